import json
import math
import subprocess
import sys

import numpy as np
import pytest
import torch

from ilnet import models
from ilnet.learning.metrics import FIGURES, ScanMetrics, chamfer, compare, edges, floating, voxels
from ilnet.scan import Scan
from ilnet.sensor import Sensor, preset

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
    perfect = {"mae": 0.0, "iou": 1.0, "precision": 1.0, "recall": 1.0, "f1": pytest.approx(1.0)}
    assert figures == {**perfect, "floating": 0.0, "edge_mae": 0.0, "flat_mae": 0.0}
    assert tuple(figures) == FIGURES


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
    # 300 m is clipped to 100 m, which is what no return counts as. 1 m and 1.5 m are nearer than the sensor measures.
    assert figures["mae"] == pytest.approx((0 + 0 + 10 + 0) / 4, abs=1e-5)


def test_nothing_predicted_and_nothing_there():
    truth = scan(0.0, 0.0, 0.0, 0.0)
    figures = compare(torch.full((2, 2), 100.0), truth)
    assert figures == dict.fromkeys(FIGURES, 0)


def test_bad_predictions_are_refused():
    with pytest.raises(ValueError, match=r"ranges has shape \(2, 3\)"):
        compare(torch.ones(2, 3), scan(0.0, 0.0, 0.0, 3.0))
    with pytest.raises(ValueError, match="holds 4 NaN"):
        compare(torch.full((2, 2), math.nan), scan(0.0, 0.0, 0.0, 3.0))


def view(columns, rows=6, wrap=False):
    """A sensor of rays about 0.35 degrees apart, or of a full circle."""
    azimuths = np.linspace(-180, 180, columns, endpoint=False) if wrap else np.arange(columns) * 0.35
    return Sensor(np.deg2rad(np.linspace(-1, 1, rows)), np.deg2rad(azimuths), 2.0, 80.0, 100.0)


