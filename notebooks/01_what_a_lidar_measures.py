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
# # 01 · What a LiDAR measures
#
# ![Above, a range image of a street, 16 rows of coarse stripes, with three marked pixels A, B and C. Below, the same
# returns as points seen from above, thin rings on the road and the outlines of houses, with the same three
# marks](pictures/01_what_a_lidar_measures.png)
#
# **Goal.** You take a LiDAR scan apart: angles, directions, a range image, points. You go both ways between them, and
# you find a place where code often goes wrong, the seam behind the sensor.
#
# **After this notebook you can**
#
# - turn the two angles of a laser into a direction, and a direction into a continuous pixel coordinate, for evenly and
#   unevenly spaced beams;
# - read a range image: which way rows and columns run, what 0 means, and what to do about it before any arithmetic;
# - find the pixel coordinate of a direction across the seam between the last and the first column;
# - turn a range image into points and points into a range image.
#
# | | |
# |---|---|
# | You know | Python, a little NumPy and PyTorch; nothing about LiDAR |
# | Time | 40 minutes, and 35 for the exercises; half a minute to run |
# | Hardware | any computer; a CUDA GPU is used if there is one |
#
# Before a result there is a line **Predict**. Write your guess down before you run the next cell.

# %%
import math
import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pyvista
import torch

from ilnet import places, scan_files, simulate
from ilnet.course import check, show_scene
from ilnet.scan import Scan
from ilnet.sensor import angles_to_directions, directions_to_angles, preset

pyvista.vtk_verbosity("off")  # where there is no screen VTK warns of its absence, then renders all the same
device = "cuda" if torch.cuda.is_available() else "cpu"
BLUE, VERMILION, GREEN, ORANGE, GREY = "#0072b2", "#d55e00", "#009e73", "#e69f00", "#999999"

# %% [markdown]
# ## 1. A sensor is two tables of angles
#
# A spinning LiDAR has a column of lasers, one above the other. Laser $i$ looks up or down by a fixed angle, its
# *elevation* $\epsilon_i$: 0 is level, positive is up. The whole column turns about the upright axis and fires at
# *azimuths* $\alpha_j$: 0 is straight ahead, positive is to the left. For each shot it measures how long the light
# takes to come back, which gives one number: the *range*, in metres along the laser.
#
# So all that we need to know of a sensor are two tables, `elevations` and `azimuths`, and the limits of its ranges. The
# package has the tables of some common sensors. All angles are in radians.

# %%
paper, kitti = preset("paper-16x1024"), preset("hdl-64e")
for sensor in (paper, kitti):
    print(sensor)
print("first three azimuths of each [rad]:", paper.azimuths[:3].round(3), kitti.azimuths[:3].round(3))

# %% [markdown]
# The first is the simulated sensor of the paper that this course follows: 16 beams, 1024 columns. The second is the one
# that recorded the KITTI data: 64 beams, here with 2048 columns. Compare the first entries of each table with the last.
#
# **Predict:** in which direction do the rows of each count, and in which direction does each turn?

# %%
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained", width_ratios=(1, 1, 0.9))
for side, sensor, colour in ((axes[0], paper, BLUE), (axes[1], kitti, VERMILION)):
    for elevation in sensor.elevations:
        side.plot([0, 30 * math.cos(elevation)], [0, 30 * math.sin(elevation)], color=colour, linewidth=0.6)
    side.set(xlim=(0, 31), ylim=(-13, 9), xlabel="ahead [m]", ylabel="up [m]", title=f"{sensor.name}, from the side")
axes[2].plot(np.degrees(paper.elevations), "o", color=BLUE, markersize=4, label=paper.name)
axes[2].plot(np.degrees(kitti.elevations), "^", color=VERMILION, markersize=3, label=kitti.name)
axes[2].set(xlabel="row", ylabel="elevation [°]", title="the tables")
axes[2].legend()
plt.show()

# %% [markdown]
# *In words: left, 16 beams spread evenly from 15° below to 15° above the horizon. Middle, 64 beams, nearly all of them
# downwards, close together in the upper half and wider apart below. Right, elevation against row: a rising straight
# line for the paper's sensor; for the other a falling line that bends at row 31.*
#
# The rows of the first sensor count upwards and its columns turn to the left (counter-clockwise, seen from above). The
# rows of the second count downwards, its columns turn to the right, and its beams are **not evenly spaced**. Neither is
# wrong. Code that takes the one for the other is: it shows a street upside down. So we never compute with "row 3 of
# 16". We look the angle up in the table.
#
# How far apart do the beams touch a wall? At range $r$ two directions with a small angle $\delta$ between them are
# $r\,\delta$ apart.
#
# **Predict:** the paper's sensor looks at a wall 20 m away. How far apart are two neighbouring beams there, and two
# neighbouring columns?

# %%
between_beams = 20 * np.diff(paper.elevations)
between_columns = 20 * np.diff(paper.azimuths)
print(f"20 m away: {between_beams[0]:.2f} m between beams, {between_columns[0]:.2f} m between columns")
assert between_beams[0] > 5 * between_columns[0]
thirds, halves = -np.degrees(np.diff(kitti.elevations))[[10, 50]]
print(f"{kitti.name}: {thirds:.2f}° between the upper beams, {halves:.2f}° between the lower ones")

# %% [markdown]
# 0.70 m against 0.12 m: a dog fits between two beams. This is why one wants *super-resolution*: more rows than the
# sensor has.

# %% [markdown]
# ## 2. From two angles to a direction
#
# We use one frame in the whole course, with the sensor at the origin: **x ahead, y left, z up**. Azimuth 0 looks along
# x, azimuth +90° along y. A laser looks along a vector of length 1, its *direction* $\mathbf d$.
#
# Two right triangles give it. The first stands upright: its longest side is the laser, of length 1, its height
# is $\sin\epsilon$, and its foot, the laser's shadow on the ground, has length $\cos\epsilon$. The second lies on the
# ground: its long side is that shadow, and the azimuth is its angle at the sensor.

