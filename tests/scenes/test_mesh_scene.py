"""Scenes from mesh files: placement, formats and limits, gloss."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from commands import refused
from mesh_scenes import BLUE, GREEN, RED, WHITE, colour_at, load, textured_quad, uv_of
from PIL import Image
from trimesh.visual.material import PBRMaterial

from rsbench.core.errors import RsbenchError
from rsbench.scenes.load import _packed, _unpacked
from rsbench.scenes.model import SceneMesh


def quad_of(folder: Path, more: str = "", material: Any = None) -> SceneMesh:
    """The mesh of a textured quad in a GLB file, by a card with more parameters."""
    textured_quad(material).export(folder / "quad.glb")
    (mesh,) = load(folder, f'file = "quad.glb"\n{more}').meshes
    return mesh


@pytest.mark.parametrize("suffix", ["glb", "obj"])
def test_colours_sit_at_their_corners(tmp_path: Path, suffix: str) -> None:
    quad = textured_quad()
    if suffix == "obj":  # trimesh writes Kd 0.4 of other materials, which would dim the texture
        image = quad.visual.material.baseColorTexture
        quad.visual.material = trimesh.visual.material.SimpleMaterial(image=image, diffuse=[255, 255, 255, 255])
    quad.export(tmp_path / f"quad.{suffix}")
    (mesh,) = load(tmp_path, f'file = "quad.{suffix}"').meshes
    middle = np.array([0.5, 0.5])
    # y up in the file is z up in the scene; a step of a quarter towards the middle stays in the corner's texel.
    corners = {(0, 0, 1): RED, (2, 0, 1): GREEN, (0, 0, 0): WHITE, (2, 0, 0): BLUE}
    for (x, y, z), colour in corners.items():
        uv = uv_of(mesh, (x, y, z))
        assert colour_at(mesh, uv + 0.5 * (middle - uv)) == colour


@pytest.mark.parametrize(("axis", "where"), [("z", (2, 1, 0)), ("y", (2, 0, 1)), ("x", (1, 0, 2))])
def test_up_axis_and_units(tmp_path: Path, axis: str, where: tuple[float, float, float]) -> None:
    mesh = quad_of(tmp_path, f'up_axis = "{axis}"\nmetres_per_unit = 0.25')
    uv_of(mesh, tuple(0.25 * value for value in where))  # pyrefly: ignore[bad-argument-type]
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    assert sorted(high - low) == pytest.approx([0.0, 0.25, 0.5])


def test_heading_turns_about_the_vertical(tmp_path: Path) -> None:
    uv_of(quad_of(tmp_path, "heading_deg = 90.0"), (0.0, 2.0, 1.0))


def test_scene_graph_transforms_are_applied(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    transform = np.eye(4)
    transform[:3, 3] = (10.0, 0.0, 0.0)
    mirrored = np.diag([-3.0, 3.0, 3.0, 1.0])
    scene.add_geometry(textured_quad(), node_name="a", geom_name="quad", transform=transform)
    scene.add_geometry(textured_quad(), node_name="b", geom_name="other", transform=mirrored)
    scene.export(tmp_path / "two.glb")
    meshes = load(tmp_path, 'file = "two.glb"\nup_axis = "z"').meshes
    spans = sorted((float(m.vertices[:, 0].min()), float(m.vertices[:, 0].max())) for m in meshes)
    assert np.ravel(spans) == pytest.approx([-6.0, 0.0, 10.0, 12.0])


def test_smooth_normals_of_a_sphere_point_outward(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.apply_transform(np.diag([1.0, 2.0, 0.5, 1.0]))
    ball.export(tmp_path / "ball.ply")
    (mesh,) = load(tmp_path, 'file = "ball.ply"\nshading = "smooth"').meshes
    assert mesh.normals is not None
    # Normal of x^2 + (y/2)^2 + (z/0.5)^2 = 1 in the file's axes, with y up: scene z is the file's y.
    x, y, z = mesh.vertices.T
    truth = np.stack([x, y / 0.25, z / 4], axis=1)
    truth /= np.linalg.norm(truth, axis=1, keepdims=True)
    # A 320-triangle ellipsoid's vertex normals are a few degrees off where it bends most.
    assert np.min(np.sum(truth * mesh.normals, axis=1)) > np.cos(np.deg2rad(12))


def test_face_colours_survive(tmp_path: Path) -> None:
    box = trimesh.creation.box()
    box.visual.face_colors = [[10 * k, 255 - 10 * k, 7, 255] for k in range(12)]
    box.export(tmp_path / "box.ply")
    (mesh,) = load(tmp_path, 'file = "box.ply"\nup_axis = "z"').meshes
    assert mesh.uv is not None
    corners = mesh.vertices[mesh.faces]
    for triangle, colour in zip(box.triangles, box.visual.face_colors, strict=True):
        k = int(np.argmin(np.abs(corners - triangle).max(axis=(1, 2))))
        assert np.abs(corners[k] - triangle).max() < 1e-6
        assert {colour_at(mesh, uv) for uv in mesh.uv[mesh.faces[k]]} == {tuple(int(c) for c in colour[:3])}


def test_missing_and_broken_files_are_named(tmp_path: Path) -> None:
    (tmp_path / "broken.glb").write_bytes(b"glTF but not really")
    (tmp_path / "odd.xyzabc").write_bytes(b"?")
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "points.ply")
    for name, words in (
        ("absent.glb", "no such file"),
        ("broken.glb", "cannot be read"),
        ("odd.xyzabc", "cannot be read"),
        ("points.ply", "holds no triangles"),
    ):
        with refused(f"{name}: {words}"):
            load(tmp_path, f'file = "{name}"')


def test_a_missing_texture_file_is_named(tmp_path: Path) -> None:
    textured_quad().export(tmp_path / "quad.obj")
    (image,) = [path for path in tmp_path.iterdir() if path.suffix in (".png", ".jpg", ".jpeg")]
    image.unlink()
    with pytest.raises(RsbenchError, match=f"refers to .*{image.name}.*missing"):
        load(tmp_path, 'file = "quad.obj"')


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ("", "parameters: 'file' is required"),
        ('file = "a.glb"\nup_axis = "w"', "parameters: up_axis = 'w'"),
        ('file = "a.glb"\nmetres_per_unit = 0.0', "metres_per_unit = 0.0: must be positive"),
        ('file = "a.glb"\nmetres_per_unit = nan', "parameters.metres_per_unit"),
        ('file = "a.glb"\nunits = "m"', "parameters: unknown key 'units'"),
        ('file = "a.glb"\nsize = 2.0', 'size: needs place = "origin"'),
    ],
)
def test_bad_parameters_are_refused(tmp_path: Path, parameters: str, message: str) -> None:
    with refused(message):
        load(tmp_path, parameters)


# Hostile files


def glb(header: dict[str, Any], binary: bytes = b"") -> bytes:
    """A binary glTF of a header and a buffer."""
    text = json.dumps({"asset": {"version": "2.0"}} | header).encode()
    chunks = b""
    for kind, data in ((b"JSON", text + b" " * (-len(text) % 4)), (b"BIN\0", binary + b"\0" * (-len(binary) % 4))):
        chunks += struct.pack("<I4s", len(data), kind) + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


TRIANGLE: dict[str, Any] = {
    "buffers": [{"byteLength": 36}],
    "bufferViews": [{"buffer": 0, "byteLength": 36}],
    "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
    "nodes": [{"mesh": 0}],
    "scenes": [{"nodes": [0]}],
}
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32).tobytes()


def read(folder: Path, data: bytes, more: str = "") -> SceneMesh:
    """The mesh of a GLB file of these bytes, by a card with more parameters."""
    (folder / "x.glb").write_bytes(data)
    (mesh,) = load(folder, f'file = "x.glb"\n{more}').meshes
    return mesh


def test_a_triangle_of_the_tests_own_making_is_read(tmp_path: Path) -> None:
    assert len(read(tmp_path, glb(TRIANGLE, CORNERS)).faces) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"accessors": [{"componentType": 5126, "count": 10**9, "type": "VEC3"}]}, "values of all accessors"),
        ({"accessors": [{"componentType": 5126, "count": -1, "type": "VEC3"}]}, "count = -1"),
        ({"accessors": [{"componentType": 5126, "count": 3}]}, "KeyError in its header"),
        ({"accessors": [TRIANGLE["accessors"][0] | {"bufferView": 9}]}, "cannot be read: IndexError"),
        ({"nodes": [{}] * 5000}, "nodes: 5000 is more than 4096; if meant, set RSBENCH_LIMITS=2"),
        ({"meshes": [{"primitives": TRIANGLE["meshes"][0]["primitives"] * 5000}]}, "primitives: 5000"),
        ({"meshes": [{"primitives": [{"attributes": {"POSITION": 7}}]}]}, "cannot be read"),
        ({"meshes": 3}, "cannot be read"),
        ({"materials": [{"extensions": {"KHR_materials_pbrSpecularGlossiness": {}}}]}, "metallic-roughness"),
        ({"nodes": [{"children": [k + 1]} for k in range(99)] + [{}]}, "levels of nodes"),
        ({"nodes": [{"children": [1]}, {"children": [0]}]}, "levels of nodes"),
        ({"nodes": [{"children": [1, 1]}, {"mesh": 0}]}, "two parents"),
        ({"nodes": [{"mesh": 0, "scale": [0, 0, 0]}], "shading": "smooth"}, "flattened by its transform"),
        ({"nodes": [{"mesh": 0, "scale": [1e308, 1e308, 1e308]}]}, "vertices"),
    ],
)
def test_headers_that_unfold_or_lie_are_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    shading = change.pop("shading", "flat")
    with refused(message):
        read(tmp_path, glb(TRIANGLE | change, CORNERS), f'shading = "{shading}"')


def test_a_mesh_that_many_nodes_show_counts_each_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rsbench.scenes.mesh._TRIANGLES", 4)
    nodes = {"nodes": [{"mesh": 0}] * 5, "scenes": [{"nodes": list(range(5))}]}
    with refused("triangles: 5 is more than 4"):
        read(tmp_path, glb(TRIANGLE | nodes, CORNERS))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("x.ply", "element vertex 2000000000\nproperty float x\n", "states 2000000000 elements"),
        ("x.ply", "element vertex -5\nproperty float x\n", "states -5 elements"),
        ("x.ply", "element vertex many\nproperty float x\n", "ValueError"),
        ("x.obj", "v 0 0 0\n" + "".join(f"usemtl m{k}\nf 1 1 1\n" for k in range(5000)), "groups: 5000"),
        ("x.obj", "v 0 0 0\n" * 100_000 + "usemtl m\nf 1 1 1\n" * 4000, "vertices times groups"),
        ("x.ply", "comment ascii\nelement vertex 3\n" + "end_header\n" + "\n" * 9000, "3 elements in 900"),
        ("x.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99\n", "x.obj"),
        ("x.obj", "v 0 0 1e308\nv 1e308 0 0\nv 0 1e308 0\nf 1 2 3\n", "vertices"),
        ("x.obj", "v 0 0 1e10\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "vertices beyond 1e+09"),
        ("x.obj", "v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not finite"),
        ("x.zip", "PK", "must end in .glb"),
        ("x.dae", "<a/>", "must end in .glb"),
    ],
)
@pytest.mark.parametrize("shading", ["flat", "smooth"])
def test_texts_that_unfold_or_lie_are_refused(
    tmp_path: Path, name: str, text: str, message: str, shading: str
) -> None:
    if name.endswith(".ply"):
        text = f"ply\nformat binary_little_endian 1.0\n{text}end_header\n"
    (tmp_path / name).write_text(text)
    with refused(message):
        load(tmp_path, f'file = "{name}"\nshading = "{shading}"')


@pytest.mark.parametrize("shading", ["flat", "smooth"])
def test_faces_that_name_no_vertex_are_refused(tmp_path: Path, shading: str) -> None:
    faces = {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"}
    header = TRIANGLE | {
        "buffers": [{"byteLength": 48}],
        "bufferViews": [*TRIANGLE["bufferViews"], {"buffer": 0, "byteOffset": 36, "byteLength": 12}],
        "accessors": [*TRIANGLE["accessors"], faces],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
    }
    data = glb(header, CORNERS + np.array([0, 1, 70_000], np.uint32).tobytes())
    with refused("beyond its 3"):
        read(tmp_path, data, f'shading = "{shading}"')


def test_files_outside_the_models_folder_are_not_read(tmp_path: Path) -> None:
    inner = tmp_path / "inner"
    inner.mkdir()
    (tmp_path / "secret.mtl").write_text("newmtl m\nKd 1 0 0\n")
    (inner / "link.mtl").symlink_to(tmp_path / "secret.mtl")
    (inner / "endless.mtl").symlink_to("/dev/zero")
    for name in ("../secret.mtl", str(tmp_path / "secret.mtl"), "link.mtl", "endless.mtl"):
        (inner / "x.obj").write_text(f"mtllib {name}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m\nf 1 2 3\n")
        with refused("missing or lies outside its folder"):
            load(inner, 'file = "x.obj"')


def test_a_texture_is_measured_before_it_is_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rsbench.scenes.mesh.TEXTURE", 3)
    with refused("2 x 2 pixels: 4 is more than 3"):
        quad_of(tmp_path)
    monkeypatch.setattr("rsbench.scenes.mesh.TEXTURE", 4)
    monkeypatch.setattr("rsbench.scenes.mesh._TEXTURES", 2)
    with refused("pixels of all textures: 4 is more than 2"):
        quad_of(tmp_path)


def _edited(folder: Path, edit: Callable[[dict[str, Any]], None]) -> tuple[SceneMesh, ...]:
    """The meshes of a textured quad whose glTF header was changed."""
    data = textured_quad().export(file_type="glb")
    length = int.from_bytes(data[12:16], "little")
    header = json.loads(data[20 : 20 + length])
    edit(header)
    (folder / "quad.glb").write_bytes(glb(header, data[20 + length + 8 :]))
    return load(folder, 'file = "quad.glb"').meshes


@pytest.mark.parametrize("name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_texture_basisu"])
def test_what_cannot_be_decoded_is_refused_by_name(tmp_path: Path, name: str) -> None:
    with pytest.raises(RsbenchError, match=f"quad.glb: needs the glTF extension {name}"):
        _edited(tmp_path, lambda header: header.update(extensionsRequired=[name]))


def test_meshes_without_data_are_refused(tmp_path: Path) -> None:
    """As a compressed file has them that does not say so; trimesh reads zeros."""

    def strip(header: dict[str, Any]) -> None:
        for accessor in header["accessors"]:
            del accessor["bufferView"]

    with pytest.raises(RsbenchError, match="has meshes without data"):
        _edited(tmp_path, strip)


@pytest.mark.parametrize(
    "uri", ["data:image/png;base64,AAAA", "data:image/png;base64,no base64!", "data:image/png;base64,", "data:,x"]
)
def test_an_image_inside_the_file_that_cannot_be_decoded_is_refused(tmp_path: Path, uri: str) -> None:
    """Trimesh would take grey in its place without a word."""

    with pytest.raises(RsbenchError, match=r"quad\.glb: (image 0: )?cannot be (decoded|read)"):
        _edited(tmp_path, lambda header: header.update(images=[{"uri": uri}]))

    def cut(header: dict[str, Any]) -> None:
        header["bufferViews"][header["images"][0]["bufferView"]]["byteLength"] = 20

    with pytest.raises(RsbenchError, match=r"quad\.glb: image 0: cannot be decoded"):
        _edited(tmp_path, cut)


def test_an_image_inside_the_file_colours_it(tmp_path: Path) -> None:
    Image.new("RGB", (2, 2), (200, 10, 10)).save(tmp_path / "red.png")
    uri = "data:image/png;base64," + base64.b64encode((tmp_path / "red.png").read_bytes()).decode()
    (mesh,) = _edited(tmp_path, lambda header: header.update(images=[{"uri": uri}]))
    assert np.all(np.asarray(mesh.material.texture)[..., 0] > np.asarray(mesh.material.texture)[..., 1])


def test_a_texture_outside_the_folder_of_a_ply_is_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    Image.new("RGB", (2, 2)).save(tmp_path / "outside.png")
    inner = tmp_path / "inner"
    inner.mkdir()
    header = "ply\nformat ascii 1.0\ncomment TextureFile ../outside.png\nelement vertex 3\n"
    header += "".join(f"property float {name}\n" for name in ("x", "y", "z", "s", "t"))
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (inner / "tri.ply").write_text(header + "0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 1\n3 0 1 2\n")
    with pytest.raises(RsbenchError, match=r"refers to \.\./outside\.png, which is missing or lies outside"):
        load(inner, 'file = "tri.ply"')
    assert capfd.readouterr().err == ""


def _transformed(**transform: object) -> Callable[[dict[str, Any]], None]:
    def edit(header: dict[str, Any]) -> None:
        texture = header["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
        texture["extensions"] = {"KHR_texture_transform": transform}

    return edit


def test_textures_are_scaled_turned_and_moved(tmp_path: Path) -> None:
    """Corners by hand, in glTF's coordinates: v down; a quarter turn takes (u, v) to (v, -u)."""
    edit = _transformed(offset=[0.25, 0.125], rotation=np.pi / 2, scale=[2.0, 3.0])
    (mesh,) = _edited(tmp_path, edit)
    corners = {(0, 0, 1): (0.0, 0.0), (2, 0, 1): (1.0, 0.0), (0, 0, 0): (0.0, 1.0), (2, 0, 0): (1.0, 1.0)}
    for (x, y, z), (u, v) in corners.items():
        expected = (3.0 * v + 0.25, 1.0 - (-2.0 * u + 0.125))
        np.testing.assert_allclose(uv_of(mesh, (x, y, z)), expected, atol=1e-6)


