"""The notebook: clean as committed, of public names alone, and it runs; the documents come with the wheel."""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import rsbench

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))


def code_of(notebook: Path) -> str:
    """The code cells as one script."""
    cells = json.loads(notebook.read_text("utf-8"))["cells"]
    return "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code") + "\n"


def test_there_is_a_notebook() -> None:
    assert [path.name for path in NOTEBOOKS] == ["tour.ipynb"]


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_committed_without_outputs(notebook: Path) -> None:
    content = json.loads(notebook.read_text("utf-8"))
    assert content["nbformat"] == 4
    for cell in content["cells"]:
        assert cell["id"]
        if cell["cell_type"] == "code":
            assert cell["outputs"] == [] and cell["execution_count"] is None


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_use_public_names_alone(notebook: Path) -> None:
    code = code_of(notebook)
    modules = set()
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            modules.add(str(node.module))
    assert modules == {"pathlib", "matplotlib.pyplot", "numpy", "rsbench"}
    assert set(re.findall(r"\brsbench\.(\w+)", code)) <= set(rsbench.__all__)


_TRUTHS = """
# Where the truth is known: simulated points at 0.3 px, and rendered frames that are corrected.
assert errors_of("rs-stereo", data)["e_R_deg"] < 0.05 < errors_of("gs-8pt", data)["e_R_deg"]
assert found.estimate.success and error < 0.05
assert after.mean() < 0.5 * before.mean()
assert len(plt.get_fignums()) == 2
"""


def test_the_tour_runs(tmp_path: Path) -> None:
    script = tmp_path / "tour.py"
    script.write_text(code_of(ROOT / "examples" / "tour.ipynb") + _TRUTHS, "utf-8")
    environment = os.environ | {"MPLBACKEND": "Agg", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-W", "error", script.name]
    run = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=500)
    assert run.returncode == 0, run.stderr
