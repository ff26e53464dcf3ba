"""A whole attention block for a few queries at a time on CPUs: what the fused decoders share.

    t = z + Wq + b                           for each of the 4 neighbours
    t ← t + O attend(M LN(t))                `kernels.neighbour_attention.maths`
    t ← t + W₂ gelu(W₁ LN(t) + b₁) + b₂

A frame of 128×2048 queries has a million tokens, and a decoder passes over them a dozen times. One operation after the
other, it would wait for memory. Here a thread takes a few queries at a time through all operations: their tokens stay
in the cache of its core.

γ and β of the layer norms are multiplied into the weights behind them.
"""

from typing import Any, NamedTuple

import torch
import warp as wp

from kernels.lanes import LANES, add_products, gelu, rsqrt, totals4, vectors, zeros4
from kernels.neighbour_attention.maths import PIXEL_TABLES, attend, stencil
from kernels.neighbour_attention.table import Projected, head_last
from kernels.neighbour_attention.vectors import HEADS, fits

__all__ = [
    "GROUP",
    "WORKERS",
    "DecoderWeights",
    "Scratch",
    "block",
    "blocks_of",
    "check_served",
    "normalise",
    "scratch_of",
    "serves",
]

# Threads among which the queries are split, and how many queries a thread takes at a time. The tokens of so many fit
# the cache of a core, and it reads each layer's weights once for all of them.
WORKERS = 64
GROUP = 16

_lanes = vectors(LANES, wp.float32)
_pixel_table: Any = PIXEL_TABLES[_lanes]


@wp.struct
class Scratch:
    """Memory of the threads: each has 4·`GROUP` rows, one for each neighbour of its queries."""

    tokens: wp.array2d[_lanes]
    """(rows, blocks): t."""
    x: wp.array2d[_lanes]
    """(rows, blocks): the input of the next layer."""
    x_scalars: wp.array2d[float]
    """(rows, C): the same memory, number by number."""
    h: wp.array2d[_lanes]
    """(rows, blocks): the hidden layer."""
    h_scalars: wp.array2d[float]
    """(rows, C): the same memory, number by number."""


def scratch_of(pixels: torch.Tensor, channels: int) -> dict[str, torch.Tensor]:
    """Returns the fields of `Scratch` for `WORKERS` threads and C = `channels`."""
    tokens, x, h = pixels.new_empty(3, 4 * GROUP * WORKERS, channels)
    return {"tokens": tokens, "x": x, "x_scalars": x, "h": h, "h_scalars": h}


@wp.func
def normalise(x: wp.array2d[_lanes], row: int, eps: float, y_out: wp.array2d[_lanes]):
    """Layer norm of rows `row` to `row` + 3, without weight and bias."""
    inverse = 1.0 / float(LANES * x.shape[1])
    sums = zeros4(_lanes())
    for c in range(x.shape[1]):
        for t in range(4):
            sums[t] += x[row + t, c]
    mean = totals4(sums[0], sums[1], sums[2], sums[3]) * inverse
    squares = zeros4(_lanes())
    for c in range(x.shape[1]):
        for t in range(4):
            centred = x[row + t, c] - _lanes(mean[4 * t])
            squares[t] += wp.cw_mul(centred, centred)
    variance = totals4(squares[0], squares[1], squares[2], squares[3]) * inverse
    factor = rsqrt(variance + _lanes(eps))
    for c in range(x.shape[1]):
        for t in range(4):
            y_out[row + t, c] = (x[row + t, c] - _lanes(mean[4 * t])) * factor[4 * t]


@wp.func
def block(
    table: _pixel_table,
    queries: wp.array2d[float],
    weights: wp.array3d[_lanes],
    biases: wp.array2d[_lanes],
    begin: int,
    end: int,
    row: int,
    # out
    scratch_out: Scratch,
):
    """Takes queries `begin` to `end` - 1 through the block, and leaves LN(t) in `x`, in 4 rows a query from `row`.

    `weights` begins with Oᵀ, W₁ᵀ and W₂ᵀ, `biases` with theirs.
    """
    tokens = scratch_out.tokens
    x = scratch_out.x
    h = scratch_out.h
    blocks = biases.shape[1]
    stop = row + 4 * (end - begin)
    for n in range(begin, end):
        around = stencil(table, queries, n)
        attend(table, around, 0, row + 4 * (n - begin), tokens, x)
    for i in range(row, stop):
        for c in range(blocks):
            tokens[i, c] = tokens[i, c] + biases[0, c]
    for i in range(row, stop, 4):
        add_products(scratch_out.x_scalars, weights[0], i, tokens)
    for i in range(row, stop, 4):
        normalise(tokens, i, table.eps, x)
        for c in range(blocks):
            for t in range(4):
                h[i + t, c] = biases[1, c]
    for i in range(row, stop, 4):
        add_products(scratch_out.x_scalars, weights[1], i, h)
    for i in range(row, stop):
        for c in range(blocks):
            h[i, c] = gelu(h[i, c])
            tokens[i, c] = tokens[i, c] + biases[2, c]
    for i in range(row, stop, 4):
        add_products(scratch_out.h_scalars, weights[2], i, tokens)
    for i in range(row, stop, 4):
        normalise(tokens, i, table.eps, x)


class DecoderWeights(NamedTuple):
    """Weights of a decoder behind its attention, on the device of the table; shapes (out, in) as in `torch.nn`."""

    output: tuple[torch.Tensor, torch.Tensor]
    """O (C, C) and its bias (C,)."""
    norm: tuple[torch.Tensor, torch.Tensor]
    """Weight and bias (C,) of the feed-forward's layer norm."""
    hidden: tuple[torch.Tensor, torch.Tensor]
    """W₁ (C, C) and b₁ (C,)."""
    back: tuple[torch.Tensor, torch.Tensor]
    """W₂ (C, C) and b₂ (C,)."""
    head_norm: tuple[torch.Tensor, torch.Tensor]
    """Weight and bias (C,) of the head's layer norm."""
    score: tuple[torch.Tensor, torch.Tensor]
    """What the head says of a token: weight (N, C) and bias (N,), N = 1 for `fused_decode`, 10 for `fused_surfaces`."""

    def named(self) -> dict[str, torch.Tensor]:
        """Returns the tensors by the names that errors give them."""
        return {f"weights.{name}[{i}]": pair[i] for name, pair in self._asdict().items() for i in range(2)}


def blocks_of(weights: DecoderWeights, heads: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the matrices (3, C, C) and the biases (3, C) that `block` takes."""
    (gamma, beta), (w1, b1) = weights.norm, weights.hidden
    output = head_last(weights.output[0], heads)
    matrices = torch.stack((output.T, (w1 * gamma).T, weights.back[0].T))
    return matrices.float(), torch.stack((weights.output[1], w1 @ beta + b1, weights.back[1])).float()


def serves(projected: Projected) -> bool:
    """Whether `block` serves a table: float32 on a CPU, the paper's 8 heads, C a multiple of 16."""
    return fits(projected.pixels, torch.float32, len(projected.shift) // 3, projected.heads)


def check_served(projected: Projected) -> None:
    """Raises a ValueError unless `block` serves the table."""
    if not serves(projected):
        pixels, heads, channels = projected.pixels, projected.heads, len(projected.shift) // 3
        raise ValueError(
            f"projected is {pixels.dtype} on {pixels.device} with {heads} heads and {channels} channels; it should be "
            f"torch.float32 on cpu with {HEADS} heads and a multiple of {LANES} channels, or backend='torch'"
        )
