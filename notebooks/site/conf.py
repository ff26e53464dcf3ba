"""The site of the course and of the API, by Sphinx.

sphinx-build -W -c notebooks/site . build/site        from the root of the repository; needs the extra `site`

The pages are read where they lie: the notebooks as they were executed, and the README files. So the source folder of
Sphinx is the root of the repository, and links between notebooks and README files hold in both.
"""

import re
from pathlib import Path
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert

NOTEBOOKS = Path(__file__).parents[1]
# Numbers of the notebooks of each track.
TRACKS = {"values": ("00", "03", "04", "05", "08", "10"), "kernels": ("02", "06a", "06b", "07")}


def times(notebook: Path) -> tuple[int, int]:
    """Returns the minutes for reading and for the exercises that the head of a notebook names."""
    row = re.search(r"\| Time \| (\d+) minutes, and (\d+) for the exercises", notebook.read_text())
    if row is None:
        raise ValueError(
            f"{notebook.name} has no row of its time; it should begin `| Time | N minutes, and M for the exercises`"
        )
    return int(row[1]), int(row[2])


def table(numbers: tuple[str, ...] | None = None) -> str:
    """Returns the notebooks with their minutes as a Markdown table: those of a track, or all."""
    sources = [s for s in sorted(NOTEBOOKS.glob("[0-9]*.py")) if numbers is None or s.name.split("_")[0] in numbers]
    minutes = [times(source) for source in sources]
    rows = ["| notebook | reading | exercises |", "|---|--:|--:|"]
    for source, (reading, solving) in zip(sources, minutes, strict=True):
        rows.append(f"| [](../{source.stem}.ipynb) | {reading} minutes | {solving} minutes |")
    hours = [sum(column) / 60 for column in zip(*minutes, strict=True)]
    rows.append(f"| *together* | *{hours[0]:.1f} hours* | *{hours[1]:.1f} hours* |")
    return "\n".join(rows)


project = "Implicit LiDAR Network"
html_title = project
copyright = "its authors, MIT licence"
root_doc = "notebooks/site/index"
include_patterns = ["*.md", "kernels/**.md", "ilnet/**.md", "notebooks/*.ipynb", "notebooks/site/*.md"]
exclude_patterns = [".*", "build", "runs", "*_output"]
html_extra_path = ["start"]
html_static_path = ["static"]
html_css_files = ["site.css"]
html_theme_options = {"navbar_persistent": []}  # one search field is enough

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
html_theme = "sphinx_book_theme"
html_math_renderer = "mathml"

nb_execution_mode = "off"
myst_enable_extensions = ["dollarmath", "html_image", "substitution"]
myst_heading_anchors = 3
myst_substitutions = {"all": table(), **{name: table(numbers) for name, numbers in TRACKS.items()}}

napoleon_custom_sections = [("Returns", "params_style")]  # a tuple is described name by name
default_role = "code"  # docstrings set names in single backticks
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"


def keep_colons(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Puts back what stands before a colon in the docstring of an attribute, which Napoleon takes for its type."""
    if what in ("attribute", "data", "property") and lines and lines[-1].startswith(":type: "):
        before = lines.pop().removeprefix(":type: ")
        lines[0] = f"{before}: {lines[0]}"


def draw_inline(self: Any, node: Any) -> None:
    self.body.append(convert(node.astext()))
    raise nodes.SkipNode


def draw_block(self: Any, node: Any) -> None:
    self.body.append(f'<div class="formula">{convert(node.astext(), display="block")}</div>')
    raise nodes.SkipNode


def setup(app: Any) -> None:
    # Browsers show MathML without a script from the network.
    app.add_html_math_renderer("mathml", (draw_inline, None), (draw_block, None))
    app.connect("autodoc-process-docstring", keep_colons, priority=600)  # after Napoleon
