"""The shutter and motion model that a correction uses. Truth: exact projections; differences of the cost."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, random_motion, simulate
from rsbench.capture.calibration import NO_ERRORS, OFFSET, RefusedFramesError, offset_error, recalibrated
from rsbench.capture.hypotheses import (
    ACCELERATION,
    GLOBAL,
    MODELS,
    RATIO,
    UNKNOWNS,
    CaptureCost,
    Hypothesis,
    Known,
    KnownInputs,
    Likelihood,
    Scans,
    TimedMatches,
    scans_of,
)
from rsbench.capture.model_choice import AUTO, choose_model, motion_at
from rsbench.capture.shutter_decision import (
    NoMotionError,
    as_global,
    conclude_alone,
    examine_alone,
    fits_backwards,
    known_alone,
    known_of,
    runs_backwards,
    shutter_found,
)
from rsbench.capture.two_frame_estimate import Candidate, Capture, conclude, examine, nearly_global
from rsbench.components.motion_models import LinearMotion, make_motion
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.frame_capture import know_matches
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.frame_motion import solve_frames
from rsbench.solvers.engine.robust_motion import RobustOptions

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.5)
TOP = Scanning()
AT_TOP = KnownInputs(readout_ratio=0.8, scanning=TOP)
W, D = np.array([0.02, -0.025, 0.015]), np.array([0.2, 0.1, -0.2])


def simulated(seed: int, ratio: float, degrees: float, tracks: int, noise: float = 0.3) -> Simulation:
    rng = np.random.default_rng(seed)
    shutter = RollingShutter(height=900, readout_ratio=ratio)
    motion = random_motion(rng, np.deg2rad(degrees), 0.3)
    options = SimulationOptions(pairs=tracks // 4, tracks=tracks, noise_px=noise, outlier_ratio=0.2)
    return simulate(RIG, shutter, motion, options, np.random.default_rng(seed))


def found_in(matches: Correspondences, models: tuple[str, ...] = ("linear",)) -> Capture:
    """With the scan known and the ratio not."""
    return conclude([examine(matches, RIG, known_of(matches, RIG, KnownInputs(scanning=TOP, models=models)))])


def reversed_in_time(matches: Correspondences) -> Correspondences:
    """As if the two times were exchanged."""
    pair, track = [2, 3, 0, 1], [4, 5, 6, 7, 0, 1, 2, 3]
    return Correspondences(
        left=matches.left[:, pair],
        right=matches.right[:, pair],
        tracks=matches.tracks[:, track],
    )


# The equations


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("scans", [Scans("top", "top"), Scans("left", "bottom")])
def test_the_gradient_is_that_of_differences(model: str, scans: Scans) -> None:
    """By the motion and by all unknowns, through a lens. Left out is what the weights of errors change by: of the
    second order in the noise of 0.01 px."""
    lens = Lens(model="brown-conrady", k1=-0.1)
    camera = replace(PinholeCamera.centred(640, 480, 520.0), lens=lens)
    rig, shutter = StereoRig(camera=camera, baseline=0.3), _shutter_of(scans)
    truth = make_motion(model, W, D, {"acceleration": 0.15} if model == "accelerated" else {})
    options = SimulationOptions(pairs=12, tracks=12, noise_px=0.01)
    matches = simulate(rig, shutter, truth, options, np.random.default_rng(1)).correspondences
    timed = TimedMatches(matches, rig, model)
    likelihood = Likelihood(nu=4.0, scale=0.05, chosen=np.ones(timed.count, dtype=np.bool_))
    hypothesis = Hypothesis(scans=scans, motion_model=model, delayed=True)
    free = [k for k in range(UNKNOWNS) if k != ACCELERATION or model == "accelerated"]
    cost = CaptureCost(timed, hypothesis, likelihood, np.where(np.arange(UNKNOWNS) == RATIO, np.inf, 1.0))
    unknowns = np.zeros(UNKNOWNS)
    unknowns[RATIO], unknowns[ACCELERATION] = 0.7, 0.15 if model == "accelerated" else 0.0
    theta = timed.packed(scans, unknowns).theta(truth.w, truth.d)
    at = np.concatenate([theta + 2e-5, unknowns + 1e-4])
    value, gradient, H = cost.local(at[:6], at[6:], free)
    assert value == pytest.approx(cost(at[:6], at[6:]), rel=1e-9)
    steps = np.concatenate([np.full(6, 1e-6), np.full(UNKNOWNS, 1e-5)])
    for k, j in enumerate([*range(6), *(6 + each for each in free)]):
        step = steps[j] * np.eye(6 + UNKNOWNS)[j]
        above, below = (cost(*np.split(at + s * step, [6])) for s in (1.0, -1.0))
        slope = (above - below) / (2.0 * steps[j])
        assert gradient[k] == pytest.approx(slope, rel=0.03, abs=0.02 * np.sqrt(H[k, k]) * likelihood.scale)


def _shutter_of(scans: Scans) -> RollingShutter:
    assert scans.left != "global" and scans.right != "global"
    return RollingShutter(height=480, width=640, readout_ratio=0.7, scan=scans.left, right_scan=scans.right)


# The readout ratio


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "ratio", "degrees"), [(0, 0.35, 1.0), (3, 0.97, 6.0)])
def test_the_ratio_is_recovered_within_a_fiftieth(seed: int, ratio: float, degrees: float) -> None:
    """|w| >= 1 deg, noise 0.3 px, a fifth outliers; 6000 tracks give 0.010, known to a sixth from 24 tiles."""
    shutter = shutter_found(found_in(simulated(seed, ratio, degrees, 6000).correspondences), RIG)
    assert abs(shutter.readout_ratio - ratio) < 0.02


@pytest.mark.slow
def test_the_uncertainty_is_honest() -> None:
    """Errors over their standard deviations have a root mean square of 1: here of 12 draws, 1 +- 3 / sqrt(24)."""
    scores = []
    for seed in range(12):
        ratio = float(np.random.default_rng(seed).uniform(0.3, 0.8))
        best = found_in(simulated(seed, ratio, 2.0, 400).correspondences).likeliest
        assert best is not None
        scores.append((best.ratio - ratio) / best.sigma)
    assert 0.38 < np.sqrt(np.mean(np.square(scores))) < 1.62


def test_a_global_shutter_is_recognised() -> None:
    capture = found_in(simulated(4, 0.0, 3.0, 800).correspondences)
    assert shutter_found(capture, RIG).readout_ratio == 0.0


def test_no_motion_leaves_the_ratio_open_in_words() -> None:
    shutter = RollingShutter(height=900, readout_ratio=0.8)
    still = random_motion(np.random.default_rng(0), 0.0, 0.0)
    data = simulate(RIG, shutter, still, SimulationOptions(tracks=300, noise_px=0.3), np.random.default_rng(0))
    capture = found_in(data.correspondences)
    if capture.likeliest is None or capture.likeliest.sigma * capture.moved_px > 1.0:
        with pytest.raises(NoMotionError, match="readout_ratio"):
            shutter_found(capture, RIG)
    with pytest.raises(NoMotionError, match="0 matches"):
        shutter_found(found_in(Correspondences()), RIG)


@pytest.mark.slow
def test_frames_in_the_wrong_order_are_noticed() -> None:
    """Their lines seem to be read from the opposite side; the frames are refused where the side is given."""
    data = simulated(6, 0.8, 2.0, 800)
    turned = reversed_in_time(data.correspondences)
    for given, backwards in ((data.correspondences, False), (turned, True)):
        assert runs_backwards(found_in(given, MODELS), scans_of(data.shutter)) == backwards
    for ratio in (None, 0.8):
        with pytest.raises(RefusedFramesError, match="backwards"):
            options = CorrectionOptions(motion_model=AUTO)
            inputs = KnownInputs(readout_ratio=ratio, scanning=TOP)
            solve_frames(know_matches(turned, RIG, inputs, options), options)


def test_a_disparity_offset_is_found_with_the_ratio() -> None:
    """Rows tilted by 0.5 px allow an offset; without it the ratio of a global shutter comes out wrong."""
    data, offset = simulated(9, 0.0, 1.0, 1500, noise=0.1), 0.7
    c = recalibrated(data.correspondences, RIG, offset_error(-offset))
    tracks = c.tracks.copy()
    tracks[:, [3, 7]] += 0.5 * (tracks[:, [2, 6]] / 450.0 - 1.0)
    c = Correspondences(left=c.left, right=c.right, tracks=tracks)
    known = known_of(c, RIG, KnownInputs(scanning=TOP, models=("linear",)))
    assert known.calibration_sigma[OFFSET] > 0.1
    assert (
        known_of(c, RIG, KnownInputs(scanning=TOP, calibration=offset_error(0.0))).calibration_sigma == NO_ERRORS
    )
    capture = conclude([examine(c, RIG, known)])
    assert abs(capture.offset - offset) < 4.0 * capture.offset_sigma < 0.6


# Motion models


def test_a_global_shutter_leaves_nothing_to_choose() -> None:
    data = simulated(9, 0.0, 1.0, 600, noise=0.1)
    given = KnownInputs(readout_ratio=0.0, scanning=TOP, calibration=NO_ERRORS)
    known = known_of(data.correspondences, RIG, given)
    choice = choose_model(conclude([examine(data.correspondences, RIG, known)]))
    assert str(choice) == "linear; the others give the same motion"


def matches_of(model: str, seed: int = 0) -> Correspondences:
    truth = make_motion(model, W, D, {"acceleration": 0.1} if model == "accelerated" else {})
    shutter = RollingShutter(height=900, readout_ratio=0.8)
    options = SimulationOptions(tracks=150, noise_px=0.3, outlier_ratio=0.2)
    return simulate(RIG, shutter, truth, options, np.random.default_rng(seed)).correspondences


@pytest.mark.parametrize("model", MODELS)
def test_each_model_is_recognised_and_gives_the_right_d(model: str) -> None:
    """Among outliers; chi-squared with 6 degrees of freedom: beyond 22.5 in one of a thousand."""
    options = CorrectionOptions(motion_model=AUTO)
    solved = solve_frames(know_matches(matches_of(model), RIG, AT_TOP, options), options, in_order=True)
    assert solved.choice is not None
    choice, found = solved.choice, solved.robust.estimate
    assert choice.used == model and sum(choice.probability.values()) == pytest.approx(1.0)
    assert choice.decided or model == "linear"
    error = np.concatenate([found.w - W, found.d - D])
    assert error @ np.linalg.solve(_known(found.covariance), error) < 22.5
    if model != "linear":
        options = CorrectionOptions()
        linear = solve_frames(know_matches(matches_of(model), RIG, AT_TOP, options), options, in_order=True)
        assert np.linalg.norm(linear.motion.d - D) > 1.5 * np.sqrt(np.trace(_known(found.covariance)[3:, 3:]))


def _known(covariance: FloatArray | None) -> FloatArray:
    assert covariance is not None
    return covariance


def test_what_matches_cannot_tell_is_said_and_the_likeliest_model_used() -> None:
    """0.06 deg and 6 mm at 1 px: no model's rows differ by a tenth of the noise."""
    truth = make_motion("twist", 0.03 * W, 0.02 * D)
    shutter, options = RollingShutter(height=900, readout_ratio=0.8), SimulationOptions(tracks=60, noise_px=1.0)
    matches = simulate(RIG, shutter, truth, options, np.random.default_rng(0)).correspondences
    known = known_of(matches, RIG, AT_TOP)
    capture = conclude([examine(matches, RIG, known, start=truth)])
    choice = choose_model(capture)
    assert choice is not None and not choice.decided
    assert choice.probability[choice.used] >= 0.9 * max(choice.probability.values())
    assert str(choice).startswith(f"cannot tell, so {choice.used} is used (")
    requested = choose_model(capture, "twist")
    assert requested is not None and requested.used == "twist" and requested.rival != "twist"
    assert str(requested).startswith("twist, as requested (")
    motion = motion_at(capture.peaks["twist"])
    assert motion.name == "twist" and np.linalg.norm(motion.d - truth.d) < 0.05