def test_a_turn_of_a_texture_is_anticlockwise_in_its_own_picture(tmp_path: Path) -> None:
    """As Blender, Babylon and three.js have it; the matrix printed in the extension's text turns the other way."""
    (mesh,) = _edited(tmp_path, _transformed(rotation=0.1))
    u, v = uv_of(mesh, (2, 0, 1))  # the corner at (1, 0): from +u towards the picture's top, -v
    np.testing.assert_allclose([u, 1.0 - v], [np.cos(0.1), -np.sin(0.1)], atol=1e-6)


def test_transforms_belong_to_materials_by_number(tmp_path: Path) -> None:
    """Materials may have one name or none; three.js#15486."""

    def second(header: dict[str, Any]) -> None:
        header["materials"].append(json.loads(json.dumps(header["materials"][0])))
        _transformed(scale=[2.0, 2.0])(header)
        for material in header["materials"]:
            material.pop("name")
        header["meshes"].append(json.loads(json.dumps(header["meshes"][0])))
        header["meshes"][1]["primitives"][0]["material"] = 1
        header["nodes"].append({"mesh": 1})
        header["nodes"][0].setdefault("children", []).append(len(header["nodes"]) - 1)

    meshes = _edited(tmp_path, second)
    assert sorted(float(np.max(mesh.uv)) for mesh in meshes if mesh.uv is not None) == [1.0, 2.0]
    with refused("'four' uses a second set of coordinates"):
        _edited(tmp_path, _transformed(texCoord=1))


