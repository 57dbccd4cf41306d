"""Sphinx: `make docs` writes docs/_build/index.html."""

from typing import Any

from sb3_robust_bisim import __version__

project = "sb3_robust_bisim"
release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3  # links to headings work as on GitHub
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = project
html_show_copyright = False
html_static_path = ["_static"]
html_css_files = ["tables.css"]
autodoc_member_order = "bysource"
autodoc_typehints = "description"


def setup(app: Any) -> None:
    """Docstrings write |x| for the absolute value, which reStructuredText takes for a substitution."""

    def escape_bars(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
        for i, line in enumerate(lines):
            parts = line.split("``")  # every second one is a literal
            lines[i] = "``".join(part if j % 2 else part.replace("|", r"\|") for j, part in enumerate(parts))

    app.connect("autodoc-process-docstring", escape_bars)
