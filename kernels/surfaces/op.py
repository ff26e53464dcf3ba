"""surface_hypotheses, surface_likelihood, surface_median: what the surfaces of the neighbours say of queries, as ops.

`kernels.surfaces.maths` derives them. A thread takes a query in each lane: 16 queries on a CPU in float32, else one.
"""

import math
from typing import Any

import torch
import warp as wp

from kernels import reference
from kernels.checks import (
    BACKGROUND,
    KINDS,
    broadcast_batch,
    check_backend,
    check_devices,
    check_floating,
    check_queries,
)
from kernels.lanes import LANES, exp2, vectors, where_less
from kernels.launch import LEAST, launch
from kernels.neighbour_attention.maths import ROLLED_FOUR
from kernels.stencil import query_of
from kernels.surfaces.maths import RAYS, explain, hypotheses, load, scale, settle, store, weigh
from kernels.vmap import refuse

__all__ = ["rays_of", "surface_hypotheses", "surface_likelihood", "surface_median"]

_BACKGROUND = wp.constant(BACKGROUND)


def _kernels(lane: Any) -> tuple[wp.Kernel, ...]:
    """Returns the four kernels for one type of lanes."""
    scalar: Any = lane._wp_scalar_type_
    lanes = lane._length_
    module = wp.get_module(f"kernels.surfaces.{scalar.__name__}x{lanes}")  # compiled only where its lanes are used
    rays_type: Any = RAYS[scalar]
    many, four, two, single = (wp.types.matrix((rows, lanes), scalar) for rows in (4 * KINDS, 4, 2, 1))

    @wp.func
    def first_of(thread: int, rays: rays_type):
        """Image and first query of a thread, which takes a query in each lane."""
        b, block = query_of(thread, (rays.queries.shape[1] + lanes - 1) // lanes)
        return b, lanes * block

    @wp.kernel(enable_backward=False, module=module)
    def _hypotheses_kernel(
        first: int,
        # in
        rays: rays_type,
        # out
        found_out: wp.array3d[scalar],
    ):
        b, begin = first_of(first + wp.tid(), rays)
        at = load(rays.queries, b, begin, two())
        store(hypotheses(rays, b, at[0], at[1], many()), b, begin, found_out)

    @wp.kernel(enable_backward=False, module=module)
    def _likelihood_kernel(
        first: int,
        # in
        rays: rays_type,
        scores: wp.array3d[scalar],
        scales: wp.array3d[scalar],
        targets: wp.array3d[scalar],
        far: scalar,
        # out
        likelihood_out: wp.array3d[scalar],
        error_out: wp.array3d[scalar],
    ):
        b, begin = first_of(first + wp.tid(), rays)
        at = load(rays.queries, b, begin, two())
        target = load(targets, b, begin, single())[0]
        w = weigh(load(scores, b, begin, many()), at[0], at[1], rays.rolled_four)
        found = hypotheses(rays, b, at[0], at[1], many())
        p, gap = explain(found, load(scales, b, begin, four()), target, lane(far), rays.rolled_four)
        whole = lane()
        explained = lane()
        error = lane()
        for k in range(4 * KINDS):
            whole = whole + w[k]
            explained = explained + wp.cw_mul(w[k], p[k])
            error = error + wp.cw_mul(w[k], gap[k])
        background = scalar(_BACKGROUND)
        known = scalar(1.0) - scalar(2.0) * background
        likelihood = single()
        for i in range(lanes):
            unexplained = wp.where(target[i] > scalar(0.0), background / far, background)
            likelihood[0, i] = -wp.log(known * explained[i] / whole[i] + unexplained)
        store(likelihood, b, begin, likelihood_out)
        mean = single()
        mean[0] = wp.cw_div(error, whole)
        store(mean, b, begin, error_out)

    @wp.kernel(enable_backward=False, module=module)
    def _likelihood_backward_kernel(
        first: int,
        # in
        rays: rays_type,
        scores: wp.array3d[scalar],
        scales: wp.array3d[scalar],
        targets: wp.array3d[scalar],
        far: scalar,
        adj_likelihood: wp.array3d[scalar],
        adj_error: wp.array3d[scalar],
        # out
        adj_scores_out: wp.array3d[scalar],
        adj_scales_out: wp.array3d[scalar],
    ):
        b, begin = first_of(first + wp.tid(), rays)
        at = load(rays.queries, b, begin, two())
        target = load(targets, b, begin, single())[0]
        c = load(scales, b, begin, four())
        w = weigh(load(scores, b, begin, many()), at[0], at[1], rays.rolled_four)
        found = hypotheses(rays, b, at[0], at[1], many())
        p, gap = explain(found, c, target, lane(far), rays.rolled_four)
        zero = lane()
        one = lane(scalar(1.0))
        whole = zero
        for k in range(4 * KINDS):
            whole = whole + w[k]
        explained = zero
        error = zero
        for k in range(4 * KINDS):
            w[k] = wp.cw_div(w[k], whole)
            explained = explained + wp.cw_mul(w[k], p[k])
            error = error + wp.cw_mul(w[k], gap[k])
        background = scalar(_BACKGROUND)
        known = scalar(1.0) - scalar(2.0) * background
        unexplained = where_less(zero, target, lane(background / far), lane(background))
        factor = wp.cw_div(load(adj_likelihood, b, begin, single())[0] * known, explained * known + unexplained)
        of_error = load(adj_error, b, begin, single())[0]
        adj_scores = many()
        for k in range(4 * KINDS):
            slope = wp.cw_mul(of_error, gap[k] - error) - wp.cw_mul(factor, p[k] - explained)
            adj_scores[k] = wp.cw_mul(w[k], slope)
        store(adj_scores, b, begin, adj_scores_out)
        adj_scales = four()
        for t in range(rays.rolled_four):
            inverse = wp.cw_div(one, scale(c[t]))
            total = zero
            for k in range(KINDS * t, KINDS * t + KINDS):
                total = total + wp.cw_mul(wp.cw_mul(w[k], p[k]), wp.cw_mul(wp.cw_mul(gap[k], inverse) - one, inverse))
            # The slope of b_t in c_t is 0.5 sigmoid c_t.
            e = exp2(-wp.abs(c[t]) * scalar(1.4426950408889634))
            slope = wp.cw_div(where_less(c[t], zero, e, one) * scalar(0.5), one + e)
            adj_scales[t] = where_less(zero, target, -wp.cw_mul(wp.cw_mul(factor, total), slope), zero)
        store(adj_scales, b, begin, adj_scales_out)

    @wp.kernel(enable_backward=False, module=module)
    def _median_kernel(
        first: int,
        # in
        rays: rays_type,
        scores: wp.array3d[scalar],
        scales: wp.array3d[scalar],
        # out
        ranges_out: wp.array3d[scalar],
        support_out: wp.array3d[scalar],
        none_out: wp.array3d[scalar],
    ):
        b, begin = first_of(first + wp.tid(), rays)
        at = load(rays.queries, b, begin, two())
        w = weigh(load(scores, b, begin, many()), at[0], at[1], rays.rolled_four)
        found = hypotheses(rays, b, at[0], at[1], many())
        median, support, none = settle(found, w, load(scales, b, begin, four()), rays.rolled_four)
        answer = single()
        answer[0] = median
        store(answer, b, begin, ranges_out)
        store(support, b, begin, support_out)
        answer[0] = none
        store(answer, b, begin, none_out)

    return _hypotheses_kernel, _likelihood_kernel, _likelihood_backward_kernel, _median_kernel


_LANES: list[Any] = [vectors(LANES, wp.float32), vectors(1, wp.float32), vectors(1, wp.float64)]
_MADE = {lane: _kernels(lane) for lane in _LANES}
_FOUND, _LIKELIHOOD, _LIKELIHOOD_BACKWARD, _MEDIAN = range(4)


def _launch(number: int, rays: dict[str, Any], inputs: list[Any], outputs: list[torch.Tensor]) -> None:
    """Launches a kernel on rays, with a query in each lane; tensors are (B, Q) or (B, Q, ...)."""
    queries = rays["queries"]
    batch, count, _ = queries.shape
    lane = _LANES[2 if queries.dtype == torch.float64 else int(queries.device.type == "cuda")]
    blocks = -(-count // lane._length_)
    # (B, Q, numbers): one number a query is a row of one.
    inputs, results = (
        [t.unsqueeze(2).flatten(2) if isinstance(t, torch.Tensor) else t for t in tensors]
        for tensors in (inputs, outputs)
    )
    launch(_MADE[lane][number], batch * blocks, [rays, *inputs], results, least=-(-LEAST // lane._length_))


def rays_of(
    image: torch.Tensor, queries: torch.Tensor, elevations: torch.Tensor, azimuths: torch.Tensor, wrap: bool
) -> dict[str, Any]:
    """Returns the fields of `RAYS` for `kernels.launch.launch`."""
    tensors = {"image": image, "elevations": elevations, "azimuths": azimuths, "queries": queries}
    return {**tensors, "wrap": int(wrap), "rolled_four": ROLLED_FOUR}


def _empty_hypotheses(image: torch.Tensor, queries: torch.Tensor, *_: Any) -> torch.Tensor:
    return image.new_empty(*queries.shape[:2], 4, KINDS)


@torch.library.custom_op("kernels::surface_hypotheses", mutates_args=())
def _surface_hypotheses(
    image: torch.Tensor, queries: torch.Tensor, elevations: torch.Tensor, azimuths: torch.Tensor, wrap: bool
) -> torch.Tensor:
    found = _empty_hypotheses(image, queries)
    _launch(_FOUND, rays_of(image, queries, elevations, azimuths, wrap), [], [found])
    return found


_surface_hypotheses.register_fake(_empty_hypotheses)


def _empty_likelihood(image: torch.Tensor, queries: torch.Tensor, *_: Any) -> tuple[torch.Tensor, torch.Tensor]:
    return image.new_empty(queries.shape[:2]), image.new_empty(queries.shape[:2])


@torch.library.custom_op("kernels::surface_likelihood", mutates_args=())
def _surface_likelihood(
    image: torch.Tensor,
    queries: torch.Tensor,
    elevations: torch.Tensor,
    azimuths: torch.Tensor,
    wrap: bool,
    scores: torch.Tensor,
    scales: torch.Tensor,
    targets: torch.Tensor,
    far: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    likelihood, error = _empty_likelihood(image, queries)
    rays = rays_of(image, queries, elevations, azimuths, wrap)
    _launch(_LIKELIHOOD, rays, [scores, scales, targets, far], [likelihood, error])
    return likelihood, error


_surface_likelihood.register_fake(_empty_likelihood)


def _empty_gradients(image: torch.Tensor, queries: torch.Tensor, *_: Any) -> tuple[torch.Tensor, torch.Tensor]:
    return image.new_empty(*queries.shape[:2], 4, KINDS), image.new_empty(*queries.shape[:2], 4)


@torch.library.custom_op("kernels::surface_likelihood_backward", mutates_args=())
def _surface_likelihood_backward(
    image: torch.Tensor,
    queries: torch.Tensor,
    elevations: torch.Tensor,
    azimuths: torch.Tensor,
    wrap: bool,
    scores: torch.Tensor,
    scales: torch.Tensor,
    targets: torch.Tensor,
    far: float,
    adj_likelihood: torch.Tensor,
    adj_error: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    adj_scores, adj_scales = _empty_gradients(image, queries)
    rays = rays_of(image, queries, elevations, azimuths, wrap)
    inputs = [scores, scales, targets, far, adj_likelihood, adj_error]
    _launch(_LIKELIHOOD_BACKWARD, rays, inputs, [adj_scores, adj_scales])
    return adj_scores, adj_scales


_surface_likelihood_backward.register_fake(_empty_gradients)


def _setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
    *tensors, ctx.far = inputs
    ctx.wrap = tensors.pop(4)
    ctx.save_for_backward(*tensors)


def _backward(ctx: Any, adj_likelihood: torch.Tensor, adj_error: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
    *rays, scores, scales, targets = ctx.saved_tensors
    adj_scores, adj_scales = _surface_likelihood_backward(
        *rays, ctx.wrap, scores, scales, targets, ctx.far, adj_likelihood.contiguous(), adj_error.contiguous()
    )
    return None, None, None, None, None, adj_scores, adj_scales, None, None


_surface_likelihood.register_autograd(_backward, setup_context=_setup_context)


def _empty_answers(
    image: torch.Tensor, queries: torch.Tensor, *_: Any
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    shape = queries.shape[:2]
    return image.new_empty(shape), image.new_empty(*shape, 4), image.new_empty(shape)


@torch.library.custom_op("kernels::surface_median", mutates_args=())
def _surface_median(
    image: torch.Tensor,
    queries: torch.Tensor,
    elevations: torch.Tensor,
    azimuths: torch.Tensor,
    wrap: bool,
    scores: torch.Tensor,
    scales: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    ranges, support, none = _empty_answers(image, queries)
    rays = rays_of(image, queries, elevations, azimuths, wrap)
    _launch(_MEDIAN, rays, [scores, scales], [ranges, support, none])
    return ranges, support, none


_surface_median.register_fake(_empty_answers)


for _op in (_surface_hypotheses, _surface_likelihood, _surface_median):
    refuse(_op, "its image and queries have a batch dimension for that")
refuse(_surface_likelihood_backward, "ask for one gradient at a time")


def surface_hypotheses(
    image: torch.Tensor,
    queries: torch.Tensor,
    elevations: torch.Tensor,
    azimuths: torch.Tensor,
    wrap: bool = True,
    backend: str = "warp",
) -> torch.Tensor:
    """Finds the ranges at which each query meets the surfaces of its 4 neighbours, continued in 9 ways each.

    The hypotheses follow from measured ranges and carry no gradient.

    Args:
        image: (..., H, W) float32 or float64 ranges in metres, 0 where nothing returned.
        queries: (..., Q, 2) pixel coordinates (row, column). Leading dimensions broadcast against those of `image`.
        elevations: (H,) radians, of the rows; any spacing.
        azimuths: (W,) radians, of the columns; any spacing.
        wrap: Whether column W-1 meets column 0 (a full circle). Otherwise columns clamp; rows always clamp.
        backend: "warp", or "torch" for the plain twin in `kernels.reference`.

    Returns:
        (..., Q, 4, 9) metres, 0 for no return and NaN where the query is NaN. Neighbours are in the order (row-, col-),
        (row-, col+), (row+, col-), (row+, col+). Hypothesis 3 v + h of a neighbour is continued along the column as v
        says and along the row as h says: 0 with the outer pixel, 1 with the inner one, 2 not at all.

    Raises:
        TypeError: If an argument is not a floating-point tensor of a supported dtype.
        ValueError: If a shape, device or backend does not fit.

    Source: ours, Eq. (2) of `kernels.surfaces.maths`.
    """
    batch, image, queries, tables = _checked(image, queries, elevations, azimuths, backend)
    op = reference.surface_hypotheses if backend == "torch" else _surface_hypotheses
    return op(image, queries, *tables, wrap).view(*batch, queries.shape[1], 4, KINDS)


def surface_likelihood(
    image: torch.Tensor,
    queries: torch.Tensor,
    elevations: torch.Tensor,
    azimuths: torch.Tensor,
    scores: torch.Tensor,
    scales: torch.Tensor,
    targets: torch.Tensor,
    far: float,
    wrap: bool = True,
    backend: str = "warp",
) -> tuple[torch.Tensor, torch.Tensor]:
    """Tells how well scores and scales explain the ranges that were measured along the queries.

    Differentiable in `scores` and `scales`.

    Args:
        image: (..., H, W) float32 or float64 ranges in metres, 0 where nothing returned.
        queries: (..., Q, 2) pixel coordinates (row, column). Leading dimensions broadcast against those of `image`.
        elevations: (H,) radians, of the rows; any spacing.
        azimuths: (W,) radians, of the columns; any spacing.
        scores: (..., Q, 4, 9), s_tk of the hypotheses of `surface_hypotheses`, with all leading dimensions, float32,
            float64, bfloat16 or float16. They are computed with in the dtype of `image`, as are the next two.
        scales: (..., Q, 4), c_t of the neighbours.
        targets: (..., Q) measured ranges in metres, 0 where nothing returned.
        far: R, the range in metres that a no return counts as.
        wrap: Whether column W-1 meets column 0 (a full circle). Otherwise columns clamp; rows always clamp.
        backend: "warp", or "torch" for the plain twin in `kernels.reference`.

    Returns:
        likelihood: (..., Q), -log p of Eq. (4).
        error: (..., Q) metres, the expected absolute error `Σ_tk w_tk |r_tk - r|`.

    Raises:
        TypeError: If an argument is not a floating-point tensor of a supported dtype.
        ValueError: If a shape, device, `far` or backend does not fit.

    Source: ours, Eqs. (3) and (4) of `kernels.surfaces.maths`.
    """
    if not 0 < far < math.inf:
        raise ValueError(f"far is {far}; it should be a finite number of metres above 0")
    batch, image, queries, tables = _checked(image, queries, elevations, azimuths, backend)
    count = queries.shape[1]
    scores = _of_queries("scores", scores, batch, (count, 4, KINDS), image)
    scales = _of_queries("scales", scales, batch, (count, 4), image)
    targets = _of_queries("targets", targets, batch, (count,), image).detach()
    op = reference.surface_likelihood if backend == "torch" else _surface_likelihood
    likelihood, error = op(image, queries, *tables, wrap, scores, scales, targets, float(far))
    return likelihood.view(*batch, count), error.view(*batch, count)


def surface_median(
    image: torch.Tensor,
    queries: torch.Tensor,
    elevations: torch.Tensor,
    azimuths: torch.Tensor,
    scores: torch.Tensor,
    scales: torch.Tensor,
    wrap: bool = True,
    backend: str = "warp",
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Answers queries with the weighted median of their hypotheses.

    It is for inference and gives no gradients.

    Args:
        image: (..., H, W) float32 or float64 ranges in metres, 0 where nothing returned.
        queries: (..., Q, 2) pixel coordinates (row, column). Leading dimensions broadcast against those of `image`.
        elevations: (H,) radians, of the rows; any spacing.
        azimuths: (W,) radians, of the columns; any spacing.
        scores: (..., Q, 4, 9), s_tk of the hypotheses of `surface_hypotheses`, with all leading dimensions, float32,
            float64, bfloat16 or float16. They are computed with in the dtype of `image`, as are the scales.
        scales: (..., Q, 4), c_t of the neighbours.
        wrap: Whether column W-1 meets column 0 (a full circle). Otherwise columns clamp; rows always clamp.
        backend: "warp", or "torch" for the plain twin in `kernels.reference`.

    Returns:
        ranges: (..., Q) metres, 0 for no return, and NaN where a score or the query is NaN.
        support: (..., Q, 4), the probability that the surface of each neighbour is met within 10 cm of the range; where
            the answer is no return, the probability that the neighbour says so. The sum over the neighbours is the
            confidence, the probability that the answer is right.
        no_return: (..., Q), the probability that nothing returns. Like the support it leaves out the ε of Eq. (4).

    Raises:
        TypeError: If an argument is not a floating-point tensor of a supported dtype.
        ValueError: If a shape, device or backend does not fit.

    Source: ours, Eqs. (3) and (4) of `kernels.surfaces.maths`.
    """
    batch, image, queries, tables = _checked(image, queries, elevations, azimuths, backend)
    count = queries.shape[1]
    scores = _of_queries("scores", scores, batch, (count, 4, KINDS), image).detach()
    scales = _of_queries("scales", scales, batch, (count, 4), image).detach()
    op = reference.surface_median if backend == "torch" else _surface_median
    ranges, support, none = op(image, queries, *tables, wrap, scores, scales)
    return ranges.view(*batch, count), support.view(*batch, count, 4), none.view(*batch, count)


def _checked(
    image: torch.Tensor, queries: torch.Tensor, elevations: torch.Tensor, azimuths: torch.Tensor, backend: str
) -> tuple[torch.Size, torch.Tensor, torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
    """Checks what all these ops take.

    Returns:
        The broadcast batch shape, the image (B, H, W), the queries (B, Q, 2), and the tables: elevations (H,) and
        azimuths (W,). All are contiguous, of the image's dtype and without gradients.
    """
    check_backend(backend)
    check_floating("image", image, [torch.float32, torch.float64], "(..., H, W)")
    if image.ndim < 2 or 0 in image.shape[-2:]:
        raise ValueError(f"image has shape {tuple(image.shape)}; it should be (..., H, W), neither of them 0")
    check_queries(queries)
    tables = []
    for name, table, count in (
        ("elevations", elevations, image.shape[-2]),
        ("azimuths", azimuths, image.shape[-1]),
    ):
        check_floating(name, table, [torch.float32, torch.float64], f"({count},)")
        if table.shape != (count,):
            raise ValueError(f"{name} has shape {tuple(table.shape)}; it should be ({count},), as the image has it")
        tables.append(table.detach().to(image.dtype).contiguous())
    check_devices(image=image, queries=queries, elevations=elevations, azimuths=azimuths)
    queries = queries.detach().to(image.dtype)
    batch, (image, queries) = broadcast_batch(image=(image.detach(), 2), queries=(queries, 2))
    return batch, image.contiguous(), queries.contiguous(), (tables[0], tables[1])


def _of_queries(
    name: str, tensor: torch.Tensor, batch: torch.Size, shape: tuple[int, ...], image: torch.Tensor
) -> torch.Tensor:
    """Checks a tensor (*batch, *shape) of something for each query; returns it as (B, *shape) of the image's dtype."""
    dtypes = [torch.float32, torch.float64, torch.bfloat16, torch.float16]
    check_floating(name, tensor, dtypes, str((*batch, *shape)))
    if tensor.shape != (*batch, *shape):
        raise ValueError(f"{name} has shape {tuple(tensor.shape)}; it should be {(*batch, *shape)}")
    check_devices(image=image, **{name: tensor})
    return tensor.to(image.dtype).reshape(len(image), *shape).contiguous()
