"""Verdicts on constructed tables, whose right answer is plain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsbench.benchmark.studies.claims import (
    ALL,
    CLAIMS,
    GLOBAL,
    LITERAL,
    MORE,
    NINE,
    OURS,
    READINGS,
    Check,
    Figure,
    Series,
    always_better,
    beats_one_camera,
    best_readings,
    better,
    both_grow,
    enough_solved,
    hardly_changes,
    holding_settings,
    judge_claims,
    judge_settings,
    more_stable,
    no_worse,
    one_solution,
    scale_known,
    series,
    small_increase,
    verdict,
)
from rsbench.core.errors import RsbenchError
from rsbench.report.claim_pages import claims_page, readings_page

SYMMETRIC = replace(LITERAL, extraction="symmetric")
VALUES = (1.0, 2.0, 4.0)


def figures(values: list[float], half: float = 0.01) -> tuple[Figure, ...]:
    return tuple(Figure(value, value - half, value + half) for value in values)


def of(e_R: list[float], e_T: list[float] | None = None, half: float = 0.01) -> Series:
    R, T = figures(e_R, half), figures(e_T or e_R, half)
    both = {"e_R": R, "e_T": T, "rms_R": R, "rms_T": T, "bound_R": R, "bound_T": T}
    return Series(VALUES, {**both, "solved": R, "answered": R, "e_s": R})


@pytest.mark.parametrize(
    ("holds", "expected"),
    [
        ([True, True, True], "holds"),
        ([False, False, False], "fails"),
        ([True, True, False], "holds only if speed <= 2"),
        ([False, True, True], "holds only if speed >= 2"),
        ([True, False, True], "holds only if speed is 1, 4"),
        ([False, True, False], "holds only if speed is 2"),
    ],
)
def test_verdicts_over_values(holds: list[bool], expected: str) -> None:
    checks = [Check(f"{value:g}", ok, value) for value, ok in zip(VALUES, holds, strict=True)]
    assert verdict(checks, "speed") == expected


def test_verdicts_over_quantities() -> None:
    assert verdict([Check("e_R", True), Check("e_T", False)], "speed") == "holds only for e_R"
    assert verdict([Check("e_R", False), Check("e_T", False)], "speed") == "fails"


def test_better_needs_intervals_apart() -> None:
    assert better(Figure(1.0, 0.9, 1.1), Figure(1.3, 1.2, 1.4)) is True
    assert better(Figure(1.0, 0.9, 1.2), Figure(1.3, 1.2, 1.4)) is None
    assert better(Figure(1.3, 1.2, 1.4), Figure(1.0, 0.9, 1.1)) is False


def test_what_cannot_be_observed_is_worse_than_what_can() -> None:
    known, unknown = Figure(1.0, 0.9, 1.1), Figure(np.nan, np.nan, np.nan)
    assert better(known, unknown) is True and better(unknown, known) is False and better(unknown, unknown) is None
    assert str(unknown) == "not observable" and str(known) == "1.00 [0.90, 1.10]"
    blind = Series(VALUES, {"e_R": figures([1, 1, 1]), "e_T": (known, known, unknown)})
    assert verdict(more_stable(of([1, 2, 3]), blind), "x") == "holds only for e_T"
    assert verdict(more_stable(blind, of([1, 2, 3])), "x") == "holds only for e_R"


@pytest.mark.parametrize(
    ("rule", "ours", "other", "expected"),
    [
        (always_better, of([1, 1, 1]), of([2, 2, 2]), "holds"),
        (always_better, of([1, 1, 3]), of([2, 2, 2]), "holds only if x <= 2"),
        # Better in one of the two errors is not better.
        (always_better, of([1, 1, 1], [3, 3, 3]), of([2, 2, 2]), "fails"),
        (always_better, of([1, 1, 1], half=0.6), of([2, 2, 2], half=0.6), "undecided"),
        # A quarter of 2 is the margin; the ends of the intervals count.
        (small_increase, of([0, 0.2, 0.4]), of([2, 9, 9]), "holds"),
        (small_increase, of([0, 0.2, 0.6]), of([2, 9, 9]), "holds only if x <= 2"),
        (small_increase, of([0, 0.49, 0.6]), of([2, 9, 9]), "undecided if x <= 2"),
        (small_increase, of([0, 3, 3]), of([2, 9, 9]), "fails"),
        (more_stable, of([1, 2, 1]), of([1, 2, 5]), "holds"),
        (more_stable, of([1, 2, 1], [1, 9, 1]), of([1, 2, 5]), "holds only for e_R"),
        (more_stable, of([1, 2, 1], half=1.0), of([1, 2, 2.5], half=1.0), "undecided"),
        (both_grow, of([1, 1, 2]), of([1, 1, 2]), "holds"),
        (both_grow, of([2, 2, 1]), of([1, 1, 2]), "holds only for e_R of GS, e_T of GS"),
        # Larger at the end than at the start, but not growing.
        (both_grow, of([1, 3, 2]), of([1, 1, 2]), "holds only for e_R of GS, e_T of GS"),
        (hardly_changes, of([1.0, 1.1, 1.2]), of([1, 1, 1]), "holds"),
        (hardly_changes, of([1.0, 1.1, 1.6]), of([1, 1, 1]), "fails"),
        (hardly_changes, of([1.0, 1.1, 1.4], half=0.2), of([1, 1, 1]), "undecided"),
        (no_worse, of([1, 1, 1]), of([1, 0.8, 0.5]), "holds only if x <= 2"),
        (enough_solved, of([0.5, 0.95, 1.0]), of([0, 0, 0]), "holds only if x >= 2"),
        (enough_solved, of([0.5, 0.905, 1.0]), of([0, 0, 0]), "holds only if x >= 4; undecided if x is 2"),
        (one_solution, of([0.0, 0.98, 1.0]), of([0, 0, 0]), "holds only if x >= 2"),
        (scale_known, of([0.05, 0.095, 0.2]), of([0, 0, 0]), "holds only if x <= 1; undecided if x is 2"),
        (beats_one_camera, of([1, 1, 1], [3, 3, 3]), of([2, 2, 2]), "holds only for e_R"),
    ],
)
def test_rules(rule: Callable[[Series, Series], list[Check]], ours: Series, other: Series, expected: str) -> None:
    assert verdict(rule(ours, other), "x") == expected


EQUIVALENCE = {
    "no impact": hardly_changes,
    "tiny increase": small_increase,
    "omitted terms do not matter": no_worse,
}


@given(
    claim=st.sampled_from(sorted(EQUIVALENCE)),
    error=st.floats(0.01, 100.0),
    factor=st.floats(2.0, 100.0),
    relative=st.floats(0.001, 3.0),
)
def test_a_solver_that_gets_worse_by_a_factor_of_two_never_passes(
    claim: str, error: float, factor: float, relative: float
) -> None:
    """Whatever the width of the intervals: wide ones cannot show that a claim holds."""
    rule = EQUIVALENCE[claim]
    worse = wide([error, error, factor * error], relative)
    found = rule(worse, wide([error, error, error], relative))
    assert any(check.holds is not True for check in found)
    # With narrow intervals it is refuted.
    narrow = rule(wide([error, error, factor * error], 0.01), wide([error, error, error], 0.01))
    assert any(check.holds is False for check in narrow)


@given(error=st.floats(0.01, 100.0), change=st.floats(-0.05, 0.05))
def test_a_solver_that_stays_as_it_is_passes(error: float, change: float) -> None:
    same = wide([error, error * (1.0 + change), error], 0.01)
    for rule in EQUIVALENCE.values():
        assert verdict(rule(same, same), "x") == "holds"


def wide(values: list[float], relative: float) -> Series:
    """Errors with intervals of a relative half width."""
    numbers = tuple(
        Figure(value, max(0.0, value * (1.0 - relative)), value * (1.0 + relative)) for value in values
    )
    return Series(VALUES, {"e_R": numbers, "e_T": numbers})


def summary(errors: dict[str, float], variants: list[str], values: tuple[float, ...] = VALUES) -> pd.DataFrame:
    """A summary in which each solver has one error everywhere."""
    rows = []
    for variant, value, (solver, error) in product(variants, values, errors.items()):
        share = 1.0 if error < 1 else 0.0
        row: dict[str, object] = {"variant": variant, "value": value, "solver": solver}
        row |= {"trials": 300, "failures": 300 - round(300 * share)}
        for end, factor in (("", 1.0), ("_low", 0.9), ("_high", 1.1)):
            names = ("e_R_mean", "e_R_median", "e_T_mean", "e_T_median", "e_s_median")
            row |= {f"{name}{end}": factor * error for name in names}
            row |= {f"{name}_over_bound{end}": factor for name in ("e_R", "e_T")}
            row |= {f"success_{end[1:] or 'share'}": share}
        rows.append(row | {"e_R_bound": error, "e_T_bound": error})
    return pd.DataFrame(rows)


NAMES = {reading.name: reading for reading in (LITERAL, LITERAL.complete, SYMMETRIC, SYMMETRIC.complete)}


def tables(errors: dict[str, float]) -> dict[str, dict[str, pd.DataFrame]]:
    sweeps = {name: summary(errors, list(READINGS)) for name in ("rotation", "translation", "readout", "baseline")}
    sweeps["noise"] = summary(errors, ["all"], (1e-4, 1e-3, 0.81))
    points = {"points": summary(errors, list(READINGS), (9.0, 20.0))}
    degenerate = summary({LITERAL.name: 0.5}, ["generic", "plane"], (0.0, 0.3))
    degenerate.loc[degenerate.variant == "plane", "failures"] = 300
    return {ALL: sweeps, NINE: {**sweeps, "degenerate": degenerate}, MORE: points}


def test_every_claim_is_judged_in_every_reading() -> None:
    errors = dict.fromkeys(NAMES, 3.0) | {SYMMETRIC.name: 0.2, OURS: 0.1, GLOBAL: 1.0}
    table = judge_claims(tables(errors), NAMES)
    assert set(table.claim) == {claim.key for claim in CLAIMS}
    best = {(row.claim, row.matches, row.noise): row for row in best_readings(table).itertuples()}
    faster = best["rotation velocity: better than GS", ALL, "1e-3 px"]
    verdicts = (faster.literal, faster.best, faster.best_reading, faster.ours)
    assert verdicts == ("fails", "holds", "symmetric", "holds")
    assert (faster.holding, faster.readings) == (1, 2)
    enough = best["nine matches per camera suffice", MORE, "0.81 px"]
    assert (enough.literal, enough.best) == ("fails", "holds")
    # 3.0 with 19 unknowns and with 27; 0.2 against 3.0.
    assert best["omitted terms do not matter", ALL, "1e-3 px"].holding == 2
    assert best["eighteen equations have one solution", NINE, "none"].best == "holds only for generic"
    mono = best["stereo estimates motion better than one camera", ALL, "0.81 px"]
    assert (mono.literal, mono.best, mono.ours) == ("fails", "holds", "holds")
    page = claims_page(table, best_readings(table))
    row = "| rotation velocity: better than GS | 100 + 100 | 1e-3 px | fails | holds | 1 of 2 hold | holds |"
    assert row in page
    for claim in CLAIMS:
        assert f"{claim.text}." in page and claim.rule in page
    # Every table of the page has as many cells in each row as in its head.
    blocks = [block.splitlines() for block in page.split("\n\n") if block.startswith("|")]
    assert len(blocks) == 2 + len(CLAIMS)
    generic = "holds only for generic"
    assert f"| eighteen equations have one solution | 9 + 9 | {generic} | {generic} | - | - |" in page
    for lines in blocks:
        assert len({line.count(" | ") for line in lines if not line.startswith("|--")}) == 1


def test_the_reading_bounds_the_noise_that_the_noise_claim_is_judged_by() -> None:
    names = (LITERAL.name, OURS, GLOBAL)
    rows = [summary(dict.fromkeys(names, e), ["all"], (v,)) for v, e in ((1e-4, 1.0), (1e-3, 1.0), (0.81, 9.0))]
    noise = pd.concat(rows)
    for name in ("e_R", "e_T"):
        for end in ("_low", "_high"):
            noise[f"{name}_mean{end}"] = noise[f"{name}_median{end}"] = noise[f"{name}_mean"]
    table = judge_claims({NINE: {"noise": noise}}, NAMES)
    table = table[table.claim == "noise: tiny increase"]
    verdicts = dict(zip(table.noise, table.verdict, strict=True))
    assert verdicts == {"1e-3 px": "holds", "0.81 px": "holds only if noise_px <= 0.001"}


def test_the_best_reading_is_found_and_the_literal_one_kept() -> None:
    def row(solver: str, statistic: str, held: float, verdict: str, left_open: float = 0.0) -> dict[str, object]:
        where = {"claim": "c", "matches": NINE, "noise": "1e-3 px", "solver": solver, "statistic": statistic}
        return {**where, "held": held, "open": left_open, "verdict": verdict}

    rows = [
        row("literal", "mean", 0.0, "fails"),
        row("literal", "median", 0.5, "holds only if x <= 1"),
        row("symmetric", "mean", 0.5, "holds only if x <= 1"),
        row("symmetric", "median", 1.0, "holds"),
        row("ours", "mean", 1.0, "holds"),
    ]
    (found,) = best_readings(pd.DataFrame(rows)).to_dict("records")
    assert (found["literal"], found["best"], found["best_reading"]) == ("fails", "holds", "symmetric")
    assert (found["holding"], found["readings"], found["best_statistic"]) == (0, 2, "median")
    # What is undecided is better than what fails.
    rows = [row("literal", "mean", 0.0, "fails"), row("symmetric", "mean", 0.0, "undecided", 1.0)]
    assert best_readings(pd.DataFrame(rows)).best.iloc[0] == "undecided"


def test_settings_are_counted_per_reading() -> None:
    errors = {LITERAL.name: 0.1, SYMMETRIC.name: 0.1, GLOBAL: 1.0}
    good, bad = summary(errors, ["easy"]), summary(errors | {LITERAL.name: 2.0}, ["hard"])
    readings = {name: NAMES[name] for name in (LITERAL.name, SYMMETRIC.name)}
    judged = judge_settings({"rotation": pd.concat([good, bad])}, readings)
    key = "rotation velocity: better than GS"
    counts = {
        row["reading"]: (row["holding"], row["failing"], row["settings"])
        for row in holding_settings(judged).to_dict("records")
        if row["claim"] == key
    }
    assert counts == {"literal": (1, 1, 2), "symmetric": (2, 0, 2)}
    assert f"| {key} | 2 | 1 | 1 | 2 | 0 |" in readings_page(holding_settings(judged))


def test_missing_solvers_are_named() -> None:
    with pytest.raises(RsbenchError, match="no rows of solver 'nobody'"):
        series(summary({GLOBAL: 1.0}, ["all"]), "nobody", "all", "mean")
    found = series(summary({GLOBAL: 2.0}, ["all"]), GLOBAL, "all", "median")
    assert found.values == VALUES
    np.testing.assert_allclose(found["e_T"][0], (2.0, 1.8, 2.2))
    np.testing.assert_allclose(found["rms_R"][0], (2.0, 1.8, 2.2))
    assert found["answered"][0].value == 0.0
