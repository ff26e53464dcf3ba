"""Points with named fields: from those of a file to a scan, and back."""

import itertools
import logging
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import BinaryIO

import numpy as np
import torch

from ilnet import fit, memory
from ilnet.scan import Scan
from ilnet.sensor import Sensor

__all__ = [
    "XYZ",
    "Field",
    "Points",
    "UnknownSensor",
    "check_count",
    "columns_of",
    "fraction",
    "from_records",
    "from_text",
    "header_lines",
    "known",
    "note",
    "numbered",
    "real",
    "records_of",
    "scan_of",
    "seconds",
    "standard",
    "text_lines",
    "unit_of",
]

XYZ = ("x", "y", "z")
# What a scan keeps of a point, and how files call it, in lower case; the first name found counts.
_NAMES = {
    **{axis: (axis,) for axis in XYZ},
    "intensity": ("intensity", "reflectivity", "reflectance", "scalar_intensity"),
    "ring": ("ring", "channel", "scalar_ring"),
    "time": ("t", "time", "timestamp", "time_stamp", "timestamp_ns", "offset_time", "gps_time"),
    "confidence": ("confidence",),
}
# About how much memory a point takes until it is in a scan [bytes].
_PER_POINT = 200
# The intensity of a perfect reflector: as a share, in 8 bits, in 16 bits.
_WHOLES = (1.0, 255.0, 65535.0)
# A scan lasts at most so many seconds.
_LONGEST = 2.0
# A range in millimetres is at least this [m]: by then those in metres are beyond what a LiDAR measures.
_NEAREST_MILLIMETRES = 0.3
# The least share of the returns within the sensor's limits if the unit is right.
_LEAST_WITHIN = 0.01
# A sensor is judged by about so many points, until it is doubted.
_JUDGED = 50_000
_doubted: set[str] = set()
# A header has at most so many bytes.
_LONGEST_HEADER = 1 << 20

# A field of a point: its name, its numpy type, its number of values.
Field = tuple[str, np.dtype, int]
# Points, by the standard name of the field: each (N,), of any number type.
Points = dict[str, np.ndarray]


class UnknownSensor(ValueError):
    """A file does not hold the angles of its rays, and no sensor was named; the cause of the error of `read`."""


def known(sensor: Sensor | None) -> Sensor:
    """Returns the sensor, or raises an `UnknownSensor` if it is None."""
    if sensor is None:
        raise UnknownSensor(
            "it does not hold the angles of its rays; name the sensor that measured it, such as the preset os1-128"
        )
    return sensor


def note(source: str, text: str) -> None:
    """Says in one line how something was read; on stderr, unless the logger `ilnet` is told otherwise."""
    logging.getLogger("ilnet").warning("%s: %s", source, text)


def standard(names: Iterable[str]) -> dict[str, str]:
    """Returns the file's own name of each standard field that it has: x, y, z, intensity, ring, time, confidence.

    Raises:
        ValueError: If x, y or z is missing.
    """
    own: dict[str, str] = {}
    for name in names:
        own.setdefault(name.lower(), name)
    found = {ours: own[name] for ours, theirs in _NAMES.items() for name in reversed(theirs) if name in own}
    if not {*XYZ} <= found.keys():
        raise ValueError(f"its fields are {', '.join(own.values()) or 'none'}; x, y and z should be among them")
    return found


def scan_of(points: Mapping[str, np.ndarray], sensor: Sensor, source: str = "points") -> Scan:
    """Returns the scan of points whose fields have standard names.

    Metres or millimetres, the scale of the intensity and the unit of the time are told by their size. The ring, where
    there is one, decides the row.

    Args:
        points: x, y, z and perhaps intensity, ring, time and confidence, each (N,). Others are ignored.
        sensor: The sensor that measured them.
        source: What they are called in notes.

    Raises:
        ValueError: If none is in view, or their unit cannot be told.
    """
    with np.errstate(all="ignore"):  # points that are not finite are dropped
        xyz = np.stack([real(axis, points[axis]) for axis in XYZ], axis=1)
        distance = np.sqrt(np.einsum("ij,ij->i", xyz, xyz))
        usable = np.isfinite(distance) & (distance > 0)
        xyz *= unit_of(distance[usable], sensor, source)
        rows = _rows(points["ring"], xyz, usable, sensor, source) if "ring" in points else None
        others: dict[str, np.ndarray] = {}
        if "intensity" in points:
            others["intensity"] = fraction(points["intensity"], usable)
        if "time" in points and (time := seconds(points["time"], source)) is not None:
            others["time"] = time
        if "confidence" in points:
            others["confidence"] = real("confidence", points["confidence"])
    scan = Scan.from_points(xyz, sensor, **others, rows=rows)
    if rows is None:  # by their numbers, rows need no angles
        _doubt(sensor, xyz[usable], int((scan.ranges > 0).sum()), source)
    return scan


