"""Verdicts on the paper's claims about simulated points and images, computed by rules from stored tables.

The paper's description of its solver is ambiguous in places, so each claim has a verdict for each reading
(``Reading``); it is refuted only if the most favourable reading fails.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from itertools import pairwise, product
from pathlib import Path
from typing import Any, Literal, NamedTuple

import pandas as pd

from rsbench.benchmark.simulated.sweep_card import SweepCard, Variant
from rsbench.benchmark.statistics import format_interval, median_and_quartiles, share_interval
from rsbench.benchmark.studies import fig4_panels
from rsbench.core.errors import RsbenchError
from rsbench.jobs.isolation import one_line
from rsbench.storage.files import write_bytes

MEASURES = ("e_R", "e_T")
Centre = Literal["mean", "median"]
TINY = 0.25
"""Limit of a small increase, as a share of the eight-point algorithm's error without noise."""
UNCHANGED = 1.5
"""Limit of the ratio of two errors that count as equal."""
SUFFICIENT_SHARE, UNIQUE_SHARE = 0.9, 0.95
SCALE_MARGIN = 0.1
"""Limit of the median of abs(log(estimated / true length of d)) if the scale counts as known."""


class Figure(NamedTuple):
    """A statistic with its 95 % interval, which has the width 0 if it is exact; NaN if it is not observable."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        if math.isnan(self.value):
            return "not observable"
        return f"{self.value:.3g}" if self.low == self.high else format_interval(*self)


class Check(NamedTuple):
    """Result of a claim at one value of the axis, or for one quantity; None: undecided."""

    label: str
    holds: bool | None
    value: float | None = None
    """Value of the axis, if there is one check per value."""


@dataclass(frozen=True)
class Series:
    """Figures for the values of a sweep, sorted by value."""

    values: tuple[float, ...]
    figures: Mapping[str, tuple[Figure, ...]]
    """``e_R`` and ``e_T`` in degrees; their root mean squares ``rms_R`` and ``rms_T`` and the bounds ``bound_R``
    and ``bound_T`` of these; the median ``e_s``; the shares of trials ``solved`` and ``answered``."""
    labels: tuple[str, ...] = ()
    """Names of the values if they are not numbers."""

    def __getitem__(self, measure: str) -> tuple[Figure, ...]:
        return self.figures[measure]

    def at(self, k: int, measures: Sequence[str]) -> str:
        """Text with the figures at the k-th value."""
        where = self.labels[k] if self.labels else f"{self.values[k]:g}"
        return f"{where}: " + ", ".join(f"{name} {self.figures[name][k]}" for name in measures)

    def checks(self, holds: Sequence[bool | None], first: int = 0) -> list[Check]:
        """One check per value, starting with number ``first``."""
        if self.labels:
            return [Check(label, good) for label, good in zip(self.labels[first:], holds, strict=True)]
        return [Check(f"{v:g}", good, v) for v, good in zip(self.values[first:], holds, strict=True)]


def series(table: pd.DataFrame, solver: str, variant: str, centre: Centre) -> Series:
    """The figures of a solver in one variant of a summary.

    Raises:
        RsbenchError: the summary lacks them.
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
    """Return "holds", "fails", "undecided", or these with the values or quantities for which they are true."""
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
    """Return whether a is smaller than b; None if the intervals overlap. NaN (not observable) counts as larger."""
    if math.isnan(a.value) or math.isnan(b.value):
        return None if math.isnan(a.value) and math.isnan(b.value) else math.isnan(b.value)
    return True if a.high < b.low else False if b.high < a.low else None


def within(low: float, high: float, margin: float) -> bool | None:
    """Return whether an interval lies below a margin; None if it contains the margin."""
    return True if high <= margin else False if low > margin else None


def all_of(parts: Sequence[bool | None]) -> bool | None:
    """Return False if any part is False, else None if any part is None, else True."""
    return False if False in parts else None if None in parts else True


def small_increase(ours: Series, other: Series) -> list[Check]:
    """Check, per value, that errors grow from the first value by less than ``TINY`` of the other's error there."""
    later = range(1, len(ours.values))
    rises = [[_rise(ours[m], k, TINY * other[m][0].value) for m in MEASURES] for k in later]
    return ours.checks([all_of(rise) for rise in rises], 1)


