import json
import math

import numpy as np
import pytest
import torch

from ilnet.sensor import Sensor, preset
from ilnet.world import meshes, places, simulate
from ilnet.world.effects import Effects
from ilnet.world.simulate import cast, pose, ranges
from kernels import Mesh

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
    scan = simulate.scan(yard, sensor, pose((0.0, -60.0, 1.8)))
    torch.testing.assert_close(scan.ranges[0], torch.full((18,), 1.8 / math.sin(math.radians(30))), rtol=0, atol=METRES)
    assert (scan.ranges[1, scan.ranges[1] > 0] < 80).all()  # 103 m away along -1°, beyond the maximum range
    assert (scan.ranges[2] == 0).float().mean() > 0.5


def test_a_block_stands_where_it_stands_whatever_the_yaw(yard):
    sensor = preset("paper-16x1024")
    for yaw in (0.0, 1.0, -2.5):
        turn = pose((0.0, 0.0, 1.8), yaw)
        points = simulate.scan(yard, sensor, turn).points().double()
        world = points @ turn[:3, :3].T + turn[:3, 3]
        near = world[(world[:, 0] - 10).abs() < METRES]
        assert len(near) > 50  # the block's face at x = 10
        assert near[:, 1].min() >= 1 - METRES
        assert near[:, 1].max() <= 5 + METRES


def test_nothing_nearer_than_the_minimum_range(yard):
    sensor = Sensor(torch.tensor([-1.0, -0.5]), torch.tensor([0.0, 0.1]), min_range=3.0)
    ranges = simulate.scan(yard, sensor, pose((50.0, 50.0, 1.8))).ranges
    assert (ranges[0] == 0).all()
    torch.testing.assert_close(ranges[1], torch.full((2,), 1.8 / math.sin(0.5)), rtol=0, atol=METRES)


def test_a_missing_direction_shows_as_no_return(yard):
    high = Sensor(torch.tensor([0.7, 0.8]), torch.tensor([0.0, 0.1]))
    assert not simulate.scan(yard, high, pose((60.0, 60.0, 1.8))).ranges.any()


@pytest.mark.parametrize("size", ["paper-16x1024", "paper-64x1024", "paper-128x2048", "os1-128"])
def test_presets_scan_the_yard(yard, size):
    scan = simulate.scan(yard, preset(size), pose((0.0, 0.0, 1.8)))
    assert scan.ranges.shape == preset(size).shape
    assert scan.ranges.any()


def test_what_is_nearest_of_several_meshes_is_measured(yard):
    wall = Mesh(
        torch.tensor([[6.0, -9, 0], [6, 9, 0], [6, 9, 1.6], [6, -9, 1.6]]), torch.tensor([[0, 1, 2], [0, 2, 3]])
    )
    sensor, here = preset("paper-16x1024"), pose((0.0, 0.0, 1.8))
    one, other = (simulate.scan(mesh, sensor, here).ranges for mesh in (yard, wall))
    both = simulate.scan([yard, wall], sensor, here).ranges
    assert torch.equal(both, torch.where((other > 0) & ((one == 0) | (other < one)), other, one))
    assert ((both == one) & (both > 0)).any()
    assert ((both == other) & (both > 0)).any()


def test_what_is_too_near_hides_what_is_behind(yard):
    near = Mesh(torch.tensor([[1.0, -1, 1], [1, 1, 1], [1, 0, 3]]), torch.tensor([[0, 1, 2]]))
    sensor = Sensor(torch.tensor([-0.1, -0.08]), torch.tensor([0.0, 2.0]))
    open_, hidden = (simulate.scan(world, sensor, pose((0.0, 0.0, 1.8))).ranges for world in (yard, [yard, near]))
    assert (open_[:, 0] > 2).all()
    assert (hidden[:, 0] == 0).all()
    assert torch.equal(hidden[:, 1], open_[:, 1])


