"""A test that skips in CI is named with its reason, and fails the run where it is not on the list."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from skips import LIST, allowed, last_line, unlisted

TESTS = Path(__file__).parent
REPORTED = """from skips import SkipReport
def pytest_configure(config): config.pluginmanager.register(SkipReport())
"""
SKIPPING = """import pytest
@pytest.mark.skipif(True, reason="no such camera")
def test_one(): ...
def test_two(): ...
"""


@pytest.mark.parametrize(("variable", "status"), [(None, 0), ("CI", 1), ("NO_SKIPS", 1)])
def test_a_new_skip_fails_in_ci_and_is_named_in_the_last_line(
    tmp_path: Path, variable: str | None, status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("CI", "NO_SKIPS"):
        monkeypatch.delenv(name, raising=False)
    if variable:
        monkeypatch.setenv(variable, "1")
    (tmp_path / "test_new.py").write_text(SKIPPING, "utf-8")
    (tmp_path / "conftest.py").write_text(REPORTED, "utf-8")
    monkeypatch.setenv("PYTHONPATH", str(TESTS))
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", str(tmp_path)]
    ran = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert ran.returncode == status, ran.stdout + ran.stderr
    last = ran.stdout.splitlines()[-1]
    assert last.startswith("skipped 1: ") and "test_new.py::test_one (no such camera)" in last
    assert ("FAILED: 1 not in tests/skips.txt" in last) == bool(status)


def test_the_list_names_tests_that_exist_each_with_its_reason() -> None:
    names = allowed(LIST.read_text("utf-8"))
    assert names
    for line in LIST.read_text("utf-8").splitlines():
        if not line.startswith("#"):
            name, reason = line.split(": ", 1)
            file, test = name.split("::")
            text = (TESTS.parent / file).read_text("utf-8")
            assert reason and (test == "*" or f"def {test}(" in text), line


def test_a_listed_skip_is_told_and_passes() -> None:
    names = allowed("# comment\ntests/a.py::test_x: why\ntests/b.py::*: why\n")
    found = {"tests/a.py::test_x": "r", "tests/a.py::test_y": "s", "tests/b.py::test_z": "t"}
    assert unlisted(found, names) == ["tests/a.py::test_y"]
    assert last_line(found, ["tests/a.py::test_y"]).startswith(
        "skipped 3: FAILED: 1 not in tests/skips.txt; tests/a.py::test_y (s)"
    )
