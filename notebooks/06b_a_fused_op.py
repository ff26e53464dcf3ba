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
# # 06b · A fused op
#
# ![A pixel of a range image and those around it as squares, queries as dots between them; the queries of the four cells
# around the middle pixel are marked by crosses](pictures/06b_a_fused_op.png)
#
# **Goal.** You write equation 3 as one Warp kernel, derive and write its backward kernels, and make them a PyTorch op
# that trains.
#
# **After this notebook you can**
#
# - count the bytes that a chain of PyTorch operations moves, and say what fusing them saves;
# - write a forward kernel and its backward kernels from a derivation on paper;
# - tell a gather from a scatter, and add up what many threads say of one pixel without a race;
# - wrap kernels as `autograd.Function` and as a `torch.library` op, and test them with `gradcheck` and `opcheck`.
#
# | | |
# |---|---|
# | You know | queries and neighbours (03), weights by softmax (05), adjoints and `gradcheck` (06a) |
# | Time | 35 minutes, and 60 for the exercises; one more of 15 minutes is optional; under a minute to run |
# | Hardware | any computer; a CUDA GPU is used if there is one |
#
# The exercises build on each other. Where you skip one, what follows uses a PyTorch version in its place. Most sections
# ask you for a prediction. Write it down before you run the next cell.

# %%
import time
from typing import Any

import matplotlib.pyplot as plt
import torch
import warp as wp
from torch.utils._python_dispatch import TorchDispatchMode

from ilnet.course import check, draw_trace, run, trace_thread, yours_or
from ilnet.sensor import preset
from kernels import gather_blend
from kernels.launch import initialise

torch.manual_seed(0)
initialise()  # starts Warp without its greeting
device = "cuda" if torch.cuda.is_available() else "cpu"

# %% [markdown]
# ## 1. Six steps, and what they move
#
# Equation 3 of the paper blends the ranges $r_t$ of the four neighbours with weights that a network scored:
#
# $$\hat r = \sum_t w_t r_t, \qquad w = \operatorname{softmax}(s)$$
#
# A small world to try it in: a level road 1.8 m below the sensor, a wall 15 m ahead, another 40 m behind, and a round
# pillar. Its ranges have a formula, so that any ray can be asked without casting it.

# %%
coarse, fine = preset("paper-16x1024"), preset("paper-128x2048")


def ranges_along(directions):
    """Ranges (...) to a road, two walls and a pillar along unit vectors (..., 3)."""
    x, y, z = directions.unbind(-1)
    road = torch.where(z < 0, -1.8 / z, torch.inf)
    walls = torch.where(x > 0, 15.0 / x, -40.0 / x)
    across = x**2 + y**2  # the pillar: |p - (8, 3)| = 0.5, seen from above
    half = (8 * x + 3 * y) / across
    root = half**2 - (73 - 0.25) / across
    pillar = torch.where((root > 0) & (half > 0), half - root.clamp(min=0).sqrt(), torch.inf)
    return torch.stack((road, walls, pillar)).amin(0).clamp(max=80.0)


image = ranges_along(coarse.directions()).to(device)  # (H, W) [m]
queries = coarse.grid_queries(fine).view(-1, 2).to(device)  # (Q, 2)
scores = torch.randn(len(queries), 4, device=device)  # (Q, 4): what a network would say
print(f"image {tuple(image.shape)}, queries {tuple(queries.shape)}, scores {tuple(scores.shape)}")

# %% tags=["hide-input"]
figure, axes = plt.subplots(figsize=(9, 2.2), layout="constrained")
extent = (-180, 180, -15, 15)
shown = axes.imshow(
    image.cpu(), cmap="viridis_r", origin="lower", extent=extent, aspect="auto", interpolation="nearest"
)
axes.set(xlabel="azimuth [°]", ylabel="elevation [°]", title="the range image: 16 x 1024 pixels")
figure.colorbar(shown, label="range [m]")
plt.show()

# %% [markdown]
# *In words: the range image. In the upper half the wall ahead, from 15 m on, in the middle, the wall behind at both
# ends, and nothing (80 m) between them; below lies the road, nearer from row to row; the pillar is an upright stripe at
# 20°.*


# %% [markdown]
# In PyTorch the blend is a line per step. Each operation inside a step reads whole tensors from memory and writes whole
# tensors to memory, even if the next one needs them at once and nobody ever needs them again.
#
# **Predict:** a query brings 2 + 4 floats, meets 4 pixels and leaves 1 range: 44 bytes. How many do the steps move?


# %%
def blend_steps(image, queries, scores):
    """Equation 3, a step at a time; rows clamp, columns wrap."""
    height, width = image.shape
    row, column = queries.floor().long().unbind(-1)  # 1. the pixel (row-, column-)
    rows = torch.stack((row, row, row + 1, row + 1), -1).clamp(0, height - 1)  # 2. rows of the 4 neighbours
    columns = torch.stack((column, column + 1, column, column + 1), -1) % width  # 3. and their columns
    ranges = image[rows, columns]  # 4. gather
    weights = scores.softmax(-1)  # 5. softmax
    return (weights * ranges).sum(-1)  # 6. blend


# %% [markdown]
# (From here on $t$ counts from 0, as in code.) Count. A float32 has 4 bytes, an index (int64) 8. Per query:
#
# | step | reads | writes | together |
# |---|---|---|---|
# | 1. `floor`; `long` | 2·4; 2·4 | 2·4; 2·8 | 40 |
# | 2. `row + 1`, twice; `stack`; `clamp` | 2·8; 4·8; 4·8 | 2·8; 4·8; 4·8 | 160 |
# | 3. the same for columns, with `%` for `clamp` | 2·8; 4·8; 4·8 | 2·8; 4·8; 4·8 | 160 |
# | 4. gather: two indices and the pixels of 4 neighbours | 2·4·8 + 4·4 | 4·4 | 96 |
# | 5. softmax | 4·4 | 4·4 | 32 |
# | 6. product; sum | 2·4·4; 4·4 | 4·4; 4 | 68 |
# | **all steps** | | | **556** |
# | **needed**: query, scores, 4 pixels in; one range out | 2·4 + 4·4 + 4·4 | 4 | **44** |
#
# The pixels are read from an image of 64 KiB, which stays in the processor's cache: 16 of the 44 bytes cost next to
# nothing. Nearly three quarters of what the steps move are indices, which say nothing that the query did not say.
#
# Is the table right? PyTorch can tell: a *dispatch mode* sees every operation with its tensors. (Inside, `long` is
# called `_to_copy`, `%` `remainder`, and a gather `index`.) Views (`unbind`) move nothing and are left out.


# %%
class Traffic(TorchDispatchMode):
    """Adds up the bytes that operations read and write."""

    def __init__(self):
        super().__init__()
        self.bytes, self.steps = 0, []

    def __torch_dispatch__(self, operation, types, arguments=(), keywords=None):
        result = operation(*arguments, **(keywords or {}))
        if not operation.is_view:
            flat = torch.utils._pytree.tree_leaves((arguments, keywords, result))
            tensors = [x for x in flat if isinstance(x, torch.Tensor)]
            moved = sum(x.numel() * x.element_size() for x in tensors)
            if operation is torch.ops.aten.index.Tensor:  # of the gathered image only what is picked
                moved += result.nbytes - arguments[0].nbytes
            self.bytes += moved
            self.steps.append((operation.__name__.split(".")[0], moved))
        return result


