"""Pictures scored by several processes: the same bytes, and the same words of what is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from leaderboards import lines_of, named, pictures_of, write

from rsbench.benchmark.leaderboard.board import FILES, add, rescore
from rsbench.benchmark.leaderboard.picture_oracles import write_truth
from rsbench.benchmark.leaderboard.scoring_workers import _serve
from rsbench.benchmark.leaderboard.splits import Split
from rsbench.benchmark.leaderboard.submissions import read_submission
from rsbench.dataset.files import read_png, write_png
from rsbench.pipeline.isolation import EntryFailure


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
    for name in FILES:
        one, two = (
            (tmp_path / str(workers) / split.protocol.id / split.name / "entries" / "noisy" / name).read_bytes()
            for workers in (1, 2)
        )
        assert one == two
    assert rescore(tmp_path / "2", split) == {}


def test_a_child_says_what_is_wrong(splits: dict[str, Split], tmp_path: Path) -> None:
    """In this process, as a child would: a picture that went after the file was read."""
    split = splits["depth"]
    path = write_truth(split, tmp_path)
    submission = read_submission(path, split)
    (first, _) = pictures_of(path)
    first.unlink()
    run = _serve(submission, split)
    with pytest.raises(EntryFailure, match=r"left_1\.exr: is missing"):
        run(split.truths[0].name)
    assert run(split.truths[1].name)["bad_1"] == 0.0
