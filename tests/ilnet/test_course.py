import io
import os
import subprocess
import sys

import ipywidgets
import numpy as np
import PIL.Image
import pytest
import pyvista
import torch
import warp as wp
from IPython.display import Image

from ilnet.course import Cells, check, draw_thread, draw_trace, run, show_scene, slide, trace_thread, yours_or


def test_a_check_says_right_or_not_yet_and_raises_what_is_wrong(capsys):
    @check
    def _():
        pass

    @check
    def _():
        raise NotImplementedError

    right, not_yet = capsys.readouterr().out.splitlines()
    assert right == "Right."
    assert "NotImplementedError" in not_yet
    with pytest.raises(AssertionError, match="too short"):

        @check
        def _():
            raise AssertionError("too short")

    with pytest.raises(NotImplementedError, match="aten"):  # an answer, and a wrong one

        @check
        def _():
            raise NotImplementedError("Could not run 'aten::bmm'")


def test_sliders_where_somebody_sits_and_elsewhere_their_middle(monkeypatch):
    monkeypatch.delenv("JPY_SESSION_NAME", raising=False)
    monkeypatch.delenv("VSCODE_PID", raising=False)
    drawn, shown = [], []
    monkeypatch.setattr(ipywidgets, "interact", lambda draw, **values: shown.append(values))
    values = {"edge": (0.0, 1.0, 0.05), "number": (0, 11, 1), "row": (2.0, 14.75, 0.25)}
    slide(lambda **at: drawn.append(at), **values)
    [at] = drawn
    assert at == pytest.approx({"edge": 0.5, "number": 5, "row": 8.25})
    assert isinstance(at["number"], int)  # it may be an index
    assert shown == []
    monkeypatch.setenv("JPY_SESSION_NAME", "a notebook")
    slide(lambda **at: drawn.append(at), **values)
    assert len(drawn) == 1
    assert shown == [values]


def test_an_answer_has_a_stand_in_until_it_is_given():
    def not_yet(x):
        raise NotImplementedError

    def broken(x):
        raise NotImplementedError("Could not run 'aten::bmm'")

    assert yours_or(abs, not_yet)(-2) == 2
    assert yours_or(abs, lambda x: 10 * x)(-2) == -20
    with pytest.raises(NotImplementedError, match="aten"):
        yours_or(abs, broken)(-2)


@wp.func
def right_of(columns: wp.array[int], i: int, width: int):
    return (columns[i] + 1) % width


@wp.kernel(enable_backward=False, module="unique")
def scatter_kernel(
    columns: wp.array[int],
    values: wp.array2d[float],
    scale: float,
    sums_out: wp.array2d[float],
    counts_out: wp.array[float],
    copies_out: wp.array[float],
):
    i, k = wp.tid()
    j = right_of(columns, i, sums_out.shape[1])
    sums_out[k, j] += scale * wp.max(values[i, k], wp.float32(0.0))
    wp.atomic_add(counts_out, j, 1.0)
    copies_out[j] = copies_out[j] + 1.0  # a race


def scattered():
    columns = torch.tensor([0, 1, 2, 2], dtype=torch.int32)
    return [columns, torch.ones(4, 2), 3.0, torch.zeros(2, 3), torch.zeros(3), torch.zeros(3)]


def test_a_trace_shows_what_one_thread_of_a_kernel_touches():
    arguments = scattered()
    trace = trace_thread(scatter_kernel, (1, 0), arguments)
    assert trace.reads == [
        Cells("columns", (1, 4), [(0, 1)]),
        Cells("values", (4, 2), [(1, 0)]),
        Cells("copies_out", (1, 3), [(0, 2)]),
    ]
    assert trace.writes == [
        Cells("copies_out", (1, 3), [(0, 2)]),
        Cells("sums_out +=", (2, 3), [(0, 2)]),
        Cells("counts_out +=", (1, 3), [(0, 2)]),
    ]
    assert trace.bytes == 4 * (3 + 1 + 2 * 2)
    assert all(x.sum() == 0 for x in arguments[3:]), "only a launch changes the arguments"
    assert isinstance(draw_trace(scatter_kernel, (1, 0), arguments, "scale"), Image)
    with pytest.raises(IndexError, match=r"the thread touches columns\[4\]; its shape is \(4,\)"):
        trace_thread(scatter_kernel, (4, 0), arguments)


def test_run_launches_on_tensors_and_an_exercise_is_neither_launched_nor_drawn(capsys):
    @wp.kernel(enable_backward=False, module="unique")
    def open_kernel(sums_out: wp.array[float]):
        raise NotImplementedError

    *inputs, sums, counts, copies = scattered()
    run(scatter_kernel, (4, 2), inputs, [sums, counts, copies])
    assert sums.tolist() == [[6, 3, 3]] * 2
    with pytest.raises(NotImplementedError):
        run(open_kernel, 3, [], [counts])
    assert draw_trace(open_kernel, 0, [counts], "") is None
    assert "Not answered yet" in capsys.readouterr().out


@pytest.fixture
def plotter():
    plotter = pyvista.Plotter(off_screen=True, window_size=(120, 80))
    plotter.add_mesh(pyvista.PolyData(np.random.default_rng(0).random((50, 3)).astype(np.float32)))
    return plotter


def test_a_scene_is_a_picture_where_nobody_sits(plotter, monkeypatch):
    monkeypatch.delenv("JPY_SESSION_NAME", raising=False)
    monkeypatch.delenv("VSCODE_PID", raising=False)
    shown = show_scene(plotter)
    assert isinstance(shown, Image)
    assert PIL.Image.open(io.BytesIO(shown.data)).size == (120, 80)


SCENE = """
import numpy as np, pyvista
from ilnet.course import show_scene
plotter = pyvista.Plotter(off_screen=True, window_size=(120, 80))
plotter.add_mesh(pyvista.PolyData(np.random.default_rng(0).random((50, 3)).astype(np.float32)))
print(type(show := show_scene(plotter)).__name__, '<iframe srcdoc="' in show.data, "height: 80px" in show.data)
"""


def test_a_scene_can_be_turned_in_a_jupyter_session():
    # In a process of its own: trame patches asyncio for good, and a patched loop now and then misses what a notebook
    # kernel answers, so that the tests which run notebooks later would wait for ever.
    session = {**os.environ, "JPY_SESSION_NAME": "lesson.ipynb"}
    command = [sys.executable, "-W", "error", "-c", SCENE]
    run = subprocess.run(command, env=session, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert run.stdout.split() == ["HTML", "True", "True"]


def test_a_thread_is_drawn_with_all_that_it_touches():
    few = [Cells("image", (3, 4), [(1, 1)])]
    many = [*few, Cells("scores", (5, 4), [(2, column) for column in range(4)])]
    sizes = []
    for reads in (few, many):
        drawn = PIL.Image.open(
            io.BytesIO(draw_thread("a kernel", reads, "adds", [Cells("out", (2, 1), [(1, 0)])]).data)
        )
        colours = {colour for _, colour in drawn.convert("RGB").getcolors(2**20)}
        assert {(0, 114, 178), (213, 94, 0)} <= colours  # what is read, what is written
        sizes.append(drawn.size)
    assert sizes[0][0] == sizes[1][0]
    assert sizes[0][1] < sizes[1][1]
