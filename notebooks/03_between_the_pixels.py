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
# # 03 · Between the pixels
#
# ![From above: a sensor, a wall at 10 m that ends between two laser beams, a wall at 30 m behind it, and three points
# on a dotted ray between the beams](pictures/03_between_the_pixels.png)
#
# **Goal.** You ask a scan for directions that its sensor did not measure, answer by blending the four pixels around
# them, and find out where no fixed blend can be right.
#
# **After this notebook you can**
#
# - say which four pixels surround a direction, and with which areas;
# - blend ranges with the op `gather_blend`, and say what its scores and its prior do;
# - show why 1/r, and not r, may be interpolated on a plane;
# - show that points in empty air come from blending across an edge, and that one neighbour mostly knows better.
#
# | | |
# |---|---|
# | You know | [01 · What a LiDAR measures](01_what_a_lidar_measures.ipynb), [02 · Casting rays](02_casting_rays.ipynb) |
# | Time | 30 minutes, and 30 for the exercises; under a minute to run |
# | Hardware | any computer; a CUDA GPU is used if there is one |

# %%
import math

import matplotlib.pyplot as plt
import torch

from ilnet import places, simulate
from ilnet.course import Cells, check, draw_thread, slide
from ilnet.sensor import angles_to_directions, preset
from kernels import gather_blend, gather_neighbours

device = "cuda" if torch.cuda.is_available() else "cpu"
COLOURS = {"bilinear": "#999999", "perspective": "#e69f00", "truth": "black"}

# %% [markdown]
# We stand in a street with a LiDAR of 16 beams. Its scan is the *image*; the street itself is the truth that we may
# ask for any other ray.

# %%
street = places.town("town01", device=device)
WAYPOINT = 1445
sensor = preset("paper-16x1024")
pose = street.pose(WAYPOINT)
world = street.world(pose[:3, 3], seed=0)
scan = simulate.scan(world, sensor, pose)
image = scan.filled()  # (16, 1024) metres; no return becomes 100 m, as the networks see it


def truth_at(elevation, azimuth):
    """The range [m] that the sensor would measure in a direction of its own frame, 0 where nothing is met."""
    return cast_into(world, pose, angles_to_directions(elevation, azimuth))


def cast_into(world, pose, rays):
    """Ranges along rays (N, 3) to the nearest of several meshes."""
    return simulate.nearest([simulate.cast(mesh, pose, rays, sensor.max_range) for mesh in world])


print(image.shape, f"{(scan.ranges > 0).float().mean():.0%} of the rays came back")

# %% [markdown]
# ## 1. A query and its four neighbours
#
# A *query* is a direction. `sensor.locate` turns its elevation and azimuth into a *pixel coordinate* (row, column), of
# which integers are pixel centres. The four pixels around it are its *neighbours*, always in this order:
#
# | $t$ | 1 | 2 | 3 | 4 |
# |---|---|---|---|---|
# | pixel | (row-, column-) | (row-, column+) | (row+, column-) | (row+, column+) |
#
# where row- is the row rounded down and row+ the next one, and the same for columns. Columns wrap around the seam;
# beyond the first and the last row the border row is repeated. (In code $t$ runs from 0 to 3.)
#
# The query cuts the cell between them into four rectangles. The *area* $a_t$ of a neighbour is that of the rectangle
# **opposite** it, so that the closest neighbour has the largest area. With $f$ and $g$ for the fractions of row and
# column:
#
# $$a = \big((1-f)(1-g),\ (1-f)\,g,\ f\,(1-g),\ f g\big), \qquad \textstyle\sum_t a_t = 1$$

# %%
query = torch.tensor([[4.3, 511.6]], device=device)  # (Q, 2)
neighbours, offsets = gather_neighbours(image[None], query)  # an image of one channel: (Q, 4, channels), (Q, 4, 2)
areas = gather_blend(image, query, image.new_zeros(1, 4), "bilinear", return_weights=True)[1]  # see section 2

