"""The guess of where the sky is."""

from __future__ import annotations

import numpy as np
import pytest

from rsbench.vision.sky import sky_mask


def _frame(sky_colour: tuple[int, int, int] = (190, 205, 230)) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A picture with a smooth upper third, its disparity as a matcher finds it, and the true sky."""
    rng = np.random.default_rng(0)
    image = rng.integers(0, 160, (90, 120, 3)).astype(np.uint8)
    sky = np.zeros((90, 120), dtype=bool)
    sky[:30] = True
    sky[20:30, 50:60] = False  # a chimney
    gradient = np.linspace(0, 6, 90)[:, None, None]
    smooth = np.clip(np.array(sky_colour) + gradient, 0, 255).astype(np.uint8)
    image[sky] = np.broadcast_to(smooth, image.shape)[sky]
    disparity = np.full((90, 120), 20.0, dtype=np.float32)
    disparity[60:] = 60.0  # the ground in front
    disparity[:5] = np.nan
    return image, disparity, sky


def test_a_smooth_bright_far_area_at_the_top_is_sky() -> None:
    image, disparity, sky = _frame()
    found = sky_mask(image, disparity)
    # The rim of one pixel may go either way.
    assert np.mean(found[sky]) > 0.97 and np.mean(found[~sky]) < 0.01


@pytest.mark.parametrize("kind", ["grey", "16 bit"])
def test_grey_and_deep_images(kind: str) -> None:
    image, disparity, sky = _frame()
    changed = image.mean(axis=-1).astype(np.uint8) if kind == "grey" else image.astype(np.uint16) * 257
    found = sky_mask(changed, disparity)
    assert np.mean(found[sky]) > 0.9 and np.mean(found[~sky]) < 0.02


def test_a_wall_is_not_sky() -> None:
    image, disparity, _ = _frame()
    near = np.where(np.arange(90)[:, None] < 45, np.float32(80.0), disparity)  # nearer than the ground
    assert not np.any(sky_mask(image, near))


def test_a_red_or_dark_area_is_not_sky() -> None:
    for colour in ((230, 190, 180), (20, 22, 30)):
        image, disparity, _ = _frame(colour)
        assert not np.any(sky_mask(image, disparity))


def test_smooth_areas_that_do_not_reach_the_top_are_not_sky() -> None:
    image, disparity, _ = _frame()
    assert not np.any(sky_mask(image[::-1].copy(), disparity[::-1].copy()))


def test_without_any_disparity_nothing_is_said() -> None:
    image, disparity, _ = _frame()
    assert not np.any(sky_mask(image, np.full_like(disparity, np.nan)))
