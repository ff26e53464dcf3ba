"""fused_surfaces: the whole decoder over surfaces on CPUs, from the table of pixels to the answer to each query.

    t                                        after `kernels.neighbour_attention.block`
    (s_t1, ..., s_t9, c_t) = H LN(t) + b     for each of the 4 neighbours
    median and support                       of `kernels.surfaces.maths`

A few queries at a time go through all operations, and only answers are written. Up to the head, the lanes of a vector
are channels of one token; behind it, they are the same number of 16 queries.
"""

from typing import Any

import torch
import torch.nn.functional as F
import warp as wp

from kernels import reference
from kernels.checks import KINDS, check_backend, check_devices, check_floating, check_queries
from kernels.lanes import LANES, add_products, vectors
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
from kernels.neighbour_attention.maths import PIXEL_TABLES
from kernels.neighbour_attention.table import Projected, fields
from kernels.neighbour_attention.vectors import HEADS
from kernels.stencil import query_of
from kernels.surfaces.maths import RAYS, hypotheses, load, settle, store, weigh
from kernels.surfaces.op import rays_of
from kernels.vmap import refuse

__all__ = ["fused_surfaces", "fused_surfaces_serves"]

_GROUP = wp.constant(GROUP)
_KINDS = wp.constant(KINDS)

_lanes = vectors(LANES, wp.float32)
_many, _four, _two, _single = (wp.types.matrix((rows, LANES), wp.float32) for rows in (4 * KINDS, 4, 2, 1))
_pixel_table: Any = PIXEL_TABLES[_lanes]
_rays: Any = RAYS[wp.float32]


@wp.struct
class _Answers:
    """What is written for each query."""

    ranges: wp.array3d[float]
    """(B, Q, 1) metres, 0 for no return."""
    support: wp.array3d[float]
    """(B, Q, 4): the probability that each neighbour's surface is met there."""
    none: wp.array3d[float]
    """(B, Q, 1): the probability that nothing returns."""


@wp.func
def _head(head: wp.array2d[_lanes], bias: wp.array[_lanes], row: int, count: int, scratch_out: Scratch):
    """Scores and scales of the queries whose LN(t) are in `x` from `row`; a query in each lane, 9 t + k in the rows."""
    h = scratch_out.h
    for i in range(row, row + 4 * count):
        h[i, 0] = bias[0]
    for i in range(row, row + 4 * count, 4):
        add_products(scratch_out.x_scalars, head, i, h)
    scores = _many()
    scales = _four()
    for q in range(count):
        for t in range(4):
            for k in range(_KINDS):
                scores[_KINDS * t + k, q] = scratch_out.h_scalars[row + 4 * q + t, k]
            scales[t, q] = scratch_out.h_scalars[row + 4 * q + t, _KINDS]
    return scores, scales


@wp.kernel(enable_backward=False)
def _fused_surfaces_kernel(
    first: int,
    # in
    table: _pixel_table,
    queries: wp.array2d[float],
    weights: wp.array3d[_lanes],
    biases: wp.array2d[_lanes],
    head: wp.array2d[_lanes],
    head_bias: wp.array[_lanes],
    rays: _rays,
    share: int,
    # out
    scratch_out: Scratch,
    answers_out: _Answers,
):
    thread = first + wp.tid()
    row = thread * 4 * _GROUP
    groups = (table.per_image + _GROUP - 1) // _GROUP
    for group in range(thread * share, wp.min((thread + 1) * share, groups * rays.image.shape[0])):
        b, number = query_of(group, groups)
        begin = number * _GROUP
        count = wp.min(_GROUP, table.per_image - begin)
        n = b * table.per_image + begin
        block(table, queries, weights, biases, n, n + count, row, scratch_out)
        scores, scales = _head(head, head_bias, row, count, scratch_out)
        at = load(rays.queries, b, begin, _two())
        w = weigh(scores, at[0], at[1], rays.rolled_four)
        found = hypotheses(rays, b, at[0], at[1], _many())
        median, support, none = settle(found, w, scales, rays.rolled_four)
        answer = _single()
        answer[0] = median
        store(answer, b, begin, answers_out.ranges)
        store(support, b, begin, answers_out.support)
        answer[0] = none
        store(answer, b, begin, answers_out.none)


def fused_surfaces_serves(projected: Projected) -> bool:
    """Whether `fused_surfaces` has a kernel for a table: float32 on a CPU, the paper's 8 heads, C a multiple of 16."""
    return serves(projected)


