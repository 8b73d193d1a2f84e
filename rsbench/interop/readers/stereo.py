"""Rectified stereo with disparities: Middlebury (2014 and 2021) and KITTI (stereo 2012 and 2015).

Middlebury: a scene is a folder with ``im0.png``, ``im1.png``, ``calib.txt`` and ``disp0.pfm``. Its principal
points may differ by ``doffs``: z = baseline f / (d + doffs); lengths are millimetres; a PFM begins with its lowest
row, and unknown disparities are infinite.

KITTI: a folder with ``image_2``, ``image_3`` (or 0 and 1, grey), ``disp_occ_0`` (or ``disp_occ``) and
``calib_cam_to_cam`` (or ``calib``). Disparities are 16 bits, 256 to the pixel, 0 unknown; the baseline is what the
fourth numbers of the projection matrices, -fx times the camera's place, differ by.

Neither says when a row was read, and no shutter is made up for it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, View
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray
from rsbench.dataset.recording import Recording
from rsbench.interop.readers.text import lines, numbers, only_file
from rsbench.pipeline.footage import read_frame
from rsbench.storage.files import read_grey_png
from rsbench.storage.untrusted_files import read_bytes

_MM = 1e-3


def read_middlebury(folder: Path) -> list[Recording]:
    """Every scene below a folder, or the folder itself."""
    found = sorted(path.parent for path in folder.glob("**/calib.txt") if (path.parent / "im0.png").is_file())
    if not found:
        raise RsbenchError(f"{folder}: holds no scene of Middlebury: no calib.txt beside an im0.png")
    return [_middlebury(each) for each in found]


def _middlebury(folder: Path) -> Recording:
    path = folder / "calib.txt"
    said = {key.strip(): value for _, line in lines(path) for key, _, value in [line.partition("=")]}
    for key in ("cam0", "cam1", "baseline", "width", "height"):
        if key not in said:
            raise RsbenchError(f"{path}: {key!r} is required")
    K0, K1 = (numbers(re.sub(r"[\[\];]", " ", said[key]), path, 9).reshape(3, 3) for key in ("cam0", "cam1"))
    width, height, baseline = (float(numbers(said[key], path, 1)[0]) for key in ("width", "height", "baseline"))
    offset = float(numbers(said["doffs"], path, 1)[0]) if "doffs" in said else float(K1[0, 2] - K0[0, 2])
    left, right = (_camera(K, int(width), int(height), path) for K in (K0, K1))
    images: dict[View, Path] = {("left", 0): folder / "im0.png", ("right", 0): folder / "im1.png"}
    disparities: dict[View, Callable[[], FloatArray]] = {}
    views: tuple[View, ...] = (("left", 0), ("right", 0))
    for view, name in zip(views, ("disp0.pfm", "disp1.pfm"), strict=True):
        if (folder / name).is_file():
            disparities[view] = partial(_pfm, folder / name, offset)
    return Recording(
        name=folder.name,
        cameras={"left": left, "right": right},
        images={view: image for view, image in images.items() if image.is_file()},
        right_from_left=_apart(_MM * baseline),
        disparities=disparities,
    )


def _camera(K: FloatArray, width: int, height: int, path: Path) -> PinholeCamera:
    try:
        return PinholeCamera(width=width, height=height, fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2])
    except ValueError as error:
        raise RsbenchError(f"{path}: {error}") from error


def _apart(baseline: float) -> Pose:
    return Pose(np.eye(3), np.array([-baseline, 0.0, 0.0]))


def _pfm(path: Path, offset: float) -> FloatArray:
    """Disparities (H, W) of a grey PFM, with the offset of the principal points; NaN where unknown."""
    data = read_bytes(path)
    found = re.match(rb"Pf\s+(\d+)\s+(\d+)\s+(-?[0-9.eE+]+)\s", data)
    if found is None:
        raise RsbenchError(f"{path}: is no grey PFM")
    width, height, scale = int(found[1]), int(found[2]), float(found[3])
    values = data[found.end() :]
    if len(values) != 4 * width * height:
        raise RsbenchError(f"{path}: has {len(values)} bytes of numbers, not those of {width} x {height}")
    # A negative scale says that the lowest byte comes first; the lowest row always does.
    rows = np.frombuffer(values, dtype="<f4" if scale < 0.0 else ">f4").reshape(height, width)[::-1]
    return np.where(np.isfinite(rows) & (rows > 0.0), rows + offset, np.nan).astype(np.float64)


def read_kitti(folder: Path) -> list[Recording]:
    """Every pair that has disparities, and the pictures of the next time where they are there."""
    images = next(
        (names for names in (("image_2", "image_3"), ("image_0", "image_1")) if _all(folder, names)), None
    )
    if images is None:
        raise RsbenchError(f"{folder}: holds no folders image_2 and image_3, or image_0 and image_1")
    truth = next((name for name in ("disp_occ_0", "disp_occ") if (folder / name).is_dir()), None)
    calib = next((name for name in ("calib_cam_to_cam", "calib") if (folder / name).is_dir()), None)
    if calib is None:
        raise RsbenchError(f"{folder}: holds no folder calib_cam_to_cam or calib")
    firsts = sorted((folder / images[0]).glob("*_10.png"))
    if not firsts:
        raise RsbenchError(f"{folder / images[0]}: holds no 000000_10.png")
    return [_kitti(folder, images, truth, calib, path.name[:-7]) for path in firsts]


def _all(folder: Path, names: tuple[str, str]) -> bool:
    return all((folder / name).is_dir() for name in names)


def _kitti(folder: Path, names: tuple[str, str], truth: str | None, calib: str, number: str) -> Recording:
    path = only_file(folder / calib, f"{number}.txt")
    said = {key.strip(): value for _, line in lines(path) for key, _, value in [line.partition(":")]}
    matrices = []
    for name in names:
        keys = (f"P_rect_0{name[-1]}", f"P{name[-1]}")
        key = next((each for each in keys if each in said), None)
        if key is None:
            raise RsbenchError(f"{path}: has neither {keys[0]} nor {keys[1]}")
        matrices.append(numbers(said[key], path, 12).reshape(3, 4))
    files: dict[View, Path] = {
        (side, frame): folder / name / f"{number}_1{frame}.png"
        for side, name in zip(SIDES, names, strict=True)
        for frame in (0, 1)
    }
    height, width = read_frame(files["left", 0]).shape[:2]
    left, right = (_camera(P[:, :3], width, height, path) for P in matrices)
    baseline = matrices[0][0, 3] / matrices[0][0, 0] - matrices[1][0, 3] / matrices[1][0, 0]
    offset = right.cx - left.cx
    found = None if truth is None else folder / truth / f"{number}_10.png"
    read = None if found is None or not found.is_file() else partial(_png, found, (width, height), offset)
    return Recording(
        name=number,
        cameras={"left": left, "right": right},
        images={view: file for view, file in files.items() if file.is_file()},
        right_from_left=_apart(float(baseline)),
        disparities={} if read is None else {("left", 0): read},
    )


def _png(path: Path, size: tuple[int, int], offset: float) -> FloatArray:
    values = read_grey_png(path, size, 16)
    return np.where(values > 0, values / 256.0 + offset, np.nan)
