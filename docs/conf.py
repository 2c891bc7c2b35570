"""Settings of the documentation's site (`make docs`): the Markdown files as they are, README.md as the front page."""

import shutil
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent

project = "lerobot_policy_cqn"
copyright = "the authors of lerobot_policy_cqn; Apache-2.0"  # the name that Sphinx reads
extensions = ["myst_parser"]
root_doc = "README"
include_patterns = ["*.md", "docs/*.md", "benchmarks/README.md", "tests/golden/README.md"]
# Sphinx walks through the whole checkout; what is not kept in git is left out by name.
exclude_patterns = [".*", "build", "dist", "data", "outputs", "**/__pycache__", "*.egg-info"]

# As GitHub does it: anchors of headings, and links to files of the repository (here they are downloads).
myst_heading_anchors = 4

html_theme = "furo"
html_title = "lerobot_policy_cqn"
html_static_path = ["site.css"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
smartquotes = False
pygments_style = "friendly"
pygments_dark_style = "monokai"

# Chapters of the sidebar; a page that is not there (yet) is left out, one that is not named here comes last.
CHAPTERS = {
    "First steps": ["docs/tutorial", "docs/real_arm", "docs/faq", "docs/troubleshooting"],
    "Using it": [
        "docs/datasets",
        "docs/environments",
        "docs/hub",
        "docs/scale",
        "docs/compatibility",
        "docs/configuration",
        "docs/metrics",
    ],
    "How it works": ["docs/algorithm", "docs/baselines", "benchmarks/README", "tests/golden/README"],
    "Working on it": ["docs/extending", "docs/architecture", "CONTRIBUTING", "CHANGELOG"],
}


def chapters() -> str:
    """The sidebar as toctrees, in Markdown."""
    named = {page for pages in CHAPTERS.values() for page in pages}
    others = sorted(f"docs/{path.stem}" for path in (ROOT / "docs").glob("*.md"))
    table = {**CHAPTERS, "More": [page for page in others if page not in named]}
    blocks = []
    for caption, pages in table.items():
        there = [page for page in pages if (ROOT / f"{page}.md").is_file()]
        if there:
            blocks.append("\n".join(["```{toctree}", ":hidden:", f":caption: {caption}", "", *there, "```"]))
    return "\n\n".join(blocks)


def _add_chapters(_app: Any, name: str, source: list[str]) -> None:
    if name == root_doc:
        source[0] += f"\n\n{chapters()}\n"


def _add_index(app: Any, error: Exception | None) -> None:
    """A web server looks for index.html."""
    if error is None:
        shutil.copyfile(Path(app.outdir) / f"{root_doc}.html", Path(app.outdir) / "index.html")


def setup(app: Any) -> dict[str, bool]:
    """What Sphinx calls first."""
    app.connect("source-read", _add_chapters)
    app.connect("build-finished", _add_index)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
