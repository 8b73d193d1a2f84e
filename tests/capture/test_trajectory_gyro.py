"""A gyroscope beside the matches of a sequence. Truth: laws of ``shaken_rig``, differences, dense matrices."""

import numpy as np
import pytest
import scipy
from scipy.spatial.transform import Rotation
from shaken_rig import HEIGHT, RIG, SHAKES, SHUTTER, Law, matches, row_errors_deg, sines, times

from rsbench.capture.trajectory_estimate import (
    StreamedWindow,
    TrajectoryOptions,
    _State,
    estimate_trajectory,
    stream_trajectory,
)
from rsbench.capture.trajectory_fit import ANCHORED, anchored, normal_equations, window_motions
from rsbench.capture.trajectory_gyro import (
    ERRORS,
    Border,
    Drift,
    bordered_inverse,
    bordered_step,
    eliminated,
    gyro_steps,
    learned,
    sensed,
)
from rsbench.capture.trajectory_spline import (
    Curve,
    band_factor,
    evaluate,
    make_curve,
    moved,
)
from rsbench.capture.trajectory_tracks import TimedTracks
from rsbench.core.correspondences import Correspondences
from rsbench.core.so3 import FloatArray

DENSITY, BIAS = 3.1e-5, 6.7e-4
"""rad per root of a period, and rad per period: those of the channel ``imu`` at 30 frames a second."""
RATE = 200.0 / 30.0


def measured(law: Law, frames: int, rng: np.random.Generator, late: float = 0.0) -> FloatArray:
    """Samples (n, 4) of a law; ``late`` frame periods after their stated times."""
    tau = np.arange(-1.0, frames + 1.0, 1.0 / RATE)
    before, after = (law(tau + late + each)[0] for each in (-1e-4, 1e-4))
    w = Rotation.from_matrix(after @ np.swapaxes(before, 1, 2)).as_rotvec() / 2e-4
    noise = DENSITY * np.sqrt(RATE) * rng.normal(size=w.shape)
    return np.column_stack([tau, w + BIAS * rng.normal(size=3) + noise])


def wild(rng: np.random.Generator, controls: int = 8) -> Curve:
    R = Rotation.from_rotvec(0.3 * rng.normal(size=(controls, 3))).as_matrix()
    return make_curve(-0.4, 0.6, R, 0.3 * rng.normal(size=(controls, 3)))


def dense(band: FloatArray, border: Border) -> FloatArray:
    n = len(band)
    H = sum((np.diag(band[: n - i, i], -i) for i in range(band.shape[1])), np.zeros((n, n)))
    H = H + np.tril(H, -1).T
    return np.block([[H, border.mixed], [border.mixed.T, border.corner]])


# Parts


def test_derivatives_of_the_errors_of_a_gyroscope() -> None:
    rng = np.random.default_rng(0)
    curve = wild(rng)
    tau = np.linspace(0.1, 2.3, 13)
    samples = np.column_stack([tau, 0.2 * rng.normal(size=(13, 3))])
    steps, drift = gyro_steps(samples), Drift(np.append([0.02, -0.01, 0.03, 0.07], 0.1 * rng.normal(size=9)), 1.0)

    def at(x: FloatArray) -> float:
        other = drift._replace(errors=drift.errors + x[-ERRORS:])
        return 0.5 * sensed(moved(curve, x[:-ERRORS]), steps, other, 30).squares

    found = sensed(curve, steps, drift, 30)
    ours = np.concatenate([found.gradient, found.border.slope])
    wanted = [(at(1e-5 * e) - at(-1e-5 * e)) / 2e-5 for e in np.eye(len(ours))]
    # 1e-10 of truncation times third derivatives; rounding of a turn within a moment, 1e-16 / 1e-3, over the step.
    np.testing.assert_allclose(ours, wanted, atol=1e-5 * np.max(np.abs(wanted)))


