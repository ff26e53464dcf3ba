import pytest
import torch

from ilnet import models
from ilnet.commands import variants
from ilnet.commands.variants import Blended, from_one_channel, from_ranges
from ilnet.models.surfaces import describe
from ilnet.sensor import PAPER_INPUT
from ilnet.world import simulate
from ilnet.world.simulate import pose
from kernels import area_blend, gather_neighbours, surface_hypotheses


@pytest.fixture(scope="module")
def pair(yard):
    return tuple(simulate.scan(yard, s, pose((3.0, 0.0, 1.8))) for s in (PAPER_INPUT, PAPER_INPUT.resize(31, 256)))


@pytest.fixture(scope="module")
def asked(pair):
    """An image, queries between its pixels, and the ranges there."""
    scan, truth = pair
    queries = scan.sensor.grid_queries(truth.sensor).view(1, -1, 2)
    return scan.filled().unsqueeze(0), queries[:, ::7], truth.filled().view(1, -1)[:, ::7]


def learned(make, asked, steps=3):
    """A variant after some steps, and the plain model with its weights."""
    torch.manual_seed(0)
    model = make(**variants.SIZE)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2, eps=1e-6)
    for _ in range(steps):
        optimizer.zero_grad()
        model.loss(*asked, True, PAPER_INPUT).backward()
        optimizer.step()
    plain = models.Surfaces(**variants.SIZE)
    plain.load_state_dict(model.state_dict())
    return model.eval(), plain.eval()


def test_a_network_of_ranges_answers_with_them_after_training_too(asked):
    _, plain = learned(from_ranges, asked)
    answers = plain(*asked[:2], sensor=PAPER_INPUT)
    measured, _ = gather_neighbours(asked[0].unsqueeze(1), asked[1], True)
    assert torch.allclose((measured.squeeze(-1) - answers.unsqueeze(-1)).abs().amin(-1), torch.zeros(1), atol=1e-4)
    assert not torch.equal(plain.head[1].bias[-2], torch.zeros(()))  # it has learned


def test_a_network_of_one_channel_sees_the_range_alone_after_training_too(asked):
    _, plain = learned(from_one_channel, asked)
    weight = plain.encoder.head.weight
    assert weight[:, 1:].abs().max() == 0
    assert weight[:, 0].abs().max() > 0.2  # as 9 inputs start, not 108
    seen = describe(asked[0], PAPER_INPUT, True)[:, 0]
    torch.testing.assert_close(seen, asked[0] / 50 - 1)


def test_the_mean_weighs_all_hypotheses(asked):
    """Untrained, each neighbour's hypotheses share its bilinear area equally."""
    image, queries, ranges = asked
    model = Blended(**variants.SIZE)
    measured = image.where(image < PAPER_INPUT.norm_range, 0.0)
    found = surface_hypotheses(measured, queries, *PAPER_INPUT.angles())
    means = area_blend(found.where(found > 0, PAPER_INPUT.norm_range).mean(-1), queries)
    inside = ((queries - queries.round()).abs() > 0.01).all(-1)  # where no area is near 0
    answers = model(image, queries, sensor=PAPER_INPUT)
    torch.testing.assert_close(answers[inside], means[inside], rtol=0.02, atol=0.02)
    assert model.loss(*asked, True, PAPER_INPUT).item() == pytest.approx((answers - ranges).abs().mean().item())


def test_the_mean_is_what_is_predicted_of_a_scan(pair, tmp_path):
    torch.manual_seed(0)
    model = models.Surfaces(**variants.SIZE)
    models.save(model, tmp_path / "m.safetensors", "iln-surfaces", variants.SIZE)
    mean = variants.blended(tmp_path / "m.safetensors")
    scan, truth = pair
    medians = models.load(tmp_path / "m.safetensors").ranges(scan, truth.sensor)
    assert not torch.allclose(mean.ranges(scan, truth.sensor), medians)
    assert mean.upsample(scan, truth.sensor).confidence is None


def test_every_variant_learns(asked):
    for name, options in variants.VARIANTS.items():
        make = options.get("make", models.Surfaces)
        losses = [learned(make, asked, steps)[0].loss(*asked, True, PAPER_INPUT).item() for steps in (0, 8)]
        assert losses[1] < losses[0], name


def test_an_oracle_does_the_better_the_more_it_may_choose_from(pair):
    found = variants.ceilings([pair, pair])
    ranges, surfaces, between = (
        found[name] for name in ("best of 4 ranges", "best of 36 surfaces", "between 4 ranges")
    )
    assert ranges["mae"] > surfaces["mae"]
    assert ranges["mae"] > between["mae"]
    assert 0 < ranges["iou"] < surfaces["iou"] < 1
    assert ranges["iou"] < between["iou"] < 1
    assert surfaces["iou"] > 1.5 * ranges["iou"]  # a yard is made of planes
