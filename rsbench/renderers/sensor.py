"""The rolling-shutter camera: every ray leaves from the pose of its image row, or column.

``rs_pinhole`` is an ordinary Mitsuba sensor, so any Mitsuba integrator can render through it; rsbench's own
renderers call its ``row_ray`` directly. Poses and intrinsics are data of the compiled kernel, never constants.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.se3 import Pose, inverse
from rsbench.renderers.lens_rays import lens_rays

PLUGIN = "rs_pinhole"
LEAST_COMPONENT = 1e-15
"""Smaller components of a ray's direction, which are rounding, are made 0. Embree takes one between -1e-18 and 0
for negative and its inverse for positive: rays of its packet then miss surfaces that they meet."""


def pose_table(
    camera: PinholeCamera, rotations: ArrayLike, translations: ArrayLike, columns: bool = False
) -> NDArray[np.float32]:
    """Row poses as the kernels read them, (..., height, 12): ``R^T`` row-major, then the camera centre ``-R^T t``.

    Args:
        camera: its height is the number of poses.
        rotations: (..., height, 3, 3) world-to-camera rotations, one per row; a leading axis holds the instants of
            an exposure.
        translations: (..., height, 3) metres, with ``X_cam = R @ X_world + t``.
        columns: whether columns are read: one pose for each of them instead.

    Raises:
        RsbenchError: wrong shapes, or values that are not finite.
    """
    R = np.asarray(rotations, dtype=np.float64)
    t = np.asarray(translations, dtype=np.float64)
    lines, name = (camera.width, "columns") if columns else (camera.height, "rows")
    if R.shape[-3:] != (lines, 3, 3) or t.shape != R.shape[:-1]:
        raise RsbenchError(
            f"row poses have shapes {R.shape} and {t.shape}: a camera of {lines} {name} needs "
            f"({lines}, 3, 3) and ({lines}, 3)"
        )
    if not (np.isfinite(R).all() and np.isfinite(t).all()):
        raise RsbenchError("row poses are not finite numbers")
    axes = np.swapaxes(R, -1, -2)
    centre = -np.einsum("...ij,...j->...i", axes, t)
    return np.concatenate([axes.reshape(*t.shape[:-1], 9), centre], axis=-1).astype(np.float32)


def make_sensor(
    camera: PinholeCamera,
    rotations: ArrayLike,
    translations: ArrayLike,
    objects: Pose | None = None,
    *,
    columns: bool = False,
) -> Any:
    """A Mitsuba sensor ``rs_pinhole`` with a box filter, of ``camera``'s size, at these row poses.

    Args and errors: see ``pose_table``. Poses that are equal in all rows make a global shutter. ``objects`` are
    those of objects that move, ``world_from_object``, with one more leading axis.
    """
    import mitsuba as mi

    sensor_class()
    film = {
        "type": "hdrfilm",
        "width": camera.width,
        "height": camera.height,
        "pixel_format": "rgb",
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }
    sensor = mi.load_dict({"type": PLUGIN, "film": film, "sampler": {"type": "independent"}})
    sensor.set_intrinsics(camera)
    sensor.set_poses(pose_table(camera, rotations, translations, columns), columns)
    sensor.set_objects(object_tables(camera, objects, columns))
    return sensor


def object_tables(camera: PinholeCamera, objects: Pose | None, columns: bool) -> list[NDArray[np.float32]]:
    """A table of each object as ``pose_table`` makes it: ``R`` row-major and ``t`` of ``world_from_object``."""
    if objects is None:
        return []
    tables = pose_table(camera, *inverse(objects), columns)
    if tables.ndim < 3:
        raise RsbenchError(f"poses of objects have shape {objects.R.shape}: the first axis holds the objects")
    return list(tables)


def _coordinates(sensor: Any, x: Any, y: Any, active: Any, pixel: Any) -> tuple[Any, Any]:
    """Coordinates x / z, y / z of the ray through pixel coordinates (x, y)."""
    if sensor.lens is not None:
        return sensor.lens.coordinates(x, y, sensor.lens.pixel(x, y, active) if pixel is None else pixel)
    if sensor.camera.lens is not None:  # one by one
        u, v, _ = sensor.camera.unproject([float(x), float(y)]).tolist()
        return u, v
    fx, fy, cx, cy = sensor.intrinsics
    return (x - cx) / fx, (y - cy) / fy


def _held(table: NDArray[np.float32]) -> Any:
    """A table as ``entries`` reads it."""
    import drjit as dr
    import mitsuba as mi

    return mi.Float(table.ravel()) if dr.is_jit_v(mi.Float) else table.ravel().tolist()


def entries(poses: Any, row: Any, active: Any) -> list[Any]:
    """The 12 values of the pose of each lane's row."""
    import drjit as dr
    import mitsuba as mi

    if not dr.is_jit_v(mi.Float):
        return list(poses[12 * int(row) : 12 * int(row) + 12])
    return [dr.gather(mi.Float, poses, row * 12 + k, active) for k in range(12)]


