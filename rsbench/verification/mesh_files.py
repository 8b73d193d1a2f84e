"""Mesh files that move in a sequence: the user names them, for what a dataset says of a file is a name."""

from __future__ import annotations

from collections.abc import Sequence as Many
from dataclasses import replace
from pathlib import Path

from rsbench.core.errors import RsbenchError
from rsbench.dataset.object_records import MovingManifest
from rsbench.dataset.scene_hashes import mesh_file_hash
from rsbench.dataset.sequence import Sequence


def with_files(sequence: Sequence, files: Many[Path]) -> tuple[MovingManifest, ...]:
    """The objects of a sequence, their mesh files found by name among these.

    Raises:
        RsbenchError: a file that was not named, cannot be read, or is another than the sequence was made of.
    """
    named = {path.name: path for path in files}
    hashes = sequence.manifest.get("meshes")
    made = []
    for number, each in enumerate(sequence.moving, start=1):
        if each.mesh is None:
            made.append(each)
            continue
        if (path := named.get(each.mesh.name)) is None:
            raise RsbenchError(
                f"the mesh {each.mesh.name!r} of moving object {number} is a file of yours; name it with --scene"
            )
        mesh = replace(each.mesh, file=str(path))
        stated = hashes.get(str(number)) if isinstance(hashes, dict) else None
        if mesh_file_hash(mesh) != stated:
            raise RsbenchError(f"{path}: what is drawn of it has another sha256 than meshes in sequence.json says")
        made.append(replace(each, mesh=mesh))
    return tuple(made)
