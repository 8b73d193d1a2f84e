"""Readers of calibrations that consist of OpenCV's matrices: OpenCV's own files, and camera_info of ROS.

**OpenCV** (FileStorage): x2 = R x1 + T, with T in the unit of the board's squares. Files of OpenCV's samples lack
the image size. Keys have various names, and a rotation may be a vector. If a file has only rectified cameras,
R = R2^T R1 and T = R2^T (P2[0, 3], P2[1, 3], 0) / f.

**ROS** (camera_info of both cameras): extrinsics exist only as the rectification R of both and P[0, 3] = -f B.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray
from rsbench.interop.readers.calibration_parts import (
    Calibration,
    Fields,
    Files,
    Table,
    brown,
    by_name,
    in_metres,
    keyed,
    lens_of,
    rotation_of,
    table_of,
)

_ROLES = (
    ("rectified", r"[rp][12]", (9, 12)),
    ("", r"[qef]|(rect|proj|map|new|opt).*", ()),
    ("rotation", r"r|rot|rotation|rotation_?matrix|rvec|om|r_?(stereo|lr|12|21)|stereo_?r(otation)?", (3, 9)),
    ("translation", r"t|trans|translation|translation_?vector|tvec|t_?(stereo|lr|12|21)|stereo_?t\w*", (3,)),
    ("distortion", r"(d|k?d)(_?[lr012])?|d_\w+|\w*dist\w*", (4, 5, 8, 12, 14)),
    ("size", r"size|(image|img)_?size|resolution", (2,)),
)
"""Role, pattern of the lower-case key, and valid numbers of values; camera matrices are found by their zeros."""
_ARRAYS = (np.ndarray, list)
_FISHEYE = ("fisheye", "kannala_brandt", "equidistant")


class Parts:
    """Matrices and vectors of OpenCV files, recognised by the names of their keys and their sizes."""

    def __init__(self, *trees: Any) -> None:
        self.matrices: dict[str, FloatArray] = {}
        """Camera matrices (3, 3) by key."""
        self.values: dict[str, dict[str, FloatArray]] = {role: {} for role, _, _ in _ROLES}
        """Numbers (n,) by role and key."""
        self.fisheye = False
        for tree in trees:
            for key, value in tree.items() if isinstance(tree, Mapping) else ():
                self._add(key, value)
            width, height = (Parts.number(tree, name) for name in ("width", "height"))
            if width and height:
                self.values["size"][""] = np.array([width, height])

    def _add(self, key: str, value: Any) -> None:
        plain = key.lower().replace("-", "_")
        self.fisheye |= plain.endswith("_fe") or str(value).lower() in _FISHEYE
        self.fisheye |= "fisheye" in plain and value in (1, "1", "true", True)
        try:
            numbers = np.array(value if isinstance(value, _ARRAYS) else np.nan, dtype=np.float64)
        except (TypeError, ValueError):
            return
        role = next((role for role, name, _ in _ROLES if re.fullmatch(name, plain)), None)
        if not np.all(np.isfinite(numbers)) or role == "":
            return
        if role not in ("rectified", "rotation") and numbers.shape == (3, 3) and _is_camera_matrix(numbers):
            self.matrices[key] = numbers
        elif role is not None and numbers.size in next(sizes for each, _, sizes in _ROLES if each == role):
            self.values[role][key if role == "distortion" else plain] = numbers.ravel()

    @staticmethod
    def number(tree: Any, name: str) -> float | None:
        """Return the value of ``image_NAME`` or NAME, such as ``image_width``; None without a number."""
        value = tree.get(f"image_{name}", tree.get(name)) if isinstance(tree, Mapping) else None
        return float(value) if isinstance(value, int | float) else None

    def one(self, role: str) -> FloatArray | None:
        """Return the first value of a role; None if there is none."""
        return next(iter(self.values[role].values()), None)

    @property
    def apart(self) -> bool:
        """Whether the files define the relative pose of the cameras."""
        both = self.values["rotation"] and self.values["translation"]
        return bool(both) or {"r1", "r2", "p2"} <= self.values["rectified"].keys()


def _is_camera_matrix(K: FloatArray) -> bool:
    return bool(K[2, 2] == 1.0 and min(K[0, 0], K[1, 1]) > 5.0 and not np.any(K[[1, 2, 2], [0, 0, 1]]))


def is_opencv(tree: Any) -> bool:
    """Return whether a file has a camera matrix, or the relative pose of two cameras."""
    found = Parts(tree)
    return bool(found.matrices) or found.apart


def opencv_files(path: Path, near: Mapping[Path, Any]) -> Mapping[Path, Any]:
    """Return the file and the one next to it with the missing part, such as OpenCV's extrinsics.yml."""
    own, others = Parts(near[path]), {each: tree for each, tree in near.items() if each != path}
    if (own.matrices and own.apart) or len(own.matrices) == 1:
        return {path: near[path]}
    parts = {each: Parts(tree) for each, tree in others.items()}
    fits = [e for e, p in parts.items() if (p.apart and not p.matrices if own.matrices else len(p.matrices) > 1)]
    return {path: near[path]} | ({fits[0]: near[fits[0]]} if len(fits) == 1 else {})


