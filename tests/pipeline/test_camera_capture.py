"""Whether frames of a known shutter are in order. Truth: points projected exactly by it."""

from __future__ import annotations

import numpy as np
import pytest

from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.capture.calibration import RefusedFramesError
from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.pipeline import camera_capture
from rsbench.pipeline.camera_capture import find_shutter
from rsbench.pipeline.footage import OneCameraCard
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
