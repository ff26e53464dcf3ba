"""A LiDAR as tables: one elevation per row, one azimuth per column, range limits; angles to pixel coordinates and back.

This is the one home of the project's frame and angles. Sensor frame: x forward, y left, z up. Azimuth turns
counter-clockwise from +x (left is +90 deg), elevation rises from the horizontal:

    x = cos(elevation) cos(azimuth),  y = cos(elevation) sin(azimuth),  z = sin(elevation)

Radians and metres everywhere in Python; degrees stand only in files and in the preset literals below.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

__all__ = [
    "PAPER_INPUT",
    "PAPER_TARGET",
    "PRESETS",
    "Sensor",
    "angles_to_directions",
    "directions_to_angles",
    "format_size",
    "parse_size",
    "preset",
]


def angles_to_directions(elevation: torch.Tensor, azimuth: torch.Tensor) -> torch.Tensor:
    """Return the unit vectors (..., 3) that look along elevations and azimuths [rad] of broadcastable shapes."""
    x, y, z = torch.broadcast_tensors(
        torch.cos(elevation) * torch.cos(azimuth), torch.cos(elevation) * torch.sin(azimuth), torch.sin(elevation)
    )
    return torch.stack((x, y, z), dim=-1)


def directions_to_angles(directions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return elevation and azimuth (...) [rad] of vectors (..., 3) of any length, in the sensor frame."""
    x, y, z = directions.unbind(-1)
    return torch.atan2(z, torch.hypot(x, y)), torch.atan2(y, x)


