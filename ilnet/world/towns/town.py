"""A built town as arrays, and the waypoints on its lanes."""

from dataclasses import dataclass

import numpy as np

from ilnet.world.towns.parts import raster
from ilnet.world.towns.streets import Ground

__all__ = ["LIDAR_REACH", "SENSOR_HEIGHT", "WAYPOINT_SPACING", "Town", "lane_waypoints"]

# Distance between two waypoints of a lane [m].
WAYPOINT_SPACING = 1.8
# Height of a car's sensor above the waypoint under it [m].
SENSOR_HEIGHT = 1.8
# Nothing farther than this from a sensor is built or drawn [m]; a LiDAR of 80 m does not see it.
LIDAR_REACH = 85.0


@dataclass(frozen=True)
class Town:
    """A town's mesh, the waypoints on its lanes, and the spots where cars and people may be.

    In the town's frame x points east, y north and z up. The mesh holds only what stands still;
    `ilnet.world.towns.traffic` draws vehicles and people for each scan.

    Attributes:
        name: Name of its plan.
        seed: Which of the towns of that plan this is.
        vertices: (V, 3) float32, metres.
        triangles: (F, 3) int32 numbers of vertices.
        waypoints: (N, 3) float32 points on the lanes, `WAYPOINT_SPACING` apart, metres.
        headings: (N,) float32 driving directions, rad counter-clockwise from +x.
        parking: (P, 4) float32 spots where a car may stand: x, y, z [m] and heading [rad].
        walks: (Q, 4) float32 spots where a person or a bicycle may be: x, y, z [m] and heading [rad].
        poles: (R, 2) int32, for each lamp, sign, traffic light, bollard and power pole the number of its first triangle
            and that after its last.
    """

    name: str
    seed: int
    vertices: np.ndarray
    triangles: np.ndarray
    waypoints: np.ndarray
    headings: np.ndarray
    parking: np.ndarray
    walks: np.ndarray
    poles: np.ndarray


def lane_waypoints(ground: Ground) -> tuple[np.ndarray, np.ndarray]:
    """Returns the waypoints (N, 3) float32 [m] of all lanes and their headings (N,) float32 [rad]."""
    points, headings = [], []
    for street in ground.streets:
        for lane in street.lanes:
            for way in street.ways:
                s = np.arange(1.0 + street.tails[0], street.length - 1.0 - street.tails[1], 0.1)
                xy, heading = street.at(s, way * lane)
                # Steps are even along the lane itself; in a bend it is longer or shorter than the centreline.
                driven = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
                s = np.interp(np.arange(0, driven[-1], WAYPOINT_SPACING), driven, s)[::way]
                xy, heading = street.at(s, way * lane)
                clear = ground.kerb_distance(xy) < -1.2
                points.append(np.column_stack([xy, ground.height(xy)])[clear])
                headings.append((heading if way > 0 else heading + np.pi)[clear])
    turned = np.mod(np.concatenate(headings) + np.pi, 2 * np.pi) - np.pi
    return raster(np.concatenate(points)), raster(turned)
