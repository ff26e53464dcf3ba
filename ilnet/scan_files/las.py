""".las and .laz, by laspy and lazrs (the extra `io`)."""

import io
import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ilnet.scan import Scan
from ilnet.scan_files.points import XYZ, Points, check_count, columns_of, standard

__all__ = ["read_points", "write"]

# Coordinates are written as multiples of this [m].
_STEP = 1e-5
# A packed chunk takes at least so many bytes, and a file has at most so many in its header and other records.
_LEAST_CHUNK, _LONGEST_HEADER = 8, 1 << 24


def read_points(path: Path) -> Points:
    """Returns the points in a file by their standard names; raises a ValueError that continues "path: "."""
    laspy = _laspy()
    _check(path)
    try:
        with laspy.open(path) as file:
            record = file.read()
            names = {"x": "x", "y": "y", "z": "z"} | {
                ours: own
                for ours, own in standard([*XYZ, *record.point_format.dimension_names]).items()
                if ours not in XYZ
            }
            found = {ours: np.array(record[own]) for ours, own in names.items()}
            if not found["intensity"].any():  # nobody set it
                del found["intensity"]
            return found
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # laspy raises many kinds on damaged files, and lazrs panics beside them all
        raise ValueError(f"it is not a whole LAS or LAZ file: {error}") from error


def _laspy() -> Any:
    try:
        import laspy  # type: ignore[import-untyped]
        import lazrs  # type: ignore[import-untyped]  # noqa: F401
    except ImportError as error:
        raise ValueError("it needs laspy, which is not installed: pip install 'ilnet[io]'") from error
    return laspy


def _check(path: Path) -> None:
    """Raises a ValueError unless a file can hold the points that its header promises.

    Source: ASPRS, "LAS specification 1.4 - R15", public header block; rapidlasso, "LASzip", chunk table.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        header = file.read(375)
        if header[:4] != b"LASF" or len(header) < 227:
            raise ValueError("it is not a whole LAS or LAZ file: its header is missing or cut short")
        offset, _, form, length, count = struct.unpack_from("<IIBHI", header, 96)
        start_of_extra, extra = 0, 0
        if header[25] >= 4 and len(header) == 375:
            start_of_extra, extra, large = struct.unpack_from("<QIQ", header, 235)
            count = max(count, large)
        is_packed = bool(form & 0x80)
        if offset > min(size, _LONGEST_HEADER) or (extra and start_of_extra > size):
            raise ValueError("it is not a whole LAS or LAZ file: its header points beyond its end")
        check_count(count, 0 if is_packed else length, size - offset)
        if is_packed:
            file.seek(offset)
            (table,) = struct.unpack("<q", file.read(8).ljust(8, b"\0"))
            if not offset < table <= size - 8:
                raise ValueError("it is not a whole LAS or LAZ file: its chunk table is missing")
            file.seek(table)
            _, chunks = struct.unpack("<II", file.read(8))
            if chunks > count or chunks * _LEAST_CHUNK > size:
                raise ValueError("it is not a whole LAS or LAZ file: its chunk table is damaged")


def write(file: BinaryIO, scan: Scan) -> None:
    """Writes a scan to an open file, packed; LAS has no ring, time since the first return or confidence of its own."""
    laspy = _laspy()
    columns = columns_of(scan)
    header = laspy.LasHeader(point_format=1, version="1.2")
    header.scales, header.offsets = np.full(3, _STEP), np.zeros(3)
    own = [name for name in columns if name not in (*XYZ, "intensity")]
    header.add_extra_dims([laspy.ExtraBytesParams(name, columns[name].dtype) for name in own])
    record = laspy.LasData(header)
    for axis in XYZ:
        record[axis] = columns[axis].astype(np.float64)
    if "intensity" in columns:
        record.intensity = (columns["intensity"] * 65535).round().astype(np.uint16)
    for name in own:
        record[name] = columns[name]
    if "t" in columns:
        record.gps_time = columns["t"] * 1e-9
    # laspy closes what it writes to.
    packed = io.BytesIO()
    record.write(packed, do_compress=True)
    file.write(packed.getbuffer())
