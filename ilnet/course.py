"""What the notebooks share: checks of exercises, sliders, 3-D scenes, drawings of threads. Needs the extra `course`."""

import io
import os
from collections.abc import Callable, Sequence
from html import escape
from typing import Any, NamedTuple

import ipywidgets
import PIL.Image
from IPython.display import HTML, Image
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch, Rectangle

__all__ = ["Cells", "check", "draw_thread", "show_scene", "slide"]

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
        print("Not answered yet: replace the line that raises NotImplementedError, and run both cells again.")
    else:
        print("Right.")


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
