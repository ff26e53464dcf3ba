"""plane_prior: what to expect between the pixels where the world is made of planes, as scores of the 4 neighbours.

On a plane the inverse range u = 1/r is linear along a column of the range image. Between two pixels b and c of a
column, f of the way from b, the surfaces that their outer neighbours a and d lie on as well are expected at

    u₁ = b + (b - a) f,    u₂ = c - (d - c) (1 - f)

- Where they meet in a crease that opens towards the sensor, as a road and a house front do, the nearer one is seen:
  max(u₁, u₂).
- Where they do not meet between b and c, and are far apart, one ends where the other is seen behind it: the surface of
  the pixel next to the query, (1 - s) u₁ + s u₂ with a step s = f^k / (f^k + (1 - f)^k) of sharpness k.
- Elsewhere linear interpolation stands, (1 - f) b + f c.

The result, kept between b and c, is λ of the way from b to c. Both columns of a query so have areas 1 - λ and λ, by
which its bilinear areas a_t are replaced; where the columns' own results are far apart, the step is made between them
as well. The prior is log a_t - log r_t as in `gather_blend`'s "perspective": inverse ranges are blended.
"""

import math
from typing import Any

import torch
import warp as wp

from kernels import reference
from kernels.checks import (
    PARTED,
    RANGE_FLOOR,
    SHARPEST,
    broadcast_batch,
    check_backend,
    check_devices,
    check_floating,
    check_queries,
)
from kernels.launch import launch, overload
from kernels.stencil import Grid, bounds, grid_of, query_of
from kernels.vmap import fold_into_batch

__all__ = ["plane_prior"]

_PARTED = wp.constant(PARTED)
_SHARPEST = wp.constant(SHARPEST)
_RANGE_FLOOR = wp.constant(RANGE_FLOOR)


_four = wp.types.vector(4, wp.Float)


@wp.func
def _inverse(image: wp.array3d[wp.Float], b: int, row: int, column: int):
    return image.dtype(1.0) / wp.max(image[b, row, column], image.dtype(_RANGE_FLOOR))


@wp.func
def _apart(difference: Any, u: Any, v: Any):
    """Whether a difference is too large for two inverse ranges to be of one surface."""
    return wp.abs(difference) > type(u)(_PARTED) * wp.min(u, v)


@wp.func
def _step(f: Any, sharpness: Any):
    """s(f); for all sharpness in the world the step function."""
    half = type(f)(0.5)
    one = type(f)(1.0)
    s = wp.where(f < half, type(f)(0.0), one)
    if sharpness < type(f)(_SHARPEST) and f > type(f)(0.0):
        s = one / (one + wp.pow((one - f) / f, sharpness))
    return s


@wp.func
def _between(image: wp.array3d[wp.Float], b: int, above: int, below: int, f: Any, sharpness: Any, column: int):
    """What is expected between two pixels of a column: λ, and the inverse range."""
    u = _inverse(image, b, above, column)
    v = _inverse(image, b, below, column)
    # By how much the surface of each goes on changing towards the other; as they differ, where no outer pixel tells.
    down = v - u
    up = u - v
    if above > 0 and below > above:
        down = u - _inverse(image, b, above - 1, column)
    if below < image.shape[1] - 1 and below > above:
        up = v - _inverse(image, b, below + 1, column)
    first = u + down * f
    second = v + up * (image.dtype(1.0) - f)
    # first - second at either end
    at_u = u - v - up
    at_v = u + down - v
    expected = u + (v - u) * f
    if at_u > image.dtype(0.0) and at_v < image.dtype(0.0):
        expected = wp.max(first, second)
    elif at_u * at_v > image.dtype(0.0) and _apart(at_u, u, v) and _apart(at_v, u, v) and _apart(u - v, u, v):
        low = wp.min(u, v)
        high = wp.max(u, v)
        s = _step(f, sharpness)
        expected = wp.clamp(first, low, high) * (image.dtype(1.0) - s) + wp.clamp(second, low, high) * s
    expected = wp.clamp(expected, wp.min(u, v), wp.max(u, v))
    share = f
    if u != v:
        share = (expected - u) / (v - u)
    return share, expected


