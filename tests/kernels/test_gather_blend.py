import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kernels import gather_blend
from kernels.checks import PRIORS, RANGE_FLOOR
from kernels.gather_blend import _gather_blend

# float32 rounds ranges below 100 m to 8e-6 m; a blend of four adds a few roundings.
METRES = 5e-5
# Weights and gradients to scores are sums of a few float32 products.
RELATIVE = 1e-4
# A weight or a gradient to a score, rounded once or, by PyTorch's casts, twice.
HALF = {torch.bfloat16: 2**-7, torch.float16: 2**-10}

SIZES = [(16, 64, True), (5, 7, False), (1, 3, True), (3, 1, True), (1, 1, True), (2, 1, False), (3, 2, True)]


def draw(height, width, device, dtype=torch.float32, batch=(2,), count=257):
    generator = torch.Generator().manual_seed(height * 100 + width)
    image = torch.rand(*batch, height, width, generator=generator, dtype=dtype) * 80 + 2
    # Beyond all four borders, and some exactly on pixel centres.
    queries = torch.rand(*batch, count, 2, generator=generator, dtype=dtype)
    queries = queries * torch.tensor([height + 3, 2 * width + 3], dtype=dtype) - torch.tensor([2, width], dtype=dtype)
    queries[..., ::5, :] = queries[..., ::5, :].round()
    scores = torch.randn(*batch, count, 4, generator=generator, dtype=dtype)
    return image.to(device), queries.to(device), scores.to(device)


@pytest.mark.parametrize("prior", PRIORS)
@pytest.mark.parametrize(("height", "width", "wrap"), SIZES)
@pytest.mark.parametrize("area_floor", [0.0, 1e-3])
def test_matches_the_reference_with_gradients(height, width, wrap, prior, area_floor, device, poisoned):
    image, queries, scores = draw(height, width, device)
    image.requires_grad_()
    scores.requires_grad_()
    results = []
    for backend in ("warp", "torch"):
        blended, weights = gather_blend(
            image, queries, scores, prior, wrap, area_floor=area_floor, return_weights=True, backend=backend
        )
        # Different factors for every element: equal gradients are no coincidence.
        loss = (blended * queries[..., 0].cos()).sum() + (weights * weights.detach().sin() * scores.detach()).sum()
        results.append((blended, weights, *torch.autograd.grad(loss, [image, scores])))
    (blended, weights, *gradients), (blended_ref, weights_ref, *gradients_ref) = results
    torch.testing.assert_close(blended, blended_ref, rtol=0, atol=METRES)
    torch.testing.assert_close(weights, weights_ref, rtol=RELATIVE, atol=1e-6)
    for gradient, reference in zip(gradients, gradients_ref, strict=True):
        torch.testing.assert_close(gradient, reference, rtol=RELATIVE, atol=RELATIVE)


