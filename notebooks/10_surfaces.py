# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 10 · Surfaces
#
# ![From the side: two laser beams from the left, one meets the road and one a wall. Coloured lines continue the surface
# of each of the two points in three ways; two of them follow the road and the wall to the corner between
# them](pictures/10_surfaces.png)
#
# **Goal.** You go from *which neighbour?* to *which surface?*: you continue the surface of each measured neighbour in
# several ways, let a network choose among them, and read from its answer how sure it is.
#
# **After this notebook you can**
#
# - show that choosing among ranges cannot win, and that choosing among surfaces can;
# - write a Warp kernel that finds where a neighbour's surface is met along a query;
# - train and read a mixture: a likelihood, a median instead of a mean, and a calibrated confidence;
# - say why the same network serves sensors with uneven beams.
#
# | | |
# |---|---|
# | You know | [02 · Casting rays](02_casting_rays.ipynb) for Warp, [05 · Weights](05_weights.ipynb) |
# | Time | 35 minutes, and 65 for the exercises; under a minute to run |
# | Hardware | any computer; a CUDA GPU is used if there is one |

# %%
import math

import matplotlib.pyplot as plt
import numpy as np
import torch
import warp as wp

from ilnet import metrics, models, places, simulate
from ilnet.course import check, draw_trace, run, slide
from ilnet.learning import calibration
from ilnet.scan import Scan
from ilnet.sensor import Sensor, angles_to_directions, preset
from kernels import gather_neighbours, surface_hypotheses, surface_likelihood, surface_median
from kernels.launch import initialise

initialise()  # starts Warp without its greeting
device = "cuda" if torch.cuda.is_available() else "cpu"
BLUE, ORANGE, GREEN, GREY = "#0072b2", "#e69f00", "#009e73", "#999999"

# %% [markdown]
# One street that no shipped network was trained in, scanned twice from the same place: with 16 beams, which is the
# *image*, and with 64, which is the truth.

# %%
street = places.town("town05", seed=1, device=device)
waypoint = street.spread(1)[0]
pose = street.pose(waypoint)
world = street.world(pose[:3, 3], waypoint)
sensor, fine = preset("paper-16x1024"), preset("paper-64x1024")
scan, truth = (simulate.scan(world, one, pose) for one in (sensor, fine))

image = scan.ranges  # (16, 1024) metres, 0 where nothing returned
queries = sensor.grid_queries(fine).view(-1, 2).to(device)  # (Q, 2): every pixel of the 64 x 1024 image
elevations, azimuths = sensor.angles(device)  # (16,), (1024,) radians
FAR = sensor.norm_range  # 100 m: what a no return counts as
true = truth.filled().view(-1)  # (Q,) metres


def judge(ranges):
    """IoU, MAE [m] and share of floating points of predicted ranges (Q,) [m]."""
    found = metrics.compare(ranges.view(fine.shape), truth)
    return f"IoU {found['iou']:.3f}, MAE {found['mae']:.2f} m, floating {found['floating']:.1%}"


print(len(queries), "queries")

# %% [markdown]
# ## 1. Which neighbour?
#
# ILN answers with a blend of the four measured ranges (notebook 05). How good can that ever be? Ask *oracles*, which
# know the truth. The first chooses the best of the four ranges for each query. The second blends them with the best
# weights that there are. Then we spoil the second a little: its weights are off by 1 % or 5 % (standard deviation).
#
# **Predict:** with perfect weights the IoU is nearly 0.9. What is left of it with weights that are off by 5 %?


# %%
def best_of(candidates):
    """Of candidates (Q, N) [m], the one nearest to the truth."""
    return candidates.gather(1, (candidates - true[:, None]).abs().argmin(1, keepdim=True))[:, 0]


four = gather_neighbours(scan.filled()[None], queries)[0][..., 0]  # (Q, 4)
low, high = four.amin(1), four.amax(1)
weight = ((true - low) / (high - low).clamp(min=1e-6)).clamp(0, 1)  # of the farthest neighbour
noise = torch.randn(len(true), generator=torch.Generator().manual_seed(0)).to(device)
print(f"{'the best of the 4 ranges':>36}:", judge(best_of(four)))
for off in (0.0, 0.01, 0.05):
    spoilt = (weight + off * noise).clamp(0, 1)
    print(f"{f'the best blend, weights off by {off:.0%}':>36}:", judge(low + spoilt * (high - low)))

# %% [markdown]
# Neither wins. **Choosing** one of four ranges cannot be right on a road: one beam meets it at 19 m, the next at 30 m,
# and nothing was measured between them. **Blending** can be right everywhere, but only with weights that are right to a
# fraction of a percent: 1 % of the 11 m between the beams are 11 cm, more than the voxels of the IoU are wide. The
# farther the neighbours are apart, the more exact the weights have to be.
#
# A road is flat, though, and two beams are enough to say where it is between them. So let the network choose among
# something better than ranges.
#
# ## 2. A surface goes on
#
# Notebook 03: on a plane $\mathbf n \cdot \mathbf p = c$ the inverse range $u = 1/r$ is
# $\mathbf n \cdot \mathbf d / c$, linear in the direction $\mathbf d$. Along a column the azimuth $\beta$ is fixed, and
# the elevation $\alpha$ changes $\mathbf d = (\cos\alpha \cos\beta,\ \cos\alpha \sin\beta,\ \sin\alpha)$. So
#
# $$u(\alpha) = A \cos\alpha + B \sin\alpha$$
#
# with two unknowns, $A$ and $B$. Two pixels of the column, $t$ at $\alpha_t$ and $o$ at $\alpha_o$, tell both, and the
# plane through them is known at *any* elevation:
#
# $$u(\alpha) = \frac{u_t \sin(\alpha_o - \alpha) + u_o \sin(\alpha - \alpha_t)}{\sin(\alpha_o - \alpha_t)}$$
#
# For small angles $\sin x \approx x$, and this is the straight line through $u_t$ and $u_o$. Along a row it holds with
# azimuths, nearly. There are **three ways to continue** the surface that neighbour $t$ lies on:
#
# | name | the other pixel $o$ | right where |
# |---|---|---|
# | *outer* | the one beyond $t$, away from the query | the surface of $t$ goes on and ends somewhere behind the query |
# | *inner* | the one across, on the query's side | one surface goes through both |
# | *none* | there is none: $u(\alpha) = u_t$ | $t$ is all there is of its surface, such as a pole |
#
# ### Exercise 1 · Continue
#
# importance ★★★ · difficulty ★☆☆ · 10 minutes
#
# Write the `wp.func` `continued`: the **change** $u(\alpha) - u_t$. Angles are counted from $t$: `gap` is
# $\alpha_o - \alpha_t$ and `angle` is $\alpha - \alpha_t$, in radians, of either sign. An inverse range of 0 stands for
# no return. Nothing is continued, and the change is 0, if one of the two pixels has no return, if the gap is 0 (there
# is no other pixel), or if it is wider than 0.5 rad.
#
# <details><summary>Hint</summary>
#
# $\alpha_o - \alpha$ is `gap - angle`. Use `wp.sin`, `wp.abs`, `wp.min`, and `0.0`, not `0`.
#
# </details>


# %% tags=["exercise"]
@wp.func
def continued(u: float, other: float, gap: float, angle: float) -> float:
    raise NotImplementedError


# %% tags=["solution"]
@wp.func
def continued(u: float, other: float, gap: float, angle: float) -> float:
    if wp.min(u, other) == 0.0 or gap == 0.0 or wp.abs(gap) > 0.5:
        return 0.0
    return (u * wp.sin(gap - angle) + other * wp.sin(angle)) / wp.sin(gap) - u


