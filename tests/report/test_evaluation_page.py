"""The page of an evaluation whose record is somebody else's."""

from __future__ import annotations

from pathlib import Path

import pytest

from rsbench.core.errors import RsbenchError
from rsbench.report.evaluation_page import write_report
from rsbench.storage.files import write_json


@pytest.mark.parametrize("name", ["../../victim", "a/b", "/victim"])
def test_names_in_a_record_are_no_paths(tmp_path: Path, name: str) -> None:
    chosen = {"corrector": "fusion", "solver": name, "matcher": "sgm"}
    write_json(tmp_path / "provenance.json", {"date": "today", "inputs": {"dataset": "a", "correction": chosen}})
    with pytest.raises(RsbenchError, match=r"provenance\.json: is not that of an evaluation"):
        write_report(tmp_path, tmp_path)
