"""Figures of any model in any scene: pairs of what it sees and what it should predict, and the means over them."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm  # type: ignore[import-untyped]

from ilnet import models, scan_files
from ilnet.learning import metrics
from ilnet.scan import Scan
from ilnet.sensor import Sensor, preset
from ilnet.world import meshes, places, simulate
from kernels import Mesh

__all__ = ["INPUT", "evaluate", "mesh_pairs", "scan_pair", "town_pairs"]

# What the models see of a scene.
INPUT = preset("paper-16x1024")
# Beside the paper's figures, what tells whether edges stay sharp.
_FIGURES = ("mae", "iou", "precision", "recall", "f1", "floating", "edge_mae")

Pair = tuple[Scan, Scan]
Position = tuple[float, float, float]


def town_pairs(name: str, count: int, output: Sensor) -> list[Pair]:
    """Scans a town at evenly spread waypoints, each with its own traffic.

    Args:
        name: One of `towns.NAMES`.
        count: Number of waypoints.
        output: The sensor to predict.

    Returns:
        For each waypoint the scan of `INPUT` and that of `output`.

    Raises:
        ValueError: If there is no such town.
    """
    street = places.street(name, seed=0, device=simulate.best_device())
    return [(scan, truth) for scan, truth in places.held_out_scans(street, count, [INPUT, output])]


def mesh_pairs(path: Path, positions: Sequence[Position], output: Sensor) -> list[Pair]:
    """Scans any mesh.

    Args:
        path: A mesh file, metres, z up.
        positions: Of the sensor [m] in the mesh; it looks along x.
        output: The sensor to predict.

    Returns:
        For each position the scan of `INPUT` and that of `output`.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a mesh, or nothing is in range of a position.
    """
    for position in positions:
        if not all(map(math.isfinite, position)):
            raise ValueError(f"a position is {position}; it should be three finite numbers, metres in the mesh")
    vertices, triangles = meshes.read(path)
    mesh = Mesh(vertices, triangles, simulate.best_device())
    pairs = []
    for position in positions:
        scan, truth = (simulate.simulate(mesh, sensor, simulate.pose(position)) for sensor in (INPUT, output))
        if not scan.ranges.any():
            low, high = (", ".join(f"{c:.1f}" for c in corner) for corner in (vertices.min(0), vertices.max(0)))
            raise ValueError(
                f"{path}: nothing within {INPUT.max_range:g} m of {position}; "
                f"the mesh spans ({low}) to ({high}): move --at"
            )
        pairs.append((scan, truth))
    return pairs


def scan_pair(path: Path, rows: int, sensor: str | None = None) -> Pair:
    """A measured scan with only some of its beams, and the whole of it.

    Args:
        path: A scan file; see `ilnet.scan_files.read`.
        rows: Beams to keep.
        sensor: Preset with the file's angles, where the file does not name them.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a scan, or cannot be decimated so.
    """
    truth = scan_files.read(path, preset(sensor) if sensor else None)
    truth = Scan(truth.ranges.to(simulate.best_device()), truth.sensor)
    scan = truth.decimate(rows)
    if rows == truth.sensor.shape[0]:
        raise ValueError(f"rows is {rows}, all the beams of {path}: keep fewer, so that there are some to predict")
    limits = truth.sensor
    if not ((truth.ranges >= limits.min_range) & (truth.ranges <= limits.max_range)).any():
        raise ValueError(
            f"{path}: no return lies within {limits.min_range:g} to {limits.max_range:g} m, "
            f"the nearest at {truth.ranges[truth.ranges > 0].min():g}: are these metres?"
        )
    if not scan.ranges.any():
        raise ValueError(f"{path}: the {rows} beams kept hold no return; keep more --rows")
    return scan, truth


def evaluate(loaded: Mapping[str, models.Model], pairs: Sequence[Pair]) -> list[dict[str, Any]]:
    """Measures models, with a progress bar on stderr.

    Args:
        loaded: Models by the names that the results shall bear.
        pairs: At least one pair of what a model sees and what it should predict, all of the same two sensors.

    Returns:
        For each model its name as `model`, the `size` of its predictions, the number of `scans`, and the means over
        them of `mae`, `edge_mae` [m], `iou`, `precision`, `recall`, `f1` and `floating`; see `metrics.compare`.

    Raises:
        ValueError: If a model cannot predict this sensor.
    """
    scan, truth = pairs[0]
    device, size = scan.ranges.device, "x".join(map(str, truth.sensor.shape))
    results = []
    with tqdm(total=len(loaded) * len(pairs), unit="scan", desc="evaluate") as progress:
        for name, model in loaded.items():
            frames = models.Upsampler(model.to(device), scan.sensor, truth.sensor, device=device)
            mean = metrics.ScanMetrics().to(device)
            for sparse, dense in pairs:
                mean.update(frames.ranges(sparse), dense)
                progress.update()
            figures = {figure: value.item() for figure, value in mean.compute().items() if figure in _FIGURES}
            results.append({"model": name, "size": size, "scans": len(pairs), **figures})
    return results
