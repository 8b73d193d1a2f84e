"""Scores, boards and files of predictions of the tracks of motions."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from commands import assert_refused, refused, run_here
from hypothesis import given, settings
from hypothesis import strategies as st
from leaderboards import (
    Line,
    entered,
    erring,
    handed_in,
    jobs_here,
    leaderboard,
    lines_of,
    named,
    run_entries,
    scores_of,
    small_split,
    truth_lines,
    write,
)

from rsbench.benchmark.leaderboard import running
from rsbench.benchmark.leaderboard.board import ORACLES, add, entries_of, merge, rescore, restore, splits_of, store
from rsbench.benchmark.leaderboard.inputs import write_inputs
from rsbench.benchmark.leaderboard.motion_tracks import AUC_DEG, motion_row, uses_of
from rsbench.benchmark.leaderboard.running import run_cards
from rsbench.benchmark.leaderboard.splits import simulated_problem
from rsbench.benchmark.leaderboard.standings import standings, table
from rsbench.benchmark.leaderboard.submissions import (
    check_submission,
    failure_reasons,
    read_submission,
    write_template,
)
from rsbench.benchmark.leaderboard.track import KNOWLEDGE, Limits, Split
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.components.cards import parse_card
from rsbench.core.errors import RsbenchError
from rsbench.jobs.isolation import Outcome
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.report.board_page import build_site
from rsbench.solvers.engine.base import BESIDE, load_solver_entry
from rsbench.storage.files import load_arrays

ROOT = Path(__file__).parents[3]
SPLIT = small_split()
TRUTH = truth_lines(SPLIT)


def _noisy(size: float, seed: int = 0) -> list[Line]:
    return [TRUTH[0], *erring(TRUTH[1:], size, 0.3 * size, seed)]


# Scores


def test_the_truth_and_nothing_have_the_ends_of_each_score(tmp_path: Path) -> None:
    best, worst = (scores_of(SPLIT, lines, tmp_path) for lines in (TRUTH, TRUTH[:1]))
    for limit in AUC_DEG:
        assert best[f"auc_{limit}"].min() > 1.0 - 1e-6 and worst[f"auc_{limit}"].max() == 0.0
    worst_of = {"e_R_deg": 180.0, "e_T_deg": 180.0, "e_s": np.inf, "metres": np.inf, "e_row_deg": 180.0}
    for name, most in worst_of.items():
        assert best[name].max() < 1e-5 and np.all(worst[name] == most)
    assert worst["failure"].all() and not best["failure"].any() and not worst["success"].any()


def test_auc_is_the_area_below_the_curve(tmp_path: Path) -> None:
    scores = scores_of(SPLIT, _noisy(0.03), tmp_path)
    for limit in AUC_DEG:
        x = np.linspace(0.0, limit, 20_001)
        recall = np.mean(scores["error_deg"].to_numpy()[:, None] <= x, axis=0)
        # The rule of the trapezoid errs by half a step at each of the jumps.
        assert abs(np.trapezoid(recall, x) / limit - scores[f"auc_{limit}"].mean()) < 1e-4


def test_the_left_camera_is_another_point(tmp_path: Path) -> None:
    """The left camera's true motion, found from its poses, scores as the body's does."""
    lines = [TRUTH[0]]
    for truth, line in zip(SPLIT.truths, TRUTH[1:], strict=True):
        start, end = (truth.rig.cam_from_world(truth.motion, tau, "left") for tau in (0.0, 1.0))
        d = end.t - end.R @ start.R.T @ start.t
        lines.append({**line, "d": d.tolist(), "reference_point": "left"})
    scores = scores_of(SPLIT, lines, tmp_path)
    assert scores["error_deg"].max() < 1e-5 and scores["metres"].max() < 1e-9


def test_the_error_of_rows_grows_with_the_readout(tmp_path: Path) -> None:
    """About one axis the last row of frame 1 is off by (1 + readout ratio) times e_R."""
    lines = [TRUTH[0], *({**line, "w": (1.01 * np.array(line["w"])).tolist()} for line in TRUTH[1:])]
    scores = scores_of(SPLIT, lines, tmp_path)
    ratio = np.array([truth.shutter.readout_ratio for truth in SPLIT.truths])
    np.testing.assert_allclose(scores["e_row_deg"], (1.0 + ratio) * scores["e_R_deg"], rtol=1e-6)


def test_stated_covariances_are_judged(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    half = rng.standard_normal((6, 6)) * 1e-3
    covariance = (half @ half.T).tolist()
    lines, squares = [TRUTH[0]], list[float]()
    for line in TRUTH[1:]:
        error = rng.standard_normal(6) * 1e-3
        squares.append(float(error @ np.linalg.solve(half @ half.T, error)))
        theta = np.array([*line["w"], *line["d"]]) + error
        lines.append({**line, "w": theta[:3].tolist(), "d": theta[3:].tolist(), "covariance": covariance})
    np.testing.assert_allclose(scores_of(SPLIT, lines, tmp_path)["nees"], squares, rtol=1e-6)


# Boards


def test_entries_stand_alone_and_copies_tie(tmp_path: Path) -> None:
    board = tmp_path / "board"
    handed_in(board, named(_noisy(0.1), "a"), SPLIT)
    (alone,) = entries_of(board, "points-1", SPLIT.name)
    for name, lines in (("copy", _noisy(0.1)), ("better", _noisy(0.03)), ("worse", _noisy(0.6))):
        handed_in(board, named(lines, name), SPLIT)
    handed_in(board, TRUTH, SPLIT, ORACLES)
    entries = entered(board, SPLIT)
    pd.testing.assert_frame_equal(entries["a"].scores, alone.scores)
    found = {line.scored.header.method: line for line in standings([*entries.values()])}
    assert "copy" in found["a"].ties and "a" in found["copy"].ties and found["a"].rank == found["copy"].rank
    assert found["truth"].rank is None and list(found)[-1] == "truth"
    assert next(iter(found)) == "better" and found["better"].peers == 4
    numbers = table(list(found.values()))
    assert list(numbers["method"]) == list(found) and numbers["rank"].isna().sum() == 1


def test_boards_merge_and_names_clash(tmp_path: Path) -> None:
    boards = [tmp_path / "one", tmp_path / "two"]
    for board, name, size in ((boards[0], "a", 0.01), (boards[1], "b", 0.02), (boards[1], "a", 0.01)):
        handed_in(board, named(_noisy(size), name), SPLIT)
    assert merge(boards[1], boards[0]) == [f"points-1/{SPLIT.name}/b"]
    assert merge(boards[1], boards[0]) == []
    assert [e.header.method for e in entries_of(boards[0], *splits_of(boards[0])[0])] == ["a", "b"]
    assert rescore(boards[0], SPLIT) == {}
    clash = write(tmp_path / "x.jsonl", named(_noisy(0.5), "b"))
    with pytest.raises(RsbenchError, match="with other predictions"):
        add(boards[0], clash, SPLIT, {})
    add(boards[1], clash, SPLIT, {}, replace=True)
    with pytest.raises(RsbenchError, match="with other predictions"):
        merge(boards[1], boards[0])


def test_scores_that_were_changed_are_named(tmp_path: Path) -> None:
    board = tmp_path / "board"
    scored = handed_in(board, named(_noisy(0.01), "a"), SPLIT)
    path = scored.folder / "scores.csv"
    forged = pd.read_csv(path).assign(auc_5=1.0)
    forged.to_csv(path, index=False)
    assert rescore(board, SPLIT) == {"a": ["auc_5"]}
    assert rescore(board, SPLIT) == {}
    path.write_text("problem\n", "utf-8")
    with pytest.raises(RsbenchError, match="lacks the column"):
        entries_of(board, "points-1", SPLIT.name)
    assert "auc_5" in rescore(board, SPLIT)["a"]
    assert rescore(board, SPLIT) == {}
    predictions = scored.folder / "predictions.jsonl"
    predictions.write_text(predictions.read_text("utf-8").replace("[", "[ "), "utf-8")
    with pytest.raises(RsbenchError, match="has changed since it was scored"):
        rescore(board, SPLIT)


def test_readout_ratios_are_asked(smoke_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The ratio is not told, one that is off by 0.03 scores 0.7, and small frames are failures by value."""
    monkeypatch.setattr(running, "finished_jobs", jobs_here)
    split = TRACKS["readout"].split(smoke_dataset)
    where = ("--data", smoke_dataset, "--board", tmp_path / "board")
    leaderboard("export", "readout", *where[:2], "--out", tmp_path / "in")
    assert "0.8" not in (tmp_path / "in" / "problems.csv").read_text("utf-8")
    assert "readout_ratio" not in (tmp_path / "in" / "problems.jsonl").read_text("utf-8")
    assert load_arrays(tmp_path / "in" / "problems.npz")["rig"].shape == (2, 7)
    head, *answers = truth_lines(split)
    off = [{**head, "method": "off", "uses": ["left"]}, *({**a, "readout_ratio": 0.77} for a in answers)]
    leaderboard("oracles", "readout", *where)
    leaderboard("submit", write(tmp_path / "x.jsonl", off), *where)
    run_entries("readout", ["rs-stereo-refined"], *where)
    refused = run_here("leaderboard", "run", "readout", *where, "--entry", "gs-8pt")
    assert_refused(refused, "gs-8pt", "finds no readout ratio")
    percent = [head, *({**a, "readout_ratio": 80} for a in answers)]
    checked = run_here("leaderboard", "check", write(tmp_path / "x.jsonl", percent), *where[:2])
    assert checked.returncode == 2 and "readout_ratio = 80.0: must lie in [0, 1]" in checked.stderr
    found = {name: each.scores for name, each in entered(tmp_path / "board", split).items()}
    np.testing.assert_allclose(found["off"]["auc_r10"], 0.7, atol=1e-6)
    assert np.all(found["truth"]["auc_r02"] == 1.0) and np.all(found["off"]["auc_r02"] == 0.0)
    assert not found["rs-stereo-refined"]["success"].any()  # frames of 128 x 96 px do not determine it
    assert np.all(found["rs-stereo-refined"]["e_readout"] == 1.0)
    build_site(tmp_path / "board", tmp_path / "site")
    assert "AUC@0.1" in (tmp_path / "site" / "index.html").read_text("utf-8")


