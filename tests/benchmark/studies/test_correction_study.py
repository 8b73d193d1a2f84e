"""The correction study: methods against the truth on a small dataset, statistics against direct computation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from rsbench.benchmark.studies import correction_study
from rsbench.benchmark.studies.correction_bench import METHODS, Rows
from rsbench.benchmark.studies.correction_study import (
    EXTRA,
    ROW_BANDS,
    SCORES,
    by_law,
    by_scene,
    by_sequence,
    flow_error,
    loss_to_true_motion,
    masks,
    study_dataset,
    study_sequence,
    summarise,
    summarise_bands,
    verdict,
)
from rsbench.core.errors import RsbenchError
from rsbench.dataset.sequence import Sequence, read_sequence
from rsbench.report.correction_page import laws_page, study_page, write_study
from rsbench.solvers.engine.base import MotionEstimate
from rsbench.solvers.engine.robust_motion import RobustEstimate

SMALL = ["castle", "room-twist"]
Tables = tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]


@pytest.fixture(scope="module")
def tables(smoke_dataset: Path) -> Tables:
    """Of the two sequences of 128 x 96 px."""
    words: list[str] = []
    images, bands, motions = study_dataset(smoke_dataset, words.append)
    assert words == SMALL
    frames = [pd.DataFrame(rows) for rows in (images, bands, motions)]
    for frame in frames:
        frame.insert(0, "stratum", "small")
    return frames[0], frames[1], frames[2]


def test_every_method_scores_every_view(tables: Tables) -> None:
    images, bands, motions = tables
    assert len(images) == 2 * 4 * len(METHODS)
    assert len(bands) == len(images) * ROW_BANDS
    assert len(motions) == 2
    first = (images["side"] == "left") & (images["frame"] == 0)
    slow = images["method"].isin([method.key for method in METHODS if method.slow_scores])
    assert not images[first & slow].isna().any().any()
    assert not images.drop(columns=list(EXTRA)).isna().any().any()
    assert images[~(first & slow)][list(EXTRA)].isna().all().all()


def test_the_truth_makes_no_flow_error_and_knowing_more_never_makes_it_worse(tables: Tables) -> None:
    castle = tables[0][tables[0]["sequence"] == "castle"]
    flow = castle.groupby("method")["flow_mean_px"].mean()
    assert flow["truth"] == 0.0
    assert flow["ours"] < 0.5 * flow["none"]
    # The motion's own error, without that of the depth.
    assert flow["true-depth"] < 0.2
    assert flow["true-motion"] < flow["ours"] + 0.05


def test_nothing_beats_ours_but_the_oracles(tables: Tables) -> None:
    """On 128 x 96 px, resampling costs more than the motion, so ties within 0.3 dB are allowed."""
    psnr = tables[0].groupby("method")["psnr_covered"].mean()
    for method in METHODS:
        if method.kind in ("none", "baseline"):
            assert psnr["ours"] > psnr[method.key] - 0.3, method.key
    assert psnr["ours"] > psnr["none"] + 4.0


def test_the_summary_is_the_median_over_sequences_of_the_mean_of_views(tables: Tables) -> None:
    summary = summarise(tables[0]).set_index("method")
    images = tables[0]
    for score in SCORES:
        by_hand = [
            images[(images["method"] == "ours") & (images["sequence"] == name)][score].mean()
            for name in images["sequence"].unique()
        ]
        np.testing.assert_allclose(summary[score]["ours"], np.median(by_hand))
    # The scenes have one sequence each; their names end in no seed.
    scenes = by_scene(images).set_index(["method", "scene"])
    castle = images[(images["method"] == "ours") & (images["sequence"] == "castle")]
    assert scenes["sequences"].loc["ours", "castle"] == 1
    np.testing.assert_allclose(scenes["psnr_all"].loc["ours", "castle"], castle["psnr_all"].mean())
    share, common = masks(images).iloc[0], images["common"]
    np.testing.assert_allclose([share["median"], share["least"]], [common.median(), common.min()])
    # The interval of two sequences spans both.
    ours = summary.loc["ours"]
    assert ours["psnr_covered_low"] <= ours["psnr_covered"] <= ours["psnr_covered_high"]
    assert np.all(summary["sequences"] == 2) and np.all(summary["failures"] == 0)
    np.testing.assert_allclose(summary["gain"]["ours"], 0.0)


def _synthetic(ours: list[float], other: list[float]) -> pd.DataFrame:
    """Scores of two methods on sequences of one view each; all other scores are 1."""
    rows = []
    for k, values in enumerate(zip(ours, other, strict=True)):
        for method in METHODS:
            row = {"stratum": "s", "sequence": f"q{k}", "side": "left", "frame": 0, "method": method.key}
            row |= dict.fromkeys(SCORES, 1.0) | {"common": 1.0, "success": True}
            row["psnr_covered"] = row["psnr_all"] = values[0] if method.kind in ("ours", "oracle") else values[1]
            rows.append(row)
    return pd.DataFrame(rows)


def test_a_study_of_several_laws_is_summed_up_by_law_and_size() -> None:
    images = _synthetic([30.0, 32.0, 34.0, 40.0, 50.0], 5 * [20.0])
    names = [f"old-town-{law}-moderate-ideal-{seed}" for law in ("linear", "twist") for seed in (1, 2)]
    names.append("castle-spline-aggressive-ideal-1")
    images["sequence"] = images["sequence"].map({f"q{k}": name for k, name in enumerate(names)})
    laws = by_law(images)
    ours = laws[laws["method"] == "ours"].set_index("stratum")["psnr_covered"]
    assert dict(ours) == {"linear, moderate": 31.0, "twist, moderate": 37.0, "spline, aggressive": 50.0}
    motions = pd.DataFrame({"sequence": names, "e_T_deg_ours": [0.1, 105.0, 0.2, 0.3, 1.0], "e_R_deg_ours": 0.5})
    page = laws_page(laws, by_sequence(images), motions)
    hidden = "| linear, moderate | 30.0 | 20.0 | old-town-linear-moderate-ideal-1 | 105 (0.5) | old-town-linear-"
    assert f"{hidden}moderate-ideal-2 |" in page, "a median hides it"
    assert "| moderate | linear | twist |" in page and "| **ours** | 31.0 | 37.0 |" in page


def test_paired_differences_see_what_separate_intervals_do_not() -> None:
    """Sequences differ by 10 dB, methods by 1 dB on each."""
    base = [20.0, 25.0, 30.0, 22.0, 28.0, 24.0]
    summary = summarise(_synthetic([value + 1.0 for value in base], base))
    checked = verdict(summary)
    assert len(checked) == sum(method.kind in ("none", "baseline") for method in METHODS)
    assert not checked["covered_apart"].any() and checked["covered_paired"].all()
    far = verdict(summarise(_synthetic([value + 30.0 for value in base], base)))
    assert far["covered_apart"].all()
    assert not far["flow_apart"].any()  # equal in the synthetic table
    equal = verdict(summarise(_synthetic(base, base)))
    assert not equal["covered_paired"].any()


def test_the_loss_to_the_true_motion_is_paired_by_view() -> None:
    images = _synthetic([30.0, 40.0, 50.0], [20.0, 20.0, 20.0])
    mask = images["method"] == "true-motion"
    images.loc[mask, "psnr_covered"] += [0.1, 0.3, 0.2]
    loss = loss_to_true_motion(images).iloc[0]
    np.testing.assert_allclose([loss["median_loss_db"], loss["largest_loss_db"]], [0.2, 0.3])


def test_a_failed_method_scores_the_worst_and_the_study_goes_on(
    smoke_dataset: Path, tables: Tables, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No motion at all: what knows the truth is unharmed; the rest is counted and takes nothing from others."""
    failed = MotionEstimate.failed("nothing moves")

    def nothing(*_: object) -> RobustEstimate:
        return RobustEstimate(estimate=failed, iterations=0, seconds=0.0, threshold_px=1.0)

    for module in ("frame_motion", "baseline_motions"):
        monkeypatch.setattr(f"rsbench.pipeline.{module}.estimate_motion", nothing)
    rows, bands, motions = study_dataset(smoke_dataset, lambda word: None)
    images = pd.DataFrame(rows)
    images.insert(0, "stratum", "small")
    unharmed = {"none", "gyro", "true-motion", "truth"}
    assert set(images[images["success"]]["method"]) == unharmed
    lost = images[~images["success"]]
    for name, worst in (("psnr", 0.0), ("ssim", -1.0)):
        assert np.all(lost[[f"{name}_covered", f"{name}_all"]] == worst)
    assert np.all(lost["coverage"] == 0.0) and np.all(images["common"] > 0.5)
    diagonal = np.hypot(128, 96)
    assert np.all(lost[["flow_mean_px", "flow_median_px"]] == diagonal)
    assert {row["flow_mean_px"] for row in bands if row["method"] == "ours"} == {diagonal}
    # Whole pictures do not depend on what the others cover.
    before = tables[0].set_index(["sequence", "side", "frame", "method"])["psnr_all"]
    after = images.set_index(["sequence", "side", "frame", "method"])["psnr_all"]
    kept = after.index.get_level_values("method").isin(unharmed)
    pd.testing.assert_series_equal(after[kept], before.loc[after.index[kept]])
    summary = summarise(images).set_index("method")
    assert summary.loc["ours", "failures"] == 2 and summary.loc["truth", "failures"] == 0
    assert summary.loc["ours", "psnr_all"] == 0.0
    of = ("ours", "linear", "twist", "gs", "gs_scaled")
    for row in motions:
        assert {row[f"{name}_{each}"] for name in ("e_R_deg", "e_T_deg") for each in of} == {180.0}


