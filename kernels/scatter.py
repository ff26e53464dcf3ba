"""The adjoint of the stencil: what queries say of their neighbours is summed into pixels, without atomics."""

from typing import Any

import torch
import warp as wp

from kernels.launch import launch, overload, overload_vectors, vector_width
from kernels.stencil import base, bounds, column_of, query_of
from kernels.vmap import fold_into_batch

__all__ = ["PARTS", "adjoint_of_gather", "sort_queries", "sum_by_pixel", "sum_by_query", "sum_slices"]


@wp.func
def cell(row: Any, column: Any, height: int, width: int, wrap: int):
    """Number of the cell between pixel centres that holds a query: (height + 1) rows of (width + 1) cells.

    Queries of one cell share their neighbours; cell (i, j) has pixel (i, j) as its neighbour 3, before clamping.
    """
    i = wp.clamp(base(row) + 1, 0, height)
    j = wp.clamp(base(column) + 1, 0, width)
    if wrap != 0:
        j = column_of(base(column), width, 1) + 1
    return i * (width + 1) + j


@wp.func
def cell_index(i: int, j: int, k: int, height: int, width: int, wrap: int):
    """The k-th (0..3) cell whose queries have pixel (i, j) as a neighbour, or -1.

    The clamped border needs no special case: its cells have the border pixel as two neighbours. -1 stands for a
    cell met before, when one column wraps onto itself.
    """
    ci = i + k // 2
    cj = j + k % 2
    if wrap != 0:
        if width == 1 and cj == 1:
            return -1
        if cj == 0:
            cj = width
    return ci * (width + 1) + cj


@wp.kernel(enable_backward=False)
def _number_cells_kernel(
    first: int,
    # in
    queries: wp.array3d[Any],
    height: int,
    width: int,
    wrap: int,
    # out
    cells_out: wp.array2d[wp.int32],
):
    b, q = query_of(first + wp.tid(), queries.shape[1])
    cells_out[b, q] = cell(queries[b, q, 0], queries[b, q, 1], height, width, wrap)


@wp.kernel(enable_backward=False)
def _sum_gradients_kernel(
    first: int,
    # in
    gradients: wp.array4d[Any],
    order: wp.array[wp.int32],
    starts: wp.array[wp.int32],
    wrap: int,
    # out
    pixels_out: wp.array4d[Any],
):
    height = pixels_out.shape[1]
    width = pixels_out.shape[2]
    thread = first + wp.tid()
    c = thread % pixels_out.shape[3]
    pixel = thread // pixels_out.shape[3]
    b = pixel // (height * width)
    i = (pixel // width) % height
    j = pixel % width
    total = pixels_out[b, i, j, c]
    for k in range(4):
        n = cell_index(i, j, k, height, width, wrap)
        if n >= 0:
            above = n // (width + 1) - 1
            left = n % (width + 1) - 1
            n = n + b * (height + 1) * (width + 1)
            for t in range(4):
                row = wp.clamp(above + t // 2, 0, height - 1)
                if row == i and column_of(left + t % 2, width, wrap) == j:
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
    height: int,
    width: int,
    span: int,
    wrap: int,
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
        above, below, left, right = bounds(queries[b, q, 0], queries[b, q, 1], height, width, wrap)
        p0 = above * width + left
        p1 = above * width + right
        p2 = below * width + left
        p3 = below * width + right
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

# Threads of the sum on a CPU. A constant: the number of cores does not change the rounding.
PARTS = 8


def sort_queries(queries: torch.Tensor, height: int, width: int, wrap: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """Sorts the queries of all images by cell.

    Args:
        queries: (B, Q, 2) pixel coordinates.
        height: Rows H of the image.
        width: Columns W of the image.
        wrap: Whether columns wrap around the seam.

    Returns:
        order: (B·Q,) int32 numbers b·Q + q of the queries, cell by cell.
        starts: (B·(H + 1)·(W + 1) + 1,) int32, where in `order` the queries of each cell begin.
    """
    batch, count, _ = queries.shape
    cells = torch.empty(batch, count, dtype=torch.int32, device=queries.device)
    launch(_number_cells[queries.dtype], batch * count, [queries, height, width, int(wrap)], [cells])
    per_image = (height + 1) * (width + 1)
    cells = cells + per_image * torch.arange(batch, dtype=torch.int32, device=queries.device).unsqueeze(1)
    cells, order = torch.sort(cells.view(-1), stable=True)
    numbers = torch.arange(batch * per_image + 1, dtype=torch.int32, device=queries.device)
    return order.to(torch.int32), torch.searchsorted(cells, numbers, out_int32=True)


@torch.library.custom_op("kernels::adjoint_of_gather", mutates_args=())
def adjoint_of_gather(
    gradients: torch.Tensor, queries: torch.Tensor, height: int, width: int, wrap: bool
) -> torch.Tensor:
    """Sums what the queries say of their neighbours into the pixels: the adjoint of gathering.

    Deterministic, and without atomics: those are not deterministic on a GPU and not safe on several CPU cores.

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
        return gradients.new_zeros(gradients.shape[0], height, width, gradients.shape[3])
    summed = sum_by_pixel if queries.device.type == "cuda" else sum_by_query
    return summed(gradients.contiguous(), queries, height, width, wrap)


def sum_by_pixel(gradients: torch.Tensor, queries: torch.Tensor, height: int, width: int, wrap: bool) -> torch.Tensor:
    """`adjoint_of_gather` for many small cores: each pixel reads the queries of the cells around it, in their order."""
    order, starts = sort_queries(queries, height, width, wrap)
    pixels = gradients.new_zeros(len(gradients), height, width, gradients.shape[3])
    width = vector_width(gradients.shape[3])
    inputs = [gradients, order, starts, int(wrap)]
    launch(_sum_gradients[gradients.dtype, width], pixels.numel() // width, inputs, [pixels])
    return pixels


def sum_by_query(gradients: torch.Tensor, queries: torch.Tensor, height: int, width: int, wrap: bool) -> torch.Tensor:
    """`adjoint_of_gather` for few big cores: each adds a share of queries and channels to pixels of its own."""
    batch, _, _, channels = gradients.shape
    width = vector_width(channels)
    blocks = channels // width
    spans = min(blocks, -(-PARTS // batch))
    slices = -(-PARTS // (batch * spans))
    shares = gradients.new_empty(batch * slices, height * width, channels)
    span = -(-blocks // spans)
    launch(
        _add_gradients[gradients.dtype, width],
        batch * slices * -(-blocks // span),
        [gradients, queries, 0.0, height, width, span, int(wrap)],
        [shares],
        least=1,
    )
    return sum_slices(shares.view(batch, slices, height * width, channels)).view(batch, height, width, channels)


def sum_slices(slices: torch.Tensor) -> torch.Tensor:
    """(B, P, C), the sum of slices (B, S, P, C) in their order."""
    # Not `sum`: torch's threads, once woken, spin for milliseconds on cores that the next launch wants.
    sums = slices.new_empty(slices.shape[0], *slices.shape[2:])
    width = vector_width(slices.shape[3])
    launch(_sum_slices[slices.dtype, width], sums.numel() // width, [slices, 0.0], [sums])
    return sums


@adjoint_of_gather.register_fake
def _(gradients: torch.Tensor, queries: torch.Tensor, height: int, width: int, wrap: bool) -> torch.Tensor:
    return gradients.new_empty(gradients.shape[0], height, width, gradients.shape[3])


fold_into_batch(adjoint_of_gather)
