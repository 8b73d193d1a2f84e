"""Check a pull request to a board: python check.py BASE HEAD, two commits of this repository.

BASE is the tip of the board's branch, HEAD the last commit of the request. What is judged is the tree that merging
HEAD into BASE makes. It may differ from BASE in one folder, submissions/METHOD, which holds what the track of its
predictions asks for, and may hold owner.pub, the key of its author. An entry that is there already changes only
where that key signed the change (update.sig), or where updates.txt of BASE allows it. What the request brings is
read from git objects as data: nothing of it is checked out or run, and no link is followed. Further options are
those of ``rsbench leaderboard submit``.
"""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple, NoReturn

from rsbench.benchmark.leaderboard.board import outline

NAME = r"[A-Za-z0-9][A-Za-z0-9._-]{0,119}"
ANSWERS, OWNER, SIGNATURE, UPDATES = "predictions.jsonl", "owner.pub", "update.sig", "updates.txt"
ALLOWED = re.compile(
    rf"submissions/({NAME})/(predictions\.jsonl|owner\.pub|update\.sig|(?:pictures/{NAME}|matches)/{NAME})"
)
KEY = re.compile(rb"(ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAI[A-Za-z0-9+/]{43})( [ -~]*)?\n?")
FILE = "100644"
MOST_FILES, FILE_BYTES, ENTRY_BYTES, KEY_BYTES = 10_000, 64 << 20, 1 << 30, 4096
SHOWN = 200
"""Characters of a path that a refusal shows."""
OWN = {"GIT_NO_REPLACE_OBJECTS": "1"}
"""Variables of git."""


class Blob(NamedTuple):
    """A file of a tree."""

    mode: str
    hash: str
    bytes: int
    """-1 of a submodule, and of what is not there."""


def refuse(why: str) -> NoReturn:
    print(f"refused: {why}", file=sys.stderr)
    sys.exit(2)


def plain(path: str) -> str:
    """A path in printable ASCII, whatever bytes it has."""
    return ascii(path[:SHOWN])


def plain_lines(text: str) -> str:
    """A text in which nothing but line ends moves a terminal."""
    return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text)


def run_git(*words: str, given: bytes = b"", index: str = "") -> subprocess.CompletedProcess[bytes]:
    own = OWN | ({"GIT_INDEX_FILE": index} if index else {})
    return subprocess.run(["git", *words], input=given, capture_output=True, check=False, env=os.environ | own)


def last_line(ran: subprocess.CompletedProcess[bytes]) -> str:
    lines = ran.stderr.decode(errors="replace").strip().splitlines() or [f"exit code {ran.returncode}"]
    return plain(lines[-1])[1:-1]


def git(*words: str, given: bytes = b"", index: str = "") -> bytes:
    """What git prints; refuses, with git's last line, where it fails."""
    ran = run_git(*words, given=given, index=index)
    if ran.returncode:
        refuse(f"git {words[0]}: {last_line(ran)}")
    return ran.stdout


def hash_of(*words: str, given: bytes = b"", index: str = "") -> str:
    return git(*words, given=given, index=index).decode().strip()


def commit(name: str) -> str:
    ran = run_git("rev-parse", "--verify", "--end-of-options", f"{name}^{{commit}}")
    if ran.returncode:
        refuse(f"{plain(name)}: is no commit of this repository; fetch it")
    return ran.stdout.decode().strip()


def merged(base: str, head: str) -> str:
    """The tree that merging makes."""
    if run_git("rev-parse", "--is-shallow-repository").stdout.strip() != b"false":
        refuse("this clone is shallow, so what a merge makes is not known; run git fetch --unshallow")
    ran = run_git("merge-tree", "--write-tree", "--no-messages", base, head)
    if ran.returncode == 129:
        refuse("this git has no merge-tree --write-tree; install git 2.38 or later")
    if ran.returncode == 1:
        refuse("the request conflicts with the board; bring it up to date with the board's branch")
    if ran.returncode:
        refuse(f"the request cannot be merged: {last_line(ran)}; start from a clone of the board")
    return ran.stdout.decode().strip()


