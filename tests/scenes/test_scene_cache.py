"""Built scenes in the cache: the same arrays again, or none; never a damaged one."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest

from rsbench.dataset.scene_hashes import scene_hash
from rsbench.scenes import load, scene_cache
from rsbench.scenes.load import load_scene, read_scene_card
from rsbench.scenes.model import Material, SceneMesh
from rsbench.scenes.scene_cache import built_key, cached_meshes, keep

KEY = "0123"


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "rsbench" / "scenes"


def _meshes() -> tuple[SceneMesh, ...]:
    """Two that share a material, and one without uv, normals and texture."""
    rng = np.random.default_rng(0)
    painted = Material(name="painted", texture=rng.integers(0, 255, (4, 6, 3), dtype=np.uint8))
    faces = np.array([[0, 1, 2], [2, 1, 3]], dtype=np.int32)
    walls = [
        SceneMesh(
            name=f"wall_{k}",
            vertices=rng.normal(size=(4, 3)),
            faces=faces,
            material=painted,
            uv=rng.random((4, 2)),
            normals=rng.normal(size=(4, 3)),
        )
        for k in range(2)
    ]
    plain = SceneMesh(
        name="plain",
        vertices=rng.normal(size=(3, 3)),
        faces=faces[:1],
        material=Material(name="m", colour=(0.1, 1.0, 0.3)),
    )
    return (*walls, plain)


def test_what_is_kept_is_the_same_to_the_last_bit(cache: Path) -> None:
    meshes = _meshes()
    assert cached_meshes(KEY) is None
    keep(KEY, meshes)
    found = cached_meshes(KEY)
    assert found is not None
    assert [mesh.name for mesh in found] == [mesh.name for mesh in meshes]
    assert found[0].material is found[1].material is not found[2].material
    assert found[2].material == meshes[2].material
    assert found[2].uv is None and found[2].normals is None
    for mesh, expected in zip(found, meshes, strict=True):
        for name in ("vertices", "faces", "uv", "normals"):
            ours, theirs = getattr(mesh, name), getattr(expected, name)
            if theirs is not None:
                assert ours.dtype == theirs.dtype and ours.tobytes() == theirs.tobytes()
    assert found[0].material.texture is not None and meshes[0].material.texture is not None
    assert found[0].material.texture.tobytes() == meshes[0].material.texture.tobytes()


def test_a_damaged_file_is_nothing(cache: Path) -> None:
    keep(KEY, _meshes())
    path = cache / f"{KEY}.npz"
    whole = path.read_bytes()
    for at in range(0, len(whole), 97):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :])
        found = cached_meshes(KEY)
        # A bit of the archive's own fields that nobody reads, such as a date, may go unseen; no array may.
        if found is not None:
            for mesh, expected in zip(found, _meshes(), strict=True):
                assert mesh.vertices.tobytes() == expected.vertices.tobytes()
                assert mesh.faces.tobytes() == expected.faces.tobytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert cached_meshes(KEY) is None


def test_only_the_latest_stay_and_what_was_abandoned_goes(cache: Path) -> None:
    cache.mkdir(parents=True)
    (old := cache / "x.partial").touch()
    (young := cache / "y.partial").touch()
    os.utime(old, (0.0, time.time() - 2 * scene_cache._ABANDONED_S))
    for number in range(scene_cache._MOST + 2):
        keep(str(number), _meshes())
        os.utime(cache / f"{number}.npz", (number, number))
        if number > 0:
            assert cached_meshes("0") is not None  # its use makes it the latest
    assert len(list(cache.glob("*.npz"))) == scene_cache._MOST
    assert cached_meshes("0") is not None and cached_meshes("1") is None
    assert not old.exists() and young.exists()


def test_where_nothing_can_be_kept_scenes_are_built(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for place in (None, tmp_path / "file"):
        monkeypatch.setattr(scene_cache, "user_cache", lambda place=place: place)
        keep(KEY, _meshes())
        assert cached_meshes(KEY) is None


def test_a_scene_is_built_once(cache: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    first = load_scene("corridor")
    monkeypatch.setattr("rsbench.scenes.corridor.CorridorBuilder.build", None)
    second = load_scene("corridor")
    assert scene_hash(first) == scene_hash(second)
    card, builder = read_scene_card(Path(load.__file__).parents[2] / "scenes" / "corridor.toml")
    assert built_key(builder, card.seed) != built_key(builder, card.seed + 1)
