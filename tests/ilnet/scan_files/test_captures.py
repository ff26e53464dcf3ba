"""Captures that a sensor would have filled, read back."""

import importlib.util
import json
import struct

import numpy as np
import pytest
import torch

from ilnet.scan import Scan
from ilnet.scan_files import bags, captures, clouds, ouster
from ilnet.sensor import preset
from ilnet.world import simulate
from ilnet.world.simulate import pose

from . import recorded

pytest.importorskip("velodyne_decoder", reason="needs the extra io")

VLP16 = preset("vlp-16")
# It measures in steps of 2 mm, and its decoder knows that the lasers sit up to 11 mm above and below the middle.
VELODYNE_ERROR = 0.001 + 0.0112 * np.sin(np.deg2rad(15)) + 1e-4
PROFILES = ("LEGACY", "RNG19_RFL8_SIG16_NIR16", "RNG19_RFL8_SIG16_NIR16_DUAL", "RNG15_RFL8_NIR8")
OUSTER = preset("os1-32").resize(8, 64)


def measured(yard, sensor, x=0.0):
    scan = simulate.scan(yard, sensor, pose((x, 0.0, 1.8)))
    return Scan(scan.ranges, sensor, torch.rand(sensor.shape, generator=torch.Generator().manual_seed(0)))


@pytest.fixture(scope="module")
def turns(yard):
    return [measured(yard, VLP16, x) for x in (0.0, 0.5)]


@pytest.fixture
def capture(tmp_path):
    def write(packets, name="a.pcap", cut=None):
        (tmp_path / name).write_bytes(recorded.pcap(packets)[:cut])
        return tmp_path / name

    return write


def test_the_turns_of_a_velodyne(turns, capture):
    found = list(captures.sweeps(capture(recorded.vlp16_packets(turns))))
    assert len(found) == 2
    assert [round(sweep.time / 1e8) for sweep in found] == [0, 1]  # it turns ten times a second
    for (_, scan), turn in zip(found, turns, strict=True):
        assert scan.sensor == VLP16
        # The lasers of the later half of a column fire nearer to the next one, which lies to the right.
        away = torch.stack([(scan.ranges.roll(k, 1) - turn.ranges).abs() for k in (0, 1)]).amin(0)
        assert (away < VELODYNE_ERROR).float().mean() > 0.99
        assert scan.time.max() == pytest.approx(0.1, abs=0.01)
        strong = scan.intensity[scan.ranges > 0]
        assert 0.4 < strong.mean() < 0.6


def test_a_sensor_of_ones_own_replaces_the_preset(turns, capture):
    own = VLP16.resize(16, 900)
    [found] = captures.sweeps(capture(recorded.vlp16_packets(turns[:1])), own)
    assert found.scan.sensor == own


@pytest.mark.parametrize(
    "profile", ["LEGACY", "RNG19_RFL8_SIG16_NIR16", "RNG19_RFL8_SIG16_NIR16_DUAL", "RNG15_RFL8_NIR8"]
)
@pytest.mark.parametrize("nested", [True, False])
def test_the_turns_of_an_ouster(yard, capture, tmp_path, profile, nested):
    metadata = tmp_path / "a.json"
    metadata.write_text(recorded.ouster_metadata(OUSTER, profile, nested))
    turns = [measured(yard, OUSTER, x) for x in (0.0, 0.5)]
    path = capture(recorded.ouster_packets(turns, metadata.read_text()))  # longer than a frame: fragmented
    found = list(captures.sweeps(path, metadata=metadata))
    assert [sweep.time for sweep in found] == [100 * 10**9, 100 * 10**9 + 10**8]
    for (_, scan), turn in zip(found, turns, strict=True):
        np.testing.assert_allclose(scan.sensor.elevations, OUSTER.elevations)
        step = 0.008 if profile.startswith("RNG15") else 0.001
        assert (scan.ranges - turn.ranges).abs().max() <= step
        torch.testing.assert_close(scan.intensity, turn.intensity.where(turn.ranges > 0, 0), atol=0.002, rtol=0)
        assert scan.seen is None
        assert (scan.sensor.min_range, scan.sensor.max_range) == (0.5, 200)
        assert 0.09 < scan.time.max() < 0.1


