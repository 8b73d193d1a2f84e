"""Readers of the calibration files of other tools, with one common result.

A reader returns the tables of rig.toml: ``left``, ``right`` and ``X_right = R X_left + t`` in metres. Conventions
of the tools, from their documentation and sources:

**Kalibr** (camchain.yaml, camchain-imucam.yaml; OpenVINS has the same keys): ``T_cn_cnm1`` maps coordinates of the
previous camera to this one, ``T_cam_imu`` those of the IMU to the camera, and OpenVINS's ``T_imu_cam`` those of
the camera to the IMU. A camera's time plus ``timeshift_cam_imu`` is the IMU's time. ``line_delay`` is the time
between rows; no other format here has one.

**Basalt**: ``T_imu_cam`` maps camera coordinates to the IMU. **ZED** (SN*.conf): millimetres, a rotation vector
(RX, CV, RZ), T = (-Baseline, TY, TZ), a section for each image size. **DepthAI**: centimetres, x_to = R x_this + t
along a chain of sockets. **RealSense** has no file format of its own: JSON of rs2_intrinsics and rs2_extrinsics,
whose matrices are stored by columns. **COLMAP** (rig_config.json; cameras.txt and rigs.txt): the origin of pixel
coordinates is the corner of the image, so they are half a pixel larger than here; x_camera = R x_rig + t.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rsbench.components.rig_tables import Size
from rsbench.core import so3
from rsbench.core.camera import COEFFICIENTS
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.so3 import FloatArray
from rsbench.interop.readers.calibration_opencv import (
    is_opencv,
    is_ros,
    opencv_files,
    read_opencv,
    read_ros,
    ros_files,
)
from rsbench.interop.readers.calibration_parts import (
    UNITS,
    Assumptions,
    Calibration,
    Fields,
    Files,
    Format,
    Table,
    brown,
    by_name,
    camera_table,
    files_in,
    keyed,
    lens_of,
    pose_of,
    quaternion_of,
    read_tree,
    rotation_of,
    table_of,
    unfolded,
)

_CORNER = 0.5


_RIG_CONFIG = "COLMAP rig_config.json"


def read_calibration(path: Path, given: Assumptions | None = None) -> Calibration:
    """Read the calibration in a file or folder.

    Args:
        path: a file of one of the formats, or a folder with such a file or with files that belong together.
        given: assumptions of the user, in addition to the file.

    Raises:
        RsbenchError: the calibration is missing or invalid; the message names file, field, fault and remedy.
    """
    given = given or Assumptions()
    if path.is_dir():
        kind, trees = _of_folder(path)
    else:
        known = _by_format([(path, read_tree(path))])
        if not known:
            listed = ", ".join(kind.name for kind in FORMATS)
            raise RsbenchError(f"{path}: is not a calibration of a supported format: rig.toml, {listed}")
        ((kind, trees),) = known.items()
        if kind.parts is not None:
            near = [path.parent, *([path.parent.parent] if kind.name == "ROS camera_info" else [])]
            trees = kind.parts(path, _by_format(_trees_in(*near)).get(kind, {}) | trees)
    try:
        found = kind.read(Files(trees, given))
    except (TypeError, ValueError, KeyError, IndexError, AttributeError, OverflowError) as error:
        words = " ".join(str(error).split())
        raise RsbenchError(
            f"{path}: is not a valid {kind.name} calibration: {type(error).__name__}: {words[:100]}"
        ) from error
    return unfolded(replace(_left_first(found, given, str(path)), files=tuple(trees)), given)


def _trees_in(*folders: Path) -> Iterator[tuple[Path, Any]]:
    """Yield the files of folders and their parsed contents; files that cannot be read are skipped."""
    for path in (path for folder in folders for path in files_in(folder)):
        with contextlib.suppress(RsbenchError):
            yield path, read_tree(path)


def _by_format(files: Iterable[tuple[Path, Any]]) -> dict[Format, dict[Path, Any]]:
    """Return the calibrations among files by format, in the order of ``FORMATS``; other files are left out."""
    found = {kind: dict[Path, Any]() for kind in FORMATS}
    for path, tree in files:
        kind = next((kind for kind in FORMATS if kind.holds(tree)), None)
        if kind is not None:
            found[kind][path] = tree
    return {kind: trees for kind, trees in found.items() if trees}


def _of_folder(folder: Path) -> tuple[Format, Mapping[Path, Any]]:
    """Return the only format in a folder, and its files; RsbenchError if there is none or more than one."""
    found = _by_format(_trees_in(folder))
    if _RIG_CONFIG in (kind.name for kind in found):  # cameras.txt in the folder belongs to it
        found = {kind: trees for kind, trees in found.items() if kind.name != "COLMAP"}
    if len(found) != 1:
        listed = "; ".join(f"{next(iter(trees)).name} of {kind.name}" for kind, trees in found.items())
        raise RsbenchError(f"{folder}: holds {listed or 'no calibration'}; give one file")
    return next(iter(found.items()))


def _left_first(found: Calibration, given: Assumptions, where: str) -> Calibration:
    """Return the calibration with the left camera first and the transform from left to right."""
    if found.right_from_left is None:
        return found
    apart = inverse(found.right_from_left) if given.invert else found.right_from_left
    found = replace(found, right_from_left=apart)
    if given.exchange:
        found = _exchanged(found)
    R, t = found.right_from_left or apart
    if not np.linalg.norm(t) > 0.0:
        raise RsbenchError(f"{where}: the translation between the cameras is 0; give one with a baseline")
    if -(R.T @ t)[0] - t[0] < -np.linalg.norm(t):
        if found.format not in _NUMBERED:
            raise RsbenchError(
                f"{where}: the right camera would stand {abs(t[0]):.4g} m to the left of the left one: the "
                "cameras are exchanged (rsbench rig --exchange) or their transform inverted (rsbench rig --invert)"
            )
        note = "its second camera stands to the left of the first one and is taken as the left camera"
        found = replace(_exchanged(found), notes=(*found.notes, note))
    return found


def _exchanged(found: Calibration) -> Calibration:
    assert found.right is not None and found.right_from_left is not None
    return replace(
        found,
        left=found.right,
        right=found.left,
        right_from_left=inverse(found.right_from_left),
        right_delay_s=-found.right_delay_s,
    )


# Kalibr and OpenVINS.


def _is_kalibr(tree: Any) -> bool:
    return (keyed(tree, "cam0") and keyed(tree["cam0"], "intrinsics")) or (
        keyed(tree, "cam1") and "T_cn_cnm1" in str(tree)
    )


def _read_kalibr(files: Files) -> Calibration:
    top = files.only()
    names = sorted((key for key in top.tree if re.fullmatch(r"cam\d+", key)), key=lambda key: int(key[3:]))
    cameras = [top.inner(name) for name in names]
    tables, notes = zip(*map(_kalibr_camera, cameras), strict=True)
    made = [note for each in notes for note in each]
    if len(cameras) == 1:
        return Calibration(format="Kalibr", left=tables[0], notes=tuple(made))
    if len(cameras) > 2:
        made.append(f"holds {len(cameras)} cameras; {names[0]} and {names[1]} are taken")
    apart, shifts = _kalibr_apart(*cameras[:2]), [each.number("timeshift_cam_imu", 0.0) for each in cameras[:2]]
    return Calibration(
        format="Kalibr",
        left=tables[0],
        right=tables[1],
        right_from_left=apart,
        right_delay_s=shifts[1] - shifts[0] if all("timeshift_cam_imu" in each for each in cameras[:2]) else 0.0,
        notes=tuple(made),
    )


def _kalibr_apart(first: Fields, second: Fields) -> Pose:
    """Return the transform from the first camera to the second."""
    if "T_cn_cnm1" in second:
        return pose_of(second, "T_cn_cnm1")
    return compose(_kalibr_from_imu(second), inverse(_kalibr_from_imu(first)))


def _kalibr_from_imu(camera: Fields) -> Pose:
    """Return ``camera_from_imu``."""
    if "T_cam_imu" in camera:
        return pose_of(camera, "T_cam_imu")
    if "T_imu_cam" in camera:
        return inverse(pose_of(camera, "T_imu_cam"))
    raise RsbenchError(
        f"{camera.where}: T_cn_cnm1: is missing, as are T_cam_imu and T_imu_cam, so the relative pose of the "
        "cameras is unknown; calibrate them together"
    )


def kalibr_in_body(path: Path) -> list[tuple[Table, Pose]]:
    """Read the table and ``body_from_camera`` of each camera of a camchain with an IMU, whose axes are the body's.

    Raises:
        RsbenchError: the file is not a camchain, or a camera has no pose.
    """
    top, found = Fields(read_tree(path), str(path)), list[tuple[Table, Pose]]()
    if not _is_kalibr(top.tree):
        raise RsbenchError(f"{path}: is not a camchain of Kalibr; give camchain-imucam.yaml")
    for camera in map(top.inner, sorted(key for key in top.tree if re.fullmatch(r"cam\d", key))):
        if found and not {"T_cam_imu", "T_imu_cam"} & camera.tree.keys():
            in_body = compose(found[-1][1], inverse(pose_of(camera, "T_cn_cnm1")))
        else:
            in_body = inverse(_kalibr_from_imu(camera))
        found.append((_kalibr_camera(camera)[0], in_body))
    return found


def _kalibr_camera(camera: Fields) -> tuple[Table, tuple[str, ...]]:
    model = camera.text("camera_model", default="pinhole")
    distortion = camera.text("distortion_model", default="none")
    where, size = camera.where, camera.numbers("resolution", 2)
    known = {"pinhole": 4, "omni": 5, "ds": 6, "eucm": 6}
    if model not in known:
        raise RsbenchError(f"{where}: camera_model = {model!r}: must be one of {', '.join(known)}")
    *own, fx, fy, cx, cy = camera.numbers("intrinsics", known[model]).tolist()
    d = camera.numbers("distortion_coeffs").tolist() if camera.get("distortion_coeffs") else []
    if model == "omni" and (distortion not in ("radtan", "none") or any(d[2:])):
        raise RsbenchError(
            f"{where}: omni with {distortion} {d}: tangential and other distortion of omni is not supported; "
            "calibrate as pinhole-equi, ds-none or eucm-none"
        )
    intrinsics = (fx, fy, cx, cy)
    if model == "pinhole" and distortion == "fov" and not d:
        raise RsbenchError(f"{where}: distortion_coeffs: is missing; fov has one")
    if model == "pinhole" and distortion != "fov":
        table, note = table_of(size, intrinsics, by_name(distortion, d, where)), ""
    elif model == "pinhole":
        table, note = camera_table(size, intrinsics, "fov", d[:1], where)
    elif model == "omni":
        table, note = camera_table(size, intrinsics, "omni", own + d[:2], where)
    else:
        table, note = camera_table(size, intrinsics, {"ds": "double-sphere"}.get(model, model), own, where)
    if "line_delay" in camera:
        table["line_delay_s"] = camera.number("line_delay")
    return table, (note,) if note else ()


# Basalt.


def _read_basalt(files: Files) -> Calibration:
    top = files.only().inner("value0")
    sizes = top.get("resolution") or []
    made = [
        _basalt_camera(Fields(each, f"{top.where}: intrinsics {k}"), sizes[k] if k < len(sizes) else None)
        for k, each in enumerate(top.get("intrinsics") or [])
    ]
    if not made:
        raise RsbenchError(f"{top.where}: intrinsics: is missing")
    notes = tuple(note for _, note in made if note)
    if len(made) == 1:
        return Calibration(format="Basalt", left=made[0][0], notes=notes)
    if len(made) > 2:
        notes += (f"holds {len(made)} cameras; the first two are taken",)
    poses = []
    for k, each in enumerate((top.get("T_imu_cam") or [])[:2]):
        place = Fields(each, f"{top.where}: T_imu_cam {k}")
        q = place.each("qw", "qx", "qy", "qz")
        poses.append(Pose(quaternion_of(q, place.where), np.array(place.each("px", "py", "pz"))))
    if len(poses) < 2:
        raise RsbenchError(f"{top.where}: T_imu_cam: must be of both cameras")
    apart = compose(inverse(poses[1]), poses[0])
    return Calibration(format="Basalt", left=made[0][0], right=made[1][0], right_from_left=apart, notes=notes)


def _basalt_camera(camera: Fields, size: Sequence[float] | None) -> tuple[Table, str]:
    own, kind = camera.inner("intrinsics"), camera.text("camera_type")
    if kind not in _BASALT_MODELS:
        raise RsbenchError(f"{camera.where}: camera_type = {kind!r}: must be one of {', '.join(_BASALT_MODELS)}")
    name, keys = _BASALT_MODELS[kind]
    usual = dict.fromkeys(keys, 0.0) if kind == "pinhole-radtan8" else {"beta": 1.0}
    values = [own.number(key, usual.get(key)) for key in keys]
    return camera_table(size, own.each("fx", "fy", "cx", "cy"), name, values, camera.where)


_BASALT_MODELS: Mapping[str, tuple[str, Sequence[str]]] = {
    "pinhole": ("none", ()),
    "kb4": ("kannala-brandt", COEFFICIENTS["kannala-brandt"]),
    "ds": ("double-sphere", COEFFICIENTS["double-sphere"]),
    "pinhole-radtan8": ("radtan", COEFFICIENTS["rational"]),
    "pinhole-radtan5": ("radtan", COEFFICIENTS["brown-conrady"]),
    "eucm": ("eucm", ("alpha", "beta")),
    "ucm": ("ucm", ("alpha", "beta")),
}
"""Name of the lens model, and keys of its coefficients."""


# ZED.


_ZED_SIZES = {
    "2K": (2208, 1242),
    "FHD": (1920, 1080),
    "HD": (1280, 720),
    "VGA": (672, 376),
    "FHD1200": (1920, 1200),
    "SVGA": (960, 600),
    "4K": (3840, 2160),
    "QHDPLUS": (3200, 1800),
}
"""Image size (width, height) of one camera by the suffix of the section's name."""