def test_the_likeliest_model_is_used_and_the_others_are_in_the_deviation() -> None:
    """By hand: 0.07 and 0.03 times the squares of how far the others' motions are; none where one is requested."""
    capture = conclude([examine(matches_of("twist"), RIG, known_of(matches_of("twist"), RIG, AT_TOP))])
    capture = replace(capture, models={"twist": 0.9, "linear": 0.07, "accelerated": 0.03})
    peaks = {name: capture.peaks.get(name, next(iter(capture.peaks.values()))) for name in capture.models}
    moved = replace(peaks["linear"].fit, theta=peaks["linear"].fit.theta + 0.01)
    capture = replace(capture, peaks={**peaks, "linear": replace(peaks["linear"], fit=moved)})
    chosen, requested = choose_model(capture), choose_model(capture, "twist")
    assert chosen is not None and requested is not None and chosen.used == requested.used == "twist"
    assert not chosen.decided and chosen.rival == "linear"
    motions = {name: motion_at(peak) for name, peak in capture.peaks.items()}
    values = {name: np.concatenate([each.w, each.d]) for name, each in motions.items()}
    away = {name: value - values["twist"] for name, value in values.items()}
    expected = sum(p * np.outer(away[name], away[name]) for name, p in capture.models.items())
    np.testing.assert_allclose(chosen.spread - requested.spread, expected, atol=1e-12)
    sure = choose_model(replace(capture, models={"twist": 0.96, "linear": 0.04, "accelerated": 0.0}))
    assert sure is not None and sure.decided


