"""Rows and columns found in points, and sensors that do not fit."""

from pathlib import Path

import numpy as np
import pytest

from ilnet.fit import doubt, fit, off_rows, same_rows
from ilnet.sensor import PRESETS, Sensor, preset

SCANS = sorted(Path(__file__).parents[3].joinpath("shared/data/scans").glob("*.npz"))
WANTED = np.deg2rad(0.02)


def returns(sensor: Sensor, ranges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points of ranges (H, W) in float32, as files have them, and their rows."""
    e, a = sensor.elevations[:, None], sensor.azimuths[None]
    directions = np.stack(np.broadcast_arrays(np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)), axis=-1)
    measured = ranges > 0
    return (directions * ranges[..., None])[measured].astype(np.float32), np.nonzero(measured)[0]


def street(sensor: Sensor, seed: int = 0, lost: float = 0.1, noise: float = 0.02) -> np.ndarray:
    """Ranges of a flat street between walls: 2 cm of noise, a tenth lost, the sky empty."""
    rng = np.random.default_rng(seed)
    e, a = sensor.elevations[:, None], sensor.azimuths[None]
    ground = 1.8 / np.maximum(np.sin(-e), 1e-3) + 0 * a
    wall = 9.0 / np.maximum(np.abs(np.sin(a)), 1e-3) / np.cos(e)
    ranges = np.minimum(ground, wall) + noise * rng.standard_normal(sensor.shape)
    sky = wall * np.sin(e) > 12.0
    return np.where(sky | (ranges > 90) | (rng.random(sensor.shape) < lost), 0.0, ranges)


def missed(found: np.ndarray, wanted: np.ndarray) -> float:
    """The largest distance of a wanted row from the nearest found one [deg]."""
    return np.rad2deg(np.abs(wanted[:, None] - found).min(axis=1).max())


@pytest.mark.skipif(not SCANS, reason="needs the measured scans in ../shared")
@pytest.mark.parametrize("path", SCANS, ids=lambda path: path.stem)
@pytest.mark.parametrize("bare", [True, False], ids=["bare", "ring"])
def test_rows_of_measured_scans(path, bare):
    with np.load(path) as file:
        sensor = Sensor.from_table(file)
        points, ring = returns(sensor, file["range"].astype(np.float64))
    found = fit([points], None if bare else [ring])
    wanted = sensor.elevations[np.unique(ring)]  # a row without a return cannot be found
    assert found.sensor.shape == (len(wanted), sensor.shape[1])
    assert missed(found.sensor.elevations, wanted) < 1e-3
    assert not found.unsure.any()
    assert found.off < 0.01
    assert found.origin == (0, 0)
    assert found.sensor.wrap
    np.testing.assert_allclose(
        np.sort(np.mod(found.sensor.azimuths, 2 * np.pi)), np.sort(np.mod(sensor.azimuths, 2 * np.pi)), atol=1e-4
    )


@pytest.mark.skipif(not SCANS, reason="needs the measured scans in ../shared")
def test_points_seen_from_the_base_of_a_sensor():
    """An Ouster's own points: its beams start 15.8 mm from the axis, and 36.2 mm above the origin of the points."""
    path = next(path for path in SCANS if "os1-128_1024" in path.stem)
    with np.load(path) as file:
        sensor, points = Sensor.from_table(file), file["xyz"][file["range"] > 0]
    found = fit([points])
    assert found.origin == pytest.approx((0.0158, 0.0362), abs=1e-3)
    assert found.sensor.shape[0] == 128
    assert missed(found.sensor.elevations, sensor.elevations) < 0.02


@pytest.mark.parametrize("name", ["vlp-16", "vls-128", "hdl-64e", "pandar40p", "rs-ruby-plus"])
def test_rows_of_a_simulated_street(name):
    sensor = preset(name)
    points, row = returns(sensor, street(sensor))
    found = fit([points])
    wanted = sensor.elevations[np.bincount(row, minlength=len(sensor.elevations)) > 2]
    assert found.sensor.shape == (len(wanted), sensor.shape[1])
    assert missed(found.sensor.elevations, wanted) < 1e-3
    assert found.sensor.name == name
    assert found.sensor.max_range == sensor.max_range


def test_several_clouds_have_more_rows():
    """Each cloud has the returns of other rows; those with few count."""
    sensor = preset("os1-32-gradient")
    ranges = street(sensor)
    ranges[:2] = 0
    ranges[:2, 100:105] = 20.0  # five returns
    first, second = ranges.copy(), ranges.copy()
    first[::3] = 0
    second[1::3] = 0
    clouds = [returns(sensor, part)[0] for part in (first, second)]
    found = fit(clouds)
    assert missed(found.sensor.elevations, sensor.elevations) < 1e-3
    assert found.returns.sum() == sum(map(len, clouds))
    assert found.sensor.shape[0] == 32
    with pytest.raises(AssertionError):
        np.testing.assert_equal(fit(clouds[:1]).sensor.shape[0], 32)


def test_coordinates_in_centimetres():
    sensor = preset("os1-64")
    points, _ = returns(sensor, street(sensor))
    found = fit([np.round(points, 2)])
    assert found.sensor.shape == sensor.shape
    assert missed(found.sensor.elevations, sensor.elevations) < 0.02


def test_a_sector():
    sensor = preset("vlp-32c")
    sensor = Sensor(sensor.elevations, sensor.azimuths[600:900])
    points, _ = returns(sensor, street(sensor))
    found = fit([points]).sensor
    assert found.shape == (32, 300)
    assert not found.wrap
    np.testing.assert_allclose(found.azimuths, sensor.azimuths, atol=np.deg2rad(0.02))


def test_rings_are_taken_as_they_are():
    """Where rows overlap as these do, only their numbers tell them apart; whatever the numbers are."""
    sensor = Sensor(np.deg2rad(np.linspace(-5, -15, 12)), preset("os1-32").azimuths)
    points, ring = returns(sensor, street(sensor, noise=0.0))
    blurred = points + np.random.default_rng(0).normal(0, 0.05, points.shape)
    found = fit([blurred], [7 * (20 - ring)])
    assert missed(found.sensor.elevations, sensor.elevations) < 0.05
    assert found.sensor.shape[0] == 12


def test_points_without_rows():
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match=r"no rows stand out in 4000 points; .*upright, and neither moved nor merged"):
        fit([rng.standard_normal((4000, 3))])
    with pytest.raises(ValueError, match="points holds 0 finite points off the origin"):
        fit([np.full((9, 3), np.nan), np.zeros((9, 3))])
    flat = np.stack([np.cos(np.arange(99)), np.sin(np.arange(99)), np.zeros(99)], axis=1)
    with pytest.raises(ValueError, match=r"row\(s\) stand out in 99 points; a sensor has at least 2"):
        fit([flat])


