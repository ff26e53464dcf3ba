"""The first attention step with its projections hoisted from the queries to the pixels: the maths, for all kernels.

Gather the features z, embed the offset q as t = z + Wq + b, normalise, project to queries, keys and values, attend,
project back, add: t + O attend(M LN(t)). LayerNorm's mean and variance are polynomials in q whose coefficients belong
to the pixel. With Γ = diag(γ) and ᶜ for what is left after subtracting the mean over the C channels:

    t - mean = x + Wᶜ q,    x = (z + b)ᶜ
    σ² = (xᵀx + 2 qᵀu + qᵀ N q) / C + ε,    u = Wᶜᵀ x,    N = Wᶜᵀ Wᶜ
    qkv = (A + B q) / σ + c,    A = M Γ x,    B = M Γ Wᶜ,    c = M β

so the projection M is applied once per *pixel* (A) and not once per neighbour of each query, of which a frame of
128×2048 from 16×1024 has 64 times as many. It is the same function, rounded differently.

Backwards, with G the gradient of the attended values, P the attention map and S as in `kernels.attention`: the
gradients of q, k and v are S k, Sᵀ q and Pᵀ G; divided by σ they belong to A + B q; their products with A + B q add up
to the gradient of 1/σ, and so of xᵀx, u and N.

Channels are stored [d][head], so that consecutive ones belong to different heads. A CPU core takes 16 at a time, two d
of 8 heads (`kernels.lanes`), all heads in one group; a GPU thread takes one head, its neighbours the others, and each
head is a group.
"""

from typing import Any

import warp as wp

from kernels.lanes import exp2, fold, total, zeros4, zeros16
from kernels.stencil import Grid, neighbour, offset

__all__ = ["MOMENTS", "adj_squares", "affine", "attend", "attend_backward", "stencil"]

# Columns of the table of pixels after q, k, v and z: xᵀx, u and padding to a cache line.
MOMENTS = 16


@wp.func
def stencil(
    moments: wp.array2d[Any],
    queries: wp.array2d[Any],
    n: int,
    image: int,
    height: int,
    width: int,
    gram: wp.array2d[Any],
    channels: int,
    eps: Any,
    wrap: int,
):
    """For each neighbour of query n its pixel, the offset from it (down, right) and 1 / σ."""
    pixel = wp.vec4i()
    down = wp.vector(dtype=type(eps), length=4)
    right = wp.vector(dtype=type(eps), length=4)
    inverse = wp.vector(dtype=type(eps), length=4)
    grid = Grid()
    grid.height = height
    grid.width = width
    grid.wrap = wrap
    row = queries[n, 0]
    column = queries[n, 1]
    for t in range(4):
        i, j = neighbour(row, column, t, grid)
        dr, dc = offset(row, column, t, grid)
        p = (image * height + i) * width + j
        cross = dr * moments[p, 1] + dc * moments[p, 2]
        squares = moments[p, 0] + cross + cross
        squares = squares + dr * (gram[0, 0] * dr + (gram[0, 1] + gram[1, 0]) * dc) + dc * dc * gram[1, 1]
        pixel[t] = p
        down[t] = dr
        right[t] = dc
        inverse[t] = type(eps)(1.0) / wp.sqrt(squares / type(eps)(channels) + eps)
    return pixel, down, right, inverse


@wp.func
def affine(pixels: wp.array2d[Any], slope: wp.array2d[Any], p: int, c: int, down: Any, right: Any):
    """Lanes c of A + B q, or of z + Wq + b."""
    return pixels[p, c] + slope[0, c] * down + slope[1, c] * right


