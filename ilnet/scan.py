"""A scan: a range image with its sensor, and its points.

A range of 0 means no return. Points are in the sensor frame, see `ilnet.sensor`.
"""

from dataclasses import dataclass

import numpy as np
import torch

from ilnet.sensor import Sensor, directions_to_angles

__all__ = ["Pair", "Scan", "real_tensor"]


@dataclass(frozen=True, eq=False)
class Scan:
    """A range image and the sensor that measured it.

    Args:
        ranges: (H, W) [m], finite and >= 0; 0 is no return. They are stored as float32.
        sensor: The sensor that measured them, of shape (H, W).
        intensity: (H, W) strength of each return, from 0 to 1; None where it was not measured. It is stored as float32
            on the device of `ranges`, and as 0 where there is no return.

    Raises:
        ValueError: If the shapes differ, a range is NaN, infinite or negative, or an intensity is not in [0, 1].
    """

    ranges: torch.Tensor
    sensor: Sensor
    intensity: torch.Tensor | None = None

    def __post_init__(self) -> None:
        ranges = real_tensor("ranges", self.ranges).float()
        if tuple(ranges.shape) != self.sensor.shape:
            raise ValueError(
                f"ranges has shape {tuple(ranges.shape)}; it should be {self.sensor.shape}, the shape of {self.sensor}"
            )
        bad = {
            "NaN": ranges.isnan(),
            "infinite": ranges.isinf(),
            "negative": (ranges < 0) & ranges.isfinite(),
        }
        counts = [f"{int(mask.sum())} {kind}" for kind, mask in bad.items() if mask.any()]
        if counts:
            raise ValueError(
                f"ranges has {', '.join(counts)} of {ranges.numel()} values; all should be finite and >= 0: "
                "store 0 where nothing came back"
            )
        object.__setattr__(self, "ranges", ranges)
        if self.intensity is None:
            return
        intensity = real_tensor("intensity", self.intensity).to(ranges)
        if intensity.shape != ranges.shape:
            raise ValueError(
                f"intensity has shape {tuple(intensity.shape)}; it should be {tuple(ranges.shape)}, as ranges"
            )
        outside = ~((intensity >= 0) & (intensity <= 1))  # NaN too
        if outside.any():
            raise ValueError(
                f"intensity has {int(outside.sum())} of {outside.numel()} values outside 0 to 1; "
                "divide it by the largest that the sensor reports"
            )
        object.__setattr__(self, "intensity", intensity.where(ranges > 0, 0.0))

    def to(self, device: torch.device | str) -> "Scan":
        """Returns the scan, with its intensity, on a device."""
        intensity = None if self.intensity is None else self.intensity.to(device)
        return Scan(self.ranges.to(device), self.sensor, intensity)

    def points(self) -> torch.Tensor:
        """Returns the points of all returns, (N, 3) float32 [m], in the sensor frame, row by row."""
        directions = self.sensor.directions().to(self.ranges.device)
        measured = self.ranges > 0
        return directions[measured] * self.ranges[measured, None]

    def filled(self, norm_range: float = 0.0) -> torch.Tensor:
        """Returns what a network sees, (H, W) [m]: no return and ranges beyond `max_range` become `norm_range`.

        Args:
            norm_range: The range that the network was trained with [m]; the sensor's is taken where it is larger.
        """
        unseen = (self.ranges == 0) | (self.ranges > self.sensor.max_range)
        return self.ranges.masked_fill(unseen, max(norm_range, self.sensor.norm_range))

    def decimate(self, rows: int | None = None, columns: int | None = None) -> "Scan":
        """Returns the scan of only some beams and columns; see `Sensor.decimation`."""
        indices = self.sensor.decimation(rows, columns)
        row_index, column_index = (torch.from_numpy(index).to(self.ranges.device) for index in indices)
        intensity = None if self.intensity is None else self.intensity[row_index][:, column_index]
        return Scan(self.ranges[row_index][:, column_index], self.sensor.decimate(rows, columns), intensity)

    @classmethod
    def from_points(cls, points: torch.Tensor | np.ndarray, sensor: Sensor) -> "Scan":
        """Returns the range image of a point cloud.

        Each point goes to its nearest pixel. Of several points in one pixel, the nearest to the sensor stays. Points
        that are out of view, not finite or at the origin are dropped.

        Args:
            points: (N, 3 or more) [m], in the sensor frame; columns after x, y, z are ignored.
            sensor: The sensor that measured them.

        Raises:
            ValueError: If `points` has another shape, or no point is in view.
        """
        points = real_tensor("points", points)
        if points.ndim != 2 or points.shape[1] < 3:
            raise ValueError(f"points has shape {tuple(points.shape)}; it should be (N, 3 or more)")
        xyz = points[:, :3].double()
        distance = xyz.norm(dim=1)
        usable = distance.isfinite() & (distance > 0)
        xyz, distance = xyz[usable], distance[usable]
        pixels = sensor.locate(*directions_to_angles(xyz))
        in_view = sensor.contains(pixels)
        if not in_view.any():
            raise ValueError(
                f"none of {len(points)} points ({len(distance)} finite and off the origin) is in view of {sensor}: "
                "give the sensor that measured them, and points in metres in its frame"
            )
        height, width = sensor.shape
        row, column = pixels[in_view].round().long().unbind(-1)
        row = row.clamp(0, height - 1)
        column = column.remainder(width) if sensor.wrap else column.clamp(0, width - 1)
        ranges = torch.full((height * width,), torch.inf, device=points.device)
        ranges.scatter_reduce_(0, row * width + column, distance[in_view].float(), "amin")
        return cls(ranges.masked_fill(ranges.isinf(), 0.0).view(height, width), sensor)


# The scan that a model sees, and the scan that it should predict.
Pair = tuple[Scan, Scan]


def real_tensor(name: str, value: object) -> torch.Tensor:
    """Returns an array or tensor of integers or floats as a tensor.

    Args:
        name: What it is called in errors.
        value: The array; a tensor keeps its device and dtype.

    Raises:
        ValueError: If it holds anything else.
    """
    if isinstance(value, torch.Tensor):
        if value.is_complex() or value.dtype == torch.bool:
            raise ValueError(f"{name} is of dtype {value.dtype}; it should hold real numbers")
        return value.detach()
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name} is of dtype {array.dtype}; it should hold real numbers")
    # A copy: torch does not take a foreign byte order, and the array may be read-only.
    return torch.from_numpy(array.astype(np.float64 if array.dtype.itemsize > 4 else np.float32))
