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
# # 02 · Casting rays
#
# ![A street of a town in 16 x 1024 rays of the notebook's own kernel: above the ranges, below the cosine of the angle
# at which each ray meets its surface](pictures/02_casting_rays.png)
#
# **Goal.** You write the program that measures ranges: kernels in NVIDIA Warp with one thread per ray, from a flat
# ground to a town of a million triangles.
#
# **After this notebook you can**
#
# - write a Warp kernel, launch it on PyTorch tensors without a copy, and say what one thread reads and writes;
# - intersect a ray with a plane, a sphere and a triangle, in all the cases in which there is nothing to be met;
# - say why testing every triangle is hopeless, and use a tree of boxes instead;
# - cast a scan of a town, and read its ranges, triangles and angles of incidence.
#
# | | |
# |---|---|
# | You know | [01 · What a LiDAR measures](01_what_a_lidar_measures.ipynb): directions, range images, no return |
# | Time | 45 minutes, and 30 for the exercises; half a minute to run |
# | Hardware | any computer; a CUDA GPU is used if there is one |

# %%
import math
import time

import matplotlib.pyplot as plt
import numpy as np
import pyvista
import torch
import warp as wp

from ilnet import simulate, towns
from ilnet.course import Cells, check, draw_thread, show_scene
from ilnet.sensor import preset
from kernels import Mesh
from kernels.launch import initialise

pyvista.vtk_verbosity("off")  # where there is no screen VTK warns of its absence, then renders all the same
device = "cuda" if torch.cuda.is_available() else "cpu"
BLUE, VERMILION, GREY = "#0072b2", "#d55e00", "#999999"

initialise()  # starts Warp without its greeting
if device == "cuda":  # Warp shall queue its work behind PyTorch's
    wp.set_stream(wp.stream_from_torch(torch.cuda.current_stream()))

# %% [markdown]
# ## 1. One thread per ray
#
# A scan has tens of thousands of rays, and none of them needs to know of the others. That is what a *kernel* is for: a
# function that is written for **one** ray and run by as many *threads* as there are rays, side by side on the cores of
# a GPU, one after the other on a core of a CPU. [Warp](https://nvidia.github.io/warp/) compiles such functions from
# Python source for both.
#
# The first kernel computes the direction of a ray from its two angles, as you did in the notebook before.
#
# | equation | line of code | kernel argument |
# |---|---|---|
# | ray $(i, j)$ | `i, j = wp.tid()` | the number of the thread; the launch says how many there are |
# | $\epsilon_i$ | `elevation = elevations[i]` | `elevations: wp.array[float]`, (H,) |
# | $\alpha_j$ | `azimuth = azimuths[j]` | `azimuths: wp.array[float]`, (W,) |
# | $\mathbf d_{ij}$ | `directions_out[i, j] = wp.vec3(...)` | `directions_out: wp.array2d[wp.vec3]`, (H, W) |


# %%
@wp.kernel(enable_backward=False, module="unique")
def look_kernel(
    # in
    elevations: wp.array[float],
    azimuths: wp.array[float],
    # out
    directions_out: wp.array2d[wp.vec3],
):
    i, j = wp.tid()  # which ray am I?
    elevation = elevations[i]
    azimuth = azimuths[j]
    shadow = wp.cos(elevation)
    directions_out[i, j] = wp.vec3(shadow * wp.cos(azimuth), shadow * wp.sin(azimuth), wp.sin(elevation))


draw_thread(
    "look_kernel: one thread per ray, here (2, 3)",
    [Cells("elevations", (4, 1), [(2, 0)]), Cells("azimuths", (1, 6), [(0, 3)])],
    "elevation, azimuth\ncos, sin\none vec3",
    [Cells("directions_out", (4, 6), [(2, 3)])],
)

# %% [markdown]
# *In words: on the left the two tables; the thread reads one element of each. On the right the grid of directions; it
# writes one element.*
#
# A kernel looks like Python but is a smaller language:
#
# - every argument has a type, and every variable keeps the type it begins with: `0.0` is a float, `0` an int;
#   one that a loop changes begins as `float(0.0)` or `int(0)`;
# - `wp.cos`, `wp.dot`, `wp.vec3` are Warp's; a `list`, a string or a PyTorch function have no place in it. Write `wp.`
#   even where another name happens to work;
# - it returns nothing. It writes into arrays that it was given, and **no two threads write to the same element**:
#   nobody says which comes last. (On one core of a CPU threads run in turn, so that such a mistake may not show.)
#
# The decorator's two settings: Warp would also make the derivative of each kernel, for training (notebook 06a). We need
# none here, and `enable_backward=False` saves the time of compiling it. With `module="unique"` each kernel is compiled for itself;
# otherwise all kernels of a notebook are compiled together, and a mistake in one stops them all.
#
# A launch hands over tensors. `wp.from_torch` makes a Warp array of a tensor **without a copy**: both see the same
# memory. With `dtype=wp.vec3` the last dimension, of 3, becomes the vector.
#
# **Predict:** the first launch compiles the kernel. How much longer does it take than the second?

# %%
sensor = preset("paper-16x1024")
elevations = torch.tensor(sensor.elevations, dtype=torch.float32, device=device)
azimuths = torch.tensor(sensor.azimuths, dtype=torch.float32, device=device)
directions = torch.full((*sensor.shape, 3), torch.nan, device=device)  # NaN: what no thread writes will show

for attempt in ("first", "second"):
    start = time.perf_counter()
    wp.launch(
        look_kernel,
        dim=sensor.shape,  # H x W threads
        inputs=[wp.from_torch(elevations), wp.from_torch(azimuths)],
        outputs=[wp.from_torch(directions, dtype=wp.vec3)],
        device=device,
    )
    wp.synchronize_device(device)  # a GPU is only told to work; here we wait for it
    print(f"{attempt} launch: {1000 * (time.perf_counter() - start):.2f} ms")

assert torch.allclose(directions, sensor.directions().to(device), atol=1e-6)
assert wp.from_torch(directions, dtype=wp.vec3).ptr == directions.data_ptr()  # one memory, two names

# %% [markdown]
# The very first time it takes a second or so. What was compiled lies in a folder of Warp's, and from then on the first
# launch only loads it: the outputs printed in this course come from such a second run, so that you see milliseconds.
#
# From now on a small function of our own launches for us: N threads, tensors in, tensors out. Tensors whose last
# dimension is 3 are taken as vectors.


# %%
def run(kernel, threads, inputs, outputs):
    def to_warp(argument):
        if not isinstance(argument, torch.Tensor):
            return argument  # numbers, vectors, and ids, which we shall meet in section 5
        vectors = argument.ndim > 1 and argument.shape[-1] == 3
        return wp.from_torch(argument, dtype=wp.vec3 if vectors else None)

    arguments = [to_warp(argument) for argument in inputs], [to_warp(argument) for argument in outputs]
    wp.launch(kernel, threads, *arguments, device=device)


