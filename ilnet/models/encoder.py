"""The feature extractor of LIIF and ILN: EDSR without its upsampling tail (paper, Sec. II-B)."""

import torch
from torch import nn

__all__ = ["Encoder"]


def _pad(x: torch.Tensor, wrap: bool) -> torch.Tensor:
    """Adds one pixel on each side of (B, C, H, W): rows repeat, columns wrap around the seam or repeat."""
    # Slices rather than F.pad, which leaves the channels_last format.
    left, right = (x[..., -1:], x[..., :1]) if wrap else (x[..., :1], x[..., -1:])
    x = torch.cat((left, x, right), -1)
    return torch.cat((x[..., :1, :], x, x[..., -1:, :]), -2)


class _Conv(nn.Conv2d):
    """A 3×3 convolution on a range image."""

    def __init__(self, channels_in: int, channels_out: int):
        super().__init__(channels_in, channels_out, 3)

    def forward(self, x: torch.Tensor, wrap: bool) -> torch.Tensor:  # type: ignore[override]
        return super().forward(_pad(x, wrap))


class _ResidualBlock(nn.Module):
    def __init__(self, features: int):
        super().__init__()
        self.first = _Conv(features, features)
        self.second = _Conv(features, features)

    def forward(self, x: torch.Tensor, wrap: bool) -> torch.Tensor:
        return x + self.second(self.first(x, wrap).relu(), wrap)


class Encoder(nn.Module):
    """One feature vector per pixel of a range image.

    A head convolution, residual blocks of convolution, ReLU and convolution, a closing convolution, and a skip from
    head to end; no normalisation layers, all kernels 3×3.

    Args:
        features: Channels C of every layer.
        blocks: Number of residual blocks.
    """

    def __init__(self, features: int = 64, blocks: int = 16):
        super().__init__()
        self.head = _Conv(1, features)
        self.blocks = nn.ModuleList(_ResidualBlock(features) for _ in range(blocks))
        self.tail = _Conv(features, features)
        # The format in which convolutions are fast, and a pixel's features lie together for `gather_neighbours`.
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, image: torch.Tensor, wrap: bool) -> torch.Tensor:
        """Maps images (B, 1, H, W) scaled to [-1, 1] to features (B, C, H, W)."""
        head = self.head(image.to(memory_format=torch.channels_last), wrap)
        x = head
        for block in self.blocks:
            x = block(x, wrap)
        return head + self.tail(x, wrap)
