"""Streets as centrelines, and the ground of the whole town: carriageways, kerbs, lots and fields."""

from dataclasses import dataclass, replace

import numpy as np

from ilnet.world.towns.parts import Part, merge

__all__ = ["KERB_HEIGHT", "Draft", "Ground", "Street", "inside"]

KERB_HEIGHT = 0.12
_CELL = 4  # Side of a coarse cell of the ground [m]. The kerb is cut on a grid of 1 m nested in it.
_FAR = 18.0  # Largest distance from the kerb that is kept [m].
_SPACING = 2.0  # Distance between the points of a centreline [m].
_TAIL = 150.0  # A street that leaves the town goes on so much longer, beyond a LiDAR's reach [m].
_CORNER = 6.0  # Where two kerb lines meet, they blend over this distance [m]; the corner's radius is about 5 m.


def _spline(points: np.ndarray, closed: bool = False) -> np.ndarray:
    """Returns a Catmull-Rom curve through points (N, 2) [m], resampled to even steps of about `_SPACING`."""
    before, after = 2 * points[:1] - points[1:2], 2 * points[-1:] - points[-2:-1]
    if closed:
        before, after = points[-2:-1], points[1:2]
    ends = np.concatenate([before, points, after])
    p0, p1, p2, p3 = (ends[i : len(ends) - 3 + i, None] for i in range(4))
    t = np.linspace(0, 1, 64, endpoint=False)[None, :, None]
    curve = p1 + 0.5 * t * (p2 - p0 + t * (2 * p0 - 5 * p1 + 4 * p2 - p3 + t * (3 * (p1 - p2) + p3 - p0)))
    dense = np.concatenate([curve.reshape(-1, 2), points[-1:]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))])
    even = np.linspace(0, along[-1], max(2, round(along[-1] / _SPACING) + 1))
    return np.stack([np.interp(even, along, dense[:, k]) for k in range(2)], axis=1)


