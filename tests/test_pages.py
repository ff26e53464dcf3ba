"""The pages that people read: their links lead somewhere, and their Python runs."""

import re
import tomllib
from pathlib import Path

import pytest
import torch

from ilnet import scan_files
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