def read_opencv(files: Files) -> Calibration:
    """Read one camera, or two cameras with R and T or with their rectification."""
    if len(files.trees) > 2:
        files.only()
    found, where = Parts(*files.trees.values()), files.where
    if not found.matrices:
        raise RsbenchError(f"{where}: no camera matrices (M1, M2): give the folder that also holds intrinsics.yml")
    if len(found.matrices) == 1:
        ((key, K),) = found.matrices.items()
        d = found.one("distortion")
        return Calibration(format="OpenCV", left=_camera(K, d, found, files, key))
    distortions = found.values["distortion"]
    matrices, d = _by_side(found.matrices, where), _by_side(distortions, where) if distortions else {}
    left, right = (_camera(matrices[side], d.get(side), found, files, side) for side in SIDES)
    R, t = _apart(found, where)
    t, notes = in_metres(t, files.given, where)
    return Calibration(format="OpenCV", left=left, right=right, right_from_left=Pose(R, t), notes=notes)


def _by_side(values: Mapping[str, FloatArray], where: str) -> dict[str, FloatArray]:
    """Return values by side, from two keys that differ only in l and r, left and right, 1 and 2, or 0 and 1."""

    def differ(one: str, two: str) -> bool:
        a, b = (key.lower().replace("left", "l").replace("right", "r") for key in (one, two))
        apart = [pair for pair in zip(a, b, strict=False) if pair[0] != pair[1]]
        return len(a) == len(b) and apart in ([("l", "r")], [("1", "2")], [("0", "1")])

    pairs = [pair for pair in permutations(values, 2) if differ(*pair)]
    if len(pairs) != 1:
        raise RsbenchError(
            f"{where}: {', '.join(values)}: which is the left camera is not clear; name them M1, D1, M2, D2"
        )
    return {side: values[key] for side, key in zip(SIDES, pairs[0], strict=True)}


def _camera(K: FloatArray, d: FloatArray | None, found: Parts, files: Files, key: str) -> Table:
    where, d = f"{files.where}: {key}", np.zeros(0) if d is None else d
    if abs(K[0, 1]) > 1e-3 * K[0, 0]:
        raise RsbenchError(f"{where}: skew {K[0, 1]:g}: must be 0; calibrate without skew")
    fisheye = files.given.fisheye
    if len(d) == 4 and np.any(d) and fisheye is None and not found.fisheye:
        raise RsbenchError(
            f"{where}: four coefficients are k1, k2, p1, p2 of an ordinary lens or k1 to k4 of a fisheye; say "
            "which: rsbench rig FILE --lens brown-conrady (or kannala-brandt) -o rig.toml"
        )
    fisheye = (found.fisheye if fisheye is None else fisheye) and len(d) == 4
    lens = lens_of("kannala-brandt", d, where) if fisheye else brown(d, where)
    size = found.one("size")
    return table_of(None if size is None else size.tolist(), (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), lens)


def _apart(found: Parts, where: str) -> Pose:
    R, t, rectified = found.one("rotation"), found.one("translation"), found.values["rectified"]
    if R is not None and t is not None:
        return Pose(rotation_of(R, f"{where}: R"), t)
    if not found.apart:
        raise RsbenchError(
            f"{where}: R and T are missing, so the relative pose is unknown; give the folder that also holds "
            "extrinsics.yml, or calibrate them together (stereoCalibrate)"
        )
    return _apart_of_rectified(rectified["r1"], rectified["r2"], rectified["p2"].reshape(3, 4), where)


