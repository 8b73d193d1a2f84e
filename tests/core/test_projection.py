"""Rolling-shutter projection against closed forms, the row equation itself and a brute-force scan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsbench.components.motion_models import LinearMotion, TwistMotion
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.motion import Motion
from rsbench.core.projection import (
    ROW_TOLERANCE_PX,
    ProjectionStatus,
    back_project,
    project_at,
    row_poses,
    rs_project,
    rs_project_near,
)
from rsbench.core.rig import SIDES, Side, StereoRig, View, views_of
from rsbench.core.se3 import transform
from rsbench.core.shutter import RollingShutter, Scan
from rsbench.core.so3 import FloatArray

few = settings(max_examples=25)
vectors = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)
seeds = st.integers(0, 2**32 - 1)
views = st.sampled_from(views_of(2))


def motions(turn: float, shift: float | FloatArray) -> st.SearchStrategy[Motion]:
    """The paper's motions and constant twists of up to ``turn`` and ``shift`` along each axis, rad and metres."""
    models = st.sampled_from([LinearMotion, TwistMotion])
    return st.builds(lambda model, w, d: model(turn * w, shift * d), models, vectors, vectors)


RIG = StereoRig(camera=PinholeCamera.centred(100, 80, 100.0), baseline=0.2)
SHUTTER = RollingShutter(height=80, readout_ratio=0.8)
STILL = LinearMotion(np.zeros(3), np.zeros(3))


def _points(seed: int, n: int = 50) -> FloatArray:
    return np.random.default_rng(seed).uniform([-2, -2, 2], [2, 2, 8], size=(n, 3))


def _scan(motion: Motion, side: Side, frame: int, X: FloatArray, rows: int = 20_000) -> list[FloatArray]:
    """Rows (per point) at which a dense scan of the image sees the point, and the x there lies inside."""
    y = np.linspace(-0.5, 79.5, rows)
    pose = RIG.cam_from_world(motion, frame + 0.8 * y / 80, side)
    found = []
    for point in X:
        x, v, z = (pose.R @ point + pose.t).T
        ahead = z > 0
        f = np.where(ahead, 100 * v / np.where(ahead, z, 1) + 39.5, np.nan) - y
        k = np.flatnonzero(f[:-1] * f[1:] < 0)
        column = 100 * x[k] / z[k] + 49.5
        found.append(y[k][(column > -0.5) & (column < 99.5)])
    return found


@few
@given(motions(0.3, 1.0), seeds, views)
def test_a_seen_point_satisfies_the_row_equation(motion: Motion, seed: int, view: View) -> None:
    (side, frame), X = view, _points(seed)
    seen = rs_project(RIG, SHUTTER, motion, side, frame, X)
    ok = seen.status == ProjectionStatus.SEEN
    np.testing.assert_array_equal(np.isfinite(seen.pixels[:, 0]), ok | (seen.status == ProjectionStatus.TWICE))
    tau = frame + 0.8 * seen.pixels[ok, 1] / 80
    again = project_at(RIG, motion, side, tau, X[ok])
    np.testing.assert_allclose(again[:, 1], seen.pixels[ok, 1], rtol=0, atol=10 * ROW_TOLERANCE_PX)
    np.testing.assert_allclose(seen.tau[ok], tau, rtol=0, atol=1e-10)
    np.testing.assert_allclose(seen.depth[ok], again[:, 2], rtol=1e-9)
    assert not np.any(seen.status == ProjectionStatus.NOT_CONVERGED)


@few
@given(motions(0.05, 0.1), seeds, views)
def test_projecting_a_back_projected_pixel_returns_it(motion: Motion, seed: int, view: View) -> None:
    (side, frame), rng = view, np.random.default_rng(seed)
    pixels, depth = rng.uniform(0, [99, 79], size=(30, 2)), rng.uniform(2, 9, size=30)
    X = back_project(RIG, SHUTTER, motion, side, frame, pixels, depth)
    seen = rs_project(RIG, SHUTTER, motion, side, frame, X)
    np.testing.assert_allclose(seen.pixels, pixels, rtol=0, atol=2 * ROW_TOLERANCE_PX)
    np.testing.assert_allclose(seen.depth, depth, rtol=1e-10)


