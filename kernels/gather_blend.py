"""gather_blend: ranges of the 4 neighbours, blended with softmax weights, in one pass (paper, Eq. 3).

    r̂ = Σ_t w_t r_t,    w = softmax(s + p),    p_t = 0 | log a_t | log a_t - log r_t

a_t are the bilinear areas. Zero scores give the mean of the neighbours, bilinear interpolation, or bilinear
interpolation of *inverse* range: 1 / Σ_t a_t / r_t = Σ_t w_t r_t with w_t ∝ a_t / r_t. On a plane n·x = c the range
along a direction d is c / (n·d), so that 1/r is linear in d and this last blend keeps planes flat.

The gradients follow from ∂w_t/∂s_u = w_t (δ_tu - w_u):

    ∂r̂/∂s_t = w_t (r_t - r̂)
    ∂r̂/∂r_t = w_t                                        priors that do not see the range
    ∂r̂/∂r_t = w_t + w_t (r_t - r̂) · (-1 / r_t) = w_t r̂ / r_t    the perspective prior
"""

from typing import Any, Literal
from typing import overload as overload_types

import torch
import warp as wp

from kernels import reference
from kernels.launch import check_backend, check_floating, launch, overload
from kernels.neighbours import adjoint_of_gather, area, broadcast_batch, check_queries, neighbour
from kernels.reference import PRIORS, RANGE_FLOOR

__all__ = ["gather_blend"]

_BILINEAR = wp.constant(PRIORS.index("bilinear"))
_PERSPECTIVE = wp.constant(PRIORS.index("perspective"))
_RANGE_FLOOR = wp.constant(RANGE_FLOOR)


@wp.func
def _prior(row: Any, column: Any, t: int, r: Any, prior: int, area_floor: Any):
    """exp(p_t): a factor of the weight, so that neither 0 nor its logarithm is special."""
    p = type(row)(1.0)
    if prior >= _BILINEAR:
        p = wp.max(area(row, column, t), area_floor)
    if prior == _PERSPECTIVE:
        p = p / wp.max(r, type(row)(_RANGE_FLOOR))
    return p


@wp.kernel(enable_backward=False)
def _gather_blend_kernel(
    first: int,
    # in
    image: wp.array3d[Any],
    queries: wp.array3d[Any],
    scores: wp.array3d[Any],
    area_floor: wp.Float,
    prior: int,
    wrap: int,
    # out
    blended_out: wp.array2d[Any],
    weights_out: wp.array3d[Any],
):
    thread = first + wp.tid()
    b = thread // queries.shape[1]
    q = thread % queries.shape[1]
    row = queries[b, q, 0]
    column = queries[b, q, 1]
    r = wp.vector(dtype=image.dtype, length=4)
    w = wp.vector(dtype=image.dtype, length=4)
    largest = image.dtype(-wp.inf)  # score of a neighbour that the prior lets in
    for t in range(4):
        i, j = neighbour(row, column, t, image.shape[1], image.shape[2], wrap)
        r[t] = image[b, i, j]
        w[t] = _prior(row, column, t, r[t], prior, area_floor)
        if w[t] > image.dtype(0.0):
            largest = wp.max(largest, scores[b, q, t])
    for t in range(4):
        if w[t] > image.dtype(0.0):
            w[t] = w[t] * wp.exp(scores[b, q, t] - largest)
    w = w / (w[0] + w[1] + w[2] + w[3])
    blended_out[b, q] = wp.dot(w, r)
    for t in range(4):
        weights_out[b, q, t] = w[t]


@wp.kernel(enable_backward=False)
def _gather_blend_backward_kernel(
    first: int,
    # in
    image: wp.array3d[Any],
    queries: wp.array3d[Any],
    weights: wp.array3d[Any],
    adj_blended: wp.array2d[Any],
    adj_weights: wp.array3d[Any],
    prior: int,
    wrap: int,
    # out
    adj_scores_out: wp.array3d[Any],
    adj_ranges_out: wp.array4d[Any],
):
    thread = first + wp.tid()
    b = thread // queries.shape[1]
    q = thread % queries.shape[1]
    r = wp.vector(dtype=image.dtype, length=4)
    w = wp.vector(dtype=image.dtype, length=4)
    adj_w = wp.vector(dtype=image.dtype, length=4)
    for t in range(4):
        i, j = neighbour(queries[b, q, 0], queries[b, q, 1], t, image.shape[1], image.shape[2], wrap)
        r[t] = image[b, i, j]
        w[t] = weights[b, q, t]
        adj_w[t] = adj_weights[b, q, t] + adj_blended[b, q] * r[t]
    mean = wp.dot(w, adj_w)
    for t in range(4):
        adj_logit = w[t] * (adj_w[t] - mean)
        adj_scores_out[b, q, t] = adj_logit
        adj_r = adj_blended[b, q] * w[t]
        if prior == _PERSPECTIVE and r[t] > image.dtype(_RANGE_FLOOR):
            adj_r = adj_r - adj_logit / r[t]
        adj_ranges_out[b, q, t, 0] = adj_r


_blend = overload(_gather_blend_kernel)
_blend_backward = overload(_gather_blend_backward_kernel)


@torch.library.custom_op("kernels::gather_blend", mutates_args=())
def _gather_blend(
    image: torch.Tensor, queries: torch.Tensor, scores: torch.Tensor, prior: int, area_floor: float, wrap: bool
) -> tuple[torch.Tensor, torch.Tensor]:
    blended = torch.empty_like(scores[..., 0], memory_format=torch.contiguous_format)
    weights = torch.empty_like(scores, memory_format=torch.contiguous_format)
    inputs = [image, queries, scores, area_floor, prior, int(wrap)]
    launch(_blend[image.dtype], blended.numel(), inputs, [blended, weights])
    return blended, weights


