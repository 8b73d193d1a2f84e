"""The row-time formula: tau = frame + readout_ratio * y / height."""

from __future__ import annotations

import numpy as np
import pytest

from rsbench.core.shutter import RollingShutter, Scan


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


@pytest.mark.parametrize("ratio", [-0.1, 1.1, float("nan")])
def test_ratios_outside_zero_to_one_are_refused(ratio: float) -> None:
    with pytest.raises(ValueError, match="readout_ratio"):
        RollingShutter(height=10, readout_ratio=ratio)


def test_a_shutter_without_rows_is_refused() -> None:
    with pytest.raises(ValueError, match="height"):
        RollingShutter(height=0, readout_ratio=0.5)


@pytest.mark.parametrize(
    ("scan", "first", "last"),
    [("top", (3, 0), (3, 7)), ("bottom", (3, 7), (3, 0)), ("left", (0, 5), (9, 5)), ("right", (9, 5), (0, 5))],
)
def test_each_scan_begins_at_its_side(scan: Scan, first: tuple[int, int], last: tuple[int, int]) -> None:
    shutter = RollingShutter(height=8, width=10, readout_ratio=0.5, scan=scan)
    lines = 8 if scan in ("top", "bottom") else 10
    assert shutter.pixel_time(first, 1, "left") == 1.0
    # The last line begins one line delay before all are read.
    assert shutter.pixel_time(last, 1, "left") == pytest.approx(1.0 + 0.5 * (lines - 1) / lines, rel=1e-15)
    assert shutter.lines("left") == len(shutter.line_times(0, "left")) == lines
    step = shutter.pixel_time([4.5, 2.25], 0, "right") - shutter.pixel_time([4.0, 2.0], 0, "right")
    assert step == pytest.approx(shutter.rate("right") @ [0.5, 0.25], rel=1e-12)


def test_the_right_camera_may_be_late_and_read_another_way() -> None:
    shutter = RollingShutter(height=8, width=10, readout_ratio=0.5, right_scan="bottom", right_delay=0.25)
    np.testing.assert_array_equal(shutter.line_times(0, "left"), 0.5 / 8 * np.arange(8))
    np.testing.assert_array_equal(shutter.line_times(0, "right"), 0.25 + 0.5 / 8 * np.arange(8)[::-1])
    assert shutter.start(1, "right") == 1.25
    assert not (shutter.plain or shutter.rows_together)
    with pytest.raises(ValueError, match=r"right_delay = 0\.25: only rows from the top"):
        shutter.row_time(0, 0)


def test_rows_from_the_bottom_in_both_cameras_are_read_together() -> None:
    shutter = RollingShutter(height=8, readout_ratio=0.5, scan="bottom")
    assert shutter.rows_together and not shutter.plain


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"scan": "up"}, "scan = 'up': must be one of 'top', 'bottom', 'left', 'right'"),
        ({"right_scan": "both"}, "right_scan = 'both'"),
        ({"right_scan": "left"}, "width must be given where columns are read"),
        ({"right_delay": 1.5}, "right_delay = .*: must be a number from -1 to 1"),
        ({"right_delay": float("nan")}, "right_delay = .*: must be a number from -1 to 1"),
        ({"width": 0}, "shutter width = 0: must be a whole number from 1"),
    ],
)
def test_shutters_that_cannot_be_are_refused_by_name(values: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RollingShutter(**{"height": 10, "readout_ratio": 0.5, **values})  # pyrefly: ignore[bad-argument-type]
