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
# # 05 · Weights
#
# ![A wall and a car in a range image: the truth, and what three networks answer untrained, after 30 and after 120
# steps](pictures/05_weights.png)
#
# **Goal.** You write the one branch in which three networks differ: they predict *values*, *corrections* or *weights*.
# You train each of them three times on the same rays, and see which part of the lead comes from what.
#
# **After this notebook you can**
#
# - write equation 3 of the paper, and say why its answer never leaves the span of the neighbours;
# - derive the gradient that teaches it, and say what it spends its training on;
# - tell what measured ranges are worth from what weights are worth, by your own runs;
# - start a network from a formula instead of from nothing.
#
# | | |
# |---|---|
# | You know | [04 · Values](04_values.ipynb) |
# | Time | 35 minutes, and 35 for the exercises; two to three minutes to run |
# | Hardware | any computer; a CUDA GPU is used if there is one |

# %%
import matplotlib.pyplot as plt
import numpy as np
import torch
from torch import nn

from ilnet import metrics, models
from ilnet.commands import fair
from ilnet.course import check, fit, held_out, slide, yours_or
from ilnet.models.encoder import Encoder
from ilnet.sensor import PAPER_INPUT as SENSOR
from kernels import area_blend, gather_blend, gather_neighbours

FAST = True  # False: ten times the steps
STEPS = 120 if FAST else 1200
SEEDS = 3
device = "cuda" if torch.cuda.is_available() else "cpu"
KINDS = "values", "corrections", "weights"
COLOURS = dict(zip(KINDS, ("#d55e00", "#e69f00", "#0072b2"), strict=True))
MARKS = dict(zip(KINDS, "vso", strict=True))

# %% [markdown]
# ## 1. Another question
#
# In notebook 03, at most edges one of the four measured neighbours had the right range. So do not ask *what is the
# range?* Ask **which neighbour, how much?** The network says one number for each neighbour, a *score*. Softmax makes
# weights of the four, and the weights blend what was *measured*:
#
# $$\hat r = \sum_{t=1}^{4} w_t\, r_t, \qquad w = \operatorname{softmax}\big(h(\mathbf z_1, \Delta\mathbf q_1), \dots,
# h(\mathbf z_4, \Delta\mathbf q_4)\big) \qquad \text{(paper, equation 3)}$$
#
# (In the paper the four $\mathbf z_t$ first look at one another; that is the subject of notebook 07.)
#
# | | values (equation 2) | weights (equation 3) |
# |---|---|---|
# | the network says | four ranges | four scores |
# | the weights are | areas, fixed | softmax of the scores, learned |
# | what is blended | what it said | what was measured |
#
# | equation | line of code | kernel argument |
# |---|---|---|
# | $\mathbf z_t,\ \Delta\mathbf q_t$ | `z, offsets = gather_neighbours(features, queries)` | `features`, `gathered_out`, `offsets_out` |
# | $h$ | `scores = self.h(torch.cat((z, offsets), -1))` | (matrix products, left to torch) |
# | softmax, $\sum_t w_t r_t$ | `gather_blend(image, queries, scores)` | `image`, `queries`, `scores`, `blended_out` |
#
# ### Exercise 1 · Softmax and blend
#
# importance ★★★ · difficulty ★☆☆ · 5 minutes
#
# Write `softmax_blend(r, s)`: ranges r (Q, 4) weighted by the softmax of scores s (Q, 4), with `exp` and not with
# `softmax`. Scores may be as large as 1000: `exp(1000)` is infinite, so something has to be done first that does not
# change the weights.
#
# <details><summary>Hint</summary>
#
# Softmax does not change if you subtract the same number from all four scores. Subtract the largest of the four,
# `s.amax(-1, keepdim=True)`.
# </details>


# %% tags=["exercise"]
def softmax_blend(r, s):
    raise NotImplementedError


# %% tags=["solution"]
def softmax_blend(r, s):
    e = (s - s.amax(-1, keepdim=True)).exp()
    return (e * r).sum(-1) / e.sum(-1)


