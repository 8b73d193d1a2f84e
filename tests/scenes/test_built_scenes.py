"""The built-in scenes: sound geometry, determinism, and what their default viewpoints see."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from commands import refused
from numpy.typing import NDArray

from rsbench.components.cards import card_path, list_cards
from rsbench.core.errors import RsbenchError
from rsbench.dataset.card import load_dataset_card
from rsbench.scenes.load import BUILDERS, load_scene, read_scene_card
from rsbench.scenes.model import Material, Scene
from rsbench.scenes.surfaces import RECIPES, Surface

DEPTHS = {
    "castle": (4.0, (8, 27), 70.0),
    "corridor": (2.5, (4, 10), 24.0),
    "forest": (2.0, (6, 20), 60.0),
    "old-town": (4.0, (8, 25), 70.0),
    "poles": (2.0, (4, 13), 30.0),
    "room": (1.2, (2.5, 5.5), 6.5),
    "shelves": (3.0, (6, 15), 28.0),
    "street": (4.0, (8, 30), 90.0),
    "terrain": (50.0, (70, 110), 170.0),
}
"""The built-in scenes. Of the default view, metres: the nearest, the range of the median, the farthest."""
FOCAL, SIZE = 1384.6, 900  # the paper's camera, 36 degrees


@pytest.fixture(scope="module", params=DEPTHS)
def name(request: pytest.FixtureRequest) -> str:
    """Of module scope, so that pytest runs all tests of one scene, and drops it, before the next."""
    return str(request.param)


@pytest.fixture(scope="module")
def scene(name: str, built_scene: Callable[[str], Scene]) -> Scene:
    return built_scene(name)


def test_every_card_parses_and_every_builder_has_one() -> None:
    cards = {name: read_scene_card(path)[0] for name, path in list_cards("scenes").items()}
    assert {card.builder for card in cards.values()} == set(BUILDERS.built_in)
    for name, card in cards.items():
        assert card.name == name


def test_the_example_of_a_mesh_card_asks_for_its_file() -> None:
    with pytest.raises(RsbenchError, match=r"model\.glb: no such file"):
        load_scene("mesh")


@pytest.mark.slow
def test_meshes_are_sound(scene: Scene) -> None:
    assert len({mesh.name for mesh in scene.meshes}) == len(scene.meshes)
    for mesh in scene.meshes:
        count = len(mesh.vertices)
        assert mesh.vertices.shape == (count, 3) and np.isfinite(mesh.vertices).all()
        assert mesh.faces.dtype == np.int32 and mesh.faces.min() >= 0 and mesh.faces.max() < count
        corners = mesh.vertices[mesh.faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        assert np.mean(area < 1e-9) < 0.01
        assert mesh.material.texture is not None and mesh.material.texture.dtype == np.uint8
        assert mesh.uv is not None and mesh.uv.shape == (count, 2) and np.isfinite(mesh.uv).all()
        assert mesh.normals is not None and mesh.normals.shape == (count, 3)
        assert np.linalg.norm(mesh.normals, axis=1) == pytest.approx(1, abs=1e-6)


def test_scenes_stay_within_their_budget(scene: Scene) -> None:
    assert sum(len(mesh.faces) for mesh in scene.meshes) < 400_000
    textures = {id(mesh.material.texture): mesh.material.texture for mesh in scene.meshes}
    assert sum(texture.nbytes for texture in textures.values() if texture is not None) < 200e6


def test_texels_are_as_fine_as_pixels_need(scene: Scene, name: str) -> None:
    """Texels of the median triangle: about a pixel at one to twenty metres, 0.7 to 14 mm; from farther, two."""
    largest = max(0.012, 2 * DEPTHS[name][1][0] / FOCAL)
    for mesh in scene.meshes:
        assert mesh.material.texture is not None and mesh.uv is not None
        a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
        p, q, r = (mesh.uv[mesh.faces[:, k]] * mesh.material.texture.shape[1::-1] for k in range(3))
        metres2 = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        texels2 = np.abs((q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0])
        size = np.median(np.sqrt(metres2 / np.maximum(texels2, 1e-9)))
        assert 0.0004 < size < largest, mesh.name


def triangles(scene: Scene, view: str) -> NDArray[np.float64]:
    """Corners (n, 3, 3) of all triangles as seen from a viewpoint."""
    seen = scene.seen_from(scene.viewpoints[view])
    return np.concatenate([mesh.vertices[mesh.faces] for mesh in seen.meshes])


def nearest_surface(scene: Scene, view: str) -> float:
    """Metres from a viewpoint to the nearest point of any triangle: inside it, or on an edge."""
    corners = triangles(scene, view)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    corners, normal = corners[length > 0], normal[length > 0] / length[length > 0, None]
    foot = normal * np.sum(corners[:, 0] * normal, axis=1, keepdims=True)
    inside, nearest = np.ones(len(corners), dtype=bool), np.inf
    for k in range(3):
        start, edge = corners[:, k], corners[:, (k + 1) % 3] - corners[:, k]
        inside &= np.sum(np.cross(edge, foot - start) * normal, axis=1) >= 0
        along = np.clip(-np.sum(start * edge, axis=1) / np.maximum(np.sum(edge**2, axis=1), 1e-300), 0, 1)
        nearest = min(nearest, float(np.min(np.linalg.norm(start + along[:, None] * edge, axis=1))))
    return min(nearest, float(np.min(np.linalg.norm(foot[inside], axis=1), initial=np.inf)))


def test_no_seed_leads_a_camera_of_these_cards_into_a_wall(scene: Scene, name: str) -> None:
    """A camera is never farther from the viewpoint than half the baseline and the whole way, wherever it turns."""
    reach: dict[str, float] = {}
    for card in ("standard", "sweep-readout", "stress"):
        dataset = load_dataset_card(card)
        for sequence in dataset.sequence:
            if sequence.scene == name:
                way = float(np.linalg.norm(dataset.motion_of(sequence).d))
                way *= 1 + dataset.shutter_for(sequence).readout_ratio
                own = dataset.rig_of(sequence).baseline / 2 + way
                reach[sequence.viewpoint] = max(own, reach.get(sequence.viewpoint, 0.0))
    for view, farthest in reach.items():
        assert farthest < nearest_surface(scene, view), view


def first_hits(scene: Scene, view: str, rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance along each ray (n, 3) from a viewpoint, in lengths of the ray; infinite where nothing is hit.

    Moeller and Trumbore, "Fast, minimum storage ray-triangle intersection", 1997.
    """
    corners = triangles(scene, view)
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    # Triple products of a ray and two edges are products of the ray with what only the triangle decides.
    by_det, by_u, by_v = np.cross(ac, ab), np.cross(ac, a), np.cross(a, ab)
    by_t = np.einsum("nc,nc->n", ac, by_v)
    distances = np.full(len(rays), np.inf)
    for k, ray in enumerate(rays):
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = -1 / (by_det @ ray)
            u, v, t = (by_u @ ray) * inverse, (by_v @ ray) * inverse, by_t * inverse
            hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-6)
        distances[k] = t[hit].min(initial=np.inf)
    return distances


