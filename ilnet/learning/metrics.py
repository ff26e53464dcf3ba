"""How close a predicted range image is to the true one: in metres, as occupied voxels (paper, Sec. III-B), at edges."""

from collections.abc import Callable, Iterator

import torch
import torch.nn.functional as F
from torchmetrics import Metric

from ilnet.scan import Scan
from ilnet.sensor import Sensor

__all__ = ["FIGURES", "VOXEL", "ScanMetrics", "compare", "edges", "floating", "voxels"]

FIGURES = ("mae", "iou", "precision", "recall", "f1", "floating", "edge_mae", "flat_mae")
# Metres: edge length of the voxels (paper, Sec. III-B).
VOXEL = 0.1
# Metres: a point so close to a surface is on it. Several times a LiDAR's noise of centimetres, and what a bent blend
# misses of near ground; a tenth of the metres between a car and the wall behind it.
MARGIN = 0.3
# Metres: no surface is seen whose plane passes so close to the sensor. The ground under a car's does at 1.5 and more.
PLANE = 1.0
# Pixels from the middle of the 5×5 neighbourhood to its sides: half the way between measured beams at 16 -> 64.
REACH = 2


def voxels(points: torch.Tensor) -> torch.Tensor:
    """The voxels that points occupy.

    Args:
        points: (N, 3) metres.

    Returns:
        (M,) int64, a number for each voxel, sorted. Voxels within 100 km of the origin are told apart.
    """
    x, y, z = (points.double() / VOXEL).floor().long().add(1 << 20).unbind(-1)
    return torch.unique((x << 42) + (y << 21) + z)


def _returns(ranges: torch.Tensor, sensor: Sensor) -> torch.Tensor:
    return (ranges >= sensor.min_range) & (ranges <= sensor.max_range)


def _occupied(ranges: torch.Tensor, truth: Scan) -> torch.Tensor:
    """Voxels of the ranges (H, W) within the limits of the sensor."""
    within = _returns(ranges, truth.sensor)
    return voxels(truth.sensor.directions().to(ranges.device)[within] * ranges[within].unsqueeze(-1))


def _padded(image: torch.Tensor, wrap: bool) -> torch.Tensor:
    """Adds REACH pixels on each side of (C, H, W): rows repeat, columns wrap around the seam or repeat."""
    sides = F.pad(image.unsqueeze(0), (REACH, REACH, 0, 0), "circular" if wrap else "replicate")
    return F.pad(sides, (0, 0, REACH, REACH), "replicate").squeeze(0)