@cache
def sensor_class() -> Any:
    """The class behind the plugin ``rs_pinhole``, registered with the Mitsuba variant that is set."""
    import drjit as dr
    import mitsuba as mi

    scalar = not dr.is_jit_v(mi.Float)

    class RSPinhole(mi.Sensor):
        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self.intrinsics = [mi.Float(1.0), mi.Float(1.0), mi.Float(0.0), mi.Float(0.0)]
            self.lens: Any = None
            self.poses: Any = None
            self.objects: list[Any] = []
            """Poses of each object that moves, as many as those of the camera."""
            self.columns = False
            """Whether poses are those of columns."""
            self.lines = 0
            """Poses of an instant."""
            self.instants = 1
            """Of an exposure: so many poses has each row."""

        def set_intrinsics(self, camera: PinholeCamera) -> None:
            values = (camera.fx, camera.fy, camera.cx, camera.cy)
            self.intrinsics = [dr.opaque(mi.Float, value) for value in values]
            self.camera = camera
            if camera.lens is not None and not scalar:
                self.lens = lens_rays(camera, camera.lens)

        def set_poses(self, table: NDArray[np.float32], columns: bool = False) -> None:
            """Table (lines, 12) or (instants, lines, 12) of ``pose_table``."""
            self.columns, self.lines = columns, table.shape[-2]
            self.instants = table.shape[0] if table.ndim == 3 else 1
            self.poses = _held(table)

        def set_objects(self, tables: Sequence[NDArray[np.float32]]) -> None:
            """See ``object_tables``."""
            self.objects = list(map(_held, tables))

        def row_ray(self, x: Any, y: Any, row: Any, active: Any = True, pixel: Any = None) -> tuple[Any, Any]:
            """World origin and direction of the ray through pixel coordinates (x, y), at the pose of ``row``.

            With instants, pose ``row + lines * instant``; with columns, rows are columns. ``pixel`` is that of
            ``lens``, found once for many samples. The direction has camera z = 1, so the distance to a hit in
            units of it is the depth z.
            """
            u, v = _coordinates(self, x, y, active, pixel)
            p = entries(self.poses, row, active)
            direction = [dr.fma(p[3 * i], u, dr.fma(p[3 * i + 1], v, p[3 * i + 2])) for i in range(3)]
            level = [dr.select(dr.abs(value) < LEAST_COMPONENT, 0.0, value) for value in direction]
            return mi.Point3f(p[9], p[10], p[11]), mi.Vector3f(*level)

        def object_pose(self, number: int, row: Any, active: Any) -> list[Any]:
            """The 12 values of the pose of an object, counted from 0."""
            return entries(self.objects[number], row, active)

        def sample_ray(self, time: Any, wavelength: Any, position: Any, aperture: Any, active: Any = True) -> Any:
            """Mitsuba's interface: film position in [0, 1]^2, whose pixel coordinate is half a pixel less."""
            film = self.film()
            size, crop, offset = film.size(), film.crop_size(), film.crop_offset()
            x = position.x * crop[0] + offset[0]
            y = position.y * crop[1] + offset[1]
            along, last = (x, size[0] - 1) if self.columns else (y, size[1] - 1)
            row = mi.UInt32(dr.clip(dr.floor(along), 0, last))
            origin, direction = self.row_ray(x - 0.5, y - 0.5, row, active)
            wavelengths, weight = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), wavelength, active)
            return mi.Ray3f(origin, dr.normalize(direction), time, wavelengths), weight

        def sample_ray_differential(
            self, time: Any, wavelength: Any, position: Any, aperture: Any, active: Any = True
        ) -> Any:
            ray, weight = self.sample_ray(time, wavelength, position, aperture, active)
            return mi.RayDifferential3f(ray), weight

        def bbox(self) -> Any:
            return mi.ScalarBoundingBox3f()

        def to_string(self) -> str:
            return f"RSPinhole[{self.film().size()}]"

    mi.register_sensor(PLUGIN, RSPinhole)
    return RSPinhole
