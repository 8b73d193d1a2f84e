"""The tracks depth and correction: what scores, what is told of slips, and boards."""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from analytic_dataset import write_analytic_dataset
from leaderboards import ASK_PICTURES, PLANES, lines_of, pictures_of, write

from rsbench.benchmark.leaderboard.board import add, entries_of, merge, rescore
from rsbench.benchmark.leaderboard.standings import standings
from rsbench.benchmark.leaderboard.submissions import (
    check_submission,
    read_submission,
    write_oracles,
    write_template,
    write_truth,
)
from rsbench.benchmark.leaderboard.track import Split, mark
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.components.motion_models import LinearMotion
from rsbench.core.errors import RsbenchError
from rsbench.storage.files import read_depth, read_png, write_depth, write_png

RIG, SHUTTER, MOTION = PLANES


def _scores(path: Path, split: Split) -> pd.DataFrame:
    return mark(read_submission(path, split), split)


def _each_depth(path: Path, change: Callable[[np.ndarray], np.ndarray]) -> Path:
    for picture in pictures_of(path):
        write_depth(picture, change(read_depth(picture).astype(np.float64)).astype(np.float32))
    return path


def _each_frame(path: Path, change: Callable[[np.ndarray], np.ndarray]) -> Path:
    for picture in pictures_of(path):
        write_png(picture, np.ascontiguousarray(change(read_png(picture))))
    return path


# Scores


@pytest.mark.parametrize("track", ASK_PICTURES)
def test_the_truth_is_best_and_nothing_is_worst(track: str, splits: dict[str, Split], tmp_path: Path) -> None:
    """No score of any other lies outside; the order of answers does not matter."""
    split = splits[track]
    two = islice(write_oracles(split, tmp_path), 2)  # the third takes seconds, and is scored below
    found = {path.parent.name: _scores(path, split) for path in two}
    path = tmp_path / "truth" / "predictions.jsonl"
    head, *answers = lines_of(path)
    write(path, [head, *random.Random(1).sample(answers, len(answers))])
    pd.testing.assert_frame_equal(_scores(path, split), found["truth"])
    empty = _scores(write(tmp_path / "empty.jsonl", [head]), split)
    failed = [{**answer, "success": False} for answer in answers]
    pd.testing.assert_frame_equal(_scores(write(tmp_path / "failed.jsonl", [head, *failed]), split), empty)
    for score in split.track.scores:
        best, worst = ((score.sign * found["truth"][score.key]), (score.sign * empty[score.key]))
        if score.key == "seconds":
            continue
        assert np.all(best >= worst)
        for other in found.values():
            value = score.sign * other[score.key]
            assert np.all((value <= best) & (value >= worst)), score.key
    primary = split.track.primary
    assert np.all(found["truth"][primary.key] == (1.0 if primary.better == "higher" else 0.0))
    assert found["truth"][split.track.error].max() == 0.0 and empty[split.track.error].min() == 1.0


def test_depth_scores_are_those_of_a_count(splits: dict[str, Split], tmp_path: Path) -> None:
    """Pixel by pixel, of a map that is off by known disparities and does not know a part."""
    split = splits["depth"]
    rng = np.random.default_rng(0)
    path = write_truth(split, tmp_path)
    off = rng.choice([0.0, 0.6, 1.4, -2.5, 5.0], (80, 96))
    known = rng.random((80, 96)) > 0.2
    product = RIG.camera.fx * RIG.baseline
    _each_depth(path, lambda z: np.where(known, product / np.maximum(product / z + off, 0.1), 0.0))
    scores = _scores(path, split)
    for number, truth in enumerate(split.truths):
        assert truth.pictures is not None
        z = truth.pictures.depth().astype(np.float64)
        estimate = read_depth(pictures_of(path)[number]).astype(np.float64)
        for limit in (1, 2, 3):
            bad = sum(
                not known[i, j] or abs(product / estimate[i, j] - product / z[i, j]) > limit
                for i in range(80)
                for j in range(96)
            )
            assert abs(scores[f"bad_{limit}"][number] - bad / z.size) < 1e-12
        relative = [abs(estimate[i, j] / z[i, j] - 1.0) for i in range(80) for j in range(96) if known[i, j]]
        assert abs(scores["abs_rel"][number] - np.mean(relative)) < 1e-12
        squares = (estimate - z)[known] ** 2
        assert abs(scores["rmse_m"][number] - np.sqrt(squares.mean())) < 1e-9
        assert scores["coverage"][number] == known.mean() and scores["on_sky"][number] == 0.0
        # The classes make up the whole: what the right camera sees, and the rest.
        seen = truth.pictures.seen_by_both(truth.pictures.depth()).mean()
        whole = seen * scores["bad_1_visible"][number] + (1.0 - seen) * scores["bad_1_occluded"][number]
        assert abs(whole - scores["bad_1"][number]) < 1e-12


