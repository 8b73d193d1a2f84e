"""How cards are tuned: a setting is better only beyond its interval, and by what is committed the cards stand."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import programs
import pytest

from rsbench.benchmark.leaderboard.track import PUBLIC_SEED
from rsbench.solvers.engine.base import load_solver_entry

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "results/tuning"


@pytest.fixture(scope="module")
def program() -> ModuleType:
    return programs.program("benchmarks/tune_solvers.py")


def test_one_option_at_a_time_differs_and_the_house_s_loop_is_for_those_in_it(program: ModuleType) -> None:
    for name, own in (("rs-r6p", True), ("rs-zhuang-8pt", False)):
        entry = load_solver_entry(name)
        assert (entry.options.robust == "own") == own
        card, *others = program.settings_of(entry.solver, own)
        assert card.option == "card" and card.solver == entry.solver
        assert any(each.option.startswith("loop.") for each in others) != own
        for each in others:
            changed = {k for k, v in vars(each.solver).items() if v != vars(card.solver)[k]}
            assert len(changed) + (each.loop != card.loop) == 1


def test_intervals_hold_for_all_settings_together(program: ModuleType) -> None:
    """Of gains of nothing, one in twenty tables may show one beyond 0."""
    rng, beyond = np.random.default_rng(0), 0
    for _ in range(60):
        low, high = program.gain_intervals(rng.normal(0.0, 0.1, (40, 5)))
        beyond += bool(np.any((low > 0.0) | (high < 0.0)))
    assert beyond <= 9  # 3 expected; the bootstrap of 40 is somewhat narrow
    low, high = program.gain_intervals(np.full((40, 2), 0.25))
    assert np.allclose([low, high], 0.25, rtol=0.0, atol=1e-12)


def test_the_card_stands_unless_another_setting_is_better_beyond_its_interval(program: ModuleType) -> None:
    card = program.Setting("card", "", load_solver_entry("rs-r6p").solver, program.RobustOptions())
    rng = np.random.default_rng(1)
    errors = rng.uniform(0.5, 4.5, 40)
    settings = [(card, errors), (card, errors + rng.normal(-0.02, 0.5, 40)), (card, errors + 1.0)]
    assert [row["best"] for row in program.rows_of("rs-r6p", settings)] == [True, False, False]
    settings.append((card, errors - 0.4))
    rows = program.rows_of("rs-r6p", settings)
    assert [row["best"] for row in rows] == [False, False, False, True]
    assert rows[-1]["gain"] == pytest.approx(0.08, abs=1e-12)


def test_what_is_committed_is_of_a_seed_of_its_own_and_the_cards_stand(program: ModuleType) -> None:
    assert program.SEED != PUBLIC_SEED
    table = pd.read_csv(FOLDER / "tuning.csv", keep_default_na=False)
    assert set(table["solver"]) == set(program.CARDS)
    for name, rows in table.groupby("solver"):
        entry = load_solver_entry(str(name))
        settings = list(program.settings_of(entry.solver, entry.options.robust == "own"))
        assert list(rows["option"]) == [each.option for each in settings]
        assert list(rows["value"].astype(str)) == [each.value for each in settings]
        assert list(rows["option"][rows["best"]]) == ["card"], f"{name}: its card does not have what is best"
