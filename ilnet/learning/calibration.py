"""Whether a confidence is what it says: of the points with a confidence of 80 %, 80 % should be right to 10 cm."""

from collections.abc import Sequence
from typing import NamedTuple

import torch

from ilnet.learning import metrics
from ilnet.scan import Pair, Scan
from kernels.checks import TOLERANCE

__all__ = ["BINS", "Bin", "calibration_error", "reliability", "told", "without_least"]

BINS = 10
# A query this near to a pixel, in pixels, asks for what was measured there.
_MEASURED = 1e-3


class Bin(NamedTuple):
    """Points of about the same confidence."""

    least: float
    """The least confidence that belongs here."""
    confidence: float
    """The mean."""
    right: float
    """The share of the points that is right to 10 cm."""
    points: int


def told(answers: Sequence[Scan], pairs: Sequence[Pair]) -> tuple[torch.Tensor, torch.Tensor]:
    """Compares predicted points with the truth.

    Args:
        answers: Predicted scans with confidence.
        pairs: For each of them the scan that it was predicted from, and what its sensor measured.

    Returns:
        The confidence of all predicted points (N,), and whether each is right to 10 cm, (N,) bool. Directions that the
        scan below holds itself are left out, since nothing is predicted there.

    Raises:
        ValueError: If an answer has no confidence.
    """
    confidences, right = [], []
    for answer, (scan, truth) in zip(answers, pairs, strict=True):
        if answer.confidence is None:
            raise ValueError("answers have no confidence; they should be scans by a model that tells it")
        pixels = scan.sensor.grid_queries(truth.sensor).to(answer.ranges.device)
        between = ((pixels - pixels.round()).abs() > _MEASURED).any(-1)
        points = between & (metrics.judged(answer.ranges, truth) > 0)
        confidences.append(answer.confidence[points])
        right.append(((answer.ranges - truth.filled()).abs() <= TOLERANCE)[points])
    return torch.cat(confidences), torch.cat(right)


def reliability(confidence: torch.Tensor, right: torch.Tensor) -> list[Bin]:
    """Compares confidences with what came true.

    Args:
        confidence: (N,), from 0 to 1.
        right: (N,) bool.

    Returns:
        Those of `BINS` equally wide bins from 0 to 1 that hold a point.
    """
    number = (confidence * BINS).long().clamp(max=BINS - 1)
    found = []
    for k in number.unique().tolist():
        inside = number == k
        means = confidence[inside].double().mean().item(), right[inside].double().mean().item()
        found.append(Bin(k / BINS, *means, int(inside.sum())))
    return found


def calibration_error(bins: Sequence[Bin]) -> float:
    """Returns the expected calibration error: how far confidence and share are apart, on average over the points.

    Source: C. Guo et al., "On calibration of modern neural networks", ICML 2017, Eq. (3).
    """
    return sum(b.points * abs(b.confidence - b.right) for b in bins) / sum(b.points for b in bins)


def without_least(scan: Scan, share: float) -> Scan:
    """Returns the scan without that share of its returns, 0 to 1, that has the least confidence.

    Raises:
        ValueError: If the scan has no confidence.
    """
    if scan.confidence is None or not (scan.ranges > 0).any():
        return scan.confident(0.0)
    return scan.confident(scan.confidence[scan.ranges > 0].quantile(share).item())
