import ast
import re
from pathlib import Path

import jupytext
import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[2] / "notebooks"
SOURCES = sorted(FOLDER.glob("[0-9]*.py"))
MAX_BYTES = 2**20
TIMEOUT = 180  # seconds a cell
# A local path shows where the notebook was built, and does not exist at the reader's.
LOCAL_PATH = re.compile(r"/(home|root|work|tmp)/|[A-Za-z]:\\\\?Users")

each_notebook = pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)


def written(source):
    return nbformat.read(source.with_suffix(".ipynb"), as_version=4)


def outputs(notebook):
    return [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]


def shows(code):
    """Whether it prints or draws, other than in functions that it only defines."""
    top = [node for node in ast.parse(code).body if not isinstance(node, ast.FunctionDef | ast.ClassDef)]
    calls = [node.func for statement in top for node in ast.walk(statement) if isinstance(node, ast.Call)]
    return any(getattr(call, "id", getattr(call, "attr", "")) in ("print", "show", "display") for call in calls)


def execute(notebook, folder):
    NotebookClient(
        notebook, timeout=TIMEOUT, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    ).execute()


def test_there_are_notebooks():
    assert SOURCES


@each_notebook
def test_the_notebook_is_built_from_its_source(source):
    def cells(notebook):
        return [(cell.cell_type, cell.source) for cell in notebook.cells]

    assert cells(written(source)) == cells(jupytext.read(source)), "run: python notebooks/build.py"


@each_notebook
def test_the_source_runs_from_top_to_bottom(source, tmp_path):
    execute(jupytext.read(source), tmp_path)
    assert list(tmp_path.iterdir()) == []


@each_notebook
def test_the_notebook_holds_its_outputs(source):
    notebook = written(source)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.source for cell in code if shows(cell.source) and not cell.outputs] == []
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert any("image/png" in output.get("data", {}) for output in outputs(notebook))


@each_notebook
def test_the_notebook_shows_no_error_warning_or_local_path(source):
    notebook = written(source)
    shown = outputs(notebook)
    assert [output for output in shown if output.output_type == "error"] == []
    assert [output.text for output in shown if output.get("name") == "stderr"] == []
    for output in shown:
        output.get("data", {}).pop("image/png", None)  # base64 spells whatever it likes
    assert LOCAL_PATH.findall(nbformat.writes(notebook)) == []


@each_notebook
def test_the_notebook_is_small(source):
    assert source.with_suffix(".ipynb").stat().st_size < MAX_BYTES
