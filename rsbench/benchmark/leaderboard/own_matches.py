"""Matches that a method found itself, handed in beside its motions: how many there are, and how many are right.

They lie in ``matches/left.csv`` and the like beside the file of answers, with the columns of the given matches
that ``export pose`` writes. The true place of a match is where the other frame sees the surface at its first end,
by the true depth, which between pixels is that of one plane, and the true motion, each end at its own row's time.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from rsbench.benchmark.leaderboard.picture_files import check_own
from rsbench.benchmark.leaderboard.splits import Truth
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import View
from rsbench.core.so3 import FloatArray
from rsbench.dataset.match_truth import arranged, looks, seen_near
from rsbench.dataset.matches import MATCHED
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import FAR
from rsbench.pipeline.problem import COLUMNS
from rsbench.storage.files import read_table
from rsbench.vision.undistortion import between_pixels

FOLDER = "matches"
"""Beside the file of answers."""
RIGHT_PX = 1.0
"""A right match ends so near to the truth."""
FILES = tuple(f"{key}.csv" for key in COLUMNS)
_LARGEST = 1e6
"""px: no image is so large."""


def match_files(beside: Path) -> list[str]:
    """Names of the files of matches beside a file of answers.

    Raises:
        RsbenchError: something else lies in the folder ``matches``, or a link.
    """
    folder = beside / FOLDER
    if not os.path.lexists(folder):
        return []
    found = sorted(os.listdir(folder)) if folder.is_dir() else []
    for name in found:
        if name not in FILES:
            raise RsbenchError(f"{folder / name}: is not asked; there are: {', '.join(FILES)}")
        check_own(beside, f"{FOLDER}/{name}")
    if not found:
        raise RsbenchError(f"{folder}: must be a folder with some of {', '.join(FILES)}, no link")
    return found


def read_own_matches(beside: Path, problems: Mapping[str, Truth]) -> dict[str, Correspondences] | None:
    """Matches by the name of the problem; None where there is no folder of them.

    Raises:
        RsbenchError: see ``match_files``; a file is no such table, names no problem, or has more matches of one
            than its images have pixels.
    """
    names = match_files(beside)
    tables = {name.removesuffix(".csv"): _table(beside / FOLDER / name, problems) for name in names}
    if not tables:
        return None
    found: dict[str, dict[str, FloatArray]] = {problem: {} for problem in problems}
    for key, table in tables.items():
        for problem, rows in table.groupby("name", sort=False):
            camera = problems[str(problem)].rig.camera
            if len(rows) > (most := camera.width * camera.height):
                raise RsbenchError(
                    f"{beside / FOLDER / key}.csv: {len(rows)} matches of {problem}: more than pixels, {most}"
                )
            found[str(problem)][key] = rows[COLUMNS[key].split(", ")].to_numpy(dtype=np.float64)
    return {problem: Correspondences(**sets) for problem, sets in found.items()}


def _table(path: Path, problems: Mapping[str, Truth]) -> pd.DataFrame:
    columns = COLUMNS[path.stem].split(", ")
    table = read_table(path, ("name",), columns, dtype={"name": str}, keep_default_na=False, na_values=["nan"])
    if others := sorted({*map(str, table.columns)} - {"name", *columns}):
        raise RsbenchError(
            f"{path}: the column {others[0][:100]!r} is not asked; there are: name, {', '.join(columns)}"
        )
    for name in table["name"].unique():
        if name not in problems:
            raise RsbenchError(f"{path}: name = {str(name)[:100]!r}: is no problem of the split")
    wrong = ~np.all(np.abs(table[columns].to_numpy(dtype=np.float64)) < _LARGEST, axis=1)
    if np.any(wrong):
        raise RsbenchError(f"{path}:{int(np.argmax(wrong)) + 2}: must hold finite pixels below {_LARGEST:g}")
    return table


def match_scores(sequence: Sequence, matches: Correspondences | None) -> dict[str, float]:
    """Of the matches of one problem, each counted once: their number, and the share that is right.

    NaN where the method hands in none at all; of a problem without matches nothing is right.
    """
    if matches is None:
        return {"matches": math.nan, "matches_1px": math.nan}
    found = arranged(matches)
    errors = [
        match_errors(sequence, views, np.unique(found.pixels[found.sets == number].reshape(-1, 4), axis=0))
        for number, views in enumerate(MATCHED.values())
    ]
    right = np.concatenate(errors) <= RIGHT_PX
    return {"matches": float(len(right)), "matches_1px": float(np.mean(right)) if len(right) else 0.0}


def match_errors(sequence: Sequence, views: tuple[View, View], rows: FloatArray) -> FloatArray:
    """Distances (n,), px, of the second ends of matches (n, 4) from their true places; infinite without one.

    What has no surface is infinitely far.
    """
    source, target = views
    disparity = np.nan_to_num(sequence.rig.disparity(sequence.depth("rs", *source))).astype(np.float32)
    there = between_pixels(disparity, rows[:, :2]).astype(np.float64)
    far = np.where(there > 0.0, sequence.rig.depth(np.where(there > 0.0, there, 1.0)), FAR)
    eyes, ahead = looks(sequence, source, rows[:, :2])
    truth, _, _ = seen_near(sequence, target, eyes + far[:, None] * (ahead - eyes), rows[:, 2:])
    error = np.linalg.norm(rows[:, 2:] - truth, axis=1)
    return np.where(np.isfinite(error) & np.isfinite(there), error, np.inf)
