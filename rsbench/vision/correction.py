"""Correction of a rolling-shutter frame: the global-shutter image at a chosen time.

Every pixel is back-projected with its row's pose (paper, eq. 11a) and projected at the target pose (eq. 11b). The
two steps are one map in the pixel and its inverse depth, ``h = M_y (x, y, 1) + rho b_y`` with
``M_y = K R K^-1``, ``b_y = K t`` and ``R, t`` the target pose from row y's pose, so a surface at infinity
(rho = 0) needs no special case: it moves by rotation alone and every other surface hides it. The target pixel is
``h_xy / h_z``, its inverse depth ``rho / h_z``. Lines are rows, or columns where those are read.

Four neighbouring pixel centres make two triangles; source coordinates and inverse depth are interpolated affinely
over each triangle at the target pixel centres that it covers, with a z-buffer, and the image is resampled once, at
these source coordinates. Inverse depth is affine in the image of a plane, so that is exact; source coordinates
are not (the map is projective and curved by the shutter), but over one pixel the deviation is an eighth of the
map's second derivative, well below 1e-3 px. Neighbours on different surfaces are not joined (``connect``); there
each pixel draws its own cell, half a pixel to every side along the surface it belongs to, so that a tear leaves
no gap where the camera saw both surfaces.

A lens changes where the maps begin and end, not how often an image is resampled: source and target are both images
of the camera with its lens, and times belong to the pixels of the source as the sensor has it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.components.motion_kernels import Vector
from rsbench.core.camera import PinholeCamera
from rsbench.core.geometry import MovingRig
from rsbench.core.projection import row_poses
from rsbench.core.rig import Side, View
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.vision.images import Interpolation, resample
from rsbench.vision.reprojection import LineMaps, line_of, look, optics_of, see

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

RIGHT, BELOW = 1, 2
"""Bits of ``connect``: joined to the neighbour on the right, below."""
_SLACK = 1e-7  # px and barycentric; a centre on a shared edge must fall into one triangle at least
_DEGENERATE = 1e9  # inverse area, px^-2, of a triangle seen edge-on
_MAX_STRETCH = 16.0  # px that one source pixel may span at the target: wider ones show nothing and cost their area
_SAME_SURFACE = 1.001  # a cell yields to the mesh unless it is nearer by this factor of inverse depth


@compiled(error_model="numpy")
def _continues(step: float, before: float, after: float, limit: float) -> bool:
    """Whether a step between neighbours is small or continues the surface on one side of it.

    ``before`` and ``after`` are the steps on its two sides, NaN where there is none. On a plane all three are
    equal, at a crease the step equals one of them, at a jump neither. NaN fails every comparison.
    """
    return abs(step) <= limit or abs(step - before) <= limit or abs(step - after) <= limit


@compiled(error_model="numpy")
def connect(rho: F32, limit: F64) -> U8:
    """(H, W) bits RIGHT and BELOW: the neighbours that lie on the same surface.

    ``rho`` (H, W) is inverse depth, NaN where unknown; ``limit`` (H, W) the largest unexplained step of inverse
    depth between a pixel and its neighbours.
    """
    height, width = rho.shape
    joined = np.zeros((height, width), dtype=np.uint8)
    for y in range(height):
        for x in range(width - 1):
            step = rho[y, x + 1] - rho[y, x]
            before = rho[y, x] - rho[y, x - 1] if x > 0 else np.nan
            after = rho[y, x + 2] - rho[y, x + 1] if x + 2 < width else np.nan
            if _continues(step, before, after, min(limit[y, x], limit[y, x + 1])):
                joined[y, x] = RIGHT
    for y in range(height - 1):
        for x in range(width):
            step = rho[y + 1, x] - rho[y, x]
            before = rho[y, x] - rho[y - 1, x] if y > 0 else np.nan
            after = rho[y + 2, x] - rho[y + 1, x] if y + 2 < height else np.nan
            if _continues(step, before, after, min(limit[y, x], limit[y + 1, x])):
                joined[y, x] |= BELOW
    return joined


LineMap = tuple[Vector, Vector, Vector, Vector]
"""The rows of M of one line, and its b."""


@compiled(error_model="numpy", inline="always")
def line_map(maps: LineMaps, line: int) -> LineMap:
    """The map of one line. A loop over a row's pixels that loads it before is compiled to vector instructions."""
    M, b = maps.M, maps.b
    return (
        (M[line, 0, 0], M[line, 0, 1], M[line, 0, 2]),
        (M[line, 1, 0], M[line, 1, 1], M[line, 1, 2]),
        (M[line, 2, 0], M[line, 2, 1], M[line, 2, 2]),
        (b[line, 0], b[line, 1], b[line, 2]),
    )


