""".bin: KITTI"s float32 points."""

from pathlib import Path

import numpy as np

from ilnet.scan import Scan
from ilnet.scan_files.points import XYZ, from_columns
from ilnet.sensor import Sensor, preset

__all__ = ["kitti_points", "read"]


def read(path: Path, sensor: Sensor | None) -> Scan:
    """Returns the scan in a file; raises a ValueError that continues "path: "."""
    columns = kitti_points(path).T
    return from_columns(dict(zip((*XYZ, "intensity"), columns, strict=True)), sensor or preset("hdl-64e"))


def kitti_points(path: Path) -> np.ndarray:
    """Returns the points in a `.bin` file of KITTI, in its order: (N, 4) float32, x, y, z [m] and intensity.

    Raises:
        OSError: If the file cannot be read.
        ValueError: If it holds anything else; the message continues "path: ".
    """
    data = path.read_bytes()
    if not data or len(data) % 16:
        raise ValueError(f"its {len(data)} bytes are not whole KITTI points of 16 bytes (float32 x, y, z, intensity)")
    return np.frombuffer(data, "<f4").reshape(-1, 4)
