"""The trajectory of a sequence. Truth: points projected at their rows' times, moving by laws that are not ours."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scipy
from scipy.spatial.transform import Rotation

from rsbench.capture import trajectory_banded as banded
from rsbench.capture.trajectory import Trajectory, TrajectoryOptions, estimate_trajectory, trajectory_bound
from rsbench.capture.trajectory_choice import approximated
from rsbench.capture.trajectory_data import pack_windows
from rsbench.capture.trajectory_fit import fit, normal_equations
from rsbench.capture.trajectory_kernels import Tails
from rsbench.capture.trajectory_poses import blank_views, fill_views
from rsbench.capture.trajectory_prior import Prior, roughness, whitening
from rsbench.capture.trajectory_spline import ContinuousMotion, Curve, evaluate, make_curve, moved
from rsbench.capture.trajectory_stream import stream_trajectory
from rsbench.components.motion_models import motion_record, read_motion
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import BoolArray, Correspondences
from rsbench.core.motion import LinearMotion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

FOCAL, BASELINE, HEIGHT, RATIO = 520.0, 0.2, 480, 0.8
RIG = StereoRig(camera=PinholeCamera.centred(640, HEIGHT, FOCAL), baseline=BASELINE)
SHUTTER = RollingShutter(height=HEIGHT, readout_ratio=RATIO)
Law = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Rotations body_from_world (n, 3, 3) and positions of the body (n, 3) at times (n,)."""


def sines(rng: np.random.Generator, size: float, slowest: float, fastest: float) -> Law:
    """Three sines about and along each axis, on top of 1.5 degrees and 0.15 m per frame."""
    turn = np.radians(0.2) * size * rng.uniform(0.5, 1.5, (3, 3))
    shift = 0.005 * size * rng.uniform(0.5, 1.5, (3, 3))
    rates, phases = rng.uniform(slowest, fastest, (2, 3, 3)), rng.uniform(0.0, 2.0 * np.pi, (2, 3, 3))
    w, v = (
        scale * each / np.linalg.norm(each)
        for scale, each in ((0.02618, rng.normal(size=3)), (0.15, rng.normal(size=3)))
    )

    def law(tau: FloatArray) -> tuple[FloatArray, FloatArray]:
        angles, places = (
            np.sum(size * np.sin(2.0 * np.pi * f * tau[:, None, None] + p), axis=-1)
            for size, f, p in ((turn, rates[0], phases[0]), (shift, rates[1], phases[1]))
        )
        R = Rotation.from_rotvec(angles) * Rotation.from_rotvec(tau[:, None] * w)
        return R.as_matrix(), tau[:, None] * v + places

    return law


def times(y: FloatArray, frame: int) -> FloatArray:
    """The rule of the conventions, written once more."""
    return frame + RATIO * y / HEIGHT


def seen(law: Law, points: FloatArray, frame: int, side: int) -> FloatArray:
    """Pixels (n, 2) of points of the world (n, 3): the row decides the time, and the time the row."""
    y = np.full(len(points), 0.5 * HEIGHT)
    for _ in range(12):
        R, p = law(times(y, frame))
        x = np.einsum("nij,nj->ni", R, points - p) + np.array([(0.5 - side) * BASELINE, 0.0, 0.0])
        y = FOCAL * x[:, 1] / x[:, 2] + 239.5
    pixels = np.stack([FOCAL * x[:, 0] / x[:, 2] + 319.5, y], axis=-1)
    return np.where(x[:, 2:] > 0.1, pixels, np.nan)


def scattered(law: Law, frame: int, count: int, rng: np.random.Generator) -> FloatArray:
    """Points (n, 3) 2 to 12 m in front of the left camera."""
    pixels, z = rng.uniform([0.0, 0.0], [640.0, HEIGHT], (count, 2)), rng.uniform(2.0, 12.0, count)
    R, p = law(times(pixels[:, 1], frame))
    rays = np.concatenate([(pixels - [319.5, 239.5]) / FOCAL, np.ones((count, 1))], axis=1) * z[:, None]
    rays[:, 0] -= 0.5 * BASELINE
    return np.einsum("nji,nj->ni", R, rays) + p


def inside(pixels: FloatArray) -> BoolArray:
    x, y = pixels[:, 0::2], pixels[:, 1::2]
    return np.all((x > 0.0) & (x < 639.0) & (y > 0.0) & (y < 479.0), axis=1)