def test_our_solver_finds_the_ratio_that_it_is_not_told() -> None:
    """Of the public problems the two with the fastest turn whose noise is below 0.2 px."""
    clear = [t for t in TRACKS["points"].split(None).truths if float(t.facts["noise_px"]) < 0.2]
    entry = load_solver_entry("rs-stereo-refined")
    for truth in sorted(clear, key=lambda t: -float(t.facts["rotation_deg"]))[:2]:
        problem = simulated_problem(1, int(truth.name[1:]))
        blind = replace(problem, known_shutter=problem.shutter.with_ratio(0.0))
        with SolverRunner() as runner:
            answer = TRACKS["readout"].answer(blind, entry, runner)  # pyrefly: ignore[missing-attribute]
        assert abs(answer["readout_ratio"] - truth.shutter.readout_ratio) < 0.05


def test_what_is_no_board_stays_as_it_is(tmp_path: Path) -> None:
    path = write(tmp_path / "x.jsonl", named(_noisy(0.01), "a"))
    with pytest.raises(RsbenchError, match="is no board"):
        add(tmp_path, path, SPLIT, {})
    assert [each.name for each in tmp_path.iterdir()] == ["x.jsonl"]


def test_a_strangers_board_leads_nowhere(tmp_path: Path) -> None:
    """Links and entries under other names than their own are refused, and nothing is copied."""
    theirs, secret = tmp_path / "theirs", tmp_path / "secret"
    secret.write_text("secret", "utf-8")
    scored = handed_in(theirs, named(_noisy(0.01), "a"), SPLIT)
    (scored.folder / "predictions.jsonl").unlink()
    (scored.folder / "predictions.jsonl").symlink_to(secret)
    with pytest.raises(RsbenchError, match="must be a file of its own"):
        merge(theirs, tmp_path / "mine")
    scored.folder.rename(scored.folder.with_name("b"))
    with pytest.raises(RsbenchError):
        merge(theirs, tmp_path / "mine")
    other = tmp_path / "other"
    about = handed_in(other, named(_noisy(0.01), "a"), SPLIT).folder.parents[1] / "split.json"
    about.unlink()
    about.symlink_to(secret)
    with pytest.raises(RsbenchError, match=r"split\.json: must be a file of its own"):
        merge(other, tmp_path / "mine")
    assert not list((tmp_path / "mine").rglob("predictions.jsonl"))


