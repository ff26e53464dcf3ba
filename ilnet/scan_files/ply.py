""".ply: points as vertices.

Read by hand, as `plyfile` is under the GPL, which this project is not.
"""

import os
from itertools import islice
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from ilnet.scan import Scan
from ilnet.scan_files.points import (
    Field,
    Points,
    check_count,
    columns_of,
    from_records,
    from_text,
    header_lines,
    records_of,
    text_lines,
)

__all__ = ["check_header", "read_points", "write"]

_KINDS = dict(char="i1", uchar="u1", short="i2", ushort="u2", int="i4", uint="u4", float="f4", double="f8")
_KINDS |= dict(int8="i1", uint8="u1", int16="i2", uint16="u2", int32="i4", uint32="u4", float32="f4", float64="f8")
_NAMES = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "u4": "uint"}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


class _Element(NamedTuple):
    name: str
    number: int
    properties: list[Field]
    """A list has its length's type and 0 values, and is followed by the type of its values with -1."""

    def least(self, is_text: bool) -> int:
        """Returns the fewest bytes that one takes; a list may be empty."""
        if is_text:  # a digit and a space
            return max(1, 2 * sum(size >= 0 for _, _, size in self.properties))
        return sum(kind.itemsize for _, kind, size in self.properties if size >= 0)


def read_points(path: Path) -> Points:
    """Returns the points in a file by their standard names; raises a ValueError that continues "path: "."""
    with path.open("rb") as file:
        layout, elements = _header(file)
        names = [element.name for element in elements]
        if "vertex" not in names:
            raise ValueError(f"its elements are {', '.join(names) or 'none'}; its vertices should be among them")
        number = names.index("vertex")
        vertex, before = elements[number], elements[:number]
        if any(size != 1 for _, _, size in vertex.properties):
            raise ValueError("its vertices have a list; they should have numbers only")
        there = os.fstat(file.fileno()).st_size - file.tell()
        check_count(vertex.number, vertex.least(layout == "ascii"), there + 1)  # the last line may lack its end
        if layout == "ascii":
            lines = text_lines(file)
            for _ in islice(lines, sum(element.number for element in before)):
                pass
            return from_text(lines, vertex.properties, vertex.number)
        for element in before:
            _skip(file, element)
        there = os.fstat(file.fileno()).st_size - file.tell()
        check_count(vertex.number, vertex.least(False), there)
        return from_records(file, vertex.properties, vertex.number)


def check_header(path: Path) -> None:
    """Raises a ValueError, which continues "path: ", if a file is shorter than its header promises."""
    with path.open("rb") as file:
        try:
            layout, elements = _header(file)
        except ValueError:  # another reader may know it
            return
        there = os.fstat(file.fileno()).st_size - file.tell()
    least = sum(element.number * element.least(layout == "ascii") for element in elements)
    if least > there + 1:  # as above
        raise ValueError(f"it was cut short: its elements take at least {least} bytes, {there} are there")


def _header(file: BinaryIO) -> tuple[str, list[_Element]]:
    """Returns the layout of an open file and its elements."""
    if file.readline(8).strip() != b"ply":
        raise ValueError("it is not a PLY file: its first line is not 'ply'")
    layout = "ascii"
    elements: list[_Element] = []
    for words in header_lines(file, "end_header"):
        match words:
            case ["format", layout, *_]:
                if layout not in _ORDERS:
                    raise ValueError(f"its format is {layout!r}; it should be one of {', '.join(_ORDERS)}")
            case ["element", name, number]:
                if not number.isdecimal():
                    raise ValueError(f"it has {number} of the element {name}; it should be a number")
                elements.append(_Element(name, int(number), []))
            case ["property", kind, name] if elements and kind in _KINDS:
                elements[-1].properties.append((name, np.dtype(_ORDERS[layout] + _KINDS[kind]), 1))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= _KINDS.keys():
                for of, size in ((length, 0), (kind, -1)):
                    elements[-1].properties.append((name, np.dtype(_ORDERS[layout] + _KINDS[of]), size))
            case ["property", *rest]:
                raise ValueError(f"its property {' '.join(rest)!r} is none that this reader knows")
    return layout, elements


def _skip(file: BinaryIO, element: _Element) -> None:
    """Moves an open binary file to behind an element."""
    whole = os.fstat(file.fileno()).st_size
    if all(size == 1 for _, _, size in element.properties):
        file.seek(element.number * element.least(False), os.SEEK_CUR)
        return
    for _ in range(element.number):
        length = 0
        for _, kind, size in element.properties:
            if size == 0:
                data = file.read(kind.itemsize)
                length = int(np.frombuffer(data, kind)[0]) if len(data) == kind.itemsize else -1
            else:
                file.seek(kind.itemsize * (length if size < 0 else 1), os.SEEK_CUR)
            if length < 0 or file.tell() > whole:
                raise ValueError(f"it was cut short or is damaged in its element {element.name}")


def write(file: BinaryIO, scan: Scan) -> None:
    """Writes a scan to an open file, with the ranges."""
    columns = columns_of(scan) | {"range": scan.ranges[scan.ranges > 0].cpu().numpy().astype("<f4")}
    rows = records_of(columns)
    kinds = (_NAMES[columns[name].dtype.str[1:]] for name in columns)
    properties = "".join(f"property {kind} {name}\n" for kind, name in zip(kinds, columns, strict=True))
    file.write(f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n".encode())
    file.write(rows.tobytes())
