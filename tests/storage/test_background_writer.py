"""Work on other threads: done at the end, errors raised, and never much of it ahead."""

from __future__ import annotations

import gc
import threading
import weakref
from pathlib import Path

import pytest

from rsbench.core.errors import RsbenchError
from rsbench.storage.files import background_writer, begun, write_bytes


def test_all_is_done_at_the_end() -> None:
    done: list[int] = []
    with background_writer() as later:
        for k in range(50):
            later(done.append, k)
    assert sorted(done) == list(range(50))


def test_the_first_error_is_raised(tmp_path: Path) -> None:
    """A full disk, say: the folder of the second file is missing."""
    with pytest.raises(RsbenchError, match="lost"), background_writer() as later:
        for name in ("a", "lost/b", "c"):
            later(write_bytes, tmp_path / name, b"1")
    assert "a" in {path.name for path in tmp_path.iterdir()} <= {"a", "c"}


def test_an_error_is_raised_when_more_is_handed_over() -> None:
    """Not when hours of rendering have been for nothing."""
    handed: list[int] = []
    with pytest.raises(ValueError, match="invalid literal"), background_writer() as later:
        for k in range(1000):
            later(int, "no number")
            handed.append(k)
    assert len(handed) < 100


def test_results_are_not_kept() -> None:
    """A sequence of 30 frames would hold gigabytes."""
    with background_writer() as later:
        results = [weakref.ref(later(_Large).result()) for _ in range(50)]
        later(int, "1").result()
        gc.collect()
        assert sum(each() is not None for each in results) <= 1


def test_a_slow_disk_holds_the_renderer_up() -> None:
    """What waits has arrays: there must not be more and more of it."""
    go, most = threading.Event(), 0
    done: list[int] = []

    def write(k: int) -> None:
        assert go.wait(10.0)
        done.append(k)

    with background_writer() as later:
        threading.Timer(0.2, go.set).start()
        for k in range(40):
            later(write, k)
            most = max(most, k + 1 - len(done))
    assert len(done) == 40 and most <= 8


class _Large:
    pass


def test_an_error_of_who_hands_over_work_goes_on() -> None:
    with pytest.raises(ZeroDivisionError), background_writer() as later:
        later(int, "1")
        raise ZeroDivisionError


def test_results_come_in_order_and_few_are_ahead() -> None:
    lock, begun_by_now, taken, ahead = threading.Lock(), 0, 0, 0

    def work(k: int) -> int:
        nonlocal begun_by_now, ahead
        with lock:
            begun_by_now += 1
            ahead = max(ahead, begun_by_now - taken)
        return k * k

    with background_writer() as later:
        for k, result in enumerate(begun(later, work, range(20))):
            assert result == k * k
            with lock:
                taken += 1
    assert taken == 20 and ahead <= 3
