"""Rules that turn the figures of a solver, and of what it is compared with, into a verdict.

They look at 95 % intervals: what is said to be better must have an interval apart, and what is said not to change
must stay within a margin that was fixed before, with its interval (an equivalence test). What neither holds nor
fails by its intervals is undecided.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

import pandas as pd

from rsbench.benchmark.statistics import in_words, share_interval
from rsbench.core.errors import RsbenchError

MEASURES = ("e_R", "e_T")
Centre = Literal["mean", "median"]
TINY = 0.25
"""Margin of an increase, as a share of what the eight-point algorithm errs without noise."""
UNCHANGED = 1.5
"""Margin of no change, as the quotient of the largest error and the smallest."""
SUFFICIENT_SHARE, UNIQUE_SHARE = 0.9, 0.95
SCALE_MARGIN = 0.1
"""Margin of a known scale: the median of abs(log(estimated / true length of d))."""


class Figure(NamedTuple):
    """A statistic with its 95 % interval, of no width where it is exact; NaN where the matches do not tell it."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        if math.isnan(self.value):
            return "not observable"
        return f"{self.value:.3g}" if self.low == self.high else in_words(*self)


class Check(NamedTuple):
    """Whether a claim holds at one value of the axis, or for one quantity; None: the intervals leave it open."""

    label: str
    holds: bool | None
    value: float | None = None
    """Value of the axis, where the checks go over values."""


@dataclass(frozen=True)
class Series:
    """Figures over the values of a sweep, in order of the values."""

    values: tuple[float, ...]
    figures: Mapping[str, tuple[Figure, ...]]
    """``e_R`` and ``e_T`` in degrees, their root mean squares ``rms_R`` and ``rms_T`` with the bounds ``bound_R``
    and ``bound_T`` of these, the median ``e_s``, and the shares of the trials ``solved`` and ``answered``."""
    labels: tuple[str, ...] = ()
    """Names of the values where these are no numbers."""

    def __getitem__(self, measure: str) -> tuple[Figure, ...]:
        return self.figures[measure]

    def at(self, k: int, measures: Sequence[str]) -> str:
        """The figures at the k-th value in words."""
        where = self.labels[k] if self.labels else f"{self.values[k]:g}"
        return f"{where}: " + ", ".join(f"{name} {self.figures[name][k]}" for name in measures)

    def checks(self, holds: Sequence[bool | None], first: int = 0) -> list[Check]:
        """One check per value from the first on."""
        if self.labels:
            return [Check(label, good) for label, good in zip(self.labels[first:], holds, strict=True)]
        return [Check(f"{v:g}", good, v) for v, good in zip(self.values[first:], holds, strict=True)]


def series(table: pd.DataFrame, solver: str, variant: str, centre: Centre) -> Series:
    """Figures of a solver in one variant of a summary.

    Raises:
        RsbenchError: the summary does not have them.
    """
    rows = table[(table.solver == solver) & (table.variant == variant)].sort_values("value")
    if rows.empty:
        raise RsbenchError(f"the summary holds no rows of solver {solver!r} and variant {variant!r}")
    ends = ("", "_low", "_high")
    columns = {
        **{name: [f"{name}_{centre}{end}" for end in ends] for name in MEASURES},
        "e_s": [f"e_s_median{end}" for end in ends],
        "solved": ["success_share", "success_low", "success_high"],
    }
    figures = {
        name: tuple(Figure(*map(float, numbers)) for numbers in rows[keys].to_numpy(dtype=float))
        for name, keys in columns.items()
    }
    for letter in "RT":
        bounds = rows[f"e_{letter}_bound"].to_numpy(dtype=float)
        quotients = rows[[f"e_{letter}_over_bound{end}" for end in ends]].to_numpy(dtype=float)
        figures[f"rms_{letter}"] = tuple(Figure(*map(float, row)) for row in bounds[:, None] * quotients)
        figures[f"bound_{letter}"] = tuple(Figure(*[float(bound)] * 3) for bound in bounds)
    answered = [(int(n), int(n - f)) for n, f in zip(rows.trials, rows.failures, strict=True)]
    figures["answered"] = tuple(Figure(good / n, *share_interval(good, n)) for n, good in answered)
    labels = tuple(map(str, rows.label)) if "label" in rows else ()
    return Series(tuple(map(float, rows.value)), figures, labels)


def verdict(checks: Sequence[Check], axis: str) -> str:
    """ "holds", "fails", "undecided" or where which of them: at values of the axis, or for quantities."""
    parts = {
        word: [check for check in checks if check.holds is holds]
        for word, holds in (("holds", True), ("undecided", None), ("fails", False))
    }
    present = {word: part for word, part in parts.items() if part}
    if len(present) == 1:
        return next(iter(present))
    shown = [word for word in ("holds", "undecided") if word in present]
    return "; ".join(
        f"{word}{' only' if word == 'holds' else ''} {_where(present[word], checks, axis)}" for word in shown
    )


