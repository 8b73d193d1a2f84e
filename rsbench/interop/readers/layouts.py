"""Readers of datasets in the layouts of other projects; data that a layout lacks are absent in the result.

**COLMAP**'s text model: cameras.txt, images.txt and, where they exist, points3D.txt, rigs.txt and frames.txt (of
COLMAP 3.12: ``sensor_from_rig`` of each camera, and the images of each frame). Its pixel origin is the corner of
the image, ours the centre of the first pixel, so 0.5 px are subtracted. Quaternions are (w, x, y, z); poses are
``cam_from_world``, as ours. The layout has no times: images are ordered by name, with one pose each and no
shutter. A rig of two cameras becomes one recording, and every other camera becomes one of its own.

**EuRoC**, TUM VI and TUM RS-VI (the ASL layout): ``mav0/cam0/sensor.yaml`` has ``T_BS``, which maps sensor
coordinates to body coordinates (if it is absent, a camchain of Kalibr is used); ``data.csv`` has times in
nanoseconds and file names. Body poses, p and q = (w, x, y, z), are in ``mocap0`` or
``state_groundtruth_estimate0``. Times are read as integers, because float64 rounds them to 256 ns. The layout does
not describe a rolling shutter: TUM RS-VI's line delay (29.4737 us for camera 1; camera 0 has a global shutter) is
published separately, and its times are assumed to be those of the first row.

**Carla-RS** (Liu et al., Deep Shutter Unrolling Network, CVPR 2020): a sequence is a folder with ``gt_vel.log``
(wx, wy, wz in rad/s and x, y, z per second), ``%04d_rs.png``, and where depth was rendered ``%04d_rs.depth`` or
``.pdepth``; ``%04d_gs_f.png`` and ``%04d_gs_m.png`` are global-shutter images of the first row and of row ``height
// 2``, ``%04d_mask.png`` the pixels that the authors score. The rest follows from its generator (UnrealCV of the
same authors, Python/capture_rolling_shutter.py):

- rotation exp([w t]x) and translation v t are the pose of the camera at time t **in the camera at time 0**:
  ``cam_from_world`` is its inverse, with the translation -exp(-[w t]x) v t, and the motion is not a screw;
- row r of frame k is read at k / FPS + r times the row's readout, which is 1 / FPS / rows: a readout ratio of 1;
- the field of view is 90 degrees: fx is half the width, and the principal point is the middle of the image, which
  is (width - 1) / 2 here and width / 2 in their own code;
- ``.depth`` is the distance along the ray, ``.pdepth`` is z, computed from it with their principal point.

**Fastec-RS** (the same paper): a sequence is a folder with ``%03d_rolling.png``, ``%03d_global_first.png``, taken
at the time of the first row, and ``%03d_global_middle.png``, of row ``height // 2``. Rows are those of successive
frames of a high-speed camera, so the readout ratio is 1. There is no calibration, depth or motion.

**Middlebury** (2014 and 2021): a scene is a folder with ``im0.png``, ``im1.png``, ``calib.txt`` and ``disp0.pfm``
(``disp0GT.pfm`` in MiddEval3 and ETH3D).
Its principal points may differ by ``doffs``: z = baseline f / (d + doffs); lengths are millimetres; a PFM begins
with its lowest row, and unknown disparities are infinite.

**KITTI** (stereo 2012 and 2015): a folder with ``image_2``, ``image_3`` (or 0 and 1, grey), ``disp_occ_0`` (or
``disp_occ``) and ``calib_cam_to_cam`` (or ``calib``). Disparities have 16 bits, 256 to the pixel, 0 unknown; the
baseline is the difference of the fourth numbers of the projection matrices, each -fx times the camera's position.
Neither Middlebury nor KITTI has times of rows, and no shutter is assumed.

**KITTI raw** (Geiger et al., Vision meets Robotics, IJRR 2013): a drive holds ``image_02/data`` and
``image_03/data`` (or 00 and 01, grey) with ``timestamps.txt``, and the day's folder ``calib_cam_to_cam.txt``. The
images of an ``extract`` drive are not rectified and have the size ``S_0k``: ``K_0k``, ``D_0k`` (OpenCV's k1, k2,
p1, p2, k3), and ``R_0k``, ``T_0k`` from camera 0 to camera k. Those of a ``sync`` drive are rectified and have the
size ``S_rect_0k``: ``P_rect_0k = K [I | t]``, t from the rectified camera 0. The cameras have global shutters.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from rsbench.components.cards import choices
from rsbench.core import so3
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, Side, View
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.dataset.recording import PoseAt, Recording
from rsbench.interop.readers.calibration_parts import (
    Fields,
    Table,
    brown,
    camera_of,
    quaternion_of,
    read_tree,
    rotation_of,
    table_of,
)
from rsbench.interop.readers.calibrations import (
    asl_camera,
    asl_pose,
    colmap_camera,
    colmap_poses,
    kalibr_in_body,
)
from rsbench.pipeline.footage import DEFAULT_FOCAL, read_frame
from rsbench.storage.files import read_grey_png
from rsbench.storage.untrusted_files import NUMBER, inside, read_bytes, read_text


def numbers(text: str, where: object, count: int | None = None) -> FloatArray:
    """Parse (n,) finite numbers separated by blanks or commas; RsbenchError if invalid or n is not ``count``."""
    words = text.replace(",", " ").split()
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        raise RsbenchError(f"{where}: {text.strip()[:60]!r}: must be numbers") from None
    if (count is not None and len(values) != count) or not np.all(np.isfinite(values)):
        wanted = "finite numbers" if count is None else f"{count} finite numbers"
        raise RsbenchError(f"{where}: {text.strip()[:60]!r}: must be {wanted}")
    return values


def lines(path: Path) -> Iterator[tuple[str, str]]:
    """Yield the lines that are neither empty nor comments (#), each after its file and line number."""
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield f"{path}:{number}", line


def only_file(folder: Path, *names: str) -> Path:
    """Return the first of the named files that exists; RsbenchError if none exists."""
    for name in names:
        if (folder / name).is_file():
            return folder / name
    raise RsbenchError(f"{folder}: holds no {' or '.join(names)}")


def _pinhole(size: Sequence[float], K: FloatArray, where: object, lens: Lens | None = None) -> PinholeCamera:
    """Return a camera for (width, height), a calibration matrix (3, 3 or more) and a lens."""
    return camera_of(table_of(size, K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), lens), str(where))