@compiled(error_model="numpy", inline="always")
def move_by(line: LineMap, maps: LineMaps, x: int, y: int, rho: float) -> Vector:
    """``move`` by the map of the pixel's line."""
    A, B, C, b = line
    gx, gy = look(maps.ideal, x, y)
    z = C[0] * gx + C[1] * gy + C[2] + rho * b[2]
    s = 1.0 / z if z > 0.0 else np.nan
    u = A[0] * gx + A[1] * gy + A[2] + rho * b[0]
    v = B[0] * gx + B[1] * gy + B[2] + rho * b[1]
    px, py = see(maps.lens, u * s, v * s)
    return px, py, rho * s


@compiled(error_model="numpy", inline="always")
def move(maps: LineMaps, x: int, y: int, rho: float) -> Vector:
    """Target pixel and inverse depth of a source pixel; NaN behind the target camera or where rho is NaN."""
    return move_by(line_map(maps, line_of(maps.columns, x, y)), maps, x, y, rho)


@compiled(error_model="numpy")
def move_pixels(rho: F32, maps: LineMaps, moved: F64) -> None:
    """Fill ``moved`` (3, H, W) with target x, y and inverse depth of every source pixel centre."""
    for y in range(rho.shape[0]):
        move_row(maps, y, rho, moved[:, y])


@compiled(error_model="numpy")
def move_row(maps: LineMaps, y: int, rho: F32, out: F64) -> None:
    """``move`` of a row of pixels into ``out`` (3, W)."""
    if maps.columns:
        for x in range(rho.shape[1]):
            out[0, x], out[1, x], out[2, x] = move_by(line_map(maps, x), maps, x, y, rho[y, x])
    else:
        line = line_map(maps, y)
        for x in range(rho.shape[1]):
            out[0, x], out[1, x], out[2, x] = move_by(line, maps, x, y, rho[y, x])


@compiled(error_model="numpy")
def draw_mesh(rho: F32, joined: U8, maps: LineMaps, source_map: F32, buffer: F32) -> None:
    """Draw the triangles of all joined neighbours into ``source_map`` (H, W, 2) and ``buffer`` (H, W).

    ``buffer`` holds inverse depth at the target, -1 where nothing is drawn yet; the larger value wins.
    """
    height, width = rho.shape
    rows = np.zeros((2, 3, width))
    for y in range(height):
        upper, lower = rows[(y + 1) & 1], rows[y & 1]
        move_row(maps, y, rho, lower)
        if y > 0:
            _draw_strip(upper.T, lower.T, joined, y, source_map, buffer)


@compiled(error_model="numpy", inline="always")
def _draw_strip(upper: F64, lower: F64, joined: U8, y: int, source_map: F32, buffer: F32) -> None:
    """Draw the triangles between the moved pixel centres (W, 3) of rows y - 1 and y."""
    for x in range(joined.shape[1] - 1):
        top, bottom = joined[y - 1, x] & RIGHT != 0, joined[y, x] & RIGHT != 0
        left, right = joined[y - 1, x] & BELOW != 0, joined[y - 1, x + 1] & BELOW != 0
        whole = top and bottom and left and right
        if (top and left) or (bottom and right):
            # Both triangles of a whole quad; of a torn one those whose two sides are whole.
            first, second = whole or (top and left), whole or (bottom and right)
            _quad(upper, lower, x, x + 1, y - 1, first, second, source_map, buffer)
        if not whole and ((top and right) or (bottom and left)):
            # The other diagonal may still join three corners: the same quad, mirrored.
            _quad(upper, lower, x + 1, x, y - 1, top and right, bottom and left, source_map, buffer)


