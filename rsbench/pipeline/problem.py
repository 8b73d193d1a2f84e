"""One problem in a JSON file, for people with correspondences of their own, and its answer."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rsbench.cards import parse_card
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences, track_pairs
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.errors import RsbenchError
from rsbench.pipeline.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.engine.registry import SolverEntry

_COLUMNS = {
    "left": "x0, y0, x1, y1",
    "right": "x0, y0, x1, y1",
    "stereo_0": "xl, yl, xr, yr",
    "stereo_1": "xl, yl, xr, yr",
    "tracks": "xl0, yl0, xr0, yr0, xl1, yl1, xr1, yr1",
}
_Rows = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """What a solver is given."""

    correspondences: Correspondences
    rig: StereoRig
    shutter: RollingShutter


@dataclass(frozen=True, kw_only=True)
class _Content:
    camera: PinholeCamera
    baseline: float
    readout_ratio: float
    left: _Rows
    right: _Rows
    stereo_0: _Rows = ()
    stereo_1: _Rows = ()
    tracks: _Rows = ()


def read_problem(path: str | Path) -> Problem:
    """Problem in a JSON file (format: ``parse_problem``).

    Raises:
        RsbenchError: the file cannot be read or is wrong.
    """
    try:
        text = Path(path).read_bytes().decode("utf-8")
    except OSError as error:
        raise RsbenchError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise RsbenchError(
            f"{path}: not valid JSON: not UTF-8 text ({error.reason} at byte {error.start})"
        ) from error
    return parse_problem(text, str(path))


def parse_problem(text: str, where: str) -> Problem:
    """Problem from JSON text.

    ``{"camera": {"width", "height", "fx", "fy", "cx", "cy"}, "baseline", "readout_ratio", "left", "right"}``, and
    where there are any ``"stereo_0", "stereo_1", "tracks"``; matches are lists of numbers in pixels. Left matches
    whose two ends both have a left-right match at exactly the same left pixel become tracks.

    Args:
        text: JSON.
        where: file name, for messages.

    Raises:
        RsbenchError: one line with the file, the field, the value and what is allowed.
    """
    try:
        data = json.loads(text)  # reads NaN, which parse_card refuses with the field's name
    except json.JSONDecodeError as error:
        raise RsbenchError(
            f"{where}: not valid JSON: {error.msg} at line {error.lineno} column {error.colno}"
        ) from error
    except RecursionError as error:
        raise RsbenchError(f"{where}: not valid JSON: nested too deeply") from error
    if not isinstance(data, dict):
        raise RsbenchError(f"{where}: must be a JSON object with camera, baseline, ..., got {type(data).__name__}")
    content = parse_card(_Content, data, where)
    for name, columns in _COLUMNS.items():
        _check_widths(getattr(content, name), name, columns, where)
    try:
        rig = StereoRig(camera=content.camera, baseline=content.baseline)
        shutter = RollingShutter(height=content.camera.height, readout_ratio=content.readout_ratio)
    except ValueError as error:
        raise RsbenchError(f"{where}: {error}") from error
    matches = {name: np.array(getattr(content, name), dtype=np.float64) for name in _COLUMNS}
    return Problem(correspondences=link_tracks(Correspondences(**matches)), rig=rig, shutter=shutter)


def _check_widths(rows: _Rows, name: str, columns: str, where: str) -> None:
    width = columns.count(",") + 1
    for k, row in enumerate(rows):
        if len(row) != width:
            raise RsbenchError(f"{where}: {name}[{k}] = {list(row)}: must be {width} numbers in pixels: {columns}")


def link_tracks(correspondences: Correspondences) -> Correspondences:
    """Join left matches with the left-right matches of both frames at exactly the same pixels into tracks."""
    ends = []
    for stereo in (correspondences.stereo_0, correspondences.stereo_1):
        ends.append({(row[0], row[1]): row[2:] for row in stereo})
    known = {row.tobytes() for row in track_pairs(correspondences.tracks, "left")}
    found: list[FloatArray] = []
    for row in correspondences.left:
        right0, right1 = ends[0].get((row[0], row[1])), ends[1].get((row[2], row[3]))
        if right0 is not None and right1 is not None and row.tobytes() not in known:
            found.append(np.concatenate([row[:2], right0, row[2:], right1]))
    if not found:
        return correspondences
    return Correspondences(
        left=correspondences.left,
        right=correspondences.right,
        stereo_0=correspondences.stereo_0,
        stereo_1=correspondences.stereo_1,
        tracks=np.concatenate([correspondences.tracks, np.array(found)]),
    )


def solve_problem(problem: Problem, entry: SolverEntry, options: RobustOptions, seed: int = 0) -> dict[str, Any]:
    """Answer to a problem, ready for JSON; a failure has ``w`` and ``d`` null and the reason."""
    solver = entry.solver
    result = estimate_motion(
        problem.correspondences, problem.rig, problem.shutter, solver, options, np.random.default_rng(seed)
    )
    estimate = result.estimate
    counts: dict[str, int] = {}
    for side in SIDES:
        if not solver.spec.needs & {side, "tracks"}:
            counts[side] = 0
            continue
        own = getattr(problem.correspondences, side)[result.inliers[side]]
        halves = track_pairs(problem.correspondences.tracks, side)[result.inliers["tracks"]]
        counts[side] = len({row.tobytes() for row in np.concatenate([own, halves])})
    return {
        "solver": entry.name,
        "success": estimate.success,
        "reason": estimate.reason,
        "w": estimate.w.tolist() if estimate.success else None,
        "d": estimate.d.tolist() if estimate.success else None,
        "metric": estimate.metric,
        "inliers_left": counts["left"],
        "inliers_right": counts["right"],
        "seconds": result.seconds,
    }
