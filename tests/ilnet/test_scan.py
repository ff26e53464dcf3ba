"""Scans: range images, points, intensity and confidence."""

import math

import numpy as np
import pytest
import torch

from ilnet.scan import Scan
from ilnet.sensor import Sensor, preset

from .toy import ROUND_TRIP, SENSOR, bright, complete, predicted, toy


def test_points_by_hand():
    sensor = Sensor(np.deg2rad([-30, 0]), np.deg2rad([-90, 0, 90, 180]))
    ranges = torch.zeros(2, 4)
    ranges[1, 1], ranges[1, 2], ranges[0, 0] = 5, 7, 2
    found = Scan(ranges, sensor).points()
    assert found.dtype == torch.float32
    expected = torch.tensor([[0, -math.sqrt(3), -1], [5, 0, 0], [0, 7, 0]])  # right and down, ahead, left
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)


def test_filled():
    ranges = torch.full((4, 4), 20.0)
    ranges[0] = torch.tensor([0, 50.5, 50, 0.5])
    filled = Scan(ranges, SENSOR).filled()
    assert filled[0].tolist() == [60, 60, 50, 60]  # no return, beyond max_range, at it, below min_range
    assert (filled[1:] == 20).all()
    assert ranges[0, 0] == 0  # the scan itself is left alone


def test_decimate():
    few = toy().decimate(3, 2)
    assert few.sensor == SENSOR.decimate(3, 2)
    torch.testing.assert_close(few.ranges, toy().ranges[[0, 2, 3]][:, [0, 2]], atol=0, rtol=0)
    # Its points are points of the whole scan.
    assert (torch.cdist(few.points(), toy().points()).min(dim=1).values < 1e-5).all()


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.uint16, ">f4"])
def test_ranges_of_any_number_type(dtype):
    found = Scan(np.full((4, 4), 7, dtype), SENSOR)
    assert found.ranges.dtype == torch.float32
    assert (found.ranges == 7).all()


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        (torch.zeros(4, 5), r"shape \(4, 5\); it should be \(4, 4\), the shape of Sensor\(toy, 4x4"),
        (torch.tensor([math.nan, math.nan, math.inf, -1] * 4).view(4, 4), "8 NaN, 4 infinite, 4 negative of 16 values"),
        (np.full((4, 4), 1e300), "16 infinite"),
        (torch.zeros(4, 4, dtype=torch.bool), "ranges is of dtype torch.bool; it should hold real numbers"),
        (torch.zeros(4, 4, dtype=torch.complex64), "ranges is of dtype .*; it should hold real numbers"),
        ([["far"] * 4] * 4, "ranges is of dtype .*; it should hold real numbers"),
    ],
)
def test_bad_ranges(ranges, message):
    with pytest.raises(ValueError, match=message):
        Scan(ranges, SENSOR)


# Intensity and confidence


def test_intensity_and_confidence_are_zero_where_nothing_returned():
    assert toy().intensity is None
    assert toy().confidence is None
    assert bright().confidence is None
    found = predicted()
    assert found.intensity.dtype == found.confidence.dtype == torch.float32
    assert found.intensity[0, 1] == found.intensity[3, 3] == found.confidence[0, 1] == found.confidence[3, 3] == 0
    assert found.intensity[2, 2] == pytest.approx(10 / 15)
    assert found.confidence[2, 2] == pytest.approx(0.5)


def test_decimate_keeps_intensity_and_confidence_of_each_pixel():
    few = predicted().decimate(3, 2)
    assert torch.equal(few.intensity, predicted().intensity[[0, 2, 3]][:, [0, 2]])
    assert torch.equal(few.confidence, predicted().confidence[[0, 2, 3]][:, [0, 2]])
    assert bright().decimate(3, 2).confidence is None
    few = complete().decimate(4, 2)
    assert torch.equal(few.time, complete().time[:, [0, 2]])
    assert few.seen is None  # the hole is in a column that went
    assert torch.equal(complete().decimate(2).seen, complete().seen[[0, 3]])


