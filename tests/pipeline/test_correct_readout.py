"""The readout ratio from matches: recovered, with an honest uncertainty, and told from its reverse."""

from __future__ import annotations

import numpy as np
import pytest
from rsbench.capture.readout import (
    ReadoutEstimate,
    combined,
    estimate_readout_ratio,
    fits_far_better,
    runs_backwards,
    select,
    truncated_losses,
)
from rsbench.capture.readout_profile import reversed_in_time

from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, random_motion, simulate
from rsbench.capture.rectification import without_offset
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.5)
SOLVER, ROBUST = RefinedSolver(), RobustOptions()


def _simulated(seed: int, ratio: float, degrees: float, tracks: int, noise: float = 0.3) -> Simulation:
    rng = np.random.default_rng(seed)
    shutter = RollingShutter(height=900, readout_ratio=ratio)
    motion = random_motion(rng, np.deg2rad(degrees), 0.3)
    options = SimulationOptions(pairs=tracks // 4, tracks=tracks, noise_px=noise, outlier_ratio=0.2)
    return simulate(RIG, shutter, motion, options, np.random.default_rng(seed))


@pytest.mark.parametrize(("seed", "ratio", "degrees"), [(0, 0.35, 1.0), (3, 0.97, 6.0)])
def test_the_ratio_is_recovered_within_a_fiftieth(seed: int, ratio: float, degrees: float) -> None:
    """|w| >= 1 deg, noise 0.3 px, a fifth outliers; 6000 tracks give 0.010, known to a sixth from 24 tiles."""
    data = _simulated(seed, ratio, degrees, 6000)
    found = estimate_readout_ratio(data.correspondences, RIG, SOLVER, ROBUST)
    assert found is not None
    assert found.sigma < 0.013
    assert abs(found.readout_ratio - ratio) < 0.02


def test_the_uncertainty_is_honest() -> None:
    """Errors over their standard deviations have a root mean square of 1: here of 12 draws, 1 +- 3 / sqrt(24)."""
    scores = []
    for seed in range(12):
        ratio = float(np.random.default_rng(seed).uniform(0.2, 0.8))
        found = estimate_readout_ratio(_simulated(seed, ratio, 2.0, 400).correspondences, RIG, SOLVER, ROBUST)
        assert found is not None
        scores.append((found.readout_ratio - ratio) / found.sigma)
    assert 0.38 < np.sqrt(np.mean(np.square(scores))) < 1.62


def test_exact_matches_give_the_exact_ratio() -> None:
    data = _simulated(5, 0.47, 2.0, 200, noise=0.0)
    found = estimate_readout_ratio(data.correspondences, RIG, SOLVER, ROBUST)
    assert found is not None
    # The search stops at 1e-5.
    assert abs(found.readout_ratio - 0.47) < 1e-4


def test_a_global_shutter_is_recognised() -> None:
    found = estimate_readout_ratio(_simulated(4, 0.0, 3.0, 1500).correspondences, RIG, SOLVER, ROBUST)
    assert found is not None
    assert found.readout_ratio < 0.02


def test_no_motion_leaves_the_ratio_open() -> None:
    shutter = RollingShutter(height=900, readout_ratio=0.8)
    still = random_motion(np.random.default_rng(0), 0.0, 0.0)
    options = SimulationOptions(tracks=300, noise_px=0.3)
    data = simulate(RIG, shutter, still, options, np.random.default_rng(0))
    found = estimate_readout_ratio(data.correspondences, RIG, SOLVER, ROBUST)
    assert found is None or not found.sigma < 0.25


def test_nothing_is_estimated_from_nothing() -> None:
    assert estimate_readout_ratio(Correspondences(), RIG, SOLVER, ROBUST) is None


def test_frames_in_the_wrong_order_are_noticed() -> None:
    data = _simulated(6, 0.8, 2.0, 800)
    matches = data.correspondences
    for given, backwards in ((matches, False), (reversed_in_time(matches), True)):
        forward = estimate_motion(given, RIG, data.shutter, SOLVER, ROBUST, np.random.default_rng(0))
        assert runs_backwards(given, RIG, 0.8, SOLVER, ROBUST, forward) == backwards


def test_reversing_twice_changes_nothing() -> None:
    matches = _simulated(7, 0.8, 2.0, 20).correspondences
    again = reversed_in_time(reversed_in_time(matches))
    for name in ("left", "right", "stereo_0", "stereo_1", "tracks"):
        np.testing.assert_array_equal(getattr(again, name), getattr(matches, name))


def test_the_truncated_losses_count_an_outlier_once() -> None:
    """Exact matches cost nothing; an outlier costs the threshold, squared, however far it is off."""
    data = _simulated(8, 0.8, 2.0, 100, noise=0.0)
    motion = estimate_motion(data.correspondences, RIG, data.shutter, SOLVER, ROBUST, np.random.default_rng(0))
    inliers = select(data.correspondences, motion)
    assert np.sum(truncated_losses(inliers, RIG, 0.8, SOLVER, 1.25, motion)) < 1e-9
    for shift in (30.0, 300.0):
        left = inliers.left.copy()
        left[0, 2:] += shift
        hurt = Correspondences(left=left, right=inliers.right, tracks=inliers.tracks)
        losses = truncated_losses(hurt, RIG, 0.8, SOLVER, 1.25, motion)
        np.testing.assert_allclose(np.sum(losses), 1.25**2, rtol=1e-6)


def test_outliers_of_both_orders_are_no_evidence() -> None:
    """Nine matches of ten are outliers at the limit of 1 of either; the tenth is what tells."""
    limit = np.ones(90)
    worse, better = np.concatenate([limit, np.full(10, 0.5)]), np.concatenate([limit, np.full(10, 0.1)])
    assert fits_far_better(better, worse) and not fits_far_better(worse, better)
    assert not fits_far_better(worse, worse)


def test_a_disparity_offset_is_found_with_the_ratio() -> None:
    """Rows tilted by 0.5 px allow an offset; without it the ratio of a global shutter comes out wrong."""
    data, offset = _simulated(9, 0.0, 1.0, 1500, noise=0.1), 0.7
    c = without_offset(data.correspondences, -offset)
    tracks = c.tracks.copy()
    tracks[:, [3, 7]] += 0.5 * (tracks[:, [2, 6]] / 450.0 - 1.0)
    c = Correspondences(left=c.left, right=c.right, tracks=tracks)
    fitted = estimate_readout_ratio(c, RIG, SOLVER, ROBUST)
    fixed = estimate_readout_ratio(c, RIG, SOLVER, ROBUST, disparity_offset=0.0)
    assert fitted is not None and fixed is not None
    assert abs(fitted.disparity_offset - offset) < 4.0 * fitted.offset_sigma < 0.4
    # The tilt itself is not modelled: it moves the ratio by less than a tenth.
    assert abs(fitted.signed_ratio) < 0.1
    assert fixed.disparity_offset == 0.0 and fixed.offset_sigma == 0.0


def test_reversed_frames_have_the_negative_ratio() -> None:
    """At 2 deg the models of both orders differ by |w| |d| / 8 = 1 mm at most."""
    data = _simulated(6, 0.8, 2.0, 800)
    found = estimate_readout_ratio(reversed_in_time(data.correspondences), RIG, SOLVER, ROBUST)
    assert found is not None and found.backwards and found.readout_ratio == 0.0
    assert abs(found.signed_ratio + 0.8) < 4.0 * found.sigma


def test_windows_are_combined_with_their_scatter() -> None:
    """Equal windows keep their mean; windows that differ by more than they say widen it to the scatter."""

    def window(ratio: float) -> ReadoutEstimate:
        return ReadoutEstimate(signed_ratio=ratio, covariance=np.diag([0.01**2, 0.0]), matches=10)

    same = combined([window(0.4)] * 4)
    assert same.signed_ratio == pytest.approx(0.4) and same.sigma == pytest.approx(0.005)
    apart = combined([window(0.2), window(0.6)])
    assert apart.signed_ratio == pytest.approx(0.4) and apart.sigma == pytest.approx(0.2)
    assert (apart.matches, apart.windows) == (20, 2)
