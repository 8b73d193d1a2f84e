"""``make reference``: docs/reference/commands.md and cards.md, from the commands and the dataclasses of cards.

The docstring below a field of a card's dataclass is the only description of its key.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from rsbench.cli.names import field_docstrings, value_in_a_card

_WORDS = {int: "integer", float: "number", str: "text", bool: "true or false", Any: "values"}


@dataclass(frozen=True, kw_only=True)
class CardKey:
    """One key of a table of a card."""

    name: str
    type: str
    """In words, such as ``list of numbers``; of a table the name of its dataclass."""
    default: str
    """As a card writes it; ``required``; or empty where the key may be absent."""
    meaning: str
    tables: tuple[type, ...]
    """Dataclasses of the tables that it holds."""


def keys_of(cls: type) -> list[CardKey]:
    """The keys of a card or table, in the order of the fields of its dataclass, shorthands last."""
    meanings, hints = field_docstrings(cls), get_type_hints(cls)
    rows = [
        CardKey(
            name=field.name.rstrip("_"),  # class_, for class is a word of Python's own
            type=type_words(hints[field.name]),
            default=_card_default(field),
            meaning=meanings.get(field.name, ""),
            tables=tables_in(hints[field.name]),
        )
        for field in dataclasses.fields(cls)
        if field.init
    ]
    shorthands: Mapping[str, str] = getattr(cls, "SHORTHANDS", {})
    return rows + [
        CardKey(name=name, type="text", default="", meaning=meaning, tables=())
        for name, meaning in shorthands.items()
    ]


def all_tables(cls: type) -> list[type]:
    """A card's dataclass and those of the tables below it, each once, from the top."""
    found = [cls]
    for table in found:
        found += [inner for key in keys_of(table) for inner in key.tables if inner not in found]
    return list(dict.fromkeys(found))


def tables_in(hint: Any) -> tuple[type, ...]:
    """The dataclasses inside a type."""
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return (hint,)
    return tuple(dict.fromkeys(table for part in get_args(hint) for table in tables_in(part)))


