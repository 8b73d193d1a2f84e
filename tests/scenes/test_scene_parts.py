"""Parts that scenes are assembled from, and painted textures."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rsbench.scenes.model import Material
from rsbench.scenes.parts import (
    HouseStyle,
    Piece,
    assemble,
    beam,
    block,
    cushion,
    flat,
    house,
    leaned,
    lump,
    panel,
    picture,
    placed,
    prism,
    profile,
    revolve,
    tube,
)
from rsbench.scenes.surfaces import (
    RECIPES,
    Surface,
    cut_courses,
    paint_palette,
)


def solid(piece: Piece) -> trimesh.Trimesh:
    """Corners merged, so that a closed surface is watertight."""
    vertices, faces = piece.points.reshape(-1, 3), np.arange(3 * len(piece.points)).reshape(-1, 3)
    mesh = trimesh.Trimesh(vertices=vertices, faces=faces, process=False)
    mesh.merge_vertices(merge_norm=True, merge_tex=True)
    return mesh


def assert_sound(piece: Piece) -> None:
    """Also that normals are on the side from which triangles turn anticlockwise."""
    assert piece.points.shape[1:] == (3, 3) and piece.uv.shape == (*piece.points.shape[:2], 2)
    for values in (piece.points, piece.uv, piece.normals):
        assert np.isfinite(values).all()
    assert np.linalg.norm(piece.normals, axis=2) == pytest.approx(1, abs=1e-9)
    geometric = np.cross(piece.points[:, 1] - piece.points[:, 0], piece.points[:, 2] - piece.points[:, 0])
    assert np.all(np.einsum("nc,nkc->nk", geometric, piece.normals) > 0)


U_SHAPE = [(0.0, 0.0), (3.0, 0.0), (3.0, 2.0), (2.0, 2.0), (2.0, 1.0), (1.0, 1.0), (1.0, 2.0), (0.0, 2.0)]


@pytest.mark.parametrize(
    ("piece", "volume"),
    [
        (block("a", (2, 3, 4), (5, 6, 7)), 24),
        (beam("a", (1, 2, 3), (4, 6, 3), 0.2, 0.3), 5 * 0.2 * 0.3),
        (prism("a", U_SHAPE, 2.5), 5 * 2.5),
        (prism("a", U_SHAPE[::-1], 2.5), 5 * 2.5),
        (panel("a", [(0, 0), (4, 0), (4, 3), (0, 3)], 0.5, [[(1, 1), (2, 1), (2, 2), (1, 2)]]), 11 * 0.5),
        (panel("a", [(0, 0), (4, 0), (4, 3), (0, 3)], 0.5, [[(1, -1), (2, -1), (2, 2), (1, 2)]]), 10 * 0.5),
        (profile("a", U_SHAPE, 7.0), 5 * 7.0),
        (revolve("a", [(0, 0), (2, 0), (2, 5), (0, 5)], 360), np.pi * 4 * 5),
        (revolve("a", [(0, 0), (3, 0), (0, 4)], 360), np.pi * 9 * 4 / 3),
    ],
)
def test_volumes(piece: Piece, volume: float) -> None:
    assert_sound(piece)
    mesh = solid(piece)
    assert mesh.is_watertight
    # 360 segments of a circle lose 2 pi^2 / 3 / 360^2 = 5e-5 of its area.
    assert mesh.volume == pytest.approx(volume, rel=1e-4)


def test_a_cushion_fits_its_box() -> None:
    piece = cushion("a", (1, 2, 1), (0, 0, 3))
    assert_sound(piece)
    assert 0 < solid(piece).volume < 2
    corners = piece.points.reshape(-1, 3)
    assert np.all(corners >= (-0.5, -1, 3)) and np.all(corners <= (0.5, 1, 4))


def test_a_cylinder_is_smooth_and_its_texture_is_unrolled() -> None:
    piece = revolve("a", [(2, 1), (2, 6)], 64)
    radial = piece.points * (1, 1, 0) / 2
    assert piece.normals == pytest.approx(radial)
    assert np.ptp(piece.uv[..., 0]) == pytest.approx(2 * np.pi * 2)
    assert np.ptp(piece.uv[..., 1]) == pytest.approx(5)


def test_a_tube_has_the_surface_of_a_cylinder() -> None:
    piece = tube("a", [(0, 0, 0), (1, 1, 1), (3, 3, 3)], (0.5, 0.5, 0.5), 128)
    assert_sound(piece)
    # 128 segments shorten the circumference by pi^2 / 6 / 128^2 = 1e-4.
    assert solid(piece).area == pytest.approx(np.pi * 3 * 3**0.5, rel=1e-3)


coordinate = st.floats(-10, 10, allow_nan=False, width=32)
triangle = st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=3, max_size=3)


@given(triangle)
@settings(max_examples=60)
def test_flat_textures_keep_lengths(corners: list[tuple[float, float, float]]) -> None:
    piece = flat("a", [corners])
    area = np.linalg.norm(np.cross(np.subtract(corners[1], corners[0]), np.subtract(corners[2], corners[0])))
    if len(piece.points) == 0:
        assert area <= 1.01e-10, "only degenerate triangles are dropped"
        return
    assert_sound(piece)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        length = float(np.linalg.norm(np.subtract(corners[a], corners[b])))
        # A sliver's normal is uncertain by rounding over area, which tilts the texture plane.
        tolerance = float(1e-9 + 1e-13 * length**3 / area)
        assert np.linalg.norm(piece.uv[0, a] - piece.uv[0, b]) == pytest.approx(length, abs=tolerance)


def test_textures_hang_upright_on_walls_and_roofs() -> None:
    wall = flat("a", [[(0, 0, 0), (1, 0, 0), (0, 0, 1)]])
    assert wall.uv[0] - wall.uv[0, 0] == pytest.approx(np.array([(0, 0), (1, 0), (0, 1)]))
    roof = flat("a", [[(0, 0, 0), (1, 0, 0), (0, 3, 4)]])
    assert roof.uv[0] - roof.uv[0, 0] == pytest.approx(np.array([(0, 0), (1, 0), (0, 5)]))
    assert flat("a", roof.points, turned=True).uv == pytest.approx(roof.uv[..., ::-1])


@given(st.floats(-180, 180), st.floats(0.2, 3), st.tuples(coordinate, coordinate, coordinate))
@settings(max_examples=30)
def test_placing_is_a_similarity(heading: float, scale: float, at: tuple[float, float, float]) -> None:
    (moved,) = placed([prism("a", U_SHAPE, 2.0)], at, heading, scale)
    assert_sound(moved)
    assert moved.points.reshape(-1, 3).min(axis=0)[2] == pytest.approx(at[2])
    assert moved.points[..., 2].max() == pytest.approx(at[2] + 2 * scale)
    # Volume by the divergence theorem.
    a, b, c = (moved.points[:, k] - np.asarray(at) for k in range(3))
    assert np.einsum("nc,nc->", a, np.cross(b, c)) / 6 == pytest.approx(10 * scale**3, rel=1e-6)


def test_headings_and_tilts_turn_the_right_way() -> None:
    front = [flat("a", [[(0, -1, 0), (1, -1, 0), (0, -1, 1)]])]
    (turned,) = placed(front, (0, 0, 0), 90)
    assert turned.normals[0, 0] == pytest.approx([1, 0, 0])  # what looked to -y looks to +x
    (tipped,) = leaned(front, 90)
    assert tipped.normals[0, 0] == pytest.approx([0, 0, -1])  # a quarter turn about x takes -y to -z
    (rolled,) = leaned([flat("a", [[(1, 0, 0), (1, 1, 0), (1, 0, 1)]])], 0, 90)
    assert rolled.normals[0, 0] == pytest.approx([0, 0, -1])  # a quarter turn about y takes +x to -z


def test_a_picture_shows_the_whole_texture_once() -> None:
    piece = picture("a", [(0, 0, 0), (2, 0, 0), (2, 0, 1), (0, 0, 1)])
    assert piece.points[..., 0] / 2 == pytest.approx(piece.uv[..., 0])
    assert piece.points[..., 2] == pytest.approx(piece.uv[..., 1])


def test_lumps_are_seeded_and_closed() -> None:
    one, same, other = (lump("a", np.random.default_rng(seed), (1, 2, 3)) for seed in (1, 1, 2))
    assert np.array_equal(one.points, same.points) and not np.array_equal(one.points, other.points)
    assert_sound(one)
    assert solid(one).is_watertight


@pytest.mark.parametrize("gable_front", [True, False])
def test_houses_are_built_soundly(gable_front: bool) -> None:
    style = HouseStyle(gable_front=gable_front, storeys=3)
    pieces = house(np.random.default_rng(4), style)
    for piece in pieces:
        assert_sound(piece)
    points = np.concatenate([piece.points.reshape(-1, 3) for piece in pieces])
    assert points[:, 2].max() > 3 * style.storey_height + 1.0
    assert np.abs(points[:, 0]).max() < style.width / 2 + 1.0


def test_assembling_merges_by_surface_and_keeps_texture_scale() -> None:
    surfaces = {
        "tiled": Surface(Material(name="tiled", texture=np.zeros((2, 2, 3), np.uint8)), (4.0, 2.0)),
        "fitted": Surface(Material(name="fitted", texture=np.zeros((2, 2, 3), np.uint8)), None),
    }
    square = picture("fitted", [(0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)])
    pieces = [block("tiled", (1, 1, 1)), square, block("tiled", (2, 2, 2), (5, 0, 0))]
    fitted, tiled = assemble(pieces, surfaces, (1,))
    assert (fitted.name, tiled.name) == ("fitted", "tiled")
    assert fitted.uv == pytest.approx(square.uv.reshape(-1, 2))
    assert len(tiled.faces) == 24 and tiled.material is surfaces["tiled"].material
    assert tiled.uv is not None
    for face in tiled.faces:
        metres = np.linalg.norm((tiled.uv[face] - tiled.uv[face[0]]) * (4.0, 2.0), axis=1)
        assert metres == pytest.approx(np.linalg.norm(tiled.vertices[face] - tiled.vertices[face[0]], axis=1))
    offsets = [tiled.uv[0] % 1, tiled.uv[36] % 1]
    assert not np.allclose(offsets[0], offsets[1])


def seam_ratio(texture: NDArray[Any], axis: int) -> float:
    """Step across the border of a repeated texture over the strongest step between two neighbouring lines inside.

    Joints between stones may lie on the border, so it is measured against other joints. A texture that does not
    repeat steps as much as unrelated lines do, several times that.
    """
    lines = np.moveaxis(texture.astype(np.float64), axis, 0).reshape(texture.shape[axis], -1)
    steps = np.abs(np.diff(lines, axis=0)).mean(axis=1)
    return float(np.abs(lines[0] - lines[-1]).mean() / steps.max())


def test_courses_of_known_size() -> None:
    cells = cut_courses(np.random.default_rng(0), 400, 4.0, (0.5, 0.5), (1.0, 1.0))
    assert cells.count == 8 * 4
    # Every block is 0.5 m x 1 m, so its inradius is 0.25 m, and blocks share the area equally.
    assert cells.edge.max() == pytest.approx(0.25, abs=0.011)
    assert np.unique(np.bincount(cells.index.ravel()) / (50 * 100)) == pytest.approx(1.0, abs=0.03)
    assert np.array_equal(cells.course, np.repeat(np.arange(8), 50)[:, None] * np.ones((1, 400), int))
    assert cells.across[0].max() < 0.03 and cells.across[49].min() > 0.95


@pytest.fixture(scope="module")
def palette() -> dict[str, Surface]:
    """All surfaces, with half as many texels along a side as scenes have, for time."""
    with pytest.MonkeyPatch.context() as patch:
        for name, recipe in RECIPES.items():
            patch.setitem(RECIPES, name, replace(recipe, pixels=recipe.pixels // 2))
        return paint_palette(RECIPES, 7)


def test_every_surface_paints_and_repeats(palette: dict[str, Surface]) -> None:
    for name, surface in palette.items():
        texture = surface.material.texture
        assert texture is not None and texture.dtype == np.uint8 and texture.shape[2] == 3, name
        assert 20 < texture.mean() < 235, name
        # Enough contrast for a feature detector: a few grey levels from texel to texel and from stone to stone.
        # Paint and sheet metal are weak on purpose, but not one colour.
        weak = name.startswith("paint_") or name in ("enamel", "steel")
        assert texture.mean(axis=2).std() > (1.5 if weak else 5.0), name
        if surface.repeat is not None:
            assert max(seam_ratio(texture, 0), seam_ratio(texture, 1)) < 1.3, name


def test_a_texture_depends_on_seed_and_name_alone() -> None:
    alone = paint_palette(["iron"], 7)["iron"].material.texture
    among = paint_palette(["fruit_0", "iron", "water"], 7)["iron"].material.texture
    other = paint_palette(["iron"], 8)["iron"].material.texture
    assert alone is not None and among is not None and other is not None
    assert np.array_equal(alone, among)
    assert not np.array_equal(alone, other)
