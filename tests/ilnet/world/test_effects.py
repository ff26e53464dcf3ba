"""What a real sensor does to a scan: every effect against the closed form that its documentation states."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from ilnet.sensor import Sensor, preset
from ilnet.world import simulate
from ilnet.world.effects import RANGE_RESOLUTION, REFERENCE_RANGE, Effects, simulate_with
from ilnet.world.simulate import cast, pose
from kernels import Mesh

# float32 of coordinates up to 100 m.
METRES = 1e-3
# Chance deviations beyond this many standard deviations come once in 1.7 million draws, and the seeds are fixed.
SIGMAS = 5
# How well a beam's 19 sub-rays know what share of it an edge covers: at worst two of them lie in line.
SHARE = 0.11

FRONT = Sensor(np.linspace(-0.3, 0.3, 64), np.linspace(-1.2, 1.2, 512), 0.5, 100, 120)
ORIGIN = pose((0.0, 0.0, 0.0))


def plates(*quads, device="cpu"):
    """A mesh of parallelograms, each of a corner and two edges [m]."""
    vertices = []
    for corner, a, b in quads:
        c, a, b = (torch.tensor(v, dtype=torch.float64) for v in (corner, a, b))
        vertices += [c, c + a, c + a + b, c + b]
    first = 4 * torch.arange(len(quads))[:, None]
    triangles = torch.cat((first + torch.tensor([0, 1, 2]), first + torch.tensor([0, 2, 3])))
    return Mesh(torch.stack(vertices), triangles, device)


def wall(x, y=-400.0, width=800.0):
    """A plate across the x axis, from y on."""
    return (x, y, -400.0), (0.0, width, 0.0), (0.0, 0.0, 800.0)


GROUND = (-400.0, -400.0, -1.8), (800.0, 0.0, 0.0), (0.0, 800.0, 0.0)


def scan(effects, mesh, sensor=FRONT, seed=0, at=ORIGIN):
    return simulate_with(effects, [mesh], sensor, at, torch.Generator().manual_seed(seed))


def angles(sensor):
    return torch.tensor(sensor.elevations)[:, None], torch.tensor(sensor.azimuths)[None, :]


def assert_frequency(struck, probability):
    """That as many of independent events happened as their probabilities let one expect."""
    spread = (probability * (1 - probability)).sum().sqrt()
    assert (struck.sum() - probability.sum()).abs() < SIGMAS * spread


# Nothing on


@pytest.mark.parametrize("name", ["paper-16x1024", "os1-32", "vlp-16"])
def test_without_effects_it_is_the_plain_scan_bit_for_bit(name, device):
    mesh, at = plates(GROUND, wall(8.0, 3.0), wall(-20.0), device=device), pose((0.3, 0.2, 0.1), 0.7, 0.02, -0.01)
    found = scan(Effects(), mesh, preset(name), at=at)
    # Not `simulate`, which does without rays where that is faster, and rounds otherwise.
    expected = cast(mesh, at, preset(name).directions().view(-1, 3), preset(name).max_range).view(preset(name).shape)
    assert torch.equal(found.ranges, expected.where(expected >= preset(name).min_range, 0.0))
    assert found.ranges.device.type == device.type
    assert found.intensity is None


def test_the_nearest_hit_of_all_meshes_counts(device):
    near, far = plates(wall(8.0, 0.0), device=device), plates(wall(20.0), device=device)
    both = plates(wall(8.0, 0.0), wall(20.0), device=device)
    expected = simulate.scan(both, FRONT, ORIGIN).ranges
    assert (expected < 15).any()
    assert (expected > 15).any()
    for meshes in ([near, far], [far, near]):
        found = simulate_with(Effects(), meshes, FRONT, ORIGIN, torch.Generator()).ranges
        torch.testing.assert_close(found, expected, atol=METRES, rtol=0)


def test_the_seed_decides(yard):
    effects = Effects(range_noise=0.02, dropout_range=0.5)
    sensor = preset("paper-16x1024")
    first, again, other = (scan(effects, yard, sensor, seed, pose((0.0, 0.0, 1.8))).ranges for seed in (1, 1, 2))
    assert torch.equal(first, again)
    both = (first > 0) & (other > 0)
    assert (first[both] != other[both]).float().mean() > 0.9
    # Another effect leaves the noise of the pixels that stay.
    alone = scan(replace(effects, dropout_range=0.0), yard, sensor, 1, pose((0.0, 0.0, 1.8))).ranges
    assert torch.equal(alone[first > 0], first[first > 0])


# Noise


@pytest.mark.parametrize(("constant", "growth"), [(0.03, 0.0), (0.0, 0.002), (0.01, 0.001)])
def test_range_noise_is_gaussian_and_grows_as_stated(device, constant, growth):
    mesh = plates(wall(10.0), device=device)
    plain = scan(Effects(), mesh).ranges
    found = scan(Effects(range_noise=constant, range_noise_growth=growth), mesh).ranges
    normal = (found - plain) / (constant + growth * plain)
    for part in (normal, normal[plain < 12], normal[plain > 18]):
        count = part.numel()
        assert count > 4000
        assert part.mean().abs() < SIGMAS / math.sqrt(count)
        assert (part.std() - 1).abs() < SIGMAS / math.sqrt(2 * count)
        beyond_two = torch.full((count,), math.erfc(math.sqrt(2)))
        assert_frequency(part.cpu().abs() > 2, beyond_two)


def test_noise_neither_makes_returns_nor_breaks_the_limits():
    mesh = plates(wall(5.0, 0.0))
    sensor = replace(FRONT, min_range=5.0, max_range=6.0)
    plain, found = scan(Effects(), mesh, sensor).ranges, scan(Effects(range_noise=0.3), mesh, sensor).ranges
    assert not found[plain == 0].any()
    assert ((found == 0) | ((found >= 5) & (found <= 6))).all()
    assert 0.2 < (found[plain > 0] == 0).float().mean() < 0.8


# Dropout


def test_dropout_by_range_follows_its_formula(device):
    mesh, sensor = plates(GROUND, device=device), replace(FRONT, elevations=np.linspace(-0.2, -0.02, 64))
    plain = scan(Effects(), mesh, sensor).ranges.cpu()
    lost = scan(Effects(dropout_range=0.6), mesh, sensor).ranges.cpu() == 0
    for near, far in ((0, 20), (20, 50), (50, 100)):
        there = (plain > near) & (plain < far)
        assert there.sum() > 1000
        assert_frequency(lost[there], 0.6 * (plain[there] / 100) ** 2)


def test_dropout_by_incidence_follows_its_formula(device):
    mesh = plates(wall(10.0), device=device)
    elevation, azimuth = angles(FRONT)
    cosine = elevation.cos() * azimuth.cos()
    lost = scan(Effects(dropout_incidence=0.9), mesh).ranges.cpu() == 0
    for low, high in ((0.3, 0.5), (0.5, 0.8), (0.8, 1.0)):
        there = (cosine > low) & (cosine <= high)
        assert_frequency(lost[there], 0.9 * (1 - cosine[there]) ** 2)


def test_both_dropouts_strike_independently():
    elevation, azimuth = angles(FRONT)
    cosine = elevation.cos() * azimuth.cos()
    lost = scan(Effects(dropout_range=0.5, dropout_incidence=0.5), plates(wall(30.0))).ranges == 0
    kept = (1 - 0.5 * (0.3 / cosine) ** 2) * (1 - 0.5 * (1 - cosine) ** 2)
    kept = kept.where(30 / cosine < 100, 0.0)
    assert_frequency(lost, 1 - kept)


# Intensity


def test_intensity_is_lambert_s(device):
    mesh = plates(wall(6.0), device=device)
    elevation, azimuth = angles(FRONT)
    cosine = elevation.cos() * azimuth.cos()
    expected = (cosine * (REFERENCE_RANGE * cosine / 6.0) ** 2).clamp(max=1).float()
    assert (expected == 1).any()
    assert (expected < 0.3).any()
    found = scan(Effects(intensity=True), mesh)
    torch.testing.assert_close(found.intensity.cpu(), expected, atol=1e-4, rtol=0)
    noisy = scan(Effects(intensity=True, range_noise=0.1, dropout_incidence=0.5), mesh)
    stays = noisy.ranges > 0
    assert torch.equal(noisy.intensity[stays], found.intensity[stays])
    assert not noisy.intensity[~stays].any()


# Beams with a width

DIVERGENCE = 0.004
# Beams that look at the edge at y = 0 from 2 footprints right of it to 2 left of it.
ACROSS = Sensor([-1e-4, 1e-4], np.linspace(-2, 2, 400) * DIVERGENCE, 0.5, 100, 120)


def covered():
    """Share of each beam of ACROSS left of the edge: a disc cut by a line at distance d of its middle, in radii."""
    d = (torch.tensor(ACROSS.azimuths).tan() / math.tan(DIVERGENCE / 2)).clamp(-1, 1)
    return 1 - (d.acos() - d * (1 - d**2).sqrt()) / math.pi


@pytest.mark.parametrize("returns", ["first", "strongest", "last"])
def test_which_return_is_reported_at_an_edge(device, returns):
    near, far = 10.0, 20.0
    mesh = plates(wall(near, 0.0), wall(far), device=device)
    found = scan(Effects(divergence=DIVERGENCE, returns=returns), mesh, ACROSS).ranges.cpu()
    is_near = found < 15
    torch.testing.assert_close(found, torch.tensor(far).where(~is_near, near), atol=METRES, rtol=0)
    share = covered()
    # The energies are as share and 1 / r²: near wins from a share of 1/5 on.
    turns = {"first": 0.0, "strongest": near**2 / (near**2 + far**2), "last": 1.0}[returns]
    assert is_near[:, share > turns + SHARE].all()
    assert not is_near[:, share < turns - SHARE].any()
    # Whole beams on one side hit but one wall; a beam that is cut can report either.
    assert is_near[:, share == 1].all()
    assert not is_near[:, share == 0].any()
    cut = (share > SHARE) & (share < 1 - SHARE)
    assert is_near[:, cut].all() == (returns == "first")
    assert is_near[:, cut].any() == (returns != "last")


def test_the_energy_of_a_return_is_the_share_of_the_beam_that_hit(device):
    mesh = plates(wall(REFERENCE_RANGE, 0.0), wall(30.0), device=device)
    found = scan(Effects(divergence=DIVERGENCE, returns="first", intensity=True), mesh, ACROSS).intensity.cpu()
    share = covered()
    cut = share > SHARE
    error = (found - share)[:, cut]
    assert error.abs().max() < SHARE
    assert error.square().mean().sqrt() < SHARE / 3
    assert error.mean().abs() < 0.01  # no lean to one side
    assert (found[:, share == 0] < 0.12).all()  # (10 m / 30 m)², the far wall's


@pytest.mark.parametrize("returns", ["first", "strongest", "last"])
def test_surfaces_too_close_to_tell_apart_give_a_range_between(returns):
    step = 0.6 * RANGE_RESOLUTION
    mesh = plates(wall(10.0, 0.0), wall(10.0 + step))
    found = scan(Effects(divergence=DIVERGENCE, returns=returns), mesh, ACROSS).ranges
    share = covered()
    near, far = share / 10.0**2, (1 - share) / (10 + step) ** 2
    expected = 10 + step * (far / (near + far)).float()
    torch.testing.assert_close(found, expected.expand_as(found), atol=step * SHARE, rtol=0)
    assert ((found > 10 + 0.2 * step) & (found < 10 + 0.8 * step)).any()


def test_a_wide_beam_is_round():
    upright, lying = plates(wall(10.0, 0.0)), plates(((10.0, -400.0, 0.0), (0.0, 800.0, 0.0), (0.0, 0.0, 400.0)))
    down = Sensor(ACROSS.azimuths, ACROSS.elevations, 0.5, 100, 120)
    effects = Effects(divergence=DIVERGENCE, intensity=True)
    left = scan(effects, upright, ACROSS).intensity[0]
    above = scan(effects, lying, down).intensity[:, 0]
    assert (left - above).abs().max() < SHARE
    assert left.sum() == pytest.approx(float(above.sum()), rel=0.002)


def test_a_wide_beam_changes_no_flat_wall(device):
    mesh = plates(wall(10.0), device=device)
    plain, wide = scan(Effects(), mesh), scan(Effects(divergence=0.002), mesh)
    # Seen at 1.2 rad, the wall recedes by 7 cm within a footprint; but its far part sends less back.
    torch.testing.assert_close(wide.ranges, plain.ranges, atol=METRES, rtol=0)


def test_hits_nearer_than_the_minimum_range_hide_what_is_behind():
    sensor = replace(ACROSS, min_range=12.0)
    mesh = plates(wall(10.0, 0.0), wall(30.0))
    found = scan(Effects(divergence=DIVERGENCE, returns="first"), mesh, sensor).ranges[0]
    share = covered()
    assert not found[share == 1].any()
    assert (found[share < 1 - SHARE] > 29).all()


# Staggered columns and motion


def test_each_beam_looks_along_its_own_azimuth(device):
    offsets = np.deg2rad(np.tile([-4.2, -1.4, 1.4, 4.2], 16))
    found = scan(Effects(azimuth_offsets=offsets), plates(wall(10.0), device=device)).ranges.cpu()
    elevation, azimuth = angles(FRONT)
    expected = 10 / (elevation.cos() * (azimuth + torch.tensor(offsets)[:, None]).cos())
    torch.testing.assert_close(found, expected.float(), atol=METRES, rtol=0)


def turn(falling):
    """A full circle of even columns, and the part of the turn that has passed as each is fired, -1/2 to 1/2."""
    passed = torch.arange(256) / 256 - 255 / 512
    azimuths = -math.tau * passed if falling else math.tau * passed
    return Sensor(np.linspace(-0.3, 0.3, 16), azimuths.numpy(), 0.5, 100, 120), passed


@pytest.mark.parametrize("falling", [False, True])
def test_linear_motion_shifts_the_origin_of_each_column(device, falling):
    sensor, passed = turn(falling)
    # The sensor's nose points along the world's y, and so does its velocity.
    mesh = plates(((-400.0, 30.0, -400.0), (800.0, 0.0, 0.0), (0.0, 0.0, 800.0)), device=device)
    at = pose((3.0, 2.0, 1.0), math.pi / 2)
    found = scan(Effects(velocity=(20.0, 0.0, 0.0), turn_time=0.1), mesh, sensor, at=at).ranges.cpu()
    elevation, azimuth = angles(sensor)
    expected = (28 - 20 * 0.1 * passed) / (elevation.cos() * azimuth.cos())
    expected = expected.where((expected > 0) & (expected < 100), 0.0).float()
    torch.testing.assert_close(found, expected, atol=METRES, rtol=0)
    assert (found > 0).sum() > 1000


@pytest.mark.parametrize("falling", [False, True])
def test_angular_motion_turns_the_rays_of_each_column(device, falling):
    sensor, passed = turn(falling)
    found = scan(Effects(angular_velocity=(0, 0, 1.5)), plates(wall(20.0), device=device), sensor).ranges.cpu()
    elevation, azimuth = angles(sensor)
    expected = 20 / (elevation.cos() * (azimuth + 1.5 * 0.1 * passed).cos())
    expected = expected.where((expected > 0) & (expected < 100), 0.0).float()
    torch.testing.assert_close(found, expected, atol=METRES, rtol=0)


def test_both_motions_together_drive_an_arc():
    """A car at constant speed and steering: position along a circle, heading along its tangent."""
    sensor, passed = turn(falling=True)
    speed, rate, time = 15.0, 2.0, 0.4
    effects = Effects(velocity=(speed, 0, 0), angular_velocity=(0, 0, rate), turn_time=time)
    found = scan(effects, plates(wall(30.0)), sensor).ranges
    elevation, azimuth = angles(sensor)
    heading = rate * time * passed
    x = speed / rate * heading.sin()
    expected = (30 - x) / (elevation.cos() * (azimuth + heading).cos())
    expected = expected.where((expected > 0) & (expected < 100), 0.0).float()
    torch.testing.assert_close(found, expected, atol=METRES, rtol=0)


def test_pitch_and_roll_tilt_the_ground():
    sensor, passed = turn(falling=False)
    elevation, azimuth = angles(sensor)
    forward, left, up = elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()
    tilt = 0.8 * 0.1 * passed  # pitch lowers the nose, roll raises the left side
    for rates, rise in (((0, 0.8, 0), -forward), ((0.8, 0, 0), left)):
        found = scan(Effects(angular_velocity=rates), plates(GROUND), sensor).ranges
        down = -(rise * tilt.sin() + up * tilt.cos())
        expected = (1.8 / down).where(down > 0.018, 0.0).float()
        torch.testing.assert_close(found, expected, atol=5e-3, rtol=0)  # grazing rays of float32, up to 100 m


# Bad input


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"range_noise": -0.1}, "range_noise is -0.1; it should lie from 0 to inf: a standard deviation"),
        ({"range_noise": math.nan}, "range_noise is nan; it should be finite"),
        ({"range_noise_growth": "much"}, "range_noise_growth is .*much.*should hold numbers"),
        ({"dropout_range": 1.5}, "dropout_range is 1.5; it should lie from 0 to 1: a probability"),
        ({"dropout_incidence": -1}, "dropout_incidence is -1"),
        ({"intensity": 0.5}, "intensity is 0.5; it should be True or False"),
        ({"divergence": 3.0}, "divergence is 3; it should lie from 0 to 0.1: an angle in radians"),
        ({"returns": "second"}, "returns is 'second'; it should be one of first, strongest, last"),
        (
            {"azimuth_offsets": [4.2, -5.6]},
            "azimuth_offsets reaches -5.6 rad; it should be at most half a turn: are these degrees",
        ),
        ({"azimuth_offsets": 0.1}, "azimuth_offsets is 0.1; it should hold numbers"),
        ({"velocity": (1.0, 2.0)}, "velocity has 2 numbers; it should have three: m/s along x, y and z"),
        ({"angular_velocity": (0, 0, math.inf)}, "angular_velocity is .*; it should be finite: rad/s"),
        ({"turn_time": 0}, "turn_time is 0; it should be above 0"),
    ],
)
def test_bad_effects(bad, message):
    with pytest.raises(ValueError, match=message):
        Effects(**bad)


def test_bad_arguments(yard):
    with pytest.raises(ValueError, match="meshes is empty; it should hold at least one Mesh"):
        simulate_with(Effects(), [], FRONT, ORIGIN, torch.Generator())
    with pytest.raises(ValueError, match="azimuth_offsets has 3 entries; it should have 64, one for each beam"):
        scan(Effects(azimuth_offsets=[0.1, 0.0, 0.1]), yard)