def type_words(hint: Any) -> str:
    """A type as people say what a card holds; the values of a ``Literal`` are those that are allowed."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Literal:
        return " or ".join(value_words(value) for value in parts)
    if origin in (Union, UnionType):
        return " or ".join(type_words(part) for part in parts if part is not type(None))
    if origin is tuple:
        if parts[-1] is Ellipsis:
            return f"list of {_plural(type_words(parts[0]))}"
        return f"{len(parts)} {_plural(type_words(parts[0]))}"
    if origin is dict:
        return f"table of {_plural(type_words(parts[1]))}"
    return _WORDS.get(hint) or getattr(hint, "__name__", str(hint))


def _plural(words: str) -> str:
    return f"{words}s" if words in ("number", "integer", "text", "list of numbers") else words


def value_words(value: Any) -> str:
    """A value as TOML writes it; tables with their keys left out."""
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(value_words(item) for item in value)}]"
    return "defaults" if isinstance(value, dict) else str(value)


def _card_default(field: dataclasses.Field[Any]) -> str:
    if field.default_factory is not dataclasses.MISSING:
        made = field.default_factory()
        return "" if made in ({}, (), []) else value_words(value_in_a_card(made))
    if field.default is dataclasses.MISSING:
        return "required"
    return "" if field.default is None or field.default == () else value_words(value_in_a_card(field.default))


_CODE = "https://github.com/rsbench/rsbench/blob/main/"
_BAR = "\\|"
"""In the cell of a table."""
_MADE = "<!-- Made from the code by `make reference`. Change the text there. -->\n"


def pages() -> dict[str, str]:
    """Text of each page by its path below ``docs``."""
    return {
        "reference/commands.md": "\n".join([_MADE, *_commands()]) + "\n",
        "reference/cards.md": "\n".join([_MADE, *_cards()]) + "\n",
        "reference/rigs.md": "\n".join([_MADE, *_rigs()]) + "\n",
    }


# Commands


def _commands() -> Iterator[str]:
    import typer

    from rsbench.cli.main import app

    yield "# Commands\n\nEvery command with all its options, as `rsbench COMMAND --help` prints them.\n"
    yield from _command(typer.main.get_command(app), "rsbench")


def _command(command: Any, path: str) -> Iterator[str]:
    if command.hidden:
        return
    yield f"## {path}\n"
    yield _escaped(command.help) + "\n"
    shown = [each for each in command.params if not getattr(each, "hidden", False)]
    arguments = [each for each in shown if each.param_type_name == "argument"]
    options = [each for each in shown if each.param_type_name == "option" and each.name != "help"]
    inner = getattr(command, "commands", {})
    words = [_usage(each) for each in arguments] + (["COMMAND"] if inner else [])
    yield f"```text\n{' '.join([path, *(['[OPTIONS]'] if options else []), *words])}\n```\n"
    if arguments:
        rows = [(f"`{_metavar(each)}`", _plain(each.help)) for each in arguments]
        yield _table(("argument", "meaning"), rows)
    if options:
        rows = [(_option(each), _default(each), _plain(each.help)) for each in options]
        yield _table(("option", "default", "meaning"), rows)
    yield from _epilog(command.epilog)
    for name, each in inner.items():
        yield from _command(each, f"{path} {name}")


def _usage(argument: Any) -> str:
    word = _metavar(argument).replace(_BAR, "|") + ("..." if argument.nargs == -1 else "")
    return word if argument.required else f"[{word}]"


def _metavar(parameter: Any) -> str:
    return (parameter.metavar or parameter.name.upper()).replace("|", _BAR)


def _option(option: Any) -> str:
    """Its names, and the kind of its value."""
    names = ", ".join(f"`{name}`" for name in [*option.opts, *option.secondary_opts])
    if option.is_flag:
        return names
    kind = option.type_descriptor.annotation
    choices = [each.value for each in kind] if hasattr(kind, "__members__") else []
    return f"{names} `{(option.metavar or '|'.join(choices) or _value_word(kind)).replace('|', _BAR)}`"


def _value_word(kind: Any) -> str:
    name = getattr(kind, "__name__", str(kind))
    words = {"int": "INTEGER", "float": "NUMBER", "Path": "PATH", "str": "TEXT"}
    return words.get(name) or next((word for key, word in words.items() if key in str(kind)), "VALUE")


def _default(option: Any) -> str:
    if option.required:
        return "required"
    value = getattr(option.default, "value", option.default)
    if option.is_flag:
        on, off = option.opts[0], (option.secondary_opts or [""])[0]
        return f"`{on}`" if value else f"`{off}`" if off else ""
    return "" if value in (None, "") else f"`{value.as_posix() if isinstance(value, Path) else value}`"


_INDENTED = re.compile(r"^  ", re.MULTILINE)


def _epilog(epilog: str | None) -> Iterator[str]:
    """Indented lines as code, remarks on them as comments; the rest as text."""
    code = list[str]()
    for part in (epilog or "").split("\n\n"):
        part = re.sub(
            r"\[dim\]\((.*?)\)\[/dim\]", lambda match: f"  # {_joined(match.group(1))}", part, flags=re.DOTALL
        )
        if part.startswith("  "):
            code += _INDENTED.sub("", _unmarked(part)).splitlines()
            continue
        yield from _fenced(code)
        code = list[str]()
        heading, _, rest = part.partition("[/bold]  ")  # [bold]Example[/bold]  rsbench doctor
        if rest and heading.startswith("[bold]Example"):
            code = [_unmarked(rest).strip()]
        elif not heading.startswith("[bold]Examples"):
            yield _escaped(part) + "\n"
    yield from _fenced(code)


def _fenced(code: Sequence[str]) -> Iterator[str]:
    if code:
        yield "\n".join([f"```{'toml' if ' = ' in code[0] else 'sh'}", *code, "```\n"])


def _joined(text: str) -> str:
    return " ".join(text.split())


def _unmarked(text: str) -> str:
    """A text without rich's styles; escaped brackets as they are."""
    return re.sub(r"(?<!\\)\[/?(bold|dim)\]", "", text).replace("\\[", "[")


def _escaped(text: str) -> str:
    """A help text as Markdown: bold words of it are commands, files or keys."""
    text = re.sub(r"(?<!\\)\[bold\](.*?)\[/bold\]", lambda match: f"`{match.group(1)}`", text.strip())
    return _wrapped(_unmarked(text))


def _plain(text: str | None) -> str:
    """One line for the cell of a table."""
    return _unmarked(_joined(text or "")).replace("``", "`").replace("|", _BAR)


def _wrapped(text: str) -> str:
    import textwrap

    parts = text.replace("``", "`").split("\n\n")
    return "\n\n".join(textwrap.fill(_joined(part), 100, break_long_words=False) for part in parts)


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


# Cards


