"""Ranges at which the surfaces of the 4 neighbours of a query may be met, how likely each is, and what is answered.

Take two pixels t and o of one column of the range image, and let α be the elevation. Along the column the inverse range
u = 1/r of a plane is A cos α + B sin α. Two pixels therefore tell it at the elevation α of any query:

    u(α) = (u_t sin(α_o - α) + u_o sin(α - α_t)) / sin(α_o - α_t)                                                    (1)

Along a row α is the azimuth, and u is A cos α + B sin α + C. There Eq. (1) leaves an error of at most about δ² C, from
one gap δ before the two pixels to one behind them.

Each neighbour t lies on a surface that may go on to the query. Along the column there are three ways to continue it:
with the *outer* pixel, the one beyond t as seen from the query; with the *inner* pixel, the one on the query's side; or
not at all, since t may be all there is of its surface. Along the row there are the same three. The change along the
column and the change along the row are added. That makes 9 hypotheses for a neighbour and 36 for a query:

    u_tk = u_t + (u_v(α_v) - u_t) + (u_h(α_h) - u_t),    r_tk = 1 / u_tk,    u_t / 4 <= u_tk <= 4 u_t                (2)

Where one of the two pixels has no return, or the gap between them is wider than 0.5 rad, nothing is continued and
u(α) = u_t. All hypotheses of a neighbour without a return say that nothing returns.

A network gives each hypothesis a score s_tk and each neighbour a scale c_t. The bilinear areas a_t are the prior:

    w_tk = softmax(s_tk + log max(a_t, 0.001)),    b_t = 0.5 log(1 + exp c_t) + 0.02 m                               (3)

On a pixel, to a thousandth of its distance to the next, the other areas count as 0: what was measured is answered.

The range r of a query then has the following density, a mixture of Laplace distributions, and nothing returns with the
following probability:

    p(r) = (1 - 2 ε) Σ_tk w_tk exp(-|r_tk - r| / b_t) / 2 b_t + ε / R      over the hypotheses that return           (4)
    p(none) = (1 - 2 ε) Σ_tk w_tk + ε                                      over those that do not

ε = 0.001 is for what no neighbour tells. R is the range that a no return counts as.

The answer is the weighted median of the r_tk, where a no return is farther than any range. Of all answers the median
has the least expected absolute error. It is one of the hypotheses, so that no point floats between two surfaces.
"""

from typing import Any

import warp as wp

from kernels.checks import AREA_FLOOR, BACKGROUND, CONTINUED, LEAST_RANGE, LEAST_SCALE, TOLERANCE, WIDEST_GAP
from kernels.lanes import LANES, exp2, softplus, vectors, where_less
from kernels.stencil import area, base, column_of

__all__ = ["RAYS", "explain", "hypotheses", "load", "scale", "settle", "store", "weigh"]

_AREA_FLOOR = wp.constant(AREA_FLOOR)
_BACKGROUND = wp.constant(BACKGROUND)
_CONTINUED = wp.constant(CONTINUED)
_LEAST_RANGE = wp.constant(LEAST_RANGE)
_LEAST_SCALE = wp.constant(LEAST_SCALE)
_TOLERANCE = wp.constant(TOLERANCE)
_WIDEST_GAP = wp.constant(WIDEST_GAP)
_TURN = wp.constant(6.283185307179586)


def _rays_type(scalar: type) -> Any:
    @wp.struct
    class Rays:
        """What was measured, and the rays that are asked for."""

        image: wp.array3d[scalar]
        """(B, H, W) metres, 0 where nothing returned."""
        elevations: wp.array[scalar]
        """(H,) radians."""
        azimuths: wp.array[scalar]
        """(W,) radians."""
        queries: wp.array3d[scalar]
        """(B, Q, 2) pixel coordinates."""
        wrap: int
        """1 if column W-1 meets column 0, else 0."""
        rolled_four: int
        """`kernels.neighbour_attention.maths.ROLLED_FOUR`."""

    return Rays


# The rays for each dtype, since no struct's arrays are generic.
RAYS = {scalar: _rays_type(scalar) for scalar in (wp.float32, wp.float64)}


@wp.func
def _sine(x: Any):
    """The sine of |x| <= 1 to 3e-8; far faster than `wp.sin`, which no CPU compiler turns into SIMD instructions."""
    s = x * x
    p = type(x)(2.7557319e-6) * s - type(x)(1.984126984e-4)
    p = p * s + type(x)(8.333333333e-3)
    p = p * s - type(x)(0.16666666667)
    return x + x * s * p


@wp.func
def _sines(x: Any):
    """`_sine` in each lane."""
    y = type(x)()
    for i in range(len(x)):
        y[i] = _sine(x[i])
    return y


