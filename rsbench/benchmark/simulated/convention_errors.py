"""Errors of convention (axes, units, signs), recognised from a wrong motion and the true one."""

from __future__ import annotations

import numpy as np

from rsbench.core import so3
from rsbench.core.pose_errors import rotation_error, translation_error, translation_of_offset
from rsbench.core.rig import StereoRig
from rsbench.core.so3 import FloatArray

_CLOSE = 0.2
"""Of the motion's angle, and in radians of direction: nearer to one misreading than any two are to each other."""


def misreading(
    w: FloatArray, d: FloatArray, true_w: FloatArray, true_d: FloatArray, rig: StereoRig, point: str
) -> str | None:
    """The mistake that would turn the true motion into the given one; None when no usual one does.

    Args:
        w, d: (3,) the solver's motion.
        true_w, true_d: (3,) the body's true motion.
        rig: where the cameras are.
        point: the point whose translation the solver says ``d`` is.
    """
    # Of the angle of rotation, and in radians.
    errors = {
        words: max(
            float(rotation_error(w, wrong_w)) / max(float(np.linalg.norm(true_w)), 1e-12),
            float(translation_error(d, wrong_d)),
        )
        for words, (wrong_w, wrong_d) in _misreadings(true_w, true_d, rig, point).items()
    }
    words = min(errors, key=lambda key: errors[key])
    return words if words and errors[words] < _CLOSE else None


def _misreadings(
    w: FloatArray, d_body: FloatArray, rig: StereoRig, point: str
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """What each mistake makes of the true motion; the empty words are the truth itself."""
    points = {"body": d_body}
    for side in ("left", "right"):
        points[side] = translation_of_offset(w, d_body, rig.offset(side))
    d = points[point]
    found = {
        "": (w, d),
        "w is inverted: X_body = exp([w]x) X_world + d, with the body that has moved": (-w, d),
        "d is inverted: X_body = exp([w]x) X_world + d, with the body that has moved": (w, -d),
        "w and d both have the opposite sign": (-w, -d),
        "it is the inverse motion: give the pose of the body in frame 1, not of the world in it": (
            -w,
            -so3.exp(-w) @ d,
        ),
        "it has the paper's axes (down, right, forward): swap x and y, and change the sign of w": (
            -w[[1, 0, 2]],
            d[[1, 0, 2]],
        ),
        "x and y are swapped": (w[[1, 0, 2]], d[[1, 0, 2]]),
        "it has axes with y up and z backward: y is down and z forward here": (w * [1, -1, -1], d * [1, -1, -1]),
        "it is mirrored: its axes are left-handed (y up, z forward?)": (w * [-1, 1, -1], d * [1, -1, 1]),
        "w is in degrees: give radians": (np.rad2deg(w), d),
    }
    for other, value in points.items():
        if other != point:
            whose = "body" if other == "body" else f"{other} camera"
            found[f"d is the translation of the {whose}, but the spec says reference_point = {point!r}"] = w, value
    return found
