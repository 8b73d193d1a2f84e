"""Sequences of a sensor that is not ideal: exposure and noise in the frames, a clean twin beside them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import trimesh
from attack.planting import spoilt
from channel_faults import image_of
from numpy.typing import NDArray
from small_scenes import write_box_scene, write_small_card

from rsbench.components.cards import load_card
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import VIEWS
from rsbench.dataset.card import CameraCard, DatasetCard, load_dataset_card
from rsbench.dataset.generation import generate_dataset, seen_scene
from rsbench.dataset.sequence import read_sequence
from rsbench.renderers.image import Sensor, compressed, fall_off, to_srgb8
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.render import LinePoses, render, sensed_rows
from rsbench.renderers.scene import MitsubaScene
from rsbench.scenes.model import Scene
from rsbench.storage.files import read_png, write_png
from rsbench.verification import verify_dataset
from rsbench.verification.content import read_content
from rsbench.verification.sensor_checks import sensor_faults

NOISY = Sensor(full_well=6000, gain=4, photon_noise=True, read_noise=2.5, bit_depth=10)

CAMERA = replace(
    NOISY, exposure_s=0.01, right_exposure_s=0.0, mosaic="GRBG", right_mosaic="BGGR", right_jpeg_quality=80
)
UNEVEN = replace(NOISY, right_gain=12, right_exposure_s=0.01, brightness=(1.0, 0.6), right_brightness=0.8)


def _card(sensor: Sensor | None, **fields: object) -> DatasetCard:
    smoke = load_dataset_card("smoke")
    camera = CameraCard(width=96, height=72, focal=112.0)
    return replace(smoke, camera=camera, sequence=smoke.sequence[1:], sensor=sensor, **fields)  # pyrefly: ignore[bad-argument-type]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, scenes_once: None) -> dict[str, Path]:
    """Folders of one sequence: an ideal sensor, one with noise, with an exposure too, and two pairs unlike."""
    exposed = replace(NOISY, exposure_s=0.02)
    sensors = {"ideal": None, "noisy": NOISY, "exposed": exposed, "uneven": UNEVEN, "camera": CAMERA}
    folders = {}
    for name, sensor in sensors.items():
        folders[name] = tmp_path_factory.mktemp("sensors") / name
        generate_dataset(_card(sensor), folders[name])
        assert generate_dataset(_card(sensor), folders[name]) == [], "a second run has nothing to do"
    return {name: folder / "room-twist" for name, folder in folders.items()}


def test_the_clean_twin_is_the_frame_of_an_ideal_sensor(made: dict[str, Path]) -> None:
    for name in ("noisy", "exposed", "camera"):
        for file in ("left_0.png", "right_1.png"):
            assert (made[name] / "rs_clean" / file).read_bytes() == (made["ideal"] / "rs" / file).read_bytes()
        for file in ("rs_depth/left_1.exr", "gs/left_1.png", "gs_depth/right_0.exr", "poses/left_1.csv"):
            assert (made[name] / file).read_bytes() == (made["ideal"] / file).read_bytes()
    assert not (made["ideal"] / "rs_clean").exists()


def _linear(image: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1, backwards."""
    x = image / 255.0
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def test_noise_on_rendered_frames_is_the_model_s(made: dict[str, Path]) -> None:
    sequence = read_sequence(made["noisy"])
    assert sequence.sensor == NOISY
    seen, clean = (
        np.stack([_linear(image(side, frame)) for side in ("left", "right") for frame in (0, 1)])
        for image in (lambda side, frame: sequence.image("rs", side, frame), sequence.clean_image)
    )
    middle = (clean > 0.05) & (clean < 0.8)
    # Both images are rounded to 8 bits of sRGB: one twelfth of a step each, whose size is the curve's slope.
    step = (_linear(np.minimum(255.0 * _srgb(clean) + 0.5, 255.0)) - _linear(255.0 * _srgb(clean) - 0.5)) ** 2
    variance = NOISY.variance(clean) + 2 * step / 12
    z = ((seen - clean) / np.sqrt(variance))[middle]
    assert middle.sum() > 30_000
    assert abs(z.mean()) < 0.03 and z.var() == pytest.approx(1.0, abs=0.05)


def _srgb(linear: np.ndarray) -> np.ndarray:
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def test_unlike_cameras_show_the_light_of_their_frames(made: dict[str, Path]) -> None:
    sequence = read_sequence(made["uneven"])
    assert sequence.sensor == UNEVEN
    light = {("left", 0): 1.0, ("left", 1): 0.6, ("right", 0): 0.8, ("right", 1): 0.48}
    for view in VIEWS:
        seen, clean = _linear(sequence.image("rs", *view)), _linear(sequence.clean_image(*view))
        middle = (clean > 0.05) & (clean < 0.8)
        # 3 % noise of a pixel, thousands of pixels, and a blur that moves light across the bounds.
        assert np.median(seen[middle] / clean[middle]) == pytest.approx(light[view], rel=0.02)


