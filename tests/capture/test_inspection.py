"""What matches say of the shutters that made them. Truth: points projected exactly by those shutters."""

import json

import numpy as np
import pytest
import scipy
from commands import run_here

from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.capture.inspection import Inspection, conclude, inspect_window
from rsbench.capture.reading_evidence import Peak, _product
from rsbench.capture.reading_fit import LEAST_RATIO
from rsbench.capture.reading_start import find_lag, first_shutter
from rsbench.capture.scan_reading import READINGS, Reading, TimedMatches, reading_line, reading_of
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.lens import Lens
from rsbench.core.motion import LinearMotion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter, Scan
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


def inspected(given: Correspondences) -> Inspection:
    return conclude([inspect_window(given, RIG, models=("linear",))], max_sigma=0.03)


@pytest.mark.parametrize(("scan", "right", "delay"), [("left", "left", 0.0), ("top", "right", 0.1)])
def test_camera_direction_and_ratio_are_told(scan: Scan, right: Scan, delay: float) -> None:
    found = inspected(matches(shutter(scan, right, 0.7, delay)))
    assert found.told, found.reason
    best = found.best
    assert best is not None
    assert best.reading == Reading(scan, right)
    assert abs(best.ratio - 0.7) < 0.03  # what the command promises
    assert abs(best.ratio - 0.7) < 5.0 * best.sigma  # and what it says itself
    assert abs(best.delay - delay) < 5.0 * best.delay_sigma


def test_a_global_shutter_is_told() -> None:
    found = inspected(matches(RollingShutter(height=480, readout_ratio=0.0)))
    assert found.told, found.reason
    assert found.best is not None
    assert found.best.reading == Reading("global", "global")
    assert found.best.ratio == 0.0


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
    assert not found.told
    assert reason in found.reason


def test_what_moves_along_its_rows_does_not_show_their_readout() -> None:
    """A rig that moves along its rows sees each point twice on one row, a period apart whatever the readout.

    That both cameras read alike, rows or all at once, it may show: no more than that.
    """
    sideways = LinearMotion(w=[0.0, 0.0, 0.0], d=[0.25, 0.0, 0.0])
    found = inspected(matches(shutter("top", "top", 0.8), sideways, noise=0.2, tracks=40))
    assert not found.told
    assert {(each.reading.left, each.reading.right) for each in found.candidates} >= {
        ("global", "global"),
        ("top", "top"),
        ("bottom", "bottom"),
    }


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
    found = timed.packed(reading_of(known), 0.6, 0.05)
    np.testing.assert_allclose(found.pairs, expected.pairs, atol=1e-12)
    np.testing.assert_allclose(found.tracks, expected.tracks, atol=1e-12)
    some = np.arange(timed.count) % 2 == 0
    halved = timed.subset(some).packed(reading_of(known), 0.6, 0.05)
    np.testing.assert_array_equal(halved.tracks, found.only(some).tracks)
    np.testing.assert_array_equal(halved.pairs, found.only(some).pairs)


def test_a_global_camera_reads_everything_at_once() -> None:
    given = Correspondences(tracks=np.random.default_rng(1).uniform(100, 380, (6, 8)))
    tracks = TimedMatches(given, RIG).packed(Reading("global", "top"), 0.6, 0.0).tracks
    np.testing.assert_array_equal(tracks[:, [0, 2], 2], np.tile([0.0, 1.0], (6, 1)))
    np.testing.assert_allclose(tracks[:, 1, 2], 0.6 * given.tracks[:, 3] / 480)
    assert not np.any(tracks[:, [0, 2], 7:9])


@pytest.mark.parametrize("reading", [Reading("top", "bottom"), Reading("left", "right"), Reading("right", "top")])
def test_row_differences_show_how_times_differ(reading: Reading) -> None:
    """To 0.1: that the flow itself changes while it is read is left out, a few hundredths of it at 2 deg."""
    assert reading.left != "global" and reading.right != "global"
    scan, right = reading.left, reading.right
    tracks = matches(shutter(scan, right, 0.7), noise=0.0).tracks
    lag = find_lag(tracks, RIG)
    expected = 0.7 * (reading_line(reading, "left") - reading_line(reading, "right"))
    np.testing.assert_allclose(lag.line, expected, atol=0.1)
    np.testing.assert_allclose(first_shutter(reading, lag), [0.7, 0.0], atol=0.1)


@pytest.mark.parametrize(("at", "sigma"), [(0.5, 0.02), (0.03, 0.05), (1.3, 0.1), (-0.4, 0.3)])
def test_evidence_is_the_integral_over_ratios(at: float, sigma: float) -> None:
    """Against quadrature of the same normal function."""
    peak = Peak(value=3.0, at=at, information=sigma**-2.0, delay=0.0, delay_sigma=1.0)
    total, _ = scipy.integrate.quad(
        lambda ratio: np.exp(-0.5 * ((ratio - at) / sigma) ** 2),
        LEAST_RATIO,
        1.0,
        points=[min(max(at, 0.06), 0.99)],
    )
    assert np.isclose(peak.log_evidence, 3.0 + np.log(total / (1.0 - LEAST_RATIO)), rtol=1e-6)


def test_windows_are_multiplied() -> None:
    """Two normal functions; their product at any ratio is that of the values, when they agree."""
    peaks = [
        Peak(value=1.0, at=0.50, information=400.0, delay=0.0, delay_sigma=0.1),
        Peak(value=2.0, at=0.52, information=100.0, delay=0.2, delay_sigma=0.2),
    ]
    found = _product(peaks)
    ratio = 0.6
    expected = sum(peak.value - 0.5 * peak.information * (ratio - peak.at) ** 2 for peak in peaks)
    assert np.isclose(found.value - 0.5 * found.information * (ratio - found.at) ** 2, expected)
    assert np.isclose(found.delay, 0.04)  # weights 4 to 1


def test_all_readings_are_there_once() -> None:
    assert len(set(READINGS)) == 25


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
