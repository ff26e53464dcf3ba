"""Rays from one point: triangles are projected onto the range image, instead of walking a tree for every ray.

The rays of a column lie in a half-plane that ends in the vertical axis of the sensor. The half-plane cuts a triangle in
a segment (ρ₁, z₁)-(ρ₂, z₂) of horizontal distances ρ and heights z. The ends of the segment bound the rows that see it.
A ray of slope m = tan(elevation) meets the line through the ends exactly at

    ρ = (ρ₁ Δz - z₁ Δρ) / (Δz - m Δρ),    range = ρ √(1 + m²)

What cannot be seen is left out before that, from coarse to fine: first clusters of neighbouring triangles that are out
of reach, or above or below all rows; then triangles that lie between two rows or two columns. Each thread takes a block
of columns, so that no two threads write to one pixel.
"""

from typing import NamedTuple

import torch
import warp as wp

from kernels.launch import launch

__all__ = ["Clusters", "cluster_triangles", "project_triangles", "within_reach"]

# How many triangles make a cluster.
_SIZE = wp.constant(64)
# How many blocks of columns a core gets. Each block looks at the columns of every triangle.
_BLOCKS_PER_CORE = 8
# By how much the columns [rad] and the slopes (as a share) of a triangle are widened, since float32 rounds them. The
# exact cut decides afterwards.
_MARGIN = wp.constant(1e-5)
# Metres. A segment that crosses the vertical axis is cut off at this distance from it. Also the least range.
_NEAR = wp.constant(1e-6)

_TURN = wp.constant(6.283185307179586)


class Clusters(NamedTuple):
    """Triangles in groups of 64 neighbouring ones, with a ball around each group."""

    corners: torch.Tensor
    """(64 C, 3, 3) float32, metres. Triangles of no size fill the last cluster."""
    centres: torch.Tensor
    """(C, 3) float32, metres."""
    radii: torch.Tensor
    """(C,) float32, metres."""


def cluster_triangles(vertices: torch.Tensor, triangles: torch.Tensor) -> Clusters:
    """Sorts triangles along a space-filling curve (Morton order) and groups them.

    Args:
        vertices: (V, 3) float32, metres.
        triangles: (F, 3) int32, numbers of the vertices.

    Returns:
        The triangles in clusters, in the frame of the vertices.
    """
    corners = vertices[triangles.long()]
    middle = corners.mean(1)
    cell = ((middle - middle.amin(0)) / (middle.amax(0) - middle.amin(0)).max().clamp(min=1e-6) * 1023).long()
    for shift, mask in ((16, 0x30000FF), (8, 0x300F00F), (4, 0x30C30C3), (2, 0x9249249)):  # two zeros after every bit
        cell = (cell | (cell << shift)) & mask
    corners = corners[(cell << torch.arange(3, device=cell.device)).sum(1).argsort(stable=True)]
    missing = -len(corners) % int(_SIZE)
    corners = torch.cat((corners, corners[-1:, :1].expand(missing, 3, 3))).contiguous()
    points = corners.view(-1, 3 * int(_SIZE), 3)
    centres = (points.amin(1) + points.amax(1)) / 2
    return Clusters(corners, centres, (points - centres.unsqueeze(1)).norm(dim=2).amax(1))


@wp.func
def _lower_bound(table: wp.array[float], value: float):
    """Number of entries of a rising table that are below a value."""
    begin = wp.int32(0)
    end = table.shape[0]
    while begin < end:
        middle = (begin + end) // 2
        if table[middle] < value:
            begin = middle + 1
        else:
            end = middle
    return begin


@wp.func
def _horizontal(a: wp.vec3):
    """Distance of a point from the vertical axis."""
    return wp.sqrt(a[0] * a[0] + a[1] * a[1])