# %% [markdown]
# ### Exercise 1 · A direction from two angles
#
# ★☆☆ · 5 minutes
#
# Write `direction(elevation, azimuth)`. It takes two tensors of radians of any shape, the same for both, and returns
# the unit vectors with x, y, z in a new last dimension: shape `(..., 3)`. Rays straight up are directions, too.
#
# <details><summary>Hint</summary>
#
# z is `torch.sin(elevation)`. The shadow has length `torch.cos(elevation)`; split *it* into x and y.
#
# </details>
#
# <details><summary>Hint</summary>
#
# `torch.stack((x, y, z), dim=-1)`
#
# </details>


# %% tags=["exercise"]
def direction(elevation, azimuth):
    raise NotImplementedError


# %% tags=["solution"]
def direction(elevation, azimuth):
    shadow = torch.cos(elevation)
    return torch.stack((shadow * torch.cos(azimuth), shadow * torch.sin(azimuth), torch.sin(elevation)), dim=-1)


# %% tags=["check"]
@check
def _():
    def look(elevation, azimuth):
        return direction(torch.tensor([math.radians(elevation)]), torch.tensor([math.radians(azimuth)]))

    ahead = look(0.0, 0.0)
    assert ahead.shape == (1, 3), f"one ray should give shape (1, 3), not {tuple(ahead.shape)}: x, y, z come last"
    cases = {
        "ahead": (0, 0, 1, 0, 0),
        "left": (0, 90, 0, 1, 0),
        "right": (0, -90, 0, -1, 0),
        "back": (0, 180, -1, 0, 0),
    }
    for name, (elevation, azimuth, *wanted) in cases.items():
        got = [round(x, 3) + 0.0 for x in look(elevation, azimuth)[0].tolist()]
        message = f"straight {name} (elevation {elevation}°, azimuth {azimuth}°) should be {wanted}, not {got}"
        assert np.allclose(got, wanted, atol=2e-3), f"{message}: x is ahead, y left, angles are radians"
    up = look(90.0, 50.0)[0]
    assert torch.allclose(up, torch.tensor([0.0, 0.0, 1.0]), atol=1e-6), (
        f"a ray straight up has no x and no y whatever its azimuth, not {up.tolist()}: does its shadow have length 0?"
    )
    assert torch.allclose(look(-10.0, 180.0), look(-10.0, -180.0), atol=1e-6), "+180° and -180° are one direction"
    many = direction(torch.rand(4, 5), torch.rand(4, 5))
    assert many.shape == (4, 5, 3), f"angles of shape (4, 5) should give (4, 5, 3), not {tuple(many.shape)}"
    assert torch.allclose(many.norm(dim=-1), torch.ones(4, 5)), "directions should have length 1"
    assert direction(torch.empty(0), torch.empty(0)).shape == (0, 3), "no angles should give no directions, (0, 3)"


# %% tags=["wrong"]
def direction(elevation, azimuth):  # the shadow is not shortened
    return torch.stack((torch.cos(azimuth), torch.sin(azimuth), torch.sin(elevation)), dim=-1)


# %% tags=["wrong"]
def direction(elevation, azimuth):  # y ahead, x right: the frame of the paper's authors
    shadow = torch.cos(elevation)
    return torch.stack((shadow * torch.sin(azimuth), shadow * torch.cos(azimuth), torch.sin(elevation)), dim=-1)


# %% tags=["wrong"]
def direction(elevation, azimuth):  # stacked in front
    shadow = torch.cos(elevation)
    return torch.stack((shadow * torch.cos(azimuth), shadow * torch.sin(azimuth), torch.sin(elevation)))


# %% [markdown]
# The package has the same function, `angles_to_directions`. A sensor asks it for a whole grid at once: a column of
# elevations against a row of azimuths.
#
# | equation | line of code | shape |
# |---|---|---|
# | $\epsilon_i$, $\alpha_j$ | `elevations[:, None]`, `azimuths[None, :]` | (H, 1), (1, W) |
# | $d_x = \cos\epsilon_i \cos\alpha_j$ | `torch.cos(elevation) * torch.cos(azimuth)` | (H, W) |
# | $d_y = \cos\epsilon_i \sin\alpha_j$ | `torch.cos(elevation) * torch.sin(azimuth)` | (H, W) |
# | $d_z = \sin\epsilon_i$ | `torch.sin(elevation)` | (H, W) |
# | $\mathbf d_{ij}$ | `angles_to_directions(...)` or `sensor.directions()` | (H, W, 3) |

# %%
elevations, azimuths = torch.tensor(paper.elevations), torch.tensor(paper.azimuths)  # float64
rays = angles_to_directions(elevations[:, None], azimuths[None, :])
assert torch.equal(rays.float(), paper.directions())
assert torch.allclose(rays.norm(dim=-1), torch.ones(paper.shape, dtype=torch.float64))

back = directions_to_angles(rays)  # and the other way, for vectors of any length
assert torch.allclose(back[0], elevations[:, None].expand(paper.shape))
print("all rays:", tuple(rays.shape), " ray (row 4, column 512):", [round(x, 3) for x in rays[4, 512].tolist()])

# %% [markdown]
# ## 3. A scan is a range image
#
# The package builds towns, so that we can put a sensor anywhere and know what is really there. The next cell builds
# one, stands at point 1445 along its roads, 1.8 m above the ground, and casts all rays of a sensor. How casting works
# is the subject of the next notebook; here we only want what comes back, a `Scan`: the ranges, and the sensor that they
# belong to.

# %%
street = places.town("town01", device=device)
pose = street.pose(1445)  # (4, 4), sensor frame to town
world = street.world(pose[:3, 3], seed=0)  # the town, and cars and people
scan = simulate.scan(world, paper, pose)

