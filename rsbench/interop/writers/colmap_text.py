"""COLMAP's text model: cameras, images with their poses, and points of the depth with all that sees them.

Format: COLMAP's documentation, "Output Format". Poses are ``cam_from_world`` with quaternions (w, x, y, z), camera
axes as ours; (0, 0) is the corner of the image. Camera models are those of its ``sensor/models.h``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import SIDES
from rsbench.dataset.sequence import Sequence
from rsbench.interop.writers.image_poses import (
    CORNER_PX,
    Images,
    about_moving_objects,
    copy_image,
    first_pose,
    number,
    numbers,
    views_in_time,
    write_lines,
)
from rsbench.interop.writers.surface_points import Surfaces, surfaces

ABOUT = (
    "SEQUENCE/sparse holds cameras.txt, images.txt and points3D.txt, SEQUENCE/images the images. The world "
    "is the rig's body at time 0 (x right, y down, z forward, metres). Points are those of the true depth, "
    "observations their exact projections; points on objects that move are left out."
)
_ONE_POSE = (
    "the images are rolling-shutter frames: images.txt has the pose of the line that is read first, and the "
    "observations are where the rolling shutter sees the points, so they do not reproject"
)


def check(sequence: Sequence, images: Images) -> None:
    """COLMAP has models for all our lenses, and one pose per image whatever the scan is."""


def write(sequence: Sequence, root: Path, images: Images) -> dict[str, Any]:
    """The files of one sequence in a folder of its name below ``root``; what has to be said of them."""
    folder = root / sequence.name
    found = surfaces(sequence, images)
    sparse = folder / "sparse"
    sparse.mkdir(parents=True)
    write_lines(sparse / "cameras.txt", [camera_line(k + 1, sequence.rig.camera) for k in range(len(SIDES))])
    write_lines(sparse / "images.txt", _image_lines(sequence, found))
    write_lines(sparse / "points3D.txt", _point_lines(sequence, found))
    for view in views_in_time(sequence):
        copy_image(sequence, view, images, folder / "images" / view.name)
    told = [_ONE_POSE] if images == "rs" else []
    return {"points": len(found.world), "told": told + about_moving_objects(sequence)}


def camera_line(identifier: int, camera: PinholeCamera) -> str:
    """A line of cameras.txt."""
    lens = camera.lens
    values = [camera.fx, camera.fy, camera.cx + CORNER_PX, camera.cy + CORNER_PX]
    if lens is None:
        model = "PINHOLE"
    elif lens.model == "kannala-brandt":
        model = "OPENCV_FISHEYE"
        values += [lens.k1, lens.k2, lens.k3, lens.k4]
    elif lens.k3 == 0.0:
        model = "OPENCV"
        values += [lens.k1, lens.k2, lens.p1, lens.p2]
    else:
        model = "FULL_OPENCV"
        values += [lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, 0.0, 0.0, 0.0]
    return f"{identifier} {model} {camera.width} {camera.height} {numbers(values)}"


def _image_lines(sequence: Sequence, found: Surfaces) -> list[str]:
    lines = list[str]()
    for k, view in enumerate(views_in_time(sequence)):
        pose = first_pose(sequence, view)
        camera = SIDES.index(view.side) + 1
        lines.append(f"{k + 1} {numbers(so3.quaternion(pose.R))} {numbers(pose.t)} {camera} {view.name}")
        seen = found.seen[view]
        pixels = seen.pixels + CORNER_PX
        lines.append(
            " ".join(
                f"{number(x)} {number(y)} {point + 1}"
                for (x, y), point in zip(pixels.tolist(), seen.index.tolist(), strict=True)
            )
        )
    return lines


def _point_lines(sequence: Sequence, found: Surfaces) -> list[str]:
    """Points without an error: their observations are exact where each image has one pose."""
    tracks: list[list[str]] = [[] for _ in found.world]
    for k, view in enumerate(views_in_time(sequence)):
        for place, point in enumerate(found.seen[view].index.tolist()):
            tracks[point].append(f"{k + 1} {place}")
    colours = found.colours.tolist()
    return [
        f"{k + 1} {numbers(world)} {' '.join(map(str, colours[k]))} 0 {' '.join(tracks[k])}"
        for k, world in enumerate(np.asarray(found.world))
    ]
