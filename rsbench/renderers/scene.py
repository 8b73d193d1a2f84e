"""A scene in Mitsuba: built once, rendered from any number of poses.

For ``sunsky``, the textures of all materials are bytes in one array, read by one look-up. Mitsuba itself stores
four floats per pixel, four times as much, and compiles code for each material. The arithmetic matches Dr.Jit's
bilinear, repeated textures bit for bit.
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.renderers.backend import VARIANTS, start_backend
from rsbench.renderers.mitsuba_modules import dr, mi
from rsbench.scenes.load import irradiance_map
from rsbench.scenes.model import Environment, Light, Material, Scene, SceneMesh, srgb_to_linear


class Reflectances:
    """Diffuse reflectance of the surfaces of a scene as kernel inputs: another scene needs no compilation."""

    def __init__(self, surfaces: Sequence[tuple[Any, Material]]) -> None:
        """Store the reflectance of ``surfaces``, which are Mitsuba's shapes and their materials.

        Raises:
            RsbenchError: a texture is invalid.
        """
        materials = {id(material): material for _, material in surfaces}
        textures = {key: checked_texture(each) for key, each in materials.items() if each.texture is not None}
        begins = dict(zip(textures, np.cumsum([0, *(t[..., 0].size for t in textures.values())]), strict=False))
        # Dr.Jit compiles a table of one entry to different code, hence two more entries.
        texels = np.zeros(sum(t[..., 0].size for t in textures.values()) + 2, dtype=np.uint32)
        for key, texture in textures.items():
            of = texels[begins[key] : begins[key] + texture[..., 0].size].reshape(texture.shape[:2])
            for channel in range(3):
                of |= texture[..., channel].astype(np.uint32) << np.uint32(8 * channel)
        numbers = [_number(shape) for shape, _ in surfaces]
        places = np.zeros((3, max(numbers, default=0) + 2), dtype=np.uint32)
        colours = np.zeros((3, places.shape[1]), dtype=np.float32)
        for number, (_, material) in zip(numbers, surfaces, strict=True):
            if material.texture is None:
                colours[:, number] = srgb_to_linear(material.colour)
            else:
                height, width = textures[id(material)].shape[:2]
                places[:, number] = begins[id(material)], width, height
        self._places, self._colours = [mi.UInt32(each) for each in places], [mi.Float(each) for each in colours]
        self._texels, self._codes = mi.UInt32(texels), mi.Float(linear_codes())
        dr.eval(self.kernel_inputs())

    def kernel_inputs(self) -> list[Any]:
        """Return the arrays that ``at`` reads."""
        return [self._places, self._colours, self._texels, self._codes]

    def texture(self, shape: Any) -> NDArray[np.uint8] | None:
        """Return the texture (h, w, 3) of a shape's material, or None."""
        begin, width, height = (int(each[_number(shape)]) for each in self._places)
        if width == 0:
            return None
        texels = np.array(self._texels)[begin : begin + width * height]
        channels = [texels >> np.uint32(8 * channel) & np.uint32(255) for channel in range(3)]
        return np.stack(channels, axis=-1).astype(np.uint8).reshape(height, width, 3)

    def at(self, hit: Any, active: Any) -> Any:
        """Return the reflectance (RGB) of the surfaces at Mitsuba's interactions."""
        number = dr.reinterpret_array(mi.UInt32, hit.shape)
        begin, width, height = (dr.gather(mi.UInt32, each, number, active) for each in self._places)
        textured = active & (width > 0)
        u, v = (_between(*each) for each in ((hit.uv.x, width), (hit.uv.y, height)))
        found = [mi.Float(0.0)] * 3
        for y, below in v:
            for x, right in u:
                texel = dr.gather(mi.UInt32, self._texels, begin + mi.UInt32(y) * width + mi.UInt32(x), textured)
                for channel in range(3):
                    value = dr.gather(mi.Float, self._codes, (texel >> (8 * channel)) & 255, textured)
                    found[channel] = dr.fma(value, right * below, found[channel])
        plain = [dr.gather(mi.Float, each, number, active) for each in self._colours]
        return mi.Color3f(*(dr.select(textured, *each) for each in zip(found, plain, strict=True)))