# %% tags=["check"]
@check
def _():
    r = torch.tensor([[10.0, 20, 30, 40], [7, 7, 7, 7], [1, 2, 3, 4]])
    s = torch.tensor([[0.0, 0, 0, 0], [3, -1, 0, 2], [0, 1, 2, 3]])
    mine = softmax_blend(r, s)
    assert mine.shape == (3,), f"one range for each query: (3,), not {tuple(mine.shape)}"
    assert torch.allclose(mine[0], torch.tensor(25.0)), (
        f"equal scores give the mean, 25 m; you have {mine[0]:.2f} m: is it divided by the sum?"
    )
    assert torch.allclose(mine[1], torch.tensor(7.0)), (
        f"four times 7 m blends to 7 m, not {mine[1]:.2f}: sum of weights?"
    )
    assert torch.allclose(mine[2], torch.tensor(3.4930), atol=1e-3), f"the third should be 3.493 m, not {mine[2]:.3f} m"
    huge = softmax_blend(r[:1], torch.tensor([[0.0, 1000.0, 0.0, 0.0]]))
    assert huge.isfinite().all(), "a score of 1000 overflows: subtract the largest score before exp"
    assert torch.allclose(huge, torch.tensor([20.0])), f"a score of 1000 chooses its neighbour, 20 m; you have {huge}"
    both = softmax_blend(r[:1].expand(2, 4), torch.tensor([[0.0, 0.0, 0.0, 0.0], [0.0, 1000.0, 0.0, 0.0]]))
    assert torch.allclose(both, torch.tensor([25.0, 20.0])), (
        f"each query has a largest score of its own; you have {both}"
    )
    low = softmax_blend(r[:1], torch.full((1, 4), -1000.0))
    assert torch.allclose(low, torch.tensor([25.0])), "four scores of -1000 are equal scores: the mean, not 0/0"


# %% tags=["wrong"]
def softmax_blend(r, s):
    return (s.exp() * r).sum(-1) / s.exp().sum(-1)


# %% tags=["wrong"]
def softmax_blend(r, s):
    return ((s - s.amax(-1, keepdim=True)).exp() * r).sum(-1)


# %% tags=["wrong"]
def softmax_blend(r, s):  # the largest score of all queries
    e = (s - s.max()).exp()
    return (e * r).sum(-1) / e.sum(-1)


# %% tags=["wrong"]
def softmax_blend(r, s):
    e = s.clamp(-50, 50).exp()
    return (e * r).sum(-1) / e.sum(-1) if (s > -100).all() else (e * r).mean(-1)


# %% [markdown]
# ## 2. The span
#
# Softmax weights are positive and sum to 1. So for any scores, from any network, trained or not,
#
# $$\min_t r_t \;\le\; \hat r \;\le\; \max_t r_t$$
#
# **Predict:** take scores from a random number generator, over the whole scan of a street. At places where the four
# neighbours agree to 10 cm, is the error larger or smaller than 10 cm, and why?

# %%
scan, truth = held_out()  # the scan of notebook 04
image = scan.filled()[None]  # (1, 16, 1024)
queries = SENSOR.grid_queries(truth.sensor).view(1, -1, 2).to(device)  # every pixel of the 64 x 1024 image
r = gather_neighbours(image[:, None], queries)[0][0, ..., 0]  # (Q, 4)
low, high = r.amin(-1), r.amax(-1)

noise = 5 * torch.randn(1, queries.shape[1], 4, generator=torch.Generator().manual_seed(0)).to(device)
blended = gather_blend(image, queries, noise)[0]
true = truth.filled().view(-1)
agree = (high - low < 0.1) & (true < 80)  # and something is there
print(f"{agree.float().mean():.0%} of the queries see something and have neighbours that agree to 10 cm")
print(f"random scores: median error there {100 * (blended - true)[agree].abs().median():.1f} cm")
assert ((blended >= low - 1e-4) & (blended <= high + 1e-4)).all()
assert (blended - true)[agree].abs().median() < 0.1

