"""Holes of a projection: told from no returns where the rays are known, and filled from around them."""

import math

import numpy as np
import pytest
import torch

from ilnet import holes, models
from ilnet.scan import Scan
from ilnet.sensor import Sensor, angles_to_directions

FULL = np.linspace(-math.pi, math.pi, 64, endpoint=False)
GRID = Sensor(np.deg2rad(np.linspace(-24, 0, 17)), FULL, 0.5, 80, 100)
UNEVEN = np.deg2rad([-24, -22.3, -20.2, -19, -17.6, -16, -15.2, -13.6, -12.2, -11.1, -9, -8, -6.2, -4.6, -3, 0])


def rays(elevations, azimuths):
    """Returns the elevation and azimuth of each ray, one after the other."""
    pairs = torch.broadcast_tensors(torch.tensor(elevations)[:, None], torch.tensor(azimuths)[None, :])
    return [angle.flatten() for angle in pairs]


def street(elevation, azimuth):
    """Returns the ranges of ground 2 m below and of walls 10 m to both sides, up to 4 m above the ground."""
    _, y, z = angles_to_directions(elevation, azimuth).double().unbind(-1)
    ground, wall = 2 / (-z).clamp(min=1e-3), 10 / y.abs().clamp(min=1e-3)
    ranges = torch.where(wall < ground, wall.where(wall * z < 2, 0.0), ground).float()
    return ranges.where(ranges < 80, 0.0)


def projected(elevations, azimuths, sensor=GRID, lost=0.0):
    """Returns the scan of the street's points, and where a ray went."""
    elevation, azimuth = rays(elevations, azimuths)
    ranges = street(elevation, azimuth)
    ranges[torch.rand(len(ranges), generator=torch.Generator().manual_seed(1)) < lost] = 0.0
    went = torch.zeros(sensor.shape, dtype=torch.bool)
    went.view(-1)[holes.nearest_pixels(sensor.locate(elevation, azimuth), sensor)] = True
    points = angles_to_directions(elevation, azimuth)[ranges > 0] * ranges[ranges > 0, None]
    return Scan.from_points(points, sensor), went


def test_every_empty_pixel_of_a_sensors_own_grid_is_a_no_return():
    scan, _ = projected(GRID.elevations, GRID.azimuths, lost=0.2)
    assert (scan.ranges == 0).sum() > 150
    assert scan.seen is None


@pytest.mark.parametrize(
    "azimuths",
    [FULL + 0.02, np.linspace(-math.pi, math.pi, 57, endpoint=False), np.linspace(-math.pi, math.pi, 32, False)],
    ids=["as many columns", "fewer columns", "half of the columns"],
)
def test_pixels_that_no_ray_went_to_are_found(azimuths):
    scan, went = projected(UNEVEN, azimuths, lost=0.05)
    hole, empty = ~went, scan.ranges == 0
    solid = street(*rays(GRID.elevations, GRID.azimuths)).view(GRID.shape) > 0
    found = ~scan.seen
    assert (hole & solid).sum() > 50
    assert (found & hole & solid).sum() / (hole & solid).sum() > 0.85
    assert (found & hole).sum() / found.sum() > 0.9
    assert (went & empty).sum() > 15
    assert (found & went).sum() / (went & empty).sum() < 0.25


def test_holes_are_found_where_the_points_are(device):
    elevation, azimuth = rays(UNEVEN, FULL)
    pixels = GRID.locate(elevation, azimuth)
    found = holes.find(pixels.to(device), GRID)
    assert found.device.type == device.type
    assert torch.equal(found.cpu(), holes.find(pixels, GRID))
    assert found.any()


@pytest.mark.parametrize("wrap", [True, False])
def test_a_hole_at_the_seam(wrap):
    azimuths = FULL if wrap else FULL / 2
    sensor = Sensor(GRID.elevations, azimuths, 0.5, 80, 100)
    # Each ray is a bit farther from the one before, so that none goes to column 0.
    columns = torch.arange(1, 64) - 0.45 + torch.arange(63) * (0.9 / 62)
    pixels = torch.stack(torch.meshgrid(torch.arange(17.0), columns, indexing="ij"), -1).view(-1, 2)
    found = holes.find(pixels, sensor)
    assert torch.equal(found.any(1), torch.full((17,), wrap))
    assert not found[:, 1:].any()


