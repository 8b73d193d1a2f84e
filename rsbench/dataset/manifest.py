"""dataset.json and croissant.json: the card of a dataset and the files of all of its sequences.

A sequence is identified by the hash of its scene and all settings of the card that affect its bytes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from rsbench.components.cards import card_path
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import FRAMES
from rsbench.core.version import RELEASED, __version__
from rsbench.dataset.card import DatasetCard, SequenceCard
from rsbench.dataset.sequence import UNITS, files_of, format_of
from rsbench.renderers.options import RendererOptions
from rsbench.scenes.load import SceneCard, built_key, read_scene_card
from rsbench.scenes.model import Scene, SceneMesh
from rsbench.scenes.object_meshes import Body, MeshFile
from rsbench.storage.files import HashedFile, read_json, sha256, write_json
from rsbench.storage.untrusted_files import read_bytes

CROISSANT = "croissant.json"
_WORDS = """citeAs column equivalentProperty extract field fileObject fileProperty fileSet format includes
isLiveDataset jsonPath key md5 parentField path recordSet references regex repeated replace samplingRate separator
source subField transform"""
_KINDS = {
    ".png": "image/png",
    ".exr": "image/x-exr",
    ".csv": "text/csv",
    ".npz": "application/x-npz",
    ".json": "application/json",
}
_WHERE = "https://github.com/rsbench/rsbench"
_SEQUENCE = r"(?:.*[/\\])?([^/\\]+)[/\\]%s[/\\][^/\\]+$"
_SIDE, _FRAME = r".*[/\\](left|right)_[0-9]+\.[a-z]+$", r".*_([0-9]+)\.[a-z]+$"
"""Patterns that match whole paths, from their beginning."""
_POSE = {name: "sc:Float" for name in ("tau", "qw", "qx", "qy", "qz", "tx", "ty", "tz")}


def croissant_of(manifest: Mapping[str, Any], sha256: str) -> dict[str, Any]:
    """Return the content of croissant.json; ``manifest`` and ``sha256`` belong to the dataset.json beside it."""
    return {
        "@context": _context(),
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": manifest["name"],
        "description": manifest["description"]
        or f"Rolling-shutter stereo, made by rsbench from {manifest['name']}",
        "license": f"https://spdx.org/licenses/{manifest['license']}.html",
        "creator": {"@type": "sc:Organization", "name": "The rsbench developers", "url": _WHERE},
        "url": _WHERE,
        "version": manifest["rsbench"],
        "datePublished": RELEASED,
        "citeAs": f"The rsbench developers. rsbench {manifest['rsbench']}: dataset {manifest['name']}. {_WHERE}",
        "keywords": ["rolling shutter", "stereo", "relative pose", "synthetic data"],
        "isLiveDataset": False,
        "distribution": [_manifest_file(sha256), *_file_sets(manifest["files"])],
        "recordSet": [_sequences(), _frames(), _rows()],
    }


def _context() -> dict[str, Any]:
    """Return the context that the specification requires, including terms that are not used here."""
    return {
        "@language": "en",
        "@vocab": "https://schema.org/",
        "cr": "http://mlcommons.org/croissant/",
        "dct": "http://purl.org/dc/terms/",
        "rai": "http://mlcommons.org/croissant/RAI/",
        "sc": "https://schema.org/",
        "conformsTo": "dct:conformsTo",
        **{word: f"cr:{word}" for word in _WORDS.split()},
        "data": {"@id": "cr:data", "@type": "@json"},
        "examples": {"@id": "cr:examples", "@type": "@json"},
        "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    }


def _manifest_file(sha256: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": "dataset.json",
        "name": "dataset.json",
        "description": "Card of the dataset; size and SHA-256 of every file of its sequences.",
        "contentUrl": "dataset.json",
        "encodingFormat": "application/json",
        "sha256": sha256,
    }


def _file_sets(files: Iterable[str]) -> list[dict[str, Any]]:
    """Return a file set for each folder of a sequence and file type; ``files`` are SEQUENCE/[FOLDER/...]NAME."""
    names, taken = dict[str, str](), set[str]()
    for file in files:
        place, *below = PurePosixPath(file).parts[1:]
        end = PurePosixPath(file).suffix
        pattern = "/".join([place, *["*"] * (len(below) - 1), f"*{end}"]) if below else place
        if pattern not in names:
            names[pattern] = f"{place}{end}" if place in taken else place
            taken.add(place)
    return [
        {
            "@type": "cr:FileSet",
            "@id": name,
            "name": name,
            "description": f"Files {pattern} of every sequence: see `rsbench docs dataset-format`.",
            "encodingFormat": _KINDS[PurePosixPath(pattern).suffix],
            "includes": f"*/{pattern}",
        }
        for pattern, name in names.items()
    ]


def _table(name: str, description: str, fields: list[dict[str, Any]]) -> dict[str, Any]:
    own = [{**each, "@id": f"{name}/{each['name']}"} for each in fields]
    return {"@type": "cr:RecordSet", "@id": name, "name": name, "description": description, "field": own}


def _field(name: str, description: str, kind: str, source: dict[str, Any]) -> dict[str, Any]:
    return {"@type": "cr:Field", "name": name, "description": description, "dataType": kind, "source": source}


def _sequences() -> dict[str, Any]:
    def of(path: str) -> dict[str, Any]:
        return {"fileObject": {"@id": "dataset.json"}, "extract": {"jsonPath": path}}

    fields = [
        _field("name", "Name of the sequence and of its folder.", "sc:Text", of("card.sequence[*].name")),
        _field("scene", "Name of its scene.", "sc:Text", of("card.sequence[*].scene")),
    ]
    return _table("sequences", "Each sequence and its scene.", fields)


def _of_path(folder: str) -> list[dict[str, Any]]:
    def of(regex: str) -> dict[str, Any]:
        where = {"fileSet": {"@id": folder}, "extract": {"fileProperty": "fullpath"}}
        return {**where, "transform": {"regex": regex}}

    return [
        _field("sequence", "Name of the sequence.", "sc:Text", of(_SEQUENCE % folder)),
        _field("side", "Camera: left or right.", "sc:Text", of(_SIDE)),
        _field("frame", "Number of the frame, from 0.", "sc:Integer", of(_FRAME)),
    ]


def _frames() -> dict[str, Any]:
    source = {"fileSet": {"@id": "rs"}, "extract": {"fileProperty": "content"}}
    image = _field("image", "The rolling-shutter frame, 8-bit sRGB.", "sc:ImageObject", source)
    return _table("frames", "Each rolling-shutter frame of each camera.", [*_of_path("rs"), image])


def _rows() -> dict[str, Any]:
    def of(column: str) -> dict[str, Any]:
        return {"fileSet": {"@id": "poses"}, "extract": {"column": column}}

    columns = {"row": "sc:Integer", **_POSE}
    own = [_field(name, f"Column {name} of poses/*.csv.", kind, of(name)) for name, kind in columns.items()]
    text = "Pose of the camera (cam_from_world, metres) at each row's time tau (frame periods) of each frame."
    return _table("rows", text, [*_of_path("poses"), *own])


DATASET = "dataset.json"
Files = dict[str, HashedFile]
"""The files of a sequence by their paths below its folder, in the order of dataset.json."""


def write_manifest(card: DatasetCard, out: Path, made: Mapping[str, Files]) -> None:
    """Write dataset.json and croissant.json unless unchanged; ``made`` are the files of each sequence."""
    content = manifest_of(card, made)
    _write(out / DATASET, content)
    _write(out / CROISSANT, croissant_of(content, sha256(out / DATASET)))


def _write(path: Path, content: dict[str, Any]) -> None:
    try:
        stands = says(read_bytes(path), content)
    except RsbenchError:
        stands = False
    if not stands:
        write_json(path, content)


def manifest_of(card: DatasetCard, made: Mapping[str, Files]) -> dict[str, Any]:
    """Return the content of dataset.json; ``made`` as for ``write_manifest``."""
    files = {
        f"{sequence.name}/{name}": {"sha256": file.sha256, "size": file.size}
        for sequence in card.sequence
        for name, file in made[sequence.name].items()
    }
    return {
        "format": max(format_of(card.rig_of(each), card.shutter_for(each)) for each in card.sequence),
        "name": card.name,
        "description": card.description,
        "license": card.license,
        "rsbench": __version__,
        "mitsuba": version("mitsuba"),
        "units": UNITS,
        "card": _record(card),
        "sequences": [sequence.name for sequence in card.sequence],
        "files": files,
    }


def says(data: bytes, content: dict[str, Any]) -> bool:
    """Return whether a file already has this content; reading a large file is much faster than rewriting it."""
    try:
        return bool(json.loads(data) == json.loads(json.dumps(content)))
    except (ValueError, RecursionError):
        return False


def _record(card: DatasetCard) -> dict[str, Any]:
    """Return the complete card, without newer keys at their defaults and without ``frames`` if there are two."""
    own = _without_new_keys(asdict(card))
    if card.camera is not None and card.camera.lens is not None:
        own["camera"]["lens"] = card.camera.lens.record()
    absent = {key for key in ("camera", "baseline", "readout_ratio") if own[key] is None}
    absent |= {"frames"} if card.frames == len(FRAMES) else set()
    return {key: value for key, value in own.items() if key not in absent}


def _without_new_keys(value: Any) -> Any:
    if isinstance(value, dict):
        new = {key for key in ("rig", "right_readout_ratio") if value.get(key, 0) is None}
        return {key: _without_new_keys(each) for key, each in value.items() if key not in new}
    return [_without_new_keys(each) for each in value] if isinstance(value, (list, tuple)) else value


def scene_hash(scene: Scene) -> str:
    """Return the hash of everything in a scene that affects images: geometry, materials and light."""
    digest = hashlib.sha256()
    digest.update(repr(scene.light).encode())
    if scene.light.environment is not None:
        digest.update(scene.light.environment.radiance.tobytes())
        digest.update(scene.light.environment.frame_from_map.tobytes())
    for part in _bytes_of(scene.meshes):
        digest.update(part)
    return digest.hexdigest()


def mesh_file_hash(mesh: MeshFile) -> str:
    """Return the SHA-256 of the meshes of a moving mesh file; raise RsbenchError if it cannot be read."""
    return hashlib.sha256(b"".join(_bytes_of(mesh.meshes()))).hexdigest()


def hashes_of_meshes(moving: Sequence[Body], mesh_hash: Callable[[MeshFile], str]) -> dict[str, Any]:
    """Return the entry ``meshes`` of a sequence.json: hashes of the objects' mesh files; empty without any."""
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
    """Hashes of scenes, stored between runs for scenes that depend only on their card and our code."""

    def __init__(self, store: Path, build: Callable[[str], str]) -> None:
        """
        Args:
            store: JSON file with the hashes of earlier runs; it need not exist.
            build: builds the scene with a name and returns its hash.
        """
        self._store, self._build = store, build
        self._by_name: dict[str, str] = {}
        try:
            self._known: dict[str, Any] = read_json(store)
        except RsbenchError:
            self._known = {}

    def of(self, name: str) -> str:
        """Return the hash of a scene by the name or path of its card; each card is read once."""
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
    """Return a key that identifies a scene on one machine; None if it depends on files or other packages' code."""
    card, builder = read_scene_card(card_path("scenes", name))
    key = built_key(builder, card.seed)
    if key is None or card.light.environment:
        return None
    return hashlib.sha256(json.dumps([key, asdict(card)], sort_keys=True).encode()).hexdigest()


