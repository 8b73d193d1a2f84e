"""Verdicts on the claims of the paper about simulated points, by rule from stored summaries.

The paper leaves open how its solver is meant in places (see ``readings``), so a claim has a verdict under each
reading; it is refuted only where the most favourable one fails.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import pandas as pd

from rsbench.benchmark.studies.claim_rules import (
    MEASURES,
    SCALE_MARGIN,
    SUFFICIENT_SHARE,
    TINY,
    UNCHANGED,
    UNIQUE_SHARE,
    Centre,
    Check,
    Series,
    always_better,
    beats_one_camera,
    both_grow,
    enough_solved,
    hardly_changes,
    more_stable,
    no_worse,
    one_solution,
    scale_known,
    series,
    small_increase,
    verdict,
)
from rsbench.benchmark.studies.readings import LITERAL, Reading

OURS, GLOBAL = "rs-stereo-refined-pairs", "gs-8pt"
READINGS = {"1e-3 px": 1e-3, "0.81 px": 0.81}
"""Variants of the sweeps that read the paper's noise of 10^-3 in pixels, and on the normalised image plane."""
ALL, NINE, MORE = "100 + 100", "9 + 9", "9 + 9 and more"
"""Matches that solvers are given."""


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
    """Of the solver's figures and those of ``other``."""
    measures: tuple[str, ...] = MEASURES
    """Figures that tables show."""
    beside: tuple[str, ...] = ()
    """Figures of what it is compared with; the same where nothing is said."""
    matches: tuple[str, ...] = (ALL, NINE)
    """How many of them it is judged with."""
    against_complete: bool = False
    """Whether the solver is compared with itself with all 27 unknowns, instead of the eight-point algorithm."""
    at_reading: bool = False
    """Whether only the noise of the reading counts, of a sweep over noise."""
    any_scale: bool = False
    """Whether the readings of the scale matter to it."""
    exact: bool = False
    """Whether it is judged without noise, by the variants of the sweep."""
    papers_alone: bool = False
    """Whether it says nothing of other solvers than the paper's."""

    @property
    def shares(self) -> bool:
        """Whether its figures are shares of trials."""
        return bool({"solved", "answered"} & set(self.measures))

    def statistic(self, centre: Centre) -> str:
        """What is shown of the trials; ``centre`` is that of e_R and e_T."""
        if self.measures == MEASURES:
            return centre
        return "share" if self.shares else "RMS" if self.measures[0].startswith("rms") else "median"

    @property
    def centres(self) -> tuple[Centre, ...]:
        """Statistics of e_R and e_T; the paper's is the mean."""
        return ("mean", "median") if self.measures == MEASURES else ("mean",)


_VELOCITY = "Section 3.1: at every velocity the RS solver beats the GS one, in rotation as in translation"
_STABLE = "Section 3.1: as velocity grows, the errors of the RS solver stay steadier than those of the GS one"
_BETTER = "e_R and e_T both below those of gs-8pt, 95 % intervals apart, at each value"
_RANGE = "largest minus smallest error over the sweep (deg) below that of gs-8pt, intervals apart, for e_R and e_T"
CLAIMS = (
    Claim(
        key="noise: tiny increase",
        text="Section 3.1: errors grow with the noise, but only a little",
        sweep="noise",
        axis="noise_px",
        rule=f"from the smallest noise to each level up to the reading, e_R and e_T rise by at most "
        f"{100 * TINY:g} % of the error that gs-8pt has at the smallest noise, which is what ignoring the rolling "
        "shutter costs; by the ends of both intervals",
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
        rule="e_R and e_T of both at phi = 1 above those at phi = 0.2, 95 % intervals apart, and nowhere falling",
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
        rule=f"largest error over the sweep at most {UNCHANGED:g} times the smallest, by the ends of their 95 % "
        "intervals, for e_R and e_T",
        check=hardly_changes,
    ),
    Claim(
        key="nine matches per camera suffice",
        text="Abstract and section 2.2: nine matches of each camera over time are enough",
        sweep="points",
        axis="points",
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
        axis="rotation_deg",
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
        axis="motion or scene",
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
        axis="noise_px",
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
        axis="noise_px",
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
        tables: summaries of sweeps, by the matches that solvers were given ("9 + 9") and the name of the sweep,
            with rows of ``OURS``, ``GLOBAL`` and readings of the paper's solver.
        readings: of the paper's solver, by the names that they have in the tables.

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
    """Reading of the noise, the rows of a summary that it is judged by, and their variant."""
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
    """Names in a summary that a claim is judged for, with that of what each is compared with."""
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
    """Per claim, matches and noise: the literal verdict in the paper's statistic, the best one, and ours.

    The best is over readings, and over mean and median: what holds in most checks, then what fails in least.
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
    """One row per claim, setting of the grid and reading: verdict on the paper's statistic, the mean.

    Args:
        tables: summaries of ``readings.settings_card`` sweeps by the name of the sweep.
        readings: by the names that they have in the tables.

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
    """Per claim and reading: in how many settings of the grid the claim holds throughout, in how many it fails
    throughout, and how many there are."""
    groups = judged.groupby(["claim", "reading"], sort=False)
    counts = groups.agg(
        holding=("held", lambda held: int((held == 1.0).sum())),
        failing=("verdict", lambda verdicts: int((verdicts == "fails").sum())),
        settings=("held", "size"),
    )
    return counts.reset_index()
