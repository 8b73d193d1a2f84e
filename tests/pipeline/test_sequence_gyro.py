"""Windows without matches, with a gyroscope and without. Truth: the laws of ``shaken_rig``."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from shaken_rig import RIG, SHAKES, SHUTTER, matches, sines, times

from rsbench.core.correspondences import Correspondences
from rsbench.dataset.corrected_frames import motion_record
from rsbench.pipeline.frame_capture import KnownCapture
from rsbench.pipeline.sequence_correction import BRIDGED, TURNED, Window, on_one_trajectory


@pytest.mark.slow
def test_a_gyroscope_turns_frames_far_from_any_that_match() -> None:
    rng = np.random.default_rng(5)
    law = sines(rng, *SHAKES["walk"])
    given, _ = matches(law, 15, rng, count=100)
    given[4:11] = [Correspondences()] * 7
    tau = np.arange(-0.5, 15.5, 0.125)
    before, after = (law(tau + each)[0] for each in (-1e-4, 1e-4))
    w = Rotation.from_matrix(after @ np.swapaxes(before, 1, 2)).as_rotvec() / 2e-4
    samples = np.column_stack([tau, w + 1e-4 * rng.normal(size=w.shape)])

    def through(gyro: Any) -> list[Window]:
        windows = (Window(images={}, pairs=None, found=None, matches=each) for each in given)
        return list(on_one_trajectory(windows, KnownCapture(rig=RIG, shutter=SHUTTER, gyro=gyro), 0, ""))

    with_it, alone = through(samples), through(None)
    far = range(6, 9)
    assert [k for k, each in enumerate(alone) if each.found is None] == list(far)
    rows = times(np.array([0.0, 479.0]), 0)
    for k, each in enumerate(with_it):
        assert each.found is not None
        motion = each.found.motion
        (a, b), (c, d) = motion.body_from_world(rows).R, law(k + rows)[0]
        # 7 windows of 8 samples of 1e-4 rad a period, and what the knots do not follow: hundredths of a degree.
        assert np.rad2deg(Rotation.from_matrix(b @ a.T @ c @ d.T).magnitude()) < 0.03
        assert (each.pose is None) == (k in far)
        record = motion_record(each.found)
        assert set(record["gyro"]) == {"bias", "shift", "matrix", "noise"}
        if k in far:
            assert each.reason == BRIDGED + TURNED and record["covariance_w_d"] is None
            np.testing.assert_allclose(motion.body_from_world(rows).t, 0.0, atol=1e-12)
    assert all("gyro" not in motion_record(each.found) for each in alone if each.found is not None)
