"""fused_decode: the whole decoder of ILN at depth 1 on CPUs, from the table of pixels to the range of each query.

    t = z + Wq + b                           for each of the 4 neighbours
    t ← t + O attend(M LN(t))                `kernels.neighbour_attention.maths`
    t ← t + W₂ gelu(W₁ LN(t) + b₁) + b₂
    s = hᵀ LN(t),   r̂ = Σ_t softmax(s + p)_t r_t

A frame of 128×2048 queries has a million tokens of 64 numbers, and the decoder passes over them a dozen times. One
operation after the other, it would wait for memory. Here a thread takes a few queries at a time through all operations:
their tokens stay in the cache of its core, and only ranges are written.

γ and β of the layer norms are multiplied into the weights behind them. Terms that are the same for all 4 neighbours,
such as the bias of the score, are left out, since the softmax does not depend on them.
"""

from typing import Any, NamedTuple

import torch
import warp as wp

from kernels import reference
from kernels.checks import (
    PRIORS,
    RANGE_FLOOR,
    check_area_floor,
    check_backend,
    check_devices,
    check_prior,
    check_queries,
)
from kernels.lanes import LANES, add_products, gelu, rsqrt, total, vectors
from kernels.launch import launch
from kernels.neighbour_attention.maths import PIXEL_TABLES, attend, stencil
from kernels.neighbour_attention.table import Projected, fields, head_last
from kernels.neighbour_attention.vectors import HEADS, fits
from kernels.stencil import area
from kernels.vmap import refuse

__all__ = ["DecoderWeights", "fused_decode", "fused_decode_serves"]

# Threads among which the queries are split, and how many queries a thread takes at a time. The tokens of so many fit
# the cache of a core, and it reads each layer's weights once for all of them.
_WORKERS = 64
_GROUP = wp.constant(16)

_BILINEAR = wp.constant(PRIORS.index("bilinear"))
_PERSPECTIVE = wp.constant(PRIORS.index("perspective"))
_RANGE_FLOOR = wp.constant(RANGE_FLOOR)

_lanes = vectors(LANES, wp.float32)
_pixel_table: Any = PIXEL_TABLES[_lanes]


@wp.func
def _normalise(x: wp.array2d[_lanes], row: int, eps: float, y_out: wp.array2d[_lanes]):
    """Layer norm of a row, without weight and bias."""
    channels = float(LANES * x.shape[1])
    sums = _lanes()
    for c in range(x.shape[1]):
        sums += x[row, c]
    mean = total(sums) / channels
    squares = _lanes()
    for c in range(x.shape[1]):
        centred = x[row, c] - mean
        squares += wp.cw_mul(centred, centred)
    variance = total(squares) / channels
    for i in range(LANES):
        variance[i] = variance[i] + eps
    inverse = rsqrt(variance)
    for c in range(x.shape[1]):
        y_out[row, c] = wp.cw_mul(x[row, c] - mean, inverse)


@wp.func
def _blend(scores: wp.vec4, ranges: wp.vec4, row: float, column: float, prior: int, area_floor: float):
    """softmax(s + p) · r, as in `kernels.gather_blend`."""
    factor = wp.vec4(1.0, 1.0, 1.0, 1.0)  # exp(p) instead of p: an area of 0 needs no logarithm
    largest = float(-wp.inf)
    for t in range(4):
        if prior >= _BILINEAR:
            factor[t] = wp.max(area(row, column, t), area_floor)
        if prior == _PERSPECTIVE:
            factor[t] = factor[t] / wp.max(ranges[t], _RANGE_FLOOR)
        if factor[t] > 0.0:
            largest = wp.max(largest, scores[t])
    for t in range(4):
        if factor[t] > 0.0:
            factor[t] = factor[t] * wp.exp(scores[t] - largest)
    return wp.dot(factor, ranges) / (factor[0] + factor[1] + factor[2] + factor[3])


@wp.struct
class _Scratch:
    """Memory of the threads: each has 4·_GROUP rows, one for each neighbour of its queries."""

    tokens: wp.array2d[_lanes]
    """(rows, blocks): t."""
    x: wp.array2d[_lanes]
    """(rows, blocks): the input of the next layer."""
    x_scalars: wp.array2d[float]
    """(rows, C): the same memory, number by number."""
    h: wp.array2d[_lanes]
    """(rows, blocks): the hidden layer."""
    h_scalars: wp.array2d[float]
    """(rows, C): the same memory, number by number."""