def _where(good: Sequence[Check], checks: Sequence[Check], axis: str) -> str:
    values = [check.value for check in good if check.value is not None]
    if len(values) < len(good):
        return f"for {', '.join(check.label for check in good)}"
    if list(good) == list(checks[: len(good)]):
        return f"if {axis} <= {values[-1]:g}"
    if list(good) == list(checks[-len(good) :]):
        return f"if {axis} >= {values[0]:g}"
    return f"if {axis} is {', '.join(f'{value:g}' for value in values)}"


def better(a: Figure, b: Figure) -> bool | None:
    """Smaller or not; None when the intervals overlap. What can be observed is better than what cannot."""
    if math.isnan(a.value) or math.isnan(b.value):
        return None if math.isnan(a.value) and math.isnan(b.value) else math.isnan(b.value)
    return True if a.high < b.low else False if b.high < a.low else None


def within(low: float, high: float, margin: float) -> bool | None:
    """Whether an interval lies below a margin; None when it lies across."""
    return True if high <= margin else False if low > margin else None


def all_of(parts: Sequence[bool | None]) -> bool | None:
    """False if one fails, None if one is undecided."""
    return False if False in parts else None if None in parts else True


def small_increase(ours: Series, other: Series) -> list[Check]:
    """At each value but the smallest, errors have risen by less than ``TINY`` of the other's at the smallest."""
    later = range(1, len(ours.values))
    rises = [[_rise(ours[m], k, TINY * other[m][0].value) for m in MEASURES] for k in later]
    return ours.checks([all_of(rise) for rise in rises], 1)


def _rise(figures: Sequence[Figure], k: int, margin: float) -> bool | None:
    first, now = figures[0], figures[k]
    return within(now.low - first.high, now.high - first.low, margin)


def always_better(ours: Series, other: Series) -> list[Check]:
    """At each value both errors are smaller than the other's."""
    return _at_each(ours, other, better)


def more_stable(ours: Series, other: Series) -> list[Check]:
    """Per error: its range over the values is smaller than the other's."""
    return [Check(m, better(_range(ours[m]), _range(other[m]))) for m in MEASURES]


def both_grow(ours: Series, other: Series) -> list[Check]:
    """Per solver and error: larger at the last value than at the first, and nowhere falling."""
    sides = (("RS", ours), ("GS", other))
    return [Check(f"{m} of {who}", _grows(s[m])) for who, s in sides for m in MEASURES]


def _grows(figures: Sequence[Figure]) -> bool | None:
    falls = any(better(b, a) for a, b in pairwise(figures))
    return False if falls else better(figures[0], figures[-1])


def hardly_changes(ours: Series, other: Series) -> list[Check]:
    """Per error: the largest is at most ``UNCHANGED`` times the smallest."""
    checks = []
    for m in MEASURES:
        small, large = (extreme(ours[m], key=lambda figure: figure.value) for extreme in (min, max))
        low, high = large.low / max(small.high, 1e-300), large.high / max(small.low, 1e-300)
        checks.append(Check(m, within(low, high, UNCHANGED)))
    return checks


def no_worse(ours: Series, other: Series) -> list[Check]:
    """At each value both errors are at most ``UNCHANGED`` times the other's."""
    return _at_each(ours, other, _quotient)


def _at_each(ours: Series, other: Series, holds: Callable[[Figure, Figure], bool | None]) -> list[Check]:
    places = range(len(ours.values))
    return ours.checks([all_of([holds(ours[m][k], other[m][k]) for m in MEASURES]) for k in places])


def _quotient(a: Figure, b: Figure) -> bool | None:
    return within(a.low / max(b.high, 1e-300), a.high / max(b.low, 1e-300), UNCHANGED)


def enough_solved(ours: Series, other: Series) -> list[Check]:
    """At each value the share of solved trials is at least ``SUFFICIENT_SHARE``."""
    return ours.checks([_at_least(share, SUFFICIENT_SHARE) for share in ours["solved"]])


def one_solution(ours: Series, other: Series) -> list[Check]:
    """At each value the share of trials with one solution is at least ``UNIQUE_SHARE``."""
    return ours.checks([_at_least(share, UNIQUE_SHARE) for share in ours["answered"]])


def scale_known(ours: Series, other: Series) -> list[Check]:
    """At each value the median of e_s is at most ``SCALE_MARGIN``."""
    known = [not math.isnan(f.value) and within(f.low, f.high, SCALE_MARGIN) for f in ours["e_s"]]
    return ours.checks(known)


def beats_one_camera(ours: Series, other: Series) -> list[Check]:
    """Per error at the first value: root mean square below the bound of the other's matches, of one camera."""
    return [Check(f"e_{m}", better(ours[f"rms_{m}"][0], other[f"bound_{m}"][0])) for m in "RT"]


def _at_least(share: Figure, least: float) -> bool | None:
    return True if share.low >= least else False if share.high < least else None


def _range(figures: Sequence[Figure]) -> Figure:
    values = [figure.value for figure in figures]
    if any(map(math.isnan, values)):
        return Figure(math.inf, math.inf, math.inf)
    small, large = (extreme(figures, key=lambda figure: figure.value) for extreme in (min, max))
    return Figure(large.value - small.value, max(large.low - small.high, 0.0), large.high - small.low)
