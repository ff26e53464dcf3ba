"""LIIF for range images: a network predicts a value for each neighbour, and areas weight them (paper, Eq. 2)."""

from itertools import pairwise

import torch
from torch import nn

from ilnet.models.base import OFFSET_SCALE, Model, normalised
from ilnet.models.encoder import Encoder
from ilnet.sensor import Sensor
from kernels import area_blend, gather_neighbours

__all__ = ["LIIF"]


class LIIF(Model):
    """r̂ = Σ_t (S_t / S) h(z'_t), which the paper improves on.

    Args:
        features: Channels of the encoder.
        blocks: Residual blocks of the encoder.
        hidden: Width of the four hidden layers of h.
        norm_range: The range [m] that the network sees, and predicts, as +1; no return is filled with it.

    Source: paper Eq. 2 and Sec. II-A; sizes as in the authors' code, without feature unfolding and cell decoding.
        1,434,049 parameters.
    """

    def __init__(self, features: int = 64, blocks: int = 16, hidden: int = 256, norm_range: float = 100.0):
        super().__init__()
        self.norm_range = norm_range
        self.encoder = Encoder(features, blocks)
        widths = [features + 2, hidden, hidden, hidden, hidden]
        layers = [layer for a, b in pairwise(widths) for layer in (nn.Linear(a, b), nn.ReLU())]
        self.value = nn.Sequential(*layers, nn.Linear(hidden, 1))

    def encode(self, image: torch.Tensor, wrap: bool, sensor: Sensor | None = None) -> torch.Tensor:
        """Extracts features z (B, C, H, W) from ranges (B, H, W) [m], scaled to [-1, 1]."""
        return self.encoder(normalised(image, self.norm_range), wrap)

    def decode(self, features: torch.Tensor, image: torch.Tensor, queries: torch.Tensor, wrap: bool) -> torch.Tensor:
        """Predicts and blends the values of the 4 neighbours of each query."""
        values = self.values(features, queries, wrap)
        return (area_blend(values, queries, self.backend) + 1) * (self.norm_range / 2)

    def values(self, features: torch.Tensor, queries: torch.Tensor, wrap: bool) -> torch.Tensor:
        """Returns the value (B, Q, 4) of each neighbour of queries (B, Q, 2): a range scaled to [-1, 1]."""
        z, offsets = gather_neighbours(features, queries, wrap, self.backend)
        hidden = self.value[:-1](torch.cat((z, (offsets * OFFSET_SCALE).to(z.dtype)), -1))
        # The last layer always runs in float32: near 1, the spacing of bfloat16 is 0.004, which is 20 cm.
        with torch.autocast(z.device.type, enabled=False):
            return self.value[-1](hidden.float()).squeeze(-1)
