"""Clouds as ROS sends them: the message `sensor_msgs/PointCloud2`, to a scan and back.

A cloud is a block of records. Its fields say where x, y and z [m] and others lie in a record, in either byte order; its
points may be in a grid, "organised", with gaps after each row, or in a list.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ilnet.scan import Scan
from ilnet.scan_files.points import XYZ, scan_of
from ilnet.sensor import Sensor, directions_to_angles

__all__ = ["TYPE", "Cloud", "pack"]

TYPE = "sensor_msgs/msg/PointCloud2"
# The numbers that the message gives to numpy's types.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
# What drivers call the number of a point's row, and its time.
_RINGS = ("ring", "line", "channel", "laser_id")
_TIMES = ("t", "time", "timestamp", "offset_time", "time_stamp")


class Cloud:
    """The points of a message.

    Args:
        message: A `sensor_msgs/PointCloud2` as rosbags deserialises it.

    Raises:
        ValueError: If its fields or sizes contradict each other, or x, y and z are not among its fields.
    """

    def __init__(self, message: Any):
        self.message = message
        fields = {field.name: field for field in message.fields}
        if not {*XYZ} <= set(fields):
            names = ", ".join(fields) or "none"
            raise ValueError(f"the fields of its clouds are {names}; x, y and z should be among them")
        height, width, step, row = message.height, message.width, message.point_step, message.row_step
        unknown = [field.datatype for field in fields.values() if field.datatype not in _TYPES]
        if unknown:
            raise ValueError(f"a field of its clouds is of datatype {unknown[0]}; it should be from 1 to 8")
        order = ">" if message.is_bigendian else "<"
        types = {name: np.dtype(order + _TYPES[field.datatype]) for name, field in fields.items()}
        if any(field.offset + types[name].itemsize > step for name, field in fields.items()):
            raise ValueError(f"a field of its clouds lies beyond the {step} bytes of a point")
        if height > 1 and row < width * step:
            raise ValueError(f"the rows of its clouds have {row} bytes; {width} points take {width * step}")
        need = (height - 1) * row + width * step if height and width else 0
        if len(message.data) < need:
            raise ValueError(
                f"a cloud was cut short: {height}x{width} points take {need} bytes, {len(message.data)} are there"
            )
        record = np.dtype(
            {
                "names": list(fields),
                "formats": list(types.values()),
                "offsets": [field.offset for field in fields.values()],
                "itemsize": step,
            }
        )
        points = np.ndarray((height, width), record, np.ascontiguousarray(message.data), 0, (row, step))
        self.points = points.reshape(-1)

    def _first(self, names: tuple[str, ...]) -> str | None:
        return next((name for name in names if name in (self.points.dtype.names or ())), None)

    def scan(self, sensor: Sensor, source: str = "cloud") -> Scan:
        """Returns the range image of the points, with an intensity where they have one.

        The row of a point is that of its ring, where there is one. The intensity is divided by the largest that its
        type can hold or, if it is a float, by the smallest of 1, 255, 65535 and the largest of the cloud that is not
        below it.

        Args:
            sensor: The sensor that measured them.
            source: What the points are called in notes.

        Raises:
            ValueError: If no point is in view of the sensor.
        """
        columns = dict(zip(XYZ, self._xyz().T, strict=True))
        ring = self._first(_RINGS)
        if ring:
            columns["ring"] = self.points[ring]
        if "intensity" in (self.points.dtype.names or ()):
            values = np.nan_to_num(self.points["intensity"].astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
            columns["intensity"] = np.clip(values / self._whole(), 0, 1)
        return scan_of(columns, sensor, source)

    def _whole(self) -> float:
        """Returns what intensity a perfect reflector has."""
        values = self.points["intensity"]
        if values.dtype.kind != "f":
            return float(np.iinfo(values.dtype).max)
        largest = float(np.max(values, initial=0.0, where=np.isfinite(values)))
        return next((whole for whole in (1.0, 255.0, 65535.0) if largest <= whole), largest)

    def denser(self, scan: Scan, source: Sensor) -> Any:
        """Returns a message of the points of a denser scan, with the header and the layout of this one.

        It keeps the fields x, y, z, intensity, ring and time, of the same names and types, and adds `confidence`, a
        float32, where the scan has one. A ring is the row of the scan, counted from the lowest or the highest as here.
        The time is that of the nearest column that was measured. An organised cloud stays one: of all rays, the highest
        row first and azimuths falling, NaN where nothing returned. Others are the points of all returns.

        Args:
            scan: The scan that was predicted from this cloud.
            source: The sensor that measured this cloud.
        """
        names = self.points.dtype.names or ()
        ring, time = self._first(_RINGS), self._first(_TIMES)
        images: dict[str, np.ndarray] = {}
        if scan.intensity is not None and "intensity" in names:
            images["intensity"] = scan.intensity.cpu().numpy() * self._whole()
        if ring:
            images[ring] = np.broadcast_to(self._rows(ring, scan.sensor)[:, None], scan.sensor.shape)
        if time:
            images[time] = np.broadcast_to(self._times(time, source, scan.sensor), scan.sensor.shape)
        types = {name: self.points.dtype[name].newbyteorder("<") for name in (*XYZ, *images)}
        if scan.confidence is not None:
            images["confidence"], types["confidence"] = scan.confidence.cpu().numpy(), np.dtype("<f4")
        return pack(self.message, scan, images, types, organised=self.message.height > 1)

    def _rows(self, ring: str, sensor: Sensor) -> np.ndarray:
        """Returns the numbers of a sensor's rows (H,), counted in the direction in which the cloud counts them."""
        measured, elevation, _ = self._angles()
        rings, heights = self.points[ring][measured].astype(np.float64), elevation.numpy()
        rises = len(rings) == 0 or float(((rings - rings.mean()) * (heights - heights.mean())).sum()) >= 0
        return np.argsort(np.argsort(sensor.elevations if rises else -sensor.elevations))

    def _times(self, time: str, source: Sensor, target: Sensor) -> np.ndarray:
        """Returns the times of a sensor's columns (W,), in the unit of the cloud."""
        measured, *angles = self._angles()
        pixels = source.locate(*angles)
        in_view = source.contains(pixels).numpy()
        times = self.points[time][measured][in_view]
        columns = pixels[..., 1].numpy()[in_view].round().astype(np.int64) % source.shape[1]
        # The earliest of a column: where a turn ends beside its start, the mean of both would be neither.
        order = np.lexsort((times, columns))
        known, first = np.unique(columns[order], return_index=True)
        times = times[order][first]
        wanted = source.locate(0.0, torch.tensor(target.azimuths))[..., 1].numpy()
        width = source.shape[1] if source.wrap else np.inf
        after = np.searchsorted(known, wanted) % len(known)
        before = after - 1
        to_before, to_after = (np.abs(wanted - known[side]) for side in (before, after))
        nearer = np.minimum(to_before, width - to_before) <= np.minimum(to_after, width - to_after)
        return np.where(nearer, times[before], times[after])

    def _angles(self) -> tuple[np.ndarray, torch.Tensor, torch.Tensor]:
        """Returns which points were measured (N,), and the elevations and azimuths [rad] of those."""
        xyz = self._xyz()
        with np.errstate(invalid="ignore"):
            distance = np.abs(xyz).max(1)
            measured = np.isfinite(distance) & (distance > 0)
        return measured, *directions_to_angles(torch.from_numpy(xyz[measured]))

    def _xyz(self) -> np.ndarray:
        with np.errstate(invalid="ignore"):  # no warning about a signalling NaN
            return np.stack([self.points[axis] for axis in XYZ], axis=1).astype(np.float64)


