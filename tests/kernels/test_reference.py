"""What is asked of the plain twins themselves. That they agree with the ops is tested op by op."""

import torch

from kernels import DecoderWeights, fused_decode, project_pixels, reference

CHANNELS, HEADS = 64, 8


def draw():
    generator = torch.Generator().manual_seed(0)
    matrix = torch.randn(3 * CHANNELS, CHANNELS, generator=generator) / 8
    position, norm = (matrix[:CHANNELS, :2], matrix[0]), (matrix[1], matrix[2])
    features = torch.randn(1, CHANNELS, 4, 8, generator=generator)
    queries = torch.rand(1, 20, 2, generator=generator) * 3
    return project_pixels(features, position, norm, matrix, HEADS), matrix, queries


def test_the_decoders_ranges_are_float32_for_queries_and_images_of_any_precision():
    projected, matrix, queries = draw()
    linear, norm = (matrix[:CHANNELS], matrix[0]), (matrix[1], matrix[2])
    weights = DecoderWeights(linear, norm, linear, linear, norm, (matrix[:1], matrix[0, :1]))
    image = torch.rand(1, 4, 8, generator=torch.Generator().manual_seed(1)) * 20 + 2
    expected = fused_decode(projected, image, queries, weights, backend="torch")
    for backend in ("warp", "torch"):
        ranges = fused_decode(projected, image.double(), queries.double(), weights, backend=backend)
        assert ranges.dtype == torch.float32
        torch.testing.assert_close(ranges, expected, rtol=0, atol=1e-3)


def test_a_variance_that_is_rounded_to_below_0_counts_as_0():
    projected, matrix, queries = draw()
    pixels, slope, shift, gram, heads = projected
    others = slope, shift, gram * 0, matrix[:CHANNELS], matrix[0], heads, 1e-5, True
    results = []
    for squares in (-1e-2, 0.0):
        pixels = pixels.clone()
        pixels[..., 4 * CHANNELS :] = 0
        pixels[..., 4 * CHANNELS] = squares
        results.append(reference.neighbour_attention(pixels, queries, *others))
    assert results[1].isfinite().all()
    assert torch.equal(*results)