@wp.func
def attention_map(
    pixels: wp.array2d[Any],
    slope: wp.array2d[Any],
    shift: wp.array[Any],
    pixel: wp.vec4i,
    down: Any,
    right: Any,
    inverse: Any,
    heads: int,
    groups: int,
    g: int,
    four: int,
):
    """P of the heads of group g, row 4 i + j for how neighbour i attends to neighbour j."""
    zero = pixels.dtype()
    blocks = shift.shape[0] // 3
    logits = zeros16(zero)
    for c in range(g, blocks, groups):
        q = zeros4(zero)
        k = zeros4(zero)
        for t in range(4):
            q[t] = affine(pixels, slope, pixel[t], c, down[t], right[t]) * inverse[t] + shift[c]
            k[t] = affine(pixels, slope, pixel[t], blocks + c, down[t], right[t]) * inverse[t] + shift[blocks + c]
        for i in range(4):
            for j in range(4):
                logits[4 * i + j] += wp.cw_mul(q[i], k[j])
    width = blocks * len(zero) // heads
    scale = type(inverse[0])(1.4426950408889634) / wp.sqrt(type(inverse[0])(width))  # log2(e) / √D
    p = logits
    for i in range(four):
        l0 = fold(p[4 * i]) * scale
        l1 = fold(p[4 * i + 1]) * scale
        l2 = fold(p[4 * i + 2]) * scale
        l3 = fold(p[4 * i + 3]) * scale
        largest = wp.max(wp.max(l0, l1), wp.max(l2, l3))
        l0 = exp2(l0 - largest)
        l1 = exp2(l1 - largest)
        l2 = exp2(l2 - largest)
        l3 = exp2(l3 - largest)
        whole = (l0 + l1) + (l2 + l3)
        p[4 * i] = wp.cw_div(l0, whole)
        p[4 * i + 1] = wp.cw_div(l1, whole)
        p[4 * i + 2] = wp.cw_div(l2, whole)
        p[4 * i + 3] = wp.cw_div(l3, whole)
    return p


@wp.func
def attend(
    pixels: wp.array2d[Any],
    slope: wp.array2d[Any],
    shift: wp.array[Any],
    pixel: wp.vec4i,
    down: Any,
    right: Any,
    inverse: Any,
    heads: int,
    groups: int,
    g: int,
    four: int,
    row: int,
    # out
    tokens_out: wp.array2d[Any],
    attended_out: wp.array2d[Any],
):
    """Writes rows `row` to `row` + 3, one for each neighbour: t, and what its heads of group g attend to."""
    blocks = shift.shape[0] // 3
    p = attention_map(pixels, slope, shift, pixel, down, right, inverse, heads, groups, g, four)
    for c in range(g, blocks, groups):
        v = zeros4(pixels.dtype())
        for t in range(4):
            value = affine(pixels, slope, pixel[t], 2 * blocks + c, down[t], right[t])
            v[t] = value * inverse[t] + shift[2 * blocks + c]
        for t in range(4):
            mixed = wp.cw_mul(p[4 * t], v[0]) + wp.cw_mul(p[4 * t + 1], v[1])
            mixed = mixed + wp.cw_mul(p[4 * t + 2], v[2]) + wp.cw_mul(p[4 * t + 3], v[3])
            attended_out[row + t, c] = mixed
            token = affine(pixels, slope, pixel[t], 3 * blocks + c, down[t], right[t])
            tokens_out[row + t, c] = token


