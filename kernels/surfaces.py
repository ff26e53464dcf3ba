"""surfaces: ranges at which the surfaces of the 4 neighbours of a query may be met, and how likely each of them is.

Take two pixels t and o of one column of the range image, and let α be the elevation. Along the column the inverse range
u = 1/r of a plane is A cos α + B sin α. Two pixels therefore tell it at the elevation α of any query:

    u(α) = (u_t sin(α_o - α) + u_o sin(α - α_t)) / sin(α_o - α_t)                                                    (1)

Along a row α is the azimuth, and u is A cos α + B sin α + C. There Eq. (1) leaves an error of at most about δ² C, from
one gap δ before the two pixels to one behind them.

Each neighbour t lies on a surface that may go on to the query. Along the column there are three ways to continue it:
with the *outer* pixel, the one beyond t as seen from the query; with the *inner* pixel, the one on the query's side; or
not at all, since t may be all there is of its surface. Along the row there are the same three. The change along the
column and the change along the row are added. That makes 9 hypotheses for a neighbour and 36 for a query:

    u_tk = u_t + (u_v(α_v) - u_t) + (u_h(α_h) - u_t),    r_tk = 1 / u_tk,    u_t / 4 <= u_tk <= 4 u_t                (2)

Where one of the two pixels has no return, or the gap between them is wider than 0.5 rad, nothing is continued and
u(α) = u_t. All hypotheses of a neighbour without a return say that nothing returns.

A network gives each hypothesis a score s_tk and each neighbour a scale c_t. The bilinear areas a_t are the prior:

    w_tk = softmax(s_tk + log max(a_t, 0.001)),    b_t = 0.5 log(1 + exp c_t) + 0.02 m                               (3)

The range r of a query then has the following density, a mixture of Laplace distributions, and nothing returns with the
following probability:

    p(r) = (1 - 2 ε) Σ_tk w_tk exp(-|r_tk - r| / b_t) / 2 b_t + ε / R      over the hypotheses that return           (4)
    p(none) = (1 - 2 ε) Σ_tk w_tk + ε                                      over those that do not

ε = 0.001 is for what no neighbour tells. R is the range that a no return counts as.

The answer is the weighted median of the r_tk, where a no return is farther than any range. Of all answers the median
has the least expected absolute error. It is one of the hypotheses, so that no point floats between two surfaces.
"""

import math
from typing import Any

import torch
import warp as wp

from kernels import reference
from kernels.checks import (
    AREA_FLOOR,
    BACKGROUND,
    CONTINUED,
    KINDS,
    LEAST_RANGE,
    LEAST_SCALE,
    TOLERANCE,
    WIDEST_GAP,
    broadcast_batch,
    check_backend,
    check_devices,
    check_floating,
    check_queries,
)
from kernels.lanes import exp2
from kernels.launch import launch
from kernels.stencil import area, base, column_of, query_of
from kernels.vmap import refuse

__all__ = ["surface_hypotheses", "surface_likelihood", "surface_median"]

_AREA_FLOOR = wp.constant(AREA_FLOOR)
_BACKGROUND = wp.constant(BACKGROUND)
_CONTINUED = wp.constant(CONTINUED)
_LEAST_RANGE = wp.constant(LEAST_RANGE)
_LEAST_SCALE = wp.constant(LEAST_SCALE)
_TOLERANCE = wp.constant(TOLERANCE)
_WIDEST_GAP = wp.constant(WIDEST_GAP)
_TURN = wp.constant(6.283185307179586)


@wp.func
def _sine(x: Any):
    """The sine of |x| <= 1 to 3e-8; far faster than `wp.sin`, which no CPU compiler turns into SIMD instructions."""
    s = x * x
    p = type(x)(2.7557319e-6) * s - type(x)(1.984126984e-4)
    p = p * s + type(x)(8.333333333e-3)
    p = p * s - type(x)(0.16666666667)
    return x + x * s * p


@wp.func
def _gap(table: wp.array[Any], index: int, other: int, wrap: int):
    """The angle from pixel `index` to pixel `other` of a row or column, the short way round on a full circle."""
    gap = table[other] - table[index]
    if wrap != 0:
        turn = type(gap)(_TURN)
        gap = gap - turn * wp.round(gap / turn)
    return gap


