"""Lots along the streets: which building stands on each, and its garden, yard or terrace.

A street's `frontage` names a style: a generator of building sizes, and a function that builds one lot.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ilnet.world.towns import buildings, furniture, plants, structures
from ilnet.world.towns.parts import Panel, boxes, merge, shift
from ilnet.world.towns.plants import Greens
from ilnet.world.towns.site import Site
from ilnet.world.towns.streets import Street

__all__ = ["Lot", "build_lots"]


class Lot(NamedTuple):
    """A frame on the ground: x runs along the street and y away from it."""

    origin: np.ndarray
    """(2,) in the town's frame, metres. It lies behind the pavement, or on the edge of it."""
    yaw: float
    """Direction of x in the town's frame, rad counter-clockwise."""

    @classmethod
    def beside(cls, street: Street, along: float, side: int, setback: float) -> "Lot":
        """Returns the frame beside a street.

        Args:
            street: Which street.
            along: Arc length from the start of its centreline, metres.
            side: 1 for the right, -1 for the left.
            setback: Distance from the pavement, metres.
        """
        xy, heading = street.at(np.array([along]), side * (street.half_width + street.pavement + setback))
        return cls(xy[0], float(heading[0]) + (np.pi if side > 0 else 0.0))

    def moved(self, x: float, y: float) -> "Lot":
        """Returns the same frame with its origin moved to (x, y) of this one, metres."""
        return Lot(self.world([x, y])[0], self.yaw)

    def world(self, xy: ArrayLike) -> np.ndarray:
        """Returns points (2,) or (N, 2) [m] of the lot's frame as points (N, 2) in the town's frame."""
        x, y = np.atleast_2d(np.asarray(xy, dtype=np.float64)).T
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        return self.origin + np.column_stack([cos * x - sin * y, sin * x + cos * y])


def _boundary(rng: np.random.Generator) -> Panel | None:
    """Returns what runs along the edge of a garden: a fence, a hedge, a wall, a railing, or nothing."""
    kind = rng.random()
    if kind < 0.3:
        return furniture.fence(2.4, rng.uniform(0.85, 1.15), rng.uniform(0.14, 0.2))
    if kind < 0.5:
        return plants.hedge(rng, 2.0, rng.uniform(0.9, 1.9), rng.uniform(0.6, 0.9))
    if kind < 0.65:
        return Panel(boxes([0, -0.12, -0.4], [3.0, 0.12, rng.uniform(0.5, 1.1)]), 3.0)
    if kind < 0.8:
        return Panel(furniture.railing(2.0, rng.uniform(0.9, 1.2)), 2.0)
    return None


def _garden(
    site: Site, lot: Lot, width: float, setback: float, depth: float, greens: Greens, rng: np.random.Generator
) -> None:
    """Builds a garden: its edges with gaps for door and drive, plants, a spot for a car, bins."""
    half = width / 2
    front = -setback + 0.25
    edge = _boundary(rng)
    drive = rng.random() < 0.7
    gap = half - 3.4 if drive else half
    if edge:
        site.run(edge, lot.world([[-half + 0.1, front], [-0.9, front]]))
        site.run(edge, lot.world([[0.9, front], [gap, front]]))
    side = _boundary(rng)
    if side:
        site.run(side, lot.world([[-half, front], [-half, depth + 8]]))
        back = lot.world([[-half, depth + 8], [half, depth + 8]])
        if not site.taken(back).any():
            site.run(side, back)
    if drive and setback > 4:
        y = -setback / 2 + rng.uniform(-0.2, 1.5)
        if site.free(lot.world([[half - 1.6, y - 2.2], [half - 1.6, y], [half - 1.6, y + 2.2]]), 0.9):
            site.park(lot.world([half - 1.6, y]), lot.yaw + np.pi / 2 + np.pi * int(rng.integers(0, 2)))
    for _ in range(int(rng.integers(1, 5)) if setback > 2 else 0):
        spot = lot.world([rng.uniform(-half, half - 3.5), rng.uniform(front + 0.6, -0.6)])
        if site.ground.kerb_distance(spot)[0] > 1.7:
            site.put(greens.pick(rng, "bush"), spot, rng.uniform(0, 6), rng.uniform(0.6, 1.3))
    for _ in range(int(rng.integers(0, 5))):
        behind = setback < 4 or rng.random() < 0.6
        y = depth + rng.uniform(3, 12) if behind else rng.uniform(front + 1.5, -1.5)
        spot = lot.world([rng.uniform(-half, half), y])
        if site.free(spot, 3.5):
            tree = greens.pick(rng, "conifer" if rng.random() < 0.25 else "small")
            site.put(tree, spot, rng.uniform(0, 6), rng.uniform(0.75, 1.15))
            site.claim(spot)
    if rng.random() < 0.5:
        spot = lot.world([[half - 0.6, front + 0.5], [half - 1.4, front + 0.6]])
        spot = spot[site.ground.kerb_distance(spot) > 0.5]
        site.put(furniture.bin_(True), spot, lot.yaw - np.pi / 2)