def _wrapped(s: int, t: int, scale: float) -> Callable[[dict[str, Any]], None]:
    def edit(header: dict[str, Any]) -> None:
        header["samplers"] = [{"wrapS": s, "wrapT": t}]
        header["textures"][0]["sampler"] = 0
        _transformed(scale=[scale, scale])(header)

    return edit


def bilinear(texture: np.ndarray, uv: np.ndarray, index: Callable[[np.ndarray, int], np.ndarray]) -> np.ndarray:
    """Colours (n, 3) at uv (n, 2), v up, with a rule that gives the texel of an index beyond the texture."""
    height, width = texture.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1.0 - uv[:, 1]) * height - 0.5
    found = np.zeros((len(uv), 3))
    for dx in (0, 1):
        for dy in (0, 1):
            weight = np.abs(1 - dx - (x - np.floor(x))) * np.abs(1 - dy - (y - np.floor(y)))
            i, j = index(np.floor(x).astype(int) + dx, width), index(np.floor(y).astype(int) + dy, height)
            found += weight[:, None] * texture[j, i]
    return found


def mirrored(index: np.ndarray, size: int) -> np.ndarray:
    return np.where(index % (2 * size) < size, index % size, size - 1 - index % size)


def clamped(index: np.ndarray, size: int) -> np.ndarray:
    return np.clip(index, 0, size - 1)