@pytest.mark.parametrize("prior", PRIORS)
@pytest.mark.parametrize("dtype", HALF)
def test_half_precision_scores_leave_the_ranges_in_float32(dtype, prior, device, poisoned):
    image, queries, scores = draw(8, 16, device)
    half = scores.to(dtype).requires_grad_()
    image.requires_grad_()
    results = []
    for leaf, backend in ((half, "warp"), (half, "torch"), (half.detach().float().requires_grad_(), "warp")):
        blended, weights = gather_blend(
            image, queries, leaf, prior, area_floor=1e-3, return_weights=True, backend=backend
        )
        assert blended.dtype == torch.float32
        assert weights.dtype == leaf.dtype
        loss = (blended * queries[..., 0].cos()).sum() + (weights.float() * scores).sum()
        results.append((blended, weights, *torch.autograd.grad(loss, [image, leaf])))
    for backend in (0, 1):
        for ours, exact in zip(results[backend], results[2], strict=True):
            # The ranges and their gradient are not rounded to half precision on their way; weights and scores once.
            tolerance = RELATIVE if ours.dtype == torch.float32 else HALF[dtype]
            torch.testing.assert_close(ours.float(), exact.float(), rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("prior", PRIORS)
@pytest.mark.parametrize("wrap", [True, False])
def test_gradcheck(prior, wrap, device):
    image, queries, scores = draw(3, 4, device, torch.float64, batch=(1,), count=9)

    def op(image, scores):
        return gather_blend(image, queries, scores, prior, wrap, area_floor=1e-3, return_weights=True)

    assert torch.autograd.gradcheck(op, (image.requires_grad_(), scores.requires_grad_()))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("prior", range(len(PRIORS)))
def test_opcheck(prior, dtype, device):
    image, queries, scores = draw(4, 5, device, count=11)
    scores = scores.to(dtype)
    torch.library.opcheck(_gather_blend, (image.requires_grad_(), queries, scores.requires_grad_(), prior, 1e-3, True))


def test_weights_are_positive_and_sum_to_one(device):
    image, queries, scores = draw(8, 16, device)
    for prior in PRIORS:
        _, weights = gather_blend(image, queries, scores * 30, prior, area_floor=1e-4, return_weights=True)
        assert (weights >= 0).all()
        torch.testing.assert_close(weights.sum(-1), torch.ones_like(weights[..., 0]))


@pytest.mark.parametrize("prior", PRIORS)
def test_stays_between_its_neighbours_and_keeps_constants(prior, device):
    image, queries, scores = draw(8, 16, device)
    blended = gather_blend(image, queries, scores, prior)
    assert blended.min() >= image.min() - METRES
    assert blended.max() <= image.max() + METRES
    constant = gather_blend(torch.full_like(image, 7.25), queries, scores, prior)
    torch.testing.assert_close(constant, torch.full_like(constant, 7.25))


def test_zero_scores_under_the_bilinear_prior_are_bilinear(device):
    rows, columns = torch.meshgrid(torch.arange(6.0), torch.arange(9.0), indexing="ij")
    image = (3 + 2 * rows + 5 * columns).to(device)
    queries = (torch.rand(100, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([5.0, 8.0])).to(device)
    blended = gather_blend(image, queries, queries.new_zeros(100, 4), "bilinear", wrap=False)
    torch.testing.assert_close(blended, 3 + 2 * queries[:, 0] + 5 * queries[:, 1], rtol=0, atol=METRES)


def test_zero_scores_under_the_perspective_prior_are_bilinear_over_inverse_range(device):
    image, queries, scores = draw(8, 16, device)
    inverse = gather_blend(1 / image, queries, scores * 0, "bilinear")
    torch.testing.assert_close(gather_blend(image, queries, scores * 0, "perspective"), 1 / inverse, rtol=1e-5, atol=0)


@pytest.mark.parametrize("prior", ["bilinear", "perspective"])
def test_a_measured_pixel_is_kept_exactly_by_a_prior_without_floor(prior, device):
    image, _, _ = draw(4, 6, device, batch=())
    rows, columns = torch.meshgrid(torch.arange(4.0), torch.arange(6.0), indexing="ij")
    queries = torch.stack([rows, columns], -1).view(-1, 2).to(device)
    scores = torch.randn(24, 4, generator=torch.Generator().manual_seed(1)).to(device) * 50
    torch.testing.assert_close(gather_blend(image, queries, scores, prior), image.view(-1), rtol=0, atol=0)


def test_the_seam_wraps_or_clamps(device):
    image = torch.tensor([[1.0, 2.0, 3.0, 10.0]], device=device)
    queries = torch.tensor([[0.0, 3.5], [0.0, -0.5], [0.0, 7.5], [0.0, 3.25]], device=device)
    zeros = queries.new_zeros(4, 4)
    wrapped = gather_blend(image, queries, zeros, "bilinear", wrap=True)
    torch.testing.assert_close(wrapped, wrapped.new_tensor([5.5, 5.5, 5.5, 7.75]))
    clamped = gather_blend(image, queries, zeros, "bilinear", wrap=False)
    torch.testing.assert_close(clamped, clamped.new_tensor([10.0, 1.0, 10.0, 10.0]))


def test_huge_scores_do_not_overflow(device):
    image = torch.tensor([[4.0, 8.0]], device=device)
    scores = torch.tensor([[1e30, -1e30, -1e30, -1e30], [0.0, 3e4, 0.0, 0.0]], device=device)
    blended = gather_blend(image, torch.tensor([[0.0, 0.5], [0.0, 0.5]], device=device), scores, wrap=False)
    torch.testing.assert_close(blended, blended.new_tensor([4.0, 8.0]))
    # The largest score belongs to a neighbour that the prior shuts out: the others still share the weight.
    shut_out = gather_blend(image, torch.zeros(1, 2, device=device), scores[1:], "bilinear", wrap=False)
    torch.testing.assert_close(shut_out, shut_out.new_tensor([4.0]))


def test_ranges_below_the_floor_do_not_divide_by_zero(device):
    image = torch.tensor([[0.0, 5.0]], device=device, requires_grad=True)
    queries = torch.tensor([[0.0, 0.5]], device=device)
    blended = gather_blend(image, queries, queries.new_zeros(1, 4), "perspective", wrap=False)
    expected = (5.0 / 5.0) / (1 / RANGE_FLOOR + 1 / 5.0)
    torch.testing.assert_close(blended, blended.new_tensor([expected]))
    blended.sum().backward()
    assert image.grad.isfinite().all()


def test_nan_stays_with_the_queries_it_concerns(device):
    image, queries, scores = draw(8, 16, device)
    scores[0, 3, 1] = float("nan")
    blended = gather_blend(image, queries, scores)
    assert blended[0, 3].isnan()
    assert blended.isnan().sum() == 1


@pytest.mark.parametrize("prior", PRIORS)
@pytest.mark.parametrize("wrap", [True, False])
def test_nan_queries_and_nan_ranges_give_what_the_reference_gives(prior, wrap, device):
    image, queries, scores = draw(8, 16, device)
    queries[0, ::7, 0] = math.nan
    queries[0, ::5, 1] = math.nan
    queries[1, ::7] = math.inf
    image[1, 3, 4] = math.nan
    results = [
        gather_blend(image, queries, scores, prior, wrap, area_floor=1e-3, return_weights=True, backend=backend)
        for backend in ("warp", "torch")
    ]
    for ours, reference in zip(*results, strict=True):
        torch.testing.assert_close(ours, reference, rtol=RELATIVE, atol=METRES, equal_nan=True)
    assert results[0][0].isnan().any()
    assert results[0][0].isfinite().any()


def test_batches_broadcast(device):
    image, queries, scores = draw(5, 6, device, batch=(3, 1))
    queries, scores = queries[:1, 0], scores[0].expand(4, -1, -1)
    blended = gather_blend(image, queries, scores)
    assert blended.shape == (3, 4, 257)
    torch.testing.assert_close(blended[2, 1], gather_blend(image[2, 0], queries[0], scores[1]))
    image.requires_grad_()
    gather_blend(image, queries, scores).sum().backward()
    assert image.grad.shape == image.shape
    torch.testing.assert_close(image.grad.sum(), image.new_tensor(3.0 * 4 * 257), rtol=1e-4, atol=0)


def test_no_queries_and_strided_inputs(device):
    image, queries, scores = draw(5, 6, device)
    assert gather_blend(image, queries[:, :0], scores[:, :0]).shape == (2, 0)
    expected = gather_blend(image, queries, scores, "perspective")
    transposed = image.transpose(1, 2).contiguous().transpose(1, 2)
    scattered = torch.stack([scores, scores], -1)[..., 0]
    result = gather_blend(transposed, queries.flip(1).flip(1), scattered, "perspective")
    torch.testing.assert_close(result, expected, rtol=0, atol=0)


def test_backward_twice_gives_the_same_gradients_bit_for_bit(device):
    image, queries, scores = draw(8, 16, device, count=5000)
    image.requires_grad_()
    blended = gather_blend(image, queries, scores, "perspective")
    grads = [torch.autograd.grad(blended.sum(), image, retain_graph=True)[0] for _ in range(3)]
    assert all(torch.equal(grads[0], g) for g in grads[1:])


def test_compiles_without_graph_breaks(device):
    image, queries, scores = draw(8, 16, device)
    results = []
    for call in (gather_blend, torch.compile(gather_blend, fullgraph=True, backend="aot_eager")):
        leaves = [image.clone().requires_grad_(), scores.clone().requires_grad_()]
        blended = call(leaves[0], queries, leaves[1], "perspective")
        blended.sin().sum().backward()
        results.append((blended.detach(), *(leaf.grad for leaf in leaves)))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_mutating_a_saved_input_raises(device):
    image, queries, scores = draw(4, 4, device)
    scores.requires_grad_()
    blended = gather_blend(image, queries, scores)
    image.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        blended.sum().backward()


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 6), st.integers(1, 6), st.booleans(), st.sampled_from(PRIORS), st.integers(0, 2**31))
def test_matches_the_reference_on_any_size(height, width, wrap, prior, seed):
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(height, width, generator=generator, dtype=torch.float64) * 50 + 1
    queries = torch.randn(20, 2, generator=generator, dtype=torch.float64) * 8
    scores = torch.randn(20, 4, generator=generator, dtype=torch.float64) * 5
    ours, reference = (gather_blend(image, queries, scores, prior, wrap, backend=b) for b in ("warp", "torch"))
    torch.testing.assert_close(ours, reference)