def pixel_rays(across: int) -> NDArray[np.float64]:
    """Rays (across^2, 3) with z = 1 through a grid of pixels, so that distances along them are depths."""
    steps = ((np.arange(across) + 0.5) * SIZE / across - SIZE / 2) / FOCAL
    return np.stack([*(axis.ravel() for axis in np.meshgrid(steps, steps)), np.ones(across * across)], axis=1)


@pytest.mark.slow
def test_viewpoints_are_several_and_leave_room_for_the_rig(scene: Scene) -> None:
    assert "default" in scene.viewpoints and len(scene.viewpoints) >= 3
    # Cameras stand 0.25 m left and right and move 0.3 m.
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    for view in scene.viewpoints:
        assert first_hits(scene, view, axes).min() > 0.35, view
        assert first_hits(scene, view, pixel_rays(3)).min() > 1.0, view


@pytest.mark.slow
def test_default_views_have_depths_a_stereo_rig_can_use(scene: Scene, name: str) -> None:
    nearest, middle, farthest = DEPTHS[name]
    depths = first_hits(scene, "default", pixel_rays(9))
    seen = depths[np.isfinite(depths)]
    assert len(seen) / depths.size > 0.85  # little sky
    assert seen.min() > nearest and seen.max() < farthest
    assert middle[0] < np.median(seen) < middle[1]
    low, high = np.quantile(seen, [0.1, 0.9])
    assert high / low > 1.5  # a flat scene would hide the translation