print(scan.sensor)
print("ranges:", tuple(scan.ranges.shape), scan.ranges.dtype)

# %% [markdown]
# `scan.ranges[i, j]` is the range along `elevations[i]` and `azimuths[j]`. Nothing more is stored: the direction
# follows from the place in the image.
#
# **Predict:** what does the image look like if we draw row 0 at the top and column 0 at the left, as one draws an
# array?

# %%
figure, (above, below) = plt.subplots(2, 1, figsize=(11, 4.2), layout="constrained")
image = scan.ranges.cpu()
seen = image.where(image > 0, torch.nan)  # no return is left white
for axes, picture in ((above, seen), (below, seen.flip(0, 1))):
    shown = axes.imshow(picture, cmap="viridis_r", vmin=0, vmax=50, aspect="auto", interpolation="nearest")
above.set(title="as it is stored: row 0 above, column 0 left", xlabel="column", ylabel="row")
below.set(title="as you see it: lowest beam below, left is left", xlabel="azimuth [°]", ylabel="elevation [°]")
places = 1023 - np.arange(0, 1024, 128)  # where columns 0, 128, ... lie in the flipped picture
below.set_xticks(places, [f"{azimuth:.0f}" for azimuth in np.degrees(paper.azimuths[::128])])
below.set_yticks([0, 5, 10, 15], [f"{elevation:.0f}" for elevation in np.degrees(paper.elevations[[15, 10, 5, 0]])])
figure.colorbar(shown, ax=(above, below), label="range [m]", fraction=0.03, pad=0.01)
plt.show()

# %% [markdown]
# *In words: the same range image twice, near is yellow-green, far is dark purple, no return is white. Above, as it is
# stored, the road is at the top and the sky at the bottom, and left and right are exchanged. Below, flipped both ways,
# a road in even stripes with house fronts, trees and cars above it.*
#
# Upside down *and* mirrored: row 0 of this sensor is its lowest beam, and its columns turn to the left. The array is
# not the picture. Flip it to look at it, never to compute with it.
#
# ### No return
#
# A laser that meets nothing within `max_range` gives no answer. Files and scans store **0** for it.
#
# **Predict:** how many of the rays in the top row got no answer? And if a ray between a pixel with 60 m and a pixel
# with no return takes the mean of the two, where does it end?

# %%
answered = scan.ranges > 0
top, known = scan.ranges[-1], answered[-1]
in_all, in_top = (~answered).float().mean(), (~known).float().mean()
print(f"no return: {in_all:.0%} of all rays, {in_top:.0%} in the top row")
print(f"mean of the top row: {top.mean():.1f} m with the zeros, {top[known].mean():.1f} m without")
assert (~known).float().mean() > (~answered[0]).float().mean()

filled = scan.filled()
middle = (60 + paper.norm_range) / 2
print(f"mean of 60 m and no return: {(60 + 0) / 2:.0f} m from 0, {middle:.0f} m from the filled image")
assert (filled[~answered] == paper.norm_range).all()
assert torch.equal(filled[answered], scan.ranges[answered])

# %% [markdown]
# 0 is a label, not a distance. As a number it says that something touches the sensor, and the mean of 60 m and
# "nothing" becomes a surface at 30 m, in front of all that is there. Before any arithmetic we therefore replace 0 by
# something *farther* than any measurement: `scan.filled()` puts in `sensor.norm_range`, 100 m here, with ranges up to
# 80 m. This is also what a network sees, once divided by `norm_range`. What it predicts beyond `max_range` then means
# "no return" again. (Things nearer than `min_range` are stored as 0 too, and nobody can tell the two apart any more.)

# %% [markdown]
# ## 4. Between the pixels: pixel coordinates
#
# We will ask for directions that the sensor did not measure. To say where such a direction lies in the image we use a
# *pixel coordinate* (row, column) of floating-point numbers. **Integers are pixel centres**: (4.0, 512.0) is exactly
# the direction that pixel measured, and 4.3 lies 30 % of the way from row 4 to row 5. There is no half pixel to add,
# since a laser is a line and a pixel of a range image has no area.
#
# From row to angle the table says it: $\epsilon(4.3) = 0.7\,\epsilon_4 + 0.3\,\epsilon_5$. `sensor.locate` goes the
# other way, from angles to pixel coordinates.
#
# **Predict:** the horizon is elevation 0. In which row of each of the two sensors does it lie?

# %%
for sensor in (paper, kitti):
    row, column = sensor.locate(0.0, 0.0).tolist()
    print(f"{sensor.name}: straight ahead is row {row:.2f}, column {column:.2f}")

centres = paper.locate(elevations[:, None], azimuths[None, :])  # (16, 1024, 2)
assert torch.equal(centres[4, 512], torch.tensor([4.0, 512.0]))

asked = torch.tensor([-7.1, -0.5, 1.9]).deg2rad()
rows = kitti.locate(asked, torch.tensor(0.0))[:, 0].numpy()
returned = np.interp(rows, np.arange(64), kitti.elevations)  # row -> angle: along the table
assert np.allclose(returned, asked, atol=1e-6)

figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
axes.plot(np.degrees(kitti.elevations), "-", color=VERMILION, linewidth=1)
axes.plot(np.degrees(kitti.elevations), "|", color=VERMILION, label="the 64 beams of hdl-64e")
for row, angle in zip(rows, np.degrees(returned), strict=True):
    axes.plot([-1, row, row], [angle, angle, -26], "--", color="black", linewidth=0.9)
    axes.plot(row, angle, "o", color="black", markersize=5)
    axes.annotate(f"{angle:.1f}° is row {row:.2f}", (row, angle), (8, 2), textcoords="offset points", fontsize=9)
axes.set(xlabel="row", ylabel="elevation [°]", xlim=(-1, 64), ylim=(-26, 4))
axes.legend(loc="upper right")
plt.show()

