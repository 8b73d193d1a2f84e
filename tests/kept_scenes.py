"""Scenes that generating and verifying build and load into the renderer once: each takes seconds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

from rsbench.dataset import generation
from rsbench.renderers import scene
from rsbench.scenes.model import Scene
from rsbench.verification import rerender


@contextmanager
def kept_scenes(load: Callable[[str | Path], Scene]) -> Iterator[None]:
    """While this lasts ``load`` builds scenes, and the renderer keeps the last one, hundreds of MB."""
    made, kept = scene.MitsubaScene, dict[object, scene.MitsubaScene]()

    def once(seen: Scene) -> scene.MitsubaScene:
        # The light in the frame of the view tells views apart.
        key = seen.name, seen.light, *((m.name, m.mover, m.vertices.tobytes()) for m in seen.meshes if m.mover)
        if key not in kept:
            kept.clear()
            kept[key] = made(seen)
        return kept[key]

    with (
        patch.object(generation, "load_scene", load),
        patch.object(rerender, "load_scene", load),
        patch.object(scene, "MitsubaScene", once),
    ):
        yield
    kept.clear()
