""".npz, the project"s own format: a range image and its angles."""

import zipfile
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from ilnet.scan import OF_RETURNS, Scan, real_tensor
from ilnet.scan_files.points import images_of, of_returns
from ilnet.sensor import Sensor

__all__ = ["read", "write"]


def read(path: Path, sensor: Sensor | None) -> Scan:
    """Returns the scan in a file; raises a ValueError that continues "path: "."""
    limits = ("min_range", "max_range", "norm_range", "name")
    if not zipfile.is_zipfile(path):
        raise ValueError("it is not a whole .npz archive: it was cut short or never was one")
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            found = list(file.files)
            wanted = ("range", "elevation_deg", "column_azimuth_deg", *OF_RETURNS, "seen", *limits)
            arrays = {key: file[key] for key in wanted if key in found}
    except Exception as error:  # zipfile, zlib and numpy raise many kinds on damaged archives
        raise ValueError(f"it cannot be unpacked: {error}") from error
    needed = ["range"] if sensor else ["range", "elevation_deg", "column_azimuth_deg"]
    missing = [key for key in needed if key not in arrays]
    if missing:
        remedy = ": add them or pass a sensor" if "range" in arrays else ""
        raise ValueError(f"it lacks {', '.join(missing)}; its keys are {', '.join(found) or 'none'}{remedy}")
    if sensor is None:
        elevations, azimuths = (real_tensor(key, arrays[key]).double().deg2rad().numpy() for key in needed[1:])
        sensor = Sensor(elevations, azimuths, **{key: arrays[key] for key in limits if key in arrays})
    seen = torch.from_numpy(arrays["seen"]) if "seen" in arrays else None
    return Scan(real_tensor("range", arrays["range"]), sensor, **of_returns(arrays), seen=seen)


def write(file: BinaryIO, scan: Scan) -> None:
    """Writes a scan to an open file."""
    sensor = scan.sensor
    arrays = dict(
        range=scan.ranges.cpu().numpy(),
        elevation_deg=np.rad2deg(sensor.elevations),
        column_azimuth_deg=np.rad2deg(sensor.azimuths),
        min_range=np.array(sensor.min_range),
        max_range=np.array(sensor.max_range),
        norm_range=np.array(sensor.norm_range),
        name=np.array(sensor.name),
    )
    images = images_of(scan) | ({} if scan.seen is None else {"seen": scan.seen})
    arrays |= {name: image.cpu().numpy() for name, image in images.items()}
    np.savez_compressed(file, **arrays)
