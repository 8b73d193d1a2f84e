"""A second process compiles while the first command of an installation works."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from small_scenes import write_rig

from rsbench.cli import compile_ahead
from rsbench.dataset.sequence import read_dataset

_LOADED = """
import sys
from rsbench.components import compiled
loaded, load = set(), compiled._KernelCache._load_overload
def noted(cache, signature, context):
    loaded.add((cache._name, str(signature)))
    return load(cache, signature, context)
compiled._KernelCache._load_overload = noted
from rsbench.cli.compile_ahead import parts
for part in parts():
    part()
ahead, argv = set(loaded), sys.argv[1:]
from rsbench.cli.main import app
app(argv, standalone_mode=False)
assert len(ahead) > 20, ahead
assert loaded == ahead, loaded - ahead
"""


@pytest.mark.slow
def test_everything_that_correct_compiles_is_compiled_ahead(tmp_path: Path, smoke_dataset: Path) -> None:
    castle = read_dataset(smoke_dataset)[0]
    rig = write_rig(tmp_path / "rig.toml", castle.rig, castle.shutter.readout_ratio)
    frames = [str(castle.folder / f"rs/{side}_{frame}.png") for frame in (0, 1) for side in ("left", "right")]
    words = ["correct", *frames, "--rig", str(rig), "--out", str(tmp_path / "out")]
    done = subprocess.run([sys.executable, "-c", _LOADED, *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.skipif(sys.platform != "linux", reason="that a child ends with its parent is for Linux alone")
def test_the_second_process_ends_with_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started = list[subprocess.Popen[bytes]]()
    popen = subprocess.Popen

    def noted(*words: Any, **options: Any) -> subprocess.Popen[bytes]:
        started.append(popen(*words, **options))
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", noted)
    monkeypatch.setattr(compile_ahead, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(compile_ahead, "shipped_folder", lambda: None)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    with compile_ahead.compiling_ahead():
        time.sleep(1.0)
        assert started[0].poll() is None
    assert started[0].wait(10.0) != 0
    with compile_ahead.compiling_ahead(to_the_end=True):
        pass
    outlives = started.pop()
    try:
        with pytest.raises(subprocess.TimeoutExpired):
            outlives.wait(1.0)
    finally:
        outlives.kill()
        outlives.wait()
    (tmp_path / "function.nbi").touch()
    with compile_ahead.compiling_ahead():
        assert len(started) == 1
