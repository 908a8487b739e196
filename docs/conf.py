"""Sphinx settings: MyST pages, furo, API pages from the numpy-style docstrings."""

import errormotion

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

html_theme = "furo"
html_title = f"errormotion {release}"
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#1f5a96", "color-brand-content": "#1f5a96"},
}
