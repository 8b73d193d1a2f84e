"""Rigs of two cameras that differ in size, lens and orientation, and shutters of theirs."""

from __future__ import annotations

import numpy as np

from rsbench.core import so3
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import Scanning

LEFT = PinholeCamera(
    width=640,
    height=480,
    fx=520.0,
    fy=521.0,
    cx=315.0,
    cy=242.0,
    lens=Lens(model="brown-conrady", k1=-0.2, p1=1e-3),
)
RIGHT = PinholeCamera(
    width=1280, height=720, fx=905.0, fy=903.0, cx=650.0, cy=355.0, lens=Lens(model="kannala-brandt", k1=0.02)
)


def rig_of(w: tuple[float, float, float], t: tuple[float, float, float] = (-0.25, 0.01, -0.02)) -> StereoRig:
    """The rig whose right camera is turned by w, rad, and stands at -t, metres, nearly."""
    return StereoRig.of_cameras(LEFT, RIGHT, so3.exp(np.array(w)), t)


LENSES = {
    "brown-conrady": Lens(model="brown-conrady", k1=-0.25, k2=0.06, p1=0.004, p2=-0.003),
    "kannala-brandt": Lens(model="kannala-brandt", k1=-0.06, k2=0.01),
    "rational": Lens(
        model="rational", k1=0.9, k2=0.06, p1=-0.0004, p2=0.0002, k3=0.001, k4=1.25, k5=0.22, k6=0.006
    ),
    "double-sphere": Lens(model="double-sphere", xi=-0.18, alpha=0.59),
}
"""One of each model, for cameras of some 60 degrees."""
RIGS = {
    "turned": rig_of((0.01, -0.03, 0.02)),
    "vertical": rig_of((0.01, 0.0, 0.02), (0.01, -0.25, 0.01)),
    "toed in": rig_of((0.0, 0.06, 0.02)),
}
SCANS = {
    "rows": Scanning(),
    "late": Scanning(right_delay=0.1),
    "columns": Scanning(right_scan="left"),
    "global right": Scanning(right_readout_ratio=0.0),
}
