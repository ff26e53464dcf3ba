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
# # 06a · Gradients in Warp
#
# ![Left, ranges of the road turned into points, which climb before the fit and lie level after it. Right, height and
# tilt of the sensor over the steps of the fit, each reaching its true value](pictures/06a_gradients_in_warp.png)
#
# **Goal.** You let Warp differentiate a kernel, use its gradients from PyTorch, and learn to tell when they are wrong.
#
# **After this notebook you can**
#
# - record launches on a `wp.Tape` and get the gradient of a loss;
# - make a PyTorch function of a kernel and of the *adjoint* that Warp derives from it;
# - test a gradient with `torch.autograd.gradcheck`;
# - recognise two kernels whose derivative is wrong without a warning, and mend them;
# - replace the derivative of a function with one of your own.
#
# | | |
# |---|---|
# | You know | a first kernel and what one thread reads and writes (02); PyTorch's `backward()` |
# | Time | 30 minutes, and 45 for the exercises; under a minute to run |
# | Hardware | any computer; a CUDA GPU is used if there is one |
#
# Each section asks you for a prediction. Write it down before you run the next cell.

# %%
import math

import matplotlib.pyplot as plt
import torch
import warp as wp

from ilnet.course import Cells, check, draw_thread, run, trace_thread
from ilnet.sensor import preset
from kernels.launch import initialise

torch.manual_seed(0)
initialise()  # starts Warp without its greeting
device = "cuda" if torch.cuda.is_available() else "cpu"
real = wp.float64  # gradients are tested in double precision, so all kernels of this notebook use it
double = {"dtype": torch.float64, "device": device}
if device == "cuda":  # Warp's work queues behind PyTorch's
    wp.set_stream(wp.stream_from_torch(torch.cuda.current_stream()))

# %% [markdown]
# ## 1. A tape
#
# How high above the road does a sensor stand, and how far is it tilted forward? The road itself can tell. A beam that
# points an angle $\beta_i$ below the sensor's horizon meets a level road at the range
#
# $$r_i = \frac{h}{\sin(\beta_i + \tau)}$$
#
# with height $h$ and tilt $\tau$. So we measure ranges, compare them with this formula, and change $h$ and $\tau$ until
# they agree. The direction of the change is the *gradient* of the loss $L = \sum_i (r_i - m_i)^2$, where $m_i$ are the
# measured ranges.
#
# | equation | line of code | kernel argument |
# |---|---|---|
# | $\beta_i$ | `angles[i]` | `angles` (N,) |
# | $h,\ \tau$ | `mount[0]`, `mount[1]` | `mount` (2,) |
# | $r_i$ | `mount[0] / wp.sin(...)` | `ranges_out` (N,) |


# %%
@wp.kernel(module="unique")
def road_kernel(
    # in
    angles: wp.array[real],
    mount: wp.array[real],
    # out
    ranges_out: wp.array[real],
):
    i = wp.tid()
    ranges_out[i] = mount[0] / wp.sin(angles[i] + mount[1])


@wp.kernel(module="unique")
def loss_kernel(
    # in
    ranges: wp.array[real],
    measured: wp.array[real],
    # out
    loss_out: wp.array[real],
):
    i = wp.tid()
    difference = ranges[i] - measured[i]
    loss_out[0] += difference * difference  # all threads add to one number; `+=` on an array is atomic


# %% [markdown]
# In earlier notebooks we wrote `enable_backward=False`. Without it Warp derives a second kernel from each, its
# *adjoint*. A `wp.Tape` records which kernels were launched with which arrays. `tape.backward(loss)` then goes through
# the record from its end and launches the adjoints. Each array with `requires_grad=True` has a second array, `grad`, for
# the gradient of the loss with respect to it.

# %%
TRUE_HEIGHT, TRUE_TILT = 1.8, math.radians(2)
sensor = preset("paper-64x1024")
angles = -torch.tensor(sensor.elevations, **double)
angles = angles[angles > math.radians(3)]  # the beams that look down
measured = TRUE_HEIGHT / torch.sin(angles + TRUE_TILT) + 0.02 * torch.randn(len(angles), **double)


def array(values, requires_grad=False):
    return wp.array(values, dtype=real, device=device, requires_grad=requires_grad)