@pytest.mark.slow
def test_methods_in_no_published_table_take_part_when_they_are_asked_for(
    smoke_dataset: Path, tables: Tables, tmp_path: Path
) -> None:
    """They change no number of the others; what gives a view up scores the worst; the page shows them."""
    others, castle = ("zhuang", "vasu-layers", "lao-lines"), read_sequence(smoke_dataset / "castle")
    rows, bands, _ = study_sequence(castle, others=others)
    images = pd.DataFrame(rows)
    asked = images["method"].isin(others)
    before = tables[0][tables[0]["sequence"] == "castle"].drop(columns="stratum").reset_index(drop=True)
    pd.testing.assert_frame_equal(images[~asked].reset_index(drop=True), before)
    assert images[asked].groupby("method").size().to_dict() == dict.fromkeys(others, 4)
    lost = images[~images["success"]]
    assert np.all(lost["psnr_all"] == 0.0) and np.all(lost["coverage"] == 0.0)
    alone = images.groupby("method")["flow_median_px"].mean()
    assert alone["zhuang"] < alone["none"] and alone["vasu-layers"] < alone["none"]
    images.insert(0, "stratum", "small")
    summary = summarise(images)
    assert set(summary["method"]) == set(images["method"]) and len(bands) == len(images) * ROW_BANDS
    assert "monocular, Zhuang et al." in study_page(images, summary)
    with pytest.raises(RsbenchError, match="imu"):
        study_sequence(castle, others=("gyroscope",))


