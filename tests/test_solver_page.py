"""The pages of solvers (docs) say what the committed tables say, of every solver that comes with rsbench."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import programs
import pytest

from rsbench.components.cards import FORMER_NAMES, list_cards

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/explanation/solvers.md").read_text("utf-8")
SHEETS = (ROOT / "docs/reference/solver-sheets.md").read_text("utf-8")
ROWS = [
    row
    for row in pd.read_csv(ROOT / "results/solvers/solvers.csv").to_dict("records")
    if row["solver"] not in FORMER_NAMES["solvers"]
]
TABLE = {str(row["solver"]): row for row in ROWS}


def test_the_pages_are_what_their_program_makes_of_the_tables() -> None:
    made = programs.program("benchmarks/solver_pages.py").pages(ROOT / "results/solvers")
    assert list(made.values()) == [PAGE, SHEETS]


def test_every_solver_has_a_section_and_was_measured() -> None:
    assert re.findall(r"^## (\S+)$", SHEETS, re.MULTILINE) == list(list_cards("solvers")) == sorted(TABLE)
    assert "not measured" not in PAGE + SHEETS


@pytest.mark.parametrize("name", ["rs-stereo-tracks", "rs-dai-uniform", "rs-zhuang-8pt", "rs-gyro-5pt"])
def test_a_row_is_read_back_from_the_page(name: str) -> None:
    (cells,) = re.findall(
        rf"^\| \[{name}\]\(../reference/solver-sheets.md#{name}\) \| (.*) \|$", PAGE, re.MULTILINE
    )
    bias, noise, *shares, ms = cells.split(" | ")
    found = [float(value) for value in bias.split(", ")]
    row = TABLE[name]
    truth = np.array([row["bias_e_R_deg"], row["bias_e_T_deg"]])
    np.testing.assert_allclose(found, np.where(truth < 1e-7, 0.0, truth), rtol=0.05)  # two digits
    assert float(noise.split(", ")[1]) == pytest.approx(row["e_T_over_bound"], rel=0.05)
    wanted = [row[f"success_{share}"] for share in ("0%", "30%", "50%")]
    assert [float(share) for share in shares[:3]] == pytest.approx(wanted, abs=0.005)
    assert float(ms) == pytest.approx(row["robust_ms_30%"], rel=0.05)


def test_all_solvers_take_less_than_half_a_minute_for_a_thousand_matches() -> None:
    """Of the committed table: the sum of one robust estimate each, of the processor."""
    assert 0.0 < 1e-3 * sum(row["robust_ms_many"] for row in ROWS) < 30.0