figure, axes = plt.subplots(figsize=(4.6, 3.6), layout="constrained")
f, g = 0.3, 0.6
corners = [(0, 0), (0, 1), (1, 0), (1, 1)]
colours = ["#0072b2", "#e69f00", "#009e73", "#cc79a7"]
for (r, c), colour, area, r_t in zip(corners, colours, areas[0].tolist(), neighbours[0, :, 0].tolist(), strict=True):
    opposite = (g if c == 0 else 0, f if r == 0 else 0)
    size = (1 - g if c == 0 else g), (1 - f if r == 0 else f)
    axes.add_patch(plt.Rectangle(opposite, *size, color=colour, alpha=0.35))
    axes.plot(c, r, "o", color=colour, markersize=12)
    axes.annotate(f"{r_t:.2f} m\narea {area:.2f}", (c, r), (1 if c else -1) * 12 * torch.tensor([1, 0]).numpy(),
                  textcoords="offset points", ha="left" if c else "right", va="center")  # fmt: skip
axes.plot(g, f, "kx", markersize=10, markeredgewidth=2)
axes.set(xlim=(-0.7, 1.7), ylim=(-0.15, 1.15), xticks=[0, 1], xticklabels=["511", "512"], xlabel="column")
axes.set(yticks=[0, 1], yticklabels=["4", "5"], ylabel="row")
plt.show()

# %% [markdown]
# *In words: a square with a coloured dot, its range and its area at each corner and a cross at the query. The rectangle
# between the query and a corner has the colour of the corner opposite.*
#
# The offsets say the same in pixels: query minus neighbour. A network will get them as input.

# %%
print("offsets:", [[round(part, 3) for part in offset] for offset in offsets[0].tolist()])

# %% [markdown]
# ### Exercise 1 · Areas
#
# ★☆☆ · 5 minutes
#
# Write `bilinear_areas(queries)`: the areas (Q, 4) of queries (Q, 2), in the order of the table. A query on a pixel
# centre gives that pixel all the area.
#
# <details><summary>Hint</summary>
#
# `queries - queries.floor()` holds $f$ and $g$. `torch.stack([...], -1)` joins four columns.
# </details>


# %% tags=["exercise"]
def bilinear_areas(queries):
    raise NotImplementedError


# %% tags=["solution"]
def bilinear_areas(queries):
    f, g = (queries - queries.floor()).unbind(-1)
    return torch.stack([(1 - f) * (1 - g), (1 - f) * g, f * (1 - g), f * g], -1)


# %% tags=["check"]
@check
def _():
    mine = bilinear_areas(torch.tensor([[4.3, 511.6]]))
    assert mine.shape == (1, 4), f"the shape should be (1, 4), one area for each neighbour; it is {tuple(mine.shape)}"
    assert (mine >= 0).all(), f"an area is negative: {mine}; fractions are counted from the row and column below"
    assert torch.allclose(mine.sum(-1), torch.ones(1)), f"the areas sum to {mine.sum():.3f}, not to 1"
    wanted = torch.tensor([[0.28, 0.42, 0.12, 0.18]])
    assert not torch.allclose(mine, wanted.flip(-1), atol=1e-4), "the closest neighbour got the smallest area: opposite"
    assert torch.allclose(mine, wanted, atol=1e-4), f"for (4.3, 511.6) you have {mine}, wanted is {wanted}: the order?"
    centre = bilinear_areas(torch.tensor([[2.0, 7.0]]))
    assert torch.equal(centre, torch.tensor([[1.0, 0, 0, 0]])), f"on the centre of (2, 7) all area is its: {centre}"


# %% tags=["wrong"]
def bilinear_areas(queries):
    f, g = (queries - queries.floor()).unbind(-1)
    return torch.stack([f * g, f * (1 - g), (1 - f) * g, (1 - f) * (1 - g)], -1)


# %% tags=["wrong"]
def bilinear_areas(queries):
    f, g = (queries - queries.floor()).unbind(-1)
    return torch.stack([(1 - f) * (1 - g), f * (1 - g), (1 - f) * g, f * g], -1)


# %% tags=["wrong"]
def bilinear_areas(queries):
    f, g = (queries - (queries - 1e-3).floor()).unbind(-1)
    return torch.stack([(1 - f) * (1 - g), (1 - f) * g, f * (1 - g), f * g], -1)