with Traffic() as forward_steps:
    blend_steps(image, queries, scores)
for name, moved in forward_steps.steps:
    print(f"{name:>10} {moved / len(queries):6.0f} bytes per query")
per_query_steps = forward_steps.bytes / len(queries)
print(f"{'all':>10} {per_query_steps:6.0f}")
assert per_query_steps == 556

# %% [markdown]
# The count agrees with the table: the steps move more than twelve times what is needed. And a moved byte is what such
# steps cost: there is next to no arithmetic in them.
#
# ## 2. One kernel
#
# A *fused* op does all steps for one query before it turns to the next. What lies between them never leaves the
# *registers*, the few numbers that a thread has at hand. So: one thread per query.
#
# The softmax needs one precaution. $e^{s}$ overflows float32 at $s = 89$, but weights do not change when all four
# scores fall by the same amount, $e^{s_t - m} / \sum_u e^{s_u - m}$. With $m = \max_u s_u$ no exponent is positive,
# and the sum is at least 1. The sum need not be known before the blend, either:
#
# $$\hat r = \frac{\sum_t e^{s_t - m}\, r_t}{\sum_t e^{s_t - m}}$$
#
# | equation | line of code | kernel argument |
# |---|---|---|
# | $t = 0 \ldots 3$, the pixels around $q$ | `i, j = pixel(queries[q, 0], queries[q, 1], t, ...)` | `queries` (Q, 2) |
# | $r_t$ | `image[i, j]` | `image` (H, W) |
# | $s_t$ | `scores[q, t]` | `scores` (Q, 4) |
# | $\hat r$ | one division | `blended_out` (Q,) |
#
# `Any` stands for whatever is passed: float32 to use the kernel, float64 to test it. A number of that type is
# `image.dtype(0.0)`. `module="unique"` compiles each kernel on its own, and `enable_backward=False` says that Warp need
# not derive its adjoint: you will.


# %%
@wp.func
def pixel(row: Any, column: Any, t: int, height: int, width: int):
    """Row and column of neighbour t of a query: rows clamp, columns wrap."""
    i = int(wp.floor(row)) + t // 2
    j = int(wp.floor(column)) + t % 2
    return wp.clamp(i, 0, height - 1), (j % width + width) % width  # in a kernel, -1 % width is -1, as in C


# A small problem for checks and drawings: five by nine pixels, six queries. NaN shows what no thread writes.
tiny = 5 + 20 * torch.rand(5, 9, device=device)
tiny_queries = torch.tensor([[0.3, 0.6], [1.5, 3.5], [2.2, 5.4], [-0.5, 1.0], [3.1, 8.4], [4.2, 2.5]], device=device)
tiny_scores = torch.randn(6, 4, device=device)
unwritten = torch.full((6,), torch.nan, device=device)

# %% [markdown]
# A kernel to start from, which weighs the four pixels equally. What does one of its threads touch? `trace_thread` (06a)
# replays thread 2, whose query is (2.2, 5.4), and counts the bytes.


# %%
@wp.kernel(module="unique", enable_backward=False)
def mean_kernel(
    # in
    image: wp.array2d[Any],
    queries: wp.array2d[Any],
    # out
    means_out: wp.array[Any],
):
    q = wp.tid()
    total = image.dtype(0.0)
    for t in range(4):
        i, j = pixel(queries[q, 0], queries[q, 1], t, image.shape[0], image.shape[1])
        total += image[i, j]
    means_out[q] = total / image.dtype(4.0)


draw_trace(mean_kernel, 2, [tiny, tiny_queries, unwritten], "one sum\nin a register")

# %% [markdown]
# *In words: the thread reads four pixels of the image, two by two, and one row of `queries`, and writes one element of
# `means_out`: 28 bytes.*
#
# A kernel needs someone to launch it: the *host*, a Python function that makes the output and passes the tensors.
# (`run` of `ilnet.course` hands them to Warp without a copy. On a CPU such a launch runs on one core.)


# %%
def blend_forward(image, queries, scores):
    blended = image.new_empty(len(queries))
    run(blend_kernel, len(queries), [image, queries, scores], [blended])
    return blended


# %% [markdown]
# ### Exercise 1 · Forward
#
# importance ★★★ · difficulty ★★☆ · 10 minutes
#
# Write the body of `blend_kernel`, beginning with `q = wp.tid()`. `wp.max` takes two numbers. If Warp refuses your
# kernel, read the last line of its message.
#
# <details><summary>Hint: the outline</summary>
#
# First a loop for the largest score: `largest = scores[q, 0]`, then `for t in range(1, 4):`. Then a second loop over
# `range(4)` that adds to two local variables, `total` and `mixed`. Then one line that writes.
#
# </details>
# <details><summary>Hint: types</summary>
#
# Warp does not mix types: begin with `total = image.dtype(0.0)`.
#
# </details>


# %% tags=["exercise"]
@wp.kernel(module="unique", enable_backward=False)
def blend_kernel(
    # in
    image: wp.array2d[Any],
    queries: wp.array2d[Any],
    scores: wp.array2d[Any],
    # out
    blended_out: wp.array[Any],
):
    raise NotImplementedError


# %% tags=["solution"]
@wp.kernel(module="unique", enable_backward=False)
def blend_kernel(
    # in
    image: wp.array2d[Any],
    queries: wp.array2d[Any],
    scores: wp.array2d[Any],
    # out
    blended_out: wp.array[Any],
):
    q = wp.tid()
    largest = scores[q, 0]
    for t in range(1, 4):
        largest = wp.max(largest, scores[q, t])
    total = image.dtype(0.0)
    mixed = image.dtype(0.0)
    for t in range(4):
        i, j = pixel(queries[q, 0], queries[q, 1], t, image.shape[0], image.shape[1])
        e = wp.exp(scores[q, t] - largest)
        total += e
        mixed += e * image[i, j]
    blended_out[q] = mixed / total


# %% tags=["check"]
@check
def _():
    trace = trace_thread(blend_kernel, 2, [tiny, tiny_queries, tiny_scores, unwritten])
    written = [(cells.name, cells.touched) for cells in trace.writes]
    assert written == [("blended_out", [(0, 2)])], f"thread 2 should write blended_out[2] once; it writes {written}"
    wanted = blend_steps(tiny, tiny_queries, tiny_scores)
    found = blend_forward(tiny, tiny_queries, tiny_scores)
    equal = blend_forward(tiny, tiny_queries, 0 * tiny_scores)
    means = blend_steps(tiny, tiny_queries, 0 * tiny_scores)
    assert torch.allclose(equal, means, atol=1e-4), (
        f"equal scores give the mean of the four: {means[0]:.3f} m, you have {equal[0]:.3f} m"
    )
    assert torch.allclose(found, wanted, atol=1e-4), (
        f"query 0: {wanted[0]:.3f} m, you have {found[0]:.3f} m. Does score t belong to pixel t?"
    )
    huge = blend_forward(tiny, tiny_queries, 1000 * tiny_scores)
    assert huge.isfinite().all(), "scores of thousands: subtract the largest of the four before exp"
    everywhere = blend_forward(image, queries, scores)
    assert (everywhere - blend_steps(image, queries, scores)).abs().max() < 1e-3, "seam or border of the large image"
    assert trace.bytes == 44, f"thread 2 moves {trace.bytes} bytes; 44 are needed: does it read other elements?"


