"""The rig against a pinhole pair, the shutter against tau = frame + readout_ratio * y / height, moving objects."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rsbench.components.motion_models import AcceleratedMotion, LinearMotion, TwistMotion
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.geometry import MovingObject, RelativeMotion, poses_of
from rsbench.core.motion import Motion
from rsbench.core.projection import project_at
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.se3 import Pose, inverse, transform
from rsbench.core.shutter import RollingShutter, Scan

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 1384.6), baseline=0.2)


def test_the_left_camera_stands_half_a_baseline_to_the_left() -> None:
    still = LinearMotion(np.zeros(3), np.zeros(3))
    left, right = (inverse(Pose(*RIG.cam_from_world(still, 0.0, side))).t for side in SIDES)
    np.testing.assert_allclose(left, [-0.1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(right, [0.1, 0, 0], atol=1e-15)


@pytest.mark.parametrize("model", [LinearMotion, TwistMotion])
def test_cameras_of_one_time_are_a_rectified_pair(model: type[LinearMotion] | type[TwistMotion]) -> None:
    motion = model(np.array([0.02, -0.05, 0.03]), np.array([0.1, 0.2, -0.1]))
    points = np.random.default_rng(0).uniform([-1, -1, 4], [1, 1, 9], size=(30, 3))
    left, right = (project_at(RIG, motion, side, 0.7, points) for side in SIDES)
    np.testing.assert_allclose(left[:, 1], right[:, 1], rtol=0, atol=1e-11)  # the same row
    np.testing.assert_allclose(left[:, 2], right[:, 2], rtol=1e-15)
    disparity = left[:, 0] - right[:, 0]
    np.testing.assert_allclose(disparity, 1384.6 * 0.2 / left[:, 2], rtol=1e-11)
    np.testing.assert_allclose(RIG.disparity(left[:, 2]), disparity, rtol=1e-11)
    np.testing.assert_allclose(RIG.depth(disparity), left[:, 2], rtol=1e-11)


def test_a_rig_about_a_camera_has_that_camera_for_its_body() -> None:
    still = LinearMotion(np.zeros(3), np.zeros(3))
    for origin, centres in (("left", [0.0, 0.2]), ("right", [-0.2, 0.0]), ("middle", [-0.1, 0.1])):
        rig = RIG.about(origin)
        found = [inverse(Pose(*rig.cam_from_world(still, 0.0, side))).t[0] for side in SIDES]
        np.testing.assert_allclose(found, centres, atol=1e-15)
    assert RIG.about("left").about("middle") == RIG
    with pytest.raises(ValueError, match="origin"):
        RIG.about("top")  # pyrefly: ignore[bad-argument-type]


@pytest.mark.parametrize("baseline", [0.0, -0.1, float("nan"), float("inf")])
def test_a_baseline_that_is_not_positive_is_refused(baseline: float) -> None:
    with pytest.raises(ValueError, match="baseline"):
        StereoRig(camera=RIG.camera, baseline=baseline)


def test_row_time_is_linear_from_the_start_of_its_frame() -> None:
    shutter = RollingShutter(height=900, readout_ratio=0.8)
    assert shutter.row_time(0, 0) == 0.0 and shutter.row_time(0, 1) == 1.0
    # Half-way down, half the readout has passed; a row beyond the last one ends it.
    np.testing.assert_allclose(shutter.row_time([450, 900, 112.5], [0, 0, 1]), [0.4, 0.8, 1.1], rtol=1e-15)
    assert shutter.h == pytest.approx(0.8 / 900, rel=1e-15)
    still = RollingShutter(height=7, readout_ratio=0.0)
    np.testing.assert_array_equal(still.row_time(np.arange(7), 1), np.ones(7))


@pytest.mark.parametrize(
    ("scan", "first", "last"),
    [("top", (3, 0), (3, 7)), ("bottom", (3, 7), (3, 0)), ("left", (0, 5), (9, 5)), ("right", (9, 5), (0, 5))],
)
def test_each_scan_begins_at_its_side(scan: Scan, first: tuple[int, int], last: tuple[int, int]) -> None:
    shutter = RollingShutter(height=8, width=10, readout_ratio=0.5, scan=scan)
    lines = 8 if scan in ("top", "bottom") else 10
    assert shutter.pixel_time(first, 1, "left") == 1.0
    # The last line begins one line delay before all are read.
    assert shutter.pixel_time(last, 1, "left") == pytest.approx(1.0 + 0.5 * (lines - 1) / lines, rel=1e-15)
    assert shutter.lines("left") == len(shutter.line_times(0, "left")) == lines
    step = shutter.pixel_time([4.5, 2.25], 0, "right") - shutter.pixel_time([4.0, 2.0], 0, "right")
    assert step == pytest.approx(shutter.rate("right") @ [0.5, 0.25], rel=1e-12)


def test_the_right_camera_may_be_late_and_read_another_way() -> None:
    shutter = RollingShutter(height=8, width=10, readout_ratio=0.5, right_scan="bottom", right_delay=0.25)
    np.testing.assert_array_equal(shutter.line_times(0, "left"), 0.5 / 8 * np.arange(8))
    np.testing.assert_array_equal(shutter.line_times(0, "right"), 0.25 + 0.5 / 8 * np.arange(8)[::-1])
    assert shutter.start(1, "right") == 1.25
    assert not (shutter.plain or shutter.rows_together)
    with pytest.raises(ValueError, match=r"right_delay = 0\.25: only rows from the top"):
        shutter.row_time(0, 0)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"scan": "up"}, "scan = 'up': must be one of 'top', 'bottom', 'left', 'right'"),
        ({"right_scan": "both"}, "right_scan = 'both'"),
        ({"right_scan": "left"}, "width must be given where columns are read"),
        ({"right_delay": 1.5}, "right_delay = .*: must be a number from -1 to 1"),
        ({"right_delay": float("nan")}, "right_delay = .*: must be a number from -1 to 1"),
        ({"width": 0}, "shutter width = 0: must be a whole number from 1"),
        ({"height": 0}, "shutter height = 0"),
        *[({"readout_ratio": ratio}, "readout_ratio = ") for ratio in (-0.1, 1.1, float("nan"))],
    ],
)
def test_shutters_that_cannot_be_are_refused_by_name(values: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RollingShutter(**{"height": 10, "readout_ratio": 0.5, **values})  # pyrefly: ignore[bad-argument-type]


Triple = tuple[float, float, float]
VECTOR = st.tuples(*[st.floats(-1.0, 1.0)] * 3)
MODELS: list[type[Motion]] = [LinearMotion, TwistMotion, AcceleratedMotion]


@given(VECTOR, VECTOR, VECTOR, st.floats(0.0, 2.0), VECTOR)
def test_an_object_turns_about_its_pivot_and_is_shifted(
    w: Triple, d: Triple, pivot: Triple, tau: float, X: Triple
) -> None:
    thing = MovingObject(np.array(pivot), LinearMotion(w, d))
    turned = Rotation.from_rotvec(tau * np.array(w)).apply(np.array(X) - pivot)
    moved = transform(thing.world_from_object(tau), np.array(X))
    np.testing.assert_allclose(moved, turned + pivot + tau * np.array(d), atol=1e-13)  # some roundings


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("own", MODELS)
def test_the_rig_seen_from_an_object(model: type[Motion], own: type[Motion]) -> None:
    """A point of the object is where the rig sees it in the world; velocities against central differences."""
    rng = np.random.default_rng(4)
    rig = model(0.3 * rng.normal(size=3), rng.normal(size=3))
    thing = MovingObject(rng.normal(size=3), own(0.5 * rng.normal(size=3), rng.normal(size=3)))
    relative, tau, X = RelativeMotion(rig, thing), rng.uniform(0.0, 2.0, 7), rng.normal(size=(7, 3))
    in_world = transform(thing.world_from_object(tau), X)
    expected = transform(rig.body_from_world(tau), in_world)
    np.testing.assert_allclose(transform(relative.body_from_world(tau), X), expected, atol=1e-13)
    np.testing.assert_allclose(so3.exp(relative.w), relative.body_from_world(1.0).R, atol=1e-13)
    step = 1e-5  # truncation 1e-10, rounding 1e-11
    after, before = (relative.body_from_world(tau + by) for by in (step, -step))
    w_rate, t_rate = relative.velocity(tau)
    R = relative.body_from_world(tau).R
    np.testing.assert_allclose((after.R - before.R) / (2 * step), so3.hat(w_rate) @ R, atol=1e-8)
    np.testing.assert_allclose((after.t - before.t) / (2 * step), t_rate, atol=1e-8)


def test_without_objects_there_are_no_poses() -> None:
    assert poses_of((), np.zeros(3)) is None
