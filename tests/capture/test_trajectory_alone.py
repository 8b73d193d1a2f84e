"""The way of one camera. Truth: points that a trembling camera sees in closed form, and poses in other axes."""

from __future__ import annotations

import numpy as np
import pytest

from rsbench.capture.sequence_shutter import capture_of_video
from rsbench.capture.trajectory_spline import ContinuousMotion
from rsbench.capture.two_frame_spline import camera_trajectory, camera_two_frame_spline
from rsbench.components.motion_models import InertialMotion
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver

SHUTTER = RollingShutter(height=480, readout_ratio=0.8)
RIG = StereoRig(camera=PinholeCamera.centred(640, 480, 520.0), baseline=1.0).about("left")
W, V = np.array([0.002, 0.01, -0.003]), np.array([0.3, -0.05, 0.9])
"""Radians and lengths per frame period."""


def place(tau: FloatArray, shake: float) -> Pose:
    """Camera from world at times (n,): even speed, and a tremor about all axes of some 1.3 and 3.1 periods."""
    waves = np.stack([np.sin(2.0 * tau + 1.0), np.sin(4.8 * tau), np.cos(2.4 * tau)], axis=-1)
    R = so3.exp(shake * waves) @ so3.exp(tau[:, None] * W)
    return Pose(R, -(R @ (tau[:, None] * V)[..., None])[..., 0])


def seen(points: FloatArray, frame: int, shake: float) -> tuple[FloatArray, np.ndarray]:
    """Pixels (n, 2), each at the time of its own row, and which lie in the image."""
    pixels = np.full((len(points), 2), 240.0)
    for _ in range(30):
        pose = place(SHUTTER.pixel_time(pixels, frame, "left"), shake)
        there = (pose.R @ points[..., None])[..., 0] + pose.t
        pixels = there[:, :2] / there[:, 2:] * 520.0 + [319.5, 239.5]
    inside = np.all((pixels > 0.0) & (pixels < [639.0, 479.0]), axis=-1) & (there[:, 2] > 1.0)
    return pixels, inside


def windows_of(count: int, shake: float, noise_px: float, rng: np.random.Generator) -> list[FloatArray]:
    """Matches of neighbouring frames; one in ten is wrong. What ends somewhere begins there again."""
    depth = rng.uniform(5.0, 40.0, 3000)
    points = np.column_stack([rng.uniform(-0.7, 0.7, (3000, 2)) * depth[:, None], depth + 3.0])
    frames = [seen(points, frame, shake) for frame in range(count + 1)]
    drawn = [pixels + rng.normal(0.0, noise_px, pixels.shape) for pixels, _ in frames]
    out = []
    for k in range(count):
        chosen = np.flatnonzero(frames[k][1] & frames[k + 1][1])[:800]
        rows = np.concatenate([drawn[k][chosen], drawn[k + 1][chosen]], axis=-1)
        wrong = rng.uniform(size=len(rows)) < 0.1
        rows[wrong, 2:] += rng.normal(0.0, 20.0, (np.count_nonzero(wrong), 2))
        out.append(rows)
    return out


def turned_deg(motion: Motion, number: int, shake: float) -> float:
    """Root mean square of how rows of a window turn wrongly against its first one."""
    tau = np.linspace(0.0, 1.8, 19)
    true = place(tau + number, shake).R @ place(np.array([float(number)]), shake).R[0].T
    angles = np.linalg.norm(so3.log(motion.body_from_world(tau).R @ np.swapaxes(true, 1, 2)), axis=-1)
    return float(np.rad2deg(np.sqrt(np.mean(angles**2))))


@pytest.mark.slow
@pytest.mark.parametrize("shake", [0.0, 0.01])
def test_a_way_follows_what_a_camera_trembles(shake: float) -> None:
    """The search begins from even speeds, which are wrong by more than ten times as much where it trembles."""
    rng = np.random.default_rng(1)
    windows = windows_of(8, shake, 0.1, rng)
    even = InertialMotion(W, -V)
    ways = camera_trajectory(windows, [even] * 8, RIG, SHUTTER)
    assert ways is not None and len(ways) == 8
    errors = [turned_deg(way, k, shake) for k, way in enumerate(ways)]
    assert np.median(errors) < 0.03 and np.max(errors) < 0.06
    if shake:
        assert np.median([turned_deg(even, k, shake) for k in range(8)]) > 0.3
    for k, way in enumerate(ways):
        last = place(np.array([k + 1.0]), shake).R[0] @ -V
        assert np.linalg.norm(way.d) == pytest.approx(1.0, abs=1e-9)
        assert way.d @ last / np.linalg.norm(V) > np.cos(np.deg2rad(1.0))


