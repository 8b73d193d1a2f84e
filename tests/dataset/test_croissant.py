"""croissant.json of a dataset, as the reader of MLCommons sees it."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import mlcroissant
import numpy as np
import pytest

from rsbench.core.rig import views_of
from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.manifest import croissant_of
from rsbench.dataset.sequence import read_dataset
from rsbench.verification import verify_dataset

# Of the reader's own dependencies.
pytestmark = pytest.mark.filterwarnings(
    "ignore::DeprecationWarning:rdflib", "ignore::DeprecationWarning:mlcroissant"
)


def test_mlcroissant_accepts_it_without_a_word_and_reads_frames_and_poses(smoke_dataset: Path) -> None:
    read = mlcroissant.Dataset(jsonld=str(smoke_dataset / "croissant.json"))
    assert not read.metadata.ctx.issues.errors and not read.metadata.ctx.issues.warnings
    assert read.metadata.license == ["https://spdx.org/licenses/CC-BY-4.0.html"]
    scenes = [(r["sequences/name"], r["sequences/scene"]) for r in read.records("sequences")]
    assert scenes == [(b"castle", b"castle"), (b"room-twist", b"room")]
    sequences = {sequence.name: sequence for sequence in read_dataset(smoke_dataset)}
    frames = {
        (r["frames/sequence"].decode(), r["frames/side"].decode(), r["frames/frame"]): r["frames/image"]
        for r in read.records("frames")
    }
    assert set(frames) == {(name, *view) for name in sequences for view in views_of(2)}
    for (name, side, frame), image in frames.items():
        np.testing.assert_array_equal(np.asarray(image), sequences[name].image("rs", side, frame))
    rows = [r for r in read.records("rows") if r["rows/sequence"] == b"castle" and r["rows/side"] == b"right"]
    tau, pose = sequences["castle"].poses("right", 1)
    own = sorted((r for r in rows if r["rows/frame"] == 1), key=lambda r: r["rows/row"])
    np.testing.assert_array_equal([r["rows/tau"] for r in own], tau)
    np.testing.assert_array_equal([[r[f"rows/t{axis}"] for axis in "xyz"] for r in own], pose.t)
    sets = {each.id: each.includes for each in read.metadata.file_sets}
    assert sets["rs_depth"] == ["*/rs_depth/*.exr"] and sets["sequence.json"] == ["*/sequence.json"]


def test_every_kind_of_file_has_a_set_of_its_own() -> None:
    files = ["a/matches/0.npz", "a/matches/matcher.json", "b/matches/0.npz", "a/gs_twin/0450/left_0.png"]
    manifest = dict.fromkeys(("name", "description", "license", "rsbench"), "x") | {"files": files}
    sets = {each["@id"]: each["includes"] for each in croissant_of(manifest, "")["distribution"][1:]}
    assert sets == {
        "matches": "*/matches/*.npz",
        "matches.json": "*/matches/*.json",
        "gs_twin": "*/gs_twin/*/*.png",
    }


def test_verify_names_a_croissant_file_that_tells_of_another_dataset(smoke_dataset: Path, tmp_path: Path) -> None:
    shutil.copytree(smoke_dataset, tmp_path / "data")
    path = tmp_path / "data" / "croissant.json"
    path.write_text(path.read_text("utf-8").replace("CC-BY-4.0", "CC0-1.0"), "utf-8")
    first, *_ = verify_dataset(tmp_path / "data", rerender="no")
    assert first.name == "dataset.json" and "croissant.json: does not describe dataset.json" in first.faults[0]


def test_a_card_names_the_licence_of_what_it_makes() -> None:
    card = load_dataset_card("smoke")
    assert (card.license, replace(card, license="CC0-1.0").license) == ("CC-BY-4.0", "CC0-1.0")
    with pytest.raises(ValueError, match="license = 'of mine': must be an SPDX name"):
        replace(card, license="of mine")
