"""What release 0.1 wrote can be read, checked, scored and built by the code of today."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import run_here

import rsbench
from rsbench.benchmark.leaderboard.board import add, entries_of, splits_of
from rsbench.benchmark.leaderboard.standings import standings
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.report.board_page import build_site

KEPT = Path(__file__).parent / "release_0_1"


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    """A copy: readers may write beside what they read."""
    return Path(shutil.copytree(KEPT, tmp_path / "kept"))


def test_a_dataset_is_read_and_has_no_fault(kept: Path) -> None:
    (sequence,) = rsbench.read_dataset(kept / "dataset")
    manifest = json.loads((kept / "dataset" / "castle" / "sequence.json").read_text("utf-8"))
    for path, digest in manifest["files"].items():
        assert hashlib.sha256((kept / "dataset" / "castle" / path).read_bytes()).hexdigest() == digest
    assert sequence.image("rs", "left", 0).shape == (32, 48, 3)
    np.testing.assert_array_equal(sequence.motion.w, manifest["motion"]["w"])
    report = rsbench.verify(kept / "dataset", rerender="no")
    assert [each.faults for each in report] == [()] * len(report) or not any(each.faults for each in report)


@pytest.mark.slow
def test_a_board_is_read_scored_again_and_built(kept: Path) -> None:
    board, split = kept / "board", TRACKS["points"].split(None)
    assert splits_of(board) == [("points-1", split.name)]
    (entry,) = entries_of(board, "points-1", split.name)
    assert entry.header.method == "kept-method" and entry.handed_in and entry.doubt == ""
    again = add(kept / "new", entry.folder / "predictions.jsonl", split, {})
    for name in ("e_R_deg", "e_T_deg", "auc_5", "e_s"):
        # Another processor's sines differ in the last bits.
        np.testing.assert_allclose(again.scores[name], entry.scores[name], rtol=1e-9, atol=1e-9)
    (line,) = standings([entry])
    assert line.rank_words == "alone"
    assert "kept-method" in build_site(board, kept / "site", ()).read_text("utf-8")


def test_what_is_newer_is_refused_in_one_line(kept: Path) -> None:
    (kept / "board" / "board.json").write_text('{"format": 2}', "utf-8")
    ran = run_here("leaderboard", "show", "--board", kept / "board")
    assert ran.returncode == 2 and ran.stderr.count("\n") == 1 and "format = 2: must be 1" in ran.stderr
    path = kept / "dataset" / "dataset.json"
    path.write_text(path.read_text("utf-8").replace('"format": 1', '"format": 2', 1), "utf-8")
    ran = run_here("verify", kept / "dataset", "--rerender", "no")
    assert ran.returncode in (1, 2) and "format" in ran.stderr + ran.stdout
