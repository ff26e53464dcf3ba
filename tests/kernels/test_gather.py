import math

import pytest
import torch

from kernels import gather_neighbours
from kernels.gather import _gather_neighbours
from kernels.reference import areas
from kernels.scatter import sum_by_pixel, sum_by_query

# A gradient sums a few thousand float32 products at most.
SUM = 1e-4

SIZES = [(16, 64, True), (5, 7, False), (1, 3, True), (3, 1, True), (1, 1, True), (2, 1, False), (3, 2, True)]


def draw(height, width, device, dtype=torch.float32, channels=9, count=257):
    generator = torch.Generator().manual_seed(height * 100 + width)
    features = torch.randn(2, channels, height, width, generator=generator, dtype=dtype)
    queries = torch.rand(2, count, 2, generator=generator, dtype=dtype) * torch.tensor([height + 3, 2 * width + 3])
    queries = queries - torch.tensor([2, width])
    queries[:, ::5] = queries[:, ::5].round()
    return features.to(device), queries.to(device)


@pytest.mark.parametrize(("height", "width", "wrap"), SIZES)
@pytest.mark.parametrize("channels", [1, 9, 32])
def test_matches_the_reference_with_gradients(height, width, wrap, channels, device, poisoned):
    features, queries = draw(height, width, device, channels=channels)
    features.requires_grad_()
    results = []
    for backend in ("warp", "torch"):
        gathered, offsets = gather_neighbours(features, queries, wrap, backend)
        (gradient,) = torch.autograd.grad(gathered.sin().sum(), features)
        results.append((gathered, offsets, gradient))
    (gathered, offsets, gradient), (gathered_ref, offsets_ref, gradient_ref) = results
    assert torch.equal(gathered, gathered_ref)
    assert torch.equal(offsets, offsets_ref)
    torch.testing.assert_close(gradient, gradient_ref, rtol=SUM, atol=SUM)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_is_copied_and_its_gradient_summed_in_float32(dtype, device, poisoned):
    features, queries = draw(6, 8, device, count=5000)
    half = features.to(dtype).requires_grad_()
    gathered, offsets = gather_neighbours(half, queries)
    expected, expected_offsets = gather_neighbours(half.float(), queries)
    assert gathered.dtype == dtype
    assert torch.equal(gathered.float(), expected)
    assert torch.equal(offsets, expected_offsets)
    (gradient,) = torch.autograd.grad(gathered.sum(), half)
    ones = torch.autograd.grad(gather_neighbours(features.requires_grad_(), queries)[0].sum(), features)[0]
    assert torch.equal(gradient, ones.to(dtype))


@pytest.mark.parametrize(("height", "width", "wrap"), SIZES)
@pytest.mark.parametrize(("channels", "batch"), [(1, 1), (9, 2), (32, 16)])
def test_the_sums_for_a_gpu_and_for_a_cpu_agree(height, width, wrap, channels, batch, device, poisoned):
    _, queries = draw(height, width, device)
    queries = queries[:1].expand(batch, -1, -1).contiguous()
    gradients = torch.randn(batch, 257, 4, channels, generator=torch.Generator().manual_seed(0)).to(device)
    by_pixel, by_query = (summed(gradients, queries, height, width, wrap) for summed in (sum_by_pixel, sum_by_query))
    torch.testing.assert_close(by_pixel, by_query, rtol=SUM, atol=SUM)


def test_order_of_the_neighbours_and_sign_of_the_offsets(device):
    features = torch.arange(12.0, device=device).view(1, 3, 4)
    gathered, offsets = gather_neighbours(features, torch.tensor([[1.25, 2.5], [0.0, 3.75]], device=device))
    assert gathered[0, :, 0].tolist() == [6, 7, 10, 11]
    assert offsets[0].tolist() == [[0.25, 0.5], [0.25, -0.5], [-0.75, 0.5], [-0.75, -0.5]]
    # Over the seam the neighbour is column 0, and the offset does not jump.
    assert gathered[1, :, 0].tolist() == [3, 0, 7, 4]
    assert offsets[1].tolist() == [[0, 0.75], [0, -0.25], [-1, 0.75], [-1, -0.25]]


