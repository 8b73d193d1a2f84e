"""The rolling-shutter camera: every ray starts from the camera pose of its image row, or column.

``rs_pinhole`` is an ordinary Mitsuba sensor, so any Mitsuba integrator can render through it; rsbench's own
renderers take the rays from ``LineRays`` directly. Poses and intrinsics are inputs of the compiled kernel, never
constants.

The kernel undistorts every sample of a pixel separately, in double precision. The host undistorts the pixel
centres and computes the inverse Jacobian there once. Starting from these, the chord method (Newton's with a
constant Jacobian) solves each sample, at most half a pixel away; no ray is interpolated. The host determines the
number of steps for the lens. The NumPy equivalent is ``rsbench.core.camera.Lens.undistort``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rsbench.core.camera import Lens, PinholeCamera, inverse_2x2
from rsbench.core.errors import RsbenchError
from rsbench.core.se3 import Pose, inverse
from rsbench.renderers.mitsuba_modules import dr, mi

_EXACT_PX = 1e-8
"""Largest error of an undistorted ray, px, in double precision; rounding to single precision adds an error a
thousand times larger."""
_MOST_STEPS = 12
_TRIED = 65
"""Number of pixels along each side of the image that the host tests, including the outermost."""
_ALIGNED = 64
"""Bytes of a line of the processor's cache, and of its longest registers."""


