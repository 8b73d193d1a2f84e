"""Identity of a component: equal keys give equal answers, whatever file or name a component came from."""

from __future__ import annotations

import ast
import dataclasses
import functools
import hashlib
import inspect
import json
import re
import sys
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

_NUMERIC_ROOMS = ("core", "solvers", "vision", "capture", "pipeline")
"""Packages whose source decides what a component of ours answers."""
_NUMERIC_FILES = ("components/compiled.py", "components/motion_models.py", "components/parameters.py")
"""Modules beside them of which that is true too."""


def component_key(component: object, parameters: Mapping[str, Any]) -> str:
    """Hash of a component's class, source, parameters, and the keys of the components inside it.

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
    return hashlib.sha256(json.dumps(identity, sort_keys=True, default=_text).encode()).hexdigest()


def _text(value: object) -> str:
    """A value that JSON does not know, without its address in memory, which differs in every run."""
    return re.sub(r" at 0x[0-9a-fA-F]+", "", repr(value))


def source_version(cls: type) -> str:
    """Hash of the source that a class's answers come from.

    All of rsbench's numerics for its own; the whole package of another's; for a single file, that file and the
    files beside it that it imports.
    """
    module = cls.__module__
    if module.partition(".")[0] == "rsbench":
        return own_source_version()
    try:
        file = inspect.getsourcefile(cls)
    except TypeError:  # built in, or made in a shell
        file = None
    if file is None or not Path(file).is_file():
        return f"{module}: no source"
    root = sys.modules.get(module.partition(".")[0])
    if root is not None and getattr(root, "__file__", None) and hasattr(root, "__path__"):
        folder = Path(str(root.__file__)).parent
        return hash_of_files(folder.parent, sorted(folder.rglob("*.py")))
    return hash_of_files(Path(file).parent, with_neighbours(Path(file)))


def with_neighbours(file: Path) -> list[Path]:
    """A file, and the modules and packages beside it that it imports, and those that they import, sorted."""
    found: set[Path] = set()
    todo = [file]
    while todo:
        path = todo.pop()
        if path in found or not path.is_file():
            continue
        found.add(path)
        for name in _imported(path):
            todo.append(file.parent / f"{name}.py")
            todo += (file.parent / name).rglob("*.py")
    return sorted(found)


def _imported(file: Path) -> set[str]:
    """First parts of the names of the modules that a file imports anywhere."""
    try:
        tree = ast.parse(file.read_bytes())
    except SyntaxError:
        return set()
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.add(node.module.partition(".")[0])
    return names


@functools.cache
def own_source_version() -> str:
    """Hash of rsbench's own sources that decide what solvers, matchers and correctors answer."""
    package = Path(str(resources.files("rsbench")))
    rooms = [path for room in _NUMERIC_ROOMS for path in (package / room).rglob("*.py")]
    return hash_of_files(package, sorted([*rooms, *(package / name for name in _NUMERIC_FILES)]))


def hash_of_files(folder: Path, files: list[Path]) -> str:
    text = "\n".join(f"{path.relative_to(folder).as_posix()} {file_hash(path)}" for path in files)
    return hashlib.sha256(text.encode()).hexdigest()


def file_hash(path: Path) -> str:
    """SHA-256 of a file's bytes."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
