import contextlib
import copy
import json
import time
import types
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from safetensors import safe_open
from torch._subclasses.fake_tensor import FakeTensorMode

from ilnet import models
from ilnet.models import base
from ilnet.models.encoder import Encoder
from ilnet.scan import Scan
from ilnet.sensor import Sensor, preset
from ilnet.world import simulate
from ilnet.world.simulate import pose
from kernels import reference
from kernels.checks import PRIORS

# float32 ranges below 100 m through a network of a dozen layers.
METRES = 1e-3
# A gradient is a sum over hundreds of queries of metres; some of them cancel to nothing but rounding.
GRADIENT = 1e-3


def small(prior="none", **arguments):
    torch.manual_seed(0)
    model = models.ILN(prior=prior, features=16, blocks=2, heads=4, **arguments).eval()
    # The head of a network with a prior starts at 0; anything else tells more in a test.
    torch.nn.init.normal_(model.head[1].weight, std=0.5)
    return model


def surfaces():
    torch.manual_seed(0)
    model = models.create("iln-surfaces", features=16, blocks=1).eval()
    torch.nn.init.normal_(model.head[1].weight, std=0.5)
    return model


def draw(height=6, width=16, count=200, batch=2):
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(batch, height, width, generator=generator) * 60 + 2
    queries = torch.rand(batch, count, 2, generator=generator) * torch.tensor([height - 1.0, float(width)])
    return image, queries


@pytest.mark.parametrize(("depth", "parameters"), [(0, 1_219_649), (1, 1_244_673), (2, 1_269_697), (4, 1_319_745)])
def test_iln_has_the_papers_size(depth, parameters):
    assert sum(p.numel() for p in models.ILN(depth).parameters()) == parameters


def test_liif_has_the_papers_size():
    assert sum(p.numel() for p in models.LIIF().parameters()) == 1_434_049


@pytest.mark.parametrize(("rows", "columns", "parameters"), [(4, 1, 34_600_001), (8, 2, 34_637_057)])
def test_lidar_sr_has_the_papers_size(rows, columns, parameters):
    assert sum(p.numel() for p in models.LiDARSR(rows, columns).parameters()) == parameters


def test_lidar_sr_predicts_its_own_size_and_refuses_others(yard):
    torch.manual_seed(0)
    model = models.create("lidar-sr", rows=4, columns=2).eval()
    source = preset("paper-16x1024").resize(8, 32)
    scan = simulate.scan(yard, source, pose((0.0, 0.0, 1.8)))
    target = source.resize(32, 64)
    dense = model.ranges(scan, target)
    # Each query of the grid gets the pixel of its own, the seam included.
    assert torch.equal(dense, model.encode(scan.filled().unsqueeze(0), True)[0])
    assert len(dense.unique()) > 1000
    falling = replace(source, elevations=source.elevations[::-1].copy())
    turned = model.ranges(Scan(scan.ranges.flip(0), falling), falling.resize(32, 64))
    torch.testing.assert_close(turned, dense.flip(0), rtol=0, atol=METRES)
    assert model.upsample(scan, target).sensor == target
    for other in (source.resize(16, 64), source.resize(32, 128)):
        with pytest.raises(ValueError, match="lidar-sr at 4x2 makes 32x64 rays of this scan, not"):
            model.ranges(scan, other)
    with pytest.raises(ValueError, match="looks elsewhere"):
        model.upsample(scan, preset("os1-128").resize(32, 64))
    with pytest.raises(ValueError, match="should be multiples of 16"):
        model.ranges(scan.decimate(6), source.resize(24, 64))


def test_lidar_sr_answers_a_part_of_the_circle():
    sensor = Sensor(np.deg2rad(np.linspace(-15, 15, 8)), np.deg2rad(np.linspace(-45, 45, 16)))
    model = models.create("lidar-sr", rows=2, columns=2).eval()
    scan = Scan(torch.rand(sensor.shape) * 50 + 3, sensor)
    dense = model.encode(scan.filled().unsqueeze(0), False)[0]
    assert torch.equal(model.ranges(scan, sensor.resize(16, 32)), dense)


def test_lidar_sr_learns_from_queries_like_the_others():
    model = models.create("lidar-sr", rows=2, columns=1)
    image, queries = torch.rand(2, 8, 16) * 50, torch.tensor([[[0.0, 0.0], [7.0, 15.0]], [[3.5, 2.0], [1.0, 7.0]]])
    assert model(image, queries).shape == (2, 2)
    torch.nn.init.ones_(model.last.bias)  # above the last ReLU's threshold
    model(image, queries).sum().backward()
    assert model.widen[0][0].weight.grad.abs().max() > 0