def _apart_of_rectified(R1: FloatArray, R2: FloatArray, P2: FloatArray, where: str) -> Pose:
    """Compute ``right_from_left`` from the rectifying rotations of both cameras and the second projection."""
    if not (P2[0, 0] > 0.0 and P2[1, 1] > 0.0):
        raise RsbenchError(f"{where}: projection: focal lengths {P2[0, 0]:g}, {P2[1, 1]:g}: must be positive")
    first, second = (rotation_of(R.ravel(), f"{where}: rectification") for R in (R1, R2))
    return Pose(second.T @ first, second.T @ np.array([P2[0, 3] / P2[0, 0], P2[1, 3] / P2[1, 1], 0.0]))


# ROS.


def is_ros(tree: Any) -> bool:
    long = keyed(tree, "camera_matrix", "rectification_matrix", "projection_matrix")
    return long or keyed(tree, "k", "r", "p", "distortion_model") or keyed(tree, "K", "R", "P", "distortion_model")


_OTHER_SIDE = (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT"), ("cam0", "cam1"), ("camera0", "camera1"))
_OTHER_SIDE += (("infra1", "infra2"), ("_0", "_1"), ("_1", "_2"), ("_l.", "_r."), ("1.", "2."))


def ros_files(path: Path, near: Mapping[Path, Any]) -> Mapping[Path, Any]:
    """Return the file and that of the other camera, found by its name in this folder or in a sibling folder."""
    others = [each for each in near if each != path]
    for pair in _OTHER_SIDE:
        for one, other in (pair, pair[::-1]):
            for whole in (False, True):
                name = str(path) if whole else path.name
                named = Path(name.replace(one, other)) if whole else path.with_name(name.replace(one, other))
                if one in name and named in others:
                    return {path: near[path], named: near[named]}
    beside = [each for each in others if each.parent == path.parent]
    return {path: near[path]} | ({beside[0]: near[beside[0]]} if len(beside) == 1 else {})


def read_ros(files: Files) -> Calibration:
    if len(files.trees) > 2:
        files.only()
    cameras = [Fields(tree, str(path)) for path, tree in files.trees.items()]
    tables = [_ros_camera(camera) for camera in cameras]
    P = [each.numbers(each.known("projection_matrix", "p", "P"), 12).reshape(3, 4) for each in cameras]
    if len(cameras) == 1:
        return Calibration(format="ROS camera_info", left=tables[0])
    shift = [p[0, 3] if abs(p[0, 3]) >= abs(p[1, 3]) else p[1, 3] for p in P]
    if not any(shift):
        raise RsbenchError(
            f"{files.where}: projection_matrix: the cameras have no baseline (P[0, 3] = 0), as in files of "
            "single cameras; calibrate them as a pair (cameracalibrator)"
        )
    left, right = (0, 1) if abs(shift[0]) <= abs(shift[1]) else (1, 0)
    R = [each.numbers(each.known("rectification_matrix", "r", "R"), 9) for each in cameras]
    relative = P[right].copy()
    relative[:2, 3] -= P[left][:2, 3]
    return Calibration(
        format="ROS camera_info",
        left=tables[left],
        right=tables[right],
        right_from_left=_apart_of_rectified(R[left], R[right], relative, cameras[right].where),
    )


def _ros_camera(camera: Fields) -> Table:
    K = camera.numbers(camera.known("camera_matrix", "k", "K"), 9).reshape(3, 3)
    if not K[0, 0] > 0.0:
        raise RsbenchError(
            f"{camera.where}: camera_matrix: focal length {K[0, 0]:g}: the camera is not calibrated"
        )
    for key in ("binning_x", "binning_y"):
        if camera.number(key, 0.0) > 1:
            raise RsbenchError(
                f"{camera.where}: {key} = {camera.number(key):g}: give a calibration without binning"
            )
    roi = camera.get("roi")
    if isinstance(roi, Mapping) and (roi.get("x_offset") or roi.get("y_offset")):
        raise RsbenchError(f"{camera.where}: roi: give a calibration of whole images")
    key = camera.known("distortion_coefficients", "d", "D")
    d = camera.numbers(key).tolist() if key in camera else []
    lens = by_name(camera.text("distortion_model", default="plumb_bob"), d, camera.where) if any(d) else None
    if camera.text("distortion_model") in ("equidistant", "fisheye"):
        lens = lens_of("kannala-brandt", d, camera.where)
    size = [camera.get(f"image_{name}", name) for name in ("width", "height")]
    return table_of(size if all(size) else None, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), lens)
