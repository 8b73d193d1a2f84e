"""Errors with heavy tails: their distribution, the weights, and a covariance that holds whatever they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, t

from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, simulate
from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MotionEstimate
from rsbench.solvers.engine.levenberg_marquardt import levenberg_marquardt
from rsbench.solvers.engine.packed import HeavyTailed, Packed, _distribution, each_term, heavy_tailed, pack
from rsbench.solvers.refined import RefinedSolver

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
SHUTTER = RollingShutter(height=900, readout_ratio=0.8)
MOTION = LinearMotion(np.array([0.012, -0.02, 0.016]), np.array([0.2, -0.12, 0.18]))
TRUTH = MotionEstimate(w=MOTION.w, d=MOTION.d, success=True)


def exact(pairs: int, tracks: int, seed: int = 0, depth: tuple[float, float] = (2.0, 10.0)) -> Simulation:
    options = SimulationOptions(pairs=pairs, tracks=tracks, depth=depth)
    return simulate(RIG, SHUTTER, MOTION, options, np.random.default_rng(seed))


def heavy(points: FloatArray, scale: float, nu: float, rng: np.random.Generator) -> FloatArray:
    """Points (n, k) with errors of a multivariate t distribution: each row has a variance of its own."""
    spread = np.sqrt(nu / rng.chisquare(nu, (len(points), 1)))
    return points + scale * spread * rng.standard_normal(points.shape)


def problem(noise: float = 0.3, pairs: int = 30, tracks: int = 40) -> tuple[Packed, FloatArray]:
    rng, c = np.random.default_rng(1), exact(pairs, tracks).correspondences
    sets = {name: heavy(getattr(c, name), noise, 3.0, rng) for name in ("left", "right", "tracks")}
    packed = pack(Correspondences(**sets), RIG, SHUTTER)
    return packed, packed.theta(MOTION.w, MOTION.d)


def test_the_terms_of_each_sum_to_the_normal_equations() -> None:
    packed, theta = problem()
    each = each_term(packed, theta)
    cost, gradient, H = packed.normal_equations(theta)
    np.testing.assert_allclose(0.5 * np.sum(each.squares), cost + 0.5 * np.sum(packed.row_checks), rtol=1e-12)
    np.testing.assert_allclose(np.sum(each.gradients, axis=0), gradient, rtol=1e-10, atol=1e-10 * np.abs(H).max())
    np.testing.assert_allclose(np.sum(each.hessians, axis=0), H, rtol=1e-10, atol=1e-12 * np.abs(H).max())
    expected = np.concatenate([packed.pair_residuals(theta) ** 2, packed.track_squares(theta)])
    np.testing.assert_allclose(each.squares, expected, rtol=1e-12)


@pytest.mark.parametrize("nu", [3.0, 5.0])
def test_the_distribution_is_that_of_scipy(nu: float) -> None:
    """Of one residual each; the six parameters of a motion are 0.15 % of 2000, and the scale feels twice that."""
    x = 0.2 * np.random.default_rng(0).standard_t(nu, 2000)
    found, scale = _distribution(x**2, np.ones(2000), 1.0)
    assert found == nu
    assert scale == pytest.approx(t.fit(x, fdf=nu, floc=0.0)[2], rel=4e-3)


def test_normal_errors_have_no_tails() -> None:
    rng = np.random.default_rng(0)
    nu, scale = _distribution(0.04 * rng.chisquare(5, 1000), np.full(1000, 5.0), 1.0)
    # A t distribution of 30 degrees is wider by sqrt(30 / 28); the standard error of 5000 residuals is 1 %.
    assert nu == 30.0 and scale * np.sqrt(30 / 28) == pytest.approx(0.2, rel=0.03)


def test_gradient_and_hessian_against_finite_differences() -> None:
    """With noise of 3e-3 px and a scale of 0.05: the Sampson errors' own curvature is then 1e-4 of the Hessian."""
    packed, theta = problem(noise=3e-3)
    count = len(packed.pairs) + len(packed.tracks)
    trust = np.random.default_rng(0).uniform(0.2, 1.0, count)
    tailed = HeavyTailed(**vars(packed), nu=3.0, scale=0.05, trust=trust)
    unit = 1e-6
    above = [tailed.normal_equations(theta + unit * e) for e in np.eye(6)]
    below = [tailed.normal_equations(theta - unit * e) for e in np.eye(6)]
    _, gradient, H = tailed.normal_equations(theta)
    slope = np.array([(a[0] - b[0]) / (2 * unit) for a, b in zip(above, below, strict=True)])
    np.testing.assert_allclose(gradient, slope, rtol=1e-3, atol=1e-3 * np.abs(gradient).max())
    curvature = np.array([(a[1] - b[1]) / (2 * unit) for a, b in zip(above, below, strict=True)])
    np.testing.assert_allclose(H, curvature, atol=0.01 * np.abs(H).max())


