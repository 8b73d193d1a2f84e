"""What became of each claim of the paper's simulation section: verdicts by rule from stored summaries.

The paper's text makes claims about noise, velocity, readout ratio and baseline (section 3.1), and that nine
matches per camera suffice (section 2.2). Each has a rule here that turns the figures of a solver, and of the
global-shutter eight-point algorithm it is compared with, into "holds", "fails" or "holds only if ...".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import pandas as pd

from rsbench.errors import RsbenchError

PUBLISHED, OURS, GLOBAL = "rs-stereo-linear", "rs-stereo-refined-pairs", "gs-8pt"
MEASURES = ("e_R", "e_T")
READINGS = {"1e-3 px": 1e-3, "0.81 px": 0.81}
"""Variants of the sweeps that read the paper's noise of 10^-3 in pixels, and on the normalised image plane."""
Centre = Literal["mean", "median"]
LARGEST_BASELINE_RATIO = 1.25
SUFFICIENT_SHARE = 0.9


class Figure(NamedTuple):
    """A statistic with its 95 % interval; NaN where the matches do not determine it."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        if math.isnan(self.value):
            return "not observable"
        return f"{self.value:.3g} [{self.low:.3g}, {self.high:.3g}]"


@dataclass(frozen=True)
class Series:
    """Figures over the values of a sweep, in order of the values."""

    values: tuple[float, ...]
    figures: Mapping[str, tuple[Figure, ...]]
    """``e_R`` and ``e_T`` in degrees, and ``solved``, the share of the trials."""

    def __getitem__(self, measure: str) -> tuple[Figure, ...]:
        return self.figures[measure]

    def at(self, k: int, measures: Sequence[str]) -> str:
        """The figures at the k-th value in words."""
        return f"{self.values[k]:g}: " + ", ".join(f"{name} {self.figures[name][k]}" for name in measures)


class Check(NamedTuple):
    """Whether a claim holds at one value of the axis, or for one quantity."""

    label: str
    holds: bool
    value: float | None = None
    """Value of the axis, where the checks go over values."""


@dataclass(frozen=True, kw_only=True)
class Claim:
    """A claim, where it is tested, and the rule."""

    key: str
    text: str
    """The paper's words."""
    sweep: str
    axis: str
    rule: str
    """The rule in words."""
    check: Callable[[Series, Series], list[Check]]
    """Of the solver's figures and the eight-point algorithm's."""
    measures: tuple[str, ...] = MEASURES
    """Figures that tables show."""


def series(table: pd.DataFrame, solver: str, variant: str, centre: Centre) -> Series:
    """Figures of a solver in one variant of a summary.

    Raises:
        RsbenchError: the summary does not have them.
    """
    rows = table[(table.solver == solver) & (table.variant == variant)].sort_values("value")
    if rows.empty:
        raise RsbenchError(f"the summary holds no rows of solver {solver!r} and variant {variant!r}")
    columns = {
        "e_R": [f"e_R_{centre}", f"e_R_{centre}_low", f"e_R_{centre}_high"],
        "e_T": [f"e_T_{centre}", f"e_T_{centre}_low", f"e_T_{centre}_high"],
        "solved": ["success_share", "success_low", "success_high"],
    }
    figures = {
        name: tuple(Figure(*map(float, numbers)) for numbers in rows[keys].to_numpy())
        for name, keys in columns.items()
    }
    return Series(tuple(map(float, rows.value)), figures)


def verdict(checks: Sequence[Check], axis: str) -> str:
    """ "holds", "fails" or "holds only if ...": the values, or the quantities, for which it does."""
    good = [check for check in checks if check.holds]
    if len(good) == len(checks):
        return "holds"
    if not good:
        return "fails"
    if any(check.value is None for check in checks):
        return f"holds only for {', '.join(check.label for check in good)}"
    values = [check.value for check in good if check.value is not None]
    if good == list(checks[: len(good)]):
        return f"holds only if {axis} <= {values[-1]:g}"
    if good == list(checks[-len(good) :]):
        return f"holds only if {axis} >= {values[0]:g}"
    return f"holds only if {axis} is {', '.join(f'{value:g}' for value in values)}"


def better(a: Figure, b: Figure) -> bool:
    """Smaller, and the intervals do not overlap; what can be observed is better than what cannot."""
    return a.high < b.low or (math.isnan(b.value) and not math.isnan(a.value))


def small_increase(ours: Series, other: Series) -> list[Check]:
    """At each value but the smallest, errors have risen by no more than the other's errors at the smallest."""
    return [
        Check(f"{value:g}", all(ours[m][k].value - ours[m][0].value <= other[m][0].value for m in MEASURES), value)
        for k, value in enumerate(ours.values)
        if k > 0
    ]


def always_better(ours: Series, other: Series) -> list[Check]:
    """At each value both errors are smaller than the eight-point algorithm's."""
    return [
        Check(f"{value:g}", all(better(ours[m][k], other[m][k]) for m in MEASURES), value)
        for k, value in enumerate(ours.values)
    ]


def more_stable(ours: Series, other: Series) -> list[Check]:
    """Per error: its range over the values is smaller than the eight-point algorithm's."""
    return [Check(m, _range(ours[m]) < _range(other[m])) for m in MEASURES]


def both_grow(ours: Series, other: Series) -> list[Check]:
    """Per solver and error: larger at the last value than at the first."""
    sides = (("RS", ours), ("GS", other))
    return [Check(f"{m} of {who}", better(s[m][0], s[m][-1])) for who, s in sides for m in MEASURES]


