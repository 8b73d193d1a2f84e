"""Runs of the tracks depth and correction: cards of ours and of others, and inputs without a secret."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from commands import assert_refused, run_here
from leaderboards import ASK_PICTURES, PLANES, files_below, jobs_here, lines_of, pictures_of

from rsbench.benchmark.leaderboard import running
from rsbench.benchmark.leaderboard.board import entries_of
from rsbench.benchmark.leaderboard.submissions import check_submission, write_truth
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.storage.files import read_depth

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
    cards = [word for entry in entries for word in ("--entry", entry)]
    assert_refused(run_here("leaderboard", "run", track, *where, "--entry", "gs-8pt"), "gs-8pt")
    ran = run_here("leaderboard", "run", track, *where, *cards)
    assert ran.returncode == 0, ran.stderr
    assert run_here("leaderboard", "oracles", track, *where).returncode == 0
    split = TRACKS[track].split(smoke_dataset)
    found = {e.header.method: e for e in entries_of(tmp_path / "board", split.track.id, split.name)}
    assert {*entries, "truth"} < set(found)
    made = tmp_path / "board" / ".rsbench" / "runs" / split.track.id / split.name / entries[0]
    first = {path.name: path.read_bytes() for path in pictures_of(made / "x")}
    (made / "answers" / "castle.json").unlink()
    (made / "pictures" / "castle").rename(tmp_path / "lost")
    assert run_here("leaderboard", "run", track, *where, *cards).returncode == 0
    assert {path.name: path.read_bytes() for path in pictures_of(made / "x")} == first
    if track == "depth":
        assert np.all(found["sgm"].scores["bad_1"] < 0.5 * found["constant"].scores["bad_1"])
    else:
        psnr = {name: entry.scores["psnr"] for name, entry in found.items()}
        assert np.all(psnr["fusion"] > psnr["uncorrected"] + 3.0)
        assert found["lao-lines"].header.uses == ("readout", "images")
        assert found["fusion"].header.uses == ("readout", "images", "stereo", "time")
        assert np.all(psnr["fusion-true"] > psnr["rotation-only"])


MATCHER = """
from dataclasses import dataclass
import numpy as np
from rsbench.vision.stereo_matcher import StereoMatcher

@dataclass(frozen=True)
class Level(StereoMatcher):
    px: float = 5.0

    def disparities(self, left, right, rig):
        if self.px < 0.0:
            raise ValueError("not today")
        return (np.full(left.shape[:2], self.px),) * 2
"""


def test_a_method_of_somebody_else_runs_and_fails_alone(
    planes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two cards beside their own module: one level everywhere, and one that raises."""
    monkeypatch.setattr(running, "finished_jobs", jobs_here)
    (tmp_path / "level_matcher.py").write_text(MATCHER, "utf-8")
    for name, px in (("level", 5.0), ("odd", -1.0)):
        (tmp_path / f"{name}.toml").write_text(
            f'class = "level_matcher:Level"\nparameters = {{ px = {px} }}\n', "utf-8"
        )
    where = ("--data", planes, "--board", tmp_path / "board")
    cards = [word for name in ("level", "odd") for word in ("--entry", tmp_path / f"{name}.toml")]
    ran = run_here("leaderboard", "run", "depth", *where, *cards)
    assert ran.returncode == 0, ran.stderr
    split = TRACKS["depth"].split(planes)
    found = {e.header.method: e for e in entries_of(tmp_path / "board", "depth-1", split.name)}
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
    export = ("leaderboard", "export", track, "--data", planes, "--out")
    assert run_here(*export, tmp_path / "open").returncode == 0
    split = TRACKS[track].split(planes)
    assert check_submission(tmp_path / "open" / "truth.jsonl", split).faults == ()
    assert run_here(*export, tmp_path / "closed", "--secret").returncode == 0
    told = set(files_below(tmp_path / "closed").values())
    for truth in split.truths:
        assert truth.pictures is not None
        assert not told & {truth.pictures.path(each).read_bytes() for each in truth.pictures.requested}
    assert (planes / "planes" / "rs" / "left_2.png").read_bytes() in told
