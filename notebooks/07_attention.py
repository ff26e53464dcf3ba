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
# # 07 · Attention among four neighbours
#
# ![Left, ranges along a row across the edge of a pillar: the truth, bilinear interpolation and a network. Right, the
# weights of the four neighbours while the query crosses the cell of that edge, as stacked
# bands](pictures/07_attention.png)
#
# **Goal.** You build the network that predicts the scores, write a kernel of its backward pass, see what attention can
# add, and cut its work to half without changing what it computes.
#
# **After this notebook you can**
#
# - write multi-head attention among four tokens in a few lines, and as a kernel with one thread per query and head;
# - derive the backward pass of attention, and write one term of it as a kernel;
# - say what a network without attention (D = 0) cannot know;
# - count multiply-adds, and hoist a projection out of a loop over queries into one over pixels;
# - tell a difference between trained networks from noise.
#
# | | |
# |---|---|
# | You know | weights (05), a fused op (06b); `nn.Module`, `nn.Linear`, `nn.LayerNorm` |
# | Time | 45 minutes, and 50 for the exercises; a minute to run |
# | Hardware | any computer; a CUDA GPU is used if there is one |
#
# Most sections ask you for a prediction. Write it down before you run the next cell.

# %%
import csv
import math
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
import warp as wp
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

import ilnet
from ilnet import data, metrics, models, places
from ilnet.course import check, draw_trace, run, slide
from ilnet.models.base import OFFSET_SCALE
from ilnet.sensor import angles_to_directions, preset
from kernels import attend_neighbours, gather_neighbours, neighbour_attention, project_pixels
from kernels.launch import initialise

FAST = True  # False: ten times the steps in section 5
initialise()  # starts Warp without its greeting
device = "cuda" if torch.cuda.is_available() else "cpu"

# %% [markdown]
# ## 1. Four tokens
#
# The encoder gives every pixel a feature vector $z$ of $C = 64$ numbers. A query asks its four neighbours. Each becomes
# a *token*: its feature, plus where the query lies as seen from it, the offset $\delta_t$ in pixels (notebook 04's
# $\Delta\mathbf q_t$), brought to 64 numbers by a linear layer (the *position embedding*):
#
# $$x_t = z_t + W \delta_t + b, \qquad t = 0 \ldots 3$$
#
# D *blocks* follow, each made of two steps which add to the tokens what they found:
#
# $$x \leftarrow x + O\,\operatorname{attend}(M\,\mathrm{LN}(x)), \qquad x \leftarrow x + \mathrm{FF}(\mathrm{LN}(x))$$
#
# LN is a layer norm. $M$ makes a query, a key and a value of each token, $O$ brings the result back, FF is a linear
# layer, GELU, and another linear layer. In each of 8 *heads*, which share the 64 numbers, $d = 64 / 8 = 8$ for each,
# token i asks all tokens j how well their keys fit its query, and takes the mean of their values by these weights:
#
# $$P_{ij} = \operatorname{softmax}_j\!\left(\frac{\mathbf q_i \cdot \mathbf k_j}{\sqrt{d}}\right), \qquad
#   \operatorname{attend}_i = \sum_j P_{ij}\,\mathbf v_j$$
#
# (Two things are called query here: the direction that is asked of the network, and $\mathbf q_i$, which a token asks
# of the other tokens. Both uses are common.) At last a linear layer scores each token (`head` in the code, which has
# nothing to do with the 8 heads), and the softmax of the four scores weighs the ranges, as in notebook 05. All of it
# fits one screen:


# %%
class Block(nn.Module):
    def __init__(self, channels, heads):
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(channels)
        self.qkv = nn.Linear(channels, 3 * channels, bias=False)  # M
        self.out = nn.Linear(channels, channels)  # O
        self.feed_forward = nn.Sequential(
            nn.LayerNorm(channels), nn.Linear(channels, channels), nn.GELU(), nn.Linear(channels, channels)
        )

    def forward(self, x):  # (Q, 4, C)
        q, k, v = self.qkv(self.norm(x)).unflatten(-1, (3, self.heads, -1)).unbind(-3)  # (Q, 4, heads, d) each
        logits = torch.einsum("nihd,njhd->nhij", q, k) / math.sqrt(q.shape[-1])
        attended = torch.einsum("nhij,njhd->nihd", logits.softmax(-1), v).flatten(-2)
        x = x + self.out(attended)
        return x + self.feed_forward(x)


class Decoder(nn.Module):
    def __init__(self, depth, channels=64, heads=8):
        super().__init__()
        self.position = nn.Linear(2, channels)  # W, b
        self.blocks = nn.ModuleList(Block(channels, heads) for _ in range(depth))
        self.head = nn.Sequential(nn.LayerNorm(channels), nn.Linear(channels, 1))

    def scores(self, z, offsets):  # (Q, 4, C), (Q, 4, 2)
        x = z + self.position(OFFSET_SCALE * offsets)  # the authors measure offsets in half pixels: a scale of 2
        for block in self.blocks:
            x = block(x)
        return self.head(x).squeeze(-1)  # (Q, 4)

    def forward(self, z, offsets, ranges):
        return (self.scores(z, offsets).softmax(-1) * ranges).sum(-1)


# %% [markdown]
# Is that the network of the paper? We copy the weights of `ilnet.models.ILN`, which runs on fused kernels, into ours
# and ask both the same. The parameters come in the same order, after those of the encoder.


# %%
def copy_of(model):
    """Our decoder with the weights of a model."""
    decoder = Decoder(len(model.blocks)).to(device)
    theirs = [p for name, p in model.named_parameters() if not name.startswith("encoder")]
    for mine, other in zip(decoder.parameters(), theirs, strict=True):
        mine.data.copy_(other.data)
    return decoder


def ask(decoder, model, image, queries):
    """Ranges of one image (H, W) along queries (Q, 2): the encoder is the model's, what follows is ours."""
    features = model.encode(image[None], wrap=True).features
    z, offsets = gather_neighbours(features, queries[None])
    ranges, _ = gather_neighbours(image[None, None], queries[None])
    return decoder(z[0], offsets[0], ranges[0, ..., 0])


torch.manual_seed(0)
image = 5 + 20 * torch.rand(16, 64, device=device)
queries = torch.rand(500, 2, device=device) * torch.tensor([15.0, 64.0], device=device)
for depth in (0, 1, 2):
    model = models.create("iln", depth=depth, blocks=2).to(device)
    with torch.no_grad():
        difference = (ask(copy_of(model), model, image, queries) - model(image[None], queries[None])[0]).abs().max()
    print(f"D = {depth}: largest difference {difference:.1e} m")
    assert difference < 1e-3

# %% [markdown]
# ### Exercise 1 · Attention that ignores
#
# importance ★★☆ · difficulty ★★☆ · 10 minutes
#
# A laser that met nothing has no surface to speak of. Write one head of attention in which some of the four tokens are
# not listened to: `attend(q, k, v, valid)` with `q`, `k`, `v` (N, 4, d) and `valid` (N, 4), True for tokens to listen
# to. Token i takes the mean of the values of the *valid* tokens j, weighed by the softmax of
# $\mathbf q_i \cdot \mathbf k_j / \sqrt d$ over these j alone. Where no token is valid the result is 0. Return (N, 4,
# d).
#
# <details><summary>Hint: leaving a token out</summary>
#
# A logit of $-\infty$ has weight 0: `logits.masked_fill(~valid[:, None, :], -math.inf)`, with the mask along j.
#
# </details>
# <details><summary>Hint: nothing valid</summary>
#
# A softmax of four times $-\infty$ is NaN. `weights.nan_to_num(0.0)`, or fill with 0 where `valid` is False everywhere.
#
# </details>


