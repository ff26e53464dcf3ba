"""Scans in files: the formats that are read and written.

A range of 0 means no return. Points are in the sensor frame, see `ilnet.sensor`.

`read` goes by the suffix:

- `.npz`: `range` (H, W) [m], `elevation_deg` (H,) of the rows and `column_azimuth_deg` (W,) of the columns. Optional
  are `min_range`, `max_range` and `norm_range` [m], by default the paper's 2, 80 and 100; `name`; and `intensity`,
  `confidence`, `time` and `seen` (H, W). A sensor given to `read` replaces the angles, the limits and the name.
- `.npy`: ranges (H, W) of the sensor's shape, or points (N, 3) to (N, 8) that start with x, y, z. Needs a sensor.
- `.bin`: KITTI's float32 x, y, z, intensity. The sensor is `hdl-64e` by default.
- `.ply`: vertices with x, y, z, and perhaps `intensity`, `confidence` and `time`; ascii or binary. Needs a sensor.
- `.pcd`: points with x, y, z, and perhaps `intensity`, `confidence` and `time`; ascii, binary or binary_compressed.
  Needs a sensor; VIEWPOINT is not applied.

An intensity beyond 1 is divided by 255; beyond 255, by 65535; and beyond that, by the largest in the file.
Times are seconds, and count from the first if one is negative.

`write` makes `.npz`, `.ply` and `.pcd`, with intensity, confidence and time where the scan has them, and `.npz` with
`seen`.
"""

import os
import secrets
from pathlib import Path

from ilnet.scan import Scan
from ilnet.scan_files import bin, npy, npz, pcd, ply
from ilnet.scan_files.bin import kitti_points
from ilnet.scan_files.points import UnknownSensor
from ilnet.sensor import Sensor

__all__ = ["UnknownSensor", "kitti_points", "listed", "read", "write"]


def read(path: str | Path, sensor: Sensor | None = None) -> Scan:
    """Returns the scan in a file; the list above says what each suffix holds. Nothing in a file is ever executed.

    Args:
        path: The file.
        sensor: The sensor that measured it; None where the file describes it.

    Raises:
        OSError: If the file is missing, a folder or unreadable.
        ValueError: If it is damaged, of another kind than its suffix says, or holds no return; or if it does not hold
            the angles of its rays and `sensor` is None: then the cause is an `UnknownSensor`.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder; it should be one of the files in it")
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"{path}: its suffix is {path.suffix!r}; it should be one of {', '.join(_READERS)}")
    try:
        scan = reader(path, sensor)
        if not (scan.ranges > 0).any():
            raise ValueError("it holds no return: every range is 0")
    except ValueError as error:
        # One line, whatever a library wrote.
        raise ValueError(f"{path}: {' '.join(str(error).split())}") from error
    return scan


def listed(path: Path) -> list[Path]:
    """Returns the file that a path names or, for a folder, the files in it by name, without folders and hidden files.

    Raises:
        FileNotFoundError: If there is no such file or folder.
        ValueError: If there is no file in the folder.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file or folder")
    if not path.is_dir():
        return [path]
    paths = sorted(inside for inside in path.iterdir() if inside.is_file() and not inside.name.startswith("."))
    if not paths:
        raise ValueError(f"{path}: there is no file in this folder")
    return paths


def write(path: str | Path, scan: Scan) -> None:
    """Writes a scan: to `.npz` as it is, to `.ply` (binary, with the range) and `.pcd` (binary) its points.

    Folders are made as needed. A file of that name is replaced once the new one is complete.

    Args:
        path: The file; its suffix says the format.
        scan: What is written, with all that it has.

    Raises:
        ValueError: If the suffix is unknown.
    """
    path = Path(path)
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise ValueError(f"{path}: its suffix is {path.suffix!r}; it should be one of {', '.join(_WRITERS)}")
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with partial.open("xb") as file:
            writer(file, scan)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


# Readers return a scan or raise a ValueError that continues "path: ".
_READERS = {".npz": npz.read, ".npy": npy.read, ".bin": bin.read, ".ply": ply.read, ".pcd": pcd.read}
_WRITERS = {".npz": npz.write, ".ply": ply.write, ".pcd": pcd.write}
