"""Evaluations: what is kept and what is made again, and entries that fail alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from rsbench.benchmark.images.evaluation import columns_of, open_evaluation, read_scores
from rsbench.benchmark.images.plan import EvaluationOptions
from rsbench.benchmark.images.score import TABLES
from rsbench.errors import RsbenchError

QUICK = EvaluationOptions(solvers=("gs-8pt",), correction_solver="rs-stereo-refined")
MACHINE = ("seconds.json", "seconds.csv", "provenance.json")
"""Files that hold times, the date and the machine."""


def evaluate(dataset: Path, out: Path, step: Any = lambda word: None, **changes: Any) -> list[str]:
    options = EvaluationOptions(**{**vars(QUICK), **changes})
    return open_evaluation(dataset, out, options).run("test", step)


def contents(out: Path) -> dict[str, bytes]:
    files = (path for path in sorted(out.rglob("*")) if path.is_file() and path.name not in MACHINE)
    return {str(path.relative_to(out)): path.read_bytes() for path in files}


def times(out: Path) -> dict[str, int]:
    return {str(p.relative_to(out)): p.stat().st_mtime_ns for p in (out / "predictions").rglob("*") if p.is_file()}


def remade(before: dict[str, int], out: Path) -> set[str]:
    """Predictions that were written since, such as ``castle/motion/gs-8pt``; none may be gone."""
    after = times(out)
    assert before.keys() <= after.keys()
    changed = {name for name in after if after[name] != before.get(name) and Path(name).name not in MACHINE}
    return {name.removeprefix("predictions/").removesuffix(".json") for name in changed if name.endswith(".json")}


@pytest.fixture(scope="module")
def evaluated(smoke_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("evaluated")
    assert evaluate(smoke_dataset, out) == []
    return out


@pytest.fixture
def copy(evaluated: Path, tmp_path: Path) -> Path:
    import shutil

    return Path(shutil.copytree(evaluated, tmp_path / "copy"))


def solvers_of(out: Path) -> set[str]:
    return set(read_scores(out, "pose")["solver"])


def cell(table: pd.DataFrame, column: str, **keys: object) -> float:
    """The one number of a table in the row that has these keys."""
    rows = table[np.logical_and.reduce([table[name] == value for name, value in keys.items()])]
    (value,) = rows[column].to_numpy()
    return float(value)


# What is kept


def test_two_runs_write_the_same_bytes(smoke_dataset: Path, evaluated: Path, tmp_path: Path) -> None:
    evaluate(smoke_dataset, tmp_path)
    assert contents(tmp_path) == contents(evaluated)


def test_a_repeated_run_makes_nothing_again(smoke_dataset: Path, copy: Path) -> None:
    before = times(copy)
    evaluate(smoke_dataset, copy)
    assert remade(before, copy) == set()


def test_one_more_solver_redoes_and_deletes_nothing(smoke_dataset: Path, copy: Path) -> None:
    before, others = times(copy), read_scores(copy, "pose")
    evaluate(smoke_dataset, copy, solvers=("gs-poselib",))
    assert remade(before, copy) == {"castle/motion/gs-poselib", "room-twist/motion/gs-poselib"}
    pose = read_scores(copy, "pose")
    assert set(pose["solver"]) == {"gs-8pt", "gs-poselib", "rs-stereo-refined"}
    kept = pose[pose["solver"] != "gs-poselib"].reset_index(drop=True)
    pd.testing.assert_frame_equal(kept, others)


def test_an_interrupted_run_goes_on_where_it_stopped(smoke_dataset: Path, evaluated: Path, tmp_path: Path) -> None:
    class InterruptedByTestError(Exception):
        pass

    def stop(word: str) -> None:
        if word == "room-twist: gs-8pt":
            raise InterruptedByTestError

    with pytest.raises(InterruptedByTestError):
        evaluate(smoke_dataset, tmp_path, stop)
    before = times(tmp_path)
    assert "predictions/room-twist/motion/gs-8pt.json" in before
    evaluate(smoke_dataset, tmp_path)
    again = remade(before, tmp_path)
    assert not any(name.startswith("castle/") for name in again)
    assert not {"room-twist/matches", "room-twist/motion/gs-8pt"} & again
    assert contents(tmp_path) == contents(evaluated)


def test_half_an_artefact_is_made_again(smoke_dataset: Path, evaluated: Path, copy: Path) -> None:
    # As a run that was killed between the files of an artefact and its record leaves it.
    (copy / "predictions/castle/depth/sgm.json").unlink()
    (copy / "predictions/castle/depth/sgm.npz").write_bytes(b"half")
    evaluate(smoke_dataset, copy)
    assert contents(copy) == contents(evaluated)


def test_other_images_make_everything_stale(smoke_dataset: Path, copy: Path, tmp_path: Path) -> None:
    import shutil

    data = Path(shutil.copytree(smoke_dataset, tmp_path / "data"))
    image = data / "castle" / "rs" / "left_0.png"
    image.write_bytes((data / "castle" / "gs" / "left_0.png").read_bytes())
    before = times(copy)
    stale = evaluate(data, copy, only=("room-twist",))
    assert remade(before, copy) == set()
    assert "castle/motion/gs-8pt" in stale and set(read_scores(copy, "pose")["sequence"]) == {"room-twist"}
    evaluate(data, copy)
    again = {name for name in remade(before, copy) if "/motion/" in name}
    assert again == {"castle/motion/gs-8pt", "castle/motion/rs-stereo-refined"}


def card(path: Path, cls: str, **parameters: Any) -> Path:
    lines = [f'class = "{cls}"', "[parameters]"]
    lines += [f"{key} = {json.dumps(value)}" for key, value in parameters.items()]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_changed_card_inside_a_scaled_solver_is_seen(smoke_dataset: Path, copy: Path, tmp_path: Path) -> None:
    inner = card(tmp_path / "inner.toml", "rsbench.solvers.refined:RefinedSolver", shutter="global")
    outer = card(tmp_path / "outer.toml", "rsbench.solvers.scaled:FlowScaledSolver", solver=str(inner))
    evaluate(smoke_dataset, copy, solvers=(str(outer),))
    before = times(copy)
    evaluate(smoke_dataset, copy, solvers=(str(outer),))
    assert remade(before, copy) == set()
    card(inner, "rsbench.solvers.refined:RefinedSolver", shutter="global", use_pairs=False)
    assert evaluate(smoke_dataset, copy, solvers=("gs-8pt",)) == ["castle/motion/outer", "room-twist/motion/outer"]
    assert "outer" not in solvers_of(copy)
    assert remade(before, copy) == set()
    evaluate(smoke_dataset, copy, solvers=(str(outer),))
    assert remade(before, copy) == {"castle/motion/outer", "room-twist/motion/outer"}


def test_only_and_force_make_again_what_they_name(smoke_dataset: Path, copy: Path) -> None:
    before, was = times(copy), contents(copy)
    evaluate(smoke_dataset, copy, only=("gs-8pt",), force=True)
    assert remade(before, copy) == {"castle/motion/gs-8pt", "room-twist/motion/gs-8pt"}
    assert contents(copy) == was
    before = times(copy)
    evaluate(smoke_dataset, copy, only=("castle",), force=True)
    again = remade(before, copy)
    assert {"castle/matches", "castle/depth/sgm", "castle/motion/rs-stereo-refined"} < again
    assert not any(name.startswith("room-twist") for name in again)
    assert contents(copy) == was


def test_only_refuses_what_is_not_there(smoke_dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(RsbenchError, match=r"--only castel: is neither .* \(did you mean 'castle'\?\)"):
        evaluate(smoke_dataset, tmp_path, only=("castel",))


# Names


def test_two_entries_of_one_name_are_refused(smoke_dataset: Path, copy: Path, tmp_path: Path) -> None:
    twin = card(tmp_path / "gs-8pt.toml", "rsbench.solvers.refined:RefinedSolver")
    with pytest.raises(RsbenchError, match=rf"--solver gs-8pt and --solver {twin}: both have the name 'gs-8pt'"):
        evaluate(smoke_dataset, copy, solvers=("gs-8pt", str(twin)))
    was = contents(copy)
    with pytest.raises(RsbenchError, match=rf"of another 'gs-8pt', gs-8pt, not of {twin}; .* --force"):
        evaluate(smoke_dataset, copy, solvers=(str(twin),))
    assert contents(copy) == was
    evaluate(smoke_dataset, copy, solvers=(str(twin),), force=True, only=("gs-8pt",))
    record = json.loads((copy / "predictions/castle/motion/gs-8pt.json").read_text())
    assert (record["entry"], record["shutter"]) == (str(twin), "rolling")


def test_a_solver_without_metres_does_not_correct(smoke_dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(RsbenchError, match="--correct-with gs-8pt: gives no length of d in metres"):
        evaluate(smoke_dataset, tmp_path, correction_solver="gs-8pt")
    assert not (tmp_path / "predictions").exists()


# Entries that fail alone

STRANGER = """
import os, sys, time
from dataclasses import dataclass
from typing import final
import numpy as np
from rsbench.benchmark.metric_plugins import Column, ImageMetric, PoseMetric
from rsbench.solvers.engine.base import MotionEstimate, Solver, SolverSpec
from rsbench.vision.corrector import Corrector, CorrectorSpec
from rsbench.vision.feature_matcher import FeatureMatcher
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