# %% tags=["exercise"]
def attend(q, k, v, valid):
    raise NotImplementedError


# %% tags=["solution"]
def attend(q, k, v, valid):
    logits = torch.einsum("nid,njd->nij", q, k) / math.sqrt(q.shape[-1])
    logits = logits.masked_fill(~valid[:, None, :], -math.inf)
    weights = logits.softmax(-1).nan_to_num(0.0)  # no valid token: softmax of nothing
    return torch.einsum("nij,njd->nid", weights, v)


# %% tags=["check"]
@check
def _():
    generator = torch.Generator().manual_seed(1)
    q, k, v = torch.randn(3, 6, 4, 8, generator=generator)
    everyone = torch.ones(6, 4, dtype=torch.bool)
    together = torch.stack((q, k, v), 2).flatten(2)  # (6, 4, 3 d)
    answer = attend(q, k, v, everyone)
    assert answer.shape == v.shape, f"the result has shape {tuple(answer.shape)}; it should be {tuple(v.shape)}"
    same = torch.allclose(answer, attend_neighbours(together, heads=1, backend="torch"), atol=1e-5)
    assert same, "with all tokens valid it differs from attention: is the sum over j, and the scale 1/sqrt(d)?"
    turned = [2, 0, 3, 1]
    moved = attend(q[:, turned], k[:, turned], v[:, turned], everyone)
    assert torch.allclose(moved, answer[:, turned], atol=1e-5), (
        "tokens in another order: the same results in that order"
    )
    assert attend(1e4 * q, k, v, everyone).isfinite().all(), (
        "huge logits overflow: torch's softmax takes care, exp does not"
    )
    some = torch.tensor([True, False, True, True]).expand(6, 4)
    loud = v.clone()
    loud[:, 1] = 1e6
    assert torch.allclose(attend(q, k, v, some), attend(q, k, loud, some)), (
        "token 1 is not valid, and yet was listened to: is the mask along j?"
    )
    ones = attend(q, k, torch.ones_like(v), some)
    assert torch.allclose(ones, torch.ones_like(v), atol=1e-5), "values of 1: the weights of the valid tokens sum to 1"
    nobody = attend(q, k, v, torch.zeros(6, 4, dtype=torch.bool))
    assert torch.equal(nobody, torch.zeros_like(v)), "where no token is valid the result is 0"


# %% tags=["wrong"]
def attend(q, k, v, valid):  # masked after the softmax: weights no longer sum to 1
    weights = (torch.einsum("nid,njd->nij", q, k) / math.sqrt(q.shape[-1])).softmax(-1)
    return torch.einsum("nij,njd->nid", weights * valid[:, None, :], v)


# %% tags=["wrong"]
def attend(q, k, v, valid):  # the tokens that ask are masked, not those that answer
    logits = torch.einsum("nid,njd->nij", q, k) / math.sqrt(q.shape[-1])
    weights = logits.masked_fill(~valid[:, :, None], -math.inf).softmax(-1).nan_to_num(0.0)
    return torch.einsum("nij,njd->nid", weights, v)


# %% tags=["wrong"]
def attend(q, k, v, valid):  # exp overflows
    weights = (torch.einsum("nid,njd->nij", q, k) / math.sqrt(q.shape[-1])).exp() * valid[:, None, :]
    return torch.einsum("nij,njd->nid", weights / weights.sum(-1, keepdim=True).clamp(min=1e-9), v)


# %% [markdown]
# ## 2. What D = 0 cannot know
#
# Without blocks nothing passes between the tokens: the score of a neighbour is a function of that neighbour alone,
# $s_t = g(z_t + W \delta_t + b)$. The weights are still a softmax over all four, so they do compete. But how much one
# is preferred over another, $w_0 / w_1 = e^{s_0 - s_1}$, cannot depend on the other two. With a block, $s_0$ may say "I
# am the nearer of two surfaces" or "all four of us agree".
#
# **Predict:** we change the feature of neighbour 3 only. Which scores change for D = 0, for D = 1?

# %%
torch.manual_seed(1)
z, offsets = torch.randn(200, 4, 64, device=device), torch.rand(200, 4, 2, device=device)
changed = z.clone()
changed[:, 3] = torch.randn(200, 64, device=device)
figure, axes = plt.subplots(figsize=(7, 2.6), layout="constrained")
for depth, colour, hatch in ((0, "#999999", ""), (1, "#0072b2", "///")):
    decoder = Decoder(depth).to(device)
    with torch.no_grad():
        moved = (decoder.scores(changed, offsets) - decoder.scores(z, offsets)).abs().mean(0).cpu()
    axes.bar(torch.arange(4) + 0.4 * depth - 0.2, moved, 0.38, color=colour, hatch=hatch, label=f"D = {depth}")
    print(f"D = {depth}: mean change of the four scores {[round(x, 4) for x in moved.tolist()]}")
    assert moved[3] > 0.01
    assert (moved[:3].max() < 1e-6) == (depth == 0)
axes.set(
    xlabel="neighbour", ylabel="mean change of its score", xticks=range(4), title="the feature of neighbour 3 changed"
)
axes.legend(frameon=False, loc="upper left")
plt.show()

# %% [markdown]
# *In words: bars for four neighbours. The score of neighbour 3 changes much at both depths; those of neighbours 0 to 2
# change a little at D = 1, and not at all at D = 0.*
#
# The encoder softens this: a feature has seen the pixels around its own, so neighbours know of each other even at D =
# 0. But the encoder does not know the query. Attention compares the four once the query is known.
#
# ## 3. What it costs
#
# A frame of 128 × 2048 queries has 4 · 262144 tokens. Count the multiply-adds for *one query*, that is for four tokens;
# a matrix of a × b costs a · b for each token. C = 64:
#
# | step | multiply-adds per query | C = 64 |
# |---|---|---|
# | position embedding | 4 · 2 C | 512 |
# | queries, keys, values $M$ | 4 · 3 C² | 49,152 |
# | logits, all heads together | 4 · 4 C | 1,024 |
# | mean of the values | 4 · 4 C | 1,024 |
# | output $O$ | 4 · C² | 16,384 |
# | feed-forward | 4 · 2 C² | 32,768 |
# | head | 4 · C | 256 |
#
# **Predict:** which row would you attack first?
#
# PyTorch counts floating-point operations, two to a multiply-add:


# %%
def count(depth, channels=64, heads=8, queries=10):
    """Multiply-adds of our decoder per query, as PyTorch counts them."""
    z = torch.zeros(queries, 4, channels, device=device)
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        Decoder(depth, channels, heads).to(device).scores(z, z[..., :2])
    return counter.get_total_flops() / 2 / queries


for depth in (0, 1, 2):
    print(f"D = {depth}: {count(depth):9,.0f} multiply-adds per query, {count(depth) * 262144 / 1e9:6.2f} G per frame")
assert count(0) == 512 + 256
assert count(1) == 512 + 49152 + 2 * 1024 + 16384 + 32768 + 256

# %% [markdown]
# Attention itself, the 4 × 4, is the smallest part of a block by this count; nearly half is $M$, with 24 times as many
# multiply-adds. The 4 × 4 also gets a kernel of its own, with one thread per query and head.


# %%
@wp.func
def softmax4(s: wp.vec4):
    """Weights of four scores, see notebook 06b."""
    w = s
    largest = wp.max(s)
    for t in range(4):
        w[t] = wp.exp(s[t] - largest)
    return w / (w[0] + w[1] + w[2] + w[3])


