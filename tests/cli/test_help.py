"""What help and tables print is what was written: brackets are not taken for markup."""

from __future__ import annotations

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


def test_the_extra_that_the_viewer_needs_is_named() -> None:
    assert "'rsbench[view]'" in run_here("view", "--help", COLUMNS="200").stdout


_bracketed = st.text("[]/ab=#", min_size=1, max_size=12).map(lambda text: f"[{text}]")


@given(_bracketed, _bracketed, _bracketed)
def test_tables_print_brackets_as_they_are(title: str, column: str, cell: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", "200")
        out = _captured(lambda: print_rows(title, ["first", column], [["wider-than-any-title", cell]]))
    assert all(text in out for text in (title, column, cell))


def test_progress_prints_brackets_as_they_are(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    with progress_bar("rendering my[view]", 2) as advance:
        advance("a[0]")
        advance("[/bold]")
    told = capsys.readouterr().err
    assert "my[view]" in told and "[/bold]" in told


def _captured(action: Any) -> str:
    import contextlib
    import io

    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        action()
    return out.getvalue()
