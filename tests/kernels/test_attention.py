import pytest
import torch

from kernels import attend_neighbours
from kernels.attention import _attend_neighbours

# Half precision is rounded once on the way out by the kernel, several times on the way by plain PyTorch.
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-12, torch.bfloat16: 6e-2, torch.float16: 8e-3}


def draw(device, dtype=torch.float32, batch=(3, 50), heads=2, width=5):
    generator = torch.Generator().manual_seed(0)
    return torch.randn(*batch, 4, 3 * heads * width, generator=generator).to(device, dtype)


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize(("heads", "width"), [(8, 8), (1, 1), (3, 5)])
def test_matches_the_reference_with_gradients(dtype, heads, width, device, poisoned):
    qkv = draw(device, dtype, heads=heads, width=width).requires_grad_()
    results = []
    for backend in ("warp", "torch"):
        attended = attend_neighbours(qkv, heads, backend)
        (gradient,) = torch.autograd.grad((attended.float() * qkv[..., : heads * width].detach().float()).sum(), qkv)
        results.append((attended, gradient))
    for ours, reference in zip(*results, strict=True):
        torch.testing.assert_close(ours, reference, rtol=TOLERANCE[dtype], atol=TOLERANCE[dtype])


def test_matches_torchs_own_attention(device):
    qkv = draw(device, heads=8, width=8)
    q, k, v = qkv.unflatten(-1, (3, 8, 8)).transpose(-2, -4).unbind(-3)
    expected = torch.nn.functional.scaled_dot_product_attention(q, k, v).transpose(-2, -3).flatten(-2)
    torch.testing.assert_close(attend_neighbours(qkv, 8), expected, rtol=1e-5, atol=1e-6)


def test_gradcheck(device):
    qkv = draw(device, torch.float64, batch=(3,), heads=2, width=3).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: attend_neighbours(x, 2), qkv)


def test_opcheck(device):
    torch.library.opcheck(_attend_neighbours, (draw(device, batch=(6,)).view(6, 12, 2, 5).requires_grad_(),))


def test_compiles_without_graph_breaks(device):
    results = []
    for call in (attend_neighbours, torch.compile(attend_neighbours, fullgraph=True, backend="aot_eager")):
        qkv = draw(device).requires_grad_()
        attended = call(qkv, 2)
        attended.sin().sum().backward()
        results.append((attended.detach(), qkv.grad))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_equal_values_pass_through_and_huge_logits_choose(device):
    qkv = draw(device, batch=(7,), heads=2, width=5)
    qkv[..., 20:] = 3.5
    torch.testing.assert_close(attend_neighbours(qkv, 2), torch.full((7, 4, 10), 3.5, device=device))
    qkv[..., :20] *= 1e4
    assert attend_neighbours(qkv, 2).isfinite().all()


def test_no_queries_and_strided_input(device):
    assert attend_neighbours(draw(device)[:, :0], 2).shape == (3, 0, 4, 10)
    qkv = draw(device)
    strided = torch.stack([qkv, qkv], -1)[..., 0]
    assert torch.equal(attend_neighbours(strided, 2), attend_neighbours(qkv, 2))


@pytest.mark.parametrize(
    ("qkv", "heads", "message"),
    [
        (torch.ones(7, 3, 6), 1, r"qkv has shape \(7, 3, 6\)"),
        (torch.ones(7, 4, 6), 4, "multiple of the 4 heads"),
        (torch.ones(7, 4, 6), 0, "heads is 0; it should be at least 1"),
        (torch.ones(7, 4, 6).long(), 1, "qkv is torch.int64"),
    ],
)
def test_bad_arguments_are_named(qkv, heads, message):
    with pytest.raises((TypeError, ValueError), match=message):
        attend_neighbours(qkv, heads)
