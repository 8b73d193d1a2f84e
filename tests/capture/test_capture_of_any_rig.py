"""Shutter and motion model of cameras that differ, with a given readout ratio each or one to be found."""

from __future__ import annotations

import numpy as np
import pytest
from general_rigs import RIGS
from hypothesis import given
from hypothesis import strategies as st

from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.capture.hypotheses import (
    Hypothesis,
    Known,
    KnownInputs,
    Scans,
    TimedMatches,
    scans_of,
    shutter_under,
)
from rsbench.capture.model_choice import choose_model
from rsbench.capture.shutter_decision import known_of, shutter_found
from rsbench.capture.two_frame_estimate import conclude, examine
from rsbench.components.motion_models import make_motion
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.solvers.engine.packed import pack

W, D = np.array([0.02, 0.06, -0.04]), np.array([0.1, -0.1, 0.12])
STARTS = ["global", "top", "bottom", "left", "right"]


def matches_of(name: str, shutter: RollingShutter, motion: Motion, noise_px: float = 0.1) -> Correspondences:
    options = SimulationOptions(tracks=150, pairs=40, depth=(2.0, 6.0), noise_px=noise_px)
    return simulate(RIGS[name], shutter, motion, options, np.random.default_rng(5)).correspondences


@given(st.sampled_from(STARTS), st.sampled_from(STARTS), st.floats(0.1, 1.0), st.floats(0.2, 1.0))
def test_a_shutter_is_what_is_known_of_it(left: str, right: str, ratio: float, share: float) -> None:
    rig, scans = RIGS["turned"], Scans(left, right)  # pyrefly: ignore[bad-argument-type]
    shutter = shutter_under(scans, ratio, rig, 0.1, share)
    assert scans_of(shutter) == scans
    assert shutter.ratio_of("left") == (0.0 if left == "global" else ratio)
    assert shutter.ratio_of("right") == (0.0 if right == "global" else share * ratio)
    known = Known().with_shutter(shutter)
    again = known.shutter(rig)
    assert known.shutter_known and again is not None and scans_of(again) == scans
    for side in ("left", "right"):
        assert again.ratio_of(side) == pytest.approx(shutter.ratio_of(side), rel=1e-12)


@pytest.mark.parametrize("right", [0.0, 0.3])
@pytest.mark.parametrize("left", [0.8, 0.0])
def test_matches_have_the_times_of_two_given_ratios(left: float, right: float) -> None:
    """The equations of the capture are those of the solvers, which know the shutter."""
    rig = RIGS["toed in"]
    shutter = rig.shutter_of(Scanning(right_readout_ratio=right, right_scan="left", right_delay=0.1), left)
    c = matches_of("toed in", shutter, make_motion("linear", W, D))
    known = known_of(c, rig, KnownInputs(readout_ratio=left, scanning=shutter.scanning))
    timed = TimedMatches(c, rig, right_share=known.right_share)
    unknowns = known.start(Hypothesis(scans=known.scans[0], motion_model="linear"), 0.0, 0.0)
    found, expected = timed.packed(known.scans[0], unknowns), pack(c, rig, shutter)
    np.testing.assert_allclose(found.pairs, expected.pairs, atol=1e-12)
    np.testing.assert_allclose(found.tracks, expected.tracks, atol=1e-12)


@pytest.mark.parametrize("model", ["linear", "twist"])
@pytest.mark.parametrize(
    ("name", "left", "scanning"),
    [
        ("turned", 0.8, Scanning(right_readout_ratio=0.0)),
        ("vertical", 0.9, Scanning(right_readout_ratio=0.4, right_delay=0.1)),
        ("toed in", 0.0, Scanning(right_readout_ratio=0.8, right_scan="left")),
    ],
)
def test_a_known_shutter_of_two_ratios_shows_the_motion_model(
    name: str, left: float, scanning: Scanning, model: str
) -> None:
    rig, motion = RIGS[name], make_motion(model, 2.0 * W, 3.0 * D)
    c = matches_of(name, rig.shutter_of(scanning, left), motion, noise_px=0.05)
    known = known_of(c, rig, KnownInputs(readout_ratio=left, scanning=scanning, models=("linear", "twist")))
    capture = conclude([examine(c, rig, known)])
    choice = choose_model(capture)
    assert choice is not None and choice.used == model, capture.models
    assert capture.noise_px == pytest.approx(0.05, rel=0.2)


@pytest.mark.parametrize("name", RIGS)
def test_a_ratio_that_both_share_is_found(name: str) -> None:
    rig = RIGS[name]
    c = matches_of(name, rig.shutter_of(Scanning(), 0.7), make_motion("linear", W, D), noise_px=0.05)
    known = known_of(c, rig, KnownInputs(scanning=Scanning(), models=("linear",)))
    best = conclude([examine(c, rig, known)]).likeliest
    assert best is not None and best.scans == Scans("top", "top")
    assert abs(best.ratio - 0.7) < 4.0 * best.sigma < 0.2
    assert shutter_found(conclude([examine(c, rig, known)]), rig).right_size == (1280, 720)


def test_a_ratio_of_the_right_camera_alone_is_refused_by_name() -> None:
    rig, scanning = RIGS["turned"], Scanning(right_readout_ratio=0.4)
    c = matches_of("turned", rig.shutter_of(scanning, 0.8), make_motion("linear", W, D))
    with pytest.raises(RsbenchError, match=r"right_readout_ratio = 0\.4: give readout_ratio too"):
        known_of(c, rig, KnownInputs(scanning=scanning))
