"""Tables on terminals of any width: what they say can be read."""

from __future__ import annotations

import pytest

from rsbench.cli.console import print_rows

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
