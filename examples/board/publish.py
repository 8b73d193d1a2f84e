"""Score every submission of this repository and write the site: python publish.py SITE.

The board is made anew from what was handed in, so nothing is lost with it, and a newer rsbench scores all alike.
Lines ``METHOD: reason`` in accepted.txt are the keeper's word for entries that are in doubt. What rsbench refuses,
as a newer one may that has a method of that name itself, is left out with a line and keeps no other from the site.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path


def rsbench(*words: object) -> bool:
    """Whether it went well; if not, rsbench has said why."""
    command = [sys.executable, "-m", "rsbench", "-q", "leaderboard", *map(str, words)]
    return subprocess.run(command, check=False).returncode == 0


def main() -> None:
    site, accepted = Path(sys.argv[1]), Path("accepted.txt")
    with tempfile.TemporaryDirectory() as folder:
        board = Path(folder, "board")
        for answers in sorted(Path("submissions").glob("*/predictions.jsonl")):
            if not rsbench("submit", answers, "--board", board):
                print(f"left out: {answers}", file=sys.stderr)
        for line in accepted.read_text("utf-8").splitlines() if accepted.is_file() else ():
            method, _, reason = line.partition(": ")
            for entry in board.glob(f"*/*/entries/{method}"):
                protocol, split = entry.parts[-4:-2]
                where = ("--board", board, "--protocol", protocol, "--split", split)
                if not rsbench("accept", method, *where, "--reason", reason):
                    print(f"accepted.txt: left out: {line}", file=sys.stderr)
        shutil.rmtree(site, ignore_errors=True)
        if not rsbench("build", "--board", board, "--out", site):
            sys.exit(1)


if __name__ == "__main__":
    main()