@compiled(error_model="numpy", inline="always")
def _covered(a: float, b: float, c: float, d: float, size: int) -> tuple[int, int]:
    """First and last pixel between the corners' coordinates; an empty range if one is NaN or they are too far
    apart."""
    low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    if not high - low <= _MAX_STRETCH:
        return 1, 0
    return int(max(0.0, np.ceil(low - _SLACK))), int(min(size - 1.0, np.floor(high + _SLACK)))


@compiled(error_model="numpy", inline="always")
def _quad(
    upper: F64, lower: F64, near: int, far: int, y: int, first: bool, second: bool, source_map: F32, buffer: F32
) -> None:
    """Draw two triangles of the quad of source columns ``near`` and ``far``, rows y and y + 1.

    ``first`` has its right angle at (near, y), ``second`` at (far, y + 1). ``upper`` and ``lower`` (W, 3) hold
    (target x, y, inverse depth) of the two rows.
    """
    # Scalars, because numba counts references of every array view.
    ax, ay, az = upper[near, 0], upper[near, 1], upper[near, 2]
    bx, by, bz = upper[far, 0], upper[far, 1], upper[far, 2]
    cx, cy, cz = lower[near, 0], lower[near, 1], lower[near, 2]
    dx, dy, dz = lower[far, 0], lower[far, 1], lower[far, 2]
    height, width = buffer.shape
    start, stop = _covered(ax, bx, cx, dx, width)
    top, bottom = _covered(ay, by, cy, dy, height)
    if not (start <= stop and top <= bottom):
        return
    ux, uy, vx, vy = bx - ax, by - ay, cx - ax, cy - ay
    wx, wy, zx, zy = cx - dx, cy - dy, bx - dx, by - dy
    scale, scale_2 = 1.0 / (ux * vy - uy * vx), 1.0 / (wx * zy - wy * zx)
    # Also false for NaN, a corner behind the target camera.
    first = first and abs(scale) < _DEGENERATE
    second = second and abs(scale_2) < _DEGENERATE
    for row in range(top, bottom + 1):
        for column in range(start, stop + 1):
            px, py = column - ax, row - ay
            s, t = (px * vy - py * vx) * scale, (ux * py - uy * px) * scale
            z = az + s * (bz - az) + t * (cz - az)
            if not (first and s >= -_SLACK and t >= -_SLACK and s + t <= 1.0 + _SLACK):
                px, py = column - dx, row - dy
                s, t = (px * zy - py * zx) * scale_2, (wx * py - wy * px) * scale_2
                if not (second and s >= -_SLACK and t >= -_SLACK and s + t <= 1.0 + _SLACK):
                    continue
                z = dz + s * (cz - dz) + t * (bz - dz)
                s, t = 1.0 - s, 1.0 - t
            nearness = np.float32(z)
            if nearness > buffer[row, column]:
                buffer[row, column] = nearness
                source_map[row, column, 0] = near + (far - near) * s
                source_map[row, column, 1] = y + t