def _number(shape: Any) -> int:
    """Return the identifier of a shape inside a kernel."""
    return int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])


def _between(coordinate: Any, size: Any) -> list[tuple[Any, Any]]:
    """Return the two nearest texels along an axis and their weights; the texture repeats."""
    place = dr.fma(coordinate, mi.Float(size), -0.5)
    whole, count = dr.floor(place), mi.Int32(dr.maximum(size, 1))
    share, at = place - whole, mi.Int32(whole)
    # Integer division is slow. The quotient of floats may be inexact, after the second pass by at most 1;
    # coordinates beyond the range of integers give an arbitrary valid texel.
    for _ in range(2):
        at -= mi.Int32(dr.floor(mi.Float(at) / mi.Float(count))) * count
    at = dr.select(at < 0, at + count, at)
    at = dr.clip(dr.select(at >= count, at - count, at), 0, count - 1)
    return [(at, 1.0 - share), (dr.select(at + 1 == count, 0, at + 1), share)]


def checked_texture(material: Material) -> NDArray[np.uint8]:
    """Return the texture of a textured material; raise RsbenchError if it is not (h, w, 3) uint8."""
    texture = np.asarray(material.texture)
    if texture.dtype != np.uint8 or texture.ndim != 3 or texture.shape[2] != 3 or texture.size == 0:
        raise RsbenchError(
            f"material {material.name!r}: texture of shape {texture.shape}, {texture.dtype}: "
            "(h, w, 3) uint8 is needed"
        )
    return texture


@cache
def linear_codes() -> NDArray[np.float32]:
    """Return the linear intensity (256,) of each 8-bit sRGB code, with the rounding of Mitsuba's own conversion.

    Looking up codes is several times faster than Mitsuba's conversion of whole textures, with identical bits.
    """
    codes = mi.Bitmap(np.arange(256, dtype=np.uint8).reshape(1, 256, 1).repeat(3, axis=2))
    linear = codes.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    return np.array(linear)[0, :, 0]


COAT_INDEX = 1.5
"""Refractive index of the clear coat of glossy surfaces: that of glass, lacquer and glTF."""
_SLACK = 1e-3
_SKY_ROWS = 64  # of the sky map that `path` samples; the sky is linear in the sine of the elevation


