"""Identity of a sequence: what of a card decides its bytes, and whether a sequence was made from it."""

from __future__ import annotations

from dataclasses import asdict
from functools import lru_cache
from typing import Any

from rsbench.components.cards import card_path
from rsbench.core.errors import RsbenchError
from rsbench.dataset.card import DatasetCard, SequenceCard
from rsbench.dataset.layout import files_of
from rsbench.dataset.scene_hashes import hashes_of_meshes, mesh_file_hash
from rsbench.renderers.options import RendererOptions
from rsbench.scenes.load import SceneCard, read_scene_card

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
