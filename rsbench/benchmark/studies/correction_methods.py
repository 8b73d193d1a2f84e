"""What the correction study compares: baselines, the strongest of each family among them, ours, and oracles."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Method:
    """One line of the table."""

    key: str
    title: str
    kind: str
    """``none``, ``baseline``, ``ours``, ``law`` (ours, told a law of motion) or ``oracle``."""
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
        "frame period by their rows, which suits a twist; depth as ours, with that motion",
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
        knows="estimated motion, of the law that the matches prefer; SGM depth, and depth from the motion where "
        "SGM finds none",
        slow_scores=True,
    ),
    Method(key="linear", title="ours, linear", kind="law", knows="the same, told that the motion is `linear`"),
    Method(key="twist", title="ours, twist", kind="law", knows="the same, told that the motion is a `twist`"),
    Method(key="true-motion", title="true motion, SGM depth", kind="oracle", knows="true motion; depth as ours"),
    Method(key="true-depth", title="our motion, true depth", kind="oracle", knows="true depth"),
    Method(key="truth", title="true motion, true depth", kind="oracle", knows="true motion and depth"),
)
ON_REQUEST = (
    Method(
        key="gyroscope",
        title="rotation only, measured",
        kind="baseline",
        knows="what the gyroscope of the channel `imu` measured, with its noise, bias and clock; no depth",
    ),
    Method(
        key="zhuang",
        title="monocular, Zhuang et al.",
        kind="baseline",
        knows="one camera, two frames: its motion by `rs-zhuang-8pt`, depth from dense flow in the same unit",
    ),
    Method(
        key="vasu-layers",
        title="monocular, Vasu et al.",
        kind="baseline",
        knows="one camera, two frames: planes of one depth each, and its motion, in turn",
    ),
    Method(key="lao-lines", title="lines, Lao et al.", kind="baseline", knows="one image: curves that were lines"),
    Method(
        key="purkait-manhattan",
        title="Manhattan, Purkait et al.",
        kind="baseline",
        knows="one image: lines along three orthogonal directions",
    ),
)
"""Methods that a study has when it is asked for them: docs/explanation/correctors.md compares them."""


def methods_among(keys: Collection[str]) -> list[Method]:
    """The methods of these keys, in the order of tables."""
    return [method for method in (*METHODS, *ON_REQUEST) if method.key in keys]
