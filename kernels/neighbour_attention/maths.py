"""The attention step with its projections moved from the queries to the pixels: the maths that all kernels share.

The step (paper, Fig. 3b) takes the features z of the 4 neighbours of a query, adds an embedding of the offset q,
normalises, projects to queries, keys and values, attends, projects back, and adds: with t = z + Wq + b, the result is
t + O attend(M LN(t)) + the bias of O. The mean and the variance in the layer norm LN are polynomials in q, whose
coefficients belong to the pixel. Let Γ = diag(γ), and let ᶜ mark what is left after subtracting the mean over the C
channels:

    t - mean = x + Wᶜ q,    x = (z + b)ᶜ
    σ² = (xᵀx + 2 qᵀu + qᵀ N q) / C + ε,    u = Wᶜᵀ x,    N = Wᶜᵀ Wᶜ
    qkv = (A + B q) / σ + c,    A = M Γ x,    B = M Γ Wᶜ,    c = M β

So the projection M is applied once for each pixel (A), not once for each neighbour of each query. A frame of 128×2048
from 16×1024 has 64 times as many of those. The function is the same, only rounded differently.

Where the symbols are found: `PixelTable.pixels` holds A and z + b; `moments` holds xᵀx and u; `slope` holds B and W;
`shift` is c and `gram` is N. `Stencil.down` and `Stencil.right` are the two components of q, and `inverse` is 1/σ.

Backwards, let G be the gradient of the attended values, P the attention map and S as in `kernels.attention`. The
gradients of q, k and v are S k, Sᵀ q and Pᵀ G. Divided by σ they are the gradients of A + B q. Multiplied by A + B q
and summed they are the gradient of 1/σ, and from that follow those of xᵀx, u and N.

Channels are stored [d][head]: channel d of all heads, then channel d + 1 of all heads. A CPU core takes 16 channels at
a time as the lanes of a vector (`kernels.lanes`), which are two d of 8 heads, and computes all heads together. A GPU
thread takes one head, and the threads beside it take the others.
"""

from typing import Any

import warp as wp

from kernels.checks import FARTHEST
from kernels.lanes import LANES, add_product, fold, softmax4, total, vectors, zeros4, zeros16
from kernels.stencil import Grid, neighbour, offset

__all__ = [
    "MOMENTS",
    "PIXEL_TABLES",
    "ROLLED_FOUR",
    "adj_squares",
    "attend",
    "attend_backward",
    "stencil",
]

# Columns in a row of the table after q, k, v and z: xᵀx, u, and padding to a cache line.
MOMENTS = 16

_FARTHEST = wp.constant(FARTHEST)

# A 4 that the compiler does not know, since it reaches a kernel at run time. Loops over `range(rolled_four)` stay
# loops: when they are unrolled, they take long to compile and become fewer SIMD instructions.
ROLLED_FOUR = 4


def _stencil_type(scalar: Any) -> Any:
    four: Any = wp.types.vector(4, scalar)

    @wp.struct
    class Stencil:
        """The 4 neighbours of a query; component t of each vector belongs to neighbour t."""

        pixel: wp.vec4i
        """Row of the neighbour in `PixelTable.pixels`."""
        down: four
        """Offset, query minus neighbour, in rows: the first component of q."""
        right: four
        """Offset in columns: the second component of q."""
        squares: four
        """C (σ² - ε) as computed; rounding may take it below 0, and then 0 stands for it."""
        inverse: four
        """Reciprocal of the standard deviation of t over its channels, with ε under the root."""

    return Stencil


def _pixel_table_type(lane: Any, scalar: Any) -> Any:
    @wp.struct
    class PixelTable:
        """A `Projected` (`kernels.neighbour_attention.table`) as a kernel's argument.

        Channels are counted in vectors of lanes: `blocks` = C / lanes.
        """

        pixels: wp.array2d[lane]
        """(B·H·W, 4·blocks and padding): queries, keys and values of A, then z + b."""
        moments: wp.array2d[scalar]
        """(B·H·W, 3): xᵀx and the two components of u."""
        slope: wp.array2d[lane]
        """(2, 4·blocks): what a pixel of offset down, and one to the right, adds to `pixels`: Bᵀ, then Wᵀ."""
        shift: wp.array[lane]
        """(3·blocks,): c."""
        gram: wp.array2d[scalar]
        """(2, 2): N."""
        grid: Grid
        """H, W and whether columns wrap."""
        per_image: int
        """Number of queries of each image."""
        channels: int
        """C."""
        heads: int
        """Number of heads."""
        groups: int
        """Groups of heads; a thread handles one. Group g has the blocks g, g + groups, ... of channels."""
        eps: scalar
        """ε of the layer norm."""
        rolled_four: int
        """`ROLLED_FOUR`."""

    return PixelTable


_Stencil, _StencilDouble = _stencil_type(wp.float32), _stencil_type(wp.float64)

