import math

import pytest
import torch

from ilnet.sensor import Sensor, preset
from ilnet.simulate import pose, simulate

# float32 of coordinates up to 100 m.
METRES = 1e-3


def test_pose_turns_and_moves():
    matrix = pose((1.0, 2.0, 3.0), yaw=math.pi / 2)
    forward, left = matrix[:3, 0], matrix[:3, 1]
    torch.testing.assert_close(forward, torch.tensor([0.0, 1, 0], dtype=torch.float64), atol=1e-12, rtol=0)
    torch.testing.assert_close(left, torch.tensor([-1.0, 0, 0], dtype=torch.float64), atol=1e-12, rtol=0)
    assert matrix[:3, 3].tolist() == [1, 2, 3]
    down = pose((0.0, 0.0, 0.0), pitch=0.1)[:3, 0]
    assert down[2] < 0
    assert pose((0.0, 0.0, 0.0), roll=0.1)[2, 1] > 0


def test_poses_come_in_batches_and_are_rotations():
    angles = torch.randn(3, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rotation = pose(torch.zeros(7, 3), *angles)[:, :3, :3]
    identity = torch.eye(3, dtype=torch.float64).expand(7, 3, 3)
    torch.testing.assert_close(rotation @ rotation.transpose(1, 2), identity)
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(7, dtype=torch.float64))


def test_flat_ground_by_hand(yard):
    sensor = Sensor(torch.deg2rad(torch.tensor([-30.0, -1.0, 10.0])), torch.deg2rad(torch.arange(-170.0, 190.0, 20.0)))
    scan = simulate(yard, sensor, pose((0.0, -60.0, 1.8)))
    torch.testing.assert_close(scan.ranges[0], torch.full((18,), 1.8 / math.sin(math.radians(30))), rtol=0, atol=METRES)
    assert (scan.ranges[1, scan.ranges[1] > 0] < 80).all()  # 103 m away along -1°, beyond the maximum range
    assert (scan.ranges[2] == 0).float().mean() > 0.5


def test_a_block_stands_where_it_stands_whatever_the_yaw(yard):
    sensor = preset("paper-16x1024")
    for yaw in (0.0, 1.0, -2.5):
        turn = pose((0.0, 0.0, 1.8), yaw)
        points = simulate(yard, sensor, turn).points().double()
        world = points @ turn[:3, :3].T + turn[:3, 3]
        near = world[(world[:, 0] - 10).abs() < METRES]
        assert len(near) > 50  # the block's face at x = 10
        assert near[:, 1].min() >= 1 - METRES
        assert near[:, 1].max() <= 5 + METRES


def test_nothing_nearer_than_the_minimum_range(yard):
    sensor = Sensor(torch.tensor([-1.0, -0.5]), torch.tensor([0.0, 0.1]), min_range=3.0)
    ranges = simulate(yard, sensor, pose((50.0, 50.0, 1.8))).ranges
    assert (ranges[0] == 0).all()
    torch.testing.assert_close(ranges[1], torch.full((2,), 1.8 / math.sin(0.5)), rtol=0, atol=METRES)


def test_a_missing_direction_shows_as_no_return(yard):
    high = Sensor(torch.tensor([0.7, 0.8]), torch.tensor([0.0, 0.1]))
    assert not simulate(yard, high, pose((60.0, 60.0, 1.8))).ranges.any()


@pytest.mark.parametrize("size", ["paper-16x1024", "paper-64x1024", "paper-128x2048", "os1-128"])
def test_presets_scan_the_yard(yard, size):
    scan = simulate(yard, preset(size), pose((0.0, 0.0, 1.8)))
    assert scan.ranges.shape == preset(size).shape
    assert scan.ranges.any()
