"""What the correction study compares: baselines, the strongest of each family among them, ours, and oracles."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Method:
    """One line of the table."""

    key: str
    title: str
    kind: str
    """``none``, ``baseline``, ``ours`` or ``oracle``."""
    knows: str
    """What it assumes or is given."""
    slow_scores: bool = False
    """Whether FLIP and the SSIM of others' protocols are computed: of the best of each family."""


METHODS = (
    Method(key="none", title="uncorrected", kind="none", knows="nothing", slow_scores=True),
    Method(key="gyro", title="rotation only, true", kind="baseline", knows="true rotation, as of a perfect gyro"),
    Method(key="rotation", title="rotation only, estimated", kind="baseline", knows="our rotation; no depth"),
    Method(
        key="gs",
        title="GS motion, SGM depth",
        kind="baseline",
        knows="motion solved as if the shutter was global; depth as ours, with that motion",
    ),
    Method(
        key="gs-scaled",
        title="GS motion of scaled matches, SGM depth",
        kind="baseline",
        knows="`gs-stereo-tracks-scaled`: motion as if the shutter was global, of matches scaled to one "
        "frame period by their rows, which suits a twist (the data are linear); depth as ours, with that motion",
        slow_scores=True,
    ),
    Method(
        key="gs-mono",
        title="monocular GS of scaled matches",
        kind="baseline",
        knows="one camera, two frames: `gs-poselib-scaled`, the strongest monocular solver that knows no rolling "
        "shutter but in the scale of its matches; depth from dense flow in the same unit",
    ),
    Method(
        key="mono",
        title="monocular, constant velocity",
        kind="baseline",
        knows="one camera, two frames: its motion up to scale (descending from ours), depth from dense flow in "
        "the same unit",
        slow_scores=True,
    ),
    Method(
        key="plane",
        title="one plane",
        kind="baseline",
        knows="our motion; the plane that fits SGM depth best",
        slow_scores=True,
    ),
    Method(
        key="ours",
        title="ours",
        kind="ours",
        knows="estimated motion; SGM depth, and depth from the motion where SGM finds none",
        slow_scores=True,
    ),
    Method(key="true-motion", title="true motion, SGM depth", kind="oracle", knows="true motion; depth as ours"),
    Method(key="true-depth", title="our motion, true depth", kind="oracle", knows="true depth"),
    Method(key="truth", title="true motion, true depth", kind="oracle", knows="true motion and depth"),
)
