"""The stencil: which 4 pixels surround a query, and where the query lies between them.

A query is a continuous pixel coordinate (row, column) whose integers are pixel centres. Its neighbours are
numbered (row-, col-), (row-, col+), (row+, col-), (row+, col+). Rows clamp at the image's first and last row. Columns
wrap from W-1 to 0 on a full-circle image (`wrap`) and clamp otherwise. A query that lies on a pixel centre has that
pixel as its neighbour 0. Clamped neighbours repeat a pixel: they are still four.
"""

from typing import Any

import torch
import warp as wp

from kernels.launch import lanes, launch, overload, overload_vectors
from kernels.vmap import fold_into_batch

__all__ = [
    "BLOCKS",
    "PARTS",
    "adjoint_of_gather",
    "area",
    "bounds",
    "broadcast_batch",
    "channel_spans",
    "check_queries",
    "neighbour",
    "offset",
    "query_blocks",
    "query_of",
    "sort_queries",
    "sum_by_pixel",
    "sum_by_query",
    "sum_slices",
]


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
    lane = lanes(gradients.shape[3])
    inputs = [gradients, order, starts, int(wrap)]
    launch(_sum_gradients[gradients.dtype, lane], pixels.numel() // lane, inputs, [pixels])
    return pixels


def sum_by_query(gradients: torch.Tensor, queries: torch.Tensor, height: int, width: int, wrap: bool) -> torch.Tensor:
    """`adjoint_of_gather` for few big cores: each adds a share of queries and channels to pixels of its own."""
    batch, _, _, channels = gradients.shape
    lane = lanes(channels)
    blocks = channels // lane
    spans = min(blocks, -(-PARTS // batch))
    slices = -(-PARTS // (batch * spans))
    shares = gradients.new_empty(batch * slices, height * width, channels)
    span = -(-blocks // spans)
    launch(
        _add_gradients[gradients.dtype, lane],
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
    lane = lanes(slices.shape[3])
    launch(_sum_slices[slices.dtype, lane], sums.numel() // lane, [slices, 0.0], [sums])
    return sums


@adjoint_of_gather.register_fake
def _(gradients: torch.Tensor, queries: torch.Tensor, height: int, width: int, wrap: bool) -> torch.Tensor:
    return gradients.new_empty(gradients.shape[0], height, width, gradients.shape[3])


fold_into_batch(adjoint_of_gather)


# Queries that a thread takes on a CPU, where the vectors of so many fill its registers, and on a GPU.
BLOCKS = (4, 1)


def query_blocks(count: int, device: torch.device) -> list[tuple[int, slice]]:
    """Which queries go how many to a thread: on a CPU all but the odd ones at the end go in whole blocks."""
    whole = 0 if device.type == "cuda" else count - count % BLOCKS[0]
    parts = zip(BLOCKS, [(0, whole), (whole, count)], strict=True)
    return [(n, slice(*ends)) for n, ends in parts if ends[0] < ends[1]]


def channel_spans(blocks: int, device: torch.device) -> tuple[int, int]:
    """How many blocks of channels a thread handles, and how many threads that takes.

    A CPU core handles all; on a GPU each thread handles one, since neighbouring threads read together.
    """
    return (1, blocks) if device.type == "cuda" else (blocks, 1)


def check_queries(queries: torch.Tensor, like: torch.Tensor, name: str) -> None:
    """Raises unless `queries` is a floating (..., Q, 2) tensor on the device of `like`, the argument called `name`."""
    if not isinstance(queries, torch.Tensor):
        raise TypeError(f"queries is a {type(queries).__name__}; it should be a torch.Tensor (..., Q, 2)")
    if queries.ndim < 2 or queries.shape[-1] != 2:
        raise ValueError(
            f"queries has shape {tuple(queries.shape)}; it should be (..., Q, 2): row and column in pixels"
        )
    if not queries.is_floating_point():
        raise TypeError(f"queries is {queries.dtype}; it should be a floating-point tensor of pixel coordinates")
    if queries.device != like.device:
        raise ValueError(f"queries is on {queries.device}, {name} on {like.device}; they should be on one device")


def broadcast_batch(**named: tuple[torch.Tensor, int]) -> tuple[torch.Size, list[torch.Tensor]]:
    """Broadcasts leading dimensions and folds them into one.

    Args:
        **named: For each argument its tensor and how many trailing dimensions are not batch.

    Returns:
        The broadcast batch shape, and the tensors as (B, ...) in the order given.

    Raises:
        ValueError: If the batch shapes do not broadcast.
    """
    batches = {name: tensor.shape[: tensor.ndim - own] for name, (tensor, own) in named.items()}
    try:
        batch = torch.broadcast_shapes(*batches.values())
    except RuntimeError:
        shapes = ", ".join(f"{name} {tuple(shape)}" for name, shape in batches.items())
        raise ValueError(f"the batch dimensions do not broadcast: {shapes}") from None
    folded = []
    for tensor, own in named.values():
        shape = tensor.shape[tensor.ndim - own :]
        folded.append(tensor.expand(*batch, *shape).reshape(batch.numel(), *shape))
    return batch, folded
