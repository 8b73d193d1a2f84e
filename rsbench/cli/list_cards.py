"""``rsbench list``: the cards that exist."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer


class Kind(StrEnum):
    """Kinds of cards."""

    scenes = "scenes"
    renderers = "renderers"
    solvers = "solvers"
    datasets = "datasets"
    sweeps = "sweeps"
    matchers = "matchers"
    features = "features"
    correctors = "correctors"


def list_(kind: Annotated[Kind, typer.Argument(help="What to list.")]) -> None:
    """List the cards of a kind, with the files to copy and edit."""
    import pandas as pd

    from rsbench.cards import list_cards, read_toml
    from rsbench.cli.console import print_table
    from rsbench.solvers.engine.registry import list_solvers

    cards = list_cards(kind.value)
    rows = [{"name": name, "description": read_toml(path).get("description", "")} for name, path in cards.items()]
    if kind is Kind.solvers:
        plugins = [name for name in list_solvers() if name not in cards]
        rows += [{"name": name, "description": "from an installed package"} for name in plugins]
    print_table(kind.value, pd.DataFrame(rows))
    folder = next(iter(cards.values())).parent
    typer.echo(f"cards: {folder}; copy one, edit it, and pass its path (ending in .toml) instead of a name")


def register(app: typer.Typer) -> None:
    app.command("list", epilog="[bold]Example[/bold]  rsbench list solvers")(list_)