@wp.func
def attention_map(qkv: wp.array4d[float], n: int, h: int):
    """P (4, 4) of head h of query n."""
    p = wp.mat44()
    for i in range(4):
        logits = wp.vec4()
        for d in range(qkv.shape[3]):
            for j in range(4):
                logits[j] += qkv[n, 3 * i, h, d] * qkv[n, 3 * j + 1, h, d]
        p[i] = softmax4(logits / wp.sqrt(float(qkv.shape[3])))
    return p


@wp.kernel(module="unique", enable_backward=False)
def attend_kernel(
    # in
    qkv: wp.array4d[float],  # (Q, 12, heads, d): q, k, v of neighbour 0, then those of neighbour 1 ...
    # out
    attended_out: wp.array4d[float],  # (Q, 4, heads, d)
):
    n, h = wp.tid()
    p = attention_map(qkv, n, h)
    for i in range(4):
        for d in range(qkv.shape[3]):
            mean = p[i, 0] * qkv[n, 2, h, d] + p[i, 1] * qkv[n, 5, h, d]
            attended_out[n, i, h, d] = mean + p[i, 2] * qkv[n, 8, h, d] + p[i, 3] * qkv[n, 11, h, d]


def attend_by_kernel(qkv):
    """(Q, 4, 3 C) -> (Q, 4, C) with 8 heads."""
    rows = qkv.reshape(len(qkv), 12, 8, -1)
    attended = torch.empty_like(rows[:, :4])
    run(attend_kernel, (len(rows), 8), [rows], [attended])
    return attended.flatten(2)


# %% tags=["hide-input"]
few = torch.randn(1, 12, 4, 3)  # one query, 4 heads of 3 numbers
draw_trace(attend_kernel, (0, 1), [few, few[:, :4]], "P = softmax(q kᵀ / √d)\n4 x 4, in registers\nmean of v by P")

# %% [markdown]
# *In words: thread (n, h) lets the four neighbours of query n attend to each other in head h. On the left are the twelve
# rows of one query: query, key and value of each of four neighbours, heads side by side. The thread reads the columns of
# its own head from all of them, and writes the same columns of four rows on the right. The threads beside it do the
# other heads.*
#
# ### Backwards
#
# Training needs the backward pass of that kernel. Let $G$ (4, d) be the gradient of the loss with respect to what one
# head returned. First comes the gradient of the weights: $\mathrm{attend}_i = \sum_j P_{ij} \mathbf v_j$, so
# $\partial L / \partial P_{ij} = \mathbf G_i \cdot \mathbf v_j$. Row $i$ of $P$ is a softmax, whose backward you wrote in
# notebook 06b, with $\mathbf G_i \cdot \mathbf v_j$ in the place of the ranges:
#
# $$S_{ij} = P_{ij} \Big( \mathbf G_i \cdot \mathbf v_j - \sum_u P_{iu}\, \mathbf G_i \cdot \mathbf v_u \Big)$$
#
# is the gradient of the logits $\mathbf q_i \cdot \mathbf k_j / \sqrt d$. From there on everything is linear:
#
# | gradient of | is |
# |---|---|
# | the queries | $\partial L / \partial \mathbf q_i = \sum_j S_{ij}\, \mathbf k_j / \sqrt d$ |
# | the keys | yours |
# | the values | $\partial L / \partial \mathbf v_j = \sum_i P_{ij}\, \mathbf G_i$ |


# %%
def keys_backward(qkv, adj_attended):
    """(Q, 4, 3 C), (Q, 4, C) -> the gradient of the keys (Q, 4, C), with 8 heads."""
    rows, adj = qkv.reshape(len(qkv), 12, 8, -1), adj_attended.reshape(len(qkv), 4, 8, -1)
    adj_keys = torch.empty_like(adj)
    run(keys_backward_kernel, (len(rows), 8), [rows, adj], [adj_keys])
    return adj_keys.flatten(2)


# %% [markdown]
# ### Exercise 2 · The gradient of the keys
#
# importance ★★☆ · difficulty ★★★ · 20 minutes
#
# Write `keys_backward_kernel`, one thread per query and head: `adj_keys_out[n, j, h]` is
# $\partial L / \partial \mathbf k_j$. Key $\mathbf k_j$ takes part in the logits of *all* tokens $i$. Use `attention_map`.
# In `qkv`, token t has its query at row 3 t, its key at 3 t + 1 and its value at 3 t + 2.
#
# <details><summary>Hint: the formula</summary>
#
# $\partial L / \partial \mathbf k_j = \sum_i S_{ij}\, \mathbf q_i / \sqrt d$.
#
# </details>
# <details><summary>Hint: the outline</summary>
#
# `s = wp.mat44()`. Loop over i, d and j and add $G_{id} v_{jd}$ to `s[i, j]`. Then, for each row, compute the mean and
# replace `s[i, j]`. Then loop over j and d: a local sum over i, divided by $\sqrt d$, and one element written.
#
# </details>


# %% tags=["exercise"]
@wp.kernel(module="unique", enable_backward=False)
def keys_backward_kernel(
    # in
    qkv: wp.array4d[float],  # (Q, 12, heads, d)
    adj_attended: wp.array4d[float],  # (Q, 4, heads, d): G
    # out
    adj_keys_out: wp.array4d[float],  # (Q, 4, heads, d)
):
    raise NotImplementedError


# %% tags=["solution"]
@wp.kernel(module="unique", enable_backward=False)
def keys_backward_kernel(
    # in
    qkv: wp.array4d[float],  # (Q, 12, heads, d)
    adj_attended: wp.array4d[float],  # (Q, 4, heads, d): G
    # out
    adj_keys_out: wp.array4d[float],  # (Q, 4, heads, d)
):
    n, h = wp.tid()
    p = attention_map(qkv, n, h)
    s = wp.mat44()
    for i in range(4):
        for d in range(qkv.shape[3]):
            for j in range(4):
                s[i, j] += adj_attended[n, i, h, d] * qkv[n, 3 * j + 2, h, d]
        mean = wp.dot(p[i], s[i])
        for j in range(4):
            s[i, j] = p[i, j] * (s[i, j] - mean)
    for j in range(4):
        for d in range(qkv.shape[3]):
            total = float(0.0)
            for i in range(4):
                total += s[i, j] * qkv[n, 3 * i, h, d]
            adj_keys_out[n, j, h, d] = total / wp.sqrt(float(qkv.shape[3]))


# %% tags=["check"]
@check
def _():
    generator = torch.Generator().manual_seed(3)
    qkv, adj = torch.randn(5, 4, 192, generator=generator), torch.randn(5, 4, 64, generator=generator)
    qkv, adj = qkv.to(device), adj.to(device)
    leaf = qkv.clone().requires_grad_()
    attend_neighbours(leaf, heads=8, backend="torch").backward(adj)
    true, mine = leaf.grad[..., 64:128], keys_backward(qkv, adj)
    assert mine.isfinite().all(), "some elements are not written, or not finite"
    ratio = (mine / true).median()
    assert not torch.allclose(mine, true * math.sqrt(8), atol=1e-4), (
        "everything is too large by √8: the scale of logits"
    )
    same = keys_backward(torch.cat((qkv[..., :128], torch.ones_like(qkv[..., 128:])), -1), adj)
    assert same.abs().max() < 1e-4, "where all values are equal no weight matters: zeros. Is the mean subtracted in S?"
    assert torch.allclose(mine, true, atol=1e-4), (
        f"token 0 of query 0 begins {true[0, 0, :3].tolist()}, yours {mine[0, 0, :3].tolist()} (median ratio "
        f"{ratio:.2f}): is the sum over i, the tokens that ask?"
    )
    assert torch.allclose(keys_backward(qkv, 3 * adj), 3 * true, atol=1e-3), "three times the gradient should triple it"


