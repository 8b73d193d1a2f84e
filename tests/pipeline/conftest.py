"""Fixtures of the chain's tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from rsbench.dataset.sequence import Sequence, read_dataset


@pytest.fixture(scope="session")
def castle(smoke_dataset: Path) -> Sequence:
    """128 x 96 px, 1.5 deg and 0.2 m per frame."""
    return read_dataset(smoke_dataset)[0]
