"""The mesh builder against what exporters write: glTF extensions, alpha, old OBJ files; and where models stand."""

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
from mesh_scenes import GREEN, RED, load, textured_quad, uv_of
from PIL import Image

from rsbench.core.errors import RsbenchError


def _edited(folder: Path, edit: Callable[[dict[str, Any]], None]) -> str:
    """Parameters of a textured quad whose glTF header was changed."""
    textured_quad().export(folder / "quad.glb")
    data = (folder / "quad.glb").read_bytes()
    length = int.from_bytes(data[12:16], "little")
    header = json.loads(data[20 : 20 + length])
    edit(header)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    chunk = struct.pack("<I", len(text)) + b"JSON" + text
    (folder / "quad.glb").write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunk) + len(rest)) + chunk + rest)
    return 'file = "quad.glb"'


@pytest.mark.parametrize("name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_texture_basisu"])
def test_what_cannot_be_decoded_is_refused_by_name(tmp_path: Path, name: str) -> None:
    with pytest.raises(RsbenchError, match=f"quad.glb: needs the glTF extension {name}"):
        load(tmp_path, _edited(tmp_path, lambda header: header.update(extensionsRequired=[name])))


def test_meshes_without_data_are_refused(tmp_path: Path) -> None:
    """As a compressed file has them that does not say so; trimesh reads zeros."""

    def strip(header: dict[str, Any]) -> None:
        for accessor in header["accessors"]:
            del accessor["bufferView"]

    with pytest.raises(RsbenchError, match="has meshes without data"):
        load(tmp_path, _edited(tmp_path, strip))


@pytest.mark.parametrize(
    "uri", ["data:image/png;base64,AAAA", "data:image/png;base64,no base64!", "data:image/png;base64,", "data:,x"]
)
def test_an_image_inside_the_file_that_cannot_be_decoded_is_refused(tmp_path: Path, uri: str) -> None:
    """Trimesh would take grey in its place without a word."""

    def put(header: dict[str, Any]) -> None:
        header["images"] = [{"uri": uri}]

    with pytest.raises(RsbenchError, match=r"quad\.glb: (image 0: )?cannot be (decoded|read)"):
        load(tmp_path, _edited(tmp_path, put))

    def cut(header: dict[str, Any]) -> None:
        header["bufferViews"][header["images"][0]["bufferView"]]["byteLength"] = 20

    with pytest.raises(RsbenchError, match=r"quad\.glb: image 0: cannot be decoded"):
        load(tmp_path, _edited(tmp_path, cut))


def test_an_image_inside_the_file_colours_it(tmp_path: Path) -> None:
    Image.new("RGB", (2, 2), (200, 10, 10)).save(tmp_path / "red.png")
    uri = "data:image/png;base64," + base64.b64encode((tmp_path / "red.png").read_bytes()).decode()
    mesh = load(tmp_path, _edited(tmp_path, lambda header: header.update(images=[{"uri": uri}]))).meshes[0]
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
    (mesh,) = load(tmp_path, _edited(tmp_path, edit)).meshes
    corners = {(0, 0, 1): (0.0, 0.0), (2, 0, 1): (1.0, 0.0), (0, 0, 0): (0.0, 1.0), (2, 0, 0): (1.0, 1.0)}
    for (x, y, z), (u, v) in corners.items():
        expected = (3.0 * v + 0.25, 1.0 - (-2.0 * u + 0.125))
        np.testing.assert_allclose(uv_of(mesh, (x, y, z)), expected, atol=1e-6)


def test_a_turn_of_a_texture_is_anticlockwise_in_its_own_picture(tmp_path: Path) -> None:
    """As Blender, Babylon and three.js have it; the matrix printed in the extension's text turns the other way."""
    (mesh,) = load(tmp_path, _edited(tmp_path, _transformed(rotation=0.1))).meshes
    u, v = uv_of(mesh, (2, 0, 1))  # the corner at (1, 0): from +u towards the picture's top, -v
    np.testing.assert_allclose([u, 1.0 - v], [np.cos(0.1), -np.sin(0.1)], atol=1e-6)


