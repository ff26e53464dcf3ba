""".npz, the format of the project: a range image and its angles."""

import io
import math
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ilnet import memory
from ilnet.scan import OF_RETURNS, Scan
from ilnet.scan_files import images, points
from ilnet.scan_files.points import note, real, seconds
from ilnet.sensor import Sensor

__all__ = ["read", "write"]

_LIMITS = ("min_range", "max_range", "norm_range")
_ANGLES = ("elevation_deg", "column_azimuth_deg", "azimuth_deg")
# The last two are what Ouster's tools call intensity and time.
_KEYS = ("range", *_ANGLES, *_LIMITS, "name", *OF_RETURNS, "seen", "reflectivity", "timestamp_ns")
# The header of an array is at most so long [bytes], and a value takes about so much until it is in a scan.
_LONGEST_HEADER, _PER_VALUE = 4096, 40
# A name is cut to so many characters.
_LONGEST_NAME = 80
# How far azimuths may be from 2 pi to be taken for a full turn in radians, as a share of it.
_TURN_TOLERANCE = 0.01


def read(path: Path, sensor: Sensor | None) -> Scan:
    """Returns the scan in a file; raises a ValueError that continues "path: "."""
    found, arrays = _arrays(path)
    if "range" not in arrays:
        raise ValueError(f"it lacks range; its keys are {', '.join(found) or 'none'}")
    pictures = {key: arrays[key] for key in ("range", *OF_RETURNS, "seen") if key in arrays}
    if "reflectivity" in arrays:
        pictures.setdefault("intensity", arrays["reflectivity"])
    if "timestamp_ns" in arrays and "time" not in arrays:
        time = _of_columns(arrays["timestamp_ns"], arrays["range"].shape, str(path))
        pictures |= {} if time is None else {"time": time}
    key = "azimuth_deg" if "azimuth_deg" in arrays else "column_azimuth_deg"
    azimuth = np.deg2rad(real(key, arrays[key])) if key in arrays else None
    if azimuth is not None and azimuth.ndim == 2:
        if sensor is not None:
            return points.scan_of(images.points_of(pictures, azimuth, sensor), sensor, str(path))
        pictures, azimuth = images.resampled(pictures, azimuth, str(path))
    return images.scan_of(pictures, sensor or _sensor(arrays, found, key, azimuth, str(path)), str(path))


def _arrays(path: Path) -> tuple[list[str], dict[str, np.ndarray]]:
    """Returns the names of the arrays in a file, and those that are read, once their headers say that they fit."""
    if not zipfile.is_zipfile(path):
        raise ValueError("it is not a whole .npz archive: it was cut short or never was one")
    try:
        with zipfile.ZipFile(path) as file:
            found = [name[:-4] for name in file.namelist() if name.endswith(".npy")]
            wanted = [key for key in _KEYS if key in found]
            memory.check("it", sum(_size(file, key) for key in wanted) * _PER_VALUE)
            arrays = {}
            for key in wanted:
                with file.open(f"{key}.npy") as member:
                    arrays[key] = np.lib.format.read_array(member, allow_pickle=False)
    except memory.TooLarge:
        raise
    except Exception as error:  # zipfile, zlib and numpy raise many kinds on damaged archives
        raise ValueError(f"it cannot be unpacked: {error}") from error
    return found, arrays


def _size(file: zipfile.ZipFile, key: str) -> int:
    """Returns how many values an array has, or as many of 8 bytes as it fills."""
    with file.open(f"{key}.npy") as member:
        start = io.BytesIO(member.read(_LONGEST_HEADER))
    major, _ = np.lib.format.read_magic(start)
    header = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
    shape, _, kind = header(start)
    return math.prod(shape) * max(1, -(-kind.itemsize // 8))


def _of_columns(stamps: np.ndarray, shape: tuple[int, ...], source: str) -> np.ndarray | None:
    """Returns times [s] of the pixels, of stamps of the pixels or of whole columns; None if they fit neither."""
    if stamps.shape not in (shape, shape[-1:]):
        note(source, f"timestamp_ns is left out: its shape {stamps.shape} is neither {shape} nor {shape[-1:]}")
        return None
    time = seconds(stamps, source)
    return None if time is None else np.broadcast_to(time, shape)


def _sensor(
    arrays: dict[str, np.ndarray], found: list[str], key: str, azimuth: np.ndarray | None, source: str
) -> Sensor:
    """Returns the sensor that the arrays describe, whose columns have these azimuths [rad]."""
    if azimuth is None or "elevation_deg" not in arrays:
        missing = [name for name in ("elevation_deg", key) if name not in arrays]
        raise ValueError(f"it lacks {', '.join(missing)}; its keys are {', '.join(found)}: add them or pass a sensor")
    elevation = np.deg2rad(real("elevation_deg", arrays["elevation_deg"]))
    if elevation.ndim == 2:
        note(source, "its elevations differ from column to column: each row gets its median")
        elevation = np.nanmedian(elevation, axis=1)
    if azimuth.ndim == 1 and len(azimuth) > 1:
        # In radians a full turn is 6.28; in degrees it would be a sensor that sees no more than that.
        turn = float(np.rad2deg(abs(azimuth[-1] - azimuth[0]))) * len(azimuth) / (len(azimuth) - 1)
        if abs(turn / math.tau - 1) < _TURN_TOLERANCE:
            raise ValueError(f"its azimuths span {turn:.3g}, which looks like radians; they should be degrees")
    limits: dict[str, Any] = {name: arrays[name] for name in _LIMITS if name in arrays}
    return Sensor(elevation, azimuth, **limits, name=str(arrays.get("name", ""))[:_LONGEST_NAME])


def write(file: BinaryIO, scan: Scan) -> None:
    """Writes a scan to an open file."""
    sensor = scan.sensor
    arrays: dict[str, np.ndarray] = dict(
        range=scan.ranges.cpu().numpy(),
        elevation_deg=np.rad2deg(sensor.elevations),
        column_azimuth_deg=np.rad2deg(sensor.azimuths),
        min_range=np.array(sensor.min_range),
        max_range=np.array(sensor.max_range),
        norm_range=np.array(sensor.norm_range),
        name=np.array(sensor.name),
    )
    for name in (*OF_RETURNS, "seen"):
        if (image := getattr(scan, name)) is not None:
            arrays[name] = image.cpu().numpy()
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