def _is_zed(tree: Any) -> bool:
    return isinstance(tree, Mapping) and any(str(key).upper().startswith("LEFT_CAM_") for key in tree)


def _read_zed(files: Files) -> Calibration:
    top = files.only()
    known = {key.upper()[9:]: key for key in top.tree if key.upper().startswith("LEFT_CAM_")}
    sizes = {name: _ZED_SIZES[name] for name in known if name in _ZED_SIZES}
    wanted = files.given.frame_size() if files.given.frame_size is not None else None
    if wanted is None and len(sizes) > 1:
        raise RsbenchError(
            f"{top.where}: has calibrations of {', '.join(f'{w} x {h}' for w, h in sizes.values())}: give the "
            "size of one camera's frames: rsbench rig FILE --size 1280x720"
        )
    name = next((name for name, size in sizes.items() if wanted is None or size == tuple(wanted)), None)
    if name is None:
        raise RsbenchError(
            f"{top.where}: no calibration of frames of {wanted[0]} x {wanted[1]} pixels; there are "  # pyrefly: ignore[unsupported-operation]
            f"{', '.join(f'{w} x {h}' for w, h in sizes.values())}; frames side by side in one image must be split"
        )
    tables = [_zed_camera(top, side, name, _ZED_SIZES[name]) for side in ("LEFT", "RIGHT")]
    stereo = top.inner("STEREO")
    turn, shift = list[float](), list[float]()
    for key in ("RX", "CV", "RZ"):
        own = stereo.known(f"{key}_{name}", f"R{key[-1:]}_{name}", key)
        turn.append(stereo.number(own, None if key != "CV" or own in stereo else 0.0))
    for key in ("Baseline", "TY", "TZ"):
        own = f"{key}_{name}" if f"{key}_{name}" in stereo else key
        shift.append(stereo.number(own, None if key == "Baseline" else 0.0))
    t = np.array([-shift[0], shift[1], shift[2]]) * (files.given.unit or UNITS["mm"])
    apart = Pose(so3.exp(np.array(turn)), t)
    return Calibration(format="ZED", left=tables[0], right=tables[1], right_from_left=apart)


