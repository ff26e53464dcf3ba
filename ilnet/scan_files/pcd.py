""".pcd: points of the Point Cloud Library."""

from pathlib import Path
from typing import BinaryIO

import numpy as np

from ilnet.scan import Scan
from ilnet.scan_files.points import (
    Field,
    check_size,
    from_columns,
    from_records,
    from_text,
    header_lines,
    known,
    numbered,
    point_rows,
)
from ilnet.sensor import Sensor

__all__ = ["read", "write"]


def read(path: Path, sensor: Sensor | None) -> Scan:
    """Returns the scan in a file; raises a ValueError that continues "path: "."""
    sensor = known(sensor)
    with path.open("rb") as file:
        header, body = {words[0]: words[1:] for words in header_lines(file, "DATA")}, file.read()
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "POINTS") if key not in header]
    if missing:
        raise ValueError(f"its PCD header lacks {', '.join(missing)}")
    names = header["FIELDS"]
    counts = header.get("COUNT", ["1"] * len(names))
    try:
        if not (set(header["TYPE"]) <= set("FIU") and all(int(count) > 0 for count in counts)):
            raise ValueError
        types = [np.dtype(f"<{t.lower()}{int(s)}") for t, s in zip(header["TYPE"], header["SIZE"], strict=True)]
        fields = [(n, t, int(c)) for n, t, c in zip(names, types, counts, strict=True)]
        count = int(header["POINTS"][0])
    except (TypeError, ValueError, IndexError):
        raise ValueError("its PCD header contradicts itself in FIELDS, SIZE, TYPE, COUNT or POINTS") from None
    unpackers = {"ascii": from_text, "binary": from_records, "binary_compressed": _from_compressed}
    layout = " ".join(header["DATA"])
    if layout not in unpackers:
        raise ValueError(f"its DATA is {layout!r}; it should be one of {', '.join(unpackers)}")
    return from_columns(unpackers[layout](body, fields, count), sensor)


def _from_compressed(body: bytes, fields: list[Field], count: int) -> dict[str, np.ndarray]:
    """Unpacks PCD's binary_compressed: two sizes, then LZF of all x, all y, and so on."""
    packed, unpacked = int.from_bytes(body[:4], "little"), int.from_bytes(body[4:8], "little")
    check_size(body[8:], packed, count)
    sizes = [kind.itemsize * size * count for _, kind, size in fields]
    if unpacked != sum(sizes):
        raise ValueError(f"its {count} points take {sum(sizes)} bytes, but its data says {unpacked}")
    data = lzf(body[8 : 8 + packed], unpacked)
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
    fields, rows = point_rows(scan)
    sizes, types, counts = (" ".join(entry * len(fields)) for entry in ("4", "F", "1"))
    file.write(
        "# .PCD v0.7 - Point Cloud Data file format\n"
        f"VERSION 0.7\nFIELDS {' '.join(fields)}\nSIZE {sizes}\nTYPE {types}\nCOUNT {counts}\n"
        f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA binary\n".encode()
    )
    file.write(rows.tobytes())
