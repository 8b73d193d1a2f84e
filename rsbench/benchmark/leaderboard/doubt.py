"""Entries that are more accurate than their data allow are in doubt: they are not ranked until the board's keeper
accepts them.

An entry is in doubt for two reasons: an error that is zero up to rounding in a tenth of the problems, or errors
below the Cramer-Rao bound of the data that the method states to use. The error of an unbiased method is below the
median at the bound in at most half of the problems. Each error of a track is tested separately. If no bound is
known, as for rendered frames, a submission of the true values with a small error is not detected; to be sure, the
keeper must run the method.
"""

from __future__ import annotations

import re

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rsbench.benchmark.leaderboard.track import ORACLE, Header, Split
from rsbench.benchmark.statistics import share_interval
from rsbench.benchmark.trajectory_scores import METHODS
from rsbench.components.cards import list_cards
from rsbench.core.errors import RsbenchError

COVERAGE = 0.999
"""Coverage of the interval that must exclude one half: 1 of 2000 unbiased methods at the bound is put in doubt."""
_EXACT_SHARE = 0.1
"""Largest share of problems in which an error may be zero up to rounding."""
_ORACLES = (ORACLE, "cramer-rao", "constant", "uncorrected", "fusion-true")
_BUILT_IN = ("rs-stereo", "rs-stereo-auto", "sgm", "sweep", "fusion")
"""Names of former entries, in addition to those of cards."""


def outline(name: str) -> str:
    """A name reduced to its appearance: without case and separators, and with 0 = o and 1 = i = l."""
    return re.sub("[._-]+", "-", name.lower()).strip("-").translate(str.maketrans("01i", "oll"))


def refuse_reserved(header: Header, where: str) -> None:
    """Refuse a submission with the name of a method of rsbench, or one that uses the ground truth.

    Raises:
        RsbenchError: the name reads like one of rsbench's own, or ``uses`` names the truth.
    """
    method, kinds = header.method, ("solvers", "matchers", "correctors")
    own = {*_ORACLES, *_BUILT_IN, *METHODS, *(name for kind in kinds for name in list_cards(kind))}
    if outline(method) in {outline(name) for name in own}:
        raise RsbenchError(
            f"{where}: method = {method!r}: is the name of a method of rsbench, or looks like it; choose another, "
            f"such as '{method}-mine'"
        )
    if ORACLE in header.uses:
        raise RsbenchError(
            f"{where}: uses = {ORACLE!r}: only oracles of rsbench know the truth (rsbench leaderboard oracles); "
            "name the data that the method works on"
        )


def doubt_about(scores: pd.DataFrame, header: Header, split: Split) -> str:
    """The reason why an entry is in doubt, in one line; empty if it is not."""
    if ORACLE in header.uses:
        return ""
    track = split.track
    for column, below in track.exact.items():
        exact = np.asarray(scores[column].to_numpy(dtype=np.float64) < below)
        if np.count_nonzero(exact) > _EXACT_SHARE * len(exact):
            return f"{column} is below {below:g}, exact but for rounding, in {_words(exact, 0.95)} of the problems"
    for name, medians in track.medians_at_bound(header.uses, split).items():
        known = np.isfinite(medians)
        nearer = scores[name].to_numpy(dtype=np.float64)[known] < medians[known]
        if share_interval(int(np.count_nonzero(nearer)), len(nearer), COVERAGE).low > 0.5:
            return (
                f"{name} is below the median at the Cramer-Rao bound of {' + '.join(header.uses)} in "
                f"{_words(nearer, COVERAGE)} of the problems; without bias it is so in half of them at most"
            )
    return ""


def _words(hits: NDArray[np.bool_], coverage: float) -> str:
    count = int(np.count_nonzero(hits))
    low, high = share_interval(count, len(hits), coverage)
    return f"{count / len(hits):.2f} [{low:.2f}, {high:.2f}]"