def _zed_camera(top: Fields, side: str, name: str, size: Size) -> Table:
    section = next((key for key in top.tree if key.upper() == f"{side}_CAM_{name}"), f"{side}_CAM_{name}")
    own = top.inner(section)
    disto = next((top.inner(key) for key in top.tree if key.upper() == f"{side}_DISTO"), own)
    intrinsics = own.each("fx", "fy", "cx", "cy")
    if "p1" in disto:
        values = [disto.number(key, 0.0) for key in COEFFICIENTS["rational"]]
        return table_of(size, intrinsics, brown(values, disto.where))
    values = [disto.number(key, 0.0) for key in COEFFICIENTS["kannala-brandt"]]
    fisheye = disto is not own or any(values[2:])
    lens = (
        lens_of("kannala-brandt", values, disto.where) if fisheye else brown([*values[:2], 0.0, 0.0], disto.where)
    )
    return table_of(size, intrinsics, lens)


# DepthAI (OAK).


def _read_depthai(files: Files) -> Calibration:
    top = files.only()
    cameras = dict[int, Fields]()
    for each in top.get("cameraData"):
        if isinstance(each, list) and len(each) == 2:
            cameras[int(each[0])] = Fields(each[1], f"{top.where}: camera {each[0]}")
    pair = top.get("stereoRectificationData") or {}
    left, right = (int(pair.get(f"{side}CameraSocket", -1)) for side in SIDES)
    left, right = (left, right) if {left, right} <= cameras.keys() else (1, 2)
    if not {left, right} <= cameras.keys():
        if len(cameras) == 1:
            return Calibration(format="DepthAI", left=_depthai_camera(next(iter(cameras.values()))))
        raise RsbenchError(f"{top.where}: cameraData: must have the sockets 1 (left) and 2 (right)")
    links = dict[tuple[int, int], Pose]()
    for socket, camera in cameras.items():
        own = camera.inner("extrinsics")
        to = int(own.number("toCameraSocket", -1.0))
        if to in cameras and own.get("rotationMatrix"):
            R = rotation_of(own.numbers("rotationMatrix", 9), f"{own.where}: rotationMatrix")
            place, unit = own.inner("translation"), _depthai_unit(own)
            t = np.array(place.each(*"xyz")) * (files.given.unit or unit)
            links[socket, to], links[to, socket] = Pose(R, t), inverse(Pose(R, t))
    tables, apart = [_depthai_camera(cameras[k]) for k in (left, right)], _chained(links, left, right, top.where)
    return Calibration(format="DepthAI", left=tables[0], right=tables[1], right_from_left=apart)


