"""Environment maps against closed forms, sums over directions and the path tracer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest
from numpy.typing import NDArray
from small_scenes import write_box_scene

from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.dataset.scene_hashes import scene_hash, scene_key
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.render import render_global
from rsbench.renderers.scene import MitsubaScene
from rsbench.scenes.environment import irradiance_map, lit_by, read_environment
from rsbench.scenes.load import load_scene
from rsbench.scenes.model import Light, Material, Scene, SceneMesh, Viewpoint

CARD = Light(sun_direction=(0.0, 0.6, 0.8), sun_irradiance=(2.0, 2.0, 2.0), sky_zenith=(0.4,) * 3)
AHEAD = Viewpoint(eye=(0.0, 0.0, 1.0), target=(0.0, 1.0, 1.0))
CAMERA = PinholeCamera.centred(32, 24, 20.0)


def _sky(height: int = 32) -> NDArray[np.float32]:
    """Another colour in each direction, brighter above; nothing is black."""
    y, x = np.mgrid[:height, : 2 * height]
    turn = np.pi * (x + 0.5) / height
    wave = [1.2 + np.cos(turn - 2.1 * k) * np.sin(np.pi * (y + 0.5) / height) for k in range(3)]
    return (np.stack(wave, axis=-1) * (1.5 - y / height)[..., None]).astype(np.float32)


def _image(light: Light, *meshes: SceneMesh, **options: Any) -> Any:
    scene = Scene(name="test", meshes=meshes, light=light).seen_from(AHEAD)
    return render_global(MitsubaScene(scene), CAMERA, np.eye(3), np.zeros(3), RendererOptions(**options))


def _save(path: Path, radiance: NDArray[np.float32]) -> Path:
    if path.suffix == ".hdr":
        assert cv2.imwrite(str(path), np.ascontiguousarray(radiance[..., ::-1]))
        return path
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {name: radiance[..., k].copy() for k, name in enumerate("RGB")}) as file:
        file.write(str(path))
    return path


@pytest.mark.parametrize("suffix", [".hdr", ".exr"])
def test_both_formats_are_read(tmp_path: Path, suffix: str) -> None:
    radiance = _sky()
    read = read_environment(_save(tmp_path / f"sky{suffix}", radiance))
    # RGBE has eight bits for the brightest of three values.
    np.testing.assert_allclose(read, radiance, atol=0.0 if suffix == ".exr" else radiance.max() / 128)


def test_the_middle_of_the_map_lies_ahead_and_its_right_side_at_the_right() -> None:
    radiance = np.full((32, 64, 3), 0.1, np.float32)
    radiance[:, 32:40, 0] = 2.0  # red: from ahead to an eighth of the way round, to the right
    radiance[:14, :, 1] = 1.0  # green above
    for turn, red in ((0.0, slice(18, 32)), (90.0, slice(0, 0))):
        for integrator in ("sunsky", "path"):
            image = _image(lit_by(CARD, radiance, turn), integrator=integrator, samples=4).image
            is_red = image[20, :, 0] > 3 * image[20, :, 2]
            assert np.all(is_red[red]) and not np.any(is_red[: red.start - 4])
            assert np.all(image[0, :, 1] > 3 * image[0, :, 2]) and not np.any(
                image[23, :, 1] > 3 * image[23, :, 2]
            )


def test_a_map_is_as_bright_as_the_light_of_the_card_and_its_sun_is_a_sun() -> None:
    """Level ground gets sun times sine plus sky; so much sun as a disc of so much light has."""
    radiance = np.full((64, 128, 3), 0.5, np.float32)
    row, column = 20, 80
    radiance[row, column] = 40_000.0
    light = lit_by(CARD, 7.0 * radiance, 0.0)
    down, around = np.pi * (row + 0.5) / 64, np.pi * ((column + 0.5) / 64 - 1)
    way = np.array([np.sin(down) * np.sin(around), np.sin(down) * np.cos(around), np.cos(down)])
    np.testing.assert_allclose(light.sun_direction, way, atol=1e-6)
    assert light.environment is not None
    solid = (np.cos(np.pi * row / 64) - np.cos(np.pi * (row + 1) / 64)) * np.pi / 64
    sky = float(light.environment.radiance[-1, 0, 0])
    assert np.ptp(light.environment.radiance) < 1e-6, "the sun is not in the map any more"
    assert light.sun_irradiance[0] / sky == pytest.approx((40_000.0 - 0.5) * solid / 0.5, rel=1e-6)
    horizon = 0.2126 * 0.75 + 0.7152 * 0.85 + 0.0722 * 0.95
    wanted = 2.0 * 0.8 + np.pi * (horizon + 2 * 0.4) / 3
    # The sum over 64 rows errs by about (pi / 64)^2 / 24.
    assert light.sun_irradiance[0] * way[2] + np.pi * sky == pytest.approx(wanted, rel=1e-4)
    assert lit_by(CARD, _sky(), 0.0).sun_irradiance == (0.0, 0.0, 0.0), "a map without a sun has none"


def test_open_surfaces_have_the_sum_of_all_light(quad: Any) -> None:
    light = lit_by(CARD, _sky(), 30.0)
    white = Material(name="w", colour=(1, 1, 1))
    wall = quad([[-20, 5, 21], [20, 5, 21], [20, 5, -19], [-20, 5, -19]], white)
    seen, near = (_image(light, wall, samples=1, sky_rays=rays).image[12, 16] for rays in (0, 2))
    traced = _image(light, wall, integrator="path", samples=256, max_depth=2).image.mean(axis=(0, 1))
    # 768 pixels of 256 samples that differ by less than themselves: 0.2 %; the map of open surfaces has 32 rows.
    np.testing.assert_allclose(seen, traced, rtol=0.01)
    np.testing.assert_allclose(near, traced, rtol=0.01)
    even = irradiance_map(np.ones((33, 64, 3), np.float32))
    np.testing.assert_allclose(even, 1.0, rtol=2e-3)


def test_a_card_names_its_map_and_the_hash_knows_it(tmp_path: Path) -> None:
    card = write_box_scene(tmp_path, "box")
    plain = load_scene(card)
    card.write_text(card.read_text() + '[light]\nenvironment = "sky.exr"\nenvironment_turn_deg = 45.0\n')
    with pytest.raises(RsbenchError, match=r"sky.exr: cannot be read"):
        load_scene(card)
    hashes = {scene_hash(plain)}
    for factor in (np.float32(1), np.linspace(1, 2, 64, dtype=np.float32)[:, None]):
        _save(tmp_path / "sky.exr", _sky() * factor)
        hashes.add(scene_hash(load_scene(card)))
    assert len(hashes) == 3 and scene_key(str(card)) is None


def test_what_is_no_map_is_refused_by_its_header(tmp_path: Path) -> None:
    huge = tmp_path / "huge.hdr"
    huge.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 50000 +X 100000\n")
    wide = _save(tmp_path / "wide.exr", np.ones((8, 15, 3), np.float32))
    dark = _save(tmp_path / "dark.exr", np.zeros((8, 16, 3), np.float32))
    bent = _save(tmp_path / "bent.exr", np.full((8, 16, 3), np.nan, np.float32))
    cut = tmp_path / "cut.exr"
    cut.write_bytes(_save(tmp_path / "whole.exr", _sky()).read_bytes()[:400])
    short = tmp_path / "short.hdr"
    short.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 64 +X 128\n")
    (tmp_path / "sky.png").write_bytes(b"x")
    for path, words in (
        (huge, "RSBENCH_LIMITS"),
        (wide, "15 x 8: a lat-long map is twice as wide as high"),
        (dark, "no light at all"),
        (bent, "not finite"),
        (cut, "damaged"),
        (short, "damaged"),
        (tmp_path / "sky.png", "must end in .hdr or .exr"),
    ):
        with pytest.raises(RsbenchError) as refusal:
            read_environment(path)
        assert words in str(refusal.value) and path.name in str(refusal.value) and "\n" not in str(refusal.value)
