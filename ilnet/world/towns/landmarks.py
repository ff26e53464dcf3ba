"""Landmarks, which a town has once or twice: squares, parks, churches, bridges, yards, fields, power and tram lines.

A plan chooses them. They are built before the lots and mark the ground that they need as taken.
"""

from itertools import pairwise

import numpy as np

from ilnet.world.towns import buildings, furniture, plants, structures
from ilnet.world.towns.frontage import Lot
from ilnet.world.towns.parts import Panel, boxes, merge, place
from ilnet.world.towns.plants import Greens
from ilnet.world.towns.site import Site
from ilnet.world.towns.streets import Street, inside

__all__ = [
    "bridge",
    "churchyard",
    "container_yard",
    "fields",
    "green_square",
    "island",
    "market_square",
    "noise_walls",
    "park",
    "power_line",
    "tank_farm",
    "tram_line",
]


def _plot(site: Site, street: Street, share: float, side: int, setback: float, width: float, depth: float) -> Lot:
    """Returns the frame of a rectangular plot beside a street, after marking the rectangle as taken.

    Args:
        site: Where to build.
        street: Which street.
        share: Where along the street, 0 to 1, tails excluded.
        side: 1 for the right, -1 for the left.
        setback: Distance from the pavement, metres.
        width: Length of the plot along the street, metres.
        depth: From the front of the plot to its back, metres.
    """
    lot = Lot.beside(street, street.tails[0] + share * (street.length - sum(street.tails)), side, setback)
    site.claim(site.footprint(lot.origin, lot.yaw, width, depth))
    return lot


def _plant(site: Site, greens: Greens, kinds: tuple[str, ...], spots: np.ndarray, rng: np.random.Generator) -> None:
    """Puts plants of some kinds on those of spots (N, 2) [m] that are off the carriageways."""
    for at in spots[site.ground.kerb_distance(spots) > 1.6]:
        site.put(greens.pick(rng, str(rng.choice(kinds))), at, rng.uniform(0, 6), rng.uniform(0.8, 1.2))


def _enclose(site: Site, lot: Lot, width: float, depth: float, panel: Panel, gap: float = 2.0) -> None:
    """Repeats a panel along the sides and the front of a plot; a gap of `gap` metres each way is left in the middle."""
    half = width / 2
    for start, end in (
        ((-half, 0), (-gap, 0)),
        ((gap, 0), (half, 0)),
        ((-half, 0), (-half, depth)),
        ((half, 0), (half, depth)),
    ):
        site.run(panel, lot.world([start, end]))


def _within(line: np.ndarray, step: float) -> np.ndarray:
    """Returns the points (N, 2) [m] of a raster of `step` metres that lie inside a closed line."""
    low, high = line.min(0), line.max(0)
    x, y = np.meshgrid(np.arange(low[0], high[0], step), np.arange(low[1], high[1], step), indexing="ij")
    xy = np.column_stack([x.ravel(), y.ravel()])
    return xy[inside(line, xy)]


def churchyard(site: Site, street: Street, share: float, greens: Greens, rng: np.random.Generator) -> None:
    """Builds a church in its yard, with a wall, graves and trees, on the left of a street."""
    width, depth, setback = 44.0, 56.0, 1.0
    lot = _plot(site, street, share, -1, setback, width, depth)
    half = width / 2
    site.put(buildings.church(rng), lot.world([0.0, 13.0]), lot.yaw)
    wall = structures.stone_wall(rng, 1.2)
    _enclose(site, lot, width, depth, wall)
    pillar = boxes([-0.35, -0.35, -0.4], [0.35, 0.35, 2.0])
    site.put(pillar, lot.world([[-2, 0], [2, 0]]), lot.yaw)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(9.5, half - 2, 2.2), np.arange(5.0, depth - 5, 3.5)))
    for sign in (-1, 1):
        graves = np.column_stack([sign * x, y])[rng.random(len(x)) < 0.55] + rng.normal(0, 0.15, 2)
        stone = boxes([-0.4, -0.08, -0.3], [0.4, 0.08, rng.uniform(0.7, 1.1)])
        site.put(stone, lot.world(graves), lot.yaw + rng.normal(0, 0.05, len(graves)))
    trees = np.column_stack([rng.choice([-1, 1], 7) * rng.uniform(12, half - 2, 7), rng.uniform(4, depth - 4, 7)])
    _plant(site, greens, ("tall", "conifer"), lot.world(trees), rng)


