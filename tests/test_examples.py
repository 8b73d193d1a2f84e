"""The notebook: clean as committed, and of public names alone. That it runs: test_installed_wheel.py."""

from __future__ import annotations

import ast
import json
import re
import runpy
from pathlib import Path

import numpy as np
import pytest
from documents import ROOT, notebook_code
from PIL import Image, ImageSequence

import rsbench
from rsbench.cli.small_commands import docs, list_documents

NOTEBOOK = ROOT / "examples" / "tour.ipynb"


def test_the_notebook_is_committed_without_outputs() -> None:
    assert list((ROOT / "examples").glob("*.ipynb")) == [NOTEBOOK]
    content = json.loads(NOTEBOOK.read_text("utf-8"))
    assert content["nbformat"] == 4
    for cell in content["cells"]:
        assert cell["id"]
        if cell["cell_type"] == "code":
            assert cell["outputs"] == [] and cell["execution_count"] is None


def test_the_notebook_uses_public_names_alone() -> None:
    code, modules = notebook_code(NOTEBOOK), set()
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            modules.add(str(node.module))
    assert modules == {"pathlib", "matplotlib.pyplot", "numpy", "rsbench"}
    assert set(re.findall(r"\brsbench\.(\w+)", code)) <= set(rsbench.__all__)


def test_documents_and_examples_are_listed_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    documents = list_documents()
    assert {path for path in documents.values() if path.suffix == ".md"} == {
        path for path in (ROOT / "docs").rglob("*.md") if path.name != "index.md"
    }
    assert documents["tour.ipynb"] == NOTEBOOK
    docs()
    listed = capsys.readouterr().out
    assert all(name in listed for name in documents) and "A tour of rsbench" in listed
    docs("conventions")
    assert capsys.readouterr().out == f"{ROOT / 'docs' / 'explanation' / 'conventions.md'}\n"


def test_a_document_that_does_not_exist_is_named_with_the_nearest() -> None:
    with pytest.raises(
        rsbench.RsbenchError, match=r"document 'convention' does not exist \(did you mean 'conventions'"
    ):
        docs("convention")


def test_a_mesh_becomes_a_dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The script as printed, on smaller frames; what it makes is what verify finds."""
    script = runpy.run_path(str(ROOT / "examples" / "own_mesh.py"))
    small = script["DATASET"].replace("480", "96").replace("360", "72").replace("default", "preview")
    monkeypatch.setitem(script["main"].__globals__, "DATASET", small)
    monkeypatch.setattr("sys.argv", ["own_mesh.py", "--out", str(tmp_path), "--picture", str(tmp_path / "p.jpg")])
    script["main"]()
    assert (tmp_path / "p.jpg").stat().st_size > 1000
    assert not any(report.faults for report in rsbench.verify(tmp_path / "data"))
    (sequence,) = rsbench.read_dataset(tmp_path / "data")
    depth = sequence.depth("rs", "left", 0)
    assert depth[36:].min() > 0.0  # the ground, at least
    assert 3.5 < depth[20:40, 36:60].min() < 5.1  # the model, in the middle, 5 m away


def test_a_dataset_becomes_one_picture(
    smoke_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    picture = tmp_path / "sheet.png"
    monkeypatch.setattr("sys.argv", ["contact_sheet.py", str(smoke_dataset), str(picture)])
    runpy.run_path(str(ROOT / "examples" / "contact_sheet.py"), run_name="__main__")
    sheet = np.asarray(Image.open(picture))
    for column, sequence in enumerate(rsbench.read_dataset(smoke_dataset)):
        np.testing.assert_array_equal(sheet[:, 128 * column : 128 * (column + 1)], sequence.image("rs", "left", 0))
    assert sheet.shape == (96, 3 * 128, 3) and not sheet[:, 2 * 128 :].any()


def test_a_correction_becomes_a_moving_picture(smoke_dataset: Path, tmp_path: Path) -> None:
    """Two frames: as photographed and corrected, then the truth in both places; the depth stands still."""
    script = runpy.run_path(str(ROOT / "examples" / "before_after.py"))
    (sequence, *_) = rsbench.read_dataset(smoke_dataset)
    script["moving_picture"](sequence, tmp_path / "moving.gif")
    with Image.open(tmp_path / "moving.gif") as moving:
        shown = [np.asarray(frame.convert("RGB")).astype(float) for frame in ImageSequence.Iterator(moving)]
    assert len(shown) == 2
    width, head = script["WIDTH"], script["HEAD"]
    starts = [column * (width + script["GAP"]) for column in range(3)]
    before, after, depth = ([frame[head:, left : left + width] for frame in shown] for left in starts)
    assert np.abs(after[0] - after[1]).mean() < 0.8 * np.abs(before[0] - before[1]).mean()
    assert np.abs(before[1] - after[1]).mean() < 1.0 and np.abs(depth[0] - depth[1]).mean() < 1.0