beams, target = wp.from_torch(angles), wp.from_torch(measured)
mount = array([1.5, 0.0], requires_grad=True)  # a first guess
ranges = array([0.0] * len(angles), requires_grad=True)
loss = array([0.0], requires_grad=True)

with wp.Tape() as tape:
    wp.launch(road_kernel, len(angles), inputs=[beams, mount], outputs=[ranges], device=device)
    wp.launch(loss_kernel, len(angles), inputs=[ranges, target], outputs=[loss], device=device)
tape.backward(loss)

print(f"{len(angles)} beams, loss {loss.numpy()[0]:.1f} m²")
print("gradient by the tape:", mount.grad.numpy())

# %% [markdown]
# **Predict:** derive $\partial L / \partial h$ and $\partial L / \partial \tau$ on paper. Is the tape right?

# %%
difference = 1.5 / torch.sin(angles) - measured
by_hand = torch.stack(
    (
        (2 * difference / torch.sin(angles)).sum(),
        (2 * difference * -1.5 * torch.cos(angles) / torch.sin(angles) ** 2).sum(),
    )
)
print("gradient by hand:    ", by_hand.cpu().numpy())
assert torch.allclose(wp.to_torch(mount.grad), by_hand)

# %% [markdown]
# It is. What does an adjoint read and write? It turns the kernel round. Where the kernel *reads* an input, its adjoint
# *adds* to the gradient of that input; where the kernel *writes* an output, the adjoint reads the gradient of that
# output.
#
# The first drawing below is a *trace*: `trace_thread` replays one thread of the kernel in Python, on small arrays that note
# what is read and written. You will use it on kernels of your own.

# %% tags=["hide-input"]
few = torch.linspace(0.1, 0.4, 9, **double)
trace = trace_thread(road_kernel, 3, [few, torch.tensor([1.5, 0.0], **double), torch.empty_like(few)])
draw_thread("road_kernel, thread 3", trace.reads, "one division,\none sine", trace.writes)

# %% tags=["hide-input"]
draw_thread(
    "its adjoint, thread 3",
    [*trace.reads, Cells("adj_ranges", (1, 9), [(0, 3)])],
    "the chain rule",
    [Cells("adj_angles +=", (1, 9), [(0, 3)]), Cells("adj_mount +=", (1, 2), [(0, 0), (0, 1)])],
)

# %% [markdown]
# *In words: above, thread 3 reads one of nine angles and both numbers of the mount, and writes one range. Below, its
# adjoint reads the same elements and the gradient of that range, and adds to the gradients of the angle and of both
# numbers of the mount.*
#
# All threads add to the same two numbers of `adj_mount`. Warp makes these additions atomic by itself.
#
# ### Exercise 1 · A wall
#
# importance ★★★ · difficulty ★☆☆ · 10 minutes
#
# A flat wall stands at distance $a$; its normal is turned by the angle $\psi$ from straight ahead. A level beam at
# azimuth $\alpha_i$ meets it at $r_i = a / \cos(\alpha_i - \psi)$. Write `wall_kernel`, with one thread per beam:
# `wall` holds $a$ and $\psi$. The derivative you leave to Warp.
#
# <details><summary>Hint</summary>
#
# Copy the body of `road_kernel` and change one line. Cosine is `wp.cos`.
#
# </details>


# %% tags=["exercise"]
@wp.kernel(module="unique")
def wall_kernel(
    # in
    azimuths: wp.array[real],
    wall: wp.array[real],
    # out
    ranges_out: wp.array[real],
):
    raise NotImplementedError


# %% tags=["solution"]
@wp.kernel(module="unique")
def wall_kernel(
    # in
    azimuths: wp.array[real],
    wall: wp.array[real],
    # out
    ranges_out: wp.array[real],
):
    i = wp.tid()
    ranges_out[i] = wall[0] / wp.cos(azimuths[i] - wall[1])


