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
# # First light: load a town, cast, look
#
# **Goal.** You build a street, put a LiDAR into it, and find out what it fails to see between its beams.
#
# **After this notebook you can**
#
# - cast any ray at any triangle mesh, and read its range, triangle and cosine;
# - simulate a LiDAR from two tables of angles, and draw its range image and its points;
# - ask for a direction between the pixels, blend its four neighbours, and say where a fixed blend works and where it
#   fails.
#
# | | |
# |---|---|
# | You know | Python, a little PyTorch (tensors, shapes, indexing) |
# | Time | 20 minutes to read and try; under a minute to run |
# | Hardware | any computer; a CUDA GPU is used if there is one |
#
# Each section asks you for a prediction. Write it down before you run the next cell.

# %%
import io
import math

import matplotlib.pyplot as plt
import numpy as np
import PIL.Image
import pyvista
import torch
from IPython.display import Image

from ilnet import simulate, towns
from ilnet.sensor import angles_to_directions, preset
from kernels import Mesh, gather_blend, gather_neighbours

pyvista.OFF_SCREEN = True  # draw into memory: no window
pyvista.vtk_verbosity("off")  # where there is no screen VTK warns of its absence, then renders all the same
device = "cuda" if torch.cuda.is_available() else "cpu"


# %% [markdown]
# ## 1. A town is triangles
#
# `towns.build` makes a town from its name and a seed. The same name and seed give the same triangles everywhere.
# A town has no colours and no names of things: only points in metres (x east, y north, z up), triangles between them,
# and *waypoints* on its lanes where a car could be.
#
# **Predict:** a town of about 650 m × 650 m, with houses, trees and fences. How many triangles is that?

# %%
town = towns.build("town01")

print(f"{len(town.vertices):,} vertices, {len(town.triangles):,} triangles, {len(town.waypoints):,} waypoints")
west, south, _ = town.vertices.min(axis=0)
east, north, _ = town.vertices.max(axis=0)
print(f"{east - west:.0f} m from west to east, {north - south:.0f} m from south to north")

# %% [markdown]
# We stand at waypoint 1445 and look from above, then along the lane. A waypoint lies on the road; the LiDAR sits 1.8 m
# above it, on the roof of the car. What moves is not part of a town: `towns.traffic` draws cars and people around us,
# others for each seed.

# %%
WAYPOINT, SENSOR_HEIGHT = 1445, 1.8
lidar = torch.tensor(town.waypoints[WAYPOINT]) + torch.tensor([0.0, 0.0, SENSOR_HEIGHT])
heading = float(town.headings[WAYPOINT])
ahead = torch.tensor([math.cos(heading), math.sin(heading), 0.0])

cars, car_triangles = towns.traffic(town, lidar.numpy(), seed=0)
vertices = np.concatenate([town.vertices, cars])
triangles = np.concatenate([town.triangles, car_triangles + len(town.vertices)])

surface = pyvista.PolyData.from_regular_faces(vertices, triangles)
surface["height [m]"] = vertices[:, 2]


def picture(plotter):
    """A PyVista scene as a PNG of 256 colours, so that the notebook stays small."""
    pixels = plotter.screenshot()
    plotter.close()
    png = io.BytesIO()
    PIL.Image.fromarray(pixels).quantize(256, PIL.Image.Quantize.MAXCOVERAGE).save(png, "png", optimize=True)
    return Image(png.getvalue())


plotter = pyvista.Plotter(shape=(1, 2), window_size=(1200, 560), border=False)
style = {"scalars": "height [m]", "cmap": "cividis", "clim": (-12, 20), "show_scalar_bar": False}
style |= {"ambient": 0.25, "diffuse": 0.75}
plotter.add_mesh(surface, **style)
plotter.add_mesh(pyvista.Sphere(radius=9, center=lidar.tolist()), color="#d55e00", lighting=False)
plotter.view_xy()
plotter.camera.parallel_projection = True
plotter.camera.parallel_scale = 260
plotter.subplot(0, 1)
plotter.add_mesh(surface, **style)
plotter.camera_position = [lidar.tolist(), (lidar + ahead).tolist(), (0, 0, 1)]
plotter.camera.view_angle = 75
plotter.camera.clipping_range = (0.5, 500)
picture(plotter)

