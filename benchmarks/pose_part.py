"""Entries of pose-2 again on every n-th problem, beside what the stored entries answered there.

    rsbench leaderboard run readout-3 --entry rs-stereo-refined --data laws --board board    (exports the matches)
    python benchmarks/pose_part.py laws board/.rsbench/runs/readout-3/laws-*/inputs --every 3 --out answers.jsonl

The matches are those of pose-2 (SIFT of the same frames); readout-3 exports them without the ratio, which is taken
from the truth, as pose-2 gives it. Answers are kept in ``--out``, so that a run goes on where it was stopped. A
part ranks nothing: it shows what a change of a solver does, on the same problems. The problems of a scene come in
twenties, of which every second has a real sensor: an odd ``--every`` has both.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pandas as pd

from rsbench.benchmark.leaderboard.board import entries_of, restore
from rsbench.benchmark.leaderboard.deviations import calibration
from rsbench.benchmark.leaderboard.inputs import read_inputs
from rsbench.benchmark.leaderboard.motion_tracks import CHOOSES, MotionTrack
from rsbench.benchmark.leaderboard.submissions import method_header, read_submission, submission_text
from rsbench.benchmark.leaderboard.track import Split, mark
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.benchmark.statistics import format_interval
from rsbench.pipeline.isolated_components import SolverRunner


def answer(split: Split, inputs: Path, cards: Sequence[str], names: Sequence[str], out: Path) -> None:
    """Append the answers that ``out`` lacks, a line each."""
    track = split.track
    assert isinstance(track, MotionTrack)
    problems = {each.name: each for each in read_inputs(inputs, TRACKS["readout-3"])}
    done = {(each["card"], each["name"]) for each in _lines(out)}
    with out.open("a", encoding="utf-8") as file, SolverRunner(single_thread=True) as runner:
        for name in names:
            problem = replace(problems[name], known_shutter=split.by_name[name].shutter)
            for card in cards:
                if (card, name) not in done:
                    found = track.answer(problem, track.entry_of(card), runner)
                    file.write(json.dumps({"card": card, **found}) + "\n")
                    file.flush()


def _lines(path: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in path.read_text("utf-8").splitlines()] if path.is_file() else []


def scores_of(split: Split, card: str, out: Path) -> pd.DataFrame:
    """Scores of the kept answers of a card, as on a board; the other problems count as failures."""
    found = {
        each["name"]: {k: v for k, v in each.items() if k != "card"}
        for each in _lines(out)
        if each["card"] == card
    }
    answers = [found.get(name, {"name": name, "success": False, "reason": "not run"}) for name in split.by_name]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "predictions.jsonl"
        path.write_text(
            submission_text(method_header(split, f"{card}-part", ["left"], "a part"), answers), "utf-8"
        )
        return mark(read_submission(path, split), split)


def line_of(title: str, scores: pd.DataFrame) -> str:
    """Medians of the errors, coverage and log score of some problems."""
    found = calibration(scores, 6)
    assert found is not None and found.log_score is not None
    medians = ", ".join(f"{scores[name].median():.4g}" for name in ("e_R_deg", "e_T_deg"))
    covers, gain = format_interval(*found.covers[-1]), format_interval(*found.log_score)
    return f"| {title} | {len(scores)} | {medians} | {scores['auc_apart'].mean():.3f} | {covers} | {gain} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("inputs", type=Path)
    parser.add_argument("--every", type=int, default=3)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--card", action="append")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    split, cards = TRACKS["pose-2"].split(options.data), options.card or [CHOOSES, "rs-stereo-refined"]
    names = list(split.by_name)[options.first :: options.every]
    answer(split, options.inputs, cards, names, options.out)
    head = ("entry", "problems", "e_R, e_T (deg), median", "AUC apart, mean", "in 95 %", "log score")
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    with tempfile.TemporaryDirectory() as folder:
        restore(Path("results/laws/predictions/pose-2"), split, Path(folder))
        stored = {e.header.method: e.scores for e in entries_of(Path(folder), split.track.id, split.name)}
    for card in cards:
        for title, scores in (("stored", stored[card]), ("now", scores_of(split, card, options.out))):
            lines.append(line_of(f"{card}, {title}", scores[scores["problem"].isin(names)]))
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
