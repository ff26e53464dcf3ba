import math

import numpy as np
import pytest
import torch

from ilnet.sensor import Sensor, preset
from kernels import surface_hypotheses, surface_likelihood, surface_median
from kernels.checks import BACKGROUND, KINDS, TOLERANCE
from kernels.surfaces.op import _surface_hypotheses, _surface_likelihood, _surface_median

# Relative, of ranges that are differences of inverse ranges, and of logarithms of densities. The kernel's
# sine is good to 3e-8.
CLOSE = {torch.float32: 1e-3, torch.float64: 2e-6}
# Share of the range. Along a row of even ground the inverse range is constant, where Eq. (1) is off by squared angles.
PLANE = 3e-4
FAR = 100.0
HEIGHT, WIDTH = 7, 24


def draw(device="cpu", dtype=torch.float32, batch=2, count=3000):
    """Images with holes, uneven tables, queries on, between and beyond the pixels, and what a network may say."""
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    image = uniform(batch, HEIGHT, WIDTH) * 30 + 1
    image[uniform(batch, HEIGHT, WIDTH) < 0.15] = 0
    elevations = (uniform(HEIGHT) + 0.2).cumsum(0) * 0.05 - 0.3
    azimuths = torch.linspace(-3.1, 3.0, WIDTH, dtype=torch.float64) + 0.05 * uniform(WIDTH)
    queries = uniform(batch, count, 2) * torch.tensor([HEIGHT + 1.0, WIDTH + 3.0]) - 1
    queries[:, ::5] = queries[:, ::5].round()
    targets = uniform(batch, count) * 30
    targets[uniform(batch, count) < 0.2] = 0
    scores = torch.randn(batch, count, 4, KINDS, generator=generator, dtype=torch.float64)
    scales = torch.randn(batch, count, 4, generator=generator, dtype=torch.float64)
    tensors = (image, queries, elevations, azimuths, scores, scales, targets)
    return [tensor.to(device, dtype) for tensor in tensors]


@pytest.mark.parametrize("dtype", CLOSE)
@pytest.mark.parametrize("wrap", [True, False])
def test_hypotheses_match_the_reference(dtype, wrap, device, poisoned):
    image, queries, *tables, _, _, _ = draw(device, dtype)
    ours, theirs = (surface_hypotheses(image, queries, *tables, wrap, backend=b) for b in ("warp", "torch"))
    assert ours.dtype == dtype
    torch.testing.assert_close(ours, theirs, rtol=CLOSE[dtype], atol=0)


@pytest.mark.parametrize("dtype", CLOSE)
@pytest.mark.parametrize("wrap", [True, False])
def test_the_likelihood_and_its_gradients_match_the_reference(dtype, wrap, device, poisoned):
    *rays, scores, scales, targets = draw(device, dtype)
    found = []
    for backend in ("warp", "torch"):
        leaves = scores.clone().requires_grad_(), scales.clone().requires_grad_()
        results = surface_likelihood(*rays, *leaves, targets, FAR, wrap, backend)
        loss = (results[0] * torch.linspace(0, 1, targets.shape[1], device=device)).sum() + 0.1 * results[1].sum()
        found.append([*results, *torch.autograd.grad(loss, leaves)])
    for ours, theirs in zip(*found, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=CLOSE[dtype], atol=CLOSE[dtype])


@pytest.mark.parametrize("dtype", CLOSE)
@pytest.mark.parametrize("wrap", [True, False])
def test_the_median_matches_the_reference(dtype, wrap, device, poisoned):
    *rays, scores, scales, _ = draw(device, dtype)
    ours, theirs = (surface_median(*rays, scores, scales, wrap, b) for b in ("warp", "torch"))
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other, rtol=CLOSE[dtype], atol=CLOSE[dtype])


def uneven_sensor():
    elevations = np.deg2rad([-25.0, -19, -15, -12, -10, -9, -8.5, -8])
    return Sensor(elevations, np.linspace(-math.pi, math.pi, 512, endpoint=False))


