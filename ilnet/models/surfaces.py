"""ILN over surfaces: attention among the neighbours weighs what their surfaces say, and predicts how well they know it.

The paper's network weighs the ranges of the 4 neighbours. This one continues the surface that each neighbour lies on in
several ways, and weighs the ranges at which these are met along the query (`kernels.surfaces.maths`).
"""

from typing import NamedTuple

import torch
from torch import nn

from ilnet.models.base import OFFSET_SCALE, Answer, Model
from ilnet.models.encoder import Encoder
from ilnet.models.iln import Block
from ilnet.sensor import Sensor
from kernels import (
    DecoderWeights,
    Projected,
    fused_surfaces,
    fused_surfaces_serves,
    neighbour_attention,
    project_pixels,
    surface_likelihood,
    surface_median,
)
from kernels.checks import KINDS

__all__ = ["Surfaces", "describe"]

# What `describe` returns.
_CHANNELS = 12
# Metres. All that is farther looks alike to the encoder. No return looks like a range of `_NOTHING`.
_FARTHEST, _NOTHING = 200.0, 100.0
# Radians between rows and between columns that the encoder sees as 0: about those of the paper's input.
_ROW_GAP, _COLUMN_GAP = 0.035, 0.006


class _Encoded(NamedTuple):
    measured: torch.Tensor
    """(B, H, W) metres, 0 where nothing returned."""
    projected: Projected
    """What the attention needs of each pixel."""
    sensor: Sensor
    """The sensor that measured."""


def _shifted(image: torch.Tensor, by: int, axis: int, wrap: bool) -> torch.Tensor:
    """Returns for each pixel of (B, H, W) the one before it (`by` = 1) or after it (-1) along an axis.

    At a border that is the pixel itself.
    """
    shifted = image.roll(by, axis)
    if not wrap:
        end = 0 if by == 1 else image.shape[axis] - 1
        shifted.select(axis, end).copy_(image.select(axis, end))
    return shifted


def describe(measured: torch.Tensor, sensor: Sensor, wrap: bool) -> torch.Tensor:
    """Returns what the encoder sees of ranges: how far, where edges and creases are, and how dense the rays are.

    Args:
        measured: (B, H, W) metres, 0 where nothing returned.
        sensor: The sensor that measured, with H beams and W columns.
        wrap: Whether column W-1 meets column 0.

    Returns:
        (B, 12, H, W) without a unit. 3 channels hold the range on three scales; 1, whether nothing returned; 4, how the
        logarithm of the range changes towards the pixels above, below, before and after; 2, the curvature of the
        inverse range along the column and along the row; 2, the logarithms of the spacing of rows and of columns.
    """
    r = measured.where(measured > 0, _NOTHING).clamp(max=_FARTHEST)
    log, u = r.log(), 1 / r
    changes, curvatures = [], []
    for axis, circle, sharpness in ((1, False, 20.0), (2, wrap, 40.0)):
        before, after = (_shifted(log, by, axis, circle) for by in (1, -1))
        changes += [(10 * (before - log)).tanh(), (10 * (after - log)).tanh()]
        both = _shifted(u, 1, axis, circle) + _shifted(u, -1, axis, circle)
        curvatures.append((sharpness * (both - 2 * u) * r).tanh())
    elevations, azimuths = sensor.angles(measured.device)
    gaps = elevations.diff().abs()
    rows = torch.cat((gaps[:1], (gaps[1:] + gaps[:-1]) / 2, gaps[-1:]))
    spacing = (rows / _ROW_GAP).log() / 2, (azimuths.diff().abs().mean() / _COLUMN_GAP).log() / 2
    density = [gap.view(1, -1, 1).expand_as(r) for gap in spacing]
    scales = [r.clamp(max=1.5 * _NOTHING) / 50 - 1, log / 2 - 1, (5 * u).clamp(max=2), (measured == 0).to(r)]
    return torch.stack((*scales, *changes, *curvatures, *density), 1)


