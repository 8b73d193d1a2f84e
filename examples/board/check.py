"""Check a pull request to a board: python check.py BASE HEAD, two commits of this repository.

What is judged is the tree that merging HEAD into BASE gives, against that of BASE. They may differ in one folder,
submissions/METHOD, and in nothing else. It holds predictions.jsonl, whose header names METHOD, the pictures/ or
matches/ that its track asks for, and owner.pub, a public SSH key (ed25519), where its author wants to change the
entry later. A change of an entry of BASE needs update.sig, a signature by the owner.pub of BASE, or the keeper's
leave: BOARD_UPDATE is the hash of HEAD. ``check.py BASE HEAD --message`` prints what is to be signed; other
options go to ``rsbench leaderboard submit``. HEAD is read as data from git objects: none of it is checked out or
run, and no link is followed.
"""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple, NoReturn

from rsbench.benchmark.leaderboard.doubt import outline

NAME = r"[A-Za-z0-9][A-Za-z0-9._-]{0,119}"
ALLOWED = re.compile(
    rf"submissions/({NAME})/(predictions\.jsonl|owner\.pub|update\.sig|pictures/{NAME}/{NAME}|matches/{NAME})"
)
KEY, SIGNATURE = "owner.pub", "update.sig"
KEY_LINE = re.compile(rb"(ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAI[A-Za-z0-9+/]{43})( [ -~]{0,100})?\r?\n?")
MOST_FILES, MOST_BYTES, MOST_BYTES_IN_ALL, MOST_BYTES_OF_KEY = 20_000, 1 << 26, 1 << 31, 1 << 12


class Blob(NamedTuple):
    mode: str
    sha: str
    size: str


def refuse(why: str) -> NoReturn:
    print(f"refused: {why}", file=sys.stderr)
    sys.exit(2)


def shown(name: str) -> str:
    """A name of a stranger for the log: escaped, so that nothing in it acts on a terminal."""
    return ascii(name[:200])


def safe(text: str) -> str:
    """Lines for the log, with whatever is not printable escaped."""
    return "".join(c if c == "\n" or c.isprintable() else ascii(c)[1:-1] for c in text)


def git(*words: str, why: str = "git failed") -> bytes:
    environment = {**os.environ, "GIT_NO_REPLACE_OBJECTS": "1", "LC_ALL": "C"}
    ran = subprocess.run(["git", *words], check=False, capture_output=True, env=environment)
    if ran.returncode != 0:
        said = ran.stderr.decode("utf-8", "backslashreplace").strip()
        refuse(f"{why} (git {words[0]}: {shown(said)})" if said else why)
    return ran.stdout


def commit(name: str) -> str:
    words = ("rev-parse", "--verify", "--end-of-options", f"{name}^{{commit}}")
    return git(*words, why=f"{shown(name)}: is no commit of this repository; fetch it").decode().strip()


def merged(base: str, head: str) -> str:
    """The tree that the merge gives."""
    found = re.search(rb"(\d+)\.(\d+)", git("version"))
    if found is None or (int(found[1]), int(found[2])) < (2, 38):
        refuse("git is older than 2.38 and cannot tell what a merge gives; install a newer one")
    fault = "the request does not merge; merge the board's branch into it"
    if git("merge-base", base, head, why=fault).decode().strip() == base:
        return head  # as it stands, so that nothing is mended that a fast-forward would leave
    return git("merge-tree", "--write-tree", "--no-messages", base, head, why=fault).decode().strip()


def files_of(tree: str) -> dict[str, Blob]:
    """All paths of a tree; those that are not UTF-8 with surrogates."""
    found: dict[str, Blob] = {}
    listed = git("ls-tree", "-r", "-l", "-z", "--full-tree", tree).decode("utf-8", "surrogateescape")
    for line in listed.split("\0")[:-1]:
        about, _, path = line.partition("\t")
        mode, _, sha, size = about.split()
        if path in found:
            refuse(f"{shown(path)}: stands twice in its folder; make the commit again with git add")
        found[path] = Blob(mode, sha, size)
    return found


def one_method(before: dict[str, Blob], after: dict[str, Blob]) -> str:
    """The one entry that a request adds or changes."""
    methods = set[str]()
    for path in sorted(path for path in {*before, *after} if before.get(path) != after.get(path)):
        match = ALLOWED.fullmatch(path)
        if match is None:
            refuse(
                f"{shown(path)}: only submissions/METHOD/predictions.jsonl, {KEY}, {SIGNATURE}, pictures and "
                "matches may change; leave it as it is"
            )
        if path in after and after[path].mode != "100644":
            refuse(f"{shown(path)}: must be a plain file; no link, submodule or executable")
        methods.add(match[1])
    if len(methods) != 1:
        refuse(f"changes {len(methods)} entries ({', '.join(sorted(methods)[:9])}); hand in one at a time")
    return methods.pop()


def contents(files: dict[str, Blob], method: str) -> dict[str, bytes]:
    """What the files of an entry hold, by their paths below its folder; sizes are checked before that."""
    prefix = f"submissions/{method}/"
    blobs = {path.removeprefix(prefix): blob for path, blob in files.items() if path.startswith(prefix)}
    if len(blobs) > MOST_FILES or sum(int(blob.size) for blob in blobs.values()) > MOST_BYTES_IN_ALL:
        refuse(f"{prefix}: has {len(blobs)} files, or more than {MOST_BYTES_IN_ALL} bytes; hand in less")
    for name, blob in blobs.items():
        most = MOST_BYTES_OF_KEY if name in (KEY, SIGNATURE) else MOST_BYTES
        if int(blob.size) > most:
            refuse(f"{prefix}{name}: has {blob.size} bytes; {most} are allowed")
    if len({name.lower() for name in blobs}) < len(blobs):
        refuse(f"{prefix}: has names that differ in case alone; rename one")
    return {name: git("cat-file", "blob", blob.sha) for name, blob in blobs.items()}


