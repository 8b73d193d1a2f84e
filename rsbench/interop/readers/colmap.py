"""COLMAP's text model: cameras.txt, images.txt and, where it is there, points3D.txt.

Its pixels are counted from the corner of the image, where ours are from the centre of the first pixel: half a
pixel less. A quaternion is (w, x, y, z), and a pose ``cam_from_world``, as ours. Nothing is said of times: images
come in the order of their names, one pose each, and there is no shutter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.lens import Lens
from rsbench.core.rig import View
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray
from rsbench.dataset.recording import Recording
from rsbench.interop.readers.text import lines, numbers, only_file, rotation
from rsbench.storage.untrusted_files import inside, read_text

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


class Shot(NamedTuple):
    """An image: its name, its pose, and what gives pixels and points that are seen there."""

    name: str
    pose: Pose
    seen: Callable[[], tuple[FloatArray, FloatArray]] | None


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
    shots: dict[str, list[Shot]] = {}
    points = folder / "points3D.txt"
    path = only_file(folder, "images.txt")
    rows = [line for line in read_text(path).splitlines() if not line.lstrip().startswith("#")]
    while rows and not rows[-1].strip():
        rows.pop()
    for number, line in enumerate(rows[::2]):  # every second one lists points, and may be empty
        where = f"{path}, image {number + 1}"
        name, camera, pose = _image(where, line)
        if camera not in cameras:
            raise RsbenchError(f"{path}: {name} is of camera {camera}, which cameras.txt lacks")
        seen = partial(_seen, points, "".join(rows[2 * number + 1 : 2 * number + 2]), where)
        shots.setdefault(camera, []).append(Shot(name, pose, seen if points.is_file() else None))
    return [
        _recording(camera, cameras[camera], sorted(each, key=attrgetter("name")), root)
        for camera, each in shots.items()
    ]


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


def _seen(points: Path, line: str, where: str) -> tuple[FloatArray, FloatArray]:
    """Pixels and points of a line of x, y and a point's number, -1 for none."""
    known, values = _points(points), numbers(line, where)
    if len(values) % 3:
        raise RsbenchError(f"{where}: its points must be x, y and a number each")
    rows = [row for row in values.reshape(-1, 3) if int(row[2]) in known]
    found = np.array([known[int(row[2])] for row in rows]).reshape(-1, 3)
    return np.array(rows).reshape(-1, 3)[:, :2] - _CORNER, found


@lru_cache(maxsize=2)
def _points(path: Path) -> dict[int, FloatArray]:
    """Places by number."""
    found = {}
    for where, line in lines(path):
        number, *place = numbers(" ".join(line.split()[:4]), where, 4)
        found[int(number)] = np.array(place)
    return found


def _recording(number: str, camera: PinholeCamera, shots: list[Shot], root: Path) -> Recording:
    files: dict[View, Path] = {("left", k): inside(root, shot.name) for k, shot in enumerate(shots)}
    R, t = np.array([shot.pose.R for shot in shots]), np.array([shot.pose.t for shot in shots])
    return Recording(
        name=f"camera {number}",
        cameras={"left": camera},
        images=files,
        poses={"left": partial(_at, R, t)},
        sightings={("left", k): shot.seen for k, shot in enumerate(shots) if shot.seen is not None},
        notes=("the layout does not say when images were taken, or how rows were read",),
    )


def _at(R: FloatArray, t: FloatArray, tau: FloatArray) -> Pose:
    """The pose of an image at its whole number; NaN between, where nothing is known."""
    tau = np.asarray(tau, dtype=np.float64)
    index = np.clip(np.rint(tau), 0, len(R) - 1).astype(np.int64)
    known = index == tau
    return Pose(np.where(known[..., None, None], R[index], np.nan), np.where(known[..., None], t[index], np.nan))
