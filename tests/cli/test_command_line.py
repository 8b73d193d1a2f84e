"""The command as users meet it: exit codes, one-line errors, nothing half-written, quick help."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import assert_refused, run_here

from rsbench.benchmark.simulated.simulation import SimulationOptions, random_motion, simulate
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter


@pytest.fixture(scope="module")
def problem() -> dict[str, Any]:
    """A problem with 120 tracks and 60 pairs per camera, noise 0.3 px, and its truth."""
    rng = np.random.default_rng(7)
    camera = PinholeCamera.centred(900, 900, 810.0)
    rig, shutter = StereoRig(camera=camera, baseline=0.6), RollingShutter(height=900, readout_ratio=0.8)
    motion = random_motion(rng, np.deg2rad(2.0), 0.3)
    options = SimulationOptions(pairs=60, tracks=120, noise_px=0.3)
    matches = simulate(rig, shutter, motion, options, rng).correspondences
    fields = ("width", "height", "fx", "fy", "cx", "cy")
    return {
        "camera": {field: getattr(camera, field) for field in fields},
        "baseline": 0.6,
        "readout_ratio": 0.8,
        "left": matches.left.tolist(),
        "right": matches.right.tolist(),
        "tracks": matches.tracks.tolist(),
        "truth": {"w": motion.w.tolist(), "d": motion.d.tolist()},
    }


def write_problem(folder: Path, problem: dict[str, Any], **changes: Any) -> Path:
    path = folder / "problem.json"
    content = {key: value for key, value in (problem | changes).items() if key != "truth" and value is not None}
    path.write_text(json.dumps(content))
    return path


def test_help_loads_nothing_heavy() -> None:
    heavy = ("numpy", "pandas", "mitsuba", "cv2", "scipy", "numba", "trimesh", "matplotlib")
    code = f"import sys, rsbench.cli.main; print([m for m in {heavy!r} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "command", ["demo", "list", "doctor", "generate", "verify", "view", "export", "solve", "evaluate", "reproduce"]
)
def test_every_command_has_help_with_an_example(command: str) -> None:
    result = run_here(command, "--help")
    assert result.returncode == 0
    assert f"rsbench {command}" in result.stdout
    assert "Example" in result.stdout


@pytest.mark.parametrize("kind", ["scenes", "renderers", "solvers", "datasets"])
def test_list_names_every_card_with_a_description(kind: str) -> None:
    result = run_here("list", kind)
    assert result.returncode == 0
    for path in (Path(__file__).parents[2] / kind).glob("*.toml"):
        assert path.stem in result.stdout


def test_unknown_card_is_refused_with_the_names_that_exist(tmp_path: Path) -> None:
    # In a process of its own: exit code and line are those of the program, not of a function.
    command = [sys.executable, "-m", "rsbench", "generate", "papre", "--out", str(tmp_path / "x")]
    result = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert_refused(result, "papre", "paper")
    assert result.stdout == ""
    assert not (tmp_path / "x").exists()


def test_unknown_solver_is_refused_with_the_names_that_exist(tmp_path: Path, problem: dict[str, Any]) -> None:
    path = write_problem(tmp_path, problem)
    assert_refused(run_here("solve", path, "--solver", "gs-9pt"), "gs-9pt", "gs-8pt")


def test_missing_dataset_is_refused(tmp_path: Path) -> None:
    assert_refused(run_here("verify", tmp_path / "none"), "none")
    assert_refused(run_here("evaluate", tmp_path / "none", "--out", tmp_path / "e"), "none")
    assert not (tmp_path / "e").exists()


def test_solve_answers_in_json_near_the_truth(tmp_path: Path, problem: dict[str, Any]) -> None:
    result = run_here("solve", write_problem(tmp_path, problem), "--json")
    assert result.returncode == 0, result.stderr
    answer = json.loads(result.stdout)
    fields = "name solver success reason w d d_unit reference_point inliers matches seconds"
    assert set(fields.split()) <= set(answer)
    # Five times the bound of 240 pairs and 120 tracks at 0.3 px: about 0.01 deg and 0.6 % of 0.3 m.
    np.testing.assert_allclose(answer["w"], problem["truth"]["w"], atol=np.deg2rad(0.05))
    np.testing.assert_allclose(answer["d"], problem["truth"]["d"], atol=0.01)
    assert answer["metric"] is True and answer["d_unit"] == "m" and answer["reference_point"] == "body"
    assert answer["inliers"] <= answer["matches"] == 240  # 60 pairs of each camera and 120 tracks, each once


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"left": [[1.0, 2.0, float("nan"), 4.0]]}, ("left",)),
        ({"left": [[1.0, 2.0, 3.0]]}, ("left",)),
        ({"baseline": None}, ("baseline",)),
        ({"baseline": -1.0}, ("baseline", "-1")),
        ({"readout_ratio": 2.0}, ("readout_ratio", "2")),
        ({"lefd": []}, ("lefd",)),
        ({"camera": {"width": 900}}, ("camera",)),
    ],
    ids=["nan", "three numbers", "no baseline", "negative baseline", "ratio", "unknown key", "camera"],
)
def test_bad_problem_is_refused_in_one_line(
    tmp_path: Path, problem: dict[str, Any], changes: dict[str, Any], words: tuple[str, ...]
) -> None:
    assert_refused(run_here("solve", write_problem(tmp_path, problem, **changes)), "problem.json", *words)


def test_problem_that_is_not_json_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "problem.json"
    path.write_text('{"camera": ')
    assert_refused(run_here("solve", path), "problem.json", "JSON")
    assert_refused(run_here("solve", tmp_path / "absent.json"), "absent.json")


@pytest.mark.parametrize("solver", ["rs-stereo-refined", "rs-stereo-linear", "gs-8pt"])
def test_too_few_matches_is_a_failure_with_a_reason(tmp_path: Path, problem: dict[str, Any], solver: str) -> None:
    few: dict[str, Any] = {"left": problem["left"][:2], "right": [], "tracks": []}
    result = run_here("solve", write_problem(tmp_path, problem, **few), "--solver", solver, "--json")
    assert result.returncode == 1
    answer = json.loads(result.stdout)
    assert answer["success"] is False
    assert answer["w"] is None
    assert answer["reason"]


def test_matches_without_a_motion_are_a_failure(tmp_path: Path, problem: dict[str, Any]) -> None:
    rng = np.random.default_rng(3)
    noise: dict[str, Any] = {
        "left": rng.uniform(0, 899, (80, 4)).tolist(),
        "right": rng.uniform(0, 899, (80, 4)).tolist(),
        "tracks": [],
    }
    result = run_here("solve", write_problem(tmp_path, problem, **noise), "--json")
    assert result.returncode == 1
    assert json.loads(result.stdout)["success"] is False


def test_damaged_depth_is_refused_by_evaluate_and_found_by_verify(smoke_dataset: Path, tmp_path: Path) -> None:
    copy = tmp_path / "smoke"
    shutil.copytree(smoke_dataset, copy)
    damaged = copy / "castle/rs_depth/left_0.exr"
    damaged.write_bytes(damaged.read_bytes()[:500])
    assert_refused(
        run_here("evaluate", copy, "--out", tmp_path / "e", "--solver", "gs-8pt"), "left_0.exr", "damaged"
    )
    result = run_here("verify", copy, "--rerender", "no")
    assert result.returncode == 1
    assert "left_0.exr" in result.stderr


def test_verify_passes_on_sound_data(smoke_dataset: Path) -> None:
    result = run_here("verify", smoke_dataset, "--fast")
    assert result.returncode == 0, result.stderr
    assert "0 faults" in result.stdout.splitlines()[-1]
    assert "--fast left out: rows rendered again" in result.stdout + result.stderr


def test_evaluate_writes_scores_and_a_page_without_links(smoke_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "evaluation"
    result = run_here(
        "evaluate", smoke_dataset, "--out", out, "--solver", "gs-8pt", "--solver", "rs-stereo-refined"
    )
    assert result.returncode == 0, result.stderr
    assert str((out / "report.html").resolve()) in result.stdout.replace("\n", "")
    page = (out / "report.html").read_text()
    assert "http://" not in page and "https://" not in page, "the page must open without a network"
    for table in ("pose", "depth", "correction"):
        assert len((out / "scores" / f"{table}.csv").read_text().splitlines()) > 2
