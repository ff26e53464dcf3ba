"""Lanes: the components of a vector, to each of which the same scalar function is applied.

A CPU is fast when it loads, computes and stores whole vectors. Warp's CPU compiler makes SIMD instructions of functions
of `wp.types.vector`s if no component is addressed by a run-time index. Loops over such functions should stay loops:
unrolled ones take long to compile and become fewer SIMD instructions. On a GPU each thread is a lane already, so that a
vector has length 1.
"""

from typing import Any

import warp as wp

__all__ = [
    "LANES",
    "add_outer",
    "add_product",
    "add_products",
    "exp2",
    "fold",
    "gelu",
    "rsqrt",
    "softmax4",
    "softplus",
    "total",
    "totals4",
    "vectors",
    "where_less",
    "zeros4",
    "zeros16",
]

# 16 float32 are a cache line, and a register of AVX-512.
LANES = 16

# What native functions begin with: clang, which compiles them for CPUs, then computes whole vectors.
_FLOATS = """
    typedef float floats __attribute__((vector_size(64), aligned(4)));
    typedef int ints __attribute__((vector_size(64), aligned(4)));
"""

_wide = wp.types.vector(LANES, wp.float32)
_one = wp.types.vector(1, wp.float32)
_one_double = wp.types.vector(1, wp.float64)


def vectors(lanes: int, scalar: type) -> type:
    """Returns the type of a vector of lanes: `LANES` of float32, or 1 of float32 or float64."""
    return {(LANES, wp.float32): _wide, (1, wp.float32): _one, (1, wp.float64): _one_double}[lanes, scalar]


@wp.func
def _exp2(x: wp.float32):
    """2^x for x <= 0: the nearest power of two as bits, times a polynomial on [-1/2, 1/2] that is 1 at 0.

    Relative error 1e-7, 0 below 2^-126, NaN stays; the coefficients are our own minimax fit. Far faster than `wp.exp`,
    which no compiler turns into SIMD instructions.
    """
    n = wp.floor(wp.max(x, -126.0) + 0.5)
    f = x - n
    p = 1.535336206e-4 * f + 1.339887456e-3
    p = p * f + 9.618437358e-3
    p = p * f + 5.550332471e-2
    p = p * f + 2.402264791e-1
    p = p * f + 6.931472029e-1
    p = p * f + 1.0
    return wp.where(x < -126.0, 0.0, p * wp.cast((int(n) + 127) << 23, wp.float32))


@wp.func
def _exp2(x: wp.float64):
    return wp.pow(wp.float64(2.0), x)


@wp.func
def exp2(x: Any):
    """2^x in each lane, for x <= 0."""
    y = type(x)()
    for i in range(len(x)):
        y[i] = _exp2(x[i])
    return y


@wp.func
def _softplus(x: wp.float32):
    """log(1 + e^x): the larger of x and 0, and 2 artanh z of z = e / (2 + e) with e = e^-|x|, by its series.

    Relative error 2e-7; no call of `wp.log`, for the same reason as in `_exp2`.
    """
    e = _exp2(-1.442695041 * wp.abs(x))
    z = e / (2.0 + e)
    s = z * z
    p = 0.1 * s + 0.1111111111
    p = p * s + 0.1428571429
    p = p * s + 0.2
    p = p * s + 0.3333333333
    return wp.max(x, 0.0) + 2.0 * z * (p * s + 1.0)


@wp.func
def _softplus(x: wp.float64):
    return wp.max(x, wp.float64(0.0)) + wp.log(wp.float64(1.0) + wp.exp(-wp.abs(x)))


@wp.func
def softplus(x: Any):
    """The function log(1 + e^x) in each lane."""
    y = type(x)()
    for i in range(len(x)):
        y[i] = _softplus(x[i])
    return y


@wp.func
def rsqrt(x: Any):
    """1 / √x in each lane."""
    y = type(x)()
    for i in range(len(x)):
        y[i] = type(x[0])(1.0) / wp.sqrt(x[i])
    return y


@wp.func
def gelu(x: Any):
    """The function x Φ(x) in each lane, with erf after Abramowitz and Stegun 7.1.26: absolute error 2e-7 |x|."""
    y = type(x)()
    for i in range(len(x)):
        a = wp.abs(x[i]) * 0.7071067812
        t = 1.0 / (1.0 + 0.3275911 * a)
        p = 1.061405429 * t - 1.453152027
        p = p * t + 1.421413741
        p = p * t - 0.284496736
        p = p * t + 0.254829592
        y[i] = 0.5 * (x[i] + wp.abs(x[i]) * (1.0 - p * t * _exp2(-1.442695041 * a * a)))
    return y