# %% tags=["check"]
@check
def _():
    def u(alpha):  # a plane
        return 0.05 * math.cos(alpha) - 0.3 * math.sin(alpha)

    def asked(t, o, alpha):
        return continued(u(t), u(o), o - t, alpha - t)

    assert abs(asked(-0.2, -0.05, -0.2)) < 1e-6, "at the pixel itself nothing changes: the change is 0, not u"
    across = asked(-0.2, -0.05, -0.05)
    assert abs(across - (u(-0.05) - u(-0.2))) < 1e-6, (
        f"at the other pixel the change is u_o - u_t = {u(-0.05) - u(-0.2):.4f}; you have {across:.4f}"
    )
    for t, o, alpha, where in ((-0.2, -0.05, -0.1, "between both"), (-0.2, -0.3, -0.1, "beyond, with an outer pixel")):
        found, wanted = asked(t, o, alpha), u(alpha) - u(t)
        assert abs(found - wanted) < 1e-6, f"on a plane, {where}, the change is {wanted:.4f}; you have {found:.4f}"
    wide = continued(0.1, 0.1, 0.48, 0.24)
    assert abs(wide - (0.1 / math.cos(0.24) - 0.1)) < 1e-6, (
        f"a wall that faces the sensor is nearest in its middle: the change is 0.00295; you have {wide:.5f}"
    )
    assert continued(0.1, 0.0, 0.03, 0.01) == 0.0, "the other pixel has no return: nothing is continued"
    assert continued(0.0, 0.1, 0.03, 0.01) == 0.0, "pixel t has no return: nothing is continued"
    assert continued(0.1, 0.1, 0.0, 0.01) == 0.0, "a gap of 0: there is no other pixel, and sin(0) divides"
    assert continued(0.1, 0.2, 0.6, 0.1) == 0.0, "a gap of 0.6 rad is too wide"
    assert continued(0.1, 0.2, -0.6, 0.1) == 0.0, "a gap of -0.6 rad is too wide as well"


# %% tags=["wrong"]
@wp.func
def continued(u: float, other: float, gap: float, angle: float) -> float:  # a straight line
    if wp.min(u, other) == 0.0 or gap == 0.0 or wp.abs(gap) > 0.5:
        return 0.0
    return (other - u) * angle / gap


# %% tags=["wrong"]
@wp.func
def continued(u: float, other: float, gap: float, angle: float) -> float:  # u(α), and not how it differs from u_t
    if wp.min(u, other) == 0.0 or gap == 0.0 or wp.abs(gap) > 0.5:
        return 0.0
    return (u * wp.sin(gap - angle) + other * wp.sin(angle)) / wp.sin(gap)


# %% tags=["wrong"]
@wp.func
def continued(u: float, other: float, gap: float, angle: float) -> float:  # no return is very far away
    if gap == 0.0 or wp.abs(gap) > 0.5:
        return 0.0
    return (u * wp.sin(gap - angle) + other * wp.sin(angle)) / wp.sin(gap) - u


# %% tags=["wrong"]
@wp.func
def continued(u: float, other: float, gap: float, angle: float) -> float:  # only positive gaps
    if wp.min(u, other) == 0.0 or gap <= 0.0 or gap > 0.5:
        return 0.0
    return (u * wp.sin(gap - angle) + other * wp.sin(angle)) / wp.sin(gap) - u


# %% [markdown]
# ## 3. Hypotheses
#
# Look from the side: one column of the image, the sensor on the left, and the truth as thousands of rays would see it.
# Between two beams, each of the two measured points has three hypotheses about what a ray would meet. The op
# `surface_hypotheses` finds them.
#
# **Predict:** where a road meets a wall, which hypotheses are true?

# %% tags=["goal", "hide-input"]
PLACES = {"at the foot of a wall": (304, 6), "on the road": (525, 4), "at the top of a car": (905, 6)}
WAYS = {"outer": "-", "inner": "--", "none": ":"}


def draw_slice(number=0):
    """From the side: a column of the image, and the hypotheses between two of its beams."""
    name, (column, row) = list(PLACES.items())[number]
    alpha = torch.linspace(sensor.elevations[0], sensor.elevations[-1], 4000, dtype=torch.float64)
    rays = angles_to_directions(alpha, torch.full_like(alpha, float(sensor.azimuths[column])))
    met = simulate.nearest([simulate.cast(mesh, pose, rays, sensor.max_range) for mesh in world]).cpu()
    axes = plt.figure(figsize=(9, 3.2), layout="constrained").subplots()
    there = met > 0
    axes.scatter((met * alpha.cos())[there], (met * alpha.sin())[there], s=5, color="#cccccc", label="truth")

    parts = torch.linspace(0, 1, 101)[:-1]
    asked = torch.stack((row + parts, torch.full_like(parts, column)), -1).to(device)
    found = surface_hypotheses(image, asked, elevations, azimuths).cpu()  # (Q, 4, 9)
    angles = torch.lerp(elevations[row].cpu(), elevations[row + 1].cpu(), parts)
    for t, colour, which in ((0, BLUE, "lower"), (2, ORANGE, "upper")):  # the neighbours in this column
        for v, (way, style) in enumerate(WAYS.items()):
            r = found[:, t, 3 * v + 2]  # not continued along the row
            width = 1.8 if way != "outer" else 5 if t == 0 else 2.5  # so that one shows behind the other
            axes.plot(r * angles.cos(), r * angles.sin(), style, color=colour, lw=width, label=f"{which} beam, {way}")

    measured = image[:, column].cpu()
    x, z = measured * elevations.cpu().cos(), measured * elevations.cpu().sin()
    for i in (row, row + 1):
        axes.plot((0, x[i]), (0, z[i]), color="black", lw=0.5)
    axes.plot(x[measured > 0], z[measured > 0], "k.", markersize=8, label="measured")
    axes.plot(0, 0, "ks")
    (low, high), (left, right) = z[row : row + 2].tolist(), x[row : row + 2].tolist()
    axes.set(xlim=(left - (right - left) - 1, right + (right - left) + 1), ylim=(low - 1, high + 1.5))
    axes.set(xlabel="metres ahead", ylabel="metres up", title=f"{name}: column {column}, rows {row} and {row + 1}")
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    plt.show()


draw_slice()

# %% [markdown]
# *In words: the truth in grey, a road that ends at a wall. A ray meets the road, the next one up meets the wall. The
# blue solid line, the lower beam's outer hypothesis, follows the road up to the corner; the orange solid line, the
# upper beam's outer one, follows the wall down to it. Both dashed lines are the straight line from point to point,
# which cuts the corner. The dotted lines are arcs at the measured ranges.*
#
# In the corner the truth changes from one line to the other, and a ray between the beams has to choose. On the road and
# at the top of a car it looks like this:

# %%
draw_slice(1)
draw_slice(2)

# %% [markdown]
# *In words: first a flat road. Four of the six lines lie on it, and only the two dotted ones, the measured ranges, miss
# it. Then the top of a car, with a wall far behind it. The blue lines go up from the point on the car, the orange solid
# and dotted ones go down from the point on the wall, and the dashed line bridges 8 m of empty air.*
#
# On the road it does not matter which is chosen, outer or inner. **Where the world is simple the hypotheses agree, and
# the network need not be exact.** Above the car it matters a lot: car or wall? In a running notebook a slider shows all
# three places:

# %%
slide(draw_slice, number=(0, len(PLACES) - 1, 1))

