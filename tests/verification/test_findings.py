"""Findings of verification as values, and the line that is printed of each."""

from __future__ import annotations

import pytest

from rsbench.core.errors import RsbenchError
from rsbench.verification.findings import Finding

LINES = [
    (Finding("rs/left_0.png", "missing"), "rs/left_0.png: missing"),
    (Finding("a.exr", "is off", "rows 3-9", "zeroed"), "a.exr: rows 3-9: is off (zeroed)"),
    (Finding("tracks.npz", "has no points", part="left_0"), "tracks.npz: left_0: has no points"),
    (Finding.of(RsbenchError("data/a.png: damaged")), "data/a.png: damaged"),
]


@pytest.mark.parametrize(("finding", "line"), LINES)
def test_the_printed_line(finding: Finding, line: str) -> None:
    assert str(finding) == line


def test_two_checks_that_find_the_same_find_it_once() -> None:
    found = (Finding("a", "is off", check=name) for name in ("depth", "colours"))
    assert len(set(found)) == 1
