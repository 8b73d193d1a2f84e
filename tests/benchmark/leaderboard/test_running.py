"""Runs of cards that draw pictures, their limits, scoring in processes, and the board of several motion models."""

from __future__ import annotations

import json
import lzma
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from analytic_dataset import write_analytic_dataset
from commands import assert_refused, run_here
from leaderboards import (
    ASK_PICTURES,
    PLANES,
    entered,
    files_below,
    jobs_here,
    leaderboard,
    lines_of,
    named,
    pictures_of,
    run_entries,
    write,
)

from rsbench.benchmark.images.store import keep
from rsbench.benchmark.leaderboard import motion_tracks, running
from rsbench.benchmark.leaderboard.board import (
    FILES,
    ORACLES,
    add,
    add_all,
    entries_of,
    rescore,
    restore,
    splits_of,
)
from rsbench.benchmark.leaderboard.picture_track import _serve_rows
from rsbench.benchmark.leaderboard.submissions import check_submission, read_submission, write_oracles, write_truth
from rsbench.benchmark.leaderboard.track import Split
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.cli import reproduce_leaderboard
from rsbench.cli.reproduce import Target, reproduce
from rsbench.core.errors import RsbenchError
from rsbench.jobs.isolation import Outcome
from rsbench.storage.files import read_depth, read_json, read_png, write_depth, write_png

RIG, _, _ = PLANES


