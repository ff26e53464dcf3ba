"""Clouds of ROS in the layouts that drivers send."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from ilnet import models
from ilnet.scan import Scan
from ilnet.scan_files.clouds import Cloud
from ilnet.sensor import preset
from ilnet.world import simulate
from ilnet.world.simulate import pose

SENSOR = preset("paper-16x1024").resize(8, 128)
TARGET = SENSOR.resize(16, 256)
XYZ = {axis: "f4" for axis in "xyz"}


@dataclass
class Field:
    name: str
    offset: int
    datatype: int
    count: int = 1


@dataclass
class Message:
    header: str
    height: int
    width: int
    fields: list
    is_bigendian: bool
    point_step: int
    row_step: int
    data: np.ndarray
    is_dense: bool


def message(points, columns, types, gap=0, row_gap=0, big=False, organised=False):
    """A message of columns (H, W), with bytes that mean nothing between the points and after each row."""
    numbers = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
    columns = dict(zip("xyz", np.moveaxis(points, -1, 0), strict=True)) | columns
    kinds = {name: np.dtype((">" if big else "<") + kind) for name, kind in types.items()}
    offsets = dict(zip(kinds, np.cumsum([gap, *(kind.itemsize + gap for kind in kinds.values())]), strict=False))
    step = max(offsets[name] + kinds[name].itemsize for name in kinds) + gap
    record = np.dtype(
        {"names": list(kinds), "formats": [*kinds.values()], "offsets": [*offsets.values()], "itemsize": step}
    )
    table = np.zeros(columns["x"].shape, record)
    for name in kinds:
        table[name] = columns[name]
    if not organised:
        table = table.reshape(1, -1)
    rows = [row.tobytes() + b"\xff" * row_gap for row in table]
    fields = [Field(name, int(offsets[name]), numbers[kind]) for name, kind in types.items()]
    data = np.frombuffer(b"".join(rows), np.uint8)
    return Message("header", *table.shape, fields, big, step, len(rows[0]), data, not organised)


@pytest.fixture(scope="module")
def seen(yard):
    scan = simulate.scan(yard, SENSOR, pose((0.0, 0.0, 1.8)))
    return Scan(scan.ranges, SENSOR, torch.linspace(0, 1, 8 * 128).view(8, 128))


def points_of(scan):
    return (scan.sensor.directions() * scan.ranges[..., None]).numpy().astype(np.float64)


@pytest.mark.parametrize(
    ("types", "whole", "options"),
    [
        (XYZ | {"intensity": "f4"}, 1.0, {}),
        ({"intensity": "u1"} | XYZ, 255, {"gap": 3}),
        ({"z": "f8", "x": "f8", "y": "f8", "intensity": "u2"}, 65535, {"big": True}),
        (XYZ | {"intensity": "f4"}, 255.0, {"organised": True, "row_gap": 5}),
        (XYZ | {"intensity": "f4"}, 2000.0, {"organised": True, "big": True, "gap": 1, "row_gap": 64}),
    ],
)
def test_every_layout_is_read_alike(seen, types, whole, options):
    values = (seen.intensity.numpy() * whole).round(0 if whole > 1 else 3)
    found = Cloud(message(points_of(seen), {"intensity": values}, types, **options)).scan(SENSOR)
    torch.testing.assert_close(found.ranges, seen.ranges, atol=1e-4, rtol=0)
    scale = 65535 if whole == 2000 else whole
    measured = (seen.ranges > 0).numpy()
    np.testing.assert_allclose(found.intensity.numpy()[measured], (values / scale)[measured], atol=1e-3)


def test_points_that_are_nan_are_no_returns(seen):
    points = points_of(seen)
    points[(seen.ranges == 0).numpy()] = np.nan
    points[3] = np.nan
    found = Cloud(message(points, {}, XYZ, organised=True)).scan(SENSOR)
    expected = seen.ranges.clone()
    expected[3] = 0
    torch.testing.assert_close(found.ranges, expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("organised", [False, True])
@pytest.mark.parametrize("lowest_first", [False, True])
def test_a_denser_cloud_has_the_same_fields(seen, organised, lowest_first):
    rows, columns = np.meshgrid(np.arange(8), np.arange(128), indexing="ij")
    ring = rows if lowest_first else 7 - rows  # row 0 of the sensor is its lowest
    extra = {"intensity": seen.intensity.numpy() * 255, "ring": ring, "t": columns * 781250, "ambient": ring}
    types = XYZ | {"intensity": "u1", "ring": "u2", "t": "u4", "ambient": "u2"}
    cloud = Cloud(message(points_of(seen), extra, types, big=True, organised=organised))
    dense = models.load("planes").upsample(cloud.scan(SENSOR), TARGET)
    again = cloud.denser(dense, SENSOR)
    assert again.header == "header"
    assert [(field.name, field.datatype) for field in again.fields] == [
        *((axis, 7) for axis in "xyz"),
        ("intensity", 2),
        ("ring", 4),
        ("t", 6),
    ]
    assert again.is_bigendian is False
    assert len(again.data) == again.height * again.row_step == again.height * again.width * again.point_step
    found = Cloud(again)
    torch.testing.assert_close(found.scan(TARGET).ranges, dense.ranges, atol=1e-4, rtol=0)
    torch.testing.assert_close(found.scan(TARGET).intensity, dense.intensity, atol=3e-3, rtol=0)
    if organised:
        assert (again.height, again.width, again.is_dense) == (16, 256, False)
        finite = np.isfinite(found.points["x"]).reshape(16, 256)
        assert (finite == (dense.ranges > 0).numpy()[::-1, ::-1]).all()
    else:
        assert (again.height, again.width, again.is_dense) == (1, int((dense.ranges > 0).sum()), True)
    kept = found.points[np.isfinite(found.points["x"])]
    elevation = np.arcsin(kept["z"] / np.sqrt(kept["x"] ** 2 + kept["y"] ** 2 + kept["z"] ** 2))
    row = np.abs(elevation[:, None] - TARGET.elevations).argmin(1)
    assert (kept["ring"] == (row if lowest_first else 15 - row)).all()
    column = SENSOR.locate(0.0, torch.from_numpy(np.arctan2(kept["y"], kept["x"])))[..., 1].numpy()
    away = np.abs(kept["t"] / 781250 - column)
    assert np.minimum(away, 128 - away).max() < 0.51


def test_a_confidence_is_added(seen):
    dense = Scan(seen.ranges, SENSOR, confidence=(seen.ranges > 0) * 0.5)
    again = Cloud(message(points_of(seen), {}, XYZ)).denser(dense, SENSOR)
    assert again.fields[-1].name == "confidence"
    assert (Cloud(again).points["confidence"] == 0.5).all()


def change(**values):
    return lambda cloud: vars(cloud).update(values)


@pytest.mark.parametrize(
    ("spoil", "complaint"),
    [
        (change(fields=[Field("x", 0, 7), Field("y", 4, 7)]), "the fields of its clouds are x, y; x, y and z should"),
        (change(fields=[]), "the fields of its clouds are none"),
        (change(fields=[Field(axis, 0, 9) for axis in "xyz"]), "is of datatype 9; it should be from 1 to 8"),
        (change(point_step=8), "lies beyond the 8 bytes of a point"),
        (change(width=4_000_000_000), "a cloud was cut short: 1x4000000000 points"),
        (change(height=2, row_step=0), "its clouds have 0 bytes"),
        (change(data=np.zeros(0, np.uint8)), "0 are there"),
    ],
)
def test_a_damaged_cloud_is_refused(seen, spoil, complaint):
    cloud = message(points_of(seen), {}, XYZ)
    spoil(cloud)
    with pytest.raises(ValueError, match=complaint):
        Cloud(cloud)


def test_a_cloud_out_of_view_is_refused(seen):
    with pytest.raises(ValueError, match="none of 1024 points"):
        Cloud(message(points_of(seen) * [0, 0, 1] - [0, 0, 1], {}, XYZ)).scan(SENSOR)
