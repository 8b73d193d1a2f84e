"""Time and space that a dataset will take, by a trial: one camera's frames of one sequence of each scene."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

from rsbench.components.cards import load_card
from rsbench.core.rig import SIDES
from rsbench.dataset.card import DatasetCard, SequenceCard
from rsbench.dataset.generation import build_scene, render_camera, scene_name
from rsbench.dataset.layout import files_of
from rsbench.dataset.posed_scenes import place_of, seen_scene
from rsbench.renderers.options import RendererOptions
from rsbench.storage.files import background_writer
from rsbench.storage.work_folder import files_below

if TYPE_CHECKING:
    from rsbench.renderers.scene import MitsubaScene

_LISTED_BYTES = 200
"""Of a file in sequence.json and dataset.json."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Of a whole dataset; bytes and seconds are those of one camera's frames times their number."""

    sequences: int
    files: int
    bytes: int
    seconds: float
    """On this machine, in one process."""


def estimate_dataset(card: DatasetCard, progress: Callable[[str], None]) -> Estimate:
    """Render a little of a card and count the rest; ``progress`` is called with the name of each scene tried.

    Raises:
        RsbenchError: a scene or renderer of the card does not exist.
    """
    options = load_card(RendererOptions, "renderers", card.renderer)
    found: list[Estimate] = []
    warm: set[str] = set()
    for scene, group in groupby(sorted(card.sequence, key=scene_name), key=scene_name):
        found.append(_of_scene(card, list(group), options, warm))
        progress(scene)
    total = _sum(found)
    return replace(total, files=total.files + 2, bytes=total.bytes + _LISTED_BYTES * (total.files + 2))


def _sum(parts: list[Estimate]) -> Estimate:
    return Estimate(
        sequences=sum(each.sequences for each in parts),
        files=sum(each.files for each in parts),
        bytes=sum(each.bytes for each in parts),
        seconds=sum(each.seconds for each in parts),
    )


def _of_scene(
    card: DatasetCard, sequences: list[SequenceCard], options: RendererOptions, warm: set[str]
) -> Estimate:
    """Of the sequences of one scene: a trial with each sensor. ``warm``: those whose kernels are compiled."""
    from rsbench.renderers.scene import MitsubaScene

    start = time.monotonic()
    scene = build_scene(sequences[0].scene).scene
    built = time.monotonic()
    rendered = MitsubaScene(seen_scene(scene, sequences[0]))
    loaded = time.monotonic()
    places = len({repr(place_of(sequence)) for sequence in sequences})
    kinds: dict[str, list[SequenceCard]] = {}
    for sequence in sequences:
        kinds.setdefault(repr((card.sensor_of(sequence), len(sequence.moving))), []).append(sequence)
    tried: list[Estimate] = []
    for kind, alike in kinds.items():
        same = alike[0].moving == sequences[0].moving
        shown = rendered if same else MitsubaScene(seen_scene(scene, alike[0]))
        tried.append(_of_kind(card, alike, options, shown, warm=kind in warm))
        warm.add(kind)
    total = _sum(tried)
    return replace(total, seconds=total.seconds + built - start + places * (loaded - built))


def _of_kind(
    card: DatasetCard, sequences: list[SequenceCard], options: RendererOptions, scene: MitsubaScene, warm: bool
) -> Estimate:
    """Of sequences of one sensor; its first image compiles, which is counted once."""
    glossy: dict[str, bool] = {"glossy": True} if scene.glossy else {}
    own = files_of(card.manifest_of(sequences[0]) | glossy)
    with tempfile.TemporaryDirectory(prefix="rsbench-") as temporary:
        for folder in {Path(name).parent for name in own}:
            (Path(temporary) / folder).mkdir(parents=True, exist_ok=True)
        times, middle = list[float](), (card.frames - 1) // 2
        for _ in range(1 if warm else 2):
            begun = time.monotonic()
            with background_writer() as later:
                for _ in render_camera(
                    card, sequences[0], options, scene, SIDES[0], middle, Path(temporary), later
                ):
                    pass
            times.append(time.monotonic() - begun)
        written = sum((Path(temporary) / name).stat().st_size for name in files_below(Path(temporary)))
    cameras = len(SIDES) * card.frames * len(sequences)
    return Estimate(
        sequences=len(sequences),
        files=len(sequences) * (len(own) + 1),
        bytes=cameras * written,
        seconds=max(times[0] - times[-1], 0.0) + cameras * times[-1],
    )
