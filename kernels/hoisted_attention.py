"""neighbour_attention: the whole first attention step, with its projections hoisted from the queries to the pixels.

Gather the features z, embed the offset q as z + Wq + b, normalise, project to queries, keys and values, attend.
LayerNorm's mean and variance are polynomials in q whose coefficients belong to the pixel. With Γ = diag(γ) and ᶜ for
what is left after subtracting the mean over the C channels:

    z + Wq + b - mean = x + Wᶜ q,    x = (z + b)ᶜ
    σ² = (xᵀx + 2 qᵀu + qᵀ N q) / C + ε,    u = Wᶜᵀ x,    N = Wᶜᵀ Wᶜ
    qkv = (A + B q) / σ + c,    A = M Γ x,    B = M Γ Wᶜ,    c = M β

so the projection M is applied once per *pixel* (A) and not once per neighbour of each query, of which a frame of
128×2048 from 16×1024 has 64 times as many. It is the same function, rounded differently.
"""

from typing import Any, NamedTuple

import torch
import warp as wp

from kernels import reference
from kernels.attention import adj_logits, softmax_rows
from kernels.launch import check_backend, check_floating, launch, overload
from kernels.neighbours import adjoint_of_gather, check_queries, neighbour, offset

__all__ = ["Projected", "neighbour_attention", "project_pixels"]


@wp.func
def _stencil(queries: wp.array3d[Any], b: int, n: int, height: int, width: int, eps: Any, wrap: int):
    """Rows and columns of the 4 neighbours, and the offsets from them."""
    row = queries[b, n, 0]
    column = queries[b, n, 1]
    rows = wp.vec4i()
    columns = wp.vec4i()
    down = wp.vector(dtype=type(eps), length=4)
    right = wp.vector(dtype=type(eps), length=4)
    for t in range(4):
        i, j = neighbour(row, column, t, height, width, wrap)
        rows[t] = i
        columns[t] = j
        dr, dc = offset(row, column, t, height, width, wrap)
        down[t] = dr
        right[t] = dc
    return rows, columns, down, right


@wp.func
def _four_tokens(
    pixels: wp.array4d[Any],
    b: int,
    rows: wp.vec4i,
    columns: wp.vec4i,
    down: Any,
    right: Any,
    channel: int,
    slope: wp.array2d[Any],
):
    """A + B q of one channel, for each neighbour."""
    values = down * slope[channel, 0] + right * slope[channel, 1]
    for t in range(4):
        values[t] = values[t] + pixels[b, rows[t], columns[t], channel]
    return values


@wp.func
def _add(values: Any, constant: Any):
    for t in range(4):
        values[t] = values[t] + constant
    return values


@wp.func
def _inverse_deviations(
    pixels: wp.array4d[Any],
    b: int,
    rows: wp.vec4i,
    columns: wp.vec4i,
    down: Any,
    right: Any,
    gram: wp.array2d[Any],
    eps: Any,
):
    """1 / σ for each neighbour; the pixel's last three channels are xᵀx and u."""
    channels = (pixels.shape[3] - 3) // 3
    inverse = down
    for t in range(4):
        squares = pixels[b, rows[t], columns[t], 3 * channels]
        cross = down[t] * pixels[b, rows[t], columns[t], 3 * channels + 1]
        cross = cross + right[t] * pixels[b, rows[t], columns[t], 3 * channels + 2]
        squares = squares + cross + cross
        squares = squares + down[t] * (gram[0, 0] * down[t] + (gram[0, 1] + gram[1, 0]) * right[t])
        squares = squares + right[t] * right[t] * gram[1, 1]
        inverse[t] = type(eps)(1.0) / wp.sqrt(squares / type(eps)(channels) + eps)
    return inverse


