import pytest
import torch

from ilnet import models
from ilnet.learning import evaluate
from ilnet.scan import Scan
from ilnet.sensor import PAPER_INPUT, preset
from ilnet.world import simulate


@pytest.fixture
def pair(yard):
    here = simulate.pose((0.0, 0.0, 1.8))
    return tuple(simulate.scan(yard, PAPER_INPUT.resize(*size), here) for size in ((8, 256), (32, 256)))


def test_measures_each_model_over_all_pairs(pair):
    scan, truth = pair
    empty = Scan(scan.ranges, scan.sensor), Scan(truth.ranges * 0, truth.sensor)
    loaded = {"one": models.load("nearest"), "other": models.load("bilinear-inverse")}
    one, other = evaluate.measure(loaded, [pair])
    assert (one["model"], other["model"]) == ("one", "other")
    assert (one["size"], one["scans"]) == ("32x256", 1)
    assert other["iou"] > one["iou"] > 0  # most of the yard is a plane
    both = evaluate.measure(loaded, [pair, empty])
    assert [row["iou"] for row in both] == pytest.approx([one["iou"] / 2, other["iou"] / 2])


def test_a_model_elsewhere_is_refused_and_stays_there(pair):
    model = models.create("iln", features=16, blocks=1, heads=4).to("meta")
    with pytest.raises(ValueError, match="model is on meta; it should be on cpu"):
        evaluate.measure({"iln": model}, [pair])
    assert {weight.device.type for weight in model.parameters()} == {"meta"}


def test_intervals_hold_the_mean_and_tell_who_is_ahead(pair):
    scan, truth = pair
    half = scan.decimate(4), truth
    loaded = {"nearest": models.load("nearest"), "planes": models.load("planes")}
    nearest, planes = evaluate.summary(evaluate.scan_by_scan(loaded, [pair, half, pair]), [pair, half, pair])
    for row in (nearest, planes):
        low, high = row["iou_interval"]
        assert low < row["iou"] < high
    assert planes["iou_difference"] == pytest.approx(planes["iou"] - nearest["iou"])
    assert planes["iou_difference_interval"][0] > 0
    assert "iou_difference" not in nearest
    [alone] = evaluate.summary(evaluate.scan_by_scan({"planes": models.load("planes")}, [pair]), [pair])
    assert "iou_interval" not in alone  # one scan says nothing of others


def test_interval_of_few_values():
    assert evaluate.interval([0.5]) is None
    assert evaluate.interval([0.5, float("nan")]) is None
    assert evaluate.interval([0.5, 0.5]) == (0.5, 0.5)


def test_any_sensor_is_predicted_from_any_other_in_a_town(monkeypatch, quiet_place):
    monkeypatch.setattr(simulate, "best_device", lambda: torch.device("cpu"))
    monkeypatch.setattr(evaluate.places, "town", lambda name, device: quiet_place([[3, 0, 0], [3, 5, 0], [0, 9, 0]]))
    other = preset("vlp-16")
    for arguments, source in (((), PAPER_INPUT), ((other.decimate(8),), other.decimate(8))):
        [(scan, truth)] = evaluate.town_pairs("town07", 1, other, *arguments)
        assert (scan.sensor, truth.sensor) == (source, other)
    assert torch.equal(scan.ranges, truth.decimate(8).ranges)  # from the same place
