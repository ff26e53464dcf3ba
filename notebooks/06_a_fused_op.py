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
# # 06 · A fused op
#
# ![A pixel of a range image and those around it as squares, queries as dots between them; the queries of the four cells
# around the middle pixel are marked by crosses](pictures/06_a_fused_op.png)
#
# **Goal.** You write the blend of equation 3 as one Warp kernel, derive and write its backward pass, and hand both to
# PyTorch's autograd.
#
# **After this notebook you can**
#
# - count the bytes that a chain of PyTorch operations moves, and say what fusing them saves;
# - write a forward kernel with one thread per query, and its backward kernels from a derivation on paper;
# - tell a gather from a scatter, and add up what many threads say of one pixel without a race;
# - wrap kernels as a PyTorch op, and find a wrong gradient with `gradcheck`.
#
# | | |
# |---|---|
# | You know | queries and neighbours (03), weights by softmax (05), a first kernel (02); PyTorch's `backward()` |
# | Time | 45 minutes, and 40 for the exercises, with a good place to pause after section 4; under a minute to run |
# | Hardware | any computer; a CUDA GPU is used if there is one |
#
# Nearly every section asks you for a prediction. Write it down before you run the next cell.

# %%
import time
from typing import Any

import matplotlib.pyplot as plt
import torch
import warp as wp
from torch.utils._python_dispatch import TorchDispatchMode

from ilnet.course import Cells, check, draw_thread
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
# *registers*, the few numbers that a thread has at hand. So: one thread per query, and two small functions that forward
# and backward share.
#
# The softmax needs one precaution. $e^{s}$ overflows float32 at $s = 89$, but weights do not change when all four
# scores fall by the same amount, $e^{s_t - m} / \sum_u e^{s_u - m}$. With $m = \max_u s_u$ no exponent is positive,
# and the sum is at least 1.
#
# `Any` stands for whatever is passed: float32 to use it, float64 to test it. A row of `queries` is one vector of 2
# numbers, a row of `scores` one vector of 4. In a kernel an assignment *copies* a vector: `w = s` makes a second one of
# the same type, and to change it changes neither `s` nor the array that `s` came from.


# %%
@wp.func
def softmax4(s: Any):
    """Weights of four scores."""
    w = s
    largest = wp.max(s)
    for t in range(4):
        w[t] = wp.exp(s[t] - largest)
    return w / (w[0] + w[1] + w[2] + w[3])


@wp.func
def pixel(at: Any, t: int, height: int, width: int):
    """Row and column of neighbour t of a query: rows clamp, columns wrap."""
    i = int(wp.floor(at[0])) + t // 2
    j = int(wp.floor(at[1])) + t % 2
    return wp.clamp(i, 0, height - 1), (j % width + width) % width  # in a kernel, -1 % width is -1, as in C


@wp.kernel(module="unique", enable_backward=False)
def _blend_kernel(
    # in
    image: wp.array2d[Any],
    queries: wp.array[Any],
    scores: wp.array[Any],
    # out
    blended_out: wp.array[Any],
):
    q = wp.tid()
    w = softmax4(scores[q])
    blended = image.dtype(0.0)
    for t in range(4):
        i, j = pixel(queries[q], t, image.shape[0], image.shape[1])
        blended += w[t] * image[i, j]
    blended_out[q] = blended


# %% [markdown]
# `module="unique"` compiles the kernel on its own, so that a change in one cell does not compile all others again.
#
# | equation | line of code | kernel argument |
# |---|---|---|
# | $t = 0 \ldots 3$, the pixels around $q$ | `i, j = pixel(queries[q], t, ...)` | `queries` (Q,) of 2 |
# | $r_t$ | `image[i, j]` | `image` (H, W) |
# | $w = \operatorname{softmax}(s)$ | `w = softmax4(scores[q])` | `scores` (Q,) of 4 |
# | $\hat r = \sum_t w_t r_t$ | `blended += w[t] * image[i, j]` | `blended_out` (Q,) |

# %%
draw_thread(
    "_blend_kernel: thread q answers query q",
    reads=[
        Cells("image", (5, 9), [(1, 5), (1, 6), (2, 5), (2, 6)]),
        Cells("queries", (1, 9), [(0, 3)]),
        Cells("scores", (1, 9), [(0, 3)]),
    ],
    steps="w = softmax(s)\nblended = Σ w[t] r[t]\nin registers",
    writes=[Cells("blended_out", (1, 9), [(0, 3)])],
)

# %% [markdown]
# *In words: on the left the arrays that one thread reads: four pixels of the image, two by two, and one element each of
# queries and scores. It computes in registers, and writes one element of `blended_out`, on the right.*
#
# Around a kernel belongs the side of the *host*, the Python program that launches it: torch tensors seen as Warp
# arrays, without a copy, on the device and the stream that torch uses. (On a CPU such a launch runs on one core.)