# %% tags=["wrong"]
@wp.kernel(module="unique", enable_backward=False)
def blend_kernel(
    image: wp.array2d[Any], queries: wp.array2d[Any], scores: wp.array2d[Any], blended_out: wp.array[Any]
):  # exp overflows
    q = wp.tid()
    total = image.dtype(0.0)
    mixed = image.dtype(0.0)
    for t in range(4):
        i, j = pixel(queries[q, 0], queries[q, 1], t, image.shape[0], image.shape[1])
        total += wp.exp(scores[q, t])
        mixed += wp.exp(scores[q, t]) * image[i, j]
    blended_out[q] = mixed / total


# %% tags=["wrong"]
@wp.kernel(module="unique", enable_backward=False)
def blend_kernel(
    image: wp.array2d[Any], queries: wp.array2d[Any], scores: wp.array2d[Any], blended_out: wp.array[Any]
):  # not divided by the sum
    q = wp.tid()
    largest = scores[q, 0]
    for t in range(1, 4):
        largest = wp.max(largest, scores[q, t])
    mixed = image.dtype(0.0)
    for t in range(4):
        i, j = pixel(queries[q, 0], queries[q, 1], t, image.shape[0], image.shape[1])
        mixed += wp.exp(scores[q, t] - largest) * image[i, j]
    blended_out[q] = mixed


# %% tags=["wrong"]
@wp.kernel(module="unique", enable_backward=False)
def blend_kernel(
    image: wp.array2d[Any], queries: wp.array2d[Any], scores: wp.array2d[Any], blended_out: wp.array[Any]
):  # neighbours in another order than scores
    q = wp.tid()
    largest = wp.max(wp.max(scores[q, 0], scores[q, 1]), wp.max(scores[q, 2], scores[q, 3]))
    total = image.dtype(0.0)
    mixed = image.dtype(0.0)
    for t in range(4):
        i, j = pixel(queries[q, 0], queries[q, 1], 3 - t, image.shape[0], image.shape[1])
        total += wp.exp(scores[q, t] - largest)
        mixed += wp.exp(scores[q, t] - largest) * image[i, j]
    blended_out[q] = mixed / total


# %% [markdown]
# What does one thread of *your* kernel touch? **Predict** it for thread 2, whose query is (2.2, 5.4), then look.

# %%
draw_trace(blend_kernel, 2, [tiny, tiny_queries, tiny_scores, unwritten], "4 exponentials,\ntwo sums\nin registers")

# %% [markdown]
# *In words, once the kernel is there: the drawing of `mean_kernel`, with one row of `scores` more on the left.*
#
# ## 3. Backward by hand
#
# Autograd cannot look into our kernel. It hands us $g_q = \partial L / \partial \hat r_q$, and wants
# $\partial L / \partial s$ and $\partial L / \partial I$ for the image $I$.
#
# **Derive both on paper**, for one query: $\partial \hat r / \partial r_t$ and $\partial \hat r / \partial s_t$, with
# $\hat r = \sum_u w_u r_u$ and $w = \operatorname{softmax}(s)$. Three lines are enough.
#
# <details><summary>The three lines</summary>
#
# $$\frac{\partial \hat r}{\partial r_t} = w_t$$
#
# $$\frac{\partial w_u}{\partial s_t} = w_u (\delta_{ut} - w_t) \qquad \text{(quotient rule on } e^{s_u} / \textstyle\sum_v e^{s_v}\text{)}$$
#
# $$\frac{\partial \hat r}{\partial s_t} = \sum_u r_u\, w_u (\delta_{ut} - w_t) = w_t\, r_t - w_t \sum_u w_u r_u = w_t\,(r_t - \hat r)$$
#
# </details>
#
# Test your result: where all ranges are equal no score matters. Where one weight is 1 no score matters either. In code
# $\partial L / \partial x$ is called `adj_x`, for *adjoint*.
#
# **Predict:** backwards a thread needs the weights again. Should the forward kernel have stored them? Count the bytes.
#
# <details><summary>Answer</summary>
#
# Stored weights would cost 16 bytes written, and 16 read where the scores are now read. Four exponentials are cheaper,
# and no memory is held between the passes.
#
# </details>
#
# The host of that kernel:


# %%
def scores_backward(image, queries, scores, adj_blended):
    adj_scores = torch.empty_like(scores)
    run(blend_scores_backward_kernel, len(queries), [image, queries, scores, adj_blended.contiguous()], [adj_scores])
    return adj_scores


adj_blended = torch.randn(len(queries), device=device)  # some gradient that arrives from further on


# %% [markdown]
# ### Exercise 2 · Backward to the scores
#
# importance ★★★ · difficulty ★★☆ · 15 minutes
#
# Write the body of `blend_scores_backward_kernel`: `adj_scores_out[q, t]` is $g_q\, \partial \hat r / \partial s_t$.
#
# <details><summary>Hint</summary>
#
# The first part is your forward kernel. Instead of writing the blend, keep it in a variable. A second loop over
# `range(4)` computes each weight again, `wp.exp(scores[q, t] - largest) / total`, and writes.
#
# </details>


# %% tags=["exercise"]
@wp.kernel(module="unique", enable_backward=False)
def blend_scores_backward_kernel(
    # in
    image: wp.array2d[Any],
    queries: wp.array2d[Any],
    scores: wp.array2d[Any],
    adj_blended: wp.array[Any],
    # out
    adj_scores_out: wp.array2d[Any],
):
    raise NotImplementedError


# %% tags=["solution"]
@wp.kernel(module="unique", enable_backward=False)
def blend_scores_backward_kernel(
    # in
    image: wp.array2d[Any],
    queries: wp.array2d[Any],
    scores: wp.array2d[Any],
    adj_blended: wp.array[Any],
    # out
    adj_scores_out: wp.array2d[Any],
):
    q = wp.tid()
    largest = scores[q, 0]
    for t in range(1, 4):
        largest = wp.max(largest, scores[q, t])
    total = image.dtype(0.0)
    mixed = image.dtype(0.0)
    for t in range(4):
        i, j = pixel(queries[q, 0], queries[q, 1], t, image.shape[0], image.shape[1])
        e = wp.exp(scores[q, t] - largest)
        total += e
        mixed += e * image[i, j]
    blended = mixed / total
    for t in range(4):
        i, j = pixel(queries[q, 0], queries[q, 1], t, image.shape[0], image.shape[1])
        w = wp.exp(scores[q, t] - largest) / total
        adj_scores_out[q, t] = adj_blended[q] * w * (image[i, j] - blended)