@wp.func_native(
    """
    wp::vec_t<16, wp::float32> chosen;
#if defined(__clang__)
"""
    + _FLOATS
    + """    const ints less = *(const floats*)&a.c[0] < *(const floats*)&b.c[0];
    *(floats*)&chosen.c[0] = (floats)((*(const ints*)&x.c[0] & less) | (*(const ints*)&y.c[0] & ~less));
#else
    for (int i = 0; i < 16; ++i) chosen.c[i] = a.c[i] < b.c[i] ? x.c[i] : y.c[i];
#endif
    return chosen;
"""
)
def _where_less(a: _wide, b: _wide, x: _wide, y: _wide) -> _wide:
    """As `where_less`. It becomes two SIMD instructions; 16 calls of `wp.where` take long to compile."""


@wp.func
def where_less(a: _wide, b: _wide, x: _wide, y: _wide):
    """In each lane x where a < b, else y; y where a or b is NaN."""
    return _where_less(a, b, x, y)


@wp.func
def where_less(a: Any, b: Any, x: Any, y: Any):  # noqa: F811
    """There is one lane."""
    return wp.where(a[0] < b[0], x, y)


@wp.func
def zeros4(zero: Any):
    """A matrix of 4 rows of lanes."""
    return wp.matrix_from_rows(zero, zero, zero, zero)


@wp.func
def zeros16(zero: Any):
    """A matrix of 16 rows of lanes."""
    return wp.matrix_from_rows(
        zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero
    )


@wp.func_native("""
    for (int i = 0; i < 16; ++i) sum.c[i] = fmaf(x.c[i], factor, sum.c[i]);
    return sum;
""")
def _add_product(sum: _wide, x: _wide, factor: float) -> _wide:
    """Adds x · factor, rounded once: a fused multiply-add, which Warp does not make of two operations.

    Written like this, 16 sums stay in registers; single sums are faster with `add_product`.
    """


@wp.func_native(
    """
#if defined(__clang__)
"""
    + _FLOATS
    + """    *(floats*)&sum.c[0] = *(const floats*)&x.c[0] * factor + *(const floats*)&sum.c[0];
#else
    for (int i = 0; i < 16; ++i) sum.c[i] = fmaf(x.c[i], factor, sum.c[i]);
#endif
    return sum;
"""
)
def _add_product_to(sum: _wide, x: _wide, factor: float) -> _wide:
    """As `add_product`."""


@wp.func_native(
    """
#if defined(__clang__)
"""
    + _FLOATS
    + """    *(floats*)&sum.c[0] = *(const floats*)&x.c[0] * *(const floats*)&y.c[0] + *(const floats*)&sum.c[0];
#else
    for (int i = 0; i < 16; ++i) sum.c[i] = fmaf(x.c[i], y.c[i], sum.c[i]);
#endif
    return sum;
"""
)
def _add_product_of(sum: _wide, x: _wide, y: _wide) -> _wide:
    """As `add_product`."""


@wp.func
def add_product(sum: _wide, x: _wide, factor: wp.float32):
    """The sum plus x · factor in each lane, rounded once: a fused multiply-add."""
    return _add_product_to(sum, x, factor)


@wp.func
def add_product(sum: _wide, x: _wide, factor: _wide):  # noqa: F811
    """The factor may differ between lanes."""
    return _add_product_of(sum, x, factor)


@wp.func
def add_product(sum: _one, x: _one, factor: wp.float32):  # noqa: F811
    """There is one lane."""
    return sum + x * factor


@wp.func
def add_product(sum: _one, x: _one, factor: _one):  # noqa: F811
    """There is one lane."""
    return sum + wp.cw_mul(x, factor)


@wp.func
def add_product(sum: _one_double, x: _one_double, factor: wp.float64):  # noqa: F811
    """There is one lane."""
    return sum + x * factor


@wp.func
def add_product(sum: _one_double, x: _one_double, factor: _one_double):  # noqa: F811
    """There is one lane."""
    return sum + wp.cw_mul(x, factor)