class _Size(NamedTuple):
    """The size of a building and of the space around it."""

    width: float
    """Length along the street, metres."""
    depth: float
    """From the front to the back, metres."""
    floors: int
    """Number of storeys."""
    setback: float
    """Depth of the front garden or yard, metres."""
    space: float
    """Distance to the next building, metres."""


def _towers(rng: np.random.Generator) -> Iterator[_Size]:
    """Yields blocks of flats, some of them tall, with space between them."""
    while True:
        width, depth, floors = rng.uniform(17, 30), rng.uniform(13, 17), int(rng.integers(4, 8))
        setback, space = rng.choice([0.0, 2.0, 5.0]), rng.uniform(5, 24)
        if rng.random() < 0.25:
            width, depth, floors = rng.uniform(17, 22), rng.uniform(16, 20), int(rng.integers(9, 15))
        yield _Size(width, depth, floors, setback, space)


def _downtown(rng: np.random.Generator) -> Iterator[_Size]:
    """Yields offices wall to wall, some of them towers."""
    while True:
        floors = int(rng.integers(5, 10) if rng.random() < 0.7 else rng.integers(11, 24))
        setback, space = rng.choice([0.0, 0.0, 0.0, 4.0]), rng.choice([0.0, 0.0, 1.5, 7.0])
        yield _Size(rng.uniform(15, 32), rng.uniform(14, 22), floors, setback, space)


def _shops(rng: np.random.Generator) -> Iterator[_Size]:
    """Yields shops with gaps between some of them."""
    while True:
        setback, space = rng.choice([0.0, 0.0, 0.6]), rng.choice([0.0, 0.0, 4.0, 12.0])
        yield _Size(rng.uniform(10, 20), rng.uniform(11, 15), int(rng.integers(2, 6)), setback, space)


def _old(rng: np.random.Generator) -> Iterator[_Size]:
    """Yields rows of narrow old houses of equal depth."""
    while True:
        depth, setback = rng.uniform(9, 13), rng.choice([0.0, 0.0, 0.4])
        for left in range(int(rng.integers(3, 9)), 0, -1):
            space = 0.0 if left > 1 else rng.choice([0.0, 2.2, 3.5])
            yield _Size(rng.uniform(6, 13), depth, int(rng.integers(3, 6)), setback, space)


def _rows(rng: np.random.Generator) -> Iterator[_Size]:
    """Yields rows of equal houses."""
    while True:
        width, depth, floors = rng.uniform(5.5, 8.5), rng.uniform(8.5, 11), int(rng.integers(2, 4))
        setback = rng.choice([0.0, 1.6, 3.0])
        for left in range(int(rng.integers(3, 7)), 0, -1):
            yield _Size(width, depth, floors, setback, 0.0 if left > 1 else rng.uniform(4, 13))


def _houses(rng: np.random.Generator) -> Iterator[_Size]:
    """Yields detached houses."""
    while True:
        width, depth, floors = rng.uniform(8.5, 13), rng.uniform(8, 11), int(rng.integers(1, 3))
        yield _Size(width, depth, floors, rng.uniform(4, 9.5), rng.uniform(5, 11))


def _cottages(rng: np.random.Generator) -> Iterator[_Size]:
    """Yields cottages with front gardens of all sizes."""
    while True:
        width, depth, floors = rng.uniform(7, 12), rng.uniform(6, 8.5), int(rng.integers(1, 3))
        yield _Size(width, depth, floors, rng.choice([0.8, rng.uniform(2, 5), rng.uniform(5, 13)]), rng.uniform(5, 15))


def _works(rng: np.random.Generator) -> Iterator[_Size]:
    """Yields halls behind yards."""
    while True:
        width, depth = rng.uniform(24, 52), rng.uniform(20, 34)
        yield _Size(width, depth, 1, rng.uniform(13, 24), rng.uniform(8, 22))


def _farms(rng: np.random.Generator) -> Iterator[_Size]:
    """Yields farmhouses far from each other."""
    while True:
        yield _Size(
            rng.uniform(9, 14), rng.uniform(7, 9), int(rng.integers(1, 3)), rng.uniform(3, 12), rng.uniform(40, 95)
        )


