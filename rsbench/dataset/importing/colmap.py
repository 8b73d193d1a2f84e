"""COLMAP's text model: cameras.txt and images.txt.

Its pixels are counted from the corner of the image, where ours are from the centre of the first pixel: half a
pixel less. A quaternion is (w, x, y, z), and a pose ``cam_from_world``, as ours. Nothing is said of times: images
come in the order of their names, one pose each, and there is no shutter.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np

from rsbench.core.camera import PinholeCamera
from rsbench.core.lens import Lens
from rsbench.core.rig import View
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray
from rsbench.dataset.importing.recording import Recording
from rsbench.dataset.importing.text import lines, numbers, only_file, rotation
from rsbench.errors import RsbenchError
from rsbench.reading import inside, read_text

_MODELS: Mapping[str, tuple[str, str | None]] = {
    "SIMPLE_PINHOLE": ("f cx cy", None),
    "PINHOLE": ("fx fy cx cy", None),
    "SIMPLE_RADIAL": ("f cx cy k1", "brown-conrady"),
    "RADIAL": ("f cx cy k1 k2", "brown-conrady"),
    "OPENCV": ("fx fy cx cy k1 k2 p1 p2", "brown-conrady"),
    "SIMPLE_RADIAL_FISHEYE": ("f cx cy k1", "kannala-brandt"),
    "RADIAL_FISHEYE": ("f cx cy k1 k2", "kannala-brandt"),
    "OPENCV_FISHEYE": ("fx fy cx cy k1 k2 k3 k4", "kannala-brandt"),
}
"""Parameters in their order, and the lens that has them."""
_CORNER = 0.5


def read_colmap(folder: Path, images: Path | None = None) -> list[Recording]:
    """One recording of each camera, its images in the order of their names.

    Args:
        folder: holds cameras.txt and images.txt.
        images: folder to which names of images are relative; None: ``images`` in the folder, or one or two above.

    Raises:
        RsbenchError: a file is missing or wrong, or a camera model has no counterpart.
    """
    cameras = dict(_camera(where, line) for where, line in lines(only_file(folder, "cameras.txt")))
    root = images or next(
        (each / "images" for each in (folder, *folder.parents[:2]) if (each / "images").is_dir()), folder
    )
    shots: dict[str, list[tuple[str, Pose]]] = {}
    path = only_file(folder, "images.txt")
    rows = [line for line in read_text(path).splitlines() if not line.lstrip().startswith("#")]
    while rows and not rows[-1].strip():
        rows.pop()
    for number, line in enumerate(rows[::2]):  # every second one lists points, and may be empty
        name, camera, pose = _image(f"{path}, image {number + 1}", line)
        if camera not in cameras:
            raise RsbenchError(f"{path}: {name} is of camera {camera}, which cameras.txt lacks")
        shots.setdefault(camera, []).append((name, pose))
    return [_recording(camera, cameras[camera], sorted(each, key=_name), root) for camera, each in shots.items()]


def _name(shot: tuple[str, Pose]) -> str:
    return shot[0]


def _camera(where: str, line: str) -> tuple[str, PinholeCamera]:
    words = line.split()
    if len(words) < 5 or words[1] not in _MODELS:
        known = ", ".join(_MODELS)
        raise RsbenchError(f"{where}: camera model {words[1] if len(words) > 1 else ''!r}: must be one of {known}")
    keys, model = _MODELS[words[1]]
    values = dict(zip(keys.split(), numbers(" ".join(words[4:]), where, len(keys.split())).tolist(), strict=True))
    size = numbers(" ".join(words[2:4]), where, 2)
    fx, fy = values.pop("fx", values.get("f", 0.0)), values.pop("fy", values.pop("f", 0.0))
    cx, cy = values.pop("cx") - _CORNER, values.pop("cy") - _CORNER
    try:
        lens = None if model is None else Lens(model=model, **values)  # pyrefly: ignore[bad-argument-type]
        camera = PinholeCamera(width=int(size[0]), height=int(size[1]), fx=fx, fy=fy, cx=cx, cy=cy, lens=lens)
    except ValueError as error:
        raise RsbenchError(f"{where}: {error}") from error
    return words[0], camera


def _image(where: str, line: str) -> tuple[str, str, Pose]:
    words = line.split(maxsplit=9)
    if len(words) != 10:
        raise RsbenchError(f"{where}: must be a number, a quaternion, a translation, a camera and a name")
    values = numbers(" ".join(words[1:8]), where, 7)
    return words[9].strip(), words[8], Pose(rotation(values[:4], where), values[4:])


def _recording(number: str, camera: PinholeCamera, shots: list[tuple[str, Pose]], root: Path) -> Recording:
    files: dict[View, Path] = {("left", k): inside(root, name) for k, (name, _) in enumerate(shots)}
    R, t = np.array([pose.R for _, pose in shots]), np.array([pose.t for _, pose in shots])
    return Recording(
        name=f"camera {number}",
        cameras={"left": camera},
        images=files,
        poses={"left": partial(_at, R, t)},
        notes=("the layout does not say when images were taken, or how rows were read",),
    )


def _at(R: FloatArray, t: FloatArray, tau: FloatArray) -> Pose:
    """The pose of an image at its whole number; NaN between, where nothing is known."""
    tau = np.asarray(tau, dtype=np.float64)
    index = np.clip(np.rint(tau), 0, len(R) - 1).astype(np.int64)
    known = index == tau
    return Pose(np.where(known[..., None, None], R[index], np.nan), np.where(known[..., None], t[index], np.nan))
