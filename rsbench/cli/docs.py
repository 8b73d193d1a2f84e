"""``rsbench docs``: the documents and examples that are installed with the package."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rsbench.cli.console import echo

EPILOG = """[bold]Examples[/bold]

  rsbench docs                              [dim](what there is)[/dim]

  less "$(rsbench docs conventions)"

  cp "$(rsbench docs tour.ipynb)" . && jupyter lab tour.ipynb"""


def docs(
    name: Annotated[str | None, typer.Argument(help="A document or example; its path is printed.")] = None,
) -> None:
    """List the documents and examples that come with rsbench, or print where one of them is."""
    from rsbench.components.cards import choices
    from rsbench.core.errors import RsbenchError

    documents = list_documents()
    if name is not None:
        if name not in documents:
            raise RsbenchError(f"document {name!r} does not exist{choices(name, documents)}")
        echo(str(documents[name]))
        return
    import pandas as pd

    from rsbench.cli.console import print_table

    rows = [{"name": known, "about": _title(path)} for known, path in documents.items()]
    print_table("documents and examples", pd.DataFrame(rows))
    echo("rsbench docs NAME prints the path of one")


def list_documents() -> dict[str, Path]:
    """Paths by name, sorted: documents without their ending, examples with it."""
    from rsbench.components.cards import shipped_folder

    examples = shipped_folder("examples", "_docs/examples")
    pages = shipped_folder("docs", "_docs").rglob("*.md")
    documents = {path.stem: path for path in pages if path.stem != "index" and examples not in path.parents}
    return dict(sorted(documents.items())) | {path.name: path for path in sorted(examples.glob("*.*"))}


def _title(path: Path) -> str:
    """The first heading of a document or notebook."""
    for line in path.read_text("utf-8").splitlines():
        text = line.strip().lstrip('"').removesuffix(",").removesuffix('"').removesuffix("\\n")
        if text.startswith("# "):
            return text[2:]
    return ""


def register(app: typer.Typer) -> None:
    app.command(epilog=EPILOG)(docs)