def hardly_changes(ours: Series, other: Series) -> list[Check]:
    """Per error: the largest is at most 1.25 times the smallest, or their intervals overlap."""
    checks = []
    for m in MEASURES:
        figures = sorted(ours[m], key=lambda figure: figure.value)
        small, large = figures[0], figures[-1]
        same = large.value <= LARGEST_BASELINE_RATIO * small.value or not better(small, large)
        checks.append(Check(m, same))
    return checks


def enough_solved(ours: Series, other: Series) -> list[Check]:
    """At each value the lower end of the share of solved trials is at least ``SUFFICIENT_SHARE``."""
    return [
        Check(f"{value:g}", ours["solved"][k].low >= SUFFICIENT_SHARE, value)
        for k, value in enumerate(ours.values)
    ]


def _range(figures: Sequence[Figure]) -> float:
    values = [figure.value for figure in figures]
    return math.inf if any(map(math.isnan, values)) else max(values) - min(values)


_VELOCITY = "Section 3.1: at every velocity the RS solver beats the GS one, in rotation as in translation"
_STABLE = "Section 3.1: as velocity grows, the errors of the RS solver stay steadier than those of the GS one"
_BETTER = "e_R and e_T both below those of gs-8pt, 95 % intervals apart, at each value"
_RANGE = "largest minus smallest error over the sweep (deg) below that of gs-8pt, for e_R and e_T"
CLAIMS = (
    Claim(
        key="noise: tiny increase",
        text="Section 3.1: errors grow with the noise, but only a little",
        sweep="noise",
        axis="noise_px",
        rule="from the smallest noise to each level up to the reading, e_R and e_T rise by no more than the error "
        "that gs-8pt has at the smallest noise: what ignoring the rolling shutter costs",
        check=small_increase,
    ),
    Claim(
        key="rotation velocity: better than GS",
        text=_VELOCITY,
        sweep="rotation",
        axis="rotation_deg",
        rule=_BETTER,
        check=always_better,
    ),
    Claim(
        key="translation velocity: better than GS",
        text=_VELOCITY,
        sweep="translation",
        axis="translation",
        rule=_BETTER,
        check=always_better,
    ),
    Claim(
        key="rotation velocity: more stable",
        text=_STABLE,
        sweep="rotation",
        axis="rotation_deg",
        rule=_RANGE,
        check=more_stable,
    ),
    Claim(
        key="translation velocity: more stable",
        text=_STABLE,
        sweep="translation",
        axis="translation",
        rule=_RANGE,
        check=more_stable,
    ),
    Claim(
        key="readout ratio: both grow",
        text="Section 3.1: the errors of both solvers grow with the readout ratio",
        sweep="readout",
        axis="readout_ratio",
        rule="e_R and e_T of both at phi = 1 above those at phi = 0.2, 95 % intervals apart",
        check=both_grow,
    ),
    Claim(
        key="readout ratio: GS gets higher errors",
        text="Section 3.1: at every readout ratio the GS solver errs more",
        sweep="readout",
        axis="readout_ratio",
        rule=_BETTER,
        check=always_better,
    ),
    Claim(
        key="baseline: no impact",
        text="Section 3.1: the length of the baseline hardly matters",
        sweep="baseline",
        axis="baseline",
        rule=f"largest error over the sweep at most {LARGEST_BASELINE_RATIO:g} times the smallest, or their 95 % "
        "intervals overlap, for e_R and e_T",
        check=hardly_changes,
    ),
    Claim(
        key="nine matches per camera suffice",
        text="Abstract and section 2.2: nine matches of each camera over time are enough",
        sweep="points",
        axis="points",
        rule=f"at least {100 * SUFFICIENT_SHARE:g} % of the trials solved (e_R < 1 deg and e_T < 5 deg), by the "
        "lower end of the 95 % interval",
        check=enough_solved,
        measures=("solved",),
    ),
)


def judge_claims(tables: Mapping[str, Mapping[str, pd.DataFrame]]) -> pd.DataFrame:
    """One row per claim, number of matches, reading of the noise, statistic and solver.

    Args:
        tables: summaries of sweeps, by the matches that solvers were given ("9 + 9") and the name of the sweep.

    Raises:
        RsbenchError: a summary lacks a solver or a variant.
    """
    rows = []
    for claim in CLAIMS:
        for matches, sweeps in tables.items():
            for noise in READINGS if claim.sweep in sweeps else ():
                rows += _judge(claim, sweeps[claim.sweep], matches, noise)
    return pd.DataFrame(rows)


def _judge(claim: Claim, table: pd.DataFrame, matches: str, noise: str) -> list[dict[str, str]]:
    rows = []
    variant = noise
    if claim.sweep == "noise":
        table, variant = table[table.value <= READINGS[noise]], str(table.variant.iloc[0])
    centres: tuple[Centre, ...] = ("mean", "median")
    for centre in centres if claim.measures == MEASURES else centres[:1]:
        other = series(table, GLOBAL, variant, centre)
        for solver in (PUBLISHED, OURS):
            figures = series(table, solver, variant, centre)
            rows.append(
                {
                    "claim": claim.key,
                    "matches": matches,
                    "noise": noise,
                    "statistic": centre if claim.measures == MEASURES else "share",
                    "solver": solver,
                    "verdict": verdict(claim.check(figures, other), claim.axis),
                    "axis": claim.axis,
                    "first": figures.at(0, claim.measures),
                    "last": figures.at(-1, claim.measures),
                    "gs_first": other.at(0, claim.measures),
                    "gs_last": other.at(-1, claim.measures),
                }
            )
    return rows
