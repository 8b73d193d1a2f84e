"""``rsbench list`` and ``rsbench show``: names of components and cards, their kinds, and completion in a shell."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import functools
import inspect
import itertools
import textwrap
from collections.abc import Callable, Mapping, Set
from importlib import import_module, metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from rsbench.cli.console import print_json, print_rows, say
from rsbench.core.errors import RsbenchError

if TYPE_CHECKING:
    from rsbench.components.plugins import Kind, Offer

COMPONENTS = {
    "solvers": "rsbench.solvers.engine.base:SOLVERS",
    "builders": "rsbench.scenes.load:BUILDERS",
    "motions": "rsbench.components.motion_models:MOTIONS",
    "matchers": "rsbench.vision.stereo_matcher:STEREO_MATCHERS",
    "features": "rsbench.vision.feature_matcher:FEATURE_MATCHERS",
    "correctors": "rsbench.vision.corrector:CORRECTORS",
    "metrics": "rsbench.benchmark.scoring:METRICS",
}
"""Kinds with names from installed packages too, and the location of their ``plugins.Kind``."""


_GROUPS = {"builders": "rsbench.scenes"}
"""Groups of entry points, for kinds whose group is not ``rsbench.KIND``."""


def kind_names() -> list[str]:
    """Return all kinds, sorted: kinds of cards, and kinds of components without cards."""
    from rsbench.components.cards import CardKind

    return sorted({*get_args(CardKind), *COMPONENTS})


def component_kind(kind: str) -> Any:
    """Return the ``plugins.Kind`` of a kind; None for kinds whose cards name no class."""
    if kind not in COMPONENTS:
        return None

    module, _, name = COMPONENTS[kind].partition(":")
    return getattr(import_module(module), name)


def names_of(kind: str) -> list[str]:
    """Return the names of one kind, sorted."""
    from rsbench.components import plugins
    from rsbench.components.cards import list_cards

    described = component_kind(kind)
    return plugins.list_names(described) if described is not None else list(list_cards(kind))  # pyrefly: ignore[bad-argument-type]


def complete(kind: str = "") -> Callable[[str], list[str]]:
    """Return a shell completion for names of one kind, or of all; to be fast, it imports no components."""

    def names(incomplete: str) -> list[str]:
        found = {name for each in ([kind] if kind else kind_names()) for name in _quick_names(each)}
        return sorted(name for name in found if name.startswith(incomplete))

    return names


def named(kind: str, text: str, *names: str) -> Any:
    """Return an option for a name of one kind or a path; ``text`` is its help, ``names`` are its own names."""
    return typer.Option(*names, help=text, autocompletion=complete(kind))


def complete_kind(incomplete: str) -> list[str]:
    """Return the kinds that begin with ``incomplete``, for shell completion."""
    return [name for name in kind_names() if name.startswith(incomplete)]


def _quick_names(kind: str) -> set[str]:
    """Return names of one kind without importing components; rsbench's classes without a card are left out."""
    from rsbench.components.cards import CardKind, list_cards

    names = set(list_cards(kind)) if kind in get_args(CardKind) else set()  # pyrefly: ignore[bad-argument-type]
    if kind in COMPONENTS:
        # Unreadable metadata of a package are reported by ``rsbench list``.
        with contextlib.suppress(Exception):
            group = _GROUPS.get(kind, f"rsbench.{kind}")
            names |= {point.name for point in metadata.entry_points(group=group)}
    return names


LIST_EPILOG = """[bold]Examples[/bold]

  rsbench list                    [dim](the kinds)[/dim]

  rsbench list solvers

  rsbench list scenes --json"""


