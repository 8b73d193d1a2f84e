"""Placement of a user's model: its size and place, the ground below it and walls around."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rsbench.scenes.model import FloatArray, SceneMesh
from rsbench.scenes.palette import paint_palette
from rsbench.scenes.parts import Piece, assemble, box, grid

_GROUND, _WALL = "cobbles", "brick"
_SUNK = 1e-3
"""Of the model's size: a base at the height of the ground would share its surface."""
_APART, _HIGH = 4.0, 2.0
"""Of the model's size: from its axis to the walls, and their height."""


def standing(meshes: Sequence[SceneMesh], size: float | None) -> tuple[SceneMesh, ...]:
    """The same model over the scene's origin, its lowest point at z = 0.

    Args:
        meshes: of the model; all vertices that triangles use are within its box.
        size: length of the longest side of that box, metres; None keeps it.
    """
    low, high = box_of(meshes)
    factor = 1.0 if size is None else size / float(np.max(high - low))
    foot = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    return tuple(replace(mesh, vertices=factor * (mesh.vertices - foot)) for mesh in meshes)


def box_of(meshes: Sequence[SceneMesh]) -> tuple[FloatArray, FloatArray]:
    """Least and largest coordinates (3,) of what is seen of meshes."""
    used = [mesh.vertices[np.unique(mesh.faces)] for mesh in meshes]
    lows, highs = [part.min(axis=0) for part in used], [part.max(axis=0) for part in used]
    return np.min(lows, axis=0), np.max(highs, axis=0)


def surroundings(meshes: Sequence[SceneMesh], ground: bool, backdrop: bool, seed: int) -> tuple[SceneMesh, ...]:
    """Cobbles below a model, and a square of brick walls around it; its box decides their size."""
    low, high = box_of(meshes)
    size, (x, y) = float(np.max(high - low)), (low[:2] + high[:2]) / 2
    floor, reach, pieces = float(low[2]) - _SUNK * size, _APART * size, list[Piece]()
    if ground:
        steps = np.linspace(-2 * reach, 2 * reach, 33)
        across, along = np.meshgrid(steps, steps)
        points = np.stack([x + across, y + along, np.full_like(across, floor)], axis=-1)
        pieces.append(grid(_GROUND, points, np.stack([across, along], axis=-1)))
    if backdrop:
        thick, top = 0.1 * size, floor + _HIGH * size
        for sign in (-1, 1):
            near, far = sorted((sign * reach, sign * (reach + thick)))
            pieces.append(box(_WALL, (x + near, y - reach, floor), (x + far, y + reach, top)))
            pieces.append(box(_WALL, (x - reach, y + near, floor), (x + reach, y + far, top)))
    made = assemble(pieces, paint_palette((piece.surface for piece in pieces), seed), (seed, 2))
    return tuple(replace(mesh, name=f"around the model: {mesh.name}") for mesh in made)
