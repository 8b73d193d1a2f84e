"""Motion models against closed forms, differences and Fourier transforms; what inertial sensors measure."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm, logm

from rsbench.components.motion_models import (
    AcceleratedMotion,
    InertialMotion,
    LinearMotion,
    TwistMotion,
    make_motion,
    motion_record,
    read_motion,
)
from rsbench.core import so3
from rsbench.core.imu import STANDARD_GRAVITY, inertial
from rsbench.core.motion import LaterMotion, Motion
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.so3 import FloatArray
from rsbench.core.spline_motion import PRESETS, SplineMotion, TrajectoryMotion, world_from_body
from rsbench.dataset.card import load_dataset_card

Model = (
    type[LinearMotion] | type[InertialMotion] | type[TwistMotion] | type[AcceleratedMotion] | type[SplineMotion]
)
MODELS: tuple[Model, ...] = (LinearMotion, TwistMotion, InertialMotion, AcceleratedMotion, SplineMotion)
few = settings(max_examples=25)
vectors = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)
times = st.floats(-2, 3)


def _matrix(motion: Motion, tau: float) -> FloatArray:
    R, t = motion.body_from_world(tau)
    M = np.eye(4)
    M[:3, :3], M[:3, 3] = R, t
    return M


@few
@given(vectors, vectors, times)
def test_linear_motion_is_the_papers(w: FloatArray, d: FloatArray, tau: float) -> None:
    R, t = LinearMotion(w, d).body_from_world(tau)
    np.testing.assert_allclose(R, expm(tau * so3.hat(w)), rtol=0, atol=1e-14)
    np.testing.assert_allclose(t, tau * d, rtol=1e-15)


@few
@given(vectors, vectors, times)
def test_twist_motion_is_the_matrix_exponential_of_its_twist(w: FloatArray, d: FloatArray, tau: float) -> None:
    motion = TwistMotion(w, d)
    xi = np.zeros((4, 4))
    xi[:3, :3], xi[:3, 3] = so3.hat(w), motion.v
    np.testing.assert_allclose(_matrix(motion, tau), expm(tau * xi), rtol=0, atol=1e-13)


@few
@given(vectors, vectors, st.floats(-1.0, 2.0))
def test_an_inertial_body_keeps_its_velocity_in_the_world_and_its_rate_of_turn(
    w: FloatArray, d: FloatArray, start: float
) -> None:
    """Its centre -R^T t moves along a line at one speed; seen from a later time it does too."""
    tau = np.linspace(-1.0, 2.0, 7)
    for motion in (InertialMotion(w, d), InertialMotion(w, d).from_time(start)):
        R, t = motion.body_from_world(tau)
        centres = -np.einsum("nji,nj->ni", R, t)
        np.testing.assert_allclose(centres, tau[:, None] * -(so3.exp(-w) @ motion.d), rtol=0, atol=1e-12)
        np.testing.assert_allclose(R, so3.exp(tau[:, None] * w), rtol=0, atol=1e-12)
    later, general = InertialMotion(w, d).from_time(start), LaterMotion.of(InertialMotion(w, d), start)
    np.testing.assert_allclose(_matrix(later, 0.7), _matrix(general, 0.7), rtol=0, atol=1e-12)


@pytest.mark.parametrize("model", MODELS)
@few
@given(vectors, vectors)
def test_every_model_starts_at_the_world_and_reaches_w_and_d(model: Model, w: FloatArray, d: FloatArray) -> None:
    R, t = model(w, d).body_from_world([0.0, 1.0])
    np.testing.assert_allclose(R, [np.eye(3), expm(so3.hat(w))], rtol=0, atol=1e-14)
    np.testing.assert_allclose(t, [np.zeros(3), d], rtol=0, atol=1e-14)


@pytest.mark.parametrize("model", MODELS)
@few
@given(vectors, vectors, times)
def test_velocity_is_the_derivative_of_the_pose(model: Model, w: FloatArray, d: FloatArray, tau: float) -> None:
    motion, step = model(w, d), 1e-5
    before, after = motion.body_from_world(tau - step), motion.body_from_world(tau + step)
    w_rate, t_rate = motion.velocity(tau)
    # Central differences: truncation step^2 times the third derivative, which a shake every quarter of a period
    # makes large; rounding 1e-16 / step; where a spline is only once differentiable, at its ends, step.
    at_end = model is SplineMotion and min(abs(tau), abs(tau - 2.0)) <= step
    atol = 1e-4 if at_end else 1e-8
    np.testing.assert_allclose(so3.log(after.R @ before.R.T) / (2 * step), w_rate, rtol=0, atol=atol)
    np.testing.assert_allclose((after.t - before.t) / (2 * step), t_rate, rtol=0, atol=atol)


accelerations = st.floats(-0.45, 3.0)


@few
@given(vectors, vectors, accelerations, st.floats(0, 2))
def test_accelerated_motion_has_constant_acceleration(w: FloatArray, d: FloatArray, k: float, tau: float) -> None:
    motion = AcceleratedMotion(w, d, acceleration=k)
    # t'' = k t'(0), and t(1) = d: the two facts that define the law.
    (_, start), (_, now) = motion.velocity(0.0), motion.velocity(tau)
    np.testing.assert_allclose(now, (1.0 + k * tau) * start, rtol=0, atol=1e-14)
    path = LinearMotion(w, d).body_from_world(motion.share(tau))
    np.testing.assert_allclose(motion.body_from_world(tau).R, path.R, rtol=0, atol=1e-14)
    assert motion.speed(tau) > 0.0
    if k == 0.0:
        np.testing.assert_array_equal(motion.share(tau), tau)


@pytest.mark.parametrize("k", [-0.5, -3.0, np.nan, np.inf])
def test_a_motion_that_would_turn_back_is_refused(k: float) -> None:
    with pytest.raises(ValueError, match=r"acceleration = .*: must be a number (above -0\.5|that is finite)"):
        AcceleratedMotion(np.zeros(3), np.zeros(3), acceleration=k)


@few
@given(vectors, vectors, times, st.sampled_from([0.1, 0.3, 0.5, 2.0]))
def test_a_spline_without_shake_is_a_constant_twist(
    w: FloatArray, d: FloatArray, tau: float, interval: float
) -> None:
    motion = SplineMotion(w, d, interval=interval, shake=np.zeros((int(np.ceil(2 / interval)) + 3, 6)))
    np.testing.assert_allclose(_matrix(motion, tau), _matrix(TwistMotion(w, d), tau), rtol=0, atol=1e-12)


def control(seed: int, n: int, size: float = 0.05) -> FloatArray:
    rng = np.random.default_rng(seed)
    return size * rng.standard_normal((n, 6)) + np.arange(n)[:, None] * np.array([0.01, 0.02, 0, 0.1, 0, 0.05])


@few
@given(st.integers(0, 10**6), st.floats(0, 2))
def test_the_spline_is_the_cumulative_one_of_its_poses(seed: int, tau: float) -> None:
    """By 4 x 4 matrices and SciPy's exponential and logarithm, and by the basis in its recursive form."""
    interval, poses = 0.5, control(seed, 7)
    w, d = SplineMotion.endpoint({"interval": interval, "poses": poses}) or (None, None)
    assert w is not None and d is not None
    motion = SplineMotion(w, d, interval=interval, poses=poses)

    def matrix(pose: FloatArray) -> FloatArray:
        M = np.eye(4)
        M[:3, :3], M[:3, 3] = expm(so3.hat(pose[:3])), pose[3:]
        return M

    matrices = [matrix(pose) for pose in poses]
    steps = [np.real(logm(after @ np.linalg.inv(before))) for before, after in pairwise(matrices)]

    def raw(time: float) -> FloatArray:
        # De Boor's recursion, summed from the back, weighs the steps between control poses.
        knots, x = np.arange(-3.0, 9.0), time / interval
        basis = [1.0 * (knots[k] <= x < knots[k + 1]) for k in range(len(knots) - 1)]
        for degree in (1, 2, 3):
            basis = [
                (x - knots[k]) / degree * basis[k] + (knots[k + degree + 1] - x) / degree * basis[k + 1]
                for k in range(len(knots) - 1 - degree)
            ]
        weights = np.cumsum(basis[::-1])[::-1]
        M = matrices[0]
        for k, step in enumerate(steps, start=1):
            M = expm(weights[k] * step) @ M
        return M

    expected = raw(tau) @ np.linalg.inv(raw(0.0))
    np.testing.assert_allclose(_matrix(motion, tau), expected, rtol=0, atol=1e-10)


