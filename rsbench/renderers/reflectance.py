"""The textures of all materials as bytes in one array, looked up by one piece of code: what ``sunsky`` asks.

Mitsuba keeps a texture as four floats a pixel, four times as much, and has code for each material. The arithmetic
here is that of Dr.Jit's bilinear, repeated textures, bit for bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.scenes.model import Material


class Reflectances:
    """Diffuse reflectance of the surfaces of a scene, as data: another scene compiles nothing."""

    def __init__(self, surfaces: Sequence[tuple[Any, Material]]) -> None:
        """``surfaces``: Mitsuba's shapes, and their materials.

        Raises:
            RsbenchError: a texture is none.
        """
        import drjit as dr
        import mitsuba as mi

        materials = {id(material): material for _, material in surfaces}
        textures = {key: checked_texture(each) for key, each in materials.items() if each.texture is not None}
        begins = dict(zip(textures, np.cumsum([0, *(t[..., 0].size for t in textures.values())]), strict=False))
        # Dr.Jit turns a table of one entry into other code, hence two more.
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
        dr.eval(self._places, self._colours, self._texels, self._codes)

    def texture(self, shape: Any) -> NDArray[np.uint8] | None:
        """That of a shape's material, (h, w, 3); None without one."""
        begin, width, height = (int(each[_number(shape)]) for each in self._places)
        if width == 0:
            return None
        texels = np.array(self._texels)[begin : begin + width * height]
        channels = [texels >> np.uint32(8 * channel) & np.uint32(255) for channel in range(3)]
        return np.stack(channels, axis=-1).astype(np.uint8).reshape(height, width, 3)

    def at(self, hit: Any, active: Any) -> Any:
        """Reflectance (RGB) of the surfaces of Mitsuba's interactions."""
        import drjit as dr
        import mitsuba as mi

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
    """By which a kernel knows it."""
    import drjit as dr
    import mitsuba as mi

    return int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])


def _between(coordinate: Any, size: Any) -> list[tuple[Any, Any]]:
    """The two texels of an axis about coordinates, each with its share; the last one's neighbour is the first."""
    import drjit as dr
    import mitsuba as mi

    place = dr.fma(coordinate, mi.Float(size), -0.5)
    whole, count = dr.floor(place), mi.Int32(dr.maximum(size, 1))
    share, at = place - whole, mi.Int32(whole)
    # Division of integers is slow. A quotient of floats may be off, the second one by one; what is larger than a
    # whole number can be ends at some texel.
    for _ in range(2):
        at -= mi.Int32(dr.floor(mi.Float(at) / mi.Float(count))) * count
    at = dr.select(at < 0, at + count, at)
    at = dr.clip(dr.select(at >= count, at - count, at), 0, count - 1)
    return [(at, 1.0 - share), (dr.select(at + 1 == count, 0, at + 1), share)]


def checked_texture(material: Material) -> NDArray[np.uint8]:
    """Of a material that has one."""
    texture = np.asarray(material.texture)
    if texture.dtype != np.uint8 or texture.ndim != 3 or texture.shape[2] != 3 or texture.size == 0:
        raise RsbenchError(
            f"material {material.name!r}: texture of shape {texture.shape}, {texture.dtype}: "
            "(h, w, 3) uint8 is needed"
        )
    return texture


def srgb_to_linear(value: Any) -> NDArray[np.float64]:
    """Linear intensity of sRGB values in [0, 1] (IEC 61966-2-1)."""
    value = np.asarray(value, dtype=np.float64)
    return np.where(value <= 0.04045, value / 12.92, ((np.maximum(value, 0.0) + 0.055) / 1.055) ** 2.4)


@cache
def linear_codes() -> NDArray[np.float32]:
    """Linear intensity (256,) of each 8-bit sRGB code, with the rounding of Mitsuba's own conversion.

    Looking them up is several times faster than letting Mitsuba convert whole textures, and bit for bit the same.
    """
    import mitsuba as mi

    codes = mi.Bitmap(np.arange(256, dtype=np.uint8).reshape(1, 256, 1).repeat(3, axis=2))
    linear = codes.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    return np.array(linear)[0, :, 0]
