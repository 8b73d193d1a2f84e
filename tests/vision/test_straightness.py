"""Rotation from straight lines: exact curves of exact lines, differences, and what the algebra cannot tell."""

from __future__ import annotations

import numpy as np
import pytest

from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.shutter import RollingShutter
from rsbench.vision.line_rotation import LineOptions, rotation_of_lines
from rsbench.vision.manhattan import ManhattanOptions, rotation_of_directions
from rsbench.vision.straightness import Points, Turned, across, lines_at, step_of, straightened

CAMERA = PinholeCamera.centred(320, 320, 490.0)
SHUTTER = RollingShutter(height=320, readout_ratio=0.9)
MIDDLE = 0.5 * SHUTTER.row_time(319.0, 0)
PRIOR = np.radians(3.0)


def curve_of(normal: np.ndarray, w: np.ndarray, upright: bool, ends: tuple[int, int]) -> np.ndarray:
    """Places (n, 2) of the line of normal l, in the middle of the readout, in a frame of a camera that turns by w.

    In each row, or in each column, whose row is then found by fixed-point steps that shrink by w each.
    """
    along = np.arange(*ends, dtype=np.float64)
    x, y = (np.full_like(along, 160.0), along) if upright else (along, np.full_like(along, 160.0))
    for _ in range(1 if upright else 60):
        a, b, c = (so3.exp((SHUTTER.row_time(y, 0) - MIDDLE)[:, None] * w) @ normal).T
        if upright:
            x = CAMERA.cx - CAMERA.fx * (b * (y - CAMERA.cy) / CAMERA.fy + c) / a
        else:
            y = CAMERA.cy - CAMERA.fy * (a * (x - CAMERA.cx) / CAMERA.fx + c) / b
    return np.column_stack([x, y])