def _nanoseconds(stamp: str, where: str) -> int:
    if not stamp.strip().isdigit():
        raise RsbenchError(f"{where}: {stamp!r}: must be nanoseconds, a whole number")
    return int(stamp)


def _fields_of(path: Path, separator: str) -> Fields:
    """Return the words after each key of a file; brackets and semicolons of matrices count as blanks."""
    pairs = (line.partition(separator) for _, line in lines(path))
    return Fields({key.strip(): re.sub(r"[\[\];]", " ", value).split() for key, _, value in pairs}, str(path))


def _holders(folder: Path, pattern: str, wanted: str) -> list[Path]:
    """Return the folder and subfolders that contain a file of this name; RsbenchError if there are none."""
    found = sorted({path.parent for path in folder.rglob(pattern)})
    if not found:
        raise RsbenchError(f"{folder}: holds no {wanted}")
    return found


def _numbered_images(folder: Path, digits: int, kind: str) -> dict[View, Path]:
    """Return the image files of one kind by view, from file names with a frame number of ``digits`` digits."""
    found = sorted(folder.glob(f"{'[0-9]' * digits}_{kind}.*"))
    return {("left", int(path.name[:digits])): path for path in found if path.suffix in (".png", ".jpg")}


def _numbered_truths(folder: Path, digits: int, rows: Mapping[str, int]) -> dict[tuple[Side, int, int], Path]:
    """Return the global-shutter images of each kind, with the row at whose time they were taken."""
    found = {kind: _numbered_images(folder, digits, kind) for kind in rows}
    return {(*view, rows[kind]): path for kind, images in found.items() for view, path in images.items()}


_CORNER = 0.5


class Shot(NamedTuple):
    """An image: camera, name, pose, and a function that returns its observed pixels and their 3D points."""

    camera: str
    name: str
    pose: Pose
    seen: Callable[[], tuple[FloatArray, FloatArray]] | None


def read_colmap(folder: Path, images: Path | None = None) -> list[Recording]:
    """Read a recording for each rig of two cameras, and for each other camera; images are in the order of names.

    Args:
        folder: folder with cameras.txt and images.txt.
        images: folder to which image names are relative; by default ``images`` in ``folder``, or one or two levels
            above, or else ``folder``.

    Raises:
        RsbenchError: a file is missing or malformed, or a camera model is not supported.
    """
    cameras = dict(_colmap_camera(where, line) for where, line in lines(only_file(folder, "cameras.txt")))
    root = images or next(
        (each / "images" for each in (folder, *folder.parents[:2]) if (each / "images").is_dir()), folder
    )
    shots: dict[str, Shot] = {}
    points = folder / "points3D.txt"
    path = only_file(folder, "images.txt")
    for number, (line, seen_points) in enumerate(_colmap_image_lines(path), start=1):
        where = f"{path}, image {number}"
        identifier, name, camera, pose = _colmap_image(where, line)
        if camera not in cameras:
            raise RsbenchError(f"{path}: {name} is of camera {camera}, which cameras.txt lacks")
        seen = partial(_colmap_points_seen, points, seen_points, where)
        shots[identifier] = Shot(camera, name, pose, seen if points.is_file() else None)
    found = list[Recording]()
    rigs = _colmap_rigs(folder, cameras)
    for rig in rigs:
        times = [[shots[each] for each in together if each in shots] for together in rig.times]
        times = [{shot.camera: shot for shot in together} for together in times if together]
        found.append(_colmap_recording(f"rig {rig.number}", cameras, rig.sides, times, root, rig.right_from_left))
    paired = {camera for rig in rigs for camera in rig.sides.values()}
    for camera in dict.fromkeys(shot.camera for shot in shots.values() if shot.camera not in paired):
        times = [{camera: shot} for shot in shots.values() if shot.camera == camera]
        found.append(_colmap_recording(f"camera {camera}", cameras, {"left": camera}, times, root, None))
    return found