@pytest.mark.parametrize(("code", "rule", "scale"), [(33648, mirrored, 2.5), (33071, clamped, 1.0)])
def test_wraps_of_textures(tmp_path: Path, code: int, rule: Any, scale: float) -> None:
    """What the renderer looks up, a repeated texture, against the rule of glTF's samplers between corners."""
    (plain,) = _edited(tmp_path, _transformed(scale=[scale, scale]))
    (found,) = _edited(tmp_path, _wrapped(code, code, scale))
    weights = np.random.default_rng(0).dirichlet(np.ones(3), 200)
    texture, expected = found.material.texture, plain.material.texture
    assert texture is not None and expected is not None and plain.uv is not None and found.uv is not None
    there, truth = weights @ found.uv[found.faces[0]], weights @ plain.uv[plain.faces[0]]
    np.testing.assert_allclose(bilinear(texture, there, np.mod), bilinear(expected, truth, rule), atol=1e-9)


def test_coordinates_that_leave_a_clamped_texture_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RsbenchError, match="its texture is clamped, and its coordinates u leave 0 to 1"):
        _edited(tmp_path, _wrapped(33071, 10497, 2.0))


@pytest.mark.parametrize(("mode", "faces"), [(5, 2), (6, None)])
def test_strips_are_drawn_and_fans_refused(tmp_path: Path, mode: int, faces: int | None) -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32)
    header = TRIANGLE | {
        "buffers": [{"byteLength": 48}],
        "bufferViews": [{"buffer": 0, "byteLength": 48}],
        "accessors": [TRIANGLE["accessors"][0] | {"count": 4}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": mode}]}],
    }
    if faces is None:
        with refused("triangle fans (mode 6)"):
            read(tmp_path, glb(header, corners.tobytes()))
    else:
        mesh = read(tmp_path, glb(header, corners.tobytes()))
        found = mesh.vertices[mesh.faces]
        normals = np.cross(found[:, 1] - found[:, 0], found[:, 2] - found[:, 0])
        # A square of area 1, both triangles turning one way (glTF 2.0, 3.7.2.1).
        assert len(found) == faces and np.linalg.norm(normals.sum(axis=0)) == pytest.approx(2.0)


def _with_colours(colours: np.ndarray, material: dict[str, Any] | None, image: bytes = b"") -> bytes:
    """The triangle with COLOR_0, float, and a material, whose texture is ``image``."""
    data, uv = colours.astype(np.float32).tobytes(), np.array([[0, 0], [1, 0], [0, 1]], np.float32).tobytes()
    binary, views = CORNERS, list(TRIANGLE["bufferViews"])
    for part in (data, uv, image):
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(part)})
        binary += part + b"\0" * (-len(part) % 4)
    width = f"VEC{colours.shape[1]}"
    accessors = [
        *TRIANGLE["accessors"],
        {"bufferView": 1, "componentType": 5126, "count": 3, "type": width},
        {"bufferView": 2, "componentType": 5126, "count": 3, "type": "VEC2"},
    ]
    primitive: dict[str, Any] = {"attributes": {"POSITION": 0, "COLOR_0": 1, "TEXCOORD_0": 2}}
    header = TRIANGLE | {
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [{"primitives": [primitive | ({} if material is None else {"material": 0})]}],
    }
    if material is not None:
        header |= {"materials": [material]}
    if image:
        header |= {"images": [{"bufferView": 3, "mimeType": "image/png"}], "textures": [{"source": 0}]}
    return glb(header, binary)


