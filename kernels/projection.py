"""Rays from one point: triangles are projected onto the range image, instead of walking a tree for every ray.

The rays of a column lie in a half-plane that ends in the vertical axis of the sensor. It cuts a triangle in a segment
(ρ₁, z₁)-(ρ₂, z₂), whose ends bound the rows that see it, and a ray of slope m = tan(elevation) meets the line through
them at

    ρ = (ρ₁ Δz - z₁ Δρ) / (Δz - m Δρ),    range = ρ √(1 + m²)

exactly, without a tree over the triangles. The azimuths of a triangle's corners tell which columns to cut it with;
columns are shared out in blocks, so that no two threads write to one.
"""

import torch
import warp as wp

from kernels.launch import launch

__all__ = ["project_triangles"]

# Blocks of columns. Each looks at the columns of every triangle.
_BLOCKS = 16
# Radians that a triangle's columns are widened by: the cut decides, but float32 decides what is cut.
_MARGIN = 1e-5
# Metres from the vertical axis that a segment is cut off at, where it crosses the axis; and the least range.
_NEAR = 1e-6

_TURN = wp.constant(6.283185307179586)


@wp.func
def _lower_bound(table: wp.array[float], value: float):
    """How many entries of a rising table are below a value."""
    begin = wp.int32(0)
    end = table.shape[0]
    while begin < end:
        middle = (begin + end) // 2
        if table[middle] < value:
            begin = middle + 1
        else:
            end = middle
    return begin


@wp.kernel(enable_backward=False)
def _find_columns_kernel(
    first: int,
    # in
    corners: wp.array[wp.vec3],
    angles: wp.array[float],
    triangles: wp.array[wp.vec3i],
    azimuths: wp.array[float],
    max_range: float,
    margin: float,
    # out
    columns_out: wp.array[wp.vec2i],
):
    f = first + wp.tid()
    t = triangles[f]
    a = corners[t[0]]
    b = corners[t[1]]
    c = corners[t[2]]
    edge = wp.max(wp.length(b - a), wp.max(wp.length(c - b), wp.length(a - c)))
    nearest = wp.min(wp.length(a), wp.min(wp.length(b), wp.length(c)))
    ab = a[0] * b[1] - a[1] * b[0]
    bc = b[0] * c[1] - b[1] * c[0]
    ca = c[0] * a[1] - c[1] * a[0]
    columns = wp.vec2i(0, 0)
    if nearest - edge <= max_range:
        if (ab >= 0.0 and bc >= 0.0 and ca >= 0.0) or (ab <= 0.0 and bc <= 0.0 and ca <= 0.0):
            columns[1] = azimuths.shape[0]  # around the vertical axis
        else:
            u = angles[t[0]]
            v = angles[t[1]]
            w = angles[t[2]]
            low = wp.min(u, wp.min(v, w))
            high = wp.max(u, wp.max(v, w))
            if high - low > 0.5 * _TURN:  # across ±π
                if u < 0.0:
                    u = u + _TURN
                if v < 0.0:
                    v = v + _TURN
                if w < 0.0:
                    w = w + _TURN
                low = wp.min(u, wp.min(v, w))
                high = wp.max(u, wp.max(v, w))
            low = low - margin
            high = high + margin
            turns = wp.floor((low - azimuths[0]) / _TURN) * _TURN
            low = low - turns
            high = high - turns
            columns[0] = _lower_bound(azimuths, low)
            columns[1] = _lower_bound(azimuths, high) + _lower_bound(azimuths, high - _TURN) - columns[0]
    columns_out[f] = columns


