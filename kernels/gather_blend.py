"""gather_blend: ranges of the 4 neighbours, blended with softmax weights, in one pass (paper, Eq. 3).

    r̂ = Σ_t w_t r_t,    w = softmax(s + p),    p_t = 0 | log a_t | log a_t - log r_t

a_t are the bilinear areas S_t / S. With zero scores the three priors give the mean of the neighbours, bilinear
interpolation, and bilinear interpolation of *inverse* range: 1 / Σ_t a_t / r_t = Σ_t w_t r_t with w_t ∝ a_t / r_t. On a
plane n·x = c the range along a direction d is c / (n·d), so 1/r is linear in d, and the last blend keeps planes flat.

The gradients follow from ∂w_t/∂s_u = w_t (δ_tu - w_u):

    ∂r̂/∂s_t = w_t (r_t - r̂)
    ∂r̂/∂r_t = w_t                                               for priors without r_t
    ∂r̂/∂r_t = w_t + w_t (r_t - r̂) · (-1 / r_t) = w_t r̂ / r_t    for the perspective prior
"""

from typing import Any, Literal
from typing import overload as overload_types

import torch
import warp as wp

from kernels import reference
from kernels.checks import (
    PRIORS,
    RANGE_FLOOR,
    broadcast_batch,
    check_area_floor,
    check_backend,
    check_devices,
    check_floating,
    check_prior,
    check_queries,
)
from kernels.lanes import exp2
from kernels.launch import BLOCKS, LEAST, launch, overload, query_blocks
from kernels.scatter import PARTS, adjoint_of_gather, sum_slices
from kernels.stencil import Grid, area, bounds, grid_of, query_of
from kernels.vmap import fold_into_batch

__all__ = ["gather_blend"]

_BILINEAR = wp.constant(PRIORS.index("bilinear"))
_PERSPECTIVE = wp.constant(PRIORS.index("perspective"))
_RANGE_FLOOR = wp.constant(RANGE_FLOOR)