def _rise(figures: Sequence[Figure], k: int, margin: float) -> bool | None:
    first, now = figures[0], figures[k]
    return within(now.low - first.high, now.high - first.low, margin)


def always_better(ours: Series, other: Series) -> list[Check]:
    """Check, per value, that both errors are smaller than those of the other solver."""
    return _at_each(ours, other, better)


def more_stable(ours: Series, other: Series) -> list[Check]:
    """Check, per error, that its range over the values is smaller than that of the other solver."""
    return [Check(m, better(_range(ours[m]), _range(other[m]))) for m in MEASURES]


def both_grow(ours: Series, other: Series) -> list[Check]:
    """Check, per solver and error, that it grows from the first to the last value and never decreases."""
    sides = (("RS", ours), ("GS", other))
    return [Check(f"{m} of {who}", _grows(s[m])) for who, s in sides for m in MEASURES]


def _grows(figures: Sequence[Figure]) -> bool | None:
    falls = any(better(b, a) for a, b in pairwise(figures))
    return False if falls else better(figures[0], figures[-1])


def hardly_changes(ours: Series, other: Series) -> list[Check]:
    """Check, per error, that the largest one is at most ``UNCHANGED`` times the smallest one."""
    checks = []
    for m in MEASURES:
        small, large = (extreme(ours[m], key=lambda figure: figure.value) for extreme in (min, max))
        low, high = large.low / max(small.high, 1e-300), large.high / max(small.low, 1e-300)
        checks.append(Check(m, within(low, high, UNCHANGED)))
    return checks


def no_worse(ours: Series, other: Series) -> list[Check]:
    """Check, per value, that both errors are at most ``UNCHANGED`` times those of the other solver."""
    return _at_each(ours, other, _quotient)


def _at_each(ours: Series, other: Series, holds: Callable[[Figure, Figure], bool | None]) -> list[Check]:
    places = range(len(ours.values))
    return ours.checks([all_of([holds(ours[m][k], other[m][k]) for m in MEASURES]) for k in places])


def _quotient(a: Figure, b: Figure) -> bool | None:
    return within(a.low / max(b.high, 1e-300), a.high / max(b.low, 1e-300), UNCHANGED)


def enough_solved(ours: Series, other: Series) -> list[Check]:
    """Check, per value, that the share of solved trials is at least ``SUFFICIENT_SHARE``."""
    return ours.checks([_at_least(share, SUFFICIENT_SHARE) for share in ours["solved"]])


def one_solution(ours: Series, other: Series) -> list[Check]:
    """Check, per value, that the share of trials with one solution is at least ``UNIQUE_SHARE``."""
    return ours.checks([_at_least(share, UNIQUE_SHARE) for share in ours["answered"]])


def scale_known(ours: Series, other: Series) -> list[Check]:
    """Check, per value, that the median of e_s is at most ``SCALE_MARGIN``."""
    known = [not math.isnan(f.value) and within(f.low, f.high, SCALE_MARGIN) for f in ours["e_s"]]
    return ours.checks(known)


def beats_one_camera(ours: Series, other: Series) -> list[Check]:
    """Check, per error at the first value, that its root mean square is below the bound for one camera."""
    return [Check(f"e_{m}", better(ours[f"rms_{m}"][0], other[f"bound_{m}"][0])) for m in "RT"]


def _at_least(share: Figure, least: float) -> bool | None:
    return True if share.low >= least else False if share.high < least else None


def _range(figures: Sequence[Figure]) -> Figure:
    values = [figure.value for figure in figures]
    if any(map(math.isnan, values)):
        return Figure(math.inf, math.inf, math.inf)
    small, large = (extreme(figures, key=lambda figure: figure.value) for extreme in (min, max))
    return Figure(large.value - small.value, max(large.low - small.high, 0.0), large.high - small.low)


SETTINGS: dict[str, tuple[Any, Any]] = {
    "depth": ((2.0, 10.0), (5.0, 50.0)),
    "rotation_deg": (0.5, 5.0),
    "translation": (0.1, 1.0),
    "baseline": (0.2, 0.6),
    "points": (9, 100),
}
"""Two values for each setting that the paper does not give; the grid of a sweep excludes the sweep's axis."""
GRID_NOISE_PX, GRID_TRIALS = 1e-3, 100


