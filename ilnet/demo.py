"""The whole path once: a scan, its upsampled versions, their figures and pictures."""

import math
from pathlib import Path
from typing import Any

import torch

from ilnet import data, meshes, metrics, models, plot, simulate
from ilnet import scan as scans
from ilnet.scan import Scan
from ilnet.sensor import preset
from kernels import Mesh

__all__ = ["METHODS", "demo", "from_mesh", "from_scan", "from_town"]

METHODS = ("nearest", "bilinear", "bilinear-inverse", "iln", "iln-prior")
INPUT, OUTPUT = preset("paper-16x1024"), preset("paper-128x2048")
TOWN = "town01"
# A waypoint of the town with seed 0, in which no network was trained.
_WAYPOINT = 400


def _pair(world: simulate.World, pose: torch.Tensor) -> tuple[Scan, Scan]:
    return simulate.simulate(world, INPUT, pose), simulate.simulate(world, OUTPUT, pose)


def from_town() -> tuple[Scan, Scan]:
    """A scan of 16×1024 in the embedded town, and what 128×2048 rays measure there."""
    street = data.street(TOWN, seed=0, device=simulate.best_device())
    pose = street.pose(_WAYPOINT)
    return _pair(street.world(pose[:3, 3], seed=0), pose)


def from_mesh(path: Path, at: tuple[float, float, float]) -> tuple[Scan, Scan]:
    """A scan of 16×1024 in any mesh, and what 128×2048 rays measure there.

    Args:
        path: A mesh file, metres, z up.
        at: Position of the sensor [m] in the mesh.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a mesh, or nothing is in range of the position.
    """
    if not all(map(math.isfinite, at)):
        raise ValueError(f"--at is {at}; it should be three finite numbers, metres in the mesh")
    vertices, triangles = meshes.read(path)
    scan, truth = _pair(Mesh(vertices, triangles, simulate.best_device()), simulate.pose(at))
    if not scan.ranges.any():
        low, high = (", ".join(f"{c:.1f}" for c in corner) for corner in (vertices.min(0), vertices.max(0)))
        raise ValueError(
            f"{path}: nothing within {INPUT.max_range:g} m of {at}; the mesh spans ({low}) to ({high}): move --at"
        )
    return scan, truth


def from_scan(path: Path, rows: int, sensor: str | None = None) -> tuple[Scan, Scan]:
    """A measured scan with only some of its beams, and the whole of it.

    Args:
        path: A scan file; see `ilnet.scan.read`.
        rows: Beams to keep.
        sensor: Preset with the file's angles, where the file does not name them.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a scan, or cannot be decimated so.
    """
    truth = scans.read(path, preset(sensor) if sensor else None)
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


def demo(scan: Scan, truth: Scan, out: Path, source: str) -> dict[str, Any]:
    """Upsamples a scan with every method, measures and draws the results.

    Args:
        scan: What the methods see.
        truth: What they should predict.
        out: Folder for the pictures and the point cloud; made where missing.
        source: What the scan was taken from, for titles.

    Returns:
        `methods`: for each method its `metrics.compare`; `input` and `output`: the sizes of the scans.
    """
    out.mkdir(parents=True, exist_ok=True)
    figures, upsampled = {}, {}
    for name in METHODS:
        ranges = models.load(name).to(scan.ranges.device).ranges(scan, truth.sensor)
        figures[name] = metrics.compare(ranges, truth)
        upsampled[name] = models.returns(ranges, scan.sensor, truth.sensor)
    size = {"input": "x".join(map(str, scan.sensor.shape)), "output": "x".join(map(str, truth.sensor.shape))}
    pictures = {f"input, {size['input']}": scan, **upsampled, f"truth, {size['output']}": truth}
    plot.range_images(pictures, out / "range_images.png", f"{source}: range images")
    plot.range_images(pictures, out / "range_images_sector.png", f"{source}: 90° of them", sector=90)
    plot.point_clouds({n: s for n, s in pictures.items() if n != "nearest"}, out / "points.png")
    scans.write(out / "iln-prior.ply", upsampled["iln-prior"])
    return {"methods": figures, "input": size["input"], "output": size["output"]}
