"""Problem files: what is read, what is refused, what is answered."""

from __future__ import annotations

import io
import json
import re
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import refused
from general_rigs import RIGS
from solver_trials import RIG, SHUTTER, D, W

from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.components.motion_models import LinearMotion
from rsbench.core import so3
from rsbench.core.camera import Lens
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES
from rsbench.core.shutter import Scanning
from rsbench.pipeline.answer import EXTRAS, Answer, solve_problem
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.pipeline.problem import EXAMPLE, Problem, parse_problem, problem_record, read_problem, read_problems
from rsbench.solvers.engine.base import load_solver_entry
from rsbench.solvers.engine.robust_motion import RobustOptions

MOTION = LinearMotion(W, D)
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
    (json.dumps(content(left=None, right=None, tracks=None)), ["at least one of left, right, stereo_0"]),
    (json.dumps(content(name=3)), ["name = 3"]),
    (json.dumps(content(readout_ratio=1.5)), ["readout_ratio", "from 0 to 1", "1.5"]),
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
    with refused(*parts, match="^p.json: "):
        parse_problem(text, "p.json")


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RsbenchError, match="cannot be read"):
        read_problem(tmp_path / "missing.json")
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RsbenchError, match="is UTF-16 text"):
        read_problem(tmp_path / "binary.json")
    for name in ("frame.png", "Film.MP4"):
        with pytest.raises(RsbenchError, match="is an image or a video, but matches are needed"):
            read_problem(tmp_path / name)


@pytest.mark.parametrize("name", ["left", "right", "stereo_0", "tracks"])
def test_one_set_alone_is_a_problem(name: str) -> None:
    rows = [[1.0] * (8 if name == "tracks" else 4)]
    sets: dict[str, Any] = {"left": None, "right": None, "tracks": None}
    problem = parse_problem(json.dumps(content(**{**sets, name: rows})), "p.json")
    for other in ("left", "right", "stereo_0", "stereo_1", "tracks"):
        assert len(getattr(problem.correspondences, other)) == (other == name)


def test_straight_lines_are_read_and_solved_alone() -> None:
    s = simulate(RIG, SHUTTER.at_once(), MOTION, SimulationOptions(lines=20), np.random.default_rng(0))
    lines = s.correspondences.lines
    data = content(left=None, right=None, tracks=[], readout_ratio=0.0, lines=lines.tolist())
    problem = parse_problem(json.dumps(data), "here")
    np.testing.assert_array_equal(problem.correspondences.lines, lines)
    with SolverRunner() as runner:
        answer = solve_problem(problem, load_solver_entry("gs-stereo-triplets-lines"), RobustOptions(), runner)
    assert answer["success"] and np.abs(np.subtract(answer["w"], MOTION.w)).max() < 1e-9
    with pytest.raises(
        RsbenchError, match=r"here: lines\[0\] = \[1.0\]: must be 16 numbers in pixels: xl0a, yl0a, xl0b"
    ):
        parse_problem(json.dumps(data | {"lines": [[1.0]]}), "here")


def test_a_name_is_kept_and_else_it_is_the_files(tmp_path: Path) -> None:
    path = tmp_path / "walk.json"
    path.write_text(json.dumps(content()))
    assert read_problem(path).name == "walk"
    path.write_text(json.dumps(content(name="second floor")))
    assert read_problem(path).name == "second floor"


def write_npz(path: Path, **changes: Any) -> Path:
    camera = RIG.camera
    arrays: dict[str, Any] = {
        "camera": [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy],
        "baseline": RIG.baseline,
        "readout_ratio": SHUTTER.readout_ratio,
        "left": CORRESPONDENCES.left,
        "tracks": CORRESPONDENCES.tracks,
    } | changes
    np.savez(
        path, allow_pickle=False, **{key: np.array(value) for key, value in arrays.items() if value is not None}
    )
    return path