def island(site: Site, ring: Street, greens: Greens, rng: np.random.Generator) -> None:
    """Fills the middle of a roundabout: a statue, hedges, trees and signs."""
    centre = ring.line[:-1].mean(0)
    site.put(structures.statue(), centre, rng.uniform(0, 6))
    turn = np.linspace(0, 2 * np.pi, 25)
    circle = np.column_stack([np.cos(turn), np.sin(turn)])
    hedge = plants.hedge(rng, 2.0, 0.9, 1.0)
    for arc in range(0, 24, 6):
        site.run(hedge, centre + 7.0 * circle[arc : arc + 5])
    trees = centre + 10.5 * circle[:-1:4] + rng.uniform(-1, 1, (6, 2))
    _plant(site, greens, ("tall", "conifer"), trees, rng)
    signs = centre + 14.0 * circle[:-1:6]
    site.put(furniture.sign(2, 1.2), signs[site.ground.kerb_distance(signs) > 0.6], turn[:-1:6])


def park(
    site: Site,
    street: Street,
    share: float,
    side: int,
    width: float,
    depth: float,
    greens: Greens,
    rng: np.random.Generator,
) -> None:
    """Builds a small park behind a railing beside a street; arguments as for `_plot`."""
    lot = _plot(site, street, share, side, 0.5, width, depth)
    half = width / 2
    _enclose(site, lot, width, depth, Panel(furniture.railing(2.0, 1.2), 2.0))
    spots = np.column_stack([rng.uniform(-half + 2, half - 2, 18), rng.uniform(3, depth, 18)])
    _plant(site, greens, ("tall", "small", "bush", "conifer"), lot.world(spots), rng)
    benches = np.column_stack([np.linspace(-half + 6, half - 6, 4), np.full(4, 8.0)])
    site.put(furniture.bench(), lot.world(benches), lot.yaw - np.pi / 2)


def green_square(site: Site, around: list[Street], greens: Greens, rng: np.random.Generator) -> None:
    """Fills the block between four streets with a park: trees, benches, a fountain, a railing.

    Args:
        site: Where to build.
        around: Two streets in one direction, then the two that cross them.
        greens: Plants of the town.
        rng: Source of the variety.
    """
    corners = []
    for a, b in ((0, 2), (0, 3), (1, 3), (1, 2)):
        gap = np.hypot(*(around[a].line[:, None] - around[b].line).transpose(2, 0, 1))
        corners.append(around[a].line[np.unravel_index(gap.argmin(), gap.shape)[0]])
    block = np.array([*corners, corners[0]])
    centre = block[:-1].mean(0)
    lawn = _within(block, 1.0)
    site.claim(lawn[site.ground.kerb_distance(lawn) > 5.5])
    site.put(structures.fountain(), centre)
    shrunk = centre + (block - centre) * 0.74
    rail = Panel(furniture.railing(2.0, 1.1), 2.0)
    for a, b in pairwise(shrunk):
        for start, end in ((0.02, 0.44), (0.56, 0.98)):
            site.run(rail, np.array([a + start * (b - a), a + end * (b - a)]), 4.0)
    spots = _within(shrunk, 7.5)
    spots = spots + rng.uniform(-2.2, 2.2, spots.shape)
    away = np.hypot(*(spots - centre).T)
    _plant(
        site,
        greens,
        ("tall", "tall", "tall", "small", "conifer", "bush"),
        spots[(away > 9) & (rng.random(len(spots)) < 0.8)],
        rng,
    )
    turn = 2 * np.pi * np.arange(8) / 8 + 0.2
    site.put(furniture.bench(), centre + 7.0 * np.column_stack([np.cos(turn), np.sin(turn)]), turn + np.pi)
    site.put(
        furniture.lamp(4.2, 0.3),
        centre + 8.2 * np.column_stack([np.cos(turn[::2] + 0.4), np.sin(turn[::2] + 0.4)]),
        turn[::2],
    )
    walks = spots[away > 6] + 2.0
    site.walk(walks, rng.uniform(-np.pi, np.pi, len(walks)))


