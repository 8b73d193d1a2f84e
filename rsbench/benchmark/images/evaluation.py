"""Evaluation of a dataset: predictions, then scores, then the record of how they came about."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import pandas as pd

from rsbench.benchmark.images.predict import EvaluationOptions, Step, predict_sequence
from rsbench.benchmark.images.score import score_correction, score_depth, score_poses
from rsbench.benchmark.provenance import dataset_record, provenance
from rsbench.dataset.files import write_bytes, write_json
from rsbench.dataset.sequence import read_dataset
from rsbench.errors import RsbenchError

TABLES = ("pose", "depth", "correction")


def evaluation_steps(dataset: Path, options: EvaluationOptions) -> int:
    """How often ``run_evaluation`` reports progress.

    Raises:
        RsbenchError: the dataset cannot be read.
    """
    return len(read_dataset(dataset)) * (options.steps() + 1)


def run_evaluation(dataset: Path, out: Path, options: EvaluationOptions, command: str, step: Step) -> None:
    """Predict and score every sequence; writes predictions/, scores/*.csv and provenance.json below ``out``.

    Predictions made before from the same data, cards and options are kept.

    Raises:
        RsbenchError: the dataset cannot be read, a solver card does not exist, or ``out`` cannot be written.
    """
    sequences = read_dataset(dataset)
    try:
        (out / "scores").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RsbenchError(f"{out}: cannot be written: {error.strerror}; choose another --out") from error
    rows: dict[str, list[dict[str, object]]] = {table: [] for table in TABLES}
    for sequence in sequences:
        folder = out / "predictions" / sequence.name
        predict_sequence(sequence, options, folder, step)
        rows["pose"] += score_poses(sequence, folder)
        rows["depth"] += score_depth(sequence, folder)
        rows["correction"] += score_correction(sequence, folder, options.correction_solver)
        step(sequence.name)
    for table, content in rows.items():
        text = pd.DataFrame(content).to_csv(index=False, float_format="%.6g", lineterminator="\n")
        write_bytes(out / "scores" / f"{table}.csv", text.encode())
    record = provenance(
        command, **dataset_record(dataset), seed=options.seed, solvers=list(options.solvers),
        correction_solver=options.correction_solver, matcher=asdict(options.sgm),  # type: ignore[call-overload]
    )  # fmt: skip
    write_json(out / "provenance.json", record)


def read_scores(out: Path, table: str) -> pd.DataFrame:
    """One of ``TABLES`` of an evaluation.

    Raises:
        RsbenchError: the evaluation is not there.
    """
    path = out / "scores" / f"{table}.csv"
    if not path.is_file():
        raise RsbenchError(f"{path}: no such scores; make them with: rsbench evaluate DIR --out {out}")
    return pd.read_csv(path)
