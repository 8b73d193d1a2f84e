"""The trajectory of a sequence. Truth: points projected at their rows' times (``shaken_rig``)."""

import numpy as np
import pytest
import scipy
from scipy.spatial.transform import Rotation
from shaken_rig import (
    HEIGHT,
    RIG,
    SHAKES,
    SHUTTER,
    Law,
    drawn,
    inside,
    law_of,
    matches,
    row_errors_deg,
    scattered,
    seen,
    sines,
    times,
)

from rsbench.capture.trajectory_estimate import (
    TrajectoryOptions,
    estimate_trajectory,
    stream_trajectory,
)
from rsbench.capture.trajectory_fit import NORMAL, Fit, covariance_band, fit, normal_equations
from rsbench.capture.trajectory_spline import (
    NO_PRIOR,
    ContinuousMotion,
    Prior,
    approximated,
    pose_covariance,
    span_of,
)
from rsbench.capture.trajectory_tracks import Tails, pack_windows
from rsbench.components.motion_models import LinearMotion
from rsbench.core.correspondences import Correspondences
from rsbench.core.motion import Motion
from rsbench.core.so3 import FloatArray


@pytest.mark.slow
@pytest.mark.parametrize(("shake", "frames"), [("strong", 8), ("tremor", 8), ("walk", 8), ("strong", 60)])
def test_rows_of_a_shaken_rig(shake: str, frames: int) -> None:
    rng = np.random.default_rng(6)
    law = sines(rng, *SHAKES[shake])
    windows, right = matches(law, frames, rng)
    found = estimate_trajectory(windows, RIG, SHUTTER)
    errors = row_errors_deg(found, law, frames)
    assert np.median(errors) < 0.02  # the requirement of issue 30
    assert abs(found.noise_px - 0.3) < 0.02  # three deviations of 2400 errors are 0.01
    assert np.all(found.supported)
    wrong = sum(np.count_nonzero(mask != truth) for mask, truth in zip(found.inliers, right, strict=True))
    assert wrong <= 0.01 * 300 * frames  # wrong ends that lie within ten deviations by chance


def bound_of(
    motion: Motion, windows: list[Correspondences], interval: float, prior: Prior, tau: FloatArray
) -> FloatArray:
    """The Cramer-Rao bound of poses at times (n,) at the truth, with normal errors of 0.3 px."""
    alone = pack_windows(windows, RIG, SHUTTER)
    tracks = pack_windows(windows, RIG, SHUTTER, [np.ones(len(each)) for each in alone.members])
    curve = approximated(motion.body_from_world, span_of(len(windows), SHUTTER), interval)
    trust, tails = np.ones(len(tracks)), Tails(NORMAL, 0.3)
    equations = normal_equations(curve, tracks, tails, prior, trust, False)
    found = Fit(curve=curve, tails=tails, prior=prior, trust=trust, equations=equations)
    return pose_covariance(curve, covariance_band(found, tracks), tau)


@pytest.mark.slow
def test_errors_are_those_of_the_bound_and_of_the_covariances() -> None:
    """Splines drawn from the prior: the bound of H. van Trees holds on average, and covariances do."""
    prior, frames, interval, runs = Prior(0.5, 2, 0.02**2, 0.04**2), 8, 0.5, 12
    tau = np.concatenate([times(np.arange(60.0, HEIGHT, 120.0), k) for k in range(frames)])
    squares, bounds, nees = np.zeros(6), np.zeros(6), list[float]()
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        truth = drawn(prior, rng, frames, interval)
        windows, right = matches(law_of(truth), frames, rng)
        found = estimate_trajectory(windows, RIG, SHUTTER, options=TrajectoryOptions(intervals=(interval,)))
        R, p = law_of(truth)(tau)
        R_found, p_found = law_of(found.motion.curve)(tau)
        errors = np.concatenate(
            [Rotation.from_matrix(R_found @ np.swapaxes(R, 1, 2)).as_rotvec(), p_found - p], axis=1
        )
        clean = [Correspondences(tracks=w.tracks[mask]) for w, mask in zip(windows, right, strict=True)]
        motion = ContinuousMotion.of(truth)
        bound = bound_of(motion, clean, interval, prior, tau)
        squares += np.mean(errors**2, axis=0) / runs
        bounds += np.mean(np.diagonal(bound, axis1=1, axis2=2), axis=0) / runs
        last = found.covariance(tau)[-1]
        nees.append(float(errors[-1] @ np.linalg.solve(last, errors[-1])))
    assert np.sqrt(np.sum(squares[:3]) / np.sum(bounds[:3])) < 1.2
    assert np.sqrt(np.sum(squares[3:]) / np.sum(bounds[3:])) < 1.2
    low, high = (float(scipy.stats.chi2.ppf(share, 6 * runs)) for share in (0.005, 0.995))
    assert low < sum(nees) < high


