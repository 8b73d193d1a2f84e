"""Running sweeps: the same bytes however it is done, and nothing lost, mixed up or hidden."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import bytes_below

from rsbench.benchmark.simulated import run_sweep as module
from rsbench.benchmark.simulated.run_sweep import (
    failure_reasons,
    geometry_of,
    read_bounds,
    read_trials,
    run_sweep,
    summarise_sweep,
    sweep_steps,
)
from rsbench.benchmark.simulated.sweep_card import Setting, SweepCard, Variant, load_sweep
from rsbench.benchmark.simulated.trials import Arrays, _simulation, enter, run_bounds, run_trials
from rsbench.components.motion_models import LinearMotion
from rsbench.components.rig_tables import load_rig
from rsbench.core.epipolar import rs_sampson_error
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import StereoRig
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.solvers.engine.base import load_solver_entry
from rsbench.solvers.essential_matrix import EightPointSolver
from rsbench.storage.files import load_arrays, read_json, save_arrays, write_json

SETTING = load_sweep("noise").setting.changed({"points": 30, "noise_px": 0.1}, "test")
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
    return bytes_below(folder, "seconds")


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
    with pytest.raises(
        RsbenchError, match=r"sweep small, low, rotation_deg = 170, trials 0 to 0: trial 0: .* in view"
    ):
        run_sweep(card, tmp_path / "lost")


def test_force_removes_nothing_of_others(finished: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "copy"))
    for name in ("trials/notes.txt", "trials/mine.npz", "notes.txt"):
        (folder / name).write_text("mine")
    (folder / "trials/099.npz").write_bytes(b"of an earlier sweep with more cells")
    run_sweep(CARD, folder, workers=1, force=True)
    assert not (folder / "trials/099.npz").exists()
    for name in ("trials/notes.txt", "trials/mine.npz", "notes.txt"):
        assert (folder / name).read_text() == "mine"


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("link", [False, True])
def test_trials_of_others_are_neither_removed_nor_taken_for_ours(tmp_path: Path, force: bool, link: bool) -> None:
    place = tmp_path / ("theirs" if link else "out/trials")
    place.mkdir(parents=True)
    (place / "000.npz").write_bytes(b"mine")
    if link:
        (tmp_path / "out").mkdir()
        (tmp_path / "out/trials").symlink_to(place)
    with pytest.raises(RsbenchError, match="'rsbench simulate' did not make it; move it away"):
        run_sweep(CARD, tmp_path / "out", force=force)
    assert (place / "000.npz").read_bytes() == b"mine"


MISCHIEF = """
import os, sys, time
from rsbench.solvers.engine.base import Solver
from rsbench.solvers.engine.base import load_solver

EIGHT_POINT = load_solver("gs-8pt")

class Mischief(Solver):
    spec = EIGHT_POINT.spec

    def __init__(self):
        self.seen = 0

    def estimate(self, correspondences, rig, shutter):
        self.seen += 1
        if self.seen == 2:
            raise ArithmeticError("no luck")
        if self.seen == 3:
            print("overboard")
            os._exit(1)
        return EIGHT_POINT.estimate(correspondences, rig, shutter)