# %% [markdown]
# ## 2. One op for every blend
#
# An answer is a *blend* of the four ranges with weights that sum to 1:
#
# $$\hat r = \sum_{t=1}^{4} w_t\, r_t, \qquad w = \operatorname{softmax}(s + p)$$
#
# The *scores* $s$ are what a network will say (notebook 05). We have none yet: $s = 0$, and the *prior* $p$, four
# numbers that are known beforehand, decides alone.
#
# | prior | $p_t$ | zero scores give |
# |---|---|---|
# | `"none"` | 0 | the mean of the four |
# | `"bilinear"` | $\log a_t$ | $\sum_t a_t r_t$: bilinear interpolation |
# | `"perspective"` | $\log a_t - \log r_t$ | $1 \big/ \sum_t (a_t / r_t)$: bilinear interpolation of **1/r** |
#
# The last line takes a moment: $w_t \propto a_t / r_t$, so $\hat r = \sum (a_t/r_t)\,r_t \big/ \sum (a_t/r_t)$, and the
# numerator is $\sum a_t = 1$.
#
# From the equation to the kernel that does it, `_gather_blend_kernel` in `kernels/gather_blend.py`. (The op adds a
# batch dimension B; `wp.Float` is any floating-point type.)
#
# | equation | line of code | kernel argument |
# |---|---|---|
# | $r_t$ | `image` | `image: wp.array3d[wp.Float]`, (B, H, W) |
# | where $t = 1..4$ are | `queries` | `queries: wp.array2d[...]`, two numbers at once |
# | $s$ | `scores` | `scores: wp.array2d[...]`, four at once |
# | $p$ | `prior="perspective"` | `prior: int` |
# | $\hat r$ | `gather_blend(image, queries, scores, prior)` | `blended_out` |

# %%
draw_thread(
    "gather_blend: one thread, one query",
    [
        Cells("image", (5, 9), [(2, 4), (2, 5), (3, 4), (3, 5)]),
        Cells("queries", (6, 2), [(2, 0), (2, 1)]),
        Cells("scores", (6, 4), [(2, 0), (2, 1), (2, 2), (2, 3)]),
    ],
    "locate 4 neighbours\n$w = $ softmax$(s + p)$\n$\\hat r = \\sum_t w_t\\, r_t$",
    [Cells("blended_out", (6, 1), [(2, 0)])],
)

# %% [markdown]
# *In words: on the left three arrays; a thread reads two by two pixels of the image, one row of the queries, one row of
# the scores. On the right it writes one element of the answer (and, not drawn, its four weights). No other thread
# writes there, and nothing in between goes through memory.*

# %%
zero = image.new_zeros(1, 4)
for prior in ("none", "bilinear", "perspective"):
    blended, weights = gather_blend(image, query, zero, prior, return_weights=True)
    print(f"{prior:>12}: {blended.item():6.3f} m, weights {[round(w, 3) for w in weights[0].tolist()]}")
r = neighbours[..., 0]
assert torch.allclose(gather_blend(image, query, zero, "bilinear"), (areas * r).sum(-1))
assert torch.allclose(gather_blend(image, query, zero, "perspective"), 1 / (areas / r).sum(-1))

# %% [markdown]
# ## 3. On a plane
#
# Straight ahead is road. We move a query from the beam at -7° (row 4) up to the beam at -3° (row 6) and compare both
# blends with the truth.
#
# **Predict:** the road is flat. Is the truth, drawn over the row, a straight line between two pixels? If it is not, on
# which side of the straight line does it lie?


# %%
def along_column(column, rows):
    """Truth and blends at rows of a column: {name: (Q,) metres}."""
    queries = torch.stack((rows, torch.full_like(rows, column)), -1).to(device)
    elevations = torch.tensor(sensor.elevations)
    low = rows.floor().long().clamp(max=len(elevations) - 2)
    elevation = torch.lerp(elevations[low], elevations[low + 1], rows.double() - low)
    azimuth = torch.full_like(elevation, float(sensor.azimuths[column]))
    zero = image.new_zeros(len(rows), 4)
    found = {prior: gather_blend(image, queries, zero, prior).cpu() for prior in ("bilinear", "perspective")}
    return {"truth": truth_at(elevation, azimuth).cpu(), **found}


AHEAD = 512
rows = torch.linspace(4, 6, 81)
road = along_column(AHEAD, rows)
for name in ("bilinear", "perspective"):
    error = (road[name] - road["truth"]).abs()
    print(f"{name:>12}: at most {error.max():.2f} m off, {error.mean():.2f} m in the mean")


def draw_lines(x, lines, **labels):
    axes = plt.figure(figsize=(6, 3), layout="constrained").subplots()
    for name, style in (("truth", "-"), ("bilinear", "--"), ("perspective", "-.")):
        axes.plot(x, lines[name], style, color=COLOURS[name], linewidth=2, label=name)
    axes.set(ylabel="range [m]", **labels)
    axes.legend(frameon=False)
    return axes


