"""Verification that renders rows again: what no comparison of files with each other can show."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from attack.planting import manifest_of, put, spoilt
from small_scenes import write_box_scene, write_small_card

from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.generation import generate_dataset
from rsbench.dataset.sequence import read_dataset
from rsbench.dataset.views import ImageView
from rsbench.renderers import backend
from rsbench.storage.files import read_depth, read_png, write_depth, write_png
from rsbench.verification import SequenceReport, rerender, verify_dataset
from rsbench.verification.content import read_content
from rsbench.verification.image_checks import Picture
from rsbench.verification.rerender import image_check


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with box.toml, a scene, and the dataset of one sequence in it."""
    folder = tmp_path_factory.mktemp("rendered")
    card = write_small_card(folder, [write_box_scene(folder, "box")])
    generate_dataset(load_dataset_card(str(card)), folder / "dataset")
    return folder


def verified(sound: Path, dataset: Path, *, rerender: Any = "auto") -> SequenceReport:
    return verify_dataset(dataset, 4, rerender=rerender, scenes=[sound / "box.toml"])[-1]


def test_rows_of_sound_data_have_the_same_bits(sound: Path) -> None:
    report = verified(sound, sound / "dataset", rerender="all")
    assert report.faults == ()
    assert "64 rows" in report.notes[0] and report.notes[0].endswith("the same bits")


def test_what_a_dataset_says_of_its_scene_is_never_opened(sound: Path) -> None:
    (report,) = verify_dataset(sound / "dataset", 4, rerender="auto")
    assert report.faults == ()
    assert "name its card with --scene" in report.notes[0]


def test_a_common_scale_of_all_depth_is_found(sound: Path, tmp_path: Path) -> None:
    def change(folder: Path) -> None:
        for path in folder.glob("*_depth/*.exr"):
            write_depth(path, read_depth(path) * np.float32(1.00002))

    faults = verified(sound, spoilt(sound / "dataset", tmp_path / "data", change, sequence="box")).faults
    assert len(faults) == 8
    assert all("looks scaled by 1.00002" in fault for fault in faults)


def test_a_blur_is_found(sound: Path, tmp_path: Path) -> None:
    def change(folder: Path) -> None:
        path = folder / "gs/left_1.png"
        image = read_png(path)
        blurred = cv2.GaussianBlur(image, (0, 0), 0.6)
        blurred[0] = image[0]
        write_png(path, blurred)

    (fault,) = verified(sound, spoilt(sound / "dataset", tmp_path / "data", change, sequence="box")).faults
    assert "gs/left_1.png" in fault and "new rendering" in fault


def test_a_picture_of_other_light_is_one_finding(sound: Path, tmp_path: Path) -> None:
    """All files are consistent with each other; the exposure that sequence.json states is another."""

    change = manifest_of("sequence.json", put("renderer", "exposure", 0.9))
    faults = verified(sound, spoilt(sound / "dataset", tmp_path / "data", change, sequence="box")).faults
    images = [fault for fault in faults if "the image differs from a new rendering" in fault]
    assert len(images) == 8


@pytest.mark.parametrize(
    ("share", "by_gpu", "passes"), [(0.01, False, False), (0.01, True, True), (0.03, True, False)]
)
def test_a_gpu_may_move_more_samples_across_edges(share: float, by_gpu: bool, passes: bool) -> None:
    rng = np.random.default_rng(0)
    rendered = rng.integers(0, 200, (50, 60, 3), dtype=np.uint8)
    stored = rendered.copy()
    stored.reshape(-1, 3)[rng.choice(3000, round(share * 3000), replace=False)] += 20
    picture = Picture.of(ImageView("rs", "left", 0), stored, noisy=False)
    check = image_check("left_0.png", picture, rendered, list(range(50)), noisy=False, by_gpu=by_gpu)
    assert (check.fault is None) == passes and not check.same_bits


@pytest.mark.parametrize(
    ("here", "made", "differs"),
    [("llvm", "llvm", False), ("cuda", "cuda", False), ("llvm", "cuda", True), ("cuda", "llvm", True)],
)
def test_who_rendered_is_read_from_the_sequence(
    sound: Path, here: str, made: str, differs: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = read_content(next(iter(read_dataset(sound / "dataset"))))
    content.sequence.manifest["made_by"]["variant"] = f"{made}_ad_rgb"
    monkeypatch.setattr(backend, "_started", backend.Backend(variant=f"{here}_ad_rgb"))
    monkeypatch.delenv("RSBENCH_VARIANT", raising=False)
    assert rerender._by_gpu(content) == differs
