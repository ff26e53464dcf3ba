"""Scans as people have them: units, scales, dtypes, layouts and names, each read back to the same ranges."""

import logging
import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from ilnet import scan_files
from ilnet.scan import Scan
from ilnet.sensor import Sensor, preset

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "scans"
# A scan of each kind of sensor, thinned out to be quick; a made-up one where the measured ones are not there.
SCANS = sorted(path.stem for path in SHARED.glob("*.npz")) or ["made-up"]
# Float32 points: three roundings of 2^-24, and a square root's.
POINTS = 5e-7


@pytest.fixture(params=SCANS)
def scan(request):
    rng = np.random.default_rng(3)
    if request.param == "made-up":
        sensor = preset("os1-32").resize(32, 256)
        walls = 6 + 30 * rng.random((1, 8)).repeat(32, 1) + np.linspace(0, 3, 32)[:, None]
        ranges = torch.from_numpy(np.where(rng.random(sensor.shape) < 0.1, 0, walls))
    else:
        whole = scan_files.read(SHARED / f"{request.param}.npz")
        sensor, ranges = whole.sensor, whole.ranges
        columns = max(n for n in range(2, 80) if sensor.shape[1] % n == 0)
        sensor, ranges = sensor.decimate(columns=columns), ranges[:, :: sensor.shape[1] // columns]
    intensity = torch.from_numpy(rng.integers(0, 256, sensor.shape) / 255)
    intensity[ranges.argmax() // ranges.shape[1], ranges.argmax() % ranges.shape[1]] = 1
    return Scan(ranges, sensor, intensity)


@pytest.fixture
def notes(caplog):
    caplog.set_level(logging.WARNING, "ilnet")
    return lambda: [record.getMessage() for record in caplog.records]


def same(found, scan, rtol=POINTS, atol=0.0, intensity=None):
    assert found.sensor == scan.sensor
    torch.testing.assert_close(found.ranges, scan.ranges, rtol=rtol, atol=atol)
    if intensity is not None:
        torch.testing.assert_close(found.intensity, scan.intensity, rtol=0, atol=intensity)


def arrays(scan, **changes):
    """What an `.npz` holds."""
    sensor = scan.sensor
    return {
        "range": scan.ranges.numpy(),
        "elevation_deg": np.rad2deg(sensor.elevations),
        "column_azimuth_deg": np.rad2deg(sensor.azimuths),
        **changes,
    }


def columns(scan, unit=1.0):
    """Points in some unit, with their fields."""
    row = (scan.ranges > 0).nonzero()[:, 0].numpy()
    x, y, z = scan.points().double().numpy().T / unit
    return {"x": x, "y": y, "z": z, "intensity": scan.intensity[scan.ranges > 0].numpy(), "ring": row}


@pytest.mark.parametrize("nothing", [0, np.nan, np.inf, -np.inf, -1])
@pytest.mark.parametrize(("kind", "unit"), [("<f4", 1), (">f8", 1), ("<f4", 1e-3), ("<i4", 1e-3)])
def test_range_images(tmp_path, scan, notes, nothing, kind, unit):
    if kind == "<i4" and not np.isfinite(nothing):
        return
    ranges = scan.ranges.double().numpy() / unit
    image = np.where(ranges > 0, ranges.round() if kind == "<i4" else ranges, nothing).astype(kind)
    np.savez(tmp_path / "a.npz", **arrays(scan, range=image, intensity=(scan.intensity * 255).numpy()))
    precision = {"rtol": 1e-6, "atol": 6e-4 if kind == "<i4" else 0.0}
    same(scan_files.read(tmp_path / "a.npz"), scan, **precision, intensity=1e-6)
    np.save(tmp_path / "a.npy", image)
    same(scan_files.read(tmp_path / "a.npy", scan.sensor), scan, **precision)
    said = [line for line in notes() if "millimetres" in line]
    assert len(said) == (0 if unit == 1 else 2)
    assert not said or said[0].startswith(f"{tmp_path / 'a.npz'}: ranges are taken as millimetres: their median is ")


def test_ranges_of_16_bits_are_millimetres(tmp_path, scan):
    near = Scan(scan.ranges.where(scan.ranges < 65, 0.0), scan.sensor)
    np.save(tmp_path / "a.npy", (near.ranges * 1000).round().numpy().astype(np.uint16))
    same(scan_files.read(tmp_path / "a.npy", scan.sensor), near, rtol=0, atol=6e-4)


@pytest.mark.parametrize("factor", [1e-3, 1e-6, 1e7, 1e30])
def test_a_unit_that_cannot_be_is_refused(tmp_path, scan, factor):
    np.savez(tmp_path / "a.npz", **arrays(scan, range=scan.ranges.double().numpy() * factor))
    with pytest.raises(ValueError, match=r"are neither metres nor millimetres of a sensor that measures"):
        scan_files.read(tmp_path / "a.npz")


def test_angles_in_radians_are_refused(tmp_path, scan):
    changes = {"elevation_deg": scan.sensor.elevations, "column_azimuth_deg": scan.sensor.azimuths}
    np.savez(tmp_path / "a.npz", **arrays(scan, **changes))
    with pytest.raises(ValueError, match=r"looks like radians; they should be degrees"):
        scan_files.read(tmp_path / "a.npz")


@pytest.mark.parametrize("unit", [1, 1e-3])
def test_arrays_of_points(tmp_path, scan, unit):
    fields = columns(scan, unit)
    table = np.stack([fields[key] for key in ("x", "y", "z", "intensity")], axis=1)
    directions = scan.sensor.directions().numpy() * scan.ranges[..., None].double().numpy() / unit
    records = np.zeros(len(table), [("Z", ">f8"), ("x", "<f4"), ("Y", "<f4"), ("intensity", "u1"), ("rgb", "u4")])
    for key in ("Z", "x", "Y"):
        records[key] = fields[key.lower()]
    records["intensity"] = (fields["intensity"] * 255).round()
    for number, array in enumerate(
        [table[:, :3], table, np.column_stack([table, np.zeros((len(table), 5))]), table[:, :3].T, directions, records]
    ):
        np.save(tmp_path / f"{number}.npy", array.astype(np.float64) if array.dtype.kind == "f" else array)
        found = scan_files.read(tmp_path / f"{number}.npy", scan.sensor)
        same(found, scan, 1e-6, intensity=1e-6 if number in (1, 2, 5) else None)


@pytest.mark.parametrize("number", [3, 4, 5, 6])
@pytest.mark.parametrize("shuffled", [False, True])
def test_bin_of_any_number_of_columns(tmp_path, scan, number, shuffled):
    fields = columns(scan)
    time = (np.arange(len(fields["x"])) / len(fields["x"]) / 10).astype(np.float32)
    table = np.stack([*(fields[axis] for axis in "xyz"), fields["intensity"] * 255, fields["ring"], time], axis=1)
    if shuffled:
        table = np.random.default_rng(0).permutation(table)
    table[:, :number].astype("<f4").tofile(tmp_path / "a.bin")
    found = scan_files.read(tmp_path / "a.bin", scan.sensor)
    same(found, scan, 1e-6, intensity=1e-6 if number > 3 else None)
    assert (found.time is not None) == (number == 6)
    points = scan_files.read_points(tmp_path / "a.bin", columns=number)
    assert list(points) == ["x", "y", "z", "intensity", "ring", "time"][:number]


def test_bin_that_holds_no_points_is_refused(tmp_path):
    rng = np.random.default_rng(1)
    for content in (b"It was a dark and stormy night. " * 600, b"1.25 -3.5 7\n" * 1000, rng.bytes(9600), bytes(9600)):
        (tmp_path / "a.bin").write_bytes(content)
        with pytest.raises(ValueError, match="holds no plausible coordinates"):
            scan_files.read(tmp_path / "a.bin", preset("hdl-64e"))
    (tmp_path / "a.bin").write_bytes(bytes(20 * 7))
    with pytest.raises(ValueError, match="its 140 bytes are not whole points of 4 float32"):
        scan_files.read(tmp_path / "a.bin", columns=4)


def ply_text(fields, before=""):
    header = f"ply\nformat ascii 1.0\n{before}element vertex {len(fields['x'])}\n"
    header += "".join(f"property double {name}\n" for name in fields) + "end_header\n"
    return header, "".join(" ".join(map(repr, map(float, row))) + "\n" for row in zip(*fields.values(), strict=True))


@pytest.mark.parametrize("unit", [1, 1e-3])
def test_ply_of_others(tmp_path, scan, unit):
    plyfile = pytest.importorskip("plyfile")
    fields = {name.upper() if name in "xyz" else name: values for name, values in columns(scan, unit).items()}
    kind = [(name, "f8" if name in "XYZ" else "f4" if name == "intensity" else "u1") for name in fields]
    vertices = np.zeros(len(fields["X"]), kind)
    for name, values in fields.items():
        vertices[name] = values
    faces = np.array([([0, 1, 2], 3.0), ([1, 2, 3, 4], 4.0)], dtype=[("vertex_indices", "O"), ("area", "f4")])
    camera = np.array([(1.0, 2)], dtype=[("view", "f8"), ("n", "i2")])
    for number, (text, order) in enumerate([(True, "="), (False, "<"), (False, ">")]):
        elements = [plyfile.PlyElement.describe(*each) for each in ((camera, "camera"), (faces, "face"))]
        elements.append(plyfile.PlyElement.describe(vertices, "vertex"))
        plyfile.PlyData(elements, text=text, byte_order=order).write(tmp_path / f"{number}.ply")
        same(scan_files.read(tmp_path / f"{number}.ply", scan.sensor), scan, 1e-6, intensity=1e-6)


@pytest.mark.parametrize("unit", [1, 1e-3])
def test_pcd_of_others(tmp_path, scan, unit):
    pypcd4 = pytest.importorskip("pypcd4")
    fields = columns(scan, unit)
    names, kinds = ("X", "Y", "Z", "intensity", "ring"), (np.float64,) * 3 + (np.float32, np.uint16)
    cloud = pypcd4.PointCloud.from_points([fields[name.lower()] for name in names], names, kinds)
    for encoding in pypcd4.Encoding:
        if encoding == pypcd4.Encoding.BINARYSCOMPRESSED:
            continue
        cloud.save(tmp_path / "a.pcd", encoding=encoding)
        same(scan_files.read(tmp_path / "a.pcd", scan.sensor), scan, 1e-5, intensity=1e-6)
        content = (tmp_path / "a.pcd").read_bytes()
        lines = content.split(b"\n")
        (tmp_path / "a.pcd").write_bytes(b"\n".join(line for line in lines if not line.startswith(b"POINTS")))
        same(scan_files.read(tmp_path / "a.pcd", scan.sensor), scan, 1e-5, intensity=1e-6)


@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_las_of_others(tmp_path, scan, name):
    laspy = pytest.importorskip("laspy")
    fields = columns(scan)
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [1e-4] * 3, [3.0, -7.0, 0.5]
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = (fields[axis] for axis in "xyz")
    cloud.intensity = (fields["intensity"] * 255).round().astype(np.uint16)
    cloud.gps_time = 3e8 + np.linspace(0, 0.1, len(fields["x"]))
    cloud.write(tmp_path / name)
    found = scan_files.read(tmp_path / name, scan.sensor)
    same(found, scan, rtol=0, atol=1e-4, intensity=1e-6)
    assert found.time.max().item() == pytest.approx(0.1, abs=1e-6)


@pytest.mark.parametrize("renumbered", [lambda ring: ring, lambda ring: ring.max() - ring, lambda ring: 7 + 3 * ring])
def test_the_ring_decides_the_row(tmp_path, scan, notes, renumbered):
    """Points whose elevations are off by more than half a row, as those of a tilted or uncalibrated sensor."""
    fields = columns(scan)
    distance = scan.ranges[scan.ranges > 0].double().numpy()
    off = 0.7 * np.diff(scan.sensor.elevations).mean()
    elevation = np.arcsin(fields["z"] / distance) + off
    azimuth = np.arctan2(fields["y"], fields["x"])
    fields["x"], fields["y"] = (distance * np.cos(elevation) * of(azimuth) for of in (np.cos, np.sin))
    fields["z"], fields["ring"] = distance * np.sin(elevation), renumbered(fields["ring"])
    if len(np.unique(fields["ring"])) < scan.sensor.shape[0]:
        pytest.skip("a beam without a return")
    same(scan_files.scan_of(fields, scan.sensor), scan)
    assert notes() == []


def test_a_ring_that_is_none_is_left_out(scan, notes):
    fields = columns(scan)
    fields["ring"] = np.random.default_rng(0).integers(0, scan.sensor.shape[0], len(fields["x"]))
    same(scan_files.scan_of(fields, scan.sensor, "cloud"), scan)
    (line,) = notes()
    assert line.startswith("cloud: its ring has ")
    assert line.endswith("rows go by elevation")


@pytest.mark.parametrize(
    "stamps",
    [
        lambda s: s.astype(np.float32),
        lambda s: 1.7e9 + s,
        lambda s: (s * 1e9).astype(np.uint32),
        lambda s: (s * 1e9).astype(np.int64) + 1_700_000_000_000_000_123,
        lambda s: s * 1e6,
        lambda s: s * 1e3,
    ],
)
def test_times_of_any_clock_become_seconds(scan, stamps):
    fields = columns(scan)
    since = np.linspace(0, 0.1, len(fields["x"]))
    found = scan_files.scan_of({**fields, "time": stamps(since)}, scan.sensor)
    expected = torch.zeros(scan.sensor.shape)
    expected[scan.ranges > 0] = torch.from_numpy(since).float()
    torch.testing.assert_close(found.time, expected, rtol=0, atol=5e-7)


def test_times_that_are_none_are_left_out(scan, notes):
    fields = columns(scan)
    assert scan_files.scan_of({**fields, "time": fields["x"] * 1e12}, scan.sensor).time is None
    assert "its times are left out" in notes()[0]


def turned(found, scan):
    """The image in the order of the columns of a scan on a full circle."""
    shift = np.angle(np.exp(1j * (found.sensor.azimuths[:, None] - scan.sensor.azimuths)))
    column = np.abs(shift).argmin(axis=0)
    assert len(np.unique(column)) == len(column)
    return np.abs(np.take_along_axis(shift, column[None], 0)).max(), found.ranges[:, column]


def test_staggered_columns_are_resampled_without_loss(tmp_path, scan, notes):
    """As a raw Ouster: each row is shifted by whole columns."""
    height, width = scan.sensor.shape
    shifts = np.arange(height) % 4 * 3
    azimuth = np.stack([np.roll(scan.sensor.azimuths, shift) for shift in shifts])
    image = np.stack([np.roll(row, shift) for row, shift in zip(scan.ranges.numpy(), shifts, strict=True)])
    bright = np.stack([np.roll(row, shift) for row, shift in zip(scan.intensity.numpy(), shifts, strict=True)])
    changes = {"range": image, "azimuth_deg": np.rad2deg(azimuth), "intensity": bright}
    np.savez(tmp_path / "a.npz", **arrays(scan, **changes))
    found = scan_files.read(tmp_path / "a.npz")
    error, ranges = turned(found, scan)
    assert error < 0.2 * np.abs(np.diff(scan.sensor.azimuths)).mean()
    assert torch.equal(ranges, scan.ranges)
    assert (found.intensity > 0).sum() == (scan.intensity > 0).sum()
    assert found.seen is None
    assert any(f"resampled to {width} columns" in line for line in notes())
    same(scan_files.read(tmp_path / "a.npz", scan.sensor), scan, 1e-6)


def test_offsets_of_rows_of_parts_of_a_column_lose_nothing(tmp_path):
    """As nuScenes: each beam looks a little aside, so azimuths are those of pixels."""
    sensor = Sensor(np.deg2rad(np.linspace(-10, 10, 8)), np.deg2rad(np.linspace(-45, 45, 91)))
    ranges = 5 + torch.rand(sensor.shape, generator=torch.Generator().manual_seed(0))
    offset = np.linspace(-0.9, 0.9, 8)[:, None]
    azimuth = np.rad2deg(sensor.azimuths) + offset
    np.savez(tmp_path / "a.npz", **arrays(Scan(ranges, sensor), column_azimuth_deg=azimuth))
    found = scan_files.read(tmp_path / "a.npz")
    assert found.ranges.count_nonzero() == ranges.numel()
    assert torch.equal(found.ranges[found.ranges > 0], ranges.flatten())
    _, column = (found.ranges > 0).nonzero().numpy().T
    away = np.rad2deg(found.sensor.azimuths)[column] - azimuth.ravel()
    assert np.abs(away).max() < 0.51
    assert found.seen is not None
    assert (found.seen == (found.ranges > 0)).all()


def test_driver_names_are_known(tmp_path, scan):
    stamps = np.linspace(0, 1e8, scan.sensor.shape[1]).astype(np.uint64) + 987654321012345
    reflectivity = (scan.intensity * 255).round().numpy().astype(np.uint8)
    np.savez(tmp_path / "a.npz", **arrays(scan, reflectivity=reflectivity, timestamp_ns=stamps))
    found = scan_files.read(tmp_path / "a.npz")
    same(found, scan, 0, intensity=1e-6)
    expected = torch.linspace(0, 0.1, scan.sensor.shape[1]).expand(scan.ranges.shape)
    torch.testing.assert_close(found.time, expected * (scan.ranges > 0), rtol=0, atol=1e-6)


def test_an_uncompressed_size_beyond_the_data_is_damage(tmp_path, scan):
    header = (
        "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 90000000\nHEIGHT 1\nPOINTS 90000000\n"
        "DATA binary_compressed\n"
    )
    (tmp_path / "a.pcd").write_bytes(header.encode() + struct.pack("<II", 12, 1_080_000_000) + bytes(12))
    with pytest.raises(ValueError, match=r"12 bytes cannot hold 1080000000|would take about 18 GB"):
        scan_files.read(tmp_path / "a.pcd", scan.sensor)
