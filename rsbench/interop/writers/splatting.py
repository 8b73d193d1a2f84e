"""Gaussian splatting: nerfstudio's transforms.json with the fields of 3dgs-deblur, and the arrays of gsplat.

nerfstudio (its documentation, "Data conventions"): ``world_from_camera``, camera axes x right, y up, z back. Its
code puts the centre of the first pixel at (0.5, 0.5) (``Cameras.get_image_coords``).

3dgs-deblur (Seiskari et al., Gaussian Splatting on the Move, ECCV 2024): ``camera_linear_velocity`` (m/s) and
``camera_angular_velocity`` (rad/s) are those of the camera itself in its own axes, and ``rolling_shutter_time``
is the readout time, s. Its rasterizer (SpectacularAI/gsplat, ``forward.cu``) shifts each projection by
``(y / height - 0.5) * rolling_shutter_time`` times the velocity of the pixel, with y = 0.5 in row 0. So the pose
is that of row (height - 1) / 2, and the model is a first-order approximation in pixels.

gsplat (``gsplat.rasterization`` and ``gsplat/cuda/_torch_cameras.py``) interpolates the rows between two view
matrices: ``viewmats`` are ``cam_from_world`` of the line that is read first, ``viewmats_rs`` of the one that is
read last; the relative time of a pixel's line is ``floor(y) / (height - 1)`` (``(height - ceil(y)) / (height -
1)`` from the bottom; columns likewise), where y = 0.5 is the centre of row 0; translations are interpolated
linearly, rotations at constant angular velocity, as in our model ``linear``. Lenses are OpenCV's, and the line is
that of the distorted pixel, as in ours.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rsbench.core import so3
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.rig import SIDES, views_of
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import Sequence
from rsbench.interop.writers.sequence_views import (
    CORNER_PX,
    Format,
    Images,
    Note,
    Points,
    View,
    about_moving_objects,
    camera_velocity,
    compare_rows,
    copy_image,
    corner_matrix,
    first_pose,
    first_second,
    lens_fault,
    line_delay,
    line_poses,
    lines_of,
    matrix,
    one_by_one,
    reads_from_top,
    seen_by,
    views_in_time,
    world_from_camera,
)
from rsbench.storage.files import save_arrays, write_json

_NERFSTUDIO_ABOUT = (
    "SEQUENCE/transforms.json and SEQUENCE/images. The world is the rig's body at time 0, metres, x right, "
    "y down, z forward: let nerfstudio orient it (orientation-method vertical or up). With rolling-shutter "
    "frames the poses are those of the middle of the readout, row (height - 1) / 2, and 3dgs-deblur reads "
    "the velocities, rolling_shutter_time and exposure_time (seconds); nerfstudio itself ignores these."
)
_DEBLUR_LAW = "first order in pixels, from the middle of the readout"
AXES = np.array([1.0, -1.0, -1.0])
"""Signs that convert our camera axes to OpenGL's."""


def _nerfstudio_fault(sequence: Sequence, images: Images) -> str:
    cameras = [sequence.rig.sensor(side) for side in SIDES]
    if len({_camera_model(camera) for camera in cameras}) > 1:
        return (
            "its camera_model is one for all images, and one of these cameras is a fisheye; choose other sequences"
        )
    if (fault := lens_fault(sequence.rig, "brown-conrady", "kannala-brandt")) or images == "gs":
        return fault
    if not reads_from_top(sequence):
        return "3dgs-deblur supports only rows that are read from the top; use --images gs"
    if any(camera.lens is not None for camera in cameras):
        what = "nerfstudio undistorts images before it trains, and a row of time is one of the distorted image"
        return f"{what}; take --images gs"
    if len({sequence.shutter.ratio_of(side) for side in SIDES}) > 1:
        return "the readouts of the cameras differ, and rolling_shutter_time is one for all; take --images gs"
    one = len(_exposures(sequence)) == 1
    return "" if one else "exposures differ, and exposure_time is one for all; take --images gs"


def _write_nerfstudio(sequence: Sequence, root: Path, images: Images) -> Note:
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
        return about_moving_objects(sequence), {}
    sentences, record = compare_rows(sequence, views, partial(_deblur_pixels, sequence), _DEBLUR_LAW)
    return sentences + about_moving_objects(sequence), record