def plane(normal, distance, elevation, azimuth):
    """Ranges to a plane that is everywhere in view."""
    x, y, z = normal
    along = elevation.cos() * (azimuth.cos() * x + azimuth.sin() * y) + elevation.sin() * z
    return distance / along


@pytest.mark.parametrize("normal", [(0.0, 0.0, -1.0), (0.02, -0.03, -1.0)])
def test_all_continuations_of_one_plane_meet_on_it_whatever_the_spacing_of_the_beams(normal):
    sensor = uneven_sensor()
    elevations, azimuths = torch.tensor(sensor.elevations), torch.tensor(sensor.azimuths)
    image = plane(normal, 1.8, elevations[:, None], azimuths[None])
    generator = torch.Generator().manual_seed(0)
    angles = torch.rand(4000, 2, generator=generator, dtype=torch.float64)
    elevation = elevations[0] + angles[:, 0] * (elevations[-1] - elevations[0])
    azimuth = -math.pi + angles[:, 1] * math.tau
    queries = sensor.locate(elevation, azimuth).double()
    found = surface_hypotheses(image, queries, elevations, azimuths)
    truth = plane(normal, 1.8, elevation, azimuth)[:, None, None]
    # With both continuations, on rows that have an outer neighbour; `locate` is linear between beams, as is this.
    inner = (queries[:, 0] > 1) & (queries[:, 0] < 6)
    kinds = [3 * v + h for v in (0, 1) for h in (0, 1)]
    error = ((found - truth).abs() / truth)[inner][..., kinds]
    assert error.max() < PLANE
    assert ((found - truth).abs() / truth)[inner][..., 8].max() > 0.05  # where nothing is continued


def test_hypotheses_are_the_measured_range_where_the_neighbours_are_holes():
    image = torch.zeros(3, 5)
    image[1, 2] = 7.0
    tables = torch.tensor([-0.1, 0.0, 0.1]), torch.linspace(-0.2, 0.2, 5)
    found = surface_hypotheses(image, torch.tensor([[1.3, 2.4]]), *tables, wrap=False)[0]
    torch.testing.assert_close(found[0], torch.full((KINDS,), 7.0))
    assert (found[1:] == 0).all()


def test_a_column_continues_over_the_seam():
    image, queries, elevations, _, *_ = draw(dtype=torch.float64)
    azimuths = torch.linspace(-math.pi, math.pi, WIDTH + 1, dtype=torch.float64)[:-1]
    turned = torch.stack((queries[..., 0], queries[..., 1] + 5), -1)
    here = surface_hypotheses(image, queries, elevations, azimuths)
    there = surface_hypotheses(image.roll(5, -1), turned, elevations, azimuths)
    torch.testing.assert_close(here, there)


def test_hypotheses_do_not_depend_on_the_order_of_the_rows_and_columns():
    image, queries, elevations, azimuths, *_ = draw(dtype=torch.float64)
    last = torch.tensor([HEIGHT - 1.0, WIDTH - 1.0], dtype=torch.float64)
    off = queries[(queries != queries.round()).all(-1)].view(1, -1, 2)[:, :500]  # on a pixel another one is number 0
    here = surface_hypotheses(image[:1], off, elevations, azimuths, wrap=False)
    there = surface_hypotheses(image[:1].flip(1, 2), last - off, elevations.flip(0), azimuths.flip(0), wrap=False)
    torch.testing.assert_close(here, there.flip(2))


def test_the_probabilities_of_all_ranges_and_of_none_add_up_to_one():
    image, queries, elevations, azimuths, scores, scales, _ = draw(dtype=torch.float64, batch=1, count=20)
    image = image.clamp(5, 20)
    image[:, 3] = 0
    scales = scales - 4  # some centimetres: all that is likely lies between 0 and FAR
    targets = torch.linspace(0, FAR, 200_001, dtype=torch.float64)[1:]
    total = []
    for q in range(20):
        one = [tensor[:, q : q + 1].expand(-1, len(targets), *tensor.shape[2:]) for tensor in (queries, scores, scales)]
        density, _ = surface_likelihood(image, one[0], elevations, azimuths, *one[1:], targets[None], FAR)
        nothing, _ = surface_likelihood(
            image, queries[:, q : q + 1], elevations, azimuths, scores[:, q : q + 1], scales[:, q : q + 1],
            torch.zeros(1, 1, dtype=torch.float64), FAR,
        )  # fmt: skip
        total.append((-density).exp().mean() * FAR + (-nothing).exp().sum())
    torch.testing.assert_close(torch.stack(total), torch.ones(20, dtype=torch.float64), rtol=2e-3, atol=0)