@few
@given(st.sampled_from(list(PRESETS)), vectors, vectors, st.integers(0, 10**6))
def test_a_shake_moves_neither_end(preset: str, w: FloatArray, d: FloatArray, seed: int) -> None:
    R, t = SplineMotion(0.3 * w, 0.3 * d, preset=preset, seed=seed).body_from_world([0.0, 1.0])
    np.testing.assert_allclose(R, [np.eye(3), expm(so3.hat(0.3 * w))], rtol=0, atol=1e-12)
    np.testing.assert_allclose(t, [np.zeros(3), 0.3 * d], rtol=0, atol=1e-12)


@few
@given(st.integers(0, 10**6), st.integers(1, 7))
def test_a_spline_is_twice_differentiable_at_its_knots(seed: int, knot: int) -> None:
    motion = SplineMotion([0.02, -0.03, 0.01], [0.2, 0.1, -0.1], preset="handheld", seed=seed)
    tau, step = 0.25 * knot, 1e-4
    velocity = np.concatenate(motion.velocity(tau + step * np.array([-2.0, -1.0, 0.0, 1.0, 2.0])), axis=-1)
    below, above = (velocity[2] - velocity[1]) / step, (velocity[3] - velocity[2]) / step
    # Each one-sided difference errs by step times the third derivative at most, the second of the velocity.
    third = np.abs(np.diff(velocity[:3], 2, axis=0)) + np.abs(np.diff(velocity[2:], 2, axis=0))
    np.testing.assert_array_less(np.abs(above - below), 2.0 * np.max(third) / step + 1e-9)
    # Were it only once differentiable, the acceleration would jump by about its own size.
    assert np.max(np.abs(above - below)) < 0.02 * np.max(np.abs(above)) + 1e-3