class OddMetric(PoseMetric):
    columns = (Column(name="odd", better="lower", worst=9.0),)

    def __init__(self, how="raises"):
        self.how = how

    def compute(self, case):
        behave(self.how)
        return {"other": 1.0}


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


def odd(strangers: Path, name: str, cls: str, how: str, limit: float = 30.0) -> str:
    text = f'class = "evaluation_strangers:{cls}"\ntime_limit_s = {limit}\n[parameters]\nhow = "{how}"\n'
    path = strangers / f"{name}.toml"
    path.write_text(text)
    return str(path)


SOLVER_FAULTS = {
    "raises": "ValueError: not today",
    "nan": "w of a motion estimate must be 3 finite numbers",
    "tuple": "returned a tuple, not a MotionEstimate",
    "exits": "SystemExit: 3",
    "crashes": "SIGABRT",
    "hangs": "took longer than 3 s",
}


def test_solvers_that_break_the_contract_fail_alone(
    smoke_dataset: Path, copy: Path, strangers: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    others = read_scores(copy, "pose")
    limits = {"hangs": 3.0}
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
    from rsbench.solvers.eight_point import EightPointSolver

    def broken(*arguments: object) -> object:
        raise ZeroDivisionError("a bug of ours")

    monkeypatch.setattr(EightPointSolver, "estimate", broken)
    monkeypatch.setattr(EightPointSolver, "propose", broken)
    with pytest.raises(ZeroDivisionError):
        evaluate(smoke_dataset, tmp_path)


# Metrics


def test_one_file_and_one_card_add_a_metric(smoke_dataset: Path, copy: Path, strangers: Path) -> None:
    path = strangers / "darkness.toml"
    path.write_text('class = "evaluation_strangers:Darkness"\n')
    before, was = times(copy), read_scores(copy, "correction")
    evaluate(smoke_dataset, copy, metrics=(str(path),))
    assert remade(before, copy) == set()
    scores = read_scores(copy, "correction")
    pd.testing.assert_frame_equal(scores.drop(columns="darkness"), was)
    from rsbench.dataset.files import read_png

    image = read_png(smoke_dataset / "castle" / "rs" / "left_0.png")
    found = cell(scores, "darkness", sequence="castle", corrector="none", pixels="all", side="left", frame=0)
    assert found == pytest.approx(1.0 - image.mean() / 255.0, abs=1e-6)  # six digits in the file
    from rsbench.report.evaluation_page import summary_tables

    assert "dark" in {str(name) for table in summary_tables(copy) for name in table.brief}


def test_a_metric_whose_column_is_taken_is_refused(smoke_dataset: Path, tmp_path: Path, strangers: Path) -> None:
    (strangers / "psnr-twin.py").write_text("")
    (strangers / "evaluation_twin.py").write_text(
        "from rsbench.benchmark.metric_plugins import Column, ImageMetric\n"
        "class Twin(ImageMetric):\n"
        "    columns = (Column(name='psnr', better='higher', worst=0.0),)\n"
        "    def compute(self, case):\n"
        "        return {'psnr': 1.0}\n"
    )
    (strangers / "twin.toml").write_text('class = "evaluation_twin:Twin"\n')
    with pytest.raises(RsbenchError, match="metric 'twin': column 'psnr' is one of metric 'psnr' too"):
        evaluate(smoke_dataset, tmp_path, metrics=(str(strangers / "twin.toml"),))


def test_flip_is_a_metric_that_comes_along(smoke_dataset: Path, copy: Path) -> None:
    pytest.importorskip("flip_evaluator")
    evaluate(smoke_dataset, copy, metrics=("flip",))
    scores = read_scores(copy, "correction")
    shown = scores[(scores["pixels"] == "visible") & (scores["sequence"] == "castle")]
    corrected = shown[(shown["solver"] == "true") & (shown["matcher"] == "true")]["flip"].mean()
    # Correcting with the truth looks more like it than not correcting does.
    assert 0.0 < corrected < shown[shown["corrector"] == "none"]["flip"].mean() < 1.0


# Files


def test_columns_are_the_planned_ones(smoke_dataset: Path, evaluated: Path) -> None:
    plan = open_evaluation(smoke_dataset, evaluated, QUICK).plan
    for table in TABLES:
        assert list(read_scores(evaluated, table)) == columns_of(table, plan)


def test_each_match_is_counted_once(evaluated: Path) -> None:
    from rsbench.dataset.files import load_matches

    pose = read_scores(evaluated, "pose")
    for sequence in ("castle", "room-twist"):
        matches = load_matches(evaluated / "predictions" / sequence / "matches.npz")
        left = {tuple(row) for row in matches.left} | {tuple(row) for row in matches.tracks[:, [0, 1, 4, 5]]}
        inliers, counted = (
            cell(pose, name, sequence=sequence, solver="gs-8pt") for name in ("inliers", "matches")
        )
        assert counted == len(left) and 0 < inliers <= counted
