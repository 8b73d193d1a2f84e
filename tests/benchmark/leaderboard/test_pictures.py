"""Submitted pictures: their scores against counts and formulas, faults, and parts of the pixels."""

from __future__ import annotations

import json
import math
import os
import random
import shutil
import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest
from analytic_dataset import write_analytic_dataset
from leaderboards import (
    ASK_PICTURES,
    PLANES,
    Line,
    files_below,
    lines_of,
    named,
    pictures_of,
    scores_of,
    small_split,
    write,
)

from rsbench.benchmark.leaderboard.board import add, entries_of, merge, place, rescore
from rsbench.benchmark.leaderboard.pictures import PARTINGS, WINDOW, columns, texture
from rsbench.benchmark.leaderboard.submissions import (
    check_submission,
    write_oracles,
    write_template,
    write_truth,
)
from rsbench.benchmark.leaderboard.track import Split
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.components.motion_models import LinearMotion
from rsbench.core.errors import RsbenchError
from rsbench.report.board_page import albums, entry_context, read_split
from rsbench.storage.files import read_depth, read_png, read_table, write_depth, write_exr, write_png

RIG, SHUTTER, MOTION = PLANES


def _changed(path: Path, change: Callable[[np.ndarray], np.ndarray]) -> Path:
    """A file of predictions whose depth maps, float64 when they are changed, or frames are others."""
    for picture in pictures_of(path):
        if picture.suffix == ".png":
            write_png(picture, np.ascontiguousarray(change(read_png(picture))))
        else:
            write_depth(picture, change(read_depth(picture).astype(np.float64)).astype(np.float32))
    return path


# Scores


@pytest.mark.parametrize("track", [*ASK_PICTURES, "points"])
def test_the_truth_is_best_and_nothing_is_worst(track: str, splits: dict[str, Split], tmp_path: Path) -> None:
    """No score of any other lies outside; the order of answers does not matter."""
    split = splits[track] if track in splits else small_split()
    two = islice(write_oracles(split, tmp_path), 2)  # the third takes seconds, and is scored below
    found = {path.parent.name: scores_of(split, path) for path in two}
    path = tmp_path / "truth" / "predictions.jsonl"
    head, *answers = lines_of(path)
    write(path, [head, *random.Random(1).sample(answers, len(answers))])
    pd.testing.assert_frame_equal(scores_of(split, path), found["truth"])
    empty = scores_of(split, [head], tmp_path)
    failed = [head, *({"name": answer["name"], "success": False, "reason": "no"} for answer in answers)]
    pd.testing.assert_frame_equal(scores_of(split, failed, tmp_path), empty)
    for score in split.track.scores:
        best, worst = (score.sign * each[score.key] for each in (found["truth"], empty))
        for other in found.values() if score.key != "seconds" else ():
            value = score.sign * other[score.key]
            assert np.all((value <= best) & (value >= worst)) and np.all(best >= worst), score.key
    primary, error = split.track.primary, split.track.error
    rounding, most = (1e-5, 180.0) if track == "points" else (0.0, 1.0)
    np.testing.assert_allclose(found["truth"][primary.key], float(primary.better == "higher"), atol=rounding)
    assert found["truth"][error].max() <= rounding and empty[error].min() == most


def test_depth_scores_are_those_of_a_count(splits: dict[str, Split], tmp_path: Path) -> None:
    """Pixel by pixel, of a map that is off by known disparities and does not know a part."""
    split = splits["depth"]
    rng = np.random.default_rng(0)
    off = rng.choice([0.0, 0.6, 1.4, -2.5, 5.0], (80, 96))
    known = rng.random((80, 96)) > 0.2
    product = RIG.camera.fx * RIG.baseline
    path = _changed(
        write_truth(split, tmp_path),
        lambda z: np.where(known, product / np.maximum(product / z + off, 0.1), 0.0),
    )
    scores = scores_of(split, path)
    for number, truth in enumerate(split.truths):
        z = truth.shown.depth().astype(np.float64)
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
        seen = truth.shown.seen_by_both(truth.shown.depth()).mean()
        whole = seen * scores["bad_1_visible"][number] + (1.0 - seen) * scores["bad_1_occluded"][number]
        assert abs(whole - scores["bad_1"][number]) < 1e-12


