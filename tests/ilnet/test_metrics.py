import math

import pytest
import torch

from ilnet.metrics import compare, voxels
from ilnet.scan import Scan
from ilnet.sensor import Sensor

# Two rays along +x and +y at elevation 0, and two straight at 45° up.
SENSOR = Sensor(torch.tensor([0.0, math.pi / 4]), torch.tensor([0.0, math.pi / 2]), 2.0, 80.0, 100.0)


def scan(*ranges):
    return Scan(torch.tensor(ranges).view(2, 2), SENSOR)


def test_voxels_are_counted_once_with_floor():
    points = torch.tensor([[0.05, 0.05, 0.05], [0.09, 0.01, 0.02], [-0.05, 0.05, 0.05], [0.15, 0.05, 0.05]])
    assert len(voxels(points)) == 3
    assert len(voxels(torch.tensor([[0.05, 0.0, 0.0], [0.0, 0.05, 0.0], [0.0, 0.0, 0.05]]))) == 1
    assert len(voxels(torch.tensor([[1000.05, 0, 0], [0, 1000.05, 0], [0, 0, 1000.05], [-1000.05, 0, 0]]))) == 4
    assert len(voxels(torch.empty(0, 3))) == 0


def test_a_perfect_prediction():
    truth = scan(10.05, 20.05, 30.05, 0.0)
    figures = compare(truth.filled(), truth)
    assert figures == {"mae": 0.0, "iou": 1.0, "precision": 1.0, "recall": 1.0, "f1": pytest.approx(1.0)}


def test_by_hand():
    truth = scan(10.05, 20.05, 30.05, 0.0)
    # First ray right, second one voxel off, third lost, fourth invented.
    figures = compare(torch.tensor([[10.05, 20.15], [100.0, 50.05]]), truth)
    assert figures["mae"] == pytest.approx((0 + 0.1 + 69.95 + 49.95) / 4, abs=1e-4)
    assert figures["iou"] == pytest.approx(1 / 5)
    assert figures["precision"] == pytest.approx(1 / 3)
    assert figures["recall"] == pytest.approx(1 / 3)
    assert figures["f1"] == pytest.approx(1 / 3)


def test_uneven_counts_tell_precision_from_recall():
    truth = scan(10.05, 20.05, 30.05, 40.05)
    figures = compare(torch.tensor([[10.05, 100.0], [100.0, 100.0]]), truth)
    assert figures["precision"] == 1
    assert figures["recall"] == pytest.approx(1 / 4)
    assert figures["f1"] == pytest.approx(2 / 5)


def test_out_of_limits_counts_for_the_error_and_not_for_voxels():
    truth = scan(10.05, 1.0, 0.0, 0.0)
    figures = compare(torch.tensor([[10.05, 1.5], [90.0, 300.0]]), truth)
    assert figures["iou"] == 1
    # 300 m is clipped to 100 m, which is what no return counts as.
    assert figures["mae"] == pytest.approx((0 + 0.5 + 10 + 0) / 4, abs=1e-5)


def test_nothing_predicted_and_nothing_there():
    truth = scan(0.0, 0.0, 0.0, 0.0)
    figures = compare(torch.full((2, 2), 100.0), truth)
    assert figures == {"mae": 0, "iou": 0, "precision": 0, "recall": 0, "f1": 0}


def test_bad_predictions_are_refused():
    with pytest.raises(ValueError, match=r"ranges has shape \(2, 3\)"):
        compare(torch.ones(2, 3), scan(0.0, 0.0, 0.0, 3.0))
    with pytest.raises(ValueError, match="holds 4 NaN"):
        compare(torch.full((2, 2), math.nan), scan(0.0, 0.0, 0.0, 3.0))