# %% tags=["wrong"]
@wp.kernel(module="unique", enable_backward=False)
def keys_backward_kernel(
    qkv: wp.array4d[float], adj_attended: wp.array4d[float], adj_keys_out: wp.array4d[float]
):  # the queries' formula, with queries for keys: S is not transposed
    n, h = wp.tid()
    p = attention_map(qkv, n, h)
    for i in range(4):
        s = wp.vec4()
        for d in range(qkv.shape[3]):
            for j in range(4):
                s[j] += adj_attended[n, i, h, d] * qkv[n, 3 * j + 2, h, d]
        mean = wp.dot(p[i], s)
        for d in range(qkv.shape[3]):
            total = float(0.0)
            for j in range(4):
                total += p[i, j] * (s[j] - mean) * qkv[n, 3 * j, h, d]
            adj_keys_out[n, i, h, d] = total / wp.sqrt(float(qkv.shape[3]))


# %% tags=["wrong"]
@wp.kernel(module="unique", enable_backward=False)
def keys_backward_kernel(
    qkv: wp.array4d[float], adj_attended: wp.array4d[float], adj_keys_out: wp.array4d[float]
):  # the mean is not subtracted
    n, h = wp.tid()
    p = attention_map(qkv, n, h)
    s = wp.mat44()
    for i in range(4):
        for d in range(qkv.shape[3]):
            for j in range(4):
                s[i, j] += p[i, j] * adj_attended[n, i, h, d] * qkv[n, 3 * j + 2, h, d]
    for j in range(4):
        for d in range(qkv.shape[3]):
            total = float(0.0)
            for i in range(4):
                total += s[i, j] * qkv[n, 3 * i, h, d]
            adj_keys_out[n, j, h, d] = total / wp.sqrt(float(qkv.shape[3]))


# %% tags=["wrong"]
@wp.kernel(module="unique", enable_backward=False)
def keys_backward_kernel(
    qkv: wp.array4d[float], adj_attended: wp.array4d[float], adj_keys_out: wp.array4d[float]
):  # the scale is forgotten
    n, h = wp.tid()
    p = attention_map(qkv, n, h)
    s = wp.mat44()
    for i in range(4):
        for d in range(qkv.shape[3]):
            for j in range(4):
                s[i, j] += adj_attended[n, i, h, d] * qkv[n, 3 * j + 2, h, d]
        mean = wp.dot(p[i], s[i])
        for j in range(4):
            s[i, j] = p[i, j] * (s[i, j] - mean)
    for j in range(4):
        for d in range(qkv.shape[3]):
            total = float(0.0)
            for i in range(4):
                total += s[i, j] * qkv[n, 3 * i, h, d]
            adj_keys_out[n, j, h, d] = total


# %% [markdown]
# The trace of your kernel: the same rows as forward and those of $G$ in, the gradients of four keys out.

# %%
draw_trace(keys_backward_kernel, (0, 1), [few, few[:, :4], few[:, :4]], "P again, then S,\nthen Sᵀ q / √d")

# %% [markdown]
# *In words, once the kernel is there: as the drawing above, with four more rows on the left.*
#
# ### The clock
#
# **Predict:** which takes longer, $M$ or the 4 × 4? Does it matter with what the 4 × 4 is computed?


# %%
def milliseconds(function, repeats=5):
    """The shortest of several runs on one core: what else the computer does only ever adds."""
    cores = torch.get_num_threads()
    torch.set_num_threads(1)  # so that how well the work is shared out is not what is measured
    times = []
    for _ in range(repeats + 1):  # the first compiles and is not the shortest
        if device == "cuda":
            torch.cuda.synchronize()
        start = time.perf_counter()
        function()
        if device == "cuda":
            torch.cuda.synchronize()
        times.append(1e3 * (time.perf_counter() - start))
    torch.set_num_threads(cores)
    return min(times)


def attend_by_einsum(qkv):
    q, k, v = qkv.unflatten(-1, (3, 8, -1)).unbind(-3)
    logits = torch.einsum("nihd,njhd->nhij", q, k) / math.sqrt(q.shape[-1])
    return torch.einsum("nhij,njhd->nihd", logits.softmax(-1), v).flatten(-2)


qkv = torch.randn(8192, 4, 192, device=device)
assert torch.allclose(attend_by_kernel(qkv), attend_by_einsum(qkv), atol=1e-5)
tokens, weight = torch.randn(8192, 4, 64, device=device), torch.randn(192, 64, device=device)
ways = {
    "M, a matrix product": lambda: tokens @ weight.T,
    "4 x 4 by einsum": lambda: attend_by_einsum(qkv),
    "4 x 4 by our kernel": lambda: attend_by_kernel(qkv),
    "4 x 4 by kernels.attend_neighbours": lambda: attend_neighbours(qkv, heads=8),
}
for name, way in ways.items():
    print(f"{name:>35}: {milliseconds(way):6.1f} ms for {len(qkv):,} queries")

# %% [markdown]
# With a twenty-fourth of the multiply-adds the 4 × 4 by `einsum` takes longer than the matrix product. Matrices of 64 ×
# 192 keep the processor's multipliers busy; a 4 × 4 is far too small for a library of large matrices. Here the count
# misleads. From now on we use `attend_neighbours`.
#
# ## 4. Hoisting: projections per pixel
#
# Now $M$, nearly half of the count of section 3. It is applied to 1,048,576 tokens, but these are made of only 16,384
# pixels: 64 tokens share each feature $z$ and differ by their offsets alone. If there were no layer norm,
# $M(z + W\delta + b)$ would be $M(z + b) + (MW)\,\delta$: the first part once per *pixel*, the second a product with
# two numbers. Moving work out of a loop in which it does not change is called *hoisting*.
#
# The layer norm is in the way: it divides by a standard deviation which depends on $z$ and $\delta$ together,
#
# $$\mathrm{LN}(x) = \gamma\,\frac{x - \bar x}{\sqrt{\operatorname{var}(x) + \varepsilon}} + \beta$$
#
# **Predict:** can it be hoisted all the same, without an approximation?
#
# Look at how it is in the way. Subtracting the mean over the C channels is linear. Write
# $\mathbf{\hat z} = (z + b) - \text{mean}$, and $\hat W$ for $W$ whose columns have lost their means. Then
# $x - \bar x = \mathbf{\hat z} + \hat W \delta$, and
#
# $$C \operatorname{var}(x) = \lVert \mathbf{\hat z} + \hat W \delta \rVert^2
#   = \underbrace{\mathbf{\hat z}^\top \mathbf{\hat z}}_{\text{1 number}}
#   + 2\, \delta^\top \underbrace{\hat W^\top \mathbf{\hat z}}_{u:\ \text{2 numbers}}
#   + \delta^\top \underbrace{\hat W^\top \hat W}_{N:\ 2 \times 2} \delta$$
#
# a quadratic in the offset, with three numbers that belong to the pixel and a matrix that belongs to the network. And,
# with $\sigma = \sqrt{\operatorname{var}(x) + \varepsilon}$,
#
# $$M\,\mathrm{LN}(x) = \frac{A + B \delta}{\sigma} + c, \qquad
#   A = M \gamma \mathbf{\hat z}, \quad B = M \gamma \hat W, \quad c = M \beta$$
#
# where $\gamma$ multiplies channel by channel. It is exact.
#
# | equation | line of code | field of `Projected` |
# |---|---|---|
# | $A$, per pixel | `(z_hat * gamma) @ M.T` | `pixels` (P, 4 C + 16), first 3 C columns |
# | $\hat z^\top \hat z,\ u$, per pixel | `(z_hat**2).sum(-1)`, `z_hat @ W_hat` | `pixels`, columns 4 C to 4 C + 2 |
# | $B$ | `(M * gamma) @ W_hat` | `slope` (2, 4 C), first 3 C columns |
# | $c$, $N$ | `M @ beta`, `W_hat.T @ W_hat` | `shift` (3 C,), `gram` (2, 2) |
#
# The names are those of what `project_pixels` returns (`kernels/neighbour_attention.py`; its own `_attend_kernel` gets
# the columns from 4 C on as an argument of their own, `moments`); the C columns after those 3 C of `pixels` and `slope`
# are $z + b$ and $W$, which make the token itself, and 13 more only fill a row up. (In code, `W` contains the scale of
# offsets.)

