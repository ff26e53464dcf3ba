import json

import numpy as np
import pytest
import torch

from ilnet.commands.cli import cli
from ilnet.learning import kitti
from ilnet.scan import Scan
from ilnet.world import simulate

PLAIN = kitti.SPHERICAL


def directions(elevation, azimuth):
    elevation, azimuth = np.deg2rad(elevation), np.deg2rad(azimuth)
    return np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1)


def test_spherical_projection_counts_rows_from_below_and_keeps_the_last_point():
    rows = np.array([0, 5, 5, 63])
    points = directions(-24.8 + rows * 26.8 / 63, np.zeros(4)) * np.array([[10.0], [20.0], [30.0], [40.0]])
    ranges = kitti.project(points, "spherical").ranges
    assert ranges.nonzero().tolist() == [[0, 512], [5, 512], [63, 512]]
    torch.testing.assert_close(ranges[[0, 5, 63], 512], torch.tensor([10.0, 30.0, 40.0]))


def test_projection_by_beams_uses_the_sensors_own_table_and_keeps_the_nearest_point():
    points = directions(np.array([-8 - 5 / 6, -8 - 5 / 6, 2.0]), np.zeros(3)) * np.array([[9.0], [7.0], [50.0]])
    scan = kitti.project(points, "beams")
    found = {(round(float(np.rad2deg(scan.sensor.elevations[row])), 2)): r for row, r in rows_of(scan)}
    assert found == pytest.approx({-8.83: 7.0, 2.0: 50.0})


def rows_of(scan):
    return [(row, float(scan.ranges[row, column])) for row, column in scan.ranges.nonzero().tolist()]


@pytest.mark.parametrize("projection", kitti.PROJECTIONS)
def test_points_out_of_reach_are_dropped(projection):
    points = directions(np.array([-5.0, -5.0]), np.array([0.0, 90.0])) * np.array([[20.0], [130.0]])
    assert (kitti.project(points, projection).ranges > 0).sum() == 1
    with pytest.raises(ValueError, match="view"):
        kitti.project(points[1:], projection)


def two_pixels(one, other):
    """Returns ranges with a measured pixel in row 4 and an unmeasured one in row 5."""
    ranges = torch.zeros(PLAIN.shape)
    ranges[4, 512], ranges[5, 512] = one, other
    return ranges


def test_the_literatures_convention_by_hand():
    truth = Scan(two_pixels(10.0, 20.0), PLAIN)
    found = kitti.conventional(two_pixels(11.0, 22.0), truth)
    count = PLAIN.shape[0] * PLAIN.shape[1]
    assert found["mae"] == pytest.approx((1 + 2) / count)  # empty pixels count as well
    # Pasted, the point of row 4 is right. Voxels: the origin, 10 m and 20 m against the origin, 10 m and 22 m.
    assert found["iou"] == pytest.approx(2 / 4)
    # Of all points only one in each cloud is 2 m off; all others, most at the origin, have a twin.
    assert found["chamfer"] == pytest.approx(2 * 2.0**2 / count, rel=1e-4)


def test_our_convention_by_hand():
    truth = Scan(two_pixels(10.0, 20.0), PLAIN)
    found = kitti.unmeasured(two_pixels(11.0, 22.0), truth)
    assert found == pytest.approx({"mae": 2.0, "iou": 0.0, "chamfer": 2.0 + 2.0, "unseen": 0}, rel=1e-4)
    assert kitti.unmeasured(truth.ranges, truth) == pytest.approx({"mae": 0.0, "iou": 1.0, "chamfer": 0.0, "unseen": 0})


@pytest.fixture
def drive(yard, tmp_path):
    for number in range(2):
        scan = simulate.scan(yard, kitti.PROJECTIONS["beams"], simulate.pose((0.5 * number, 0.0, 1.7)))
        points = scan.points().numpy()
        np.column_stack((points, np.zeros(len(points)))).astype("<f4").tofile(tmp_path / f"{number:06}.bin")
    (tmp_path / "times.txt").write_text("0\n")
    return tmp_path


def run(capsys, *words):
    cli.main(["evaluate", "--protocol", "kitti", *map(str, words)], standalone_mode=False)
    return capsys.readouterr().out


def test_a_folder_on_the_command_line(drive, capsys):
    arguments = drive, "--model", "nearest", "--model", "bilinear-inverse"
    found = json.loads(run(capsys, *arguments, "--json"))
    assert [(row["model"], row["scans"]) for row in found] == [("nearest", 2), ("bilinear-inverse", 2)]
    assert found[1]["beams unmeasured"]["iou"] > found[0]["beams unmeasured"]["iou"]  # most of the yard is a plane
    for row in found:
        assert row["iou"] > row["spherical unmeasured"]["iou"]  # a quarter of the rows is pasted in
        assert row["mae"] == pytest.approx(np.mean([file["spherical"]["mae"] for file in row["files"]]))
    assert "bilinear-inverse" in run(capsys, *arguments)


def test_other_files_are_refused(drive):
    with pytest.raises(ValueError, match=r"times.txt: its suffix is '.txt'"):
        kitti.files([drive / "times.txt"])
    with pytest.raises(FileNotFoundError, match="nowhere"):
        kitti.files([drive / "nowhere"])
    (drive / "cut.bin").write_bytes(b"12345")
    with pytest.raises(ValueError, match=r"cut.bin: its 5 bytes are not whole points of 4 float32"):
        kitti.judge({}, [drive / "cut.bin"])


def test_a_hole_of_the_projection_is_no_error_in_our_convention():
    truth = Scan(two_pixels(10.0, 20.0), PLAIN)
    seen = torch.ones(PLAIN.shape, dtype=torch.bool)
    seen[6] = False
    holed = Scan(truth.ranges, PLAIN, seen=seen)
    answer = two_pixels(10.0, 20.0)
    answer[6, 512] = 30.0  # a surface where no ray went
    assert kitti.unmeasured(answer, holed) == {"mae": 0, "iou": 1, "chamfer": 0, "unseen": 1024}
    assert kitti.unmeasured(answer, truth)["iou"] == 0.5


def test_rows_that_no_beam_goes_to_are_told_from_no_returns():
    even = np.arange(0, 64, 2)
    rows, columns = np.repeat(even, 1024), np.tile(np.arange(1024), len(even))
    points = directions(-24.8 + rows * 26.8 / 63, columns * 360 / 1024 - 180) * 10.0
    points = points[(rows != 20) | (columns % 64 != 5)]  # lost returns
    scan = kitti.project(points, "spherical")
    assert ((~scan.seen).float().mean(1) > 0.9).tolist() == [row % 2 == 1 and row < 62 for row in range(64)]
    assert scan.seen[::2].all()