# %% tags=["check"]
@check
def _():
    def both(image, s, adj):
        leaf = s.clone().requires_grad_()
        blend_steps(image, tiny_queries, leaf).backward(adj)
        return scores_backward(image, tiny_queries, s, adj), leaf.grad

    ones = torch.ones(6, device=device)
    flat, _ = both(torch.full_like(tiny, 7.0), tiny_scores, ones)
    assert flat.abs().max() < 1e-4, f"where all ranges are equal no score matters: zeros, not {flat[0].tolist()}"
    mine, true = both(tiny, tiny_scores, ones)
    assert not torch.allclose(mine, -true, atol=1e-4), "the sign: a larger score pulls the answer to its neighbour"
    assert torch.allclose(mine, true, atol=1e-4), (
        f"query 0, where the gradient that arrives is 1: {true[0].tolist()}, you have {mine[0].tolist()}"
    )
    mine, true = both(tiny, tiny_scores, torch.arange(6.0, device=device))
    assert torch.allclose(mine, true, atol=1e-4), "the gradient that arrives is a factor: is adj_blended[q] there?"
    mine, _ = both(tiny, 1000 * tiny_scores, ones)
    assert mine.isfinite().all(), "scores of thousands: subtract the largest before exp, as in the forward kernel"
    leaf = scores.clone().requires_grad_()
    blend_steps(image, queries, leaf).backward(adj_blended)
    assert torch.allclose(scores_backward(image, queries, scores, adj_blended), leaf.grad, atol=1e-3), "the large image"


# %% tags=["wrong"]
@wp.kernel(module="unique", enable_backward=False)
def blend_scores_backward_kernel(
    image: wp.array2d[Any],
    queries: wp.array2d[Any],
    scores: wp.array2d[Any],
    adj_blended: wp.array[Any],
    adj_scores_out: wp.array2d[Any],
):  # the answer is not subtracted
    q = wp.tid()
    total = image.dtype(0.0)
    for t in range(4):
        total += wp.exp(scores[q, t])
    for t in range(4):
        i, j = pixel(queries[q, 0], queries[q, 1], t, image.shape[0], image.shape[1])
        adj_scores_out[q, t] = adj_blended[q] * wp.exp(scores[q, t]) / total * image[i, j]


# %% tags=["wrong"]
@wp.kernel(module="unique", enable_backward=False)
def blend_scores_backward_kernel(
    image: wp.array2d[Any],
    queries: wp.array2d[Any],
    scores: wp.array2d[Any],
    adj_blended: wp.array[Any],
    adj_scores_out: wp.array2d[Any],
):  # the gradient that arrives is forgotten
    q = wp.tid()
    total = image.dtype(0.0)
    mixed = image.dtype(0.0)
    for t in range(4):
        i, j = pixel(queries[q, 0], queries[q, 1], t, image.shape[0], image.shape[1])
        total += wp.exp(scores[q, t])
        mixed += wp.exp(scores[q, t]) * image[i, j]
    for t in range(4):
        i, j = pixel(queries[q, 0], queries[q, 1], t, image.shape[0], image.shape[1])
        adj_scores_out[q, t] = wp.exp(scores[q, t]) / total * (image[i, j] - mixed / total)


# %% tags=["wrong"]
@wp.kernel(module="unique", enable_backward=False)
def blend_scores_backward_kernel(
    image: wp.array2d[Any],
    queries: wp.array2d[Any],
    scores: wp.array2d[Any],
    adj_blended: wp.array[Any],
    adj_scores_out: wp.array2d[Any],
):  # a sign
    q = wp.tid()
    total = image.dtype(0.0)
    mixed = image.dtype(0.0)
    for t in range(4):
        i, j = pixel(queries[q, 0], queries[q, 1], t, image.shape[0], image.shape[1])
        total += wp.exp(scores[q, t])
        mixed += wp.exp(scores[q, t]) * image[i, j]
    for t in range(4):
        i, j = pixel(queries[q, 0], queries[q, 1], t, image.shape[0], image.shape[1])
        adj_scores_out[q, t] = adj_blended[q] * wp.exp(scores[q, t]) / total * (mixed / total - image[i, j])


# %% [markdown]
# ## 4. Many queries, one pixel
#
# For the image the arrows turn round. Forward, many queries *gather* from one pixel, and nobody minds. Backward, they
# all *add* to it: a *scatter*.
#
# $$\frac{\partial L}{\partial I_p} = \sum_{(q, t)\,:\ \text{neighbour } t \text{ of } q \text{ is } p} g_q\, w_{q,t}$$
#
# How many terms has that sum, for the pixels of our image?

# %% tags=["goal", "hide-input"]
height, width = image.shape
row, column = queries.floor().long().unbind(-1)
rows = torch.stack((row, row, row + 1, row + 1), -1).clamp(0, height - 1)
columns = torch.stack((column, column + 1, column, column + 1), -1) % width
asked = (rows * width + columns).flatten()  # pixel number of each (query, neighbour)
demand = asked.bincount(minlength=height * width).view(height, width)


here = 8, 300  # one pixel
near = (queries - torch.tensor(here, device=device)).abs().amax(-1) < 2.2
asks = (rows * width + columns == here[0] * width + here[1]).any(-1)
figure, axes = plt.subplots(figsize=(9, 3.2), layout="constrained")
for some, colour, marker, label in (
    (near & ~asks, "#999999", ".", "other queries"),
    (asks, "#d55e00", "x", "its queries"),
):
    axes.plot(*queries[some].flip(-1).T.cpu(), marker, color=colour, label=label, markersize=5)
grid = torch.cartesian_prod(torch.arange(-2, 3), torch.arange(-2, 3)) + torch.tensor(here)
axes.plot(*grid.flip(-1).T, "s", color="white", markeredgecolor="black", markersize=8, label="pixels")
axes.plot(here[1], here[0], "s", color="#0072b2", markersize=10, label=f"pixel {here}")
axes.set(xlabel="column", ylabel="row", title="who adds to one pixel")
axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
plt.show()
print(f"terms per pixel: {demand.float().mean():.0f} on average, at most {demand.max()}")
assert demand.float().mean() == 64

# %% [markdown]
# *In words: five by five pixels drawn as squares, between them the queries as dots, eight or nine rows and two columns
# of them to a cell. The queries of the four cells around the middle pixel are marked by crosses: all of them add to
# it.*
#
# To add, a thread reads the old sum, adds its term, and writes the new sum. If two threads read before either writes,
# one term is lost: a *race*. Here is one in slow motion. PyTorch's `total[index] += term` first reads all, then adds,
# then writes all.
#
# **Predict:** four threads add 1 to pixel 0. What does it hold?

# %%
total = torch.zeros(3)
index = torch.tensor([0, 0, 0, 0, 2])
total[index] += torch.ones(5)
print("read all, add, write all:", total.tolist())
print("one after the other:     ", torch.zeros(3).index_add_(0, index, torch.ones(5)).tolist())
assert total[0] == 1

# %% [markdown]
# Three of four terms are lost, without a warning. `wp.atomic_add` reads, adds and writes as one step that no other
# thread can enter, and so does `+=` on an element of an array. `a[p] = a[p] + x` does *not*. On one core of a CPU, where
# threads run in turn, you would never notice. So the check below replays a thread and looks at how it writes.
#
# The host:


