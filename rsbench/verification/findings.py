"""What verification says: reports, and the words of a finding."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Progress = Callable[[str], None]
"""Called with the name of the sequence after each step."""
_MOST_RUNS = 3
"""Runs of rows that a finding names one by one."""


@dataclass(frozen=True, kw_only=True)
class DepthAgreement:
    """How one depth map agrees with another."""

    source: str
    """File below the folder of the sequence, as ``target`` is."""
    target: str
    compared: int
    """Pixels on a locally flat surface that land on one in the target and are not plainly hidden there."""
    agreeing: int
    """Of these, within ``shots.DEPTH_TOLERANCE``."""
    typical: float
    """Median of the relative difference of the agreeing and near pixels."""
    p99: float
    """Its 99th percentile."""

    @property
    def share(self) -> float:
        return self.agreeing / self.compared if self.compared else 0.0


@dataclass(frozen=True, kw_only=True)
class SequenceReport:
    """What verification found in one sequence, or in dataset.json where ``name`` is that."""

    name: str
    faults: tuple[str, ...]
    """One line each: file, rows, size of the fault and its likely cause."""
    agreements: tuple[DepthAgreement, ...] = ()
    notes: tuple[str, ...] = ()
    """What could not be checked, and what was: no faults."""


def finding(file: str, what: str, rows: str = "", cause: str = "") -> str:
    """``file: rows 3-9: what (cause)``."""
    return f"{file}: {rows + ': ' if rows else ''}{what}{f' ({cause})' if cause else ''}"


def rows_of(flags: NDArray[np.bool_]) -> str:
    """Rows (H,) in words: "all rows", "rows 3-9, 12 and 40 more"; "" for none."""
    rows = np.flatnonzero(flags)
    if len(rows) == 0:
        return ""
    if len(rows) >= 0.9 * len(flags):
        return "all rows"
    runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
    shown = sorted(sorted(runs, key=len)[-_MOST_RUNS:], key=lambda run: int(run[0]))
    words = ", ".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in shown)
    left = len(rows) - sum(map(len, shown))
    return f"{'rows' if len(rows) > 1 else 'row'} {words}{f' and {left} more' if left else ''}"
