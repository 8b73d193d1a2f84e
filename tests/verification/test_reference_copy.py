"""A dataset against the reference copy of its card."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import run_here

from rsbench.dataset.card import load_dataset_card
from rsbench.storage.files import read_json, read_png, sha256, write_json, write_png
from rsbench.verification.digests import against_reference, references


def test_what_is_rendered_here_is_the_reference_copy_or_alike(smoke_dataset: Path) -> None:
    found = list(against_reference(smoke_dataset))
    assert [(each.name, each.fault) for each in found] == [("castle", ""), ("room-twist", "")]


def test_every_reference_copy_has_the_sequences_of_its_card() -> None:
    assert {"smoke", "standard"} <= references().keys()
    for name, path in references().items():
        card, content = load_dataset_card(name), read_json(path)
        assert content["name"] == name and path.stat().st_size < 100_000
        assert list(content["sequences"]) == [each.name for each in card.sequence]
        assert len({each["sha256"] for each in content["sequences"].values()}) == len(card.sequence)


@pytest.mark.parametrize(("levels", "words"), [(0.0, "are alike"), (1.0, "castle: rs/left_0.png: grey")])
def test_other_bytes_are_alike_and_other_pictures_are_named(
    smoke_dataset: Path, tmp_path: Path, levels: float, words: str
) -> None:
    """One pixel by one level, as on another processor; and one level everywhere."""
    shutil.copytree(smoke_dataset, tmp_path / "data")
    folder = tmp_path / "data/castle"
    image = read_png(folder / "rs/left_0.png").astype(float) + levels
    image[5, 7] += 1 - levels
    write_png(folder / "rs/left_0.png", np.clip(image, 0, 255).astype(np.uint8))
    manifest = read_json(folder / "sequence.json")
    manifest["files"]["rs/left_0.png"] = sha256(folder / "rs/left_0.png")
    write_json(folder / "sequence.json", manifest)
    found = list(against_reference(tmp_path / "data"))
    assert sum(bool(each.fault) for each in found) == (levels > 0) and not found[0].same
    # The other sequence has the reference's bytes on its processor alone.
    words = f"{sum(not each.same for each in found)} {words}" if levels == 0.0 else words
    ran = run_here("verify", tmp_path / "data", "--rerender", "no", "--reference")
    assert words in ran.stdout + ran.stderr and "of 2 sequences have its bytes" in ran.stdout


def test_a_dataset_without_a_reference_copy_is_refused(smoke_dataset: Path, tmp_path: Path) -> None:
    shutil.copytree(smoke_dataset, tmp_path / "data")
    path = tmp_path / "data/dataset.json"
    path.write_text(path.read_text("utf-8").replace('"name": "smoke"', '"name": "mine"', 1), "utf-8")
    ran = run_here("verify", tmp_path / "data", "--reference")
    assert ran.returncode == 2 and "'mine' has no reference copy" in ran.stderr