def bad_arguments():
    image, queries, scores = torch.ones(4, 5), torch.ones(7, 2), torch.ones(7, 4)
    return {
        "prior is 'cubic'": (image, queries, scores, {"prior": "cubic"}),
        "backend is 'jax'": (image, queries, scores, {"backend": "jax"}),
        "area_floor is 0.5": (image, queries, scores, {"area_floor": 0.5}),
        "image is torch.int64": (image.long(), queries, scores, {}),
        "image is list": ([[1.0]], queries, scores, {}),
        "image is torch.bfloat16": (image.bfloat16(), queries, scores.bfloat16(), {}),
        "scores is torch.float16; it should be torch.float64, as image is": (
            image.double(),
            queries,
            scores.half(),
            {},
        ),
        r"image has shape \(0, 5\)": (image[:0], queries, scores, {}),
        r"queries has shape \(7, 3\)": (image, torch.ones(7, 3), scores, {}),
        "queries is torch.int64": (image, queries.long(), scores, {}),
        r"scores has shape \(6, 4\)": (image, queries, scores[:6], {}),
        r"scores has shape \(7, 3\)": (image, queries, scores[:, :3], {}),
        "scores is torch.float64; it should be torch.float32, as image is": (image, queries, scores.double(), {}),
        "do not broadcast": (image.expand(3, 4, 5), queries.expand(2, 7, 2), scores, {}),
    }


@pytest.mark.parametrize("message", bad_arguments())
def test_bad_arguments_are_named(message):
    *tensors, options = bad_arguments()[message]
    with pytest.raises((TypeError, ValueError), match=message):
        gather_blend(*tensors, **options)
