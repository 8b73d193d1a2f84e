"""The ASL layout of EuRoC, TUM VI and TUM RS-VI: cameras with lenses, an inertial frame, poses at their own times.

``mav0/cam0/sensor.yaml`` holds ``T_BS``, which takes the sensor's coordinates to the body's, ``data.csv`` times in
nanoseconds and file names; poses are those of the body, p and q = (w, x, y, z), in ``mocap0`` or
``state_groundtruth_estimate0``. Times are whole numbers: as floats they would lose 256 ns. The layout says nothing
of a rolling shutter: TUM RS-VI's line delay (29.4737 us of camera 1; camera 0 is global) is given beside it, and
its times are taken for those of the first row.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.lens import Lens
from rsbench.core.rig import SIDES, Side, View
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.dataset.recording import PoseAt, Recording
from rsbench.interop.readers.text import lines, numbers, rotation
from rsbench.storage.untrusted_files import inside, read_text

_LENSES = {
    "radial-tangential": ("brown-conrady", ("k1", "k2", "p1", "p2")),
    "radtan": ("brown-conrady", ("k1", "k2", "p1", "p2")),
    "equidistant": ("kannala-brandt", ("k1", "k2", "k3", "k4")),
}
_POSES = ("state_groundtruth_estimate0", "mocap0", "gt0")
_KEY = re.compile(r"^[ \t]*(\w+):[ \t]*(\[[^\]]*\]|[^\n#]*)", re.MULTILINE)


def read_euroc(folder: Path, line_delays_s: Mapping[Side, float] | None = None) -> list[Recording]:
    """The sequence of a folder that is, or holds, ``mav0`` (or the cameras themselves).

    Args:
        line_delays_s: seconds between rows of the cameras that are known to roll, or 0 of a global one.

    Raises:
        RsbenchError: files that are missing, or not what they should be.
    """
    root = folder / "mav0" if (folder / "mav0").is_dir() else folder
    sensors = {side: root / f"cam{k}" for k, side in enumerate(SIDES) if (root / f"cam{k}").is_dir()}
    if "left" not in sensors:
        raise RsbenchError(f"{root}: holds no folder cam0")
    yamls = {side: _yaml(path / "sensor.yaml") for side, path in sensors.items()}
    cameras = {side: _camera(yamls[side], sensors[side] / "sensor.yaml") for side in sensors}
    body_from = {side: _extrinsics(yamls[side], sensors[side] / "sensor.yaml") for side in sensors}
    times = {side: _times(path) for side, path in sensors.items()}
    stamps = [stamp for stamp in times["left"] if all(stamp in times[side] for side in sensors)]
    if len(stamps) < 2:
        raise RsbenchError(f"{root}: the cameras have {len(stamps)} times in common; two are needed")
    period = float(np.median(np.diff(stamps))) * 1e-9
    images: dict[View, Path] = {(s, k): times[s][stamp] for s in sensors for k, stamp in enumerate(stamps)}
    apart = None if "right" not in sensors else compose(inverse(body_from["right"]), body_from["left"])
    world = _trajectory(root, stamps[0], period)
    shutters = {
        side: _shutter(cameras[side].height, delay, period, root) for side, delay in (line_delays_s or {}).items()
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


def _yaml(path: Path) -> dict[str, str]:
    return {key: value.strip() for key, value in _KEY.findall(read_text(path))}


def _list(said: Mapping[str, str], key: str, path: Path, count: int) -> FloatArray:
    if key not in said:
        raise RsbenchError(f"{path}: {key!r} is required")
    return numbers(said[key].strip("[]").replace("\n", " "), f"{path}: {key}", count)


def _camera(said: Mapping[str, str], path: Path) -> PinholeCamera:
    width, height = _list(said, "resolution", path, 2)
    fx, fy, cx, cy = _list(said, "intrinsics", path, 4)
    model = said.get("distortion_model", "none").strip('"')
    lens = None
    if model in _LENSES:
        name, keys = _LENSES[model]
        values = _list(said, "distortion_coefficients", path, len(keys))
        lens = Lens(model=name, **dict(zip(keys, values.tolist(), strict=True)))  # pyrefly: ignore[bad-argument-type]
    elif model != "none":
        raise RsbenchError(f"{path}: distortion_model = {model!r}: must be one of {', '.join(_LENSES)}")
    try:
        return PinholeCamera(width=int(width), height=int(height), fx=fx, fy=fy, cx=cx, cy=cy, lens=lens)
    except ValueError as error:
        raise RsbenchError(f"{path}: {error}") from error


def _extrinsics(said: Mapping[str, str], path: Path) -> Pose:
    """``body_from_camera``."""
    T = _list(said, "data", path, 16).reshape(4, 4)
    if not np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-3):
        raise RsbenchError(f"{path}: T_BS: its rotation is none")
    return Pose(T[:3, :3], T[:3, 3])


def _times(folder: Path) -> dict[int, Path]:
    """Files by nanosecond."""
    out = {}
    for where, line in lines(folder / "data.csv"):
        stamp, _, name = line.partition(",")
        if not stamp.strip().isdigit():
            raise RsbenchError(f"{where}: {stamp!r}: must be nanoseconds, a whole number")
        out[int(stamp)] = inside(folder / "data", name.strip())
    return dict(sorted(out.items()))


def _trajectory(root: Path, start_ns: int, period_s: float) -> PoseAt | None:
    """``world_from_body`` by time in frame periods; None where there is none."""
    path = next((root / name / "data.csv" for name in _POSES if (root / name / "data.csv").is_file()), None)
    if path is None:
        return None
    stamps, rows = list[float](), list[tuple[FloatArray, FloatArray]]()
    for where, line in lines(path):
        stamp, _, rest = line.partition(",")
        if not stamp.strip().isdigit():
            raise RsbenchError(f"{where}: {stamp!r}: must be nanoseconds, a whole number")
        values = numbers(rest, where)
        if len(values) < 7:
            raise RsbenchError(f"{where}: must be a time, a position and a quaternion")
        stamps.append((int(stamp) - start_ns) * 1e-9 / period_s)
        rows.append((rotation(values[3:7], where), values[:3]))
    tau = np.array(stamps)
    if len(tau) < 2 or not np.all(np.diff(tau) > 0.0):
        raise RsbenchError(f"{path}: must hold at least two times that grow")
    turns = Slerp(tau, Rotation.from_matrix(np.array([R for R, _ in rows])))
    return partial(_between, tau, turns, np.array([p for _, p in rows]))


def _between(known: FloatArray, turns: Slerp, places: FloatArray, tau: FloatArray) -> Pose:
    """Between two known poses, the way along a straight line and the turn at constant speed; NaN beyond them."""
    tau = np.asarray(tau, dtype=np.float64)
    held = np.clip(tau, known[0], known[-1])
    R = turns(held.ravel()).as_matrix().reshape(*tau.shape, 3, 3)
    p = np.stack([np.interp(held, known, places[:, axis]) for axis in range(3)], axis=-1)
    beyond = held != tau
    return Pose(np.where(beyond[..., None, None], np.nan, R), np.where(beyond[..., None], np.nan, p))


def _camera_pose(world_from_body: PoseAt, body_from_camera: Pose, tau: FloatArray) -> Pose:
    return inverse(compose(world_from_body(tau), body_from_camera))


def _shutter(height: int, line_delay_s: float, period_s: float, root: Path) -> RollingShutter:
    ratio = line_delay_s * height / period_s
    if not 0.0 <= ratio <= 1.0:
        raise RsbenchError(
            f"{root}: a line delay of {1e6 * line_delay_s:g} us makes a readout ratio of {ratio:.3f}"
        )
    return RollingShutter(height=height, readout_ratio=ratio)