def test_columns_that_were_lost_are_not_seen(yard, capture, tmp_path):
    metadata = tmp_path / "a.json"
    metadata.write_text(recorded.ouster_metadata(OUSTER))
    packets = list(recorded.ouster_packets([measured(yard, OUSTER)], metadata.read_text()))
    [found] = captures.sweeps(capture(packets[:1] + packets[2:]), metadata=metadata)
    assert (~found.scan.seen).sum() == 8 * 16


@pytest.mark.skipif(importlib.util.find_spec("ouster") is None, reason="needs ouster-sdk, which wants other versions")
@pytest.mark.parametrize("profile", PROFILES)
def test_ousters_own_packets_are_read_as_ouster_reads_them(tmp_path, profile):
    from ouster.sdk import core

    info = core.SensorInfo.from_default(core.LidarMode._1024x10)
    info.format.udp_profile_lidar = getattr(core.UDPProfileLidar, profile)
    (tmp_path / "a.json").write_text(info.to_json_string())
    metadata = ouster.Metadata(tmp_path / "a.json")
    frame, random = core.LidarFrame(info), np.random.default_rng(0)
    frame.field("RANGE")[:] = random.integers(500, 60000, (info.h, info.w)) // 8 * 8
    frame.field("REFLECTIVITY")[:] = random.integers(0, 256, (info.h, info.w))
    frame.status[:] = 0xFFFFFFFF if profile == "LEGACY" else 1
    frame.measurement_id[:] = np.arange(info.w)
    frame.timestamp[:] = 10**15 + np.arange(info.w) * 97000
    frame.packet_timestamp[:] = 10**18 + np.arange(len(frame.packet_timestamp))
    packets = core.frame_to_packets(frame, core.PacketFormat(info), 0, 0)
    scan = ouster.scan_of([ouster.columns_of(bytes(packet.buf), metadata) for packet in packets], metadata)
    np.testing.assert_allclose(scan.ranges, core.destagger(info, frame.field("RANGE")) / 1000, atol=1e-5)
    np.testing.assert_allclose(scan.intensity, core.destagger(info, frame.field("REFLECTIVITY")) / 255, atol=1e-6)
    theirs = core.destagger(info, np.asarray(core.XYZLut(info, False)(frame)).reshape(info.h, info.w, 3))
    ours = (scan.sensor.directions() * scan.ranges[..., None]).numpy()
    # Its points are in another frame: the origin lies 36 mm lower, and beams start 16 mm off the axis.
    assert np.abs(theirs - ours).max() < 0.045


def test_of_a_capture_that_was_cut_short_all_before_is_read(turns, capture):
    path = capture(recorded.vlp16_packets(turns), cut=150_000)
    sweeps = captures.sweeps(path)
    assert len([next(sweeps), next(sweeps)]) == 2
    with pytest.raises(ValueError, match=r"a\.pcap: it was cut short after 118 packets"):
        next(sweeps)


