"""Data packets of Ouster sensors, to scans. The layouts are those of Ouster's firmware manuals.

Ouster's own `ouster-sdk` cannot be installed beside this project: its version 1.0.1 asks for click below 8.1.8 and for
one old version of rosbags. Its packets are read here alike; a test compares the two where it is there.
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from ilnet.scan import Scan
from ilnet.sensor import Sensor, preset

__all__ = ["Layout", "Metadata", "columns_of", "scan_of"]


class Layout(NamedTuple):
    """How a profile stores a packet. Sizes and places are in bytes.

    Args:
        head: Size of the packet's header.
        column: Size of a column's header.
        status: Place of the status in a column's header; below 0, from the end of the column.
        tail: Size of a column's footer.
        pixel: Size of a pixel.
        bits: Bits of the range, which are the lowest ones at the start of a pixel.
        unit: Unit of the range [m].
        reflectivity: Place of the reflectivity in a pixel, a byte.
    """

    head: int
    column: int
    status: int
    tail: int
    pixel: int
    bits: int
    unit: float
    reflectivity: int


# A second return of a pixel is left out.
_LAYOUTS = {
    "LEGACY": Layout(0, 16, -4, 4, 12, 20, 0.001, 4),
    "RNG19_RFL8_SIG16_NIR16": Layout(32, 12, 10, 0, 12, 19, 0.001, 4),
    "RNG19_RFL8_SIG16_NIR16_DUAL": Layout(32, 12, 10, 0, 16, 19, 0.001, 3),
    "RNG15_RFL8_NIR8": Layout(32, 12, 10, 0, 4, 15, 0.008, 2),
}
# LEGACY's status of a column that is whole.
_WHOLE = 0xFFFFFFFF
# The preset that has the range limits of a product line.
_LIMITS = {"OS-0": "os0-128", "OS-1": "os1-128", "OS-2": "os2-128"}


class Metadata:
    """What a sensor's metadata file (JSON) says: its beams and how its packets are stored.

    Args:
        path: The file, as Ouster's tools write it beside a capture.

    Raises:
        OSError: If it cannot be read.
        ValueError: If it is no metadata file, or the packets are of a profile that is not read.
    """

    def __init__(self, path: Path):
        try:
            found = _flat(json.loads(path.read_text()))
            elevations = np.array(found["beam_altitude_angles"], np.float64)
            offsets = np.array(found["beam_azimuth_angles"], np.float64)
            mode = str(found.get("lidar_mode", "1024x10"))
            self.columns = int(found.get("columns_per_frame", mode.partition("x")[0]))
            self.columns_per_packet = int(found.get("columns_per_packet", 16))
            profile = str(found.get("udp_profile_lidar", "LEGACY"))
            line = str(found.get("prod_line", "OS-1"))
            shift = 360 / self.columns
            shifts = found.get("pixel_shift_by_row", np.round(offsets / shift))
            self.shifts = np.array(shifts, np.int64)
            if not 0 < len(elevations) == len(offsets) == len(self.shifts) <= 1024:
                raise ValueError("its tables of beams differ in length")
            if not (0 < self.columns <= 65536 and 0 < self.columns_per_packet <= self.columns):
                raise ValueError(f"it has {self.columns} columns")
        except OSError:
            raise
        except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
            text = " ".join(f"{type(error).__name__} {error}".split())[:200]
            raise ValueError(f"{path}: it is not the metadata file (JSON) of an Ouster sensor: {text}") from error
        if profile not in _LAYOUTS:
            raise ValueError(f"{path}: its profile is {profile!r}; it should be one of {', '.join(_LAYOUTS)}")
        self.layout = _LAYOUTS[profile]
        rows = len(elevations)
        limits = preset(_LIMITS.get(line[:4], "os1-128"))
        # Column 0 looks back, and azimuths fall. A row's beams are turned by its offset, less the shift of its pixels.
        first = 180 + float((self.shifts * shift - offsets).mean())
        self.sensor = Sensor(
            np.deg2rad(elevations),
            np.deg2rad(first - shift * np.arange(self.columns)),
            limits.min_range,
            limits.max_range,
            limits.norm_range,
            name=line.lower(),
        )
        layout = self.layout
        self.column_size = layout.column + rows * layout.pixel + layout.tail
        self.packet_size = layout.head + self.columns_per_packet * self.column_size + layout.head  # as long a footer


class Columns(NamedTuple):
    """The columns of a packet that are whole: frame, number and time [ns] of each, (C,), and their pixels (C, H)."""

    frames: np.ndarray
    numbers: np.ndarray
    times: np.ndarray
    ranges: np.ndarray  # [m]
    reflectivity: np.ndarray


def columns_of(packet: bytes, metadata: Metadata) -> Columns:
    """Returns the columns of a packet of `metadata.packet_size` bytes."""
    layout, rows = metadata.layout, len(metadata.shifts)
    count, size = metadata.columns_per_packet, metadata.column_size
    block = np.frombuffer(packet, np.uint8, count * size, layout.head).reshape(count, size)

    def field(place: int, kind: str) -> np.ndarray:
        return np.ascontiguousarray(block[:, place : place + np.dtype(kind).itemsize]).view(kind)[:, 0]

    legacy = layout.head == 0
    if legacy:
        frames, whole = field(10, "<u2"), field(size + layout.status, "<u4") == _WHOLE
    else:
        frames = np.broadcast_to(np.frombuffer(packet, "<u2", 1, 2), count)
        whole = field(layout.status, "<u2") & 1 == 1
    numbers = field(8, "<u2")
    whole = whole & (numbers < metadata.columns)
    pixels = block[:, layout.column : layout.column + rows * layout.pixel].reshape(count, rows, layout.pixel)[whole]
    raw = np.ascontiguousarray(pixels[..., :4]).view("<u4")[..., 0] & ((1 << layout.bits) - 1)
    reflectivity = pixels[..., layout.reflectivity] / 255
    return Columns(
        frames[whole], numbers[whole].astype(np.int64), field(0, "<u8")[whole], raw * layout.unit, reflectivity
    )


def scan_of(columns: list[Columns], metadata: Metadata) -> Scan:
    """Returns the scan of the columns of a frame; `seen` is False where columns are missing."""
    shape = metadata.sensor.shape
    ranges, intensity, time = (torch.zeros(shape) for _ in range(3))
    seen = torch.zeros(shape, dtype=torch.bool)
    start = min(part.times.min() for part in columns)
    rows = np.arange(shape[0])[:, None]
    for part in columns:
        # Rows are staggered: the beams of a column look to different sides.
        at = rows, (part.numbers + metadata.shifts[:, None]) % shape[1]
        ranges.numpy()[at], intensity.numpy()[at], seen.numpy()[at] = part.ranges.T, part.reflectivity.T, True
        time.numpy()[at] = (part.times - start) * 1e-9
    return Scan(ranges, metadata.sensor, intensity, time=time, seen=seen)


def _flat(found: Any) -> dict[str, Any]:
    """Returns the entries of nested objects in one; files differ in how they nest them."""
    flat: dict[str, Any] = {}
    for key, value in dict(found).items():
        flat |= _flat(value) if isinstance(value, dict) else {key: value}
    return flat