def test_frame_scores_follow_their_formulas(splits: dict[str, Split], tmp_path: Path) -> None:
    """Ten steps of grey everywhere, a picture that is moved by two pixels, and one that is half drawn."""
    split = splits["correction"]
    brighter = scores_of(split, _changed(write_truth(split, tmp_path / "a"), lambda image: image + np.uint8(10)))
    for name in ("psnr", "psnr_all", "psnr_covered", "psnr_first", "psnr_middle"):
        np.testing.assert_allclose(brighter[name], 20.0 * np.log10(25.5), rtol=1e-9)
    path = _changed(write_truth(split, tmp_path / "b"), lambda image: np.roll(image, 2, axis=1))
    moved = scores_of(split, path)
    assert np.all(np.abs(moved["epe_px"] - 2.0) < 0.3)  # dense flow is some tenths of a pixel wrong
    assert np.all(moved["ssim"] < brighter["ssim"])
    path = write_truth(split, tmp_path / "c")
    for picture in pictures_of(path):
        image = read_png(picture)
        alpha = np.zeros(image.shape[:2], np.uint8)
        alpha[:40] = 255
        cv2.imwrite(str(picture), np.dstack([image[..., ::-1], alpha]))
    half = scores_of(split, path)
    assert np.all(half["ssim_covered"] == 1.0) and np.all(np.isinf(half["psnr_covered"]))
    assert np.all(half["psnr_all"] < 12.0)
    for truth, share in zip(split.truths, half["coverage"], strict=True):
        masks = truth.shown.commons()
        assert abs(share - np.mean([mask[:40].sum() / mask.sum() for mask in masks])) < 1e-12


def test_the_common_pixels_are_those_that_the_frame_saw(splits: dict[str, Split]) -> None:
    """By rays: the true point of each pixel of the corrected frame, projected into the rolling-shutter one."""
    from rsbench.core.projection import rs_project

    truth = splits["correction"].truths[1]
    for each, common in zip(truth.shown.requested, truth.shown.commons(), strict=True):
        sequence = truth.shown.sequence
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
    path = _changed(write_truth(split, tmp_path), (DEPTH_SLIPS | FRAME_SLIPS)[words])
    (note,) = check_submission(path, split).notes
    assert words in note
    blind = check_submission(path, replace(split, public=False)).notes
    assert len(blind) == (1 if words in ("millimetres", "centimetres") else 0)


def test_what_is_nearly_right_is_not_called_a_slip(splits: dict[str, Split], tmp_path: Path) -> None:
    """Noise of 3 %, a map that is 2 % too large, and frames with noise."""
    rng = np.random.default_rng(0)
    path = _changed(
        write_truth(splits["depth"], tmp_path / "a"),
        lambda z: 1.02 * z * np.exp(0.03 * rng.standard_normal(z.shape)),
    )
    assert check_submission(path, splits["depth"]).notes == ()
    path = _changed(
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
    scores = scores_of(split, path)
    assert scores["bad_1"].max() == 0.0 and 0.0 < scores["rmse_m"].max() < 0.0005


# Boards


def _submitted(board: Path, split: Split, folder: Path, method: str, factor: float = 1.0) -> None:
    path = _changed(write_truth(split, folder / method), lambda z: factor * z)
    head, *answers = lines_of(path)
    add(board, write(path, [{**head, "method": method, "uses": ["images"]}, *answers]), split, {})


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
        tmp_path, RIG, SHUTTER, MOTION, frames=3, twins=(40,), true_motion=LinearMotion(MOTION.w, -MOTION.d)
    )
    assert TRACKS["pose"].split(tmp_path).name == TRACKS["pose"].split(planes).name
    split = TRACKS["depth"].split(tmp_path)
    assert split.name != splits["depth"].name
    path = write_truth(split, tmp_path / "truth")
    true = tmp_path / "planes" / "rs_depth" / "left_2.exr"
    write_depth(true, 1.01 * read_depth(true))
    with pytest.raises(RsbenchError, match=r"left_2\.exr: is not the file that dataset\.json names"):
        scores_of(split, path)