def _depthai_unit(apart: Fields) -> float:
    """Return the unit of length in metres; it is centimetres if the file has none."""
    known = {"0": 1.0, "1": 0.01, "2": 0.001, "3": 0.0254, "4": 0.3048}
    unit = known.get(apart.text("lengthUnit", default="1"))
    if unit is None:
        raise RsbenchError(
            f"{apart.where}: lengthUnit = {apart.get('lengthUnit')}: must be one of {', '.join(known)}"
        )
    return unit


def _chained(links: Mapping[tuple[int, int], Pose], start: int, end: int, where: str) -> Pose:
    """Return the transform from camera ``start`` to camera ``end`` along links between cameras."""
    known = {start: Pose(np.eye(3), np.zeros(3))}
    todo = [start]
    while todo:
        at = todo.pop()
        for (a, b), step in links.items():
            if a == at and b not in known:
                known[b] = compose(step, known[a])
                todo.append(b)
    if end not in known:
        raise RsbenchError(f"{where}: extrinsics: no chain of extrinsics links camera {start} with camera {end}")
    return known[end]


def _depthai_camera(camera: Fields) -> Table:
    K, d = camera.numbers("intrinsicMatrix", 9), camera.numbers("distortionCoeff").tolist()
    kind = int(camera.number("cameraType", 0.0))
    if kind not in (0, 1):
        raise RsbenchError(f"{camera.where}: cameraType = {kind}: must be 0 (perspective) or 1 (fisheye)")
    lens = brown(d, camera.where) if kind == 0 else lens_of("kannala-brandt", d, camera.where)
    return table_of(camera.each("width", "height"), (K[0], K[4], K[2], K[5]), lens)


