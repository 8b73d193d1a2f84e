"""What tests of exports share: datasets in closed form, and pixels with the world points that they show."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from analytic_dataset import write_analytic_dataset

from rsbench.components.motion_models import LinearMotion
from rsbench.core import so3
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.motion import Motion
from rsbench.core.rig import Side, StereoRig
from rsbench.core.shutter import Scanning
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.interop.writers.exporter import export_dataset
from rsbench.interop.writers.sequence_views import Images

WIDTH, HEIGHT = 64, 49
"""Row 24 is the middle of the readout."""
MOTION = LinearMotion([0.02, -0.03, 0.04], [0.2, -0.1, 0.15])
LENSES = {
    "none": None,
    "brown": Lens(model="brown-conrady", k1=-0.1, k2=0.02, p1=0.001, p2=-0.002),
    "brown-k3": Lens(model="brown-conrady", k1=-0.1, k2=0.02, p1=0.001, p2=-0.002, k3=0.005),
    "fisheye": Lens(model="kannala-brandt", k1=-0.03, k2=0.01, k3=-0.002, k4=0.0005),
    "rational": Lens(model="rational", k1=0.1, k2=0.01, p1=0.001, k4=0.15, k5=0.02),
}
RIGHT = PinholeCamera(width=80, height=45, fx=75.0, fy=74.0, cx=41.0, cy=20.5)
TURN, PLACE = np.array([0.03, -0.06, 0.05]), np.array([-0.3, 0.02, -0.03])
"""Rotation vector and translation, ``X_right = R X_left + t``, of rigs of ``dataset`` with a ``right`` lens."""
SAME_PX = 1e-6
"""What reading our own numbers back may cost: rounding is below 1e-9."""


def dataset(
    out: Path,
    lens: str = "none",
    motion: Motion = MOTION,
    readout: float = 0.8,
    frames: int = 2,
    right: str = "",
    **scanning: Any,
) -> Path:
    """Write a dataset of one sequence, ``planes``, with the twin of the middle row of cameras of one size.

    With the lens of a ``right`` camera the rig is a general one.
    """
    camera = PinholeCamera(width=WIDTH, height=HEIGHT, fx=60.0, fy=61.0, cx=30.5, cy=25.0, lens=LENSES[lens])
    rig = StereoRig(camera=camera, baseline=0.3)
    if right:
        rig = StereoRig.of_cameras(camera, replace(RIGHT, lens=LENSES[right]), so3.exp(TURN), PLACE)
    shutter = rig.shutter_of(Scanning(**scanning), readout)
    write_analytic_dataset(out, rig, shutter, motion, frames=frames, twins=() if right else (HEIGHT // 2,))
    return out


def only(folder: Path) -> Sequence:
    (sequence,) = read_dataset(folder)
    return sequence


def exported(folder: Path, name: str, out: Path, images: Images | None = None) -> tuple[Path, dict[str, Any]]:
    """Export; the folder, and what export.json says of the sequence."""
    export_dataset(folder, name, out, images=images)
    return out, json.loads((out / "export.json").read_text())["sequences"]["planes"]


class Seen(NamedTuple):
    """Pixels of one image and what they show."""

    pixels: FloatArray
    """(n, 2) whole, ours: (0, 0) is the centre of the first."""
    world: FloatArray
    """(n, 3)"""
    lines: FloatArray
    """(n,) rows, or columns."""


def seen(
    sequence: Sequence, side: Side, frame: int, images: Images, rows: tuple[int, ...] = (0, 7, 24, 48)
) -> Seen:
    """World points of some pixels by the depth and the poses that the files of the dataset hold."""
    height = sequence.rig.sensor(side).height
    kept = np.array([row for row in rows if row < height])
    x, y = (part.reshape(-1) for part in np.meshgrid(np.arange(3, WIDTH, 12), kept))
    pixels = np.stack([x, y], axis=-1).astype(np.float64)
    _, poses = sequence.poses(side, frame)
    lines = pixels[:, sequence.shutter.axis(side)].astype(int)
    at = np.full_like(lines, sequence.shutter.first_line(side)) if images == "gs" else lines
    z = sequence.depth(images, side, frame)[y, x].astype(np.float64)
    x_in_cam = z[:, None] * sequence.rig.sensor(side).unproject(pixels)
    world = np.einsum("nji,nj->ni", poses.R[at], x_in_cam - poses.t[at])
    return Seen(pixels, world, lines.astype(np.float64))


def opencv_pixels(x_in_cam: FloatArray, K: FloatArray, lens: str) -> FloatArray:
    """Pixels (n, 2) of points (n, 3) in a camera, by OpenCV's own models of a lens."""
    shown, zero = LENSES[lens], np.zeros(3)
    points = np.ascontiguousarray(x_in_cam[:, None])
    if shown is not None and shown.model == "kannala-brandt":
        found, _ = cv2.fisheye.projectPoints(
            points, zero, zero, K, np.array([shown.k1, shown.k2, shown.k3, shown.k4])
        )
        return found[:, 0]
    values = np.zeros(5) if shown is None else np.array(shown.coefficients)
    found, _ = cv2.projectPoints(points, zero, zero, K, values)
    return found[:, 0]
