"""Range images: from the arrays of a file to a scan."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from ilnet.scan import Scan
from ilnet.scan_files.points import Points, fraction, note, real, unit_of
from ilnet.sensor import Sensor

__all__ = ["points_of", "resampled", "scan_of"]

# What a file may have for each pixel.
_IMAGES = ("intensity", "confidence", "time", "seen")
# How far the columns may be from an even full turn, as a share of it.
_TURN_TOLERANCE = 0.02


def scan_of(images: Mapping[str, np.ndarray], sensor: Sensor, source: str) -> Scan:
    """Returns the scan of images in the rows and columns of a sensor.

    Args:
        images: `range` (H, W) in metres or millimetres, where 0, NaN, an infinity or -1 is no return. Perhaps
            `intensity` of any scale, `confidence`, `time` [s] and `seen`, (H, W).
        sensor: The sensor that measured them.
        source: What the images are called in notes.

    Raises:
        ValueError: If an image has another shape, the unit cannot be told, or a value is out of its limits.
    """
    ranges = real("range", images["range"])
    for name in images.keys() & {*_IMAGES}:
        if images[name].shape != ranges.shape:
            raise ValueError(f"{name} has shape {images[name].shape}; it should be {ranges.shape}, as range")
    others: dict[str, Any] = {}
    with np.errstate(all="ignore"):
        ranges = np.where(_returned(ranges), ranges, 0.0)
        measured = ranges != 0
        if ranges.shape == sensor.shape and (ranges >= 0).all():  # or a scan says what is wrong
            ranges *= unit_of(ranges[measured], sensor, source)
        if "intensity" in images:
            others["intensity"] = fraction(images["intensity"], measured)
        for name in ("confidence", "time"):
            if name in images:
                others[name] = np.where(measured, real(name, images[name]), 0.0)
        if "time" in others:
            others["time"] = np.where(measured, others["time"] - min(others["time"].min(initial=0.0), 0.0), 0.0)
    if "seen" in images:
        others["seen"] = torch.from_numpy(images["seen"].copy())
    return Scan(torch.from_numpy(ranges), sensor, **others)


def resampled(
    images: Mapping[str, np.ndarray], azimuth: np.ndarray, source: str
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Moves the pixels of images whose azimuths differ from row to row into columns of one azimuth each, and notes it.

    A row moves as a whole by its offset from whole columns, so that even rows neither lose nor double a pixel. Of
    several pixels in one place the nearest return stays.

    Args:
        images: `range` (H, W) and perhaps others of that shape.
        azimuth: (H, W) [rad], the azimuth of each pixel; NaN where it has none.
        source: What the images are called in the note.

    Returns:
        The images (H, V), with `seen`, and the azimuths (V,) of their columns [rad].

    Raises:
        ValueError: If the azimuths do not run along the rows.
    """
    ranges = real("range", images["range"])
    if azimuth.shape != ranges.shape or ranges.ndim != 2:
        raise ValueError(f"its azimuths have shape {azimuth.shape}; it should be {ranges.shape}, as range")
    height, width = ranges.shape
    step = np.nanmedian(_wrapped(np.diff(azimuth, axis=1))) if np.isfinite(azimuth).sum() > 1 and width > 1 else 0.0
    if not abs(step) > 1e-6:
        raise ValueError("its azimuths do not rise or fall from column to column")
    if full := abs(abs(step) * width / math.tau - 1) < _TURN_TOLERANCE:
        step = math.copysign(math.tau / width, step)
    # What is left of each azimuth beyond whole columns, as an angle of its own, so that it has a mean.
    beyond = np.exp(2j * np.pi / step * np.where(np.isfinite(azimuth), azimuth, np.nan))
    of_row = np.nanmean(np.where(np.isfinite(azimuth).any(axis=1, keepdims=True), beyond, 1), axis=1)
    offset = np.angle(of_row / np.mean(of_row)) * step / (2 * np.pi)
    common = np.angle(np.mean(of_row)) * step / (2 * np.pi)
    centre = np.angle(np.nanmean(np.exp(1j * azimuth))) if not full else azimuth[np.isfinite(azimuth)][0]
    number = np.round((centre + _wrapped(azimuth - offset[:, None] - centre) - common) / step)
    found = np.isfinite(number) & np.isfinite(ranges)
    first = int(number[found].min()) if not full else round((centre - common) / step)
    count = width if full else int(number[found].max()) - first + 1
    column = ((np.where(found, number, 0) - first) % count).astype(np.int64)
    # Returns from far to near, so that the nearest is written last; no returns before all of them.
    distance = np.where(_returned(ranges) & (ranges != 0), ranges, np.inf)
    order = np.argsort(-distance, axis=None, kind="stable")
    order = order[found.ravel()[order]]
    row, column = order // width, column.ravel()[order]
    moved = {name: np.zeros((height, count), image.dtype) for name, image in images.items()}
    for name, image in images.items():
        moved[name][row, column] = image.ravel()[order]
    if "seen" not in images:
        moved["seen"] = np.zeros((height, count), bool)
        moved["seen"][row, column] = True
    error = np.abs(_wrapped((column + first) * step + common - azimuth.ravel()[order])).max()
    note(
        source,
        f"its azimuths differ from row to row: resampled to {count} columns {np.rad2deg(abs(step)):.3g} degrees apart, "
        f"each pixel at most {np.rad2deg(error):.2g} degrees from its own azimuth",
    )
    return moved, (np.arange(count) + first) * step + common


def points_of(images: Mapping[str, np.ndarray], azimuth: np.ndarray, sensor: Sensor) -> Points:
    """Returns the pixels of images as points (H x W,), in the unit of the range, with their row as ring.

    Args:
        images: `range` (H, W), perhaps `intensity`, `confidence` and `time`.
        azimuth: (H, W) [rad], the azimuth of each pixel.
        sensor: The sensor that measured them, with H rows.

    Raises:
        ValueError: If the shapes differ.
    """
    ranges = real("range", images["range"])
    height = sensor.shape[0]
    if azimuth.shape != ranges.shape or len(ranges) != height:
        raise ValueError(
            f"its range has shape {ranges.shape} and its azimuths {azimuth.shape}; both should have {height} rows, as "
            f"{sensor}"
        )
    ranges = np.where(_returned(ranges), ranges, 0.0)
    elevation = np.broadcast_to(sensor.elevations[:, None], ranges.shape)
    found = {
        "x": ranges * np.cos(elevation) * np.cos(azimuth),
        "y": ranges * np.cos(elevation) * np.sin(azimuth),
        "z": ranges * np.sin(elevation),
        "ring": np.broadcast_to(np.arange(height)[:, None], ranges.shape),
    }
    found |= {name: images[name] for name in ("intensity", "confidence", "time") if name in images}
    return {name: image.ravel() for name, image in found.items()}


def _returned(ranges: np.ndarray) -> np.ndarray:
    return np.isfinite(ranges) & (ranges != -1)


def _wrapped(angle: np.ndarray) -> np.ndarray:
    """Returns angles [rad] in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