def _kernels(n: int) -> tuple[wp.Kernel, wp.Kernel]:
    """Returns the forward and the backward kernel whose threads take n queries each."""
    one, two, four = (wp.types.vector(n * numbers, wp.Float) for numbers in (1, 2, 4))
    four_stored = wp.types.vector(n * 4, wp.Scalar)
    m = 4 * n

    @wp.func
    def ranges(image: wp.array3d[Any], b: int, at: Any, r: Any, grid: Grid):
        for k in range(n):
            above, below, left, right = bounds(at[2 * k], at[2 * k + 1], grid)
            r[4 * k] = image[b, above, left]
            r[4 * k + 1] = image[b, above, right]
            r[4 * k + 2] = image[b, below, left]
            r[4 * k + 3] = image[b, below, right]
        return r

    @wp.kernel(enable_backward=False)
    def _gather_blend_kernel(
        first: int,
        # in
        image: wp.array3d[wp.Float],
        queries: wp.array2d[two],
        scores: wp.array2d[four_stored],
        area_floor: wp.Float,
        prior: int,
        grid: Grid,
        # out
        blended_out: wp.array2d[one],
        weights_out: wp.array2d[four],
    ):
        b, q = query_of(first + wp.tid(), queries.shape[1])
        at = queries[b, q]
        s = scores[b, q]
        r = ranges(image, b, at, weights_out.dtype(), grid)
        p = weights_out.dtype()  # exp of the prior, as a factor: an area of 0 needs no logarithm
        x = weights_out.dtype()
        for k in range(m):
            p[k] = image.dtype(1.0)
        if prior >= _BILINEAR:
            for k in range(m):
                p[k] = area(at[k // 4 * 2], at[k // 4 * 2 + 1], k % 4)
            for k in range(m):
                p[k] = wp.where(p[k] < area_floor, area_floor, p[k])  # not `max`, which may drop NaN
        if prior == _PERSPECTIVE:
            for k in range(m):
                p[k] = p[k] / wp.where(r[k] < image.dtype(_RANGE_FLOOR), image.dtype(_RANGE_FLOOR), r[k])
        for k in range(m):
            x[k] = wp.where(p[k] <= image.dtype(0.0), image.dtype(-wp.inf), image.dtype(s[k]))
        for k in range(n):
            upper = wp.where(x[4 * k] > x[4 * k + 1], x[4 * k], x[4 * k + 1])
            lower = wp.where(x[4 * k + 2] > x[4 * k + 3], x[4 * k + 2], x[4 * k + 3])
            largest = wp.where(upper > lower, upper, lower)  # of the neighbours whose area is not 0
            for t in range(4):
                x[4 * k + t] = x[4 * k + t] - largest
        w = wp.cw_mul(p, exp2(x * image.dtype(1.4426950408889634)))
        for k in range(n):
            total = w[4 * k] + w[4 * k + 1] + w[4 * k + 2] + w[4 * k + 3]
            for t in range(4):
                w[4 * k + t] = w[4 * k + t] / total
        wr = wp.cw_mul(w, r)
        blended = blended_out.dtype()
        for k in range(n):
            blended[k] = wr[4 * k] + wr[4 * k + 1] + wr[4 * k + 2] + wr[4 * k + 3]
        blended_out[b, q] = blended
        weights_out[b, q] = w

    @wp.kernel(enable_backward=False)
    def _gather_blend_backward_kernel(
        first: int,
        # in
        image: wp.array3d[wp.Float],
        queries: wp.array2d[two],
        weights: wp.array2d[four],
        adj_blended: wp.array2d[one],
        adj_weights: wp.array2d[four],
        prior: int,
        grid: Grid,
        slices: int,
        # out
        adj_scores_out: wp.array2d[four_stored],
        adj_ranges_out: wp.array2d[four],
        adj_image_out: wp.array3d[wp.Float],
    ):
        b, s = query_of(first + wp.tid(), slices)
        share = (weights.shape[1] + slices - 1) // slices
        if adj_image_out:
            for p in range(adj_image_out.shape[2]):
                adj_image_out[b, s, p] = image.dtype(0.0)
        for q in range(s * share, wp.min((s + 1) * share, weights.shape[1])):
            at = queries[b, q]
            w = weights[b, q]
            r = ranges(image, b, at, weights.dtype(), grid)
            g = adj_blended[b, q]
            x = weights.dtype()
            for k in range(m):
                x[k] = g[k // 4] * r[k]
            if adj_weights:
                x = x + adj_weights[b, q]
            wx = wp.cw_mul(w, x)
            for k in range(n):
                mean = wx[4 * k] + wx[4 * k + 1] + wx[4 * k + 2] + wx[4 * k + 3]
                for t in range(4):
                    x[4 * k + t] = w[4 * k + t] * (x[4 * k + t] - mean)
            adj_scores = adj_scores_out.dtype()
            for k in range(m):
                adj_scores[k] = adj_scores.dtype(x[k])
            adj_scores_out[b, q] = adj_scores
            if adj_ranges_out or adj_image_out:
                for k in range(m):
                    w[k] = g[k // 4] * w[k]
                if prior == _PERSPECTIVE:
                    for k in range(m):
                        w[k] = w[k] - wp.where(r[k] > w.dtype(_RANGE_FLOOR), x[k] / r[k], w.dtype(0.0))
            if adj_ranges_out:
                adj_ranges_out[b, q] = w
            if adj_image_out:
                for k in range(n):
                    above, below, left, right = bounds(at[2 * k], at[2 * k + 1], grid)
                    p0 = above * grid.width + left
                    p1 = above * grid.width + right
                    p2 = below * grid.width + left
                    p3 = below * grid.width + right
                    adj_image_out[b, s, p0] = adj_image_out[b, s, p0] + w[4 * k]
                    adj_image_out[b, s, p1] = adj_image_out[b, s, p1] + w[4 * k + 1]
                    adj_image_out[b, s, p2] = adj_image_out[b, s, p2] + w[4 * k + 2]
                    adj_image_out[b, s, p3] = adj_image_out[b, s, p3] + w[4 * k + 3]

    return _gather_blend_kernel, _gather_blend_backward_kernel


_made = {n: [overload(kernel, half=True) for kernel in _kernels(n)] for n in BLOCKS}
_blend = {(dtype, n): forward[dtype] for n, (forward, _) in _made.items() for dtype in forward}
_blend_backward = {(dtype, n): backward[dtype] for n, (_, backward) in _made.items() for dtype in backward}


def _empty_outputs(
    image: torch.Tensor, queries: torch.Tensor, scores: torch.Tensor, prior: int, area_floor: float, wrap: bool
) -> tuple[torch.Tensor, torch.Tensor]:
    return image.new_empty(scores.shape[:2]), image.new_empty(scores.shape)


@torch.library.custom_op("kernels::gather_blend", mutates_args=())
def _gather_blend(
    image: torch.Tensor, queries: torch.Tensor, scores: torch.Tensor, prior: int, area_floor: float, wrap: bool
) -> tuple[torch.Tensor, torch.Tensor]:
    count = scores.shape[1]
    _, height, width = image.shape
    blended, weights = _empty_outputs(image, queries, scores, prior, area_floor, wrap)
    for n, part in query_blocks(count, image.device):
        inputs = [image, queries[:, part], scores[:, part], area_floor, prior, grid_of(height, width, wrap)]
        outputs = [blended[:, part], weights[:, part]]
        launch(_blend[scores.dtype, n], outputs[0].numel() // n, inputs, outputs)
    return blended, weights


_gather_blend.register_fake(_empty_outputs)


def _empty_gradients(
    image: torch.Tensor,
    queries: torch.Tensor,
    weights: torch.Tensor,
    adj_blended: torch.Tensor,
    adj_weights: torch.Tensor | None,
    prior: int,
    wrap: bool,
    scores: torch.dtype,
    for_image: bool,
) -> tuple[torch.Tensor, torch.Tensor]:
    return weights.new_empty(weights.shape, dtype=scores), image.new_empty(image.shape if for_image else 0)


@torch.library.custom_op("kernels::gather_blend_backward", mutates_args=())
def _gather_blend_backward(
    image: torch.Tensor,
    queries: torch.Tensor,
    weights: torch.Tensor,
    adj_blended: torch.Tensor,
    adj_weights: torch.Tensor | None,
    prior: int,
    wrap: bool,
    scores: torch.dtype,
    for_image: bool,
) -> tuple[torch.Tensor, torch.Tensor]:
    batch, count, _ = weights.shape
    adj_scores, adj_image = _empty_gradients(
        image, queries, weights, adj_blended, adj_weights, prior, wrap, scores, for_image
    )
    _, height, width = image.shape
    grid = grid_of(height, width, wrap)
    blocks = query_blocks(count, weights.device)
    on_cpu = weights.device.type == "cpu"
    adj_ranges = None if on_cpu or not for_image else weights.new_empty(weights.shape)
    # On a CPU few threads sum gradients of the image, each in a slice of its own (`kernels.scatter.sum_by_query`).
    slices = -(-PARTS // max(batch, 1))
    shares = weights.new_empty(batch, slices * len(blocks), height * width) if on_cpu and for_image else None
    for i, (n, part) in enumerate(blocks):
        threads, least, own = (part.stop - part.start) // n, LEAST, None
        if shares is not None:
            threads, least = slices, 1
            own = shares[:, i * slices : (i + 1) * slices]
        adjoints = [adj_blended[:, part], None if adj_weights is None else adj_weights[:, part]]
        inputs = [image, queries[:, part], weights[:, part], *adjoints, prior, grid, threads]
        outputs = [adj_scores[:, part], None if adj_ranges is None else adj_ranges[:, part], own]
        launch(_blend_backward[scores, n], batch * threads, inputs, outputs, least)
    if shares is not None:
        adj_image = sum_slices(shares.unsqueeze(-1)).view(image.shape)
    elif adj_ranges is not None:
        adj_image = adjoint_of_gather(adj_ranges.unsqueeze(-1), queries, height, width, wrap).squeeze(-1)
    return adj_scores, adj_image


_gather_blend_backward.register_fake(_empty_gradients)


def _setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
    image, queries, scores, ctx.prior, _, ctx.wrap = inputs
    ctx.scores = scores.dtype
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(image, queries, output[1])


def _backward(
    ctx: Any, adj_blended: torch.Tensor | None, adj_weights: torch.Tensor | None
) -> tuple[torch.Tensor | None, ...]:
    image, queries, weights = ctx.saved_tensors
    adj_blended = weights.new_zeros(weights.shape[:2]) if adj_blended is None else adj_blended.contiguous()
    adj_weights = None if adj_weights is None else adj_weights.contiguous()
    for_image = ctx.needs_input_grad[0]
    adj_scores, adj_image = _gather_blend_backward(
        image, queries, weights, adj_blended, adj_weights, ctx.prior, ctx.wrap, ctx.scores, for_image
    )
    return adj_image if for_image else None, None, adj_scores, None, None, None


_gather_blend.register_autograd(_backward, setup_context=_setup_context)
fold_into_batch(_gather_blend)
fold_into_batch(_gather_blend_backward)


@overload_types
def gather_blend(
    image: torch.Tensor,
    queries: torch.Tensor,
    scores: torch.Tensor,
    prior: str = ...,
    wrap: bool = ...,
    *,
    area_floor: float = ...,
    return_weights: Literal[False] = ...,
    backend: str = ...,
) -> torch.Tensor: ...


@overload_types
def gather_blend(
    image: torch.Tensor,
    queries: torch.Tensor,
    scores: torch.Tensor,
    prior: str = ...,
    wrap: bool = ...,
    *,
    area_floor: float = ...,
    return_weights: Literal[True],
    backend: str = ...,
) -> tuple[torch.Tensor, torch.Tensor]: ...


def gather_blend(
    image: torch.Tensor,
    queries: torch.Tensor,
    scores: torch.Tensor,
    prior: str = "none",
    wrap: bool = True,
    *,
    area_floor: float = 0.0,
    return_weights: bool = False,
    backend: str = "warp",
) -> torch.Tensor | tuple[torch.Tensor, torch.Tensor]:
    """Blends the ranges of the 4 neighbours of each query with the softmax of scores plus a geometric prior.

    Differentiable in `image` and `scores`; the backward pass is deterministic.

    Args:
        image: (..., H, W) float32 or float64 ranges in metres, no return already filled. Other units serve as well,
            but the perspective prior needs positive ranges and takes those below 0.1 as 0.1. Half precision is
            refused, since bfloat16 rounds 80 m by up to 0.25 m.
        queries: (..., Q, 2) pixel coordinates (row, column); integers are pixel centres.
        scores: (..., Q, 4), one per neighbour in the order (row-, col-), (row-, col+), (row+, col-), (row+, col+), of
            the image's dtype. Beside a float32 image they may be bfloat16 or float16 and are computed with in float32.
            The leading dimensions of the three broadcast. Four scores of -inf give NaN.
        prior: What zero scores give: "none" the mean of the neighbours (the paper), "bilinear" bilinear interpolation,
            "perspective" bilinear interpolation of inverse range, which keeps planes flat.
        wrap: Whether column W-1 meets column 0 (a full circle). Otherwise columns clamp. Rows always clamp.
        area_floor: Least bilinear area in the prior. Above 0, scores can overrule an area of 0.
        return_weights: Whether to return the weights as well.
        backend: "warp", or "torch" for the plain twin in `kernels.reference`.

    Returns:
        blended: (..., Q) metres, between the least and the greatest of the 4 ranges, of the image's dtype.
        weights: (..., Q, 4), positive, summing to 1, of the scores' dtype; only with `return_weights`.

    Raises:
        TypeError: If an argument is not a tensor of a supported dtype.
        ValueError: If a shape, device, prior, floor or backend does not fit.

    Source: paper Eq. 3 (`prior="none"`); the priors are ours.
    """
    check_backend(backend)
    check_prior(prior)
    check_area_floor(area_floor)
    check_floating("image", image, [torch.float32, torch.float64], "(..., H, W)")
    check_floating("scores", scores, [dtype for dtype, _ in _blend], "(..., Q, 4)")
    if image.ndim < 2 or 0 in image.shape[-2:]:
        raise ValueError(f"image has shape {tuple(image.shape)}; it should be (..., H, W), neither of them 0")
    check_queries(queries)
    check_devices(image=image, queries=queries, scores=scores)
    if image.dtype != torch.promote_types(scores.dtype, torch.float32):
        raise TypeError(
            f"scores is {scores.dtype}; it should be {image.dtype}, as image is, or half precision beside a float32"
            " image"
        )
    if scores.ndim < 2 or scores.shape[-2:] != (queries.shape[-2], 4):
        raise ValueError(f"scores has shape {tuple(scores.shape)}; it should be (..., {queries.shape[-2]}, 4)")
    queries = queries.detach().to(image.dtype)
    batch, (image, queries, scores) = broadcast_batch(image=(image, 2), queries=(queries, 2), scores=(scores, 2))
    if backend == "torch":
        blended, weights = reference.gather_blend(image, queries, scores, prior, wrap, area_floor)
    else:
        queries, scores = queries.contiguous(), scores.contiguous()
        blended, weights = _gather_blend(image, queries, scores, PRIORS.index(prior), area_floor, wrap)
    blended = blended.reshape(*batch, *blended.shape[1:])
    return (blended, weights.reshape(*batch, *weights.shape[1:]).to(scores.dtype)) if return_weights else blended