def card_classes() -> dict[str, list[tuple[str, type]]]:
    """By kind of card: headings of its tables and the dataclasses that they are parsed into."""
    from rsbench.benchmark.leaderboard.track import Answer, Header
    from rsbench.benchmark.simulated.sweep_card import SweepCard
    from rsbench.cli.names import COMPONENTS, component_kind
    from rsbench.components.cards import ShutterCard
    from rsbench.components.plugins import CardContent
    from rsbench.components.rig_tables import RigTables
    from rsbench.dataset.card import DatasetCard
    from rsbench.pipeline.footage import OneCameraCard, RigCard
    from rsbench.renderers.options import RendererOptions
    from rsbench.scenes.load import SceneCard

    kinds: dict[str, list[tuple[str, type]]] = {
        "Dataset cards": [("", DatasetCard)],
        "Scene cards": [("", SceneCard)],
        "Renderer cards": [("", RendererOptions)],
        "Sweep cards": [("", SweepCard)],
        "Shutter cards": [("", ShutterCard)],
        "Rig cards": [("", RigTables)],
        "rig.toml": [("", RigCard)],
        "camera.toml": [("", OneCameraCard)],
        "Leaderboard predictions": [("First line", Header), ("Every other line", Answer)],
    }
    cards = [name for name in COMPONENTS if component_kind(name).cards is not None]
    components = [("", CardContent), *((f"Also of {name}", component_kind(name).options) for name in cards)]
    kinds["Component cards"] = [pair for pair in components if dataclasses.fields(pair[1])]
    return kinds


_ABOUT = {
    "Dataset cards": "Files in `cards/datasets/`, for `rsbench generate`.",
    "Scene cards": "Files in `scenes/`: a builder, its parameters, light and viewpoints.",
    "Renderer cards": "Files in `renderers/`.",
    "Sweep cards": "Files in `cards/sweeps/`, for `rsbench simulate`.",
    "Shutter cards": "Files in `cards/shutters/`: measured readout times of real cameras.",
    "Rig cards": "Files in `cards/rigs/`: [published calibrations](rigs.md) of two cameras.",
    "camera.toml": "The camera of frames for `rsbench correct --camera`; with `--frames` it may be absent.",
    "rig.toml": "The cameras of your own frames, for `rsbench correct` and `rsbench inspect`.",
    "Leaderboard predictions": "JSON lines, for `rsbench leaderboard submit`.",
    "Component cards": "Files in `solvers/`, `cards/matchers/`, `cards/features/`, `cards/correctors/` and "
    "`cards/metrics/`: a class and its parameters.",
}


@functools.cache
def component_classes() -> dict[str, dict[type, list[str]]]:
    """By kind of component: rsbench's own classes that have parameters, with the names that use them."""
    from rsbench.cli.names import COMPONENTS, component_kind
    from rsbench.components.plugins import load_class, load_entry, offers

    found: dict[str, dict[type, list[str]]] = {}
    for name in COMPONENTS:
        kind, classes = component_kind(name), dict[type, list[str]]()
        for offer in offers(kind):
            if offer.origin == "rsbench":
                made = type(load_entry(kind, offer.name).component) if kind.cards else load_class(kind, offer.name)
                if dataclasses.is_dataclass(made):
                    classes.setdefault(made, []).append(offer.name)
        found[name] = classes
    return found


def _cards() -> Iterator[str]:
    yield "# Cards\n"
    yield _wrapped(
        "Every key of every kind of card: a TOML file that you copy (`rsbench list KIND` says from where), edit "
        "and pass by its path, which ends in `.toml`. A key that is not listed is refused with the nearest name. "
        "Each table names the class that holds its values: find its uses in the code to see what a key changes."
    )
    yield ""
    for kind, tables in card_classes().items():
        yield f"## {kind}\n\n{_wrapped(_ABOUT[kind])}\n"
        yield from _card_tables(tables)
    inner = {cls: cls.__name__ for cls in _inner_tables()}
    for kind, classes in component_classes().items():
        yield f"## Parameters of {kind}\n"
        for cls, names in classes.items():
            yield from _keys(cls.__name__, cls, inner, names)
    yield "## Tables inside parameters\n"
    for cls, heading in inner.items():
        yield from _keys(heading, cls, inner)


def _card_tables(tables: Sequence[tuple[str, type]]) -> Iterator[str]:
    roots = {cls for _, cls in tables}
    for title, root in tables:
        headings = {cls: f"{root.__name__}: {cls.__name__}" for cls in all_tables(root) if cls not in roots}
        yield from _keys(title or root.__name__, root, headings)
        for cls, heading in headings.items():
            yield from _keys(heading, cls, headings)


