import pytest
import torch

from ilnet import models
from ilnet.learning import calibration, metrics, train
from ilnet.scan import Scan
from ilnet.sensor import PAPER_INPUT, Sensor, preset

# The confidence of the shipped network is this near to the share of points that is right: on average over the points,
# and in each bin that holds a hundredth of them. It is too sure of points that it gives 50 to 80 %.
ERROR, FARTHEST_OFF = 0.05, 0.25


def test_reliability_by_hand():
    confidence = torch.tensor([0.05, 0.72, 0.78, 0.75, 0.79, 1.0])
    right = torch.tensor([False, True, True, True, False, True])
    low, high, sure = bins = calibration.reliability(confidence, right)
    assert low == (0.0, pytest.approx(0.05), 0.0, 1)
    assert high == (0.7, pytest.approx(0.76), 0.75, 4)
    assert sure == (0.9, 1.0, 1.0, 1)  # all from .9 to 1, both ends included
    assert calibration.calibration_error(bins) == pytest.approx((0.05 + 4 * 0.01) / 6)


@pytest.fixture
def pair():
    """A scan of 2 beams, and one of 3: the middle beam is what has to be predicted."""
    sensor = Sensor([-0.1, 0.0, 0.1], PAPER_INPUT.azimuths[:4], 1.0, 50.0, 60.0)
    truth = Scan(torch.tensor([[5.0, 5, 5, 5], [6.0, 6, 6, 0], [7.0, 7, 7, 7]]), sensor)
    return truth.decimate(2), truth


def test_points_are_right_to_10_cm_and_measured_ones_are_left_out(pair):
    predicted = torch.tensor([[5.0, 5, 5, 5], [6.09, 5.8, 0, 6], [7.0, 7, 7, 7]])
    confidence = torch.tensor([[1.0, 1, 1, 1], [0.9, 0.8, 0.7, 0.6], [1.0, 1, 1, 1]])
    answer = Scan(predicted, pair[1].sensor, confidence=confidence)
    told, right = calibration.told([answer, answer], [pair, pair])
    assert told.tolist() == pytest.approx([0.9, 0.8, 0.6] * 2)
    assert right.tolist() == [True, False, False] * 2
    with pytest.raises(ValueError, match="answers have no confidence"):
        calibration.told([pair[1]], [pair])


def test_the_least_confident_returns_are_dropped(pair):
    ranges = torch.ones(3, 4).where(torch.arange(12).view(3, 4) > 1, 0.0)  # 10 returns
    scan = Scan(ranges, pair[1].sensor, confidence=(torch.arange(12) / 12).view(3, 4) * ranges)
    kept = calibration.without_least(scan, 0.3)
    assert kept.ranges.flatten().tolist() == [0.0] * 5 + [1.0] * 7
    assert calibration.without_least(scan, 0.0).ranges.equal(ranges)
    assert calibration.without_least(kept.confident(1.0), 0.1).ranges.any().logical_not()


@pytest.fixture(scope="module")
def shipped():
    """What the shipped network predicts of held-out scans: by kind of sensor the answers, and the pairs of scans."""
    model, other = models.load("iln-surfaces"), preset("os1-64")
    kinds = [(PAPER_INPUT, train.VALIDATION, 2), (other.decimate(16), other, 2)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train, "HELD_OUT", dict([next(iter(train.HELD_OUT.items()))]))
        by_kind = train.held_out_pairs(kinds, torch.device("cpu"))
    return [([model.upsample(scan, truth.sensor) for scan, truth in pairs], pairs) for pairs in by_kind]


def test_the_shipped_confidence_is_calibrated_on_held_out_scans(shipped):
    for answers, pairs in shipped:
        told, right = calibration.told(answers, pairs)
        bins = calibration.reliability(told, right)
        assert calibration.calibration_error(bins) < ERROR
        assert all(abs(b.confidence - b.right) < FARTHEST_OFF for b in bins if b.points > len(told) / 100)
        shares = [b.right for b in bins]
        assert shares == sorted(shares)  # whatever is surer is right more often
        assert bins[0].right < 0.25
        assert bins[-1].right > 0.9


def test_most_floating_points_go_with_the_least_confident_tenth(shipped):
    for answers, pairs in shipped:
        floating = recall = left = kept_recall = 0.0
        for answer, (_, truth) in zip(answers, pairs, strict=True):
            kept = calibration.without_least(answer, 0.1)
            assert (kept.ranges > 0).sum() > 0.89 * (answer.ranges > 0).sum()
            floating += int(metrics.floating(answer.ranges, truth).sum())
            left += int(metrics.floating(kept.ranges, truth).sum())
            recall += metrics.compare(answer.ranges, truth)["recall"]
            kept_recall += metrics.compare(kept.ranges, truth)["recall"]
        assert left < 0.35 * floating
        assert kept_recall > 0.9 * recall
