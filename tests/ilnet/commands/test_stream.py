"""Streams from files and from a port of this machine, in this process."""

import json
import re
import socket
import threading
import time
import urllib.request

import pytest
import torch

from ilnet.commands import stream, viewer
from ilnet.scan import Scan
from ilnet.scan_files import bags
from ilnet.sensor import preset
from ilnet.world import simulate
from ilnet.world.simulate import pose

from ..scan_files import recorded

pytest.importorskip("rosbags", reason="needs the extra io")
pytest.importorskip("velodyne_decoder", reason="needs the extra io")

VLP16 = preset("vlp-16")
SIZE = ("--size", "32x900", "--model", "nearest")


@pytest.fixture(scope="module")
def packets(yard):
    """Five turns of a Velodyne, half a second."""
    scan = simulate.scan(yard, VLP16, pose((0.0, 0.0, 1.8)))
    return recorded.vlp16_packets([Scan(scan.ranges, VLP16, torch.zeros(VLP16.shape))] * 5)


@pytest.fixture
def capture(packets, tmp_path):
    (tmp_path / "in.pcap").write_bytes(recorded.pcap(packets))
    return tmp_path / "in.pcap"


def test_a_capture_is_played_at_its_rate_into_a_bag(command, capture, tmp_path):
    code, out, lines = command("stream", "in.pcap", *SIZE, "--from", "vlp-16", "--out", "out.mcap")
    assert code == 0, lines
    found = re.fullmatch(
        r"5 scan\(s\) in ([\d.]+) s: (\d) made denser \([\d.]+ a second, \d+ ms .*\), (\d) dropped\n", out
    )
    seconds, dense, dropped = float(found[1]), int(found[2]), int(found[3])
    assert seconds >= 0.4
    assert dense + dropped == 5
    with bags.Bag(tmp_path / "out.mcap") as bag:
        assert len(bag) == dense
        assert len(next(bag.cloud(message) for message in bag.messages()).points) > 10_000


def test_scans_are_dropped_rather_than_late(capture):
    delivered = []

    def slow(scan):
        time.sleep(0.25)
        return scan

    found = stream.run(str(capture), [lambda frame, scan: delivered.append(frame.time)], slow)
    assert found.scans == 5
    assert found.dropped >= 2
    assert found.dense == len(delivered) == 5 - found.dropped
    assert delivered == sorted(delivered)
    assert delivered[-1] > 0.39e9  # the newest is never dropped
    assert found.delay < 0.6


def test_packets_at_a_port_of_this_machine(packets):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]

    def send():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            time.sleep(0.3)
            for _, packet in packets:
                sender.sendto(packet, ("127.0.0.1", port))
                time.sleep(0.0005)

    thread, delivered = threading.Thread(target=send), []
    thread.start()
    take = lambda frame, scan: delivered.append((frame.time, scan))  # noqa: E731
    found = stream.run(f"udp://127.0.0.1:{port}", [take], lambda scan: scan, scans=2)
    thread.join()
    assert found.scans == 2
    assert abs(delivered[0][0] / 1e9 - time.time()) < 60
    assert (delivered[0][1].ranges > 0).sum() > 5000


def test_what_came_before_the_damage_is_kept(command, capture, tmp_path):
    capture.write_bytes(capture.read_bytes()[:350_000])
    code, _, lines = command("stream", "in.pcap", *SIZE, "--from", "vlp-16", "--out", "out.bag")
    assert code == 2
    assert "error: in.pcap: it was cut short after 276 packets" in lines
    with bags.Bag(tmp_path / "out.bag") as bag:
        assert 1 <= len(bag) <= 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("udp://:port", *SIZE, "--out", "out.bag"), "source is 'udp://:port'; it should be such as udp://:2368"),
        (("none.pcap", *SIZE, "--out", "out.bag"), "none.pcap: there is no such file"),
        (("in.pcap", "--out", "out.bag"), "give --size ROWSxCOLUMNS or --sensor NAME"),
        (("in.pcap", *SIZE, "--out", "out.ply"), "out is out.ply; it should be a folder, or end in .bag or .mcap"),
    ],
)
def test_bad_input_is_one_line(command, capture, tmp_path, arguments, message):
    code, out, lines = command("stream", *arguments)
    assert (code, out) == (2, "")
    assert lines == [f"error: {lines[-1][7:]}"]
    assert message in lines[0]
    assert [path.name for path in tmp_path.iterdir()] == ["in.pcap"]


def test_the_page_gets_the_newest_scan(yard):
    scan = simulate.scan(yard, VLP16, pose((0.0, 0.0, 1.8)))
    dense = Scan(scan.ranges, VLP16, confidence=(scan.ranges > 0) * 0.5)
    with viewer.Server(0) as server:

        def get(path):
            with urllib.request.urlopen(server.address + path, timeout=10) as answer:
                return answer.read().decode()

        assert '{"live": true}' in get("")
        stream.show(server, stream.Frame(0, scan), dense)
        first = json.loads(get("scene?after=-1"))
        threading.Timer(0.2, stream.show, (server, stream.Frame(0, scan), scan)).start()
        second = json.loads(get(f"scene?after={first['number']}"))
    assert [panel["title"] for panel in first["panels"]] == [
        "as it comes, 16x1800: height",
        "denser, 16x1800: height",
        "denser: confidence",
    ]
    assert first["clouds"][0]["count"] == (scan.ranges > 0).sum()
    assert len(second["panels"]) == 2
    assert second["number"] > first["number"]