@wp.func
def attend_backward(
    pixels: wp.array2d[Any],
    slope: wp.array2d[Any],
    shift: wp.array[Any],
    pixel: wp.vec4i,
    down: Any,
    right: Any,
    inverse: Any,
    heads: int,
    groups: int,
    g: int,
    four: int,
    adj_tokens: wp.array2d[Any],
    adj_attended: wp.array2d[Any],
    row: int,
    # out
    adj_pixels_out: wp.array2d[Any],
    attended_out: wp.array2d[Any],
):
    """Reads and writes rows `row` to `row` + 3, one for each neighbour, in the heads of group g.

    Writes the gradients of A + B q and of z + Wq + b, and again what was attended to; returns the gradients of 1/σ.
    """
    zero = pixels.dtype()
    blocks = shift.shape[0] // 3
    p = attention_map(pixels, slope, shift, pixel, down, right, inverse, heads, groups, g, four)

    adj_inverse = zeros4(zero)
    adj_p = zeros16(zero)
    for c in range(g, blocks, groups):
        gradient = zeros4(zero)
        v = zeros4(zero)
        for t in range(four):
            gradient[t] = adj_attended[row + t, c]
            v[t] = affine(pixels, slope, pixel[t], 2 * blocks + c, down[t], right[t])
        v0 = v[0] * inverse[0] + shift[2 * blocks + c]
        v1 = v[1] * inverse[1] + shift[2 * blocks + c]
        v2 = v[2] * inverse[2] + shift[2 * blocks + c]
        v3 = v[3] * inverse[3] + shift[2 * blocks + c]
        for i in range(four):
            adj_p[4 * i] += wp.cw_mul(gradient[i], v0)
            adj_p[4 * i + 1] += wp.cw_mul(gradient[i], v1)
            adj_p[4 * i + 2] += wp.cw_mul(gradient[i], v2)
            adj_p[4 * i + 3] += wp.cw_mul(gradient[i], v3)
        for t in range(four):
            adj_v = wp.cw_mul(p[t], gradient[0]) + wp.cw_mul(p[4 + t], gradient[1])
            adj_v = adj_v + wp.cw_mul(p[8 + t], gradient[2]) + wp.cw_mul(p[12 + t], gradient[3])
            adj_inverse[t] += wp.cw_mul(adj_v, v[t])
            adj_pixels_out[row + t, 2 * blocks + c] = adj_v * inverse[t]
            mixed = wp.cw_mul(p[4 * t], v0) + wp.cw_mul(p[4 * t + 1], v1)
            attended_out[row + t, c] = mixed + wp.cw_mul(p[4 * t + 2], v2) + wp.cw_mul(p[4 * t + 3], v3)
            adj_pixels_out[row + t, 3 * blocks + c] = adj_tokens[row + t, c]

    scale = type(inverse[0])(1.0) / wp.sqrt(type(inverse[0])(blocks * len(zero) // heads))
    s = adj_p
    for i in range(four):
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

    for c in range(g, blocks, groups):
        q = zeros4(zero)
        k = zeros4(zero)
        for t in range(4):
            q[t] = affine(pixels, slope, pixel[t], c, down[t], right[t])
            k[t] = affine(pixels, slope, pixel[t], blocks + c, down[t], right[t])
        q0 = q[0] * inverse[0] + shift[c]
        q1 = q[1] * inverse[1] + shift[c]
        q2 = q[2] * inverse[2] + shift[c]
        q3 = q[3] * inverse[3] + shift[c]
        k0 = k[0] * inverse[0] + shift[blocks + c]
        k1 = k[1] * inverse[1] + shift[blocks + c]
        k2 = k[2] * inverse[2] + shift[blocks + c]
        k3 = k[3] * inverse[3] + shift[blocks + c]
        for t in range(four):
            adj_q = wp.cw_mul(s[4 * t], k0) + wp.cw_mul(s[4 * t + 1], k1)
            adj_q = adj_q + wp.cw_mul(s[4 * t + 2], k2) + wp.cw_mul(s[4 * t + 3], k3)
            adj_k = wp.cw_mul(s[t], q0) + wp.cw_mul(s[4 + t], q1)
            adj_k = adj_k + wp.cw_mul(s[8 + t], q2) + wp.cw_mul(s[12 + t], q3)
            adj_inverse[t] += wp.cw_mul(adj_q, q[t]) + wp.cw_mul(adj_k, k[t])
            adj_pixels_out[row + t, c] = adj_q * inverse[t]
            adj_pixels_out[row + t, blocks + c] = adj_k * inverse[t]

    sums = inverse
    for t in range(four):
        sums[t] = total(adj_inverse[t])[0]
    return sums


@wp.func
def adj_squares(adj_inverse: Any, inverse: Any, channels: int):
    """Gradient of C (σ² - ε) from that of 1/σ."""
    half = type(inverse)(-0.5) / type(inverse)(channels)
    return adj_inverse * inverse * inverse * inverse * half
