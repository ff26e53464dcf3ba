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
# # 08 · The comparison
#
# ![Two scatter plots of MAE against IoU, with the methods as filled markers and some of them, as the paper has them, as
# hollow ones](pictures/08_the_comparison.png)
#
# **Goal.** You compare all methods of this course, from the shipped weights and from a training of your own, and find
# out which of the differences you may believe.
#
# **After this notebook you can**
#
# - compute the mean absolute error and the voxel IoU of a prediction by hand, and say what each of them does not see;
# - compare methods scan by scan, and tell a difference from noise with a handful of scans;
# - read a convergence curve, and measure a method outside of what it was trained on;
# - name what a table of results does not tell you.
#
# | | |
# |---|---|
# | You know | [03 · Between the pixels](03_between_the_pixels.ipynb), [04 · Values](04_values.ipynb), [05 · Weights](05_weights.ipynb), what attention is in `iln` ([07](07_attention.ipynb)) |
# | Time | 45 minutes, and 30 for the exercises; two to four minutes to run |
# | Hardware | any computer; a CUDA GPU is used if there is one |

# %%
import csv
import math
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pyvista
import torch

import ilnet
from ilnet import data, metrics, models, places, simulate, towns
from ilnet.commands.experiment import PAPER
from ilnet.course import check, show_scene
from ilnet.sensor import PAPER_INPUT as INPUT
from kernels import Mesh

FAST = True  # False: ten times the steps, and more scans
OWN = None  # weights of your own, such as "runs/iln.safetensors", which `python -m ilnet train` wrote

pyvista.vtk_verbosity("off")
device = "cuda" if torch.cuda.is_available() else "cpu"
RULES, NETWORKS = ("nearest", "bilinear", "bilinear-inverse", "planes"), ("liif", "iln", "iln-surfaces")
COLOURS = {"nearest": "#cc79a7", "bilinear": "#999999", "bilinear-inverse": "#e69f00", "planes": "#56b4e9"}
COLOURS |= {"liif": "#d55e00", "iln": "#0072b2", "iln-surfaces": "#009e73", "own": "black"}
MARKERS = dict(zip(COLOURS, "Pov^sDXp", strict=True))

# %% [markdown]
# ## 1. Two questions, two measures
#
# A prediction $\hat r$ and the truth $r$ are range images of the same sensor. Two measures are usual.
#
# **MAE** asks *how many metres is a pixel off?* It is the mean of $|\hat r - r|$ over **all** $N$ pixels. A pixel
# without a return counts as `norm_range`, here 100 m: whoever predicts a wall at 20 m where there is sky is 80 m off.
#
# **Voxel IoU** asks *is the scene where it should be?* Both range images become points, space is cut into cubes of 0.1
# m, and $P$ and $T$ are the sets of the cubes that hold a predicted point and a true point. No return gives no point.
# `metrics.compare(ranges, truth)` computes both:
#
# | equation | line of code | argument |
# |---|---|---|
# | $\frac1N\sum_i \lvert\hat r_i - r_i\rvert$ | `(ranges - truth.filled()).abs().mean()` | `ranges`, `truth` |
# | $\mathbf p_i = r_i \mathbf d_i$, `min_range` $\le r_i \le$ `max_range` | `directions[within] * ranges[within, None]` | `truth.sensor` |
# | $T = \{\lfloor \mathbf p_i / 0.1 \rfloor\}$, a set | `torch.unique((points / 0.1).floor(), dim=0)` | |
# | $\text{IoU} = \lvert P\cap T\rvert \,/\, \lvert P\cup T\rvert$ | `common / (len(P) + len(T) - common)` | |
#
# Here are a few points from above: six true points of a wall and a bush, and six predicted ones.

# %%
true_points = torch.tensor([[5.02, 0.05], [5.02, 0.15], [5.03, 0.25], [5.03, 0.28], [5.24, 0.37], [5.36, 0.33]])
guess = torch.tensor([[5.04, 0.04], [5.07, 0.16], [4.98, 0.24], [5.05, 0.27], [5.15, 0.36], [5.37, 0.38]])


def draw_cells(axes, squares=()):
    for some, colour, hatch in squares:
        for x, y in some:
            square = plt.Rectangle((x / 10, y / 10), 0.1, 0.1, fc=colour, alpha=0.35, hatch=hatch, ec="#777777")
            axes.add_patch(square)
    axes.plot(*true_points.T, "o", color="black", label="true")
    axes.plot(*guess.T, "x", color="#d55e00", label="predicted", markersize=8, markeredgewidth=2)
    axes.set(xlim=(4.85, 5.6), ylim=(-0.05, 0.45), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axes.set_xticks(np.arange(4.9, 5.6, 0.1))
    axes.set_yticks(np.arange(0, 0.5, 0.1))
    axes.legend(loc="lower right", fontsize=8)


axes = plt.figure(figsize=(5, 3), layout="constrained").subplots()
draw_cells(axes)
axes.grid()
plt.show()

# %% [markdown]
# *In words: a grid of squares of 0.1 m, six dots and six crosses, mostly close to one another, some in the same square
# and some not.*
#
# **Predict:** what is the IoU? (Count squares, not points.) And a wall that stands 5 cm behind the front of its voxels
# is predicted with the same error $e$ everywhere: how large may $e$ be, before the IoU of the wall falls to 0?


# %%
def cells(points):
    return {tuple(cell) for cell in (points / 0.1).floor().int().tolist()}


T, P = cells(true_points), cells(guess)
iou_by_hand = len(P & T) / len(P | T)
print(
    f"{len(T)} true voxels, {len(P)} predicted, {len(P & T)} common: IoU {len(P & T)}/{len(P | T)} = {iou_by_hand:.2f}"
)
flat = [torch.nn.functional.pad(points, (0, 1)) for points in (true_points, guess)]  # z = 0
assert [len(metrics.voxels(points)) for points in flat] == [len(T), len(P)] == [5, 6]


def wall(at, error):
    """IoU of a wall of 1 m x 1 m across the view at x = `at`, predicted `error` too far."""
    y, z = torch.meshgrid(torch.linspace(0, 1, 60), torch.linspace(0, 1, 60), indexing="ij")
    one, other = (metrics.voxels(torch.stack((torch.full_like(y, x), y, z), -1).view(-1, 3)) for x in (at, at + error))
    common = torch.isin(one, other).sum().item()
    return common / (len(one) + len(other) - common)


figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.4), layout="constrained")
draw_cells(left, ((P & T, "#009e73", ""), (P - T, "#d55e00", "//"), (T - P, "#56b4e9", "..")))
left.set_title("voxels from above", loc="left", fontsize=10)
errors = np.linspace(0, 0.12, 49)
for at, style, colour in ((5.005, "-", "#0072b2"), (5.05, "--", "#d55e00"), (5.095, ":", "black")):
    label = f"{100 * (at - 5):.1f} cm into its voxel"
    right.plot(100 * errors, [wall(at, e) for e in errors], style, color=colour, label=label, lw=2)
right.set(xlabel="error e of the whole wall [cm]", ylabel="IoU")
right.set_title("one wall, at three places", loc="left", fontsize=10)
right.legend(fontsize=8)
plt.show()
assert wall(5.005, 0.09) == 1
assert wall(5.095, 0.01) == 0

