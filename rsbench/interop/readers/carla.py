"""Carla-RS (Liu et al., Deep Shutter Unrolling Network, CVPR 2020): velocities and radial depth of one camera.

A sequence is a folder with ``gt_vel.log`` (wx, wy, wz in rad/s and x, y, z per second), ``%04d_rs.png``, and where
depth was rendered ``%04d_rs.depth`` or ``.pdepth``; ``%04d_gs_f.png`` and ``%04d_gs_m.png`` are what a global
shutter takes at the first row and at row ``height // 2``, ``%04d_mask.png`` the pixels that the authors score. Its
generator (UnrealCV of the same authors, Python/capture_rolling_shutter.py) says what the files do not:

- exp([w t]x), v t is the pose of the camera at time t **in the camera at time 0**: ``cam_from_world`` is its
  inverse, rotation and translation grow apart (no screw), and the translation is turned by the rotation;
- row r of frame k is read at k / FPS + r times the row's readout, which is 1 / FPS / rows: a readout ratio of 1;
- the field of view is 90 degrees: fx is half the width, and the principal point the middle of the image, which is
  (width - 1) / 2 here and width / 2 in their own code;
- ``.depth`` is the distance along the ray, ``.pdepth`` is z, made of it with their principal point.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import View
from rsbench.core.se3 import Pose, inverse
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.dataset.recording import Recording
from rsbench.interop.readers.text import lines, numbers
from rsbench.pipeline.footage import read_frame

_FPS = 20.0
"""Of the published data, where no rs_calib.txt says otherwise."""


def read_carla(folder: Path) -> list[Recording]:
    """Every sequence below a folder, or the folder itself.

    Raises:
        RsbenchError: no gt_vel.log, or a file that is not what it should be.
    """
    found = sorted(path.parent for path in [folder, *folder.glob("**")] for path in path.glob("gt_vel.log"))
    if not found:
        raise RsbenchError(f"{folder}: holds no gt_vel.log, as sequences of Carla-RS do")
    return [_read(each) for each in dict.fromkeys(found)]


def _read(folder: Path) -> Recording:
    images: dict[View, Path] = {("left", frame): path for frame, path in _pictures(folder, "rs").items()}
    if not images:
        raise RsbenchError(f"{folder}: holds no 0000_rs.png")
    height, width = read_frame(next(iter(images.values()))).shape[:2]
    camera = PinholeCamera.centred(width, height, width / 2)
    fps, row_s, known = _timing(folder, height)
    ratio = row_s * height * fps
    if not 0.0 <= ratio <= 1.0 + 1e-6:
        raise RsbenchError(f"{folder}: rows of {1e3 * row_s} ms at {fps} Hz make a readout ratio of {ratio:.3f}")
    velocity = [numbers(line, where, 6) for where, line in lines(folder / "gt_vel.log")]
    if len(velocity) != 1:
        raise RsbenchError(f"{folder / 'gt_vel.log'}: has {len(velocity)} velocities, not one")
    w, v = velocity[0][:3] / fps, velocity[0][3:] / fps
    depths = {view: reader for view in images if (reader := _depth(folder, view[1], camera)) is not None}
    assumed = f"no rs_calib.txt: {_FPS:g} Hz and a readout ratio of 1 are those of the published data"
    return Recording(
        name=folder.name,
        cameras={"left": camera},
        images=images,
        shutters={"left": RollingShutter(height=height, readout_ratio=min(ratio, 1.0))},
        frame_period_s=1.0 / fps,
        poses={"left": partial(_pose, w, v)},
        depths=depths,
        truths={
            ("left", frame, row): path
            for kind, row in (("gs_f", 0), ("gs_m", height // 2))
            for frame, path in _pictures(folder, kind).items()
        },
        masks={("left", frame): path for frame, path in _pictures(folder, "mask").items()},
        notes=() if known else (assumed,),
    )


def _pictures(folder: Path, kind: str) -> dict[int, Path]:
    """Files of images of one kind, by frame."""
    found = sorted(folder.glob(f"[0-9][0-9][0-9][0-9]_{kind}.*"))
    return {int(path.name[:4]): path for path in found if path.suffix in (".png", ".jpg")}


def _pose(w: FloatArray, v: FloatArray, tau: FloatArray) -> Pose:
    """``cam_from_world`` at times (...), velocities per frame period."""
    tau = np.asarray(tau, dtype=np.float64)[..., None]
    return inverse(Pose(so3.exp(tau * w), tau * v))


def _timing(folder: Path, height: int) -> tuple[float, float, bool]:
    """Frames a second, seconds a row, and whether a file says so: rs_calib.txt here or one folder up."""
    for path in (folder / "rs_calib.txt", folder.parent / "rs_calib.txt"):
        if path.is_file():
            said = dict(line.split(":", 1) for _, line in lines(path) if ":" in line)
            keys = ("FPS", "ROW_READOUT_TIME(ms)")
            if not all(key in said for key in keys):
                raise RsbenchError(f"{path}: must say {' and '.join(keys)}")
            fps, row_ms = (float(numbers(said[key], path, 1)[0]) for key in keys)
            if not fps > 0.0:
                raise RsbenchError(f"{path}: FPS = {fps}: must be positive")
            return fps, 1e-3 * row_ms, True
    return _FPS, 1.0 / _FPS / height, False


def _depth(folder: Path, frame: int, camera: PinholeCamera) -> Callable[[], FloatArray] | None:
    for suffix, radial in ((".depth", True), (".pdepth", False)):
        path = folder / f"{frame:04d}_rs{suffix}"
        if path.is_file():
            return partial(_read_depth, path, camera, radial)
    return None


def _read_depth(path: Path, camera: PinholeCamera, radial: bool) -> FloatArray:
    rows = [numbers(line, where, camera.width) for where, line in lines(path)]
    if len(rows) != camera.height:
        raise RsbenchError(f"{path}: has {len(rows)} rows, not {camera.height}")
    distance = np.array(rows)
    if not radial:
        return distance
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return distance / np.linalg.norm(camera.unproject(np.stack([x, y], axis=-1)), axis=-1)
