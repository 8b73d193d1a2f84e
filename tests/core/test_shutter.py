"""The row-time formula: tau = frame + readout_ratio * y / height."""

from __future__ import annotations

import numpy as np
import pytest

from rsbench.core.shutter import RollingShutter


def test_row_zero_is_the_start_of_its_frame_exactly() -> None:
    shutter = RollingShutter(height=900, readout_ratio=0.8)
    assert shutter.row_time(0, 0) == 0.0
    assert shutter.row_time(0, 1) == 1.0


def test_row_time_is_continuous_in_y_and_linear() -> None:
    shutter = RollingShutter(height=900, readout_ratio=0.8)
    # Half-way down, half the readout has passed; a row beyond the last one ends it.
    np.testing.assert_allclose(shutter.row_time([450, 900, 112.5], [0, 0, 1]), [0.4, 0.8, 1.1], rtol=1e-15)
    assert shutter.h == pytest.approx(0.8 / 900, rel=1e-15)


def test_ratio_zero_is_a_global_shutter() -> None:
    shutter = RollingShutter(height=7, readout_ratio=0.0)
    np.testing.assert_array_equal(shutter.row_time(np.arange(7), 1), np.ones(7))


def test_ratio_one_leaves_no_gap_between_frames() -> None:
    shutter = RollingShutter(height=8, readout_ratio=1.0)
    assert shutter.row_time(8, 0) == shutter.row_time(0, 1)


def test_rows_and_frames_broadcast() -> None:
    shutter = RollingShutter(height=10, readout_ratio=0.5)
    times = shutter.row_time(np.arange(10)[None], np.arange(2)[:, None])
    assert times.shape == (2, 10)
    np.testing.assert_allclose(times[1] - times[0], 1.0, rtol=0, atol=1e-15)


@pytest.mark.parametrize("ratio", [-0.1, 1.1, float("nan")])
def test_ratios_outside_zero_to_one_are_refused(ratio: float) -> None:
    with pytest.raises(ValueError, match="readout_ratio"):
        RollingShutter(height=10, readout_ratio=ratio)


def test_a_shutter_without_rows_is_refused() -> None:
    with pytest.raises(ValueError, match="height"):
        RollingShutter(height=0, readout_ratio=0.5)
