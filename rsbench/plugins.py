"""Components by name: cards that come with rsbench, a user's card, or an installed package's entry point.

Every kind of component is found in the same way. A name is that of a card or of an entry point; a value that
ends in ``.toml`` is the path of a card. A card says ``class = "package.module:Class"``, may say ``description``,
sets ``parameters``, and may set the options of its kind. A name that two packages claim is an error of whoever
uses that name, and of nobody else.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib
import inspect
import json
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import metadata, resources
from pathlib import Path
from typing import Any, Generic, TypeVar

from rsbench.cards import CardKind, card_path, choices, list_cards, parse_card, read_toml
from rsbench.errors import RsbenchError

T = TypeVar("T")
Component = TypeVar("Component")
Options = TypeVar("Options")
_OWN = ("class", "description", "parameters")
_NUMERIC_ROOMS = ("core", "solvers", "robust", "vision", "pipeline")
"""Packages whose source decides what a component of ours answers."""


@dataclass(frozen=True, kw_only=True)
class Kind(Generic[Component, Options]):
    """One kind of component."""

    singular: str
    """Its name in messages, such as ``solver``."""
    cards: CardKind
    """Folder of its cards; its entry points are of the group ``rsbench.<folder>``."""
    base: type[Component]
    """Contract: what classes must be below of."""
    options: type[Options]
    """Dataclass of what a card may set beside the parameters; without values it must be valid."""

    @property
    def group(self) -> str:
        """Entry point group."""
        return f"rsbench.{self.cards}"


@dataclass(frozen=True, kw_only=True, eq=False)
class Entry(Generic[Component, Options]):
    """A component under the name by which tables, files and seeds know it."""

    name: str
    path: Path | None
    """Its card; None for an entry point."""
    description: str
    component: Component
    options: Options
    parameters: dict[str, Any] = field(default_factory=dict)
    """As the card gives them."""
    key: str
    """Hash of class, source, parameters and the components inside: equal keys give equal answers."""

    @property
    def built_in(self) -> bool:
        """Whether the class is rsbench's own, so that it may run in this process."""
        return type(self.component).__module__.partition(".")[0] == "rsbench"


@dataclass(frozen=True, kw_only=True)
class _Content:
    class_: str
    description: str = ""
    parameters: dict[str, Any] = field(default_factory=dict)


def list_names(kind: Kind[Any, Any]) -> list[str]:
    """Names of all components of a kind, sorted; a clash of names is not an error here."""
    return sorted({*list_cards(kind.cards), *_entry_points(kind)})


def load_entry(kind: Kind[Component, Options], name_or_path: str | Path) -> Entry[Component, Options]:
    """A component by the name of a card or entry point, or by the path of a card.

    Raises:
        RsbenchError: no such component, two of that name, or its card or class is wrong: one line that names
            the card or the entry point.
    """
    text = os.fspath(name_or_path)
    cards, points = list_cards(kind.cards), _entry_points(kind).get(text, [])
    owners = ([f"the card {text}.toml of rsbench"] if text in cards else []) + [_owner(point) for point in points]
    if len(owners) > 1:
        raise RsbenchError(
            f"{kind.singular} {text!r}: is the name of {' and of '.join(owners)}; rename one of them"
        )
    if points:
        return _from_entry_point(kind, text, points[0])
    if not text.endswith(".toml") and "/" not in text and os.sep not in text and text not in cards:
        known = list_names(kind)
        raise RsbenchError(f"{kind.singular} {text!r} does not exist{choices(text, known)}; a path ends in .toml")
    return _from_card(kind, card_path(kind.cards, name_or_path))


def _from_entry_point(
    kind: Kind[Component, Options], name: str, point: metadata.EntryPoint
) -> Entry[Component, Options]:
    where = f"entry point {kind.group}:{name} ({_owner(point)})"
    try:
        cls = point.load()
    except Exception as error:  # whatever a package's import raises, it is that package's fault
        raise RsbenchError(f"{where}: cannot be loaded: {_in_words(error)}") from error
    component = _instance(kind, cls, {}, where)
    description = (inspect.getdoc(cls) or "").partition("\n")[0]
    return Entry(
        name=name,
        path=None,
        description=description,
        component=component,
        options=kind.options(),
        key=component_key(component, {}),
    )