@wp.kernel(enable_backward=False)
def _plane_prior_kernel(
    first: int,
    # in
    image: wp.array3d[wp.Float],
    queries: wp.array3d[wp.Float],
    sharpness: wp.Float,
    area_floor: wp.Float,
    grid: Grid,
    # out
    prior_out: wp.array2d[_four],
):
    b, q = query_of(first + wp.tid(), queries.shape[1])
    row = queries[b, q, 0]
    column = queries[b, q, 1]
    above, below, left, right = bounds(row, column, grid)
    f = row - wp.floor(row)
    g = column - wp.floor(column)
    on_left, u = _between(image, b, above, below, f, sharpness, left)
    on_right, v = _between(image, b, above, below, f, sharpness, right)
    one = image.dtype(1.0)
    if _apart(u - v, u, v):
        g = _step(g, sharpness)
    p = prior_out.dtype()
    p[0] = wp.max((one - on_left) * (one - g), area_floor) * _inverse(image, b, above, left)
    p[1] = wp.max((one - on_right) * g, area_floor) * _inverse(image, b, above, right)
    p[2] = wp.max(on_left * (one - g), area_floor) * _inverse(image, b, below, left)
    p[3] = wp.max(on_right * g, area_floor) * _inverse(image, b, below, right)
    for t in range(4):
        p[t] = wp.log(p[t])
    prior_out[b, q] = p


_kernels = overload(_plane_prior_kernel)


@torch.library.custom_op("kernels::plane_prior", mutates_args=())
def _plane_prior(
    image: torch.Tensor, queries: torch.Tensor, sharpness: float, area_floor: float, wrap: bool
) -> torch.Tensor:
    batch, count, _ = queries.shape
    prior = image.new_empty(batch, count, 4)
    _, height, width = image.shape
    inputs = [image, queries, min(sharpness, SHARPEST), area_floor, grid_of(height, width, wrap)]
    launch(_kernels[image.dtype], batch * count, inputs, [prior])
    return prior


@_plane_prior.register_fake
def _(image: torch.Tensor, queries: torch.Tensor, sharpness: float, area_floor: float, wrap: bool) -> torch.Tensor:
    return image.new_empty(queries.shape[0], queries.shape[1], 4)


fold_into_batch(_plane_prior)


def plane_prior(
    image: torch.Tensor,
    queries: torch.Tensor,
    wrap: bool = True,
    *,
    sharpness: float = math.inf,
    area_floor: float = 0.0,
    backend: str = "warp",
) -> torch.Tensor:
    """Scores of the 4 neighbours with which `gather_blend` interpolates planes, creases and edges.

    It says what it expects of measured ranges and carries no gradient: add what a network knows better.

    Args:
        image: (..., H, W) float32 or float64 ranges in metres, no return filled; those below 0.1 are taken as 0.1.
        queries: (..., Q, 2) pixel coordinates (row, column). Leading dimensions broadcast against those of `image`.
        wrap: Whether column W-1 meets column 0 (a full circle). Otherwise columns clamp; rows always clamp.
        sharpness: k ≥ 1 of the step from one surface to the other at an edge; infinite for a choice without a between.
        area_floor: Least area of a neighbour. Above 0, scores can overrule it.
        backend: "warp", or "torch" for the plain twin in `kernels.reference`.

    Returns:
        (..., Q, 4) logarithms of weights; -inf where the area is 0.

    Raises:
        TypeError: If `image` is not float32 or float64, or `queries` not a floating-point tensor.
        ValueError: If a shape, device, sharpness, floor or backend does not fit.

    Source: ours.
    """
    check_backend(backend)
    check_floating("image", image, list(_kernels), "(..., H, W)")
    if image.ndim < 2 or 0 in image.shape[-2:]:
        raise ValueError(f"image has shape {tuple(image.shape)}; it should be (..., H, W), neither of them 0")
    if not 0 <= area_floor < 0.25:
        raise ValueError(f"area_floor is {area_floor}; it should be at least 0 and below 0.25")
    if not sharpness >= 1:
        raise ValueError(f"sharpness is {sharpness}; it should be at least 1")
    check_queries(queries)
    check_devices(image=image, queries=queries)
    queries = queries.detach().to(image.dtype)
    batch, (image, queries) = broadcast_batch(image=(image.detach(), 2), queries=(queries, 2))
    if backend == "torch":
        prior = reference.plane_prior(image, queries, wrap, min(sharpness, SHARPEST), area_floor)
    else:
        prior = _plane_prior(image.contiguous(), queries.contiguous(), sharpness, area_floor, wrap)
    return prior.view(*batch, *prior.shape[1:])