@wp.func
def _cut(
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
    sine: float,
    cosine: float,
    slopes: wp.array[float],
    max_range: float,
    near: float,
    column: int,
    # out
    ranges_out: wp.array2d[float],
):
    """Cuts a triangle by the half-plane of a column, and keeps what is nearer than what its rows saw so far."""
    sa = cosine * a[1] - sine * a[0]
    sb = cosine * b[1] - sine * b[0]
    sc = cosine * c[1] - sine * c[0]
    # The corner alone on its side of the plane: its two edges are cut.
    left_a = sa <= 0.0
    left_b = sb <= 0.0
    left_c = sc <= 0.0
    if left_a == left_b and left_b == left_c:
        return
    p = a
    q = b
    r = c
    sp = sa
    sq = sb
    sr = sc
    if left_a == left_c:
        p = b
        q = c
        r = a
        sp = sb
        sq = sc
        sr = sa
    elif left_a == left_b:
        p = c
        q = a
        r = b
        sp = sc
        sq = sa
        sr = sb
    d = p + (q - p) * (sp / (sp - sq))
    e = p + (r - p) * (sp / (sp - sr))
    rho1 = cosine * d[0] + sine * d[1]
    rho2 = cosine * e[0] + sine * e[1]
    z1 = d[2]
    z2 = e[2]
    if rho1 < near and rho2 < near:
        return
    drho = rho2 - rho1
    dz = z2 - z1
    numerator = rho1 * dz - z1 * drho
    if rho1 < near:
        z1 = z1 + dz * (near - rho1) / drho
        rho1 = near
    if rho2 < near:
        z2 = z2 + dz * (near - rho2) / drho
        rho2 = near
    m1 = z1 / rho1
    m2 = z2 / rho2
    high = wp.max(m1, m2)
    row = _lower_bound(slopes, wp.min(m1, m2))
    while row < slopes.shape[0]:
        m = slopes[row]
        if m > high:
            return
        distance = numerator / (dz - m * drho) * wp.sqrt(1.0 + m * m)
        if distance > near and distance <= max_range and distance < ranges_out[column, row]:
            ranges_out[column, row] = distance
        row += 1


@wp.kernel(enable_backward=False)
def _project_kernel(
    first: int,
    # in
    corners: wp.array[wp.vec3],
    triangles: wp.array[wp.vec3i],
    columns: wp.array[wp.vec2i],
    sines: wp.array[float],
    cosines: wp.array[float],
    slopes: wp.array[float],
    max_range: float,
    near: float,
    span: int,
    # out
    ranges_out: wp.array2d[float],
):
    width = sines.shape[0]
    begin = (first + wp.tid()) * span
    end = wp.min(begin + span, width)
    for column in range(begin, end):
        for row in range(slopes.shape[0]):
            ranges_out[column, row] = wp.inf
    for f in range(triangles.shape[0]):
        start = columns[f][0]
        stop = start + columns[f][1]
        if wp.min(stop, end) > wp.max(start, begin) or stop - width > begin:
            t = triangles[f]
            for column in range(wp.max(start, begin), wp.min(stop, end)):
                _cut(
                    corners[t[0]], corners[t[1]], corners[t[2]], sines[column], cosines[column], slopes,
                    max_range, near, column, ranges_out,
                )  # fmt: skip
            for column in range(begin, wp.min(stop - width, end)):
                _cut(
                    corners[t[0]], corners[t[1]], corners[t[2]], sines[column], cosines[column], slopes,
                    max_range, near, column, ranges_out,
                )  # fmt: skip


def project_triangles(
    corners: torch.Tensor,
    triangles: torch.Tensor,
    elevations: torch.Tensor,
    azimuths: torch.Tensor,
    max_range: float,
) -> torch.Tensor:
    """Finds the range of the nearest triangle along each ray of a range image.

    Args:
        corners: (V, 3) float32, metres, in the frame of the sensor, which stands at its origin.
        triangles: (F, 3) int32, numbers of the corners.
        elevations: (H,) rad, of the rows, within ±90 degrees.
        azimuths: (W,) rad, of the columns, all different, within one turn.
        max_range: Metres; farther surfaces are not seen.

    Returns:
        (H, W) float32 metres; 0 where nothing is met.
    """
    device = corners.device
    azimuths, column_order = azimuths.to(device).double().sort()
    slopes, row_order = elevations.to(device).double().tan().float().sort()
    columns = torch.empty(len(triangles), 2, dtype=torch.int32, device=device)
    angles = torch.atan2(corners[:, 1], corners[:, 0])
    inputs = [corners.contiguous(), angles, triangles, azimuths.float(), max_range, _MARGIN]
    launch(_find_columns_kernel, len(triangles), inputs, [columns])
    ranges = torch.empty(len(azimuths), len(slopes), device=device)
    tables = [azimuths.sin().float(), azimuths.cos().float(), slopes]
    span = -(-len(azimuths) // _BLOCKS)
    inputs = [corners.contiguous(), triangles, columns, *tables, max_range, _NEAR, span]
    launch(_project_kernel, -(-len(azimuths) // span), inputs, [ranges], least=1)
    image = torch.empty_like(ranges.T).contiguous()
    image[row_order.unsqueeze(1), column_order] = ranges.T
    return image.masked_fill_(image.isinf(), 0.0)
