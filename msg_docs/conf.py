"""Settings of Sphinx: ``sphinx-build -W msg_docs build/html`` makes HTML of these pages.

The pages are written for GitHub. The first page of the HTML is the repository's README.
"""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

project = "avatar"
copyright = "the avatar authors, Apache-2.0"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinxcontrib.mermaid"]

myst_heading_anchors = 4
myst_fence_as_directive = ["mermaid"]
html_theme = "furo"
html_title = "avatar"
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # docstrings give types, shapes and units
napoleon_custom_sections = [("Attributes", "params_style")]
suppress_warnings = ["ref.python"]  # "shape" of an array is no reference to any ``shape``


def as_on_github(app, docname, source):
    """Make README.md the first page, and lead links to it there."""
    readme = "../" * (docname.count("/") + 1) + "README.md"
    source[0] = source[0].replace(f"]({readme}", "](/index.md")
    if docname == "index":
        text = (ROOT / "README.md").read_text().replace("](msg_docs/", "](")
        outside = r"\[([^\]]+)\]\((?:LICENSE|CHANGELOG.md)\)"  # are no pages
        source[0] = re.sub(outside, r"\1", text) + source[0]
        app.env.note_dependency(ROOT / "README.md")


def norms_as_text(app, what, name, obj, options, lines):
    """Escape the bars of |x|, which reStructuredText takes for a substitution."""
    lines[:] = [re.sub(r"(``.*?``)|\|", lambda m: m[1] or r"\|", one) for one in lines]


def setup(app):
    """Register what is above with Sphinx."""
    app.connect("source-read", as_on_github)
    app.connect("autodoc-process-docstring", norms_as_text)
