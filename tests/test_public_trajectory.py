"""``rsbench.estimate_trajectory``. Truth: points projected at their rows' times (``shaken_rig``)."""

from typing import Any, cast

import numpy as np
import pytest
from shaken_rig import RATIO, RIG, SHAKES, SHUTTER, matches, row_errors_deg, sines

import rsbench


@pytest.mark.slow
def test_a_trajectory_through_matches_with_a_shutter_and_without() -> None:
    rng = np.random.default_rng(104)
    law = sines(rng, *SHAKES["tremor"])
    windows, right = matches(law, 4, rng, count=60, noise=0.1)
    found = rsbench.estimate_trajectory(windows, RIG, SHUTTER)
    assert np.median(row_errors_deg(found, law, 4)) < 0.02 and np.all(found.supported)  # of issue 30
    assert np.mean(found.inliers[0] == right[0]) > 0.95
    assert found.shutter is SHUTTER and found.covariance([1.0, 2.0]).shape == (2, 6, 6)
    # The same tracks tell the ratio: four frames to a few hundredths, as tests/capture shows of its deviation.
    assert abs(rsbench.estimate_trajectory(windows, RIG).shutter.readout_ratio - RATIO) < 0.15


def test_what_is_no_sequence_is_refused() -> None:
    with pytest.raises(ValueError, match="4 frames and more; these are 2"):
        rsbench.estimate_trajectory([rsbench.Correspondences()], RIG)
    with pytest.raises(ValueError, match=r"sequence\[1\]: must be"):
        mixed: Any = [np.zeros((2, 480, 640), np.uint8), rsbench.Correspondences()]
        rsbench.estimate_trajectory(mixed, RIG, SHUTTER)
    with pytest.raises(ValueError, match=r"sequence\[0\]: must be"):
        rsbench.estimate_trajectory(cast("Any", [1, 2]), RIG, SHUTTER)
    with pytest.raises(ValueError, match="needs tracks"):
        rsbench.estimate_trajectory([rsbench.Correspondences()], RIG, SHUTTER)


@pytest.mark.slow
def test_random_tracks_show_no_trajectory() -> None:
    rng = np.random.default_rng(0)
    windows = []
    for _ in range(4):
        tracks = rng.uniform(0.0, 1.0, (60, 8)) * np.tile([639.0, 479.0], 4)
        tracks[:, [2, 6]] = tracks[:, [0, 4]] - rng.uniform(1.0, 40.0, (60, 2))
        tracks[:, [3, 7]] = tracks[:, [1, 5]]
        windows.append(rsbench.Correspondences(tracks=tracks))
    with pytest.raises(rsbench.RsbenchError, match="no trajectory explains the matches"):
        rsbench.estimate_trajectory(windows, RIG, SHUTTER)