class _ColmapRig(NamedTuple):
    """A rig of two cameras: its number, the cameras' numbers, their relative pose, and the images by frame."""

    number: str
    sides: dict[Side, str]
    right_from_left: Pose
    times: list[list[str]]


def _colmap_rigs(folder: Path, cameras: Mapping[str, PinholeCamera]) -> list[_ColmapRig]:
    """Return the rigs of rigs.txt that have two cameras with poses; none if the file does not exist."""
    path, found = folder / "rigs.txt", list[_ColmapRig]()
    for where, line in lines(path) if path.is_file() else ():
        words = line.split()
        poses = colmap_poses(words, where)
        if not poses.keys() <= cameras.keys():
            raise RsbenchError(f"{where}: has a camera that cameras.txt lacks")
        if len(poses) == len(SIDES):
            (one, at_one), (two, at_two) = poses.items()
            sides, apart = _left_first((one, two), compose(at_two, inverse(at_one)))
            found.append(_ColmapRig(words[0], sides, apart, _colmap_times(folder, words[0])))
    return found


def _left_first(cameras: tuple[str, str], second_from_first: Pose) -> tuple[dict[Side, str], Pose]:
    """Determine the left one of two cameras from their relative pose; return the sides and right_from_left."""
    x, y, _ = inverse(second_from_first).t
    if (x if abs(x) >= abs(y) else y) < 0.0:  # in a vertical rig the upper camera is the left one
        return dict(zip(SIDES, cameras[::-1], strict=True)), inverse(second_from_first)
    return dict(zip(SIDES, cameras, strict=True)), second_from_first


