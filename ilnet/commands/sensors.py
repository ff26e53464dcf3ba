"""The command `sensor`: presets, tables of angles, and the sensor that measured points."""

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ilnet import memory, scan_files
from ilnet.fit import Fit, fit
from ilnet.sensor import PRESETS, SOURCES, Sensor

__all__ = ["angles", "draw", "draw_fit", "estimate", "listing", "summary"]

# Of one point, from its file to its row [bytes].
_PER_POINT = 400
# A gap so many times the wider of its neighbours may be a row without returns.
_SUSPICIOUS_GAP = 1.7


def listing() -> str:
    """Returns a table of the presets."""
    lines = [f"{'name':17}{'rows':>5}{'columns':>9}{'elevations [°]':>18}{'ranges [m]':>13}   source"]
    for name, sensor in PRESETS.items():
        e = np.rad2deg(sensor.elevations)
        view = f"{e.max():.2f} to {e.min():.2f}"
        ranges = f"{sensor.min_range:g} to {sensor.max_range:g}"
        lines.append(f"{name:17}{sensor.shape[0]:5}{sensor.shape[1]:9}{view:>18}{ranges:>13}   {SOURCES[name]}")
    return "\n".join(lines)


def angles(sensor: Sensor) -> str:
    """Returns what a sensor is: its columns, its limits, and the elevation of each row."""
    a = np.rad2deg(sensor.azimuths)
    step = np.median(np.abs(np.diff(a)))
    circle = "a full circle" if sensor.wrap else f"{np.ptp(a):.2f}°"
    lines = [
        f"{sensor.name or 'sensor'}: {sensor.size}, {circle} in steps of {step:.3f}°, column 0 at {a[0]:.3f}°, "
        f"{sensor.min_range:g} to {sensor.max_range:g} m",
        *([f"source: {SOURCES[sensor.name]}"] if PRESETS.get(sensor.name) == sensor else []),
        f"{'row':>5}{'elevation [°]':>15}",
        *(f"{row:5}{elevation:15.3f}" for row, elevation in enumerate(np.rad2deg(sensor.elevations))),
    ]
    return "\n".join(lines)


def estimate(files: Sequence[Path]) -> tuple[Fit, list[np.ndarray]]:
    """Returns the sensor that measured the points in some files, and the points of each, (N, 3) [m].

    Args:
        files: Files of points, with a ring or without; `.npy` of points or of an organised scan, (H, W, 3 or more);
            `.npz` scans, whose rows are taken for rings.

    Raises:
        OSError: If a file is missing or unreadable.
        ValueError: If a file holds no points, or no rows stand out.
    """
    clouds, rings = zip(*map(_cloud, files), strict=True)
    memory.check("the sensor of these files", _PER_POINT * sum(map(len, clouds)))
    try:
        return fit(clouds, rings), list(clouds)
    except ValueError as error:
        raise ValueError(f"{', '.join(map(str, files))}: {error}") from error


