import math

import pytest
import torch
import torch.nn.functional as F

from kernels import (
    DecoderWeights,
    fused_surfaces,
    fused_surfaces_serves,
    neighbour_attention,
    project_pixels,
    surface_hypotheses,
    surface_median,
)
from kernels.checks import KINDS
from kernels.surfaces.decoder import _fused_surfaces

# Probabilities, and ranges in metres, behind a decoder in float32. A median is one of 36 hypotheses, and where half of
# the weight lies on either side to the last digit, rounding decides which.
CLOSE, UNDECIDED = 1e-3, 2e-3

HEADS = 8
HEIGHT, WIDTH = 5, 16


def draw(channels=32, count=500):
    generator = torch.Generator().manual_seed(0)

    def normal(*shape, scale=1.0):
        return torch.randn(*shape, generator=generator) * scale

    def linear(rows):
        return normal(rows, channels, scale=channels**-0.5), normal(rows)

    def norm():
        return normal(channels), normal(channels)

    features, image = normal(2, channels, HEIGHT, WIDTH), normal(2, HEIGHT, WIDTH).exp() * 10 + 2
    image[normal(2, HEIGHT, WIDTH) > 1.2] = 0
    queries = normal(2, count, 2) * 6 + 2
    queries[:, ::7] = queries[:, ::7].round()
    tables = torch.linspace(-0.3, 0.2, HEIGHT), torch.linspace(-3, 3, WIDTH)
    position = normal(channels, 2), normal(channels)
    projected = project_pixels(features, position, norm(), linear(3 * channels)[0], HEADS)
    weights = DecoderWeights(linear(channels), norm(), linear(channels), linear(channels), norm(), linear(KINDS + 1))
    return [projected, image, queries, *tables, weights]


def assert_close(ours, theirs):
    for one, other in zip(ours, theirs, strict=True):
        apart = (one - other).abs() > CLOSE
        assert apart.float().mean() < UNDECIDED
        assert torch.equal(one.isnan(), other.isnan())


@pytest.mark.parametrize("channels", [16, 32, 48, 64])
@pytest.mark.parametrize("wrap", [True, False])
def test_is_the_decoder_layer_by_layer(channels, wrap, poisoned):
    projected, image, queries, elevations, azimuths, weights = draw(channels)
    assert fused_surfaces_serves(projected)
    t = neighbour_attention(projected, queries, weights.output, wrap, backend="torch")
    hidden = F.gelu(F.linear(F.layer_norm(t, (channels,), *weights.norm), *weights.hidden))
    t = t + F.linear(hidden, *weights.back)
    said = F.linear(F.layer_norm(t, (channels,), *weights.head_norm), *weights.score)
    scores, scales = said.split((KINDS, 1), -1)
    expected = surface_median(image, queries, elevations, azimuths, scores, scales.squeeze(-1), wrap, "torch")
    for backend in ("warp", "torch"):
        answers = fused_surfaces(projected, image, queries, elevations, azimuths, weights, wrap, backend=backend)
        assert_close(answers, expected)


def test_answers_are_hypotheses_and_confidences_probabilities():
    projected, image, queries, elevations, azimuths, weights = draw()
    ranges, support, none = fused_surfaces(projected, image, queries, elevations, azimuths, weights)
    found = surface_hypotheses(image, queries, elevations, azimuths).flatten(-2)
    assert (found == ranges.unsqueeze(-1)).any(-1).all()
    assert (support >= 0).all()
    assert (support.sum(-1) <= 1 + 1e-6).all()
    certain = (none - 0.5).abs() > 0.01
    assert torch.equal(ranges[certain] == 0, none[certain] > 0.5)


def test_any_number_of_queries_and_cores(poisoned):
    projected, image, queries, *rest = draw(count=1000)
    expected = fused_surfaces(projected, image, queries, *rest)
    assert fused_surfaces(projected, image, queries[:, :0], *rest)[1].shape == (2, 0, 4)
    for count in (1, 15, 17, 999):
        some = fused_surfaces(projected, image, queries[:, :count], *rest)
        assert_close(some, [whole[:, :count] for whole in expected])
    cores = torch.get_num_threads()
    try:
        for number in (1, 3):
            torch.set_num_threads(number)
            for one, other in zip(fused_surfaces(projected, image, queries, *rest), expected, strict=True):
                assert torch.equal(one, other)
    finally:
        torch.set_num_threads(cores)


@pytest.mark.parametrize("absurd", [1e9, 1e30, math.inf])
def test_absurd_queries_give_what_the_twin_gives(absurd, poisoned):
    projected, image, queries, *rest = draw()
    queries[:, ::5] = absurd
    queries[:, 1::5, 0] = -absurd
    queries[:, 2::5, 1] = absurd
    ours, plain = (fused_surfaces(projected, image, queries, *rest, backend=b) for b in ("warp", "torch"))
    assert_close(ours, plain)


def test_a_query_of_nan_makes_its_answer_nan_and_no_other():
    projected, image, queries, *rest = draw()
    queries[1, 3] = math.nan
    for answer in fused_surfaces(projected, image, queries, *rest):
        assert answer[1, 3].isnan().all()
        assert answer.isnan().sum() == answer[1, 3].numel()


def test_opcheck_without_gradients():
    (pixels, slope, shift, gram, _), image, queries, elevations, azimuths, _ = draw(count=9)
    layers = torch.randn(3, 32, 32), torch.randn(3, 32), torch.randn(32, 16), torch.randn(16)
    arguments = (pixels, queries, slope, shift, gram, image, elevations, azimuths, *layers, 1e-5, True)
    torch.library.opcheck(_fused_surfaces, arguments)


def test_what_it_does_not_serve_is_named():
    projected, image, queries, elevations, azimuths, weights = draw()
    tables = elevations, azimuths
    with pytest.raises(ValueError, match=r"on cpu with 4 heads and 32 channels; it should be .* multiple of 16"):
        fused_surfaces(projected._replace(heads=4), image, queries, *tables, weights)
    with pytest.raises(ValueError, match=r"image has shape \(2, 4, 16\); it should be \(2, 5, 16\)"):
        fused_surfaces(projected, image[:, :4], queries, *tables, weights)
    with pytest.raises(ValueError, match=r"azimuths has shape \(5,\); it should be \(16,\)"):
        fused_surfaces(projected, image, queries, elevations, elevations, weights)
    with pytest.raises(TypeError, match=r"elevations is torch\.int64"):
        fused_surfaces(projected, image, queries, torch.arange(HEIGHT), azimuths, weights)
    with pytest.raises(ValueError, match=r"queries has shape \(500, 2\)"):
        fused_surfaces(projected, image, queries[0], *tables, weights)
    short = weights._replace(score=(weights.score[0][:9], weights.score[1][:9]))
    with pytest.raises(ValueError, match=r"weights.score\[0\] has shape \(9, 32\); it should be \(10, 32\)"):
        fused_surfaces(projected, image, queries, *tables, short)
    elsewhere = weights._replace(back=(weights.back[0], weights.back[1].to("meta")))
    with pytest.raises(ValueError, match=r"weights.back\[1\] is on meta; it should be on cpu"):
        fused_surfaces(projected, image, queries, *tables, elsewhere)
