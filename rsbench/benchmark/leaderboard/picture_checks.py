"""What is wrong with pictures that were handed in, and what may be meant by them: scored is what stands there."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.leaderboard.picture_files import read_answer_depth, read_answer_frame, strange_files
from rsbench.benchmark.leaderboard.splits import Split, Truth
from rsbench.core.errors import RsbenchError
from rsbench.core.so3 import FloatArray

_NEAR = 0.1
"""Relative error of depth below which another reading is near to the truth."""
_RIGHT = 0.01
"""One that is so near as it stands needs no other reading."""
_SMALLER = 0.25
"""Another reading's error must be below this part of that of what stands there: of depth; of frames, squared."""
_FAR_M = 300.0
"""Median depth that is hardly one in metres."""


def check_pictures(
    folder: Path, answered: list[str], png_unit_m: float | None, split: Split, most: int, hints: bool
) -> tuple[list[str], list[str]]:
    """Faults of the pictures of answers, ``most`` at most, and notes; each picture is read once.

    Args:
        folder: the folder ``pictures``.
        answered: names of the problems that have an answer.
        png_unit_m: as of the header.
        split: of the answers; a secret truth is not looked at.
        most: faults that are told.
        hints: whether notes are wanted, which take longer than reading.
    """
    faults, found = list(islice(strange_files(folder, split, answered), most)), Counter[str]()
    for name in answered:
        if len(faults) >= most:
            break
        truth = split.by_name[name]
        try:
            found.update(_hints(folder, truth, png_unit_m, split, hints))
        except RsbenchError as error:
            faults.append(str(error))
    notes = [
        f"{folder}: {count} of {len(answered)} answers look like something else: {words}"
        for words, count in found.items()
        if 2 * count > len(answered)
    ]
    return faults, notes


def _hints(folder: Path, truth: Truth, png_unit_m: float | None, split: Split, wanted: bool) -> set[str]:
    """Reads the pictures of an answer, which may raise, and says what they look like."""
    assert truth.pictures is not None
    if split.protocol.asks == "depth":
        depth = read_answer_depth(folder, truth, png_unit_m)
        if not wanted:
            return set()
        if split.public:
            return set(_depth_readings(depth, truth))
        far = np.any(depth > 0.0) and np.median(depth[depth > 0.0]) > _FAR_M
        return {f"half of it is above {_FAR_M:g} m: metres are asked, not millimetres"} if far else set()
    found: set[str] = set()
    for each in truth.pictures.asked:
        image, _ = read_answer_frame(folder, truth, each)
        if wanted and split.public:
            others = {k.stem: truth.pictures.frame(k.row) for k in truth.pictures.asked if k != each}
            found |= set(_frame_readings(image, truth.pictures.frame(each.row), others))
    return found


def _depth_readings(depth: NDArray[np.float32], truth: Truth) -> Iterator[str]:
    assert truth.pictures is not None
    sequence = truth.pictures.sequence
    rig, true = sequence.rig, truth.pictures.depth()
    along = np.linalg.norm(rig.camera.unproject(rig.camera.pixel_grid()), axis=-1)
    both = (depth > 0.0) & (true > 0.0)
    if not np.any(both):
        return
    given, z, product = depth[both].astype(np.float64), true[both].astype(np.float64), rig.camera.fx * rig.baseline
    stands = _error(given, z)
    if stands < _RIGHT:
        return
    readings: dict[str, Callable[[], FloatArray]] = {
        "it is in millimetres; metres are asked": lambda: given / 1000.0,
        "it is in centimetres; metres are asked": lambda: given / 100.0,
        "it is disparity in px; depth is fx * baseline / disparity": lambda: product / given,
        "it is inverse depth, 1 / m; depth is asked": lambda: 1.0 / given,
        "it is the distance along the ray; z of the camera is asked": lambda: given / along[both],
    }
    for words, reading in readings.items():
        if _error(reading(), z) < min(_NEAR, _SMALLER * stands):
            yield words
            return
    before = sequence.depth("rs", "left", 0)
    there = (depth > 0.0) & (before > 0.0)
    if _error(depth[there].astype(np.float64), before[there].astype(np.float64)) < _SMALLER * stands:
        yield "it is that of frame 0; frame 1 is asked"
    elif _error(given * np.median(z / given), z) < min(_NEAR, _SMALLER * stands):
        yield "it is right up to a factor; metres are asked"


def _error(depth: FloatArray, truth: FloatArray) -> float:
    """Median relative error."""
    return float(np.median(np.abs(depth - truth) / truth)) if truth.size else np.inf


def _frame_readings(
    image: NDArray[np.uint8], truth: NDArray[np.uint8], others: dict[str, NDArray[np.uint8]]
) -> Iterator[str]:
    limit = _SMALLER * _squared(image, truth)
    readings: dict[str, NDArray[Any]] = {
        "red and blue are swapped; PNG files hold RGB": image[..., ::-1],
        "it is upside down": image[::-1],
        "it is mirrored": image[:, ::-1],
        "it stands a row too low": np.roll(image, -1, axis=0),
        "it stands a row too high": np.roll(image, 1, axis=0),
        "it stands a column too far right": np.roll(image, -1, axis=1),
        "it stands a column too far left": np.roll(image, 1, axis=1),
    }
    for words, reading in readings.items():
        if _squared(reading, truth) < limit:
            yield words
            return
    for stem, other in others.items():
        if _squared(image, other) < limit:
            yield f"it is nearer to the truth of {stem}: the rows are exchanged"


def _squared(image: NDArray[Any], truth: NDArray[np.uint8]) -> float:
    """Mean squared difference of the pixels that are not black, but for the rim, which a shift brings in."""
    counted = np.any(image > 0, axis=-1)
    counted[[0, -1]] = counted[:, [0, -1]] = False
    difference = image[counted].astype(np.float32) - truth[counted]
    return float(np.mean(difference * difference)) if difference.size else np.inf
