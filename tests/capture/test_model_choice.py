"""The motion model that matches prefer: recognised, or said to be open; held to integrals and to differences."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rsbench.capture.model_choice import MODELS, choose_model, preferred, settle_model
from rsbench.capture.model_fit import CANDIDATES, Candidate, Errors, dispersion, fit_model
from scipy.special import logsumexp

from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.capture import model_fit
from rsbench.components.motion_models import make_motion
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import AcceleratedMotion, LinearMotion, Motion
from rsbench.core.rig import VIEWS, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.core.spline_motion import SplineMotion, blending
from rsbench.dataset.corrected_frames import motion_record
from rsbench.dataset.sequence import read_dataset
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.frame_motion import find_motion, match_frames
from rsbench.solvers.engine.registry import load_solver_entry
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
SHUTTER = RollingShutter(height=900, readout_ratio=0.8)
W, D = np.array([0.02, -0.025, 0.015]), np.array([0.2, 0.1, -0.2])
OWN: dict[str, dict[str, Any]] = {
    "accelerated": {"acceleration": 0.1},
    "spline": {"preset": "driving", "seed": 3},
}


def matches(motion: Motion, seed: int = 0, **options: Any) -> Correspondences:
    usual: dict[str, Any] = {"tracks": 60, "noise_px": 0.3}
    wanted = SimulationOptions(**usual | options)
    return simulate(RIG, SHUTTER, motion, wanted, np.random.default_rng(seed)).correspondences


def named(name: str) -> Candidate:
    return next(each for each in CANDIDATES if name in (each.name, each.label))


@pytest.mark.parametrize("name", MODELS)
def test_each_model_is_recognised_and_gives_the_right_d(name: str) -> None:
    """Among outliers. The paper's model is wrong by several standard deviations there."""
    truth = make_motion(name, W, D, OWN.get(name, {}))
    given = matches(truth, tracks=150, outlier_ratio=0.2)
    entry, rng = load_solver_entry("rs-stereo-refined"), np.random.default_rng(0)
    as_linear = estimate_motion(given, RIG, SHUTTER, entry.solver, RobustOptions(), rng)
    robust, choice = settle_model("auto", as_linear, entry, given, RIG, SHUTTER, RobustOptions(), rng)
    assert choice is not None and choice.used == name
    # Data of the paper's model fit a slight acceleration by chance; one time in ten that stays possible.
    assert choice.decided or name == "linear"
    assert sum(choice.probability.values()) == pytest.approx(1.0)
    found, known = robust.estimate, robust.estimate.covariance
    assert known is not None
    error = np.concatenate([found.w - W, found.d - D])
    # Chi-squared with 6 degrees of freedom: beyond 22.5 in one of a thousand.
    assert error @ np.linalg.solve(known, error) < 22.5
    np.testing.assert_array_equal(choice.motion.d, found.d) if name != "linear" else None
    if name != "linear":
        assert np.linalg.norm(as_linear.estimate.d - D) > 3 * np.sqrt(np.trace(known[3:, 3:]))


def test_what_matches_cannot_tell_is_said_and_the_papers_model_used() -> None:
    """0.06 deg and 6 mm at 1 px: no model's rows differ by a tenth of the noise."""
    truth = make_motion("twist", 0.03 * W, 0.02 * D)
    choice = choose_model(matches(truth, noise_px=1.0), RIG, SHUTTER, LinearMotion(truth.w, truth.d))
    assert choice.used == "linear" and not choice.decided
    assert 0.15 < choice.probability["linear"] < 0.6
    assert choice.acceleration_sigma > 0.1
    text = str(choice)
    assert text.startswith("cannot tell, so linear is used (") and "do not determine an acceleration" in text


def test_the_papers_model_is_not_used_where_it_is_excluded() -> None:
    assert preferred({"twist": 0.6, "spline": 0.38, "linear": 0.01, "accelerated": 0.01}) == "twist"
    assert preferred({"twist": 0.9, "linear": 0.07, "spline": 0.02, "accelerated": 0.01}) == "linear"
    assert preferred({"twist": 0.96, "linear": 0.04}) == "twist"


def test_the_evidence_is_the_integral_over_the_models_own_parameter() -> None:
    """Against a sum over k, each with a motion of its own: what is approximated in 7 dimensions is in 6 there."""
    truth = AcceleratedMotion(0.2 * W, 0.2 * D, 0.1)
    given = matches(truth, noise_px=1.0)
    errors, start = Errors(given, RIG, SHUTTER, truth), np.concatenate([truth.w, truth.d])
    scale = fit_model(errors, named("linear"), start).scale_px
    whole = fit_model(errors, named("accelerated"), np.append(start, 0.0), scale)
    sigma = named("accelerated").sigma[0]
    grid = np.linspace(-0.45, 0.95, 57)

    def given_k(k: float) -> Candidate:
        return Candidate(name="fixed", sigma=np.zeros(0), make=lambda phi: AcceleratedMotion(phi[:3], phi[3:], k))

    each = [fit_model(errors, given_k(float(k)), start, scale).log_evidence(1.0) for k in grid]
    prior = -0.5 * (grid / sigma) ** 2 - np.log(np.sqrt(2 * np.pi) * sigma)
    summed = logsumexp(np.array(each) + prior) + np.log(grid[1] - grid[0])
    assert whole.log_evidence(1.0) == pytest.approx(summed, abs=0.1)
    k_sigma = np.sqrt(whole.covariance(1.0)[6, 6])
    assert 0.02 < k_sigma < 0.15 and abs(whole.phi[6] - 0.1) < 4 * k_sigma


