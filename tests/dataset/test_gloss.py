"""Sequences of a scene with a glossy surface: masks, and what verify makes of them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import trimesh
from attack.planting import drop, manifest_of, named, rehash, spoilt
from numpy.typing import NDArray
from small_scenes import SCENE, box_of, painted, write_small_card
from trimesh.visual.material import PBRMaterial

from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES
from rsbench.dataset.card import DatasetCard, load_dataset_card
from rsbench.dataset.generation import generate_dataset
from rsbench.dataset.sequence import read_sequence
from rsbench.dataset.views import IMAGE_VIEWS, ImageView
from rsbench.storage.files import read_grey_png, read_json, read_mask, write_mask
from rsbench.verification import verify_dataset

Mask = NDArray[np.bool_]
ONE = ImageView("rs", "left", 1)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A card of a painted room with a black, glossy panel at an angle to the view."""
    folder = tmp_path_factory.mktemp("scenes")
    shiny = PBRMaterial(name="shiny", baseColorFactor=[20, 20, 20, 255], metallicFactor=0.0, roughnessFactor=0.1)
    room = box_of((6.0, 10.0, 4.0), painted(name="matt", metallicFactor=0.0))
    panel = box_of((1.6, 0.1, 1.6), shiny, (0.2, 1.0, 0.0))
    panel.apply_transform(trimesh.transformations.rotation_matrix(0.9, (0, 0, 1), (0.2, 1.0, 0.0)))
    trimesh.Scene({"room": room, "panel": panel}).export(folder / "hall.glb")
    card = folder / "hall.toml"
    card.write_text(SCENE.format(name="hall").replace('up_axis = "z"', 'up_axis = "z"\ngloss = "file"'))
    return card


@pytest.fixture(scope="module")
def card(scene: Path) -> DatasetCard:
    text = write_small_card(scene.parent, [scene]).read_text()
    path = scene.parent / "glossy.toml"
    path.write_text('channels = ["instances"]\ntwins = ["middle"]\n' + text)
    return load_dataset_card(str(path))


@pytest.fixture(scope="module")
def sound(card: DatasetCard, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sound") / "data"
    generate_dataset(card, out)
    return out


def faults_of(folder: Path, scenes: Sequence[Path] = ()) -> list[str]:
    reports = verify_dataset(folder, rerender="auto" if scenes else "no", scenes=scenes)
    return [fault for report in reports for fault in report.faults]


def gloss_of(change: Callable[[Mask], Mask], views: Sequence[ImageView]) -> Callable[[Path], None]:
    def plant(folder: Path) -> None:
        for view in views:
            write_mask(folder / view.gloss, change(read_mask(folder / view.gloss)))

    return plant


def test_masks_are_where_the_glossy_instance_is(sound: Path) -> None:
    sequence = read_sequence(sound / "hall")
    assert sequence.glossy and read_json(sound / "hall/sequence.json")["glossy"] is True
    table = json.loads((sound / "hall/instances.json").read_text())
    text = json.dumps(table)
    assert "shiny" in text
    numbers = [k for k, each in enumerate(table["instances"], start=1) if each["material"] == "shiny"]
    for side in SIDES:
        own = read_grey_png(sound / f"hall/instances/{side}_1.png", bits=16)
        gloss = sequence.gloss("rs", side, 1)
        # Rays of both are rounded otherwise: an edge may fall to either side of a pixel's centre.
        assert np.mean(gloss != np.isin(own, numbers)) < 1e-3 and 0.05 < np.mean(gloss) < 0.4
    middle = sequence.gloss("gs", "left", 0, row=32)
    np.testing.assert_array_equal(middle[32], sequence.gloss("rs", "left", 0)[32])


def test_a_sound_sequence_passes(sound: Path, scene: Path) -> None:
    assert faults_of(sound) == [] and faults_of(sound, [scene]) == []


@pytest.mark.parametrize(
    ("change", "views", "words"),
    [
        (lambda mask: mask & False, (ONE,), (ONE.gloss, "marks other surfaces")),
        (lambda mask: mask | True, tuple(IMAGE_VIEWS), ("_gloss/", "leaves 0 %")),
        (lambda mask: mask[:, ::-1], (ONE,), (ONE.gloss, "")),
    ],
    ids=["emptied", "of all", "flipped"],
)
def test_wrong_masks_are_named_without_the_scene(
    sound: Path,
    tmp_path: Path,
    change: Callable[[Mask], Mask],
    views: tuple[ImageView, ...],
    words: tuple[str, str],
) -> None:
    found = faults_of(spoilt(sound, tmp_path / "data", gloss_of(change, views), sequence="hall"))
    assert named(found, words), found


def test_rays_know_where_it_is_glossy(sound: Path, tmp_path: Path, scene: Path) -> None:
    def band(mask: Mask) -> Mask:
        mask[20:40] = True
        return mask

    out = spoilt(sound, tmp_path / "data", gloss_of(band, IMAGE_VIEWS), sequence="hall")
    assert any(f"{ONE.gloss}: rows 20-39" in fault and "rays meet" in fault for fault in faults_of(out, [scene]))
    manifest_of("hall/sequence.json", drop("glossy"))(out)
    rehash(out)
    found = faults_of(out, [scene])
    assert any("sequence.json: glossy = false" in fault for fault in found), found


def test_resuming_makes_a_lost_mask_again(sound: Path, card: DatasetCard, tmp_path: Path) -> None:
    out = tmp_path / "data"
    shutil.copytree(sound, out)
    assert generate_dataset(card, out) == []
    kept = (out / "hall" / ONE.gloss).read_bytes()
    (out / "hall" / ONE.gloss).unlink()
    assert generate_dataset(card, out) == ["hall"]
    assert (out / "hall" / ONE.gloss).read_bytes() == kept


def test_a_mask_holds_two_values(sound: Path, tmp_path: Path) -> None:
    from rsbench.storage.files import write_png

    write_png(tmp_path / "mask.png", np.arange(12, dtype=np.uint8).reshape(3, 4))
    with pytest.raises(RsbenchError, match=r"mask.png: must hold 0 and 255 alone"):
        read_mask(tmp_path / "mask.png")