# %% [markdown]
# ## 2. A plane, by hand
#
# A ray starts at $\mathbf o$ and runs along the unit vector $\mathbf d$: its points are $\mathbf o + r\,\mathbf d$ with
# $r > 0$. Its *range* is the smallest such $r$ at which it meets something. The simplest something is level ground,
# $z = 0$: there $o_z + r\,d_z = 0$, so
#
# $$r = -\frac{o_z}{d_z}.$$
#
# **Predict:** for which two kinds of rays is that no answer?
#
# <details><summary>Answer</summary>
#
# - $d_z = 0$: the ray runs level and never comes down. A kernel does not stop at a division by zero, it goes on with
#   infinity.
# - $r < 0$: the formula knows lines, not rays. It finds the ground *behind* a ray that looks up.
#
# </details>
#
# Both are **misses**, and a miss is range 0. What kernels share is written as a `wp.func`. It can be called from Python
# as well, which is handy for trying it out.


# %%
@wp.func
def ground_range(origin: wp.vec3, direction: wp.vec3) -> float:
    """Range to the plane z = 0; 0 where it is not met."""
    if direction[2] == 0.0:
        return 0.0
    return wp.max(-origin[2] / direction[2], 0.0)


@wp.kernel(enable_backward=False, module="unique")
def cast_ground_kernel(
    # in
    origin: wp.vec3,
    directions: wp.array[wp.vec3],
    # out
    ranges_out: wp.array[float],
):
    i = wp.tid()
    ranges_out[i] = ground_range(origin, directions[i])


for name, ray in (("down", (0.0, 0.0, -1.0)), ("level", (1.0, 0.0, 0.0)), ("up", (0.6, 0.0, 0.8))):
    print(f"{name:>5}: {ground_range(wp.vec3(0.0, 0.0, 1.8), wp.vec3(*ray)):.2f} m")

rays = directions.view(-1, 3)  # (N, 3), one thread each
ground = torch.full_like(rays[:, 0], torch.nan)
run(cast_ground_kernel, len(rays), [wp.vec3(0.0, 0.0, 1.8), rays], [ground])

ground = ground.view(sensor.shape)
assert (ground[8:] == 0).all()  # the eight beams that look up
assert torch.allclose(ground[0], 1.8 / torch.sin(-elevations[0]))  # h / sin(-elevation)

# %% [markdown]
# ### Exercise 1 · Any plane
#
# importance ★★★ · difficulty ★☆☆ · 6 minutes
#
# A plane is given by a normal $\mathbf n$, of any length but 0, and an offset $c$: its points are those with
# $\mathbf n \cdot \mathbf p = c$. Write the `wp.func` `plane_range`: the range at which the ray meets the plane, 0
# where it does not. A ray that runs parallel to the plane misses it, even inside it.
#
# <details><summary>Hint</summary>
#
# Put $\mathbf p = \mathbf o + r\,\mathbf d$ into the equation of the plane and solve for $r$. The dot product is
# `wp.dot(a, b)`. A miss is `0.0`, not `0`, which would be an int.
#
# </details>
#
# <details><summary>Hint</summary>
#
# $r = (c - \mathbf n \cdot \mathbf o) / (\mathbf n \cdot \mathbf d)$. Test the denominator first, the sign afterwards.
#
# </details>


# %% tags=["exercise"]
@wp.func
def plane_range(origin: wp.vec3, direction: wp.vec3, normal: wp.vec3, offset: float) -> float:
    raise NotImplementedError


# %% tags=["solution"]
@wp.func
def plane_range(origin: wp.vec3, direction: wp.vec3, normal: wp.vec3, offset: float) -> float:
    along = wp.dot(normal, direction)
    if along == 0.0:
        return 0.0
    return wp.max((offset - wp.dot(normal, origin)) / along, 0.0)


# %% tags=["check"]
@check
def _():
    plane_range(wp.vec3(0.0, 0.0, 1.0), wp.vec3(0.0, 0.0, -1.0), wp.vec3(0.0, 0.0, 1.0), 0.0)  # is there an answer?

    @wp.kernel(enable_backward=False, module="unique")
    def check_plane_kernel(
        origin: wp.vec3, directions: wp.array[wp.vec3], normal: wp.vec3, offset: float, ranges_out: wp.array[float]
    ):
        i = wp.tid()
        ranges_out[i] = plane_range(origin, directions[i], normal, offset)

    def meet(origin, direction, normal, offset):
        ray, met = torch.tensor([direction], device=device), torch.full((1,), torch.nan, device=device)
        run(check_plane_kernel, 1, [wp.vec3(*origin), ray, wp.vec3(*normal), offset], [met])
        return met.item()

    cases = {
        "a wall at x = 10, seen from x = 4 straight on": ((4, 0, 0), (1, 0, 0), (1, 0, 0), 10, 6),
        "the same wall, its normal the other way and twice as long": ((4, 0, 0), (1, 0, 0), (-2, 0, 0), -20, 6),
        "the same wall at a slant: range is along the ray": ((4, 0, 0), (0.6, 0.8, 0), (1, 0, 0), 10, 10),
        "the wall is behind the ray, which meets nothing": ((4, 0, 0), (-1, 0, 0), (1, 0, 0), 10, 0),
        "a ray parallel to the wall meets nothing": ((4, 0, 0), (0, 1, 0), (1, 0, 0), 10, 0),
        "a ray that runs inside the plane counts as a miss": ((10, 0, 0), (0, 0, 1), (1, 0, 0), 10, 0),
        "a roof above, z = 5, seen from below": ((0, 0, 2), (0, 0, 1), (0, 0, 1), 5, 3),
        "a slope through the origin of the frame": ((0, 0, 2), (0, 0, -1), (1, 0, 1), 0, 2),
    }
    for name, (origin, direction, normal, offset, wanted) in cases.items():
        got = meet(*(tuple(map(float, vector)) for vector in (origin, direction, normal)), float(offset))
        assert abs(got - wanted) < 1e-5, f"{name}: range {wanted}, you have {got:.3f}"


# %% tags=["wrong"]
@wp.func
def plane_range(origin: wp.vec3, direction: wp.vec3, normal: wp.vec3, offset: float) -> float:  # sees behind itself
    along = wp.dot(normal, direction)
    if along == 0.0:
        return 0.0
    return (offset - wp.dot(normal, origin)) / along


# %% tags=["wrong"]
@wp.func
def plane_range(origin: wp.vec3, direction: wp.vec3, normal: wp.vec3, offset: float) -> float:  # takes |r|
    along = wp.dot(normal, direction)
    if along == 0.0:
        return 0.0
    return wp.abs((offset - wp.dot(normal, origin)) / along)