class MitsubaScene:
    """Meshes, materials, sun and sky of a ``Scene`` in the world frame.

    The constructor starts the renderer backend if the program has not done so.

    Raises:
        RsbenchError: a mesh or texture has the wrong shape, is not finite or refers to missing vertices; a
            textured mesh has no uv; the direction of the sun or the zenith is zero; there are moving objects on a
            GPU; or there is no backend.
    """

    def __init__(self, scene: Scene) -> None:
        variant = start_backend().variant
        self.name = scene.name
        self.light = scene.light
        drawn = [mesh for mesh in scene.meshes if mesh.faces.size]
        if variant == VARIANTS["cuda"] and any(mesh.mover for mesh in drawn):
            # Each object is a separate scene; on a GPU, a kernel silently traces rays in only one of them.
            raise RsbenchError(
                f"scene {scene.name}: objects that move are not rendered on a GPU: choose backend llvm"
            )
        content: dict[str, Any] = {"type": "scene", **_lights(scene.light)}
        moved: list[dict[str, Any]] = [{"type": "scene"} for _ in range(max((m.mover for m in drawn), default=0))]
        self.glossy = scene.glossy
        """Whether any surface is glossy."""
        bare = dr.is_jit_v(mi.Float)
        materials: dict[int, tuple[Material, Any]] = {}
        surfaces, self._bare = list[tuple[Any, Material]](), list[tuple[Any, Material]]()
        self.instances = [{"name": mesh.name, "material": mesh.material.name} for mesh in drawn]
        """Names of the meshes that have faces; the shapes of the renderer are called mesh00000 and so on."""
        for number, mesh in enumerate(drawn):
            key = id(mesh.material)
            if key not in materials:
                own = mesh.material
                if bare and own.roughness is None:  # Mitsuba itself evaluates glossy materials
                    own = replace(own, texture=None)
                materials[key] = own, _loaded(own)
            own, bsdf = materials[key]
            of = moved[mesh.mover - 1] if mesh.mover else content
            of[f"mesh{number:05d}"] = shape = _mesh(mesh, bsdf)
            surfaces.append((shape, mesh.material))
            self._bare.append((shape, own))
        self._reflectances = Reflectances(surfaces) if bare else None
        # Merging shapes of equal material, the default, depends on the order of a parallel loader.
        self.scene = mi.load_dict(content, optimize=False)
        self.objects = [mi.load_dict(each, optimize=False) for each in moved]
        """One scene for each moving object, in the world frame with the object's pose at time 0."""
        self.balls = [_ball([m.vertices for m in drawn if m.mover == k + 1]) for k in range(len(moved))]
        self.sky = Sky(scene.light, self.scene.environment())
        gc.collect()  # `mi.traverse` leaves cyclic garbage that references its shape, and so the textures

    def kernel_inputs(self) -> list[Any]:
        """Return the Dr.Jit arrays, and the Mitsuba objects, that tracing rays in this scene reads."""
        own = None if self._reflectances is None else self._reflectances.kernel_inputs()
        return [self.scene, self.objects, self.balls, own, self.sky.kernel_inputs()]

    def reflectance(self, hit: Any, active: Any) -> Any:
        """Return the diffuse reflectance (RGB) at Mitsuba's interactions."""
        if self._reflectances is None:
            return hit.bsdf().eval_diffuse_reflectance(hit, active)
        return self._reflectances.at(hit, active)

    def textured(self) -> Any:
        """Return Mitsuba's scene with textured materials, for ``path``; the first call loads the textures."""
        if self._reflectances is not None:
            materials: dict[int, Any] = {}
            for shape, material in self._bare:
                if id(material) not in materials:
                    texture = self._reflectances.texture(shape)
                    materials[id(material)] = _loaded(replace(material, texture=texture))
                shape.set_bsdf(materials[id(material)])
            self._bare.clear()
        return self.scene

    def __del__(self) -> None:
        # Dr.Jit keeps hundreds of MB of freed memory for arrays of the same sizes, which another scene rarely has.
        if self.__dict__ and not sys.is_finalizing():
            self.__dict__.clear()
            give_back_memory()


def give_back_memory() -> None:
    """Return the memory of freed arrays, which Dr.Jit caches, to the system."""
    dr.sync_thread()
    dr.flush_malloc_cache()


class Sky:
    """Sun and sky as kernel inputs, so that another sun needs no compilation."""

    def __init__(self, light: Light, emitter: Any) -> None:
        """Store the light; ``emitter`` is Mitsuba's emitter of the sky, used for an environment map."""

        def opaque(values: Any) -> Any:
            return [dr.opaque(mi.Float, float(value)) for value in values]

        self.sun_direction = mi.Vector3f(*opaque(_unit(light.sun_direction, "sun_direction")))
        self.up = mi.Vector3f(*opaque(_unit(light.up, "up")))
        self.sun_radiance = mi.Color3f(*opaque(np.asarray(light.sun_irradiance) / np.pi))
        self.horizon = mi.Color3f(*opaque(light.sky_horizon))
        self.zenith = mi.Color3f(*opaque(light.sky_zenith))
        self.overhead = mi.Color3f(*opaque(light.mean_sky))
        self.mapped = light.environment is not None
        if light.environment is not None:
            open_ = irradiance_map(light.environment.radiance)
            self._around, self._open = emitter, mi.load_dict(_mapped(open_, light.environment))

    def kernel_inputs(self) -> list[Any]:
        """Return the arrays and emitters that the other methods read."""
        colours = [self.sun_direction, self.up, self.sun_radiance, self.horizon, self.zenith, self.overhead]
        return [*colours, self._around, self._open] if self.mapped else colours

    def seen_along(self, direction: Any) -> Any:
        """Return the sky's radiance along unit directions: the horizon's colour below, blended to the zenith's."""
        if self.mapped:
            return _looked_up(self._around, direction)
        return self.horizon + (self.zenith - self.horizon) * dr.maximum(dr.dot(direction, self.up), 0)

    def on_open_surface(self, normal: Any) -> Any:
        """Return the radiance of a white diffuse surface with unit normals under the unoccluded sky and ground.

        The integral of max(n.w, 0) max(up.w, 0) over all directions w is 2 / 3 (sin a + (pi - a) cos a), with a
        between n and up: Cho and Saul, Kernel methods for deep learning, NIPS 2009, in three dimensions.
        """
        if self.mapped:
            return _looked_up(self._open, normal)
        level = dr.clip(dr.dot(normal, self.up), -1, 1)
        angle = dr.acos(level)
        share = (dr.sqrt(1 - level * level) + (dr.pi - angle) * level) * (2 / (3 * dr.pi))
        return self.horizon + (self.zenith - self.horizon) * share


