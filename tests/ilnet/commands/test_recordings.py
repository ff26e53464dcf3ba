"""Drives as bags and captures, upsampled by one command, in this process."""

import re
import shutil
import sqlite3
import sys

import numpy as np
import pytest
import torch

from ilnet import models, scan_files
from ilnet.scan import Scan
from ilnet.scan_files import bags, clouds
from ilnet.sensor import preset
from ilnet.world import simulate
from ilnet.world.simulate import pose

from ..scan_files import recorded

pytest.importorskip("rosbags", reason="needs the extra io")

SENSOR = preset("paper-16x1024").resize(8, 128)
TARGET = SENSOR.resize(16, 256)
SCANS = 6
START = 1_700_000_000_123_456_789
POINTS, NAMES = "/lidar/points", {"x": "<f4", "y": "<f4", "z": "<f4", "intensity": "<f4", "ring": "<u2", "t": "<u4"}


@pytest.fixture(scope="session")
def drive(yard):
    """Scans of a sensor that drives ahead."""
    scans = [simulate.scan(yard, SENSOR, pose((0.5 * number, 0.0, 1.8))) for number in range(SCANS)]
    return [Scan(scan.ranges, SENSOR, torch.full(SENSOR.shape, 0.25)) for scan in scans]


def write_bag(path, drive, mcap=False, empty=()):
    """A bag of clouds, with text and times between them and a second topic of clouds."""
    ros2 = path.suffix != ".bag"
    grid = np.meshgrid(np.arange(8), np.arange(128), indexing="ij")
    with bags.written(path, mcap) as bag:
        types = bag._types.types
        points, text, other = bag.add(POINTS), bag.add("/chat", "std_msgs/msg/String"), bag.add("/other/points")
        clock = bag.add("/clock", "builtin_interfaces/msg/Time" if ros2 else "std_msgs/msg/String")
        pack = bag._types.serialize_cdr if ros2 else bag._types.serialize_ros1
        for number, scan in enumerate(drive):
            time = START + number * 10**8
            values = {"intensity": scan.intensity.numpy() * 255, "ring": grid[0], "t": grid[1] * 781250}
            message = bags.blank(ros2, time - 50_000_000, "velodyne")
            if number not in empty:
                kinds = {name: np.dtype(kind) for name, kind in NAMES.items()}
                message = clouds.pack(message, scan, values, kinds)
            bag.write_cloud(points, time, message)
            hello = types["std_msgs/msg/String"](f"hello {number}")
            bag.write(text, time + 1, pack(hello, "std_msgs/msg/String"))
            if number == 2:
                bag.write_cloud(other, time + 2, message)
        assert clock


def contents(path):
    with bags.Bag(path) as bag:
        found = {}
        for message in bag.messages():
            found.setdefault(message.connection.topic, []).append((message.time, bytes(message.data)))
        types = {connection.topic: connection.msgtype for connection in bag.connections}
        sweeps = [bag.cloud(message) for message in bag.messages() if message.connection.topic == POINTS]
    return types, found, sweeps


@pytest.fixture
def run(command):
    def run(*arguments):
        code, out, lines = command("upsample", *arguments)
        return code, out, [line for line in lines if line.startswith(("error: ", "warning: "))]

    return run


@pytest.fixture(scope="session")
def own_sensor(tmp_path_factory):
    """A file with the angles of the sensor of the drive."""
    path = tmp_path_factory.mktemp("sensor") / "own.json"
    from ilnet import sensor_files

    sensor_files.write(path, SENSOR)
    return path


