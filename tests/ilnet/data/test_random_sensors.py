import numpy as np
import pytest
import torch

from ilnet import data
from ilnet.data.random_sensors import draw_effects, draw_sensor
from ilnet.sensor import PAPER_INPUT
from ilnet.world.effects import Effects

DRAWS = 300


def draws():
    return [draw_sensor(np.random.default_rng([0, number])) for number in range(DRAWS)]


def test_the_same_seed_draws_the_same_sensor():
    assert draws() == draws()


def test_sensors_are_of_many_kinds():
    sensors = draws()
    others = [sensor for sensor in sensors if sensor != PAPER_INPUT]
    assert 0.2 < 1 - len(others) / DRAWS < 0.4
    gaps = [np.rad2deg(np.diff(sensor.elevations)) for sensor in others]
    uneven = [gap.max() / gap.min() > 1.1 for gap in gaps]
    assert 0.3 < np.mean(uneven) < 0.7
    assert min(gap.mean() for gap in gaps) < 0.6
    assert max(gap.mean() for gap in gaps) > 3
    assert len({sensor.shape for sensor in others}) > 20
    assert min(sensor.max_range for sensor in others) < 70 < 110 < max(sensor.max_range for sensor in others)


def test_every_sensor_is_upright_and_goes_full_circle():
    for sensor in draws():
        assert sensor.wrap
        assert sensor.upright() == sensor
        assert np.abs(np.rad2deg(sensor.elevations)).max() < 60
        assert np.rad2deg(np.ptp(sensor.elevations)) < 100


def test_effects_are_only_those_of_the_ranges():
    effects = [draw_effects(np.random.default_rng([0, number])) for number in range(DRAWS)]
    assert any(effect == Effects() for effect in effects)
    assert max(effect.range_noise for effect in effects) > 0.02
    assert max(effect.dropout for effect in effects) > 0.06
    assert {effect.divergence for effect in effects} == {0.0}


@pytest.fixture
def flat(quiet_place):
    corners = torch.tensor([[-500.0, -500, 0], [500, -500, 0], [500, 500, 0], [-500, 500, 0]])
    return quiet_place([[0.0, 0, 0]], (corners, torch.tensor([[0, 1, 2], [0, 2, 3]])))


def batches(place, sensors=(), **options):
    return iter(data.ContinuousRays([place], sensors, crops=4, columns=64, queries=200, seed=0, **options))


def test_a_batch_of_any_sensor_says_its_sensor_and_only_its_images_are_spoilt(flat, monkeypatch):
    found = [batch for batch, _ in zip(batches(flat), range(12), strict=False)]
    monkeypatch.setattr(data.batches, "spoil", lambda effects, ranges, *_: ranges)
    clean = [batch for batch, _ in zip(batches(flat), range(12), strict=False)]
    noisy = lossy = 0
    for batch, other in zip(found, clean, strict=True):
        assert batch.image.shape[1:] == batch.sensor.shape
        assert torch.equal(batch.ranges, other.ranges)
        nothing = batch.sensor.norm_range
        kept = (batch.image != nothing) & (other.image != nothing)
        noisy += bool((batch.image != other.image)[kept].any())
        lossy += int((batch.image == nothing).sum() > (other.image == nothing).sum())
    assert noisy > 6
    assert lossy > 4


def test_batches_of_any_sensor_are_the_same_whenever_and_in_however_many_parts_they_are_drawn(flat):
    whole = [batch for batch, _ in zip(batches(flat), range(5), strict=False)]
    later = next(batches(flat, start=4))
    assert torch.equal(later.image, whole[4].image)
    assert later.sensor == whole[4].sensor
    parts = [next(batches(flat, part=(number, 2))) for number in range(2)]
    assert torch.equal(torch.cat([part.image for part in parts]), whole[0].image)
    assert torch.equal(torch.cat([part.ranges for part in parts]), whole[0].ranges)


def test_each_batch_has_one_of_several_sensors(flat):
    several = [PAPER_INPUT, PAPER_INPUT.resize(8, 1024)]
    rows = {batch.image.shape[1] for batch, _ in zip(batches(flat, several), range(12), strict=False)}
    assert rows == {8, 16}