def test_a_large_empty_region_is_sky():
    scan, _ = projected(UNEVEN, FULL + 0.02)
    ranges = scan.ranges.clone()
    ranges[4:12, 20:40] = 0
    found = Scan.from_points(Scan(ranges, GRID).points(), GRID)
    assert found.seen is None or found.seen[5:11, 20:40].all()


# Filling


def bridged(ranges, seen, sensor=GRID, **images):
    return Scan(ranges.where(seen, 0.0), sensor, seen=seen, **images).bridged()


def test_a_hole_in_a_plane_continues_it(device):
    sensor = Sensor(np.deg2rad(np.linspace(-24, 0, 25)), np.deg2rad(np.linspace(40, -40, 81)), 0.5, 80, 100)
    facing = sensor.directions() @ torch.tensor([0.9, 0.2, -0.39])
    truth = (10 / facing).to(device)
    seen = torch.ones(sensor.shape, dtype=torch.bool, device=device)
    seen[1::3, ::2] = False
    seen[4, 6:20] = seen[8, :] = False
    found = bridged(truth, seen, sensor)
    assert found.seen is None
    assert torch.equal(found.ranges[seen], truth[seen])
    torch.testing.assert_close(found.ranges, truth, rtol=1e-3, atol=0)


def test_nothing_floats_between_two_surfaces():
    ranges = torch.full(GRID.shape, 5.0)
    ranges[:, 30:] = 20.0
    ranges[10:, 30:] = 0.0
    seen = torch.ones(GRID.shape, dtype=torch.bool)
    seen[:, 28:32] = False
    seen[10] = False
    found = bridged(ranges, seen).ranges
    for surface in (0.0, 5.0, 20.0):
        found = found.where((found - surface).abs() > 1e-5, surface)
    assert set(found.unique().tolist()) == {0.0, 5.0, 20.0}


def test_a_hole_with_nothing_on_one_side_copies_the_other_and_one_in_the_void_stays_empty():
    half = Sensor(GRID.elevations, FULL / 2, 0.5, 80, 100)
    seen = torch.ones(half.shape, dtype=torch.bool)
    seen[:, -3:] = False
    torch.testing.assert_close(bridged(torch.full(half.shape, 7.0), seen, half).ranges, torch.full(half.shape, 7.0))
    nothing = torch.zeros(half.shape, dtype=torch.bool)
    assert not bridged(torch.zeros(half.shape), nothing, half).ranges.any()
    assert (Scan(torch.zeros(half.shape), half, seen=nothing).filled() == 100).all()


def test_intensity_and_time_are_bridged_too():
    seen = torch.ones(GRID.shape, dtype=torch.bool)
    seen[5, :] = False
    rising = torch.linspace(0, 1, 17)[:, None].expand(GRID.shape)
    found = bridged(torch.full(GRID.shape, 7.0), seen, intensity=rising, time=rising)
    torch.testing.assert_close(found.intensity, rising)
    torch.testing.assert_close(found.time, rising)


@pytest.mark.parametrize("name", ["bilinear", "planes", "iln-surfaces"])
def test_models_see_no_wall_in_a_hole(name):
    wall = torch.full(GRID.shape, 7.0)
    seen = torch.ones(GRID.shape, dtype=torch.bool)
    seen[3::4, :] = False
    holed = Scan(wall.where(seen, 0.0), GRID, wall.where(seen, 0.0) / 10, seen=seen)
    model = models.create(name).eval()
    target = GRID.resize(33, 128)
    expected = model.upsample(Scan(wall, GRID, wall / 10), target)
    found = model.upsample(holed, target)
    assert (found.ranges > 0).all()
    torch.testing.assert_close(found.ranges, expected.ranges, rtol=1e-5, atol=0)
    torch.testing.assert_close(found.intensity, expected.intensity, rtol=1e-5, atol=1e-6)
