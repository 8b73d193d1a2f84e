"""Export datasets and output of ``rsbench correct`` as COLMAP text models and trajectories in TUM's format.

COLMAP (its documentation, "Output Format"; camera models of its ``sensor/models.h``): cameras, images with their
poses, and points from the depth with all observations. Poses are ``cam_from_world`` with quaternions (w, x, y, z)
and our camera axes; (0, 0) is the corner of the image.

TUM RGB-D benchmark, as evo reads it: ``timestamp tx ty tz qx qy qz qw``, seconds and metres,
``world_from_camera``.

A corrected frame is a global-shutter image, so it has a single pose, at the time of the row to which it was
corrected.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rsbench.components.cards import parse_card
from rsbench.core import so3
from rsbench.core.camera import Lens, LensModel, PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.se3 import Pose, inverse, transform
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.dataset.corrected_frames import MARKER, read_corrected
from rsbench.dataset.motion_cards import FORMAT
from rsbench.dataset.sequence import RigManifest, Sequence
from rsbench.interop.writers.sequence_views import (
    CORNER_PX,
    Format,
    Images,
    Note,
    Surfaces,
    View,
    about_moving_objects,
    copy_file,
    copy_image,
    first_pose,
    lens_fault,
    number,
    numbers,
    one_by_one,
    surfaces,
    views_in_time,
    write_lines,
)
from rsbench.storage.files import read_depth
from rsbench.storage.untrusted_files import check_amount, read_json, read_text

_COLMAP_ABOUT = (
    "SEQUENCE/sparse holds cameras.txt, images.txt, points3D.txt and, since COLMAP 3.12, rigs.txt and frames.txt; "
    "SEQUENCE/images the images. The world "
    "is the rig's body at time 0 (x right, y down, z forward, metres). Points are those of the true depth, "
    "observations their exact projections; points on objects that move are left out."
)
_ONE_POSE = (
    "the images are rolling-shutter frames: images.txt has the pose of the line that is read first, and the "
    "observations are where the rolling shutter sees the points, so they do not reproject"
)
_TWO_TIMES = "the right camera is late, so its images are of other times: there is no rigs.txt"


def _write_colmap(sequence: Sequence, root: Path, images: Images) -> Note:
    folder = root / sequence.name
    found = surfaces(sequence, images)
    sparse = folder / "sparse"
    sparse.mkdir(parents=True)
    write_lines(sparse / "cameras.txt", _camera_lines(sequence.rig))
    write_lines(sparse / "images.txt", _image_lines(sequence, found))
    write_lines(sparse / "points3D.txt", _point_lines(sequence, found))
    for view in views_in_time(sequence):
        copy_image(sequence, view, images, folder / "images" / view.name)
    sentences = [_ONE_POSE] if images == "rs" else []
    if sequence.shutter.right_delay:
        sentences.append(_TWO_TIMES)
    else:
        lefts = [first_pose(sequence, View("left", frame)) for frame in range(sequence.frames)]
        _write_rig(sparse, sequence.rig, lefts)
    return sentences + about_moving_objects(sequence), {"points": len(found.world)}


def _camera_lines(rig: StereoRig) -> list[str]:
    return [camera_line(k, rig.sensor(side)) for k, side in enumerate(SIDES, start=1)]


def _write_rig(sparse: Path, rig: StereoRig, lefts: list[Pose]) -> None:
    """Write rigs.txt and frames.txt for the left camera's poses; frame k has the images 2 k + 1 and 2 k + 2."""
    right = rig.right_from_left
    write_lines(sparse / "rigs.txt", [f"1 2 CAMERA 1 CAMERA 2 1 {_pose_words(right)}"])
    frames = [
        f"{k} 1 {_pose_words(left)} 2 CAMERA 1 {2 * k - 1} CAMERA 2 {2 * k}" for k, left in enumerate(lefts, 1)
    ]
    write_lines(sparse / "frames.txt", frames)