def _doubt(sensor: Sensor, xyz: np.ndarray, returns: int, source: str) -> None:
    """Notes, once for each sensor, if it is likely not the one that measured points (N, 3) [m] that became returns."""
    known_as = f"{sensor.name} {sensor.size}"
    if known_as in _doubted:
        return
    distance = np.sqrt(np.einsum("ij,ij->i", xyz, xyz))
    elevation = np.arcsin(np.clip(xyz[:, 2] / distance, -1, 1))
    # Of points in view, which are all that can share a pixel.
    seen = np.count_nonzero((elevation >= sensor.elevations.min()) & (elevation <= sensor.elevations.max()))
    lost = 1 - returns / seen if sensor.wrap and seen else 0.0
    step = len(xyz) // _JUDGED + 1
    if doubt := fit.doubt(sensor, elevation[::step], distance[::step], lost):
        _doubted.add(known_as)
        note(source, f"{doubt} `ilnet sensor estimate` finds the rows of the points")


def columns_of(scan: Scan) -> Points:
    """Returns the returns of a scan as points, row by row, under the names and in the types that others expect.

    Those are x, y, z [m], float32; `ring`, its row, uint16; where the scan has them `intensity` and `confidence` from 0
    to 1, float32, and `t`, nanoseconds since the first return, uint32.

    Raises:
        ValueError: If a time is beyond 4.29 s, the largest that such nanoseconds hold.
    """
    measured = scan.ranges > 0
    found = dict(zip(XYZ, scan.points().cpu().numpy().astype("<f4").T, strict=True))
    if scan.intensity is not None:
        found["intensity"] = scan.intensity[measured].cpu().numpy().astype("<f4")
    rows = torch.arange(scan.sensor.shape[0], device=measured.device)
    found["ring"] = rows[:, None].expand(measured.shape)[measured].cpu().numpy().astype("<u2")
    if scan.time is not None:
        time = (scan.time[measured].cpu().double().numpy() * 1e9).round()
        if time.size and time.max() >= 2**32:
            raise ValueError(f"time reaches {time.max() / 1e9:g} s; it should be below 4.29 s, as that of one turn")
        found["t"] = time.astype("<u4")
    if scan.confidence is not None:
        found["confidence"] = scan.confidence[measured].cpu().numpy().astype("<f4")
    return found