def test_another_brightness_than_the_sensor_s_is_named(made: dict[str, Path]) -> None:
    sequence = read_sequence(made["uneven"])
    content = read_content(sequence)
    content.sequence = replace(sequence, sensor=replace(UNEVEN, brightness=(1.0, 0.7)))
    named = [fault.file for fault in sensor_faults(content, ())]
    # The right camera's blur and noise hide it; its rows that are rendered again tell.
    assert "rs/left_1.png" in named and set(named) <= {"rs/left_1.png", "rs/right_1.png"}


def test_such_sequences_are_verified(made: dict[str, Path]) -> None:
    for name in ("noisy", "exposed", "uneven", "camera"):
        (report,) = verify_dataset(made[name].parent)
        assert report.faults == ()


FAULTS: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "the clean twin": lambda seen, clean: clean,
    "of more noise": lambda seen, clean: np.clip(
        seen + np.random.default_rng(1).normal(0, 9, seen.shape), 0, 255
    ).astype(np.uint8),
    "black": lambda seen, clean: np.zeros_like(seen),
    "channels exchanged": lambda seen, clean: seen[..., ::-1],
    "upside down": lambda seen, clean: seen[::-1],
    "mirrored": lambda seen, clean: seen[:, ::-1],
    "brighter": lambda seen, clean: np.minimum(seen.astype(int) + 12, 255).astype(np.uint8),
    "one row replaced": lambda seen, clean: np.concatenate([seen[:40], 255 - seen[40:41], seen[41:]]),
}


def test_rows_of_a_sensor_are_made_again(made: dict[str, Path], tmp_path: Path) -> None:
    """Bit for bit; so a sharp frame with noise of the right size but of other random numbers is found."""
    for name in ("exposed", "camera"):
        (report,) = verify_dataset(made[name].parent, 4, rerender="auto")
        assert report.faults == () and report.notes[0].endswith("the same bits")
    sequence = read_sequence(made["exposed"])
    light = _linear(sequence.clean_image("left", 1).astype(np.float64))
    noise = np.random.default_rng(3).normal(0.0, 1.0, light.shape) * np.sqrt(NOISY.variance(light))
    forged = np.round(255.0 * _srgb(np.clip(light + noise, 0.0, 1.0))).astype(np.uint8)
    plant = image_of("rs/left_1.png", lambda seen: forged)
    copy = spoilt(made["exposed"].parent, tmp_path / "data", plant, sequence="room-twist")
    (report,) = verify_dataset(copy, 4, rerender="auto")
    assert any(fault.startswith("rs/left_1.png: ") and "new rendering" in fault for fault in report.faults)


# Global-shutter images as the sensor exposes them


@pytest.fixture(scope="module")
def twins(tmp_path_factory: pytest.TempPathFactory, scenes_once: None) -> Path:
    """A dataset of a sensor with exposure, fall-off and no noise; exposed twins of the first and middle row."""
    sensor = Sensor(exposure_s=0.02, vignetting=0.3, brightness=(1.0, 0.7))
    folder = tmp_path_factory.mktemp("twins") / "data"
    generate_dataset(_card(sensor, exposed_twins=True, twins=("middle",)), folder)
    return folder


def test_a_row_of_an_exposed_twin_is_that_of_the_rolling_frame(twins: Path) -> None:
    """Where both are exposed about one time, by the same samples, the bits are the same; elsewhere not."""
    sequence = read_sequence(twins / "room-twist")
    for (side, frame), row in product(VIEWS, (0, 36)):
        seen, twin = sequence.image("rs", side, frame), sequence.exposed_image(side, frame, row)
        np.testing.assert_array_equal(seen[row], twin[row])
        assert np.any(seen[71 - row] != twin[71 - row])


def test_an_exposed_twin_is_the_mean_of_the_images_of_its_instants(built_scene: Callable[[str], Scene]) -> None:
    """Frames of an ideal global shutter at the 64 times of the exposure, averaged as light."""
    card, sensor, row = _card(None), Sensor(exposure_s=0.1, vignetting=0.3), 36
    options = replace(load_card(RendererOptions, "renderers", "preview"), samples=64, seed=1)
    scene = MitsubaScene(seen_scene(built_scene("room"), card.sequence[0]))
    geometry = card.geometry_of(card.sequence[0])
    found = sensed_rows(scene, geometry, ("left", 0), sensor, card.frame_period_s, options, twin=row)
    at, light = geometry.shutter.row_time(row, 0), fall_off(sensor, 96, 72, range(72))[..., None]

    def seen(tau: float) -> NDArray[np.float32]:
        poses = geometry.rig.cam_from_world(geometry.motion, np.full(72, tau), "left")
        return render(scene, geometry.rig.camera, LinePoses(*poses), replace(options, samples=4)).image

    instants = at + sensor.exposure_s / card.frame_period_s * ((np.arange(64) + 0.5) / 64 - 0.5)
    whole = [np.mean([seen(float(tau)) for tau in instants], axis=0), seen(float(at))]
    errors = [
        found.astype(float) - to_srgb8((each * light).astype(np.float32), options.exposure) for each in whole
    ]
    blurred, sharp = (float(np.sqrt(np.mean(error**2))) for error in errors)
    # Each instant is seen once in a pixel, at another place of it: what is left is Monte Carlo error.
    assert blurred < 0.5 * sharp and abs(np.mean(errors[0])) < 0.2