def _pose_words(pose: Pose) -> str:
    return f"{numbers(so3.quaternion(pose.R))} {numbers(pose.t)}"


def camera_line(identifier: int, camera: PinholeCamera) -> str:
    """Return a line of cameras.txt."""
    lens = camera.lens
    model = "PINHOLE" if lens is None else _MODELS[lens.model]
    if lens is not None and lens.model == "brown-conrady" and lens.k3 != 0.0:
        model = "FULL_OPENCV"
    known = (() if lens is None else lens.coefficients)[: _COEFFICIENTS[model]]
    values = [camera.fx, camera.fy, camera.cx + CORNER_PX, camera.cy + CORNER_PX, *known]
    values += [0.0] * (_COEFFICIENTS[model] - len(known))
    return f"{identifier} {model} {camera.width} {camera.height} {numbers(values)}"


_MODELS: Mapping[LensModel, str] = {
    "brown-conrady": "OPENCV",
    "kannala-brandt": "OPENCV_FISHEYE",
    "rational": "FULL_OPENCV",
}
_COEFFICIENTS = {"PINHOLE": 0, "OPENCV": 4, "OPENCV_FISHEYE": 4, "FULL_OPENCV": 8}


def _image_lines(sequence: Sequence, found: Surfaces) -> list[str]:
    lines = list[str]()
    for k, view in enumerate(views_in_time(sequence)):
        pose = first_pose(sequence, view)
        camera = SIDES.index(view.side) + 1
        lines.append(f"{k + 1} {_pose_words(pose)} {camera} {view.name}")
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
    """Return the lines of points3D.txt; the reprojection errors are written as 0."""
    tracks: list[list[str]] = [[] for _ in found.world]
    for k, view in enumerate(views_in_time(sequence)):
        for place, point in enumerate(found.seen[view].index.tolist()):
            tracks[point].append(f"{k + 1} {place}")
    colours = found.colours.tolist()
    return [
        f"{k + 1} {numbers(world)} {' '.join(map(str, colours[k]))} 0 {' '.join(tracks[k])}"
        for k, world in enumerate(np.asarray(found.world))
    ]


_TUM_ABOUT = (
    "SEQUENCE/left.txt and right.txt have the pose of each frame at the time of the line that is read "
    "first, left_rows.txt and right_rows.txt that of every line at its own time, body.txt that of the "
    "middle of the rig. Seconds count from the first line of the left camera's frame 0; the world is the "
    "body then, camera axes are x right, y down, z forward."
)


def _write_tum(sequence: Sequence, root: Path, images: Images) -> Note:
    folder = root / sequence.name
    folder.mkdir(parents=True)
    shutter, motion, rig = sequence.shutter, sequence.motion, sequence.rig
    frames = np.arange(sequence.frames, dtype=np.float64)
    write_poses(folder / "body.txt", sequence.frame_period_s * frames, motion.body_from_world(frames))
    sentences = list[str]()
    for side in SIDES:
        starts = shutter.start(frames, side)
        write_poses(
            folder / f"{side}.txt", sequence.frame_period_s * starts, rig.cam_from_world(motion, starts, side)
        )
        times = line_times(sequence, side)
        if times is None:
            which = "" if sequence.shutter.still else f" of the {side} camera"
            sentences = [f"all lines{which} are read at once: there is no trajectory of lines"]
        else:
            poses = rig.cam_from_world(motion, times, side)
            write_poses(folder / f"{side}_rows.txt", sequence.frame_period_s * times, poses)
    return sentences, {}


def line_times(sequence: Sequence, side: Side) -> FloatArray | None:
    """Return the times (n,) of all lines of all frames, ascending, frame periods; None for a global shutter."""
    if sequence.shutter.ratio_of(side) == 0.0:
        return None
    frames = range(sequence.frames)
    return np.sort(np.concatenate([sequence.shutter.line_times(frame, side) for frame in frames]))


