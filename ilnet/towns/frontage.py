"""Lots along the streets: which building stands where, and its garden."""

import numpy as np

from ilnet.towns import buildings, furniture, plants
from ilnet.towns.parts import Part, boxes
from ilnet.towns.site import Site
from ilnet.towns.streets import Street

__all__ = ["Lot", "build_lots"]


class Lot:
    """A frame on the ground: origin on the pavement's inner edge, x along the street, y away from it."""

    def __init__(self, street: Street, along: float, side: int, setback: float):
        """Stand at arc length `along` on the right (side 1) or left (side -1), `setback` metres off the pavement."""
        xy, heading = street.at(np.array([along]), side * (street.half + street.pavement + setback))
        self.origin = xy[0]
        self.yaw = float(heading[0]) + (np.pi if side > 0 else 0.0)

    def world(self, xy: object) -> np.ndarray:
        """Points (N, 2) of the lot's frame in the town's frame."""
        x, y = np.atleast_2d(np.asarray(xy, dtype=np.float64)).T
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        return self.origin + np.column_stack([cos * x - sin * y, sin * x + cos * y])


def _boundary(rng: np.random.Generator) -> tuple[Part, float] | None:
    """A panel to repeat along a garden's edge and its length, or nothing."""
    kind = rng.random()
    if kind < 0.3:
        return furniture.fence(2.4, rng.uniform(0.85, 1.15), rng.uniform(0.14, 0.2)), 2.4
    if kind < 0.5:
        return plants.hedge(rng, 2.0, rng.uniform(0.9, 1.9), rng.uniform(0.6, 0.9)), 2.0
    if kind < 0.65:
        return boxes([0, -0.12, -0.4], [3.0, 0.12, rng.uniform(0.5, 1.1)]), 3.0
    if kind < 0.8:
        return furniture.railing(2.0, rng.uniform(0.9, 1.2)), 2.0
    return None


def _garden(
    site: Site, lot: Lot, width: float, setback: float, depth: float, greens: dict[str, list[Part]], rng
) -> None:
    """Front edge with a gap for the door and the drive, side edges, plants, a place for a car, bins."""
    half = width / 2
    front = -setback + 0.25
    edge = _boundary(rng)
    drive = rng.random() < 0.7
    gap = half - 3.4 if drive else half
    if edge:
        site.run(*edge, lot.world([[-half + 0.1, front], [-0.9, front]]))
        site.run(*edge, lot.world([[0.9, front], [gap, front]]))
    side = _boundary(rng)
    if side:
        site.run(*side, lot.world([[-half, front], [-half, depth + 8]]))
    if drive and setback > 4:
        y = -setback / 2 + rng.uniform(-0.2, 1.5)
        if site.free(lot.world([[half - 1.6, y - 2.2], [half - 1.6, y], [half - 1.6, y + 2.2]]), 0.9):
            site.park(lot.world([half - 1.6, y]), lot.yaw + np.pi / 2 + np.pi * int(rng.integers(0, 2)))
    for _ in range(int(rng.integers(1, 5))):
        spot = lot.world([rng.uniform(-half, half - 3.5), rng.uniform(front + 0.6, -0.6)])
        bush = greens["bush"][int(rng.integers(0, len(greens["bush"])))]
        if setback > 2 and site.ground.edge(spot)[0] > 1.7:
            site.put(bush, spot, rng.uniform(0, 6), rng.uniform(0.6, 1.3))
    for _ in range(int(rng.integers(0, 3))):
        spot = lot.world(
            [rng.uniform(-half, half), rng.choice([rng.uniform(front + 1.5, -1.5), depth + rng.uniform(3, 9)])]
        )
        if setback > 4 and site.free(spot, 3.5):
            trees = greens["conifer" if rng.random() < 0.25 else "small"]
            tree = trees[int(rng.integers(0, len(trees)))]
            site.put(tree, spot, rng.uniform(0, 6), rng.uniform(0.75, 1.15))
    if rng.random() < 0.5:
        spot = lot.world([[half - 0.6, front + 0.5], [half - 1.4, front + 0.6]])
        spot = spot[site.ground.edge(spot) > 0.5]
        site.put(furniture.bin_(True), spot, lot.yaw - np.pi / 2)


