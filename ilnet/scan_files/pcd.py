""".pcd: points of the Point Cloud Library.

Read by hand, as `pypcd4` takes the memory that a header asks for, and does not read a file without POINTS.
"""

import os
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ilnet import memory
from ilnet.scan import Scan
from ilnet.scan_files.points import (
    Field,
    Points,
    check_count,
    columns_of,
    from_records,
    from_text,
    header_lines,
    numbered,
    records_of,
    text_lines,
)

__all__ = ["lzf", "read_points", "write"]

# LZF makes at most so many bytes of one.
_LARGEST_RATIO = 90


def read_points(path: Path) -> Points:
    """Returns the points in a file by their standard names; raises a ValueError that continues "path: "."""
    with path.open("rb") as file:
        header = {words[0].upper(): words[1:] for words in header_lines(file, "DATA")}
        fields, count = _fields(header)
        there = os.fstat(file.fileno()).st_size - file.tell()
        size = sum(kind.itemsize * number for _, kind, number in fields)
        match layout := " ".join(header["DATA"]).lower():
            case "ascii":  # a value takes a digit and a space or the end of the line, which the last may lack
                check_count(count, 2 * sum(number for _, _, number in fields), there + 1)
                return from_text(text_lines(file), fields, count)
            case "binary":
                check_count(count, size, there)
                return from_records(file, fields, count)
            case "binary_compressed":
                return _from_compressed(file, there, fields, count)
    raise ValueError(f"its DATA is {layout!r}; it should be one of ascii, binary, binary_compressed")


def _fields(header: dict[str, list[str]]) -> tuple[list[Field], int]:
    """Returns the fields of a point, and how many points there are."""
    count_key = ["POINTS"] if "POINTS" in header else ["WIDTH", "HEIGHT"]
    if missing := [key for key in ("FIELDS", "SIZE", "TYPE") if key not in header]:
        raise ValueError(f"its PCD header lacks {', '.join(missing)}")
    if not all(key in header for key in count_key):
        raise ValueError("its PCD header lacks POINTS, and WIDTH or HEIGHT")
    names = header["FIELDS"]
    counts = header.get("COUNT", ["1"] * len(names))
    try:
        if not (set(header["TYPE"]) <= set("FIU") and all(int(count) > 0 for count in counts)):
            raise ValueError
        types = [np.dtype(f"<{t.lower()}{int(s)}") for t, s in zip(header["TYPE"], header["SIZE"], strict=True)]
        fields = [(n, t, int(c)) for n, t, c in zip(names, types, counts, strict=True)]
        count = 1
        for key in count_key:
            count *= int(header[key][0])
    except (TypeError, ValueError, IndexError):
        raise ValueError("its PCD header contradicts itself in FIELDS, SIZE, TYPE, COUNT or POINTS") from None
    return fields, count


def _from_compressed(file: BinaryIO, there: int, fields: list[Field], count: int) -> Points:
    """Unpacks PCD's binary_compressed: two sizes, then LZF of all x, all y, and so on."""
    start = file.read(8)
    packed, unpacked = int.from_bytes(start[:4], "little"), int.from_bytes(start[4:], "little")
    check_count(count, 0, there)
    if there - 8 < packed:
        raise ValueError(f"it was cut short: its data takes {packed} bytes, {max(there - 8, 0)} are there")
    sizes = [kind.itemsize * size * count for _, kind, size in fields]
    if unpacked != sum(sizes):
        raise ValueError(f"its {count} points take {sum(sizes)} bytes, but its data says {unpacked}")
    if unpacked > packed * _LARGEST_RATIO:
        raise ValueError(f"its compressed data is damaged: {packed} bytes cannot hold {unpacked}")
    memory.check("its points", 2 * unpacked)
    data = lzf(file.read(packed), unpacked)
    starts = np.cumsum([0, *sizes])
    return {
        name: np.frombuffer(data, fields[i][1], count * fields[i][2], starts[i]).reshape(count, -1)[:, 0]
        for name, i in numbered(fields).items()
    }


def lzf(data: bytes, size: int) -> bytes:
    """Unpacks LZF: a control byte below 32 starts a run of literals, others copy from what was unpacked before."""
    out, at = bytearray(), 0
    try:
        while at < len(data) and len(out) <= size:
            control, at = data[at], at + 1
            if control < 32:
                out += data[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length, at = length + data[at], at + 1
            length += 2
            distance, at = ((control & 31) << 8) + data[at] + 1, at + 1
            if distance > len(out):
                raise IndexError
            # A copy longer than `distance` repeats the last `distance` bytes.
            source = bytes(out[len(out) - distance : len(out) - distance + length])
            out += (source * (length // len(source) + 1))[:length]
    except IndexError:
        raise ValueError("its compressed data is damaged") from None
    if len(out) != size:
        raise ValueError(f"its compressed data is damaged: {len(out)} bytes came out, not {size}")
    return bytes(out)


def write(file: BinaryIO, scan: Scan) -> None:
    """Writes a scan to an open file."""
    columns = columns_of(scan)
    rows = records_of(columns)
    types = [column.dtype for column in columns.values()]
    header: dict[str, list[object]] = {
        "VERSION": ["0.7"],
        "FIELDS": [*columns],
        "SIZE": [kind.itemsize for kind in types],
        "TYPE": [kind.kind.upper() for kind in types],
        "COUNT": [1] * len(types),
        "WIDTH": [len(rows)],
        "HEIGHT": [1],
        "VIEWPOINT": [0, 0, 0, 1, 0, 0, 0],
        "POINTS": [len(rows)],
        "DATA": ["binary"],
    }
    lines = "".join(f"{key} {' '.join(map(str, values))}\n" for key, values in header.items())
    file.write(f"# .PCD v0.7 - Point Cloud Data file format\n{lines}".encode() + rows.tobytes())