def test_the_normal_matrix_is_the_second_derivative_where_nothing_errs() -> None:
    rng = np.random.default_rng(1)
    curve, tau = wild(rng), np.linspace(0.2, 2.2, 11)
    steps = gyro_steps(np.column_stack([tau, evaluate(curve, tau)[1]]))
    drift = Drift(np.zeros(ERRORS), 1.0)

    def slope(x: FloatArray) -> FloatArray:
        there = sensed(moved(curve, x[:-ERRORS]), steps, drift._replace(errors=x[-ERRORS:]), 30)
        return np.concatenate([there.gradient, there.border.slope])

    found = sensed(curve, steps, drift, 30)
    assert found.squares < 1e-8  # a moment's curvature, (1e-3)^2 / 6 of second derivatives of some units
    ours = dense(found.band, found.border)
    wanted = np.stack([(slope(1e-5 * e) - slope(-1e-5 * e)) / 2e-5 for e in np.eye(len(ours))])
    np.testing.assert_allclose(ours, wanted, atol=1e-4 * np.max(np.abs(wanted)))


def test_a_border_is_solved_as_a_dense_matrix() -> None:
    rng = np.random.default_rng(2)
    n, width = 24, 7
    A = np.tril(np.triu(rng.normal(size=(n, n)), -width + 1))
    H = A @ A.T + np.eye(n)
    band = np.stack([np.concatenate([np.diagonal(H, -i), np.zeros(i)]) for i in range(width)], axis=1)
    J = rng.normal(size=(4 * n, 4))
    border = Border(rng.normal(size=(n, 4)), J.T @ J, rng.normal(size=4))
    whole, gradient, lower = dense(band, border), rng.normal(size=n), band_factor(band)
    step = np.concatenate(bordered_step(lower, gradient, border))
    np.testing.assert_allclose(step, -np.linalg.solve(whole, np.concatenate([gradient, border.slope])), rtol=1e-9)
    inverse = np.linalg.inv(whole)
    ours = bordered_inverse(lower, border)
    for i in range(width):
        np.testing.assert_allclose(ours[: n - i, i], np.diagonal(inverse[:n, :n], -i), rtol=1e-8, atol=1e-12)
    added = np.linalg.slogdet(whole)[1] - np.linalg.slogdet(H)[1]
    assert eliminated(lower, border).log_determinant == pytest.approx(added, rel=1e-10)
    # What steps determine is the trace of the inverse times their own part of the matrix, here two thirds of it.
    own = sensed(wild(rng, 4), gyro_steps(np.zeros((0, 4))), Drift(np.zeros(ERRORS), 1.0), 30)
    own = own._replace(band=band / 3.0, border=Border(*(each / 3.0 for each in border)), count=100, squares=7.0)
    used, left, drift = learned(own, Drift(np.zeros(ERRORS), 0.5), lower, ours, border)
    assert used == pytest.approx((n + 4) * 2.0 / 3.0, rel=1e-9) and left == pytest.approx(100.0 - used)
    assert drift.variance == pytest.approx(7.0 / left)


def test_close_samples_are_taken_together_and_in_any_order() -> None:
    rng = np.random.default_rng(3)
    tau = np.arange(0.0, 2.0, 1.0 / 256.0)
    samples = np.column_stack([tau, rng.normal(size=(len(tau), 3))])
    steps = gyro_steps(rng.permutation(samples))
    means = samples.reshape(32, 16, 4).mean(axis=1)
    np.testing.assert_allclose(0.5 * (steps.start + steps.end), means[:, 0], atol=1e-12)
    np.testing.assert_allclose(steps.turn / (steps.end - steps.start)[:, None], means[:, 1:], atol=1e-10)
    np.testing.assert_allclose(steps.worth, 1.0 / 16.0)
    assert len(gyro_steps(samples[:5]).start) == 0  # within a sixteenth of a period: nothing changes


