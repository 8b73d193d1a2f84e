"""Programs beside the package as modules, for tests of their parts, and Python in a process of its own."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType, ModuleType

ROOT = Path(__file__).parents[1]


def program(file: str) -> ModuleType:
    """A file of the repository, run as an import."""
    path = ROOT / file
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run_python(
    *words: object,
    folder: Path | None = None,
    path: Iterable[Path] = (),
    environment: Mapping[str, str | None] = MappingProxyType({}),
) -> subprocess.CompletedProcess[str]:
    """Another Python with these arguments, in a folder; ``path`` comes before our own path.

    Variables of ``environment`` are set, or absent (None).
    """
    places = os.pathsep.join([*map(str, path), *filter(None, sys.path)])
    variables = {**os.environ, "PYTHONPATH": places, **environment}
    return subprocess.run(
        [sys.executable, *map(str, words)],
        cwd=folder,
        env={name: value for name, value in variables.items() if value is not None},
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )


def is_running(pid: int) -> bool:
    """Whether a process runs; one that has ended may wait for its parent."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
