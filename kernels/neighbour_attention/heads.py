"""neighbour_attention with one head of one query in a thread: for GPUs, float64 and other numbers of channels."""

from typing import Any

import torch
import warp as wp

from kernels.lanes import vectors
from kernels.neighbour_attention.maths import adj_squares, attend, attend_backward, stencil

__all__ = ["_attend", "_attend_backward"]


@wp.kernel(enable_backward=False)
def _attend_kernel(
    first: int,
    # in
    pixels: wp.array2d[Any],
    moments: wp.array2d[wp.Float],
    queries: wp.array2d[wp.Float],
    slope: wp.array2d[Any],
    shift: wp.array[Any],
    gram: wp.array2d[wp.Float],
    height: int,
    width: int,
    per_image: int,
    heads: int,
    four: int,
    eps: wp.Float,
    wrap: int,
    # out
    tokens_out: wp.array2d[Any],
    attended_out: wp.array2d[Any],
):
    thread = first + wp.tid()
    n = thread // heads
    g = thread % heads
    channels = shift.shape[0] // 3
    pixel, down, right, inverse = stencil(moments, queries, n, n // per_image, height, width, gram, channels, eps, wrap)
    attend(
        pixels, slope, shift, pixel, down, right, inverse, heads, heads, g, four, 4 * n, tokens_out, attended_out
    )  # fmt: skip


@wp.kernel(enable_backward=False)
def _attend_backward_kernel(
    first: int,
    # in
    pixels: wp.array2d[Any],
    moments: wp.array2d[wp.Float],
    queries: wp.array2d[wp.Float],
    slope: wp.array2d[Any],
    shift: wp.array[Any],
    gram: wp.array2d[wp.Float],
    height: int,
    width: int,
    per_image: int,
    heads: int,
    four: int,
    eps: wp.Float,
    wrap: int,
    adj_tokens: wp.array2d[Any],
    adj_attended: wp.array2d[Any],
    # out
    adj_pixels_out: wp.array2d[Any],
    attended_out: wp.array2d[Any],
    adj_squares_out: wp.array2d[wp.Float],
    coefficients_out: wp.array2d[wp.Float],
):
    thread = first + wp.tid()
    n = thread // heads
    g = thread % heads
    channels = shift.shape[0] // 3
    pixel, down, right, inverse = stencil(moments, queries, n, n // per_image, height, width, gram, channels, eps, wrap)
    adj_inverse = attend_backward(
        pixels, slope, shift, pixel, down, right, inverse, heads, heads, g, four,
        adj_tokens, adj_attended, 4 * n, adj_pixels_out, attended_out,
    )  # fmt: skip
    for t in range(four):
        adj_squares_out[4 * n + t, g] = adj_squares(adj_inverse[t], inverse[t], channels)
        if g == 0:
            coefficients_out[4 * n + t, 0] = down[t]
            coefficients_out[4 * n + t, 1] = right[t]
            coefficients_out[4 * n + t, 2] = type(eps)(1.0) / inverse[t]


def _concrete(kernel: wp.Kernel, scalar: type) -> wp.Kernel:
    known = {Any: vectors(1, scalar), wp.Float: scalar}
    types = []
    for argument in kernel.adj.args:
        dtype = getattr(argument.type, "dtype", None)
        generic = wp.array(dtype=known[dtype], ndim=argument.type.ndim) if dtype in known else argument.type
        types.append(known.get(generic, generic))
    return wp.overload(kernel, types)


_SCALARS = {torch.float32: wp.float32, torch.float64: wp.float64}
_attend = {dtype: _concrete(_attend_kernel, scalar) for dtype, scalar in _SCALARS.items()}
_attend_backward = {dtype: _concrete(_attend_backward_kernel, scalar) for dtype, scalar in _SCALARS.items()}