@_gather_blend.register_fake
def _(
    image: torch.Tensor, queries: torch.Tensor, scores: torch.Tensor, prior: int, area_floor: float, wrap: bool
) -> tuple[torch.Tensor, torch.Tensor]:
    return scores.new_empty(scores.shape[:-1]), scores.new_empty(scores.shape)


@torch.library.custom_op("kernels::gather_blend_backward", mutates_args=())
def _gather_blend_backward(
    image: torch.Tensor,
    queries: torch.Tensor,
    weights: torch.Tensor,
    adj_blended: torch.Tensor,
    adj_weights: torch.Tensor,
    prior: int,
    wrap: bool,
) -> tuple[torch.Tensor, torch.Tensor]:
    adj_scores = torch.empty_like(weights)
    adj_ranges = torch.empty_like(weights).unsqueeze(-1)
    inputs = [image, queries, weights, adj_blended, adj_weights, prior, int(wrap)]
    launch(_blend_backward[image.dtype], adj_blended.numel(), inputs, [adj_scores, adj_ranges])
    return adj_scores, adj_ranges


@_gather_blend_backward.register_fake
def _(
    image: torch.Tensor,
    queries: torch.Tensor,
    weights: torch.Tensor,
    adj_blended: torch.Tensor,
    adj_weights: torch.Tensor,
    prior: int,
    wrap: bool,
) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.empty_like(weights), torch.empty_like(weights).unsqueeze(-1)


def _setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
    image, queries, _, ctx.prior, _, ctx.wrap = inputs
    ctx.save_for_backward(image, queries, output[1])


def _backward(ctx: Any, adj_blended: torch.Tensor, adj_weights: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
    image, queries, weights = ctx.saved_tensors
    adj_scores, adj_ranges = _gather_blend_backward(
        image, queries, weights, adj_blended, adj_weights, ctx.prior, ctx.wrap
    )
    adj_image = None
    if ctx.needs_input_grad[0]:
        adj_image = adjoint_of_gather(adj_ranges, queries, *image.shape[1:], ctx.wrap).squeeze(-1)
    return adj_image, None, adj_scores, None, None, None


_gather_blend.register_autograd(_backward, setup_context=_setup_context)


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
            but the perspective prior wants positive ranges and takes those below 0.1 as 0.1.
        queries: (..., Q, 2) pixel coordinates (row, column); integers are pixel centres.
        scores: (..., Q, 4), one per neighbour in the order (row-, col-), (row-, col+), (row+, col-), (row+, col+).
            The leading dimensions of the three broadcast. Four scores of -inf give NaN.
        prior: What zero scores mean: "none" the mean of the neighbours (the paper), "bilinear" bilinear interpolation,
            "perspective" bilinear interpolation of inverse range, which keeps planes flat.
        wrap: Whether column W-1 meets column 0 (a full circle). Otherwise columns clamp; rows always clamp.
        area_floor: Least bilinear area in the prior. Above 0, scores can overrule a neighbour's area of 0.
        return_weights: Whether to return the weights as well.
        backend: "warp", or "torch" for the plain twin in `kernels.reference`.

    Returns:
        blended: (..., Q) metres, within the range of the 4 neighbours.
        weights: (..., Q, 4), positive, summing to 1; with `return_weights` only.

    Raises:
        TypeError: If an argument is not a tensor of a supported dtype, or image and scores differ in dtype.
        ValueError: If a shape, device, prior, floor or backend does not fit.

    Source: paper Eq. 3 (`prior="none"`); the priors are ours.
    """
    check_backend(backend)
    if prior not in PRIORS:
        raise ValueError(f"prior is {prior!r}; it should be one of {', '.join(PRIORS)}")
    if not 0 <= area_floor <= 0.25:
        raise ValueError(f"area_floor is {area_floor}; it should be between 0 and 0.25, the area at a cell's centre")
    check_floating("image", image, _blend, "(..., H, W)")
    check_floating("scores", scores, _blend, "(..., Q, 4)")
    if image.ndim < 2 or 0 in image.shape[-2:]:
        raise ValueError(f"image has shape {tuple(image.shape)}; it should be (..., H, W), neither of them 0")
    check_queries(queries, image, "image")
    if scores.dtype != image.dtype:
        raise TypeError(f"scores is {scores.dtype}, image {image.dtype}; they should have one dtype")
    if scores.device != image.device:
        raise ValueError(f"scores is on {scores.device}, image on {image.device}; they should be on one device")
    if scores.ndim < 2 or scores.shape[-2:] != (queries.shape[-2], 4):
        raise ValueError(f"scores has shape {tuple(scores.shape)}; it should be (..., {queries.shape[-2]}, 4)")
    queries = queries.detach().to(image.dtype)
    batch, (image, queries, scores) = broadcast_batch(image=(image, 2), queries=(queries, 2), scores=(scores, 2))
    if backend == "torch":
        blended, weights = reference.gather_blend(image, queries, scores, prior, wrap, area_floor)
    else:
        blended, weights = _gather_blend(image, queries, scores, PRIORS.index(prior), area_floor, wrap)
    blended, weights = blended.reshape(*batch, *blended.shape[1:]), weights.reshape(*batch, *weights.shape[1:])
    return (blended, weights) if return_weights else blended
