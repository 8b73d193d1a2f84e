"""The public names: which, what they cost, their types, and a whole experiment that uses nothing else."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import assert_type

import numpy as np
import pytest
from documents import ROOT, blocks, rows
from numpy.typing import NDArray

import rsbench
from rsbench.benchmark.images.plan import EvaluationOptions
from rsbench.benchmark.simulated.simulation import Simulation
from rsbench.capture.shutter_decision import NoMotionError
from rsbench.core.projection import RSProjection
from rsbench.dataset.sequence import Sequence
from rsbench.solvers.engine.robust_motion import RobustEstimate

OVERVIEW = ROOT / "docs" / "reference" / "api.md"
DOCUMENTED = dict(
    re.findall(r"`(\w+)(?:\(([\w, ]*)\))?`", "\n".join(cell for cell, *_ in rows(OVERVIEW.read_text("utf-8"))))
)
"""The parameters of each name in the tables of the overview; a class has none there."""
NAMES = sorted([*DOCUMENTED, "RsbenchError"])
RIG = rsbench.StereoRig(camera=rsbench.PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
SHUTTER = rsbench.RollingShutter(height=900, readout_ratio=0.8)
MOTION = rsbench.LinearMotion([0.012, -0.02, 0.016], [0.2, -0.12, 0.18])


def test_the_public_names_are_those_of_the_overview() -> None:
    assert rsbench.__all__ == NAMES
    assert len(NAMES) <= 28
    assert dir(rsbench) == sorted([*NAMES, "__version__"])


def test_the_names_that_editors_see_are_those_that_exist() -> None:
    tree = ast.parse(Path(str(rsbench.__file__)).read_text("utf-8"))
    (block,) = [n for n in tree.body if isinstance(n, ast.If) and ast.unparse(n.test) == "TYPE_CHECKING"]
    typed = {
        alias.name: node.module for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    assert sorted(typed) == NAMES
    for name, module in typed.items():
        assert getattr(rsbench, name) is getattr(sys.modules[str(module)], name)


def test_evaluate_takes_every_option_of_the_command() -> None:
    command = {field.name for field in dataclasses.fields(EvaluationOptions)} - {"correction_solver"}
    assert command | {"folder", "out", "correct_with"} == set(inspect.signature(rsbench.evaluate).parameters)


@pytest.mark.parametrize("name", NAMES)
def test_public_names_are_documented(name: str) -> None:
    assert inspect.getdoc(getattr(rsbench, name))


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'rsbench' has no attribute 'solve_everything'"):
        rsbench.solve_everything  # pyrefly: ignore[missing-attribute]  # noqa: B018


def test_the_import_brings_nothing_along() -> None:
    """A time would depend on the machine; what is imported does not."""
    code = "import sys; before = set(sys.modules); import rsbench; print(*sorted(set(sys.modules) - before))"
    run = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=60)
    brought = run.stdout.split()
    assert "rsbench" in brought
    # The standard library may be there, and the version; numpy and our other parts wait for their first use.
    assert [name for name in brought if name.partition(".")[0] not in sys.stdlib_module_names] == [
        "rsbench",
        "rsbench.core",
        "rsbench.core.version",
    ]


# One experiment. pyrefly checks the assert_type lines: the types reach those who import rsbench alone.


def test_points_are_projected() -> None:
    points = np.random.default_rng(0).uniform([-2, -2, 4], [2, 2, 9], (5, 3))
    seen = rsbench.project(points, RIG, SHUTTER, MOTION, "right", 1)
    assert_type(seen, RSProjection)
    for X, pixel, tau in zip(points, seen.pixels, seen.tau, strict=True):
        # The pinhole equation at the row's own time, written out with Rodrigues' formula in full.
        assert tau == pytest.approx(1 + 0.8 * pixel[1] / 900, abs=1e-12)
        angle = tau * np.linalg.norm(MOTION.w)
        k = MOTION.w / np.linalg.norm(MOTION.w)
        turned = X * np.cos(angle) + np.cross(k, X) * np.sin(angle) + k * (k @ X) * (1 - np.cos(angle))
        x = turned + tau * MOTION.d - [0.3, 0.0, 0.0]
        # The row equation is solved to 1e-9 px.
        np.testing.assert_allclose(pixel, 810.0 * x[:2] / x[2] + 449.5, atol=2e-9)


def test_a_simulated_motion_is_found_and_scored() -> None:
    data = rsbench.simulate(RIG, SHUTTER, MOTION, pairs=60, tracks=60, outlier_ratio=0.2, seed=3)
    assert_type(data, Simulation)
    assert {name: int(mask.sum()) for name, mask in data.outliers.items()} == dict(left=12, right=12, tracks=12)
    found = rsbench.estimate_motion(data.correspondences, RIG, SHUTTER)
    assert_type(found, RobustEstimate)
    assert_type(found.estimate, rsbench.MotionEstimate)
    assert found.estimate.success, found.estimate.reason
    # Few outliers are kept, fewer than one in ten good matches lost.
    assert not np.any(found.inliers["tracks"] & data.outliers["tracks"])
    assert np.mean(found.inliers["tracks"][~data.outliers["tracks"]]) > 0.9
    errors = rsbench.pose_errors(found, MOTION, RIG)
    assert_type(errors, dict[str, float])
    # Three standard deviations of this noise at this size, rounded up.
    assert errors["e_R_deg"] < 0.05 and errors["e_T_deg"] < 1.0 and errors["e_s"] < 0.02


def test_every_public_motion_can_be_simulated_and_solved_with_its_own_name_in_the_answer() -> None:
    """A motion that a solver does not assume is simulated all the same: that is the wrong-model test."""
    w, d = MOTION.w, MOTION.d
    motions = (
        rsbench.TwistMotion(w, d),
        rsbench.AcceleratedMotion(w, d, acceleration=0.1),
        rsbench.SplineMotion(w, d, preset="driving", seed=1),
    )
    for motion in motions:
        data = rsbench.simulate(RIG, SHUTTER, motion, pairs=0, tracks=60, noise_px=0.0)
        found = rsbench.estimate_motion(data.correspondences, RIG, SHUTTER)
        assert found.estimate.success
        errors = rsbench.pose_errors(found, motion, RIG)
        # The linear model's own error on these motions: far above that of exact linear data, far below a failure.
        assert 1e-6 < errors["e_R_deg"] < 1.0, motion


@pytest.mark.slow
def test_the_motion_model_is_chosen_where_that_is_asked_for() -> None:
    """On a twist the linear model's error is of interpolation, the chosen one's of noise alone."""
    motion = rsbench.TwistMotion(np.radians([1.0, 2.0, -1.0]), [0.1, 0.05, 0.3])
    matches = rsbench.simulate(RIG, SHUTTER, motion, pairs=0, tracks=150, noise_px=0.1).correspondences
    found = rsbench.estimate_motion(matches, RIG, SHUTTER, motion_model="auto")
    assert found.motion_model == "twist"
    linear = rsbench.estimate_motion(matches, RIG, SHUTTER)
    assert linear.motion_model == "" and linear.estimate.covariance is not None
    e_T = [rsbench.pose_errors(each, motion, RIG)["e_T_deg"] for each in (found, linear)]
    assert e_T[0] < 0.3 * e_T[1]
    with pytest.raises(rsbench.RsbenchError, match="supports only linear motion"):
        rsbench.estimate_motion(matches, RIG, SHUTTER, "rs-stereo-linear", motion_model="auto")


def test_a_solver_is_taken_by_name_by_card_and_as_it_is(tmp_path: Path) -> None:
    data = rsbench.simulate(RIG, SHUTTER, MOTION, pairs=40, tracks=0, noise_px=0.1)
    assert "gs-8pt" in rsbench.list_solvers()
    card = tmp_path / "mine.toml"
    card.write_text('class = "rsbench.solvers.essential_matrix:EightPointSolver"\n')
    solver = rsbench.load_solver("gs-8pt")
    assert_type(solver, rsbench.Solver)
    answers = [
        rsbench.estimate_motion(data.correspondences, RIG, SHUTTER, chosen).estimate.w
        for chosen in ("gs-8pt", card, solver)
    ]
    np.testing.assert_array_equal(answers[0], answers[1])
    np.testing.assert_array_equal(answers[0], answers[2])
    with pytest.raises(rsbench.RsbenchError, match="did you mean 'gs-8pt'"):
        rsbench.estimate_motion(data.correspondences, RIG, SHUTTER, "gs-8pts")


def test_the_left_cameras_translation_is_scored_as_such() -> None:
    """The camera's own motion, from its two poses: what a single camera can know."""
    (R0, t0), (R1, t1) = (RIG.cam_from_world(MOTION, tau, "left") for tau in (0.0, 1.0))
    of_left = t1 - R1 @ R0.T @ t0
    answer = rsbench.MotionEstimate(w=MOTION.w, d=2.0 * of_left, success=True, metric=False)
    errors = rsbench.pose_errors(answer, MOTION, RIG, reference_point="left")
    assert errors["e_R_deg"] < 1e-9 and errors["e_T_deg"] < 1e-9  # rounding
    assert np.isnan(errors["e_s"])
    # What comes out of the robust loop says itself that it is the left camera's: far from the body's direction.
    still = rsbench.RollingShutter(height=900, readout_ratio=0.0)
    data = rsbench.simulate(RIG, still, MOTION, pairs=40, tracks=0, noise_px=0.0)
    found = rsbench.estimate_motion(data.correspondences, RIG, still, "gs-8pt")
    assert found.reference_point == "left"
    assert rsbench.pose_errors(found, MOTION, RIG)["e_T_deg"] < 1e-4
    assert rsbench.pose_errors(found, MOTION, RIG, reference_point="body")["e_T_deg"] > 0.5


