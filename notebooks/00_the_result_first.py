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
# # 00 · The result first
#
# ![Four range images of the same street, one above the other: 16 coarse rows, two dense predictions, and the true
# scan.](pictures/00_the_result_first.png)
#
# **Goal.** You make a LiDAR scan of 16 beams eight times as dense, in a minute and before you know how, and see what is
# wrong with the obvious way of doing it. The other notebooks explain every step.
#
# **After this notebook you can**
#
# - upsample a scan to any size with a shipped network, in two lines;
# - say what is wrong with the obvious way, and measure it;
# - find your way through the course.
#
# | | |
# |---|---|
# | You know | Python, a little PyTorch (tensors, shapes, indexing) |
# | Time | 15 minutes, and 15 for the exercises; under a minute to run |
# | Hardware | any computer; a CUDA GPU is used if there is one |
#
# How to use the course: read, run each cell (Shift + Enter), and when a line says **Predict:**, write down what you
# expect before you run the next cell. Exercises check themselves. Their solutions are folded below them.

# %%
import math

import matplotlib.pyplot as plt
import numpy as np
import pyvista
import torch

from ilnet import metrics, models, places, simulate
from ilnet.course import check, show_scene
from ilnet.sensor import preset

pyvista.vtk_verbosity("off")  # where there is no screen VTK warns of its absence, then renders all the same
device = "cuda" if torch.cuda.is_available() else "cpu"

# %% [markdown]
# ## 1. A scan, and what a better sensor would have seen
#
# A LiDAR on the roof of a car sends out laser beams and measures how far each gets: its *range*. This one has 16 beams
# one above the other and turns, so that a scan is an image of 16 rows and 1024 columns: rows differ in *elevation*, the
# angle above the horizon, columns in *azimuth*, the direction on a map. A ray that meets nothing within 80 m has range
# 0: *no return*. We simulate this sensor, in a town that no network has seen in training, and a second, expensive one
# with 128 × 2048 rays at the same place: the truth.

# %%
street = places.town("town10", device=device)
pose = street.pose(1400)  # (4, 4): where on the street the sensor is, and where it looks
world = street.world(pose[:3, 3], seed=1400)  # what stands around there, with cars and people of that seed

sparse = simulate.scan(world, preset("paper-16x1024"), pose)
truth = simulate.scan(world, preset("paper-128x2048"), pose)
print("measured:", tuple(sparse.ranges.shape), " wanted:", tuple(truth.ranges.shape))

# %% [markdown]
# ## 2. Two lines
#
# For every measured ray 16 are wanted, and hardly any of those was measured itself. The obvious method, `bilinear`,
# interpolates between the four measured pixels around each wanted ray. The network `iln-surfaces` is our successor to
# that of the paper behind this course, *Implicit LiDAR Network* (Kwon, Sung, Yoon, ICRA 2022). The paper's network
# weighs the ranges of the four pixels. Ours continues the surface that each of them lies on, and weighs where these are
# met.
#
# **Predict:** what will the obvious method do to the outline of a car?

# %%
model = models.load("iln-surfaces").to(device)
network = model.upsample(sparse, truth.sensor)

bilinear = models.load("bilinear").to(device).upsample(sparse, truth.sensor)

# %% tags=["goal"]
scans = {"measured, 16 beams": sparse, "bilinear": bilinear, "iln-surfaces": network, "truth, 128 beams": truth}
figure, axes = plt.subplots(4, 1, figsize=(10, 6.4), sharex=True, layout="constrained")
for axis, (title, scan) in zip(axes, scans.items(), strict=True):
    image = scan.ranges.cpu()
    image = image.where(image > 0, torch.nan).flip(0, 1)  # these sensors count beams upwards and turn to the left
    extent = (180, -180, -15, 15)
    shown = axis.imshow(image, cmap="viridis_r", vmin=2, vmax=40, extent=extent, aspect="auto", interpolation="nearest")
    axis.set_title(title, loc="left", fontsize=10)
    axis.set(xlim=(60, -60), ylabel="elevation [°]")
axis.set_xlabel("azimuth [°]")
figure.colorbar(shown, ax=list(axes), label="range [m]", fraction=0.02, pad=0.01)
plt.show()