def test_what_is_given_is_known() -> None:
    given = known_of(Correspondences(), RIG, KnownInputs(readout_ratio=0.8, scanning=Scanning(scan="bottom")))
    assert (given.scans, given.ratio, given.shutter_known) == ((Scans("bottom", "bottom"),), 0.8, True)
    assert known_of(Correspondences(), RIG, KnownInputs(readout_ratio=0.0, scanning=TOP)).scans == (GLOBAL,)
    nothing = known_of(Correspondences(), RIG, KnownInputs())
    assert len(nothing.scans) == 25 and nothing.delay is None and not nothing.shutter_known
    assert isinstance(nothing, Known)


def test_a_ratio_near_0_tells_no_scan() -> None:
    capture = found_in(simulated(2, 0.7, 2.0, 1000).correspondences)
    best = capture.candidates[0]
    assert shutter_found(capture, RIG).readout_ratio == best.ratio
    near = replace(best, ratio=0.25, sigma=0.09, probability=0.98)
    with pytest.raises(NoMotionError, match="cannot tell the readout ratio"):
        shutter_found(replace(capture, candidates=(near,)), RIG)


RIG_GLOBAL = StereoRig(camera=PinholeCamera.centred(64, 48, 50.0), baseline=0.1)


def candidate(scans: Scans, probability: float, ratio: float, sigma: float, offset: float = 0.0) -> Candidate:
    return Candidate(
        scans=scans,
        probability=probability,
        ratio=ratio,
        sigma=sigma,
        delay=0.0,
        delay_sigma=0.0,
        calibration=offset_error(offset),
    )


