"""Writes the notebooks from their sources.

python notebooks/build.py            all of them
python notebooks/build.py 00 03      those that start so

A source `NN_name.py` (jupytext, py:percent) becomes two notebooks: the learner's `NN_name.ipynb`, executed, and
`solutions/NN_name.ipynb`. Tags say which cells are whose. An exercise is a cell tagged `exercise`, which raises
NotImplementedError, then one tagged `solution`, then one tagged `check`. Cells tagged `wrong` behind them are answers
that the check has to refuse; only the tests run them. What the cell tagged `goal` draws becomes the picture at the head
of the notebook and in the README, `pictures/NN_name.png`.
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
TIMEOUT = 600  # seconds a cell, where other things run as well
PICTURE_WIDTH = 640  # pixels
WIDGET = "application/vnd.jupyter.widget-view+json"


def tagged(cell: NotebookNode, tag: str) -> bool:
    return tag in cell.metadata.get("tags", ())


def exercises(source: Path) -> list[dict[str, list[NotebookNode]]]:
    """The cells of a source in order, each run of exercise cells as one dictionary by tag."""
    groups: list[dict[str, list[NotebookNode]]] = []
    for cell in jupytext.read(source).cells:
        tag = next((t for t in ("exercise", "solution", "check", "wrong") if tagged(cell, t)), "text")
        if tag in ("text", "exercise"):
            groups.append({"text": [], "exercise": [], "solution": [], "check": [], "wrong": []})
        groups[-1][tag].append(cell)
    return groups


def learner(source: Path) -> NotebookNode:
    """The notebook with stubs to fill in, each solution folded behind its check."""
    cells = []
    for group in exercises(source):
        cells += group["text"] + group["exercise"] + group["check"]
        code = "\n\n".join(cell.source for cell in group["solution"])
        if code:
            folded = f"<details><summary><b>Solution</b></summary>\n\n```python\n{code}\n```\n\n</details>"
            cells.append(nbformat.v4.new_markdown_cell(folded))
    return notebook(source, cells)


def solved(source: Path) -> NotebookNode:
    """The notebook with the solutions in."""
    return notebook(source, [c for g in exercises(source) for c in g["text"] + g["solution"] + g["check"]])


def proof(source: Path) -> NotebookNode:
    """The solved notebook in which each check, once passed, meets its wrong answers, and then the solution again."""
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
        cell.id = f"cell-{number}"  # not random, so that two builds agree
    made.metadata.pop("jupytext", None)
    return made


def execute(made: NotebookNode, folder: str) -> None:
    NotebookClient(
        made,
        timeout=TIMEOUT,
        kernel_name="python3",
        resources={"metadata": {"path": folder}},
        record_timing=False,  # nor differ in times, nor in how what was printed falls into pieces
        coalesce_streams=True,
    ).execute()
    # Sliders work where a kernel runs; on paper they are an error message.
    made.metadata.pop("widgets", None)
    for cell in made.cells:
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if WIDGET not in output.get("data", {})]


def draw_goal(made: NotebookNode, file: Path) -> None:
    """Writes what the cell tagged `goal` of an executed notebook drew."""
    [cell] = [cell for cell in made.cells if tagged(cell, "goal")]
    [drawn] = [output.data["image/png"] for output in cell.outputs if "image/png" in output.get("data", {})]
    picture = PIL.Image.open(io.BytesIO(base64.b64decode(drawn))).convert("RGB")
    size = PICTURE_WIDTH, round(picture.height * PICTURE_WIDTH / picture.width)
    picture = picture.resize(size, PIL.Image.Resampling.LANCZOS).quantize(128, PIL.Image.Quantize.MAXCOVERAGE)
    file.parent.mkdir(exist_ok=True)
    picture.save(file, "png", optimize=True)


def build(source: Path) -> None:
    made = learner(source)
    with tempfile.TemporaryDirectory() as folder:  # a notebook may not rely on where it lies
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
