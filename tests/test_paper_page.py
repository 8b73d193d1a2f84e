"""docs/explanation/paper.md names what exists, and every equation, figure and claim of the paper."""

from __future__ import annotations

import ast
import importlib
import re

import pytest
from documents import ROOT, results

from rsbench.benchmark.studies.claims import CLAIMS, IMAGE_CLAIMS, judge_image_claims

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
        assert len(row) in (5, 6), row
        assert re.search(r"`rsbench/.*::", row[-3]), row
        assert re.search(r"`tests/.*::test_", row[-2]), row


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
            assert "](" in row[-1] or "same bits" in row[-1] or "marked" in row[-1], row


def test_verdicts_are_those_of_the_stored_results() -> None:
    """Holds: in every setting, read literally. Fails: in every setting, at best. In brackets: of one noise."""
    shown = {row[0]: row[2] for row in ROWS if len(row) == 6}
    expected = {}
    for claim in CLAIMS:
        settings = [row for row in results("claims/best-readings.csv") if row["claim"] == claim.key]
        most = [row for row in settings if row["matches"] == settings[0]["matches"]]
        noises = {row["noise"]: _word([row]) for row in most}
        single = [f"{n.replace('1e-3', '10^-3')}: {word}" for n, word in noises.items() if word != "depends"]
        word = _word(settings)
        expected[claim.key] = f"{word} ({'; '.join(single)})" if word == "depends" and single else word
    images = judge_image_claims(ROOT / "results")
    for claim in IMAGE_CLAIMS:
        found = set(images[images.claim == claim.key].verdict)
        expected[claim.key] = found.pop() if found in ({"holds"}, {"fails"}) else "depends"
    assert {key: word for key, word in shown.items() if key in expected} == expected
    by_test_alone = {"the left part of the depth map has no estimate", "GS frames cut into RS frames row by row"}
    assert shown.keys() - expected.keys() == by_test_alone and {shown[key] for key in by_test_alone} == {"holds"}


def test_the_best_readings_are_those_of_the_claims() -> None:
    """The literal verdict on the mean is that of claims.csv."""
    literal = {
        (row["claim"], row["matches"], row["noise"]): row["verdict"]
        for row in results("claims/claims.csv")
        if (row["solver"], row["statistic"]) == ("literal", "mean")
    }
    for row in results("claims/best-readings.csv"):
        key = row["claim"], row["matches"], row["noise"]
        assert literal.get(key, row["literal"]) == row["literal"], key
    assert len(literal) > 20


def _word(settings: list[dict[str, str]]) -> str:
    if all(row["literal"] == "holds" for row in settings):
        return "holds"
    return "fails" if all(row["best"] == "fails" for row in settings) else "depends"