# %%
def image_backward(image, queries, scores, adj_blended):
    adj_image = torch.zeros_like(image)  # the kernel adds to what is there
    run(blend_image_backward_kernel, len(queries), [queries, scores, adj_blended.contiguous()], [adj_image])
    return adj_image


# %% [markdown]
# ### Exercise 3 · Backward to the image
#
# importance ★★★ · difficulty ★★☆ · 10 minutes
#
# Write the body of `blend_image_backward_kernel`: each thread adds $g_q\, w_{q,t}$ to the four pixels of its query. The
# host hands it an array of zeros.
#
# <details><summary>Hint</summary>
#
# The image itself is not needed: $\partial \hat r / \partial r_t$ is the weight alone. Sum the exponentials, then loop
# over the four pixels.
#
# </details>


# %% tags=["exercise"]
@wp.kernel(module="unique", enable_backward=False)
def blend_image_backward_kernel(
    # in
    queries: wp.array2d[Any],
    scores: wp.array2d[Any],
    adj_blended: wp.array[Any],
    # out
    adj_image_out: wp.array2d[Any],
):
    raise NotImplementedError


# %% tags=["solution"]
@wp.kernel(module="unique", enable_backward=False)
def blend_image_backward_kernel(
    # in
    queries: wp.array2d[Any],
    scores: wp.array2d[Any],
    adj_blended: wp.array[Any],
    # out
    adj_image_out: wp.array2d[Any],
):
    q = wp.tid()
    largest = scores[q, 0]
    for t in range(1, 4):
        largest = wp.max(largest, scores[q, t])
    total = scores.dtype(0.0)
    for t in range(4):
        total += wp.exp(scores[q, t] - largest)
    for t in range(4):
        i, j = pixel(queries[q, 0], queries[q, 1], t, adj_image_out.shape[0], adj_image_out.shape[1])
        adj_image_out[i, j] += adj_blended[q] * wp.exp(scores[q, t] - largest) / total


# %% tags=["check"]
@check
def _():
    trace = trace_thread(blend_image_backward_kernel, 2, [tiny_queries, tiny_scores, unwritten, 0 * tiny])
    assert "adj_image_out" not in [cells.name for cells in trace.reads], (
        "a race: the thread reads adj_image_out and writes it later, and another may write in between. Use += or "
        "wp.atomic_add"
    )
    names = [cells.name for cells in trace.writes]
    assert names == ["adj_image_out +="], (
        f"other threads add to the same pixels: this one should add, not write {names}"
    )
    leaf = tiny.clone().requires_grad_()
    adj = torch.arange(1.0, 7.0, device=device)
    blend_steps(leaf, tiny_queries, tiny_scores).backward(adj)
    mine = image_backward(tiny, tiny_queries, tiny_scores, adj)
    assert abs(mine.sum() - adj.sum()) < 1e-3, (
        f"weights sum to 1, so all pixels together get {adj.sum():.0f}; yours get {mine.sum():.3f}"
    )
    assert torch.allclose(mine, leaf.grad, atol=1e-4), "the sum is right, but it arrives at other pixels"
    leaf = image.clone().requires_grad_()
    blend_steps(leaf, queries, scores).backward(adj_blended)
    assert torch.allclose(image_backward(image, queries, scores, adj_blended), leaf.grad, atol=1e-2), "the large image"


# %% tags=["wrong"]
@wp.kernel(module="unique", enable_backward=False)
def blend_image_backward_kernel(
    queries: wp.array2d[Any], scores: wp.array2d[Any], adj_blended: wp.array[Any], adj_image_out: wp.array2d[Any]
):  # a race, which one core does not show
    q = wp.tid()
    total = scores.dtype(0.0)
    for t in range(4):
        total += wp.exp(scores[q, t])
    for t in range(4):
        i, j = pixel(queries[q, 0], queries[q, 1], t, adj_image_out.shape[0], adj_image_out.shape[1])
        adj_image_out[i, j] = adj_image_out[i, j] + adj_blended[q] * wp.exp(scores[q, t]) / total


# %% tags=["wrong"]
@wp.kernel(module="unique", enable_backward=False)
def blend_image_backward_kernel(
    queries: wp.array2d[Any], scores: wp.array2d[Any], adj_blended: wp.array[Any], adj_image_out: wp.array2d[Any]
):  # the last thread wins
    q = wp.tid()
    total = scores.dtype(0.0)
    for t in range(4):
        total += wp.exp(scores[q, t])
    for t in range(4):
        i, j = pixel(queries[q, 0], queries[q, 1], t, adj_image_out.shape[0], adj_image_out.shape[1])
        adj_image_out[i, j] = adj_blended[q] * wp.exp(scores[q, t]) / total


# %% tags=["wrong"]
@wp.kernel(module="unique", enable_backward=False)
def blend_image_backward_kernel(
    queries: wp.array2d[Any], scores: wp.array2d[Any], adj_blended: wp.array[Any], adj_image_out: wp.array2d[Any]
):  # scores instead of weights
    q = wp.tid()
    for t in range(4):
        i, j = pixel(queries[q, 0], queries[q, 1], t, adj_image_out.shape[0], adj_image_out.shape[1])
        adj_image_out[i, j] += adj_blended[q] * wp.exp(scores[q, t])


# %%
draw_trace(
    blend_image_backward_kernel,
    2,
    [tiny_queries, tiny_scores, unwritten, 0 * tiny],
    "4 weights,\neach times g",
)

# %% [markdown]
# *In words, once the kernel is there: the thread reads one row each of queries and scores and one element of
# `adj_blended`, and adds to four pixels, two by two: just those that the forward kernel read. The thread of the next
# query adds to some of the same.*
#
# ## 5. A function of PyTorch
#
# A `torch.autograd.Function` ties forward and backward together. Its `backward` returns one gradient for each argument
# of `forward`, and `None` for one that needs none. What backward needs goes through `ctx.save_for_backward`.
#
# From here on, `forward`, `to_scores` and `to_image` are your functions, or their stand-ins in PyTorch where you skipped
# an exercise.


# %%
def scores_formula(image, queries, scores, adj_blended):
    weights, ranges = scores.softmax(-1), gather_ranges(image, queries)
    return adj_blended[:, None] * weights * (ranges - (weights * ranges).sum(-1, keepdim=True))


def image_formula(image, queries, scores, adj_blended):
    terms = (adj_blended[:, None] * scores.softmax(-1)).flatten()
    return torch.zeros_like(image).flatten().index_add(0, pixel_numbers(image, queries), terms).view(image.shape)


def pixel_numbers(image, queries):
    """Which pixel each (query, neighbour) is, counted row by row: (4 Q,)."""
    row, column = queries.floor().long().unbind(-1)
    rows = torch.stack((row, row, row + 1, row + 1), -1).clamp(0, len(image) - 1)
    columns = torch.stack((column, column + 1, column, column + 1), -1) % image.shape[1]
    return (rows * image.shape[1] + columns).flatten()


def gather_ranges(image, queries):
    return image.flatten()[pixel_numbers(image, queries)].view(-1, 4)


forward = yours_or(blend_steps, blend_forward)
to_scores = yours_or(scores_formula, scores_backward)
to_image = yours_or(image_formula, image_backward)


