"""``rsbench reproduce laws``: frames rendered once, all boards in one site, predictions by protocol."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from analytic_dataset import write_analytic_dataset
from leaderboards import PLANES, jobs_here

from rsbench.benchmark.leaderboard import motion_tracks, running
from rsbench.benchmark.leaderboard.board import entries_of, restore, splits_of
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.cli import generate, reproduce_leaderboard
from rsbench.cli.reproduce import Target, reproduce

ENTRIES = {"pose-2": ["gs-p3p", "gs-8pt"], "readout-3": ["rs-stereo-refined"], "correction-3": ["rotation-only"]}


def _nothing_left(serve: Any, jobs: Any, *arguments: object) -> Any:
    assert not jobs
    yield from ()


def test_one_command_makes_all_boards_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, str]] = []

    def render(card: str, out: str, sequence: None, workers: int) -> None:
        asked.append((card, out))
        if len(asked) == 1:
            write_analytic_dataset(Path(out), *PLANES, twins=(40,))

    monkeypatch.setattr(generate, "generate", render)
    monkeypatch.setattr(reproduce_leaderboard, "entries_of_laws", lambda: ENTRIES)
    monkeypatch.setattr(running, "finished_jobs", jobs_here)
    out, data = tmp_path / "results", tmp_path / "data"
    reproduce(Target.laws, out, data, workers=1)
    frames, folder = data / "laws-frames", out / "laws"
    assert asked == [("laws", str(frames))]
    splits = dict(splits_of(data / "laws"))
    assert set(splits) == set(ENTRIES)
    stored = {path.name: {each.name for each in path.iterdir()} for path in (folder / "predictions").iterdir()}
    assert stored == {
        "pose-2": {"gs-p3p.jsonl.xz", "gs-8pt.jsonl.xz", "truth.jsonl.xz"},
        "readout-3": {"rs-stereo-refined.jsonl.xz", "constant.jsonl.xz", "truth.jsonl.xz"},
    }
    made = json.loads((folder / "provenance.json").read_text("utf-8"))
    assert made["command"] == "rsbench reproduce laws"
    assert f"correction-3/{splits['correction-3']}/uncorrected" in made["entries"]
    page = (folder / "site" / "index.html").read_text("utf-8")
    assert all(f"{protocol}--{split}" in page for protocol, split in splits.items())
    # What is stored of frames scores as it did; a second run answers nothing again.
    split = TRACKS["pose-2"].split(frames)
    restore(folder / "predictions" / "pose-2", split, tmp_path / "again")
    first, again = (
        {
            each.header.method: each.scores["auc_apart"].to_list()
            for each in entries_of(board, "pose-2", split.name)
        }
        for board in (data / "laws", tmp_path / "again")
    )
    assert first == again and len(first) == 3
    monkeypatch.setattr(running, "finished_jobs", _nothing_left)
    reproduce(Target.laws, out, data, workers=1)


def test_entries_of_laws_answer_what_is_asked() -> None:
    """Each is taken by its track; the one that chooses a law is with the solvers and the readers."""
    entries = reproduce_leaderboard.entries_of_laws()
    for protocol, names in entries.items():
        TRACKS[protocol].load(names)
        assert len(set(names)) == len(names)
    choosers = {protocol for protocol, names in entries.items() if motion_tracks.CHOOSES in names}
    assert choosers == {"points-2", "pose-2", "readout-3"} and entries["points-2"] == entries["pose-2"]
    assert "gyro" not in entries["correction-3"]