@dataclass(frozen=True, kw_only=True)
class Reading:
    """A reading of the paper's solver; the fields are parameters of ``LinearSolver``, by default literal."""

    scaling: str = "none"
    baseline_unit: str = "metre"
    extraction: str = "full"
    sign: str = "cheirality"
    scale: str = "rotation"
    sampling: str = "all"
    terms: str = "second"

    def __str__(self) -> str:
        """The parameters that differ from the literal reading."""
        literal = asdict(LITERAL)
        words = [f"{name} by {v}" if name in ("scale", "sign") else v for name, v in asdict(self).items()]
        changed = [word for word, (name, v) in zip(words, asdict(self).items(), strict=True) if v != literal[name]]
        return ", ".join(changed) or "literal"

    @property
    def name(self) -> str:
        """Name of its solver card."""
        return f"reading-{str(self).replace(', ', '-').replace(' ', '-')}"

    @property
    def complete(self) -> Reading:
        """The same reading with all 27 unknowns."""
        return replace(self, terms="third")


LITERAL = Reading()
_A_AND_UNIT = (("none", "metre"), ("none", "half-baseline"), ("unit-columns", "metre"))
"""Combinations of scaling and unit; columns of unit length make the unit of the baseline irrelevant."""
_EXTRACTIONS = ("full", "symmetric")
SOLVER_READINGS = (
    *(Reading(scaling=a, baseline_unit=unit, extraction=e) for (a, unit), e in product(_A_AND_UNIT, _EXTRACTIONS)),
    *(Reading(extraction=extraction, sign="scale") for extraction in _EXTRACTIONS),
)
"""Readings that affect e_R and e_T if there are more matches than unknowns; the literal one is first."""
NINE_READINGS = tuple(r for r in SOLVER_READINGS if (r.scaling, r.baseline_unit) == _A_AND_UNIT[0])
"""Readings for nine matches per camera: A X = 0 then has an exact solution, which scaling does not change."""
APART = tuple(Reading(extraction=extraction, sampling="nine-apart") for extraction in _EXTRACTIONS)
"""Readings that use nine of a hundred matches, chosen as far apart as possible."""


def readings_of(sweep: str, points: int | None) -> tuple[Reading, ...]:
    """The readings for a sweep; ``points`` is the number per camera, None if the sweep varies it."""
    found = NINE_READINGS if points == 9 else SOLVER_READINGS
    cheirality = [reading for reading in found if reading.sign == "cheirality"]
    if sweep == "noise":
        found += tuple(replace(reading, scale="constraint") for reading in cheirality)
    if sweep == "rotation" and points == 100:
        found += tuple(reading.complete for reading in found)
    return (*found, *APART) if points == 100 else found


def write_cards(folder: Path, readings: tuple[Reading, ...]) -> tuple[str, ...]:
    """Write a solver card below ``folder`` for each reading; returns the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for reading in readings:
        path = folder / f"{reading.name}.toml"
        lines = ['class = "rsbench.solvers.linear:LinearSolver"', f'description = "{reading}"', "[parameters]"]
        lines += [f'{name} = "{value}"' for name, value in asdict(reading).items()]
        write_bytes(path, ("\n".join(lines) + "\n").encode())
        paths.append(str(path))
    return tuple(paths)


def settings_card(card: SweepCard, solvers: tuple[str, ...]) -> SweepCard:
    """The card of a sweep with one variant per setting of the grid, at the paper's noise in pixels.

    The grid is a half fraction of all corners, in which any two choices occur together equally often.
    """
    fields = {name: values for name, values in SETTINGS.items() if name != card.axis}
    variants = []
    for corner in product((0, 1), repeat=len(fields)):
        if sum(corner) % 2:
            continue
        setting = {name: values[k] for (name, values), k in zip(fields.items(), corner, strict=True)}
        name = ", ".join(f"{key} {value}" for key, value in setting.items())
        if card.axis != "noise_px":
            setting["noise_px"] = GRID_NOISE_PX
        variants.append(Variant(name=name, setting=setting))
    values = tuple(v for v in card.values if card.axis != "noise_px" or v <= GRID_NOISE_PX)
    return replace(card, solvers=solvers, variant=tuple(variants), trials=GRID_TRIALS, values=values)


OURS, GLOBAL = "rs-stereo-refined-pairs", "gs-8pt"
READINGS = {"1e-3 px": 1e-3, "0.81 px": 0.81}
"""Readings of the paper's noise of 10^-3, in pixels or on the normalised image plane, with the noise in pixels."""
ALL, NINE, MORE = "100 + 100", "9 + 9", "9 + 9 and more"
"""Number of matches that solvers get."""


