"""The sweep of trajectories: its points against the conventions, and what is committed of it."""

from __future__ import annotations

import importlib
from types import ModuleType

import numpy as np
import pandas as pd
import pytest
from programs import ROOT

FOLDER = ROOT / "results/trajectory"


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))  # whose programs find each other in their folder
    return importlib.import_module("trajectory_sweep")


def test_points_are_seen_where_their_rows_are_read(program: ModuleType) -> None:
    """Each pixel is the pinhole image from the pose at its own row's time, whatever order found it."""
    rng, setting = np.random.default_rng(0), program.Setting()
    law, ratio = program.hand(setting, rng), 0.015 * 30.0
    points = rng.uniform([-2.0, -1.5, 4.0], [2.0, 1.5, 9.0], (50, 3))
    for frame, side, shift in ((0, 0, 0.1), (1, 1, -0.1)):
        pixels = program.seen(law, setting.shutter, points, frame, side)
        for point, (x, y) in zip(points, pixels, strict=True):
            R, t = (each[0] for each in law.body(np.array([frame + ratio * y / 480.0])))
            X = R @ point + t + [shift, 0.0, 0.0]
            np.testing.assert_allclose([x, y], 520.0 * X[:2] / X[2] + [319.5, 239.5], atol=1e-6)


def test_the_truth_errs_by_nothing_and_a_still_rig_by_the_motion(program: ModuleType) -> None:
    from rsbench.benchmark.trajectory_methods import along
    from rsbench.components.motion_models import LinearMotion

    setting = program.Setting(shake=0.0)
    law = program.hand(setting, np.random.default_rng(1))
    still = along(LinearMotion(np.zeros(3), np.zeros(3)), setting.length - 1)
    turned, shifted = program.error(law, setting, still)
    # Rows go on evenly from the first: the root mean square of k / 20 of the readout, k from 0 to 19.
    part = 0.45 * np.sqrt(np.mean((np.arange(20) / 20.0) ** 2))
    assert turned == pytest.approx(part * 1.0, rel=1e-9)
    assert shifted == pytest.approx(part * 50.0, rel=1e-9)


def test_committed_rows_say_what_the_page_concludes() -> None:
    rows = pd.read_csv(FOLDER / "rows.csv").set_index(["sweep", "entry", "value"])
    ours = rows.xs("rs-trajectory", level="entry")
    for windows in ("windows-auto", "windows-linear"):
        beside = rows.xs(windows, level="entry")
        clear = ours.rotation_deg_high < beside.rotation_deg_low
        shaken = [key for key in clear.index if key[0] != "shake of two frames" and key[1] != 0.0]
        assert all(clear[key] for key in shaken if key != ("rate", 7.5))
        assert not clear["shake of two frames", 0.0] and not clear["rate", 7.5]
    assert not np.any(rows.failed)
