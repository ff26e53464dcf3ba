"""The encoder of LIIF and ILN: EDSR without its upsampling tail (paper, Sec. II-B)."""

from typing import Any

import torch
from torch import nn

__all__ = ["Encoder"]


class _Pad(torch.autograd.Function):
    """Adds one pixel on each side of (B, C, H, W): rows repeat, columns wrap around the seam or repeat.

    Written by hand for speed: `F.pad` loses the channels_last format, and autograd through slices takes as long as the
    convolution, since each slice gets a gradient of the size of the whole.
    """

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, wrap: bool) -> torch.Tensor:
        ctx.left, ctx.right = (-1, 0) if wrap else (0, -1)
        batch, channels, height, width = x.shape
        padded = x.new_empty(batch, height + 2, width + 2, channels).movedim(3, 1)
        rows = padded[..., 1:-1]
        rows[..., 1:-1, :] = x
        rows[..., 0, :], rows[..., -1, :] = x[..., 0, :], x[..., -1, :]
        padded[..., 0], padded[..., -1] = rows[..., ctx.left].clone(), rows[..., ctx.right].clone()
        return padded

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None]:
        rows = gradient[..., 1:-1]
        x = rows[..., 1:-1, :].clone(memory_format=torch.channels_last)
        for padding, column in ((gradient[..., 0], ctx.left), (gradient[..., -1], ctx.right)):
            x[..., column] += padding[..., 1:-1]
            x[..., 0, column] += padding[..., 0]
            x[..., -1, column] += padding[..., -1]
        x[..., 0, :] += rows[..., 0, :]
        x[..., -1, :] += rows[..., -1, :]
        return x, None


class _Conv(nn.Conv2d):
    """A 3×3 convolution on a range image."""

    def __init__(self, channels_in: int, channels_out: int):
        super().__init__(channels_in, channels_out, 3)

    def forward(self, x: torch.Tensor, wrap: bool) -> torch.Tensor:  # type: ignore[override]
        return super().forward(_Pad.apply(x, wrap))


class _ResidualBlock(nn.Module):
    def __init__(self, features: int):
        super().__init__()
        self.first = _Conv(features, features)
        self.second = _Conv(features, features)

    def forward(self, x: torch.Tensor, wrap: bool) -> torch.Tensor:
        return x + self.second(self.first(x, wrap).relu(), wrap)


class Encoder(nn.Module):
    """Extracts one feature vector per pixel of a range image.

    A head convolution, residual blocks of convolution, ReLU and convolution, a closing convolution, and a skip from the
    head to the end. There are no normalisation layers, and all kernels are 3×3.

    Args:
        features: Channels C of every layer.
        blocks: Number of residual blocks.
        inputs: Channels of the image.
    """

    def __init__(self, features: int = 64, blocks: int = 16, inputs: int = 1):
        super().__init__()
        self.head = _Conv(inputs, features)
        self.blocks = nn.ModuleList(_ResidualBlock(features) for _ in range(blocks))
        self.tail = _Conv(features, features)
        # Convolutions are fast in this format, and it keeps the features of a pixel together for `gather_neighbours`.
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, image: torch.Tensor, wrap: bool) -> torch.Tensor:
        """Maps images (B, inputs, H, W), scaled to about [-1, 1], to features (B, C, H, W)."""
        head = self.head(image.to(memory_format=torch.channels_last), wrap)
        x = head
        for block in self.blocks:
            x = block(x, wrap)
        return head + self.tail(x, wrap)