# %% tags=["wrong"]
@wp.func
def plane_range(origin: wp.vec3, direction: wp.vec3, normal: wp.vec3, offset: float) -> float:  # forgets parallel rays
    range = (offset - wp.dot(normal, origin)) / wp.dot(normal, direction)
    if range < 0.0:
        return 0.0
    return range


# %% tags=["wrong"]
@wp.func
def plane_range(origin: wp.vec3, direction: wp.vec3, normal: wp.vec3, offset: float) -> float:  # distance, not range
    if wp.dot(normal, direction) == 0.0:
        return 0.0
    return wp.max((offset - wp.dot(normal, origin)) / wp.length(normal) * wp.sign(wp.dot(normal, direction)), 0.0)


# %% [markdown]
# ## 3. A sphere
#
# The points of a sphere have distance $R$ from its centre $\mathbf c$. With $\mathbf v = \mathbf o - \mathbf c$ the ray
# meets it where
#
# $$|\mathbf v + r\,\mathbf d|^2 = R^2 \quad\Longleftrightarrow\quad r^2 + 2\,b\,r + c = 0 \quad\text{with}\quad
# b = \mathbf v \cdot \mathbf d, \quad c = \mathbf v \cdot \mathbf v - R^2,$$
#
# since $\mathbf d \cdot \mathbf d = 1$. (Plain $c$ is a number, bold $\mathbf c$ the centre.) Such an equation has two
# solutions, $-b - \sqrt q$ and $-b + \sqrt q$ with $q = b^2 - c$, one where $q = 0$, and none where $q < 0$.

# %%
cases = {  # where the ray starts (it runs to the right), and its name
    "A: passes": (-3, 1.5),
    "B: touches": (-3, 1.0),
    "C: goes through": (-3, 0.4),
    "D: starts inside": (-0.3, -0.15),
    "E: starts behind": (1.6, -0.65),
}


def draw_rays(solved):
    axes = plt.figure(figsize=(8, 4.2), layout="constrained").subplots()
    axes.add_patch(plt.Circle((0, 0), 1, fill=False, linewidth=1.5))
    for name, (x, y) in cases.items():
        axes.annotate("", (x + 4.2, y), (x, y), arrowprops={"arrowstyle": "->", "color": GREY})
        axes.plot(x, y, "s", color=BLUE, markersize=5)
        axes.annotate(name, (x, y), (0, 5), textcoords="offset points", fontsize=9)
        half = math.sqrt(max(1 - y * y, 0))
        for number, root in enumerate(sorted({-half, half}) if solved and abs(y) <= 1 else []):
            ahead = root > x
            axes.plot(root, y, "o", color=VERMILION if ahead else "white", markeredgecolor=VERMILION, markersize=7)
            sign = ("$-$", "$+$")[number] if half else "$\\pm$"
            box = {"fc": "white", "lw": 0, "pad": 0}
            axes.annotate(sign, (root, y), (8, -14), textcoords="offset points", bbox=box)
    axes.set(xlim=(-3.3, 6), ylim=(-1.3, 1.9), aspect="equal", xticks=[], yticks=[])
    plt.show()


draw_rays(solved=False)

# %% [markdown]
# *In words: a circle and five rays to the right, each from a blue square. A starts left of the circle and passes above
# it. B starts left and touches its top. C starts left and goes through. D starts inside. E starts to the right.*
#
# **Predict:** which of the two solutions, with minus or with plus, is the range of each ray, if any?

# %%
draw_rays(solved=True)

# %% [markdown]
# *In words: the same, with the solutions as dots, filled where they lie ahead of the start, empty where they lie
# behind. A has none. B has one. C has two ahead. D has the minus solution behind and the plus solution ahead. E has
# both behind.*
#
# The range is the **smallest solution that is not behind**: minus for C (and B), plus for D, and a miss for A and E.
#
# | equation | line of code | kernel argument |
# |---|---|---|
# | $\mathbf v = \mathbf o - \mathbf c$ | `v = origin - centre` | `origin: wp.vec3`, `centre: wp.vec3` |
# | $b = \mathbf v \cdot \mathbf d$ | `b = wp.dot(v, direction)` | `direction: wp.vec3` |
# | $q = b^2 - c$ | `q = b * b - (wp.dot(v, v) - radius * radius)` | `radius: float` |
# | $r = -b \mp \sqrt{q}$ | `-b - wp.sqrt(q)`, else `-b + wp.sqrt(q)` | `ranges_out[i]` |


# %%
@wp.func
def sphere_range(origin: wp.vec3, direction: wp.vec3, centre: wp.vec3, radius: float) -> float:
    """Range to a sphere from outside or inside; 0 where it is not met."""
    v = origin - centre
    b = wp.dot(v, direction)
    q = b * b - (wp.dot(v, v) - radius * radius)
    if q < 0.0:
        return 0.0  # A
    root = wp.sqrt(q)
    if -b - root > 0.0:
        return -b - root  # B, C
    return wp.max(-b + root, 0.0)  # D, or E


@wp.kernel(enable_backward=False, module="unique")
def cast_sphere_kernel(
    # in
    origin: wp.vec3,
    directions: wp.array[wp.vec3],
    centre: wp.vec3,
    radius: float,
    # out
    ranges_out: wp.array[float],
):
    i = wp.tid()
    ranges_out[i] = sphere_range(origin, directions[i], centre, radius)


expected = (0, 3, 3 - math.sqrt(1 - 0.4**2), 0.3 + math.sqrt(1 - 0.15**2), 0)
for (name, (x, y)), wanted in zip(cases.items(), expected, strict=True):
    met = sphere_range(wp.vec3(x, y, 0.0), wp.vec3(1.0, 0.0, 0.0), wp.vec3(), 1.0)
    print(f"{name:>16}: {met:.3f}")
    assert abs(met - wanted) < 1e-5

# %% [markdown]
# Now a world of a ground and three spheres, cast with a launch for each thing. Of all ranges of a ray the smallest that
# is not 0 counts.

# %%
balls = [((9.0, 3.0, 1.0), 1.0), ((12.0, -2.0, 2.0), 2.0), ((16.0, 5.0, 2.5), 2.5)]  # centre, radius [m]
fine = preset("paper-64x1024")
fine_rays = fine.directions().view(-1, 3).to(device)
eye = wp.vec3(0.0, 0.0, 1.8)
found = torch.full((1 + len(balls), len(fine_rays)), torch.nan, device=device)

run(cast_ground_kernel, len(fine_rays), [eye, fine_rays], [found[0]])
for number, (centre, radius) in enumerate(balls, start=1):
    run(cast_sphere_kernel, len(fine_rays), [eye, fine_rays, wp.vec3(*centre), radius], [found[number]])

nearest = found.where(found > 0, torch.inf).amin(dim=0)
image = nearest.where(nearest < fine.max_range, 0.0).view(fine.shape).cpu()