# Running


@pytest.mark.parametrize(
    ("card", "uses"),
    [
        ("gs-8pt", ("left",)),
        ("gs-8pt-scaled", ("left", "readout")),
        ("rs-stereo-refined-pairs", ("left", "right", "readout")),
        ("gs-stereo-tracks", ("left", "right", "links")),
        ("rs-stereo-refined", ("left", "right", "links", "readout")),
    ],
)
def test_cards_say_what_they_use(card: str, uses: tuple[str, ...]) -> None:
    assert uses_of(load_solver_entry(card)) == uses


@pytest.mark.slow
def test_what_is_not_there_leaves_no_folder(tmp_path: Path) -> None:
    board = tmp_path / "board"
    assert_refused(run_here("leaderboard", "run", "points", "--entry", "nobody", "--board", board), "'nobody'")
    assert_refused(run_here("leaderboard", "rescore", "points", "--board", board), "is no board")
    assert not board.exists()


def test_cards_that_cannot_be_entries_are_refused_before_they_run(tmp_path: Path) -> None:
    card = tmp_path / "my card.toml"
    card.write_text('class = "rsbench.solvers.essential_matrix:EightPointSolver"\n', "utf-8")
    with pytest.raises(RsbenchError, match=r"entry .*my card.toml: name = 'my card': must be a folder's name"):
        run_cards(SPLIT, [str(card)], tmp_path / "in", tmp_path / "work")


