import csv
import math

import pytest
import torch

from ilnet import models
from ilnet.commands import experiment, where
from ilnet.commands.study import Study
from ilnet.learning import evaluate, metrics
from ilnet.scan import Scan
from ilnet.sensor import PAPER_INPUT
from ilnet.world import simulate
from ilnet.world.simulate import pose
from kernels import attend_neighbours, gather_neighbours

SMALL = {"features": 16, "blocks": 1, "heads": 4}


@pytest.fixture(scope="module")
def pair(yard):
    return tuple(simulate.scan(yard, PAPER_INPUT.resize(*size), pose((3.0, 0.0, 1.8))) for size in ((16, 64), (31, 96)))


def profile(*values):
    return torch.tensor([values])


def test_the_spread_by_hand():
    sensor = PAPER_INPUT.resize(2, 4)
    scan = Scan(torch.tensor([[5.0, 5, 9, 0], [5, 5, 5, 5]]), sensor)
    asked = where.spread(scan, Scan(torch.full((3, 8), 5.0), sensor.resize(3, 8)))
    # Between the columns 0 and 1, 1 and 2, 2 and no return, no return and 0 across the seam.
    assert asked[1, 1::2].tolist() == [0, 4, 95, 95]


def test_shares_add_up_to_the_figures_of_the_scan(pair):
    scan, truth = pair
    answer = models.create("planes").ranges(scan, truth.sensor)
    bins = torch.bucketize(where.spread(scan, truth), torch.tensor([0.2, 2.0, 10.0]), right=True)
    found = where.shares(answer, truth, bins)
    assert sum(part["returns"] for part in found) == int((truth.ranges > 0).sum())
    assert sum(part["returns"] > 0 for part in found) >= 3
    hit, true, false = (sum(part[key] for part in found) for key in ("hit", "true", "false"))
    assert hit / (true + false) == pytest.approx(metrics.compare(answer, truth)["iou"], abs=1e-6)
    perfect = where.shares(truth.filled(), truth, bins)
    assert all(part["within 2 cm"] == part["returns"] and part["false"] == 0 for part in perfect)


def test_rises_by_hand():
    steps = torch.cat(
        (
            profile(0, 0, 0, 0.5, 1, 1, 1),  # from 0.1 to 0.9 in 0.8 of its two steps
            profile(0, 0, 0, 1, 1, 1, 1),
            profile(0, 0, 0, 0, 0.2, 0.3, 0.3),  # never through a half
            profile(0, 0, 0, 0.4, 0.6, 0.7, 0.8),  # never at 0.9
            profile(0, 1, 0, 0, 0, 1, 1),  # twice: once near the middle
        )
    )
    place, width = where.rises(steps, torch.tensor([3.0, 3, 3, 3, 5]))
    torch.testing.assert_close(place, torch.tensor([3.0, 2.5, math.nan, 3.5, 4.5]), equal_nan=True)
    torch.testing.assert_close(width, torch.tensor([1.6, 0.8, math.nan, math.inf, 0.8]), equal_nan=True)


def test_jumps_are_those_between_two_flat_surfaces(monkeypatch):
    monkeypatch.setattr(where, "_FINE", 4)
    truth = torch.full((3, 40), 10.0)
    truth[:, 18:] = 20.0  # between the measured columns 4 and 5; the way back is at the seam
    truth[1, 9:13] = 15.0  # a pole before it
    truth[2, 18:] = 11.0  # less than a jump
    row, columns = where.jumps(truth, 100.0)
    assert row.tolist() == [0, 0, 1]
    assert columns[:, where._AROUND * 4].tolist() == [16, 36, 36]
    assert columns[1].tolist() == [*range(28, 40), *range(9)]
    truth[:, 18:] = 100.0  # no return is no surface
    assert not len(where.jumps(truth, 100.0)[0])


def test_entropy_by_hand():
    assert where.entropy(torch.tensor([[0.25] * 4, [1, 0, 0, 0], [0.5, 0.5, 0, 0]])).tolist() == [2, 0, 1]