def check_names(tree: str) -> None:
    """Refuse a tree that git itself would not make of its files."""
    with tempfile.TemporaryDirectory() as folder:
        index = str(Path(folder, "index"))
        git(
            "update-index",
            "-z",
            "--index-info",
            given=git("ls-tree", "-r", "-z", "--full-tree", tree),
            index=index,
        )
        if hash_of("write-tree", index=index) != tree:
            refuse("the request has a tree with empty, doubled or strange names; commit with git itself")


def files_of(tree: str, most: float = math.inf) -> dict[str, Blob]:
    """All files of a tree, by path. Bytes that are not UTF-8 become lone surrogates.

    Refuses a tree of more than ``most`` files before all are listed: a few objects can name any number of files.
    """
    found: dict[str, Blob] = {}
    words = ["git", "ls-tree", "-r", "-l", "-z", "--full-tree", tree]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(words, env=os.environ | OWN, **pipes) as listing:
        assert listing.stdout is not None
        rest = b""
        while block := listing.stdout.read(1 << 16):
            *lines, rest = (rest + block).split(b"\0")
            for about, path in (line.decode(errors="surrogateescape").split("\t", 1) for line in lines):
                mode, _, digest, size = about.split()
                found[path] = Blob(mode, digest, int(size) if size.isdigit() else -1)
            if len(found) > most or len(rest) > 1 << 16:
                listing.kill()
                refuse(f"the request has more than {MOST_FILES} files, or endless names; take some out")
    if listing.returncode:
        refuse("git ls-tree: the request's tree cannot be listed; commit with git itself")
    return found


def changed_entry(before: dict[str, Blob], after: dict[str, Blob]) -> tuple[str, dict[str, Blob]]:
    """The one entry that differs, and the files that it then has, by their paths in it."""
    changed = sorted(path for path in {*before, *after} if before.get(path) != after.get(path))
    for path in changed:
        if not ALLOWED.fullmatch(path):
            refuse(f"{plain(path)}: is no file of one folder submissions/METHOD of a board; take the change back")
    methods = sorted({path.split("/")[1] for path in changed})
    if len(methods) != 1:
        refuse(f"changes {len(methods)} entries ({', '.join(methods)[:SHOWN]}); change one")
    (method,) = methods
    files = {path: blob for path, blob in after.items() if path.startswith(f"submissions/{method}/")}
    for path, blob in files.items():
        if not ALLOWED.fullmatch(path) or blob.mode != FILE:
            refuse(f"{plain(path)}: mode {blob.mode}: must be a plain file that the track asks for; take it out")
        if blob.bytes > (KEY_BYTES if path.endswith((OWNER, SIGNATURE)) else FILE_BYTES):
            refuse(f"{plain(path)}: {blob.bytes} bytes are too many; take it out or make it smaller")
    if (total := sum(blob.bytes for blob in files.values())) > ENTRY_BYTES:
        refuse(f"submissions/{method}: {total} bytes are too many; take some out")
    for other in {path.split("/")[1] for path in before if path.startswith("submissions/")} - {method}:
        if outline(other) == outline(method):
            refuse(f"submissions/{method}: reads like submissions/{other}; choose a name that differs by more")
    entry = {path.removeprefix(f"submissions/{method}/"): blob for path, blob in files.items()}
    if ANSWERS not in entry:
        refuse(f"submissions/{method}: has no {ANSWERS}; add it, or ask the keeper to take the entry out")
    if OWNER in entry and not KEY.fullmatch(git("cat-file", "blob", entry[OWNER].hash)):
        refuse(
            f"submissions/{method}/{OWNER}: must be one public key, 'ssh-ed25519 ...'; see ssh-keygen -t ed25519"
        )
    return method, entry


def lines_of(base: str, files: dict[str, Blob], name: str) -> list[str]:
    """Lines of a file of the keeper's; none where there is no such file."""
    return git("cat-file", "blob", f"{base}:{name}").decode(errors="replace").splitlines() if name in files else []


def is_accepted(base: str, before: dict[str, Blob], method: str) -> bool:
    return any(line.lower().startswith(f"{method.lower()}:") for line in lines_of(base, before, "accepted.txt"))


