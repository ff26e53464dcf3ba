"""The stencil: which 4 pixels surround a query, and where the query lies between them.

A query is a continuous pixel coordinate (row, column) whose integers are pixel centres. Its neighbours are
numbered (row-, col-), (row-, col+), (row+, col-), (row+, col+). Rows clamp at the image's first and last row. Columns
wrap from W-1 to 0 on a full-circle image (`wrap`) and clamp otherwise. A query that lies on a pixel centre has that
pixel as its neighbour 0. Clamped neighbours repeat a pixel: they are still four.
"""

from typing import Any

import warp as wp

__all__ = ["area", "base", "bounds", "column_of", "neighbour", "offset", "query_of"]


@wp.func
def query_of(thread: int, count: int):
    """Which image and which of its `count` queries a thread serves; the CPU compiler sees that neither is negative."""
    b = wp.max(thread // count, 0)
    return b, wp.max(thread - b * count, 0)


@wp.func
def base(coordinate: Any):
    """The integer below a coordinate; absurd ones stay within what an int holds."""
    limit = type(coordinate)(1073741824.0)  # 2^30
    return int(wp.floor(wp.clamp(coordinate, -limit, limit)))


@wp.func
def column_of(column: int, width: int, wrap: int):
    """The pixel column that an unbounded column number stands for."""
    if wrap != 0:
        if column >= 0 and column < width:
            return column  # the usual case, without a division
        return ((column % width) + width) % width
    return wp.clamp(column, 0, width - 1)


@wp.func
def bounds(row: Any, column: Any, height: int, width: int, wrap: int):
    """Rows above and below and columns left and right of a query, which its neighbours are made of."""
    r = wp.floor(row)
    c = wp.floor(column)
    zero = type(row)(0.0)
    if r >= zero and c >= zero and r < type(row)(height - 1) and c < type(row)(width - 1):
        above = wp.max(int(r), 0)  # it is: so much the compiler must see, or it provides for negative indices
        left = wp.max(int(c), 0)
        return above, above + 1, left, left + 1  # the usual case, without a border
    i = base(row)
    j = base(column)
    return (
        wp.max(wp.min(i, height - 1), 0),
        wp.max(wp.min(i + 1, height - 1), 0),
        wp.max(column_of(j, width, wrap), 0),
        wp.max(column_of(j + 1, width, wrap), 0),
    )


@wp.func
def neighbour(row: Any, column: Any, t: int, height: int, width: int, wrap: int):
    """Pixel (row, column) of the query's neighbour number t."""
    return (
        wp.clamp(base(row) + t // 2, 0, height - 1),
        column_of(base(column) + t % 2, width, wrap),
    )


@wp.func
def offset(row: Any, column: Any, t: int, height: int, width: int, wrap: int):
    """Query minus neighbour number t in pixels (rows, columns); never a jump over the seam."""
    r = wp.clamp(base(row) + t // 2, 0, height - 1)
    c = base(column) + t % 2
    if wrap == 0:
        c = wp.clamp(c, 0, width - 1)
    return row - type(row)(r), column - type(column)(c)


@wp.func
def area(row: Any, column: Any, t: int):
    """Bilinear weight of neighbour t: the area between the query and the diagonally opposite neighbour (S_t / S)."""
    fr = row - wp.floor(row)
    fc = column - wp.floor(column)
    one = type(row)(1.0)
    if t // 2 == 0:
        fr = one - fr
    if t % 2 == 0:
        fc = one - fc
    return fr * fc
