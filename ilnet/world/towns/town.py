"""What a built town is, and the lanes to drive through it."""

from dataclasses import dataclass

import numpy as np

from ilnet.world.towns.parts import raster
from ilnet.world.towns.streets import Ground

__all__ = ["Town", "lanes"]

_STEP = 1.8


@dataclass(frozen=True)
class Town:
    """A town's mesh, the lanes through it and the places for what moves, x east, y north, z up.

    The mesh holds what stands; `ilnet.world.towns.traffic` adds vehicles and people, anew for each scan.

    Attributes:
        name: which plan it follows.
        seed: which town of that plan.
        vertices: (V, 3) float32, metres.
        triangles: (F, 3) int32.
        waypoints: (N, 3) float32 points on the lanes, 1.8 m apart, metres.
        headings: (N,) float32 driving direction, rad counter-clockwise from +x.
        parking: (P, 4) float32 places where a car may stand: x, y, z [m] and heading [rad].
        walks: (Q, 4) float32 places where somebody may walk or stand, or a bicycle: x, y, z [m] and heading [rad].
    """

    name: str
    seed: int
    vertices: np.ndarray
    triangles: np.ndarray
    waypoints: np.ndarray
    headings: np.ndarray
    parking: np.ndarray
    walks: np.ndarray


def lanes(ground: Ground) -> tuple[np.ndarray, np.ndarray]:
    """Waypoints (N, 3) float32 [m] and headings (N,) float32 [rad] of all lanes."""
    points, headings = [], []
    for street in ground.streets:
        for lane in street.lanes:
            for way in street.ways:
                s = np.arange(1.0 + street.tails[0], street.length - 1.0 - street.tails[1], 0.1)
                xy, heading = street.at(s, way * lane)
                # even steps along the lane itself, which is longer or shorter than the centreline in a bend
                driven = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
                s = np.interp(np.arange(0, driven[-1], _STEP), driven, s)[::way]
                xy, heading = street.at(s, way * lane)
                clear = ground.edge(xy) < -1.2
                points.append(np.column_stack([xy, ground.height(xy)])[clear])
                headings.append((heading if way > 0 else heading + np.pi)[clear])
    turned = np.mod(np.concatenate(headings) + np.pi, 2 * np.pi) - np.pi
    return raster(np.concatenate(points)), raster(turned)
