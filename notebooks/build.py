"""Writes the notebooks: each source `NN_name.py` is converted and executed, and becomes `NN_name.ipynb`.

python notebooks/build.py            all of them
python notebooks/build.py 00 03      those that start so
"""

import sys
import tempfile
import time
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient

HERE = Path(__file__).parent


def build(source: Path) -> None:
    notebook = jupytext.read(source)
    for number, cell in enumerate(notebook.cells):
        cell.id = f"cell-{number}"  # not random, so that two builds agree
    with tempfile.TemporaryDirectory() as folder:  # a notebook may not rely on where it lies
        NotebookClient(
            notebook,
            timeout=180,
            kernel_name="python3",
            resources={"metadata": {"path": folder}},
            record_timing=False,  # nor differ in times, nor in how what was printed falls into pieces
            coalesce_streams=True,
        ).execute()
    notebook.metadata.pop("jupytext", None)
    nbformat.write(notebook, source.with_suffix(".ipynb"))


if __name__ == "__main__":
    for source in sorted(HERE.glob("[0-9]*.py")):
        if len(sys.argv) == 1 or source.name.startswith(tuple(sys.argv[1:])):
            start = time.perf_counter()
            build(source)
            size = source.with_suffix(".ipynb").stat().st_size
            print(f"{source.stem}: {time.perf_counter() - start:.0f} s, {size / 1024:.0f} KiB")