@pytest.mark.parametrize("size", ["paper-16x1024", "paper-64x1024"])
def test_many_poses_are_cast_in_one_call(yard_on, size, device):
    mesh, sensor = yard_on(device), preset(size)
    poses = pose(torch.tensor([[0.0, 0, 1.8], [5, 4, 2], [-20, 0, 1]]), torch.tensor([0.0, 1.0, 2.0]))
    many = ranges(mesh, sensor, poses)
    assert many.shape == (3, *sensor.shape)
    for image, one in zip(many, poses, strict=True):
        assert torch.equal(image, simulate.scan(mesh, sensor, one).ranges)
    assert ranges(mesh, sensor, poses.view(3, 1, 4, 4)).shape == (3, 1, *sensor.shape)
    assert ranges(mesh, sensor, poses[:0]).shape == (0, *sensor.shape)
    assert torch.equal(ranges(mesh, sensor, poses.mT.contiguous().mT), many)  # in any order of memory


def test_the_engine_follows_the_work(yard):
    """Few rays are cast one by one, an image is projected; near triangles alone count."""
    here = torch.zeros(3, dtype=torch.float64)
    assert not yard.projects_faster(here, 500, 80.0)
    assert yard.projects_faster(here, 128 * 2048, 80.0)
    generator = torch.Generator().manual_seed(0)
    middle = torch.randn(100_000, 1, 3, generator=generator)
    dust = (middle + 0.01 * torch.randn(100_000, 3, 3, generator=generator)).view(-1, 3)
    dense = Mesh(dust, torch.arange(300_000).view(-1, 3))
    assert not dense.projects_faster(here, 16 * 1024, 80.0)
    assert dense.projects_faster(torch.tensor([500.0, 0, 0]), 16 * 1024, 80.0)


def test_effects_are_drawn_from_the_seed(yard):
    sensor, here = preset("paper-16x1024"), pose((0.0, 0.0, 1.8))
    noisy = Effects(range_noise=0.02, intensity=True)
    first, again, other = (simulate.scan(yard, sensor, here, noisy, seed) for seed in (1, 1, 2))
    clean = simulate.scan(yard, sensor, here).ranges
    assert torch.equal(first.ranges, again.ranges)
    assert not torch.equal(first.ranges, other.ranges)
    both = (clean > 0) & (first.ranges > 0)
    assert (first.ranges - clean)[both].std() == pytest.approx(0.02, rel=0.05)
    assert first.intensity[both].min() > 0


def compare_engines(mesh, positions):
    """The same hits for 99.99 % of the pixels, and the same ranges to a millimetre off the silhouettes."""
    sensor = preset("paper-128x2048")
    tables = torch.tensor(sensor.elevations), torch.tensor(sensor.azimuths)
    for number, position in enumerate(positions):
        here = pose(torch.tensor(position, dtype=torch.float64), 0.7 * number, 0.03, -0.02)
        projected = mesh.project(here, *tables, sensor.max_range)
        expected = cast(mesh, here, sensor.directions().view(-1, 3), sensor.max_range).view(sensor.shape)
        assert (expected > 0).double().mean() > 0.3
        assert ((projected > 0) != (expected > 0)).double().mean() <= 1e-4
        around = expected.unfold(0, 3, 1).unfold(1, 3, 1).flatten(2)
        smooth = around.amax(2) - around.amin(2) < 0.1 * around.amin(2)
        assert smooth.double().mean() > 0.2
        difference = (projected - expected)[1:-1, 1:-1].abs()
        assert (difference[smooth] > METRES).double().mean() <= 1e-5


def test_both_engines_see_the_same_in_a_town():
    street = places.town("town01")
    compare_engines(street.mesh, street.town.waypoints[[5, 900, 2000]] + np.float32([0, 0, 1.8]))


@pytest.mark.parametrize("name", ["sionna_florence", "sionna_munich", "torcs_aalborg", "torcs_street-1"])
def test_both_engines_see_the_same_in_other_meshes(shared, name):
    file = shared / "data" / "meshes" / f"{name}.ply"
    positions = json.loads(file.with_name(f"{name}_positions.json").read_text())["positions"]
    compare_engines(Mesh(*meshes.read(file)), positions[:2])


def test_what_cannot_be_cast_is_named(yard):
    sensor = preset("paper-16x1024")
    for effects in (None, Effects(range_noise=0.1)):
        with pytest.raises(ValueError, match="world is empty; it should be one mesh or several"):
            simulate.scan([], sensor, pose((0.0, 0.0, 1.8)), effects)
    with pytest.raises(ValueError, match="finite"):
        simulate.scan(yard, sensor, pose((math.nan, 0.0, 1.8)))
