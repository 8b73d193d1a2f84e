"""What parts of ``compare_public.py`` share: asking a program, and rows of its tables."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.statistics import median_interval, share_interval
from rsbench.core.camera import PinholeCamera
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

CAMERA = PinholeCamera.centred(900, 900, 810.0)
HEIGHT = 900.0 / 810.0
"""Of the image, in rays: what a readout takes."""
SAME = 1e-6
FREE = RollingShutter(height=900, readout_ratio=0.0)


class Answer(NamedTuple):
    microseconds: float
    solutions: FloatArray
    """(count, numbers)"""


def ask(program: str, method: str, problems: Sequence[FloatArray], repeat: int = 3) -> list[Answer]:
    """Answers of a program to problems (rows, columns)."""
    lines = [" ".join(map(repr, [*each.shape, *each.ravel().tolist()])) for each in problems]
    done = subprocess.run(
        [program, method, str(repeat)], input="\n".join(lines), capture_output=True, text=True, check=True
    )
    answers = []
    for line in done.stdout.splitlines():
        us, count, *numbers = line.split()
        found = np.array(numbers, dtype=np.float64)
        answers.append(Answer(float(us), found.reshape(int(count), -1) if numbers else np.zeros((0, 0))))
    if len(answers) != len(problems):
        raise ValueError(f"{program} {method}: {len(answers)} lines for {len(problems)} problems")
    return answers


def row(
    setting: str, name: str, errors: FloatArray, milliseconds: float, among: Sequence[bool] | None = None
) -> str:
    """A table's row of errors (n, k) of the best solutions, the first in radians and others relative."""
    found = np.all(errors < SAME, axis=1)
    parts = [setting, name, share(found)]
    for column, scale in zip(errors.T, (180.0 / np.pi, *[1.0] * (errors.shape[1] - 1)), strict=True):
        low, high = median_interval(scale * column)
        parts.append(f"{np.median(scale * column):.2g} [{low:.2g}, {high:.2g}]")
    parts += ["" if among is None else share(among), f"{milliseconds:.3g}"]
    return "| " + " | ".join(parts) + " |"


def share(hits: Sequence[bool] | NDArray[np.bool_]) -> str:
    low, high = share_interval(int(np.sum(hits)), len(hits))
    return f"{np.mean(hits):.2f} [{low:.2f}, {high:.2f}]"


def best(errors: Sequence[FloatArray], width: int) -> FloatArray:
    """(n, width): of the errors (count, width) of each problem's solutions those of the least; pi of none."""
    worst = np.array([[np.pi, *[np.inf] * (width - 1)]])
    kept = []
    for each in errors:
        each = np.concatenate([np.nan_to_num(each.reshape(-1, width), nan=np.inf), worst])
        kept.append(each[np.argmin(np.sum(each, axis=1))])
    return np.array(kept)


def relative(found: FloatArray, true: FloatArray) -> FloatArray:
    """Of vectors (..., 3)."""
    return np.asarray(np.linalg.norm(found - true, axis=-1) / np.linalg.norm(true, axis=-1))


def unit(rng: np.random.Generator) -> FloatArray:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def timed(work: Callable[[], object]) -> float:
    """Milliseconds of the processor, the least of three."""
    spent = []
    for _ in range(3):
        start = time.process_time()
        work()
        spent.append(time.process_time() - start)
    return 1e3 * min(spent)