@dataclass(frozen=True, kw_only=True)
class Claim:
    """A claim of the paper, the sweep that tests it, and the rule of the test."""

    key: str
    text: str
    """The paper's words."""
    sweep: str
    rule: str
    """The rule in words."""
    check: Callable[[Series, Series], list[Check]]
    """The test, from the figures of the solver and of the one that it is compared with."""
    measures: tuple[str, ...] = MEASURES
    """Figures that tables show."""
    beside: tuple[str, ...] = ()
    """Figures that tables show of the other solver; empty: the same."""
    matches: tuple[str, ...] = (ALL, NINE)
    """Numbers of matches for which it is tested."""
    against_complete: bool = False
    """Whether the solver is compared with itself with all 27 unknowns, instead of the eight-point algorithm."""
    at_reading: bool = False
    """Whether a sweep over noise is tested only at the noise of the reading."""
    any_scale: bool = False
    """Whether readings of the scale are tested."""
    exact: bool = False
    """Whether it is tested without noise, by the variants of the sweep."""
    papers_alone: bool = False
    """Whether it applies only to the paper's solver."""

    @property
    def axis(self) -> str:
        """What its sweep varies."""
        return _AXES[self.sweep]

    @property
    def shares(self) -> bool:
        """Whether its figures are shares of trials."""
        return bool({"solved", "answered"} & set(self.measures))

    def statistic(self, centre: Centre) -> str:
        """Name of the statistic over the trials; ``centre`` is that of e_R and e_T."""
        if self.measures == MEASURES:
            return centre
        return "share" if self.shares else "RMS" if self.measures[0].startswith("rms") else "median"

    @property
    def centres(self) -> tuple[Centre, ...]:
        """Statistics of e_R and e_T; the paper's is the mean."""
        return ("mean", "median") if self.measures == MEASURES else ("mean",)


_AXES = {
    "noise": "noise_px",
    "rotation": "rotation_deg",
    "translation": "translation",
    "readout": "readout_ratio",
    "baseline": "baseline",
    "points": "points",
    "degenerate": "motion or scene",
}
"""What each sweep varies."""
_BETTER = "e_R and e_T both below those of gs-8pt, 95 % intervals apart, at each value"
CLAIMS = (
    Claim(
        key="noise: tiny increase",
        text="Section 3.1: errors grow with the noise, but only a little",
        sweep="noise",
        rule=f"from the smallest noise to each level up to the reading, e_R and e_T rise by at most "
        f"{100 * TINY:g} % of the error that gs-8pt has at the smallest noise, which is what ignoring the rolling "
        "shutter costs; by the ends of both intervals",
        check=small_increase,
    ),
    *(
        Claim(
            key=f"{sweep} velocity: better than GS",
            text="Section 3.1: at every velocity the RS solver beats the GS one, in rotation as in translation",
            sweep=sweep,
            rule=_BETTER,
            check=always_better,
        )
        for sweep in ("rotation", "translation")
    ),
    *(
        Claim(
            key=f"{sweep} velocity: more stable",
            text="Section 3.1: as velocity grows, the errors of the RS solver stay steadier than those of the GS "
            "one",
            sweep=sweep,
            rule="largest minus smallest error over the sweep (deg) below that of gs-8pt, intervals apart, for "
            "e_R and e_T",
            check=more_stable,
        )
        for sweep in ("rotation", "translation")
    ),
    Claim(
        key="readout ratio: both grow",
        text="Section 3.1: the errors of both solvers grow with the readout ratio",
        sweep="readout",
        rule="e_R and e_T of both at phi = 1 above those at phi = 0.2, 95 % intervals apart, and nowhere falling",
        check=both_grow,
    ),
    Claim(
        key="readout ratio: GS gets higher errors",
        text="Section 3.1: at every readout ratio the GS solver errs more",
        sweep="readout",
        rule=_BETTER,
        check=always_better,
    ),
    Claim(
        key="baseline: no impact",
        text="Section 3.1: the length of the baseline hardly matters",
        sweep="baseline",
        rule=f"largest error over the sweep at most {UNCHANGED:g} times the smallest, by the ends of their 95 % "
        "intervals, for e_R and e_T",
        check=hardly_changes,
    ),
    Claim(
        key="nine matches per camera suffice",
        text="Abstract and section 2.2: nine matches of each camera over time are enough",
        sweep="points",
        rule=f"at least {100 * SUFFICIENT_SHARE:g} % of the trials solved (e_R < 1 deg and e_T < 5 deg), by the "
        "ends of the 95 % interval",
        check=enough_solved,
        measures=("solved",),
        matches=(MORE,),
    ),
    Claim(
        key="omitted terms do not matter",
        text="Section 2.2: the terms of third order do not affect the results, so they are omitted",
        sweep="rotation",
        rule=f"e_R and e_T at most {UNCHANGED:g} times those of the same solver with all 27 unknowns, by the ends "
        "of the 95 % intervals, at each value (the terms grow with the motion)",
        check=no_worse,
        matches=(ALL,),
        against_complete=True,
        papers_alone=True,
    ),
    Claim(
        key="eighteen equations have one solution",
        text="Section 2.2: 19 parameters, thus a linear 18-point solver must exist",
        sweep="degenerate",
        rule=f"exact matches: A has rank 18 in at least {100 * UNIQUE_SHARE:g} % of the trials, by the ends of "
        "the 95 % interval",
        check=one_solution,
        measures=("answered",),
        matches=(NINE,),
        exact=True,
        papers_alone=True,
    ),
    Claim(
        key="the scale is metric",
        text="Section 1: stereo cameras give the global scale",
        sweep="noise",
        rule=f"median of abs(log(estimated / true length of d)) at most {SCALE_MARGIN:g} at the noise of the "
        "reading, by the ends of the 95 % interval",
        check=scale_known,
        measures=("e_s",),
        at_reading=True,
        any_scale=True,
    ),
    Claim(
        key="stereo estimates motion better than one camera",
        text="Section 1: stereo cameras estimate motion more accurately than a monocular camera",
        sweep="noise",
        rule="root mean square of e_R and of e_T at the noise of the reading below the Cramer-Rao bound of the "
        "left camera's matches alone, which no unbiased solver of that camera can beat, 95 % interval apart",
        check=beats_one_camera,
        measures=("rms_R", "rms_T"),
        beside=("bound_R", "bound_T"),
        at_reading=True,
    ),
)


