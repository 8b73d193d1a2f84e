"""Where compiled code is kept, and that it is neither stale nor made twice."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from programs import run_python

from rsbench.components import compiled, motion_kernels, motion_models
from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.solvers import refined
from rsbench.solvers.engine import packed, residuals
from rsbench.solvers.engine.base import list_solvers, load_solver
from rsbench.solvers.refined import warm_up

FOLDER = "from rsbench.components.compiled import cache_folder; import sys; sys.stdout.write(str(cache_folder()))"
ADDS = """
    from rsbench.components.compiled import compiled

    @compiled
    def add(a: float, b: float) -> float:
        return a + b

    @compiled(error_model="numpy")
    def quotient(a: float, b: float) -> float:
        return add(a, 0.0) / b
"""


def child(code: str, **environment: str | None) -> subprocess.CompletedProcess[str]:
    """Another Python on these sources, with some variables set or (None) absent."""
    return run_python("-c", textwrap.dedent(code), environment=environment)


def test_the_folder_of_the_environment_comes_before_the_user_s(tmp_path: Path) -> None:
    version = f"kernels/{compiled.source_version()[:16]}"
    own = child(FOLDER, NUMBA_CACHE_DIR=str(tmp_path / "own"), XDG_CACHE_HOME=str(tmp_path))
    assert own.stdout == str(tmp_path / "own" / version)
    users = child(FOLDER, NUMBA_CACHE_DIR=None, XDG_CACHE_HOME=str(tmp_path / "xdg"))
    assert users.stdout == str(tmp_path / "xdg" / "rsbench" / version)


@pytest.mark.skipif(sys.platform != "linux", reason="the folders of Linux")
def test_without_a_home_a_temporary_folder_of_this_user_alone_serves(tmp_path: Path) -> None:
    nowhere = {"NUMBA_CACHE_DIR": None, "XDG_CACHE_HOME": None, "HOME": "/dev/null/home"}
    done = child(FOLDER, **nowhere, TMPDIR=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout).is_relative_to(tmp_path)
    private = next(tmp_path.iterdir())
    assert private.stat().st_mode & 0o077 == 0
    # A folder that others may write is not trusted: who writes there decides what is run.
    private.chmod(0o777)
    again = child(FOLDER, **nowhere, TMPDIR=str(tmp_path))
    assert not Path(again.stdout).is_relative_to(private)


def test_where_nothing_can_be_written_functions_still_compile(tmp_path: Path) -> None:
    (tmp_path / "adds.py").write_text(textwrap.dedent(ADDS))
    code = f"""
        import sys; sys.path.insert(0, {str(tmp_path)!r})
        from rsbench.components import compiled
        compiled.config.CACHE_DIR = ""; compiled.user_cache = compiled.temporary = lambda: None
        import adds
        assert adds.quotient(3.0, 2.0) == 1.5
        assert compiled.cache_folder() is None
    """
    done = child(code)
    assert done.returncode == 0, done.stderr


USE = """
    import sys; sys.path.insert(0, {folder!r})
    import adds
    result = adds.quotient(3.0, 2.0)
    hits = sum(adds.quotient.stats.cache_hits.values())
    sys.stdout.write(f"{{result}} {{hits}}")
"""


def test_the_second_process_loads_what_the_first_compiled(tmp_path: Path) -> None:
    (tmp_path / "adds.py").write_text(textwrap.dedent(ADDS))
    use = USE.format(folder=str(tmp_path))
    assert child(use, NUMBA_CACHE_DIR=str(tmp_path / "cache")).stdout == "1.5 0"
    assert child(use, NUMBA_CACHE_DIR=str(tmp_path / "cache")).stdout == "1.5 1"
    # Half a file, as a full disk leaves it, is compiled again instead of ending the program.
    for path in (tmp_path / "cache").rglob("*.nbc"):
        path.write_bytes(path.read_bytes()[:100])
    assert child(use, NUMBA_CACHE_DIR=str(tmp_path / "cache")).stdout == "1.5 0"


@pytest.mark.slow
def test_two_processes_may_compile_at_once(tmp_path: Path) -> None:
    """One signature each: with one index for both, the second would call the first one's code."""
    (tmp_path / "adds.py").write_text(textwrap.dedent(ADDS))
    code = """
        import sys; sys.path.insert(0, {folder!r})
        import adds
        sys.stdout.write(str(adds.add({a}, {a})))
    """

    def added(a: str) -> str:
        return child(code.format(folder=str(tmp_path), a=a), NUMBA_CACHE_DIR=str(tmp_path / "cache")).stdout

    for _ in range(2):
        with ThreadPoolExecutor(2) as pool:
            assert list(pool.map(added, ("3", "2j"))) == ["6", "4j"]