def _looked_up(emitter: Any, direction: Any) -> Any:
    """Return the radiance of an environment map along unit directions, as ``path`` evaluates it."""
    ray = dr.zeros(mi.SurfaceInteraction3f)
    ray.wi = -direction
    return mi.Color3f(emitter.eval(ray))


def _unit(vector: Any, field: str) -> NDArray[np.float64]:
    vector = np.asarray(vector, dtype=np.float64)
    norm = float(np.linalg.norm(vector))
    if not (np.isfinite(norm) and norm > 0.0):
        raise RsbenchError(f"light {field} = {tuple(vector.tolist())}: a direction is needed")
    return vector / norm


def _lights(light: Light) -> dict[str, Any]:
    """Return sun and sky for ``path``, which samples one at random for each shadow ray.

    Black emitters would add noise and are omitted.
    """
    found: dict[str, Any] = {"sun": _sun(light)} if any(light.sun_irradiance) else {}
    if light.environment is not None:
        found["sky"] = _mapped(light.environment.radiance, light.environment)
    elif any((*light.sky_zenith, *light.sky_horizon)):
        found["sky"] = _sky(light)
    return found


def _ball(vertices: Sequence[NDArray[np.float64]]) -> tuple[Any, Any]:
    """Return the centre and squared radius of a bounding sphere of vertices (n, 3), with a margin for rounding."""
    every = np.concatenate(vertices)
    centre = 0.5 * (every.min(axis=0) + every.max(axis=0))
    square = float(np.max(np.sum((every - centre) ** 2, axis=1)))
    values = [dr.opaque(mi.Float, float(value)) for value in (*centre, (1.0 + _SLACK) * square + _SLACK)]
    return mi.Point3f(*values[:3]), values[3]


def _sun(light: Light) -> dict[str, Any]:
    direction = -_unit(light.sun_direction, "sun_direction")
    irradiance = {"type": "rgb", "value": [float(value) for value in light.sun_irradiance]}
    return {"type": "directional", "direction": direction.tolist(), "irradiance": irradiance}


def _sky(light: Light) -> dict[str, Any]:
    """Return the sky as an environment map whose pole (row 0 of the map) is the zenith."""
    up = _unit(light.up, "up")
    side = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    side /= np.linalg.norm(side)
    height = np.cos(np.pi * (np.arange(_SKY_ROWS) + 0.5) / _SKY_ROWS).clip(0.0)[:, None]
    horizon, zenith = np.asarray(light.sky_horizon), np.asarray(light.sky_zenith)
    colours = (horizon + (zenith - horizon) * height).astype(np.float32)
    colours = np.repeat(colours[:, None], 2 * _SKY_ROWS, axis=1)
    return _environment_map(colours, np.stack([side, up, np.cross(side, up)], axis=1))


def _mapped(radiance: NDArray[np.float32], environment: Environment) -> dict[str, Any]:
    """Return Mitsuba's environment map: its centre is along z, its right side along -x, its pole along y."""
    return _environment_map(radiance, environment.frame_from_map @ np.diag([-1.0, -1.0, 1.0]))


