"""How good a predicted range image is: errors in metres, occupied voxels (paper, Sec. III-B), points at edges."""

from collections.abc import Callable, Iterator

import torch
import torch.nn.functional as F
from scipy.spatial import KDTree
from torchmetrics import Metric

from ilnet.scan import Scan
from ilnet.sensor import Sensor

__all__ = ["FIGURES", "VOXEL", "ScanMetrics", "chamfer", "cloud", "compare", "edges", "floating", "judged", "voxels"]

FIGURES = ("mae", "iou", "precision", "recall", "f1", "floating", "edge_mae", "flat_mae")
# Edge length of the voxels [m] (paper, Sec. III-B).
VOXEL = 0.1
# Points of a cloud from which the Chamfer distance is measured.
SAMPLE = 50_000
# A point this close to a surface is on it [m]. It is several times a LiDAR's noise of centimetres and the error of a
# bent blend on near ground, and a tenth of the gap between a car and the wall behind it.
MARGIN = 0.3
# The plane of a visible surface passes the sensor at least this far away [m]; that of the ground passes it at 1.5 m.
PLANE = 1.0
# Pixels from the middle of the 5×5 neighbourhood to its sides: half the way between measured beams from 16 to 64 rows.
REACH = 2


def voxels(points: torch.Tensor) -> torch.Tensor:
    """Returns the voxels that points occupy.

    Args:
        points: (N, 3) metres, within 100 km of the origin.

    Returns:
        (M,) int64, a number for each occupied voxel, sorted.
    """
    x, y, z = (points.double() / VOXEL).floor().long().add(1 << 20).unbind(-1)
    return torch.unique((x << 42) + (y << 21) + z)