# %% tags=["check"]
@check
def _():
    azimuths, wall = torch.linspace(-0.6, 0.6, 7, **double), torch.tensor([12.0, 0.2], **double)
    found = torch.full_like(azimuths, torch.nan)
    run(wall_kernel, 7, [azimuths, wall], [found])
    assert found.isfinite().all(), f"each thread should write its own range; you have {found.tolist()}"
    assert torch.allclose(found, 12 / torch.cos(azimuths - 0.2)), (
        f"the first beam, at -0.6, meets the wall at {12 / math.cos(0.8):.3f} m; you have {found[0]:.3f} m"
    )
    arrays = [wp.from_torch(x) for x in (azimuths, wall)]
    arrays[1].requires_grad = True
    out, total = array([0.0] * 7, requires_grad=True), array([0.0], requires_grad=True)
    with wp.Tape() as tape:
        wp.launch(wall_kernel, 7, inputs=arrays, outputs=[out], device=device)
        wp.launch(loss_kernel, 7, inputs=[out, array([10.0] * 7)], outputs=[total], device=device)
    tape.backward(total)
    leaf = wall.clone().requires_grad_()
    ((leaf[0] / torch.cos(azimuths - leaf[1]) - 10) ** 2).sum().backward()
    gradient = wp.to_torch(arrays[1].grad)
    assert torch.allclose(gradient, leaf.grad), (
        f"the tape gives {gradient.tolist()}, PyTorch {leaf.grad.tolist()}: is the wall read from `wall`?"
    )


# %% tags=["wrong"]
@wp.kernel(module="unique")
def wall_kernel(azimuths: wp.array[real], wall: wp.array[real], ranges_out: wp.array[real]):  # a plus for a minus
    i = wp.tid()
    ranges_out[i] = wall[0] / wp.cos(azimuths[i] + wall[1])


# %% tags=["wrong"]
@wp.kernel(module="unique")
def wall_kernel(azimuths: wp.array[real], wall: wp.array[real], ranges_out: wp.array[real]):  # only the first thread
    if wp.tid() == 0:
        ranges_out[0] = wall[0] / wp.cos(azimuths[0] - wall[1])


# %% tags=["wrong"]
@wp.kernel(module="unique")
def wall_kernel(azimuths: wp.array[real], wall: wp.array[real], ranges_out: wp.array[real]):  # no gradient to the angle
    i = wp.tid()
    ranges_out[i] = wall[0] / wp.cos(azimuths[i] - real(0.2))


# %% [markdown]
# ## 2. From Warp to PyTorch
#
# A tape suits a program that is all Warp. Our networks are PyTorch's, so we want the kernel as one step among PyTorch's
# own. A `torch.autograd.Function` has two methods: `forward`, which computes, and `backward`, which is given the
# gradient of the output and returns the gradient of each input. Without a tape, `adjoint=True` launches the adjoint
# alone. It reads `adj_outputs` and adds to `adj_inputs`.
#
# Two details are easily missed. The adjoint *adds*, so what it adds to has to start at zero. And it *uses up*
# `adj_outputs`, which it sets to other values. PyTorch still needs the gradient that it handed us, so we pass a copy.


# %%
def differentiated(kernel, *numbers):
    """A PyTorch function: some tensors in, one number per row of the first out. `numbers` are passed to the kernel."""

    class Derived(torch.autograd.Function):
        @staticmethod
        def forward(ctx, *tensors):
            out = tensors[0].new_zeros(len(tensors[0]))
            run(kernel, len(out), [*tensors, *numbers], [out])
            ctx.save_for_backward(*tensors, out)
            return out

        @staticmethod
        def backward(ctx, adj_out):
            *inputs, output = (wp.from_torch(tensor.detach()) for tensor in ctx.saved_tensors)
            adj_inputs = [torch.zeros_like(tensor) for tensor in ctx.saved_tensors[:-1]]
            wp.launch(
                kernel,
                len(adj_out),
                inputs=[*inputs, *numbers],
                outputs=[output],
                adj_inputs=[*(wp.from_torch(adj) for adj in adj_inputs), *(None for _ in numbers)],
                adj_outputs=[wp.from_torch(adj_out.clone())],
                adjoint=True,
                device=device,
            )
            return tuple(adj_inputs)

    return Derived.apply


road = differentiated(road_kernel)
guess = torch.tensor([1.5, 0.0], **double, requires_grad=True)
((road(angles, guess) - measured) ** 2).sum().backward()
print("through PyTorch:", guess.grad.cpu().numpy())
assert torch.allclose(guess.grad, by_hand)

# %% [markdown]
# The same gradient. Now any optimiser of PyTorch can use it.
#
# **Predict:** after the fit, where do the measured points lie?

