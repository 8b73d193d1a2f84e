"""docs/reference/score-files.md against the files that evaluations and sweeps write."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from rsbench.benchmark.images.evaluation import open_evaluation
from rsbench.benchmark.images.plan import EvaluationOptions
from rsbench.benchmark.simulated.run_sweep import run_sweep, summarise_sweep
from rsbench.benchmark.simulated.sweep_card import load_sweep

DOCUMENT = (Path(__file__).parents[2] / "docs" / "reference" / "score-files.md").read_text("utf-8")


def documented(section: str) -> list[str]:
    """Names in the first column of the table of a section, in order."""
    text = re.split(r"^#+ ", DOCUMENT.split(f"\n### {section}\n")[1], flags=re.MULTILINE)[0]
    rows = [row.split("|")[1] for row in text.splitlines() if row.startswith("| `")]
    return [name for row in rows for name in re.findall(r"`([^`]+)`", row)]


@pytest.fixture(scope="module")
def evaluation(smoke_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("evaluation")
    options = EvaluationOptions(solvers=("gs-8pt",), only=("castle",))
    open_evaluation(smoke_dataset, out, options).run("test", lambda word: None)
    return out


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from dataclasses import replace

    out = tmp_path_factory.mktemp("sweep")
    card = load_sweep("noise")
    run_sweep(replace(card, trials=3, values=card.values[:1], solvers=("gs-8pt",)), out)
    summarise_sweep(out)
    return out


@pytest.mark.parametrize("table", ["pose", "depth", "correction", "failures", "seconds"])
def test_every_column_of_an_evaluation_is_documented(evaluation: Path, table: str) -> None:
    written = pd.read_csv(evaluation / "scores" / f"{table}.csv")
    assert list(written) == documented(f"{table}.csv")


def test_every_key_of_the_records_is_documented(evaluation: Path) -> None:
    folder = evaluation / "predictions" / "castle"
    motion = json.loads((folder / "motion" / "gs-8pt.json").read_text())
    assert sorted(motion) == sorted(documented("motion.json"))
    columns = json.loads((evaluation / "scores" / "columns.json").read_text())
    assert all(list(column) == documented("columns.json") for table in columns.values() for column in table)
    text = set(documented(r"predictions/\<sequence\>")) | set(re.findall(r"`(\w+)`", DOCUMENT))
    for name in ("matches", "depth/sgm", "corrected/fusion+rs-stereo-refined+sgm"):
        assert set(json.loads((folder / f"{name}.json").read_text())) <= text | {"identity"}


def test_every_column_of_a_sweep_is_documented(sweep: Path) -> None:
    assert list(pd.read_csv(sweep / "summary.csv")) == documented("summary.csv")
    for kind in ("trials", "bounds"):
        with np.load(sweep / kind / "000.npz", allow_pickle=False) as stored:
            assert sorted(stored.files) == sorted(documented(f"{kind}.npz"))


def test_the_documented_metric_is_a_metric(smoke_dataset: Path, evaluation: Path, tmp_path: Path) -> None:
    for block in re.findall(r"^```\w+\n# (\S+)\n(.*?)^```", DOCUMENT, flags=re.DOTALL | re.MULTILINE):
        (tmp_path / block[0]).write_text(block[1])
    options = EvaluationOptions(
        solvers=("gs-8pt",), metrics=(str(tmp_path / "worst-pixel.toml"),), only=("castle", "gs-8pt")
    )
    open_evaluation(smoke_dataset, evaluation, options).run("test", lambda word: None)
    scores = pd.read_csv(evaluation / "scores" / "correction.csv")
    assert scores["worst_pixel"].between(1.0, 255.0).all()