@pytest.mark.parametrize("name", ["intensity", "confidence"])
@pytest.mark.parametrize(
    ("values", "message"),
    [
        (torch.zeros(4, 5), r" has shape \(4, 5\); it should be \(4, 4\)"),
        (np.full((4, 4), 255, np.uint8), " has 16 of 16 values outside 0 to 1; (divide it|they should be prob)"),
        (torch.tensor([math.nan, -0.1, 0, 1] * 4).view(4, 4), " has 8 of 16 values outside"),
    ],
)
def test_bad_intensity_and_confidence(name, values, message):
    with pytest.raises(ValueError, match=name + message):
        Scan(toy().ranges, SENSOR, **{name: values})


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ({"time": torch.full((4, 4), 1e9)}, "time has 16 of 16 values outside 0 to 86400; it should be seconds since"),
        ({"time": -torch.ones(4, 4)}, "time has 16 of 16 values outside 0 to 86400"),
        ({"seen": torch.ones(4, 4)}, "seen is of dtype torch.float32; it should be bool"),
        ({"seen": torch.ones(4, 5, dtype=torch.bool)}, r"seen has shape \(4, 5\); it should be \(4, 4\)"),
        ({"seen": np.zeros((4, 4), bool)}, "seen is False at 14 of 14 returns; it should be True wherever"),
    ],
)
def test_bad_times_and_bad_holes(field, message):
    with pytest.raises(ValueError, match=message):
        Scan(toy().ranges, SENSOR, **field)


def test_a_sensor_that_looked_everywhere_has_no_mask():
    assert Scan(toy().ranges, SENSOR, seen=torch.ones(4, 4, dtype=torch.bool)).seen is None


def test_points_keep_their_times():
    points, time = toy().points(), torch.arange(14) / 100
    found = Scan.from_points(points, SENSOR, time=time)
    assert torch.equal(found.time[found.ranges > 0], time)


def test_a_scan_moves_to_a_device_with_all_it_has(device):
    found = complete().to(device)
    for name in ("ranges", "intensity", "confidence", "time", "seen"):
        assert getattr(found, name).device.type == device.type
        assert torch.equal(getattr(found, name).cpu(), getattr(complete(), name))
    assert found.sensor is complete().sensor
    assert toy().to(device).intensity is None


def test_a_scan_is_decimated_where_it_is(device):
    few = predicted().to(device).decimate(3, 2)
    assert few.intensity.device.type == few.confidence.device.type == device.type


def test_only_confident_returns_stay():
    scan = complete()
    found = scan.confident(0.5)
    stays = (scan.confidence >= 0.5) & (scan.ranges > 0)
    assert stays.sum() == 10  # of the first 11 pixels, one has no return
    for name in ("ranges", "intensity", "confidence", "time"):
        assert torch.equal(getattr(found, name), getattr(scan, name).where(stays, 0.0))
    assert torch.equal(found.seen, scan.seen)
    assert torch.equal(scan.confident(0).ranges, scan.ranges)
    for least in (-0.1, 1.1, math.nan):
        with pytest.raises(ValueError, match=f"least is {least}; it should be from 0 to 1"):
            scan.confident(least)
    with pytest.raises(ValueError, match="the scan has no confidence"):
        bright().confident(0.5)


# Points to a range image


def test_nearest_return_wins_and_useless_points_go():
    e, a = SENSOR.elevations[1], SENSOR.azimuths[3]
    ray = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    useless = [[np.nan, 1, 1], [1, np.inf, 1], [0, 0, 0], [0, 0, 9], [5, 0, -9]]  # the last two out of view
    points = np.concatenate(([9 * ray, 4 * ray, 6 * ray], useless))
    found = Scan.from_points(points, SENSOR)
    expected = torch.zeros(4, 4)
    expected[1, 3] = 4
    torch.testing.assert_close(found.ranges, expected, **ROUND_TRIP)
    assert found.sensor is SENSOR


