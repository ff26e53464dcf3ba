"""Many scans on disk, in the Zarr format (version 3), which xarray, TensorStore and others read too.

An archive is a folder, one Zarr group. For each size, say 64x1024, it holds

- `range_64x1024` (scan, row, column): uint16, 0 = no return; times its attribute `scale_factor` it is a range in metres
  (a CF attribute, which xarray applies). The step is a power of two, 2 mm for a sensor that sees 80 m, where float16
  would lose 3 cm. The sensor's name and range limits [m] are attributes too.
- `elevation_64x1024` (row) and `azimuth_64x1024` (column): float64 rad, in the frame of `ilnet.sensor`;

and for each scan `pose` (scan, 4, 4), from the sensor frame to the world [m]; `town`, a number in the group's attribute
`towns`; and `waypoint`, a number in that town.

A file holds `UNIT` scans of one array; the files of the same scans are a unit. Each file appears whole or not at all
and is never changed. So several hosts may write units of one archive, or each its own copy of it; copies are merged by
copying their files together.
"""

import json
import math
import os
import secrets
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import zarr
from zarr.abc.buffer import Buffer
from zarr.codecs import BloscCodec, Crc32cCodec
from zarr.storage import LocalStore, MemoryStore

from ilnet.data.rimg import RangeImageTree
from ilnet.scan import Scan
from ilnet.sensor import Sensor

__all__ = ["UNIT", "Archive", "open_archive"]

UNIT = 8
_FORMAT = 1
# Bytes are sorted by significance. The checksum shows damage. Within a file each scan is compressed by itself.
_COMPRESSION = [BloscCodec(cname="zstd", clevel=5, shuffle="shuffle", typesize=2), Crc32cCodec()]
# Names that the store gives to unfinished files.
_UNFINISHED = "*.partial"
_PER_SCAN = ("town", "waypoint", "pose")


