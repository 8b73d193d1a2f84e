"""What a dataset will take, by trying: one camera's frames of one sequence of each scene."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from rsbench.cards import load_card
from rsbench.core.rig import SIDES
from rsbench.dataset.card import DatasetCard, SequenceCard
from rsbench.dataset.generation import build_scene, render_camera, scene_name, seen_scene
from rsbench.dataset.sequence import FRAMES, files_of
from rsbench.dataset.workplace import files_below
from rsbench.renderers.options import RendererOptions

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
    for scene, group in groupby(sorted(card.sequence, key=scene_name), key=scene_name):
        found.append(_of_scene(card, list(group), options, warm=bool(found)))
        progress(scene)
    files = sum(each.files for each in found) + 1
    return Estimate(
        sequences=len(card.sequence),
        files=files,
        bytes=sum(each.bytes for each in found) + _LISTED_BYTES * files,
        seconds=sum(each.seconds for each in found),
    )


def _of_scene(card: DatasetCard, sequences: list[SequenceCard], options: RendererOptions, warm: bool) -> Estimate:
    """Of the sequences of one scene; the first image of a process also compiles, which is counted once."""
    from rsbench.renderers.scene import MitsubaScene

    start = time.monotonic()
    scene = build_scene(sequences[0].scene).scene
    built = time.monotonic()
    rendered = MitsubaScene(seen_scene(scene, sequences[0]))
    loaded = time.monotonic()
    own = files_of(card.manifest_of(sequences[0]))
    with tempfile.TemporaryDirectory(prefix="rsbench-") as temporary:
        for folder in {Path(name).parent for name in own}:
            (Path(temporary) / folder).mkdir(parents=True, exist_ok=True)
        times = []
        for _ in range(1 if warm else 2):
            begun = time.monotonic()
            for _ in render_camera(card, sequences[0], options, rendered, SIDES[0], FRAMES[0], Path(temporary)):
                pass
            times.append(time.monotonic() - begun)
        written = sum((Path(temporary) / name).stat().st_size for name in files_below(Path(temporary)))
    cameras = len(SIDES) * len(FRAMES) * len(sequences)
    compiling = max(times[0] - times[-1], 0.0)
    return Estimate(
        sequences=len(sequences),
        files=len(sequences) * (len(own) + 1),
        bytes=cameras * written,
        seconds=built - start + compiling + len(sequences) * (loaded - built) + cameras * times[-1],
    )
