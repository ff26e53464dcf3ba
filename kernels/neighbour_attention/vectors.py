"""neighbour_attention on CPU cores: each query from the table of pixels to its tokens without leaving the cache.

The output projection is done 4 tokens at a time, in registers, by the thread that attended. In the backward pass a
thread has a row of cells to itself (`kernels.scatter.cell`), whose queries it takes in order: what they say of the
two rows of pixels around them it adds up in place, so that the result does not depend on the number of cores, and
nothing that is as large as the tokens need be kept from the forward pass.
"""

from typing import Any

import torch
import warp as wp

from kernels.lanes import LANES, add_outer, add_products, vectors
from kernels.launch import launch
from kernels.neighbour_attention.maths import MOMENTS, adj_squares, attend, attend_backward, stencil
from kernels.scatter import sort_queries

__all__ = ["HEADS", "arguments", "fits", "step", "step_backward"]

# Threads that share the queries of a forward pass. Each has a few rows of memory to itself.
_WORKERS = 64

# Two channels of each fill the lanes.
HEADS = LANES // 2

_lanes = vectors(LANES, wp.float32)


@wp.kernel(enable_backward=False)
def _step_kernel(
    first: int,
    # in
    pixels: wp.array2d[_lanes],
    moments: wp.array2d[float],
    queries: wp.array2d[float],
    slope: wp.array2d[_lanes],
    shift: wp.array[_lanes],
    gram: wp.array2d[float],
    height: int,
    width: int,
    per_image: int,
    heads: int,
    four: int,
    eps: float,
    wrap: int,
    weight: wp.array2d[_lanes],
    bias: wp.array[_lanes],
    attended_scalars: wp.array2d[float],
    share: int,
    # out
    tokens_out: wp.array2d[_lanes],
    attended_out: wp.array2d[_lanes],
    step_out: wp.array2d[Any],
):
    worker = first + wp.tid()
    row = 4 * worker
    blocks = bias.shape[0]
    for n in range(worker * share, wp.min((worker + 1) * share, queries.shape[0])):
        pixel, down, right, inverse = stencil(
            moments, queries, n, n // per_image, height, width, gram, 16 * blocks, eps, wrap
        )
        attend(
            pixels, slope, shift, pixel, down, right, inverse, heads, 1, 0, four, row, tokens_out, attended_out
        )  # fmt: skip
        for c in range(blocks):
            for t in range(4):
                tokens_out[row + t, c] = tokens_out[row + t, c] + bias[c]
        add_products(attended_scalars, weight, row, tokens_out)
        for c in range(blocks):
            for t in range(4):
                step_out[4 * n + t, c] = step_out.dtype(tokens_out[row + t, c])


@wp.kernel(enable_backward=False)
def _step_backward_kernel(
    first: int,
    # in
    pixels: wp.array2d[_lanes],
    moments: wp.array2d[float],
    queries: wp.array2d[float],
    slope: wp.array2d[_lanes],
    shift: wp.array[_lanes],
    gram: wp.array2d[float],
    height: int,
    width: int,
    per_image: int,
    heads: int,
    four: int,
    eps: float,
    wrap: int,
    weight: wp.array2d[_lanes],
    adj_step: wp.array2d[Any],
    adj_scalars: wp.array2d[float],
    order: wp.array[wp.int32],
    starts: wp.array[wp.int32],
    parity: int,
    # out
    adj_rows_out: wp.array2d[_lanes],
    adj_attended_out: wp.array2d[_lanes],
    attended_out: wp.array2d[_lanes],
    rows_out: wp.array2d[_lanes],
    adj_pixels_out: wp.array2d[_lanes],
    adj_moments_out: wp.array2d[float],
    adj_affine_out: wp.array2d[_lanes],
    adj_gram_out: wp.array2d[float],
    adj_weight_out: wp.array2d[_lanes],
    adj_bias_out: wp.array2d[_lanes],
):
    band = 2 * (first + wp.tid()) + parity
    row = 4 * band
    blocks = weight.shape[1]
    for s in range(starts[band * (width + 1)], starts[(band + 1) * (width + 1)]):
        n = order[s]
        for t in range(four):
            for c in range(blocks):
                gradient = adj_rows_out.dtype(adj_step[4 * n + t, c])
                adj_rows_out[row + t, c] = gradient
                adj_bias_out[band, c] = adj_bias_out[band, c] + gradient
                adj_attended_out[row + t, c] = _lanes()
        add_products(adj_scalars, weight, row, adj_attended_out)
        pixel, down, right, inverse = stencil(
            moments, queries, n, n // per_image, height, width, gram, 16 * blocks, eps, wrap
        )
        adj_inverse = attend_backward(
            pixels, slope, shift, pixel, down, right, inverse, heads, 1, 0, four,
            adj_rows_out, adj_attended_out, row, rows_out, attended_out,
        )  # fmt: skip
        add_outer(adj_scalars, attended_out, row, 16 * blocks * band, adj_weight_out)
        for t in range(four):
            squares = adj_squares(adj_inverse[t], inverse[t], 16 * blocks)
            p = pixel[t]
            adj_moments_out[p, 0] = adj_moments_out[p, 0] + squares
            squares_down = squares * down[t]
            squares_right = squares * right[t]
            adj_moments_out[p, 1] = adj_moments_out[p, 1] + squares_down + squares_down
            adj_moments_out[p, 2] = adj_moments_out[p, 2] + squares_right + squares_right
            adj_gram_out[band, 0] = adj_gram_out[band, 0] + squares_down * down[t]
            adj_gram_out[band, 1] = adj_gram_out[band, 1] + squares_down * right[t]
            adj_gram_out[band, 2] = adj_gram_out[band, 2] + squares_right * right[t]
            deviation = 1.0 / inverse[t]
            for c in range(4 * blocks):
                x = rows_out[row + t, c]
                adj_pixels_out[p, c] = adj_pixels_out[p, c] + x
                adj_affine_out[3 * band, c] = adj_affine_out[3 * band, c] + x * down[t]
                adj_affine_out[3 * band + 1, c] = adj_affine_out[3 * band + 1, c] + x * right[t]
                adj_affine_out[3 * band + 2, c] = adj_affine_out[3 * band + 2, c] + x * deviation