def digest(entry: dict[str, bytes]) -> str:
    lines = (f"{hashlib.sha256(data).hexdigest()} {name}\n" for name, data in sorted(entry.items()))
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def message(method: str, old: dict[str, bytes], new: dict[str, bytes]) -> bytes:
    """What an owner signs. The old entry counts with its signature, so that no message comes a second time."""
    unsigned = {name: data for name, data in new.items() if name != SIGNATURE}
    return f"rsbench board: update of {method}\nfrom {digest(old)}\nto {digest(unsigned)}\n".encode()


def is_signed(text: bytes, key: bytes, signature: bytes, folder: Path) -> bool:
    (folder / "signers").write_bytes(b"owner " + key + b"\n")
    (folder / "signature").write_bytes(signature)
    words = ["-Y", "verify", "-f", str(folder / "signers"), "-I", "owner", "-n", "rsbench-board"]
    try:
        ran = subprocess.run(
            ["ssh-keygen", *words, "-s", str(folder / "signature")], input=text, check=False, capture_output=True
        )
    except OSError:
        refuse("ssh-keygen is missing, so no signature can be checked; install OpenSSH")
    return ran.returncode == 0


def check_right(method: str, old: dict[str, bytes], new: dict[str, bytes], folder: Path, *, keeper: bool) -> None:
    """Refuse what neither the entry's own key nor the keeper allows."""
    where = f"submissions/{method}"
    if keeper or not old:
        if new.get(SIGNATURE) != old.get(SIGNATURE):
            refuse(f"{where}/{SIGNATURE}: only the owner of an entry changes it, by an update; leave it as it is")
        return
    key = KEY_LINE.fullmatch(old.get(KEY, b""))
    if key is None:
        refuse(f"{where}: is there already, without {KEY}; only the keeper may allow that it changes")
    if not is_signed(message(method, old, new), key[1], new.get(SIGNATURE, b""), folder):
        refuse(f"{where}: is there already; {SIGNATURE} must be a signature of this change by its {KEY}")


def score(method: str, entry: dict[str, bytes], folder: Path, options: list[str]) -> None:
    """Let rsbench score an entry; whatever of it rsbench does not take is refused."""
    mine, board = folder / "submissions" / method, folder / "board"
    for name, data in entry.items():
        (mine / name).parent.mkdir(parents=True, exist_ok=True)
        (mine / name).write_bytes(data)
    words = ["leaderboard", "submit", str(mine / "predictions.jsonl"), "--board", str(board), *options]
    ran = subprocess.run([sys.executable, "-m", "rsbench", *words], check=False, capture_output=True)
    print(safe(ran.stderr.decode("utf-8", "backslashreplace")), end="", file=sys.stderr)
    if ran.returncode != 0:
        sys.exit(ran.returncode)
    (place,) = board.glob("*/*/entries/*")
    if place.name != method:
        refuse(f"submissions/{method}: its header names {place.name!r}; folder and method must agree")
    taken = {path.relative_to(place).as_posix() for path in place.rglob("*")}
    if strange := sorted({*entry} - taken - {KEY, SIGNATURE}):
        refuse(f"submissions/{method}/{strange[0]}: is not asked by its track; remove it")
    print(safe(ran.stdout.decode("utf-8", "backslashreplace")), end="")


def main() -> None:
    if len(sys.argv) < 3:
        refuse("two commits are missing; run python check.py BASE HEAD")
    base, head, options = commit(sys.argv[1]), commit(sys.argv[2]), sys.argv[3:]
    before, after = files_of(base), files_of(merged(base, head))
    method = one_method(before, after)
    old, new = contents(before, method), contents(after, method)
    others = {path.split("/")[1] for path in before if path.startswith("submissions/")} - {method}
    for name in sorted(others if not old else ()):
        if outline(name) == outline(method):
            refuse(f"submissions/{method}: reads like submissions/{name}, which is there; choose another name")
    if options == ["--message"]:
        sys.stdout.buffer.write(message(method, old, new))
        return
    if "predictions.jsonl" not in new:
        refuse(f"submissions/{method}: has no predictions.jsonl; add it")
    if KEY in new and not KEY_LINE.fullmatch(new[KEY]):
        refuse(f"submissions/{method}/{KEY}: must be one line, ssh-ed25519 and a key (ssh-keygen -t ed25519)")
    keeper = os.environ.get("BOARD_UPDATE") == head
    vouched = git("cat-file", "blob", before["accepted.txt"].sha) if "accepted.txt" in before else b""
    if not keeper and any(
        line.partition(": ")[0] == method for line in vouched.decode("utf-8", "replace").splitlines()
    ):
        refuse(
            f"submissions/{method}: accepted.txt vouches for what it is now; only the keeper may allow a change"
        )
    with tempfile.TemporaryDirectory() as folder:
        check_right(method, old, new, Path(folder), keeper=keeper)
        score(method, new, Path(folder), options)


if __name__ == "__main__":
    main()