@wp.func
def _look_up(table: wp.array[Any], index: Any):
    """The entries of a table at the indices in the lanes."""
    y = type(index)()
    for i in range(len(index)):
        y[i] = table[int(index[i])]
    return y


@wp.func
def _inverse(image: wp.array3d[Any], b: int, row: Any, column: Any):
    """The inverse range u of the pixel in each lane; 0 where nothing returned."""
    zero = type(row)()
    r = type(row)()
    for i in range(len(row)):
        r[i] = image[b, int(row[i]), int(column[i])]
    least = type(row)(type(row[0])(_LEAST_RANGE))
    one = type(row)(type(row[0])(1.0))
    return where_less(zero, r, wp.cw_div(one, wp.max(r, least)), zero)


@wp.func
def _within(x: Any, low: Any, high: Any):
    """The value x, clamped to lie between low and high; NaN for NaN, which `wp.clamp` may drop."""
    return where_less(x, low, low, where_less(high, x, high, x))


@wp.func
def _below(coordinate: Any):
    """The pixel number at or below a coordinate, as `kernels.stencil.base` has it."""
    y = type(coordinate)()
    for i in range(len(coordinate)):
        y[i] = type(y[0])(base(coordinate[i]))
    return y


@wp.func
def _wrapped(number: Any, count: int):
    """The column that an unbounded column number stands for on a full circle."""
    y = type(number)()
    for i in range(len(number)):
        y[i] = type(y[0])(column_of(int(number[i]), count, 1))
    return y


@wp.func
def _bounded(number: Any, count: int, wrap: int):
    """The row or column of a number that is at most one off the table."""
    zero = type(number)()
    last = type(number)(type(number[0])(count - 1))
    if wrap != 0:
        whole = type(number)(type(number[0])(count))
        number = where_less(number, zero, number + whole, number)
        return where_less(last, number, number - whole, number)
    return wp.max(wp.min(number, last), zero)


@wp.func
def _gap(table: wp.array[Any], index: Any, other: Any, wrap: int):
    """The angle from pixel `index` to pixel `other` of a row or column, the short way round on a full circle."""
    gap = _look_up(table, other) - _look_up(table, index)
    if wrap != 0:
        for i in range(len(gap)):
            turn = type(gap[0])(_TURN)
            gap[i] = gap[i] - turn * wp.rint(gap[i] / turn)
    return gap


@wp.func
def _continue(gap: Any, angle: Any):
    """What u_t and u_o are multiplied by in u(α) - u_t, with α and α_o counted from t; Eq. (1)."""
    zero = type(gap)()
    one = type(gap)(type(gap[0])(1.0))
    size = wp.abs(gap)
    limit = type(gap)(type(gap[0])(_WIDEST_GAP))
    inverse = wp.cw_div(one, _sines(gap))
    a = wp.cw_mul(_sines(gap - angle), inverse) - one
    b = wp.cw_mul(_sines(angle), inverse)
    # Nothing is continued over a gap that is too wide, nor from a pixel to itself.
    a = where_less(limit, size, zero, where_less(zero, size, a, zero))
    b = where_less(limit, size, zero, where_less(zero, size, b, zero))
    return a, b


@wp.func
def _along(coordinate: Any, below: Any, first: Any, side: int, table: wp.array[Any], wrap: int):
    """Along one axis, for the neighbours on one side of a query: pixel, outer and inner pixel, and their factors.

    `below` is the number of the pixel below the coordinate, and `first` the same within the table on a full circle.
    `side` is 0 for the neighbours below the coordinate and 1 for those above. The factors are two for the outer pixel
    and two for the inner one, see `_continue`.
    """
    count = table.shape[0]
    zero = type(coordinate)()
    one = type(coordinate)(type(coordinate[0])(1.0))
    step = type(coordinate)(type(coordinate[0])(side))
    t = _bounded(first + step, count, wrap)
    offset = coordinate - t
    if wrap != 0:
        offset = coordinate - below - step
    towards = where_less(offset, zero, -one, one)
    inner = _bounded(t + towards, count, wrap)
    outer = _bounded(t - towards, count, wrap)
    inner_gap = _gap(table, t, inner, wrap)
    outer_gap = _gap(table, t, outer, wrap)
    # Beyond the table its last spacing goes on.
    spacing = where_less(zero, wp.abs(inner - t), inner_gap, -outer_gap)
    limit = type(coordinate)(type(coordinate[0])(_WIDEST_GAP))
    angle = _within(wp.cw_mul(wp.abs(offset), spacing), -limit, limit)
    a_outer, b_outer = _continue(outer_gap, angle)
    a_inner, b_inner = _continue(inner_gap, angle)
    return t, outer, inner, a_outer, b_outer, a_inner, b_inner


@wp.func
def _change(u: Any, other: Any, a: Any, b: Any):
    """u(α) - u_t; 0 where one of the pixels has no return."""
    zero = type(u)()
    return where_less(zero, wp.min(u, other), wp.cw_mul(u, a) + wp.cw_mul(other, b), zero)


