"""The pinhole camera and the pixel convention."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsbench.core.camera import PinholeCamera

CAMERA = PinholeCamera(width=640, height=480, fx=500.0, fy=510.0, cx=310.0, cy=250.0)


@settings(max_examples=40)
@given(st.floats(-100, 800), st.floats(-100, 800), st.floats(0.01, 1000))
def test_project_inverts_unproject(x: float, y: float, depth: float) -> None:
    ray = CAMERA.unproject([x, y])
    assert ray[2] == 1.0
    np.testing.assert_allclose(CAMERA.project(depth * ray), [x, y], rtol=0, atol=1e-12)  # rounding at 1000 px


def test_project_is_the_homogeneous_product_with_K() -> None:
    x = np.random.default_rng(0).uniform([-1, -1, 1], [1, 1, 5], size=(7, 3))
    homogeneous = x @ CAMERA.K.T
    np.testing.assert_allclose(CAMERA.project(x), homogeneous[:, :2] / homogeneous[:, 2:], rtol=1e-14)


def test_axes_are_right_down_forward() -> None:
    centre = CAMERA.project([0.0, 0.0, 1.0])
    np.testing.assert_array_equal(centre, [310.0, 250.0])
    assert CAMERA.project([0.1, 0.0, 1.0])[0] > centre[0]
    assert CAMERA.project([0.0, 0.1, 1.0])[1] > centre[1]


def test_centre_of_the_top_left_pixel_is_zero() -> None:
    camera = PinholeCamera.centred(900, 900, 1384.6)
    assert (camera.cx, camera.cy) == (449.5, 449.5)
    grid = camera.pixel_grid()
    assert grid.shape == (900, 900, 2)
    np.testing.assert_array_equal(grid[0, 0], [0.0, 0.0])
    np.testing.assert_array_equal(grid[3, 7], [7.0, 3.0])  # (x, y) at [row, column]
    # The optical axis meets the image in the middle of all pixel centres.
    np.testing.assert_array_equal(grid.mean(axis=(0, 1)), [camera.cx, camera.cy])


@pytest.mark.parametrize("z", [0.0, -1e-9, -3.0])
def test_points_not_in_front_have_no_pixel(z: float) -> None:
    assert np.all(np.isnan(CAMERA.project([0.1, 0.2, z])))


def test_the_image_area_reaches_half_a_pixel_beyond_the_outermost_centres() -> None:
    pixels = [[-0.5, -0.5], [639.5, 479.5], [-0.51, 0], [0, -0.51], [639.51, 0], [0, 479.51], [np.nan, 3]]
    np.testing.assert_array_equal(CAMERA.contains(pixels), [True, True, False, False, False, False, False])


@pytest.mark.parametrize(
    ("field", "value"),
    [("width", 0), ("height", -1), ("fx", 0.0), ("fy", float("nan")), ("cx", float("inf")), ("cy", float("nan"))],
)
def test_bad_intrinsics_are_refused_by_name(field: str, value: float) -> None:
    good = {"width": 4, "height": 3, "fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0}
    with pytest.raises(ValueError, match=f"camera {field} = "):
        PinholeCamera(**{**good, field: value})  # pyrefly: ignore[bad-argument-type]
