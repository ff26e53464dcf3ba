"""Dresses streets and fields: lamps, trees, signs, wires, and the spots where cars and people may be."""

from itertools import pairwise

import numpy as np

from ilnet.world.towns import furniture, plants, structures
from ilnet.world.towns.parts import Part
from ilnet.world.towns.plants import Greens
from ilnet.world.towns.site import Site
from ilnet.world.towns.streets import Street

__all__ = ["dress_street", "plant_fields", "signals"]


def _spread(
    street: Street, right: float, first: float, step: float, jitter: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Returns points (N, 2) [m] at about even steps along a street, and the street's headings (N,) [rad] there.

    Args:
        street: Which street.
        right: Distance to the right of the centreline, metres.
        first: Arc length of the first point, metres.
        step: From one point to the next, metres.
        jitter: How far points may stray along the street, metres.
        rng: Source of the variety.
    """
    s = np.arange(first, street.length - 2, step)
    return street.at(s + rng.uniform(-jitter, jitter, len(s)), right)


def dress_street(site: Site, street: Street, greens: Greens, rng: np.random.Generator) -> None:
    """Furnishes the pavements, the parking along the kerbs and the median of a street."""
    if street.frontage == "highway":
        _dress_highway(site, street, greens, rng)
        return
    ground = site.ground
    busy = street.frontage in ("shops", "towers", "downtown", "old")
    country = street.frontage in ("farms", "open")
    for side in street.sides:
        inward = np.pi / 2 if side > 0 else -np.pi / 2  # From the street's heading to the direction of the carriageway.
        lamp = furniture.lamp(rng.uniform(6.0, 8.5), rng.uniform(1.0, 2.2))
        offset = side * (street.half_width + 0.5)

        def stand(
            parts: list[Part],
            first: float,
            step: float,
            share: float,
            right: float,
            turn: float,
            scale: tuple[float, float] = (1.0, 1.0),
        ) -> None:
            """Puts parts, at random one of several, where the pavement is free; first, step and right as in `_spread`.

            Args:
                parts: What to choose from.
                first: Arc length of the first one, metres.
                step: From one to the next, metres.
                share: Probability that one of them stands.
                right: Distance to the right of the centreline, metres.
                turn: Turn from the street's heading, rad.
                scale: Range of the size relative to the part.
            """
            xy, heading = _spread(street, right, first, step, 0.2 * step, rng)
            edge = ground.kerb_distance(xy)
            keep = (edge > 0.38) & (edge < street.pavement + 0.2) & (rng.random(len(xy)) < share) & ~site.taken(xy)
            kind = rng.integers(0, len(parts), len(xy))
            size = rng.uniform(scale[0], scale[1], len(xy))
            for k, part in enumerate(parts):
                pick = keep & (kind == k)
                site.put(part, xy[pick], heading[pick] + turn, size[pick])

        if not country:
            stand([lamp], 9 if side > 0 else 24, 30, 0.95, offset, inward)
        signs = [furniture.sign(k) for k in range(4)]
        stand(signs, 14, 60 if country else 23, 0.7, offset, np.pi if side > 0 else 0.0)
        wide = side * (street.half_width + street.pavement - 0.5)
        if not country:
            stand([furniture.bin_(False), furniture.bin_(True)], 20, 35, 0.6, wide, inward)
        _walks(site, street, side, 24.0 if country else 4.0, rng)
        if busy:
            stand([furniture.bench()], 16, 41, 0.7, wide, inward)
            stand([furniture.cabinet(), furniture.cycle_hoops()], 27, 37, 0.5, wide, inward)
            stand([furniture.bollard()], 3, 2.2, 0.25, offset, 0.0)
            stand([furniture.bus_shelter()], 45, 150, float(street.pavement > 2.0), wide, inward)
        if street.pavement > 2.4:
            trees = greens.kinds["tall"] * 3 + greens.kinds["bare"]
            stand(
                trees, 7, rng.uniform(12, 18), 0.75, side * (street.half_width + 0.9), rng.uniform(0, 6), (0.95, 1.15)
            )
        if street.parking:
            _parking(site, street, side, rng)
        if country:
            _verge(site, street, side, greens, rng)
    if street.median:
        s = np.arange(4, street.length - 4, 2.0)
        xy, _ = street.at(s, 0.0)
        inside = ground.kerb_distance(xy) > 0.5
        s_tree = inside & (np.arange(len(s)) % 6 == 0)
        for at in xy[s_tree]:
            site.put(greens.pick(rng, "tall"), at, rng.uniform(0, 6), rng.uniform(1.0, 1.2))
        hedge = plants.hedge(rng, 2.0, 0.8, 0.9)
        for k in np.nonzero(inside[:-1] & inside[1:] & (np.arange(len(s) - 1) % 24 < 14))[0]:
            site.run(hedge, xy[k : k + 2])
    if street.frontage in ("houses", "open", "rows", "cottages", "works", "farms", "hillside") and rng.random() < 0.8:
        _power_poles(site, street, rng)


def _dress_highway(site: Site, street: Street, greens: Greens, rng: np.random.Generator) -> None:
    """Furnishes a highway: guard rails, posts, signs, shrubs; on the median a concrete barrier, lamps and gantries."""
    ground = site.ground

    def line(right: float, first: float = 2.0, step: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
        """Returns points and headings as `_spread` does, at even steps."""
        return street.at(np.arange(first, street.length - 2, step), right)

    for side in street.sides:
        xy, heading = line(side * (street.half_width + 0.7))
        site.run(structures.guard_rail(), xy if side < 0 else xy[::-1], 0.45)
        xy, heading = line(side * (street.half_width + 0.4), 10, 25)
        site.put(furniture.bollard(), xy[ground.kerb_distance(xy) > 0.3], heading[0])
        xy, heading = line(side * (street.half_width + 1.6), 30, 110)
        clear = ground.kerb_distance(xy) > 1.0
        site.put(furniture.sign(2, 2.9), xy[clear], heading[clear] + (np.pi if side > 0 else 0.0), 1.5)
        xy, _ = street.at(np.arange(5, street.length - 5, 3.0), side * (street.half_width + rng.uniform(4, 9)))
        for at in xy[(ground.kerb_distance(xy) > 2.5) & ~site.taken(xy) & (rng.random(len(xy)) < 0.4)]:
            kind = str(rng.choice(["bush", "small", "tall"], p=[0.6, 0.2, 0.2]))
            site.put(greens.pick(rng, kind), at + rng.uniform(-1.5, 1.5, 2), rng.uniform(0, 6), rng.uniform(0.8, 1.5))
    if street.median:
        xy, heading = line(0.0)
        site.run(structures.concrete_barrier(), xy, 0.5)
        xy, heading = line(0.0, 20, 45)
        inside = ground.kerb_distance(xy) > 0.5
        for turn in (0.5, -0.5):
            site.put(furniture.lamp(10.5, 2.4), xy[inside], heading[inside] + turn * np.pi)
        span = 2 * street.half_width + 2.4
        for s in (0.27, 0.58, 0.82):
            at, heading = street.at(np.array([s * street.length]), 0.0)
            site.put_at(structures.gantry(span), [*at[0], float(ground.height(at)[0])], heading)


def _verge(site: Site, street: Street, side: int, greens: Greens, rng: np.random.Generator) -> None:
    """Bounds the fields along a lane, stretch by stretch: with a wall, a hedge, a bank, a fence, trees, or nothing."""
    s = street.tails[0]
    while s < street.length - street.tails[1]:
        length = rng.uniform(25, 70)
        xy, _ = street.at(
            np.arange(s, min(s + length, street.length), 4.0), side * (street.half_width + rng.uniform(1.7, 3.0))
        )
        kind = str(rng.choice(["wall", "hedge", "bank", "fence", "trees", "none"]))
        panels = {
            "wall": lambda: structures.stone_wall(rng, rng.uniform(0.8, 1.3)),
            "hedge": lambda: plants.hedge(rng, 4.0, rng.uniform(1.0, 2.2), rng.uniform(0.8, 1.4)),
            "bank": lambda: structures.bank(rng.uniform(0.5, 1.1)),
            "fence": structures.post_and_rail,
        }
        if kind in panels:
            panel = panels[kind]()
            for start, end in pairwise(xy):
                middle = 0.5 * (start + end)
                if not site.taken(np.array([start, middle, end])).any():
                    site.run(panel, np.array([start, end]), 1.3)
        if kind in ("trees", "bank"):
            spots = xy[:: 2 if kind == "trees" else 3]
            for at in spots[(site.ground.kerb_distance(spots) > 1.5) & ~site.taken(spots)]:
                site.put(greens.pick(rng, "tall", "bare"), at, rng.uniform(0, 6), rng.uniform(0.8, 1.1))
        s += length + rng.uniform(4, 9)


def _parking(site: Site, street: Street, side: int, rng: np.random.Generator) -> None:
    """Adds spots for cars along one kerb."""
    s = np.arange(5, street.length - 5, 6.1) + rng.uniform(-0.4, 0.4)
    from_kerb = 1.08  # To the middle of a parked car [m].
    lateral = side * (street.half_width - from_kerb)
    xy, heading = street.at(s, lateral)
    straight = np.ones(len(s), dtype=bool)
    for step in (-6.0, -3.0, 0.0, 3.0, 6.0):  # At junctions and ends of streets the kerb turns away.
        near, _ = street.at(s + step, lateral)
        straight &= np.abs(site.ground.kerb_distance(near) + from_kerb) < 0.3
    turn = (0.0 if side > 0 else np.pi) + rng.normal(0, 0.02, len(s))
    site.park(xy[straight], (heading + turn)[straight])


def _walks(site: Site, street: Street, side: int, step: float, rng: np.random.Generator) -> None:
    """Adds spots for people on one pavement or verge, about `step` metres apart, where nothing stands."""
    s = np.arange(3, street.length - 3, step)
    s = s + rng.uniform(-0.4, 0.4, len(s)) * step
    xy, heading = street.at(s, side * (street.half_width + rng.uniform(0.95, max(street.pavement - 0.75, 1.0), len(s))))
    edge = site.ground.kerb_distance(xy)
    clear = (edge > 0.5) & (edge < max(street.pavement, 1.7)) & ~site.taken(xy)
    site.walk(xy[clear], (heading + np.pi * rng.integers(0, 2, len(s)))[clear])


def signals(site: Site, first: Street, second: Street) -> None:
    """Sets traffic lights where two streets meet, on each approach in front of the crossing."""
    gap = np.linalg.norm(first.line[:, None] - second.line, axis=-1)
    meet = np.unravel_index(gap.argmin(), gap.shape)
    for street, other, k in ((first, second, meet[0]), (second, first, meet[1])):
        middle = street.length * k / (len(street.line) - 1)
        for way in (1, -1):
            s = middle - way * (other.half_width + 4.5)
            if not 0 < s < street.length:
                continue
            xy, heading = street.at(np.array([s]), way * (street.half_width + 0.5))
            if site.ground.kerb_distance(xy)[0] > 0.3:
                inward = heading + way * np.pi / 2
                # The arm reaches over the lanes; its heads face the waiting traffic.
                arm = furniture.traffic_light(street.half_width - street.lanes[0])
                site.put(arm, xy, inward)


def _power_poles(site: Site, street: Street, rng: np.random.Generator) -> None:
    """Sets wooden poles along one side of a street, with three sagging wires."""
    side = float(rng.choice([-1, 1]))
    s = np.arange(6, street.length - 6, rng.uniform(28, 36))
    xy, heading = street.at(s, side * (street.half_width + street.pavement - 0.35))
    keep = (site.ground.kerb_distance(xy) > 0.6) & ~site.taken(xy)
    xy, heading, s = xy[keep], heading[keep], s[keep]
    site.put(furniture.pole(), xy, heading)
    top = site.ground.surface(xy)
    left = np.column_stack([-np.sin(heading), np.cos(heading)])
    for y, z in furniture.POLE_HOOKS:
        hooks = top + np.column_stack([left * y, np.full(len(s), z)])
        for k in range(len(s) - 1):
            if s[k + 1] - s[k] < 50:
                site.put_at(furniture.wire(hooks[k], hooks[k + 1], rng.uniform(0.3, 0.8)), (0, 0, 0))


def plant_fields(site: Site, greens: Greens, radius: float, rng: np.random.Generator) -> None:
    """Plants trees between the lots, and a ragged line of trees around the town at about `radius` metres."""
    turn = np.linspace(0, 2 * np.pi, 130, endpoint=False)
    reach = radius * (1 + 0.05 * np.sin(3 * turn + rng.uniform(0, 6)) + rng.normal(0, 0.02, len(turn)))
    ring = np.column_stack([np.cos(turn), np.sin(turn)])
    # The line is a rounded square, so that it reaches into the corners of the ground.
    ring *= (reach / np.maximum(np.abs(ring).max(1), 0.8))[:, None]
    ring = ring[site.in_sight(ring) & (rng.random(len(ring)) < 0.9)]
    for at in ring:
        if site.free(at[None], 8.0):
            site.put(greens.pick(rng, "far"), at, rng.uniform(0, 6), rng.uniform(0.7, 1.2))
    spots = rng.uniform(-0.95 * radius, 0.95 * radius, (1600, 2))
    spots = spots[(site.ground.kerb_distance(spots) > 6) & ~site.taken(spots) & site.in_sight(spots)]
    around = 3 * np.column_stack([np.cos(np.arange(8)), np.sin(np.arange(8))])
    for at in spots[:170]:
        if not site.taken(at + around).any():
            kind = str(rng.choice(["small", "bush", "conifer", "far", "bare"], p=[0.35, 0.25, 0.1, 0.25, 0.05]))
            site.put(greens.pick(rng, kind), at, rng.uniform(0, 6), rng.uniform(0.8, 1.3))