# %% [markdown]
# *In words: the falling table of the hdl-64e, elevation against row, steeper behind row 31. For three elevations dashed
# lines lead from the angle to the table and from there down to the row: -7.1° is row 27.30, -0.5° row 7.50, 1.9° row
# 0.30.*
#
# The table is a line from point to point, and `locate` reads it backwards. An even sensor needs no table; a real one
# does.

# %% [markdown]
# ### Exercise 2 · The row of an elevation
#
# ★★☆ · 8 minutes
#
# Write `row_of(elevation, elevations)`: the continuous row of each elevation, as in the figure. `elevation` is a NumPy
# array of radians of any shape, within the table; `elevations` is the table (H,), which **rises or falls**, evenly or
# not.
#
# <details><summary>Hint</summary>
#
# `np.interp(x, xp, fp)` draws a line through the points (xp, fp) and reads it at x. Here x is an angle and the answer a
# row: which of `elevations` and `np.arange(len(elevations))` is `xp`, and which is `fp`?
#
# </details>
#
# <details><summary>Hint</summary>
#
# `np.interp` wants `xp` to rise, and **says nothing** if it does not. Turn both tables around, `[::-1]`, where the
# elevations fall.
#
# </details>


# %% tags=["exercise"]
def row_of(elevation, elevations):
    raise NotImplementedError


# %% tags=["solution"]
def row_of(elevation, elevations):
    rows = np.arange(len(elevations))
    if elevations[0] > elevations[-1]:
        elevations, rows = elevations[::-1], rows[::-1]
    return np.interp(elevation, elevations, rows)


# %% tags=["check"]
@check
def _():
    rising = np.array([-0.3, -0.1, 0.0, 0.4])
    for name, table in (("rising", rising), ("falling", rising[::-1])):
        got = np.asarray(row_of(table.copy(), table))
        assert got.shape == (4,), f"4 elevations should give 4 rows, not shape {got.shape}"
        assert np.allclose(got, range(4)), (
            f"the entries of a {name} table are the pixel centres 0, 1, 2, 3, you have {got.round(3).tolist()}"
        )
        middles = (table[:-1] + table[1:]) / 2
        got = np.asarray(row_of(middles, table))
        assert np.allclose(got, [0.5, 1.5, 2.5]), (
            f"halfway between two beams of an uneven {name} table lie rows 0.5, 1.5, 2.5, you have {got.round(3)}"
        )
    angles = np.linspace(kitti.elevations[0], kitti.elevations[-1], 200).reshape(20, 10)
    got = np.asarray(row_of(angles, kitti.elevations))
    assert got.shape == (20, 10), f"(20, 10) elevations should give (20, 10) rows, not {got.shape}"
    assert np.allclose(got, kitti.locate(torch.tensor(angles), 0.0)[..., 0], atol=1e-4), "hdl-64e: not what locate says"
    assert np.asarray(row_of(np.array([]), kitti.elevations)).size == 0, "no elevations should give no rows"


# %% tags=["wrong"]
def row_of(elevation, elevations):  # np.interp on a falling table: no error, and nonsense
    return np.interp(elevation, elevations, np.arange(len(elevations)))


# %% tags=["wrong"]
def row_of(elevation, elevations):  # as if beams were even
    return (elevation - elevations[0]) / (elevations[-1] - elevations[0]) * (len(elevations) - 1)


# %% tags=["wrong"]
def row_of(elevation, elevations):  # the nearest beam: no row between two
    return np.abs(np.asarray(elevation)[..., None] - elevations).argmin(-1).astype(float)


# %% [markdown]
# ## 5. The seam
#
# A turning sensor comes back to where it began. Column 1023 and column 0 of the paper's sensor are neighbours like any
# other two columns; only the array does not know. The place where they meet is the *seam*.
#
# **Predict:** what is the mean of the azimuths of column 1023 and column 0, and where does it point?

# %%
last, first = paper.azimuths[-1], paper.azimuths[0]
print(f"column 1023 at {math.degrees(last):.2f}°, column 0 at {math.degrees(first):.2f}°")
print(f"mean of the two numbers: {math.degrees((last + first) / 2):.2f}°, which is straight ahead")

step = math.tau / 1024
print(f"between the two, behind the sensor: column {paper.locate(0.0, last + step / 2)[1]:.2f}")
print(
    f"full circle: {paper.wrap}; half a sensor, columns 0 to 511: {replace(paper, azimuths=paper.azimuths[:512]).wrap}"
)

# %% [markdown]
# Numbers jump by 360° at the seam; the world does not. `sensor.locate` therefore interpolates there too: between column
# 1023 and column 0 lie the columns from 1023 to just below 1024, and 1024 is 0 again. `sensor.wrap` says whether there
# is a seam at all: a sensor that sees only half the circle has two ends.
#
# What happens to code that forgets it? We turn the sensor so that its seam runs through a parked car, take an image of
# 64 rows and 64 columns, and make it 64 times finer in azimuth by linear interpolation along each row. Once with
# `np.interp` on the table of azimuths as it stands, once with column 0 repeated behind column 63. The town knows the
# truth.
#
# **Predict:** `np.interp` does not go beyond its table: it repeats the last value. What will be seen on the car?

# %%
turned = simulate.pose(pose[:3, 3], yaw=math.atan2(pose[1, 0], pose[0, 0]) - math.radians(24))
coarse, fine = preset("paper-64x1024").resize(64, 64), preset("paper-64x1024").resize(64, 4096)
measured = simulate.scan(world, coarse, turned).filled().cpu().numpy()
truth = simulate.scan(world, fine, turned).filled().cpu().numpy()

