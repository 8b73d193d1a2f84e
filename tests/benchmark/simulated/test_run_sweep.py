"""Running sweeps: the same bytes however it is done, and nothing lost, mixed up or hidden."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsbench.benchmark.simulated import run_sweep as module
from rsbench.benchmark.simulated.run_sweep import geometry_of, read_bounds, read_trials, run_sweep, sweep_steps
from rsbench.benchmark.simulated.sweep_card import Setting, SweepCard, Variant
from rsbench.benchmark.simulated.sweep_summary import summarise_sweep
from rsbench.benchmark.simulated.trials import entrant, run_bounds, run_trials
from rsbench.core.epipolar import rs_sampson_error
from rsbench.core.motion import LinearMotion
from rsbench.errors import RsbenchError
from rsbench.solvers.eight_point import EightPointSolver

SETTING = Setting(
    width=900,
    height=900,
    focal=810.0,
    baseline=0.6,
    readout_ratio=0.8,
    points=30,
    depth=(2.0, 10.0),
    rotation_deg=2.0,
    translation=0.3,
    noise_px=0.1,
)
CARD = SweepCard(
    name="small",
    axis="rotation_deg",
    values=(1.0, 2.0),
    solvers=("gs-8pt", "rs-stereo-linear"),
    trials=7,
    setting=SETTING,
    variant=(Variant(name="low"), Variant(name="high", setting={"noise_px": 0.5})),
)


def contents(folder: Path) -> dict[str, bytes]:
    """Files whose bytes must not depend on the run."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.parent.name != "seconds"]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sweep") / "one"
    run_sweep(CARD, folder, workers=1)
    summarise_sweep(folder)
    return folder


def test_bytes_do_not_depend_on_workers_and_chunks(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "CHUNK", 3)
    words: list[str] = []
    run_sweep(CARD, tmp_path / "two", workers=2, progress=words.append)
    summarise_sweep(tmp_path / "two")
    assert contents(tmp_path / "two") == contents(finished)
    # Four cells with trials, and bounds of the two that differ in more than noise; three chunks each.
    assert len(words) == sweep_steps(CARD) == 3 * (4 + 2)


def test_an_interrupted_run_resumes_with_the_same_bytes(finished: Path, tmp_path: Path) -> None:
    before = contents(finished)
    removed = finished / "trials" / "002.npz"
    kept = finished / "trials" / "001.npz"
    stamp = kept.stat().st_mtime_ns
    removed.unlink()
    words: list[str] = []
    run_sweep(CARD, finished, workers=1, progress=words.append)
    assert contents(finished) == before
    assert kept.stat().st_mtime_ns == stamp and len(words) == sweep_steps(CARD)


@pytest.mark.parametrize(
    ("changes", "word"), [({"trials": 8}, "trials"), ({"seed": 1}, "seed"), ({"solvers": ("gs-8pt",)}, "solvers")]
)
def test_a_folder_of_another_sweep_is_refused(finished: Path, changes: dict[str, Any], word: str) -> None:
    with pytest.raises(RsbenchError, match=f"holds another sweep .differs in {word}"):
        run_sweep(replace(CARD, **changes), finished)


def test_a_motion_that_loses_the_scene_names_its_cell(tmp_path: Path) -> None:
    card = replace(CARD, values=(170.0,), trials=1, solvers=("gs-8pt",))
    with pytest.raises(RsbenchError, match=r"sweep small, low, rotation_deg = 170: trial 0: .* in view"):
        run_sweep(card, tmp_path / "lost")


FATAL = """
import os
from rsbench.solvers.engine.base import Solver
from rsbench.solvers.engine.registry import load_solver

class Fatal(Solver):
    spec = load_solver("gs-8pt").spec

    def estimate(self, correspondences, rig, shutter):
        os._exit(1)
"""