@pytest.mark.parametrize(
    ("track", "entries"),
    [("depth", ("sgm", "sgm-plain")), ("correction", ("rotation-only", "fusion", "lao-lines"))],
)
def test_cards_run_and_go_on(
    track: str, entries: tuple[str, ...], smoke_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Through the command line; what is lost is made again, to the last digit, and a solver is no matcher."""
    monkeypatch.setattr(running, "finished_jobs", jobs_here)
    where = ("--data", smoke_dataset, "--board", tmp_path / "board")
    assert_refused(run_here("leaderboard", "run", track, *where, "--entry", "gs-8pt"), "gs-8pt")
    run_entries(track, entries, *where)
    leaderboard("oracles", track, *where)
    split = TRACKS[track].split(smoke_dataset)
    found = entered(tmp_path / "board", split)
    assert {*entries, "truth"} < set(found)
    made = tmp_path / "board" / ".rsbench" / "runs" / split.track.id / split.name / entries[0]
    first = {path.name: path.read_bytes() for path in pictures_of(made / "x")}
    (made / "answers" / "castle.json").unlink()
    (made / "pictures" / "castle").rename(tmp_path / "lost")
    run_entries(track, entries, *where)
    assert {path.name: path.read_bytes() for path in pictures_of(made / "x")} == first
    if track == "depth":
        assert np.all(found["sgm"].scores["bad_1"] < 0.5 * found["constant"].scores["bad_1"])
    else:
        psnr = {name: entry.scores["psnr"] for name, entry in found.items()}
        assert np.all(psnr["fusion"] > psnr["uncorrected"] + 3.0)
        assert found["lao-lines"].header.uses == ("readout", "images")
        assert found["fusion"].header.uses == ("readout", "images", "stereo", "time")
        assert np.all(psnr["fusion-true"] > psnr["rotation-only"])


METHODS = """
import time
from dataclasses import dataclass
from pathlib import Path
import numpy as np
from rsbench.vision.corrector import Corrector, CorrectorSpec
from rsbench.vision.fusion import Fused
from rsbench.vision.stereo_matcher import StereoMatcher

def misbehave(mood):
    "Once: the first problem alone; but for who is odd."
    if mood == "odd":
        raise ValueError("not today")
    done = Path(__file__).with_name(f"{mood}.done")
    if mood == "sound" or done.exists():
        return
    done.touch()
    held = np.ones((1 << 17, 900 if mood == "hungry" else 1))
    time.sleep(1000.0)

@dataclass(frozen=True)
class Level(StereoMatcher):
    mood: str = "sound"

    def disparities(self, left, right, rig):
        misbehave(self.mood)
        return (np.full(left.shape[:2], 5.0),) * 2

@dataclass(frozen=True)
class Same(Corrector):
    mood: str = "sound"
    spec = CorrectorSpec(needs=set(), reference="this file", assumes="nothing")

    def correct(self, problem, views):
        misbehave(self.mood)
        seen = np.ones(problem.images["left", 0].shape[:2], bool)
        return {view: Fused.seen(problem.images[view], seen) for view in views}
"""


def test_a_method_of_somebody_else_runs_and_fails_alone(
    planes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two cards beside their own module: one level everywhere, and one that raises."""
    monkeypatch.setattr(running, "finished_jobs", jobs_here)
    (tmp_path / "level_matcher.py").write_text(METHODS, "utf-8")
    for name, mood in (("level", "sound"), ("odd", "odd")):
        text = f'class = "level_matcher:Level"\nparameters = {{ mood = "{mood}" }}\n'
        (tmp_path / f"{name}.toml").write_text(text, "utf-8")
    where = ("--data", planes, "--board", tmp_path / "board")
    run_entries("depth", [tmp_path / "level.toml", tmp_path / "odd.toml"], *where)
    split = TRACKS["depth"].split(planes)
    found = entered(tmp_path / "board", split)
    depth = read_depth(found["level"].folder / "pictures" / "planes.0" / "left_1.exr")
    np.testing.assert_allclose(depth, RIG.camera.fx * RIG.baseline / 5.0, rtol=1e-6)
    assert found["level"].header.code == "" and found["level"].header.uses == ("images", "stereo")
    assert found["odd"].scores["failure"].all() and found["odd"].files == {}
    answers = lines_of(found["odd"].folder / "predictions.jsonl")[1:]
    assert all("not today" in str(answer["reason"]) for answer in answers)
    # A damaged picture is one line on the command line too, and the board stays as it is.
    path = write_truth(split, tmp_path / "mine")
    pictures_of(path)[0].write_bytes(b"no picture")
    before = files_below(tmp_path / "board")
    assert_refused(run_here("leaderboard", "submit", path, *where), "left_1.exr: damaged or not an EXR file")
    checked = run_here("leaderboard", "check", path, "--data", planes)
    assert checked.returncode == 2 and len(checked.stderr.splitlines()) == 1
    assert files_below(tmp_path / "board") == before


@pytest.mark.parametrize("track", ASK_PICTURES)
def test_inputs_hold_no_secret(track: str, planes: Path, tmp_path: Path) -> None:
    """Of a public split the truth, which is in order as it stands; of a secret one none of its files."""
    export = ("export", track, "--data", planes, "--out")
    leaderboard(*export, tmp_path / "open")
    split = TRACKS[track].split(planes)
    assert check_submission(tmp_path / "open" / "truth.jsonl", split).faults == ()
    leaderboard(*export, tmp_path / "closed", "--secret")
    told = set(files_below(tmp_path / "closed").values())
    for truth in split.truths:
        assert not told & {truth.shown.path(each).read_bytes() for each in truth.shown.requested}
    assert (planes / "planes" / "rs" / "left_2.png").read_bytes() in told


CLASSES = {"depth": "Level", "correction": "Same"}
MOODS = {
    "hanging": (("--time-limit", 2), "took longer than 2 s"),
    "hungry": (("--memory", 900), "used more than 900 MB of memory"),
}
"""The limit, and what is said. The hungry one uses 944 MB beside what it imports, and has time for it."""


def _here(
    serve: Any, jobs: Any, workers: int, environment: object, *arguments: object, seconds_of: Any, memory_mb: Any
) -> Any:
    """``run_jobs`` without a child of ours: that of the method is enough."""
    run = serve(*arguments)
    for job in jobs:
        assert seconds_of(job) == math.inf, "the start of the method's process is not in its time"
        yield job, Outcome(value=run(job), reason="", output="")


@pytest.mark.slow
@pytest.mark.parametrize("mood", MOODS)
@pytest.mark.parametrize("track", ASK_PICTURES)
def test_a_method_that_takes_too_much_fails_alone(
    track: str, mood: str, planes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first problem, in a process of the method's own, with the reason; the second is in order."""
    monkeypatch.setattr(running, "run_jobs", _here)
    limit, words = MOODS[mood]
    module = f"{mood}_{track}"
    (tmp_path / f"{module}.py").write_text(METHODS, "utf-8")
    card = tmp_path / f"{mood}.toml"
    card.write_text(
        f'class = "{module}:{CLASSES[track]}"\ntime_limit_s = 300\nparameters = {{ mood = "{mood}" }}\n', "utf-8"
    )
    where = ("--data", planes, "--board", tmp_path / "board")
    run_entries(track, [card], *where, *limit)
    (found,) = entered(tmp_path / "board", TRACKS[track].split(planes)).values()
    first, second = lines_of(found.folder / "predictions.jsonl")[1:]
    assert words in str(first["reason"]) and mood in str(first["reason"])
    assert "reason" not in second
    assert list(found.scores["failure"]) == [1.0, 0.0]


def test_two_processes_give_the_bytes_of_one(splits: dict[str, Split], tmp_path: Path) -> None:
    """Of frames that are moved and noisy, so that no score is a round number; and scored again by one."""
    split, rng = splits["correction"], np.random.default_rng(0)
    path = write_truth(split, tmp_path)
    for picture in pictures_of(path):
        image = np.roll(read_png(picture), 1, axis=1) + rng.normal(0.0, 9.0, (80, 96, 3))
        write_png(picture, np.clip(image, 0, 255).astype(np.uint8))
    lines = lines_of(path)
    path = write(path, named(lines, "noisy", ("images",)))
    for workers in (1, 2):
        add(tmp_path / str(workers), path, split, {}, workers=workers)
    one, two = (entered(tmp_path / each, split)["noisy"].folder for each in ("1", "2"))
    assert all((one / name).read_bytes() == (two / name).read_bytes() for name in FILES)
    assert rescore(tmp_path / "2", split) == {}


@pytest.mark.slow
@pytest.mark.parametrize("track", ["depth", "correction"])
def test_entries_that_are_scored_together_score_as_alone(
    track: str, splits: dict[str, Split], tmp_path: Path
) -> None:
    """The truth, which the board has alone too, beside two that know less; and each process shares it anew."""
    split = splits[track]
    paths = list(write_oracles(split, tmp_path / "oracles"))
    for path in paths:
        add(tmp_path / "alone", path, split, {"command": ORACLES})
    for workers in (1, 2):
        add_all(tmp_path / str(workers), paths, split, {"command": ORACLES}, workers=workers)
        alone, together = (entered(tmp_path / each, split) for each in ("alone", str(workers)))
        for name, entry in alone.items():
            table = (entry.folder / "scores.csv").read_bytes()
            assert table == (together[name].folder / "scores.csv").read_bytes()


@pytest.mark.parametrize("workers", [1, 2])
def test_a_run_that_was_cut_off_goes_on(workers: int, splits: dict[str, Split], tmp_path: Path) -> None:
    split, path = splits["depth"], write_truth(splits["depth"], tmp_path)
    scored = list[str]()

    def stop(name: str) -> None:
        scored.append(name)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        add(tmp_path / "cut", path, split, {"command": ORACLES}, workers=workers, step=stop)
    (kept,) = (tmp_path / "cut" / ".rsbench" / "scoring").iterdir()
    record = read_json(kept)
    (row,) = record["content"]
    keep(kept, record["identity"], [{**row, "scene": "marble"}])  # seen only if it is taken
    add(tmp_path / "cut", path, split, {"command": ORACLES}, workers=workers)
    table = pd.read_csv(next((tmp_path / "cut").rglob("scores.csv")))
    assert kept.stem == scored[0] and list(table["scene"]).count("marble") == 1
    assert not (tmp_path / "cut" / ".rsbench" / "scoring").exists()


@pytest.mark.parametrize("workers", [1, 2])
def test_who_is_at_fault_fails_alone(workers: int, splits: dict[str, Split], tmp_path: Path) -> None:
    """A picture that went after the file was read: the other entry is scored."""
    split = splits["depth"]
    broken, whole = (read_submission(write_truth(split, tmp_path / name), split) for name in ("broken", "whole"))
    pictures_of(broken.folder / "predictions.jsonl")[0].unlink()
    fault, table = split.track.mark([broken, whole], split, workers, lambda word: None, None)
    assert isinstance(fault, RsbenchError) and "left_1.exr: is missing" in str(fault)
    assert isinstance(table, pd.DataFrame) and np.all(table["bad_1"] == 0.0)


def test_a_fault_is_told_after_the_others_are_on_the_board(splits: dict[str, Split], tmp_path: Path) -> None:
    split = splits["depth"]
    paths = list(write_oracles(split, tmp_path / "oracles"))
    write_depth(pictures_of(paths[0])[0], np.full((80, 96), -1.0, dtype=np.float32))
    with pytest.raises(RsbenchError, match=r"left_1\.exr: 7680 pixels are negative"):
        add_all(tmp_path / "board", paths, split, {"command": ORACLES})
    assert [*entered(tmp_path / "board", split)] == ["constant"]


def test_a_child_says_that_the_truth_has_changed(splits: dict[str, Split], tmp_path: Path) -> None:
    """In this process, as a child would."""
    split = splits["depth"]
    first, second = split.truths
    changed = replace(first.shown, files=dict.fromkeys(first.shown.files, "0" * 64))
    broken = replace(split, truths=(replace(first, pictures=changed), second))
    run = _serve_rows([read_submission(write_truth(split, tmp_path), split)], broken)
    with pytest.raises(RsbenchError, match=r"is not the file that dataset\.json names"):
        run(first.name)
    (row,) = run(second.name)
    assert isinstance(row, dict) and row["bad_1"] == 0.0


ENTRIES = {"pose-2": ["gs-p3p", "gs-8pt"], "readout-3": ["rs-stereo-refined"], "correction-3": ["rotation-only"]}


def _nothing_left(serve: Any, jobs: Any, *arguments: object) -> Any:
    assert not jobs
    yield from ()


def test_one_command_makes_all_boards_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, str]] = []

    def render(card: str, out: str, sequence: None, workers: int) -> None:
        asked.append((card, out))
        if len(asked) == 1:
            write_analytic_dataset(Path(out), *PLANES, twins=(40,))

    monkeypatch.setattr(reproduce_leaderboard, "generate", render)
    monkeypatch.setattr(reproduce_leaderboard, "entries_of_laws", lambda: ENTRIES)
    monkeypatch.setattr(running, "finished_jobs", jobs_here)
    out, data = tmp_path / "results", tmp_path / "data"
    reproduce(Target.laws, out, data, workers=1)
    frames, folder = data / "laws-frames", out / "laws"
    assert asked == [("laws", str(frames))]
    splits = dict(splits_of(data / "laws"))
    assert set(splits) == set(ENTRIES)
    stored = {path.name: {each.name for each in path.iterdir()} for path in (folder / "predictions").iterdir()}
    assert stored == {
        "pose-2": {"gs-p3p.jsonl.xz", "gs-8pt.jsonl.xz", "truth.jsonl.xz"},
        "readout-3": {"rs-stereo-refined.jsonl.xz", "constant.jsonl.xz", "truth.jsonl.xz"},
    }
    made = json.loads((folder / "provenance.json").read_text("utf-8"))
    assert made["command"] == "rsbench reproduce laws"
    assert f"correction-3/{splits['correction-3']}/uncorrected" in made["entries"]
    page = (folder / "site" / "index.html").read_text("utf-8")
    assert all(f"{protocol}--{split}" in page for protocol, split in splits.items())
    # What is stored of frames scores as it did; a second run answers nothing again.
    split = TRACKS["pose-2"].split(frames)
    restore(folder / "predictions" / "pose-2", split, tmp_path / "again")
    first, again = (
        {name: each.scores["auc_apart"].to_list() for name, each in entered(board, split).items()}
        for board in (data / "laws", tmp_path / "again")
    )
    assert first == again and len(first) == 3
    monkeypatch.setattr(running, "finished_jobs", _nothing_left)
    reproduce(Target.laws, out, data, workers=1)