# %% [markdown]
# *In words: left, squares of 0.1 m with points in them. Four squares hold a true and a predicted point, two only a
# predicted one, one only a true one. Right, three step functions: each falls from 1 to 0 at once, for the wall at the
# front of its voxel after 9.5 cm, for the one in the middle after 5 cm, for the one at the back after half a
# centimetre.*
#
# Four of seven squares: 0.57, and the two true points in one square count once. The wall on the right shows a weakness:
# a voxel has boundaries, and whether an error of 1 cm costs nothing or everything depends on where the wall happens to
# stand. Over a whole scan, with walls and ground at all places, this evens out: an error of $e < 10$ cm across a
# surface that lies along the voxels moves about the share $e / 10\,\text{cm}$ of its points into another voxel.

# %% [markdown]
# ### Exercise 1 · Voxel IoU by hand
#
# importance ★★☆ · difficulty ★☆☆ · 7 minutes
#
# Write `voxel_iou(predicted, true, low, high)`: the IoU of two point clouds, tensors of shapes (N, 3) and (M, 3) in the
# frame of the sensor, in voxels of 0.1 m. Points whose range (distance from the origin) is below `low` or above `high`
# are left out of both. Several points in a voxel count once. Where neither cloud has a point left, the IoU is 0, as in
# `metrics.compare`. Return a float.
#
# <details><summary>Hint</summary>
#
# `points.norm(dim=1)` are the ranges. A Python `set` of tuples does the rest, with `&` and `|`.
#
# </details>
# <details><summary>Hint on negative coordinates</summary>
#
# `(points / 0.1).int()` rounds towards zero: the voxels on both sides of 0 become one. `floor` does not.
#
# </details>


# %% tags=["exercise"]
def voxel_iou(predicted, true, low, high):
    raise NotImplementedError


# %% tags=["solution"]
def voxel_iou(predicted, true, low, high):
    def occupied(points):
        ranges = points.norm(dim=1)
        within = points[(ranges >= low) & (ranges <= high)]
        return {tuple(cell) for cell in (within / 0.1).floor().int().tolist()}

    one, other = occupied(predicted), occupied(true)
    return len(one & other) / max(len(one | other), 1)


# %% tags=["check"]
@check
def _():
    a = torch.tensor([[5.05, 0.05, 0.05], [5.15, 0.05, 0.05], [5.25, 0.05, 0.05]])
    value = voxel_iou(a, a, 2, 80)
    assert isinstance(value, float), f"return a float, not {type(value).__name__}: call .item() on a tensor"
    assert value == 1.0, f"a cloud against itself has IoU 1, not {value} (a set tells tensors apart: use .tolist())"
    value = voxel_iou(a[:2], a[1:], 2, 80)
    assert abs(value - 1 / 3) < 1e-6, f"1 voxel of 3 is common: 0.333, not {value:.3f}; the union counts it once"
    value = voxel_iou(torch.cat((a[:1], a[:1] + 0.01)), a[:1], 2, 80)
    assert value == 1.0, f"two points in one voxel count once: IoU 1, not {value:.3f}"
    b = torch.tensor([[5.05, -0.05, 0.05]])
    value = voxel_iou(b, b + torch.tensor([0, 0.1, 0]), 2, 80)
    assert value == 0.0, f"y = -0.05 and y = 0.05 lie in two voxels: IoU 0, not {value:.3f}; floor, do not truncate"
    far = torch.tensor([[99.95, 0.0, 0.0], [0.55, 0.05, 0.05]])
    value = voxel_iou(torch.cat((a, far)), a, 2, 80)
    assert value == 1.0, f"points at 100 m and at 0.6 m are outside 2 to 80 m and left out: IoU 1, not {value:.3f}"
    slanted = torch.tensor([[60.05, 60.05, 0.05]])
    value = voxel_iou(torch.cat((a, slanted)), a, 2, 80)
    assert value == 1.0, "the limits hold for the range, the distance from the origin, and not for each coordinate"
    try:
        value = voxel_iou(far[:1], a[:0], 2, 80)
    except ZeroDivisionError:
        value = math.nan
    assert value == 0.0, f"no point is left in either cloud: IoU 0 by agreement, not {value}"


# %% tags=["wrong"]
def voxel_iou(predicted, true, low, high):  # truncates
    def occupied(points):
        ranges = points.norm(dim=1)
        return {tuple(c) for c in (points[(ranges >= low) & (ranges <= high)] / 0.1).int().tolist()}

    one, other = occupied(predicted), occupied(true)
    return len(one & other) / max(len(one | other), 1)


# %% tags=["wrong"]
def voxel_iou(predicted, true, low, high):  # keeps what is out of range
    one, other = ({tuple(c) for c in (p / 0.1).floor().int().tolist()} for p in (predicted, true))
    return len(one & other) / max(len(one | other), 1)


# %% tags=["wrong"]
def voxel_iou(predicted, true, low, high):  # counts points, not voxels
    def occupied(points):
        ranges = points.norm(dim=1)
        return [tuple(c) for c in (points[(ranges >= low) & (ranges <= high)] / 0.1).floor().int().tolist()]

    one, other = occupied(predicted), occupied(true)
    common = sum(cell in other for cell in one)
    return common / max(len(one) + len(other) - common, 1)


# %% tags=["wrong"]
def voxel_iou(predicted, true, low, high):  # divides by zero
    def occupied(points):
        ranges = points.norm(dim=1)
        return {tuple(c) for c in (points[(ranges >= low) & (ranges <= high)] / 0.1).floor().int().tolist()}

    one, other = occupied(predicted), occupied(true)
    return len(one & other) / len(one | other)


# %% [markdown]
# ## 2. Why they disagree
#
# Now real predictions. The test towns are `town07` (a village) and `town10` (an old centre). No network was trained in
# them and nothing was chosen by what it did in them. `places.held_out_scans` takes the same evenly spread waypoints with
# each of several sensors: the input of 16×1024 rays and the truths of 64×1024 and 128×2048.

# %%
SCANS = 4 if FAST else 10  # from each town
FINE, FINEST = INPUT.resize(64, 1024), INPUT.resize(128, 2048)
streets = {name: places.town(name, device=device) for name in towns.TEST}
scans = [
    triple for street in streets.values() for triple in places.held_out_scans(street, SCANS, [INPUT, FINE, FINEST])
]
pairs = {"64x1024": [(sparse, fine) for sparse, fine, _ in scans]}
pairs["128x2048"] = [(sparse, finest) for sparse, _, finest in (scans[1::SCANS] if FAST else scans)]
print({size: f"{len(some)} scans" for size, some in pairs.items()})
loaded = {name: models.load(name).to(device) for name in RULES + NETWORKS}

# %% [markdown]
# We take one scan and three answers that are wrong in different ways:
#
# - `planes`: a rule that lays planes through the pixels around a query and answers with the one that the query lies on;
#   at a jump it takes one side instead of a mixture (`kernels.interpolate_planes`). Nothing in it is learned;
# - *noisy truth*: the truth with an error of 5 cm (standard deviation) in every pixel;
# - *mended planes*: the truth, except for the worst 5 % of the pixels of `planes`, which stay as bad as they are.
#
# **Predict:** order the three by MAE, and by IoU.

