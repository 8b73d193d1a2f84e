"""Evaluations of other packages' entries: what they do wrong fails alone; metrics that they add."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from evaluations import cell, evaluate, remade, times

from rsbench.benchmark.images.evaluation import read_scores
from rsbench.core.errors import RsbenchError
from rsbench.report.evaluation_page import summary_tables
from rsbench.solvers.essential_matrix import EightPointSolver
from rsbench.storage.files import read_png

STRANGER = """
import os, sys, time
from dataclasses import dataclass
from typing import final
import numpy as np
from rsbench.benchmark.scoring import Column, ImageMetric, PoseMetric
from rsbench.solvers.engine.base import MotionEstimate, Solver, SolverSpec
from rsbench.vision.corrector import Corrector, CorrectorSpec
from rsbench.vision.feature_matcher import FeatureMatcher
from rsbench.vision.fusion import Fused
from rsbench.vision.stereo_matcher import StereoMatcher


def behave(how):
    print("this must not reach standard output")
    if how == "raises":
        raise ValueError("not today")
    if how == "exits":
        sys.exit(3)
    if how == "crashes":
        os.abort()
    if how == "hangs":
        time.sleep(60)


@final
@dataclass(frozen=True)
class Odd(Solver):
    how: str = "raises"
    spec = SolverSpec(needs={"left"}, minimum={"left": 8}, metric=False, motion_model="linear", shutter="global",
                      reference_point="left", reference="none", assumes="nothing")

    def estimate(self, correspondences, rig, shutter):
        behave(self.how)
        if self.how == "tuple":
            return (1, 2)
        return MotionEstimate(w=np.full(3, np.nan), d=np.ones(3), success=True)


@final
@dataclass(frozen=True)
class OddMatcher(StereoMatcher):
    how: str = "raises"

    def disparities(self, left, right, rig):
        behave(self.how)
        return np.zeros((2, 2)), np.zeros((2, 2))


@final
@dataclass(frozen=True)
class OddFeatures(FeatureMatcher):
    how: str = "raises"

    def match(self, images):
        behave(self.how)
        return "matches"


@final
@dataclass(frozen=True)
class OddCorrector(Corrector):
    how: str = "raises"
    spec = CorrectorSpec(needs={"motion"}, reference="none", assumes="nothing")

    def correct(self, problem, views):
        behave(self.how)
        return {}


@final
@dataclass(frozen=True)
class LeftAlone(Corrector):
    # Takes matches, leaves left frames as they are and finds nothing for right ones.
    spec = CorrectorSpec(needs={"matches"}, reference="none", assumes="nothing")

    def correct(self, problem, views):
        assert len(problem.matches.tracks) > 10 and problem.motion is None and problem.gyro is None
        seen, images = np.ones(problem.images["left", 0].shape[:2], dtype=np.bool_), problem.images
        left = {view: Fused.seen(images[view], seen) for view in views if view[0] == "left"}
        return left | {view: Fused.failed(images[view], "too far right") for view in views if view[0] == "right"}


class OddMetric(PoseMetric):
    columns = (Column(name="odd", better="lower", worst=9.0),)

    def __init__(self, how="raises"):
        self.how = how

    def compute(self, case):
        behave(self.how)
        return {"other": 1.0}


class Twin(ImageMetric):
    columns = (Column(name="psnr", better="higher", worst=0.0),)

    def compute(self, case):
        return {"psnr": 1.0}


class Darkness(ImageMetric):
    columns = (Column(name="darkness", better="lower", worst=1.0, title="dark"),)

    def compute(self, case):
        return {"darkness": 1.0 - float(np.mean(case.image[case.pixels])) / 255.0}
