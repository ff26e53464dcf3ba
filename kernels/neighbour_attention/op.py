"""neighbour_attention: a whole pre-norm attention step among the 4 neighbours of each query (paper, Fig. 3b).

`kernels.neighbour_attention.maths` derives it. Where `vectors` fits, its kernel does the whole step. Elsewhere the
kernel of `heads` gathers and attends, and torch does the output projection. Only the inputs are kept for the backward
pass.
"""

from typing import Any

import torch

from kernels import reference
from kernels.checks import check_backend, check_devices, check_floating, check_queries
from kernels.launch import launch
from kernels.neighbour_attention import vectors
from kernels.neighbour_attention.heads import ATTEND, ATTEND_BACKWARD
from kernels.neighbour_attention.table import Projected, fields, head_last
from kernels.scatter import adjoint_of_gather
from kernels.vmap import refuse

__all__ = ["neighbour_attention"]


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
    if vectors.fits(pixels, dtype, channels, heads):
        return vectors.step(pixels, queries, slope, shift, gram, weight, bias, heads, eps, wrap, dtype)
    batch, count, _ = queries.shape
    tokens = pixels.new_empty(batch * count * 4, channels)
    attended = torch.empty_like(tokens)
    table = fields(pixels, slope, shift, gram, heads, eps, wrap, per_image=count, groups=heads)
    launch(ATTEND[pixels.dtype], batch * count * heads, [table, queries.view(-1, 2)], [tokens, attended])
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
    if vectors.fits(pixels, adj_step.dtype, channels, heads):
        return vectors.step_backward(pixels, queries, slope, shift, gram, weight, adj_step, heads, eps, wrap)  # type: ignore[return-value]
    with torch.autocast(pixels.device.type, enabled=False):
        adj_tokens = adj_step.reshape(-1, channels).to(pixels.dtype).contiguous()
        adj_attended = adj_tokens @ weight
        adj_rows = pixels.new_zeros(len(adj_tokens), columns)
        attended = torch.empty_like(adj_tokens)
        adj_squares = pixels.new_empty(len(adj_tokens), heads)
        coefficients = pixels.new_empty(len(adj_tokens), 3)
        table = fields(pixels, slope, shift, gram, heads, eps, wrap, per_image=count, groups=heads)
        inputs = [table, queries.view(-1, 2), adj_tokens, adj_attended]
        outputs = [adj_rows, attended, adj_squares, coefficients]
        launch(ATTEND_BACKWARD[pixels.dtype], batch * count * heads, inputs, outputs)
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
    *_: Any,
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

    With the features z and offsets q of `gather_neighbours` and t = z + Wq + b, the result equals
    t + linear(attend_neighbours(linear(layer_norm(t), M), heads), O). It is differentiable in `projected` and `output`,
    and the backward pass is deterministic.

    Args:
        projected: The features after `project_pixels`, float32 or float64.
        queries: (B, Q, 2) pixel coordinates (row, column). Those beyond ±2^30 count as ±2^30.
        output: Weight O (C, C) and bias (C,) of the projection of the attended values.
        wrap: Whether column W-1 meets column 0 (a full circle). Otherwise columns clamp; rows always clamp.
        eps: ε of the layer norm.
        backend: "warp", or "torch" for the plain twin in `kernels.reference`.

    Returns:
        (B, Q, 4, C) tokens, in the usual order of neighbours. They are computed in the dtype of `projected`, which is
        also theirs; under autocast they are rounded to autocast's.

    Raises:
        TypeError: If `projected` or `queries` is not of a supported floating-point dtype.
        ValueError: If a shape, device or backend does not fit.

    Source: paper Sec. II-B, "Feature transformation using self-attention"; projecting pixels instead of tokens is ours.
    """
    check_backend(backend)
    pixels, slope, shift, gram, heads = projected
    check_floating("projected.pixels", pixels, [torch.float32, torch.float64], "(B, H, W, 4·C + 16)")
    check_queries(queries)
    outputs = {f"output[{i}]": tensor for i, tensor in enumerate(output)}
    check_devices(**projected.named(), queries=queries, **outputs)
    if queries.ndim != 3 or len(queries) != len(pixels):
        raise ValueError(f"queries has shape {tuple(queries.shape)}; it should be ({len(pixels)}, Q, 2)")
    channels = len(shift) // 3
    if output[0].shape != (channels, channels) or output[1].shape != (channels,):
        shapes = [tuple(tensor.shape) for tensor in output]
        raise ValueError(f"output has shapes {shapes}; they should be {[(channels, channels), (channels,)]}")
    device = pixels.device.type
    dtype = torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else pixels.dtype
    queries = queries.detach().to(pixels.dtype)
    weight = head_last(output[0].to(pixels.dtype), heads)
    bias = output[1].to(pixels.dtype).contiguous()
    pixels, queries = pixels.contiguous(), queries.contiguous()
    if backend == "torch":
        step = reference.neighbour_attention(pixels, queries, slope, shift, gram, weight, bias, heads, eps, wrap)
        return step.to(dtype)
    return _neighbour_attention(pixels, queries, slope, shift, gram, weight, bias, heads, eps, wrap, dtype)