def test_a_capture_in_pcapng(turns, tmp_path):
    def block(kind, body):
        return struct.pack("<II", kind, 12 + len(body)) + body + struct.pack("<I", 12 + len(body))

    plain, file, at = recorded.pcap(recorded.vlp16_packets(turns[:1])), b"", 24
    file += block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)) + block(1, struct.pack("<HHI", 1, 0, 65535))
    while at < len(plain):
        seconds, fraction, size, _ = struct.unpack_from("<IIII", plain, at)
        time, frame = seconds * 10**6 + fraction, plain[at + 16 : at + 16 + size]
        head = struct.pack("<IIIII", 0, time >> 32, time & 0xFFFFFFFF, size, size)
        file += block(6, head + frame + b"\0" * (-size % 4))
        at += 16 + size
    (tmp_path / "a.pcapng").write_bytes(file)
    (tmp_path / "a.pcap").write_bytes(plain)
    [one], [other] = captures.sweeps(tmp_path / "a.pcapng"), captures.sweeps(tmp_path / "a.pcap")
    assert torch.equal(one.scan.ranges, other.scan.ranges)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"hello" * 100, "it is not a packet capture"),
        (b"", "it is not a packet capture"),
        (recorded.pcap([(0.0, b"something else")]), "it holds no packets of Velodyne: for an Ouster sensor, give its"),
        (recorded.pcap([(0.0, b"\0" * 1206)]), "its packets are of model 0x0; it should be one of .*vlp-16"),
    ],
)
def test_what_is_no_capture_of_a_sensor_is_refused_in_a_line(tmp_path, content, complaint):
    (tmp_path / "a.pcap").write_bytes(content)
    with pytest.raises(ValueError, match=rf"a\.pcap: {complaint}"):
        list(captures.sweeps(tmp_path / "a.pcap"))


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda found: found["beam_intrinsics"].pop("beam_altitude_angles"), "KeyError 'beam_altitude_angles'"),
        (lambda found: found["beam_intrinsics"]["beam_azimuth_angles"].pop(), "its tables of beams differ in length"),
        (lambda found: found["lidar_data_format"].update(columns_per_frame=10**9), "it has 1000000000 columns"),
        (lambda found: found["lidar_data_format"].update(udp_profile_lidar="NEW"), "its profile is 'NEW'; it should"),
    ],
)
def test_metadata_that_is_wrong_is_refused_in_a_line(tmp_path, change, complaint):
    found = json.loads(recorded.ouster_metadata(OUSTER))
    change(found)
    (tmp_path / "a.json").write_text(json.dumps(found))
    with pytest.raises(ValueError, match=rf"a\.json: .*{complaint}"):
        ouster.Metadata(tmp_path / "a.json")


def damaged(content, random):
    """Bytes cut off, left out, put in or overwritten, near the start as often as anywhere."""
    data, at = bytearray(content), int(random.integers(random.choice([40, 400, len(content)])))
    match random.integers(5):
        case 0:
            del data[random.integers(len(data)) :]
        case 1:
            del data[at : at + random.integers(1, 200)]
        case 2:
            data[at:at] = random.bytes(random.integers(1, 100))
        case 3:
            data[at : at + 4] = struct.pack("<I", random.choice([0, 1, 2**31 - 1, 2**32 - 1]))
        case 4:
            for place in random.integers(0, len(data), 20):
                data[place] = random.integers(256)
    return bytes(data)


@pytest.mark.parametrize(("kind", "times"), [("velodyne", 50), ("ouster", 200), ("bag", 200), ("mcap", 200)])
def test_damaged_recordings_are_refused_in_a_line(yard, tmp_path, kind, times):
    metadata = tmp_path / "a.json"
    metadata.write_text(recorded.ouster_metadata(OUSTER))
    scan = measured(yard, OUSTER)
    path = tmp_path / (f"a.{kind}" if kind in ("bag", "mcap") else "a.pcap")
    if kind == "velodyne":
        path.write_bytes(recorded.pcap(recorded.vlp16_packets([measured(yard, VLP16)])))
    elif kind == "ouster":
        path.write_bytes(recorded.pcap(recorded.ouster_packets([scan], metadata.read_text())))
    else:
        pytest.importorskip("rosbags", reason="needs the extra io")
        with bags.written(path) as bag:
            fields = {axis: np.dtype("<f4") for axis in "xyz"}
            cloud = clouds.pack(bags.blank(kind == "mcap", 0, "lidar"), scan, {}, fields)
            bag.write_cloud(bag.add("/points"), 0, cloud)

    def read():
        if path.suffix == ".pcap":
            return list(captures.sweeps(path, metadata=metadata if kind == "ouster" else None))
        with bags.Bag(path) as bag:
            return [bag.cloud(message).scan(OUSTER) for message in bag.messages()]

    whole, random, lines = path.read_bytes(), np.random.default_rng(0), []
    assert len(read()) == 1
    for _ in range(times):
        path.write_bytes(damaged(whole, random))
        try:
            read()
        except (ValueError, OSError) as error:
            lines.append(str(error))
    assert 0 < len(lines) < times
    assert max(map(len, lines)) < 600
    assert "\n" not in "".join(lines)