closed_table = np.append(coarse.azimuths, coarse.azimuths[0] + math.tau)  # 65 azimuths, the last one a turn later
closed_image = np.append(measured, measured[:, :1], axis=1)
clamped = np.stack([np.interp(fine.azimuths, coarse.azimuths, row) for row in measured])
wrapped = np.stack([np.interp(fine.azimuths, closed_table, row) for row in closed_image])

stripe = slice(63 * 64, 4096)  # the fine columns between column 63 and column 0
errors = {}
for name, answer in (("clamped", clamped), ("wrapped", wrapped)):
    errors[name] = np.abs(answer - truth)[:, stripe].mean()
    print(f"{name}: mean error between column 63 and column 0 {errors[name]:.2f} m")
assert errors["clamped"] > 1.5 * errors["wrapped"]
assert np.array_equal(clamped[:, : 63 * 64], wrapped[:, : 63 * 64])  # everywhere else they agree

# %%
figure, panels = plt.subplots(1, 3, figsize=(11, 3.4), sharey=True, layout="constrained")
for axes, name, answer in zip(panels, ("truth", "clamped", "wrapped"), (truth, clamped, wrapped), strict=True):
    behind = np.roll(answer, 2048, axis=1)[::-1, ::-1][:, 2048 - 300 : 2048 + 300]  # the seam in the middle
    extent = (180 + 26.4, 180 - 26.4, -15, 15)
    shown = axes.imshow(
        behind, cmap="viridis_r", vmin=0, vmax=50, extent=extent, aspect="auto", interpolation="nearest"
    )
    for azimuth, style in ((180, "--"), (180 - 360 / 64, ":")):
        axes.axvline(azimuth, color="black", linestyle=style, linewidth=1)
    axes.set(title=name, xlabel="azimuth [°]")
panels[0].set_ylabel("elevation [°]")
figure.colorbar(shown, ax=panels, label="range [m]", fraction=0.03, pad=0.01)
plt.show()

# %% [markdown]
# *In words: the view backwards three times, the seam a dashed line at 180°, the last column a dotted line at 174°.
# Left, the truth: a parked car lies across the seam. Middle, clamped: between the two lines every row has one value,
# and at the dashed line the car is cut off by a step. Right, wrapped: the car is as blurred there as everywhere else.*
#
# Nothing fails, no error is raised: one 64th of the picture is wrong, behind the sensor, where nobody looks. The code
# of the paper's authors clamps there. A convolution that pads with zeros makes a mistake of its own, unless it is
# padded in a circle. In this project everything that reads columns takes `wrap`.

# %% [markdown]
# ### Exercise 3 · The column of an azimuth
#
# ★★☆ · 8 minutes
#
# A full-circle sensor has `count` evenly spaced columns; column 0 looks along `first`, and each column `step` radians
# further (`count * step` is a full turn to the left, or to the right where `step` is negative). Write
# `column_of(azimuth, first, step, count)` for a NumPy array of azimuths of **any turn** (190° is -170°). The columns it
# returns lie in [0, count).
#
# <details><summary>Hint</summary>
#
# How many steps is it from `first` to `azimuth`? A turn is `count` steps: `%`.
#
# </details>
#
# <details><summary>Hint</summary>
#
# Try `-1e-17 % 1024` in Python. It is not below 1024: such a column is column 0.
#
# </details>


# %% tags=["exercise"]
def column_of(azimuth, first, step, count):
    raise NotImplementedError


# %% tags=["solution"]
def column_of(azimuth, first, step, count):
    column = (azimuth - first) / step % count
    return np.where(column >= count, 0.0, column)


# %% tags=["check"]
@check
def _():
    step = math.tau / 8
    for name, first, turn in (("left", -math.pi, step), ("right", math.pi, -step)):
        table = first + turn * np.arange(8)
        got = np.asarray(column_of(table, first, turn, 8))
        assert got.shape == (8,), f"8 azimuths should give 8 columns, not shape {got.shape}"
        assert np.allclose(got, range(8)), (
            f"turning {name}: the table itself is columns 0 to 7, you have {got.round(3)}"
        )
        got = float(np.asarray(column_of(np.array([table[-1] + turn / 2]), first, turn, 8))[0])
        assert abs(got - 7.5) < 1e-6, f"turning {name}: halfway across the seam is column 7.5, you have {got:.3f}"
        for full in (-math.tau, math.tau, 3 * math.tau):
            got = np.asarray(column_of(table + turn / 4 + full, first, turn, 8))
            assert np.allclose(got, np.arange(8) + 0.25), f"other turns are the same columns, you have {got.round(3)}"
    got = float(np.asarray(column_of(np.array([math.pi]), -math.pi, step, 8))[0])
    assert got < 8, f"+180° is -180°, which is column 0; you have {got:.3f}, and no column {got:.0f} exists"
    got = float(np.asarray(column_of(np.array([-1e-18]), 0.0, step, 8))[0])
    assert 0 <= got < 8, f"an azimuth the tiniest bit before column 0 gives {got}: columns should lie in [0, 8)"
    assert np.asarray(column_of(np.array([]), 0.0, step, 8)).size == 0, "no azimuths should give no columns"


# %% tags=["wrong"]
def column_of(azimuth, first, step, count):  # no seam
    return (azimuth - first) / step


# %% tags=["wrong"]
def column_of(azimuth, first, step, count):  # clamps
    return np.clip((azimuth - first) / step, 0, count - 1)


# %% tags=["wrong"]
def column_of(azimuth, first, step, count):  # forgets the sensors that turn to the right
    return (azimuth - first) % math.tau / abs(step)


# %% tags=["wrong"]
def column_of(azimuth, first, step, count):  # forgets rounding
    return (azimuth - first) / step % count


# %% [markdown]
# ## 6. Points
#
# Range times direction is a point in the frame of the sensor: $\mathbf p_{ij} = r_{ij}\,\mathbf d_{ij}$. No return
# gives no point.
#
# **Predict:** what is z of the points on the road? And what shape do the returns of one beam have on a level road, seen
# from above?