def check_update(base: str, tree: str, method: str, before: dict[str, Blob], entry: dict[str, Blob]) -> None:
    """Refuse a change of an entry that neither its owner nor the keeper allows.

    Either allows one line, METHOD OLD NEW: the hashes of the trees that the entry is before and after, the latter
    without update.sig. So the word of either is about this change alone, and no copy of it serves for another.
    """
    at = f"submissions/{method}"
    listed = git("ls-tree", "-z", f"{tree}:{at}").split(b"\0")
    unsigned = b"\0".join(line for line in listed if not line.endswith(b"\t" + SIGNATURE.encode()))
    line = f"{method} {hash_of('rev-parse', f'{base}:{at}')} {hash_of('mktree', '-z', given=unsigned)}"
    owned = f"{at}/{OWNER}" in before
    accepted = is_accepted(base, before, method)
    if SIGNATURE not in entry or not owned or accepted:
        if SIGNATURE in entry or line not in lines_of(base, before, UPDATES):
            who = "its owner's key signs" if owned and not accepted else f"the keeper adds to {UPDATES}"
            refuse(
                f"{at}: is there already, without a {SIGNATURE} that counts; it changes where {who} this: {line}"
            )
        return
    with tempfile.TemporaryDirectory() as folder:
        signers, signature = Path(folder, "signers"), Path(folder, SIGNATURE)
        key = KEY.fullmatch(git("cat-file", "blob", before[f"{at}/{OWNER}"].hash))
        signers.write_bytes(b'owner namespaces="rsbench-board" ' + (key.group(1) if key else b"") + b"\n")
        signature.write_bytes(git("cat-file", "blob", entry[SIGNATURE].hash))
        words = ["-Y", "verify", "-f", signers, "-I", "owner", "-n", "rsbench-board", "-s", signature]
        ran = subprocess.run(["ssh-keygen", *words], input=f"{line}\n".encode(), capture_output=True, check=False)
    if ran.returncode:
        refuse(f"{at}/{SIGNATURE}: is not the signature by the key of {OWNER} on the board of the line: {line}")


def score(method: str, entry: dict[str, Blob], options: list[str]) -> None:
    """Score an entry on a board of its own, and refuse files that were not asked for."""
    with tempfile.TemporaryDirectory() as folder:
        for name, blob in entry.items():
            place = Path(folder, method, name)
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(git("cat-file", "blob", blob.hash))
        board = Path(folder, "board")
        words = ["leaderboard", "submit", str(Path(folder, method, ANSWERS)), "--board", str(board), *options]
        ran = subprocess.run([sys.executable, "-m", "rsbench", *words], capture_output=True, check=False)
        output, errors = (
            plain_lines(text.decode(errors="replace").replace(f"{folder}{os.sep}", "submissions/"))
            for text in (ran.stdout, ran.stderr)
        )
        if ran.returncode:
            sys.stderr.write(errors)
            sys.exit(2)
        (made,) = board.glob("*/*/entries/*/entry.json")
        if made.parent.name != method:
            refuse(f"submissions/{method}: its header names {made.parent.name!r}; folder and method must agree")
        asked = {ANSWERS, OWNER, SIGNATURE, *json.loads(made.read_text("utf-8")).get("files", {})}
    for name in entry:
        if name not in asked:
            refuse(f"submissions/{method}/{name}: is nothing that the track of {ANSWERS} asks for; take it out")
    sys.stdout.write(output)
    sys.stderr.write(errors)


def main() -> None:
    if len(sys.argv) < 3:
        refuse("give two commits: python check.py BASE HEAD")
    base, head = map(commit, sys.argv[1:3])
    tree = merged(base, head)
    before = files_of(base)
    method, entry = changed_entry(before, files_of(tree, len(before) + MOST_FILES))
    check_names(tree)
    at = f"submissions/{method}"
    if hash_of("rev-parse", f"{tree}:{at}") != hash_of("rev-parse", "--verify", f"{head}:{at}"):
        refuse(f"{at}: was changed by others too; bring the request up to date with the board's branch")
    if any(path.startswith(f"{at}/") for path in before):
        check_update(base, tree, method, before, entry)
    elif is_accepted(base, before, method):
        refuse(f"{at}: accepted.txt speaks of an entry of that name; choose another name")
    elif SIGNATURE in entry:
        refuse(f"{at}/{SIGNATURE}: is for a change of an entry that is there; take it out")
    score(method, entry, sys.argv[3:])


if __name__ == "__main__":
    main()