def law_of(matches: FloatArray) -> InertialMotion:
    solver = RefinedSolver(motion_model=InertialMotion.name, one_camera=True)
    given, rng = Correspondences(left=matches), np.random.default_rng(0)
    found = estimate_motion(given, RIG, SHUTTER, solver, RobustOptions(), rng).estimate
    return InertialMotion(found.w, found.d / np.linalg.norm(found.d))


@pytest.mark.slow
@pytest.mark.parametrize("shake", [0.0, 0.001, 0.005])
def test_two_frames_are_believed_that_they_shook_where_they_show_it(shake: float) -> None:
    """By half a pixel: that way is nearer than the best law. By more, many ways explain them: the law stays."""
    for seed in range(3):
        (matches,) = windows_of(1, shake, 0.1, np.random.default_rng(seed))
        law = law_of(matches)
        way = camera_two_frame_spline(matches, law, RIG, SHUTTER)
        assert (way is not None) == (shake == 0.001)
        if way is not None:
            assert np.linalg.norm(way.d) == pytest.approx(1.0, abs=1e-9)
            assert turned_deg(way, 0, shake) < 0.7 * turned_deg(law, 0, shake)
            assert camera_two_frame_spline(matches[:15], law, RIG, SHUTTER) is None
            assert (
                camera_two_frame_spline(matches, law, RIG, RollingShutter(height=480, readout_ratio=0.0)) is None
            )


def test_wrong_matches_of_two_frames_are_no_way() -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        assert (
            camera_two_frame_spline(rng.uniform(0.0, 480.0, (300, 4)), InertialMotion(W, -V), RIG, SHUTTER) is None
        )


@pytest.mark.slow
@pytest.mark.parametrize("backwards", [False, True])
def test_a_video_of_a_hand_tells_how_its_lines_are_read(backwards: bool) -> None:
    """And frames in reverse look as if they were read from the bottom. Its ratio is within three deviations."""
    windows = windows_of(7, 0.01, 0.1, np.random.default_rng(4))
    if backwards:
        windows = [each[:, [2, 3, 0, 1]] for each in windows[::-1]]
    capture = capture_of_video(windows, RIG.camera, None)
    assert capture is not None and capture.likeliest is not None
    best = capture.likeliest
    assert best.scans.left == ("bottom" if backwards else "top") and best.probability > 0.99
    assert best.sigma < 0.05 and abs(best.ratio - 0.8) < 3.0 * best.sigma
    assert capture.matches == sum(map(len, windows)) > capture.used > 0.5 * capture.matches / 4


@pytest.mark.slow
def test_wrong_matches_tell_nothing() -> None:
    for seed in (5, 6):  # of two ways: few that fit exactly, and all under much noise
        rng = np.random.default_rng(seed)
        assert capture_of_video([rng.uniform(0.0, 480.0, (60, 4)) for _ in range(6)], RIG.camera, "top") is None
    assert capture_of_video([np.zeros((0, 4))] * 6, RIG.camera, "top") is None


def test_a_motion_is_the_same_in_other_axes_and_units() -> None:
    rng = np.random.default_rng(2)
    rows = np.concatenate([rng.normal(0.0, 0.1, (7, 3)), rng.normal(0.0, 0.5, (7, 3))], axis=1)
    own = {"first": -0.25, "interval": 0.5, "controls": rows}
    motion, tau = ContinuousMotion(*ContinuousMotion.endpoint(own), **own), np.linspace(-0.3, 2.0, 9)
    for axes in (np.diag([1.0, -1.0, 1.0]), np.eye(3)[[1, 0, 2]], so3.exp(np.array([0.3, -0.5, 1.0]))):
        found, pose = motion.seen(axes, 0.4).body_from_world(tau), motion.body_from_world(tau)
        np.testing.assert_allclose(found.R, axes @ pose.R @ axes.T, atol=1e-12)
        np.testing.assert_allclose(found.t, 0.4 * pose.t @ axes.T, atol=1e-12)
