"""Two planes as problems of the tracks that ask for pictures."""

from __future__ import annotations

from pathlib import Path

import pytest
from analytic_dataset import write_analytic_dataset
from leaderboards import ASK_PICTURES, PLANES

from rsbench.benchmark.leaderboard.track import Split
from rsbench.benchmark.leaderboard.tracks import TRACKS


@pytest.fixture(scope="module")
def planes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two planes in three frames, which are two problems, with the middle row's truth."""
    folder = tmp_path_factory.mktemp("planes")
    write_analytic_dataset(folder, *PLANES, frames=3, twins=(40,))
    return folder


@pytest.fixture(scope="module")
def splits(planes: Path) -> dict[str, Split]:
    return {track: TRACKS[track].split(planes) for track in ASK_PICTURES}