def write_poses(path: Path, seconds: FloatArray, cam_from_world: Pose) -> None:
    R, t = inverse(cam_from_world)
    table = np.concatenate([seconds[:, None], t, so3.quaternion(R)[:, [1, 2, 3, 0]]], axis=1)
    write_lines(path, [f"# {FORMAT}", *map(numbers, table)])


def _colmap_fault(sequence: Sequence, images: Images) -> str:
    return lens_fault(sequence.rig, *_MODELS)


COLMAP = Format(_COLMAP_ABOUT, ("gs", "rs"), one_by_one(_write_colmap), fault=_colmap_fault)
TUM = Format(_TUM_ABOUT, (), one_by_one(_write_tum))


# Frames that ``rsbench correct`` wrote


CORRECTED_ABOUT = {
    "tum": (
        "NAME/body.txt has the pose of the middle of the rig at the start of each frame that was corrected, "
        "NAME/left.txt and right.txt those of the cameras, NAME/left_rows.txt that of the left camera at each of "
        "its rows, if --row-poses was given. Times are frame periods; the world is the body at the start of the "
        "first frame, camera axes are x right, y down, z forward."
    ),
    "colmap": (
        "NAME/sparse holds cameras.txt, images.txt and points3D.txt, NAME/images the corrected frames, NAME/masks "
        "0 where nothing is drawn. Poses are those of the trajectory at the time to which frames were corrected. "
        "Points are those of the depth of the left frames, each of one frame and without observations. The world "
        "is the body at the start of the first frame (x right, y down, z forward, metres)."
    ),
}
_CORRECTED_POINTS, _MOST_POSES = 50_000, 10_000_000
_UNIT = 1e-3


class Corrected(NamedTuple):
    """A folder of corrected frames."""

    folder: Path
    rig: StereoRig
    times: FloatArray
    """(n,) frame periods."""
    poses: Pose
    """(n, 3, 3), (n, 3) body_from_world at these times, which are the starts of frames."""
    row: float
    """The row to whose time the frames were corrected, counted in the order of the readout."""
    shutter: RollingShutter

    @property
    def name(self) -> str:
        return self.folder.resolve().name


def is_corrected(folder: Path) -> bool:
    """Return whether a folder was written by ``rsbench correct``."""
    return (folder / MARKER).is_file() and not (folder / "dataset.json").exists()


def read_corrected_folder(folder: Path) -> Corrected:
    """Read a folder of corrected frames with its rig and trajectory.

    Raises:
        RsbenchError: the folder has no trajectory, or its files have no valid rig or poses.
    """
    path, table = folder / MARKER, folder / "trajectory.csv"
    if not table.is_file():
        raise RsbenchError(
            f"{folder}: has no trajectory.csv, so there are no poses; rsbench correct writes one of four frames "
            "and more of a rig, without --motion-model NAME"
        )
    record = read_json(path)
    try:
        if "cameras" in record:
            rig = parse_card(RigManifest, record, str(path), extra="ignore").rig
        else:
            camera, lens = record["camera"], record["lens"]
            known = None if lens is None else parse_card(Lens, lens, str(path))
            rig = StereoRig(camera=PinholeCamera(**camera, lens=known), baseline=record["baseline"])
        shutter = rig.shutter_of(parse_card(Scanning, record["scan"], str(path)), record["readout_ratio"])
        row = float(record["target_row"])
    except (KeyError, TypeError, ValueError) as error:
        raise RsbenchError(
            f"{path}: does not say the rig of corrected frames: {error!r}; correct again"
        ) from error
    times, poses = read_poses(table)
    return Corrected(folder, rig, times, poses, row, shutter)