def _terraced(site: Site, lot: Lot, size: _Size, greens: Greens, rng: np.random.Generator) -> None:
    """Builds a house between its neighbours, with a strip of garden in front."""
    site.put(buildings.house(rng, size.width, size.depth, size.floors, detached=False), lot.origin, lot.yaw)
    if size.setback > 1 and (edge := _boundary(rng)):
        front = -size.setback + 0.2
        site.run(edge, lot.world([[-size.width / 2, front], [size.width / 4, front]]))


def _block(site: Site, lot: Lot, size: _Size, greens: Greens, rng: np.random.Generator) -> None:
    """Builds a block of flats, offices or shops."""
    ground_floor = str(rng.choice(["shops", "arcade", "passage", "flats"], p=[0.4, 0.15, 0.15, 0.3]))
    roof = "flat" if size.floors > 5 or rng.random() < 0.5 else "pitched"
    site.put(buildings.block(rng, size.width, size.depth, size.floors, ground_floor, roof), lot.origin, lot.yaw)


def _old_block(site: Site, lot: Lot, size: _Size, greens: Greens, rng: np.random.Generator) -> None:
    """Builds a town house under a pitched roof, often with shops or an arcade."""
    ground_floor = str(rng.choice(["shops", "arcade", "flats"], p=[0.4, 0.35, 0.25]))
    site.put(buildings.block(rng, size.width, size.depth, size.floors, ground_floor, "pitched"), lot.origin, lot.yaw)


def _tower(site: Site, lot: Lot, size: _Size, greens: Greens, rng: np.random.Generator) -> None:
    """Builds an office tower or a large block over shops, an arcade or a passage."""
    ground_floor = str(rng.choice(["shops", "arcade", "passage"], p=[0.45, 0.4, 0.15]))
    if size.floors > 9:
        site.put(buildings.tower(rng, size.width, size.depth, size.floors, ground_floor), lot.origin, lot.yaw)
    else:
        site.put(buildings.block(rng, size.width, size.depth, size.floors, ground_floor, "flat"), lot.origin, lot.yaw)


def _villa(site: Site, lot: Lot, size: _Size, greens: Greens, rng: np.random.Generator) -> None:
    """Builds a detached house in its garden, often with a shed."""
    site.put(buildings.house(rng, size.width, size.depth, size.floors, detached=True), lot.origin, lot.yaw)
    _garden(site, lot, size.width + size.space, size.setback, size.depth, greens, rng)
    if rng.random() < 0.5:
        width, depth = (float(v) for v in rng.uniform(3, 6, 2))
        at = lot.moved(size.width / 2 + rng.uniform(0.5, 2) + width / 2, rng.uniform(0, size.depth))
        if _claim_if_free(site, at, width, depth, 1.0):
            site.put(buildings.shed(rng, width, depth, rng.uniform(2.3, 3)), at.origin, at.yaw)


def _terrace(site: Site, lot: Lot, size: _Size, greens: Greens, rng: np.random.Generator) -> None:
    """Builds a detached house; where the ground rises, it stands on a terrace behind a retaining wall with steps."""
    half, front = (size.width + 0.7 * size.space) / 2, -size.setback + 0.3
    low, high = site.ground.height(lot.world([[0, front], [0, size.depth + 2]]))
    lift = min(high - low, 2.8)
    plot = site.footprint(lot.moved(0, front).origin, lot.yaw, 2 * half, size.depth + 2.5 - front)
    if lift < 0.4 or site.ground.kerb_distance(plot).min() < 1.0:
        _villa(site, lot, size, greens, rng)
        return
    count = int(np.ceil(lift / 0.18))
    x, one = rng.uniform(-0.5, 0.3) * half + 0.3 * np.arange(count), np.ones(count)
    steps = boxes(
        np.column_stack([x, (front - 0.9) * one, -0.6 * one]),
        np.column_stack([x + 0.3, front * one, lift / count * (1 + np.arange(count))]),
    )
    parts = [boxes([-half, front, -4.0], [half, size.depth + 2.5, lift]), steps]
    for start, end in ((-half, x[0] - 0.1), (x[-1] + 1.4, half)):
        if end - start > 1:
            parts.append(shift(furniture.railing(end - start), start, front + 0.15, lift))
    parts.append(shift(buildings.house(rng, size.width, size.depth, size.floors, detached=True), z=lift))
    for _ in range(int(rng.integers(1, 5))):
        parts.append(
            shift(greens.pick(rng, "bush"), rng.uniform(-half + 1, half - 1), rng.uniform(front + 0.9, -1.0), lift)
        )
    at = np.append(lot.origin, low)  # The wall starts at the level of the street, not of the house.
    site.put_at(merge(parts), at, lot.yaw)
    site.claim(plot)


