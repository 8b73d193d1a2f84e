"""Noise and cell patterns: ranges, periodicity, closed forms, determinism."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rsbench.scenes.palette import RECIPES, paint_palette
from rsbench.scenes.surfaces import Surface
from rsbench.scenes.textures import Noise, NoiseKind, cut_courses, fractal_noise, pick, ramp, to_bytes, value_noise

KINDS: tuple[NoiseKind, ...] = ("broad", "smooth", "fine", "grain")


def seam_ratio(texture: NDArray[Any], axis: int) -> float:
    """Step across the border of a repeated texture over the strongest step between two neighbouring lines inside.

    Joints between stones may lie on the border, so it is measured against other joints. A texture that does not
    repeat steps as much as unrelated lines do, several times that.
    """
    lines = np.moveaxis(texture.astype(np.float64), axis, 0).reshape(texture.shape[axis], -1)
    steps = np.abs(np.diff(lines, axis=0)).mean(axis=1)
    return float(np.abs(lines[0] - lines[-1]).mean() / steps.max())


def test_value_noise_is_bounded_smooth_and_periodic() -> None:
    noise = value_noise(np.random.default_rng(1), (256, 512), (8, 16))
    assert noise.dtype == np.float32 and noise.shape == (256, 512)
    assert np.abs(noise).max() <= 1
    # A cell is 32 pixels; the steepest step of a smoothstep over a range of 2 is 1.5 * 2 / 32.
    for axis in (0, 1):
        assert np.abs(np.diff(noise, axis=axis)).max() <= 1.5 * 2 / 32
        assert np.abs(noise.take(0, axis) - noise.take(-1, axis)).max() <= 1.5 * 2 / 32


def test_value_noise_has_its_lattice_values_at_cell_corners() -> None:
    lattice = np.random.default_rng(3).random((4, 4), dtype=np.float32) * 2 - 1
    noise = value_noise(np.random.default_rng(3), (4096, 4), (4, 4))
    # Pixel centres sit half a pixel beside the corner: rows 1024 k + 0.5, and midway between columns' corners.
    between = (lattice + np.roll(lattice, -1, axis=1)) / 2
    assert noise[::1024] == pytest.approx(between, abs=1e-5)


def test_fractal_noise_has_the_promised_deviation() -> None:
    for octaves in (1, 4, 7):
        deviation = fractal_noise(np.random.default_rng(2), (512, 512), (8, 8), octaves, 0.7).std()
        assert deviation == pytest.approx(0.5, rel=0.2)  # 64 cells of the first octave: 10 % of sampling noise


def test_noise_draws_are_periodic_at_every_size() -> None:
    noise = Noise((1, 2), 128)
    for pixels in (64, 128, 256):
        for kind in KINDS:
            field = noise.draw(np.random.default_rng(0), kind, pixels)
            assert field.shape == (pixels, pixels)
            assert max(seam_ratio(field, 0), seam_ratio(field, 1)) < 1.3
    cut = noise.draw(np.random.default_rng(0), "smooth")[:40]
    assert seam_ratio(cut, 0) > 3  # what the measure says of a texture that does not repeat


def test_courses_of_known_size() -> None:
    cells = cut_courses(np.random.default_rng(0), 400, 4.0, (0.5, 0.5), (1.0, 1.0))
    assert cells.count == 8 * 4
    # Every block is 0.5 m x 1 m, so its inradius is 0.25 m, and blocks share the area equally.
    assert cells.edge.max() == pytest.approx(0.25, abs=0.011)
    assert np.unique(np.bincount(cells.index.ravel()) / (50 * 100)) == pytest.approx(1.0, abs=0.03)
    assert np.array_equal(cells.course, np.repeat(np.arange(8), 50)[:, None] * np.ones((1, 400), int))
    assert cells.across[0].max() < 0.03 and cells.across[49].min() > 0.95


def test_courses_are_periodic_and_edges_not_negative() -> None:
    rng = np.random.default_rng(5)
    noise = Noise((3,), 256)
    wobble = (noise.draw(rng, "broad") * 0.02, noise.draw(rng, "broad") * 0.02)
    cells = cut_courses(rng, 256, 4.0, (0.2, 0.4), (0.3, 0.8), corner=0.05, wobble=wobble)
    assert cells.edge.min() >= 0
    assert max(seam_ratio(cells.edge, 0), seam_ratio(cells.edge, 1)) < 1.3
    assert cells.across.min() > -0.1 and cells.across.max() < 1.1  # borders sit on quarter pixels


def test_ramp_is_a_smoothstep() -> None:
    value = np.array([-1, 0, 0.25, 0.5, 0.75, 1, 2], dtype=np.float32)
    truth = [0, 0, 0.15625, 0.5, 0.84375, 1, 1]
    assert ramp(value, 0, 1) == pytest.approx(truth)
    assert ramp(value, 1, 0) == pytest.approx(truth[::-1][:1] * 2 + [0.84375, 0.5, 0.15625, 0, 0])


def test_pick_interpolates_neighbouring_colours() -> None:
    colours = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0)]
    chosen = pick(colours, np.array([0, 0.25, 0.5, 0.75, 1], dtype=np.float32))
    assert pytest.approx(np.array([(0, 0, 0), (0.5, 0, 0), (1, 0, 0), (1, 0.5, 0), (1, 1, 0)])) == chosen.T


def test_bytes_are_channels_last_and_rounded() -> None:
    image = np.zeros((3, 2, 4), dtype=np.float32)
    image[0], image[1], image[2] = 0.5, 0.25, 0.75
    assert np.array_equal(to_bytes(image), np.full((2, 4, 3), (128, 64, 191), dtype=np.uint8))


@pytest.fixture(scope="module")
def palette() -> dict[str, Surface]:
    """All surfaces, with half as many texels along a side as scenes have, for time."""
    with pytest.MonkeyPatch.context() as patch:
        for name, recipe in RECIPES.items():
            patch.setitem(RECIPES, name, replace(recipe, pixels=recipe.pixels // 2))
        return paint_palette(RECIPES, 7)


def test_every_surface_paints_and_repeats(palette: dict[str, Surface]) -> None:
    for name, surface in palette.items():
        texture = surface.material.texture
        assert texture is not None and texture.dtype == np.uint8 and texture.shape[2] == 3, name
        assert 20 < texture.mean() < 235, name
        # Enough contrast for a feature detector: a few grey levels from texel to texel and from stone to stone.
        # Paint and sheet metal are weak on purpose, but not one colour.
        weak = name.startswith("paint_") or name in ("enamel", "steel")
        assert texture.mean(axis=2).std() > (1.5 if weak else 5.0), name
        if surface.repeat is not None:
            assert max(seam_ratio(texture, 0), seam_ratio(texture, 1)) < 1.3, name


def test_a_texture_depends_on_seed_and_name_alone() -> None:
    alone = paint_palette(["iron"], 7)["iron"].material.texture
    among = paint_palette(["fruit_0", "iron", "water"], 7)["iron"].material.texture
    other = paint_palette(["iron"], 8)["iron"].material.texture
    assert alone is not None and among is not None and other is not None
    assert np.array_equal(alone, among)
    assert not np.array_equal(alone, other)
