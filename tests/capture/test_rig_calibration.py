"""What tracks show of a calibration that is wrong, against the true one that they were simulated with."""

from __future__ import annotations

import numpy as np
import pytest

from rsbench.capture.hypotheses import KnownInputs
from rsbench.capture.rig_calibration import agrees, prior_of, refine_rig, rotation_of_rows, rows_moved, with_errors
from rsbench.components.motion_models import make_motion
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.motion import Motion
from rsbench.core.projection import rs_project
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.frame_capture import KnownCapture, rig_of_matches
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.frame_motion import solve_frames

TRUE = StereoRig.of_cameras(
    PinholeCamera.centred(640, 480, 520.0),
    PinholeCamera.centred(640, 480, 527.0),
    so3.exp(np.deg2rad([0.4, 0.8, -0.6])),
    (-0.2, 0.001, -0.002),
)
SHUTTER: RollingShutter = TRUE.shutter_of(Scanning(), 0.8)
LOOSE = np.array([*np.deg2rad([0.2, 0.2, 0.2, 0.1, 0.1]), 0.005, 0.005, 0.0])
"""Standard deviations of a loose calibration, in the order of ``ERRORS``."""


def motion_of(rng: np.random.Generator) -> Motion:
    """2 deg and 0.25 m a frame period."""
    w, d = rng.normal(size=(2, 3))
    return make_motion("linear", w * np.deg2rad(2.0) / np.linalg.norm(w), d * 0.25 / np.linalg.norm(d))


def tracks_of(
    rng: np.random.Generator,
    noise_px: float,
    count: int,
    rig: StereoRig = TRUE,
    shutter: RollingShutter = SHUTTER,
    motion: Motion | None = None,
) -> FloatArray:
    """Tracks (n, 8) of a given motion, or of one by ``motion_of``."""
    motion = motion or motion_of(rng)
    X = rng.uniform([-6.0, -4.0, 2.0], [6.0, 4.0, 14.0], (6 * count, 3))
    X[:, :2] *= X[:, 2:] / 8.0
    ends = [rs_project(rig, shutter, motion, side, frame, X).pixels for frame in (0, 1) for side in SIDES]
    tracks = np.concatenate(ends, axis=1)
    tracks = tracks[np.all(np.isfinite(tracks), axis=1)][:count]
    return np.asarray(tracks + rng.normal(0.0, noise_px, tracks.shape))


def ideal(rows: FloatArray, rig: StereoRig) -> FloatArray:
    ends = [rig.eye(side).ideal_pixels(rows[:, k : k + 2]) for k, side in zip((0, 2), SIDES, strict=True)]
    return np.concatenate(ends, axis=1)