def _factory(site: Site, lot: Lot, size: _Size, greens: Greens, rng: np.random.Generator) -> None:
    """Builds a hall behind a yard with a fence, a gate and stored goods."""
    height = rng.uniform(6.0, 10.5)
    site.put(buildings.hall(rng, size.width, size.depth, height), lot.origin, lot.yaw)
    half, front = size.width / 2 + 0.4 * size.space, -size.setback + 0.4
    gate = rng.uniform(-0.3, 0.3) * half
    concrete = Panel(boxes([0, -0.1, -0.4], [3.0, 0.1, 1.9]), 3.0)
    fence = structures.mesh_fence() if rng.random() < 0.8 else concrete
    if rng.random() < 0.8:
        site.run(fence, lot.world([[-half, front], [gate - 4.5, front]]))
        site.run(fence, lot.world([[gate + 4.5, front], [half, front]]))
        site.put(boxes([-0.25, -0.25, -0.4], [0.25, 0.25, 2.3]), lot.world([[gate - 4.6, front], [gate + 4.6, front]]))
        for side in (-half, half):
            site.run(fence, lot.world([[side, front], [side, size.depth]]))
    spots = np.arange(-half + 3, half - 3, 2.9)
    spots = spots[np.abs(spots - gate) > 6]
    site.park(lot.world(np.column_stack([spots, np.full(len(spots), front + 3.6)])), lot.yaw + np.pi / 2)
    site.walk(lot.world(np.column_stack([spots[::3], np.full(len(spots[::3]), front + 8.0)])), lot.yaw)
    _store(site, lot, size, half, rng)
    office = lot.moved(rng.choice([-1, 1]) * (size.width / 2 - 5.5), -5.0)
    foot = site.footprint(office.origin, office.yaw, 10.0, 5.0)
    away = np.hypot(*(office.origin - lot.world([gate, -5.0])[0]))
    if rng.random() < 0.25 and away > 7 and site.ground.kerb_distance(foot).min() > 1.0:
        part = buildings.block(rng, 10.0, 5.0, int(rng.integers(2, 4)), "flats", "flat")
        site.put(part, office.origin, office.yaw)
    site.put(furniture.lamp(9.0, 1.8), lot.world([-half + 1.0, front + 1.0]), lot.yaw + np.pi / 2)
    site.claim(site.footprint(lot.moved(0, front).origin, lot.yaw, 2 * half, size.depth - front))


def _store(site: Site, lot: Lot, size: _Size, half: float, rng: np.random.Generator) -> None:
    """Puts trailers, containers and pallets into a yard 2 `half` metres wide; a tank or silos may stand beside it."""
    ground = site.ground
    for x in np.arange(-half + 4, half - 2, 7.0):
        kind = rng.random()
        if ground.kerb_distance(lot.world([[x, -1.0], [x, -14.0]])).min() < 2.0:
            continue
        if kind < 0.22 and size.setback > 15:
            site.put(structures.trailer(), lot.world([x, -7.2 + rng.uniform(-0.6, 0.3)]), lot.yaw - np.pi / 2)
        elif kind < 0.36:
            site.put(structures.container(), lot.world([x, -2.2]), lot.yaw + rng.normal(0, 0.03))
        elif kind < 0.46:
            z = 0.15 * np.arange(int(rng.integers(3, 10)))[:, None]
            stack = boxes(np.array([-0.6, -0.5, 0.0]) + z * (0, 0, 1), np.array([0.6, 0.5, 0.12]) + z * (0, 0, 1))
            site.put(stack, lot.world(np.column_stack([x + 1.4 * np.arange(3), np.full(3, -1.5)])), lot.yaw)
    edge = size.width / 2 + 0.2 * size.space
    kind = rng.random()
    if ground.kerb_distance(lot.world([[edge + 8.0, 6.0], [edge, 0.0]])).min() < 4.0:
        return
    if kind < 0.3 and size.space > 14:
        site.put(structures.tank(2.6, rng.uniform(5, 9)), lot.world([edge + 2.0, 6.0]), lot.yaw)
    elif kind < 0.5 and size.space > 12:
        site.put(structures.silo(1.7, rng.uniform(8, 13)), lot.world([[edge, 4.0], [edge, 8.2]]), lot.yaw)


