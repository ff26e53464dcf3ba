"""Scans in files: the formats that are read and written.

A range of 0 means no return. Points are in the sensor frame, see `ilnet.sensor`.

`read` goes by the suffix:

- `.npz`: `range` (H, W) [m], `elevation_deg` (H,) of the rows and `column_azimuth_deg` (W,) of the columns. Optional
  are `min_range`, `max_range` and `norm_range` [m], by default the paper's 2, 80 and 100; `name`; and `intensity` and
  `confidence` (H, W). A sensor given to `read` replaces all of these except range, intensity and confidence.
- `.npy`: ranges (H, W) of the sensor's shape, or points (N, 3) to (N, 8) that start with x, y, z. Needs a sensor.
- `.bin`: KITTI's float32 x, y, z, intensity. The sensor is `hdl-64e` by default.
- `.ply`: vertices with x, y, z, and perhaps `intensity` and `confidence`; ascii or binary. Needs a sensor.
- `.pcd`: points with x, y, z, and perhaps `intensity` and `confidence`; ascii, binary or binary_compressed. Needs a
  sensor; VIEWPOINT is not applied.

An intensity beyond 1 is divided by 255; beyond 255, by 65535; and beyond that, by the largest in the file.

`write` makes `.npz`, `.ply` and `.pcd`, with intensity and confidence where the scan has them.
"""

import os
import secrets
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from ilnet.scan import OF_RETURNS, Scan, real_tensor
from ilnet.sensor import Sensor, preset

__all__ = ["UnknownSensor", "kitti_points", "listed", "read", "write"]


def read(path: str | Path, sensor: Sensor | None = None) -> Scan:
    """Returns the scan in a file; the list above says what each suffix holds. Nothing in a file is ever executed.

    Args:
        path: The file.
        sensor: The sensor that measured it; None where the file describes it.

    Raises:
        OSError: If the file is missing, a folder or unreadable.
        ValueError: If it is damaged, of another kind than its suffix says, or holds no return; or if it does not hold
            the angles of its rays and `sensor` is None: then the cause is an `UnknownSensor`.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder; it should be one of the files in it")
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"{path}: its suffix is {path.suffix!r}; it should be one of {', '.join(_READERS)}")
    try:
        scan = reader(path, sensor)
        if not (scan.ranges > 0).any():
            raise ValueError("it holds no return: every range is 0")
    except ValueError as error:
        # One line, whatever a library wrote.
        raise ValueError(f"{path}: {' '.join(str(error).split())}") from error
    return scan


def listed(path: Path) -> list[Path]:
    """Returns the file that a path names or, for a folder, the files in it by name, without folders and hidden files.

    Raises:
        FileNotFoundError: If there is no such file or folder.
        ValueError: If there is no file in the folder.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file or folder")
    if not path.is_dir():
        return [path]
    paths = sorted(inside for inside in path.iterdir() if inside.is_file() and not inside.name.startswith("."))
    if not paths:
        raise ValueError(f"{path}: there is no file in this folder")
    return paths


def write(path: str | Path, scan: Scan) -> None:
    """Writes a scan: to `.npz` as it is, to `.ply` (binary, with the range) and `.pcd` (binary) its points.

    Folders are made as needed. A file of that name is replaced once the new one is complete.

    Args:
        path: The file; its suffix says the format.
        scan: What is written, with its intensity and confidence where it has them.

    Raises:
        ValueError: If the suffix is unknown.
    """
    path = Path(path)
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise ValueError(f"{path}: its suffix is {path.suffix!r}; it should be one of {', '.join(_WRITERS)}")
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with partial.open("xb") as file:
            writer(file, scan)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


# Readers. Each returns a scan or raises a ValueError that continues "path: ".


def _read_npz(path: Path, sensor: Sensor | None) -> Scan:
    limits = ("min_range", "max_range", "norm_range", "name")
    if not zipfile.is_zipfile(path):
        raise ValueError("it is not a whole .npz archive: it was cut short or never was one")
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            found = list(file.files)
            wanted = ("range", "elevation_deg", "column_azimuth_deg", *OF_RETURNS, *limits)
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
    return Scan(real_tensor("range", arrays["range"]), sensor, **_of_returns(arrays))


