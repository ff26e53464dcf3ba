import ast
import re
import sys
from pathlib import Path

import nbformat
import pytest

FOLDER = Path(__file__).parents[2] / "notebooks"
sys.path.insert(0, str(FOLDER))
import build  # noqa: E402

SOURCES = sorted(FOLDER.glob("[0-9]*.py"))
MAX_BYTES = 2**20
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
    names = {getattr(call, "id", getattr(call, "attr", "")) for call in calls}
    return not names.isdisjoint(("print", "show", "display", "slide"))


def cells(notebook):
    return [(cell.cell_type, cell.source) for cell in notebook.cells]


def prove(source, folder):
    """Runs a notebook with its solutions in; returns what its checks said to each wrong answer."""
    notebook = build.proof(source)
    build.execute(notebook, str(folder))
    said = []
    for cell in notebook.cells:
        if build.tagged(cell, "refuses"):
            errors = [output for output in cell.outputs if output.output_type == "error"]
            assert errors, f"{source.stem}: a wrong answer passes the check\n{cell.source}"
            said.append((errors[0].ename, errors[0].evalue))
        elif build.tagged(cell, "check"):
            [output] = cell.outputs  # what the check found out, if it says so, and then
            assert output.get("text", "").splitlines()[-1:] == ["Right."], output
    return said


def test_there_are_notebooks():
    assert SOURCES


@each_notebook
def test_the_notebooks_are_built_from_their_source(source):
    remedy = "run: python notebooks/build.py"
    assert cells(written(source)) == cells(build.learner(source)), remedy
    solutions = FOLDER / "solutions" / f"{source.stem}.ipynb"
    if any(group["exercise"] for group in build.exercises(source)):
        assert cells(nbformat.read(solutions, as_version=4)) == cells(build.solved(source)), remedy
    else:
        assert not solutions.exists()


@each_notebook
def test_every_exercise_has_a_solution_a_check_and_an_answer_that_is_refused(source):
    for group in build.exercises(source):
        if group["exercise"]:
            assert "NotImplementedError" in group["exercise"][0].source
            assert min(len(group[tag]) for tag in ("solution", "check", "wrong")) > 0, group["exercise"][0].source


@each_notebook
def test_its_head_says_what_it_is_about_and_its_picture_is_there(source):
    notebook = written(source)
    head = notebook.cells[0].source
    assert re.match(rf"# {source.stem.split('_')[0]} · \S", head)
    [(words, picture)] = re.findall(r"!\[([^]]+)\]\(([^)]+)\)", head)
    assert picture == f"pictures/{source.stem}.png"
    assert len(words) > 60, "the picture in words, for those who cannot see it"
    assert (FOLDER / picture).read_bytes().startswith(b"\x89PNG")
    for part in ("**Goal.**", "**After this notebook you can**", "| You know |", "| Time |", "| Hardware |"):
        assert part in head
    assert sum(len(group["exercise"]) for group in build.exercises(source)) >= 3


def test_notebooks_and_readme_lead_to_notebooks_that_exist():
    names = {source.stem for source in SOURCES}
    readme = (FOLDER.parent / "README.md").read_text()
    for source in SOURCES:
        text = "".join(cell.source for cell in written(source).cells if cell.cell_type == "markdown")
        assert set(re.findall(r"\]\((?:\./)?([^):]+)\.ipynb\)", text)) <= names
        assert f"](notebooks/{source.stem}.ipynb)" in readme
        assert f"notebooks/pictures/{source.stem}.png" in readme


@each_notebook
def test_it_runs_with_its_solutions_and_refuses_wrong_answers(source, tmp_path):
    for name, message in prove(source, tmp_path):
        assert name == "AssertionError"
        assert len(message) > 10, "a check says what is off"
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
        output.get("data", {}).pop("image/png", None)  # base64 may spell anything
    assert LOCAL_PATH.findall(nbformat.writes(notebook)) == []


@each_notebook
def test_the_notebook_is_small(source):
    assert source.with_suffix(".ipynb").stat().st_size < MAX_BYTES


SMALL = """# %% [markdown]
# # Doubling

# %%
import math
from ilnet.course import check

# %% tags=["exercise"]
def double(x):
    raise NotImplementedError

# %% tags=["solution"]
def double(x):
    return 2 * x

# %% tags=["check"]
@check
def _():
    assert double(3) == 6, f"twice 3 is 6, not {double(3)}"
    assert math.isnan(double(math.nan)), "twice what is no number is none"

# %% tags=["wrong"]
def double(x):
    return x + 3 if x == x else 0

# %% tags=["wrong"]
def double(x):
    return x * x

# %%
print(double(1) if False else "the end")
"""


@pytest.fixture
def small(tmp_path):
    source = tmp_path / "01_small.py"
    source.write_text(SMALL)
    return source


def test_a_source_becomes_a_learners_and_a_solution_notebook(small):
    learner, solved = (cells(made(small)) for made in (build.learner, build.solved))
    code = [text for kind, text in learner if kind == "code"]
    assert "raise NotImplementedError" in code[1]
    assert code[2].startswith("@check")
    assert ("markdown", learner[4][1]) == learner[4]
    assert (
        "<details><summary><b>Solution</b></summary>\n\n```python\ndef double(x):\n    return 2 * x\n```"
        in learner[4][1]
    )
    assert [text for kind, text in solved if kind == "code"][1] == "def double(x):\n    return 2 * x"
    assert not any("x * x" in text for _, text in learner + solved)


def test_a_learner_runs_it_untouched(small, tmp_path):
    made = build.learner(small)
    build.execute(made, str(tmp_path))
    assert [output.text.split(":")[0] for output in outputs(made)] == ["Not answered yet", "the end\n"]


def test_a_check_that_lets_a_wrong_answer_pass_is_found(small, tmp_path):
    assert prove(small, tmp_path) == [
        ("AssertionError", "twice what is no number is none"),
        ("AssertionError", "twice 3 is 6, not 9"),
    ]
    small.write_text(SMALL.replace('    assert math.isnan(double(math.nan)), "twice what is no number is none"\n', ""))
    with pytest.raises(AssertionError, match="a wrong answer passes the check"):
        prove(small, tmp_path)
