"""The pages that people read: their links lead somewhere, and their Python runs."""

import csv
import re
import tomllib
from pathlib import Path

import pytest
import torch

from ilnet import scan_files
from ilnet.commands import experiment
from ilnet.scan import Scan
from ilnet.sensor import preset

ROOT = Path(__file__).parents[1]
PAGES = [*ROOT.glob("*.md"), *(ROOT / "kernels").rglob("*.md"), *(ROOT / "ilnet").rglob("*.md")]

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))


def anchors(page):
    """What GitHub makes of its headings."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@each_page
def test_every_link_leads_somewhere(page):
    for link in re.findall(r'\]\(([^)\s]+)\)|src="([^"]+)"', page.read_text()):
        target, _, anchor = "".join(link).partition("#")
        if "://" not in target:
            found = page.parent / target if target else page
            assert found.exists(), target
            assert not anchor or anchor in anchors(found), anchor


def test_the_layout_names_each_module_once():
    layout = re.search(r"^## Layout\n+```\n(.*?)^```", (ROOT / "README.md").read_text(), re.MULTILINE | re.DOTALL)[1]
    folders = ["kernels", *(f"ilnet/{room}" for room in ("", "world", "data", "models", "learning"))]
    modules = [file.name for folder in folders for file in (ROOT / folder).glob("[!_]*.py")]
    named = re.findall(r"\w+\.py", layout.partition("\nnotebooks/")[0])
    assert sorted(named) == sorted(modules)


SIZES = ("64x1024", "128x2048", "256x4096")


@pytest.mark.parametrize(("page", "sizes"), [("README.md", SIZES[1:2]), ("ilnet/results/README.md", SIZES)])
def test_the_figures_are_those_that_were_measured(page, sizes):
    """Each size has a table, sorted by IoU; the best of a column is bold, and the paper's MAE and IoU stand last."""
    with open(ROOT / "ilnet" / "results" / "table.csv", newline="") as file:
        measured = list(csv.DictReader(file))
    text = (ROOT / page).read_text()
    for size in sizes:
        [block] = re.findall(rf"^\| {size} \|.*\n\|[-|]+\n((?:\|.*\n)+)", text, re.MULTILINE)
        lines = [[cell.strip(" |") for cell in line.split(" | ")] for line in block.splitlines()]
        shown = [re.match(r"`([\w-]+)`", line[0])[1] for line in lines]
        known = {row["model"]: row for row in measured if row["size"] == size and row["model"] in shown}
        assert set(shown) >= {"bilinear", "planes", "liif", "iln", "iln-surfaces"}
        assert shown == sorted(shown, key=lambda name: -float(known[name]["iou"]))
        columns = ["mae", "iou", "floating", "chamfer"][: len(lines[0]) - 4]
        best = {
            key: (max if key == "iou" else min)(float(row[key]) for row in known.values() if row[key])
            for key in columns
        }
        for name, line in zip(shown, lines, strict=True):
            row = known[name]
            assert line[1] == (row["minutes"] or "\N{EN DASH}")
            for key, cell in zip(columns, line[2:], strict=False):
                assert cell.strip("*") == (f"{float(row[key]):.3f}" if row[key] else "")
                assert cell.startswith("**") == (bool(row[key]) and float(row[key]) == best[key])
            paper = [f"*{value:.3f}*" for value in experiment.PAPER[size].get(name, ())[:2]]
            assert line[-2:] == (paper or ["", ""])


@pytest.mark.parametrize("page", ["README.md", "ilnet/world/README.md"])
def test_its_python_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sensor = preset("os1-32")
    scan_files.write("frame.npz", Scan(torch.rand(sensor.shape) * 50 + 2, sensor))
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(), re.MULTILINE | re.DOTALL)
    assert blocks
    for block in blocks:
        exec(compile(block, page, "exec"), {})


def test_what_the_notebooks_read_is_installed_with_the_package():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    patterns = project["tool"]["setuptools"]["package-data"]["ilnet"]
    installed = {path.name for pattern in patterns for path in (ROOT / "ilnet").glob(pattern)}
    sources = "".join(path.read_text() for path in (ROOT / "notebooks").glob("[0-9]*.py"))
    read = set(re.findall(r'"results" / "([^"]+)"', sources))
    assert read
    assert read <= installed