def test_the_median_is_a_hypothesis_with_half_of_the_weight_on_either_side():
    *rays, scores, scales, _ = draw(dtype=torch.float64)
    median, support, none = surface_median(*rays, scores, scales)
    found = surface_hypotheses(*rays).flatten(-2)
    assert (found == median.unsqueeze(-1)).any(-1).all()
    # The expected error is least at a median.
    errors = [surface_likelihood(*rays, scores, scales, at, 1e3)[1] for at in (median, median * 0.99, median * 1.01)]
    assert (errors[0] <= torch.minimum(errors[1], errors[2]) + 1e-9)[median > 0].all()
    assert ((none > 0.5) == (median == 0)).float().mean() > 0.99
    assert (support >= 0).all()
    assert (support.sum(-1) <= 1).all()


@pytest.mark.parametrize("backend", ["warp", "torch"])
def test_what_was_measured_is_answered_on_a_pixel_and_may_be_overruled_beside_it(backend):
    image, _, elevations, azimuths, *_ = draw(batch=1)
    rows, columns = torch.meshgrid(torch.arange(HEIGHT - 1.0), torch.arange(WIDTH - 1.0), indexing="ij")
    pixels = torch.stack((rows, columns), -1).view(1, -1, 2)
    # The other three neighbours have far higher scores than the pixel itself.
    scores = torch.full((1, len(pixels[0]), 4, KINDS), 12.0)
    scores[:, :, 0] = 0.0
    measured = image[:, :-1, :-1].flatten(1)
    for beside, same in ((0.0, True), (1e-6, True), (0.01, False)):
        answer, _, none = surface_median(
            image, pixels + beside, elevations, azimuths, scores, scores[..., 0], backend=backend
        )
        assert torch.allclose(answer, measured, rtol=1e-3) == same
        assert torch.equal((none > 0.99) & (measured == 0), measured == 0) == same


def test_the_sum_of_the_support_is_the_probability_of_being_right_to_a_decimetre():
    image, queries, *others = draw(dtype=torch.float64, batch=1, count=30)
    elevations, azimuths, scores, scales, _ = others
    median, support, none = surface_median(image, queries, elevations, azimuths, scores, scales)
    confidence = support.sum(-1)
    steps = 400
    across = torch.linspace(-TOLERANCE, TOLERANCE, 2 * steps + 1, dtype=torch.float64)[1::2]
    many = [tensor.repeat_interleave(steps, 1) for tensor in (queries, scores, scales)]
    targets = (median.unsqueeze(-1) + across).clamp(min=1e-6).flatten(1)
    density, _ = surface_likelihood(image, many[0], elevations, azimuths, *many[1:], targets, FAR)
    around = (-density).exp().view(30, steps).mean(1) * 2 * TOLERANCE
    returned = median[0] > 0
    torch.testing.assert_close(confidence[0][returned], around[returned], rtol=1e-3, atol=BACKGROUND)
    torch.testing.assert_close(confidence[0][~returned], none[0][~returned])


def test_the_neighbours_whose_surface_is_met_support_the_answer():
    image = torch.tensor([[10.0, 30.0, 0.0], [10.0, 30.0, 0.0]])
    tables = torch.tensor([0.0, 0.01]), torch.tensor([0.0, 0.01, 0.02])
    queries = torch.tensor([[0.5, 0.25], [0.5, 0.75], [0.5, 1.75]])
    scores = torch.tensor([0.0] * 8 + [9.0]).expand(3, 4, KINDS)  # nothing is continued
    ranges, support, none = surface_median(image, queries, *tables, scores, torch.full((3, 4), -9.0), wrap=False)
    torch.testing.assert_close(ranges, torch.tensor([10.0, 30.0, 0.0]))
    nearer = 0.375 * torch.tensor([[1, 0, 1, 0], [0, 1, 0, 1], [0, 1, 0, 1]])  # their areas
    torch.testing.assert_close(support, nearer, rtol=0, atol=0.01)
    torch.testing.assert_close(none, torch.tensor([0.0, 0.0, 0.75]), rtol=0, atol=0.01)


