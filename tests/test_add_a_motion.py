"""The motion model of docs/how-to/add-a-motion.md as an installed package: nothing in rsbench changes for it."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest
from commands import install_project, sweep_card
from documents import ROOT, write_blocks
from programs import run_python

SWEEP = sweep_card(
    ["rs-stereo-ease.toml", "rs-stereo-refined"], noise_px=[0.0], trials=2, more='motion_model = "ease"\n'
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of the document, installed."""
    folder = tmp_path_factory.mktemp("site")
    write_blocks(ROOT / "docs" / "how-to" / "add-a-motion.md", folder)
    install_project(folder)
    (folder / "mine.toml").write_text(SWEEP)
    return folder


def rsbench(site: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    return run_python("-m", "rsbench", *arguments, folder=site, path=[site])


def test_it_is_listed(site: Path) -> None:
    result = rsbench(site, "list", "motions", "--json")
    assert result.returncode == 0, result.stderr
    assert "ease" in result.stdout


@pytest.mark.slow
def test_a_simulation_follows_it_and_a_solver_assumes_it(site: Path) -> None:
    result = rsbench(site, "simulate", "mine.toml", "--out", "out", "--workers", "1")
    assert result.returncode == 0, result.stderr
    assert "rs-stereo-refined assumes linear motion; the data are of ease motion" in result.stdout
    rows = (site / "out" / "summary.csv").read_text().splitlines()
    header = rows[0].split(",")
    errors = {
        row.split(",")[header.index("solver")]: float(row.split(",")[header.index("e_R_median")])
        for row in rows[1:]
    }
    # Exact data: the solver of the right model stops at its own tolerance, degrees.
    assert errors["rs-stereo-ease"] < 1e-5
    assert errors["rs-stereo-refined"] > 1e-2
    plan = json.loads((site / "out" / "sweep.json").read_text())
    assert plan["card"]["setting"]["motion_model"] == "ease"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("motion_model=eas", "motion model 'eas' does not exist"),
        ("motion_parameters={c = 2.0}", "c must lie in [0, 1), got 2.0"),
        ("motion_parameters={k = 2.0}", "motion model 'ease': unknown parameter 'k'"),
    ],
)
def test_what_it_cannot_be_is_one_line(site: Path, setting: str, words: str) -> None:
    result = rsbench(site, "simulate", "mine.toml", "--out", "none", "--set", setting)
    assert result.returncode == 2
    assert words in result.stderr and result.stderr.count("\n") == 1


def test_a_class_beside_the_card_needs_no_package(site: Path, tmp_path: Path) -> None:
    (tmp_path / "ease_motion.py").write_text((site / "ease_motion.py").read_text())
    card = (ROOT / "cards" / "datasets" / "smoke.toml").read_text()
    card = card.replace("[motion]\n", '[motion]\nmodel = "ease_motion:EaseMotion"\nparameters = { c = 0.5 }\n')
    (tmp_path / "eased.toml").write_text(card)
    code = f"""
from rsbench.dataset.card import load_dataset_card
from rsbench.components.motion_models import motion_record, read_motion
card = load_dataset_card({str(tmp_path / "eased.toml")!r})
record = motion_record(card.motion_of(card.sequence[0]))
assert record["model"] == "ease_motion:EaseMotion", record
assert read_motion(record).c == 0.5
"""
    result = run_python("-c", code, folder=site.parent)
    assert result.returncode == 0, result.stderr