def _read_npy(path: Path, sensor: Sensor | None) -> Scan:
    sensor = _required(sensor)
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


def _read_bin(path: Path, sensor: Sensor | None) -> Scan:
    columns = kitti_points(path).T
    return _from_columns(dict(zip((*_XYZ, "intensity"), columns, strict=True)), sensor or preset("hdl-64e"))


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


_XYZ = ("x", "y", "z")
# The intensity of a perfect reflector: as a share, in 8 bits, in 16 bits.
_WHOLES = (1.0, 255.0, 65535.0)
# A field of a point: its name, its numpy type, its number of values.
_Field = tuple[str, np.dtype, int]


def _read_ply(path: Path, sensor: Sensor | None) -> Scan:
    sensor = _required(sensor)
    with path.open("rb") as file:
        if file.readline(8).strip() != b"ply":
            raise ValueError("it is not a PLY file: its first line is not 'ply'")
        header, body = _header(file, "end_header"), file.read()
    kinds = dict(char="i1", uchar="u1", short="i2", ushort="u2", int="i4", uint="u4", float="f4", double="f8")
    kinds |= dict(int8="i1", uint8="u1", int16="i2", uint16="u2", int32="i4", uint32="u4", float32="f4", float64="f8")
    orders = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
    layout, count = "ascii", 0
    elements: list[str] = []
    fields: list[_Field] = []
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
    unpack = _from_text if layout == "ascii" else _from_records
    return _from_columns(unpack(body, fields, count), sensor)


def _read_pcd(path: Path, sensor: Sensor | None) -> Scan:
    sensor = _required(sensor)
    with path.open("rb") as file:
        header, body = {words[0]: words[1:] for words in _header(file, "DATA")}, file.read()
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
    unpackers = {"ascii": _from_text, "binary": _from_records, "binary_compressed": _from_compressed}
    layout = " ".join(header["DATA"])
    if layout not in unpackers:
        raise ValueError(f"its DATA is {layout!r}; it should be one of {', '.join(unpackers)}")
    return _from_columns(unpackers[layout](body, fields, count), sensor)


class UnknownSensor(ValueError):
    """A file does not hold the angles of its rays, and no sensor was named; the cause of the error of `read`."""


def _required(sensor: Sensor | None) -> Sensor:
    if sensor is None:
        raise UnknownSensor(
            "it does not hold the angles of its rays; name the sensor that measured it, such as the preset os1-128"
        )
    return sensor


def _header(file: BinaryIO, last: str) -> list[list[str]]:
    """Returns the words of each line up to the one that starts with `last`."""
    lines = []
    while line := file.readline(4096):
        words = line.decode("ascii", "replace").split()
        if words:
            lines.append(words)
            if words[0] == last:
                return lines
    raise ValueError(f"its header has no line {last!r}: it was cut short or is of another kind")


def _of_returns(arrays: Mapping[str, np.ndarray]) -> dict[str, torch.Tensor]:
    """Returns intensity and confidence as a scan takes them, as far as a file has them."""
    found = {name: real_tensor(name, arrays[name]) for name in OF_RETURNS if name in arrays}
    if "intensity" in found:
        intensity = found["intensity"]
        largest = intensity.where(intensity.isfinite(), 0.0).max().item() if intensity.numel() else 0.0
        found["intensity"] = intensity / next((whole for whole in _WHOLES if largest <= whole), largest)
    return found


def _from_columns(columns: Mapping[str, np.ndarray], sensor: Sensor) -> Scan:
    """Returns the scan of points whose fields are given, each (N,)."""
    with np.errstate(invalid="ignore"):  # no warning about a signalling NaN: such points are dropped
        points = np.stack([columns[axis] for axis in _XYZ], axis=1, dtype=np.float64)
        return Scan.from_points(points, sensor, **_of_returns(columns))


def _numbers(fields: list[_Field]) -> dict[str, int]:
    """Returns the numbers of the fields that are read: x, y and z, and what else a scan keeps."""
    names = [name for name, _, _ in fields]
    if not {*_XYZ} <= set(names):
        raise ValueError(f"its fields are {', '.join(names) or 'none'}; x, y and z should be among them")
    return {name: names.index(name) for name in (*_XYZ, *OF_RETURNS) if name in names}


