"""``rsbench reproduce claims`` from simulation to page, with few trials."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from rsbench.benchmark.simulated import run_sweep, sweep_card
from rsbench.benchmark.studies import claims
from rsbench.benchmark.studies.claims import CLAIMS
from rsbench.cli import reproduce as command
from rsbench.cli.reproduce import Target, reproduce
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.report import paper_figures
from rsbench.report.paper_figures import SWEEPS


@pytest.mark.slow
def test_claims_and_figure_come_from_the_stored_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    complete = sweep_card.load_sweep

    def short(name: str) -> sweep_card.SweepCard:
        card = complete(name)
        values = {"noise": (1e-4, 1e-3, 0.81), "points": (9, 20)}.get(name, (card.values[0], card.values[-1]))
        return replace(card, trials=2, values=values)

    def touch(tables: object, variant: str, centre: str, stem: Path) -> list[Path]:
        paths = [stem.with_suffix(ending) for ending in (".pdf", ".png")]
        for path in paths:
            path.touch()
        return paths

    def run_here(todo: list[run_sweep._Job], workers: int, limit: float | None) -> Iterator[run_sweep._Part]:
        with SolverRunner() as runner:
            for job in todo:
                run_sweep.run_job(job, runner)
                yield job.part

    monkeypatch.setattr(sweep_card, "load_sweep", short)
    monkeypatch.setattr(claims, "SETTINGS", {"points": (9, 20), "baseline": (0.2, 0.6)})
    monkeypatch.setattr(claims, "GRID_TRIALS", 2)
    for name in ("SOLVER_READINGS", "NINE_READINGS"):
        chosen = tuple(one for one in getattr(claims, name) if str(one) in ("literal", "symmetric"))
        monkeypatch.setattr(claims, name, chosen)
    monkeypatch.setattr(paper_figures, "_draw_fig3", touch)  # test_fig3 draws: it takes seconds
    monkeypatch.setattr(run_sweep, "_run_all", run_here)  # starting processes would take most of the time
    out, data = tmp_path / "results", tmp_path / "data"
    reproduce(Target.claims, out, data, workers=2)
    names = {path.name for path in (out / "fig3").iterdir()}
    assert names >= {f"{name}.csv" for name in SWEEPS} | {"settings.csv", "provenance.json", "README.md"}
    assert names >= {
        f"fig3-{end}-{c}.{kind}"
        for end in ("px", "normalised")
        for c in ("mean", "median")
        for kind in ("pdf", "png")
    }
    with np.load(out / "fig3" / "trials.npz") as stored_errors:
        for name in SWEEPS:
            table = pd.read_csv(out / "fig3" / f"{name}.csv")
            # Single precision, and six digits in the table.
            np.testing.assert_allclose(
                np.mean(stored_errors[f"{name}_e_R_deg"], axis=1), table.e_R_mean, rtol=1e-5
            )
    verdicts = pd.read_csv(out / "claims" / "claims.csv")
    assert set(verdicts.matches) == {"100 + 100", "9 + 9", "9 + 9 and more"}
    assert verdicts.verdict.str.match("holds|fails|undecided").all()
    page = (out / "claims" / "README.md").read_text()
    assert "Rule: " in page and "nan" not in page
    best = pd.read_csv(out / "claims" / "best-readings.csv")
    assert set(best.claim) == {claim.key for claim in CLAIMS}
    assert set(best[best.matches == "9 + 9"].readings) >= {1, 4}  # symmetric or not, any nine or nine far apart
    stored = pd.read_csv(out / "claims" / "rotation-9.csv")
    assert set(stored.trials) == {2} and set(stored.value) == {0.25, 8.0}
    record = json.loads((out / "claims" / "provenance.json").read_text())
    assert record["command"] == "rsbench reproduce claims"
    reproduce(Target.readings, out, data, workers=2)
    grid = pd.read_csv(out / "readings" / "settings.csv")
    assert set(grid.reading) == {"literal", "symmetric"}
    assert set(grid[grid.claim == "baseline: no impact"].setting) == {"points 9"}


def test_everything_makes_each_folder_of_results_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made: list[str] = []
    monkeypatch.setattr(command, "_reproduce", lambda target, *rest: made.append(target.value))
    reproduce(Target.everything, tmp_path / "out", tmp_path / "data")
    folders = {folder.name for folder in (Path(__file__).parents[2] / "results").iterdir() if folder.is_dir()}
    # Made by programs in benchmarks/, which their provenance names.
    apart = {"gyro", "r6p", "rectify", "solvers", "speed", "trajectory", "tuning"}
    # Claims make Figure 3 too, boards write beside leaderboard.
    assert {*made, "fig3"} == folders - apart | {"image-claims", "boards"}
    # Judged from what the others have stored.
    assert made[-1] == "image-claims" and len(set(made)) == len(made)
    lines = capsys.readouterr().out.splitlines()
    # Before each, how long it and the rest take, by how long the others took: at once, as if made before.
    assert lines[0].startswith(f"[1 of {len(made)}] {made[0]}: about 3 minutes on two cores; with what follows 14")
    assert lines[::2][:-1] == [each for each in lines if each.startswith("[")]
    assert lines[-3].endswith(
        "image-claims: about 1 minute on two cores; judges what the other targets have written: make them first"
    )
    printed = [line.partition(":")[0] for line in lines if not line.startswith("[")]
    assert printed == [*made, "everything"]
    assert command._left([Target.fig4, Target.sgm], [0.0, 2.0]).startswith("about 4 minutes")
