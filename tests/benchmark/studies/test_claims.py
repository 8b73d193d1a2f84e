"""Verdicts on constructed tables, whose right answer is plain."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest

from rsbench.benchmark.studies.claims import (
    CLAIMS,
    GLOBAL,
    OURS,
    PUBLISHED,
    READINGS,
    Check,
    Figure,
    Series,
    always_better,
    better,
    both_grow,
    enough_solved,
    hardly_changes,
    judge_claims,
    more_stable,
    series,
    small_increase,
    verdict,
)
from rsbench.errors import RsbenchError
from rsbench.report.claims_page import claims_page

VALUES = (1.0, 2.0, 4.0)


def figures(values: list[float], half: float = 0.01) -> tuple[Figure, ...]:
    return tuple(Figure(value, value - half, value + half) for value in values)


def of(e_R: list[float], e_T: list[float] | None = None, half: float = 0.01) -> Series:
    return Series(
        VALUES, {"e_R": figures(e_R, half), "e_T": figures(e_T or e_R, half), "solved": figures(e_R, half)}
    )


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
    assert better(Figure(1.0, 0.9, 1.1), Figure(1.3, 1.2, 1.4))
    assert not better(Figure(1.0, 0.9, 1.2), Figure(1.3, 1.2, 1.4))
    assert not better(Figure(1.3, 1.2, 1.4), Figure(1.0, 0.9, 1.1))


def test_what_cannot_be_observed_is_worse_than_what_can() -> None:
    known, unknown = Figure(1.0, 0.9, 1.1), Figure(np.nan, np.nan, np.nan)
    assert better(known, unknown) and not better(unknown, known) and not better(unknown, unknown)
    assert str(unknown) == "not observable" and str(known) == "1 [0.9, 1.1]"
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
        (always_better, of([1, 1, 1], half=0.6), of([2, 2, 2], half=0.6), "fails"),
        (small_increase, of([0, 1, 2]), of([2, 9, 9]), "holds"),
        (small_increase, of([0, 1, 3]), of([2, 9, 9]), "holds only if x <= 2"),
        (small_increase, of([0, 3, 3]), of([2, 9, 9]), "fails"),
        (more_stable, of([1, 2, 1]), of([1, 2, 5]), "holds"),
        (more_stable, of([1, 2, 1], [1, 9, 1]), of([1, 2, 5]), "holds only for e_R"),
        (both_grow, of([1, 0, 2]), of([1, 1, 2]), "holds"),
        (both_grow, of([2, 2, 1]), of([1, 1, 2]), "holds only for e_R of GS, e_T of GS"),
        (hardly_changes, of([1.0, 1.1, 1.2]), of([1, 1, 1]), "holds"),
        (hardly_changes, of([1.0, 1.1, 1.5]), of([1, 1, 1]), "fails"),
        (hardly_changes, of([1.0, 1.1, 1.5], half=0.4), of([1, 1, 1]), "holds"),
        (enough_solved, of([0.5, 0.95, 1.0]), of([0, 0, 0]), "holds only if x >= 2"),
        (enough_solved, of([0.5, 0.905, 1.0]), of([0, 0, 0]), "holds only if x >= 4"),
    ],
)
def test_rules(rule: Callable[[Series, Series], list[Check]], ours: Series, other: Series, expected: str) -> None:
    assert verdict(rule(ours, other), "x") == expected


def summary(errors: dict[str, float], variants: list[str], values: tuple[float, ...] = VALUES) -> pd.DataFrame:
    """A summary in which each solver has one error everywhere."""
    rows = []
    for variant in variants:
        for value in values:
            for solver, error in errors.items():
                row = {"variant": variant, "value": value, "solver": solver}
                for measure in ("e_R", "e_T"):
                    for centre in ("mean", "median"):
                        ends = {"": error, "_low": 0.9 * error, "_high": 1.1 * error}
                        row |= {f"{measure}_{centre}{end}": number for end, number in ends.items()}
                share = 1.0 if error < 1 else 0.0
                rows.append(row | {"success_share": share, "success_low": share, "success_high": share})
    return pd.DataFrame(rows)


def test_every_claim_is_judged_for_both_solvers_readings_and_statistics() -> None:
    errors = {PUBLISHED: 3.0, OURS: 0.1, GLOBAL: 1.0}
    sweeps = {name: summary(errors, list(READINGS)) for name in ("rotation", "translation", "readout", "baseline")}
    sweeps["noise"] = summary(errors, ["all"], (1e-4, 1e-3, 0.81))
    points = {"points": summary(errors, list(READINGS), (9.0, 20.0))}
    table = judge_claims({"100 + 100": sweeps, "9 + 9 and more": points})
    assert set(table.claim) == {claim.key for claim in CLAIMS}
    assert len(table) == (len(CLAIMS) - 1) * 2 * 2 * 2 + 2 * 2
    faster = table[table.claim == "rotation velocity: better than GS"]
    assert set(faster[faster.solver == PUBLISHED].verdict) == {"fails"}
    assert set(faster[faster.solver == OURS].verdict) == {"holds"}
    enough = table[table.claim == "nine matches per camera suffice"]
    assert dict(zip(enough.solver, enough.verdict, strict=True)) == {PUBLISHED: "fails", OURS: "holds"}
    page = claims_page(table)
    assert "| rotation velocity: better than GS | 100 + 100 | 1e-3 px | fails | holds |" in page
    for claim in CLAIMS:
        assert f"{claim.text}." in page and claim.rule in page
    # Every table of the page has as many cells in each row as in its head.
    tables = [block.splitlines() for block in page.split("\n\n") if block.startswith("|")]
    assert len(tables) == 1 + len(CLAIMS)
    for lines in tables:
        assert len({line.count(" | ") for line in lines if not line.startswith("|--")}) == 1


def test_the_reading_bounds_the_noise_that_the_noise_claim_is_judged_by() -> None:
    rows = [
        summary({s: e for s in (PUBLISHED, OURS, GLOBAL)}, ["all"], (v,)) for v, e in ((1e-4, 1.0), (0.81, 9.0))
    ]
    rows.insert(1, summary(dict.fromkeys((PUBLISHED, OURS, GLOBAL), 1.0), ["all"], (1e-3,)))
    table = judge_claims({"9 + 9": {"noise": pd.concat(rows)}})
    verdicts = dict(zip(table.noise, table.verdict, strict=True))
    assert verdicts == {"1e-3 px": "holds", "0.81 px": "holds only if noise_px <= 0.001"}


def test_missing_solvers_are_named() -> None:
    with pytest.raises(RsbenchError, match="no rows of solver 'nobody'"):
        series(summary({GLOBAL: 1.0}, ["all"]), "nobody", "all", "mean")
    found = series(summary({GLOBAL: 2.0}, ["all"]), GLOBAL, "all", "median")
    assert found.values == VALUES
    np.testing.assert_allclose(found["e_T"][0], (2.0, 1.8, 2.2))
