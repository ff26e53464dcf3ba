"""The stencil: which 4 pixels surround a query, and where the query lies between them.

A *query* is a continuous pixel coordinate (row, column); integers are pixel centres. These words mean the same
everywhere in `kernels`:

- *Neighbours*: the 4 pixels around a query, numbered t = 0..3 in the order (row-, col-), (row-, col+), (row+, col-),
  (row+, col+). A query on a pixel centre has that pixel as its neighbour 0.
- *Offset* Δq_t: query minus neighbour t, in rows and columns of pixels.
- *Area* S_t / S: the bilinear weight of neighbour t (paper, Eq. 2), see `area`.
- *Seam*: where column W-1 meets column 0. Columns wrap around it if the grid says so, and clamp otherwise. Rows always
  clamp. A clamped neighbour repeats a pixel: there are still four.

`kernels.scatter` is the adjoint of the stencil.
"""

from functools import lru_cache
from typing import Any

import warp as wp

__all__ = ["Grid", "area", "base", "bounds", "column_of", "grid_of", "neighbour", "offset", "query_of"]


@wp.struct
class Grid:
    """The pixels of an image, as a kernel's argument."""

    height: int
    """Rows H."""
    width: int
    """Columns W."""
    wrap: int
    """1 if column W-1 meets column 0, a full circle; 0 if columns clamp."""


@lru_cache(maxsize=128)  # the same few sizes in every launch; nobody changes a grid
def grid_of(height: int, width: int, wrap: bool) -> Any:
    """Returns the `Grid` of an image of H = `height` and W = `width` whose columns wrap around the seam or clamp."""
    grid = Grid()
    grid.height, grid.width, grid.wrap = height, width, int(wrap)
    return grid


@wp.func
def query_of(thread: int, count: int):
    """Image and query number of a thread, where each image has `count` queries."""
    b = wp.max(thread // count, 0)  # neither is negative, and `max` lets the CPU compiler see it
    return b, wp.max(thread - b * count, 0)


@wp.func
def base(coordinate: Any):
    """The integer at or below a coordinate, kept within ±2^30 so that an int holds it; -2^30 for NaN."""
    limit = type(coordinate)(1073741824.0)  # 2^30
    coordinate = wp.where(coordinate > -limit, coordinate, -limit)  # not `clamp`, which leaves NaN to the device
    return int(wp.floor(wp.where(coordinate < limit, coordinate, limit)))


@wp.func
def column_of(column: int, width: int, wrap: int):
    """The pixel column that an unbounded column number stands for."""
    if wrap != 0:
        if column >= 0 and column < width:
            return column  # the usual case, without a division
        return ((column % width) + width) % width
    return wp.clamp(column, 0, width - 1)


@wp.func
def bounds(row: Any, column: Any, grid: Grid):
    """Rows above and below and columns left and right of a query: its neighbours are their four combinations."""
    r = wp.floor(row)
    c = wp.floor(column)
    zero = type(row)(0.0)
    if r >= zero and c >= zero and r < type(row)(grid.height - 1) and c < type(row)(grid.width - 1):
        above = wp.max(int(r), 0)  # never negative, and `max` lets the compiler see it
        left = wp.max(int(c), 0)
        return above, above + 1, left, left + 1  # the usual case, without a border
    i = base(row)
    j = base(column)
    return (
        wp.max(wp.min(i, grid.height - 1), 0),
        wp.max(wp.min(i + 1, grid.height - 1), 0),
        wp.max(column_of(j, grid.width, grid.wrap), 0),
        wp.max(column_of(j + 1, grid.width, grid.wrap), 0),
    )


@wp.func
def neighbour(row: Any, column: Any, t: int, grid: Grid):
    """Pixel (row, column) of neighbour t of a query."""
    return (
        wp.clamp(base(row) + t // 2, 0, grid.height - 1),
        column_of(base(column) + t % 2, grid.width, grid.wrap),
    )


@wp.func
def offset(row: Any, column: Any, t: int, grid: Grid):
    """Query minus neighbour t in rows and columns; small at the seam as well, where pixel columns jump."""
    r = wp.clamp(base(row) + t // 2, 0, grid.height - 1)
    c = base(column) + t % 2
    if grid.wrap == 0:
        c = wp.clamp(c, 0, grid.width - 1)
    return row - type(row)(r), column - type(column)(c)


@wp.func
def area(row: Any, column: Any, t: int):
    """S_t / S (paper, Eq. 2), the area of the rectangle between the query and the neighbour diagonally opposite to t.

    The unit cell between the 4 neighbours has the area S = 1. The nearer the query is to neighbour t, the larger S_t.
    """
    fr = row - wp.floor(row)
    fc = column - wp.floor(column)
    one = type(row)(1.0)
    if t // 2 == 0:
        fr = one - fr
    if t % 2 == 0:
        fc = one - fc
    return fr * fc
