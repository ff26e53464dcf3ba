"""Writes the notebooks from their sources.

python notebooks/build.py            builds all of them
python notebooks/build.py 00 03      builds those whose names start with 00 or 03

A source `NN_name.py` (jupytext, py:percent) becomes two notebooks: `NN_name.ipynb` for the learner, executed, and
`solutions/NN_name.ipynb`. Cells are told apart by their tags. An exercise has four kinds, in this order:

- `exercise`: a stub that raises NotImplementedError;
- `solution`: folded away in the learner's notebook;
- `check`: asserts that an answer is right;
- `wrong`: one or more answers that the check should refuse. Only the tests run them.

The text before an exercise has a card below its title: `importance ★★★ · difficulty ★★☆ · 10 minutes`. Cells that only
draw are tagged `hide-input`.

One cell is tagged `goal`. Its picture becomes `pictures/NN_name.png`, which the head of the notebook and the README show.
"""

import base64
import io
import sys
import tempfile
import time
from pathlib import Path

import jupytext
import nbformat
import PIL.Image
from nbclient import NotebookClient
from nbformat import NotebookNode

HERE = Path(__file__).parent
TIMEOUT = 600  # seconds for one cell, on a machine that is busy with other work
PICTURE_WIDTH = 640  # pixels


def tagged(cell: NotebookNode, tag: str) -> bool:
    return tag in cell.metadata.get("tags", ())


def exercises(source: Path) -> list[dict[str, list[NotebookNode]]]:
    """Returns the cells of a source in order: one dictionary by tag for each exercise, and for each other cell."""
    groups: list[dict[str, list[NotebookNode]]] = []
    for cell in jupytext.read(source).cells:
        tag = next((t for t in ("exercise", "solution", "check", "wrong") if tagged(cell, t)), "text")
        if tag in ("text", "exercise"):
            groups.append({"text": [], "exercise": [], "solution": [], "check": [], "wrong": []})
        groups[-1][tag].append(cell)
    return groups


def learner(source: Path) -> NotebookNode:
    """Returns the notebook with stubs to fill in. Each solution is folded below its check."""
    cells = []
    for group in exercises(source):
        cells += group["text"] + group["exercise"] + group["check"]
        code = "\n\n".join(cell.source for cell in group["solution"])
        if code:
            folded = f"<details><summary><b>Solution</b></summary>\n\n```python\n{code}\n```\n\n</details>"
            cells.append(nbformat.v4.new_markdown_cell(folded))
    return notebook(source, cells)


def solved(source: Path) -> NotebookNode:
    """Returns the notebook with its solutions in place of the stubs."""
    return notebook(source, [c for g in exercises(source) for c in g["text"] + g["solution"] + g["check"]])


def proof(source: Path) -> NotebookNode:
    """Returns the solved notebook in which each check also meets its wrong answers, and then the solution again."""
    cells = []
    for group in exercises(source):
        cells += group["text"] + group["solution"] + group["check"]
        for wrong in group["wrong"]:
            refused = [nbformat.v4.new_code_cell(cell.source) for cell in group["check"]]
            refused[-1].metadata["tags"] = ["raises-exception", "refuses"]
            cells += [wrong, *refused]
        if group["wrong"]:
            cells += [nbformat.v4.new_code_cell(cell.source) for cell in group["solution"]]
    return notebook(source, cells)


def notebook(source: Path, cells: list[NotebookNode]) -> NotebookNode:
    made = jupytext.read(source)
    made.cells = cells
    for number, cell in enumerate(cells):
        cell.id = f"cell-{number}"  # not random, so that two builds are equal
    made.metadata.pop("jupytext", None)
    return made


def execute(made: NotebookNode, folder: str) -> None:
    NotebookClient(
        made,
        timeout=TIMEOUT,
        kernel_name="python3",
        resources={"metadata": {"path": folder}},
        # Two builds should not differ in times, or in how printed text is split into outputs.
        record_timing=False,
        coalesce_streams=True,
    ).execute()


def draw_goal(made: NotebookNode, file: Path) -> None:
    """Writes the picture that the cell tagged `goal` of an executed notebook drew."""
    [cell] = [cell for cell in made.cells if tagged(cell, "goal")]
    [drawn] = [output.data["image/png"] for output in cell.outputs if "image/png" in output.get("data", {})]
    picture = PIL.Image.open(io.BytesIO(base64.b64decode(drawn))).convert("RGB")
    size = PICTURE_WIDTH, round(picture.height * PICTURE_WIDTH / picture.width)
    picture = picture.resize(size, PIL.Image.Resampling.LANCZOS).quantize(128, PIL.Image.Quantize.MAXCOVERAGE)
    file.parent.mkdir(exist_ok=True)
    picture.save(file, "png", optimize=True)


def build(source: Path) -> None:
    made = learner(source)
    with tempfile.TemporaryDirectory() as folder:  # a notebook should run from any folder
        execute(made, folder)
    nbformat.write(made, source.with_suffix(".ipynb"))
    draw_goal(made, HERE / "pictures" / f"{source.stem}.png")
    if any(group["exercise"] for group in exercises(source)):
        (HERE / "solutions").mkdir(exist_ok=True)
        nbformat.write(solved(source), HERE / "solutions" / f"{source.stem}.ipynb")


if __name__ == "__main__":
    for source in sorted(HERE.glob("[0-9]*.py")):
        if len(sys.argv) == 1 or source.name.startswith(tuple(sys.argv[1:])):
            start = time.perf_counter()
            build(source)
            size = source.with_suffix(".ipynb").stat().st_size
            print(f"{source.stem}: {time.perf_counter() - start:.0f} s, {size / 1024:.0f} KiB")
