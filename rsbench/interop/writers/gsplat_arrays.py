"""gsplat: the two view matrices of each frame between which its rasterizer interpolates the rows.

Convention, of ``gsplat.rasterization`` and ``gsplat/cuda/_torch_cameras.py``: ``viewmats`` are
``cam_from_world`` of the line that is read first, ``viewmats_rs`` of the one that is read last; the line of a
pixel is at ``floor(y) / (height - 1)`` of the way (``(height - ceil(y)) / (height - 1)`` from the bottom;
columns likewise), where y = 0.5 is the centre of row 0; translations go linearly, rotations along their arc.
Both are those of our model ``linear``. Lenses are OpenCV's, and a line is that of the distorted pixel, as ours.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rsbench.core import so3
from rsbench.core.lens import Lens
from rsbench.core.rig import SIDES, Side
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import Sequence
from rsbench.interop.writers import row_motion_error
from rsbench.interop.writers.image_poses import (
    Images,
    View,
    about_moving_objects,
    copy_image,
    corner_matrix,
    first_second,
    line_poses,
    matrix,
)
from rsbench.interop.writers.surface_points import Points
from rsbench.storage.files import save_arrays, write_json

ABOUT = (
    "SEQUENCE/left.npz and right.npz hold the arrays that gsplat.rasterization takes, left.json and "
    "right.json its other arguments and the images in their order, SEQUENCE/images the images. Pixels have "
    "(0, 0) in the corner of the image. With rolling-shutter frames viewmats are the poses of the lines "
    "read first, viewmats_rs of those read last. Distortion and rolling shutter need with_ut = True and "
    "with_eval3d = True."
)
LAW = (
    "relative time of a line = lines read before it / (lines - 1); translation of cam_from_world linear, rotation "
    "along its arc"
)
_SHUTTERS = {
    "top": ("ROLLING_TOP_TO_BOTTOM", 0),
    "left": ("ROLLING_LEFT_TO_RIGHT", 1),
    "bottom": ("ROLLING_BOTTOM_TO_TOP", 2),
    "right": ("ROLLING_RIGHT_TO_LEFT", 3),
}
"""Names and values of gsplat's ``RollingShutterType`` by the side at which reading begins."""
_GLOBAL = ("GLOBAL", 4)


def check(sequence: Sequence, images: Images) -> None:
    """gsplat knows all our scans and lenses; each camera has arrays of its own."""


def write(sequence: Sequence, root: Path, images: Images) -> dict[str, Any]:
    """The files of one sequence in a folder of its name below ``root``; what has to be said of them."""
    folder = root / sequence.name
    folder.mkdir(parents=True)
    for side in SIDES:
        views = [View(side, frame) for frame in range(sequence.frames)]
        save_arrays(folder / f"{side}.npz", _arrays(sequence, views, images))
        write_json(folder / f"{side}.json", _arguments(sequence, views, images))
        for view in views:
            copy_image(sequence, view, images, folder / "images" / view.name)
    if images == "gs":
        return {"told": about_moving_objects(sequence)}
    views = [View(side, frame) for side in SIDES for frame in range(sequence.frames)]
    error = row_motion_error.largest_error(sequence, views, lambda view, points: _seen(sequence, view, points))
    return {
        "largest_row_error_px": error,
        "told": row_motion_error.told(error, LAW) + about_moving_objects(sequence),
    }


def ends(sequence: Sequence, view: View) -> tuple[Pose, Pose]:
    """``cam_from_world`` of the lines that are read first and last."""
    poses, first = line_poses(sequence, view), sequence.shutter.first_line(view.side)
    last = sequence.shutter.lines(view.side) - 1 - first
    return Pose(poses.R[first], poses.t[first]), Pose(poses.R[last], poses.t[last])


def _arrays(sequence: Sequence, views: list[View], images: Images) -> dict[str, FloatArray]:
    camera, count = sequence.rig.camera, len(views)
    both = [[matrix(pose) for pose in ends(sequence, view)] for view in views]
    arrays = {
        "viewmats": np.stack([first for first, _ in both]),
        "Ks": np.tile(corner_matrix(camera), (count, 1, 1)),
    }
    if images == "rs":
        arrays["viewmats_rs"] = np.stack([last for _, last in both])
    for name, values in coefficients(camera.lens).items():
        arrays[name] = np.tile(values, (count, 1))
    return arrays


def coefficients(lens: Lens | None) -> dict[str, list[float]]:
    """gsplat's arrays of a lens."""
    if lens is None:
        return {}
    if lens.model == "kannala-brandt":
        return {"radial_coeffs": [lens.k1, lens.k2, lens.k3, lens.k4]}
    return {"radial_coeffs": [lens.k1, lens.k2, lens.k3, 0.0, 0.0, 0.0], "tangential_coeffs": [lens.p1, lens.p2]}


def _arguments(sequence: Sequence, views: list[View], images: Images) -> dict[str, Any]:
    camera, side = sequence.rig.camera, views[0].side
    name, value = _SHUTTERS[sequence.shutter.scan_of(side)] if images == "rs" else _GLOBAL
    fisheye = camera.lens is not None and camera.lens.model == "kannala-brandt"
    return {
        "width": camera.width,
        "height": camera.height,
        "camera_model": "fisheye" if fisheye else "pinhole",
        "rolling_shutter": name,
        "rolling_shutter_value": value,
        "row_to_time": LAW if images == "rs" else "all rows have the pose of viewmats",
        "images": [f"images/{view.name}" for view in views],
        "first_line_s": [first_second(sequence, view) for view in views],
        "line_delay_s": _line_delay(sequence, side) if images == "rs" else 0.0,
    }


def _line_delay(sequence: Sequence, side: Side) -> float:
    return sequence.shutter.readout_ratio * sequence.frame_period_s / sequence.shutter.lines(side)


def _seen(sequence: Sequence, view: View, points: Points) -> FloatArray:
    """Pixels (n, 2) that gsplat's law gives."""
    first, last = ends(sequence, view)
    lines = row_motion_error.lines_of(sequence, view, points.pixels)
    share = (lines / max(sequence.shutter.lines(view.side) - 1, 1))[:, None]
    turn = so3.log(last.R @ first.R.T)
    poses = Pose(so3.exp(share * turn) @ first.R, first.t + share * (last.t - first.t))
    return row_motion_error.seen_by(sequence, poses, points.world)
