"""Targets of ``rsbench reproduce`` on simulated points: fig3, claims, image-claims, readings, sweeps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rsbench.benchmark.provenance import provenance
from rsbench.benchmark.simulated.run_sweep import errors_of_rows
from rsbench.benchmark.simulated.sweep_card import load_sweep
from rsbench.benchmark.studies.claims import (
    APART,
    GLOBAL,
    LITERAL,
    OURS,
    best_readings,
    holding_settings,
    judge_claims,
    judge_image_claims,
    judge_settings,
    readings_of,
    settings_card,
    write_cards,
)
from rsbench.cli.console import echo
from rsbench.cli.simulate import run_and_summarise
from rsbench.report.claim_pages import claims_page, image_claims_page, readings_page, sweeps_page
from rsbench.report.paper_figures import SWEEPS, draw_fig3, fig3_page, read_summaries, setting_table
from rsbench.storage.files import save_arrays, write_bytes, write_json, write_table

_OTHER_SWEEPS = ("solvers", "limit", "degenerate", "planar", "outliers", "wrong-readout", "wrong-motion")


def fig3(out: Path, data: Path, workers: int | None) -> None:
    folder = out / "fig3"
    command = "rsbench reproduce fig3"
    errors: dict[str, NDArray[np.float32]] = {}
    cards = {name: load_sweep(name) for name in SWEEPS}
    for name, card in cards.items():
        home = data / "simulated" / name
        table = run_and_summarise(card, home, workers, command)
        write_table(folder / f"{name}.csv", table)
        found = errors_of_rows(table, home)
        errors |= {f"{name}_{measure}": values for measure, values in found.items()}
    save_arrays(folder / "trials.npz", errors)
    settings = setting_table(list(cards.values()))
    write_table(folder / "settings.csv", settings)
    write_bytes(folder / "README.md", fig3_page(settings).encode())
    seeds = {name: card.seed for name, card in cards.items()}
    write_json(folder / "provenance.json", provenance(command, sweeps=list(SWEEPS), seeds=seeds))
    for path in draw_fig3(folder):
        echo(f"figure: {path}")


def sweeps(out: Path, data: Path, workers: int | None) -> None:
    folder = out / "sweeps"
    command = "rsbench reproduce sweeps"
    cards = [load_sweep(name) for name in _OTHER_SWEEPS]
    tables = {}
    for card in cards:
        tables[card.name] = run_and_summarise(card, data / "simulated" / card.name, workers, command)
        write_table(folder / f"{card.name}.csv", tables[card.name])
    write_bytes(folder / "README.md", sweeps_page(cards, tables).encode())
    write_json(folder / "provenance.json", provenance(command, sweeps=list(_OTHER_SWEEPS)))
    echo(f"tables: {folder}")


def claims(out: Path, data: Path, workers: int | None) -> None:
    """Judge every claim of the paper on simulated points, for every reading of its solver."""
    fig3(out, data, workers)
    folder, home, command = out / "claims", data / "simulated", "rsbench reproduce claims"
    tables = _claim_tables(out / "fig3", folder, home, workers, command)
    (literal,) = write_cards(home / "readings", (LITERAL,))
    exact = replace(load_sweep("degenerate").with_setting(points=9), solvers=(literal,))
    tables["9 + 9"]["degenerate"] = run_and_summarise(exact, home / "degenerate-9", workers, command)
    readings = {reading.name: reading for name in SWEEPS for n in (9, 100) for reading in readings_of(name, n)}
    verdicts = judge_claims(tables, readings)
    write_table(folder / "claims.csv", verdicts)
    best = best_readings(verdicts)
    write_table(folder / "best-readings.csv", best)
    page = folder / "README.md"
    write_bytes(page, claims_page(verdicts, best).encode())
    write_json(folder / "provenance.json", provenance(command, sweeps=[*SWEEPS, "points", "degenerate"]))
    echo(f"claims: {page}")


def _claim_tables(
    fig3_folder: Path, folder: Path, home: Path, workers: int | None, command: str
) -> dict[str, dict[str, pd.DataFrame]]:
    """Run the sweeps with all readings of the paper's solver; return summaries by matches per camera and sweep."""
    hundred = read_summaries(fig3_folder, SWEEPS)
    tables: dict[str, dict[str, pd.DataFrame]] = {"100 + 100": {}, "9 + 9": {}}
    for name in SWEEPS:
        nine = _with_readings(name, 9, home, workers, command)
        write_table(folder / f"{name}-9.csv", nine)
        more = _with_readings(name, 100, home, workers, command)
        write_table(folder / f"{name}-readings.csv", more)
        apart = more.solver.isin([reading.name for reading in APART])
        tables["100 + 100"][name] = pd.concat([hundred[name], more[~apart]], ignore_index=True)
        tables["9 + 9"][name] = pd.concat([nine, more[apart]], ignore_index=True)
    points = _with_readings("points", None, home, workers, command)
    write_table(folder / "points.csv", points)
    return {**tables, "9 + 9 and more": {"points": points}}


def _with_readings(name: str, points: int | None, home: Path, workers: int | None, command: str) -> pd.DataFrame:
    """Run a sweep of the paper with the readings of its solver; return the summary. The solvers for comparison are
    run too, unless there are 100 points, for which ``fig3`` runs them."""
    others = () if points == 100 else (OURS, GLOBAL)
    card = replace(load_sweep(name), solvers=(*write_cards(home / "readings", readings_of(name, points)), *others))
    folder = home / (f"{name}-readings" if points is None else f"{name}-{points}-readings")
    return run_and_summarise(
        card if points is None else card.with_setting(points=points), folder, workers, command
    )


def readings(out: Path, data: Path, workers: int | None) -> None:
    """Judge the claims in settings that the paper leaves open."""
    folder, home, command = out / "readings", data / "simulated", "rsbench reproduce readings"
    chosen = (LITERAL, replace(LITERAL, extraction="symmetric"))
    solvers = (*write_cards(home / "readings", chosen), GLOBAL)
    tables = {
        name: run_and_summarise(
            settings_card(load_sweep(name), solvers), home / f"{name}-settings", workers, command
        )
        for name in SWEEPS
    }
    judged = judge_settings(tables, {reading.name: reading for reading in chosen})
    write_table(folder / "settings.csv", judged)
    page = folder / "README.md"
    write_bytes(page, readings_page(holding_settings(judged)).encode())
    write_json(folder / "provenance.json", provenance(command, sweeps=list(SWEEPS)))
    echo(f"readings: {page}")


def image_claims(out: Path) -> None:
    """Judge the claims about images from the results in ``out``."""
    text, page = image_claims_page(judge_image_claims(out)), out / "claims" / "images.md"
    write_bytes(page, text.encode())
    echo(f"claims: {page}")