# %%
sparse, truth = pairs["64x1024"][0]
planes = loaded["planes"].ranges(sparse, truth.sensor).clamp(0, truth.sensor.norm_range)
target = truth.filled()
error = (planes - target).abs()
worst = error >= error.flatten().quantile(0.95)

noise = torch.randn(target.shape, generator=torch.Generator().manual_seed(0)).to(device)
answers = {"planes": planes, "noisy truth": target + 0.05 * noise, "mended planes": planes.where(worst, target)}
judged = {name: metrics.compare(answer, truth) for name, answer in answers.items()}
for name, found in judged.items():
    print(f"{name:>14}: MAE {found['mae']:.3f} m, IoU {found['iou']:.3f}")
assert judged["noisy truth"]["mae"] < 0.05 * judged["planes"]["mae"]
assert judged["noisy truth"]["iou"] < judged["planes"]["iou"]
assert judged["mended planes"]["mae"] > 0.75 * judged["planes"]["mae"]
assert judged["mended planes"]["iou"] > 0.85

# %% [markdown]
# By MAE the noisy truth is nearly perfect, by IoU it is worse than a rule without a network. The mended answer is
# nearly perfect by IoU, and by MAE hardly better than what it mends. Each measure is nearly blind to what the other one
# sees. The next cell says where the metres of the MAE lie.

# %%
figure, (left, right) = plt.subplots(
    1, 2, figsize=(11, 3.4), layout="constrained", gridspec_kw={"width_ratios": [1.6, 1]}
)
part = slice(384, 640)  # 90 degrees ahead
azimuths, elevations = (np.rad2deg(table) for table in (truth.sensor.azimuths, truth.sensor.elevations))
extent = (azimuths[part][-1], azimuths[part][0], elevations[0], elevations[-1])
shown = left.imshow(
    error.cpu().clamp(min=0.01)[:, part].flip(1), norm="log", vmin=0.01, vmax=100, cmap="cividis", extent=extent,
    aspect="auto", origin="lower", interpolation="nearest",
)  # fmt: skip
left.set(xlabel="azimuth [°]", ylabel="elevation [°]")
left.set_title("error of planes", loc="left", fontsize=10)
figure.colorbar(shown, ax=left, label="error [m]")
share = {}
for name, style in (("bilinear", "-."), ("planes", "--"), ("iln", "-")):
    off = (loaded[name].ranges(sparse, truth.sensor) - target).abs().flatten().sort(descending=True).values.cpu()
    cumulated = off.cumsum(0) / off.sum()
    share[name] = cumulated[len(off) // 20].item()
    pixels = np.linspace(0, 100, len(off))
    right.plot(pixels[::50], cumulated[::50], style, color=COLOURS[name], label=name, lw=2)
right.axvline(5, color="black", lw=0.8)
right.set(xlim=(0, 40), xlabel="worst pixels, share of all [%]", ylabel="share of the MAE")
right.legend(fontsize=9)
plt.show()
print("share of the MAE that comes from the worst 5 % of the pixels:", {k: round(v, 2) for k, v in share.items()})
median = error.median().item()
print(f"planes: mean error {error.mean():.2f} m, median error {100 * median:.1f} cm")
edges = metrics.edges(truth)
at_edges = (error[edges].sum() / error.sum()).item()
print(f"planes: {at_edges:.0%} of the MAE comes from the {edges.float().mean():.0%} of the pixels near a range edge")
assert min(share.values()) > 0.7
assert median < 0.05
assert at_edges > 0.8

# %% [markdown]
# *In words: left, 90 degrees of a range image of errors on a logarithmic scale. The near road, the sky and house fronts
# are dark, at a centimetre or less; outlines of roofs and trees, and a band just below the horizon where near things
# end and far ones begin, are bright, at metres to tens of metres. Right, three curves rise steeply and bend: with 5 %
# of the pixels, a thin vertical line, all of them are above 0.7.*
#
# So **the MAE is ruled by a few pixels at far edges**, where one side of a roof line is sky and a mistake costs 80 m.
# **The IoU is ruled by flat surfaces**, which hold most of the points, and where centimetres decide. A network trained
# with an L1 loss in metres gives what the loss pays for.
#
# Two more measures of `metrics.compare` look at edges alone. A pixel is near an *edge* if among the 5 × 5 true pixels
# around it there are two neighbours that part by more than 0.6 m and do not lie on one surface. `edge_mae` is the MAE
# over these. `floating` is the share of the predicted points that lie between two surfaces of these 5 × 5 pixels and
# more than 0.3 m from any. Look at them as points: a driver would brake for those.

# %%
plotter = pyvista.Plotter(shape=(1, 2), off_screen=True, window_size=(1000, 420), border=False)
floats = {}
for number, name in enumerate(("bilinear", "iln")):
    answer = loaded[name].ranges(sparse, truth.sensor)
    hanging = metrics.floating(answer, truth)
    seen = (answer >= 2) & (answer < 45)
    floats[name] = (hanging[answer <= 80].float().mean()).item()
    directions = truth.sensor.directions().to(device)
    plotter.subplot(0, number)
    for mask, colour, size in ((seen & ~hanging, "#8899aa", 2), (seen & hanging, "#d55e00", 4)):
        plotter.add_mesh((directions[mask] * answer[mask, None]).cpu().numpy(), color=colour, point_size=size)
    plotter.add_text(f"{name}: {floats[name]:.1%} floating", font_size=10, color="black", position="upper_edge")
    plotter.camera_position = [(-28, -22, 24), (6, 2, -1), (0, 0, 1)]
assert floats["iln"] < 0.6 * floats["bilinear"]
show_scene(plotter)

# %% [markdown]
# *In words: the same street twice as a cloud of grey points seen from above and behind, with the floating points in
# orange. On the left, bilinear, orange veils hang between the outlines of things and what is behind them. On the right,
# iln, far fewer are left, as single points.*

# %% [markdown]
# ## 3. The table
#
# All methods, on the same scans. (`bilinear-inverse` is the *perspective* blend of notebook 03.) `python -m ilnet
# evaluate` and `ilnet.learning.evaluate.measure` do the same and return the means; we keep the figures of every scan, since we
# want to look at their spread. A `models.Upsampler` prepares once what all scans have in common.
#
# If you have trained weights of your own, name their file in `OWN` at the top, and they stand in the table. A minute or
# two of training is `python -m ilnet train iln --preset tiny --out runs`.

# %%
if OWN:
    loaded["own"] = models.load(OWN).to(device)


def spread_of(values):
    return f"± {values.std(ddof=1):4.2f}" if len(values) > 2 else " " * 6


def judge(model, some):
    """Figures of a model, each an array with one entry for each scan."""
    frames = models.Upsampler(model, some[0][0].sensor, some[0][1].sensor, device=device)
    found = [metrics.compare(frames.ranges(sparse), truth) for sparse, truth in some]
    return {key: np.array([one[key] for one in found]) for key in found[0]}


table = {"64x1024": {name: judge(model, pairs["64x1024"]) for name, model in loaded.items()}}

# %%
table["128x2048"] = {name: judge(model, pairs["128x2048"]) for name, model in loaded.items()}

# %%
for size, found in table.items():
    count = len(pairs[size])
    print(f"{size}, {count} scans: mean ± spread over the scans{'the paper':>38}")
    print(f"{'':>17} {'MAE [m]':>13} {'IoU':>15} {'floating':>9} {'at edges [m]':>13} {'MAE':>8} {'IoU':>6}")
    for name, f in found.items():
        theirs = PAPER[size].get(name)
        paper = f"{theirs[0]:8.2f} {theirs[1]:6.3f}" if theirs else ""
        print(
            f"{name:>17} {f['mae'].mean():6.2f} {spread_of(f['mae'])} {f['iou'].mean():8.3f} "
            f"{spread_of(f['iou'])} {f['floating'].mean():9.3f} {f['edge_mae'].mean():13.2f} {paper}"
        )
    print()
mean = {size: {n: {k: v.mean() for k, v in f.items()} for n, f in found.items()} for size, found in table.items()}
for found in mean.values():
    assert found["planes"]["iou"] > max(found[n]["iou"] for n in ("liif", "iln"))
    assert max(found[n]["mae"] for n in NETWORKS) < min(found[n]["mae"] for n in RULES)
    assert found["iln-surfaces"]["iou"] > found["iln"]["iou"] > found["liif"]["iou"]
    assert found["liif"]["iou"] < found["bilinear"]["iou"]
assert mean["64x1024"]["iln-surfaces"]["iou"] > mean["64x1024"]["planes"]["iou"]
for theirs in PAPER.values():
    assert theirs["iln"][1] > theirs["liif"][1]
assert PAPER["64x1024"]["liif"][1] > PAPER["64x1024"]["bilinear"][1]

# %% tags=["goal"]
figure, panels = plt.subplots(1, 2, figsize=(11, 4), layout="constrained", sharey=True)
for axes, (size, found) in zip(panels, mean.items(), strict=True):
    for name, f in found.items():
        axes.plot(f["mae"], f["iou"], MARKERS[name], color=COLOURS[name], markersize=11, label=name, linestyle="")
    for name, (mae, iou, *_) in PAPER[size].items():
        if name in found:
            axes.plot(mae, iou, MARKERS[name], mfc="none", mec=COLOURS[name], markersize=11, markeredgewidth=1.5)
    axes.set(xlabel="MAE [m], smaller is better")
    axes.set_title(f"16x1024 to {size}", loc="left")
    axes.grid(alpha=0.3)
    axes.annotate(
        "better", (0.86, 0.16), (0.95, 0.04), xycoords="axes fraction", arrowprops={"arrowstyle": "->"}, ha="right"
    )
panels[0].set_ylabel("IoU, larger is better")
panels[1].legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False, title="filled: here\nhollow: the paper")
plt.show()

