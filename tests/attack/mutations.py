"""Broken inputs from valid ones: bytes changed at random, trees changed by Hypothesis strategies."""

from __future__ import annotations

import copy
import io
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
from hypothesis import strategies as st

Rng = np.random.Generator
_NUMBERS = (
    b"0 -1 1 2 3 255 65535 65536 2147483647 4294967295 99999999999999999999 "
    b"1e308 -1e308 1e-320 5e-324 1e-170 1e200 nan inf"
).split()
_WORDS = (
    *_NUMBERS,
    b"-inf",
    b"NaN",
    b"null",
    b"true",
    b'"x"',
    b"''",
    b"[]",
    b"{}",
    b"1e999",
    b"0x10",
    b"1_0",
    b"\xff",
)
_INTEGERS = (0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 0x80000000, 100_000_000)
_NUMBER = re.compile(rb"-?\d+(\.\d+)?([eE][-+]?\d+)?")


def mutated(data: bytes, others: tuple[bytes, ...], rng: Rng) -> bytes:
    """``data`` with one to four changes; ``others`` are valid inputs to take pieces from."""
    for _ in range(int(rng.integers(1, 5))):
        change: Callable[[bytes, tuple[bytes, ...], Rng], bytes] = _CHANGES[int(rng.integers(len(_CHANGES)))]
        data = change(data, others, rng)
    return data[:10_000_000]


def _flip(data: bytes, others: tuple[bytes, ...], rng: Rng) -> bytes:
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 9)) if out else 0):
        out[int(rng.integers(len(out)))] ^= 1 << int(rng.integers(8))
    return bytes(out)


def _cut(data: bytes, others: tuple[bytes, ...], rng: Rng) -> bytes:
    return data[: int(rng.integers(len(data) + 1))]


def _insert(data: bytes, others: tuple[bytes, ...], rng: Rng) -> bytes:
    place, source = int(rng.integers(len(data) + 1)), others[int(rng.integers(len(others)))]
    first = int(rng.integers(len(source) + 1))
    piece = source[first : first + int(rng.integers(1, 200))]
    if rng.random() < 0.3:
        piece = rng.bytes(int(rng.integers(1, 64)))
    return data[:place] + piece + data[place:]


def _remove(data: bytes, others: tuple[bytes, ...], rng: Rng) -> bytes:
    first = int(rng.integers(len(data) + 1))
    return data[:first] + data[first + int(rng.integers(1, 64)) :]


def _word(data: bytes, others: tuple[bytes, ...], rng: Rng) -> bytes:
    """Another number, in text; at random places where there is none."""
    word, found = _WORDS[int(rng.integers(len(_WORDS)))], list(_NUMBER.finditer(data[:100_000]))
    if not found:
        return _integer(data, others, rng)
    place = found[int(rng.integers(len(found)))]
    return data[: place.start()] + word + data[place.end() :]


def _integer(data: bytes, others: tuple[bytes, ...], rng: Rng) -> bytes:
    """Another number, in binary; more often near the beginning, where headers are."""
    value = _INTEGERS[int(rng.integers(len(_INTEGERS)))]
    piece = struct.pack("<>"[int(rng.integers(2))] + "I", value)
    end = min(len(data), 400) if rng.random() < 0.7 else len(data)
    place = int(rng.integers(end + 1))
    return data[:place] + piece + data[place + 4 :]


def _nest(data: bytes, others: tuple[bytes, ...], rng: Rng) -> bytes:
    depth, place = int(10 ** rng.uniform(1, 5)), int(rng.integers(len(data) + 1))
    left, right = (b"[", b"]") if rng.random() < 0.5 else (b'{"a":', b"}")
    middle = b"1" if rng.random() < 0.5 else b""
    found = list(_NUMBER.finditer(data[:100_000]))
    if found and rng.random() < 0.7:
        value = found[int(rng.integers(len(found)))]
        return data[: value.start()] + left * depth + b"1" + right * depth + data[value.end() :]
    return data[:place] + left * depth + middle + right * depth + data[place:]


_CHANGES = (_flip, _flip, _cut, _insert, _remove, _word, _word, _integer, _integer, _nest)


def mutated_png(data: bytes, others: tuple[bytes, ...], rng: Rng) -> bytes:
    """A PNG whose header says something else, with a checksum that fits; or any change of its bytes."""
    if rng.random() < 0.6 or len(data) < 33:
        return mutated(data, others, rng)
    header = bytearray(data[16:29])
    place = int(rng.integers(4))
    if place < 2:
        header[4 * place : 4 * place + 4] = struct.pack(">I", int(2 ** rng.uniform(0, 32)) & 0xFFFFFFFF)
    else:
        header[int(rng.integers(8, 13))] = int(rng.integers(256))
    return data[:16] + bytes(header) + struct.pack(">I", zlib.crc32(b"IHDR" + bytes(header))) + data[33:]


def mutated_npz(data: bytes, others: tuple[bytes, ...], rng: Rng) -> bytes:
    """An archive with one array changed, and whole otherwise; or any change of its bytes."""
    if rng.random() < 0.4:
        return mutated(data, others, rng)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = list(members)[int(rng.integers(len(members)))]
    choice = rng.random()
    if choice < 0.15:
        del members[name]
    elif choice < 0.5:
        array = _array(rng)
        buffer = io.BytesIO()
        np.lib.format.write_array(buffer, array, allow_pickle=False)
        members[name] = buffer.getvalue()
    else:
        members[name] = mutated(members[name], others, rng)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for member, content in members.items():
            archive.writestr(member, content)
    return buffer.getvalue()


def _array(rng: Rng) -> Any:
    """A plain array of another kind or shape."""
    shape = tuple(int(n) for n in rng.integers(0, 5, int(rng.integers(0, 4))))
    kind = ("f8", "f4", "i8", "u1", "?", "c16", "U5", "S3", "M8[s]")[int(rng.integers(9))]
    values = np.zeros(shape, dtype=kind)
    if kind in ("f8", "f4") and rng.random() < 0.5:
        values = values + np.float64((np.nan, np.inf, 1e308, -1.0)[int(rng.integers(4))])
    return values


# Trees, as cards and JSON files are

JUNK: st.SearchStrategy[Any] = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from((0, -1, 10**30, 2**63, 1e308, -0.0, 5e-324, 1e-170, 1e200))
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(("..", "/", "../../other", "a\nb", "\x00", "..:x", "os:system", "nan", "a" * 5000)),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@st.composite
def broken(draw: st.DrawFn, tree: Any) -> Any:
    """The tree with one to three of its parts replaced, removed, doubled or added to."""
    tree = copy.deepcopy(tree)
    for _ in range(draw(st.integers(1, 3))):
        places = _places(tree)
        if not places:
            return tree
        parent, key = draw(st.sampled_from(places))
        what = draw(st.sampled_from(("replace", "replace", "replace", "remove", "exchange", "add")))
        if what == "remove":
            del parent[key]
        elif what == "exchange":
            other, name = draw(st.sampled_from(places))
            parent[key], other[name] = copy.deepcopy(other[name]), copy.deepcopy(parent[key])
        elif what == "add" and isinstance(parent, dict):
            parent[draw(st.text(max_size=6))] = draw(JUNK)
        else:
            parent[key] = draw(JUNK)
    return tree


def _places(tree: Any) -> list[tuple[Any, Any]]:
    """Every part of a tree, as what holds it and its key there."""
    found: list[tuple[Any, Any]] = []
    for key in list(tree) if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else ():
        found += [(tree, key), *_places(tree[key])]
    return found
