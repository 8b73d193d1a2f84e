"""The tracks of frames in the smoke run: a few entries of each, on small sequences that are rendered for it."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import pandas as pd

from rsbench.benchmark.leaderboard.exporting import write_matches
from rsbench.benchmark.leaderboard.frames import (
    FEATURES,
    bare_problems,
    matched_problems,
    read_frames,
    write_frames,
)
from rsbench.benchmark.leaderboard.marking import mark
from rsbench.benchmark.leaderboard.own_matches import FOLDER as MATCHES
from rsbench.benchmark.leaderboard.picture_oracles import write_oracles
from rsbench.benchmark.leaderboard.picture_running import run_picture_cards
from rsbench.benchmark.leaderboard.protocols import PROTOCOLS, Asks
from rsbench.benchmark.leaderboard.running import (
    answer_problem,
    header_of,
    load_entries,
    prepare_inputs,
    read_inputs,
    run_cards,
)
from rsbench.benchmark.leaderboard.splits import Split, dataset_split
from rsbench.benchmark.leaderboard.submissions import read_submission, submission_text, truth_text
from rsbench.dataset.sequence import read_dataset_manifest
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.frame_motion import find_matches_of_rig
from rsbench.pipeline.isolated_solver import SolverRunner
from rsbench.storage.files import write_bytes
from rsbench.vision.feature_matcher import load_features

CARD = "leaderboard-smoke"
"""The dataset's."""
ORACLES = ("truth", "constant", "uncorrected", "fusion-true")
"""Entries that are no cards."""
_SOLVERS = ("rs-stereo-refined", "gs-stereo-tracks-scaled", "truth")
ENTRIES = {
    "pose": _SOLVERS,
    "pose-own": _SOLVERS,
    "readout": ("rs-stereo-refined", "rs-stereo-refined-pairs", "truth"),
    "depth": ("sgm", "sweep", "sgm-plain", "constant", "truth"),
    "correction": ("fusion", "zhuang", "uncorrected", "fusion-true", "truth"),
}
"""By track: what rsbench has by default, the strongest of the others that cost little, and oracles."""
_METRICS: dict[Asks, tuple[str, ...]] = {
    "motion": ("e_R_deg", "e_T_deg", "e_s", "metres", "e_row_deg", "nees"),
    "readout": ("e_readout",),
    "depth": (
        *(f"bad_{part}" for part in ("1", "2", "3", "1_visible", "1_occluded")),
        "coverage",
        "on_sky",
        "abs_rel",
        "rmse_m",
    ),
    # Without FLIP, whose package has no wheel for some systems.
    "frames": (
        *(f"ssim{part}" for part in ("", "_covered", "_all", "_deepunroll", "_uniform")),
        *(f"psnr{part}" for part in ("", "_covered", "_all", "_first", "_middle")),
        "coverage",
        "epe_px",
    ),
}


def metrics_of(track: str) -> tuple[str, ...]:
    """Columns of scores that are compared."""
    protocol = PROTOCOLS[track]
    return _METRICS[protocol.asks] + (("matches", "matches_1px") if protocol.own_matches else ())


def track_scores(track: str, data: Path, entries: Sequence[str], problems: int | None = None) -> pd.DataFrame:
    """Scores of entries on the first sequences of a dataset, made as anybody's: inputs, answers, marks.

    Returns:
        A row for each entry and problem: method, problem, success, ``metrics_of`` the track.

    Raises:
        RsbenchError: no such dataset or entry.
    """
    split, tables = dataset_split(PROTOCOLS[track], data), list[pd.DataFrame]()
    split = replace(split, truths=split.truths[:problems])
    with tempfile.TemporaryDirectory() as folder:
        inputs = Path(folder) / "inputs"
        frames = "images" in split.protocol.allowed
        prepare_inputs(
            split,
            lambda: islice((bare_problems if frames else matched_problems)(data), len(split.truths)),
            inputs,
            lambda place: write_frames(data, place) if frames else None,
        )
        for path in _answers(split, entries, inputs, Path(folder)):
            submission = read_submission(path, split)
            scores = mark(submission, split).assign(method=submission.header.method)
            tables.append(scores[["method", "problem", "success", *metrics_of(track)]])
    return pd.concat(tables, ignore_index=True)


def _answers(split: Split, entries: Sequence[str], inputs: Path, work: Path) -> Iterator[Path]:
    """Files of answers; cards run in this process."""
    cards = [name for name in entries if name not in ORACLES]
    if split.protocol.own_matches:
        yield from _with_own_matches(cards, split, inputs, work)
    elif cards:
        run = run_picture_cards if split.protocol.pictures else run_cards
        yield from run(cards, split, inputs, work, workers=0)
    if len(cards) == len(entries):
        return
    if split.protocol.pictures:
        yield from (path for path in write_oracles(split, work / "oracles") if path.parent.name in entries)
    else:
        path = work / "truth.jsonl"
        write_bytes(path, truth_text(split).encode())
        yield path


def _with_own_matches(cards: Sequence[str], split: Split, inputs: Path, work: Path) -> Iterator[Path]:
    """Solvers on matches of the frames, which are handed in too."""
    options, runner = CorrectionOptions(features=load_features(FEATURES)), SolverRunner(single_thread=True)
    given = [
        replace(
            each,
            correspondences=find_matches_of_rig(
                read_frames(inputs, each), each.rig, each.shutter.scanning, options
            ),
        )
        for each in read_inputs(inputs, split.protocol)
    ]
    for entry in load_entries(cards, PROTOCOLS["pose"]).values():
        header = header_of(entry, split)
        header["uses"] = [*header["uses"], "images"]
        path = work / entry.name / "predictions.jsonl"
        write_matches(given, path.parent / MATCHES)
        answers = (answer_problem(each, entry, runner) for each in given)
        write_bytes(path, submission_text(header, answers).encode())
        yield path


def hashes_of_frames(data: Path) -> dict[str, str]:
    """Of each sequence of a dataset, a hash of its images and depth maps."""
    manifest, found = read_dataset_manifest(data), dict[str, str]()
    for name in manifest.sequences:
        pictures = [
            f"{path} {each.sha256}\n"
            for path, each in sorted(manifest.files.items())
            if path.startswith(f"{name}/") and path.endswith((".png", ".exr"))
        ]
        found[name] = hashlib.sha256("".join(pictures).encode()).hexdigest()
    return found