def test_frame_scores_follow_their_formulas(splits: dict[str, Split], tmp_path: Path) -> None:
    """Ten steps of grey everywhere, a picture that is moved by two pixels, and one that is half drawn."""
    split = splits["correction"]
    brighter = _scores(_each_frame(write_truth(split, tmp_path / "a"), lambda image: image + np.uint8(10)), split)
    for name in ("psnr", "psnr_all", "psnr_covered", "psnr_first", "psnr_middle"):
        np.testing.assert_allclose(brighter[name], 20.0 * np.log10(25.5), rtol=1e-9)
    moved = _scores(
        _each_frame(write_truth(split, tmp_path / "b"), lambda image: np.roll(image, 2, axis=1)), split
    )
    assert np.all(np.abs(moved["epe_px"] - 2.0) < 0.3)  # dense flow is some tenths of a pixel wrong
    assert np.all(moved["ssim"] < brighter["ssim"])
    path = write_truth(split, tmp_path / "c")
    for picture in pictures_of(path):
        image = read_png(picture)
        alpha = np.zeros(image.shape[:2], np.uint8)
        alpha[:40] = 255
        cv2.imwrite(str(picture), np.dstack([image[..., ::-1], alpha]))
    half = _scores(path, split)
    assert np.all(half["ssim_covered"] == 1.0) and np.all(np.isinf(half["psnr_covered"]))
    assert np.all(half["psnr_all"] < 12.0)
    for truth, share in zip(split.truths, half["coverage"], strict=True):
        assert truth.pictures is not None
        masks = truth.pictures.commons()
        assert abs(share - np.mean([mask[:40].sum() / mask.sum() for mask in masks])) < 1e-12


def test_the_common_pixels_are_those_that_the_frame_saw(splits: dict[str, Split]) -> None:
    """By rays: the true point of each pixel of the corrected frame, projected into the rolling-shutter one."""
    from rsbench.core.projection import rs_project

    truth = splits["correction"].truths[1]
    assert truth.pictures is not None
    for each, common in zip(truth.pictures.requested, truth.pictures.commons(), strict=True):
        sequence = truth.pictures.sequence
        pose = RIG.cam_from_world(truth.motion, truth.shutter.time_after(each.row, 1, "left"), "left")
        z = sequence.depth("gs", "left", 1, each.row)[..., None]
        X = (RIG.camera.unproject(RIG.camera.pixel_grid()) * z - pose.t) @ pose.R
        seen = rs_project(RIG, truth.shutter, truth.motion, "left", 1, X.reshape(-1, 3)).pixels
        inside = np.all((seen >= 0.0) & (seen <= [95.0, 79.0]), axis=-1).reshape(80, 96)
        assert np.mean(inside == common) > 0.97  # but for the rims


# What is told