def test_cameras_of_other_kinds_are_refused(planes: Path, tmp_path: Path) -> None:
    shutil.copytree(planes, tmp_path / "copy")
    path = tmp_path / "copy" / "planes" / "sequence.json"
    path.write_text(json.dumps({**json.loads(path.read_text("utf-8")), "scan": "bottom"}), "utf-8")
    with pytest.raises(RsbenchError, match="is of cameras without a lens that read rows together"):
        TRACKS["depth"].split(tmp_path / "copy")


def _header(width: int = 96, height: int = 80, bits: int = 8, colour: int = 2) -> bytes:
    return struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)


def _png(*more: tuple[bytes, bytes], header: bytes = _header(), body: bytes = b"") -> bytes:
    """``more``: chunks between the header and the pixels."""
    chunks = ((b"IHDR", header), *more, (b"IDAT", zlib.compress(body)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )


def _with_hole(value: float) -> Callable[[Path], None]:
    def damage(picture: Path) -> None:
        depth = np.full((80, 96), 5.0, dtype=np.float32)
        depth[3, 4] = value
        write_depth(picture, depth)

    return damage


def _with_window(x: int, y: int) -> Callable[[Path], None]:
    """Of an EXR file, from (x, y) on where that leaves the size as it is, else up to there."""

    def damage(picture: Path) -> None:
        key = b"dataWindow\0box2i\0\x10\0\0\0"
        data = picture.read_bytes()
        place = data.index(key) + len(key)
        window = (0, 0, x, y) if x > 1000 else (x, y, x + 95, y + 79)
        picture.write_bytes(data[:place] + struct.pack("<4i", *window) + data[place + 16 :])

    return damage


def _link(picture: Path) -> None:
    other = picture.parents[3] / "secret"
    picture.rename(other)
    picture.symlink_to(other)


def _linked_folder(picture: Path) -> None:
    other = picture.parents[3] / "secret"
    picture.parent.rename(other)
    picture.parent.symlink_to(other)


def _written(data: bytes) -> Callable[[Path], object]:
    return lambda picture: picture.write_bytes(data)


def _replaced(make: Callable[[Path], object]) -> Callable[[Path], None]:
    """By what ``make`` puts in the place of a picture."""

    def damage(picture: Path) -> None:
        picture.unlink()
        make(picture)

    return damage


DEPTH_FAULTS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "missing": (lambda p: p.unlink(), "left_1.exr: is missing"),
    "two": (
        lambda p: p.with_suffix(".png").write_bytes(p.read_bytes()),
        "2 of left_1.exr and left_1.png are there",
    ),
    "another name": (lambda p: p.rename(p.with_name("left_0.exr")), "left_0.exr: does not belong here"),
    "another problem": (lambda p: p.parent.rename(p.parent.with_name("castle")), "castle: is no problem of"),
    "a file too many": (lambda p: p.with_name("evil.sh").write_text("x"), "evil.sh: does not belong here"),
    "a hidden file": (lambda p: p.with_name(".x").write_text("x"), ".x: does not belong here"),
    "a file among folders": (lambda p: (p.parents[1] / "planes.1x").write_text("x"), "planes.1x: is no problem"),
    "a link": (_link, "left_1.exr: must be a file of its own, no link"),
    "a linked folder": (_linked_folder, "planes.0: must be a folder of its own, no link"),
    "a circle": (_replaced(lambda p: p.symlink_to(p)), "must be a file of its own, no link"),
    "a pipe": (_replaced(lambda p: os.mkfifo(p)), "must be a file of its own"),
    "a folder": (_replaced(lambda p: p.mkdir()), "must be a file of its own"),
    "1 GB": (lambda p: os.truncate(p, 1 << 30), "bytes: 1073741824 is more than"),
    "no EXR": (lambda p: p.write_bytes(b"PK\x03\x04" + bytes(100)), "damaged or not an EXR file"),
    "half a file": (lambda p: os.truncate(p, 500), "left_1.exr: "),
    "channels of colour": (
        lambda p: write_exr(p, {c: np.ones((80, 96), np.float32) for c in "RGB"}),
        "must hold one part of scanlines with one channel, Z, of float32",
    ),
    "channel Y": (lambda p: write_exr(p, {"Y": np.ones((80, 96), np.float32)}), "with one channel, Z"),
    "half floats": (lambda p: write_exr(p, {"Z": np.ones((80, 96), np.float32)}, half=True), "float32 channel Z"),
    "another size": (
        lambda p: write_depth(p, np.ones((96, 80), np.float32)),
        "is 80 x 96 pixels, the camera 96 x 80",
    ),
    "huge by its header": (_with_window(2**31 - 1, 2**31 - 1), "left_1.exr: "),
    "a window elsewhere": (_with_window(5, 3), "left_1.exr: "),
    "NaN": (_with_hole(np.nan), "1 pixels are NaN; unknown depth and sky are 0"),
    "infinity": (_with_hole(np.inf), "1 pixels are infinite"),
    "negative": (_with_hole(-1.0), "1 pixels are negative"),
    "beyond the universe": (_with_hole(1e30), "1 pixels are above 1e+09 m"),
}
DAMAGED, UNFOLDS = "is a damaged PNG file", b"x\0\0" + zlib.compress(bytes(1 << 22))
TOO_LARGE = f"{DAMAGED}: Decompressed data too large"
FILM = (
    (b"acTL", struct.pack(">II", 2, 0)),
    (b"fcTL", struct.pack(">IIIIIHHBB", 0, 60000, 60000, 0, 0, 1, 1, 0, 0)),
)
FRAME_FAULTS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "a JPEG": (lambda p: p.write_bytes(cv2.imencode(".jpg", np.ones((80, 96, 3)))[1].tobytes()), "is no PNG file"),
    "16 bits": (
        lambda p: cv2.imwrite(str(p), np.ones((80, 96, 3), np.uint16)),
        "is RGB of 16 bits: must be RGB or",
    ),
    "grey": (lambda p: cv2.imwrite(str(p), np.ones((80, 96), np.uint8)), "is grey of 8 bits: must be RGB or RGBA"),
    "a palette": (_written(_png(header=_header(colour=3))), "is palette of 8 bits"),
    "no colour type": (_written(_png(header=_header(colour=77))), "is unknown of 8 bits"),
    "another size": (lambda p: write_png(p, np.zeros((80, 95, 3), np.uint8)), "is 95 x 80 pixels"),
    "a huge image": (_written(_png(header=_header(2**31 - 1, 2**31 - 1))), "is 2147483647 x 2147483647 pixels"),
    # 64 million pixels pass Pillow's own limit.
    "a second header": (_written(_png((b"IHDR", _header(8000, 8000)))), "its headers differ: 8000 x 8000 pixels"),
    "a second kind": (
        _written(_png((b"IHDR", _header(colour=0)), body=bytes(97 * 80))),
        "is RGB of 8 bits, and holds something else",
    ),
    "a text that unfolds": (_written(_png((b"zTXt", UNFOLDS))), TOO_LARGE),
    "a profile that unfolds": (_written(_png((b"iCCP", UNFOLDS))), TOO_LARGE),
    "a film of huge pictures": (_written(_png(*FILM)), DAMAGED),
    "another check sum": (lambda p: p.write_bytes(p.read_bytes()[:29] + b"abcd" + p.read_bytes()[33:]), "damaged"),
    "no pixels": (_written(_png()), DAMAGED),
    "only a header": (lambda p: p.write_bytes(_png()[:30]), "is no PNG file"),
    "nothing": (_written(b""), "is no PNG file"),
    "the middle is missing": (
        lambda p: p.with_name("left_1_middle.png").unlink(),
        "left_1_middle.png: is missing",
    ),
}
ANSWER_FAULTS: dict[str, tuple[Callable[[list[Line]], list[Line]], str]] = {
    "no line": (lambda lines: lines[:-1], "planes.1: has pictures, but no line"),
    "a failure with pictures": (lambda lines: [*lines[:-1], {**lines[-1], "success": False}], "has pictures, but"),
    "a motion": (lambda lines: [*lines[:-1], {**lines[-1], "w": [0, 0, 0]}], "w: does not belong here"),
    "path for a problem": (lambda lines: [*lines, {"name": "../truth"}], "is no problem of"),
    "a unit of kilometres": (
        lambda lines: [{**lines[0], "png_unit_m": 1000.0}, *lines[1:]],
        "png_unit_m = 1000.0",
    ),
    "matches": (lambda lines: [{**lines[0], "uses": ["left"]}, *lines[1:]], "'left' is not given by depth-1"),
}