def test_exposed_twins_are_verified(twins: Path, tmp_path: Path) -> None:
    (report,) = verify_dataset(twins, 4, rerender="auto")
    assert report.faults == () and report.notes[0].endswith("the same bits")
    for number, file in enumerate(("gs_exposed/left_1.png", "gs_twin_exposed/0036/right_0.png")):
        copy = spoilt(twins, tmp_path / str(number), image_of(file, np.flipud), sequence="room-twist")
        (report,) = verify_dataset(copy)
        assert any(fault.startswith(f"{file}: ") and "beyond 5 sigma" in fault for fault in report.faults)
        (copy / "room-twist" / file).unlink()
        (report,) = verify_dataset(copy)
        assert any(file in fault for fault in report.faults)


def test_without_exposed_twins_there_is_one_line(made: dict[str, Path]) -> None:
    with pytest.raises(RsbenchError, match="has no global-shutter images of its sensor; render it again with"):
        read_sequence(made["exposed"]).exposed_image("left", 0)
    ideal = read_sequence(made["ideal"])
    np.testing.assert_array_equal(ideal.exposed_image("left", 0), ideal.image("gs", "left", 0))
    assert "exposed_twins" not in ideal.manifest, "an ideal sensor exposes no instant"


def _with_a_clean_row(seen: np.ndarray, clean: np.ndarray) -> np.ndarray:
    return np.concatenate([seen[:41], clean[41:42], seen[42:]])


PROCESSED: dict[str, tuple[str, Callable[[np.ndarray, np.ndarray], np.ndarray], str]] = {
    "clean": ("left", lambda seen, clean: clean, "looks like no mosaic"),
    "of another mosaic": ("left", lambda seen, clean: np.roll(seen, 1, axis=0), "looks like BGGR"),
    "compressed": ("left", lambda seen, clean: compressed(seen, 85), "not interpolated from a mosaic GRBG"),
    "black": ("right", lambda seen, clean: np.zeros_like(seen), "beyond 5 sigma"),
    "not compressed": ("right", lambda seen, clean: clean, "looks not compressed"),
    "of another quality": ("right", lambda seen, clean: compressed(seen, 60), "looks like quality 60"),
    "a row replaced": ("right", _with_a_clean_row, "rows 40-47"),
    "darker": ("right", lambda seen, clean: compressed(seen // np.uint8(2), 80), "beyond 5 sigma"),
}
# A blur of a fine texture hides how much noise and light there is; rows that are rendered again tell.
HIDDEN = {("exposed", fault) for fault in ("the clean twin", "of more noise", "brighter")}
OTHERWISE = {
    **{(name, fault): ("left", FAULTS[fault], "") for name, fault in product(("noisy", "exposed"), FAULTS)},
    **{("camera", fault): case for fault, case in PROCESSED.items()},
}


@pytest.mark.parametrize(("name", "fault"), [case for case in OTHERWISE if case not in HIDDEN])
def test_frames_that_the_sensor_cannot_have_made_are_named(
    made: dict[str, Path], name: str, fault: str, tmp_path: Path
) -> None:
    """The checks of hashes aside: an adversary mends those."""
    side, change, words = OTHERWISE[name, fault]
    sequence, file = read_sequence(made[name]), f"rs/{side}_1.png"
    content = read_content(sequence)
    copy = Path(shutil.copytree(made[name], tmp_path / sequence.name))
    bad = change(read_png(copy / file), read_png(copy / f"rs_clean/{side}_1.png"))
    write_png(copy / file, np.ascontiguousarray(bad))
    content.sequence = read_sequence(copy)
    (found,) = sensor_faults(content, ())
    assert found.file == file and words in str(found), found


def test_an_exposure_without_noise_is_no_fault(tmp_path: Path) -> None:
    """On walls of one colour the frame and its twin are equal: there is no noise to miss."""
    scene = write_box_scene(tmp_path, "grey")
    box = trimesh.creation.box((6.0, 10.0, 4.0))
    box.invert()
    box.visual.face_colors = np.full((12, 4), (180, 180, 180, 255), dtype=np.uint8)
    box.export(tmp_path / "grey.glb")
    card = write_small_card(tmp_path, [scene])
    card.write_text(
        card.read_text().replace("[camera]", "frame_period_s = 0.1\n[sensor]\nexposure_s = 0.004\n[camera]")
    )
    generate_dataset(load_dataset_card(str(card)), tmp_path / "out")
    content = read_content(read_sequence(tmp_path / "out" / "grey"), set())
    assert list(sensor_faults(content, ())) == []


def test_a_card_says_what_its_sensor_cannot_be() -> None:
    with pytest.raises(ValueError, match=r"exposure_s = 0.2: longer than frame_period_s = 0.1"):
        _card(Sensor(exposure_s=0.2))