# RealSense.


def _tables_with(keys: Sequence[str], tree: Any, name: str = "") -> dict[str, Mapping[str, Any]]:
    """Return the nested tables that have all ``keys``, named by the path of keys to them, in lower case."""
    if not isinstance(tree, Mapping):
        return {}
    if keyed(tree, *keys):
        return {name: tree}
    found = dict[str, Mapping[str, Any]]()
    for key, value in tree.items():
        found |= _tables_with(keys, value, f"{name} {key}".strip().lower())
    return found


_RS2_INTRINSICS, _RS2_EXTRINSICS = ("fx", "fy", "ppx", "ppy"), ("rotation", "translation")
_IR = (r"left|infra(red)?[ _]?1|ir[ _]?1|fisheye[ _]?1", r"right|infra(red)?[ _]?2|ir[ _]?2|fisheye[ _]?2")


def _read_realsense(files: Files) -> Calibration:
    top = files.only()
    cameras = _tables_with(_RS2_INTRINSICS, top.tree)
    if len(cameras) == 1:
        ((name, own),) = cameras.items()
        return Calibration(format="RealSense", left=_realsense_camera(Fields(own, f"{top.where}: {name}")))
    sides = [[name for name in cameras if re.search(pattern, name)] for pattern in _IR]
    if [len(each) for each in sides] != [1, 1]:
        raise RsbenchError(f"{top.where}: {', '.join(cameras)}: name the cameras left and right")
    (left,), (right,) = sides
    apart = None
    for name, own in _tables_with(_RS2_EXTRINSICS, top.tree).items():
        words = re.search(rf"({_IR[0]}|{_IR[1]})\w*[ _]+to[ _]+({_IR[0]}|{_IR[1]})", name)
        at = Fields(own, f"{top.where}: {name or 'extrinsics'}")
        pose = Pose(
            rotation_of(at.numbers("rotation", 9).reshape(3, 3).T.ravel(), f"{at.where}: rotation"),
            at.numbers("translation", 3),
        )
        backwards = words is not None and re.match(_IR[1], words[0]) is not None
        apart = inverse(pose) if backwards else pose
        if words is not None and not backwards:
            break
    if apart is None:
        raise RsbenchError(f"{top.where}: left_to_right: is missing: rotation (down the columns) and translation")
    tables = [_realsense_camera(Fields(cameras[name], f"{top.where}: {name}")) for name in (left, right)]
    return Calibration(format="RealSense", left=tables[0], right=tables[1], right_from_left=apart)


