"""Keys of cards, from the dataclasses that cards are parsed into: type, default, allowed values, description.

The docstring below a field is the only description of its key. Help, reference and messages are made from it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from rsbench.components.parameters import field_docstrings, value_in_a_card

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
            default=_default(field),
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


def _default(field: dataclasses.Field[Any]) -> str:
    if field.default_factory is not dataclasses.MISSING:
        made = field.default_factory()
        return "" if made in ({}, (), []) else value_words(value_in_a_card(made))
    if field.default is dataclasses.MISSING:
        return "required"
    return "" if field.default is None or field.default == () else value_words(value_in_a_card(field.default))
