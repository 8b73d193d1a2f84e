"""docs/solvers.md says what the committed tables say, of every solver that comes with rsbench."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import programs
import pytest

from rsbench.cards import list_cards

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/solvers.md").read_text("utf-8")
TABLE = pd.read_csv(ROOT / "results/solvers/solvers.csv").set_index("solver")


def test_the_page_is_what_its_program_makes_of_the_tables() -> None:
    assert programs.program("benchmarks/solver_pages.py").page(ROOT / "results/solvers") == PAGE


def test_every_solver_has_a_section_and_was_measured() -> None:
    assert re.findall(r"^## (\S+)$", PAGE, re.MULTILINE) == list(list_cards("solvers")) == sorted(TABLE.index)
    assert "not measured" not in PAGE


@pytest.mark.parametrize("name", ["rs-stereo-tracks", "rs-dai-uniform", "rs-zhuang-8pt", "rs-gyro-5pt"])
def test_a_row_is_read_back_from_the_page(name: str) -> None:
    (cells,) = re.findall(rf"^\| \[{name}\]\(#{name}\) \| (.*) \|$", PAGE, re.MULTILINE)
    bias, noise, *shares, ms = cells.split(" | ")
    found = [float(value) for value in bias.split(", ")]
    truth = TABLE.loc[name, ["bias_e_R_deg", "bias_e_T_deg"]].to_numpy(float)
    np.testing.assert_allclose(found, np.where(truth < 1e-7, 0.0, truth), rtol=0.05)  # two digits
    if np.isfinite(truth := float(TABLE.loc[name, "e_T_over_bound"])):
        assert float(noise.split(", ")[1]) == pytest.approx(truth, rel=0.05)
    assert [float(share) for share in shares[:3]] == pytest.approx(
        [TABLE.loc[name, f"success_{share}"] for share in ("0%", "30%", "50%")], abs=0.005
    )
    assert float(ms) == pytest.approx(TABLE.loc[name, "robust_ms_30%"], rel=0.05)


def test_all_solvers_take_less_than_half_a_minute_for_a_thousand_matches() -> None:
    """Of the committed table: the sum of one robust estimate each, of the processor."""
    assert 0.0 < 1e-3 * TABLE["robust_ms_many"].sum() < 30.0
