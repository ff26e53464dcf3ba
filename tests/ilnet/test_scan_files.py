"""Files of scans: every format there and back, those of other programs, and those that are refused."""

import os
import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from ilnet import scan_files
from ilnet.scan import Scan
from ilnet.scan_files import read, write
from ilnet.scan_files.pcd import lzf
from ilnet.sensor import Sensor, preset

from .toy import ROUND_TRIP, SENSOR, bright, complete, predicted, toy

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "scans"
REAL = [
    "ouster_posedelta2_os1-128_2048_f0",
    "ouster_os1-128_1024_outdoor_f0",
    "ouster_os0-128_1024_f0",
    "ouster_os1-32_1024_f0",
]


# What a scan has beside its ranges


@pytest.mark.parametrize("name", ["a.npz", "a.ply", "a.pcd", "a.laz"])
@pytest.mark.parametrize("make", [toy, bright, predicted, complete])
def test_files_keep_what_returns_have(tmp_path, name, make):
    scan = make()
    write(tmp_path / name, scan)
    found = read(tmp_path / name, None if name == "a.npz" else SENSOR)
    precision = {"rtol": 0, "atol": 1e-5} if name == "a.laz" else ROUND_TRIP
    torch.testing.assert_close(found.ranges, scan.ranges, **precision)
    for of in ("intensity", "confidence", "time"):
        expected = getattr(scan, of)
        if expected is None:
            assert getattr(found, of) is None
        else:  # times are whole nanoseconds, and LAS has intensities of 16 bits
            tolerance = 1e-9 if of == "time" else 1e-5 if name == "a.laz" else 0
            torch.testing.assert_close(getattr(found, of), expected, rtol=0, atol=tolerance)
    if name == "a.npz":
        assert found.seen is None if scan.seen is None else torch.equal(found.seen, scan.seen)


def test_times_before_that_of_the_header_count_from_the_first(tmp_path):
    np.savez(tmp_path / "a.npz", range=toy().ranges.numpy(), time=complete().time.numpy() - 0.1)
    torch.testing.assert_close(read(tmp_path / "a.npz", SENSOR).time, complete().time, rtol=0, atol=1e-7)