def test_every_source_with_compiled_code_decides_the_version() -> None:
    package = Path(compiled.__file__).parents[1]
    marked = {
        path.relative_to(package).as_posix()
        for path in package.rglob("*.py")
        if any(mark in path.read_bytes() for mark in compiled._MARKS)
    }
    # All modules that use the decorator import it.
    users = {
        path.relative_to(package).as_posix()
        for path in package.rglob("*.py")
        if "import compiled\n" in path.read_text()
    }
    assert users <= marked
    assert {"solvers/engine/residuals.py", "vision/images.py"} <= users
    assert not any("njit" in (package / name).read_text() for name in marked - {"components/compiled.py"})


def signatures() -> set[tuple[str, str]]:
    found = set()
    for module in (motion_kernels, motion_models, residuals, packed, refined):
        for name, function in vars(module).items():
            found |= {(name, str(signature)) for signature in getattr(function, "signatures", [])}
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", list_solvers())
def test_a_warm_solver_compiles_nothing(name: str) -> None:
    from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
    from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
    from rsbench.solvers.free_velocities import FreeVelocitySolver

    solver = load_solver(name)
    warm_up([solver.spec.motion_model])
    rig = StereoRig(camera=PinholeCamera.centred(640, 480, 600.0), baseline=0.5)
    shutter = RollingShutter(height=480, readout_ratio=0.5)
    options = SimulationOptions(pairs=200, tracks=200, noise_px=0.3)
    motion = LinearMotion(np.array([0.01, -0.02, 0.015]), np.array([0.2, 0.1, -0.15]))
    matches = simulate(rig, shutter, motion, options, np.random.default_rng(0)).correspondences
    if isinstance(solver, FreeVelocitySolver):  # its own kernels, which no other solver waits for
        solver.estimate(matches, rig, shutter)
    before = signatures()
    solver.estimate(matches, rig, shutter)
    estimate_motion(matches, rig, shutter, solver, RobustOptions(), np.random.default_rng(0))
    assert signatures() == before


def test_long_compiling_is_announced_in_one_line_and_once(tmp_path: Path) -> None:
    (tmp_path / "adds.py").write_text(textwrap.dedent(ADDS))
    code = "from rsbench.components import compiled; compiled._LONG_S = 0.0" + USE.format(
        folder=str(tmp_path)
    ).replace("\n    ", "\n")
    first, second = (child(code, NUMBA_CACHE_DIR=str(tmp_path / "cache")) for _ in range(2))
    assert first.stderr == "rsbench: compiling, once per installation: up to a minute\n"
    assert (second.stdout, second.stderr) == ("1.5 1", "")


def test_only_compiled_code_of_old_versions_is_removed(tmp_path: Path) -> None:
    """The cache may be put where other things lie (NUMBA_CACHE_DIR)."""
    kept = {"0123456789abcdef/now.nbc", "sources/mine.c", "fedcba9876543210/notes.txt"}
    for name in (*kept, "fedcba9876543210/old.nbi", "aaaaaaaaaaaaaaaa/old.nbc"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    for folder in tmp_path.iterdir():
        os.utime(folder, (0, 0))
    compiled._remove_old(tmp_path / "0123456789abcdef")
    assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()} == kept
    assert not (tmp_path / "aaaaaaaaaaaaaaaa").exists()


LOADS_SHIPPED = """
    import sys; sys.path.insert(0, {folder!r})
    from pathlib import Path
    from rsbench.components import compiled
    compiled.resources.files = lambda name: Path({folder!r})
    compiled.source_version = lambda: "0" * 64
    lacking = {lacking!r}
    found = compiled.binding.get_host_cpu_features()
    found.update(dict.fromkeys(lacking, False))
    compiled.binding.get_host_cpu_features = lambda: found
    import adds
    assert adds.quotient(3.0, 2.0) == 1.5
    assert compiled.shipped_folder() is None if lacking else compiled.shipped_folder() is not None
"""


@pytest.mark.skipif(not compiled.runs_portable_code(), reason="no processor for portable code")
def test_portable_code_is_loaded_on_processors_that_have_what_it_uses_alone(tmp_path: Path) -> None:
    (tmp_path / "adds.py").write_text(textwrap.dedent(ADDS))
    shipped = tmp_path / compiled.SHIPPED
    portable = {"NUMBA_CPU_NAME": compiled.PORTABLE_CPU, "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(shipped)}
    code = LOADS_SHIPPED.format(folder=str(tmp_path), lacking=[])
    made = child(code.replace("compiled.shipped_folder() is not None", "True"), **portable)
    assert made.returncode == 0, made.stderr
    assert sorted(shipped.rglob("*.nbi"))
    processors: list[list[str]] = [[], ["avx2"], ["movbe"]]
    for number, lacking in enumerate(processors):
        own = tmp_path / f"own-{number}"
        code = LOADS_SHIPPED.format(folder=str(tmp_path), lacking=lacking)
        done = child(code, NUMBA_CACHE_DIR=str(own))
        assert done.returncode == 0, done.stderr
        assert bool(list(own.rglob("*.nbi"))) == bool(lacking), (
            "compiled what was shipped, or ran what it must not"
        )
