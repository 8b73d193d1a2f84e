"""Every reading of the paper's solver is judged, and the best of them found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from rsbench.benchmark.simulated.simulation import SimulationOptions, random_motion, simulate
from rsbench.benchmark.simulated.sweep_card import load_sweep
from rsbench.benchmark.studies.claims import GLOBAL
from rsbench.benchmark.studies.readings import (
    CHOICES,
    SETTINGS,
    SOLVER_READINGS,
    Reading,
    best_readings,
    holding_settings,
    readings_card,
    settings_card,
    write_cards,
)
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.report.readings_page import readings_page
from rsbench.solvers.engine.registry import load_solver_entry
from rsbench.solvers.linear import LinearSolver


def test_the_first_reading_is_the_literal_one_and_all_differ(tmp_path: Path) -> None:
    cards = write_cards(tmp_path, SOLVER_READINGS)
    assert len(set(SOLVER_READINGS)) == len(cards) == 16
    assert str(SOLVER_READINGS[0]) == "literal"
    entries = [load_solver_entry(path) for path in cards]
    assert entries[0].solver == LinearSolver(scaling="none")
    assert len({entry.key for entry in entries}) == 16
    for entry, reading in zip(entries, cards.values(), strict=True):
        assert isinstance(entry.solver, LinearSolver)
        assert all(getattr(entry.solver, name) == getattr(reading, name) for name in CHOICES)


def test_readings_differ_where_there_is_noise(tmp_path: Path) -> None:
    """A choice that changes nothing would make the table longer than what it says."""
    rig = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
    shutter = RollingShutter(height=900, readout_ratio=0.8)
    rng = np.random.default_rng(0)
    matches = simulate(
        rig, shutter, random_motion(rng, 0.03, 0.3), SimulationOptions(pairs=30, noise_px=0.3), rng
    ).correspondences
    answers = []
    for path in write_cards(tmp_path, SOLVER_READINGS):
        found = load_solver_entry(path).solver.estimate(matches, rig, shutter)
        answers.append((*np.round(found.w, 9), *np.round(found.d / np.linalg.norm(found.d), 9)))
    # Columns of unit length undo the unit of the baseline; the sign may agree by chance.
    assert len(set(answers)) >= 6


def test_the_grid_leaves_the_axis_to_the_sweep(tmp_path: Path) -> None:
    cards = write_cards(tmp_path, SOLVER_READINGS[:1])
    card = settings_card(load_sweep("rotation"), cards)
    sizes = [len(values) for name, values in SETTINGS.items() if name != "rotation_deg"]
    assert len(card.variant) == np.prod(sizes)
    assert len(card.cells()) == len(card.variant) * len(card.values)
    assert {cell.setting.noise_px for cell in card.cells()} == {1e-3}
    assert {cell.setting.points for cell in card.cells()} == set(SETTINGS["points"])
    noise = settings_card(load_sweep("noise"), cards)
    assert {cell.setting.noise_px for cell in noise.cells()} == set(noise.values)
    assert readings_card(load_sweep("noise"), cards).solvers[-1] == GLOBAL


def judged(reading: str, statistic: str, share: float, verdict: str) -> dict[str, object]:
    row = {"claim": "c", "matches": "9 + 9", "noise": "1e-3 px", "reading": reading, "statistic": statistic}
    return row | {"share": share, "verdict": verdict}


def test_the_best_reading_is_found_and_the_literal_one_kept() -> None:
    table = pd.DataFrame(
        [
            judged("literal", "mean", 0.0, "fails"),
            judged("literal", "median", 0.5, "holds only if x <= 1"),
            judged("symmetric", "mean", 0.5, "holds only if x <= 1"),
            judged("symmetric", "median", 1.0, "holds"),
            judged("unit-columns", "mean", 1.0, "holds"),
            judged("unit-columns", "median", 0.0, "fails"),
        ]
    )
    (row,) = best_readings(table).to_dict("records")
    assert (row["literal"], row["best"], row["best_reading"]) == ("fails", "holds", "symmetric")
    assert (row["holding"], row["readings"], row["best_statistic"]) == (1, 3, "median")
    settings = pd.DataFrame([{"claim": "c", "reading": "literal", "holding": 1, "settings": 4}])
    page = readings_page(best_readings(table), settings)
    assert "| c | 9 + 9 | 1e-3 px | fails | 1 of 3 | holds | symmetric (median) |" in page
    assert "| c | 1 of 4 |" in page


def test_settings_are_counted_per_reading() -> None:
    rows = [
        {"claim": "c", "setting": str(k), "reading": r, "share": s}
        for r, shares in (("literal", (1.0, 0.9, 0.0)), ("symmetric", (1.0, 1.0, 0.5)))
        for k, s in enumerate(shares)
    ]
    found = holding_settings(pd.DataFrame(rows))
    assert list(found.holding) == [1, 2] and list(found.settings) == [3, 3]


@pytest.mark.parametrize(("changes", "words"), [({}, "literal"), ({"sign": "scale"}, "scale")])
def test_a_reading_says_what_differs(changes: dict[str, str], words: str) -> None:
    literal = {name: values[0] for name, values in CHOICES.items()}
    assert str(Reading(**{**literal, **changes})) == words