@few
@given(motions(0.05, 0.3), seeds, views)
def test_a_nearby_row_finds_what_the_full_search_finds(motion: Motion, seed: int, view: View) -> None:
    (side, frame), X = view, _points(seed)
    full = rs_project(RIG, SHUTTER, motion, side, frame, X)
    # From the middle row, or from one that is already right.
    for start in (np.full(len(X), 40.0), np.nan_to_num(full.pixels[:, 1], nan=40.0)):
        near = rs_project_near(RIG, SHUTTER, motion, side, frame, X, start)
        np.testing.assert_array_equal(near.status, full.status)
        np.testing.assert_allclose(near.pixels, full.pixels, rtol=0, atol=4 * ROW_TOLERANCE_PX)
        np.testing.assert_allclose(near.depth, full.depth, rtol=1e-10)
        np.testing.assert_allclose(near.tau, full.tau, rtol=0, atol=1e-10)


@pytest.mark.parametrize(("side", "frame"), views_of(2))
def test_a_global_shutter_projects_at_the_time_of_its_frame_bit_for_bit(side: Side, frame: int) -> None:
    shutter = RollingShutter(height=80, readout_ratio=0.0)
    motion, X = TwistMotion(np.array([0.1, -0.2, 0.3]), np.array([0.4, 0.1, -0.2])), _points(3)
    seen = rs_project(RIG, shutter, motion, side, frame, X)
    x_in_cam = transform(RIG.cam_from_world(motion, float(frame), side), X)
    pixels = RIG.camera.project(x_in_cam)
    inside = RIG.camera.contains(pixels)
    assert 5 < np.count_nonzero(inside) < len(X)
    np.testing.assert_array_equal(seen.pixels, np.where(inside[:, None], pixels, np.nan))
    np.testing.assert_array_equal(seen.depth[inside], x_in_cam[inside, 2])
    np.testing.assert_array_equal(seen.status == ProjectionStatus.SEEN, inside)


def _moving_down(speed: float) -> LinearMotion:
    """Points at depth 5 move down the image by ``speed`` rows per row time."""
    return LinearMotion(np.zeros(3), np.array([0.0, speed * 5.0 / (100.0 * SHUTTER.h), 0.0]))


@pytest.mark.parametrize("speed", [-2.0, -0.5, 0.3, 0.9, 1.5, 3.0])
def test_constant_speed_down_the_image_in_closed_form(speed: float) -> None:
    # y = y_start + speed * y, so y = y_start / (1 - speed): a point faster than the scan is met from below.
    y_start = 40.0 * (1 - speed)
    X = np.array([0.1, (y_start - 39.5) / 100 * 5.0, 5.0])
    seen = rs_project(RIG, SHUTTER, _moving_down(speed), "left", 0, X)
    assert seen.status == ProjectionStatus.SEEN
    np.testing.assert_allclose(seen.pixels, [49.5 + 100 * 0.2 / 5, 40.0], rtol=0, atol=1e-8)


@pytest.mark.parametrize("start", [-30.0, -1.0, 3.0, 60.0])
def test_a_point_that_keeps_pace_with_the_readout_is_never_seen(start: float) -> None:
    X = np.array([0.0, (start - 39.5) / 100 * 5.0, 5.0])
    assert rs_project(RIG, SHUTTER, _moving_down(1.0), "left", 0, X).status == ProjectionStatus.NEVER


def _with_roots(total: float, product: float, dz: float, depth: float) -> tuple[LinearMotion, FloatArray]:
    """A motion and a point whose row equation is y^2 - total y + product = 0.

    With d = (0, dy, dz), f(y) = 0 is h dz y^2 + (Z - cy h dz - fy h dy) y - (cy Z + fy Y) = 0.
    """
    fy, cy, h = RIG.camera.fy, RIG.camera.cy, SHUTTER.h
    dy = (depth - cy * h * dz + total * h * dz) / (fy * h)
    Y = -(product * h * dz + cy * depth) / fy
    return LinearMotion(np.zeros(3), np.array([0.0, dy, dz])), np.array([0.0, Y, depth])