# %% [markdown]
# *In words: two scatter plots of MAE against IoU, one for each size. Filled markers: the networks liif, iln and
# iln-surfaces lie to the left, at the smallest errors; liif the lowest of the three, with an IoU below 0.3. The rules
# lie to the right, planes, a triangle, far above the others. At 64x1024 iln-surfaces is the highest of all. Hollow
# markers are the paper's bilinear, liif and iln: all lower, iln above liif as here, but liif above bilinear.*
#
# Three things to read from it:
#
# - **Networks win the MAE, a rule keeps up in IoU.** `planes`, without a single learned number, is ahead of `iln` in
#   IoU: the towns are made of planes, and section 2 says what the IoU is made of. `iln`, after 6000 steps, is level with
#   `bilinear-inverse`, a formula of notebook 03. `iln-surfaces`, our own, continues the surface of each neighbour as a
#   plane and learns which of these surfaces to trust: at 64x1024 it is ahead of `planes` as well.
# - **Weights are ahead of values.** In metres `iln` and `liif` are a few percent apart. In IoU the one that predicts
#   values is below bilinear: it has to *produce* every range, and centimetres are hard to produce. Where neighbours
#   agree, a blend of measured ranges is right whatever the weights.
# - **The paper agrees in part.** There, too, `iln` is ahead of `liif` in IoU at a similar MAE. But its LIIF is ahead of
#   bilinear in IoU and ours is not: it was trained two hundred times as long, and in its towns (CARLA) bilinear does
#   worse than in ours. Compare methods within a table, never numbers across tables.

# %% [markdown]
# ## 4. How far do you trust the order?
#
# The spread behind `±` is large: ±0.1 in IoU, about as much as `iln` and `iln-surfaces` are apart. With eight scans
# the standard error of a mean is its spread over $\sqrt 8$. Is `iln-surfaces` better than `iln`, then?
#
# **Predict:** the next figure shows the same numbers twice. On the left each method's mean with its standard error.
# Beside it the *differences to `iln` on the same scan*, mean and standard error of those. Which bars are shorter, and
# why?

# %%
found = table["64x1024"]
others = [name for name in found if name not in ("iln", "nearest")]
figure, panels = plt.subplots(1, 3, figsize=(12, 3.4), layout="constrained")
for number, name in enumerate(found):
    values = found[name]["iou"]
    standard_error = values.std(ddof=1) / math.sqrt(len(values))
    panels[0].errorbar(number, values.mean(), standard_error, fmt=MARKERS[name], color=COLOURS[name], capsize=4)
panels[0].set(ylabel="IoU", title="means of 64x1024")
panels[0].set_xticks(range(len(found)), found, rotation=60, fontsize=8)
paired = {}
for axes, key, unit in ((panels[1], "iou", ""), (panels[2], "mae", " [m]")):
    for number, name in enumerate(others):
        d = found[name][key] - found["iln"][key]
        paired[name, key] = d.mean(), d.std(ddof=1) / math.sqrt(len(d))
        axes.plot(number + np.linspace(-0.25, 0.25, len(d)), d, ".", color=COLOURS[name], alpha=0.6)
        axes.errorbar(number, *paired[name, key], fmt=MARKERS[name], color=COLOURS[name], capsize=4, mec="black")
    axes.axhline(0, color="black", lw=0.8)
    axes.set(title="differences to iln, paired", ylabel=f"{key.upper() if key == 'mae' else 'IoU'} minus iln's{unit}")
    axes.set_xticks(range(len(others)), others, rotation=60, fontsize=8)
plt.show()
for key in ("iou", "mae"):
    average, standard_error = paired["iln-surfaces", key]
    print(f"iln-surfaces minus iln, {key}: {average:+.4f} ± {standard_error:.4f}")
both = [found[name]["iou"] for name in ("iln-surfaces", "iln")]
alone = math.hypot(*(v.std(ddof=1) / math.sqrt(len(v)) for v in both))
print(f"standard error of the same IoU difference, had each method seen other scans: {alone:.4f}")
assert paired["iln-surfaces", "iou"][0] > 3 * paired["iln-surfaces", "iou"][1]
assert alone > 2 * paired["iln-surfaces", "iou"][1]

# %% [markdown]
# *In words: left, means of seven methods with long error bars that mostly overlap. Middle and right, differences to iln
# on the same scans, as dots with mean and error bar. In IoU iln-surfaces and planes lie clearly above zero, liif far
# below, and the bars are short. In MAE bilinear and planes lie above zero with long bars, and iln-surfaces is closer to
# the zero line.*
#
# Scans differ more than methods: a scan of a village with trees all around is hard for everybody. On the *same* scans
# this common part cancels. So the IoU says yes, clearly. Ask the same of the MAE: by how many of its standard errors do
# the two differ there?
#
# A paired difference does not say *why*. These two networks differ in what they weigh, in their loss, and in the
# sensors and the steps of their training. Only trainings that differ in one of these tell which of them it was.
#
# And a standard error says how sure you are of the mean over **scans like these**. It does not know that each network
# was trained once: another seed gives other weights, and another difference. That spread only more trainings show.