# %%
network = models.load("iln").to(device)  # trained, D = 1
decoder = copy_of(network)
block = decoder.blocks[0]
W, b = decoder.position.weight * OFFSET_SCALE, decoder.position.bias
gamma, beta, M = block.norm.weight, block.norm.bias, block.qkv.weight

with torch.no_grad():
    features = network.encode(image[None], wrap=True).features  # (1, C, H, W)
    z, offsets = (part[0] for part in gather_neighbours(features, queries[None]))  # (Q, 4, C), (Q, 4, 2)
    token_by_token = block.qkv(block.norm(z + offsets @ W.T + b))

    W_hat = W - W.mean(0)
    z_hat = (features[0].flatten(1).T + b) - (features[0].flatten(1).T + b).mean(-1, keepdim=True)  # once per pixel
    A, B, c, N = (z_hat * gamma) @ M.T, (M * gamma) @ W_hat, M @ beta, W_hat.T @ W_hat
    moments = torch.cat(((z_hat**2).sum(-1, keepdim=True), z_hat @ W_hat), -1)
    table = torch.cat((A, moments), -1).T.reshape(1, -1, *image.shape)  # an image of 3 C + 3 channels

    row = gather_neighbours(table, queries[None])[0][0]  # per token: gather, and two numbers of offset
    c_var = row[..., -3] + 2 * (offsets * row[..., -2:]).sum(-1) + (offsets @ N * offsets).sum(-1)  # C var(x)
    sigma = (c_var / 64 + block.norm.eps).sqrt()
    hoisted = (row[..., :-3] + offsets @ B.T) / sigma[..., None] + c

relative = (hoisted - token_by_token).abs().max() / token_by_token.abs().max()
print(f"queries, keys and values up to {token_by_token.abs().max():.2f}; relative difference {relative:.1e}")
assert relative < 5e-6

# %% [markdown]
# The same function, rounded differently. The library does it in `project_pixels` (the table) and `neighbour_attention`
# (gather, attend, project back and add in one op), for training, too: it has a backward kernel.

# %%
with torch.no_grad():
    projected = project_pixels(features, (W, b), (gamma, beta), M, heads=8)
    step = neighbour_attention(projected, queries[None], (block.out.weight, block.out.bias))[0]
    x = z + offsets @ W.T + b
    plain = x + block.out(attend_neighbours(block.qkv(block.norm(x)), heads=8))
print(f"whole attention step: largest difference {(step - plain).abs().max() / plain.abs().max():.1e}, relative")
assert (step - plain).abs().max() < 1e-4 * plain.abs().max()

# %% [markdown]
# ### Exercise 3 · Variance by moments
#
# importance ★★☆ · difficulty ★☆☆ · 10 minutes
#
# Write the quadratic yourself. `moments(z, W, b)`: from features `z` (P, C), `W` (C, 2) and `b` (C,) return `squares`
# (P,), which is $\hat z^\top \hat z$, `u` (P, 2), and `gram` (2, 2), which is $N$. `variance(squares, u, gram, offsets,
# channels)`: for `offsets` (P, 2) return (P,), the variance of $z + W\delta + b$ over the channels (divided by C, not C
# - 1), without ever forming a token.
#
# <details><summary>Hint: means over what?</summary>
#
# Over the channels: `(z + b).mean(-1, keepdim=True)`, and for `W`, whose channels are its rows, `W.mean(0)`.
#
# </details>


# %% tags=["exercise"]
def moments(z, W, b):
    raise NotImplementedError


def variance(squares, u, gram, offsets, channels):
    raise NotImplementedError


# %% tags=["solution"]
def moments(z, W, b):
    z_hat = (z + b) - (z + b).mean(-1, keepdim=True)
    W_hat = W - W.mean(0)
    return (z_hat**2).sum(-1), z_hat @ W_hat, W_hat.T @ W_hat


def variance(squares, u, gram, offsets, channels):
    return (squares + 2 * (offsets * u).sum(-1) + ((offsets @ gram) * offsets).sum(-1)) / channels


# %% tags=["check"]
@check
def _():
    generator = torch.Generator().manual_seed(2)
    z = torch.randn(7, 16, generator=generator, dtype=torch.float64)
    W = torch.randn(16, 2, generator=generator, dtype=torch.float64) + 0.5
    b, q = torch.randn(16, generator=generator, dtype=torch.float64), torch.rand(7, 2, generator=generator).double()
    shapes = [tuple(part.shape) for part in moments(z, W, b)]
    assert shapes == [(7,), (7, 2), (2, 2)], (
        f"squares, u, gram have shapes {shapes}; they should be (P,), (P, 2), (2, 2)"
    )

    def both(z, q):
        mine, true = variance(*moments(z, W, b), q, 16), (z + q @ W.T + b).var(-1, correction=0)
        assert mine.shape == true.shape, f"one variance for each token: {tuple(true.shape)}, not {tuple(mine.shape)}"
        return mine, true

    mine, true = both(z, torch.zeros_like(q))
    assert not torch.allclose(mine * 15 / 16, true), "divide by C, not by C - 1"
    assert torch.allclose(mine, true), (
        "zero offset: the variance of z + b. Is b in it, is its mean over channels gone, is it divided by C?"
    )
    mine, true = both(torch.full_like(z, 3.0) - b, q)
    assert torch.allclose(mine, true), (
        "z + b is the same in all channels: what is left is q N q / C. Has W lost its mean?"
    )
    mine, true = both(z, q)
    assert torch.allclose(mine, true), (
        f"offset {q[0].tolist()}: {mine[0]:.4f}, it should be {true[0]:.4f}. Is the mixed term there, twice?"
    )
    assert torch.allclose(both(z, -3 * q)[0], both(z, -3 * q)[1]), "offsets are negative as well: 2 q u changes sign"
    assert variance(*moments(z[:0], W, b), q[:0], 16).shape == (0,), "no tokens: no variances"


# %% tags=["wrong"]
def moments(z, W, b):  # W keeps its mean
    z_hat = (z + b) - (z + b).mean(-1, keepdim=True)
    return (z_hat**2).sum(-1), z_hat @ W, W.T @ W


# %% tags=["wrong"]
def moments(z, W, b):  # the mean over pixels, not over channels
    z_hat = (z + b) - (z + b).mean(0)
    W_hat = W - W.mean(0)
    return (z_hat**2).sum(-1), z_hat @ W_hat, W_hat.T @ W_hat


# %% tags=["wrong"]
def moments(z, W, b):
    z_hat = (z + b) - (z + b).mean(-1, keepdim=True)
    W_hat = W - W.mean(0)
    return (z_hat**2).sum(-1), z_hat @ W_hat, W_hat.T @ W_hat


