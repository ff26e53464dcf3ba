import re

import pytest
import torch
import torch.nn.functional as F
from torch._subclasses.fake_tensor import FakeTensorMode

from kernels import attend_neighbours, gather_neighbours, neighbour_attention, project_pixels
from kernels.neighbour_attention.op import _neighbour_attention

# Of the largest element: sums of some tens of products in another order.
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-12}
# One rounding of the result, and of the gradients that come back.
HALF = 1e-2

# Channels and heads: the paper's, which CPUs do in vectors, and such as they do one head at a time.
SIZES = [(32, 8), (64, 8), (128, 8), (12, 3), (64, 4)]


def draw_step(device, dtype=torch.float64, channels=12, heads=3, count=60):
    """Features, queries and the parameters of an attention step."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=dtype).to(device)

    features = normal(2, channels, 5, 7)
    queries = normal(2, count, 2) * 4 + 2
    position, norm = (normal(channels, 2), normal(channels)), (normal(channels), normal(channels))
    qkv_weight, output = normal(3 * channels, channels), (normal(channels, channels), normal(channels))
    return features, queries, position, norm, qkv_weight * channels**-0.5, output, heads


def hoisted(features, queries, position, norm, qkv_weight, output, heads, wrap=True, backend="warp"):
    projected = project_pixels(features, position, norm, qkv_weight, heads)
    return neighbour_attention(projected, queries, output, wrap, backend=backend)


def token_by_token(features, queries, position, norm, qkv_weight, output, heads, wrap=True):
    """The step as the paper draws it: every neighbour of every query is embedded, normalised and projected."""
    z, offsets = gather_neighbours(features, queries, wrap, backend="torch")
    tokens = z + F.linear(offsets, *position)
    qkv = F.linear(F.layer_norm(tokens, tokens.shape[-1:], *norm), qkv_weight)
    return tokens + F.linear(attend_neighbours(qkv, heads, backend="torch"), *output)


def with_gradients(step, features, queries, position, norm, qkv_weight, output, heads, **options):
    """The result of a step and the gradients of all its tensors, each relative to its largest element."""
    leaves = [leaf.clone().requires_grad_() for leaf in (features, *position, *norm, qkv_weight, *output)]
    z, w, b, gamma, beta, m, o, o_bias = leaves
    tokens = step(z, queries, (w, b), (gamma, beta), m, (o, o_bias), heads, **options)
    weights = torch.rand(tokens.shape, generator=torch.Generator().manual_seed(1), dtype=z.dtype).to(z.device)
    return [tokens.detach(), *torch.autograd.grad((tokens.to(z.dtype) * weights).sum(), leaves)]


def assert_same(ours, plain, tolerance):
    for a, b in zip(ours, plain, strict=True):
        scale = b.abs().max()
        torch.testing.assert_close(a.to(b.dtype) / scale, b / scale, rtol=0, atol=tolerance)


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize(("channels", "heads"), SIZES)
@pytest.mark.parametrize("wrap", [True, False])
@pytest.mark.parametrize("backend", ["warp", "torch"])
def test_projecting_pixels_equals_projecting_tokens_with_gradients(
    dtype, channels, heads, wrap, backend, device, poisoned
):
    step = draw_step(device, dtype, channels, heads)
    ours = with_gradients(hoisted, *step, wrap=wrap, backend=backend)
    assert_same(ours, with_gradients(token_by_token, *step, wrap=wrap), TOLERANCE[dtype])


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize(("channels", "heads"), SIZES)
@pytest.mark.parametrize("backend", ["warp", "torch"])
def test_autocast_rounds_the_tokens_only(dtype, channels, heads, backend, device, poisoned):
    step = draw_step(device, torch.float32, channels, heads)
    with torch.autocast(device.type, dtype):
        ours = with_gradients(hoisted, *step, backend=backend)
    assert ours[0].dtype == dtype
    assert_same(ours, with_gradients(token_by_token, *step), HALF)


@pytest.mark.parametrize(("channels", "heads"), [(12, 3), (64, 8)])
def test_gradcheck_and_opcheck(channels, heads, device):
    features, queries, position, norm, qkv_weight, output, _ = draw_step(
        device, channels=channels, heads=heads, count=6
    )
    pixels, *rest = (
        t.detach().requires_grad_() for t in project_pixels(features, position, norm, qkv_weight, heads)[:4]
    )
    output = [tensor.requires_grad_() for tensor in output]
    options = heads, 1e-5, True
    assert torch.autograd.gradcheck(
        lambda p, *r: _neighbour_attention(p, queries, *r, *options, torch.float64),
        (pixels, *rest, *output),
        fast_mode=True,
    )
    tensors = [t.detach().float().requires_grad_(t.requires_grad) for t in (pixels, queries, *rest, *output)]
    torch.library.opcheck(_neighbour_attention, (*tensors, *options, torch.float32))


@pytest.mark.parametrize(("channels", "heads"), [(12, 3), (64, 8)])
def test_compiles_without_graph_breaks(channels, heads, device):
    step = draw_step(device, torch.float32, channels, heads)
    compiled = torch.compile(hoisted, fullgraph=True, backend="aot_eager")
    assert_same(with_gradients(compiled, *step), with_gradients(hoisted, *step), 1e-6)


@pytest.mark.parametrize(("channels", "heads"), [(12, 3), (64, 8)])
def test_no_queries_and_deterministic_on_any_number_of_cores(channels, heads, device):
    step = draw_step(device, torch.float32, channels, heads, count=3000)
    none = with_gradients(hoisted, step[0], step[1][:, :0], *step[2:])
    assert none[0].shape == (2, 0, 4, channels)
    assert not any(gradient.any() for gradient in none[1:])
    cores = torch.get_num_threads()
    results = []
    try:
        for number in (cores, cores, 1, 3):
            torch.set_num_threads(number)
            results.append(with_gradients(hoisted, *step))
    finally:
        torch.set_num_threads(cores)
    assert all(torch.equal(a, b) for a, b in zip(results[0], results[1], strict=True))
    for other in results[2:]:  # torch's matrix products depend on the number of cores, our sums do not
        assert_same(other, results[0], 1e-6)


def test_bad_arguments_are_named(device):
    features, queries, position, norm, qkv_weight, output, heads = draw_step(device)
    with pytest.raises(ValueError, match=r"qkv_weight has shape \(12, 36\)"):
        project_pixels(features, position, norm, qkv_weight.T, heads)
    with pytest.raises(ValueError, match="position has shapes"):
        project_pixels(features, norm, norm, qkv_weight, heads)
    with pytest.raises(ValueError, match=r"features has shape \(12, 5, 7\)"):
        project_pixels(features[0], position, norm, qkv_weight, heads)
    with pytest.raises(ValueError, match="heads is 5"):
        project_pixels(features, position, norm, qkv_weight, 5)
    projected = project_pixels(features, position, norm, qkv_weight, heads)
    with pytest.raises(ValueError, match=r"queries has shape \(1, 60, 2\)"):
        neighbour_attention(projected, queries[:1], output)
    with pytest.raises(ValueError, match=r"output has shapes \[\(12, 12\), \(12, 12\)\]"):
        neighbour_attention(projected, queries, (output[0], output[0]))


def test_a_tensor_on_another_device_is_named():
    features, queries, position, norm, qkv_weight, output, heads = draw_step("cpu")
    projecting = {"position[0]": position[0], "position[1]": position[1], "norm[0]": norm[0], "norm[1]": norm[1]}
    projecting |= {"qkv_weight": qkv_weight}
    for name, tensor in projecting.items():
        p, n, m = ([x.to("meta") if x is tensor else x for x in group] for group in (position, norm, [qkv_weight]))
        with pytest.raises(ValueError, match=rf"{re.escape(name)} is on meta; it should be on cpu, where features is"):
            project_pixels(features, p, n, m[0], heads)
    projected = project_pixels(features, position, norm, qkv_weight, heads)
    for name in ("slope", "shift", "gram"):
        moved = projected._replace(**{name: getattr(projected, name).to("meta")})
        with pytest.raises(ValueError, match=rf"projected.{name} is on meta; it should be on cpu"):
            neighbour_attention(moved, queries, output)
    with pytest.raises(ValueError, match=r"projected.slope is on cpu; it should be on meta"):
        neighbour_attention(projected._replace(pixels=projected.pixels.to("meta")), queries, output)
    with pytest.raises(ValueError, match="queries is on meta; it should be on cpu"):
        neighbour_attention(projected, queries.to("meta"), output)
    for i in range(2):
        moved = [tensor.to("meta") if j == i else tensor for j, tensor in enumerate(output)]
        with pytest.raises(ValueError, match=rf"output\[{i}\] is on meta; it should be on cpu"):
            neighbour_attention(projected, queries, moved)


@pytest.mark.parametrize(("channels", "heads"), [(12, 3), (64, 8)])
@pytest.mark.parametrize("autocast", [False, True])
def test_fake_tensors_have_the_shapes_dtypes_and_devices_of_real_ones(channels, heads, autocast, device):
    step = draw_step(device, torch.float32, channels, heads, count=9)

    def run(*step):
        with torch.autocast(device.type, torch.bfloat16, enabled=autocast):
            return with_gradients(hoisted, *step)

    real = run(*step)
    mode = FakeTensorMode()
    with mode:
        convert = mode.from_tensor
        features, queries, position, norm, qkv_weight, output, _ = step
        pairs = [[convert(t) for t in pair] for pair in (position, norm, output)]
        fake = run(convert(features), convert(queries), *pairs[:2], convert(qkv_weight), pairs[2], heads)
    for ours, expected in zip(fake, real, strict=True):
        assert (ours.shape, ours.dtype, ours.device) == (expected.shape, expected.dtype, expected.device)


@pytest.mark.parametrize(("channels", "heads"), [(12, 3), (64, 8)])
@pytest.mark.parametrize("features", ["drawn", "constant"])
@pytest.mark.parametrize("absurd", [1e9, 1e19, 1e30, float("inf")])
def test_absurd_queries_give_finite_results_and_gradients_equal_to_the_twins(
    channels, heads, features, absurd, device, poisoned
):
    z, queries, *rest = draw_step(device, torch.float32, channels, heads)
    if features == "constant":
        z = z[:, :1, :1, :1].expand_as(z)
    queries[:, ::5] = absurd
    queries[:, 1::5, 0] = -absurd
    queries[:, 2::5, 1] = absurd
    ours, plain = (with_gradients(hoisted, z, queries, *rest, backend=backend) for backend in ("warp", "torch"))
    assert all(tensor.isfinite().all() for tensor in ours)
    assert_same(ours, plain, 1e-4)


@pytest.mark.parametrize(("channels", "heads"), [(12, 3), (64, 8)])
def test_a_variance_that_rounds_below_0_counts_as_0(channels, heads, device, poisoned):
    z, queries, position, norm, qkv_weight, output, _ = draw_step(device, torch.float32, channels, heads)
    projected = project_pixels(z, position, norm, qkv_weight, heads)
    projected.pixels[..., 4 * channels] -= 1e6  # xᵀx, far below what it can be
    results = []
    for backend in ("warp", "torch"):
        leaves = [tensor.clone().requires_grad_() for tensor in (*projected[:4], *output)]
        tokens = neighbour_attention(type(projected)(*leaves[:4], heads), queries, leaves[4:], backend=backend)
        results.append([tokens.detach(), *torch.autograd.grad(tokens.square().sum(), leaves)])
    ours, plain = results
    assert all(tensor.isfinite().all() for tensor in ours)
    below = 4 * channels
    assert not ours[1][..., below : below + 3].any()  # where 0 stands for it, xᵀx and u have no gradient
    assert not ours[4].any()
    for a, b in zip(ours, plain, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-4 * b.abs().max().item())
