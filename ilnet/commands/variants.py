"""What the experiment `surfaces` compares: `Surfaces` with one part replaced by the paper's, and what an oracle knows.

The weights of each variant are weights of `Surfaces`: those that it leaves out are such that they have no effect, and
stay so while it learns.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ilnet import models
from ilnet.learning import metrics
from ilnet.scan import Pair
from ilnet.sensor import PAPER_INPUT, Sensor
from kernels import reference, surface_hypotheses
from kernels.checks import KINDS

__all__ = ["SIZE", "VARIANTS", "Blended", "blended", "ceilings", "from_one_channel", "from_ranges", "surface_weights"]

SIZE = {"features": 24, "blocks": 4, "tokens": 16, "heads": 4}
"""Arguments of the small networks that are compared."""
# A score that leaves no weight beside any other. A lower one would make numbers so small that a CPU is slow with them.
_NEVER = -60.0


def _hypotheses(image: torch.Tensor, queries: torch.Tensor, sensor: Sensor, wrap: bool) -> torch.Tensor:
    """Returns the hypotheses (B, Q, 4, 9) [m] of an image (B, H, W), no return filled with `norm_range` in both."""
    measured = image.where(image < sensor.norm_range, 0.0)
    found = surface_hypotheses(measured, queries, *sensor.angles(image.device), wrap)
    return found.where(found > 0, sensor.norm_range)


def surface_weights(scores: torch.Tensor, queries: torch.Tensor) -> torch.Tensor:
    """Returns the weights (B, Q, 36) of the hypotheses: `kernels.surfaces.maths`, Eq. (3).

    Args:
        scores: (B, Q, 4, 9), see `Surfaces.scores`.
        queries: (B, Q, 2) pixel coordinates (row, column).
    """
    prior = reference.surface_areas(queries).log().unsqueeze(-1)
    return (scores + prior).flatten(-2).softmax(-1)


class Blended(models.Surfaces):
    """The same network, answered with the weighted mean of the hypotheses and trained by its L1, as in the paper."""

    tells_confidence = False

    def answer(self, encoded: Any, image: torch.Tensor, queries: torch.Tensor, wrap: bool) -> models.Answer:
        """Returns what `decode` returns, and nothing else."""
        return models.Answer(self.decode(encoded, image, queries, wrap))

    def decode(self, encoded: Any, image: torch.Tensor, queries: torch.Tensor, wrap: bool) -> torch.Tensor:
        """Returns the weighted means (B, Q) [m]."""
        scores, _ = self.scores(encoded, queries, wrap)
        weights = surface_weights(scores, queries)
        return (weights * _hypotheses(image, queries, encoded.sensor, wrap).flatten(-2)).sum(-1)

    def loss(
        self,
        image: torch.Tensor,
        queries: torch.Tensor,
        ranges: torch.Tensor,
        wrap: bool = True,
        sensor: Sensor | None = None,
    ) -> torch.Tensor:
        """Returns the mean absolute error [m] of the weighted means. Arguments are those of `Model.loss`."""
        return (self(image, queries, wrap, sensor) - ranges).abs().mean()


def blended(file: str | Path) -> Blended:
    """Returns a network of size `SIZE` with the weights of a file, answered with the mean."""
    model = Blended(**SIZE)
    model.load_state_dict(models.load(file).state_dict())
    return model.eval()


def from_ranges(**arguments: Any) -> models.Surfaces:
    """Returns an untrained network that weighs the 4 measured ranges alone, as in the paper."""
    model = models.Surfaces(**arguments)
    score = model.head[1]
    assert isinstance(score, nn.Linear)
    # A neighbour's last hypothesis is its measured range. A hypothesis without weight gives no gradient either.
    score.bias.data[: KINDS - 1] = _NEVER
    return model


def from_one_channel(**arguments: Any) -> models.Surfaces:
    """Returns an untrained network that sees the range alone, as the authors' does: 100 m and no return as 1."""
    model = models.Surfaces(**arguments)
    weight = model.encoder.head.weight
    nn.init.kaiming_uniform_(weight.data[:, :1], math.sqrt(5))  # as a convolution of one channel starts
    weight.data[:, 1:] = 0
    weight.register_hook(lambda gradient: torch.cat((gradient[:, :1], torch.zeros_like(gradient[:, 1:])), 1))
    return model


_ONE_SENSOR = {"sensors": [PAPER_INPUT]}
VARIANTS: Mapping[str, Mapping[str, Any]] = {
    "surfaces": _ONE_SENSOR,
    "ranges": {"make": from_ranges, **_ONE_SENSOR},
    "L1": {"make": Blended, **_ONE_SENSOR},
    "one channel": {"make": from_one_channel, **_ONE_SENSOR},
    "any sensor": {},
}
"""Arguments of `train.train` for each variant: what the network weighs, learns from and sees."""


def ceilings(pairs: Sequence[Pair]) -> dict[str, dict[str, float]]:
    """Measures the best answers of which nothing but the choice is predicted.

    Args:
        pairs: Pairs of a scan and the scan that should be predicted from it.

    Returns:
        The means of `metrics.FIGURES` over the pairs, by what an oracle chooses from: the 4 measured ranges around a
        query, their 36 hypotheses, or all that lies between the 4 ranges.
    """
    means = {name: metrics.ScanMetrics() for name in ("best of 4 ranges", "best of 36 surfaces", "between 4 ranges")}
    for scan, truth in pairs:
        image, sensor = scan.filled().unsqueeze(0), scan.sensor
        queries = sensor.grid_queries(truth.sensor).view(1, -1, 2).to(image)
        found = _hypotheses(image, queries, sensor, sensor.wrap).squeeze(0)
        right, ranges = truth.filled().flatten(), found[..., KINDS - 1]
        answers = (
            _nearest(ranges, right),
            _nearest(found.flatten(-2), right),
            right.clamp(ranges.amin(-1), ranges.amax(-1)),
        )
        for mean, answer in zip(means.values(), answers, strict=True):
            mean.to(image.device).update(answer.view(truth.sensor.shape), truth)
    return {name: {key: value.item() for key, value in mean.compute().items()} for name, mean in means.items()}


def _nearest(choices: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    """Returns of choices (Q, N) those nearest to what is right (Q,)."""
    best = (choices - right.unsqueeze(-1)).abs().argmin(-1, keepdim=True)
    return choices.gather(-1, best).squeeze(-1)