@dataclass(frozen=True, kw_only=True)
class LensRays:
    """Undistorts pixels of one camera in a kernel: parameters are its inputs, the lens model is compiled in."""

    model: str
    steps: int
    """Number of steps of the chord method."""
    width: Any
    centre: list[Any]
    per_pixel: list[Any]
    """1 / fx and 1 / fy."""
    k: dict[str, Any]
    """Coefficients of the lens by their names."""
    most: list[Any]
    """Largest column and row."""
    start: list[Any]
    """What is known of the undistorted pixel centres, one value per pixel."""

    @classmethod
    def of(cls, camera: PinholeCamera, lens: Lens) -> LensRays:
        """Undistort all pixel centres and determine the number of steps."""
        centres = camera.unproject(camera.pixel_grid())[..., :2].reshape(-1, 2)
        if lens.model == "kannala-brandt":
            # The tangent is stored too, because a GPU computes it in single precision only.
            tangent = np.hypot(centres[:, :1], centres[:, 1:])
            centres = np.concatenate([np.arctan(tangent), tangent], axis=1)
        return cls(
            model=lens.model,
            steps=chord_steps(camera, lens),
            width=dr.opaque(mi.UInt32, camera.width),
            centre=[dr.opaque(mi.Float64, value) for value in (camera.cx, camera.cy)],
            per_pixel=[dr.opaque(mi.Float64, 1.0 / value) for value in (camera.fx, camera.fy)],
            k={each.name: dr.opaque(mi.Float64, getattr(lens, each.name)) for each in fields(lens)[1:]},
            most=[dr.opaque(mi.Float, size - 1.0) for size in (camera.width, camera.height)],
            start=[mi.Float64(np.ascontiguousarray(column)) for column in centres.T],
        )

    def pixel(self, x: Any, y: Any, active: Any) -> tuple[Any, ...]:
        """Return the values that ``coordinates`` needs for all samples of the pixel around (x, y)."""
        if self.model == "double-sphere":
            return ()
        column, row = (
            mi.UInt32(dr.clip(dr.floor(v + 0.5), 0.0, most)) for v, most in zip((x, y), self.most, strict=True)
        )
        start = [dr.gather(mi.Float64, table, row * self.width + column, active) for table in self.start]
        xd, yd = self._distorted(column, row)
        if self.model == "kannala-brandt":
            return start[0], 1.0 / self._slope(start[0]), dr.sqrt(xd * xd + yd * yd), start[1]
        by_x, across, by_y = self._derivative(*start)
        determinant = by_x * by_y - across * across
        return *start, xd, yd, by_y / determinant, -across / determinant, by_x / determinant

    def coordinates(self, x: Any, y: Any, pixel: tuple[Any, ...]) -> tuple[Any, Any]:
        """Return the undistorted coordinates x / z, y / z of pixel coordinates (x, y), in single precision."""
        solve = {"kannala-brandt": self._kannala, "double-sphere": self._spheres}.get(self.model, self._brown)
        found = solve(*self._distorted(x, y), *pixel)
        return mi.Float(found[0]), mi.Float(found[1])

    def _distorted(self, x: Any, y: Any) -> list[Any]:
        rates = zip((x, y), self.centre, self.per_pixel, strict=True)
        return [(mi.Float64(value) - centre) * rate for value, centre, rate in rates]

    def _derivative(self, x: Any, y: Any) -> tuple[Any, Any, Any]:
        """Return the Jacobian of the distortion, which is symmetric: its elements xx, xy and yy."""
        k1, k2, p1, p2, k3, k4, k5, k6, _, _ = self.k.values()
        s = x * x + y * y
        gain = 1 + s * (k1 + s * (k2 + s * k3))
        bend = 2 * (k1 + s * (2 * k2 + s * 3 * k3))
        if self.model == "rational":
            below = 1 + s * (k4 + s * (k5 + s * k6))
            gain = gain / below
            bend = (bend - 2 * gain * (k4 + s * (2 * k5 + s * 3 * k6))) / below
        across = bend * x * y + 2 * (p1 * x + p2 * y)
        return gain + bend * x * x + 2 * p1 * y + 6 * p2 * x, across, gain + bend * y * y + 6 * p1 * y + 2 * p2 * x

    def _brown(
        self, xd: Any, yd: Any, x0: Any, y0: Any, xd0: Any, yd0: Any, xx: Any, xy: Any, yy: Any
    ) -> tuple[Any, Any]:
        k1, k2, p1, p2, k3, k4, k5, k6, _, _ = self.k.values()
        off_x, off_y = xd - xd0, yd - yd0
        x, y = x0 + xx * off_x + xy * off_y, y0 + xy * off_x + yy * off_y
        for _ in range(self.steps):
            square_x, square_y, twice = x * x, y * y, 2 * x * y
            s = square_x + square_y
            gain = 1 + s * (k1 + s * (k2 + s * k3))
            if self.model == "rational":
                gain = gain / (1 + s * (k4 + s * (k5 + s * k6)))
            off_x = xd - (x * gain + p1 * twice + p2 * (s + 2 * square_x))
            off_y = yd - (y * gain + p1 * (s + 2 * square_y) + p2 * twice)
            x, y = x + xx * off_x + xy * off_y, y + xy * off_x + yy * off_y
        return x, y

    def _spheres(self, xd: Any, yd: Any) -> tuple[Any, Any]:
        """Undistort the double sphere model in closed form, as ``Lens.undistort`` does in NumPy."""
        *_, xi, alpha = self.k.values()
        s = xd * xd + yd * yd
        z = (1 - alpha * alpha * s) / (alpha * dr.sqrt(1 - (2 * alpha - 1) * s) + 1 - alpha)
        scale = (z * xi + dr.sqrt(z * z + (1 - xi * xi) * s)) / (z * z + s)
        gain = scale / (scale * z - xi)
        return xd * gain, yd * gain

    def _slope(self, angle: Any) -> Any:
        """Return the derivative of the distorted radius by the angle in the Kannala-Brandt model."""
        k1, k2, _, _, k3, k4, *_ = self.k.values()
        a = angle * angle
        return 1 + a * (3 * k1 + a * (5 * k2 + a * (7 * k3 + a * 9 * k4)))

    def _kannala(self, xd: Any, yd: Any, angle0: Any, rate: Any, radius0: Any, tangent0: Any) -> tuple[Any, Any]:
        k1, k2, _, _, k3, k4, *_ = self.k.values()
        radius = dr.sqrt(xd * xd + yd * yd)
        angle = angle0 + rate * (radius - radius0)
        for _ in range(self.steps):
            a = angle * angle
            angle = angle + rate * (radius - angle * (1 + a * (k1 + a * (k2 + a * (k3 + a * k4)))))
        # tan(angle0 + turn) by the addition theorem; tan(turn) by its series, as turn is less than a pixel.
        turn = angle - angle0
        t = turn * turn
        tangent = turn * (1 + t * (1 / 3 + t * (2 / 15 + t * (17 / 315 + t * (62 / 2835)))))
        central = radius < 1e-9
        gain = (tangent0 + tangent) / ((1 - tangent0 * tangent) * dr.select(central, 1.0, radius))
        gain = dr.select(central, 1.0, gain)
        return xd * gain, yd * gain


@lru_cache(maxsize=2)
def lens_rays(camera: PinholeCamera, lens: Lens) -> LensRays:
    """Return the rays of a camera; cached, because a million pixel centres take the host seconds."""
    return LensRays.of(camera, lens)


