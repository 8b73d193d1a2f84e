"""Small splits and predictions for the tests of the leaderboard."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from rsbench.benchmark.leaderboard.protocols import PROTOCOLS
from rsbench.benchmark.leaderboard.splits import Split, points_split
from rsbench.benchmark.leaderboard.submissions import truth_text

Line = dict[str, Any]


def small_split(problems: int = 12) -> Split:
    """The first problems of the public split of points."""
    split = points_split(PROTOCOLS["points"])
    return replace(split, truths=split.truths[:problems])


def truth_lines(split: Split) -> list[Line]:
    """The truth as a submission: header and answers."""
    return [json.loads(line) for line in truth_text(split).splitlines()]


def write(path: Path, lines: Iterable[Mapping[str, Any]]) -> Path:
    path.write_text("".join(json.dumps(line) + "\n" for line in lines), "utf-8")
    return path


def named(lines: list[Line], method: str, uses: tuple[str, ...] = ("left",)) -> list[Line]:
    """The same predictions by another method."""
    return [{**lines[0], "method": method, "uses": uses}, *lines[1:]]