"""


@pytest.fixture(scope="module")
def strangers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("strangers")
    (folder / "evaluation_strangers.py").write_text(STRANGER)
    return folder


def card(strangers: Path, name: str, cls: str, more: str = "") -> str:
    path = strangers / f"{name}.toml"
    path.write_text(f'class = "evaluation_strangers:{cls}"\n{more}')
    return str(path)


def odd(strangers: Path, name: str, cls: str, how: str, limit: float = 30.0) -> str:
    return card(strangers, name, cls, f'time_limit_s = {limit}\n[parameters]\nhow = "{how}"\n')


SOLVER_FAULTS = {
    "raises": "ValueError: not today",
    "nan": "w of a motion estimate must be 3 finite numbers",
    "tuple": "returned a tuple, not a MotionEstimate",
    "exits": "SystemExit: 3",
    "crashes": "SIGABRT",
    "hangs": "took longer than 1 s",
}


@pytest.mark.slow
def test_solvers_that_break_the_contract_fail_alone(
    smoke_dataset: Path, copy: Path, strangers: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    others = read_scores(copy, "pose")
    limits = {"hangs": 1.0}
    cards = tuple(odd(strangers, f"odd-{how}", "Odd", how, limits.get(how, 30.0)) for how in SOLVER_FAULTS)
    evaluate(smoke_dataset, copy, solvers=cards, only=(*(f"odd-{how}" for how in SOLVER_FAULTS), "castle"))
    pose = read_scores(copy, "pose").set_index("solver")
    for how, reason in SOLVER_FAULTS.items():
        row = pose.loc[f"odd-{how}"]
        assert not row["success"] and reason in row["reason"]
        assert (row["e_R_deg"], row["e_T_deg"], row["e_s"]) == (180.0, 180.0, np.inf)
    failures = read_scores(copy, "failures")
    failed = set(failures[failures["kind"] == "solver"]["name"])
    assert failed == {f"odd-{how}" for how in SOLVER_FAULTS}
    kept = read_scores(copy, "pose")
    kept = kept[kept["solver"].isin(others["solver"])].reset_index(drop=True)
    pd.testing.assert_frame_equal(kept, others)
    assert "must not reach" not in capfd.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("how", ["raises", "exits", "answers nonsense"])
def test_other_components_that_break_the_contract_fail_alone(
    smoke_dataset: Path, tmp_path: Path, strangers: Path, how: str
) -> None:
    cards = {
        "matcher": odd(strangers, "odd-matcher", "OddMatcher", how),
        "corrector": odd(strangers, "odd-corrector", "OddCorrector", how),
        "metrics": (odd(strangers, "odd-metric", "OddMetric", how),),
    }
    evaluate(smoke_dataset, tmp_path, **cards, only=("castle",))
    pose = read_scores(tmp_path, "pose")
    assert np.all(pose["success"]) and np.all(pose["odd"].isna())
    depth = read_scores(tmp_path, "depth")
    assert (
        not np.any(depth["success"]) and np.all(depth["median_m"] == np.inf) and np.all(depth["coverage"] == 0.0)
    )
    correction = read_scores(tmp_path, "correction")
    odd_rows = correction[correction["corrector"] == "odd-corrector"]
    assert len(odd_rows) == 2 * 4 * 2 and not np.any(odd_rows["success"]) and np.all(odd_rows["psnr"] == 0.0)
    kinds = set(read_scores(tmp_path, "failures")["kind"])
    assert kinds == {"matcher", "correction", "metric"}


def test_frames_that_a_corrector_gives_up_by_value_score_the_worst_and_the_others_their_own(
    smoke_dataset: Path, tmp_path: Path, strangers: Path
) -> None:
    evaluate(smoke_dataset, tmp_path, corrector=card(strangers, "left-alone", "LeftAlone"), only=("castle",))
    scores = read_scores(tmp_path, "correction")
    own = scores[(scores["corrector"] == "left-alone") & (scores["sequence"] == "castle")].set_index("side")
    assert set(own["solver"]) == set(own["matcher"]) == {"none"}
    left, right = own[own.index == "left"], own[own.index == "right"]
    assert np.all(left["success"]) and not np.any(right["success"])
    assert np.all(right["psnr"] == 0.0) and np.all(right["coverage"] == 0.0)
    as_it_is = scores[(scores["corrector"] == "none") & (scores["sequence"] == "castle")].set_index("side")
    np.testing.assert_array_equal(own.loc["left", "psnr"], as_it_is.loc["left", "psnr"])
    reasons = read_scores(tmp_path, "failures")["reason"].tolist()
    assert "right_0: too far right" in reasons and len(reasons) == 2


def test_without_the_channel_of_a_gyroscope_its_corrector_fails_and_says_why(
    smoke_dataset: Path, tmp_path: Path
) -> None:
    evaluate(smoke_dataset, tmp_path, corrector="gyro", only=("castle",))
    (reason,) = read_scores(tmp_path, "failures")["reason"]
    assert "corrector 'gyro': needs the samples of a gyroscope" in reason and "channel imu" in reason


def test_a_feature_matcher_that_fails_leaves_every_solver_without_matches(
    smoke_dataset: Path, tmp_path: Path, strangers: Path
) -> None:
    features = odd(strangers, "odd-features", "OddFeatures", "raises")
    evaluate(smoke_dataset, tmp_path, features=features, only=("castle",))
    pose = read_scores(tmp_path, "pose")
    assert len(pose) == 2 and not np.any(pose["success"])
    assert all("not today" in reason for reason in pose["reason"])
    failures = read_scores(tmp_path, "failures").set_index("kind")
    assert failures.loc["feature matcher", "name"] == "odd-features"


def test_an_error_in_our_own_code_stops_the_run(
    smoke_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*arguments: object) -> object:
        raise ZeroDivisionError("a bug of ours")

    monkeypatch.setattr(EightPointSolver, "estimate", broken)
    monkeypatch.setattr(EightPointSolver, "propose", broken)
    with pytest.raises(ZeroDivisionError):
        evaluate(smoke_dataset, tmp_path)


# Metrics


def test_one_file_and_one_card_add_a_metric(smoke_dataset: Path, copy: Path, strangers: Path) -> None:
    before, was = times(copy), read_scores(copy, "correction")
    evaluate(smoke_dataset, copy, metrics=(card(strangers, "darkness", "Darkness"),))
    assert remade(before, copy) == set()
    scores = read_scores(copy, "correction")
    pd.testing.assert_frame_equal(scores.drop(columns="darkness"), was)
    image = read_png(smoke_dataset / "castle" / "rs" / "left_0.png")
    found = cell(scores, "darkness", sequence="castle", corrector="none", pixels="all", side="left", frame=0)
    assert found == pytest.approx(1.0 - image.mean() / 255.0, abs=1e-6)  # six digits in the file
    assert "dark" in {str(name) for table in summary_tables(copy) for name in table.brief}


def test_a_metric_whose_column_is_taken_is_refused(smoke_dataset: Path, tmp_path: Path, strangers: Path) -> None:
    with pytest.raises(RsbenchError, match="metric 'twin': column 'psnr' is one of metric 'psnr' too"):
        evaluate(smoke_dataset, tmp_path, metrics=(card(strangers, "twin", "Twin"),))


@pytest.mark.slow
def test_flip_is_a_metric_that_comes_along(smoke_dataset: Path, copy: Path) -> None:
    pytest.importorskip("flip_evaluator")
    evaluate(smoke_dataset, copy, metrics=("flip",))
    scores = read_scores(copy, "correction")
    shown = scores[(scores["pixels"] == "visible") & (scores["sequence"] == "castle")]
    corrected = shown[(shown["solver"] == "true") & (shown["matcher"] == "true")]["flip"].mean()
    # Correcting with the truth looks more like it than not correcting does.
    assert 0.0 < corrected < shown[shown["corrector"] == "none"]["flip"].mean() < 1.0