def test_arrays_are_the_same_problem_as_text(tmp_path: Path) -> None:
    problem = read_problem(write_npz(tmp_path / "walk.npz"))
    assert (problem.rig, problem.shutter, problem.name) == (RIG, SHUTTER, "walk")
    np.testing.assert_array_equal(problem.correspondences.left, CORRESPONDENCES.left)
    np.testing.assert_array_equal(problem.correspondences.tracks, CORRESPONDENCES.tracks)
    assert len(problem.correspondences.right) == 0
    assert read_problem(write_npz(tmp_path / "walk.npz", name="stairs")).name == "stairs"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"left": [[1.0, 2.0, 3.0]]}, "left must have 4 numbers"),
        ({"tracks": np.full((3, 8), np.nan)}, "tracks[0] must be finite"),
        ({"left": [["1", "2", "3", "4"]]}, "left: must be numbers"),
        ({"lefd": np.zeros((1, 4))}, "unknown key 'lefd' (did you mean 'left'?)"),
        ({"baseline": None}, "'baseline' is required"),
        ({"baseline": [0.1, 0.2]}, "must be one number"),
        ({"baseline": -1.0}, "baseline = -1.0: must be a positive number"),
        ({"camera": [900, 900, 810, 810, 449.5]}, "must be width, height"),
        ({"camera": [900.5, 900, 810, 810, 449.5, 449.5]}, "the first two whole"),
        ({"camera": [900, 900, -810, 810, 449.5, 449.5]}, "fx"),
        ({"name": 3}, "name: must be a text"),
        ({"left": None, "tracks": None}, "at least one of left, right"),
    ],
)
def test_wrong_arrays_are_refused_in_one_line(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    path = write_npz(tmp_path / "p.npz", **changes)
    with refused(str(path), words):
        read_problem(path)


NPY = b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (0,), }".ljust(127) + b"\n"


@pytest.mark.parametrize("data", [b"", NPY, b"PK\x03\x04 nothing", b"\x93NUMPY nothing"])
def test_a_file_that_is_no_npz_is_refused(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "p.npz").write_bytes(data)
    with pytest.raises(RsbenchError, match=r"p\.npz: "):
        read_problem(tmp_path / "p.npz")


def lines() -> str:
    """Three problems, the second of which is wrong, with an empty line."""
    good, bad = json.dumps(content(name="one")), json.dumps(content(baseline=-1))
    return f"{good}\n{bad}\n\n{json.dumps(content())}\n"


def told(problems: Iterable[Problem | RsbenchError]) -> list[str]:
    return [each.name if isinstance(each, Problem) else str(each).partition(" ")[0] for each in problems]


def test_lines_are_problems_of_their_own_and_a_wrong_one_does_not_stop_the_rest(tmp_path: Path) -> None:
    path = tmp_path / "many.jsonl"
    path.write_text(lines())
    assert told(read_problems(path, io.StringIO())) == ["one", f"{path}:2:", "many:4"]
    assert told(read_problems("-", io.StringIO(lines()))) == ["one", "stdin:2:", "stdin:4"]


def test_standard_input_may_be_one_problem_on_several_lines() -> None:
    text = json.dumps(content(), indent=1)
    assert told(read_problems("-", io.StringIO(text))) == ["stdin"]
    assert told(read_problems("-", io.StringIO("{\n"))) == ["stdin:"]


def test_problems_are_answered_as_they_come() -> None:
    """The second line is not read before the first problem is out: a program may wait for its answer."""
    read = []

    class Terminal(io.StringIO):
        def readline(self, *limit: int) -> str:
            read.append(super().readline(*limit))
            return read[-1]

    next(iter(read_problems("-", Terminal(lines()))))
    assert len(read) == 1


def test_a_folder_is_its_files_by_name(tmp_path: Path) -> None:
    assert "holds no problem" in str(next(iter(read_problems(tmp_path, io.StringIO()))))
    write_npz(tmp_path / "b.npz")
    (tmp_path / "a.json").write_text(json.dumps(content()))
    (tmp_path / "c.jsonl").write_text(lines())
    (tmp_path / "notes.txt").write_text("no problem")
    (tmp_path / "d.json").write_text("{")
    found = told(read_problems(tmp_path, io.StringIO()))
    assert found == ["a", "b", "one", f"{tmp_path / 'c.jsonl'}:2:", "c:4", f"{tmp_path / 'd.json'}:"]


