"""A scan: a range image with its sensor, and its points.

A range of 0 means no return. Points are in the sensor frame, see `ilnet.sensor`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from ilnet import holes
from ilnet.sensor import Sensor, directions_to_angles

__all__ = ["OF_RETURNS", "Pair", "Scan", "real_tensor"]

# The fields of a scan that hold a value from 0 on for each return: the largest value, and what to do about others.
OF_RETURNS = {
    "intensity": (1.0, "divide it by the largest that the sensor reports"),
    "confidence": (1.0, "they should be probabilities"),
    "time": (86400.0, "it should be seconds since the first return"),
}


@dataclass(frozen=True, eq=False)
class Scan:
    """A range image and the sensor that measured it.

    Args:
        ranges: (H, W) [m], finite and >= 0; 0 is no return. They are stored as float32.
        sensor: The sensor that measured them, of shape (H, W).
        intensity: (H, W) strength of each return, from 0 to 1; None where it was not measured.
        confidence: (H, W) probability of each return that its range is right to 10 cm, from 0 to 1, in a scan that was
            predicted; None where nobody told it.
        time: (H, W) when each return was measured, in seconds since the first of the scan; None where it is not known.
        seen: (H, W) bool, False where the sensor never looked, such as in holes of a projection; a return cannot be
            there. None, and so it is stored, if it looked everywhere. A pixel that is seen and holds no return is sky,
            or absorbs the laser.

    Intensity, confidence and time are those of returns: they are stored as 0 where there is none, as float32. All are
    on the device of `ranges`.

    Raises:
        ValueError: If the shapes differ, a range is NaN, infinite or negative, intensity or confidence is not in
            [0, 1], time is negative or beyond a day, `seen` is not bool, or a return is where it is False.
    """

    ranges: torch.Tensor
    sensor: Sensor
    intensity: torch.Tensor | None = None
    confidence: torch.Tensor | None = None
    time: torch.Tensor | None = None
    seen: torch.Tensor | None = None

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
        for name in OF_RETURNS:
            object.__setattr__(self, name, self._of_returns(name))
        object.__setattr__(self, "seen", self._checked_seen())

    def _of_returns(self, name: str) -> torch.Tensor | None:
        """Returns a checked tensor of `OF_RETURNS` as it is stored; None if the scan has none."""
        if getattr(self, name) is None:
            return None
        values = real_tensor(name, getattr(self, name)).to(self.ranges)
        self._check_shape(name, values)
        largest, remedy = OF_RETURNS[name]
        outside = ~((values >= 0) & (values <= largest))  # NaN too
        if outside.any():
            raise ValueError(
                f"{name} has {int(outside.sum())} of {outside.numel()} values outside 0 to {largest:g}; {remedy}"
            )
        return values.where(self.ranges > 0, 0.0)

    def _checked_seen(self) -> torch.Tensor | None:
        if self.seen is None:
            return None
        seen = torch.as_tensor(self.seen, device=self.ranges.device)
        if seen.dtype != torch.bool:
            raise ValueError(f"seen is of dtype {seen.dtype}; it should be bool")
        self._check_shape("seen", seen)
        unseen = ~seen & (self.ranges > 0)
        if unseen.any():
            raise ValueError(
                f"seen is False at {int(unseen.sum())} of {int((self.ranges > 0).sum())} returns; "
                "it should be True wherever something came back"
            )
        return None if seen.all() else seen

    def _check_shape(self, name: str, image: torch.Tensor) -> None:
        if image.shape != self.ranges.shape:
            raise ValueError(
                f"{name} has shape {tuple(image.shape)}; it should be {tuple(self.ranges.shape)}, as ranges"
            )

    def _map(self, change: Callable[[torch.Tensor], torch.Tensor], sensor: Sensor) -> "Scan":
        """Returns a scan of `sensor`, with each tensor changed."""
        others = {name: getattr(self, name) for name in (*OF_RETURNS, "seen")}
        changed = {name: None if image is None else change(image) for name, image in others.items()}
        return Scan(change(self.ranges), sensor, **changed)

    def to(self, device: torch.device | str) -> "Scan":
        """Returns the scan, with all that it has, on a device."""
        return self._map(lambda image: image.to(device), self.sensor)

    def points(self) -> torch.Tensor:
        """Returns the points of all returns, (N, 3) float32 [m], in the sensor frame, row by row."""
        directions = self.sensor.directions().to(self.ranges.device)
        measured = self.ranges > 0
        return directions[measured] * self.ranges[measured, None]

    def filled(self, norm_range: float = 0.0) -> torch.Tensor:
        """Returns what a network sees, (H, W) [m]: no return and ranges out of limits become `norm_range`.

        Holes are bridged: they would be walls at `norm_range` in the middle of a surface.

        Args:
            norm_range: The range that the network was trained with [m]; the sensor's is taken where it is larger.
        """
        ranges = self.bridged().ranges
        return ranges.where(self.sensor.sees(ranges), max(norm_range, self.sensor.norm_range))

    def bridged(self) -> "Scan":
        """Returns the scan as if the sensor had looked everywhere: holes filled from around them; see `holes.bridge`.

        Ranges out of the limits of the sensor count as no return, if there is a hole.
        """
        if self.seen is None:
            return self
        names = [name for name in OF_RETURNS if getattr(self, name) is not None]
        ranges = self.ranges.where(self.sensor.sees(self.ranges), 0.0)
        ranges, *others = holes.bridge(ranges, self.seen, self.sensor, *(getattr(self, name) for name in names))
        return Scan(ranges, self.sensor, **dict(zip(names, others, strict=True)))

    def decimate(self, rows: int | None = None, columns: int | None = None) -> "Scan":
        """Returns the scan of only some beams and columns; see `Sensor.decimation`."""
        indices = self.sensor.decimation(rows, columns)
        row_index, column_index = (torch.from_numpy(index).to(self.ranges.device) for index in indices)
        return self._map(lambda image: image[row_index][:, column_index], self.sensor.decimate(rows, columns))

    def confident(self, least: float) -> "Scan":
        """Returns the scan of only those returns that are right with at least this probability; no return elsewhere.

        Args:
            least: The least confidence, from 0 to 1.

        Raises:
            ValueError: If it is not from 0 to 1, or the scan has no confidence.
        """
        if not 0 <= least <= 1:
            raise ValueError(f"least is {least}; it should be from 0 to 1, a probability")
        if self.confidence is None:
            raise ValueError("the scan has no confidence; it should be one that a model with confidence predicted")
        return replace(self, ranges=self.ranges.where(self.confidence >= least, 0.0))

    @classmethod
    def from_points(
        cls,
        points: torch.Tensor | np.ndarray,
        sensor: Sensor,
        intensity: torch.Tensor | np.ndarray | None = None,
        confidence: torch.Tensor | np.ndarray | None = None,
        time: torch.Tensor | np.ndarray | None = None,
        rows: torch.Tensor | np.ndarray | None = None,
    ) -> "Scan":
        """Returns the range image of a point cloud.

        Each point goes to its nearest pixel. Of several points in one pixel, the nearest to the sensor stays. Points
        that are out of view, not finite or at the origin are dropped. An empty pixel is a no return, or was never
        looked at: see `holes.find`.

        Args:
            points: (N, 3 or more) [m], in the sensor frame; columns after x, y, z are ignored.
            sensor: The sensor that measured them.
            intensity: (N,) strength of each point, from 0 to 1.
            confidence: (N,) probability of each point that it is right to 10 cm.
            time: (N,) seconds of each point since the first.
            rows: (N,) the row of each point, where its beam is known; None takes the nearest by elevation.

        Raises:
            ValueError: If an argument has another shape, no point is in view, or a point in view has an intensity,
                confidence or time that is out of its limits.
        """
        points = real_tensor("points", points)
        if points.ndim != 2 or points.shape[1] < 3:
            raise ValueError(f"points has shape {tuple(points.shape)}; it should be (N, 3 or more)")
        of_points: dict[str, torch.Tensor] = {}
        for name, values in (("intensity", intensity), ("confidence", confidence), ("time", time)):
            if values is not None:
                of_points[name] = real_tensor(name, values).to(points.device, torch.float32)
                if of_points[name].shape != points.shape[:1]:
                    raise ValueError(
                        f"{name} has shape {tuple(of_points[name].shape)}; it should be ({len(points)},), as points"
                    )
        xyz = points[:, :3].double()
        distance = xyz.norm(dim=1)
        usable = (distance.isfinite() & (distance > 0)).nonzero().squeeze(1)
        pixels = sensor.locate(*directions_to_angles(xyz[usable]))
        if rows is not None:
            rows = real_tensor("rows", rows).to(pixels)
            if rows.shape != points.shape[:1]:
                raise ValueError(f"rows has shape {tuple(rows.shape)}; it should be ({len(points)},), as points")
            pixels[:, 0] = rows[usable]
        in_view = sensor.contains(pixels)
        if not in_view.any():
            raise ValueError(
                f"none of {len(points)} points ({len(usable)} finite and off the origin) is in view of {sensor}: "
                "give the sensor that measured them, and points in metres in its frame"
            )
        kept, pixels = usable[in_view], pixels[in_view]
        height, width = sensor.shape
        pixel, distance = holes.nearest_pixels(pixels, sensor), distance[kept].float()
        ranges = torch.full((height * width,), torch.inf, device=points.device)
        ranges.scatter_reduce_(0, pixel, distance, "amin")
        stays = distance == ranges[pixel]  # of equally near points, the one with the larger value
        images = {
            name: torch.zeros_like(ranges)
            .scatter_reduce_(0, pixel[stays], values[kept][stays], "amax", include_self=False)
            .view(sensor.shape)
            for name, values in of_points.items()
        }
        ranges = ranges.masked_fill(ranges.isinf(), 0.0).view(sensor.shape)
        return cls(ranges, sensor, **images, seen=~holes.find(pixels, sensor))


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