def test_a_killed_worker_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A solver that ends its process, as a want of memory would."""
    (tmp_path / "fatal_plugin.py").write_text(FATAL)
    (tmp_path / "fatal.toml").write_text('class = "fatal_plugin:Fatal"\n')
    monkeypatch.syspath_prepend(tmp_path)
    card = replace(CARD, solvers=(str(tmp_path / "fatal.toml"),))
    with pytest.raises(RsbenchError, match=r"worker process was killed.*resumes"):
        run_sweep(card, tmp_path / "killed")


def test_trials_depend_on_their_number_alone() -> None:
    whole = run_trials(SETTING, CARD.solvers, 0, 0, 4, robust=False)
    part = run_trials(SETTING, CARD.solvers, 0, 2, 2, robust=False)
    for name in ("w", "d", "w_est", "d_est", "success"):
        np.testing.assert_array_equal(whole[name][2:], part[name])
    alone = run_trials(SETTING, ("rs-stereo-linear",), 0, 0, 4, robust=False)
    np.testing.assert_array_equal(alone["w_est"][:, 0], whole["w_est"][:, 1])
    other_seed = run_trials(SETTING, CARD.solvers, 1, 0, 4, robust=False)
    assert not np.any(other_seed["w"] == whole["w"])


def test_solvers_get_what_they_need_and_no_more() -> None:
    assert entrant("gs-8pt").information == "left pairs"
    assert entrant("rs-stereo-linear").information == "left and right pairs"
    assert entrant("rs-stereo-refined-pairs").information == "left and right pairs"
    assert entrant("rs-stereo-refined").information == "tracks"


def test_noise_and_told_readout_share_exact_matches(finished: Path) -> None:
    cells = CARD.cells()
    assert [geometry_of(CARD, cell).index for cell in cells] == [0, 1, 0, 1]
    low, high = read_trials(finished, cells[0]), read_trials(finished, cells[2])
    np.testing.assert_array_equal(low["w"], high["w"])
    np.testing.assert_array_equal(
        read_bounds(finished, CARD, cells[0])["rotation"], read_bounds(finished, CARD, cells[2])["rotation"]
    )


def test_a_solver_that_raises_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise FloatingPointError("overflow")

    monkeypatch.setattr(EightPointSolver, "estimate", broken)
    arrays = run_trials(SETTING, ("gs-8pt",), 0, 0, 1, robust=False)
    assert not arrays["success"].any() and np.isnan(arrays["w_est"]).all()
    assert arrays["reason"][0, 0] == "raised FloatingPointError: overflow"


def test_a_wrong_readout_ratio_reaches_the_solver_only() -> None:
    told = replace(SETTING, readout_ratio_error=-0.3, noise_px=0.0)
    assert told.shutter().readout_ratio == 0.8 and told.told_shutter().readout_ratio == pytest.approx(0.5)
    right, wrong = (run_trials(s, ("rs-stereo-linear",), 0, 0, 3, robust=False) for s in (SETTING, told))
    np.testing.assert_array_equal(right["w"], wrong["w"])
    assert not np.any(right["w_est"] == wrong["w_est"])


def test_bound_of_the_left_camera_agrees_with_finite_differences_of_its_residuals() -> None:
    """Fisher information of (w, left translation) from numerical derivatives of the exact Sampson error."""
    bounds = run_bounds(SETTING, ("gs-8pt",), 0, 0, 1)
    from rsbench.benchmark.simulated.trials import _simulation

    simulation = _simulation(SETTING.exact(), [entrant("gs-8pt")], 0, 0)
    rig, shutter, motion = simulation.rig, simulation.shutter, simulation.motion
    left = simulation.correspondences.left

    def residuals(theta: np.ndarray) -> np.ndarray:
        return rs_sampson_error(rig, shutter, LinearMotion(theta[:3], theta[3:]), "left", left)

    def left_translation(theta: np.ndarray) -> np.ndarray:
        start, end = (rig.cam_from_world(LinearMotion(theta[:3], theta[3:]), tau, "left") for tau in (0.0, 1.0))
        return end.t - end.R @ start.R.T @ start.t

    theta, step = np.concatenate([motion.w, motion.d]), 1e-6
    J, D = (
        np.stack([(f(theta + step * e) - f(theta - step * e)) / (2 * step) for e in np.eye(6)], axis=-1)
        for f in (residuals, left_translation)
    )
    d = left_translation(theta)
    across = np.eye(3) - np.outer(d, d) / (d @ d)
    covariance = np.linalg.inv(J.T @ J)
    direction = np.sqrt(np.trace(across @ D @ covariance @ D.T @ across)) / np.linalg.norm(d)
    # The two kinds of information are equal at exact matches; finite differences are good to 1e-5.
    assert bounds["direction"][0, 0] == pytest.approx(direction, rel=1e-3)
    assert bounds["rotation"][0, 0] == pytest.approx(np.sqrt(np.trace(covariance[:3, :3])), rel=1e-3)


@pytest.mark.parametrize(
    ("changes", "direction", "scale"),
    [
        ({}, True, True),
        ({"rotation_deg": 0.0, "translation_axis": [1.0, 0.0, 0.0]}, True, False),
        ({"rotation_deg": 0.0, "translation_axis": [0.0, 1.0, 0.0]}, True, False),
        ({"rotation_deg": 0.0, "translation_axis": [0.0, 0.0, 1.0]}, True, False),
        ({"rotation_axis": [1.0, 0.0, 0.0]}, True, False),
        ({"rotation_axis": [0.0, 1.0, 0.0], "translation_axis": [0.0, 0.0, 1.0]}, True, False),
        ({"translation": 0.0}, False, False),
        ({"rotation_deg": 0.0, "translation": 0.0}, False, False),
    ],
)
def test_bounds_tell_what_pairs_and_tracks_can_observe(
    changes: dict[str, Any], direction: bool, scale: bool
) -> None:
    """Pairs hold the metric scale through w x b alone, which some motions lack."""
    setting = SETTING.changed(changes, "test")
    pairs, tracks = (run_bounds(setting, (name,), 0, 0, 3) for name in ("rs-stereo-linear", "rs-stereo-refined"))
    moves = setting.translation > 0
    for bounds, know_scale in ((pairs, scale), (tracks, moves)):
        assert np.all(bounds["rotation"] < 0.02)
        assert np.all((bounds["direction"] < 0.1) == direction)
        assert np.median(bounds["scale"] < 0.5) == know_scale
