"""The Implicit LiDAR Network: attention among the neighbours predicts weights for their ranges (paper, Sec. II)."""

from typing import NamedTuple

import torch
from torch import nn

from ilnet.models.base import OFFSET_SCALE, Model, normalised
from ilnet.models.encoder import Encoder
from ilnet.sensor import Sensor
from kernels import (
    DecoderWeights,
    Projected,
    attend_neighbours,
    fused_decode,
    fused_decode_serves,
    gather_blend,
    gather_neighbours,
    neighbour_attention,
    project_pixels,
)
from kernels.checks import check_prior

__all__ = ["ILN", "Block"]


class _Encoded(NamedTuple):
    features: torch.Tensor
    """(B, C, H, W), the feature z of each pixel."""
    projected: Projected | None
    """What the first attention needs of each pixel; None if it projects each query's tokens instead."""


class _Attention(nn.Module):
    """Pre-norm multi-head self-attention among the 4 neighbours of a query (paper, Fig. 3b)."""

    def __init__(self, features: int, heads: int, dropout: float):
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(features)
        self.qkv = nn.Linear(features, 3 * features, bias=False)
        self.out = nn.Linear(features, features)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: torch.Tensor, backend: str) -> torch.Tensor:
        return self.dropout(self.out(attend_neighbours(self.qkv(self.norm(x)), self.heads, backend)))


class _FeedForward(nn.Sequential):
    def __init__(self, features: int, dropout: float):
        super().__init__(
            nn.LayerNorm(features),
            nn.Linear(features, features),
            nn.GELU(),
            nn.Dropout(dropout),
            nn.Linear(features, features),
            nn.Dropout(dropout),
        )


class Block(nn.Module):
    """Attention among the 4 neighbours of a query, then a feed-forward layer for each (paper, Fig. 3b)."""

    def __init__(self, features: int, heads: int, dropout: float):
        super().__init__()
        self.attention = _Attention(features, heads, dropout)
        self.feed_forward = _FeedForward(features, dropout)

    def forward(self, z: torch.Tensor, backend: str) -> torch.Tensor:
        """Maps the tokens (..., 4, C) of queries to tokens."""
        z = z + self.attention(z, backend)
        return z + self.feed_forward(z)


class ILN(Model):
    """r̂ = Σ_t w_t r_t with weights w = softmax(g(z'_1..4)) that a network predicts (paper, Eq. 3).

    The network is here; `kernels.gather_blend` is the softmax and the sum.

    Args:
        depth: Number of attention blocks D.
        prior: The interpolation that untrained weights start from: "none" (the paper), "bilinear" or "perspective"; see
            `kernels.gather_blend`. With a prior the head starts at zero, so that the untrained network *is* that
            interpolation.
        features: Channels of the encoder and of the attention.
        blocks: Residual blocks of the encoder.
        heads: Attention heads; they divide `features`.
        dropout: Dropout rate in the attention blocks during training; the authors use 0.1.
        area_floor: Least bilinear area in the prior; above 0, so that the network can overrule a measured pixel.
        norm_range: The range [m] that the encoder sees as +1; no return is filled with it.

    Raises:
        ValueError: If the prior is unknown, or the heads do not divide the features.

    Source: paper Sec. II-B, Figs. 2 and 3; sizes as in the authors' code. 1,244,673 parameters at D = 1.
    """

    def __init__(
        self,
        depth: int = 1,
        prior: str = "none",
        features: int = 64,
        blocks: int = 16,
        heads: int = 8,
        dropout: float = 0.0,
        area_floor: float = 1e-4,
        norm_range: float = 100.0,
    ):
        check_prior(prior)
        if heads < 1 or features % heads:
            raise ValueError(f"heads is {heads}; it should divide the {features} features")
        super().__init__()
        self.prior, self.area_floor, self.norm_range, self.dropout = prior, area_floor, norm_range, dropout
        self.encoder = Encoder(features, blocks)
        self.position = nn.Linear(2, features)
        self.blocks = nn.ModuleList(Block(features, heads, dropout) for _ in range(depth))
        score = nn.Linear(features, 1)
        if prior != "none":
            nn.init.zeros_(score.weight)
            nn.init.zeros_(score.bias)
        self.head = nn.Sequential(nn.LayerNorm(features), score)

    def encode(self, image: torch.Tensor, wrap: bool, sensor: Sensor | None = None) -> _Encoded:
        """Extracts features z from ranges (B, H, W) [m] and projects them for the first attention."""
        z = self.encoder(normalised(image, self.norm_range), wrap)
        if len(self.blocks) == 0 or (self.training and self.dropout > 0):
            return _Encoded(z, None)
        first = self._first().attention
        position = self.position.weight * OFFSET_SCALE, self.position.bias
        norm = first.norm.weight, first.norm.bias
        return _Encoded(z, project_pixels(z, position, norm, first.qkv.weight, first.heads))

    def decode(self, encoded: _Encoded, image: torch.Tensor, queries: torch.Tensor, wrap: bool) -> torch.Tensor:
        """Blends the ranges of the 4 neighbours of each query, with predicted weights."""
        prior, floor = self.prior, self.area_floor
        if encoded.projected is not None and self.is_fused(encoded):  # scores and blend as one kernel
            weights = self._decoder_weights()
            return fused_decode(encoded.projected, image, queries, weights, prior, wrap, area_floor=floor)
        scores = self.scores(encoded, queries, wrap).to(image.dtype)
        return gather_blend(image, queries, scores, prior, wrap, area_floor=floor, backend=self.backend)

    def scores(self, encoded: _Encoded, queries: torch.Tensor, wrap: bool) -> torch.Tensor:
        """Returns the score (B, Q, 4) of each neighbour of queries (B, Q, 2); see `kernels.gather_blend`."""
        features, projected = encoded
        blocks = self.blocks
        if projected is None:  # tokens z (B, Q, 4, C): the feature of each neighbour and its embedded offset (Fig. 2)
            z, offsets = gather_neighbours(features, queries, wrap, self.backend)
            z = z + self.position(offsets * OFFSET_SCALE)
        else:  # the same tokens after the first block, whose projections were computed once per pixel
            first, blocks = self._first(), self.blocks[1:]
            output = first.attention.out.weight, first.attention.out.bias
            z = neighbour_attention(projected, queries, output, wrap, backend=self.backend)
            z = z + first.feed_forward(z)
        for block in blocks:
            z = block(z, self.backend)
        return self.head(z).squeeze(-1)

    def is_fused(self, encoded: _Encoded) -> bool:
        """Returns whether the whole decoder is one kernel: in inference, at depth 1, if `fused_decode` can run."""
        projected, inference = encoded.projected, self.backend == "warp" and not torch.is_grad_enabled()
        return projected is not None and inference and len(self.blocks) == 1 and fused_decode_serves(projected)

    def _first(self) -> Block:
        block = self.blocks[0]
        assert isinstance(block, Block)
        return block

    def _decoder_weights(self) -> DecoderWeights:
        block, (head_norm, score) = self._first(), self.head
        norm, hidden, _, _, back, _ = block.feed_forward
        layers = (block.attention.out, norm, hidden, back, head_norm, score)
        return DecoderWeights(*((layer.get_parameter("weight"), layer.get_parameter("bias")) for layer in layers))