# %%
VECTORS = {
    (torch.float32, 2): wp.vec2f,
    (torch.float32, 4): wp.vec4f,
    (torch.float64, 2): wp.vec2d,
    (torch.float64, 4): wp.vec4d,
}


def numbers(tensor):
    """A tensor as an array of numbers."""
    return wp.from_torch(tensor.detach().contiguous(), requires_grad=False)


def vectors(tensor):
    """A tensor (Q, 2) or (Q, 4) as an array (Q,) of vectors."""
    dtype = VECTORS[tensor.dtype, tensor.shape[1]]
    return wp.from_torch(tensor.detach().contiguous(), dtype=dtype, requires_grad=False)


def launch(kernel, threads, inputs, outputs, **more):
    stream = wp.stream_from_torch(torch.cuda.current_stream()) if device == "cuda" else None
    wp.launch(kernel, threads, inputs=inputs, outputs=outputs, device=device, stream=stream, **more)


def blend_forward(image, queries, scores):
    blended = image.new_empty(len(queries))
    launch(_blend_kernel, len(queries), [numbers(image), vectors(queries), vectors(scores)], [numbers(blended)])
    return blended


difference = (blend_forward(image, queries, scores) - blend_steps(image, queries, scores)).abs().max()
huge = blend_forward(image, queries, 1000 * scores)
print(f"kernel and steps differ by at most {difference:.1e} m; with huge scores all finite: {huge.isfinite().all()}")
assert difference < 1e-4
assert huge.isfinite().all()

# %% [markdown]
# ### Exercise 1 · A prior in the kernel
#
# ★★☆ · 15 minutes
#
# Notebook 03 weighed the neighbours by bilinear areas. With $f_r$ and $f_c$ for the fractions of row and column (there
# $f$ and $g$) they are
#
# $$a = \big((1 - f_r)(1 - f_c),\ (1 - f_r) f_c,\ f_r (1 - f_c),\ f_r f_c\big)$$
#
# As a *prior* their logarithms join the scores: $w = \operatorname{softmax}(s + \log a)$, so that zero scores give
# bilinear interpolation. Write a kernel that does so, and `blend_bilinear`, which launches it on float32 tensors
# `image` (H, W), `queries` (Q, 2), `scores` (Q, 4) and returns (Q,). Use `softmax4`, `pixel`, `numbers`, `vectors` and
# `launch` from above; your kernel may name its types, `wp.vec2`, `wp.vec4`, `float`. A query on a pixel centre has
# areas of 0. If Warp refuses your kernel, read the last two lines of its message, and write `1.0 - f`, not `1 - f`.
#
# <details><summary>Hint: what to change</summary>
#
# Copy `_blend_kernel`. Before the softmax, `s = scores[q]`, then for each t add `wp.log(a_t)` to `s[t]`. Areas can be
# made from `t // 2` and `t % 2` as `pixel` makes rows and columns.
#
# </details>
# <details><summary>Hint: areas of 0</summary>
#
# `wp.log(0.0)` is minus infinity, and $e^{-\infty} = 0$: just the weight that such a neighbour should have here. (A
# network that shall be able to overrule it needs the floor of notebook 05.) If you multiply by areas after the softmax
# instead, a huge score of a neighbour with area 0 leaves 0 / 0.
#
# </details>


# %% tags=["exercise"]
def blend_bilinear(image, queries, scores):
    raise NotImplementedError  # write a kernel above, and launch it here


