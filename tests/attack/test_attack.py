"""A little of the long attack of ``make attack``, in a process of its own: forking needs one without threads."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks, and reads /proc")


@pytest.mark.slow
def test_a_sample_of_the_attack_finds_nothing(tmp_path: Path) -> None:
    tests = Path(__file__).parents[1]
    environment = {**os.environ, "PYTHONPATH": str(tests), "TMPDIR": str(tmp_path)}
    result = subprocess.run(
        [sys.executable, "-m", "attack", "--sample", "--keep", tmp_path / "inputs"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=500,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    printed = {line.partition(":")[0] for line in result.stdout.splitlines()}
    assert {"kills of correct", "file operations of correct", "surroundings"} <= printed