def matches(
    law: Law, frames: int, rng: np.random.Generator, outliers: float = 0.2, count: int = 300, noise: float = 0.3
) -> tuple[list[Correspondences], list[BoolArray]]:
    """For each two frames, tracks (count, 8) and which of them are right."""
    windows, right = list[Correspondences](), list[BoolArray]()
    for k in range(frames - 1):
        points = scattered(law, k, 3 * count, rng)
        tracks = np.concatenate([seen(law, points, k + i // 2, i % 2) for i in range(4)], axis=1)
        tracks = tracks[inside(tracks)][:count]
        tracks = tracks + noise * rng.normal(size=tracks.shape)
        wrong = rng.random(len(tracks)) < outliers
        for j in np.flatnonzero(wrong):
            end = rng.integers(4)
            tracks[j, 2 * end : 2 * end + 2] = rng.uniform([0.0, 0.0], [640.0, 480.0])
        windows.append(Correspondences(tracks=tracks))
        right.append(~wrong)
    return windows, right


def row_errors_deg(found: Trajectory, law: Law, frames: int) -> FloatArray:
    """Errors of the rotations of all rows against the first row of their frame."""
    rows, out = np.arange(0.0, HEIGHT, 12.0), list[FloatArray]()
    for k in range(frames):
        tau = times(rows, k)
        ours, truth = found.motion.body_from_world(tau).R, law(tau)[0]
        ours, truth = ours @ ours[0].T, truth @ truth[0].T
        out.append(np.asarray(Rotation.from_matrix(ours @ np.swapaxes(truth, 1, 2)).magnitude())[1:])
    return np.rad2deg(np.array(out))


def wild(rng: np.random.Generator, controls: int = 9) -> Curve:
    """A spline that turns far."""
    R = Rotation.from_rotvec(0.3 * rng.normal(size=(controls, 3))).as_matrix()
    return make_curve(-0.4, 0.6, R, 0.3 * rng.normal(size=(controls, 3)))


def differences(of: Callable[[Curve], FloatArray], curve: Curve, step: float) -> FloatArray:
    """Central differences (..., 6 controls) by the control poses."""
    out = []
    for unit in np.eye(6 * len(curve.p)):
        out.append((of(moved(curve, step * unit)) - of(moved(curve, -step * unit))) / (2.0 * step))
    return np.stack(out, axis=-1)


def test_poses_and_their_derivatives_by_the_control_poses() -> None:
    curve = wild(np.random.default_rng(0))
    taus = np.linspace(curve.first, curve.last, 17)
    views = blank_views(len(taus))
    fill_views(curve, taus, views)
    (R, t), spin, speed = evaluate(curve, taus)
    np.testing.assert_allclose(views.R, R, atol=1e-14)
    np.testing.assert_allclose(views.p, -np.einsum("nji,nj->ni", R, t), atol=1e-14)
    np.testing.assert_allclose(views.spin, spin, atol=1e-14)
    np.testing.assert_allclose(views.speed, speed, atol=1e-14)

    def turned(other: Curve) -> FloatArray:
        return Rotation.from_matrix(evaluate(other, taus)[0].R @ np.swapaxes(R, 1, 2)).as_rotvec()

    ours = np.zeros((len(taus), 3, len(curve.p), 6))
    for k, i in enumerate(views.index):
        ours[k, :, i : i + 4, :3] = np.swapaxes(views.turn[k], 0, 1)
    # A step of 1e-6 leaves 1e-12 of truncation and 1e-10 of rounding.
    np.testing.assert_allclose(ours.reshape(len(taus), 3, -1), differences(turned, curve, 1e-6), atol=1e-8)


def test_the_spline_runs_through_its_velocity_and_goes_on_at_it() -> None:
    motion = ContinuousMotion.of(wild(np.random.default_rng(1)))
    tau, step = np.linspace(-1.0, 5.0, 31), 1e-5
    (before, t0), (after, t1) = (motion.body_from_world(tau + each) for each in (-step, step))
    spin, speed = motion.velocity(tau)
    turn = Rotation.from_matrix(after @ np.swapaxes(before, 1, 2)).as_rotvec() / (2.0 * step)
    # Jumps of the third derivative at knots: 1e-5 of them.
    np.testing.assert_allclose(turn, spin, atol=1e-4)
    np.testing.assert_allclose((t1 - t0) / (2.0 * step), speed, atol=1e-4)
    R, t = motion.body_from_world(0.0)
    np.testing.assert_allclose(R, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(t, 0.0, atol=1e-14)


def test_a_motion_is_read_back_as_it_was_written() -> None:
    motion = ContinuousMotion.of(wild(np.random.default_rng(2)))
    again = read_motion(motion_record(motion))
    np.testing.assert_allclose(again.body_from_world(1.7).t, motion.body_from_world(1.7).t, atol=1e-15)


def test_the_gradient_of_the_tracks_and_of_the_prior() -> None:
    rng = np.random.default_rng(3)
    law = sines(rng, 1.0, 0.15, 0.45)
    windows, _ = matches(law, 3, rng, outliers=0.0, count=12)
    curve = approximated(LinearMotion([0.02, -0.01, 0.01], [0.1, 0.0, -0.1]).body_from_world, (0.0, 2.8), 0.5)
    # A global shutter: the weights of pixels, which the gradient takes as given, do not depend on the motion.
    tracks = pack_windows(windows, RIG, SHUTTER)
    still = tracks.ends.copy()
    still[:, 7:9] = 0.0
    tracks = replace(tracks, ends=still)
    everything, prior, tails = np.ones(len(tracks)), Prior(0.5, 2, 1e-3, 1e-3), Tails(4.0, 2.0)

    def cost(other: Curve) -> FloatArray:
        return np.array(normal_equations(other, tracks, tails, prior, everything, False).cost)

    ours = normal_equations(curve, tracks, tails, prior, everything).gradient
    wanted = differences(cost, curve, 1e-6)
    # Points are found to 1e-3 px of errors of some pixels, which they lower to first order only.
    np.testing.assert_allclose(ours, wanted, atol=2e-3 * np.max(np.abs(wanted)))


@pytest.mark.parametrize("smooth", [1, 2])
def test_the_prior_whitens_accelerations_that_forget(smooth: int) -> None:
    """Its weights undo the covariance of the autoregression that they mean, by brute force."""
    interval, memory, count = 0.5, 0.8, 9
    rho = np.exp(-interval / memory)
    long = 4000  # the autoregression's answer to one push, until it is 0
    push = np.zeros(long)
    push[0] = 1.0
    answer = scipy.signal.lfilter([1.0], np.poly([rho] * smooth), push)
    lags = np.array([answer[: long - k] @ answer[k:] for k in range(count)])
    covariance = scipy.linalg.toeplitz(lags / lags[0])
    rows = whitening(interval, memory, smooth)
    W = np.zeros((count, count))
    for k in range(count):
        row = rows[min(k, smooth)]
        W[k, k + 1 - len(row) : k + 1] = row
    np.testing.assert_allclose(W @ covariance @ W.T * interval**4, np.eye(count), atol=1e-9)


def test_roughness_is_that_of_second_differences() -> None:
    rng = np.random.default_rng(4)
    p = rng.normal(size=(9, 3))
    curve = make_curve(0.0, 0.5, np.broadcast_to(np.eye(3), (9, 3, 3)), p)
    d = np.diff(p, n=2, axis=0)
    rows = whitening(0.5, 0.7, 2)
    errors = [rows[0][0] * d[0], rows[1] @ d[:2], *(rows[2] @ d[k : k + 3] for k in range(5))]
    assert roughness(curve, 0.7, 2, 30).squares[1] == pytest.approx(float(np.sum(np.square(errors))), rel=1e-12)


def test_the_inverse_of_a_band() -> None:
    rng = np.random.default_rng(5)
    n, width = 40, 7
    A = np.tril(np.triu(rng.normal(size=(n, n)), -width + 1))
    dense = A @ A.T + np.eye(n)
    band = np.stack([np.concatenate([np.diagonal(dense, -i), np.zeros(i)]) for i in range(width)], axis=1)
    lower = banded.factor(band)
    inverse = np.linalg.inv(dense)
    for i in range(width):
        np.testing.assert_allclose(banded.inverse_band(lower)[: n - i, i], np.diagonal(inverse, -i), rtol=1e-9)
    assert banded.log_determinant(lower) == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-12)


SHAKES = {"strong": (1.0, 0.15, 0.45), "tremor": (0.25, 0.15, 0.45), "walk": (1.0, 0.06, 0.18)}


@pytest.mark.parametrize(("shake", "frames"), [("strong", 8), ("tremor", 8), ("walk", 8), ("strong", 60)])
def test_rows_of_a_shaken_rig(shake: str, frames: int) -> None:
    rng = np.random.default_rng(6)
    law = sines(rng, *SHAKES[shake])
    windows, right = matches(law, frames, rng)
    found = estimate_trajectory(windows, RIG, SHUTTER)
    errors = row_errors_deg(found, law, frames)
    assert np.median(errors) < 0.02  # asked for by issue 30
    assert abs(found.noise_px - 0.3) < 0.02  # three deviations of 2400 errors are 0.01
    assert np.all(found.supported)
    wrong = sum(np.count_nonzero(mask != truth) for mask, truth in zip(found.inliers, right, strict=True))
    assert wrong <= 0.01 * 300 * frames  # wrong ends that lie within ten deviations by chance


def drawn(prior: Prior, rng: np.random.Generator, frames: int, interval: float) -> Curve:
    """A spline whose control poses the prior draws: accelerations by brute force from their covariance."""
    count = int(np.ceil((frames - 1 + RATIO) / interval)) + 3
    rho, m = np.exp(-interval / prior.memory), prior.smooth
    push = np.zeros(2000)
    push[0] = 1.0
    answer = scipy.signal.lfilter([1.0], np.poly([rho] * m), push)
    lags = np.array([answer[: 2000 - k] @ answer[k:] for k in range(count - 2)])
    root = np.linalg.cholesky(scipy.linalg.toeplitz(lags / lags[0]))
    turns, shifts = (np.sqrt(s) * interval**2 * root @ rng.normal(size=(count - 2, 3)) for s in prior[2:])
    w, v = (
        scale * each / np.linalg.norm(each)
        for scale, each in ((0.02618, rng.normal(size=3)), (0.15, rng.normal(size=3)))
    )
    steps, along = (
        np.concatenate([[interval * a], interval * a + np.cumsum(b, axis=0)]) for a, b in ((w, turns), (v, shifts))
    )
    R = [np.eye(3)]
    for step in steps:
        R.append(Rotation.from_rotvec(step).as_matrix() @ R[-1])
    p = np.concatenate([np.zeros((1, 3)), np.cumsum(along, axis=0)])
    return ContinuousMotion.of(make_curve(0.0, interval, np.array(R), p)).curve


def law_of(curve: Curve) -> Law:
    def law(tau: FloatArray) -> tuple[FloatArray, FloatArray]:
        R, t = evaluate(curve, tau)[0]
        return R, -np.einsum("nji,nj->ni", R, t)

    return law


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
        bound = trajectory_bound(motion, clean, RIG, SHUTTER, 0.3, interval, prior)
        squares += np.mean(errors**2, axis=0) / runs
        bounds += np.mean(np.diagonal(bound.covariance(tau), axis1=1, axis2=2), axis=0) / runs
        last = found.covariance(tau)[-1]
        nees.append(float(errors[-1] @ np.linalg.solve(last, errors[-1])))
    assert np.sqrt(np.sum(squares[:3]) / np.sum(bounds[:3])) < 1.2
    assert np.sqrt(np.sum(squares[3:]) / np.sum(bounds[3:])) < 1.2
    low, high = (float(scipy.stats.chi2.ppf(share, 6 * runs)) for share in (0.005, 0.995))
    assert low < sum(nees) < high


def test_a_bound_is_the_scatter_of_linearised_estimates() -> None:
    """Without a prior, and without ours: the scatter of fits to many draws of the noise of one scene."""
    rng = np.random.default_rng(8)
    truth = drawn(Prior(0.5, 2, 0.02**2, 0.04**2), rng, 3, 1.0)
    clean, _ = matches(law_of(truth), 3, rng, outliers=0.0, noise=0.0)
    motion = ContinuousMotion.of(truth)
    bound = trajectory_bound(motion, clean, RIG, SHUTTER, 0.3, 1.0)
    tau, errors = np.array([0.4, 1.2, 2.6]), list[FloatArray]()
    flat = Prior(0.5, 2, 1e6, 1e6)
    for _ in range(40):
        noisy = [Correspondences(tracks=w.tracks + 0.3 * rng.normal(size=w.tracks.shape)) for w in clean]
        tracks = pack_windows(noisy, RIG, SHUTTER)
        found = fit(truth, tracks, flat, False, Tails(1e6, 0.3), np.ones(len(tracks)))
        R, _ = law_of(found.curve)(tau)
        errors.append(Rotation.from_matrix(R @ np.swapaxes(law_of(truth)(tau)[0], 1, 2)).as_rotvec())
    ratio = np.mean(np.square(errors), axis=0) / np.diagonal(bound.covariance(tau), axis1=1, axis2=2)[:, :3]
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


def test_a_window_is_seen_from_its_own_first_row() -> None:
    motion = ContinuousMotion.of(wild(np.random.default_rng(13)))
    later = motion.from_time(2.0)
    R, t = later.body_from_world(0.3)
    R2, t2 = motion.body_from_world(2.0)
    np.testing.assert_allclose(R @ R2, motion.body_from_world(2.3).R, atol=1e-14)
    np.testing.assert_allclose(R @ t2 + t, motion.body_from_world(2.3).t, atol=1e-14)


def test_a_stream_says_what_the_whole_sequence_does() -> None:
    """Windows that have left count as a quadratic cost: the same trajectory, as well as it is known."""
    rng = np.random.default_rng(14)
    law = sines(rng, *SHAKES["walk"])
    windows, _ = matches(law, 20, rng)
    whole = estimate_trajectory(windows, RIG, SHUTTER)
    parts = list(stream_trajectory(windows, RIG, SHUTTER))
    assert [each.number for each in parts] == list(range(19))
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
