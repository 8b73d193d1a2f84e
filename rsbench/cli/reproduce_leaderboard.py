"""``rsbench reproduce leaderboard``: our solvers on the public split of points."""

from __future__ import annotations

import os
from pathlib import Path

import typer

BOARD = "leaderboard"
"""Folder of the board below ``--data``."""


def leaderboard(out: Path, data: Path, workers: int | None) -> None:
    """Run what has not run, score, add the oracles, and publish; entries of others on that board are shown too."""
    from rsbench.cli.leaderboard import oracles, run
    from rsbench.cli.leaderboard_smoke import own_solvers, smoke

    board = data / BOARD
    run("points", own_solvers(), board, workers=workers or os.cpu_count() or 1)
    oracles("points", board)
    smoke(out / "leaderboard" / "smoke", write=True)
    publish(board, out / "leaderboard")


def publish(board: Path, out: Path) -> None:
    """Write a board's site, and by what command and code each entry was made."""
    from rsbench.benchmark.leaderboard.board import entries_of, splits_of
    from rsbench.benchmark.provenance import provenance
    from rsbench.dataset.files import write_json
    from rsbench.reading import read_json
    from rsbench.report.board_page import build_site

    page = build_site(board, out / "site")
    made = {
        f"{protocol}/{split}/{entry.header.method}": read_json(entry.folder / "entry.json").get("made")
        for protocol, split in splits_of(board)
        for entry in entries_of(board, protocol, split)
    }
    brief = {
        name: {key: record[key] for key in ("command", "commit", "source", "date") if key in record}
        for name, record in made.items()
        if isinstance(record, dict)
    }
    write_json(out / "provenance.json", {**provenance("rsbench reproduce leaderboard"), "entries": brief})
    typer.echo(f"page: {page}")