def _from_card(kind: Kind[Component, Options], path: Path) -> Entry[Component, Options]:
    data = read_toml(path)
    known = [*_OWN, *(option.name for option in dataclasses.fields(kind.options))]  # type: ignore[arg-type]
    for key in data:
        if key not in known:
            raise RsbenchError(f"{path}: unknown key {key!r}{choices(key, known)}")
    if "class" not in data:
        raise RsbenchError(f"{path}: 'class' is required")
    content = parse_card(
        _Content, {("class_" if key == "class" else key): data[key] for key in _OWN if key in data}, str(path)
    )
    options = parse_card(kind.options, {key: data[key] for key in data if key not in _OWN}, str(path))
    cls = _import(content.class_, path)
    component = _instance(kind, cls, content.parameters, str(path))
    return Entry(
        name=path.stem,
        path=path,
        description=content.description,
        component=component,
        options=options,
        parameters=content.parameters,
        key=component_key(component, content.parameters),
    )


def _entry_points(kind: Kind[Any, Any]) -> dict[str, list[metadata.EntryPoint]]:
    found: dict[str, list[metadata.EntryPoint]] = {}
    for point in metadata.entry_points(group=kind.group):
        same = found.setdefault(point.name, [])
        if all(other.value != point.value for other in same):
            same.append(point)
    return found


def _owner(point: metadata.EntryPoint) -> str:
    package = point.dist.name if point.dist is not None else "a package"
    return f"{point.value} of {package}"


def _import(target: str, card: Path) -> object:
    """The class of ``package.module:Class``; modules beside the card are found too."""
    where = f"{card}: class = {target!r}"
    module, _, name = target.partition(":")
    if not all(part.isidentifier() for part in [*module.split("."), name]):
        raise RsbenchError(f"{where}: must be 'package.module:Class'")
    try:
        with _importable(card.parent.resolve()):
            return getattr(importlib.import_module(module), name)
    except Exception as error:
        raise RsbenchError(f"{where}: cannot be imported: {_in_words(error)}") from error


@contextmanager
def _importable(folder: Path) -> Iterator[None]:
    """Lets modules in a folder be imported, after those that are installed."""
    sys.path.append(str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))


def _instance(kind: Kind[Component, Options], cls: object, parameters: dict[str, Any], where: str) -> Component:
    """The component with its parameters."""
    if not (isinstance(cls, type) and issubclass(cls, kind.base)) or inspect.isabstract(cls):
        base = f"{kind.base.__module__}.{kind.base.__qualname__}"
        raise RsbenchError(f"{where}: {cls!r} is not a {kind.singular}: it must be a concrete subclass of {base}")
    if hasattr(cls, "__dataclass_fields__"):
        return parse_card(cls, parameters, f"{where}: parameters")
    known = list(inspect.signature(cls).parameters)
    for key in parameters:
        if key not in known:
            raise RsbenchError(f"{where}: parameters: unknown key {key!r}{choices(key, known)}")
    try:
        return cls(**parameters)
    except (TypeError, ValueError) as error:
        raise RsbenchError(f"{where}: parameters: {error}") from error


def component_key(component: object, parameters: Mapping[str, Any]) -> str:
    """Identity of a component: class, source, parameters, and the keys of the components inside it.

    A dataclass's parameters are all its fields, so that a changed default is a change; another object's are what
    its card gave.
    """
    cls = type(component)
    if dataclasses.is_dataclass(component) and not isinstance(component, type):
        parameters = {f.name: getattr(component, f.name) for f in dataclasses.fields(component) if f.init}
    identity = {
        "class": f"{cls.__module__}:{cls.__qualname__}",
        "source": source_version(cls),
        "parameters": dict(parameters),
        "inner": list(getattr(component, "inner_keys", ())),
    }
    return hashlib.sha256(json.dumps(identity, sort_keys=True, default=repr).encode()).hexdigest()


def source_version(cls: type) -> str:
    """Hash of the source that a class's answers come from: all of rsbench's numerics, or the class's own file."""
    module = cls.__module__
    if module.partition(".")[0] == "rsbench":
        return own_source_version()
    try:
        file = inspect.getsourcefile(cls)
    except TypeError:  # built in, or made in a shell
        file = None
    return _file_hash(Path(file)) if file is not None and Path(file).is_file() else f"{module}: no source"


@functools.cache
def own_source_version() -> str:
    """Hash of rsbench's own sources that decide what solvers, matchers and correctors answer."""
    package = Path(str(resources.files("rsbench")))
    files = sorted(path for room in _NUMERIC_ROOMS for path in (package / room).rglob("*.py"))
    text = "\n".join(f"{path.relative_to(package).as_posix()} {_file_hash(path)}" for path in files)
    return hashlib.sha256(text.encode()).hexdigest()


def _file_hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _in_words(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
