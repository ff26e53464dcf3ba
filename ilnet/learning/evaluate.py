"""Measuring models: pairs of what a model sees and what it should predict, and mean figures over such pairs.

The pairs that are made here are on `simulate.best_device()`.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm  # type: ignore[import-untyped]

from ilnet import models, scan_files
from ilnet.learning import metrics
from ilnet.scan import Pair
from ilnet.sensor import PAPER_INPUT, Sensor, preset
from ilnet.world import places, simulate

__all__ = ["measure", "mesh_pairs", "scan_pair", "town_pairs"]

# The figures of the paper, and those that tell whether edges stay sharp.
_FIGURES = ("mae", "iou", "precision", "recall", "f1", "floating", "edge_mae")


def town_pairs(name: str, count: int, output: Sensor) -> list[Pair]:
    """Scans a town at evenly spread waypoints, each with its own traffic.

    Args:
        name: One of `towns.NAMES`.
        count: Number of waypoints.
        output: The sensor to predict.

    Returns:
        For each waypoint the scan of `PAPER_INPUT` and that of `output`.

    Raises:
        ValueError: If there is no such town.
    """
    place = places.town(name, device=simulate.best_device())
    return [(scan, truth) for scan, truth in places.held_out_scans(place, count, [PAPER_INPUT, output])]


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
        sensor: Name of the preset with the file's angles, where the file does not hold them.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a scan, or cannot be decimated so.
    """
    truth = scan_files.read(path, preset(sensor) if sensor else None).to(simulate.best_device())
    scan = truth.decimate(rows)
    if rows == truth.sensor.shape[0]:
        raise ValueError(f"rows is {rows}, all the beams of {path}; keep fewer, so that there are some to predict")
    limits = truth.sensor
    if not ((truth.ranges >= limits.min_range) & (truth.ranges <= limits.max_range)).any():
        raise ValueError(
            f"{path}: no return lies within {limits.min_range:g} to {limits.max_range:g} m, "
            f"the nearest at {truth.ranges[truth.ranges > 0].min():g}: are these metres?"
        )
    if not scan.ranges.any():
        raise ValueError(f"{path}: the {rows} beams kept hold no return; keep more rows")
    return scan, truth


def measure(loaded: Mapping[str, models.Model], pairs: Sequence[Pair]) -> list[dict[str, Any]]:
    """Measures models, with a progress bar on stderr.

    Args:
        loaded: The models, by their names in the results, on the device of the scans.
        pairs: At least one pair of what a model sees and what it should predict, all of the same two sensors and on one
            device.

    Returns:
        For each model its name as `model`, the `size` of its predictions, the number of `scans`, and the means over
        them of `mae`, `edge_mae` [m], `iou`, `precision`, `recall`, `f1` and `floating`; see `metrics.compare`.

    Raises:
        ValueError: If a model is not on the scans' device, or cannot predict this sensor.
    """
    scan, truth = pairs[0]
    device = scan.ranges.device
    results = []
    with tqdm(total=len(loaded) * len(pairs), unit="scan", desc="evaluate") as progress:
        for name, model in loaded.items():
            frames = models.Upsampler(model, scan.sensor, truth.sensor, device=device)
            mean = metrics.ScanMetrics().to(device)
            for sparse, dense in pairs:
                mean.update(frames.ranges(sparse), dense)
                progress.update()
            figures = {figure: value.item() for figure, value in mean.compute().items() if figure in _FIGURES}
            results.append({"model": name, "size": truth.sensor.size, "scans": len(pairs), **figures})
    return results