def test_errors_added_and_taken_away_leave_the_rig() -> None:
    errors = np.array([0.01, -0.02, 0.03, 0.004, -0.005, 0.01, -0.02, 0.0])
    there = with_errors(TRUE, errors)
    assert np.rad2deg(so3.angle(there.right_from_left.R @ TRUE.right_from_left.R.T)) > 1.0
    for side in SIDES:
        back = with_errors(with_errors(TRUE, np.eye(8)[6] * 0.01), np.eye(8)[6] * -0.01)
        np.testing.assert_allclose(back.own(side).R, TRUE.own(side).R, atol=1e-12)
        assert back.sensor(side).fx == pytest.approx(TRUE.sensor(side).fx)
    left, right = (there.sensor(side) for side in SIDES)
    again = StereoRig.of_cameras(left, right, *there.right_from_left)
    for side in SIDES:  # the axes of the body are those of a calibration that prints the same cameras
        np.testing.assert_allclose(there.own(side).R, again.own(side).R, atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_rows_show_the_rotation_among_outliers(seed: int) -> None:
    rng = np.random.default_rng(seed)
    errors = np.array([*np.deg2rad(rng.uniform(-4.0, 4.0, 3)), 0.0, 0.0, 0.01, -0.01, 0.0])
    tracks = tracks_of(rng, 0.2, 200)
    wrong = rng.uniform(0.0, 480.0, (120, 4))
    given = with_errors(TRUE, errors)
    found = rotation_of_rows(ideal(np.concatenate([tracks[:, :4], wrong]), given), given)
    assert found is not None
    start, inside = found
    assert np.mean(inside[:200]) > 0.9
    assert np.mean(inside[200:]) < 0.1
    np.testing.assert_allclose(
        start[[0, 2]], -errors[[0, 2]], atol=np.deg2rad(0.3)
    )  # the search is of first order


def test_matches_of_another_scene_show_no_rotation() -> None:
    stereo = np.random.default_rng(0).uniform(0.0, 480.0, (300, 4))
    assert rotation_of_rows(stereo, TRUE) is None


@pytest.mark.slow
def test_a_loose_calibration_is_found_within_the_stated_deviations() -> None:
    scores = []
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        tracks, errors = tracks_of(rng, 0.3, 250), LOOSE * rng.normal(size=8)
        given = with_errors(TRUE, errors)
        rows = rotation_of_rows(ideal(tracks[:, :4], given), given)
        assert rows is not None
        found = refine_rig([Correspondences(tracks=tracks)], given, SHUTTER, rows[0], prior_of(rows[0]))
        assert found is not None
        # The right rotation about the baseline and the viewing direction within 0.02 deg, from 250 matches.
        assert np.all(np.abs(found.errors + errors)[[0, 2]] < np.deg2rad(0.03))
        scores.append((found.errors + errors)[:7] / found.sigma[:7])
    squares = np.array(scores) ** 2
    assert np.mean(squares < 9.0) >= 0.95
    # Chi-squared of 84: the mean lies between 0.6 and 1.6 in all but one of ten thousand.
    assert 0.4 < np.mean(squares) < 1.6


VERTICAL = StereoRig.of_cameras(
    PinholeCamera.centred(640, 480, 520.0),
    PinholeCamera.centred(640, 480, 520.0),
    so3.exp(np.deg2rad([0.3, -0.2, 0.4])),
    (0.0, -0.2, 0.0),
)
GIVEN = KnownInputs(readout_ratio=0.8, scanning=Scanning())
OPTIONS = CorrectionOptions(motion_model="linear")


def _vertical_window(seed: int) -> tuple[Motion, Correspondences, StereoRig]:
    """A motion, its matches, a tenth of them wrong, and a loose calibration of the rig that took them."""
    rng = np.random.default_rng(seed)
    motion, errors = motion_of(rng), LOOSE * rng.normal(size=8)
    tracks = tracks_of(rng, 0.1, 300, VERTICAL, VERTICAL.shutter_of(Scanning(), 0.8), motion)
    tracks[::10, 4:] += rng.normal(0.0, 20.0, (len(tracks[::10]), 4))
    return motion, Correspondences(tracks=tracks), with_errors(VERTICAL, errors)


@pytest.mark.slow
def test_cameras_one_above_the_other_correct_their_calibration_by_tracks() -> None:
    """Both read a point at different times, so that rows show no rotation; the true calibration stays as it is."""
    assert not VERTICAL.rows_together(Scanning(), 0.8)
    for seed in range(3):
        _, matches, given = _vertical_window(300 + seed)
        found = rig_of_matches([matches], given, GIVEN, OPTIONS)
        assert found is not None
        turn = found.rig.right_from_left.R @ VERTICAL.right_from_left.R.T
        # Shared errors of 0.03 px of 520 are 0.003 deg an axis; 300 tracks of 0.1 px add as much.
        assert (
            np.rad2deg(so3.angle(turn))
            < 0.02
            < np.rad2deg(so3.angle(given.right_from_left.R @ VERTICAL.right_from_left.R.T))
        )
        assert rig_of_matches([matches], VERTICAL, GIVEN, OPTIONS) is None


@pytest.mark.slow
def test_a_motion_is_stated_with_the_errors_of_the_calibration_that_was_found() -> None:
    inside = {True: 0, False: 0}
    for seed in range(20):
        motion, matches, given = _vertical_window(400 + seed)
        found = rig_of_matches([matches], given, GIVEN, OPTIONS)
        assert found is not None
        for counted in inside:
            errors = found if counted else None
            known = KnownCapture(rig=found.rig, shutter=found.shutter, matches=matches, rig_found=errors)
            estimate = solve_frames(known, OPTIONS, in_order=True).robust.estimate
            assert estimate.covariance is not None
            off = np.concatenate([estimate.w - motion.w, estimate.d - motion.d])
            inside[counted] += bool(off @ np.linalg.solve(estimate.covariance, off) < 12.59)  # chi-squared of 6
    # Of 20 ellipsoids of 95 %, fewer than 16 hold the truth once in 390.
    assert inside[True] >= 16
    assert inside[False] <= 10


def test_one_step_decides_whether_a_calibration_agrees() -> None:
    """What rows hardly show, an error of the convergence, shows in one step as it does in the whole estimate."""
    prior = prior_of(np.zeros(8))
    for seed in range(3):
        tracks = Correspondences(tracks=tracks_of(np.random.default_rng(200 + seed), 0.3, 250))
        assert agrees([tracks], TRUE, SHUTTER, prior)
        turned = with_errors(TRUE, np.eye(8)[1] * np.deg2rad(0.15))
        assert rows_moved(np.eye(8)[1] * np.deg2rad(0.15), TRUE) < 0.3
        assert not agrees([tracks], turned, SHUTTER, prior)


def test_a_late_right_camera_is_found_with_its_rotation() -> None:
    rng = np.random.default_rng(7)
    tracks, errors = tracks_of(rng, 0.1, 300), np.array([*np.deg2rad([0.2, -0.1, 0.1, 0.0, 0.0]), 0.0, 0.0, 0.0])
    given = with_errors(TRUE, errors)
    early = TRUE.shutter_of(Scanning(right_delay=-0.02), 0.8)
    prior = prior_of(-errors, delay_sigma=0.05)
    found = refine_rig([Correspondences(tracks=tracks)], given, early, -errors, prior)
    assert found is not None
    assert abs(found.errors[7] - 0.02) < 4.0 * found.sigma[7]
    assert found.sigma[7] < 0.005
    assert found.shutter.right_delay == pytest.approx(-0.02 + found.errors[7])
    assert "right camera later by" in found.words


def test_a_start_of_wrong_convergence_is_not_kept() -> None:
    """Rows do not show it: of two starts the one counts under which more tracks agree with a motion."""
    rng = np.random.default_rng(8)
    tracks, errors = tracks_of(rng, 0.3, 250), np.array([*np.deg2rad([0.2, -0.1, 0.1, 0.0, 0.0]), 0.0, 0.0, 0.0])
    given = with_errors(TRUE, errors)
    start = -errors + np.deg2rad(4.0) * np.eye(8)[1]
    found = refine_rig([Correspondences(tracks=tracks)], given, SHUTTER, start, prior_of(-errors))
    assert found is not None
    assert abs(found.errors[1] + errors[1]) < 4.0 * found.sigma[1] < np.deg2rad(0.2)


def test_windows_that_pull_apart_state_larger_deviations() -> None:
    """Each has a convergence of its own, as things that move by themselves make it: their scatter counts."""
    rng, windows = np.random.default_rng(9), list[Correspondences]()
    turns = np.deg2rad([-0.1, 0.1, -0.06, 0.08])
    for turn in turns:
        tracks = tracks_of(rng, 0.1, 150)
        shift = 527.0 * turn * np.ones(len(tracks))  # what a turn of the right camera does near the middle
        tracks[:, [2, 6]] += shift[:, None]
        windows.append(Correspondences(tracks=tracks))
    none = np.zeros(8)
    one, pooled = (refine_rig(each, TRUE, SHUTTER, none, prior_of(none)) for each in (windows[:1], windows))
    assert one is not None
    assert pooled is not None
    assert abs(one.errors[1]) > 3.0 * one.sigma[1]
    # The mean of four such turns has a deviation of half of their scatter, 0.045 deg.
    assert np.deg2rad(0.03) < pooled.sigma[1]
    assert abs(pooled.errors[1] + np.mean(turns)) < 3.0 * pooled.sigma[1]


@pytest.mark.parametrize("turn", [-0.38, -0.13])
def test_a_convergence_that_turns_disparities_negative_is_found_by_parallax(turn: float) -> None:
    """Far points of a short baseline: many disparities are below 0, and no local step from 0 passes there. Rows do
    not show the smaller error."""
    far = StereoRig.of_cameras(
        PinholeCamera.centred(384, 216, 158.0),
        PinholeCamera.centred(384, 216, 158.0),
        so3.exp(np.deg2rad([0.4, -0.1, 0.05])),
        (-0.12, 0.0, 0.002),
    )
    shutter, errors = far.shutter_of(Scanning(), 0.5), np.deg2rad([0.0, turn, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    given, rng, windows = with_errors(far, errors), np.random.default_rng(3), list[Correspondences]()
    for _ in range(3):
        X = rng.uniform([-12.0, -6.0, 8.0], [12.0, 1.5, 60.0], (4000, 3))
        motion = make_motion("linear", rng.normal(size=3) * np.deg2rad(0.3), np.array([0.02, 0.01, -0.5]))
        ends = [rs_project(far, shutter, motion, side, frame, X).pixels for frame in (0, 1) for side in SIDES]
        tracks = np.concatenate(ends, axis=1)
        tracks = tracks[np.all(np.isfinite(tracks), axis=1)][:150]
        tracks += rng.normal(0.0, 0.1, tracks.shape)
        windows.append(Correspondences(tracks=tracks, stereo_0=tracks[:, :4], stereo_1=tracks[:, 4:]))
    prior, known = prior_of(np.zeros(8)), KnownInputs(readout_ratio=0.5, scanning=Scanning())
    found = rig_of_matches(windows, given, known, OPTIONS)
    assert found is not None
    assert rig_of_matches(windows, far, known, OPTIONS) is None
    assert abs(found.errors[1] + errors[1]) < 3.0 * found.sigma[1] < np.deg2rad(0.15)
    assert not agrees(windows[:1], given, shutter, prior)
    assert agrees(windows[:1], far, shutter, prior)