# %%
fit = torch.tensor([1.5, 0.0], **double, requires_grad=True)
optimiser = torch.optim.Adam([fit], lr=0.02)
path = []
for _ in range(300):
    path.append(fit.detach().cpu().clone())
    loss = ((road(angles, fit) - measured) ** 2).mean()
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
height, tilt = fit.tolist()
print(f"height {height:.3f} m (true {TRUE_HEIGHT}), tilt {math.degrees(tilt):.2f}° (true 2)")
assert abs(height - TRUE_HEIGHT) < 0.03
assert abs(tilt - TRUE_TILT) < math.radians(0.2)

# %% tags=["goal", "hide-input"]
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
for (h, t), colour, marker, label in (((1.5, 0.0), "#d55e00", "x", "before"), (fit.tolist(), "#0072b2", ".", "after")):
    down = (angles + t).cpu()
    left.plot(measured.cpu() * torch.cos(down), h - measured.cpu() * torch.sin(down), marker, color=colour, label=label)
left.axhline(0, color="black", linewidth=0.8)
left.set(xlabel="ahead [m]", ylabel="height above the road [m]", title="where the measured points lie")
left.legend(frameon=False)
path = torch.stack(path)
right.plot(path[:, 0], color="#0072b2", label="height [m]")
right.plot(path[:, 1].rad2deg(), color="#e69f00", linestyle="--", label="tilt [°]")
for true in (TRUE_HEIGHT, 2):
    right.axhline(true, color="black", linewidth=0.8, linestyle=":")
right.set(xlabel="step", title="dotted: the true values")
right.legend(frameon=False, loc="lower right")
plt.show()

# %% [markdown]
# *In words: left, a cross for each measured range, placed with the first guess: with distance the crosses rise above
# the road. After the fit the same ranges lie along a level line. Right, height and tilt over 300 steps; both end at
# their dotted true values.*
#
# ## 3. A judge
#
# The forward pass of a kernel is easily tested: you see its result. Nobody sees a gradient, and training with a wrong one
# still runs, only worse. So it needs a judge that knows nothing of the derivation: the difference quotient
#
# $$\frac{\partial f}{\partial x_k} \approx \frac{f(x + \varepsilon e_k) - f(x - \varepsilon e_k)}{2 \varepsilon}$$
#
# `torch.autograd.gradcheck(function, inputs)` computes it for each element of each input that requires a gradient, with
# $\varepsilon = 10^{-6}$, and compares it with what `backward` returns. float32 has too few digits for that: test in
# float64. By default it raises an error if they differ; with `raise_exception=False` it returns False.
#
# Here are four suspects. Each is a small kernel with a right *forward* pass.


# %%
@wp.kernel(module="unique")
def spot_kernel(ranges: wp.array[real], spread: real, areas_out: wp.array[real]):
    """The area that a beam lights up, but for a factor: the square of its radius."""
    i = wp.tid()
    areas_out[i] = spread * ranges[i]
    areas_out[i] = areas_out[i] * areas_out[i]


@wp.kernel(module="unique")
def blend_four_kernel(ranges: wp.array2d[real], scores: wp.array2d[real], count: int, blended_out: wp.array[real]):
    """Equation 3 of the paper, for four neighbours; it ignores `count`."""
    q = wp.tid()
    total = real(0.0)
    mixed = real(0.0)
    for t in range(4):
        e = wp.exp(scores[q, t])
        total += e
        mixed += e * ranges[q, t]
    blended_out[q] = mixed / total


@wp.kernel(module="unique")
def blend_count_kernel(ranges: wp.array2d[real], scores: wp.array2d[real], count: int, blended_out: wp.array[real]):
    """The same for as many neighbours as `count` says."""
    q = wp.tid()
    total = real(0.0)
    mixed = real(0.0)
    for t in range(count):
        e = wp.exp(scores[q, t])
        total += e
        mixed += e * ranges[q, t]
    blended_out[q] = mixed / total


@wp.kernel(module="unique")
def neighbour_kernel(ranges: wp.array[real], sums_out: wp.array[real]):
    """Each thread adds its squared range to two sums, of which other threads use one as well."""
    i = wp.tid()
    sums_out[i] += ranges[i] * ranges[i]
    sums_out[(i + 1) % sums_out.shape[0]] += ranges[i] * ranges[i]


