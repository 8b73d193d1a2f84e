"""Encoding of messages from a child process: plain data, so that the parent runs nothing that comes from there.

A value is None, a truth value, a number, a text, an array, or a tuple, list, dict or dataclass of such. A message
is its length and an npz file: arrays, and the rest as JSON that refers to them.
"""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from rsbench.storage.untrusted_files import unpack_arrays

_LENGTH_BYTES = 8
_LONGEST = 1 << 32
_KINDS = "biufU"
"""Of arrays: truth values, numbers and text."""


def encode(value: object) -> bytes:
    """A value as bytes.

    Raises:
        TypeError: it holds something that is no plain data.
    """
    arrays: list[NDArray[Any]] = []
    text = json.dumps(_flat(value, arrays))
    buffer = io.BytesIO()
    content = {"tree": np.array(text), **{f"array_{k}": array for k, array in enumerate(arrays)}}
    np.savez(buffer, allow_pickle=False, **content)
    return buffer.getvalue()


def decode(data: bytes, classes: Mapping[str, type]) -> Any:
    """The value of ``encode``; dataclasses are made by their constructors, and only those of ``classes``.

    Raises:
        ValueError: the bytes are no such value, or a constructor refuses its fields.
    """
    try:
        arrays = unpack_arrays(io.BytesIO(data), "message", limit=len(data))  # ``encode`` compresses nothing
        return _built(json.loads(str(arrays["tree"])), arrays, classes)
    except ValueError:
        raise
    except Exception as error:  # whatever damaged bytes cause: zip, JSON, a missing key, a wrong field
        raise ValueError(f"no message: {type(error).__name__}: {error}") from error


def _flat(value: object, arrays: list[NDArray[Any]]) -> object:
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in _KINDS:
            raise TypeError(f"an array of {value.dtype} is no plain data")
        arrays.append(value)
        return {"array": len(arrays) - 1}
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, (tuple, list)):
        return {type(value).__name__: [_flat(item, arrays) for item in value]}
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {"dict": {key: _flat(item, arrays) for key, item in value.items()}}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: _flat(getattr(value, f.name), arrays) for f in dataclasses.fields(value) if f.init}
        return {"dataclass": type(value).__name__, "fields": fields}
    raise TypeError(f"a {type(value).__name__} is no plain data")


def _built(tree: Any, arrays: Mapping[str, NDArray[Any]], classes: Mapping[str, type]) -> Any:
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        return arrays[f"array_{tree['array']}"]
    for name, kind in (("tuple", tuple), ("list", list)):
        if name in tree:
            return kind(_built(item, arrays, classes) for item in tree[name])
    if "dict" in tree:
        return {key: _built(item, arrays, classes) for key, item in tree["dict"].items()}
    fields = {key: _built(item, arrays, classes) for key, item in tree["fields"].items()}
    return classes[tree["dataclass"]](**fields)


def send(stream: BinaryIO, data: bytes) -> None:
    """Write one message."""
    stream.write(len(data).to_bytes(_LENGTH_BYTES, "big") + data)
    stream.flush()


def receive(stream: BinaryIO) -> bytes | None:
    """The next message; None at the end of the stream, or where what comes is no message."""
    length = int.from_bytes(head, "big") if len(head := stream.read(_LENGTH_BYTES)) == _LENGTH_BYTES else _LONGEST
    if length >= _LONGEST:
        return None
    data = stream.read(length)
    return data if len(data) == length else None
