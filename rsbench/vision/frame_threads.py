"""The same work on several frames at once, as many as the memory is for."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
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
