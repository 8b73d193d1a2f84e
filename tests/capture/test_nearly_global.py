"""Shutters that matches allow to be global, or nearly so: one rule, and what is found beside."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from rsbench.capture.calibration import of_offset
from rsbench.capture.hypotheses import GLOBAL, Known, Scans
from rsbench.capture.shutter_decision import as_global
from rsbench.capture.two_frame_estimate import Candidate, Capture, nearly_global
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import StereoRig

RIG = StereoRig(camera=PinholeCamera.centred(64, 48, 50.0), baseline=0.1)


def candidate(scans: Scans, probability: float, ratio: float, sigma: float, offset: float = 0.0) -> Candidate:
    return Candidate(
        scans=scans,
        probability=probability,
        ratio=ratio,
        sigma=sigma,
        delay=0.0,
        delay_sigma=0.0,
        calibration=of_offset(offset),
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
    assert as_global(capture, [], RIG, Known()) is capture


def test_what_is_said_under_a_global_shutter_is_taken_as_it_is_said() -> None:
    told = capture_of(candidate(GLOBAL, 1.0, 0.0, 0.0, offset=0.4))
    found = as_global(
        capture_of(ONE_SIDE, OTHER_SIDE), [], RIG, Known(), lambda: replace(told, models={"twist": 1.0})
    )
    assert found.likeliest is not None and found.likeliest.scans == GLOBAL
    assert found.calibration == told.calibration and dict(found.models) == {"twist": 1.0}
    assert found.likeliest.sigma > 0.05, "how sure the shutter is stays what was found"