def _concrete(kernel: wp.Kernel, stored: type) -> wp.Kernel:
    types = []
    for argument in kernel.adj.args:
        generic = getattr(argument.type, "dtype", None) is Any
        types.append(wp.array2d(dtype=wp.types.vector(LANES, stored)) if generic else argument.type)
    return wp.overload(kernel, types)


_STORED = {torch.float32: wp.float32, torch.bfloat16: wp.bfloat16}
_step = {dtype: _concrete(_step_kernel, stored) for dtype, stored in _STORED.items()}
_step_backward = {dtype: _concrete(_step_backward_kernel, stored) for dtype, stored in _STORED.items()}


def fits(pixels: torch.Tensor, dtype: torch.dtype, channels: int, heads: int) -> bool:
    """Whether these kernels serve: on a CPU, the paper's 8 heads, whole blocks of 4×16 channels."""
    return (
        heads == HEADS
        and channels % (4 * LANES) == 0
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
    """(B, Q, 4, C) tokens after the step; the arguments are those of the op `neighbour_attention`."""
    batch, count, channels = len(pixels), queries.shape[1], len(bias)
    tokens = pixels.new_empty(batch, count, 4, channels, dtype=dtype)
    scratch = pixels.new_empty(2, 4 * _WORKERS, channels)
    share = -(-batch * count // _WORKERS)
    launch(
        _step[dtype],
        _WORKERS,
        [
            *arguments(pixels, queries, slope, shift, gram, heads, eps, wrap),
            weight.T.contiguous(),
            bias,
            scratch[1],
            share,
        ],
        [scratch[0], scratch[1], tokens.view(-1, channels)],
        least=1,
    )
    return tokens


def arguments(
    pixels: torch.Tensor,
    queries: torch.Tensor,
    slope: torch.Tensor,
    shift: torch.Tensor,
    gram: torch.Tensor,
    heads: int,
    eps: float,
    wrap: bool,
) -> list:
    """What all kernels of the step take first."""
    _, height, width, columns = pixels.shape
    table = pixels.reshape(-1, columns)
    moments = table[:, columns - MOMENTS : columns - MOMENTS + 3]
    sizes = [height, width, queries.shape[1], heads, 4]
    return [table, moments, queries.reshape(-1, 2), slope, shift, gram, *sizes, eps, int(wrap)]


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
    """Gradients of pixels, slope, shift, gram, weight and bias; the arguments are those of the op's backward."""
    batch, height, width, columns = pixels.shape
    channels = len(weight)
    order, starts = sort_queries(queries, height, width, wrap)
    bands = batch * (height + 1)
    scratch = pixels.new_empty(7, 4 * bands, channels)
    adj_pixels = torch.zeros_like(pixels)
    adj_table = adj_pixels.view(-1, columns)
    adj_affine = pixels.new_zeros(bands, 3, 4 * channels)
    adj_gram = pixels.new_zeros(bands, 3)
    adj_weight = pixels.new_zeros(bands, channels, channels)
    adj_bias = pixels.new_zeros(bands, channels)
    for parity in range(2):  # bands next to each other share a row of pixels
        launch(
            _step_backward[adj_step.dtype],
            (bands + 1 - parity) // 2,
            [
                *arguments(pixels, queries, slope, shift, gram, heads, eps, wrap),
                *(weight, adj_step.reshape(-1, channels).contiguous(), scratch[0], order, starts, parity),
            ],
            [
                *(scratch[0], scratch[1], scratch[2], scratch[3:].view(-1, 4 * channels)),
                *(
                    adj_table,
                    adj_table[:, 4 * channels : 4 * channels + 3],
                    adj_affine.view(-1, 4 * channels),
                    adj_gram,
                ),
                *(adj_weight.view(-1, channels), adj_bias),
            ],
            least=1,
        )
    affine, (down, both, right) = adj_affine.sum(0), adj_gram.sum(0)
    gram = torch.stack((down, both, both, right)).view(2, 2)
    return adj_pixels, affine[:2].clone(), affine[2, : 3 * channels].clone(), gram, adj_weight.sum(0), adj_bias.sum(0)