# %% [markdown]
# *In words: two pictures coloured by height, from grey-blue ground to yellow roofs. Left, the town from above: rows of
# houses along a few crossing streets, an orange dot at our waypoint near the middle. Right, what we see from there: a
# grey road ahead, a parked car and a bench on the left, people on the pavement, trees, house fronts on both sides.*

# %% [markdown]
# ## 2. One ray
#
# A LiDAR measures the distance to whatever its laser meets first. A ray starts at $\mathbf o$ and runs along the unit
# vector $\mathbf d$. Its *range* is the smallest $r$ for which
#
# $$\mathbf p = \mathbf o + r\,\mathbf d$$
#
# lies on a triangle. `Mesh` copies the triangles to a device once and sorts them into a tree of boxes, so that a ray
# tests a few triangles and not all of them.
#
# **Predict:** what range comes back from a ray straight down?

# %%
mesh = Mesh(vertices, triangles, device)
origin = lidar.to(device)

down = mesh.cast(origin, torch.tensor([0.0, 0.0, -1.0], device=device), max_range=80.0)
print(f"straight down: {down.range:.3f} m, triangle {down.triangle}, cosine {down.cosine:.4f}")
assert abs(down.range - SENSOR_HEIGHT) < 0.01

# %% [markdown]
# The height of the sensor, as it should be. The three numbers:
#
# - `range`: metres along the ray. **0 means that nothing was met** within `max_range`.
# - `triangle`: which triangle was met, -1 for none.
# - `cosine`: $|\mathbf n \cdot \mathbf d|$ for the triangle's unit normal $\mathbf n$. 1 is a hit at right angles, near
#   0 is a grazing one.
#
# **Predict:** a ray ahead, 10° below the horizon, still meets the road. What are its range and its cosine? (Draw the
# right triangle.) And what do you expect of a ray along the world's y axis, northwards?

# %%
dip = math.radians(10.0)
slanted = (math.cos(dip) * ahead + torch.tensor([0.0, 0.0, -math.sin(dip)])).to(device)
slant = mesh.cast(origin, slanted, max_range=80.0)
print(f"10 degrees down: {slant.range:.2f} m (a level road: {SENSOR_HEIGHT / math.sin(dip):.2f} m)")
print(f"         cosine: {slant.cosine:.3f} (a level road: {math.sin(dip):.3f})")
assert abs(slant.range - SENSOR_HEIGHT / math.sin(dip)) < 0.3
assert abs(slant.cosine - math.sin(dip)) < 0.02

axis = mesh.cast(origin, torch.tensor([0.0, 1.0, 0.0], device=device), max_range=80.0)
print(f"   along y axis: {axis.range:.2f} m, triangle {axis.triangle}, cosine {axis.cosine:.3f}")

# %% [markdown]
# The road is not quite level, so the numbers are close to the triangle's and not equal to them. To be sure that we
# understand `range` and `triangle`, we check that $\mathbf o + r\,\mathbf d$ lies in the plane of that triangle:
# $\mathbf n \cdot (\mathbf p - \mathbf v_0) = 0$.

# %%
v0, v1, v2 = torch.tensor(vertices[triangles[slant.triangle.item()]], device=device)
normal = torch.nn.functional.normalize(torch.linalg.cross(v1 - v0, v2 - v0), dim=0)

p = origin + slant.range * slanted  # p = o + r d
print(f"distance of p from the triangle's plane: {normal @ (p - v0):.5f} m")  # n . (p - v0)
assert abs(normal @ (p - v0)) < 1e-3
assert abs(abs(normal @ slanted) - slant.cosine) < 1e-3  # |n . d|

# %% [markdown]
# ## 3. A sensor is two tables of angles
#
# A spinning LiDAR has a column of lasers. Laser $i$ looks up or down by its elevation $\epsilon_i$, and the column
# turns through azimuths $\alpha_j$. In the sensor's frame (x ahead, y left, z up) ray $(i, j)$ looks along
#
# $$\mathbf d_{ij} = (\cos\epsilon_i\cos\alpha_j,\ \cos\epsilon_i\sin\alpha_j,\ \sin\epsilon_i)$$
#
# That is all a `Sensor` is: the table of elevations, the table of azimuths, and its range limits. The ranges of all
# rays make a *range image* with one row per elevation and one column per azimuth.

