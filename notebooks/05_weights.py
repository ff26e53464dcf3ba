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
# ![Left, the answers of three networks for queries on the way from one column to the next, across an edge. Right, the
# weights of one of the three for the four neighbours, as stacked bands](pictures/05_weights.png)
#
# **Goal.** You change one branch of the network of notebook 04, so that it predicts *weights* instead of values, train
# both on the same rays, and look at the same edge again.
#
# **After this notebook you can**
#
# - write equation 3 of the paper, and say why its answer never leaves the span of the neighbours;
# - derive the gradient that teaches it, and say what it spends its training on;
# - show with your own training that weights are learned faster than values;
# - start a network from a formula instead of from nothing.
#
# | | |
# |---|---|
# | You know | [04 · Values](04_values.ipynb) |
# | Time | 30 minutes, and 20 for the exercises; one to two minutes to run |
# | Hardware | any computer; a CUDA GPU is used if there is one |

# %%
from itertools import islice

import matplotlib.pyplot as plt
import torch
from torch import nn

from ilnet import data, metrics, models, places
from ilnet.course import check, slide
from ilnet.models.encoder import Encoder
from ilnet.sensor import preset
from kernels import area_blend, gather_blend, gather_neighbours

FAST = True  # False: ten times the steps
STEPS = 120 if FAST else 1200
torch.manual_seed(0)
device = "cuda" if torch.cuda.is_available() else "cpu"
COLOURS = {"values (LIIF)": "#d55e00", "weights, the same MLP": "#cc79a7", "weights (ILN)": "#0072b2"}

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
# ★☆☆ · 5 minutes
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
SENSOR = preset("paper-16x1024")
pairs = places.held_out_scans(places.town("town05", device=device), 1, [SENSOR, preset("paper-64x1024")])
scan, truth = pairs[0]
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
# Both networks from the same parts. What differs is the branch at the end.


# %%
class Network(nn.Module):
    """Encoder and MLP of notebook 04; answers with values or with weights."""

    def __init__(self, weights, features=64, hidden=256, norm_range=100.0):
        super().__init__()
        self.weights, self.norm_range = weights, norm_range
        self.encoder = Encoder(features, blocks=4)
        layers = [nn.Linear(features + 2, hidden), nn.ReLU()]
        for _ in range(3):
            layers += [nn.Linear(hidden, hidden), nn.ReLU()]
        for layer in layers[::2]:  # keeps signals at their size from layer to layer
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
        self.h = nn.Sequential(*layers, nn.Linear(hidden, 1))

    def forward(self, image, queries, wrap=True):
        features = self.encoder(image[:, None] * (2 / self.norm_range) - 1, wrap)
        z, offsets = gather_neighbours(features, queries, wrap)
        said = self.h(torch.cat((z, offsets), -1)).squeeze(-1)  # (B, Q, 4)
        if self.weights:  # they are scores: softmax, and blend what was measured
            return gather_blend(image, queries, said, "none", wrap)
        return (area_blend(said, queries) + 1) * (self.norm_range / 2)  # they are values: blend them by area


torch.manual_seed(0)
networks = {
    "values (LIIF)": Network(weights=False),
    "weights, the same MLP": Network(weights=True),
    "weights (ILN)": models.create("iln", blocks=4),
}
for name, network in networks.items():
    print(f"{name:>22}: {sum(p.numel() for p in network.parameters()):,} parameters")

# %% [markdown]
# The third is the paper's network: instead of the MLP, the four neighbours first look at one another (*attention*,
# notebook 07). It has fewer parameters.
#
# ## 4. What teaches it
#
# Learning follows gradients. How does the answer move if a score moves? With $w_t = e^{s_t} / \sum_u e^{s_u}$ we have
# $\partial w_u / \partial s_t = w_u (\delta_{ut} - w_t)$ ($\delta_{ut}$ is 1 where $u = t$, else 0), and
#
# $$\frac{\partial \hat r}{\partial s_t} = \sum_u r_u\, w_u (\delta_{ut} - w_t) = w_t\,(r_t - \hat r)$$
#
# ### Exercise 2 · The gradient of a score
#
# ★☆☆ · 5 minutes
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
# walls, where neighbours are metres apart and the right blend of them is to be found. (Section 7 gives those away for
# nothing.) LIIF's gradient, $\partial \hat r / \partial h_t = S_t / S$ in the network's own units, is the same
# everywhere.
#
# ## 5. The same budget
#
# The same rays, the same steps, the same optimiser, for all three.
#
# **Predict:** who will be ahead in IoU in the end, and how will they do against bilinear interpolation (0.40 in
# notebook 04)?

# %%
streets = [places.town(name, device=device) for name in ("town01", "town02")]
rays = data.ContinuousRays(streets, SENSOR, crops=4, columns=64, queries=384, seed=0)
batches = list(islice(rays, STEPS))  # drawn once: all three see the very same


