"""Problem files: what is read, what is refused, what is answered."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.motion import LinearMotion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.errors import RsbenchError
from rsbench.pipeline.problem import link_tracks, parse_problem, read_problem, solve_problem
from rsbench.pipeline.robust_motion import RobustOptions
from rsbench.solvers.engine.registry import load_solver_entry

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
SHUTTER = RollingShutter(height=900, readout_ratio=0.8)
MOTION = LinearMotion(np.array([0.012, -0.02, 0.016]), np.array([0.2, -0.12, 0.18]))
CORRESPONDENCES = simulate(
    RIG, SHUTTER, MOTION, SimulationOptions(pairs=40, tracks=30), np.random.default_rng(0)
).correspondences


def content(**changes: Any) -> dict[str, Any]:
    camera = RIG.camera
    data: dict[str, Any] = {
        "camera": {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
        "baseline": RIG.baseline,
        "readout_ratio": SHUTTER.readout_ratio,
        "left": CORRESPONDENCES.left.tolist(),
        "right": CORRESPONDENCES.right.tolist(),
        "tracks": CORRESPONDENCES.tracks.tolist(),
    }
    data.update(changes)
    return {key: value for key, value in data.items() if value is not None}


def test_reads_what_was_written(tmp_path: Path) -> None:
    path = tmp_path / "problem.json"
    path.write_text(json.dumps(content()))
    problem = read_problem(path)
    assert problem.rig == RIG and problem.shutter == SHUTTER
    for name in ("left", "right", "tracks"):
        np.testing.assert_array_equal(getattr(problem.correspondences, name), getattr(CORRESPONDENCES, name))
    assert problem.correspondences.stereo_0.shape == (0, 4)


def test_whole_numbers_and_absent_sets_are_fine() -> None:
    problem = parse_problem(json.dumps(content(left=[[1, 2, 3, 4]], right=[], tracks=None, baseline=1)), "p.json")
    np.testing.assert_array_equal(problem.correspondences.left, [[1.0, 2.0, 3.0, 4.0]])
    assert problem.correspondences.right.shape == (0, 4)


CAMERA = content()["camera"]
REFUSED: list[tuple[str, list[str]]] = [
    ("", ["not valid JSON", "line 1"]),
    ("{", ["not valid JSON"]),
    ("[1, 2]", ["JSON object", "list"]),
    ("null", ["JSON object"]),
    ("[" * 100_000, ["not valid JSON"]),
    (json.dumps(content(left=[[1, 2, 3, float("nan")]])), ["left.0.3 = nan", "finite"]),
    (json.dumps(content(baseline=float("inf"))), ["baseline = inf", "finite"]),
    (json.dumps(content()).replace('"baseline": 0.6', '"baseline": 1e999'), ["baseline"]),
    (json.dumps(content(baselin=0.6)), ["unknown key 'baselin'", "did you mean 'baseline'"]),
    (json.dumps(content(camera={**CAMERA, "k1": 0.1})), ["unknown key 'camera.k1'", "fx"]),
    (json.dumps(content(camera={**CAMERA, "fx": -5.0})), ["fx", "positive", "-5"]),
    (json.dumps(content(camera={**CAMERA, "width": 900.5})), ["camera.width", "900.5"]),
    (json.dumps(content(camera=None)), ["'camera' is required"]),
    (json.dumps(content(left=None)), ["'left' is required"]),
    (json.dumps(content(readout_ratio=1.5)), ["readout_ratio", "[0, 1]", "1.5"]),
    (json.dumps(content(baseline=0)), ["baseline", "positive"]),
    (json.dumps(content(baseline="0.6")), ["baseline = '0.6'"]),
    (json.dumps(content(left=[[1, 2, 3]])), ["left[0] = [1.0, 2.0, 3.0]", "4 numbers", "x0, y0, x1, y1"]),
    (json.dumps(content(tracks=[[0] * 8, [1] * 7])), ["tracks[1]", "8 numbers"]),
    (json.dumps(content(right=[[1, 2, 3, "4"]])), ["right.0.3", "'4'"]),
    (json.dumps(content(right="many")), ["right", "'many'"]),
    (json.dumps(content(left=[[1, 2, 3, True]])), ["left.0.3", "True"]),
]


@pytest.mark.parametrize(("text", "parts"), REFUSED)
def test_a_wrong_file_is_refused_in_one_line(text: str, parts: list[str]) -> None:
    with pytest.raises(RsbenchError) as caught:
        parse_problem(text, "p.json")
    message = str(caught.value)
    assert message.startswith("p.json: ") and "\n" not in message
    for part in parts:
        assert part in message


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RsbenchError, match="cannot be read"):
        read_problem(tmp_path / "missing.json")
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RsbenchError, match="not UTF-8"):
        read_problem(tmp_path / "binary.json")


def test_left_right_matches_at_the_same_pixels_become_tracks() -> None:
    tracks = CORRESPONDENCES.tracks
    c = Correspondences(
        left=np.concatenate([tracks[:20, [0, 1, 4, 5]], CORRESPONDENCES.left]),
        stereo_0=tracks[:15, :4],
        stereo_1=tracks[5:, 4:],
    )
    linked = link_tracks(c)
    np.testing.assert_array_equal(linked.tracks, tracks[5:15])
    assert len(link_tracks(linked).tracks) == 10
    assert link_tracks(CORRESPONDENCES) is CORRESPONDENCES


@pytest.mark.parametrize("name", ["rs-stereo-refined", "rs-stereo-linear", "gs-8pt"])
def test_answer_has_the_documented_fields(name: str) -> None:
    problem = parse_problem(json.dumps(content()), "p.json")
    options = RobustOptions(threshold_px=5.0)
    answer = solve_problem(problem, load_solver_entry(name), options)
    keys = ["solver", "success", "reason", "w", "d", "metric", "inliers_left", "inliers_right", "seconds"]
    assert list(answer) == keys
    assert json.loads(json.dumps(answer, allow_nan=False)) == answer
    assert answer["success"] and answer["solver"] == name
    np.testing.assert_allclose(answer["w"], MOTION.w, atol=3e-3)
    assert answer["inliers_left"] == 70
    assert answer["inliers_right"] == (0 if name == "gs-8pt" else 70)
    assert answer["metric"] is (name != "gs-8pt")


def test_a_failure_has_no_motion() -> None:
    problem = parse_problem(json.dumps(content(left=[], right=[], tracks=None)), "p.json")
    answer = solve_problem(problem, load_solver_entry("rs-stereo-refined"), RobustOptions())
    assert answer["success"] is False and answer["w"] is None and answer["d"] is None and answer["reason"]
    json.dumps(answer, allow_nan=False)
