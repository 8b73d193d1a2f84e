"""Contents of calibration files of any syntax as nested dicts, lists, texts and numbers.

YAML (OpenCV's with its ``%YAML:1.0`` and tags too), JSON, OpenCV's XML, the sections of an INI file, and the lines
of COLMAP's cameras.txt and rigs.txt. The syntax is recognised by the content, not by the file's name. A
matrix, with ``rows`` and ``cols`` or ``sizes``, and ``data``, becomes an array.
"""

from __future__ import annotations

import configparser
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from rsbench.core.errors import RsbenchError
from rsbench.core.so3 import FloatArray
from rsbench.storage.untrusted_files import MB, parse_json, read_text

_LONGEST = 8 * MB
"""Largest file, bytes; COLMAP lists a camera for each image of a collection."""
_DEEPEST = 16
"""Deepest nesting of tables and lists."""
_LISTS = (list, tuple, np.ndarray)
_MOST_FILES = 200
"""Largest number of files of a folder that are examined."""
_SUFFIXES = (".yaml", ".yml", ".json", ".xml", ".conf", ".txt", ".calib")


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, without aliases, since nested aliases let a small file expand to gigabytes."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.events.AliasEvent):
            raise yaml.YAMLError("aliases (*name) are not read")
        return super().compose_node(parent, index)


_Loader.add_multi_constructor(
    "tag:yaml.org,2002:opencv-", lambda loader, suffix, node: loader.construct_mapping(node, deep=True)
)


def read_tree(path: Path) -> Any:
    """The content of a file.

    Raises:
        RsbenchError: it cannot be read, or has none of the supported syntaxes.
    """
    text = read_text(path, _LONGEST)
    try:
        return _arrays(_parsed(text, path))
    except RecursionError as error:
        raise RsbenchError(f"{path}: nested too deeply") from error
    except ValueError as error:
        raise RsbenchError(f"{path}: {' '.join(str(error).split())[:200]}") from error


def _parsed(text: str, path: Path) -> Any:
    start, sections = text.lstrip()[:1], re.search(r"^\[[A-Za-z_][\w ]*\]\s*$", text, re.MULTILINE)
    if start == "<":
        return _of_xml(text)
    if start == "{":
        return parse_json(text, path)
    if sections:
        return _of_ini(text)
    if start == "[":
        return json.loads(text)
    if re.search(r"^\d+ +([A-Z_]+ +\d|\d+ +(CAMERA|IMU)\b)", text, re.MULTILINE):
        return {"colmap": [line.split() for line in text.splitlines() if line[:1].isdigit()]}
    return _of_yaml(text)


def _of_yaml(text: str) -> Any:
    plain = re.sub(r"\A%YAML[: ]1\.\d[^\n]*\n(---[^\n]*\n)?", "", text)
    try:
        return yaml.load(plain, Loader=_Loader)
    except yaml.YAMLError as error:
        words = str(error).replace('in "<unicode string>", ', "at ")
        raise ValueError(f"neither YAML, JSON, XML nor an INI file: {words}") from error


def _of_xml(text: str) -> Any:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("XML with a DOCTYPE or ENTITY definition is not supported")
    try:
        return _of_element(ElementTree.fromstring(text))
    except ElementTree.ParseError as error:
        raise ValueError(f"not valid XML: {error}") from error


def _of_element(element: ElementTree.Element) -> Any:
    if len(element):
        return {child.tag: _of_element(child) for child in element}
    words = (element.text or "").split()
    values = [_number(word) for word in words]
    if len(values) == 1:
        return values[0]
    return element.text if any(isinstance(value, str) for value in values) else values


def _of_ini(text: str) -> Any:
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    parser.optionxform = lambda optionstr: optionstr  # pyrefly: ignore[method-assign]
    try:
        parser.read_string(text)
    except configparser.Error as error:
        raise ValueError(f"not a valid INI file: {error}") from error
    return {name: {key: _number(value) for key, value in section.items()} for name, section in parser.items()}


def _number(word: str) -> float | str:
    try:
        return float(word)
    except ValueError:
        return word


def _arrays(tree: Any, depth: int = 0) -> Any:
    """The tree with arrays in place of matrices."""
    if depth > _DEEPEST:
        raise ValueError(f"nested more than {_DEEPEST} levels deep")
    if isinstance(tree, Mapping):
        shape = [tree[key] for key in ("rows", "cols") if key in tree] or tree.get("sizes", [])
        if "data" in tree and shape:
            data, shape = ([each] if isinstance(each, int | float) else each for each in (tree["data"], shape))
            try:
                return np.array([float(value) for value in data]).reshape([int(size) for size in shape])
            except (TypeError, ValueError, OverflowError) as error:
                raise ValueError(f"a matrix of {' x '.join(map(str, shape))} must hold as many numbers") from error
        return {str(key): _arrays(value, depth + 1) for key, value in tree.items()}
    return [_arrays(value, depth + 1) for value in tree] if isinstance(tree, list) else tree


def files_in(folder: Path) -> Iterator[Path]:
    """Files of a folder, and of folders in it, that may be calibrations."""
    inside = sorted(folder.iterdir())
    inside += [each for sub in inside if sub.is_dir() for each in sorted(sub.iterdir())[:_MOST_FILES]]
    yield from [path for path in inside if path.suffix.lower() in _SUFFIXES and path.is_file()][:_MOST_FILES]


class Fields:
    """Typed access to the keys of a table of a file; errors name the file and the key."""

    def __init__(self, tree: Any, where: str) -> None:
        self.where = where
        self.tree: Mapping[str, Any] = tree if isinstance(tree, Mapping) else {}
        if not isinstance(tree, Mapping):
            raise RsbenchError(f"{where}: must be a table of keys, is {str(tree)[:60]!r}")

    def __contains__(self, key: str) -> bool:
        return self.tree.get(key) is not None

    def known(self, *keys: str) -> str:
        """The first key that exists; the first of all if none does."""
        return next((key for key in keys if key in self), keys[0])

    def get(self, *keys: str) -> Any:
        """Value of the first key that exists; None if none does."""
        return self.tree.get(self.known(*keys))

    def inner(self, key: str) -> Fields:
        """The table under a key."""
        return Fields(self.tree.get(key), f"{self.where}: {key}")

    def text(self, *keys: str, default: str = "") -> str:
        """A word, in lower case."""
        value = self.get(*keys)
        return default if value is None else str(value).strip().lower()

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number."""
        return default if default is not None and key not in self else float(self.numbers(key, 1)[0])

    def each(self, *keys: str) -> list[float]:
        """A finite number of each key."""
        return [self.number(key) for key in keys]

    def numbers(self, key: str, *counts: int) -> FloatArray:
        """Finite numbers (n,), flattened from nested lists; n must be one of ``counts``, if any are given."""
        value = self.get(key)
        if value is None:
            raise RsbenchError(f"{self.where}: {key}: is missing")
        try:
            found = np.array([float(each) for each in _flat(value)])
        except (TypeError, ValueError, OverflowError):
            found = np.full(1, np.nan)
        if not np.all(np.isfinite(found)) or (counts and len(found) not in counts):
            wanted = f"{' or '.join(map(str, counts))} " if counts else ""
            raise RsbenchError(
                f"{self.where}: {key} = {' '.join(map(str, _flat(value)))[:60]}: must be {wanted}finite numbers"
            )
        return found


def _flat(value: Any) -> Iterator[Any]:
    if isinstance(value, _LISTS):
        for each in np.ravel(value) if isinstance(value, np.ndarray) else value:
            yield from _flat(each)
    else:
        yield value
