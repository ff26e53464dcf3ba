"""What a built town is, and the lanes to drive through it."""

from dataclasses import dataclass

import numpy as np

from ilnet.towns.streets import Ground

__all__ = ["Town", "lanes"]

_STEP = 1.8
_TRAFFIC_GAP = 4.0


@dataclass(frozen=True)
class Town:
    """A town's mesh and the lanes through it, x east, y north, z up.

    Attributes:
        name: which plan it follows.
        seed: which town of that plan.
        vertices: (V, 3) float32, metres.
        triangles: (F, 3) int32.
        waypoints: (N, 3) float32 points on the lanes, 1.8 m apart, metres.
        headings: (N,) float32 driving direction, rad counter-clockwise from +x.
    """

    name: str
    seed: int
    vertices: np.ndarray
    triangles: np.ndarray
    waypoints: np.ndarray
    headings: np.ndarray


def lanes(ground: Ground, traffic: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Waypoints (N, 3) float32 [m] and headings (N,) float32 [rad] of all lanes.

    Args:
        ground: the streets.
        traffic: (M, 2) centres of vehicles standing in lanes, metres; no waypoint lies within 4 m of them.
    """
    points, headings = [], []
    for street in ground.streets:
        for lane in street.lanes:
            for way in (1, -1):
                s = np.arange(1.0, street.length - 1.0, 0.1)
                xy, heading = street.at(s, way * lane)
                # even steps along the lane itself, which is longer or shorter than the centreline in a bend
                driven = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
                s = np.interp(np.arange(0, driven[-1], _STEP), driven, s)[::way]
                xy, heading = street.at(s, way * lane)
                clear = ground.edge(xy) < -1.2
                if len(traffic):
                    clear &= np.linalg.norm(xy[:, None] - traffic, axis=-1).min(1) > _TRAFFIC_GAP
                points.append(np.column_stack([xy, ground.height(xy)])[clear])
                headings.append((heading if way > 0 else heading + np.pi)[clear])
    turned = np.mod(np.concatenate(headings) + np.pi, 2 * np.pi) - np.pi
    return (np.round(np.concatenate(points) * 1024) / 1024).astype(np.float32), turned.astype(np.float32)
