"""The building site: ground plus whatever has been set on it, with a record of the space taken."""

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from ilnet.world.towns.parts import Part, merge, place, raster
from ilnet.world.towns.streets import Ground
from ilnet.world.towns.town import Town, lanes

__all__ = ["Site"]


class Site:
    """Sets parts on a ground and collects the mesh."""

    def __init__(self, ground: Ground):
        """Start with the bare ground."""
        self.ground = ground
        self._parts = [ground.mesh()]
        self._taken = np.zeros((2 * ground.extent + 1,) * 2, dtype=bool)
        self._parking: list[np.ndarray] = []
        self._walks: list[np.ndarray] = []

    def put(self, part: Part, xy: ArrayLike, yaw: ArrayLike = 0.0, scale: ArrayLike = 1.0) -> None:
        """Set a part on the ground at each of xy (N, 2) or (2,); yaw in rad, scale as in `place`."""
        xy = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
        if len(xy):
            self._parts.append(place(part, self.ground.surface(xy), yaw, scale))

    def put_at(self, part: Part, position: ArrayLike, yaw: ArrayLike = 0.0) -> None:
        """Set a part at positions (N, 3) or (3,), whatever the ground."""
        self._parts.append(place(part, position, yaw))

    def park(self, xy: ArrayLike, heading: ArrayLike) -> None:
        """Offer places at xy (N, 2) or (2,) where a car may stand, and claim them; heading in rad."""
        spots = self._spots(xy, heading)
        self._parking.append(spots)
        for along in (-2.0, -1.0, 0.0, 1.0, 2.0):
            self.claim(spots[:, :2] + along * np.column_stack([np.cos(spots[:, 3]), np.sin(spots[:, 3])]))

    def walk(self, xy: ArrayLike, heading: ArrayLike) -> None:
        """Offer places at xy (N, 2) or (2,) where somebody may walk or stand; heading in rad."""
        self._walks.append(self._spots(xy, heading))

    def _spots(self, xy: ArrayLike, heading: ArrayLike) -> np.ndarray:
        """Rows (N, 4) of x, y, z and heading on the ground."""
        position = self.ground.surface(np.asarray(xy, dtype=np.float64).reshape(-1, 2))
        return np.column_stack([position, np.broadcast_to(heading, len(position))])

    def run(self, panel: Part, panel_length: float, path: ArrayLike, kerb: float = 0.9) -> None:
        """Repeat a panel that runs along +x from its origin along a path (N, 2), `kerb` metres off the carriageways."""
        path = np.asarray(path, dtype=np.float64)
        for start, end in pairwise(path):
            length = np.hypot(*(end - start))
            if length < 0.5:
                continue
            count = max(1, round(length / panel_length))
            at = start + (end - start) * (np.arange(count) / count)[:, None]
            stretch = np.array([length / count / panel_length, 1.0, 1.0])
            middle = at + (end - start) / (2 * count)
            clear = self.ground.edge(middle) > kerb
            position = np.column_stack([at, self.ground.surface(middle)[:, 2]])[clear]
            if len(position):
                yaw = np.arctan2(*(end - start)[::-1])
                self._parts.append(place(panel, position, yaw, np.broadcast_to(stretch, position.shape)))

    def footprint(self, xy: np.ndarray, yaw: float, width: float, depth: float) -> np.ndarray:
        """Points (N, 2) about 0.7 m apart inside a rectangle whose front, centred on xy, faces -y before the turn."""
        u = np.linspace(-width / 2 + 0.5, width / 2 - 0.5, max(2, int(width / 0.7)))
        v = np.linspace(0.3, depth - 0.3, max(2, int(depth / 0.7)))
        u, v = (a.ravel() for a in np.meshgrid(u, v))
        return xy + np.column_stack([np.cos(yaw) * u - np.sin(yaw) * v, np.sin(yaw) * u + np.cos(yaw) * v])

    def free(self, points: np.ndarray, kerb: float) -> bool:
        """Whether nothing stands at any of points (N, 2) and all are at least `kerb` metres from a carriageway."""
        inside = np.abs(points).max() < self.ground.extent - 2
        return bool(inside and self.ground.edge(points).min() > kerb and not self.taken(points).any())

    def taken(self, points: np.ndarray) -> np.ndarray:
        """Whether something was claimed at points (N, 2)."""
        i, j = np.clip(np.round(points).astype(int) + self.ground.extent, 0, len(self._taken) - 1).T
        return self._taken[i, j]

    def in_sight(self, points: np.ndarray) -> np.ndarray:
        """Whether points (N, 2) are within a LiDAR's reach of some street."""
        road = np.concatenate([street.core[::5] for street in self.ground.streets])
        return np.linalg.norm(points[:, None] - road, axis=-1).min(1) < 85

    def claim(self, points: np.ndarray) -> None:
        """Mark points (N, 2) as taken."""
        i, j = np.clip(np.round(points).astype(int) + self.ground.extent, 0, len(self._taken) - 1).T
        self._taken[i, j] = True

    def town(self, name: str, seed: int, count: int) -> Town:
        """Returns what has been built, with at most `count` waypoints."""
        vertices, triangles = self._mesh()
        waypoints, headings = lanes(self.ground)
        room = self._room(waypoints, vertices)
        waypoints, headings = waypoints[room], headings[room]
        parking, walks = (raster(np.concatenate([np.zeros((0, 4)), *spots])) for spots in (self._parking, self._walks))
        return Town(name, seed, vertices, triangles, waypoints[:count], headings[:count], parking, walks)

    def _room(self, waypoints: np.ndarray, vertices: np.ndarray) -> np.ndarray:
        """Whether nothing hangs over the lane, a bough say, within 1.3 m of where a car carries its sensor; (N,)."""
        vertices = vertices[np.abs(vertices[:, :2]).max(1) < self.ground.extent]
        rise = vertices[:, 2] - self.ground.height(vertices[:, :2])
        vertices = vertices[(rise > 0.4) & (rise < 3.2)]
        vertices = vertices[self.ground.edge(vertices[:, :2]) < 0.2]
        sensors = waypoints + np.array([0, 0, 1.8], dtype=np.float32)
        nearest = [((vertices - at) ** 2).sum(1).min(initial=9.0) for at in sensors]
        return np.array(nearest) > 1.3**2

    def _mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (V, 3) float32 on a 1/1024 m raster and triangles (F, 3) int32 without slivers."""
        whole = merge(self._parts)
        vertices = raster(whole.vertices)
        a, b, c = (vertices[whole.triangles[:, k]].astype(np.float64) for k in range(3))
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        return vertices, whole.triangles[area > 1e-6].astype(np.int32)
