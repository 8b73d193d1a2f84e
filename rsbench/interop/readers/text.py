"""Numbers in text files of others, with errors that name file and line."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rsbench.core.errors import RsbenchError
from rsbench.core.so3 import FloatArray, from_quaternion
from rsbench.storage.untrusted_files import read_text


def numbers(text: str, where: object, count: int | None = None) -> FloatArray:
    """(n,) finite numbers apart by blanks or commas; RsbenchError for others, or another count."""
    words = text.replace(",", " ").split()
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        raise RsbenchError(f"{where}: {text.strip()[:60]!r}: must be numbers") from None
    if (count is not None and len(values) != count) or not np.all(np.isfinite(values)):
        wanted = "finite numbers" if count is None else f"{count} finite numbers"
        raise RsbenchError(f"{where}: {text.strip()[:60]!r}: must be {wanted}")
    return values


def lines(path: Path) -> Iterator[tuple[str, str]]:
    """Lines that are not empty and no comment (#), each with where it stands."""
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield f"{path}:{number}", line


def only_file(folder: Path, *names: str) -> Path:
    """The first of some files that is there; RsbenchError for none."""
    for name in names:
        if (folder / name).is_file():
            return folder / name
    raise RsbenchError(f"{folder}: holds no {' or '.join(names)}")


def rotation(q: FloatArray, where: object) -> FloatArray:
    """(3, 3) of a quaternion (w, x, y, z), made of length one; RsbenchError where it is far from that."""
    length = float(np.linalg.norm(q))
    if not abs(length - 1.0) < 1e-2:
        raise RsbenchError(f"{where}: quaternion {q.tolist()} has length {length:g}, not 1")
    return from_quaternion(q)