def _empty_answers(
    pixels: torch.Tensor, queries: torch.Tensor, *_: Any
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    shape = queries.shape[:2]
    return pixels.new_empty(shape), pixels.new_empty(*shape, 4), pixels.new_empty(shape)


@torch.library.custom_op("kernels::fused_surfaces", mutates_args=())
def _fused_surfaces(
    pixels: torch.Tensor,
    queries: torch.Tensor,
    slope: torch.Tensor,
    shift: torch.Tensor,
    gram: torch.Tensor,
    image: torch.Tensor,
    elevations: torch.Tensor,
    azimuths: torch.Tensor,
    weights: torch.Tensor,
    biases: torch.Tensor,
    head: torch.Tensor,
    head_bias: torch.Tensor,
    eps: float,
    wrap: bool,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    batch, count, _ = queries.shape
    ranges, support, none = _empty_answers(pixels, queries)
    share = -(-batch * -(-count // GROUP) // WORKERS)
    table = fields(pixels, slope, shift, gram, HEADS, eps, wrap, per_image=count, groups=1)
    rays = rays_of(image, queries, elevations, azimuths, wrap)
    inputs = [table, queries.view(-1, 2), weights, biases, head, head_bias, rays, share]
    answers = {"ranges": ranges.unsqueeze(2), "support": support, "none": none.unsqueeze(2)}
    launch(_fused_surfaces_kernel, WORKERS, inputs, [scratch_of(pixels, biases.shape[1]), answers], least=1)
    return ranges, support, none


_fused_surfaces.register_fake(_empty_answers)
refuse(_fused_surfaces, "its image and queries have a batch dimension for that")


def fused_surfaces(
    projected: Projected,
    image: torch.Tensor,
    queries: torch.Tensor,
    elevations: torch.Tensor,
    azimuths: torch.Tensor,
    weights: DecoderWeights,
    wrap: bool = True,
    *,
    eps: float = 1e-5,
    backend: str = "warp",
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Answers queries from projected features: attention, feed-forward, scores and weighted median in one pass.

    It is for inference and gives no gradients.

    Args:
        projected: The features after `project_pixels`; `fused_surfaces_serves` says which are served.
        image: (B, H, W) float32 ranges in metres, 0 where nothing returned.
        queries: (B, Q, 2) pixel coordinates (row, column). Those beyond ±2^30 count as ±2^30.
        elevations: (H,) radians, of the rows; any spacing.
        azimuths: (W,) radians, of the columns; any spacing.
        weights: Weights of the decoder; its head gives 9 scores and 1 scale for each neighbour.
        wrap: Whether column W-1 meets column 0 (a full circle). Otherwise columns clamp; rows always clamp.
        eps: ε of the layer norms.
        backend: "warp", or "torch" for the plain twin in `kernels.reference`, which serves any table.

    Returns:
        ranges: (B, Q), support: (B, Q, 4) and no_return: (B, Q), float32, as `surface_median` returns them.

    Raises:
        TypeError: If `image`, `queries` or an angle table is not a floating-point tensor.
        ValueError: If the table is not served, or a shape, device or backend does not fit.

    Source: ours, Eqs. (3) and (4) of `kernels.surfaces.maths`.
    """
    check_backend(backend)
    check_queries(queries)
    batch, height, width, _ = projected.pixels.shape
    tables = {"elevations": elevations, "azimuths": azimuths}
    check_devices(**projected.named(), image=image, queries=queries, **tables, **weights.named())
    shapes = {"image": (batch, height, width), "elevations": (height,), "azimuths": (width,)}
    for name, shape in shapes.items():
        tensor = image if name == "image" else tables[name]
        check_floating(name, tensor, [torch.float32, torch.float64], str(shape))
        if tensor.shape != shape:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}; it should be {shape}")
    if queries.ndim != 3 or len(queries) != batch:
        raise ValueError(f"queries has shape {tuple(queries.shape)}; it should be ({batch}, Q, 2)")
    channels = len(projected.shift) // 3
    if weights.score[0].shape != (KINDS + 1, channels):
        raise ValueError(
            f"weights.score[0] has shape {tuple(weights.score[0].shape)}; it should be {(KINDS + 1, channels)}"
        )
    if backend == "torch":
        return reference.fused_surfaces(projected, image, queries, elevations, azimuths, weights, wrap, eps)
    check_served(projected)
    pixels, slope, shift, gram, heads = projected
    with torch.no_grad(), torch.autocast(pixels.device.type, enabled=False):
        matrices, biases = blocks_of(weights, heads)
        (gamma, beta), (score, bias) = weights.head_norm, weights.score
        head, head_bias = (score * gamma).T.float(), (score @ beta + bias).float()
        padding = (0, LANES - len(bias))
        image, queries, elevations, azimuths = (
            tensor.float().contiguous() for tensor in (image, queries, elevations, azimuths)
        )
        return _fused_surfaces(
            pixels.contiguous(), queries, slope, shift, gram, image, elevations, azimuths,
            matrices, biases, F.pad(head, padding), F.pad(head_bias, padding), eps, wrap,
        )  # fmt: skip
