"""What ``rsbench correct`` made of footage, in the layouts of TUM and COLMAP: its trajectory, frames with poses.

A corrected frame is an image of a global shutter, so that one pose is all that it has: that at the time of the row
to which it was corrected.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rsbench.components.cards import parse_card
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.lens import Lens
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.se3 import Pose, inverse, transform
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.dataset.corrected_frames import MARKER, read_corrected
from rsbench.dataset.trajectory import FORMAT
from rsbench.interop.writers.colmap_text import camera_line
from rsbench.interop.writers.image_poses import number, numbers, write_lines
from rsbench.storage.files import read_depth, write_bytes
from rsbench.storage.untrusted_files import check_amount, inside, read_bytes, read_json, read_text

FORMATS = ("tum", "colmap")
ABOUT = {
    "tum": (
        "NAME/body.txt has the pose of the middle of the rig at the start of each frame that was corrected, "
        "NAME/left.txt and right.txt those of the cameras, NAME/left_rows.txt that of the left camera at each of "
        "its rows, where they were asked for. Times are frame periods; the world is the body at the start of the "
        "first frame, camera axes are x right, y down, z forward."
    ),
    "colmap": (
        "NAME/sparse holds cameras.txt, images.txt and points3D.txt, NAME/images the corrected frames, NAME/masks "
        "0 where nothing is drawn. Poses are those of the trajectory at the time to which frames were corrected. "
        "Points are those of the depth of the left frames, each of one frame and without observations. The world "
        "is the body at the start of the first frame (x right, y down, z forward, metres)."
    ),
}
_POINTS, _MOST_POSES = 50_000, 10_000_000
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
    """To whose time the frames were corrected, counted in the order of the readout."""
    shutter: RollingShutter

    @property
    def name(self) -> str:
        return self.folder.resolve().name


def is_corrected(folder: Path) -> bool:
    """Whether ``rsbench correct`` made a folder."""
    return (folder / MARKER).is_file() and not (folder / "dataset.json").exists()


def read_corrected_folder(folder: Path) -> Corrected:
    """A folder with its trajectory.

    Raises:
        RsbenchError: it has none, or what it says of it is no rig or are no poses.
    """
    path, table = folder / MARKER, folder / "trajectory.csv"
    if not table.is_file():
        raise RsbenchError(
            f"{folder}: has no trajectory.csv, so there are no poses; rsbench correct writes one of four frames "
            "and more of a rig, without --motion-model NAME"
        )
    record = read_json(path)
    try:
        camera, lens = record["camera"], record["lens"]
        known = None if lens is None else parse_card(Lens, lens, str(path))
        rig = StereoRig(camera=PinholeCamera(**camera, lens=known), baseline=record["baseline"])
        scanning = parse_card(Scanning, record["scan"], str(path))
        shutter = scanning.shutter_of(rig.camera.width, rig.camera.height, record["readout_ratio"])
        row = float(record["target_row"])
    except (KeyError, TypeError, ValueError) as error:
        raise RsbenchError(
            f"{path}: does not say the rig of corrected frames: {error!r}; correct again"
        ) from error
    times, poses = read_poses(table)
    return Corrected(folder, rig, times, poses, row, shutter)


def read_poses(path: Path) -> tuple[FloatArray, Pose]:
    """Times (n,) and poses body_from_world of a file in TUM's format.

    Raises:
        RsbenchError: it holds something else.
    """
    lines = [line for line in read_text(path).splitlines() if line.strip() and not line.startswith("#")]
    check_amount(path, "poses", len(lines), _MOST_POSES)
    table = np.zeros((0, 8))
    with contextlib.suppress(ValueError):  # no numbers, or not as many in each line
        table = np.array([[float(word) for word in line.split()] for line in lines], dtype=np.float64)
    good = len(table) > 0 and table.shape[1:] == (8,) and bool(np.all(np.isfinite(table)))
    lengths = np.linalg.norm(table[..., 4:], axis=-1)
    if not (good and np.all(np.abs(lengths - 1.0) < _UNIT) and np.all(np.diff(table[:, 0]) > 0.0)):
        raise RsbenchError(f"{path}: must hold lines of {FORMAT}, times rising; correct again")
    R = so3.from_quaternion(table[:, [7, 4, 5, 6]] / lengths[:, None])
    return table[:, 0], inverse(Pose(R, table[:, 1:4]))


def export_corrected(corrected: Corrected, name: str, root: Path) -> dict[str, Any]:
    """The files of one folder below ``root``; what has to be said of them."""
    folder = root / corrected.name
    folder.mkdir(parents=True)
    if name == "tum":
        return _write_tum(corrected, folder)
    return _write_colmap(corrected, folder)


def check(corrected: Corrected, name: str) -> None:
    """Raises RsbenchError for a format that cannot hold it."""
    if name not in FORMATS:
        raise RsbenchError(
            f"--to {name}: {corrected.folder} holds corrected frames, which are exported to {' or '.join(FORMATS)}"
        )
    if name == "colmap" and not corrected.shutter.rows_together:
        raise RsbenchError(
            f"--to {name}: {corrected.folder}: its cameras do not read each row at one time, so that a "
            "corrected pair has two; take --to tum"
        )


def _camera(corrected: Corrected, side: Side, body: Pose) -> Pose:
    """cam_from_world of a camera of a rig whose body is there."""
    return Pose(body.R, body.t + corrected.rig.offset(side))


def _write_tum(corrected: Corrected, folder: Path) -> dict[str, Any]:
    _write_poses(folder / "body.txt", corrected.times, corrected.poses)
    for side in SIDES:
        _write_poses(folder / f"{side}.txt", corrected.times, _camera(corrected, side, corrected.poses))
    told = ["times are frame periods: rsbench correct does not know the frame rate"]
    rows = corrected.folder / "row_poses.csv"
    if rows.is_file():
        times, poses = read_poses(rows)
        _write_poses(folder / "left_rows.txt", times, _camera(corrected, "left", poses))
    else:
        told.append("there are no poses of rows; rsbench correct --row-poses writes them")
    return {"poses": len(corrected.times), "told": told}


def _write_poses(path: Path, times: FloatArray, cam_from_world: Pose) -> None:
    R, t = inverse(cam_from_world)
    table = np.concatenate([times[:, None], t, so3.quaternion(R)[:, [1, 2, 3, 0]]], axis=1)
    write_lines(path, [f"# {FORMAT}", *map(numbers, table)])


def _write_colmap(corrected: Corrected, folder: Path) -> dict[str, Any]:
    frames = _posed_frames(corrected)
    if not frames:
        raise RsbenchError(f"{corrected.folder}: no frame was corrected and has a pose")
    sparse = folder / "sparse"
    sparse.mkdir()
    lines, points = list[str](), list[str]()
    step = max(1, round(np.sqrt(corrected.rig.camera.width * corrected.rig.camera.height * len(frames) / _POINTS)))
    for k, (frame, body) in enumerate(frames):
        for number_, side in enumerate(SIDES, start=1):
            pose, stem = _camera(corrected, side, body), f"{side}_{frame:06d}"
            identifier = len(SIDES) * k + number_
            lines += [f"{identifier} {numbers(so3.quaternion(pose.R))} {numbers(pose.t)} {number_} {stem}.png", ""]
            _copy(corrected.folder, f"corrected/{stem}.png", folder / "images" / f"{stem}.png")
            _copy(corrected.folder, f"mask/{stem}.png", folder / "masks" / f"{stem}.png.png")
        points += _points(corrected, frame, _camera(corrected, "left", body), step, len(points))
    cameras = [camera_line(k, corrected.rig.camera) for k in range(1, len(SIDES) + 1)]
    for name, content in (("cameras", cameras), ("images", lines), ("points3D", points)):
        write_lines(sparse / f"{name}.txt", content)
    left_out = len(corrected.times) - len(frames)
    words = "frames of the trajectory were not corrected, or have no pose at their row, and are left out"
    told = [f"{left_out} {words}"] if left_out else []
    return {"frames": len(frames), "points": len(points), "told": told}


def _posed_frames(corrected: Corrected) -> list[tuple[int, Pose]]:
    """Frames that were corrected, each with the body's pose at the time to which it was."""
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
    """Times and poses of the row to which frames were corrected, of the file that has all."""
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


def _points(corrected: Corrected, frame: int, left: Pose, step: int, before: int) -> list[str]:
    """Lines of points3D.txt, of every ``step``-th pixel in both directions that has depth."""
    stem, cut = f"left_{frame:06d}", slice(step // 2, None, step)
    path = corrected.folder / "depth" / f"{stem}.exr"
    if not path.is_file():
        return []
    camera = corrected.rig.camera
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


def _copy(folder: Path, name: str, to: Path) -> None:
    to.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(to, read_bytes(inside(folder, name)))
