"""Kernels of neighbour_attention whose threads take all heads of a query: for CPUs, float32 and the paper's 8 heads.

A thread takes one query after the other from the table of pixels to its tokens, which stay in the cache of its core. It
does the output projection as well, 4 tokens at a time in registers.

In the backward pass a thread takes the queries of one band: a row of cells (`kernels.scatter`) between two rows of
pixels. It computes their attention again and adds their gradients to those two rows in place. The queries are sorted,
so that the result does not depend on the number of cores. Nothing as large as the tokens is kept from the forward pass.
"""

from typing import Any

import torch
import warp as wp

from kernels.lanes import LANES, add_outer, add_products, vectors
from kernels.launch import concrete, launch
from kernels.neighbour_attention.maths import PIXEL_TABLES, adj_squares, attend, attend_backward, stencil
from kernels.neighbour_attention.table import fields
from kernels.scatter import sort_queries

__all__ = ["HEADS", "fits", "step", "step_backward"]

# Threads among which the queries of a forward pass are split. Each has a few rows of memory of its own.
_WORKERS = 64

# Number of heads: two channels of each fill a vector.
HEADS = LANES // 2

_lanes = vectors(LANES, wp.float32)
_pixel_table: Any = PIXEL_TABLES[_lanes]


@wp.struct
class _Scratch:
    """Memory of the threads of the forward pass: rows 4 i to 4 i + 3 belong to thread i."""

    tokens: wp.array2d[_lanes]
    """(4·threads, blocks): t."""
    attended: wp.array2d[_lanes]
    """(4·threads, blocks): the attended values."""
    attended_scalars: wp.array2d[float]
    """(4·threads, C): the same memory, number by number."""


@wp.struct
class _BackwardScratch:
    """Memory of the threads of the backward pass: rows 4 i to 4 i + 3 belong to thread i."""

    adj_tokens: wp.array2d[_lanes]
    """(4·threads, blocks): gradient of t, which is that of the result."""
    adj_tokens_scalars: wp.array2d[float]
    """(4·threads, C): the same memory, number by number."""
    adj_attended: wp.array2d[_lanes]
    """(4·threads, blocks): gradient of the attended values."""
    attended: wp.array2d[_lanes]
    """(4·threads, blocks): the attended values."""
    adj_rows: wp.array2d[_lanes]
    """(4·threads, 4·blocks): gradients of A + B q and of z + Wq + b."""


@wp.struct
class _Gradients:
    """Sums of gradients: of the pixels in place, of the parameters in a row for each thread."""

    pixels: wp.array2d[_lanes]
    """(B·H·W, 4·blocks and padding): of `PixelTable.pixels`."""
    moments: wp.array2d[float]
    """(B·H·W, 3): of `PixelTable.moments`; the same memory."""
    affine: wp.array2d[_lanes]
    """(3·threads, 4·blocks): of the two rows of `PixelTable.slope`, and of `PixelTable.shift`."""
    gram: wp.array2d[float]
    """(threads, 3): of N₁₁, N₁₂ and N₂₂."""
    weight: wp.array2d[_lanes]
    """(C·threads, blocks): of O."""
    bias: wp.array2d[_lanes]
    """(threads, blocks): of the bias of O."""


@wp.kernel(enable_backward=False)
def _step_kernel(
    first: int,
    # in
    table: _pixel_table,
    queries: wp.array2d[float],
    weight: wp.array2d[_lanes],
    bias: wp.array[_lanes],
    share: int,
    # out
    scratch_out: _Scratch,
    step_out: wp.array2d[Any],
):
    thread = first + wp.tid()
    row = 4 * thread
    tokens = scratch_out.tokens
    blocks = bias.shape[0]
    for n in range(thread * share, wp.min((thread + 1) * share, queries.shape[0])):
        around = stencil(table, queries, n)
        attend(table, around, 0, row, tokens, scratch_out.attended)
        for c in range(blocks):
            for t in range(4):
                tokens[row + t, c] = tokens[row + t, c] + bias[c]
        add_products(scratch_out.attended_scalars, weight, row, tokens)
        for c in range(blocks):
            for t in range(4):
                step_out[4 * n + t, c] = step_out.dtype(tokens[row + t, c])


@wp.kernel(enable_backward=False)
def _step_backward_kernel(
    first: int,
    # in
    table: _pixel_table,
    queries: wp.array2d[float],
    weight: wp.array2d[_lanes],
    adj_step: wp.array2d[Any],
    order: wp.array[wp.int32],
    starts: wp.array[wp.int32],
    parity: int,
    # out
    scratch_out: _BackwardScratch,
    gradients_out: _Gradients,
):
    thread = first + wp.tid()
    band = 2 * thread + parity
    row = 4 * band
    blocks = weight.shape[1]
    scratch = scratch_out
    of = gradients_out
    for s in range(starts[band * (table.grid.width + 1)], starts[(band + 1) * (table.grid.width + 1)]):
        n = order[s]
        for t in range(table.rolled_four):
            for c in range(blocks):
                gradient = _lanes(adj_step[4 * n + t, c])
                scratch.adj_tokens[row + t, c] = gradient
                of.bias[band, c] = of.bias[band, c] + gradient
                scratch.adj_attended[row + t, c] = _lanes()
        add_products(scratch.adj_tokens_scalars, weight, row, scratch.adj_attended)
        around = stencil(table, queries, n)
        adj_inverse = attend_backward(
            table, around, 0, row, scratch.adj_tokens, scratch.adj_attended, scratch.adj_rows, scratch.attended
        )
        add_outer(scratch.adj_tokens_scalars, scratch.attended, row, table.channels * band, of.weight)
        for t in range(table.rolled_four):
            squares = adj_squares(table, around, t, adj_inverse[t])
            p = around.pixel[t]
            down = around.down[t]
            right = around.right[t]
            of.moments[p, 0] = of.moments[p, 0] + squares
            of.moments[p, 1] = of.moments[p, 1] + 2.0 * squares * down
            of.moments[p, 2] = of.moments[p, 2] + 2.0 * squares * right
            of.gram[band, 0] = of.gram[band, 0] + squares * down * down
            of.gram[band, 1] = of.gram[band, 1] + squares * down * right
            of.gram[band, 2] = of.gram[band, 2] + squares * right * right
            deviation = 1.0 / around.inverse[t]
            for c in range(4 * blocks):
                x = scratch.adj_rows[row + t, c]
                of.pixels[p, c] = of.pixels[p, c] + x
                of.affine[3 * band, c] = of.affine[3 * band, c] + x * down
                of.affine[3 * band + 1, c] = of.affine[3 * band + 1, c] + x * right
                of.affine[3 * band + 2, c] = of.affine[3 * band + 2, c] + x * deviation