def test_vertex_colours_of_a_gltf_are_linear_and_multiply(tmp_path: Path) -> None:
    """0.5 linear is 188 in sRGB, 0.25 is 137 (IEC 61966-2-1); glTF#1224, #1225."""
    half = np.full((3, 3), 0.5)
    Image.new("RGB", (2, 2), (255, 255, 255)).save(tmp_path / "white.png")
    white = (tmp_path / "white.png").read_bytes()
    factor = {"pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.5, 0.5, 1.0]}}
    textured = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    for material, image, level in ((None, b"", 188), (factor, b"", 137), (textured, white, 188)):
        mesh = read(tmp_path, _with_colours(half, material, image))
        texture = mesh.material.texture
        found = 255.0 * np.asarray(mesh.material.colour) if texture is None else texture[0, 0]
        np.testing.assert_allclose(found, level, atol=1.0)
    mixed = np.array([[1.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, 0.0]])
    mesh = read(tmp_path, _with_colours(mixed, None))  # one triangle, the mean of its corners
    np.testing.assert_allclose(255.0 * np.asarray(mesh.material.colour), [188.0, 0.0, 0.0], atol=1.0)


def test_vertex_colours_that_cannot_be_drawn_are_refused(tmp_path: Path) -> None:
    for colours, material, words in (
        (np.full((3, 3), 2.0), None, "between 0 and 1"),
        (np.full((3, 4), 0.5), {"alphaMode": "BLEND"}, "is transparent"),
    ):
        with refused(words):
            read(tmp_path, _with_colours(colours, material))


def test_factors_of_a_gltf_are_exact(tmp_path: Path) -> None:
    """Trimesh keeps them as bytes, where 0.001 is 0; it is 12.92 times that in sRGB."""

    def dark(header: dict[str, Any]) -> None:
        header["materials"][0]["pbrMetallicRoughness"] = {"baseColorFactor": [0.001, 0.001, 0.001, 1.0]}

    (mesh,) = _edited(tmp_path, dark)
    np.testing.assert_allclose(mesh.material.colour, 0.01292, rtol=1e-9)


def test_files_beside_a_gltf_are_named_by_uris(tmp_path: Path) -> None:
    """Blanks as %20 (glTF#1449)."""
    Image.new("RGB", (2, 2), RED).save(tmp_path / "my tex.png")
    (mesh,) = _edited(tmp_path, lambda header: header.update(images=[{"uri": "my%20tex.png"}]))
    assert mesh.material.texture is not None and tuple(mesh.material.texture[0, 0]) == RED


@pytest.mark.parametrize("scale", [[1.0, 1.0, 1.0], [-1.0, 1.0, 1.0], [-2.0, -1.0, -3.0]])
def test_smooth_normals_of_a_mirror_are_on_the_side_of_the_face(tmp_path: Path, scale: list[float]) -> None:
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.icosphere(1), transform=np.diag([*scale, 1.0]))
    scene.export(tmp_path / "ball.glb")
    (mesh,) = load(tmp_path, 'file = "ball.glb"\nshading = "smooth"').meshes
    assert mesh.normals is not None
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    facing = np.cross(b - a, c - a)
    assert np.all(np.sum(facing * a, axis=1) > 0.0)  # outward
    assert np.all(np.sum(facing * mesh.normals[mesh.faces[:, 0]], axis=1) > 0.0)


