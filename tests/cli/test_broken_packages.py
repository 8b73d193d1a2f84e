"""Installed packages: a good one is used by its name; broken ones stop no command that does not use them."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest
from commands import assert_refused, install_package, run_apart, sweep_card

from rsbench.solvers.engine.base import list_solvers

CARD = sweep_card(["gs-8pt"], noise_px=[0.5], trials=2)
BROKEN = {
    "raises": "raise RuntimeError('half installed')",
    "exits": "raise SystemExit(3)",
    "loops": "import time\nwhile True: time.sleep(1)",
    "crashes": "import ctypes; ctypes.string_at(0)",
    "ends": "import os; os._exit(0)",
    "prints": "print('hello from a package')\nraise ImportError('no such library')",
}

GOOD = """
from rsbench.solvers.engine.base import Solver
from rsbench.solvers.engine.base import load_solver

EIGHT_POINT = load_solver("gs-8pt")

class Solver(Solver):
    '''Eight points in a hurry.'''

    spec = EIGHT_POINT.spec

    def estimate(self, correspondences, rig, shutter):
        print("in a hurry")
        return EIGHT_POINT.estimate(correspondences, rig, shutter)
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with packages whose modules fail, one that is gone, and one that claims a card's name."""
    folder = tmp_path_factory.mktemp("site")
    targets = {name: f"broken_{name}:Solver" for name in BROKEN} | {"gone": "not_there:Solver"}
    for name, text in BROKEN.items():
        (folder / f"broken_{name}.py").write_text(text + "\n")
    (folder / "hasty_solver.py").write_text(GOOD)
    targets |= {"gs-8pt-scaled": "broken_raises:Solver", "hasty": "hasty_solver:Solver"}
    for name, target in targets.items():
        install_package(folder, f"broken-{name}", f"[rsbench.solvers]\n{name} = {target}\n")
    install_package(folder, "mad-package", "[rsbench.solvers\nno header")
    return folder


@pytest.mark.slow
def test_listing_names_them(site: Path) -> None:
    result = run_apart("list", "solvers", "--json", path=site, RSBENCH_IMPORT_LIMIT_S="4")
    assert result.returncode == 0, result.stderr
    listed = json.loads(result.stdout)
    rows = {row["name"]: row for row in listed}
    for name, words in {
        "raises": "RuntimeError: half installed",
        "exits": "SystemExit: 3",
        "loops": "took longer than 4 s (RSBENCH_IMPORT_LIMIT_S allows more)",
        "crashes": "SIGSEGV",
        "ends": "exit code 0",
        "prints": "no such library",
        "gone": "not_there",
    }.items():
        assert words in rows[name]["broken"] and rows[name]["origin"] == f"broken-{name}"
    for name in ("gs-8pt", "rs-stereo-refined", "hasty"):
        assert rows[name]["broken"] is None
    hasty = [rows["hasty"][key] for key in ("origin", "description", "card")]
    assert hasty == ["broken-hasty", "Eight points in a hurry.", None]
    both = [row for row in listed if row["name"] == "gs-8pt-scaled"]
    assert {row["origin"] for row in both} == {"rsbench", "broken-gs-8pt-scaled"}
    assert any("rename one of them" in (row["broken"] or "") for row in both)
    assert len(listed) == len(list_solvers()) + len(BROKEN) + 3


@pytest.mark.slow
def test_built_in_solvers_and_a_good_package_simulate(site: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(CARD)
    chosen = ("--solver", "gs-8pt", "--solver", "hasty", "--workers", 1)
    result = run_apart("simulate", tmp_path / "mine.toml", "--out", tmp_path / "out", *chosen, path=site)
    assert result.returncode == 0, result.stderr
    assert "in a hurry" not in result.stdout + result.stderr
    table = pd.read_csv(tmp_path / "out" / "summary.csv", index_col="solver")
    assert list(table.failures) == [0, 0]
    assert table.e_T_median["hasty"] == table.e_T_median["gs-8pt"] < 90.0


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("ends", ["broken_ends ended its process with exit code 0", "broken-ends"]),
        ("prints", ["no such library", "broken-prints"]),
        ("gs-8pt-scaled", ["card gs-8pt-scaled.toml", "broken-gs-8pt-scaled"]),
    ],
)
def test_who_uses_one_is_told_its_name(site: Path, tmp_path: Path, name: str, words: list[str]) -> None:
    result = run_apart("simulate", "noise", "--solver", name, "--out", tmp_path / "out", path=site)
    assert_refused(result, *words)
    assert result.stdout == ""
    assert not (tmp_path / "out").exists()