@pytest.mark.parametrize("model", MODELS)
@few
@given(vectors, vectors, st.integers(0, 1))
def test_no_speed_exceeds_the_bound(model: Model, w: FloatArray, d: FloatArray, frame: int) -> None:
    motion = model(w, d)
    bound = motion.fastest(frame, frame + 1.0)
    assert bound is not None
    for rate, most in zip(motion.velocity(np.linspace(frame, frame + 1.0, 200)), bound, strict=True):
        assert np.max(np.linalg.norm(rate, axis=-1)) <= most * (1.0 + 1e-12) + 1e-150  # squares below lose digits


@pytest.mark.parametrize(
    "motion",
    [
        TwistMotion([0.1, 0.2, 0.3], [0.3, 0.1, 0.2]),
        InertialMotion([0.1, 0.2, 0.3], [0.3, 0.1, 0.2]),
        AcceleratedMotion([0.1, 0.2, 0.3], [0.3, 0.1, 0.2], acceleration=1.5),
        SplineMotion([0.1, 0.2, 0.3], [0.3, 0.1, 0.2], preset="drone", seed=8),
    ],
)
def test_parameters_make_the_motion_again(motion: Motion) -> None:
    tau = np.linspace(-0.2, 2.2, 30)
    again = type(motion)(motion.w, motion.d, **motion.parameters)
    for now, before in zip(again.body_from_world(tau), motion.body_from_world(tau), strict=True):
        np.testing.assert_array_equal(now, before)
    moved = motion.with_endpoint(2.0 * motion.w, -motion.d)
    assert moved.parameters == motion.parameters
    np.testing.assert_allclose(moved.body_from_world(1.0).t, -motion.d, rtol=0, atol=1e-12)


STILL = [0.0] * 6


def test_explicit_poses_fix_the_motion() -> None:
    given = {"interval": 0.4, "poses": control(3, 8)}
    w, d = SplineMotion.endpoint(given) or (None, None)
    assert w is not None and d is not None
    motion = SplineMotion(w, d, **given)
    # The poses are seen through the spline, which passes near them, and from its own pose at time 0.
    near = Pose(so3.exp(control(3, 8)[:, :3]), control(3, 8)[:, 3:])
    R, t = motion.body_from_world(0.4 * np.arange(1, 6))
    expected = compose(Pose(near.R[2:7], near.t[2:7]), inverse(Pose(near.R[1], near.t[1])))
    assert np.max(so3.angle(R @ np.swapaxes(expected.R, -1, -2))) < 0.2
    assert np.max(np.abs(t - expected.t)) < 0.2
    with pytest.raises(ValueError, match="must be those of its poses"):
        SplineMotion(w, 1.1 * d, **given)


def _spectral(spectrum: Any) -> dict[str, Any]:
    return {"interval": 0.5, "spectrum": spectrum}


