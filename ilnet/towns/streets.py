"""Streets as centrelines, and the ground under the whole town: carriageways, kerbs, lots and fields."""

from dataclasses import dataclass

import numpy as np

from ilnet.towns.parts import Part, merge

__all__ = ["KERB", "Ground", "Street", "spline"]

KERB = 0.12
_CELL = 4  # coarse ground cell [m]; the kerb is cut on a 1 m grid nested in it
_FAR = 18.0  # distances to the kerb are kept up to here [m]
_CORNER = 6.0  # blend of two kerb lines [m]; about a 5 m corner radius


def spline(points: np.ndarray, spacing: float = 2.0) -> np.ndarray:
    """A Catmull-Rom curve through points (N, 2), resampled to even steps of about `spacing` metres."""
    points = np.asarray(points, dtype=np.float64)
    ends = np.concatenate([2 * points[:1] - points[1:2], points, 2 * points[-1:] - points[-2:-1]])
    p0, p1, p2, p3 = (ends[i : len(ends) - 3 + i, None] for i in range(4))
    t = np.linspace(0, 1, 64, endpoint=False)[None, :, None]
    curve = p1 + 0.5 * t * (p2 - p0 + t * (2 * p0 - 5 * p1 + 4 * p2 - p3 + t * (3 * (p1 - p2) + p3 - p0)))
    dense = np.concatenate([curve.reshape(-1, 2), points[-1:]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))])
    even = np.linspace(0, along[-1], max(2, round(along[-1] / spacing) + 1))
    return np.stack([np.interp(even, along, dense[:, k]) for k in range(2)], axis=1)


