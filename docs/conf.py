"""Sphinx: `make docs` writes docs/_build/index.html."""

from sb3_robust_bisim import __version__

project = "sb3_robust_bisim"
release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
myst_enable_extensions = ["dollarmath"]
exclude_patterns = ["_build"]
html_theme = "furo"
autodoc_member_order = "bysource"
autodoc_typehints = "description"