def _banded(low: float, high: float, degrees: float) -> dict[str, Any]:
    return _spectral({"path": STILL, "bands": [[low, high, degrees, 0.0]]})


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"preset": "boat"}, "must be one of 'steady', 'handheld', 'drone', 'driving'"),
        ({"seed": -1}, "seed = -1: must be a whole number"),
        ({"interval": 0.5}, "interval goes with shake or poses"),
        ({"shake": np.zeros((7, 6))}, "interval = None: must be a number"),
        ({"shake": np.zeros((6, 6)), "interval": 0.5}, "shake has 6 rows; an interval of 0.5 needs 7"),
        ({"shake": np.zeros((7, 5)), "interval": 0.5}, "rows of 6 finite numbers"),
        ({"shake": np.zeros((7, 6)), "interval": 0.5, "seed": 1}, "shake and seed exclude each other"),
        (_spectral(3), "spectrum must be a table with path and bands"),
        (_spectral({"bands": [[0.1, 0.2, 0.1, 0.0]]}), "spectrum must be a table with path and bands"),
        (_spectral({"path": [0.0] * 5, "bands": [[0.1, 0.2, 0.1, 0.0]]}), "spectrum.path must be 6"),
        (_spectral({"path": ["a"] * 6, "bands": [[0.1, 0.2, 0.1, 0.0]]}), "spectrum.path"),
        (_spectral({"path": STILL, "bands": []}), "spectrum.bands must be 1 to 32 rows of 4"),
        (_banded(0.2, 0.1, 0.1), "must rise from 0"),
        (_banded(0.2, 0.6, 0.1), "at most 0.5 cycles per frame period"),
        (_banded(0.2, 0.3, -0.1), "standard deviations from 0"),
        (_banded(0.2, 0.3, float("nan")), "spectrum.bands"),
        (_banded(0.1, 0.2, 0.1) | {"preset": "handheld"}, "spectrum and preset exclude each other"),
        (_banded(0.1, 0.2, 0.1) | {"interval": 1e-6}, "at most 20000 are drawn"),
    ],
)
def test_a_spline_refuses_what_it_cannot_be(parameters: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        SplineMotion(np.zeros(3), np.zeros(3), **parameters)  # pyrefly: ignore[bad-argument-type]


def test_a_spline_of_half_a_turn_is_refused() -> None:
    with pytest.raises(ValueError, match="shorter than pi"):
        SplineMotion([0.0, 3.2, 0.0], np.zeros(3))


def _motion(bands: list[list[float]], path: list[float] = STILL, **others: Any) -> SplineMotion:
    given = {**_spectral({"path": path, "bands": bands}), **others}
    w, d = SplineMotion.endpoint(given) or (None, None)
    assert w is not None and d is not None
    return SplineMotion(w, d, **given)


def _power(values: FloatArray, cycles: float) -> tuple[FloatArray, FloatArray]:
    """Power (n, 3) by frequency (n,) of values (m, 3), ``cycles`` of which are a frame period."""
    window = np.hanning(len(values))[:, None]
    spectrum = np.abs(np.fft.rfft((values - values.mean(axis=0)) * window, axis=0)) ** 2
    return np.asarray(np.fft.rfftfreq(len(values), 1.0 / cycles), dtype=np.float64), spectrum / np.sum(
        window**2
    ) * 2.0 / len(values)


@pytest.mark.parametrize(("low", "high"), [(0.05, 0.1), (0.2, 0.4)])
def test_a_band_has_its_strength_at_its_frequencies_and_nowhere_else(low: float, high: float) -> None:
    """Of 400 periods: eight sines add their powers to 3 %, a spline through 5 points of the fastest loses 1 %."""
    motion = _motion([[low, high, 0.1, 0.002]], periods=400)
    tau = np.arange(0.0, 400.0, 0.25)
    R, t = motion.body_from_world(tau)
    for values, sigma in ((np.rad2deg(so3.log(R)), 0.1), (t, 0.002)):
        np.testing.assert_allclose(np.std(values, axis=0), sigma, rtol=0.05)
        frequency, power = _power(values, 4.0)
        inside = (frequency > low - 0.01) & (frequency < high + 0.01)
        # Outside are what the window leaks, and turns that do not commute: 0.1 deg of each other.
        assert np.all(np.sum(power[~inside], axis=0) < 1e-3 * np.sum(power, axis=0))


def test_bands_add_and_the_path_goes_on_below_them() -> None:
    motion = _motion(
        [[0.01, 0.05, 0.3, 0.0], [0.2, 0.4, 0.0, 0.001]], [0.0, 0.5, 0.0, 0.0, 0.0, -0.03], periods=100
    )
    R, t = motion.body_from_world(np.arange(101.0))
    np.testing.assert_allclose(np.rad2deg(np.linalg.norm(so3.log(R[-1]))), 50.0, atol=2.0)
    # A circle of half a degree and 30 mm each period, seen from the start of a body that sways by 0.3 deg there.
    chord = 0.03 * np.sin(np.deg2rad(25.0)) / np.sin(np.deg2rad(0.25))
    np.testing.assert_allclose(
        np.linalg.norm(inverse(type(motion.body_from_world(0.0))(R, t)).t[-1]), chord, rtol=0.02
    )


def test_a_longer_shake_begins_as_a_shorter_one_and_is_read_back_to_rounding() -> None:
    bands = [[0.05, 0.3, 0.2, 0.003]]
    short, long = (_motion(bands, periods=periods, seed=3) for periods in (4, 40))
    tau = np.linspace(0.0, 4.0, 33)
    for a, b in zip(short.body_from_world(tau), long.body_from_world(tau), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)
    again = SplineMotion(long.w, long.d, **long.parameters)
    for a, b in zip(again.body_from_world(tau), long.body_from_world(tau), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-11)
    assert np.max(np.abs(_motion(bands, seed=4).w - short.w)) > 1e-4


def test_the_card_handheld_turns_as_fast_as_it_says() -> None:
    """RMS about an axis: over a second a band's sines beat, so that each sequence is up to a half off."""
    card = load_dataset_card("handheld")
    said = {"still": 2.7, "walk": 14.0, "shake": 27.0}
    rates: dict[str, list[FloatArray]] = {name: [] for name in said}
    for sequence in card.sequence:
        motion = card.motion_of(sequence)
        assert motion.lasts >= card.frames - 1 + card.shutter_for(sequence).readout_ratio
        rates[sequence.name.rpartition("-")[2]].append(motion.velocity(np.linspace(0.0, card.frames, 600))[0])
    for name, turns in rates.items():
        rms = np.rad2deg(np.sqrt(np.mean(np.concatenate(turns) ** 2))) / card.frame_period_s
        assert 0.7 * said[name] < rms < 1.4 * said[name]


def _smooth(tau: FloatArray) -> Pose:
    """A path of our own: a rotation about an axis that turns itself, and a bent way."""
    tau = np.asarray(tau, dtype=np.float64)
    turn = so3.exp(np.stack([0.3 * np.sin(tau), 0.2 * tau, 0.1 * np.cos(2 * tau)], axis=-1))
    way = np.stack([np.sin(1.3 * tau), 0.4 * tau**2, np.cos(tau)], axis=-1)
    return Pose(turn @ so3.exp(np.stack([0 * tau, 0 * tau, 0.5 * tau], axis=-1)), way)


def _rows(tau: FloatArray, path: Pose) -> FloatArray:
    w, x, y, z = np.moveaxis(so3.quaternion(path.R), -1, 0)
    return np.column_stack([tau, path.t, x, y, z, w])


def _through(poses: FloatArray) -> TrajectoryMotion:
    parameters = {"poses": poses.tolist()}
    ends = TrajectoryMotion.endpoint(parameters)
    assert ends is not None
    motion = make_motion("trajectory", *ends, parameters)
    assert isinstance(motion, TrajectoryMotion)
    return motion


@few
@given(st.integers(0, 2**32 - 1))
def test_poses_are_hit_at_their_times(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tau = np.cumsum(rng.uniform(0.05, 0.5, 30)) - 0.6
    poses = _rows(tau, Pose(so3.exp(np.cumsum(rng.normal(0, 0.3, (30, 3)), axis=0)), rng.normal(0, 5, (30, 3))))
    poses[::3, 4:] *= -1  # the same rotations
    motion = _through(poses)
    given = Pose(so3.from_quaternion(poses[:, [7, 4, 5, 6]]), poses[:, 1:4])
    start = world_from_body(poses, 0.0)
    found = compose(start, inverse(motion.body_from_world(tau)))
    np.testing.assert_allclose(found.R, given.R, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.t, given.t, rtol=0, atol=1e-11)


def test_between_poses_the_error_falls_with_the_fourth_power_of_the_step() -> None:
    between = np.linspace(0.0, 1.0, 101)
    expected, errors = _smooth(between), list[list[float]]()
    for step in (0.1, 0.05, 0.025):
        tau = np.arange(-1.0, 2.0 + step, step)
        found = world_from_body(_rows(tau, _smooth(tau)), between)
        errors.append(
            [np.max(np.abs(found.t - expected.t)), np.max(so3.angle(found.R @ np.swapaxes(expected.R, 1, 2)))]
        )
    # 16 in the limit; terms of the next order change it by some tenths.
    ratios = np.divide(errors[:-1], errors[1:])
    assert np.all((ratios > 14.0) & (ratios < 18.5)), ratios
    # The bound of Hall and Meyer for the position: fourth derivatives are 1.3^4 and 1 at most.
    assert errors[0][0] <= 5 / 384 * 0.1**4 * 1.3**4


@few
@given(st.floats(-1.2, 2.2))
def test_velocity_is_the_derivative_also_beyond_the_poses(tau: float) -> None:
    times = np.arange(-0.5, 1.6, 0.15)
    motion, step = _through(_rows(times, _smooth(times))), 1e-5
    (R0, t0), (R1, t1) = motion.body_from_world(tau - step), motion.body_from_world(tau + step)
    w, t = motion.velocity(tau)
    # Central differences: step^2 by the third derivative, below 1e2, and 1e-16 / step; at a pose and at the ends,
    # where the second derivative of the path jumps at most, step.
    np.testing.assert_allclose(so3.log(R1 @ R0.T) / (2 * step), w, rtol=0, atol=1e-4)
    np.testing.assert_allclose((t1 - t0) / (2 * step), t, rtol=0, atol=1e-4)


def test_moving_the_frame_of_all_poses_changes_nothing() -> None:
    times = np.arange(-0.5, 1.6, 0.15)
    path, move = _smooth(times), Pose(so3.exp(np.array([1.0, -2.0, 0.4])), np.array([3.0, -5.0, 7.0]))
    one, other = (
        _through(_rows(times, path)),
        _through(_rows(times, compose(move, path))),
    )
    tau = np.linspace(0, 1.5, 31)
    for first, second in zip(one.body_from_world(tau), other.body_from_world(tau), strict=True):
        np.testing.assert_allclose(first, second, rtol=0, atol=1e-13)


def test_a_record_makes_the_same_motion_again() -> None:
    times = np.arange(-0.5, 1.6, 0.3)
    motion = _through(_rows(times, _smooth(times)))
    again = read_motion(motion_record(motion))
    np.testing.assert_array_equal(again.body_from_world(0.37).t, motion.body_from_world(0.37).t)
    np.testing.assert_allclose(motion.body_from_world(1.0).R, so3.exp(motion.w), rtol=0, atol=1e-15)


STRAIGHT = np.array([[-1.0, 0, 0, 0, 0, 0, 0, 1], [0.5, 1, 0, 0, 0, 0, 0, 1], [2.0, 2, 0, 0, 0, 0, 0, 1]])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: p[:, :7], "rows of 8"),
        (lambda p: p[:1], "two or more"),
        (lambda p: p * np.nan, "finite"),
        (lambda p: p[::-1], "later"),
        (lambda p: 1.1 * p, "length 1"),
        (lambda p: p + 2 * np.eye(8)[0], "reach from time 0 to 1"),
        (lambda p: np.vstack([p[:2], [2, 0, 0, 0, 1, 0, 0, 0]]), "90 degrees"),
    ],
)
def test_poses_that_cannot_be_are_refused(change: object, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        TrajectoryMotion.endpoint({"poses": change(STRAIGHT)})  # pyrefly: ignore[not-callable]


def test_another_end_than_that_of_the_poses_is_refused() -> None:
    with pytest.raises(ValueError, match="must be those of its poses"):
        TrajectoryMotion(np.zeros(3), np.zeros(3), STRAIGHT)


W, D = np.array([0.08, -0.12, 0.05]), np.array([0.2, -0.1, 0.3])
DOWN = np.array([0.0, STANDARD_GRAVITY, 0.0])


def _along(w: FloatArray, d: FloatArray) -> Motion:
    """Through poses a quarter of a period apart, of a smooth path that is none of the models."""
    tau = np.arange(-2, 11) * 0.25
    R, t = TwistMotion(w, d).body_from_world(tau + 0.1 * np.sin(2 * tau))
    place = inverse(AcceleratedMotion(0.5 * w, d[::-1], 0.4).body_from_world(tau))
    q = so3.quaternion(np.swapaxes(R, 1, 2) @ place.R)
    poses = np.column_stack([tau, place.t - t, q[:, 1:], q[:, 0]])
    end = TrajectoryMotion.endpoint({"poses": poses})
    assert end is not None
    return TrajectoryMotion(*end, poses=poses)


FELT_MODELS: dict[str, Callable[[FloatArray, FloatArray], Motion]] = {
    "linear": LinearMotion,
    "twist": TwistMotion,
    "accelerated": lambda w, d: AcceleratedMotion(w, d, 0.3),
    "spline": lambda w, d: SplineMotion(w, d, preset="handheld", seed=2),
    "trajectory": _along,
}


class _Plain(LinearMotion):  # pyrefly: ignore[invalid-inheritance]  # final
    """A model that does not say its accelerations."""

    accelerations = Motion.accelerations

    def velocity(self, tau):  # pyrefly: ignore[implicit-any-parameter, unannotated-return]
        tau = np.asarray(tau)[..., None]
        return np.sin(3 * tau) * self.w, np.exp(tau) * self.d


@pytest.mark.parametrize("name", FELT_MODELS)
@settings(max_examples=5)
@given(place=st.integers(-1, 7), within=st.floats(0.05, 0.95), scale=st.floats(0.1, 1.5))
def test_accelerations_are_the_derivatives_of_velocities(
    name: str, place: int, within: float, scale: float
) -> None:
    """Between the knots, every quarter of a period. h^2 / 6 of a third derivative below 100, and rounding / h."""
    motion, tau, h = FELT_MODELS[name](scale * W, scale * D), 0.25 * (place + within), 1e-5
    for k in (0, 1):
        difference = (motion.velocity(tau + h)[k] - motion.velocity(tau - h)[k]) / (2 * h)
        np.testing.assert_allclose(motion.accelerations(tau)[k], difference, rtol=0, atol=1e-8)


def test_a_model_that_does_not_say_them_has_differences() -> None:
    tau = np.linspace(0.0, 1.0, 7)[:, None]
    w, t = _Plain(W, D).accelerations(tau[:, 0])
    np.testing.assert_allclose(w, 3 * np.cos(3 * tau) * W, rtol=0, atol=1e-10)
    np.testing.assert_allclose(t, np.exp(tau) * D, rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", FELT_MODELS)
def test_rates_and_forces_integrate_back_to_the_poses(name: str) -> None:
    """Steps of the middle rule, whose error is h^2 / 24 of second derivatives below 1e4 / s^2, over 0.18 s."""
    motion, period, h = FELT_MODELS[name](W, D), 0.1, 2e-5
    steps = round(1.8 * period / h)
    felt = inertial(motion, (np.arange(steps) + 0.5) * h / period, period, DOWN)
    start = inverse(motion.body_from_world(0.0))
    speed_in_body = motion.velocity(0.0)[1] - np.cross(motion.velocity(0.0)[0], motion.body_from_world(0.0).t)
    R, p, v = start.R, start.t, -(start.R @ speed_in_body) / period
    for turn, force in zip(so3.exp(h * felt.turn), felt.force, strict=True):
        later = R @ turn
        a = 0.5 * (R + later) @ force + DOWN
        p, v, R = p + h * v + 0.5 * h * h * a, v + h * a, later
    end = inverse(motion.body_from_world(1.8))
    assert so3.angle(R.T @ end.R) < 1e-7
    np.testing.assert_allclose(p, end.t, rtol=0, atol=2e-5)


def test_at_rest_one_feels_that_one_does_not_fall() -> None:
    felt = inertial(LinearMotion(np.zeros(3), np.zeros(3)), 0.3, 0.1, DOWN)
    np.testing.assert_allclose([felt.turn, felt.force], [np.zeros(3), -DOWN], rtol=0, atol=1e-15)


def test_a_turn_to_the_right_is_positive_about_the_axis_down() -> None:
    """Points move to the left in the body, by exp(-angle about y)."""
    felt = inertial(LinearMotion([0.0, -0.05, 0.0], np.zeros(3)), 0.3, 0.1, DOWN)
    np.testing.assert_allclose(felt.turn, [0.0, 0.5, 0.0], rtol=0, atol=1e-15)