class Surfaces(Model):
    """r̂ = the weighted median of the ranges at which the surfaces of the 4 neighbours are met; for any sensor.

    It needs the sensor of each image. No return is filled with that sensor's `norm_range`, and predicted as it. A query
    on a pixel gets what was measured there.

    Args:
        features: Channels of the encoder.
        blocks: Residual blocks of the encoder.
        tokens: Channels of the attention.
        heads: Attention heads; they divide `tokens`.
        weight: Weight of the expected absolute error [m] beside the likelihood in the loss.

    Raises:
        ValueError: If the heads do not divide the tokens.

    Source: ours; `kernels.surfaces.maths` has the equations.
    """

    tells_confidence = True

    def __init__(self, features: int = 48, blocks: int = 8, tokens: int = 32, heads: int = 8, weight: float = 1.0):
        if heads < 1 or tokens % heads:
            raise ValueError(f"heads is {heads}; it should divide the {tokens} tokens")
        super().__init__()
        self.weight = weight
        self.encoder = Encoder(features, blocks, _CHANNELS)
        self.reduce = nn.Conv2d(features, tokens, 1)
        self.position = nn.Linear(2, tokens)
        self.block = Block(tokens, heads, 0.0)
        score = nn.Linear(tokens, KINDS + 1)
        nn.init.zeros_(score.weight)
        nn.init.zeros_(score.bias)
        self.head = nn.Sequential(nn.LayerNorm(tokens), score)

    def encode(self, image: torch.Tensor, wrap: bool, sensor: Sensor | None = None) -> _Encoded:
        """Extracts features from ranges (B, H, W) [m] and projects them for the attention.

        Raises:
            ValueError: If the sensor is None, or its shape is not that of the image.
        """
        if sensor is None:
            raise ValueError("sensor is None; it should be the sensor of the image, whose angles surfaces need")
        if sensor.shape != tuple(image.shape[1:]):
            raise ValueError(f"sensor has shape {sensor.shape}; it should be {tuple(image.shape[1:])}, as the image")
        measured = image.where(image < sensor.norm_range, 0.0)
        z = self.reduce(self.encoder(describe(measured, sensor, wrap), wrap))
        first = self.block.attention
        position = self.position.weight * OFFSET_SCALE, self.position.bias
        norm = first.norm.weight, first.norm.bias
        return _Encoded(measured, project_pixels(z, position, norm, first.qkv.weight, first.heads), sensor)

    def scores(self, encoded: _Encoded, queries: torch.Tensor, wrap: bool) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns a score for each hypothesis (B, Q, 4, 9) and a scale for each neighbour (B, Q, 4).

        `kernels.surfaces.maths` says how the scale becomes the width of a hypothesis.
        """
        out = self.block.attention.out
        t = neighbour_attention(encoded.projected, queries, (out.weight, out.bias), wrap, backend=self.backend)
        scores, scales = self.head(t + self.block.feed_forward(t)).float().split((KINDS, 1), -1)
        return scores, scales.squeeze(-1)

    def decode(self, encoded: _Encoded, image: torch.Tensor, queries: torch.Tensor, wrap: bool) -> torch.Tensor:
        """Returns the weighted medians (B, Q) [m] of the hypotheses; the sensor's `norm_range` means no return."""
        return self.answer(encoded, image, queries, wrap).ranges

    def answer(self, encoded: _Encoded, image: torch.Tensor, queries: torch.Tensor, wrap: bool) -> Answer:
        """Returns what `decode` returns, and how likely the surface of each neighbour is met there."""
        measured, projected, sensor = encoded
        rays = measured, queries, *sensor.angles(image.device)
        if self.is_fused(encoded):  # all in one kernel
            ranges, support, _ = fused_surfaces(projected, *rays, self.decoder_weights(), wrap)
        else:
            scores, scales = self.scores(encoded, queries, wrap)
            ranges, support, _ = surface_median(*rays, scores, scales, wrap, self.backend)
        return Answer(ranges.where(ranges > 0, encoded.sensor.norm_range), support, support.sum(-1))

    def is_fused(self, encoded: _Encoded) -> bool:
        """Returns whether the whole decoder is one kernel: in inference, if `fused_surfaces` can run."""
        inference = self.backend == "warp" and not torch.is_grad_enabled()
        return inference and fused_surfaces_serves(encoded.projected)

    def decoder_weights(self) -> DecoderWeights:
        """Returns the weights behind the attention, as `fused_surfaces` takes them."""
        norm, hidden, _, _, back, _ = self.block.feed_forward
        layers = (self.block.attention.out, norm, hidden, back, *self.head)
        return DecoderWeights(*((layer.get_parameter("weight"), layer.get_parameter("bias")) for layer in layers))

    def loss(
        self,
        image: torch.Tensor,
        queries: torch.Tensor,
        ranges: torch.Tensor,
        wrap: bool = True,
        sensor: Sensor | None = None,
    ) -> torch.Tensor:
        """Returns the mean negative log-likelihood plus the weighted mean of the expected absolute error [m].

        Arguments are those of `Model.loss`. No return is filled with the sensor's `norm_range`.

        Raises:
            ValueError: If the sensor is None, or its shape is not that of the image.
        """
        encoded = self.encode(image, wrap, sensor)
        scores, scales = self.scores(encoded, queries, wrap)
        far, angles = encoded.sensor.norm_range, encoded.sensor.angles(image.device)
        targets = ranges.where(ranges < far, 0.0)
        likelihood, error = surface_likelihood(
            encoded.measured, queries, *angles, scores, scales, targets, far, wrap, self.backend
        )
        return likelihood.mean() + self.weight * error.mean()
