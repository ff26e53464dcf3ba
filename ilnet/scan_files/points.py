"""What readers and writers of points share: from the fields of points to a scan, and back."""

from collections.abc import Mapping
from typing import BinaryIO

import numpy as np
import torch

from ilnet.scan import OF_RETURNS, Scan, real_tensor
from ilnet.sensor import Sensor

__all__ = [
    "XYZ",
    "Field",
    "UnknownSensor",
    "check_size",
    "from_columns",
    "from_records",
    "from_text",
    "header_lines",
    "images_of",
    "known",
    "numbered",
    "of_returns",
    "point_rows",
]

XYZ = ("x", "y", "z")
# The intensity of a perfect reflector: as a share, in 8 bits, in 16 bits.
_WHOLES = (1.0, 255.0, 65535.0)
# A field of a point: its name, its numpy type, its number of values.
Field = tuple[str, np.dtype, int]


class UnknownSensor(ValueError):
    """A file does not hold the angles of its rays, and no sensor was named; the cause of the error of `read`."""


def known(sensor: Sensor | None) -> Sensor:
    """Returns the sensor, or raises an `UnknownSensor` if it is None."""
    if sensor is None:
        raise UnknownSensor(
            "it does not hold the angles of its rays; name the sensor that measured it, such as the preset os1-128"
        )
    return sensor


def header_lines(file: BinaryIO, last: str) -> list[list[str]]:
    """Returns the words of each line up to the one that starts with `last`."""
    lines = []
    while line := file.readline(4096):
        words = line.decode("ascii", "replace").split()
        if words:
            lines.append(words)
            if words[0] == last:
                return lines
    raise ValueError(f"its header has no line {last!r}: it was cut short or is of another kind")


def of_returns(arrays: Mapping[str, np.ndarray]) -> dict[str, torch.Tensor]:
    """Returns intensity, confidence and time as a scan takes them, as far as a file has them."""
    found = {name: real_tensor(name, arrays[name]) for name in OF_RETURNS if name in arrays}
    if "intensity" in found:
        intensity = found["intensity"]
        largest = intensity.where(intensity.isfinite(), 0.0).max().item() if intensity.numel() else 0.0
        found["intensity"] = intensity / next((whole for whole in _WHOLES if largest <= whole), largest)
    if "time" in found and found["time"].numel():
        found["time"] = found["time"] - found["time"].min().clamp(max=0)
    return found


def from_columns(columns: Mapping[str, np.ndarray], sensor: Sensor) -> Scan:
    """Returns the scan of points whose fields are given, each (N,)."""
    with np.errstate(invalid="ignore"):  # no warning about a signalling NaN: such points are dropped
        points = np.stack([columns[axis] for axis in XYZ], axis=1, dtype=np.float64)
        return Scan.from_points(points, sensor, **of_returns(columns))


def numbered(fields: list[Field]) -> dict[str, int]:
    """Returns the numbers of the fields that are read: x, y and z, and what else a scan keeps."""
    names = [name for name, _, _ in fields]
    if not {*XYZ} <= set(names):
        raise ValueError(f"its fields are {', '.join(names) or 'none'}; x, y and z should be among them")
    return {name: names.index(name) for name in (*XYZ, *OF_RETURNS) if name in names}


def check_size(body: bytes, need: int, count: int) -> None:
    """Raises a ValueError if there are no points, or fewer bytes than they take."""
    if count < 1:
        raise ValueError("it holds no points")
    if len(body) < need:
        raise ValueError(f"it was cut short: {count} points take {need} bytes, {len(body)} are there")


def from_text(body: bytes, fields: list[Field], count: int) -> dict[str, np.ndarray]:
    """Unpacks points of one line each."""
    check_size(body, 0, count)
    starts = np.cumsum([0, *(size for _, _, size in fields)])
    lines = [line for line in body.decode("ascii", "replace").splitlines() if line.strip()]
    if len(lines) < count:
        raise ValueError(f"it was cut short: its header promises {count} points, {len(lines)} are there")
    numbers = numbered(fields)
    columns = np.loadtxt(lines[:count], usecols=[starts[i] for i in numbers.values()], ndmin=2)
    return dict(zip(numbers, columns.T, strict=True))


def from_records(body: bytes, fields: list[Field], count: int) -> dict[str, np.ndarray]:
    """Unpacks points stored one after the other."""
    # Numbered, since names may repeat: PCL pads with fields that are all called "_".
    record = np.dtype([(str(i), kind, (size,)) for i, (_, kind, size) in enumerate(fields)])
    check_size(body, count * record.itemsize, count)
    records = np.frombuffer(body, record, count)
    return {name: records[str(i)][:, 0] for name, i in numbered(fields).items()}


def images_of(scan: Scan) -> dict[str, torch.Tensor]:
    """Returns intensity, confidence and time, as far as the scan has them."""
    return {name: image for name in OF_RETURNS if (image := getattr(scan, name)) is not None}


def point_rows(scan: Scan, **images: torch.Tensor) -> tuple[list[str], np.ndarray]:
    """Returns the names of a point's fields, and the points (N, fields): x, y, z, `images`, and what the scan keeps."""
    images |= images_of(scan)
    measured = scan.ranges > 0
    rows = torch.cat((scan.points(), *(image[measured, None] for image in images.values())), dim=1)
    return [*XYZ, *images], rows.cpu().numpy().astype("<f4")