def numbers_between(low, high, *shape):
    """Random inputs for a test: float64, with a gradient."""
    return torch.empty(*shape, **double).uniform_(low, high).requires_grad_()


suspects = {
    "spot": (differentiated(spot_kernel, 0.5), ((5,),)),
    "blend of four": (differentiated(blend_four_kernel, 4), ((3, 4), (3, 4))),
    "blend of count": (differentiated(blend_count_kernel, 4), ((3, 4), (3, 4))),
    "neighbours": (differentiated(neighbour_kernel), ((5,),)),
}

# %% [markdown]
# **Predict:** which of the four has a wrong gradient? Look for what differs from `road_kernel`.
#
# ### Exercise 2 · The judge
#
# importance ★★★ · difficulty ★★☆ · 10 minutes
#
# Write `is_right(function, *shapes)`: True if the backward pass of `function` agrees with its forward pass. `shapes`
# are the shapes of its tensors, all float64 on `device`. Use `torch.autograd.gradcheck`, with inputs between 1 and 2,
# and never raise an error for a wrong gradient. Every input counts, not only the first.
#
# <details><summary>Hint</summary>
#
# `numbers_between(1, 2, *shape)` makes one input. A tensor without `requires_grad` is not looked at.
#
# </details>


# %% tags=["exercise"]
def is_right(function, *shapes):
    raise NotImplementedError


# %% tags=["solution"]
def is_right(function, *shapes):
    inputs = [numbers_between(1, 2, *shape) for shape in shapes]
    return torch.autograd.gradcheck(function, inputs, raise_exception=False)


# %% tags=["check"]
@check
def _():
    class Wrong(torch.autograd.Function):  # right but for the gradient of its second input
        @staticmethod
        def forward(ctx, x, y):
            ctx.save_for_backward(x, y)
            return x * y**2

        @staticmethod
        def backward(ctx, adj):
            x, y = ctx.saved_tensors
            return adj * y**2, adj * x * y  # it should be 2 x y

    assert is_right(lambda x, y: x * y**2, (3,), (3,)) is True, "x y² by PyTorch is right: is the test in float64?"
    assert is_right(Wrong.apply, (3,), (3,)) is False, (
        "only the gradient of the second input is off: look at all inputs"
    )
    for name, (function, shapes) in suspects.items():
        inputs = [numbers_between(1, 2, *shape) for shape in shapes]
        true = torch.autograd.gradcheck(function, inputs, raise_exception=False)
        assert is_right(function, *shapes) is true, f"{name}: gradcheck says {true}, and you say the opposite"


# %% tags=["wrong"]
def is_right(function, *shapes):  # only the first input has a gradient
    inputs = [numbers_between(1, 2, *shape).requires_grad_(k == 0) for k, shape in enumerate(shapes)]
    inputs = [x if k == 0 else x.detach() for k, x in enumerate(inputs)]
    return torch.autograd.gradcheck(function, inputs, raise_exception=False)


# %% tags=["wrong"]
def is_right(function, *shapes):  # that there is a gradient says nothing
    inputs = [numbers_between(1, 2, *shape) for shape in shapes]
    function(*inputs).sum().backward()
    return all(bool(x.grad.isfinite().all()) for x in inputs)


# %% tags=["wrong"]
def is_right(function, *shapes):  # differences in float32 are noise
    inputs = [numbers_between(1, 2, *shape) for shape in shapes]
    return torch.autograd.gradcheck(lambda *x: function(*x).float().double(), inputs, raise_exception=False)


# %% [markdown]
# The verdicts, with the gradients of the first row beside them:

# %%
verdicts = {}
for name, (function, shapes) in suspects.items():
    inputs = [numbers_between(1, 2, *shape) for shape in shapes]
    verdicts[name] = torch.autograd.gradcheck(function, inputs, raise_exception=False)
    gradient = torch.autograd.grad(function(*inputs).sum(), inputs)[-1].flatten()[:4].tolist()
    print(f"{name:>15}: gradcheck {verdicts[name]!s:>5}, gradient {[round(x, 3) for x in gradient]}")
assert verdicts == {"spot": False, "blend of four": True, "blend of count": False, "neighbours": True}

