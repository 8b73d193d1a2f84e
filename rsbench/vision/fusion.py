"""Fill the holes of a corrected frame from the other camera, from the other frame, and at last by a guess.

A pixel of the target is a hole of the corrected frame if the surface was hidden, lies outside the frame, or has
unknown depth. Another image of the same scene may show it. Each image is warped to the target like the frame
itself; if several show the point, the nearest surface is used, or the first view of those that agree in depth.

``finished`` prepares the frame for viewing: it closes specks and slits that no frame shows, and smooths seams. A
narrow hole can hide nothing and is closed; filling a wide one would be a guess about the scene, so it stays. The
border between a near object and the background from another frame follows pixels, so such a seam is a staircase,
whereas the frame's own edges are as fine as its optics.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core.camera import PinholeCamera
from rsbench.core.se3 import Pose
from rsbench.vision.correction import LineView, WarpOptions, depth_of, drawn, inverse_depth, line_maps, move, warp
from rsbench.vision.images import resample_at
from rsbench.vision.reprojection import LineMaps, across_lines, line_of, look, see
from rsbench.vision.stereo_depth import known_beside

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]


class Origin(IntEnum):
    """The source of a pixel of a corrected frame."""

    NOBODY = 0
    """No frame shows the point, as far as depth is known."""
    HERE = 1
    """The frame itself, at a measured depth, at infinity, or where the depth has little effect."""
    GUESSED = 2
    """The frame itself at a depth guessed from neighbours; in a tear that it does not show, another frame."""
    OTHER_CAMERA = 3
    """The other camera's frame of the same time."""
    OTHER_FRAME = 4
    """A frame of the other time, of either camera."""
    INVENTED = 5
    """No frame: a narrow hole that was closed from its surroundings."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SourceView(LineView):
    """An image that may show parts of the target."""

    origin: Origin


@dataclass(frozen=True, kw_only=True, eq=False)
class Fused:
    """A corrected frame with its holes filled as far as possible."""

    image: NDArray[Any]
    """(H, W) or (H, W, C), type of the sources; 0 where the origin is NOBODY, unless invented."""
    origin: NDArray[np.uint8]
    """(H, W) values of ``Origin``."""
    depth: NDArray[np.float32]
    """(H, W) z in the target camera, metres; inf at infinity, NaN where it is unknown or the origin is NOBODY."""
    reason: str = ""
    """Why the corrector failed for this frame; empty if it succeeded."""
    explained: float = math.nan
    """Share of the images' flow that the motion explains; NaN: not examined."""
    note: str = ""
    """How the frame was corrected if the motion of the rig does not explain the images; empty if it does."""

    @property
    def success(self) -> bool:
        """Whether there is a corrected frame."""
        return not self.reason

    @classmethod
    def seen(cls, image: NDArray[Any], mask: Mask) -> Fused:
        """A corrected frame (H, W[, C]) that shows the frame itself where ``mask`` (H, W) is True; no depth."""
        origin = np.where(mask, np.uint8(Origin.HERE), np.uint8(Origin.NOBODY))
        return cls(image=image, origin=origin, depth=np.full(mask.shape, np.nan, dtype=np.float32))

    @classmethod
    def failed(cls, image: NDArray[Any], reason: str) -> Fused:
        """The result for a frame (H, W[, C]) that could not be corrected: a black image with the ``reason``."""
        nothing = cls.seen(np.zeros_like(image), np.zeros(image.shape[:2], dtype=np.bool_))
        return replace(nothing, reason=reason)

    def shares(self) -> dict[str, float]:
        """Share of the pixels of each origin by its lower-case name."""
        counts = np.bincount(self.origin.ravel(), minlength=len(Origin))
        return {origin.name.lower(): float(counts[origin]) / self.origin.size for origin in Origin}


