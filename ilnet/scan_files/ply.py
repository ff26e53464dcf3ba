""".ply: points as vertices."""

from pathlib import Path
from typing import BinaryIO

import numpy as np

from ilnet.scan import Scan
from ilnet.scan_files.points import Field, from_columns, from_records, from_text, header_lines, known, point_rows
from ilnet.sensor import Sensor

__all__ = ["read", "write"]


def read(path: Path, sensor: Sensor | None) -> Scan:
    """Returns the scan in a file; raises a ValueError that continues "path: "."""
    sensor = known(sensor)
    with path.open("rb") as file:
        if file.readline(8).strip() != b"ply":
            raise ValueError("it is not a PLY file: its first line is not 'ply'")
        header, body = header_lines(file, "end_header"), file.read()
    kinds = dict(char="i1", uchar="u1", short="i2", ushort="u2", int="i4", uint="u4", float="f4", double="f8")
    kinds |= dict(int8="i1", uint8="u1", int16="i2", uint16="u2", int32="i4", uint32="u4", float32="f4", float64="f8")
    orders = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
    layout, count = "ascii", 0
    elements: list[str] = []
    fields: list[Field] = []
    for words in header:
        match words:
            case ["format", layout, *_]:
                if layout not in orders:
                    raise ValueError(f"its format is {layout!r}; it should be one of {', '.join(orders)}")
            case ["element", name, number]:
                elements.append(name)
                count = int(number) if name == "vertex" else count
            case ["property", kind, name] if elements == ["vertex"] and kind in kinds:
                fields.append((name, np.dtype(orders[layout] + kinds[kind]), 1))
            case ["property", *rest] if elements == ["vertex"]:
                raise ValueError(f"its vertices have a property {' '.join(rest)!r} that this reader does not know")
    if elements[:1] != ["vertex"]:
        raise ValueError(f"its elements are {', '.join(elements) or 'none'}; the first should be its vertices")
    unpack = from_text if layout == "ascii" else from_records
    return from_columns(unpack(body, fields, count), sensor)


def write(file: BinaryIO, scan: Scan) -> None:
    """Writes a scan to an open file."""
    fields, rows = point_rows(scan, range=scan.ranges)
    properties = "".join(f"property float {name}\n" for name in fields)
    file.write(f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n".encode())
    file.write(rows.tobytes())