@pytest.mark.slow
def test_a_bound_is_the_scatter_of_linearised_estimates() -> None:
    """Without a prior, and without ours: the scatter of fits to many draws of the noise of one scene."""
    rng = np.random.default_rng(8)
    truth = drawn(Prior(0.5, 2, 0.02**2, 0.04**2), rng, 3, 1.0)
    clean, _ = matches(law_of(truth), 3, rng, outliers=0.0, noise=0.0)
    motion = ContinuousMotion.of(truth)
    tau, errors = np.array([0.4, 1.2, 2.6]), list[FloatArray]()
    bound = bound_of(motion, clean, 1.0, NO_PRIOR, tau)
    flat = Prior(0.5, 2, 1e6, 1e6)
    for _ in range(40):
        noisy = [Correspondences(tracks=w.tracks + 0.3 * rng.normal(size=w.tracks.shape)) for w in clean]
        tracks = pack_windows(noisy, RIG, SHUTTER)
        found = fit(truth, tracks, flat, False, Tails(1e6, 0.3), np.ones(len(tracks)))
        R, _ = law_of(found.curve)(tau)
        errors.append(Rotation.from_matrix(R @ np.swapaxes(law_of(truth)(tau)[0], 1, 2)).as_rotvec())
    ratio = np.mean(np.square(errors), axis=0) / np.diagonal(bound, axis1=1, axis2=2)[:, :3]
    # 40 draws, three axes that are nearly independent: chi-squared of 120 over 120 stays within 0.7 and 1.35.
    assert np.all(np.abs(np.log(np.mean(ratio, axis=1))) < 0.35)


def lasting_points(law: Law, frames: int, rng: np.random.Generator) -> list[Correspondences]:
    """The same keypoints in all frames that see them: their noise is one."""
    points = np.concatenate([scattered(law, k, 150, rng) for k in range(frames)])
    pixels = np.stack(
        [np.concatenate([seen(law, points, k, side) for side in (0, 1)], axis=1) for k in range(frames)]
    )
    pixels = pixels + 0.3 * rng.normal(size=pixels.shape)
    out = []
    for k in range(frames - 1):
        tracks = np.concatenate([pixels[k], pixels[k + 1]], axis=1)
        out.append(Correspondences(tracks=rng.permutation(tracks[inside(tracks)])[:300]))
    return out


def test_keypoints_that_meet_are_one_track() -> None:
    rng = np.random.default_rng(9)
    law = sines(rng, *SHAKES["tremor"])
    windows = lasting_points(law, 6, rng)
    alone = pack_windows(windows, RIG, SHUTTER)
    linked = pack_windows(windows, RIG, SHUTTER, [np.ones(len(each)) for each in alone.members])
    assert len(alone) == sum(len(w.tracks) for w in windows)
    keypoints = {tuple(row) for w in windows for row in np.concatenate([w.tracks[:, :4], w.tracks[:, 4:]])}
    shared = len(linked.ends) // 2 - len(keypoints)
    # Only where a track of five frames goes on is its last keypoint counted twice.
    assert 0 <= shared <= len(linked) - len({tuple(w.tracks[0]) for w in windows})
    assert np.max(np.diff(linked.starts)) == 10
    found = estimate_trajectory(windows, RIG, SHUTTER)
    assert np.median(row_errors_deg(found, law, 6)) < 0.02


@pytest.mark.slow
def test_pairs_help_where_tracks_are_few() -> None:
    rng = np.random.default_rng(10)
    law = sines(rng, *SHAKES["tremor"])
    windows, _ = matches(law, 6, rng, outliers=0.0)
    few = [Correspondences(tracks=w.tracks[:40]) for w in windows]
    more = [
        Correspondences(tracks=w.tracks[:40], left=w.tracks[40:, [0, 1, 4, 5]], right=w.tracks[40:, [2, 3, 6, 7]])
        for w in windows
    ]
    options = TrajectoryOptions(intervals=(0.5,))
    errors = [
        np.median(row_errors_deg(estimate_trajectory(w, RIG, SHUTTER, options=options), law, 6))
        for w in (few, more)
    ]
    assert errors[1] < errors[0]


@pytest.mark.slow
def test_a_window_without_matches_is_bridged_and_says_so() -> None:
    rng = np.random.default_rng(11)
    law = sines(rng, *SHAKES["walk"])
    windows, _ = matches(law, 8, rng)
    whole = estimate_trajectory(windows, RIG, SHUTTER)
    windows[3] = Correspondences()
    found = estimate_trajectory(windows, RIG, SHUTTER)
    assert found.supported.tolist() == [True, True, True, False, True, True, True]
    tau = np.array([7.0])
    errors = law_of(found.motion.curve)(tau)[1] - law_of(whole.motion.curve)(tau)[1]
    sigma, least = (np.sqrt(np.diagonal(each.covariance(tau)[0])[3:]) for each in (found, whole))
    assert np.all(sigma > least)  # nobody saw how far the rig went
    assert np.all(np.abs(errors) < 4.0 * sigma)


