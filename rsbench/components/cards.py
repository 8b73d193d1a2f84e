"""Cards: TOML files that users read, copy, edit and compare, parsed into frozen dataclasses.

A card is given by name (``castle``, a card that comes with rsbench) or by path (``my/castle.toml``). Parsing is
strict: unknown keys, wrong types and numbers that are not finite raise a one-line error with the file, the field,
the value and the allowed values. In several kinds of cards, the key ``shutter`` names a shutter card with the
readout time of a camera.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import json
import math
import os
import tomllib
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError

from rsbench.core.errors import RsbenchError, naming
from rsbench.storage.untrusted_files import CARD_BYTES, read_text

T = TypeVar("T")
CardKind = Literal[
    "scenes",
    "renderers",
    "solvers",
    "datasets",
    "sweeps",
    "matchers",
    "features",
    "correctors",
    "metrics",
    "shutters",
    "rigs",
]

FORMER_NAMES: Mapping[str, Mapping[str, str]] = {"solvers": {"rs-stereo": "rs-stereo-refined"}}
"""Former names by kind, which commands and files may still use, with the present name; no list shows them."""

FORMER_UNTIL = "release 1.1"
"""The first release that does not read former names; until then they give a warning."""

Extra = Literal["forbid", "ignore"]
_LONGEST = 100
"""Characters of a value in a message."""
_DEEPEST = 64
"""Levels of tables and arrays."""
_UNKNOWN_KEY = ("unexpected_keyword_argument", "extra_forbidden")


def list_cards(kind: CardKind) -> dict[str, Path]:
    """Names of the cards of one kind that come with rsbench, sorted, with their files."""
    return {path.stem: path for path in sorted(_card_folder(kind).glob("*.toml"), key=lambda path: path.stem)}


def current_name(kind: str | None, name: str) -> str:
    """Return the present name of a component or card, given its present or former name."""
    return FORMER_NAMES.get(kind or "", {}).get(name, name)


def name_of_today(kind: str | None, name: str) -> str:
    """Return ``current_name`` of a name given by a user, with a warning if it is a former name."""
    now = current_name(kind, name)
    if now != name:
        text = f"{kind}: {name!r} is now called {now!r}; the old name is read until {FORMER_UNTIL}"
        warnings.warn(text, FutureWarning, stacklevel=3)
    return now


def card_path(kind: CardKind, name_or_path: str | Path) -> Path:
    """File of a card: a value with a separator or ending in ``.toml`` is a path, anything else a name.

    Raises:
        RsbenchError: no such file, or no card of that name.
    """
    value = os.fspath(name_or_path)
    if value.endswith(".toml") or "/" in value or os.sep in value:
        path = Path(value)
        if not os.path.isfile(path) and path == Path(kind, path.name):  # the folder of this kind in 0.1
            path = list_cards(kind).get(name_of_today(kind, path.stem), path)
        if not os.path.isfile(path):  # False, not an error, for a name that is too long
            raise RsbenchError(f"{kind} card {value}: no such file")
        return path
    cards, name = list_cards(kind), name_of_today(kind, value)
    if name not in cards:
        raise RsbenchError(f"{kind} card {value!r} does not exist{choices(value, cards)}; a path ends in .toml")
    return cards[name]


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
    text = read_text(path, CARD_BYTES)
    try:
        return tomllib.loads(text)
    except ValueError as error:  # not TOML, or a number of thousands of digits
        raise RsbenchError(f"{path}: not valid TOML: {error}") from error
    except RecursionError as error:
        raise RsbenchError(f"{path}: not valid TOML: nested too deeply") from error


def parse_card(cls: type[T], data: Mapping[str, Any], where: str, *, extra: Extra = "forbid") -> T:
    """Convert the tables of a card, or data from JSON, to the dataclass ``cls``.

    Types are strict: text or a bool is not accepted as a number, but an integer is accepted as a float. Numbers
    must be finite, and unknown keys raise an error at every level of nesting. A ``ValueError`` or ``RsbenchError``
    from a ``__post_init__`` becomes part of the one-line message.

    Args:
        cls: a dataclass whose fields are scalars, ``Literal``s, tuples, dicts and further dataclasses.
        data: result of ``tomllib`` or ``json``.
        where: the file, for messages.
        extra: "ignore" skips unknown keys, as is needed to read files of later versions.

    Raises:
        RsbenchError: one line with ``where``, the dotted field, the value and what is allowed.
    """
    card: tuple[T]
    check_values(data, where)
    try:
        # Strict JSON validation reads arrays as tuples and tables as dataclasses, as TOML means them.
        card = _adapter(cls, extra).validate_json(json.dumps([data], default=str))
    except ValidationError as error:
        raise RsbenchError(f"{where}: {_first_problem(cls, error)}") from None
    except RsbenchError as error:
        raise RsbenchError(f"{where}: {error}") from error
    return card[0]


@functools.lru_cache(maxsize=64)
def _adapter(cls: type, extra: Extra) -> TypeAdapter[Any]:
    """Return pydantic's adapter for a dataclass, cached because creating it takes a hundred times as long as using
    it.

    pydantic accepts no configuration for a standard dataclass itself, but that of a containing tuple applies to
    it.
    """
    config = ConfigDict(extra=extra, strict=True, allow_inf_nan=False)
    return TypeAdapter(tuple[cls], config=config)


def check_values(data: Mapping[str, Any], where: str) -> None:
    """Reject numbers that are not finite, at any depth, and data that are nested too deeply.

    Fields of type ``Any`` would accept both.

    Raises:
        RsbenchError: one line with ``where`` and the dotted field.
    """
    todo: list[tuple[Any, tuple[object, ...]]] = [(data, ())]
    while todo:
        values, keys = todo.pop()
        if len(keys) > _DEEPEST:
            raise RsbenchError(
                f"{where}: {'.'.join(map(str, keys[:3]))}...: nested more than {_DEEPEST} levels deep"
            )
        for key, value in values.items() if isinstance(values, Mapping) else enumerate(values):
            if isinstance(value, (Mapping, list, tuple)):
                todo.append((value, (*keys, key)))
            elif isinstance(value, float) and not math.isfinite(value):
                field = ".".join(map(str, (*keys, key)))
                raise RsbenchError(f"{where}: {field} = {value}: numbers must be finite")


_LISTED, _COMPARED = 10, 100
"""Largest number of names in a message, and number of characters of a wrong name used to find similar ones."""


def choices(value: str, names: Iterable[str]) -> str:
    """Return the end of a message about an unknown name: the most similar name and up to ten known ones."""
    known, value = sorted(names), value[:_COMPARED]
    near = difflib.get_close_matches(value, known, n=1)
    hint = f" (did you mean {near[0]!r}?)" if near else ""
    listed = (
        known if len(known) <= _LISTED else sorted(difflib.get_close_matches(value, known, n=_LISTED, cutoff=0.0))
    )
    more = f" and {len(known) - len(listed)} more" if len(known) > len(listed) else ""
    return f"{hint}; there are: {', '.join(listed) or 'none'}{more}"


def shipped_folder(in_checkout: str, in_wheel: str) -> Path:
    """Return a folder that comes with rsbench, in a checkout or in the package data of a wheel."""
    package = Path(str(resources.files("rsbench")))
    checkout = package.parent
    return checkout / in_checkout if (checkout / "pyproject.toml").is_file() else package / in_wheel


def _card_folder(kind: CardKind) -> Path:
    folder = kind if kind in ("scenes", "renderers", "solvers") else f"cards/{kind}"
    return shipped_folder(folder, f"_cards/{kind}")


def _first_problem(cls: type, error: ValidationError) -> str:
    """Describe the first problem; unknown keys first, since a misspelt key also causes 'required' ones."""
    problems = error.errors(include_url=False)
    problem = next((item for item in problems if item["type"] in _UNKNOWN_KEY), problems[0])
    location = problem["loc"][1:]
    field = ".".join(str(part) for part in location)
    if problem["type"] in _UNKNOWN_KEY:
        key, keys = str(location[-1]), _keys_at(cls, location[:-1])
        hint = choices(key, keys)
        if "parameters" in keys and "did you mean" not in hint:
            hint = f" (did you mean parameters = {{ {key} = ... }}?){hint}"
        return f"unknown key {field!r}{hint}"
    if problem["type"].startswith("missing"):
        return f"{field!r} is required"
    message = problem["msg"].removeprefix("Value error, ")
    if not field:
        return message
    whole = problem["type"] == "value_error" and isinstance(problem["input"], dict)
    value = "" if whole else f" = {_short(problem['input'])}"
    return f"{field}{value}: {message[:1].lower()}{message[1:]}"


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def _keys_at(kind: Any, location: Sequence[int | str]) -> list[str]:
    """Return the field names of the dataclass at ``location`` below the type ``kind``."""
    if get_origin(kind) in (Union, UnionType):
        return [key for option in get_args(kind) for key in _keys_at(option, location)]
    if dataclasses.is_dataclass(kind):
        hints = get_type_hints(kind)
        if not location:
            own = [field.name for field in dataclasses.fields(kind) if field.init]
            return [*own, *getattr(kind, "SHORTHANDS", ())]
        if location[0] in hints:
            return _keys_at(hints[str(location[0])], location[1:])
        # A union adds the name of the option that was tried to the location.
        return _keys_at(kind, location[1:]) if location[0] == getattr(kind, "__name__", "") else []
    inner = [option for option in get_args(kind) if option is not Ellipsis]
    return _keys_at(inner[-1], location[1:]) if inner and location else []


SHUTTER_KEY = {
    "shutter": "Name of a shutter card or a path to one, in place of ``readout_ratio``: the readout time of a "
    "real camera's mode over the frame period, which is the mode's unless ``frame_period_s`` is given."
}
"""A shorthand of tables in which ``with_shutter`` replaces the key."""


@dataclass(frozen=True, kw_only=True)
class ShutterCard:
    """One mode of one camera; rows are read from the top, evenly."""

    description: str
    """Camera and mode, for ``rsbench list shutters``."""
    readout_ms: float
    """Milliseconds from the first row to the (missing) row after the last one."""
    fps: float
    """Frames per second of the mode."""
    width: int
    """Width of the mode's frames, px; the readout time applies to these, whatever the size of the images that
    use this card."""
    height: int
    """Height of the mode's frames, px."""
    source: str
    """Where the readout time comes from."""

    def __post_init__(self) -> None:
        for name in ("readout_ms", "fps", "width", "height"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} = {getattr(self, name)}: must be positive")
        if self.readout_ms > self.frame_period_ms * (1 + 1e-9):
            raise ValueError(f"readout_ms = {self.readout_ms}: longer than a frame period, 1 / fps")

    @property
    def frame_period_ms(self) -> float:
        """Milliseconds from one frame to the next."""
        return 1e3 / self.fps