figure, axes = plt.subplots(figsize=(9, 2.6), layout="constrained")
shown = axes.imshow(
    image.where(image > 0, torch.nan)[:, 384:640].flip(0, 1),
    cmap="viridis_r",
    vmin=0,
    vmax=30,
    extent=(45, -45, -15, 15),
    interpolation="nearest",
)
axes.set(xlabel="azimuth [°]", ylabel="elevation [°]")
figure.colorbar(shown, label="range [m]", fraction=0.03, pad=0.01)
plt.show()

# %% [markdown]
# *In words: a range image of 90 degrees. The ground fills the lower half, farther towards the horizon; three discs
# stand on it, the near one at 18° to the left, a larger one at 9° to the right, the farthest at 17° to the left, partly
# behind the first. The sky is white.*
#
# ### Exercise 2 · A pole
#
# importance ★★☆ · difficulty ★★☆ · 10 minutes
#
# An upright pole without ends is an infinite cylinder: all points whose *horizontal* distance from the axis at
# $(x_p, y_p)$ is $R$. Write the `wp.func` `pole_range`: the range to its surface from outside or inside, 0 where it is
# not met. Mind the rays that point straight up.
#
# <details><summary>Hint</summary>
#
# Do what was done for the sphere, with the x and y parts of $\mathbf v$ and $\mathbf d$ alone. The horizontal part of
# $\mathbf d$ is shorter than 1, so that $r^2$ has a factor: $a\,r^2 + 2\,b\,r + c = 0$ with $a = d_x^2 + d_y^2$.
#
# </details>
#
# <details><summary>Hint</summary>
#
# $r = (-b \mp \sqrt{b^2 - a\,c}) / a$ with $b = v_x d_x + v_y d_y$ and $c = v_x^2 + v_y^2 - R^2$. Where $a = 0$ the ray
# never comes to the surface.
#
# </details>


# %% tags=["exercise"]
@wp.func
def pole_range(origin: wp.vec3, direction: wp.vec3, x: float, y: float, radius: float) -> float:
    raise NotImplementedError


# %% tags=["solution"]
@wp.func
def pole_range(origin: wp.vec3, direction: wp.vec3, x: float, y: float, radius: float) -> float:
    v = wp.vec2(origin[0] - x, origin[1] - y)  # vec2: like vec3, with two components
    d = wp.vec2(direction[0], direction[1])
    a = wp.dot(d, d)
    b = wp.dot(v, d)
    q = b * b - a * (wp.dot(v, v) - radius * radius)
    if a == 0.0 or q < 0.0:  # without the first, 0 / 0: it is luck what wp.max makes of a NaN
        return 0.0
    root = wp.sqrt(q)
    if -b - root > 0.0:
        return (-b - root) / a
    return wp.max((-b + root) / a, 0.0)


# %% tags=["check"]
@check
def _():
    pole_range(wp.vec3(0.0, 0.0, 1.0), wp.vec3(1.0, 0.0, 0.0), 5.0, 0.0, 1.0)  # is there an answer?

    @wp.kernel(enable_backward=False, module="unique")
    def check_pole_kernel(
        origin: wp.vec3, directions: wp.array[wp.vec3], x: float, y: float, radius: float, ranges_out: wp.array[float]
    ):
        i = wp.tid()
        ranges_out[i] = pole_range(origin, directions[i], x, y, radius)

    cases = {
        "a pole straight ahead: the near side": ((0, 0, 1), (1, 0, 0), 4),
        "from another height: a pole has no ends": ((0, 0, 70), (1, 0, 0), 4),
        "a ray that rises: the range is longer than the way along the ground": ((0, 0, 1), (0.8, 0, 0.6), 5),
        "a ray that passes beside the pole": ((0, 2, 1), (1, 0, 0), 0),
        "a ray that touches the pole": ((0, 1, 1), (1, 0, 0), 5),
        "the pole is behind the ray": ((0, 0, 1), (-1, 0, 0), 0),
        "a ray from inside meets the far side": ((5, 0, 1), (0, 1, 0), 1),
        "a ray from inside that rises": ((5, 0, 1), (0.6, 0, 0.8), 1 / 0.6),
        "straight up, outside: no surface": ((0, 0, 1), (0, 0, 1), 0),
        "straight up, inside: no surface either": ((5, 0.5, 1), (0, 0, 1), 0),
    }
    for name, (origin, direction, wanted) in cases.items():
        ray, met = torch.tensor([direction], dtype=torch.float32, device=device), torch.full((1,), torch.nan)
        met = met.to(device)
        run(check_pole_kernel, 1, [wp.vec3(*map(float, origin)), ray, 5.0, 0.0, 1.0], [met])
        assert abs(met.item() - wanted) < 1e-5, (
            f"{name}: from {origin} along {direction} to a pole of radius 1 at (5, 0) it is {wanted:.2f}, "
            f"you have {met.item():.2f}"
        )


# %% tags=["wrong"]
@wp.func
def pole_range(origin: wp.vec3, direction: wp.vec3, x: float, y: float, radius: float) -> float:  # as if a were 1
    v = wp.vec2(origin[0] - x, origin[1] - y)
    b = wp.dot(v, wp.vec2(direction[0], direction[1]))
    q = b * b - (wp.dot(v, v) - radius * radius)
    if q < 0.0:
        return 0.0
    if -b - wp.sqrt(q) > 0.0:
        return -b - wp.sqrt(q)
    return wp.max(-b + wp.sqrt(q), 0.0)


# %% tags=["wrong"]
@wp.func
def pole_range(origin: wp.vec3, direction: wp.vec3, x: float, y: float, radius: float) -> float:  # never from inside
    v = wp.vec2(origin[0] - x, origin[1] - y)
    d = wp.vec2(direction[0], direction[1])
    a = wp.dot(d, d)
    b = wp.dot(v, d)
    q = b * b - a * (wp.dot(v, v) - radius * radius)
    if a == 0.0 or q < 0.0:
        return 0.0
    return wp.max((-b - wp.sqrt(q)) / a, 0.0)


# %% tags=["wrong"]
@wp.func
def pole_range(origin: wp.vec3, direction: wp.vec3, x: float, y: float, radius: float) -> float:  # forgets straight up
    v = wp.vec2(origin[0] - x, origin[1] - y)
    d = wp.vec2(direction[0], direction[1])
    b = wp.dot(v, d)
    q = b * b - wp.dot(d, d) * (wp.dot(v, v) - radius * radius)
    if q < 0.0:
        return 0.0
    if -b - wp.sqrt(q) > 0.0:
        return (-b - wp.sqrt(q)) / wp.dot(d, d)
    return (-b + wp.sqrt(q)) / wp.dot(d, d)