@pytest.mark.parametrize("dz", [-1.0, 1.0])
@pytest.mark.parametrize(
    ("first", "second"),
    [(10.0, 60.0), (31.0, 33.0), (40.0, 40.05), (1.0, 78.0), (20.0, 95.0), (20.0, -9.0), (70.0, 400.0)],
)
def test_a_point_seen_twice_reports_its_first_row_and_rows_outside_do_not_count(
    first: float, second: float, dz: float
) -> None:
    motion, X = _with_roots(first + second, first * second, dz, 5.0)
    seen, twice = rs_project(RIG, SHUTTER, motion, "right", 0, X), 0.0 < second < 79.0
    assert seen.status == (ProjectionStatus.TWICE if twice else ProjectionStatus.SEEN)
    # A residual of 1e-9 px moves a root by 1e-9 / f', and f' = h dz (y1 - y2) / Z is 1e-4 at the closest pair.
    assert seen.pixels[1] == pytest.approx(first, abs=1e-4 if twice else 1e-6)


@pytest.mark.parametrize(
    ("x_at_10", "x_at_60", "rows"), [(0.5, -0.5, [10.0, 60.0]), (0.0, -4.0, [10.0]), (-4.0, 0.0, [60.0])]
)
def test_of_two_rows_only_those_inside_the_width_count(x_at_10: float, x_at_60: float, rows: list[float]) -> None:
    down, X = _with_roots(70.0, 600.0, -1.0, 5.0)
    # Rows 10 and 60 are read at 0.1 and 0.6; the given x are in the left camera, 0.1 m from the body.
    speed = (x_at_60 - x_at_10) / 0.5
    motion = LinearMotion(np.zeros(3), down.d + np.array([speed, 0.0, 0.0]))
    X = X + np.array([x_at_10 - 0.1 * speed - 0.1, 0.0, 0.0])
    seen = rs_project(RIG, SHUTTER, motion, "left", 0, X)
    assert seen.status == (ProjectionStatus.TWICE if len(rows) == 2 else ProjectionStatus.SEEN)
    assert seen.pixels[1] == pytest.approx(rows[0], abs=1e-6)


@few
@given(motions(0.6, np.array([1.0, 6.0, 2.0])), seeds, views)  # violent: many points are met twice or never
def test_the_number_of_rows_agrees_with_a_dense_scan(motion: Motion, seed: int, view: View) -> None:
    (side, frame), X = view, _points(seed, 40)
    seen = rs_project(RIG, SHUTTER, motion, side, frame, X)
    for k, rows in enumerate(_scan(motion, side, frame, X)):
        expected = (ProjectionStatus.NEVER, ProjectionStatus.SEEN, ProjectionStatus.TWICE)[min(len(rows), 2)]
        assert seen.status[k] == expected, (k, rows)
        if len(rows):
            assert seen.pixels[k, 1] == pytest.approx(rows[0], abs=80 / 20_000 + 1e-6)


def test_points_behind_the_camera_are_never_seen() -> None:
    X = np.array([[0.0, 0.0, -5.0], [0.0, 0.0, 0.0], [0.0, 0.0, 5.0]])
    seen = rs_project(RIG, SHUTTER, STILL, "left", 0, X)
    never, one = ProjectionStatus.NEVER, ProjectionStatus.SEEN
    np.testing.assert_array_equal(seen.status, [never, never, one])
    assert (
        np.all(np.isnan(seen.pixels[:2])) and np.all(np.isnan(seen.depth[:2])) and np.all(np.isnan(seen.tau[:2]))
    )


def test_a_point_that_passes_behind_the_camera_during_the_readout() -> None:
    # Depth 0.1 - tau: the point is ahead while the first rows are read, on the axis, where row 39.5 comes late.
    motion = LinearMotion(np.zeros(3), np.array([0.0, 0.0, -1.0]))
    late = rs_project(RIG, SHUTTER, motion, "left", 0, [-0.1, 0.0, 0.1])
    early = rs_project(RIG, SHUTTER, motion, "left", 0, [-0.1, 0.0, 0.5])
    assert late.status == ProjectionStatus.NEVER
    assert early.status == ProjectionStatus.SEEN
    assert early.pixels[1] == pytest.approx(39.5, abs=1e-8)


