"""Computing the channels of a sequence and writing their files."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rsbench.core.geometry import Geometry
from rsbench.core.so3 import FloatArray
from rsbench.dataset.channel_truth import (
    PairTruth,
    Rays,
    SeenSurfaces,
    carry,
    pair_truth,
    surface_truth,
    target_of,
)
from rsbench.dataset.channels import (
    COMPONENTS,
    NORMAL_COMPONENTS,
    PAIR_CHANNELS,
    RADIANCE_COMPONENTS,
    STEP_PX,
    Layer,
    PairChannel,
    pair_layers,
    radiance_file,
    surface_file,
)
from rsbench.dataset.motion_cards import numbers_of
from rsbench.dataset.views import ImageView
from rsbench.renderers.render import Frame
from rsbench.renderers.visibility import Surfaces
from rsbench.storage.files import Later, begun, write_exr, write_png, write_png16

_BRIGHTEST = float(np.finfo(np.float16).max)


def write_channels(
    folder: Path,
    names: Collection[str],
    geometry: Geometry,
    view: ImageView,
    rendered: Frame,
    rays: Rays,
    later: Later,
    twins: Iterable[int] = (),
) -> None:
    """The files of the channels of these names that tell of one rolling-shutter frame.

    Args:
        folder: of the sequence.
        names: of channels.
        geometry: of the sequence.
        view: the frame.
        rendered: its light and depth.
        rays: through its scene, asked by this thread alone.
        later: has files written beside, see ``written_beside``.
        twins: rows of global-shutter twins to which ``gs_flow`` leads too.
    """
    if "hdr" in names:
        light = {name: rendered.image[..., k] for k, name in enumerate(RADIANCE_COMPONENTS)}
        later(_write_radiance, folder / radiance_file(view.side, view.frame), light)
    if not set(names) & {*PAIR_CHANNELS, "normals", "instances"}:
        return
    seen = SeenSurfaces(geometry, view, rendered.depth, numbers=numbers_of(rendered.labels))
    layers = [
        each for each in pair_layers(names, twins, geometry.frames) if view[1:3] in each.views(geometry.frames)
    ]
    targets = [target_of(layer, view, geometry.frames) for layer in layers]
    carried = begun(later, lambda target: carry(seen, target), targets)
    if {"normals", "instances"} & set(names):
        later(_write_surfaces, folder, names, view, surface_truth(seen, rays))
    for layer, target, landed in zip(layers, targets, carried, strict=True):
        later(_write_pair, folder, layer, view, pair_truth(seen, target, landed, rays.blocked))


def _write_surfaces(folder: Path, names: Collection[str], view: ImageView, surfaces: Surfaces) -> None:
    if "normals" in names:
        normals = {name: surfaces.normals[..., k] for k, name in enumerate(NORMAL_COMPONENTS)}
        write_exr(folder / surface_file("normals", view.side, view.frame), normals)
    if "instances" in names:
        write_png16(folder / surface_file("instances", view.side, view.frame), surfaces.instances)


def _write_radiance(path: Path, light: dict[str, NDArray[np.float32]]) -> None:
    write_exr(path, {name: np.minimum(each, _BRIGHTEST) for name, each in light.items()}, half=True)


def _write_pair(folder: Path, layer: Layer, view: ImageView, truth: PairTruth) -> None:
    values = pair_values(layer.channel, view, truth.offset)
    pixels = {name: values[..., k] for k, name in enumerate(COMPONENTS[layer.channel])}
    write_exr(folder / layer.values(view.side, view.frame), pixels)
    write_png(folder / layer.mask(view.side, view.frame), truth.classes)


def pair_values(channel: PairChannel, source: ImageView, offset: FloatArray) -> NDArray[np.float32]:
    """What a channel stores (..., components) of offsets (..., 2), px: a disparity is x_left - x_right."""
    if channel == "disparity":
        offset = offset[..., :1] * (1.0 if source.side == "right" else -1.0)
    values = offset / STEP_PX
    np.round(values, out=values)
    values *= STEP_PX
    return (values + 0.0).astype(np.float32)  # no -0
