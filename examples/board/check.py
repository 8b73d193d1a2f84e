"""Check a pull request to a board: python check.py BASE HEAD, two commits of this repository.

It may add or change one folder, submissions/METHOD, and nothing else: a file predictions.jsonl, whose header names
METHOD, and pictures/ or matches/ beside it. What it holds is read as data; nothing of it is run, no link followed.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

NAME = r"[A-Za-z0-9][A-Za-z0-9._-]*"
ALLOWED = re.compile(rf"submissions/({NAME})/(predictions\.jsonl|(?:pictures/{NAME}|matches)/{NAME})")
FILE = "100644"


def git(*words: str) -> bytes:
    return subprocess.run(["git", *words], check=True, capture_output=True).stdout


def refuse(why: str) -> None:
    sys.exit(f"refused: {why}")


def added(base: str, head: str) -> dict[str, str]:
    """Paths that the pull request leaves, with the hashes of their contents."""
    found: dict[str, str] = {}
    fields = git("diff", "--raw", "--no-renames", "--abbrev=40", "-z", f"{base}...{head}").decode().split("\0")
    for about, path in zip(fields[:-1:2], fields[1::2], strict=True):
        _, mode, _, blob, state = about.split()
        if not ALLOWED.fullmatch(path):
            refuse(f"{path!r}: only submissions/METHOD/predictions.jsonl, pictures and matches may change")
        if state == "D" or mode != FILE:
            refuse(f"{path!r}: must be a plain file, and stay")
        found[path] = blob
    return found


def main() -> None:
    base, head = sys.argv[1:3]
    files = added(base, head)
    methods = {path.split("/")[1] for path in files}
    if len(methods) != 1:
        refuse(f"changes {len(methods)} entries ({', '.join(sorted(methods))}); one at a time")
    (method,) = methods
    for other in git("ls-tree", "--name-only", "-z", base, "submissions/").decode().split("\0"):
        name = other.removeprefix("submissions/")
        if name != method and name.lower() == method.lower():
            refuse(f"submissions/{method}: differs from submissions/{name} in case alone")
    with tempfile.TemporaryDirectory() as folder:
        for path, blob in files.items():
            place = Path(folder, path)
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(git("cat-file", "blob", blob))
        answers = Path(folder, "submissions", method, "predictions.jsonl")
        if not answers.is_file():
            refuse(f"submissions/{method}: has no predictions.jsonl")
        with answers.open(encoding="utf-8", errors="replace") as lines:
            first = lines.readline(1 << 16)
        try:
            named = json.loads(first)["method"]
        except (ValueError, KeyError, TypeError):
            named = None
        if named != method:
            refuse(f"submissions/{method}: its header names {named!r}; folder and method must agree")
        words = ["leaderboard", "submit", str(answers), "--board", str(Path(folder, "board"))]
        sys.exit(subprocess.run([sys.executable, "-m", "rsbench", *words, *sys.argv[3:]], check=False).returncode)


if __name__ == "__main__":
    main()
