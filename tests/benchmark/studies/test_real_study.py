"""What the study of real cameras counts: made-up errors in, shares and medians out."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pandas as pd
import pytest

from rsbench.benchmark.studies.real_cameras import (
    ideal_card,
    largest_in_sigmas,
    sized,
    summarise,
    within_stated,
)
from rsbench.core.errors import RsbenchError
from rsbench.dataset.card import load_dataset_card
from rsbench.report.correction_page import real_page


def _motions(sigmas: dict[str, list[float]], camera: str = "real") -> pd.DataFrame:
    rows = []
    for name, values in sigmas.items():
        for seed, value in enumerate(values):
            errors = (180.0, 180.0) if np.isnan(value) else (0.01 * value, 0.1 * value)
            rows.append((name, f"{name}-mild-2", seed, not np.isnan(value), value, *errors))
    columns = ["scene", "sequence", "seed", "success", "sigmas", "e_R_deg", "e_T_deg"]
    return pd.DataFrame(rows, columns=columns).assign(camera=camera, stratum="mild")


def test_the_largest_error_is_in_its_own_deviation() -> None:
    assert largest_in_sigmas(np.array([0.1, -0.6, 1.0]), np.diag([0.01, 0.04, 1.0])) == pytest.approx(3.0)


def test_a_failure_and_one_seed_beyond_break_a_sequence() -> None:
    motions = _motions({"a": [1.0, 3.9, 2.0], "b": [1.0, 4.1, 2.0], "c": [1.0, np.nan, 2.0]})
    assert within_stated(motions, "real") == (1, 3)


def test_the_summary_and_the_page_are_of_the_stored_rows() -> None:
    both = pd.concat([_motions({"a": [1.0, 3.0, 2.0]}, camera) for camera in ("ideal", "real")])
    rows = [
        (camera, seed, frame, value + frame, value + 3.0)
        for camera in ("ideal", "real")
        for seed, value in (("none", 20.0), ("median", 30.0), ("worst", 28.0))
        for frame in (0, 1)
    ]
    views = pd.DataFrame(rows, columns=["camera", "seed", "frame", "psnr", "psnr_clean"])
    views = views.assign(scene="a", stratum="mild", sequence="a-mild-2", side="left", coverage=0.9)
    summary = summarise(both, views)
    assert summary["e_R_deg"].tolist() == pytest.approx([0.02, 0.02])
    assert summary["e_T_worst_deg"].tolist() == pytest.approx([0.3, 0.3])
    assert summary["psnr_median"].tolist() == [30.5, 30.5] and summary["psnr_clean_worst"].tolist() == [31.0, 31.0]
    page = real_page(summary, both, asdict(load_dataset_card("real")))
    assert "| a, mild | 0.020, 0.020 | 0.200, 0.200 | 20.5, 30.5 | 20.5, 30.5 | 33.0 | 90.0% |" in page
    assert "real camera: 1 of 1 sequences" in page


def test_the_ideal_card_differs_in_the_camera_alone() -> None:
    card = load_dataset_card("real")
    ideal = ideal_card(card)
    assert card.sensor is not None and card.camera.lens is not None
    assert ideal.sensor is None and ideal.camera.lens is None
    for mine, other in zip(card.sequence, ideal.sequence, strict=True):
        np.testing.assert_array_equal(card.motion_of(mine).w, ideal.motion_of(other).w)
        np.testing.assert_array_equal(card.motion_of(mine).d, ideal.motion_of(other).d)
    wide = sized(card, 900)
    assert (wide.camera.width, wide.camera.height) == (900, 675)
    assert wide.camera.focal / wide.camera.width == pytest.approx(card.camera.focal / card.camera.width)
    with pytest.raises(RsbenchError, match="--width 10"):
        sized(card, 10)