@pytest.mark.parametrize("mode", ["MASK", "BLEND"])
@pytest.mark.parametrize("alpha", [0, 255])
def test_holes_in_a_texture_are_refused_or_filled(tmp_path: Path, mode: str, alpha: int) -> None:
    image = Image.fromarray(np.array([[(*RED, 255), (*GREEN, alpha)]], dtype=np.uint8))
    leaf = PBRMaterial(baseColorTexture=image, name="leaf", alphaMode=mode)
    if alpha == 0:
        with refused("is transparent, and only opaque surfaces are rendered"):
            quad_of(tmp_path, material=leaf)
    mesh = quad_of(tmp_path, f'transparent = "{"opaque" if alpha == 0 else "refuse"}"', leaf)
    assert mesh.material.texture is not None and tuple(mesh.material.texture[0, 1]) == GREEN


_TRIANGLE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\n"


def _obj(folder: Path, faces: str, library: str, encoding: str = "utf-8") -> SceneMesh:
    """The mesh of a triangle in an OBJ file with a library of materials."""
    (folder / "a.obj").write_bytes(f"mtllib a.mtl\n{_TRIANGLE}{faces}f 1/1 2/2 3/3\n".encode(encoding))
    (folder / "a.mtl").write_bytes(library.encode(encoding))
    (mesh,) = load(folder, 'file = "a.obj"').meshes
    return mesh