def plain_iln(model, image, queries, wrap):
    """The network once more, formulated with torch's own layers and the reference ops."""
    scaled = image.clamp(max=100) / 50 - 1

    def conv(layer, x):
        x = F.pad(x, (1, 1, 0, 0), "circular" if wrap else "replicate")
        return F.conv2d(F.pad(x, (0, 0, 1, 1), "replicate"), layer.weight, layer.bias)

    head = conv(model.encoder.head, scaled.unsqueeze(1))
    x = head
    for block in model.encoder.blocks:
        x = x + conv(block.second, conv(block.first, x).relu())
    z, offsets = reference.gather_neighbours(head + conv(model.encoder.tail, x), queries, wrap)
    z = z + model.position(2 * offsets)
    for block in model.blocks:
        attention = block.attention
        q, k, v = attention.qkv(attention.norm(z)).unflatten(-1, (3, attention.heads, -1)).transpose(2, 4).unbind(3)
        z = z + attention.out(F.scaled_dot_product_attention(q, k, v).transpose(2, 3).flatten(-2))
        z = z + block.feed_forward(z)
    return reference.gather_blend(image, queries, model.head(z).squeeze(-1), model.prior, wrap, model.area_floor)[0]


@pytest.mark.parametrize("prior", PRIORS)
@pytest.mark.parametrize("wrap", [True, False])
@pytest.mark.parametrize("depth", [0, 1, 2])
def test_iln_matches_a_plain_formulation_with_gradients(prior, wrap, depth):
    model, (image, queries) = small(prior, depth=depth), draw()
    results = []
    for call in (model, lambda *a: plain_iln(model, *a)):
        model.zero_grad()
        ranges = call(image, queries, wrap)
        ranges.sum().backward()
        results.append((ranges.detach(), [p.grad.clone() for p in model.parameters()]))
    torch.testing.assert_close(results[0][0], results[1][0], rtol=0, atol=METRES)
    for ours, plain in zip(results[0][1], results[1][1], strict=True):
        torch.testing.assert_close(ours, plain, rtol=1e-2, atol=GRADIENT)


# 2.5 mm of 100 m, after 34 convolutions in another order.
NORMALISED = 5e-5


@pytest.mark.parametrize(("name", "files"), [("iln", "iln_1d"), ("liif", "liif")])
def test_gives_what_the_authors_network_gives(name, files, shared):
    model = models.load(shared / f"data/authors/{files}_random.pth")
    assert type(model) is type(models.create(name))
    expected = np.load(shared / f"data/authors/{files}_expected.npz")
    image = torch.tensor(expected["range_image_m"]).unsqueeze(0)
    row, column = torch.tensor(expected["pixel"]).unbind(1)
    queries = preset("paper-16x1024").grid_queries(preset("paper-64x1024"))[row, column].unsqueeze(0)
    with torch.no_grad():
        # Their encoder goes round the circle, their neighbours stop at the seam.
        features = model.encode(image, wrap=True)
        ranges = model.decode(features, image, queries, wrap=False).squeeze(0)
        wrapped = model.decode(features, image, queries, wrap=True).squeeze(0)
    normalised = torch.tensor(expected["output_normalised"])
    inner = column < 1023
    # On the last column their four areas are 0, and LIIF blends by what they add against division by 0.
    same = inner if name == "liif" else slice(None)
    torch.testing.assert_close(ranges[same] / 50 - 1, normalised[same], rtol=0, atol=NORMALISED)
    torch.testing.assert_close(wrapped[inner] / 50 - 1, normalised[inner], rtol=0, atol=NORMALISED)


@pytest.mark.parametrize(("prior", "baseline"), [("bilinear", "bilinear"), ("perspective", "bilinear-inverse")])
def test_an_untrained_network_with_a_prior_is_that_interpolation(prior, baseline):
    torch.manual_seed(0)
    model = models.create("iln", prior=prior, features=16, blocks=1, heads=4, area_floor=0.0).eval()
    image, queries = draw()
    torch.testing.assert_close(model(image, queries), models.create(baseline)(image, queries), rtol=0, atol=METRES)


def test_rolling_the_scan_rolls_the_answer():
    model, (image, queries) = small(), draw()
    rolled = model(image.roll(5, -1), (queries + torch.tensor([0.0, 5.0])) % torch.tensor([100.0, 16.0]))
    torch.testing.assert_close(rolled, model(image, queries), rtol=0, atol=METRES)


def test_the_encoder_pads_round_the_circle_only_when_asked():
    torch.manual_seed(0)
    encoder, x = Encoder(8, 1), torch.randn(1, 1, 5, 12)
    assert torch.allclose(encoder(x.roll(3, -1), True), encoder(x, True).roll(3, -1), atol=1e-5)
    assert not torch.allclose(encoder(x.roll(3, -1), False), encoder(x, False).roll(3, -1), atol=1e-5)


def test_blends_stay_between_the_neighbours():
    model, (image, queries) = small(), draw()
    gathered, _ = reference.gather_neighbours(image.unsqueeze(1), queries, True)
    ranges = model(image, queries)
    assert (ranges >= gathered.amin((-1, -2)) - METRES).all()
    assert (ranges <= gathered.amax((-1, -2)) + METRES).all()


