"""Kannala-Brandt lenses fitted to other models, against the models themselves."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.lens_fit import (
    Profile,
    fov_profile,
    kannala_brandt_of,
    mirror_profile,
    unified_profile,
)

CAMERA = PinholeCamera(width=752, height=480, fx=460.0, fy=457.0, cx=367.0, cy=248.0)


def check(camera: PinholeCamera, profile: Profile, most_px: float) -> None:
    """Pixels of the fitted camera against the profile's, at rays of all pixels of the fitted one."""
    found = kannala_brandt_of(camera, profile)
    fitted = replace(camera, lens=found.lens, fx=found.fx, fy=found.fy)
    pixels = np.random.default_rng(0).uniform([-0.5, -0.5], [751.5, 479.5], (3000, 2))
    rays = fitted.unproject(pixels)
    tangent = np.linalg.norm(rays[:, :2], axis=-1, keepdims=True)
    exact = rays[:, :2] / tangent * profile(np.arctan(tangent)) * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    largest = float(np.max(np.linalg.norm(exact - pixels, axis=-1)))
    assert 0.3 * found.error_px - 1e-9 < largest < 1.02 * found.error_px + 1e-9
    assert found.error_px < most_px


@pytest.mark.parametrize(
    ("profile", "focal", "most_px"),
    [
        pytest.param(unified_profile(0.61, 1.1), 460.0, 0.01, id="eucm"),
        pytest.param(unified_profile(0.57), 300.0, 0.05, id="ucm"),
        pytest.param(mirror_profile(1.4, -0.1, 0.05), 1100.0, 0.02, id="omni"),
        pytest.param(fov_profile(0.92), 400.0, 0.05, id="fov"),
        pytest.param(np.tan, 500.0, 0.02, id="pinhole"),
    ],
)
def test_other_models_are_fitted_within_the_stated_error(profile: Profile, focal: float, most_px: float) -> None:
    check(replace(CAMERA, fx=focal, fy=0.99 * focal), profile, most_px)


@settings(max_examples=30)
@given(st.floats(0.3, 0.75), st.floats(0.6, 1.6))
def test_unified_models_are_fitted(alpha: float, beta: float) -> None:
    check(CAMERA, unified_profile(alpha, beta), 0.2)


def test_a_kannala_brandt_lens_is_found_again() -> None:
    k = (-0.03, 0.012, -0.004, 0.0006)
    found = kannala_brandt_of(
        CAMERA, lambda a: 0.9 * a * (1 + k[0] * a**2 + k[1] * a**4 + k[2] * a**6 + k[3] * a**8)
    )
    assert found.error_px < 1e-9 and found.fx == pytest.approx(0.9 * CAMERA.fx, rel=1e-10)
    np.testing.assert_allclose(found.lens.coefficients, k, rtol=1e-6)


def test_the_mirror_is_a_sphere_before_a_pinhole() -> None:
    X = np.random.default_rng(1).uniform([-2, -1.2, 1], [2, 1.2, 3], (100, 3))
    from_centre = X / np.linalg.norm(X, axis=-1, keepdims=True) + [0.0, 0.0, 1.4]
    seen, k, still = from_centre / from_centre[:, 2:], np.array([-0.1, 0.05, 0.0, 0.0]), np.zeros(3)
    pixels = cv2.projectPoints(seen, still, still, np.eye(3), k)[0][:, 0]
    angle = np.arctan2(np.hypot(X[:, 0], X[:, 1]), X[:, 2])
    np.testing.assert_allclose(np.hypot(*pixels.T), mirror_profile(1.4, -0.1, 0.05)(angle), atol=1e-12)


def test_a_double_sphere_without_a_shift_is_unified() -> None:
    xy = np.random.default_rng(2).uniform(-1, 1, (50, 2))
    radius = np.linalg.norm(xy, axis=-1)
    seen = Lens(model="double-sphere", alpha=0.6).distort(xy).xy
    np.testing.assert_allclose(np.linalg.norm(seen, axis=-1), unified_profile(0.6)(np.arctan(radius)), rtol=1e-13)


def test_images_that_show_more_than_a_half_space_are_refused() -> None:
    with pytest.raises(ValueError, match=r"lie 2\.\d+ focal lengths .* more than 86 degrees"):
        kannala_brandt_of(replace(CAMERA, fx=190.0, fy=190.0), lambda angle: angle)