_STORED = {torch.float32: wp.float32, torch.bfloat16: wp.bfloat16}
_step, _step_backward = (
    {dtype: concrete(kernel, {Any: wp.types.vector(LANES, stored)}) for dtype, stored in _STORED.items()}
    for kernel in (_step_kernel, _step_backward_kernel)
)


def fits(pixels: torch.Tensor, dtype: torch.dtype, channels: int, heads: int) -> bool:
    """Whether these kernels serve: float32 on a CPU, 8 heads, C a multiple of 16, and a result in `dtype`."""
    return (
        heads == HEADS
        and channels % LANES == 0
        and pixels.device.type == "cpu"
        and pixels.dtype == torch.float32
        and dtype in _STORED
    )


def step(
    pixels: torch.Tensor,
    queries: torch.Tensor,
    slope: torch.Tensor,
    shift: torch.Tensor,
    gram: torch.Tensor,
    weight: torch.Tensor,
    bias: torch.Tensor,
    heads: int,
    eps: float,
    wrap: bool,
    dtype: torch.dtype,
) -> torch.Tensor:
    """Returns the (B, Q, 4, C) tokens after the step; its arguments are those of the op."""
    batch, count, channels = len(pixels), queries.shape[1], len(bias)
    step = pixels.new_empty(batch, count, 4, channels, dtype=dtype)
    tokens, attended = pixels.new_empty(2, 4 * _WORKERS, channels)
    table = fields(pixels, slope, shift, gram, heads, eps, wrap, per_image=count, groups=1)
    share = -(-batch * count // _WORKERS)
    scratch = {"tokens": tokens, "attended": attended, "attended_scalars": attended}
    inputs = [table, queries.view(-1, 2), weight.T.contiguous(), bias, share]
    launch(_step[dtype], _WORKERS, inputs, [scratch, step.view(-1, channels)], least=1)
    return step


def step_backward(
    pixels: torch.Tensor,
    queries: torch.Tensor,
    slope: torch.Tensor,
    shift: torch.Tensor,
    gram: torch.Tensor,
    weight: torch.Tensor,
    adj_step: torch.Tensor,
    heads: int,
    eps: float,
    wrap: bool,
) -> tuple[torch.Tensor, ...]:
    """Returns the gradients of pixels, slope, shift, gram, weight and bias; its arguments are the backward op's."""
    batch, height, width, columns = pixels.shape
    count, channels = queries.shape[1], len(weight)
    order, starts = sort_queries(queries, height, width, wrap)
    bands = batch * (height + 1)
    scratch = pixels.new_empty(7, 4 * bands, channels)
    adj_pixels = torch.zeros_like(pixels)
    adj_affine = pixels.new_zeros(bands, 3, 4 * channels)
    adj_gram = pixels.new_zeros(bands, 3)
    adj_weight = pixels.new_zeros(bands, channels, channels)
    adj_bias = pixels.new_zeros(bands, channels)
    adj_table = adj_pixels.view(-1, columns)
    inputs = [
        fields(pixels, slope, shift, gram, heads, eps, wrap, per_image=count, groups=1),
        *(queries.view(-1, 2), weight, adj_step.reshape(-1, channels).contiguous(), order, starts),
    ]
    rows = {
        "adj_tokens": scratch[0],
        "adj_tokens_scalars": scratch[0],
        "adj_attended": scratch[1],
        "attended": scratch[2],
        "adj_rows": scratch[3:].view(-1, 4 * channels),
    }
    gradients = {
        "pixels": adj_table,
        "moments": adj_table[:, 4 * channels : 4 * channels + 3],
        "affine": adj_affine.view(-1, 4 * channels),
        "gram": adj_gram,
        "weight": adj_weight.view(-1, channels),
        "bias": adj_bias,
    }
    for parity in range(2):  # even bands, then odd ones: two neighbouring bands add to the same row of pixels
        threads = (bands + 1 - parity) // 2
        launch(_step_backward[adj_step.dtype], threads, [*inputs, parity], [rows, gradients], least=1)
    affine, (down, both, right) = adj_affine.sum(0), adj_gram.sum(0)
    gram = torch.stack((down, both, both, right)).view(2, 2)
    return adj_pixels, affine[:2].clone(), affine[2, : 3 * channels].clone(), gram, adj_weight.sum(0), adj_bias.sum(0)
