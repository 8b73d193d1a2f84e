"""``rsbench reproduce``: the committed results, made again."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    import pandas as pd

EPILOG = """[bold]Examples[/bold]

  rsbench reproduce images --out results --data data       [dim](what results/images holds)[/dim]

  rsbench reproduce fig3 --out results                     [dim](simulated points: results/fig3)[/dim]

  rsbench reproduce claims --out results                   [dim](results/claims; runs fig3 first)[/dim]

  rsbench reproduce sweeps --out results                   [dim](results/sweeps: limits, degeneracies)[/dim]

  rsbench reproduce fig4 --out results --data data         [dim](renders 21 sequences first: minutes)[/dim]"""
_OTHER_SWEEPS = ("solvers", "limit", "degenerate", "planar", "outliers", "wrong-readout", "wrong-motion")


class Target(StrEnum):
    """What can be reproduced."""

    images = "images"
    fig3 = "fig3"
    claims = "claims"
    readings = "readings"
    sweeps = "sweeps"
    fig4 = "fig4"
    correction = "correction"
    sgm = "sgm"


def reproduce(
    target: Annotated[
        Target,
        typer.Argument(
            help="images: the paper's image experiment in the three built-in scenes. fig3: its Figure 3 on "
            "simulated points. claims: what became of each claim of its text. readings: the claims in every "
            "reading of the paper's solver and in settings that it does not state. sweeps: the other simulations. "
            "fig4: its Figure 4 in every scene, for three motions. correction: baselines, ours and oracles on the "
            "strata mild, moderate and aggressive. sgm: stereo matching when the cameras' rows are not in step."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = Path("results"),
    data: Annotated[Path, typer.Option(help="Folder for the rendered data and simulated trials.")] = Path("data"),
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes of simulations; default: one per core.")
    ] = None,
) -> None:
    """Make the committed results again: render or simulate what is missing, run, score, draw."""
    if target is Target.images:
        _images(out, data)
    elif target is Target.sweeps:
        _sweeps(out, data, workers)
    elif target is Target.readings:
        _readings(out, data, workers)
    elif target in (Target.fig4, Target.correction, Target.sgm):
        _correction(target, out, data)
    else:
        _fig3(out, data, workers)
        if target is Target.claims:
            _claims(out, data, workers)


def _correction(target: Target, out: Path, data: Path) -> None:
    from rsbench.cli import reproduce_correction

    getattr(reproduce_correction, target.value)(out, data)


def _images(out: Path, data: Path) -> None:
    from rsbench.cli.evaluate import evaluate_dataset
    from rsbench.cli.generate import generate
    from rsbench.report.evaluation_page import publish

    generate("paper", data / "paper", None, workers=1)
    evaluation = data / "paper-evaluation"
    evaluate_dataset(data / "paper", evaluation, None, "rsbench reproduce images")
    typer.echo(f"published: {publish(evaluation, out / 'images')}")


def _simulate(name: str, points: int | None, data: Path, workers: int | None, command: str) -> pd.DataFrame:
    """Summary of a sweep, with another number of matches per camera if given; its trials stay in ``data``."""
    from rsbench.benchmark.simulated.sweep_card import load_sweep
    from rsbench.cli.simulate import run_and_summarise

    card = load_sweep(name)
    folder = data / "simulated" / (name if points is None else f"{name}-{points}")
    return run_and_summarise(
        card if points is None else card.with_setting(points=points), folder, workers, command
    )


def _fig3(out: Path, data: Path, workers: int | None) -> None:
    from rsbench.benchmark.provenance import provenance
    from rsbench.benchmark.simulated.sweep_card import load_sweep
    from rsbench.dataset.files import write_bytes, write_json, write_table
    from rsbench.report.fig3 import SWEEPS, draw_fig3, fig3_page, setting_table

    folder = out / "fig3"
    folder.mkdir(parents=True, exist_ok=True)
    command = "rsbench reproduce fig3"
    for name in SWEEPS:
        write_table(folder / f"{name}.csv", _simulate(name, None, data, workers, command))
    cards = [load_sweep(name) for name in SWEEPS]
    settings = setting_table(cards)
    write_table(folder / "settings.csv", settings)
    write_bytes(folder / "README.md", fig3_page(settings).encode())
    seeds = {card.name: card.seed for card in cards}
    write_json(folder / "provenance.json", provenance(command, sweeps=list(SWEEPS), seeds=seeds))
    for path in draw_fig3(folder):
        typer.echo(f"figure: {path}")


def _sweeps(out: Path, data: Path, workers: int | None) -> None:
    from rsbench.benchmark.provenance import provenance
    from rsbench.benchmark.simulated.sweep_card import load_sweep
    from rsbench.dataset.files import write_bytes, write_json, write_table
    from rsbench.report.sweep_pages import sweeps_page

    folder = out / "sweeps"
    folder.mkdir(parents=True, exist_ok=True)
    command = "rsbench reproduce sweeps"
    for name in _OTHER_SWEEPS:
        write_table(folder / f"{name}.csv", _simulate(name, None, data, workers, command))
    page = sweeps_page([load_sweep(name) for name in _OTHER_SWEEPS])
    write_bytes(folder / "README.md", page.encode())
    write_json(folder / "provenance.json", provenance(command, sweeps=list(_OTHER_SWEEPS)))
    typer.echo(f"tables: {folder}")


def _claims(out: Path, data: Path, workers: int | None) -> None:
    from rsbench.benchmark.provenance import provenance
    from rsbench.benchmark.studies.claims import judge_claims
    from rsbench.dataset.files import write_bytes, write_json, write_table
    from rsbench.report.claims_page import claims_page
    from rsbench.report.fig3 import SWEEPS, read_summaries

    folder = out / "claims"
    folder.mkdir(parents=True, exist_ok=True)
    command = "rsbench reproduce claims"
    for name in SWEEPS:
        write_table(folder / f"{name}-9.csv", _simulate(name, 9, data, workers, command))
    write_table(folder / "points.csv", _simulate("points", None, data, workers, command))
    verdicts = judge_claims(
        {
            "100 + 100": read_summaries(out / "fig3", SWEEPS),
            "9 + 9": read_summaries(folder, SWEEPS, "-9"),
            "9 + 9 and more": read_summaries(folder, ("points",)),
        }
    )
    write_table(folder / "claims.csv", verdicts)
    page = folder / "README.md"
    write_bytes(page, claims_page(verdicts).encode())
    write_json(folder / "provenance.json", provenance(command, sweeps=[*SWEEPS, "points"]))
    typer.echo(f"claims: {page}")


def _readings(out: Path, data: Path, workers: int | None) -> None:
    """Every claim in every reading of the paper's solver, and in settings that the paper does not state."""
    from rsbench.benchmark.simulated.sweep_card import load_sweep
    from rsbench.benchmark.studies import readings
    from rsbench.cli.simulate import run_and_summarise
    from rsbench.dataset.files import write_bytes, write_table
    from rsbench.report.fig3 import SWEEPS
    from rsbench.report.readings_page import readings_page

    folder, home = out / "readings", data / "simulated" / "readings"
    folder.mkdir(parents=True, exist_ok=True)
    command = "rsbench reproduce readings"
    cards = readings.write_cards(home / "cards", readings.SOLVER_READINGS)
    tables: dict[str, dict[str, pd.DataFrame]] = {}
    for matches in (100, 9):
        sweeps = tables.setdefault(f"{matches} + {matches}", {})
        for name in SWEEPS:
            card = readings.readings_card(load_sweep(name).with_setting(points=matches), cards)
            sweeps[name] = run_and_summarise(card, home / f"{name}-{matches}", workers, command)
    points = readings.readings_card(load_sweep("points"), cards)
    more = {"points": run_and_summarise(points, home / "points", workers, command)}
    judged = readings.judge_readings({**tables, "9 + 9 and more": more}, cards)
    write_table(folder / "readings.csv", judged)
    best = readings.best_readings(judged)
    write_table(folder / "best-readings.csv", best)
    chosen = {path: reading for path, reading in cards.items() if str(reading) in ("literal", "symmetric")}
    grids = {}
    for name in SWEEPS:
        card = readings.settings_card(load_sweep(name), chosen)
        grids[name] = run_and_summarise(card, home / f"{name}-settings", workers, command)
    settings = readings.judge_settings(grids, chosen)
    write_table(folder / "settings.csv", settings)
    page = folder / "README.md"
    write_bytes(page, readings_page(best, readings.holding_settings(settings)).encode())
    typer.echo(f"readings: {page}")


def register(app: typer.Typer) -> None:
    app.command(epilog=EPILOG)(reproduce)