@pytest.mark.parametrize("name", ["nearest", "bilinear", "bilinear-inverse", "planes", "liif", "iln", "iln-surfaces"])
def test_upsample_to_any_sensor(name, yard):
    torch.manual_seed(0)
    arguments = {"features": 16, "blocks": 1} if name in models.TRAINABLE else {}
    model = models.create(name, **arguments).eval()
    scan = simulate.scan(yard, preset("paper-16x1024"), pose((0.0, 0.0, 1.8)))
    uneven = Sensor(np.deg2rad([-14.9, -3.0, -2.5, 0.0, 11.0]), np.deg2rad([170, 100, 95, -20, -40.5]))
    for target in (preset("paper-64x1024"), scan.sensor.resize(33, 500), uneven):
        dense = model.upsample(scan, target)
        assert dense.sensor == target
        assert dense.ranges.any()
        assert ((dense.ranges == 0) | (dense.ranges >= target.min_range)).all()
        assert dense.ranges.max() <= target.max_range


# Intensity and confidence of upsampled scans


def any_model(name):
    torch.manual_seed(0)
    return models.create(name, **{"features": 16, "blocks": 1} if name in models.TRAINABLE else {}).eval()


def painted(yard, sensor, **arguments):
    """A scan of the yard with an intensity drawn at random."""
    scan = simulate.scan(yard, sensor, pose((0.0, 0.0, 1.8)))
    intensity = torch.rand(sensor.shape, generator=torch.Generator().manual_seed(0))
    return replace(scan, intensity=intensity, **arguments)


NAMED = ("nearest", "bilinear", "planes", "liif", "iln", "iln-surfaces")