axes = draw_lines(rows, road, title="on a road, from beam to beam", xlabel="row", xticks=[4, 5, 6])
axes.plot([4, 5, 6], road["truth"][[0, 40, 80]], "o", color="black")  # the pixels
plt.show()
assert (road["perspective"] - road["truth"]).abs().max() < 0.1
assert (road["bilinear"] - road["truth"]).mean() > 0.2  # too far

# %% [markdown]
# *In words: range over the row on a road. The truth (black) runs in two sagging arcs from 15 m over 20 m to 35 m. The
# perspective blend (dash-dotted) covers it, the bilinear blend (dashed) is the chord above.*
#
# Bilinear interpolation draws the chord, and the truth sags below it: the blend is too far everywhere between the
# beams. Here is why. Points of a plane satisfy $\mathbf n \cdot \mathbf p = c$. The sensor is the origin and
# $\mathbf p = r\,\mathbf d$, so
#
# $$r\; \mathbf n \cdot \mathbf d = c \quad\Longrightarrow\quad \frac1r = \frac{\mathbf n \cdot \mathbf d}{c}$$
#
# **1/r is linear in the direction, r is not.** Over so small a cell the direction is almost linear in the pixel
# coordinate, so interpolating 1/r is almost exact. No network is needed to know that roads and walls are flat.
#
# ### Exercise 2 · The perspective blend by hand
#
# ★★☆ · 10 minutes
#
# Write `inverse_blend(r, a)`, for ranges r (Q, 4) and areas a (Q, 4). It returns a pair: the inverse of the bilinear
# blend of 1/r, (Q,), and the weights $w_t$, (Q, 4), with which the same is a blend of *ranges*.
#
# <details><summary>Hint 1</summary>
#
# The blend of 1/r is $u = \sum_t a_t / r_t$. What is returned is $1/u$.
# </details>
# <details><summary>Hint 2</summary>
#
# $w_t \propto a_t / r_t$. What do these four sum to before you divide?
# </details>


# %% tags=["exercise"]
def inverse_blend(r, a):
    raise NotImplementedError  # return ranges (Q,), weights (Q, 4)


# %% tags=["solution"]
def inverse_blend(r, a):
    inverse = (a / r).sum(-1)
    return 1 / inverse, a / r / inverse[:, None]


# %% tags=["check"]
@check
def _():
    r = torch.tensor([[10.0, 10.0, 20.0, 20.0], [7.0, 7.0, 7.0, 7.0], [5.0, 50.0, 50.0, 50.0]])
    a = torch.tensor([[0.25, 0.25, 0.25, 0.25], [0.1, 0.2, 0.3, 0.4], [1.0, 0.0, 0.0, 0.0]])
    answer = inverse_blend(r, a)
    assert isinstance(answer, tuple), "return a pair: ranges (Q,) and weights (Q, 4)"
    blended, weights = answer
    assert blended.shape == (3,), f"one range for each query is wanted: (3,), not {tuple(blended.shape)}"
    assert abs(blended[0] - 15.0) > 1e-3, "between 10 m and 20 m you have 15 m: that is the blend of ranges, not of 1/r"
    assert abs(blended[0] - 0.075) > 1e-3, "0.075 is the blended inverse range, in 1/m: one step is missing"
    assert torch.allclose(blended[0], torch.tensor(40 / 3)), f"half way from 10 m to 20 m is 13.33 m, not {blended[0]}"
    assert torch.allclose(blended[1], torch.tensor(7.0)), f"where all are 7 m, the blend is 7 m, not {blended[1]}"
    assert torch.allclose(blended[2], torch.tensor(5.0)), f"on a pixel its own range is returned, 5 m, not {blended[2]}"
    assert torch.allclose(weights.sum(-1), torch.ones(3)), f"the weights sum to {weights.sum(-1).tolist()}, not to 1"
    assert torch.allclose((weights * r).sum(-1), blended), "the weights do not blend the ranges to what you returned"


# %% tags=["wrong"]
def inverse_blend(r, a):
    return (a * r).sum(-1), a


# %% tags=["wrong"]
def inverse_blend(r, a):
    return (a / r).sum(-1), a / r


# %% tags=["wrong"]
def inverse_blend(r, a):
    return 1 / (a / r).sum(-1), a