def judged(points: np.ndarray, sensor: Sensor, lost: float = 0.0) -> str:
    distance = np.linalg.norm(points, axis=1)
    return doubt(sensor, np.arcsin(points[:, 2] / distance), distance, lost)


def test_a_wrong_sensor_is_doubted():
    points, _ = returns(preset("vls-128"), street(preset("vls-128")))
    assert judged(points, preset("vls-128")) == ""
    for name in ("os1-128", "hdl-32e", "hdl-64e", "pandar64", "vlp-16", "paper-64x1024"):
        assert f"% of the points lie off the rows of {name}; is it the right sensor?" in judged(points, preset(name))
    assert "60% of the points share a pixel of vls-128 with a nearer one" in judged(points, preset("vls-128"), 0.6)


@pytest.mark.parametrize("name", [name for name in PRESETS if not name.startswith("paper")])
def test_the_right_sensor_is_not_doubted_in_spite_of_noise(name):
    sensor = preset(name)
    sensor = Sensor(sensor.elevations, sensor.azimuths[::8], name=name)
    points, _ = returns(sensor, street(sensor))
    assert judged(points, sensor) == ""
    points += np.random.default_rng(0).normal((0, 0, 0.036), 0.02, points.shape)
    assert judged(points, sensor) == ""


@pytest.mark.skipif(not SCANS, reason="needs the measured scans in ../shared")
@pytest.mark.parametrize("path", SCANS, ids=lambda path: path.stem)
def test_measured_scans_are_not_doubted(path):
    with np.load(path) as file:
        sensor = Sensor.from_table(file)
        points, _ = returns(sensor, file["range"].astype(np.float64))
    points = points[::7]
    noise = np.random.default_rng(0).normal(0, 0.02, points.shape)
    assert judged(points, sensor) == judged(points + noise, sensor) == ""


def test_few_points_tell_nothing():
    assert np.isnan(off_rows(preset("vls-128"), np.full(99, 0.3), np.full(99, 90.0)))
    near = np.random.default_rng(0).uniform(-0.2, 0.1, 9999)
    assert np.isnan(off_rows(preset("vls-128"), near, np.full(9999, 2.0)))


def test_near_points_tell_where_they_are_exact():
    rows = np.repeat(preset("vlp-32c").elevations, 300).astype(np.float32).astype(np.float64)
    assert off_rows(preset("vlp-32c"), rows, np.full(len(rows), 2.0)) == 0
    assert off_rows(preset("os1-128"), rows, np.full(len(rows), 2.0)) > 0.4


def test_rows_of_a_preset():
    rows = preset("vls-128").elevations
    assert same_rows(rows) == "vls-128"
    assert same_rows(np.delete(rows, 3)[::-1] + WANTED / 2) == "vls-128"
    assert same_rows(rows + 2 * WANTED) == ""
    assert same_rows(rows[:64]) == ""
