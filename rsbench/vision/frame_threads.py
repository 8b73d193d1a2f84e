"""Work on several frames at once: the same on all, as many as the memory is for, or what comes next ahead."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")
_BYTES = 1e9
"""What frames that are worked on at once may take: correcting four of full HD stays below 2 GB."""


def map_frames(work: Callable[[T], R], items: Iterable[T], pixels: int, bytes_per_pixel: float) -> list[R]:
    """``work`` on each item, by threads: no more than there are cores, and at least one.

    Args:
        pixels: of one frame.
        bytes_per_pixel: memory that one ``work`` needs while it runs, measured.
    """
    most = max(1, min(os.cpu_count() or 1, int(_BYTES / (pixels * bytes_per_pixel))))
    with ThreadPoolExecutor(most) as pool:
        return list(pool.map(work, items))


def ahead(items: Iterator[T], most: int) -> Iterator[T]:
    """The items, in order, of which a thread makes up to ``most`` before they are asked for."""
    last, pool = object(), ThreadPoolExecutor(1)
    waiting = deque(pool.submit(next, items, last) for _ in range(most))
    try:
        while (item := waiting.popleft().result()) is not last:
            waiting.append(pool.submit(next, items, last))
            yield item  # pyrefly: ignore[invalid-yield]
    finally:  # an interrupt does not wait for what runs
        pool.shutdown(wait=False, cancel_futures=True)


def map_ahead(work: Callable[[T], R], items: Iterable[T], most: int, threads: int) -> Generator[R]:
    """``work`` on each item, in order, by threads; up to ``most`` wait for those before them."""
    waiting, pool = deque[Future[R]](), ThreadPoolExecutor(threads)
    try:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) > most:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
