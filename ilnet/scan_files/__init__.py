"""Scans in files: the formats that are read and written.

A range of 0 means no return. Points are in the sensor frame, see `ilnet.sensor`.

`read` goes by the suffix:

- `.npz`: `range` (H, W), `elevation_deg` (H,) of the rows and `column_azimuth_deg` (W,) of the columns. Optional are
  `min_range`, `max_range` and `norm_range` [m], by default the paper's 2, 80 and 100; `name`; and `intensity` or
  `reflectivity`, `confidence`, `time` [s] and `seen` (H, W), or `timestamp_ns` (W,). Azimuths that differ from row to
  row, (H, W), are resampled to columns. A sensor given to `read` replaces the angles, the limits and the name.
- `.npy`: ranges (H, W) of the sensor's shape; or points (N, 3) to (N, 16), (3, N) or (H, W, 3 to 16) that start with x,
  y, z and perhaps intensity; or a structured array with such fields. Needs a sensor.
- `.bin`: float32 points as KITTI has them (x, y, z, intensity) or nuScenes (and ring), of 3 to 6 columns, told apart by
  their values. The sensor is `hdl-64e` by default, or that of nuScenes where there are its rings.
- `.ply`: vertices with x, y, z and perhaps other fields; ascii or binary. Needs a sensor.
- `.pcd`: points with x, y, z and perhaps other fields; ascii, binary or binary_compressed. Needs a sensor; VIEWPOINT is
  not applied.
- `.las`, `.laz`: points, with the extra `io`. Need a sensor.

The other fields of points are `intensity` (or `reflectivity`), `ring` (it decides the row), `t`, `time` or `timestamp`
(seconds to nanoseconds) and `confidence`; capitals do not matter.

Ranges and coordinates may be in metres or millimetres: in the right unit most returns are within the limits of the
sensor. No return is 0, NaN, an infinity or -1. An intensity beyond 1 is divided by 255; beyond 255, by 65535; and
beyond that, or where one is negative, it is scaled by the range in the file. Whatever is guessed is noted on stderr, by
the logger `ilnet`. What would take more memory than `ilnet.memory` allows is refused before it is read.

`write` makes `.npz`, which keeps all that a scan has; `.ply`, `.pcd` and `.laz`, with `intensity`, `ring`, `t` [ns] and
`confidence`; and `.bin`, with four columns as KITTI's or, where the scan has times, six with ring and time [s].
"""

import os
import secrets
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from ilnet.scan import Scan
from ilnet.scan_files import bin, las, npy, npz, pcd, ply
from ilnet.scan_files.points import Points, UnknownSensor, columns_of, known, scan_of
from ilnet.sensor import Sensor

try:
    import fcntl
except ImportError:  # Windows, where left-over files stay
    fcntl = None  # type: ignore[assignment]

__all__ = ["UnknownSensor", "columns_of", "listed", "read", "read_points", "remove_unfinished", "scan_of", "write"]

T = TypeVar("T")

# Error lines are cut to about so many characters.
_LONGEST_LINE = 400
# The end of the names of files that are being written.
_UNFINISHED = ".ilnet-partial"


def read(path: str | Path, sensor: Sensor | None = None, columns: int | None = None) -> Scan:
    """Returns the scan in a file; the list above says what each suffix holds. Nothing in a file is ever executed.

    Args:
        path: The file.
        sensor: The sensor that measured it; None where the file describes it.
        columns: How many columns the points of a `.bin` have, 3 to 6; None tells it by the values.

    Raises:
        OSError: If the file is missing, a folder, a device or unreadable.
        ValueError: If it is damaged, of another kind than its suffix says, or holds no return; if it does not hold
            the angles of its rays and `sensor` is None: then the cause is an `UnknownSensor`; or if it takes too much
            memory: then the cause is an `ilnet.memory.TooLarge`.
    """

    def scan(path: Path) -> Scan:
        suffix = path.suffix.lower()
        if suffix == ".bin":
            found = bin.read(path, sensor, columns)
        elif suffix in _IMAGES:
            found = _IMAGES[suffix](path, sensor)
        else:
            needed = known(sensor)
            found = scan_of(_POINTS[suffix](path), needed, str(path))
        if not (found.ranges > 0).any():
            raise ValueError("it holds no return: every range is 0")
        return found

    return _tried(scan, Path(path), (*_IMAGES, *_POINTS))


def read_points(path: str | Path, columns: int | None = None) -> Points:
    """Returns the points in a `.bin`, `.ply`, `.pcd`, `.las` or `.laz` file as they are, in their order.

    Args:
        path: The file.
        columns: As in `read`.

    Returns:
        x, y, z and, where the file has them, intensity, ring, time and confidence, each (N,) in the file's unit.

    Raises:
        OSError: As in `read`.
        ValueError: If it is damaged, or of another kind than its suffix says.
    """

    def points(path: Path) -> Points:
        suffix = path.suffix.lower()
        return bin.read_points(path, columns) if suffix == ".bin" else _POINTS[suffix](path)

    return _tried(points, Path(path), tuple(_POINTS))


def _tried(reader: Callable[[Path], T], path: Path, suffixes: tuple[str, ...]) -> T:
    """Returns what a reader makes of a file; its errors become one line that starts with the path."""
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder; it should be one of the files in it")
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: its suffix is {path.suffix!r}; it should be one of {', '.join(suffixes)}")
    if not path.is_file():  # a pipe would be waited for
        raise OSError(f"{path}: it is a pipe or a device; it should be a file")
    try:
        return reader(path)
    except MemoryError as error:
        raise ValueError(f"{path}: there is not enough memory to read it") from error
    except ValueError as error:
        line = " ".join(str(error).split())  # whatever a library wrote
        short = line if len(line) <= _LONGEST_LINE else f"{line[:_LONGEST_LINE]} ..."
        raise ValueError(f"{path}: {short}") from error


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
    """Writes a scan: to `.npz` as it is, to others its points.

    Folders are made as needed. A file of that name is replaced once the new one is complete.

    Args:
        path: The file; its suffix says the format.
        scan: What is written, with all of it that the format has a place for.

    Raises:
        ValueError: If the suffix is unknown, or a time is too large for the format.
    """
    path = Path(path)
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise ValueError(f"{path}: its suffix is {path.suffix!r}; it should be one of {', '.join(_WRITERS)}")
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{secrets.token_hex(8)}{_UNFINISHED}")
    try:
        with partial.open("xb") as file:
            if fcntl:
                fcntl.flock(file, fcntl.LOCK_EX)  # says that somebody is at it, until this process ends
            writer(file, scan)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def remove_unfinished(folder: Path) -> None:
    """Removes the files in a folder that writers left unfinished because they were killed."""
    if not fcntl:
        return
    for path in folder.glob(f".*{_UNFINISHED}"):
        try:
            with path.open("r+b") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                found = os.fstat(file.fileno())
                # An empty one may be about to be locked.
                if found.st_size or time.time() - found.st_mtime > 60:
                    path.unlink(missing_ok=True)
        except OSError:  # somebody is at it, or may remove it as well
            continue


_IMAGES = {".npz": npz.read, ".npy": npy.read}
_POINTS: dict[str, Callable[[Path], Points]] = {
    ".bin": bin.read_points,
    ".ply": ply.read_points,
    ".pcd": pcd.read_points,
    ".las": las.read_points,
    ".laz": las.read_points,
}
_WRITERS = {".npz": npz.write, ".ply": ply.write, ".pcd": pcd.write, ".bin": bin.write, ".laz": las.write}
