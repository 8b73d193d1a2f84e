"""What is nearer to the truth than its data allow has no rank; names of rsbench are its own."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from commands import assert_refused, run_here
from leaderboards import Line, named, small_split, truth_lines, write

from rsbench.benchmark.leaderboard.adding import add
from rsbench.benchmark.leaderboard.board import RUN, accept, entries_of, rescore
from rsbench.benchmark.leaderboard.motion_tracks import bound_text
from rsbench.benchmark.leaderboard.splits import points_split
from rsbench.benchmark.leaderboard.standings import standings, table
from rsbench.benchmark.leaderboard.track_list import TRACKS
from rsbench.core.errors import RsbenchError
from rsbench.report.board_page import build_site

SPLIT, SMALL = small_split(60), small_split()


@pytest.fixture(scope="module")
def at_bound() -> list[Line]:
    """Motions that err as the bound of all links allows."""
    return [json.loads(line) for line in bound_text(SPLIT, SPLIT.seed).splitlines()]


def handed(lines: list[Line], method: str, *uses: str) -> list[Line]:
    return [{**lines[0], "method": method, "uses": list(uses)}, *lines[1:]]


def test_a_method_at_its_bound_is_believed_and_one_below_it_is_not(tmp_path: Path, at_bound: list[Line]) -> None:
    board = tmp_path / "board"
    honest = handed(at_bound, "honest", "left", "right", "links", "readout")
    scored = add(board, write(tmp_path / "a.jsonl", honest), SPLIT, {})
    assert scored.doubt == ""
    for name, medians in SPLIT.track.medians_at_bound(honest[0]["uses"], SPLIT).items():
        # A draw from the bound is below its median in half of the problems: of 60, in 17 to 43, at 1 in 1000.
        assert 17 <= np.count_nonzero(scored.scores[name].to_numpy() < medians) <= 43
    # The same answers, said to be of less: twice too near where one camera's matches are all that it saw.
    scored = add(board, write(tmp_path / "b.jsonl", handed(at_bound, "boasting", "left")), SPLIT, {})
    assert scored.doubt.startswith("e_R_deg is below the median at the Cramer-Rao bound of left in ")
    lines = {line.scored.header.method: line for line in standings(entries_of(board, "points-1", SPLIT.name))}
    assert lines["boasting"].rank is None and lines["boasting"].rank_words == "in doubt"
    assert lines["honest"].rank is not None and lines["honest"].rank_words == "alone"
    assert rescore(board, SPLIT) == {}, "doubts are found again"
    page = build_site(board, tmp_path / "site", ()).read_text("utf-8")
    assert page.count('class="entry oracle handed-in doubt"') == 1 and page.count("handed in</span>") == 2
    assert accept(board, "points-1", SPLIT.name, "boasting", "seen by us") == scored.doubt
    ranked = standings(entries_of(board, "points-1", SPLIT.name))
    assert all(line.rank is not None for line in ranked)
    with pytest.raises(RsbenchError, match="nothing speaks against it"):
        accept(board, "points-1", SPLIT.name, "honest", "why not")


def test_the_truth_under_another_name_is_in_doubt(tmp_path: Path) -> None:
    lines = handed(truth_lines(SMALL), "mine", "left")
    scored = add(tmp_path / "board", write(tmp_path / "a.jsonl", lines), SMALL, {})
    assert scored.doubt.startswith("error_deg is below 1e-05, exact but for rounding, in 1.00 ")
    numbers = table(standings(entries_of(tmp_path / "board", "points-1", SMALL.name)))
    assert numbers["rank"].isna().all() and numbers["handed_in"].all() and numbers["doubt"].notna().all()


@pytest.mark.parametrize(
    "name", ["rs-stereo-refined", "RS-Stereo-Refined", "sgm", "fusion", "cramer-rao", "truth"]
)
def test_names_of_rsbench_are_its_own(tmp_path: Path, name: str) -> None:
    lines = handed(truth_lines(SMALL), name, "left")
    with pytest.raises(RsbenchError, match=f"method = '{name}': is the name of a method of rsbench"):
        add(
            tmp_path / "board",
            write(tmp_path / "a.jsonl", lines),
            SMALL,
            {"command": "rsbench leaderboard submit"},
        )
    assert not add(tmp_path / "own", write(tmp_path / "a.jsonl", lines), SMALL, {"command": RUN}).handed_in


def test_the_commands_say_it(tmp_path: Path) -> None:
    file = write(tmp_path / "a.jsonl", named(truth_lines(points_split(TRACKS["points"])), "mine"))
    text = file.read_text("utf-8").replace('"truth"', '"left"', 1)
    file.write_text(text, "utf-8")
    board = tmp_path / "board"
    ran = run_here("leaderboard", "submit", file, "--board", board)
    assert ran.returncode == 0 and "in doubt, and not ranked: error_deg is below 1e-05" in ran.stdout, ran.stderr
    words = [
        "leaderboard",
        "accept",
        "mine",
        "--board",
        board,
        "--protocol",
        "points-1",
        "--split",
        points_split(TRACKS["points"]).name,
    ]
    assert_refused(run_here(*words, "--reason", " "), "--reason")
    ran = run_here(*words, "--reason", "a test of ours")
    assert ran.returncode == 0 and ran.stdout.startswith("mine: ranked all the same: error_deg")