# The type of the table for each type of vector.
PIXEL_TABLES = {
    vectors(lanes, scalar): _pixel_table_type(vectors(lanes, scalar), scalar)
    for lanes, scalar in ((LANES, wp.float32), (1, wp.float32), (1, wp.float64))
}


@wp.func
def _empty_stencil(like: wp.float32):
    return _Stencil()


@wp.func  # type: ignore[no-redef]
def _empty_stencil(like: wp.float64):
    return _StencilDouble()


@wp.func
def _within(coordinate: Any):
    """A coordinate no farther out than `FARTHEST`; NaN stays."""
    farthest = type(coordinate)(_FARTHEST)
    coordinate = wp.where(coordinate > farthest, farthest, coordinate)
    return wp.where(coordinate < -farthest, -farthest, coordinate)


@wp.func
def stencil(table: Any, queries: wp.array2d[Any], n: int):
    """The `Stencil` of query n, of all images' queries, in a `PixelTable`."""
    around = _empty_stencil(table.eps)
    row = _within(queries[n, 0])
    column = _within(queries[n, 1])
    gram = table.gram
    for t in range(4):
        i, j = neighbour(row, column, t, table.grid)
        down, right = offset(row, column, t, table.grid)
        p = (n // table.per_image * table.grid.height + i) * table.grid.width + j
        cross = down * table.moments[p, 1] + right * table.moments[p, 2]
        squares = table.moments[p, 0] + cross + cross
        squares += down * (gram[0, 0] * down + (gram[0, 1] + gram[1, 0]) * right) + right * right * gram[1, 1]
        variance = wp.max(squares, type(squares)(0.0)) / type(squares)(table.channels)
        around.pixel[t] = p
        around.down[t] = down
        around.right[t] = right
        around.squares[t] = squares
        around.inverse[t] = type(squares)(1.0) / wp.sqrt(variance + table.eps)
    return around


@wp.func
def _affine(table: Any, around: Any, t: int, c: int):
    """Block c of A + B q, or of z + Wq + b, for neighbour t."""
    still = add_product(table.pixels[around.pixel[t], c], table.slope[0, c], around.down[t])
    return add_product(still, table.slope[1, c], around.right[t])


@wp.func
def _attention_map(
    table: Any,
    around: Any,
    g: int,
):
    """P of the heads of group g: row 4 i + j is the weight that neighbour i gives to neighbour j."""
    zero = table.pixels.dtype()
    blocks = table.shift.shape[0] // 3
    logits = zeros16(zero)
    for c in range(g, blocks, table.groups):
        q = zeros4(zero)
        k = zeros4(zero)
        for t in range(4):
            q[t] = add_product(table.shift[c], _affine(table, around, t, c), around.inverse[t])
            k[t] = add_product(table.shift[blocks + c], _affine(table, around, t, blocks + c), around.inverse[t])
        for i in range(4):
            for j in range(4):
                logits[4 * i + j] = add_product(logits[4 * i + j], q[i], k[j])
    log2_e = type(table.eps)(1.4426950408889634)
    scale = log2_e / wp.sqrt(type(table.eps)(table.channels // table.heads))
    p = logits
    for i in range(4):
        weights = softmax4(p[4 * i], p[4 * i + 1], p[4 * i + 2], p[4 * i + 3], scale)
        for j in range(4):
            p[4 * i + j] = weights[j]
    return p


@wp.func
def attend(
    table: Any,
    around: Any,
    g: int,
    row: int,
    # out
    tokens_out: wp.array2d[Any],
    attended_out: wp.array2d[Any],
):
    """Writes t and the attended values of the heads of group g to rows `row` to `row` + 3, one for each neighbour."""
    blocks = table.shift.shape[0] // 3
    p = _attention_map(table, around, g)
    for c in range(g, blocks, table.groups):
        v = zeros4(table.pixels.dtype())
        for t in range(4):
            value = _affine(table, around, t, 2 * blocks + c)
            v[t] = add_product(table.shift[2 * blocks + c], value, around.inverse[t])
        for t in range(4):
            mixed = wp.cw_mul(p[4 * t], v[0])
            for j in range(1, 4):
                mixed = add_product(mixed, p[4 * t + j], v[j])
            attended_out[row + t, c] = mixed
            token = _affine(table, around, t, 3 * blocks + c)
            tokens_out[row + t, c] = token


@wp.func
def attend_backward(
    table: Any,
    around: Any,
    g: int,
    row: int,
    adj_tokens: wp.array2d[Any],
    adj_attended: wp.array2d[Any],
    # out
    adj_rows_out: wp.array2d[Any],
    attended_out: wp.array2d[Any],
):
    """Writes the gradients of A + B q and of z + Wq + b, and the attended values again; returns those of 1/σ.

    It handles the heads of group g. All arrays have a row for each neighbour: `row` to `row` + 3.
    """
    zero = table.pixels.dtype()
    blocks = table.shift.shape[0] // 3
    p = _attention_map(table, around, g)

    adj_inverse = zeros4(zero)
    adj_p = zeros16(zero)
    for c in range(g, blocks, table.groups):
        gradient = zeros4(zero)
        v = zeros4(zero)
        for t in range(table.rolled_four):
            gradient[t] = adj_attended[row + t, c]
            v[t] = _affine(table, around, t, 2 * blocks + c)
        v0 = v[0] * around.inverse[0] + table.shift[2 * blocks + c]
        v1 = v[1] * around.inverse[1] + table.shift[2 * blocks + c]
        v2 = v[2] * around.inverse[2] + table.shift[2 * blocks + c]
        v3 = v[3] * around.inverse[3] + table.shift[2 * blocks + c]
        for i in range(table.rolled_four):
            adj_p[4 * i] += wp.cw_mul(gradient[i], v0)
            adj_p[4 * i + 1] += wp.cw_mul(gradient[i], v1)
            adj_p[4 * i + 2] += wp.cw_mul(gradient[i], v2)
            adj_p[4 * i + 3] += wp.cw_mul(gradient[i], v3)
        for t in range(table.rolled_four):
            adj_v = wp.cw_mul(p[t], gradient[0]) + wp.cw_mul(p[4 + t], gradient[1])
            adj_v = adj_v + wp.cw_mul(p[8 + t], gradient[2]) + wp.cw_mul(p[12 + t], gradient[3])
            adj_inverse[t] += wp.cw_mul(adj_v, v[t])
            adj_rows_out[row + t, 2 * blocks + c] = adj_v * around.inverse[t]
            mixed = wp.cw_mul(p[4 * t], v0) + wp.cw_mul(p[4 * t + 1], v1)
            attended_out[row + t, c] = mixed + wp.cw_mul(p[4 * t + 2], v2) + wp.cw_mul(p[4 * t + 3], v3)
            adj_rows_out[row + t, 3 * blocks + c] = adj_tokens[row + t, c]

    scale = type(table.eps)(1.0) / wp.sqrt(type(table.eps)(table.channels // table.heads))
    s = adj_p
    for i in range(table.rolled_four):
        s0 = fold(s[4 * i])
        s1 = fold(s[4 * i + 1])
        s2 = fold(s[4 * i + 2])
        s3 = fold(s[4 * i + 3])
        mean = wp.cw_mul(p[4 * i], s0) + wp.cw_mul(p[4 * i + 1], s1)
        mean = mean + wp.cw_mul(p[4 * i + 2], s2) + wp.cw_mul(p[4 * i + 3], s3)
        s[4 * i] = wp.cw_mul(p[4 * i], s0 - mean) * scale
        s[4 * i + 1] = wp.cw_mul(p[4 * i + 1], s1 - mean) * scale
        s[4 * i + 2] = wp.cw_mul(p[4 * i + 2], s2 - mean) * scale
        s[4 * i + 3] = wp.cw_mul(p[4 * i + 3], s3 - mean) * scale

    for c in range(g, blocks, table.groups):
        q = zeros4(zero)
        k = zeros4(zero)
        for t in range(4):
            q[t] = _affine(table, around, t, c)
            k[t] = _affine(table, around, t, blocks + c)
        q0 = q[0] * around.inverse[0] + table.shift[c]
        q1 = q[1] * around.inverse[1] + table.shift[c]
        q2 = q[2] * around.inverse[2] + table.shift[c]
        q3 = q[3] * around.inverse[3] + table.shift[c]
        k0 = k[0] * around.inverse[0] + table.shift[blocks + c]
        k1 = k[1] * around.inverse[1] + table.shift[blocks + c]
        k2 = k[2] * around.inverse[2] + table.shift[blocks + c]
        k3 = k[3] * around.inverse[3] + table.shift[blocks + c]
        for t in range(table.rolled_four):
            adj_q = wp.cw_mul(s[4 * t], k0) + wp.cw_mul(s[4 * t + 1], k1)
            adj_q = adj_q + wp.cw_mul(s[4 * t + 2], k2) + wp.cw_mul(s[4 * t + 3], k3)
            adj_k = wp.cw_mul(s[t], q0) + wp.cw_mul(s[4 + t], q1)
            adj_k = adj_k + wp.cw_mul(s[8 + t], q2) + wp.cw_mul(s[12 + t], q3)
            adj_inverse[t] += wp.cw_mul(adj_q, q[t]) + wp.cw_mul(adj_k, k[t])
            adj_rows_out[row + t, c] = adj_q * around.inverse[t]
            adj_rows_out[row + t, blocks + c] = adj_k * around.inverse[t]

    sums = around.inverse
    for t in range(table.rolled_four):
        sums[t] = total(adj_inverse[t])[0]
    return sums


@wp.func
def adj_squares(table: Any, around: Any, t: int, adj_inverse: Any):
    """The gradient of C (σ² - ε) from that of 1/σ, for neighbour t."""
    if around.squares[t] < type(table.eps)(0.0):
        return type(table.eps)(0.0)  # σ is √ε, whatever the squares
    inverse = around.inverse[t]
    half = type(table.eps)(-0.5) / type(table.eps)(table.channels)
    return adj_inverse * inverse * inverse * inverse * half