def chord_steps(camera: PinholeCamera, lens: Lens) -> int:
    """Return the number of steps after which the corners of pixels, the worst case, are exact to ``_EXACT_PX``."""
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    axes = (np.unique(np.linspace(0, size - 1, _TRIED).round()) for size in (camera.width, camera.height))
    middles = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 1, 2)
    start = lens.undistort((middles - centre) / focal)
    back = inverse_2x2(lens.distort(start).jacobian)
    wanted = (middles + np.array([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]]) - centre) / focal
    exact = lens.undistort(wanted)  # a corner may lie beyond the fold
    found = start + (back @ (wanted - (middles - centre) / focal)[..., None])[..., 0]
    for steps in range(_MOST_STEPS):
        missing = wanted - lens.distort(found).xy
        if not np.nanmax(np.abs(missing * focal), initial=0.0, where=np.isfinite(exact)) > _EXACT_PX:
            return steps
        found = found + (back @ missing[..., None])[..., 0]
    return _MOST_STEPS


PLUGIN = "rs_pinhole"
LEAST_COMPONENT = 1e-15
"""Smaller components of a ray's direction are rounding errors and are set to 0. Embree treats a component between
-1e-18 and 0 as negative but its inverse as positive, and rays in the same packet then miss surfaces."""


def level(direction: Iterable[Any]) -> list[Any]:
    """Return the components of a direction, with magnitudes below ``LEAST_COMPONENT`` set to 0."""
    return [dr.select(dr.abs(value) < LEAST_COMPONENT, 0.0, value) for value in direction]


