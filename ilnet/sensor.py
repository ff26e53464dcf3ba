"""A LiDAR as tables: one elevation per row, one azimuth per column, range limits; angles to pixel coordinates.

The project's frame and angles are defined here. In the sensor frame x points forward, y left and z up. Azimuth turns
counter-clockwise from +x (left is +90 deg), elevation rises from the horizontal:

    x = cos(elevation) cos(azimuth),  y = cos(elevation) sin(azimuth),  z = sin(elevation)

Python code holds radians and metres. Degrees appear only in files and in `ilnet.sensors`, the tables of the presets.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from ilnet import memory
from ilnet.sensors import TABLES, Table
from ilnet.sensors.table import FALLING, RISING

__all__ = [
    "PAPER_INPUT",
    "PAPER_TARGET",
    "PRESETS",
    "SOURCES",
    "Sensor",
    "angles_to_directions",
    "directions_to_angles",
    "format_size",
    "parse_size",
    "preset",
]


# Of a turn, in a table that only names their number.
_MOST_COLUMNS = 1 << 16


def angles_to_directions(elevation: torch.Tensor, azimuth: torch.Tensor) -> torch.Tensor:
    """Returns the unit vectors (..., 3) along elevations and azimuths [rad] of broadcastable shapes."""
    x, y, z = torch.broadcast_tensors(
        torch.cos(elevation) * torch.cos(azimuth), torch.cos(elevation) * torch.sin(azimuth), torch.sin(elevation)
    )
    return torch.stack((x, y, z), dim=-1)


def directions_to_angles(directions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns elevation and azimuth (...) [rad] of vectors (..., 3) of any length, in the sensor frame."""
    x, y, z = directions.unbind(-1)
    return torch.atan2(z, torch.hypot(x, y)), torch.atan2(y, x)


# About how much memory a ray takes when its scan is predicted or simulated [bytes].
_PER_RAY = 100


