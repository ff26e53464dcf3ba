"""The adjoint of the stencil: gradients that queries have for their neighbours are summed into pixels.

Gathering copies 4 pixels to each query. Its adjoint adds the 4 gradients of each query to those pixels, and many
queries share a pixel. Atomic additions would round differently in every run on a GPU. On several CPU cores they would
give wrong sums, since Warp's CPU atomics are plain additions. So no two threads write to one element here:

- On a GPU a thread sums one pixel (`sum_by_pixel`). The queries are first sorted by *cell*, the unit square between 4
  pixel centres: queries of one cell have the same neighbours, and a pixel is a neighbour in the 4 cells around it.
- On a CPU a thread takes a share of the queries and adds to an image of its own, a *slice* (`sum_by_query`). The slices
  are summed afterwards.

Both add in a fixed order, so that the result is the same in every run and on any number of cores.
"""

from typing import Any

import torch
import warp as wp

from kernels.launch import launch, overload, overload_vectors, vector_width
from kernels.stencil import Grid, base, bounds, column_of, grid_of, query_of
from kernels.vmap import fold_into_batch

__all__ = ["PARTS", "adjoint_of_gather", "sort_queries", "sum_by_pixel", "sum_by_query", "sum_slices"]

# How many threads share the queries of a sum on a CPU. A constant, so that the number of cores changes no rounding.
PARTS = 8


@wp.func
def cell(row: Any, column: Any, grid: Grid):
    """Number of the cell that holds a query, of H + 1 rows of W + 1 cells.

    Cell (i, j) has pixel (i, j) as its neighbour 3, before clamping. The outermost cells reach beyond the image.
    """
    i = wp.clamp(base(row) + 1, 0, grid.height)
    j = wp.clamp(base(column) + 1, 0, grid.width)
    if grid.wrap != 0:
        j = column_of(base(column), grid.width, 1) + 1
    return i * (grid.width + 1) + j


@wp.func
def cell_index(i: int, j: int, k: int, grid: Grid):
    """Number of the k-th (0..3) cell around pixel (i, j), whose queries have the pixel as a neighbour.

    Returns -1 for a cell that came before, which happens when the only column wraps onto itself. At a clamped border
    a cell has the border pixel as two of its neighbours.
    """
    ci = i + k // 2
    cj = j + k % 2
    if grid.wrap != 0:
        if grid.width == 1 and cj == 1:
            return -1
        if cj == 0:
            cj = grid.width
    return ci * (grid.width + 1) + cj


@wp.kernel(enable_backward=False)
def _number_cells_kernel(
    first: int,
    # in
    queries: wp.array3d[Any],
    grid: Grid,
    # out
    cells_out: wp.array2d[wp.int32],
):
    b, q = query_of(first + wp.tid(), queries.shape[1])
    cells_out[b, q] = cell(queries[b, q, 0], queries[b, q, 1], grid)