def judge_claims(
    tables: Mapping[str, Mapping[str, pd.DataFrame]], readings: Mapping[str, Reading]
) -> pd.DataFrame:
    """One row per claim, number of matches, reading of the noise, statistic and contender.

    Args:
        tables: summaries of sweeps, by the number of matches ("9 + 9") and the name of the sweep, with rows of
            ``OURS``, ``GLOBAL`` and readings of the paper's solver.
        readings: readings of the paper's solver by their names in the tables.

    Raises:
        RsbenchError: a summary lacks a solver or a variant.
    """
    rows: list[dict[str, object]] = []
    for claim in CLAIMS:
        for matches in claim.matches:
            if claim.sweep in tables.get(matches, {}):
                for noise, table, variant in _cases(claim, tables[matches][claim.sweep]):
                    where = {"claim": claim.key, "matches": matches, "noise": noise}
                    rows += [where | row for row in _judge(claim, table, variant, readings)]
    return pd.DataFrame(rows)


def _cases(claim: Claim, table: pd.DataFrame) -> list[tuple[str, pd.DataFrame, str]]:
    """For each reading of the noise: its name, the rows of a summary for it, and their variant."""
    if claim.exact:
        exact = table[table.value == 0.0]
        names = exact.variant.unique()
        numbered = exact.assign(label=exact.variant, value=exact.variant.map(list(names).index), variant="all")
        return [("none", numbered, "all")]
    if claim.sweep != "noise":
        return [(noise, table, noise) for noise in READINGS]
    variant = str(table.variant.iloc[0])
    chosen = {n: table.value == px if claim.at_reading else table.value <= px for n, px in READINGS.items()}
    return [(noise, table[rows], variant) for noise, rows in chosen.items()]


