"""Compiled loops over bands of rows, by threads."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
_LEAST_ROWS = 64
"""Of a band: starting a thread costs what some rows do."""
_threads = os.cpu_count() or 1


def set_threads(count: int) -> None:
    """Let this process use so many (one of several that share the cores)."""
    global _threads
    _threads = count


def by_bands(work: Callable[[int, int], T], height: int) -> list[T]:
    """What ``work`` makes of bands of rows, first to last without the last, in their order.

    It runs in threads, so it must let go of the interpreter, and write to no place that another band writes to.
    """
    threads = min(_threads, max(1, height // _LEAST_ROWS))
    bands = 1 if threads == 1 else min(4 * threads, height // _LEAST_ROWS)
    ends = [height * k // bands for k in range(bands + 1)]
    if bands == 1:
        return [work(0, height)]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, ends[:-1], ends[1:]))