def variance(squares, u, gram, offsets, channels):  # the mixed term once only
    return (squares + (offsets * u).sum(-1) + ((offsets @ gram) * offsets).sum(-1)) / channels


# %% [markdown]
# ### When does it pay?
#
# Hoisted, $M$ costs 3 C² once per pixel, and a product with two numbers per token. Token by token it costs 4 · 3 C² per
# query. So it pays once there are more *tokens* than pixels: from a quarter of a query per pixel on. To go from
# 16 × 1024 to 128 × 2048 asks 16 queries per pixel. Only the first block can be hoisted: after it, tokens are mixtures
# of four pixels.
#
# ### Exercise 4 · Count it
#
# importance ★☆☆ · difficulty ★☆☆ · 7 minutes
#
# Write `multiply_adds(queries, pixels, depth, hoisted)` for the decoder with C = 64, for a whole frame. Token by token
# it is the table of section 3. Hoisted, the *first* block's $M$ costs 3 · 64² per pixel plus 4 · 2 · 3 · 64 per query
# (that is $Bq$ for four tokens); leave the few multiply-adds of the variance out. Other blocks stay as they are.
#
# <details><summary>Hint</summary>
#
# Per query: 768 for position and head, and for each block 49152 (for $M$) + 2048 + 16384 + 32768.
#
# </details>


# %% tags=["exercise"]
def multiply_adds(queries, pixels, depth, hoisted):
    raise NotImplementedError


# %% tags=["solution"]
def multiply_adds(queries, pixels, depth, hoisted):
    per_query = 512 + 256 + depth * (49152 + 2048 + 16384 + 32768)
    if hoisted and depth > 0:
        per_query += 4 * 2 * 3 * 64 - 49152
        return queries * per_query + pixels * 3 * 64**2
    return queries * per_query


# %% tags=["check"]
@check
def _():
    for depth in (0, 1, 2):
        mine, true = multiply_adds(10, 1000, depth, False), 10 * count(depth)
        assert mine == true, f"token by token, D = {depth}, 10 queries: {true:,.0f} as PyTorch counts, not {mine:,.0f}"
    frame = multiply_adds(262144, 16384, 1, True)
    wanted = 262144 * (768 + 1536 + 51200) + 16384 * 12288
    assert frame == wanted, (
        f"D = 1, 16 queries per pixel, hoisted: {wanted:,}, you have {frame:,.0f}, {(frame - wanted) / 262144:,.0f} too "
        "many per query"
    )
    assert multiply_adds(10, 1000, 0, True) == multiply_adds(10, 1000, 0, False), "D = 0 has no block to hoist from"
    saved = [multiply_adds(100, 50, depth, False) - multiply_adds(100, 50, depth, True) for depth in (1, 2)]
    assert saved[0] == saved[1], "the second block's tokens are mixtures of pixels: its M cannot be hoisted"
    assert multiply_adds(0, 100, 1, True) == 100 * 12288, "no queries: the pixels were projected all the same"


# %% tags=["wrong"]
def multiply_adds(queries, pixels, depth, hoisted):  # hoists from every block
    if hoisted:
        return queries * (768 + depth * (1536 + 51200)) + depth * pixels * 12288
    return queries * (768 + depth * 100352)


# %% tags=["wrong"]
def multiply_adds(queries, pixels, depth, hoisted):  # one token per query
    return queries * (768 + depth * 100352) / 4


# %% tags=["wrong"]
def multiply_adds(queries, pixels, depth, hoisted):  # forgets that D = 0 has nothing to project
    if hoisted:
        return queries * (768 + depth * 100352 - 49152 + 1536) + pixels * 12288
    return queries * (768 + depth * 100352)


# %% [markdown]
# Counting is one thing. Here is the clock for one attention step, from features to new tokens, three ways: token by
# token; hoisted, in plain PyTorch as above; and `neighbour_attention`, hoisted and in one kernel. The first two use
# `attend_neighbours` for the 4 × 4. The two hoisted ones make their table anew in each run, too.
#
# **Predict:** does the hoisted version in plain PyTorch win, from which number of queries per pixel on?

# %%
height, width = 16, 128
features = torch.randn(1, 64, height, width, device=device).contiguous(memory_format=torch.channels_last)


def by_tokens(queries):
    z, offsets = gather_neighbours(features, queries)
    x = z + offsets @ W.T + b
    return x + block.out(attend_neighbours(block.qkv(block.norm(x)), heads=8))


def by_hoisting(queries):
    z_hat = features.movedim(1, 3) + b
    z_hat = z_hat - z_hat.mean(-1, keepdim=True)
    parts = (z_hat * gamma) @ M.T, z_hat @ W_hat, (z_hat**2).sum(-1, keepdim=True), features.movedim(1, 3) + b
    rows, offsets = gather_neighbours(torch.cat(parts, -1).movedim(3, 1), queries)
    a, u, squares, x = rows.split([192, 2, 1, 64], -1)
    c_var = squares + 2 * (offsets * u).sum(-1, keepdim=True) + (offsets @ N * offsets).sum(-1, keepdim=True)
    qkv = (a + offsets @ B.T) / (c_var / 64 + block.norm.eps).sqrt() + c
    return x + offsets @ W.T + block.out(attend_neighbours(qkv, heads=8))


def by_op(queries):
    table = project_pixels(features, (W, b), (gamma, beta), M, heads=8)
    return neighbour_attention(table, queries, (block.out.weight, block.out.bias))


# %%
steps = {"token by token": by_tokens, "hoisted, PyTorch": by_hoisting, "neighbour_attention": by_op}
per_pixel = [1 / 8, 1 / 2, 2, 8]
clock = {name: [] for name in steps}
with torch.no_grad():
    for share in per_pixel:
        some = torch.rand(1, int(share * height * width), 2, device=device) * torch.tensor([15.0, width], device=device)
        for name, way in steps.items():
            clock[name].append(milliseconds(lambda way=way, some=some: way(some), repeats=6))
        assert torch.allclose(by_tokens(some), by_op(some), atol=1e-3)
        assert torch.allclose(by_tokens(some), by_hoisting(some), atol=1e-3)
for name, values in clock.items():
    print(f"{name:>20}: " + ", ".join(f"{ms:.1f} ms at {share:g}" for ms, share in zip(values, per_pixel, strict=True)))

# %% tags=["hide-input"]
shares = np.geomspace(1 / 32, 32, 50)
counts = {
    "token by token": shares * (512 + 49152 + 2048 + 16384),
    "hoisted": shares * (512 + 1536 + 2048 + 16384) + 12288,
}
figure, axes = plt.subplots(1, 2, figsize=(10, 3.4), layout="constrained")
for (name, values), (colour, line) in zip(counts.items(), (("#999999", "--"), ("#0072b2", "-")), strict=True):
    axes[0].plot(shares, values / 1e3, line, color=colour, label=name)
axes[0].axvline(1 / 4, color="black", linewidth=0.8, linestyle=":")
axes[0].axvline(16, color="black", linewidth=0.8)
axes[0].text(0.27, 1.5, "as many tokens\nas pixels", fontsize=8, va="bottom")
axes[0].text(15, 1.5, "16x1024 to\n128x2048", fontsize=8, va="bottom", ha="right")
axes[0].set(ylabel="thousand multiply-adds per pixel", title="counted")
for (name, values), (colour, look) in zip(
    clock.items(), (("#999999", "s--"), ("#e69f00", "^:"), ("#0072b2", "o-")), strict=True
):
    axes[1].plot(per_pixel, values, look, color=colour, label=name)