# %% [markdown]
# Two of four are wrong, and nothing warned us.
#
# **What was read is overwritten.** `spot_kernel` squares `areas_out[i]` in place. The derivative of $x^2$ is $2x$, and
# the adjoint reads $x$ from where the kernel had read it. But there lies $x^2$ by now. An array holds one value for each
# element, the last one. So keep what a derivative needs: write the intermediate value to a local variable, or to an
# array of its own. Adding with `+=` is harmless, since the derivative of a sum needs no values: the neighbours passed.
# Warp can warn you of overwriting, if you set `wp.config.verify_autograd_array_access = True` before the kernel is
# compiled.
#
# **The loop is not unrolled.** `range(4)` is known to the compiler. Warp makes four copies of the body, and
# differentiates straight code. With `range(count)` it stays a loop, and what its iterations overwrite (`total` and
# `mixed`) is not kept. The adjoint does not even run the loop forward before it turns round. From the C++ that Warp
# generated, shortened:
#
# ```c++
# var_1 = 0.0;                          // total = real(0.0)
# var_2 = 0.0;                          // mixed = real(0.0)
# var_3 = wp::range(var_n);             // for t in range(count):      the loop itself is missing here
# var_13 = wp::div(var_2, var_1);       // mixed / total = 0 / 0
# ...
# wp::adj_div(var_2, var_1, var_13, adj_2, adj_1, adj_13);
# ```
#
# Division by zero at least shows. A running sum that starts at 1 gives finite numbers that are as wrong. (Warp's manual
# names both traps: *Differentiability*, *Array Overwrites* and *Dynamic Loops*. This is version 1.19. It unrolls loops
# of up to 16 iterations whose bounds are constants.)
#
# ### Exercise 3 · Mend it
#
# importance ★★☆ · difficulty ★★☆ · 15 minutes
#
# This kernel has both faults. It blends the ranges of the first `count` of up to eight neighbours with weights
# $w_t \propto e^{s_t} / r_t$, which is what a *perspective prior* does (notebook 03). Write `blend_some_kernel`, which
# computes the same and has a right derivative, for every `count` from 1 to 8.
#
# ```python
# q = wp.tid()
# blended_out[q] = real(0.0)
# total = real(0.0)
# for t in range(count):
#     w = wp.exp(scores[q, t]) / ranges[q, t]
#     total += w
#     blended_out[q] = blended_out[q] + w * ranges[q, t]
# blended_out[q] = blended_out[q] / total
# ```
#
# <details><summary>Hint: the loop</summary>
#
# A loop over all eight is unrolled. Inside it, `if t < count:` leaves out those that do not count.
#
# </details>
# <details><summary>Hint: the array</summary>
#
# Sum in a local variable, and write `blended_out[q]` once.
#
# </details>


# %% tags=["exercise"]
@wp.kernel(module="unique")
def blend_some_kernel(
    # in
    ranges: wp.array2d[real],
    scores: wp.array2d[real],
    count: int,
    # out
    blended_out: wp.array[real],
):
    raise NotImplementedError


# %% tags=["solution"]
@wp.kernel(module="unique")
def blend_some_kernel(
    # in
    ranges: wp.array2d[real],
    scores: wp.array2d[real],
    count: int,
    # out
    blended_out: wp.array[real],
):
    q = wp.tid()
    total = real(0.0)
    mixed = real(0.0)
    for t in range(8):
        if t < count:
            w = wp.exp(scores[q, t]) / ranges[q, t]
            total += w
            mixed += w * ranges[q, t]
    blended_out[q] = mixed / total


# %% tags=["check"]
@check
def _():
    for count in (1, 3, 8):
        r, s = numbers_between(2, 20, 2, 8), numbers_between(-1, 1, 2, 8)
        blend = differentiated(blend_some_kernel, count)
        found = blend(r, s)
        weights = (s.exp() / r)[:, :count]
        true = (weights * r[:, :count]).sum(-1) / weights.sum(-1)
        assert torch.allclose(found, true), (
            f"count {count}: the blend should be {true[0]:.4f} m, you have {found[0]:.4f} m"
        )
        assert torch.autograd.gradcheck(blend, (r, s), raise_exception=False), (
            f"count {count}: the blend is right, its gradient is not. Is the loop unrolled, and no array overwritten?"
        )


