"""What the notebooks share: checks of exercises, one training, sliders, 3-D scenes, traces of threads.

Needs the extra `course`.
"""

import inspect
import io
import math
import os
from collections.abc import Callable, Sequence
from functools import lru_cache, wraps
from html import escape
from itertools import islice
from types import FunctionType
from typing import Any, NamedTuple

import ipywidgets
import numpy as np
import PIL.Image
import torch
import warp as wp
from IPython.display import HTML, Image
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch, Rectangle
from torch import nn
from tqdm import tqdm  # type: ignore[import-untyped]

from ilnet import data, metrics, places, simulate
from ilnet.scan import Pair
from ilnet.sensor import PAPER_INPUT, PAPER_TARGET, Sensor

__all__ = [
    "Cells",
    "Fit",
    "Trace",
    "check",
    "draw_thread",
    "draw_trace",
    "fit",
    "held_out",
    "run",
    "show_scene",
    "slide",
    "trace_thread",
    "yours_or",
]

_NOT_YET = "Not answered yet: replace the line that raises NotImplementedError, and run both cells again."
# Inches: the width of a drawing, and the side of an array element in it.
_WIDTH, _CELL = 9.0, 0.17


def check(checks: Callable[[], object]) -> None:
    """Runs the checks of an exercise at once. Use it as a decorator of the function that holds them.

    An exercise that is not answered yet raises a bare NotImplementedError. Then this prints a hint, and the notebook
    goes on. Every other error goes through, including a NotImplementedError with a message, such as PyTorch's.

    Args:
        checks: Asserts what the answer should fulfil. It takes no arguments, and its result is ignored.

    Raises:
        AssertionError: If `checks` finds something wrong. Any other error of the answer goes through as well.
    """
    try:
        checks()
    except NotImplementedError as error:
        if error.args:
            raise
        print(_NOT_YET)
    else:
        print("Right.")


class Fit(NamedTuple):
    """What `fit` returns."""

    curve: dict[int, dict[str, float]]
    """Figures on the held-out scan by step, see `metrics.compare`. Step 0 is the untrained network."""
    answers: dict[int, torch.Tensor]
    """Ranges (64, 1024) [m] that the network gave for that scan, by step."""


@lru_cache(maxsize=2)
def held_out(target: Sensor = PAPER_TARGET) -> Pair:
    """Returns a scan of a town that `fit` does not train in, 16×1024, and what another sensor measures there."""
    town = places.town("town05", device=simulate.best_device())
    [(scan, truth)] = places.held_out_scans(town, 1, [PAPER_INPUT, target])
    return scan, truth


@lru_cache(maxsize=1)
def _streets() -> list[places.Place]:
    return [places.town(name, device=simulate.best_device()) for name in ("town01", "town02")]


@lru_cache(maxsize=4)
def _batches(steps: int, seed: int) -> list[data.Batch]:
    rays = data.ContinuousRays(_streets(), PAPER_INPUT, crops=4, columns=64, queries=384, seed=seed)
    return list(islice(rays, steps))


def fit(model: nn.Module, steps: int = 120, seed: int = 0, looks: Sequence[int] = (0, 30, 60, 120)) -> Fit:
    """Trains a network as all notebooks do: on the same rays and with the same settings.

    The loss is L1 in metres, the optimiser Adam with one cycle of its rate up to 1e-3. A step has 4 crops of 64 columns
    and 384 rays in each, in two towns.

    Args:
        model: Called with `(images (B, 16, W) [m], queries (B, Q, 2), wrap)`, it returns ranges (B, Q) [m]. It goes to
            the GPU if there is one.
        steps: Number of steps.
        seed: Of the rays. Networks that are compared have the same.
        looks: Steps after which the network is measured on the scan of `held_out`.
    """
    scan, truth = held_out()
    device = scan.ranges.device
    image, queries = scan.filled()[None], PAPER_INPUT.grid_queries(truth.sensor).view(1, -1, 2).to(device)
    optimizer = torch.optim.Adam(model.to(device).parameters(), 1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1e-3, steps)
    found = Fit({}, {})
    batches = tqdm(_batches(steps, seed), desc="training", leave=False, disable=not _somebody_is_there())
    for step, batch in enumerate((None, *batches)):
        if batch is not None:
            crops, asked, ranges = (tensor.to(device) for tensor in (batch.image, batch.queries, batch.ranges))
            loss = (model(crops, asked, batch.wrap) - ranges).abs().mean()  # metres
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
        if step in looks:
            with torch.no_grad():  # in parts that stay in the cache
                parts = [model(image, part, True) for part in queries.split(2**14, dim=1)]
            found.answers[step] = torch.cat(parts, 1).view(truth.ranges.shape)
            found.curve[step] = metrics.compare(found.answers[step], truth)
    return found