axes[1].set(ylabel="ms", title=f"measured, {height} x {width} pixels")
for axis in axes:
    axis.set(xscale="log", yscale="log", xlabel="queries per pixel")
    axis.legend(frameon=False, fontsize=9, loc="upper left")
axes[1].set_xticks(per_pixel, [f"{share:g}" for share in per_pixel])
axes[1].set_xticks([], minor=True)
plt.show()

# %% [markdown]
# *In words: two plots over the number of queries per pixel, both axes logarithmic. Left, counted multiply-adds: token
# by token a straight line, hoisted one that starts flat, crosses at about a quarter and ends at less than a third.
# Right, the times of the three ways on one core of the computer that built this page.*
#
# Where this page was built hoisting alone gained nothing: it saves multiplications, but in plain PyTorch it pays for
# them with memory, since each token gathers 259 numbers of its pixel instead of 64 and passes over them again and
# again. That is what notebook 06b was about. In one kernel, where what is gathered stays in registers, both gains come
# together. At an eighth of a query per pixel, though, it is better not to hoist at all, as the count says.
#
# ## 5. Does attention help? Train and see
#
# The paper compares depths after days of training. We have half a minute: two depths, the same batches of rays in one
# town, two starts (seeds) each, and one scan elsewhere in that town to test. Small encoders, 30 steps.
#
# **Predict:** which depth comes out ahead? And how far apart are two starts of the same depth?

# %%
STEPS = 30 if FAST else 300
SEEDS = 0, 1
coarse, fine = preset("paper-16x1024"), preset("paper-64x1024")
town = places.town("town01", device=device)
rays = iter(data.ContinuousRays([town], coarse, crops=2, columns=48, queries=256, seed=0))
batches = [next(rays) for _ in range(STEPS)]
[(scan, truth)] = places.held_out_scans(town, 1, [coarse, fine])


def train(depth, seed):
    torch.manual_seed(seed)
    model = models.create("iln", depth=depth, blocks=2).to(device)
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 1e-3, total_steps=STEPS)
    for batch in batches:
        image, queries, ranges, wrap, _ = batch.to(device)
        loss = (model(image, queries, wrap) - ranges).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return model.eval()


def figures_of(model):
    """Mean absolute error [m] and IoU of the held-out scan."""
    found = metrics.compare(model.ranges(scan, fine), truth)
    return found["mae"], found["iou"]


trained = {depth: [train(depth, seed) for seed in SEEDS] for depth in (0, 1)}

# %%
results = {depth: [figures_of(model) for model in runs] for depth, runs in trained.items()}
baseline = figures_of(models.create("bilinear").to(device))
print(f"{'bilinear':>8}: MAE {baseline[0]:.2f} m, IoU {baseline[1]:.3f}")
for depth, runs in results.items():
    print(f"   D = {depth}: " + "; ".join(f"MAE {mae:.2f} m, IoU {iou:.3f}" for mae, iou in runs))

by_depth = [sum(iou for _, iou in runs) / len(runs) for runs in results.values()]
between_seeds = max(abs(runs[0][1] - runs[1][1]) for runs in results.values())
print(f"IoU: depths differ by up to {max(by_depth) - min(by_depth):.3f}, two starts by up to {between_seeds:.3f}")

# %% [markdown]
# Compare the last two numbers before you believe any order. If two starts of one depth lie about as far apart as the
# depths do, this run tells nothing about depth. With so few steps that is what to expect, and a table with one number
# per depth would not have shown it. (A depth's number is a mean of two starts, which scatters less than one start, by
# $\sqrt 2$.) Also compare with bilinear interpolation, which needs no training: after 30 steps a
# network has only begun. Set `FAST = False` for ten times the steps.
#
# The package keeps a run of full size: encoders of 16 blocks, 2000 steps in six towns, ten scans of two other towns.
# Seconds are those of a frame of 128 × 2048 on the CPU of that run. (`python -m ilnet experiment attention` makes the
# file, in an hour on two cores.)

# %%
with open(Path(ilnet.__file__).parent / "results" / "attention.csv") as file:
    for row in csv.DictReader(file):
        if row["size"] == "64x1024":
            print(
                f"D = {row['depth']}: {int(row['parameters']):,} parameters, {float(row['seconds_128x2048']):.2f} s; "
                f"MAE {float(row['mae']):.2f} m, IoU {float(row['iou']):.3f}"
            )

# %% [markdown]
# Here is an order to believe, and it has one step. Without a block a network loses more than a fifth of its IoU, far
# more than two starts of one depth differ by after 2000 steps (.01; notebook 08 draws three). Mind what that compares: a
# block is attention *and* a feed-forward layer, and D = 0 has neither. This table cannot say which of the two is missed.
# **One block is all it takes:** two and four change nothing that is larger than the noise, and cost three and six times
# as long. (D = 0 and D = 1 run in one fused kernel, `fused_decode`; deeper networks do not.) The paper uses one block,
# too.
#
# ## 6. The weights at an edge
#
# What a long training makes of it: the shipped network (D = 1; `ilnet/weights/README.md` says how it was trained) on a
# small world with a formula for its ranges, so that the truth is known along any ray: a road, a wall 15 m ahead, a
# pillar before it. A query moves half way between two rows of pixels, over the edge of the pillar just before column
# 561. (Columns count to the left: it is the pillar's right edge as you would see it.)
#
# **Predict:** draw the weights of the four neighbours while the query crosses the cell in which the edge lies: for
# bilinear interpolation, and for a network that got it right.


# %%
def ranges_along(directions):
    """Ranges (...) to a road, a wall and a pillar along unit vectors (..., 3)."""
    x, y, z = directions.unbind(-1)
    road = torch.where(z < 0, -1.8 / z, torch.inf)
    wall = torch.where(x > 0, 15.0 / x, torch.inf)
    across = x**2 + y**2  # the pillar: |p - (8, 3)| = 0.5, seen from above
    half = (8 * x + 3 * y) / across
    root = half**2 - (73 - 0.25) / across
    pillar = torch.where((root > 0) & (half > 0), half - root.clamp(min=0).sqrt(), torch.inf)
    ranges = torch.stack((road, wall, pillar)).amin(0)
    return torch.where(ranges <= 80, ranges, coarse.norm_range)


scene = ranges_along(coarse.directions()).to(device)
encoded = network.encode(scene[None], wrap=True).features
EDGE = 560  # column of the last pixel before the pillar


@torch.no_grad()
def along_row(row, columns):
    """Weights (Q, 4) of the network, ranges (Q, 4) of the neighbours, and the truth (Q,)."""
    queries = torch.stack((torch.full_like(columns, row), columns), -1)
    z, offsets = gather_neighbours(encoded, queries[None].to(device))
    ranges = gather_neighbours(scene[None, None], queries[None].to(device))[0][0, ..., 0]
    elevation = np.interp(row, range(16), coarse.elevations)
    azimuth = np.interp(columns.numpy(), range(1024), coarse.azimuths)
    directions = angles_to_directions(torch.full_like(columns, elevation), torch.tensor(azimuth).float())
    return decoder.scores(z[0], offsets[0]).softmax(-1).cpu(), ranges.cpu(), ranges_along(directions)


# %%
COLOURS = "#d55e00", "#e69f00", "#0072b2", "#56b4e9"
NAMES = "row-, col-", "row+, col-", "row-, col+", "row+, col+"


