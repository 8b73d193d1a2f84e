"""One sequence on disk: what it is (sequence.json) and its images, depth maps and row poses, read on demand."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rsbench.core.camera import PinholeCamera
from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.dataset.files import read_depth, read_json, read_png, read_poses
from rsbench.errors import RsbenchError
from rsbench.motions import motion_record, read_motion

FORMAT = 1
FRAMES = (0, 1)
Shutter = Literal["rs", "gs"]
SHUTTERS: tuple[Shutter, Shutter] = ("rs", "gs")

RELATIVE_FILES = tuple(
    f"{folder}/{side}_{frame}.{suffix}"
    for folder, suffix in (
        ("rs", "png"),
        ("rs_depth", "exr"),
        ("gs", "png"),
        ("gs_depth", "exr"),
        ("poses", "csv"),
    )
    for side in SIDES
    for frame in FRAMES
)


@dataclass(frozen=True, kw_only=True)
class Sequence:
    """A sequence folder of format 1; frames 0 and 1, sides left and right."""

    folder: Path
    name: str
    rig: StereoRig
    shutter: RollingShutter
    motion: Motion
    frame_period_s: float
    manifest: dict[str, Any]
    """Content of sequence.json."""

    def image(self, shutter: Shutter, side: Side, frame: int) -> NDArray[np.uint8]:
        """(H, W, 3) sRGB; ``gs`` is the global-shutter image at the pose of the frame's row 0."""
        path = self.folder / shutter / f"{side}_{frame}.png"
        pixels = read_png(path)
        self._check_size(path, pixels.shape[:2])
        return pixels

    def images(self, shutter: Shutter = "rs") -> list[NDArray[np.uint8]]:
        """Left 0, right 0, left 1, right 1: the order of ``rsbench.match`` and ``rsbench.correct``."""
        return [self.image(shutter, side, frame) for frame in FRAMES for side in SIDES]

    def depth(self, shutter: Shutter, side: Side, frame: int) -> NDArray[np.float32]:
        """(H, W) z in the camera of the row that saw the pixel, metres, 0 = no surface."""
        path = self.folder / f"{shutter}_depth" / f"{side}_{frame}.exr"
        depth = read_depth(path)
        self._check_size(path, depth.shape)
        return depth

    def poses(self, side: Side, frame: int) -> tuple[FloatArray, Pose]:
        """Row times (H,) and ``cam_from_world`` (H, 3, 3), (H, 3) as stored."""
        path = self.folder / "poses" / f"{side}_{frame}.csv"
        tau, poses = read_poses(path)
        if len(tau) != self.shutter.height:
            raise RsbenchError(f"{path}: has {len(tau)} rows, the camera has {self.shutter.height}")
        return tau, poses

    def _check_size(self, path: Path, shape: tuple[int, ...]) -> None:
        camera = self.rig.camera
        if shape != (camera.height, camera.width):
            raise RsbenchError(
                f"{path}: is {shape[1]} x {shape[0]} pixels, the camera {camera.width} x {camera.height}"
            )


def sequence_manifest(
    *, name: str, rig: StereoRig, shutter: RollingShutter, motion: Motion, frame_period_s: float
) -> dict[str, Any]:
    """The geometric part of sequence.json, with units in the names where they are not metres and radians."""
    camera = rig.camera
    fields = ("width", "height", "fx", "fy", "cx", "cy")
    readout_s = shutter.readout_ratio * frame_period_s
    return {
        "format": FORMAT,
        "conventions": 1,
        "name": name,
        "camera": {field: getattr(camera, field) for field in fields},
        "baseline": rig.baseline,
        "readout_ratio": shutter.readout_ratio,
        "frame_period_s": frame_period_s,
        "readout_time_s": readout_s,
        "row_time_s": readout_s / shutter.height,
        "motion": motion_record(motion),
    }


def read_sequence(folder: Path) -> Sequence:
    """Open a sequence folder.

    Raises:
        RsbenchError: no sequence.json, a format of another version, or a field that is missing or wrong.
    """
    path = folder / "sequence.json"
    manifest = read_json(path)
    if manifest.get("format") != FORMAT:
        raise RsbenchError(f"{path}: format = {manifest.get('format')!r}; this version reads {FORMAT}")
    try:
        camera = PinholeCamera(**manifest["camera"])
        return Sequence(
            folder=folder,
            name=str(manifest["name"]),
            rig=StereoRig(camera=camera, baseline=manifest["baseline"]),
            shutter=RollingShutter(height=camera.height, readout_ratio=manifest["readout_ratio"]),
            motion=read_motion(manifest["motion"]),
            frame_period_s=float(manifest["frame_period_s"]),
            manifest=manifest,
        )
    except (KeyError, TypeError, ValueError, RsbenchError) as error:
        what = f"{error} is missing or unknown" if isinstance(error, KeyError) else str(error)
        raise RsbenchError(f"{path}: {what}") from error


def read_dataset(folder: Path) -> list[Sequence]:
    """All sequences that dataset.json names, in its order.

    Raises:
        RsbenchError: not a finished dataset, or a sequence that cannot be read.
    """
    path = folder / "dataset.json"
    if not path.is_file():
        raise RsbenchError(
            f"{folder}: not a dataset (no dataset.json); make one with: rsbench generate CARD --out DIR"
        )
    manifest = read_json(path)
    if manifest.get("format") != FORMAT:
        raise RsbenchError(f"{path}: format = {manifest.get('format')!r}; this version reads {FORMAT}")
    names = manifest.get("sequences")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise RsbenchError(f"{path}: 'sequences' must be a list of names")
    return [read_sequence(folder / name) for name in names]