@torch.no_grad()
def judge(model):
    """MAE [m], IoU and share of floating points on the held-out scan."""
    found = metrics.ScanMetrics().to(device)
    for scan, truth in pairs:
        found.update(model(scan.filled()[None], queries).view(truth.ranges.shape), truth)
    return {name: value.item() for name, value in found.compute().items()}


def train(model, steps, rate=1e-3, validations=4):
    """Trains on rays at continuous directions; returns what `judge` said on the way, by step."""
    optimizer = torch.optim.Adam(model.parameters(), rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, steps)
    curve = {0: judge(model)}
    for step, batch in enumerate(batches[:steps], start=1):
        crops, asked, ranges = (t.to(device) for t in (batch.image, batch.queries, batch.ranges))
        loss = (model(crops, asked, wrap=batch.wrap) - ranges).abs().mean()  # metres
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % (steps // validations) == 0:
            curve[step] = judge(model)
    return curve


curves = {name: train(network.to(device), STEPS) for name, network in networks.items()}
for name, curve in curves.items():
    print(f"{name:>22}: MAE {curve[STEPS]['mae']:.2f} m, IoU {curve[STEPS]['iou']:.3f}")
last = {name: curve[STEPS]["iou"] for name, curve in curves.items()}
formula = judge(models.create("bilinear").to(device))["iou"]
print(f"{'bilinear, untrained':>22}: IoU {formula:.3f}")
print(f"\nIoU, ILN over LIIF: {last['weights (ILN)'] / last['values (LIIF)']:.1f}")
print(f"IoU, the same MLP, weights over values: {last['weights, the same MLP'] / last['values (LIIF)']:.1f}")
assert last["weights (ILN)"] > 1.2 * last["values (LIIF)"]
assert last["weights, the same MLP"] > last["values (LIIF)"]
assert curves["weights (ILN)"][STEPS]["mae"] < curves["values (LIIF)"][STEPS]["mae"]

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.4), layout="constrained")
left.axhline(formula, color="#999999", linestyle=":", label="bilinear, untrained")
for (name, curve), style in zip(curves.items(), ("v-", "s--", "o-"), strict=True):
    for axis, figure_name in ((left, "iou"), (right, "mae")):
        axis.plot(list(curve), [point[figure_name] for point in curve.values()], style, color=COLOURS[name], label=name)
left.set(xlabel="step", ylabel="IoU")
right.set(xlabel="step", ylabel="MAE [m]", ylim=(0, 10))
left.legend(frameon=False)
plt.show()

# %% [markdown]
# *In words: left, IoU over the step, with bilinear interpolation as a dotted line at 0.40. Both networks that predict
# weights start at 0.14, untrained: the mean of the four neighbours. ILN climbs steeply to 0.28 in 60 steps and stays
# there, the MLP climbs slowly; the network that predicts values stays close to zero. Right, the MAE: LIIF starts
# outside of the picture and comes down towards the others' level late.*
#
# Weights are learned much faster than values. How much faster is hard to say from one run: LIIF's IoU depends on the
# seed and lies between 0.01 and 0.09 here, so that the factor is anything from 3 to nearly 30. (The paper has 1.3 at
# this size, after days of training.) And in so few steps ILN, too, is behind bilinear interpolation in IoU, though not
# in MAE. Section 7 helps.
#
# (The MLPs start from larger weights than PyTorch's own. To LIIF that makes no difference beyond that of another seed;
# the MLP that says scores would have learned next to nothing in so few steps.)
#
# ## 6. The same edge
#
# Which neighbour does ILN trust while a query walks across an edge? Its weights say it. The answer is linear in the
# measured ranges, so $w_t = \partial \hat r / \partial r_t$: we get them by a derivative. (`encode` is the part of the
# network that sees the image, `decode` the part that answers queries.)


# %% tags=["goal"]
def weights_of(network, image, queries):
    """The weights (Q, 4) of a network that was built with scores, by the derivative of its answer by the ranges."""
    ranges = image.clone().requires_grad_()
    features = network.encode(image, True)
    answer = network.decode(features, ranges, queries, True)
    rows = []
    for q in range(queries.shape[1]):
        [gradient] = torch.autograd.grad(answer[0, q], ranges, retain_graph=True)  # w_t at the pixel of neighbour t
        rows.append(gather_neighbours(gradient[:, None], queries[:, q : q + 1])[0][0, 0, :, 0])
    return answer.detach()[0], torch.stack(rows)


one, other = scan.ranges[:, :-1], scan.ranges[:, 1:]
similar = (one.diff(dim=0).abs() < 0.5) & (other.diff(dim=0).abs() < 0.5)
cell = torch.stack((one[:-1], other[:-1], one[1:], other[1:]))
jump = (cell.amax(0) - cell.amin(0)).where(similar & (cell > 0).all(0) & (cell < 40).all(0), 0.0)
edges = [divmod(int(place), jump.shape[1]) for place in jump.flatten().topk(12).indices]


