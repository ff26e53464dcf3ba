import os
import subprocess
import sys
import zlib

import numpy as np
import pytest
import torch

from ilnet.world import towns
from ilnet.world.towns import SENSOR_HEIGHT
from ilnet.world.towns.town import LIDAR_REACH, WAYPOINT_SPACING
from kernels.rays.mesh import Mesh

# Sensors have at least this much room around them, and traffic keeps as far away [m].
CLEARANCE = 1.2
# Half a step of the vertex raster, and slopes of up to 11 % across it [m].
GROUND_TOLERANCE = 0.01
WAYPOINTS = {
    "town01": 3_050,
    "town02": 2_620,
    "town03": 3_450,
    "town04": 4_930,
    "town05": 5_224,
    "town06": 2_970,
    "town07": 1_385,
    "town10": 1_462,
}
# CRC-32 of all arrays of a town. After a change that is meant to change towns, the failing test prints the new ones.
CHECKSUMS = {
    "town01": "e5a4c61d",
    "town02": "97d12a88",
    "town03": "84ef5eb3",
    "town04": "0dd828fe",
    "town05": "aadc3afa",
    "town06": "132965d5",
    "town07": "a7e0d2aa",
    "town10": "7c861965",
}


def _cast(mesh, origins, directions, max_range=80.0):
    """Returns the ranges (N, M) [m] along directions (M, 3) from each of origins (N, 3) [m]."""
    each = np.repeat(origins, len(directions), axis=0), np.tile(directions, (len(origins), 1))
    hits = mesh.cast(*(torch.from_numpy(a.astype(np.float32)) for a in each), max_range)
    return hits.range.numpy().reshape(len(origins), len(directions))


@pytest.fixture(scope="module", params=towns.NAMES)
def town(request):
    return towns.build(request.param)


@pytest.fixture(scope="module")
def mesh(town):
    return Mesh(town.vertices, town.triangles)


@pytest.fixture(scope="module")
def sensors(town):
    """Returns sensor positions above about 40 waypoints spread over the town."""
    return town.waypoints[:: len(town.waypoints) // 40] + np.float32([0, 0, SENSOR_HEIGHT])


def _checksum(town):
    """Returns the CRC-32 of all arrays."""
    arrays = town.vertices, town.triangles, town.waypoints, town.headings, town.parking, town.walks
    return zlib.crc32(b"".join(a.tobytes() for a in arrays))


def test_seed_0_is_the_same_town_everywhere(town):
    assert f"{_checksum(town):08x}" == CHECKSUMS[town.name]


def test_seed_0_is_the_same_town_on_a_processor_without_wide_registers():
    found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    if not found:
        pytest.skip("numpy has only its baseline here")
    environment = os.environ | {"NPY_DISABLE_CPU_FEATURES": " ".join(found)}
    code = (
        "import zlib; from ilnet import towns; t = towns.build('town10');"
        "arrays = t.vertices, t.triangles, t.waypoints, t.headings, t.parking, t.walks;"
        "print(f'{zlib.crc32(b\"\".join(a.tobytes() for a in arrays)):08x}')"
    )
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == CHECKSUMS["town10"], done.stderr


def test_waypoints_are_as_many_as_in_the_paper(town):
    assert len(town.waypoints) == WAYPOINTS[town.name]
    assert sum(WAYPOINTS[name] for name in towns.TRAIN) == 22_244
    assert sum(WAYPOINTS[name] for name in towns.TEST) == 2_847


def test_another_seed_is_another_town():
    first, other = towns.build("town07"), towns.build("town07", 1)
    assert other.seed == 1
    assert other.vertices.shape != first.vertices.shape
    assert len(other.waypoints) <= len(first.waypoints)
    nearest = np.linalg.norm(other.waypoints[::20, None, :2] - first.waypoints[None, ::2, :2], axis=-1).min(1)
    assert np.median(nearest) > 4


def test_arrays_have_the_documented_types_and_shapes(town):
    assert town.vertices.dtype == town.waypoints.dtype == town.headings.dtype == np.float32
    assert town.triangles.dtype == np.int32
    assert town.vertices.shape[1] == town.triangles.shape[1] == town.waypoints.shape[1] == 3
    assert town.headings.shape == (len(town.waypoints),)
    assert town.parking.dtype == town.walks.dtype == np.float32
    assert town.parking.shape[1] == town.walks.shape[1] == 4
    for array in (town.vertices, town.waypoints, town.headings, town.parking, town.walks):
        assert np.isfinite(array).all()
    assert town.triangles.min() >= 0
    assert town.triangles.max() < len(town.vertices)
    np.testing.assert_array_equal(town.vertices * 1024, np.round(town.vertices * 1024))


def test_poles_are_upright_and_each_is_one_thing(town):
    assert town.poles.dtype == np.int32
    assert len(town.poles) > 30
    order = np.sort(town.poles, axis=0)
    assert (order[:, 0] < order[:, 1]).all()
    assert (order[1:, 0] >= order[:-1, 1]).all()
    for first, last in town.poles:
        corners = town.vertices[town.triangles[first:last].ravel()].astype(np.float64)
        low, high = corners.min(0), corners.max(0)
        assert 1.0 < high[2] - low[2] < 13.0
        foot = corners[corners[:, 2] < low[2] + 0.3]
        assert np.ptp(foot[:, :2], axis=0).max() < 0.5


def test_triangles_have_area(town):
    a, b, c = (town.vertices[town.triangles[:, k]].astype(np.float64) for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    assert area.min() > 1e-7
    assert 300_000 < len(area) < 2_000_000


def test_waypoints_follow_their_lane(town):
    step = np.diff(town.waypoints, axis=0)
    length = np.linalg.norm(step[:, :2], axis=1)
    in_lane = (length < 3) & (np.cos(np.diff(town.headings)) > 0.9)
    assert in_lane.mean() > 0.9
    np.testing.assert_allclose(length[in_lane], WAYPOINT_SPACING, atol=0.05)
    ahead = np.arctan2(step[:, 1], step[:, 0])[in_lane]
    turn = np.angle(np.exp(1j * (ahead - town.headings[:-1][in_lane])))
    assert np.abs(turn).max() < 0.2
    slope = np.abs(step[in_lane, 2]) / length[in_lane]
    assert slope.max() < 0.13


def test_road_lies_under_every_waypoint(town, mesh):
    drop = _cast(mesh, town.waypoints + np.float32([0, 0, SENSOR_HEIGHT]), np.float32([[0, 0, -1]]))
    np.testing.assert_allclose(drop, SENSOR_HEIGHT, atol=GROUND_TOLERANCE)


def test_sensors_have_room(town, mesh):
    k = np.arange(200) + 0.5  # A spiral of directions, evenly spread over the sphere.
    polar, turn = np.arccos(1 - k / 100), np.pi * (1 + 5**0.5) * k
    sphere = np.column_stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)])
    ranges = _cast(mesh, town.waypoints + np.float32([0, 0, SENSOR_HEIGHT]), sphere, CLEARANCE)
    assert (ranges == 0).all()