def draw_edge(row=9.5):
    _, (left, right) = plt.subplots(1, 2, figsize=(10, 3.4), layout="constrained")
    columns = torch.linspace(EDGE - 1.49, EDGE + 2.49, 400)
    weights, ranges, truth = along_row(row, columns)
    f, g = columns - columns.floor(), row - math.floor(row)
    areas = torch.stack(((1 - g) * (1 - f), (1 - g) * f, g * (1 - f), g * f), -1)
    left.plot(columns, truth, color="black", linewidth=3, alpha=0.4, label="truth")
    left.plot(columns, (areas * ranges).sum(-1), "--", color="#999999", label="bilinear")
    left.plot(columns, (weights * ranges).sum(-1), color="#0072b2", label="iln")
    for place, marker in ((int(row), "v"), (min(int(row) + 1, 15), "^")):
        pixels = torch.arange(EDGE - 1, EDGE + 3)
        left.plot(pixels, scene[place, pixels].cpu(), marker, color="white", markeredgecolor="black", markersize=7)
    left.set(xlabel="column of the query [pixels]", ylabel="range [m]", title=f"along row {row:.2f}")
    left.legend(frameon=False)

    columns = torch.linspace(EDGE, EDGE + 0.999, 200)
    weights, _, truth = along_row(row, columns)
    shown = right.stackplot(columns, weights.T[[0, 2, 1, 3]], colors=COLOURS, labels=NAMES)  # the left two below
    for part, hatch in zip(shown, ("", "///", "", "\\\\\\"), strict=True):
        part.set(hatch=hatch, edgecolor="white", linewidth=0.3)
    jump = columns[1:][truth.diff().abs() > 1]
    right.plot(columns, 1 - (columns - EDGE), "--", color="black", linewidth=1)  # bilinear: both on the left together
    for place in jump:
        right.axvline(place, color="black", linewidth=2, linestyle=":")
    right.set(xlabel="column of the query [pixels]", ylabel="weights, stacked", ylim=(0, 1), xlim=(EDGE, EDGE + 1))
    right.set_title("in the cell of the edge (dotted: the edge; dashed: bilinear)", fontsize=10)
    right.legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    plt.show()


# %% tags=["goal", "hide-input"]
draw_edge()

# %%
columns = torch.linspace(EDGE, EDGE + 0.999, 200)
weights, ranges, truth = along_row(9.5, columns)
on_left = weights[:, 0] + weights[:, 2]
crossing = columns[on_left < 0.5][0].item()
edge = columns[:-1][truth.diff().abs() > 1].item()
print(f"weight of the two left pixels: {on_left[0]:.2f} at the left end of the cell, {on_left[-1]:.2f} at the right")
print(f"the weights change sides at column {crossing:.2f}, the true edge lies at {edge:.2f}")
assert on_left[0] > 0.9
assert on_left[-1] < 0.1

# %% [markdown]
# *In words: left, ranges along row 9.5. The truth falls from the wall's 15.7 m to the pillar's 8.5 m in one step;
# bilinear interpolation draws a ramp over the whole cell; the network a steep step. Right, the four weights in that
# cell, stacked and hatched, those of the two left pixels below: first these have all of it, then, within a small part
# of the cell, the two right ones take over. A dashed line falls from 1 to 0: what bilinear interpolation gives to the
# two left ones.*
#
# Bilinear weights change evenly from one end of the cell to the other, and every query in between makes up a point in
# the air between pillar and wall. The network's weights switch. *Where* they switch is a guess from what the
# surroundings look like; the image does not tell where in the cell the edge lies. But on either side of it the answer
# is a surface that is there.
#
# Who listened to whom, on the way to these weights? Each head has a map $P$ (4, 4). Row i shows how token i shares out
# its attention.
#
# **Predict:** in the cell of the edge, tokens 0 and 2 are on the wall, 1 and 3 on the pillar. Will a token listen to the
# other one of its surface, or to the other surface?


# %%
@torch.no_grad()
def attention_maps(row, columns):
    """P (Q, 8, 4, 4) of the network's eight heads."""
    queries = torch.stack((torch.full_like(columns, row), columns), -1)
    z, offsets = gather_neighbours(encoded, queries[None].to(device))
    x = z[0] + offsets[0] @ W.T + b
    q, k, _ = block.qkv(block.norm(x)).unflatten(-1, (3, 8, -1)).unbind(-3)
    return (torch.einsum("nihd,njhd->nhij", q, k) / math.sqrt(q.shape[-1])).softmax(-1).cpu()


places_asked = {"on a flat wall, column 530.5": 530.5, f"at the edge, column {EDGE + 0.5}": EDGE + 0.5}
maps = attention_maps(9.5, torch.tensor(list(places_asked.values())))
across = torch.tensor([[False, True] * 2, [True, False] * 2] * 2)  # token i and token j on different surfaces
for name, one in zip(places_asked, maps, strict=True):
    shares_across = (one * across).sum((1, 2)) / 4
    print(f"{name}: {shares_across.mean():.2f} of the attention goes to the other column; by head, ", end="")
    print(" ".join(f"{share:.2f}" for share in shares_across))
moved, spread = (maps[0] - maps[1]).abs().mean(), (maps[0] - maps[0].roll(1, 0)).abs().mean()
print(f"between the two places a weight differs by {moved:.2f} on average, between two heads by {spread:.2f}")
assert moved < spread

# %% tags=["hide-input"]
figure, grid = plt.subplots(2, 8, figsize=(10, 3), layout="constrained", sharex=True, sharey=True)
for row_of_axes, name, heads in zip(grid, places_asked, maps, strict=True):
    for number, (axis, one) in enumerate(zip(row_of_axes, heads, strict=True)):
        shown = axis.imshow(one, cmap="cividis", vmin=0, vmax=1)
        axis.set(title=f"head {number}" if axis in grid[0] else "", xticks=range(4), yticks=range(4))
    row_of_axes[0].set_ylabel(name.split(",")[0] + "\ntoken i", fontsize=8)
figure.supxlabel("token j, which it listens to", fontsize=9)
figure.colorbar(shown, ax=grid, label="P")
plt.show()

# %% [markdown]
# *In words: two rows of eight small 4 × 4 maps, above for a query on a flat wall, below for one at the edge. In most
# heads each row has one bright square, and most squares are at the same place above and below.*
#
# Neither, for most heads. They listen by *place*: head 2 to the pixel of the same column in the upper row, heads 3 and 4
# to the other column, head 7 to token 1, on the wall as at the edge. So a token gets to know the features of particular
# neighbours, and what to make of the comparison is left to the layers that follow. A few heads change with the scene
# (head 6 turns to the same column at the edge). These are two queries of one scene. Averaged over all queries of ten
# scans it is the same: what a head listens to hardly depends on how far the neighbours are apart
# (`python -m ilnet experiment where`).
#
# Another row. In a running notebook a slider moves it: look at rows of pixels (9.0) and between them, and below row 5,
# where rays meet the road before they reach the wall.

# %%
slide(draw_edge, row=(2.0, 14.75, 0.25))

# %% [markdown]
# ## Summary
#
# 1. Four tokens, feature plus embedded offset, attend to each other in D blocks; a head scores each. At D = 0 a score
#    cannot depend on the other neighbours.
# 2. Multiply-adds count what large matrices cost. A 4 × 4 needs a kernel: one thread per query and head.
# 3. The layer norm's variance is quadratic in the offset, so $M$ can be applied per pixel, exactly. It pays from a
#    quarter of a query per pixel on, if what it gathers is used at once.
# 4. A difference between networks counts if it is larger than that between two starts of one network. Ours were trained
#    too briefly for a verdict on depth.
#
# ## Next
#
# A verdict takes longer trainings, more scans and towns not trained in: [08 · The comparison](08_the_comparison.ipynb).