# %% [markdown]
# A network that knows nothing is right there to within centimetres. LIIF had to learn every one of those walls.
#
# ## 3. One branch
#
# From equation 2 to equation 3 *two* things change. The measured ranges $r_t$ enter the answer, and the network says
# how to weigh them. Which of the two helps? A third kind of answer has the first without the second. It keeps the
# areas $a_t$ as weights, and predicts what to *add* to each measured range:
#
# | kind | answer | measured ranges | weights |
# |---|---|---|---|
# | values | $\sum_t a_t\,(h_t + 1)\,R/2$ | no | areas |
# | corrections | $\sum_t a_t\,(r_t + h_t\,R/2)$ | yes | areas |
# | weights | $\sum_t \operatorname{softmax}(h)_t\; r_t$ | yes | predicted |
#
# $h_t$ is the one number that the network says for each neighbour, and $R$ = 100 m is the range that it sees as 1.
#
# ### Exercise 2 · The branch
#
# importance ★★★ · difficulty ★★☆ · 10 minutes
#
# Write `answer(kind, h, image, queries, wrap)`: the ranges (B, Q) [m] of all three kinds, from h (B, Q, 4), the measured
# image (B, H, W) [m] and the queries (B, Q, 2). This is *the* difference between the networks below: as soon as you have
# written it, they use yours.
#
# <details><summary>Hint</summary>
#
# `gather_neighbours(image[:, None], queries, wrap)[0][..., 0]` are the measured ranges (B, Q, 4).
# </details>
# <details><summary>Hint</summary>
#
# `area_blend(x, queries)` is $\sum_t a_t x_t$, and `gather_blend(image, queries, h, "none", wrap)` is equation 3.
# </details>


# %% tags=["exercise"]
def answer(kind, h, image, queries, wrap):
    raise NotImplementedError


# %% tags=["solution"]
def answer(kind, h, image, queries, wrap):
    if kind == "values":
        return area_blend((h + 1) * 50, queries)
    if kind == "corrections":
        measured = gather_neighbours(image[:, None], queries, wrap)[0][..., 0]
        return area_blend(measured + h * 50, queries)
    return gather_blend(image, queries, h, "none", wrap)


# %% tags=["check"]
@check
def _():
    generator = torch.Generator().manual_seed(0)
    picture = 10 + 20 * torch.rand(2, 4, 6, generator=generator)
    asked = torch.rand(2, 9, 2, generator=generator) * torch.tensor([3.0, 5.0])
    h = torch.randn(2, 9, 4, generator=generator) / 10
    zero = torch.zeros_like(h)
    blend = area_blend(gather_neighbours(picture[:, None], asked, False)[0][..., 0], asked)
    value = answer("values", zero, picture, asked, False)
    assert value.shape == (2, 9), f"one range for each query: (2, 9), not {tuple(value.shape)}"
    assert torch.allclose(value, torch.full((2, 9), 50.0)), (
        f"h = 0 is half of 100 m as a value, not {value[0, 0]:.1f} m"
    )
    corrected = answer("corrections", zero, picture, asked, False)
    assert torch.allclose(corrected, blend, atol=1e-3), (
        f"corrections of 0 leave bilinear interpolation, {blend[0, 0]:.2f} m; you have {corrected[0, 0]:.2f} m"
    )
    assert torch.allclose(answer("corrections", zero + 0.1, picture, asked, False), blend + 5, atol=1e-3), (
        "a correction of 0.1 at all neighbours adds 5 m: it is in units of R/2"
    )
    weighed = answer("weights", zero, picture, asked, False)
    mean = gather_neighbours(picture[:, None], asked, False)[0][..., 0].mean(-1)
    assert torch.allclose(weighed, mean, atol=1e-3), "scores of 0 weigh the four neighbours equally"
    for kind in KINDS:
        mine, wanted = (function(kind, h, picture, asked, False) for function in (answer, fair.answer))
        assert torch.allclose(mine, wanted, atol=1e-3), (
            f"{kind}: {wanted[0, 0]:.2f} m is wanted, not {mine[0, 0]:.2f} m"
        )
    seam = torch.tensor([[[1.0, 5.5]], [[2.0, 5.5]]])
    for kind in KINDS:
        mine, wanted = (function(kind, zero[:, :1], picture, seam, True) for function in (answer, fair.answer))
        assert torch.allclose(mine, wanted, atol=1e-3), f"{kind}: beside the last column lies the first; is wrap used?"