def _try(site: Site, lot: Lot, width: float, depth: float, kerb: float) -> bool:
    """Claim the footprint if it is free."""
    points = site.footprint(lot.origin, lot.yaw, width, depth)
    if not site.free(points, kerb):
        return False
    site.claim(points)
    return True


def build_lots(site: Site, street: Street, side: int, greens: dict[str, list[Part]], rng: np.random.Generator) -> None:
    """Fill one side of a street with buildings, after its frontage.

    Args:
        site: where to build.
        street: its `frontage` is "towers", "shops", "rows", "houses" or "open".
        side: 1 right, -1 left.
        greens: prototypes under "bush", "small", "conifer".
        rng: source of the variety.
    """
    style = street.frontage
    kerb = street.pavement - 0.3
    along = rng.uniform(2, 8)
    row_setback = rng.choice([0.0, 1.6, 3.0])
    row: tuple[float, float, int] | None = None
    left_in_row = 0
    while along < street.length - 4:
        if style == "open" and rng.random() < 0.8:
            along += rng.uniform(10, 30)
            continue
        if style == "rows":
            if left_in_row == 0:
                row = (rng.uniform(5.5, 8.5), rng.uniform(8.5, 11), int(rng.integers(2, 4)))
                left_in_row = int(rng.integers(3, 7))
                row_setback = rng.choice([0.0, 1.6, 3.0])
            assert row is not None
            width, depth, floors = row
            setback, space = row_setback, 0.0
        elif style == "shops":
            width, depth, floors = rng.uniform(10, 20), rng.uniform(11, 15), int(rng.integers(2, 6))
            setback, space = rng.choice([0.0, 0.0, 0.6]), rng.choice([0.0, 0.0, 4.0, 12.0])
        elif style == "towers":
            width, depth, floors = rng.uniform(17, 30), rng.uniform(13, 17), int(rng.integers(4, 8))
            setback, space = rng.choice([0.0, 2.0, 5.0]), rng.uniform(5, 24)
            if rng.random() < 0.25:
                width, depth, floors = rng.uniform(17, 22), rng.uniform(16, 20), int(rng.integers(9, 15))
        else:
            width, depth, floors = rng.uniform(8.5, 13), rng.uniform(8, 11), int(rng.integers(1, 3))
            setback, space = rng.uniform(4, 9.5), rng.uniform(5, 11)
        lot = Lot(street, along + width / 2, side, setback)
        if along + width / 2 > street.length or not _try(site, lot, width, depth, kerb):
            along += 2.0
            left_in_row = 0
            continue
        if style == "rows":
            site.put(buildings.house(rng, width, depth, floors, detached=False), lot.origin, lot.yaw)
            left_in_row -= 1
            if setback > 1:
                edge = _boundary(rng)
                if edge:
                    site.run(*edge, lot.world([[-width / 2, -setback + 0.2], [width / 4, -setback + 0.2]]))
            space = rng.uniform(4, 13) if left_in_row == 0 else 0.0
        elif style in ("shops", "towers"):
            ground_floor = rng.choice(["shops", "arcade", "passage", "flats"], p=[0.4, 0.15, 0.15, 0.3])
            roof = "flat" if floors > 5 or rng.random() < 0.5 else "pitched"
            site.put(buildings.block(rng, width, depth, floors, str(ground_floor), roof), lot.origin, lot.yaw)
        else:
            site.put(buildings.house(rng, width, depth, floors, detached=True), lot.origin, lot.yaw)
            _garden(site, lot, width + space, setback, depth, greens, rng)
            if rng.random() < 0.5:
                shed_width, shed_depth = (float(v) for v in rng.uniform(3, 6, 2))
                at = Lot(street, along + width + rng.uniform(1, 3), side, setback + depth + rng.uniform(0, 4))
                if _try(site, at, shed_width, shed_depth, kerb):
                    site.put(buildings.shed(rng, shed_width, shed_depth, rng.uniform(2.3, 3)), at.origin, at.yaw)
        along += width + space
