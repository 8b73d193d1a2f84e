"""The images of a sequence, and the reprojection of the surfaces in one image to another."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from enum import IntEnum
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.geometry import FixedGeometry, Geometry, RelativeMotion
from rsbench.core.projection import ProjectionStatus, row_poses, rs_project
from rsbench.core.rig import FRAMES, SIDES, Side
from rsbench.core.se3 import Pose, inverse, transform
from rsbench.core.so3 import FloatArray, hat
from rsbench.dataset.layout import SHUTTERS, Shutter, exposed_file, gloss_file, moving_file, picture_file
from rsbench.vision.reprojection import bend, lens_table

if TYPE_CHECKING:
    from rsbench.renderers.visibility import Surfaces

_NEAREST = 32
FAR = 1e7
"""Distance at which the sky is placed, metres: no motion of a rig moves it by a hundredth of a pixel."""


NUMBER, SHADED = 127, 128
"""Bit masks of a label: the object's number, and the flag for pixels in the shadow of a moving object."""


class PixelClass(IntEnum):
    """Whether another image shows the surface of a pixel: the values of a mask."""

    UNSOLVED = 0
    """The search for its row failed; there is no value."""
    VISIBLE = 1
    OCCLUDED = 2
    """In view, but a nearer surface hides it."""
    OUT_OF_VIEW = 3
    """Outside of the image or behind the camera; also for sky."""
    SKY = 4
    """Sky in both images; the value is that of the direction."""
    SKY_OCCLUDED = 5
    """Sky that a surface hides in the other image."""


