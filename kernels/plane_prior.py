"""plane_prior: scores of the 4 neighbours that interpolate a world made of planes.

On a plane the inverse range u = 1/r is nearly linear along a column of the range image, if its rows lie evenly and
close together. Take four pixels a, b, c, d of a column, named by their inverse ranges, and a query between b and c, the
fraction f of the way from b. The surface through a and b and the surface through c and d reach the query at

    u₁ = b + (b - a) f,    u₂ = c - (d - c) (1 - f)

- If they meet between b and c in a crease that opens towards the sensor, as a road and a house front do, the nearer
  surface is seen: max(u₁, u₂).
- If they do not meet between b and c and are far apart, the near surface ends somewhere between. The query takes the
  surface of the pixel that is closer to it: (1 - s) u₁ + s u₂ with a step s = f^k / (f^k + (1 - f)^k) of sharpness k.
- Otherwise interpolation is linear: (1 - f) b + f c.

The result is clamped to lie between b and c. If it lies the fraction λ of the way from b to c, the areas of the upper
and the lower neighbour in this column are 1 - λ and λ. They replace the bilinear areas a_t. If the results of the two
columns are far apart, the step is applied between the columns as well. The scores are log a_t - log r_t, as with the
prior "perspective" of `gather_blend`, so that inverse ranges are blended.
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
    check_area_floor,
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
    """The inverse range of a pixel; NaN for NaN."""
    return image.dtype(1.0) / _at_least(image[b, row, column], image.dtype(_RANGE_FLOOR))


@wp.func
def _at_least(x: Any, floor: Any):
    """max(x, floor), but NaN for NaN on every device."""
    return wp.where(x < floor, floor, x)


@wp.func
def _within(x: Any, u: Any, v: Any):
    """The value x, clamped to lie between u and v; NaN for NaN."""
    low = wp.min(u, v)
    high = wp.max(u, v)
    return wp.where(x < low, low, wp.where(x > high, high, x))


@wp.func
def _apart(difference: Any, u: Any, v: Any):
    """Whether a difference of two inverse ranges u and v is too large for one surface."""
    return wp.abs(difference) > type(u)(_PARTED) * wp.min(u, v)


@wp.func
def _step(f: Any, sharpness: Any):
    """The step s(f) of a sharpness; it jumps at f = 1/2 from `SHARPEST` on."""
    half = type(f)(0.5)
    one = type(f)(1.0)
    s = wp.where(f < half, type(f)(0.0), wp.where(f >= half, one, f))  # NaN for NaN
    if sharpness < type(f)(_SHARPEST) and f > type(f)(0.0):
        s = one / (one + wp.pow((one - f) / f, sharpness))
    return s


@wp.func
def _between(image: wp.array3d[wp.Float], b: int, above: int, below: int, f: Any, sharpness: Any, column: int):
    """Returns λ and the expected inverse range between two pixels of a column."""
    u = _inverse(image, b, above, column)
    v = _inverse(image, b, below, column)
    # Change of each surface towards the other pixel. Without an outer pixel it is the difference of the two.
    down = v - u
    up = u - v
    if above > 0 and below > above:
        down = u - _inverse(image, b, above - 1, column)
    if below < image.shape[1] - 1 and below > above:
        up = v - _inverse(image, b, below + 1, column)
    first = u + down * f
    second = v + up * (image.dtype(1.0) - f)
    # first - second at either pixel
    at_u = u - v - up
    at_v = u + down - v
    expected = u + (v - u) * f
    if at_u > image.dtype(0.0) and at_v < image.dtype(0.0):
        expected = wp.max(first, second)
    elif at_u * at_v > image.dtype(0.0) and _apart(at_u, u, v) and _apart(at_v, u, v) and _apart(u - v, u, v):
        s = _step(f, sharpness)
        expected = _within(first, u, v) * (image.dtype(1.0) - s) + _within(second, u, v) * s
    expected = _within(expected, u, v)
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
    p[0] = _at_least((one - on_left) * (one - g), area_floor) * _inverse(image, b, above, left)
    p[1] = _at_least((one - on_right) * g, area_floor) * _inverse(image, b, above, right)
    p[2] = _at_least(on_left * (one - g), area_floor) * _inverse(image, b, below, left)
    p[3] = _at_least(on_right * g, area_floor) * _inverse(image, b, below, right)
    for t in range(4):
        p[t] = wp.log(p[t])
    prior_out[b, q] = p


_kernels = overload(_plane_prior_kernel)


def _empty_prior(
    image: torch.Tensor, queries: torch.Tensor, sharpness: float, area_floor: float, wrap: bool
) -> torch.Tensor:
    return image.new_empty(queries.shape[0], queries.shape[1], 4)


@torch.library.custom_op("kernels::plane_prior", mutates_args=())
def _plane_prior(
    image: torch.Tensor, queries: torch.Tensor, sharpness: float, area_floor: float, wrap: bool
) -> torch.Tensor:
    batch, count, _ = queries.shape
    prior = _empty_prior(image, queries, sharpness, area_floor, wrap)
    _, height, width = image.shape
    inputs = [image, queries, min(sharpness, SHARPEST), area_floor, grid_of(height, width, wrap)]
    launch(_kernels[image.dtype], batch * count, inputs, [prior])
    return prior


_plane_prior.register_fake(_empty_prior)
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
    """Computes scores of the 4 neighbours with which `gather_blend` interpolates planes, creases and edges.

    The scores follow from measured ranges and carry no gradient. A network's scores can be added to them.

    Args:
        image: (..., H, W) float32 or float64 ranges in metres, no return filled. Ranges below 0.1 are taken as 0.1.
        queries: (..., Q, 2) pixel coordinates (row, column). Leading dimensions broadcast against those of `image`.
        wrap: Whether column W-1 meets column 0 (a full circle). Otherwise columns clamp. Rows always clamp.
        sharpness: k ≥ 1 of the step from one surface to the other at an edge. If it is infinite, each query takes one
            of the two surfaces.
        area_floor: Least area of a neighbour. Above 0, added scores can overrule an area of 0.
        backend: "warp", or "torch" for the plain twin in `kernels.reference`.

    Returns:
        (..., Q, 4) logarithms of weights. They are -inf where the area is 0, and NaN where the query is or a neighbour
        in the same column.

    Raises:
        TypeError: If `image` is not float32 or float64, or `queries` not a floating-point tensor.
        ValueError: If a shape, device, sharpness, floor or backend does not fit.

    Source: ours.
    """
    check_backend(backend)
    check_floating("image", image, list(_kernels), "(..., H, W)")
    if image.ndim < 2 or 0 in image.shape[-2:]:
        raise ValueError(f"image has shape {tuple(image.shape)}; it should be (..., H, W), neither of them 0")
    check_area_floor(area_floor)
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