@pytest.mark.parametrize("name", NAMED)
def test_an_even_intensity_stays_even_beside_what_does_not_return(name, yard):
    scan = simulate.scan(yard, preset("paper-16x1024"), pose((0.0, 0.0, 1.8)))
    lost = torch.rand(scan.ranges.shape, generator=torch.Generator().manual_seed(0)) < 0.3
    ranges = scan.ranges.masked_fill(lost, 0.0)
    target = preset("os1-128")  # rays out of view as well
    dense = any_model(name).upsample(Scan(ranges, scan.sensor, torch.full(ranges.shape, 0.7)), target)
    returned = dense.ranges > 0
    assert 0.1 < returned.float().mean() < 0.75
    assert not dense.intensity[~returned].any()
    # An untrained LIIF predicts ranges also where none of the neighbours returned.
    queries = scan.sensor.grid_queries(target).view(1, -1, 2)
    near = reference.gather_neighbours(ranges[None, None], queries, True)[0].amax((0, 2, 3)).view(target.shape)
    torch.testing.assert_close(dense.intensity[returned], (near[returned] > 0) * 0.7, rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", NAMED)
def test_ranges_do_not_depend_on_the_intensity(name, yard):
    model, scan, target = any_model(name), painted(yard, preset("paper-16x1024")), preset("paper-64x1024")
    dense, plain = model.upsample(scan, target), model.upsample(Scan(scan.ranges, scan.sensor), target)
    assert torch.equal(dense.ranges, plain.ranges)
    assert plain.intensity is None
    assert (dense.confidence is None) == (plain.confidence is None) == (not model.tells_confidence)
    assert dense.intensity.shape == target.shape


@pytest.mark.parametrize("name", ["planes", "iln-surfaces"])
def test_intensity_is_that_of_the_surface_that_is_met(name):
    """A bright pole before a dark wall: what is met at one of the two ranges has its intensity."""
    sensor = preset("paper-16x1024").resize(8, 90)
    ranges = torch.full(sensor.shape, 40.0)
    ranges[:, 43:46] = 5.0
    scan = Scan(ranges, sensor, torch.where(ranges < 10, 0.9, 0.1))
    dense = any_model(name).upsample(scan, sensor.resize(20, 300))
    for range_, expected in ((5.0, 0.9), (40.0, 0.1)):
        met = (dense.ranges - range_).abs() < 0.5
        assert met.sum() > 100
        assert (dense.intensity[met] - expected).abs().max() < 0.01


@torch.no_grad()
def test_support_weights_the_intensity(yard):
    model, scan, target = surfaces(), painted(yard, preset("paper-16x1024")), preset("paper-64x1024")
    queries, image = scan.sensor.grid_queries(target).view(1, -1, 2), scan.filled().unsqueeze(0)
    answer = model.answer(model.encode(image, True, scan.sensor), image, queries, True)
    near = reference.gather_neighbours(scan.intensity[None, None], queries, True)[0].squeeze(-1)
    expected = (answer.support * near).sum(-1) / answer.support.sum(-1)
    dense = model.upsample(scan, target)
    met = dense.ranges > 0
    torch.testing.assert_close(dense.intensity[met], expected.view(target.shape)[met], rtol=0, atol=1e-4)
    torch.testing.assert_close(dense.confidence[met], answer.confidence.view(target.shape)[met], rtol=0, atol=1e-5)
    assert dense.confidence[met].min() > 0
    assert not dense.confidence[~met].any()


@pytest.mark.parametrize("name", ["planes", "iln-surfaces"])
def test_intensity_and_confidence_do_not_depend_on_the_chunk(name, yard, monkeypatch):
    model, scan, target = any_model(name), painted(yard, preset("paper-16x1024")), preset("paper-64x1024")
    expected = model.upsample(scan, target)
    monkeypatch.setitem(base._TILE, "cpu", 777)
    found = model.upsample(scan, target)
    torch.testing.assert_close(found.intensity, expected.intensity, rtol=0, atol=1e-5)
    assert name == "planes" or torch.allclose(found.confidence, expected.confidence, rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", ["planes", "iln-surfaces"])
def test_both_backends_blend_alike(name, yard):
    model, scan, target = any_model(name), painted(yard, preset("paper-16x1024")), preset("paper-64x1024")
    ours = model.upsample(scan, target)
    model.backend = "torch"
    theirs = model.upsample(scan, target)
    same = (ours.ranges - theirs.ranges).abs() < METRES
    assert same.float().mean() > 0.99  # a median may jump
    assert (ours.intensity - theirs.intensity).abs()[same].max() < 1e-3


@pytest.mark.parametrize("name", ["planes", "iln-surfaces"])
def test_intensity_meets_itself_at_the_seam(name, yard):
    model, sensor = any_model(name), preset("paper-16x1024").resize(16, 64)
    scan, between = painted(yard, sensor), replace(sensor, azimuths=sensor.azimuths + np.pi / 64)
    turned = Scan(scan.ranges.roll(20, -1), sensor, scan.intensity.roll(20, -1))
    found, expected = model.upsample(turned, between), model.upsample(scan, between)
    same = (found.ranges.roll(-20, -1) - expected.ranges).abs() < METRES
    assert same.float().mean() > 0.99  # a median may jump
    assert same[:, -1].all()
    off = (found.intensity.roll(-20, -1) - expected.intensity).abs()
    assert off[same].max() < 1e-3
    assert expected.intensity[:, -1].any()


@pytest.mark.parametrize("name", ["planes", "iln-surfaces"])
@pytest.mark.parametrize("span", [360, 90])
@pytest.mark.parametrize("flips", [(0,), (1,), (0, 1)])
def test_intensity_is_flipped_as_ranges_are(name, span, flips, yard):
    source = Sensor(np.deg2rad(np.linspace(-15, 15, 16)), np.deg2rad(np.arange(-span / 2, span / 2, 1.5)))
    model, scan, target = any_model(name), painted(yard, source), preset("paper-64x1024")

    def flip(sensor):
        tables = [t[::-1].copy() if i in flips else t for i, t in enumerate((sensor.elevations, sensor.azimuths))]
        return replace(sensor, elevations=tables[0], azimuths=tables[1])

    expected = model.upsample(scan, target)
    turned = Scan(scan.ranges.flip(flips), flip(source), scan.intensity.flip(flips))
    for found in (model.upsample(turned, target), model.upsample(turned, flip(target))):
        images = [(getattr(found, of), getattr(expected, of)) for of in ("ranges", "intensity", "confidence")]
        for image, exact in images[: 3 if model.tells_confidence else 2]:
            exact = exact.flip(flips) if found.sensor == flip(target) else exact
            assert ((image - exact).abs() < METRES).float().mean() > 0.999  # a median may jump
    assert (expected.ranges[:, ::64] > 0).any(0).sum() == (16 if span == 360 else 4)


@pytest.mark.parametrize("flips", [(0,), (1,), (0, 1)])
def test_networks_see_every_sensor_upright(flips, yard):
    """Ouster and Velodyne store the highest beam first; networks were trained with the lowest first."""
    model, source, target = small("bilinear"), preset("paper-16x1024"), preset("paper-64x1024")
    scan = simulate.scan(yard, source, pose((0.0, 0.0, 1.8)))

    def flip(sensor):
        elevations, azimuths = (
            table[::-1] if axis in flips else table for axis, table in enumerate((sensor.elevations, sensor.azimuths))
        )
        return replace(sensor, elevations=elevations.copy(), azimuths=azimuths.copy())

    expected = model.upsample(scan, target)
    turned = model.upsample(Scan(scan.ranges.flip(flips), flip(source)), flip(target))
    torch.testing.assert_close(turned.ranges.flip(flips), expected.ranges, rtol=0, atol=METRES)
    upright = model.upsample(Scan(scan.ranges.flip(flips), flip(source)), target)
    torch.testing.assert_close(upright.ranges, expected.ranges, rtol=0, atol=METRES)


def test_upsample_does_not_depend_on_the_chunk(yard, monkeypatch):
    model = small("bilinear")
    scan = simulate.scan(yard, preset("paper-16x1024"), pose((0.0, 0.0, 1.8)))
    expected = model.ranges(scan, preset("paper-64x1024"))
    monkeypatch.setitem(base._TILE, "cpu", 777)
    torch.testing.assert_close(model.ranges(scan, preset("paper-64x1024")), expected, rtol=0, atol=METRES)


def test_upsample_decodes_in_pieces_of_bounded_size(yard):
    scan = simulate.scan(yard, preset("paper-16x1024"), pose((0.0, 0.0, 1.8)))
    model, sizes = models.create("bilinear"), []
    decode = model.decode
    model.decode = lambda e, i, queries, w: sizes.append(queries.shape[1]) or decode(e, i, queries, w)
    model.ranges(scan, preset("paper-128x2048"))
    assert sum(sizes) == 128 * 2048
    assert max(sizes) == base._TILE["cpu"]


@pytest.mark.parametrize("depth", [0, 1, 2])
@pytest.mark.parametrize("training", [True, False])
def test_a_network_answers_alike_in_training_in_a_frame_and_in_plain_torch(depth, training, yard):
    """The paper's width: CPUs decode a frame in one pass, and train on one kernel a direction."""
    torch.manual_seed(0)
    model = models.ILN(depth, "perspective", blocks=1).train(training)
    torch.nn.init.normal_(model.head[1].weight, std=0.5)
    scan = simulate.scan(yard, preset("paper-16x1024").resize(8, 128), pose((0.0, 0.0, 1.8)))
    target = scan.sensor.resize(20, 300)
    queries = scan.sensor.grid_queries(target).view(1, -1, 2)
    image = scan.filled().unsqueeze(0)
    expected = plain_iln(model, image, queries, scan.sensor.wrap).view(target.shape)
    gradients = []
    for backend in ("warp", "torch"):
        model.backend = backend
        torch.testing.assert_close(model.ranges(scan, target), expected, rtol=0, atol=METRES)
        ranges = model(image, queries, scan.sensor.wrap)
        torch.testing.assert_close(ranges.view(target.shape), expected, rtol=0, atol=METRES)
        gradients.append(torch.autograd.grad(ranges.mean(), list(model.parameters())))
    for ours, plain in zip(*gradients, strict=True):
        torch.testing.assert_close(ours, plain, rtol=1e-2, atol=GRADIENT)


def test_dropout_is_active_in_training_only(yard):
    model, (image, queries) = small(dropout=0.5), draw()
    assert torch.equal(model(image, queries), model(image, queries))
    model.train()
    assert not torch.equal(model(image, queries), model(image, queries))


@pytest.mark.parametrize("name", ["liif", "iln", "bilinear"])
def test_bfloat16_is_close_and_ranges_stay_float32(name, yard):
    torch.manual_seed(0)
    model = models.create(name, blocks=4).eval() if name in models.TRAINABLE else models.create(name)
    scan = simulate.scan(yard, preset("paper-16x1024"), pose((0.0, 0.0, 1.8)))
    exact = model.ranges(scan, preset("paper-64x1024"))
    rounded = model.ranges(scan, preset("paper-64x1024"), "bfloat16")
    assert rounded.dtype == torch.float32
    assert torch.equal(exact, rounded) == (name == "bilinear")
    # LIIF predicts values, of 100 m, on features of 8 bits; weights blend what was measured.
    assert (exact - rounded).abs().mean() < (0.05 if name == "liif" else 0.02)


def test_liif_tells_ranges_apart_in_bfloat16():
    torch.manual_seed(0)
    model, (image, queries) = models.create("liif", features=16, blocks=1), draw()
    with torch.autocast("cpu", torch.bfloat16):
        ranges = model(image, queries)
    assert ranges.dtype == torch.float32
    assert (ranges != ranges.bfloat16().float()).float().mean() > 0.9


def test_an_upsampler_serves_many_frames_of_its_sensor_only(yard):
    model = small("bilinear")
    source, target = preset("paper-16x1024"), preset("paper-64x1024")
    upsampler = models.Upsampler(model, source, target)
    for x in (0.0, 3.0):
        scan = simulate.scan(yard, source, pose((x, 0.0, 1.8)))
        assert torch.equal(upsampler(scan).ranges, model.upsample(scan, target).ranges)
        assert upsampler(scan).sensor == target
    with pytest.raises(ValueError, match=r"scan is of Sensor\(paper-64x1024.*; it should be of Sensor\(paper-16x1024"):
        upsampler(simulate.scan(yard, target, pose((0.0, 0.0, 1.8))))
    with pytest.raises(ValueError, match="precision is 'half'; it should be one of float32, bfloat16"):
        models.Upsampler(model, source, target, "half")


def on(device, scan):
    """The scan with its ranges elsewhere; a device without numbers holds no scan that could be checked."""
    elsewhere = copy.copy(scan)
    object.__setattr__(elsewhere, "ranges", scan.ranges.to(device))
    return elsewhere


def test_a_model_elsewhere_than_its_scans_is_refused(yard):
    model, source, target = small(), preset("paper-16x1024").resize(8, 64), preset("paper-64x1024").resize(16, 64)
    scan = simulate.scan(yard, source, pose((0.0, 0.0, 1.8)))
    elsewhere = r"model is on cpu; it should be on meta, where the scans are: call model.to\('meta'\)"
    for call in (model.ranges, model.upsample):
        with pytest.raises(ValueError, match=elsewhere):
            call(on("meta", scan), target)
    with pytest.raises(ValueError, match=elsewhere):
        models.Upsampler(model, source, target, device="meta")
    assert models.Upsampler(models.create("planes"), source, target, device="meta").device.type == "meta"
    upsampler = models.Upsampler(model, source, target)
    with pytest.raises(ValueError, match=r"scan is on meta; it should be on cpu, .* call scan.to\('cpu'\)"):
        upsampler(on("meta", scan))
    model.to("meta")
    with pytest.raises(ValueError, match="model is on meta; it should be on cpu"):
        upsampler(scan)
    assert models.Upsampler(model, source, target).device.type == "meta"  # where the model is


def test_the_number_of_a_device_counts():
    sensor = preset("paper-16x1024").resize(8, 64)
    with FakeTensorMode():  # as if there were GPUs
        model = models.create("bilinear")
        model.register_buffer("table", torch.zeros(1, device="cuda:1"))
        assert models.Upsampler(model, sensor, sensor, device="cuda:1").device == torch.device("cuda", 1)
        with pytest.raises(ValueError, match=r"model is on cuda:1; it should be on cuda:0.*model.to\('cuda:0'\)"):
            models.Upsampler(model, sensor, sensor, device="cuda")


@pytest.fixture
def graphs(monkeypatch):
    """CUDA graphs as far as the host sees them, on the CPU: a recording may fail, and replays its work once more."""

    class Graph:
        def __init__(self):
            state.graphs.append(self)

        def replay(self):
            time.sleep(0.01)  # a frame is under way
            state.replays += 1
            recording, work = state.recorded[self]
            recording._frame = work(*recording._images)

    @contextlib.contextmanager
    def record(graph, **options):
        yield
        if state.fails:
            raise RuntimeError("the recording failed")

    def remember(recording, work, images):
        make(recording, work, images)
        state.recorded[recording._graph] = recording, work

    state = types.SimpleNamespace(graphs=[], recorded={}, replays=0, fails=False)
    make = base._Recording.__init__
    nothing = types.SimpleNamespace(**{f"{verb}_event": lambda event: None for verb in ("wait", "record")})
    nothing.wait_stream = lambda stream: None
    monkeypatch.setattr(base._Recording, "__init__", remember)
    monkeypatch.setattr(torch.cuda, "CUDAGraph", Graph)
    monkeypatch.setattr(torch.cuda, "graph", record)
    monkeypatch.setattr(torch.cuda, "Event", lambda: None)
    monkeypatch.setattr(torch.cuda, "Stream", lambda device: nothing)
    monkeypatch.setattr(torch.cuda, "stream", contextlib.nullcontext)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: nothing)
    return state


def test_a_recording_that_failed_is_made_again(graphs):
    sensor = preset("paper-16x1024").resize(8, 64)
    upsampler = models.Upsampler(models.create("bilinear"), sensor, sensor.resize(16, 64))
    images = torch.rand(4, 1, 8, 64) * 50 + 3
    assert torch.equal(upsampler._replay(images[0]).ranges, upsampler._answer(images[0]).ranges)
    assert graphs.graphs == []  # a single frame is not worth one
    graphs.fails = True
    with pytest.raises(RuntimeError, match="the recording failed"):
        upsampler._replay(images[1])
    graphs.fails = False
    for image in images[2:]:
        assert torch.equal(upsampler._replay(image).ranges, upsampler._answer(image).ranges)
    assert (len(graphs.graphs), graphs.replays) == (2, 2)


def test_a_first_frame_that_failed_is_no_first_frame(graphs, monkeypatch):
    sensor = preset("paper-16x1024").resize(8, 64)
    upsampler = models.Upsampler(models.create("bilinear"), sensor, sensor.resize(16, 64))
    image = torch.rand(1, 8, 64) * 50 + 3
    with monkeypatch.context() as broken:
        broken.setattr(upsampler, "_answer", lambda image: torch.rand(2) @ torch.rand(3))
        with pytest.raises(RuntimeError):
            upsampler._replay(image)
    upsampler._replay(image)
    assert graphs.graphs == []


def test_frames_with_intensity_have_a_recording_of_their_own(graphs):
    sensor = preset("paper-16x1024").resize(8, 64)
    upsampler = models.Upsampler(surfaces(), sensor, sensor.resize(16, 64))
    frames = torch.rand(6, 2, 1, 8, 64)
    for number, (image, intensity) in enumerate(frames):
        images = (image * 50 + 3, intensity) if number % 2 else (image * 50 + 3,)
        with torch.no_grad():
            found, expected = upsampler._replay(*images), upsampler._answer(*images)
        assert torch.equal(found.ranges, expected.ranges)
        assert torch.equal(found.confidence, expected.confidence)
        assert (found.intensity is None) == (number % 2 == 0)
        assert found.intensity is None or torch.equal(found.intensity, expected.intensity)
    assert (len(graphs.graphs), graphs.replays) == (2, 5)


def test_threads_that_share_an_upsampler_get_their_own_frames(graphs):
    sensor = preset("paper-16x1024").resize(8, 64)
    upsampler = models.Upsampler(models.create("bilinear"), sensor, sensor.resize(16, 64))
    images = torch.rand(12, 1, 8, 64) * 50 + 3
    expected = [upsampler._answer(image) for image in images]
    with ThreadPoolExecutor(4) as threads:
        answers = list(threads.map(upsampler._replay, images))
    assert all(torch.equal(answer.ranges, exact.ranges) for answer, exact in zip(answers, expected, strict=True))
    assert (len(graphs.graphs), graphs.replays) == (1, 11)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("precision", models.PRECISIONS)
def test_on_cuda_frames_replay_a_graph_without_waiting(precision, yard):
    torch.manual_seed(0)
    model = models.ILN(blocks=2).eval()
    source, target = preset("paper-16x1024"), preset("paper-64x1024")
    scans = [simulate.scan(yard, source, pose((x, 0.0, 1.8))) for x in (0.0, 3.0, 6.0)]
    expected = [model.ranges(scan, target) for scan in scans]
    upsampler = models.Upsampler(model.cuda(), source, target, precision, "cuda")
    moved = [Scan(scan.ranges.cuda(), source) for scan in scans]
    for scan in moved[:2]:  # the first is answered straight away, the second is recorded
        upsampler.ranges(scan)
    mode = torch.cuda.get_sync_debug_mode()
    torch.cuda.set_sync_debug_mode("error")
    try:
        answers = [upsampler.ranges(scan) for scan in moved]
    finally:
        torch.cuda.set_sync_debug_mode(mode)
    for answer, exact in zip(answers, expected, strict=True):
        assert (answer.cpu() - exact).abs().mean() < (METRES if precision == "float32" else 0.02)
    with pytest.raises(ValueError, match=r"scan is on cpu; it should be on cuda:\d"):
        upsampler.ranges(scans[0])
    with pytest.raises(ValueError, match=r"model is on cuda:\d; it should be on cpu"):
        model.ranges(scans[0], target)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("name", ["planes", "iln-surfaces"])
def test_on_cuda_intensity_and_confidence_are_those_of_the_cpu(name, yard):
    model, source, target = any_model(name), preset("paper-16x1024"), preset("paper-64x1024")
    scan = painted(yard, source)
    expected = model.upsample(scan, target)
    upsampler = models.Upsampler(model.cuda(), source, target, device="cuda")
    for _ in range(3):  # answered straight away, recorded, replayed
        for bright in (True, False):
            found = upsampler((scan if bright else Scan(scan.ranges, source)).to("cuda")).to("cpu")
            same = (found.ranges - expected.ranges).abs() < METRES
            assert same.float().mean() > 0.99  # a median may jump
            assert (found.intensity is None) == (not bright)
            for of in ("intensity", "confidence"):
                if getattr(found, of) is not None:
                    assert (getattr(found, of) - getattr(expected, of))[same].abs().max() < 1e-3


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_on_cuda_threads_and_streams_share_an_upsampler(yard):
    torch.manual_seed(0)
    model = models.ILN(blocks=2).eval().cuda()
    source, target = preset("paper-16x1024"), preset("paper-64x1024")
    scans = [simulate.scan(yard, source, pose((float(x), 0.0, 1.8))) for x in range(12)]
    moved = [Scan(scan.ranges.cuda(), source) for scan in scans]
    expected = [model.ranges(scan, target) for scan in moved]
    upsampler = models.Upsampler(model, source, target, device="cuda")
    torch.cuda.synchronize()

    def ranges(scan):
        with torch.cuda.stream(torch.cuda.Stream()):
            answer = upsampler.ranges(scan)
            torch.cuda.current_stream().synchronize()
            return answer

    with ThreadPoolExecutor(4) as threads:
        for answer, exact in zip(threads.map(ranges, moved), expected, strict=True):
            torch.testing.assert_close(answer, exact, rtol=0, atol=METRES)


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two CUDA devices")
def test_on_cuda_a_frame_stays_on_a_device_that_is_not_the_current_one(yard):
    model = small().to("cuda:1")
    source, target = preset("paper-16x1024"), preset("paper-64x1024")
    scan = simulate.scan(yard, source, pose((0.0, 0.0, 1.8)))
    upsampler = models.Upsampler(model, source, target, device="cuda:1")
    moved = Scan(scan.ranges.to("cuda:1"), source)
    answers = [upsampler.ranges(moved) for _ in range(3)]
    exact = model.cpu().ranges(scan, target)
    assert all((answer.cpu() - exact).abs().mean() < METRES for answer in answers)


def test_bilinear_upsampling_is_close_to_the_truth_on_the_ground(yard):
    here = pose((60.0, -60.0, 1.8))
    scan = simulate.scan(yard, preset("paper-16x1024"), here)
    truth = simulate.scan(yard, preset("paper-64x1024"), here)
    for name, metres in (("bilinear", 0.7), ("bilinear-inverse", 0.02), ("planes", 0.02)):
        dense = models.create(name).ranges(scan, truth.sensor)
        near = (truth.ranges > 0) & (truth.ranges < 15)
        assert near.sum() > 5000
        assert (dense - truth.ranges)[near].abs().max() < metres


def test_rays_out_of_view_hold_no_return(yard):
    scan = simulate.scan(yard, preset("paper-16x1024"), pose((0.0, 0.0, 1.8)))
    steep = Sensor(np.deg2rad([-60.0, -10.0]), np.deg2rad([0.0, 10.0]))
    dense = models.create("bilinear").upsample(scan, steep)
    assert (dense.ranges[0] == 0).all()
    assert (dense.ranges[1] > 0).all()


@pytest.mark.parametrize("name", ["nearest", "bilinear", "bilinear-inverse", "iln"])
def test_no_return_does_not_become_one_for_a_sensor_that_sees_farther(name):
    near, far = preset("paper-16x1024"), preset("os1-128")
    model = models.create(name, features=16, blocks=1) if name == "iln" else models.create(name)
    assert far.max_range > near.norm_range
    assert not model.eval().upsample(Scan(torch.zeros(near.shape), near), far).ranges.any()


def test_a_scan_without_returns_gives_none():
    sensor = preset("paper-16x1024")
    empty = Scan(torch.zeros(sensor.shape), sensor)
    for model in (models.create("bilinear-inverse"), small()):
        assert not model.upsample(empty, sensor.resize(20, 100)).ranges.any()


@pytest.mark.parametrize("name", [name for name in models.NAMES if name not in ("lidar-sr", "iln-surfaces")])
def test_shipped_models_load_and_predict(name, yard):
    model = models.load(name)
    scan = simulate.scan(yard, preset("paper-16x1024"), pose((0.0, 0.0, 1.8)))
    truth = simulate.scan(yard, preset("paper-64x1024"), pose((0.0, 0.0, 1.8)))
    ranges = model.ranges(scan, truth.sensor)
    # An upper bound for the nearest pixel, the worst of them; no return counts as 100 m.
    assert (ranges - truth.filled()).abs().mean() < 1.5


def test_weights_survive_a_round_trip(tmp_path):
    model = small("perspective")
    arguments = {"prior": "perspective", "features": 16, "blocks": 2, "heads": 4}
    models.save(model, tmp_path / "a.safetensors", "iln", arguments, steps=3)
    image, queries = draw()
    model.half().float()  # as they are stored
    assert torch.equal(models.load(tmp_path / "a.safetensors")(image, queries), model(image, queries))


def test_a_sensor_of_short_range_shows_no_return_as_the_network_knows_it():
    """Filled with the 60 m of its sensor, no return would look like a wall to a network trained with 100 m."""
    sensor = Sensor(np.deg2rad([-10.0, 0.0, 10.0]), np.deg2rad(np.arange(0.0, 360.0, 20.0)), 2.0, 50.0, 60.0)
    ranges = torch.full(sensor.shape, 20.0)
    ranges[1:] = 0
    model, seen = small(), []
    model.encoder.register_forward_pre_hook(lambda module, arguments: seen.append(arguments[0]))
    model.upsample(Scan(ranges, sensor), sensor)
    assert seen[0].unique().tolist() == pytest.approx([20 / 50 - 1, 1.0])


def test_weights_say_what_their_name_stood_for(tmp_path):
    model = models.create("bilinear-inverse")
    models.save(model, tmp_path / "a.safetensors", "bilinear-inverse", {})
    with safe_open(tmp_path / "a.safetensors", "pt") as file:
        assert json.loads(file.metadata()["arguments"]) == {"inverse": True}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [({"prior": "cubic"}, "prior is 'cubic'"), ({"heads": 7}, "heads is 7")],
)
def test_bad_constructor_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        models.ILN(**arguments)