def test_ground_is_closed(mesh, sensors):
    azimuth = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    for elevation in np.radians([-20.0, -8.0]):
        way = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.full(720, np.tan(elevation))])
        assert (_cast(mesh, sensors, way, 200.0) > 0).all()


def test_scans_look_like_streets(mesh, sensors):
    azimuth = np.linspace(0, 2 * np.pi, 1024, endpoint=False)
    elevation = np.radians(np.linspace(15, -15, 32))[:, None]
    way = np.broadcast_arrays(
        np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    )
    ranges = _cast(mesh, sensors, np.stack(way, axis=-1).reshape(-1, 3)).reshape(-1, 32, 1024)
    assert 0.55 < (ranges > 0).mean() < 0.96  # From open fields to streets between tall fronts.
    assert (np.abs(np.diff(ranges)) > 0.5).mean() > 0.04


def test_traffic_is_drawn_anew_for_each_seed(town, sensors):
    first, again, other = (towns.traffic(town, sensors[3], seed) for seed in (5, 5, [5, 1]))
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
    assert first[0].shape != other[0].shape or (first[0] != other[0]).any()


def test_traffic_stands_on_the_ground_and_clear_of_the_sensor(town, mesh, sensors):
    sizes, above = [], []
    for number, sensor in enumerate(sensors):
        vertices, triangles = towns.traffic(town, sensor, number)
        assert vertices.dtype == np.float32
        assert triangles.dtype == np.int32
        assert triangles.min() >= 0
        assert triangles.max() < len(vertices)
        np.testing.assert_array_equal(vertices * 1024, np.round(vertices * 1024))
        sizes.append(len(triangles))
        corners = vertices[triangles] - sensor
        assert np.linalg.norm(corners[..., :2], axis=-1).min() > CLEARANCE
        assert np.linalg.norm(corners[..., :2], axis=-1).max() < LIDAR_REACH + 8  # and the longest vehicle
        up = _cast(mesh, vertices[::97] + np.float32([0, 0, 0.3]), np.float32([[0, 0, -1]]), 5.0)
        above.append(up)
    above = np.concatenate(above)
    assert (above > 0).mean() > 0.99
    assert (above < 0.1).mean() < 0.02  # Nothing sinks into the road.
    assert 5_000 < np.median(sizes) < 60_000
    assert np.ptp(sizes) > 0.5 * np.median(sizes)