@pytest.mark.slow
def test_runs_are_the_same_however_they_are_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With two workers, and in this process after the loss of half of it."""
    write_inputs(SPLIT, (simulated_problem(1, number) for number in range(12)), tmp_path / "in")
    steps: list[str] = []
    work = tmp_path / "work"
    (path,) = run_cards(SPLIT, ["gs-8pt"], tmp_path / "in", work, workers=2, step=steps.append)
    first = [{**line, "seconds": 0} for line in lines_of(path)]
    chunks = sorted(work.glob("gs-8pt/answers/*.json"))
    assert len(steps) == len(chunks) == 2
    kept = chunks[0].read_bytes()
    chunks[1].unlink()
    monkeypatch.setattr(running, "finished_jobs", jobs_here)
    run_cards(SPLIT, ["gs-8pt"], tmp_path / "in", work)
    assert [{**line, "seconds": 0} for line in lines_of(path)] == first and chunks[0].read_bytes() == kept
    assert scores_of(SPLIT, path)["auc_10"].mean() > 0.3  # the conventions of inputs and answers agree


def test_a_problem_that_takes_too_much_is_a_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It alone, with the reason; and what was done without limits is not taken for it."""
    split = small_split(3)
    write_inputs(split, (simulated_problem(1, number) for number in range(3)), tmp_path / "in")
    limits = Limits(seconds=5.0)

    def one_too_long(
        serve: Any,
        jobs: Any,
        workers: int,
        environment: object,
        *arguments: object,
        seconds_of: Any,
        memory_mb: Any,
    ) -> Any:
        run = serve(*arguments)
        for job in jobs:
            assert seconds_of(job) == 5.0 and memory_mb is None and len(job.problems) == 1
            late = job.problems == ("p001",)
            value = None if late else run(job)
            yield job, Outcome(value=value, reason="took longer than 5 s" if late else "", output="")

    monkeypatch.setattr(running, "finished_jobs", jobs_here)
    monkeypatch.setattr(running, "run_jobs", one_too_long)
    for chosen in (Limits(), limits):
        (path,) = run_cards(split, ["gs-8pt"], tmp_path / "in", tmp_path / "work", limits=chosen)
        answers = lines_of(path)[1:]
        assert [answer["name"] for answer in answers] == ["p000", "p001", "p002"]
        assert ("took longer" in answers[1].get("reason", "")) == (chosen == limits)
    assert scores_of(split, path)["failure"][1] == 1.0