def test_a_failure_scores_the_worst() -> None:
    errors = rsbench.pose_errors(rsbench.MotionEstimate.failed("nothing to see"), MOTION, RIG)
    assert errors == {"e_R_deg": 180.0, "e_T_deg": 180.0, "e_s": np.inf}


def test_a_dataset_is_read_matched_and_measured(smoke_dataset: Path) -> None:
    sequences = rsbench.read_dataset(str(smoke_dataset))
    assert_type(sequences, list[Sequence])
    images = sequences[0].images()
    assert all(image.shape == (96, 128, 3) for image in images)
    np.testing.assert_array_equal(images[1], sequences[0].image("rs", "right", 0))
    np.testing.assert_array_equal(images[2], sequences[0].image("rs", "left", 1))
    matches = rsbench.match(images)
    assert_type(matches, rsbench.Correspondences)
    assert len(matches.left) > 20
    depth = rsbench.stereo_depth(images[0], images[1], sequences[0].rig)
    assert_type(depth, NDArray[np.float32])
    truth = sequences[0].depth("rs", "left", 0)
    both = (depth > 0) & (truth > 0)
    # At 128 x 96 a tenth of a pixel of disparity is some percent of depth.
    assert both.mean() > 0.3 and np.median(np.abs(depth[both] / truth[both] - 1)) < 0.05
    assert not any(report.faults for report in rsbench.verify(smoke_dataset, stride=4, rerender="no"))


