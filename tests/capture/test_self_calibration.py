"""Focal lengths and k1 estimated with the motion. Truth: finite differences, points projected exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.capture.calibration import FOCAL, LENS, NO_ERRORS, RADIAL, CardSigma, ray_shifts
from rsbench.capture.hypotheses import (
    CALIBRATION,
    CaptureCost,
    Hypothesis,
    Known,
    KnownInputs,
    Likelihood,
    Scans,
    TimedMatches,
)
from rsbench.capture.self_calibration import (
    PRIOR,
    PairFocal,
    _corrected,
    conclude_focal,
    find_camera,
    focal_of_pair,
)
from rsbench.components.motion_models import InertialMotion, make_motion
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.solvers.engine.robust_motion import RobustOptions

CAMERA = PinholeCamera.centred(640, 480, 520.0)
BARREL = Lens(model="brown-conrady", k1=-0.2)
AT_TOP = KnownInputs(readout_ratio=0.8, scanning=Scanning())
TURN = np.deg2rad([1.0, 2.0, 0.5])


def matches_of(
    camera: PinholeCamera, w: np.ndarray = TURN, seed: int = 0, depths: tuple[float, float] = (2.0, 10.0)
) -> tuple[Correspondences, StereoRig]:
    rig = StereoRig(camera=camera, baseline=0.2)
    shutter = RollingShutter(height=camera.height, readout_ratio=0.8)
    motion = make_motion("twist", w, np.array([0.05, 0.02, 0.1]), {})
    options = SimulationOptions(noise_px=0.2, pairs=200, tracks=200, depth=depths)
    made = simulate(rig, shutter, motion, options, np.random.default_rng(seed))
    return made.correspondences, rig


def with_card(rig: StereoRig, factor: float, k1_too_large: float = 0.0) -> StereoRig:
    camera = rig.camera
    lens = replace(camera.lens, k1=camera.lens.k1 + k1_too_large) if camera.lens else None
    return replace(rig, camera=replace(camera, fx=factor * camera.fx, fy=factor * camera.fy, lens=lens))


FISHEYE = Lens(model="kannala-brandt", k1=-0.05)


def test_k1_of_a_lens_without_one_is_refused() -> None:
    lens = Lens(model="double-sphere", xi=-0.2, alpha=0.6)
    rig = StereoRig(camera=replace(CAMERA, lens=lens), baseline=0.3)
    with pytest.raises(RsbenchError, match=r"k1_sigma = 0\.02: a double-sphere lens has no k1"):
        find_camera([], rig, CardSigma(k1=0.02))


@pytest.mark.parametrize("lens", [None, BARREL, FISHEYE])
def test_rays_shift_as_those_of_another_camera_do(lens: Lens | None) -> None:
    """Central differences of ``unproject``, which knows nothing of this; their own error is of h squared."""
    camera = replace(CAMERA, lens=lens)
    pixels = np.random.default_rng(0).uniform([20.0, 20.0], [620.0, 460.0], (50, 2))
    rays, h = camera.unproject(pixels)[:, :2], 1e-5
    shifts = ray_shifts(rays, "left", camera.fx, lens)
    ends = [
        replace(camera, fx=camera.fx / (1.0 - e), fy=camera.fy / (1.0 - e)).unproject(pixels)[:, :2]
        for e in (h, -h)
    ]
    np.testing.assert_allclose(shifts[:, FOCAL], (ends[1] - ends[0]) / (2.0 * h), atol=1e-7)
    base = lens or Lens(model="brown-conrady")
    ends = [replace(camera, lens=replace(base, k1=base.k1 + e)).unproject(pixels)[:, :2] for e in (h, -h)]
    np.testing.assert_allclose(shifts[:, LENS.start], (ends[1] - ends[0]) / (2.0 * h), atol=1e-7)


@pytest.mark.parametrize("term", [FOCAL, RADIAL])
@pytest.mark.parametrize("lens", [None, BARREL])
def test_the_gradient_counts_what_it_does_to_the_size_of_errors(term: int, lens: Lens | None) -> None:
    matches, rig = matches_of(replace(CAMERA, lens=lens))
    timed = TimedMatches(matches, rig, "twist")
    hypothesis = Hypothesis(scans=Scans("top", "top"), motion_model="twist")
    sigma = list(NO_ERRORS)
    sigma[term] = 0.1
    known = Known(calibration_sigma=tuple(sigma))
    likelihood = Likelihood(nu=4.0, scale=0.3, chosen=np.ones(timed.count, dtype=np.bool_))
    cost = CaptureCost(timed, hypothesis, likelihood, known.prior(hypothesis))
    unknowns = known.start(hypothesis, 0.8, 0.0)
    at, h = CALIBRATION.start + term, 1e-6
    unknowns[at] = 0.02
    theta = timed.kernel(unknowns).theta(TURN, np.array([0.05, 0.02, 0.1]))
    ends = []
    for step in (h, -h):
        moved = unknowns.copy()
        moved[at] += step
        ends.append(cost(theta, moved))
    gradient = cost.local(theta, unknowns, cost.free)[1][6 + cost.free.index(at)]
    assert gradient == pytest.approx((ends[0] - ends[1]) / (2.0 * h), rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lens", "factor", "k1_too_large"),
    [(None, 1.05, 0.0), (None, 0.93, 0.0), (BARREL, 1.05, 0.03), (FISHEYE, 1.0, -0.02)],
)
def test_a_card_that_errs_is_put_right(lens: Lens | None, factor: float, k1_too_large: float) -> None:
    matches, rig = matches_of(replace(CAMERA, lens=lens))
    sigma = CardSigma(focal=52.0, k1=0.05 if lens else 0.0)
    given = with_card(rig, factor, k1_too_large)
    known = None if lens is None else AT_TOP  # behind a lens it takes several rounds
    found = find_camera([matches], given, sigma, known)
    assert found.determined == (True, lens is not None) and "card" in found.words(given, sigma)
    assert abs(found.rig.camera.fx - CAMERA.fx) < min(4.0 * found.sigma.focal, 0.01 * CAMERA.fx)
    assert found.rig.camera.fy / found.rig.camera.fx == pytest.approx(1.0)
    if lens is not None and found.rig.camera.lens is not None:
        assert abs(found.rig.camera.lens.k1 - lens.k1) < min(4.0 * found.sigma.k1, 0.01)


@pytest.mark.slow
def test_what_is_left_of_a_lens_is_found_as_one() -> None:
    """Of a distant scene, whose row differences say nothing of it."""
    true = replace(CAMERA, lens=Lens(model="brown-conrady", k1=0.02))
    matches, rig = matches_of(true, depths=(30.0, 100.0))
    given = replace(rig, camera=CAMERA)
    found = find_camera([matches], given, CardSigma(k1=0.05), AT_TOP)
    assert found.determined == (False, True) and found.rig.camera.lens is not None
    assert abs(found.rig.camera.lens.k1 - 0.02) < min(4.0 * found.sigma.k1, 0.01)
    assert found.rig.camera.fx == CAMERA.fx


@pytest.mark.slow
def test_deviations_are_those_of_the_errors() -> None:
    """Chi-squared with 3 degrees of freedom: 0.024 and 16.3 hold it in 998 of 1000."""
    ratios = []
    for seed in range(3):
        matches, rig = matches_of(replace(CAMERA, lens=BARREL), seed=seed)
        given = with_card(rig, 1.04, 0.02)
        found = find_camera([matches], given, CardSigma(focal=52.0, k1=0.05), AT_TOP)
        assert found.determined == (True, True) and found.rig.camera.lens is not None
        errors = (found.rig.camera.fx - CAMERA.fx, found.rig.camera.lens.k1 - BARREL.k1)
        ratios.append(np.divide(errors, (found.sigma.focal, found.sigma.k1)))
    sums = np.sum(np.square(ratios), axis=0)
    assert np.all((sums > 0.024) & (sums < 16.3)), sums


def test_a_rig_that_does_not_turn_keeps_its_card() -> None:
    matches, rig = matches_of(CAMERA, w=np.deg2rad([0.0, 0.1, 0.0]))
    wrong, sigma = with_card(rig, 1.05), CardSigma(focal=52.0, k1=0.02)
    found = find_camera([matches], wrong, sigma, AT_TOP)
    assert found.determined == (False, False) and found.rig == wrong and found.sigma == sigma
    assert found.words(wrong, sigma).count("do not determine it") == 2


def test_a_lens_that_would_fold_is_not_taken() -> None:
    """k1 = -0.9 folds at a radius of 0.61; the corner is at 0.77."""
    _, rig = matches_of(CAMERA)
    assert _corrected(rig, np.array([0.0, -0.9])) is None
    assert _corrected(rig, np.array([0.0, -0.1])) is not None


def test_where_rows_differ_k1_is_one_of_the_errors() -> None:
    """Row differences of half a pixel and more, of a scene at 2 to 10 m and a lens that nobody undistorted."""
    matches, rig = matches_of(replace(CAMERA, lens=Lens(model="brown-conrady", k1=0.05)))
    given, sigma = replace(rig, camera=CAMERA), CardSigma(k1=0.05)
    found = find_camera([matches], given, sigma, AT_TOP)
    assert found.determined == (False, False) and found.rig == given
    assert "with the calibration errors" in found.words(given, sigma)


WIDTH, HEIGHT = 640, 480
SHUTTER = RollingShutter(height=HEIGHT, readout_ratio=0.7)


def _pair(focal: float, w: list[float], d: list[float], seed: int) -> PairFocal:
    rig = StereoRig(camera=PinholeCamera.centred(WIDTH, HEIGHT, focal), baseline=0.4)
    motion, options = InertialMotion(w=np.radians(w), d=d), SimulationOptions(pairs=300, noise_px=0.1)
    matches = simulate(rig, SHUTTER, motion, options, np.random.default_rng(seed)).correspondences.left
    found = focal_of_pair(matches, (WIDTH, HEIGHT), SHUTTER, RobustOptions())
    assert found is not None
    return found


@pytest.mark.parametrize("focal", [300.0, 1100.0])
def test_a_camera_that_turns_shows_its_focal_length(focal: float) -> None:
    found = _pair(focal, [3.0, -2.0, 1.0], [0.1, -0.2, 0.1], 0)
    # Exact but for 0.1 px of noise: 5 of its deviations, and less than a quarter of what two frames are trusted.
    assert abs(found.log - np.log(focal / WIDTH)) < min(5.0 * found.sigma, 0.06)
    result = conclude_focal(3 * [found], WIDTH)
    assert result.determined and abs(result.focal - focal) < 2.0 * result.sigma


def test_a_camera_that_goes_straight_on_does_not() -> None:
    found = conclude_focal([_pair(400.0, [0.0, 0.0, 0.0], [0.2, 0.1, 0.2], 1)], WIDTH)
    assert not found.determined and found.focal == WIDTH and found.sigma == PRIOR * WIDTH


def test_more_pairs_tell_more_and_the_more_they_scatter_the_less() -> None:
    def sigma(*logs: float) -> float:
        found = conclude_focal([PairFocal(log, 0.01, 0.1) for log in logs], WIDTH)
        return found.sigma / found.focal

    assert sigma(-0.2, -0.2, -0.2, -0.2) < sigma(-0.2, -0.2) < sigma(-0.2)
    assert sigma(-0.2, -0.2, -0.2, -0.2) < sigma(-0.6, 0.2, -0.6, 0.2)


def test_pairs_that_show_no_lens_that_is_made_are_not_averaged() -> None:
    broken, good = PairFocal(1.5, 0.01, 0.1), PairFocal(-0.2, 0.01, 0.1)
    assert not conclude_focal([broken, broken, good, good], WIDTH).determined
    assert conclude_focal([broken, good, good, good], WIDTH).pairs == 3
    still = PairFocal(-0.2, 0.01, np.deg2rad(0.3))
    assert not conclude_focal([None, still], WIDTH).determined
    assert not conclude_focal([good, still, still], WIDTH).determined