# %% [markdown]
# *In words: four range images, 120 degrees of each; near is yellow-green, far is dark purple, no return white. The
# measured one is made of 16 broad stripes. In the bilinear one, things have blurred outlines, green where yellow meets
# purple. In the network's, outlines are sharp though a little ragged. The truth has thin poles, leaves and the outlines
# that cars really have.*
#
# ## 3. Where it smears
#
# Colours hide what a blurred outline means in metres. We walk along one row of the dense images, just below the
# horizon, and look at the ranges themselves.

# %%
ROW = 62
azimuths = np.degrees(truth.sensor.azimuths)
window = slice(1080, 1190)
figure, axis = plt.subplots(figsize=(10, 3.2), layout="constrained")
for name, scan, style, colour in (
    ("truth", truth, "-", "black"),
    ("bilinear", bilinear, "^--", "#999999"),
    ("network", network, "o:", "#009e73"),
):
    line = scan.ranges[ROW, window].cpu()
    axis.plot(azimuths[window], line.where(line > 0, torch.nan), style, color=colour, markersize=3, label=name)
axis.set(xlabel="azimuth [°]", ylabel="range [m]", title=f"row {ROW}")
axis.invert_xaxis()
axis.legend(frameon=False)
plt.show()

# %% [markdown]
# *In words: range over azimuth. The truth (black) runs along a wall at 30 m, then a car before it at 23 m, then a trunk
# at 13 m. Along the car the bilinear line (grey triangles) keeps three metres behind it, in the air between car and
# wall, and nine metres behind what is right of the trunk. The network's dots lie on both, though they jump to the car a
# little too late.*
#
# A range half way between a car and the wall behind it is a point in empty air: a *flying point*. A robot brakes for
# it. Here are the points from above and behind, those that fly in orange-red (in a running notebook: turn it with the
# mouse). Between the leaves of a hedge even true points count as flying now and then.

# %%
plotter = pyvista.Plotter(off_screen=True, shape=(1, 3), window_size=(1080, 420), border=False)
for number, (name, scan) in enumerate((("bilinear", bilinear), ("network", network), ("truth", truth))):
    plotter.subplot(0, number)
    plotter.add_text(name, font_size=10, color="black", position="upper_edge")
    flies = metrics.floating(scan.ranges, truth)[scan.ranges > 0].cpu()
    points = scan.points().cpu()
    near = points.norm(dim=1) < 22
    for part, colour, size in ((near & ~flies, "#9ab6c8", 2), (near & flies, "#d55e00", 3)):
        if part.any():
            plotter.add_mesh(pyvista.PolyData(points[part].numpy()), color=colour, point_size=size)
    plotter.camera_position = [(-24, -14, 16), (3, 0, -1), (0, 0, 1)]
show_scene(plotter)

# %% [markdown]
# *In words: three point clouds of the same street: left bilinear, middle the network, right the truth. In the bilinear
# one, veils of flying points spread from the car, the posts and the trees to what is behind them, row by row. The
# network leaves fewer than half as many, scattered. In the truth there are next to none.*
#
# ## 4. In numbers
#
# Three figures tell it. **MAE** is the mean absolute error over all pixels, where no return counts as 100 m: a pixel
# that has a return and should not, or the other way round, costs tens of metres. **IoU** is the number of 10 cm cubes
# that hold points of both clouds, divided by the number of those that hold points of either: 1 is perfect. **Floating**
# is the share of points in empty space between two surfaces. (A model's `upsample` returns a `Scan`; its method
# `ranges` returns the plain numbers, in which no return is still close to 100 m and not yet 0.)

# %%
found = {}
for name in ("bilinear", "iln-surfaces"):
    judge = metrics.ScanMetrics().to(device)
    judge.update(models.load(name).to(device).ranges(sparse, truth.sensor), truth)
    found[name] = {key: value.item() for key, value in judge.compute().items()}
    mae, iou, floating = (found[name][key] for key in ("mae", "iou", "floating"))
    print(f"{name:>12}: MAE {mae:.2f} m, IoU {iou:.3f}, floating {floating:.1%}")

# The next cell relies on these.
assert found["iln-surfaces"]["mae"] < found["bilinear"]["mae"]
assert found["iln-surfaces"]["iou"] > 1.1 * found["bilinear"]["iou"]
assert found["iln-surfaces"]["floating"] < 0.6 * found["bilinear"]["floating"]