@wp.func
def add_products(x: wp.array2d[float], weight: wp.array2d[_wide], row: int, y_out: wp.array2d[_wide]):
    """Adds X W to Y in rows `row` to `row` + 3. W (K, N) is counted in vectors; X is read as numbers."""
    fours = weight.shape[1] // 4 * 4
    for block in range(0, fours, 4):
        y = zeros16(_wide())
        for t in range(4):
            for b in range(4):
                y[4 * t + b] = y_out[row + t, block + b]
        for k in range(weight.shape[0]):
            for b in range(4):
                w = weight[k, block + b]
                for t in range(4):
                    y[4 * t + b] = _add_product(y[4 * t + b], w, x[row + t, k])
        for t in range(4):
            for b in range(4):
                y_out[row + t, block + b] = y[4 * t + b]
    for block in range(fours, weight.shape[1]):
        z = zeros4(_wide())
        odd = zeros4(_wide())  # with sums of their own for odd k, 8 chains of additions hide their latency
        for t in range(4):
            z[t] = y_out[row + t, block]
        for k in range(0, weight.shape[0], 4):  # 4 at a time, since a loop costs as much as some products
            for even in range(0, 4, 2):
                w = weight[k + even, block]
                v = weight[k + even + 1, block]
                for t in range(4):
                    z[t] = add_product(z[t], w, x[row + t, k + even])
                    odd[t] = add_product(odd[t], v, x[row + t, k + even + 1])
        for t in range(4):
            y_out[row + t, block] = z[t] + odd[t]


@wp.func
def add_outer(x: wp.array2d[float], y: wp.array2d[_wide], row: int, first: int, weight_out: wp.array2d[_wide]):
    """Adds Xᵀ Y of rows `row` to `row` + 3 to W (K, N), whose rows begin at `first`; shapes as in `add_products`."""
    fours = y.shape[1] // 4 * 4
    for block in range(0, fours, 4):
        rows = zeros16(_wide())
        for t in range(4):
            for b in range(4):
                rows[4 * t + b] = y[row + t, block + b]
        for k in range(x.shape[1]):
            for b in range(4):
                w = weight_out[first + k, block + b]
                for t in range(4):
                    w = _add_product(w, rows[4 * t + b], x[row + t, k])
                weight_out[first + k, block + b] = w
    for block in range(fours, y.shape[1]):
        some = zeros4(_wide())
        for t in range(4):
            some[t] = y[row + t, block]
        for k in range(x.shape[1]):
            w = weight_out[first + k, block]
            for t in range(4):
                w = _add_product(w, some[t], x[row + t, k])
            weight_out[first + k, block] = w


@wp.func
def fold(x: _wide):
    """Sums what belongs to one head: lanes i and i + 8 hold two channels of head i, and both get the sum."""
    y = type(x)()
    for i in range(16):
        y[i] = x[(i + 8) % 16]
    return x + y


@wp.func
def fold(x: _one):  # noqa: F811
    """There is one lane."""
    return x


@wp.func
def fold(x: _one_double):  # noqa: F811
    """There is one lane."""
    return x


@wp.func_native(
    """
#if defined(__clang__)
"""
    + _FLOATS
    + """    const floats p = *(const floats*)&a.c[0], q = *(const floats*)&b.c[0];
    const floats r = *(const floats*)&c.c[0], s = *(const floats*)&d.c[0];
    const floats pq = __builtin_shufflevector(p, q, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23)
        + __builtin_shufflevector(p, q, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
    const floats rs = __builtin_shufflevector(r, s, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23)
        + __builtin_shufflevector(r, s, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
    floats all = __builtin_shufflevector(pq, rs, 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27)
        + __builtin_shufflevector(pq, rs, 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31);
    all += __builtin_shufflevector(all, all, 2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9, 14, 15, 12, 13);
    all += __builtin_shufflevector(all, all, 1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14);
    wp::vec_t<16, wp::float32> sums;
    *(floats*)&sums.c[0] = all;
#else
    wp::vec_t<16, wp::float32> sums(0.0f);
    for (int i = 0; i < 16; ++i) {
        for (int n = 0; n < 4; ++n) {
            sums.c[n] += a.c[i];
            sums.c[4 + n] += b.c[i];
            sums.c[8 + n] += c.c[i];
            sums.c[12 + n] += d.c[i];
        }
    }
#endif
    return sums;
"""
)
def totals4(a: _wide, b: _wide, c: _wide, d: _wide) -> _wide:
    """The sums over all lanes of 4 vectors, in 4 lanes each, in a third of the instructions of 4 calls of `total`."""


_four_wide = wp.types.matrix((4, LANES), wp.float32)


