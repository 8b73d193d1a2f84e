"""The wheel, away from the checkout: README's commands and Python with what they print, and the notebook.

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
from documents import ROOT, blocks, notebook_code

README = ROOT / "README.md"
pytestmark = pytest.mark.skipif(shutil.which("bash") is None, reason="README's commands are written for bash")


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of an installed wheel."""
    out, target = tmp_path_factory.mktemp("wheel"), tmp_path_factory.mktemp("installed")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True, timeout=60)
    (wheel,) = out.glob("*.whl")
    options = ["--quiet", "--no-deps", "--no-index", "--target", str(target)]
    install = [sys.executable, "-m", "pip", "install", *options, str(wheel)]
    subprocess.run(install, check=True, capture_output=True, timeout=120)
    return target


def _run(command: list[str], folder: Path, installed: Path) -> str:
    path = f"{installed / 'bin'}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PYTHONPATH": str(installed), "PATH": path, "MPLBACKEND": "Agg"}
    run = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=500)
    assert run.returncode == 0, f"{command}: {run.stderr}{run.stdout}"
    return run.stdout


def _printed_commands() -> list[tuple[str, list[str]]]:
    """README's commands, each with the lines that it should print."""
    commands = re.split(r"^\$ ", "".join(blocks(README, "console")), flags=re.MULTILINE)[1:]
    return [(lines[0], lines[1:]) for lines in map(str.splitlines, commands)]


def _printed_python() -> tuple[str, str]:
    """README's Python, and the line that it should print."""
    (code,) = blocks(README, "python")
    code, _, printed = code.rpartition("\n# ")
    return code, printed.strip()


_NUMBER = re.compile(r"-?\d+\.\d+")


def _same(shown: str, printed: str) -> bool:
    """The same words; numbers with a point to a twentieth, as machines differ. "..." stands for anything."""
    words = [re.escape(_NUMBER.sub("#", part)) for part in " ".join(shown.split()).split("...")]
    printed = " ".join(printed.split())
    if re.fullmatch(".*".join(words), _NUMBER.sub("#", printed)) is None:
        return False
    pairs = zip(map(float, _NUMBER.findall(shown)), map(float, _NUMBER.findall(printed)), strict=True)
    return all(abs(one - other) <= 0.05 * abs(one) + 0.002 for one, other in pairs)


def _assert_shown(shown: list[str], printed: str) -> None:
    """Every line that is shown was printed, in this order, from the first one on unless "..." stands between."""
    left = [line for line in printed.splitlines() if line.strip()]
    skip = False
    for line in shown:
        if line == "...":
            skip = True
            continue
        while skip and left and not _same(line, left[0]):
            left.pop(0)
        assert left and _same(line, left.pop(0)), (line, printed)
        skip = False
    assert skip or not left, printed


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
def test_the_readme_runs_as_printed(installed: Path, tmp_path: Path) -> None:
    """Word for word, and prints what README shows."""
    commands = _printed_commands()
    assert len(commands) > 8
    for command, shown in commands:
        if "reproduce" in command:  # minutes of computing; its parts have tests of their own
            figures = [line.removeprefix("figure: ") for line in shown if line != "..."]
            assert figures and all((ROOT / figure).is_file() for figure in figures)
            continue
        _assert_shown(shown, _run(["bash", "-c", command], tmp_path, installed))
    code, shown = _printed_python()
    (tmp_path / "example.py").write_text(code, "utf-8")
    printed = _run([sys.executable, "-W", "error", "example.py"], tmp_path, installed)
    assert _same(shown, printed)


def test_what_is_shown_is_held_to_what_is_said() -> None:
    _assert_shown(["a 1.00", "...", "c ...d"], "a  1.01\n\nb\nc /x/d\n")
    for shown in (["a 1.00"], ["a 1.20", "..."], ["b", "..."], ["...", "d"]):
        with pytest.raises(AssertionError):
            _assert_shown(shown, "a 1.01\nb\n")


_TRUTHS = """
# Where the truth is known: simulated points at 0.3 px, and rendered frames that are corrected.
assert errors_of("rs-stereo-refined", data)["e_R_deg"] < 0.05 < errors_of("gs-8pt", data)["e_R_deg"]
assert found.estimate.success and error < 0.05
assert after.mean() < 0.5 * before.mean()
assert len(plt.get_fignums()) == 2
"""


@pytest.mark.slow
def test_the_notebook_runs(installed: Path, tmp_path: Path) -> None:
    code = notebook_code(Path(_run(["rsbench", "docs", "tour.ipynb"], tmp_path, installed).strip()))
    script = tmp_path / "tour.py"
    script.write_text(f"{code}\n{_TRUTHS}", "utf-8")
    _run([sys.executable, "-W", "error", str(script)], tmp_path, installed)


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["rs-stereo-linear", "gs-8pt"])
def test_the_contract_holds(installed: Path, tmp_path: Path, solver: str) -> None:
    answer = json.loads(_run(["rsbench", "check-solver", solver, "--json"], tmp_path, installed))
    assert answer["passed"] is True