def capture_of(*candidates: Candidate) -> Capture:
    return Capture(
        candidates=candidates,
        models={"linear": 1.0},
        peaks={},
        reason="",
        named=True,
        windows=1,
        matches=100,
        used=100,
        noise_px=0.1,
        moved_px=5.0,
    )


ONE_SIDE = candidate(Scans("left", "left"), 0.7, 0.08, 0.03)
OTHER_SIDE = candidate(Scans("bottom", "bottom"), 0.3, 0.05, 0.01)


def test_small_ratios_of_any_side_are_one_global_shutter_as_wide_as_all_of_them() -> None:
    found = nearly_global(capture_of(ONE_SIDE, OTHER_SIDE))
    assert found is not None and [each.scans for each in found] == [GLOBAL]
    square = 0.7 * (0.08**2 + 0.03**2) + 0.3 * (0.05**2 + 0.01**2)
    assert found[0].sigma == pytest.approx(math.sqrt(square)) and found[0].ratio == 0.0


@pytest.mark.parametrize(
    "capture",
    [
        capture_of(),
        capture_of(candidate(GLOBAL, 1.0, 0.0, 0.0)),
        capture_of(ONE_SIDE, candidate(Scans("top", "top"), 0.3, 0.5, 0.01)),  # clearly rolls, too probable
        capture_of(candidate(Scans("top", "top"), 1.0, 0.2, 0.2)),  # says nothing of the ratio
    ],
)
def test_what_may_roll_is_left_as_it_is(capture: Capture) -> None:
    assert nearly_global(capture) is None
    assert as_global(capture, [], RIG_GLOBAL, Known()) is capture