def camera_fields(sequence: Sequence) -> dict[str, Any]:
    """Return the top-level fields of transforms.json; if the intrinsics differ, each frame has its own instead."""
    model = {"camera_model": _camera_model(sequence.rig.sensor("left"))}
    return model | (_intrinsics(sequence.rig.camera) if sequence.rig.aligned else {})


def _camera_model(camera: PinholeCamera) -> str:
    fisheye = camera.lens is not None and camera.lens.model == "kannala-brandt"
    return "OPENCV_FISHEYE" if fisheye else "OPENCV"


def _intrinsics(camera: PinholeCamera) -> dict[str, float]:
    return {
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + CORNER_PX,
        "cy": camera.cy + CORNER_PX,
        "w": camera.width,
        "h": camera.height,
        **_opencv_coefficients(camera.lens),
    }


def _opencv_coefficients(lens: Lens | None) -> dict[str, float]:
    if lens is None:
        return {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    names = ("k1", "k2", "k3", "k4") if lens.model == "kannala-brandt" else ("k1", "k2", "p1", "p2", "k3")
    return {name: getattr(lens, name) for name in names}


def _exposures(sequence: Sequence) -> set[float]:
    """Return the different exposure times of all frames, s; 0 for an ideal sensor."""
    sensor = sequence.sensor
    return {sensor.of(side, frame).exposure_s if sensor else 0.0 for side, frame in views_of(sequence.frames)}


def _frame(sequence: Sequence, view: View, images: Images) -> dict[str, Any]:
    pose = first_pose(sequence, view) if images == "gs" else middle_pose(sequence, view)
    place = world_from_camera(pose)
    place[:3, :3] *= AXES
    frame: dict[str, Any] = {"file_path": f"images/{view.name}", "transform_matrix": place.tolist()}
    frame |= {} if sequence.rig.aligned else _intrinsics(sequence.rig.sensor(view.side))
    if images == "rs":
        linear, angular = camera_velocity(sequence, view.side, middle_time(sequence, view))
        frame["camera_linear_velocity"] = (AXES * linear).tolist()
        frame["camera_angular_velocity"] = (AXES * angular).tolist()
    return frame


def middle_time(sequence: Sequence, view: View) -> float:
    """Return the time of the middle line, such as row (height - 1) / 2, frame periods."""
    shutter = sequence.shutter
    return float(shutter.line_time((shutter.lines(view.side) - 1) / 2, view.frame, view.side))


def middle_pose(sequence: Sequence, view: View) -> Pose:
    """Return ``cam_from_world`` (3, 3), (3,) of the middle line."""
    return sequence.rig.cam_from_world(sequence.motion, middle_time(sequence, view), view.side)


def _deblur_pixels(sequence: Sequence, view: View, points: Points) -> FloatArray:
    """Project points to pixels (n, 2) with the motion model of 3dgs-deblur."""
    pose, camera = middle_pose(sequence, view), sequence.rig.sensor(view.side)
    x = points.world @ pose.R.T + pose.t
    linear, angular = camera_velocity(sequence, view.side, middle_time(sequence, view))
    rates = camera.velocity(x, -(linear + so3.cross(angular, x)))
    readout_s = sequence.shutter.readout_ratio * sequence.frame_period_s
    seconds = readout_s * ((points.pixels[:, 1] + CORNER_PX) / camera.height - 0.5)
    return camera.project(x) + seconds[:, None] * rates


_GSPLAT_ABOUT = (
    "SEQUENCE/left.npz and right.npz hold the arrays that gsplat.rasterization takes, left.json and "
    "right.json its other arguments and the images in their order, SEQUENCE/images the images. Pixels have "
    "(0, 0) in the corner of the image. With rolling-shutter frames viewmats are the poses of the lines "
    "read first, viewmats_rs of those read last. Distortion and rolling shutter need with_ut = True and "
    "with_eval3d = True."
)
_GSPLAT_LAW = (
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


def _write_gsplat(sequence: Sequence, root: Path, images: Images) -> Note:
    folder = root / sequence.name
    folder.mkdir(parents=True)
    for side in SIDES:
        views = [View(side, frame) for frame in range(sequence.frames)]
        save_arrays(folder / f"{side}.npz", _arrays(sequence, views, images))
        write_json(folder / f"{side}.json", _arguments(sequence, views, images))
        for view in views:
            copy_image(sequence, view, images, folder / "images" / view.name)
    if images == "gs":
        return about_moving_objects(sequence), {}
    views = [View(*view) for view in views_of(sequence.frames)]
    sentences, record = compare_rows(sequence, views, partial(_gsplat_pixels, sequence), _GSPLAT_LAW)
    return sentences + about_moving_objects(sequence), record


def ends(sequence: Sequence, view: View) -> tuple[Pose, Pose]:
    """Return ``cam_from_world`` of the lines that are read first and last."""
    poses, first = line_poses(sequence, view), sequence.shutter.first_line(view.side)
    last = sequence.shutter.lines(view.side) - 1 - first
    return Pose(poses.R[first], poses.t[first]), Pose(poses.R[last], poses.t[last])


def _arrays(sequence: Sequence, views: list[View], images: Images) -> dict[str, FloatArray]:
    camera, count = sequence.rig.sensor(views[0].side), len(views)
    both = [[matrix(pose) for pose in ends(sequence, view)] for view in views]
    arrays = {
        "viewmats": np.stack([first for first, _ in both]),
        "Ks": np.tile(corner_matrix(camera), (count, 1, 1)),
    }
    if images == "rs":
        arrays["viewmats_rs"] = np.stack([last for _, last in both])
    for name, values in _gsplat_coefficients(camera.lens).items():
        arrays[name] = np.tile(values, (count, 1))
    return arrays


def _gsplat_coefficients(lens: Lens | None) -> dict[str, list[float]]:
    """Return the arrays by which gsplat describes a lens."""
    if lens is None:
        return {}
    if lens.model == "kannala-brandt":
        return {"radial_coeffs": [lens.k1, lens.k2, lens.k3, lens.k4]}
    radial = [lens.k1, lens.k2, lens.k3, lens.k4, lens.k5, lens.k6]
    return {"radial_coeffs": radial, "tangential_coeffs": [lens.p1, lens.p2]}


def _arguments(sequence: Sequence, views: list[View], images: Images) -> dict[str, Any]:
    side = views[0].side
    camera = sequence.rig.sensor(side)
    name, value = _SHUTTERS[sequence.shutter.scan_of(side)] if images == "rs" else _GLOBAL
    return {
        "width": camera.width,
        "height": camera.height,
        "camera_model": "fisheye" if _camera_model(camera) == "OPENCV_FISHEYE" else "pinhole",
        "rolling_shutter": name,
        "rolling_shutter_value": value,
        "row_to_time": _GSPLAT_LAW if images == "rs" else "all rows have the pose of viewmats",
        "images": [f"images/{view.name}" for view in views],
        "first_line_s": [first_second(sequence, view) for view in views],
        "line_delay_s": line_delay(sequence, side) if images == "rs" else 0.0,
    }


def _gsplat_pixels(sequence: Sequence, view: View, points: Points) -> FloatArray:
    """Project points to pixels (n, 2) with the motion model of gsplat."""
    first, last = ends(sequence, view)
    lines = lines_of(sequence, view, points.pixels)
    share = (lines / max(sequence.shutter.lines(view.side) - 1, 1))[:, None]
    turn = so3.log(last.R @ first.R.T)
    poses = Pose(so3.exp(share * turn) @ first.R, first.t + share * (last.t - first.t))
    return seen_by(sequence, view.side, poses, points.world)


NERFSTUDIO = Format(_NERFSTUDIO_ABOUT, ("rs", "gs"), one_by_one(_write_nerfstudio), fault=_nerfstudio_fault)


def _gsplat_fault(sequence: Sequence, images: Images) -> str:
    return lens_fault(sequence.rig, "brown-conrady", "rational", "kannala-brandt")


GSPLAT = Format(_GSPLAT_ABOUT, ("rs", "gs"), one_by_one(_write_gsplat), fault=_gsplat_fault)
