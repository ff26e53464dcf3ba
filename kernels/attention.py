"""neighbour_attention: multi-head self-attention among the 4 neighbours of each query (paper, Fig. 3b).

For every query and head, with q, k, v the rows of the 4 neighbours and D their length:

    P = softmax(q kᵀ / √D),    out = P v

and backwards, from the gradient G of the output, with S = P ∘ (G vᵀ - rowsum(P ∘ G vᵀ)):

    ∂q = S k / √D,    ∂k = Sᵀ q / √D,    ∂v = Pᵀ G

A 4×4 problem is far too small for a matrix library: one thread does one head of one query in registers.
"""

import math
from typing import Any

import torch
import warp as wp

from kernels import reference
from kernels.launch import check_backend, launch, overload

__all__ = ["neighbour_attention"]


_Q, _K, _V = wp.constant(0), wp.constant(1), wp.constant(2)


@wp.func
def _probabilities(qkv: wp.array4d[Any], n: int, h: int, scale: Any):
    """P (4, 4) of head h of query n."""
    p = wp.matrix(shape=(4, 4), dtype=type(scale))
    for d in range(qkv.shape[3]):
        for i in range(4):
            q = type(scale)(qkv[n, 3 * i + _Q, h, d]) * scale
            for j in range(4):
                p[i, j] = p[i, j] + q * type(scale)(qkv[n, 3 * j + _K, h, d])
    for i in range(4):
        largest = wp.max(wp.max(p[i, 0], p[i, 1]), wp.max(p[i, 2], p[i, 3]))
        for j in range(4):
            p[i, j] = wp.exp(p[i, j] - largest)
        total = p[i, 0] + p[i, 1] + p[i, 2] + p[i, 3]
        for j in range(4):
            p[i, j] = p[i, j] / total
    return p


@wp.kernel(enable_backward=False)
def _attend_neighbours_kernel(
    first: int,
    # in
    qkv: wp.array4d[Any],
    scale: wp.Float,
    # out
    attended_out: wp.array4d[Any],
):
    thread = first + wp.tid()
    n = thread // qkv.shape[2]
    h = thread % qkv.shape[2]
    p = _probabilities(qkv, n, h, scale)
    for d in range(qkv.shape[3]):
        for i in range(4):
            blended = type(scale)(0.0)
            for j in range(4):
                blended = blended + p[i, j] * type(scale)(qkv[n, 3 * j + _V, h, d])
            attended_out[n, i, h, d] = qkv.dtype(blended)


@wp.kernel(enable_backward=False)
def _attend_neighbours_backward_kernel(
    first: int,
    # in
    qkv: wp.array4d[Any],
    adj_attended: wp.array4d[Any],
    scale: wp.Float,
    # out
    adj_qkv_out: wp.array4d[Any],
):
    thread = first + wp.tid()
    n = thread // qkv.shape[2]
    h = thread % qkv.shape[2]
    p = _probabilities(qkv, n, h, scale)
    s = wp.matrix(shape=(4, 4), dtype=type(scale))
    for d in range(qkv.shape[3]):
        for i in range(4):
            g = type(scale)(adj_attended[n, i, h, d])
            for j in range(4):
                s[i, j] = s[i, j] + g * type(scale)(qkv[n, 3 * j + _V, h, d])
    for i in range(4):
        mean = p[i, 0] * s[i, 0] + p[i, 1] * s[i, 1] + p[i, 2] * s[i, 2] + p[i, 3] * s[i, 3]
        for j in range(4):
            s[i, j] = p[i, j] * (s[i, j] - mean)
    for d in range(qkv.shape[3]):
        for i in range(4):
            adj_q = type(scale)(0.0)
            adj_k = type(scale)(0.0)
            adj_v = type(scale)(0.0)
            for j in range(4):
                adj_q = adj_q + s[i, j] * type(scale)(qkv[n, 3 * j + _K, h, d])
                adj_k = adj_k + s[j, i] * type(scale)(qkv[n, 3 * j + _Q, h, d])
                adj_v = adj_v + p[j, i] * type(scale)(adj_attended[n, j, h, d])
            adj_qkv_out[n, 3 * i + _Q, h, d] = qkv.dtype(adj_q * scale)
            adj_qkv_out[n, 3 * i + _K, h, d] = qkv.dtype(adj_k * scale)
            adj_qkv_out[n, 3 * i + _V, h, d] = qkv.dtype(adj_v)