@dataclass(frozen=True, eq=False, repr=False)
class Sensor:
    """A LiDAR whose ray (i, j) looks along `elevations[i]` and `azimuths[j]`.

    Args:
        elevations: (H,) [rad], strictly rising or strictly falling, H >= 2. Spacing may be uneven.
        azimuths: (W,) [rad], strictly rising or strictly falling once unwrapped, less than a full turn from first to
            last, W >= 2. Spacing may be uneven. The table is stored unwrapped.
        min_range: Nearest range that the sensor measures [m].
        max_range: Farthest range that the sensor measures [m]. A range outside these limits counts as no return, for
            networks and in figures alike; see `sees`.
        norm_range: Range that stands for no return when a network sees a scan [m]. It lies beyond `max_range`, so that
            no return differs from every return: 0 <= min < max < norm.
        name: Used in messages and files.

    Raises:
        ValueError: If a table or a limit breaks these rules.
    """

    elevations: np.ndarray
    azimuths: np.ndarray
    min_range: float = 2.0
    max_range: float = 80.0
    norm_range: float = 100.0
    name: str = ""
    _tensors: dict[str, tuple[torch.Tensor, torch.Tensor]] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        elevations = _table("elevations", self.elevations)
        if len(elevations) < 2:
            raise ValueError(
                f"elevations has {len(elevations)} beam(s); it should have at least 2, to interpolate between"
            )
        if not _is_monotonic(elevations):
            raise ValueError(
                "elevations is not sorted; it should strictly rise or strictly fall: sort the rows by elevation"
            )
        if np.abs(elevations).max() > math.pi / 2 + 1e-6:
            raise ValueError(
                f"elevations reaches {np.abs(elevations).max():.4g} rad; it should lie within +-pi/2: "
                "are these degrees?"
            )

        azimuths = _table("azimuths", self.azimuths)
        if len(azimuths) < 2:
            raise ValueError(
                f"azimuths has {len(azimuths)} column(s); it should have at least 2, to interpolate between"
            )
        # A valid table is not unwrapped: the columns of a coarse sensor may lie more than half a turn apart.
        if not (_is_monotonic(azimuths) and abs(azimuths[-1] - azimuths[0]) < math.tau):
            azimuths = np.unwrap(azimuths)
            azimuths -= math.tau * np.round((azimuths[0] + azimuths[-1]) / 2 / math.tau)
        if not _is_monotonic(azimuths):
            raise ValueError("azimuths is not sorted; it should strictly rise or strictly fall, except at the seam")
        span = abs(azimuths[-1] - azimuths[0])
        if span > math.tau * (1 - 1e-9):
            raise ValueError(
                f"azimuths spans {span:.6g} rad; it should span less than 2 pi from the first to the last column: "
                "are these degrees, or does the last column repeat the first?"
            )

        limits = {k: _limit(k, getattr(self, k)) for k in ("min_range", "max_range", "norm_range")}
        if not 0 <= limits["min_range"] < limits["max_range"] < limits["norm_range"]:
            found = ", ".join(f"{name} is {value:g}" for name, value in limits.items())
            raise ValueError(f"{found}; they should be 0 <= min_range < max_range < norm_range")

        for name, value in {"elevations": elevations, "azimuths": azimuths, **limits, "name": str(self.name)}.items():
            object.__setattr__(self, name, value)
        elevations.setflags(write=False)
        azimuths.setflags(write=False)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Sensor):
            return NotImplemented
        return self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple:
        # To a nanoradian: files hold degrees, and conversion may change the last bit.
        elevations, azimuths = (tuple(table.round(9).tolist()) for table in (self.elevations, self.azimuths))
        return elevations, azimuths, self.min_range, self.max_range, self.norm_range

    def __getstate__(self) -> dict[str, object]:
        # Tensors on a GPU stay in the process that made them.
        return {**self.__dict__, "_tensors": {}}

    def __repr__(self) -> str:
        e, a = np.rad2deg(self.elevations), np.rad2deg(self.azimuths)
        return (
            f"Sensor({self.name or 'unnamed'}, {self.size}, elevations {e[0]:.2f}..{e[-1]:.2f} deg, "
            f"azimuths {a[0]:.2f}..{a[-1]:.2f} deg, {self.min_range:g}..{self.max_range:g} m)"
        )

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> "Sensor":
        """Returns the sensor that a table in degrees and metres describes, as files hold it.

        Args:
            table: `elevation_deg` (H,) of the rows; `column_azimuth_deg` (W,) of the columns, or `columns`, their
                number in an even full turn that falls from 180°. Optional are `min_range`, `max_range`, `norm_range`
                [m] and `name`. Other keys are ignored.

        Raises:
            ValueError: If it lacks an angle, breaks a rule of `Sensor`, or holds radians.
        """
        missing = [key for key in ("elevation_deg", "column_azimuth_deg") if table.get(key) is None]
        columns = table.get("columns")
        if missing == ["column_azimuth_deg"] and columns is not None:
            if not (isinstance(columns, int) and 2 <= columns <= _MOST_COLUMNS):
                raise ValueError(f"columns is {columns!r}; it should be a whole number from 2 to {_MOST_COLUMNS}")
            azimuths = _even_turn(columns, FALLING)
        elif missing:
            raise ValueError(f"it lacks {', '.join(missing)}: the angles of the rows and of the columns [deg]")
        else:
            azimuths = _table("column_azimuth_deg", table["column_azimuth_deg"])
        elevations = _table("elevation_deg", table["elevation_deg"])
        for name, angles, most in (
            ("elevation_deg", elevations, math.pi / 2),
            ("column_azimuth_deg", azimuths, math.tau),
        ):
            if _looks_like_radians(angles, most):
                raise ValueError(
                    f"{name} spans {np.ptp(angles):.3g} deg with {len(angles)} entries; it should hold degrees: "
                    "are these radians?"
                )
        limits = {key: table[key] for key in ("min_range", "max_range", "norm_range", "name") if key in table}
        return cls(np.deg2rad(elevations), np.deg2rad(azimuths), **limits)

    def table(self) -> dict[str, Any]:
        """Returns the sensor as `from_table` takes it: degrees and metres, in lists and numbers."""
        return {
            "name": self.name,
            "elevation_deg": np.rad2deg(self.elevations).round(6).tolist(),
            "column_azimuth_deg": np.rad2deg(self.azimuths).round(6).tolist(),
            "min_range": self.min_range,
            "max_range": self.max_range,
            "norm_range": self.norm_range,
        }

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of its range images, (H, W)."""
        return len(self.elevations), len(self.azimuths)

    @property
    def size(self) -> str:
        """Rows and columns as text, such as "16x1024"; see `parse_size`."""
        return format_size(self.shape)

    @property
    def wrap(self) -> bool:
        """Whether the columns go full circle: the gap at the seam is at most 1.5 times the largest other spacing."""
        gap = math.tau - abs(self.azimuths[-1] - self.azimuths[0])
        return bool(gap <= 1.5 * np.abs(np.diff(self.azimuths)).max())

    def directions(self) -> torch.Tensor:
        """Returns the unit vectors of all rays, (H, W, 3) float32, in the sensor frame."""
        elevations, azimuths = torch.tensor(self.elevations), torch.tensor(self.azimuths)
        return angles_to_directions(elevations[:, None], azimuths[None, :]).float()

    def angles(self, device: torch.device | str = "cpu") -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the elevations (H,) and azimuths (W,) as float32 tensors [rad] on a device.

        They are made once for each device, since a CUDA graph cannot copy from the host while it is recorded. So they
        are shared and must not be changed.
        """
        key = str(device)
        if key not in self._tensors:
            # Inference may ask first, and training later: it cannot save tensors that inference mode made.
            with torch.inference_mode(False):
                elevations, azimuths = (
                    torch.tensor(table, dtype=torch.float32, device=device)
                    for table in (self.elevations, self.azimuths)
                )
            self._tensors[key] = elevations, azimuths
        return self._tensors[key]

    def locate(self, elevation: torch.Tensor | float, azimuth: torch.Tensor | float) -> torch.Tensor:
        """Returns the pixel coordinates of laser directions.

        They are linear between neighbouring entries of a table, and continue with the spacing at its ends. On a full
        circle the gap between column W-1 and column 0 is interpolated too, so a column lies in [0, W). On a partial
        circle the azimuth counts in the turn that is nearest to the middle of the table.

        Args:
            elevation: (...) [rad], of any float type; broadcasts with `azimuth`.
            azimuth: (...) [rad], in any turn.

        Returns:
            (..., 2) float32 (row, column), on the arguments' device.
        """
        device = next((v.device for v in (elevation, azimuth) if isinstance(v, torch.Tensor)), None)
        elevation, azimuth = (
            v.double() if isinstance(v, torch.Tensor) else torch.tensor(v, dtype=torch.float64, device=device)
            for v in (elevation, azimuth)
        )
        # Broadcast last: a grid then costs H + W searches.
        row, column = torch.broadcast_tensors(self._row(elevation), self._column(azimuth))
        return torch.stack((row, column), dim=-1)

    def _row(self, elevation: torch.Tensor) -> torch.Tensor:
        return _fractional_index(self.elevations, elevation).float()

    def _column(self, azimuth: torch.Tensor) -> torch.Tensor:
        table = self.azimuths
        first, last = float(table[0]), float(table[-1])
        if not self.wrap:
            start = (first + last) / 2 - math.pi
            return _fractional_index(table, start + torch.remainder(azimuth - start, math.tau)).float()
        turn = math.copysign(math.tau, last - first)
        # torch.remainder takes the divisor's sign, so this is in the table's first turn, whether it rises or falls.
        azimuth = first + torch.remainder(azimuth - first, turn)
        column = _fractional_index(np.append(table, first + turn), azimuth).float()
        # Just short of a full turn rounds to W, which is column 0.
        return torch.where(column >= len(table), 0.0, column)

    def grid_queries(self, target: "Sensor") -> torch.Tensor:
        """Returns where the rays of `target` lie in this sensor's image: (H_t, W_t, 2) float32 (row, column)."""
        return self.locate(torch.tensor(target.elevations)[:, None], torch.tensor(target.azimuths)[None, :])

    def contains(self, queries: torch.Tensor) -> torch.Tensor:
        """Returns which pixel coordinates (..., 2) lie in the image or at most half a pixel outside, (...) bool."""
        rows, columns = self.shape
        row, column = queries.unbind(-1)
        inside = (row >= -0.5) & (row <= rows - 0.5)
        return inside if self.wrap else inside & (column >= -0.5) & (column <= columns - 0.5)

    def sees(self, ranges: torch.Tensor) -> torch.Tensor:
        """Returns which ranges [m] are returns: those above 0 and within the limits, as a bool tensor of that shape."""
        return (ranges > 0) & (ranges >= self.min_range) & (ranges <= self.max_range)

    def upright(self, falling: bool = False) -> "Sensor":
        """Returns the same sensor as a network sees it: lowest beam first, azimuths rising or, for some, `falling`."""
        azimuths = np.sort(self.azimuths)
        return replace(self, elevations=np.sort(self.elevations), azimuths=azimuths[::-1] if falling else azimuths)

    def flips(self, falling: bool = False) -> list[int]:
        """Returns the axes of images (..., H, W), -2 or -1 or both, along which `upright` reverses the order."""
        turned = self.upright(falling)
        tables = {-2: (self.elevations, turned.elevations), -1: (self.azimuths, turned.azimuths)}
        return [axis for axis, (table, upright) in tables.items() if table[0] != upright[0]]

    def decimation(self, rows: int | None = None, columns: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Returns the numbers of the rows and columns that `decimate` keeps.

        Args:
            rows: Number of beams to keep, 2 to H, the outermost two among them; None keeps all.
            columns: Number of columns to keep, evenly from column 0; a divisor of W; None keeps all.

        Returns:
            (rows,) and (columns,) int64.

        Raises:
            ValueError: If `rows` or `columns` does not fit this sensor.
        """
        height, width = self.shape
        rows, columns = height if rows is None else rows, width if columns is None else columns
        if not 2 <= rows <= height:
            raise ValueError(f"rows is {rows}; it should be 2 to {height}, the number of this sensor's beams")
        if not (2 <= columns <= width and width % columns == 0):
            raise ValueError(
                f"columns is {columns}; it should be at least 2 and divide {width}, the number of this sensor's columns"
            )
        return np.linspace(0, height - 1, rows).round().astype(np.int64), np.arange(0, width, width // columns)

    def decimate(self, rows: int | None = None, columns: int | None = None) -> "Sensor":
        """Returns the sensor of only some beams and columns, at their true angles, without a name; see `decimation`."""
        row_index, column_index = self.decimation(rows, columns)
        return replace(self, elevations=self.elevations[row_index], azimuths=self.azimuths[column_index], name="")

    def resize(self, rows: int, columns: int) -> "Sensor":
        """Returns a sensor of `rows` x `columns` evenly spaced rays over the same field of view, without a name.

        The outermost beams stay. A full circle keeps its first column; a partial one its first and last.

        Raises:
            ValueError: If `rows` or `columns` is below 2, or such a scan would take too much memory.
        """
        if rows < 2 or columns < 2:
            raise ValueError(f"rows and columns are {rows} and {columns}; each should be at least 2")
        memory.check(f"a scan of {format_size((rows, columns))} rays", rows * columns * _PER_RAY)
        first, last = self.azimuths[0], self.azimuths[-1]
        if self.wrap:
            turn = math.copysign(math.tau, last - first)
            azimuths = np.linspace(first, first + turn, columns, endpoint=False)
        else:
            azimuths = np.linspace(first, last, columns)
        elevations = np.linspace(self.elevations[0], self.elevations[-1], rows)
        return replace(self, elevations=elevations, azimuths=azimuths, name="")


def format_size(shape: Sequence[int]) -> str:
    """Returns rows and columns as text, such as "16x1024"."""
    rows, columns = shape
    return f"{rows}x{columns}"


def parse_size(size: str) -> tuple[int, int]:
    """Returns the rows and columns that a text such as "16x1024" names.

    Raises:
        ValueError: If it is anything else, or names fewer than 2 of either.
    """
    rows, _, columns = size.partition("x")
    if not (rows.isdecimal() and columns.isdecimal() and int(rows) >= 2 and int(columns) >= 2):
        raise ValueError(f"size is {size!r}; it should be rows x columns, at least 2 of each, such as 64x1024")
    return int(rows), int(columns)


def _table(name: str, value: object) -> np.ndarray:
    """Returns a float64 copy of a table of finite angles."""
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    try:
        table = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name} is of type {type(value).__name__}; it should be a list of angles [rad]") from None
    if table.ndim != 1:
        raise ValueError(f"{name} has shape {table.shape}; it should be a list of angles [rad]")
    if not np.isfinite(table).all():
        bad = np.count_nonzero(~np.isfinite(table))
        raise ValueError(f"{name} has {bad} NaN or infinite entries; all should be finite")
    return table


def _limit(name: str, value: object) -> float:
    try:
        limit = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name} is {value!r:.40}; it should be a number of metres") from None
    if not math.isfinite(limit):
        raise ValueError(f"{name} is {limit}; it should be finite")
    return limit


def _is_monotonic(table: np.ndarray) -> bool:
    steps = np.diff(table)
    return bool((steps > 0).all() or (steps < 0).all())


def _looks_like_radians(angles: np.ndarray, most: float) -> bool:
    """Returns whether angles said to be degrees are within `most` [rad] and closer than any sensor's: radians are.

    No sensor has rows 0.1° apart over less than 3°, nor columns less than 0.02° apart over less than 7°; a full turn of
    few columns is one of about 2 pi.
    """
    if len(angles) < 2 or not np.abs(angles).max() <= most * 1.01:
        return False
    steps = np.abs(np.diff(angles))
    step = float(np.median(steps))
    turn = most > math.pi and abs(float(np.ptp(angles)) + step - math.tau) < 0.01 + 0.1 * step
    return turn or step < (0.1 if most < math.pi else 0.02)


def _fractional_index(table: np.ndarray, value: torch.Tensor) -> torch.Tensor:
    """Returns the float64 index of `value` in a monotonic table, linear between the entries and beyond the ends."""
    sign = math.copysign(1.0, table[-1] - table[0])
    ascending = torch.as_tensor(sign * table, device=value.device)
    value = sign * value
    lower = torch.searchsorted(ascending, value.contiguous(), right=True).sub(1).clamp(0, len(table) - 2)
    start, end = ascending[lower], ascending[lower + 1]
    return lower + (value - start) / (end - start)


def _even_turn(columns: int, first: float) -> np.ndarray:
    """Returns an even full turn [deg] from `first`, -180 or 180, so that forward is the middle of the image."""
    return np.linspace(first, -first, columns, endpoint=False)


def _preset(name: str, table: Table) -> Sensor:
    azimuths = _even_turn(table.columns, table.first)
    return Sensor(np.deg2rad(table.elevations), np.deg2rad(azimuths), *table.limits, name=name)


# The paper's simulated sensors (row 0 lowest).
_PAPER = {
    f"paper-{h}x{w}": Table(np.linspace(-15, 15, h), w, (2, 80, 100), "Implicit LiDAR Network, ICRA 2022", RISING)
    for h, w in ((16, 1024), (64, 1024), (128, 2048), (256, 4096))
}

PRESETS: dict[str, Sensor] = {name: _preset(name, table) for name, table in (_PAPER | TABLES).items()}
SOURCES: dict[str, str] = {name: table.source for name, table in (_PAPER | TABLES).items()}
"""Where the numbers of each preset stand."""


def preset(name: str) -> Sensor:
    """Returns the sensor of that name in `PRESETS`.

    Raises:
        ValueError: If there is none.
    """
    if name not in PRESETS:
        raise ValueError(f"sensor is {name!r}; it should be one of {', '.join(PRESETS)}")
    return PRESETS[name]


PAPER_INPUT = preset("paper-16x1024")
"""What the paper's networks see."""
PAPER_TARGET = preset("paper-128x2048")
"""What they learn to predict from stored images."""
