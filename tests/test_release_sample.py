"""The sample of a release: an archive that loaders read once it is unpacked, the same whenever it is made."""

from __future__ import annotations

import hashlib
import os
import shutil
import zipfile
from pathlib import Path
from types import ModuleType

import programs
import pytest
from commands import run_here

import rsbench
from rsbench.dataset.card import load_dataset_card
from rsbench.storage.files import sha256
from rsbench.storage.work_folder import HIDDEN


@pytest.fixture(scope="module")
def program() -> ModuleType:
    return programs.program("benchmarks/release_sample.py")


def test_what_is_unpacked_is_what_was_packed(program: ModuleType, smoke_dataset: Path, tmp_path: Path) -> None:
    file = tmp_path / "tiny.zip"
    file.write_bytes(program.packed(smoke_dataset, "tiny"))
    with zipfile.ZipFile(file) as archive:
        assert archive.testzip() is None and not any(HIDDEN in name for name in archive.namelist())
        archive.extractall(tmp_path)
    ours, theirs = rsbench.read_dataset(tmp_path / "tiny"), rsbench.read_dataset(smoke_dataset)
    assert [each.name for each in ours] == [each.name for each in theirs] == ["castle", "room-twist"]
    for sequence in ours:
        for name, expected in sequence.manifest["files"].items():
            assert sha256(sequence.folder / name) == expected
    ran = run_here("verify", tmp_path / "tiny", "--fast")
    assert ran.returncode == 0 and "2 sequences, 0 faults" in ran.stdout


def test_a_copy_made_later_has_the_same_bytes(program: ModuleType, smoke_dataset: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(smoke_dataset, tmp_path / "copy")
    for path in copy.rglob("*.png"):
        os.utime(path, (1e9, 1e9))
        path.chmod(0o600)
    digests = {hashlib.sha256(program.packed(each, "tiny")).hexdigest() for each in (smoke_dataset, copy)}
    assert len(digests) == 1


def test_a_large_one_is_refused(program: ModuleType, smoke_dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(program, "MOST_BYTES", 1000)
    with pytest.raises(rsbench.RsbenchError, match="bytes packed, of 1000"):
        program.packed(smoke_dataset, "tiny")


def test_the_card_has_ten_sequences_of_all_scenes(program: ModuleType) -> None:
    card = load_dataset_card(program.CARD)
    assert len(card.sequence) == 10
    assert {each.scene for each in card.sequence} == {
        each.scene for each in load_dataset_card("standard").sequence
    }