def line_at(pixel: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Normal of the line through a pixel that runs along a direction (3,) in space."""
    normal = np.cross(CAMERA.unproject(pixel), direction)
    return np.asarray(normal / np.linalg.norm(normal))


def lines_of(rng: np.random.Generator, w: np.ndarray, count: int = 8) -> list[np.ndarray]:
    """Upright curves, some slanted, of lines along directions of their own."""
    normals = [line_at(rng.uniform(60, 260, 2), np.array([rng.normal(0, 0.5), 1, 0.2])) for _ in range(count)]
    return [curve_of(n, w, True, (int(rng.integers(0, 120)), int(rng.integers(200, 320)))) for n in normals]


def town_of(rng: np.random.Generator, w: np.ndarray, count: int = 24) -> list[np.ndarray]:
    """Curves, some of them short, of lines along three orthogonal directions."""
    axes, curves = so3.exp(np.array([0.2, 0.5, 0.1])), list[np.ndarray]()
    for k in range(count):
        n = line_at(rng.uniform(60, 260, 2), axes[:, k % 3])
        first = int(rng.integers(0, 160))
        curves.append(curve_of(n, w, abs(n[0]) >= abs(n[1]), (first, first + int(rng.integers(60, 160)))))
    return curves


def points_of(curves: list[np.ndarray]) -> Points:
    return Points.of(curves, CAMERA, SHUTTER, ("left", 0))


@pytest.mark.parametrize("seed", range(3))
def test_exact_curves_of_lines_give_the_exact_rotation(seed: int) -> None:
    w = np.radians([2.5, -3.0, 4.0])
    found = straightened(points_of(lines_of(np.random.default_rng(seed), w)), np.zeros(3), PRIOR)
    np.testing.assert_allclose(found.w, w, atol=1e-11)  # rounding, times what noise in px becomes: up to 1e3
    determined = found.determined(PRIOR)
    assert determined is not None
    np.testing.assert_allclose(determined, w, atol=1e-11)


def test_the_linear_model_errs_by_the_square_of_the_rotation() -> None:
    errors = []
    for part in (1.0, 0.5, 0.25):
        w = part * np.radians([2.5, -3.0, 4.0])
        still = Turned.by(points_of(lines_of(np.random.default_rng(1), w)), np.zeros(3))
        step = step_of(still, lines_at(still))
        errors.append(np.linalg.norm(np.linalg.solve(step.A.sum(axis=0), step.b.sum(axis=0)) + w))
    for ratio in (errors[0] / errors[1], errors[1] / errors[2]):
        assert 3.5 < ratio < 4.6


def test_derivatives_are_those_of_the_errors() -> None:
    """Of curves that fit nothing, in rows and in columns, against central differences."""
    rng = np.random.default_rng(2)
    curves = [each + rng.normal(0, 0.3, each.shape) for each in town_of(rng, np.radians([1.0, 2.0, -1.0]), 9)]
    points, w, h = points_of(curves), np.array([0.03, 0.02, -0.05]), 1e-6
    at = Turned.by(points, w)
    normals = lines_at(at) + 0.01
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ways = across(normals)
    by_turn = [
        Turned.by(points, w + h * u).errors(normals) - Turned.by(points, w - h * u).errors(normals)
        for u in np.eye(3)
    ]
    by_normals = [at.errors(normals + h * ways[:, k]) - at.errors(normals - h * ways[:, k]) for k in (0, 1)]
    for found, expected in ((at.by_turn(normals), by_turn), (at.by_normals(normals, ways), by_normals)):
        expected = np.stack(expected, axis=-1) / (2 * h)
        np.testing.assert_allclose(
            found, expected, atol=1e-6 * np.max(np.abs(expected))
        )  # rounding over the step: 1e-9


def test_errors_are_pixels_along_the_row() -> None:
    n = line_at(np.array([150.0, 170.0]), np.array([0.3, 1.0, 0.1]))
    w = np.radians([1.0, 2.0, -3.0])
    curve = curve_of(n, w, True, (20, 300))
    at = Turned.by(points_of([curve + np.array([0.25, 0.0])]), w)
    np.testing.assert_allclose(np.abs(at.errors(n[None])), 0.25, atol=1e-10)


def test_stated_deviations_are_those_of_noise() -> None:
    """White noise counts as one error in eight px: it errs by less than stated, and not by a tenth of that."""
    w, ratios = np.radians([1.0, -1.0, 2.0]), list[float]()
    for seed in range(12):
        rng = np.random.default_rng(seed)
        curves = [
            each + np.column_stack([rng.normal(0, 0.1, len(each)), np.zeros(len(each))])
            for each in lines_of(rng, w)
        ]
        found = straightened(points_of(curves), np.zeros(3), 1.0)
        ratios.append(float((found.w - w) @ np.linalg.solve(found.covariance, found.w - w)))
    assert 3 * 0.1**2 < np.mean(ratios) < 3 * 1.5


def test_curves_that_were_no_lines_are_left_out() -> None:
    w = np.radians([2.0, -1.5, 3.0])
    curves = lines_of(np.random.default_rng(3), w, 12)
    y = np.arange(40.0, 280.0)
    bent = [np.column_stack([80 + 20 * k + 2e-3 * (1 + k) * (y - 160) ** 2, y]) for k in range(5)]
    found = rotation_of_lines(points_of([*curves, *bent]), LineOptions(), np.random.default_rng(0))
    assert not isinstance(found, str) and len(found.normals) == 12
    np.testing.assert_allclose(found.w, w, atol=1e-10)


def test_upright_lines_in_the_middle_leave_all_but_roll_open() -> None:
    w = np.radians([1.0, 1.0, 2.0])
    curves = [
        curve_of(line_at(np.array([x, 160.0]), np.array([0.0, 1, 0])), w, True, (20, 300))
        for x in (158, 159, 160, 161)
    ]
    rng = np.random.default_rng(0)
    noisy = [each + np.column_stack([rng.normal(0, 0.05, len(each)), np.zeros(len(each))]) for each in curves]
    found = straightened(points_of(noisy), np.zeros(3), PRIOR)
    determined = found.determined(PRIOR)
    assert determined is not None
    np.testing.assert_allclose(determined[:2], 0.0, atol=np.radians(0.1))
    assert determined[2] == pytest.approx(w[2], abs=np.radians(0.3))


@pytest.mark.parametrize("count", [0, 3])
def test_fewer_than_four_curves_are_a_failure_by_value(count: int) -> None:
    curves = lines_of(np.random.default_rng(0), np.zeros(3), count)
    points = points_of(curves) if curves else None
    found = rotation_of_lines(points, LineOptions(), np.random.default_rng(0))
    assert isinstance(found, str) and found.startswith(f"{count} curves")


@pytest.mark.parametrize("seed", range(3))
def test_exact_lines_along_three_directions_give_the_exact_rotation(seed: int) -> None:
    w = np.radians([2.0, -2.5, 3.0])
    points = points_of(town_of(np.random.default_rng(seed), w))
    found = rotation_of_directions(points, ManhattanOptions(), np.random.default_rng(0))
    assert not isinstance(found, str), found
    np.testing.assert_allclose(found.w, w, atol=1e-11)


def test_directions_tell_yaw_where_straightness_does_not() -> None:
    """Short pieces: bending tells next to nothing, shear a tenth of a degree."""
    rng, w = np.random.default_rng(5), np.radians([0.0, 2.0, 0.0])
    curves = [each + rng.normal(0, 0.05, each.shape) for each in town_of(rng, w)]
    points = points_of([each[:40] for each in curves])
    straight = straightened(points, np.zeros(3), PRIOR)
    along = rotation_of_directions(points, ManhattanOptions(), np.random.default_rng(0))
    assert not isinstance(along, str)
    assert np.sqrt(along.covariance[1, 1]) < 0.5 * np.sqrt(straight.covariance[1, 1])
    assert along.w[1] == pytest.approx(w[1], abs=4 * np.sqrt(along.covariance[1, 1]))


def test_lines_in_all_directions_are_no_town() -> None:
    curves = lines_of(np.random.default_rng(7), np.radians([1.0, 1.0, 1.0]), 40)
    found = rotation_of_directions(
        points_of(curves), ManhattanOptions(threshold_px=0.05), np.random.default_rng(0)
    )
    assert isinstance(found, str)


@pytest.mark.parametrize("count", [0, 7])
def test_fewer_than_eight_curves_are_no_town(count: int) -> None:
    curves = town_of(np.random.default_rng(0), np.zeros(3), count)
    points = points_of(curves) if curves else None
    found = rotation_of_directions(points, ManhattanOptions(), np.random.default_rng(0))
    assert isinstance(found, str) and found.startswith(f"{count} curves")