@dataclass(frozen=True)
class Street:
    """One street: its centreline and its cross-section.

    Attributes:
        line: (N, 2) centreline at even steps, metres.
        half: from the centreline to the kerb, metres.
        lanes: lane centres to the right of the centreline, metres; the other direction mirrors them.
        frontage: what stands along it, a key the town gives meaning to.
        pavement: width of the pavement, metres.
        parking: whether cars park along the kerb.
        median: half the width of a raised median, metres; 0 is none.
    """

    line: np.ndarray
    half: float
    lanes: tuple[float, ...]
    frontage: str
    pavement: float = 2.2
    parking: bool = True
    median: float = 0.0

    @property
    def length(self) -> float:
        """Length of the centreline, metres."""
        return float(np.linalg.norm(np.diff(self.line, axis=0), axis=1).sum())

    def at(self, along: np.ndarray, right: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """Points (M, 2) at arc length `along`, `right` metres to the right, and the street's heading there (M,) rad."""
        s = np.linspace(0, self.length, len(self.line))
        along = np.atleast_1d(np.asarray(along, dtype=np.float64))
        tangent = np.gradient(self.line, axis=0)
        centre = np.stack([np.interp(along, s, self.line[:, k]) for k in range(2)], axis=1)
        direction = np.stack([np.interp(along, s, tangent[:, k]) for k in range(2)], axis=1)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        normal = np.stack([direction[:, 1], -direction[:, 0]], axis=1)
        offset = np.broadcast_to(np.asarray(right, dtype=np.float64), along.shape)[:, None]
        return centre + offset * normal, np.arctan2(direction[:, 1], direction[:, 0])


def _segment_distance(xy: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Distance of points (N, 2) from a polyline (M, 2), metres."""
    a, ab = line[:-1], np.diff(line, axis=0)
    t = ((xy[:, None] - a) * ab).sum(-1) / (ab**2).sum(-1)
    gap = xy[:, None] - a - np.clip(t, 0, 1)[..., None] * ab
    return np.sqrt((gap**2).sum(-1).min(axis=1))


def _grid(count: int) -> np.ndarray:
    """All index pairs (count², 2) below count."""
    return np.argwhere(np.ones((count, count), dtype=bool))


class Ground:
    """Rolling ground with the streets cut into it.

    The height is linear on the triangles of a lattice, so `height` is exactly the surface of the mesh.
    """

    def __init__(self, streets: list[Street], extent: float, rng: np.random.Generator):
        """Lay the streets on ground that covers [-extent, extent]² metres."""
        self.streets = streets
        self.extent = int(np.ceil(extent / (2 * _CELL))) * 2 * _CELL
        self._edge = self._distance_raster()
        axis = np.arange(-self.extent, self.extent + 1, _CELL, dtype=np.float64)
        x, y = np.meshgrid(axis, axis, indexing="ij")
        lattice = np.zeros_like(x)
        for _ in range(7):
            length, turn, phase = rng.uniform(140, 420), rng.uniform(0, np.pi), rng.uniform(0, 2 * np.pi)
            k = 2 * np.pi / length
            lattice += length * np.sin(k * (np.cos(turn) * x + np.sin(turn) * y) + phase)
        slope = np.hypot(*np.gradient(lattice, _CELL))
        lattice *= rng.uniform(0.05, 0.06) / slope.max()
        rough = np.clip((self._edge[::_CELL, ::_CELL] - 10) / 10, 0, 1)  # lawns and fields are not ironed
        lattice += 0.05 * rough * rng.standard_normal(lattice.shape)
        # far from streets every second node lies on the line between its neighbours: larger cells fit there exactly
        far = self._edge[::_CELL, ::_CELL] >= _FAR
        between = lattice.copy()
        between[1::2, ::2] = 0.5 * (lattice[:-1:2, ::2] + lattice[2::2, ::2])
        between[::2, 1::2] = 0.5 * (lattice[::2, :-1:2] + lattice[::2, 2::2])
        between[1::2, 1::2] = 0.5 * (lattice[:-1:2, :-1:2] + lattice[2::2, 2::2])
        self._lattice = np.where(far, between, lattice)

    def _distance_raster(self) -> np.ndarray:
        """Signed distance to the kerb on a 1 m grid, negative on carriageways, cut off at _FAR."""
        n = 2 * self.extent + 1
        fields = []
        for number, street in enumerate(self.streets):
            # apart from each other, so that no two meet in the blend out there
            field = np.full((n, n), 100.0 * (1 + number))
            for i in range(0, len(street.line) - 1, 10):
                line = street.line[i : i + 11]
                low = np.floor(line.min(0) - _FAR - street.half).astype(int) + self.extent
                high = np.ceil(line.max(0) + _FAR + street.half).astype(int) + self.extent + 1
                low, high = np.maximum(low, 0), np.minimum(high, n)
                x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]), indexing="ij")
                xy = np.stack([x.ravel(), y.ravel()], axis=1) - float(self.extent)
                window = field[low[0] : high[0], low[1] : high[1]]
                np.minimum(window, _segment_distance(xy, line).reshape(x.shape), out=window)
            fields.append(field - street.half)
        edge = fields[0]
        for field in fields[1:]:
            blend = np.maximum(_CORNER - np.abs(edge - field), 0)
            edge = np.minimum(edge, field) - blend**2 / (4 * _CORNER)
        for street, field in zip(self.streets, fields, strict=True):
            if street.median:
                others = np.min([f for f in fields if f is not field], axis=0)
                edge = np.maximum(edge, -np.maximum(field + street.half - street.median, 5.0 - others))
        return np.minimum(edge, _FAR)

    def edge(self, xy: np.ndarray) -> np.ndarray:
        """Signed distance (N,) of points (N, 2) from the kerb, metres: negative on a carriageway, at most 18."""
        return self._bilinear(self._edge, np.asarray(xy, dtype=np.float64) + self.extent)

    @staticmethod
    def _bilinear(raster: np.ndarray, at: np.ndarray) -> np.ndarray:
        low = np.clip(np.floor(at).astype(int), 0, np.array(raster.shape) - 2)
        u, v = (np.clip(at - low, 0, 1)).T
        i, j = low.T
        return (raster[i, j] * (1 - u) + raster[i + 1, j] * u) * (1 - v) + (
            raster[i, j + 1] * (1 - u) + raster[i + 1, j + 1] * u
        ) * v

    def height(self, xy: np.ndarray) -> np.ndarray:
        """Height (N,) of the carriageway level at points (N, 2), metres; pavements and lots lie KERB above it."""
        at = (np.asarray(xy, dtype=np.float64) + self.extent) / _CELL
        low = np.clip(np.floor(at).astype(int), 0, np.array(self._lattice.shape) - 2)
        u, v = (at - low).T
        i, j = low.T
        z = self._lattice
        a, b, c, d = z[i, j], z[i + 1, j], z[i + 1, j + 1], z[i, j + 1]
        return np.where(u > v, a + u * (b - a) + v * (c - b), a + v * (d - a) + u * (c - d))

    def surface(self, xy: np.ndarray) -> np.ndarray:
        """Points (N, 3) on top of whatever ground lies at (N, 2): carriageway, pavement or lot."""
        xy = np.asarray(xy, dtype=np.float64)
        return np.column_stack([xy, self.height(xy) + KERB * (self.edge(xy) > 0)])

    def mesh(self) -> Part:
        """The ground as triangles, closed, with upright kerbs."""
        n = (len(self._lattice) - 1) // 2
        negative = self._edge < 0
        parts = []
        size = 2 * _CELL
        cells = _grid(n) * size
        while size > 1:  # halve the cells whose nodes lie on both sides of the kerb
            nodes = cells[:, None] + _grid(size + 1)
            below = negative[nodes[..., 0], nodes[..., 1]]
            every = below.all(1)
            cut = below.any(1) & ~every
            if size > _CELL:
                cut = (self._edge[nodes[..., 0], nodes[..., 1]] < _FAR).any(1)
            parts.append(self._lift(self._cell_triangles(cells[~cut], size), np.repeat(every[~cut], 2)))
            size //= 2
            cells = (cells[cut, None] + size * _grid(2)).reshape(-1, 2)
        parts += self._cut(self._cell_triangles(cells, 1))
        # a second floor below catches the rare ray that slips through the seam of two cell sizes
        sunk = self._cell_triangles(_grid(n // 2) * 4 * _CELL, 4 * _CELL)
        floor = self._lift(sunk, np.ones(len(sunk), bool))
        parts.append(Part(floor.vertices - (0, 0, 1.5), floor.triangles))
        return merge(parts)

    @staticmethod
    def _cell_triangles(cells: np.ndarray, size: int) -> np.ndarray:
        """Both halves (2N, 3, 2) of square cells, as node indices of the 1 m grid."""
        a, b, c, d = (cells + np.array(step) * size for step in ((0, 0), (1, 0), (1, 1), (0, 1)))
        return np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], 1).reshape(-1, 3, 2)

    def _lift(self, nodes: np.ndarray, road: np.ndarray) -> Part:
        """Triangles of nodes (N, 3, 2), on the carriageway where road (N,), else KERB above it."""
        xy = nodes.reshape(-1, 2) - float(self.extent)
        z = self.height(xy) + KERB * np.repeat(~road, 3)
        return Part(np.column_stack([xy, z]), np.arange(len(xy)).reshape(-1, 3))

    def _cut(self, nodes: np.ndarray) -> list[Part]:
        """Triangles of nodes (N, 3, 2) split along the kerb, and the kerb's face."""
        value = self._edge[nodes[..., 0], nodes[..., 1]]
        below = value < 0
        count = below.sum(1)
        parts = [self._lift(nodes[count == 3], np.ones((count == 3).sum(), bool))]
        parts.append(self._lift(nodes[count == 0], np.zeros((count == 0).sum(), bool)))
        for road_tip in (True, False):
            pick = count == (1 if road_tip else 2)
            tri, val = nodes[pick], value[pick]
            tip = np.argmax(below[pick] == road_tip, axis=1)
            order = (tip[:, None] + np.arange(3)) % 3
            p = np.take_along_axis(tri, order[..., None], 1) - float(self.extent)
            val = np.take_along_axis(val, order, 1)
            q1 = p[:, 0] + (val[:, 0] / (val[:, 0] - val[:, 1]))[:, None] * (p[:, 1] - p[:, 0])
            q2 = p[:, 0] + (val[:, 0] / (val[:, 0] - val[:, 2]))[:, None] * (p[:, 2] - p[:, 0])
            polygon = np.stack([p[:, 0], q1, q2, p[:, 1], p[:, 2]], 1)
            z = self.height(polygon.reshape(-1, 2)).reshape(-1, 5, 1)
            low, high = np.concatenate([polygon, z], -1), np.concatenate([polygon, z + KERB], -1)
            tip_side, base_side = (low, high) if road_tip else (high, low)
            every = np.concatenate([tip_side, base_side], axis=1)
            faces = np.array([[0, 1, 2], [6, 8, 9], [6, 9, 7], [1, 2, 7], [1, 7, 6]])
            start = 10 * np.arange(len(every))[:, None, None]
            parts.append(Part(every.reshape(-1, 3), (faces + start).reshape(-1, 3)))
        return parts