@wp.func
def _between_rows(a: wp.vec3, b: wp.vec3, c: wp.vec3, edge: float, slopes: wp.array[float]):
    """Whether bounds on the slopes of a triangle show that no row sees it. `edge` is the longest one."""
    ra = _horizontal(a)
    rb = _horizontal(b)
    rc = _horizontal(c)
    nearest = wp.min(ra, wp.min(rb, rc))
    farthest = wp.max(ra, wp.max(rb, rc))
    # A chord of length `edge` between points at least `nearest` from the axis comes no nearer to it than `inner`.
    inner = nearest * nearest - 0.25 * edge * edge
    if inner <= 1.0e-3 * edge * edge:
        return False
    inner = wp.sqrt(inner)
    low = wp.min(a[2], wp.min(b[2], c[2]))
    high = wp.max(a[2], wp.max(b[2], c[2]))
    low = wp.where(low < 0.0, low / inner, low / farthest)
    high = wp.where(high > 0.0, high / inner, high / farthest)
    row = _lower_bound(slopes, low - _MARGIN * (1.0 + wp.abs(low)))
    if row == slopes.shape[0]:
        return True
    return slopes[row] > high + _MARGIN * (1.0 + wp.abs(high))


@wp.kernel(enable_backward=False)
def _find_columns_kernel(
    first: int,
    # in
    clusters: wp.array[wp.int32],
    corners: wp.array2d[wp.vec3],
    origin: wp.vec3,
    rotation: wp.mat33,
    azimuths: wp.array[float],
    slopes: wp.array[float],
    max_range: float,
    # out
    corners_out: wp.array2d[wp.vec3],
    columns_out: wp.array[wp.vec2i],
):
    i = first + wp.tid()
    f = clusters[i // _SIZE] * _SIZE + i % _SIZE
    a = rotation * (corners[f, 0] - origin)
    b = rotation * (corners[f, 1] - origin)
    c = rotation * (corners[f, 2] - origin)
    edge = wp.max(wp.length(b - a), wp.max(wp.length(c - b), wp.length(a - c)))
    nearest = wp.min(wp.length(a), wp.min(wp.length(b), wp.length(c)))
    columns = wp.vec2i(0, 0)
    if nearest - edge <= max_range and not _between_rows(a, b, c, edge, slopes):
        ab = a[0] * b[1] - a[1] * b[0]
        bc = b[0] * c[1] - b[1] * c[0]
        ca = c[0] * a[1] - c[1] * a[0]
        if (ab >= 0.0 and bc >= 0.0 and ca >= 0.0) or (ab <= 0.0 and bc <= 0.0 and ca <= 0.0):
            columns[1] = azimuths.shape[0]  # around the vertical axis
        else:
            u = wp.atan2(a[1], a[0])
            v = wp.atan2(b[1], b[0])
            w = wp.atan2(c[1], c[0])
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
            low = low - _MARGIN
            high = high + _MARGIN
            turns = wp.floor((low - azimuths[0]) / _TURN) * _TURN
            low = low - turns
            high = high - turns
            columns[0] = _lower_bound(azimuths, low)
            columns[1] = _lower_bound(azimuths, high) + _lower_bound(azimuths, high - _TURN) - columns[0]
    corners_out[i, 0] = a
    corners_out[i, 1] = b
    corners_out[i, 2] = c
    columns_out[i] = columns


@wp.func
def _cut(
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
    sine: float,
    cosine: float,
    slopes: wp.array[float],
    max_range: float,
    column: int,
    # out
    ranges_out: wp.array2d[float],
):
    """Cuts a triangle by the half-plane of a column, and keeps each range that is less than what its row has so far."""
    sa = cosine * a[1] - sine * a[0]
    sb = cosine * b[1] - sine * b[0]
    sc = cosine * c[1] - sine * c[0]
    # p is the corner alone on its side of the plane, whose two edges are cut.
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
    if rho1 < _NEAR and rho2 < _NEAR:
        return
    drho = rho2 - rho1
    dz = z2 - z1
    numerator = rho1 * dz - z1 * drho
    if rho1 < _NEAR:
        z1 = z1 + dz * (_NEAR - rho1) / drho
        rho1 = _NEAR
    if rho2 < _NEAR:
        z2 = z2 + dz * (_NEAR - rho2) / drho
        rho2 = _NEAR
    m1 = z1 / rho1
    m2 = z2 / rho2
    high = wp.max(m1, m2)
    row = _lower_bound(slopes, wp.min(m1, m2))
    while row < slopes.shape[0]:
        m = slopes[row]
        if m > high:
            return
        distance = numerator / (dz - m * drho) * wp.sqrt(1.0 + m * m)
        if distance > _NEAR and distance <= max_range and distance < ranges_out[column, row]:
            ranges_out[column, row] = distance
        row += 1


@wp.kernel(enable_backward=False)
def _project_kernel(
    first: int,
    # in
    corners: wp.array2d[wp.vec3],
    columns: wp.array[wp.vec2i],
    sines: wp.array[float],
    cosines: wp.array[float],
    slopes: wp.array[float],
    max_range: float,
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
    for f in range(columns.shape[0]):
        start = columns[f][0]
        stop = start + columns[f][1]
        if wp.min(stop, end) > wp.max(start, begin) or stop - width > begin:
            for column in range(wp.max(start, begin), wp.min(stop, end)):
                _cut(
                    corners[f, 0], corners[f, 1], corners[f, 2], sines[column], cosines[column], slopes,
                    max_range, column, ranges_out,
                )  # fmt: skip
            for column in range(begin, wp.min(stop - width, end)):
                _cut(
                    corners[f, 0], corners[f, 1], corners[f, 2], sines[column], cosines[column], slopes,
                    max_range, column, ranges_out,
                )  # fmt: skip


def project_triangles(
    clusters: Clusters,
    origin: torch.Tensor,
    rotation: torch.Tensor,
    elevations: torch.Tensor,
    azimuths: torch.Tensor,
    max_range: float,
) -> torch.Tensor:
    """Finds the range of the nearest triangle along each ray of a range image.

    Args:
        clusters: The triangles, metres, in the frame of the mesh.
        origin: (3,) metres, of the sensor in that frame.
        rotation: (3, 3) from the sensor's axes to those of that frame.
        elevations: (H,) rad, of the rows, within ±90 degrees.
        azimuths: (W,) rad, of the columns, all different, within one turn.
        max_range: Metres. Surfaces farther away are not seen.

    Returns:
        (H, W) float32 metres, 0 where nothing is met.
    """
    device = clusters.corners.device
    azimuths, column_order = azimuths.to(device).double().sort()
    slopes, row_order = elevations.to(device).double().tan().float().sort()
    seen = _seen(clusters, origin, rotation, elevations, max_range)
    corners = clusters.corners.new_empty(len(seen) * int(_SIZE), 3, 3)
    columns = torch.empty(len(corners), 2, dtype=torch.int32, device=device)
    placement = [wp.vec3(*origin.tolist()), wp.mat33(*rotation.T.flatten().tolist())]
    inputs = [seen, clusters.corners, *placement, azimuths.float(), slopes, max_range]
    launch(_find_columns_kernel, len(corners), inputs, [corners, columns])
    ranges = slopes.new_empty(len(azimuths), len(slopes))
    tables = [azimuths.sin().float(), azimuths.cos().float(), slopes]
    blocks = _BLOCKS_PER_CORE * torch.get_num_threads() if device.type == "cpu" else len(azimuths)
    span = -(-len(azimuths) // blocks)
    inputs = [corners, columns, *tables, max_range, span]
    launch(_project_kernel, -(-len(azimuths) // span), inputs, [ranges], least=1)
    image = torch.empty_like(ranges.T).contiguous()
    image[row_order.unsqueeze(1), column_order] = ranges.T
    return image.masked_fill_(image.isinf(), 0.0)


def within_reach(clusters: Clusters, origin: torch.Tensor, max_range: float) -> int:
    """Returns how many triangles are in clusters that begin within `max_range` [m] of an origin (3,) [m]."""
    distance = (clusters.centres - origin.float()).norm(dim=1)
    return int((distance - clusters.radii <= max_range).sum()) * int(_SIZE)


def _seen(
    clusters: Clusters, origin: torch.Tensor, rotation: torch.Tensor, elevations: torch.Tensor, max_range: float
) -> torch.Tensor:
    """Numbers (K,) int32 of the clusters within reach and between the lowest and the highest row, nearest first."""
    away = clusters.centres - origin.float()
    distance = away.norm(dim=1)
    height = away @ rotation[:, 2].float()
    elevation = torch.asin((height / distance.clamp(min=1e-6)).clamp(-1, 1))
    width = torch.asin((clusters.radii / distance.clamp(min=1e-6)).clamp(max=1)) + 1e-4
    width.masked_fill_(distance <= clusters.radii, torch.inf)
    low, high = float(elevations.min()), float(elevations.max())
    seen = (distance - clusters.radii <= max_range) & (elevation + width >= low) & (elevation - width <= high)
    numbers = seen.nonzero().squeeze(1)
    return numbers[distance[numbers].argsort()].int()
