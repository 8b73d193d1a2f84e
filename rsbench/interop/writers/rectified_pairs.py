"""Corrected frames as rectified global-shutter pairs, with the calibration that stereo and SLAM programs read.

A corrected frame has the pixel grid of its own camera. Here it is resampled to a camera without distortion whose
axes are the body axes of the rig: the cameras of the pair then differ only by a translation along their rows, as
after OpenCV's stereoRectify. R1, R2, P1, P2 and Q have OpenCV's conventions. Frames of an ideal rig without
distortion are rectified already and are not resampled.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.so3 import FloatArray
from rsbench.dataset.corrected_frames import write_origin
from rsbench.interop.writers.colmap_and_tum import camera_line
from rsbench.interop.writers.kitti_and_kalibr import disparity_values
from rsbench.interop.writers.sequence_views import projections, write_lines
from rsbench.storage.files import write_depth, write_png, write_png16
from rsbench.vision.fusion import Fused, Origin
from rsbench.vision.images import resample

FOLDER = "rectified"
_ONE_SURFACE = 1.05
"""Largest ratio of the depths around a pixel up to which they belong to one surface and are interpolated."""


def rectified_camera(rig: StereoRig) -> PinholeCamera:
    """Return the camera model of both cameras of the rectified pair, whose axes are the body axes."""
    if rig.rectified or not rig.aligned:
        return rig.camera
    focal = float(np.mean(rig.camera.central_focal))
    return replace(rig.camera.ideal, fx=focal, fy=focal)


def rectify(fused: Fused, rig: StereoRig, side: Side) -> Fused:
    """Resample a corrected frame to ``rectified_camera``; the depth is z in that camera."""
    if rig.rectified:
        return fused
    camera, sensor = rectified_camera(rig), rig.sensor(side)
    rays = camera.unproject(camera.pixel_grid())
    pixels = rig.eye(side).project(rays)
    seen = sensor.contains(pixels)
    nearest = np.rint(np.where(seen[..., None], pixels, 0.0)).astype(np.intp)
    row, column = np.clip(nearest[..., 1], 0, sensor.height - 1), np.clip(nearest[..., 0], 0, sensor.width - 1)
    origin = np.where(seen, fused.origin[row, column], np.uint8(Origin.NOBODY))
    image = resample(fused.image, np.where(seen[..., None], pixels, np.nan).astype(np.float32))
    image[origin == Origin.NOBODY] = 0
    inverse = _inverse_depth(fused.depth, pixels, row, column)
    with np.errstate(divide="ignore"):
        depth = 1.0 / inverse / (rays @ rig.own(side).R[2])
    depth[origin == Origin.NOBODY] = np.nan
    return replace(fused, image=image, origin=origin, depth=depth.astype(np.float32))


def _inverse_depth(
    depth: NDArray[np.float32], pixels: FloatArray, row: NDArray[np.intp], column: NDArray[np.intp]
) -> FloatArray:
    """Interpolate 1 / z of a depth map at pixels (H, W, 2), whose nearest are (row, column); NaN where unknown.

    For a plane, 1 / z is a linear function of the pixel without distortion, and nearly linear with distortion.
    """
    known = np.where(depth > 0.0, depth, np.nan)
    inverse = np.where(np.isnan(known), np.float32(-1.0), np.float32(1.0) / known).astype(np.float32)
    around = np.ones((3, 3), np.uint8)
    low = cv2.erode(inverse, around)
    smooth = (cv2.dilate(inverse, around) <= _ONE_SURFACE * low) & (low >= 0.0)
    x, y = (np.nan_to_num(part).astype(np.float32) for part in (pixels[..., 0], pixels[..., 1]))
    between = cv2.remap(inverse, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    found = np.where(smooth[row, column], between, inverse[row, column]).astype(np.float64)
    return np.where(found >= 0.0, found, np.nan)


def rectification(rig: StereoRig) -> dict[str, FloatArray]:
    """Return R1, R2 (3, 3), P1, P2 (3, 4) and Q (4, 4), as in OpenCV's stereoRectify; metres."""
    camera = rectified_camera(rig)
    P1, P2 = projections(camera, rig.baseline)
    ratio = camera.fx / camera.fy
    Q = np.array(
        [
            [1.0, 0.0, 0.0, -camera.cx],
            [0.0, ratio, 0.0, -ratio * camera.cy],
            [0.0, 0.0, 0.0, camera.fx],
            [0.0, 0.0, 1.0 / rig.baseline, 0.0],
        ]
    )
    R1, R2 = (rig.own(side).R.T for side in SIDES)
    return {"R1": R1, "R2": R2, "P1": P1, "P2": P2, "Q": Q}


def write_rectified(folder: Path, name: str, fused: Fused, rig: StereoRig, side: Side) -> None:
    """Write NAME.png, depth/NAME.exr, disparity/NAME.png and mask/NAME.png below ``folder`` / rectified."""
    place, frame = folder / FOLDER, rectify(fused, rig, side)
    for part in ("depth", "disparity", "mask"):
        (place / part).mkdir(parents=True, exist_ok=True)
    write_png(place / f"{name}.png", frame.image)
    write_origin(place / "mask" / f"{name}.png", frame.origin)
    finite = np.isfinite(frame.depth)
    write_depth(place / "depth" / f"{name}.exr", np.where(finite, frame.depth, np.float32(0.0)))
    shift = rectified_camera(rig).fx * rig.baseline
    disparity = shift / np.where(finite, frame.depth, np.nan).astype(np.float64)
    write_png16(place / "disparity" / f"{name}.png", disparity_values(disparity)[0])


def write_calibration(folder: Path, rig: StereoRig) -> None:
    """Write calibration.yml, for OpenCV's FileStorage, and COLMAP's cameras.txt below ``folder`` / rectified."""
    place, camera = folder / FOLDER, rectified_camera(rig)
    storage = cv2.FileStorage(str(place / "calibration.yml"), cv2.FILE_STORAGE_WRITE)
    for key, value in (("image_width", camera.width), ("image_height", camera.height)):
        storage.write(key, value)
    for number, side in enumerate(SIDES, start=1):
        sensor = rig.sensor(side)
        lens = sensor.lens
        storage.write(f"lens{number}", "none" if lens is None else lens.model)
        storage.write(f"size{number}", np.array([[sensor.width, sensor.height]]))
        storage.write(f"M{number}", sensor.ideal.K)
        storage.write(f"D{number}", np.array([(0.0,) * 5 if lens is None else lens.coefficients]))
    R, T = rig.right_from_left
    for key, matrix in {"R": R, "T": T.reshape(3, 1), **rectification(rig)}.items():
        storage.write(key, np.ascontiguousarray(matrix))
    storage.release()
    write_lines(place / "cameras.txt", [camera_line(number, camera) for number in (1, 2)])
