"""The site builds without a warning and without a network, and its links lead somewhere."""

import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

ROOT = Path(__file__).parents[2]
pytest.importorskip("myst_nb", reason="needs the extra `site`")


class Page(HTMLParser):
    """The links, anchors and folded blocks of a page."""

    def __init__(self, file):
        super().__init__()
        self.links, self.anchors, self.folded, self.loaded = [], set(), 0, []
        self.feed(file.read_text())

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.links += [given[name] for name in ("href", "src") if given.get(name)]
        self.anchors.update(given[name] for name in ("id", "name") if given.get(name))
        self.folded += tag == "details" and "open" not in given
        if tag in ("script", "img", "link", "iframe"):
            self.loaded += [given[name] for name in ("href", "src") if given.get(name)]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-c", "notebooks/site", ".", str(out)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return {file: Page(file) for file in out.rglob("*.html") if "_static" not in file.parts}


def test_its_links_lead_somewhere(site):
    broken = []
    for file, page in site.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (file.parent / unquote(parts.path)).resolve() if parts.path else file
            anchor = unquote(parts.fragment)
            if not target.exists() or (anchor and target in site and anchor not in site[target].anchors):
                broken.append(f"{file.name}: {link}")
    assert broken == []


def test_it_needs_no_network(site):
    outside = {link for page in site.values() for link in page.loaded if urlsplit(link).scheme in ("http", "https")}
    assert outside == set()


def test_it_has_every_notebook_with_its_solutions_folded(site):
    pages = {file.stem: page for file, page in site.items()}
    for notebook in (ROOT / "notebooks").glob("[0-9]*.ipynb"):
        assert pages[notebook.stem].folded >= notebook.read_text().count("<b>Solution</b>"), notebook.name


@pytest.mark.parametrize(
    "name", ["kernels.gather_blend", "kernels.Mesh.cast", "ilnet.models.load", "ilnet.sensor.Sensor"]
)
def test_the_reference_describes_public_names(site, name):
    assert any(name in page.anchors for page in site.values())
