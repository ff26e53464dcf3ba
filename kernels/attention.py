"""attend_neighbours: multi-head self-attention among the 4 neighbours of each query (paper, Fig. 3b).

Let q, k and v (4, D) be the queries, keys and values of one head, one row per neighbour, and G the gradient of the
output. Then, forward and backward:

    P = softmax(q kᵀ / √D),    out = P v
    S = P ∘ (G vᵀ - rowsum(P ∘ G vᵀ)),    ∂q = S k / √D,    ∂k = Sᵀ q / √D,    ∂v = Pᵀ G

A 4×4 problem is far too small for a matrix library, so one thread does one head of one query in registers.
"""

import math
from typing import Any

import torch
import warp as wp

from kernels import reference
from kernels.checks import check_backend, check_floating
from kernels.launch import launch, overload
from kernels.vmap import fold_into_batch

__all__ = ["attend_neighbours"]


@wp.func
def _softmax_rows(logits: Any):
    """Attention map P (4, 4) from the logits q kᵀ / √D."""
    p = logits
    for i in range(4):
        largest = wp.max(wp.max(p[i, 0], p[i, 1]), wp.max(p[i, 2], p[i, 3]))
        for j in range(4):
            p[i, j] = wp.exp(p[i, j] - largest)
        total = p[i, 0] + p[i, 1] + p[i, 2] + p[i, 3]
        for j in range(4):
            p[i, j] = p[i, j] / total
    return p


@wp.func
def _adj_logits(p: Any, adj_p: Any):
    """S, the gradient of the logits, from P and the gradient G vᵀ of P."""
    s = adj_p
    for i in range(4):
        mean = p[i, 0] * s[i, 0] + p[i, 1] * s[i, 1] + p[i, 2] * s[i, 2] + p[i, 3] * s[i, 3]
        for j in range(4):
            s[i, j] = p[i, j] * (s[i, j] - mean)
    return s


@wp.func
def _four(array: wp.array4d[Any], n: int, step: int, start: int, h: int, d: int, scale: Any):
    """The 4 entries start, start + step, ... of array[n, :, h, d], one for each neighbour.

    In qkv neighbour t has its query at 3 t, its key at 3 t + 1 and its value at 3 t + 2.
    """
    values = wp.vector(dtype=type(scale), length=4)
    for t in range(4):
        values[t] = type(scale)(array[n, start + step * t, h, d])
    return values


@wp.func
def _attention_map(qkv: wp.array4d[Any], n: int, h: int, scale: Any):
    """Attention map P (4, 4) of head h of query n."""
    logits = wp.matrix(shape=(4, 4), dtype=type(scale))
    for d in range(qkv.shape[3]):
        logits = logits + wp.outer(_four(qkv, n, 3, 0, h, d, scale) * scale, _four(qkv, n, 3, 1, h, d, scale))
    return _softmax_rows(logits)


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
    p = _attention_map(qkv, n, h, scale)
    for d in range(qkv.shape[3]):
        attended = p * _four(qkv, n, 3, 2, h, d, scale)
        for t in range(4):
            attended_out[n, t, h, d] = qkv.dtype(attended[t])


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
    p = _attention_map(qkv, n, h, scale)
    adj_p = wp.matrix(shape=(4, 4), dtype=type(scale))
    for d in range(qkv.shape[3]):
        adj_p = adj_p + wp.outer(_four(adj_attended, n, 1, 0, h, d, scale), _four(qkv, n, 3, 2, h, d, scale))
    s = _adj_logits(p, adj_p) * scale
    for d in range(qkv.shape[3]):
        adj_q = s * _four(qkv, n, 3, 1, h, d, scale)
        adj_k = wp.transpose(s) * _four(qkv, n, 3, 0, h, d, scale)
        adj_v = wp.transpose(p) * _four(adj_attended, n, 1, 0, h, d, scale)
        for t in range(4):
            adj_qkv_out[n, 3 * t, h, d] = qkv.dtype(adj_q[t])
            adj_qkv_out[n, 3 * t + 1, h, d] = qkv.dtype(adj_k[t])
            adj_qkv_out[n, 3 * t + 2, h, d] = qkv.dtype(adj_v[t])