@pytest.mark.parametrize("preset", ["driving", "handheld"])
def test_derivatives_by_w_d_and_the_shake_are_those_of_differences(preset: str) -> None:
    truth = SplineMotion(W, D, preset=preset, seed=3)
    errors = Errors(matches(truth, tracks=20, pairs=10), RIG, SHUTTER, truth)
    candidate, phi = named(preset), np.concatenate([W, D, truth.shake.ravel()])
    J = model_fit._jacobian(errors, candidate, phi, errors(truth))
    chosen = [*range(6), *range(6, len(phi), 5)]
    unit = np.concatenate([np.full(6, 1e-3), candidate.sigma])
    for k in chosen:
        step = 1e-3 * unit[k] * (np.arange(len(phi)) == k)
        slope = (errors(candidate.make(phi + step)) - errors(candidate.make(phi - step))) / 2e-3
        # To first order in the turn within an interval, 0.2 deg to 1 deg here: a few per cent of the largest.
        np.testing.assert_allclose(unit[k] * J[:, k], slope, atol=0.02 * np.max(np.abs(unit * J)))


def test_shares_of_control_poses_are_those_of_the_spline() -> None:
    """A path along one axis is a B-spline of numbers: the position is the sum of the shares times the poses."""
    rng, interval = np.random.default_rng(2), 0.4
    steps = np.zeros((8, 6))
    steps[:, 3] = rng.standard_normal(8)
    tau = np.array([0.0, 0.13, 0.4, 0.9, 1.0, 1.77, 2.0])
    shares = blending(tau, interval, 8)
    np.testing.assert_allclose(shares.sum(axis=1), 1.0, atol=1e-14)
    at, x = shares @ steps[:, 3], blending(np.zeros(1), interval, 8) @ steps[:, 3]
    w, d = SplineMotion.endpoint({"interval": interval, "poses": steps.tolist()}) or (np.zeros(3), np.zeros(3))
    path = SplineMotion(w, d, interval=interval, poses=steps)
    np.testing.assert_allclose(path.body_from_world(tau).t[:, 0], at - x, atol=1e-12)


def test_matches_that_err_together_count_once() -> None:
    """Every track four times: four times the scores' variance, and the same evidence for and against."""
    truth = make_motion("twist", W, D)
    once = matches(truth, tracks=150)
    again = replace(once, tracks=np.repeat(once.tracks, 4, axis=0))
    start, gaps, spreads = np.concatenate([W, D]), list[float](), list[float]()
    for given in (once, again):
        errors = Errors(given, RIG, SHUTTER, truth)
        linear, twist = (fit_model(errors, named(name), start, 0.3) for name in ("linear", "twist"))
        spreads.append(dispersion(twist, 900 / 8))
        gaps.append(linear.log_evidence(spreads[-1]) - twist.log_evidence(spreads[-1]))
    # Independent normal errors: 0.93, up to the chance of what falls into one of 64 cells (sigma about 0.1).
    assert 0.8 < spreads[0] < 1.3
    # By chance the scores of a cell may vary less than alone, which is not counted: hence the tolerance.
    assert spreads[1] == pytest.approx(4 * spreads[0], rel=0.25)
    assert gaps[1] == pytest.approx(gaps[0], rel=0.25)


def test_rendered_frames_do_not_exclude_the_model_that_made_them(smoke_dataset: Path) -> None:
    """128 x 96 pixels: a few dozen matches with the errors of SIFT. One sequence is linear, one a twist."""
    for sequence in read_dataset(smoke_dataset):
        options = CorrectionOptions(motion_model="auto")
        given = match_frames({view: sequence.image("rs", *view) for view in VIEWS}, sequence.rig, options)
        found = find_motion(given, sequence.rig, sequence.shutter, options)
        assert found.choice is not None and found.motion.name == found.choice.used
        assert found.choice.probability[sequence.motion.name] > 0.05
        record = motion_record(found)
        assert record["model"] == found.choice.used and record["model_choice"]["text"] == str(found.choice)
        rebuilt = make_motion(record["model"], record["w"], record["d"], record["parameters"])
        tau = np.linspace(0.0, 1.8, 5)
        for ours, theirs in zip(found.motion.body_from_world(tau), rebuilt.body_from_world(tau), strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-9)


def test_outliers_do_not_move_the_fit() -> None:
    truth = make_motion("twist", W, D)
    given, spoilt = (matches(truth, tracks=100, outlier_ratio=share) for share in (0.0, 0.3))
    found: list[FloatArray] = []
    for each in (given, spoilt):
        fit = fit_model(Errors(each, RIG, SHUTTER, truth), named("twist"), np.concatenate([W, D]))
        found.append(fit.phi)
        sigma = np.sqrt(np.diagonal(fit.covariance(1.0)))
    assert np.all(np.abs(found[0] - found[1]) < 3 * sigma)


def test_wrong_requests_are_one_line() -> None:
    given = matches(LinearMotion(W, D))
    for name, solver, words in (
        ("twsit", "rs-stereo-refined", "did you mean 'twist'"),
        ("auto", "gs-8pt", "take rs-stereo-refined"),
        ("auto", "gs-stereo-tracks", "global shutter"),
    ):
        entry = load_solver_entry(solver)
        robust = estimate_motion(
            given, RIG, SHUTTER, entry.solver, RobustOptions(), np.random.default_rng(0), entry.options.robust
        )
        with pytest.raises(RsbenchError, match=words):
            settle_model(name, robust, entry, given, RIG, SHUTTER, RobustOptions(), np.random.default_rng(0))
