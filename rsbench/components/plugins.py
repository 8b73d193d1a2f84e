"""Loading components by name: cards that come with rsbench, users' cards, and entry points of installed packages.

All kinds of components are found in the same way. A name refers to a card, an entry point, or a class of rsbench
that needs no card. A value that ends in ``.toml`` is the path of a card; ``FILE.py`` or ``FILE.py:NAME`` is a
class or decorated function in that file, used with its default parameters. A card has ``class =
"package.module:Class"`` and may have ``description``, ``parameters`` and the options of its kind. If two packages
use the same name, this is an error only when the name is used. An exception in a package's code is reported as one
line with the package's name.
"""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import os
import re
import sys
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any, Generic, TypeGuard, TypeVar

from pydantic.errors import PydanticUserError

from rsbench.components.cards import (
    CardKind,
    card_path,
    check_values,
    choices,
    list_cards,
    name_of_today,
    parse_card,
    read_toml,
)
from rsbench.components.imports import (
    blaming,
    component_key,
    entry_points_by_name,
    exception_text,
    import_file,
    import_target,
    package_of,
    try_import,
)
from rsbench.core.errors import RsbenchError

Component = TypeVar("Component")
Options = TypeVar("Options")
MARK = "rsbench_class"
"""Attribute of a decorated function with the component class that calls it."""
CARD_OPTIONS = "card_options"
"""Attribute of a component class with its defaults for the options of a card, if any."""
_PYTHON = re.compile(r"(.*\.py)(?::(.*))?", re.DOTALL)
"""A Python file, optionally followed by the name of a class or function in it."""


@dataclass(frozen=True)
class NoOptions:
    """Options of a kind whose cards set only parameters."""


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of running a component, set by its card."""

    time_limit_s: float = 300.0
    """Wall-clock time limit for one problem; a component of another package that exceeds it has failed."""

    def __post_init__(self) -> None:
        if not self.time_limit_s > 0.0:
            raise ValueError(f"time_limit_s = {self.time_limit_s}: must be a positive number of seconds")


def _anything_goes(component: Any) -> None:
    pass


@dataclass(frozen=True, kw_only=True)
class Kind(Generic[Component, Options]):
    """One kind of component."""

    singular: str
    """Its name in messages, such as ``solver``."""
    cards: CardKind | None = None
    """Folder of its cards; None when the classes are named in cards of something else."""
    group: str = ""
    """Group of its entry points; by default ``rsbench.<folder of its cards>``."""
    base: type[Component]
    """Base class of all components."""
    options: type[Options]
    """Dataclass of the keys that a card may set beside the parameters; all have defaults."""
    built_in: Mapping[str, str] = field(default_factory=dict)
    """Names of rsbench's own classes that need no card, as ``package.module:Class``."""
    check: Callable[[Component], None] = _anything_goes
    """Function that raises ValueError for a component with inconsistent declarations."""
    mark: str = ""
    """The decorator of functions, such as ``@rsbench.solver``; empty if components must be classes."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "group", self.group or f"rsbench.{self.cards}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Entry(Generic[Component, Options]):
    """A component with its name in tables, files and seeds."""

    name: str
    path: Path | None
    """Its card, or its Python file, which ``:NAME`` may follow; None for an entry point."""
    description: str
    component: Component
    options: Options
    parameters: dict[str, Any] = field(default_factory=dict)
    """Parameters that the card sets."""
    key: str
    """Hash of class, source, parameters and inner components: equal keys give equal results."""

    @property
    def built_in(self) -> bool:
        """Whether the component and its inner components belong to rsbench, so that it runs in this process."""
        part: object = self.component
        while part is not None:
            if type(part).__module__.partition(".")[0] != "rsbench":
                return False
            part = getattr(part, "inner", None)
        return True


@dataclass(frozen=True, kw_only=True)
class Offer:
    """An available component that is not yet loaded."""

    name: str
    origin: str
    """``rsbench``, or the package that provides the component."""
    path: Path | None = None
    """Its card."""
    point: metadata.EntryPoint | None = None


@dataclass(frozen=True, kw_only=True)
class CardContent:
    """A component's card: the class that does the work, and its parameters."""

    class_: str
    """The class that does the work: ``package.module:Class``; the module may lie beside the card."""
    description: str = ""
    """One line for ``rsbench list``."""
    parameters: dict[str, Any] = field(default_factory=dict)
    """Parameters of the class: its fields, or the arguments of its constructor."""


