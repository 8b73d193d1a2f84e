"""Inputs for any language: CSV, npz and JSON of the same problems, and the truth of a public split.

The files contain everything that a method may use; docs/how-to/submit.md describes them.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.images.store import read_record
from rsbench.benchmark.leaderboard.pictures import VIEW
from rsbench.benchmark.leaderboard.submissions import write_truth
from rsbench.benchmark.leaderboard.track import Split, Track
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, VIEWS
from rsbench.dataset.layout import picture_file
from rsbench.pipeline.frame_depth import Images
from rsbench.pipeline.problem import COLUMNS, Problem, parse_problem, problem_record
from rsbench.storage.files import read_png, save_arrays, write_bytes, write_json
from rsbench.storage.untrusted_files import inside, parse_json, read_bytes, read_text
from rsbench.storage.work_folder import HIDDEN, named

RIG = ("width", "height", "fx", "fy", "cx", "cy", "baseline", "readout_ratio")
"""Columns of problems.csv after the name."""
OF_ANY_RIG = ("baseline", "readout_ratio")
"""Columns for rigs whose cameras differ or are rotated, which problems.jsonl describes."""


def check_place(split: Split, out: Path) -> None:
    """Raise RsbenchError if a folder contains anything but inputs of this split, or its secret truth."""
    others = [path.name for path in out.iterdir() if path.name != HIDDEN] if out.is_dir() else []
    record = (read_record(out / "split.json") or {}) if others else split_record(split)
    reveals = not split.public and "truth.jsonl" in others
    if record.get("fingerprint") != split.fingerprint or reveals:
        raise RsbenchError(
            f"{out}: holds {named(sorted(others))}, not the inputs of {split.name} alone; choose another folder"
        )


def write_inputs(split: Split, problems: Iterable[Problem], out: Path) -> None:
    """Write the problems of a split into a folder, and its truth if that is public.

    Raises:
        RsbenchError: a file cannot be written.
    """
    given = list(problems)
    out.mkdir(parents=True, exist_ok=True)
    columns = RIG if all(problem.rig.aligned for problem in given) else OF_ANY_RIG
    columns = columns if split.track.gives_readout else columns[:-1]
    records = [_record(problem, split.track) for problem in given]
    write_bytes(out / "problems.jsonl", "".join(json.dumps(each) + "\n" for each in records).encode())
    write_bytes(out / "problems.csv", _csv(("name", *columns), ((p.name, *_rig(p, columns)) for p in given)))
    write_matches(given, out)
    save_arrays(out / "problems.npz", _arrays(given, columns))
    if split.track.at_rows:
        # Each requested picture, the row to whose time it is corrected, and this time.
        rows = (
            (truth.name, each.stem, each.row, float(truth.shutter.time_after(each.row, VIEW[1], VIEW[0])))
            for truth in split.truths
            for each in truth.shown.requested
        )
        write_bytes(out / "pictures.csv", _csv(("name", "picture", "row", "time"), rows))
    if split.public:
        write_truth(split, out, "truth.jsonl")
    write_json(out / "split.json", split_record(split))


def write_matches(problems: Sequence[Problem], out: Path) -> None:
    """Write ``left.csv`` and similar files, whose rows begin with the name of the problem; an empty set has no
    file.

    Raises:
        RsbenchError: a file cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    for key, names in COLUMNS.items():
        rows = [(p.name, *row) for p in problems for row in getattr(p.correspondences, key).tolist()]
        if rows:
            write_bytes(out / f"{key}.csv", _csv(("name", *names.split(", ")), rows))


def split_record(split: Split) -> dict[str, Any]:
    """Return the properties of a split that are published before anything is scored."""
    return {
        "protocol": split.track.id,
        "split": split.name,
        "fingerprint": split.fingerprint,
        "problems": len(split.truths),
        "given": split.track.given,
        "allowed": list(split.track.allowed),
    }