@compiled(error_model="numpy")
def draw_cells(rho: F32, joined: U8, maps: LineMaps, source_map: F32, buffer: F32) -> None:
    """Draw the cells of pixels that are not joined to four neighbours, behind ``draw_mesh``'s result.

    A cell reaches half a pixel beyond the centre along its own surface: the boundary between two surfaces is
    taken to lie halfway between the two pixel centres, and the frame to end half a pixel beyond its outermost
    ones, so that a warp by almost nothing loses no row or column.
    """
    height, width = rho.shape
    for y in range(height):
        for x in range(width):
            if not rho[y, x] >= 0.0:
                continue
            right, left = joined[y, x] & RIGHT, x > 0 and joined[y, x - 1] & RIGHT
            below, above = joined[y, x] & BELOW, y > 0 and joined[y - 1, x] & BELOW
            if right and left and below and above:
                continue
            # Steps of inverse depth along the surface, 0 where nothing is known of its slope.
            ahead = x + 1 if right else x
            behind = x - 1 if left else x
            along_x = (rho[y, ahead] - rho[y, behind]) / max(ahead - behind, 1)
            ahead = y + 1 if below else y
            behind = y - 1 if above else y
            along_y = (rho[ahead, x] - rho[behind, x]) / max(ahead - behind, 1)
            _cell(rho, x, y, (along_x, along_y), maps, source_map, buffer)


@compiled(error_model="numpy")
def _cell(
    rho: F32, x: int, y: int, along: tuple[float, float], maps: LineMaps, source_map: F32, buffer: F32
) -> None:
    """Draw the parallelogram to which the square of half a pixel around source pixel (x, y) is moved.

    ``along`` are the steps of inverse depth to the next column and row.
    """
    height, width = buffer.shape
    own_height, own_width = rho.shape
    columns = maps.columns
    ax, ay, az = move(maps, x, y, rho[y, x])
    # The next line has another pose, also at the last one, whose next neighbour does not exist. A row's goes on.
    right = -1 if x + 1 == own_width and (columns or maps.ideal is not None) else 1
    bx, by, bz = move(maps, x + right, y, rho[y, x] + right * along[0])
    step = 1 if y + 1 < own_height else -1
    cx, cy, cz = move(maps, x, y + step, rho[y, x] + step * along[1])
    ux, uy, uz = right * (bx - ax), right * (by - ay), right * (bz - az)
    vx, vy, vz = step * (cx - ax), step * (cy - ay), step * (cz - az)
    scale = 1.0 / (ux * vy - uy * vx)
    if not abs(scale) < _DEGENERATE:
        return
    reach_x, reach_y = 0.5 * (abs(ux) + abs(vx)) + _SLACK, 0.5 * (abs(uy) + abs(vy)) + _SLACK
    if not (2.0 * reach_x <= _MAX_STRETCH and 2.0 * reach_y <= _MAX_STRETCH):
        return
    top, bottom = max(0.0, np.ceil(ay - reach_y)), min(height - 1.0, np.floor(ay + reach_y))
    left, right = max(0.0, np.ceil(ax - reach_x)), min(width - 1.0, np.floor(ax + reach_x))
    if not (top <= bottom and left <= right):
        return
    half = 0.5 + _SLACK
    for row in range(int(top), int(bottom) + 1):
        for column in range(int(left), int(right) + 1):
            px, py = column - ax, row - ay
            s = (px * vy - py * vx) * scale
            t = (ux * py - uy * px) * scale
            if abs(s) <= half and abs(t) <= half:
                z = np.float32(max(az + s * uz + t * vz, 0.0))
                if z > buffer[row, column] * _SAME_SURFACE or buffer[row, column] < 0.0:
                    buffer[row, column] = z
                    source_map[row, column, 0] = x + s
                    source_map[row, column, 1] = y + t


@compiled(error_model="numpy")
def draw_moved(moved: F64, joined: U8, source_map: F32, buffer: F32) -> None:
    """``draw_mesh`` for pixel centres that were already moved: ``moved`` (H, W, 3) has target x, y and inverse
    depth; NaN is not drawn."""
    for y in range(1, len(joined)):
        _draw_strip(moved[y - 1], moved[y], joined, y, source_map, buffer)


def draw_within(moved: F64, stretch: float) -> tuple[F32, F32]:
    """Source pixel (H, W, 2) and inverse depth (H, W), -1 if there is none, of the mesh of ``moved`` (H, W, 3).

    Neighbours that are more than ``stretch`` px apart are not joined.
    """
    return draw_joined(moved, joined_within(moved, stretch))


