"""The parts of a trajectory's estimate against differences and brute force."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scipy
from scipy.spatial.transform import Rotation
from shaken_rig import RATIO, RIG, SHUTTER, matches, sines

from rsbench.capture.trajectory_fit import NORMAL, Fit, covariance_band, normal_equations, squared_errors
from rsbench.capture.trajectory_spline import (
    ContinuousMotion,
    Curve,
    Prior,
    approximated,
    band_factor,
    band_inverse,
    band_log_determinant,
    blank_views,
    evaluate,
    fill_views,
    from_pose_at,
    make_curve,
    moved,
    roughness,
    whitening,
)
from rsbench.capture.trajectory_tracks import (
    ENOUGH,
    Tails,
    TimedTracks,
    informative,
    noise_by_tile,
    pack_windows,
)
from rsbench.components.motion_models import LinearMotion, motion_record, read_motion
from rsbench.core import so3
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.so3 import FloatArray


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


@pytest.mark.parametrize("size", [0.0, 1e-7, 0.05, 0.11, 1.0, 3.0, np.pi - 1e-3])
def test_steps_between_control_poses_are_those_of_scipy(size: float) -> None:
    axes = np.random.default_rng(3).normal(size=(8, 3))
    steps = size * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    R = np.eye(3)[None]
    for step in steps:
        R = np.concatenate([R, (Rotation.from_rotvec(step).as_matrix() @ R[-1])[None]])
    curve = make_curve(0.0, 0.5, R, np.zeros((9, 3)))
    # Near half a turn the angle is determined by the root of the rounding errors.
    np.testing.assert_allclose(curve.steps, steps, atol=1e-12 if size < 3.1 else 1e-8)
    inverses = np.linalg.inv(so3.left_jacobian(steps))
    np.testing.assert_allclose(curve.inverse_left, inverses, atol=1e-11 if size < 3.1 else 1e-7)
    turns = np.random.default_rng(4).normal(size=(9, 6))
    np.testing.assert_allclose(
        moved(curve, turns).R, Rotation.from_rotvec(turns[:, :3]).as_matrix() @ R, atol=1e-13
    )


@pytest.mark.parametrize("tau", [-0.4, 0.0, 1.3, -2.0, 9.0])
def test_the_same_trajectory_relative_to_the_body_at_a_time(tau: float) -> None:
    curve, taus = wild(np.random.default_rng(2)), np.linspace(-0.4, 3.1, 9)
    there, before, here = (evaluate(from_pose_at(curve, tau), taus), evaluate(curve, taus), evaluate(curve, tau))
    R = before[0].R @ here[0].R.T
    np.testing.assert_allclose(there[0].R, R, atol=1e-13)
    np.testing.assert_allclose(there[0].t, before[0].t - R @ here[0].t, atol=1e-12)
    np.testing.assert_allclose(there[1], before[1], atol=1e-12)


def test_some_tracks_alone_are_all_with_no_weight_for_the_others() -> None:
    rng = np.random.default_rng(5)
    windows, _ = matches(sines(rng, 1.0, 0.5, 2.0), 4, rng)
    tracks, curve = pack_windows(windows, RIG, SHUTTER), wild(np.random.default_rng(5))
    chosen = np.arange(len(tracks)) % 3 == 0
    rest = Tails(5.0, 0.3), Prior(0.2, 1, 1.0, 1.0)
    alone = normal_equations(curve, tracks.only(chosen), *rest, np.ones(np.count_nonzero(chosen)))
    every = normal_equations(curve, tracks, *rest, chosen.astype(np.float64))
    np.testing.assert_allclose(alone.cost, every.cost, rtol=1e-12)
    np.testing.assert_allclose(alone.gradient, every.gradient, atol=1e-9 * np.max(np.abs(every.gradient)))


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


def test_the_gradient_by_ratio_focal_length_and_principal_point() -> None:
    rng = np.random.default_rng(11)
    windows, _ = matches(sines(rng, 1.0, 0.15, 0.45), 3, rng, outliers=0.0, count=40)
    pairs = [Correspondences(left=each.tracks[:, [0, 1, 4, 5]]) for each in windows]
    curve = approximated(LinearMotion([0.02, -0.01, 0.01], [0.1, 0.0, -0.1]).body_from_world, (0.0, 2.8), 0.5)
    prior, tails = Prior(0.5, 2, 1e-3, 1e-3), Tails(4.0, 2.0)

    def tracks(ratio: float, log_focal: float, x: float, y: float) -> TimedTracks:
        camera = RIG.camera
        focal = {"fx": camera.fx * np.exp(log_focal), "fy": camera.fy * np.exp(log_focal)}
        other = replace(camera, cx=camera.cx + x, cy=camera.cy + y, **focal)
        return pack_windows(pairs, StereoRig.of_one(other), SHUTTER.with_ratio(ratio))

    def cost(place: FloatArray) -> float:
        each = tracks(*place)
        return normal_equations(curve, each, tails, prior, np.ones(len(each)), False).cost

    here, steps = np.array([RATIO, 0.0, 0.0, 0.0]), np.diag([1e-4, 1e-4, 1e-2, 1e-2])
    wanted = [(cost(here + step) - cost(here - step)) / (2.0 * np.max(step)) for step in steps]
    ends = [tracks(ratio, 0.0, 0.0, 0.0).ends[:, [2, 7, 8]] for ratio in (0.0, 1.0)]
    shared = replace(tracks(*here), by_ratio=ends[1] - ends[0])
    border = normal_equations(curve, shared, tails, prior, np.ones(len(shared))).border
    assert border is not None
    # Weights of pixels change with the flow, which the last three derivatives ignore; errors are large here.
    np.testing.assert_allclose(border.slope, wanted, rtol=0.02, atol=0.005 * np.max(np.abs(wanted)))


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


def test_half_a_share_is_half_the_information() -> None:
    """Of normal errors it is that of twice the variance; covariances count every track for one."""
    rng = np.random.default_rng(6)
    windows, _ = matches(sines(rng, 1.0, 0.15, 0.45), 3, rng, outliers=0.0)
    curve, prior = (
        make_curve(-0.5, 0.5, np.tile(np.eye(3), (10, 1, 1)), np.zeros((10, 3))),
        Prior(0.5, 2, 1e-4, 1e-4),
    )
    half, whole = (pack_windows(windows, RIG, SHUTTER, share=share) for share in (0.5, 1.0))
    trust = np.ones(len(whole))
    shared = normal_equations(curve, half, Tails(NORMAL, 0.3), prior, trust)
    wide = normal_equations(curve, whole, Tails(NORMAL, 0.3 * np.sqrt(2.0)), prior, trust)
    for a, b in ((shared.cost, wide.cost), (shared.gradient, wide.gradient), (shared.band, wide.band)):
        np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-4 * np.max(np.abs(b)))  # nearly normal: nu is 1e9
    found = Fit(curve=curve, tails=Tails(5.0, 0.3), prior=prior, trust=trust, equations=shared)
    one, other = (covariance_band(found, each) for each in (half, whole))
    np.testing.assert_array_equal(one, other)


def test_the_noise_of_a_tile_is_estimated_and_divides_the_errors_of_its_tracks() -> None:
    rng, curve = (
        np.random.default_rng(8),
        approximated(LinearMotion([0.02, 0, 0], [0.1, 0, 0]).body_from_world, (0, 2.8), 0.5),
    )
    windows, _ = matches(sines(rng, 1.0, 0.15, 0.45), 3, rng, outliers=0.0)
    tracks = pack_windows(windows, RIG, SHUTTER)
    right = tracks.ends[tracks.starts[:-1], 0] > np.median(tracks.ends[tracks.starts[:-1], 0])
    squares = np.where(right, 0.4, 0.1) ** 2 * rng.chisquare(tracks.freedom)
    noise = noise_by_tile(tracks, squares)
    # The median of 35 values of chi-squared with 5 degrees of freedom has a deviation of 13 %, its root of 7 %.
    assert np.mean(noise[right]) / np.mean(noise[~right]) == pytest.approx(4.0, rel=0.1)
    np.testing.assert_allclose(
        squared_errors(curve, tracks.with_noise(noise)), squared_errors(curve, tracks) / noise**2, rtol=1e-3
    )


def test_pairs_of_windows_with_tracks_enough_are_left_out() -> None:
    rng = np.random.default_rng(7)
    pairs, tracks = rng.uniform(0.0, 470.0, (5, 4)), rng.uniform(0.0, 470.0, (ENOUGH, 8))
    few = Correspondences(left=pairs, tracks=tracks[1:])
    assert informative(few) is few
    many = informative(Correspondences(left=pairs, tracks=tracks))
    assert len(many.tracks) == ENOUGH and len(many.left) == 0


def test_the_inverse_of_a_band() -> None:
    rng = np.random.default_rng(5)
    n, width = 40, 7
    A = np.tril(np.triu(rng.normal(size=(n, n)), -width + 1))
    dense = A @ A.T + np.eye(n)
    band = np.stack([np.concatenate([np.diagonal(dense, -i), np.zeros(i)]) for i in range(width)], axis=1)
    lower = band_factor(band)
    inverse = np.linalg.inv(dense)
    for i in range(width):
        np.testing.assert_allclose(band_inverse(lower)[: n - i, i], np.diagonal(inverse, -i), rtol=1e-9)
    assert band_log_determinant(lower) == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-12)


def test_a_window_is_seen_from_its_own_first_row() -> None:
    motion = ContinuousMotion.of(wild(np.random.default_rng(13)))
    later = motion.from_time(2.0)
    R, t = later.body_from_world(0.3)
    R2, t2 = motion.body_from_world(2.0)
    np.testing.assert_allclose(R @ R2, motion.body_from_world(2.3).R, atol=1e-14)
    np.testing.assert_allclose(R @ t2 + t, motion.body_from_world(2.3).t, atol=1e-14)
