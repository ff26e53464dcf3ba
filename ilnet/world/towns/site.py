"""The building site: collects the mesh of a town, the spots for cars and people, and which space is taken."""

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from ilnet.world.towns.parts import Panel, Part, merge, place, raster
from ilnet.world.towns.streets import Ground
from ilnet.world.towns.town import LIDAR_REACH, SENSOR_HEIGHT, Town, lane_waypoints

__all__ = ["Site"]


class Site:
    """Sets parts on the ground and remembers where something stands.

    Which space is taken is kept on a raster of 1 m. `put` does not mark it; `claim` and `park` do.
    """

    def __init__(self, ground: Ground):
        """Starts with the bare ground."""
        self.ground = ground
        self._parts = [ground.mesh()]
        self._poles: list[tuple[int, int]] = []  # each a part with copies of one pole, and their number
        self._taken = np.zeros((2 * ground.extent + 1,) * 2, dtype=bool)
        self._parking: list[np.ndarray] = []
        self._walks: list[np.ndarray] = []

    def put(self, part: Part, xy: ArrayLike, yaw: ArrayLike = 0.0, scale: ArrayLike = 1.0) -> None:
        """Sets copies of a part on the ground.

        Args:
            part: What to set.
            xy: (2,) or (N, 2), metres.
            yaw: Scalar or (N,), rad counter-clockwise.
            scale: Scalar, (N,), or (N, 3) along the part's own axes.
        """
        xy = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
        if len(xy):
            if part.is_pole:
                self._poles.append((len(self._parts), len(xy)))
            self._parts.append(place(part, self.ground.surface(xy), yaw, scale))

    def put_at(self, part: Part, position: ArrayLike, yaw: ArrayLike = 0.0) -> None:
        """Sets copies of a part at positions (3,) or (N, 3) [m], independent of the ground; yaw (N,) in rad."""
        self._parts.append(place(part, position, yaw))

    def park(self, xy: ArrayLike, heading: ArrayLike) -> None:
        """Adds spots for cars at xy (2,) or (N, 2) [m], and marks the ground there as taken; heading in rad."""
        spots = self._spots(xy, heading)
        self._parking.append(spots)
        for along in (-2.0, -1.0, 0.0, 1.0, 2.0):
            self.claim(spots[:, :2] + along * np.column_stack([np.cos(spots[:, 3]), np.sin(spots[:, 3])]))

    def walk(self, xy: ArrayLike, heading: ArrayLike) -> None:
        """Adds spots for people and bicycles at xy (2,) or (N, 2) [m]; heading in rad."""
        self._walks.append(self._spots(xy, heading))

    def _spots(self, xy: ArrayLike, heading: ArrayLike) -> np.ndarray:
        """Returns spots (N, 4) on the ground: x, y, z [m] and heading [rad]."""
        position = self.ground.surface(np.asarray(xy, dtype=np.float64).reshape(-1, 2))
        return np.column_stack([position, np.broadcast_to(heading, len(position))])

    def run(self, panel: Panel, path: ArrayLike, clearance: float = 0.9) -> None:
        """Repeats a panel along a path; each piece is stretched a little so that a whole number fits.

        Args:
            panel: What to repeat.
            path: (N, 2) corners of the path, metres.
            clearance: Pieces closer than this to a carriageway are left out, metres.
        """
        path = np.asarray(path, dtype=np.float64)
        for start, end in pairwise(path):
            length = np.hypot(*(end - start))
            if length < 0.5:
                continue
            count = max(1, round(length / panel.length))
            at = start + (end - start) * (np.arange(count) / count)[:, None]
            stretch = np.array([length / count / panel.length, 1.0, 1.0])
            middle = at + (end - start) / (2 * count)
            clear = self.ground.kerb_distance(middle) > clearance
            position = np.column_stack([at, self.ground.surface(middle)[:, 2]])[clear]
            if len(position):
                yaw = np.arctan2(*(end - start)[::-1])
                self._parts.append(place(panel.part, position, yaw, np.broadcast_to(stretch, position.shape)))

    def footprint(self, xy: np.ndarray, yaw: float, width: float, depth: float) -> np.ndarray:
        """Returns points (N, 2) [m] about 0.7 m apart inside a rectangle on the ground.

        Args:
            xy: (2,) middle of the rectangle's front, metres.
            yaw: Turn of the rectangle, rad counter-clockwise; at 0 its front faces -y.
            width: Length of the front, metres.
            depth: From the front to the back, metres.
        """
        u = np.linspace(-width / 2 + 0.5, width / 2 - 0.5, max(2, int(width / 0.7)))
        v = np.linspace(0.3, depth - 0.3, max(2, int(depth / 0.7)))
        u, v = (a.ravel() for a in np.meshgrid(u, v))
        return xy + np.column_stack([np.cos(yaw) * u - np.sin(yaw) * v, np.sin(yaw) * u + np.cos(yaw) * v])

    def free(self, points: np.ndarray, clearance: float) -> bool:
        """Returns whether all points (N, 2) [m] are not taken and more than `clearance` metres from a carriageway."""
        inside = np.abs(points).max() < self.ground.extent - 2
        return bool(inside and self.ground.kerb_distance(points).min() > clearance and not self.taken(points).any())

    def taken(self, points: np.ndarray) -> np.ndarray:
        """Returns at which of points (N, 2) [m] the ground is taken, as (N,) bool."""
        i, j = np.clip(np.round(points).astype(int) + self.ground.extent, 0, len(self._taken) - 1).T
        return self._taken[i, j]

    def in_sight(self, points: np.ndarray) -> np.ndarray:
        """Returns which of points (N, 2) [m] are within a LiDAR's reach of a street, as (N,) bool."""
        road = np.concatenate([street.line_in_town[::5] for street in self.ground.streets])
        return np.linalg.norm(points[:, None] - road, axis=-1).min(1) < LIDAR_REACH

    def claim(self, points: np.ndarray) -> None:
        """Marks the ground at points (N, 2) [m] as taken."""
        i, j = np.clip(np.round(points).astype(int) + self.ground.extent, 0, len(self._taken) - 1).T
        self._taken[i, j] = True

    def town(self, name: str, seed: int, count: int) -> Town:
        """Returns what has been built, with at most `count` waypoints, as the town of this name and seed."""
        vertices, triangles, poles = self._mesh()
        waypoints, headings = lane_waypoints(self.ground)
        room = self._have_room(waypoints, vertices)
        waypoints, headings = waypoints[room], headings[room]
        parking, walks = (raster(np.concatenate([np.zeros((0, 4)), *spots])) for spots in (self._parking, self._walks))
        return Town(name, seed, vertices, triangles, waypoints[:count], headings[:count], parking, walks, poles)

    def _have_room(self, waypoints: np.ndarray, vertices: np.ndarray) -> np.ndarray:
        """Returns above which waypoints a sensor has 1.3 m of room, as (N,) bool; a bough may hang over the lane."""
        vertices = vertices[np.abs(vertices[:, :2]).max(1) < self.ground.extent]
        rise = vertices[:, 2] - self.ground.height(vertices[:, :2])
        vertices = vertices[(rise > 0.4) & (rise < 3.2)]
        vertices = vertices[self.ground.kerb_distance(vertices[:, :2]) < 0.2]
        sensors = waypoints + np.array([0, 0, SENSOR_HEIGHT], dtype=np.float32)
        nearest = [((vertices - at) ** 2).sum(1).min(initial=9.0) for at in sensors]
        return np.array(nearest) > 1.3**2

    def _mesh(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns vertices (V, 3) float32 [m] on the raster, triangles (F, 3) int32 without slivers, and the poles."""
        whole = merge(self._parts)
        vertices = raster(whole.vertices)
        a, b, c = (vertices[whole.triangles[:, k]].astype(np.float64) for k in range(3))
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        kept = area > 1e-6
        starts = np.cumsum([0, *[len(part.triangles) for part in self._parts]])
        ends = [np.linspace(starts[k], starts[k + 1], count + 1, dtype=int) for k, count in self._poles]
        spans = np.concatenate([np.zeros((0, 2), int), *[np.stack([e[:-1], e[1:]], 1) for e in ends]])
        poles = np.append(0, np.cumsum(kept))[spans].astype(np.int32)
        return vertices, whole.triangles[kept].astype(np.int32), poles
