"""The table of projected pixels that the attention step reads."""

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F

from kernels.checks import check_devices
from kernels.neighbour_attention.maths import MOMENTS, ROLLED_FOUR
from kernels.stencil import grid_of

__all__ = ["Projected", "fields", "head_last", "project_pixels"]


class Projected(NamedTuple):
    """Features projected once per pixel, for `neighbour_attention`. Channels of q, k and v are stored [d][head]."""

    pixels: torch.Tensor
    """(B, H, W, 4·C + 16): A (queries, keys, values), z + b, xᵀx, u, and padding."""
    slope: torch.Tensor
    """(2, 4·C): B and W, transposed."""
    shift: torch.Tensor
    """(3·C,): c."""
    gram: torch.Tensor
    """(2, 2): N."""
    heads: int
    """Number of heads."""


def head_last(channels: int, heads: int, device: torch.device) -> torch.Tensor:
    """(C,) where the channel stored at each place, [d][head], stands among channels stored head after head."""
    return torch.arange(channels, device=device).view(heads, -1).T.reshape(-1)


def project_pixels(
    features: torch.Tensor,
    position: tuple[torch.Tensor, torch.Tensor],
    norm: tuple[torch.Tensor, torch.Tensor],
    qkv_weight: torch.Tensor,
    heads: int,
) -> Projected:
    """Projects features to queries, keys and values before they are gathered, normalised and given an offset.

    Plain PyTorch, differentiable in all tensors.

    Args:
        features: (B, C, H, W) floating-point, z of each pixel; computed in float32 at least.
        position: Weight W (C, 2) and bias b (C,) of the embedding of offsets in pixels.
        norm: Weight γ (C,) and bias β (C,) of the layer norm.
        qkv_weight: M (3·C, C), as in a `Linear(C, 3·C, bias=False)`.
        heads: Number of heads; it divides C.

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
        raise ValueError(f"heads is {heads}; it should divide the {channels} channels")
    check_devices(features=features, position=position[0], norm=norm[0], qkv_weight=qkv_weight)
    with torch.autocast(features.device.type, enabled=False):  # a variance wants more digits than bfloat16 has
        z = features.to(position[0].dtype).movedim(1, 3) + position[1]
        mean = z.mean(-1, keepdim=True)
        x = z - mean
        centred = position[0] - position[0].mean(0)
        qkv_weight = qkv_weight.unflatten(0, (3, channels))[:, head_last(channels, heads, z.device)].flatten(0, 1)
        projection = qkv_weight * norm[0]
        # One matrix makes the row of a pixel from (x, mean, xᵀx).
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
    """The fields of a `PixelTable` (`kernels.neighbour_attention.maths`), for `launch`."""
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