def _farm(site: Site, lot: Lot, size: _Size, greens: Greens, rng: np.random.Generator) -> None:
    """Builds a farmhouse with barns, silos and a paddock."""
    _villa(site, lot, size, greens, rng)
    side = rng.choice([-1, 1])
    for k in range(int(rng.integers(1, 4))):
        width, depth = rng.uniform(12, 24), rng.uniform(9, 13)
        at = lot.moved(side * (size.width / 2 + 6 + width / 2 + 3 * k), rng.uniform(-2, 4) + k * 15)
        if _claim_if_free(site, at, width, depth, 4.0):
            site.put(buildings.barn(rng, width, depth), at.origin, at.yaw)
            yard = at.world([rng.uniform(-0.3, 0.3) * width, -3.5])
            if site.free(yard, 3.0):
                site.park(yard, at.yaw + rng.uniform(-0.4, 0.4))
            if rng.random() < 0.5:
                spot = at.world([[side * (width / 2 + 3.2), 4.0]])
                if site.free(spot, 3.0):
                    site.put(structures.silo(rng.uniform(1.6, 2.4), rng.uniform(7, 12)), spot, lot.yaw)
    far = -side * (size.width / 2 + rng.uniform(16, 28))
    near = -side * (size.width / 2 + 3)
    front, back = -size.setback + 0.8, size.depth + rng.uniform(8, 22)
    paddock = lot.world([[near, front], [far, front], [far, back], [near, back], [near, front]])
    site.run(structures.post_and_rail(), paddock, 1.2)
    bales = lot.world(
        rng.uniform((min(near, far) + 2, 3), (max(near, far) - 2, back - 2), (int(rng.integers(0, 7)), 2))
    )
    site.put(structures.bale(), bales[~site.taken(bales)], rng.uniform(0, 3))


class _Style(NamedTuple):
    """How the lots along a street are filled."""

    sizes: Callable[[np.random.Generator], Iterator[_Size]]
    """Draws one building after the other."""
    build: Callable[[Site, Lot, _Size, Greens, np.random.Generator], None]
    """Builds one lot."""
    gaps: float = 0.0
    """Probability of an empty stretch before a lot."""
    scaffolded: bool = False
    """Whether a few fronts have a scaffold."""


_STYLES = {
    "towers": _Style(_towers, _block, scaffolded=True),
    "downtown": _Style(_downtown, _tower, scaffolded=True),
    "shops": _Style(_shops, _block, scaffolded=True),
    "old": _Style(_old, _old_block, scaffolded=True),
    "rows": _Style(_rows, _terraced, scaffolded=True),
    "houses": _Style(_houses, _villa),
    "hillside": _Style(_houses, _terrace),
    "cottages": _Style(_cottages, _villa, 0.12),
    "works": _Style(_works, _factory),
    "farms": _Style(_farms, _farm, 0.4),
    "open": _Style(_houses, _villa, 0.8),
}


def _claim_if_free(site: Site, lot: Lot, width: float, depth: float, clearance: float) -> bool:
    """Returns whether a footprint is free, and if so marks it as taken; arguments as for `Site`."""
    points = site.footprint(lot.origin, lot.yaw, width, depth)
    if not site.free(points, clearance):
        return False
    site.claim(points)
    return True


def build_lots(site: Site, street: Street, side: int, greens: Greens, rng: np.random.Generator) -> None:
    """Fills one side of a street with buildings in the style of its frontage.

    Args:
        site: Where to build.
        street: Which street. If its `frontage` names no style, nothing is built.
        side: 1 for the right, -1 for the left.
        greens: Plants for the gardens.
        rng: Source of the variety.
    """
    if street.frontage not in _STYLES:
        return
    style = _STYLES[street.frontage]
    sizes = style.sizes(rng)
    end = street.length - street.tails[1]
    along = street.tails[0] + rng.uniform(2, 8)
    while along < end - 4:
        if rng.random() < style.gaps:
            along += rng.uniform(10, 30)
            continue
        size = next(sizes)
        lot = Lot.beside(street, along + size.width / 2, side, size.setback)
        if along + size.width / 2 > end or not _claim_if_free(site, lot, size.width, size.depth, street.pavement - 0.3):
            along += 2.0
            sizes = style.sizes(rng)  # A row of houses that was interrupted does not go on.
            continue
        style.build(site, lot, size, greens, rng)
        if style.scaffolded and street.pavement > 1.8 and rng.random() < 0.06:
            site.put(structures.scaffold(size.width - 1.0, int(rng.integers(2, 6))), lot.origin, lot.yaw)
        along += size.width + size.space