# %% [markdown]
# The same along the row: outer, inner, none. The change along the column and the change along the row are added, which
# makes $3 \times 3 = 9$ hypotheses for a neighbour and 36 for a query:
#
# $$u_{tk} = u_t + (u_v(\alpha_v) - u_t) + (u_h(\alpha_h) - u_t), \qquad r_{tk} = 1 / u_{tk},
# \qquad u_t / 4 \le u_{tk} \le 4 u_t$$
#
# The bounds keep a steep slope from running through the sensor or behind it. Hypothesis $k = 3v + h$ continues along
# the column as $v$ says and along the row as $h$ says: 0 is outer, 1 inner, 2 none.
#
# ### Exercise 2 · The hypotheses of one neighbour
#
# importance ★★★ · difficulty ★★★ · 20 minutes
#
# Write `nine_kernel`, one thread per query: the nine hypotheses [m] of neighbour `t`, 0 to 3, in the order of $k$. A
# neighbour without a return has nine hypotheses of 0. The queries keep clear of the border, so that no row or column
# has to be clamped or wrapped. `inverse` gives $u$, and `continued` is yours (or the solution) of exercise 1.
#
# <details><summary>Hint: where the pixels are</summary>
#
# Neighbour t is at row `int(wp.floor(queries[q, 0])) + t // 2`, and likewise in columns with `t % 2`. Seen from a lower
# neighbour (t // 2 = 0) the query lies at higher rows: the inner pixel is in row i + 1 and the outer one in row i - 1.
# Seen from an upper neighbour it is the other way round. `towards = 1 - 2 * (t // 2)` is the sign for both.
#
# </details>
# <details><summary>Hint: the angle to the query</summary>
#
# The query lies the part `wp.abs(queries[q, 0] - float(i))` of the way from row i to the inner row. So the angle is
# that part of the gap to the inner row, `elevations[inner] - elevations[i]`. It holds for outer and inner alike.
#
# </details>
# <details><summary>Hint: all nine</summary>
#
# `v = wp.vec3(outer, inner, 0.0)` holds the three changes along the column, `h` those along the row. Two loops over
# `range(3)` then make `u + v[a] + h[b]`. `wp.clamp(x, low, high)` keeps it within the bounds.
#
# </details>


# %%
@wp.func
def inverse(r: float) -> float:
    """u = 1/r of a range [m]; 0 for no return."""
    if r > 0.0:
        return 1.0 / r
    return 0.0


# %% tags=["exercise"]
@wp.kernel(module="unique", enable_backward=False)
def nine_kernel(
    # in
    image: wp.array2d[float],  # (H, W) metres
    queries: wp.array2d[float],  # (Q, 2) row, column
    elevations: wp.array[float],  # (H,) radians
    azimuths: wp.array[float],  # (W,) radians
    t: int,
    # out
    found_out: wp.array2d[float],  # (Q, 9) metres
):
    raise NotImplementedError


