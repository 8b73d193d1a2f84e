"""A board in a git repository: handed in, a hostile one refused, scored, published, opened again later."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from leaderboards import Line, named, truth_lines, write

from rsbench.benchmark.leaderboard.splits import points_split
from rsbench.benchmark.leaderboard.track_list import TRACKS

ROOT = Path(__file__).parents[3]
BOARD = ROOT / "examples" / "board"


def run(*words: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    me = {f"GIT_{who}_{what}": "a@b" for who in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")}
    return subprocess.run(
        [str(word) for word in words],
        cwd=cwd,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **me, "PYTHONPATH": str(ROOT)},
    )


@pytest.fixture
def keeper(tmp_path: Path) -> Path:
    """The keeper's clone of a bare repository."""
    bare, clone = tmp_path / "bare.git", tmp_path / "keeper"
    assert run("git", "init", "-q", "--bare", "-b", "main", bare, cwd=tmp_path).returncode == 0
    assert run("git", "clone", "-q", bare, clone, cwd=tmp_path).returncode == 0
    shutil.copytree(BOARD, clone, dirs_exist_ok=True)
    run("git", "checkout", "-q", "-b", "main", cwd=clone)
    run("git", "add", "-A", cwd=clone)
    run("git", "commit", "-qm", "Open the board", cwd=clone)
    assert run("git", "push", "-q", "origin", "main", cwd=clone).returncode == 0
    return clone


def hand_in(tmp_path: Path, branch: str, change: Callable[[Path], object]) -> None:
    """A stranger's clone, a branch, a push: the pull request."""
    clone = tmp_path / branch
    run("git", "clone", "-q", tmp_path / "bare.git", clone, cwd=tmp_path)
    run("git", "checkout", "-q", "-b", branch, cwd=clone)
    change(clone)
    run("git", "add", "-A", cwd=clone)
    run("git", "commit", "-qm", "Hand in", cwd=clone)
    assert run("git", "push", "-q", "origin", branch, cwd=clone).returncode == 0


def answers(method: str) -> Callable[[Path], object]:
    lines: list[Line] = named(truth_lines(points_split(TRACKS["points"])), method)
    rough = [lines[0], *({**line, "w": [line["w"][0] + 0.01, *line["w"][1:]]} for line in lines[1:])]

    def change(clone: Path) -> None:
        (clone / "submissions" / method).mkdir(parents=True)
        write(clone / "submissions" / method / "predictions.jsonl", rough)

    return change


def link(clone: Path) -> None:
    (clone / "submissions" / "mine").mkdir(parents=True)
    (clone / "submissions" / "mine" / "predictions.jsonl").symlink_to("/etc/passwd")


def another_name(clone: Path) -> None:
    answers("mine")(clone)
    (clone / "submissions" / "mine").rename(clone / "submissions" / "theirs")


HOSTILE: dict[str, tuple[Callable[[Path], object], str]] = {
    "script": (
        lambda clone: (clone / "check.py").write_text("print('fine')"),
        "'check.py': only submissions/METHOD",
    ),
    "link": (link, "must be a plain file; no link, submodule or executable"),
    "name": (another_name, "its header names 'mine'; folder and method must agree"),
    "ours": (answers("rs-stereo-refined"), "is the name of a method of rsbench"),
}


@pytest.mark.slow
def test_hostile_ones_are_refused(keeper: Path, tmp_path: Path) -> None:
    for branch, (change, words) in HOSTILE.items():
        hand_in(tmp_path, branch, change)
        run("git", "fetch", "-q", "origin", branch, cwd=keeper)
        ran = run(sys.executable, "check.py", "main", "FETCH_HEAD", cwd=keeper)
        assert ran.returncode != 0 and words in ran.stderr and ran.stderr.count("\n") == 1, (branch, ran.stderr)


@pytest.mark.slow
def test_one_is_scored_published_and_there_when_the_board_is_opened_again(keeper: Path, tmp_path: Path) -> None:
    hand_in(tmp_path, "mine", answers("mine"))
    run("git", "fetch", "-q", "origin", "mine", cwd=keeper)
    ran = run(sys.executable, "check.py", "main", "FETCH_HEAD", cwd=keeper)
    assert ran.returncode == 0 and "mine" in ran.stdout, ran.stderr
    assert run("git", "merge", "-q", "FETCH_HEAD", cwd=keeper).returncode == 0
    assert run("git", "push", "-q", "origin", "main", cwd=keeper).returncode == 0
    hand_in(tmp_path, "shouting", answers("MINE"))
    run("git", "fetch", "-q", "origin", "shouting", cwd=keeper)
    ran = run(sys.executable, "check.py", "main", "FETCH_HEAD", cwd=keeper)
    assert ran.returncode != 0 and "reads like submissions/mine, which is there" in ran.stderr
    tables = []
    for later in (False, True):  # from what the repository holds alone, as after a year
        if later:  # a newer rsbench has a method of an entry's name, and no doubt that the keeper spoke of
            answers("rs-stereo-refined")(keeper)
            (keeper / "accepted.txt").write_text("mine: an oracle of ours\n", "utf-8")
        ran = run(sys.executable, "publish.py", tmp_path / "site", cwd=keeper)
        assert ran.returncode == 0, ran.stderr
        assert ran.stderr.count("left out: ") == 2 * later, ran.stderr
        (table,) = (tmp_path / "site").glob("points-1--*.csv")
        tables.append(table.read_bytes())
        assert "mine" in (tmp_path / "site" / "index.html").read_text("utf-8")
    assert tables[0] == tables[1]


def test_the_workflow_runs_the_scripts_of_the_board_and_gives_pull_requests_no_rights() -> None:
    flow = yaml.safe_load((BOARD / ".github" / "workflows" / "board.yml").read_text("utf-8"))
    steps = flow["jobs"]["check"]["steps"]
    assert flow["permissions"] == {"contents": "read"} and "permissions" not in flow["jobs"]["check"]
    assert "pull_request_target" not in flow[True]
    assert "base.sha" in steps[0]["with"]["ref"] and steps[0]["with"]["persist-credentials"] is False
    for word in ("check.py", "publish.py"):
        assert (BOARD / word).is_file() and word in str(flow["jobs"])