@wp.struct
class _Blend:
    """What turns scores into a range."""

    image: wp.array[float]
    """(B·H·W,): ranges r, metres."""
    prior: int
    """Index of the prior in `PRIORS`."""
    area_floor: float
    """Least bilinear area in the prior."""


@wp.kernel(enable_backward=False)
def _fused_decode_kernel(
    first: int,
    # in
    table: _pixel_table,
    queries: wp.array2d[float],
    weights: wp.array3d[_lanes],
    biases: wp.array2d[_lanes],
    blend: _Blend,
    share: int,
    # out
    scratch_out: _Scratch,
    blended_out: wp.array[float],
):
    thread = first + wp.tid()
    tokens = scratch_out.tokens
    x = scratch_out.x
    h = scratch_out.h
    blocks = biases.shape[1]
    row = thread * 4 * _GROUP
    last = wp.min((thread + 1) * share, queries.shape[0])
    for begin in range(thread * share, last, _GROUP):
        end = wp.min(begin + _GROUP, last)
        stop = row + 4 * (end - begin)
        for n in range(begin, end):
            around = stencil(table, queries, n)
            attend(table, around, 0, row + 4 * (n - begin), tokens, x)
        for i in range(row, stop):
            for c in range(blocks):
                tokens[i, c] = tokens[i, c] + biases[0, c]
        for i in range(row, stop, 4):
            add_products(scratch_out.x_scalars, weights[0], i, tokens)
        for i in range(row, stop):
            _normalise(tokens, i, table.eps, x)
            for c in range(blocks):
                h[i, c] = biases[1, c]
        for i in range(row, stop, 4):
            add_products(scratch_out.x_scalars, weights[1], i, h)
        for i in range(row, stop):
            for c in range(blocks):
                h[i, c] = gelu(h[i, c])
                tokens[i, c] = tokens[i, c] + biases[2, c]
        for i in range(row, stop, 4):
            add_products(scratch_out.h_scalars, weights[2], i, tokens)
        for n in range(begin, end):
            around = stencil(table, queries, n)
            scores = wp.vec4()
            ranges = wp.vec4()
            for t in range(4):
                i = row + 4 * (n - begin) + t
                _normalise(tokens, i, table.eps, x)
                score = _lanes()
                for c in range(blocks):
                    score += wp.cw_mul(x[i, c], biases[3, c])
                scores[t] = total(score)[0]
                ranges[t] = blend.image[around.pixel[t]]
            blended_out[n] = _blend(scores, ranges, queries[n, 0], queries[n, 1], blend.prior, blend.area_floor)


class DecoderWeights(NamedTuple):
    """Weights of the decoder behind its attention, on the device of the table; shapes (out, in) as in `torch.nn`."""

    output: tuple[torch.Tensor, torch.Tensor]
    """O (C, C) and its bias (C,)."""
    norm: tuple[torch.Tensor, torch.Tensor]
    """Weight and bias (C,) of the feed-forward's layer norm."""
    hidden: tuple[torch.Tensor, torch.Tensor]
    """W₁ (C, C) and b₁ (C,)."""
    back: tuple[torch.Tensor, torch.Tensor]
    """W₂ (C, C) and b₂ (C,)."""
    head_norm: tuple[torch.Tensor, torch.Tensor]
    """Weight and bias (C,) of the head's layer norm."""
    score: tuple[torch.Tensor, torch.Tensor]
    """h (1, C) and its bias (1,)."""

    def named(self) -> dict[str, torch.Tensor]:
        """Returns the tensors by the names that errors give them."""
        return {f"weights.{name}[{i}]": pair[i] for name, pair in self._asdict().items() for i in range(2)}