# %%
directions = paper.directions().to(device)  # (H, W, 3)
points = scan.ranges[answered][:, None] * directions[answered]  # (N, 3), N returns
assert torch.equal(points, scan.points())

height = (scan.ranges[0, 512] * directions[0, 512])[2]
print(f"{len(points):,} points; the road ahead lies at z = {height:.2f} m")
assert abs(height + 1.8) < 0.1

# %% tags=["goal"]
marks = {"A": (3, 512), "B": (9, 700), "C": (7, 225)}  # (row, column)
figure, (above, below) = plt.subplots(2, 1, figsize=(9, 7), layout="constrained", height_ratios=(1, 2.4))
extent = (1023.5, -0.5, -0.5, 15.5)  # column 0 on the right, row 0 below
shown = above.imshow(
    seen.flip(0, 1), cmap="viridis_r", vmin=0, vmax=50, extent=extent, aspect="auto", interpolation="nearest"
)
above.set(title="range image, 16 x 1024", xlabel="column", ylabel="row")
cloud = points.cpu()
below.scatter(-cloud[:, 1], cloud[:, 0], c=cloud.norm(dim=1), s=1.5, cmap="viridis_r", vmin=0, vmax=50)
below.plot(0, 0, "+", color="black", markersize=12)
below.set(title="the same returns as points, from above", xlabel="right [m]", ylabel="ahead [m]")
below.set(xlim=(-45, 45), ylim=(-22, 32), aspect="equal")
for name, (row, column) in marks.items():
    x, y, _ = (scan.ranges[row, column] * directions[row, column]).tolist()
    below.plot([0, -y], [0, x], "-", color=VERMILION, linewidth=0.9)
    for axes, place in ((above, (column, row)), (below, (-y, x))):
        axes.plot(*place, "o", color="none", markeredgecolor=VERMILION, markersize=9, markeredgewidth=2)
        axes.annotate(
            name,
            place,
            (8, 6),
            textcoords="offset points",
            fontweight="bold",
            bbox={"fc": "white", "pad": 1.5, "lw": 0},
        )
    assert scan.ranges[row, column] > 0
figure.colorbar(shown, ax=(above, below), label="range [m]", fraction=0.03, pad=0.01)
plt.show()

# %% [markdown]
# *In words: above, the range image with three marked pixels: A on the road ahead, B on a house front to the left, C on
# a trunk to the right. Below, the returns from above, the sensor as a cross. The six lowest beams draw thin rings on
# the road around it, broken where houses stand; the fronts of the houses are lines. A, B and C lie at the ends of three
# lasers, ahead, left and right.*
#
# A level road is z = -1.8 m, and a beam at a fixed angle below the horizon meets it at one range all around: a ring.
# Here is the same cloud, and that of a sensor with 128 beams. In a Jupyter session you can turn it with the mouse.

# %%
dense = simulate.scan(world, preset("paper-128x2048"), pose)
plotter = pyvista.Plotter(off_screen=True, shape=(1, 2), window_size=(1000, 420), border=False)
for number, shot in enumerate((scan, dense)):
    plotter.subplot(0, number)
    plotter.add_text("x".join(map(str, shot.sensor.shape)), font_size=10, color="black", position="upper_edge")
    near = shot.points().cpu()
    near = near[near.norm(dim=1) < 30][:: 1 + number]  # every other point of the dense one, to keep the page light
    cloud = pyvista.PolyData(near.numpy())
    cloud["height [m]"] = near[:, 2].numpy()
    plotter.add_mesh(cloud, scalars="height [m]", cmap="viridis", clim=(-2, 6), point_size=2, show_scalar_bar=False)
    plotter.camera_position = [(-34, -24, 26), (2, 0, -1), (0, 0, 1)]
show_scene(plotter)

# %% [markdown]
# *In words: two point clouds from above and behind, coloured by height. Left, 16 beams: a few rings with wide gaps.
# Right, 128 beams: close rings, cars, trees, house fronts, and the shadows behind them.*
#
# ### From points to a range image
#
# Many data sets are stored as points, so we need the way back. For each point: its range is its length, its angles give
# a pixel coordinate, and the nearest pixel centre takes it. Two things need care.
#
# **Predict:** we drive on by 3 m and sort the same points into the image of the sensor at the new place. Do more pixels
# stay empty than the 10 % that had no return before, or fewer? If several points fall into one pixel, which should it
# keep?

# %%
moved = points - torch.tensor([3.0, 0.0, 0.0], device=device)
place = paper.locate(*directions_to_angles(moved))  # (N, 2)
visible = paper.contains(place)  # at most half a pixel above the top beam or below the lowest
row, column = place[visible].round().long().unbind(-1)
row = row.clamp(0, 15)  # rounding 15.5 gives 16, and there is no row 16
column = column % 1024  # rounding 1023.7 gives 1024, which is column 0
number = torch.zeros(paper.shape, dtype=torch.long, device=device)
number.index_put_((row, column), torch.tensor(1, device=device), accumulate=True)
empty, before = (number == 0).float().mean(), (~answered).float().mean()
print(f"{empty:.0%} of the pixels stay empty; {before:.0%} had no return before")
print(f"{100 * (number > 1).float().mean():.0f} % get several points, at most {number.max()}")
assert (number > 1).float().mean() > 0.1

# %% [markdown]
# A laser stops at the first thing it meets: the **nearest point wins**. A plain assignment `image[row, column] = range`
# keeps whichever came last, so walls shine through cars, and on a GPU which one that is may change from run to run. And
# a pixel without a point is 0, no return, though we know nothing about it.