# %% [markdown]
# ### Exercise 2 · A paired difference
#
# importance ★★☆ · difficulty ★☆☆ · 8 minutes
#
# Write `paired_difference(one, other)` for two NumPy arrays with one figure per scan, in the same order of scans.
# Return the mean of `one - other` and its standard error: the standard deviation of the differences, with $n - 1$ in
# its denominator, over $\sqrt n$. With a single scan nothing is known about the spread: return `nan` for the standard
# error then, without a warning. Arrays of different lengths are not pairs: raise a `ValueError`.
#
# <details><summary>Hint</summary>
#
# `d.std(ddof=1)`. Subtract first: the standard deviation of a difference is not the difference of standard deviations.
#
# </details>


# %% tags=["exercise"]
def paired_difference(one, other):
    raise NotImplementedError


# %% tags=["solution"]
def paired_difference(one, other):
    if len(one) != len(other):
        raise ValueError(f"{len(one)} and {len(other)} scans make no pairs")
    d = np.asarray(one) - np.asarray(other)
    standard_error = d.std(ddof=1) / math.sqrt(len(d)) if len(d) > 1 else math.nan
    return d.mean(), standard_error


# %% tags=["check"]
@check
def _():
    import warnings

    one, other = np.array([0.5, 0.7, 0.3, 0.9]), np.array([0.4, 0.5, 0.2, 0.7])
    average, standard_error = paired_difference(one, other)
    assert abs(average - 0.15) < 1e-9, f"the mean difference is 0.15, not {average:.3f}: one minus other"
    wanted = np.std([0.1, 0.2, 0.1, 0.2], ddof=1) / 2
    biased, unpaired = np.std([0.1, 0.2, 0.1, 0.2]) / 2, math.hypot(one.std(ddof=1), other.std(ddof=1)) / 2
    assert abs(standard_error - unpaired) > 1e-6, "that is the standard error for unpaired scans: subtract first"
    assert abs(standard_error - 2 * wanted) > 1e-6, "that is the spread of the differences: divide it by sqrt(n)"
    assert abs(standard_error - biased) > 1e-6, "the denominator of the standard deviation is n - 1: ddof=1"
    assert abs(standard_error - wanted) < 1e-9, f"the standard error is {wanted:.4f}, not {standard_error:.4f}"
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        average, standard_error = paired_difference(np.array([0.5]), np.array([0.4]))
    assert abs(average - 0.1) < 1e-9, f"the mean of one difference is that difference, 0.1, not {average}"
    assert math.isnan(standard_error), f"one scan says nothing of the spread: nan, not {standard_error}"
    assert not said, "with one scan NumPy warns of a division by zero: treat n = 1 before you call std"
    try:
        paired_difference(np.array([0.5, 0.6]), np.array([0.4]))
    except ValueError:
        return
    raise AssertionError("two scans against one are no pairs; NumPy would stretch the one: raise a ValueError")


# %% tags=["wrong"]
def paired_difference(one, other):  # the wrong deviation, and no answer to one scan
    d = np.asarray(one) - np.asarray(other)
    return d.mean(), d.std() / math.sqrt(len(d))


# %% tags=["wrong"]
def paired_difference(one, other):  # as if the scans were others
    one, other = np.asarray(one), np.asarray(other)
    return one.mean() - other.mean(), math.hypot(one.std(ddof=1), other.std(ddof=1)) / math.sqrt(len(one))


# %% tags=["wrong"]
def paired_difference(one, other):  # stretches one scan to many
    d = np.asarray(one) - np.asarray(other)
    return d.mean(), d.std(ddof=1) / math.sqrt(len(d)) if len(d) > 1 else math.nan


# %% tags=["wrong"]
def paired_difference(one, other):  # zero instead of unknown
    if len(one) != len(other):
        raise ValueError("no pairs")
    d = np.asarray(one) - np.asarray(other)
    return d.mean(), d.std(ddof=1) / math.sqrt(len(d)) if len(d) > 1 else 0.0


# %% [markdown]
# ## 5. Convergence
#
# A table shows the end of a training. How fast does a network get there? We train small versions of both networks on
# the very same batches, and stop a few times to measure them. The validation scans are from another draw of a
# *training* town (`seed=1`: other streets of the same kind): test towns decide nothing, not even what a curve looks
# like. To be quick, we only ask for the 90 degrees ahead in each scan, where there is more far away, and the MAE is
# larger.
#
# **Predict:** an untrained ILN blends four measured ranges with weights of its own making. An untrained LIIF produces
# ranges from nothing. Where do the two curves start?

# %%
STEPS = 100 if FAST else 1000
SECTOR = replace(FINE, azimuths=FINE.azimuths[384:640])
validation = places.held_out_scans(places.town("town01", seed=1, device=device), 3, [INPUT, SECTOR])
rays = iter(data.ContinuousRays([places.town("town01", device=device)], INPUT, 4, 64, 512, seed=0))
batches = [next(rays) for _ in range(STEPS)]


