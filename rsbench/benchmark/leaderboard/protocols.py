"""The protocols of the leaderboard: what a method is given, what it may use, and what is asked; docs/protocols.md.

A protocol never changes: what would change scores is a protocol with another number.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

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
PRIMARY = "auc_5"
"""The score by which methods are ranked."""
FLIP_DEG = 90.0
"""A direction that is wrong by more is the opposite one."""


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
