"""What solvers are given: shapes, copies, and messages that name the bad match."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.correspondences import Correspondences, lens_affine, without_lens

COLUMNS = {"left": 4, "right": 4, "stereo_0": 4, "stereo_1": 4, "tracks": 8, "lines": 16}


def test_absent_sets_are_empty_with_their_columns() -> None:
    nothing = Correspondences()
    assert {name: getattr(nothing, name).shape for name in COLUMNS} == {n: (0, c) for n, c in COLUMNS.items()}


def test_lists_become_float64_rows() -> None:
    for name, columns in COLUMNS.items():
        for count in (0, 3):
            given: dict[str, Any] = {name: [list(range(columns))] * count}
            rows = getattr(Correspondences(**given), name)
            assert (rows.shape, rows.dtype) == ((count, columns), np.float64), name


def test_a_number_that_is_not_finite_is_named_by_set_and_match() -> None:
    for (name, columns), bad in zip(COLUMNS.items(), [np.nan, np.inf] * 3, strict=True):
        rows = np.ones((5, columns))
        rows[3, 1] = bad
        with pytest.raises(ValueError, match=rf"{name}\[3\] must be finite numbers, got .*{bad}"):
            Correspondences(**{name: rows})


@pytest.mark.parametrize("shape", [(3, 5), (4,), (2, 2, 4)])
def test_wrong_shapes_are_refused_with_the_right_one(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="left must have 4 numbers per match"):
        Correspondences(left=np.ones(shape))


def test_input_is_copied_and_the_copy_is_read_only() -> None:
    given = np.ones((2, 4))
    matches = Correspondences(left=given)
    given[0, 0] = 7.0
    assert matches.left[0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        matches.left[0, 0] = 2.0


def test_gravity_without_a_direction_is_refused_by_its_row() -> None:
    with pytest.raises(ValueError, match=r"gravity\[1\] has no direction: gx, gy, gz are 0"):
        Correspondences(gravity=np.array([[0.0, 0.0, 9.8, 0.0], [1.0, 0.0, 0.0, 0.0]]))


def test_affine_frames_are_as_many_as_left_matches_or_none() -> None:
    frames = Correspondences(left=np.ones((3, 4)), affine=np.ones((3, 4)))
    assert frames.affine.shape == (3, 4) and Correspondences(left=np.ones((3, 4))).affine.shape == (0, 4)
    with pytest.raises(ValueError, match="affine has 2 rows and left 3: one each, or none"):
        Correspondences(left=np.ones((3, 4)), affine=np.ones((2, 4)))
    with pytest.raises(ValueError, match=r"affine\[1\] must be finite numbers"):
        Correspondences(left=np.ones((2, 4)), affine=np.diag([1.0, np.nan, 1.0, 1.0])[:2])


def test_affine_frames_without_the_lens_are_those_of_ideal_pixels() -> None:
    """Of a map of pixels to pixels of the distorted images, by differences between ideal pixels."""
    lens = Lens(model="brown-conrady", k1=-0.2, k2=0.05, p1=1e-3)
    camera = PinholeCamera(width=640, height=480, fx=500.0, fy=480.0, cx=320.0, cy=240.0, lens=lens)
    A, first = np.array([[0.9, -0.1], [0.2, 1.1]]), np.array([[120.0, 80.0], [500.0, 400.0]])
    second, h = first + 7.0, 1e-4
    given = Correspondences(
        left=np.hstack([first, second]), affine=np.tile(A.ravel(), (2, 1)), gyro=np.ones((1, 4))
    )
    ideal = without_lens(given, camera)
    at = camera.ideal_pixels(first)
    for k, step in enumerate(h * np.eye(2)):
        ends = []
        for sign in (1.0, -1.0):
            moved = camera.lens_pixels(at + sign * step)
            ends.append(camera.ideal_pixels(second + (moved - first) @ A.T))
        numeric = (ends[0] - ends[1]) / (2.0 * h)
        np.testing.assert_allclose(ideal.affine.reshape(-1, 2, 2)[:, :, k], numeric, atol=1e-7)
    np.testing.assert_array_equal(ideal.gyro, given.gyro)
    np.testing.assert_allclose(lens_affine(ideal.affine, given.left, camera), given.affine, atol=1e-12)
