""".npy: one array, ranges or points."""

import math
from pathlib import Path

import numpy as np

from ilnet import memory
from ilnet.scan import Scan
from ilnet.scan_files import images, points
from ilnet.sensor import Sensor

__all__ = ["read"]

# How many columns an array of points may have, and how many of them are read: x, y, z and the intensity.
_COLUMNS = range(3, 17)
_READ = (*points.XYZ, "intensity")
# About how much memory a value takes until it is in a scan [bytes].
_PER_VALUE = 40


def read(path: Path, sensor: Sensor | None) -> Scan:
    """Returns the scan in a file; raises a ValueError that continues "path: "."""
    sensor = points.known(sensor)
    try:
        with path.open("rb") as file:
            major, _ = np.lib.format.read_magic(file)
            header = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
            shape, _, kind = header(file)
            there = path.stat().st_size - file.tell()
            if math.prod(shape) * kind.itemsize > there and not kind.hasobject:
                raise ValueError(f"its header promises more than the {there} bytes that are there")
            memory.check("it", there * _PER_VALUE // min(max(kind.itemsize, 1), 8))
            file.seek(0)
            array = np.lib.format.read_array(file, allow_pickle=False)
    except memory.TooLarge:
        raise
    except Exception as error:  # numpy raises many kinds on damaged files
        raise ValueError(f"it is not a whole .npy file of numbers: {error}") from error
    source = str(path)
    if array.dtype.names:
        fields = {ours: array[own].ravel() for ours, own in points.standard(array.dtype.names).items()}
        return points.scan_of(fields, sensor, source)
    if array.shape == sensor.shape:
        return images.scan_of({"range": array}, sensor, source)
    if array.ndim == 2 and len(array) == 3 < array.shape[1] and array.shape[1] not in _COLUMNS:
        array = array.T
    if array.ndim in (2, 3) and array.shape[-1] in _COLUMNS:
        columns = array.reshape(-1, array.shape[-1]).T
        fields = dict(zip(_READ, columns, strict=False))
        if array.shape[:2] == sensor.shape:  # the row of an image is that of a beam
            fields["ring"] = np.repeat(np.arange(len(array)), array.shape[1])
        return points.scan_of(fields, sensor, source)
    raise ValueError(
        f"its shape {array.shape} is neither ranges of {sensor} nor points (N, 3) to (N, 16), (3, N) or (H, W, 3)"
    )
