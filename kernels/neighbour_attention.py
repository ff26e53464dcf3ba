"""neighbour_attention: a whole pre-norm attention step among the 4 neighbours (paper, Fig. 3b).

The maths stand in `kernels.hoisted`. On a CPU `kernels.fused_attention` does the whole step; the kernels here, one head
of one query in a thread, serve GPUs, float64, and numbers of channels that vectors do not fit, and leave the output
projection to torch. Nothing is kept for the backward pass but the inputs.
"""

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
import warp as wp

from kernels import fused_attention, reference
from kernels.hoisted import MOMENTS, adj_squares, attend, attend_backward, stencil
from kernels.lanes import vectors
from kernels.launch import check_backend, check_floating, launch
from kernels.neighbours import adjoint_of_gather, check_queries
from kernels.vmap import refuse

__all__ = ["Projected", "neighbour_attention", "project_pixels"]


@wp.kernel(enable_backward=False)
def _attend_kernel(
    first: int,
    # in
    pixels: wp.array2d[Any],
    moments: wp.array2d[wp.Float],
    queries: wp.array2d[wp.Float],
    slope: wp.array2d[Any],
    shift: wp.array[Any],
    gram: wp.array2d[wp.Float],
    height: int,
    width: int,
    per_image: int,
    heads: int,
    four: int,
    eps: wp.Float,
    wrap: int,
    # out
    tokens_out: wp.array2d[Any],
    attended_out: wp.array2d[Any],
):
    thread = first + wp.tid()
    n = thread // heads
    g = thread % heads
    channels = shift.shape[0] // 3
    pixel, down, right, inverse = stencil(moments, queries, n, n // per_image, height, width, gram, channels, eps, wrap)
    attend(
        pixels, slope, shift, pixel, down, right, inverse, heads, heads, g, four, 4 * n, tokens_out, attended_out
    )  # fmt: skip


@wp.kernel(enable_backward=False)
def _attend_backward_kernel(
    first: int,
    # in
    pixels: wp.array2d[Any],
    moments: wp.array2d[wp.Float],
    queries: wp.array2d[wp.Float],
    slope: wp.array2d[Any],
    shift: wp.array[Any],
    gram: wp.array2d[wp.Float],
    height: int,
    width: int,
    per_image: int,
    heads: int,
    four: int,
    eps: wp.Float,
    wrap: int,
    adj_tokens: wp.array2d[Any],
    adj_attended: wp.array2d[Any],
    # out
    adj_pixels_out: wp.array2d[Any],
    attended_out: wp.array2d[Any],
    adj_squares_out: wp.array2d[wp.Float],
    coefficients_out: wp.array2d[wp.Float],
):
    thread = first + wp.tid()
    n = thread // heads
    g = thread % heads
    channels = shift.shape[0] // 3
    pixel, down, right, inverse = stencil(moments, queries, n, n // per_image, height, width, gram, channels, eps, wrap)
    adj_inverse = attend_backward(
        pixels, slope, shift, pixel, down, right, inverse, heads, heads, g, four,
        adj_tokens, adj_attended, 4 * n, adj_pixels_out, attended_out,
    )  # fmt: skip
    for t in range(four):
        adj_squares_out[4 * n + t, g] = adj_squares(adj_inverse[t], inverse[t], channels)
        if g == 0:
            coefficients_out[4 * n + t, 0] = down[t]
            coefficients_out[4 * n + t, 1] = right[t]
            coefficients_out[4 * n + t, 2] = type(eps)(1.0) / inverse[t]


def _concrete(kernel: wp.Kernel, scalar: type) -> wp.Kernel:
    known = {Any: vectors(1, scalar), wp.Float: scalar}
    types = []
    for argument in kernel.adj.args:
        dtype = getattr(argument.type, "dtype", None)
        generic = wp.array(dtype=known[dtype], ndim=argument.type.ndim) if dtype in known else argument.type
        types.append(known.get(generic, generic))
    return wp.overload(kernel, types)


_SCALARS = {torch.float32: wp.float32, torch.float64: wp.float64}
_attend = {dtype: _concrete(_attend_kernel, scalar) for dtype, scalar in _SCALARS.items()}
_attend_backward = {dtype: _concrete(_attend_backward_kernel, scalar) for dtype, scalar in _SCALARS.items()}


@torch.library.custom_op("kernels::neighbour_attention", mutates_args=())
def _neighbour_attention(
    pixels: torch.Tensor,
    queries: torch.Tensor,
    slope: torch.Tensor,
    shift: torch.Tensor,
    gram: torch.Tensor,
    weight: torch.Tensor,
    bias: torch.Tensor,
    heads: int,
    eps: float,
    wrap: bool,
    dtype: torch.dtype,
) -> torch.Tensor:
    channels = len(bias)
    if fused_attention.fits(pixels, dtype, channels, heads):
        return fused_attention.step(pixels, queries, slope, shift, gram, weight, bias, heads, eps, wrap, dtype)
    batch, count, _ = queries.shape
    tokens = pixels.new_empty(batch * count * 4, channels)
    attended = torch.empty_like(tokens)
    inputs = fused_attention.arguments(pixels, queries, slope, shift, gram, heads, eps, wrap)
    launch(_attend[pixels.dtype], batch * count * heads, inputs, [tokens, attended])
    with torch.autocast(pixels.device.type, enabled=False):
        step = tokens.add_(bias).to(dtype).addmm_(attended.to(dtype), weight.to(dtype).T)
    return step.view(batch, count, 4, channels)


@_neighbour_attention.register_fake
def _(
    pixels: torch.Tensor,
    queries: torch.Tensor,
    slope: torch.Tensor,
    shift: torch.Tensor,
    gram: torch.Tensor,
    weight: torch.Tensor,
    bias: torch.Tensor,
    heads: int,
    eps: float,
    wrap: bool,
    dtype: torch.dtype,
) -> torch.Tensor:
    return pixels.new_empty(queries.shape[0], queries.shape[1], 4, bias.shape[0], dtype=dtype)


@torch.library.custom_op("kernels::neighbour_attention_backward", mutates_args=())
def _neighbour_attention_backward(
    pixels: torch.Tensor,
    queries: torch.Tensor,
    slope: torch.Tensor,
    shift: torch.Tensor,
    gram: torch.Tensor,
    weight: torch.Tensor,
    adj_step: torch.Tensor,
    heads: int,
    eps: float,
    wrap: bool,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    batch, height, width, columns = pixels.shape
    count, channels = queries.shape[1], len(weight)
    if fused_attention.fits(pixels, adj_step.dtype, channels, heads):
        return fused_attention.step_backward(pixels, queries, slope, shift, gram, weight, adj_step, heads, eps, wrap)  # type: ignore[return-value]
    with torch.autocast(pixels.device.type, enabled=False):
        adj_tokens = adj_step.reshape(-1, channels).to(pixels.dtype).contiguous()
        adj_attended = adj_tokens @ weight
        adj_rows = pixels.new_zeros(len(adj_tokens), columns)
        attended = torch.empty_like(adj_tokens)
        adj_squares = pixels.new_empty(len(adj_tokens), heads)
        coefficients = pixels.new_empty(len(adj_tokens), 3)
        launch(
            _attend_backward[pixels.dtype],
            batch * count * heads,
            [
                *fused_attention.arguments(pixels, queries, slope, shift, gram, heads, eps, wrap),
                adj_tokens,
                adj_attended,
            ],
            [adj_rows, attended, adj_squares, coefficients],
        )
        adj_squares, offsets = adj_squares.sum(1, keepdim=True), coefficients[:, :2]
        adj_rows[:, 4 * channels : 4 * channels + 3] = torch.cat((adj_squares, 2 * offsets * adj_squares), 1)
        adj_affine = coefficients.T @ adj_rows[:, : 4 * channels]
        return (
            adjoint_of_gather(adj_rows.view(batch, count, 4, columns), queries, height, width, wrap),
            adj_affine[:2].clone(),
            adj_affine[2, : 3 * channels].clone(),
            offsets.T @ (offsets * adj_squares),
            adj_tokens.T @ attended,
            adj_tokens.sum(0),
        )


@_neighbour_attention_backward.register_fake
def _(
    pixels: torch.Tensor,
    queries: torch.Tensor,
    slope: torch.Tensor,
    shift: torch.Tensor,
    gram: torch.Tensor,
    weight: torch.Tensor,
    adj_step: torch.Tensor,
    heads: int,
    eps: float,
    wrap: bool,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    of_inputs = [t.new_empty(t.shape) for t in (pixels, slope, shift, gram, weight)]
    return *of_inputs, weight.new_empty(weight.shape[0])  # type: ignore[return-value]


def _setup_context(ctx: Any, inputs: tuple, output: torch.Tensor) -> None:
    *tensors, _, ctx.heads, ctx.eps, ctx.wrap, _ = inputs
    ctx.save_for_backward(*tensors)


def _backward(ctx: Any, adj_step: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
    adj_pixels, *others = _neighbour_attention_backward(*ctx.saved_tensors, adj_step, ctx.heads, ctx.eps, ctx.wrap)
    return adj_pixels, None, *others, None, None, None, None


_neighbour_attention.register_autograd(_backward, setup_context=_setup_context)
refuse(_neighbour_attention, "its features and queries have a batch dimension for that")
refuse(_neighbour_attention_backward, "ask for one gradient at a time")


class Projected(NamedTuple):
    """Features projected once per pixel, for `neighbour_attention`. Channels of q, k and v are stored [d][head]."""

    pixels: torch.Tensor
    """(B, H, W, 4·C + 16): A (queries, keys, values), z + b, xᵀx, u, and padding."""
    slope: torch.Tensor
    """(2, 4·C): B and W, transposed."""
    shift: torch.Tensor
    """(3·C,): c."""
    gram: torch.Tensor
    """(2, 2): N."""
    heads: int
    """Number of heads."""


def head_last(channels: int, heads: int, device: torch.device) -> torch.Tensor:
    """(C,) where the channel stored at each place, [d][head], stands among channels stored head after head."""
    return torch.arange(channels, device=device).view(heads, -1).T.reshape(-1)


def project_pixels(
    features: torch.Tensor,
    position: tuple[torch.Tensor, torch.Tensor],
    norm: tuple[torch.Tensor, torch.Tensor],
    qkv_weight: torch.Tensor,
    heads: int,
) -> Projected:
    """Projects features to queries, keys and values before they are gathered, normalised and given an offset.

    Plain PyTorch, differentiable in all tensors.

    Args:
        features: (B, C, H, W) floating-point, z of each pixel; computed in float32 at least.
        position: Weight W (C, 2) and bias b (C,) of the embedding of offsets in pixels.
        norm: Weight γ (C,) and bias β (C,) of the layer norm.
        qkv_weight: M (3·C, C), as in a `Linear(C, 3·C, bias=False)`.
        heads: Number of heads; it divides C.

    Raises:
        ValueError: If a shape or `heads` does not fit.
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
    if heads < 1 or channels % heads:
        raise ValueError(f"heads is {heads}; it should divide the {channels} channels")
    with torch.autocast(features.device.type, enabled=False):  # a variance wants more digits than bfloat16 has
        z = features.to(position[0].dtype).movedim(1, 3) + position[1]
        mean = z.mean(-1, keepdim=True)
        x = z - mean
        centred = position[0] - position[0].mean(0)
        qkv_weight = qkv_weight.unflatten(0, (3, channels))[:, head_last(channels, heads, z.device)].flatten(0, 1)
        projection = qkv_weight * norm[0]
        # One matrix makes the row of a pixel from (x, mean, xᵀx).
        of_x = torch.cat(
            (projection.T, torch.eye(channels, dtype=x.dtype, device=x.device), x.new_zeros(channels, 1), centred), 1
        )
        of_mean = F.pad(x.new_ones(1, channels), (3 * channels, 3))
        of_squares = F.pad(x.new_ones(1, 1), (4 * channels, 2))
        rows = F.pad(torch.cat((of_x, of_mean, of_squares)), (0, MOMENTS - 3))
        pixels = torch.cat((x, mean, (x * x).sum(-1, keepdim=True)), -1) @ rows
        slope = torch.cat((projection @ centred, position[0])).T.contiguous()
        return Projected(pixels, slope, qkv_weight @ norm[1], centred.T @ centred, heads)


def neighbour_attention(
    projected: Projected,
    queries: torch.Tensor,
    output: tuple[torch.Tensor, torch.Tensor],
    wrap: bool = True,
    *,
    eps: float = 1e-5,
    backend: str = "warp",
) -> torch.Tensor:
    """Gathers the 4 neighbours of each query, embeds the offsets, and lets the neighbours attend to each other.

    Equal to x + linear(attend_neighbours(linear(layer_norm(x), M), heads), O) of x = z + Wq + b with z and q from
    `gather_neighbours`. Differentiable in `projected` and `output`; the backward pass is deterministic.

    Args:
        projected: `project_pixels` of the features, float32 or float64.
        queries: (B, Q, 2) pixel coordinates (row, column).
        output: Weight O (C, C) and bias (C,) of the projection of what was attended to.
        wrap: Whether column W-1 meets column 0 (a full circle). Otherwise columns clamp; rows always clamp.
        eps: Of the layer norm.
        backend: "warp", or "torch" for the plain twin in `kernels.reference`.

    Returns:
        (B, Q, 4, C) tokens, in the usual order of neighbours; of the dtype of `projected`, or under autocast of
        autocast's, but computed in that of `projected`.

    Raises:
        TypeError: If `projected` or `queries` is not of a supported floating-point dtype.
        ValueError: If a shape, device or backend does not fit.

    Source: paper Sec. II-B, "Feature transformation using self-attention"; the hoisting is ours.
    """
    check_backend(backend)
    pixels, slope, shift, gram, heads = projected
    check_floating("projected.pixels", pixels, [torch.float32, torch.float64], "(B, H, W, 4·C + 16)")
    check_queries(queries, pixels, "projected")
    if queries.ndim != 3 or len(queries) != len(pixels):
        raise ValueError(f"queries has shape {tuple(queries.shape)}; it should be ({len(pixels)}, Q, 2)")
    channels = len(shift) // 3
    if output[0].shape != (channels, channels) or output[1].shape != (channels,):
        shapes = [tuple(tensor.shape) for tensor in output]
        raise ValueError(f"output has shapes {shapes}; they should be {[(channels, channels), (channels,)]}")
    device = pixels.device.type
    dtype = torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else pixels.dtype
    queries = queries.detach().to(pixels.dtype)
    weight = output[0].to(pixels.dtype)[:, head_last(channels, heads, pixels.device)]
    bias = output[1].to(pixels.dtype)
    pixels, queries = pixels.contiguous(), queries.contiguous()
    if backend == "torch":
        step = reference.neighbour_attention(pixels, queries, slope, shift, gram, weight, bias, heads, eps, wrap)
        return step.to(dtype)
    return _neighbour_attention(pixels, queries, slope, shift, gram, weight, bias, heads, eps, wrap, dtype)