def contenders(claim: Claim, table: pd.DataFrame, readings: Mapping[str, Reading]) -> dict[str, str]:
    """Names of the solvers in a summary to which a claim applies, each with that of the solver to compare with."""
    present = [name for name in table.solver.unique() if name in readings]
    by_reading = {readings[name]: name for name in present}
    chosen = {}
    for reading, name in by_reading.items():
        if reading.terms != "second" or (reading.scale != LITERAL.scale and not claim.any_scale):
            continue
        chosen[name] = by_reading[reading.complete] if claim.against_complete else GLOBAL
    if claim.exact:
        return dict.fromkeys(chosen, next(iter(chosen)))
    return chosen if claim.papers_alone else {**chosen, OURS: GLOBAL}


def _judge(
    claim: Claim, table: pd.DataFrame, variant: str, readings: Mapping[str, Reading]
) -> list[dict[str, Any]]:
    rows = []
    found = cache(partial(series, table, variant=variant))
    for solver, opponent in contenders(claim, table, readings).items():
        for centre in claim.centres:
            figures, other = (found(name, centre=centre) for name in (solver, opponent))
            checks = claim.check(figures, other)
            count = max(len(checks), 1)
            rows.append(
                {
                    "solver": "ours" if solver == OURS else str(readings[solver]),
                    "statistic": claim.statistic(centre),
                    "verdict": verdict(checks, claim.axis),
                    "held": sum(check.holds is True for check in checks) / count,
                    "open": sum(check.holds is None for check in checks) / count,
                    "first": figures.at(0, claim.measures),
                    "last": figures.at(-1, claim.measures),
                    "other_first": other.at(0, claim.beside or claim.measures),
                    "other_last": other.at(-1, claim.beside or claim.measures),
                }
            )
    return rows


def best_readings(judged: pd.DataFrame) -> pd.DataFrame:
    """Per claim, matches and noise: the literal reading's verdict in the paper's statistic, the best one, ours.

    The best reading and statistic (mean or median) holds in most checks, and among these fails in fewest.
    """
    rows = []
    for keys, group in judged.groupby(["claim", "matches", "noise"], sort=False):
        first = group.statistic.iloc[0]
        papers, ours = group[group.solver != "ours"], group[(group.solver == "ours") & (group.statistic == first)]
        literal = papers[(papers.solver == str(LITERAL)) & (papers.statistic == first)].iloc[0]
        best = papers.sort_values(["held", "open"], ascending=False, kind="stable").iloc[0]
        rows.append(
            dict(zip(("claim", "matches", "noise"), keys, strict=True))
            | {
                "literal": literal.verdict,
                "best": best.verdict,
                "best_reading": best.solver,
                "best_statistic": best.statistic,
                "holding": int((papers[papers.statistic == first].held == 1.0).sum()),
                "readings": papers.solver.nunique(),
                "ours": ours.verdict.iloc[0] if len(ours) else "-",
            }
        )
    return pd.DataFrame(rows)


def judge_settings(tables: Mapping[str, pd.DataFrame], readings: Mapping[str, Reading]) -> pd.DataFrame:
    """One row per claim, setting of the grid and reading: the verdict by the paper's statistic, the mean.

    Args:
        tables: summaries of ``settings_card`` sweeps by the name of the sweep.
        readings: readings by their names in the tables.

    Raises:
        RsbenchError: a summary lacks a solver or a variant.
    """
    rows = []
    for claim in CLAIMS:
        if claim.sweep not in tables or claim.measures != MEASURES or claim.against_complete:
            continue
        table = tables[claim.sweep]
        for setting in table.variant.unique():
            other = series(table, GLOBAL, setting, "mean")
            for name, reading in readings.items():
                checks = claim.check(series(table, name, setting, "mean"), other)
                held = sum(check.holds is True for check in checks) / max(len(checks), 1)
                row = {"claim": claim.key, "setting": setting, "reading": str(reading)}
                rows.append(row | {"verdict": verdict(checks, claim.axis), "held": held})
    return pd.DataFrame(rows)


def holding_settings(judged: pd.DataFrame) -> pd.DataFrame:
    """Per claim and reading: the number of settings in which all checks hold, in which all fail, and of all."""
    groups = judged.groupby(["claim", "reading"], sort=False)
    counts = groups.agg(
        holding=("held", lambda held: int((held == 1.0).sum())),
        failing=("verdict", lambda verdicts: int((verdicts == "fails").sum())),
        settings=("held", "size"),
    )
    return counts.reset_index()


COINCIDES_DB, ACCURATE_PX, FAR_SHARE = 30.0, 0.1, 0.05
PUBLISHED = ("rs-stereo-linear", "rs-stereo-linear-symmetric")