def _record(problem: Problem, track: Track) -> dict[str, Any]:
    record = problem_record(problem)
    if not track.gives_readout:
        del record["readout_ratio"]
    samples = problem.correspondences.gyro
    return {**record, "gyro": samples.tolist()} if "gyro" in track.allowed and len(samples) > 0 else record


def _rig(problem: Problem, columns: Sequence[str]) -> tuple[float, ...]:
    known = {"baseline": problem.rig.baseline, "readout_ratio": problem.shutter.readout_ratio}
    return tuple(known[key] if key in known else getattr(problem.rig.camera, key) for key in columns)


def _csv(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> bytes:
    """Return the content of a CSV file, with all digits of the numbers."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue().encode()


def _arrays(problems: list[Problem], columns: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return ``names`` (n,), ``rig`` (n, k columns) and, for each set of matches, its rows (m, 4 or 8) and
    ``<set>_problem`` (m,), the index of the problem of each row."""
    arrays: dict[str, NDArray[Any]] = {
        "names": np.array([problem.name for problem in problems]),
        "rig": np.array([_rig(problem, columns) for problem in problems]),
    }
    for key in COLUMNS:
        sets = [getattr(problem.correspondences, key) for problem in problems]
        arrays[key] = np.concatenate(sets)
        arrays[f"{key}_problem"] = np.repeat(np.arange(len(sets)), [len(each) for each in sets])
    return arrays


# Frames, and inputs of runs


def write_frames(split: Split, out: Path) -> None:
    """Copy the rolling-shutter frames, as ``frames/<problem>/left_0.png`` to ``right_1.png``.

    Raises:
        RsbenchError: a frame is missing, differs from that of the split, or cannot be written.
    """
    for truth in split.truths:
        if truth.pictures is not None:
            truth.pictures.check()
    for truth in split.truths:
        sequence, folder = truth.rendered, out / "frames" / truth.name
        folder.mkdir(parents=True, exist_ok=True)
        for side, frame in VIEWS:
            sequence.image("rs", side, frame)  # raises an error if the frame is damaged
            path = inside(sequence.folder, picture_file("rs", side, frame + sequence.first))
            write_bytes(folder / f"{side}_{frame}.png", read_bytes(path))


def read_frames(inputs: Path, problem: Problem) -> Images:
    """Read the frames of a problem that ``write_frames`` wrote.

    Raises:
        RsbenchError: a frame is missing, or is not an image of its camera's size.
    """
    folder = inputs / "frames" / problem.name
    sizes = {side: (camera.width, camera.height) for side in SIDES for camera in [problem.rig.sensor(side)]}
    return {view: read_png(folder / f"{view[0]}_{view[1]}.png", sizes[view[0]]) for view in VIEWS}


def prepare_inputs(split: Split, data: Path | None, seed_file: Path | None, folder: Path) -> None:
    """Export a split into a folder without its truth, unless the folder has the split already.

    Args:
        split: the problems.
        data, seed_file: as in ``Track.split``.
        folder: created if missing.

    Raises:
        RsbenchError: see ``write_frames`` and ``write_inputs``.
    """
    stored = read_record(folder / "split.json")
    if stored is None or stored.get("fingerprint") != split.fingerprint:
        if data is not None and split.track.gives_images:
            write_frames(split, folder)
        problems = split.track.problems(data, seed_file, len(split.truths))
        write_inputs(replace(split, public=False), problems, folder)


def read_inputs(inputs: Path, track: Track) -> list[Problem]:
    """Read the exported problems; on tracks that do not give the readout ratio, it is set to 0.

    Raises:
        RsbenchError: the file is missing or damaged.
    """
    path = inputs / "problems.jsonl"
    unknown: dict[str, float] = {} if track.gives_readout else {"readout_ratio": 0.0}
    found = list[Problem]()
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        where = f"{path}:{number}"
        text = json.dumps(parse_json(line, where) | unknown) if unknown else line
        found.append(parse_problem(text, where))
    return found