def draw_joined(moved: F64, joined: U8) -> tuple[F32, F32]:
    """``draw_within`` for given neighbours (H, W) that are joined, in the bits of ``connect``."""
    source_map = np.full((*joined.shape, 2), np.nan, dtype=np.float32)
    buffer = np.full(joined.shape, -1.0, dtype=np.float32)
    draw_moved(moved, joined, source_map, buffer)
    return source_map, buffer


def joined_within(moved: F64, stretch: float) -> U8:
    """(H, W) bits of ``connect``: neighbours of ``moved`` (H, W, 3) that are at most ``stretch`` px apart."""
    joined = np.zeros(moved.shape[:2], dtype=np.uint8)
    _join(moved, stretch * stretch, joined)
    return joined


def joined_inside(mask: NDArray[np.bool_]) -> U8:
    """(H, W) bits of ``connect``: neighbours that are both in a mask."""
    joined = np.zeros(mask.shape, dtype=np.uint8)
    joined[:, :-1][mask[:, :-1] & mask[:, 1:]] = RIGHT
    joined[:-1] |= np.uint8(BELOW) * (mask[:-1] & mask[1:])
    return joined


@compiled(error_model="numpy")
def _join(moved: F64, square: float, joined: U8) -> None:
    """Fill ``joined`` (H, W) with the bits of ``connect``; ``square``: of the largest distance, px^2."""
    height, width = joined.shape
    for y in range(height):
        for x in range(width):
            u, v, bits = moved[y, x, 0], moved[y, x, 1], 0
            if x + 1 < width:
                du, dv = moved[y, x + 1, 0] - u, moved[y, x + 1, 1] - v
                bits = RIGHT if du * du + dv * dv <= square else 0
            if y + 1 < height:
                du, dv = moved[y + 1, x, 0] - u, moved[y + 1, x, 1] - v
                bits |= BELOW if du * du + dv * dv <= square else 0
            joined[y, x] = bits


_IMAGE_TYPES = (np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32))


@dataclass(frozen=True, kw_only=True)
class WarpOptions:
    """Options of the warp from the source image to the target image."""

    interpolation: Interpolation = "cubic"
    """Interpolation of colours between the source image's pixels."""
    tear_px: float = 0.2
    """Two neighbours are not joined if a step of depth between them that neither side's surface explains moves
    them apart by more than this, px; the mesh between surfaces thus errs by at most this."""

    def __post_init__(self) -> None:
        if self.interpolation not in get_args(Interpolation):
            raise ValueError(f"interpolation must be one of {get_args(Interpolation)}, got {self.interpolation!r}")
        if not self.tear_px > 0.0:
            raise ValueError(f"tear_px must be positive, got {self.tear_px}")