def answer_of(problem: Problem, name: str, threshold_px: float = 5.0, **keywords: Any) -> Answer:
    options = RobustOptions(threshold_px=threshold_px)
    with SolverRunner() as runner:
        return solve_problem(problem, load_solver_entry(name), options, runner, **keywords)


@pytest.mark.parametrize("name", ["rs-stereo-refined", "rs-stereo-linear", "gs-8pt"])
def test_answer_names_its_point_its_unit_and_counts_each_match_once(name: str) -> None:
    answer = answer_of(parse_problem(json.dumps(content()), "p.json"), name)
    assert json.loads(json.dumps(answer, allow_nan=False)) == answer
    assert answer["success"] and (answer["name"], answer["solver"]) == ("p.json", name)
    np.testing.assert_allclose(answer["w"], MOTION.w, atol=3e-3)
    left = name == "gs-8pt"
    assert answer["metric"] is not left
    assert answer["d_unit"] == ("none: direction only" if left else "m")
    assert answer["reference_point"] == ("left" if left else "body")
    assert answer["shutter"] == ("global" if left else "rolling") and answer["motion_model"] == "linear"
    assert answer["d_body"] == (None if left else answer["d"])
    # 40 pairs per camera and 30 tracks: for a solver of pairs a track is a left and a right one.
    assert answer["matches"] == {"gs-8pt": 70, "rs-stereo-linear": 140, "rs-stereo-refined": 110}[name]
    assert answer["inliers"] == answer["matches"]


def test_the_documented_keys_are_those_of_the_answer() -> None:
    text = (Path(__file__).parents[2] / "docs" / "reference" / "problem-format.md").read_text()
    section = text[text.index("## An answer") : text.index("## The sample")]
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    documented = [key for row in rows for key in re.findall(r"`(\w+)`", row)]
    answer = answer_of(parse_problem(json.dumps(content()), "p.json"), "rs-stereo-refined", extras=EXTRAS)
    assert documented == list(answer)


def test_the_documented_program_makes_the_sample(capsys: pytest.CaptureFixture[str]) -> None:
    text = (Path(__file__).parents[2] / "docs" / "reference" / "problem-format.md").read_text()
    program = text[text.index("```python\n") + 10 :].partition("```")[0]
    exec(compile(program, "problem-format.md", "exec"), {})
    assert capsys.readouterr().out == EXAMPLE.read_text()


def test_the_sample_is_solved_near_its_truth() -> None:
    answer = answer_of(read_problem(EXAMPLE), "rs-stereo-refined", threshold_px=1.25)
    # 0.2 px over 500 px of focal length, 70 points: a few times 1e-4 rad, 1 mm.
    np.testing.assert_allclose(answer["w"], [0.01, -0.02, 0.015], atol=5e-4)
    np.testing.assert_allclose(answer["d"], [0.08, -0.02, 0.12], atol=4e-3)
    assert answer["stereo_alone"] == {"stereo_0": 0, "stereo_1": 0} and answer["matches"] == 80


def test_left_right_matches_that_join_nothing_are_said() -> None:
    tracks = CORRESPONDENCES.tracks
    sets = {"left": tracks[:, [0, 1, 4, 5]], "stereo_0": tracks[:20, :4] + 1e-6, "stereo_1": tracks[10:, 4:]}
    changes = {name: rows.tolist() for name, rows in sets.items()}
    answer = answer_of(
        parse_problem(json.dumps(content(right=None, tracks=None, **changes)), "p.json"), "rs-stereo-refined"
    )
    assert answer["stereo_alone"] == {"stereo_0": 10, "stereo_1": 10}
    assert answer["reason"].count("10 of 20 stereo_0 and 10 of 20 stereo_1 matches join no match over time") == 1


