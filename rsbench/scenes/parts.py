"""Shapes that builders assemble scenes from: triangles with texture coordinates in metres, placed and merged.

A builder works with names of surfaces only ("ashlar", "tiles") and returns ``Piece``s; ``assemble`` merges them
with the painted surfaces of the same names into one mesh for each surface.

Local frames: x right, y away from who looks at the front, z up, metres.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import mapbox_earcut
import numpy as np
import shapely
import trimesh
from numpy.typing import ArrayLike, NDArray

from rsbench.scenes.model import FloatArray, SceneMesh
from rsbench.scenes.surfaces import Surface

Point = tuple[float, float]
IndexArray = NDArray[np.intp]

# Triangles of a box: for each corner, which end (0 low, 1 high) of each axis.
_BOX = np.asarray(trimesh.creation.box(bounds=((0, 0, 0), (1, 1, 1))).triangles).round().astype(np.intp)


@dataclass(frozen=True)
class Piece:
    """Triangles of one surface."""

    surface: str
    points: FloatArray
    """(n, 3, 3) corners, metres."""
    uv: FloatArray
    """(n, 3, 2) metres on the surface; 0 to 1 for a surface that fits its part exactly."""
    normals: FloatArray
    """(n, 3, 3) unit shading normals."""


def flat(surface: str, triangles: ArrayLike, *, turned: bool = False) -> Piece:
    """Flat-shaded triangles (n, 3, 3), anticlockwise from outside.

    The texture lies as on a wall: u horizontal, v up the slope; on level faces u along x and v along y.
    ``turned`` exchanges the two, for wood whose grain runs sideways.
    """
    points = np.asarray(triangles, dtype=np.float64).reshape(-1, 3, 3)
    normal = _area_vectors(points)
    length = np.linalg.norm(normal, axis=1)
    points, normal = points[length > 1e-10], normal[length > 1e-10]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    side = np.stack([-normal[:, 1], normal[:, 0], np.zeros(len(normal))], axis=1)
    level = np.linalg.norm(side, axis=1) < 1e-3
    side[level] = np.array([1.0, 0.0, 0.0]) - normal[level] * normal[level, :1]
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = _cross(normal, side)
    uv = np.stack([np.einsum("nkc,nc->nk", points, axis) for axis in (side, up)], axis=2)
    uv = uv[..., ::-1] if turned else uv
    return Piece(surface, points, uv, np.repeat(normal[:, None], 3, axis=1))


def smooth(surface: str, vertices: FloatArray, faces: IndexArray, normals: FloatArray) -> Piece:
    """Triangles with the unit shading normals (n, 3) of their vertices, textured as ``flat`` does."""
    piece = flat(surface, vertices[faces])
    kept = np.linalg.norm(_area_vectors(vertices[faces]), axis=1) > 1e-10
    return replace(piece, normals=normals[faces][kept])


def placed(
    pieces: Iterable[Piece], at: tuple[float, float, float], heading_deg: float = 0.0, scale: float = 1.0
) -> list[Piece]:
    """The pieces turned anticlockwise about z by ``heading_deg``, scaled, and moved to ``at``."""
    angle = np.deg2rad(heading_deg)
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return [
        replace(
            piece,
            points=piece.points @ turn * scale + np.asarray(at),
            normals=piece.normals @ turn,
            uv=piece.uv * scale,
        )
        for piece in pieces
    ]


def leaned(pieces: Iterable[Piece], pitch_deg: float = 0.0, roll_deg: float = 0.0) -> list[Piece]:
    """The pieces tipped about x by ``pitch_deg``, then about y by ``roll_deg``; the texture tips along."""
    a, b = np.deg2rad(pitch_deg), np.deg2rad(roll_deg)
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    turn = (about_y @ about_x).T
    return [replace(piece, points=piece.points @ turn, normals=piece.normals @ turn) for piece in pieces]


def joined(pieces: Sequence[Piece]) -> Piece:
    """Pieces of one surface as one, which then shares one texture offset."""
    points, uv, normals = (
        np.concatenate([getattr(piece, name) for piece in pieces]) for name in ("points", "uv", "normals")
    )
    return Piece(pieces[0].surface, points, uv, normals)


def box(surface: str, low: ArrayLike, high: ArrayLike, *, turned: bool = False) -> Piece:
    """An axis-aligned box between two corners."""
    corners = np.stack([np.minimum(low, high), np.maximum(low, high)]).astype(np.float64)
    return flat(surface, corners[_BOX, np.arange(3)], turned=turned)


def block(surface: str, size: Sequence[float], at: Sequence[float] = (0, 0, 0), *, turned: bool = False) -> Piece:
    """A box of ``size`` that stands on the point ``at``."""
    half = np.array([size[0] / 2, size[1] / 2, 0.0])
    return box(surface, np.asarray(at) - half, np.asarray(at) + half + (0, 0, size[2]), turned=turned)


def beam(
    surface: str, start: Sequence[float], end: Sequence[float], width: float, depth: float | None = None
) -> Piece:
    """A square beam between two points, its grain along it; ``depth`` is its size along y (or vertically)."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    length = float(np.linalg.norm(b - a))
    along = (b - a) / length
    reference = np.array([0.0, 1.0, 0.0]) if abs(along[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
    side = _cross(reference, along)
    side /= np.linalg.norm(side)
    piece = block(surface, (width, width if depth is None else depth, length))
    frame = np.stack([side, _cross(along, side), along])
    return replace(piece, points=piece.points @ frame + a, normals=piece.normals @ frame)


def prism(
    surface: str, outline: Sequence[Point] | shapely.Polygon, height: float, *, turned: bool = False
) -> Piece:
    """A polygon in x, y extruded upward from z = 0."""
    shape = outline if isinstance(outline, shapely.Polygon) else shapely.Polygon(outline)
    shape = shapely.geometry.polygon.orient(shape)
    rings = [shapely.get_coordinates(ring)[:-1] for ring in (shape.exterior, *shape.interiors)]
    corners = np.concatenate(rings)
    ends = np.cumsum([len(ring) for ring in rings]).astype(np.uint32)
    cap = corners[mapbox_earcut.triangulate_float64(corners, ends).reshape(-1, 3)]
    # Earcut does not keep a winding: turn every triangle anticlockwise.
    edges = cap[:, 1:] - cap[:, :1]
    cap = np.where(
        (edges[:, 0, 0] * edges[:, 1, 1] < edges[:, 0, 1] * edges[:, 1, 0])[:, None, None], cap[:, ::-1], cap
    )
    starts, nexts = corners, np.concatenate([np.roll(ring, -1, axis=0) for ring in rings])
    a, b, c, d = (_at_height(xy, z) for xy, z in ((starts, 0.0), (nexts, 0.0), (nexts, height), (starts, height)))
    sides = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return flat(
        surface, np.concatenate([_at_height(cap[:, ::-1], 0.0), _at_height(cap, height), sides]), turned=turned
    )


def panel(
    surface: str,
    outline: Sequence[Point],
    thickness: float,
    openings: Iterable[Sequence[Point]] = (),
    *,
    turned: bool = False,
) -> Piece:
    """A wall: an outline in x, z with openings, its front at y = 0 facing -y, its back at y = ``thickness``."""
    shape = shapely.Polygon(outline)
    for opening in openings:
        shape = shape.difference(shapely.Polygon(opening))
    shapes = [part for part in shapely.get_parts(shape) if part.area > 1e-6]
    upright = np.concatenate([prism(surface, part, thickness).points for part in shapes])
    points = np.stack([upright[..., 0], thickness - upright[..., 2], upright[..., 1]], axis=-1)
    return flat(surface, points, turned=turned)


def profile(surface: str, section: Sequence[Point], length: float, *, turned: bool = False) -> Piece:
    """A section in y, z extruded along x, centred on x = 0: walls with a batter, mouldings, roofs."""
    upright = prism(surface, section, length).points
    points = np.stack([upright[..., 2] - length / 2, upright[..., 0], upright[..., 1]], axis=-1)
    return flat(surface, points, turned=turned)


def revolve(
    surface: str,
    outline: Sequence[Point],
    segments: int = 32,
    sweep_deg: tuple[float, float] = (0.0, 360.0),
) -> Piece:
    """An outline of (radius, z) from bottom to top turned about z: towers, cones, barrels, basins.

    Shaded smoothly around and flat along the outline; u is the arc at the largest radius, v the outline's length.
    """
    line = np.asarray(outline, dtype=np.float64)
    angles = np.deg2rad(np.linspace(*sweep_deg, segments + 1))
    around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    steps = np.diff(line, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    run = np.concatenate([[0.0], np.cumsum(lengths)])
    arc = angles * line[:, 0].max()
    strips = []
    for k in np.flatnonzero(lengths > 1e-9):
        out, rise = steps[k][1] / lengths[k], -steps[k][0] / lengths[k]
        rings = [np.column_stack([around * radius, np.full(len(around), z)]) for radius, z in line[k : k + 2]]
        normals = np.column_stack([around * out, np.full(len(around), rise)])
        uv = np.stack(np.broadcast_arrays(arc, run[k : k + 2, None]), axis=-1)
        strips.append(grid(surface, np.stack(rings), uv, np.stack([normals, normals])))
    return joined(strips)


def tube(surface: str, path: ArrayLike, radii: ArrayLike, segments: int = 8) -> Piece:
    """A round tube along a path (n, 3): trunks, branches, pipes, ropes."""
    line = np.asarray(path, dtype=np.float64)
    along = np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    reference = np.where(np.abs(along[:, 2:]) < 0.9, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    side = _cross(reference, along)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = _cross(along, side)
    angles = np.linspace(0, 2 * np.pi, segments + 1)
    ring = side[:, None] * np.cos(angles)[:, None] + other[:, None] * np.sin(angles)[:, None]
    points = line[:, None] + ring * np.asarray(radii)[:, None, None]
    run = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    u, v = np.broadcast_arrays(angles * np.max(radii), run[:, None])
    return grid(surface, points, np.stack([u, v], axis=-1), ring)


def grid(surface: str, points: FloatArray, uv: FloatArray, normals: FloatArray | None = None) -> Piece:
    """A sheet of points (rows, columns, 3) with uv (rows, columns, 2); its own normals if none are given."""
    if normals is None:
        across, along = np.gradient(points, axis=1), np.gradient(points, axis=0)
        facing = _cross(across, along)
        normals = facing / np.linalg.norm(facing, axis=2, keepdims=True)

    def cut(values: FloatArray) -> FloatArray:
        a, b, c, d = values[:-1, :-1], values[:-1, 1:], values[1:, 1:], values[1:, :-1]
        triangles = np.concatenate([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)])
        return triangles.reshape(-1, 3, values.shape[-1])

    corners = cut(points)
    kept = np.linalg.norm(_area_vectors(corners), axis=1) > 1e-10
    return Piece(surface, corners[kept], cut(uv)[kept], cut(normals)[kept])


def picture(surface: str, corners: ArrayLike) -> Piece:
    """A flat quadrilateral (4, 3), anticlockwise from bottom left, that shows the whole texture once."""
    a, b, c, d = np.asarray(corners, dtype=np.float64)
    uv = np.array([[(0, 0), (1, 0), (1, 1)], [(0, 0), (1, 1), (0, 1)]], dtype=np.float64)
    return replace(flat(surface, [[a, b, c], [a, c, d]]), uv=uv)


def lump(
    surface: str, rng: np.random.Generator, radii: ArrayLike, roughness: float = 0.2, subdivisions: int = 3
) -> Piece:
    """An ellipsoid with bumps, centred at the origin: crowns, bushes, stones, sacks."""
    unit, faces = _ball(subdivisions)
    height = np.ones(len(unit))
    for octave in range(4):
        waves = rng.normal(size=(6, 3)) * 2.0 * 1.8**octave
        phases = rng.uniform(0, 2 * np.pi, 6)
        height += roughness * 0.6**octave * np.sin(unit @ waves.T + phases).sum(axis=1) / 6**0.5
    return _rounded(surface, unit * height[:, None] * np.asarray(radii), faces)


def cushion(surface: str, size: Sequence[float], at: Sequence[float] = (0, 0, 0), power: float = 5.0) -> Piece:
    """A box of ``size`` with soft edges that stands on the point ``at``."""
    unit, faces = _ball(3)
    unit = unit / (np.abs(unit) ** power).sum(axis=1, keepdims=True) ** (1 / power)
    vertices = (unit + np.array([0.0, 0.0, 1.0])) * np.asarray(size) / 2 + np.asarray(at)
    return _rounded(surface, vertices, faces)


def _at_height(xy: FloatArray, z: float) -> FloatArray:
    return np.concatenate([xy, np.full((*xy.shape[:-1], 1), z)], axis=-1)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products along the last axis; several times faster than ``np.cross`` on small arrays."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def _area_vectors(corners: FloatArray) -> FloatArray:
    """Normals (n, 3) of triangles (n, 3, 3), as long as twice their area."""
    return _cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


@functools.cache
def _ball(subdivisions: int) -> tuple[FloatArray, IndexArray]:
    """Vertices and faces of a unit sphere; callers leave them as they are."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.intp)


def assemble(
    pieces: Iterable[Piece], palette: Mapping[str, Surface], seed: Sequence[int]
) -> tuple[SceneMesh, ...]:
    """One mesh for each surface. Every piece shows its texture at a random offset, half of them mirrored, because
    a texture seen twice in one picture cannot be matched."""
    rng = np.random.default_rng(seed)
    by_surface: dict[str, list[tuple[Piece, FloatArray]]] = {}
    for piece in pieces:
        repeat = palette[piece.surface].repeat
        uv = piece.uv
        if repeat is not None:
            mirror = np.array([rng.choice((-1.0, 1.0)), 1.0])
            uv = uv * mirror / np.asarray(repeat) + rng.random(2)
        by_surface.setdefault(piece.surface, []).append((piece, uv))
    return tuple(_merged(name, by_surface[name], palette[name]) for name in sorted(by_surface))


def _merged(name: str, parts: list[tuple[Piece, FloatArray]], surface: Surface) -> SceneMesh:
    points = np.concatenate([piece.points for piece, _ in parts]).reshape(-1, 3)
    return SceneMesh(
        name=name,
        vertices=points,
        faces=np.arange(len(points), dtype=np.int32).reshape(-1, 3),
        material=surface.material,
        uv=np.concatenate([uv for _, uv in parts]).reshape(-1, 2),
        normals=np.concatenate([piece.normals for piece, _ in parts]).reshape(-1, 3),
    )


def _rounded(surface: str, vertices: FloatArray, faces: IndexArray) -> Piece:
    normals = np.zeros_like(vertices)
    corner = vertices[faces]
    face_normal = _area_vectors(corner)
    for k in range(3):
        np.add.at(normals, faces[:, k], face_normal)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return smooth(surface, vertices, faces, normals)
