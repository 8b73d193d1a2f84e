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


def run(*words: object, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    me = {f"GIT_{who}_{what}": "a@b" for who in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")}
    return subprocess.run(
        [str(word) for word in words],
        cwd=cwd,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **me, "PYTHONPATH": str(ROOT), **environment},
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


def answers(method: str, size: float = 0.05, **changes: object) -> Callable[[Path], object]:
    lines: list[Line] = named(truth_lines(points_split(TRACKS["points"])), method)
    rough = [
        {**lines[0], **changes},
        *({**line, "w": [x + size for x in line["w"]], "d": [x + size for x in line["d"]]} for line in lines[1:]),
    ]

    def change(clone: Path) -> None:
        (clone / "submissions" / method).mkdir(parents=True, exist_ok=True)
        write(clone / "submissions" / method / "predictions.jsonl", rough)

    return change


def link(clone: Path) -> None:
    (clone / "submissions" / "mine").mkdir(parents=True)
    (clone / "submissions" / "mine" / "predictions.jsonl").symlink_to("/etc/passwd")


def another_name(clone: Path) -> None:
    answers("mine")(clone)
    (clone / "submissions" / "mine").rename(clone / "submissions" / "theirs")


def besides(path: str, text: str = "a", mode: int = 0o644) -> Callable[[Path], object]:
    """An entry in order, and a file that is not."""

    def change(clone: Path) -> None:
        answers("mine")(clone)
        file = os.path.join(os.fsencode(clone), path.encode("utf-8", "surrogateescape"))
        os.makedirs(os.path.dirname(file), exist_ok=True)
        Path(os.fsdecode(file)).write_text(text)
        os.chmod(file, mode)

    return change


def submodule(clone: Path) -> None:
    answers("mine")(clone)
    (clone / "submissions" / "mine" / "matches" / "left.csv").mkdir(parents=True)
    of = run("git", "rev-parse", "HEAD", cwd=clone).stdout.strip()
    run("git", "update-index", "--add", "--cacheinfo", f"160000,{of},submissions/mine/matches/left.csv", cwd=clone)


ONLY, ASKED = "only submissions/METHOD", "is not asked by its track"
HOSTILE: dict[str, tuple[Callable[[Path], object], str]] = {
    "script": (
        lambda clone: (clone / "check.py").write_text("print('fine')"),
        "'check.py': only submissions/METHOD",
    ),
    "link": (link, "must be a plain file; no link, submodule or executable"),
    "name": (another_name, "its header names 'mine'; folder and method must agree"),
    "ours": (answers("rs-stereo-refined"), "is the name of a method of rsbench"),
    "oracle": (answers("rs-stereo-refined", uses=["truth"]), "is the name of a method of rsbench"),
    "look-alike": (answers("RS_stereo.ref1ned"), "is the name of a method of rsbench"),
    "truth": (answers("mine", uses=["left", "truth"]), "uses = 'truth': only oracles of rsbench"),
    "bytes": (besides("submissions/mine/\udcff"), f"'submissions/mine/\\udcff': {ONLY}"),
    "newline": (besides("submissions/mine/a\nb\x1b[31m"), f"'submissions/mine/a\\nb\\x1b[31m': {ONLY}"),
    "page": (besides("submissions/mine/pictures/p000/evil.html"), f"pictures/p000/evil.html: {ASKED}"),
    "matches": (besides("submissions/mine/matches/left.csv"), f"matches/left.csv: {ASKED}"),
    "attributes": (besides("submissions/mine/.gitattributes", "* filter=x"), ONLY),
    "executable": (besides("submissions/mine/matches/left.csv", mode=0o755), "must be a plain file"),
    "submodule": (submodule, "must be a plain file"),
    "case": (
        lambda clone: [besides(f"submissions/mine/pictures/{name}/a.png")(clone) for name in ("p", "P")],
        "differ in case alone",
    ),
    "long": (besides("submissions/mine/owner.pub", "a" * 5000), "owner.pub: has 5000 bytes; 4096 are allowed"),
    "key": (besides("submissions/mine/owner.pub", "cert-authority ssh-ed25519 AAAA"), "must be one line"),
    "signature": (besides("submissions/mine/update.sig"), "only the owner of an entry changes it"),
    "two": (lambda clone: [answers(name)(clone) for name in ("mine", "yours")], "changes 2 entries (mine, yours)"),
    "nothing": (lambda clone: run("git", "commit", "--allow-empty", "-qm", "-", cwd=clone), "changes 0 entries"),
    "deep": (
        lambda clone: [
            answers("mine")(clone),
            (clone / "submissions/mine/predictions.jsonl").write_text("[" * 50000),
        ],
        "not valid JSON: nested too deeply",
    ),
}


def check(keeper: Path, head: str, *options: str, **environment: str) -> subprocess.CompletedProcess[str]:
    run("git", "fetch", "-q", "origin", head, cwd=keeper)
    return run(sys.executable, "check.py", "main", "FETCH_HEAD", *options, cwd=keeper, **environment)


def assert_refused(ran: subprocess.CompletedProcess[str], words: str) -> None:
    assert ran.returncode == 2 and words in ran.stderr and ran.stderr.count("\n") == 1, (words, ran.stderr)
    assert ran.stdout == "" and ran.stderr.strip().isprintable() and ran.stderr.isascii()


def merge(keeper: Path, tmp_path: Path, branch: str, change: Callable[[Path], object]) -> None:
    """A request that passes and is merged."""
    hand_in(tmp_path, branch, change)
    ran = check(keeper, branch)
    assert ran.returncode == 0, ran.stderr
    assert run("git", "merge", "-q", "FETCH_HEAD", cwd=keeper).returncode == 0
    assert run("git", "push", "-q", "origin", "main", cwd=keeper).returncode == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_ones_are_refused(keeper: Path, tmp_path: Path, name: str) -> None:
    change, words = HOSTILE[name]
    hand_in(tmp_path, "theirs", change)
    assert_refused(check(keeper, "theirs"), words)


@pytest.mark.slow
def test_a_history_of_two_merge_bases_deletes_nothing(keeper: Path, tmp_path: Path) -> None:
    """The head changes its own entry in the tree of an old request, and has that and the board as parents."""

    def git(*words: object) -> str:
        ran = run("git", *words, cwd=keeper)
        assert ran.returncode == 0, ran.stderr
        return ran.stdout.strip()

    def head(*parents: str) -> str:
        return git("commit-tree", tree, *(word for each in parents for word in ("-p", each)), "-m", "Criss-cross")

    root = git("rev-parse", "main")
    answers("yours")(keeper)
    (keeper / "accepted.txt").write_text("yours: seen\n", "utf-8")
    git("add", "-A")
    git("commit", "-qm", "Another's entry, and the keeper's word")
    before = git("rev-parse", "main")
    git("checkout", "-q", "-b", "theirs", root)
    answers("mine")(keeper)
    git("add", "-A")
    # The newer of two merge bases is the one that git takes for ``BASE...HEAD``.
    run("git", "commit", "-qm", "The first request", cwd=keeper, GIT_COMMITTER_DATE="2090-01-01T00:00:00Z")
    first = git("rev-parse", "HEAD")
    answers("mine", 0.06)(keeper)
    git("add", "-A")
    tree = git("write-tree")
    git("checkout", "-qf", "main")
    git("merge", "-q", "--no-ff", "-m", "Merge", first)
    for parents in ((first, before), (before, first), (first, before, root), ("main",), ("main", first)):
        made = head(*parents)
        if len(parents) == 2 and "main" not in parents:
            assert len(git("merge-base", "--all", "main", made).split()) == 2
        ran = run(sys.executable, "check.py", "main", made, cwd=keeper)
        assert_refused(ran, "'accepted.txt': only submissions/METHOD")
    # A tree with one name twice, which a merge would mend and a fast-forward keep.
    raw = subprocess.run(["git", "cat-file", "tree", "main"], cwd=keeper, capture_output=True, check=True).stdout
    twice = tmp_path / "tree"
    twice.write_bytes(raw + b"40000 submissions\0" + bytes.fromhex(git("rev-parse", f"{tree}:submissions")))
    tree = git("hash-object", "-t", "tree", "--literally", "-w", twice)
    ran = run(sys.executable, "check.py", "main", head("main"), cwd=keeper)
    assert_refused(ran, "stands twice in its folder")
    assert_refused(run(sys.executable, "check.py", "main", head(), cwd=keeper), "does not merge")  # unrelated
    assert_refused(run(sys.executable, "check.py", "main", "no", cwd=keeper), "'no': is no commit")


@pytest.mark.slow
def test_an_entry_is_changed_by_its_key_or_its_keeper(keeper: Path, tmp_path: Path) -> None:
    """An old signature, one for another entry or of another key opens nothing; a rename takes no entry away."""
    keys = {}
    for who in ("me", "you"):
        keys[who] = tmp_path / who
        run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", keys[who], cwd=tmp_path)

    def entry(method: str, size: float, who: str) -> Callable[[Path], object]:
        def change(clone: Path) -> None:
            answers(method, size)(clone)
            key = keys[who].with_suffix(".pub").read_text("utf-8")
            (clone / "submissions" / method / "owner.pub").write_text(key, "utf-8")

        return change

    def signed(method: str, size: float, who: str, by: str) -> Callable[[Path], object]:
        def change(clone: Path) -> None:
            entry(method, size, who)(clone)
            run("git", "add", "-A", cwd=clone)
            run("git", "commit", "-qm", "Update", cwd=clone)
            text = run(sys.executable, "check.py", "origin/main", "HEAD", "--message", cwd=clone).stdout
            (clone / "message").write_text(text, "utf-8")
            words = ("ssh-keygen", "-Y", "sign", "-n", "rsbench-board", "-f", keys[by], "message")
            assert run(*words, cwd=clone).returncode == 0
            (clone / "message").unlink()
            (clone / "message.sig").rename(clone / "submissions" / method / "update.sig")

        return change

    merge(keeper, tmp_path, "one", entry("mine", 0.05, "me"))
    merge(keeper, tmp_path, "two", entry("yours", 0.06, "you"))
    merge(keeper, tmp_path, "three", answers("mine-2", 0.05))  # whose name begins with that of another
    wanted = "is there already; update.sig must be a signature of this change by its owner.pub"
    for branch, change in (
        ("unsigned", entry("mine", 0.04, "me")),
        ("another key", entry("mine", 0.04, "you")),
        ("another's word", signed("mine", 0.04, "you", by="you")),
        ("picture", besides("submissions/mine/pictures/p000/left_1.png")),
        ("removed", lambda clone: (clone / "submissions" / "mine" / "owner.pub").unlink()),
    ):
        hand_in(tmp_path, branch.replace(" ", "-").replace("'", ""), change)
        assert_refused(check(keeper, branch.replace(" ", "-").replace("'", "")), wanted)
    hand_in(tmp_path, "keyless", answers("mine-2", 0.04))
    assert_refused(check(keeper, "keyless"), "is there already, without owner.pub; only the keeper")
    hand_in(tmp_path, "moved", lambda clone: (clone / "submissions/mine").rename(clone / "submissions/new"))
    assert_refused(check(keeper, "moved"), "changes 2 entries (mine, new)")
    hand_in(tmp_path, "gone", lambda clone: shutil.rmtree(clone / "submissions/mine"))
    assert check(keeper, "gone").returncode == 2
    merge(keeper, tmp_path, "better", signed("mine", 0.04, "me", by="me"))
    merge(keeper, tmp_path, "back", signed("mine", 0.05, "me", by="me"))

    def replayed(clone: Path) -> None:
        run("git", "checkout", "origin/better", "--", "submissions/mine", cwd=clone)

    hand_in(tmp_path, "replayed", replayed)
    assert_refused(check(keeper, "replayed"), wanted)
    # The keeper allows one commit, not what comes after it.
    head = run("git", "rev-parse", "origin/keyless", cwd=keeper).stdout.strip()
    assert check(keeper, "keyless", BOARD_UPDATE=head).returncode == 0
    assert_refused(check(keeper, "unsigned", BOARD_UPDATE=head), wanted)
    # What the keeper vouches for is what it is; its owner's word is not enough for something else.
    (keeper / "accepted.txt").write_text("mine: seen\n", "utf-8")
    run("git", "add", "-A", cwd=keeper)
    run("git", "commit", "-qm", "Accept", cwd=keeper)
    run("git", "push", "-q", "origin", "main", cwd=keeper)
    hand_in(tmp_path, "vouched", signed("mine", 0.03, "me", by="me"))
    assert_refused(check(keeper, "vouched"), "accepted.txt vouches for what it is now")


def test_an_old_git_is_refused(keeper: Path, tmp_path: Path) -> None:
    old = tmp_path / "bin" / "git"
    old.parent.mkdir()
    old.write_text(
        f'#!/bin/sh\n[ "$1" = version ] && echo git version 2.34.1 || exec {shutil.which("git")} "$@"\n'
    )
    old.chmod(0o755)
    path = f"{old.parent}{os.pathsep}{os.environ['PATH']}"
    assert_refused(run(sys.executable, "check.py", "main", "main", cwd=keeper, PATH=path), "older than 2.38")


@pytest.mark.slow
def test_one_is_scored_published_and_there_when_the_board_is_opened_again(keeper: Path, tmp_path: Path) -> None:
    merge(keeper, tmp_path, "mine", answers("mine"))
    hand_in(tmp_path, "shouting", answers("MINE"))
    assert_refused(check(keeper, "shouting"), "reads like submissions/mine, which is there")
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


def test_the_workflow_runs_nothing_of_a_request() -> None:
    """Of pull_request the file would be the request's; here file and scripts are those of main, with no rights."""
    flow = yaml.safe_load((BOARD / ".github" / "workflows" / "board.yml").read_text("utf-8"))
    job = flow["jobs"]["check"]
    assert set(flow[True]) == {"push", "pull_request_target"} and flow[True]["pull_request_target"][
        "branches"
    ] == ["main"]
    assert flow["permissions"] == {} and job["permissions"] == {"contents": "read"}
    first = job["steps"][0]["with"]
    assert first["ref"] == "refs/heads/main" and first["persist-credentials"] is False
    assert sum("checkout" in str(step) for step in job["steps"]) == 1
    ran = "".join(step.get("run", "") for step in job["steps"])
    assert "${{" not in ran and 'check.py main "$HEAD"' in ran and "secrets" not in str(flow)
    assert "action == 'labeled'" in job["env"]["BOARD_UPDATE"]
    for word in ("check.py", "publish.py"):
        assert (BOARD / word).is_file() and word in str(flow["jobs"])
