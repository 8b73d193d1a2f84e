"""Work on other threads while this one goes on: the renderer's, whose kernels leave cores idle between them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from itertools import islice
from typing import Any, TypeVar

T = TypeVar("T")
R = TypeVar("R")
Later = Callable[..., "Future[Any]"]
"""Called with a function and its arguments: it is called soon."""
_THREADS = 2
_WAITING = 8
"""Jobs at most that are not done: each may hold a frame's arrays, and a disk may be slower than the renderer."""


@contextmanager
def background_writer() -> Iterator[Later]:
    """Gives what hands work to other threads. At the end all of it is done.

    The first error is raised at the end, or when more work is handed over; results are kept by who asked alone.
    """
    with ThreadPoolExecutor(_THREADS) as pool:
        jobs: deque[Future[Any]] = deque()

        def later(work: Callable[..., Any], *given: Any) -> Future[Any]:
            while jobs and (jobs[0].done() or len(jobs) >= _WAITING):
                jobs.popleft().result()
            jobs.append(pool.submit(work, *given))
            return jobs[-1]

        yield later
        while jobs:
            jobs.popleft().result()


def begun(later: Later, work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """``work`` on each item, in order. The first are begun now, the others as results are taken."""
    rest = iter(items)
    waiting = deque(later(work, item) for item in islice(rest, _THREADS))

    def results() -> Iterator[R]:
        while waiting:
            first = waiting.popleft()
            yield first.result()
            waiting.extend(later(work, item) for item in islice(rest, 1))

    return results()