def _cloud(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Returns the points in a file, (N, 3) [m], and their rings, (N,)."""
    if path.suffix.lower() == ".npz":
        scan = scan_files.read(path)
        return scan.points().numpy(), np.nonzero(scan.ranges.numpy() > 0)[0]
    if path.suffix.lower() == ".npy":
        return _array(path)
    points = scan_files.read_points(path)
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1, dtype=np.float64)
    ring = points.get("ring")
    return _metres(path, xyz), None if ring is None or len(np.unique(ring)) < 2 else ring


def _array(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    try:
        memory.check(str(path), path.stat().st_size)
        array = np.load(path, allow_pickle=False)
    except memory.TooLarge:
        raise
    except (ValueError, EOFError) as error:
        raise ValueError(f"{path}: it is not a whole .npy file of numbers: {error}") from None
    if array.dtype.names and {"x", "y", "z"} <= set(array.dtype.names):
        xyz = np.stack([array[axis].ravel() for axis in "xyz"], axis=1).astype(np.float64)
        return _metres(path, xyz), array["ring"].ravel() if "ring" in array.dtype.names else None
    if array.dtype.kind not in "fiu" or array.ndim not in (2, 3) or not 3 <= array.shape[-1] <= 16:
        raise ValueError(f"{path}: its shape {array.shape} is neither points (N, 3) nor an organised scan (H, W, 3)")
    ring = np.repeat(np.arange(len(array)), array.shape[1]) if array.ndim == 3 else None
    return _metres(path, array.reshape(-1, array.shape[-1])[:, :3].astype(np.float64)), ring


def _metres(path: Path, xyz: np.ndarray) -> np.ndarray:
    """Returns points in metres. No LiDAR sees hundreds of metres in the median: those are millimetres, as is said."""
    with np.errstate(all="ignore"):  # points that are not finite are left out
        distance = np.linalg.norm(xyz, axis=1)
        usable = distance[np.isfinite(distance) & (distance > 0)]
    if len(usable) and np.median(usable) > 500:
        logging.getLogger("ilnet").warning("%s: points are taken as millimetres", path)
        return xyz / 1000
    return xyz


def summary(found: Fit) -> str:
    """Returns what was found, in lines."""
    sensor = found.sensor
    e, scatter = np.rad2deg(sensor.elevations), np.rad2deg(found.scatter)
    lines = [f"{sensor.size}: {len(e)} rows from {e.max():.3f}° to {e.min():.3f}°, {found.returns.sum()} points"]
    if sensor.name:
        missing = PRESETS[sensor.name].shape[0] - len(e)
        lines.append(
            f"the rows are those of the preset {sensor.name}" + (f", {missing} without returns" if missing else "")
        )
    apart = np.abs(np.diff(e))
    lines.append(
        f"spacing {apart.min():.3f}° to {apart.max():.3f}°; a point lies {np.median(scatter):.4f}° from its row in the "
        f"median, {scatter.max():.4f}° in the worst row"
        + ("" if np.isnan(found.off) else f"; {found.off:.1%} of the points lie off the rows")
    )
    if any(found.origin):
        aside, above = (1000 * value for value in found.origin)
        lines.append(
            f"the beams start {aside:.0f} mm from the z axis and {above:.0f} mm above the origin of the points; the "
            "elevations are those seen from there"
        )
    if found.unsure.any():
        lines.append(
            f"{found.unsure.sum()} rows are unsure, from {e[found.unsure].max():.2f}° to {e[found.unsure].min():.2f}°: "
            "their points scatter by more than a quarter of the spacing; points with a ring tell rows apart"
        )
    gaps = [i for i in range(1, len(apart) - 1) if apart[i] > _SUSPICIOUS_GAP * max(apart[i - 1], apart[i + 1])]
    if gaps:
        lines.append(
            "a row without returns cannot be found; there may be one between "
            + ", ".join(f"{e[i]:.2f}° and {e[i + 1]:.2f}°" for i in gaps)
            + ": more scans would show it"
        )
    return "\n".join(lines)


def draw(sensor: Sensor, path: Path) -> None:
    """Draws the rows of a sensor: elevations, and the spacing between them."""
    figure, axes = _figure(f"{sensor.name or path.stem}: {sensor.size}", 2)
    e = np.sort(np.rad2deg(sensor.elevations))
    axes[0].hlines(e, -0.5, 0.5, linewidth=0.8)
    axes[0].set_xticks([])
    axes[0].set_xlabel("rows")
    axes[1].plot(np.diff(e), (e[1:] + e[:-1]) / 2, ".-", markersize=3, linewidth=0.6)
    axes[1].set_xlim(0, 1.1 * np.diff(e).max())
    axes[1].set_xlabel("spacing of rows [°]")
    axes[0].set_ylabel("elevation [°]")
    _save(figure, path)


def draw_fit(found: Fit, clouds: Sequence[np.ndarray], path: Path) -> None:
    """Draws how elevations of points are distributed, and the rows that were found; the densest five degrees closer."""
    points = np.concatenate([np.asarray(cloud, np.float64) for cloud in clouds])
    aside = np.hypot(points[:, 0], points[:, 1]) - found.origin[0]
    elevation = np.rad2deg(np.arctan2(points[:, 2] - found.origin[1], aside))
    elevation = elevation[np.isfinite(elevation)]
    e = np.rad2deg(found.sensor.elevations)
    figure, axes = _figure(f"{found.sensor.size}: points by elevation, and rows", 3)
    dense = e[int(np.abs(np.diff(e)).argmin())]
    for axis, (low, high) in zip(axes[:2], ((e.min() - 1, e.max() + 1), (dense - 2.5, dense + 2.5)), strict=True):
        width = max((high - low) / 2000, 0.01)
        counts, edges = np.histogram(elevation, np.arange(low, high + width, width))
        axis.hlines(e[(e >= low) & (e <= high)], 0, counts.max(), color="tab:orange", linewidth=0.5)
        axis.stairs(counts, edges, orientation="horizontal", color="tab:blue", linewidth=0.7)
        axis.set_ylim(low, high)
        axis.set_xlabel(f"points in {width:.3f}°")
    axes[2].plot(np.rad2deg(found.scatter), e, ".", markersize=3)
    axes[2].set_xlim(0, 1.1 * max(np.rad2deg(found.scatter).max(), 0.001))
    axes[2].set_xlabel("median distance from the row [°]")
    axes[2].set_ylim(axes[0].get_ylim())
    axes[0].set_ylabel("elevation [°]")
    _save(figure, path)


def _figure(title: str, count: int) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(4 * count, 7), layout="constrained")
    axes = figure.subplots(1, count, squeeze=False)[0]
    figure.suptitle(title)
    return figure, axes


def _save(figure: Figure, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