# %% [markdown]
# ### Exercise 4 · Points into a range image
#
# ★★★ · 15 minutes
#
# Write `into_image(points, sensor)`: from points (N, 3) of the sensor's frame the range image, shape `sensor.shape`. A
# point goes to the pixel nearest to its pixel coordinate; points out of view are dropped; of several points in one
# pixel the nearest stays; a pixel without a point is 0. The code cell above has most of the steps. All sensors
# here go full circle.
#
# <details><summary>Hint</summary>
#
# The range is `points.norm(dim=1)`. Either sort the points from far to near and assign them one after the other in a
# loop, or start with an image full of `torch.inf` and let each pixel keep the minimum.
#
# </details>
#
# <details><summary>Hint</summary>
#
# With a flat image of H·W pixels: `image.scatter_reduce_(0, row * width + column, ranges, "amin")`. Then turn what is
# still infinite into 0.
#
# </details>


# %% tags=["exercise"]
def into_image(points, sensor):
    raise NotImplementedError


# %% tags=["solution"]
def into_image(points, sensor):
    height, width = sensor.shape
    place = sensor.locate(*directions_to_angles(points))
    visible = sensor.contains(place)
    row, column = place[visible].round().long().unbind(-1)
    row, column = row.clamp(0, height - 1), column % width
    image = torch.full((height * width,), torch.inf)
    image.scatter_reduce_(0, row * width + column, points[visible].norm(dim=1), "amin")
    return torch.where(image.isinf(), 0.0, image).view(height, width)


# %% tags=["check"]
@check
def _():
    sensor = paper.resize(16, 64)
    rays = sensor.directions()

    def only(points, wanted, message):
        image = into_image(torch.stack(points) if points else torch.empty(0, 3), sensor)
        assert tuple(image.shape) == sensor.shape, f"the image should be {sensor.shape}, not {tuple(image.shape)}"
        expected = torch.zeros(sensor.shape)
        for pixel, value in wanted.items():
            expected[pixel] = value
        wrong = (image - expected).abs() > 1e-3
        place = tuple(wrong.nonzero()[0].tolist()) if wrong.any() else (0, 0)
        found = f"{int(wrong.sum())} pixels differ; {place} is {image[place]:.2f}, it should be {expected[place]:.2f}"
        assert not wrong.any(), f"{message}: {found}"

    only([], {}, "without points every pixel is no return, 0")
    only([20 * rays[4, 10]], {(4, 10): 20}, "one point, 20 m along the ray of pixel (4, 10)")
    near, far = 8 * rays[4, 10], 30 * rays[4, 10]
    only([near, far], {(4, 10): 8}, "two points in pixel (4, 10), first 8 m then 30 m away: the nearest stays")
    only([far, near], {(4, 10): 8}, "two points in pixel (4, 10), first 30 m then 8 m away: the nearest stays")
    between = torch.lerp(torch.tensor(sensor.azimuths[10]), torch.tensor(sensor.azimuths[11]), 0.8)
    tilted = angles_to_directions(torch.tensor(sensor.elevations[4]), between).float()
    only([5 * tilted], {(4, 11): 5}, "a point at column 10.8 belongs to column 11, whose centre is nearer")
    seam = angles_to_directions(torch.tensor(sensor.elevations[4]), torch.tensor(sensor.azimuths[-1] + 0.08)).float()
    only([5 * seam], {(4, 0): 5}, "a point at column 63.8 is nearest to column 0, across the seam")
    up = torch.tensor([0.1, 0.0, 9.0])
    only([up, near], {(4, 10): 8}, "a point overhead is in nobody's view: it should be dropped")
    answer, wanted = into_image(moved.cpu(), paper), Scan.from_points(moved.cpu(), paper).ranges
    differ = int(((answer - wanted).abs() > 1e-3).sum())  # halfway between two pixels rounding may go either way
    assert differ < 10, f"the street from 3 m ahead: {differ} pixels are not what Scan.from_points makes of it"


# %% tags=["wrong"]
def into_image(points, sensor):  # the last one wins
    place = sensor.locate(*directions_to_angles(points))
    visible = sensor.contains(place)
    row, column = place[visible].round().long().unbind(-1)
    image = torch.zeros(sensor.shape)
    image[row.clamp(0, sensor.shape[0] - 1), column % sensor.shape[1]] = points[visible].norm(dim=1)
    return image


# %% tags=["wrong"]
def into_image(points, sensor):  # zeros take part in the minimum
    place = sensor.locate(*directions_to_angles(points))
    visible = sensor.contains(place)
    row, column = place[visible].round().long().unbind(-1)
    image = torch.zeros(sensor.shape[0] * sensor.shape[1])
    index = row.clamp(0, sensor.shape[0] - 1) * sensor.shape[1] + column % sensor.shape[1]
    return image.scatter_reduce_(0, index, points[visible].norm(dim=1), "amin").view(sensor.shape)


# %% tags=["wrong"]
def into_image(points, sensor):  # clamps at the seam
    height, width = sensor.shape
    place = sensor.locate(*directions_to_angles(points))
    visible = sensor.contains(place)
    row, column = place[visible].round().long().unbind(-1)
    image = torch.full((height * width,), torch.inf)
    index = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    image.scatter_reduce_(0, index, points[visible].norm(dim=1), "amin")
    return torch.where(image.isinf(), 0.0, image).view(height, width)


# %% tags=["wrong"]
def into_image(points, sensor):  # cuts off instead of rounding
    height, width = sensor.shape
    place = sensor.locate(*directions_to_angles(points))
    visible = sensor.contains(place)
    row, column = place[visible].long().unbind(-1)
    image = torch.full((height * width,), torch.inf)
    image.scatter_reduce_(0, row * width + column % width, points[visible].norm(dim=1), "amin")
    return torch.where(image.isinf(), 0.0, image).view(height, width)


# %% tags=["wrong"]
def into_image(points, sensor):  # presses what is out of view into the border rows
    height, width = sensor.shape
    row, column = sensor.locate(*directions_to_angles(points)).round().long().unbind(-1)
    image = torch.full((height * width,), torch.inf)
    image.scatter_reduce_(0, row.clamp(0, height - 1) * width + column % width, points.norm(dim=1), "amin")
    return torch.where(image.isinf(), 0.0, image).view(height, width)


