""".npy: one array, ranges or points."""

from pathlib import Path

import numpy as np

from ilnet.scan import Scan, real_tensor
from ilnet.scan_files.points import known
from ilnet.sensor import Sensor

__all__ = ["read"]


def read(path: Path, sensor: Sensor | None) -> Scan:
    """Returns the scan in a file; raises a ValueError that continues "path: "."""
    sensor = known(sensor)
    try:
        with path.open("rb") as file:
            array = np.lib.format.read_array(file, allow_pickle=False)
    except Exception as error:  # numpy raises many kinds on damaged files
        raise ValueError(f"it is not a whole .npy file of numbers: {error}") from error
    if array.shape == sensor.shape:
        return Scan(real_tensor("ranges", array), sensor)
    if array.ndim == 2 and 3 <= array.shape[1] <= 8:
        return Scan.from_points(array, sensor)
    raise ValueError(f"its shape {array.shape} is neither ranges of {sensor} nor points (N, 3) to (N, 8)")
