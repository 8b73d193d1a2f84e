"""The program that measures lines: what it counts as an error, and the table that it prints."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pandas as pd
import programs
import pytest

from rsbench.benchmark.simulated.simulation import SimulationOptions, random_motion, simulate
from rsbench.core.correspondences import Correspondences
from rsbench.core.shutter import RollingShutter


@pytest.fixture(scope="module")
def program() -> ModuleType:
    return programs.program("benchmarks/line_triplets.py")


def test_failures_err_by_half_a_turn_and_exact_features_by_nothing(program: ModuleType) -> None:
    motion = random_motion(np.random.default_rng(0), np.radians(2.0), 0.3)
    still = RollingShutter(height=900, readout_ratio=0.0)
    c = simulate(
        program.RIG, still, motion, SimulationOptions(tracks=20), np.random.default_rng(0)
    ).correspondences
    row = program.errors(c, program.RIG, motion)
    assert row["e_R_lines"] == row["e_T_lines"] == 180.0
    assert row["e_R_both"] == row["e_R_points"] < 1e-8
    assert program.errors(Correspondences(), program.RIG, motion)["e_R_both"] == 180.0


def test_the_table_has_a_row_for_each_thing_with_medians_and_the_share_that_is_right(program: ModuleType) -> None:
    kinds = {f"{e}_{kind}": 1.0 for e in ("e_R", "e_T") for kind in ("points", "lines", "both")}
    rows = [
        {"of": "room", "tracks": 10 * k, "lines": 20, "right": 19, "ms_both": 7.0, **kinds, "e_R_both": 0.1 * k}
        for k in range(1, 12)
    ]
    head, rule, line = program.told(pd.DataFrame(rows)).split("\n")
    cells = line.strip("| ").split(" | ")
    assert cells[:3] == ["room", "11", "60, 20"] and cells[3].startswith("0.95 [")
    assert cells[6].startswith("0.6 [") and cells[-1] == "7"
    assert head.count("|") == rule.count("|") == line.count("|") == 12
