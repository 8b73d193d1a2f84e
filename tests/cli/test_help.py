"""Help and tables: every bracket is printed, every option is described, and no word of a table is broken."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Iterator
from typing import Any

import pytest
import typer
from commands import run_here
from hypothesis import given
from hypothesis import strategies as st

from rsbench.cli.console import print_rows, progress_bar
from rsbench.cli.main import app

_MARKUP = re.compile(r"(?<!\\)\[/?(bold|dim)\]")
"""The two styles that help texts use on purpose."""
_BRACKETED = re.compile(r"\[[^\]\s]*\]")


def commands(command: Any = None, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command of the application, with the words that call it."""
    command = typer.main.get_command(app) if command is None else command
    yield path, command
    for name, inner in getattr(command, "commands", {}).items():
        yield from commands(inner, (*path, name))


COMMANDS = dict(commands())


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_help_prints_every_bracket_that_its_texts_have(path: tuple[str, ...]) -> None:
    command = COMMANDS[path]
    texts = [command.help, command.epilog, *(option.help for option in command.params)]
    wanted = [word for text in texts if text for word in _BRACKETED.findall(_MARKUP.sub("", text))]
    printed = run_here(*path, "--help", COLUMNS="300").stdout
    for word in wanted:
        assert word in printed


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_every_command_and_option_says_what_it_does(path: tuple[str, ...]) -> None:
    command = COMMANDS[path]
    assert command.help
    assert not [option.name for option in command.params if not option.help]


_bracketed = st.text("[]/ab=#", min_size=1, max_size=12).map(lambda text: f"[{text}]")


@given(_bracketed, _bracketed, _bracketed)
def test_tables_print_brackets_as_they_are(title: str, column: str, cell: str) -> None:
    out = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out):
        patch.setenv("COLUMNS", "200")
        print_rows(title, ["first", column], [["wider-than-any-title", cell]])
    assert all(text in out.getvalue() for text in (title, column, cell))


def test_progress_prints_brackets_as_they_are(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    with progress_bar("rendering my[view]", 2) as advance:
        advance("a[0]")
        advance("[/bold]")
    printed = capsys.readouterr().err
    assert "my[view]" in printed and "[/bold]" in printed


COLUMNS = [
    "sequence",
    "solver",
    "assumes",
    "e_R (deg)",
    "e_T (deg)",
    "e_s",
    "inliers",
    "matches",
    "runs",
    "failures",
]
INTERVAL = "0.0035 [0.00345, 0.00352]"
ROWS = [
    [
        "castle",
        "rs-stereo-iterated-metric",
        "linear",
        INTERVAL,
        "0.159 [0.159, 0.163]",
        "0.0563",
        6021,
        6448,
        20,
        0,
    ],
    ["castle", "gs-8pt", "twist", "0.0072", "0.103", "", 2992, 3224, 20, 0],
]


@pytest.mark.parametrize("width", [60, 79, 80, 100, 117, 130, 200])
def test_no_word_is_broken_and_no_line_too_long(
    width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    print_rows("Relative pose", COLUMNS, ROWS, right=COLUMNS[6:])
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= width
    words = {word for row in [COLUMNS, *ROWS] for cell in row for word in str(cell).split()}
    assert words <= set(out.split())
    # Each part of a table that was cut has what tells its rows apart.
    assert out.count("rs-stereo-iterated-metric") == out.count("solver") == out.count("gs-8pt")


def test_what_is_redirected_is_never_cut(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    print_rows("Relative pose", COLUMNS, ROWS, right=COLUMNS[6:])
    out = capsys.readouterr().out
    assert INTERVAL in out and out.count("rs-stereo-iterated-metric") == 1


def test_tables_without_rows_or_room_end(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "12")
    print_rows("nothing", [], [])
    print_rows("no rows", ["a", "b"], [])
    print_rows("one word", ["a"], [["unbreakable-word-longer-than-the-terminal"]])
    assert "unbreakable" in capsys.readouterr().out.replace("\n", "").replace(" ", "")