def test_frames_without_a_motion_raise_what_a_notebook_can_catch() -> None:
    """Bad frames and frames without a motion have one base class among the public names."""
    flat = [np.full((96, 128), 90, np.uint8)] * 4
    with pytest.raises(rsbench.RsbenchError, match="no texture"):
        rsbench.correct(
            flat, rsbench.StereoRig(camera=rsbench.PinholeCamera.centred(128, 96, 150.0), baseline=0.3)
        )
    assert issubclass(NoMotionError, rsbench.RsbenchError)


FLAT = np.zeros((900, 900), np.uint8)
EMPTY = rsbench.Correspondences()
FEW_ROWS = rsbench.RollingShutter(height=9, readout_ratio=0.8)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: rsbench.project(np.zeros((4, 2)), RIG, SHUTTER, MOTION), "points: must have shape"),
        (lambda: rsbench.project([1, 2, 3], RIG, SHUTTER, MOTION, "middle"), "side = 'middle': must be"),  # pyrefly: ignore[bad-argument-type]
        (lambda: rsbench.project([1, 2, 3], RIG, SHUTTER, MOTION, "left", -1), "frame = -1: must be a whole"),
        (lambda: rsbench.simulate(RIG, FEW_ROWS, MOTION), "shutter.height = 9: must be .* 900 rows"),
        (lambda: rsbench.simulate(RIG, SHUTTER, MOTION, shape="ball"), "shape = 'ball': must be one of 'box'"),  # pyrefly: ignore[bad-argument-type]
        (lambda: rsbench.estimate_motion(np.zeros((9, 4)), RIG, SHUTTER), "correspondences: must be an rsben"),  # pyrefly: ignore[bad-argument-type]
        (lambda: rsbench.estimate_motion(EMPTY, RIG, SHUTTER, 3), "solver: must be a name, the path of a card"),  # pyrefly: ignore[bad-argument-type]
        (lambda: rsbench.pose_errors({}, MOTION, RIG), "found: must be what estimate_motion returned"),  # pyrefly: ignore[bad-argument-type]
        (lambda: rsbench.match([FLAT] * 3), "got 3; four are needed"),
        (lambda: rsbench.match([FLAT.astype(float)] * 4), "image left 0: must be .* got float64"),
        (lambda: rsbench.match([FLAT, FLAT, FLAT, FLAT[:9]]), "image right 1: is .* but image left 0"),
        (lambda: rsbench.match([FLAT[..., None]] * 4), r"image left 0: must have shape \(H, W\) or"),
        (lambda: rsbench.stereo_depth(FLAT[:9], FLAT[:9], RIG), "left: is 900 x 9 pixels, the rig"),
        (lambda: rsbench.correct([FLAT[:9]] * 4, RIG), "image left 0: is 900 x 9 pixels"),
        (lambda: rsbench.correct([FLAT] * 4, RIG, 1.5), "readout_ratio = 1.5: must be a number from 0 to 1"),
        (lambda: rsbench.correct([FLAT] * 4, RIG, target_row=900), "target_row = 900: must be .* to 899"),
        (lambda: rsbench.correct([FLAT] * 2), "rig: give a StereoRig, or camera"),  # pyrefly: ignore[no-matching-overload]
        (lambda: rsbench.correct([FLAT] * 2, RIG, camera=60.0), "one of both"),  # pyrefly: ignore[unexpected-keyword]
        (lambda: rsbench.correct([FLAT] * 2, camera=60.0, matcher="sgm-2"), "matcher = 'sgm-2': .* leave it out"),  # pyrefly: ignore[no-matching-overload]
        (lambda: rsbench.correct([FLAT[:9]] * 2, camera=RIG.camera), "frame 0: is 900 x 9 pixels"),
        (lambda: rsbench.verify("unused", rerender="some"), "rerender = 'some': must be one of"),  # pyrefly: ignore[bad-argument-type]
    ],
)  # fmt: skip
def test_wrong_arguments_are_named_in_one_line(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)


# The document


def test_the_overview_has_the_parameters_of_every_function() -> None:
    assert "`RsbenchError`" in OVERVIEW.read_text("utf-8")
    for name, given in DOCUMENTED.items():
        value = getattr(rsbench, name)
        if inspect.isfunction(value) and name not in ("list_solvers", "load_solver"):
            assert given.split(", ") == list(inspect.signature(value).parameters), name


def test_the_overview_s_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = blocks(OVERVIEW, "python")
    exec(compile(code, "api.md", "exec"), {})
    assert "e_R_deg" in capsys.readouterr().out
