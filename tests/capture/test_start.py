"""Starts of the estimator: what is taken from the matches beforehand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rsbench.capture.hypothesis_ranking import Lag, without_lag
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig


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