def test_extras_are_given_on_request() -> None:
    c = CORRESPONDENCES
    off = c.left + 0.0
    off[3] += [0, 0, 40, -40]
    problem = parse_problem(json.dumps(content(left=off.tolist(), stereo_0=c.tracks[:, :4].tolist())), "p.json")
    answer = answer_of(problem, "rs-stereo-refined", extras=EXTRAS)
    assert answer["inlier_indices"]["left"] == [k for k in range(40) if k != 3]
    assert answer["inlier_indices"]["tracks"] == list(range(30))
    assert np.array(answer["covariance"]).shape == (6, 6) and answer["noise_px"] >= 0.0
    assert "covariance" not in answer_of(problem, "rs-stereo-refined", extras=["noise"])
    assert answer_of(problem, "gs-8pt", extras=EXTRAS)["covariance"] is None


def test_a_failure_has_no_motion() -> None:
    problem = parse_problem(json.dumps(content(left=[], right=[], tracks=None)), "p.json")
    answer = answer_of(problem, "rs-stereo-refined", extras=EXTRAS)
    assert answer["success"] is False and answer["reason"]
    assert answer["w"] is answer["d"] is answer["d_body"] is answer["covariance"] is None
    json.dumps(answer, allow_nan=False)


@pytest.mark.slow
def test_seconds_hold_no_compilation() -> None:
    """In a fresh process the first problem takes about as long as the second one, and not what loading takes."""
    code = (
        "from rsbench.pipeline.answer import *; from rsbench.pipeline.problem import *\n"
        "from rsbench.solvers.engine.base import load_solver_entry\n"
        "problem, entry = read_problem(EXAMPLE), load_solver_entry('rs-stereo-refined')\n"
        "with SolverRunner() as runner:\n"
        "    print([solve_problem(problem, entry, RobustOptions(), runner)['seconds'] for _ in range(5)])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    first, *later = json.loads(result.stdout)
    # Loading compiled code takes ten times as long as this problem, compiling it a thousand times.
    assert first < 5.0 * max(later) + 0.05


def test_a_problem_may_have_a_lens_another_scan_and_a_late_camera() -> None:
    lens = Lens(model="kannala-brandt", k1=-0.02, k2=0.004)
    rig = replace(RIG, camera=replace(RIG.camera, lens=lens))
    shutter = replace(SHUTTER, scan="bottom", right_scan="left", right_delay=0.1, width=900)
    seen = simulate(rig, shutter, MOTION, SimulationOptions(tracks=30), np.random.default_rng(0)).correspondences
    data = content(left=[], right=[], tracks=seen.tracks.tolist())
    data["camera"]["lens"] = {"model": "kannala-brandt", "k1": -0.02, "k2": 0.004}
    data |= {"scan": "bottom", "right_scan": "left", "right_delay": 0.1}
    problem = parse_problem(json.dumps(data), "p.json")
    assert (problem.rig, problem.shutter) == (rig, shutter)
    with SolverRunner() as runner:
        answer = solve_problem(problem, load_solver_entry("rs-stereo-refined"), RobustOptions(), runner)
        asked = solve_problem(
            problem, load_solver_entry("rs-stereo-refined"), RobustOptions(), runner, motion_model="auto"
        )
    # Exact matches: what is left is where the descent stops.
    np.testing.assert_allclose(answer["w"], MOTION.w, atol=1e-7)
    np.testing.assert_allclose(asked["w"], MOTION.w, atol=1e-7)


def test_a_lens_that_folds_is_one_line_with_the_field() -> None:
    data = content()
    data["camera"]["lens"] = {"model": "brown-conrady", "k1": -2.0}
    with pytest.raises(
        RsbenchError, match=r"^p.json: camera: camera lens: the brown-conrady polynomial folds"
    ) as error:
        parse_problem(json.dumps(data), "p.json")
    assert "\n" not in str(error.value)
    data["camera"]["lens"] = {"model": "brown-conrady", "k7": 0.1}
    with pytest.raises(RsbenchError, match=r"unknown key 'camera.lens.k7'"):
        parse_problem(json.dumps(data), "p.json")


# Format 2: any two cameras.


def of_any_rig(**changes: Any) -> dict[str, Any]:
    rig = RIGS["turned"]
    motion = LinearMotion(np.array([0.01, 0.03, -0.02]), np.array([0.05, -0.1, 0.12]))
    shutter = rig.shutter_of(Scanning(right_readout_ratio=0.3), 0.8)
    matches = simulate(
        rig, shutter, motion, SimulationOptions(pairs=40, tracks=40, depth=(3.0, 8.0)), np.random.default_rng(0)
    ).correspondences
    found = problem_record(Problem(name="any", correspondences=matches, rig=rig, known_shutter=shutter))
    return {key: value for key, value in (found | changes).items() if value is not None}


def test_a_problem_of_any_rig_is_read_as_written_and_solved_exactly() -> None:
    data = of_any_rig()
    problem = parse_problem(json.dumps(data), "p.json")
    assert problem.shutter == RIGS["turned"].shutter_of(Scanning(right_readout_ratio=0.3), 0.8)
    assert problem.rig.right_from_left.R.tolist() == pytest.approx(RIGS["turned"].right_from_left.R, abs=1e-15)
    w, d = np.array([0.01, 0.03, -0.02]), np.array([0.05, -0.1, 0.12])
    answer = answer_of(problem, "rs-stereo-refined")
    np.testing.assert_allclose([answer["w"], answer["d"]], [w, d], atol=1e-8)
    for side in SIDES:  # in its own axes, against the poses at 0 and 1
        (R0, t0), (R1, t1) = (problem.rig.cam_from_world(LinearMotion(w, d), k, side) for k in (0, 1))
        turned = R1 @ R0.T
        own = answer["cameras"][side]
        np.testing.assert_allclose(so3.exp(np.array(own["w"])), turned, atol=1e-8)
        np.testing.assert_allclose(own["d"], t1 - turned @ t0, atol=1e-8)
    one = answer_of(problem, "rs-mono-refined")["cameras"]
    assert one["right"]["d"] is None and np.linalg.norm(one["left"]["d"]) == pytest.approx(1.0)
    assert "perfect alignment" in answer_of(problem, "rs-r6p")["reason"]
    assert answer_of(problem, "rs-r6p")["cameras"] is None


def test_equal_aligned_cameras_have_the_answers_of_format_1() -> None:
    camera = content()["camera"]
    pose = {"translation": [-RIG.baseline, 0.0, 0.0]}
    both = content(camera=None, baseline=None, cameras={"left": camera, "right": camera}, right_from_left=pose)
    answers = [
        answer_of(parse_problem(json.dumps(each), "p.json", "p"), "rs-stereo-refined")
        for each in (content(), both)
    ]
    for answer in answers:
        del answer["seconds"]
    assert answers[0] == answers[1]


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({"camera": content()["camera"]}, ["camera and cameras exclude", "right_from_left"]),
        ({"baseline": 0.2}, ["baseline and cameras exclude"]),
        ({"right_from_left": None}, ["'right_from_left' is required"]),
        ({"cameras": None}, ["'cameras' is required"]),
        ({"cameras": {"left": content()["camera"]}}, ["cameras.right"]),
        ({"right_from_left": {"translation": [0.0, 0.0, 0.0]}}, ["right_from_left", "translation", "one place"]),
        (
            {"right_from_left": {"translation": [-1, 0, 0], "rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}},
            ["rotation"],
        ),
        ({"readout_ratio": None}, ["right_readout_ratio = 0.3", "needs readout_ratio"]),
    ],
)
def test_a_wrong_rig_is_refused_in_one_line(changes: dict[str, Any], parts: list[str]) -> None:
    with refused(*parts, match="^p.json: "):
        parse_problem(json.dumps(of_any_rig(**changes)), "p.json")