# %% [markdown]
# ### Exercise 3 · The nearest of many
#
# importance ★★★ · difficulty ★★☆ · 12 minutes
#
# One launch per sphere writes and reads a whole image for each. Let one thread look at all spheres instead, and keep
# the nearest hit in a variable of its own. Write a kernel with a `for` loop over the spheres, and the function
# `cast_spheres(origin, directions, centres, radii)` which launches it: `origin` is a `wp.vec3`; `directions` (N, 3),
# `centres` (S, 3) and `radii` (S,) are tensors on `device`. It returns the ranges (N,), 0 where nothing is met. There
# may be no sphere at all. Use `sphere_range` and `run` from above, and write the kernel in the same cell, above the
# function.
#
# <details><summary>Hint</summary>
#
# In a kernel `nearest = float(wp.inf)` makes a variable that a loop may change; `for s in range(radii.shape[0]):`
# goes over the spheres. Which ranges may replace `nearest`?
#
# </details>
#
# <details><summary>Hint</summary>
#
# `sphere_range` says 0 for a miss, and 0 is smaller than any hit. After the loop, what if `nearest` is still infinite?
#
# </details>


# %% tags=["exercise"]
def cast_spheres(origin, directions, centres, radii):
    raise NotImplementedError


# %% tags=["solution"]
@wp.kernel(enable_backward=False, module="unique")
def cast_spheres_kernel(
    origin: wp.vec3,
    directions: wp.array[wp.vec3],
    centres: wp.array[wp.vec3],
    radii: wp.array[float],
    ranges_out: wp.array[float],
):
    i = wp.tid()
    nearest = float(wp.inf)
    for s in range(radii.shape[0]):
        met = sphere_range(origin, directions[i], centres[s], radii[s])
        if met > 0.0 and met < nearest:
            nearest = met
    if nearest == wp.inf:
        nearest = 0.0
    ranges_out[i] = nearest


def cast_spheres(origin, directions, centres, radii):
    ranges = torch.empty(len(directions), device=directions.device)
    run(cast_spheres_kernel, len(directions), [origin, directions, centres, radii], [ranges])
    return ranges