@dataclass(frozen=True, eq=False, repr=False)
class Sensor:
    """A LiDAR whose ray (i, j) looks along `elevations[i]` and `azimuths[j]`.

    Args:
        elevations: (H,) [rad], strictly rising or strictly falling, H >= 2. Spacing may be uneven.
        azimuths: (W,) [rad], strictly rising or falling once unwrapped, less than a full turn from first to last,
            W >= 2. Spacing may be uneven. Stored unwrapped: monotonic.
        min_range: nearest range the sensor measures [m].
        max_range: farthest range the sensor measures [m].
        norm_range: what a no-return is filled with before a network sees it [m]; 0 <= min < max < norm, else no
            return would look like one.
        name: for messages and files.

    Raises:
        ValueError: where a table or a limit breaks these rules.
    """

    elevations: np.ndarray
    azimuths: np.ndarray
    min_range: float = 2.0
    max_range: float = 80.0
    norm_range: float = 100.0
    name: str = ""

    def __post_init__(self) -> None:
        elevations = _table("elevations", self.elevations)
        if len(elevations) < 2:
            raise ValueError(
                f"elevations has {len(elevations)} beam(s): a sensor needs at least 2 beams to interpolate between"
            )
        if not _is_monotonic(elevations):
            raise ValueError(
                "elevations must strictly rise or strictly fall from row to row: sort the rows by elevation"
            )
        if np.abs(elevations).max() > math.pi / 2 + 1e-6:
            raise ValueError(
                f"elevations must lie within +-pi/2 rad, got up to {np.abs(elevations).max():.4g}: are these degrees?"
            )

        azimuths = _table("azimuths", self.azimuths)
        if len(azimuths) < 2:
            raise ValueError(
                f"azimuths has {len(azimuths)} column(s): a sensor needs at least 2 columns to interpolate between"
            )
        # A table that is fine as it stands stays so: columns of a coarse sensor may lie more than half a turn apart.
        if not (_is_monotonic(azimuths) and abs(azimuths[-1] - azimuths[0]) < math.tau):
            azimuths = np.unwrap(azimuths)
            azimuths -= math.tau * np.round((azimuths[0] + azimuths[-1]) / 2 / math.tau)
        if not _is_monotonic(azimuths):
            raise ValueError("azimuths must strictly rise or strictly fall from column to column, seam aside")
        span = abs(azimuths[-1] - azimuths[0])
        if span > math.tau * (1 - 1e-9):
            raise ValueError(
                f"azimuths must span less than 2 pi rad from the first to the last column, got {span:.6g}: "
                "are these degrees, or does the last column repeat the first?"
            )

        limits = {k: _limit(k, getattr(self, k)) for k in ("min_range", "max_range", "norm_range")}
        if not 0 <= limits["min_range"] < limits["max_range"] < limits["norm_range"]:
            got = ", ".join(f"{k}={v:g}" for k, v in limits.items())
            raise ValueError(f"range limits must obey 0 <= min_range < max_range < norm_range, got {got}")

        for field, value in {"elevations": elevations, "azimuths": azimuths, **limits, "name": str(self.name)}.items():
            object.__setattr__(self, field, value)
        elevations.setflags(write=False)
        azimuths.setflags(write=False)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Sensor):
            return NotImplemented
        return self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple:
        # To a nanoradian: files hold degrees, and the way there and back may cost the last bit.
        elevations, azimuths = (tuple(table.round(9).tolist()) for table in (self.elevations, self.azimuths))
        return elevations, azimuths, self.min_range, self.max_range, self.norm_range

    def __repr__(self) -> str:
        e, a = np.rad2deg(self.elevations), np.rad2deg(self.azimuths)
        return (
            f"Sensor({self.name or 'unnamed'}, {self.size}, elevations {e[0]:.2f}..{e[-1]:.2f} deg, "
            f"azimuths {a[0]:.2f}..{a[-1]:.2f} deg, {self.min_range:g}..{self.max_range:g} m)"
        )

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
        """Return the unit vectors of all rays, (H, W, 3) float32, sensor frame."""
        elevations, azimuths = torch.tensor(self.elevations), torch.tensor(self.azimuths)
        return angles_to_directions(elevations[:, None], azimuths[None, :]).float()

    def locate(self, elevation: torch.Tensor | float, azimuth: torch.Tensor | float) -> torch.Tensor:
        """Return the pixel coordinates of laser directions.

        Piecewise linear between the table's entries; beyond the first and last one the end spacing goes on. On a full
        circle the stretch between column W-1 and column 0 is interpolated too, so a column lies in [0, W); otherwise
        the turn of the azimuth that is nearest to the middle of the table counts.

        Args:
            elevation: (...) [rad], any float type; broadcasts with `azimuth`.
            azimuth: (...) [rad], any turn.

        Returns:
            (..., 2) float32 (row, column), on the arguments' device.
        """
        device = next((v.device for v in (elevation, azimuth) if isinstance(v, torch.Tensor)), None)
        elevation, azimuth = (
            v.double() if isinstance(v, torch.Tensor) else torch.tensor(v, dtype=torch.float64, device=device)
            for v in (elevation, azimuth)
        )
        # Kept apart until the end: a grid costs H + W searches.
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
        # torch.remainder takes the divisor's sign, so this lies in the table's first turn in either direction.
        azimuth = first + torch.remainder(azimuth - first, turn)
        column = _fractional_index(np.append(table, first + turn), azimuth).float()
        # Just short of a full turn rounds to W, which is column 0.
        return torch.where(column >= len(table), 0.0, column)

    def grid_queries(self, target: "Sensor") -> torch.Tensor:
        """Return the pixel coordinates in this sensor of all rays of `target`, (H_t, W_t, 2) float32 (row, column)."""
        return self.locate(torch.tensor(target.elevations)[:, None], torch.tensor(target.azimuths)[None, :])

    def contains(self, queries: torch.Tensor) -> torch.Tensor:
        """Return (...) bool: which pixel coordinates (..., 2) lie at most half a pixel outside the outermost pixels."""
        rows, columns = self.shape
        row, column = queries.unbind(-1)
        inside = (row >= -0.5) & (row <= rows - 0.5)
        return inside if self.wrap else inside & (column >= -0.5) & (column <= columns - 0.5)

    def decimation(self, rows: int | None = None, columns: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the row and the column indices that `decimate` keeps.

        Args:
            rows: how many beams to keep, 2 to H, the outermost two among them; None keeps all.
            columns: how many columns to keep, evenly from column 0; it must divide W; None keeps all.

        Returns:
            (rows,) and (columns,) int64.

        Raises:
            ValueError: where `rows` or `columns` does not fit this sensor.
        """
        height, width = self.shape
        rows, columns = height if rows is None else rows, width if columns is None else columns
        if not 2 <= rows <= height:
            raise ValueError(f"rows must be 2 to {height}, the beams of this sensor, got {rows}")
        if not (2 <= columns <= width and width % columns == 0):
            raise ValueError(
                f"columns must be at least 2 and divide {width}, the columns of this sensor, got {columns}"
            )
        return np.linspace(0, height - 1, rows).round().astype(np.int64), np.arange(0, width, width // columns)

    def decimate(self, rows: int | None = None, columns: int | None = None) -> "Sensor":
        """Return the nameless sensor of only some of the beams and columns, at their true angles; see `decimation`."""
        row_index, column_index = self.decimation(rows, columns)
        return replace(self, elevations=self.elevations[row_index], azimuths=self.azimuths[column_index], name="")

    def resize(self, rows: int, columns: int) -> "Sensor":
        """Return a nameless sensor of `rows` x `columns` evenly spaced rays over the same field of view.

        The outermost beams stay. A full circle keeps its first column and turns on in even steps; a partial one keeps
        its first and last column.
        """
        if rows < 2 or columns < 2:
            raise ValueError(f"rows and columns must be at least 2, got {rows} and {columns}")
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
    """Return a private float64 copy of a table of finite angles."""
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    try:
        table = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be a 1-D table of angles [rad], got {type(value).__name__}") from None
    if table.ndim != 1:
        raise ValueError(f"{name} must be a 1-D table of angles [rad], got shape {table.shape}")
    if not np.isfinite(table).all():
        raise ValueError(f"{name} must be finite, got {np.count_nonzero(~np.isfinite(table))} NaN or infinite entries")
    return table


def _limit(name: str, value: object) -> float:
    try:
        limit = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be a number of metres, got {value!r}") from None
    if not math.isfinite(limit):
        raise ValueError(f"{name} must be finite, got {limit}")
    return limit


def _is_monotonic(table: np.ndarray) -> bool:
    steps = np.diff(table)
    return bool((steps > 0).all() or (steps < 0).all())


def _fractional_index(table: np.ndarray, value: torch.Tensor) -> torch.Tensor:
    """Return the float64 index of `value` in a monotonic table: linear between the entries and beyond the ends."""
    sign = math.copysign(1.0, table[-1] - table[0])
    ascending = torch.as_tensor(sign * table, device=value.device)
    value = sign * value
    lower = torch.searchsorted(ascending, value.contiguous(), right=True).sub(1).clamp(0, len(table) - 2)
    start, end = ascending[lower], ascending[lower + 1]
    return lower + (value - start) / (end - start)


def _from_degrees(
    name: str, elevations: np.ndarray, azimuths: np.ndarray, limits: tuple[float, float, float]
) -> Sensor:
    return Sensor(np.deg2rad(elevations), np.deg2rad(azimuths), *limits, name=name)


def _turn(columns: int, first: float) -> np.ndarray:
    """Return an even full turn [deg] from `first`, one of the two below; forward is the middle of the image."""
    return np.linspace(first, -first, columns, endpoint=False)


_UP, _DOWN = -180.0, 180.0  # where azimuths that rise or fall with the column start [deg]

PRESETS: dict[str, Sensor] = {
    sensor.name: sensor
    for sensor in (
        # The paper's simulated sensors (row 0 lowest).
        *(
            _from_degrees(f"paper-{h}x{w}", np.linspace(-15, 15, h), _turn(w, _UP), (2, 80, 100))
            for h, w in ((16, 1024), (64, 1024), (128, 2048), (256, 4096))
        ),
        # Velodyne: VLP-16 at 10 Hz; HDL-64E (KITTI), an upper block in thirds and a lower one in halves of a degree.
        _from_degrees("vlp-16", np.arange(-15, 16, 2), _turn(1800, _UP), (0.5, 100, 120)),
        _from_degrees(
            "hdl-64e",
            np.concatenate((2 - np.arange(32) / 3, -8 - 5 / 6 - np.arange(32) / 2)),
            _turn(2048, _DOWN),
            (0.9, 120, 150),
        ),
        # Ouster's nominal fields of view. A real unit has a table of its own in its metadata, often a degree narrower.
        *(
            _from_degrees(f"{model}-{h}", np.linspace(half, -half, h), _turn(w, _DOWN), limits)
            for model, half, w, limits, beams in (
                ("os0", 45.0, 1024, (0.5, 100, 120), (32, 128)),
                ("os1", 22.5, 1024, (0.5, 200, 250), (32, 64, 128)),
                ("os2", 11.25, 2048, (1.0, 400, 500), (128,)),
            )
            for h in beams
        ),
    )
}


def preset(name: str) -> Sensor:
    """Return the sensor of that name in `PRESETS`; ValueError lists the names where there is none."""
    if name not in PRESETS:
        raise ValueError(f"unknown sensor {name!r}; known are {', '.join(PRESETS)}")
    return PRESETS[name]


PAPER_INPUT = preset("paper-16x1024")
"""What the paper's networks see."""
PAPER_TARGET = preset("paper-128x2048")
"""What they learn to predict from stored images."""
