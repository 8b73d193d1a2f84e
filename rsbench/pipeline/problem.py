"""Read and write problem files, which have a user's own correspondences; format:
docs/reference/problem-format.md."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from rsbench.components.cards import choices, parse_card, shipped_folder
from rsbench.components.rig_tables import RightFromLeft, camera_record, tables_of
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.shutter import RollingShutter, Scanning, StatedShutter
from rsbench.storage.untrusted_files import (
    FILE_BYTES,
    check_amount,
    load_arrays,
    open_regular,
    parse_json,
    read_text,
)

COLUMNS = {
    "left": "x0, y0, x1, y1",
    "right": "x0, y0, x1, y1",
    "stereo_0": "xl, yl, xr, yr",
    "stereo_1": "xl, yl, xr, yr",
    "tracks": "xl0, yl0, xr0, yr0, xl1, yl1, xr1, yr1",
}
_CAMERA = ("width", "height", "fx", "fy", "cx", "cy")
_LINES = (".jsonl", ".ndjson")
_PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".mp4", ".mov", ".mkv", ".avi")
_BESIDE = {
    "affine": "dx1/dx0, dx1/dy0, dy1/dx0, dy1/dy0",
    "gyro": "tau, wx, wy, wz",
    "gravity": "tau, gx, gy, gz",
    "lines": ", ".join(f"{xy}{image}{end}" for image in ("l0", "r0", "l1", "r1") for end in "ab" for xy in "xy"),
}
"""Columns of sets that few solvers need, and that only JSON files can have."""
SUFFIXES = (".json", *_LINES, ".npz")
EXAMPLE = shipped_folder("examples", "_docs/examples") / "problem.json"
"""A small problem that is installed with the package."""
_Rows = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """The input of a solver: correspondences, rig and shutter."""

    name: str
    correspondences: Correspondences
    """Correspondences as in the file, without joining left-right matches to tracks."""
    rig: StereoRig
    known_shutter: RollingShutter | None
    """None: the readout ratio is estimated with the motion."""
    scanning: Scanning | None = None
    """The given scan if the readout ratio is not given; None: it is estimated too."""

    @property
    def shutter(self) -> RollingShutter:
        """The given shutter; RsbenchError if there is none."""
        if self.known_shutter is None:
            raise RsbenchError(f"{self.name}: readout_ratio is required")
        return self.known_shutter


@dataclass(frozen=True, kw_only=True)
class _Cameras:
    left: PinholeCamera
    right: PinholeCamera


@dataclass(frozen=True, kw_only=True)
class _Content(StatedShutter):
    camera: PinholeCamera | None = None
    baseline: float | None = None
    cameras: _Cameras | None = None
    """Format 2, for any rig: ``cameras`` and ``right_from_left`` in place of ``camera`` and ``baseline``."""
    right_from_left: RightFromLeft | None = None
    name: str = ""
    left: _Rows = ()
    right: _Rows = ()
    stereo_0: _Rows = ()
    stereo_1: _Rows = ()
    tracks: _Rows = ()
    affine: _Rows = ()
    gyro: _Rows = ()
    gravity: _Rows = ()
    lines: _Rows = ()


def read_problems(source: str | Path, stdin: TextIO) -> Iterator[Problem | RsbenchError]:
    """Yield the problems of a file, of all files in a folder, or of ``stdin`` for ``-``.

    For a wrong problem, an error is yielded, and reading goes on; the error names the file and, if the file has
    several problems, the line.
    """
    if str(source) == "-":
        try:
            yield from _parsed(stdin, "stdin", "stdin", lines=None)
        except UnicodeDecodeError:
            yield RsbenchError("stdin: not UTF-8 text")
        return
    path = Path(source)
    if not path.is_dir():
        yield from _read_file(path)
        return
    files = sorted(file for file in path.iterdir() if file.suffix in SUFFIXES)
    if not files:
        yield RsbenchError(f"{path}: holds no problem: no file ends in {', '.join(SUFFIXES)}")
    for file in files:
        yield from _read_file(file)


def read_problem(path: str | Path) -> Problem:
    """Read a file with one problem.

    Raises:
        RsbenchError: the file cannot be read, is wrong, or does not have exactly one problem.
    """
    problems = list(_read_file(Path(path)))
    if len(problems) != 1:
        raise RsbenchError(f"{path}: has {len(problems)} problems, not one")
    if isinstance(problems[0], RsbenchError):
        raise problems[0]
    return problems[0]


def problem_record(problem: Problem) -> dict[str, Any]:
    """The JSON content of a problem, for ``parse_problem``; empty sets are left out, but not all."""
    sets = {key: getattr(problem.correspondences, key).tolist() for key in COLUMNS}
    return {
        "name": problem.name,
        **_rig_record(problem.rig),
        **_shutter_record(problem),
        **({key: rows for key, rows in sets.items() if rows} or {"left": []}),
    }


def _rig_record(rig: StereoRig) -> dict[str, Any]:
    if rig.aligned:
        return {"camera": camera_record(rig.camera), "baseline": rig.baseline}
    tables = tables_of(rig)
    return {"cameras": {side: tables.pop(side) for side in SIDES}, **tables}


def _shutter_record(problem: Problem) -> dict[str, Any]:
    shutter, scanning = problem.known_shutter, problem.scanning
    if shutter is None:
        return {} if scanning is None else scanning.record
    return {"readout_ratio": shutter.readout_ratio, **({} if shutter.plain else shutter.scanning.record)}


def _read_file(path: Path) -> Iterator[Problem | RsbenchError]:
    try:
        if path.suffix.lower() in _PICTURES:
            raise RsbenchError(
                f"{path}: is an image or a video, but matches are needed: use rsbench correct, or rsbench inspect "
                "with --rig for four images"
            )
        if path.suffix == ".npz":
            yield _from_npz(path)
            return
        if path.suffix not in _LINES:
            yield _attempt(read_text(path), str(path), path.stem)
            return
        with io.TextIOWrapper(open_regular(path), encoding="utf-8-sig") as file:
            yield from _parsed(file, str(path), path.stem, lines=True)
    except OSError as error:
        yield RsbenchError(f"{path}: cannot be read: {error.strerror}")
    except UnicodeDecodeError:
        yield RsbenchError(f"{path}: not UTF-8 text")
    except RsbenchError as error:
        yield error


def _parsed(file: TextIO, where: str, name: str, lines: bool | None) -> Iterator[Problem | RsbenchError]:
    """Parse one problem, or one per line; with None, one per line if the first line is a complete JSON object."""
    first = ""
    if lines is None:
        first = next((line for line in _lines(file, where) if line.strip()), "")
        lines = _is_object(first)
    if not lines:
        rest = file.read(FILE_BYTES + 1)
        check_amount(where, "characters", len(rest), FILE_BYTES)
        yield _attempt(first + rest, where, name)
        return
    number = 1 if first else 0
    if first:
        yield _attempt(first, f"{where}:1", f"{name}:1")
    for line in _lines(file, where):
        number += 1
        if line.strip():
            yield _attempt(line, f"{where}:{number}", f"{name}:{number}")


def _lines(file: TextIO, where: str) -> Iterator[str]:
    while line := file.readline(FILE_BYTES + 1):
        check_amount(where, "characters of a line", len(line), FILE_BYTES)
        yield line


def _is_object(line: str) -> bool:
    try:
        return isinstance(json.loads(line), dict)
    except (ValueError, RecursionError):
        return False


def _attempt(text: str, where: str, name: str) -> Problem | RsbenchError:
    try:
        return parse_problem(text, where, name)
    except RsbenchError as error:
        return error


def parse_problem(text: str, where: str, name: str = "") -> Problem:
    """Parse a problem in JSON.

    Args:
        text: JSON.
        where: file name, for messages.
        name: name of the problem if the text gives none.

    Raises:
        RsbenchError: one line with the file, the field, the value and what is allowed.
    """
    data = parse_json(text, where)  # accepts NaN, which parse_card refuses with the field's name
    content = parse_card(_Content, data, where)
    _check_sets(data, where)
    given = COLUMNS | _BESIDE
    for key, columns in given.items():
        _check_widths(getattr(content, key), key, columns, where)
    sets = {key: getattr(content, key) for key in given}
    return _problem(_rig_of(content, where), content, sets, content.name or name or where, where)


_IDEAL, _ANY = ("camera", "baseline"), ("cameras", "right_from_left")


def _rig_of(content: _Content, where: str) -> StereoRig:
    given = [key for key in (*_IDEAL, *_ANY) if getattr(content, key) is not None]
    form = _ANY if given and given[-1] in _ANY else _IDEAL
    for key in given:
        if key not in form:
            raise RsbenchError(f"{where}: {key} and {form[0]} exclude each other: {form[0]} goes with {form[1]}")
    for key in form:
        if key not in given:
            other = "" if given else f"; or {_ANY[0]} and {_ANY[1]} of a rig whose cameras differ"
            raise RsbenchError(f"{where}: {key!r} is required{other}")
    try:
        if content.cameras is not None and content.right_from_left is not None:
            pose = content.right_from_left
            return StereoRig.of_cameras(content.cameras.left, content.cameras.right, pose.R, pose.translation)
        assert content.camera is not None and content.baseline is not None
        return StereoRig(camera=content.camera, baseline=content.baseline)
    except ValueError as error:
        raise RsbenchError(f"{where}: {'right_from_left: ' if form is _ANY else ''}{error}") from error


def _check_sets(data: Mapping[str, Any], where: str) -> None:
    """Refuse a file without any set of matches; empty sets are allowed and give a problem without an answer."""
    if not any(key in data for key in COLUMNS):
        raise RsbenchError(f"{where}: no matches: at least one of {', '.join(COLUMNS)} is required")


def _check_widths(rows: _Rows, name: str, columns: str, where: str) -> None:
    width, unit = columns.count(",") + 1, " in pixels" if name in (*COLUMNS, "lines") else ""
    for k, row in enumerate(rows):
        if len(row) != width:
            raise RsbenchError(f"{where}: {name}[{k}] = {list(row)}: must be {width} numbers{unit}: {columns}")


def _problem(
    rig: StereoRig,
    stated: StatedShutter,
    sets: Mapping[str, Any],
    name: str,
    where: str,
) -> Problem:
    scanning, ratio, right = stated.scanning, stated.readout_ratio, stated.right_readout_ratio
    if ratio is None and right is not None:
        raise RsbenchError(f"{where}: right_readout_ratio = {right}: needs readout_ratio, that of the left camera")
    try:
        known = rig.shutter_of(scanning or Scanning(), ratio or 0.0)
        matches = Correspondences(**{key: np.array(rows, dtype=np.float64) for key, rows in sets.items()})
    except ValueError as error:
        raise RsbenchError(f"{where}: {error}") from error
    shutter = None if ratio is None else known
    return Problem(name=name, correspondences=matches, rig=rig, known_shutter=shutter, scanning=scanning)


def _from_npz(path: Path) -> Problem:
    """Read a problem from arrays: ``camera`` (6,) is width, height, fx, fy, cx, cy; other keys are as in JSON."""
    arrays = load_arrays(path)
    known = ("camera", "baseline", "readout_ratio", "name", *COLUMNS)
    for key in arrays:
        if key not in known:
            raise RsbenchError(f"{path}: unknown key {key!r}{choices(key, known)}")
    for key in known[:2]:
        if key not in arrays:
            raise RsbenchError(f"{path}: {key!r} is required")
    _check_sets(arrays, str(path))
    for key, array in arrays.items():
        if array.dtype.kind not in ("U" if key == "name" else "fiu"):
            raise RsbenchError(f"{path}: {key}: must be {'a text' if key == 'name' else 'numbers'}")
    size = arrays["camera"]
    if size.shape != (6,) or np.any(size[:2] != np.round(size[:2])):
        raise RsbenchError(f"{path}: camera = {size.tolist()}: must be {', '.join(_CAMERA)}, the first two whole")
    for key in ("baseline", "readout_ratio"):
        if key in arrays and arrays[key].size != 1:
            raise RsbenchError(f"{path}: {key} has shape {arrays[key].shape}: must be one number")
    width, height, *rest = size.tolist()
    values = {"width": int(width), "height": int(height), **dict(zip(_CAMERA[2:], rest, strict=True))}
    try:
        camera = parse_card(PinholeCamera, values, f"{path}: camera")
        rig = StereoRig(camera=camera, baseline=float(arrays["baseline"].item()))
    except ValueError as error:
        raise RsbenchError(f"{path}: {error}") from error
    sets = {key: arrays[key] for key in COLUMNS if key in arrays}
    ratio = float(arrays["readout_ratio"].item()) if "readout_ratio" in arrays else None
    name = str(arrays["name"]) if "name" in arrays else path.stem
    return _problem(rig, StatedShutter(readout_ratio=ratio), sets, name, str(path))
