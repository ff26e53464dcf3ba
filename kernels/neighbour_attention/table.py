"""The table of projected pixels: what the attention step computes once for each pixel, before any query is known.

`project_pixels` makes it and the public ops take it. `kernels.neighbour_attention.maths` says why this is possible, and
what the symbols mean.
"""

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F

from kernels.checks import check_devices
from kernels.neighbour_attention.maths import MOMENTS, ROLLED_FOUR
from kernels.stencil import grid_of

__all__ = ["Projected", "fields", "head_last", "project_pixels"]


class Projected(NamedTuple):
    """Features projected once for each pixel, as `project_pixels` makes them for `neighbour_attention`.

    Queries, keys and values are stored [d][head]: channel d of all heads, then channel d + 1 of all heads.
    """

    pixels: torch.Tensor
    """(B, H, W, 4·C + 16), a row for each pixel.

    - 3·C columns: queries, keys and values of the feature, before an offset is added and the sum is normalised (A).
    - C columns: the feature plus the bias of the position embedding (z + b).
    - 1 column: the squared length of that sum after its mean is subtracted (xᵀx).
    - 2 columns: the products of the centred sum with the two columns of the position embedding (u).
    - 13 columns of zeros, which make a row a whole number of cache lines.
    """
    slope: torch.Tensor
    """(2, 4·C): what one pixel of offset, down or to the right, adds to the first 4·C columns (B and W, transposed)."""
    shift: torch.Tensor
    """(3·C,): what is added to queries, keys and values after the normalisation (c)."""
    gram: torch.Tensor
    """(2, 2): the products of the centred columns of the position embedding with each other (N)."""
    heads: int
    """Number of heads."""

    def named(self) -> dict[str, torch.Tensor]:
        """Returns the tensors by the names that errors give them."""
        return {f"projected.{name}": getattr(self, name) for name in ("pixels", "slope", "shift", "gram")}


def head_last(tensor: torch.Tensor, heads: int) -> torch.Tensor:
    """Returns (..., C) channels that were stored [head][d] in the order [d][head]."""
    return tensor.unflatten(-1, (heads, -1)).transpose(-1, -2).flatten(-2).contiguous()


def project_pixels(
    features: torch.Tensor,
    position: tuple[torch.Tensor, torch.Tensor],
    norm: tuple[torch.Tensor, torch.Tensor],
    qkv_weight: torch.Tensor,
    heads: int,
) -> Projected:
    """Projects features to queries, keys and values before they are gathered, given an offset and normalised.

    Written in plain PyTorch and differentiable in all tensors.

    Args:
        features: (B, C, H, W) floating-point features z of the pixels; computed in the dtype of `position`.
        position: Weight W (C, 2) and bias b (C,) of the embedding of offsets in pixels.
        norm: Weight γ (C,) and bias β (C,) of the layer norm.
        qkv_weight: Weight M (3·C, C) of queries, keys and values, as in `Linear(C, 3·C, bias=False)`.
        heads: Number of heads, a divisor of C.

    Returns:
        The table that `neighbour_attention` and `fused_decode` read.

    Raises:
        ValueError: If a shape, device or `heads` does not fit.
    """
    if features.ndim != 4:
        raise ValueError(f"features has shape {tuple(features.shape)}; it should be (B, C, H, W)")
    channels = features.shape[1]
    expected = {"position": [(channels, 2), (channels,)], "norm": [(channels,), (channels,)]}
    for name, pair in (("position", position), ("norm", norm)):
        if (shapes := [tuple(tensor.shape) for tensor in pair]) != expected[name]:
            raise ValueError(f"{name} has shapes {shapes}; they should be {expected[name]}")
    if qkv_weight.shape != (3 * channels, channels):
        raise ValueError(f"qkv_weight has shape {tuple(qkv_weight.shape)}; it should be {(3 * channels, channels)}")
    if heads < 1 or channels % heads:
        raise ValueError(f"heads is {heads}; it should divide C = {channels}")
    pairs = {f"{name}[{i}]": pair[i] for name, pair in (("position", position), ("norm", norm)) for i in range(2)}
    check_devices(features=features, **pairs, qkv_weight=qkv_weight)
    with torch.autocast(features.device.type, enabled=False):  # a variance needs more digits than bfloat16 has
        z = features.to(position[0].dtype).movedim(1, 3) + position[1]
        mean = z.mean(-1, keepdim=True)
        x = z - mean
        centred = position[0] - position[0].mean(0)
        qkv_weight = head_last(qkv_weight.T.unflatten(1, (3, channels)), heads).flatten(1).T
        projection = qkv_weight * norm[0]
        # One matrix product makes the whole row of a pixel from (x, mean, xᵀx).
        of_x = torch.cat(
            (projection.T, torch.eye(channels, dtype=x.dtype, device=x.device), x.new_zeros(channels, 1), centred), 1
        )
        of_mean = F.pad(x.new_ones(1, channels), (3 * channels, 3))
        of_squares = F.pad(x.new_ones(1, 1), (4 * channels, 2))
        rows = F.pad(torch.cat((of_x, of_mean, of_squares)), (0, MOMENTS - 3))
        pixels = torch.cat((x, mean, (x * x).sum(-1, keepdim=True)), -1) @ rows
        slope = torch.cat((projection @ centred, position[0])).T.contiguous()
        return Projected(pixels, slope, qkv_weight @ norm[1], centred.T @ centred, heads)


def fields(
    pixels: torch.Tensor,
    slope: torch.Tensor,
    shift: torch.Tensor,
    gram: torch.Tensor,
    heads: int,
    eps: float,
    wrap: bool,
    *,
    per_image: int,
    groups: int,
) -> dict[str, Any]:
    """Returns the fields of a `PixelTable` (`kernels.neighbour_attention.maths`) for `kernels.launch.launch`.

    Args:
        pixels: (B, H, W, 4·C + 16), contiguous, as are the next three. `Projected` says what they hold.
        slope: (2, 4·C).
        shift: (3·C,).
        gram: (2, 2).
        heads: Number of heads.
        eps: ε of the layer norm.
        wrap: Whether column W-1 meets column 0.
        per_image: Number of queries of each image.
        groups: 1 if a thread handles all heads, `heads` if it handles one.
    """
    _, height, width, columns = pixels.shape
    rows = pixels.view(-1, columns)
    return {
        "pixels": rows,
        "moments": rows[:, columns - MOMENTS : columns - MOMENTS + 3],
        "slope": slope,
        "shift": shift,
        "gram": gram,
        "channels": len(shift) // 3,
        "heads": heads,
        "groups": groups,
        "eps": eps,
        "grid": grid_of(height, width, wrap),
        "per_image": per_image,
        "rolled_four": ROLLED_FOUR,
    }