def test_entries_of_laws_answer_what_is_asked() -> None:
    """Each is taken by its track; the one that chooses a law is with the solvers and the readers."""
    entries = reproduce_leaderboard.entries_of_laws()
    for protocol, names in entries.items():
        TRACKS[protocol].load(names)
        assert len(set(names)) == len(names)
    choosers = {protocol for protocol, names in entries.items() if motion_tracks.CHOOSES in names}
    assert choosers == {"points-2", "pose-2", "readout-3"} and entries["points-2"] == entries["pose-2"]
    assert "gyro" not in entries["correction-3"]


def test_the_first_problems_are_a_split_of_their_own_ranked_beside_stored_entries(tmp_path: Path) -> None:
    split, stored, board = TRACKS["points"].split(None), tmp_path / "stored", tmp_path / "board"
    stored.mkdir()
    truth = write_truth(split, tmp_path / "truth")
    (stored / "truth.jsonl.xz").write_bytes(lzma.compress(truth.read_bytes()))
    where = ("--entry", "gs-8pt", "--board", board, "--beside", stored, "--workers", "1")
    shown = leaderboard("run", "points", *where, "--problems", "3")
    assert "oracle" in shown and "gs-8pt" in shown
    ((protocol, name),) = splits_of(board)
    assert name != split.name
    (entry,) = entries_of(board, protocol, name)  # what is stored is beside the board, not on it
    assert list(entry.scores["problem"]) == list(split.by_name)[:3]
    assert_refused(run_here("leaderboard", "run", "points", *where, "--problems", "1000"), "--problems 1000")
