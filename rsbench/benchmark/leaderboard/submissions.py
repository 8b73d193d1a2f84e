"""Submitted predictions: JSON lines with a header and an answer for each problem; a fault is reported in a line.

The file is not trusted: sizes are limited before decoding, names are looked up in the split and never used as
paths, and numbers must be finite. docs/how-to/submit.md describes the format.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from rsbench.benchmark.leaderboard.track import ORACLE, Answer, Header, Split, Submission
from rsbench.components.cards import choices, parse_card
from rsbench.core.errors import RsbenchError, naming
from rsbench.storage.files import write_bytes
from rsbench.storage.untrusted_files import MB, parse_json, read_text

SUBMISSION_BYTES = 16 * MB
"""Limit of the size of a file: 20 kB for each of 800 problems."""
_LINE_CHARACTERS = 1 << 16
_MOST_FAULTS = 50
_OF_SOLVE = (
    *("solver", "d_unit", "d_body", "motion_model", "shutter", "assumes", "inliers", "matches", "stereo_alone"),
    *("threshold_px", "iterations", "noise_px", "inlier_indices", "model_choice"),
)
"""Further keys of an answer of ``rsbench solve --json``, which are ignored if the track does not use them."""
_NAMED = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class Findings:
    """Result of checking a submission."""

    submission: Submission | None
    """None if there are faults."""
    faults: tuple[str, ...]
    """Messages of one line, with file, line, field, value and remedy."""
    notes: tuple[str, ...]
    """Likely mistakes; they do not prevent scoring."""


def read_submission(path: Path, split: Split) -> Submission:
    """Read a file of predictions.

    Raises:
        RsbenchError: the file has faults; the message has the first one, and the number of the others.
    """
    found = check_submission(path, split, hints=False)
    if found.submission is None:
        more = len(found.faults) - 1
        rest = f" (and {more} more: rsbench leaderboard check {path})" if more else ""
        raise RsbenchError(f"{found.faults[0]}{rest}")
    return found.submission


def check_submission(path: Path, split: Split, *, hints: bool = True) -> Findings:
    """Check a file of predictions; return at most ``_MOST_FAULTS`` faults and, with ``hints``, likely mistakes."""
    faults: list[str] = []
    header: Header | None = None
    answers: dict[str, Answer] = {}
    lines: dict[str, int] = {}
    try:
        for number, text in _lines(path):
            where = f"{path}:{number}"
            try:
                if header is None:
                    header = _header(text, where, split)
                    continue
                answer = _answer(text, where, split)
                if answer.name in answers:
                    first = lines[answer.name]
                    raise RsbenchError(f"{where}: name = {answer.name!r}: is that of line {first} too; keep one")
                answers[answer.name], lines[answer.name] = answer, number
            except RsbenchError as error:
                faults.append(str(error))
                if header is None or len(faults) == _MOST_FAULTS:
                    break
        if header is None and not faults:
            faults.append(f"{path}: is empty: the first line must be the header (rsbench leaderboard template)")
    except RsbenchError as error:
        faults.append(str(error))
    if header is None or faults:
        return Findings(submission=None, faults=tuple(faults), notes=())
    submission = Submission(header=header, answers=answers, folder=path.parent)
    beside, notes = split.track.check_files(submission, split, _MOST_FAULTS, hints)
    if beside:
        return Findings(submission=None, faults=tuple(beside), notes=())
    if hints:
        notes = [*_notes(submission, split, path), *notes]
    return Findings(submission=submission, faults=(), notes=tuple(notes))


def failure_reasons(path: Path) -> str:
    """Return the number of failures in a file and their most frequent reasons as text; empty without failures."""
    answers = [parse_json(text, f"{path}:{number}") for number, text in _lines(path)][1:]
    reasons = Counter(str(each.get("reason", "")) for each in answers if each.get("success") is False)
    if not reasons:
        return ""
    words = [f"{count} x {reason}" for reason, count in reasons.most_common(_NAMED)]
    return (
        f"{reasons.total()} of {len(answers)} failed: {'; '.join(words)}{'; ...' if len(reasons) > _NAMED else ''}"
    )


def protocol_of(path: Path) -> tuple[str, str]:
    """Return the protocol that the first line of a file names, and the place ``file:line``.

    Raises:
        RsbenchError: the file cannot be read, or its first line names no protocol.
    """
    number, text = next(_lines(path), (1, "{}"))
    data = parse_json(text, f"{path}:{number}")
    name = data.get("protocol")
    if not isinstance(name, str):
        raise RsbenchError(
            f"{path}:{number}: protocol = {name!r}: the first line is a header, which names it "
            "(rsbench leaderboard template)"
        )
    return name, f"{path}:{number}"


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    if path.exists() and not path.is_file():  # a folder, or a pipe, whose reading may never end
        raise RsbenchError(f"{path}: is no file: give the file of JSON lines")
    for number, line in enumerate(read_text(path, SUBMISSION_BYTES).split("\n"), start=1):
        if len(line) > _LINE_CHARACTERS:
            raise RsbenchError(
                f"{path}:{number}: has {len(line)} characters: a line has at most {_LINE_CHARACTERS}"
            )
        if line.strip():
            yield number, line


def _header(text: str, where: str, split: Split) -> Header:
    data = parse_json(text, where)
    if "method" not in data and "name" in data:
        raise RsbenchError(f"{where}: is an answer: the first line is the header (rsbench leaderboard template)")
    header = parse_card(Header, data, where)
    for field, is_now, must_be in (
        ("protocol", header.protocol, split.track.id),
        ("split", header.split, split.name),
    ):
        if is_now != must_be:
            raise RsbenchError(f"{where}: {field} = {is_now!r}: the truth at hand is that of {must_be!r}")
    with naming(where):
        split.track.check_uses(header.uses)
    if "links" in header.uses and not {"left", "right", "images"} & set(header.uses):
        raise RsbenchError(
            f"{where}: uses = 'links' without 'left' or 'right': links join matches of these; name the matches too"
        )
    return header


def _answer(text: str, where: str, split: Split) -> Answer:
    ignored = {*_OF_SOLVE} - {field.name for field in fields(split.track.answers)}
    data: dict[str, Any] = {key: value for key, value in parse_json(text, where).items() if key not in ignored}
    name = data.get("name")
    if isinstance(name, str) and name not in split.by_name:
        near = choices(name, split.by_name).partition("; there are")[0]
        raise RsbenchError(f"{where}: name = {json.dumps(name[:100])}: is no problem of {split.name}{near}")
    return parse_card(split.track.answers, data, where)


# Likely mistakes


def _notes(submission: Submission, split: Split, path: Path) -> Iterator[str]:
    missing = [truth.name for truth in split.truths if truth.name not in submission.answers]
    if missing:
        yield f"{path}: no answer for {len(missing)} of {_few(missing, len(split.truths))}: they count as failures"
    answers = [answer for answer in submission.answers.values() if answer.success and answer.w is not None]
    turns = [answer.name for answer in answers if answer.w is not None and math.hypot(*answer.w) > math.pi]
    if turns:
        yield (
            f"{path}: norm(w) is more than half a turn in {len(turns)} of {_few(turns, len(answers))}: w is in "
            "rad, not in degrees"
        )
    if split.public:
        yield from (f"{path}: {words}" for words in split.track.notes(answers, split))


def _few(names: list[str], total: int) -> str:
    return f"{total} ({', '.join(names[:_NAMED])}{', ...' if len(names) > _NAMED else ''})"


# Writing


def submission_text(header: Mapping[str, Any], answers: Iterable[Mapping[str, Any]]) -> str:
    """Return the header and answers as JSON lines, in the format of ``check_submission``."""
    return "".join(json.dumps(line, allow_nan=False) + "\n" for line in (header, *answers))


def method_header(split: Split, method: str, uses: Sequence[str], description: str) -> dict[str, Any]:
    """Return the header of predictions by rsbench."""
    return {
        "protocol": split.track.id,
        "split": split.name,
        "method": method,
        "uses": uses,
        "description": description[:300],
    }


def template_header(split: Split, method: str = "my-method") -> dict[str, Any]:
    """Return a header with all keys, for users to fill in."""
    return {
        "protocol": split.track.id,
        "split": split.name,
        "method": method,
        "uses": ["images" if split.track.pictures else "left"],
        **{key: "" for key in ("version", "authors", "paper", "code", "licence", "hardware", "tuned_on")},
    }


def write_template(split: Split, path: Path) -> None:
    """Write a valid example file: an answer to the first problem, and a failure for every other one."""
    first, *rest = (truth.name for truth in split.truths)
    failures = [{"name": name, "success": False, "reason": "not tried"} for name in rest]
    split.track.draw_example(split, path.parent)
    answers = [{"name": first, **split.track.example(split)}, *failures]
    write_bytes(path, submission_text(template_header(split), answers).encode())


def write_truth(split: Split, folder: Path, file: str = "predictions.jsonl") -> Path:
    """Write the ground truth as a submission, which gets the best scores; returns its file of answers."""
    folder.mkdir(parents=True, exist_ok=True)
    split.track.draw_truth(split, folder)
    write_bytes(folder / file, truth_text(split).encode())
    return folder / file


def truth_text(split: Split) -> str:
    """Return the content of a file of answers with the ground truth."""
    answers = ({"name": truth.name, **split.track.true_answer(truth)} for truth in split.truths)
    return submission_text(method_header(split, ORACLE, [ORACLE], "The truth itself"), answers)


def write_oracles(split: Split, folder: Path) -> Iterator[Path]:
    """Write the ground truth and the other oracles of the track; yields their files of answers."""
    yield write_truth(split, folder / ORACLE)
    for name, make in split.track.oracles:
        path = folder / name / "predictions.jsonl"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, make(split, path.parent).encode())
        yield path
