"""Every op again in plain PyTorch, written to be read. These are the oracle of the tests and the backend "torch".

Shapes are those of the ops, with the leading dimensions folded into one batch B. Autograd derives the gradients.
"""

import math
from typing import Any

import torch
import torch.nn.functional as F

from kernels.checks import (
    AREA_FLOOR,
    BACKGROUND,
    CONTINUED,
    FARTHEST,
    KINDS,
    LEAST_RANGE,
    LEAST_SCALE,
    PARTED,
    RANGE_FLOOR,
    TOLERANCE,
    WIDEST_GAP,
)

__all__ = [
    "area_blend",
    "areas",
    "attend_neighbours",
    "cast_rays",
    "fused_decode",
    "fused_surfaces",
    "gather_blend",
    "gather_neighbours",
    "interpolate_planes",
    "neighbour_attention",
    "neighbours",
    "surface_hypotheses",
    "surface_likelihood",
    "surface_median",
]


def neighbours(
    queries: torch.Tensor, height: int, width: int, wrap: bool
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Rows and columns of the 4 neighbours, and the queries' offsets from them.

    Args:
        queries: (..., 2) pixel coordinates.
        height: Rows H of the image.
        width: Columns W of the image.
        wrap: Whether columns wrap around the seam.

    Returns:
        rows, columns: (..., 4) int64 pixel indices.
        offsets: (..., 4, 2), query minus neighbour in pixels.
    """
    row, column = queries.unbind(-1)
    # Coordinates are kept within ±2^30, as the kernels do, whose integers have 32 bits; NaN counts as -2^30.
    limit = 2.0**30
    below, left = (c.nan_to_num(-limit).clamp(-limit, limit).floor().long() for c in (row, column))
    rows = torch.stack([below, below, below + 1, below + 1], -1).clamp(0, height - 1)
    columns = torch.stack([left, left + 1, left, left + 1], -1)
    if not wrap:
        columns = columns.clamp(0, width - 1)
    offsets = torch.stack([row.unsqueeze(-1) - rows, column.unsqueeze(-1) - columns], -1)
    return rows, columns % width, offsets


def areas(queries: torch.Tensor) -> torch.Tensor:
    """Bilinear weights S_t / S of the 4 neighbours (paper, Eq. 2): each the area of the diagonally opposite rectangle.

    Args:
        queries: (..., 2) pixel coordinates.

    Returns:
        (..., 4), summing to 1.
    """
    fraction = queries - queries.floor()
    fr, fc = fraction.unbind(-1)
    return torch.stack([(1 - fr) * (1 - fc), (1 - fr) * fc, fr * (1 - fc), fr * fc], -1)


def area_blend(values: torch.Tensor, queries: torch.Tensor) -> torch.Tensor:
    """`kernels.area_blend` on values (N, 4) and queries (N, 2)."""
    return (values * areas(queries)).sum(-1).to(values.dtype)


def gather_neighbours(features: torch.Tensor, queries: torch.Tensor, wrap: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """`kernels.gather_neighbours` on features (B, C, H, W) and queries (B, Q, 2)."""
    rows, columns, offsets = neighbours(queries, features.shape[2], features.shape[3], wrap)
    image = torch.arange(len(features), device=features.device).view(-1, 1, 1)
    return features.movedim(1, 3)[image, rows, columns], offsets


def gather_blend(
    image: torch.Tensor, queries: torch.Tensor, scores: torch.Tensor, prior: str, wrap: bool, area_floor: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """`kernels.gather_blend` on image (B, H, W), queries (B, Q, 2) and scores (B, Q, 4), with the weights."""
    gathered, _ = gather_neighbours(image.unsqueeze(1), queries, wrap)
    ranges = gathered.squeeze(-1)
    logits = scores.to(ranges.dtype)
    if prior != "none":
        logits = logits + areas(queries).clamp(min=area_floor).log()
    if prior == "perspective":
        logits = logits - ranges.clamp(min=RANGE_FLOOR).log()
    weights = logits.softmax(-1)
    return (weights * ranges).sum(-1), weights


def attend_neighbours(qkv: torch.Tensor) -> torch.Tensor:
    """`kernels.attend_neighbours` on (N, 12, heads, D), the 4 neighbours' queries, keys and values in turn."""
    q, k, v = qkv.unflatten(1, (4, 3)).unbind(2)
    logits = torch.einsum("nihd,njhd->nhij", q, k) / math.sqrt(qkv.shape[-1])
    return torch.einsum("nhij,njhd->nihd", logits.softmax(-1), v)


def neighbour_attention(
    pixels: torch.Tensor,
    queries: torch.Tensor,
    slope: torch.Tensor,
    shift: torch.Tensor,
    gram: torch.Tensor,
    weight: torch.Tensor,
    bias: torch.Tensor,
    heads: int,
    eps: float,
    wrap: bool,
) -> torch.Tensor:
    """`kernels.neighbour_attention` on the tensors of a `Projected`, queries (B, Q, 2) and a weight for [d][head]."""
    channels = len(bias)
    gathered, q = gather_neighbours(pixels.movedim(3, 1), queries.clamp(-FARTHEST, FARTHEST), wrap)
    a, squares, u, _ = gathered.split([4 * channels, 1, 2, gathered.shape[-1] - 4 * channels - 3], -1)
    qkv, tokens = (a + q @ slope).split([3 * channels, channels], -1)
    sums = squares + 2 * (q * u).sum(-1, keepdim=True) + ((q @ gram) * q).sum(-1, keepdim=True)
    variance = sums.clamp(min=0) / channels  # the polynomial may be rounded to below 0
    qkv = qkv / (variance + eps).sqrt() + shift
    attended = attend_neighbours(qkv.reshape(-1, 12, channels // heads, heads).transpose(2, 3))
    return tokens + F.linear(attended.transpose(2, 3).reshape(tokens.shape), weight, bias)


def interpolate_planes(image: torch.Tensor, queries: torch.Tensor, wrap: bool) -> torch.Tensor:
    """`kernels.interpolate_planes` on image (B, H, W) and queries (B, Q, 2)."""
    height = image.shape[1]
    rows, columns, _ = neighbours(queries, height, image.shape[2], wrap)
    inverse = 1 / image.clamp(min=RANGE_FLOOR)
    batch = torch.arange(len(image), device=image.device).view(-1, 1, 1)
    f, g = (queries - queries.floor()).unsqueeze(-2).unbind(-1)  # (B, Q, 1)
    above, below, columns = rows[..., :1], rows[..., 2:3], columns[..., :2]  # one each, both columns
    u, v = inverse[batch, above, columns], inverse[batch, below, columns]
    before, after = inverse[batch, (above - 1).clamp(min=0), columns], inverse[batch, (below + 1) % height, columns]
    between = below > above
    down = torch.where(between & (above > 0), u - before, v - u)
    up = torch.where(between & (below < height - 1), v - after, u - v)
    first, second = u + down * f, v + up * (1 - f)
    at_u, at_v = u - v - up, u + down - v
    expected = torch.where((at_u > 0) & (at_v < 0), torch.maximum(first, second), u + (v - u) * f)
    parted = (torch.stack((at_u, at_v, u - v)).abs() > PARTED * torch.minimum(u, v)).all(0) & (at_u * at_v > 0)
    expected = torch.where(parted, torch.where(f < 0.5, first, second), expected)
    left, right = expected.clamp(torch.minimum(u, v), torch.maximum(u, v)).split(1, -1)
    apart = (left - right).abs() > PARTED * torch.minimum(left, right)
    g = torch.where(apart, (g + 0.5).floor(), g)
    return (1 / (left + (right - left) * g)).squeeze(-1)


def fused_decode(
    projected: Any,
    image: torch.Tensor,
    queries: torch.Tensor,
    weights: Any,
    prior: str,
    wrap: bool,
    area_floor: float,
    eps: float,
) -> torch.Tensor:
    """`kernels.fused_decode`: a `Projected`, image (B, H, W), queries (B, Q, 2) and `DecoderWeights`."""
    image, queries = image.to(projected.pixels.dtype), queries.to(projected.pixels.dtype)
    scores = _decoded(projected, queries, weights, wrap, eps).squeeze(-1)
    return gather_blend(image, queries, scores, prior, wrap, area_floor)[0]


def fused_surfaces(
    projected: Any,
    image: torch.Tensor,
    queries: torch.Tensor,
    elevations: torch.Tensor,
    azimuths: torch.Tensor,
    weights: Any,
    wrap: bool,
    eps: float,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """`kernels.fused_surfaces`, arguments as in `fused_decode`, and both tables."""
    image, queries, elevations, azimuths = (
        tensor.to(projected.pixels.dtype) for tensor in (image, queries, elevations, azimuths)
    )
    scores, scales = _decoded(projected, queries, weights, wrap, eps).split((KINDS, 1), -1)
    return surface_median(image, queries, elevations, azimuths, wrap, scores, scales.squeeze(-1))


def _decoded(projected: Any, queries: torch.Tensor, weights: Any, wrap: bool, eps: float) -> torch.Tensor:
    """What the head of a decoder says of each neighbour, (B, Q, 4, N)."""
    pixels, slope, shift, gram, heads = projected
    weight, bias = weights.output
    weight = weight[:, torch.arange(len(bias), device=bias.device).view(heads, -1).T.reshape(-1)]
    t = neighbour_attention(pixels, queries, slope, shift, gram, weight, bias, heads, eps, wrap)
    hidden = F.gelu(F.linear(F.layer_norm(t, bias.shape, weights.norm[0], weights.norm[1], eps), *weights.hidden))
    t = t + F.linear(hidden, *weights.back)
    t = F.layer_norm(t, bias.shape, weights.head_norm[0], weights.head_norm[1], eps)
    return F.linear(t, *weights.score)


def cast_rays(
    vertices: torch.Tensor, triangles: torch.Tensor, origins: torch.Tensor, directions: torch.Tensor, max_range: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """`kernels.Mesh.cast` by intersecting every ray with every triangle (Möller and Trumbore 1997).

    Args:
        vertices: (V, 3) metres.
        triangles: (F, 3) integer.
        origins: (N, 3) metres.
        directions: (N, 3) unit vectors.
        max_range: Metres.

    Returns:
        ranges (N,), triangle numbers (N,) int32 and incidence cosines (N,).
    """
    a, b, c = vertices[triangles.long()].unbind(1)
    normals = F.normalize(torch.linalg.cross(b - a, c - a), dim=1)
    results = []
    for start, direction in zip(origins.split(1024), directions.split(1024), strict=True):
        across = torch.linalg.cross(direction[:, None], (c - a)[None])
        determinant = ((b - a)[None] * across).sum(-1)
        from_a = start[:, None] - a[None]
        along = torch.linalg.cross(from_a, (b - a)[None].expand_as(from_a))
        u = (from_a * across).sum(-1) / determinant
        v = (direction[:, None] * along).sum(-1) / determinant
        t = ((c - a)[None] * along).sum(-1) / determinant
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t <= max_range)
        nearest, number = t.masked_fill(~hit, math.inf).min(1)
        cosine = (normals[number] * direction).sum(-1).abs()
        some = nearest.isfinite()
        results.append((nearest.where(some, 0.0), number.where(some, -1).int(), cosine.where(some, 0.0)))
    return tuple(torch.cat(parts) for parts in zip(*results, strict=True))  # type: ignore[return-value]


def _continued(u: torch.Tensor, other: torch.Tensor, gap: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """u(α) - u_t of `kernels.surfaces.maths`, Eq. (1), with angles counted from t; 0 where it cannot be continued."""
    can = (u > 0) & (other > 0) & (gap != 0) & (gap.abs() <= WIDEST_GAP)
    sine = gap.where(can, 1.0).sin()
    return ((u * (gap - angle).sin() + other * angle.sin()) / sine - u).where(can, 0.0)


def surface_hypotheses(
    image: torch.Tensor, queries: torch.Tensor, elevations: torch.Tensor, azimuths: torch.Tensor, wrap: bool
) -> torch.Tensor:
    """`kernels.surface_hypotheses` on image (B, H, W), queries (B, Q, 2) and both tables."""
    inverse = (1 / image.clamp(min=LEAST_RANGE)).where(image > 0, 0.0)
    batch = torch.arange(len(image), device=image.device).view(-1, 1, 1)
    rows, columns, offsets = neighbours(queries, image.shape[1], image.shape[2], wrap)
    u = inverse[batch, rows, columns]
    changes = []
    for axis, (pixels, table, circle) in enumerate(((rows, elevations, False), (columns, azimuths, wrap))):
        offset, count = offsets[..., axis], len(table)
        towards = torch.where(offset < 0, -1, 1)
        inner, outer = pixels + towards, pixels - towards
        inner, outer = (p % count if circle else p.clamp(0, count - 1) for p in (inner, outer))
        gaps = [table[p] - table[pixels] for p in (outer, inner)]
        if circle:
            gaps = [gap - math.tau * (gap / math.tau).round() for gap in gaps]
        spacing = torch.where(inner == pixels, -gaps[0], gaps[1])
        angle = (offset.abs() * spacing).clamp(-WIDEST_GAP, WIDEST_GAP)
        others = [inverse[batch, *((p, columns) if axis == 0 else (rows, p))] for p in (outer, inner)]
        outer_inner = [_continued(u, other, gap, angle) for other, gap in zip(others, gaps, strict=True)]
        changes.append(torch.stack((*outer_inner, torch.zeros_like(u)), -1))
    u = u[..., None, None]
    found = u + changes[0].unsqueeze(-1) + changes[1].unsqueeze(-2)
    found = torch.minimum(torch.maximum(found, u / CONTINUED), u * CONTINUED)
    return (1 / found).where(u > 0, 0.0).flatten(-2)


def surface_areas(queries: torch.Tensor) -> torch.Tensor:
    """The prior of the neighbours in Eq. (3) of `kernels.surfaces.maths`: (..., 4) for queries (..., 2)."""
    found = areas(queries)
    floor = torch.where(found.amax(-1, keepdim=True) < 1 - AREA_FLOOR, AREA_FLOOR, 0.0).to(found)
    return torch.where(found < AREA_FLOOR, floor, found)


def _log_weights(queries: torch.Tensor, scores: torch.Tensor) -> torch.Tensor:
    """Log w_tk of `kernels.surfaces.maths`, Eq. (3), (B, Q, 4, 9)."""
    prior = surface_areas(queries).log()
    return (scores + prior.unsqueeze(-1)).flatten(-2).log_softmax(-1).view(scores.shape)


def surface_likelihood(
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
    """`kernels.surface_likelihood`, shapes as in `surface_hypotheses`."""
    found = surface_hypotheses(image, queries, elevations, azimuths, wrap)
    w = _log_weights(queries, scores).exp()
    b = (0.5 * F.softplus(scales) + LEAST_SCALE).unsqueeze(-1)
    r = targets[..., None, None]
    error = (found.where(found > 0, far) - r.where(r > 0, far)).abs()
    p = torch.where(r > 0, (-error / b).exp() / (2 * b), 1.0).where((found > 0) == (r > 0), 0.0)
    background = torch.where(targets > 0, BACKGROUND / far, BACKGROUND)
    likelihood = -((1 - 2 * BACKGROUND) * (w * p).flatten(-2).sum(-1) + background).log()
    return likelihood, (w * error).flatten(-2).sum(-1)


def surface_median(
    image: torch.Tensor,
    queries: torch.Tensor,
    elevations: torch.Tensor,
    azimuths: torch.Tensor,
    wrap: bool,
    scores: torch.Tensor,
    scales: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """`kernels.surface_median`, shapes as in `surface_hypotheses`."""
    found = surface_hypotheses(image, queries, elevations, azimuths, wrap)
    w = _log_weights(queries, scores).exp()
    r, order = found.where(found > 0, math.inf).flatten(-2).sort(-1)
    below = w.flatten(-2).gather(-1, order).cumsum(-1)
    median = r.gather(-1, (below < 0.5).sum(-1, keepdim=True).clamp(max=r.shape[-1] - 1)).unsqueeze(-1)
    b = (0.5 * F.softplus(scales) + LEAST_SCALE).unsqueeze(-1)
    ends = [(median - found + side).where(median.isfinite(), 0.0) / b for side in (-TOLERANCE, TOLERANCE)]
    low, high = (torch.where(x < 0, 0.5 * x.clamp(max=0).exp(), 1 - 0.5 * (-x).clamp(max=0).exp()) for x in ends)
    near = torch.where(median.isfinite(), (high - low).where(found > 0, 0.0), (found == 0).to(w))
    median = median.flatten(-3)
    unknown = w.flatten(-2).sum(-1).isnan()
    ranges = median.where(median.isfinite(), 0.0).masked_fill(unknown, math.nan)
    support = (w * near).sum(-1).masked_fill(unknown.unsqueeze(-1), math.nan)
    none = (w * (found == 0)).flatten(-2).sum(-1)
    return ranges, (1 - 2 * BACKGROUND) * support, (1 - 2 * BACKGROUND) * none