_RS2 = ("none", "modified_brown_conrady", "inverse_brown_conrady", "ftheta", "brown_conrady", "kannala_brandt4")
"""Model names in the order of the enumeration rs2_distortion."""


def _realsense_camera(camera: Fields) -> Table:
    model = camera.text("model", default="none").rsplit(".", 1)[-1].replace(" ", "_").replace("distortion_", "")
    model = _RS2[int(model)] if model.isdigit() and int(model) < len(_RS2) else model
    d = camera.numbers("coeffs").tolist() if "coeffs" in camera else []
    if model in ("inverse_brown_conrady", "modified_brown_conrady", "ftheta") and any(d):
        raise RsbenchError(
            f"{camera.where}: model = {model}: this model is supported only if its coefficients are 0; use the "
            "infrared or another stream whose coefficients are 0, or calibrate with OpenCV"
        )
    lens = by_name(model, d, camera.where) if any(d) or model == "kannala_brandt4" else None
    return table_of(camera.each("width", "height"), camera.each("fx", "fy", "ppx", "ppy"), lens)


# COLMAP.


_COLMAP_MODELS: Mapping[str, tuple[str, str]] = {
    "SIMPLE_PINHOLE": ("f cx cy", "none"),
    "PINHOLE": ("fx fy cx cy", "none"),
    "SIMPLE_RADIAL": ("f cx cy k1", "radtan"),
    "RADIAL": ("f cx cy k1 k2", "radtan"),
    "OPENCV": ("fx fy cx cy k1 k2 p1 p2", "radtan"),
    "FULL_OPENCV": ("fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", "radtan"),
    "SIMPLE_RADIAL_FISHEYE": ("f cx cy k1", "kannala-brandt"),
    "RADIAL_FISHEYE": ("f cx cy k1 k2", "kannala-brandt"),
    "OPENCV_FISHEYE": ("fx fy cx cy k1 k2 k3 k4", "kannala-brandt"),
    "FOV": ("fx fy cx cy omega", "FOV"),
    "EUCM": ("fx fy cx cy alpha beta", "EUCM"),
}
"""Names of the parameters in their order, and the lens model."""


