"""The documentation site: `make docs`. Warnings are errors; nothing is fetched from the network."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import rsbench

if TYPE_CHECKING:
    from sphinx.application import Sphinx

project = "rsbench"
author = "The rsbench developers"
version = release = rsbench.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["site"]
html_theme = "furo"
html_title = f"rsbench {release}"
html_copy_source = False
html_show_sphinx = False
myst_heading_anchors = 3
napoleon_google_docstring = True
napoleon_numpy_docstring = False
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_type_aliases = {name: name for name in ("ArrayLike", "FloatArray", "Image")}
python_use_unqualified_type_names = True
maximum_signature_line_length = 90

_REPOSITORY = "https://github.com/rsbench/rsbench/blob/main/"
_OUTSIDE = re.compile(r"\]\(\.\./(?P<path>[^)\s]+)\)")


def _link_to_the_repository(app: Sphinx, docname: str, content: list[str]) -> None:
    """Links that leave docs/ lead to files of the repository, which the site does not hold."""
    content[0] = _OUTSIDE.sub(rf"]({_REPOSITORY}\g<path>)", content[0])


def setup(app: Sphinx) -> None:
    app.connect("source-read", _link_to_the_repository)