def market_square(site: Site, ring: Street, greens: Greens, rng: np.random.Generator) -> None:
    """Fills a closed street with a market square: fountain, statue, stalls, café tables, bollards and lamps."""
    floor = _within(ring.line, 1.0)
    edge = site.ground.kerb_distance(floor)
    site.claim(floor[edge > 0.5])
    centre = ring.line[:-1].mean(0)
    spread = ring.line[:-1] - centre
    angle = 0.5 * np.arctan2(2 * (spread[:, 0] * spread[:, 1]).mean(), (spread[:, 0] ** 2 - spread[:, 1] ** 2).mean())
    lot = Lot(centre, float(angle))
    site.put(structures.fountain(), lot.world([-13.0, 0.0]))
    site.put(structures.statue(), lot.world([17.0, 0.0]), lot.yaw)
    for y in (-12.0, -6.5, 6.5, 12.0):
        for x in np.arange(-4.0, 13.0, 4.3):
            spot = lot.world([x + rng.uniform(-0.3, 0.3), y])
            if rng.random() < 0.8 and site.ground.kerb_distance(spot)[0] > 3:
                site.put(structures.stall(rng), spot, lot.yaw + (np.pi / 2 if y in (-12.0, 6.5) else -np.pi / 2))
    for x in (-24.0, -20.5, 24.0):
        for y in np.arange(-13, 14, 3.6):
            spot = lot.world([x, y]) + rng.uniform(-0.3, 0.3, 2)
            if site.ground.kerb_distance(spot)[0] > 2.5 and rng.random() < 0.85:
                site.put(structures.parasol(rng.random() < 0.7), spot, rng.uniform(0, 6))
    s = np.arange(1.0, ring.length, 2.4)
    posts, _ = ring.at(s, -(ring.half_width + 0.45))
    site.put(furniture.bollard(), posts[np.arange(len(s)) % 9 > 1])
    s = np.arange(5.0, ring.length, 19.0)
    spots, heading = ring.at(s, -(ring.half_width + 1.6))
    site.put(furniture.lamp(5.0, 0.4), spots, heading)
    trees, _ = ring.at(s + 9.0, -(ring.half_width + 2.4))
    _plant(site, greens, ("small",), trees, rng)
    walks = floor[edge > 2.0]
    walks = walks[:: max(1, len(walks) // 160)]
    site.walk(walks, rng.uniform(-np.pi, np.pi, len(walks)))


def tram_line(site: Site, street: Street) -> None:
    """Sets masts along a street and wires over the middle of its two lanes."""
    s = np.arange(9.0, street.length - 4, 24.0)
    arm = street.half_width + 0.45
    xy, heading = street.at(s, arm)
    keep = site.ground.kerb_distance(xy) > 0.3
    site.put(structures.tram_mast(arm), xy[keep], heading[keep] + np.pi / 2)
    s = s[keep]
    for right in (-street.lanes[0], street.lanes[0]):
        over, _ = street.at(s, right)
        hooks = np.column_stack([over, site.ground.height(over) + structures.TRAM_WIRE_HEIGHT])
        for a, b in pairwise(hooks):
            site.put_at(furniture.wire(a, b, 0.15, 0.012), (0, 0, 0))


def noise_walls(site: Site, street: Street, side: int, start: float, end: float, rng: np.random.Generator) -> None:
    """Builds a noise wall along one side (1 right, -1 left) of a highway, between two shares of its length."""
    length = street.length
    xy, _ = street.at(np.arange(start * length, end * length, 4.0), side * (street.half_width + 3.2))
    site.run(structures.noise_wall(rng.uniform(3.5, 4.5)), xy, 2.0)
    site.claim(xy)


def bridge(site: Site, street: Street, share: float) -> None:
    """Builds a bridge with its banks over a highway, at a share of the highway's length."""
    at, heading = street.at(np.array([share * street.length]), 0.0)
    across = np.arange(-street.half_width - 70.0, street.half_width + 71.0)
    left = np.array([-np.sin(heading[0]), np.cos(heading[0])])
    line = at + across[:, None] * left
    deck = line[np.abs(across) < street.half_width]
    z = float(site.ground.height(deck).max())
    site.put_at(structures.overpass(2 * street.half_width + 11.0), [*at[0], z], heading)
    along = np.array([left[1], -left[0]])
    banks = line[np.abs(across) > street.half_width + 3]
    site.claim(np.concatenate([banks + step * along for step in np.arange(-9.0, 9.5)]))


def tank_farm(site: Site, street: Street, share: float, side: int, rng: np.random.Generator) -> None:
    """Builds six tanks with pipes inside a low wall, behind a fence; arguments as for `_plot`."""
    lot = _plot(site, street, share, side, 4.0, 56.0, 42.0)
    wall = Panel(boxes([0, -0.15, -0.6], [3.0, 0.15, 1.1]), 3.0)
    corners = lot.world([[-27, 2], [27, 2], [27, 40], [-27, 40], [-27, 2]])
    site.run(wall, corners)
    site.run(structures.mesh_fence(), lot.world([[-28, 0], [28, 0]]))
    for x in (-18, 0, 18):
        for y in (12, 30):
            tank = structures.tank(rng.uniform(5.0, 7.0), rng.uniform(6.0, 11.0))
            if site.ground.kerb_distance(lot.world([x, y]))[0] > 9:
                site.put(tank, lot.world([x, y]), lot.yaw + rng.uniform(-0.3, 0.3))
    pipes = boxes([[-26, 3.2 + 0.5 * k, 0.6] for k in range(3)], [[26, 3.5 + 0.5 * k, 0.85] for k in range(3)])
    site.put(pipes, lot.origin, lot.yaw)


def container_yard(site: Site, street: Street, share: float, side: int, rng: np.random.Generator) -> None:
    """Builds a yard behind a wire fence: stacks of containers, trailers, lamps; arguments as for `_plot`."""
    lot = _plot(site, street, share, side, 2.0, 58.0, 40.0)
    _enclose(site, lot, 58.0, 40.0, structures.mesh_fence(), gap=5.0)
    short, long = structures.container(), structures.container(12.19)
    for row, y in enumerate((7.0, 9.8, 20.0, 22.8, 33.0)):
        for x in np.arange(-23.0, 24.0, 6.6 if row % 2 else 12.9):
            if (abs(x) < 5 and row < 2) or site.ground.kerb_distance(lot.world([x, y]))[0] < 8:
                continue
            high = int(rng.choice([0, 1, 2, 3], p=[0.2, 0.35, 0.3, 0.15]))
            one = short if row % 2 else long
            stack = merge([place(one, (rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1), 2.6 * k)) for k in range(high)])
            site.put(stack, lot.world([x, y]), lot.yaw)
    site.put(structures.trailer(), lot.world([[-16.0, 15.0], [10.0, 15.2]]), lot.yaw)
    site.put(furniture.lamp(11.0, 1.5), lot.world([[-27.0, 15.0], [27.0, 15.0]]), lot.yaw)


def power_line(site: Site, street: Street, right: float, rng: np.random.Generator) -> None:
    """Sets pylons with six wires along a street, `right` metres to the right of its centreline."""
    s = np.arange(20.0, street.length, 74.0)
    xy, heading = street.at(s, right)
    clear = site.ground.kerb_distance(xy) > 3.0
    xy, heading = xy[clear], heading[clear]
    site.put(structures.pylon(), xy, heading)
    site.claim(np.concatenate([xy + step for step in ((0, 0), (1.5, 0), (-1.5, 0), (0, 1.5), (0, -1.5))]))
    top = site.ground.surface(xy)
    left = np.column_stack([-np.sin(heading), np.cos(heading)])
    for reach, z in structures.PYLON_ARMS:
        for y in (-reach, reach):
            hooks = top + np.column_stack([left * y, np.full(len(xy), z - 0.2)])
            for a, b in pairwise(hooks):
                if np.hypot(*(b - a)[:2]) < 160:
                    site.put_at(furniture.wire(a, b, rng.uniform(1.6, 2.2), 0.025), (0, 0, 0))


def fields(site: Site, greens: Greens, rng: np.random.Generator) -> None:
    """Bounds fields with walls, hedges and fences in about two directions, and strews bales."""
    reach, grain = site.ground.extent - 30.0, rng.uniform(0, np.pi)
    for _ in range(46):
        middle, length = rng.uniform(-reach, reach, 2), rng.uniform(40, 110)
        turn = grain + np.pi / 2 * int(rng.integers(0, 2)) + rng.normal(0, 0.08)
        way = np.array([np.cos(turn), np.sin(turn)])
        path = middle + np.linspace(-0.5, 0.5, max(2, round(length / 4)))[:, None] * length * way
        path = path[(np.abs(path) < reach).all(1)]
        path = path[(site.ground.kerb_distance(path) > 6) & ~site.taken(path) & site.in_sight(path)]
        if len(path) < 2:
            continue
        kind = rng.random()
        if kind < 0.35:
            site.run(structures.stone_wall(rng, rng.uniform(0.9, 1.3)), path)
        elif kind < 0.7:
            site.run(plants.hedge(rng, 4.0, rng.uniform(1.2, 2.4), 1.2), path)
            _plant(site, greens, ("tall", "far", "bare"), path[::3], rng)
        else:
            site.run(structures.post_and_rail(), path)
        site.claim(path)
    for _ in range(12):
        centre = rng.uniform(-reach, reach, 2)
        bales = centre + rng.uniform(-25, 25, (int(rng.integers(4, 10)), 2))
        site.put(structures.bale(), bales[site.ground.kerb_distance(bales) > 3], rng.uniform(0, 3))
