"""Built scenes in the user's cache folder: our builders take seconds, and every process wants the same arrays.

A scene is one file, named by what decides its arrays. It is written under another name and renamed when complete,
so processes may fill the cache at the same time; zip's checksums tell a damaged file, which is built again.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict
from importlib import resources
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.components.imports import component_key, hash_of_files
from rsbench.scenes.model import Material, SceneBuilder, SceneMesh
from rsbench.storage.work_folder import cpu_key, user_cache

_PACKAGES = ("numpy", "trimesh", "shapely", "mapbox-earcut")
"""Decide, with the sources of ``rsbench.scenes``, what our builders make of a card."""
_MOST = 12
"""Scenes that are kept: 0.2 GB each."""
_ABANDONED_S = 3600.0
_ARRAYS = ("vertices", "faces", "uv", "normals")


def built_key(builder: SceneBuilder, seed: int) -> str | None:
    """Equal keys are equal meshes on one machine; None when files or other packages' code decide too."""
    if not builder.closed or type(builder).__module__.partition(".")[0] != "rsbench":
        return None
    package = Path(str(resources.files("rsbench")))
    content = {
        "builder": component_key(builder, {}),
        "seed": seed,
        "source": hash_of_files(package, sorted((package / "scenes").glob("*.py"))),
        "packages": {each: version(each) for each in _PACKAGES},
        "processor": cpu_key(),
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def cached_meshes(key: str) -> tuple[SceneMesh, ...] | None:
    """What ``keep`` stored under a key; None when there is nothing that can be read."""
    folder = _folder()
    if folder is None:
        return None
    path = folder / f"{key}.npz"
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            meshes = tuple(_unpacked(arrays))
        os.utime(path)  # the least recently used goes first
    except Exception:  # whatever a damaged file makes of those who read it
        return None
    return meshes


def keep(key: str, meshes: tuple[SceneMesh, ...]) -> None:
    """Store meshes; silently does nothing where nothing can be written."""
    folder = _folder()
    if folder is None:
        return
    partial = None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _trim(folder)
        handle, partial = tempfile.mkstemp(dir=folder, suffix=".partial")
        with os.fdopen(handle, "wb") as stream:
            np.savez(stream, allow_pickle=False, **_packed(meshes))
        os.replace(partial, folder / f"{key}.npz")
    except OSError:
        pass
    finally:
        if partial is not None:
            with contextlib.suppress(OSError):
                os.unlink(partial)


def _folder() -> Path | None:
    base = user_cache()
    return None if base is None else base / "scenes"


def _trim(folder: Path) -> None:
    """Make room for one more scene; what a killed process left goes too."""
    kept = sorted(folder.glob("*.npz"), key=lambda path: path.stat().st_mtime)
    for path in kept[: max(len(kept) - _MOST + 1, 0)]:
        path.unlink(missing_ok=True)
    for path in folder.glob("*.partial"):
        if time.time() - path.stat().st_mtime > _ABANDONED_S:
            path.unlink(missing_ok=True)


def _packed(meshes: tuple[SceneMesh, ...]) -> dict[str, NDArray[Any]]:
    """Arrays by name, and everything else as JSON; meshes that share a material share it again."""
    materials = list({id(mesh.material): mesh.material for mesh in meshes}.values())
    numbers = {id(material): number for number, material in enumerate(materials)}
    arrays: dict[str, NDArray[Any]] = {}
    for number, material in enumerate(materials):
        if material.texture is not None:
            arrays[f"texture-{number}"] = material.texture
    for number, mesh in enumerate(meshes):
        found = {name: getattr(mesh, name) for name in _ARRAYS}
        arrays |= {f"{name}-{number}": array for name, array in found.items() if array is not None}
    content = {
        "materials": [{**asdict(one), "texture": one.texture is not None} for one in materials],
        "meshes": [{"name": mesh.name, "material": numbers[id(mesh.material)]} for mesh in meshes],
    }
    return arrays | {"content": np.frombuffer(json.dumps(content).encode(), dtype=np.uint8)}


def _unpacked(arrays: Any) -> Iterator[SceneMesh]:
    content = json.loads(arrays["content"].tobytes())
    materials = []
    for number, found in enumerate(content["materials"]):
        texture = arrays[f"texture-{number}"] if found["texture"] else None
        parts: dict[str, Any] = {**found, "colour": tuple(found["colour"]), "texture": texture}
        materials.append(Material(**parts))
    for number, found in enumerate(content["meshes"]):
        own = {name: arrays[f"{name}-{number}"] for name in _ARRAYS if f"{name}-{number}" in arrays}
        yield SceneMesh(name=found["name"], material=materials[found["material"]], **own)