@wp.kernel(enable_backward=False)
def _sum_gradients_kernel(
    first: int,
    # in
    gradients: wp.array4d[Any],
    order: wp.array[wp.int32],
    starts: wp.array[wp.int32],
    grid: Grid,
    # out
    pixels_out: wp.array4d[Any],
):
    height = grid.height
    width = grid.width
    thread = first + wp.tid()
    c = thread % pixels_out.shape[3]
    pixel = thread // pixels_out.shape[3]
    b = pixel // (height * width)
    i = (pixel // width) % height
    j = pixel % width
    total = pixels_out[b, i, j, c]
    for k in range(4):
        n = cell_index(i, j, k, grid)
        if n >= 0:
            above = n // (width + 1) - 1
            left = n % (width + 1) - 1
            n = n + b * (height + 1) * (width + 1)
            for t in range(4):
                row = wp.clamp(above + t // 2, 0, height - 1)
                if row == i and column_of(left + t % 2, width, grid.wrap) == j:
                    for s in range(starts[n], starts[n + 1]):
                        total = total + gradients[b, order[s] - b * gradients.shape[1], t, c]
    pixels_out[b, i, j, c] = total


@wp.kernel(enable_backward=False)
def _add_gradients_kernel(
    first: int,
    # in
    gradients: wp.array4d[Any],
    queries: wp.array3d[wp.Float],
    zero: wp.Float,
    span: int,
    grid: Grid,
    # out
    slices_out: wp.array3d[Any],
):
    spans = (gradients.shape[3] + span - 1) // span
    thread = first + wp.tid()
    begin = (thread % spans) * span
    end = wp.min(begin + span, gradients.shape[3])
    part = thread // spans
    slices = slices_out.shape[0] // queries.shape[0]
    b = part // slices
    per_slice = (queries.shape[1] + slices - 1) // slices
    start = (part % slices) * per_slice
    for p in range(slices_out.shape[1]):
        for c in range(begin, end):
            slices_out[part, p, c] = gradients.dtype(zero)
    for q in range(start, wp.min(start + per_slice, queries.shape[1])):
        above, below, left, right = bounds(queries[b, q, 0], queries[b, q, 1], grid)
        p0 = above * grid.width + left
        p1 = above * grid.width + right
        p2 = below * grid.width + left
        p3 = below * grid.width + right
        for c in range(begin, end):
            slices_out[part, p0, c] = slices_out[part, p0, c] + gradients[b, q, 0, c]
            slices_out[part, p1, c] = slices_out[part, p1, c] + gradients[b, q, 1, c]
            slices_out[part, p2, c] = slices_out[part, p2, c] + gradients[b, q, 2, c]
            slices_out[part, p3, c] = slices_out[part, p3, c] + gradients[b, q, 3, c]


@wp.kernel(enable_backward=False)
def _sum_slices_kernel(
    first: int,
    # in
    slices: wp.array4d[Any],
    zero: wp.Float,
    # out
    sums_out: wp.array3d[Any],
):
    thread = first + wp.tid()
    c = thread % slices.shape[3]
    p = (thread // slices.shape[3]) % slices.shape[2]
    b = thread // slices.shape[3] // slices.shape[2]
    total = slices.dtype(zero)
    for s in range(slices.shape[1]):
        total = total + slices[b, s, p, c]
    sums_out[b, p, c] = total


_number_cells = overload(_number_cells_kernel)
_sum_gradients = overload_vectors(_sum_gradients_kernel)
_add_gradients = overload_vectors(_add_gradients_kernel)
_sum_slices = overload_vectors(_sum_slices_kernel)


def sort_queries(queries: torch.Tensor, height: int, width: int, wrap: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """Sorts the queries of all images by the cell that holds them.

    Args:
        queries: (B, Q, 2) pixel coordinates.
        height: Rows H of the image.
        width: Columns W of the image.
        wrap: Whether columns wrap around the seam.

    Returns:
        order: (B·Q,) int32, the numbers b·Q + q of the queries, cell by cell.
        starts: (B·(H + 1)·(W + 1) + 1,) int32, the place in `order` where the queries of each cell begin.
    """
    batch, count, _ = queries.shape
    cells = torch.empty(batch, count, dtype=torch.int32, device=queries.device)
    launch(_number_cells[queries.dtype], batch * count, [queries, grid_of(height, width, wrap)], [cells])
    per_image = (height + 1) * (width + 1)
    cells = cells + per_image * torch.arange(batch, dtype=torch.int32, device=queries.device).unsqueeze(1)
    cells, order = torch.sort(cells.view(-1), stable=True)
    numbers = torch.arange(batch * per_image + 1, dtype=torch.int32, device=queries.device)
    return order.to(torch.int32), torch.searchsorted(cells, numbers, out_int32=True)


@torch.library.custom_op("kernels::adjoint_of_gather", mutates_args=())
def adjoint_of_gather(
    gradients: torch.Tensor, queries: torch.Tensor, height: int, width: int, wrap: bool
) -> torch.Tensor:
    """Sums the gradients that queries have for their neighbours into pixels: the adjoint of gathering.

    Args:
        gradients: (B, Q, 4, C) float32 or float64, for each query and neighbour.
        queries: (B, Q, 2) pixel coordinates, same dtype.
        height: Rows H of the image.
        width: Columns W of the image.
        wrap: Whether columns wrap around the seam.

    Returns:
        (B, H, W, C).
    """
    if gradients.numel() == 0:
        return _empty_pixels(gradients, queries, height, width, wrap).zero_()
    summed = sum_by_pixel if queries.device.type == "cuda" else sum_by_query
    return summed(gradients.contiguous(), queries, height, width, wrap)


def _empty_pixels(gradients: torch.Tensor, queries: torch.Tensor, height: int, width: int, wrap: bool) -> torch.Tensor:
    return gradients.new_empty(gradients.shape[0], height, width, gradients.shape[3])


adjoint_of_gather.register_fake(_empty_pixels)
fold_into_batch(adjoint_of_gather)


def sum_by_pixel(gradients: torch.Tensor, queries: torch.Tensor, height: int, width: int, wrap: bool) -> torch.Tensor:
    """`adjoint_of_gather` for many small cores: each thread sums one pixel over the queries of the cells around it."""
    order, starts = sort_queries(queries, height, width, wrap)
    pixels = _empty_pixels(gradients, queries, height, width, wrap).zero_()
    lanes = vector_width(gradients.shape[3])
    inputs = [gradients, order, starts, grid_of(height, width, wrap)]
    launch(_sum_gradients[gradients.dtype, lanes], pixels.numel() // lanes, inputs, [pixels])
    return pixels


def sum_by_query(gradients: torch.Tensor, queries: torch.Tensor, height: int, width: int, wrap: bool) -> torch.Tensor:
    """`adjoint_of_gather` for few large cores: each thread adds its share of queries and channels to its slice."""
    batch, _, _, channels = gradients.shape
    lanes = vector_width(channels)
    blocks = channels // lanes
    spans = min(blocks, -(-PARTS // batch))
    slices = -(-PARTS // (batch * spans))
    shares = gradients.new_empty(batch * slices, height * width, channels)
    span = -(-blocks // spans)
    launch(
        _add_gradients[gradients.dtype, lanes],
        batch * slices * -(-blocks // span),
        [gradients, queries, 0.0, span, grid_of(height, width, wrap)],
        [shares],
        least=1,
    )
    return sum_slices(shares.view(batch, slices, height * width, channels)).view(batch, height, width, channels)


def sum_slices(slices: torch.Tensor) -> torch.Tensor:
    """Returns (B, P, C), the sum of slices (B, S, P, C) in their order."""
    # Not `torch.sum`: torch's threads, once woken, spin for milliseconds on cores that the next launch needs.
    sums = slices.new_empty(slices.shape[0], *slices.shape[2:])
    lanes = vector_width(slices.shape[3])
    launch(_sum_slices[slices.dtype, lanes], sums.numel() // lanes, [slices, 0.0], [sums])
    return sums
