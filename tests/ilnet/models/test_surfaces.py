import numpy as np
import pytest
import torch

from ilnet import models
from ilnet.models.surfaces import describe
from ilnet.scan import Scan
from ilnet.sensor import PAPER_INPUT, Sensor, preset
from ilnet.world import simulate
from ilnet.world.simulate import pose
from kernels import surface_hypotheses


def small():
    torch.manual_seed(0)
    model = models.create("iln-surfaces", features=16, blocks=1, tokens=16)
    torch.nn.init.normal_(model.head[1].weight, std=0.5)
    return model.eval()


def draw(sensor=PAPER_INPUT, count=400):
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(2, *sensor.shape, generator=generator) * 40 + 2
    image[torch.rand(2, *sensor.shape, generator=generator) < 0.1] = sensor.norm_range
    size = torch.tensor([sensor.shape[0] - 1.0, sensor.shape[1]])
    return image, torch.rand(2, count, 2, generator=generator) * size


@torch.no_grad()
def test_every_answer_is_where_a_surface_of_a_neighbour_is_met():
    model, (image, queries) = small(), draw()
    answers = model(image, queries, sensor=PAPER_INPUT)
    measured = image.where(image < PAPER_INPUT.norm_range, 0.0)
    found = surface_hypotheses(measured, queries, *PAPER_INPUT.angles()).flatten(-2)
    found = found.where(found > 0, PAPER_INPUT.norm_range)
    assert ((found - answers.unsqueeze(-1)).abs().amin(-1) < 1e-4 * answers).all()


@torch.no_grad()
def test_both_backends_agree():
    model, (image, queries) = small(), draw()
    ours = model(image, queries, sensor=PAPER_INPUT)
    model.backend = "torch"
    theirs = model(image, queries, sensor=PAPER_INPUT)
    # A median jumps where two hypotheses have half of the weight each.
    assert ((ours - theirs).abs() < 1e-2).float().mean() > 0.995


def test_the_loss_falls_and_all_parameters_learn():
    model, (image, queries) = small().train(), draw()
    truth = image[:, 0, 0].unsqueeze(1).expand(-1, queries.shape[1]).contiguous()
    optimizer = torch.optim.Adam(model.parameters(), lr=3e-3)
    losses = []
    for _ in range(15):
        optimizer.zero_grad()
        loss = model.loss(image, queries, truth, True, PAPER_INPUT)
        loss.backward()
        assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0]


def test_without_its_sensor_it_says_what_is_missing():
    image, queries = draw()
    with pytest.raises(ValueError, match=r"sensor has shape \(16, 512\); it should be \(16, 1024\), as the image"):
        small()(image, queries, sensor=PAPER_INPUT.resize(16, 512))
    with pytest.raises(ValueError, match="sensor is None; it should be the sensor of the image"):
        small()(image, queries)


@torch.no_grad()
def test_the_untrained_network_continues_the_ground_of_any_sensor():
    """Scores of zero weigh all continuations alike, and most of them agree on a plane."""
    torch.manual_seed(0)
    model = models.create("iln-surfaces", features=16, blocks=1, tokens=16).eval()
    beams = np.deg2rad([-24.0, -19, -16, -13, -11, -9.5, -8.5, -8])
    sensor = Sensor(beams, np.linspace(-np.pi, np.pi, 512, endpoint=False), 0.5, 80, 100)
    target = Sensor(np.deg2rad(np.linspace(-18.5, -8.6, 23)), sensor.azimuths, 0.5, 80, 100)

    def ground(of):
        return (1.8 / np.sin(-of.elevations))[:, None] * np.ones(of.shape)

    dense = model.upsample(Scan(torch.from_numpy(ground(sensor)), sensor), target)
    error = (dense.ranges - torch.from_numpy(ground(target))).abs() / torch.from_numpy(ground(target))
    # Unweighted, a third of the hypotheses of a neighbour stand still; the median is one that does not.
    assert error.median() < 2e-3
    assert error.max() < 0.2


@torch.no_grad()
def test_what_the_encoder_sees_is_finite_and_of_its_order(yard):
    for name in ("paper-16x1024", "hdl-64e", "vlp-16", "os0-32"):
        sensor = preset(name).upright()
        scan = simulate.scan(yard, sensor, pose((0.0, 0.0, 1.8)))
        seen = describe(scan.ranges.unsqueeze(0), sensor, sensor.wrap)
        assert seen.shape == (1, 12, *sensor.shape)
        assert seen.isfinite().all()
        assert seen.abs().max() < 4
    empty = describe(torch.zeros(1, *sensor.shape), sensor, True)
    assert empty.isfinite().all()


@torch.no_grad()
def test_the_seam_is_no_border():
    model, (image, queries) = small(), draw(count=200)
    turned = torch.stack((queries[..., 0], queries[..., 1] + 100), -1)
    here = model(image, queries, sensor=PAPER_INPUT)
    there = model(image.roll(100, -1), turned, sensor=PAPER_INPUT)
    assert ((here - there).abs() < 1e-2).float().mean() > 0.99