def test_weights_are_those_of_the_answers(pair):
    scan, truth = pair
    torch.manual_seed(0)
    iln = models.create("iln", **SMALL, prior="bilinear").eval()
    torch.nn.init.normal_(iln.head[1].weight)
    found = where.weights(iln, scan, truth)
    torch.testing.assert_close(found.sum(-1), torch.ones(truth.sensor.shape))
    image, upright = scan.filled(iln.norm_range), scan.sensor.upright()
    queries = upright.grid_queries(truth.sensor).view(1, -1, 2)
    ranges = gather_neighbours(image.flip(scan.sensor.flips())[None, None], queries, True)[0]
    answers = (found.view(-1, 4) * ranges.view(-1, 4)).sum(-1).view(truth.sensor.shape)
    torch.testing.assert_close(answers, iln.ranges(scan, truth.sensor), rtol=0, atol=1e-3)
    surfaces = where.weights(models.create("iln-surfaces", features=16, blocks=1, tokens=16), scan, truth)
    assert surfaces.shape == (*truth.sensor.shape, 36)
    torch.testing.assert_close(surfaces.sum(-1), torch.ones(truth.sensor.shape))


def test_attention_maps_are_those_of_the_network(pair):
    scan, truth = pair
    torch.manual_seed(0)
    iln = models.create("iln", **SMALL).eval()
    maps = where.attention_maps(iln, scan, truth)
    assert maps.shape == (truth.ranges.numel(), 4, 4, 4)
    torch.testing.assert_close(maps.sum(-1), torch.ones(maps.shape[:-1]))
    # What the network's own attention makes of values that tell neighbours apart, head by head.
    [(encoded, _, queries)] = where._tiles(iln, scan, truth)
    attention = iln.blocks[0].attention
    with torch.no_grad():
        z, offsets = gather_neighbours(encoded.features, queries, True)
        qkv = attention.qkv(attention.norm(z + iln.position(offsets * where.OFFSET_SCALE)))
        qkv[..., 32:] = torch.eye(4).repeat(1, 4)  # in each head, the value of neighbour t is the unit vector t
        attended = attend_neighbours(qkv, 4)
    torch.testing.assert_close(attended.view(-1, 4, 4, 4).transpose(1, 2), maps, rtol=1e-4, atol=1e-5)


def test_the_experiment_writes_tables_and_pictures_of_all_parts(tmp_path, monkeypatch, yard):
    networks = {
        "liif": models.create("liif", features=16, blocks=1, hidden=16),
        "iln": models.create("iln", **SMALL),
        "iln-surfaces": models.create("iln-surfaces", features=16, blocks=1, tokens=16),
    }

    def pairs(town, count, output, source=PAPER_INPUT):
        return [tuple(simulate.scan(yard, sensor, pose((3.0, 0.0, 1.8))) for sensor in (source, output))] * count

    monkeypatch.setattr(simulate, "best_device", lambda: torch.device("cpu"))  # where the yard is
    monkeypatch.setattr(evaluate, "town_pairs", pairs)
    monkeypatch.setattr(Study, "sizes", ((16, 256), (32, 256)))
    monkeypatch.setattr(Study, "networks", lambda study: networks)
    monkeypatch.setattr(where, "_FINE", 2)
    study = Study(None, tmp_path, scans=1)
    where.where(study)
    parts = ("where", *(f"where-{part}" for part in ("errors", "jumps", "weights", "attention", "precision")))
    found = {}
    for part in parts:
        assert (tmp_path / f"{part}.png").read_bytes()[:4] == b"\x89PNG"
        with open(tmp_path / f"{part}.csv", newline="") as file:
            found[part] = list(csv.DictReader(file))
    [truth] = [row for row in found["where-jumps"] if row["model"] == "truth" and row["rows"] == "on a beam"]
    assert int(truth["jumps"]) > 4
    assert float(truth["width"]) <= 0.5  # a step of two queries a column
    for kind, most in (("4 ranges", 2), ("attention", 2), ("36 surfaces", math.log2(36))):
        bits = [float(row["entropy [bits]"]) for row in found["where-weights"] if row["of"] == kind]
        assert len(bits) == 4
        assert all(0 < value <= most for value in bits)
    paid = list(found["where-attention"][0].values())[2:]
    assert sum(map(float, paid)) == pytest.approx(1, abs=1e-3)
    page = experiment.results(study).read_text()
    assert "Made with the networks that ship." in page
    assert all(f"![{part}]({part}.png)" in page for part in parts)