@dataclass(frozen=True, kw_only=True, eq=False)
class LineView:
    """A frame whose lines have separate poses."""

    image: NDArray[Any]
    """(H, W) or (H, W, C) of uint8, uint16 or float32."""
    depth: NDArray[Any]
    """(H, W) z in each line's own camera, metres; inf is infinitely far, 0, negative or NaN unknown."""
    poses: Pose
    """``cam_from_world`` of every line, (lines, 3, 3) and (lines, 3)."""
    camera: PinholeCamera | None = None
    """Camera of the frame if it is not that of the target: in a rig of two different cameras, or if disparities
    have an offset."""
    columns: bool = False
    """Whether lines are columns."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Corrected:
    """A frame as one camera at one time would have seen it."""

    image: NDArray[Any]
    """(H, W) or (H, W, C), type of the source; 0 where the mask is False."""
    mask: NDArray[np.bool_]
    """(H, W) mask of the pixels that the source frame saw."""
    source_map: NDArray[np.float32]
    """(H, W, 2) source pixel (x, y) of every target pixel; NaN where the mask is False."""
    depth: NDArray[np.float32]
    """(H, W) z in the target camera, metres; inf at infinity, NaN where the mask is False."""


def line_maps(
    camera: PinholeCamera,
    source_poses: Pose,
    target_pose: Pose,
    columns: bool = False,
    source_camera: PinholeCamera | None = None,
) -> LineMaps:
    """Maps from the pixels of a frame, one pose per line, to those of ``camera`` at the target pose.

    Poses are ``cam_from_world``, of every line and of the target; either may be the one that has lines.
    ``source_camera`` is the frame's camera if it differs.
    """
    R, t = compose(target_pose, inverse(source_poses))
    K = camera.ideal.K
    source = source_camera or camera
    M = K @ R @ np.linalg.inv(source.ideal.K)
    return LineMaps(M, t @ K.T, optics_of(source, columns).ideal, optics_of(camera).lens, columns)


def warp_gain(camera: PinholeCamera, source_poses: Pose, target_pose: Pose, columns: bool = False) -> FloatArray:
    """(H, 1) px m, or (1, W) for ``columns``: approximate displacement of a pixel divided by a step of its inverse
    depth, f |t|."""
    lengths = np.linalg.norm(compose(target_pose, inverse(source_poses)).t, axis=-1)
    gain = np.asarray(max(camera.fx, camera.fy) * lengths)
    return gain[np.newaxis] if columns else gain[:, np.newaxis]


def inverse_depth(depth: NDArray[Any], sky_mask: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
    """1 / depth (H, W): 0 at infinity and under ``sky_mask``, NaN where the depth is unknown (not positive)."""
    rho = np.full(depth.shape, np.nan, dtype=np.float32)
    np.divide(1.0, depth, out=rho, where=depth > 0.0, casting="same_kind")
    if sky_mask is not None:
        rho[sky_mask] = 0.0
    return rho


def warp(
    view: LineView,
    camera: PinholeCamera,
    target_pose: Pose,
    *,
    sky_mask: NDArray[np.bool_] | None = None,
    options: WarpOptions | None = None,
) -> Corrected:
    """Warp a frame with one pose per line to any pose (3, 3), (3,) of a camera; z-buffered.

    Pixels under ``sky_mask`` (H, W) are infinitely far. Raises ValueError on other shapes or types.
    """
    options = options or WarpOptions()
    source_map, buffer = drawn(view, camera, target_pose, sky_mask, options)
    mask = buffer >= 0.0
    return Corrected(
        image=resample(view.image, source_map, options.interpolation),
        mask=mask,
        source_map=source_map,
        depth=depth_of(buffer),
    )


def drawn(
    view: LineView,
    camera: PinholeCamera,
    target_pose: Pose,
    sky_mask: NDArray[np.bool_] | None,
    options: WarpOptions,
) -> tuple[F32, F32]:
    """The source pixel (H, W, 2) of each target pixel of ``warp``, and inverse depth (H, W) there: NaN and -1
    where the frame did not see the target. Raises ValueError on other shapes or types."""
    _check(view.image, view.depth, view.camera or camera, view.poses, sky_mask, view.columns)
    maps = line_maps(camera, view.poses, target_pose, view.columns, view.camera)
    rho = inverse_depth(view.depth, sky_mask)
    gain = np.broadcast_to(warp_gain(camera, view.poses, target_pose, view.columns), rho.shape)
    joined = connect(rho, options.tear_px / np.maximum(gain, np.finfo(np.float64).tiny))
    size = camera.height, camera.width
    source_map = np.full((*size, 2), np.nan, dtype=np.float32)
    buffer = np.full(size, -1.0, dtype=np.float32)
    draw_mesh(rho, joined, maps, source_map, buffer)
    draw_cells(rho, joined, maps, source_map, buffer)
    return source_map, buffer


def correct_frame(
    image: NDArray[Any],
    depth: NDArray[Any],
    moving: MovingRig,
    view: View,
    *,
    target_tau: float | None = None,
    sky_mask: NDArray[np.bool_] | None = None,
    options: WarpOptions | None = None,
) -> Corrected:
    """Correct a rolling-shutter frame (H, W[, C]) to the global-shutter image of its camera at ``target_tau``.

    ``target_tau`` is in frame periods; by default the time of the first line read. ``depth`` (H, W) is as in
    ``LineView``. Raises as ``warp`` does.
    """
    poses, target, columns = _poses(moving, view, target_tau)
    frame = LineView(image=image, depth=depth, poses=poses, columns=columns)
    return warp(frame, moving.rig.sensor(view[0]), target, sky_mask=sky_mask, options=options)


def correction_flow(
    depth: NDArray[Any],
    moving: MovingRig,
    view: View,
    *,
    target_tau: float | None = None,
    sky_mask: NDArray[np.bool_] | None = None,
) -> NDArray[np.float32]:
    """Return the displacement (H, W, 2), px, of each rolling-shutter pixel to its position at ``target_tau``.

    ``x_target - x_source`` on the grid of the source; NaN where the depth is unknown or the point is behind the
    target camera. Arguments as in ``correct_frame``.
    """
    camera = moving.rig.sensor(view[0])
    poses, target, columns = _poses(moving, view, target_tau)
    _check(None, depth, camera, poses, sky_mask, columns)
    moved = np.zeros((3, *depth.shape))
    move_pixels(inverse_depth(depth, sky_mask), line_maps(camera, poses, target, columns), moved)
    return np.asarray(np.moveaxis(moved[:2], 0, -1) - camera.pixel_grid(), dtype=np.float32)


def _poses(moving: MovingRig, view: View, target_tau: float | None) -> tuple[Pose, Pose, bool]:
    """Return the poses of a frame's lines, the target pose, and whether lines are columns."""
    rig, shutter, motion, (side, frame) = moving.rig, moving.shutter, moving.motion, view
    target = rig.cam_from_world(motion, _target_time(shutter, side, frame, target_tau), side)
    return row_poses(rig, shutter, motion, side, frame), target, shutter.axis(side) == 0