class Archive:
    """Scans from many poses, each by one or several sensors. `len(archive)` is the number of poses.

    Args:
        path: Its folder. Scans may be missing; reading one raises an error.

    Attributes:
        path: Its folder.
        sizes: The sizes of its images, such as "64x1024".
        sensors: The sensor of each size.
        towns: Names of the places where the scans were taken.

    Raises:
        OSError: If there is no archive or it cannot be read.
        ValueError: If its format is not known, or its description is damaged.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        if not (self.path / "zarr.json").is_file():
            raise FileNotFoundError(f"{path}: there is no archive; `python -m ilnet simulate` makes one")
        try:
            group = zarr.open_group(LocalStore(self.path, read_only=True), mode="r")
            found = dict(group.attrs)
            if found.get("format") != _FORMAT:
                raise ValueError(f"its format is {found.get('format')}, and {_FORMAT} is what this version reads")
            self.sizes: tuple[str, ...] = tuple(found["sizes"])  # type: ignore[arg-type]
            self.towns: tuple[str, ...] = tuple(found["towns"])  # type: ignore[arg-type]
            names = [f"{kind}_{size}" for size in self.sizes for kind in ("range", "elevation", "azimuth")]
            self._arrays: dict[str, Any] = {name: group[name] for name in [*names, *_PER_SCAN]}
            self.sensors = {size: self._sensor(size) for size in self.sizes}
        except Exception as error:  # zarr raises many kinds on damaged files
            raise ValueError(f"{path}: not an archive of scans, or damaged: {_line(error)}") from error

    def _sensor(self, size: str) -> Sensor:
        about = self._arrays[f"range_{size}"].attrs
        limits = (about[key] for key in ("min_range", "max_range", "norm_range", "sensor"))
        return Sensor(*(self._arrays[f"{kind}_{size}"][:] for kind in ("elevation", "azimuth")), *limits)

    def __len__(self) -> int:
        return self._arrays["pose"].shape[0]

    @classmethod
    def create(
        cls, path: str | Path, scans: int, sensors: Mapping[str, Sensor], attributes: dict[str, Any]
    ) -> "Archive":
        """Makes an empty archive, or opens one that was made with the same arguments before.

        Args:
            path: Its folder; made as needed.
            scans: Number of scans in the finished archive.
            sensors: The sensor of each size, such as "64x1024".
            attributes: What else decides the content, among it `towns`; kept as attributes of the group.

        Raises:
            OSError: If the folder cannot be written.
            ValueError: If it holds another archive.
        """
        path = Path(path)
        files = _description(scans, sensors, attributes)
        try:
            _refuse_other(path, files)
            # The group's own comes last: it makes the folder an archive.
            for name in sorted(files, key=lambda name: name == "zarr.json"):
                if not (path / name).exists():
                    _put(path / name, files[name])
        except OSError as error:
            raise _unwritable(path, error) from error
        return cls(path)

    def scan(self, number: int, size: str) -> Scan:
        """Returns the scan of that number and size.

        Raises:
            IndexError: If the archive has fewer scans.
            OSError: If this scan is not there (yet).
            ValueError: If there is no such size, or the scan's file is damaged.
        """
        self._check_size(size)
        counts = self._read(f"range_{size}", number)
        scale = self._arrays[f"range_{size}"].attrs["scale_factor"]
        return Scan(torch.from_numpy(counts.astype(np.float32)) * scale, self.sensors[size])

    def check(self, sizes: Sequence[str], numbers: Sequence[int]) -> None:
        """Raises what `scan` would if a scan of these numbers lacked one of the sizes, without reading any."""
        for size in sizes:
            self._check_size(size)
            for number in numbers:
                self._check_there(f"range_{size}", number)

    def pose(self, number: int) -> torch.Tensor:
        """Returns the pose (4, 4) float64 of a scan, from the sensor frame to the world [m]; raises as `scan` does."""
        return torch.from_numpy(self._read("pose", number))

    def town(self, number: int) -> str:
        """Returns the name of the place where a scan was taken, one of `towns`; raises as `scan` does."""
        return self.towns[self._read("town", number)]

    def _check_size(self, size: str) -> None:
        if size not in self.sensors:
            raise ValueError(f"{self.path}: holds no scans of size {size!r}; it has {', '.join(self.sizes)}")

    def _check_there(self, name: str, number: int) -> Path:
        if not 0 <= number < len(self):
            raise IndexError(f"{self.path}: there is no scan {number}; its {len(self)} scans are numbered from 0")
        file = self._file(name, number // UNIT)
        if not file.exists():
            raise FileNotFoundError(
                f"{self.path}: scan {number} is not there yet; run the command that makes the archive to its end"
            )
        return file

    def _read(self, name: str, number: int) -> Any:
        file = self._check_there(name, number)
        try:
            return self._arrays[name][number]
        except Exception as error:  # zarr and its codecs raise many kinds on damaged files
            raise ValueError(
                f"{file}: damaged ({_line(error)}); delete it and run the command that made the archive again"
            ) from error

    def missing(self) -> list[int]:
        """Returns the numbers of the units that are not complete, rising."""
        names = [name for name in self._arrays if name.startswith("range_") or name in _PER_SCAN]
        units = range(-(-len(self) // UNIT))
        return [unit for unit in units if not all(self._file(name, unit).exists() for name in names)]

    def write(
        self, unit: int, ranges: Mapping[str, np.ndarray], towns: np.ndarray, waypoints: np.ndarray, poses: np.ndarray
    ) -> None:
        """Writes a unit; files of it that exist are kept.

        Args:
            unit: Number of the unit; its first scan is `unit * UNIT`.
            ranges: For each size the images of all n scans of the unit, (n, H, W) uint16, see `quantise`.
            towns: (n,) numbers in `towns`.
            waypoints: (n,) numbers of waypoints.
            poses: (n, 4, 4) float64 transforms from the sensor frame to the world [m].

        Raises:
            OSError: If there is no room, or the folder cannot be written.
        """
        values = {f"range_{size}": image for size, image in ranges.items()}
        values |= {"town": towns, "waypoint": waypoints, "pose": poses}
        scans = slice(unit * UNIT, unit * UNIT + len(poses))
        store = LocalStore(self.path)
        try:
            for name, value in values.items():
                # A file that holds nothing but fill values is written too: without it the unit would be incomplete.
                if not self._file(name, unit).exists():
                    array = zarr.open_array(store, path=name, mode="r+")
                    array.with_config({"write_empty_chunks": True})[scans] = value
        except OSError as error:
            raise _unwritable(self.path, error) from error

    def quantise(self, size: str, ranges: torch.Tensor) -> np.ndarray:
        """Returns ranges [m] as `write` takes them: rounded to the step of the size, within the sensor's limits."""
        scale, sensor = self._arrays[f"range_{size}"].attrs["scale_factor"], self.sensors[size]
        low, high = max(1, math.ceil(sensor.min_range / scale)), math.floor(sensor.max_range / scale)
        counts = (ranges / scale).round().clamp(low, high).where(ranges > 0, 0)
        return counts.cpu().numpy().astype(np.uint16)

    def remove_unfinished(self, units: set[int]) -> None:
        """Removes unfinished files of some units; another process may be writing other units meanwhile."""
        for file in self.path.rglob(_UNFINISHED):
            match file.relative_to(self.path).parts:
                case [_, "c", part, *_] if int(part.split(".")[0]) not in units:
                    continue
            file.unlink(missing_ok=True)

    def _file(self, name: str, unit: int) -> Path:
        return self.path.joinpath(name, "c", str(unit), *["0"] * (self._arrays[name].ndim - 1))