Plan = dict[str, Any]
"""All settings that affect the bytes of a sequence, as in its sequence.json, except the hash of the scene."""


def plans_of(card: DatasetCard, options: RendererOptions) -> dict[str, Plan]:
    """Return the plan of each sequence by its name.

    Raises:
        RsbenchError: a scene, viewpoint or mesh does not exist, or the integrator does not support moving objects.
    """
    scenes = lru_cache(maxsize=None)(lambda name: read_scene_card(card_path("scenes", name))[0])
    mesh_hash = lru_cache(maxsize=None)(mesh_file_hash)
    return {
        each.name: _plan(card, each, options, scenes(each.scene)) | hashes_of_meshes(each.moving, mesh_hash)
        for each in card.sequence
    }


def of_scene(plan: Plan, sha256: str) -> Plan:
    return plan | {"scene": plan["scene"] | {"sha256": sha256}}


def with_gloss(plan: Plan, glossy: bool) -> Plan:
    """Return the plan with ``glossy`` if the scene, once loaded, has any glossy surface."""
    return plan | {"glossy": True} if glossy else plan


def check_same(place: object, manifest: Plan, plan: Plan, scene_sha256: str) -> None:
    """Raise RsbenchError unless the sequence.json at ``place`` was made from this plan and scene."""
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
    """Return the unchecked hashes of a sequence's files by path, from its sequence.json."""
    listed = manifest.get("files")
    return listed if isinstance(listed, dict) else {}


def wanted_files(manifest: Plan, plan: Plan) -> list[str]:
    """Return the paths that the plan requires and those that sequence.json lists, except sequence.json itself."""
    needed = files_of(with_gloss(plan, manifest.get("glossy") is True))
    return list({**dict.fromkeys(needed), **hashes_in(manifest)})


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