def test_windows_that_leave_and_those_that_stay_say_together_what_all_said() -> None:
    """Eliminating the control poses that leave, of the equations of everything, by brute force."""
    rng = np.random.default_rng(4)
    law = sines(rng, *SHAKES["walk"])
    windows, _ = matches(law, 7, rng, count=60)
    options = TrajectoryOptions(link=False, learn=False, intervals=(0.5,))
    state = _State(RIG, SHUTTER, options, gyro_steps(measured(law, 7, rng, 0.03)))
    for window in windows:
        state.add(window, *window_motions([window], RIG, SHUTTER, 0))
    found, tracks = state.solve()

    def equations(curve: Curve, some: TimedTracks, trust: FloatArray) -> tuple[FloatArray, FloatArray]:
        here = normal_equations(curve, some, found.tails, found.prior, trust, drift=found.drift)
        assert here.border is not None
        return dense(anchored(here, curve, some, ANCHORED), here.border), here.slope

    H, slope = equations(found.curve, tracks, found.trust)
    state.marginalise(found, tracks, 3)
    assert state.curve is not None and found.drift is not None and tracks.gyro is not None
    m = 6 * (len(found.curve.p) - len(state.curve.p))
    solved = scipy.linalg.solve(H[:m, :m], np.column_stack([H[:m, m:], slope[:m]]), assume_a="pos")
    rest = state._pack(state.windows, drift=found.drift)
    assert rest.gyro is not None and 0 < len(rest.gyro.start) < len(tracks.gyro.start)
    trust = np.concatenate([found.trust[each] for each in tracks.members[3:]])
    ours, own_slope = equations(state.curve, rest, trust)
    scale = np.sqrt(np.diagonal(ours))
    # The pose at time 0 has 1e4 times the precision of the most certain control pose: another one here.
    wanted = H[m:, m:] - H[m:, :m] @ solved[:, :-1]
    np.testing.assert_allclose(ours / scale / scale[:, None], wanted / scale / scale[:, None], atol=1e-3)
    np.testing.assert_allclose(own_slope / scale, (slope[m:] - H[m:, :m] @ solved[:, -1]) / scale, atol=0.05)


# Sequences


@pytest.mark.slow
@pytest.mark.parametrize(("shake", "late"), [("strong", 0.0), ("tremor", 0.2), ("walk", -0.2)])
def test_rows_are_better_with_a_gyroscope_whose_clock_is_off(shake: str, late: float) -> None:
    rng = np.random.default_rng(200)
    law = sines(rng, *SHAKES[shake])
    windows, _ = matches(law, 8, rng, count=150)
    samples = measured(law, 8, rng, late)
    alone = np.median(row_errors_deg(estimate_trajectory(windows, RIG, SHUTTER), law, 8))
    found = estimate_trajectory(windows, RIG, SHUTTER, gyro=samples)
    assert np.median(row_errors_deg(found, law, 8)) < 0.8 * alone
    assert found.gyro is not None and found.gyro.used
    assert abs(found.gyro.shift - late) < 0.03
    # 160 samples of three axes tell the noise to 4 %, knots that do not follow the shakes add to it.
    assert 0.85 * DENSITY < found.gyro.noise < 1.5 * DENSITY


def test_axes_and_scales_that_are_off_are_found() -> None:
    """Taken as right they make rows three times as wrong as without a gyroscope."""
    rng = np.random.default_rng(202)
    law = sines(rng, *SHAKES["strong"])
    windows, _ = matches(law, 8, rng, count=150)
    samples = measured(law, 8, rng)
    wrong = 1.05 * Rotation.from_rotvec([0.05, -0.03, 0.04]).as_matrix()
    samples[:, 1:] = samples[:, 1:] @ wrong.T
    options = TrajectoryOptions(intervals=(0.5,))
    alone, found = (estimate_trajectory(windows, RIG, SHUTTER, options=options, gyro=g) for g in (None, samples))
    assert found.gyro is not None and found.gyro.used
    assert np.median(row_errors_deg(found, law, 8)) < 0.8 * np.median(row_errors_deg(alone, law, 8))
    assert np.linalg.norm(found.gyro.matrix @ wrong - np.eye(3)) < 0.5 * np.linalg.norm(wrong - np.eye(3))