def fused_decode_serves(projected: Projected) -> bool:
    """Whether `fused_decode` has a kernel for this table: float32 on a CPU, the paper's 8 heads, C a multiple of 64."""
    return fits(projected.pixels, torch.float32, len(projected.shift) // 3, projected.heads)


def _empty_ranges(pixels: torch.Tensor, queries: torch.Tensor, *_: Any) -> torch.Tensor:
    return pixels.new_empty(queries.shape[:2])


@torch.library.custom_op("kernels::fused_decode", mutates_args=())
def _fused_decode(
    pixels: torch.Tensor,
    queries: torch.Tensor,
    slope: torch.Tensor,
    shift: torch.Tensor,
    gram: torch.Tensor,
    image: torch.Tensor,
    weights: torch.Tensor,
    biases: torch.Tensor,
    prior: int,
    area_floor: float,
    eps: float,
    wrap: bool,
) -> torch.Tensor:
    batch, count, _ = queries.shape
    channels = biases.shape[1]
    blended = _empty_ranges(pixels, queries)
    tokens, x, h = pixels.new_empty(3, 4 * _GROUP * _WORKERS, channels)
    share = -(-batch * count // _WORKERS)
    table = fields(pixels, slope, shift, gram, HEADS, eps, wrap, per_image=count, groups=1)
    blend = {"image": image.view(-1), "prior": prior, "area_floor": area_floor}
    scratch = {"tokens": tokens, "x": x, "x_scalars": x, "h": h, "h_scalars": h}
    inputs = [table, queries.view(-1, 2), weights, biases, blend, share]
    launch(_fused_decode_kernel, _WORKERS, inputs, [scratch, blended.view(-1)], least=1)
    return blended


_fused_decode.register_fake(_empty_ranges)
refuse(_fused_decode, "its image and queries have a batch dimension for that")


def fused_decode(
    projected: Projected,
    image: torch.Tensor,
    queries: torch.Tensor,
    weights: DecoderWeights,
    prior: str = "none",
    wrap: bool = True,
    *,
    area_floor: float = 0.0,
    eps: float = 1e-5,
    backend: str = "warp",
) -> torch.Tensor:
    """Predicts the range of each query: attention, feed-forward, scores and blend in one pass.

    It is for inference and gives no gradients.

    Args:
        projected: The features after `project_pixels`; `fused_decode_serves` says which are served.
        image: (B, H, W) float32 ranges in metres, no return filled.
        queries: (B, Q, 2) pixel coordinates (row, column). Those beyond ±2^30 count as ±2^30.
        weights: Weights of the decoder.
        prior: As in `gather_blend`.
        wrap: Whether column W-1 meets column 0 (a full circle). Otherwise columns clamp; rows always clamp.
        area_floor: As in `gather_blend`.
        eps: ε of the layer norms.
        backend: "warp", or "torch" for the plain twin in `kernels.reference`, which serves any table.

    Returns:
        (B, Q) float32 metres.

    Raises:
        TypeError: If `queries` is not a floating-point tensor.
        ValueError: If the table is not served, or a shape, device, prior, floor or backend does not fit.

    Source: paper Fig. 3 and Eq. 3.
    """
    check_backend(backend)
    check_prior(prior)
    check_area_floor(area_floor)
    check_queries(queries)
    check_devices(**projected.named(), image=image, queries=queries, **weights.named())
    batch, height, width, _ = projected.pixels.shape
    if image.shape != (batch, height, width):
        raise ValueError(f"image has shape {tuple(image.shape)}; it should be {(batch, height, width)}")
    if queries.ndim != 3 or len(queries) != batch:
        raise ValueError(f"queries has shape {tuple(queries.shape)}; it should be ({batch}, Q, 2)")
    if backend == "torch":
        return reference.fused_decode(projected, image, queries, weights, prior, wrap, area_floor, eps)
    if not fused_decode_serves(projected):
        pixels, heads, channels = projected.pixels, projected.heads, len(projected.shift) // 3
        raise ValueError(
            f"projected is {pixels.dtype} on {pixels.device} with {heads} heads and {channels} channels; it should be "
            f"torch.float32 on cpu with {HEADS} heads and a multiple of 64 channels, or backend='torch'"
        )
    pixels, slope, shift, gram, heads = projected
    with torch.no_grad(), torch.autocast(pixels.device.type, enabled=False):
        (gamma, beta), (w1, b1), (head_gamma, _) = weights.norm, weights.hidden, weights.head_norm
        output = head_last(weights.output[0], heads)
        matrices = torch.stack((output.T, (w1 * gamma).T, weights.back[0].T)).float()
        rows = torch.stack(
            (weights.output[1], w1 @ beta + b1, weights.back[1], weights.score[0][0] * head_gamma)
        ).float()
        return _fused_decode(
            pixels.contiguous(), queries.to(pixels.dtype).contiguous(), slope, shift, gram, image.float().contiguous(),
            matrices, rows, PRIORS.index(prior), area_floor, eps, wrap,
        )  # fmt: skip