# %%
def test_inputs():
    """A handful of queries in float64, at the seam, at a border, and two that are equal."""
    small = {"dtype": torch.float64, "device": device}
    test_queries = torch.tensor([[0.3, 0.6], [1.5, 3.5], [2.2, -0.4], [-0.5, 1.0], [0.3, 0.6]], **small)
    test_image = (2 + 10 * torch.rand(3, 4, **small)).requires_grad_()
    return test_image, test_queries, torch.randn(5, 4, **small).requires_grad_()


# %% [markdown]
# ### Exercise 4 · An autograd function
#
# importance ★★★ · difficulty ★★☆ · 10 minutes
#
# Write both methods of `Blend`, with `forward(...)`, `to_scores(...)` and `to_image(...)`. The queries need no gradient.
#
# <details><summary>Hint</summary>
#
# `ctx.save_for_backward(image, queries, scores)` in one method, `ctx.saved_tensors` in the other. `to_scores` and
# `to_image` both take these three and `adj_blended`.
#
# </details>


# %% tags=["exercise"]
class Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, queries, scores):
        raise NotImplementedError

    @staticmethod
    def backward(ctx, adj_blended):
        raise NotImplementedError


# %% tags=["solution"]
class Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, queries, scores):
        ctx.save_for_backward(image, queries, scores)
        return forward(image, queries, scores)

    @staticmethod
    def backward(ctx, adj_blended):
        saved = ctx.saved_tensors
        return to_image(*saved, adj_blended), None, to_scores(*saved, adj_blended)


# %% tags=["check"]
@check
def _():
    inputs = test_inputs()
    blended = Blend.apply(*inputs)
    assert torch.allclose(blended, blend_steps(*inputs)), "forward should return the blend"
    mine = torch.autograd.grad(blended.sum(), (inputs[0], inputs[2]))
    true = torch.autograd.grad(blend_steps(*inputs).sum(), (inputs[0], inputs[2]))
    for name, a, b in zip(("image", "scores"), mine, true, strict=True):
        assert a.shape == b.shape, f"the gradient of {name} has shape {tuple(a.shape)}; it should be {tuple(b.shape)}"
        assert torch.allclose(a, b), f"the gradient of {name} is off. backward returns them in the order of forward"
    # nondet_tol: on a GPU the order of atomic additions, and so the last digit, differs from run to run.
    assert torch.autograd.gradcheck(Blend.apply, inputs, nondet_tol=1e-12, raise_exception=False), (
        "gradcheck refuses it: does what arrives, adj_blended, reach both?"
    )


# %% tags=["wrong"]
class Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, queries, scores):
        ctx.save_for_backward(image, queries, scores)
        return forward(image, queries, scores)

    @staticmethod
    def backward(ctx, adj_blended):  # adj_blended is replaced by ones in one of the two
        image, queries, scores = ctx.saved_tensors
        ones = torch.ones_like(adj_blended)
        return to_image(image, queries, scores, ones), None, to_scores(image, queries, scores, adj_blended)


# %% tags=["wrong"]
class Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, queries, scores):
        ctx.save_for_backward(image, queries, scores)
        return forward(image, queries, scores)

    @staticmethod
    def backward(ctx, adj_blended):  # the mean over queries, as for a loss
        saved = ctx.saved_tensors
        count = len(adj_blended)
        return to_image(*saved, adj_blended / count), None, to_scores(*saved, adj_blended / count)


# %% [markdown]
# ### A registered op
#
# `torch.compile` and `torch.export` cannot see through a `Function` that launches foreign kernels. A *custom op* of
# `torch.library` tells them what they need: a name, the types of its arguments, a *fake* that says shape, dtype and
# device of the result without computing it, and its backward. The backward is an op of its own. Here it is, complete;
# the forward op is yours.


