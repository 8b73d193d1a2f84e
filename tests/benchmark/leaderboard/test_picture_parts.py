"""Scores of pictures by rows from the reference row and by texture, against counts, pixel by pixel."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from leaderboards import ASK_PICTURES, PLANES, lines_of, named, pictures_of, write

from rsbench.benchmark.leaderboard.board import add, place
from rsbench.benchmark.leaderboard.picture_track import PictureTrack
from rsbench.benchmark.leaderboard.pictures import PARTINGS, WINDOW, columns, texture
from rsbench.benchmark.leaderboard.submissions import read_submission, write_truth
from rsbench.benchmark.leaderboard.track import Split, mark
from rsbench.report.board_entry import entry_context
from rsbench.report.board_pictures import albums
from rsbench.report.board_splits import read_split
from rsbench.storage.files import read_depth, read_png, read_table, write_depth, write_png

RIG, _, _ = PLANES
ROWS, TEXTURE = PARTINGS


def test_texture_is_the_deviation_in_a_window() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (30, 40, 3)).astype(np.uint8)
    image[:, 25:] = 90
    found, half = texture(image), WINDOW // 2
    for y, x in ((4, 4), (15, 20), (25, 23)):
        window = image[y - half : y + half + 1, x - half : x + half + 1].astype(np.float64).mean(axis=-1)
        # The difference of two squares of some 100 levels: rounding of 1e-12 of them, below a root.
        assert found[y, x] == pytest.approx(window.std(), abs=1e-5)
    assert np.all(found[:, 30:] < 1e-5)


def _by_hand(values: np.ndarray, of: np.ndarray, image: np.ndarray, row: int) -> dict[str, list[float]]:
    """The ``values`` (H, W) of the pixels ``of`` (H, W) in each part, one after the other."""
    deviation, found = texture(image.astype(np.uint8)), dict[str, list[float]]()
    for (y, x), value in np.ndenumerate(values):
        for parting, at in ((ROWS, abs(y - row) / len(values)), (TEXTURE, deviation[y, x])):
            number = max(k for k, start in enumerate(parting.starts) if at >= start) + 1
            if of[y, x]:
                found.setdefault(f"{parting.name}_{number}", []).append(float(value))
    return found


def test_wrong_depth_is_counted_by_part(splits: dict[str, Split], tmp_path: Path) -> None:
    """Off by 1.5 px below the middle row, and unknown in a column: of rows the first parts are right."""
    split = splits["depth"]
    path, product = write_truth(split, tmp_path), RIG.camera.fx * RIG.baseline
    for picture in pictures_of(path):
        z = read_depth(picture).astype(np.float64)
        z[40:] = product / (product / z[40:] + 1.5)
        z[:, 7] = 0.0
        write_depth(picture, z.astype(np.float32))
    scores = mark(read_submission(path, split), split)
    assert np.all(scores["bad_1_rows_1"] == 1 / 96) and np.all(scores["bad_1_rows_5"] == 1.0)
    for number, truth in enumerate(split.truths):
        assert truth.pictures is not None
        wrong = np.zeros((80, 96))
        wrong[40:], wrong[:, 7] = 1.0, 1.0
        parts = _by_hand(wrong, truth.pictures.depth() > 0, truth.pictures.rolling(), 0)
        for name in (*columns("bad_1", ROWS), *columns("bad_1", TEXTURE)):
            expected = parts.get(name.removeprefix("bad_1_"), [math.nan])
            assert scores[name][number] == pytest.approx(np.mean(expected), nan_ok=True)
        assert scores["bad_1"][number] == pytest.approx(wrong.mean())


def test_errors_of_frames_are_rooted_by_part(splits: dict[str, Split], tmp_path: Path) -> None:
    """Each pixel of both frames off by a level of its own; a part holds what either frame has of it."""
    split = splits["correction"]
    path, off = write_truth(split, tmp_path), np.random.default_rng(1).integers(0, 3, (80, 96, 3))
    off[50:] *= 9
    for picture in pictures_of(path):
        write_png(picture, ((read_png(picture) + off) % 256).astype(np.uint8))
    scores = mark(read_submission(path, split), split)
    for number, truth in enumerate(split.truths):
        assert truth.pictures is not None
        parts = dict[str, list[float]]()
        for each, common in zip(truth.pictures.requested, truth.pictures.commons(), strict=True):
            frame = truth.pictures.frame(each.row)
            squares = np.mean(((frame + off) % 256 - frame.astype(np.float64)) ** 2, axis=-1)
            for name, values in _by_hand(squares, common, frame, each.row).items():
                parts.setdefault(name, []).extend(values)
        for name in (*columns("rms", ROWS), *columns("rms", TEXTURE)):
            expected = parts.get(name.removeprefix("rms_"), [math.nan])
            assert scores[name][number] == pytest.approx(np.sqrt(np.mean(expected)), nan_ok=True)


def _folder(path: Path) -> Path:
    """Without pictures."""
    path.mkdir()
    return path


@pytest.mark.parametrize(("track", "worst"), [("depth", 1.0), ("correction", 255.0)])
def test_a_failure_is_the_worst_in_the_same_parts(
    track: str, worst: float, splits: dict[str, Split], tmp_path: Path
) -> None:
    split = splits[track]
    path = write_truth(split, tmp_path)
    right = mark(read_submission(path, split), split)
    failed = mark(read_submission(write(_folder(tmp_path / "none") / "x.jsonl", lines_of(path)[:1]), split), split)
    for parting in PARTINGS:
        for name in columns(cast(PictureTrack, split.track).part_score, parting):
            assert list(right[name].isna()) == list(failed[name].isna())
            assert set(right[name].dropna()) <= {0.0} and set(failed[name].dropna()) <= {worst}
    assert failed[columns(cast(PictureTrack, split.track).part_score, ROWS)[0]].notna().all()


@pytest.mark.parametrize("track", ASK_PICTURES)
def test_the_page_of_an_entry_draws_them(track: str, splits: dict[str, Split], tmp_path: Path) -> None:
    """Medians of the problems, as stored; none of a secret split, and none of scores that were stored before."""
    split = splits[track]
    lines = lines_of(write_truth(split, tmp_path / "in"))
    failed = [{"name": line["name"], "success": False} for line in lines[1:]]
    path = write(_folder(tmp_path / "none") / "x.jsonl", named([lines[0], *failed], "none", ("images",)))
    scored = add(tmp_path / "board", path, split, {})
    names = (tmp_path / "board", split.track.id, split.name)

    def drawn() -> list[dict[str, str]]:
        board = read_split(*names)
        (album,) = albums([board], tmp_path / "out", ())
        found: list[dict[str, str]] = entry_context(board, board.lines[0], album)["figures_within"]["drawn"]
        return found

    rows, by_texture = drawn()
    worst = "1" if track == "depth" else "255"
    assert f"median errors at 0, 0.2, 0.4, 0.6, 0.8: none: {', '.join([worst] * 5)}" in rows["svg"]
    assert rows["title"] == ROWS.title and by_texture["title"] == TEXTURE.title
    table = scored.folder / "scores.csv"
    kept = read_table(table)
    write_csv = kept.drop(columns=[name for name in map(str, kept) if "_rows_" in name or "_texture_" in name])
    write_csv.to_csv(table, index=False)
    assert drawn() == []
    kept.to_csv(table, index=False)
    add(tmp_path / "secret", path, replace(split, public=False), {})
    names = (tmp_path / "secret", split.track.id, split.name)
    assert place(*names).is_dir() and drawn() == []
