""".bin: float32 points without a header, as KITTI and nuScenes have them.

Nothing in such a file says how many columns it has. Under the right number, each column has a distribution of its own;
under a wrong one all are mixtures. So the number is chosen whose columns tell the most about the values, as far as
three of them are plausible coordinates.
"""

from pathlib import Path
from typing import BinaryIO

import numpy as np

from ilnet import memory
from ilnet.scan import Scan
from ilnet.scan_files.points import XYZ, Points, columns_of, known, note, scan_of
from ilnet.sensor import PRESETS, Sensor, preset

__all__ = ["COLUMNS", "read", "read_points", "write"]

COLUMNS = (4, 5, 3, 6)
"""The numbers of columns that are tried, the most usual first."""

# A value of points takes about so much memory until it is in a scan [bytes].
_PER_VALUE = 50
# A coordinate is at most this, in metres or millimetres; the median distance is at least that.
_FARTHEST, _NEAREST = 1e6, 0.1
# At least this share of the points is plausible.
_PLAUSIBLE = 0.99
# Values are compared by their quantiles, so many of them, of at most so many values (a multiple of all numbers).
_BINS, _SAMPLE = 16, 120_000
# The largest number of a beam.
_RINGS = 256


def read(path: Path, sensor: Sensor | None, columns: int | None = None) -> Scan:
    """Returns the scan in a file; raises a ValueError that continues "path: ".

    Args:
        path: The file.
        sensor: The sensor that measured it; by default KITTI's or, by the ring, nuScenes'.
        columns: The number of columns of its points; None tells it by the values.
    """
    points = read_points(path, columns)
    if sensor is None:
        # KITTI's sensor has no ring in its files, nuScenes' has rings 0 to 31.
        beams = points["ring"].max() + 1 if "ring" in points else 64
        if "hdl-32e" in PRESETS and beams == 32:
            note(str(path), "its 32 rings are taken for those of nuScenes' sensor, the preset hdl-32e")
            sensor = preset("hdl-32e")
        else:
            sensor = preset("hdl-64e") if beams == 64 else known(None)
    return scan_of(points, sensor, str(path))


def read_points(path: Path, columns: int | None = None) -> Points:
    """Returns the points in a file, in its order: x, y, z, and as far as there are columns intensity, ring and time.

    Raises:
        OSError: If the file cannot be read.
        ValueError: If it holds anything else; the message continues "path: ".
    """
    size = path.stat().st_size
    memory.check("it", size // 4 * _PER_VALUE)
    tried = COLUMNS if columns is None else (columns,)
    if columns is not None and columns not in COLUMNS:
        raise ValueError(f"the number of columns is {columns}; it should be 3 to 6")
    if not size or not any(size % (4 * number) == 0 for number in tried):
        wanted = "3 to 6" if columns is None else columns
        raise ValueError(f"its {size} bytes are not whole points of {wanted} float32")
    values = np.fromfile(path, "<f4")
    if columns is None:
        columns = _number_of_columns(values)
    table = values.reshape(-1, columns).T
    found = dict(zip((*XYZ, "intensity"), table, strict=False))
    # The ring is a small whole number; what else follows the intensity is a time.
    for column in table[4:]:
        whole = np.isfinite(column).all() and (column == np.floor(column)).all()
        name = "ring" if whole and column.min() >= 0 and column.max() < _RINGS else "time"
        found.setdefault(name, column)
    return found


def _number_of_columns(values: np.ndarray) -> int:
    """Returns how many columns points of these float32 values have."""
    with np.errstate(all="ignore"):
        plausible = [number for number in COLUMNS if len(values) % number == 0 and _is_plausible(values, number)]
        if not plausible:
            raise ValueError(
                "read as float32 points of 3 to 6 columns, it holds no plausible coordinates; it should hold x, y, z "
                "and perhaps intensity, ring and time, or the number of its columns be given"
            )
        sample = values[:_SAMPLE]
        edges = np.quantile(sample[np.isfinite(sample)], np.linspace(0, 1, _BINS + 1)[1:-1])
        bins = np.searchsorted(edges, sample, side="right")
        return max(plausible, key=lambda number: _information(bins, number))


def _is_plausible(values: np.ndarray, number: int) -> bool:
    xyz = values.reshape(-1, number)[:, :3].astype(np.float64)
    distance = np.sqrt((xyz**2).sum(axis=1))
    distance = distance[distance > 0] if (distance > 0).any() else distance
    return bool(np.mean(distance < _FARTHEST) >= _PLAUSIBLE and np.median(distance) >= _NEAREST)


def _information(bins: np.ndarray, number: int) -> float:
    """Returns how much the columns tell about the values [nats]; their number costs as in Schwarz's criterion."""
    counts = np.zeros((number, _BINS))
    for column in range(number):
        counts[column] = np.bincount(bins[column::number], minlength=_BINS)
    expected = counts.sum(axis=1, keepdims=True) * counts.sum(axis=0) / counts.sum()
    told = (counts * np.log(np.where(counts > 0, counts, 1) / np.where(expected > 0, expected, 1))).sum()
    return float(told - (number - 1) * (_BINS - 1) / 2 * np.log(len(bins)))


def write(file: BinaryIO, scan: Scan) -> None:
    """Writes a scan to an open file: x, y, z, intensity as KITTI; then ring and time [s] if the scan has times."""
    points = columns_of(scan)
    rows = [points[axis] for axis in XYZ]
    rows.append(points.get("intensity", np.zeros_like(rows[0])))
    if "t" in points:
        rows += [points["ring"], points["t"] * 1e-9]
    file.write(np.stack(rows, axis=1).astype("<f4").tobytes())