def _colmap_times(folder: Path, rig: str) -> list[list[str]]:
    """Return the image numbers of each frame of a rig, from frames.txt."""
    found, path = list[list[str]](), only_file(folder, "frames.txt")
    for where, line in lines(path):
        words = line.split()
        data = words[10:]
        if len(words) < 10 or len(data) % 3 or words[9] != str(len(data) // 3):
            raise RsbenchError(f"{where}: must be a frame, a rig, its pose, and a count of images with these")
        if words[1] == rig:
            found.append([data[k + 2] for k in range(0, len(data), 3) if data[k] == "CAMERA"])
    return found


def _colmap_camera(where: str, line: str) -> tuple[str, PinholeCamera]:
    words = line.split()
    if len(words) < 5:
        raise RsbenchError(f"{where}: must be a number, a camera model, a size and parameters")
    table, _ = colmap_camera(words[1], words[4:], numbers(" ".join(words[2:4]), where, 2), where)
    return words[0], camera_of(table, where)


def _colmap_image_lines(path: Path) -> Iterator[tuple[str, str]]:
    """Yield the line of each image and the line of its points, which may be empty or absent without points."""
    image = ""
    for line in read_text(path).splitlines():
        if line.lstrip().startswith("#"):
            continue
        words = line.split()
        of_points = len(words) != 10 and all(NUMBER.fullmatch(word) for word in words)
        if image:
            yield image, line if of_points else ""
        image = "" if of_points else line
    if image:
        yield image, ""


def _colmap_image(where: str, line: str) -> tuple[str, str, str, Pose]:
    """Parse the number, name, camera and pose of an image."""
    words = line.split(maxsplit=9)
    if len(words) != 10:
        raise RsbenchError(f"{where}: must be a number, a quaternion, a translation, a camera and a name")
    values = numbers(" ".join(words[1:8]), where, 7)
    return words[0], words[9].strip(), words[8], Pose(quaternion_of(values[:4], where), values[4:])


def _colmap_points_seen(points: Path, line: str, where: str) -> tuple[FloatArray, FloatArray]:
    """Return pixels and 3D points from a line of triples (x, y, point number); -1 is a pixel without a point."""
    known, values = _colmap_points(points), numbers(line, where)
    if len(values) % 3:
        raise RsbenchError(f"{where}: its points must be x, y and a number each")
    rows = [row for row in values.reshape(-1, 3) if int(row[2]) in known]
    found = np.array([known[int(row[2])] for row in rows]).reshape(-1, 3)
    return np.array(rows).reshape(-1, 3)[:, :2] - _CORNER, found


@lru_cache(maxsize=2)
def _colmap_points(path: Path) -> dict[int, FloatArray]:
    """Return the positions of the 3D points by their number."""
    found = {}
    for where, line in lines(path):
        number, *place = numbers(" ".join(line.split()[:4]), where, 4)
        found[int(number)] = np.array(place)
    return found


def _colmap_recording(
    name: str,
    cameras: Mapping[str, PinholeCamera],
    sides: Mapping[Side, str],
    times: list[dict[str, Shot]],
    root: Path,
    right_from_left: Pose | None,
) -> Recording:
    """Return a recording of one or two cameras, from the images of each time, by camera, in any order."""
    times = sorted(times, key=lambda together: next(together[c].name for c in sides.values() if c in together))
    shots = {
        (side, k): together[camera]
        for side, camera in sides.items()
        for k, together in enumerate(times)
        if camera in together
    }
    poses = {side: {k: shot.pose for (each, k), shot in shots.items() if each == side} for side in sides}
    return Recording(
        name=name,
        cameras={side: cameras[camera] for side, camera in sides.items()},
        images={view: inside(root, shot.name) for view, shot in shots.items()},
        right_from_left=right_from_left,
        poses={side: partial(_pose_of_image, of_side) for side, of_side in poses.items() if of_side},
        sightings={view: shot.seen for view, shot in shots.items() if shot.seen is not None},
        notes=("the layout does not say when images were taken, or how rows were read",),
    )


def _pose_of_image(known: Mapping[int, Pose], tau: FloatArray) -> Pose:
    """Return the pose of the image with the index ``tau``; NaN if ``tau`` is not an integer."""
    tau = np.asarray(tau, dtype=np.float64)
    R, t = np.full((*tau.shape, 3, 3), np.nan), np.full((*tau.shape, 3), np.nan)
    for number, pose in known.items():
        R[tau == number], t[tau == number] = pose
    return Pose(R, t)


_EUROC_POSES = ("state_groundtruth_estimate0", "mocap0", "gt0")


def read_euroc(folder: Path, line_delays_s: Mapping[Side, float] | None = None) -> list[Recording]:
    """Read the sequence of a folder that is or contains ``mav0``, or contains the cameras.

    Args:
        line_delays_s: seconds between rows, 0 for a global shutter; if None, from the calibration.

    Raises:
        RsbenchError: a file is missing or malformed.
    """
    root = folder / "mav0" if (folder / "mav0").is_dir() else folder
    sensors = {side: root / f"cam{k}" for k, side in enumerate(SIDES) if (root / f"cam{k}").is_dir()}
    if "left" not in sensors:
        raise RsbenchError(f"{root}: holds no folder cam0")
    known = _asl_cameras(root, sensors)
    cameras = {side: camera_of(table, str(root)) for side, (table, _) in known.items()}
    body_from = {side: pose for side, (_, pose) in known.items()}
    times = {side: _euroc_times(path) for side, path in sensors.items()}
    together = _together(times, cameras["left"].height)
    if len(together) < 2:
        raise RsbenchError(f"{root}: the cameras have {len(together)} times in common; two are needed")
    stamps = [each["left"] for each in together]
    period = float(np.median(np.diff(stamps))) * 1e-9
    images: dict[View, Path] = {(s, k): times[s][each[s]] for s in sensors for k, each in enumerate(together)}
    apart = None if "right" not in sensors else compose(inverse(body_from["right"]), body_from["left"])
    world = _trajectory(root, stamps[0], period)
    shutters = {
        side: _euroc_shutter(cameras[side].height, delay, period, root)
        for side, delay in (line_delays_s or _line_delays(known)).items()
    }
    return [
        Recording(
            name=folder.name,
            cameras=cameras,
            images=images,
            shutters=shutters,
            frame_period_s=period,
            right_from_left=apart,
            poses={} if world is None else {s: partial(_camera_pose, world, body_from[s]) for s in sensors},
            notes=() if shutters else ("the layout does not say how rows are read",),
        )
    ]


def _asl_cameras(root: Path, sensors: Mapping[Side, Path]) -> dict[Side, tuple[Table, Pose]]:
    """Return the table and ``body_from_camera`` of each camera, from sensor.yaml or a camchain of Kalibr.

    TUM VI and TUM RS-VI are distributed with ``dso/camchain.yaml`` in place of the first.
    """
    files = {side: path / "sensor.yaml" for side, path in sensors.items()}
    chains = sorted({each for folder in (root, root.parent) for each in folder.glob("**/*camchain*.yaml")})
    if not any(path.is_file() for path in files.values()) and chains:
        found = kalibr_in_body(chains[0])
        if len(found) < len(sensors):
            raise RsbenchError(f"{chains[0]}: has {len(found)} cameras, and {root} {len(sensors)}")
        return dict(zip(sensors, found, strict=False))
    yamls = {side: Fields(read_tree(path), str(path)) for side, path in files.items()}
    return {side: (asl_camera(each), asl_pose(each)) for side, each in yamls.items()}


def _line_delays(known: Mapping[Side, tuple[Table, Pose]]) -> dict[Side, float]:
    """Return the time between rows of each camera, seconds; empty unless it is known for all cameras."""
    found = {side: table["line_delay_s"] for side, (table, _) in known.items() if "line_delay_s" in table}
    return found if len(found) == len(known) else {}


def _together(times: Mapping[Side, Mapping[int, Path]], height: int) -> list[dict[Side, int]]:
    """Match each left image to the images of other cameras with the nearest time stamp, within half a row.

    Time stamps of simultaneous images may differ by some nanoseconds, by separate clocks or rounding to floats.
    """
    left = np.array(sorted(times["left"]), dtype=np.int64)
    most = np.median(np.diff(left)) / height / 2.0 if len(left) > 1 else 0.0
    near = {side: np.array(sorted(of_side), dtype=np.int64) for side, of_side in times.items() if of_side}
    found = list[dict[Side, int]]()
    for stamp in left if len(near) == len(times) else ():
        each = {side: int(stamps[np.argmin(np.abs(stamps - stamp))]) for side, stamps in near.items()}
        if all(abs(value - int(stamp)) <= most for value in each.values()):
            found.append(each)
    return found


def _euroc_times(folder: Path) -> dict[int, Path]:
    """Return the image files by time stamp, nanoseconds."""
    out = {}
    for where, line in lines(folder / "data.csv"):
        stamp, _, name = line.partition(",")
        out[_nanoseconds(stamp, where)] = inside(folder / "data", name.strip())
    return dict(sorted(out.items()))


def _trajectory(root: Path, start_ns: int, period_s: float) -> PoseAt | None:
    """Return a function from time, frame periods, to ``world_from_body``; None without a file of poses."""
    path = next((root / name / "data.csv" for name in _EUROC_POSES if (root / name / "data.csv").is_file()), None)
    if path is None:
        return None
    stamps, rows = list[float](), list[tuple[FloatArray, FloatArray]]()
    for where, line in lines(path):
        stamp, _, rest = line.partition(",")
        ns, values = _nanoseconds(stamp, where), numbers(rest, where)
        if len(values) < 7:
            raise RsbenchError(f"{where}: must be a time, a position and a quaternion")
        stamps.append((ns - start_ns) * 1e-9 / period_s)
        rows.append((quaternion_of(values[3:7], where), values[:3]))
    tau = np.array(stamps)
    if len(tau) < 2 or not np.all(np.diff(tau) > 0.0):
        raise RsbenchError(f"{path}: must hold at least two times, increasing")
    turns = Slerp(tau, Rotation.from_matrix(np.array([R for R, _ in rows])))
    return partial(_between, tau, turns, np.array([p for _, p in rows]))


def _between(known: FloatArray, turns: Slerp, places: FloatArray, tau: FloatArray) -> Pose:
    """Interpolate poses: positions linearly, rotations at constant angular velocity; NaN outside given times."""
    tau = np.asarray(tau, dtype=np.float64)
    clipped = np.clip(tau, known[0], known[-1])
    R = turns(clipped.ravel()).as_matrix().reshape(*tau.shape, 3, 3)
    p = np.stack([np.interp(clipped, known, places[:, axis]) for axis in range(3)], axis=-1)
    beyond = clipped != tau
    return Pose(np.where(beyond[..., None, None], np.nan, R), np.where(beyond[..., None], np.nan, p))


def _camera_pose(world_from_body: PoseAt, body_from_camera: Pose, tau: FloatArray) -> Pose:
    return inverse(compose(world_from_body(tau), body_from_camera))


def _euroc_shutter(height: int, line_delay_s: float, period_s: float, root: Path) -> RollingShutter:
    ratio = line_delay_s * height / period_s
    if not 0.0 <= ratio <= 1.0:
        raise RsbenchError(
            f"{root}: a line delay of {1e6 * line_delay_s:g} us makes a readout ratio of {ratio:.3f}"
        )
    return RollingShutter(height=height, readout_ratio=ratio)


_CARLA_FPS = 20.0
"""Frame rate of the published data, used without rs_calib.txt."""


def read_carla(folder: Path) -> list[Recording]:
    """Read the sequences in a folder and its subfolders.

    Raises:
        RsbenchError: there is no gt_vel.log, or a file is malformed.
    """
    found = _holders(folder, "gt_vel.log", "gt_vel.log, as sequences of Carla-RS do")
    return [_read_carla_sequence(each) for each in found]


def _read_carla_sequence(folder: Path) -> Recording:
    images = _numbered_images(folder, 4, "rs")
    if not images:
        raise RsbenchError(f"{folder}: holds no 0000_rs.png")
    height, width = read_frame(next(iter(images.values()))).shape[:2]
    camera = PinholeCamera.centred(width, height, width / 2)
    fps, row_s, known = _carla_timing(folder, height)
    ratio = row_s * height * fps
    if not 0.0 <= ratio <= 1.0 + 1e-6:
        raise RsbenchError(f"{folder}: rows of {1e3 * row_s} ms at {fps} Hz make a readout ratio of {ratio:.3f}")
    velocity = [numbers(line, where, 6) for where, line in lines(folder / "gt_vel.log")]
    if len(velocity) != 1:
        raise RsbenchError(f"{folder / 'gt_vel.log'}: has {len(velocity)} velocities, not one")
    w, v = velocity[0][:3] / fps, velocity[0][3:] / fps
    depths = {view: reader for view in images if (reader := _carla_depth(folder, view[1], camera)) is not None}
    assumed = f"no rs_calib.txt: {_CARLA_FPS:g} Hz and a readout ratio of 1 are those of the published data"
    return Recording(
        name=folder.name,
        cameras={"left": camera},
        images=images,
        shutters={"left": RollingShutter(height=height, readout_ratio=min(ratio, 1.0))},
        frame_period_s=1.0 / fps,
        poses={"left": partial(_carla_pose, w, v)},
        depths=depths,
        truths=_numbered_truths(folder, 4, {"gs_f": 0, "gs_m": height // 2}),
        masks=_numbered_images(folder, 4, "mask"),
        notes=() if known else (assumed,),
    )


def _carla_pose(w: FloatArray, v: FloatArray, tau: FloatArray) -> Pose:
    """Return ``cam_from_world`` at times (...), frame periods, for velocities per frame period."""
    tau = np.asarray(tau, dtype=np.float64)[..., None]
    return inverse(Pose(so3.exp(tau * w), tau * v))


def _carla_timing(folder: Path, height: int) -> tuple[float, float, bool]:
    """Return frames per second, seconds per row, and whether rs_calib.txt, here or one folder up, defines them."""
    for path in (folder / "rs_calib.txt", folder.parent / "rs_calib.txt"):
        if path.is_file():
            fields = _fields_of(path, ":")
            fps, row_ms = fields.number("FPS"), fields.number("ROW_READOUT_TIME(ms)")
            if not fps > 0.0:
                raise RsbenchError(f"{path}: FPS = {fps}: must be positive")
            return fps, 1e-3 * row_ms, True
    return _CARLA_FPS, 1.0 / _CARLA_FPS / height, False


def _carla_depth(folder: Path, frame: int, camera: PinholeCamera) -> Callable[[], FloatArray] | None:
    for suffix, radial in ((".depth", True), (".pdepth", False)):
        path = folder / f"{frame:04d}_rs{suffix}"
        if path.is_file():
            return partial(_read_carla_depth, path, camera, radial)
    return None


def _read_carla_depth(path: Path, camera: PinholeCamera, radial: bool) -> FloatArray:
    rows = [numbers(line, where, camera.width) for where, line in lines(path)]
    if len(rows) != camera.height:
        raise RsbenchError(f"{path}: has {len(rows)} rows, not {camera.height}")
    distance = np.array(rows)
    return distance / np.linalg.norm(camera.unproject(camera.pixel_grid()), axis=-1) if radial else distance


def read_fastec(folder: Path) -> list[Recording]:
    """Read the sequences in a folder and its subfolders.

    Raises:
        RsbenchError: there is no frame, or the first frame of a sequence is not an image.
    """
    wanted = "000_rolling.png, as sequences of Fastec-RS do"
    places = _holders(folder, "[0-9][0-9][0-9]_rolling.png", wanted)
    return [_read_fastec_sequence(place, folder) for place in places]


def _read_fastec_sequence(place: Path, folder: Path) -> Recording:
    images = _numbered_images(place, 3, "rolling")
    height, width = read_frame(next(iter(images.values()))).shape[:2]
    focal = DEFAULT_FOCAL * width
    return Recording(
        name=place.name if place == folder else place.relative_to(folder).as_posix(),
        cameras={"left": PinholeCamera.centred(width, height, focal)},
        images=images,
        shutters={"left": RollingShutter(height=height, readout_ratio=1.0)},
        truths=_numbered_truths(place, 3, {"global_first": 0, "global_middle": height // 2}),
        notes=(
            f"no calibration: a focal length of {focal:g} px, the width, and a readout ratio of 1 are assumed",
        ),
    )


_MM = 1e-3


def read_middlebury(folder: Path) -> list[Recording]:
    """Read the scenes in a folder and its subfolders; RsbenchError if there are none or a file is malformed."""
    found = sorted(path.parent for path in folder.glob("**/calib.txt") if (path.parent / "im0.png").is_file())
    if not found:
        raise RsbenchError(f"{folder}: holds no scene of Middlebury: no calib.txt beside an im0.png")
    return [_middlebury(each) for each in found]


def _middlebury(folder: Path) -> Recording:
    fields = _fields_of(folder / "calib.txt", "=")
    K0, K1 = (fields.numbers(key, 9).reshape(3, 3) for key in ("cam0", "cam1"))
    width, height, baseline = (fields.number(key) for key in ("width", "height", "baseline"))
    offset = fields.number("doffs", float(K1[0, 2] - K0[0, 2]))
    left, right = (_pinhole((width, height), K, fields.where) for K in (K0, K1))
    images: dict[View, Path] = {(side, 0): folder / f"im{k}.png" for k, side in enumerate(SIDES)}
    disparities: dict[View, Callable[[], FloatArray]] = {}
    for k, view in enumerate(images):
        named = [folder / f"disp{k}.pfm", folder / f"disp{k}GT.pfm"]  # the second in MiddEval3 and ETH3D
        for path in [each for each in named if each.is_file()][:1]:
            disparities[view] = partial(_middlebury_disparities, path, offset)
    return Recording(
        name=folder.name,
        cameras={"left": left, "right": right},
        images={view: image for view, image in images.items() if image.is_file()},
        right_from_left=_apart(_MM * baseline),
        disparities=disparities,
        notes=() if disparities else ("there is no disp0.pfm or disp0GT.pfm: disparities are not compared",),
    )


def _apart(baseline: float) -> Pose:
    return Pose(np.eye(3), np.array([-baseline, 0.0, 0.0]))


def _middlebury_disparities(path: Path, offset: float) -> FloatArray:
    """Read disparities (H, W) from a grey PFM and add the offset of the principal points; NaN where unknown."""
    data = read_bytes(path)
    found = re.match(rb"Pf\s+(\d+)\s+(\d+)\s+(-?[0-9.eE+]+)\s", data)
    if found is None:
        raise RsbenchError(f"{path}: is not a grey PFM")
    width, height, scale = int(found[1]), int(found[2]), float(found[3])
    values = data[found.end() :]
    if len(values) != 4 * width * height:
        raise RsbenchError(f"{path}: has {len(values)} bytes of numbers, not those of {width} x {height}")
    # A negative scale means little-endian; the lowest row always comes first.
    rows = np.frombuffer(values, dtype="<f4" if scale < 0.0 else ">f4").reshape(height, width)[::-1]
    return np.where(np.isfinite(rows) & (rows > 0.0), rows + offset, np.nan).astype(np.float64)


def read_kitti(folder: Path) -> list[Recording]:
    """Read each pair ``*_10.png``, with its disparities and the images of the next time if they exist."""
    pairs = (("image_2", "image_3"), ("image_0", "image_1"))
    images = next((names for names in pairs if all((folder / name).is_dir() for name in names)), None)
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


def _kitti(folder: Path, names: tuple[str, str], truth: str | None, calib: str, number: str) -> Recording:
    fields = _fields_of(only_file(folder / calib, f"{number}.txt"), ":")
    keys = (fields.known(f"P_rect_0{name[-1]}", f"P{name[-1]}") for name in names)
    matrices = [fields.numbers(key, 12).reshape(3, 4) for key in keys]
    files: dict[View, Path] = {
        (side, frame): folder / name / f"{number}_1{frame}.png"
        for side, name in zip(SIDES, names, strict=True)
        for frame in (0, 1)
    }
    height, width = read_frame(files["left", 0]).shape[:2]
    left, right = (_pinhole((width, height), P, fields.where) for P in matrices)
    baseline = matrices[0][0, 3] / matrices[0][0, 0] - matrices[1][0, 3] / matrices[1][0, 0]
    offset = right.cx - left.cx
    found = folder / (truth or "") / f"{number}_10.png"
    known = truth is not None and found.is_file()
    read = partial(_kitti_disparities, found, (width, height), offset)
    return Recording(
        name=number,
        cameras={"left": left, "right": right},
        images={view: file for view, file in files.items() if file.is_file()},
        right_from_left=_apart(float(baseline)),
        disparities={("left", 0): read} if known else {},
    )


def _kitti_disparities(path: Path, size: tuple[int, int], offset: float) -> FloatArray:
    values = read_grey_png(path, size, 16)
    return np.where(values > 0, values / 256.0 + offset, np.nan)


def read_kitti_raw(folder: Path) -> list[Recording]:
    """Read the drives in a folder, or a single drive; RsbenchError if there are none or a file is malformed."""
    found = sorted(path.parent for pair in _KITTI_PAIRS for path in folder.glob(f"**/{pair[0]}") if path.is_dir())
    if not found:
        raise RsbenchError(f"{folder}: holds no drive of KITTI: no folders image_02 and image_03, or 00 and 01")
    return [_kitti_drive(drive) for drive in dict.fromkeys(found)]


_KITTI_PAIRS = (("image_02", "image_03"), ("image_00", "image_01"))


def _kitti_drive(drive: Path) -> Recording:
    names = next((pair for pair in _KITTI_PAIRS if all((drive / name).is_dir() for name in pair)), None)
    if names is None:
        raise RsbenchError(f"{drive}: holds one camera alone; image_02 and image_03, or image_00 and image_01")
    path = only_file(drive if (drive / "calib_cam_to_cam.txt").is_file() else drive.parent, "calib_cam_to_cam.txt")
    images: dict[View, Path] = {
        (side, int(file.stem)): file
        for side, name in zip(SIDES, names, strict=True)
        for file in sorted((drive / name / "data").glob("[0-9]*.png"))
    }
    if not images:
        raise RsbenchError(f"{drive / names[0] / 'data'}: holds no 0000000000.png")
    height, width = read_frame(next(iter(images.values()))).shape[:2]
    both = [_kitti_camera(_fields_of(path, ":"), name[-2:], (width, height)) for name in names]
    cameras = dict(zip(SIDES, (camera for camera, _ in both), strict=True))
    return Recording(
        name=drive.name,
        cameras=cameras,
        images=images,
        shutters={
            side: RollingShutter(height=camera.height, readout_ratio=0.0) for side, camera in cameras.items()
        },
        frame_period_s=_kitti_period(drive / names[0] / "timestamps.txt"),
        right_from_left=compose(both[1][1], inverse(both[0][1])),
    )


def _kitti_camera(fields: Fields, number: str, size: tuple[int, int]) -> tuple[PinholeCamera, Pose]:
    """Return camera ``number`` of calib_cam_to_cam.txt for images of this size, and its pose from camera 0."""
    raw, rectified = (tuple(map(int, fields.numbers(f"{key}_{number}", 2))) for key in ("S", "S_rect"))
    if size == raw:
        K, d, R, t = (fields.numbers(f"{key}_{number}", n) for key, n in (("K", 9), ("D", 5), ("R", 9), ("T", 3)))
        pose = Pose(rotation_of(R, f"{fields.where}: R_{number}"), t)
        return _pinhole(size, K.reshape(3, 3), fields.where, brown(d, fields.where)), pose
    if size == rectified:
        P = fields.numbers(f"P_rect_{number}", 12).reshape(3, 4)
        t = np.asarray(np.linalg.inv(P[:, :3]) @ P[:, 3], dtype=np.float64)
        return _pinhole(size, P, fields.where), Pose(np.eye(3), t)
    raise RsbenchError(
        f"{fields.where}: its images are {size[0]} x {size[1]} pixels: neither S_{number} nor S_rect_{number}"
    )


def _kitti_period(path: Path) -> float:
    """Return the median time between frames, s, from a file with a date and a time in each line."""
    days = [line.split() for _, line in lines(path)]
    try:
        seconds = [60 * (60 * int(h) + int(m)) + float(s) for _, time in days for h, m, s in [time.split(":")]]
    except ValueError:
        raise RsbenchError(f"{path}: must hold lines of a date and a time") from None
    if len(seconds) < 2:
        raise RsbenchError(f"{path}: has {len(seconds)} times; two are needed")
    return float(np.median(np.diff(seconds) % 86400.0))


_TUM_RSVI: Mapping[Side, float] = {"left": 0.0, "right": 29.4737e-6}
"""Line delays, s: D. Schubert et al., Rolling-Shutter Modelling for Direct Visual-Inertial Odometry, IROS 2019."""


FORMATS: Mapping[str, Callable[[Path], list[Recording]]] = {
    "carla-rs": read_carla,
    "colmap": read_colmap,
    "euroc": read_euroc,
    "fastec-rs": read_fastec,
    "kitti": read_kitti,
    "kitti-raw": read_kitti_raw,
    "middlebury": read_middlebury,
    "tum-rsvi": partial(read_euroc, line_delays_s=_TUM_RSVI),
}


def read_others(folder: Path, format_name: str) -> list[Recording]:
    """Read the recordings of a folder.

    Raises:
        RsbenchError: the layout is unknown, or the folder does not have it.
    """
    if format_name not in FORMATS:
        raise RsbenchError(f"--from {format_name}: is not a layout{choices(format_name, FORMATS)}")
    if not folder.is_dir():
        raise RsbenchError(f"{folder}: no such folder")
    return FORMATS[format_name](folder)
