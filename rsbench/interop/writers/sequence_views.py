"""Shared parts of the exports: poses of images, pixel conventions, surface points, and the row-motion error.

Surface points are world points from depth maps, with their exact pixels in the images of a sequence, as in a
reconstruction. The row-motion error is the largest distance, px, between the projections of points under a
format's model of the motion during readout and under the true motion.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.core import so3
from rsbench.core.camera import LensModel, PinholeCamera
from rsbench.core.projection import ProjectionStatus, project_at, row_poses, rs_project
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.se3 import Pose, inverse, transform
from rsbench.core.so3 import FloatArray
from rsbench.dataset.layout import picture_file
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import numbers_of
from rsbench.storage.files import write_bytes
from rsbench.storage.untrusted_files import inside, read_bytes

Note = tuple[list[str], dict[str, Any]]
"""Sentences about data of a sequence that a format cannot represent, and fields of its record in export.json."""
Images = Literal["rs", "gs"]
"""Rolling-shutter frames, or their global-shutter twins from the pose of the line that is read first."""
CORNER_PX = 0.5
"""Offset added to pixels for formats with (0, 0) at the image corner; ours is the centre of the first pixel."""


class Format(NamedTuple):
    """A layout of another project."""

    about: str
    """Description of its files, for README.txt."""
    images: tuple[Images, ...]
    """Types of images that can be exported, the default first; empty if the format has none, or both."""
    write: Callable[[list[Sequence], Path, Images], Iterator[Note]]
    """Function that writes sequences to files below a root folder and yields a note after each."""
    fault: Callable[[Sequence, Images], str] = lambda sequence, images: ""
    """Function that returns why a sequence cannot be written, with a remedy; empty if it can."""


class View(NamedTuple):
    """One image of a sequence."""

    side: Side
    frame: int

    @property
    def name(self) -> str:
        return f"{self.side}_{self.frame:04d}.png"


def one_by_one(
    write: Callable[[Sequence, Path, Images], Note],
) -> Callable[[list[Sequence], Path, Images], Iterator[Note]]:
    """Return ``Format.write`` for a function that writes the separate files of one sequence."""
    return lambda sequences, root, images: (write(sequence, root, images) for sequence in sequences)


def views_in_time(sequence: Sequence) -> list[View]:
    """Return the views in the order left 0, right 0, left 1, and so on."""
    return [View(side, frame) for frame in range(sequence.frames) for side in SIDES]


def first_pose(sequence: Sequence, view: View) -> Pose:
    """Return ``cam_from_world`` of the line that is read first, which is also that of the global-shutter twin."""
    start = sequence.shutter.start(view.frame, view.side)
    return sequence.rig.cam_from_world(sequence.motion, start, view.side)


def line_poses(sequence: Sequence, view: View) -> Pose:
    """Return ``cam_from_world`` (lines, 3, 3), (lines, 3) of all lines, in the order of the image."""
    return row_poses(sequence.rig, sequence.shutter, sequence.motion, view.side, view.frame)


def first_second(sequence: Sequence, view: View) -> float:
    """Return the time of the line that is read first, s; 0 is the time of row 0 in frame 0."""
    return sequence.frame_period_s * float(sequence.shutter.start(view.frame, view.side))


def camera_velocity(sequence: Sequence, side: Side, tau: float) -> tuple[FloatArray, FloatArray]:
    """Return the linear and angular velocity (3,) of a camera in its own axes, m/s and rad/s, at frame period tau.

    A world point X has camera coordinates x = R X + t with R' = [w]x R, and the velocity w x (x - t) + t'. For a
    camera with velocity v and angular velocity a it is -(v + a x x), hence a = -w and v = w x t - t'.
    """
    w, rate = (sequence.rig.own(side).R @ each for each in sequence.motion.velocity(tau))
    t = sequence.rig.cam_from_world(sequence.motion, tau, side).t
    return (so3.cross(w, t) - rate) / sequence.frame_period_s, -w / sequence.frame_period_s


def matrix(pose: Pose) -> FloatArray:
    """Return the homogeneous matrix (..., 4, 4) of a transform."""
    out = np.zeros((*pose.t.shape[:-1], 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = pose.R, pose.t, 1.0
    return out


def world_from_camera(pose: Pose) -> FloatArray:
    """Return the homogeneous matrix (..., 4, 4) of the inverse of ``cam_from_world``."""
    return matrix(inverse(pose))


def step_of(camera: PinholeCamera, wanted: float) -> int:
    """Return the grid spacing, px, at which about ``wanted`` pixels of an image are sampled."""
    return max(math.ceil(math.sqrt(camera.width * camera.height / wanted)), 1)


def corner_matrix(camera: PinholeCamera) -> FloatArray:
    """Return the calibration matrix (3, 3), without the lens, for pixels with (0, 0) at the image corner."""
    K = camera.ideal.K
    K[:2, 2] += CORNER_PX
    return K


def copy_image(sequence: Sequence, view: View, images: Images, path: Path) -> None:
    """Copy the PNG file of a view unchanged."""
    copy_file(sequence.folder, picture_file(images, view.side, view.frame + sequence.first), path)


def copy_file(folder: Path, name: str, to: Path) -> None:
    """Copy a file of a folder unchanged."""
    to.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(to, read_bytes(inside(folder, name)))


def projections(camera: PinholeCamera, baseline: float) -> tuple[FloatArray, FloatArray]:
    """Return P1, P2 (3, 4) of a rectified pair, as in OpenCV's stereoRectify, in the left camera's axes."""
    right = np.column_stack([camera.K, [-camera.fx * baseline, 0.0, 0.0]])
    return np.column_stack([camera.K, np.zeros(3)]), right


def number(value: float) -> str:
    """Format a number exactly, with a decimal point, because YAML 1.1 reads 1e-05 as text."""
    text = repr(float(value))
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def numbers(values: object) -> str:
    """Format numbers row by row, separated by blanks."""
    return " ".join(number(value) for value in np.ravel(np.asarray(values, dtype=np.float64)))


def write_lines(path: Path, lines: list[str]) -> None:
    """Write lines as UTF-8 text; every line is terminated."""
    write_bytes(path, ("\n".join(lines) + "\n").encode())


def reads_from_top(sequence: Sequence) -> bool:
    """Return whether both cameras read their rows from top to bottom."""
    return {sequence.shutter.scan_of(side) for side in SIDES} == {"top"}


def lens_fault(rig: StereoRig, *known: LensModel) -> str:
    """Return why a format that supports only these lens models cannot represent a rig; empty if it can."""
    for side in SIDES:
        lens = rig.sensor(side).lens
        if lens is not None and lens.model not in known:
            lenses = f"supports only {' and '.join(known)} lenses" if known else "has no lenses"
            return f"it {lenses}, and the {side} camera's is {lens.model}; choose other sequences"
    return ""


def about_moving_objects(sequence: Sequence) -> list[str]:
    """Return a note on moving objects, if there are any, for formats with a static scene."""
    if not sequence.moving:
        return []
    count = len(sequence.moving)
    return [f"{count} object{'s' if count > 1 else ''} move in the images; the format supports only static scenes"]


_POINTS = 50_000
"""Approximate number of points of a sequence."""
_MOST_OF_AN_IMAGE = 2_000
_AROUND = 4
"""Number of frames before and after its own frame in which a point is searched."""
_SAME = 2e-3
"""Tolerance of the relative difference between the depths of a point and of the visible surface."""


class Points(NamedTuple):
    """Surface points (n) of one image."""

    world: FloatArray
    """(n, 3) m, in the world of the sequence."""
    pixels: NDArray[np.int64]
    """(n, 2) x, y."""
    colours: NDArray[np.uint8]
    """(n, 3) sRGB."""


class Observations(NamedTuple):
    """Points that are visible in an image, as indices into a list of points, and their pixels."""

    index: NDArray[np.int64]
    """(m,)"""
    pixels: FloatArray
    """(m, 2) exact projections, not rounded."""


class Surfaces(NamedTuple):
    """Points of all images of a sequence, each visible in at least two images."""

    world: FloatArray
    """(n, 3)"""
    colours: NDArray[np.uint8]
    """(n, 3)"""
    seen: dict[View, Observations]
    """Visible points of each view."""


def world_points(sequence: Sequence, view: View, images: Images, step: int) -> Points:
    """Return points at every ``step``-th pixel in both directions that shows a static surface."""
    depth = sequence.depth(images, view.side, view.frame)
    still = (depth > 0) & (numbers_of(sequence.labels(images, view.side, view.frame)) == 0)
    grid = np.zeros_like(still)
    grid[step // 2 :: step, step // 2 :: step] = True
    y, x = np.nonzero(still & grid)
    pixels = np.stack([x, y], axis=-1)
    colours = sequence.image(images, view.side, view.frame)[y, x]
    x_in_cam = depth[y, x, None].astype(np.float64) * sequence.rig.sensor(view.side).unproject(pixels)
    return Points(transform(inverse(pixel_poses(sequence, view, images, pixels)), x_in_cam), pixels, colours)


def pixel_poses(sequence: Sequence, view: View, images: Images, pixels: NDArray[np.int64]) -> Pose:
    """Return ``cam_from_world`` (n, 3, 3), (n, 3) at the times of integer pixels (n, 2) of an image."""
    if images == "gs":
        still = first_pose(sequence, view)
        return Pose(*(np.broadcast_to(part, (len(pixels), *part.shape)) for part in still))
    lines = pixels[:, sequence.shutter.axis(view.side)]
    return Pose(*(part[lines] for part in line_poses(sequence, view)))


def observe(sequence: Sequence, view: View, images: Images, world: FloatArray) -> Observations:
    """Select the points (n, 3) that project into an image exactly once and are not occluded in its depth map."""
    rig, shutter, motion = sequence.rig, sequence.shutter, sequence.motion
    if images == "gs":
        start = shutter.start(view.frame, view.side)
        found = project_at(rig, motion, view.side, start, world)
        pixels, z = found[:, :2], found[:, 2]
        once = rig.sensor(view.side).contains(np.nan_to_num(pixels, nan=-np.inf))
    else:
        rolling = rs_project(rig, shutter, motion, view.side, view.frame, world)
        pixels, z, once = rolling.pixels, rolling.depth, rolling.status == ProjectionStatus.SEEN
    index = np.flatnonzero(once)
    depth = sequence.depth(images, view.side, view.frame)
    index = index[_on_surface(depth, pixels[index], z[index])]
    return Observations(index, pixels[index])


def _on_surface(depth: NDArray[np.float32], pixels: FloatArray, z: FloatArray) -> NDArray[np.bool_]:
    """Return whether points at pixels (n, 2) and depths (n) lie on a depth map (H, W), interpolated in 1 / z."""
    height, width = depth.shape
    if min(height, width) < 2:
        return np.zeros(len(z), dtype=np.bool_)
    x0 = np.clip(np.floor(pixels[:, 0]), 0, width - 2).astype(np.int64)
    y0 = np.clip(np.floor(pixels[:, 1]), 0, height - 2).astype(np.int64)
    corners = np.stack([depth[y0 + j, x0 + i] for j in (0, 1) for i in (0, 1)], axis=-1).astype(np.float64)
    known = np.all(corners > 0, axis=-1)
    near = 1.0 / np.where(corners > 0, corners, 1.0)
    u, v = pixels[:, 0] - x0, pixels[:, 1] - y0
    upper = near[:, 0] + u * (near[:, 1] - near[:, 0])
    lower = near[:, 2] + u * (near[:, 3] - near[:, 2])
    return known & (np.abs(z * (upper + v * (lower - upper)) - 1.0) < _SAME)


def surfaces(sequence: Sequence, images: Images) -> Surfaces:
    """Return surface points from the depth of every image, and the nearby frames in which they are visible."""
    views = views_in_time(sequence)
    wanted = min(_MOST_OF_AN_IMAGE, max(_POINTS // len(views), 1))
    worlds, colours, origins = list[FloatArray](), list[NDArray[np.uint8]](), list[NDArray[np.int64]]()
    for number, view in enumerate(views):
        points = world_points(sequence, view, images, step_of(sequence.rig.sensor(view.side), wanted))
        worlds.append(points.world)
        colours.append(points.colours)
        origins.append(np.full(len(points.world), number, dtype=np.int64))
    world, origin = np.concatenate(worlds), np.concatenate(origins)
    frames = np.array([view.frame for view in views])[origin]
    seen = dict[View, Observations]()
    for view in views:
        near = np.flatnonzero(np.abs(frames - view.frame) <= _AROUND)
        found = observe(sequence, view, images, world[near])
        seen[view] = Observations(near[found.index], found.pixels)
    return _seen_twice(Surfaces(world, np.concatenate(colours), seen))


def _seen_twice(found: Surfaces) -> Surfaces:
    """Select the points that are visible in at least two images."""
    counts = np.zeros(len(found.world), dtype=np.int64)
    for each in found.seen.values():
        np.add.at(counts, each.index, 1)
    keep = counts >= 2
    place = np.cumsum(keep) - 1
    seen = {
        view: Observations(place[each.index[keep[each.index]]], each.pixels[keep[each.index]])
        for view, each in found.seen.items()
    }
    return Surfaces(found.world[keep], found.colours[keep], seen)


Law = Callable[[View, Points], FloatArray]
"""A format's motion model: projects points to pixels (n, 2), in our convention, at the pose of their lines."""
_TRIED = 5_000
"""Approximate number of pixels of each image that are compared."""