def test_the_page_and_the_figure_come_from_the_stored_tables(tables: Tables, tmp_path: Path) -> None:
    images, bands, _ = tables
    images.to_csv(tmp_path / "views.csv", index=False)
    summarise(images).to_csv(tmp_path / "summary.csv", index=False)
    summarise_bands(bands).to_csv(tmp_path / "rows.csv", index=False)
    first = [path.read_bytes() for path in write_study(tmp_path)]
    assert [path.read_bytes() for path in write_study(tmp_path)] == first
    text = study_page(images, summarise(images))
    for method in METHODS:
        assert method.title in text


def test_flow_errors_are_lengths() -> None:
    flow, truth = np.zeros((2, 3, 2), np.float32), np.zeros((2, 3, 2), np.float32)
    flow[0, 0] = (3.0, 4.0)
    flow[1, 2] = np.nan
    error = flow_error(flow, truth)
    assert error[0, 0] == 5.0 and np.isnan(error[1, 2]) and error[0, 1] == 0.0


def test_a_study_that_was_cut_off_goes_on_where_it_stopped(
    smoke_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    studied: list[str] = []

    def study_sequence(sequence: Sequence, seed: int, solver: str, others: tuple[str, ...]) -> Rows:
        studied.append(sequence.name)
        row = {"sequence": sequence.name, "psnr_all": 1 / 3, "flip_all": float("nan"), "success": True}
        return [row], [row | {"band": 1}], [row]

    def stop(name: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(correction_study, "study_sequence", study_sequence)
    whole = study_dataset(smoke_dataset, lambda name: None)
    with pytest.raises(KeyboardInterrupt):
        study_dataset(smoke_dataset, stop, kept=tmp_path)
    resumed = study_dataset(smoke_dataset, lambda name: None, kept=tmp_path)
    for table, expected in zip(resumed, whole, strict=True):
        pd.testing.assert_frame_equal(pd.DataFrame(table), pd.DataFrame(expected), check_exact=True)
    assert studied == ["castle", "room-twist", "castle", "room-twist"]
    study_dataset(smoke_dataset, lambda name: None, seed=1, kept=tmp_path)
    assert studied[4:] == ["castle", "room-twist"]