def unpainted(names: Iterable[str], seed: int) -> dict[str, Surface]:
    """Surfaces of the right size without pictures, which follow from the seed (test_scene_parts)."""
    sizes = {name: RECIPES[name].metres for name in names}
    return {n: Surface(Material(name=n), None if size is None else (size, size)) for n, size in sizes.items()}


@pytest.mark.slow
def test_the_seed_decides_the_arrays(scene: Scene, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    card, builder = read_scene_card(card_path("scenes", name))
    monkeypatch.setattr("rsbench.scenes.parts.paint_palette", unpainted)
    for mesh, again in zip(scene.meshes, builder.build(card.seed, Path()), strict=True):
        assert mesh.uv is not None and again.uv is not None
        assert np.array_equal(mesh.vertices, again.vertices)
        assert np.array_equal(mesh.uv, again.uv)
    before = {mesh.name: mesh.vertices for mesh in scene.meshes}
    after = {mesh.name: mesh.vertices for mesh in builder.build(card.seed + 1, Path())}
    assert any(not np.array_equal(before[key], after[key]) for key in before.keys() & after.keys())


def write(folder: Path, name: str, old: str, new: str) -> Path:
    text = card_path("scenes", name).read_text()
    assert old in text
    path = folder / f"{name}.toml"
    path.write_text(text.replace(old, new))
    return path


@pytest.mark.parametrize(
    ("card", "old", "new", "message"),
    [
        ("castle", 'builder = "castle"', 'builder = "castel"', "'castel' does not exist (did you mean 'castle'?)"),
        ("castle", 'builder = "castle"', "", "'builder' is required"),
        ("castle", 'builder = "castle"', "builder = 3", "builder = 3: input should be a valid string"),
        ("castle", "trees = 26", "treees = 26", "parameters: unknown key 'treees' (did you mean 'trees'?)"),
        ("castle", "trees = 26", "trees = 2.5", "parameters: trees = 2.5"),
        ("castle", "trees = 26", "trees = 1000", "trees = 1000: allowed are 0 to 60"),
        ("castle", "wall_height = 6.5", "wall_height = nan", "parameters.wall_height = nan"),
        ("castle", "seed = 1", "seed = -1", "seed = -1: allowed are 0 and above"),
        ("castle", "sun_elevation_deg = 48.0", "sun_elevation_deg = -3.0", "sun_elevation_deg = -3.0: allowed"),
        ("castle", "[viewpoints.default]", "[viewpoints.first]", "[viewpoints.default] is required"),
        ("castle", "[viewpoints.default]", "[viewpoints.default]\nup = 1", "unknown key 'viewpoints.default.up'"),
        ("old-town", "storeys = [2, 3]", "storeys = [3, 2]", "storeys = (3, 2): allowed are 1 to 5"),
        ("old-town", "eye = [0.6, -8.0, 3.6]", "eye = [0.6, inf, 3.6]", "viewpoints.default.eye.1"),
        ("old-town", "eye = [0.6, -8.0, 3.6]", "eye = [0.0, 14.0, 3.6]", "viewpoints.default: viewpoint looks"),
        ("room", "chairs = 3 ", "chairs = 9 ", "chairs = 9: allowed are 0 to 4"),
        ("room", "ceiling_height = 2.7", "ceiling_height = 1", "ceiling_height = 1.0: allowed are 2.5 to 4"),
    ],
)
def test_bad_cards_are_refused_in_one_line(tmp_path: Path, card: str, old: str, new: str, message: str) -> None:
    path = write(tmp_path, card, old, new)
    with refused(message, str(path)):
        load_scene(path)


def test_unknown_scenes_are_refused_with_the_known_ones() -> None:
    known = ", ".join(sorted([*DEPTHS, "mesh"]))
    with pytest.raises(RsbenchError, match=f"'atlantis' does not exist; there are: {known}"):
        load_scene("atlantis")