def compare_rows(sequence: Sequence, views: list[View], law: Law, name: str) -> Note:
    """Return the largest distance, px, between true pixels and a format's projections, and a note above 1e-6 px.

    Each point is projected at the pose that the motion model gives to its line. The distance is 0 if no image has
    depth; 1e-6 px is the accuracy with which written numbers are read back.
    """
    error = 0.0
    for view in views:
        points = world_points(sequence, view, "rs", step_of(sequence.rig.sensor(view.side), _TRIED))
        away = np.linalg.norm(law(view, points) - points.pixels, axis=-1)
        # NaN: the point is behind the camera, which is an infinite error
        error = max(error, float(np.max(np.nan_to_num(away, nan=math.inf), initial=0.0)))
    sentence = f"the format's motion of the rows ({name}) is up to {error:.2g} px from the true one"
    return [] if error < 1e-6 else [sentence], {"largest_row_error_px": error}


def seen_by(sequence: Sequence, side: Side, poses: Pose, world: FloatArray) -> FloatArray:
    """Project world points (n, 3) to pixels (n, 2) of a camera with poses ``cam_from_world`` (n, 3, 3), (n, 3)."""
    return sequence.rig.sensor(side).project(transform(poses, world))


def line_delay(sequence: Sequence, side: Side) -> float:
    """Return the time between successive lines of a camera, seconds."""
    shutter = sequence.shutter
    return shutter.ratio_of(side) * sequence.frame_period_s / shutter.lines(side)


def lines_of(sequence: Sequence, view: View, pixels: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the number of lines (n,) that are read before those of pixels (n, 2)."""
    shutter = sequence.shutter
    lines = pixels[:, shutter.axis(view.side)]
    return np.abs(lines - shutter.first_line(view.side))