_AGREE = 0.03
"""Relative difference of depth below which two views show the same surface."""
_DIFFERENT = 0.06
"""Difference of colours, as a share of the full range, above which they show different surfaces."""
_ROW_STEPS = 6
"""Iterations for the row of a point; each multiplies the error by less than the readout ratio times the motion,
relative to the height of the image."""
_MARGIN = 3
"""Width, px, of the area around a hole that is drawn too, so that the mesh reaches the hole's border."""


def fuse(
    views: Sequence[SourceView], camera: PinholeCamera, target_pose: Pose, options: WarpOptions | None = None
) -> Fused:
    """Warp the first view to ``target_pose`` and fill its holes from the others.

    Measured pixels that the frame does not contradict come first, then GUESSED ones, then the contradicted ones.
    If there is a GUESSED view, tears in one surface are closed at last.

    Raises ValueError as ``rsbench.vision.correction.warp`` does.
    """
    first, others, options = views[0], views[1:], options or WarpOptions()
    corrected = warp(first, camera, target_pose, options=options)
    image, depth = corrected.image, corrected.depth
    origin = np.where(corrected.mask, np.uint8(first.origin), np.uint8(Origin.NOBODY))
    measured = [view for view in others if view.origin is not Origin.GUESSED]
    guessed = [view for view in others if view.origin is Origin.GUESSED]
    contradicted: list[tuple[_Points, Origin]] = []

    def fill(found: _Points, source: Origin) -> None:
        image[found.at], depth[found.at], origin[found.at] = found.colour, found.depth, source

    for group in (measured, guessed):
        holes = origin == Origin.NOBODY
        for view in group:
            if not np.any(holes):
                break
            found = _warp_into(view, holes, camera, target_pose, options)
            # If two views show a pixel of a hole, the nearer surface hides the other.
            known = np.nan_to_num(depth[found.at], nan=np.inf, posinf=np.inf)
            nearer = found.depth < known * (1.0 - _AGREE)
            found = found.only((origin[found.at] == Origin.NOBODY) | nearer)
            found = found.coloured(view.image, options)
            if view.origin is not Origin.GUESSED:
                against = _contradicted(first, found, camera, target_pose)
                contradicted.append((found.only(against), view.origin))
                found = found.only(~against)
            fill(found, view.origin)
    for found, source in contradicted:  # only where nothing else fills the hole
        fill(found.only(origin[found.at] == Origin.NOBODY), source)
    if guessed:
        _close_tears(image, depth, origin, (first, *measured), camera, target_pose, options)
    return Fused(image=image, origin=origin, depth=depth)


Pixels = tuple[NDArray[np.intp], NDArray[np.intp]]
"""Rows and columns of n pixels."""


class _Points(NamedTuple):
    """Pixels of the target that a view shows."""

    at: Pixels
    depth: F32
    """(n,)"""
    source: F32
    """(n, 2) pixels of the view."""
    colour: NDArray[Any]
    """(n[, C]), empty before ``coloured``."""

    def only(self, which: Mask) -> _Points:
        """Select points by a mask (n,)."""
        (y, x), rest = self.at, (each[which] for each in self[1:])
        return _Points((y[which], x[which]), *rest)

    def coloured(self, image: NDArray[Any], options: WarpOptions) -> _Points:
        """Add colours from the view's image."""
        return self._replace(colour=resample_at(image, self.source, options.interpolation))


def _close_tears(
    image: NDArray[Any],
    depth: NDArray[np.float32],
    origin: NDArray[np.uint8],
    views: Sequence[SourceView],
    camera: PinholeCamera,
    target_pose: Pose,
    options: WarpOptions,
) -> None:
    """Fill, in place, holes within one surface from the first view that shows them; their origin is GUESSED.

    A gap at a depth edge lies between two surfaces. A hole between two points of one surface, in a row or column,
    is a tear, due to pixels with unknown or wrong depth. It gets the depth of its sides, and is filled from a view
    unless that view has a nearer surface there.
    """
    rho = _surface_of_both_sides(inverse_depth(depth))
    for view in views:
        y, x = np.nonzero((origin == Origin.NOBODY) & np.isfinite(rho))
        if not len(y):
            break
        places, expected, known = _look_up(view, rho[y, x], (y, x), camera, target_pose)
        take = np.isfinite(places[:, 0]) & ~(known * (1.0 - _AGREE) > expected)
        at = y[take], x[take]
        image[at] = resample_at(view.image, places[take], options.interpolation)
        origin[at] = Origin.GUESSED
        with np.errstate(divide="ignore"):  # at infinity
            depth[at] = 1.0 / rho[at]


