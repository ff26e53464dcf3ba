"""Pieces of mesh in metres, z up: primitives such as boxes and tubes, and functions that copy, move and join them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

__all__ = [
    "EMPTY",
    "Panel",
    "Part",
    "boxes",
    "loft",
    "merge",
    "place",
    "polyline_tubes",
    "quads",
    "raster",
    "shift",
    "tubes",
]


class Part(NamedTuple):
    """A piece of mesh: vertices (V, 3) float64 in metres, triangles (F, 3) int64."""

    vertices: np.ndarray
    triangles: np.ndarray
    is_pole: bool = False
    """Whether it is a pole with what it carries, which a town tells apart from all else."""


class Panel(NamedTuple):
    """A piece of a fence, wall or hedge, to be repeated along a path."""

    part: Part
    """Runs along +x from the origin."""
    length: float
    """Distance from one panel to the next, metres."""


EMPTY = Part(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))


def merge(parts: Sequence[Part]) -> Part:
    """Returns several parts as one."""
    if not parts:
        return EMPTY
    starts = np.cumsum([0, *[len(p.vertices) for p in parts[:-1]]])
    triangles = [p.triangles + start for p, start in zip(parts, starts, strict=True)]
    return Part(np.concatenate([p.vertices for p in parts]), np.concatenate(triangles))


def _repeat(vertices: np.ndarray, triangles: np.ndarray) -> Part:
    """Returns N pieces with vertices (N, K, 3) that all have the same triangles (F, 3) as one part."""
    count, size = vertices.shape[:2]
    offsets = size * np.arange(count)[:, None, None]
    return Part(vertices.reshape(-1, 3), (triangles[None] + offsets).reshape(-1, 3))


def place(part: Part, position: ArrayLike, yaw: ArrayLike = 0.0, scale: ArrayLike = 1.0) -> Part:
    """Returns copies of a part, each scaled, then turned about z, then moved.

    Args:
        part: What to copy.
        position: (3,) or (N, 3) where the origin of each copy goes, metres.
        yaw: Scalar or (N,), rad counter-clockwise.
        scale: Scalar, (N,), or (N, 3) along the part's own axes.
    """
    position = np.atleast_2d(np.asarray(position, dtype=np.float64))
    count = len(position)
    yaw = np.broadcast_to(np.asarray(yaw, dtype=np.float64), (count,))
    scale = np.asarray(scale, dtype=np.float64)
    scale = np.broadcast_to(scale[:, None] if scale.ndim == 1 else scale, (count, 3))
    local = part.vertices[None] * scale[:, None]
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x = cos * local[..., 0] - sin * local[..., 1]
    y = sin * local[..., 0] + cos * local[..., 1]
    return _repeat(np.stack([x, y, local[..., 2]], axis=-1) + position[:, None], part.triangles)


def shift(part: Part, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Part:
    """Returns a part moved by (x, y, z) metres."""
    return Part(part.vertices + np.array([x, y, z]), part.triangles)


def quads(corners: ArrayLike) -> Part:
    """Returns flat four-sided faces; corners (N, 4, 3) [m] go around each face."""
    corners = np.asarray(corners, dtype=np.float64).reshape(-1, 4, 3)
    return _repeat(corners, np.array([[0, 1, 2], [0, 2, 3]]))


_BOX = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
_BOX_FACES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [1, 5, 7, 3], [0, 2, 6, 4]])


def boxes(low: ArrayLike, high: ArrayLike, ends: bool = True) -> Part:
    """Returns axis-aligned boxes.

    Args:
        low: (3,) or (N, 3) corners with the smallest coordinates, metres.
        high: (3,) or (N, 3) opposite corners, metres.
        ends: Whether the boxes have a top and a bottom.
    """
    low, high = np.broadcast_arrays(np.atleast_2d(np.asarray(low, float)), np.atleast_2d(np.asarray(high, float)))
    corners = low[:, None] + _BOX * (high - low)[:, None]
    faces = _BOX_FACES if ends else _BOX_FACES[:4]
    return _repeat(corners, np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]]))


def tubes(
    start: ArrayLike,
    end: ArrayLike,
    radius: ArrayLike,
    end_radius: ArrayLike | None = None,
    sides: int = 4,
    caps: bool = True,
) -> Part:
    """Returns tapered prisms.

    Args:
        start: (3,) or (N, 3) start of each axis, metres.
        end: (3,) or (N, 3) end of each axis, metres.
        radius: Scalar or (N,) radius at the start, metres.
        end_radius: Scalar or (N,) radius at the end, metres; by default the same as at the start.
        sides: Number of sides of each prism.
        caps: Whether the ends are closed. Thin bars do not need it.
    """
    start, end = np.broadcast_arrays(np.atleast_2d(np.asarray(start, float)), np.atleast_2d(np.asarray(end, float)))
    count = len(start)
    r0 = np.broadcast_to(np.asarray(radius, dtype=np.float64), (count,))
    r1 = r0 if end_radius is None else np.broadcast_to(np.asarray(end_radius, dtype=np.float64), (count,))
    axis = end - start
    axis = axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-9)
    upright = np.abs(axis[:, 2:]) > 0.9
    u = np.cross(axis, np.where(upright, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]]))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    w = np.cross(axis, u)
    turn = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    ring = np.cos(turn)[:, None] * u[:, None] + np.sin(turn)[:, None] * w[:, None]
    vertices = np.concatenate(
        [start[:, None] + r0[:, None, None] * ring, end[:, None] + r1[:, None, None] * ring], axis=1
    )
    i = np.arange(sides)
    j = (i + 1) % sides
    fan = np.stack([np.zeros(sides - 2, dtype=np.int64), i[1:-1], i[2:]], axis=1)
    faces = [np.stack([i, j, j + sides], 1), np.stack([i, j + sides, i + sides], 1)]
    if caps:
        faces += [fan[:, ::-1], fan + sides]
    return _repeat(vertices, np.concatenate(faces))


def polyline_tubes(points: ArrayLike, radius: float, sides: int = 3) -> Part:
    """Returns open prisms along a polyline (N, 3) [m], all of one radius [m]."""
    points = np.asarray(points, dtype=np.float64)
    return tubes(points[:-1], points[1:], radius, sides=sides, caps=False)


def loft(rings: np.ndarray) -> Part:
    """Returns the closed skin over M rings of K points (M, K, 3) [m], with fans over the first and the last ring."""
    m, k = rings.shape[:2]
    a = (np.arange(m - 1)[:, None] * k + np.arange(k)).ravel()
    b = (np.arange(m - 1)[:, None] * k + (np.arange(k) + 1) % k).ravel()
    i = np.arange(1, k - 1)
    fan = np.stack([np.zeros_like(i), i, i + 1], axis=1)
    faces = [np.stack([a, b, b + k], 1), np.stack([a, b + k, a + k], 1), fan[:, ::-1], fan + (m - 1) * k]
    return Part(rings.reshape(-1, 3).astype(np.float64), np.concatenate(faces))


def raster(metres: np.ndarray) -> np.ndarray:
    """Returns an array as float32, rounded to multiples of 1/1024.

    Machines whose arithmetic differs in the last digits then give the same values.
    """
    return (np.round(metres * 1024) / 1024).astype(np.float32)