def slide(draw: Callable[..., object], **values: tuple[float, float, float]) -> None:
    """Shows what `draw` draws, in a Jupyter session with sliders to move, elsewhere at the middle of their ranges.

    Args:
        draw: Draws a picture for numbers that it takes by name.
        values: The first, the last and the step of each number.
    """
    if _somebody_is_there():
        ipywidgets.interact(draw, **values)
        return
    # Sliders need a running kernel, and nbclient sometimes freezes on them (its issue 312).
    middle = {name: first + (last - first) / step // 2 * step for name, (first, last, step) in values.items()}
    draw(**{name: type(values[name][0])(value) for name, value in middle.items()})


def _somebody_is_there() -> bool:
    return "JPY_SESSION_NAME" in os.environ or "VSCODE_PID" in os.environ


def yours_or(given: Callable[..., Any], answer: Callable[..., Any]) -> Callable[..., Any]:
    """Returns the answer to an exercise, with a stand-in that serves for as long as the exercise is not answered.

    Args:
        given: What serves until then.
        answer: The learner's function. It raises a bare NotImplementedError as long as it is not answered.

    Returns:
        A function that calls `answer`, or else `given`.
    """

    @wraps(given)
    def function(*args: Any, **kwargs: Any) -> Any:
        try:
            return answer(*args, **kwargs)
        except NotImplementedError as error:
            if error.args:
                raise
            return given(*args, **kwargs)

    return function


def run(kernel: wp.Kernel, threads: int | tuple[int, ...], inputs: Sequence[Any], outputs: Sequence[Any]) -> None:
    """Launches a Warp kernel on torch tensors, without a copy, on their device and its current stream.

    Args:
        kernel: The kernel.
        threads: How many threads it has, or their numbers along each axis.
        inputs: Its first arguments: tensors, whose dtype the kernel may leave open, and numbers.
        outputs: Its other arguments, tensors that it writes to.

    Raises:
        NotImplementedError: If the kernel is an exercise that is not answered yet.
    """
    if "NotImplementedError" in kernel.func.__code__.co_names:
        raise NotImplementedError
    device = outputs[0].device
    stream = wp.stream_from_torch(torch.cuda.current_stream(device)) if device.type == "cuda" else None
    arrays = [[wp.from_torch(x.detach()) if torch.is_tensor(x) else x for x in part] for part in (inputs, outputs)]
    wp.launch(kernel, threads, *arrays, device=str(device), stream=stream)


def show_scene(plotter: Any) -> HTML | Image:
    """Shows a PyVista scene: in a Jupyter session one that turns with the mouse, elsewhere a picture.

    Args:
        plotter: A `pyvista.Plotter` with `off_screen=True`. It is closed.

    Returns:
        The scene as HTML, or a picture. A cell that ends with this call shows it.
    """
    if _somebody_is_there():
        width, height = plotter.window_size
        page = escape(plotter.trame.export_html(None).getvalue())
        plotter.close()
        # A width in percent, so that the scene shrinks with the page.
        style = f"width: 100%; max-width: {width}px; height: {height}px; border: 0"
        return HTML(f'<div><iframe srcdoc="{page}" style="{style}"></iframe></div>')
    pixels = plotter.screenshot()
    plotter.close()
    png = io.BytesIO()
    # 256 colours keep notebooks small.
    PIL.Image.fromarray(pixels).quantize(256, PIL.Image.Quantize.MAXCOVERAGE).save(png, "png", optimize=True)
    return Image(png.getvalue())


class Cells(NamedTuple):
    """An array to draw, and which of its elements one thread touches."""

    name: str
    """The name of the array in the kernel's signature."""
    shape: tuple[int, int]
    """How many rows and columns to draw."""
    touched: Sequence[tuple[int, int]]
    """The (row, column) of each element that the thread reads or writes."""


class Trace(NamedTuple):
    """What one thread of a kernel touches. `draw_thread` draws it."""

    reads: list[Cells]
    """The arrays of which it reads elements."""
    writes: list[Cells]
    """The arrays of which it writes elements. "+=" after a name: it adds to them, atomically."""
    bytes: int
    """How many bytes it moves if it reads and writes each element once; adding takes both."""


def trace_thread(kernel: wp.Kernel, thread: int | tuple[int, ...], arguments: Sequence[Any]) -> Trace:
    """Replays one thread of a kernel in Python and records which elements of its arrays it touches.

    A kernel is a Python function, so it runs here as it stands, on copies of its arguments and with another `wp`. Real
    numbers become Python's. Integers divide as in Python, so a kernel that divides negative ones may go elsewhere.

    Args:
        kernel: The kernel, with the functions that it calls.
        thread: What `wp.tid()` returns.
        arguments: All arguments of a launch, its inputs and then its outputs: tensors and numbers. Keep them small.

    Returns:
        The elements it reads, in the order of the arguments, and those it writes.

    Raises:
        IndexError: If the thread touches an element that an array does not have.
    """
    names = inspect.signature(kernel.func).parameters
    recorded = [
        _Recorded(name, x.detach().cpu().numpy()) if torch.is_tensor(x) else x
        for name, x in zip(names, arguments, strict=True)
    ]
    _in_python(kernel.func, _WarpInPython(thread))(*recorded)
    arrays = [x for x in recorded if isinstance(x, _Recorded)]
    reads = [x.cells(x.read) for x in arrays if x.read]
    writes = [x.cells(x.written) for x in arrays if x.written] + [x.cells(x.added, " +=") for x in arrays if x.added]
    moved = sum((len(x.read) + len(x.written) + 2 * len(x.added)) * x.values.itemsize for x in arrays)
    return Trace(reads, writes, moved)


def draw_trace(kernel: wp.Kernel, thread: int | tuple[int, ...], arguments: Sequence[Any], steps: str) -> Image | None:
    """Draws what one thread of a kernel touches, see `trace_thread`.

    Args:
        kernel: The kernel.
        thread: What `wp.tid()` returns.
        arguments: All arguments of a launch: small tensors and numbers.
        steps: A few short lines that say what happens in registers.

    Returns:
        A picture. A cell that ends with this call shows it. None, with a hint, if the kernel is not answered yet.
    """
    try:
        trace = trace_thread(kernel, thread, arguments)
    except NotImplementedError as error:
        if error.args:
            raise
        print(_NOT_YET)
        return None
    title = f"{kernel.func.__name__}, thread {thread}: {trace.bytes} bytes"
    return draw_thread(title, trace.reads, steps, trace.writes)


class _Element(float):
    """A number read from an array. It knows where from, so that `array[i] += x`, which is atomic, can be told apart."""

    home: tuple[Any, ...] | None = None
    added = False

    def __iadd__(self, other: float) -> "_Element":
        element = _Element(float(self) + other)
        element.home, element.added = self.home, True
        return element


class _Recorded:
    """A copy of an array that notes which of its elements are read, written and added to."""

    def __init__(self, name: str, values: np.ndarray) -> None:
        self.name, self.values, self.shape = name, values.copy(), values.shape
        self.dtype: type = float if np.issubdtype(values.dtype, np.floating) else int
        self.read: dict[tuple[int, ...], None] = {}  # dictionaries, as sets that keep their order
        self.written: dict[tuple[int, ...], None] = {}
        self.added: dict[tuple[int, ...], None] = {}

    def _checked(self, index: Any) -> tuple[int, ...]:
        index = tuple(int(i) for i in (index if isinstance(index, tuple) else (index,)))
        if len(index) != len(self.shape) or not all(0 <= i < n for i, n in zip(index, self.shape, strict=True)):
            raise IndexError(f"the thread touches {self.name}{list(index)}; its shape is {self.shape}")
        return index

    def __getitem__(self, index: Any) -> Any:
        index = self._checked(index)
        self.read[index] = None
        if self.dtype is int:
            return int(self.values[index])
        element = _Element(self.values[index])
        element.home = (self.name, index)
        return element

    def __setitem__(self, index: Any, value: Any) -> None:
        index = self._checked(index)
        self.values[index] = value
        if isinstance(value, _Element) and value.added and value.home == (self.name, index):
            self.read.pop(index, None)
            self.added[index] = None
        else:
            self.written[index] = None

    def add(self, index: Any, value: float) -> None:
        index = self._checked(index)
        self.values[index] += value
        self.added[index] = None

    def cells(self, touched: dict[tuple[int, ...], None], mark: str = "") -> Cells:
        """Returns the touched elements in a drawing of two dimensions: the last half of the axes side by side."""
        shape = self.shape if len(self.shape) > 1 else (1, *self.shape)
        rows = math.prod(shape[: len(shape) // 2])
        flat = (np.ravel_multi_index(index, self.shape) for index in touched)
        columns = max(math.prod(shape) // rows, 1)
        return Cells(self.name + mark, (rows, columns), [divmod(int(i), columns) for i in flat])


class _WarpInPython:
    """What a kernel that is replayed in Python finds under the name `wp`."""

    float32 = float64 = float
    int32 = int64 = int

    def __init__(self, thread: int | tuple[int, ...]) -> None:
        self.tid = lambda: thread

    @staticmethod
    def where(condition: bool, if_true: Any, if_false: Any) -> Any:
        return if_true if condition else if_false

    @staticmethod
    def atomic_add(array: _Recorded, *arguments: Any) -> None:
        array.add(arguments[:-1], arguments[-1])

    def __getattr__(self, name: str) -> Any:
        value = getattr(wp, name)
        if not isinstance(value, wp.Function | type):
            return value
        return lambda *arguments: value(*(float(x) if isinstance(x, _Element) else x for x in arguments))


def _in_python(function: FunctionType, stand_in: _WarpInPython) -> FunctionType:
    """Returns a kernel's function with another `wp`, and so are the functions that it calls."""
    scope: dict[str, Any] = {}
    for name in function.__code__.co_names:
        value = function.__globals__.get(name)
        if value is wp:
            scope[name] = stand_in
        elif value is wp.float32 or value is wp.float64:
            scope[name] = float
        elif isinstance(value, wp.Function) and value.func is not None:
            scope[name] = _in_python(value.func, stand_in)
        elif name in function.__globals__:
            scope[name] = value
    return FunctionType(function.__code__, scope, closure=function.__closure__)


def draw_thread(title: str, reads: Sequence[Cells], steps: str, writes: Sequence[Cells]) -> Image:
    """Draws one thread of a kernel: what it reads on the left, its steps in the middle, what it writes on the right.

    Args:
        title: The name of the kernel, and what one thread stands for.
        reads: The arrays it reads.
        steps: A few short lines that say what happens in registers.
        writes: The arrays it writes.

    Returns:
        A picture. A cell that ends with this call shows it.
    """
    height = 0.3 + max(sum(_tall(cells) for cells in arrays) for arrays in (reads, writes))
    figure = Figure(figsize=(_WIDTH, height))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, _WIDTH), ylim=(0, height), aspect="equal")
    axes.axis("off")
    axes.text(0.1, height - 0.1, title, fontsize=10, va="top")
    middle, half = (height - 0.3) / 2, 1.15
    box = FancyBboxPatch((_WIDTH / 2 - half, middle - 0.45), 2 * half, 0.9, "round,pad=0.05", fc="#fff3d6", ec="black")
    axes.add_patch(box)
    axes.text(_WIDTH / 2, middle, steps, ha="center", va="center", fontsize=9)
    for arrays, colour, side in ((reads, "#0072b2", -1), (writes, "#d55e00", 1)):
        thread = _WIDTH / 2 + side * (half + 0.07), middle
        top = middle + sum(_tall(cells) for cells in arrays) / 2
        for cells in arrays:
            x = 2.6 - _CELL * cells.shape[1] if side < 0 else _WIDTH - 2.4
            for end in _draw_cells(axes, cells, colour, x, top, side):
                ends = (end, thread) if side < 0 else (thread, end)
                axes.add_patch(FancyArrowPatch(*ends, arrowstyle="-|>", mutation_scale=7, color=colour, alpha=0.6))
            top -= _tall(cells)
    png = io.BytesIO()
    figure.savefig(png, dpi=100)
    return Image(png.getvalue())


def _tall(cells: Cells) -> float:
    return _CELL * cells.shape[0] + 0.45


def _draw_cells(axes: Axes, cells: Cells, colour: str, x: float, top: float, side: int) -> list[tuple[float, float]]:
    """Draws one array as a grid below its name; returns where the arrows of the touched rows end."""
    right, aligned = x + _CELL * cells.shape[1], "right" if side < 0 else "left"
    name_x = right if side < 0 else x
    axes.text(name_x, top - 0.12, cells.name, fontsize=9, family="monospace", va="center", ha=aligned)
    ends: dict[int, tuple[float, float]] = {}
    for row in range(cells.shape[0]):
        for column in range(cells.shape[1]):
            corner = x + _CELL * column, top - 0.25 - _CELL * (row + 1)
            here = (row, column) in cells.touched
            axes.add_patch(Rectangle(corner, _CELL, _CELL, fc=colour if here else "white", ec="#777777", linewidth=0.6))
            # An arrow leaves the last touched cell of a row that is read, and meets the first of one that is written.
            if here and (side < 0 or row not in ends):
                ends[row] = corner[0] + (_CELL if side < 0 else 0), corner[1] + _CELL / 2
    return list(ends.values())