_OWN = tuple(each.name.rstrip("_") for each in dataclasses.fields(CardContent))
"""Keys that cards of all kinds of components may have."""


def blame(kind: Kind[Any, Any], entry: Entry[Any, Any]) -> AbstractContextManager[None]:
    """Return a context for a component's code that reports exceptions of other packages as one line with its name.

    Raises:
        RsbenchError: an exception in another package's component; exceptions in rsbench's own pass unchanged.
    """
    if entry.built_in:
        return contextlib.nullcontext()
    return blaming(f"{kind.singular} {entry.name!r}", "failed")


def wrap(kind: Kind[Component, Options], component: Component) -> Entry[Component, Options]:
    """Return the entry of a component object without a card, with the name of its class."""
    return _without_card(kind, component, type(component).__name__, "")


def _without_card(
    kind: Kind[Component, Options], component: Component, name: str, description: str, path: Path | None = None
) -> Entry[Component, Options]:
    return Entry(
        name=name,
        path=path,
        description=description,
        component=component,
        options=getattr(component, CARD_OPTIONS, kind.options()),
        key=component_key(component, {}),
    )


def list_names(kind: Kind[Any, Any]) -> list[str]:
    """Return the names of all components of a kind, sorted; a name that is used twice is not an error here."""
    return sorted({offer.name for offer in offers(kind)})


def offers(kind: Kind[Any, Any]) -> list[Offer]:
    """Return all available components of a kind, sorted by name, without loading them; names may occur twice."""
    cards = list_cards(kind.cards) if kind.cards is not None else {}
    own = [Offer(name=name, origin="rsbench", path=path) for name, path in cards.items()]
    own += [Offer(name=name, origin="rsbench") for name in kind.built_in if name not in cards]
    installed = [
        Offer(name=name, origin=package_of(point), point=point)
        for name, points in entry_points_by_name(kind.group).items()
        for point in points
    ]
    return sorted([*own, *installed], key=lambda offer: offer.name)


def is_path(text: str) -> bool:
    """Return whether a component is given by the path of its card or Python file, not by its name."""
    return text.endswith(".toml") or "/" in text or os.sep in text or _PYTHON.fullmatch(text) is not None


def load_entry(kind: Kind[Component, Options], name_or_path: str | Path) -> Entry[Component, Options]:
    """Load a component by the name of a card or entry point, by the path of a card, or by ``FILE.py[:NAME]``.

    Raises:
        RsbenchError: the component does not exist, two have this name, or its card or class is invalid; one line
            with the card, the file or the entry point.
    """
    text = os.fspath(name_or_path)
    if kind.cards is not None and (python := _PYTHON.fullmatch(text)):
        return _from_python(kind, text, *python.groups(""))
    if kind.cards is not None and is_path(text):
        return _from_card(kind, card_path(kind.cards, text))
    near = next((f"; did you mean {text}{end}?" for end in (".py", ".toml") if os.path.isfile(text + end)), "")
    offer = _only_offer(kind, text, (near or "; a path ends in .toml or .py") if kind.cards is not None else "")
    if offer.path is not None:
        return _from_card(kind, offer.path)
    cls, where = _offered_class(kind, offer)
    return _without_card(kind, make_component(kind, cls, {}, where), offer.name, _first_paragraph(cls))


def load_class(kind: Kind[Component, Any], name: str, card: Path | None = None) -> type[Component]:
    """Load a class by the name of a class of rsbench or of an entry point, or as ``package.module:Class``.

    The module may be in the folder of the card (or, without a card, in the current folder).

    Raises:
        RsbenchError: the class does not exist, two have this name, or it cannot be loaded or is not of this kind.
    """
    card_is = f"{card}: " if card is not None else ""
    if ":" in name:
        where, folder = f"{card_is}{kind.singular} = {name!r}", card.parent if card is not None else Path.cwd()
        return _checked(kind, import_target(name, folder, where), str(card) if card is not None else where)
    return _offered_class(kind, _only_offer(kind, name, "", card_is))[0]