def test_offsets_agree_with_the_areas(device):
    features, queries = draw(6, 8, device, torch.float64)
    inside = queries.clamp(min=0) % torch.tensor([5, 8], device=device)
    _, offsets = gather_neighbours(features, inside)
    torch.testing.assert_close((1 - offsets.abs()).prod(-1), areas(inside))


@pytest.mark.parametrize("wrap", [True, False])
def test_gradcheck(wrap, device):
    features, queries = draw(3, 4, device, torch.float64, channels=2, count=9)
    assert torch.autograd.gradcheck(
        lambda f: gather_neighbours(f, queries, wrap)[0], features.requires_grad_(), fast_mode=True
    )


def test_opcheck(device):
    features, queries = draw(3, 4, device, count=9)
    torch.library.opcheck(_gather_neighbours, (features.movedim(1, 3).contiguous().requires_grad_(), queries, True))


def test_offsets_carry_no_gradient(device):
    features, queries = draw(5, 6, device)
    for backend in ("warp", "torch"):
        gathered, offsets = gather_neighbours(features.requires_grad_(), queries, backend=backend)
        assert gathered.requires_grad
        assert not offsets.requires_grad


def test_absurd_queries_read_no_foreign_memory(device):
    features, _ = draw(5, 6, device)
    wild = torch.tensor([[1e12, -1e12], [-3e38, 3e38], [float("inf"), float("-inf")], [float("nan"), 2.0]])
    for wrap in (True, False):
        ours, twin = (gather_neighbours(features, wild.to(device), wrap, b)[0] for b in ("warp", "torch"))
        assert torch.equal(ours[:, :3], twin[:, :3])
        assert ours.isfinite().all()


def test_compiles_without_graph_breaks(device):
    features, queries = draw(5, 6, device)
    results = []
    for call in (gather_neighbours, torch.compile(gather_neighbours, fullgraph=True, backend="aot_eager")):
        leaf = features.clone().requires_grad_()
        gathered, _ = call(leaf, queries)
        gathered.sin().sum().backward()
        results.append((gathered.detach(), leaf.grad))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_memory_formats_batches_and_no_queries(device):
    features, queries = draw(5, 6, device)
    expected, _ = gather_neighbours(features, queries)
    last, _ = gather_neighbours(features.to(memory_format=torch.channels_last), queries)
    assert torch.equal(last, expected)
    broadcast, offsets = gather_neighbours(features, queries[0])
    assert torch.equal(broadcast[0], expected[0])
    assert offsets.shape == (2, 257, 4, 2)
    assert gather_neighbours(features, queries[:, :0])[0].shape == (2, 0, 4, 9)


def test_backward_twice_gives_the_same_gradient_bit_for_bit(device):
    features, queries = draw(8, 16, device, count=5000)
    features.requires_grad_()
    gathered, _ = gather_neighbours(features, queries)
    first, second = (torch.autograd.grad(gathered.sin().sum(), features, retain_graph=True)[0] for _ in range(2))
    assert torch.equal(first, second)


@pytest.mark.parametrize("wrap", [True, False])
def test_nan_and_infinite_queries_select_the_pixels_that_the_reference_selects(wrap, device):
    features = torch.arange(5 * 7.0, device=device).view(1, 5, 7)
    odd = torch.tensor([math.nan, math.inf, -math.inf, 1e30, -1e30, 2.5], device=device)
    queries = torch.cartesian_prod(odd, odd)
    ours, reference = (gather_neighbours(features, queries, wrap, backend=backend) for backend in ("warp", "torch"))
    assert torch.equal(ours[0], reference[0])
    torch.testing.assert_close(ours[1], reference[1], equal_nan=True)


@pytest.mark.parametrize(
    ("features", "queries", "message"),
    [
        (torch.ones(4, 5), torch.ones(7, 2), r"features has shape \(4, 5\)"),
        (torch.ones(0, 4, 5), torch.ones(7, 2), "none of them 0"),
        (torch.ones(2, 4, 5).int(), torch.ones(7, 2), "features is torch.int32"),
        (torch.ones(2, 4, 5), torch.ones(7), r"queries has shape \(7,\)"),
        (torch.ones(2, 4, 5), [1.0, 2.0], "queries is list"),
    ],
)
def test_bad_arguments_are_named(features, queries, message):
    with pytest.raises((TypeError, ValueError), match=message):
        gather_neighbours(features, queries)