@wp.func
def _continue(gap: Any, angle: Any):
    """What u_t and u_o are multiplied by in u(α) - u_t, with α and α_o counted from t; Eq. (1)."""
    if gap == type(gap)(0.0) or wp.abs(gap) > type(gap)(_WIDEST_GAP):
        return type(gap)(0.0), type(gap)(0.0)
    sine = _sine(gap)
    return _sine(gap - angle) / sine - type(gap)(1.0), _sine(angle) / sine


@wp.func
def _within(x: Any, low: Any, high: Any):
    """The value x, clamped to lie between low and high; NaN for NaN, which `wp.clamp` may drop."""
    return wp.where(x < low, low, wp.where(x > high, high, x))


@wp.func
def _along(coordinate: Any, side: int, table: wp.array[Any], wrap: int):
    """Along one axis, for the neighbours on one side of a query: pixel, outer and inner pixel, and their factors.

    `side` is 0 for the neighbours below the coordinate and 1 for those above. The factors are two for the outer pixel
    and two for the inner one, see `_continue`.
    """
    count = table.shape[0]
    unbounded = base(coordinate) + side
    if wrap == 0:
        unbounded = wp.clamp(unbounded, 0, count - 1)
    offset = coordinate - type(coordinate)(unbounded)
    towards = wp.where(offset < type(coordinate)(0.0), -1, 1)
    t = column_of(unbounded, count, wrap)
    inner = column_of(unbounded + towards, count, wrap)
    outer = column_of(unbounded - towards, count, wrap)
    inner_gap = _gap(table, t, inner, wrap)
    outer_gap = _gap(table, t, outer, wrap)
    # Beyond the table its last spacing goes on.
    spacing = wp.where(inner == t, -outer_gap, inner_gap)
    limit = type(coordinate)(_WIDEST_GAP)
    angle = _within(wp.abs(offset) * spacing, -limit, limit)
    a_outer, b_outer = _continue(outer_gap, angle)
    a_inner, b_inner = _continue(inner_gap, angle)
    return t, outer, inner, a_outer, b_outer, a_inner, b_inner


@wp.func
def _inverse(image: wp.array3d[Any], b: int, i: int, j: int):
    """The inverse range u of a pixel; 0 where nothing returned."""
    r = image[b, i, j]
    one = type(r)(1.0)
    return wp.where(r > type(r)(0.0), one / wp.max(r, type(r)(_LEAST_RANGE)), type(r)(0.0))


@wp.func
def _change(u: Any, other: Any, a: Any, b: Any):
    """u(α) - u_t; 0 where one of the pixels has no return."""
    zero = type(u)(0.0)
    return wp.where(u > zero and other > zero, u * a + other * b, zero)