def _surface_of_both_sides(rho: NDArray[np.float32]) -> NDArray[np.float32]:
    """Inverse depth (H, W) of the farther of the surfaces on both sides of a pixel; NaN if these differ.

    The sides are the nearest known pixels in the row, or in the column if those in the row differ.
    """
    found = np.full_like(rho, np.nan)
    for sides in (known_beside(rho), tuple(side.T for side in known_beside(rho.T))):
        one = np.abs(sides[0] - sides[1]) <= _AGREE * np.maximum(*sides)
        found = np.where(np.isnan(found) & one, np.minimum(*sides), found)
    return found


def _contradicted(frame: SourceView, found: _Points, camera: PinholeCamera, target_pose: Pose) -> Mask:
    """(n,) mask of points of another view whose reprojection to ``frame`` shows something else.

    There the frame has a farther surface, or no depth and another colour: an object that only the frame shows,
    often near and thin, is in front of the point, which must not be drawn over it. If the frame has a nearer
    surface, the point was hidden, which is no contradiction.
    """
    places, expected, known = _look_up(frame, inverse_depth(found.depth), found.at, camera, target_pose)
    seen, unlike = np.isfinite(places[:, 0]), np.zeros(len(places), dtype=np.bool_)
    shown = found.only(seen)._replace(colour=resample_at(frame.image, places[seen], "linear"))
    unlike[seen] = _differ(shown, found.colour[seen], (camera.height, camera.width))
    return seen & np.where(np.isnan(known), unlike, known < expected * (1.0 - _AGREE))


def _look_up(
    view: SourceView, rho: F32, at: Pixels, camera: PinholeCamera, target_pose: Pose
) -> tuple[F32, F32, F32]:
    """Reproject pixels of the target with inverse depth ``rho`` (n,) to a view.

    Returns:
        The pixels (n, 2), NaN outside the view; the inverse depth (n,) of the points in the view; the view's own
        inverse depth there, NaN where it is unknown.
    """
    own = view.camera or camera
    maps = line_maps(own, target_pose, view.poses, view.columns, camera)
    places, expected = np.full((len(rho), 2), np.nan, dtype=np.float32), np.zeros(len(rho), dtype=np.float32)
    y, x = (np.ascontiguousarray(each) for each in at)  # compiled for one layout
    _find_in_lines(rho, y, x, maps, own.width, own.height, places, expected)
    inside, known = np.isfinite(places[:, 0]), np.full(len(rho), np.nan, dtype=np.float32)
    # The frame ends half a pixel beyond the last centre, which may be rounded to the next pixel in float32.
    nearest = np.rint(places[inside]).astype(np.intp)
    x, y = np.clip(nearest, 0, (own.width - 1, own.height - 1)).T
    known[inside] = inverse_depth(view.depth[y, x])
    return places, expected, known


def _differ(points: _Points, colour: NDArray[Any], shape: tuple[int, int]) -> Mask:
    """(n,) whether colours differ from those of the points in the mean over the points in 3 x 3 pixels."""
    levels = np.iinfo(colour.dtype).max if np.issubdtype(colour.dtype, np.integer) else 1.0
    apart, here = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
    each = np.abs(points.colour.astype(np.float32) - colour.astype(np.float32))
    apart[points.at] = (each if each.ndim == 1 else each.max(axis=-1)) / np.float32(levels)
    here[points.at] = 1.0
    count, mean = (cv2.blur(values, (3, 3))[points.at] for values in (here, apart))
    return np.asarray(mean / np.maximum(count, np.float32(1e-6)) > _DIFFERENT)


