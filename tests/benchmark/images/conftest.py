"""Evaluations of the smoke dataset."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from evaluations import evaluate


@pytest.fixture(scope="session")
def evaluated(smoke_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("evaluated")
    assert evaluate(smoke_dataset, out) == []
    return out


@pytest.fixture
def copy(evaluated: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(evaluated, tmp_path / "copy"))