@wp.func
def _hypotheses(rays: Any, b: int, row: Any, column: Any, zeros: Any):
    """The ranges r_tk of a query, number 9 t + 3 v + h for continuation v along the column and h along the row.

    Continuations are 0, outer; 1, inner; 2, none. No return is 0.
    """
    found = zeros
    zero = type(row)(0.0)
    within = type(row)(_CONTINUED)
    v = wp.vector(length=3, dtype=type(row))
    h = wp.vector(length=3, dtype=type(row))
    for t in range(4):
        i, i_outer, i_inner, a_outer, b_outer, a_inner, b_inner = _along(row, t // 2, rays.elevations, 0)
        j, j_outer, j_inner, c_outer, d_outer, c_inner, d_inner = _along(column, t % 2, rays.azimuths, rays.wrap)
        u = _inverse(rays.image, b, i, j)
        v[0] = _change(u, _inverse(rays.image, b, i_outer, j), a_outer, b_outer)
        v[1] = _change(u, _inverse(rays.image, b, i_inner, j), a_inner, b_inner)
        h[0] = _change(u, _inverse(rays.image, b, i, j_outer), c_outer, d_outer)
        h[1] = _change(u, _inverse(rays.image, b, i, j_inner), c_inner, d_inner)
        for k in range(9):
            x = _within(u + v[k // 3] + h[k % 3], u / within, u * within)
            found[9 * t + k] = wp.where(u > zero, type(row)(1.0) / x, zero)
    return found


@wp.func
def _weigh(scores: Any, row: Any, column: Any):
    """The weights of Eq. (3), up to a common factor."""
    largest = scores[0]
    for k in range(len(scores)):
        largest = wp.max(largest, scores[k])
    w = scores
    for k in range(len(scores)):
        w[k] = (scores[k] - largest) * type(row)(1.4426950408889634)
    w = exp2(w)
    for t in range(4):
        a = area(row, column, t)
        a = wp.where(a < type(row)(_AREA_FLOOR), type(row)(_AREA_FLOOR), a)  # not `max`, which may drop NaN
        for k in range(9):
            w[9 * t + k] = w[9 * t + k] * a
    return w


@wp.func
def _scale(c: Any):
    """b_t of Eq. (3)."""
    softplus = wp.max(c, type(c)(0.0)) + wp.log(type(c)(1.0) + wp.exp(-wp.abs(c)))
    return type(c)(0.5) * softplus + type(c)(_LEAST_SCALE)


@wp.func
def _explain(found: Any, scales: Any, target: Any, far: Any):
    """What each hypothesis says of a measured range by Eq. (4), and the absolute error.

    What it says is a density, or a probability where nothing returned.
    """
    zero = type(target)(0.0)
    gap = found
    p = found
    for k in range(len(found)):
        gap[k] = wp.abs(wp.where(found[k] > zero, found[k], far) - wp.where(target > zero, target, far))
    for t in range(4):
        b = _scale(scales[t])
        for k in range(9):
            p[9 * t + k] = gap[9 * t + k] / b * type(target)(-1.4426950408889634)
    p = exp2(p)
    for t in range(4):
        half = type(target)(0.5) / _scale(scales[t])
        for k in range(9):
            p[9 * t + k] = p[9 * t + k] * wp.where(target > zero, half, type(target)(1.0))
    for k in range(len(found)):
        p[k] = wp.where((found[k] > zero) == (target > zero), p[k], zero)
    return p, gap


@wp.func
def _mass(x: Any):
    """The distribution function of the Laplace distribution of scale 1."""
    half = type(x)(0.5) * wp.exp(-wp.abs(x))
    return wp.where(x < type(x)(0.0), half, type(x)(1.0) - half)


@wp.func
def _settle(found: Any, w: Any, scales: Any):
    """The weighted median of hypotheses, the probability that each neighbour's surface is met there, that of no return.

    The median is 0 for no return and NaN where a weight is NaN.
    """
    zero = type(scales[0])(0.0)
    infinite = type(scales[0])(wp.inf)
    r = found
    whole = zero
    none = zero
    for k in range(len(found)):
        r[k] = wp.where(found[k] > zero, found[k], infinite)
        whole = whole + w[k]
        none = none + wp.where(found[k] > zero, zero, w[k])
    # Weight of all that is no farther, of every hypothesis at once: a sort in no order, without a branch.
    below = type(found)()
    for j in range(len(found)):
        for k in range(len(found)):
            below[k] = below[k] + wp.where(r[j] <= r[k], w[j], zero)
    median = infinite
    for k in range(len(found)):
        median = wp.min(median, wp.where(below[k] >= type(zero)(0.5) * whole, r[k], infinite))
    known = (type(zero)(1.0) - type(zero)(2.0) * type(zero)(_BACKGROUND)) / whole
    support = scales
    for t in range(4):
        inverse = type(zero)(1.0) / _scale(scales[t])
        met = zero
        for k in range(9):
            x = r[9 * t + k]
            near = wp.where(x < infinite, zero, type(zero)(1.0))
            if median < infinite:
                near = zero
                if x < infinite:
                    near = _mass((median - x + type(zero)(_TOLERANCE)) * inverse)
                    near = near - _mass((median - x - type(zero)(_TOLERANCE)) * inverse)
            met = met + w[9 * t + k] * near
        support[t] = met * known
    if median == infinite:
        median = wp.where(whole >= zero, zero, whole)  # NaN for NaN
    return median, support, none * known


def _kernels(scalar: type) -> tuple[wp.Kernel, ...]:
    """Returns the four kernels for float32 or float64. They are made for each, since no struct's arrays are generic."""
    many, four = wp.types.vector(4 * KINDS, scalar), wp.types.vector(4, scalar)

    @wp.struct
    class Rays:
        """What was measured, and the rays that are asked for."""

        image: wp.array3d[scalar]
        """(B, H, W) metres, 0 where nothing returned."""
        elevations: wp.array[scalar]
        """(H,) radians."""
        azimuths: wp.array[scalar]
        """(W,) radians."""
        queries: wp.array3d[scalar]
        """(B, Q, 2) pixel coordinates."""
        wrap: int
        """1 if column W-1 meets column 0, else 0."""

    @wp.kernel(enable_backward=False)
    def _hypotheses_kernel(
        first: int,
        # in
        rays: Rays,
        # out
        found_out: wp.array2d[many],
    ):
        b, q = query_of(first + wp.tid(), rays.queries.shape[1])
        found_out[b, q] = _hypotheses(rays, b, rays.queries[b, q, 0], rays.queries[b, q, 1], found_out.dtype())

    @wp.kernel(enable_backward=False)
    def _likelihood_kernel(
        first: int,
        # in
        rays: Rays,
        scores: wp.array2d[many],
        scales: wp.array2d[four],
        targets: wp.array2d[scalar],
        far: scalar,
        # out
        likelihood_out: wp.array2d[scalar],
        error_out: wp.array2d[scalar],
    ):
        b, q = query_of(first + wp.tid(), rays.queries.shape[1])
        row = rays.queries[b, q, 0]
        column = rays.queries[b, q, 1]
        target = targets[b, q]
        w = _weigh(scores[b, q], row, column)
        found = _hypotheses(rays, b, row, column, scores.dtype())
        p, gap = _explain(found, scales[b, q], target, far)
        background = scalar(_BACKGROUND)
        whole = scalar(0.0)
        explained = scalar(0.0)
        error = scalar(0.0)
        for k in range(len(w)):
            whole = whole + w[k]
            explained = explained + w[k] * p[k]
            error = error + w[k] * gap[k]
        unexplained = wp.where(target > scalar(0.0), background / far, background)
        likelihood_out[b, q] = -wp.log((scalar(1.0) - scalar(2.0) * background) * explained / whole + unexplained)
        error_out[b, q] = error / whole

    @wp.kernel(enable_backward=False)
    def _likelihood_backward_kernel(
        first: int,
        # in
        rays: Rays,
        scores: wp.array2d[many],
        scales: wp.array2d[four],
        targets: wp.array2d[scalar],
        far: scalar,
        adj_likelihood: wp.array2d[scalar],
        adj_error: wp.array2d[scalar],
        # out
        adj_scores_out: wp.array2d[many],
        adj_scales_out: wp.array2d[four],
    ):
        b, q = query_of(first + wp.tid(), rays.queries.shape[1])
        row = rays.queries[b, q, 0]
        column = rays.queries[b, q, 1]
        target = targets[b, q]
        w = _weigh(scores[b, q], row, column)
        found = _hypotheses(rays, b, row, column, scores.dtype())
        p, gap = _explain(found, scales[b, q], target, far)
        zero = scalar(0.0)
        one = scalar(1.0)
        background = scalar(_BACKGROUND)
        whole = zero
        for k in range(len(w)):
            whole = whole + w[k]
        explained = zero
        error = zero
        for k in range(len(w)):
            w[k] = w[k] / whole
            explained = explained + w[k] * p[k]
            error = error + w[k] * gap[k]
        unexplained = wp.where(target > zero, background / far, background)
        known = one - scalar(2.0) * background
        factor = known / (known * explained + unexplained) * adj_likelihood[b, q]
        adj_scores = scores.dtype()
        for k in range(len(w)):
            adj_scores[k] = w[k] * (adj_error[b, q] * (gap[k] - error) - factor * (p[k] - explained))
        adj_scores_out[b, q] = adj_scores
        adj_scales = scales.dtype()
        for t in range(4):
            c = scales[b, q][t]
            inverse = one / _scale(c)
            total = zero
            for k in range(9):
                total = total + w[9 * t + k] * p[9 * t + k] * (gap[9 * t + k] * inverse - one) * inverse
            slope = scalar(0.5) / (one + wp.exp(-c))  # of b_t in c_t
            adj_scales[t] = wp.where(target > zero, -factor * total * slope, zero)
        adj_scales_out[b, q] = adj_scales

    @wp.kernel(enable_backward=False)
    def _median_kernel(
        first: int,
        # in
        rays: Rays,
        scores: wp.array2d[many],
        scales: wp.array2d[four],
        # out
        ranges_out: wp.array2d[scalar],
        support_out: wp.array2d[four],
        none_out: wp.array2d[scalar],
    ):
        b, q = query_of(first + wp.tid(), rays.queries.shape[1])
        row = rays.queries[b, q, 0]
        column = rays.queries[b, q, 1]
        w = _weigh(scores[b, q], row, column)
        found = _hypotheses(rays, b, row, column, scores.dtype())
        median, support, none = _settle(found, w, scales[b, q])
        ranges_out[b, q] = median
        support_out[b, q] = support
        none_out[b, q] = none

    return _hypotheses_kernel, _likelihood_kernel, _likelihood_backward_kernel, _median_kernel


_SCALARS = {torch.float32: wp.float32, torch.float64: wp.float64}
_made = {dtype: _kernels(scalar) for dtype, scalar in _SCALARS.items()}
_found, _likelihood, _likelihood_backward, _median = (
    {dtype: kernels[n] for dtype, kernels in _made.items()} for n in range(4)
)


def _rays(
    image: torch.Tensor, queries: torch.Tensor, elevations: torch.Tensor, azimuths: torch.Tensor, wrap: bool
) -> dict[str, Any]:
    """Returns the fields of `Rays` for `kernels.launch.launch`."""
    tensors = {"image": image, "elevations": elevations, "azimuths": azimuths, "queries": queries}
    return {**tensors, "wrap": int(wrap)}


def _empty_hypotheses(image: torch.Tensor, queries: torch.Tensor, *_: Any) -> torch.Tensor:
    return image.new_empty(*queries.shape[:2], 4, KINDS)


@torch.library.custom_op("kernels::surface_hypotheses", mutates_args=())
def _surface_hypotheses(
    image: torch.Tensor, queries: torch.Tensor, elevations: torch.Tensor, azimuths: torch.Tensor, wrap: bool
) -> torch.Tensor:
    found = _empty_hypotheses(image, queries)
    inputs = [_rays(image, queries, elevations, azimuths, wrap)]
    launch(_found[image.dtype], queries[..., 0].numel(), inputs, [found])
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
    inputs = [_rays(image, queries, elevations, azimuths, wrap), scores, scales, targets, far]
    launch(_likelihood[image.dtype], targets.numel(), inputs, [likelihood, error])
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
    inputs = [
        _rays(image, queries, elevations, azimuths, wrap),
        scores,
        scales,
        targets,
        far,
        adj_likelihood,
        adj_error,
    ]
    launch(_likelihood_backward[image.dtype], targets.numel(), inputs, [adj_scores, adj_scales])
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
    inputs = [_rays(image, queries, elevations, azimuths, wrap), scores, scales]
    launch(_median[image.dtype], ranges.numel(), inputs, [ranges, support, none])
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

    Source: ours, Eq. (2) of `kernels.surfaces`.
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
        error: (..., Q) metres, the expected absolute error Σ_tk w_tk |r_tk - r|.

    Raises:
        TypeError: If an argument is not a floating-point tensor of a supported dtype.
        ValueError: If a shape, device, `far` or backend does not fit.

    Source: ours, Eqs. (3) and (4) of `kernels.surfaces`.
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

    Source: ours, Eqs. (3) and (4) of `kernels.surfaces`.
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
    check_floating("image", image, list(_found), "(..., H, W)")
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
