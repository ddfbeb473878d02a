"""How Sphinx makes the site; `make docs` runs it. See docs/pages.py for what runs before."""

from importlib.metadata import version as installed
from typing import Any

from sphinx.util import inspect

project = "dolfinx_nts"
author = copyright = "The dolfinx_nts authors"
version = release = installed("dolfinx_nts")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3
exclude_patterns = ["_build", "made/runs"]
html_theme = "furo"
html_title = f"dolfinx_nts {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]

default_role = "py:obj"  # `System` in a docstring is a link where there is such a thing
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # docstrings give shapes and units, which annotations cannot
autodoc_class_signature = "mixed"
napoleon_google_docstring, napoleon_numpy_docstring = True, False
napoleon_use_ivar = True
napoleon_attr_annotations = False  # types say less than the text beside them


def indent(line: str) -> int:
    """How far a line is indented."""
    return len(line) - len(line.lstrip())


def as_markup(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Make of plain docstrings what Sphinx reads as code and as lists.

    Code is what is indented behind a line that ends with a colon and an empty line; a list may
    begin without an empty line before it.
    """
    for i in range(len(lines) - 2):
        line, after = lines[i], lines[i + 2]
        deeper = bool(after.strip()) and indent(after) > indent(line)
        if line.rstrip().endswith(":") and not lines[i + 1].strip() and deeper:
            lines[i] = line.rstrip() + ":"
    for i in range(len(lines) - 1, 0, -1):
        line, before = lines[i], lines[i - 1]
        begins = line.lstrip().startswith("- ") and indent(before) <= indent(line)
        goes_on = before.lstrip().startswith("- ") and indent(before) == indent(line)
        if begins and before.strip() and not goes_on:
            lines.insert(i, "")


def leave_out(app: Any, what: str, name: str, obj: Any, skip: bool, options: Any) -> bool | None:
    """Leave out the fields of named tuples, which their class's docstring describes."""
    return True if type(obj).__name__ == "_tuplegetter" else None


def arguments(
    app: Any, what: str, name: str, obj: Any, options: Any, given: str | None, returned: Any
) -> tuple[str, None] | None:
    """Show the arguments of __init__ where __new__ takes any, and none of protocols."""
    if what != "class" or "**" not in (given or ""):
        return None
    if getattr(obj, "_is_protocol", False):
        return "", None
    taken = inspect.signature(obj.__init__, bound_method=True)
    return inspect.stringify_signature(taken, show_annotation=False), None


def setup(app: Any) -> None:
    """Connect what is above, and `as_markup` before napoleon, which reads the sections."""
    app.connect("autodoc-process-signature", arguments)
    app.connect("autodoc-skip-member", leave_out)
    app.connect("autodoc-process-docstring", as_markup, priority=400)
