"""Corrected frames as a person would keep them: holes of known shapes in a ramp of colour, seams along a line."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from rsbench.vision.closing import finished
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
    closed = finished(fused)
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
    assert finished(whole) is whole
    failed = replace(_frame(~holes)[0], reason="nothing is known")
    assert finished(failed) is failed


def _slanted(near: Origin, far: Origin, behind: float) -> tuple[Fused, np.ndarray]:
    """A near thing at 2 m before something, cut along pixels by a slanted line; and what a pixel's area shows."""
    size, fine = 60, 16
    x = (np.arange(size * fine) + 0.5) / fine
    area = (x[None, :] < 20.3 + 0.37 * x[:, None]).reshape(size, fine, size, fine).mean(axis=(1, 3))
    cut = area > 0.5
    image = np.where(cut, 200, 80).astype(np.uint8)
    origin = np.where(cut, np.uint8(near), np.uint8(far))
    depth = np.where(cut, 2.0, behind).astype(np.float32)
    return Fused(image=image, origin=origin, depth=depth), 80.0 + 120.0 * area


@pytest.mark.parametrize("behind", [3.0, np.inf, np.nan])
def test_a_seam_before_something_farther_is_a_line_and_not_a_staircase(behind: float) -> None:
    fused, true = _slanted(Origin.HERE, Origin.OTHER_FRAME, behind)
    even = finished(fused)
    off = [
        np.sqrt(np.mean((image - true) ** 2)) for image in (fused.image.astype(float), even.image.astype(float))
    ]
    assert off[1] < 0.75 * off[0]
    changed = even.image != fused.image
    assert (
        np.array_equal(even.origin, fused.origin) and changed.any(axis=1).all() and changed.sum(axis=1).max() <= 4
    )


@pytest.mark.parametrize(
    ("near", "far", "behind"),
    [
        (Origin.HERE, Origin.HERE, 3.0),  # the frame's own edge, as its optics made it
        (Origin.HERE, Origin.OTHER_FRAME, 2.05),  # one surface
    ],
)
def test_edges_that_are_no_seams_of_depth_stay(near: Origin, far: Origin, behind: float) -> None:
    fused, _ = _slanted(near, far, behind)
    assert finished(fused) is fused


def test_black_does_not_run_into_the_picture() -> None:
    even = finished(_slanted(Origin.HERE, Origin.NOBODY, np.nan)[0])
    black = cv2.dilate((even.origin == Origin.NOBODY).astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    assert np.all(even.image[black & (even.origin == Origin.HERE)] == 200)