def colmap_camera(
    name: str, params: Sequence[Any], size: Sequence[float] | FloatArray | None, where: str
) -> tuple[Table, str]:
    """Return the camera table for a model's name and parameters, and a note if the lens was fitted, else \"\"."""
    if name not in _COLMAP_MODELS:
        raise RsbenchError(f"{where}: camera model {name!r}: must be one of {', '.join(_COLMAP_MODELS)}")
    keys, model = _COLMAP_MODELS[name]
    numbers = Fields({"params": list(params)}, where).numbers("params", len(keys.split()))
    values = dict(zip(keys.split(), numbers.tolist(), strict=True))
    fx, fy = values.pop("fx", values.get("f", 0.0)), values.pop("fy", values.pop("f", 0.0))
    intrinsics = (fx, fy, values.pop("cx") - _CORNER, values.pop("cy") - _CORNER)
    return camera_table(size, intrinsics, model, list(values.values()), where)


def colmap_poses(words: Sequence[str], where: str) -> dict[str, Pose]:
    """Return ``camera_from_rig`` by camera number from the words of a line of rigs.txt, reference camera first."""
    poses = {words[3]: Pose(np.eye(3), np.zeros(3))} if words[2:3] == ["CAMERA"] and len(words) > 3 else {}
    rest = words[4:]
    while len(rest) >= 3:
        values = rest[3:10] if rest[2] == "1" else []
        if rest[0] == "CAMERA" and values:
            numbers = Fields({"pose": values}, where).numbers("pose", 7)
            poses[rest[1]] = Pose(quaternion_of(numbers[:4].tolist(), where), numbers[4:])
        rest = rest[3 + len(values) :]
    return poses


def _is_rig_config(tree: Any) -> bool:
    return isinstance(tree, list) and bool(tree) and all(keyed(each, "cameras") for each in tree)


def _read_rig_config(files: Files) -> Calibration:
    if len(files.trees) > 1:
        files.only()
    ((path, tree),) = files.trees.items()
    cameras = [Fields(each, f"{path}: camera {k}") for k, each in enumerate(tree[0]["cameras"])]
    notes = [f"holds {len(tree)} rigs; the first is taken"] if len(tree) > 1 else []
    if len(cameras) > 2:
        notes.append(f"holds {len(cameras)} cameras; the first two are taken")
    made, poses, beside = list[tuple[Table, str]](), list[Pose](), path.with_name("cameras.txt")
    known = _colmap_cameras(read_tree(beside)["colmap"], str(beside)) if beside.is_file() else {}
    for number, camera in enumerate(cameras[:2]):
        own = camera.text("camera_id") or [*known, "", ""][number]
        if "camera_params" in camera:
            name = camera.text("camera_model_name").upper()
            made.append(colmap_camera(name, camera.get("camera_params"), None, camera.where))
        elif own in known and ("camera_id" in camera or len(known) == len(cameras)):
            made.append(known[own])
        else:
            raise RsbenchError(
                f"{camera.where}: camera_params: is missing, with camera_model_name; add both, or put "
                "cameras.txt of as many cameras beside it"
            )
        if camera.get("ref_sensor"):
            poses.append(Pose(np.eye(3), np.zeros(3)))
        elif "cam_from_rig_rotation" in camera:
            q = camera.numbers("cam_from_rig_rotation", 4).tolist()
            poses.append(Pose(quaternion_of(q, camera.where), camera.numbers("cam_from_rig_translation", 3)))
    if len(made) == 2 and len(poses) < 2:
        raise RsbenchError(f"{path}: cam_from_rig_rotation, cam_from_rig_translation: are missing")
    notes += [note for _, note in made if note]
    if len(made) == 1:
        return Calibration(format="COLMAP", left=made[0][0], notes=tuple(notes))
    return _colmap_pair([table for table, _ in made], poses, notes, files.given)


def _colmap_pair(tables: list[Table], poses: list[Pose], notes: list[str], given: Assumptions) -> Calibration:
    R, t = compose(poses[1], inverse(poses[0]))
    notes.append("lengths of COLMAP are metres only if the rig was given in metres")
    apart = Pose(R, t * (given.unit or 1.0))
    return Calibration(format="COLMAP", left=tables[0], right=tables[1], right_from_left=apart, notes=tuple(notes))


