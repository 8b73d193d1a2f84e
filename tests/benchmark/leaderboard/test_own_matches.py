"""Own matches beside own motions: points of known planes, seen by four frames, and what is wrong with files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from analytic_dataset import PLANES, write_analytic_dataset
from leaderboards import PLANES as RIG_OF_PLANES
from leaderboards import entered, leaderboard, run_entries, scores_of, truth_lines, write

from rsbench.benchmark.leaderboard.board import ORACLES, add, entries_of, merge, rescore
from rsbench.benchmark.leaderboard.motion_tracks import match_scores
from rsbench.benchmark.leaderboard.submissions import check_submission
from rsbench.benchmark.leaderboard.track import Split
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.core.correspondences import Correspondences
from rsbench.core.projection import rs_project
from rsbench.core.rig import VIEWS
from rsbench.pipeline.problem import COLUMNS

RIG, SHUTTER, MOTION = RIG_OF_PLANES


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Split:
    folder = tmp_path_factory.mktemp("planes")
    write_analytic_dataset(folder, RIG, SHUTTER, MOTION)
    return TRACKS["pose-own"].split(folder)


def _tracks() -> np.ndarray:
    """(n, 8) where four frames see points of the nearer plane; no depth map is used."""
    rng = np.random.default_rng(0)
    points = []
    for number, (normal, offset) in enumerate(PLANES):
        ahead = rng.uniform([-0.5, -0.4, 1.0], [0.5, 0.4, 1.0], (400, 3))
        near = [c / (ahead @ n) for n, c in PLANES]
        other = near[1 - number]
        here = near[number]
        # Clearly before the other plane, or the other one is behind the camera.
        chosen = (here > 0.0) & ((here < 0.8 * other) | (other < 0.0))
        points.append((ahead * here[:, None])[chosen])
        assert np.allclose(points[-1] @ normal, offset)
    seen = [rs_project(RIG, SHUTTER, MOTION, *view, np.concatenate(points)).pixels for view in VIEWS]
    order = [VIEWS.index(view) for view in (("left", 0), ("right", 0), ("left", 1), ("right", 1))]
    tracks = np.concatenate([seen[k] for k in order], axis=1)
    inside = np.all(np.isfinite(tracks), axis=1) & np.all((tracks >= 1.0) & (tracks <= 78.0), axis=1)
    return tracks[inside]


def _handed_in(folder: Path, split: Split, sets: dict[str, np.ndarray]) -> Path:
    (folder / "matches").mkdir(parents=True)
    for key, rows in sets.items():
        table = pd.DataFrame(rows, columns=COLUMNS[key].split(", "))
        table.insert(0, "name", "planes")
        table.to_csv(folder / "matches" / f"{key}.csv", index=False)
    return write(folder / "predictions.jsonl", truth_lines(split))


def test_right_matches_are_counted(split: Split, tmp_path: Path) -> None:
    """Every third second end is 2 px off, and all have noise of a tenth of a pixel."""
    tracks = _tracks()
    assert len(tracks) > 100
    left, stereo = tracks[:, [0, 1, 4, 5]], tracks[:, :4]
    off = np.zeros_like(left)
    off[::3, 3] = 2.0
    noise = 0.1 * np.random.default_rng(1).standard_normal(left.shape)
    path = _handed_in(tmp_path, split, {"left": left + off + noise, "stereo_0": stereo})
    (row,) = scores_of(split, path).to_dict("records")
    assert row["matches"] == 2 * len(tracks)
    assert abs(row["matches_1px"] - (1.0 - len(tracks[::3]) / (2 * len(tracks)))) < 0.02
    # Tracks are matches of all four pairs, each once, also where they are repeated.
    (truth,) = split.truths
    found = match_scores(truth.rendered, Correspondences(tracks=tracks, left=left))
    assert found["matches"] == 4 * len(tracks) and found["matches_1px"] > 0.98
    assert match_scores(truth.rendered, Correspondences(left=np.tile(left[:7], (9, 1))))["matches"] == 7.0


def test_motions_without_matches_have_none(split: Split, tmp_path: Path) -> None:
    (row,) = scores_of(split, truth_lines(split), tmp_path).to_dict("records")
    assert np.isnan(row["matches"]) and np.isnan(row["matches_1px"]) and row["auc_1"] > 1.0 - 1e-6
    (truth,) = split.truths
    assert match_scores(truth.rendered, Correspondences()) == {"matches": 0.0, "matches_1px": 0.0}


def test_matches_are_kept_with_the_entry(split: Split, tmp_path: Path) -> None:
    path = _handed_in(tmp_path / "in", split, {"left": _tracks()[:, [0, 1, 4, 5]]})
    add(tmp_path / "board", path, split, {"command": ORACLES})
    assert merge(tmp_path / "board", tmp_path / "other") == [f"pose-own-1/{split.name}/truth"]
    assert rescore(tmp_path / "other", split) == {}
    (entry,) = entries_of(tmp_path / "other", "pose-own-1", split.name)
    assert list(entry.files) == ["matches/left.csv"] and entry.scores["matches_1px"][0] > 0.98


def test_what_comes_with_rsbench_finds_its_own_matches(smoke_dataset: Path, tmp_path: Path) -> None:
    """The matches of ``rsbench correct``, which are handed in, and the law that they ask for."""
    board = ("--board", tmp_path / "board", "--data", smoke_dataset)
    run_entries("pose-own", ["rs-stereo-auto", "gs-8pt"], *board)
    found = entered(tmp_path / "board", TRACKS["pose-own"].split(smoke_dataset))
    ours, baseline = found["rs-stereo-auto"], found["gs-8pt"]
    assert "images" in ours.header.uses and "matches/tracks.csv" in ours.files
    assert ours.scores["matches"].min() > 50 and ours.scores["matches_1px"].min() > 0.7
    assert ours.scores["e_R_deg"].median() < 0.5 * baseline.scores["e_R_deg"].median()


def _table(*rows: str, head: str = "name,x0,y0,x1,y1") -> Callable[[Path], object]:
    """Of left matches, by lines below a head."""
    return lambda folder: (folder / "left.csv").write_text("\n".join([head, *rows]) + "\n")


FAULTS: dict[str, tuple[Callable[[Path], object], str]] = {
    "another file": (lambda p: (p / "evil.csv").touch(), "evil.csv: does not belong here; there are: left.csv"),
    "a link": (lambda p: (p / "right.csv").symlink_to(p / "left.csv"), "right.csv: must be a file of its own"),
    "nothing": (lambda p: (p / "left.csv").unlink(), "matches: must be a folder with some of"),
    "no columns": (_table("planes,1", head="name,x"), "lacks the column 'x0'"),
    "text": (_table("planes,1,2,3,a"), "must hold numbers"),
    "NaN": (_table("planes,1,2,3,nan"), "left.csv:2: must hold"),
    "infinity": (_table("planes,1,2,3,inf"), "finite pixels"),
    "another problem": (_table("../x,1,2,3,4"), "name = '../x': is no problem"),
    "truth values": (_table("planes,True,False,True,True"), "must hold numbers"),
    "a column twice": (_table(head="name,x0,x0,y0,x1,y1"), "'x0.1' does not belong here"),
    "an open quote": (_table('"planes'), "not a table"),
    "rows that are too long": (_table("planes,1,2,3,4,5,6"), "name ="),
    "more than pixels": (_table(*7681 * ["planes,1,2,3,4"]), "7681 matches of planes: more than pixels, 7680"),
    "other bytes": (lambda p: (p / "left.csv").write_bytes(b"\xff\xfe\x00"), "is UTF-16 text"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_faults_are_lines(case: str, split: Split, tmp_path: Path) -> None:
    damage, words = FAULTS[case]
    path = _handed_in(tmp_path, split, {"left": np.ones((3, 4))})
    damage(tmp_path / "matches")
    (fault,) = check_submission(path, split).faults
    assert words in fault and "\n" not in fault


def test_given_matches_are_in_the_form_of_own_ones(smoke_dataset: Path, tmp_path: Path) -> None:
    """What ``export pose`` writes may be handed in as it is: most of rsbench's matches are right."""
    split = TRACKS["pose-own"].split(smoke_dataset)
    out = tmp_path / "inputs"
    leaderboard("export", "pose", "--data", smoke_dataset, "--out", out)
    (tmp_path / "matches").mkdir()
    for key in COLUMNS:
        if (out / f"{key}.csv").exists():
            (out / f"{key}.csv").rename(tmp_path / "matches" / f"{key}.csv")
    path = write(tmp_path / "predictions.jsonl", truth_lines(split))
    scores = scores_of(split, path)
    assert np.all(scores["matches"] > 50) and np.all(scores["matches_1px"] > 0.7), json.dumps(scores.to_dict())