# %% tags=["wrong"]
@wp.kernel(module="unique")
def blend_some_kernel(
    ranges: wp.array2d[real], scores: wp.array2d[real], count: int, blended_out: wp.array[real]
):  # the loop is still dynamic
    q = wp.tid()
    total = real(0.0)
    mixed = real(0.0)
    for t in range(count):
        w = wp.exp(scores[q, t]) / ranges[q, t]
        total += w
        mixed += w * ranges[q, t]
    blended_out[q] = mixed / total


# %% tags=["wrong"]
@wp.kernel(module="unique")
def blend_some_kernel(
    ranges: wp.array2d[real], scores: wp.array2d[real], count: int, blended_out: wp.array[real]
):  # the array is still overwritten
    q = wp.tid()
    total = real(0.0)
    blended_out[q] = real(0.0)
    for t in range(8):
        if t < count:
            w = wp.exp(scores[q, t]) / ranges[q, t]
            total += w
            blended_out[q] = blended_out[q] + w * ranges[q, t]
    blended_out[q] = blended_out[q] / total


# %% tags=["wrong"]
@wp.kernel(module="unique")
def blend_some_kernel(
    ranges: wp.array2d[real], scores: wp.array2d[real], count: int, blended_out: wp.array[real]
):  # all eight, whatever count is
    q = wp.tid()
    total = real(0.0)
    mixed = real(0.0)
    for t in range(8):
        w = wp.exp(scores[q, t]) / ranges[q, t]
        total += w
        mixed += w * ranges[q, t]
    blended_out[q] = mixed / total


# %% [markdown]
# ## 4. Your own adjoint
#
# Sometimes a formula is right, its derivative is right, and still it fails at one point. The range of a point is
# $r = \sqrt{x^2 + y^2 + z^2}$. In many files a laser that met nothing is stored as the point (0, 0, 0).
#
# **Predict:** what is the gradient there?


# %%
@wp.func
def plain_range(x: real, y: real, z: real):
    return wp.sqrt(x * x + y * y + z * z)


@wp.kernel(module="unique")
def plain_range_kernel(points: wp.array2d[real], ranges_out: wp.array[real]):
    i = wp.tid()
    ranges_out[i] = plain_range(points[i, 0], points[i, 1], points[i, 2])


points = torch.tensor([[3.0, 4.0, 0.0], [0.0, 0.0, 0.0]], **double, requires_grad=True)
differentiated(plain_range_kernel)(points).sum().backward()
print("gradients of two points:", points.grad.tolist())
assert points.grad[0].isfinite().all()
assert points.grad[1].isnan().all()

# %% [markdown]
# The derivative of a square root at 0 is infinite, the derivative of $x^2$ there is 0, and infinity times 0 is NaN. If
# one of a hundred thousand points is such a one, the gradient of whatever they have in common is NaN, and after the next
# step of the optimiser so are all parameters. A range has no derivative at the origin. But a return that is not there
# should pull at nothing: 0 is what we want.
#
# `@wp.func_grad(f)` replaces the derivative of a `wp.func`. It takes the arguments of `f` and the gradient of the
# result, and adds to `wp.adjoint[x]` for each argument `x`. For $a(x) = x^3$:
#
# ```python
# @wp.func
# def cube(x: real):
#     return x * x * x
#
# @wp.func_grad(cube)
# def adj_cube(x: real, adj_ret: real):
#     wp.adjoint[x] += adj_ret * real(3.0) * x * x
# ```
#
# ### Exercise 4 · A range that does not break
#
# importance ★★☆ · difficulty ★★☆ · 10 minutes
#
# Write `adj_safe_range`: the gradient of `safe_range`, and 0 at the origin.
#
# <details><summary>Hint</summary>
#
# $\partial r / \partial x = x / r$, for $y$ and $z$ alike. Compute $r$ first, then `if r > real(0.0):`.
#
# </details>


# %% tags=["exercise"]
@wp.func
def safe_range(x: real, y: real, z: real):
    return wp.sqrt(x * x + y * y + z * z)


@wp.func_grad(safe_range)
def adj_safe_range(x: real, y: real, z: real, adj_ret: real):
    raise NotImplementedError


# %% tags=["solution"]
@wp.func
def safe_range(x: real, y: real, z: real):
    return wp.sqrt(x * x + y * y + z * z)


