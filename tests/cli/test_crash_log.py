"""What nobody foresaw is one line with a log; where results cannot go is said before the work, not after it."""

from __future__ import annotations

import errno
import os
import sys
from pathlib import Path
from typing import Any

import pytest
from commands import assert_refused, run_here

from rsbench.cli import exits, main


def run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: BaseException
) -> tuple[int, str]:
    def fail(**options: Any) -> None:
        raise error

    monkeypatch.setattr(main, "app", fail)
    with pytest.raises(SystemExit) as caught:
        main.run()
    assert isinstance(caught.value.code, int)
    (line,) = capsys.readouterr().err.splitlines()
    return caught.value.code, line


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(sys, "argv", ["rsbench", "list"])
    return tmp_path / "cache"


def test_an_unknown_error_is_one_line_with_a_log(
    cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(cache.parent)
    code, line = run(monkeypatch, capsys, ZeroDivisionError("a bug\nof ours"))
    assert code == 70
    assert "a fault of rsbench, not yours: ZeroDivisionError: a bug of ours; what led to it: " in line
    log = Path(line.rpartition("what led to it: ")[2])
    assert log.is_relative_to(cache)
    text = log.read_text("utf-8")
    assert "Traceback" in text and "in fail" in text and "['rsbench', 'list']" in text
    assert [path.name for path in cache.parent.iterdir()] == ["cache"]


@pytest.mark.parametrize(
    ("number", "place"),
    [(errno.ENOSPC, "standard output: "), (errno.ENOENT, "the working folder, which must exist: ")],
)
def test_what_has_no_name_is_named(
    number: int, place: str, cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A full disk behind standard output, or a working folder that was removed: a user's, and no log."""
    code, line = run(monkeypatch, capsys, OSError(number, os.strerror(number)))
    assert (code, line) == (2, f"rsbench: error: {place}{os.strerror(number)}")
    assert not cache.exists()


def test_logs_do_not_pile_up(cache: Path) -> None:
    for _ in range(25):
        exits.describe(ValueError())
    assert len(list((cache / "rsbench" / "faults").iterdir())) == 20


def test_without_a_place_for_a_log_the_line_stays(
    cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cache.write_text("no folder")
    monkeypatch.setattr(exits, "temporary", lambda: None)
    code, line = run(monkeypatch, capsys, RecursionError("too deep"))
    assert code == 70 and "RecursionError: too deep; no log of it could be written" in line


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (MemoryError(), 1, "not enough memory"),
        (PermissionError(errno.EACCES, "Permission denied", "/x"), 2, "rsbench: error: /x: Permission denied"),
        (OSError(errno.EBADF, "Bad file descriptor"), 70, "the system refused: OSError: [Errno 9] Bad file"),
    ],
)
def test_errors_of_the_system(
    cache: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    error: Exception,
    code: int,
    words: str,
) -> None:
    found, line = run(monkeypatch, capsys, error)
    assert found == code and words in line and "file system:" not in line


def test_a_long_message_keeps_its_file_and_its_remedy(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main._fail("x.toml: " + "long " * 10_000 + "do this instead")
    line = capsys.readouterr().err
    assert len(line) < 2100 and line.startswith("rsbench: error: x.toml: ") and line.endswith("do this instead\n")


@pytest.mark.parametrize(
    "command", [("generate", "smoke"), ("reproduce", "fig4"), ("simulate", "noise"), ("demo",)], ids=lambda c: c[0]
)
def test_a_folder_that_cannot_be_written_is_said_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
) -> None:
    def work(*arguments: object, **options: object) -> None:
        raise AssertionError("the work had begun")

    monkeypatch.setattr("rsbench.renderers.backend.start_backend", work)
    monkeypatch.setattr("rsbench.dataset.generation.load_scene", work)
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        result = run_here(*command, "--out", out)
        assert_refused(result, "file")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("evaluate", "--out-of"), "No such option: --out-of"),
        (("generate",), "Missing argument 'card'; see rsbench generate --help"),
        (("simulate", "noise", "--trials", "x"), "Invalid value for '--trials'"),
        (("leaderboard", "submit"), "see rsbench leaderboard submit --help"),
        (("bogus",), "No such command 'bogus'; see rsbench --help"),
    ],
)
def test_wrong_words_are_refused_in_one_line_with_the_help_to_read(words: tuple[str, ...], said: str) -> None:
    result = run_here(*words)
    (line,) = result.stderr.splitlines()
    assert result.returncode == 2 and line.startswith("rsbench: error: ") and said in line
