"""Work on other threads: done at the end, errors raised, and never much of it ahead."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from rsbench.dataset.beside import begun, beside
from rsbench.dataset.files import write_bytes
from rsbench.errors import RsbenchError


def test_all_is_done_at_the_end() -> None:
    done: list[int] = []
    with beside() as later:
        for k in range(50):
            later(done.append, k)
    assert sorted(done) == list(range(50))


def test_the_first_error_is_raised_at_the_end(tmp_path: Path) -> None:
    """A full disk, say: the folder of the second file is missing."""
    with pytest.raises(RsbenchError, match="lost"), beside() as later:
        for name in ("a", "lost/b", "c"):
            later(write_bytes, tmp_path / name, b"1")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "c"]


def test_an_error_of_who_hands_over_work_goes_on() -> None:
    with pytest.raises(ZeroDivisionError), beside() as later:
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

    with beside() as later:
        for k, result in enumerate(begun(later, work, range(20))):
            assert result == k * k
            with lock:
                taken += 1
    assert taken == 20 and ahead <= 3
