"""Which tests a run has skipped, and why: named in its last line; in CI, one that is not on the list fails.

``skips.txt`` beside this file has a line for each test that may skip, ``FILE::TEST: reason``, where the test may
be ``*``. With CI set in the environment, on Linux, others fail the run; with ``NO_SKIPS`` any skip does.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest

LIST = Path(__file__).with_name("skips.txt")


class SkipReport:
    """Collects the skips of a run, those of its processes too."""

    def __init__(self) -> None:
        self.found: dict[str, str] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Of a test."""
        if not hasattr(report, "wasxfail"):
            self._note(report)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """Of a whole file."""
        self._note(report)

    def _note(self, report: pytest.TestReport | pytest.CollectReport) -> None:
        if report.skipped:
            reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
            self.found[report.nodeid.partition("[")[0]] = reason.removeprefix("Skipped: ")

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """A skip that nobody has written down is a check that nobody runs."""
        if unlisted(self.found, allowed()) and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_unconfigure(self) -> None:
        """The last line."""
        if self.found:
            print(last_line(self.found, unlisted(self.found, allowed())))  # noqa: T201


def allowed(text: str | None = None) -> frozenset[str] | None:
    """Tests that may skip, from the lines of the list; None where any may."""
    if os.environ.get("NO_SKIPS"):
        return frozenset()
    if text is None and not (os.environ.get("CI") and sys.platform == "linux"):
        return None
    lines = (LIST.read_text("utf-8") if text is None else text).splitlines()
    return frozenset(line.partition(": ")[0] for line in lines if line.strip() and not line.startswith("#"))


def unlisted(found: Iterable[str], names: frozenset[str] | None) -> list[str]:
    """Those that skipped and may not."""
    if names is None:
        return []
    return sorted(name for name in found if not {name, name.partition("::")[0] + "::*"} & names)


def last_line(found: dict[str, str], wrong: list[str]) -> str:
    """Every skip with its reason, the wrong ones first."""
    words = "; ".join(f"{name} ({found[name]})" for name in [*wrong, *sorted(set(found) - set(wrong))])
    failed = f"FAILED: {len(wrong)} not in tests/skips.txt; " if wrong else ""
    return f"skipped {len(found)}: {failed}{words}"
