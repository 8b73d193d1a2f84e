"""Where vision alone overtakes a gyroscope, against closed forms, and what is committed of it."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import programs
import pytest

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "results/gyro"


@pytest.fixture(scope="module")
def program() -> ModuleType:
    return programs.program("benchmarks/gyro_crossing.py")


VALUES = np.array([0.0, 1.0, 3.0, 10.0])


def test_errors_that_add_in_squares_cross_where_they_do(program: ModuleType) -> None:
    a, b = 0.2, 0.5
    gyro = np.sqrt(a**2 + (b * VALUES) ** 2)
    for vision in (0.21, 0.6, 1.7, 5.0):
        found = float(program.crossing(VALUES, gyro, np.full(4, vision)))
        assert found == pytest.approx(np.sqrt(vision**2 - a**2) / b, rel=1e-12)
    assert program.crossing(VALUES, gyro, np.full(4, 0.1)) == 0.0
    assert program.crossing(VALUES, gyro, np.full(4, 6.0)) == np.inf


def test_a_length_that_is_not_found_is_the_larger_error(program: ModuleType) -> None:
    gyro = np.array([0.1, 0.2, np.inf, np.inf])
    assert program.crossing(VALUES, gyro, np.full(4, 0.5)) == 3.0
    assert program.crossing(VALUES, gyro, np.full(4, np.inf)) == np.inf


def test_the_interval_holds_the_crossing_of_what_was_drawn_from(program: ModuleType) -> None:
    """Rayleigh errors: those of two Gaussian parts, whose squares add."""
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((2, 2, 200))
    gyro = np.stack([np.hypot(0.2, 0.5 * x) * np.hypot(*noise[0]) for x in VALUES])
    vision = np.stack([1.0 * np.hypot(*noise[1])] * len(VALUES))
    row = program.crossing_row(VALUES, gyro, vision, 0)
    truth = np.sqrt(1.0 - 0.2**2) / 0.5
    assert row["low"] < truth < row["high"] and row["high"] / row["low"] < 2.0


def test_committed_crossings_are_those_of_the_committed_medians(program: ModuleType) -> None:
    medians = pd.read_csv(FOLDER / "medians.csv")
    crossings = pd.read_csv(FOLDER / "crossings.csv")
    assert set(crossings["sweep"]) == set(program.SWEEPS)
    for row in crossings.to_dict("records"):
        here = medians[(medians["sweep"] == row["sweep"]) & (medians["variant"] == row["variant"])]
        here = here[here["measure"] == row["measure"]]
        gyro, vision = (here[here["solver"] == row[kind]] for kind in ("gyro", "vision"))
        curves = [each["median"].to_numpy(float) for each in (gyro, vision)]
        found = float(program.crossing(gyro["value"].to_numpy(float), *curves))
        # Tables have six digits; where curves run along each other that moves a crossing by more.
        assert found == pytest.approx(row["crossing"], rel=1e-3)
        assert row["low"] <= row["crossing"] <= row["high"]


def test_the_document_has_the_committed_crossings(program: ModuleType) -> None:
    text = (ROOT / "docs/explanation/monocular.md").read_text("utf-8")
    rows = program.shown(pd.read_csv(FOLDER / "crossings.csv"))
    assert len(rows) == 8 and [row for row in rows if row not in text] == []


def test_the_rotation_of_a_biased_gyroscope_errs_by_its_bias() -> None:
    medians = pd.read_csv(FOLDER / "medians.csv")
    of_bias = medians[(medians["sweep"] == "gyro-bias") & (medians["measure"] == "e_R_deg")]
    rows = of_bias[of_bias["solver"] == "rs-gyro-stereo"]
    # deg/s over 30 frames/s; a rotation of 2 deg turns the bias on the way, by at most its sine, 0.035.
    np.testing.assert_allclose(rows["median"], rows["value"] / 30.0, rtol=1e-3, atol=1e-9)