@pytest.mark.parametrize(
    ("source", "out", "mcap"),
    [("in.bag", "out.bag", False), ("in.mcap", "out.mcap", True), ("in", "out", False), ("in", "out", True)],
)
def test_a_drive_becomes_a_denser_drive(run, drive, own_sensor, tmp_path, source, out, mcap):
    write_bag(tmp_path / source, drive, mcap)
    options = ("--topic", POINTS, "--from", own_sensor, "--size", "16x256", "--model", "planes")
    assert run(source, out, *options) == (0, f"{SCANS} scan(s) written to {out}\n", [])
    types, before, sparse = contents(tmp_path / source)
    types_after, after, dense = contents(tmp_path / out)
    assert types_after == types
    assert after.keys() == before.keys() == {POINTS, "/chat", "/other/points"}
    for topic in before.keys() - {POINTS}:
        assert after[topic] == before[topic]
    assert [time for time, _ in after[POINTS]] == [time for time, _ in before[POINTS]]
    model = models.load("planes")
    for scan, old, new in zip(drive, sparse, dense, strict=True):
        assert new.message.header == old.message.header
        assert new.message.header.frame_id == "velodyne"
        assert [field.name for field in new.message.fields] == list(NAMES)
        expected = model.upsample(scan, TARGET)
        torch.testing.assert_close(new.scan(TARGET).ranges, expected.ranges, atol=2e-3, rtol=1e-3)
        measured = expected.ranges > 0
        assert float((new.scan(TARGET).intensity[measured] - 0.25).abs().max()) < 0.01
    kept = sorted(path.name for path in tmp_path.iterdir())
    assert kept == sorted([source, out])
    if (tmp_path / out).is_dir():
        inside = {path.suffix for path in (tmp_path / out).iterdir()}
        assert inside == {".yaml", ".mcap" if mcap else ".db3"}


def test_a_drive_without_definitions(run, drive, own_sensor, tmp_path):
    """Bags of ROS 2 from before 2023 do not say what their messages hold."""
    write_bag(tmp_path / "in", drive[:1])
    with sqlite3.connect(tmp_path / "in" / "in.db3") as base:
        base.execute("DELETE FROM message_definitions")
    options = ("--topic", POINTS, "--from", own_sensor, "--size", "16x256", "--model", "nearest")
    assert run("in", "out", *options)[0] == 0
    assert contents(tmp_path / "out")[1]["/chat"] == contents(tmp_path / "in")[1]["/chat"]


def test_a_cloud_of_no_points_passes_as_it_is(run, drive, own_sensor, tmp_path):
    write_bag(tmp_path / "in.mcap", drive[:3], empty=[1])
    options = ("--topic", POINTS, "--from", own_sensor, "--size", "16x256", "--model", "nearest")
    code, out, [error, warning] = run("in.mcap", "out.mcap", *options)
    assert (code, out) == (2, "2 scan(s) written to out.mcap, 1 could not be: see above\n")
    assert "in.mcap: none of 0 points" in error
    assert warning == "warning: 1 cloud(s) were written as they were"
    before, after = contents(tmp_path / "in.mcap")[1][POINTS], contents(tmp_path / "out.mcap")[1][POINTS]
    assert after[1] == before[1]
    assert len(after) == 3


def test_a_capture_becomes_files_or_a_bag(run, yard, tmp_path):
    sensor = preset("vlp-16")
    scan = simulate.scan(yard, sensor, pose((0.0, 0.0, 1.8)))
    scan = Scan(scan.ranges, sensor, torch.full(sensor.shape, 0.5))
    (tmp_path / "in.pcap").write_bytes(recorded.pcap(recorded.vlp16_packets([scan] * 2)))
    options = ("--size", "32x900", "--model", "nearest")
    assert run("in.pcap", "files", *options, "--format", "ply") == (0, "2 scan(s) written to files\n", [])
    assert sorted(path.name for path in (tmp_path / "files").iterdir()) == ["000000.ply", "000001.ply"]
    dense = scan_files.read(tmp_path / "files" / "000001.ply", sensor.resize(32, 900))
    for out in ("out.bag", "out.mcap"):
        assert run("in.pcap", out, *options) == (0, f"2 scan(s) written to {out}\n", [])
        with bags.Bag(tmp_path / out) as bag:
            assert bag.cloud_topic() == "/points"
            first, second = (bag.cloud(message) for message in bag.messages())
        assert [field.name for field in first.message.fields] == ["x", "y", "z", "intensity", "ring", "time"]
        assert second.message.header.stamp.nanosec - first.message.header.stamp.nanosec == pytest.approx(1e8, rel=0.02)
        torch.testing.assert_close(second.scan(dense.sensor).ranges, dense.ranges, atol=1e-3, rtol=0)
        assert float(second.points["time"].max()) == pytest.approx(0.1, abs=0.01)


