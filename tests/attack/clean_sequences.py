"""Sound sequences of random cards, in which verify must find nothing.

Cameras, rigs, shutters, motions of every model, renderers, scenes and viewpoints are drawn; motions go to 20
degrees and a metre per frame, and one scene has hardly any texture. A motion through a wall or into the sky,
which ``generate`` refuses, is drawn again. Small, so that there can be many. No surface is glossy: none of
rsbench's scenes has one.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from unittest.mock import patch

import numpy as np
from small_scenes import write_box_scene

from rsbench.cards import list_cards
from rsbench.dataset import generation
from rsbench.dataset.card import CameraCard, DatasetCard, MotionCard, SequenceCard
from rsbench.dataset.verification import verify_dataset
from rsbench.errors import RsbenchError
from rsbench.scenes.load import load_scene, read_scene_card
from rsbench.scenes.model import Scene

MODELS = ("linear", "twist", "accelerated", "spline")
PER_DATASET = 10
"""Sequences of one viewpoint, camera, shutter and renderer."""
MOST_DRAWS = 50
"""Motions of one sequence, of which ``generate`` must take one."""
RENDERERS = {
    "one": 'integrator = "sunsky"\nsamples = 1\n',
    "four": 'integrator = "sunsky"\nsamples = 4\n',
    "sixteen": 'integrator = "sunsky"\nsamples = 16\nexposure = 1.6\n',
    "traced": 'integrator = "path"\nsamples = 4\nmax_depth = 3\n',
}


def random_cards(count: int, folder: Path, seed: int) -> Iterator[DatasetCard]:
    """Cards of ``count`` sequences in all; those of one scene follow each other, as it is built once."""
    rng = np.random.default_rng(seed)
    for name, text in RENDERERS.items():
        (folder / f"{name}.toml").write_text(f'description = "{name}"\n{text}')
    plain = str(write_box_scene(folder, "plain", (2, 2)))
    scenes = [plain, *(name for name in list_cards("scenes") if name != "mesh")]
    datasets = -(-count // PER_DATASET)
    for number in range(datasets):
        scene = scenes[number * len(scenes) // datasets]
        yield _card(rng, number, scene, folder, min(PER_DATASET, count - number * PER_DATASET))


def _card(rng: np.random.Generator, number: int, scene: str, folder: Path, sequences: int) -> DatasetCard:
    path = Path(scene) if scene.endswith(".toml") else list_cards("scenes")[scene]
    viewpoint = str(rng.choice(list(read_scene_card(path)[0].viewpoints)))
    width, height = (int(size) for size in rng.integers(48, 97, 2))
    return DatasetCard(
        name=f"random-{number}",
        camera=CameraCard(width=width, height=height, focal=float(width * rng.uniform(0.6, 2.0))),
        baseline=float(rng.uniform(0.05, 0.6)),
        readout_ratio=float(rng.choice([0.0, 1.0, rng.uniform(0, 1)])),
        frame_period_s=float(rng.uniform(0.01, 0.2)),
        motion=_motion(rng),
        renderer=str(folder / f"{rng.choice(list(RENDERERS))}.toml"),
        seed=int(rng.integers(1000)),
        sequence=tuple(
            SequenceCard(name=f"s{k}", scene=scene, viewpoint=viewpoint, motion=_motion(rng))
            for k in range(sequences)
        ),
    ).expanded()


def _motion(rng: np.random.Generator) -> MotionCard:
    return MotionCard(
        model=str(rng.choice(MODELS)),
        rotation_deg=float(rng.choice([0.0, rng.uniform(0, 2), rng.uniform(2, 20)])),
        rotation_axis="random",
        translation=float(rng.choice([0.0, rng.uniform(0, 0.2), rng.uniform(0.2, 1)])),
        translation_axis="random",
    )


def _generated(card: DatasetCard, out: Path) -> int:
    """Make a dataset, with other motions where ``generate`` refuses one; returns how many it did."""
    rng = np.random.default_rng(card.seed)
    for draws in range(MOST_DRAWS * len(card.sequence)):
        try:
            generation.generate_dataset(card, out)
        except RsbenchError as error:
            blocked = re.match(
                r"sequence (\S+): (the \S+ camera goes through a surface|\S+ shows no surface)", str(error)
            )
            if not blocked:
                raise
            others = (
                replace(each, motion=_motion(rng)) if each.name == blocked[1] else each for each in card.sequence
            )
            card = replace(card, sequence=tuple(others)).expanded()
        else:
            return draws
    raise RuntimeError(f"{card.name}: every motion is refused")


def false_alarms(count: int, folder: Path, seed: int = 0) -> Iterator[tuple[str, int, int, list[str]]]:
    """Of each dataset its name, how many sequences it has, motions that were refused, and what verify found."""
    from rsbench.renderers import scene

    kept: dict[object, scene.MitsubaScene] = {}

    def once(seen: Scene) -> scene.MitsubaScene:
        """The renderer's scene, which takes seconds; the light in the frame of the view tells views apart."""
        key = seen.name, seen.light
        if key not in kept:
            kept.clear()
            kept[key] = made(seen)
        return kept[key]

    made = scene.MitsubaScene
    with (
        patch.object(generation, "load_scene", lru_cache(maxsize=1)(load_scene)),
        patch.object(scene, "MitsubaScene", once),
    ):
        for card in random_cards(count, folder, seed):
            out = folder / card.name
            refused = _generated(card, out)
            found = [f"{report.name}: {fault}" for report in verify_dataset(out) for fault in report.faults]
            yield f"{card.name} ({Path(card.renderer).stem})", len(card.sequence), refused, found
            if not found:
                shutil.rmtree(out)