# %% [markdown]
# The network wins in all three. And yet, like bilinear interpolation, it only uses the four measured neighbours and the
# pixels beside them: no range is made up. What it learned is **how much to trust each of them.** That is the idea of
# the paper: a network that predicts *weights*, where others predict *values*.
#
# ### Exercise 1 · A size of your own
#
# ★☆☆ · 5 minutes
#
# The network was not trained for 128 × 2048 in particular. Write `upsample_to(scan, rows, columns)`, which returns a
# `Scan` of that size with the `model` of section 2. Any sensor has a method `resize(rows, columns)`: the same field of
# view with other numbers of beams and columns.
#
# <details><summary>Hint</summary>
#
# In section 2 the sensor to predict was `truth.sensor`. Here it is the scan's own, resized.
# </details>


# %% tags=["exercise"]
def upsample_to(scan, rows, columns):
    raise NotImplementedError


# %% tags=["solution"]
def upsample_to(scan, rows, columns):
    return model.upsample(scan, scan.sensor.resize(rows, columns))


# %% tags=["check"]
@check
def _():
    odd = upsample_to(sparse, 40, 600)
    assert hasattr(odd, "sensor"), f"a Scan is wanted, with its sensor; you return a {type(odd).__name__}"
    assert tuple(odd.ranges.shape) == (40, 600), (
        f"40 rows and 600 columns were asked for, not {tuple(odd.ranges.shape)}"
    )
    assert np.allclose(odd.sensor.elevations[[0, -1]], sparse.sensor.elevations[[0, -1]]), "the field of view changed"
    same = upsample_to(sparse, 16, 1024)
    off = (same.ranges - sparse.ranges)[sparse.ranges > 0].abs().median()
    assert off < 0.05, f"at its own size a scan should come back nearly as it is; the median error is {off:.2f} m"


# %% tags=["wrong"]
def upsample_to(scan, rows, columns):
    return model.upsample(scan, preset("paper-128x2048"))


# %% tags=["wrong"]
def upsample_to(scan, rows, columns):
    return model.upsample(scan, scan.sensor.resize(columns, rows))


# %% tags=["wrong"]
def upsample_to(scan, rows, columns):
    return model.upsample(scan, scan.sensor.resize(rows, columns)).ranges


# %% [markdown]
# ### Exercise 2 · Good points
#
# ★☆☆ · 5 minutes
#
# Write `share_within(predicted, true, metres)`: of the pixels at which the truth has a return (range above 0), the
# share whose predicted range is off by at most so many metres: a Python float from 0 to 1. Where the truth has no
# return at all, the share is `nan`.
#
# <details><summary>Hint</summary>
#
# `seen = true > 0` picks the pixels. The mean of `True` and `False` as numbers, `.float().mean().item()`, is a share;
# the mean of nothing is `nan`.
# </details>


# %% tags=["exercise"]
def share_within(predicted, true, metres):
    raise NotImplementedError


# %% tags=["solution"]
def share_within(predicted, true, metres):
    seen = true > 0
    return ((predicted - true)[seen].abs() <= metres).float().mean().item()


# %% tags=["check"]
@check
def _():
    true = torch.tensor([[0.0, 10.0], [20.0, 30.0]])
    predicted = torch.tensor([[50.0, 10.2], [19.0, 30.0]])
    share = share_within(predicted, true, 0.5)
    assert abs(share - 0.5) > 1e-6, "half of all four pixels are close, but one of the four has no return in the truth"
    assert abs(share - 2 / 3) < 1e-6, f"two of the three pixels with a return are within 0.5 m; you have {share:.3f}"
    assert abs(share_within(predicted, true, 1.0) - 1) < 1e-6, "an error of exactly 1 m is within 1 m"
    assert math.isnan(float(share_within(predicted, torch.zeros(2, 2), 0.5))), "no return at all: nan is wanted"
    good = {name: share_within(scan.ranges, truth.ranges, 0.1) for name, scan in (("b", bilinear), ("n", network))}
    assert good["n"] > good["b"], "the network should have more points within 10 cm than bilinear"


# %% tags=["wrong"]
def share_within(predicted, true, metres):
    return ((predicted - true).abs() <= metres).float().mean().item()


# %% tags=["wrong"]
def share_within(predicted, true, metres):
    seen = true > 0
    return ((predicted - true)[seen] <= metres).float().mean().item()