def test_of_a_capture_cut_short_all_before_is_written(run, yard, tmp_path):
    scan = simulate.scan(yard, preset("vlp-16"), pose((0.0, 0.0, 1.8)))
    scan = Scan(scan.ranges, scan.sensor, torch.zeros(scan.sensor.shape))
    (tmp_path / "in.pcap").write_bytes(recorded.pcap(recorded.vlp16_packets([scan] * 2))[:150_000])
    code, out, [error] = run("in.pcap", "out.mcap", "--size", "32x900", "--model", "nearest")
    assert (code, out) == (2, "2 scan(s) written to out.mcap, 1 could not be: see above\n")
    assert error == "error: in.pcap: it was cut short after 118 packets"
    with bags.Bag(tmp_path / "out.mcap") as bag:
        assert len(bag) == 2


SIZE = ("--size", "16x256", "--model", "nearest")
TOPIC, FROM = ("--topic", POINTS), ("--from", "vlp-16")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("in.mcap", "out.mcap", *SIZE, *TOPIC),
            "in.mcap: a cloud does not hold the angles .*: --from NAME",
        ),
        (
            ("in.mcap", "out.mcap", *SIZE, *FROM),
            "topic is not named; it should be one of .*/other/points",
        ),
        (
            ("in.mcap", "out.mcap", *SIZE, "--topic", "/chat", *FROM),
            r"topic is '/chat'; it should be one of .* All topics: /chat \(std_msgs/String\), /clock",
        ),
        (
            ("in.mcap", "out.bag", *SIZE, *TOPIC, *FROM),
            "out is out.bag; it should be a folder or end in .mcap",
        ),
        (("in.mcap", "in.mcap", *SIZE, *TOPIC, *FROM), "out is in.mcap, the recording to be read"),
        (("in.mcap", "there", *SIZE, *TOPIC, *FROM), "there: it exists already; it should be a new name"),
        (
            ("text.mcap", "out.mcap", *SIZE, *FROM),
            r"no topic of sensor_msgs/PointCloud2; its topics are /chat",
        ),
        (("cut.mcap", "out.mcap", *SIZE, *FROM), "cut.mcap: it cannot be read as a bag"),
        (("cut.bag", "out.bag", *SIZE, *FROM), "cut.bag: it cannot be read as a bag"),
        (("none.bag", "out.bag", *SIZE, *FROM), "none.bag: there is no such file"),
        (("none.pcap", "out", *SIZE), "none.pcap: there is no such file"),
        (("empty.pcap", "out", *SIZE), "empty.pcap: it is not a packet capture"),
        (("empty.pcap", "out.ply", *SIZE), "out is out.ply; it should be a folder, or end in .bag or .mcap"),
        (("empty.pcap", "out", *SIZE, "--metadata", "none.json"), "none.json"),
        (("frame.npz", "out.npz", *SIZE, *TOPIC), "--topic, --metadata and --precision go with a bag or a capture"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(run, drive, tmp_path, arguments, message):
    write_bag(tmp_path / "in.mcap", drive[:1])
    with bags.written(tmp_path / "text.mcap") as bag:
        bag.add("/chat", "std_msgs/msg/String")
    for name in ("cut.mcap", "cut.bag"):
        (tmp_path / name).write_bytes((tmp_path / "in.mcap").read_bytes()[:5000])
    (tmp_path / "empty.pcap").write_bytes(b"")
    (tmp_path / "there").mkdir()
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    code, out, [error] = run(*arguments)
    assert (code, out) == (2, "")
    assert re.search(message, error), error
    shutil.rmtree(tmp_path / "out", ignore_errors=True)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before


def test_without_the_extra_a_line_says_so(run, monkeypatch, tmp_path):
    (tmp_path / "in.bag").write_bytes(b"")
    (tmp_path / "in.pcap").write_bytes(b"")
    for name in ("rosbags", "velodyne_decoder"):
        monkeypatch.setitem(sys.modules, name, None)
    assert "pip install 'ilnet[io]'" in run("in.bag", "out.bag", *SIZE, *FROM)[2][0]
    assert "pip install 'ilnet[io]'" in run("in.pcap", "out", *SIZE)[2][0]
