"""What left-right matches say of a rig: distortion, sides and rows, from points projected by closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from rsbench.capture.calibration import RefusedFramesError, judge_stereo, of_offset, recalibrated, row_pattern
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.so3 import FloatArray

RIG = StereoRig(camera=PinholeCamera.centred(1200, 400, 700.0), baseline=0.5)


def _matches(k: float = 0.0, noise: float = 0.15, n: int = 600, forward: float = 0.0) -> FloatArray:
    """(n, 4) of random points; ``k``: radial distortion; ``forward``: metres the right camera stands ahead."""
    rng = np.random.default_rng(3)
    depth = rng.uniform(5.0, 60.0, n)
    points = np.stack([rng.uniform(-0.8, 0.8, n) * depth, rng.uniform(-0.27, 0.27, n) * depth, depth], axis=1)
    out = []
    for x, z in ((0.25, 0.0), (-0.25, forward)):
        rays = (points[:, :2] + np.array([x, 0.0])) / (points[:, 2:] - z)
        rays = rays * (1.0 + k * np.sum(rays**2, axis=1, keepdims=True))
        out.append(rays * 700.0 + np.array([RIG.camera.cx, RIG.camera.cy]))
    return np.concatenate(out, axis=1) + noise * rng.standard_normal((n, 4))


def test_the_distortion_of_a_lens_is_seen_in_the_rows() -> None:
    """k in the distorted radius instead of the true one is off by 2 k r^2, a third at the border."""
    for k in (-0.3, -0.15, 0.0):
        pattern = row_pattern(_matches(k), RIG)
        assert pattern is not None
        assert abs(pattern.distortion - k) < 0.35 * abs(k) + 4.0 * pattern.distortion_sigma
        assert pattern.systematic_px < 0.1 + 5.0 * abs(k)


def test_a_tilt_of_the_rows_is_measured() -> None:
    """Rows that differ by a x have the root mean square of a x, whatever the noise."""
    stereo = _matches()
    tilt = 0.8 * (stereo[:, 2] - RIG.camera.cx) / 600.0
    stereo[:, 3] += tilt
    pattern = row_pattern(stereo, RIG)
    assert pattern is not None
    assert pattern.systematic_px == pytest.approx(np.sqrt(np.mean(tilt**2)), abs=0.03)


def test_good_pairs_pass_and_bad_ones_are_told_apart() -> None:
    judge_stereo(_matches(), RIG, 1.5)
    judge_stereo(_matches() + np.array([0.0, 0.0, 0.8, 0.0]), RIG, 1.5)  # an offset of real calibrations
    bad = {"exchanged": _matches()[:, [2, 3, 0, 1]], "undistorted": _matches(-0.33), "late": _matches(forward=2.0)}
    for word, stereo in bad.items():
        with pytest.raises(RefusedFramesError, match=word):
            judge_stereo(stereo, RIG, 1.5)


def test_an_offset_is_taken_from_the_disparity_alone() -> None:
    stereo = _matches()
    c = Correspondences(left=stereo, right=stereo, tracks=np.concatenate([stereo, stereo], axis=1))
    moved = recalibrated(c, RIG, of_offset(0.6))
    np.testing.assert_allclose(moved.tracks[:, 0] - moved.tracks[:, 2], stereo[:, 0] - stereo[:, 2] - 0.6)
    np.testing.assert_allclose(moved.tracks[:, 0] + moved.tracks[:, 2], stereo[:, 0] + stereo[:, 2])
    np.testing.assert_allclose(moved.tracks[:, 0], moved.left[:, 0])


def test_one_wrong_match_of_large_disparity_is_no_lens() -> None:
    """Of 60 matches with disparities below 20 px one is wrong by 300 px along the row, and its row by 6 px."""
    stereo = _matches(n=60)
    stereo[:, 2] = stereo[:, 0] - np.random.default_rng(1).uniform(4.0, 20.0, 60)
    judge_stereo(stereo, RIG, 1.5)
    stereo[0] = [900.0, 80.0, 600.0, 86.0]
    pattern = row_pattern(stereo, RIG)
    assert pattern is not None and abs(pattern.distortion) < 5.0 * pattern.distortion_sigma
    judge_stereo(stereo, RIG, 1.5)