# %%
@torch.library.custom_op("course::blend_backward", mutates_args=())
def blend_backward_op(
    image: torch.Tensor, queries: torch.Tensor, scores: torch.Tensor, adj_blended: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    saved = image, queries, scores, adj_blended
    return to_image(*saved), to_scores(*saved)


@blend_backward_op.register_fake
def _(image, queries, scores, adj_blended):
    return torch.empty_like(image), torch.empty_like(scores)


# %% [markdown]
# ### Exercise 5 · Register it
#
# importance ★★☆ · difficulty ★★☆ · 15 minutes
#
# Write `make_op()`, which defines the op `course::blend`, registers its fake and its backward, and returns it. The fake
# returns an empty tensor of the right shape, dtype and device, and computes nothing. `torch.library.opcheck` runs
# PyTorch's four tests of such an op.
#
# <details><summary>Hint: the op</summary>
#
# As above: `@torch.library.custom_op("course::blend", mutates_args=())` over a function with annotated arguments, which
# returns `forward(image, queries, scores)`. In the fake, `image.new_empty(...)` keeps dtype and device.
#
# </details>
# <details><summary>Hint: the backward</summary>
#
# `op.register_autograd(backward, setup_context=setup)`, where `setup(ctx, inputs, output)` saves `inputs` for backward,
# and `backward(ctx, adj_blended)` calls `blend_backward_op` and returns three gradients.
#
# </details>


# %% tags=["exercise"]
def make_op():
    raise NotImplementedError


# %% tags=["solution"]
def make_op():
    @torch.library.custom_op("course::blend", mutates_args=())
    def op(image: torch.Tensor, queries: torch.Tensor, scores: torch.Tensor) -> torch.Tensor:
        return forward(image, queries, scores)

    @op.register_fake
    def _(image, queries, scores):
        return image.new_empty(len(queries))

    def setup(ctx, inputs, output):
        ctx.save_for_backward(*inputs)

    def backward(ctx, adj_blended):
        adj_image, adj_scores = blend_backward_op(*ctx.saved_tensors, adj_blended)
        return adj_image, None, adj_scores

    op.register_autograd(backward, setup_context=setup)
    return op


# %% tags=["check"]
@check
def _():
    op, inputs = make_op(), test_inputs()
    assert torch.allclose(op(*inputs), blend_steps(*inputs)), "the op should return the blend"
    fake = op(*(x.detach().to("meta") for x in inputs))
    assert fake.shape == (5,), f"the fake has shape {tuple(fake.shape)}; it should be (Q,), here (5,)"
    assert fake.dtype == torch.float64, f"the fake is {fake.dtype}, though the image is float64"
    assert op(*inputs).requires_grad, "the result has no gradient: register_autograd is missing"
    for name, result in torch.library.opcheck(op, inputs, raise_exception=False).items():
        assert result == "SUCCESS", f"opcheck, {name}: {result}"
    assert torch.autograd.gradcheck(op, inputs, nondet_tol=1e-12, raise_exception=False), (
        "gradcheck refuses it: does backward return the gradients in the order of the arguments?"
    )


# %% tags=["wrong"]
def make_op():  # the fake forgets dtype and device
    @torch.library.custom_op("course::blend", mutates_args=())
    def op(image: torch.Tensor, queries: torch.Tensor, scores: torch.Tensor) -> torch.Tensor:
        return forward(image, queries, scores)

    @op.register_fake
    def _(image, queries, scores):
        return torch.empty(len(queries), device=image.device)

    op.register_autograd(
        lambda ctx, adj: (lambda pair: (pair[0], None, pair[1]))(blend_backward_op(*ctx.saved_tensors, adj)),
        setup_context=lambda ctx, inputs, output: ctx.save_for_backward(*inputs),
    )
    return op


# %% tags=["wrong"]
def make_op():  # no backward
    @torch.library.custom_op("course::blend", mutates_args=())
    def op(image: torch.Tensor, queries: torch.Tensor, scores: torch.Tensor) -> torch.Tensor:
        return forward(image, queries, scores)

    @op.register_fake
    def _(image, queries, scores):
        return image.new_empty(len(queries))

    return op


# %% tags=["wrong"]
def make_op():  # the fake has the shape of the scores
    @torch.library.custom_op("course::blend", mutates_args=())
    def op(image: torch.Tensor, queries: torch.Tensor, scores: torch.Tensor) -> torch.Tensor:
        return forward(image, queries, scores)

    @op.register_fake
    def _(image, queries, scores):
        return torch.empty_like(scores)

    op.register_autograd(
        lambda ctx, adj: (lambda pair: (pair[0], None, pair[1]))(blend_backward_op(*ctx.saved_tensors, adj)),
        setup_context=lambda ctx, inputs, output: ctx.save_for_backward(*inputs),
    )
    return op


# %% [markdown]
# ## 6. Train through it
#
# If the op is right, one can learn through it. No network here: the scores themselves are the parameters, one set of
# four for each query, and they see the truth. So this asks how far *any* network can get that predicts weights: to the
# truth where it lies between the neighbours, else to the nearest neighbour.
#
# **Predict:** how close to the truth do freely chosen weights come, compared with bilinear interpolation?

# %%
blend = yours_or(lambda: gather_blend, make_op)()
truth = ranges_along(fine.directions()).view(-1).to(device)
every = slice(0, None, 4)  # every fourth query is enough
part, goal = queries[every], truth[every]
free = torch.zeros(len(part), 4, device=device, requires_grad=True)
optimiser = torch.optim.Adam([free], lr=0.1)
for _ in range(60):
    optimiser.zero_grad()
    loss = (blend(image, part, free) - goal).abs().sum()
    loss.backward()
    optimiser.step()

bilinear = gather_blend(image, part, torch.zeros_like(free), "bilinear")
neighbours = gather_ranges(image, part)
within = goal.clamp(neighbours.amin(-1), neighbours.amax(-1))  # the nearest that a blend can say
errors = {"bilinear": bilinear, "learned scores": blend(image, part, free.detach()), "best blend": within}
mae = {name: (answer - goal).abs().mean().item() for name, answer in errors.items()}
for name, error in mae.items():
    print(f"{name:>15}: {error:.4f} m from the truth, on average")
assert mae["best blend"] <= mae["learned scores"] + 1e-4
assert mae["learned scores"] < 0.15 * mae["bilinear"]

# %% [markdown]
# In sixty steps the gradients lead the scores most of the way to where weights can get. What a network adds is to
# find such scores without the truth.
#
# ## 7. What it is worth
#
# First the bytes. `Traffic` counts what PyTorch's autograd moves for the steps of section 1, forward and backward. The
# traces count what the kernels move: 44 bytes forward, 60 for the scores, and 60 for the image, whose pixels are read
# and written. (What an operation moves inside, such as the sorting in PyTorch's scatter, stays uncounted.)
#
# The library's `gather_blend` is the same idea with more care: all cores of a CPU share a launch, a thread takes several
# queries at a time so that the compiler can use vector instructions, one kernel makes both gradients, and it stores the
# weights, since it can return them as well. Its scores can also be added to a prior, such as bilinear areas.
#
# **Predict:** the kernels move twelve times fewer bytes forward. How much faster are they?


# %%
def milliseconds(function, repeats=15):
    """The shortest of several runs: what else the computer does only ever adds."""
    times = []
    for _ in range(repeats + 1):  # the first compiles and is not the shortest
        if device == "cuda":
            torch.cuda.synchronize()
        start = time.perf_counter()
        function()
        if device == "cuda":
            torch.cuda.synchronize()
        times.append(1e3 * (time.perf_counter() - start))
    return min(times)


leaves = image.clone().requires_grad_(), queries, scores.clone().requires_grad_()
with Traffic() as both_steps:
    blend_steps(*leaves).backward(adj_blended)
with Traffic() as forward_steps:
    blend_steps(image, queries, scores)

ways = {"PyTorch steps": blend_steps, "gather_blend": gather_blend}
counted = {
    "PyTorch steps": (forward_steps.bytes / len(queries), both_steps.bytes / len(queries)),
    "gather_blend": (44 + 16, 44 + 16 + (8 + 16 + 16 + 4 + 16 + 2 * 16)),  # with weights; backward in one kernel
}
try:
    Blend.apply(*leaves).backward(adj_blended)
except NotImplementedError:
    print("Your own kernels join the comparison once exercise 4 is answered.")
else:
    ways["your kernels"], counted["your kernels"] = Blend.apply, (44, 44 + 60 + 60)

measured = {}
for name, way in ways.items():
    once = milliseconds(lambda way=way: way(image, queries, scores))
    measured[name] = once, milliseconds(lambda way=way: way(*leaves).backward(adj_blended))
    print(f"{name:>13}: {counted[name][0]:4.0f} bytes per query and {once:5.1f} ms forward, ", end="")
    print(f"{counted[name][1]:5.0f} bytes and {measured[name][1]:5.1f} ms with backward")
ours, theirs = (way(*leaves) for way in (blend, gather_blend))
assert torch.allclose(ours, theirs, atol=1e-4)
assert counted["PyTorch steps"][0] > 9 * counted["gather_blend"][0]

# %% tags=["hide-input"]
colours = {"PyTorch steps": "#999999", "gather_blend": "#009e73", "your kernels": "#0072b2"}
figure, axes = plt.subplots(1, 2, figsize=(10, 3), layout="constrained", sharey=True)
for axis, numbers, unit in ((axes[0], counted, "bytes per query, counted"), (axes[1], measured, "ms, measured here")):
    for place, name in enumerate(ways):
        for up, hatch, value in ((-0.2, "", numbers[name][0]), (0.2, "///", numbers[name][1])):
            axis.barh(place + up, value, 0.38, color=colours[name], edgecolor="black", hatch=hatch)
            axis.text(value, place + up, f" {value:.0f}" if value > 20 else f" {value:.1f}", va="center", fontsize=9)
    axis.set(xlabel=unit, yticks=range(len(ways)), yticklabels=list(ways))
    axis.margins(x=0.15)
    axis.spines[["top", "right"]].set_visible(False)
axes[0].invert_yaxis()
axes[0].set_title(f"{len(queries):,} queries: forward; hatched: forward and backward", loc="left", fontsize=10)
plt.show()

# %% [markdown]
# *In words: two bar charts with a pair of bars for each way, forward and with backward. Left, bytes counted: PyTorch's
# steps have by far the longest bars. Right, milliseconds measured on the computer that built this page.*
#
# Bytes predict which way is faster, though not by how much: what was just written is often still in a cache. On a CPU
# your kernels run on one core, while PyTorch and `gather_blend` take all of them. `torch.compile` fuses such chains by
# itself where it finds a compiler, and is then nearly as fast forward: the README has both in one table. It cannot
# change the algorithm, which the next notebook does.
#
# ## 8. Optional: a sum without atomics
#
# Atomics have a price. On a GPU the order of the additions differs from run to run, and with it the rounding; and
# threads queue up where 64 of them want the same pixel.
#
# **Turn the scatter into a gather.** Give each *pixel* a thread, which reads the terms that belong to it and writes one
# number that no one else writes. No race, always the same order, no atomics. The thread must know who asked for its
# pixel: sort the terms by pixel once, and note where each pixel's terms begin.
#
# | term e (of query `e // 4`) | 0 | 1 | 2 | 3 | 4 | 5 | 6 | 7 |
# |---|---|---|---|---|---|---|---|---|
# | its pixel | 5 | 6 | 9 | 10 | 5 | 6 | 9 | 10 |
# | `order`: terms sorted by pixel | 0 | 4 | 1 | 5 | 2 | 6 | 3 | 7 |
# | pixel of `order[k]` | 5 | 5 | 6 | 6 | 9 | 9 | 10 | 10 |
#
# Pixel p's terms are `order[starts[p]]` to `order[starts[p + 1] - 1]`: for pixel 6, `starts[6]` is 2 and `starts[7]`
# is 4; for pixels 7 and 8 both ends are 4, no terms. The library's ops do this on GPUs (`kernels/scatter.py`,
# `sum_by_pixel`; they sort the *cells* between pixels, a quarter as many). On CPUs each core adds to an image of its
# own, and these are summed.
#
# ### Exercise 6 · A sum without a race
#
# importance ★☆☆ · difficulty ★★☆ · 15 minutes
#
# Write `sum_by_pixel(values, pixels, count)`: for float32 `values` (N,) and int64 `pixels` (N,) return (count,) with
# the sum of the values of each pixel, 0 where there are none. Sort on the host with torch, then launch a kernel with
# one thread per *pixel*. Terms of equal pixel keep their order, so that the sum is the same in every run. (On a CPU the
# check cannot see a race: a launch runs on one core there.)
#
# <details><summary>Hint: the host</summary>
#
# `ordered, order = torch.sort(pixels, stable=True)`. `torch.searchsorted(ordered, wanted)` counts for each element of
# `wanted` how many of `ordered` are smaller: with `wanted = 0 ... count` that is `starts`, of count + 1 elements.
# int64 tensors arrive in a kernel as `wp.array[wp.int64]`.
#
# </details>
# <details><summary>Hint: the kernel</summary>
#
# `p = wp.tid()`, `total = wp.float32(0.0)`, then `for k in range(int(starts[p]), int(starts[p + 1])):` add
# `values[order[k]]`, then write `total`, also where the loop had nothing to do.
#
# </details>


# %% tags=["exercise"]
def sum_by_pixel(values, pixels, count):
    raise NotImplementedError  # write a kernel above; sort, then launch it here


# %% tags=["solution"]
@wp.kernel(module="unique", enable_backward=False)
def sum_by_pixel_kernel(
    # in
    values: wp.array[float],
    order: wp.array[wp.int64],
    starts: wp.array[wp.int64],
    # out
    sums_out: wp.array[float],
):
    p = wp.tid()
    total = wp.float32(0.0)
    for k in range(int(starts[p]), int(starts[p + 1])):
        total += values[order[k]]
    sums_out[p] = total


def sum_by_pixel(values, pixels, count):
    ordered, order = torch.sort(pixels, stable=True)
    starts = torch.searchsorted(ordered, torch.arange(count + 1, device=pixels.device))
    sums = values.new_empty(count)
    run(sum_by_pixel_kernel, count, [values, order, starts], [sums])
    return sums


# %% tags=["check"]
@check
def _():
    def ask(values, pixels, count):
        values, pixels = torch.tensor(values, device=device), torch.tensor(pixels, device=device, dtype=torch.long)
        answer = sum_by_pixel(values, pixels, count)
        assert answer.shape == (count,), f"the result has shape {tuple(answer.shape)}; it should be ({count},)"
        return answer.tolist()

    said = ask([1.0, 2.0, 4.0, 8.0], [1, 3, 1, 1], 5)
    assert said[1] != 8.0, "pixel 1 has three terms, and two of them are lost: is something else adding to it?"
    assert said[1] == 13.0, f"pixel 1 has terms 1, 4 and 8; you have {said[1]}. Where do its terms begin and end?"
    assert said[3] == 2.0, f"pixel 3 has one term, 2; you have {said[3]}"
    assert said[0] == said[2] == said[4] == 0.0, f"nobody asks for pixels 0, 2 and 4: 0, not {said}"
    assert ask([1.0] * 1000, [2] * 1000, 3) == [0.0, 0.0, 1000.0], "1000 terms of 1 for the last pixel: 1000"
    assert ask([1.0, 2.0], [0, 2], 3) == [1.0, 0.0, 2.0], "the first and the last pixel count as well"
    assert ask([], [], 2) == [0.0, 0.0], "no terms at all: zeros"
    terms = scores.softmax(-1).flatten() * adj_blended.repeat_interleave(4)
    mine = sum_by_pixel(terms, asked, height * width).view(height, width)
    atomic = to_image(image, queries, scores, adj_blended)
    assert torch.allclose(mine, atomic, atol=1e-2), "the gradient of the image differs from the atomics'"


# %% tags=["wrong"]
def sum_by_pixel(values, pixels, count):  # terms get lost
    sums = values.new_zeros(count)
    sums[pixels] += values
    return sums


# %% tags=["wrong"]
def sum_by_pixel(values, pixels, count):  # differences of a running sum, each pixel's first term left out
    ordered, order = torch.sort(pixels, stable=True)
    starts = torch.searchsorted(ordered, torch.arange(count + 1, device=pixels.device))
    running = torch.cat((values.new_zeros(1), values[order].cumsum(0)))
    first = (starts[:-1] + 1).clamp(max=len(values))
    return running[starts[1:]] - running[torch.minimum(first, starts[1:])]


# %% tags=["wrong"]
def sum_by_pixel(values, pixels, count):  # only pixels that somebody asks for
    return torch.stack([values[pixels == p].sum() for p in pixels.unique()]) if len(pixels) else values


# %% [markdown]
# ## Summary
#
# 1. PyTorch's steps moved 556 bytes per query where 44 are needed. A fused kernel keeps the rest in registers.
# 2. $\partial \hat r / \partial s_t = w_t (r_t - \hat r)$ and $\partial \hat r / \partial r_t = w_t$ are two short
#    kernels. What forward gathers, backward scatters: with atomics, or as a gather over a sorted index.
# 3. An `autograd.Function` makes kernels part of a training; a registered op makes them part of PyTorch.
#    `gradcheck` and `opcheck` test them.
#
# ## Next
#
# Where do the scores come from? [07 · Attention](07_attention.ipynb): the four neighbours look at each other, and a
# change of algorithm saves more than fusing does.
