"""area_blend: values at the 4 neighbours, weighted by bilinear areas (paper, Eq. 2).

    r̂ = Σ_t (S_t / S) v_t,    ∂r̂/∂v_t = S_t / S

S_t is the area of the rectangle between the query and the neighbour diagonally opposite to t (`kernels.stencil.area`).
With the neighbours' own ranges as values v_t this is bilinear interpolation. In LIIF a network predicts the values.
"""

from typing import Any

import torch
import warp as wp

from kernels import reference
from kernels.checks import broadcast_batch, check_backend, check_devices, check_floating, check_queries
from kernels.launch import BLOCKS, launch, overload, query_blocks
from kernels.stencil import area
from kernels.vmap import fold_into_batch

__all__ = ["area_blend"]


def _kernels(n: int) -> tuple[wp.Kernel, wp.Kernel]:
    """Returns the forward and the backward kernel whose threads take n queries each."""
    two = wp.types.vector(2 * n, wp.Float)
    one_stored, four_stored = (wp.types.vector(n * numbers, wp.Scalar) for numbers in (1, 4))

    @wp.kernel(enable_backward=False)
    def _area_blend_kernel(
        first: int,
        # in
        values: wp.array[four_stored],
        queries: wp.array[two],
        # out
        blended_out: wp.array[one_stored],
    ):
        q = first + wp.tid()
        at = queries[q]
        v = values[q]
        blended = blended_out.dtype()
        for k in range(n):
            total = area(at[2 * k], at[2 * k + 1], 0) * queries.dtype.dtype(v[4 * k])
            for t in range(1, 4):
                total = total + area(at[2 * k], at[2 * k + 1], t) * queries.dtype.dtype(v[4 * k + t])
            blended[k] = blended.dtype(total)
        blended_out[q] = blended

    @wp.kernel(enable_backward=False)
    def _area_blend_backward_kernel(
        first: int,
        # in
        adj_blended: wp.array[one_stored],
        queries: wp.array[two],
        # out
        adj_values_out: wp.array[four_stored],
    ):
        q = first + wp.tid()
        at = queries[q]
        g = adj_blended[q]
        x = adj_values_out.dtype()
        for k in range(n):
            for t in range(4):
                x[4 * k + t] = x.dtype(area(at[2 * k], at[2 * k + 1], t) * queries.dtype.dtype(g[k]))
        adj_values_out[q] = x

    return _area_blend_kernel, _area_blend_backward_kernel


_made = {n: [overload(kernel, half=True) for kernel in _kernels(n)] for n in BLOCKS}
_blend = {(dtype, n): forward[dtype] for n, (forward, _) in _made.items() for dtype in forward}
_blend_backward = {(dtype, n): backward[dtype] for n, (_, backward) in _made.items() for dtype in backward}


def _empty_blended(values: torch.Tensor, queries: torch.Tensor) -> torch.Tensor:
    return values.new_empty(values.shape[0])


@torch.library.custom_op("kernels::area_blend", mutates_args=())
def _area_blend(values: torch.Tensor, queries: torch.Tensor) -> torch.Tensor:
    blended = _empty_blended(values, queries)
    for n, part in query_blocks(len(values), values.device):
        threads = (part.stop - part.start) // n
        launch(_blend[values.dtype, n], threads, [values[part], queries[part]], [blended[part]])
    return blended


def _empty_adj_values(adj_blended: torch.Tensor, queries: torch.Tensor) -> torch.Tensor:
    return adj_blended.new_empty(adj_blended.shape[0], 4)


@torch.library.custom_op("kernels::area_blend_backward", mutates_args=())
def _area_blend_backward(adj_blended: torch.Tensor, queries: torch.Tensor) -> torch.Tensor:
    adj_values = _empty_adj_values(adj_blended, queries)
    for n, part in query_blocks(len(queries), queries.device):
        threads = (part.stop - part.start) // n
        launch(_blend_backward[adj_blended.dtype, n], threads, [adj_blended[part], queries[part]], [adj_values[part]])
    return adj_values


_area_blend.register_fake(_empty_blended)
_area_blend_backward.register_fake(_empty_adj_values)


def _setup_context(ctx: Any, inputs: tuple, output: torch.Tensor) -> None:
    ctx.save_for_backward(inputs[1])


def _backward(ctx: Any, adj_blended: torch.Tensor) -> tuple[torch.Tensor, None]:
    (queries,) = ctx.saved_tensors
    return _area_blend_backward(adj_blended.contiguous(), queries), None


_area_blend.register_autograd(_backward, setup_context=_setup_context)
fold_into_batch(_area_blend)
fold_into_batch(_area_blend_backward)


def area_blend(values: torch.Tensor, queries: torch.Tensor, backend: str = "warp") -> torch.Tensor:
    """Blends one value per neighbour with the bilinear areas of a query.

    Differentiable in `values`.

    Args:
        values: (..., Q, 4) float32, float64, bfloat16 or float16, of any unit, one per neighbour in the order
            (row-, col-), (row-, col+), (row+, col-), (row+, col+). Half precision is summed in float32.
        queries: (..., Q, 2) pixel coordinates (row, column). Leading dimensions broadcast against those of `values`.
        backend: "warp", or "torch" for the plain twin in `kernels.reference`.

    Returns:
        (..., Q), in the unit of the values.

    Raises:
        TypeError: If an argument is not a floating-point tensor of a supported dtype.
        ValueError: If a shape, device or backend does not fit.

    Source: paper Eq. 2 (the weight function S_t / S).
    """
    check_backend(backend)
    check_floating("values", values, [dtype for dtype, n in _blend if n == 1], "(..., Q, 4)")
    check_queries(queries)
    check_devices(values=values, queries=queries)
    if values.ndim < 2 or values.shape[-2:] != (queries.shape[-2], 4):
        raise ValueError(f"values has shape {tuple(values.shape)}; it should be (..., {queries.shape[-2]}, 4)")
    queries = queries.detach().to(torch.promote_types(values.dtype, torch.float32))
    count = queries.shape[-2]
    batch, (values, queries) = broadcast_batch(values=(values, 2), queries=(queries, 2))
    values, queries = values.flatten(0, 1).contiguous(), queries.flatten(0, 1).contiguous()
    blended = reference.area_blend(values, queries) if backend == "torch" else _area_blend(values, queries)
    return blended.view(*batch, count)