def read_poses(path: Path) -> tuple[FloatArray, Pose]:
    """Read times (n,) and poses body_from_world from a file in TUM's format; RsbenchError if it is invalid."""
    lines = [line for line in read_text(path).splitlines() if line.strip() and not line.startswith("#")]
    check_amount(path, "poses", len(lines), _MOST_POSES)
    table = np.zeros((0, 8))
    with contextlib.suppress(ValueError):  # not numbers, or lines of different lengths
        table = np.array([[float(word) for word in line.split()] for line in lines], dtype=np.float64)
    good = len(table) > 0 and table.shape[1:] == (8,) and bool(np.all(np.isfinite(table)))
    lengths = np.linalg.norm(table[..., 4:], axis=-1)
    if not (good and np.all(np.abs(lengths - 1.0) < _UNIT) and np.all(np.diff(table[:, 0]) > 0.0)):
        raise RsbenchError(f"{path}: must hold lines of {FORMAT}, times rising; correct again")
    R = so3.from_quaternion(table[:, [7, 4, 5, 6]] / lengths[:, None])
    return table[:, 0], inverse(Pose(R, table[:, 1:4]))


def export_corrected(corrected: Corrected, name: str, root: Path) -> Note:
    """Export a folder of corrected frames to a subfolder of ``root``."""
    folder = root / corrected.name
    folder.mkdir(parents=True)
    if name == "tum":
        return _write_corrected_tum(corrected, folder)
    return _write_corrected_colmap(corrected, folder)


def check_corrected(corrected: Corrected, name: str) -> None:
    """Raise RsbenchError if a format cannot represent a folder of corrected frames."""
    if name not in CORRECTED_ABOUT:
        raise RsbenchError(
            f"--to {name}: {corrected.folder} holds corrected frames, which are exported to "
            f"{' or '.join(CORRECTED_ABOUT)}"
        )
    if name == "colmap" and (fault := lens_fault(corrected.rig, *_MODELS)):
        raise RsbenchError(f"--to {name}: {corrected.folder}: {fault}")
    if name == "colmap" and not _of_one_time(corrected):
        raise RsbenchError(
            f"--to {name}: {corrected.folder}: its cameras do not read each row at one time, so that a "
            "corrected pair has two; take --to tum"
        )


def _of_one_time(corrected: Corrected) -> bool:
    """Return whether both frames of a pair were corrected to the same time: ``CorrectionProblem.target_time``."""
    shutter = corrected.shutter
    by_left = (shutter.right_readout_ratio, shutter.right_size) != (None, None)
    return shutter.rows_together or (shutter.right_delay == 0.0 and (by_left or corrected.row == 0.0))


def _camera_pose(corrected: Corrected, side: Side, body: Pose) -> Pose:
    """Return cam_from_world of a camera of the rig for a pose body_from_world."""
    offset, turn = corrected.rig.offset(side), corrected.rig.own(side).R
    return Pose(turn @ body.R, (body.t + offset) @ turn.T)


def _write_corrected_tum(corrected: Corrected, folder: Path) -> Note:
    write_poses(folder / "body.txt", corrected.times, corrected.poses)
    for side in SIDES:
        write_poses(folder / f"{side}.txt", corrected.times, _camera_pose(corrected, side, corrected.poses))
    sentences = ["times are frame periods: the corrected folder has no frame rate"]
    rows = corrected.folder / "row_poses.csv"
    if rows.is_file():
        times, poses = read_poses(rows)
        write_poses(folder / "left_rows.txt", times, _camera_pose(corrected, "left", poses))
    else:
        sentences.append("there are no poses of rows; rsbench correct --row-poses writes them")
    return sentences, {"poses": len(corrected.times)}