def with_shutter(table: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Replace ``shutter = NAME`` in a table of a card by ``readout_ratio`` and, unless given, ``frame_period_s``.

    Raises:
        RsbenchError: the shutter does not exist, a readout ratio is given too, or the frame period is shorter than
            the readout.
    """
    if "shutter" not in table:
        return dict(table)
    name, left = table["shutter"], {key: value for key, value in table.items() if key != "shutter"}
    if not isinstance(name, str):
        raise RsbenchError(f"{where}: shutter = {name!r}: must be a name (rsbench list shutters) or a path")
    if "readout_ratio" in left:
        raise RsbenchError(f"{where}: shutter and readout_ratio exclude each other; leave one out")
    with naming(f"{where}: shutter", RsbenchError):
        shutter = load_card(ShutterCard, "shutters", name)
    period = left.setdefault("frame_period_s", 1.0 / shutter.fps)
    readout = 1e-3 * shutter.readout_ms
    if isinstance(period, int | float) and 0.0 < period < readout * (1 - 1e-9):
        raise RsbenchError(
            f"{where}: frame_period_s = {period}: {name} reads a frame for {readout:.6g} s; leave frame_period_s "
            "out or give at least that"
        )
    if isinstance(period, int | float) and period > 0.0:
        left["readout_ratio"] = min(readout / period, 1.0)
    return left


def with_shutters(card: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Replace every ``shutter`` in a dataset's card; raise RsbenchError like ``with_shutter``."""
    return in_all_tables(card, lambda table: with_shutter(table, where))


def in_all_tables(
    card: Mapping[str, Any], change: Callable[[Mapping[str, Any]], dict[str, Any]]
) -> dict[str, Any]:
    """Apply a change to a dataset's card: to its own table, to those of its sequences and to values of its grid.

    Values of wrong types are left unchanged, so that the parser reports them.
    """

    def replaced(value: Any) -> Any:
        return change(value) if isinstance(value, dict) else value

    def values(axis: Any) -> Any:
        return {key: replaced(value) for key, value in axis.items()} if isinstance(axis, dict) else axis

    made = change(card)
    if isinstance(sequences := made.get("sequence"), list):
        made["sequence"] = [replaced(sequence) for sequence in sequences]
    if isinstance(grid := made.get("grid"), dict):
        made["grid"] = {name: values(axis) for name, axis in grid.items()}
    return made
