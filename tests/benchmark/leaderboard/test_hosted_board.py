"""A board in a git repository: handed in, hostile ones refused, scored, updated, published, opened again later."""

from __future__ import annotations

import io
import itertools
import os
import re
import runpy
import shutil
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest
import yaml
from commands import bytes_below
from leaderboards import erring, lines_of, named, truth_lines, write

from rsbench.benchmark.leaderboard.submissions import write_truth
from rsbench.benchmark.leaderboard.track import Split
from rsbench.benchmark.leaderboard.tracks import TRACKS

ROOT = Path(__file__).parents[3]
BOARD = ROOT / "examples" / "board"


REFUSED = "is no file of one folder submissions/METHOD"
PATHS: dict[str, tuple[bytes, str, str]] = {
    "script": (b"check.py", "100644", REFUSED),
    "workflow": (b".github/workflows/board.yml", "100644", REFUSED),
    "attributes": (b"submissions/mine/.gitattributes", "100644", REFUSED),
    "modules": (b".gitmodules", "100644", REFUSED),
    "keeper's word": (b"updates.txt", "100644", REFUSED),
    "page": (b"submissions/mine/evil.html", "100644", REFUSED),
    "page below": (b"submissions/mine/pictures/p000/a/evil.html", "100644", REFUSED),
    "another's": (b"submissions/theirs/pictures/p000/left_1.exr", "100644", "changes 2 entries"),
    "prefix": (b"submissions/mine.d/predictions.jsonl", "100644", "changes 2 entries"),
    "folder in other case": (b"Submissions/mine/predictions.jsonl", "100644", REFUSED),
    "entry in other case": (b"submissions/Theirs/predictions.jsonl", "100644", "changes 2 entries"),
    "full-width": ("submissions/\uff4dine/predictions.jsonl".encode(), "100644", REFUSED),
    "not UTF-8": (b"submissions/mine/\xff\xfe", "100644", REFUSED),
    "terminal": (b"submissions/mine/\x1b[31mred\x07", "100644", REFUSED),
    "command of the log": (b"submissions/mine/a\n::error::b", "100644", REFUSED),
    "text from right to left": ("submissions/mine/\u202etxt".encode(), "100644", REFUSED),
    "link": (b"submissions/mine/pictures/p000/left_1.exr", "120000", "mode 120000: must be a plain file"),
    "program": (b"submissions/mine/pictures/p000/left_1.exr", "100755", "mode 100755: must be a plain file"),
    "submodule": (b"submissions/mine/matches/left.csv", "160000", "mode 160000: must be a plain file"),
    "signature of a new one": (b"submissions/mine/update.sig", "100644", "is for a change of an entry that is"),
    "key": (b"submissions/mine/owner.pub", "100644", "owner.pub: must be one public key"),
}
"""A path beside an entry in order, its mode, and what is said of it."""
SECONDS = itertools.count(2_000_000_000)
"""Of commits, so that each is after the last."""
Files = dict[bytes, bytes | tuple[str, bytes] | None]