_attend = overload(_attend_neighbours_kernel, half=True)
_attend_backward = overload(_attend_neighbours_backward_kernel, half=True)


@torch.library.custom_op("kernels::neighbour_attention", mutates_args=())
def _neighbour_attention(qkv: torch.Tensor) -> torch.Tensor:
    count, _, heads, width = qkv.shape
    attended = qkv.new_empty(count, 4, heads, width)
    launch(_attend[qkv.dtype], count * heads, [qkv, 1 / math.sqrt(width)], [attended])
    return attended


@_neighbour_attention.register_fake
def _(qkv: torch.Tensor) -> torch.Tensor:
    count, _, heads, width = qkv.shape
    return qkv.new_empty(count, 4, heads, width)


@torch.library.custom_op("kernels::neighbour_attention_backward", mutates_args=())
def _neighbour_attention_backward(qkv: torch.Tensor, adj_attended: torch.Tensor) -> torch.Tensor:
    count, _, heads, width = qkv.shape
    adj_qkv = qkv.new_empty(qkv.shape)
    launch(_attend_backward[qkv.dtype], count * heads, [qkv, adj_attended, 1 / math.sqrt(width)], [adj_qkv])
    return adj_qkv


@_neighbour_attention_backward.register_fake
def _(qkv: torch.Tensor, adj_attended: torch.Tensor) -> torch.Tensor:
    return qkv.new_empty(qkv.shape)


def _setup_context(ctx: Any, inputs: tuple, output: torch.Tensor) -> None:
    ctx.save_for_backward(*inputs)


def _backward(ctx: Any, adj_attended: torch.Tensor) -> torch.Tensor:
    (qkv,) = ctx.saved_tensors
    return _neighbour_attention_backward(qkv, adj_attended)


_neighbour_attention.register_autograd(_backward, setup_context=_setup_context)


def neighbour_attention(qkv: torch.Tensor, heads: int, backend: str = "warp") -> torch.Tensor:
    """Lets the 4 neighbours of each query attend to each other.

    Args:
        qkv: (..., 4, 3·C) float32, float64, bfloat16 or float16: queries, keys and values of each neighbour, in the
            order of a `Linear(C, 3·C)`; each is split into heads.
        heads: Number of heads; it divides C.
        backend: "warp", or "torch" for the plain twin in `kernels.reference`.

    Returns:
        (..., 4, C), the heads' results side by side; half precision is computed in float32.

    Raises:
        TypeError: If `qkv` is not a floating-point tensor of a supported dtype.
        ValueError: If a shape, `heads` or backend does not fit.

    Source: paper Sec. II-B, "Feature transformation using self-attention".
    """
    check_backend(backend)
    if not isinstance(qkv, torch.Tensor) or qkv.dtype not in _attend:
        kind = getattr(qkv, "dtype", type(qkv).__name__)
        raise TypeError(f"qkv is {kind}; it should be a floating-point tensor (..., 4, 3·C)")
    if qkv.ndim < 2 or qkv.shape[-2] != 4 or heads < 1 or qkv.shape[-1] == 0 or qkv.shape[-1] % (3 * heads):
        raise ValueError(
            f"qkv has shape {tuple(qkv.shape)}; it should be (..., 4, 3·C) with C a multiple of the {heads} heads"
        )
    batch, width = qkv.shape[:-2], qkv.shape[-1] // (3 * heads)
    qkv = qkv.reshape(-1, 12, heads, width)
    attended = reference.neighbour_attention(qkv) if backend == "torch" else _neighbour_attention(qkv.contiguous())
    return attended.reshape(*batch, 4, heads * width)