@pytest.mark.slow
def test_a_wrong_motion_of_a_window_is_mended() -> None:
    rng = np.random.default_rng(12)
    law = sines(rng, *SHAKES["walk"])
    windows, _ = matches(law, 8, rng)
    R, p = law(np.arange(8.0))
    relative = R[1:] @ np.swapaxes(R[:-1], 1, 2)
    shifts = np.einsum("nij,nj->ni", R[1:], p[:-1] - p[1:])
    motions = [LinearMotion(Rotation.from_matrix(a).as_rotvec(), b) for a, b in zip(relative, shifts, strict=True)]
    motions[2] = LinearMotion([0.3, -0.2, 0.1], [0.5, 0.5, -0.5])
    found = estimate_trajectory(windows, RIG, SHUTTER, [*motions[:5], None, *motions[6:]])
    assert np.all(found.supported)
    assert np.median(row_errors_deg(found, law, 8)) < 0.02


@pytest.mark.slow
def test_a_stream_says_what_the_whole_sequence_does() -> None:
    """Windows that have left count as a quadratic cost: the same trajectory, as well as it is known."""
    rng = np.random.default_rng(14)
    law = sines(rng, *SHAKES["walk"])
    windows, _ = matches(law, 20, rng)
    whole = estimate_trajectory(windows, RIG, SHUTTER)
    parts = list(stream_trajectory(windows, RIG, SHUTTER))
    assert [each.number for each in parts] == list(range(19))
    nees = list[float]()
    for each in parts:
        R, p = law(np.array([each.number, each.number + 1.0]))
        w, d = Rotation.from_matrix(R[1] @ R[0].T).as_rotvec(), R[1] @ (p[0] - p[1])
        off = np.concatenate([each.motion.w - w, each.motion.d - d])
        assert each.covariance is not None
        nees.append(float(off @ np.linalg.solve(each.covariance, off)))
    # Windows share frames, so that few of the 19 are on their own: six degrees of freedom, within a factor.
    assert 3.0 < np.mean(nees) < 12.0
    errors, tau = list[FloatArray](), times(np.arange(0.0, HEIGHT, 48.0), 0)
    for each in parts:
        ours, truth = each.motion.body_from_world(tau).R, law(each.number + tau)[0]
        errors.append(np.asarray(Rotation.from_matrix(ours @ np.swapaxes(truth @ truth[0].T, 1, 2)).magnitude()))
    assert np.median(np.rad2deg(errors)) < 1.3 * np.median(row_errors_deg(whole, law, 20)) + 0.001
    # Six windows later than a frame say little more of it: it is as far as the whole sequence has it.
    R, t = whole.motion.body_from_world(18.0)
    sigma = np.sqrt(np.diagonal(whole.covariance(18.0)[0]))
    turned = Rotation.from_matrix(parts[18].body_from_world.R @ R.T).as_rotvec()
    assert np.all(np.abs(turned) < 2.0 * sigma[:3])
    assert np.linalg.norm(parts[18].body_from_world.t - t) < 3.0 * np.linalg.norm(sigma[3:])


@pytest.mark.slow
def test_a_stream_outlives_frames_that_match_nothing() -> None:
    """The trajectory before and after is as good; what lies between says how far it is from any matches."""
    rng = np.random.default_rng(15)
    law = sines(rng, *SHAKES["walk"])
    windows, _ = matches(law, 24, rng)
    silent = range(6, 19)
    broken = [Correspondences() if k in silent else each for k, each in enumerate(windows)]
    parts = list(stream_trajectory(broken, RIG, SHUTTER))
    assert [each.supported for each in parts] == [k not in silent for k in range(23)]
    assert parts[7].apart == parts[17].apart == 2 < min(each.apart for each in parts[8:17])
    for each in (parts[3], parts[21]):
        R = law(np.array([each.number, each.number + 1.0]))[0]
        w = Rotation.from_matrix(R[1] @ R[0].T).as_rotvec()
        assert np.rad2deg(np.linalg.norm(each.motion.w - w)) < 0.02


@pytest.mark.parametrize(("depths", "speed"), [((2.0, 12.0), 0.15), ((200.0, 1200.0), 15.0)])
def test_points_are_not_beyond_infinity(depths: tuple[float, float], speed: float) -> None:
    """Cameras that converge by one pixel too little: disparities of far points become negative.

    With these the opposite motion and points beyond infinity explain all matches. The length of a translation is
    then not determined, but its direction is.
    """

    def law(tau: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.tile(np.eye(3), (len(tau), 1, 1)), tau[:, None] * np.array([0.0, 0.0, speed])

    windows, _ = matches(law, 6, np.random.default_rng(3), noise=0.1, depths=depths)
    off = np.zeros(8)
    off[[2, 6]] = 1.0
    converging = [Correspondences(tracks=each.tracks + off) for each in windows]
    for each in stream_trajectory(converging, RIG, SHUTTER):
        assert each.motion.d[2] < 0.0
        assert each.depths == (each.covariance is not None) == (depths[0] < 10.0)
    assert np.all(estimate_trajectory(converging, RIG, SHUTTER).depths == (depths[0] < 10.0))