@pytest.mark.parametrize("backend", ["warp", "torch"])
def test_gradcheck(backend):
    *rays, scores, scales, targets = draw(dtype=torch.float64, batch=2, count=40)
    leaves = scores.requires_grad_(), scales.requires_grad_()
    assert torch.autograd.gradcheck(lambda s, c: surface_likelihood(*rays, s, c, targets, FAR, backend=backend), leaves)


def test_compiles_without_graph_breaks(device):
    *rays, scores, scales, targets = draw(device, count=50)
    results = []
    for call in (surface_likelihood, torch.compile(surface_likelihood, fullgraph=True, backend="aot_eager")):
        leaves = scores.clone().requires_grad_(), scales.clone().requires_grad_()
        likelihood, error = call(*rays, *leaves, targets, FAR)
        (likelihood.sin() + error).sum().backward()
        results.append((likelihood.detach(), error.detach(), *(leaf.grad for leaf in leaves)))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_opcheck(device):
    image, queries, elevations, azimuths, scores, scales, targets = draw(device, count=50)
    rays = image, queries, elevations, azimuths, True
    leaves = scores.requires_grad_(), scales.requires_grad_()
    torch.library.opcheck(_surface_likelihood, (*rays, *leaves, targets, FAR))
    torch.library.opcheck(_surface_hypotheses, rays)
    torch.library.opcheck(_surface_median, (*rays, scores.detach(), scales.detach()))


def test_leading_dimensions_broadcast_and_inputs_need_not_be_contiguous():
    image, queries, elevations, azimuths, scores, scales, targets = draw(batch=1, count=40)
    both = queries.expand(3, 40, 2)
    plain = surface_hypotheses(image, queries, elevations, azimuths)
    strided = image.movedim(1, 2).contiguous().movedim(1, 2)
    assert torch.equal(surface_hypotheses(strided, both, elevations, azimuths), plain.expand(3, -1, -1, -1))
    alone = surface_likelihood(image[0], queries[0], elevations, azimuths, scores[0], scales[0], targets[0], FAR)
    together = surface_likelihood(image, queries, elevations, azimuths, scores, scales, targets, FAR)
    for one, other in zip(alone, together, strict=True):
        assert torch.equal(one, other[0])


@pytest.mark.parametrize("wrap", [True, False])
def test_nan_infinite_and_absurd_queries_give_what_the_reference_gives(wrap, device, poisoned):
    image, queries, *tables, scores, scales, targets = draw(device)
    for n, odd in enumerate((math.nan, math.inf, -math.inf, 1e30, -1e30)):
        queries[0, n::50, 0] = odd
        queries[1, n::35, 1] = odd
    odd = queries.isnan().any(-1) | queries.isinf().any(-1)
    ours, theirs = (surface_hypotheses(image, queries, *tables, wrap, backend=b) for b in ("warp", "torch"))
    torch.testing.assert_close(ours, theirs, rtol=CLOSE[torch.float32], atol=0, equal_nan=True)
    rays = image, queries, *tables
    ours, theirs = ([*surface_likelihood(*rays, scores, scales, targets, FAR, wrap, b)] for b in ("warp", "torch"))
    ours += surface_median(*rays, scores, scales, wrap, "warp")
    theirs += surface_median(*rays, scores, scales, wrap, "torch")
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-3, equal_nan=True)
        assert one[odd].isnan().all()
        assert one[~odd].isfinite().all()