def _target_time(shutter: RollingShutter, side: Side, frame: int, target_tau: float | None) -> float:
    tau = float(shutter.start(frame, side)) if target_tau is None else float(target_tau)
    if not math.isfinite(tau):
        raise ValueError(f"target_tau must be a finite time in frame periods, got {target_tau}")
    return tau


def depth_of(buffer: F32) -> F32:
    """Convert inverse depths (...) of ``drawn`` to depths; NaN where the frame did not see the target."""
    depth = np.full(buffer.shape, np.nan, dtype=np.float32)
    with np.errstate(divide="ignore"):  # at infinity
        return np.divide(np.float32(1.0), buffer, out=depth, where=buffer >= 0.0)


def _check(
    image: NDArray[Any] | None,
    depth: NDArray[Any],
    camera: PinholeCamera,
    source_poses: Pose,
    sky_mask: NDArray[np.bool_] | None,
    columns: bool,
) -> None:
    size = (camera.height, camera.width)
    if image is not None:
        if image.ndim not in (2, 3) or image.shape[:2] != size:
            raise ValueError(f"image must have shape {size} or {size} + channels, got {image.shape}")
        if image.dtype not in _IMAGE_TYPES:
            raise ValueError(f"image must be uint8, uint16 or float32, got {image.dtype}")
    if depth.shape != size or not np.issubdtype(depth.dtype, np.floating):
        raise ValueError(f"depth must be floating point of shape {size}, got {depth.dtype} {depth.shape}")
    lines = camera.width if columns else camera.height
    if source_poses.R.shape != (lines, 3, 3) or source_poses.t.shape != (lines, 3):
        raise ValueError(f"source_poses must have one pose per line, {lines}, got {source_poses.R.shape}")
    if sky_mask is not None and (sky_mask.shape != size or sky_mask.dtype != np.bool_):
        raise ValueError(f"sky_mask must be bool of shape {size}, got {sky_mask.dtype} {sky_mask.shape}")