def numbers_of(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the object numbers (...) of labels (...); 0: no moving object."""
    return np.asarray(labels & NUMBER, dtype=np.uint8)


def seen_from(geometry: Geometry, number: int) -> FixedGeometry:
    """Return the geometry relative to a moving object, in whose frame its points are at rest; 0: the world."""
    motion = RelativeMotion(geometry.motion, geometry.objects[number - 1]) if number else geometry.motion
    return FixedGeometry(geometry.rig, geometry.shutter, motion, geometry.frames)


class ImageView(NamedTuple):
    """An image of one camera at one frame time, with a rolling or a global shutter."""

    shutter: Shutter
    side: Side
    frame: int
    row: int = 0
    """The row whose pose a global-shutter image has, counted in the order of the readout."""

    @property
    def image(self) -> str:
        """Path of the image below the folder of the sequence."""
        return picture_file(*self)

    @property
    def depth(self) -> str:
        """Path of the depth map."""
        return picture_file(*self, depth=True)

    @property
    def labels(self) -> str:
        """Path of the labels of moving objects, if there are any."""
        return moving_file(*self)

    @property
    def gloss(self) -> str:
        """Path of the mask of glossy surfaces, if there are any."""
        return gloss_file(*self)

    @property
    def exposed(self) -> str:
        """Path of the global-shutter image with the sensor's exposure, if the dataset has it."""
        return exposed_file(*self[1:])

    @property
    def other_shutter(self) -> ImageView:
        return self._replace(shutter="gs" if self.shutter == "rs" else "rs")

    @property
    def other_side(self) -> ImageView:
        return self._replace(side="right" if self.side == "left" else "left")

    def next_frame(self, frames: int) -> ImageView:
        """Return the image of the next of ``frames`` frames; for the last frame, that of the previous one."""
        return self._replace(frame=self.frame + (1 if self.frame < frames - 1 else -1))

    @property
    def frame_before(self) -> ImageView:
        return self._replace(frame=self.frame - 1)

    def partners(self) -> Iterator[ImageView]:
        """Views with most surfaces in common: other shutter, other camera, next frame, previous frame.

        The last two may not exist in the sequence.
        """
        after = self._replace(frame=self.frame + 1)
        yield from (self.other_shutter, self.other_side, after, self.frame_before)


Times = tuple[int, int]
"""Two successive frame numbers."""


def image_views(times: Iterable[int]) -> tuple[ImageView, ...]:
    """Return all views of these frames; global-shutter views are those of row 0."""
    return tuple(ImageView(*each) for each in product(SHUTTERS, SIDES, times))


def view_pairs(times: Times) -> tuple[tuple[ImageView, ImageView], ...]:
    """Return all pairs of a view of two frames and one of its three partners."""
    both = image_views(times)
    return tuple((source, target) for source in both for target in source.partners() if target in both)


def nearby_views(view: ImageView, frames: int) -> list[ImageView]:
    """Return the other views in the ``_NEAREST`` frames that are nearest in time, nearest first."""
    times = sorted(range(frames), key=lambda frame: abs(frame - view.frame))[:_NEAREST]
    return [each for time in times for each in image_views((time,)) if each != view]


IMAGE_VIEWS, VIEW_PAIRS = image_views(FRAMES), view_pairs(FRAMES)
"""All views, and all pairs of partners, of a sequence of two frames."""


def times_at(geometry: Geometry, view: ImageView, pixels: FloatArray) -> FloatArray:
    """Return the times (...) of pixels (..., 2) of a view, frame periods; the frame number for NaN."""
    if view.shutter == "gs":
        return np.broadcast_to(_time(geometry, view), pixels.shape[:-1])
    tau = geometry.shutter.pixel_time(pixels, view.frame, view.side)
    return np.where(np.isnan(tau), float(view.frame), tau)


def _time(geometry: Geometry, view: ImageView) -> FloatArray:
    return geometry.shutter.time_after(view.row, view.frame, view.side)


def _pose(geometry: Geometry, view: ImageView) -> Pose:
    return geometry.rig.cam_from_world(geometry.motion, _time(geometry, view), view.side)


def image_seed(seed: int, sequence: str, side: Side, frame: int) -> int:
    """Noise seed of an image, the same for rolling- and global-shutter twins, so that their rows 0 are equal."""
    text = f"{seed}/{sequence}/{side}/{frame}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "little")


_SAME = 1e-11
"""Largest interpolation error of a pose's entries: of rotations, and metres."""
_FINEST, _AT_JUMPS = 64, 1e-8
"""Most table entries per line, and the largest interpolation error allowed then, as the acceleration may be
discontinuous, for instance at the end of a spline."""
_TOLERANCE_PX = 1e-8
"""Residual of the row equation at which the search stops; stored values are rounded to 1e-3 px."""
_MOST_STEPS = 12
_SEEN, _NOT_SEEN, _UNSURE = 0, 1, 2


ByBands = Callable[[Callable[[int, int], None], int], object]
"""Calls a function for bands of rows, with their first row and the row after their last, that cover a height."""


class Reprojected(NamedTuple):
    """Pixels of points (...) in an image."""

    pixels: FloatArray
    """(..., 2) px; NaN for points that it does not show."""
    eyes: FloatArray
    """(..., 3) the camera's centre at that time, world frame; arbitrary for points that it does not show."""
    unsolved: NDArray[np.bool_]
    """(...) whether the search failed, so that it is unknown whether the image shows the point."""


class _Table(NamedTuple):
    """Poses of an image as a function of the line, from line -1."""

    entries: FloatArray
    """(n, 24): rotation and translation of ``cam_from_world``, and their derivatives per table entry."""
    per_line: float
    """Number of entries per line; 0: all lines have one pose."""


def find(
    geometry: Geometry,
    target: ImageView,
    points: FloatArray,
    start: FloatArray,
    *,
    in_camera: FloatArray | None = None,
    any_motion: bool = False,
    by_bands: ByBands = lambda work, height: [work(0, height)],
) -> Reprojected:
    """Find the lines and pixels of an image at which it shows points.

    Args:
        geometry: rig, shutter and motion.
        target: the image.
        points: (rows, n, 3) points, world frame, metres.
        start: (rows, n) lines at which the search starts.
        in_camera: (rows, n, 3) output: the points in the target's camera at their times, metres; meaningless for
            points that the target does not show. Not computed by default.
        any_motion: use a slow search for all solutions if no table of poses represents the motion.
        by_bands: runs the search for bands of rows, for example in threads.

    Raises:
        RsbenchError: no table of poses represents the motion, unless ``any_motion``.
    """
    camera, shutter = geometry.rig.sensor(target.side), geometry.shutter
    pixels, eyes = np.full((*start.shape, 2), np.nan), np.zeros(points.shape)
    status = np.full(start.shape, _UNSURE, dtype=np.uint8)
    axis, lines = shutter.axis(target.side), shutter.lines(target.side)
    optics, seen = _optics_of(camera), np.zeros((0, 0, 3)) if in_camera is None else in_camera

    def search(first: int, last: int) -> None:
        rows = slice(first, last)
        own = pixels[rows], eyes[rows], status[rows], seen[rows]
        reproject_rows(table.entries, table.per_line, optics, axis, lines, points[rows], start[rows], *own)

    try:
        table = _pose_table(geometry, target)
        by_bands(search, len(start))
    except RsbenchError:
        if not any_motion:
            raise
    unsure = status == _UNSURE
    if np.any(unsure):
        found = rs_project(geometry.rig, shutter, geometry.motion, target.side, target.frame, points[unsure])
        pixels[unsure] = found.pixels
        times = np.where(np.isnan(found.tau), target.frame, found.tau)
        pose = geometry.rig.cam_from_world(geometry.motion, times, target.side)
        eyes[unsure] = inverse(pose).t
        if in_camera is not None:
            in_camera[unsure] = transform(pose, points[unsure])
        unsure[unsure] = found.status == ProjectionStatus.NOT_CONVERGED
    return Reprojected(pixels, eyes, unsure)


def _pose_table(geometry: Geometry, view: ImageView) -> _Table:
    rig, shutter, motion = geometry.rig, geometry.shutter, geometry.motion
    if view.shutter == "gs":
        R, t = rig.cam_from_world(motion, shutter.time_after(view.row, view.frame, view.side), view.side)
        entry = np.concatenate([R.ravel(), t, np.zeros(12)])
        return _Table(np.stack([entry, entry]), 0.0)
    lines = shutter.lines(view.side)
    rate = shutter.rate(view.side)[shutter.axis(view.side)]
    per_line = 1
    while per_line <= _FINEST:
        at = np.linspace(-1.0, lines, (lines + 1) * per_line + 1)
        tau = shutter.line_time(at, view.frame, view.side)
        R, t = rig.cam_from_world(motion, tau, view.side)
        spin, speed = motion.velocity(tau)
        if not rig.aligned:
            turn = rig.own(view.side).R.T
            spin, speed = spin @ turn, speed @ turn
        changes = np.concatenate([(hat(spin) @ R).reshape(-1, 9), speed], axis=1) * (rate / per_line)
        entries = np.concatenate([R.reshape(-1, 9), t, changes], axis=1)
        between = shutter.line_time(at[:-1] + 0.5 / per_line, view.frame, view.side)
        R, t = rig.cam_from_world(motion, between, view.side)
        middle = 0.5 * (entries[:-1, :12] + entries[1:, :12]) + 0.125 * (entries[:-1, 12:] - entries[1:, 12:])
        off = np.max(np.abs(middle - np.concatenate([R.reshape(-1, 9), t], axis=1)))
        if off <= (_SAME if per_line < _FINEST else _AT_JUMPS):
            return _Table(entries, float(per_line))
        per_line *= 2
    raise RsbenchError(
        f"motion model {type(motion).__name__}: jumps between the lines of {view.image}, or its velocity is not "
        "the derivative of its poses: channels of truth cannot be made"
    )


def _optics_of(camera: PinholeCamera) -> FloatArray:
    """(21,) width, height, fx, fy, cx, cy; 1 for a camera with a lens, and its ``lens_table``."""
    lens = np.zeros(14) if camera.lens is None else lens_table(camera, camera.lens)
    own = [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.lens is not None]
    return np.concatenate([own, lens])


@compiled
def reproject_rows(
    table: FloatArray,
    per_line: float,
    camera: FloatArray,
    axis: int,
    lines: int,
    points: FloatArray,
    start: FloatArray,
    pixels: FloatArray,
    eyes: FloatArray,
    status: NDArray[np.uint8],
    in_camera: FloatArray,
) -> None:
    """Fill the fields of ``Reprojected``, and ``in_camera`` unless empty. NumPy: ``core.projection.rs_project``.

    The search for a point starts from the extrapolated result of its two neighbours in the row. Other rows have no
    effect, so that the bits of a row do not depend on the rows that are requested with it.
    """
    pose = np.zeros(12)
    _pose_between(table, 0.0, pose)
    for row in range(start.shape[0]):
        offset, change, slope = 0.0, 0.0, -1.0
        for k in range(start.shape[1]):
            X = points[row, k, 0], points[row, k, 1], points[row, k, 2]
            near = start[row, k] + offset + change
            x, y, line, slope, found = _line(table, per_line, camera, axis, lines, X, near, slope, pose)
            status[row, k] = found
            if found == _SEEN:
                change = line - start[row, k] - offset
                offset += change
                pixels[row, k, 0], pixels[row, k, 1] = x, y
            else:
                offset, change, slope = 0.0, 0.0, -1.0
            for j in range(3):
                eyes[row, k, j] = -(pose[j] * pose[9] + pose[3 + j] * pose[10] + pose[6 + j] * pose[11])
            if in_camera.size > 0:
                for j in range(3):
                    turned = pose[3 * j] * X[0] + pose[3 * j + 1] * X[1] + pose[3 * j + 2] * X[2]
                    in_camera[row, k, j] = turned + pose[9 + j]


@compiled
def _line(
    table: FloatArray,
    per_line: float,
    camera: FloatArray,
    axis: int,
    lines: int,
    X: tuple[float, float, float],
    start: float,
    slope: float,
    pose: FloatArray,
) -> tuple[float, float, float, float, int]:
    """Pixel, line, slope and status of one point, by secant steps; leaves the line's pose in ``pose`` (12,)."""
    line, step, before = start, 0.0, 0.0
    x, y, off = math.nan, math.nan, math.nan
    for _ in range(_MOST_STEPS):
        if per_line > 0.0:
            _pose_between(table, (line + 1.0) * per_line, pose)
        x, y = _pixel(pose, camera, X)
        off = (x if axis == 0 else y) - line
        if not abs(off) > _TOLERANCE_PX:
            break
        if step != 0.0:
            slope = (off - before) / step
        if not slope < 0.0:
            break
        before, step = off, -off / slope
        line += step
    if abs(off) <= _TOLERANCE_PX:
        if -0.5 <= x <= camera[0] - 0.5 and -0.5 <= y <= camera[1] - 0.5:
            return x, y, line, slope, _SEEN
        if -0.5 <= line <= lines - 0.5:
            return x, y, line, slope, _NOT_SEEN
    # Further solutions are possible, and solutions beyond a pole: the slow search for all of them decides.
    first = _off(table, per_line, camera, axis, X, -0.5, pose)
    last = _off(table, per_line, camera, axis, X, lines - 0.5, pose)
    if math.isnan(first) and math.isnan(last):
        return x, y, line, slope, _NOT_SEEN
    if abs(off) <= _TOLERANCE_PX and first * last > 0.0:
        return x, y, line, slope, _NOT_SEEN
    return x, y, line, slope, _UNSURE


@compiled
def _off(
    table: FloatArray,
    per_line: float,
    camera: FloatArray,
    axis: int,
    X: tuple[float, float, float],
    line: float,
    pose: FloatArray,
) -> float:
    """Residual of the row equation at a line, px; NaN behind the camera."""
    _pose_between(table, (line + 1.0) * per_line, pose)
    x, y = _pixel(pose, camera, X)
    return (x if axis == 0 else y) - line


@compiled
def _pose_between(table: FloatArray, place: float, pose: FloatArray) -> None:
    """Interpolate rotation and translation (12,) between entries (cubic Hermite), constant beyond the ends."""
    below = min(max(math.floor(place), 0), table.shape[0] - 2)
    u = min(max(place - below, 0.0), 1.0)
    v = 1.0 - u
    a, b, c, d = v * v * (1.0 + 2.0 * u), u * v * v, u * u * (1.0 + 2.0 * v), -u * u * v
    for k in range(12):
        pose[k] = (
            a * table[below, k] + b * table[below, 12 + k] + c * table[below + 1, k] + d * table[below + 1, 12 + k]
        )


@compiled
def _pixel(pose: FloatArray, camera: FloatArray, X: tuple[float, float, float]) -> tuple[float, float]:
    """Pixel of a point; NaN behind the camera or beyond the lens. NumPy: ``PinholeCamera.project``."""
    z = pose[6] * X[0] + pose[7] * X[1] + pose[8] * X[2] + pose[11]
    if not z > 0.0:
        return math.nan, math.nan
    x = (pose[0] * X[0] + pose[1] * X[1] + pose[2] * X[2] + pose[9]) / z
    y = (pose[3] * X[0] + pose[4] * X[1] + pose[5] * X[2] + pose[10]) / z
    if camera[6] > 0.0:
        x, y = bend(camera[7:], x, y)
    return camera[2] * x + camera[4], camera[3] * y + camera[5]


Blocked = Callable[[FloatArray, FloatArray, FloatArray | None], NDArray[np.bool_]]
"""Mask (n,) of points (n, 3) that are hidden from eyes (n, 3), world frame, metres, at times (n,), which are
needed only if objects move."""


class Rays(Protocol):
    """Ray casting in the scene of a sequence, as ``SceneRays`` implements it."""

    def blocked(
        self, eyes: FloatArray, points: FloatArray, tau: FloatArray | None = None
    ) -> NDArray[np.bool_]: ...
    def surfaces(self, eyes: FloatArray, points: FloatArray, tau: FloatArray | None = None) -> Surfaces: ...


class PairTruth(NamedTuple):
    """True displacement and visibility of the pixels of a source image in a target image."""

    offset: FloatArray
    """(H, W, 2) x_target - x_source, px; NaN where the class is UNSOLVED or OUT_OF_VIEW."""
    classes: NDArray[np.uint8]
    """(H, W) values of ``PixelClass``."""


class SeenSurfaces:
    """The surface points of the pixels of an image, and the camera's centres at their times.

    Args:
        geometry: geometry of the sequence.
        source: the image.
        depth: (H, W) depth map of the image, metres; 0: sky, which is placed at ``FAR``.
        rows: rows (H,) of the image to which ``depth`` belongs; all by default.
        numbers: (H, W) numbers of the visible moving objects, 0: none; none by default.
        stride: ``depth`` has every ``stride``-th column of the image.
    """

    def __init__(
        self,
        geometry: Geometry,
        source: ImageView,
        depth: NDArray[np.float32],
        rows: Sequence[int] | None = None,
        numbers: NDArray[np.uint8] | None = None,
        stride: int = 1,
    ) -> None:
        camera, shutter = geometry.rig.sensor(source.side), geometry.shutter
        self.geometry, self.source = geometry, source
        chosen = slice(None) if rows is None else np.asarray(rows), slice(None, None, stride)
        self.grid = camera.pixel_grid()[chosen]
        self.sky = depth == 0
        self.numbers = numbers
        if source.shutter == "gs":
            R, t = _pose(geometry, source)
            count = shutter.lines(source.side)
            poses = Pose(np.broadcast_to(R, (count, 3, 3)), np.broadcast_to(t, (count, 3)))
        else:
            poses = row_poses(geometry.rig, shutter, geometry.motion, source.side, source.frame)
        rays = camera.unproject(self.grid) if camera.lens is None else _pixel_rays(camera)[chosen]
        self.points = np.where(self.sky, FAR, depth)[..., None] * rays
        """(H, W, 3) surface points, world frame, metres."""
        eyes = inverse(poses).t
        if shutter.axis(source.side) == 1:
            lines = self.grid[:, 0, 1].astype(np.int64)
            self.points -= poses.t[lines, None]
            self.points = self.points @ poses.R[lines]
            eyes = eyes[lines, None]
        else:
            lines = self.grid[0, :, 0].astype(np.int64)
            self.points -= poses.t[lines]
            self.points = np.swapaxes(np.swapaxes(self.points, 0, 1) @ poses.R[lines], 0, 1)
            eyes = eyes[lines]
        self.eyes = np.broadcast_to(eyes, self.points.shape)
        """(H, W, 3) the camera's centres, world frame, metres."""

    @property
    def tau(self) -> FloatArray | None:
        """(H W) times of the pixels; None if the scene is static."""
        return times_at(self.geometry, self.source, self.grid).ravel() if self.geometry.objects else None


@lru_cache(maxsize=2)
def _pixel_rays(camera: PinholeCamera) -> FloatArray:
    """(H, W, 3) rays with z = 1, cached so that a lens is inverted once for all of its images."""
    return camera.unproject(camera.pixel_grid())


class Carried(NamedTuple):
    """The surface points of a source image, reprojected to a target image."""

    landed: Reprojected
    points: FloatArray
    """(H, W, 3) the points at the time of their target pixels, world frame, metres."""


def carry(
    surfaces: SeenSurfaces,
    target: ImageView,
    in_camera: FloatArray | None = None,
    **options: Any,
) -> Carried:
    """Reproject surface points to a target image, even hidden ones; ``options`` are those of ``find``."""
    start = _first_lines(surfaces, target)
    landed = find(surfaces.geometry, target, surfaces.points, start, in_camera=in_camera, **options)
    if surfaces.numbers is None or not surfaces.geometry.objects:
        return Carried(landed, surfaces.points)
    points = surfaces.points.copy()
    for number in np.unique(surfaces.numbers[surfaces.numbers > 0]):
        chosen = surfaces.numbers == number
        points[chosen], own = _carry_object(surfaces, target, int(number), chosen, start, in_camera, **options)
        for whole, part in zip(landed, own, strict=True):
            whole[chosen] = part
    return Carried(landed, points)


def _first_lines(surfaces: SeenSurfaces, target: ImageView) -> FloatArray:
    """Lines (H, W) at which the search starts: those of the source pixels, or, for a rig that is not aligned, the
    projections with the pose of the middle line."""
    rig, shutter = surfaces.geometry.rig, surfaces.geometry.shutter
    axis = shutter.axis(target.side)
    if rig.aligned:
        return surfaces.grid[..., axis]
    middle = 0.5 * (shutter.lines(target.side) - 1)
    tau = shutter.line_time(middle, target.frame, target.side)
    pose = rig.cam_from_world(surfaces.geometry.motion, tau, target.side)
    line = rig.sensor(target.side).project(transform(pose, surfaces.points))[..., axis]
    return np.clip(np.where(np.isnan(line), middle, line), -0.5, 2.0 * middle + 0.5)


def pair_truth(surfaces: SeenSurfaces, target: ImageView, carried: Carried, blocked: Blocked) -> PairTruth:
    """The displacement and visibility of reprojected pixels; ``blocked`` is called once."""
    landed, points = carried
    return PairTruth(landed.pixels - surfaces.grid, _classes(surfaces, target, landed, points, blocked))


def _carry_object(
    surfaces: SeenSurfaces,
    target: ImageView,
    number: int,
    chosen: NDArray[np.bool_],
    start: FloatArray,
    in_camera: FloatArray | None,
    **options: Any,
) -> tuple[FloatArray, Reprojected]:
    """The chosen points (n, 3) of a moving object at the times of their target pixels, and these pixels."""
    geometry, thing = surfaces.geometry, surfaces.geometry.objects[number - 1]
    tau = times_at(geometry, surfaces.source, surfaces.grid[chosen])
    X = transform(inverse(thing.world_from_object(tau)), surfaces.points[chosen])
    # Search for each point separately, as its neighbours in the row may belong to other objects.
    seen = None if in_camera is None else np.zeros((len(X), 1, 3))
    found = find(
        seen_from(geometry, number), target, X[:, None], start[chosen][:, None], in_camera=seen, **options
    )
    if in_camera is not None and seen is not None:
        in_camera[chosen] = seen[:, 0]
    there = thing.world_from_object(times_at(geometry, target, found.pixels[:, 0]))
    eyes = transform(there, found.eyes[:, 0])
    return transform(there, X), Reprojected(found.pixels[:, 0], eyes, found.unsolved[:, 0])


def surface_truth(surfaces: SeenSurfaces, rays: Rays) -> Surfaces:
    """Normals (H, W, 3) and instances (H, W) at the pixels of a rolling-shutter frame; 0 in the sky."""
    shape = surfaces.sky.shape
    seen = rays.surfaces(surfaces.eyes.reshape(-1, 3), surfaces.points.reshape(-1, 3), surfaces.tau)
    normals, instances = seen.normals.reshape(*shape, 3), seen.instances.reshape(shape)
    normals[surfaces.sky], instances[surfaces.sky] = 0.0, 0
    return seen._replace(normals=normals, instances=instances)


def _classes(
    surfaces: SeenSurfaces, target: ImageView, landed: Reprojected, points: FloatArray, blocked: Blocked
) -> NDArray[np.uint8]:
    """(H, W) values of ``PixelClass``; ``points`` (H, W, 3) are those at the times of their target pixels."""
    inside = np.isfinite(landed.pixels[..., 0])
    moves = bool(surfaces.geometry.objects)
    tau = times_at(surfaces.geometry, target, landed.pixels).ravel() if moves else None
    hidden = blocked(landed.eyes.reshape(-1, 3), points.reshape(-1, 3), tau).reshape(inside.shape)
    classes = np.where(hidden, np.uint8(PixelClass.OCCLUDED), np.uint8(PixelClass.VISIBLE))
    of_sky = np.where(hidden, np.uint8(PixelClass.SKY_OCCLUDED), np.uint8(PixelClass.SKY))
    classes[surfaces.sky] = of_sky[surfaces.sky]
    classes[~inside] = PixelClass.OUT_OF_VIEW
    classes[landed.unsolved] = PixelClass.UNSOLVED
    return classes
