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
    "add_products",
    "exp2",
    "fold",
    "gelu",
    "rsqrt",
    "total",
    "vectors",
    "zeros4",
    "zeros16",
]

# 16 float32 are a cache line, and a register of AVX-512.
LANES = 16

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
    """Adds x · factor, rounded once: a fused multiply-add, which Warp does not make of two operations."""


@wp.func
def add_products(x: wp.array2d[float], weight: wp.array2d[_wide], row: int, y_out: wp.array2d[_wide]):
    """Adds X W to Y in rows `row` to `row` + 3. W (K, N) has whole blocks of 4 vectors a row; X is read as numbers."""
    for block in range(0, weight.shape[1], 4):
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


@wp.func
def add_outer(x: wp.array2d[float], y: wp.array2d[_wide], row: int, first: int, weight_out: wp.array2d[_wide]):
    """Adds Xᵀ Y of rows `row` to `row` + 3 to W (K, N), whose rows begin at `first`; shapes as in `add_products`."""
    for block in range(0, y.shape[1], 4):
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
