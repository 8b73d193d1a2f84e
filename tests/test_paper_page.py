"""docs/explanation/paper.md names what exists, and every equation, figure and claim of the paper."""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path

import pytest

from rsbench.benchmark.studies.claims import CLAIMS
from rsbench.benchmark.studies.image_claims import IMAGE_CLAIMS

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "explanation" / "paper.md").read_text("utf-8")
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in PAGE.splitlines()
    if line.startswith("|") and not line.startswith(("|---", "| paper", "| claim"))
]
NAMED = sorted(set(re.findall(r"`((?:rsbench|tests)/[\w/]+\.py)::([\w.]+)`", PAGE)))


@pytest.mark.parametrize(("file", "name"), [pair for pair in NAMED if pair[0].startswith("rsbench/")])
def test_named_functions_exist(file: str, name: str) -> None:
    assert (ROOT / file).is_file()
    value: object = importlib.import_module(file.removesuffix(".py").replace("/", "."))
    for part in name.split("."):
        value = getattr(value, part)


@pytest.mark.parametrize(("file", "name"), [pair for pair in NAMED if pair[0].startswith("tests/")])
def test_named_tests_exist(file: str, name: str) -> None:
    tree = ast.parse((ROOT / file).read_text("utf-8"))
    assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_every_row_names_code_and_a_test() -> None:
    assert len(ROWS) > 25
    for row in ROWS:
        assert len(row) == 5, row
        assert re.search(r"`rsbench/.*::", row[2]), row
        assert re.search(r"`tests/.*::test_", row[3]), row


def test_every_equation_figure_and_claim_has_a_row() -> None:
    first = "\n".join(row[0] for row in ROWS)
    assert {int(n) for n in re.findall(r"\((\d+)[a-c]?\)", first)} == set(range(1, 12))
    assert set(re.findall(r"Figure (\d)", first)) == set("1234")
    assert [row[0] for row in ROWS if row[0] in {claim.key for claim in CLAIMS}] == [claim.key for claim in CLAIMS]
    assert {claim.key for claim in IMAGE_CLAIMS} <= {row[0] for row in ROWS}


def test_every_claim_has_a_result_that_exists() -> None:
    """test_house checks that links lead somewhere; here, that they are there."""
    for row in ROWS:
        if row[1] in ("3.1", "3.2") or row[0].startswith("Figure"):
            assert "](" in row[4] or "same bits" in row[4] or "marked" in row[4], row