def train(name):
    """IoU and MAE on the validation scans in the course of a training: (steps, iou, mae)."""
    torch.manual_seed(0)
    model = models.create(name, blocks=2).to(device)
    optimizer = torch.optim.Adam(model.parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-3, STEPS, pct_start=0.2)
    curve = []
    for step in range(STEPS + 1):
        if step % (STEPS // 5) == 0:
            found = judge(model.eval(), validation)
            curve.append((step, found["iou"].mean(), found["mae"].mean()))
            model.train()
        if step < STEPS:
            batch = batches[step].to(device)
            loss = (model(batch.image, batch.queries, wrap=batch.wrap) - batch.ranges).abs().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return np.array(curve).T


curves = {name: train(name) for name in ("liif", "iln")}

# %% [markdown]
# Networks of full size take longer. Beside ours we draw six trainings that are committed with the package, three of
# each, with 2000 steps and three seeds. (`python -m ilnet experiment convergence` makes that file, in three hours on
# two cores.)

# %%
with open(Path(ilnet.__file__).parent / "results" / "convergence.csv") as file:
    rows = list(csv.DictReader(file))
figure, panels = plt.subplots(1, 3, figsize=(12, 3.4), layout="constrained")
baseline = judge(loaded["bilinear"], validation)
for name, (steps, iou, mae) in curves.items():
    style = {"color": COLOURS[name], "marker": MARKERS[name], "label": name}
    panels[0].plot(steps, iou, **style)
    panels[1].plot(steps, mae, **style)
for axes, key, label in ((panels[0], "iou", "IoU"), (panels[1], "mae", "MAE [m]")):
    axes.axhline(baseline[key].mean(), color=COLOURS["bilinear"], ls="--", label="bilinear")
    axes.set(xlabel="step", ylabel=label)
    axes.set_title("small networks, trained here", loc="left", fontsize=10)
panels[1].set(yscale="log")
panels[1].yaxis.set_major_formatter("{x:g}")
panels[1].yaxis.set_minor_formatter("{x:g}")
panels[0].legend()
full = {"liif": [], "iln": []}
for name, runs in full.items():
    for seed in sorted({row["seed"] for row in rows}):
        run = [row for row in rows if (row["model"], row["seed"]) == (name, seed)]
        x, y = ([float(row[key]) for row in run] for key in ("step", "iou"))
        panels[2].plot(x, y, color=COLOURS[name], marker=MARKERS[name], markersize=4, lw=1)
        runs.append(y)
panels[2].set(xlabel="step", ylabel="IoU, test towns")
panels[2].set_title("full size, three trainings each", loc="left", fontsize=10)
plt.show()
for name, runs in full.items():
    print(f"{name:>5}, full size: IoU after 2000 steps {', '.join(f'{run[-1]:.3f}' for run in runs)}")
assert min(run[1] for run in full["iln"]) > max(run[1] for run in full["liif"])
assert min(run[-1] for run in full["iln"]) > max(run[-1] for run in full["liif"])
for name, (_, iou, mae) in curves.items():
    print(f"{name:>5}: IoU {iou[0]:.3f} -> {iou[-1]:.3f}, MAE {mae[0]:5.1f} -> {mae[-1]:.2f} m")
assert curves["iln"][1][1] > max(curves["liif"][1])
assert curves["iln"][1][0] > 5 * curves["liif"][1][0]

# %% [markdown]
# *In words: IoU and MAE by step. The IoU of iln is above zero from the start and climbs; that of liif stays next to
# zero all along. In MAE, on a logarithmic axis, liif starts at tens of metres and comes down towards iln, which starts
# at a few metres. Bilinear is a dashed line. Right, six trainings of full-size networks: the three of iln climb at once
# and lie close together; the three of liif stay near zero, with single peaks, for more than a thousand steps, then
# climb, and end far below.*
#
# After a fifth of this short training ILN has an IoU that LIIF does not reach at all in it. It does not start from
# nothing: the average of four neighbours is a usable range, and it can never leave the span between the nearest and the
# farthest of them. How much of that head start is left after a long training is another question. After 2000 steps much
# of it is; the shipped networks, with 6000, have 0.505 against 0.282 in IoU (section 3, 64x1024).

# %% [markdown]
# ### Exercise 3 · Steps to reach
#
# importance ★★☆ · difficulty ★☆☆ · 4 minutes
#
# "ILN needs a tenth of the steps" is a statement about two curves. Write `steps_to_reach(steps, values, target)`: the
# first of the `steps` at which `values`, a figure where larger is better, is at least `target`. A curve may come down
# again later: the first time counts. The validations may be listed in any order. A curve that never gets there takes
# infinitely many steps: return `math.inf`.
#
# <details><summary>Hint</summary>
#
# `min(..., default=math.inf)` over the steps whose value suffices.
#
# </details>


# %% tags=["exercise"]
def steps_to_reach(steps, values, target):
    raise NotImplementedError


# %% tags=["solution"]
def steps_to_reach(steps, values, target):
    return min((step for step, value in zip(steps, values, strict=True) if value >= target), default=math.inf)


# %% tags=["check"]
@check
def _():
    steps, values = [0, 100, 200, 300, 400], [0.0, 0.2, 0.35, 0.3, 0.4]
    found = steps_to_reach(steps, values, 0.25)
    assert found == 200, f"the curve first has 0.25 or more at step 200, not {found}"
    found = steps_to_reach(steps, values, 0.32)
    assert found == 200, f"it comes down to 0.3 later, but the first time counts: 200, not {found}"
    found = steps_to_reach(steps, values, 0.2)
    assert found == 100, f"at least means that 0.2 itself is enough: 100, not {found}"
    found = steps_to_reach(steps[::-1], values[::-1], 0.25)
    assert found == 200, f"the same validations listed backwards: still 200, not {found}"
    found = steps_to_reach(np.array(steps), np.array(values), 0.5)
    assert found == math.inf, f"it never has 0.5: math.inf, not {found}"
    found = steps_to_reach([], [], 0.5)
    assert found == math.inf, f"no validation, so it was never seen there: math.inf, not {found}"


# %% tags=["wrong"]
def steps_to_reach(steps, values, target):  # 0 where it never gets there
    return np.asarray(steps)[np.argmax(np.asarray(values) >= target)] if len(steps) else math.inf


# %% tags=["wrong"]
def steps_to_reach(steps, values, target):  # the last time
    return max((s for s, v in zip(steps, values, strict=True) if v < target), default=math.inf) + 100


# %% tags=["wrong"]
def steps_to_reach(steps, values, target):  # more than
    return min((step for step, value in zip(steps, values, strict=True) if value > target), default=math.inf)


# %% tags=["wrong"]
def steps_to_reach(steps, values, target):  # trusts the order
    return next((step for step, value in zip(steps, values, strict=True) if value >= target), math.inf)


# %% [markdown]
# ## 6. In and out of distribution
#
# `liif` and `iln` were trained on one input: 16 beams over ±15°, 2° apart, in six towns. The queries of their training
# were rays at *continuous* directions between those beams. So any **output** size is in distribution: 64x1024, 128x2048
# and 50x777 are all samples of the same directions. Out of distribution are
#
# - another **spacing** of the input's beams. These networks see offsets in pixels and do not know how many degrees a
#   pixel is: 16 beams over ±7.5°, over ±21° (2.8° apart), over ±30° (4° apart). `iln-surfaces` knows it, and has been
#   trained on many spacings;
# - another **world**: a hall with pillars and shelves. There is no sky in it, and a ceiling, which no town has.
#
# **Predict:** for whom is the wide field of view worse, for LIIF or for ILN? And in the hall?

# %%
stands = ((0, 0, 0), (-12, 0.5, 0.6), (12, -0.5, 2.0), (3, 0, 4))  # in the hall: x, y [m], yaw [rad]


def box(low, high):
    """Corners and triangles of a box."""
    corners = np.array([[(low, high)[k >> a & 1][a] for a in range(3)] for k in range(8)], np.float32)
    quads = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))
    return corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def hall():
    boxes = [box((-30, -18, 0), (30, 18, 7))]
    boxes += [box((x - 0.3, y - 0.3, 0), (x + 0.3, y + 0.3, 7)) for x in range(-24, 25, 8) for y in (-12, -4, 4, 12)]
    boxes += [box((x, y, 0), (x + 5, y + 1, 2.6)) for x in range(-22, 20, 8) for y in (-15, -8, 8, 14)]
    starts = 8 * np.arange(len(boxes))
    triangles = np.concatenate([t + start for (_, t), start in zip(boxes, starts, strict=True)])
    return Mesh(np.concatenate([c for c, _ in boxes]), triangles, device)


def spread(half, rows=16):
    """The input sensor with its beams over ± `half` degrees."""
    return replace(INPUT, elevations=np.deg2rad(np.linspace(-half, half, rows)), name="")


def pair(world, pose, half, rows=64):
    """One pair: 16 beams over ± `half` degrees, and `rows` beams over the same, 90 degrees of them."""
    dense = replace(SECTOR, elevations=spread(half, rows).elevations)
    return [simulate.scan(world, sensor, pose) for sensor in (spread(half), dense)]


