"""Environment maps: light from all directions, in place of the two-colour sky, from a lat-long HDR or EXR file.

The middle of the map looks along +y of the scene, its right side along +x; its upper border is the zenith.
"""

from __future__ import annotations

import io
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core import so3
from rsbench.core.errors import RsbenchError
from rsbench.scenes.model import Environment, FloatArray, Light
from rsbench.storage.untrusted_files import check_amount, read_bytes

PIXELS = 1 << 23
"""Of a map: 4096 x 2048."""
_CHANNELS = 16
_REC_709 = np.array([0.2126, 0.7152, 0.0722])
_SUN_DEG, _RING_DEG, _SUNNY = 5.0, 8.0, 50.0
"""How far from the brightest pixel the sun's light is looked for, how far what lies around it, and how many times
as bright as the median of the upper half it must be."""


def read_environment(path: Path) -> NDArray[np.float32]:
    """Linear radiance (H, 2 H, 3) of a Radiance HDR or an EXR file; its size is read before it is decoded.

    Raises:
        RsbenchError: it cannot be read, is too large, not twice as wide as high, or holds what is no light.
    """
    data, kind = read_bytes(path), path.suffix.lower()
    if kind not in (".hdr", ".exr"):
        raise RsbenchError(f"environment map {path}: must end in .hdr or .exr")
    try:
        radiance = _read_exr(data, path) if kind == ".exr" else _read_hdr(data, path)
    except RsbenchError:
        raise
    except Exception as error:  # what a damaged file makes its decoder stumble over
        raise RsbenchError(f"environment map {path}: damaged, or no {kind[1:].upper()} file") from error
    if not (np.isfinite(radiance).all() and radiance.min() >= 0.0 and radiance.max() > 0.0):
        raise RsbenchError(
            f"environment map {path}: holds values below 0, that are not finite, or no light at all"
        )
    return radiance


def _check_map(path: Path, width: int, height: int, channels: int = 3) -> None:
    if width != 2 * height or height < 2:
        raise RsbenchError(f"environment map {path}: {width} x {height}: a lat-long map is twice as wide as high")
    check_amount(f"environment map {path}", "pixels", width * height, PIXELS)
    check_amount(f"environment map {path}", "channels", channels, _CHANNELS)


def _read_hdr(data: bytes, path: Path) -> NDArray[np.float32]:
    size = re.search(rb"\n-Y (\d{1,9}) \+X (\d{1,9})\n", data[:4096])
    if size is None or not data.startswith(b"#?"):
        raise RsbenchError(f"environment map {path}: no Radiance HDR file with rows from the top")
    height, width = int(size[1]), int(size[2])
    _check_map(path, width, height)
    decoded: Any = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if decoded.shape != (height, width, 3):
        raise ValueError("decoded to another size")
    return np.ascontiguousarray(decoded[..., ::-1], dtype=np.float32)


def _read_exr(data: bytes, path: Path) -> NDArray[np.float32]:
    import OpenEXR

    with OpenEXR.File(io.BytesIO(data), header_only=True) as file:
        headers = [part.header for part in file.parts]
        low, high = headers[0]["dataWindow"]
        width, height = (int(end - start) + 1 for start, end in zip(low, high, strict=True))
        names = [channel.name for channel in headers[0]["channels"]]
    if len(headers) != 1 or not {"R", "G", "B"} <= set(names):
        raise RsbenchError(f"environment map {path}: one part with the channels R, G and B is needed")
    _check_map(path, width, height, len(names))
    with OpenEXR.File(io.BytesIO(data), separate_channels=True) as file:
        pixels = [np.asarray(file.channels()[name].pixels, dtype=np.float32) for name in "RGB"]
    return np.stack(pixels, axis=-1)