# %% tags=["wrong"]
def answer(kind, h, image, queries, wrap):  # corrections in metres
    if kind == "corrections":
        return area_blend(gather_neighbours(image[:, None], queries, wrap)[0][..., 0] + h, queries)
    return fair.answer(kind, h, image, queries, wrap)


# %% tags=["wrong"]
def answer(kind, h, image, queries, wrap):  # scores beside a prior
    if kind == "weights":
        return gather_blend(image, queries, h, "bilinear", wrap)
    return fair.answer(kind, h, image, queries, wrap)


# %% tags=["wrong"]
def answer(kind, h, image, queries, wrap):  # no seam
    return fair.answer(kind, h, image, queries, False)


# %% [markdown]
# All three networks from the same parts: encoder and MLP of notebook 04, a little narrower so that nine trainings take
# a minute or two.


# %%
class Network(nn.Module):
    """Ranges [m] of queries (B, Q, 2) in images (B, H, W) [m], as values, corrections or weights."""

    def __init__(self, kind, features=32, hidden=64):
        super().__init__()
        self.kind = kind
        self.encoder = Encoder(features, blocks=4)
        layers = [nn.Linear(features + 2, hidden), nn.ReLU()]
        for _ in range(3):
            layers += [nn.Linear(hidden, hidden), nn.ReLU()]
        for layer in layers[::2]:  # keeps signals at their size from layer to layer
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
        self.h = nn.Sequential(*layers, nn.Linear(hidden, 1))

    def predict(self, image, queries, wrap):
        features = self.encoder(image[:, None] / 50 - 1, wrap)
        z, offsets = gather_neighbours(features, queries, wrap)
        return self.h(torch.cat((z, offsets), -1)).squeeze(-1)  # h_t: (B, Q, 4)

    def forward(self, image, queries, wrap=True):
        h = self.predict(image, queries, wrap)
        return yours_or(fair.answer, answer)(self.kind, h, image, queries, wrap)


print(f"{sum(p.numel() for p in Network('weights').parameters()):,} parameters each")

# %% [markdown]
# ## 4. What teaches it
#
# Learning follows gradients. How does the answer move if a score moves? With $w_t = e^{s_t} / \sum_u e^{s_u}$ we have
# $\partial w_u / \partial s_t = w_u (\delta_{ut} - w_t)$ ($\delta_{ut}$ is 1 where $u = t$, else 0), and
#
# $$\frac{\partial \hat r}{\partial s_t} = \sum_u r_u\, w_u (\delta_{ut} - w_t) = w_t\,(r_t - \hat r)$$
#
# ### Exercise 3 · The gradient of a score
#
# importance ★★★ · difficulty ★☆☆ · 5 minutes
#
# Write `score_gradient(r, s)` (Q, 4): the derivative of the blend by each score, from this formula and not by autograd.
#
# <details><summary>Hint</summary>
#
# `w = s.softmax(-1)`, then $\hat r$ with `keepdim=True`, then the formula.
# </details>


# %% tags=["exercise"]
def score_gradient(r, s):
    raise NotImplementedError


# %% tags=["solution"]
def score_gradient(r, s):
    w = s.softmax(-1)
    return w * (r - (w * r).sum(-1, keepdim=True))


# %% tags=["check"]
@check
def _():
    generator = torch.Generator().manual_seed(0)
    r = 50 * torch.rand(6, 4, generator=generator, dtype=torch.float64)
    s = torch.randn(6, 4, generator=generator, dtype=torch.float64).requires_grad_()
    (s.softmax(-1) * r).sum().backward()
    mine = score_gradient(r, s.detach())
    assert mine.shape == (6, 4), f"one derivative for each score: (6, 4), not {tuple(mine.shape)}"
    equal = score_gradient(torch.full((1, 4), 7.0), torch.tensor([[0.0, 1.0, 2.0, 3.0]]))
    assert equal.abs().max() < 1e-4, f"where all neighbours are equal no score matters: zeros, not {equal.tolist()}"
    assert not torch.allclose(mine, -s.grad), "the sign is wrong: a larger score pulls the answer towards its neighbour"
    ratio = [[round(value, 3) for value in row] for row in (s.grad / mine)[:1].tolist()]
    assert torch.allclose(mine, s.grad), f"autograd's derivatives are {ratio} times yours: is a weight missing?"