@pytest.mark.parametrize("name", ["a.ply", "a.pcd", "a.laz", "a.bin"])
def test_other_libraries_read_what_we_write(tmp_path, name):
    """Each by the library that people would use."""
    scan = complete()
    write(tmp_path / name, scan)
    if name == "a.ply":
        found = pytest.importorskip("plyfile").PlyData.read(tmp_path / name)["vertex"]
    elif name == "a.pcd":
        found = pytest.importorskip("pypcd4").PointCloud.from_path(tmp_path / name).pc_data
    elif name == "a.laz":
        found = pytest.importorskip("laspy").read(tmp_path / name)
    else:
        kind = [(key, "<f4") for key in ("x", "y", "z", "intensity", "ring", "time")]
        found = np.fromfile(tmp_path / name, kind)
    measured = scan.ranges > 0
    points = np.stack([found[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(points, scan.points(), atol=6e-6 if name == "a.laz" else 0)
    np.testing.assert_array_equal(found["ring"], measured.nonzero()[:, 0])
    scale = 65535 if name == "a.laz" else 1
    np.testing.assert_allclose(found["intensity"], scale * scan.intensity[measured], atol=0.51 * (scale > 1))
    if name == "a.bin":
        np.testing.assert_allclose(found["time"], scan.time[measured], rtol=0, atol=1e-8)
    else:
        np.testing.assert_array_equal(found["t"], (scan.time[measured].double() * 1e9).round())
        np.testing.assert_array_equal(found["confidence"], scan.confidence[measured])


def test_a_scan_without_times_is_written_as_kitti_has_it(tmp_path):
    write(tmp_path / "a.bin", bright())
    found = np.fromfile(tmp_path / "a.bin", "<f4").reshape(-1, 4)
    np.testing.assert_array_equal(found[:, :3], bright().points())
    np.testing.assert_array_equal(found[:, 3], bright().intensity[bright().ranges > 0])


@pytest.mark.parametrize(("whole", "kind"), [(255, np.uint8), (65535, np.uint16), (255, ">f4"), (7e5, np.float64)])
def test_an_intensity_of_any_scale_becomes_a_share(tmp_path, whole, kind):
    intensity = (bright().intensity.double() * whole).round().numpy().astype(kind)
    intensity[2, 3] = whole
    np.savez(tmp_path / "a.npz", range=toy().ranges.numpy(), intensity=intensity)
    found = read(tmp_path / "a.npz", SENSOR).intensity
    torch.testing.assert_close(found[:2], bright().intensity[:2], rtol=0, atol=0.5 / whole)
    assert found.max() == 1


# Files: there and back


@pytest.mark.parametrize("where", ["a.npz", "new/folders/a.NPZ"])
def test_npz_is_lossless(tmp_path, where):
    write(tmp_path / where, toy())
    found = read(tmp_path / where)
    assert torch.equal(found.ranges, toy().ranges)
    assert found.sensor == SENSOR
    assert found.sensor.name == "toy"
    np.testing.assert_allclose(found.sensor.azimuths, SENSOR.azimuths, rtol=1e-15)


@pytest.mark.parametrize("name", ["a.ply", "a.pcd"])
def test_point_files(tmp_path, name):
    write(tmp_path / name, toy())
    found = read(str(tmp_path / name), SENSOR)
    torch.testing.assert_close(found.ranges, toy().ranges, **ROUND_TRIP)


def test_other_programs_read_our_ply(tmp_path):
    pyvista = pytest.importorskip("pyvista")
    write(tmp_path / "a.ply", toy())
    np.testing.assert_array_equal(pyvista.read(tmp_path / "a.ply").points, toy().points().numpy())


def test_we_read_the_ply_of_other_programs(tmp_path):
    pyvista = pytest.importorskip("pyvista")
    for binary in (True, False):
        pyvista.PolyData(toy().points().numpy()).save(tmp_path / "a.ply", binary=binary)
        torch.testing.assert_close(read(tmp_path / "a.ply", SENSOR).ranges, toy().ranges, rtol=1e-4, atol=0)


def test_a_failed_write_leaves_the_earlier_file(tmp_path, monkeypatch):
    write(tmp_path / "a.npz", toy())
    before = (tmp_path / "a.npz").read_bytes()

    def fail(file, scan):
        file.write(b"half of it")
        raise OSError("disk full")

    monkeypatch.setitem(scan_files._WRITERS, ".npz", fail)
    with pytest.raises(OSError, match="disk full"):
        write(tmp_path / "a.npz", toy())
    assert (tmp_path / "a.npz").read_bytes() == before
    assert os.listdir(tmp_path) == ["a.npz"]


def test_write_to_an_unknown_suffix(tmp_path):
    with pytest.raises(ValueError, match=r"a\.xyz: its suffix is '\.xyz'; it should be one of \.npz, \.ply, \.pcd"):
        write(tmp_path / "sub" / "a.xyz", toy())
    assert os.listdir(tmp_path) == []


# Files of others


@pytest.mark.skipif(not SHARED.is_dir(), reason=f"the real scans are not there: {SHARED}")
@pytest.mark.parametrize("name", REAL)
def test_real_scans(name):
    found = read(SHARED / f"{name}.npz")
    with np.load(SHARED / f"{name}.npz") as file:
        np.testing.assert_array_equal(found.ranges, file["range"])
        np.testing.assert_allclose(np.rad2deg(found.sensor.elevations), file["elevation_deg"], atol=1e-5)
        turns = (np.rad2deg(found.sensor.azimuths) - file["column_azimuth_deg"]) / 360
    np.testing.assert_allclose(turns, turns.round(), atol=1e-7)
    assert found.sensor.wrap
    assert (np.diff(found.sensor.azimuths) < 0).all()
    assert (found.sensor.min_range, found.sensor.max_range, found.sensor.norm_range) == (2, 80, 100)
    back = Scan.from_points(found.points(), found.sensor)
    torch.testing.assert_close(back.ranges, found.ranges, **ROUND_TRIP)


def test_npz_sensor_overrides(tmp_path):
    other = Sensor(SENSOR.elevations / 2, SENSOR.azimuths, name="other")
    write(tmp_path / "a.npz", toy())
    assert read(tmp_path / "a.npz", other).sensor is other
    np.savez(tmp_path / "bare.npz", range=toy().ranges.numpy())
    assert read(tmp_path / "bare.npz", other).sensor is other
    with pytest.raises(
        ValueError, match=r"a\.npz: ranges has shape \(4, 4\); it should be \(16, 1800\), the shape of Sensor\(vlp-16"
    ):
        read(tmp_path / "a.npz", preset("vlp-16"))


def test_npy(tmp_path):
    np.save(tmp_path / "image.npy", toy().ranges.numpy().astype(np.float64))
    assert torch.equal(read(tmp_path / "image.npy", SENSOR).ranges, toy().ranges)
    points = toy().points().numpy()
    np.save(tmp_path / "points.npy", np.column_stack((points, np.full(len(points), 99))))
    torch.testing.assert_close(read(tmp_path / "points.npy", SENSOR).ranges, toy().ranges, **ROUND_TRIP)
    np.save(tmp_path / "odd.npy", np.ones((4, 100)))
    with pytest.raises(ValueError, match=r"its shape \(4, 100\) is neither ranges of Sensor\(toy.*nor points"):
        read(tmp_path / "odd.npy", SENSOR)


def test_kitti(tmp_path):
    sensor = preset("hdl-64e")
    ranges = torch.zeros(sensor.shape)
    ranges[5, 100], ranges[60, 2000] = 30, 8
    points = Scan(ranges, sensor).points().numpy()
    np.column_stack((points, [0.2, 0.9])).astype("<f4").tofile(tmp_path / "a.bin")
    found = read(tmp_path / "a.bin")
    assert found.sensor == sensor
    torch.testing.assert_close(found.ranges, ranges, **ROUND_TRIP)
    assert found.intensity[5, 100].item() == pytest.approx(0.2)
    assert found.intensity[60, 2000].item() == pytest.approx(0.9)
    assert read(tmp_path / "a.bin", preset("paper-16x1024")).sensor == preset("paper-16x1024")


def pcd(fields: str, sizes: str, types: str, counts: str | None, points: int, data: str, body: bytes) -> bytes:
    count_line = f"COUNT {counts}\n" if counts else ""
    return (
        f"# a comment\nVERSION .7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\n{count_line}"
        f"WIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {data}\n"
    ).encode() + body


def test_pcd_ascii(tmp_path):
    rows = "".join(f"1 2 {z!r} 51 {x!r} {y!r}\n" for x, y, z in toy().points().tolist())
    body = f"1 2 nan 77 nan nan\n{rows}".encode()
    count, fields = len(toy().points()) + 1, "n z intensity x y"
    (tmp_path / "a.pcd").write_bytes(pcd(fields, "4 4 4 4 4", "F F U F F", "2 1 1 1 1", count, "ascii", body))
    found = read(tmp_path / "a.pcd", SENSOR)
    torch.testing.assert_close(found.ranges, toy().ranges, **ROUND_TRIP)
    torch.testing.assert_close(found.intensity, (toy().ranges > 0) * 0.2)


# x, y and z out of order, of three widths, among padding that PCL names "_" more than once.
PCD_FIELDS = ("_ z intensity _ x y", "1 8 2 1 4 4", "U F U U F F", "4 1 1 3 1 1")
PCD_RECORD = np.dtype([("p", "u1", 4), ("z", "<f8"), ("i", "<u2"), ("q", "u1", 3), ("x", "<f4"), ("y", "<f4")])


def pcd_records() -> np.ndarray:
    records = np.full(len(toy().points()), 77).astype(PCD_RECORD)
    records["x"], records["y"], records["z"] = toy().points().numpy().T
    return records


def test_pcd_binary(tmp_path):
    records = pcd_records()
    (tmp_path / "a.pcd").write_bytes(pcd(*PCD_FIELDS, len(records), "binary", records.tobytes()))
    found = read(tmp_path / "a.pcd", SENSOR)
    torch.testing.assert_close(found.ranges, toy().ranges, **ROUND_TRIP)
    torch.testing.assert_close(found.intensity, (toy().ranges > 0) * (77 / 255))


def test_pcd_binary_compressed(tmp_path):
    records = pcd_records()
    columns = b"".join(np.ascontiguousarray(records[name]).tobytes() for name in PCD_RECORD.names)
    # LZF with literal runs only: each is its length less one, then up to 32 bytes.
    runs = [columns[i : i + 32] for i in range(0, len(columns), 32)]
    packed = b"".join(bytes([len(run) - 1]) + run for run in runs)
    body = struct.pack("<II", len(packed), len(columns)) + packed
    (tmp_path / "a.pcd").write_bytes(pcd(*PCD_FIELDS, len(records), "binary_compressed", body))
    found = read(tmp_path / "a.pcd", SENSOR)
    torch.testing.assert_close(found.ranges, toy().ranges, **ROUND_TRIP)
    torch.testing.assert_close(found.intensity, (toy().ranges > 0) * (77 / 255))


def test_lzf_copies():
    """Copies, by hand: 3 bits of length less 2 (7: a byte more follows), 13 bits of distance less 1."""
    copy_4_from_3_back = bytes([(2 << 5) | 0, 2])
    assert lzf(b"\x02abc" + copy_4_from_3_back, 7) == b"abcabca"  # reads what it writes
    copy_20_from_1_back = bytes([(7 << 5) | 0, 11, 0])
    assert lzf(b"\x00z" + copy_20_from_1_back + b"\x00!", 22) == b"z" * 21 + b"!"
    far = bytes(range(256)) + bytes(64)
    literals = b"".join(b"\x1f" + far[i : i + 32] for i in range(0, 320, 32))
    copy_3_from_300_back = bytes([(1 << 5) | (299 >> 8), 299 & 255])
    assert lzf(literals + copy_3_from_300_back, 323) == far + bytes([20, 21, 22])
    for damaged in (b"\x20\x05", b"\x00a\xe0", b"\x05abc", b"\x00a\x20"):
        with pytest.raises(ValueError, match="compressed data is damaged"):
            lzf(damaged, 6)


def test_ply_ascii_and_big_endian(tmp_path):
    points = toy().points().numpy()
    header = (
        "ply\nformat {}\ncomment with words\nelement vertex {}\nproperty uchar red\nproperty double z\n"
        "property float x\nproperty float32 y\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"
    )
    text = "".join(f"255 {z!r} {x!r} {y!r}\n" for x, y, z in points.tolist())
    (tmp_path / "a.ply").write_text(header.format("ascii 1.0", len(points)) + text)
    torch.testing.assert_close(read(tmp_path / "a.ply", SENSOR).ranges, toy().ranges, **ROUND_TRIP)
    records = np.zeros(len(points), np.dtype([("red", "u1"), ("z", ">f8"), ("x", ">f4"), ("y", ">f4")]))
    records["x"], records["y"], records["z"] = points.T
    (tmp_path / "b.ply").write_bytes(header.format("binary_big_endian 1.0", len(points)).encode() + records.tobytes())
    torch.testing.assert_close(read(tmp_path / "b.ply", SENSOR).ranges, toy().ranges, **ROUND_TRIP)


# Files that are refused


def npz(path: Path, **changes) -> None:
    arrays = {"range": np.ones((2, 3), np.float32), "elevation_deg": [0, 1], "column_azimuth_deg": [0, 1, 2], **changes}
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})


PLY = "ply\nformat {}\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
XYZ = ("x y z", "4 4 4", "F F F", "1 1 1")


def pickled() -> np.ndarray:
    return np.array([{"never": "unpickled"}], dtype=object)


@pytest.mark.parametrize(
    ("name", "make", "message"),
    [
        ("a.npz", lambda p: npz(p, range=None), "lacks range; its keys are elevation_deg, column_azimuth_deg"),
        ("a.npz", lambda p: npz(p, elevation_deg=None), "lacks elevation_deg; .*add them or pass a sensor"),
        ("a.npz", lambda p: npz(p, range=np.full((2, 3), np.nan)), "holds no return"),
        ("a.npz", lambda p: npz(p, range=np.zeros((2, 3))), "holds no return"),
        ("a.npz", lambda p: npz(p, range=np.full((2, 3), "far")), "range is of dtype .*; it should hold real numbers"),
        ("a.npz", lambda p: npz(p, range=pickled()), "allow_pickle=False"),
        ("a.npz", lambda p: npz(p, range=np.ones((3, 2))), r"shape \(3, 2\); it should be \(2, 3\)"),
        ("a.npz", lambda p: npz(p, elevation_deg=[0, 0]), "elevations is not sorted"),
        ("a.npz", lambda p: npz(p, max_range=[1, 2]), "max_range is array.*; it should be a number"),
        ("a.npz", lambda p: p.write_bytes(b"PK\x03\x04 and then nothing"), "not a whole .npz archive"),
        ("a.npz", lambda p: p.write_text("text"), "not a whole .npz archive"),
        ("a.npz", lambda p: p.write_bytes(b""), "not a whole .npz archive"),
        (
            "a.npz",
            lambda p: [npz(p), p.write_bytes(p.read_bytes().replace(b"NUMPY", b"NUMPX", 1))],
            "cannot be unpacked",
        ),
        ("a.npy", lambda p: np.save(p, pickled()), "allow_pickle=False"),
        ("a.npy", lambda p: p.write_text("text"), "not a whole .npy file"),
        ("a.npy", lambda p: p.write_bytes(b""), "not a whole .npy file"),
        ("a.npy", lambda p: [np.save(p, np.ones((4, 4))), p.write_bytes(p.read_bytes()[:-9])], "not a whole .npy file"),
        ("a.npy", lambda p: [npz(p), p.with_name("a.npy.npz").rename(p)], "not a whole .npy file"),
        ("a.bin", lambda p: p.write_bytes(bytes(44)), "44 bytes are not whole points of 3 to 6 float32"),
        ("a.bin", lambda p: p.write_bytes(b""), "0 bytes are not whole points"),
        ("a.bin", lambda p: p.write_bytes(bytes(32)), "holds no plausible coordinates"),
        ("a.ply", lambda p: p.write_text("hello\nthis is text\n"), "not a PLY file"),
        ("a.ply", lambda p: p.write_bytes(b""), "not a PLY file"),
        ("a.ply", lambda p: p.write_text("ply\nformat ascii 1.0\n"), "no line 'end_header'"),
        (
            "a.ply",
            lambda p: p.write_text(PLY.format("ascii 1.0", 2) + "5 0 0\n"),
            "2 points take 12 bytes",
        ),
        ("a.ply", lambda p: p.write_text(PLY.format("ascii 1.0", 0)), "it holds no points"),
        ("a.ply", lambda p: p.write_text(PLY.format("ascii 1.0", 1) + "5 zero 0\n"), "could not convert"),
        (
            "a.ply",
            lambda p: p.write_text(PLY.format("binary_middle_endian 1.0", 1)),
            "format is 'binary_middle_endian'; it should be one of ascii",
        ),
        (
            "a.ply",
            lambda p: p.write_text(PLY.replace("float z", "float w").format("ascii 1", 1) + "1 2 3\n"),
            "fields are x, y, w;",
        ),
        (
            "a.ply",
            lambda p: p.write_text(PLY.replace("float z", "list int int z").format("ascii 1", 1) + "1 2 1 3\n"),
            "vertices have a list; they should have numbers only",
        ),
        ("a.ply", lambda p: p.write_text(PLY.replace("vertex", "edge").format("ascii 1", 1)), "elements are edge"),
        (
            "a.ply",
            lambda p: p.write_bytes(PLY.format("binary_little_endian 1.0", 3).encode() + bytes(35)),
            "3 points take 36 bytes, 35 are there",
        ),
        ("a.pcd", lambda p: p.write_text("VERSION .7\n"), "no line 'DATA'"),
        ("a.pcd", lambda p: p.write_text("FIELDS x y z\nDATA ascii\n"), "header lacks SIZE, TYPE$"),
        ("a.pcd", lambda p: p.write_bytes(pcd(*XYZ, 3, "binary", bytes(30))), "3 points take 36 bytes, 30 are there"),
        (
            "a.pcd",
            lambda p: p.write_bytes(pcd(*XYZ, 3, "zip", b"")),
            "DATA is 'zip'; it should be one of ascii, binary",
        ),
        (
            "a.pcd",
            lambda p: p.write_bytes(pcd("x y", "4 4", "F F", None, 1, "binary", bytes(8))),
            "fields are x, y; x, y and z should be among them$",
        ),
        ("a.pcd", lambda p: p.write_bytes(pcd("x y z", "4 4", "F F F", None, 1, "ascii", b"")), "contradicts itself"),
        ("a.pcd", lambda p: p.write_bytes(pcd("x y z", "4 4 4", "O F F", None, 1, "ascii", b"")), "contradicts itself"),
        (
            "a.pcd",
            lambda p: p.write_bytes(pcd(*XYZ, 1, "binary_compressed", struct.pack("<II", 3, 12) + b"\x05ab")),
            "data is damaged: 2 bytes came out, not 12",
        ),
        (
            "a.pcd",
            lambda p: p.write_bytes(pcd(*XYZ, 1, "binary_compressed", struct.pack("<II", 3, 13) + b"\x05ab")),
            "its 1 points take 12 bytes, but its data says 13",
        ),
        (
            "a.txt",
            lambda p: p.write_text("1 2 3"),
            r"suffix is '\.txt'; it should be one of .npz, .npy, .bin, .ply, .pcd",
        ),
        ("noend", lambda p: p.write_text("1 2 3"), "suffix is ''"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_refused_files(tmp_path, capfd, name, make, message):
    path = tmp_path / name
    make(path)
    sensor = None if path.suffix in (".npz", ".bin") else SENSOR
    with pytest.raises(ValueError, match=message) as caught:
        read(path, sensor)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["a.npy", "a.ply", "a.pcd"])
def test_files_that_need_a_sensor(tmp_path, name):
    if name == "a.npy":
        np.save(tmp_path / name, np.ones((4, 4)))
    else:
        write(tmp_path / name, toy())
    with pytest.raises(ValueError, match=f"{name}: it does not hold the angles of its rays; name the sensor"):
        read(tmp_path / name)


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"^\S+gone\.npz: there is no such file$"):
        read(tmp_path / "gone.npz")
    with pytest.raises(IsADirectoryError, match="is a folder; it should be one of the files in it"):
        read(tmp_path)


@pytest.mark.filterwarnings("error")
def test_damage_anywhere_is_one_kind_of_error(tmp_path):
    """Files with bytes overwritten or cut off either still read, or raise what `read` documents."""
    rng = np.random.default_rng(3)
    for suffix in (".npz", ".ply", ".pcd"):
        path = tmp_path / f"a{suffix}"
        write(path, predicted())
        whole = path.read_bytes()
        refused = 0
        for _ in range(150):
            damaged = bytearray(whole)
            for at in rng.integers(0, len(whole), 4):
                damaged[at] = rng.integers(0, 256)
            path.write_bytes(damaged[: rng.integers(1, len(whole) + 1)] if rng.random() < 0.3 else damaged)
            try:
                read(path, None if suffix == ".npz" else SENSOR)
            except ValueError as error:
                refused += str(error).startswith(f"{path}: ")
        assert refused > 30