@compiled(error_model="numpy")
def _find_in_lines(
    rho: F32,
    ys: NDArray[np.intp],
    xs: NDArray[np.intp],
    maps: LineMaps,
    view_width: int,
    view_height: int,
    places: F32,
    seen_rho: F32,
) -> None:
    """Reproject pixels (n,) of the target with inverse depth ``rho`` (n,) to a rolling-shutter frame.

    Fills ``places`` (n, 2), px, and ``seen_rho`` (n,), the inverse depth there, for points inside the frame of
    ``view_width`` x ``view_height`` pixels. ``maps`` lead to each line's camera.
    """
    M, b, columns = maps.M, maps.b, maps.columns
    lines = len(M)
    for k in range(len(rho)):
        y, x = ys[k], xs[k]
        gx, gy = look(maps.ideal, x, y)
        line, u, v, s = min(line_of(columns, x, y), lines - 1), np.nan, np.nan, np.nan
        for _ in range(_ROW_STEPS):
            z = M[line, 2, 0] * gx + M[line, 2, 1] * gy + M[line, 2, 2] + rho[k] * b[line, 2]
            s = 1.0 / z if z > 0.0 else np.nan
            u = (M[line, 0, 0] * gx + M[line, 0, 1] * gy + M[line, 0, 2] + rho[k] * b[line, 0]) * s
            v = (M[line, 1, 0] * gx + M[line, 1, 1] * gy + M[line, 1, 2] + rho[k] * b[line, 1]) * s
            u, v = see(maps.lens, u, v)
            along = across_lines(columns, u, v)
            if not -lines < along < 2 * lines:  # NaN included
                break
            line = min(max(int(along + 0.5), 0), lines - 1)
        if -0.5 < u < view_width - 0.5 and -0.5 < v < view_height - 0.5:
            places[k, 0], places[k, 1], seen_rho[k] = u, v, rho[k] * s


def _warp_into(
    view: SourceView, holes: Mask, camera: PinholeCamera, target_pose: Pose, options: WarpOptions
) -> _Points:
    """Find the pixels of the holes (H, W) that a view shows, without their colours."""
    maps = line_maps(camera, view.poses, target_pose, view.columns, view.camera)
    wanted = cv2.dilate(holes.astype(np.uint8), np.ones((2 * _MARGIN + 1, 2 * _MARGIN + 1), np.uint8))
    depth = np.zeros_like(view.depth)
    if _keep_landing(view.depth, inverse_depth(view.depth), maps, wanted, depth) == 0:
        source_map, buffer = np.zeros((*holes.shape, 2), dtype=np.float32), np.full(holes.shape, -1.0, np.float32)
    else:
        source_map, buffer = drawn(replace(view, depth=depth), camera, target_pose, None, options)
    y, x = np.nonzero(holes & (buffer >= 0.0))
    return _Points((y, x), depth_of(buffer[y, x]), source_map[y, x], np.zeros((len(y), 0)))


@compiled(error_model="numpy")
def _keep_landing(
    depth: NDArray[np.float32],
    rho: NDArray[np.float32],
    maps: LineMaps,
    wanted: NDArray[np.uint8],
    kept: NDArray[np.float32],
) -> int:
    """Copy to ``kept`` the depth (H, W) of pixels that are mapped to ``wanted`` target pixels (h, w).

    ``rho`` is inverse depth, NaN where unknown. Returns the number of these pixels.
    """
    height, width = wanted.shape
    count = 0
    for y in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            if np.isnan(rho[y, x]):
                continue
            u, v, _ = move(maps, x, y, rho[y, x])
            u, v = u + 0.5, v + 0.5
            if 0.0 <= u < width and 0.0 <= v < height and wanted[int(v), int(u)] != 0:  # NaN is outside
                kept[y, x] = depth[y, x]
                count += 1
    return count