DEPTH_SLIPS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "millimetres": lambda z: 1000.0 * z,
    "centimetres": lambda z: 100.0 * z,
    "disparity in px": lambda z: RIG.camera.fx * RIG.baseline / z,
    "inverse depth": lambda z: 1.0 / z,
    "along the ray": lambda z: z * np.linalg.norm(RIG.camera.unproject(RIG.camera.pixel_grid()), axis=-1),
    "up to a factor": lambda z: 3.7 * z,
}
FRAME_SLIPS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "red and blue": lambda image: image[..., ::-1],
    "upside down": lambda image: image[::-1],
    "mirrored": lambda image: image[:, ::-1],
    "a row too low": lambda image: np.roll(image, 1, axis=0),
    "a column too far left": lambda image: np.roll(image, -1, axis=1),
}


@pytest.mark.parametrize("words", [*DEPTH_SLIPS, *FRAME_SLIPS])
def test_slips_are_told(words: str, splits: dict[str, Split], tmp_path: Path) -> None:
    """And of a secret truth only what needs no truth."""
    split = splits["depth" if words in DEPTH_SLIPS else "correction"]
    path = write_truth(split, tmp_path)
    if words in DEPTH_SLIPS:
        _each_depth(path, DEPTH_SLIPS[words])
    else:
        _each_frame(path, FRAME_SLIPS[words])
    (note,) = check_submission(path, split).notes
    assert words in note
    blind = check_submission(path, replace(split, public=False)).notes
    assert len(blind) == (1 if words in ("millimetres", "centimetres") else 0)


def test_what_is_nearly_right_is_not_called_a_slip(splits: dict[str, Split], tmp_path: Path) -> None:
    """Noise of 3 %, a map that is 2 % too large, and frames with noise."""
    rng = np.random.default_rng(0)
    path = _each_depth(
        write_truth(splits["depth"], tmp_path / "a"),
        lambda z: 1.02 * z * np.exp(0.03 * rng.standard_normal(z.shape)),
    )
    assert check_submission(path, splits["depth"]).notes == ()
    path = _each_frame(
        write_truth(splits["correction"], tmp_path / "b"),
        lambda image: np.clip(image + rng.normal(0.0, 12.0, image.shape), 0, 255).astype(np.uint8),
    )
    assert check_submission(path, splits["correction"]).notes == ()


def test_exchanged_rows_are_told(splits: dict[str, Split], tmp_path: Path) -> None:
    path = write_truth(splits["correction"], tmp_path)
    for folder in (tmp_path / "pictures").iterdir():
        (folder / "left_1_first.png").rename(folder / "x")
        (folder / "left_1_middle.png").rename(folder / "left_1_first.png")
        (folder / "x").rename(folder / "left_1_middle.png")
    notes = check_submission(path, splits["correction"]).notes
    assert len(notes) == 2 and all("rows are exchanged" in note for note in notes)


@pytest.mark.parametrize("track", ASK_PICTURES)
def test_the_template_is_in_order(track: str, splits: dict[str, Split], tmp_path: Path) -> None:
    write_template(splits[track], path := tmp_path / "predictions.jsonl")
    assert check_submission(path, splits[track]).faults == ()


def test_depth_of_opencv_alone_is_read(splits: dict[str, Split], tmp_path: Path) -> None:
    """The lines of the document: half a step of rounding is all that is lost."""
    split = splits["depth"]
    path = write_truth(split, tmp_path)
    for picture in pictures_of(path):
        depth = read_depth(picture)
        picture.unlink()
        cv2.imwrite(str(picture.with_suffix(".png")), np.clip(depth / 0.001 + 0.5, 0, 65535).astype(np.uint16))
    head, *answers = lines_of(path)
    write(path, [head, *answers])
    assert "png_unit_m" in check_submission(path, split).faults[0]
    write(path, [{**head, "png_unit_m": 0.001}, *answers])
    scores = _scores(path, split)
    assert scores["bad_1"].max() == 0.0 and 0.0 < scores["rmse_m"].max() < 0.0005


# Boards


def _submitted(board: Path, split: Split, folder: Path, method: str, factor: float = 1.0) -> None:
    path = _each_depth(write_truth(split, folder / method), lambda z: factor * z)
    head, *answers = lines_of(path)
    add(board, write(path, [{**head, "method": method, "uses": ["images"]}, *answers]), split, {})


