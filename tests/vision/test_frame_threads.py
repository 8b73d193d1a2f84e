"""How many frames are worked on at once, and what is made ahead."""

from __future__ import annotations

import contextlib
import itertools
import os
import threading
import time
from collections.abc import Iterator

import pytest

from rsbench.vision.frame_threads import ahead, map_ahead, map_frames


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


def test_what_is_made_ahead_comes_in_order_and_a_fault_in_its_place() -> None:
    def numbers() -> Iterator[int]:
        yield from range(5)
        raise ValueError("no more")

    found, made = list[int](), ahead(numbers(), 3)
    with pytest.raises(ValueError, match="no more"):
        found.extend(made)
    assert found == [0, 1, 2, 3, 4]


def test_work_ahead_comes_in_order_and_a_fault_in_its_place() -> None:
    def slow_first(n: int) -> int:
        time.sleep(0.05 * (n == 0))
        return n

    assert list(map_ahead(slow_first, range(6), 2, 2)) == list(range(6))
    with pytest.raises(ZeroDivisionError):
        list(map_ahead(lambda n: 1 // (n - 3), range(6), 2, 2))


def test_who_stops_asking_waits_for_no_more_than_what_runs() -> None:
    made = list[int]()

    def number(n: int) -> int:
        made.append(n)
        time.sleep(0.02)
        return n

    with contextlib.closing(map_ahead(number, itertools.count(), 4, 1)) as asked:
        assert next(asked) == 0
    assert len(made) <= 6