# %% tags=["solution"]
@wp.kernel(module="unique", enable_backward=False)
def nine_kernel(
    # in
    image: wp.array2d[float],
    queries: wp.array2d[float],
    elevations: wp.array[float],
    azimuths: wp.array[float],
    t: int,
    # out
    found_out: wp.array2d[float],
):
    q = wp.tid()
    i = int(wp.floor(queries[q, 0])) + t // 2
    j = int(wp.floor(queries[q, 1])) + t % 2
    up = 1 - 2 * (t // 2)  # from the neighbour towards the query
    right = 1 - 2 * (t % 2)
    gap_up = elevations[i + up] - elevations[i]
    gap_right = azimuths[j + right] - azimuths[j]
    angle_up = wp.abs(queries[q, 0] - float(i)) * gap_up
    angle_right = wp.abs(queries[q, 1] - float(j)) * gap_right

    u = inverse(image[i, j])
    v = wp.vec3(
        continued(u, inverse(image[i - up, j]), elevations[i - up] - elevations[i], angle_up),
        continued(u, inverse(image[i + up, j]), gap_up, angle_up),
        0.0,
    )
    h = wp.vec3(
        continued(u, inverse(image[i, j - right]), azimuths[j - right] - azimuths[j], angle_right),
        continued(u, inverse(image[i, j + right]), gap_right, angle_right),
        0.0,
    )
    for a in range(3):
        for b in range(3):
            found_out[q, 3 * a + b] = inverse(wp.clamp(u + v[a] + h[b], 0.25 * u, 4.0 * u))


# %% tags=["check"]
@check
def _():
    generator = torch.Generator().manual_seed(0)
    some = torch.tensor([[2.0, 2.0], [2.3, 3.6], [4.5, 1.25], [3.9, 5.7], [2.0, 4.5]])
    alpha = torch.tensor([-0.30, -0.22, -0.17, -0.13, -0.05, 0.05, 0.1])  # uneven beams
    beta = torch.tensor([-0.1, -0.06, -0.02, 0.02, 0.06, 0.1, 0.14, 0.18])
    small = 8 + 6 * torch.rand(7, 8, generator=generator)
    small[3, 4] = small[2, 2] = 0  # no return
    small[4, 6] = 200.0  # so steep that the bounds count
    small, some, alpha, beta = (x.to(device) for x in (small, some, alpha, beta))
    wanted = surface_hypotheses(small, some, alpha, beta, wrap=False)
    for t in range(4):
        mine = torch.full((len(some), 9), torch.nan, device=device)
        run(nine_kernel, len(some), [small, some, alpha, beta, t], [mine])
        assert not mine.isnan().any(), f"neighbour {t}: element {mine.isnan().nonzero()[0].tolist()} was not written"
        for k in (8, 2, 5, 6, 7, 0, 1, 3, 4):  # none first, then one axis, then both
            off = (mine[:, k] - wanted[:, t, k]).abs()
            way = f"{list(WAYS)[k // 3]} along the column, {list(WAYS)[k % 3]} along the row"
            assert off.max() < 1e-3, (
                f"neighbour {t}, hypothesis {k} ({way}), query {some[off.argmax()].tolist()}: "
                f"{wanted[off.argmax(), t, k]:.3f} m is wanted, you have {mine[off.argmax(), k]:.3f} m"
            )
    rows, columns = (queries.floor() - 1).unbind(1)
    inside = queries[(rows >= 0) & (rows < 13) & (columns >= 0) & (columns < 1021)].contiguous()
    mine = torch.full((4, len(inside), 9), torch.nan, device=device)
    for t in range(4):
        run(nine_kernel, len(inside), [image, inside, elevations, azimuths, t], [mine[t]])
    shipped = surface_hypotheses(image, inside, elevations, azimuths).movedim(1, 0)
    same = ((mine - shipped).abs() < 1e-2).float().mean()
    print(f"{same:.2%} of {mine.numel():,} hypotheses of the scan within 1 cm of those of kernels.surface_hypotheses")
    assert same > 0.999, "your kernel passes the small cases, and differs from the op on the scan"


# %% tags=["wrong"]
@wp.kernel(module="unique", enable_backward=False)
def nine_kernel(  # outer and inner are mistaken for one another
    # in
    image: wp.array2d[float],
    queries: wp.array2d[float],
    elevations: wp.array[float],
    azimuths: wp.array[float],
    t: int,
    # out
    found_out: wp.array2d[float],
):
    q = wp.tid()
    i = int(wp.floor(queries[q, 0])) + t // 2
    j = int(wp.floor(queries[q, 1])) + t % 2
    up = 2 * (t // 2) - 1
    right = 2 * (t % 2) - 1
    gap_up = elevations[i + up] - elevations[i]
    gap_right = azimuths[j + right] - azimuths[j]
    angle_up = -wp.abs(queries[q, 0] - float(i)) * gap_up
    angle_right = -wp.abs(queries[q, 1] - float(j)) * gap_right

    u = inverse(image[i, j])
    v = wp.vec3(
        continued(u, inverse(image[i - up, j]), elevations[i - up] - elevations[i], angle_up),
        continued(u, inverse(image[i + up, j]), gap_up, angle_up),
        0.0,
    )
    h = wp.vec3(
        continued(u, inverse(image[i, j - right]), azimuths[j - right] - azimuths[j], angle_right),
        continued(u, inverse(image[i, j + right]), gap_right, angle_right),
        0.0,
    )
    for a in range(3):
        for b in range(3):
            found_out[q, 3 * a + b] = inverse(wp.clamp(u + v[a] + h[b], 0.25 * u, 4.0 * u))


# %% tags=["wrong"]
@wp.kernel(module="unique", enable_backward=False)
def nine_kernel(  # the bounds are missing
    # in
    image: wp.array2d[float],
    queries: wp.array2d[float],
    elevations: wp.array[float],
    azimuths: wp.array[float],
    t: int,
    # out
    found_out: wp.array2d[float],
):
    q = wp.tid()
    i = int(wp.floor(queries[q, 0])) + t // 2
    j = int(wp.floor(queries[q, 1])) + t % 2
    up = 1 - 2 * (t // 2)  # from the neighbour towards the query
    right = 1 - 2 * (t % 2)
    gap_up = elevations[i + up] - elevations[i]
    gap_right = azimuths[j + right] - azimuths[j]
    angle_up = wp.abs(queries[q, 0] - float(i)) * gap_up
    angle_right = wp.abs(queries[q, 1] - float(j)) * gap_right

    u = inverse(image[i, j])
    v = wp.vec3(
        continued(u, inverse(image[i - up, j]), elevations[i - up] - elevations[i], angle_up),
        continued(u, inverse(image[i + up, j]), gap_up, angle_up),
        0.0,
    )
    h = wp.vec3(
        continued(u, inverse(image[i, j - right]), azimuths[j - right] - azimuths[j], angle_right),
        continued(u, inverse(image[i, j + right]), gap_right, angle_right),
        0.0,
    )
    for a in range(3):
        for b in range(3):
            found_out[q, 3 * a + b] = inverse(u + v[a] + h[b])


# %% tags=["wrong"]
@wp.kernel(module="unique", enable_backward=False)
def nine_kernel(  # every gap is as wide as the first
    # in
    image: wp.array2d[float],
    queries: wp.array2d[float],
    elevations: wp.array[float],
    azimuths: wp.array[float],
    t: int,
    # out
    found_out: wp.array2d[float],
):
    q = wp.tid()
    i = int(wp.floor(queries[q, 0])) + t // 2
    j = int(wp.floor(queries[q, 1])) + t % 2
    up = 1 - 2 * (t // 2)  # from the neighbour towards the query
    right = 1 - 2 * (t % 2)
    gap_up = float(up) * (elevations[1] - elevations[0])
    gap_right = azimuths[j + right] - azimuths[j]
    angle_up = wp.abs(queries[q, 0] - float(i)) * gap_up
    angle_right = wp.abs(queries[q, 1] - float(j)) * gap_right

    u = inverse(image[i, j])
    v = wp.vec3(
        continued(u, inverse(image[i - up, j]), -float(up) * (elevations[1] - elevations[0]), angle_up),
        continued(u, inverse(image[i + up, j]), gap_up, angle_up),
        0.0,
    )
    h = wp.vec3(
        continued(u, inverse(image[i, j - right]), azimuths[j - right] - azimuths[j], angle_right),
        continued(u, inverse(image[i, j + right]), gap_right, angle_right),
        0.0,
    )
    for a in range(3):
        for b in range(3):
            found_out[q, 3 * a + b] = inverse(wp.clamp(u + v[a] + h[b], 0.25 * u, 4.0 * u))


# %% tags=["wrong"]
@wp.kernel(module="unique", enable_backward=False)
def nine_kernel(  # row and column change places
    # in
    image: wp.array2d[float],
    queries: wp.array2d[float],
    elevations: wp.array[float],
    azimuths: wp.array[float],
    t: int,
    # out
    found_out: wp.array2d[float],
):
    q = wp.tid()
    i = int(wp.floor(queries[q, 0])) + t // 2
    j = int(wp.floor(queries[q, 1])) + t % 2
    up = 1 - 2 * (t // 2)  # from the neighbour towards the query
    right = 1 - 2 * (t % 2)
    gap_up = elevations[i + up] - elevations[i]
    gap_right = azimuths[j + right] - azimuths[j]
    angle_up = wp.abs(queries[q, 0] - float(i)) * gap_up
    angle_right = wp.abs(queries[q, 1] - float(j)) * gap_right

    u = inverse(image[i, j])
    v = wp.vec3(
        continued(u, inverse(image[i - up, j]), elevations[i - up] - elevations[i], angle_up),
        continued(u, inverse(image[i + up, j]), gap_up, angle_up),
        0.0,
    )
    h = wp.vec3(
        continued(u, inverse(image[i, j - right]), azimuths[j - right] - azimuths[j], angle_right),
        continued(u, inverse(image[i, j + right]), gap_right, angle_right),
        0.0,
    )
    for a in range(3):
        for b in range(3):
            found_out[q, 3 * b + a] = inverse(wp.clamp(u + v[a] + h[b], 0.25 * u, 4.0 * u))


# %% [markdown]
# What does one thread of your kernel read?

# %%
small_image = torch.full((7, 9), 10.0)
three_queries = torch.tensor([[1.5, 2.5], [2.3, 4.6], [3.5, 5.5]])
draw_trace(
    nine_kernel,
    1,
    [small_image, three_queries, torch.linspace(-0.2, 0.1, 7), torch.linspace(-0.1, 0.1, 9), 0, torch.zeros(3, 9)],
    "5 inverse ranges,\n4 changes,\n9 sums in registers",
)

# %% [markdown]
# *In words, once the kernel is there: five pixels of the image in the shape of a plus sign, one row of the queries,
# three elevations and three azimuths; it writes one row of nine numbers.*
#
# Four such plus signs make the 4×4 pixels around a query without its corners, 12 pixels. Are 36 hypotheses worth the
# trouble? The same oracle as in section 1, and another that is right nine times in ten and takes *any* of the 36 else:

# %%
found = surface_hypotheses(image, queries, elevations, azimuths)  # (Q, 4, 9)
candidates = found.where(found > 0, FAR).flatten(1)  # (Q, 36) metres
generator = torch.Generator().manual_seed(0)
anything = candidates.gather(1, torch.randint(36, (len(true), 1), generator=generator).to(device))[:, 0]
mistaken = (torch.rand(len(true), generator=generator) < 0.1).to(device)
print(f"{'the best of the 4 ranges':>36}:", judge(best_of(four)))
print(f"{'the best of the 36 hypotheses':>36}:", judge(best_of(candidates)))
print(f"{'the same, mistaken in 10 %':>36}:", judge(anything.where(mistaken, best_of(candidates))))

right = ((candidates - true[:, None]).abs() < 0.1).sum(1)
ranges_right = ((four - true[:, None]).abs() < 0.1).any(1)
print(f"one of the 4 ranges is right to 10 cm at {ranges_right.float().mean():.0%} of the queries,")
print(f"one of the 36 hypotheses at {(right > 0).float().mean():.0%}, nine or more at {(right > 8).float().mean():.0%}")

# %% [markdown]
# **Choosing a surface forgives mistakes, blending ranges does not.** A network that errs in one query of ten is still
# ahead of a blend whose weights are off by 1 %.
#
# ## 4. A mixture
#
# The network of `iln-surfaces` predicts ten numbers for each neighbour, 40 in all: a score $s_{tk}$ for each of its
# nine hypotheses, and a scale $b_t$, how far off they may be (softplus keeps it above 2 cm). The areas $a_t$ serve as a
# prior:
#
# $$w_{tk} = \operatorname{softmax}\big(s_{tk} + \log \max(a_t, 0.001)\big)$$
#
# It does not answer *the range is 19.4 m*. It answers *with 70 % it is this surface, with 30 % that one*: a **mixture**
# of 36 narrow peaks, each a Laplace density around a hypothesis.
#
# $$p(r) = (1 - 2\varepsilon) \sum_{tk} w_{tk}\, \frac{1}{2 b_t} e^{-|r_{tk} - r| / b_t} + \frac{\varepsilon}{R}
# \qquad\qquad
# p(\text{none}) = (1 - 2 \varepsilon) \sum_{tk} w_{tk} + \varepsilon$$
#
# The left sum runs over the hypotheses that return, the right one over those that do not. $\varepsilon = 0.001$ is for
# what no neighbour knows of, and $R$ = 100 m is what a no return counts as. Training makes what was measured likely:
# the loss is $-\log p(r)$, or $-\log p(\text{none})$ where nothing returned.
#
# Here is what the shipped network predicts for one query half way across an edge. (`scores` gives scores and scales.)

# %%
network = models.load("iln-surfaces").to(device)


@torch.no_grad()
def mixture(asked):
    """Hypotheses [m] (0: no return), weights and scales [m] of the shipped network for queries (Q, 2): each (Q, 36)."""
    encoded = network.encode(scan.filled()[None], sensor.wrap, sensor)
    scores, scales = network.scores(encoded, asked[None], sensor.wrap)
    f, g = (asked - asked.floor()).unbind(1)
    areas = torch.stack(((1 - f) * (1 - g), (1 - f) * g, f * (1 - g), f * g), 1)
    areas = areas.where(areas.amax(1, keepdim=True) > 0.999, areas.clamp(min=0.001))  # on a pixel it alone counts
    w = (scores[0] + areas.log()[..., None]).flatten(1).softmax(1)
    b = 0.5 * torch.nn.functional.softplus(scales[0]) + 0.02
    met = surface_hypotheses(image, asked, elevations, azimuths).flatten(1)
    return met, w, b.repeat_interleave(9, 1)


one, other = image[:, :-1], image[:, 1:]  # each column and the next: upright edges, as in notebook 03
agree = (one.diff(dim=0).abs() < 0.5) & (other.diff(dim=0).abs() < 0.5)
cell = torch.stack((one[:-1], other[:-1], one[1:], other[1:]))
jump = (cell.amax(0) - cell.amin(0)).where(agree & (cell > 0).all(0) & (cell < 40).all(0), 0.0)
EDGES = [divmod(int(place), jump.shape[1]) for place in jump.flatten().topk(12).indices.cpu()]
SHOWN = 8  # the edge that the next pictures show

# %% tags=["hide-input"]
row, column = EDGES[SHOWN]
met, w, b = (x[0].cpu() for x in mixture(torch.tensor([[row + 0.5, column + 0.5]], device=device)))
r = torch.linspace(0.5 * met[met > 0].min().item(), 1.1 * met.max().item(), 4000)
density = (w * (met > 0) * (-(met - r[:, None]).abs() / b).exp() / (2 * b)).sum(1)
axes = plt.figure(figsize=(9, 2.6), layout="constrained").subplots()
axes.fill_between(r, density, color=BLUE, alpha=0.4, lw=0)
axes.plot(r, density, color=BLUE, lw=1, label="density")
axes.plot(met, torch.full_like(met, 2e-4), "|", color="black", markersize=12, label="36 hypotheses")
axes.set(yscale="log", ylim=(1e-4, 30), xlabel="range [m]", ylabel="density [1/m]")
axes.legend(frameon=False, loc="upper center")
plt.show()

# %% [markdown]
# *In words: density over range, on a logarithmic axis. Four narrow peaks: high ones at 17 m and 38 m, low ones at 13 m
# and 23 m. At the bottom the 36 hypotheses as short lines, most of them on top of one another.*
#
# Something at 17 m stands in front of a wall at 38 m, and the network believes in both. What bridges the jump (23 m) or
# prolongs it (13 m) it has nearly ruled out.
#
# ### Exercise 3 · The likelihood
#
# importance ★★★ · difficulty ★★☆ · 10 minutes
#
# Write `negative_log_likelihood(found, w, b, r)`: minus the logarithm of the likelihood, (Q,), of measured ranges r
# (Q,) [m], 0 where nothing returned. Hypotheses `found` [m] (0: no return), weights `w` and scales `b` [m] are (Q, 36).
# Use $\varepsilon$ = 0.001 and `FAR` for $R$.
#
# <details><summary>Hint</summary>
#
# Compute both cases for all queries, and choose with `torch.where(r > 0, ..., ...)`. `found > 0` are the hypotheses
# that return. The logarithm comes last, after the sum.
#
# </details>


# %% tags=["exercise"]
def negative_log_likelihood(found, w, b, r):
    raise NotImplementedError


# %% tags=["solution"]
def negative_log_likelihood(found, w, b, r):
    peaks = (-(found - r[:, None]).abs() / b).exp() / (2 * b)
    of_range = 0.998 * (w * peaks * (found > 0)).sum(1) + 0.001 / FAR
    of_none = 0.998 * (w * (found == 0)).sum(1) + 0.001
    return -torch.where(r > 0, of_range, of_none).log()


# %% tags=["check"]
@check
def _():
    def ask(r, met=((10.0, 30.0, 0.0),), w=((0.5, 0.3, 0.2),), b=((0.1, 0.1, 0.1),)):
        return negative_log_likelihood(*(torch.tensor(x) for x in (met, w, b)), torch.tensor([r]))

    mine = ask(10.0)
    assert mine.shape == (1,), f"one number for each query: (1,), not {tuple(mine.shape)}"
    wanted = -math.log(0.998 * 0.5 / 0.2 + 1e-5)
    assert abs(mine - wanted) < 1e-4, f"on a peak of weight 0.5 and scale 0.1 m: {wanted:.4f}, not {mine.item():.4f}"
    assert abs(ask(30.1) - (-math.log(0.998 * 0.3 / 0.2 / math.e + 1e-5))) < 1e-3, (
        f"one scale beside a peak it is 1 more than on it: {-math.log(0.998 * 0.3 / 0.2 / math.e):.3f}, "
        f"not {ask(30.1).item():.3f}"
    )
    assert abs(ask(20.0) - 11.513) < 1e-2, f"where no hypothesis is, ε/R is left: 11.513, not {ask(20.0).item():.3f}"
    assert abs(ask(0.0) - (-math.log(0.998 * 0.2 + 0.001))) < 1e-4, (
        f"nothing returned, which has a weight of 0.2: {-math.log(0.998 * 0.2 + 0.001):.4f}, not {ask(0.0).item():.4f}"
    )
    assert abs(ask(0.05) - 11.513) < 1e-2, "a hypothesis of no return is none of a range of 0 m"
    encoded = network.encode(scan.filled()[None], sensor.wrap, sensor)
    with torch.no_grad():
        scores, scales = network.scores(encoded, queries[None], sensor.wrap)
    targets = true.where(true < FAR, 0.0)
    op = surface_likelihood(image[None], queries[None], elevations, azimuths, scores, scales, targets[None], FAR)[0][0]
    mine = negative_log_likelihood(*mixture(queries), targets)
    off = (mine - op).abs().max()
    assert off < 0.05, f"on the scan you and kernels.surface_likelihood are up to {off:.3f} apart"
    print(f"mean over the scan: {mine.mean():.4f} (kernels.surface_likelihood: {op.mean():.4f})")


# %% tags=["wrong"]
def negative_log_likelihood(found, w, b, r):  # without what no hypothesis explains
    peaks = (-(found - r[:, None]).abs() / b).exp() / (2 * b)
    return -torch.where(r > 0, (w * peaks * (found > 0)).sum(1), (w * (found == 0)).sum(1)).log()


# %% tags=["wrong"]
def negative_log_likelihood(found, w, b, r):  # the mean of the logarithms
    peaks = (-(found - r[:, None]).abs() / b).exp() / (2 * b)
    of_range = (w * (0.998 * peaks * (found > 0) + 0.001 / FAR).log()).sum(1)
    return -torch.where(r > 0, of_range, (0.998 * (w * (found == 0)).sum(1) + 0.001).log())


# %% tags=["wrong"]
def negative_log_likelihood(found, w, b, r):  # a density that does not sum to 1
    peaks = (-(found - r[:, None]).abs() / b).exp()
    of_range = 0.998 * (w * peaks * (found > 0)).sum(1) + 0.001 / FAR
    return -torch.where(r > 0, of_range, 0.998 * (w * (found == 0)).sum(1) + 0.001).log()


# %% tags=["wrong"]
def negative_log_likelihood(found, w, b, r):  # no return is a range of 0 m
    peaks = (-(found - r[:, None]).abs() / b).exp() / (2 * b)
    of_range = 0.998 * (w * peaks).sum(1) + 0.001 / FAR
    return -torch.where(r > 0, of_range, 0.998 * (w * (found == 0)).sum(1) + 0.001).log()


# %% [markdown]
# Why not the L1 loss of notebooks 04 and 05? Take an edge whose place the image does not tell: the left pixels are 10 m
# away, the right ones 30 m, and half way between them 70 of 100 rays meet the near wall. No network here, just the
# scores themselves, learned with three losses.
#
# **Predict:** which of the losses finds 70 % and 30 %? What do the others find?

# %%
pair = torch.tensor([[[10.0, 30.0], [10.0, 30.0]]])
tables = torch.tensor([-0.02, 0.02]), torch.tensor([-0.003, 0.003])
middle = torch.full((1, 100, 2), 0.5)
rays = torch.where(torch.arange(100) < 70, 10.0, 30.0)[None]  # (1, 100)
met = surface_hypotheses(pair, middle, *tables, wrap=False)  # (1, 100, 4, 9)


def learn(loss):
    """Weight of the near wall and of the far one, and the blended mean [m], after learning the scores of this query."""
    scores, scales = torch.zeros(1, 1, 4, 9, requires_grad=True), torch.zeros(1, 1, 4, requires_grad=True)
    optimizer = torch.optim.Adam([scores, scales], 0.1)
    for _ in range(300):
        optimizer.zero_grad()
        loss(scores.expand(1, 100, 4, 9), scales.expand(1, 100, 4)).backward()
        optimizer.step()
    w = scores.detach().flatten().softmax(0)
    walls = met[0, 0].flatten()
    return [w[(walls - wall).abs() < 0.1].sum().item() for wall in (10, 30)], (w * walls).sum().item()


def likelihood(scores, scales):
    return surface_likelihood(pair, middle, *tables, scores, scales, rays, FAR, wrap=False)[0].mean()


def blended(scores):
    return (scores.flatten(2).softmax(2) * met.flatten(2)).sum(2)


losses = {
    "likelihood of the mixture": likelihood,
    "L1 of the blended mean": lambda scores, scales: (blended(scores) - rays).abs().mean(),
    "squared error of the mean": lambda scores, scales: (blended(scores) - rays).square().mean(),
}
learned = {name: learn(loss) for name, loss in losses.items()}
for name, ((near, far), mean) in learned.items():
    print(f"{name:>26}: near wall {near:.0%}, far wall {far:.0%}, mean {mean:.1f} m")
(near, far), _ = learned["likelihood of the mixture"]
assert abs(near - 0.7) < 0.02
assert abs(far - 0.3) < 0.02

# %% [markdown]
# The likelihood finds what is true of this edge: 70 % and 30 %. L1 puts all weight on the near wall. That is
# the best single range, but no doubt is left in the weights. The squared error settles on 16 m, in empty air. Only the
# first can tell afterwards how sure it is.
#
# (The shipped network was trained with the likelihood plus the expected absolute error $\sum w_{tk} |r_{tk} - r|$,
# which keeps it from very large errors. Without the likelihood, small networks of this kind reach an IoU of .424
# instead of .572: `python -m ilnet experiment surfaces`, table in `ilnet/results`.)
#
# ## 5. A median does not float between surfaces
#
# A mixture is not an answer: one range is wanted. The mean $\sum w_{tk} r_{tk}$ is a blend again. With 70 % at 10 m and
# 30 % at 30 m it lies at 16 m, where nothing is. The **weighted median** is the smallest $r_{tk}$ such that the
# hypotheses that are no farther hold at least half of the weight. It has two virtues: of all answers it has the least
# expected absolute error, and it *is* one of the hypotheses: it never lies between two of them.
#
# ### Exercise 4 · The weighted median
#
# importance ★★☆ · difficulty ★★☆ · 15 minutes
#
# Write `median_kernel`, one thread per query. Weights are positive and need not sum to 1. Sorting in a thread is
# awkward; 36 numbers are few enough to do without.
#
# <details><summary>Hint</summary>
#
# For each hypothesis n, add up the weights of all j with `ranges[q, j] <= ranges[q, n]`. If that is at least half of
# the whole, n is a candidate, and the nearest candidate is the median: two loops, one within the other, and
# `median = float(wp.inf)` to start with. `float(0.0)` makes a sum that a loop may change.
#
# </details>


# %% tags=["exercise"]
@wp.kernel(module="unique", enable_backward=False)
def median_kernel(
    # in
    ranges: wp.array2d[float],  # (Q, N) metres; no return counts as FAR
    weights: wp.array2d[float],  # (Q, N)
    # out
    median_out: wp.array[float],  # (Q,) metres
):
    raise NotImplementedError


# %% tags=["solution"]
@wp.kernel(module="unique", enable_backward=False)
def median_kernel(
    # in
    ranges: wp.array2d[float],
    weights: wp.array2d[float],
    # out
    median_out: wp.array[float],
):
    q = wp.tid()
    whole = float(0.0)
    for k in range(weights.shape[1]):
        whole += weights[q, k]
    median = float(wp.inf)
    for n in range(ranges.shape[1]):
        nearer = float(0.0)
        for j in range(ranges.shape[1]):
            if ranges[q, j] <= ranges[q, n]:
                nearer += weights[q, j]
        if nearer >= 0.5 * whole:
            median = wp.min(median, ranges[q, n])
    median_out[q] = median


# %% tags=["check"]
@check
def _():
    def ask(ranges, weights):
        ranges, weights = torch.tensor([ranges], device=device), torch.tensor([weights], device=device)
        median = torch.full((1,), torch.nan, device=device)
        run(median_kernel, 1, [ranges, weights], [median])
        return median.item()

    assert ask([10.0, 30.0], [0.7, 0.3]) == 10, f"70 % at 10 m, 30 % at 30 m: 10 m, not {ask([10.0, 30.0], [0.7, 0.3])}"
    mine = ask([30.0, 10.0, 20.0, 11.0], [0.1, 0.3, 0.35, 0.25])
    assert mine == 11, f"up to 10 m lies 0.3 of the weight, up to 11 m 0.55: 11 m, not {mine}. Are they in order?"
    mine = ask([10.0, 30.0], [1.4, 0.6])
    assert mine == 10, f"weights 1.4 and 0.6: half of the whole is 1, so it is 10 m, not {mine}"
    mine = ask([30.0, 10.0], [1.4, 0.6])
    assert mine == 30, f"weights 1.4 at 30 m and 0.6 at 10 m: 30 m, not {mine}"
    mine = ask([12.0, 12.0, 12.0, 9.0], [0.2, 0.2, 0.2, 0.4])
    assert mine == 12, f"three hypotheses agree on 12 m and hold 0.6: 12 m, not {mine}"
    assert ask([10.0, 30.0], [0.5, 0.5]) == 10, "exactly half is enough: the nearer one"
    met, w, _ = mixture(queries)
    mine = torch.full_like(true, torch.nan)
    run(median_kernel, len(true), [met.where(met > 0, FAR), w], [mine])
    encoded = network.encode(scan.filled()[None], sensor.wrap, sensor)
    with torch.no_grad():
        scores, scales = network.scores(encoded, queries[None], sensor.wrap)
    op = surface_median(image[None], queries[None], elevations, azimuths, scores, scales)[0][0]
    same = ((mine - op.where(op > 0, FAR)).abs() < 1e-2).float().mean()
    assert same > 0.999, f"on the scan {same:.2%} of your answers are those of kernels.surface_median"
    print(f"on the scan {same:.2%} of the answers are within 1 cm of those of kernels.surface_median")


# %% tags=["wrong"]
@wp.kernel(module="unique", enable_backward=False)
def median_kernel(ranges: wp.array2d[float], weights: wp.array2d[float], median_out: wp.array[float]):  # the mean
    q = wp.tid()
    total = float(0.0)
    whole = float(0.0)
    for k in range(weights.shape[1]):
        total += weights[q, k] * ranges[q, k]
        whole += weights[q, k]
    median_out[q] = total / whole


# %% tags=["wrong"]
@wp.kernel(module="unique", enable_backward=False)
def median_kernel(ranges: wp.array2d[float], weights: wp.array2d[float], median_out: wp.array[float]):  # the likeliest
    q = wp.tid()
    best = int(0)
    for k in range(weights.shape[1]):
        if weights[q, k] > weights[q, best]:
            best = k
    median_out[q] = ranges[q, best]


# %% tags=["wrong"]
@wp.kernel(module="unique", enable_backward=False)
def median_kernel(ranges: wp.array2d[float], weights: wp.array2d[float], median_out: wp.array[float]):  # half is 0.5
    q = wp.tid()
    median = float(wp.inf)
    for n in range(ranges.shape[1]):
        nearer = float(0.0)
        for j in range(ranges.shape[1]):
            if ranges[q, j] <= ranges[q, n]:
                nearer += weights[q, j]
        if nearer >= 0.5:
            median = wp.min(median, ranges[q, n])
    median_out[q] = median


# %% [markdown]
# Mean and median of the very same mixtures, over the whole scan. And the median of a network that was never trained:
# its scores are 0, so that the areas alone weigh the hypotheses.
#
# **Predict:** how do mean and median differ in IoU, in MAE, and in the share of floating points?

# %%
met, w, b = mixture(queries)
encoded = network.encode(scan.filled()[None], sensor.wrap, sensor)
with torch.no_grad():
    scores, scales = network.scores(encoded, queries[None], sensor.wrap)


def median_of(scores, scales):
    """Weighted median (Q,) [m], no return as 100 m, and the confidence (Q,)."""
    ranges, support, _ = surface_median(image[None], queries[None], elevations, azimuths, scores, scales)
    return ranges[0].where(ranges[0] > 0, FAR), support[0].sum(1)


median, confidence = median_of(scores, scales)
mean = (w * met.where(met > 0, FAR)).sum(1)
print(f"{'mean':>20}:", judge(mean))
print(f"{'median':>20}:", judge(median))
print(f"{'median, untrained':>20}:", judge(median_of(0 * scores, 0 * scales)[0]))
for name in ("iln", "planes"):
    print(f"{name:>20}:", judge(models.load(name).to(device).ranges(scan, fine).clamp(max=FAR).view(-1)))

# %% [markdown]
# Their MAE is the same. The mean has the lower IoU and six times as many floating points. What still floats with the
# median are hypotheses that are wrong, such as a surface that is continued into the air. Untrained, the mixture already
# has a higher IoU than ILN: that is what surfaces know without a network, though more of its points float. What
# training adds is the choice.
#
# ## 6. Across an edge
#
# What does the network choose while a query walks from one column to the next, across an upright edge? We ask along
# the row, and add its weights up by side and by way along the row.
#
# **Predict:** where will the colours change: in the middle, gradually over the whole way, or at the truth's jump?


# %% tags=["hide-input"]
def draw_walk(number=SHOWN):
    """The answers on a walk across an edge, and the weights by neighbour and way."""
    row, column = EDGES[number]
    parts = torch.linspace(0, 1, 121)[1:-1]
    walk = torch.stack((torch.full_like(parts, row + 0.5), column + parts), 1).to(device)
    alpha = torch.full_like(parts, sensor.elevations[row : row + 2].mean(), dtype=torch.float64)
    beta = float(sensor.azimuths[column]) + parts.double() * float(np.diff(sensor.azimuths[column : column + 2])[0])
    rays = angles_to_directions(alpha, beta)
    met_there = simulate.nearest([simulate.cast(mesh, pose, rays, sensor.max_range) for mesh in world]).cpu()
    met, w, _ = mixture(walk)
    with torch.no_grad():
        median = network(scan.filled()[None], walk[None], sensor.wrap, sensor)[0].cpu()
    mean = (w * met.where(met > 0, FAR)).sum(1).cpu()

    left, right = plt.figure(figsize=(10, 3.2), layout="constrained").subplots(1, 2)
    left.plot(parts, met_there.where(met_there > 0, torch.nan), color="black", lw=4, alpha=0.3, label="truth")
    left.plot(parts, mean, "--", color=ORANGE, lw=2, label="mean of the mixture")
    left.plot(parts, median, color=BLUE, lw=2, label="median: iln-surfaces")
    for side in (0, 1):
        pixels = image[row : row + 2, column + side].cpu()
        left.plot([side, side], pixels, "k^", label=None if side else "measured")
    left.set(xlabel="part of the way from column to column", ylabel="range [m]", title=f"edge {number}")
    left.legend(frameon=False, fontsize=8)

    w = (
        w.view(-1, 2, 2, 3, 3).sum((1, 3)).cpu()
    )  # rows and ways along the column added up: (Q, side, way along the row)
    bands = torch.cat((w[:, 0], w[:, 1].flip(1)), 1)  # left outer, inner, none; right none, inner, outer
    names = [f"left, {way}" for way in WAYS] + [f"right, {way}" for way in reversed(WAYS)]
    colours = ["#08519c", "#6baed6", "#c6dbef", "#fdd0a2", "#fd8d3c", "#a63603"]
    right.stackplot(parts, bands.T, labels=names, colors=colours)
    right.set(xlabel="part of the way", ylabel="weights", xlim=(0, 1), ylim=(0, 1))
    right.legend(fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5), frameon=False, reverse=True)
    plt.show()


draw_walk()

# %% [markdown]
# *In words: left, the truth jumps from 38 m down to 17 m at 0.65 of the way. The median jumps between the same levels
# at 0.51; the mean sinks slowly through all ranges between. Right, the weights as bands: first those of the left
# column, mostly "outer", from 0.4 to 0.6 they give way to "right, none".*
#
# On the left a wall goes on (*outer*), on the right stands something that is one column wide (*none*): the network has
# told them apart. Both levels are right to centimetres. **Where** between the columns the edge lies it cannot know,
# since nothing was measured there. So its weights are half and half in the middle, as in the experiment of section 4,
# and between 0.51 and 0.65 the answer is wrong. But the mixture shows the doubt.
#
# In a running notebook a slider shows the twelve strongest edges:

# %%
slide(draw_walk, number=(0, len(EDGES) - 1, 1))

# %% [markdown]
# ## 7. How sure?
#
# A mixture knows more than its median. The probability that the truth lies within 10 cm of the answer is the mass of
# the mixture there. We call it the **confidence**.
#
# ### Exercise 5 · Confidence
#
# importance ★★☆ · difficulty ★★☆ · 10 minutes
#
# Write `confidence_of(found, w, b, answer)`, (Q,): the probability, by the mixture of section 4, that the measured
# range lies within 0.1 m of the answers (Q,) [m]. All answers are returns; $\varepsilon$ may be left out. The
# probability that a Laplace variable around 0 of scale 1 is less than $x$ is $F(x) = \frac12 e^{x}$ for $x < 0$, and
# $1 - \frac12 e^{-x}$ else.
#
# <details><summary>Hint 1</summary>
#
# With $d$ for the answer minus a hypothesis, the peak's share within the limits is
# $F((d + 0.1) / b) - F((d - 0.1) / b)$.
#
# </details>
# <details><summary>Hint 2</summary>
#
# Both branches in one, without an overflow: `torch.where(x < 0, 0.5 * e, 1 - 0.5 * e)` with `e = (-x.abs()).exp()`.
# Hypotheses of no return contribute nothing.
#
# </details>


# %% tags=["exercise"]
def confidence_of(found, w, b, answer):
    raise NotImplementedError


# %% tags=["solution"]
def confidence_of(found, w, b, answer):
    def below(x):
        e = (-x.abs()).exp()
        return torch.where(x < 0, 0.5 * e, 1 - 0.5 * e)

    d = answer[:, None] - found
    inside = below((d + 0.1) / b) - below((d - 0.1) / b)
    return (w * inside * (found > 0)).sum(1)


# %% tags=["check"]
@check
def _():
    def ask(answer, met=(10.0, 10.3, 30.0, 0.0), w=(0.5, 0.2, 0.2, 0.1), b=(0.1, 0.2, 0.05, 0.1)):
        met, w, b = (torch.tensor([x]) for x in (met, w, b))
        return confidence_of(met, w, b, torch.tensor([answer]))

    assert ask(10.0).shape == (1,), f"one number for each query: (1,), not {tuple(ask(10.0).shape)}"
    one = ask(10.0, w=(1.0, 0.0, 0.0, 0.0)).item()
    assert abs(one - (1 - math.exp(-1))) < 1e-4, f"one peak of scale 0.1 m has 63.2 % within 0.1 m, not {one:.1%}"
    beside = ask(10.3, w=(1.0, 0.0, 0.0, 0.0)).item()
    wanted = 0.5 * (math.exp(-2) - math.exp(-4))
    assert abs(beside - wanted) < 1e-4, f"from 0.2 to 0.4 m beside that peak lie {wanted:.1%}, not {beside:.1%}"
    all_of = ask(10.0).item()
    wanted = 0.5 * (1 - math.exp(-1)) + 0.2 * 0.5 * (math.exp(-1) - math.exp(-2))
    assert abs(all_of - wanted) < 1e-4, f"the second peak reaches in: {wanted:.1%}, not {all_of:.1%}"
    assert abs(ask(0.05)) < 1e-4, "a hypothesis of no return is none of a range of 0 m"
    assert ask(60.0, b=(1e-3,) * 4).isfinite().all(), "far from a narrow peak exp overflows: see hint 2"
    returned = median < FAR
    mine = confidence_of(*(x[returned] for x in mixture(queries)), median[returned])
    off = (mine - confidence[returned]).abs().max()
    assert off < 0.02, f"on the scan you and kernels.surface_median are up to {off:.3f} apart"
    print(f"on the scan at most {off:.3f} from the confidence of kernels.surface_median, which counts ε")


# %% tags=["wrong"]
def confidence_of(found, w, b, answer):  # the weight of the hypotheses within 10 cm
    return (w * ((answer[:, None] - found).abs() < 0.1)).sum(1)


# %% tags=["wrong"]
def confidence_of(found, w, b, answer):  # the density, times 20 cm
    return (0.2 * w * (-(answer[:, None] - found).abs() / b).exp() / (2 * b) * (found > 0)).sum(1)


# %% tags=["wrong"]
def confidence_of(found, w, b, answer):  # without the weights
    def below(x):
        e = (-x.abs()).exp()
        return torch.where(x < 0, 0.5 * e, 1 - 0.5 * e)

    d = answer[:, None] - found
    return ((below((d + 0.1) / b) - below((d - 0.1) / b)) * (found > 0)).mean(1)


# %% tags=["wrong"]
def confidence_of(found, w, b, answer):  # overflows
    def below(x):
        return torch.where(x < 0, 0.5 * x.exp(), 1 - 0.5 * (-x).exp()) + 0 * x.exp() * (-x).exp()

    d = answer[:, None] - found
    return (w * (below((d + 0.1) / b) - below((d - 0.1) / b)) * (found > 0)).sum(1)


# %% [markdown]
# Is it true? Sort the predicted points by confidence into ten bins. Of those with a confidence around 80 %, 80 % should
# be right. `model.upsample` returns a scan with its confidence, and `calibration.reliability` compares it with the
# truth; the beams that were measured are left out.

# %%
dense = network.upsample(scan, fine)
bins = calibration.reliability(*calibration.told([dense], [(scan, truth)]))
print(f"expected calibration error: {calibration.calibration_error(bins):.3f}")

kept = calibration.without_least(dense, 0.1)
for name, one in (("all points", dense), ("without the least confident tenth", kept)):
    found = metrics.compare(one.filled(), truth)
    print(
        f"{name:>34}: floating {found['floating']:.2%}, precision {found['precision']:.3f}, recall {found['recall']:.3f}"
    )
assert calibration.calibration_error(bins) < 0.06

# %% tags=["hide-input"]
left, right = plt.figure(figsize=(10, 3.2), layout="constrained").subplots(1, 2, width_ratios=(1, 1.6))
left.plot((0, 1), (0, 1), ":", color=GREY)
left.plot([x.confidence for x in bins], [x.right for x in bins], "o-", color=BLUE)
left.set(xlabel="confidence", ylabel="share right to 10 cm", xlim=(0, 1), ylim=(0, 1), aspect="equal")
ahead = slice(384, 640)  # 90 degrees
shown = right.imshow(
    dense.confidence.where(dense.ranges > 0, torch.nan)[:, ahead].flip(0, 1).cpu(),
    cmap="viridis",
    vmin=0,
    vmax=1,
    extent=(45, -45, -15, 15),
    interpolation="nearest",
)
right.set(xlabel="azimuth [°]", ylabel="elevation [°]")
plt.colorbar(shown, label="confidence", fraction=0.02, pad=0.01)
plt.show()

# %% [markdown]
# *In words: left, the share of right points over their confidence. The dots follow the diagonal: up to 7 points above
# it below 0.4, up to 13 points below it from 0.5 to 0.9. Right, the confidence over 90° of the scan. Road and walls are
# bright. Dark lines run along the silhouettes of things and between the last beams that meet the road, and trees are
# dark.*
#
# So it is a little too sure of points that it gives 50 to 90 %. Without the least confident tenth next to nothing
# floats, for 2 points of recall.
#
# ## 8. Any sensor
#
# Nothing in sections 2 to 5 has asked how many beams there are, or that they are evenly spaced. Surfaces are continued
# over *angles*. Two of the twelve channels that the encoder sees are the spacing of rows and of columns
# (`ilnet/models/surfaces.py`, `describe`). The network was trained with sensors that were made up, a new one for each
# batch. So the same weights serve this one, whose 24 beams lie close together around the horizon and far apart above
# and below it:

# %%
degrees = np.concatenate(([-24, -19, -15, -12], np.linspace(-10, 2, 16), [4, 7, 11, 16]))
uneven = Sensor(np.deg2rad(degrees), np.linspace(-np.pi, np.pi, 900, endpoint=False), 0.5, 80, 100, name="uneven-24")
wanted = uneven.resize(96, 900)  # evenly spaced over the same field of view
seen, there = (simulate.scan(world, one, pose) for one in (uneven, wanted))
for name in ("bilinear", "planes", "iln", "iln-surfaces"):
    found = metrics.compare(models.load(name).to(device).ranges(seen, wanted).clamp(max=FAR), there)
    print(f"{name:>14}: IoU {found['iou']:.3f}, MAE {found['mae']:.2f} m, floating {found['floating']:.1%}")

# %% [markdown]
# (`planes`, the best rule without a network, counts rows as if they were evenly spaced. `iln` learned from the paper's
# 16 beams alone.)
#
# **Predict:** a driver often names the field of view and the number of beams, and no table. What if we believe that
# these 24 beams are evenly spaced?

# %%
even = uneven.resize(24, 900)  # the same field of view, and the wrong table
for name, one in (("the true table", uneven), ("evenly spaced", even)):
    found = metrics.compare(network.ranges(Scan(seen.ranges, one), wanted).clamp(max=FAR), there)
    print(f"{name:>14}: IoU {found['iou']:.3f}, MAE {found['mae']:.2f} m, floating {found['floating']:.1%}")

# %% [markdown]
# One wrong table costs more than any network gains: each row is taken for one that looks elsewhere. Any sensor is
# served, if it is described as it is.
#
# ## Summary
#
# 1. Choosing among the four ranges cannot win, and blending them takes weights that are right to a fraction of a
#    percent.
# 2. $1/r$ of a plane is known from two pixels, at any angle. So each neighbour has nine hypotheses about what a query
#    meets: its surface goes on with the outer pixel, with the inner one, or not at all, along columns and along rows.
# 3. On planes the hypotheses agree, at edges they part. The network predicts which surface it is, as a mixture that is
#    trained by its likelihood.
# 4. The answer is the weighted median. It is one of the hypotheses, so that hardly any point floats. The mixture also
#    tells how sure it is, and that is close to the truth.
# 5. Surfaces go on over angles. One network serves any beam table, if the table is right.
#
# ## Next
#
# [09 · Your own sensor](09_your_own_sensor.ipynb) uses this network on scans from files. The kernels are in
# `kernels/surfaces`: `maths.py` derives what you wrote here, and computes it for 16 queries at a time.