def test_points_bring_their_intensity_and_confidence(device):
    scan = predicted()
    # Behind each point another one of value 1, and one that is no point and has no value.
    points = torch.cat((scan.points(), 1.5 * scan.points(), torch.full((1, 3), math.nan)))
    more = torch.cat((torch.ones(14), torch.tensor([300.0])))
    intensity, confidence = (torch.cat((of[scan.ranges > 0], more)) for of in (scan.intensity, scan.confidence))
    order = torch.randperm(29, generator=torch.Generator().manual_seed(0))
    found = Scan.from_points(points[order].to(device), SENSOR, intensity[order], confidence[order].numpy())
    assert torch.equal(found.ranges > 0, (scan.ranges > 0).to(device))
    for name in ("intensity", "confidence"):
        assert torch.equal(getattr(found, name), getattr(scan, name).to(device))
    assert Scan.from_points(points, SENSOR, confidence=confidence).intensity is None
    with pytest.raises(ValueError, match=r"intensity has shape \(28,\); it should be \(29,\), as points"):
        Scan.from_points(points, SENSOR, intensity[1:])
    intensity[3] = -0.5
    with pytest.raises(ValueError, match="intensity has 1 of 16 values outside 0 to 1"):
        Scan.from_points(points, SENSOR, intensity)


@pytest.mark.parametrize(
    ("elevation", "azimuth", "pixel"),
    [
        (2.6, 80, (1, 1)),  # nearer to 5 than to 0
        (2.4, 80, (2, 1)),
        (27, 80, (0, 1)),  # at most half a pixel above the first row
        (-14.9, 80, (3, 1)),
        (0, -144, (2, 3)),  # the middle of the seam is -145
        (0, -146, (2, 0)),
    ],
)
def test_nearest_pixel(elevation, azimuth, pixel):
    e, a = math.radians(elevation), math.radians(azimuth)
    point = 8 * torch.tensor([[math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)]])
    assert torch.nonzero(Scan.from_points(point, SENSOR).ranges).tolist() == [list(pixel)]


def test_nearest_pixel_on_a_partial_circle():
    sensor = Sensor(np.deg2rad([0, 10]), np.deg2rad([-20, 0, 20]))
    edges = torch.tensor(np.deg2rad([-30.1, -29.9, 29.9, 30.1]))
    points = torch.stack((edges.cos(), edges.sin(), 0 * edges), dim=1)
    for point, column in zip(points, (None, 0, 2, None), strict=True):
        if column is None:
            with pytest.raises(ValueError, match="none of 1 points"):
                Scan.from_points(point[None], sensor)
        else:
            assert torch.nonzero(Scan.from_points(point[None], sensor).ranges).tolist() == [[0, column]]


@pytest.mark.parametrize("name", ["paper-64x1024", "vlp-16", "hdl-64e", "os0-128"])
def test_points_lead_back_to_the_same_image(name):
    sensor = preset(name).decimate(columns=preset(name).shape[1] // 4)
    generator = torch.Generator().manual_seed(7)
    ranges = torch.rand(sensor.shape, generator=generator) * 90 + 0.5
    ranges[torch.rand(sensor.shape, generator=generator) < 0.2] = 0
    scan = Scan(ranges, sensor)
    torch.testing.assert_close(Scan.from_points(scan.points(), sensor).ranges, ranges, **ROUND_TRIP)
    order = torch.randperm(int((ranges > 0).sum()), generator=generator)
    torch.testing.assert_close(Scan.from_points(scan.points()[order], sensor).ranges, ranges, **ROUND_TRIP)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (torch.tensor([[0.0, 0, 5], [math.nan, 0, 0]]), r"none of 2 points \(1 finite.*is in view of Sensor\(toy"),
        (torch.zeros(0, 3), "none of 0 points"),
        (torch.ones(5, 2), r"points has shape \(5, 2\); it should be \(N, 3 or more\)"),
        (torch.ones(3), r"points has shape \(3,\)"),
        (np.array([["a", "b", "c"]]), "points is of dtype .*; it should hold real numbers"),
    ],
)
def test_bad_points(points, message):
    with pytest.raises(ValueError, match=message):
        Scan.from_points(points, SENSOR)