def test_transforms_that_cannot_be_told_apart_are_refused(tmp_path: Path) -> None:
    def twice(header: dict[str, Any]) -> None:
        header["materials"].append(json.loads(json.dumps(header["materials"][0])))
        _transformed(scale=[2.0, 2.0])(header)

    with pytest.raises(RsbenchError, match="materials of the name 'four' have several KHR_texture_transform"):
        load(tmp_path, _edited(tmp_path, twice))
    with pytest.raises(RsbenchError, match="'four' uses a second set of coordinates"):
        load(tmp_path, _edited(tmp_path, _transformed(texCoord=1)))


@pytest.mark.parametrize("mode", ["MASK", "BLEND"])
@pytest.mark.parametrize("alpha", [0, 255])
def test_holes_in_a_texture_are_refused_or_filled(tmp_path: Path, mode: str, alpha: int) -> None:
    image = Image.fromarray(np.array([[(*RED, 255), (*GREEN, alpha)]], dtype=np.uint8))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image, name="leaf", alphaMode=mode)
    textured_quad(material).export(tmp_path / "leaf.glb")
    if alpha == 0:
        with pytest.raises(RsbenchError, match="is transparent, and only opaque surfaces are rendered"):
            load(tmp_path, 'file = "leaf.glb"')
    (mesh,) = load(tmp_path, f'file = "leaf.glb"\ntransparent = "{"opaque" if alpha == 0 else "refuse"}"').meshes
    assert mesh.material.texture is not None and tuple(mesh.material.texture[0, 1]) == GREEN


_TRIANGLE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\n"


def _obj(folder: Path, faces: str, library: str, encoding: str = "utf-8") -> str:
    (folder / "a.obj").write_bytes(f"mtllib a.mtl\n{_TRIANGLE}{faces}f 1/1 2/2 3/3\n".encode(encoding))
    (folder / "a.mtl").write_bytes(library.encode(encoding))
    return 'file = "a.obj"'


def test_an_obj_of_an_old_windows_exporter_is_read(tmp_path: Path) -> None:
    """Names in Latin-1, and a texture by a path with backslashes."""
    (tmp_path / "tex").mkdir()
    Image.new("RGB", (4, 4), RED).save(tmp_path / "tex" / "w.png")
    library = "newmtl größe\nmap_Kd tex\\w.png\n"
    (mesh,) = load(tmp_path, _obj(tmp_path, "usemtl größe\n", library, "latin-1")).meshes
    assert mesh.material.name == "größe"
    assert mesh.material.texture is not None and tuple(mesh.material.texture[0, 0]) == RED


def test_an_obj_whose_material_is_missing_or_transparent_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RsbenchError, match=r"usemtl q: its \.mtl has no such material"):
        load(tmp_path, _obj(tmp_path, "usemtl q\n", "newmtl m\nKd 1 0 0\n"))
    with pytest.raises(RsbenchError, match="is transparent"):
        load(tmp_path, _obj(tmp_path, "usemtl m\n", "newmtl m\nKd 1 0 0\nd 0.5\n"))
    # Without usemtl there is no material to miss.
    (mesh,) = load(tmp_path, _obj(tmp_path, "", "newmtl m\nKd 1 0 0\n")).meshes
    assert len(mesh.faces) == 1


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


def test_a_size_without_a_place_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RsbenchError, match='size: needs place = "origin"'):
        load(tmp_path, 'file = "crate.glb"\nsize = 2.0')


@pytest.mark.parametrize("more", ["size = 2.0", "ground = true"])
def test_a_model_without_extent_is_refused(tmp_path: Path, more: str) -> None:
    trimesh.Trimesh([[1, 2, 3]] * 3, [[0, 1, 2]], process=False).export(tmp_path / "dot.glb")
    with pytest.raises(RsbenchError, match=r"dot\.glb: all of it lies in one point"):
        load(tmp_path, f'file = "dot.glb"\nplace = "origin"\n{more}')