def records_of(columns: Points) -> np.ndarray:
    """Returns points as one array of records, (N,)."""
    records = np.empty(len(columns["x"]), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        records[name] = column
    return records


def unit_of(ranges: np.ndarray, sensor: Sensor, source: str) -> float:
    """Returns the metres of a unit of ranges, 1 or 0.001, as their size tells it, and notes millimetres.

    Args:
        ranges: (N,) of returns, positive.
        sensor: The sensor that measured them; most returns are within its limits if the unit is right.
        source: What they are called in notes.

    Raises:
        ValueError: If they fit neither.
    """
    if not len(ranges):
        return 1.0
    metres = float(np.mean((ranges >= sensor.min_range) & (ranges <= sensor.max_range)))
    least = max(sensor.min_range, _NEAREST_MILLIMETRES)
    millimetres = float(np.mean((ranges >= 1e3 * least) & (ranges <= 1e3 * sensor.max_range)))
    median = float(np.median(ranges))
    if max(metres, millimetres) < _LEAST_WITHIN:
        raise ValueError(
            f"its ranges, {median:g} in the median, are neither metres nor millimetres of a sensor that measures "
            f"{sensor.min_range:g} to {sensor.max_range:g} m; convert them to metres, or give the limits of the sensor"
        )
    if metres >= min(millimetres, 0.5):
        return 1.0
    note(source, f"ranges are taken as millimetres: their median is {median / 1e3:.3g} m")
    return 1e-3


def fraction(intensity: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Returns intensities of any scale as float64 from 0 to 1.

    Integers are of 8 or 16 bits and floats perhaps shares, as far as they fit; others are scaled by their own range.

    Args:
        intensity: Of any shape; a value that is not finite counts as 0.
        measured: Of the same shape, True where there was a return; others become 0 and do not set the scale.
    """
    values = real("intensity", intensity)
    values = np.where(np.isfinite(values) & measured, values, 0.0)
    lowest, largest = (values.min(), values.max()) if values.size else (0.0, 0.0)
    if lowest < 0:
        return np.where(measured, (values - lowest) / (largest - lowest), 0.0)
    wholes = _WHOLES[1:] if intensity.dtype.kind in "iu" else _WHOLES
    return values / next((whole for whole in wholes if largest <= whole), largest)


def seconds(time: np.ndarray, source: str) -> np.ndarray | None:
    """Returns times [s] since the first, of any clock that counts seconds to nanoseconds.

    None if all are the same or, with a note, if they fit no such unit.

    Args:
        time: Of any shape; a value that is not finite counts as the first.
        source: What they are called in notes.
    """
    if not time.size:
        return None
    # Integers are subtracted as such: as floats, those of a clock since 1970 are exact to a microsecond only.
    values = time if time.dtype.kind in "iu" else np.where(np.isfinite(real("time", time)), time, np.inf)
    since = real("time", values - values.min())
    since = np.where(np.isfinite(since), since, 0.0)
    longest = since.max()
    if longest == 0:  # nobody set them
        return None
    for unit in (1.0, 1e-3, 1e-6, 1e-9):
        if longest * unit <= _LONGEST:
            return since * unit
    note(source, f"its times are left out: they span {longest:g}, which are no seconds to nanoseconds of one turn")
    return None


def real(name: str, values: np.ndarray) -> np.ndarray:
    """Returns a float64 copy of numbers."""
    if values.dtype.kind not in "fiu":
        raise ValueError(f"{name} is of dtype {values.dtype}; it should hold real numbers")
    return values.astype(np.float64)


def _rows(ring: np.ndarray, xyz: np.ndarray, usable: np.ndarray, sensor: Sensor, source: str) -> np.ndarray | None:
    """Returns the row (N,) of each point by the number of its beam, whatever beam has number 0; None if that is vain.

    Beams are ordered by the median elevation of their points. Where some are missing, each gets the nearest row.
    """
    height = sensor.shape[0]
    beams, of = np.unique(real("ring", ring)[usable], return_inverse=True)
    if len(beams) < 2:
        return None
    elevation = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))[usable]
    order = np.argsort(of, kind="stable")
    parts = np.split(elevation[order], np.cumsum(np.bincount(of))[:-1]) if len(beams) <= height else []
    median = np.array([np.median(part) for part in parts])
    table = sensor.elevations
    row = np.empty(0, np.int64)
    if len(beams) == height:
        row = np.argsort(np.argsort(median if table[-1] > table[0] else -median))
    elif parts:
        row = np.abs(median[:, None] - table).argmin(axis=1)
    spread = np.median(np.abs(elevation - median[of])) if parts else math.inf
    if len(np.unique(row)) < len(beams) or spread > np.median(np.abs(np.diff(table))):
        note(source, f"its ring has {len(beams)} numbers that are not beams of {sensor}: rows go by elevation")
        return None
    rows = np.zeros(len(ring), np.int64)
    rows[usable] = row[of]
    return rows


# What readers of fields share.


def header_lines(file: BinaryIO, last: str) -> list[list[str]]:
    """Returns the words of each line up to the one that starts with `last`."""
    lines: list[list[str]] = []
    while file.tell() < _LONGEST_HEADER and (line := file.readline(4096)):
        words = line.decode("ascii", "replace").split()
        if words:
            lines.append(words)
            if words[0] == last:
                return lines
    raise ValueError(f"its header has no line {last!r}: it was cut short or is of another kind")


def numbered(fields: list[Field]) -> dict[str, int]:
    """Returns the numbers of the fields that are read, by their standard names."""
    names = [name for name, _, _ in fields]
    return {ours: names.index(name) for ours, name in standard(names).items()}


def check_count(count: int, least: int, there: int) -> None:
    """Raises a ValueError if there are no points, fewer bytes than they take, or too many for the memory.

    Args:
        count: How many there should be.
        least: The fewest bytes that one takes.
        there: How many bytes there are.
    """
    if count < 1:
        raise ValueError("it holds no points")
    if there < count * least:
        raise ValueError(f"it was cut short: {count} points take {count * least} bytes, {there} are there")
    memory.check(f"its {count} points", count * _PER_POINT)


def from_text(lines: Iterator[str], fields: list[Field], count: int) -> Points:
    """Unpacks points of one line each."""
    starts = np.cumsum([0, *(size for _, _, size in fields)])
    numbers = numbered(fields)
    rows = np.empty((0, len(numbers)))
    if (first := next(lines, None)) is not None:  # of no lines loadtxt would warn
        promised = itertools.islice(itertools.chain([first], lines), count)
        rows = np.loadtxt(promised, usecols=[starts[i] for i in numbers.values()], ndmin=2, comments=None)
    if len(rows) < count:
        raise ValueError(f"it was cut short: its header promises {count} points, {len(rows)} are there")
    return dict(zip(numbers, rows.T, strict=True))


def text_lines(file: BinaryIO) -> Iterator[str]:
    """Yields the lines that are not empty."""
    return (text for line in file if (text := line.decode("ascii", "replace")).strip())


def from_records(file: BinaryIO, fields: list[Field], count: int) -> Points:
    """Unpacks points stored one after the other, of which all bytes are there."""
    # Numbered, since names may repeat: PCL pads with fields that are all called "_".
    record = np.dtype([(str(i), kind, (size,)) for i, (_, kind, size) in enumerate(fields)])
    records = np.frombuffer(file.read(count * record.itemsize), record, count)
    return {name: records[str(i)][:, 0] for name, i in numbered(fields).items()}
