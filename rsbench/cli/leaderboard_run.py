"""What ``rsbench leaderboard run`` does before anything is scored."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rsbench.cli.leaderboard_tracks import write_frames_of

if TYPE_CHECKING:
    from rsbench.benchmark.leaderboard.track import Limits, Split
    from rsbench.jobs.process_jobs import Workers


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
    from rsbench.benchmark.leaderboard.inputs import prepare_inputs
    from rsbench.cli.console import progress_bar
    from rsbench.storage.work_folder import work_folder

    track = split.track
    with (
        work_folder(board) as hidden,
        progress_bar(f"running {split.name}", track.steps(entry, split, limits)) as advance,
    ):
        place = hidden / "runs" / track.id / split.name
        place.mkdir(parents=True, exist_ok=True)
        prepare_inputs(
            split,
            lambda: track.problems(data, seed_file, len(split.truths)),
            place / "inputs",
            lambda folder: write_frames_of(split, data, folder) if data and track.gives_images else None,
        )
        return track.run(entry, split, place / "inputs", place, workers=workers, limits=limits, step=advance)
