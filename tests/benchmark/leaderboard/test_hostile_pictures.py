"""Depth maps and corrected frames that are hostile or malformed do no harm."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from leaderboards import Line, files_below, lines_of, pictures_of, write

from rsbench.benchmark.leaderboard.board import add
from rsbench.benchmark.leaderboard.submissions import check_submission, write_truth
from rsbench.benchmark.leaderboard.track import Split
from rsbench.core.errors import RsbenchError
from rsbench.storage.files import write_depth, write_exr, write_png


def _png(
    width: int, height: int, bits: int, colour: int, body: bytes = b"", more: tuple[tuple[bytes, bytes], ...] = ()
) -> bytes:
    """``more``: chunks between the header and the pixels."""
    chunks = (
        (b"IHDR", _header(width, height, bits, colour)),
        *more,
        (b"IDAT", zlib.compress(body)),
        (b"IEND", b""),
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )


def _header(width: int, height: int, bits: int, colour: int) -> bytes:
    return struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)


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


def _circle(picture: Path) -> None:
    picture.unlink()
    picture.symlink_to(picture)


def _linked_folder(picture: Path) -> None:
    other = picture.parents[3] / "secret"
    picture.parent.rename(other)
    picture.parent.symlink_to(other)


def _pipe(picture: Path) -> None:
    picture.unlink()
    os.mkfifo(picture)


def _folder(picture: Path) -> None:
    picture.unlink()
    picture.mkdir()


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
    "a circle": (_circle, "must be a file of its own, no link"),
    "a pipe": (_pipe, "must be a file of its own"),
    "a folder": (_folder, "must be a file of its own"),
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
FRAME_FAULTS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "a JPEG": (lambda p: p.write_bytes(cv2.imencode(".jpg", np.ones((80, 96, 3)))[1].tobytes()), "is no PNG file"),
    "16 bits": (
        lambda p: cv2.imwrite(str(p), np.ones((80, 96, 3), np.uint16)),
        "is RGB of 16 bits: must be RGB or",
    ),
    "grey": (lambda p: cv2.imwrite(str(p), np.ones((80, 96), np.uint8)), "is grey of 8 bits: must be RGB or RGBA"),
    "a palette": (lambda p: p.write_bytes(_png(96, 80, 8, 3)), "is palette of 8 bits"),
    "no colour type": (lambda p: p.write_bytes(_png(96, 80, 8, 77)), "is unknown of 8 bits"),
    "another size": (lambda p: write_png(p, np.zeros((80, 95, 3), np.uint8)), "is 95 x 80 pixels"),
    "a huge image": (
        lambda p: p.write_bytes(_png(2**31 - 1, 2**31 - 1, 8, 2)),
        "is 2147483647 x 2147483647 pixels",
    ),
    # 64 million pixels pass Pillow's own limit.
    "a second header": (
        lambda p: p.write_bytes(_png(96, 80, 8, 2, more=((b"IHDR", _header(8000, 8000, 8, 2)),))),
        "its headers differ: 8000 x 8000 pixels",
    ),
    "a second kind": (
        lambda p: p.write_bytes(_png(96, 80, 8, 2, bytes(97 * 80), ((b"IHDR", _header(96, 80, 8, 0)),))),
        "is RGB of 8 bits, and holds something else",
    ),
    "a text that unfolds": (
        lambda p: p.write_bytes(_png(96, 80, 8, 2, more=((b"zTXt", b"x\0\0" + zlib.compress(bytes(1 << 22))),))),
        "is a damaged PNG file: Decompressed data too large",
    ),
    "a profile that unfolds": (
        lambda p: p.write_bytes(_png(96, 80, 8, 2, more=((b"iCCP", b"x\0\0" + zlib.compress(bytes(1 << 22))),))),
        "is a damaged PNG file: Decompressed data too large",
    ),
    "a film of huge pictures": (
        lambda p: p.write_bytes(
            _png(
                96,
                80,
                8,
                2,
                more=(
                    (b"acTL", struct.pack(">II", 2, 0)),
                    (b"fcTL", struct.pack(">IIIIIHHBB", 0, 60000, 60000, 0, 0, 1, 1, 0, 0)),
                ),
            )
        ),
        "is a damaged PNG file",
    ),
    "another check sum": (lambda p: p.write_bytes(p.read_bytes()[:29] + b"abcd" + p.read_bytes()[33:]), "damaged"),
    "no pixels": (lambda p: p.write_bytes(_png(96, 80, 8, 2)), "is a damaged PNG file"),
    "only a header": (lambda p: p.write_bytes(_png(96, 80, 8, 2)[:30]), "is no PNG file"),
    "nothing": (lambda p: p.write_bytes(b""), "is no PNG file"),
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