@pytest.mark.parametrize(
    ("rows", "columns", "message"), [(3, 1, "rows is 3"), (4, 0, "columns is 0"), (1, 1, "nothing to predict")]
)
def test_lidar_sr_grows_by_powers_of_two(rows, columns, message):
    with pytest.raises(ValueError, match=message):
        models.create("lidar-sr", rows=rows, columns=columns)


@pytest.mark.parametrize(
    ("image", "queries"), [((5, 6), (1, 7, 2)), ((1, 1, 5, 6), (1, 7, 2)), ((2, 5, 6), (7, 2)), ((2, 5, 6), (1, 7, 2))]
)
def test_bad_shapes_are_named(image, queries):
    with pytest.raises(ValueError, match="has shape"):
        models.create("bilinear")(torch.ones(image), torch.ones(queries))


def test_double_precision():
    model, (image, queries) = small().double(), draw()
    assert model(image.double(), queries.double()).dtype == torch.float64


def test_compiles_without_graph_breaks():
    model, (image, queries) = small(), draw()
    compiled = torch.compile(model, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(image, queries), model(image, queries), rtol=0, atol=METRES)


def test_bad_weights_are_refused(tmp_path):
    with pytest.raises(ValueError, match="name is 'ilm'; it should be one of nearest"):
        models.load("ilm")
    with pytest.raises(ValueError, match="name is 'ilm'; it should be one of nearest"):
        models.create("ilm")
    with pytest.raises(FileNotFoundError, match="no weights ship for lidar-sr; train them"):
        models.load("lidar-sr")
    with pytest.raises(FileNotFoundError, match="no such file of weights"):
        models.load(tmp_path / "none.safetensors")
    (tmp_path / "text.safetensors").write_text("hello")
    with pytest.raises(ValueError, match="not weights"):
        models.load(tmp_path / "text.safetensors")
    models.save(small(), tmp_path / "other.safetensors", "iln", {"blocks": 3})
    with pytest.raises(ValueError, match="not weights"):
        models.load(tmp_path / "other.safetensors")


def test_lidar_sr_starts_as_the_authors_does():
    """Kaiming's normal distribution, of which the deviation of a 3×3 convolution of 64 channels is 0.059; no bias."""
    model = models.create("lidar-sr", rows=2, columns=1)
    convolution = model.merge[3][3]
    assert convolution.weight.shape == (64, 64, 3, 3)
    assert convolution.weight.std().item() == pytest.approx((2 / 576) ** 0.5, rel=0.03)
    assert not convolution.bias.any()
