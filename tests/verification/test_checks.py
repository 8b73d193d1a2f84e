"""The table of checks: what it says in the document, and that each finding names its row."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import rsbench
from rsbench.verification.checks import CHECKS, END, START, with_table

DOCUMENT = Path(__file__).parents[2] / "docs" / "explanation" / "verification.md"


def test_the_document_holds_the_table() -> None:
    """Else: python -m rsbench.verification docs/explanation/verification.md."""
    text = DOCUMENT.read_text("utf-8")
    assert text.count(START) == text.count(END) == 1
    assert text == with_table(text)


def test_each_check_has_a_name_of_its_own_and_says_what_it_does() -> None:
    assert len({each.name for each in CHECKS}) == len(CHECKS)
    assert all(each.reads and each.finds and each.costs for each in CHECKS)


@pytest.mark.parametrize(("file", "check"), [("gs_depth/right_1.exr", "files"), ("poses/left_0.csv", "poses")])
def test_a_finding_names_its_check(smoke_dataset: Path, tmp_path: Path, file: str, check: str) -> None:
    shutil.copytree(smoke_dataset, tmp_path / "data")
    (sequence, *_) = sorted(path.parent for path in (tmp_path / "data").glob("*/sequence.json"))
    path = sequence / file
    if check == "files":
        path.unlink()
    else:
        path.write_text("".join(path.read_text("utf-8").splitlines(keepends=True)[:-1]), "utf-8")
    reports = rsbench.verify(tmp_path / "data", stride=8, rerender="no")
    assert check in {each.check for report in reports for each in report.findings}
    for report in reports:
        assert report.faults == tuple(map(str, report.findings))
        assert all(each.check for each in report.findings)
