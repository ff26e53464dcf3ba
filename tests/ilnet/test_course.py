import io
import os
import subprocess
import sys

import ipywidgets
import numpy as np
import PIL.Image
import pytest
import pyvista
from IPython.display import Image

from ilnet.course import Cells, check, draw_thread, show_scene, slide


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