def test_an_obj_of_an_old_windows_exporter_is_read(tmp_path: Path) -> None:
    """Names in Latin-1, and a texture by a path with backslashes."""
    (tmp_path / "tex").mkdir()
    Image.new("RGB", (4, 4), RED).save(tmp_path / "tex" / "w.png")
    mesh = _obj(tmp_path, "usemtl größe\n", "newmtl größe\nmap_Kd tex\\w.png\n", "latin-1")
    assert mesh.material.name == "größe"
    assert mesh.material.texture is not None and tuple(mesh.material.texture[0, 0]) == RED


def test_an_obj_whose_material_is_missing_or_transparent_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RsbenchError, match=r"usemtl q: its \.mtl has no such material"):
        _obj(tmp_path, "usemtl q\n", "newmtl m\nKd 1 0 0\n")
    with pytest.raises(RsbenchError, match="is transparent"):
        _obj(tmp_path, "usemtl m\n", "newmtl m\nKd 1 0 0\nd 0.5\n")
    # Without usemtl there is no material to miss.
    assert len(_obj(tmp_path, "", "newmtl m\nKd 1 0 0\n").faces) == 1


def test_a_model_of_any_size_and_place_is_framed(tmp_path: Path) -> None:
    """A box far from its file's origin, in millimetres: over the scene's origin, two metres at its longest."""
    crate = trimesh.creation.box((400.0, 1000.0, 250.0))
    crate.apply_translation((5000.0, -300.0, 7000.0))
    crate.export(tmp_path / "crate.glb")
    parameters = 'file = "crate.glb"\nplace = "origin"\nsize = 2.0\nground = true\nbackdrop = true'
    model, *around = load(tmp_path, parameters).meshes
    np.testing.assert_allclose(model.vertices.min(axis=0), (-0.4, -0.25, 0.0), atol=1e-6)
    np.testing.assert_allclose(model.vertices.max(axis=0), (0.4, 0.25, 2.0), atol=1e-6)
    walls, floor = around
    assert floor.vertices[:, 2].max() < 0.0 == model.vertices[:, 2].min()
    # Walls all around, four sizes away, taller than the model; the ground reaches beyond them.
    assert np.abs(walls.vertices[:, :2]).max(axis=1).min() == pytest.approx(8.0, abs=1e-5)
    assert walls.vertices[:, 2].max() > 3.9
    np.testing.assert_allclose(np.ptp(floor.vertices[:, :2], axis=0), 32.0, atol=1e-5)


@pytest.mark.parametrize("more", ["size = 2.0", "ground = true"])
def test_a_model_without_extent_is_refused(tmp_path: Path, more: str) -> None:
    trimesh.Trimesh([[1, 2, 3]] * 3, [[0, 1, 2]], process=False).export(tmp_path / "dot.glb")
    with pytest.raises(RsbenchError, match=r"dot\.glb: all of it lies in one point"):
        load(tmp_path, f'file = "dot.glb"\nplace = "origin"\n{more}')


def roughness(folder: Path, gloss: str, **material: Any) -> float | None:
    made = PBRMaterial(name="m", baseColorFactor=[200, 100, 50, 255], **material)
    return quad_of(folder, f'gloss = "{gloss}"', made).material.roughness


@pytest.mark.parametrize(("stated", "taken"), [(0.2, 0.2), (0.0, 0.05), (0.5, 0.5), (0.7, None), (None, None)])
def test_a_coat_is_as_rough_as_the_file_says(tmp_path: Path, stated: float | None, taken: float | None) -> None:
    """A mirror is the smoothest coat; what is rougher than a half, or says nothing, which is 1, is diffuse."""
    found = roughness(tmp_path, "file", metallicFactor=0.0, roughnessFactor=stated)
    assert found == (None if taken is None else pytest.approx(taken))
    assert roughness(tmp_path, "none", metallicFactor=0.0, roughnessFactor=stated) is None


