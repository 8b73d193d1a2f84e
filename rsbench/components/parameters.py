"""Parameters of a class: names, types, defaults and docstrings, for people."""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import itertools
import textwrap
from typing import Any


def parameters_of(cls: type, component: object = None) -> list[dict[str, Any]]:
    """The parameters of a component's class, in the order of its constructor.

    Args:
        cls: a dataclass, whose fields have docstrings below them, or any class.
        component: an object of it, for the values.

    Returns:
        ``parameter``, ``type``, ``default``, ``value`` (as a card would write them; "" when there is none) and
        ``meaning`` of each.
    """
    meanings = field_docstrings(cls)
    required = inspect.Parameter.empty
    rows = []
    for name, parameter in inspect.signature(cls).parameters.items():
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            continue
        default = _default(cls, name, parameter.default)
        rows.append(
            {
                "parameter": name,
                "type": "" if parameter.annotation is required else _type_name(parameter.annotation),
                "value": value_in_a_card(getattr(component, name)) if hasattr(component, name) else "",
                "default": "required" if default is required else value_in_a_card(default),
                "meaning": meanings.get(name, ""),
            }
        )
    return rows


def _default(cls: type, name: str, given: object) -> object:
    """The default that the signature shows, or that a factory makes."""
    for field in dataclasses.fields(cls) if dataclasses.is_dataclass(cls) else ():
        if field.name == name and field.default_factory is not dataclasses.MISSING:
            return field.default_factory()
    return given


def _type_name(annotation: object) -> str:
    return annotation if isinstance(annotation, str) else getattr(annotation, "__name__", str(annotation))


def value_in_a_card(value: object) -> Any:
    """A value as a card would write it; None, which no card can write, is empty text."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: value_in_a_card(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, (list, tuple)):
        return [value_in_a_card(item) for item in value]
    if isinstance(value, dict):
        return {key: value_in_a_card(item) for key, item in value.items()}
    return value if isinstance(value, bool | int | float | str) else "" if value is None else str(value)


def field_docstrings(cls: type) -> dict[str, str]:
    """Texts below the fields of a class and of those above it, in one line each."""
    return {name: text for parent in reversed(cls.__mro__[:-1]) for name, text in _own_docstrings(parent)}


@functools.cache
def _own_docstrings(cls: type) -> tuple[tuple[str, str], ...]:
    """Names and texts of the fields of a class itself; finding its source takes up to a tenth of a second."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]
    except (OSError, TypeError, SyntaxError, IndexError):  # made in a shell, or without its source
        return ()
    found = []
    for field, text in itertools.pairwise(tree.body) if isinstance(tree, ast.ClassDef) else ():
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and _is_text(text):
            told = str(text.value.value)  # pyrefly: ignore[missing-attribute]
            found.append((field.target.id, " ".join(told.split())))
    return tuple(found)


def _is_text(node: ast.stmt) -> bool:
    return (
        isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    )
