from dataclasses import replace

import numpy as np
import pytest
import torch

from ilnet.world import drives, towns

from ..crossing import REACH, crossing

SCANS = 180


@pytest.fixture(scope="module")
def place():
    return crossing()


@pytest.fixture(scope="module")
def drive(place):
    return drives.drive(place, SCANS)


def test_the_car_follows_a_lane(place, drive):
    position = drive.poses[:, :3, 3].numpy()
    step = np.diff(position, axis=0)
    np.testing.assert_allclose(np.linalg.norm(step, axis=1), drives.SPEED * drives.PERIOD, atol=1e-6)
    np.testing.assert_allclose(position[:, 2], towns.SENSOR_HEIGHT, atol=1e-6)
    np.testing.assert_allclose(step / np.linalg.norm(step, axis=1)[:, None], drive.poses[:-1, :3, 0], atol=0.02)
    np.testing.assert_allclose(position[0, :2], place.waypoints[0, :2], atol=1e-5)


def test_it_turns_into_another_lane_slowly_where_one_is_too_short(place):
    poses = drives.drive(place, 300).poses.numpy()
    position, ahead = poses[:, :2, 3], poses[:, :2, 0]
    assert (abs(ahead[-20:, 0]) < 0.1).all()
    assert position[-1, 1] > 60
    speed = np.linalg.norm(np.diff(position, axis=0), axis=1) / drives.PERIOD
    turning = abs(ahead[:-1, 0] * ahead[:-1, 1]) > 0.3
    assert turning.any()
    assert speed[turning].max() < 0.7 * drives.SPEED
    assert speed.max() < drives.SPEED + 1e-3
    sideways = np.linalg.norm(np.diff(position, 2, axis=0), axis=1) / drives.PERIOD**2
    assert sideways.max() < 10  # m/s²: no jump, no kink
    yaw = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    assert abs(np.diff(yaw)).max() < np.deg2rad(12)


def test_traffic_moves_along_its_lane_and_keeps_away_from_the_car(place):
    found = [drives.drive(place, SCANS, seed) for seed in range(4)]
    assert sum(len(drive.speeds) for drive in found) > 4
    for drive in found:
        spots = drive._spots
        away = np.hypot(*(spots[:, :, :2] - drive.poses[:, None, :2, 3].numpy()).transpose(2, 0, 1))
        assert away.min(initial=np.inf) > 5
        steps = np.linalg.norm(np.diff(spots[..., :3], axis=0), axis=2)
        wrapped = steps > 100  # from the end of a lane to its start
        off = np.abs(steps - drive.speeds * drives.PERIOD)[~wrapped]
        assert off.max(initial=0) < 0.01
        assert np.abs(spots[..., :2]).min(2).max(initial=0) < 1.0  # it stays on one of the two
        np.testing.assert_allclose(spots[0, :, :2], drive.moving.spot[:, :2], atol=1.0)


def test_a_world_has_what_stands_and_what_moves_at_that_time(place):
    drive = next(d for seed in range(9) if len((d := drives.drive(place, SCANS, seed)).speeds) > 1)
    assert len(drive.place.triangles) > len(place.triangles)  # parked cars and people
    worlds = [drive.world(number) for number in range(0, SCANS, 5)]
    assert all(world[0] is drive.place.mesh for world in worlds)
    near = [np.hypot(*(drive._spots[k, :, :2] - drive.poses[k, :2, 3].numpy()).T) < 80 for k in range(0, SCANS, 5)]
    assert any(some.any() for some in near)
    for world, some in zip(worlds, near, strict=True):
        assert len(world) == 2 or not some.any()
    number = 5 * next(k for k, some in enumerate(near) if some.any())
    spot = drive._spots[number, np.nonzero(near[number // 5])[0][0], :3]
    above = torch.tensor(spot + np.array([0, 0, 10.0]))
    assert 5 < drive.world(number)[1].cast(above, torch.tensor([0.0, 0, -1]), 20.0).range < 10  # it stands there


def test_the_same_seed_gives_the_same_drive(place, drive):
    again, other = drives.drive(place, SCANS), drives.drive(place, SCANS, 1)
    np.testing.assert_array_equal(again.poses, drive.poses)
    np.testing.assert_array_equal(again._spots, drive._spots)
    assert other._spots.shape != drive._spots.shape or (other._spots != drive._spots).any()


def test_what_cannot_be_driven_is_refused(place):
    with pytest.raises(ValueError, match=r"a way of 1000 m; the longest that was found has \d+ m: ask for fewer"):
        drives.drive(place, 1000)
    assert 2 * REACH < 1000
    with pytest.raises(ValueError, match=r"place has no lanes; it should be a town"):
        drives.drive(replace(place, town=None), 10)