def test_every_triangle_of_the_traffic_has_its_owner(town, sensors):
    things = towns.draw(town, sensors[7], 7)
    vertices, triangles = things.mesh()
    for one, other in zip((vertices, triangles), towns.traffic(town, sensors[7], 7), strict=True):
        np.testing.assert_array_equal(one, other)
    owners = things.owners()
    assert len(owners) == len(triangles)
    middles = vertices[triangles].mean(1)
    away = np.hypot(*(middles[:, :2] - things.spot[owners, :2]).T)
    people = np.isin(things.kind[owners], towns.PEOPLE)
    assert away[people].max(initial=0) < 0.6
    assert away.max() < 6.0
    assert set(owners) == set(range(len(things.kind)))


def test_own_lane_is_free_ahead(town):
    for number in range(0, len(town.waypoints), 301):
        sensor, heading = town.waypoints[number] + np.float32([0, 0, SENSOR_HEIGHT]), town.headings[number]
        away = towns.traffic(town, sensor, number)[0] - sensor
        along = away[:, 0] * np.cos(heading) + away[:, 1] * np.sin(heading)
        across = away[:, 1] * np.cos(heading) - away[:, 0] * np.sin(heading)
        assert not ((np.abs(along) < 4.4) & (np.abs(across) < 1.2)).any()


def test_traffic_does_not_overlap():
    x = np.arange(-80, 80, WAYPOINT_SPACING, dtype=np.float32)
    zero = np.zeros_like(x)
    lane, spots = np.column_stack([x, zero, zero]), np.column_stack([x, zero, zero, zero])
    empty = np.zeros((0, 3), dtype=np.float32), np.zeros((0, 3), dtype=np.int32)
    line = towns.Town("a line", 0, *empty, lane, zero, spots, np.zeros((0, 4), dtype=np.float32), empty[1][:, :2])
    for seed in range(20):
        vertices, triangles = towns.traffic(line, (0.0, 0.0, SENSOR_HEIGHT), seed)
        corners = vertices[triangles]
        on_line = (corners[..., 1].min(1) < 0.3) & (corners[..., 1].max(1) > -0.3)
        starts, ends = corners[on_line, :, 0].min(1), corners[on_line, :, 0].max(1)
        order = np.argsort(starts)
        ends = np.maximum.accumulate(ends[order])
        first = np.concatenate([[0], np.nonzero(starts[order][1:] > ends[:-1])[0] + 1])
        length = np.append(ends[first[1:] - 1], ends[-1]) - starts[order][first]
        assert len(length) > 5
        assert length.max() < 11.7  # The length of a bus.


def test_no_traffic_where_there_are_no_lanes(town):
    vertices, triangles = towns.traffic(town, (5000.0, 0.0, SENSOR_HEIGHT), 0)
    assert vertices.shape == triangles.shape == (0, 3)
    assert vertices.dtype == np.float32
    assert triangles.dtype == np.int32


@pytest.mark.parametrize("at", [(0.0, 0.0), (0.0, float("nan"), SENSOR_HEIGHT)])
def test_traffic_refuses_a_bad_position(at):
    none = np.zeros((0, 3), dtype=np.float32)
    nowhere = towns.Town(
        "nowhere", 0, none, none.astype(np.int32), none, none[:, 0], none, none, none[:, :2].astype(np.int32)
    )
    with pytest.raises(ValueError, match=r"^at is .*; it should be three finite numbers"):
        towns.traffic(nowhere, at, 0)


def test_unknown_name_is_refused():
    with pytest.raises(ValueError, match=r"^name is 'nowhere'; it should be one of: town01, "):
        towns.build("nowhere")


def test_a_sensor_sees_in_a_sector_what_it_sees_there_of_all_traffic(town):
    azimuth = np.linspace(2.5 - 0.6, 2.5 + 0.6, 400)
    way = np.stack([np.cos(azimuth), np.sin(azimuth), np.full(400, -0.05)], axis=1)
    met, triangles = 0, np.zeros(2)
    for seed in range(12):
        at = town.waypoints[100 * seed] + np.float32([0, 0, SENSOR_HEIGHT])
        both = [towns.traffic(town, at, seed, sector=sector) for sector in (None, (2.5, 0.6))]
        seen, seen_of_part = (_cast(Mesh(*t), at[None], way) if len(t[1]) else np.zeros((1, 400)) for t in both)
        np.testing.assert_array_equal(seen_of_part, seen)
        met += int((seen > 0).any())
        triangles += [len(t[1]) for t in both]
    assert met >= 2
    assert 0 < triangles[1] < 0.5 * triangles[0]
