"""Digests of sequences: as they are defined, the same for copies, others for other content."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from commands import run_here

from rsbench.core.errors import RsbenchError
from rsbench.dataset.card import load_dataset_card
from rsbench.storage.files import read_json, write_json
from rsbench.verification.digests import digests, read_digests


@pytest.fixture
def copy(smoke_dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(smoke_dataset, tmp_path / "data"))


def by_hand(folder: Path) -> str:
    """Of all files that lie in the folder of a sequence, whatever its sequence.json lists."""
    truth = json.loads((folder / "sequence.json").read_text("utf-8"))
    del truth["made_by"], truth["files"]
    text = json.dumps(truth, sort_keys=True) + "\n"
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    for name in names:
        if name != "sequence.json":
            text += f"{hashlib.sha256((folder / name).read_bytes()).hexdigest()}  {name}\n"
    return hashlib.sha256(text.encode()).hexdigest()


def test_digests_are_of_every_file_and_of_the_truth(smoke_dataset: Path) -> None:
    assert dict(digests(smoke_dataset)) == {
        name: by_hand(smoke_dataset / name) for name in ("castle", "room-twist")
    }


def test_dates_versions_and_stated_hashes_do_not_matter(smoke_dataset: Path, copy: Path) -> None:
    for path in copy.rglob("*"):
        os.utime(path, (1e9, 1e9))
    manifest = read_json(copy / "castle/sequence.json")
    manifest["made_by"]["rsbench"] = "7.0.0"
    manifest["files"] |= {"rs/left_0.png": 64 * "0"}
    write_json(copy / "castle/sequence.json", manifest)
    (copy / "croissant.json").unlink()
    assert dict(digests(copy)) == dict(digests(smoke_dataset))


def last_byte(folder: Path, name: str) -> None:
    data = bytearray((folder / name).read_bytes())
    data[-1] ^= 1
    (folder / name).write_bytes(data)


def told_motion(folder: Path) -> None:
    manifest = read_json(folder / "sequence.json")
    manifest["motion"]["d"][0] += 1e-12
    write_json(folder / "sequence.json", manifest)


@pytest.mark.parametrize(
    "change",
    [
        lambda folder: last_byte(folder, "gs/right_1.png"),
        lambda folder: last_byte(folder, "rs_depth/right_1.exr"),
        lambda folder: last_byte(folder, "poses/right_1.csv"),
        told_motion,
    ],
)
def test_one_other_bit_is_found(copy: Path, change: Callable[[Path], None]) -> None:
    file = copy.parent / "digests.txt"
    ran = run_here("digest", copy, "--out", file)
    assert ran.returncode == 0 and "digests of 2 sequences" in ran.stdout
    assert run_here("digest", copy).stdout == file.read_text("utf-8")
    ran = run_here("digest", copy, "--check", file)
    assert ran.returncode == 0 and "2 sequences, 0 faults" in ran.stdout
    change(copy / "castle")
    ran = run_here("digest", copy, "--check", file)
    assert ran.returncode == 1 and ran.stderr == "fault: castle: has another digest\n"


def test_sequences_of_one_side_alone_are_named(copy: Path) -> None:
    file = copy.parent / "digests.txt"
    file.write_bytes(b"".join(f"{64 * '0'}  {name}\r\n".encode() for name in ("castle", "street")))
    ran = run_here("digest", copy, "--check", file)
    assert ran.returncode == 1 and "2 sequences, 3 faults" in ran.stdout
    assert "room-twist: is not in the file" in ran.stderr and "street: is in the file and not" in ran.stderr


def test_what_is_missing_or_no_digest_is_refused(copy: Path) -> None:
    file = copy.parent / "digests.txt"
    for text in ("abc  castle\n", f"{64 * '0'} castle\n", 2 * f"{64 * '0'}  castle\n", f"{64 * '0'}  ../castle\n"):
        file.write_text(text, "utf-8", newline="\n")
        with pytest.raises(RsbenchError, match=r"digests.txt: line \d: .*two spaces"):
            read_digests(file)
    assert run_here("digest", copy, "--check", copy.parent / "none.txt").returncode == 2
    assert run_here("digest", copy, "--check", file, "--out", file).returncode == 2
    (copy / "castle/rs/left_0.png").unlink()
    ran = run_here("digest", copy)
    assert ran.returncode == 2 and "left_0.png: is in sequence.json and not in the folder" in ran.stderr
    assert not ran.stdout


def test_those_of_standard_are_of_all_its_sequences() -> None:
    stored = Path(__file__).parents[2] / "cards/references/standard-avx512.txt"
    card = load_dataset_card("standard")
    assert list(read_digests(stored)) == [each.name for each in card.sequence]
