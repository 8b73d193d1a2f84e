"""The wheel, away from the checkout: README's commands and its Python example, as printed, and the notebook.

The dependencies are those of the running environment; the package itself comes from the wheel alone.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text("utf-8")
pytestmark = pytest.mark.skipif(shutil.which("bash") is None, reason="README's commands are written for bash")


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of an installed wheel."""
    out, target = tmp_path_factory.mktemp("wheel"), tmp_path_factory.mktemp("installed")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True, timeout=60)
    (wheel,) = out.glob("*.whl")
    install = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--no-index",
        "--target",
        str(target),
    ]
    subprocess.run([*install, str(wheel)], check=True, capture_output=True, timeout=120)
    return target


def _run(command: list[str], folder: Path, installed: Path) -> str:
    path = f"{installed / 'bin'}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PYTHONPATH": str(installed), "PATH": path, "MPLBACKEND": "Agg"}
    run = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=500)
    assert run.returncode == 0, f"{command}: {run.stderr}{run.stdout}"
    return run.stdout


def _printed_commands() -> list[str]:
    """README's commands under "Use", without their comments; a backslash joins two lines."""
    use = README[README.index("## Use") : README.index("## Results")]
    lines = "\n".join(line[4:] for line in use.splitlines() if line.startswith("    ") and "```" not in line)
    commands = re.sub(r"\\\n\s+", "", lines).splitlines()
    return [re.sub(r"\s+#.*", "", command) for command in commands if command.startswith("rsbench ")]


def _printed_python() -> str:
    (code,) = re.findall(r"^```python\n(.*?)^```", README, flags=re.DOTALL | re.MULTILINE)
    return str(code)


def test_the_package_comes_from_the_wheel(installed: Path, tmp_path: Path) -> None:
    where = _run([sys.executable, "-c", "import rsbench; print(rsbench.__file__)"], tmp_path, installed)
    assert Path(where.strip()) == installed / "rsbench" / "__init__.py"
    document = Path(_run(["rsbench", "docs", "conventions"], tmp_path, installed).strip())
    assert document.read_bytes() == (ROOT / "docs" / "explanation" / "conventions.md").read_bytes()
    assert installed in document.parents


def test_the_sample_problem_is_solved(installed: Path, tmp_path: Path) -> None:
    """Its motion is checked in tests/pipeline/test_problem.py; here, that it is found and read."""
    command = 'rsbench solve "$(rsbench docs problem.json)" --json'
    answer = json.loads(_run(["bash", "-c", command], tmp_path, installed))
    assert answer["success"] and answer["reference_point"] == "body" and answer["d_unit"] == "m"


def test_the_sample_rig_is_that_of_the_castle(installed: Path, tmp_path: Path) -> None:
    rig = tomllib.loads(
        Path(_run(["rsbench", "docs", "rig.toml"], tmp_path, installed).strip()).read_text("utf-8")
    )
    card = tomllib.loads((ROOT / "cards" / "datasets" / "paper.toml").read_text("utf-8"))
    assert (rig["baseline"], rig["readout_ratio"]) == (card["baseline"], card["readout_ratio"])
    assert rig["camera"] == {"fx": 1384.6, "fy": 1384.6, "cx": 449.5, "cy": 449.5}
    assert (card["camera"]["focal"], card["camera"]["width"], card["camera"]["height"]) == (1384.6, 900, 900)


@pytest.mark.slow
def test_the_readme_runs_as_printed(installed: Path, tmp_path: Path, smoke_dataset: Path) -> None:
    """On the small dataset instead of the paper's, with fewer solvers and trials; else word for word."""
    shutil.copytree(smoke_dataset, tmp_path / "data" / "smoke")
    (tmp_path / "rig.toml").write_text(
        "baseline = 0.3\nreadout_ratio = 0.8\n[camera]\nfx = 150\nfy = 150\ncx = 63.5\ncy = 47.5\n"
    )
    shorter = {
        "rsbench verify": " --rerender no",
        "rsbench evaluate": " --solver gs-8pt --only castle",
        "rsbench simulate": " --trials 2 --solver gs-8pt --workers 1",
    }
    commands = _printed_commands()
    verbs = [command.split()[1] for command in commands]
    assert verbs == [
        "list",
        "generate",
        "verify",
        "export",
        "evaluate",
        "solve",
        "correct",
        "simulate",
        "docs",
        "reproduce",
    ]
    for command, verb in zip(commands, verbs, strict=True):
        if verb == "reproduce":
            continue  # renders at full size; its parts have tests of their own
        small = command.replace("paper", "smoke").replace('"$(rsbench docs rig.toml)"', "rig.toml")
        _run(["bash", "-c", small + shorter.get(" ".join(command.split()[:2]), "")], tmp_path, installed)
    for result in ("data/smoke/dataset.json", "out/smoke/report.html", "out/corrected/report.html"):
        assert (tmp_path / result).is_file()
    assert (tmp_path / "out" / "noise" / "summary.csv").is_file()
    script = tmp_path / "example.py"
    script.write_text(_printed_python().replace("data/paper", "data/smoke"), "utf-8")
    printed = _run([sys.executable, "-W", "error", str(script)], tmp_path, installed)
    assert "e_R_deg" in printed and "castle" in printed and "room-twist" in printed


_TRUTHS = """
# Where the truth is known: simulated points at 0.3 px, and rendered frames that are corrected.
assert errors_of("rs-stereo-refined", data)["e_R_deg"] < 0.05 < errors_of("gs-8pt", data)["e_R_deg"]
assert found.estimate.success and error < 0.05
assert after.mean() < 0.5 * before.mean()
assert len(plt.get_fignums()) == 2
"""


def test_the_notebook_runs(installed: Path, tmp_path: Path) -> None:
    notebook = Path(_run(["rsbench", "docs", "tour.ipynb"], tmp_path, installed).strip())
    cells = json.loads(notebook.read_text("utf-8"))["cells"]
    code = "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    script = tmp_path / "tour.py"
    script.write_text(f"{code}\n{_TRUTHS}", "utf-8")
    _run([sys.executable, "-W", "error", str(script)], tmp_path, installed)


@pytest.mark.parametrize("solver", ["rs-stereo-linear", "gs-8pt"])
def test_the_contract_holds(installed: Path, tmp_path: Path, solver: str) -> None:
    answer = json.loads(_run(["rsbench", "check-solver", solver, "--json"], tmp_path, installed))
    assert answer["passed"] is True