def test_batch_axes_are_kept_and_no_points_are_fine() -> None:
    X = _points(5, 6)
    flat = rs_project(RIG, SHUTTER, _moving_down(0.2), "left", 1, X)
    shaped = rs_project(RIG, SHUTTER, _moving_down(0.2), "left", 1, X.reshape(2, 3, 3))
    np.testing.assert_array_equal(shaped.pixels.reshape(-1, 2), flat.pixels)
    np.testing.assert_array_equal(shaped.status.ravel(), flat.status)
    single = rs_project(RIG, SHUTTER, _moving_down(0.2), "left", 1, X[0])
    assert single.pixels.shape == (2,) and single.status.shape == ()
    nothing = rs_project(RIG, SHUTTER, STILL, "left", 0, np.zeros((0, 3)))
    assert nothing.pixels.shape == (0, 2)


def test_row_poses_are_the_poses_of_integer_rows() -> None:
    motion = TwistMotion(np.array([0.1, 0.2, -0.1]), np.array([0.3, 0.0, 0.1]))
    R, t = row_poses(RIG, SHUTTER, motion, "right", 1)
    assert R.shape == (80, 3, 3) and t.shape == (80, 3)
    # R X + t at row 7 is the body's pose at 1 + 0.8 * 7 / 80, shifted by half a baseline to the left.
    body = motion.body_from_world(1.07)
    np.testing.assert_allclose(R[7], body.R, rtol=0, atol=1e-15)
    np.testing.assert_allclose(t[7], body.t - [0.1, 0, 0], rtol=0, atol=1e-15)


LENSES = [
    Lens(model="brown-conrady", k1=-0.2, k2=0.05, p1=0.002, p2=-0.001),
    Lens(model="kannala-brandt", k1=-0.05, k2=0.02),
]
SCANS: list[Scan] = ["top", "bottom", "left", "right"]


@few
@given(st.sampled_from(LENSES), st.sampled_from(SCANS), st.floats(-0.3, 0.3), vectors, vectors, seeds)
def test_a_point_is_seen_through_a_lens_when_its_distorted_line_is_read(
    lens: Lens, scan: Scan, delay: float, w: FloatArray, d: FloatArray, seed: int
) -> None:
    rig = StereoRig(camera=replace(RIG.camera, lens=lens), baseline=0.2)
    shutter = RollingShutter(height=80, width=100, readout_ratio=0.8, right_scan=scan, right_delay=delay)
    motion, side = LinearMotion(0.05 * w, 0.2 * d), SIDES[1]
    seen = rs_project(rig, shutter, motion, side, 1, _points(seed))
    assert not np.any(seen.status == ProjectionStatus.NOT_CONVERGED)
    ok = np.isfinite(seen.depth)
    x, y = seen.pixels[ok].T
    share = {"top": y / 80, "bottom": (79 - y) / 80, "left": x / 100, "right": (99 - x) / 100}[scan]
    tau = 1 + delay + 0.8 * share
    R, t = rig.cam_from_world(motion, tau, side)
    X = (R @ _points(seed)[ok][:, :, None])[..., 0] + t
    expected = lens.distort(X[:, :2] / X[:, 2:]).xy * 100.0 + [49.5, 39.5]
    np.testing.assert_allclose(seen.pixels[ok], expected, rtol=0, atol=1e-8)
    again = back_project(rig, shutter, motion, side, 1, seen.pixels[ok], seen.depth[ok])
    np.testing.assert_allclose(again, _points(seed)[ok], rtol=0, atol=1e-9)
    start = seen.pixels[ok][:, shutter.axis(side)] + 1.0
    near = rs_project_near(rig, shutter, motion, side, 1, _points(seed)[ok], start)
    once = seen.status[ok] == ProjectionStatus.SEEN
    np.testing.assert_allclose(near.pixels[once], seen.pixels[ok][once], rtol=0, atol=1e-8)
    R, t = row_poses(rig, shutter, motion, side, 1)
    assert len(R) == shutter.lines(side)
    first = {"top": 0, "left": 0, "bottom": 79, "right": 99}[scan]
    expected_pose = rig.cam_from_world(motion, 1 + delay, side)
    np.testing.assert_allclose(t[first], expected_pose.t, rtol=0, atol=1e-15)
