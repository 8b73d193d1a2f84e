"""dataset.json and croissant.json: the card of a dataset and the files of all of its sequences."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path, PurePosixPath
from typing import Any

from rsbench.core.errors import RsbenchError
from rsbench.core.rig import FRAMES
from rsbench.core.version import RELEASED, __version__
from rsbench.dataset.card import DatasetCard
from rsbench.dataset.sequence import UNITS, format_of
from rsbench.storage.files import HashedFile, sha256, write_json
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
"""Pattern of whole paths, from their beginning."""
_POSE = {name: "sc:Float" for name in ("tau", "qw", "qx", "qy", "qz", "tx", "ty", "tz")}


def croissant_of(manifest: Mapping[str, Any], sha256: str) -> dict[str, Any]:
    """The content of croissant.json; ``manifest`` and ``sha256`` are those of the dataset.json beside it."""
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
    """As the specification has it, whether a word stands here or not."""
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
    """One for each place below a sequence and kind of file in it; ``files``: SEQUENCE/[FOLDER/...]NAME."""
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
    """Write dataset.json and croissant.json where they do not say this already; ``made``: files of sequences."""
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
    """The content of dataset.json; ``made`` as of ``write_manifest``."""
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
    """Whether a file holds this already; to read millions of lines is much faster than to write them."""
    try:
        return bool(json.loads(data) == json.loads(json.dumps(content)))
    except (ValueError, RecursionError):
        return False


def _record(card: DatasetCard) -> dict[str, Any]:
    """The complete card; without ``frames`` where there are two, and without newer keys where they say nothing."""
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