"""


def test_another_packages_solver_fails_alone(tmp_path: Path) -> None:
    """By trials that fail with their reasons, and nothing else changes."""
    (tmp_path / "mischief_in_sweeps.py").write_text(MISCHIEF)
    card = tmp_path / "mischief.toml"
    card.write_text('class = "mischief_in_sweeps:Mischief"')
    with SolverRunner() as runner:
        arrays = run_trials(SETTING, (str(card), "gs-8pt"), 0, 0, 5, robust=False, runner=runner)
    sys.modules.pop("mischief_in_sweeps", None)
    assert arrays["success"][:, 1].all()
    # The process that ended in the third trial took its count along.
    assert list(arrays["success"][:, 0]) == [True, False, False, True, False]
    assert list(arrays["reason"][[1, 2, 4], 0]) == [
        "raised ArithmeticError: no luck",
        "ended its process with exit code 1; it last printed: overboard",
        "raised ArithmeticError: no luck",
    ]
    good = arrays["success"][:, 0]
    np.testing.assert_array_equal(arrays["w_est"][good, 0], arrays["w_est"][good, 1])
    assert np.isnan(arrays["w_est"][~good, 0]).all()


def test_reasons_of_failures_are_counted() -> None:
    reasons = np.array(["", "a", "b", "c", "d"])
    codes = np.array([[0], [1], [2], [2], [3], [4], [0]])
    content = {"reasons": reasons, "reason_code": codes, "success": codes == 0}
    assert failure_reasons(content, 0) == "2 x b; 1 x a; 1 x c; 1 x others"
    assert failure_reasons(content | {"success": codes >= 0}, 0) == ""


def test_two_solvers_of_one_name_are_refused(tmp_path: Path) -> None:
    same = tmp_path / "gs-8pt.toml"
    same.write_text('class = "rsbench.solvers.linear:LinearSolver"')
    with pytest.raises(RsbenchError, match=r"gs-8pt.toml' and solver 'gs-8pt' are both named 'gs-8pt'"):
        run_sweep(replace(CARD, solvers=("gs-8pt", str(same))), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_results_of_other_code_are_refused_by_name_and_remade_by_force(finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "old"
    shutil.copytree(finished, folder)
    stored = json.loads((folder / "sweep.json").read_text())
    stored["solvers"][1]["key"] = "0" * 64
    (folder / "sweep.json").write_text(json.dumps(stored))
    (folder / "trials" / "001.npz").write_bytes(b"stale")
    with pytest.raises(
        RsbenchError, match=r"rs-stereo-linear made by other code or another card.*remake with --force"
    ):
        run_sweep(CARD, folder)
    run_sweep(CARD, folder, force=True)
    summarise_sweep(folder)
    assert contents(folder) == contents(finished)


def trials(setting: Setting, solvers: tuple[str, ...], seed: int, first: int, count: int) -> Arrays:
    with SolverRunner() as runner:
        return run_trials(setting, solvers, seed, first, count, robust=False, runner=runner)


def test_trials_depend_on_their_number_alone() -> None:
    whole = trials(SETTING, CARD.solvers, 0, 0, 4)
    part = trials(SETTING, CARD.solvers, 0, 2, 2)
    for name in ("w", "d", "w_est", "d_est", "success"):
        np.testing.assert_array_equal(whole[name][2:], part[name])
    alone = trials(SETTING, ("rs-stereo-linear",), 0, 0, 4)
    np.testing.assert_array_equal(alone["w_est"][:, 0], whole["w_est"][:, 1])
    other_seed = trials(SETTING, CARD.solvers, 1, 0, 4)
    assert not np.any(other_seed["w"] == whole["w"])


def test_noise_and_told_readout_share_exact_matches(finished: Path) -> None:
    cells = CARD.cells()
    assert [geometry_of(CARD, cell).index for cell in cells] == [0, 1, 0, 1]
    low, high = read_trials(finished, CARD, cells[0]), read_trials(finished, CARD, cells[2])
    np.testing.assert_array_equal(low["w"], high["w"])
    np.testing.assert_array_equal(
        read_bounds(finished, CARD, cells[0])["rotation"], read_bounds(finished, CARD, cells[2])["rotation"]
    )


def test_a_mistake_in_our_own_solver_stops(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise FloatingPointError("overflow")

    monkeypatch.setattr(EightPointSolver, "estimate", broken)
    with pytest.raises(FloatingPointError):
        trials(SETTING, ("gs-8pt",), 0, 0, 1)


def test_a_wrong_readout_ratio_reaches_the_solver_only() -> None:
    told = replace(SETTING, readout_ratio_error=-0.3, noise_px=0.0)
    assert told.shutter().readout_ratio == 0.8 and told.given_shutter().readout_ratio == pytest.approx(0.5)
    right, wrong = (trials(s, ("rs-stereo-linear",), 0, 0, 3) for s in (SETTING, told))
    np.testing.assert_array_equal(right["w"], wrong["w"])
    assert not np.any(right["w_est"] == wrong["w_est"])


OF_RIG = Setting(
    rig_card="shuttum-vertical", points=100, depth=(2.0, 10.0), rotation_deg=2.0, translation=0.3, noise_px=0.3
)


@pytest.mark.slow
def test_a_sweep_of_rigs_is_at_their_bounds_and_read_again(tmp_path: Path) -> None:
    """A global camera above one that rolls, 6 cm apart: what moves in between hides their disparity."""
    zed = Variant(name="zed2", setting={"rig_card": "zed2"})
    card = SweepCard(
        name="rigs",
        axis="noise_px",
        values=(0.3,),
        solvers=("rs-stereo-refined",),
        trials=16,
        setting=OF_RIG,
        variant=(Variant(name="vertical"), zed),
    )
    run_sweep(card, tmp_path / "out", workers=1)
    table = summarise_sweep(tmp_path / "out")
    assert np.all(table.success_share == 1.0)
    assert np.all(table[["e_R_over_bound", "e_T_over_bound"]] < 1.5)  # of 16 trials
    assert read_json(tmp_path / "out" / "sweep.json")["rigs"]["zed2"]["source"]
    run_sweep(card, tmp_path / "out", workers=1)


def test_rigs_of_settings_are_those_of_their_cards() -> None:
    rig = load_rig("shuttum-vertical")
    assert OF_RIG.rig() == rig.rig() and replace(OF_RIG, rig_card=rig).shutter() == OF_RIG.shutter()
    assert OF_RIG.shutter().still is False and OF_RIG.shutter().ratio_of("left") == 0.0
    assert replace(OF_RIG, baseline=0.3).rig().baseline == 0.3
    wrong: tuple[tuple[dict[str, Any], str], ...] = (
        ({"width": 640}, "rig_card and width exclude each other"),
        ({"rig_card": None}, "'width' is required"),
        ({"rig_card": replace(rig, readout_ratio=None)}, "'readout_ratio' is required"),
    )
    for changes, message in wrong:
        with pytest.raises(ValueError, match=message):
            replace(OF_RIG, **changes)


def test_bound_of_the_left_camera_agrees_with_finite_differences_of_its_residuals() -> None:
    """Fisher information of a rig of one, whose length is free, by numerical derivatives of the Sampson error."""
    bounds = run_bounds(SETTING, ("gs-8pt",), 0, 0, 1)
    simulation = _simulation(SETTING.exact(), [enter(load_solver_entry("gs-8pt"))], 0, 0)
    rig, shutter, motion = simulation.rig, simulation.shutter, simulation.motion
    left, alone = simulation.correspondences.left, StereoRig.of_one(rig.camera)
    start, end = (rig.cam_from_world(motion, tau, "left") for tau in (0.0, 1.0))
    d = end.t - end.R @ start.R.T @ start.t

    def residuals(theta: np.ndarray) -> np.ndarray:
        return rs_sampson_error(alone, shutter, LinearMotion(theta[:3], theta[3:]), "left", left)

    theta, step = np.concatenate([motion.w, d]), 1e-6
    J = np.stack([(residuals(theta + step * e) - residuals(theta - step * e)) / (2 * step) for e in np.eye(6)], -1)
    # Without the length of d, which changes no residual.
    basis = np.eye(6)[:, :5].copy()
    basis[3:, 3:] = np.linalg.svd(d[None])[2][1:].T
    covariance = basis @ np.linalg.inv((J @ basis).T @ (J @ basis)) @ basis.T
    direction = np.sqrt(np.trace(covariance[3:, 3:])) / np.linalg.norm(d)
    # The matches follow the law of the rig's middle, which differs by the square of the angle.
    assert np.linalg.norm(bounds["direction"][0, 0]) == pytest.approx(direction, rel=1e-2)
    assert np.linalg.norm(bounds["rotation"][0, 0]) == pytest.approx(
        np.sqrt(np.trace(covariance[:3, :3])), rel=1e-2
    )


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
        assert np.all(np.linalg.norm(bounds["rotation"], axis=-1) < 0.02)
        assert np.all((np.linalg.norm(bounds["direction"], axis=-1) < 0.1) == direction)
        assert np.median(bounds["scale"] < 0.5) == know_scale


def test_a_damaged_part_is_refused_by_name(finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(finished, folder)
    path = folder / "trials" / "000.npz"
    whole = load_arrays(path)
    for name, array in {"w": whole["w"][:, :2], "success": whole["success"].astype(float), "d_est": None}.items():
        kept = {key: value for key, value in whole.items() if key != name}
        save_arrays(path, kept if array is None else {**kept, name: array})
        with pytest.raises(RsbenchError, match=rf"000\.npz: '{name}' is damaged; delete the file"):
            summarise_sweep(folder)
    save_arrays(path, whole | {"reasons": whole["reasons"][:0]})
    with pytest.raises(RsbenchError, match="'reasons' is damaged"):
        summarise_sweep(folder)
    content = read_json(folder / "sweep.json")
    damages: list[dict[str, Any]] = [{"card": 3}, {"solvers": None}, {"solvers": [{}]}, {"solvers": [1]}]
    for damage in (*damages, {"solvers": content["solvers"][:1]}):
        write_json(folder / "sweep.json", content | damage)
        with pytest.raises(RsbenchError, match=r"sweep\.json: .*solvers"):
            summarise_sweep(folder)
