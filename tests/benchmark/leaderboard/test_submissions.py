"""Files of predictions: what is told of slips, and that nothing hostile does more than cost one line."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from leaderboards import Line, named, small_split, truth_lines, write

from rsbench.benchmark.leaderboard.motion_tracks import motion_row
from rsbench.benchmark.leaderboard.submissions import check_submission, read_submission, write_template
from rsbench.benchmark.leaderboard.track import Split
from rsbench.components.cards import parse_card
from rsbench.core.errors import RsbenchError

SPLIT = small_split()
TRUTH = truth_lines(SPLIT)
HEAD, FIRST = TRUTH[0], TRUTH[1]


def _changed(**changes: object) -> list[Line]:
    return [HEAD, {**FIRST, **changes}, *TRUTH[2:]]


def _header(**changes: object) -> list[Line]:
    return [{**HEAD, **changes}, *TRUTH[1:]]


def _text(lines: list[Line]) -> str:
    return "".join(json.dumps(line) + "\n" for line in lines)


FAULTS: dict[str, tuple[str, str]] = {
    "empty": ("", "is empty"),
    "blank lines": ("\n\n\n", "is empty"),
    "not JSON": ("hello\n", ":1: not valid JSON"),
    "a list": ("[]\n", ":1: must hold a JSON object"),
    "a number of thousands of digits": ("1" * 5000 + "\n", "not valid JSON"),
    "deep JSON": (_text(TRUTH[:1]) + "[" * 60_000 + "\n", ":2: not valid JSON: nested too deeply"),
    "deep values": (_text(TRUTH[:1]) + '{"name": ' + "[" * 99 + "]" * 99 + "}\n", ":2: name.0.0...: nested"),
    "a long line": (_text(TRUTH[:1]) + " " * 70_000 + "{}\n", ":2: has 70002 characters"),
    "no header": (_text(TRUTH[1:]), ":1: is an answer"),
    "two headers": (_text([HEAD, *TRUTH]), ":2: unknown key"),
    "another split": (_text(_header(split="dev-00000000")), "split = 'dev-00000000': the truth at hand"),
    "another protocol": (_text(_header(protocol="pose-1")), "protocol = 'pose-1'"),
    "no protocol": (_text(_header(protocol="points-9")), "'points-9'"),
    "unknown key of the header": (_text(_header(autors="me")), "unknown key 'autors' (did you mean 'authors'?)"),
    "path for a name": (_text(_header(method="../../etc/passwd")), "method = '../../etc/passwd'"),
    "absolute name": (_text(_header(method="/etc/passwd")), "method = '/etc/passwd'"),
    "HTML for a name": (_text(_header(method="<script>alert(1)</script>")), "method = "),
    "formula for a name": (_text(_header(method="=cmd|'/c calc'!A0")), "method = "),
    "hidden folder": (_text(_header(method=".rsbench")), "method = '.rsbench'"),
    "zero byte": (_text(_header(method="a\0b")), "method = "),
    "no name": (_text(_header(method="")), "method = ''"),
    "two lines in a text": (_text(_header(authors="a\nb")), "authors: must be one line"),
    "terminal codes": (_text(_header(authors="\x1b[2J")), "authors: must be one line"),
    "turned text": (_text(_header(paper="\u202egnp.exe")), "paper: must be one line"),
    "a novel": (_text(_header(paper="x" * 301)), "paper: must be one line of at most 300"),
    "uses nothing": (_text(_header(uses=[])), "uses: must name"),
    "uses a gyro": (_text(_header(uses=["gyro"])), "'gyro' is not given by points-1"),
    "uses magic": (_text(_header(uses=["magic"])), "'magic' is unknown"),
    "unknown problem": (_text(_changed(name="p01")), 'name = "p01": is no problem'),
    "path for a problem": (_text(_changed(name="../p000")), ':2: name = "../p000"'),
    "no problem": (_text([HEAD, {"w": [0, 0, 0], "d": [0, 0, 1]}]), ":2: 'name' is required"),
    "number for a problem": (_text(_changed(name=7)), ":2: name = 7"),
    "the same problem twice": (_text([*TRUTH, FIRST]), ":14: name = 'p000': is that of line 2 too"),
    "what overflows": (_text(_changed(d=[0.0, 1e300, 0.0])), ":2: d: numbers must lie within 1e+09 of 0"),
    "a denormal direction": (
        _text(_changed(d=[5e-324, 0.0, 0.0])),
        ":2: d: has length 4.94066e-324: must be 0, or",
    ),
    "a direction too short": (_text(_changed(d=[0.0, 9e-10, 0.0])), ":2: d: has length 9e-10: must be 0, or"),
    "a direction too long": (_text(_changed(d=[9e8, 9e8, 0.0])), ":2: d: has length 1.27279e+09: must be 0, or"),
    "NaN": (_text(_changed(w=[float("nan"), 0.0, 0.0])), ":2: w.0 = nan: numbers must be finite"),
    "infinity": (_text(_changed(d=[0.0, float("inf"), 0.0])), ":2: d.1 = inf"),
    "beyond infinity": (_text(TRUTH[:1]) + '{"name": "p000", "w": [0, 0, 1e999], "d": [0, 0, 1]}\n', "w.2 = inf"),
    "two numbers": (_text(_changed(w=[0.0, 0.0])), ":2: 'w.2' is required"),
    "a matrix": (_text(_changed(w=np.eye(3).tolist())), ":2: w"),
    "texts for numbers": (_text(_changed(w=["0", "0", "0"])), ":2: w.0 = '0'"),
    "no motion": (_text(_changed(w=None)), ":2: w: a success needs three numbers"),
    "another point": (_text(_changed(reference_point="right")), ":2: reference_point = 'right'"),
    "negative time": (_text(_changed(seconds=-1.0)), ":2: seconds = -1.0"),
    "small covariance": (_text(_changed(covariance=[[1.0]])), ":2: covariance: must be 6 x 6"),
    "half a covariance": (_text(_changed(covariance=np.triu(np.ones((6, 6))).tolist())), "must be symmetric"),
    "two names": (_text(TRUTH[:1]) + '{"name": "p000", "name": "p001"}\n', ":2: not valid JSON: the key 'name'"),
    "two methods": (_text(TRUTH).replace("{", '{"method": "mine", ', 1), ":1: not valid JSON: the key 'method'"),
    "uses it twice": (_text(_header(uses=["left"] * 6000)), "uses: names something twice"),
    "a device": (_text(_header(method="nul.txt")), "method = 'nul.txt': cannot be a folder's name on Windows"),
    "a dot at the end": (_text(_header(method="mine.")), "method = 'mine.': cannot be"),
    "a number beyond all": (_text(TRUTH[:1]) + '{"name": "p000", "seconds": 1' + "0" * 400 + "}\n", ":2: seconds"),
    "half a character": (_text(_header(authors="\ud800")), ":1: "),
    "truth values": (_text(_changed(w=[True, False, True])), ":2: w.0 = True"),
    "unknown key": (_text(_changed(omega=[0, 0, 0])), ":2: unknown key 'omega'"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_faults_are_lines_that_name_the_place(case: str, tmp_path: Path) -> None:
    text, words = FAULTS[case]
    path = tmp_path / "mine.jsonl"
    path.write_text(text, "utf-8")
    found = check_submission(path, SPLIT)
    assert found.submission is None
    assert any(words in fault and str(path) in fault for fault in found.faults), found.faults
    with pytest.raises(RsbenchError, match=r"mine\.jsonl"):
        read_submission(path, SPLIT)


@settings(max_examples=30, deadline=None)
@given(st.floats(-9.0, 9.0), st.sampled_from(["left", "body"]), st.integers(0, 9))
def test_the_length_of_a_direction_changes_no_score(exponent: float, point: str, number: int) -> None:
    random = np.random.default_rng(number)
    direction = random.normal(size=3)
    direction /= np.linalg.norm(direction) * (1.0 + 1e-12)  # within the limits at both ends
    answer = {"name": FIRST["name"], "w": FIRST["w"], "reference_point": point}
    rows = [
        motion_row(
            SPLIT.truths[0], parse_card(SPLIT.track.answers, {**answer, "d": (length * direction).tolist()}, "")
        )
        for length in (1.0, max(10.0**exponent, 1e-9 * (1.0 + 1e-9)))
    ]
    # The product itself rounds, by 1e-16 of 180 deg.
    assert rows[0] == pytest.approx(rows[1], abs=1e-12, nan_ok=True)


def _huge(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 30)


def _loop(path: Path) -> None:
    path.symlink_to(path)


SPECIAL: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (lambda path: None, "cannot be read"),
    "a folder": (lambda path: path.mkdir(), "is no file"),
    "1 GB": (_huge, "bytes: 1073741824 is more than"),
    "a circle of links": (_loop, "cannot be read"),
    "other bytes": (lambda path: path.write_bytes(b"\xff\xfe{}"), "not UTF-8"),
    "a zip file": (lambda path: path.write_bytes(b"PK\x03\x04\x14\x00\x00\x00"), "not valid JSON"),
}


@pytest.mark.parametrize("case", SPECIAL)
def test_what_is_no_text_is_one_line(case: str, tmp_path: Path) -> None:
    make, words = SPECIAL[case]
    path = tmp_path / "mine.jsonl"
    make(path)
    (fault,) = check_submission(path, SPLIT).faults
    assert words in fault and "\n" not in fault


def test_every_fault_is_told(tmp_path: Path) -> None:
    lines = [HEAD, {**TRUTH[1], "w": None}, {**TRUTH[2], "name": "q"}, {**TRUTH[3], "d": [1]}, *TRUTH[4:]]
    found = check_submission(write(tmp_path / "mine.jsonl", lines), SPLIT)
    assert [fault.partition(": ")[0].rpartition(":")[2] for fault in found.faults] == ["2", "3", "4"]


def test_the_template_and_the_truth_are_in_order(tmp_path: Path) -> None:
    path = tmp_path / "template.jsonl"
    write_template(SPLIT, path)
    for file in (path, write(tmp_path / "truth.jsonl", TRUTH)):
        found = check_submission(file, SPLIT)
        assert (found.faults, found.notes) == ((), ()) and found.submission is not None
        assert set(found.submission.answers) == set(SPLIT.by_name)


def test_missing_answers_are_told(tmp_path: Path) -> None:
    (note,) = check_submission(write(tmp_path / "mine.jsonl", TRUTH[:-2]), SPLIT).notes
    assert "no answer for 2 of 12 (p010, p011)" in note


@pytest.mark.parametrize(
    ("slip", "words"),
    [
        (lambda w, d: (-w, d), "w is inverted"),
        (lambda w, d: (w, -d), "d is inverted"),
        (lambda w, d: (np.rad2deg(w), d), "degrees"),
        (lambda w, d: (w * [-1, 1, -1], d * [1, -1, 1]), "left-handed"),
        (lambda w, d: (w * [1, -1, -1], d * [1, -1, -1]), "y up and z backward"),
        (lambda w, d: (-w[[1, 0, 2]], d[[1, 0, 2]]), "the paper's axes"),
    ],
)
def test_slips_of_convention_are_told(
    slip: Callable[..., tuple[np.ndarray, ...]], words: str, tmp_path: Path
) -> None:
    changed = [slip(np.array(line["w"]), np.array(line["d"])) for line in TRUTH[1:]]
    lines = [{**line, "w": w.tolist(), "d": d.tolist()} for line, (w, d) in zip(TRUTH[1:], changed, strict=True)]
    found = check_submission(write(tmp_path / "mine.jsonl", named([HEAD, *lines], "slip")), SPLIT)
    assert not found.faults
    assert any(words in note for note in found.notes), found.notes


def test_a_secret_truth_is_not_asked(tmp_path: Path) -> None:
    """A check that compares with a secret truth would tell it."""
    secret = Split(track=SPLIT.track, label=SPLIT.label, public=False, truths=SPLIT.truths)
    inverted = [HEAD, *({**line, "w": [-x for x in line["w"]]} for line in TRUTH[1:])]
    assert check_submission(write(tmp_path / "mine.jsonl", inverted), secret).notes == ()
    degrees = [HEAD, *({**line, "w": [1000.0 * x for x in line["w"]]} for line in TRUTH[1:])]
    (note,) = check_submission(write(tmp_path / "mine.jsonl", degrees), secret).notes
    assert "not in degrees" in note


def test_answers_of_solve_may_be_handed_in(tmp_path: Path) -> None:
    extra = {"solver": "x", "d_unit": "m", "d_body": None, "inliers": 9, "matches": 10, "stereo_alone": 0}
    path = write(tmp_path / "mine.jsonl", [HEAD, *({**line, **extra} for line in TRUTH[1:])])
    assert check_submission(path, SPLIT).faults == ()


def test_a_pipe_cannot_hang(tmp_path: Path) -> None:
    if not hasattr(os, "mkfifo"):
        pytest.skip("no pipes here")
    os.mkfifo(path := tmp_path / "mine.jsonl")
    (fault,) = check_submission(path, SPLIT).faults
    assert "is no file" in fault
