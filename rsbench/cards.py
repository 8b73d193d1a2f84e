"""Cards: the TOML files that users read, copy, edit and compare, parsed into frozen dataclasses.

A card is named (``castle``), and looked up among the cards that come with rsbench, or is a path
(``my/castle.toml``). Parsing is strict: unknown keys, wrong types and numbers that are not finite are refused
in one line that names the file, the field, the value and what is allowed.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import json
import math
import os
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError

from rsbench.errors import RsbenchError

T = TypeVar("T")
CardKind = Literal[
    "scenes", "renderers", "solvers", "datasets", "sweeps", "matchers", "features", "correctors", "metrics"
]

_CONFIG = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
_UNKNOWN_KEY = ("unexpected_keyword_argument", "extra_forbidden")


def list_cards(kind: CardKind) -> dict[str, Path]:
    """Names of the cards of one kind that come with rsbench, sorted, with their files."""
    return {path.stem: path for path in sorted(_card_folder(kind).glob("*.toml"), key=lambda path: path.stem)}


def card_path(kind: CardKind, name_or_path: str | Path) -> Path:
    """File of a card: a value with a separator or ending in ``.toml`` is a path, anything else a name.

    Raises:
        RsbenchError: no such file, or no card of that name.
    """
    value = os.fspath(name_or_path)
    if value.endswith(".toml") or "/" in value or os.sep in value:
        path = Path(value)
        if not path.is_file():
            raise RsbenchError(f"{kind} card {value}: no such file")
        return path
    cards = list_cards(kind)
    if value not in cards:
        raise RsbenchError(f"{kind} card {value!r} does not exist{choices(value, cards)}; a path ends in .toml")
    return cards[value]


def load_card(cls: type[T], kind: CardKind, name_or_path: str | Path) -> T:
    """Find, read and parse a card into the dataclass ``cls``.

    Raises:
        RsbenchError: see ``card_path``, ``read_toml`` and ``parse_card``.
    """
    path = card_path(kind, name_or_path)
    return parse_card(cls, read_toml(path), str(path))


def read_toml(path: Path) -> dict[str, Any]:
    """Content of a TOML file.

    Raises:
        RsbenchError: the file cannot be read, or is not TOML (with the line and column).
    """
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8"))
    except OSError as error:
        raise RsbenchError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RsbenchError(f"{path}: not valid TOML: {error}") from error


def parse_card(cls: type[T], data: Mapping[str, Any], where: str) -> T:
    """Turn the tables of a card into the dataclass ``cls``.

    Types are strict (no text for a number, no truth value for a number; a whole number may stand for a real
    one), numbers are finite, and a key that no field has is refused at every level of nesting. A
    ``ValueError`` or ``RsbenchError`` from a ``__post_init__`` becomes part of the one-line message.

    Args:
        cls: a dataclass whose fields are scalars, ``Literal``s, tuples, dicts and further dataclasses.
        data: what ``tomllib`` read.
        where: the file, for messages.

    Raises:
        RsbenchError: one line with ``where``, the dotted field, the value and what is allowed.
    """
    card: tuple[T]
    check_finite(data, where)
    try:
        # Strict JSON validation reads arrays as tuples and tables as dataclasses, as TOML means them.
        card = _adapter(cls).validate_json(json.dumps([data], default=str))  # type: ignore[arg-type]
    except ValidationError as error:
        raise RsbenchError(f"{where}: {_first_problem(cls, error)}") from None
    except RsbenchError as error:
        raise RsbenchError(f"{where}: {error}") from error
    return card[0]


@functools.lru_cache(maxsize=64)
def _adapter(cls: type) -> TypeAdapter[Any]:
    """Kept, for it takes a hundred times as long to make as to use.

    pydantic takes no settings for a standard dataclass itself, but hands those of a container down to it.
    """
    return TypeAdapter(tuple[cls], config=_CONFIG)  # type: ignore[valid-type]


def check_finite(data: Mapping[str, Any], where: str) -> None:
    """Refuse numbers that are not finite, however deep they lie.

    Raises:
        RsbenchError: one line with ``where`` and the dotted field.
    """
    stray = next(_not_finite(data), None)
    if stray is not None:
        raise RsbenchError(f"{where}: {stray}: numbers must be finite")


def choices(value: str, names: Iterable[str]) -> str:
    """End of a message about an unknown name: the nearest name, then the names that exist."""
    known = sorted(names)
    near = difflib.get_close_matches(value, known, n=1)
    hint = f" (did you mean {near[0]!r}?)" if near else ""
    return f"{hint}; there are: {', '.join(known) or 'none'}"


def shipped_folder(in_checkout: str, in_wheel: str) -> Path:
    """A folder that comes with rsbench: below the top of a checkout, or in the package data of a wheel."""
    package = Path(str(resources.files("rsbench")))
    checkout = package.parent
    return checkout / in_checkout if (checkout / "pyproject.toml").is_file() else package / in_wheel


def _card_folder(kind: CardKind) -> Path:
    return shipped_folder(kind, f"_cards/{kind}")


def _not_finite(value: Any, field: str = "") -> Iterator[str]:
    """Fields that are not finite; fields typed ``Any`` would let them pass."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _not_finite(item, f"{field}.{key}" if field else str(key))
    elif isinstance(value, list | tuple):
        for number, item in enumerate(value):
            yield from _not_finite(item, f"{field}.{number}")
    elif isinstance(value, float) and not math.isfinite(value):
        yield f"{field} = {value}"


def _first_problem(cls: type, error: ValidationError) -> str:
    """One problem of many; a misspelt key first, for it also causes the 'required' ones."""
    problems = error.errors(include_url=False)
    problem = next((item for item in problems if item["type"] in _UNKNOWN_KEY), problems[0])
    location = problem["loc"][1:]
    field = ".".join(str(part) for part in location)
    if problem["type"] in _UNKNOWN_KEY:
        return f"unknown key {field!r}{choices(str(location[-1]), _keys_at(cls, location[:-1]))}"
    if problem["type"].startswith("missing"):
        return f"{field!r} is required"
    message = problem["msg"].removeprefix("Value error, ")
    if not field:
        return message
    return f"{field} = {problem['input']!r}: {message[:1].lower()}{message[1:]}"


def _keys_at(kind: Any, location: Sequence[int | str]) -> list[str]:
    """Field names of the dataclass found by walking ``location`` down from the type ``kind``."""
    if get_origin(kind) in (Union, UnionType):
        return [key for option in get_args(kind) for key in _keys_at(option, location)]
    if dataclasses.is_dataclass(kind):
        hints = get_type_hints(kind)
        if not location:
            return [field.name for field in dataclasses.fields(kind) if field.init]
        if location[0] in hints:
            return _keys_at(hints[str(location[0])], location[1:])
        # A union adds the name of the option that was tried to the location.
        return _keys_at(kind, location[1:]) if location[0] == getattr(kind, "__name__", "") else []
    inner = [option for option in get_args(kind) if option is not Ellipsis]
    return _keys_at(inner[-1], location[1:]) if inner and location else []