def pack(
    like: Any, scan: Scan, images: Mapping[str, np.ndarray], types: Mapping[str, np.dtype], organised: bool = False
) -> Any:
    """Returns a message of the points of a scan.

    Args:
        like: A message whose header it has.
        scan: The scan.
        images: Fields beside x, y and z by their names, each (H, W).
        types: The types of all fields, x, y and z first.
        organised: Whether all rays are in it, the highest row first and azimuths falling, NaN where nothing returned;
            by default it is a list of the returns.
    """
    measured = (scan.ranges > 0).cpu().numpy()
    xyz = (scan.sensor.directions() * scan.ranges.cpu()[..., None]).numpy()
    columns = dict(zip(XYZ, np.moveaxis(xyz, -1, 0), strict=True)) | dict(images)
    points = np.zeros(measured.shape, np.dtype([(name, types[name]) for name in columns]))
    for name, values in columns.items():
        kind = types[name]
        if kind.kind != "f" and values.dtype.kind == "f":
            values = np.clip(values.round(), np.iinfo(kind).min, np.iinfo(kind).max)
        points[name] = values
    if organised:
        for axis in XYZ:
            points[axis][~measured] = np.nan
        points = points[np.argsort(-scan.sensor.elevations)][:, np.argsort(-scan.sensor.azimuths)]
    height, width = measured.shape if organised else (1, int(measured.sum()))
    data = (points if organised else points[measured]).tobytes()
    numbers = {name: number for number, name in _TYPES.items()}
    fields, step = [], 0
    for name in columns:
        kind = types[name]
        fields.append(replace(like.fields[0], name=name, offset=step, datatype=numbers[kind.str[1:]], count=1))
        step += kind.itemsize
    return replace(
        like,
        height=height,
        width=width,
        fields=fields,
        is_bigendian=False,
        point_step=step,
        row_step=step * width,
        data=np.frombuffer(data, np.uint8),
        is_dense=not organised,
    )
