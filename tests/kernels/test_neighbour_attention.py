import pytest
import torch
import torch.nn.functional as F

from kernels import attend_neighbours, gather_neighbours, neighbour_attention, project_pixels
from kernels.neighbour_attention import _neighbour_attention

# Of the largest element: sums of some tens of products in another order.
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-12}


CHANNELS, HEADS = 12, 3


def draw_step(device, dtype=torch.float64, count=60):
    """Features, queries and the parameters of a first attention step."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=dtype).to(device)

    features = normal(2, CHANNELS, 5, 7)
    queries = normal(2, count, 2) * 4 + 2
    position, norm = (normal(CHANNELS, 2), normal(CHANNELS)), (normal(CHANNELS), normal(CHANNELS))
    return features, queries, position, norm, normal(3 * CHANNELS, CHANNELS) * 0.3


def token_by_token(features, queries, position, norm, qkv_weight, wrap):
    """The step as the paper draws it: every neighbour of every query is embedded, normalised and projected."""
    z, offsets = gather_neighbours(features, queries, wrap, backend="torch")
    tokens = F.layer_norm(z + F.linear(offsets, *position), (CHANNELS,), *norm)
    return attend_neighbours(F.linear(tokens, qkv_weight), HEADS, backend="torch")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("wrap", [True, False])
@pytest.mark.parametrize("backend", ["warp", "torch"])
def test_projecting_pixels_equals_projecting_tokens_with_gradients(dtype, wrap, backend, device, poisoned):
    features, queries, position, norm, qkv_weight = draw_step(device, dtype)
    leaves = [features, *position, *norm, qkv_weight]
    results = []
    for hoisted in (True, False):
        z, w, b, gamma, beta, m = (leaf.clone().requires_grad_() for leaf in leaves)
        if hoisted:
            projected = project_pixels(z, (w, b), (gamma, beta), m)
            attended = neighbour_attention(projected, queries, HEADS, wrap, backend=backend)
        else:
            attended = token_by_token(z, queries, (w, b), (gamma, beta), m, wrap)
        results.append((attended, *torch.autograd.grad(attended.sin().sum(), (z, w, b, gamma, beta, m))))
    for ours, plain in zip(*results, strict=True):
        scale = plain.detach().abs().max()
        torch.testing.assert_close(ours / scale, plain / scale, rtol=0, atol=TOLERANCE[dtype])


def test_neighbour_attention_passes_gradcheck_and_opcheck(device):
    features, queries, position, norm, qkv_weight = draw_step(device, count=6)
    pixels, *rest = (t.detach().requires_grad_() for t in project_pixels(features, position, norm, qkv_weight))
    assert torch.autograd.gradcheck(
        lambda p, *r: _neighbour_attention(p, queries, *r, HEADS, 1e-5, True), (pixels, *rest), fast_mode=True
    )
    torch.library.opcheck(_neighbour_attention, (pixels, queries, *rest, HEADS, 1e-5, True))


def test_compiles_without_graph_breaks(device):
    def step(features, queries, position, norm, qkv_weight):
        return neighbour_attention(project_pixels(features, position, norm, qkv_weight), queries, HEADS)

    results = []
    for call in (step, torch.compile(step, fullgraph=True, backend="aot_eager")):
        features, *others = draw_step(device)
        attended = call(features.requires_grad_(), *others)
        attended.sin().sum().backward()
        results.append((attended.detach(), features.grad))
    for ours, compiled in zip(*results, strict=True):
        torch.testing.assert_close(ours, compiled)


def test_neighbour_attention_without_queries_and_deterministic(device):
    features, queries, position, norm, qkv_weight = draw_step(device, torch.float32, count=3000)
    projected = project_pixels(features.requires_grad_(), position, norm, qkv_weight)
    assert neighbour_attention(projected, queries[:, :0], HEADS).shape == (2, 0, 4, CHANNELS)
    attended = neighbour_attention(projected, queries, HEADS)
    first, second = (torch.autograd.grad(attended.sin().sum(), features, retain_graph=True)[0] for _ in range(2))
    assert torch.equal(first, second)


def test_bad_arguments_of_the_hoisted_step_are_named(device):
    features, queries, position, norm, qkv_weight = draw_step(device)
    with pytest.raises(ValueError, match=r"qkv_weight has shape \(12, 36\)"):
        project_pixels(features, position, norm, qkv_weight.T)
    with pytest.raises(ValueError, match="position has shapes"):
        project_pixels(features, norm, norm, qkv_weight)
    with pytest.raises(ValueError, match=r"features has shape \(12, 5, 7\)"):
        project_pixels(features[0], position, norm, qkv_weight)
    projected = project_pixels(features, position, norm, qkv_weight)
    with pytest.raises(ValueError, match="heads is 5"):
        neighbour_attention(projected, queries, 5)
    with pytest.raises(ValueError, match=r"queries has shape \(1, 60, 2\)"):
        neighbour_attention(projected, queries[:1], HEADS)
