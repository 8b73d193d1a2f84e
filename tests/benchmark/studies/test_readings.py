"""The readings of the paper's solver: which there are, and that they differ."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from rsbench.benchmark.simulated.sweep_card import load_sweep
from rsbench.benchmark.studies.claims import (
    GLOBAL,
    LITERAL,
    NINE_READINGS,
    SETTINGS,
    SOLVER_READINGS,
    readings_of,
    settings_card,
    write_cards,
)
from rsbench.solvers.engine.base import load_solver_entry
from rsbench.solvers.linear import LinearSolver


def test_the_first_reading_is_the_literal_one_and_all_differ(tmp_path: Path) -> None:
    paths = write_cards(tmp_path, SOLVER_READINGS)
    assert len(set(SOLVER_READINGS)) == len(paths) == 8
    assert SOLVER_READINGS[0] == LITERAL and str(LITERAL) == "literal"
    entries = [load_solver_entry(path) for path in paths]
    assert entries[0].solver == LinearSolver() == load_solver_entry("rs-stereo-linear").solver
    assert len({entry.key for entry in entries}) == 8
    for entry, reading in zip(entries, SOLVER_READINGS, strict=True):
        assert isinstance(entry.solver, LinearSolver) and entry.name == reading.name
        assert asdict(entry.solver) == asdict(reading)


@pytest.mark.parametrize("sweep", ["noise", "baseline", "translation", "rotation", "readout"])
@pytest.mark.parametrize("points", [9, 100])
def test_every_sweep_has_the_readings_that_its_claims_need(sweep: str, points: int) -> None:
    found = readings_of(sweep, points)
    assert len({reading.name for reading in found}) == len(found)
    assert set(NINE_READINGS if points == 9 else SOLVER_READINGS) <= set(found)
    if sweep == "rotation" and points == 100:
        assert {reading.complete for reading in SOLVER_READINGS} <= set(found)


def test_the_grid_leaves_the_axis_to_the_sweep(tmp_path: Path) -> None:
    solvers = (*write_cards(tmp_path, SOLVER_READINGS[:1]), GLOBAL)
    card = settings_card(load_sweep("rotation"), solvers)
    others = [name for name in SETTINGS if name != "rotation_deg"]
    assert len(card.variant) == 2 ** (len(others) - 1)
    assert {cell.setting.noise_px for cell in card.cells()} == {1e-3}
    # Each two choices meet equally often: the columns of the grid are orthogonal.
    signs = np.array(
        [[1 if v.setting[name] == SETTINGS[name][1] else -1 for name in others] for v in card.variant]
    )
    np.testing.assert_array_equal(signs.T @ signs, len(signs) * np.eye(len(others)))
    noise = settings_card(load_sweep("noise"), solvers)
    assert max(noise.values) == 1e-3 and len(noise.values) > 2
    assert {cell.setting.noise_px for cell in noise.cells()} == set(noise.values)
