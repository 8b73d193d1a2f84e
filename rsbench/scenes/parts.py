"""Shapes, houses and fortifications that builders assemble scenes from.

Shapes are triangles with texture coordinates in metres, placed and merged. A builder works with names of surfaces
only ("ashlar", "tiles") and returns ``Piece``s; ``assemble`` merges them with the painted surfaces of the same
names into one mesh for each surface.

Local frames: x right, y away from who looks at the front, z up, metres. Fronts and outer faces look towards -y,
those of buildings with their middle at x = 0. Houses have windows, doors, timber frames, roofs, chimneys;
fortifications are curtain walls, round and square towers, keep and gatehouse.
"""

from __future__ import annotations

import functools
import itertools
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import mapbox_earcut
import numpy as np
import shapely
import trimesh
from numpy.typing import ArrayLike, NDArray

from rsbench.scenes.model import FloatArray, SceneBuilder, SceneMesh
from rsbench.scenes.surfaces import Surface, paint_palette

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
    normal = unit(normal)
    side = np.stack([-normal[:, 1], normal[:, 0], np.zeros(len(normal))], axis=1)
    level = np.linalg.norm(side, axis=1) < 1e-3
    side[level] = np.array([1.0, 0.0, 0.0]) - normal[level] * normal[level, :1]
    side = unit(side)
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
    clockwise = edges[:, 0, 0] * edges[:, 1, 1] < edges[:, 0, 1] * edges[:, 1, 0]
    cap = np.where(clockwise[:, None, None], cap[:, ::-1], cap)
    starts, nexts = corners, np.concatenate([np.roll(ring, -1, axis=0) for ring in rings])
    a, b, c, d = (_at_height(xy, z) for xy, z in ((starts, 0.0), (nexts, 0.0), (nexts, height), (starts, height)))
    sides = (np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1))
    triangles = np.concatenate([_at_height(cap[:, ::-1], 0.0), _at_height(cap, height), *sides])
    return flat(surface, triangles, turned=turned)


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
    surface: str, outline: Sequence[Point], segments: int = 32, sweep_deg: tuple[float, float] = (0.0, 360.0)
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
    along = unit(np.gradient(line, axis=0))
    reference = np.where(np.abs(along[:, 2:]) < 0.9, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    side = unit(_cross(reference, along))
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
        normals = unit(_cross(across, along))

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


def unit(vectors: FloatArray) -> FloatArray:
    """Vectors (..., 3) of length 1 of the same directions."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


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


@dataclass(frozen=True, kw_only=True)
class PartsBuilder(SceneBuilder):
    """A scene of parts, painted and merged. Raises ValueError on a parameter that is out of its range."""

    closed = True
    RANGES: ClassVar[tuple[tuple[str, float, float], ...]] = ()
    """Name, least and largest value of each parameter; a pair must ascend between them."""

    def __post_init__(self) -> None:
        for name, least, most in self.RANGES:
            value = getattr(self, name)
            low, high = value if isinstance(value, tuple) else (value, value)
            if not least <= low <= high <= most:
                order = ", the least first" if isinstance(value, tuple) else ""
                raise ValueError(f"{name} = {value}: allowed are {least:g} to {most:g}{order}")

    @abstractmethod
    def pieces(self, rng: np.random.Generator) -> list[Piece]:
        """The parts, in the scene frame."""

    def build(self, seed: int, folder: Path) -> tuple[SceneMesh, ...]:
        pieces = self.pieces(np.random.default_rng((seed, 1)))
        return assemble(pieces, paint_palette((piece.surface for piece in pieces), seed), (seed, 2))


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


@dataclass(frozen=True, kw_only=True)
class HouseStyle:
    """What a house looks like; lengths in metres."""

    width: float = 6.0
    depth: float = 8.0
    storeys: int = 2
    storey_height: float = 2.7
    wall: str = "plaster_0"
    ground: str = "stone"
    roof: str = "tiles_0"
    shutters: str = "shutter_0"
    framed: bool = True
    gable_front: bool = True
    door: bool = True
    jetty: float = 0.25
    pitch: float = 1.1
    """Rise of the roof over half its span."""


def arch(width: float, height: float, segments: int = 10, base: float = 0.0) -> list[Point]:
    """Outline of a round-arched opening that stands on z = ``base``; ``height`` is that of its crown."""
    angles = np.linspace(0, np.pi, segments + 1)
    spring = base + height - width / 2
    crown = [(width / 2 * float(np.cos(a)), spring + width / 2 * float(np.sin(a))) for a in angles]
    return [(-width / 2, base), (width / 2, base), *crown]


def rectangle(x: float, z: float, width: float, height: float) -> list[Point]:
    """Outline of a rectangle whose bottom edge is centred on (x, z)."""
    return [(x - width / 2, z), (x + width / 2, z), (x + width / 2, z + height), (x - width / 2, z + height)]


def window(
    width: float, height: float, shutters: str | None = None, frame: str = "timber", flowers: int | None = None
) -> list[Piece]:
    """A casement with bars, a sill and open shutters, for an opening that stands on z = 0 in the wall y = 0."""
    w, h = width / 2, height
    pieces = [
        box("glass", (-w, 0.12, 0), (w, 0.16, h)),
        box(frame, (-w - 0.09, -0.05, -0.02), (-w + 0.02, 0.14, h + 0.02)),
        box(frame, (w - 0.02, -0.05, -0.02), (w + 0.09, 0.14, h + 0.02)),
        box(frame, (-w - 0.13, -0.06, h), (w + 0.13, 0.14, h + 0.13), turned=True),
        box(frame, (-w - 0.15, -0.14, -0.09), (w + 0.15, 0.14, 0.0), turned=True),
        box(frame, (-0.035, 0.07, 0), (0.035, 0.13, h)),
        box(frame, (-w, 0.07, h * 0.62), (w, 0.13, h * 0.62 + 0.06), turned=True),
    ]
    if shutters is not None:
        for side in (-1, 1):
            leaf = [block(shutters, (w * 0.95, 0.05, h)), block(frame, (w * 0.95, 0.07, 0.09), (0, 0, h * 0.2)),
                    block(frame, (w * 0.95, 0.07, 0.09), (0, 0, h * 0.75))]  # fmt: skip
            pieces += placed(leaf, (side * (w * 1.5 + 0.1), -0.11, 0), side * 8)
    if flowers is not None:
        rng = np.random.default_rng(flowers)
        pieces.append(box("planks", (-w, -0.34, -0.18), (w, -0.12, 0.02), turned=True))
        for x in np.arange(-w + 0.1, w, 0.16):
            bloom = lump(str(rng.choice(["leaves", "flowers"])), rng, (0.13, 0.12, 0.14), 0.3, 1)
            pieces += placed([bloom], (float(x), -0.23, 0.06 + 0.06 * rng.random()))
    return pieces


def door(width: float, height: float, leaf: str = "door", frame: str = "timber") -> list[Piece]:
    """A boarded door with frame, iron bands and a worn step, for an opening that stands on z = 0."""
    w, h = width / 2, height
    pieces = [
        box(leaf, (-w, 0.14, 0), (w, 0.22, h)),
        box(frame, (-w - 0.12, -0.07, 0), (-w + 0.03, 0.2, h)),
        box(frame, (w - 0.03, -0.07, 0), (w + 0.12, 0.2, h)),
        box(frame, (-w - 0.18, -0.09, h), (w + 0.18, 0.2, h + 0.2), turned=True),
        box("stone", (-w - 0.3, -0.5, -0.3), (w + 0.3, 0.1, 0.14)),
    ]
    pieces += [box("iron", (-w + 0.05, 0.11, h * t), (w * 0.6, 0.15, h * t + 0.07)) for t in (0.15, 0.75)]
    return [*pieces, box("iron", (w * 0.55, 0.07, h * 0.47), (w * 0.7, 0.15, h * 0.53))]


def gable_roof(
    tiles: str, length: float, span: float, eaves: float, rise: float, overhang: float = 0.45, thick: float = 0.16
) -> list[Piece]:
    """Two slopes with their ridge along x, tiles outside and boards at the verges."""
    slope = rise / (span / 2)
    low, out = eaves - overhang * slope, span / 2 + overhang
    top = eaves + rise
    outline = [(-out, low), (0, top), (out, low), (out, low + thick), (0, top + thick * 1.2), (-out, low + thick)]
    full = length + 2 * overhang * 0.7
    pieces = [profile(tiles, outline, full)]
    ridge = [(0.14, 0.0), (0.07, 0.13), (-0.07, 0.13), (-0.14, 0.0)]
    pieces += placed([profile(tiles, ridge, full, turned=True)], (0, 0, top + thick * 0.7))
    for end in (-1, 1):
        for side in (-1, 1):
            x = end * (full / 2 + 0.02)
            pieces.append(beam("timber", (x, side * out, low + 0.02), (x, 0, top + 0.02), 0.22, 0.06))
    for side in (-1, 1):
        pieces.append(beam("timber", (-full / 2, side * out, low), (full / 2, side * out, low), 0.12))
    return pieces


def chimney(rng: np.random.Generator, height: float, width: float = 0.7, wall: str = "brick") -> list[Piece]:
    """A stack with a corbelled head and pots, standing on the origin."""
    pieces = [
        block(wall, (width, width * 0.8, height)),
        block(wall, (width + 0.16, width * 0.8 + 0.16, 0.16), (0, 0, height - 0.3)),
        block("stone", (width + 0.1, width * 0.8 + 0.1, 0.08), (0, 0, height)),
    ]
    for x in (-width / 4, width / 4):
        pot = revolve("brick", [(0.13, 0), (0.1, 0.35 + 0.2 * rng.random()), (0.13, 0.62), (0.0, 0.6)], 10)
        pieces += placed([pot], (x, 0, height + 0.08))
    return pieces


def dormer(tiles: str, wall: str, width: float = 1.3, height: float = 1.2) -> list[Piece]:
    """A small gabled window house that sticks out of a roof; its front stands at y = 0."""
    front = [*rectangle(0, 0, width, height)[:3], (0.0, height + width * 0.55), (-width / 2, height)]
    pieces = [
        panel(wall, front, 0.1, [rectangle(0, 0.25, width * 0.55, height * 0.7)]),
        box(wall, (-width / 2, 0, 0), (-width / 2 + 0.1, 2.2, height)),
        box(wall, (width / 2 - 0.1, 0, 0), (width / 2, 2.2, height)),
    ]
    pieces += placed(window(width * 0.55, height * 0.7), (0, 0, 0.25))
    roof = gable_roof(tiles, 2.4, width, height, width * 0.55, 0.16, 0.1)
    return pieces + placed(roof, (0, 1.1, 0), 90)


def timber_frame(
    rng: np.random.Generator, width: float, height: float, openings: Sequence[tuple[float, float]]
) -> list[Piece]:
    """Posts, rails and braces on a wall y = 0 of one storey; ``openings`` are (middle, width) along x."""
    posts = {-width / 2 + 0.1, width / 2 - 0.1}
    for middle, size in openings:
        posts |= {middle - size / 2 - 0.14, middle + size / 2 + 0.14}
    xs = sorted(posts)
    pieces = [beam("timber", (x, -0.03, 0), (x, -0.03, height), 0.17 + 0.04 * rng.random(), 0.14) for x in xs]
    for z in (0.1, height - 0.1):
        pieces.append(beam("timber", (-width / 2, -0.04, z), (width / 2, -0.04, z), 0.14, 0.2))
    for left, right in itertools.pairwise(xs):
        covered = any(left < middle < right for middle, _ in openings)
        if covered:
            pieces.append(beam("timber", (left, -0.02, 0.8), (right, -0.02, 0.8), 0.14, 0.1))
        elif right - left > 0.35:
            low, high = (left, right) if rng.random() < 0.5 else (right, left)
            pieces.append(beam("timber", (low, -0.015, 0.15), (high, -0.015, height - 0.15), 0.15, 0.1))
            if right - left > 0.9:
                z = height * rng.uniform(0.4, 0.6)
                pieces.append(beam("timber", (left, -0.02, z), (right, -0.02, z), 0.13, 0.1))
    return pieces


def house(rng: np.random.Generator, style: HouseStyle) -> list[Piece]:
    """A town house: ground floor with a door, jettied storeys with windows, a gabled roof with chimney."""
    pieces: list[Piece] = []
    for storey in range(style.storeys):
        front = _storey_front(rng, style, storey)
        pieces += placed(front, (0, -style.jetty * storey, storey * style.storey_height))
    eaves = style.storeys * style.storey_height
    y = -style.jetty * (style.storeys - 1)
    for side in (-1, 1):
        x = side * (style.width / 2 - 0.15)
        for storey in range(style.storeys):
            z = storey * style.storey_height
            wall = style.ground if storey == 0 else style.wall
            low = (x - 0.15, -style.jetty * storey + 0.28, z)
            pieces.append(box(wall, low, (x + 0.15, style.depth, z + style.storey_height)))
    back = rectangle(0, 0, style.width, eaves)
    pieces += placed([panel(style.wall, back, 0.3, [])], (0, style.depth, 0), 180)
    return pieces + _house_roof(rng, style, eaves, y)


def _storey_front(rng: np.random.Generator, style: HouseStyle, storey: int) -> list[Piece]:
    """Front wall of one storey with its openings, from z = 0 to the storey's height."""
    w, h = style.width, style.storey_height
    count = max(1, int((w - 0.8) / 1.75))
    middles = (np.arange(count) - (count - 1) / 2) * (w - 0.6) / count
    wall = style.ground if storey == 0 else style.wall
    door_at = int(rng.integers(count)) if storey == 0 and style.door else -1
    holes, pieces = list[list[tuple[float, float]]](), list[Piece]()
    openings: list[tuple[float, float]] = []
    for k, x in enumerate(middles):
        x = float(x)
        if k == door_at:
            size = (1.05, 2.1)
            pieces += placed(door(*size, leaf=str(rng.choice(["door", "planks"]))), (x, 0, 0))
            holes.append(rectangle(x, 0, *size))
        else:
            size = (0.8 + 0.2 * rng.random(), 1.2)
            flowers = int(rng.integers(1 << 30)) if rng.random() < 0.45 else None
            shutters = style.shutters if rng.random() < 0.8 else None
            pieces += placed(window(*size, shutters, flowers=flowers), (x, 0, 0.9))
            holes.append(rectangle(x, 0.9, *size))
        openings.append((x, size[0]))
    pieces.append(panel(wall, rectangle(0, 0, w, h), 0.3, holes))
    if storey > 0:
        if style.framed:
            pieces += timber_frame(rng, w, h, openings)
        pieces.append(beam("timber", (-w / 2, 0.1, -0.12), (w / 2, 0.1, -0.12), 0.24, 0.5))
        for x in np.arange(-w / 2 + 0.2, w / 2, 0.55):
            pieces.append(box("timber", (x - 0.08, -0.08, -0.2), (x + 0.08, 0.4, -0.02)))
    return pieces


def _house_roof(rng: np.random.Generator, style: HouseStyle, eaves: float, front: float) -> list[Piece]:
    w = style.width
    length = style.depth - front
    middle = (style.depth + front) / 2
    span = w if style.gable_front else length
    rise = span / 2 * style.pitch
    roof = gable_roof(style.roof, length if style.gable_front else w, span, eaves, rise)
    gable = [(-span / 2, 0.0), (span / 2, 0.0), (0.0, rise)]
    pieces: list[Piece] = []
    if style.gable_front:
        pieces += placed(roof, (0, middle, 0), 90)
        attic = [panel(style.wall, gable, 0.25, [rectangle(0, rise * 0.22, 0.7, 0.9)])]
        attic += placed(window(0.7, 0.9, style.shutters), (0, 0, rise * 0.22))
        if style.framed:
            attic += _gable_frame(span, rise)
        pieces += placed(attic, (0, front, eaves))
        pieces += placed([panel(style.wall, gable, 0.25)], (0, style.depth, eaves), 180)
    else:
        pieces += placed(roof, (0, middle, 0))
        for side in (-1, 1):
            pieces += placed([panel(style.wall, gable, 0.25)], (side * w / 2, middle, eaves), 90 * side)
        for x in (-w / 4, w / 4):
            if rng.random() < 0.75:
                pieces += placed(dormer(style.roof, style.wall), (x, front + 0.5, eaves + 0.25))
    stack = chimney(rng, 2.4 + rng.random(), wall=str(rng.choice(["brick", "stone"])))
    x = w * rng.uniform(0.15, 0.3) * rng.choice((-1, 1))
    y = middle + rng.uniform(-0.3, 0.3) * length if style.gable_front else middle - 0.8
    height = eaves + rise * (0.35 if style.gable_front else 0.6)
    return pieces + placed(stack, (float(x), float(y), height))


def _gable_frame(span: float, rise: float) -> list[Piece]:
    pieces = [beam("timber", (-span / 2, -0.04, 0.1), (span / 2, -0.04, 0.1), 0.14, 0.2)]
    for side in (-1, 1):
        pieces.append(beam("timber", (side * 0.5, -0.03, 0.1), (side * 0.5, -0.03, rise * 0.78), 0.16, 0.12))
        pieces.append(
            beam("timber", (side * span * 0.32, -0.02, 0.1), (side * 0.55, -0.02, rise * 0.55), 0.15, 0.1)
        )
    reach = span / 2 * 0.42
    return [*pieces, beam("timber", (-reach, -0.035, rise * 0.58), (reach, -0.035, rise * 0.58), 0.15, 0.12)]


def battlement(rng: np.random.Generator, length: float, wall: str, height: float = 1.0) -> list[Piece]:
    """A parapet along x on z = 0, its outer face at y = 0, with merlons, capstones and loops."""
    count = max(1, round(length / 1.75))
    pitch = length / count
    pieces = [box(wall, (-length / 2, 0, 0), (length / 2, 0.45, height))]
    for k in range(count):
        x = (k + 0.5) * pitch - length / 2
        wide, high = pitch * 0.58, 0.85 + 0.06 * rng.normal()
        if rng.random() < 0.06:  # a merlon that fell, as one or two always have
            high *= 0.45
        loop = [rectangle(0, high * 0.25, 0.12, high * 0.5)] if k % 2 else []
        pieces += placed([panel(wall, rectangle(0, 0, wide, high), 0.45, loop)], (x, 0, height))
        cap = [(-0.06, 0.0), (0.51, 0.0), (0.45, 0.1), (0.22, 0.2), (0.0, 0.1)]
        pieces += placed([profile("stone", cap, wide + 0.1)], (x, 0, height + high))
    return pieces


def corbels(length: float, wall: str, step: float = 0.8) -> list[Piece]:
    """A row of brackets and the ledge on them along x, below z = 0, sticking out to y = -0.35."""
    shape = [(0.0, -0.75), (0.0, 0.0), (-0.35, 0.0), (-0.35, -0.22), (-0.2, -0.4)]
    pieces = [box("stone", (-length / 2, -0.38, -0.02), (length / 2, 0.1, 0.14))]
    for x in np.arange(-length / 2 + step / 2, length / 2, step):
        pieces += placed([profile(wall, shape[::-1], 0.26)], (float(x), 0, 0))
    return pieces


def curtain_wall(
    rng: np.random.Generator, length: float, height: float = 6.0, thickness: float = 1.8, wall: str = "ashlar_0"
) -> list[Piece]:
    """A wall along x with a battered foot outside, a battlemented walk, and blind arches and a railing inside."""
    section = [(-0.7, 0.0), (thickness, 0.0), (thickness, height), (0.0, height), (0.0, 1.8)]
    pieces = [profile(wall, section, length)]
    pieces += placed(corbels(length, wall), (0, 0, height - 0.14))
    pieces += placed(battlement(rng, length, wall), (0, -0.33, height))
    count = max(1, round(length / 3.4))
    pitch = length / count
    arches: list[list[Point]] = []
    for k in range(count):
        x = (k + 0.5) * pitch - length / 2
        arches.append([(x + a, b) for a, b in arch(pitch * 0.66, height * 0.68, base=0.25)])
    inner = [panel(wall, rectangle(0, 0, length, height - 0.35), 0.4, arches)]
    for k in range(count):
        x = (k + 0.5) * pitch - length / 2
        inner += placed(_voussoirs(pitch * 0.66, height * 0.68 + 0.25), (x, 0, 0))
    inner += [box("planks", (-length / 2, -0.9, height - 0.12), (length / 2, 0.5, height), turned=True)]
    for x in np.arange(-length / 2 + 0.5, length / 2, 1.3):
        x = float(x)
        inner.append(beam("timber", (x, -0.9, height - 0.22), (x, 0.4, height - 0.22), 0.16))
        inner.append(beam("timber", (x, -0.8, height - 0.3), (x, 0.0, height - 1.1), 0.13))
        inner.append(beam("timber", (x, -0.85, height), (x, -0.85, height + 1.0), 0.1))
    for z in (0.5, 0.95):
        inner.append(beam("timber", (-length / 2, -0.85, height + z), (length / 2, -0.85, height + z), 0.08))
    return pieces + placed(inner, (0, thickness + 0.4, 0), 180)


def _voussoirs(width: float, crown: float) -> list[Piece]:
    """The ring of wedge stones around a round arch in the wall y = 0."""
    pieces: list[Piece] = []
    spring = crown - width / 2
    for a in np.linspace(0, np.pi, 12)[:-1] + np.pi / 22:
        inner, outer = width / 2, width / 2 + 0.34
        half = np.pi / 23
        points = [(inner, a - half), (outer, a - half), (outer, a + half), (inner, a + half)]
        outline = [(r * float(np.cos(t)), spring + r * float(np.sin(t))) for r, t in points]
        pieces += placed([panel("stone", outline, 0.16)], (0, -0.07, 0))
    return pieces


def loop_window(width: float = 0.7, height: float = 1.5) -> list[Piece]:
    """A narrow arched window with a stone surround on the wall y = 0."""
    outer = arch(width + 0.5, height + 0.3, base=-0.15)
    pieces = [panel("stone", outer, 0.3, [arch(width, height)])]
    pieces.append(panel("glass", arch(width * 1.02, height), 0.05))
    pieces.append(beam("iron", (0, 0.0, 0), (0, 0.0, height), 0.05))
    return [*placed(pieces, (0, -0.14, 0)), box("stone", (-width, -0.25, -0.28), (width, 0.1, -0.13))]


def round_tower(
    rng: np.random.Generator, radius: float, height: float, wall: str, roof: str | None = None, rise: float = 1.9
) -> list[Piece]:
    """A round tower: battered foot, windows, corbelled parapet, and a conical roof or open battlements."""
    top = height
    shaft = [(radius * 1.15, 0), (radius, 2.2), (radius, top - 1.2), (radius + 0.32, top - 0.4)]
    crown = [(radius + 0.32, top + 0.9), (radius - 0.1, top + 0.9), (radius - 0.1, top), (0, top)]
    pieces = [revolve(wall, shaft + crown, 40)]
    for z in (height * 0.36, height * 0.68):
        ring = [(radius, z - 0.12), (radius + 0.1, z - 0.1), (radius + 0.1, z + 0.1), (radius, z + 0.12)]
        pieces.append(revolve("stone", ring, 40))
    count = int(2 * np.pi * radius / 0.85)
    for k in range(count):
        bracket = [box(wall, (-0.14, -0.36, top - 1.35), (0.14, 0.1, top - 0.4))]
        pieces += placed(placed(bracket, (0, -radius, 0)), (0, 0, 0), 360 * k / count)
    for k in range(10):
        heading = 36.0 * k + 6
        level = height * (0.2 + 0.28 * (k % 3))
        if level < height * 0.72:
            pieces += placed(placed(loop_window(0.5, 1.2), (0, -radius, level)), (0, 0, 0), heading)
    merlons = int(2 * np.pi * (radius + 0.3) / 1.5)
    for k in range(merlons if roof is None else 0):
        merlon = [
            box(wall, (-0.42, 0, 0), (0.42, 0.42, 0.85 + 0.05 * rng.normal())),
            box("stone", (-0.46, -0.05, 0.85), (0.46, 0.47, 0.98)),
        ]
        pieces += placed(placed(merlon, (0, -radius - 0.32, top + 0.9)), (0, 0, 0), 360 * k / merlons)
    if roof is not None:
        pieces += placed(_cone_roof(roof, radius, rise), (0, 0, top))
        pieces += placed(banner(1.3, 0.6), (0.03, 0, top + 1.55 + radius * rise), float(rng.uniform(-40, 40)))
    return pieces


def _cone_roof(tiles: str, radius: float, rise: float) -> list[Piece]:
    """A bell-cast cone over a tower that ends at z = 0, with an iron finial."""
    apex, eave = 0.8 + radius * rise, radius + 0.75
    cone = [(0, 0.7), (eave, 0.7), (eave * 0.62, 0.95 + radius * rise * 0.36), (0.0, apex)]
    knob = [(0.14, -0.35), (0.1, 0.1), (0.2, 0.3), (0.04, 0.5), (0.03, 1.4), (0.0, 1.4)]
    return [revolve(tiles, cone, 40), revolve("iron", [(r, apex + z) for r, z in knob], 8)]


def banner(length: float, height: float, surface: str = "cloth_0") -> list[Piece]:
    """A flag in a light wind, flying towards +x from its pole at x = 0."""
    t = np.linspace(0, 1, 14)
    wave = 0.12 * np.sin(t * 9) * t
    x, z = np.meshgrid(t * length, np.array([0.0, height]))
    points = np.stack([x, np.broadcast_to(wave * length, x.shape), z - 0.1 * x * x], axis=-1)
    return [grid(surface, points, np.stack([z, x], axis=-1))]


def square_tower(
    rng: np.random.Generator, width: float, height: float, wall: str, floors: int = 3, roof: str | None = None
) -> list[Piece]:
    """A square tower or keep centred on the origin: windows on each floor, corner buttresses, battlements."""
    half = width / 2
    pieces: list[Piece] = [box(wall, (-half + 0.4, -half + 0.4, height - 0.3), (half - 0.4, half - 0.4, height))]
    section = [(-0.5, 0.0), (0.1, 0.0), (0.1, 2.2), (0.0, 2.0)]
    for heading in (0, 90, 180, 270):
        holes, face = list[list[tuple[float, float]]](), list[Piece]()
        for floor in range(floors):
            z = 1.6 + (height - 3.2) * (floor + 0.35) / floors
            count = 1 if width < 6 else 2
            for k in range(count):
                x = (k - (count - 1) / 2) * width * 0.42 + 0.3 * rng.normal() * (width > 6)
                holes.append([(x + a, b) for a, b in arch(0.8, 1.7, base=z)])
                face += placed(loop_window(0.8, 1.7), (x, 0.0, z))
            ledge = [(-0.12, -0.1), (0.05, -0.1), (0.05, 0.1), (-0.06, 0.1)]
            face += placed([profile("stone", ledge, width)], (0, 0, z - 0.75))
        face.append(panel(wall, rectangle(0, 0, width, height), 0.7, holes))
        face.append(profile(wall, section, width + 1.0))
        for side in (-1, 1):
            face.append(box(wall, (side * half - 0.55, -0.22, 0), (side * half + 0.55, 0.3, height - 0.9)))
        face += placed(corbels(width + 0.7, wall), (0, 0, height))
        face += placed(battlement(rng, width + 0.66, wall), (0, -0.33, height))
        pieces += placed(placed(face, (0, -half, 0)), (0, 0, 0), heading)
    return pieces if roof is None else pieces + placed(_saddle_roof(wall, roof, width), (0, 0, height))


def _saddle_roof(wall: str, tiles: str, width: float) -> list[Piece]:
    """A gabled roof with a chimney inside the battlements of a tower that ends at z = 0."""
    half = width / 2
    pieces = placed(gable_roof(tiles, width - 1.6, width - 1.4, 1.3, width * 0.42), (0, 0, 0), 90)
    inner = half - 0.8
    gable = [(-inner, 0.0), (inner, 0.0), (inner, 1.4), (0.0, 1.2 + width * 0.4), (-inner, 1.4)]
    for heading in (0, 180):
        attic = placed(loop_window(0.9, 1.6), (0, 0, 1.0))
        attic.append(panel(wall, gable, 0.3, [arch(0.9, 1.6, base=1.0)]))
        pieces += placed(placed(attic, (0, -inner, 0)), (0, 0, 0), heading)
    stack = [block("stone", (0.9, 0.7, 4.2)), block("stone", (1.1, 0.9, 0.2), (0, 0, 4.0))]
    return pieces + placed(stack, (half * 0.35, 0.8, 1.2))


def gatehouse(rng: np.random.Generator, wall: str, roof: str, height: float = 8.5) -> list[Piece]:
    """An arched passage along y between two round towers, with portcullis, open doors and a shield of arms."""
    depth, wide = 5.0, 3.0
    pieces: list[Piece] = []
    for side in (-1, 1):
        pieces += placed(round_tower(rng, 2.1, height + 1.5, wall, roof), (side * 4.3, 1.6, 0))
    passage = arch(wide, 4.3)
    pieces.append(panel(wall, rectangle(0, 0, 8.4, height), depth, [passage]))
    for heading, y in ((0, 0.0), (180, depth)):
        face = _voussoirs(wide, 4.3)
        for x in (-1.6, 1.6):
            face += placed(loop_window(0.7, 1.5), (x, 0, 5.3))
        shield = [(-0.7, 0.35), (0.0, 0.0), (0.7, 0.35), (0.7, 2.3), (-0.7, 2.3)]
        face += placed([panel("cloth_0", shield, 0.06)], (0, -0.16, 4.9))
        face.append(box("stone", (-4.2, -0.12, 4.55), (4.2, 0.1, 4.75)))
        face += placed(corbels(8.4, wall), (0, 0, height))
        face += placed(battlement(rng, 8.4, wall), (0, -0.33, height))
        pieces += placed(face, (0, y, 0), heading)
    leaf = [block("planks", (1.5, 0.12, 3.6))]
    leaf += [block("iron", (1.4, 0.16, 0.1), (0, 0, z)) for z in (0.5, 1.8, 3.0)]
    for side in (-1, 1):
        pieces += placed(leaf, (side * 1.75, depth + 0.65, 0), 70 * -side)
    for x in np.linspace(-1.4, 1.4, 8):
        pieces.append(beam("iron", (float(x), 1.0, 2.5), (float(x), 1.0, 4.3), 0.07))
    for z in (2.7, 3.1, 3.5, 3.9):
        pieces.append(beam("iron", (-1.5, 1.0, z), (1.5, 1.0, z), 0.07))
    return pieces


def wall_stairs(surface: str, height: float, width: float = 1.3) -> list[Piece]:
    """Stone stairs along x that climb to a wall walk, with a solid flank, from x = 0 upward to +x."""
    steps = round(height / 0.2)
    treads = [
        box(surface, (0.3 * k, 0, 0), (0.3 * (k + 1), width, height * (k + 1) / steps)) for k in range(steps)
    ]
    return [joined(treads)]