def lit_by(light: Light, radiance: NDArray[np.float32], turn_deg: float) -> Light:
    """The light of a map, which makes level ground in the open as bright as ``light`` does.

    A sun in the map becomes the light's sun, so that it throws shadows without noise; a map without one has none.

    Args:
        light: in the frame of the scene, z up; its sun and sky only say how bright all is.
        radiance: of ``read_environment``.
        turn_deg: the map is turned by this much, anticlockwise from above.

    Raises:
        RsbenchError: no light comes from above.
    """
    ways, weights = _directions(radiance.shape[0])
    sky, direction, irradiance = _without_sun(radiance.astype(np.float64), ways, weights)
    level = np.sum(sky * (np.maximum(ways[..., 2], 0.0) * weights)[..., None], axis=(0, 1))
    own = float((level + irradiance * direction[2]) @ _REC_709)
    if own <= 0.0:
        raise RsbenchError("environment map: its upper half is black")
    up = np.asarray(light.sun_direction)[2]
    mean = np.asarray(light.sky_horizon) / 3.0 + 2.0 * np.asarray(light.sky_zenith) / 3.0
    factor = float((np.asarray(light.sun_irradiance) * up + np.pi * mean) @ _REC_709) / own
    turn = so3.exp(np.array([0.0, 0.0, np.deg2rad(turn_deg)]))
    return replace(
        light,
        sun_direction=tuple(turn @ direction),
        sun_irradiance=tuple(factor * irradiance),
        environment=Environment(radiance=_at_edges(factor * sky), frame_from_map=turn @ _SCENE_FROM_MAP),
    )


_SCENE_FROM_MAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""The map's axes are those of a camera that looks at its middle: x right, y down, z forward."""


def _directions(height: int) -> tuple[FloatArray, FloatArray]:
    """Of pixels (H, 2 H): unit directions (..., 3) in the frame of the scene, and solid angles (H, 1)."""
    down = np.pi * (np.arange(height) + 0.5) / height
    around = np.pi * ((np.arange(2 * height) + 0.5) / height - 1.0)
    level = np.sin(down)[:, None]
    ways = [level * np.sin(around), level * np.cos(around), np.cos(down)[:, None] + 0.0 * around]
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    return np.stack(ways, axis=-1), (edges[:-1] - edges[1:])[:, None] * np.pi / height


def _without_sun(
    radiance: FloatArray, ways: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A map (H, W, 3) with what lies around its sun in its place, the sun's direction (3,) and irradiance (3,)."""
    bright = radiance @ _REC_709
    upper = bright[: len(bright) // 2]
    peak = np.unravel_index(int(np.argmax(upper)), upper.shape)
    if upper[peak] <= _SUNNY * np.median(upper):
        return radiance, np.array([0.0, 0.0, 1.0]), np.zeros(3)
    apart = ways @ ways[peak]
    near = apart > np.cos(np.deg2rad(_SUN_DEG))
    ring = ~near & (apart > np.cos(np.deg2rad(_RING_DEG)))
    around = np.median(radiance[ring], axis=0) if np.any(ring) else np.median(radiance, axis=(0, 1))
    more = np.where(near[..., None], np.maximum(radiance - around, 0.0), 0.0) * weights[..., None]
    direction = np.sum(ways * (more @ _REC_709)[..., None], axis=(0, 1))
    sky = np.where(near[..., None], np.minimum(radiance, around), radiance)
    return sky, direction / np.linalg.norm(direction), np.sum(more, axis=(0, 1))


def _at_edges(radiance: FloatArray) -> NDArray[np.float32]:
    """Values (H + 1, W, 3) at the edges of rows, the poles first and last."""
    poles = (np.broadcast_to(np.mean(radiance[row], axis=0), (1, *radiance.shape[1:])) for row in (0, -1))
    top, bottom = poles
    between = 0.5 * (radiance[:-1] + radiance[1:])
    return np.concatenate([top, between, bottom]).astype(np.float32)


def irradiance_map(radiance: NDArray[np.float32], rows: int = 32) -> NDArray[np.float32]:
    """Radiance (rows + 1, 2 rows, 3) of white diffuse surfaces that are open to a map (H + 1, 2 H, 3).

    Their normals lie as the values of ``Environment.radiance`` do.
    """
    height = min(len(radiance) - 1, 4 * rows)
    middle = 0.5 * (radiance[:-1] + radiance[1:])
    small = np.asarray(cv2.resize(middle, (2 * height, height), interpolation=cv2.INTER_AREA), dtype=np.float64)
    ways, weights = _directions(height)
    light = (small * weights[..., None]).reshape(-1, 3)
    down, around = np.pi * np.arange(rows + 1) / rows, np.pi * ((np.arange(2 * rows) + 0.5) / rows - 1.0)
    level = np.sin(down)[:, None]
    normals = np.stack(
        [level * np.sin(around), level * np.cos(around), np.cos(down)[:, None] + 0.0 * around], axis=-1
    )
    seen = [np.maximum(row @ ways.reshape(-1, 3).T, 0.0) @ light for row in normals]
    return (np.stack(seen) / np.pi).astype(np.float32)
