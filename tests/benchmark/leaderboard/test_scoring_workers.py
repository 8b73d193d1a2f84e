"""Pictures scored by several processes: the same bytes, and the same words of what is wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from leaderboards import lines_of, named, pictures_of, write

from rsbench.benchmark.leaderboard.board import FILES, ORACLES, add, add_all, entries_of, rescore
from rsbench.benchmark.leaderboard.picture_track import _serve_rows
from rsbench.benchmark.leaderboard.submissions import read_submission, write_oracles, write_truth
from rsbench.benchmark.leaderboard.track import Split
from rsbench.core.errors import RsbenchError
from rsbench.jobs.isolation import EntryFailure, decode, encode
from rsbench.storage.files import read_png, write_depth, write_png


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
            (tmp_path / str(workers) / split.track.id / split.name / "entries" / "noisy" / name).read_bytes()
            for workers in (1, 2)
        )
        assert one == two
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
        for path in paths:
            alone, together = (
                tmp_path / each / split.track.id / split.name / "entries" / path.parent.name / "scores.csv"
                for each in ("alone", str(workers))
            )
            assert alone.read_bytes() == together.read_bytes()


@pytest.mark.parametrize("workers", [1, 2])
def test_a_run_that_was_cut_off_goes_on(workers: int, splits: dict[str, Split], tmp_path: Path) -> None:
    split, path = splits["depth"], write_truth(splits["depth"], tmp_path)
    scored = list[str]()

    def stop(name: str) -> None:
        scored.append(name)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        add(tmp_path / "cut", path, split, {"command": ORACLES}, workers=workers, step=stop)
    (kept,) = (tmp_path / "cut" / ".rsbench" / "scoring").glob("*/*")
    (row,) = decode(kept.read_bytes(), {})
    kept.write_bytes(encode([{**row, "scene": "marble"}]))  # seen only if it is taken
    add(tmp_path / "cut", path, split, {"command": ORACLES}, workers=workers)
    table = pd.read_csv(next((tmp_path / "cut").rglob("scores.csv")))
    assert kept.name == scored[0] and list(table["scene"]).count("marble") == 1
    assert not (tmp_path / "cut" / ".rsbench" / "scoring").exists()


@pytest.mark.parametrize("workers", [1, 2])
def test_who_is_at_fault_fails_alone(workers: int, splits: dict[str, Split], tmp_path: Path) -> None:
    """A picture that went after the file was read: the other entry is scored."""
    split = splits["depth"]
    broken, whole = (read_submission(write_truth(split, tmp_path / name), split) for name in ("broken", "whole"))
    pictures_of(broken.folder / "predictions.jsonl")[0].unlink()
    fault, table = split.track.mark([broken, whole], split, workers)
    assert isinstance(fault, RsbenchError) and "left_1.exr: is missing" in str(fault)
    assert isinstance(table, pd.DataFrame) and np.all(table["bad_1"] == 0.0)


def test_a_fault_is_told_after_the_others_are_on_the_board(splits: dict[str, Split], tmp_path: Path) -> None:
    split = splits["depth"]
    paths = list(write_oracles(split, tmp_path / "oracles"))
    write_depth(pictures_of(paths[0])[0], np.full((80, 96), -1.0, dtype=np.float32))
    with pytest.raises(RsbenchError, match=r"left_1\.exr: 7680 pixels are negative"):
        add_all(tmp_path / "board", paths, split, {"command": ORACLES})
    (entry,) = entries_of(tmp_path / "board", split.track.id, split.name)
    assert entry.header.method == "constant"


def test_a_child_says_that_the_truth_has_changed(splits: dict[str, Split], tmp_path: Path) -> None:
    """In this process, as a child would."""
    split = splits["depth"]
    first, second = split.truths
    assert first.pictures is not None
    changed = replace(first.pictures, files=dict.fromkeys(first.pictures.files, "0" * 64))
    broken = replace(split, truths=(replace(first, pictures=changed), second))
    run = _serve_rows([read_submission(write_truth(split, tmp_path), split)], broken)
    with pytest.raises(EntryFailure, match=r"is not the file that dataset\.json names"):
        run(first.name)
    (row,) = run(second.name)
    assert isinstance(row, dict) and row["bad_1"] == 0.0
