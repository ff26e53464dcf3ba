import io

import numpy as np
import PIL.Image
import pytest
import pyvista
from IPython.display import HTML, Image

from ilnet.course import Cells, check, draw_thread, show_scene


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


@pytest.mark.filterwarnings("error")
def test_a_scene_can_be_turned_in_a_jupyter_session(plotter, monkeypatch):
    monkeypatch.setenv("JPY_SESSION_NAME", "lesson.ipynb")
    shown = show_scene(plotter)
    assert isinstance(shown, HTML)
    assert '<iframe srcdoc="' in shown.data
    assert "height: 80px" in shown.data


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
