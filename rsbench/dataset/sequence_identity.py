"""Identity of a sequence: the hash of its scene, and all of a card that decides its bytes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from rsbench.components.cards import card_path
from rsbench.core.errors import RsbenchError
from rsbench.dataset.card import DatasetCard, SequenceCard
from rsbench.dataset.sequence import files_of
from rsbench.renderers.options import RendererOptions
from rsbench.scenes.load import SceneCard, built_key, read_scene_card
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
        """The hash of a scene by the name or path of its card; each card is read once."""
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


Plan = dict[str, Any]
"""All that decides the bytes of a sequence, as it stands in its sequence.json; but for the hash of the scene."""


def plans_of(card: DatasetCard, options: RendererOptions) -> dict[str, Plan]:
    """The plan of each sequence by its name.

    Raises:
        RsbenchError: no such scene, viewpoint or mesh, or moving objects with an integrator that has none.
    """
    scenes = lru_cache(maxsize=None)(_scene_card)
    mesh_hash = lru_cache(maxsize=None)(mesh_file_hash)
    return {
        each.name: _plan(card, each, options, scenes(each.scene)) | hashes_of_meshes(each.moving, mesh_hash)
        for each in card.sequence
    }


def of_scene(plan: Plan, sha256: str) -> Plan:
    return plan | {"scene": plan["scene"] | {"sha256": sha256}}


def with_gloss(plan: Plan, glossy: bool) -> Plan:
    """What only the scene says: whether any of its surfaces is glossy."""
    return plan | {"glossy": True} if glossy else plan


def check_same(place: object, manifest: Plan, plan: Plan, scene_sha256: str) -> None:
    """Raise RsbenchError unless the sequence.json of a place was made from this plan and scene."""
    expected = dict.fromkeys(
        ("sensor", "channels", "imu", "matches", "twins", "exposed_twins", "frames", "moving", "meshes")
    )
    expected |= of_scene(plan, scene_sha256)
    other = [key for key, value in expected.items() if manifest.get(key) != value]
    if other:
        raise RsbenchError(
            f"{place}: holds a sequence of another card (differs in {', '.join(other)}); choose another --out"
        )


def hashes_in(manifest: Plan) -> dict[str, Any]:
    """What a sequence.json says of its files: hashes by path, which nobody has checked."""
    listed = manifest.get("files")
    return listed if isinstance(listed, dict) else {}


def wanted_files(manifest: Plan, plan: Plan) -> list[str]:
    """Paths that a sequence of a plan must have, and those that its sequence.json lists; that one apart."""
    needed = files_of(with_gloss(plan, manifest.get("glossy") is True))
    return list({**dict.fromkeys(needed), **hashes_in(manifest)})


def _scene_card(name: str) -> SceneCard:
    return read_scene_card(card_path("scenes", name))[0]


def _plan(card: DatasetCard, sequence: SequenceCard, options: RendererOptions, scene: SceneCard) -> Plan:
    if sequence.viewpoint not in scene.viewpoints:
        names = ", ".join(scene.viewpoints)
        raise RsbenchError(f"scene {sequence.scene}: no viewpoint {sequence.viewpoint!r}; there are: {names}")
    if sequence.moving and (options.integrator != "sunsky" or options.sky_rays):
        raise RsbenchError(
            f"sequence {sequence.name}: moving objects are not for the integrator {options.integrator!r} of the "
            f"renderer {card.renderer} with sky_rays = {options.sky_rays}: take 'sunsky' without sky_rays"
        )
    viewpoint = scene.viewpoints[sequence.viewpoint]
    start = {} if sequence.start is None else {"start": _listed(asdict(sequence.start))}
    return card.manifest_of(sequence) | {
        "scene": {
            "name": scene.name,
            "sha256": "",
            "viewpoint": sequence.viewpoint,
            **_listed(asdict(viewpoint)),
            **start,
        },
        "renderer": _listed(options.record),
        "seed": card.seed_of(sequence),
    }


def _listed(values: dict[str, Any]) -> dict[str, Any]:
    return {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}