@wp.kernel(enable_backward=False)
def _attend_hoisted_kernel(
    first: int,
    # in
    pixels: wp.array4d[Any],
    queries: wp.array3d[Any],
    slope: wp.array2d[Any],
    shift: wp.array[Any],
    gram: wp.array2d[Any],
    heads: int,
    eps: Any,
    wrap: int,
    # out
    attended_out: wp.array4d[Any],
):
    thread = first + wp.tid()
    h = thread % heads
    n = (thread // heads) % queries.shape[1]
    b = thread // heads // queries.shape[1]
    channels = attended_out.shape[3]
    width = channels // heads
    scale = type(eps)(1.0) / wp.sqrt(type(eps)(width))
    rows, columns, down, right = _stencil(queries, b, n, pixels.shape[1], pixels.shape[2], eps, wrap)
    inverse = _inverse_deviations(pixels, b, rows, columns, down, right, gram, eps)
    logits = wp.matrix(shape=(4, 4), dtype=type(eps))
    for d in range(width):
        c = h * width + d
        q = _four_tokens(pixels, b, rows, columns, down, right, c, slope)
        k = _four_tokens(pixels, b, rows, columns, down, right, channels + c, slope)
        q = _add(wp.cw_mul(q, inverse), shift[c])
        k = _add(wp.cw_mul(k, inverse), shift[channels + c])
        logits = logits + wp.outer(q * scale, k)
    p = softmax_rows(logits)
    for d in range(width):
        c = h * width + d
        v = _four_tokens(pixels, b, rows, columns, down, right, 2 * channels + c, slope)
        attended = p * _add(wp.cw_mul(v, inverse), shift[2 * channels + c])
        for t in range(4):
            attended_out[b, n, t, c] = attended[t]


@wp.kernel(enable_backward=False)
def _attend_hoisted_backward_kernel(
    first: int,
    # in
    pixels: wp.array4d[Any],
    queries: wp.array3d[Any],
    slope: wp.array2d[Any],
    shift: wp.array[Any],
    gram: wp.array2d[Any],
    adj_attended: wp.array4d[Any],
    heads: int,
    eps: Any,
    wrap: int,
    # out
    adj_tokens_out: wp.array4d[Any],
    adj_inverse_out: wp.array4d[Any],
    tokens_out: wp.array4d[Any],
):
    thread = first + wp.tid()
    h = thread % heads
    n = (thread // heads) % queries.shape[1]
    b = thread // heads // queries.shape[1]
    channels = adj_attended.shape[3]
    width = channels // heads
    scale = type(eps)(1.0) / wp.sqrt(type(eps)(width))
    rows, columns, down, right = _stencil(queries, b, n, pixels.shape[1], pixels.shape[2], eps, wrap)
    inverse = _inverse_deviations(pixels, b, rows, columns, down, right, gram, eps)
    logits = wp.matrix(shape=(4, 4), dtype=type(eps))
    adj_p = wp.matrix(shape=(4, 4), dtype=type(eps))
    for d in range(width):
        c = h * width + d
        q = _four_tokens(pixels, b, rows, columns, down, right, c, slope)
        k = _four_tokens(pixels, b, rows, columns, down, right, channels + c, slope)
        v = _four_tokens(pixels, b, rows, columns, down, right, 2 * channels + c, slope)
        q = _add(wp.cw_mul(q, inverse), shift[c])
        k = _add(wp.cw_mul(k, inverse), shift[channels + c])
        v = _add(wp.cw_mul(v, inverse), shift[2 * channels + c])
        logits = logits + wp.outer(q * scale, k)
        g = wp.vector(dtype=type(eps), length=4)
        for t in range(4):
            g[t] = adj_attended[b, n, t, c]
        adj_p = adj_p + wp.outer(g, v)
    p = softmax_rows(logits)
    s = adj_logits(p, adj_p) * scale
    adj_inverse = wp.vector(dtype=type(eps), length=4)
    for d in range(width):
        c = h * width + d
        q_raw = _four_tokens(pixels, b, rows, columns, down, right, c, slope)
        k_raw = _four_tokens(pixels, b, rows, columns, down, right, channels + c, slope)
        v_raw = _four_tokens(pixels, b, rows, columns, down, right, 2 * channels + c, slope)
        g = wp.vector(dtype=type(eps), length=4)
        for t in range(4):
            g[t] = adj_attended[b, n, t, c]
        adj_q = s * _add(wp.cw_mul(k_raw, inverse), shift[channels + c])
        adj_k = wp.transpose(s) * _add(wp.cw_mul(q_raw, inverse), shift[c])
        adj_v = wp.transpose(p) * g
        adj_inverse = adj_inverse + wp.cw_mul(adj_q, q_raw) + wp.cw_mul(adj_k, k_raw) + wp.cw_mul(adj_v, v_raw)
        for t in range(4):
            adj_tokens_out[b, n, t, c] = adj_q[t] * inverse[t]
            adj_tokens_out[b, n, t, channels + c] = adj_k[t] * inverse[t]
            adj_tokens_out[b, n, t, 2 * channels + c] = adj_v[t] * inverse[t]
    for t in range(4):
        adj_inverse_out[b, n, t, h] = adj_inverse[t]
        if h == 0:
            tokens_out[b, n, t, 0] = down[t]
            tokens_out[b, n, t, 1] = right[t]
            tokens_out[b, n, t, 2] = inverse[t]


_attend = overload(_attend_hoisted_kernel)
_attend_backward = overload(_attend_hoisted_backward_kernel)


@torch.library.custom_op("kernels::neighbour_attention", mutates_args=())
def _neighbour_attention(
    pixels: torch.Tensor,
    queries: torch.Tensor,
    slope: torch.Tensor,
    shift: torch.Tensor,
    gram: torch.Tensor,
    heads: int,
    eps: float,
    wrap: bool,
) -> torch.Tensor:
    batch, count, _ = queries.shape
    attended = pixels.new_empty(batch, count, 4, len(shift) // 3)
    inputs = [pixels, queries, slope, shift, gram, heads, eps, int(wrap)]
    launch(_attend[pixels.dtype], batch * count * heads, inputs, [attended])
    return attended


@_neighbour_attention.register_fake
def _(
    pixels: torch.Tensor,
    queries: torch.Tensor,
    slope: torch.Tensor,
    shift: torch.Tensor,
    gram: torch.Tensor,
    heads: int,
    eps: float,
    wrap: bool,
) -> torch.Tensor:
    return pixels.new_empty(queries.shape[0], queries.shape[1], 4, shift.shape[0] // 3)


@torch.library.custom_op("kernels::neighbour_attention_backward", mutates_args=())
def _neighbour_attention_backward(
    pixels: torch.Tensor,
    queries: torch.Tensor,
    slope: torch.Tensor,
    shift: torch.Tensor,
    gram: torch.Tensor,
    adj_attended: torch.Tensor,
    heads: int,
    eps: float,
    wrap: bool,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    batch, count, _ = queries.shape
    channels = len(shift) // 3
    adj_tokens = pixels.new_empty(batch, count, 4, 3 * channels + 3)
    adj_inverse = pixels.new_empty(batch, count, 4, heads)
    tokens = pixels.new_empty(batch, count, 4, 3)
    inputs = [pixels, queries, slope, shift, gram, adj_attended, heads, eps, int(wrap)]
    launch(_attend_backward[pixels.dtype], batch * count * heads, inputs, [adj_tokens, adj_inverse, tokens])
    offsets, inverse = tokens[..., :2], tokens[..., 2:]
    # σ⁻¹ = (σ²)^-1/2, and σ² is linear in xᵀx, u and N.
    adj_squares = adj_inverse.sum(-1, keepdim=True) * inverse**3 * (-0.5 / channels)
    adj_tokens[..., 3 * channels :] = torch.cat((adj_squares, 2 * offsets * adj_squares), -1)
    adj_projected = adj_tokens[..., : 3 * channels].reshape(-1, 3 * channels)
    adj_affine = adj_projected.T @ torch.cat((offsets, 1 / inverse), -1).view(-1, 3)
    flat = offsets.reshape(-1, 2)
    adj_gram = flat.T @ (flat * adj_squares.view(-1, 1))
    adj_pixels = adjoint_of_gather(adj_tokens, queries, pixels.shape[1], pixels.shape[2], wrap)
    return adj_pixels, adj_affine[:, :2].contiguous(), adj_affine[:, 2].contiguous(), adj_gram


@_neighbour_attention_backward.register_fake
def _(
    pixels: torch.Tensor,
    queries: torch.Tensor,
    slope: torch.Tensor,
    shift: torch.Tensor,
    gram: torch.Tensor,
    adj_attended: torch.Tensor,
    heads: int,
    eps: float,
    wrap: bool,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    return (
        pixels.new_empty(pixels.shape),
        slope.new_empty(slope.shape),
        shift.new_empty(shift.shape),
        gram.new_empty(gram.shape),
    )


def _setup_context(ctx: Any, inputs: tuple, output: torch.Tensor) -> None:
    *tensors, ctx.heads, ctx.eps, ctx.wrap = inputs
    ctx.save_for_backward(*tensors)


def _backward(ctx: Any, adj_attended: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
    pixels, queries, slope, shift, gram = ctx.saved_tensors
    adj_pixels, adj_slope, adj_shift, adj_gram = _neighbour_attention_backward(
        pixels, queries, slope, shift, gram, adj_attended, ctx.heads, ctx.eps, ctx.wrap
    )
    return adj_pixels, None, adj_slope, adj_shift, adj_gram, None, None, None


_neighbour_attention.register_autograd(_backward, setup_context=_setup_context)


class Projected(NamedTuple):
    """Features projected once per pixel, for `neighbour_attention`."""

    pixels: torch.Tensor
    """(B, H, W, 3·C + 3): A, xᵀx and u."""
    slope: torch.Tensor
    """(3·C, 2): B."""
    shift: torch.Tensor
    """(3·C,): c."""
    gram: torch.Tensor
    """(2, 2): N."""


def project_pixels(
    features: torch.Tensor,
    position: tuple[torch.Tensor, torch.Tensor],
    norm: tuple[torch.Tensor, torch.Tensor],
    qkv_weight: torch.Tensor,
) -> Projected:
    """Projects features to queries, keys and values before they are gathered, normalised and given an offset.

    Plain PyTorch, differentiable in all arguments.

    Args:
        features: (B, C, H, W) floating-point, z of each pixel; computed in float32 at least.
        position: Weight W (C, 2) and bias b (C,) of the embedding of offsets in pixels.
        norm: Weight γ (C,) and bias β (C,) of the layer norm.
        qkv_weight: M (3·C, C), as in a `Linear(C, 3·C, bias=False)`.

    Raises:
        ValueError: If a shape does not fit.
    """
    if features.ndim != 4:
        raise ValueError(f"features has shape {tuple(features.shape)}; it should be (B, C, H, W)")
    channels = features.shape[1]
    expected = {"position": [(channels, 2), (channels,)], "norm": [(channels,), (channels,)]}
    for name, pair in (("position", position), ("norm", norm)):
        if (shapes := [tuple(tensor.shape) for tensor in pair]) != expected[name]:
            raise ValueError(f"{name} has shapes {shapes}; they should be {expected[name]}")
    if qkv_weight.shape != (3 * channels, channels):
        raise ValueError(f"qkv_weight has shape {tuple(qkv_weight.shape)}; it should be {(3 * channels, channels)}")
    with torch.autocast(features.device.type, enabled=False):  # a variance wants more digits than bfloat16 has
        x = features.to(position[0].dtype).movedim(1, 3) + position[1]
        x = x - x.mean(-1, keepdim=True)
        centred = position[0] - position[0].mean(0)
        projection = qkv_weight * norm[0]
        pixels = torch.cat((x @ projection.T, (x * x).sum(-1, keepdim=True), x @ centred), -1)
        return Projected(pixels, projection @ centred, qkv_weight @ norm[1], centred.T @ centred)


def neighbour_attention(
    projected: Projected,
    queries: torch.Tensor,
    heads: int,
    wrap: bool = True,
    *,
    eps: float = 1e-5,
    backend: str = "warp",
) -> torch.Tensor:
    """Gathers, embeds, normalises and attends: the first attention step of each query, projected once per pixel.

    Equal to `attend_neighbours(linear(layer_norm(z + Wq + b), M), heads)` with z and q from `gather_neighbours`.
    Differentiable in `projected`; the backward pass is deterministic.

    Args:
        projected: `project_pixels` of the features, float32 or float64.
        queries: (B, Q, 2) pixel coordinates (row, column).
        heads: Number of heads; it divides C.
        wrap: Whether column W-1 meets column 0 (a full circle). Otherwise columns clamp; rows always clamp.
        eps: Of the layer norm.
        backend: "warp", or "torch" for the plain twin in `kernels.reference`.

    Returns:
        (B, Q, 4, C), the heads' results side by side, before the output projection and the residual.

    Raises:
        TypeError: If `projected` or `queries` is not of a supported floating-point dtype.
        ValueError: If a shape, device, `heads` or backend does not fit.

    Source: paper Sec. II-B, "Feature transformation using self-attention"; the hoisting is ours.
    """
    check_backend(backend)
    pixels = projected.pixels
    check_floating("projected.pixels", pixels, _attend, "(B, H, W, 3·C + 3)")
    check_queries(queries, pixels, "projected")
    if queries.ndim != 3 or len(queries) != len(pixels):
        raise ValueError(f"queries has shape {tuple(queries.shape)}; it should be ({len(pixels)}, Q, 2)")
    channels = len(projected.shift) // 3
    if heads < 1 or channels % heads:
        raise ValueError(f"heads is {heads}; it should divide the {channels} channels")
    queries = queries.detach().to(pixels.dtype).contiguous()
    if backend == "torch":
        return reference.neighbour_attention(*projected, queries, heads, eps, wrap)
    return _neighbour_attention(pixels, queries, *projected[1:], heads, eps, wrap)