# %%
coarse, fine = preset("paper-16x1024"), preset("paper-128x2048")
print(coarse)
print(fine)

i, j = 4, 700
elevation, azimuth = coarse.elevations[i], coarse.azimuths[j]
d = torch.tensor(
    [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
)
assert torch.allclose(d, coarse.directions()[i, j])

# %% [markdown]
# `simulate.simulate` turns the rays into the world with the sensor's pose, casts them, and returns a `Scan`: the range
# image with its sensor.
#
# **Predict:** the road is one flat thing. Does it have one range in the image? The coarse sensor has beams at -5° and
# -3°: how far apart do they touch the road?

# %%
pose = simulate.pose(lidar, yaw=heading)
scan = simulate.simulate(mesh, coarse, pose)
dense = simulate.simulate(mesh, fine, pose)


def draw(axes, scan, title):
    """A range image as one sees it: the top beam above, left on the left, no return white."""
    image = scan.ranges.cpu()
    image = image.where(image > 0, torch.nan).flip(0, 1)  # these sensors count beams upwards and turn to the left
    extent = (180, -180, -15, 15)
    shown = axes.imshow(image, cmap="viridis_r", vmin=0, vmax=50, extent=extent, aspect="auto", interpolation="nearest")
    axes.set_title(title, loc="left", fontsize=10)
    axes.set_ylabel("elevation [°]")
    return shown


figure, (above, below) = plt.subplots(2, 1, figsize=(11, 4.4), sharex=True, layout="constrained")
draw(above, scan, "16 x 1024 rays")
shown = draw(below, dense, "128 x 2048 rays")
below.set_xlabel("azimuth [°]")
figure.colorbar(shown, ax=(above, below), label="range [m]", fraction=0.03, pad=0.01)
plt.show()

# %% [markdown]
# *In words: two range images, one above the other; near is yellow-green, far is dark blue, no return is white. In both
# the road fills the lower third and house fronts, parked cars, trunks and tree tops stand above it. In the upper image,
# with 16 beams, the road is six flat stripes and every outline is a staircase. In the lower one, with 128 beams, the
# road darkens smoothly with the distance, cars are rounded, and trees have trunks and branches.*

# %%
ahead_column = 512  # azimuth 0
assert coarse.azimuths[ahead_column] == 0
for row in range(7):
    print(f"{math.degrees(coarse.elevations[row]):6.1f}°  {scan.ranges[row, ahead_column]:6.2f} m")

road = scan.ranges[:7, ahead_column]
assert (road.diff() > 0).all()  # the higher the beam, the farther it touches the road
assert road[6] - road[5] > 12 * (road[1] - road[0])
assert dense.ranges.numel() == 16 * scan.ranges.numel()

# %% [markdown]
# One road, many ranges: a level road has range $h / \sin(-\epsilon)$ for a sensor at height $h$. The same two degrees
# between two beams are one metre of road near the car, and more than twelve times as much at the last two beams that
# touch it. What lies in between, the coarse sensor does not say.

# %% [markdown]
# ## 4. A range image is points
#
# Each pixel knows its direction, so each return is a point: $\mathbf p_{ij} = r_{ij}\,\mathbf d_{ij}$. That is
# `scan.points()`, in the frame of the sensor. Pixels without a return are left out.
#
# **Predict:** what is z on the road in this frame?

# %%
points = scan.points()
returned = scan.ranges > 0
by_hand = scan.ranges[returned][:, None] * coarse.directions().to(device)[returned]  # p = r d
assert torch.equal(points, by_hand)

print(f"{returned.sum():,} of {returned.numel():,} rays came back")
lowest = scan.ranges[0][:, None] * coarse.directions().to(device)[0]
print(f"height of the ground ahead, where the lowest beam meets it: {lowest[ahead_column, 2]:.2f} m")
assert abs(lowest[ahead_column, 2] + SENSOR_HEIGHT) < 0.1

plotter = pyvista.Plotter(shape=(1, 2), window_size=(1200, 560), border=False)
for number, cast in enumerate((scan, dense)):
    plotter.subplot(0, number)
    plotter.add_text("x".join(map(str, cast.sensor.shape)), font_size=10, color="black", position="upper_edge")
    near = cast.points().cpu()
    near = near[near.norm(dim=1) < 35]
    cloud = pyvista.PolyData(near.numpy())
    cloud["height [m]"] = near[:, 2].numpy()
    plotter.add_mesh(cloud, scalars="height [m]", cmap="viridis", clim=(-2, 6), point_size=2, show_scalar_bar=False)
    plotter.camera_position = [(-42, -30, 32), (2, 0, -1), (0, 0, 1)]
picture(plotter)

# %% [markdown]
# *In words: the same place as two point clouds, seen from above and behind, coloured by height. Left, the coarse scan:
# six thin rings on the ground with wide empty gaps, a few dashes where poles and trees are. Right, the dense scan:
# close rings, cars, tree trunks with crowns, house fronts, and the shadows that they throw.*

# %% [markdown]
# ## 5. Between the beams
#
# Now we ask for a direction that the coarse sensor did not measure. `sensor.locate` turns its angles into a *pixel
# coordinate* (row, column): integers are pixel centres, and 4.3 lies 30 % of the way from row 4 to row 5. The four
# pixels around it are its *neighbours*, and the answer is a blend of their ranges with weights that sum to 1:
#
# $$\hat r = \sum_{t=1}^{4} w_t\, r_t, \qquad w = \operatorname{softmax}(s + p)$$
#
# The *scores* $s$ are what a network will say. We have none yet, so $s = 0$ and the *prior* $p$ decides alone:
#
# | prior | $p_t$ | zero scores give |
# |---|---|---|
# | `"none"` | 0 | the mean of the four |
# | `"bilinear"` | $\log a_t$, the bilinear area | $\sum a_t r_t$ |
# | `"perspective"` | $\log a_t - \log r_t$ | $1 / \sum (a_t / r_t)$: bilinear over *inverse* range |
#
# We can also cheat: we have the town, so we cast the ray and know the truth.

# %%
PRIORS = ("none", "bilinear", "perspective")
image = scan.filled()  # (16, 1024); no return becomes 100 m, as the networks see it
elevations = torch.tensor(coarse.elevations, device=device)
azimuths = torch.tensor(coarse.azimuths, device=device)
rotation, position = pose[:3, :3].to(device), pose[:3, 3].to(device)


def to_world(elevation, azimuth):
    """The world directions (Q, 3) of angles (Q,) in the sensor's frame."""
    return angles_to_directions(elevation, azimuth) @ rotation.T


def blend(queries, prior):
    scores = image.new_zeros(len(queries), 4)  # s = 0
    return gather_blend(image, queries, scores, prior)  # sum of softmax(s + p)_t r_t


def probe(rows, columns, row_part=0.3, column_part=0.4):
    """One query in each cell between four pixels: its neighbours, its blends, the truth, and its world direction."""
    elevation = torch.lerp(elevations[rows], elevations[rows + 1], row_part)
    azimuth = torch.lerp(azimuths[columns], azimuths[columns + 1], column_part)
    queries = coarse.locate(elevation, azimuth)  # (Q, 2)
    neighbours = gather_neighbours(image[None], queries)[0][..., 0]  # (Q, 4)
    blends = {prior: blend(queries, prior) for prior in PRIORS}  # (Q,) each
    directions = to_world(elevation, azimuth)  # (Q, 3)
    truth = mesh.cast(position, directions, coarse.max_range).range  # (Q,)
    return queries, neighbours, blends, truth, directions


def number_line(title, neighbours, blends, truth):
    """Four neighbours, three blends and the truth on one axis of range."""
    axes = plt.figure(figsize=(9, 1.9), layout="constrained").subplots()
    axes.axvline(truth.item(), color="black", linewidth=1.5, label="truth (ray cast)")
    axes.plot(neighbours.cpu(), [0] * 4, "o", color="#999999", markersize=9, label="4 neighbours")
    looks = {"none": ("s", "#e69f00"), "bilinear": ("^", "#0072b2"), "perspective": ("D", "#d55e00")}
    for height, (prior, (marker, colour)) in enumerate(looks.items(), start=1):
        axes.plot(blends[prior].cpu(), height, marker, color=colour, markersize=8, label=prior, linestyle="")
    axes.set(xlabel="range [m]", yticks=[], ylim=(-0.7, 3.7))
    axes.set_title(title, loc="left", fontsize=10)
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    plt.show()


# %% [markdown]
# ### On the road
#
# Straight ahead, between the beams at -7° (row 4) and -5° (row 5).
#
# **Predict:** which blend is nearest to the truth? On a plane $\mathbf n \cdot \mathbf p = c$, seen from the sensor at
# the origin, we have $r\,\mathbf n \cdot \mathbf d = c$, so $1/r = \mathbf n \cdot \mathbf d / c$ is linear in the
# direction, and $r$ is not. (Over so small a cell the direction is almost linear in the pixel coordinate.)

# %%
row, column = torch.tensor([4], device=device), torch.tensor([ahead_column], device=device)
queries, neighbours, blends, truth, _ = probe(row, column)
road_case = queries, neighbours, blends["perspective"]

print("pixel coordinate:", [round(x, 3) for x in queries[0].tolist()])
print("neighbours [m]:  ", [round(r, 2) for r in neighbours[0].tolist()])
errors = {prior: (blends[prior] - truth).abs().item() for prior in PRIORS}
print("truth [m]:       ", round(truth.item(), 2))
for prior, error in errors.items():
    print(f"{prior:>12}: {blends[prior].item():.2f} m, off by {error:.2f} m")
assert errors["perspective"] < errors["bilinear"] < errors["none"]
assert errors["perspective"] < 0.05
number_line("on the road", neighbours[0], blends, truth)

# %% [markdown]
# *In words: a line of ranges. Two neighbours near 15 m, two near 20 m. The diamond of the perspective blend lies on the
# truth at 16.0 m, bilinear 0.4 m too far, the mean 1.6 m too far.*
#
# The perspective blend knows that roads and walls are flat. No network is needed for that.

# %% [markdown]
# ### At the edge of a thing
#
# Now a place where the four neighbours disagree. We search the image for upright edges: the two neighbours in one
# column agree, the two in the next column agree, and the two pairs lie as far apart as possible. We only look at the
# image here, not at the truth.
#
# **Predict:** one pair is near, the other far. Where is the truth, and where are the three blends?

# %%
ranges = scan.ranges
one, other = ranges[:, :-1], ranges[:, 1:]  # each column and the next
agree = (one.diff(dim=0).abs() < 0.5) & (other.diff(dim=0).abs() < 0.5)  # (15, 1023)
cell = torch.stack((one[:-1], other[:-1], one[1:], other[1:]))  # (4, 15, 1023)
spread = (cell.amax(0) - cell.amin(0)).where(agree & (cell > 0).all(0), 0.0)

strongest = spread.flatten().topk(100).indices
rows, columns = strongest // spread.shape[1], strongest % spread.shape[1]
queries, neighbours, blends, truth, directions = probe(rows, columns)
edge_case = queries[:1], neighbours[:1], truth[:1]

print("neighbours [m]:  ", [round(r, 2) for r in neighbours[0].tolist()])
print("truth [m]:       ", round(truth[0].item(), 2))
for prior in PRIORS:
    print(f"{prior:>12}: {blends[prior][0]:.2f} m, off by {abs(blends[prior][0] - truth[0]):.2f} m")
number_line("at an edge", neighbours[0], {prior: blends[prior][0] for prior in PRIORS}, truth[0])

# %% [markdown]
# *In words: a line of ranges. Two neighbours near 30 m, two near 78 m, the truth among the far ones. The three blends
# are scattered between, 24 m and more from the truth.*
#
# Every blend made up a point between what is in front and what is behind. Is there really nothing? We stand at each
# made-up point and cast rays in all directions: the shortest range says how far the nearest surface is. Then we look at
# the 100 strongest edges, to see whether we met bad luck at one.

# %%
around = torch.randn(20_000, 3, generator=torch.Generator().manual_seed(0)).to(device)
for prior in PRIORS:
    made_up = position + blends[prior][0] * directions[0]  # p = o + r d
    distances = mesh.cast(made_up, around, max_range=80.0).range
    nearest = distances[distances > 0].min()
    print(f"{prior:>12}: nearest surface {nearest:.2f} m away")
    assert nearest > 0.3

blend_error = torch.stack([(blends[prior] - truth).abs() for prior in PRIORS]).amin(0)  # of the luckiest blend
neighbour_error = (neighbours - truth[:, None]).abs().amin(1)  # of the best neighbour
print("\n100 edges")
for name, error in (("luckiest of the blends", blend_error), ("best of the neighbours", neighbour_error)):
    print(f"{name}: median error {error.median():5.2f} m, within 0.5 m at {(error < 0.5).sum()} edges")
assert blend_error.median() > 10 * neighbour_error.median()
assert (neighbour_error < 0.5).sum() > 80

# %% [markdown]
# At most edges the right answer was there all the time: one of the four neighbours has it. A fixed blend cannot pick
# it, since it looks only at where the query lies and at four numbers, not at what they belong to. **So learn the
# weights:** a network reads the picture around the query and says four scores. If it chooses well, the edge stays
# sharp. And whatever it says, the answer lies between the nearest and the farthest neighbour.

# %% [markdown]
# ## Summary
#
# 1. A LiDAR scan is a range image: two tables of angles and one cast ray per pixel. Range times direction is a point.
# 2. Between the pixels a blend of the four neighbours answers. Over inverse range it is nearly exact on planes.
# 3. At edges fixed blends make up points in empty air. One neighbour is mostly right: a network learns to choose it.

# %% [markdown]
# ## Exercises
#
# **1. The perspective blend by hand.** You have the ranges $r_t$ of the four neighbours and their bilinear areas $a_t$.
# Replace `None` by $1 / \sum_t (a_t / r_t)$.

# %%
queries, r, expected = road_case
a = gather_blend(image, queries, image.new_zeros(1, 4), "bilinear", return_weights=True)[1]  # zero scores: the areas

my_blend = None  # your line: r and a have shape (1, 4)


def check_blend(answer):
    if answer is None:
        print("Exercise 1: not solved yet.")
        return
    value = torch.as_tensor(answer).flatten()
    if value.numel() != 1:
        raise AssertionError(f"One number is wanted, you have {value.numel()}: is the sum over the neighbours missing?")
    if abs(value - (a * r).sum()) < 1e-3:
        raise AssertionError("That is the bilinear blend of ranges. Blend the inverse ranges, and invert the result.")
    if abs(value - (a / r).sum()) < 1e-3:
        raise AssertionError("That is the blended inverse range, in 1/m. One step is missing.")
    if abs(value - expected) > 1e-3:
        raise AssertionError(f"You have {value.item():.3f} m, it should be {expected.item():.3f} m: 1 / sum(a / r).")
    print("Exercise 1: right.")


check_blend(my_blend)

# %% [markdown]
# **2. Be the network.** Choose four scores for the query at the edge, so that the blend *without* a prior comes within
# 1 m of the truth. Softmax turns them into weights: a score that is larger by 5 gets a weight 150 times as large.
# The order is that of the ranges printed below: two columns of the lower beam, then the same two of the upper beam.

# %%
edge_query, edge_r, edge_truth = edge_case
print("neighbours [m]:", [round(x, 2) for x in edge_r[0].tolist()], " truth [m]:", round(edge_truth.item(), 2))

my_scores = None  # your line: a list of four numbers


def check_scores(answer):
    if answer is None:
        print("Exercise 2: not solved yet.")
        return
    scores = torch.as_tensor(answer, dtype=image.dtype, device=device).reshape(1, -1)
    if scores.shape != (1, 4):
        raise AssertionError(f"Four scores are wanted, you have {scores.numel()}.")
    blended, weights = gather_blend(image, edge_query, scores, "none", return_weights=True)
    said = f"weights {[round(w, 3) for w in weights[0].tolist()]} give {blended.item():.2f} m"
    if abs(blended - edge_truth) > 1.0:
        raise AssertionError(f"Your {said}, the truth is {edge_truth.item():.2f} m. Which neighbours are right?")
    print(f"Exercise 2: right. Your {said}.")


check_scores(my_scores)

# %% [markdown]
# ## Next
#
# See a trained network choose the weights for 128 × 2048 directions in this town. In a terminal:
#
# ```
# python -m ilnet demo
# ```
