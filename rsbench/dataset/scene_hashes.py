"""Hashes of scenes: what decides a render besides camera, motion and options."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from rsbench.components.cards import card_path
from rsbench.core.errors import RsbenchError
from rsbench.scenes.load import built_key, read_scene_card
from rsbench.scenes.model import Scene, SceneMesh
from rsbench.scenes.object_meshes import Body, MeshFile
from rsbench.storage.files import read_json, write_json


def scene_hash(scene: Scene) -> str:
    """Hash of all that is rendered of a scene: geometry, materials and light."""
    digest = hashlib.sha256()
    digest.update(repr(scene.light).encode())
    if scene.light.environment is not None:
        digest.update(scene.light.environment.radiance.tobytes())
        digest.update(scene.light.environment.frame_from_map.tobytes())
    for part in _bytes_of(scene.meshes):
        digest.update(part)
    return digest.hexdigest()


def mesh_file_hash(mesh: MeshFile) -> str:
    """The same of a mesh file that moves, by itself; RsbenchError where it cannot be read."""
    return hashlib.sha256(b"".join(_bytes_of(mesh.meshes()))).hexdigest()


def hashes_of_meshes(moving: Sequence[Body], mesh_hash: Callable[[MeshFile], str]) -> dict[str, Any]:
    """What a sequence.json says of the mesh files of its objects: ``meshes``, where there are any."""
    hashes = {str(number): mesh_hash(each.mesh) for number, each in enumerate(moving, start=1) if each.mesh}
    return {"meshes": hashes} if hashes else {}


def _bytes_of(meshes: Sequence[SceneMesh]) -> Iterator[bytes]:
    for mesh in meshes:
        yield f"{mesh.name}/{mesh.material.name}/{mesh.material.colour}".encode()
        if mesh.material.roughness is not None:
            yield f"/{mesh.material.roughness}".encode()
        for array in (mesh.vertices, mesh.faces, mesh.uv, mesh.normals, mesh.material.texture):
            yield b"-" if array is None else np.ascontiguousarray(array).tobytes()


class SceneHashes:
    """Hashes of scenes; not built again where the card and our code say all."""

    def __init__(self, store: Path, build: Callable[[str], str]) -> None:
        """
        Args:
            store: JSON file of what was built before; need not exist.
            build: builds the scene of a name and returns the hash.
        """
        self._store, self._build = store, build
        self._by_name: dict[str, str] = {}
        try:
            self._known: dict[str, Any] = read_json(store)
        except RsbenchError:
            self._known = {}

    def of(self, name: str) -> str:
        """By the name or path of a scene card; each is looked at once."""
        if name not in self._by_name:
            self._by_name[name] = self._find(name)
        return self._by_name[name]

    def _find(self, name: str) -> str:
        key = scene_key(name)
        if key is None:
            return self._build(name)
        if key not in self._known:
            self._known[key] = self._build(name)
            write_json(self._store, self._known)
        return str(self._known[key])


def scene_key(name: str) -> str | None:
    """Equal keys are equal scenes on one machine; None when files or other packages' code decide too."""
    card, builder = read_scene_card(card_path("scenes", name))
    key = built_key(builder, card.seed)
    if key is None or card.light.environment:
        return None
    return hashlib.sha256(json.dumps([key, asdict(card)], sort_keys=True).encode()).hexdigest()