def _write_corrected_colmap(corrected: Corrected, folder: Path) -> Note:
    frames = _posed_frames(corrected)
    if not frames:
        raise RsbenchError(f"{corrected.folder}: no frame was corrected and has a pose")
    sparse = folder / "sparse"
    sparse.mkdir()
    lines, points = list[str](), list[str]()
    camera = corrected.rig.sensor("left")
    step = max(1, round(np.sqrt(camera.width * camera.height * len(frames) / _CORRECTED_POINTS)))
    for k, (frame, body) in enumerate(frames):
        for number_, side in enumerate(SIDES, start=1):
            pose, stem = _camera_pose(corrected, side, body), f"{side}_{frame:06d}"
            identifier = len(SIDES) * k + number_
            lines += [f"{identifier} {_pose_words(pose)} {number_} {stem}.png", ""]
            copy_file(corrected.folder, f"corrected/{stem}.png", folder / "images" / f"{stem}.png")
            copy_file(corrected.folder, f"mask/{stem}.png", folder / "masks" / f"{stem}.png.png")
        points += _corrected_points(corrected, frame, _camera_pose(corrected, "left", body), step, len(points))
    _write_rig(sparse, corrected.rig, [_camera_pose(corrected, "left", body) for _, body in frames])
    for name, content in (("cameras", _camera_lines(corrected.rig)), ("images", lines), ("points3D", points)):
        write_lines(sparse / f"{name}.txt", content)
    left_out = len(corrected.times) - len(frames)
    words = "frames of the trajectory were not corrected, or have no pose at their row, and are left out"
    return [f"{left_out} {words}"] if left_out else [], {"frames": len(frames), "points": len(points)}


def _posed_frames(corrected: Corrected) -> list[tuple[int, Pose]]:
    """Return the corrected frames, each with the body's pose at the time to which it was corrected."""
    times, poses = corrected.times, corrected.poses
    if corrected.row != 0.0:
        times, poses = _at_row(corrected)
    frames = [(round(float(np.floor(tau + 1e-9))), k) for k, tau in enumerate(times)]
    there = [
        (frame, k)
        for frame, k in frames
        if all((corrected.folder / "corrected" / f"{side}_{frame:06d}.png").is_file() for side in SIDES)
    ]
    return [(frame, Pose(poses.R[k], poses.t[k])) for frame, k in there]


def _at_row(corrected: Corrected) -> tuple[FloatArray, Pose]:
    """Return frame times and poses at the row to which frames were corrected, from row_poses.csv."""
    path = corrected.folder / "row_poses.csv"
    if not path.is_file():
        raise RsbenchError(
            f"--to colmap: {corrected.folder}: its frames are of the time of row {corrected.row:g}, "
            "trajectory.csv of row 0; correct again with --row-poses, or without --target"
        )
    times, poses = read_poses(path)
    wanted = corrected.shutter.time_after(corrected.row, corrected.times, "left")
    near = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    near -= wanted - times[near - 1] < times[near] - wanted
    known = np.abs(times[near] - wanted) <= corrected.shutter.readout_ratio / corrected.shutter.height
    return corrected.times[known], Pose(poses.R[near[known]], poses.t[near[known]])


def _corrected_points(corrected: Corrected, frame: int, left: Pose, step: int, before: int) -> list[str]:
    """Return lines of points3D.txt for every ``step``-th pixel in both directions that has depth."""
    stem, cut = f"left_{frame:06d}", slice(step // 2, None, step)
    path = corrected.folder / "depth" / f"{stem}.exr"
    if not path.is_file():
        return []
    camera = corrected.rig.sensor("left")
    depth = read_depth(path, (camera.width, camera.height))[cut, cut]
    image = read_corrected(corrected.folder, stem)
    if image.shape[:2] != (camera.height, camera.width):
        raise RsbenchError(f"{corrected.folder}: {stem}.png is not of the size that {MARKER} says; correct again")
    image = image[cut, cut]
    grey = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image[..., :3]
    colours = (grey >> 8 if grey.dtype == np.uint16 else grey)[depth > 0.0]
    pixels = camera.pixel_grid()[cut, cut][depth > 0.0]
    x = depth[depth > 0.0][:, None] * camera.unproject(pixels)
    world = transform(inverse(left), x)
    return [
        f"{before + k} {numbers(place)} {' '.join(map(str, colour))} {number(0.0)}"
        for k, (place, colour) in enumerate(zip(world, colours.tolist(), strict=True), start=1)
    ]
