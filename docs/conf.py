"""The documentation site: `make docs`. Warnings are errors; nothing is fetched from the network."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from docutils import nodes

import rsbench

if TYPE_CHECKING:
    from sphinx.application import Sphinx

project = "rsbench"
author = "The rsbench developers"
version = release = rsbench.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["colon_fence"]
html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_title = f"rsbench {release}"
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False
myst_heading_anchors = 3
napoleon_google_docstring = True
napoleon_numpy_docstring = False
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_type_aliases = {name: name for name in ("ArrayLike", "FloatArray", "Image")}
python_use_unqualified_type_names = True
maximum_signature_line_length = 90

# napoleon takes "length, metres: of what" in the docstring of an attribute for a type and its text.
_attributes: dict[str, list[str]] = {}


def _keep_attribute(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    if what in ("attribute", "property"):
        _attributes[name] = list(lines)


def _restore_attribute(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    if name in _attributes:
        lines[:] = _attributes.pop(name)
    # |d| is a length in our docstrings and a substitution in reStructuredText.
    lines[:] = [re.sub(r"(``.*?``)|\|", lambda match: match.group(1) or r"\|", line) for line in lines]


def _name_aliases(
    app: Sphinx, what: str, name: str, obj: object, options: object, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """Aliases inside other types by their names, which autodoc writes for whole types alone."""
    alias = re.compile(r"TypeAliasForwardRef\('(\w+)'\)")
    return alias.sub(r"\1", signature or "") or None, alias.sub(r"\1", returns or "") or None


_REPOSITORY = "https://github.com/rsbench/rsbench/"
_BOARD = re.compile(_REPOSITORY + r"blob/main/results/(?P<folder>\w+)/site/(?:(?P<table>.+)\.md|(?P<page>.+))")
_FRAME = "results-leaderboard"
"""The page in which boards are shown."""


def _take_results_along(app: Sphinx, doctree: nodes.document) -> None:
    """Documents name results by their address in the repository: they are also installed without it. The site has
    copies of the pictures and of the boards, and links to those: to the interactive one instead of a table."""
    for image in doctree.findall(nodes.image):
        image["uri"] = image["uri"].replace(f"{_REPOSITORY}raw/main/", "/../")
    up = "../" * app.env.docname.count("/")
    for link in doctree.findall(nodes.reference):
        board = _BOARD.fullmatch(link.get("refuri", ""))
        if board and (board["page"] or board["table"] in _interactive(app, board["folder"])):
            link["refuri"] = f"{up}boards/{board['folder']}/{board['page'] or 'index.html#' + board['table']}"
            if app.env.docname == _FRAME:
                link["target"] = "board"


def _sites(app: Sphinx) -> Path:
    return Path(app.srcdir).parent / "results"


def _interactive(app: Sphinx, folder: str) -> list[str]:
    """Tables on the first page of a board: of some splits there is a table alone."""
    page = _sites(app) / folder / "site" / "index.html"
    return re.findall(r'<section class="split" id="([^"]+)"', page.read_text("utf-8")) if page.is_file() else []


def _copy_boards(app: Sphinx, exception: Exception | None) -> None:
    if exception is None and app.builder.format == "html":
        for site in sorted(_sites(app).glob("*/site")):
            shutil.copytree(site, Path(app.outdir) / "boards" / site.parent.name, dirs_exist_ok=True)


def setup(app: Sphinx) -> None:
    app.connect("doctree-read", _take_results_along, priority=400)  # before images are collected
    app.connect("build-finished", _copy_boards)
    app.connect("autodoc-process-docstring", _keep_attribute, priority=400)
    app.connect("autodoc-process-docstring", _restore_attribute, priority=600)
    app.connect("autodoc-process-signature", _name_aliases)
