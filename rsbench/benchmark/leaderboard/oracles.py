"""Rows that show how much there is to gain: the truth, and motions that err as little as the data allow.

The second draws its errors from the Cramer-Rao bound of a problem's matches without the outliers: what an unbiased
method that knows them, and uses all their links, could at best do. Both know the truth, and have no rank.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from rsbench.benchmark.leaderboard.protocols import ORACLE
from rsbench.benchmark.leaderboard.splits import Split, exact_problem
from rsbench.benchmark.leaderboard.submissions import submission_text
from rsbench.benchmark.seeds import generator
from rsbench.benchmark.simulated.bound import motion_bound

BOUND = "cramer-rao"
"""Name of the entry."""


def bound_text(split: Split, seed: int) -> str:
    """Motions at the bound, as a submission of the track ``points``; ``seed`` is that of the split."""
    header = {
        "protocol": split.protocol.id,
        "split": split.name,
        "method": BOUND,
        "uses": [ORACLE],
        "description": "The true motion with errors drawn from the Cramer-Rao bound of all that is no outlier",
    }
    return submission_text(header, _answers(split, seed))


def _answers(split: Split, seed: int) -> Iterator[dict[str, Any]]:
    for number, truth in enumerate(split.truths):
        exact, noise_px = exact_problem(seed, number)
        bound = motion_bound(exact.correspondences, truth.rig, truth.shutter, truth.motion, noise_px)
        covariance = bound.covariance
        if covariance is None or not math.isfinite(bound.rotation):
            yield {"name": truth.name, "success": False, "reason": "the matches do not determine the motion"}
            continue
        error = np.linalg.cholesky(covariance) @ generator(seed, "leaderboard", BOUND, number).standard_normal(6)
        yield {
            "name": truth.name,
            "w": (truth.motion.w + error[:3]).tolist(),
            "d": (truth.motion.d + error[3:]).tolist(),
            "metric": True,
            "covariance": covariance.tolist(),
        }