def list_(
    kind: Annotated[
        str | None, typer.Argument(help="What to list; without it, the kinds.", autocompletion=complete_kind)
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print a JSON list.")] = False,
) -> None:
    """List scenes, solvers, datasets and so on, with the cards to copy and edit, and who they come from."""
    from rsbench.components.cards import choices

    kinds = kind_names()
    if kind is not None and kind not in kinds:
        raise RsbenchError(f"kind {kind!r} does not exist{choices(kind, kinds)}")
    rows = entries(kind) if kind else [{"kind": each, "names": names_of(each)} for each in kinds]
    if json:
        print_json(rows)
        return
    columns = ("kind", "names") if kind is None else ("name", "origin", "description")
    texts = [[row[column] for column in columns] for row in rows]
    print_rows(
        kind or "kinds", columns, [[", ".join(x) if isinstance(x, list) else x for x in row] for row in texts]
    )
    if kind is None:
        say("rsbench list KIND lists them; rsbench show NAME prints one")
    elif cards := [row["card"] for row in rows if row["card"]]:
        folder = cards[0].rpartition("/")[0]
        say(f"cards: {folder}; copy one, edit it, and pass its path (ending in .toml) instead of a name")


def entries(kind: str) -> list[dict[str, Any]]:
    """Return name, origin, description, card and error for all names of one kind.

    Components of installed packages are loaded to test whether they work; an error affects only its own entry.
    """
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


SHOW_EPILOG = """[bold]Examples[/bold]

  rsbench show rs-stereo-refined

  rsbench show castle --kind builders

  rsbench show ./my-solver.toml --kind solvers --json"""


def show(
    name: Annotated[
        str,
        typer.Argument(metavar="NAME|CARD", help="Name, or path of a card.", autocompletion=complete()),
    ],
    kind: Annotated[
        str | None,
        typer.Option(
            help="Kind (see rsbench list), if several kinds have this name.", autocompletion=complete_kind
        ),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Print what a solver needs and returns, the parameters of a component with defaults, or a card."""
    found = [_about(name, each) for each in _kinds_of(name, kind)]
    if json:
        print_json(found[0] if len(found) == 1 else found, default=str)
        return
    for content in found:
        _print(content)


def _print(about: dict[str, Any]) -> None:
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
    """Return the kinds that have a component or card of this name, or the given kind."""
    from rsbench.components.cards import choices, current_name

    kinds = kind_names()
    if kind is not None:
        if kind not in kinds:
            raise RsbenchError(f"--kind {kind!r} does not exist{choices(kind, kinds)}")
        return [kind]
    if name.endswith((".toml", ".py")) or ".py:" in name:
        raise RsbenchError(f"{name}: give its kind: --kind {'|'.join(kinds)}")
    if Path(name).is_dir():
        raise RsbenchError(f"{name}: is a folder, and show takes names and cards; a dataset: rsbench view {name}")
    names = {each: names_of(each) for each in kinds}
    found = [each for each in kinds if current_name(each, name) in names[each]]
    if not found:
        everything = sorted({one for each in names.values() for one in each})
        raise RsbenchError(f"{name!r} does not exist{choices(name, everything)}")
    return found


def _about(name: str, kind: str) -> dict[str, Any]:
    """Return all properties of one component or card."""
    from rsbench.components import plugins
    from rsbench.components.cards import FORMER_NAMES, card_path, read_toml

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
        "origin": _offer(described, entry.name).origin if entry.path is None else None,
        "card": entry.path.as_posix() if entry.path is not None else None,
        **_about_component(entry.component),
        **vars(entry.options),
        "key": entry.key,
        "parameters": parameters_of(type(entry.component), entry.component),
    }


def _about_component(component: object) -> dict[str, Any]:
    """Return the class of a component and the fields of its ``spec``, as values for JSON."""
    cls = type(component)
    about: dict[str, Any] = {"class": f"{cls.__module__}:{cls.__qualname__}"}
    spec = getattr(component, "spec", None)
    for field in dataclasses.fields(spec) if dataclasses.is_dataclass(spec) else ():
        value = getattr(spec, field.name)
        if isinstance(value, Set):
            value = sorted(value)
        about[field.name] = dict(value) if isinstance(value, Mapping) else value
    return about


def _offer(kind: Kind[Any, Any], name: str) -> Offer:
    from rsbench.components import plugins

    return next(offer for offer in plugins.offers(kind) if offer.name == name)


def _about_class(kind: Kind[Any, Any], name: str) -> dict[str, Any]:
    """Describe a class that has no card itself; other cards name it and set its parameters."""
    from rsbench.components import plugins

    cls, offer = plugins.load_class(kind, name, Path()), _offer(kind, name)
    return {
        "description": plugins.description_of(kind, offer),
        "origin": offer.origin,
        "class": f"{cls.__module__}:{cls.__qualname__}",
        "parameters": parameters_of(cls),
    }


def parameters_of(cls: type, component: object = None) -> list[dict[str, Any]]:
    """Return the parameters of a component's class, in the order of its constructor.

    Args:
        cls: a dataclass, whose fields have docstrings below them, or any class.
        component: an instance of it, for the values.

    Returns:
        ``parameter``, ``type``, ``default``, ``value`` (as in a card, or "") and ``meaning`` of each parameter.
    """
    meanings = field_docstrings(cls)
    required = inspect.Parameter.empty
    fields = dataclasses.fields(cls) if dataclasses.is_dataclass(cls) else ()
    factories = {each.name: each.default_factory for each in fields}
    rows = []
    for name, parameter in inspect.signature(cls).parameters.items():
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            continue
        kind, make = parameter.annotation, factories.get(name, dataclasses.MISSING)
        default = parameter.default if make is dataclasses.MISSING else make()
        kind = "" if kind is required else kind if isinstance(kind, str) else getattr(kind, "__name__", str(kind))
        rows.append(
            {
                "parameter": name,
                "type": kind,
                "value": value_in_a_card(getattr(component, name)) if hasattr(component, name) else "",
                "default": "required" if default is required else value_in_a_card(default),
                "meaning": meanings.get(name, ""),
            }
        )
    return rows


def value_in_a_card(value: object) -> Any:
    """Convert a value to its form in a card; None, which a card cannot contain, becomes empty text."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: value_in_a_card(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, (list, tuple)):
        return [value_in_a_card(item) for item in value]
    if isinstance(value, dict):
        return {key: value_in_a_card(item) for key, item in value.items()}
    return value if isinstance(value, bool | int | float | str) else "" if value is None else str(value)


def field_docstrings(cls: type) -> dict[str, str]:
    """Return the docstrings below the fields of a class and its base classes, each in one line, by field."""
    return {name: text for parent in reversed(cls.__mro__[:-1]) for name, text in _own_docstrings(parent)}


@functools.cache
def _own_docstrings(cls: type) -> tuple[tuple[str, str], ...]:
    """Return names and docstrings of a class's own fields; cached, since finding the source takes up to 0.1 s."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]
    except (OSError, TypeError, SyntaxError, IndexError):  # defined in a shell, or without source
        return ()
    found = []
    for field, text in itertools.pairwise(tree.body) if isinstance(tree, ast.ClassDef) else ():
        match field, text:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(words))):
                found.append((name, " ".join(words.split())))
    return tuple(found)