@dataclass(frozen=True, kw_only=True)
class ImageClaim:
    """A claim, the stored table by which it is judged, and the rule."""

    key: str
    text: str
    table: str
    """Path of the table below the folder of results."""
    rule: str
    check: Callable[[pd.DataFrame], dict[str, tuple[list[Check], str]]]
    """Function that returns checks and figures as text, by the judged solver."""


def motion_on_images(table: pd.DataFrame) -> dict[str, tuple[list[Check], str]]:
    """Check, per sequence, that both errors are below those of gs-8pt (medians if there are several runs)."""
    runs = table.groupby(["solver", "sequence"], sort=False)[["e_R_deg", "e_T_deg"]]
    errors, shown = runs.median(), runs.agg(median_and_quartiles)
    baseline, found = errors.loc["gs-8pt"], dict[str, tuple[list[Check], str]]()
    for solver in PUBLISHED:
        own = errors.loc[solver]
        checks = [Check(str(name), bool((own.loc[name] < baseline.loc[name]).all())) for name in own.index]
        words, others = (_in_degrees(shown.loc[[who]].droplevel("solver")) for who in (solver, "gs-8pt"))
        found[solver] = (checks, f"{words} deg (GS: {others})")
    return found


def _in_degrees(shown: pd.DataFrame) -> str:
    """e_R and e_T of each sequence: median [quartiles]."""
    return "; ".join(f"{name}: {shown.e_R_deg[name]}, {shown.e_T_deg[name]}" for name in shown.index)


def sgm_is_accurate(table: pd.DataFrame) -> dict[str, tuple[list[Check], str]]:
    """Check, per sequence and motion, the median disparity error and the share of depth errors above 2 m, for
    synchronised cameras."""
    rows = table[(table["delay"] == 0.0) & ~table["opposite"].astype(bool)].to_dict("records")
    checks = [
        Check(
            f"{row['sequence']} ({row['stratum']})",
            bool(row["error_px"] <= ACCURATE_PX and row["over_2m"] <= FAR_SHARE),
        )
        for row in rows
    ]
    errors, far, known = ([row[name] for row in rows] for name in ("error_px", "over_2m", "coverage"))
    scenes = ", ".join(dict.fromkeys(str(row["sequence"]) for row in rows))
    words = (
        f"{min(errors):.2g} to {max(errors):.2g} px; {100 * min(far):.1f} to {100 * max(far):.1f} % beyond 2 m; "
    )
    words += f"{100 * min(known):.0f} to {100 * max(known):.0f} % of the surface has an estimate ({scenes})"
    return {"SGM": (checks, words)}


def almost_coincides(table: pd.DataFrame) -> dict[str, tuple[list[Check], str]]:
    """Check, per sequence, the PSNR of views corrected with estimated motion and SGM depth."""
    rows = table[(table["corrector"] == "fusion") & (table["matcher"] == "sgm") & (table["solver"] != "true")]
    found = {}
    for solver, own in rows.groupby("solver", sort=False):
        for pixels, what in (("visible", "what the frame saw"), ("all", "all pixels")):
            psnr = own[own["pixels"] == pixels].groupby("sequence", sort=False)["psnr"].mean()
            checks = [Check(str(name), bool(value >= COINCIDES_DB)) for name, value in psnr.items()]
            words = "; ".join(f"{name}: {value:.2f} dB" for name, value in psnr.items())
            found[f"{solver}, {what}"] = (checks, words)
    return found


def coincides_literally(table: pd.DataFrame) -> dict[str, tuple[list[Check], str]]:
    """Check, per RANSAC seed, the PSNR of views corrected with the paper's components: ``correct_literally``."""
    means = table.groupby("ransac_seed", sort=False)
    by = "; ".join(", ".join(row) for row in table[list(fig4_panels.LITERAL)].drop_duplicates().to_numpy())
    found = {}
    for pixels, what in (("drawn", "pixels with depth"), ("visible", "what the frame saw"), ("all", "all pixels")):
        psnr, before = means[f"psnr_{pixels}"].mean(), means[f"psnr_rolling_{pixels}"].mean()
        checks = [Check(f"seed {seed}", bool(value >= COINCIDES_DB)) for seed, value in psnr.items()]
        words = ", ".join(f"{value:.2f}" for value in psnr)
        found[f"{by}: {what}"] = (checks, f"{words} dB (uncorrected: {before.mean():.2f})")
    return found