# %% tags=["wrong"]
def share_within(predicted, true, metres):
    seen = true > 0
    return (((predicted - true).abs() <= metres) & seen).float().sum().item() / max(int(seen.sum()), 1)


# %% [markdown]
# ### Exercise 3 · Catch a flying point
#
# ★☆☆ · 5 minutes
#
# A prediction flies if it lies *between* two surfaces and more than `gap` metres from either. Write
# `flying(predicted, one, other, gap)`: a mask (N,) that tells which of the ranges `predicted` (N,) do, where `one` and
# `other` (N,) are the true ranges of the two surfaces, in any order. (The metric does the same with all surfaces that
# the 5 × 5 true pixels around hold, and a gap of 0.3 m.)
#
# <details><summary>Hint</summary>
#
# `torch.minimum` and `torch.maximum` bring the two surfaces in order.
# </details>


# %% tags=["exercise"]
def flying(predicted, one, other, gap):
    raise NotImplementedError


# %% tags=["solution"]
def flying(predicted, one, other, gap):
    low, high = torch.minimum(one, other), torch.maximum(one, other)
    return (predicted > low + gap) & (predicted < high - gap)


# %% tags=["check"]
@check
def _():
    predicted = torch.tensor([10.0, 20.0, 30.0, 20.0, 35.0])
    one, other = torch.tensor([10.0, 10, 10, 30, 10]), torch.tensor([30.0, 30, 30, 10, 30])
    found = flying(predicted, one, other, 1.0)
    assert found.dtype == torch.bool, f"a mask of True and False is wanted, not {found.dtype}"
    assert not found[0], "a point on the near surface does not fly"
    assert not found[2], "a point on the far surface does not fly"
    assert found[1], "20 m between surfaces at 10 m and 30 m flies"
    assert found[3], "the surfaces may come in any order: 20 m between 30 m and 10 m flies too"
    assert not found[4], "a point behind both surfaces is wrong, but it does not float between them"
    close = flying(torch.tensor([10.5]), torch.tensor([10.0]), torch.tensor([11.0]), 1.0)
    assert not close, "between surfaces closer than the gap nothing flies"


# %% tags=["wrong"]
def flying(predicted, one, other, gap):
    return (predicted > one + gap) & (predicted < other - gap)


# %% tags=["wrong"]
def flying(predicted, one, other, gap):
    return ((predicted - one).abs() > gap) & ((predicted - other).abs() > gap)


# %% [markdown]
# ## 5. A map of the course
#
# | notebook | you build | you find out |
# |---|---|---|
# | [01 · What a LiDAR measures](01_what_a_lidar_measures.ipynb) | range images and points, by hand | what an image of ranges hides at its seam |
# | [02 · Casting rays](02_casting_rays.ipynb) | your first Warp kernels | how a town becomes a scan |
# | [03 · Between the pixels](03_between_the_pixels.ipynb) | the blend of four neighbours | why fixed weights are right on planes and wrong at edges |
# | [04 · Values](04_values.ipynb) | LIIF, a network that predicts ranges | what predicting values does to edges and walls |
# | [05 · Weights](05_weights.ipynb) | ILN, a network that predicts weights | the same training, and how much further it gets |
# | [06a · Gradients in Warp](06a_gradients_in_warp.ipynb) | kernels that Warp differentiates | when its gradients are wrong |
# | [06b · A fused op](06b_a_fused_op.ipynb) | a kernel and its backward by hand, as a PyTorch op | where time goes: memory |
# | [07 · Attention](07_attention.ipynb) | attention among four neighbours | how to project 64 times less often for the same result |
# | [08 · The comparison](08_the_comparison.ipynb) | the paper's table | what to believe of it |
# | [09 · Your own sensor](09_your_own_sensor.ipynb) | your sensor, your file | what breaks, and where to go next |
#
# ## Summary
#
# 1. A network makes 16 beams into 128, or any other number, and never leaves the span of the measured neighbours.
# 2. Bilinear interpolation puts points into empty air wherever two surfaces meet in the image.
# 3. The network weighs the same four neighbours better. How, is what follows.
#
# ## Next
#
# [01 · What a LiDAR measures](01_what_a_lidar_measures.ipynb) starts from a single beam.
