"""Sphinx settings: MyST pages, furo, API pages from the numpy-style docstrings."""

import re
import runpy
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx

import errormotion
import errormotion.campaign.runner  # its pydantic models are made before autodoc adds annotations to their base class

project = "errormotion"
author = "the errormotion authors"
copyright = author
release = version = errormotion.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
exclude_patterns = ["_build"]
myst_enable_extensions = ["dollarmath", "amsmath", "deflist", "colon_fence", "fieldlist"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings say type, shape and unit
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
suppress_warnings = ["ref.python"]  # every plugin class has an attribute Settings: that name alone is no link

html_theme = "furo"
html_title = f"errormotion {release}"
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#1f5a96", "color-brand-content": "#1f5a96"},
}


def _escape_second_dims(*event: Any) -> None:
    """Keep ``(dof, dof_)`` from being read as a link to "dof": second dims are named with an underscore here."""
    lines = event[-1]
    for i, line in enumerate(lines):
        parts = line.split("``")  # every second part is code already
        parts[::2] = [re.sub(r"(?<!\w)(\w+)_(?=[\s,)]|$)", r"\1\_", part) for part in parts[::2]]
        lines[i] = "``".join(parts)


def _make_navigation_of_titles(app: Sphinx, *event: Any) -> None:
    """Let Sphinx copy only titles into the navigation of each page, not all objects, which it removes again."""
    context = event[2]
    if "toctree" not in context:
        return
    env, toctree = app.env, context["toctree"]
    if not hasattr(env, "titles_only"):
        env.titles_only = {name: _title_only(contents) for name, contents in env.tocs.items()}

    def titles(**options: Any) -> str:
        env.tocs, whole = env.titles_only, env.tocs
        try:
            return toctree(**options)
        finally:
            env.tocs = whole

    context["toctree"] = titles


def _title_only(contents: nodes.bullet_list) -> nodes.bullet_list:
    if any(contents.findall(addnodes.toctree)):
        return contents
    title = contents.deepcopy()
    for sections in list(title.children[0].findall(nodes.bullet_list)):
        sections.parent.remove(sections)
    return title


MADE = {"reference/error-codes": "error_codes", "reference/source-groups": "source_groups"}
"""Pages that end with a list, and the module of ``tools`` that makes it from the source of the package."""


def _append_list(app: Sphinx, page: str, source: list[str]) -> None:
    """Append the list of a page that is made from the source of the package."""
    del app
    if page in MADE:
        path = Path(__file__).parents[1] / "tools" / f"{MADE[page]}.py"
        source[0] += "\n" + runpy.run_path(str(path))["table"]()


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("source-read", _append_list)
    app.connect("autodoc-process-docstring", _escape_second_dims)
    app.connect("html-page-context", _make_navigation_of_titles, priority=400)  # before the theme's