# %% [markdown]
# `Scan.from_points` does this in the package. There and back without moving changes nothing but the last bits. After
# moving 3 m, we see what the sensor never measured.

# %%
again = Scan.from_points(points, paper).ranges
assert torch.equal(again > 0, answered)
assert torch.allclose(again, scan.ranges, atol=1e-3)

shifted = Scan.from_points(moved, paper).ranges
there = pose.clone()
there[:3, 3] += 3 * pose[:3, 0]  # 3 m along the sensor's x axis
new_truth = simulate.scan(world, paper, there).ranges

figure, pair = plt.subplots(2, 1, figsize=(11, 3.6), sharex=True, layout="constrained")
for axes, (name, answer) in zip(
    pair, {"old points, seen from 3 m ahead": shifted, "a scan from there": new_truth}.items(), strict=True
):
    answer = answer.cpu().where(answer.cpu() > 0, torch.nan).flip(0, 1)
    extent = (180, -180, -16, 16)
    shown = axes.imshow(
        answer, cmap="viridis_r", vmin=0, vmax=50, extent=extent, aspect="auto", interpolation="nearest"
    )
    axes.set(ylabel="elevation [°]")
    axes.set_title(name, loc="left", fontsize=10)
pair[1].set_xlabel("azimuth [°]")
figure.colorbar(shown, ax=pair, label="range [m]", fraction=0.03, pad=0.01)
plt.show()
known = (shifted > 0).sum() / (new_truth > 0).sum()
print(f"the old points fill {100 * known:.0f} % as many pixels as a scan from there")
assert known < 0.9

# %% [markdown]
# *In words: above, the old points in the image of the sensor that drove on: the same street full of holes. On the road
# whole beams are missing ahead and behind, on the near house front there are upright white stripes, and gaps open where
# something stood in the way before. Below, a real scan from there, without holes.*
#
# To fill the holes is to say what lies between the rays that were cast: the subject of this course.

# %% [markdown]
# ## 7. Range is not depth
#
# A camera speaks of *depth*: how far something lies along the optical axis, here x. A LiDAR measures *range*: how far
# along its own ray. For the direction $\mathbf d$ they are $r$ and $r\,d_x$.
#
# **Predict:** a flat wall stands across the way, 10 m ahead. Draw its range and its depth against the azimuth.

# %%
wall = math.radians(60)
azimuth = torch.linspace(-wall, wall, 121, dtype=torch.float64)
look = angles_to_directions(torch.tensor(0.0, dtype=torch.float64), azimuth)
ranges = 10 / look[:, 0]  # r d_x = 10
depth = ranges * look[:, 0]
assert torch.allclose(depth, torch.full_like(depth, 10))
assert abs(ranges.amax() - 20) < 1e-6

figure, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
axes.plot(azimuth.rad2deg(), ranges, color=BLUE, label="range $r$")
axes.plot(azimuth.rad2deg(), depth, "--", color=VERMILION, label="depth $r\\,d_x$")
axes.plot(azimuth.rad2deg(), 100 / ranges, ":", color=GREEN, label="inverse range, $100/r$")
axes.set(xlabel="azimuth [°]", ylabel="[m]; dotted [1/m]", ylim=(0, 22))
axes.legend()
plt.show()

# %% [markdown]
# *In words: depth is a horizontal line at 10 m. Range is a valley: 10 m straight ahead, 20 m at 60° to either side. A
# third, dotted curve shows 100 divided by the range: a low arch from 5 to 10 and back.*
#
# A flat wall has curved ranges: linear interpolation between two of them bends it. Its inverse range is a plain cosine
# of the azimuth; [03 · Between the pixels](03_between_the_pixels.ipynb) makes use of that. Depth would be flat, but of
# what lies at the side it is 0, and behind the sensor it is negative: on a full circle it is of no use.

# %% [markdown]
# ## 8. Scans in files
#
# A range image alone is not a scan: the tables of angles have to come along. An `.npz` file of this project holds both.
# Point files (`.ply`, `.pcd`, KITTI's `.bin`) do not know their sensor, so that you have to name it (a `.bin` is else
# taken for `hdl-64e`); reading sorts the points into its image as you did.

# %%
with tempfile.TemporaryDirectory() as folder:
    for name in ("street.npz", "street.ply"):
        scan_files.write(Path(folder) / name, scan)
        size = (Path(folder) / name).stat().st_size
        loaded = scan_files.read(Path(folder) / name, None if name.endswith("npz") else paper)
        worst = (loaded.ranges - scan.ranges.cpu()).abs().max()
        print(f"{name}: {size / 1024:.0f} KiB, read again: off by at most {1000 * worst:.3f} mm")
        assert worst < 1e-3

# %% [markdown]
# The points come back to within a fraction of a millimetre. Not every format is so kind: the authors of the paper store
# ranges as 16-bit floating-point numbers, whose steps at 80 m are 6 cm, of the size of the 10 cm cubes that IoU counts.
# Know your format before you trust a small difference between two methods.

# %% [markdown]
# ## Summary
#
# 1. A sensor is two tables of angles. Rows may count up or down, evenly or not; always look the angle up.
# 2. A range image stores one range per ray; 0 is the label for no return, replaced by a long range before arithmetic.
# 3. A pixel coordinate is a continuous (row, column) whose integers are pixel centres; on a full circle the last column
#    is the neighbour of the first.
# 4. Range times direction is a point. On the way back several points may meet in one pixel: the nearest wins.
#
# ## Next
#
# Where do ranges come from in a simulation? In [02 · Casting rays](02_casting_rays.ipynb) you write the kernels
# yourself, one thread per ray.