@wp.func_native(
    """
    wp::mat_t<4, 16, wp::float32> weights;
#if defined(__clang__)
"""
    + _FLOATS
    + """    const floats p = *(const floats*)&a.c[0], q = *(const floats*)&b.c[0];
    const floats r = *(const floats*)&c.c[0], s = *(const floats*)&d.c[0];
    floats x[2] = {
        __builtin_shufflevector(p, q, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23)
            + __builtin_shufflevector(p, q, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31),
        __builtin_shufflevector(r, s, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23)
            + __builtin_shufflevector(r, s, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31)};
    ints more = x[0] < x[1];
    floats largest = (floats)(((ints)x[1] & more) | ((ints)x[0] & ~more));
    const floats other =
        __builtin_shufflevector(largest, largest, 8, 9, 10, 11, 12, 13, 14, 15, 0, 1, 2, 3, 4, 5, 6, 7);
    more = largest < other;
    largest = (floats)(((ints)other & more) | ((ints)largest & ~more));
    for (int n = 0; n < 2; ++n) {
        floats y = (x[n] - largest) * scale;
        const ints low = y < -126.0f;
        y = (floats)(((ints)(y * 0.0f - 126.0f) & low) | ((ints)y & ~low));
        const floats shifted = y + 12582912.0f;
        const floats f = y - (shifted - 12582912.0f);
        floats e = 1.535336206e-4f * f + 1.339887456e-3f;
        e = e * f + 9.618437358e-3f;
        e = e * f + 5.550332471e-2f;
        e = e * f + 2.402264791e-1f;
        e = e * f + 6.931472029e-1f;
        e = e * f + 1.0f;
        x[n] = (floats)((ints)e + ((ints)shifted << 23));
    }
    floats whole = x[0] + x[1];
    whole += __builtin_shufflevector(whole, whole, 8, 9, 10, 11, 12, 13, 14, 15, 0, 1, 2, 3, 4, 5, 6, 7);
    whole = 1.0f / whole;
    for (int n = 0; n < 2; ++n) {
        x[n] *= whole;
        *(floats*)&weights.data[2 * n][0] =
            __builtin_shufflevector(x[n], x[n], 0, 1, 2, 3, 4, 5, 6, 7, 0, 1, 2, 3, 4, 5, 6, 7);
        *(floats*)&weights.data[2 * n + 1][0] =
            __builtin_shufflevector(x[n], x[n], 8, 9, 10, 11, 12, 13, 14, 15, 8, 9, 10, 11, 12, 13, 14, 15);
    }
#else
    for (int i = 0; i < 16; ++i) {
        const int j = (i + 8) % 16;
        const float l[4] = {a.c[i] + a.c[j], b.c[i] + b.c[j], c.c[i] + c.c[j], d.c[i] + d.c[j]};
        const float largest = fmaxf(fmaxf(l[0], l[1]), fmaxf(l[2], l[3]));
        float whole = 0.0f;
        for (int n = 0; n < 4; ++n) whole += weights.data[n][i] = exp2f((l[n] - largest) * scale);
        for (int n = 0; n < 4; ++n) weights.data[n][i] /= whole;
    }
#endif
    return weights;
"""
)
def _wide_softmax4(a: _wide, b: _wide, c: _wide, d: _wide, scale: float) -> _four_wide:
    """As `softmax4`; two logits of 8 heads share a vector."""


@wp.func
def softmax4(a: _wide, b: _wide, c: _wide, d: _wide, scale: wp.float32):
    """The weights of 4 logits of each head, 2^(scale l) / Σ 2^(scale l): the logits are `fold` of the arguments."""
    return _wide_softmax4(a, b, c, d, scale)


@wp.func
def softmax4(a: Any, b: Any, c: Any, d: Any, scale: Any):  # noqa: F811
    """There is one lane."""
    l0 = a * scale
    l1 = b * scale
    l2 = c * scale
    l3 = d * scale
    largest = wp.max(wp.max(l0, l1), wp.max(l2, l3))
    l0 = exp2(l0 - largest)
    l1 = exp2(l1 - largest)
    l2 = exp2(l2 - largest)
    l3 = exp2(l3 - largest)
    whole = (l0 + l1) + (l2 + l3)
    return wp.matrix_from_rows(wp.cw_div(l0, whole), wp.cw_div(l1, whole), wp.cw_div(l2, whole), wp.cw_div(l3, whole))


@wp.func
def total(x: _wide):
    """The sum over all lanes, in each of them."""
    x = fold(x)
    y = type(x)()
    for i in range(16):
        y[i] = x[(i + 4) % 16]
    x = x + y
    for i in range(16):
        y[i] = x[(i + 2) % 16]
    x = x + y
    for i in range(16):
        y[i] = x[(i + 1) % 16]
    return x + y


@wp.func
def total(x: _one):  # noqa: F811
    """There is one lane."""
    return x


@wp.func
def total(x: _one_double):  # noqa: F811
    """There is one lane."""
    return x
