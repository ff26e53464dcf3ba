"""Sensors in files: tables of angles in degrees, `.json` or `.npz`, with the keys of `Sensor.from_table`.

    {"elevation_deg": [15, 13, -13, -15], "columns": 1800, "min_range": 0.5, "max_range": 100, "norm_range": 120}

A scan in `.npz` is such a file too, where it has the angles of its rays.
"""

import json
import os
import secrets
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from ilnet.sensor import PRESETS, Sensor

__all__ = ["check_suffix", "named", "read", "write"]

_SUFFIXES = (".json", ".npz")
# A million angles in digits: beyond it, a file is no table.
_MOST_BYTES = 16 << 20
_KEYS = ("elevation_deg", "column_azimuth_deg", "columns", "min_range", "max_range", "norm_range", "name")


def named(text: str) -> Sensor:
    """Returns the preset of that name, or the sensor in the file of that name.

    Raises:
        OSError: If the file is missing or unreadable.
        ValueError: If it is neither a preset nor a table of angles.
    """
    if text in PRESETS:
        return PRESETS[text]
    if Path(text).suffix.lower() in _SUFFIXES:
        return read(text)
    raise ValueError(
        f"sensor is {text!r}; it should be one of {', '.join(PRESETS)}, or a file of angles ({', '.join(_SUFFIXES)})"
    )


def check_suffix(path: Path) -> None:
    """Raises a ValueError if a file of that name cannot hold a table."""
    if path.suffix.lower() not in _SUFFIXES:
        raise ValueError(f"{path}: its suffix is {path.suffix!r}; it should be one of {', '.join(_SUFFIXES)}")


def read(path: str | Path) -> Sensor:
    """Returns the sensor in a `.json` or `.npz` file; by default it has the name of the file.

    Raises:
        OSError: If the file is missing or unreadable.
        ValueError: If it is damaged, lacks an angle, or describes no sensor.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    check_suffix(path)
    try:
        table = _json(path) if path.suffix.lower() == ".json" else _npz(path)
        return Sensor.from_table({**table, "name": str(table.get("name") or path.stem)})
    except ValueError as error:
        raise ValueError(f"{path}: {' '.join(str(error).split())}") from error


def write(path: str | Path, sensor: Sensor) -> None:
    """Writes a sensor to a `.json` or `.npz` file; one of that name is replaced once the new one is complete.

    Raises:
        ValueError: If the suffix is another.
    """
    path = Path(path)
    check_suffix(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = {key: np.array(value) for key, value in sensor.table().items()}
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        if path.suffix.lower() == ".json":
            partial.write_text(json.dumps(sensor.table()) + "\n")
        else:
            with partial.open("xb") as file:
                np.savez_compressed(file, **arrays)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _json(path: Path) -> dict[str, Any]:
    if path.stat().st_size > _MOST_BYTES:
        raise ValueError(f"it has {path.stat().st_size} bytes; a table of angles has at most {_MOST_BYTES}")
    try:
        table = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"it is not JSON: {str(error)[:200]}") from None
    if not isinstance(table, dict):
        raise ValueError(f"it holds a {type(table).__name__}; it should hold an object with the key elevation_deg")
    return table


def _npz(path: Path) -> dict[str, Any]:
    table: dict[str, Any] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            sizes = {info.filename: info.file_size for info in archive.infolist()}
            for key in _KEYS:
                if (member := f"{key}.npy") in sizes:
                    if sizes[member] > _MOST_BYTES:
                        raise ValueError(f"{key} has {sizes[member]} bytes; it should have at most {_MOST_BYTES}")
                    with archive.open(member) as file:
                        array = np.lib.format.read_array(file, allow_pickle=False)
                        table[key] = array.item() if array.shape == () else array
    except Exception as error:  # zipfile, zlib and numpy raise many kinds on damaged archives
        raise ValueError(f"it cannot be unpacked: {str(error)[:200]}") from error
    return table
