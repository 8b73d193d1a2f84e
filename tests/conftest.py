"""Fixtures that several parts share."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from rsbench.imports import import_untried

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # Started in the background of a shell without job control: the commands that tests interrupt would inherit it.
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Modules that tests write are not tried in a process of their own first, which takes half a second for each. The
# command line, which tests start as others do, does it.
import_untried()


@pytest.fixture(scope="session")
def smoke_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset of datasets/smoke.toml, rendered once per test run."""
    # Imported here, so that a broken part does not stop the tests of the others.
    from rsbench.dataset.card import load_dataset_card
    from rsbench.dataset.generation import generate_dataset

    folder = tmp_path_factory.mktemp("smoke") / "smoke"
    generate_dataset(load_dataset_card("smoke"), folder)
    return folder