def test_what_is_said_under_a_global_shutter_is_taken_as_it_is_said() -> None:
    globally = capture_of(candidate(GLOBAL, 1.0, 0.0, 0.0, offset=0.4))
    found = as_global(
        capture_of(ONE_SIDE, OTHER_SIDE), [], RIG_GLOBAL, Known(), lambda: replace(globally, models={"twist": 1.0})
    )
    assert found.likeliest is not None and found.likeliest.scans == GLOBAL
    assert found.calibration == globally.calibration and dict(found.models) == {"twist": 1.0}
    assert found.likeliest.sigma > 0.05, "how sure the shutter is stays what was found"


CAMERA = PinholeCamera.centred(640, 480, 500.0)
SHUTTER = RollingShutter(height=480, readout_ratio=0.7)
TURNING = [
    LinearMotion(w=np.radians([3.0, -1.0, 2.0]), d=[0.2, -0.1, 0.1]),
    LinearMotion(w=np.radians([-2.0, 2.0, -3.0]), d=[-0.1, -0.2, 0.2]),
]


def _matches(motion: LinearMotion, seed: int = 0) -> FloatArray:
    rig, options = StereoRig(camera=CAMERA, baseline=0.4), SimulationOptions(pairs=200, noise_px=0.1)
    return simulate(rig, SHUTTER, motion, options, np.random.default_rng(seed)).correspondences.left


def _capture(matches: list[FloatArray]) -> Capture:
    return conclude_alone([examine_alone(each, CAMERA, known_alone(), RobustOptions()) for each in matches])


def test_a_turning_camera_shows_its_readout_whatever_the_unit_of_length() -> None:
    capture = _capture([_matches(motion, seed) for seed, motion in enumerate(TURNING)])
    best = capture.likeliest
    assert best is not None and best.scans.left == "top" and best.probability > 0.95
    # Its own deviation covers the error; 0.1 is what a correction asks for.
    assert abs(best.ratio - 0.7) < 3.0 * best.sigma and best.sigma < 0.1
    assert shutter_found(capture, StereoRig.of_one(CAMERA)).readout_ratio == best.ratio


def test_exchanged_frames_look_read_from_the_other_side() -> None:
    forward = _matches(TURNING[0])
    backward = forward[:, [2, 3, 0, 1]]
    assert not fits_backwards(forward, CAMERA, SHUTTER, RobustOptions())
    assert fits_backwards(backward, CAMERA, SHUTTER, RobustOptions())
    assert runs_backwards(_capture([backward]), Scans("top", "top"))


def test_a_motion_along_the_lines_does_not_show_it() -> None:
    capture = _capture([_matches(LinearMotion(w=[0.0, 0.0, 0.0], d=[0.3, 0.0, 0.0]))])
    with pytest.raises(NoMotionError, match=r"cannot tell the readout ratio: the frames show .* read"):
        shutter_found(capture, StereoRig.of_one(CAMERA))
