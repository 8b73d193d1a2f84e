"""Findings of verification, the line that is printed for each, and reports."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import wraps
from typing import NamedTuple, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError

Progress = Callable[[str], None]
"""Called with the name of the sequence after each step."""
_MOST_RUNS = 3
"""Number of row ranges that a finding names one by one."""


MISSING = "missing"
"""Words of the finding for a file that a manifest lists but that does not exist."""


@dataclass(frozen=True)
class Finding:
    """One fault of a dataset. ``str`` gives the line that is printed for it."""

    file: str
    """Path below the folder of the sequence; "" if ``words``, the text of an error, contain it."""
    words: str
    """The fault and its size."""
    rows: str = ""
    """Rows of the file, from ``rows_of``."""
    cause: str = ""
    """The likely cause."""
    part: str = ""
    """View, or pair of views, in a file that holds many."""
    check: str = field(default="", compare=False)
    """Name of the row of ``checks`` that found it."""

    @classmethod
    def of(cls, error: RsbenchError) -> Finding:
        """Make a finding from the error that a file cannot be read; its message contains the whole path."""
        return cls("", str(error))

    def __str__(self) -> str:
        """``file: part: rows 3-9: words (cause)``."""
        places = filter(None, (self.file, self.part, self.rows))
        return ": ".join((*places, self.words)) + (f" ({self.cause})" if self.cause else "")


@dataclass(frozen=True, kw_only=True)
class DepthAgreement:
    """How one depth map agrees with another."""

    source: str
    """Path below the folder of the sequence, like ``target``."""
    target: str
    compared: int
    """Pixels on a locally flat surface that land on one, or on none, in the target and are not clearly hidden."""
    agreeing: int
    """The number of these that agree within ``compiled_comparison.DEPTH_TOLERANCE``."""
    typical: float
    """Median relative difference of the compared pixels that land on a surface; NaN without any."""
    p99: float
    """Its 99th percentile."""

    @property
    def share(self) -> float:
        return self.agreeing / self.compared if self.compared else 0.0


@dataclass(frozen=True, kw_only=True)
class SequenceReport:
    """The findings in one sequence, or in dataset.json if that is the ``name``."""

    name: str
    findings: tuple[Finding, ...]
    agreements: tuple[DepthAgreement, ...] = ()
    notes: tuple[str, ...] = ()
    """What was checked in addition, or could not be checked; these are no faults."""

    @property
    def faults(self) -> tuple[str, ...]:
        """One line for each finding: file, rows, size of the fault and its likely cause."""
        return tuple(map(str, self.findings))


class Again(NamedTuple):
    """A file, or some of its rows, compared with a new computation."""

    file: str
    fault: Finding | None
    """None when they are alike."""
    same_bits: bool


_Args = ParamSpec("_Args")
_Found = TypeVar("_Found")


def reports_unreadable(check: Callable[_Args, Iterator[Finding]]) -> Callable[_Args, Iterator[Finding]]:
    """Wrap a check so that it ends with a finding at the first file that it cannot read."""

    @wraps(check)
    def run(*args: _Args.args, **options: _Args.kwargs) -> Iterator[Finding]:
        try:
            yield from check(*args, **options)
        except RsbenchError as error:
            yield Finding.of(error)

    return run


def skips_unreadable(check: Callable[_Args, Iterator[_Found]]) -> Callable[_Args, Iterator[_Found]]:
    """Wrap a check so that it ends at the first file that it cannot read, which another check has reported."""

    @wraps(check)
    def run(*args: _Args.args, **options: _Args.kwargs) -> Iterator[_Found]:
        with suppress(RsbenchError):
            yield from check(*args, **options)

    return run


def files_of(findings: Iterable[Finding]) -> set[str]:
    """Return the files that findings name."""
    return {each.file for each in findings}


def cheapest_cause(costs: Mapping[str, float], as_is: float, share: float = 0.2) -> str:
    """Describe what a file looks like, by the difference that undoing each candidate change leaves; "" for none.

    The best candidate must leave less than this ``share`` of the difference ``as_is``.
    """
    best = min(costs, key=costs.__getitem__)
    return f"looks {best}" if best and costs[best] < share * as_is else ""


def rows_with_most(wrong: NDArray[np.bool_], stride: int = 1, height: int | None = None) -> str:
    """Describe the rows with more than half as many wrong pixels (h, w) as the worst row.

    ``wrong`` has every ``stride``-th row of an image of this ``height``.
    """
    share = np.mean(wrong, axis=1)
    return rows_of(np.repeat(share > 0.5 * np.max(share), stride)[:height])


def rows_of(flags: NDArray[np.bool_]) -> str:
    """Describe rows (H,) in words: "all rows", "rows 3-9, 12 and 40 more"; "" for none."""
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
