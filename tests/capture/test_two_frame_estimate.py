"""Shutters and motions from matches. Truth: points projected exactly by those shutters."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import scipy
from commands import run_here

from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.capture.hypotheses import (
    ALL_SCANS,
    BEYOND_RATIO,
    DELAY,
    LEAST_RATIO,
    RATIO,
    UNKNOWNS,
    CaptureFit,
    Hypothesis,
    Known,
    Scans,
    TimedMatches,
    line_of,
    scans_of,
)
from rsbench.capture.hypothesis_ranking import Lag, Peak, find_lag, first_shutter, without_lag, without_leaps
from rsbench.capture.two_frame_estimate import Capture, _product, conclude, examine
from rsbench.components.motion_models import (
    AcceleratedMotion,
    InertialMotion,
    LinearMotion,
    TwistMotion,
    make_motion,
)
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter, Scan
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.packed import pack

CAMERA = PinholeCamera.centred(640, 480, 600.0)
RIG = StereoRig(camera=CAMERA, baseline=0.4)
MOTION = LinearMotion(w=np.radians([1.2, -0.7, 1.5]), d=[0.1, -0.15, 0.1])
STILL = LinearMotion(w=[0.0, 0.0, 0.0], d=[0.0, 0.0, 0.0])


def shutter(scan: Scan, right: Scan, ratio: float, delay: float = 0.0) -> RollingShutter:
    return RollingShutter(
        height=480, width=640, readout_ratio=ratio, scan=scan, right_scan=right, right_delay=delay
    )


def matches(
    given: RollingShutter, motion: LinearMotion = MOTION, noise: float = 0.05, tracks: int = 130
) -> Correspondences:
    options = SimulationOptions(tracks=tracks, noise_px=noise, outlier_ratio=0.1)
    return simulate(RIG, given, motion, options, np.random.default_rng(4)).correspondences


def inspected(given: Correspondences) -> Capture:
    return conclude([examine(given, RIG, Known(models=("linear",)))], max_sigma=0.03)


@pytest.mark.parametrize(("scan", "right", "delay"), [("left", "left", 0.0), ("top", "right", 0.1)])
def test_camera_direction_and_ratio_are_told(scan: Scan, right: Scan, delay: float) -> None:
    found = inspected(matches(shutter(scan, right, 0.7, delay)))
    assert found.determined, found.reason
    best = found.likeliest
    assert best is not None
    assert best.scans == Scans(scan, right)
    assert abs(best.ratio - 0.7) < 0.03  # what the command promises
    assert abs(best.ratio - 0.7) < 5.0 * best.sigma  # and what it says itself
    assert abs(best.delay - delay) < 5.0 * best.delay_sigma


def test_a_global_shutter_is_told() -> None:
    found = inspected(matches(RollingShutter(height=480, readout_ratio=0.0)))
    assert found.determined, found.reason
    assert found.likeliest is not None
    assert found.likeliest.scans == Scans("global", "global")
    assert found.likeliest.ratio == 0.0


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (matches(shutter("top", "top", 0.8), STILL, noise=0.2, tracks=40), "only"),
        (matches(shutter("top", "top", 0.8), tracks=12), "12 matches"),
    ],
    ids=["no motion", "few matches"],
)
def test_what_cannot_be_told(given: Correspondences, reason: str) -> None:
    found = inspected(given)
    assert not found.determined
    assert reason in found.reason


def test_what_moves_along_its_rows_does_not_show_their_readout() -> None:
    """A rig that moves along its rows sees each point twice on one row, a period apart whatever the readout.

    That both cameras read alike, rows or all at once, it may show: no more than that.
    """
    sideways = LinearMotion(w=[0.0, 0.0, 0.0], d=[0.25, 0.0, 0.0])
    found = inspected(matches(shutter("top", "top", 0.8), sideways, noise=0.2, tracks=40))
    assert not found.determined
    assert {(each.scans.left, each.scans.right) for each in found.candidates} >= {
        ("global", "global"),
        ("top", "top"),
        ("bottom", "bottom"),
    }


def unknowns(ratio: float, delay: float) -> FloatArray:
    """Of cameras whose calibration is right."""
    out = np.zeros(UNKNOWNS)
    out[[RATIO, DELAY]] = ratio, delay
    return out


@pytest.mark.parametrize("lens", [None, Lens(model="brown-conrady", k1=-0.1)])
@pytest.mark.parametrize(("scan", "right"), [("top", "bottom"), ("left", "top"), ("right", "right")])
def test_times_are_those_of_the_shutter(lens: Lens | None, scan: Scan, right: Scan) -> None:
    """Against the packing for a known shutter; 1e-12: sums of a few numbers near 1."""
    camera = PinholeCamera(width=640, height=480, fx=600.0, fy=590.0, cx=310.0, cy=250.0, lens=lens)
    rig, known = StereoRig(camera=camera, baseline=0.4), shutter(scan, right, 0.6, 0.05)
    rng = np.random.default_rng(1)
    given = Correspondences(
        left=rng.uniform(100, 380, (5, 4)),
        right=rng.uniform(100, 380, (4, 4)),
        tracks=rng.uniform(100, 380, (6, 8)),
    )
    expected = pack(given, rig, known)
    timed = TimedMatches(given, rig)
    found = timed.packed(scans_of(known), unknowns(0.6, 0.05))
    np.testing.assert_allclose(found.pairs, expected.pairs, atol=1e-12)
    np.testing.assert_allclose(found.tracks, expected.tracks, atol=1e-12)
    some = np.arange(timed.count) % 2 == 0
    halved = timed.read(scans_of(known), some).packed(unknowns(0.6, 0.05))
    np.testing.assert_array_equal(halved.tracks, found.only(some).tracks)
    np.testing.assert_array_equal(halved.pairs, found.only(some).pairs)


def test_a_global_camera_reads_everything_at_once() -> None:
    given = Correspondences(tracks=np.random.default_rng(1).uniform(100, 380, (6, 8)))
    tracks = TimedMatches(given, RIG).packed(Scans("global", "top"), unknowns(0.6, 0.0)).tracks
    np.testing.assert_array_equal(tracks[:, [0, 2], 2], np.tile([0.0, 1.0], (6, 1)))
    np.testing.assert_allclose(tracks[:, 1, 2], 0.6 * given.tracks[:, 3] / 480)
    assert not np.any(tracks[:, [0, 2], 7:9])


@pytest.mark.parametrize("scans", [Scans("top", "bottom"), Scans("left", "right"), Scans("right", "top")])
def test_row_differences_show_how_times_differ(scans: Scans) -> None:
    """To 0.1: that the flow itself changes while it is read is left out, a few hundredths of it at 2 deg."""
    assert scans.left != "global" and scans.right != "global"
    scan, right = scans.left, scans.right
    tracks = matches(shutter(scan, right, 0.7), noise=0.0).tracks
    lag = find_lag(tracks, RIG)
    expected = 0.7 * (line_of(scans, "left") - line_of(scans, "right"))
    np.testing.assert_allclose(lag.line, expected, atol=0.1)
    np.testing.assert_allclose(first_shutter(scans, lag), [0.7, 0.0], atol=0.1)


def _peak(value: float, at: float, information: float, delay: float = 0.0, delay_sigma: float = 1.0) -> Peak:
    fit = CaptureFit(
        hypothesis=Hypothesis(scans=Scans("top", "top"), motion_model="linear", delayed=True),
        theta=np.zeros(6),
        unknowns=np.array([at, delay, 0.0, 0.0]),
        cost=0.0,
        sigma=np.array([0.0, delay_sigma, 0.0, 0.0]),
        spread=np.zeros((6, 6)),
        occam=0.0,
    )
    return Peak(value=value, at=at, information=information, fit=fit, trade=np.zeros(10))


@pytest.mark.parametrize(("at", "sigma"), [(0.5, 0.02), (0.03, 0.05), (1.3, 0.1), (-0.4, 0.3)])
def test_evidence_is_the_integral_over_ratios(at: float, sigma: float) -> None:
    """Against quadrature of the same normal function."""
    total, _ = scipy.integrate.quad(
        lambda ratio: np.exp(-0.5 * ((ratio - at) / sigma) ** 2),
        LEAST_RATIO,
        1.0,
        points=[min(max(at, 0.06), 0.99)],
    )
    expected = 3.0 + np.log(total / (1.0 - LEAST_RATIO))
    assert np.isclose(_peak(3.0, at, sigma**-2.0).log_evidence, expected, rtol=1e-6)


def test_windows_are_multiplied() -> None:
    """Two normal functions: the evidence is the integral of their product over the ratios."""
    peaks = [_peak(1.0, 0.50, 400.0, 0.0, 0.1), _peak(2.0, 0.52, 100.0, 0.2, 0.2)]
    found = _product(peaks, 0.0)
    total, _ = scipy.integrate.quad(
        lambda ratio: np.exp(sum(p.value - 0.5 * p.information * (ratio - p.at) ** 2 for p in peaks)),
        LEAST_RATIO,
        1.0,
        points=[0.5],
    )
    assert np.isclose(found.log_evidence, np.log(total / (1.0 - LEAST_RATIO)), rtol=1e-6)
    assert np.isclose(found.mean[DELAY], 0.04)  # weights 4 to 1


MOTIONS: dict[str, Motion] = {
    "linear": LinearMotion(w=np.radians([1.0, -2.5, 1.2]), d=[0.2, -0.12, 0.18]),
    "twist": TwistMotion(w=np.radians([1.0, -2.5, 1.2]), d=[0.2, -0.12, 0.18]),
    "inertial": InertialMotion(w=np.radians([1.0, -2.5, 1.2]), d=[0.2, -0.12, 0.18]),
    "accelerated": AcceleratedMotion(w=np.radians([1.0, -2.5, 1.2]), d=[0.2, -0.12, 0.18], acceleration=0.3),
}


@pytest.mark.parametrize("name", MOTIONS)
def test_ratio_and_motion_model_are_found_together(name: str) -> None:
    """Under a wrong model the ratio is off by many deviations: each motion is of one that the others are not."""
    options = SimulationOptions(tracks=150, noise_px=0.1, outlier_ratio=0.2)
    given = simulate(RIG, shutter("top", "top", 0.8), MOTIONS[name], options, np.random.default_rng(2))
    alike = Known(scans=tuple(each for each in ALL_SCANS if each.together))
    found = conclude([examine(given.correspondences, RIG, alike)], max_sigma=0.05)
    best = found.likeliest
    assert best is not None and found.determined, found.reason
    assert best.scans == Scans("top", "top")
    assert abs(best.ratio - 0.8) < 4.0 * best.sigma
    assert found.motion_model == name


@pytest.mark.parametrize("name", MOTIONS)
def test_what_is_known_is_not_looked_for(name: str) -> None:
    """With ratio and scans known, the motion model is found alone."""
    options = SimulationOptions(tracks=150, noise_px=0.1, outlier_ratio=0.2)
    given = simulate(RIG, shutter("top", "top", 0.8), MOTIONS[name], options, np.random.default_rng(5))
    known = Known(ratio=0.8, scans=(Scans("top", "top"),), delay=0.0)
    found = conclude([examine(given.correspondences, RIG, known)])
    best = found.likeliest
    assert best is not None
    np.testing.assert_allclose([best.ratio, best.sigma, best.delay], [0.8, 0.0, 0.0], atol=1e-12)
    assert found.motion_model == name


def test_all_readings_are_there_once() -> None:
    assert len(set(ALL_SCANS)) == 25


def test_the_command_answers_by_its_exit_code() -> None:
    given = matches(shutter("bottom", "bottom", 0.7))
    problem = {
        "name": "mine",
        "camera": {"width": 640, "height": 480, "fx": 600.0, "fy": 600.0, "cx": CAMERA.cx, "cy": CAMERA.cy},
        "baseline": 0.4,
        "readout_ratio": 0.2,
        "tracks": given.tracks.tolist(),
    }
    few = problem | {"name": "few", "tracks": given.tracks[:10].tolist()}
    words = ("--json", "--motion-model", "linear", "--max-sigma", 0.03)
    run = run_here("inspect", "-", *words, text=json.dumps(problem))
    assert run.returncode == 0, run.stdout + run.stderr
    answer = json.loads(run.stdout)
    assert (answer["left"], answer["right"], answer["told"]) == ("bottom", "bottom", True)
    assert abs(answer["readout_ratio"] - 0.7) < 0.03
    assert answer["said"] == {"left": "top", "right": "top", "readout_ratio": 0.2}
    run = run_here("inspect", "-", text=json.dumps(few))
    assert run.returncode == 1
    assert {"cannot", "tell"} <= set(run.stdout.split())  # a narrow terminal has them in two lines
    text = json.dumps(few) + "\n" + json.dumps(few | {"baseline": -1.0})
    run = run_here("inspect", "-", "--json", text=text)
    assert run.returncode == 2
    assert [json.loads(line)["told"] for line in run.stdout.splitlines()] == [False]
    assert "baseline" in run.stderr
    assert run_here("inspect").returncode == 2


RIG_LEAPS = StereoRig(camera=PinholeCamera.centred(640, 480, 520.0), baseline=0.2)
MOTION_LEAPS: Motion = make_motion("accelerated", [0.0, -0.009, 0.0], [0.006, 0.004, -0.2], {"acceleration": 0.06})
"""A vehicle that speeds up: the ratio trades with the acceleration, so the valley is shallow."""


TRUE_RATIO = 0.8


def leap(ratio: float) -> np.ndarray:
    """From the bottom of the image to a row that is read at the same time, a period later; (1, 4)."""
    return np.array([[10.0, 470.0, 170.0, 470.0 - 480.0 / ratio]])


@pytest.mark.parametrize("ratio", [1.1, BEYOND_RATIO])
def test_a_leap_is_a_perfect_match_at_some_ratio_and_is_left_out(ratio: float) -> None:
    wrong = Correspondences(left=leap(ratio))
    timed = TimedMatches(wrong, RIG_LEAPS, "linear")
    unknowns = np.zeros(17)
    unknowns[0] = ratio
    theta = np.concatenate([MOTION_LEAPS.w, MOTION_LEAPS.d])
    assert abs(timed.packed(Scans("top", "top"), unknowns).pair_residuals(theta)[0]) < 1e-3
    assert len(without_leaps(wrong, RIG_LEAPS).left) == 0


@pytest.mark.slow
def test_leaps_do_not_hold_the_ratio() -> None:
    options = SimulationOptions(noise_px=0.05, pairs=300, tracks=300, depth=(3.0, 12.0))
    made = simulate(
        RIG_LEAPS,
        RollingShutter(height=480, readout_ratio=TRUE_RATIO),
        MOTION_LEAPS,
        options,
        np.random.default_rng(0),
    )
    right = made.correspondences
    leaps = np.concatenate([leap(ratio) for ratio in np.linspace(1.02, 1.2, 10)])
    found = []
    for matches in (right, replace(right, left=np.concatenate([right.left, leaps]))):
        best = conclude([examine(matches, RIG_LEAPS)], np.inf).likeliest
        assert best is not None
        assert abs(best.ratio - TRUE_RATIO) < 3.0 * best.sigma
        found.append(best.ratio)
    assert found[1] == pytest.approx(found[0], abs=1e-3)  # the start alone is found among other matches


def test_a_lag_may_lead_to_where_a_lens_shows_nothing() -> None:
    """A point that goes on by a period as it did: in ideal pixels that is somewhere, whatever the lens shows."""
    lens = Lens(model="brown-conrady", k1=-0.28)
    camera = replace(PinholeCamera.centred(640, 480, 560.0), lens=lens)
    rig = StereoRig(camera=camera, baseline=0.2)
    ends = np.array([[[600.0, 430.0], [638.0, 478.0]]])
    beyond = 2.0 * ends[:, 1] - ends[:, 0]
    assert np.all(np.isnan(camera.ideal_pixels(beyond)))
    a_period = Lag(np.array([1.0, 0.0, 0.0]), np.eye(3))
    taken = without_lag(Correspondences(right=ends.reshape(1, 4)), a_period, rig)
    ideal = camera.ideal_pixels(ends)
    np.testing.assert_allclose(taken.right[0, 2:], (2.0 * ideal[:, 1] - ideal[:, 0])[0])