# %% [markdown]
# ## 4. At an edge
#
# Now a place where the neighbours disagree. We search the image for upright edges: the two neighbours in one column
# agree, the two in the next column agree, and the two pairs lie as far apart as possible. We look at the image only,
# not at the truth.
#
# **Predict:** a query moves from one column to the next (from the left one to the right one, as the array is drawn).
# How does the truth change on the way? And the two blends?

# %%
one, other = scan.ranges[:, :-1], scan.ranges[:, 1:]  # each column and the next
agree = (one.diff(dim=0).abs() < 0.5) & (other.diff(dim=0).abs() < 0.5)  # (15, 1023)
cell = torch.stack((one[:-1], other[:-1], one[1:], other[1:]))  # (4, 15, 1023)
spread = (cell.amax(0) - cell.amin(0)).where(agree & (cell > 0).all(0), 0.0)
strongest = spread.flatten().topk(100).indices.cpu()
edge_rows, edge_columns = strongest // spread.shape[1], strongest % spread.shape[1]


def across(row, column, parts, row_part=0.5):
    """Truth, blends and neighbours of queries between two columns: {name: (Q,) or (Q, 4) metres}."""
    low, high = sensor.elevations[row : row + 2]
    left, right = sensor.azimuths[column : column + 2]
    azimuth = left + parts.double() * (right - left)
    elevation = torch.full_like(azimuth, low + row_part * (high - low))
    queries = torch.stack((torch.full_like(parts, row + row_part), column + parts), -1).to(device)
    zero = image.new_zeros(len(parts), 4)
    found = {prior: gather_blend(image, queries, zero, prior).cpu() for prior in ("bilinear", "perspective")}
    found["neighbours"] = gather_neighbours(image[None], queries)[0][..., 0].cpu()
    return {"truth": truth_at(elevation, azimuth).cpu(), **found}


parts = torch.linspace(0, 1, 81)
edge = across(int(edge_rows[0]), int(edge_columns[0]), parts)
print("neighbours [m]:", [round(r, 1) for r in edge["neighbours"][0].tolist()])

draw_lines(parts, edge, title="across an edge, from column to column", xlabel="part of the way")
plt.show()

# %% [markdown]
# *In words: range over the way across an edge. The truth jumps once from one level to the other; both blends climb from
# one end of the cell to the other.*
#
# The truth chooses, the blends compromise. Is there perhaps something in the gap? We stand at a made-up point and
# cast rays in all directions: the shortest range says how far the nearest surface is.

# %%
middle = across(int(edge_rows[0]), int(edge_columns[0]), torch.tensor([0.5]))
row, column = int(edge_rows[0]), int(edge_columns[0])
angle = [torch.tensor(t[i : i + 2]).mean() for t, i in ((sensor.elevations, row), (sensor.azimuths, column))]
forward = (pose[:3, :3] @ angles_to_directions(*angle).double()).float().to(device)
around = torch.nn.functional.normalize(torch.randn(20_000, 3, generator=torch.Generator().manual_seed(0)), dim=1)
for prior in ("bilinear", "perspective"):
    made_up = torch.eye(4, dtype=torch.float64)
    made_up[:3, 3] = pose[:3, 3] + middle[prior].item() * forward.cpu().double()  # p = o + r d
    distances = cast_into(world, made_up, around)
    nearest = distances[distances > 0].min()
    print(f"{prior:>12}: {middle[prior].item():.1f} m, the nearest surface is {nearest:.2f} m away")
    assert nearest > 0.3

# %% [markdown]
# Nothing is there: a *flying point*. Move the edge and the query yourself. The sketch shows a wall at 10 m that ends
# somewhere between two columns, and one at 30 m behind it; the columns are drawn 8° apart so that you can see them.