@pytest.mark.parametrize("fault", ["sign", "unit", "another time"])
def test_a_gyroscope_that_contradicts_the_matches_is_left_out(fault: str) -> None:
    rng = np.random.default_rng(201)
    law = sines(rng, *SHAKES["strong"])
    windows, _ = matches(law, 6, rng, count=80)
    samples = measured(law, 6, rng, 5.3 if fault == "another time" else 0.0)
    samples[:, 1:] *= {"sign": -1.0, "unit": 57.3}.get(fault, 1.0)
    options = TrajectoryOptions(intervals=(0.5,))
    alone, found = (estimate_trajectory(windows, RIG, SHUTTER, options=options, gyro=g) for g in (None, samples))
    assert found.gyro is not None and not found.gyro.used and alone.gyro is None
    np.testing.assert_array_equal(found.motion.controls, alone.motion.controls)


def rotation_errors_deg(parts: list[StreamedWindow], law: Law) -> FloatArray:
    """(windows,) of the last row against the first one."""
    tau = times(np.array([0.0, HEIGHT - 1.0]), 0)
    off = []
    for each in parts:
        (a, b), (c, d) = each.motion.body_from_world(tau).R, law(each.number + tau)[0]
        off.append(Rotation.from_matrix(b @ a.T @ c @ d.T).magnitude())
    return np.rad2deg(off)


@pytest.mark.slow
def test_silent_windows_of_a_stream_are_bridged() -> None:
    """Four windows without matches, over a border of the sliding window: 0.1 to 1 deg without a gyroscope."""
    rng = np.random.default_rng(300)
    law = sines(rng, *SHAKES["walk"])
    windows, _ = matches(law, 14, rng, count=150)
    silent = slice(5, 9)
    windows[silent] = [Correspondences()] * 4
    samples = measured(law, 14, rng, 0.1)
    options = TrajectoryOptions(intervals=(0.5,))
    found, alone = (
        list(stream_trajectory(windows, RIG, SHUTTER, options=options, gyro=gyro)) for gyro in (samples, None)
    )
    errors = rotation_errors_deg(found, law)
    assert np.max(errors) < 0.02 < np.max(rotation_errors_deg(alone, law)[silent])
    assert all(each.gyro is not None and each.gyro.used for each in found)
    whole = estimate_trajectory(windows, RIG, SHUTTER, options=options, gyro=samples)
    assert np.rad2deg(np.linalg.norm(whole.window(11).w - found[11].motion.w)) < 0.01
    nees = list[float]()
    for each in found:
        R, p = law(np.array([each.number, each.number + 1.0]))
        w, d = Rotation.from_matrix(R[1] @ R[0].T).as_rotvec(), R[1] @ (p[0] - p[1])
        off = np.concatenate([each.motion.w - w, each.motion.d - d])
        assert each.covariance is not None
        nees.append(float(off @ np.linalg.solve(each.covariance, off)))
    assert 2.5 < np.mean(nees) < 12.0  # six degrees of freedom, windows that share frames


def test_a_stream_forgets_a_gyroscope_that_goes_wrong() -> None:
    """The bias and the clock that were found with it are left out of the summary of earlier windows."""
    rng = np.random.default_rng(301)
    law = sines(rng, *SHAKES["strong"])
    windows, _ = matches(law, 16, rng, count=80)
    samples = measured(law, 16, rng)
    samples[samples[:, 0] > 11.0, 1:] *= -1.0
    found = list(
        stream_trajectory(windows, RIG, SHUTTER, options=TrajectoryOptions(intervals=(0.5,)), gyro=samples)
    )
    used = [each.gyro is not None and each.gyro.used for each in found]
    assert used[0] and not used[-1] and used == sorted(used, reverse=True)
    assert np.max(rotation_errors_deg(found, law)) < 0.15  # as without one