def _pairs(truth: Scan) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Ranges of the nearer and the farther of two neighbours, and whether they part; padded, per column, then per row.

    Repeated pixels make pairs of equal ranges, which part nowhere and add no surface.
    """
    ranges = truth.filled()
    points = truth.sensor.directions().to(ranges.device) * ranges.unsqueeze(-1)
    padded = _padded(torch.cat((points.movedim(-1, 0), ranges.unsqueeze(0))), truth.sensor.wrap)
    for axis in (1, 2):
        count = padded.shape[axis] - 1
        one, other = padded.narrow(axis, 0, count), padded.narrow(axis, 1, count)
        low, high = torch.minimum(one[3], other[3]), torch.maximum(one[3], other[3])
        # Squares of twice the area of the triangle of both points and the sensor, and of one just as high as PLANE.
        area = torch.linalg.cross(one[:3], other[:3], dim=0).square().sum(0)
        largest = (PLANE * (one[:3] - other[:3])).square().sum(0)
        yield low, high, (high - low > 2 * MARGIN) & (area < largest)


def _windows(image: torch.Tensor, truth: Scan) -> torch.Tensor:
    """The neighbourhood (H, W, h, w) of each pixel, a view of a padded image; pairs fill one less row or column."""
    height, width = (padded - count + 1 for padded, count in zip(image.shape, truth.sensor.shape, strict=True))
    return image.unfold(0, height, 1).unfold(1, width, 1)


def _over_windows(reduce: Callable[..., torch.Tensor], image: torch.Tensor, truth: Scan) -> torch.Tensor:
    """Reduces the neighbourhood (H, W) of each pixel, rows first, then columns: a tenth of the time of both at once."""
    height, width = _windows(image, truth).shape[2:]
    return reduce(reduce(image.unfold(0, height, 1), dim=-1).unfold(1, width, 1), dim=-1)


def edges(truth: Scan) -> torch.Tensor:
    """Tells the pixels near a range edge from the others.

    Two pixels i, j next to each other in a row or a column, with true ranges t_i, t_j (no return is `norm_range`) and
    points p_i, p_j, *part* where |t_i - t_j| > 2 m and |p_i × p_j| / |p_i - p_j| < D, with m = 0.3 m and D = 1 m: where
    the gap has room for a point that is on neither side, and the straight line through both passes the sensor closer
    than D, so that no surface in sight holds both. Ground seen at a grazing angle has large gaps as well, but its lines
    pass the sensor as far away as the ground itself. A pixel is at an edge where two pixels of its 5×5 neighbourhood
    part. Columns wrap on a full circle.

    Returns:
        (H, W) bool.
    """
    in_columns, in_rows = (_over_windows(torch.any, parted, truth) for _, _, parted in _pairs(truth))
    return in_columns | in_rows


def floating(ranges: torch.Tensor, truth: Scan) -> torch.Tensor:
    """Finds the predicted points that float in empty space between two surfaces.

    The surfaces that a pixel's 5×5 neighbourhood holds are, along a ray, the set S: each true range t_i, and the
    interval between t_i and t_j for each two neighbours that do not part (`edges`). A predicted range p floats where
    min S < p < max S and no number in S is closer to p than m = 0.3 m. Only pixels at an edge can float, and only
    returns do.

    Args:
        ranges: (H, W) predicted ranges [m].
        truth: What should have been measured, by the sensor of the prediction.

    Returns:
        (H, W) bool.
    """
    filled = _padded(truth.filled().unsqueeze(0), truth.sensor.wrap)[0]
    nearest, farthest = (_over_windows(reduce, filled, truth) for reduce in (torch.amin, torch.amax))
    found = _returns(ranges, truth.sensor) & (ranges > nearest) & (ranges < farthest)
    surfaces = [(filled, filled)]
    for low, high, parted in _pairs(truth):
        surfaces.append((low.masked_fill(parted, torch.inf), high.masked_fill(parted, 0.0)))
    for low, high in surfaces:
        predicted = ranges[found][:, None, None]
        ahead = _windows(low, truth)[found] - MARGIN < predicted
        found[found.clone()] = ~(ahead & (predicted < _windows(high, truth)[found] + MARGIN)).flatten(1).any(1)
    return found


def _mean(values: torch.Tensor) -> float:
    return values.mean().item() if values.numel() else 0.0


def compare(ranges: torch.Tensor, truth: Scan) -> dict[str, float]:
    """Measures predicted ranges against a scan.

    Args:
        ranges: (H, W) predicted ranges [m], clipped to [0, norm_range]; near `norm_range` means no return.
        truth: What should have been measured, by the sensor of the prediction.

    Returns:
        The `FIGURES`, each 0 where undefined:
        mae: Mean absolute error [m] over all pixels, no return counting as `norm_range`.
        iou, precision, recall, f1: Of the occupied voxels of 0.1 m, ranges outside the sensor's limits left out.
        floating: Share of the predicted returns that float between two surfaces, see `floating`.
        edge_mae, flat_mae: The mean absolute error [m] over the pixels at range edges, see `edges`, and the others.

    Raises:
        ValueError: If the shapes differ or a prediction is not finite.

    Source: paper Sec. III-B; conventions of the authors' code. The measures of edges are our own.
    """
    if ranges.shape != truth.ranges.shape:
        raise ValueError(f"ranges has shape {tuple(ranges.shape)}; it should be {tuple(truth.ranges.shape)}")
    if not ranges.isfinite().all():
        raise ValueError(f"ranges holds {int((~ranges.isfinite()).sum())} NaN or infinite values")
    ranges = ranges.clamp(0, truth.sensor.norm_range)
    error, at_edge = (ranges - truth.filled()).abs(), edges(truth)
    predicted, true = _occupied(ranges, truth), _occupied(truth.filled(), truth)
    common = int(torch.isin(predicted, true, assume_unique=True).sum())
    precision = common / max(len(predicted), 1)
    recall = common / max(len(true), 1)
    return {
        "mae": error.mean().item(),
        "iou": common / max(len(predicted) + len(true) - common, 1),
        "precision": precision,
        "recall": recall,
        "f1": 2 * precision * recall / max(precision + recall, 1e-12),
        "floating": _mean(floating(ranges, truth)[_returns(ranges, truth.sensor)].float()),
        "edge_mae": _mean(error[at_edge]),
        "flat_mae": _mean(error[~at_edge]),
    }


class ScanMetrics(Metric):
    """Means over scans of what `compare` measures; in several processes, over the scans of all of them."""

    full_state_update = False
    sums: torch.Tensor
    scans: torch.Tensor

    def __init__(self) -> None:
        super().__init__()
        # Double precision, so that the figures do not depend on who added which scan.
        self.add_state("sums", torch.zeros(len(FIGURES), dtype=torch.float64), "sum")
        self.add_state("scans", torch.tensor(0), "sum")

    def update(self, ranges: torch.Tensor, truth: Scan) -> None:
        """Adds one scan; arguments and errors are those of `compare`."""
        figures = compare(ranges, truth)
        self.sums += torch.tensor([figures[name] for name in FIGURES]).to(self.sums)
        self.scans += 1

    def compute(self) -> dict[str, torch.Tensor]:
        """Returns the `FIGURES`, each the mean over all scans so far."""
        return dict(zip(FIGURES, self.sums / self.scans, strict=True))