def _keys(heading: str, cls: type, headings: Mapping[type, str], names: Sequence[str] = ()) -> Iterator[str]:
    """A table of keys below its heading; types that have one of the other headings link to it."""
    yield f"### {heading}\n"
    yield _about(cls, names) + "\n"
    rows = list[Sequence[str]]()
    for key in keys_of(cls):
        words = _plain(key.type)
        for table in key.tables:
            anchor = re.sub(r"[^a-z0-9_ -]", "", headings[table].lower()).replace(" ", "-")
            words = words.replace(table.__name__, f"[{table.__name__}](#{anchor})")
        rows.append((f"`{key.name}`", words, _coded(key.default), _plain(key.meaning)))
    if rows:
        yield _table(("key", "type", "default", "meaning"), rows)


def _coded(default: str) -> str:
    return f"`{default}`" if default not in ("", "required", "defaults") else default


def _inner_tables() -> list[type]:
    """Dataclasses of the tables that parameters of components hold."""
    classes = [cls for classes in component_classes().values() for cls in classes]
    inner = dict.fromkeys(table for cls in classes for table in all_tables(cls)[1:])
    return [cls for cls in inner if cls not in classes]


def _about(cls: type, names: Sequence[str]) -> str:
    """What a class is, where it lies, and which cards name it."""
    text = (inspect.getdoc(cls) or "").partition("\n\nRaises:")[0]
    more = text.partition("\n\n")[2] if hasattr(cls, "SHORTHANDS") else ""  # of cards; elsewhere for maintainers
    file = f"{cls.__module__.replace('.', '/')}.py"
    where = f"Class `{cls.__name__}` in\n[{file}]({_CODE}{file})"
    used = f", of\n{_wrapped(', '.join(f'`{name}`' for name in names))}" if names else ""
    return "\n\n".join(
        [_wrapped(part) for part in (text.partition("\n\n")[0], more) if part] + [f"{where}{used}."]
    )


# Rigs


def _rigs() -> Iterator[str]:
    """The cards of real rigs, with what they measure and assume, and their sources."""
    import textwrap

    import numpy as np

    from rsbench.components.cards import list_cards
    from rsbench.components.rig_tables import load_rig
    from rsbench.core import so3
    from rsbench.core.rig import SIDES

    text = """Published calibrations of two cameras, as cards in `cards/rigs/`: `rsbench list rigs` names them,
    `rsbench show NAME` prints one, `--rig NAME` and `rig = "NAME"` in a dataset card take one. Each was compared
    with its source through OpenCV. Copy the card that is nearest to your rig and put your numbers in. A readout is
    that of the whole image over the frame period, 0 for a global shutter."""
    yield f"# Real rigs\n\n{_wrapped(_joined(text))}\n"
    rows, notes = [], []
    for name, path in list_cards("rigs").items():
        card = load_rig(name)
        rig = card.rig()
        sizes, lenses, readouts = [], [], []
        assert card.scanning is not None and card.readout_ratio is not None
        shutter = rig.shutter_of(card.scanning, card.readout_ratio)
        for side in SIDES:
            camera = rig.sensor(side)
            sizes.append(f"{camera.width} x {camera.height}")
            lenses.append("none" if camera.lens is None else camera.lens.model)
            readouts.append(f"{shutter.ratio_of(side):.3g}")
        angle = np.degrees(np.linalg.norm(so3.log(rig.right_from_left.R)))
        both = [", ".join(dict.fromkeys(each)) for each in (sizes, lenses, readouts)]
        rows.append([f"[{name}](#{name})", *both, f"{1e3 * rig.baseline:.1f}", f"{angle:.2f}"])
        said = " ".join(line[1:] for line in path.read_text("utf-8").splitlines() if line.startswith("#"))
        paragraphs = [
            textwrap.fill(_joined(each), 100, break_long_words=False, break_on_hyphens=False)
            for each in (said, f"Source: {card.source}")
        ]
        notes.append("\n\n".join([f"## {name}", *paragraphs]) + "\n")
    columns = ("rig", "images, px", "lens", "readout", "baseline, mm", "between the cameras, deg")
    yield _table(columns, rows)
    yield from notes


def main() -> None:
    """Write the pages; the folder ``docs`` is that of the checkout, or the first argument."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "docs")
    for name, text in pages().items():
        (folder / name).write_text(text, "utf-8", newline="\n")


if __name__ == "__main__":
    main()