def test_entries_stand_alone_copies_tie_and_boards_merge(splits: dict[str, Split], tmp_path: Path) -> None:
    split, board, other = splits["depth"], tmp_path / "board", tmp_path / "other"
    _submitted(board, split, tmp_path, "a", 1.2)
    (alone,) = entries_of(board, "depth-1", split.name)
    _submitted(board, split, tmp_path, "b", 1.01)
    _submitted(other, split, tmp_path, "copy", 1.2)
    assert merge(other, board) == [f"depth-1/{split.name}/copy"]
    found = {line.scored.header.method: line for line in standings(entries_of(board, "depth-1", split.name))}
    pd.testing.assert_frame_equal(found["a"].scored.scores, alone.scores)
    assert next(iter(found)) == "b" and found["a"].rank == found["copy"].rank and "copy" in found["a"].ties
    assert sorted(alone.files) == ["pictures/planes.0/left_1.exr", "pictures/planes.1/left_1.exr"]
    assert rescore(board, split) == {}
    with pytest.raises(RsbenchError, match="with other predictions"):
        _submitted(board, split, tmp_path / "again", "a", 1.3)


def test_pictures_that_were_changed_are_named(splits: dict[str, Split], tmp_path: Path) -> None:
    split, board = splits["depth"], tmp_path / "board"
    _submitted(board, split, tmp_path, "a", 1.2)
    (entry,) = entries_of(board, "depth-1", split.name)
    record = json.loads((entry.folder / "entry.json").read_text("utf-8"))
    write_depth(entry.folder / "pictures" / "planes.0" / "left_1.exr", np.ones((80, 96), np.float32))
    for act in (lambda: rescore(board, split), lambda: merge(board, tmp_path / "mine")):
        with pytest.raises(RsbenchError, match=r"left_1\.exr: has changed since it was scored"):
            act()
    secret = tmp_path / "secret"
    secret.write_text("secret", "utf-8")
    for name in (
        "../../../../../secret",
        "pictures/../../../../../secret",
        "/etc/passwd",
        "pictures/x\0",
        "pictures/planes.0/left_1.html",
    ):
        hostile = {**record, "files": {name: "0" * 64}}
        (entry.folder / "entry.json").write_text(json.dumps(hostile), "utf-8")
        with pytest.raises(RsbenchError, match="is no name of a file of an answer"):
            merge(board, tmp_path / "mine")
    assert not [
        p for p in (tmp_path / "mine").rglob("*") if p.is_file() and "secret" in p.read_text("utf-8", "ignore")
    ]


def test_another_dataset_is_another_split(planes: Path, splits: dict[str, Split], tmp_path: Path) -> None:
    """Pictures count: of one motion, with another depth; and a byte that changed since is refused by name."""
    write_analytic_dataset(
        tmp_path,
        RIG,
        SHUTTER,
        MOTION,
        frames=3,
        twins=(40,),
        true_motion=LinearMotion(MOTION.w, -MOTION.d),
    )
    assert TRACKS["pose"].split(tmp_path).name == TRACKS["pose"].split(planes).name
    split = TRACKS["depth"].split(tmp_path)
    assert split.name != splits["depth"].name
    path = write_truth(split, tmp_path / "truth")
    true = tmp_path / "planes" / "rs_depth" / "left_2.exr"
    write_depth(true, 1.01 * read_depth(true))
    with pytest.raises(RsbenchError, match=r"left_2\.exr: is not the file that dataset\.json names"):
        _scores(path, split)


def test_cameras_of_other_kinds_are_refused(planes: Path, tmp_path: Path) -> None:
    shutil.copytree(planes, tmp_path / "copy")
    path = tmp_path / "copy" / "planes" / "sequence.json"
    path.write_text(json.dumps({**json.loads(path.read_text("utf-8")), "scan": "bottom"}), "utf-8")
    with pytest.raises(RsbenchError, match="is of cameras without a lens that read rows together"):
        TRACKS["depth"].split(tmp_path / "copy")
