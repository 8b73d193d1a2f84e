"""The protocols of the leaderboard: what a method is given, what it may use, what is asked (docs/reference).

A protocol never changes: what would change scores is a protocol with another number.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

from rsbench.components.cards import choices
from rsbench.core.errors import RsbenchError

KNOWLEDGE = {
    "left": "matches over time of the left camera",
    "right": "matches over time of the right camera",
    "links": "which matches of the two cameras are of one point",
    "readout": "the readout ratio",
    "images": "the images, and with them matches of its own",
    "stereo": "images of the other camera",
    "time": "images of the other time",
    "gyro": "the angular rates of a gyroscope",
    "gravity": "the direction of gravity",
    "affine": "the affine frames of matches over time of the left camera",
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
Asks = Literal["motion", "readout", "depth", "frames"]
Kind = Literal["share", "median"]


@dataclass(frozen=True, kw_only=True)
class Score:
    """A column of scores.csv that tables show."""

    key: str
    title: str
    hint: str
    """What it is, in a line."""
    kind: Kind
    """A share lies in [0, 1]: its mean over scenes has an interval. Of others the median over problems is told."""
    better: Literal["lower", "higher"] = "lower"

    @property
    def sign(self) -> float:
        """What makes more of it better."""
        return 1.0 if self.better == "higher" else -1.0


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
_DEPTH = (
    Score(
        key="bad_1",
        title="bad@1",
        hint="share of surface wrong by over 1 px of disparity or unknown",
        kind="share",
    ),
    *(
        Score(key=f"bad_{limit}", title=f"bad@{limit}", hint=f"the same beyond {limit} px", kind="share")
        for limit in (2, 3)
    ),
    Score(key="bad_1_visible", title="bad@1 visible", hint="bad@1 of what the right camera sees", kind="share"),
    Score(key="bad_1_occluded", title="bad@1 occluded", hint="bad@1 of what it does not see", kind="share"),
    Score(key="coverage", title="known", hint="share of surface with a depth", kind="share", better="higher"),
    Score(key="on_sky", title="on sky", hint="share of pixels without a surface that have a depth", kind="share"),
    _FAILED,
    Score(key="abs_rel", title="AbsRel", hint="median of the mean relative error, where known", kind="median"),
    Score(
        key="rmse_m", title="RMSE (m)", hint="median of the root mean squared error, where known", kind="median"
    ),
    *(
        Score(key=f"{key}_{part}", title=f"{title} {part}", hint=f"{title} of the {part} part", kind="median")
        for part in ("visible", "occluded")
        for key, title in (("abs_rel", "AbsRel"), ("rmse_m", "RMSE"))
    ),
    _SECONDS,
)
_FRAMES = (
    Score(key="ssim", title="SSIM", hint="of the common pixels, at least 0", kind="share", better="higher"),
    Score(key="ssim_covered", title="SSIM covered", hint="of what it drew itself", kind="share", better="higher"),
    Score(key="ssim_all", title="SSIM all", hint="of the whole image", kind="share", better="higher"),
    Score(key="coverage", title="drawn", hint="share of the common pixels drawn", kind="share", better="higher"),
    _FAILED,
    Score(key="psnr", title="PSNR (dB)", hint="median, of the common pixels", kind="median", better="higher"),
    *(
        Score(key=f"psnr_{part}", title=f"PSNR {part}", hint=words, kind="median", better="higher")
        for part, words in (
            ("covered", "of what it drew itself"),
            ("all", "of the whole image"),
            ("first", "of the first row's time, common pixels"),
            ("middle", "of the middle row's time, common pixels"),
        )
    ),
    *(
        Score(key=f"flip_{part}", title=f"FLIP {part}", hint=f"median, of {words}", kind="median")
        for part, words in (("common", "the common pixels"), ("covered", "what it drew"), ("all", "all pixels"))
    ),
    Score(key="epe_px", title="EPE (px)", hint="median flow to the truth, common and drawn pixels", kind="median"),
    Score(
        key="ssim_deepunroll",
        title="SSIM DeepUnrollNet",
        hint="of the whole image as DeepUnrollNet, RSSR, CVR and QRSC compute it",
        kind="median",
        better="higher",
    ),
    Score(
        key="ssim_uniform",
        title="SSIM uniform",
        hint="of the whole image with scikit-image's default window",
        kind="median",
        better="higher",
    ),
    _SECONDS,
)
_MATCHES = (
    Score(key="matches", title="matches", hint="median number of own matches", kind="median", better="higher"),
    Score(
        key="matches_1px",
        title="right matches",
        hint="median share of own matches within 1 px of the truth",
        kind="median",
        better="higher",
    ),
)
_SCORES: dict[Asks, tuple[Score, ...]] = {
    "motion": _MOTION,
    "readout": _READOUT,
    "depth": _DEPTH,
    "frames": _FRAMES,
}
_ERRORS: dict[Asks, str] = {"motion": "error_deg", "readout": "e_readout", "depth": "bad_1", "frames": "error"}


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """One way of asking for motions, or for pictures."""

    track: str
    """Name on the command line."""
    id: str
    """With the number of the protocol; what submissions name."""
    title: str
    allowed: tuple[str, ...]
    """What of ``KNOWLEDGE`` it gives."""
    given: str
    """The inputs, in words."""
    asks: Asks = "motion"
    """What an answer is."""

    @property
    def pictures(self) -> bool:
        """Whether an answer is made of pictures beside the file of answers."""
        return self.asks in ("depth", "frames")

    @property
    def own_matches(self) -> bool:
        """Whether matches may be handed in with motions."""
        return self.asks == "motion" and "images" in self.allowed

    @property
    def scores(self) -> tuple[Score, ...]:
        """Of its tables; methods are ranked by the first."""
        return _SCORES[self.asks] + (_MATCHES if self.own_matches else ())

    @property
    def primary(self) -> Score:
        """By which methods are ranked."""
        return self.scores[0]

    @property
    def error(self) -> str:
        """The column of scores.csv that decides about the primary score."""
        return _ERRORS[self.asks]

    def of_kind(self, kind: Kind) -> tuple[str, ...]:
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
        if len(set(uses)) < len(uses):
            raise ValueError("uses: names something twice; once is enough")


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
        Protocol(
            track="depth",
            id="depth-1",
            title="Depth of rolling-shutter frames",
            allowed=("readout", "images", "stereo", "time"),
            given="the four rolling-shutter frames",
            asks="depth",
        ),
        Protocol(
            track="correction",
            id="correction-1",
            title="Corrected frames",
            allowed=("readout", "images", "stereo", "time"),
            given="the four rolling-shutter frames",
            asks="frames",
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
