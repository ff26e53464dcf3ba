"""The protocol by which the literature compares LiDAR super-resolution on KITTI: 64 rows from every fourth of them.

A file of KITTI holds points. They are projected to 64×1024 pixels in two ways:

- "spherical": 64 evenly spaced rows from -24.8° to 2.0°, as the literature does it. The last point in a pixel stays.
- "beams": the rows of `preset("hdl-64e")`, at the angles of the sensor's own beams. The nearest point in a pixel stays.

Each projection is judged by two conventions:

- The literature's. The MAE [m] is over all pixels, where an empty pixel has a range of 0. Then the measured rows are
  pasted into the prediction. IoU and Chamfer distance compare the point clouds of all pixels, of which the empty ones
  lie at the origin. The Chamfer distance is the sum of both means of squared distances [m²].
- Ours. Only the rows that were not measured count, and no empty pixel is a point. The MAE [m] is over the pixels that
  hold a return. The Chamfer distance is that of `metrics.chamfer` [m]. Pixels that no ray went to (`holes.find`) count
  as neither return nor no return, and are bridged in what a model sees. To the literature they are empty pixels.

Source: the published code of TULIP (CVPR 2024). It divides ranges by 80 before the MAE; here they stay metres.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import KDTree
from tqdm import tqdm  # type: ignore[import-untyped]

from ilnet import holes, models, scan_files
from ilnet.learning import metrics
from ilnet.scan import Scan
from ilnet.sensor import Sensor, preset
from ilnet.world import simulate

__all__ = ["PROJECTIONS", "SPHERICAL", "TITLES", "conventional", "files", "judge", "project", "unmeasured"]

_ROWS, _COLUMNS = 64, 1024
# Every so many rows are measured, from row 0 on.
_STEP = 4

SPHERICAL = Sensor(
    np.deg2rad(np.linspace(-24.8, 2.0, _ROWS)),
    np.linspace(-np.pi, np.pi, _COLUMNS, endpoint=False),
    min_range=0.0,
    max_range=120.0,
    norm_range=150.0,
    name="kitti-spherical",
)
"""The literature's even rows."""

PROJECTIONS = {
    "spherical": SPHERICAL,
    "beams": Sensor(preset("hdl-64e").upright().elevations, SPHERICAL.azimuths, 0.0, 120.0, 150.0, "kitti-beams"),
}
"""The sensors that points are projected to."""

TITLES = {
    "spherical": "Even rows, the literature's convention; Chamfer distance in m²",
    "spherical unmeasured": "Even rows, unmeasured rows only; Chamfer distance in m",
    "beams": "True beams, the literature's convention; Chamfer distance in m²",
    "beams unmeasured": "True beams, unmeasured rows only; Chamfer distance in m",
}
"""What each group of figures is, in the order of `judge`. The figures of the first stand beside the model's name."""


def files(paths: Sequence[Path]) -> list[Path]:
    """Returns the `.bin` files that paths name; a folder stands for those in it, by name.

    Raises:
        FileNotFoundError: If there is no such file or folder.
        ValueError: If a file is of another kind, or a folder holds none.
    """
    found = []
    for path in paths:
        inside = scan_files.listed(path)
        found += [file for file in inside if file.suffix == ".bin"] if path.is_dir() else inside
        if not found:
            raise ValueError(f"{path}: there is no .bin file in this folder")
    for path in found:
        if path.suffix != ".bin":
            raise ValueError(f"{path}: its suffix is {path.suffix!r}; it should be .bin, KITTI's format")
    return found


def _points(path: Path) -> np.ndarray:
    """Returns the finite points (N, 3) of a file, in its order [m]."""
    columns = scan_files.read_points(path, columns=4)
    points = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)
    return points[np.isfinite(points).all(1)]


def project(points: np.ndarray, projection: str) -> Scan:
    """Returns the range image of points, with the pixels that no ray went to.

    Args:
        points: (N, 3) metres, in the sensor frame, in the order of the file.
        projection: One of `PROJECTIONS`.

    Raises:
        ValueError: If no point is in view.
    """
    sensor = PROJECTIONS[projection]
    if projection == "beams":
        near = points[np.linalg.norm(points, axis=1) <= sensor.max_range]
        return Scan.from_points(near, sensor)
    distance = np.linalg.norm(points, axis=1)
    points, distance = points[distance > 0], distance[distance > 0]
    elevation = np.rad2deg(np.arcsin(points[:, 2] / distance))
    turn = (np.arctan2(points[:, 1], points[:, 0]) + np.pi) / (2 * np.pi)
    pixels = np.stack(((elevation + 24.8) * (_ROWS - 1) / 26.8, turn * _COLUMNS % _COLUMNS), axis=1)
    row, column = np.round(pixels).astype(int).T
    column %= _COLUMNS
    seen = (row >= 0) & (row < _ROWS) & (distance <= sensor.max_range)
    if not seen.any():
        raise ValueError(f"none of {len(points)} points is in view; they should be metres in the LiDAR's frame")
    ranges = np.zeros(sensor.shape, np.float32)
    ranges[row[seen], column[seen]] = distance[seen]  # of several points in one pixel, numpy keeps the last
    unseen = holes.find(torch.from_numpy(pixels[seen]).float(), sensor) & (torch.from_numpy(ranges) == 0)
    return Scan(torch.from_numpy(ranges), sensor, seen=~unseen)