# %% tags=["goal"]
def draw_edge(edge=0.6, offset=0.4):
    """From above: two pixels, a query between them, and where each method puts its point."""
    near, far, apart = 10.0, 30.0, math.radians(8)
    pair = torch.tensor([[near, far], [near, far]])  # two rows, two columns
    query = torch.tensor([[0.5, offset]])
    found = {
        prior: gather_blend(pair, query, torch.zeros(1, 4), prior, wrap=False).item() for prior in list(COLOURS)[:2]
    }
    found["truth"] = near if offset < edge else far
    axes = plt.figure(figsize=(9, 2.6), layout="constrained").subplots()

    def place(r, part):
        angle = (0.5 - part) * apart
        return r * math.cos(angle), r * math.sin(angle)

    for low, high, r in ((-0.3, edge, near), (edge, 1.3, far)):
        wall = [place(r, low + (high - low) * i / 20) for i in range(21)]
        axes.plot(*zip(*wall, strict=True), color="#555555", linewidth=5, solid_capstyle="butt")
    for part, r in ((0, near), (1, far)):
        axes.plot(*zip((0, 0), place(r, part), strict=True), color="#cccccc", linewidth=1)
        axes.plot(*place(r, part), "o", color="#0072b2", markersize=9)
    axes.plot(*zip((0, 0), place(34, offset), strict=True), ":", color="black", linewidth=1)
    for (name, r), marker in zip(found.items(), "^Dx", strict=True):
        label = f"{name} {r:.1f} m"
        axes.plot(*place(r, offset), marker, color=COLOURS[name], markersize=9, markeredgewidth=2, label=label)
    axes.plot(0, 0, "ks")
    axes.set(xlim=(-1, 36), ylim=(-3.2, 3.2), xlabel="metres ahead", yticks=[])
    axes.legend(loc="upper left", frameon=False)
    plt.show()


draw_edge()

# %% [markdown]
# *In words: from above, two rays from the sensor on the left; a blue dot where each meets its wall, one at 10 m, one at
# 30 m. A dotted ray between them: the truth lies on the near wall, bilinear at 18 m and perspective at 13.6 m float in
# the gap.*
#
# **Predict:** the edge moves to 0.2, on the other side of the query. What changes?

# %%
draw_edge(edge=0.2)

# %% [markdown]
# *In words: the near wall now ends before the dotted ray, and the truth lies on the far wall. Bilinear and perspective
# stay where they were, at 18 m and 13.6 m.*
#
# In a running notebook, sliders move both:

# %%
slide(draw_edge, edge=(0.0, 1.0, 0.05), offset=(0.0, 1.0, 0.05))

# %% [markdown]
# The edge moves nothing but the truth: **the four ranges do not contain it.** Right is 10 m or 30 m, and the blends say
# something else wherever the query is not on a pixel.
#
# ## 5. One neighbour mostly knows
#
# Bad luck at one edge? Here are the 100 strongest, each asked at a random place between its columns. Once we pick, with
# the truth in hand, the better of the two blends, and once the best of the four neighbours:

# %%
generator = torch.Generator().manual_seed(1)
asked = [
    across(int(r), int(c), torch.rand(1, generator=generator)) for r, c in zip(edge_rows, edge_columns, strict=True)
]
truth = torch.cat([case["truth"] for case in asked])
neighbours = torch.cat([case["neighbours"] for case in asked])
blends = torch.stack([torch.cat([case[prior] for case in asked]) for prior in ("bilinear", "perspective")])

errors = {
    "the better of both blends": (blends - truth).abs().amin(0),
    "the best of the neighbours": (neighbours - truth[:, None]).abs().amin(1),
}
for name, error in errors.items():
    print(f"{name}: median error {error.median():5.2f} m, within 0.5 m at {(error < 0.5).sum()} of 100 edges")
assert errors["the best of the neighbours"].median() < 0.5 < 2 < errors["the better of both blends"].median()
assert (errors["the best of the neighbours"] < 0.5).sum() > 80

# %% [markdown]
# At most edges the right answer was there all the time: one of the four neighbours has it. So the question is not
# *which value?* but **which neighbour, how much?** That is what scores are for. Softmax turns them into weights: a
# score larger by 5 gets a weight 150 times as large.
#
# ### Exercise 3 · Be the network
#
# ★★☆ · 10 minutes
#
# Write `choose(r, truth)`: scores (Q, 4) for which `gather_blend` *without* a prior comes within 0.1 m of the neighbour
# that is closest to the truth, from the ranges r (Q, 4) and the truth (Q,). A network has to guess what you may look
# up. (Without a prior, the weights are the softmax of the scores alone.) Ranges are at most 100 m, so a weight of
# $10^{-4}$ on a wrong neighbour moves the answer by up to 1 cm.
#
# <details><summary>Hint</summary>
#
# `(r - truth[:, None]).abs().argmin(-1)` is the neighbour. Its score has to be so much larger than the others that
# $e^{-\text{difference}}$ is below $10^{-4}$, and finite.
# </details>


# %% tags=["exercise"]
def choose(r, truth):
    raise NotImplementedError