# %% tags=["solution"]
@wp.kernel(module="unique", enable_backward=False)
def _blend_bilinear_kernel(
    # in
    image: wp.array2d[float],
    queries: wp.array[wp.vec2],
    scores: wp.array[wp.vec4],
    # out
    blended_out: wp.array[float],
):
    q = wp.tid()
    at = queries[q]
    s = scores[q]
    fr = at[0] - wp.floor(at[0])
    fc = at[1] - wp.floor(at[1])
    for t in range(4):
        in_row = wp.where(t // 2 == 1, fr, 1.0 - fr)  # wp.where(condition, if true, if not)
        in_column = wp.where(t % 2 == 1, fc, 1.0 - fc)
        s[t] = s[t] + wp.log(in_row * in_column)
    w = softmax4(s)
    blended = image.dtype(0.0)
    for t in range(4):
        i, j = pixel(at, t, image.shape[0], image.shape[1])
        blended += w[t] * image[i, j]
    blended_out[q] = blended


def blend_bilinear(image, queries, scores):
    blended = image.new_empty(len(queries))
    inputs = [numbers(image), vectors(queries), vectors(scores)]
    launch(_blend_bilinear_kernel, len(queries), inputs, [numbers(blended)])
    return blended


# %% tags=["check"]
@check
def _():
    picture = torch.tensor([[2.0, 4.0, 8.0], [3.0, 6.0, 12.0]], device=device)
    zero = torch.zeros(1, 4, device=device)

    def ask(row, column, s=zero):
        return blend_bilinear(picture, torch.tensor([[row, column]], device=device), s).item()

    first = ask(0.25, 0.0)
    assert abs(first - 2.25) < 1e-4, (
        f"a quarter of the way to row 1: 2.25, not {first:.3f}. Which area is whose, and is it its log that is added?"
    )
    assert abs(ask(0.0, 0.25) - 2.5) < 1e-4, f"a quarter right of column 0: 2.5, not {ask(0.0, 0.25):.3f}"
    assert abs(ask(0.0, 2.5) - 5.0) < 1e-4, "between the last column and the first: columns wrap at the seam"
    s = torch.tensor([[0.0, 1.0, 2.0, 3.0]], device=device)
    said = gather_blend(picture, torch.tensor([[0.3, 0.6]], device=device), s, "bilinear").item()
    assert abs(ask(0.3, 0.6, s) - said) < 1e-4, f"scores 0, 1, 2, 3 give {said:.3f}, not {ask(0.3, 0.6, s):.3f}"
    assert abs(ask(0.5, 0.5, 1000 * s) - 6.0) < 1e-4, "scores of thousands: subtract the largest before exp"
    centre = ask(0.0, 0.0, 100 * s)
    assert abs(centre - 2.0) < 1e-4, f"on a pixel centre that pixel alone counts, whatever the scores, not {centre:.3f}"
    assert blend_bilinear(picture, torch.empty(0, 2, device=device), torch.empty(0, 4, device=device)).shape == (0,), (
        "no queries: an empty tensor"
    )


# %% tags=["wrong"]
def blend_bilinear(image, queries, scores):  # the area next to a neighbour, not the one opposite it
    fr, fc = (queries - queries.floor()).unbind(-1)
    areas = torch.stack((fr * fc, fr * (1 - fc), (1 - fr) * fc, (1 - fr) * (1 - fc)), -1)
    return blend_forward(image, queries, scores + areas.log())


# %% tags=["wrong"]
def blend_bilinear(image, queries, scores):  # areas after the softmax
    fr, fc = (queries - queries.floor()).unbind(-1)
    areas = torch.stack(((1 - fr) * (1 - fc), (1 - fr) * fc, fr * (1 - fc), fr * fc), -1)
    weights = areas * scores.softmax(-1)
    return blend_forward(image, queries, (weights / weights.sum(-1, keepdim=True)).log())


# %% tags=["wrong"]
def blend_bilinear(image, queries, scores):  # the prior alone
    return gather_blend(image, queries, 0 * scores, "bilinear")


# %% [markdown]
# ## 3. Backward by hand
#
# Autograd cannot look into our kernel. It hands us $g_q = \partial L / \partial \hat r_q$, and wants
# $\partial L / \partial s$ and $\partial L / \partial I$ for the image $I$. Two derivatives, then.
#
# **Scores.** As in notebook 05, $\;\partial \hat r / \partial s_t = w_t\, (r_t - \hat r)$. Equal ranges: nothing to
# learn. One weight of 1: nothing to learn either, since $r_t = \hat r$ or $w_t = 0$.
#
# **Ranges.** $\hat r$ is linear in them: $\partial \hat r / \partial r_t = w_t$.
#
# In code $\partial L / \partial x$ is `adj_x`, for *adjoint*, Warp's word.
#
# **Predict:** backwards a thread needs the weights. Should the forward kernel have stored them? Count the bytes; the
# next cell shows our choice.


# %%
@wp.kernel(module="unique", enable_backward=False)
def _blend_scores_backward_kernel(
    # in
    image: wp.array2d[Any],
    queries: wp.array[Any],
    scores: wp.array[Any],
    adj_blended: wp.array[Any],
    # out
    adj_scores_out: wp.array[Any],
):
    q = wp.tid()
    w = softmax4(scores[q])
    r = w
    for t in range(4):
        i, j = pixel(queries[q], t, image.shape[0], image.shape[1])
        r[t] = image[i, j]
    blended = wp.dot(w, r)
    adj = w
    for t in range(4):
        adj[t] = adj_blended[q] * w[t] * (r[t] - blended)
    adj_scores_out[q] = adj


def scores_backward(image, queries, scores, adj_blended):
    adj_scores = torch.empty_like(scores)
    inputs = [numbers(image), vectors(queries), vectors(scores), numbers(adj_blended)]
    launch(_blend_scores_backward_kernel, len(queries), inputs, [vectors(adj_scores)])
    return adj_scores


# %% [markdown]
# Stored weights would cost 16 bytes written, and 16 read where the scores are now read. Four exponentials are cheaper,
# and no memory is held between the passes. (The library's op stores them, since it can return them as well.)
#
# | equation | line of code | kernel argument |
# |---|---|---|
# | $g_q = \partial L / \partial \hat r_q$ | `adj_blended[q]` | `adj_blended` (Q,) |
# | $\hat r = \sum_t w_t r_t$ | `blended = wp.dot(w, r)` | (again, in registers) |
# | $\partial L / \partial s_t = g_q w_t (r_t - \hat r)$ | `adj[t] = adj_blended[q] * ...` | `adj_scores_out` (Q,) |
#
# PyTorch's autograd differentiates the steps of section 1; it is the judge.

# %%
leaf = scores.clone().requires_grad_()
adj_blended = torch.randn(len(queries), device=device)  # some gradient from further on
blend_steps(image, queries, leaf).backward(adj_blended)
ours = scores_backward(image, queries, scores, adj_blended)
print(f"largest gradient {leaf.grad.abs().max():.2f}, largest difference {(ours - leaf.grad).abs().max():.1e}")
assert torch.allclose(ours, leaf.grad, atol=1e-4)

# %% [markdown]
# ### Exercise 2 · Blend inverse ranges, backwards
#
# ★★☆ · 10 minutes
#
# Inverse ranges keep planes flat (notebook 03). Their blend with weights $w = \operatorname{softmax}(s)$ is
#
# $$h = \frac{1}{u}, \qquad u = \sum_t \frac{w_t}{r_t}$$
#
# Derive $\partial h / \partial s_t$ and $\partial h / \partial r_t$ on paper. Then write `harmonic_backward`: from
# ranges `r` (Q, 4), `scores` (Q, 4) and `adj` (Q,), the gradient that arrives at `h`, return the gradients `adj_r` and
# `adj_s`, both (Q, 4), in closed form (PyTorch, no autograd). You may express them by $h$ (a range here, not the MLP of
# notebooks 04 and 05).
#
# <details><summary>Hint: the chain</summary>
#
# $\partial h / \partial u = -1 / u^2 = -h^2$. And $\partial u / \partial s_t$ is the formula of this section, with
# $1/r_t$ for $r_t$ and $u$ for $\hat r$.
#
# </details>
# <details><summary>Hint: a test in your head</summary>
#
# Where all ranges are equal $h$ is that range: no score matters, and $\partial h / \partial r_t = w_t$.
#
# </details>


# %% tags=["exercise"]
def harmonic_backward(r, scores, adj):
    raise NotImplementedError


# %% tags=["solution"]
def harmonic_backward(r, scores, adj):
    w = scores.softmax(-1)
    h = 1 / (w / r).sum(-1, keepdim=True)
    adj = adj.unsqueeze(-1)
    return adj * h**2 * w / r**2, adj * w * h * (1 - h / r)


# %% tags=["check"]
@check
def _():
    generator = torch.Generator().manual_seed(1)
    r = 2 + 20 * torch.rand(5, 4, generator=generator, dtype=torch.float64)
    s, adj = torch.randn(2, 5, 4, generator=generator, dtype=torch.float64)[:, :, :4]
    adj = adj[:, 0]
    r.requires_grad_()
    s.requires_grad_()
    for g, of in ((torch.ones_like(adj), "1"), (adj, "other numbers")):
        h = 1 / (s.softmax(-1) / r).sum(-1)
        true_r, true_s = torch.autograd.grad(h, (r, s), g)
        answer = harmonic_backward(r.detach(), s.detach(), g)
        assert len(answer) == 2, "return two tensors: adj_r, adj_s"
        adj_r, adj_s = answer
        shapes = tuple(adj_r.shape), tuple(adj_s.shape)
        assert shapes == ((5, 4), (5, 4)), f"the shapes are {shapes}; both should be (Q, 4)"

        assert not torch.allclose(adj_s, true_r), "what you return second belongs to r: adj_r comes first, then adj_s"
        for name, mine, true in (("adj_s", adj_s, true_s), ("adj_r", adj_r, true_r)):
            assert not torch.allclose(mine, -true), f"{name} has the wrong sign: 1/u falls where u rises"
            hint = "try the cases of the second hint; is h² there?" if of == "1" else "is adj a factor?"
            assert torch.allclose(mine, true), f"{name} is off where adj is {of}: {hint}"
    same = torch.full((1, 4), 7.0, dtype=torch.float64)
    adj_r, adj_s = harmonic_backward(same, s.detach()[:1], torch.ones(1, dtype=torch.float64))
    assert adj_s.abs().max() < 1e-12, "equal ranges: no score can change the answer"
    assert torch.allclose(adj_r, s.detach()[:1].softmax(-1)), "equal ranges: the gradient to r_t is w_t"
    certain = torch.tensor([[0.0, 900.0, 0.0, 0.0]], dtype=torch.float64)
    adj_r, adj_s = harmonic_backward(r.detach()[:1], certain, torch.ones(1, dtype=torch.float64))
    assert adj_s.abs().max() < 1e-12, "one weight of 1: no score can change the answer a little"
    assert torch.allclose(adj_r, certain / 900), "one weight of 1: only its range matters"


# %% tags=["wrong"]
def harmonic_backward(r, scores, adj):  # the gradient that arrives is forgotten
    w = scores.softmax(-1)
    h = 1 / (w / r).sum(-1, keepdim=True)
    return h**2 * w / r**2, w * h * (1 - h / r)


# %% tags=["wrong"]
def harmonic_backward(r, scores, adj):  # a sign
    w = scores.softmax(-1)
    h = 1 / (w / r).sum(-1, keepdim=True)
    adj = adj.unsqueeze(-1)
    return adj * h**2 * w / r**2, -adj * w * h * (1 - h / r)


# %% tags=["wrong"]
def harmonic_backward(r, scores, adj):  # the arithmetic blend's
    w = scores.softmax(-1)
    h = 1 / (w / r).sum(-1, keepdim=True)
    adj = adj.unsqueeze(-1)
    return adj * w, adj * w * (r - h)


# %% [markdown]
# ## 4. Many queries, one pixel
#
# For the image the arrows turn round. Forward, many queries *gather* from one pixel, and nobody minds. Backward, they
# all *add* to it: a *scatter*.
#
# $$\frac{\partial L}{\partial I_p} = \sum_{(q, t)\,:\ \text{neighbour } t \text{ of } q \text{ is } p} g_q\, w_{q,t}$$
#
# How many terms has that sum, for the pixels of our image?

# %% tags=["goal"]
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
# Three of four terms are lost, without a word. There are two ways out.
#
# **Atomics.** `wp.atomic_add` reads, adds and writes as one step that no other thread can enter. The kernel below is as
# simple as it gets. On a GPU the order of the additions differs from run to run, though, and with it the rounding; and
# threads queue up where 64 of them want the same pixel. On a CPU, Warp runs a launch on one core, and its atomics are
# plain additions: fine here, wrong as soon as two cores share a launch.


# %%
@wp.kernel(module="unique", enable_backward=False)
def _blend_image_backward_kernel(
    # in
    queries: wp.array[Any],
    scores: wp.array[Any],
    adj_blended: wp.array[Any],
    # out
    adj_image_out: wp.array2d[Any],
):
    q = wp.tid()
    w = softmax4(scores[q])
    for t in range(4):
        i, j = pixel(queries[q], t, adj_image_out.shape[0], adj_image_out.shape[1])
        wp.atomic_add(adj_image_out, i, j, adj_blended[q] * w[t])


def image_backward(image, queries, scores, adj_blended):
    adj_image = torch.zeros_like(image)  # atomics add to what is there
    inputs = [vectors(queries), vectors(scores), numbers(adj_blended)]
    launch(_blend_image_backward_kernel, len(queries), inputs, [numbers(adj_image)])
    return adj_image


leaf = image.clone().requires_grad_()
blend_steps(leaf, queries, scores).backward(adj_blended)
ours = image_backward(image, queries, scores, adj_blended)
print(f"largest gradient {leaf.grad.abs().max():.2f}, largest difference {(ours - leaf.grad).abs().max():.1e}")
assert torch.allclose(ours, leaf.grad, atol=1e-3)

# %%
draw_thread(
    "_blend_image_backward_kernel: thread q adds to pixels to which others add as well",
    reads=[
        Cells("queries", (1, 9), [(0, 3)]),
        Cells("scores", (1, 9), [(0, 3)]),
        Cells("adj_blended", (1, 9), [(0, 3)]),
    ],
    steps="w = softmax(s)\nadd g w[t]\nto pixel t",
    writes=[Cells("adj_image_out", (5, 9), [(1, 5), (1, 6), (2, 5), (2, 6)])],
)

# %% [markdown]
# *In words: one element each of queries, scores and `adj_blended` on the left; on the right the image's gradient, where
# the thread adds to four pixels, two by two. The thread of the next query adds to some of the same.*
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
# ### Exercise 3 · A sum without a race
#
# ★★☆ · 15 minutes
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
def _sum_by_pixel_kernel(
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
    launch(_sum_by_pixel_kernel, count, [numbers(values), numbers(order), numbers(starts)], [numbers(sums)])
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
    assert torch.allclose(mine, ours, atol=1e-3), "the gradient of the image differs from the atomics'"


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
# ## 5. A PyTorch op
#
# A `torch.autograd.Function` ties forward and backward together. Its `backward` returns one gradient for each argument
# of `forward`, `None` for the queries, which need none. What backward needs goes through `ctx.save_for_backward`.
#
# Our kernels write only into tensors that we made, never into PyTorch's own gradients: these are added up elsewhere.


# %%
class Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, queries, scores):
        ctx.save_for_backward(image, queries, scores)
        return blend_forward(image, queries, scores)

    @staticmethod
    def backward(ctx, adj_blended):
        saved = ctx.saved_tensors
        adj_image = image_backward(*saved, adj_blended) if ctx.needs_input_grad[0] else None
        adj_scores = scores_backward(*saved, adj_blended) if ctx.needs_input_grad[2] else None
        return adj_image, None, adj_scores


# %% [markdown]
# **Is it right?** `gradcheck` compares a backward pass with finite differences: it moves every element of every input
# by $10^{-6}$ and looks how far every output moves. float32 has too few digits for that. In float64, with a handful of
# queries, an error in any formula shows. This is why the kernels say `Any`.

# %%
small = {"dtype": torch.float64, "device": device}
test_image = (2 + 10 * torch.rand(3, 4, **small)).requires_grad_()
test_queries = torch.tensor([[0.3, 0.6], [1.5, 3.5], [2.2, -0.4], [-0.5, 1.0], [0.3, 0.6]], **small)  # seam, borders
test_scores = torch.randn(5, 4, **small).requires_grad_()

# nondet_tol: on a GPU the order of atomic additions, and so the last digit, differs from run to run.
inputs = test_image, test_queries, test_scores
print("gradcheck:", torch.autograd.gradcheck(Blend.apply, inputs, nondet_tol=1e-12))

# %% [markdown]
# `torch.compile` and `torch.export` cannot see through a `Function` that launches foreign kernels. A *custom op* of
# `torch.library` tells them what they need: a name, a *fake* that says shape, dtype and device of the result without
# computing it, and the backward. `opcheck` tests all of that, in four tests that PyTorch's manual describes. This is
# how each op of the library is made.


# %%
@torch.library.custom_op("course::blend", mutates_args=())
def blend_op(image: torch.Tensor, queries: torch.Tensor, scores: torch.Tensor) -> torch.Tensor:
    return blend_forward(image, queries, scores)


@blend_op.register_fake
def _(image, queries, scores):
    return image.new_empty(len(queries))  # new_empty: the dtype and device of the image


@torch.library.custom_op("course::blend_backward", mutates_args=())
def blend_backward_op(
    image: torch.Tensor, queries: torch.Tensor, scores: torch.Tensor, adj_blended: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    saved = image, queries, scores, adj_blended
    return image_backward(*saved), scores_backward(*saved)


@blend_backward_op.register_fake
def _(image, queries, scores, adj_blended):
    return torch.empty_like(image), torch.empty_like(scores)


def _backward(ctx, adj_blended):
    adj_image, adj_scores = blend_backward_op(*ctx.saved_tensors, adj_blended)
    return adj_image, None, adj_scores


blend_op.register_autograd(_backward, setup_context=lambda ctx, inputs, output: ctx.save_for_backward(*inputs))

for name, result in torch.library.opcheck(blend_op, inputs).items():
    print(f"{name}: {result}")
    assert result == "SUCCESS"

# %% [markdown]
# **Use it.** If the op is right, one can learn through it. No network here: the scores themselves are the parameters,
# one set of four for each query, and they see the truth. So this asks how far *any* network can get that predicts
# weights: to the truth where it lies between the neighbours, else to the nearest neighbour.
#
# **Predict:** how close to the truth do freely chosen weights come, compared with bilinear interpolation?

# %%
truth = ranges_along(fine.directions()).view(-1).to(device)
every = slice(0, None, 4)  # every fourth query is enough
part, goal = queries[every], truth[every]
free = torch.zeros(len(part), 4, device=device, requires_grad=True)
optimiser = torch.optim.Adam([free], lr=0.1)
for _ in range(60):
    optimiser.zero_grad()
    loss = (Blend.apply(image, part, free) - goal).abs().sum()
    loss.backward()
    optimiser.step()

bilinear = gather_blend(image, part, torch.zeros_like(free), "bilinear")
neighbours = image[rows[every], columns[every]]
within = goal.clamp(neighbours.amin(-1), neighbours.amax(-1))  # the nearest that a blend can say
errors = {"bilinear": bilinear, "learned scores": Blend.apply(image, part, free.detach()), "best blend": within}
mae = {name: (answer - goal).abs().mean().item() for name, answer in errors.items()}
for name, error in mae.items():
    print(f"{name:>15}: {error:.4f} m from the truth, on average")
assert mae["best blend"] <= mae["learned scores"] + 1e-4
assert mae["learned scores"] < 0.15 * mae["bilinear"]

# %% [markdown]
# In sixty steps the gradients lead the scores most of the way to where weights can get. What a network adds is to
# find such scores without the truth.
#
# ## 6. Why by hand? A loop that Warp differentiates wrongly
#
# Warp can differentiate kernels by itself, and mostly does it right. Here is the blend with a sum that runs over the
# neighbours, twice: once over `range(4)`, once over `range(count)` with the number of neighbours as an argument. Both
# compute the same. (In double precision, for `gradcheck`; the ranges are gathered already; the first does not use
# `count` and takes it to be called alike.)


# %%
@wp.kernel(module="unique")
def _blend_four_kernel(
    ranges: wp.array2d[wp.float64], scores: wp.array2d[wp.float64], count: int, blended_out: wp.array[wp.float64]
):
    q = wp.tid()
    total = wp.float64(0.0)
    mixed = wp.float64(0.0)
    for t in range(4):
        e = wp.exp(scores[q, t])
        total = total + e
        mixed = mixed + e * ranges[q, t]
    blended_out[q] = mixed / total


@wp.kernel(module="unique")
def _blend_count_kernel(
    ranges: wp.array2d[wp.float64], scores: wp.array2d[wp.float64], count: int, blended_out: wp.array[wp.float64]
):
    q = wp.tid()
    total = wp.float64(0.0)
    mixed = wp.float64(0.0)
    for t in range(count):
        e = wp.exp(scores[q, t])
        total = total + e
        mixed = mixed + e * ranges[q, t]
    blended_out[q] = mixed / total


# %% [markdown]
# A function that lets Warp do the backward pass: the same kernel, launched with `adjoint=True`, reads `adj_outputs` and
# adds to `adj_inputs`.


# %%
def differentiated_by_warp(kernel):
    class Derived(torch.autograd.Function):
        @staticmethod
        def forward(ctx, ranges, scores):
            ctx.save_for_backward(ranges, scores)
            blended = ranges.new_empty(len(ranges))
            launch(kernel, len(ranges), [numbers(ranges), numbers(scores), 4], [numbers(blended)])
            return blended

        @staticmethod
        def backward(ctx, adj_blended):
            ranges, scores = ctx.saved_tensors
            adj_ranges, adj_scores = torch.zeros_like(ranges), torch.zeros_like(scores)
            inputs, outputs = [numbers(ranges), numbers(scores), 4], [numbers(torch.zeros_like(adj_blended))]
            adjoints = {
                "adj_inputs": [numbers(adj_ranges), numbers(adj_scores), None],
                "adj_outputs": [numbers(adj_blended)],
            }
            launch(kernel, len(ranges), inputs, outputs, adjoint=True, **adjoints)
            return adj_ranges, adj_scores

    return Derived.apply


# %% [markdown]
# **Predict:** same sums, same result. Same gradients?

# %%
r = (2 + 10 * torch.rand(2, 4, **small)).requires_grad_()
s = torch.randn(2, 4, **small).requires_grad_()
by_hand = s.softmax(-1) * (r - (s.softmax(-1) * r).sum(-1, keepdim=True))
verdict = {}
for name, kernel in (("range(4)", _blend_four_kernel), ("range(count)", _blend_count_kernel)):
    op = differentiated_by_warp(kernel)
    forward_is_right = torch.allclose(op(r, s), (s.softmax(-1) * r).sum(-1))
    [gradient] = torch.autograd.grad(op(r, s).sum(), [s])
    verdict[name] = torch.autograd.gradcheck(op, (r, s), raise_exception=False)
    print(f"{name:>12}: forward right {forward_is_right}, gradcheck {verdict[name]}")
    print(f"{'':>14}gradient to scores {[round(x, 3) for x in gradient[0].tolist()]}")
    assert forward_is_right
print(f"{'by hand':>12}: {'':>20} {[round(x, 3) for x in by_hand[0].tolist()]}")
assert verdict == {"range(4)": True, "range(count)": False}

# %% [markdown]
# The forward pass is right, no warning is given, and the gradients are garbage. Warp's manual says so
# (*Differentiability*, *Dynamic Loops*; this is version 1.19), and it is easily overlooked. Why is it so? Warp unrolls
# `range(4)` into straight code and differentiates that. A loop whose bound is not known to the compiler stays a loop,
# and what its iterations overwrite is not kept. The backward kernel that Warp writes does not run the loop forward at
# all before it turns round. Its first step backwards is the one for `mixed / total`, and there `total` still has its
# first value. From the C++ that Warp generated, shortened:
#
# ```c++
# var_1 = 0.0;                          // total = wp.float64(0.0)
# var_2 = 0.0;                          // mixed = wp.float64(0.0)
# var_3 = wp::range(var_n);             // for t in range(count):      the loop itself is missing here
# var_13 = wp::div(var_2, var_1);       // mixed / total = 0 / 0
# ...
# wp::adj_div(var_2, var_1, var_13, adj_2, adj_1, adj_13);
# ```
#
# Division by zero at least shows. A running sum that starts at 1 gives finite numbers that are as wrong, and training
# would merely go badly. So: derive by hand, or keep loops unrolled (Warp does so up to 16 iterations), and in any case
# put `gradcheck` beside every backward pass.
#
# ## 7. What it is worth
#
# First the bytes. `Traffic` counts what PyTorch's autograd moves for the steps of section 1, forward and backward. For
# the kernels we count by hand; 4 pixels at 4 bytes are read by the first two, and those of `adj_image` read and written
# by the third. (What
# an operation moves inside, such as the sorting in PyTorch's scatter, stays uncounted.)

# %%
leaves = image.clone().requires_grad_(), queries, scores.clone().requires_grad_()
with Traffic() as both_steps:
    blend_steps(*leaves).backward(adj_blended)

forward_kernel = 8 + 16 + 16 + 4  # query, scores, pixels; blended
backward_kernels = (8 + 16 + 16 + 4 + 16) + (8 + 16 + 4 + 2 * 16)  # for the scores; for the image
counted = {
    "PyTorch steps": (forward_steps.bytes / len(queries), both_steps.bytes / len(queries)),
    "own kernels": (forward_kernel, forward_kernel + backward_kernels),
}
for name, (forward, both) in counted.items():
    print(f"{name:>13}: {forward:4.0f} bytes per query forward, {both:5.0f} with backward")
assert counted["PyTorch steps"][0] > 10 * counted["own kernels"][0]
assert counted["PyTorch steps"][1] > 4 * counted["own kernels"][1]

# %% [markdown]
# Then the clock. The library's `gather_blend` is the same idea with more care: all cores of a CPU share a launch, a
# thread takes four queries at a time so that the compiler can use vector instructions, and one kernel makes both
# gradients.
#
# **Predict:** our kernels move twelve times fewer bytes forward, and half as many backward. How much faster are they?


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


ways = {"PyTorch steps": blend_steps, "own kernels": Blend.apply, "gather_blend": gather_blend}
measured = {}
for name, way in ways.items():
    forward = milliseconds(lambda way=way: way(image, queries, scores))
    both = milliseconds(lambda way=way: way(*leaves).backward(adj_blended))
    measured[name] = forward, both
    print(f"{name:>13}: {forward:6.1f} ms forward, {both - forward:6.1f} ms backward")

# %%
colours = {"PyTorch steps": "#999999", "own kernels": "#0072b2", "gather_blend": "#009e73"}
# The library's op stores the weights, and goes back in one kernel.
counted["gather_blend"] = (forward_kernel + 16, forward_kernel + 16 + (8 + 16 + 16 + 4 + 16 + 2 * 16))
figure, axes = plt.subplots(1, 2, figsize=(10, 3.4), layout="constrained", sharey=True)
for axis, figures, unit in ((axes[0], counted, "bytes per query, counted"), (axes[1], measured, "ms, measured here")):
    for place, name in enumerate(ways):
        for up, hatch, value in ((-0.2, "", figures[name][0]), (0.2, "///", figures[name][1])):
            axis.barh(place + up, value, 0.38, color=colours[name], edgecolor="black", hatch=hatch)
            axis.text(value, place + up, f" {value:.0f}" if value > 20 else f" {value:.1f}", va="center", fontsize=9)
    axis.set(xlabel=unit, yticks=range(3), yticklabels=list(ways))
    axis.margins(x=0.15)
    axis.spines[["top", "right"]].set_visible(False)
axes[0].invert_yaxis()
axes[0].set_title(f"{len(queries):,} queries: forward; hatched: forward and backward", loc="left", fontsize=10)
plt.show()

# %% [markdown]
# *In words: two bar charts with a pair of bars for each of the three ways. Left, bytes counted: PyTorch's steps have by
# far the longest bars. Right, milliseconds measured on the computer that built this page.*
#
# (These outputs are from two cores of a CPU.) Forward, bytes foretell that kernels beat steps, though not by how much:
# what was just written is often still in a cache. They do not tell the kernels apart: `gather_blend` moves 60 bytes to
# our 44, and is faster since it takes both cores and vector instructions. Backward, our two kernels move half the bytes
# of PyTorch's steps and take *longer*: they run on one core where PyTorch takes both, and each of the two computes the
# softmax anew. `gather_blend` shows what is left in it. `torch.compile` fuses such chains by itself where it finds a
# compiler, and is then nearly as fast forward: the README has both in one table. What it cannot do is change the
# algorithm, which the next notebook does.

# %% [markdown]
# ## Summary
#
# 1. PyTorch's steps moved 556 bytes per query where 44 are needed. A fused kernel keeps the rest in registers.
# 2. $\partial \hat r / \partial s_t = w_t (r_t - \hat r)$ and $\partial \hat r / \partial r_t = w_t$ are two short
#    kernels. What forward gathers, backward scatters: with atomics, or as a gather over a sorted index.
# 3. A custom op makes kernels part of PyTorch. `gradcheck` and `opcheck` test it.
# 4. Warp's automatic derivative of a loop with an unknown bound is wrong without a warning. `gradcheck` finds it.
#
# ## Next
#
# Where do the scores come from? [07 · Attention](07_attention.ipynb): the four neighbours look at each other, and a
# change of algorithm saves more than fusing does.