def conventional(ranges: torch.Tensor, truth: Scan) -> dict[str, float]:
    """Measures a prediction by the literature's convention.

    Args:
        ranges: (64, 1024) predicted metres, 0 for an empty pixel.
        truth: The scan that should have been predicted; its rows 0, 4, 8, … were measured.

    Returns:
        `mae` [m], `iou` and `chamfer` [m²], as described above.
    """
    mae = (ranges - truth.ranges).abs().mean().item()
    pasted = ranges.clone()
    pasted[::_STEP] = truth.ranges[::_STEP]
    directions = truth.sensor.directions().double().to(ranges.device)
    images = pasted.double(), truth.ranges.double()
    predicted, true = ((directions * image[..., None]).view(-1, 3).cpu().numpy() for image in images)
    low = np.minimum(predicted.min(0), true.min(0))
    occupied = [np.unique(((points - low) / metrics.VOXEL).astype(int), axis=0) for points in (predicted, true)]
    either = len(np.unique(np.concatenate(occupied), axis=0))
    both = len(occupied[0]) + len(occupied[1]) - either
    there, back = KDTree(true).query(predicted)[0], KDTree(predicted).query(true)[0]
    return {"mae": mae, "iou": both / either, "chamfer": float((there**2).mean() + (back**2).mean())}


def unmeasured(ranges: torch.Tensor, truth: Scan) -> dict[str, float]:
    """Measures a prediction by our convention: arguments as in `conventional`.

    Returns:
        `mae` [m], `iou` and `chamfer` [m], as described above; `mae` is NaN where no pixel holds a return. `unseen` is
        the number of pixels left out, since no ray went there.
    """
    rest = torch.ones(len(ranges), dtype=torch.bool, device=ranges.device)
    rest[::_STEP] = False
    hidden = Scan(truth.ranges.where(rest[:, None], 0.0), truth.sensor)
    returned = hidden.ranges > 0
    predicted = Scan(metrics.judged(ranges, truth).where(rest[:, None], 0.0), truth.sensor).points()
    occupied = metrics.voxels(predicted), metrics.voxels(hidden.points())
    both = int(torch.isin(*occupied, assume_unique=True).sum())
    return {
        "mae": (ranges - truth.ranges)[returned].abs().mean().item(),
        "iou": both / max(len(occupied[0]) + len(occupied[1]) - both, 1),
        "chamfer": metrics.chamfer(predicted, hidden.points()),
        "unseen": 0 if truth.seen is None else int((~truth.seen)[rest].sum()),
    }


def judge(loaded: Mapping[str, models.Model], paths: Sequence[Path]) -> list[dict[str, Any]]:
    """Measures models on files, with a progress bar on stderr.

    Args:
        loaded: The models, by their names in the results.
        paths: `.bin` files of KITTI.

    Returns:
        For each model its name as `model`, the number of `scans`, and means over them: `mae`, `iou` and `chamfer` of
        the spherical projection by the literature's convention, and the same keys in dicts for the other `TITLES`,
        with `unseen` where only unmeasured rows count.
        `files` has all of these for each file.

    Raises:
        OSError: If a file cannot be read.
        ValueError: If a file is not KITTI's, or a model cannot predict this sensor.
    """
    device = simulate.best_device()
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in loaded}
    frames: dict[tuple[str, str], models.Upsampler] = {}
    with tqdm(total=len(paths) * len(loaded), unit="scan", desc="evaluate") as progress:
        for path in paths:
            points = _points(path)
            truths = {kind: project(points, kind).to(device) for kind in PROJECTIONS}
            for name, model in loaded.items():
                found: dict[str, Any] = {"file": str(path)}
                for kind, truth in truths.items():
                    sparse = _every_fourth(truth)
                    if (name, kind) not in frames:
                        frames[name, kind] = models.Upsampler(model, sparse.sensor, truth.sensor, device=device)
                    # The literature knows no holes, neither in what a model sees nor in what it should predict.
                    ranges = _answered(frames[name, kind], replace(sparse, seen=None))
                    found[kind] = conventional(ranges, truth)
                    ranges = ranges if sparse.seen is None else _answered(frames[name, kind], sparse)
                    found[f"{kind} unmeasured"] = unmeasured(ranges, truth)
                rows[name].append(found)
                progress.update()
    return [_summary(name, found) for name, found in rows.items()]


def _every_fourth(truth: Scan) -> Scan:
    sensor = truth.sensor
    kept = Sensor(sensor.elevations[::_STEP], sensor.azimuths, sensor.min_range, sensor.max_range, sensor.norm_range)
    return Scan(truth.ranges[::_STEP], kept, seen=None if truth.seen is None else truth.seen[::_STEP])


def _answered(frames: models.Upsampler, sparse: Scan) -> torch.Tensor:
    ranges = frames.ranges(sparse)
    return ranges.where(ranges <= frames.target.max_range, 0.0)


def _summary(name: str, found: list[dict[str, Any]]) -> dict[str, Any]:
    means = {kind: {key: float(np.mean([f[kind][key] for f in found])) for key in found[0][kind]} for kind in TITLES}
    first = means.pop(next(iter(TITLES)))
    return {"model": name, "scans": len(found), **first, **means, "files": found}
