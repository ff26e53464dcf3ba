"""How close a predicted range image is to the true one: in metres, and as occupied voxels (paper, Sec. III-B)."""

import torch

from ilnet.scan import Scan

__all__ = ["NAMES", "VOXEL", "compare", "voxels"]

# What `compare` returns.
NAMES = ("mae", "iou", "precision", "recall", "f1")

# Metres: edge length of the voxels (paper, Sec. III-B).
VOXEL = 0.1


def voxels(points: torch.Tensor) -> torch.Tensor:
    """The voxels that points occupy.

    Args:
        points: (N, 3) metres.

    Returns:
        (M,) int64, a number for each voxel, sorted. Voxels within 100 km of the origin are told apart.
    """
    x, y, z = (points.double() / VOXEL).floor().long().add(1 << 20).unbind(-1)
    return torch.unique((x << 42) + (y << 21) + z)


def _occupied(ranges: torch.Tensor, truth: Scan) -> torch.Tensor:
    """Voxels of the ranges (H, W) within the limits of the sensor."""
    sensor = truth.sensor
    within = (ranges >= sensor.min_range) & (ranges <= sensor.max_range)
    return voxels(sensor.directions().to(ranges.device)[within] * ranges[within].unsqueeze(-1))


def compare(ranges: torch.Tensor, truth: Scan) -> dict[str, float]:
    """Measures predicted ranges against a scan.

    Args:
        ranges: (H, W) predicted ranges [m], clipped to [0, norm_range]; near `norm_range` means no return.
        truth: What should have been measured, by the sensor of the prediction.

    Returns:
        mae: Mean absolute error [m] over all pixels, no return counting as `norm_range`.
        iou, precision, recall, f1: Of the occupied voxels of 0.1 m, ranges outside the sensor's limits left out;
            0 where undefined.

    Raises:
        ValueError: If the shapes differ or a prediction is not finite.

    Source: paper Sec. III-B; conventions of the authors' code.
    """
    if ranges.shape != truth.ranges.shape:
        raise ValueError(f"ranges has shape {tuple(ranges.shape)}; it should be {tuple(truth.ranges.shape)}")
    if not ranges.isfinite().all():
        raise ValueError(f"ranges holds {int((~ranges.isfinite()).sum())} NaN or infinite values")
    ranges = ranges.clamp(0, truth.sensor.norm_range)
    mae = (ranges - truth.filled()).abs().mean().item()
    predicted, true = _occupied(ranges, truth), _occupied(truth.filled(), truth)
    common = int(torch.isin(predicted, true, assume_unique=True).sum())
    precision = common / max(len(predicted), 1)
    recall = common / max(len(true), 1)
    return {
        "mae": mae,
        "iou": common / max(len(predicted) + len(true) - common, 1),
        "precision": precision,
        "recall": recall,
        "f1": 2 * precision * recall / max(precision + recall, 1e-12),
    }