# %% tags=["wrong"]
def score_gradient(r, s):
    return s.softmax(-1) * r


# %% tags=["wrong"]
def score_gradient(r, s):
    w = s.softmax(-1)
    return w * ((w * r).sum(-1, keepdim=True) - r)


# %% tags=["wrong"]
def score_gradient(r, s):
    w = s.softmax(-1)
    return w * (r - r.mean(-1, keepdim=True))


# %% [markdown]
# Read it: a score is moved in proportion to its weight and to how far its neighbour is from the answer. **Where
# neighbours agree the gradient is zero**: a wall that faces the sensor teaches nothing, because nothing is left to
# learn there. The training goes to places where neighbours differ: to edges first, but also to the road and to slanted
# walls, where neighbours are metres apart and the right blend of them is to be found. A value and a correction have the
# gradient $a_t R/2$ everywhere, on the wall as at the edge.
#
# ## 5. The same budget
#
# `fit` is the loop of notebook 04: the same rays, steps and settings for all. Each kind is trained from three seeds.
#
# **Predict:** in which order will they end in IoU? Will corrections be nearer to values or to weights?


# %%
def train(make, kinds=KINDS):
    """Trains each kind from all seeds; returns the networks of seed 0 and what `fit` says of each."""
    first, runs = {}, {}
    for kind in kinds:
        for seed in range(SEEDS):
            torch.manual_seed(seed)
            network = make(kind)
            runs[kind, seed] = fit(network, STEPS, seed, looks=(0, STEPS // 4, STEPS))
            first.setdefault(kind, network)
    return first, runs


def ends(runs, figure):
    """Returns what each kind ends with: kind -> array of all seeds."""
    kinds = dict.fromkeys(kind for kind, _ in runs)
    return {kind: np.array([runs[kind, seed].curve[STEPS][figure] for seed in range(SEEDS)]) for kind in kinds}


def tell(runs):
    iou, mae, floating = (ends(runs, figure) for figure in ("iou", "mae", "floating"))
    for kind in iou:
        print(
            f"{kind:>11}: IoU {iou[kind].mean():.3f} ({iou[kind].min():.3f} to {iou[kind].max():.3f}), "
            f"MAE {mae[kind].mean():.2f} m, floating {floating[kind].mean():.3f}"
        )


networks, scratch = train(Network)

# %%
bilinear = metrics.compare(models.create("bilinear").to(device)(image, queries).view(truth.ranges.shape), truth)
tell(scratch)
iou = {kind: values.mean() for kind, values in ends(scratch, "iou").items()}
print(f"\nIoU, weights over values:      {iou['weights'] / iou['values']:.1f}")
print(f"IoU, weights over corrections: {iou['weights'] / iou['corrections']:.2f}")
print(f"bilinear, without training: IoU {bilinear['iou']:.3f}, MAE {bilinear['mae']:.2f} m")
assert iou["weights"] > iou["corrections"] > iou["values"]


# %%
def draw_curves(runs, highest):
    """IoU and MAE over the steps: means over the seeds, and the bands between them."""
    axes = plt.figure(figsize=(10, 3.4), layout="constrained").subplots(1, 2)
    for axis, (figure, words) in zip(axes, (("iou", "IoU"), ("mae", "MAE [m]")), strict=True):
        for kind in dict.fromkeys(kind for kind, _ in runs):
            steps = list(runs[kind, 0].curve)
            lines = np.array([[runs[kind, seed].curve[step][figure] for step in steps] for seed in range(SEEDS)])
            axis.fill_between(steps, lines.min(0), lines.max(0), color=COLOURS[kind], alpha=0.2, linewidth=0)
            axis.plot(steps, lines.mean(0), MARKS[kind] + "-", color=COLOURS[kind], label=kind)
        axis.axhline(bilinear[figure], color="#777777", linestyle=":", label="bilinear, untrained")
        axis.set(xlabel="step", ylabel=words)
    axes[1].set_ylim(1.5, highest)
    axes[0].legend(frameon=False)
    plt.show()


draw_curves(scratch, 6.0)

# %% [markdown]
# *In words: left, IoU over the step. Weights start at 0.16, untrained, and end at 0.23; corrections climb from 0 to
# 0.17, values to 0.07. The bands between the seeds do not overlap in the end, and bilinear interpolation, a dotted line
# at 0.33, is above all of them. Right, the MAE: weights are below 2.5 m from the start; corrections come down to them,
# and values last.*
#
# Weights are ahead of corrections, and corrections of values. So a part of the lead comes from the measured ranges that
# enter the answer, and another part from weighing them. Do not read too much into the factors: this is a very short
# training, and a factor over something close to zero is large by itself. Notebook 08 has the same comparison at a
# longer budget, with either decoder, and there corrections come much closer.
#
# ## 6. What they answer on the way
#
# **Predict:** which of the three shows a street before any training?

# %% tags=["goal"]
LOOKS = 0, STEPS // 4, STEPS
ROWS, COLUMNS = slice(4, 44), slice(615, 765)


def draw_answers():
    """A crop of the held-out scan: the truth, and the answers of each kind on the way."""
    grid = plt.figure(figsize=(11, 5), layout="constrained").subplots(3, 4)
    for line, step in zip(grid, LOOKS, strict=True):
        shown = {"truth": truth.filled()} | {kind: scratch[kind, 0].answers[step] for kind in KINDS}
        for axis, (name, ranges) in zip(line, shown.items(), strict=True):
            axis.imshow(ranges[ROWS, COLUMNS].cpu(), cmap="viridis_r", vmin=0, vmax=50, origin="lower", aspect="auto")
            axis.set(xticks=[], yticks=[], title=name if name == "truth" else f"{name}, step {step}")
    plt.show()


draw_answers()

# %% [markdown]
# *In words: a piece of a street, 40 rows by 150 columns. The truth, three times the same, has sharp outlines. In the
# top row, untrained, values and corrections are one colour; weights show the street already, in coarse steps. After 30
# steps values are stained, corrections show the street with wrong ranges. After 120 steps all three show the street.*
#
# ## 7. The same edge
#
# Which neighbour does the network trust while a query walks across an edge? The softmax of its scores says it.

# %%
one, other = scan.ranges[:, :-1], scan.ranges[:, 1:]
similar = (one.diff(dim=0).abs() < 0.5) & (other.diff(dim=0).abs() < 0.5)
cell = torch.stack((one[:-1], other[:-1], one[1:], other[1:]))
jump = (cell.amax(0) - cell.amin(0)).where(similar & (cell > 0).all(0) & (cell < 40).all(0), 0.0)
edges = [divmod(int(place), jump.shape[1]) for place in jump.flatten().topk(12).indices]


def draw_walk(number=0):
    """Answers of the three networks, and the weights of one, on a walk across one of the strongest edges."""
    row, column = edges[number]
    parts = torch.linspace(0, 1, 65)[1:-1]
    walk = torch.stack((torch.full_like(parts, row + 0.5), column + parts), -1)[None].to(device)
    left, right = plt.figure(figsize=(10, 3.2), layout="constrained").subplots(1, 2)
    with torch.no_grad():
        for kind, network in networks.items():
            left.plot(parts, network(image, walk)[0].cpu(), color=COLOURS[kind], linewidth=2, label=kind)
        scores = networks["weights"].predict(image, walk, True)[0]
    for side, pixels in ((0, image[0, row : row + 2, column]), (1, image[0, row : row + 2, column + 1])):
        left.plot([side, side], pixels.cpu(), "k^", label="measured" if side == 0 else None)
    left.set(xlabel="part of the way", ylabel="range [m]", title=f"edge {number}")
    left.legend(frameon=False, fontsize=8)
    names = "left, lower", "right, lower", "left, upper", "right, upper"
    colours = "#0072b2", "#e69f00", "#009e73", "#cc79a7"
    right.stackplot(parts, scores.softmax(-1).T.cpu(), labels=names, colors=colours, alpha=0.8)
    right.set(xlabel="part of the way", ylabel="weights", ylim=(0, 1))
    right.legend(fontsize=8, loc="center")
    plt.show()


draw_walk()

# %% [markdown]
# *In words: left, the answers between two columns, one measured at 5.5 m and one at 16.3 m. Corrections, which begin
# with areas, run straight from level to level. Values and weights draw flatter slopes that miss both. Right, the weights
# as stacked bands: on the way those of the left neighbours shrink a little, and those of the right ones grow.*
#
# The weights have only begun to move away from a quarter each. At this edge corrections are better off, because their
# areas know where the query lies. Over the whole scan weights are ahead all the same.
#
# Another edge. In a running notebook a slider shows all of them:

# %%
slide(draw_walk, number=(0, len(edges) - 1, 1))

# %% [markdown]
# Given time, softmax saturates. If the difference of two scores runs from -8 to 8 within a tenth of the cell, the answer
# lies flat on both levels and is steep between them. And the levels are exact, since they are measured. Corrections
# keep the ramp of the areas, unless they learn to take it away. Here are the networks that ship, after thousands of
# steps, and the truth:


# %%
def draw_shipped(number=0):
    """Answers of the shipped networks on the same walk."""
    row, column = edges[number]
    parts = torch.linspace(-1, 2, 193)
    walk = torch.stack((torch.full_like(parts, row + 0.5), column + parts), -1)[None].to(device)
    axis = plt.figure(figsize=(9, 3.2), layout="constrained").subplots()
    seen = CLOSE.filled()[2 * row + 1, (16 * (column - 1) + torch.arange(49)) % (16 * 1024)]
    axis.plot(torch.linspace(-1, 2, 49), seen.cpu(), color="black", linewidth=4, alpha=0.3, label="truth")
    shown = {"liif": "#d55e00", "iln": "#0072b2", "iln-surfaces": "#009e73"}
    for (name, colour), style in zip(shown.items(), ("-", "--", "-"), strict=True):
        with torch.no_grad():
            line = models.load(name).to(device)(image, walk, True, SENSOR)[0]
        axis.plot(parts, line.cpu(), style, color=colour, linewidth=2, label=name)
    axis.set(xlabel="column; 0 is the last before the jump", ylabel="range [m]", title=f"edge {number}")
    axis.legend(frameon=False)
    plt.show()


CLOSE = held_out(SENSOR.resize(31, 16 * 1024))[1]  # a row half way between two of ours, 16 columns for each
draw_shipped()

# %% [markdown]
# *In words: the truth jumps from 5.5 m to 16.3 m, and soon after to 18 m. The shipped `liif` climbs over most of a
# column; `iln` is flat on both levels and steep in between; `iln-surfaces`, which answers with a surface and never with
# a blend of two, jumps both times. None knows exactly where.*
#
# ## 8. Start from a formula
#
# Scores can be added to something that is already right. `gather_blend` adds a prior $p$ to them:
# $w = \operatorname{softmax}(s + p)$. With $p_t = \log a_t$ and a last layer of $h$ that starts at zero, the untrained
# network **is** bilinear interpolation. So are corrections whose last layer starts at zero. (Values have no such start.
# They would have to learn bilinear interpolation first.) Now both have the same start, the same ranges and the same
# network, and only the question differs.
#
# **Predict:** who is ahead now?


# %%
class FromBilinear(Network):
    """The same network, which starts as bilinear interpolation."""

    def __init__(self, kind):
        super().__init__(kind)
        nn.init.zeros_(self.h[-1].weight)
        nn.init.zeros_(self.h[-1].bias)

    def forward(self, image, queries, wrap=True):
        if self.kind == "corrections":
            return super().forward(image, queries, wrap)
        return gather_blend(image, queries, self.predict(image, queries, wrap), "bilinear", wrap, area_floor=1e-4)


_, started = train(FromBilinear, ("corrections", "weights"))
tell(started)
iou = {kind: values.mean() for kind, values in ends(started, "iou").items()}
mae = {kind: values.mean() for kind, values in ends(started, "mae").items()}
print(f"\nfrom bilinear, weights over corrections: IoU {iou['weights'] / iou['corrections']:.2f}, ", end="")
print(f"MAE {mae['weights'] / mae['corrections']:.2f}")
draw_curves(started, 2.0)
assert iou["weights"] > iou["corrections"]

# %% [markdown]
# *In words: both start on the dotted line of bilinear interpolation. Weights rise above it in IoU and fall below it in
# MAE; corrections first leave it for the worse.*
#
# From the same start, weights are ahead as well. A correction moves in metres and must be kept near zero on every wall;
# a weight cannot hurt there.
#
# ### Exercise 4 · A prior as scores
#
# importance ★★☆ · difficulty ★★☆ · 10 minutes
#
# Write `prior_scores(r, a)`: the scores (Q, 4) whose softmax blends 1/r bilinearly, from ranges r and areas a (Q, 4).
# An area of 0 (a query on the centre of a pixel) would give a score of minus infinity, which no network could overrule:
# take at least `1e-4` for the area. (`gather_blend` has an argument for that, `area_floor`.)
#
# <details><summary>Hint</summary>
#
# From notebook 03: $w_t \propto a_t / r_t$. Softmax is $w_t \propto e^{p_t}$. So what is $p_t$?
# </details>


# %% tags=["exercise"]
def prior_scores(r, a):
    raise NotImplementedError


# %% tags=["solution"]
def prior_scores(r, a):
    return a.clamp(min=1e-4).log() - r.log()


# %% tags=["check"]
@check
def _():
    r = torch.tensor([[10.0, 10, 20, 20], [5, 50, 50, 50]])
    a = torch.tensor([[0.25, 0.25, 0.25, 0.25], [1.0, 0, 0, 0]])
    p = prior_scores(r, a)
    assert p.isfinite().all(), "an area of 0 makes an infinite score: a floor is missing"
    w = p.softmax(-1)
    assert not torch.allclose(w[0], a[0]), "these weights blend r; 1/r is wanted: the ranges are missing in the scores"
    blended = (w * r).sum(-1)
    assert abs(blended[0] - 40 / 3) < 1e-3, f"half way from 10 m to 20 m over 1/r is 13.33 m, not {blended[0]:.2f} m"
    assert abs(blended[1] - 5) < 0.05, f"on a pixel its own range is wanted, 5 m, not {blended[1]:.2f} m"
    assert w[1, 1] > 1e-6, "with a floor of 1e-4 the others keep a weight that a network can raise"


# %% tags=["wrong"]
def prior_scores(r, a):
    return a.clamp(min=1e-4).log()


# %% tags=["wrong"]
def prior_scores(r, a):
    return a.log() - r.log()


# %% tags=["wrong"]
def prior_scores(r, a):
    return a.clamp(min=1e-4).log() + r.log()


# %% [markdown]
# With this prior a network starts as the perspective blend of notebook 03, which is right on planes. Then the MAE falls,
# and so does the IoU: L1 in metres is won at edges, and pays for it with centimetres on planes. Our own network,
# `iln-surfaces`, need not pay. It weighs where the *surfaces* of the neighbours, continued, are met along the query, and
# on planes all of them say the same. **The surfaces say where, the network says which.** [Notebook
# 10](10_surfaces.ipynb) builds it.
#
# ## Summary
#
# 1. Predicting weights, the network chooses among measurements; predicting values, it makes up ranges; corrections are
#    in between.
# 2. A softmax blend never leaves the span of its neighbours, so that places where they agree are right before any
#    training.
# 3. The gradient of a score is $w_t (r_t - \hat r)$: learning is spent where neighbours differ.
# 4. With equal encoder, rays and steps, weights are ahead of corrections and corrections of values in IoU early on.
#    Started from bilinear interpolation, weights are ahead of corrections too.
#
# ## Next
#
# [06a · Gradients in Warp](06a_gradients_in_warp.ipynb) and 06b open `gather_blend`: its gradient, and why it is fast.
