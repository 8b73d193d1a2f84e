"""How many frames are worked on at once."""

from __future__ import annotations

import os
import threading
import time

import pytest

from rsbench.vision.frame_threads import map_frames


@pytest.mark.parametrize(("pixels", "at_once"), [(10_000, 4), (2_000_000, 2), (50_000_000, 1)])
def test_no_more_than_the_memory_is_for(pixels: int, at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """200 B of each pixel: 1 GB holds two frames of 2 Mpx; one is always worked on."""
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    lock, now, most = threading.Lock(), 0, 0

    def work(item: int) -> int:
        nonlocal now, most
        with lock:
            now += 1
            most = max(most, now)
        time.sleep(0.02)
        with lock:
            now -= 1
        return 2 * item

    assert map_frames(work, range(8), pixels, 200.0) == [0, 2, 4, 6, 8, 10, 12, 14]
    assert most <= at_once
    assert most == at_once or at_once > 1
