"""Errors of a calibration, alone and with motion and shutter. Truth: closed forms, projected points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.capture.calibration import (
    LENS,
    NO_ERRORS,
    OFFSET,
    RADIAL,
    ROWS,
    TERMS,
    RefusedFramesError,
    describe_errors,
    judge_stereo,
    offset_error,
    ray_shifts,
    recalibrated,
    row_pattern,
)
from rsbench.capture.hypotheses import KnownInputs
from rsbench.capture.shutter_decision import known_of
from rsbench.capture.two_frame_estimate import conclude, examine
from rsbench.components.motion_models import LinearMotion, TwistMotion
from rsbench.core import so3
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.core.so3 import FloatArray

RIG = StereoRig(camera=PinholeCamera.centred(1200, 400, 700.0), baseline=0.5)
REAL = dict(
    offset=-1.0, offset_xx=-2.4, offset_yy=4.5, row=-0.2, row_x=0.45, row_y=-0.5, row_xy=-7.2, radial=0.015
)
"""px and as TERMS have them: about what two excerpts of KITTI odometry show."""


def rays(n: int = 40) -> FloatArray:
    return np.random.default_rng(0).uniform((-0.85, -0.28), (0.85, 0.28), (n, 2))


def test_row_terms_are_what_a_turned_right_camera_leaves() -> None:
    """To first order: pitch gives 1 + y^2, roll x, yaw xy."""
    v, turn = rays(), np.array([2e-6, 3e-6, -4e-6])
    turned = np.column_stack([v, np.ones(len(v))]) @ so3.exp(turn).T
    left_minus_right = v[:, 1] - turned[:, 1] / turned[:, 2]
    errors = np.zeros(len(TERMS))
    errors[ROWS] = turn[0], -turn[2], 0.0, -turn[1]
    shifts = [np.einsum("ncx,c->nx", ray_shifts(v, side, 1.0), errors)[:, 1] for side in ("left", "right")]
    extra = turn[0] * v[:, 1] ** 2  # of a pitch, which is no term: below a twelfth of it here
    np.testing.assert_allclose(shifts[0] - shifts[1] + extra, left_minus_right, atol=5e-11)


def test_lens_terms_are_those_of_cameras() -> None:
    """Against a camera with a small lens in OpenCV's model."""
    v = rays()
    k1, p2, p1 = 1e-5, 2e-5, -1e-5
    lens = Lens(model="brown-conrady", k1=k1, p1=p1, p2=p2)
    camera = PinholeCamera(width=1200, height=400, fx=700.0, fy=700.0, cx=599.5, cy=199.5, lens=lens)
    seen = RIG.camera.unproject(camera.project(np.column_stack([v, np.ones(40)])))[:, :2]
    expected = np.einsum("ncx,c->nx", ray_shifts(v, "right", 700.0)[:, LENS], [k1, p2, p1])
    np.testing.assert_allclose(seen - v, expected, atol=1e-9)


@pytest.mark.parametrize(
    "lens",
    [
        Lens(model="brown-conrady", k1=-0.2, k2=0.03, p1=0.001),
        Lens(model="kannala-brandt", k1=-0.03, k2=0.01),
        Lens(model="rational", k1=0.9, k2=0.06, p1=-0.0004, k3=0.001, k4=1.25, k5=0.22, k6=0.006),
    ],
)
def test_the_radial_term_behind_a_lens_is_its_own_first_coefficient(lens: Lens) -> None:
    v, step = 0.7 * rays(), 1e-6
    ends = [replace(lens, k1=lens.k1 + change).undistort(lens.distort(v).xy) for change in (-step, step)]
    found = ray_shifts(v, "left", 700.0, lens)[:, RADIAL]
    # A larger k1 at the same pixel is a smaller ray; the shift is that by which measured rays are too large.
    np.testing.assert_allclose(found, (ends[0] - ends[1]) / (2 * step), rtol=1e-6, atol=1e-8)


def wrong(matches: Correspondences) -> tuple[Correspondences, tuple[float, ...]]:
    """Matches of a rig whose calibration errs as real ones do: to first order the opposite of taking it back."""
    errors = tuple(REAL.get(name, 0.0) for name in TERMS)
    return recalibrated(matches, RIG, [-e for e in errors]), errors


@pytest.mark.slow
@pytest.mark.parametrize(("ratio", "seed"), [(0.0, 0), (0.7, 1)])
def test_errors_as_large_as_real_ones_are_found_with_the_shutter(ratio: float, seed: int) -> None:
    """Within four deviations; taken for none they are errors of 0.5 px and more in matches of 0.1 px."""
    shutter = RollingShutter(height=400, readout_ratio=ratio)
    motion = TwistMotion(w=np.radians([0.4, 1.8, 0.2]), d=[0.02, 0.03, 1.0])
    if ratio == 0.0:
        motion = LinearMotion(w=motion.w, d=motion.d)
    options = SimulationOptions(tracks=400, noise_px=0.1)
    exact = simulate(RIG, shutter, motion, options, np.random.default_rng(seed)).correspondences
    matches, errors = wrong(exact)
    known = known_of(matches, RIG, KnownInputs(scanning=Scanning()))
    capture = conclude([examine(matches, RIG, known)])
    best = capture.likeliest
    assert best is not None and capture.noise_px < 0.15
    assert best.scans.rolls == (ratio > 0.0) and abs(best.ratio - ratio) <= 4.0 * best.sigma
    off = np.abs(np.array(best.calibration) - errors)
    for k in (OFFSET, *range(ROWS.start, ROWS.stop)):
        assert off[k] < 4.0 * best.calibration_sigma[k] + 0.02, TERMS[k]  # 0.02 px: the second order
    right = KnownInputs(scanning=Scanning(), calibration=NO_ERRORS)
    blind = conclude([examine(matches, RIG, known_of(matches, RIG, right))])
    assert blind.noise_px > 0.2


def test_errors_are_told_by_what_they_do_to_the_images() -> None:
    """In the corner of largest error: x = -600 / 700, y = -200 / 700."""
    x, y = -600.0 / 700.0, -200.0 / 700.0
    rows = abs(-0.2 + 0.45 * x - 0.5 * y - 7.2 * x * y)
    errors = tuple(REAL.get(name, 0.0) for name in TERMS)
    assert (
        describe_errors(errors, RIG)
        == f"disparities -1.00 px in the middle; rows by up to {rows:.1f} px; k1 +0.015"
    )
    assert describe_errors(NO_ERRORS, RIG) == ""


def test_a_good_calibration_is_left_alone() -> None:
    shutter, motion = (
        RollingShutter(height=400, readout_ratio=0.7),
        LinearMotion(w=[0.0, 0.02, 0.0], d=[0.0, 0.0, 1.0]),
    )
    options = SimulationOptions(tracks=400, noise_px=0.1)
    matches = simulate(RIG, shutter, motion, options, np.random.default_rng(2)).correspondences
    assert known_of(matches, RIG, KnownInputs(scanning=Scanning())).calibration_sigma == NO_ERRORS


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
    bad = {"exchanged": _matches()[:, [2, 3, 0, 1]], "distortion": _matches(-0.33), "late": _matches(forward=2.0)}
    for word, stereo in bad.items():
        with pytest.raises(RefusedFramesError, match=word):
            judge_stereo(stereo, RIG, 1.5)


def test_an_offset_is_taken_from_the_disparity_alone() -> None:
    stereo = _matches()
    c = Correspondences(left=stereo, right=stereo, tracks=np.concatenate([stereo, stereo], axis=1))
    moved = recalibrated(c, RIG, offset_error(0.6))
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
