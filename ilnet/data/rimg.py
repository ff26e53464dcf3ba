"""The `.rimg` files of the paper's authors, in the folders of their download.

`Town01/64_1024/7.rimg` is scan 7 of a town with 64 rows and 1024 columns: two uint64, rows and columns, then float16
metres, column by column. `lidar_specification.yaml` beside or above the towns holds the field of view [degrees] and the
range limits [m] of all sizes. The elevations v of the rows are even from `min_v` to `max_v`. The angles h of the
columns are even from `min_h` to just short of `max_h`; the authors' frame counts them clockwise from its y axis:

    x = sin h cos v · r,  y = cos h cos v · r,  z = sin v · r

In the frame of `ilnet.sensor` the azimuth is π/2 - h, so that points have the same coordinates in both.
"""

import math
import re
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from ilnet import memory
from ilnet.scan import Scan
from ilnet.sensor import Sensor, format_size

__all__ = ["RangeImageTree"]

_SPECIFICATION = "lidar_specification.yaml"
_KEYS = ("min_v", "max_v", "min_h", "max_h", "min_r", "max_r", "norm_r")
_NAME = re.compile(r"\d+_\d+/\d+\.rimg")
_HEADER = 16
# About how much memory a ray takes when it is read [bytes].
_PER_RAY = 20


class RangeImageTree:
    """The scans in a tree of `.rimg` files, sorted by town, then by number; read like an `ilnet.data.archive.Archive`.

    Args:
        path: The folder that holds the towns, or the folder of one town.

    Attributes:
        path: The folder.
        sizes: The sizes of all towns, such as "64x1024".
        sensors: The sensor of each size.
        towns: Names of the towns.

    Raises:
        OSError: If there is no tree, or it lacks its `lidar_specification.yaml`.
        ValueError: If that is damaged.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        # A town, towns, or a folder that holds the whole download.
        files = (file for above in ("", "*/", "*/*/") for file in self.path.glob(f"{above}*_*/*.rimg"))
        found = [file for file in files if _NAME.fullmatch("/".join(file.parts[-2:]))]
        if not found:
            raise FileNotFoundError(f"{path}: holds no scans named like Town01/64_1024/1.rimg")
        folders = {file.parent.parent for file in found}
        towns = {f: f.relative_to(self.path).as_posix() if f != self.path else f.resolve().name for f in folders}
        self.towns = tuple(sorted(towns.values()))
        self._scans = sorted({(towns[file.parent.parent], int(file.stem), file.parent.parent) for file in found})
        shapes = {tuple(map(int, file.parent.name.split("_"))) for file in found}
        self.sensors = {format_size((h, w)): self._specified(h, w) for h, w in sorted(shapes)}
        self.sizes = tuple(self.sensors)

    @cached_property
    def _specification(self) -> dict[str, float]:
        town = self._scans[0][2].absolute()
        file = next((f for f in (folder / _SPECIFICATION for folder in town.parents) if f.is_file()), None)
        if file is None:
            raise FileNotFoundError(
                f"{self.path}: there is no {_SPECIFICATION} beside or above its towns; copy it there from the download"
            )
        lines = (line.partition("#")[0].partition(":") for line in file.read_text(errors="replace").splitlines())
        try:
            values = {key.strip(): float(value) for key, colon, value in lines if colon}
        except ValueError as error:
            raise ValueError(f"{file}: should be lines like 'max_r: 80.0', but {error}") from None
        if absent := [key for key in _KEYS if key not in values]:
            raise ValueError(f"{file}: lacks {', '.join(absent)}; copy it from the download")
        return values

    def _specified(self, rows: int, columns: int) -> Sensor:
        memory.check(f"{self.path}: a scan of {format_size((rows, columns))} rays", rows * columns * _PER_RAY)
        of = self._specification
        elevations = np.deg2rad(np.linspace(of["min_v"], of["max_v"], rows))
        azimuths = math.pi / 2 - np.deg2rad(np.linspace(of["min_h"], of["max_h"], columns, endpoint=False))
        try:
            return Sensor(elevations, azimuths, of["min_r"], of["max_r"], of["norm_r"])
        except ValueError as error:
            raise ValueError(
                f"{self.path}: its {_SPECIFICATION} makes no sensor of {format_size((rows, columns))}: {error}"
            ) from None

    def __len__(self) -> int:
        return len(self._scans)

    def scan(self, number: int, size: str) -> Scan:
        """Returns a scan; ranges beyond the sensor's maximum, with which the authors' tools store no return, become 0.

        Raises:
            IndexError: If there are fewer scans.
            OSError: If there is no such size of this scan.
            ValueError: If the file is cut short or damaged.
        """
        self._check_size(size)
        file, sensor = self._file(number, size), self.sensors[size]
        rows, columns = sensor.shape
        if not file.is_file():
            raise FileNotFoundError(f"{file}: there is no such file, though other sizes of this scan are there")
        content = file.read_bytes()
        whole = _HEADER + 2 * rows * columns
        if len(content) != whole:
            raise ValueError(f"{file}: holds {len(content)} bytes, {size} ranges take {whole}; download it again")
        header = np.frombuffer(content, "<u8", 2).tolist()
        if header != [rows, columns]:
            raise ValueError(f"{file}: its header says {format_size(header)}, its folder {size}")
        ranges = np.frombuffer(content, "<f2", offset=_HEADER).reshape(columns, rows).T.astype(np.float32)
        try:
            return Scan(torch.from_numpy(np.where(ranges > sensor.max_range, 0, ranges)), sensor)
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from None

    def check(self, sizes: Sequence[str], numbers: Sequence[int]) -> None:
        """Raises what `scan` would if a scan of these numbers lacked one of the sizes, without reading any."""
        for size in sizes:
            self._check_size(size)
            lacking = [file for file in (self._file(number, size) for number in numbers) if not file.is_file()]
            if lacking:
                raise FileNotFoundError(
                    f"{self.path}: {len(lacking)} of {len(numbers)} scans have no {size}, such as {lacking[0]}; each "
                    f"should be there in {' and '.join(sizes)}: copy them, or name the folder of another town"
                )

    def pose(self, number: int) -> torch.Tensor:
        """Raises a ValueError: the authors' files do not hold the poses of scans."""
        raise ValueError(f"{self.path}: .rimg files hold no poses; only archives do")

    def town(self, number: int) -> str:
        """Returns the name of the town where a scan was taken, one of `towns`."""
        return self._numbered(number)[0]

    def _check_size(self, size: str) -> None:
        if size not in self.sensors:
            raise ValueError(f"{self.path}: holds no scans of size {size!r}; it has {', '.join(self.sizes)}")

    def _file(self, number: int, size: str) -> Path:
        _, index, folder = self._numbered(number)
        return folder / size.replace("x", "_") / f"{index}.rimg"

    def _numbered(self, number: int) -> tuple[str, int, Path]:
        if not 0 <= number < len(self):
            raise IndexError(f"{self.path}: there is no scan {number}; its {len(self)} scans are numbered from 0")
        return self._scans[number]
