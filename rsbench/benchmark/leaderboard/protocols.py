"""The protocols of the leaderboard: what a method is given, what it may use, what is asked; docs/protocols.md.

A protocol never changes: what would change scores is a protocol with another number.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

from rsbench.cards import choices
from rsbench.errors import RsbenchError

KNOWLEDGE = {
    "left": "matches over time of the left camera",
    "right": "matches over time of the right camera",
    "links": "which matches of the two cameras are of one point",
    "readout": "the readout ratio",
    "images": "the images, and with them matches of its own",
    "gyro": "the angular rates of a gyroscope",
    "truth": "the truth: an oracle, which has no rank",
}
"""What methods use, in the order of tables."""
ORACLE = "truth"
AUC_DEG = (1, 5, 10)
"""Thresholds of the areas under the curve of max(e_R, e_T)."""
AUC_READOUT = {"auc_r10": 0.1, "auc_r02": 0.02}
"""The same of the error of a readout ratio, by the name of the column."""
FLIP_DEG = 90.0
"""A direction that is wrong by more is the opposite one."""
SUCCESS_DEG = (1.0, 5.0)
"""A success errs by less in rotation and direction, as in the sweeps of simulated points."""


@dataclass(frozen=True, kw_only=True)
class Score:
    """A column of scores.csv that tables show."""

    key: str
    title: str
    hint: str
    """What it is, in a line."""
    kind: Literal["share", "median"]
    """A share lies in [0, 1]: its mean over scenes has an interval. Of others the median over problems is told."""
    better: Literal["lower", "higher"] = "lower"


_FAILED = Score(key="failure", title="failed", hint="share of problems without an answer", kind="share")
_SECONDS = Score(key="seconds", title="s", hint="median time of a problem, as stated", kind="median")
_MOTION = (
    *(
        Score(
            key=f"auc_{limit}",
            title=f"AUC@{limit}",
            hint=f"area under the curve of max(e_R, e_T) to {limit} deg",
            kind="share",
            better="higher",
        )
        for limit in (5, 1, 10)
    ),
    Score(
        key="within", title="success", hint="share with e_R < 1 deg and e_T < 5 deg", kind="share", better="higher"
    ),
    Score(key="flip", title="flips", hint="share with e_T above 90 deg", kind="share"),
    _FAILED,
    Score(key="e_R_deg", title="e_R (deg)", hint="median angle of the rotation", kind="median"),
    Score(key="e_T_deg", title="e_T (deg)", hint="median angle of the translation", kind="median"),
    Score(key="e_row_deg", title="e_row (deg)", hint="median of the largest angle of a row's pose", kind="median"),
    Score(key="e_s", title="e_s", hint="median |log| of the length, where metres are claimed", kind="median"),
    Score(key="metres", title="metres", hint="median distance of d from the truth, where claimed", kind="median"),
    _SECONDS,
)
_READOUT = (
    *(
        Score(
            key=key,
            title=f"AUC@{limit:g}",
            hint=f"area under the curve of the error of the readout ratio to {limit:g}",
            kind="share",
            better="higher",
        )
        for key, limit in AUC_READOUT.items()
    ),
    _FAILED,
    Score(key="e_readout", title="error", hint="median error of the readout ratio", kind="median"),
    _SECONDS,
)


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """One way of asking for motions."""

    track: str
    """Name on the command line."""
    id: str
    """With the number of the protocol; what submissions name."""
    title: str
    allowed: tuple[str, ...]
    """What of ``KNOWLEDGE`` it gives."""
    given: str
    """The inputs, in words."""
    asks: Literal["motion", "readout"] = "motion"
    """What an answer is."""

    @property
    def scores(self) -> tuple[Score, ...]:
        """Of its tables; methods are ranked by the first."""
        return _MOTION if self.asks == "motion" else _READOUT

    @property
    def primary(self) -> Score:
        """By which methods are ranked: the higher the better."""
        return self.scores[0]

    @property
    def error(self) -> str:
        """The column of scores.csv that decides about the primary score."""
        return "error_deg" if self.asks == "motion" else "e_readout"

    def of_kind(self, kind: Literal["share", "median"]) -> tuple[str, ...]:
        """Keys of the scores of a kind."""
        return tuple(score.key for score in self.scores if score.kind == kind)

    def check_uses(self, uses: Collection[str]) -> None:
        """Raises ValueError when a method uses what does not exist, or what this protocol does not give."""
        for name in uses:
            if name not in KNOWLEDGE:
                raise ValueError(f"uses: {name!r} is unknown{choices(name, KNOWLEDGE)}")
            if name not in (*self.allowed, ORACLE):
                raise ValueError(
                    f"uses: {name!r} is not given by {self.id}, which gives {', '.join(self.allowed)}"
                )
        if not uses:
            raise ValueError(f"uses: must name what the method works on, of {', '.join(self.allowed)}")


PROTOCOLS = {
    protocol.track: protocol
    for protocol in (
        Protocol(
            track="points",
            id="points-1",
            title="Motion from simulated matches",
            allowed=("left", "right", "links", "readout"),
            given="tracks of random points, with noise and outliers",
        ),
        Protocol(
            track="pose",
            id="pose-1",
            title="Motion from given matches of rendered frames",
            allowed=("left", "right", "links", "readout"),
            given="matches of the frames by rsbench's SIFT",
        ),
        Protocol(
            track="pose-own",
            id="pose-own-1",
            title="Motion from rendered frames",
            allowed=("left", "right", "links", "readout", "images"),
            given="the four rolling-shutter frames",
        ),
        Protocol(
            track="readout",
            id="readout-1",
            title="Readout ratio from given matches of rendered frames",
            allowed=("left", "right", "links"),
            given="matches of the frames by rsbench's SIFT, without the readout ratio",
            asks="readout",
        ),
    )
}
"""By track."""


def protocol_of_track(track: str) -> Protocol:
    """Raises RsbenchError: there is no such track."""
    if track not in PROTOCOLS:
        raise RsbenchError(f"track {track!r} does not exist{choices(track, PROTOCOLS)}")
    return PROTOCOLS[track]


def protocol_of_id(name: str) -> Protocol:
    """Raises RsbenchError: there is no such protocol."""
    known = {protocol.id: protocol for protocol in PROTOCOLS.values()}
    if name not in known:
        raise RsbenchError(f"protocol = {name!r}: does not exist{choices(name, known)}")
    return known[name]