# %% tags=["solution"]
def choose(r, truth):
    closest = (r - truth[:, None]).abs().argmin(-1)
    return 20.0 * torch.nn.functional.one_hot(closest, 4).to(r.dtype)


# %% tags=["check"]
@check
def _():
    scores = choose(neighbours, truth)
    assert scores.shape == neighbours.shape, f"scores should be {tuple(neighbours.shape)}, not {tuple(scores.shape)}"
    assert scores.is_floating_point(), f"scores are floating-point numbers, yours {scores.dtype}: .float()"
    assert scores.isfinite().all(), "a score is not finite: softmax makes NaN of two infinite ones"
    closest = neighbours.gather(1, (neighbours - truth[:, None]).abs().argmin(1, keepdim=True))[:, 0]
    blended = (scores.softmax(-1) * neighbours).sum(-1)
    off = (blended - closest).abs().max()
    assert off < 0.1, f"a blend is {off:.2f} m away from the closest neighbour: is its weight large enough?"
    same = choose(torch.full((1, 4), 7.0), torch.tensor([7.0]))
    assert abs((same.softmax(-1) * 7).sum() - 7) < 1e-4, "four equal neighbours should blend to their own range"


# %% tags=["wrong"]
def choose(r, truth):
    return -(r - truth[:, None]).abs() / r.mean()


# %% tags=["wrong"]
def choose(r, truth):
    return (r - truth[:, None]).abs()


# %% tags=["wrong"]
def choose(r, truth):
    closest = (r - truth[:, None]).abs().argmin(-1)
    return torch.nn.functional.one_hot(closest, 4).to(r.dtype).log()


# %% [markdown]
# ### Exercise 4 · The best that any weights can do
#
# ★★☆ · 5 minutes
#
# Weights are positive and sum to 1, so a blend lies between the smallest and the largest neighbour, whatever a network
# says. Write `best_blend(r, truth)`: the range (Q,) closest to the truth (Q,) that blends of the neighbours r (Q, 4)
# can come as close to as you like. The check prints how much of the error at edges is left.
#
# <details><summary>Hint</summary>
#
# If the truth lies between the extremes, `r.amin(-1)` and `r.amax(-1)`, some weights hit it. If not, the nearest
# extreme is the best.
# </details>


# %% tags=["exercise"]
def best_blend(r, truth):
    raise NotImplementedError


# %% tags=["solution"]
def best_blend(r, truth):
    return truth.clamp(r.amin(-1), r.amax(-1))


# %% tags=["check"]
@check
def _():
    r = torch.tensor([[10.0, 10, 30, 30], [10, 11, 12, 13], [5, 5, 5, 5]])
    found = best_blend(r, torch.tensor([18.0, 20.0, 2.0]))
    assert found.shape == (3,), f"one range for each query: (3,), not {tuple(found.shape)}"
    assert abs(found[0] - 18) < 1e-5, f"18 m lies between 10 m and 30 m: weights can hit it; you have {found[0]}"
    assert abs(found[1] - 13) < 1e-5, f"20 m is beyond all neighbours: the farthest, 13 m, is best; you have {found[1]}"
    assert abs(found[2] - 5) < 1e-5, f"four neighbours at 5 m blend to 5 m and nothing else; you have {found[2]}"
    left = (best_blend(neighbours, truth) - truth).abs().median()
    assert left <= errors["the best of the neighbours"].median(), "weights can do at least what one neighbour does"
    print(f"median error at the 100 edges: {left:.2f} m with the best weights,", end=" ")
    print(", ".join(f"{error.median():.2f} m with {name}" for name, error in errors.items()))


# %% tags=["wrong"]
def best_blend(r, truth):
    return truth


# %% tags=["wrong"]
def best_blend(r, truth):
    return r.gather(-1, (r - truth[:, None]).abs().argmin(-1, keepdim=True))[:, 0]


# %% [markdown]
# ## Summary
#
# 1. Between pixels an answer is a blend of four neighbours: softmax of scores plus a prior. One kernel does all of it.
# 2. On a plane 1/r is linear in the direction: the *perspective* blend is nearly exact, the bilinear one bends.
# 3. At an edge fixed blends put points into empty air, since the four ranges do not say where the edge is.
# 4. One neighbour mostly has the answer. Somebody has to choose: from the picture around the query, not from four
#    numbers.
#
# ## Next
#
# [04 · Values](04_values.ipynb): the obvious idea, a network that predicts the range itself.
