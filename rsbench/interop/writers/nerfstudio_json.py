"""nerfstudio's transforms.json, with the rolling-shutter fields of 3dgs-deblur.

Conventions: nerfstudio's documentation, "Data conventions": ``world_from_camera``, camera axes x right, y up, z
back. Its code puts the centre of the first pixel at (0.5, 0.5) (``Cameras.get_image_coords``).

3dgs-deblur (Seiskari et al., Gaussian Splatting on the Move, ECCV 2024): ``camera_linear_velocity`` (m/s) and
``camera_angular_velocity`` (rad/s) are those of the camera itself in its own axes, and ``rolling_shutter_time``
is the readout time, s. Its rasterizer (SpectacularAI/gsplat, ``forward.cu``) shifts what the pose sees by ``(y /
height - 0.5) * rolling_shutter_time`` times the velocity of the pixel, y = 0.5 in row 0: the pose is that of row
(height - 1) / 2, and the law is of first order in pixels.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rsbench.core import so3
from rsbench.core.lens import Lens
from rsbench.core.rig import views_of
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import Sequence
from rsbench.interop.writers import row_motion_error
from rsbench.interop.writers.image_poses import (
    CORNER_PX,
    Images,
    View,
    about_moving_objects,
    camera_velocity,
    copy_image,
    first_pose,
    refuse,
    views_in_time,
    world_from_camera,
)
from rsbench.interop.writers.surface_points import Points
from rsbench.storage.files import write_json

ABOUT = (
    "SEQUENCE/transforms.json and SEQUENCE/images. The world is the rig's body at time 0, metres, x right, "
    "y down, z forward: let nerfstudio orient it (orientation-method vertical or up). With rolling-shutter "
    "frames the poses are those of the middle of the readout, row (height - 1) / 2, and 3dgs-deblur reads "
    "the velocities, rolling_shutter_time and exposure_time (seconds); nerfstudio itself ignores these."
)
LAW = "first order in pixels, from the middle of the readout"
AXES = np.array([1.0, -1.0, -1.0])
"""From our camera axes to OpenGL's."""
_NAME = "nerfstudio"


def check(sequence: Sequence, images: Images) -> None:
    """Raises RsbenchError for rows that 3dgs-deblur does not read so, or that undistortion would mix."""
    if images == "gs":
        return
    if not {sequence.shutter.scan_of("left"), sequence.shutter.scan_of("right")} <= {"top"}:
        refuse(sequence, _NAME, "3dgs-deblur knows rows that are read from the top alone", "take --images gs")
    if sequence.rig.camera.lens is not None:
        what = "nerfstudio undistorts images before it trains, and a row of time is one of the distorted image"
        refuse(sequence, _NAME, what, "take --images gs")
    if len(_exposures(sequence)) > 1:
        refuse(sequence, _NAME, "exposures differ, and exposure_time is one for all", "take --images gs")


def write(sequence: Sequence, root: Path, images: Images) -> dict[str, Any]:
    """The files of one sequence in a folder of its name below ``root``; what has to be said of them."""
    folder = root / sequence.name
    views = views_in_time(sequence)
    for view in views:
        copy_image(sequence, view, images, folder / "images" / view.name)
    content = camera_fields(sequence)
    if images == "rs":
        content["rolling_shutter_time"] = sequence.shutter.readout_ratio * sequence.frame_period_s
        (content["exposure_time"],) = _exposures(sequence)
    content["frames"] = [_frame(sequence, view, images) for view in views]
    write_json(folder / "transforms.json", content)
    if images == "gs":
        return {"told": about_moving_objects(sequence)}
    error = row_motion_error.largest_error(sequence, views, lambda view, points: _seen(sequence, view, points))
    return {
        "largest_row_error_px": error,
        "told": row_motion_error.told(error, LAW) + about_moving_objects(sequence),
    }


def camera_fields(sequence: Sequence) -> dict[str, Any]:
    """What is above the frames of a transforms.json."""
    camera, lens = sequence.rig.camera, sequence.rig.camera.lens
    fisheye = lens is not None and lens.model == "kannala-brandt"
    return {
        "camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV",
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + CORNER_PX,
        "cy": camera.cy + CORNER_PX,
        "w": camera.width,
        "h": camera.height,
        **_coefficients(lens),
    }


def _coefficients(lens: Lens | None) -> dict[str, float]:
    if lens is None:
        return {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    names = ("k1", "k2", "k3", "k4") if lens.model == "kannala-brandt" else ("k1", "k2", "p1", "p2", "k3")
    return {name: getattr(lens, name) for name in names}


def _exposures(sequence: Sequence) -> set[float]:
    """Exposure times of all frames, s; 0 of an ideal sensor."""
    sensor = sequence.sensor
    return {sensor.of(side, frame).exposure_s if sensor else 0.0 for side, frame in views_of(sequence.frames)}


def _frame(sequence: Sequence, view: View, images: Images) -> dict[str, Any]:
    pose = first_pose(sequence, view) if images == "gs" else middle_pose(sequence, view)
    place = world_from_camera(pose)
    place[:3, :3] *= AXES
    frame: dict[str, Any] = {"file_path": f"images/{view.name}", "transform_matrix": place.tolist()}
    if images == "rs":
        linear, angular = camera_velocity(sequence, view.side, middle_time(sequence, view))
        frame["camera_linear_velocity"] = (AXES * linear).tolist()
        frame["camera_angular_velocity"] = (AXES * angular).tolist()
    return frame


def middle_time(sequence: Sequence, view: View) -> float:
    """Time of row (height - 1) / 2, frame periods."""
    shutter = sequence.shutter
    return float(shutter.line_time((shutter.lines(view.side) - 1) / 2, view.frame, view.side))


def middle_pose(sequence: Sequence, view: View) -> Pose:
    """``cam_from_world`` (3, 3), (3,) of row (height - 1) / 2."""
    return sequence.rig.cam_from_world(sequence.motion, middle_time(sequence, view), view.side)


def _seen(sequence: Sequence, view: View, points: Points) -> FloatArray:
    """Pixels (n, 2) that the law of 3dgs-deblur gives."""
    pose, camera = middle_pose(sequence, view), sequence.rig.camera
    x = points.world @ pose.R.T + pose.t
    linear, angular = camera_velocity(sequence, view.side, middle_time(sequence, view))
    rates = camera.velocity(x, -(linear + so3.cross(angular, x)))
    readout_s = sequence.shutter.readout_ratio * sequence.frame_period_s
    seconds = readout_s * ((points.pixels[:, 1] + CORNER_PX) / camera.height - 0.5)
    return camera.project(x) + seconds[:, None] * rates
