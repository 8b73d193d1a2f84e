"""``rsbench list``: the names that exist."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from rsbench.cli.component_kinds import complete_kind
from rsbench.cli.console import echo

if TYPE_CHECKING:
    from rsbench.components.plugins import Kind, Offer

EPILOG = """[bold]Examples[/bold]

  rsbench list                    [dim](the kinds)[/dim]

  rsbench list solvers

  rsbench list scenes --json"""


def list_(
    kind: Annotated[
        str | None, typer.Argument(help="What to list; without it, the kinds.", autocompletion=complete_kind)
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="As a JSON list.")] = False,
) -> None:
    """List scenes, solvers, datasets and so on, with the cards to copy and edit, and who they come from."""
    import json as json_module

    from rsbench.cli.component_kinds import kind_names
    from rsbench.cli.console import print_rows, say
    from rsbench.components.cards import choices
    from rsbench.core.errors import RsbenchError

    kinds = kind_names()
    if kind is not None and kind not in kinds:
        raise RsbenchError(f"kind {kind!r} does not exist{choices(kind, kinds)}")
    rows = _kinds(kinds) if kind is None else entries(kind)
    if json:
        echo(json_module.dumps(rows))
        return
    columns = ("kind", "names") if kind is None else ("name", "origin", "description")
    texts = [[row[column] for column in columns] for row in rows]
    print_rows(
        kind or "kinds", columns, [[", ".join(x) if isinstance(x, list) else x for x in row] for row in texts]
    )
    if kind is None:
        say("rsbench list KIND lists them; rsbench show NAME tells more")
    elif cards := [row["card"] for row in rows if row["card"]]:
        folder = cards[0].rpartition("/")[0]
        say(f"cards: {folder}; copy one, edit it, and pass its path (ending in .toml) instead of a name")


def _kinds(kinds: list[str]) -> list[dict[str, Any]]:
    from rsbench.cli.component_kinds import names_of

    return [{"kind": kind, "names": names_of(kind)} for kind in kinds]


def entries(kind: str) -> list[dict[str, Any]]:
    """Name, origin, description, card and fault of everything of one kind.

    What an installed package offers is loaded, to tell whether it can be; its faults are its own.
    """
    from rsbench.cli.component_kinds import component_kind
    from rsbench.components import plugins
    from rsbench.components.cards import list_cards
    from rsbench.components.plugins import Offer

    described = component_kind(kind)
    if described is not None:
        return [_row(described, offer) for offer in plugins.offers(described)]
    cards = list_cards(kind)  # pyrefly: ignore[bad-argument-type]
    return [_row(None, Offer(name=name, origin="rsbench", path=path)) for name, path in cards.items()]


def _row(kind: Kind[Any, Any] | None, offer: Offer) -> dict[str, Any]:
    from rsbench.components import plugins
    from rsbench.components.cards import read_toml
    from rsbench.core.errors import RsbenchError

    description, broken = "", ""
    if offer.path is not None:
        description = str(read_toml(offer.path).get("description", ""))
    elif kind is not None:
        try:
            description = plugins.description_of(kind, offer)
        except RsbenchError as error:
            description, broken = f"broken: {error}", str(error)
    return {
        "name": offer.name,
        "origin": offer.origin,
        "description": description,
        "card": offer.path.as_posix() if offer.path is not None else None,
        "broken": broken or None,
    }


def register(app: typer.Typer) -> None:
    app.command("list", epilog=EPILOG)(list_)