def description_of(kind: Kind[Any, Any], offer: Offer) -> str:
    """Return the first paragraph of the docstring of a component's class, for a component without a card.

    Raises:
        RsbenchError: two components have this name, it cannot be loaded, or it is not of this kind.
    """
    _only_offer(kind, offer.name, "")
    return _first_paragraph(_offered_class(kind, offer)[0])


def _first_paragraph(cls: type) -> str:
    return " ".join((inspect.getdoc(cls) or "").partition("\n\n")[0].split())


def _only_offer(kind: Kind[Any, Any], name: str, advice: str, where: str = "") -> Offer:
    everything = offers(kind)
    names = {name, name_of_today(kind.cards, name)}
    found = [offer for offer in everything if offer.name in names]
    if len(found) > 1:
        owners = " and of ".join(_owner(offer) for offer in found)
        raise RsbenchError(f"{where}{kind.singular} {name!r}: is the name of {owners}; rename one of them")
    if not found:
        known = choices(name, {offer.name for offer in everything})
        raise RsbenchError(f"{where}{kind.singular} {name!r} does not exist{known}{advice}")
    return found[0]


def _offered_class(kind: Kind[Component, Any], offer: Offer) -> tuple[type[Component], str]:
    """Load the class of a component without a card; return it with its name for messages."""
    if offer.point is None:
        return _checked(kind, import_target(kind.built_in[offer.name], None, offer.name), offer.name), offer.name
    where = f"entry point {kind.group}:{offer.name} ({_owner(offer)})"
    with blaming(where, "cannot be loaded"):
        try_import(offer.point.module)
        cls = offer.point.load()
    return _checked(kind, cls, where), where


def _from_card(kind: Kind[Component, Options], path: Path) -> Entry[Component, Options]:
    data = read_toml(path)
    known = [*_OWN, *(option.name for option in dataclasses.fields(kind.options))]  # pyrefly: ignore[bad-argument-type]
    for key in data:
        if key not in known:
            raise RsbenchError(f"{path}: unknown key {key!r}{choices(key, known)}")
    if "class" not in data:
        raise RsbenchError(f"{path}: 'class' is required")
    content = parse_card(
        CardContent, {("class_" if key == "class" else key): data[key] for key in _OWN if key in data}, str(path)
    )
    cls = _checked(
        kind, import_target(content.class_, path.parent, f"{path}: class = {content.class_!r}"), str(path)
    )
    component = make_component(kind, cls, content.parameters, str(path))
    defaults = vars(getattr(component, CARD_OPTIONS, kind.options()))
    options = parse_card(
        kind.options, {**defaults, **{key: data[key] for key in data if key not in _OWN}}, str(path)
    )
    return Entry(
        name=path.stem,
        path=path,
        description=content.description,
        component=component,
        options=options,
        parameters=content.parameters,
        key=component_key(component, content.parameters),
    )


def _from_python(kind: Kind[Component, Options], text: str, file: str, name: str) -> Entry[Component, Options]:
    """Load the component with this name from a Python file or, without a name, the only component in it."""
    module = import_file(Path(file))
    offered = {
        cls: key
        for key, value in vars(module).items()
        if _belongs(kind, cls := class_of(value)) and cls.__module__ == module.__name__
    }
    if name and not hasattr(module, name):
        raise RsbenchError(f"{text}: {file} defines no {name!r}{choices(name, offered.values())}")
    if not name and not offered:
        raise RsbenchError(f"{file}: defines no {kind.singular}: {_remedy(kind, module)}")
    if not name and len(offered) > 1:
        raise RsbenchError(
            f"{file}: defines {len(offered)} {kind.cards}: name one, such as {file}:{min(offered.values())}"
            f"{choices('', offered.values())}"
        )
    cls = _checked(kind, getattr(module, name) if name else next(iter(offered)), text)
    component = make_component(kind, cls, {}, text)
    return _without_card(kind, component, name or module.__name__, _first_paragraph(cls), Path(text))


def class_of(value: object) -> object:
    """Return the component class of a decorated function, and any other value unchanged."""
    return getattr(value, MARK, value) if inspect.isfunction(value) else value


