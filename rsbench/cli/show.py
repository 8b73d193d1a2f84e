"""``rsbench show``: all about one name."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rsbench.cli.component_kinds import complete_any, complete_kind
from rsbench.cli.console import echo

if TYPE_CHECKING:
    from rsbench.components.plugins import Kind, Offer

EPILOG = """[bold]Examples[/bold]

  rsbench show rs-stereo-refined

  rsbench show castle --kind builders

  rsbench show ./my-solver.toml --kind solvers --json"""


def show(
    name: Annotated[
        str,
        typer.Argument(metavar="NAME|CARD", help="A name, or the path of a card.", autocompletion=complete_any),
    ],
    kind: Annotated[
        str | None,
        typer.Option(
            help="Its kind (rsbench list), where more than one has the name.", autocompletion=complete_kind
        ),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="As one JSON object.")] = False,
) -> None:
    """Print what a solver needs and returns, the parameters of a component with defaults, or a card."""
    import json as json_module

    found = [_about(name, each) for each in _kinds_of(name, kind)]
    if json:
        echo(json_module.dumps(found[0] if len(found) == 1 else found, default=str))
        return
    for content in found:
        _print(content)


def _print(about: dict[str, Any]) -> None:
    from rsbench.cli.console import print_rows, say

    title = f"{about['kind']}: {about['name']}"
    if "content" in about:
        say(f"{title}\n\n{Path(about['card']).read_text('utf-8')}\ncard: {about['card']}\n")
        return
    rows = [
        (key.replace("_", " "), _text(value))
        for key, value in about.items()
        if key not in ("kind", "name", "parameters") and value not in (None, "", [])
    ]
    print_rows(title, ("", ""), rows)
    if about["parameters"]:
        columns = ("parameter", "value", "default", "meaning")
        print_rows(
            "parameters", columns, [[_text(row[column]) for column in columns] for row in about["parameters"]]
        )


def _text(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} = {_text(item)}" for key, item in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(_text(item) for item in value)
    return str(value)


def _kinds_of(name: str, kind: str | None) -> list[str]:
    """Kinds in which to look a name up."""
    from rsbench.cli.component_kinds import kind_names, names_of
    from rsbench.components.cards import choices, current_name
    from rsbench.core.errors import RsbenchError

    kinds = kind_names()
    if kind is not None:
        if kind not in kinds:
            raise RsbenchError(f"--kind {kind!r} does not exist{choices(kind, kinds)}")
        return [kind]
    if name.endswith(".toml"):
        raise RsbenchError(f"{name}: say of which kind it is: --kind {'|'.join(kinds)}")
    names = {each: names_of(each) for each in kinds}
    found = [each for each in kinds if current_name(each, name) in names[each]]
    if not found:
        everything = sorted({one for each in names.values() for one in each})
        raise RsbenchError(f"{name!r} does not exist{choices(name, everything)}")
    return found


def _about(name: str, kind: str) -> dict[str, Any]:
    """All that can be said of one component or card."""
    from rsbench.cli.component_kinds import component_kind
    from rsbench.components import plugins
    from rsbench.components.cards import FORMER_NAMES, card_path, read_toml
    from rsbench.components.parameters import parameters_of

    described = component_kind(kind)
    if described is None:
        path = card_path(kind, name)  # pyrefly: ignore[bad-argument-type]
        return {"kind": kind, "name": path.stem, "card": path.as_posix(), "content": read_toml(path)}
    if described.cards is None:
        return {"kind": kind, "name": name, **_about_class(described, name)}
    entry = plugins.load_entry(described, name)
    return {
        "kind": kind,
        "name": entry.name,
        "formerly": sorted(former for former, now in FORMER_NAMES.get(kind, {}).items() if now == entry.name),
        "description": entry.description,
        "origin": _origin(described, entry.name) if entry.path is None else None,
        "card": entry.path.as_posix() if entry.path is not None else None,
        **_about_component(entry.component),
        **{key: value for key, value in vars(entry.options).items()},
        "key": entry.key,
        "parameters": parameters_of(type(entry.component), entry.component),
    }


def _about_component(component: object) -> dict[str, Any]:
    """Its class, and what it declares in its ``spec``."""
    import dataclasses

    cls = type(component)
    about: dict[str, Any] = {"class": f"{cls.__module__}:{cls.__qualname__}"}
    spec = getattr(component, "spec", None)
    if dataclasses.is_dataclass(spec):
        about |= {field.name: _plain(getattr(spec, field.name)) for field in dataclasses.fields(spec)}
    return about


def _plain(value: object) -> object:
    """Values of a spec, as JSON has them."""
    from collections.abc import Mapping, Set

    if isinstance(value, Mapping):
        return dict(value)
    return sorted(value) if isinstance(value, Set) else value


def _about_class(kind: Kind[Any, Any], name: str) -> dict[str, Any]:
    """A class that no card describes: other cards name it, and set its parameters."""
    from rsbench.components import plugins
    from rsbench.components.parameters import parameters_of

    cls = plugins.load_class(kind, name, Path())
    return {
        "description": plugins.description_of(kind, _offer(kind, name)),
        "origin": _origin(kind, name),
        "class": f"{cls.__module__}:{cls.__qualname__}",
        "parameters": parameters_of(cls),
    }


def _offer(kind: Kind[Any, Any], name: str) -> Offer:
    from rsbench.components import plugins

    return next(offer for offer in plugins.offers(kind) if offer.name == name)


def _origin(kind: Kind[Any, Any], name: str) -> str:
    return _offer(kind, name).origin


def register(app: typer.Typer) -> None:
    app.command(epilog=EPILOG)(show)