def _colmap_cameras(lines: Iterable[list[str]], where: str) -> dict[str, tuple[Table, str]]:
    """Return the tables of cameras.txt by camera number, each with a note if it is approximate, or \"\"."""
    made = dict[str, tuple[Table, str]]()
    for words in lines:
        if len(words) > 4 and words[1].isupper() and words[2] not in ("CAMERA", "IMU"):
            at = f"{where}: {' '.join(words[:3])}"
            size = Fields({"size": words[2:4]}, at).numbers("size", 2).tolist()
            made[words[0]] = colmap_camera(words[1], words[4:], size, at)
    return made


def _read_colmap(files: Files) -> Calibration:
    """Read cameras.txt and, if there are two cameras, rigs.txt."""
    lines = [line for tree in files.trees.values() for line in tree["colmap"]]
    made = _colmap_cameras(lines, files.where)
    rigs = [words for words in lines if words[2:3] in (["CAMERA"], ["IMU"])]
    if not made:
        raise RsbenchError(f"{files.where}: cameras.txt is missing beside it")
    notes = [note for _, note in made.values() if note]
    if len(made) == 1:
        return Calibration(format="COLMAP", left=next(iter(made.values()))[0], notes=tuple(notes))
    for words in rigs:
        poses = colmap_poses(words, files.where)
        if len(poses) >= 2 and set(list(poses)[:2]) <= made.keys():
            first, second = list(poses)[:2]
            notes += [f"holds {len(poses)} cameras; {first} and {second} are taken"] if len(poses) > 2 else []
            return _colmap_pair(
                [made[first][0], made[second][0]], [poses[first], poses[second]], notes, files.given
            )
    raise RsbenchError(
        f"{files.where}: has {len(made)} cameras and no rig of two: give the folder that also holds rigs.txt"
    )


# EuRoC (ASL).


def _read_asl(files: Files) -> Calibration:
    cameras = [Fields(tree, str(path)) for path, tree in sorted(files.trees.items())]
    made = [asl_camera(camera) for camera in cameras[:2]]
    if len(made) == 1:
        return Calibration(format="EuRoC", left=made[0])
    poses = [asl_pose(camera) for camera in cameras[:2]]
    apart = compose(inverse(poses[1]), poses[0])
    return Calibration(format="EuRoC", left=made[0], right=made[1], right_from_left=apart)


def asl_camera(camera: Fields) -> Table:
    """Return the camera table of a sensor.yaml."""
    kind = camera.text("distortion_model", default="none")
    values = camera.numbers("distortion_coefficients").tolist() if kind != "none" else []
    lens = by_name(kind, values, camera.where)
    return table_of(camera.numbers("resolution", 2), camera.numbers("intrinsics", 4).tolist(), lens)


def asl_pose(camera: Fields) -> Pose:
    """Return ``body_from_camera`` of a sensor.yaml."""
    value = camera.get("T_BS")
    T = np.ravel(value["data"] if isinstance(value, Mapping) else value)
    return pose_of(Fields({"T_BS": T}, camera.where), "T_BS")


def _beside(path: Path, near: Mapping[Path, Any]) -> Mapping[Path, Any]:
    return {each: tree for each, tree in near.items() if each.parent == path.parent}


FORMATS: tuple[Format, ...] = (
    Format("Kalibr", _is_kalibr, _read_kalibr),
    Format("Basalt", lambda tree: keyed(tree, "value0") and keyed(tree["value0"], "intrinsics"), _read_basalt),
    Format("ZED", _is_zed, _read_zed),
    Format("DepthAI", lambda tree: keyed(tree, "cameraData"), _read_depthai),
    Format(_RIG_CONFIG, _is_rig_config, _read_rig_config),
    Format("COLMAP", lambda tree: keyed(tree, "colmap"), _read_colmap, _beside),
    Format("RealSense", lambda tree: bool(_tables_with(_RS2_INTRINSICS, tree)), _read_realsense),
    Format("EuRoC", lambda tree: keyed(tree, "T_BS", "intrinsics", "resolution"), _read_asl),
    Format("ROS camera_info", is_ros, read_ros, ros_files),
    Format("OpenCV", is_opencv, read_opencv, opencv_files),
)
"""Supported formats, in the order in which a file is tested."""
_NUMBERED = ("Kalibr", "Basalt", "COLMAP", "EuRoC")
"""Formats with numbered cameras, of which the first need not be the left one."""
