"""interpolate_planes: ranges between the pixels of an image, right in a world made of planes.

On a plane the inverse range u = 1/r is nearly linear along a column of the range image, if its rows lie evenly and
close together. Take four pixels a, b, c, d of a column, named by their inverse ranges, and a query between b and c, the
fraction f of the way from b. The surface through a and b and the surface through c and d reach the query at

    u₁ = b + (b - a) f,    u₂ = c - (d - c) (1 - f)

- If they meet between b and c in a crease that opens towards the sensor, as a road and a house front do, the nearer
  surface is seen: max(u₁, u₂).
- If they do not meet between b and c and are far apart, the near surface ends somewhere between. The query takes the
  surface of the pixel that is closer to it: u₁ if f < 1/2, else u₂.
- Otherwise interpolation is linear: (1 - f) b + f c.

The result is clamped to lie between b and c. Between the results of the two columns beside the query, interpolation is
linear as well. If they are far apart, the query takes that of the closer column.
"""

from typing import Any

import torch
import warp as wp

from kernels import reference
from kernels.checks import (
    PARTED,
    RANGE_FLOOR,
    broadcast_batch,
    check_backend,
    check_devices,
    check_floating,
    check_queries,
)
from kernels.launch import launch, overload
from kernels.stencil import Grid, bounds, grid_of, query_of
from kernels.vmap import fold_into_batch

__all__ = ["interpolate_planes"]

_PARTED = wp.constant(PARTED)
_RANGE_FLOOR = wp.constant(RANGE_FLOOR)


@wp.func
def _inverse(image: wp.array3d[wp.Float], b: int, row: int, column: int):
    """The inverse range of a pixel; NaN for NaN."""
    r = image[b, row, column]
    floor = image.dtype(_RANGE_FLOOR)
    return image.dtype(1.0) / wp.where(r < floor, floor, r)


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
def _between(image: wp.array3d[wp.Float], b: int, above: int, below: int, f: Any, column: int):
    """The inverse range expected between two pixels of a column, the fraction f of the way from the one above."""
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
        expected = wp.where(f < image.dtype(0.5), first, second)
    return _within(expected, u, v)


@wp.kernel(enable_backward=False)
def _interpolate_planes_kernel(
    first: int,
    # in
    image: wp.array3d[wp.Float],
    queries: wp.array3d[wp.Float],
    grid: Grid,
    # out
    ranges_out: wp.array2d[wp.Float],
):
    b, q = query_of(first + wp.tid(), queries.shape[1])
    row = queries[b, q, 0]
    column = queries[b, q, 1]
    above, below, left, right = bounds(row, column, grid)
    f = row - wp.floor(row)
    g = column - wp.floor(column)
    u = _between(image, b, above, below, f, left)
    v = _between(image, b, above, below, f, right)
    if _apart(u - v, u, v):
        g = wp.floor(g + image.dtype(0.5))  # the closer column; NaN for NaN
    ranges_out[b, q] = image.dtype(1.0) / (u + (v - u) * g)


_kernels = overload(_interpolate_planes_kernel)


def _empty_ranges(image: torch.Tensor, queries: torch.Tensor, wrap: bool) -> torch.Tensor:
    return image.new_empty(queries.shape[:2])


@torch.library.custom_op("kernels::interpolate_planes", mutates_args=())
def _interpolate_planes(image: torch.Tensor, queries: torch.Tensor, wrap: bool) -> torch.Tensor:
    ranges = _empty_ranges(image, queries, wrap)
    _, height, width = image.shape
    launch(_kernels[image.dtype], ranges.numel(), [image, queries, grid_of(height, width, wrap)], [ranges])
    return ranges


_interpolate_planes.register_fake(_empty_ranges)
fold_into_batch(_interpolate_planes)


def interpolate_planes(
    image: torch.Tensor, queries: torch.Tensor, wrap: bool = True, *, backend: str = "warp"
) -> torch.Tensor:
    """Continues the planes around each query to their crease or edge.

    It gives no gradients.

    Args:
        image: (..., H, W) float32 or float64 ranges in metres, no return filled. Ranges below 0.1 are taken as 0.1.
        queries: (..., Q, 2) pixel coordinates (row, column). Leading dimensions broadcast against those of `image`.
        wrap: Whether column W-1 meets column 0 (a full circle). Otherwise columns clamp. Rows always clamp.
        backend: "warp", or "torch" for the plain twin in `kernels.reference`.

    Returns:
        (..., Q) metres, between those of the 4 neighbours. They are NaN where the query or a neighbour is.

    Raises:
        TypeError: If `image` is not float32 or float64, or `queries` not a floating-point tensor.
        ValueError: If a shape, device or backend does not fit.

    Source: ours.
    """
    check_backend(backend)
    check_floating("image", image, list(_kernels), "(..., H, W)")
    if image.ndim < 2 or 0 in image.shape[-2:]:
        raise ValueError(f"image has shape {tuple(image.shape)}; it should be (..., H, W), neither of them 0")
    check_queries(queries)
    check_devices(image=image, queries=queries)
    queries = queries.detach().to(image.dtype)
    batch, (image, queries) = broadcast_batch(image=(image.detach(), 2), queries=(queries, 2))
    if backend == "torch":
        ranges = reference.interpolate_planes(image, queries, wrap)
    else:
        ranges = _interpolate_planes(image.contiguous(), queries.contiguous(), wrap)
    return ranges.view(*batch, queries.shape[1])