def _environment_map(radiance: NDArray[np.float32], rotation: NDArray[np.float64]) -> dict[str, Any]:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    bitmap = mi.Bitmap(radiance.copy())
    return {"type": "envmap", "bitmap": bitmap, "to_world": mi.ScalarTransform4f(pose.tolist())}


def _loaded(material: Material) -> Any:
    """Return Mitsuba's twosided BSDF of a material: diffuse, or diffuse below a clear coat.

    Dr.Jit pads a texture to four channels at its first use, and only then frees the original. So each texture is
    used once here: this takes a third less peak memory than padding all at once in the first image.
    """
    reflectance: Any
    if material.texture is None:
        reflectance = {"type": "rgb", "value": srgb_to_linear(material.colour).tolist()}
    else:
        reflectance = _texture(material)
    inner: dict[str, Any] = {"type": "diffuse", "reflectance": reflectance}
    if material.roughness is not None:
        inner = {
            "type": "roughplastic",
            "distribution": "ggx",
            "alpha": material.roughness**2,
            "int_ior": COAT_INDEX,
            "ext_ior": 1.0,
            "diffuse_reflectance": reflectance,
        }
    bsdf = mi.load_dict({"type": "twosided", "bsdf": inner})
    if material.texture is not None and dr.is_jit_v(mi.Float):
        dr.eval(bsdf.eval_diffuse_reflectance(dr.zeros(mi.SurfaceInteraction3f)))
        give_back_memory()
    return bsdf


def _texture(material: Material) -> dict[str, Any]:
    return {
        "type": "bitmap",
        "data": mi.TensorXf(linear_codes()[checked_texture(material)]),
        "raw": True,
        "filter_type": "bilinear",
        "wrap_mode": "repeat",
        "format": "variant",
        "accel": False,  # graphics hardware interpolates with 8-bit weights
    }


def _check(mesh: SceneMesh) -> None:
    """Refuse meshes that would crash the ray tracer or give invalid images."""
    count, texture = len(mesh.vertices), mesh.material.texture
    for field, values, width in (("vertices", mesh.vertices, 3), ("uv", mesh.uv, 2), ("normals", mesh.normals, 3)):
        if values is not None and (values.shape != (count, width) or not np.isfinite(values).all()):
            raise RsbenchError(
                f"mesh {mesh.name!r}: {field} of shape {values.shape}: ({count}, {width}), all finite, is needed"
            )
    faces = mesh.faces
    if faces.ndim != 2 or faces.shape[1] != 3 or (faces.size and not 0 <= faces.min() <= faces.max() < count):
        raise RsbenchError(
            f"mesh {mesh.name!r}: faces of shape {faces.shape}: (m, 3) indices of its {count} vertices are needed"
        )
    if texture is not None and mesh.uv is None:
        raise RsbenchError(
            f"mesh {mesh.name!r}: its material {mesh.material.name!r} has a texture, but it has no uv"
        )


def _mesh(mesh: SceneMesh, bsdf: Any) -> Any:
    _check(mesh)
    shape = mi.Mesh(
        mesh.name,
        len(mesh.vertices),
        len(mesh.faces),
        has_vertex_normals=mesh.normals is not None,
        has_vertex_texcoords=mesh.uv is not None,
    )
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = np.ravel(mesh.vertices).astype(np.float32)
    parameters["faces"] = np.ravel(mesh.faces).astype(np.uint32)
    if mesh.uv is not None:
        # Mitsuba's v points down the texture.
        uv = np.stack([mesh.uv[:, 0], 1.0 - mesh.uv[:, 1]], axis=-1)
        parameters["vertex_texcoords"] = np.ravel(uv).astype(np.float32)
    parameters.update()
    if mesh.normals is not None:
        # Mitsuba recomputes normals after setting positions, so ours are set later.
        parameters["vertex_normals"] = np.ravel(mesh.normals).astype(np.float32)
        parameters.update()
    # The BSDF is set last: traversing a shape would make a permanent second copy of its textures.
    shape.set_bsdf(bsdf)
    return shape
