"""The table of checks: its document has a row for each, and each finding names its check."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import rsbench
from rsbench.verification.checks import CHECKS

DOCUMENT = Path(__file__).parents[2] / "docs" / "explanation" / "verification.md"


def test_the_document_describes_each_check_once_in_order() -> None:
    table = DOCUMENT.read_text("utf-8").partition("| check | reads | finds | costs |\n")[2].partition("\n\n")[0]
    rows = [[cell.strip() for cell in row.strip("|").split(" | ")] for row in table.splitlines()[1:]]
    assert [row[0] for row in rows] == [each.name for each in CHECKS]
    assert len({each.name for each in CHECKS}) == len(CHECKS)
    assert all(len(row) == 4 and all(row) for row in rows)


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