def draw_walk(number=0):
    """Answers of all networks, and the weights of ILN, on a walk across one of the strongest edges."""
    row, column = edges[number]
    parts = torch.linspace(0, 1, 33)[1:-1]
    walk = torch.stack((torch.full_like(parts, row + 0.5), column + parts), -1)[None].to(device)
    left, right = plt.figure(figsize=(10, 3.2), layout="constrained").subplots(1, 2)
    for (name, network), style in zip(networks.items(), ("-", "--", "-"), strict=True):
        with torch.no_grad():
            left.plot(parts, network(image, walk)[0].cpu(), style, color=COLOURS[name], linewidth=2, label=name)
    for side, pixels in ((0, image[0, row : row + 2, column]), (1, image[0, row : row + 2, column + 1])):
        left.plot([side, side], pixels.cpu(), "k^", label="measured" if side == 0 else None)
    left.set(xlabel="part of the way", ylabel="range [m]", title=f"edge {number}")
    left.legend(frameon=False, fontsize=8)
    weights = weights_of(networks["weights (ILN)"], image, walk)[1].cpu()
    names = "left, lower", "right, lower", "left, upper", "right, upper"
    colours = "#0072b2", "#e69f00", "#009e73", "#cc79a7"
    right.stackplot(parts, weights.T, labels=names, colors=colours, alpha=0.8)
    right.set(xlabel="part of the way", ylabel="weights of ILN", ylim=(0, 1))
    right.legend(fontsize=8, loc="center")
    plt.show()


draw_walk()

# %% [markdown]
# *In words: left, the answers between two columns, one measured at 5.5 m and one at 16.3 m. LIIF and the MLP draw
# almost straight slopes; ILN's curve comes closer to both levels and is steeper between them. Right, its weights as
# stacked bands: those of the left neighbours shrink on the way and those of the right ones grow.*
#
# Another edge. In a running notebook a slider shows all of them:

# %%
slide(draw_walk, number=(0, len(edges) - 1, 1))

# %% [markdown]
# After so short a training the step is still soft. See what `FAST = False` makes of it. Scores are continuous in the
# offset, too, so that it will always be a ramp; but softmax saturates. If the difference of two scores runs from -8 to
# 8 within a tenth of the cell, the answer lies flat on both levels and is steep between them. And the levels are exact,
# since they are measured. LIIF would have to say both levels *and* the ramp.
#
# ## 7. Start from a formula
#
# Scores can be added to something that is already right. `gather_blend` adds a prior $p$ to them:
# $w = \operatorname{softmax}(s + p)$. If the last layer of $h$ starts at zero, the untrained network **is** the formula
# behind the prior, and training only has to learn where to deviate from it.
#
# **Predict:** it starts as the perspective blend of notebook 03, which is right on planes. Will 120 steps of training
# raise its MAE, its IoU, both?

# %%
torch.manual_seed(0)
perspective = models.create("iln", prior="perspective", blocks=4).to(device)
with torch.no_grad():
    off = (perspective(image, queries) - models.create("bilinear-inverse")(image, queries)).abs().mean()
print(f"untrained, and bilinear over inverse range: {1000 * off:.1f} mm apart in the mean")
assert off < 1e-2

curve = train(perspective, STEPS)
for name, point in (("untrained", curve[0]), ("trained", curve[STEPS])):
    print(f"iln with a prior, {name:>9}: MAE {point['mae']:.2f} m, IoU {point['iou']:.3f}")
assert curve[0]["iou"] > last["weights (ILN)"] or not FAST
assert curve[STEPS]["mae"] < curve[0]["mae"]

# %% [markdown]
# It starts where ILN would be after a long training. Then the MAE falls, and so does the IoU: L1 in metres is won at
# edges, where errors are large, and pays for it with centimetres on planes, which is what 10 cm cubes count. Our own
# network, `iln-surfaces`, need not pay: it weighs where the *surfaces* of the neighbours, continued, are met along the
# query (`kernels.surfaces`). On planes all of them say the same. **The surfaces say where, the network says which.** It
# stands beside the others in notebook 08.

# %% [markdown]
# ### Exercise 3 · A prior as scores
#
# ★★☆ · 10 minutes
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
# ## Summary
#
# 1. Predicting weights, the network chooses among measurements; predicting values, it makes up ranges.
# 2. A softmax blend never leaves the span of its neighbours, so that places where they agree are right before any
#    training.
# 3. The gradient of a score is $w_t (r_t - \hat r)$: learning is spent where neighbours differ.
# 4. With equal encoder, rays and steps, weights are far ahead of values in IoU early on. A network that starts from a
#    formula starts further still.
#
# ## Next
#
# [06a · Gradients in Warp](06a_gradients_in_warp.ipynb) and 06b open `gather_blend`: its gradient, and why it is fast.
