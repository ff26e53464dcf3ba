"""fused_decode: the whole decoder of ILN at depth 1 on CPUs, from the table of pixels to the range of each query.

    t                                        after `kernels.neighbour_attention.block`
    s = hᵀ LN(t),   r̂ = Σ_t softmax(s + p)_t r_t

A few queries at a time go through all operations, and only ranges are written. Terms that are the same for all 4
neighbours, such as the bias of the score, are left out, since the softmax does not depend on them.
"""

from typing import Any

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
from kernels.lanes import LANES, total, vectors
from kernels.launch import launch
from kernels.neighbour_attention.block import (
    GROUP,
    WORKERS,
    DecoderWeights,
    Scratch,
    block,
    blocks_of,
    check_served,
    scratch_of,
    serves,
)
from kernels.neighbour_attention.maths import PIXEL_TABLES, stencil
from kernels.neighbour_attention.table import Projected, fields
from kernels.neighbour_attention.vectors import HEADS
from kernels.stencil import area
from kernels.vmap import refuse

__all__ = ["fused_decode", "fused_decode_serves"]

_GROUP = wp.constant(GROUP)

_BILINEAR = wp.constant(PRIORS.index("bilinear"))
_PERSPECTIVE = wp.constant(PRIORS.index("perspective"))
_RANGE_FLOOR = wp.constant(RANGE_FLOOR)

_lanes = vectors(LANES, wp.float32)
_pixel_table: Any = PIXEL_TABLES[_lanes]


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
    scratch_out: Scratch,
    blended_out: wp.array[float],
):
    thread = first + wp.tid()
    x = scratch_out.x
    row = thread * 4 * _GROUP
    last = wp.min((thread + 1) * share, queries.shape[0])
    for begin in range(thread * share, last, _GROUP):
        end = wp.min(begin + _GROUP, last)
        block(table, queries, weights, biases, begin, end, row, scratch_out)
        for n in range(begin, end):
            around = stencil(table, queries, n)
            scores = wp.vec4()
            ranges = wp.vec4()
            for t in range(4):
                i = row + 4 * (n - begin) + t
                score = _lanes()
                for c in range(biases.shape[1]):
                    score += wp.cw_mul(x[i, c], biases[3, c])
                scores[t] = total(score)[0]
                ranges[t] = blend.image[around.pixel[t]]
            blended_out[n] = _blend(scores, ranges, queries[n, 0], queries[n, 1], blend.prior, blend.area_floor)


def fused_decode_serves(projected: Projected) -> bool:
    """Whether `fused_decode` has a kernel for this table: float32 on a CPU, the paper's 8 heads, C a multiple of 16."""
    return serves(projected)


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
    blended = _empty_ranges(pixels, queries)
    share = -(-batch * count // WORKERS)
    table = fields(pixels, slope, shift, gram, HEADS, eps, wrap, per_image=count, groups=1)
    blend = {"image": image.view(-1), "prior": prior, "area_floor": area_floor}
    inputs = [table, queries.view(-1, 2), weights, biases, blend, share]
    outputs = [scratch_of(pixels, biases.shape[1]), blended.view(-1)]
    launch(_fused_decode_kernel, WORKERS, inputs, outputs, least=1)
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
    check_served(projected)
    pixels, slope, shift, gram, heads = projected
    with torch.no_grad(), torch.autocast(pixels.device.type, enabled=False):
        matrices, biases = blocks_of(weights, heads)
        score = weights.score[0] * weights.head_norm[0]
        rows = torch.cat((biases, score.float()))
        return _fused_decode(
            pixels.contiguous(), queries.to(pixels.dtype).contiguous(), slope, shift, gram, image.float().contiguous(),
            matrices, rows, PRIORS.index(prior), area_floor, eps, wrap,
        )  # fmt: skip
