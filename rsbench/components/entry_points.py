"""Entry points of installed packages, and whose they are; read from disk once: there may be dozens."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Sequence
from functools import lru_cache
from importlib import metadata


def entry_points_by_name(group: str) -> dict[str, list[metadata.EntryPoint]]:
    """Entry points of a group; of one name more than one, where they differ. Loads nothing."""
    found: dict[str, list[metadata.EntryPoint]] = {}
    for point in points_of(group, tuple((folder, _changed(folder)) for folder in sys.path)):
        same = found.setdefault(point.name, [])
        if all(other.value != point.value for other in same):
            same.append(point)
    return found


def package_of(point: metadata.EntryPoint) -> str:
    """The package's name."""
    try:
        name = point.dist.name if point.dist is not None else None
    except Exception:  # files about the package are missing or cannot be read
        name = None
    return name or "a package"


@lru_cache(maxsize=16)
def points_of(group: str, folders: tuple[tuple[str, int], ...]) -> Sequence[metadata.EntryPoint]:
    """Entry points of a group while ``folders``, those of ``sys.path`` and when they changed, stay the same.

    A package whose files about itself cannot be read has none, and stops no other.
    """
    try:
        return tuple(metadata.entry_points(group=group))
    except Exception:
        points, seen = list[metadata.EntryPoint](), set[str]()
        for package in metadata.distributions():
            with contextlib.suppress(Exception):
                if (name := str(package.metadata["Name"]).lower()) not in seen:
                    points += [point for point in package.entry_points if point.group == group]
                    seen.add(name)
        return points


def _changed(folder: str) -> int:
    """When something was last put into a folder, or taken out; ns."""
    try:
        return os.stat(folder or ".").st_mtime_ns
    except OSError:
        return 0