def pose_table(
    camera: PinholeCamera, rotations: ArrayLike, translations: ArrayLike, columns: bool = False
) -> NDArray[np.float32]:
    """Return row poses as the kernels read them, (..., height, 12): ``R^T`` row-major, then the centre ``-R^T t``.

    Args:
        camera: camera whose height is the number of poses.
        rotations: (..., height, 3, 3) world-to-camera rotations, one per row; a leading axis holds the instants of
            an exposure.
        translations: (..., height, 3) metres, with ``X_cam = R @ X_world + t``.
        columns: whether the camera reads columns; then there is one pose per column.

    Raises:
        RsbenchError: the shapes are wrong, or a value is not finite.
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


@dataclass(kw_only=True)
class LineRays:
    """Rays of a camera that has a pose for each line: its arrays are inputs of the kernels that trace the rays.

    Lines are rows, or columns. With an exposure, each line has a pose at each of its instants.
    """

    intrinsics: list[Any]
    lens: LensRays | None
    """Lens of a camera that has one, for arrays of rays."""
    one_by_one: PinholeCamera | None
    """The camera, for single rays of the scalar variant."""
    columns: bool
    """Whether there is one pose per column instead of per row."""
    lines: Any = 0
    """Number of poses per instant."""
    instants: int = 1
    """Number of instants of an exposure, and so of poses per line."""
    poses: Any = None
    objects: list[Any] = field(default_factory=list[Any])
    """Poses of each moving object, at the same times as the poses of the camera."""

    @classmethod
    def of(
        cls,
        camera: PinholeCamera,
        rotations: ArrayLike,
        translations: ArrayLike,
        objects: Pose | None = None,
        *,
        columns: bool = False,
    ) -> LineRays:
        """Return the rays of ``camera`` with these poses; arguments and errors are as for ``pose_table``.

        Equal poses in all lines give a global shutter. ``objects`` are the poses ``world_from_object`` of the
        moving objects, with an additional leading axis for the objects.
        """
        arrays = bool(dr.is_jit_v(mi.Float))
        rays = cls(
            intrinsics=[dr.opaque(mi.Float, value) for value in (camera.fx, camera.fy, camera.cx, camera.cy)],
            lens=lens_rays(camera, camera.lens) if camera.lens is not None and arrays else None,
            one_by_one=None if arrays else camera,
            columns=columns,
        )
        rays.set_poses(pose_table(camera, rotations, translations, columns))
        rays.set_objects(object_tables(camera, objects, columns))
        return rays

    def set_poses(self, table: NDArray[np.float32]) -> None:
        """Set the poses from a table (lines, 12) or (instants, lines, 12) of ``pose_table``."""
        self.lines = dr.opaque(mi.UInt32, table.shape[-2])
        self.instants = table.shape[0] if table.ndim == 3 else 1
        self.poses = kernel_input(table)

    def set_objects(self, tables: Sequence[NDArray[np.float32]]) -> None:
        """Set the poses of moving objects from ``object_tables``."""
        self.objects = list(map(kernel_input, tables))

    def row_ray(self, x: Any, y: Any, row: Any, active: Any = True, pixel: Any = None) -> tuple[Any, Any]:
        """Return world origin and direction of the ray through pixel coordinates (x, y), at the pose ``row``.

        With instants, ``row`` is ``row + lines * instant``; with columns, it counts columns. ``pixel`` is the
        result of ``lens.pixel``, computed once for many samples. The direction has z = 1 in the camera frame, so
        the ray parameter of a hit is its depth z.
        """
        u, v = self._coordinates(x, y, active, pixel)
        p = entries(self.poses, row, active)
        direction = [dr.fma(p[3 * i], u, dr.fma(p[3 * i + 1], v, p[3 * i + 2])) for i in range(3)]
        return mi.Point3f(p[9], p[10], p[11]), mi.Vector3f(*level(direction))

    def object_pose(self, number: int, row: Any, active: Any) -> list[Any]:
        """Return the 12 values of the pose of an object; objects count from 0."""
        return entries(self.objects[number], row, active)

    def _coordinates(self, x: Any, y: Any, active: Any, pixel: Any) -> tuple[Any, Any]:
        """Return the coordinates x / z, y / z of the ray through pixel coordinates (x, y)."""
        if self.lens is not None:
            return self.lens.coordinates(x, y, self.lens.pixel(x, y, active) if pixel is None else pixel)
        if self.one_by_one is not None and self.one_by_one.lens is not None:
            u, v, _ = self.one_by_one.unproject([float(x), float(y)]).tolist()
            return u, v
        fx, fy, cx, cy = self.intrinsics
        return (x - cx) / fx, (y - cy) / fy


def object_tables(camera: PinholeCamera, objects: Pose | None, columns: bool) -> list[NDArray[np.float32]]:
    """Return one table per object, as from ``pose_table``: ``R`` row-major and ``t`` of ``world_from_object``."""
    if objects is None:
        return []
    tables = pose_table(camera, *inverse(objects), columns)
    if tables.ndim < 3:
        raise RsbenchError(f"poses of objects have shape {objects.R.shape}: the first axis holds the objects")
    return list(tables)


def kernel_input(values: NDArray[Any]) -> Any:
    """Return a flat Dr.Jit array of float32 or uint32 values; a list, for the scalar variant.

    Dr.Jit uses NumPy's memory, and records a kernel again where its alignment differs; so it is aligned here.
    """
    if not dr.is_jit_v(mi.Float):
        return values.ravel().tolist()
    room = np.zeros(values.nbytes + _ALIGNED, np.uint8)
    start = -room.ctypes.data % _ALIGNED
    aligned = room[start : start + values.nbytes].view(values.dtype)
    aligned[:] = values.ravel()
    return (mi.UInt32 if values.dtype == np.uint32 else mi.Float)(aligned)


def entries(poses: Any, row: Any, active: Any) -> list[Any]:
    """Return the 12 values of the pose of each lane's row."""
    if not dr.is_jit_v(mi.Float):
        return list(poses[12 * int(row) : 12 * int(row) + 12])
    return [dr.gather(mi.Float, poses, row * 12 + k, active) for k in range(12)]


def make_sensor(camera: PinholeCamera, rays: LineRays) -> Any:
    """Make a Mitsuba sensor ``rs_pinhole`` of ``camera``'s size with these rays and a box filter."""
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
    sensor.rays = rays
    return sensor


@cache
def sensor_class() -> Any:
    """Return the class of the plugin ``rs_pinhole`` after registering it with the current Mitsuba variant."""

    class RSPinhole(mi.Sensor):
        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self.rays: LineRays

        def sample_ray(self, time: Any, wavelength: Any, position: Any, aperture: Any, active: Any = True) -> Any:
            """Implement Mitsuba's interface; ``position`` in [0, 1]^2 counts from the corner of the film."""
            film = self.film()
            size, crop, offset = film.size(), film.crop_size(), film.crop_offset()
            x = position.x * crop[0] + offset[0]
            y = position.y * crop[1] + offset[1]
            along, last = (x, size[0] - 1) if self.rays.columns else (y, size[1] - 1)
            row = mi.UInt32(dr.clip(dr.floor(along), 0, last))
            origin, direction = self.rays.row_ray(x - 0.5, y - 0.5, row, active)
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