def step(near=10.0, far=20.0, columns=16, wrap=False):
    """Ranges with a step in the middle, and their scan."""
    ranges = torch.full((6, columns), far)
    ranges[:, : columns // 2] = near
    return Scan(ranges, view(columns, wrap=wrap))


def test_a_point_between_two_surfaces_floats(device):
    truth = step()
    truth = Scan(truth.ranges.to(device), truth.sensor)
    # Of all 5×5 neighbourhoods, those around columns 6 to 9 hold both sides of the step.
    assert edges(truth).any(0).tolist() == edges(truth).all(0).tolist() == [6 <= column <= 9 for column in range(16)]
    ranges = truth.ranges.clone()
    ranges[:, 7], ranges[:, 8] = 13.0, 17.0
    ranges[:, 5] = 15.0  # nothing of the neighbourhood lies behind it: wrong, but not between two surfaces
    ranges[0, 7] = 10.2  # on the near one, but for noise
    ranges[1, 7] = 19.8
    ranges[2, 7] = 9.0  # before both
    ranges[3, 7] = 21.0  # behind both
    assert floating(ranges, truth).sum(0).tolist() == [0] * 7 + [2, 6] + [0] * 7
    figures = compare(ranges, truth)
    assert figures["floating"] == pytest.approx(8 / 96)
    assert figures["edge_mae"] == pytest.approx((0.2 + 9.8 + 1 + 11 + 2 * 3 + 6 * 3) / 24, abs=1e-5)
    assert figures["flat_mae"] == pytest.approx(6 * 5 / 72)


def test_only_returns_float():
    truth = step(40.0, 0.0)
    ranges = truth.filled()
    ranges[:, 7], ranges[:3, 8], ranges[3:, 8] = 70.0, 79.0, 95.0
    assert floating(ranges, truth).sum(0).tolist() == [0] * 7 + [6, 3] + [0] * 7
    # 24 pixels hold the edge to the sky and 21 of the rays that return, 9 of which float.
    assert compare(ranges, truth)["floating"] == pytest.approx(9 / (8 * 6 + 3))


def test_edges_and_surfaces_go_round_the_seam():
    half = step(columns=1024, wrap=True)
    assert edges(half).any(0).nonzero().squeeze(1).tolist() == [0, 1, 510, 511, 512, 513, 1022, 1023]
    ranges = half.ranges.clone()
    ranges[:, 0] = 15.0
    assert floating(ranges, half)[:, 0].all()
    opened = step(columns=1000)
    assert edges(opened).any(0).nonzero().squeeze(1).tolist() == [498, 499, 500, 501]


def test_a_thin_pole_is_a_surface_of_its_own():
    truth = step(20.0, 20.0)
    truth.ranges[:, 8] = 10.0
    ranges = truth.ranges.clone()
    ranges[:, 7], ranges[:, 9] = 10.1, 15.0
    assert floating(ranges, truth).sum(0).tolist() == [0] * 9 + [6] + [0] * 6


def test_the_ground_has_no_edges_however_flat_it_is_seen():
    sensor = preset("paper-64x1024")
    ranges = (1.8 / -torch.tensor(sensor.elevations).sin()).float()
    ranges = ranges.where((ranges > 0) & (ranges < 80), 0.0)[:, None].expand(sensor.shape)
    truth = Scan(ranges, sensor)
    ground = int((ranges[:, 0] > 0).sum())
    assert ranges[ground - 1, 0] - ranges[ground - 2, 0] > 10
    assert not edges(truth)[: ground - 2].any()
    # Between two of its rows the ground goes on.
    between = ranges.clone()
    between[: ground - 1] = (ranges[: ground - 1] + ranges[1:ground]) / 2
    assert not floating(between, truth)[: ground - 1].any()


def test_a_car_before_a_wall_has_edges_at_the_far_end_too():
    for near, far in ((5.0, 6.0), (15.0, 18.0), (40.0, 55.0)):
        assert edges(step(near, far)).sum() == 24
    assert not edges(step(10.0, 10.5)).any()


def test_bilinear_floats_at_a_step_and_nearest_never():
    sparse = step()
    dense = sparse.sensor.resize(6, 46)  # three rays for one
    queries = sparse.sensor.grid_queries(dense)
    truth = Scan(torch.where(queries[..., 1] < 7.5, 10.0, 20.0), dense)
    share = {
        name: compare(models.create(name).ranges(sparse, dense), truth)["floating"] for name in ("nearest", "bilinear")
    }
    assert share == {"nearest": 0, "bilinear": pytest.approx(2 / 46)}


def test_the_mean_over_scans():
    scans = [
        (torch.full((2, 2), 11.05), scan(10.05, 10.05, 10.05, 0.0)),
        (torch.full((2, 2), 10.05), scan(*[10.05] * 4)),
    ]
    metrics = ScanMetrics()
    for ranges, truth in scans:
        metrics.update(ranges, truth)
    figures = {name: value.item() for name, value in metrics.compute().items()}
    one, other = (compare(*pair) for pair in scans)
    assert figures == {name: pytest.approx((one[name] + other[name]) / 2) for name in FIGURES}
    assert figures["mae"] == pytest.approx((3 * 1 + 88.95) / 8, abs=1e-4)


PROCESS = """
import json, sys, torch
from ilnet.learning.metrics import ScanMetrics
from ilnet.scan import Scan
from ilnet.sensor import preset

store, rank, world = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
torch.distributed.init_process_group("gloo", init_method=f"file://{store}", rank=rank, world_size=world)
sensor, metrics = preset("paper-16x1024").resize(4, 64), ScanMetrics()
for number in range(rank, 5, world):  # one process takes more than the other
    generator = torch.Generator().manual_seed(number)
    ranges, other = torch.rand(2, *sensor.shape, generator=generator) * 60 + 2
    metrics.update(ranges.where(other > 20, other), Scan(ranges, sensor))
print(json.dumps({name: value.item() for name, value in metrics.compute().items()}))
"""


def test_processes_add_up_to_one(tmp_path):
    (tmp_path / "process.py").write_text(PROCESS)

    def run(world):
        command = [sys.executable, tmp_path / "process.py", tmp_path / f"store{world}"]
        processes = [
            subprocess.Popen([*map(str, command), str(rank), str(world)], stdout=subprocess.PIPE)
            for rank in range(world)
        ]
        return [json.loads(process.communicate(timeout=120)[0]) for process in processes]

    (alone,), both = run(1), run(2)
    assert alone["mae"] > 1
    assert alone["floating"] > 0
    assert both == [pytest.approx(alone, rel=1e-9)] * 2


def test_chamfer_distance_by_hand():
    one = torch.tensor([[0.0, 0, 0], [4.0, 0, 0]])
    other = torch.tensor([[0.0, 1, 0], [0.0, 3, 0]])
    # There 1 and sqrt(16 + 1) m, back 1 and 3 m.
    assert chamfer(one, other) == pytest.approx((1 + 17**0.5) / 2 + 2)
    assert chamfer(one, other) == chamfer(other, one)
    assert chamfer(one, one) == 0
    assert math.isnan(chamfer(one, one[:0]))


def test_pixels_never_looked_at_are_left_out_of_all_figures():
    sensor = step().sensor
    generator = torch.Generator().manual_seed(0)
    truth = torch.rand(sensor.shape, generator=generator) * 30 + 5
    answer = truth + torch.rand(sensor.shape, generator=generator)
    seen = torch.ones(sensor.shape, dtype=torch.bool)
    seen[::2] = False
    holed = Scan(truth.where(seen, 0.0), sensor, seen=seen)
    figures = compare(answer, holed)
    wild = answer.where(seen, 40.0 + 10 * torch.rand(sensor.shape, generator=generator))
    assert compare(wild, holed) == figures
    assert figures["mae"] == pytest.approx((answer - truth).abs()[seen].mean().item())
    assert compare(truth, holed)["iou"] == compare(truth, holed)["precision"] == 1


def test_a_prediction_without_returns_is_all_wrong_and_no_nan():
    """The authors' code divides 0 by 0 here."""
    truth = step()
    figures = compare(torch.full(truth.ranges.shape, 100.0), truth)
    assert {name: figures[name] for name in ("iou", "precision", "recall", "f1")} == dict.fromkeys(
        ("iou", "precision", "recall", "f1"), 0.0
    )
    assert figures["mae"] == pytest.approx(85.0)
