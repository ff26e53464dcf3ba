import pytest
import torch

from kernels import area_blend, gather_blend, gather_neighbours
from kernels.area_blend import _area_blend

# A sum of four products; half precision is rounded once by the kernel, float32 areas times half values by the twin.
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-12, torch.bfloat16: 2e-2, torch.float16: 2e-3}


def draw(device, dtype=torch.float32, batch=(2,), count=257):
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(*batch, count, 4, generator=generator).to(device, dtype)
    queries = torch.randn(*batch, count, 2, generator=generator) * 9
    queries[..., ::5, :] = queries[..., ::5, :].round()
    return values, queries.to(device)


@pytest.mark.parametrize("dtype", TOLERANCE)
def test_matches_the_reference_with_gradients(dtype, device, poisoned):
    values, queries = draw(device, dtype)
    values.requires_grad_()
    results = []
    for backend in ("warp", "torch"):
        blended = area_blend(values, queries, backend)
        assert blended.dtype == dtype
        (gradient,) = torch.autograd.grad((blended.float() * queries[..., 0].cos()).sum(), values)
        results.append((blended, gradient))
    for ours, reference in zip(*results, strict=True):
        torch.testing.assert_close(ours, reference, rtol=TOLERANCE[dtype], atol=TOLERANCE[dtype])


def test_gradcheck_and_opcheck(device):
    values, queries = draw(device, torch.float64, count=7)
    assert torch.autograd.gradcheck(lambda v: area_blend(v, queries), values.requires_grad_())
    torch.library.opcheck(_area_blend, (values[0].detach().requires_grad_(), queries[0].double()))


@pytest.mark.parametrize("wrap", [True, False])
def test_of_the_neighbours_own_ranges_is_bilinear(wrap, device):
    generator = torch.Generator().manual_seed(0)
    image = (torch.rand(6, 9, generator=generator) * 80).to(device)
    queries = (torch.rand(300, 2, generator=generator) * torch.tensor([5.0, 9.0])).to(device)
    ranges, _ = gather_neighbours(image.unsqueeze(0), queries, wrap)
    bilinear = gather_blend(image, queries, queries.new_zeros(300, 4), "bilinear", wrap)
    torch.testing.assert_close(area_blend(ranges.squeeze(-1), queries), bilinear)


def test_compiles_without_graph_breaks(device):
    results = []
    for call in (area_blend, torch.compile(area_blend, fullgraph=True, backend="aot_eager")):
        values, queries = draw(device)
        blended = call(values.requires_grad_(), queries)
        blended.sin().sum().backward()
        results.append((blended.detach(), values.grad))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_constants_pass_and_a_pixel_centre_takes_its_own_value(device):
    values, queries = draw(device)
    torch.testing.assert_close(area_blend(torch.full_like(values, 2.5), queries), torch.full((2, 257), 2.5).to(device))
    assert torch.equal(area_blend(values[:, ::5], queries[:, ::5]), values[:, ::5, 0])


def test_broadcast_strides_and_no_queries(device):
    values, queries = draw(device)
    torch.testing.assert_close(area_blend(values, queries[0])[1], area_blend(values[1], queries[0]))
    assert torch.equal(area_blend(torch.stack([values] * 2, -1)[..., 0], queries), area_blend(values, queries))
    assert area_blend(values[:, :0], queries[:, :0]).shape == (2, 0)


@pytest.mark.parametrize(
    ("values", "queries", "message"),
    [
        (torch.ones(7, 3), torch.ones(7, 2), r"values has shape \(7, 3\); it should be \(\.\.\., 7, 4\)"),
        (torch.ones(6, 4), torch.ones(7, 2), r"values has shape \(6, 4\)"),
        (torch.ones(7, 4).int(), torch.ones(7, 2), "values is torch.int32"),
        (torch.ones(7, 4), torch.ones(7, 3), r"queries has shape \(7, 3\)"),
        (torch.ones(2, 7, 4), torch.ones(3, 7, 2), "do not broadcast"),
    ],
)
def test_bad_arguments_are_named(values, queries, message):
    with pytest.raises((TypeError, ValueError), match=message):
        area_blend(values, queries)
