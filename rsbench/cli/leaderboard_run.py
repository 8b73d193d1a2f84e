"""What ``rsbench leaderboard run`` does before anything is scored."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rsbench.cli.leaderboard_tracks import problems_of, write_frames_of

if TYPE_CHECKING:
    from rsbench.benchmark.leaderboard.running import Limits
    from rsbench.benchmark.leaderboard.splits import Split
    from rsbench.jobs.workers import Workers


def load_cards(cards: list[str], split: Split) -> None:
    """Raises RsbenchError when one of them is wrong, or is none of the track's kind."""
    from rsbench.benchmark.leaderboard.picture_running import load_chains
    from rsbench.benchmark.leaderboard.running import load_entries

    (load_chains if split.protocol.pictures else load_entries)(cards, split.protocol)


def predict(
    entry: list[str],
    split: Split,
    board: Path,
    data: Path | None,
    seed_file: Path | None,
    workers: Workers,
    limits: Limits,
) -> list[Path]:
    """Files of predictions of cards, in the hidden folder of the board."""
    from rsbench.benchmark.leaderboard.picture_running import run_picture_cards
    from rsbench.benchmark.leaderboard.running import prepare_inputs, run_cards, steps_of
    from rsbench.cli.console import progress_bar
    from rsbench.storage.work_folder import work_folder

    steps = len(split.truths) if split.protocol.pictures else steps_of(entry, split, limits)
    with work_folder(board) as hidden, progress_bar(f"running {split.name}", steps) as advance:
        place = hidden / "runs" / split.protocol.id / split.name
        place.mkdir(parents=True, exist_ok=True)
        prepare_inputs(
            split,
            lambda: problems_of(split, data, seed_file),
            place / "inputs",
            lambda folder: write_frames_of(split, data, folder) if data and split.protocol.pictures else None,
        )
        if split.protocol.pictures:
            files = run_picture_cards(
                entry, split, place / "inputs", place, workers=workers, limits=limits, step=advance
            )
        else:
            files = run_cards(entry, split, place / "inputs", place, workers=workers, limits=limits, step=advance)
    return files
