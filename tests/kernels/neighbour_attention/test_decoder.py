import re

import pytest
import torch
import torch.nn.functional as F

from kernels import (
    DecoderWeights,
    fused_decode,
    neighbour_attention,
    project_pixels,
    reference,
)
from kernels.checks import PRIORS
from kernels.neighbour_attention.decoder import _fused_decode

# float32 ranges below 100 m behind a decoder.
METRES = 1e-3

C, HEADS = 64, 8


def draw(channels=C, count=500, height=5, width=16):
    generator = torch.Generator().manual_seed(0)

    def normal(*shape, scale=1.0):
        return torch.randn(*shape, generator=generator) * scale

    def linear(rows):
        return normal(rows, channels, scale=channels**-0.5), normal(rows)

    features, image = normal(2, channels, height, width), normal(2, height, width).exp() * 10 + 2
    queries = normal(2, count, 2) * 6 + 2
    queries[:, ::7] = queries[:, ::7].round()
    projected = project_pixels(
        features,
        (normal(channels, 2), normal(channels)),
        (normal(channels), normal(channels)),
        linear(3 * channels)[0],
        HEADS,
    )
    weights = DecoderWeights(
        linear(channels), (normal(channels), normal(channels)), linear(channels), linear(channels),
        (normal(channels), normal(channels)), linear(1),
    )  # fmt: skip
    return projected, image, queries, weights


@pytest.mark.parametrize("channels", [32, 64, 80, 128])
@pytest.mark.parametrize("prior", PRIORS)
@pytest.mark.parametrize("wrap", [True, False])
def test_is_the_decoder_layer_by_layer(channels, prior, wrap, poisoned):
    projected, image, queries, weights = draw(channels)
    t = neighbour_attention(projected, queries, weights.output, wrap, backend="torch")
    hidden = F.gelu(F.linear(F.layer_norm(t, (channels,), *weights.norm), *weights.hidden))
    t = t + F.linear(hidden, *weights.back)
    scores = F.linear(F.layer_norm(t, (channels,), *weights.head_norm), *weights.score).squeeze(-1)
    expected, _ = reference.gather_blend(image, queries, scores, prior, wrap, 1e-3)
    for backend in ("warp", "torch"):
        ranges = fused_decode(projected, image, queries, weights, prior, wrap, area_floor=1e-3, backend=backend)
        torch.testing.assert_close(ranges, expected, rtol=0, atol=METRES)


def test_any_number_of_queries_and_cores():
    projected, image, queries, weights = draw(count=1000)
    expected = fused_decode(projected, image, queries, weights)
    assert fused_decode(projected, image, queries[:, :0], weights).shape == (2, 0)
    for count in (1, 15, 17, 999):
        some = fused_decode(projected, image, queries[:, :count], weights)
        torch.testing.assert_close(some, expected[:, :count], rtol=0, atol=METRES)
    cores = torch.get_num_threads()
    try:
        for number in (1, 3):
            torch.set_num_threads(number)
            assert torch.equal(fused_decode(projected, image, queries, weights), expected)
    finally:
        torch.set_num_threads(cores)


def test_an_area_of_zero_shuts_a_neighbour_out():
    projected, image, queries, weights = draw()
    on_pixels = queries.round().clamp(min=0) % torch.tensor([5, 16])
    ranges = fused_decode(projected, image, on_pixels, weights, "bilinear")
    row, column = on_pixels.long().unbind(-1)
    torch.testing.assert_close(ranges, image[torch.arange(2).unsqueeze(1), row, column], rtol=0, atol=METRES)


def test_opcheck_without_gradients():
    (pixels, slope, shift, gram, _), image, queries, _ = draw(count=9)
    matrices, rows = torch.randn(3, C, C), torch.randn(4, C)
    arguments = pixels, queries, slope, shift, gram, image, matrices, rows, 1, 1e-3, 1e-5, True
    torch.library.opcheck(_fused_decode, arguments)


def test_what_it_does_not_serve_is_named():
    projected, image, queries, weights = draw()
    with pytest.raises(ValueError, match=r"projected is torch\.float32 on cpu with 4 heads and 64 channels"):
        fused_decode(projected._replace(heads=4), image, queries, weights)
    with pytest.raises(ValueError, match=r"image has shape \(2, 4, 16\)"):
        fused_decode(projected, image[:, :4], queries, weights)
    with pytest.raises(ValueError, match="prior is 'cubic'"):
        fused_decode(projected, image, queries, weights, "cubic")
    with pytest.raises(ValueError, match=r"area_floor is 0\.5; it should be between 0 and 0\.25"):
        fused_decode(projected, image, queries, weights, area_floor=0.5)
    with pytest.raises(ValueError, match=r"queries has shape \(500, 2\)"):
        fused_decode(projected, image, queries[0], weights)


def test_a_tensor_on_another_device_is_named():
    projected, image, queries, weights = draw(count=9)

    def refused(name, projected=projected, image=image, queries=queries, weights=weights):
        with pytest.raises(ValueError, match=rf"{re.escape(name)} is on meta; it should be on cpu, where projected"):
            fused_decode(projected, image, queries, weights)

    for name in ("slope", "shift", "gram"):
        refused(f"projected.{name}", projected=projected._replace(**{name: getattr(projected, name).to("meta")}))
    refused("image", image=image.to("meta"))
    refused("queries", queries=queries.to("meta"))
    for name in weights._fields:
        for i in range(2):
            pair = [tensor.to("meta") if j == i else tensor for j, tensor in enumerate(getattr(weights, name))]
            refused(f"weights.{name}[{i}]", weights=weights._replace(**{name: tuple(pair)}))


@pytest.mark.parametrize("absurd", [1e9, 1e30, float("inf")])
def test_absurd_queries_give_finite_ranges_equal_to_the_twins(absurd, poisoned):
    projected, image, queries, weights = draw()
    queries[:, ::5] = absurd
    queries[:, 1::5, 0] = -absurd
    queries[:, 2::5, 1] = absurd
    ours, plain = (fused_decode(projected, image, queries, weights, backend=b) for b in ("warp", "torch"))
    assert ours.isfinite().all()
    torch.testing.assert_close(ours, plain, rtol=0, atol=METRES)