places = []  # (world, pose) in both test towns
for street in streets.values():
    for number in (len(street.waypoints) // 3, 2 * len(street.waypoints) // 3):
        pose = street.pose(number)
        places.append((street.world(pose[:3, 3], number), pose))
inside = hall()
halls = [(inside, simulate.pose((x, y, 1.8), yaw)) for x, y, yaw in stands]
conditions = {
    "as trained\n±15°": [pair(*place, 15) for place in places],
    "odd size\n±15°, 50 rows": [pair(*place, 15, rows=50) for place in places],
    "narrow\n±7.5°": [pair(*place, 7.5) for place in places],
    "wide\n±21°": [pair(*place, 21) for place in places],
    "very wide\n±30°": [pair(*place, 30) for place in places],
    "hall\n±15°": [pair(*place, 15) for place in halls],
}
chosen = ("bilinear", "planes", *NETWORKS, *(("own",) if OWN else ()))
beyond = {
    name: {condition: judge(loaded[name], some)["iou"].mean() for condition, some in conditions.items()}
    for name in chosen
}

# %%
figure, panels = plt.subplots(1, 2, figsize=(12, 3.8), layout="constrained", sharex=True)
for name, found in beyond.items():
    x, style = (
        np.arange(len(conditions)),
        {"color": COLOURS[name], "marker": MARKERS[name], "label": name, "ls": "", "ms": 8},
    )
    panels[0].plot(x, list(found.values()), **style)
    panels[1].plot(x, [value / beyond["bilinear"][c] for c, value in found.items()], **style)
panels[0].set(ylabel="IoU")
panels[1].set(ylabel="IoU over that of bilinear")
panels[1].legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
for axes in panels:
    axes.set_xticks(range(len(conditions)), conditions, fontsize=7)
    axes.grid(axis="x", alpha=0.3)
plt.show()
print(" " * 12 + "".join(f"{condition.splitlines()[0]:>12}" for condition in conditions))
for name, found in beyond.items():
    print(f"{name:>12}" + "".join(f"{value:12.3f}" for value in found.values()))

trained, odd, narrow, _, widest, room = conditions
for found in beyond.values():
    assert abs(found[odd] - found[trained]) < 0.02
for condition in conditions:
    ahead = min(beyond[name][condition] for name in ("planes", "iln-surfaces"))
    order = [ahead, *(beyond[name][condition] for name in ("iln", "bilinear", "liif"))]
    assert order == sorted(order, reverse=True)
assert beyond["bilinear"][narrow] - beyond["bilinear"][trained] > 0.04
assert beyond["liif"][trained] - beyond["liif"][narrow] > 0.03
lost = {name: found[trained] - found[widest] for name, found in beyond.items()}
assert lost["iln"] > lost["planes"]
kept = {name: found[room] / found[trained] for name, found in beyond.items()}
assert kept["liif"] < min(kept[name] for name in ("iln", "iln-surfaces", "planes"))
assert max(kept[name] for name in ("iln", "planes")) < kept["bilinear"]

# %% [markdown]
# *In words: two panels with the six conditions side by side, each method a marker. The order is the same in all six:
# planes and iln-surfaces on top, then iln, bilinear, liif. From "as trained" to "narrow" the markers of bilinear, planes
# and iln-surfaces go up, that of iln stays, and that of liif falls. At "very wide" iln comes down more than planes. In
# the hall planes and iln lie closer to bilinear, and liif lies farther below it than as trained.*
#
# - **Another output size costs nothing**, as it should.
# - **A narrow field of view is an easier task**: neighbours are closer together, and the rules and `iln-surfaces` gain.
#   LIIF *loses*: presumably it has learned how far ranges run apart within one pixel of 2°, and predicts that still.
# - **A very wide one is harder for everybody**, and ILN loses much. Geometry holds `planes` and `iln-surfaces` up.
# - **The hall is another world**, and the order survives. Every margin over bilinear shrinks, also that of
#   `planes`, which has learned nothing: in part the hall is just a good place for bilinear. Of what it had, LIIF loses
#   most.
#
# These are four scans each, so read large differences only. And whatever an ILN answers in a place it does not know
# lies between the neighbours' ranges; nothing holds LIIF there.

# %% [markdown]
# ## 7. What to believe
#
# The largest size takes too long for a notebook. This is its row in the table that is committed with the package, ten
# scans of the same two towns, beside the paper's:

# %%
with open(Path(ilnet.__file__).parent / "results" / "table.csv") as file:
    largest = {row["model"]: row for row in csv.DictReader(file) if row["size"] == "256x4096"}
for name, row in largest.items():
    theirs = PAPER["256x4096"].get(name)
    paper = f"   the paper: {theirs[0]:.2f} m, {theirs[1]:.3f}" if theirs else ""
    print(f"{name:>17}: MAE {float(row['mae']):.2f} m, IoU {float(row['iou']):.3f}{paper}")
assert float(largest["iln"]["iou"]) > float(largest["liif"]["iou"])

# %% [markdown]
# ### One thing at a time
#
# `liif` and `iln` differ in three things at once: what is predicted, whether the measured ranges enter the answer, and
# the decoder. Notebook 05 took them apart in 120 steps. `python -m ilnet experiment fair` does so with the same encoder
# (8 blocks), the same rays and 1000 steps in float32 for every case, with LIIF's decoder (an MLP) and ILN's
# (attention), from the paper's start and from bilinear interpolation. Its numbers are committed with the package.
#
# **Predict:** in notebook 05 weights were well ahead of corrections. Are they still, after eight times as many steps?

# %%
with open(Path(ilnet.__file__).parent / "results" / "fair.csv") as file:
    runs = [row for row in csv.DictReader(file) if row["size"] == "64x1024"]
kinds, decoders, starts = (list(dict.fromkeys(row[key] for row in runs)) for key in ("kind", "decoder", "start"))


def mean(figure, **case):
    """The mean over the seeds of one case; NaN if it was not trained."""
    found = [float(row[figure]) for row in runs if all(row[key] == value for key, value in case.items())]
    return np.mean(found) if found else math.nan


print(f"seeds: {len({row['seed'] for row in runs})}, test scans: {runs[0]['scans']}")
print(" " * 30 + "".join(f"{kind:>26}" for kind in kinds))
for start in starts:
    for decoder in decoders:
        cells = ""
        for kind in kinds:
            case = {"kind": kind, "decoder": decoder, "start": start}
            iou, mae, floating = (mean(figure, **case) for figure in ("iou", "mae", "floating"))
            cells += f"{'' if math.isnan(iou) else f'{iou:.3f} / {mae:.2f} m / {floating:.3f}':>26}"
        print(f"{start:>14}, {decoder:<13} " + cells)
print("each: IoU / MAE / floating")
for start in starts:
    for decoder in decoders[:2]:
        order = [mean("mae", kind=kind, decoder=decoder, start=start) for kind in ("weights", "corrections", "values")]
        assert order == sorted(order)

# %% [markdown]
# Read it column by column. From values to corrections the IoU more than doubles: the *measured ranges* bring most of
# it. From corrections to weights it hardly changes with an MLP. But the MAE and the floating points fall in every row,
# and with attention corrections fail where weights do not. And take attention away, but leave its feed-forward layer
# (the last line of each start): weights lose .03 or nothing.
#
# So the claim is this. *Measured ranges have to be in the answer. Blending them with predicted weights is the way that
# has the lowest error, the fewest points between two surfaces, and works with any decoder.*
#
# ### What these tables say, from solid to shaky
#
# 1. **Weights are ahead of values in IoU and in MAE.** At three sizes, from the first steps on, in each of six
#    conditions above, with one thing changed at a time, and in the paper. Believe it. Most of the IoU comes from the
#    measured ranges, and corrections with an MLP have nearly as much of it.
# 2. **A rule made of planes is ahead of `iln` in IoU.** Also solid, and it says as much about the measure and the towns
#    as about the rule: most voxels lie on planes. Where leaves and people matter, ask for other measures.
# 3. **The networks have the smallest MAE.** Solid on these towns; and it is what their loss asks for.
# 4. **`iln-surfaces` over `iln` in IoU.** Solid, a paired difference of many standard errors. But these tables do not
#    say what it comes from.
# 5. **The size of any gap after a long training.** Unknown. 6000 steps are a few thousandths of the paper's budget, and
#    LIIF may gain more from a longer one than ILN, which starts ahead. The paper's own gap, with its full budget, is
#    .329 to .258.
# 6. **Digits after the second.** Voxel boundaries, the choice of 0.1 m, and how many metres a no return costs move
#    them.
#
# Two habits keep a table honest. Nothing was *chosen* on the test towns: not the number of steps, not the loss, not
# the learning rate. And rules without training stand in it: had `planes` been left out, nobody would see how much of an
# IoU flat ground gives away.

# %% [markdown]
# ### Exercise 4 · An IoU without boundaries
#
# importance ★★☆ · difficulty ★★☆ · 12 minutes
#
# In section 1 an error of 1 cm cost a wall all of its IoU, because it stood close to a boundary. Write
# `shifted_iou(predicted, true, count)` for point clouds (N, 3) and (M, 3): the mean of the voxel IoU over `count`
# grids. Grid $k = 0, \dots, \text{count} - 1$ is shifted by $k \cdot 0.1\,\text{m} / \text{count}$ along all three axes
# against the usual one. With `count = 1` it is the usual IoU. No range limits here; an IoU without any voxel is 0.
# Return a float.
#
# <details><summary>Hint</summary>
#
# Instead of a grid, shift both clouds, by the same amount, in either direction. `metrics.voxels(points)` gives a tensor
# with the number of each occupied voxel; `torch.isin` compares two of them.
#
# </details>
# <details><summary>Hint on the check</summary>
#
# The wall at 5.095 m, predicted 1 cm too far: in one grid of ten the boundary lies between the two walls.
#
# </details>


# %% tags=["exercise"]
def shifted_iou(predicted, true, count):
    raise NotImplementedError


# %% tags=["solution"]
def shifted_iou(predicted, true, count):
    total = 0.0
    for k in range(count):
        one, other = (metrics.voxels(points + k * 0.1 / count) for points in (predicted, true))
        common = torch.isin(one, other).sum().item()
        total += common / max(len(one) + len(other) - common, 1)
    return total / count


# %% tags=["check"]
@check
def _():
    y, z = torch.meshgrid(torch.arange(0.05, 1, 0.1), torch.arange(0.05, 1, 0.1), indexing="ij")

    def standing(x):
        return torch.stack((torch.full_like(y, x), y, z), -1).view(-1, 3)

    value = shifted_iou(standing(5.003), standing(5.003), 10)
    assert isinstance(value, float), f"return a float, not {type(value).__name__}"
    assert abs(value - 1) < 1e-6, f"a wall against itself has IoU 1 in every grid, not {value:.3f}: shift both clouds"
    value = shifted_iou(standing(5.105), standing(5.095), 1)
    assert value == 0, f"count = 1 is the usual grid, in which a boundary parts the two walls: 0, not {value:.3f}"
    for at in (5.003, 5.043, 5.093):
        value = shifted_iou(standing(at + 0.01), standing(at), 10)
        hint = "shift by parts of a voxel, k * 0.1 / count" if value in (0, 1) else "take the mean over the grids"
        assert abs(value - 0.9) < 1e-3, (
            f"1 cm of 10 costs a wall a tenth wherever it stands: 0.9, not {value:.3f}; {hint}"
        )
    value = shifted_iou(standing(5.023), standing(5.003), 5)
    assert abs(value - 0.8) < 1e-3, f"2 cm and 5 grids: 0.8, not {value:.3f}"
    turned = [standing(x)[:, [1, 0, 2]] for x in (5.013, 5.003)]  # walls across y
    value = shifted_iou(*turned, 10)
    assert abs(value - 0.9) < 1e-3, f"the same wall across y: 0.9, not {value:.3f}; shift along all three axes"
    nothing = torch.zeros(0, 3)
    try:
        value = shifted_iou(nothing, nothing, 4)
    except ZeroDivisionError:
        value = math.nan
    assert value == 0, f"two empty clouds have IoU 0 by agreement, not {value}"


# %% tags=["wrong"]
def shifted_iou(predicted, true, count):  # shifts one cloud
    total = 0.0
    for k in range(count):
        one, other = metrics.voxels(predicted + k * 0.1 / count), metrics.voxels(true)
        common = torch.isin(one, other).sum().item()
        total += common / max(len(one) + len(other) - common, 1)
    return total / count


# %% tags=["wrong"]
def shifted_iou(predicted, true, count):  # along x only
    total = 0.0
    for k in range(count):
        one, other = (metrics.voxels(p + torch.tensor([k * 0.1 / count, 0, 0])) for p in (predicted, true))
        common = torch.isin(one, other).sum().item()
        total += common / max(len(one) + len(other) - common, 1)
    return total / count


# %% tags=["wrong"]
def shifted_iou(predicted, true, count):  # by whole voxels
    total = 0.0
    for k in range(count):
        one, other = (metrics.voxels(points + k * 0.1) for points in (predicted, true))
        common = torch.isin(one, other).sum().item()
        total += common / max(len(one) + len(other) - common, 1)
    return total / count


# %% tags=["wrong"]
def shifted_iou(predicted, true, count):  # the union of all grids is not their mean
    common = union = 0
    for k in range(count):
        one, other = (metrics.voxels(points + k * 0.1 / count) for points in (predicted, true))
        both = torch.isin(one, other).sum().item()
        common, union = common + both, union + len(one) + len(other) - both
    return common / union


# %% [markdown]
# ## Summary
#
# 1. MAE in metres is ruled by a few pixels at far edges, voxel IoU by centimetres on flat surfaces. They can disagree,
#    and each is nearly blind to what the other one measures.
# 2. Networks that predict weights are ahead of the one that predicts values, and have the smallest errors. In IoU a rule
#    made of planes is ahead of `iln`, and the network that weighs surfaces is ahead of both.
# 3. Differences on the same scans are far less noisy than means. What several trainings would say, they do not tell.
# 4. Another output size is in distribution; another spacing of beams and another world are not, and the order held
#    there too.
#
# ## Next
#
# Simulated towns have no dust and no glass. [09 · Your own sensor](09_your_own_sensor.ipynb) takes a file as a sensor
# writes it, tells the models its beams, and finds out what breaks.