# %% tags=["check"]
@check
def _():
    def cast(rays, *spheres):
        centres = torch.tensor([centre for centre, _ in spheres], dtype=torch.float32, device=device).view(-1, 3)
        radii = torch.tensor([radius for _, radius in spheres], dtype=torch.float32, device=device)
        rays = torch.tensor(rays, dtype=torch.float32, device=device)
        answer = cast_spheres(wp.vec3(), rays, centres, radii)
        assert isinstance(answer, torch.Tensor), f"the ranges should be a tensor, not {type(answer).__name__}"
        assert answer.shape == (len(rays),), f"{len(rays)} rays should give as many ranges, not {tuple(answer.shape)}"
        return [round(value, 4) for value in answer.tolist()]

    near, far, left = ((5, 0, 0), 1), ((10, 0, 0), 2), ((0, 7, 0), 3)
    rays = [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
    got = cast(rays, far, left)
    assert got[2] == 0, f"the third ray meets no sphere and should get 0, not {got[2]}"
    assert got == [8, 4, 0], f"a sphere 8 m ahead, one 4 m to the left: {got}. Does a miss, 0, win over a hit?"
    for spheres in ((near, far), (far, near)):
        got = cast(rays[:1], *spheres)
        assert got == [4], f"spheres at 4 m and 8 m, in either order: 4 m is nearer, you have {got[0]} m"
    got = cast(rays, ((0, 0, 0), 30), near)
    assert got == [4, 30, 30], f"from inside a large sphere, with a small one ahead: 4, 30, 30 m, you have {got}"
    got = cast(rays)
    assert got == [0, 0, 0], f"without a sphere nothing is met, range 0, you have {got}"
    answer = cast_spheres(
        eye,
        fine_rays,
        torch.tensor([centre for centre, _ in balls], device=device),
        torch.tensor([radius for _, radius in balls], device=device),
    )
    wanted = found[1:].where(found[1:] > 0, torch.inf).amin(dim=0)
    wanted = wanted.where(wanted.isfinite(), 0.0)
    assert torch.allclose(answer, wanted), "the three spheres of the picture: not what three launches found"


# %% tags=["wrong"]
@wp.kernel(enable_backward=False, module="unique")
def cast_spheres_kernel(  # a miss is the nearest of all
    origin: wp.vec3,
    directions: wp.array[wp.vec3],
    centres: wp.array[wp.vec3],
    radii: wp.array[float],
    ranges_out: wp.array[float],
):
    i = wp.tid()
    nearest = float(wp.inf)
    for s in range(radii.shape[0]):
        nearest = wp.min(nearest, sphere_range(origin, directions[i], centres[s], radii[s]))
    ranges_out[i] = nearest


# %% tags=["wrong"]
@wp.kernel(enable_backward=False, module="unique")
def cast_spheres_kernel(  # the last hit, not the nearest
    origin: wp.vec3,
    directions: wp.array[wp.vec3],
    centres: wp.array[wp.vec3],
    radii: wp.array[float],
    ranges_out: wp.array[float],
):
    i = wp.tid()
    nearest = float(0.0)
    for s in range(radii.shape[0]):
        met = sphere_range(origin, directions[i], centres[s], radii[s])
        if met > 0.0:
            nearest = met
    ranges_out[i] = nearest


# %% tags=["wrong"]
@wp.kernel(enable_backward=False, module="unique")
def cast_spheres_kernel(  # infinity where nothing is met
    origin: wp.vec3,
    directions: wp.array[wp.vec3],
    centres: wp.array[wp.vec3],
    radii: wp.array[float],
    ranges_out: wp.array[float],
):
    i = wp.tid()
    nearest = float(wp.inf)
    for s in range(radii.shape[0]):
        met = sphere_range(origin, directions[i], centres[s], radii[s])
        if met > 0.0 and met < nearest:
            nearest = met
    ranges_out[i] = nearest


# %% [markdown]
# ## 4. Triangles
#
# Towns are not made of spheres. A *mesh* is a list of points (vertices) and a list of triangles, each three numbers of
# vertices. A point of the triangle $\mathbf v_0, \mathbf v_1, \mathbf v_2$ with edges
# $\mathbf e_1 = \mathbf v_1 - \mathbf v_0$ and $\mathbf e_2 = \mathbf v_2 - \mathbf v_0$ is
# $\mathbf v_0 + u\,\mathbf e_1 + v\,\mathbf e_2$ with $u \ge 0$, $v \ge 0$, $u + v \le 1$. The ray meets it where
#
# $$\mathbf o + r\,\mathbf d = \mathbf v_0 + u\,\mathbf e_1 + v\,\mathbf e_2,$$
#
# three equations, one for each of x, y, z, for the three unknowns $r, u, v$. Cramer's rule solves them with
# determinants, and a determinant of three vectors is $\mathbf a \cdot (\mathbf b \times \mathbf c)$. With vectors
# $\mathbf s = \mathbf o - \mathbf v_0$, $\mathbf p = \mathbf d \times \mathbf e_2$ and
# $\mathbf q = \mathbf s \times \mathbf e_1$ (Möller and Trumbore, 1997):
#
# | equation | line of code | kernel argument |
# |---|---|---|
# | $\mathbf e_1 = \mathbf v_1 - \mathbf v_0$ | `e1 = v1 - v0` | `corners[t, 1]`, `corners[t, 0]` |
# | $D = \mathbf e_1 \cdot \mathbf p$ | `determinant = wp.dot(e1, p)` | `directions[i]`, in `p` |
# | $u = \mathbf s \cdot \mathbf p / D$ | `u = wp.dot(s, p) / determinant` | `origin`, in `s` |
# | $v = \mathbf d \cdot \mathbf q / D$ | `v = wp.dot(direction, q) / determinant` | `directions[i]` |
# | $r = \mathbf e_2 \cdot \mathbf q / D$ | `wp.dot(e2, q) / determinant` | `ranges_out[i]` |
#
# $D = 0$ means that the ray is parallel to the triangle.


# %%
@wp.func
def triangle_range(origin: wp.vec3, direction: wp.vec3, v0: wp.vec3, v1: wp.vec3, v2: wp.vec3) -> float:
    """Range to a triangle, from either side; 0 where it is not met."""
    e1 = v1 - v0
    e2 = v2 - v0
    p = wp.cross(direction, e2)
    determinant = wp.dot(e1, p)
    if determinant == 0.0:
        return 0.0
    s = origin - v0
    q = wp.cross(s, e1)
    u = wp.dot(s, p) / determinant
    v = wp.dot(direction, q) / determinant
    if u < 0.0 or v < 0.0 or u + v > 1.0:
        return 0.0
    return wp.max(wp.dot(e2, q) / determinant, 0.0)


@wp.kernel(enable_backward=False, module="unique")
def cast_all_kernel(
    # in
    origin: wp.vec3,
    directions: wp.array[wp.vec3],
    corners: wp.array2d[wp.vec3],
    # out
    ranges_out: wp.array[float],
):
    i = wp.tid()
    nearest = float(wp.inf)
    for t in range(corners.shape[0]):  # every triangle
        met = triangle_range(origin, directions[i], corners[t, 0], corners[t, 1], corners[t, 2])
        if met > 0.0 and met < nearest:
            nearest = met
    if nearest == wp.inf:
        nearest = 0.0
    ranges_out[i] = nearest


draw_thread(
    "cast_all_kernel: one thread per ray, here 2",
    [
        Cells("directions", (5, 1), [(2, 0)]),
        Cells("corners", (5, 3), [(row, column) for row in range(5) for column in range(3)]),
    ],
    "nearest = inf\nfor each triangle:\nkeep the nearer",
    [Cells("ranges_out", (5, 1), [(2, 0)])],
)

# %% [markdown]
# *In words: the thread reads one direction and all rows of `corners`, the three corners of every triangle, and writes
# one range.*
#
# A test with known answers: a cube of 2 m around the sensor, two triangles a side, and the six rays along the axes.
# Axis-aligned rays deserve a test of their own. They hit the very diagonal that the two triangles of a side share
# ($u + v = 1$ for one of them, $u = 0$ for the other), and two of their components are 0, by which the boxes of the
# next section divide.
#
# **Predict:** what would happen to these rays if the test said `u <= 0.0 or v <= 0.0 or u + v >= 1.0`?

# %%
box = pyvista.Cube(x_length=2, y_length=2, z_length=2).triangulate()
box_vertices = torch.tensor(np.array(box.points), dtype=torch.float32, device=device)
box_triangles = torch.tensor(box.regular_faces.astype(np.int32), device=device)
box_corners = box_vertices[box_triangles.long()]  # (12, 3, 3)

axis_rays = torch.cat((torch.eye(3), -torch.eye(3))).to(device)
met = torch.full((6,), torch.nan, device=device)
run(cast_all_kernel, 6, [wp.vec3(), axis_rays, box_corners], [met])
print("along x, y, z, -x, -y, -z:", met.tolist())
assert torch.equal(met, torch.ones_like(met))

# %% [markdown]
# With `<=` each of the two triangles would leave the diagonal to the other, and the rays would slip out between them.
#
# Now a town. `towns.build` makes the same one from the same name everywhere; `towns.traffic` puts cars and people
# around us. Kernels compute in float32, which has 24 significant bits: 10 km from the origin of the frame its steps are
# 1 mm, and the products in the test lose more. So we move the origin to the sensor first.

# %%
town = towns.build("town01")
WAYPOINT, SENSOR_HEIGHT = 1445, 1.8
position = town.waypoints[WAYPOINT] + np.array([0.0, 0.0, SENSOR_HEIGHT])
cars, car_triangles = towns.traffic(town, position, seed=0)
vertices = np.concatenate((town.vertices, cars)) - position  # float64 minus float64, then float32
triangles = np.concatenate((town.triangles, car_triangles + len(town.vertices)))

vertices = torch.tensor(vertices, dtype=torch.float32, device=device)
triangles = torch.tensor(triangles.astype(np.int32), device=device)
corners = vertices[triangles.long()].contiguous()  # (F, 3, 3)
print(f"{len(triangles):,} triangles, {sensor.shape[0] * sensor.shape[1]:,} rays")

pose = simulate.pose((0.0, 0.0, 0.0), yaw=float(town.headings[WAYPOINT]))  # the sensor looks along the lane
rays = (sensor.directions().double() @ pose[:3, :3].T).float().view(-1, 3).to(device)

# %% [markdown]
# **Predict:** a test takes ten to thirty nanoseconds on one CPU core. How long would the whole scan take if every ray
# tested every triangle? We try it with 32 of the rays.

# %%
few = rays[::512].contiguous()  # (32, 3)
slow = torch.full((len(few),), torch.nan, device=device)
run(cast_all_kernel, 1, [wp.vec3(), few, corners], [slow])  # compiles; one ray
wp.synchronize_device(device)

start = time.perf_counter()
run(cast_all_kernel, len(few), [wp.vec3(), few, corners], [slow])
wp.synchronize_device(device)
seconds = time.perf_counter() - start
tests = len(rays) * len(triangles)
print(f"{len(few)} rays: {len(few) * len(triangles):,} tests in {seconds:.2f} s")
print(f"the scan of {len(rays):,} rays would take {tests:.1e} tests, about {seconds * len(rays) / len(few):.0f} s")
assert tests > 1e10

# %% [markdown]
# Eighteen billion tests ($1.8 \cdot 10^{10}$) for one small scan. Nearly all of them are in vain: a ray comes close to
# few triangles.
#
# ## 5. A tree of boxes
#
# To skip many triangles at once, put them into a box whose sides lie along the axes. If a ray misses the box, it misses
# all that is in it. Split the triangles in two halves, give each half a box, and go on until few are left: a *bounding
# volume hierarchy*, BVH. A ray starts at the outermost box and only opens those that it meets.
#
# A small one, seen from above along the axes of the town: the middles of a few thousand triangles around us, halved
# again and again across the longer side. The smallest boxes are the *leaves* of the tree.


# %%
def split(points, depth):
    """Boxes (low, high, depth) of a tree over points (N, 2)."""
    low, high = points.min(axis=0), points.max(axis=0)
    boxes = [(low, high, depth)]
    if depth < 7:
        axis = np.argmax(high - low)
        order = np.argsort(points[:, axis])
        for half in np.array_split(order, 2):
            boxes += split(points[half], depth + 1)
    return boxes


def meets(direction, low, high):
    """Whether a ray from the origin meets a box: having entered its span in x and in y, it has not yet left either."""
    with np.errstate(divide="ignore"):
        a, b = low / direction, high / direction
    return np.minimum(a, b).max() <= np.maximum(a, b).min() and np.maximum(a, b).min() >= 0


middles = corners.mean(dim=1)[:, :2].cpu().numpy()
middles = middles[np.abs(middles).max(axis=1) < 30][::10]
ray = np.array([math.cos(0.55), math.sin(0.55)])
boxes = split(middles, 0)
opened = [box for box in boxes if meets(ray, *box[:2])]
leaves = [box for box in opened if box[2] == 7]

figure, pair = plt.subplots(1, 2, figsize=(9, 4.3), sharex=True, sharey=True, layout="constrained")
for axes, (title, some) in zip(pair, {"all boxes": boxes, "boxes that the ray meets": opened}.items(), strict=True):
    axes.plot(*middles.T, ".", color=GREY, markersize=1.5)
    for low, high, depth in some:
        leaf = depth == 7
        colour = VERMILION if leaf else BLUE
        axes.add_patch(plt.Rectangle(low, *(high - low), fill=False, edgecolor=colour, linewidth=1.6 if leaf else 0.7))
    axes.annotate("", 38 * ray, (0, 0), arrowprops={"arrowstyle": "->", "linewidth": 1.5})
    axes.set(title=f"{title}: {len(some)}", xlabel="x [m]", xlim=(-33, 33), ylim=(-33, 33), aspect="equal")
pair[0].set_ylabel("y [m]")
plt.show()
print(f"{len(middles):,} triangles in {sum(box[2] == 7 for box in boxes)} smallest boxes; the ray opens {len(leaves)}")
assert len(opened) < len(boxes) / 4

# %% [markdown]
# *In words: two plans of 60 by 60 m with grey dots, dense at trees, cars and houses, and an arrow from the middle to
# the upper right. Left, all boxes of the tree, the leaves in orange-red, lie over all dots. Right, only the boxes that
# the arrow meets are left: a chain of small ones along it inside a few larger ones.*
#
# Warp has this tree. `wp.Bvh` builds it over boxes that we give it, one around each triangle. In a kernel
# `wp.bvh_query_ray` starts a walk, and each `wp.bvh_query_next` finds the next triangle whose box the ray meets. It
# takes a distance beyond which boxes need not be opened; once something is hit, that is the range of the hit. A kernel
# is handed the tree's `id`, a number by which it finds the tree (`wp.uint64`, an integer of 64 bits); the Python object
# has to live as long as the id is used.
#
# **Predict:** how many of the million triangles does a ray still test on average?


# %%
@wp.kernel(enable_backward=False, module="unique")
def cast_tree_kernel(
    # in
    tree: wp.uint64,
    origin: wp.vec3,
    directions: wp.array[wp.vec3],
    corners: wp.array2d[wp.vec3],
    max_range: float,
    # out
    ranges_out: wp.array[float],
    tests_out: wp.array[int],
):
    i = wp.tid()
    found = float(0.0)
    nearest = float(max_range)
    tests = int(0)
    t = int(0)
    query = wp.bvh_query_ray(tree, origin, directions[i])
    while wp.bvh_query_next(query, t, nearest):  # t becomes the number of a triangle
        tests += 1
        met = triangle_range(origin, directions[i], corners[t, 0], corners[t, 1], corners[t, 2])
        if met > 0.0 and met < nearest:
            nearest = met
            found = met
    ranges_out[i] = found
    tests_out[i] = tests


low, high = corners.amin(dim=1).contiguous(), corners.amax(dim=1).contiguous()  # (F, 3) each
tree = wp.Bvh(wp.from_torch(low, dtype=wp.vec3), wp.from_torch(high, dtype=wp.vec3))

by_tree = torch.full((len(rays),), torch.nan, device=device)
tests = torch.zeros(len(rays), dtype=torch.int32, device=device)
arguments = [tree.id, wp.vec3(), rays, corners, sensor.max_range], [by_tree, tests]
run(cast_tree_kernel, 1, *arguments)  # compiles; one ray
wp.synchronize_device(device)
start = time.perf_counter()
run(cast_tree_kernel, len(rays), *arguments)
wp.synchronize_device(device)
print(f"the whole scan, {len(rays):,} rays: {time.perf_counter() - start:.3f} s")
print(f"tests per ray: {tests.float().mean():.1f} on average, {tests.max()} at most, instead of {len(triangles):,}")

within = slow.where(slow < sensor.max_range, 0.0)
assert torch.allclose(by_tree[::512], within, atol=1e-3)  # the same ranges
assert tests.float().mean() < 100

# %% [markdown]
# The same ranges from a handful of tests. The work per ray now grows about with the logarithm of the number of
# triangles.
#
# A mesh with a tree is so common that Warp has it ready: `wp.Mesh`, and `wp.mesh_query_ray`, which walks and tests
# triangles in one call. It answers with the range `hit.t`, the triangle `hit.face` and its unit normal `hit.normal`.
# That is all that the project's own kernel needs. With the normal we get the *incidence* for free: the cosine
# $|\mathbf n \cdot \mathbf d|$ of the angle between ray and normal, 1 for a hit at right angles, near 0 for a grazing
# one.


# %%
@wp.kernel(enable_backward=False, module="unique")
def cast_mesh_kernel(
    # in
    mesh: wp.uint64,
    origin: wp.vec3,
    directions: wp.array[wp.vec3],
    max_range: float,
    # out
    ranges_out: wp.array[float],
    triangles_out: wp.array[int],
    cosines_out: wp.array[float],
):
    i = wp.tid()
    ranges_out[i] = 0.0
    triangles_out[i] = -1
    cosines_out[i] = 0.0
    hit = wp.mesh_query_ray(mesh, origin, directions[i], max_range)
    if hit.result:
        ranges_out[i] = hit.t
        triangles_out[i] = hit.face
        cosines_out[i] = wp.abs(wp.dot(hit.normal, directions[i]))


mesh = wp.Mesh(wp.from_torch(vertices, dtype=wp.vec3), wp.from_torch(triangles.view(-1)))
mine = torch.full((len(rays),), torch.nan, device=device)
cosines = torch.full_like(mine, torch.nan)
faces = torch.zeros_like(mine, dtype=torch.int32)
run(cast_mesh_kernel, len(rays), [mesh.id, wp.vec3(), rays, sensor.max_range], [mine, faces, cosines])

differ = ((mine - by_tree).abs() > 1e-3).sum()
print(f"{differ} of {len(rays):,} rays differ from our own walk by more than a millimetre")
assert differ < 20

draw_thread(
    "cast_mesh_kernel: one thread per ray, here 2",
    [Cells("directions", (5, 1), [(2, 0)]), Cells("mesh: boxes, triangles", (3, 8), [(0, 0), (1, 3), (2, 5), (2, 6)])],
    "walk the tree,\nopen what the ray meets,\nkeep the nearest",
    [Cells(name, (5, 1), [(2, 0)]) for name in ("ranges_out", "triangles_out", "cosines_out")],
)

# %% [markdown]
# *In words: the thread reads one direction and a few scattered boxes and triangles of the mesh, and writes one range,
# one triangle and one cosine.*
#
# ## 6. A scan of a town
#
# `kernels.Mesh` wraps that kernel for tensors. What does it do beyond ours? It checks what it is given, takes float64
# vertices and moves the origin itself, takes directions of any length and any batch shape, and splits a CPU launch over
# all cores (a launch of Warp itself uses one). `simulate.scan` turns the rays of a sensor into the world, finds
# their ranges, and leaves out what is nearer than the sensor's `min_range`. Where that is faster on a CPU it does not
# cast rays at all but projects the triangles onto the image, as a renderer does (`Mesh.project`).
#
# **Predict:** at which rays could two programs that are both right disagree?

# %%
project_mesh = Mesh(vertices, triangles, device)
hits = project_mesh.cast(torch.zeros(3, device=device), rays, sensor.max_range)
scan = simulate.scan(project_mesh, sensor, pose)

for name, ranges in (("Mesh.cast", hits.range), ("simulate", scan.ranges.view(-1))):
    differ = ((ranges - mine).abs() > 0.01).sum()
    print(f"{name}: {differ} of {len(rays):,} rays differ by more than a centimetre")
    assert differ < 50
assert torch.allclose(hits.cosine, cosines, atol=1e-3)

axis = Mesh(box_vertices, box_triangles, device).cast(torch.zeros(3, device=device), axis_rays, 10.0)
assert torch.allclose(axis.range, torch.ones_like(axis.range))  # the six rays along the axes again
assert torch.allclose(axis.cosine, torch.ones_like(axis.cosine))

# %% [markdown]
# Here all agree. Rays that graze an edge may fall to either side of it.
#
# **Predict:** where in the image are the cosines small?

# %% tags=["goal"]
figure, (above, below) = plt.subplots(2, 1, figsize=(11, 4.4), sharex=True, layout="constrained")
met = (mine > 0).view(sensor.shape).cpu()
pictures = {
    "range [m]": (above, mine, "viridis_r", 50),
    "cosine of incidence": (below, cosines, "cividis", 1),
}
for label, (axes, values, colours, top) in pictures.items():
    values = values.view(sensor.shape).cpu().where(met, torch.nan).flip(0, 1)
    shown = axes.imshow(
        values, cmap=colours, vmin=0, vmax=top, extent=(180, -180, -16, 16), aspect="auto", interpolation="nearest"
    )
    axes.set(ylabel="elevation [°]")
    figure.colorbar(shown, ax=axes, label=label, fraction=0.03, pad=0.01)
above.set_title(f"{len(rays):,} rays, {len(triangles):,} triangles", loc="left", fontsize=10)
below.set_xlabel("azimuth [°]")
plt.show()

road, sine = cosines.view(sensor.shape)[4, 512], math.sin(math.radians(7))
print(f"road ahead at elevation {math.degrees(elevations[4]):.0f}°: cosine {road:.3f}; the sine of 7° is {sine:.3f}")
assert abs(road - sine) < 0.03

# %% [markdown]
# *In words: above, the range image of the street, road below, house fronts, trees and cars above it, no return white.
# Below, the cosines: the road is dark blue, below 0.3 and nearly 0 far away; house fronts are yellow where a ray meets
# them at right angles and darken towards their ends; trees and cars are a mixture.*
#
# On a level road the cosine is the sine of the angle below the horizon: 0.12 at 7°. Two neighbouring beams touch such a
# surface eight times as far apart as on a wall that faces us. Grazing rays are also those that a real sensor gets no
# answer from; `ilnet.world.effects.Effects` has that, and noise, wide beams and a moving sensor besides.
#
# What the sensor saw of the town: the triangles that were hit, and the points on them. In a Jupyter session, turn it.

# %%
seen = triangles[faces[faces >= 0].unique().long()].cpu().numpy()
near = torch.tensor(np.linalg.norm(vertices.cpu().numpy()[seen].mean(axis=1), axis=1) < 40)
cut = pyvista.PolyData.from_regular_faces(vertices.cpu().numpy(), seen[near.numpy()]).clean()
points = (mine[:, None] * rays)[mine > 0].cpu()
points = points[points.norm(dim=1) < 40]

plotter = pyvista.Plotter(off_screen=True, window_size=(900, 420))
plotter.add_mesh(cut, color="#cccccc", show_edges=False, ambient=0.3)
plotter.add_points(points.numpy(), color=VERMILION, point_size=3)
plotter.camera_position = [(-38, -26, 30), (3, 2, -2), (0, 0, 1)]
show_scene(plotter)

# %% [markdown]
# *In words: pale pieces of road, grey house fronts and cars from above, with gaps between them, and rows of orange-red
# points on them: rings on the road, stripes on the walls.*
#
# The same kernels run on a GPU: nothing in them says where. Only the launch does, by its `device`, which in this
# notebook is the GPU if there is one.
#
# ## Summary
#
# 1. A kernel is written for one ray; the launch says how many threads run it. PyTorch tensors are handed over without a
#    copy.
# 2. The range is the smallest solution that is not behind the ray. Parallel rays, starts inside, and misses need a line
#    each, and a miss is 0.
# 3. Testing every triangle takes rays times triangles. A tree of boxes leaves a handful of tests for each ray.
# 4. A scan is one kernel launch: range, triangle and cosine for each ray.
#
# ## Next
#
# Now we know the truth in every direction, also between the beams. [03 · Between the
# pixels](03_between_the_pixels.ipynb) asks how well it can be guessed from the four measured neighbours.