_attend = overload(_attend_neighbours_kernel, half=True)
_attend_backward = overload(_attend_neighbours_backward_kernel, half=True)


def _empty_attended(qkv: torch.Tensor) -> torch.Tensor:
    count, _, heads, width = qkv.shape
    return qkv.new_empty(count, 4, heads, width)


@torch.library.custom_op("kernels::attend_neighbours", mutates_args=())
def _attend_neighbours(qkv: torch.Tensor) -> torch.Tensor:
    count, _, heads, width = qkv.shape
    attended = _empty_attended(qkv)
    launch(_attend[qkv.dtype], count * heads, [qkv, 1 / math.sqrt(width)], [attended])
    return attended


def _empty_adj_qkv(qkv: torch.Tensor, adj_attended: torch.Tensor) -> torch.Tensor:
    return qkv.new_empty(qkv.shape)


@torch.library.custom_op("kernels::attend_neighbours_backward", mutates_args=())
def _attend_neighbours_backward(qkv: torch.Tensor, adj_attended: torch.Tensor) -> torch.Tensor:
    count, _, heads, width = qkv.shape
    adj_qkv = _empty_adj_qkv(qkv, adj_attended)
    launch(_attend_backward[qkv.dtype], count * heads, [qkv, adj_attended, 1 / math.sqrt(width)], [adj_qkv])
    return adj_qkv


_attend_neighbours.register_fake(_empty_attended)
_attend_neighbours_backward.register_fake(_empty_adj_qkv)


def _setup_context(ctx: Any, inputs: tuple, output: torch.Tensor) -> None:
    ctx.save_for_backward(*inputs)


def _backward(ctx: Any, adj_attended: torch.Tensor) -> torch.Tensor:
    (qkv,) = ctx.saved_tensors
    return _attend_neighbours_backward(qkv, adj_attended)


_attend_neighbours.register_autograd(_backward, setup_context=_setup_context)
fold_into_batch(_attend_neighbours)
fold_into_batch(_attend_neighbours_backward)


def attend_neighbours(qkv: torch.Tensor, heads: int, backend: str = "warp") -> torch.Tensor:
    """Lets the 4 neighbours of each query attend to each other.

    Differentiable.

    Args:
        qkv: (..., 4, 3·C) float32, float64, bfloat16 or float16: queries, keys and values of each neighbour, in the
            order of a `Linear(C, 3·C)`. Each of the three is split into heads.
        heads: Number of heads; it divides C.
        backend: "warp", or "torch" for the plain twin in `kernels.reference`.

    Returns:
        (..., 4, C), the results of the heads side by side. Half precision is computed in float32.

    Raises:
        TypeError: If `qkv` is not a floating-point tensor of a supported dtype.
        ValueError: If a shape, `heads` or backend does not fit.

    Source: paper Sec. II-B, "Feature transformation using self-attention".
    """
    check_backend(backend)
    check_floating("qkv", qkv, _attend, "(..., 4, 3·C)")
    if heads < 1:
        raise ValueError(f"heads is {heads}; it should be at least 1")
    if qkv.ndim < 2 or qkv.shape[-2] != 4 or qkv.shape[-1] == 0 or qkv.shape[-1] % (3 * heads):
        raise ValueError(
            f"qkv has shape {tuple(qkv.shape)}; it should be (..., 4, 3·C) with C a multiple of the {heads} heads"
        )
    batch, width = qkv.shape[:-2], qkv.shape[-1] // (3 * heads)
    qkv = qkv.reshape(-1, 12, heads, width)
    attended = reference.attend_neighbours(qkv) if backend == "torch" else _attend_neighbours(qkv.contiguous())
    return attended.reshape(*batch, 4, heads * width)