@pytest.mark.parametrize("backend", ["warp", "torch"])
def test_a_nan_score_makes_its_answer_nan_and_no_other(backend, device):
    *rays, scores, scales, _ = draw(device, count=20)
    scores[0, 3, 1, 4] = math.nan
    scores[1, 5] = -math.inf
    for answer in surface_median(*rays, scores, scales, backend=backend):
        assert answer[0, 3].isnan().all()
        assert answer[1, 5].isnan().all()
        assert answer.isfinite().sum() == answer.numel() - 2 * answer[0, 3].numel()


@pytest.mark.parametrize("count", [0, 1])
def test_few_queries(count):
    *rays, scores, scales, targets = draw(count=count)
    scores.requires_grad_()
    likelihood, _ = surface_likelihood(*rays, scores, scales, targets, FAR)
    likelihood.sum().backward()
    assert scores.grad.shape == (2, count, 4, KINDS)
    assert surface_median(*rays, scores, scales)[0].shape == (2, count)


def test_half_precision_scores_are_computed_with_in_single():
    *rays, scores, scales, targets = draw()
    rough = scores.bfloat16().requires_grad_()
    likelihood, _ = surface_likelihood(*rays, rough, scales, targets, FAR)
    expected, _ = surface_likelihood(*rays, rough.detach().float(), scales, targets, FAR)
    assert torch.equal(likelihood, expected)
    likelihood.sum().backward()
    assert rough.grad.dtype == torch.bfloat16


@pytest.mark.parametrize(
    ("changed", "error", "words"),
    [
        ({"image": torch.ones(2, HEIGHT, WIDTH).int()}, TypeError, "image is torch.int32"),
        ({"elevations": torch.zeros(3)}, ValueError, r"elevations has shape \(3,\); it should be \(7,\)"),
        ({"azimuths": [0.0]}, TypeError, "azimuths is list"),
        ({"scores": torch.zeros(2, 10, 4, 8)}, ValueError, r"scores has shape \(2, 10, 4, 8\)"),
        ({"scales": torch.zeros(2, 10, 3)}, ValueError, "scales has shape"),
        ({"targets": torch.zeros(2, 11)}, ValueError, "targets has shape"),
        ({"targets": torch.zeros(2, 10, device="meta")}, ValueError, "targets is on meta"),
        ({"elevations": torch.zeros(HEIGHT, device="meta")}, ValueError, "elevations is on meta"),
        ({"far": 0.0}, ValueError, "far is 0.0"),
        ({"far": math.nan}, ValueError, "far is nan"),
        ({"far": math.inf}, ValueError, "far is inf; it should be a finite number"),
        ({"targets": [0.0]}, TypeError, r"targets is list; it should be a tensor \(2, 10\) of one of float32"),
        ({"scores": [0.0]}, TypeError, "scores is list"),
        ({"backend": "numpy"}, ValueError, "backend is 'numpy'"),
    ],
)
def test_wrong_arguments_are_named(changed, error, words):
    names = ("image", "queries", "elevations", "azimuths", "scores", "scales", "targets")
    arguments = dict(zip(names, draw(count=10), strict=True))
    with pytest.raises(error, match=words):
        surface_likelihood(**{**arguments, "far": FAR, **changed})
    if not changed.keys() & {"far", "targets"}:
        with pytest.raises(error, match=words):
            surface_median(**{name: value for name, value in (arguments | changed).items() if name != "targets"})


def test_a_presets_tables_are_taken_as_they_are():
    sensor = preset("hdl-64e")  # falling elevations and azimuths
    tables = torch.tensor(sensor.elevations).float(), torch.tensor(sensor.azimuths).float()
    image = (1.8 / (-torch.tensor(sensor.elevations)).clamp(min=0.03).sin()).float()[:, None].expand(sensor.shape)
    queries = torch.tensor([[40.3, 17.6], [50.5, 2047.5]])
    found = surface_hypotheses(image, queries, *tables, wrap=sensor.wrap)
    elevation = torch.lerp(tables[0][[40, 50]], tables[0][[41, 51]], torch.tensor([0.3, 0.5]))
    truth = 1.8 / (-elevation).sin()
    assert ((found[..., [0, 4]] - truth[:, None, None]).abs() < 2e-3 * truth[:, None, None]).all()
