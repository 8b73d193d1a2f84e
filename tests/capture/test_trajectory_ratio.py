"""The readout ratio of a rig that shakes. Truth: points projected at their rows' times (``shaken_rig``)."""

from dataclasses import replace

import numpy as np
import pytest
import shaken_rig
from shaken_rig import RATIO, RIG, SHAKES, inside, matches, scattered, seen, sines

from rsbench.capture.hypotheses import GLOBAL
from rsbench.capture.self_calibration import CENTRE_SIGMA
from rsbench.capture.sequence_shutter import capture_of_sequence, ratio_of_sequence
from rsbench.capture.two_frame_estimate import Capture
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import Scanning

NOTHING = Capture(reason="nothing", matches=0, moved_px=20.0)


def test_a_sequence_shows_the_ratio_that_its_windows_do_not() -> None:
    """Sines, which no spline of ours is."""
    rng = np.random.default_rng(102)
    windows, _ = matches(sines(rng, *SHAKES["strong"]), 5, rng, count=80)
    found = ratio_of_sequence(windows, RIG, [Scanning(), Scanning(scan="bottom")])
    assert found is not None and found.scanning == Scanning() and found.probability > 0.99
    assert abs(found.ratio - RATIO) < 3.0 * found.sigma
    assert found.sigma < 0.03  # frames that allow no more would be no use


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 4, 6, 12])
def test_a_dashboard_that_moves_with_the_camera_does_not_bias_the_ratio(seed: int) -> None:
    """The lower third of the image shows a dashboard, which vibrates by 0.4 px between frames.

    With one noise for the whole image, the ratios of 1, 4 and 6 were wrong by 12, 4 and 16 standard deviations;
    without a start at which the dashboard has little weight, that of 4 by 3; without the distance between local
    optima in the deviation, that of 12 by 3.
    """
    rng = np.random.default_rng(seed)
    law, shaken, windows = sines(rng, *SHAKES["strong"]), rng.normal(0.0, 0.4, (9, 2)), list[Correspondences]()
    for k in range(8):
        points = scattered(law, k, 600, rng)
        road = np.concatenate([seen(law, points, k, 0), seen(law, points, k + 1, 0)], axis=1)
        road = road[inside(road) & (road[:, 1] < 320.0)][:160]
        dashboard, near = rng.uniform([0.0, 320.0], [640.0, 480.0], (80, 2)), rng.uniform(1.0, 2.0, (80, 1))
        dashboard = np.concatenate([dashboard + near * shaken[k], dashboard + near * shaken[k + 1]], axis=1)
        pairs = np.concatenate([road, dashboard])
        windows.append(Correspondences(left=rng.permutation(pairs + 0.05 * rng.normal(size=pairs.shape))))
    found = ratio_of_sequence(windows, StereoRig.of_one(RIG.camera), [Scanning()])
    assert found is not None and abs(found.ratio - RATIO) < 2.5 * found.sigma and found.sigma < 0.08


@pytest.mark.slow
def test_an_unknown_principal_point_does_not_bias_the_ratio() -> None:
    """With the assumed one, 18 px beside the true one, the ratio is 0.763 +- 0.023; 0.8 is true."""
    rng = np.random.default_rng(25)
    law, windows = sines(rng, *SHAKES["walk"]), list[Correspondences]()
    for k in range(8):
        points = scattered(law, k, 600, rng)
        pairs = np.concatenate([seen(law, points, k, 0), seen(law, points, k + 1, 0)], axis=1)
        pairs = pairs[inside(pairs)][:200]
        windows.append(Correspondences(left=pairs + 0.05 * rng.normal(size=pairs.shape)))
    camera = replace(RIG.camera, cx=RIG.camera.cx - 16.0, cy=RIG.camera.cy + 8.0)
    found = ratio_of_sequence(windows, StereoRig.of_one(camera), [Scanning()], centre_sigma=CENTRE_SIGMA)
    assert found is not None and abs(found.ratio - RATIO) < 2.5 * found.sigma and found.sigma < 0.04
    assert found.noise_px < 0.055  # 0.05 in the matches


def test_few_frames_say_that_they_are_few() -> None:
    rng = np.random.default_rng(103)
    windows, _ = matches(sines(rng, *SHAKES["walk"]), 4, rng, count=60, noise=1.0)
    capture = capture_of_sequence(NOTHING, windows, RIG, [Scanning()])
    best = capture.likeliest
    assert best is not None and abs(best.ratio - RATIO) < 3.0 * best.sigma
    assert not capture.determined and "4 successive frames do not determine" in capture.reason


def test_nothing_is_told_where_nothing_is_seen() -> None:
    assert capture_of_sequence(NOTHING, [Correspondences()] * 4, RIG) is NOTHING


def test_a_shaken_rig_that_reads_all_lines_at_once_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shaken_rig, "RATIO", 0.0)
    rng = np.random.default_rng(104)
    windows, _ = matches(sines(rng, *SHAKES["strong"]), 6, rng, count=80)
    best = capture_of_sequence(NOTHING, windows, RIG, [Scanning()]).likeliest
    assert best is not None and best.scans == GLOBAL and best.ratio == 0.0 and best.probability == 1.0