def test_frames_with_given_matches(smoke_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Through the command line: the matches that are exported are enough for a motion of rendered frames."""
    monkeypatch.setattr(running, "finished_jobs", jobs_here)
    where = ("--data", smoke_dataset, "--board", tmp_path / "board")
    run_entries("pose", ["rs-stereo-refined", "gs-8pt"], *where)
    split = TRACKS["pose"].split(smoke_dataset)
    assert {truth.scene for truth in split.truths} == {"castle", "room"}
    leaderboard("oracles", "pose", *where)
    found = {name: each.scores for name, each in entered(tmp_path / "board", split).items()}
    assert list(found) == ["gs-8pt", "rs-stereo-refined", "truth"]
    assert found["truth"]["error_deg"].max() < 1e-5
    still = np.array([truth.facts["rotation_deg"] for truth in split.truths])
    assert np.all(found["rs-stereo-refined"]["e_R_deg"] < 0.2 * still)
    shown = leaderboard("show", "--board", tmp_path / "board", "--csv")
    assert [line.partition(",")[0] for line in shown.splitlines()[1:]] == ["gs-8pt", "rs-stereo-refined", "truth"]
    # What people handed in is not replaced by a run; what a run made is.
    card, mine = tmp_path / "mine.toml", tmp_path / "mine.jsonl"
    card.write_bytes((ROOT / "solvers" / "gs-8pt.toml").read_bytes())
    run_entries("pose", [card], *where)
    write(mine, named(truth_lines(split)[:1], "mine"))
    assert run_here("leaderboard", "submit", mine, *where).returncode == 2
    leaderboard("submit", mine, *where, "--replace")
    run_entries("pose", ["rs-stereo-refined"], *where)
    refused = run_here("leaderboard", "run", "pose", *where, "--entry", card)
    assert_refused(refused, "mine", "with other predictions")


# Documents


def test_the_documented_script_needs_no_rsbench(smoke_dataset: Path, tmp_path: Path) -> None:
    text = (ROOT / "docs" / "how-to" / "submit.md").read_text("utf-8")
    script = text.partition("```python\n# submit.py\n")[2].partition("```")[0]
    assert len(script.splitlines()) <= 22
    (tmp_path / "submit.py").write_text(script, "utf-8")
    data = ("--data", smoke_dataset)
    leaderboard("export", "pose-own", *data, "--out", tmp_path / "inputs")
    hide = "import runpy, sys; sys.modules['rsbench'] = None; runpy.run_path('submit.py')"
    subprocess.run([sys.executable, "-c", hide], cwd=tmp_path, check=True)
    leaderboard("check", tmp_path / "mine.jsonl", *data)
    shown = leaderboard("submit", tmp_path / "mine.jsonl", "--board", tmp_path / "board", *data)
    assert "opencv-sift-5pt" in shown
    split = TRACKS["pose-own"].split(smoke_dataset)
    (entry,) = entered(tmp_path / "board", split).values()
    # A solver for global shutters, on small frames, but nearer to the truth than "no motion": in our conventions.
    still = [truth.facts["rotation_deg"] for truth in split.truths]
    assert np.all(entry.scores["e_R_deg"] < still) and entry.scores["e_R_deg"].min() < 0.75


def test_protocols_are_documented() -> None:
    text = (ROOT / "docs" / "reference" / "protocols.md").read_text("utf-8")
    for protocol in TRACKS.values():
        cells = f"| `{protocol.name}` | `{protocol.id}` | {protocol.given} | {', '.join(protocol.allowed)} |"
        assert cells in text
    assert all(f"`{name}`" in text for name in KNOWLEDGE if name not in BESIDE)


HEAD, FIRST = TRUTH[0], TRUTH[1]


def _changed(**changes: object) -> list[Line]:
    return [HEAD, {**FIRST, **changes}, *TRUTH[2:]]


def _header(**changes: object) -> list[Line]:
    return [{**HEAD, **changes}, *TRUTH[1:]]


def _text(lines: list[Line]) -> str:
    return "".join(json.dumps(line) + "\n" for line in lines)


FAULTS: dict[str, tuple[str, str]] = {
    "empty": ("", "is empty"),
    "not JSON": ("hello\n", ":1: not valid JSON"),
    "a list": ("[]\n", ":1: must hold a JSON object"),
    "a number of thousands of digits": ("1" * 5000 + "\n", "not valid JSON"),
    "deep JSON": (_text(TRUTH[:1]) + "[" * 60_000 + "\n", ":2: not valid JSON: nested too deeply"),
    "deep values": (_text(TRUTH[:1]) + '{"name": ' + "[" * 99 + "]" * 99 + "}\n", ":2: name.0.0...: nested"),
    "a long line": (_text(TRUTH[:1]) + " " * 70_000 + "{}\n", ":2: has 70002 characters"),
    "no header": (_text(TRUTH[1:]), ":1: is an answer"),
    "two headers": (_text([HEAD, *TRUTH]), ":2: unknown key"),
    "another split": (_text(_header(split="dev-00000000")), "split = 'dev-00000000': the truth at hand"),
    "another protocol": (_text(_header(protocol="pose-1")), "protocol = 'pose-1'"),
    "no protocol": (_text(_header(protocol="points-9")), "'points-9'"),
    "unknown key of the header": (_text(_header(autors="me")), "unknown key 'autors' (did you mean 'authors'?)"),
    "path for a name": (_text(_header(method="../../etc/passwd")), "method = '../../etc/passwd'"),
    "hidden folder": (_text(_header(method=".rsbench")), "method = '.rsbench'"),
    "zero byte": (_text(_header(method="a\0b")), "method = "),
    "no name": (_text(_header(method="")), "method = ''"),
    "two lines in a text": (_text(_header(authors="a\nb")), "authors: must be one line"),
    "turned text": (_text(_header(paper="\u202egnp.exe")), "paper: must be one line"),
    "a novel": (_text(_header(paper="x" * 301)), "paper: must be one line of at most 300"),
    "uses nothing": (_text(_header(uses=[])), "uses: must name"),
    "uses a gyro": (_text(_header(uses=["gyro"])), "'gyro' is not given by points-1"),
    "uses magic": (_text(_header(uses=["magic"])), "'magic' is unknown"),
    "unknown problem": (_text(_changed(name="p01")), 'name = "p01": is no problem'),
    "the same problem twice": (_text([*TRUTH, FIRST]), ":14: name = 'p000': is that of line 2 too"),
    "what overflows": (_text(_changed(d=[0.0, 1e300, 0.0])), ":2: d: numbers must lie within 1e+09 of 0"),
    "a denormal direction": (
        _text(_changed(d=[5e-324, 0.0, 0.0])),
        ":2: d: has length 4.94066e-324: must be 0, or",
    ),
    "a direction too short": (_text(_changed(d=[0.0, 9e-10, 0.0])), ":2: d: has length 9e-10: must be 0, or"),
    "a direction too long": (_text(_changed(d=[9e8, 9e8, 0.0])), ":2: d: has length 1.27279e+09: must be 0, or"),
    "NaN": (_text(_changed(w=[float("nan"), 0.0, 0.0])), ":2: w.0 = nan: numbers must be finite"),
    "two numbers": (_text(_changed(w=[0.0, 0.0])), ":2: 'w.2' is required"),
    "a matrix": (_text(_changed(w=np.eye(3).tolist())), ":2: w"),
    "no motion": (_text(_changed(w=None)), ":2: w: a success needs three numbers"),
    "another point": (_text(_changed(reference_point="right")), ":2: reference_point = 'right'"),
    "negative time": (_text(_changed(seconds=-1.0)), ":2: seconds = -1.0"),
    "small covariance": (_text(_changed(covariance=[[1.0]])), ":2: covariance: must be 6 x 6"),
    "half a covariance": (_text(_changed(covariance=np.triu(np.ones((6, 6))).tolist())), "must be symmetric"),
    "two names": (_text(TRUTH[:1]) + '{"name": "p000", "name": "p001"}\n', ":2: not valid JSON: the key 'name'"),
    "uses it twice": (_text(_header(uses=["left"] * 6000)), "uses: names something twice"),
    "a dot at the end": (_text(_header(method="mine.")), "method = 'mine.': cannot be"),
    "a number beyond all": (_text(TRUTH[:1]) + '{"name": "p000", "seconds": 1' + "0" * 400 + "}\n", ":2: seconds"),
    "half a character": (_text(_header(authors="\ud800")), ":1: "),
    "truth values": (_text(_changed(w=[True, False, True])), ":2: w.0 = True"),
    "unknown key": (_text(_changed(omega=[0, 0, 0])), ":2: unknown key 'omega'"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_faults_are_lines_that_name_the_place(case: str, tmp_path: Path) -> None:
    text, words = FAULTS[case]
    path = tmp_path / "mine.jsonl"
    path.write_text(text, "utf-8")
    found = check_submission(path, SPLIT)
    assert found.submission is None
    assert any(words in fault and str(path) in fault for fault in found.faults), found.faults
    with pytest.raises(RsbenchError, match=r"mine\.jsonl"):
        read_submission(path, SPLIT)


@settings(max_examples=30, deadline=None)
@given(st.floats(-9.0, 9.0), st.sampled_from(["left", "body"]), st.integers(0, 9))
def test_the_length_of_a_direction_changes_no_score(exponent: float, point: str, number: int) -> None:
    random = np.random.default_rng(number)
    direction = random.normal(size=3)
    direction /= np.linalg.norm(direction) * (1.0 + 1e-12)  # within the limits at both ends
    answer = {"name": FIRST["name"], "w": FIRST["w"], "reference_point": point}
    rows = [
        motion_row(
            SPLIT.truths[0], parse_card(SPLIT.track.answers, {**answer, "d": (length * direction).tolist()}, "")
        )
        for length in (1.0, max(10.0**exponent, 1e-9 * (1.0 + 1e-9)))
    ]
    # The product itself rounds, by 1e-16 of 180 deg.
    assert rows[0] == pytest.approx(rows[1], abs=1e-12, nan_ok=True)


def _huge(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 30)


SPECIAL: dict[str, tuple[Callable[[Path], object], str]] = {
    **({"a pipe, which would hang": (os.mkfifo, "is no file")} if hasattr(os, "mkfifo") else {}),
    "missing": (lambda path: None, "cannot be read"),
    "a folder": (lambda path: path.mkdir(), "is no file"),
    "1 GB": (_huge, "bytes: 1073741824 is more than"),
    "a circle of links": (lambda path: path.symlink_to(path), "cannot be read"),
    "other bytes": (lambda path: path.write_bytes(b"\xff\xfe{}"), "is UTF-16 text"),
    "a zip file": (lambda path: path.write_bytes(b"PK\x03\x04\x14\x00\x00\x00"), "not valid JSON"),
}


@pytest.mark.parametrize("case", SPECIAL)
def test_what_is_no_text_is_one_line(case: str, tmp_path: Path) -> None:
    make, words = SPECIAL[case]
    path = tmp_path / "mine.jsonl"
    make(path)
    (fault,) = check_submission(path, SPLIT).faults
    assert words in fault and "\n" not in fault


def test_every_fault_is_told(tmp_path: Path) -> None:
    lines = [HEAD, {**TRUTH[1], "w": None}, {**TRUTH[2], "name": "q"}, {**TRUTH[3], "d": [1]}, *TRUTH[4:]]
    found = check_submission(write(tmp_path / "mine.jsonl", lines), SPLIT)
    assert [fault.partition(": ")[0].rpartition(":")[2] for fault in found.faults] == ["2", "3", "4"]


def test_the_template_and_the_truth_are_in_order(tmp_path: Path) -> None:
    path = tmp_path / "template.jsonl"
    write_template(SPLIT, path)
    for file in (path, write(tmp_path / "truth.jsonl", TRUTH)):
        found = check_submission(file, SPLIT)
        assert (found.faults, found.notes) == ((), ()) and found.submission is not None
        assert set(found.submission.answers) == set(SPLIT.by_name)


def test_missing_answers_are_told(tmp_path: Path) -> None:
    (note,) = check_submission(write(tmp_path / "mine.jsonl", TRUTH[:-2]), SPLIT).notes
    assert "no answer for 2 of 12 (p010, p011)" in note


@pytest.mark.parametrize(
    ("slip", "words"),
    [
        (lambda w, d: (-w, d), "w is inverted"),
        (lambda w, d: (w, -d), "d is inverted"),
        (lambda w, d: (np.rad2deg(w), d), "degrees"),
        (lambda w, d: (w * [-1, 1, -1], d * [1, -1, 1]), "left-handed"),
        (lambda w, d: (w * [1, -1, -1], d * [1, -1, -1]), "y up and z backward"),
        (lambda w, d: (-w[[1, 0, 2]], d[[1, 0, 2]]), "the paper's axes"),
    ],
)
def test_slips_of_convention_are_told(
    slip: Callable[..., tuple[np.ndarray, ...]], words: str, tmp_path: Path
) -> None:
    changed = [slip(np.array(line["w"]), np.array(line["d"])) for line in TRUTH[1:]]
    lines = [{**line, "w": w.tolist(), "d": d.tolist()} for line, (w, d) in zip(TRUTH[1:], changed, strict=True)]
    found = check_submission(write(tmp_path / "mine.jsonl", named([HEAD, *lines], "slip")), SPLIT)
    assert not found.faults
    assert any(words in note for note in found.notes), found.notes


def test_a_secret_truth_is_not_asked(tmp_path: Path) -> None:
    """A check that compares with a secret truth would tell it."""
    secret = Split(track=SPLIT.track, label=SPLIT.label, public=False, truths=SPLIT.truths)
    inverted = [HEAD, *({**line, "w": [-x for x in line["w"]]} for line in TRUTH[1:])]
    assert check_submission(write(tmp_path / "mine.jsonl", inverted), secret).notes == ()
    degrees = [HEAD, *({**line, "w": [1000.0 * x for x in line["w"]]} for line in TRUTH[1:])]
    (note,) = check_submission(write(tmp_path / "mine.jsonl", degrees), secret).notes
    assert "not in degrees" in note


def test_answers_of_solve_may_be_handed_in(tmp_path: Path) -> None:
    extra = {"solver": "x", "d_unit": "m", "d_body": None, "inliers": 9, "matches": 10, "stereo_alone": 0}
    path = write(tmp_path / "mine.jsonl", [HEAD, *({**line, **extra} for line in TRUTH[1:])])
    assert check_submission(path, SPLIT).faults == ()


def test_stored_predictions_are_scored_on_a_part_of_their_split(tmp_path: Path) -> None:
    part, stored = replace(SPLIT, truths=SPLIT.truths[:5]), tmp_path / "stored"
    add(tmp_path / "board", write(tmp_path / "x.jsonl", named(_noisy(0.01), "mine")), SPLIT, {})
    store(tmp_path / "board", SPLIT.track.id, SPLIT.name, stored)
    (whole,) = restore(stored, SPLIT, tmp_path / "whole")
    (first,) = restore(stored, SPLIT, tmp_path / "part", part)
    assert first.header.split == part.name != SPLIT.name
    pd.testing.assert_frame_equal(first.scores, whole.scores[:5])
    with refused("split"):
        restore(stored, replace(SPLIT, truths=SPLIT.truths[:7]), tmp_path / "other", part)


def test_a_run_tells_why_problems_failed(tmp_path: Path) -> None:
    lines = named(
        [TRUTH[0], *({"name": each["name"], "success": False, "reason": "dark"} for each in TRUTH[1:3])], "x"
    )
    path = write(tmp_path / "x.jsonl", [*lines, *TRUTH[3:]])
    assert failure_reasons(path) == f"2 of {len(TRUTH) - 1} failed: 2 x dark"
    assert failure_reasons(write(tmp_path / "y.jsonl", TRUTH)) == ""