def chamfer(one: torch.Tensor, other: torch.Tensor) -> float:
    """Returns the Chamfer distance of two point clouds.

    It is the mean distance from a point of the one cloud to the nearest of the other, plus the mean the other way. Each
    mean is over at most `SAMPLE` points, evenly spaced in their order: a search for a far point takes long.

    Args:
        one: (N, 3) metres.
        other: (M, 3) metres.

    Returns:
        Metres; NaN if a cloud has no point.
    """
    if not (len(one) and len(other)):
        return float("nan")
    clouds = [points.double().cpu().numpy() for points in (one, other)]
    pairs = clouds, clouds[::-1]
    there, back = (KDTree(b).query(a[:: -(-len(a) // SAMPLE)], workers=-1)[0] for a, b in pairs)
    return float(there.mean() + back.mean())


def cloud(ranges: torch.Tensor, sensor: Sensor) -> torch.Tensor:
    """Returns the points (N, 3) [m] of those ranges (H, W) [m] that lie within the limits of the sensor."""
    within = sensor.sees(ranges)
    return sensor.directions().to(ranges.device)[within] * ranges[within].unsqueeze(-1)


def judged(ranges: torch.Tensor, truth: Scan) -> torch.Tensor:
    """Returns predicted ranges (H, W) [m] without those at pixels of the true scan that were never looked at: 0 there.

    What is there is unknown: a return would be no error, nor would a no return.
    """
    return ranges if truth.seen is None else ranges.where(truth.seen, 0.0)


def _padded(image: torch.Tensor, wrap: bool) -> torch.Tensor:
    """Returns (C, H, W) with REACH more pixels on each side: rows repeat, columns wrap around the seam or repeat."""
    sides = F.pad(image.unsqueeze(0), (REACH, REACH, 0, 0), "circular" if wrap else "replicate")
    return F.pad(sides, (0, 0, REACH, REACH), "replicate").squeeze(0)


def _pairs(truth: Scan) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Yields the nearer range of two neighbours, the farther one, and whether they part: per column, then per row.

    All are padded. Repeated pixels make pairs of equal ranges, which never part and add no surface.
    """
    ranges = truth.filled()
    points = truth.sensor.directions().to(ranges.device) * ranges.unsqueeze(-1)
    padded = _padded(torch.cat((points.movedim(-1, 0), ranges.unsqueeze(0))), truth.sensor.wrap)
    for axis in (1, 2):
        count = padded.shape[axis] - 1
        one, other = padded.narrow(axis, 0, count), padded.narrow(axis, 1, count)
        low, high = torch.minimum(one[3], other[3]), torch.maximum(one[3], other[3])
        # Squares of twice the areas of two triangles: of both points and the sensor, and of one with the height PLANE.
        area = torch.linalg.cross(one[:3], other[:3], dim=0).square().sum(0)
        largest = (PLANE * (one[:3] - other[:3])).square().sum(0)
        yield low, high, (high - low > 2 * MARGIN) & (area < largest)


def _windows(image: torch.Tensor, truth: Scan) -> torch.Tensor:
    """Returns a view (H, W, h, w) of each pixel's neighbourhood in a padded image; pairs lack one row or column."""
    height, width = (padded - count + 1 for padded, count in zip(image.shape, truth.sensor.shape, strict=True))
    return image.unfold(0, height, 1).unfold(1, width, 1)


def _over_windows(reduce: Callable[..., torch.Tensor], image: torch.Tensor, truth: Scan) -> torch.Tensor:
    """Returns each pixel's neighbourhood reduced, (H, W): rows, then columns, ten times as fast as both at once."""
    height, width = _windows(image, truth).shape[2:]
    return reduce(reduce(image.unfold(0, height, 1), dim=-1).unfold(1, width, 1), dim=-1)


def edges(truth: Scan) -> torch.Tensor:
    """Returns which pixels are near a range edge.

    Take two pixels i, j next to each other in a row or a column, with true ranges t_i, t_j (no return is `norm_range`)
    and points p_i, p_j. They *part* where `|t_i - t_j| > 2 m` and `|p_i × p_j| / |p_i - p_j| < D`, with m = 0.3 m and
    D = 1 m. The first says that the gap has room for a point on neither side. The second says that the straight line
    through both points passes the sensor closer than D, so that no visible surface holds both. Ground at a grazing
    angle has large gaps too, but its lines pass the sensor as far away as the ground itself. A pixel is at an edge
    where two pixels of its 5×5 neighbourhood part. Columns wrap on a full circle.

    Args:
        truth: The scan whose ranges are taken as true.

    Returns:
        (H, W) bool.
    """
    in_columns, in_rows = (_over_windows(torch.any, parted, truth) for _, _, parted in _pairs(truth))
    return in_columns | in_rows


def floating(ranges: torch.Tensor, truth: Scan) -> torch.Tensor:
    """Returns which predicted points float in empty space between two surfaces.

    Let S be the set of ranges where a pixel's 5×5 neighbourhood holds surfaces: each true range t_i, and the interval
    from t_i to t_j for any two neighbours that do not part (see `edges`). A predicted range p floats where
    min S < p < max S and no number in S is closer to p than m = 0.3 m. Only returns at pixels near an edge can float.

    Args:
        ranges: (H, W) predicted ranges [m].
        truth: The true scan, by the sensor of the prediction.

    Returns:
        (H, W) bool.
    """
    filled = _padded(truth.filled().unsqueeze(0), truth.sensor.wrap)[0]
    nearest, farthest = (_over_windows(reduce, filled, truth) for reduce in (torch.amin, torch.amax))
    found = truth.sensor.sees(ranges) & (ranges > nearest) & (ranges < farthest)
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
        ranges: (H, W) predicted ranges [m]; near `norm_range` and beyond means no return, and so does less than the
            sensor's minimum.
        truth: The true scan, by the sensor of the prediction.

    Returns:
        The `FIGURES`, each 0 where it is undefined: a prediction without a return has a precision, an IoU and an F1 of
        0, as all its voxels are missing. The authors' code has NaN there, and so in the mean over scans. Pixels where
        the sensor of `truth` never looked are left out:
        mae: Mean absolute error [m] over all pixels; no return counts as `norm_range`.
        iou, precision, recall, f1: Figures of the occupied voxels of 0.1 m, without ranges outside the sensor's limits.
        floating: Share of the predicted returns that float between two surfaces, see `floating`.
        edge_mae, flat_mae: Mean absolute error [m] over the pixels near range edges, see `edges`, and over the others.

    Raises:
        ValueError: If the shapes differ or a prediction is not finite.

    Source: paper Sec. III-B; conventions of the authors' code. The measures of edges are our own.
    """
    if ranges.shape != truth.ranges.shape:
        raise ValueError(f"ranges has shape {tuple(ranges.shape)}; it should be {tuple(truth.ranges.shape)}")
    if not ranges.isfinite().all():
        raise ValueError(f"ranges holds {int((~ranges.isfinite()).sum())} NaN or infinite values; all should be finite")
    far = truth.sensor.norm_range
    ranges = judged(ranges.where(ranges >= truth.sensor.min_range, far).clamp(max=far), truth)
    error, at_edge = (ranges - truth.filled()).abs(), edges(truth)
    if truth.seen is not None:
        error, at_edge = error[truth.seen], at_edge[truth.seen]
    predicted, true = (voxels(cloud(image, truth.sensor)) for image in (ranges, truth.ranges))
    common = int(torch.isin(predicted, true, assume_unique=True).sum())
    precision = common / max(len(predicted), 1)
    recall = common / max(len(true), 1)
    return {
        "mae": error.mean().item(),
        "iou": common / max(len(predicted) + len(true) - common, 1),
        "precision": precision,
        "recall": recall,
        "f1": 2 * precision * recall / max(precision + recall, 1e-12),
        "floating": _mean(floating(ranges, truth)[truth.sensor.sees(ranges)].float()),
        "edge_mae": _mean(error[at_edge]),
        "flat_mae": _mean(error[~at_edge]),
    }


class ScanMetrics(Metric):
    """Means of the figures of `compare` over scans; in several processes, over the scans of all of them."""

    full_state_update = False
    sums: torch.Tensor
    scans: torch.Tensor

    def __init__(self) -> None:
        super().__init__()
        # Double precision, so that the means do not depend on which process measured which scan.
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