@wp.func
def hypotheses(rays: Any, b: int, row: Any, column: Any, zeros: Any):
    """The ranges r_tk of the queries, number 9 t + 3 v + h for continuation v along the column and h along the row.

    Continuations are 0, outer; 1, inner; 2, none. No return is 0.
    """
    found = zeros
    zero = type(row)()
    one = type(row)(type(row[0])(1.0))
    within = type(row[0])(_CONTINUED)
    i_below = _below(row)
    j_below = _below(column)
    j_first = j_below
    if rays.wrap != 0:
        j_first = _wrapped(j_below, rays.azimuths.shape[0])
    for down in range(rays.rolled_four // 2):
        i, i_outer, i_inner, a_outer, b_outer, a_inner, b_inner = _along(
            row, i_below, i_below, down, rays.elevations, 0
        )
        for right in range(rays.rolled_four // 2):
            j, j_outer, j_inner, c_outer, d_outer, c_inner, d_inner = _along(
                column, j_below, j_first, right, rays.azimuths, rays.wrap
            )
            u = _inverse(rays.image, b, i, j)
            v_outer = _change(u, _inverse(rays.image, b, i_outer, j), a_outer, b_outer)
            v_inner = _change(u, _inverse(rays.image, b, i_inner, j), a_inner, b_inner)
            h_outer = _change(u, _inverse(rays.image, b, i, j_outer), c_outer, d_outer)
            h_inner = _change(u, _inverse(rays.image, b, i, j_inner), c_inner, d_inner)
            v = wp.matrix_from_rows(u + v_outer, u + v_inner, u)
            h = wp.matrix_from_rows(h_outer, h_inner, zero)
            for k in range(9):
                x = _within(v[k // 3] + h[k % 3], u / within, u * within)
                found[9 * (2 * down + right) + k] = where_less(zero, u, wp.cw_div(one, x), zero)
    return found


@wp.func
def _areas(row: Any, column: Any, t: int):
    """The prior of neighbour t in Eq. (3): its bilinear area, bounded below; NaN stays."""
    a = type(row)()
    largest = type(row)()
    for i in range(len(row)):
        a[i] = area(row[i], column[i], t)
        for s in range(4):
            largest[i] = wp.max(largest[i], area(row[i], column[i], s))
    zero = type(row)()
    floor = type(row)(type(row[0])(_AREA_FLOOR))
    between = type(row)(type(row[0])(1.0)) - floor
    return where_less(a, floor, where_less(largest, between, floor, zero), a)


@wp.func
def weigh(scores: Any, row: Any, column: Any, rolled_four: int):
    """The weights of Eq. (3), up to a common factor."""
    largest = scores[0]
    for k in range(36):
        largest = wp.max(largest, scores[k])
    w = scores
    for t in range(rolled_four):
        a = _areas(row, column, t)
        for k in range(9 * t, 9 * t + 9):
            w[k] = wp.cw_mul(exp2((scores[k] - largest) * type(row[0])(1.4426950408889634)), a)
    return w


@wp.func
def scale(c: Any):
    """b_t of Eq. (3)."""
    return softplus(c) * type(c[0])(0.5) + type(c)(type(c[0])(_LEAST_SCALE))


@wp.func
def explain(found: Any, scales: Any, target: Any, far: Any, rolled_four: int):
    """What each hypothesis says of a measured range by Eq. (4), and the absolute error.

    What it says is a density, or a probability where nothing returned.
    """
    zero = type(target)()
    one = type(target)(type(target[0])(1.0))
    gap = found
    p = found
    measured = where_less(zero, target, target, far)
    for t in range(rolled_four):
        inverse = wp.cw_div(one, scale(scales[t]))
        height = where_less(zero, target, inverse * type(target[0])(0.5), one)
        for k in range(9 * t, 9 * t + 9):
            gap[k] = wp.abs(where_less(zero, found[k], found[k], far) - measured)
            says = wp.cw_mul(exp2(wp.cw_mul(gap[k], inverse) * type(target[0])(-1.4426950408889634)), height)
            says_nothing = where_less(zero, target, zero, says)
            says_something = where_less(zero, target, says, zero)
            p[k] = where_less(zero, found[k], says_something, says_nothing)
    return p, gap


_wide: Any = vectors(LANES, wp.float32)
_wide_many: Any = wp.types.matrix((36, LANES), wp.float32)


@wp.func_native("""
    wp::vec_t<16, wp::float32> median;
#if defined(__clang__)
    typedef float floats __attribute__((vector_size(64), aligned(4)));
    typedef int ints __attribute__((vector_size(64), aligned(4)));
    const floats least = *(const floats*)&half.c[0];
    floats best = {};
    best = best + INFINITY;
    for (int first = 0; first < 36; first += 12) {
        floats nearer[12] = {};
        for (int j = 0; j < 36; ++j) {
            const floats range = *(const floats*)&r.data[j][0], weight = *(const floats*)&w.data[j][0];
            for (int n = 0; n < 12; ++n)
                nearer[n] += (floats)((ints)weight & (range <= *(const floats*)&r.data[first + n][0]));
        }
        for (int n = 0; n < 12; ++n) {
            const floats range = *(const floats*)&r.data[first + n][0];
            const ints taken = (nearer[n] >= least) & (range < best);
            best = (floats)(((ints)range & taken) | ((ints)best & ~taken));
        }
    }
    *(floats*)&median.c[0] = best;
#else
    for (int i = 0; i < 16; ++i) {
        median.c[i] = INFINITY;
        for (int n = 0; n < 36; ++n) {
            float nearer = 0.0f;
            for (int j = 0; j < 36; ++j) nearer += r.data[j][i] <= r.data[n][i] ? w.data[j][i] : 0.0f;
            if (nearer >= half.c[i] && r.data[n][i] < median.c[i]) median.c[i] = r.data[n][i];
        }
    }
#endif
    return median;
""")
def _wide_median(r: _wide_many, w: _wide_many, half: _wide) -> _wide:
    """As `_median`."""


@wp.func
def _median(r: _wide_many, w: _wide_many, half: _wide):
    """The least range so that the hypotheses that are no farther have `half` of the weight, without a branch."""
    return _wide_median(r, w, half)


@wp.func  # type: ignore[no-redef]
def _median(r: Any, w: Any, half: Any):
    """There is one lane."""
    zero = type(half)()
    median = type(half)(type(half[0])(wp.inf))
    for n in range(36):
        nearer = zero
        for j in range(36):
            nearer = nearer + where_less(r[n], r[j], zero, w[j])
        median = wp.min(median, where_less(nearer, half, median, r[n]))
    return median


@wp.func
def settle(found: Any, w: Any, scales: Any, rolled_four: int):
    """The weighted median of hypotheses, the probability that each neighbour's surface is met there, that of no return.

    The median is 0 for no return and NaN where a weight is NaN.
    """
    zero = type(found[0])()
    one = type(zero)(type(zero[0])(1.0))
    infinite = type(zero)(type(zero[0])(wp.inf))
    half = type(zero[0])(0.5)
    r = found
    whole = zero
    none = zero
    for k in range(36):
        r[k] = where_less(zero, found[k], found[k], infinite)
        whole = whole + w[k]
        none = none + where_less(zero, found[k], zero, w[k])
    median = _median(r, w, whole * half)
    known = wp.cw_div(one - one * type(zero[0])(2.0 * _BACKGROUND), whole)
    if_none = where_less(median, infinite, zero, one)
    # The mass of a Laplace distribution of scale 1 within s of a point d away: 1 - e^-s cosh d for d <= s, else
    # e^-d sinh s.
    log2_e = type(zero[0])(1.4426950408889634)
    support = scales
    for t in range(rolled_four):
        inverse = wp.cw_div(one, scale(scales[t]))
        s = inverse * type(zero[0])(_TOLERANCE)
        low = exp2(-s * log2_e) * half
        sinh = wp.cw_div(one * type(zero[0])(0.25), low) - low
        met = zero
        for k in range(9 * t, 9 * t + 9):
            d = wp.cw_mul(wp.abs(median - found[k]), inverse)
            e = exp2(-d * log2_e)
            near = where_less(s, d, wp.cw_mul(e, sinh), one - wp.cw_mul(low, e + wp.cw_div(one, e)))
            near = where_less(median, infinite, near, zero)
            met = met + wp.cw_mul(w[k], where_less(zero, found[k], near, if_none))
        support[t] = wp.cw_mul(met, known)
    median = where_less(median, infinite, median, zero)
    for i in range(len(zero)):
        median[i] = wp.where(whole[i] >= type(zero[0])(0.0), median[i], whole[i])  # NaN for NaN
    return median, support, wp.cw_mul(none, known)


@wp.func
def load(array: wp.array3d[Any], b: int, begin: int, zeros: Any):
    """Rows `begin`, `begin` + 1, ... of image b, a row in each lane; zeros in the lanes behind the last."""
    values = zeros
    for i in range(wp.min(len(zeros[0]), array.shape[1] - begin)):
        for k in range(array.shape[2]):
            values[k, i] = array[b, begin + i, k]
    return values


@wp.func
def store(values: Any, b: int, begin: int, array_out: wp.array3d[Any]):
    """The opposite of `load`."""
    for i in range(wp.min(len(values[0]), array_out.shape[1] - begin)):
        for k in range(array_out.shape[2]):
            array_out[b, begin + i, k] = values[k, i]
