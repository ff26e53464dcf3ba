"""gather_neighbours: features z_t and offsets Δq_t of the 4 pixels around each query (paper, Sec. II-B).

`kernels.stencil` says which pixels these are. The gradient of a pixel is the sum over all queries that have it as a
neighbour (`kernels.scatter`).
"""

from typing import Any

import torch
import warp as wp

from kernels import reference
from kernels.checks import broadcast_batch, check_backend, check_devices, check_floating, check_queries
from kernels.launch import channel_spans, launch, overload_vectors, vector_width
from kernels.scatter import adjoint_of_gather
from kernels.stencil import Grid, grid_of, neighbour, offset
from kernels.vmap import fold_into_batch

__all__ = ["gather_neighbours"]


@wp.kernel(enable_backward=False)
def _gather_neighbours_kernel(
    first: int,
    # in
    features: wp.array4d[Any],
    queries: wp.array3d[wp.Float],
    span: int,
    grid: Grid,
    # out
    gathered_out: wp.array4d[Any],
    offsets_out: wp.array4d[wp.Float],
):
    blocks = features.shape[3]
    spans = (blocks + span - 1) // span
    thread = first + wp.tid()
    begin = (thread % spans) * span
    end = wp.min(begin + span, blocks)
    t = (thread // spans) % 4
    q = (thread // spans // 4) % queries.shape[1]
    b = thread // spans // 4 // queries.shape[1]
    row = queries[b, q, 0]
    column = queries[b, q, 1]
    i, j = neighbour(row, column, t, grid)
    for c in range(begin, end):
        gathered_out[b, q, t, c] = features[b, i, j, c]
    if begin == 0:
        dr, dc = offset(row, column, t, grid)
        offsets_out[b, q, t, 0] = dr
        offsets_out[b, q, t, 1] = dc


_gather = overload_vectors(_gather_neighbours_kernel, half=True)


def _empty_outputs(features: torch.Tensor, queries: torch.Tensor, wrap: bool) -> tuple[torch.Tensor, torch.Tensor]:
    batch, _, _, channels = features.shape
    count = queries.shape[1]
    return features.new_empty(batch, count, 4, channels), queries.new_empty(batch, count, 4, 2)


@torch.library.custom_op("kernels::gather_neighbours", mutates_args=())
def _gather_neighbours(features: torch.Tensor, queries: torch.Tensor, wrap: bool) -> tuple[torch.Tensor, torch.Tensor]:
    batch, height, width, channels = features.shape
    gathered, offsets = _empty_outputs(features, queries, wrap)
    lanes = vector_width(channels)
    span, spans = channel_spans(channels // lanes, features.device)
    inputs = [features, queries, span, grid_of(height, width, wrap)]
    launch(_gather[features.dtype, lanes], batch * queries.shape[1] * 4 * spans, inputs, [gathered, offsets])
    return gathered, offsets


_gather_neighbours.register_fake(_empty_outputs)


def _setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
    features, queries, ctx.wrap = inputs
    ctx.save_for_backward(queries)
    ctx.height, ctx.width = features.shape[1:3]


def _backward(ctx: Any, gradient: torch.Tensor, _: torch.Tensor) -> tuple[torch.Tensor | None, None, None]:
    (queries,) = ctx.saved_tensors
    if not ctx.needs_input_grad[0]:
        return None, None, None
    pixels = adjoint_of_gather(gradient.to(queries.dtype), queries, ctx.height, ctx.width, ctx.wrap)
    return pixels.to(gradient.dtype), None, None


_gather_neighbours.register_autograd(_backward, setup_context=_setup_context)
fold_into_batch(_gather_neighbours)


def gather_neighbours(
    features: torch.Tensor, queries: torch.Tensor, wrap: bool = True, backend: str = "warp"
) -> tuple[torch.Tensor, torch.Tensor]:
    """Gathers the features of the 4 pixels around each query and the query's offset from each.

    Differentiable in `features`; `queries` and the offsets carry no gradient. The backward pass is deterministic.

    Args:
        features: (..., C, H, W) float32, float64, bfloat16 or float16. Memory format `channels_last` is read in place.
            The gradients of half precision are summed in float32.
        queries: (..., Q, 2) pixel coordinates (row, column); integers are pixel centres. Leading dimensions broadcast
            against those of `features`.
        wrap: Whether column W-1 meets column 0 (a full circle). Otherwise columns clamp. Rows always clamp.
        backend: "warp", or "torch" for the plain twin in `kernels.reference`.

    Returns:
        gathered: (..., Q, 4, C), neighbours in the order (row-, col-), (row-, col+), (row+, col-), (row+, col+).
        offsets: (..., Q, 4, 2), query minus neighbour in pixels; float64 if the features are, else float32.

    Raises:
        TypeError: If `features` or `queries` is not a floating-point tensor of a supported dtype.
        ValueError: If a shape, device or backend does not fit.

    Source: paper Sec. II-B, "Local feature extraction" (z_t, Δq_t).
    """
    check_backend(backend)
    check_floating("features", features, [dtype for dtype, _ in _gather], "(..., C, H, W)")
    if features.ndim < 3 or 0 in features.shape[-3:]:
        raise ValueError(f"features has shape {tuple(features.shape)}; it should be (..., C, H, W), none of them 0")
    check_queries(queries)
    check_devices(features=features, queries=queries)
    queries = queries.detach().to(torch.promote_types(features.dtype, torch.float32))
    batch, (features, queries) = broadcast_batch(features=(features, 3), queries=(queries, 2))
    if backend == "torch":
        gathered, offsets = reference.gather_neighbours(features, queries, wrap)
    else:
        gathered, offsets = _gather_neighbours(features.movedim(1, 3).contiguous(), queries.contiguous(), wrap)
    return gathered.reshape(*batch, *gathered.shape[1:]), offsets.detach().reshape(*batch, *offsets.shape[1:])
