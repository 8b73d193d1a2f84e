"""The command line in this process: all that a new one would show, without the second or two of its start.

New processes are for what needs one: packages beside it, signals, the terminal, what is imported, and what
children print. That every command starts in one: tests/test_installed_wheel.py and tests/third_party.
"""

from __future__ import annotations

import contextlib
import functools
import io
import itertools
import json
import os
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NoReturn

import pytest
from typer.main import get_command

from rsbench.cli import console, exits, main
from rsbench.core.errors import RsbenchError


def run_here(*arguments: object, text: str = "", **environment: str) -> subprocess.CompletedProcess[str]:
    """Run ``rsbench`` with these arguments, ``text`` on standard input and these variables of the environment.

    A warning is an error here, and whatever the command does not answer in one line is raised.
    """
    words = ["rsbench", *map(str, arguments)]
    out, err, code = io.StringIO(), io.StringIO(), 0
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        patch.setattr(sys, "argv", words)
        if not environment:  # the options are made of some of it
            patch.setattr(main, "app", _command())
        patch.setattr(exits, "describe", _raise)
        patch.setattr(sys, "stdin", io.StringIO(text))
        for name, value in environment.items():
            patch.setenv(name, value)
        try:
            main.run()
        except SystemExit as end:
            assert end.code is None or isinstance(end.code, int)
            code = end.code or 0
        finally:
            console.be_quiet(False)
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


def run_apart(
    *arguments: object, path: Path | None = None, **environment: str
) -> subprocess.CompletedProcess[str]:
    """Run ``rsbench`` in a new process, which finds the packages in ``path``."""
    variables = os.environ | environment
    if path is not None:
        variables["PYTHONPATH"] = os.pathsep.join([str(path), *filter(None, [variables.get("PYTHONPATH")])])
    command = [sys.executable, "-m", "rsbench", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, env=variables)


@functools.cache
def _command() -> Callable[..., object]:
    """Commands with their options, which Typer makes anew at each call of an app."""
    return get_command(main.app)


def _raise(error: Exception) -> NoReturn:
    raise error


def sweep_card(
    solvers: Sequence[str], *, noise_px: Sequence[float], trials: int, name: str = "mine", more: str = ""
) -> str:
    """The text of a card for ``rsbench simulate`` whose trials are small; ``more`` is appended to the setting."""
    return (
        f'name = {json.dumps(name)}\naxis = "noise_px"\nvalues = {list(noise_px)}\n'
        f"solvers = {json.dumps(list(solvers))}\ntrials = {trials}\n[setting]\n"
        "width = 640\nheight = 480\nfocal = 500.0\nbaseline = 0.2\nreadout_ratio = 0.5\npoints = 30\n"
        f"depth = [2.0, 5.0]\nrotation_deg = 1.0\ntranslation = 0.1\nnoise_px = 0.0\n{more}"
    )


def assert_refused(result: subprocess.CompletedProcess[str], *words: str) -> None:
    """Bad input: exit code 2, and one line on standard error that holds the words."""
    assert result.returncode == 2, result.stderr
    assert "Traceback" not in result.stderr
    (line,) = [line for line in result.stderr.splitlines() if "rsbench: error:" in line]
    for word in words:
        assert word in line, line


@contextlib.contextmanager
def refused(*words: str, match: str | None = None) -> Iterator[None]:
    """What is called inside raises an error of one line that holds the words and matches the pattern."""
    with pytest.raises(RsbenchError, match=match) as caught:
        yield
    line = str(caught.value)
    assert "\n" not in line
    for word in words:
        assert word in line, line


def bytes_below(folder: Path, *without: str) -> dict[str, bytes]:
    """Every file below a folder by its path there, except those with a file's or folder's name in ``without``."""
    files = ((path.relative_to(folder), path) for path in sorted(folder.rglob("*")) if path.is_file())
    return {place.as_posix(): path.read_bytes() for place, path in files if not {*without} & {*place.parts}}


def install_package(folder: Path, name: str, points: str) -> None:
    """Metadata of an installed package in a folder of ``sys.path``; ``points`` are its entry points."""
    info = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n", "utf-8")
    (info / "entry_points.txt").write_text(points, "utf-8")


def install_project(folder: Path) -> None:
    """Metadata of the package that pyproject.toml in a folder of ``sys.path`` describes."""
    project = tomllib.loads((folder / "pyproject.toml").read_text("utf-8"))["project"]
    tables = [
        "\n".join([f"[{group}]", *(f"{name} = {value}" for name, value in points.items())])
        for group, points in project["entry-points"].items()
    ]
    install_package(folder, project.get("name", "documented"), "\n".join(tables) + "\n")


def rename_failing(
    fails: Callable[[int], bool], error: BaseException | None = None
) -> Callable[[Path, Path], None]:
    """``os.rename``, which raises an error at some calls, counted from 1; by default that of a disk."""
    real, calls = os.rename, itertools.count(1)

    def rename(source: Path, target: Path) -> None:
        if fails(next(calls)):
            raise error or OSError(5, "Input/output error")
        real(source, target)

    return rename