@pytest.mark.parametrize("case", [*DEPTH_FAULTS, *(f"frame: {name}" for name in FRAME_FAULTS)])
def test_faults_are_lines_and_nothing_is_kept(case: str, splits: dict[str, Split], tmp_path: Path) -> None:
    name = case.removeprefix("frame: ")
    split, faults = (splits["depth"], DEPTH_FAULTS) if name == case else (splits["correction"], FRAME_FAULTS)
    damage, words = faults[name]
    (tmp_path / "in").mkdir()
    path = write_truth(split, tmp_path / "in")
    damage(pictures_of(path)[0])
    before = files_below(tmp_path)
    told = check_submission(path, split).faults
    assert any(words in fault for fault in told), told
    assert all("\n" not in fault and len(fault) < 400 + 2 * len(str(path)) for fault in told)
    with pytest.raises(RsbenchError):
        add(tmp_path / "board", path, split, {})
    assert files_below(tmp_path) == before and not (tmp_path / "board").exists()


@pytest.mark.parametrize("case", ANSWER_FAULTS)
def test_faults_of_answers_are_lines(case: str, splits: dict[str, Split], tmp_path: Path) -> None:
    change, words = ANSWER_FAULTS[case]
    path = write_truth(splits["depth"], tmp_path)
    (fault,) = check_submission(write(path, change(lines_of(path))), splits["depth"]).faults
    assert words in fault


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
    product, wrong = RIG.camera.fx * RIG.baseline, np.zeros((80, 96))
    wrong[40:], wrong[:, 7] = 1.0, 1.0

    def change(z: np.ndarray) -> np.ndarray:
        z[40:] = product / (product / z[40:] + 1.5)
        z[:, 7] = 0.0
        return z

    scores = scores_of(split, _changed(write_truth(split, tmp_path), change))
    assert np.all(scores["bad_1_rows_1"] == 1 / 96) and np.all(scores["bad_1_rows_5"] == 1.0)
    for number, truth in enumerate(split.truths):
        parts = _by_hand(wrong, truth.shown.depth() > 0, truth.shown.rolling(), 0)
        for name in (*columns("bad_1", ROWS), *columns("bad_1", TEXTURE)):
            expected = parts.get(name.removeprefix("bad_1_"), [math.nan])
            assert scores[name][number] == pytest.approx(np.mean(expected), nan_ok=True)
        assert scores["bad_1"][number] == pytest.approx(wrong.mean())


def test_errors_of_frames_are_rooted_by_part(splits: dict[str, Split], tmp_path: Path) -> None:
    """Each pixel of both frames off by a level of its own; a part holds what either frame has of it."""
    split = splits["correction"]
    off = np.random.default_rng(1).integers(0, 3, (80, 96, 3))
    off[50:] *= 9
    path = _changed(write_truth(split, tmp_path), lambda frame: ((frame + off) % 256).astype(np.uint8))
    scores = scores_of(split, path)
    for number, truth in enumerate(split.truths):
        parts = dict[str, list[float]]()
        for each, common in zip(truth.shown.requested, truth.shown.commons(), strict=True):
            frame = truth.shown.frame(each.row)
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
