"""Closing of narrow holes, on holes of known shapes in a ramp of colour."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rsbench.vision.closing import close_narrow
from rsbench.vision.fusion import Fused, Origin


def _frame(holes: np.ndarray, channels: tuple[int, ...] = (3,)) -> tuple[Fused, np.ndarray]:
    """A frame with these holes, and what it would show without them."""
    height, width = holes.shape
    ramp = np.broadcast_to(np.linspace(60, 180, width), (height, width))
    image = np.ascontiguousarray(
        np.broadcast_to(ramp.reshape(height, width, *(1 for _ in channels)), (height, width, *channels))
    )
    true = np.rint(image).astype(np.uint8)
    return Fused.seen(
        np.where(holes.reshape(height, width, *(1 for _ in channels)), 0, true).astype(np.uint8), ~holes
    ), true


@pytest.mark.parametrize("channels", [(), (3,)])
def test_specks_and_slits_are_closed_and_marked_and_regions_stay(channels: tuple[int, ...]) -> None:
    holes = np.zeros((200, 300), dtype=np.bool_)
    holes[20:22, 40:260] = holes[100, 100] = holes[150:200, 296:] = holes[:, 0] = True
    region = np.zeros_like(holes)
    region[60:140, 150:230] = True
    fused, true = _frame(holes | region, channels)
    closed = close_narrow(fused)
    assert set(np.unique(closed.origin[holes])) == {Origin.INVENTED}
    # A step of the ramp is half a grey level, and a hole is five wide at most.
    assert np.abs(closed.image[holes].astype(int) - true[holes]).max() <= 6
    # A disc rounds the corners of a region off.
    inner = closed.origin[62:138, 152:228]
    assert np.all(inner == Origin.NOBODY) and not np.any(closed.image[62:138, 152:228])
    seen = ~(holes | region)
    np.testing.assert_array_equal(closed.image[seen], fused.image[seen])
    np.testing.assert_array_equal(closed.origin[seen], fused.origin[seen])


def test_a_failure_and_a_whole_frame_are_left_alone() -> None:
    holes = np.zeros((50, 60), dtype=np.bool_)
    whole, _ = _frame(holes)
    assert close_narrow(whole) is whole
    failed = replace(_frame(~holes)[0], reason="nothing is known")
    assert close_narrow(failed) is failed