def _belongs(kind: Kind[Any, Any], cls: object) -> TypeGuard[type[Any]]:
    return isinstance(cls, type) and issubclass(cls, kind.base) and not inspect.isabstract(cls)


def _remedy(kind: Kind[Any, Any], module: object) -> str:
    """Return advice for a Python file that defines no component of this kind."""
    own = [each for each in vars(module).values() if inspect.isfunction(each)]
    own = [each for each in own if each.__module__ == getattr(module, "__name__", "")]
    likely = max(own, key=lambda each: len(inspect.signature(each).parameters) == 3, default=None)
    if kind.mark and likely is not None:
        return f"write {kind.mark} above def {likely.__name__}{inspect.signature(likely)}"
    base = f"a concrete subclass of {kind.base.__module__}.{kind.base.__qualname__}"
    return f"write a function below {kind.mark}, or {base}" if kind.mark else f"write {base}"


def _owner(offer: Offer) -> str:
    if offer.point is not None:
        return f"{offer.point.value} of {offer.origin}"
    return f"the card {offer.name}.toml of rsbench" if offer.path is not None else "rsbench's own"


# Classes


def _checked(kind: Kind[Component, Any], cls: object, where: str) -> type[Component]:
    cls = class_of(cls)
    if _belongs(kind, cls):
        return cls  # pyrefly: ignore[bad-return]
    if kind.mark and inspect.isfunction(cls):
        raise RsbenchError(f"{where}: not a {kind.singular} yet: write {kind.mark} above def {cls.__name__}")
    base = f"{kind.base.__module__}.{kind.base.__qualname__}"
    missing = ", ".join(sorted(getattr(cls, "__abstractmethods__", ()))) if isinstance(cls, type) else ""
    lacks = f"; it lacks {missing}" if missing and issubclass(cls, kind.base) else ""  # pyrefly: ignore[bad-argument-type]
    raise RsbenchError(
        f"{where}: {cls!r} is not a {kind.singular}: it must be a concrete subclass of {base}{lacks}"
    )


def make_component(
    kind: Kind[Component, Any], cls: type[Component], parameters: Mapping[str, Any], where: str
) -> Component:
    """Make a component of a class with the parameters of a card.

    Args:
        kind: kind of the component, whose ``check`` it must pass.
        cls: a dataclass, whose fields are checked strictly, or any class.
        parameters: parameters by name.
        where: card or entry point, for messages.

    Raises:
        RsbenchError: a parameter is unknown or invalid, or the class raises an exception; one line.
    """
    check_values(parameters, f"{where}: parameters")
    if _has_dataclass_init(cls):
        component = _blamed_parse(cls, parameters, where)
    else:
        known = inspect.signature(cls).parameters
        for key in parameters:
            if key not in known and all(p.kind is not p.VAR_KEYWORD for p in known.values()):
                raise RsbenchError(f"{where}: parameters: unknown key {key!r}{choices(key, known)}")
        with blaming(where, "parameters"):
            component = cls(**parameters)
    with blaming(where, "declares what cannot be"):
        kind.check(component)
    return component


def _has_dataclass_init(cls: type) -> bool:
    """Return whether the constructor is generated by ``@dataclass``, for this class or a base class."""
    owner = next(parent for parent in cls.__mro__ if "__init__" in vars(parent))
    params = vars(owner).get("__dataclass_params__")
    return params is not None and bool(params.init)


def _blamed_parse(cls: type[Component], parameters: Mapping[str, Any], where: str) -> Component:
    try:
        with contextlib.redirect_stdout(sys.stderr):
            return parse_card(cls, parameters, f"{where}: parameters")
    except (RsbenchError, RecursionError):
        raise
    except PydanticUserError as error:
        if not parameters:
            with blaming(where, "parameters"):
                return cls()
        raise RsbenchError(
            f"{where}: parameters: the fields of {cls.__name__} must have types that a card can hold "
            f"(numbers, texts, tuples, dataclasses): {str(error).partition(chr(10))[0]}"
        ) from error
    except (Exception, SystemExit) as error:  # raised by the constructor
        raise RsbenchError(f"{where}: parameters: {exception_text(error)}") from error