ME = {f"GIT_{who}_{what}": "a@b" for who in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")}


def run(*words: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, **ME, "PYTHONPATH": str(ROOT)}
    return subprocess.run(list(map(str, words)), cwd=cwd, capture_output=True, text=True, env=environment)


@pytest.fixture
def keeper(tmp_path: Path) -> Path:
    """The keeper's clone."""
    clone = Path(shutil.copytree(BOARD, tmp_path / "keeper"))
    assert run("git", "init", "-q", "-b", "main", cwd=clone).returncode == 0
    run("git", "add", "-A", cwd=clone)
    assert run("git", "commit", "-qm", "Open the board", cwd=clone).returncode == 0
    return clone


def put_answers(clone: Path, method: str) -> bytes:
    """Predictions of a method with errors beyond those of any doubt."""
    lines = named(truth_lines(TRACKS["points"].split(None)), method)
    (clone / "submissions" / method).mkdir(parents=True)
    path = clone / "submissions" / method / "predictions.jsonl"
    return write(path, [lines[0], *erring(lines[1:], 0.05, 0.05)]).read_bytes()


def git(clone: Path, *words: str, given: bytes = b"") -> str:
    me = ME | {"GIT_INDEX_FILE": str(clone / ".git" / "hostile"), "GIT_COMMITTER_DATE": f"{next(SECONDS)} +0000"}
    ran = subprocess.run(["git", *words], cwd=clone, input=given, capture_output=True, env=os.environ | me)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout.decode().strip()


def commit(clone: Path, start: str, change: Files, *parents: str) -> str:
    """A commit of a tree with some files changed, by paths of any bytes; None: removed. Nothing is checked out."""
    git(clone, "read-tree", start)
    for path, content in change.items():
        mode, data = content if isinstance(content, tuple) else ("100644" if content is not None else "0", content)
        blob = git(clone, "hash-object", "-w", "--stdin", given=data or b"")
        if mode == "160000":
            blob = git(clone, "rev-parse", start)
        line = f"{mode} {blob if mode != '0' else '0' * 40}\t".encode() + path
        git(clone, "update-index", "-z", "--index-info", given=line + b"\0")
    words = [word for parent in parents or (start,) for word in ("-p", parent)]
    return git(clone, "commit-tree", git(clone, "write-tree"), *words, "-m", "Hand in")


def push(keeper: Path, change: Files) -> str:
    """What the keeper puts on the board's branch."""
    made = commit(keeper, "main", change)
    run("git", "reset", "-q", "--hard", made, cwd=keeper)
    return made


def judge(keeper: Path, head: str, *options: object, base: str = "main") -> subprocess.CompletedProcess[str]:
    """Run check.py in this process, since importing rsbench takes longer than a judgement."""
    words, output, errors, code = ["check.py", base, head, *map(str, options)], io.StringIO(), io.StringIO(), 0
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(output), redirect_stderr(errors):
        patch.setattr(sys, "argv", words)
        patch.chdir(keeper)
        for name, value in (ME | {"PYTHONPATH": str(ROOT)}).items():
            patch.setenv(name, value)
        try:
            runpy.run_path("check.py", run_name="__main__")
        except SystemExit as stopped:
            code = int(stopped.code or 0)
    return subprocess.CompletedProcess(words, code, output.getvalue(), errors.getvalue())


def assert_refused(ran: subprocess.CompletedProcess[str], words: str) -> None:
    assert ran.returncode == 2 and words in ran.stderr, ran.stderr
    assert ran.stderr.startswith("refused: ") and ran.stderr.count("\n") == 1
    assert ran.stderr.isascii() and ran.stderr[:-1].isprintable() and not ran.stdout


MINE, THEIRS = b"submissions/mine/predictions.jsonl", b"submissions/theirs/predictions.jsonl"
REACHED = "not valid JSON"
"""What rsbench says of an entry that nothing speaks against but what these tests have for predictions."""


@pytest.fixture
def board(keeper: Path) -> Path:
    """With an entry of somebody else, which the keeper accepted."""
    push(keeper, {THEIRS: b"theirs", b"accepted.txt": b"theirs: a reason\n"})
    return keeper


@pytest.mark.parametrize("path", PATHS)
def test_only_what_a_track_asks_for_may_change(board: Path, path: str) -> None:
    name, mode, words = PATHS[path]
    assert_refused(judge(board, commit(board, "main", {MINE: b"mine", name: (mode, b"x")})), words)


def test_what_differs_in_case_alone_is_refused(board: Path) -> None:
    head = commit(board, "main", {b"submissions/Theirs/predictions.jsonl": b"mine"})
    assert_refused(judge(board, head), "submissions/Theirs: reads like submissions/theirs")
    head = commit(board, "main", {THEIRS: None, b"submissions/Theirs/predictions.jsonl": b"mine"})
    assert_refused(judge(board, head), "changes 2 entries")


def test_what_a_merge_makes_is_judged(board: Path) -> None:
    """Two merge bases: to one a request differs in its own entry alone, and its merge takes all else away."""
    opened, now = git(board, "rev-parse", "main~1"), git(board, "rev-parse", "main")
    first = commit(board, opened, {MINE: b"mine"})
    assert REACHED in judge(board, first).stderr, "an honest one from before is fine"
    assert run("git", "merge", "-q", "-m", "Take", first, cwd=board).returncode == 0
    crossed = commit(board, first, {MINE: b"mine, better"}, first, now)
    assert git(board, "diff", "--name-only", f"main...{crossed}").split() == [MINE.decode()]
    assert_refused(judge(board, crossed), "'accepted.txt': is no file of one folder")
    assert run("git", "merge", "-q", "-m", "Take", crossed, cwd=board).returncode == 0
    assert not (board / THEIRS.decode()).exists(), "git does what is refused"


def test_histories_that_hide_something_are_refused(board: Path) -> None:
    opened, now = git(board, "rev-parse", "main~1"), git(board, "rev-parse", "main")
    beside = commit(board, opened, {b"README": b"x"})
    octopus = commit(board, "main", {MINE: b"mine", b"README": b"x"}, now, opened, beside)
    assert_refused(judge(board, octopus), "'README': is no file")
    renamed = commit(board, "main", {THEIRS: None, MINE: b"theirs"})
    assert_refused(judge(board, renamed), "changes 2 entries (mine, theirs)")
    empty = git(board, "mktree", given=b"")
    orphan = git(board, "commit-tree", empty, "-m", "Start")
    assert_refused(judge(board, commit(board, orphan, {MINE: b"mine"})), "refusing to merge unrelated histories")
    assert_refused(judge(board, "main"), "changes 0 entries")
    assert_refused(judge(board, opened), "changes 0 entries")
    assert_refused(judge(board, commit(board, "main", {THEIRS: None})), "has no predictions.jsonl")
    assert_refused(judge(board, "--help"), "'--help': is no commit")
    accepted = commit(board, "main~1", {b"submissions/Theirs/predictions.jsonl": b"another"})
    push(board, {THEIRS: None})
    assert_refused(judge(board, accepted), "accepted.txt speaks of an entry of that name")
    push(board, {THEIRS: b"theirs"})
    clash = commit(board, opened, {THEIRS: b"another"})
    assert_refused(judge(board, clash), "conflicts with the board")


def tree_of(board: Path, *entries: tuple[str, str, str]) -> str:
    """A tree of modes, names and hashes as they stand, in any order and number."""
    data = b"".join(f"{mode} {name}".encode() + b"\0" + bytes.fromhex(blob) for mode, name, blob in entries)
    return git(board, "hash-object", "-t", "tree", "-w", "--literally", "--stdin", given=data)


def hand_in_tree(board: Path, entry: str) -> str:
    """A request whose new entry ``mine`` is a tree."""
    theirs = git(board, "rev-parse", "main:submissions/theirs")
    below = tree_of(board, ("40000", "mine", entry), ("40000", "theirs", theirs))
    lines = git(board, "ls-tree", "main").splitlines()
    lines = [f"040000 tree {below}\tsubmissions" if line.endswith("\tsubmissions") else line for line in lines]
    root = git(board, "mktree", given="".join(f"{line}\n" for line in lines).encode())
    return git(board, "commit-tree", root, "-p", "main", "-m", "Hand in")


WHOLE = ("100644", "predictions.jsonl", "blob")
TREES: dict[str, list[tuple[str, str, str]]] = {
    "doubled": [WHOLE, WHOLE],
    "empty folder": [("40000", "pictures", "empty"), WHOLE],
    "slash": [("100644", "pictures/p000/left_1.exr", "blob"), WHOLE],
    "mode": [("100664", "predictions.jsonl", "blob")],
    "no name": [("100644", "", "blob"), WHOLE],
    "above": [WHOLE, ("40000", "..", "folder")],
    "missing": [("100644", "predictions.jsonl", "missing")],
    "folder": [("100644", "predictions.jsonl", "folder")],
}


@pytest.mark.parametrize("tree", TREES)
def test_trees_that_git_does_not_make_are_refused(board: Path, tree: str) -> None:
    blob = git(board, "hash-object", "-w", "--stdin", given=b"mine")
    made = {"blob": blob, "missing": "1" * 40, "empty": tree_of(board)}
    made["folder"] = tree_of(board, ("100644", "f", blob))
    head = hand_in_tree(board, tree_of(board, *((mode, name, made[what]) for mode, name, what in TREES[tree])))
    assert_refused(judge(board, head), "refused: ")


def test_a_few_objects_that_name_any_number_of_files_are_not_listed(board: Path) -> None:
    blob = git(board, "hash-object", "-w", "--stdin", given=b"mine")
    names = [f"f{number:04d}" for number in range(2000)]
    wide = tree_of(board, *(("100644", name, blob) for name in names))
    wider = tree_of(board, *(("40000", name, wide) for name in names))  # four million paths
    entry = tree_of(board, ("40000", "pictures", wider), ("100644", "predictions.jsonl", blob))
    assert_refused(judge(board, hand_in_tree(board, entry)), "more than 10000 files")


def test_lines_that_two_people_changed_are_mixed_by_nobody(board: Path) -> None:
    """git merges them without a conflict into predictions that nobody made."""
    lines = [b"line %d\n" % number for number in range(20)]
    before = push(board, {THEIRS: b"".join(lines)})
    push(board, {THEIRS: b"".join([b"x\n", *lines[1:]])})
    head = commit(board, before, {THEIRS: b"".join([*lines[:-1], b"x\n"])})
    assert_refused(judge(board, head), "submissions/theirs: was changed by others too")


def test_what_is_too_large_is_not_read(board: Path) -> None:
    git(board, "config", "core.bigFileThreshold", "1m")  # as it is
    head = commit(board, "main", {MINE: b"0" * ((64 << 20) + 1)})
    assert_refused(judge(board, head), "67108865 bytes are too many")
    head = commit(board, "main", {MINE: b"", b"submissions/mine/owner.pub": b"0" * 5000})
    assert_refused(judge(board, head), "5000 bytes are too many")


def test_where_merges_are_not_known_nothing_is_judged(board: Path, tmp_path: Path) -> None:
    head = commit(board, "main", {MINE: b"mine"})
    run("git", "branch", "asked", head, cwd=board)
    run("git", "clone", "-q", "--depth", "1", "--no-single-branch", board.as_uri(), "shallow", cwd=tmp_path)
    assert_refused(judge(tmp_path / "shallow", head, base="origin/main"), "shallow")


@pytest.mark.skipif(os.name == "nt", reason="a stand-in for git is a script")
def test_an_old_git_is_named(board: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    head, real = commit(board, "main", {MINE: b"mine"}), shutil.which("git")
    old = tmp_path / "old" / "git"
    old.parent.mkdir()
    old.write_text(f'#!/bin/sh\ncase "$*" in *--write-tree*) exit 129;; esac\nexec {real} "$@"\n', "utf-8")
    old.chmod(0o755)
    monkeypatch.setenv("PATH", f"{old.parent}{os.pathsep}{os.environ['PATH']}")
    assert_refused(judge(board, head), "install git 2.38 or later")


# Entries that change


def test_without_a_key_the_keeper_alone_allows_an_update(board: Path) -> None:
    head = commit(board, "main", {THEIRS: b"worse"})
    ran = judge(board, head)
    assert_refused(ran, "it changes where the keeper adds to updates.txt")
    line = ran.stderr.strip().rpartition(": ")[2]
    assert line.split()[0] == "theirs"
    assert line.split()[1:] == [git(board, "rev-parse", f"{each}:submissions/theirs") for each in ("main", head)]
    assert_refused(judge(board, commit(board, head, {b"updates.txt": line.encode()})), "'updates.txt': is no file")
    push(board, {b"updates.txt": f"{line}\n".encode()})
    assert REACHED in judge(board, head).stderr
    assert_refused(judge(board, commit(board, head, {THEIRS: b"worst"})), "it changes where the keeper adds")
    unasked = commit(board, head, {b"submissions/theirs/update.sig": b"x"})
    assert_refused(judge(board, unasked), "it changes where the keeper adds")


def key(folder: Path, name: str) -> Path:
    words = ("-q", "-t", "ed25519", "-N", "", "-C", "a comment", "-f", name)
    assert run("ssh-keygen", *words, cwd=folder).returncode == 0
    return folder / name


def signed(clone: Path, head: str, secret: Path, line: str, namespace: str = "rsbench-board") -> str:
    """A request with the signature of a line below it."""
    words = ["ssh-keygen", "-q", "-Y", "sign", "-n", namespace, "-f", str(secret)]
    ran = subprocess.run(words, input=f"{line}\n".encode(), capture_output=True, check=True)
    return commit(clone, head, {f"submissions/{line.split()[0]}/update.sig".encode(): ran.stdout})


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("ssh-keygen") is None, reason="no OpenSSH")
def test_the_key_of_an_entry_signs_its_updates(board: Path, tmp_path: Path) -> None:
    mine, other = key(tmp_path, "mine"), key(tmp_path, "other")
    owner = {b"submissions/mine/owner.pub": mine.with_suffix(".pub").read_bytes()}
    first = commit(board, "main", {MINE: b"first", **owner})
    assert REACHED in judge(board, first).stderr
    push(board, {MINE: b"first", **owner})
    unsigned = commit(board, "main", {MINE: b"second"})
    ran = judge(board, unsigned)
    assert_refused(ran, "it changes where its owner's key signs")
    line = ran.stderr.strip().rpartition(": ")[2]
    second = signed(board, unsigned, mine, line)
    assert REACHED in judge(board, second).stderr
    cut, theirs = (
        commit(board, unsigned, {b"submissions/mine/owner.pub": public})
        for public in (owner.popitem()[1][:-4], other.with_suffix(".pub").read_bytes())
    )
    for wrong in (
        signed(board, unsigned, other, line),
        signed(board, unsigned, mine, line, namespace="git"),
        signed(board, unsigned, mine, line[:-1] + ("1" if line.endswith("0") else "0")),
        commit(board, second, {MINE: b"third"}),
        commit(board, unsigned, {b"submissions/mine/update.sig": b"no signature"}),
        signed(board, cut, mine, line),
        signed(board, theirs, other, line),
    ):
        assert_refused(judge(board, wrong), "update.sig: is not the signature by the key of owner.pub")
    # Merged; what was signed for that change serves for no other: not to come back, not to be done again.
    run("git", "reset", "-q", "--hard", second, cwd=board)
    back = commit(board, "main", {MINE: b"first"})
    assert_refused(judge(board, back), "update.sig: is not the signature")
    push(board, {MINE: b"third", b"submissions/mine/update.sig": None})
    again = commit(board, "main", {MINE: b"second"})
    assert_refused(judge(board, signed(board, again, mine, line)), "update.sig: is not the signature")
    # What the keeper accepted was the entry as it was then.
    line = judge(board, again).stderr.strip().rpartition(": ")[2]
    assert REACHED in judge(board, signed(board, again, mine, line)).stderr
    push(board, {b"accepted.txt": b"mine: a reason\n"})
    accepted = signed(board, again, mine, line)
    assert_refused(judge(board, accepted), "it changes where the keeper adds to updates.txt")
    push(board, {b"updates.txt": f"{line}\n".encode()})
    assert REACHED in judge(board, again).stderr


# With scores


@pytest.mark.slow
def test_what_rsbench_finds_is_one_plain_line(board: Path, tmp_path: Path) -> None:
    theirs = put_answers(tmp_path, "mine")
    elsewhere = commit(board, "main", {b"submissions/another/predictions.jsonl": theirs})
    words = "submissions/another: its header names 'mine'; folder and method must agree"
    assert_refused(judge(board, elsewhere), words)
    for path in (b"pictures/p000/evil.html", b"pictures/p000/left_1.exr", b"matches/left.csv"):
        head = commit(board, "main", {MINE: theirs, b"submissions/mine/" + path: b"x"})
        ran = judge(board, head)
        assert ran.returncode == 2 and f"{path.decode()}: is nothing that the track" in ran.stderr, ran.stderr
    for change, words in (
        (("mine", "rs-stereo-refined"), "is the name of a method of rsbench"),
        (("mine", "RS_Stereo-Ref1ned"), "or looks like it"),
        (('["left"]', '["truth"]'), "only oracles of rsbench know the truth"),
        (('"mine"', '"\uff4dine"'), "must be a folder's name"),
        (('"method"', '"\\u001b[31m\\u202e": 1, "method"'), "31m"),
        (("{", "[" * 60000), "not valid JSON"),
    ):
        head = commit(board, "main", {MINE: theirs.decode().replace(*change, 1).encode()})
        ran = judge(board, head)
        assert ran.returncode == 2 and words in ran.stderr, ran.stderr
        assert ran.stderr.count("\n") == 1 and ran.stderr[:-1].isprintable() and "Traceback" not in ran.stderr


@pytest.mark.slow
def test_pictures_that_a_track_asks_for_are_scored(
    board: Path, planes: Path, splits: dict[str, Split], tmp_path: Path
) -> None:
    path = write_truth(splits["depth"], tmp_path / "in")
    write(path, named(lines_of(path), "mine", ("images",)))
    below = bytes_below(tmp_path / "in").items()
    change: Files = {f"submissions/mine/{name}".encode(): data for name, data in below}
    ran = judge(board, commit(board, "main", change), "--data", planes)
    assert len(change) == 3 and ran.returncode == 0 and "mine" in ran.stdout, ran.stderr
    extra = commit(board, "main", {**change, b"submissions/mine/matches/left.csv": b"name"})
    assert_refused(judge(board, extra, "--data", planes), "matches/left.csv: is nothing that the track")


@pytest.mark.slow
def test_one_is_scored_published_and_there_when_the_board_is_opened_again(keeper: Path, tmp_path: Path) -> None:
    head = commit(keeper, "main", {MINE: put_answers(tmp_path, "mine")})
    ran = judge(keeper, head)
    assert ran.returncode == 0 and "mine" in ran.stdout, ran.stderr
    assert run("git", "merge", "-q", head, cwd=keeper).returncode == 0
    shouting: Files = {b"submissions/MINE/predictions.jsonl": put_answers(tmp_path / "shouting", "MINE")}
    assert_refused(judge(keeper, commit(keeper, "main", shouting)), "reads like submissions/mine")
    tables = []
    for later in (False, True):  # from what the repository holds alone, as after a year
        if later:  # a newer rsbench has a method of an entry's name, and no doubt that the keeper spoke of
            put_answers(keeper, "rs-stereo-refined")
            (keeper / "accepted.txt").write_text("mine: an oracle of ours\n", "utf-8")
        ran = run(sys.executable, "publish.py", tmp_path / "site", cwd=keeper)
        assert ran.returncode == 0, ran.stderr
        assert ran.stderr.count("left out: ") == 2 * later, ran.stderr
        (table,) = (tmp_path / "site").glob("points-1--*.csv")
        tables.append(table.read_bytes())
        assert "mine" in (tmp_path / "site" / "index.html").read_text("utf-8")
    assert tables[0] == tables[1]


def test_the_workflow_runs_the_scripts_of_the_board_and_gives_pull_requests_no_rights() -> None:
    """A request's own workflow runs on ``pull_request``; on ``pull_request_target`` that of the board does."""
    flow = yaml.safe_load((BOARD / ".github" / "workflows" / "board.yml").read_text("utf-8"))
    check, report, publish, deploy = (flow["jobs"][name] for name in ("check", "report", "publish", "deploy"))
    assert set(flow[True]) == {"push", "pull_request_target"}
    assert all(each["branches"] == ["main"] for each in flow[True].values())
    assert flow["permissions"] == {"contents": "read"}
    assert "permissions" not in check and "permissions" not in publish, "what reads data can write nothing"
    assert report["permissions"] == {"statuses": "write"} and report["needs"] == "check"
    for step in (*report["steps"], *deploy["steps"]):
        assert "checkout" not in step.get("uses", "") and not re.search("python|git ", step.get("run", ""))
    (checkout,) = (step for step in check["steps"] if "checkout" in step.get("uses", ""))
    assert checkout["with"] == {"ref": "main", "fetch-depth": 0, "persist-credentials": False}
    scripts = [step["run"] for job in (check, report, publish) for step in job["steps"] if "run" in step]
    assert not any("${{" in script or re.search("checkout|switch|merge|worktree", script) for script in scripts)
    assert "secrets" not in str(flow)
    for word in ("check.py", "publish.py"):
        assert (BOARD / word).is_file() and any(word in script for script in scripts)