def stereo_corrects_better(table: pd.DataFrame) -> dict[str, tuple[list[Check], str]]:
    """Check, per stratum, that the interval of our paired gain over a method is above 0, where it is finite."""
    table = table[table["gain_low"] > float("-inf")]
    found = {}
    for method, name in (("mono", "against one camera"), ("plane", "against one plane")):
        rows = table[table["method"] == method].to_dict("records")
        checks = [Check(row["stratum"], _positive(row["gain_low"], row["gain_high"])) for row in rows]
        words = [f"{r['stratum']}: {r['gain']:.1f} [{r['gain_low']:.1f}, {r['gain_high']:.1f}] dB" for r in rows]
        found[name] = (checks, "; ".join(words))
    return found


def _positive(low: float, high: float) -> bool | None:
    return True if low > 0.0 else False if high < 0.0 else None


IMAGE_CLAIMS = (
    ImageClaim(
        key="motion is estimated well on images",
        text="Section 3.2: with SIFT and RANSAC the solver also estimates the motion well",
        table="images/scores/pose.csv",
        rule="e_R and e_T below those of gs-8pt in the same robust loop on the same images, in each scene",
        check=motion_on_images,
    ),
    ImageClaim(
        key="SGM is accurate on rolling-shutter pairs",
        text="Abstract, sections 2.3 and 3.2: semi-global matching estimates the depth of RS pairs accurately",
        table="sgm/sgm.csv",
        rule=f"cameras in step: median disparity error at most {ACCURATE_PX:g} px, and at most "
        f"{100 * FAR_SHARE:g} % of the pixels with an estimate more than 2 m off, in each sequence and motion",
        check=sgm_is_accurate,
    ),
    ImageClaim(
        key="the corrected image almost coincides",
        text="Section 3.2: the corrected image almost coincides with the GS image, but for borders without depth",
        table="images/scores/correction.csv",
        rule=f"PSNR against the GS image at least {COINCIDES_DB:g} dB in each scene, mean of four views. "
        "Ours: the motion by rs-stereo-refined from sift matches, the depth by sgm and from the motion, and "
        "fusion of the four frames",
        check=almost_coincides,
    ),
    ImageClaim(
        key="the corrected image almost coincides, with the paper's own solver, SIFT and a single view",
        text="Section 3.2: the same, of what the paper describes: its linear solver, SIFT matches, depth by "
        "semi-global matching and each frame corrected by itself",
        table="fig4/literal.csv",
        rule=f"PSNR against the GS image at least {COINCIDES_DB:g} dB in the castle, mean of four views, with "
        "each of the RANSAC seeds. Figures in the order of the seeds",
        check=coincides_literally,
    ),
    ImageClaim(
        key="stereo corrects without assumptions about the scene",
        text="Abstract and section 2.3: stereo depth replaces assumptions, and corrects better than one camera",
        table="correction/summary.csv",
        rule="paired gain in PSNR of covered pixels over sequences, median with its 95 % interval above 0, in "
        "each stratum. Ours: the motion by rs-stereo-refined from sift-refined matches, the depth by sgm and from "
        "the motion, and fusion of the four frames",
        check=stereo_corrects_better,
    ),
)


def judge_image_claims(results: Path) -> pd.DataFrame:
    """One row per claim and judged solver: verdict and figures.

    Raises:
        RsbenchError: a table is missing or damaged.
    """
    rows = []
    for claim in IMAGE_CLAIMS:
        path = results / claim.table
        target = claim.table.partition("/")[0]
        if not path.is_file():
            raise RsbenchError(f"{path}: no such table; run: rsbench reproduce {target}")
        try:
            content = path.read_text("utf-8")
            if not content.endswith("\n"):
                raise ValueError("the last line has no end")
            found = claim.check(pd.read_csv(io.StringIO(content)))
        except (KeyError, ValueError) as error:  # no such column or row; no table
            raise RsbenchError(
                f"{path}: cut short, or another version's ({one_line(error)}); run: rsbench reproduce {target}"
            ) from error
        for who, (checks, words) in found.items():
            rows.append({"claim": claim.key, "who": who, "verdict": verdict(checks, "scene"), "figures": words})
    return pd.DataFrame(rows)
