"""Measuring models: pairs of what a model sees and what it should predict, and mean figures over such pairs.

The pairs that are made here are on `simulate.best_device()`.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats
from tqdm import tqdm  # type: ignore[import-untyped]

from ilnet import data, memory, models, scan_files, sensor_files
from ilnet.data import Archive, RangeImageTree
from ilnet.learning import metrics
from ilnet.scan import Pair
from ilnet.sensor import PAPER_INPUT, Sensor, parse_size
from ilnet.world import places, simulate

__all__ = [
    "StoredPairs",
    "interval",
    "measure",
    "mesh_pairs",
    "scan_by_scan",
    "scan_pair",
    "stored_pairs",
    "summary",
    "town_pairs",
]

# The figures of the paper, and those that tell whether edges stay sharp.
_FIGURES = ("mae", "iou", "precision", "recall", "f1", "floating", "edge_mae", "chamfer")

# The memory that a ray of a scan takes [bytes].
_PER_RAY = 4


def town_pairs(name: str, count: int, output: Sensor, source: Sensor = PAPER_INPUT) -> list[Pair]:
    """Scans a town at evenly spread waypoints, each with its own traffic.

    Args:
        name: One of `towns.NAMES`.
        count: Number of waypoints.
        output: The sensor to predict.
        source: The sensor to predict it from.

    Returns:
        For each waypoint the scan of `source` and that of `output`.

    Raises:
        ValueError: If there is no such town, or so many scans would take too much memory.
    """
    rays = sum(math.prod(sensor.shape) for sensor in (source, output))
    memory.check(f"{count} pairs of scans", count * rays * _PER_RAY)
    place = places.town(name, device=simulate.best_device())
    return [(scan, truth) for scan, truth in places.held_out_scans(place, count, [source, output])]


def mesh_pairs(path: Path, positions: Sequence[Sequence[float]], output: Sensor) -> list[Pair]:
    """Scans any mesh.

    Args:
        path: A mesh file, metres, z up.
        positions: (x, y, z) of the sensor in the mesh [m]; it looks along x.
        output: The sensor to predict.

    Returns:
        For each position the scan of `PAPER_INPUT` and that of `output`.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a mesh, or nothing is in range of a position.
    """
    place = places.mesh(path, positions, simulate.best_device())
    pairs = []
    for number, position in enumerate(positions):
        scan, truth = (simulate.scan(place.mesh, sensor, place.pose(number)) for sensor in (PAPER_INPUT, output))
        if not scan.ranges.any():
            corners = place.vertices.min(0), place.vertices.max(0)
            low, high = (", ".join(f"{c:.1f}" for c in corner) for corner in corners)
            raise ValueError(
                f"{path}: nothing within {PAPER_INPUT.max_range:g} m of {tuple(position)}; "
                f"the mesh spans ({low}) to ({high}): choose another position"
            )
        pairs.append((scan, truth))
    return pairs


def scan_pair(path: Path, rows: int, sensor: str | None = None) -> Pair:
    """Returns a measured scan with only some of its beams, and the whole of it.

    Args:
        path: A scan file; see `ilnet.scan_files.read`.
        rows: Number of beams to keep, fewer than the scan has.
        sensor: Name of the preset or file of a table with the file's angles, where the file does not hold them.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a scan, or cannot be decimated so.
    """
    truth = scan_files.read(path, sensor_files.named(sensor) if sensor else None).to(simulate.best_device())
    scan = truth.decimate(rows)
    if rows == truth.sensor.shape[0]:
        raise ValueError(f"rows is {rows}, all the beams of {path}; keep fewer, so that there are some to predict")
    limits = truth.sensor
    if not limits.sees(truth.ranges).any():
        raise ValueError(
            f"{path}: no return lies within {limits.min_range:g} to {limits.max_range:g} m, "
            f"the nearest at {truth.ranges[truth.ranges > 0].min():g}: are these metres?"
        )
    if not scan.ranges.any():
        raise ValueError(f"{path}: the {rows} beams kept hold no return; keep more rows")
    return scan, truth


class StoredPairs(Sequence[Pair]):
    """Scans of one size on disk, each with that of another size from the same place; read when they are asked for.

    Args:
        stored: The scans.
        source: The size that a model sees, such as "16x1024".
        output: The size that it should predict.
        numbers: Which scans; all by default.

    Raises:
        OSError: If one of them lacks a size.
        ValueError: If there is no such size.
    """

    def __init__(
        self, stored: Archive | RangeImageTree, source: str, output: str, numbers: Sequence[int] | None = None
    ):
        self.stored, self.sizes = stored, (source, output)
        self.numbers = range(len(stored)) if numbers is None else numbers
        self.device = simulate.best_device()
        stored.check(self.sizes, self.numbers)

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: Any) -> Any:
        """Returns a pair; for a slice, `StoredPairs`."""
        if isinstance(index, slice):
            return StoredPairs(self.stored, *self.sizes, self.numbers[index])
        scan, truth = (self.stored.scan(self.numbers[index], size).to(self.device) for size in self.sizes)
        return scan, truth


def stored_pairs(
    path: Path, source: str | None = None, output: str | None = None, count: int | None = None
) -> list[StoredPairs]:
    """Returns the scans in an archive, or in a tree of the paper's authors, as pairs for each size to predict.

    Args:
        path: Its folder; see `data.open_archive`.
        source: The size that a model sees, such as "16x1024"; by default that with the fewest rays.
        output: The size to predict; by default each other one, by its number of rays.
        count: Number of scans, evenly spread over all; all by default.

    Raises:
        OSError: If there is nothing of the kind, or a scan lacks a size.
        ValueError: If there are not two sizes, no such size, or fewer scans than `count`.
    """
    stored = data.open_archive(path)
    sizes = sorted(stored.sizes, key=lambda size: math.prod(parse_size(size)))
    if len(sizes) < 2:
        raise ValueError(
            f"{path}: holds scans of {', '.join(sizes)} only; it should hold two sizes, one to predict from and one to "
            "predict"
        )
    source = source or sizes[0]
    if source == output:
        raise ValueError(f"the sizes to predict from and to predict are both {source}; they should differ")
    if count is not None and count > len(stored):
        raise ValueError(f"{path}: holds {len(stored)} scans; it should hold the {count} that are asked for")
    numbers = None if count is None else np.linspace(0, len(stored), count, endpoint=False).astype(int).tolist()
    outputs = [output] if output else [size for size in sizes if size != source]
    return [StoredPairs(stored, source, size, numbers) for size in outputs]


def measure(loaded: Mapping[str, models.Model], pairs: Sequence[Pair]) -> list[dict[str, Any]]:
    """Measures models, with a progress bar on stderr.

    Args:
        loaded: The models, by their names in the results, on the device of the scans.
        pairs: At least one pair of what a model sees and what it should predict, all on one device.

    Returns:
        For each model its name as `model`, the `size` of its predictions ("mixed" if they differ), the number of
        `scans`, and the means over them of `mae`, `edge_mae`, `chamfer` [m], `iou`, `precision`, `recall`, `f1` and
        `floating`; see `metrics.compare` and `metrics.chamfer`.

    Raises:
        ValueError: If a model is not on the scans' device, or cannot predict a sensor.
    """
    figures = scan_by_scan(loaded, pairs)
    return [_means(name, figures[name], pairs) for name in loaded]


def scan_by_scan(loaded: Mapping[str, models.Model], pairs: Sequence[Pair]) -> dict[str, list[dict[str, float]]]:
    """Returns for each model the figures of each pair; arguments, figures and errors are those of `measure`."""
    results: dict[str, list[dict[str, float]]] = {name: [] for name in loaded}
    kept: dict[str, models.Upsampler] = {}
    with tqdm(total=len(loaded) * len(pairs), unit="scan", desc="evaluate") as progress:
        for sparse, dense in pairs:
            cloud = metrics.cloud(dense.ranges, dense.sensor)
            for name, model in loaded.items():
                frames = kept.get(name)
                if frames is None or (frames.source, frames.target) != (sparse.sensor, dense.sensor):
                    frames = models.Upsampler(model, sparse.sensor, dense.sensor, device=sparse.ranges.device)
                    kept[name] = frames
                ranges = frames.ranges(sparse)
                figures = metrics.compare(ranges, dense)
                figures["chamfer"] = metrics.chamfer(metrics.cloud(metrics.judged(ranges, dense), dense.sensor), cloud)
                results[name].append({figure: figures[figure] for figure in _FIGURES})
                progress.update()
    return results


def summary(figures: Mapping[str, Sequence[Mapping[str, float]]], pairs: Sequence[Pair]) -> list[dict[str, Any]]:
    """Returns what `measure` does, and how sure it is, given what `scan_by_scan` returned for these pairs.

    `unseen` is the number of pixels in all scans that were never looked at, and so are left out of all figures. Of two
    scans or more, `iou_interval` and `mae_interval` are 95 % intervals of the means. `iou_difference` and
    `mae_difference` are the mean differences from the first model, scan by scan, and `iou_difference_interval` and
    `mae_difference_interval` their intervals: a model is ahead in IoU where the whole interval is above 0.
    """
    results = []
    unseen = sum(0 if truth.seen is None else int((~truth.seen).sum()) for _, truth in pairs)
    first = next(iter(figures.values()))
    for name, found in figures.items():
        result = _means(name, found, pairs) | {"unseen": unseen}
        for key in ("iou", "mae") if len(pairs) > 1 else ():
            result[f"{key}_interval"] = interval([scan[key] for scan in found])
            if found is not first:
                differences = [scan[key] - other[key] for scan, other in zip(found, first, strict=True)]
                result[f"{key}_difference"] = _mean(differences)
                result[f"{key}_difference_interval"] = interval(differences)
        results.append(result)
    return results


def _means(name: str, figures: Sequence[Mapping[str, float]], pairs: Sequence[Pair]) -> dict[str, Any]:
    sizes = {truth.sensor.size for _, truth in pairs}
    means = {figure: _mean([scan[figure] for scan in figures]) for figure in _FIGURES}
    return {"model": name, "size": sizes.pop() if len(sizes) == 1 else "mixed", "scans": len(pairs), **means}


def _mean(values: Sequence[float]) -> float:
    """Returns the mean of those values that are defined; NaN if none is."""
    defined = [value for value in values if not math.isnan(value)]
    return sum(defined) / len(defined) if defined else math.nan


def interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Returns the 95 % bootstrap interval of the mean over scans, by percentiles.

    Args:
        values: A figure of each scan, or the difference of two models in it, which tells whether one is ahead.

    Returns:
        Its ends; None if there are fewer than two defined values, which say nothing of others.
    """
    defined = [value for value in values if not math.isnan(value)]
    if len(defined) < 2:
        return None
    found = stats.bootstrap((defined,), np.mean, method="percentile", rng=0).confidence_interval
    return float(found.low), float(found.high)