def inpaint(image: NDArray[Any], missing: Mask, radius: float = 3.0) -> NDArray[Any]:
    """``image`` (H, W[, C]), uint8 or uint16, with its ``missing`` (H, W) pixels filled from those around them.

    Telea, "An image inpainting technique based on the fast marching method", 2004 (OpenCV).
    """
    if not np.any(missing) or np.all(missing):
        return image.copy()
    marked = missing.astype(np.uint8)
    if image.dtype == np.uint8 and (image.ndim == 2 or image.shape[2] == 3):
        return np.asarray(cv2.inpaint(np.ascontiguousarray(image), marked, radius, cv2.INPAINT_TELEA))
    planes = np.moveaxis(np.atleast_3d(image), -1, 0)
    filled = [cv2.inpaint(np.ascontiguousarray(plane), marked, radius, cv2.INPAINT_TELEA) for plane in planes]
    return np.stack(filled, axis=-1).reshape(image.shape)


_WIDTH_SHARE, _LEAST_PX = 0.015, 5
"""Largest width of a hole that is closed, as a share of the image's width; least value, px, in small images."""
_LARGE_DISCS = 16
"""Least area of a region that stays black, in squares of that width; smaller ones would look like blots."""
_RADIUS_PX = 3.0
_SEAM_PX, _JUMP = 0.5, 0.05
"""Standard deviation of the blur along seams, px; least relative difference of depth at an object's border."""
_FAR = 1e6
"""Replaces infinite and unknown depth, in the unit of depth."""


def narrow(holes: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Select the parts of ``holes`` (H, W) to close: all but large regions that consist of discs of that width.

    The outside of the image does not belong to a hole.
    """
    size = max(round(_WIDTH_SHARE * holes.shape[1]), _LEAST_PX) | 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    given = holes.astype(np.uint8)
    core = cv2.erode(given, disc, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    wide = cv2.dilate(core, disc)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(wide, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= _LARGE_DISCS * size**2
    large[0] = False  # label 0 is no hole
    return np.asarray(holes & ~large[labels])


def finished(fused: Fused) -> Fused:
    """The frame with narrow holes closed (INVENTED) and seams smoothed; a failed one is returned unchanged."""
    return _smooth_seams(_closed(fused)) if fused.success else fused


def _closed(fused: Fused) -> Fused:
    holes = fused.origin == Origin.NOBODY
    closed = narrow(holes)
    if not np.any(closed):
        return fused
    # Wide holes are filled too and then restored, as slits must not be closed with their black.
    image = inpaint(fused.image, holes, _RADIUS_PX)
    image[holes & ~closed] = 0
    origin = np.where(closed, np.uint8(Origin.INVENTED), fused.origin)
    return replace(fused, image=image, origin=origin)


def _smooth_seams(fused: Fused) -> Fused:
    """Blur by half a pixel where two sources meet at a jump of the depth."""
    known = np.isfinite(fused.depth) & (fused.depth > 0.0)
    distance = np.log(np.where(known, fused.depth, np.float32(_FAR)))
    sources, jumps = (
        _beside([np.abs(np.diff(each, axis=axis)) > least for axis in (0, 1)])
        for each, least in ((fused.origin.astype(np.int16), 0), (distance, np.log1p(_JUMP)))
    )
    seen = cv2.erode((fused.origin != Origin.NOBODY).astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.bool_)
    seam = sources & jumps & seen
    if not np.any(seam):
        return fused
    image = fused.image.copy()
    image[seam] = cv2.GaussianBlur(image, (3, 3), _SEAM_PX)[seam]
    return replace(fused, image=image)


def _beside(between: list[NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """(H, W) pixels beside a border between neighbours, (H - 1, W) down columns and (H, W - 1) along rows."""
    down, across = (
        np.pad(each, [(1, 1) if k == axis else (0, 0) for k in (0, 1)]) for axis, each in enumerate(between)
    )
    return np.asarray(down[1:] | down[:-1] | across[:, 1:] | across[:, :-1])