def normalised(found: MotionEstimate) -> float:
    assert found.covariance is not None
    error = np.concatenate([found.w - MOTION.w, found.d - MOTION.d])
    return float(error @ np.linalg.solve(found.covariance, error))


def with_errors(kind: str, seed: int) -> Correspondences:
    rng, tracks = np.random.default_rng([2, seed]), exact(0, 300, seed).correspondences.tracks
    if kind == "heavy":
        return Correspondences(tracks=heavy(tracks, 0.2, 3.0, rng))
    noise = 0.3 * rng.standard_normal((len(tracks), 4))  # both cameras see a point wrongly alike
    return Correspondences(tracks=tracks + noise[:, [0, 1, 0, 1, 2, 3, 2, 3]])


@pytest.mark.parametrize("kind", ["heavy", "shared"])
def test_covariance_holds_whatever_the_errors(kind: str) -> None:
    """40 trials: the 99.9 % band of the mean of chi-squared, and a tenth more as the covariance is estimated.

    Least squares takes the errors of two cameras, which one track shares, for independent, and misses the band.
    """
    squares, plain = list[float](), list[float]()
    for seed in range(40):
        c = with_errors(kind, seed)
        found = RefinedSolver().weigh(TRUTH, c, RIG, SHUTTER, 0.3)
        assert found is not None and found.success
        squares.append(normalised(found))
        if kind == "shared":
            plain.append(normalised(RefinedSolver().improve(TRUTH, c, RIG, SHUTTER)))
    low, high = np.asarray(chi2.ppf([0.0005, 0.9995], 6 * len(squares))) / len(squares)
    assert low / 1.1 < np.mean(squares) < 1.1 * high
    assert kind == "heavy" or np.mean(plain) > high


@pytest.fixture(scope="module")
def bent() -> tuple[Correspondences, Packed, FloatArray]:
    """Far tracks, a wrong pair of great parallax, and where least squares ends: the pair's residual vanishes.

    Far points fix the direction of d weakly, and the pair, 8 px off, counts for hundreds of them.
    """
    rng, c = np.random.default_rng(0), exact(0, 300, depth=(60.0, 100.0)).correspondences
    near = exact(1, 0, seed=3, depth=(3.0, 3.0)).correspondences.left + np.array([0.0, 0.0, 0.0, 8.0])
    tracks = c.tracks + 0.2 * rng.standard_normal(c.tracks.shape)
    matches = Correspondences(tracks=tracks, left=near)
    packed = pack(matches, RIG, SHUTTER)
    start = packed.theta(MOTION.w, MOTION.d)
    return matches, packed, levenberg_marquardt(packed.normal_equations, start, 60, 50.0).theta


def test_a_wrong_pair_of_great_leverage_does_not_bend_the_motion(
    bent: tuple[Correspondences, Packed, FloatArray],
) -> None:
    matches, packed, theta = bent
    assert np.abs(packed.pair_residuals(theta)[0]) < 0.5  # an inlier, among 300
    w, d = packed.motion(theta)
    start = MotionEstimate(w=w, d=d, success=True)
    assert normalised(RefinedSolver().improve(start, matches, RIG, SHUTTER)) > 100.0
    found = RefinedSolver().weigh(start, matches, RIG, SHUTTER, 0.2)
    assert found is not None and found.covariance is not None
    error = np.concatenate([found.w - MOTION.w, found.d - MOTION.d])
    assert np.all(np.abs(error) < 4.0 * np.sqrt(np.diag(found.covariance)))


def test_leverages_are_bounded(bent: tuple[Correspondences, Packed, FloatArray]) -> None:
    _, packed, theta = bent

    def share_of_the_pair(tailed: HeavyTailed) -> float:
        each = each_term(tailed, theta)
        H = np.einsum("n,nij->nij", tailed.weights(each.squares), each.hessians)
        return float(np.trace(np.linalg.solve(np.sum(H, axis=0), H[0])))

    tailed = heavy_tailed(packed, theta, 0.2)
    assert tailed is not None
    assert share_of_the_pair(replace(tailed, trust=np.ones(len(tailed.trust)))) > 0.7
    # The other leverages move as its weight falls: to a tenth.
    assert share_of_the_pair(tailed) == pytest.approx(0.2, rel=0.1)


def test_few_measurements_are_left_to_least_squares() -> None:
    c = exact(0, 29).correspondences
    assert RefinedSolver().weigh(TRUTH, c, RIG, SHUTTER, 0.3) is None