def open_archive(path: str | Path) -> Archive | RangeImageTree:
    """Opens scans on disk: an archive, or the `.rimg` tree of the paper's authors.

    Raises:
        OSError: If there is neither.
        ValueError: If it is damaged.
    """
    path = Path(path)
    if not path.is_dir():
        what = "is not a folder" if path.exists() else "there is no such folder"
        raise FileNotFoundError(f"{path}: {what}; it should be that of an archive or of a tree of .rimg files")
    return Archive(path) if (path / "zarr.json").exists() else RangeImageTree(path)


def _description(scans: int, sensors: Mapping[str, Sensor], attributes: dict[str, Any]) -> dict[str, bytes]:
    """Returns the files that describe an archive's content: metadata, and the sensors' tables."""
    files: dict[str, Buffer] = {}
    store = MemoryStore(files)
    everything = {"format": _FORMAT, "scans": scans, "sizes": list(sensors), **attributes}
    group = zarr.create_group(store, attributes=everything)

    def array(name: str, dtype: str, dimensions: list[str], shape: tuple[int, ...], fill: float, **about: Any) -> Any:
        each = (1, *shape[1:]) if name.startswith("range") else (UNIT, *shape[1:])
        return group.create_array(
            name,
            shape=shape,
            dtype=dtype,
            chunks=each if dimensions[0] == "scan" else shape,
            shards=(UNIT, *shape[1:]) if name.startswith("range") else None,
            compressors=_COMPRESSION if name.startswith("range") else None,
            fill_value=fill,
            dimension_names=dimensions,
            attributes=about,
        )

    for size, sensor in sensors.items():
        row, column = f"row_{size}", f"column_{size}"
        step = 2.0 ** math.ceil(math.log2(sensor.max_range / np.iinfo(np.uint16).max))
        limits = {key: getattr(sensor, key) for key in ("min_range", "max_range", "norm_range")}
        about = {"units": "m", "scale_factor": step, "sensor": sensor.name, **limits}
        array(f"range_{size}", "uint16", ["scan", row, column], (scans, *sensor.shape), 0, **about)
        for kind, dimension, table in (("elevation", row, sensor.elevations), ("azimuth", column, sensor.azimuths)):
            array(f"{kind}_{size}", "float64", [dimension], table.shape, math.nan, units="rad")[:] = table
    array("pose", "float64", ["scan", "to", "from"], (scans, 4, 4), math.nan, units="m")
    array("town", "int32", ["scan"], (scans,), -1)
    array("waypoint", "int32", ["scan"], (scans,), -1)
    return {name: value.to_bytes() for name, value in files.items()}


def _refuse_other(path: Path, files: dict[str, bytes]) -> None:
    def settings(text: bytes) -> dict[str, Any]:
        return json.loads(text)["attributes"]

    if (path / "zarr.json").exists():
        try:
            there = settings((path / "zarr.json").read_bytes())
        except (ValueError, KeyError) as error:
            raise ValueError(f"{path}: its zarr.json is damaged or of another kind; give another folder") from error
        here = settings(files["zarr.json"])
        for key in sorted(here.keys() | there.keys()):
            if there.get(key) != here.get(key):
                raise ValueError(
                    f"{path} holds another archive: its {key} is {there.get(key)}, not {here.get(key)}; "
                    "give another folder, or what this archive was made with"
                )
    for name, content in files.items():
        if (path / name).exists() and (path / name).read_bytes() != content:
            raise ValueError(f"{path} holds another archive: its {name} differs; give another folder")


def _put(file: Path, content: bytes) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    unfinished = file.with_suffix(f".{secrets.token_hex(8)}.partial")
    try:
        unfinished.write_bytes(content)
        os.replace(unfinished, file)
    finally:
        unfinished.unlink(missing_ok=True)


def _unwritable(path: Path, error: OSError) -> OSError:
    return OSError(f"{path} cannot be written: {_line(error)}; what is complete there is kept: run the same again")


def _line(error: BaseException) -> str:
    return " ".join((getattr(error, "strerror", None) or str(error) or type(error).__name__).split())