@wp.func_grad(safe_range)
def adj_safe_range(x: real, y: real, z: real, adj_ret: real):
    r = wp.sqrt(x * x + y * y + z * z)
    if r > real(0.0):
        wp.adjoint[x] += adj_ret * x / r
        wp.adjoint[y] += adj_ret * y / r
        wp.adjoint[z] += adj_ret * z / r


# %% tags=["check"]
@check
def _():
    if "NotImplementedError" in adj_safe_range.__code__.co_names:
        raise NotImplementedError

    @wp.kernel(module="unique")
    def safe_range_kernel(points: wp.array2d[real], ranges_out: wp.array[real]):
        i = wp.tid()
        ranges_out[i] = safe_range(points[i, 0], points[i, 1], points[i, 2])

    safe = differentiated(safe_range_kernel)
    leaf = torch.tensor([[3.0, 4.0, 12.0], [0.0, 0.0, 0.0], [-1.0, 2.0, -2.0]], **double, requires_grad=True)
    assert torch.allclose(safe(leaf), leaf.norm(dim=1)), "the ranges themselves have changed"
    (safe(leaf) * torch.tensor([1.0, 1.0, 5.0], **double)).sum().backward()
    assert leaf.grad.isfinite().all(), "the gradient at the origin should be 0; it is not even finite"
    assert (leaf.grad[1] == 0).all(), f"the gradient at the origin should be 0, not {leaf.grad[1].tolist()}"
    wanted = torch.tensor([3.0, 4.0, 12.0], **double) / 13
    assert torch.allclose(leaf.grad[0], wanted), f"at (3, 4, 12): {wanted.tolist()}, you have {leaf.grad[0].tolist()}"
    assert torch.autograd.gradcheck(safe, numbers_between(1, 2, 4, 3), raise_exception=False), (
        "gradcheck refuses it: is adj_ret a factor of all three?"
    )


# %% tags=["wrong"]
@wp.func
def safe_range(x: real, y: real, z: real):
    return wp.sqrt(x * x + y * y + z * z)


@wp.func_grad(safe_range)
def adj_safe_range(x: real, y: real, z: real, adj_ret: real):  # forgets the gradient that arrives
    r = wp.sqrt(x * x + y * y + z * z)
    if r > real(0.0):
        wp.adjoint[x] += x / r
        wp.adjoint[y] += y / r
        wp.adjoint[z] += z / r


# %% tags=["wrong"]
@wp.func
def safe_range(x: real, y: real, z: real):
    return wp.sqrt(x * x + y * y + z * z)


@wp.func_grad(safe_range)
def adj_safe_range(x: real, y: real, z: real, adj_ret: real):  # 0 / 0 at the origin
    r = wp.sqrt(x * x + y * y + z * z)
    wp.adjoint[x] += adj_ret * x / r
    wp.adjoint[y] += adj_ret * y / r
    wp.adjoint[z] += adj_ret * z / r


# %% tags=["wrong"]
@wp.func
def safe_range(x: real, y: real, z: real):
    return wp.sqrt(x * x + y * y + z * z)


@wp.func_grad(safe_range)
def adj_safe_range(x: real, y: real, z: real, adj_ret: real):  # z is forgotten
    r = wp.sqrt(x * x + y * y + z * z)
    if r > real(0.0):
        wp.adjoint[x] += adj_ret * x / r
        wp.adjoint[y] += adj_ret * y / r


# %% [markdown]
# `gradcheck` would not have found the NaN by itself: it looks only where it is sent. Send it to the places where
# something can go wrong.
#
# ## Summary
#
# 1. Warp derives an adjoint from each kernel. It reads what the kernel read, and adds to the gradients of the inputs. A
#    tape launches the adjoints in reverse order; `adjoint=True` launches one.
# 2. A wrong gradient is silent. `gradcheck` in float64 finds it.
# 3. Two habits break it: overwriting an array that was read, and loops whose bound is not a constant.
# 4. `wp.func_grad` and `wp.adjoint` replace the derivative of a function by your own.
#
# ## Next
#
# A kernel of equation 3 has only short loops, so Warp could differentiate it. By hand it gets faster, and each step can
# be seen: [06b · A fused op](06b_a_fused_op.ipynb).