def _check_size(body: bytes, need: int, count: int) -> None:
    if count < 1:
        raise ValueError("it holds no points")
    if len(body) < need:
        raise ValueError(f"it was cut short: {count} points take {need} bytes, {len(body)} are there")


def _from_text(body: bytes, fields: list[_Field], count: int) -> dict[str, np.ndarray]:
    _check_size(body, 0, count)
    starts = np.cumsum([0, *(size for _, _, size in fields)])
    lines = [line for line in body.decode("ascii", "replace").splitlines() if line.strip()]
    if len(lines) < count:
        raise ValueError(f"it was cut short: its header promises {count} points, {len(lines)} are there")
    numbers = _numbers(fields)
    columns = np.loadtxt(lines[:count], usecols=[starts[i] for i in numbers.values()], ndmin=2)
    return dict(zip(numbers, columns.T, strict=True))


def _from_records(body: bytes, fields: list[_Field], count: int) -> dict[str, np.ndarray]:
    """Unpacks points stored one after the other."""
    # Numbered, since names may repeat: PCL pads with fields that are all called "_".
    record = np.dtype([(str(i), kind, (size,)) for i, (_, kind, size) in enumerate(fields)])
    _check_size(body, count * record.itemsize, count)
    records = np.frombuffer(body, record, count)
    return {name: records[str(i)][:, 0] for name, i in _numbers(fields).items()}


def _from_compressed(body: bytes, fields: list[_Field], count: int) -> dict[str, np.ndarray]:
    """Unpacks PCD's binary_compressed: two sizes, then LZF of all x, all y, and so on."""
    packed, unpacked = int.from_bytes(body[:4], "little"), int.from_bytes(body[4:8], "little")
    _check_size(body[8:], packed, count)
    sizes = [kind.itemsize * size * count for _, kind, size in fields]
    if unpacked != sum(sizes):
        raise ValueError(f"its {count} points take {sum(sizes)} bytes, but its data says {unpacked}")
    data = _lzf(body[8 : 8 + packed], unpacked)
    starts = np.cumsum([0, *sizes])
    return {
        name: np.frombuffer(data, fields[i][1], count * fields[i][2], starts[i]).reshape(count, -1)[:, 0]
        for name, i in _numbers(fields).items()
    }


def _lzf(data: bytes, size: int) -> bytes:
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


def _write_npz(file: BinaryIO, scan: Scan) -> None:
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
    arrays |= {name: image.cpu().numpy() for name, image in _images(scan).items()}
    np.savez_compressed(file, **arrays)


def _images(scan: Scan) -> dict[str, torch.Tensor]:
    """Returns intensity and confidence, as far as the scan has them."""
    return {name: image for name in OF_RETURNS if (image := getattr(scan, name)) is not None}


def _point_rows(scan: Scan, **images: torch.Tensor) -> tuple[list[str], np.ndarray]:
    """Returns the names of a point's fields, and the points (N, fields): x, y, z, `images`, and what the scan keeps."""
    images |= _images(scan)
    measured = scan.ranges > 0
    rows = torch.cat((scan.points(), *(image[measured, None] for image in images.values())), dim=1)
    return [*_XYZ, *images], rows.cpu().numpy().astype("<f4")


def _write_ply(file: BinaryIO, scan: Scan) -> None:
    fields, rows = _point_rows(scan, range=scan.ranges)
    properties = "".join(f"property float {name}\n" for name in fields)
    file.write(f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n".encode())
    file.write(rows.tobytes())


def _write_pcd(file: BinaryIO, scan: Scan) -> None:
    fields, rows = _point_rows(scan)
    sizes, types, counts = (" ".join(entry * len(fields)) for entry in ("4", "F", "1"))
    file.write(
        "# .PCD v0.7 - Point Cloud Data file format\n"
        f"VERSION 0.7\nFIELDS {' '.join(fields)}\nSIZE {sizes}\nTYPE {types}\nCOUNT {counts}\n"
        f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA binary\n".encode()
    )
    file.write(rows.tobytes())


_READERS = {".npz": _read_npz, ".npy": _read_npy, ".bin": _read_bin, ".ply": _read_ply, ".pcd": _read_pcd}
_WRITERS = {".npz": _write_npz, ".ply": _write_ply, ".pcd": _write_pcd}
