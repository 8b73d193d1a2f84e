"""Whether frames of a known scan are in order. Truth: points projected exactly by it."""

from __future__ import annotations

import numpy as np
import pytest

from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.capture.calibration import RefusedFramesError
from rsbench.capture.hypotheses import KnownInputs
from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.pipeline import camera_capture, sequence_capture
from rsbench.pipeline.camera_capture import find_shutter
from rsbench.pipeline.footage import ImageSource, OneCameraCard
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.sequence_capture import estimate_sequence_capture
from rsbench.solvers.engine.robust_motion import RobustOptions

CAMERA = PinholeCamera.centred(640, 480, 500.0)


@pytest.mark.slow
@pytest.mark.parametrize(("ways", "refused"), [("bb", True), ("b", True), ("bf", False), ("fb", False)])
def test_frames_are_reversed_where_each_pair_looks_so(
    ways: str, refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A camera that trembles may look reversed in one pair of its frames; reversed frames do in all."""
    shutter, rig = RollingShutter(height=480, readout_ratio=0.7), StereoRig(camera=CAMERA, baseline=0.4)
    motion = LinearMotion(w=np.radians([3.0, -1.0, 2.0]), d=[0.2, -0.1, 0.1])
    options = SimulationOptions(pairs=200, noise_px=0.1)
    given = simulate(rig, shutter, motion, options, np.random.default_rng(0)).correspondences.left
    pairs = [(given if way == "f" else given[:, [2, 3, 0, 1]], "", CAMERA) for way in ways]
    monkeypatch.setattr(camera_capture, "matched_pairs", lambda *_: iter(pairs))
    card = OneCameraCard(readout_ratio=0.7)
    if refused:
        with pytest.raises(RefusedFramesError, match="backwards"):
            find_shutter([], 0, card, RobustOptions())
    else:
        assert find_shutter([], 0, card, RobustOptions()).shutter.readout_ratio == 0.7


@pytest.mark.parametrize("reverse", [False, True])
def test_reversed_frames_of_a_rig_are_refused(reverse: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A card that gives the scan, but no readout ratio."""
    shutter, rig = RollingShutter(height=480, readout_ratio=0.7), StereoRig(camera=CAMERA, baseline=0.4)
    motion = LinearMotion(w=np.radians([3.0, -1.0, 2.0]), d=[0.2, -0.1, 0.1])
    options = SimulationOptions(pairs=0, tracks=200, noise_px=0.1)
    given = simulate(rig, shutter, motion, options, np.random.default_rng(0)).correspondences.tracks
    matches = Correspondences(tracks=given[:, [4, 5, 6, 7, 0, 1, 2, 3]] if reverse else given)
    monkeypatch.setattr(sequence_capture, "match_given", lambda *_, **__: (matches, None))
    frames, inputs = ImageSource([np.zeros((480, 640), np.uint8)] * 3), KnownInputs(scanning=Scanning())
    if reverse:
        with pytest.raises(RefusedFramesError, match="backwards"):
            estimate_sequence_capture(frames, frames, rig, CorrectionOptions(), inputs)
    else:
        capture, found = estimate_sequence_capture(frames, frames, rig, CorrectionOptions(), inputs)
        assert capture is not None and capture.likeliest is not None
        assert abs(found.readout_ratio - 0.7) < 4 * capture.likeliest.sigma
