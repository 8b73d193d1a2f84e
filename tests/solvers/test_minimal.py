"""Compiled batches of minimal samples against the general descent and NumPy's solver."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, random_motion, simulate
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.solvers.engine.levenberg_marquardt import levenberg_marquardt
from rsbench.solvers.engine.packed import damped_step, pack, solve_triples

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
SHUTTER = RollingShutter(height=900, readout_ratio=0.8)


def trial(model: str, noise_px: float) -> Simulation:
    rng = np.random.default_rng(3)
    motion = random_motion(rng, np.radians(2.0), 0.3, model)
    return simulate(RIG, SHUTTER, motion, SimulationOptions(tracks=60, noise_px=noise_px), rng)


@settings(max_examples=50)
@given(seed=st.integers(0, 10**6), damping=st.sampled_from([0.0, 1e-4, 1.0]))
def test_step_solves_the_damped_normal_equations(seed: int, damping: float) -> None:
    rng = np.random.default_rng(seed)
    J, gradient, step = rng.standard_normal((9, 6)), rng.standard_normal(6), np.zeros(6)
    H = J.T @ J
    assert damped_step(H, gradient, damping, step)
    expected = -np.linalg.solve(H + damping * np.diag(np.diag(H)), gradient)
    # Rounding grows with the condition of H.
    np.testing.assert_allclose(step, expected, rtol=1e-13 * np.linalg.cond(H), atol=1e-12)


def test_no_step_from_a_singular_matrix() -> None:
    column = np.arange(1.0, 7.0)
    for H in (np.zeros((6, 6)), np.outer(column, column), np.full((6, 6), np.nan)):
        assert not damped_step(H, np.ones(6), 0.0, np.zeros(6))


@pytest.mark.parametrize("model", ["linear", "twist", "inertial", "accelerated"])
def test_exact_samples_give_the_motion(model: str) -> None:
    s = trial(model, 0.0)
    packed = pack(s.correspondences, RIG, SHUTTER, model)
    samples = np.arange(60).reshape(20, 3)
    thetas = solve_triples(packed, samples, iterations=20)
    truth = packed.theta(s.motion.w, s.motion.d)
    # Three points in almost one direction leave a motion weakly determined: a few samples may not arrive.
    assert np.median(np.abs(thetas - truth)) < 1e-9
    assert np.mean(np.max(np.abs(thetas - truth), axis=1) < 1e-6) >= 0.9


def test_a_sample_ends_where_the_general_descent_does() -> None:
    s = trial("linear", 0.3)
    packed = pack(s.correspondences, RIG, SHUTTER)
    samples = np.arange(60).reshape(20, 3)
    thetas = solve_triples(packed, samples, iterations=60)
    for theta, sample in zip(thetas, samples, strict=True):
        alone = pack(Correspondences(tracks=s.correspondences.tracks[sample]), RIG, SHUTTER)
        minimum = levenberg_marquardt(alone.normal_equations, np.zeros(6), 60, 50.0)
        cost, _, _ = alone.normal_equations(theta)
        assert cost == pytest.approx(minimum.cost, rel=1e-6, abs=1e-9)
