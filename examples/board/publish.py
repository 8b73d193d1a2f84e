"""Score every submission of this repository and write the site: python publish.py SITE.

The board is made anew from what was handed in, so nothing is lost with it, and a newer rsbench scores all alike.
Lines ``METHOD: reason`` in accepted.txt are the keeper's word for entries that are in doubt.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path


def rsbench(*words: object) -> None:
    subprocess.run([sys.executable, "-m", "rsbench", "-q", "leaderboard", *map(str, words)], check=True)


def main() -> None:
    site, accepted = Path(sys.argv[1]), Path("accepted.txt")
    with tempfile.TemporaryDirectory() as folder:
        board = Path(folder, "board")
        for answers in sorted(Path("submissions").glob("*/predictions.jsonl")):
            rsbench("submit", answers, "--board", board)
        for line in accepted.read_text("utf-8").splitlines() if accepted.is_file() else ():
            method, _, reason = line.partition(": ")
            for entry in board.glob(f"*/*/entries/{method}"):
                protocol, split = entry.parts[-4:-2]
                rsbench(
                    "accept",
                    method,
                    "--board",
                    board,
                    "--protocol",
                    protocol,
                    "--split",
                    split,
                    "--reason",
                    reason,
                )
        shutil.rmtree(site, ignore_errors=True)
        rsbench("build", "--board", board, "--out", site)


if __name__ == "__main__":
    main()