def test_metal_and_maps_are_refused(tmp_path: Path) -> None:
    for metal in (1.0, None):
        with pytest.raises(RsbenchError, match=r"part .* is metal \(metallicFactor = 1\).*leave gloss out"):
            roughness(tmp_path, "file", metallicFactor=metal, roughnessFactor=0.2)
    image = Image.new("RGB", (2, 2), (0, 90, 0))
    with pytest.raises(RsbenchError, match=r"part .* has a map of roughness.*leave gloss out"):
        roughness(tmp_path, "file", metallicFactor=0.0, metallicRoughnessTexture=image)


def test_the_cache_keeps_roughness(tmp_path: Path) -> None:
    mesh = quad_of(tmp_path, 'gloss = "file"', PBRMaterial(name="m", metallicFactor=0.0, roughnessFactor=0.2))
    (again,) = _unpacked(_packed((mesh,)))
    assert again.material == mesh.material


def test_texture_coordinates_of_faces_in_a_ply(tmp_path: Path) -> None:
    """As MeshLab writes them; one corner has two coordinates, at a seam."""
    Image.fromarray(np.array([[RED, GREEN], [WHITE, BLUE]], dtype=np.uint8)).save(tmp_path / "t.png")
    (tmp_path / "m.ply").write_text(
        "ply\nformat ascii 1.0\ncomment TextureFile t.png\nelement vertex 4\nproperty float x\nproperty float y\n"
        "property float z\nelement face 2\nproperty list uchar int vertex_indices\n"
        "property list uchar float texcoord\nend_header\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n"
        "3 0 1 2 6 0 0 1 0 1 1\n3 0 2 3 6 .25 .75 .25 .75 .25 .75\n"
    )
    (mesh,) = load(tmp_path, 'file = "m.ply"').meshes
    assert mesh.uv is not None
    np.testing.assert_allclose(mesh.uv[mesh.faces[0]], [[0, 0], [1, 0], [1, 1]], atol=1e-6)
    np.testing.assert_allclose(mesh.uv[mesh.faces[1]], [[0.25, 0.75]] * 3, atol=1e-6)
    assert colour_at(mesh, mesh.uv[mesh.faces[1]][0]) == RED


U_SHAPE = [(0, 0), (4, 0), (4, 4), (3, 4), (3, 1), (1, 1), (1, 4), (0, 4)]


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("tilt", [0.0, 1.2])
def test_polygons_that_are_not_convex_keep_their_area(tmp_path: Path, order: int, tilt: float) -> None:
    """A U of area 10, of which a fan covers 19 (trimesh#2519); and an arrowhead of four corners, area 1."""
    text, arrow = "", [(0, 0), (2, 1), (0, 2), (1, 1)]
    for outline in (U_SHAPE, arrow):
        turned = [(x * np.cos(tilt), y, x * np.sin(tilt)) for x, y in outline]
        text += "".join(f"v {x} {y} {z}\n" for x, y, z in turned)
        text += "f " + " ".join(str(-k) for k in range(1, len(outline) + 1)[::order]) + "\n"
    (tmp_path / "u.obj").write_text(text)
    (mesh,) = load(tmp_path, 'file = "u.obj"\nup_axis = "z"').meshes
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normals = 0.5 * np.cross(b - a, c - a)
    assert np.linalg.norm(normals, axis=1).sum() == pytest.approx(11.0)
    # All triangles turn as their polygons do.
    area = abs(normals.sum(axis=0) @ [-np.sin(tilt), 0.0, np.cos(tilt)])
    assert area in (pytest.approx(11.0), pytest.approx(9.0))


def test_textures_of_an_mtl_are_dimmed_scaled_and_clamped(tmp_path: Path) -> None:
    """Kd under map_Kd multiplies (Online3DViewer#371); -s, -o and -clamp on are read; names may have blanks."""
    Image.new("RGB", (4, 4), (255, 255, 255)).save(tmp_path / "a b.png")
    library = "newmtl m\nKd 0.5 0.5 0.5\nmap_Kd -s 10 20 1 -o 0.5 -bm 1 a b.png\n"
    mesh = _obj(tmp_path, "usemtl m\n", library)
    assert mesh.material.texture is not None and mesh.uv is not None
    np.testing.assert_allclose(mesh.material.texture, 128, atol=1)
    np.testing.assert_allclose(np.sort(mesh.uv, axis=0), [[0.5, 0], [10.5, 0], [10.5, 20]], atol=1e-9)
    with pytest.raises(RsbenchError, match="its texture is clamped"):
        _obj(tmp_path, "usemtl m\n", "newmtl m\nmap_Kd -clamp on -s 10 10 10 a b.png\n")
    with pytest.raises(RsbenchError, match=r"a\.mtl:2: -mm changes the colours"):
        _obj(tmp_path, "usemtl m\n", "newmtl m\nmap_Kd -mm 0 2 a b.png\n")