@dataclass(frozen=True)
class Street:
    """One street: its centreline and its cross-section.

    Attributes:
        line: (N, 2) centreline at even steps, metres.
        half_width: Distance from the centreline to the kerb, metres.
        lanes: Lane centres as distances to the right of the centreline, metres. The other direction mirrors them.
        frontage: The kind of buildings along it: a key of the styles in `frontage.py`, or another word for none.
        pavement: Width of the pavement, metres.
        parking: Whether cars park along the kerb.
        median: Half the width of a raised median, metres; 0 for no median.
        oneway: Whether all lanes run along the line. Lanes may then lie to the left of it (negative).
        sides: The sides that have buildings and furniture: 1 is right, -1 is left.
        tails: Lengths at the start and at the end of the line that lead out of the town, metres. They are road without
            waypoints or lots.
    """

    line: np.ndarray
    half_width: float
    lanes: tuple[float, ...]
    frontage: str
    pavement: float = 2.2
    parking: bool = True
    median: float = 0.0
    oneway: bool = False
    sides: tuple[int, ...] = (1, -1)
    tails: tuple[float, float] = (0.0, 0.0)

    @property
    def ways(self) -> tuple[int, ...]:
        """The directions of travel: 1 along the line, -1 against it."""
        return (1,) if self.oneway else (1, -1)

    @property
    def line_in_town(self) -> np.ndarray:
        """The centreline (M, 2) without its tails, metres."""
        first, last = (round(t / _SPACING) for t in self.tails)
        return self.line[first : len(self.line) - last]

    @property
    def length(self) -> float:
        """The length of the centreline with its tails, metres."""
        return float(np.linalg.norm(np.diff(self.line, axis=0), axis=1).sum())

    def at(self, along: np.ndarray, right: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """Returns points beside the centreline and the street's headings there.

        Args:
            along: Scalar or (M,) arc lengths from the start of the line, metres.
            right: Scalar or (M,) distances to the right of the centreline, metres.

        Returns:
            Points (M, 2) [m] and headings (M,) [rad counter-clockwise from +x].
        """
        s = np.linspace(0, self.length, len(self.line))
        along = np.atleast_1d(np.asarray(along, dtype=np.float64))
        tangent = np.gradient(self.line, axis=0)
        centre = np.stack([np.interp(along, s, self.line[:, k]) for k in range(2)], axis=1)
        direction = np.stack([np.interp(along, s, tangent[:, k]) for k in range(2)], axis=1)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        normal = np.stack([direction[:, 1], -direction[:, 0]], axis=1)
        offset = np.broadcast_to(np.asarray(right, dtype=np.float64), along.shape)[:, None]
        return centre + offset * normal, np.arctan2(direction[:, 1], direction[:, 0])


class Draft:
    """Draws the centrelines of a plan.

    Each line strays a little from its plan. In the end all are mirrored and turned together.
    """

    def __init__(self, rng: np.random.Generator, wobble: float = 14.0):
        """Draws how the town will be mirrored and turned.

        Args:
            rng: Source of the variety.
            wobble: How far points may stray from the plan along each axis, metres.
        """
        self._rng, self._wobble = rng, wobble
        self._mirror = rng.choice([-1.0, 1.0])
        self._turn = rng.uniform(-0.2, 0.2) + np.pi / 2 * int(rng.integers(0, 4))

    def curve(self, points: list[tuple[float, float]], fixed: str = "") -> np.ndarray:
        """Returns a line (N, 2) [m] through points that stray.

        Args:
            points: x and y in the frame of the plan, metres.
            fixed: The ends that lie on another street and do not stray: "s" the start, "e" the end, "se" both.
        """
        at = np.array(points, dtype=np.float64)
        wobble = self._rng.uniform(-self._wobble, self._wobble, at.shape)
        if "s" in fixed:
            wobble[0] = 0
        if "e" in fixed:
            wobble[-1] = 0
        return _spline(at + wobble)

    @staticmethod
    def on(line: np.ndarray, share: float) -> tuple[float, float]:
        """Returns the point at a share (0 to 1) of a line's length."""
        x, y = line[round(share * (len(line) - 1))]
        return float(x), float(y)

    @staticmethod
    def beside(line: np.ndarray, share: float, left: float) -> tuple[float, float]:
        """Returns the point `left` metres to the left of a line at a share (0 to 1) of its length."""
        k = min(max(round(share * (len(line) - 1)), 1), len(line) - 2)
        way = line[k + 1] - line[k - 1]
        x, y = line[k] + left * np.array([-way[1], way[0]]) / np.hypot(*way)
        return float(x), float(y)

    @staticmethod
    def straight(points: list[tuple[float, float]]) -> np.ndarray:
        """Returns a line through points that do not stray."""
        return _spline(np.array(points, dtype=np.float64))

    def closed(self, points: list[tuple[float, float]]) -> np.ndarray:
        """Returns a closed line through points that stray a little; they go counter-clockwise."""
        at = np.array(points, dtype=np.float64)
        at += self._rng.uniform(-0.2, 0.2, at.shape) * self._wobble
        return _spline(np.concatenate([at, at[:1]]), closed=True)

    @staticmethod
    def ring(centre: tuple[float, float], radius: float) -> np.ndarray:
        """Returns a closed circle, driven counter-clockwise."""
        turn = np.linspace(0, 2 * np.pi, max(12, round(np.pi * radius)) + 1)
        line = np.array(centre) + radius * np.column_stack([np.cos(turn), np.sin(turn)])
        line[-1] = line[0]
        return line

    def settle(self, streets: dict[str, Street]) -> dict[str, Street]:
        """Returns the streets, mirrored and turned into the town's frame.

        An end that meets no other street gets a tail, which leads out of the town.
        """
        settled = {}
        for name, street in streets.items():
            others = np.concatenate([s.line for other, s in streets.items() if other != name])
            line, tails = street.line, [0.0, 0.0]
            if np.abs(line[0] - line[-1]).max() > 0:
                for end in (0, -1):
                    if np.hypot(*(others - line[end]).T).min() > 25:
                        way = line[end] - line[3 if end == 0 else -4]
                        steps = np.arange(_SPACING, _TAIL + 1, _SPACING)[:, None] * way / np.hypot(*way)
                        more = line[end] + steps
                        line = np.concatenate([more[::-1], line] if end == 0 else [line, more])
                        tails[end] = _TAIL
            y = self._mirror * line[:, 1]
            cos, sin = np.cos(self._turn), np.sin(self._turn)
            line = np.column_stack([cos * line[:, 0] - sin * y, sin * line[:, 0] + cos * y])
            if street.oneway and self._mirror < 0:  # Traffic keeps to the right in a mirrored town as well.
                line, tails = line[::-1], tails[::-1]
            settled[name] = replace(street, line=line, tails=(tails[0], tails[1]))
        return settled


def inside(line: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Returns which of points (N, 2) lie inside a closed line (M, 2), as (N,) bool."""
    x, y = np.asarray(xy, dtype=np.float64).T[..., None]
    (x0, y0), (x1, y1) = line[:-1].T, line[1:].T
    rising = (y0 <= y) != (y1 <= y)
    crossing = x0 + (y - y0) / np.where(y1 == y0, 1.0, y1 - y0) * (x1 - x0)
    return (rising & (x < crossing)).sum(1) % 2 == 1


def _segment_distance(xy: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Returns the distances (N,) [m] of points (N, 2) from a polyline (M, 2)."""
    a, ab = line[:-1], np.diff(line, axis=0)
    t = ((xy[:, None] - a) * ab).sum(-1) / (ab**2).sum(-1)
    gap = xy[:, None] - a - np.clip(t, 0, 1)[..., None] * ab
    return np.sqrt((gap**2).sum(-1).min(axis=1))


def _grid(count: int) -> np.ndarray:
    """Returns all pairs (count², 2) of numbers below `count`."""
    return np.argwhere(np.ones((count, count), dtype=bool))


class Ground:
    """Rolling ground with the streets cut into it.

    Its height is linear on each triangle of a lattice. The mesh uses the same triangles, so `height` agrees with it
    exactly.
    """

    def __init__(
        self,
        streets: list[Street],
        extent: float,
        rng: np.random.Generator,
        steepness: float,
        kerb_height: float = KERB_HEIGHT,
    ):
        """Lays the streets on a square of ground around the origin.

        Args:
            streets: Streets whose centrelines lie within the square, tails excepted.
            extent: Half the side of the square, metres.
            rng: Source of the hills.
            steepness: Rise over run of the steepest slope, approximately.
            kerb_height: Height of pavements and lots above the carriageway, metres.
        """
        self.streets, self.kerb_height = streets, kerb_height
        self.extent = int(np.ceil(extent / (2 * _CELL))) * 2 * _CELL
        self._kerb_distance = self._distance_raster()
        axis = np.arange(-self.extent, self.extent + 1, _CELL, dtype=np.float64)
        x, y = np.meshgrid(axis, axis, indexing="ij")
        lattice = np.zeros_like(x)
        for _ in range(7):
            length, turn, phase = rng.uniform(140, 420), rng.uniform(0, np.pi), rng.uniform(0, 2 * np.pi)
            k = 2 * np.pi / length
            lattice += length * np.sin(k * (np.cos(turn) * x + np.sin(turn) * y) + phase)
        slope = np.hypot(*np.gradient(lattice, _CELL))
        lattice *= steepness * rng.uniform(0.91, 1.09) / slope.max()
        rough = np.clip(
            (self._kerb_distance[::_CELL, ::_CELL] - 10) / 10, 0, 1
        )  # Lawns and fields are a little uneven.
        lattice += 0.05 * rough * rng.standard_normal(lattice.shape)
        # Far from streets every second node lies on the line between its neighbours, so larger cells fit there exactly.
        far = self._kerb_distance[::_CELL, ::_CELL] >= _FAR
        between = lattice.copy()
        between[1::2, ::2] = 0.5 * (lattice[:-1:2, ::2] + lattice[2::2, ::2])
        between[::2, 1::2] = 0.5 * (lattice[::2, :-1:2] + lattice[::2, 2::2])
        between[1::2, 1::2] = 0.5 * (lattice[:-1:2, :-1:2] + lattice[2::2, 2::2])
        self._lattice = np.where(far, between, lattice)

    def _distance_raster(self) -> np.ndarray:
        """Returns the signed distance to the kerb [m] on a grid of 1 m: negative on carriageways, at most `_FAR`."""
        n = 2 * self.extent + 1
        fields = []
        for number, street in enumerate(self.streets):
            # Each street starts from its own large value. Equal values would blend far from the streets.
            field = np.full((n, n), 100.0 * (1 + number))
            for i in range(0, len(street.line) - 1, 10):
                line = street.line[i : i + 11]
                low = np.floor(line.min(0) - _FAR - street.half_width).astype(int) + self.extent
                high = np.ceil(line.max(0) + _FAR + street.half_width).astype(int) + self.extent + 1
                low, high = np.clip(low, 0, n), np.clip(high, 0, n)
                x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]), indexing="ij")
                xy = np.stack([x.ravel(), y.ravel()], axis=1) - float(self.extent)
                window = field[low[0] : high[0], low[1] : high[1]]
                np.minimum(window, _segment_distance(xy, line).reshape(x.shape), out=window)
            fields.append(field - street.half_width)
        edge = fields[0]
        for field in fields[1:]:
            blend = np.maximum(_CORNER - np.abs(edge - field), 0)
            edge = np.minimum(edge, field) - blend**2 / (4 * _CORNER)
        for street, field in zip(self.streets, fields, strict=True):
            if street.median:
                others = np.min([f for f in fields if f is not field], axis=0)
                edge = np.maximum(edge, -np.maximum(field + street.half_width - street.median, 5.0 - others))
        return np.minimum(edge, _FAR)

    def kerb_distance(self, xy: np.ndarray) -> np.ndarray:
        """Returns the signed distances (N,) [m] of points (N, 2) from the kerb.

        They are negative on a carriageway, and at most `_FAR`. Outside the ground they are 0, so nothing is put there.
        """
        at = np.asarray(xy, dtype=np.float64) + self.extent
        return np.where((np.abs(at - self.extent) < self.extent).all(-1), self._bilinear(self._kerb_distance, at), 0.0)

    @staticmethod
    def _bilinear(raster: np.ndarray, at: np.ndarray) -> np.ndarray:
        """Returns the values (N,) of a raster at continuous indices (N, 2)."""
        low = np.clip(np.floor(at).astype(int), 0, np.array(raster.shape) - 2)
        u, v = (np.clip(at - low, 0, 1)).T
        i, j = low.T
        return (raster[i, j] * (1 - u) + raster[i + 1, j] * u) * (1 - v) + (
            raster[i, j + 1] * (1 - u) + raster[i + 1, j + 1] * u
        ) * v

    def height(self, xy: np.ndarray) -> np.ndarray:
        """Returns the heights (N,) [m] of the carriageway level; pavements and lots lie `kerb_height` above it."""
        at = (np.asarray(xy, dtype=np.float64) + self.extent) / _CELL
        low = np.clip(np.floor(at).astype(int), 0, np.array(self._lattice.shape) - 2)
        u, v = (at - low).T
        i, j = low.T
        z = self._lattice
        a, b, c, d = z[i, j], z[i + 1, j], z[i + 1, j + 1], z[i, j + 1]
        return np.where(u > v, a + u * (b - a) + v * (c - b), a + v * (d - a) + u * (c - d))

    def surface(self, xy: np.ndarray) -> np.ndarray:
        """Returns points (N, 3) [m] on top of the carriageway, pavement or lot at (N, 2)."""
        xy = np.asarray(xy, dtype=np.float64)
        return np.column_stack([xy, self.height(xy) + self.kerb_height * (self.kerb_distance(xy) > 0)])

    def mesh(self) -> Part:
        """Returns the ground as a closed surface with upright kerbs."""
        n = (len(self._lattice) - 1) // 2
        negative = self._kerb_distance < 0
        parts = []
        size = 2 * _CELL
        cells = _grid(n) * size
        while size > 1:  # Cells with nodes on both sides of the kerb are halved.
            nodes = cells[:, None] + _grid(size + 1)
            below = negative[nodes[..., 0], nodes[..., 1]]
            every = below.all(1)
            cut = below.any(1) & ~every
            if size > _CELL:
                cut = (self._kerb_distance[nodes[..., 0], nodes[..., 1]] < _FAR).any(1)
            parts.append(self._lift(self._cell_triangles(cells[~cut], size), np.repeat(every[~cut], 2)))
            size //= 2
            cells = (cells[cut, None] + size * _grid(2)).reshape(-1, 2)
        parts += self._cut(self._cell_triangles(cells, 1))
        # A second floor below catches the rare ray that slips through where cells of two sizes meet.
        sunk = self._cell_triangles(_grid(n // 2) * 4 * _CELL, 4 * _CELL)
        floor = self._lift(sunk, np.ones(len(sunk), bool))
        parts.append(Part(floor.vertices - (0, 0, 1.5), floor.triangles))
        return merge(parts)

    @staticmethod
    def _cell_triangles(cells: np.ndarray, size: int) -> np.ndarray:
        """Returns two triangles per square cell (2N, 3, 2), as nodes of the grid of 1 m."""
        a, b, c, d = (cells + np.array(step) * size for step in ((0, 0), (1, 0), (1, 1), (0, 1)))
        return np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], 1).reshape(-1, 3, 2)

    def _lift(self, nodes: np.ndarray, road: np.ndarray) -> Part:
        """Returns triangles of nodes (N, 3, 2), at carriageway level where `road` (N,) and else a kerb above it."""
        xy = nodes.reshape(-1, 2) - float(self.extent)
        z = self.height(xy) + self.kerb_height * np.repeat(~road, 3)
        return Part(np.column_stack([xy, z]), np.arange(len(xy)).reshape(-1, 3))

    def _cut(self, nodes: np.ndarray) -> list[Part]:
        """Returns triangles of nodes (N, 3, 2) split along the kerb, and the upright face of the kerb."""
        value = self._kerb_distance[nodes[..., 0], nodes[..., 1]]
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
            low, high = np.concatenate([polygon, z], -1), np.concatenate([polygon, z + self.kerb_height], -1)
            tip_side, base_side = (low, high) if road_tip else (high, low)
            every = np.concatenate([tip_side, base_side], axis=1)
            faces = np.array([[0, 1, 2], [6, 8, 9], [6, 9, 7], [1, 2, 7], [1, 7, 6]])
            start = 10 * np.arange(len(every))[:, None, None]
            parts.append(Part(every.reshape(-1, 3), (faces + start).reshape(-1, 3)))
        return parts
