"""Scenes set for sequences: in the frame of their body at time 0, and kept while the next is seen from there."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from rsbench.dataset.card import SequenceCard
from rsbench.scenes.model import Scene
from rsbench.scenes.object_meshes import with_moving

if TYPE_CHECKING:
    from rsbench.renderers.scene import MitsubaScene


class Built(NamedTuple):
    """A scene and its hash."""

    scene: Scene
    sha256: str


Build = Callable[[str], Built]


class PosedScenes:
    """The scene of the last sequence in the renderer: sequences that are seen from one place share it."""

    def __init__(self, build: Build) -> None:
        self._build = build
        self._place: object = None
        self._scene: Any = None

    def set_for(self, sequence: SequenceCard) -> tuple[MitsubaScene, str]:
        """The scene in the frame of a sequence, and the hash of the scene."""
        from rsbench.renderers.scene import MitsubaScene

        place = place_of(sequence)
        if place != self._place:
            self._scene = None  # not two at a time
        built = self._build(sequence.scene)
        if self._scene is None:
            self._scene, self._place = MitsubaScene(seen_scene(built.scene, sequence)), place
        return self._scene, built.sha256


def place_of(sequence: SequenceCard) -> tuple[object, ...]:
    """What decides from where a sequence sees its scene."""
    return sequence.scene, sequence.viewpoint, sequence.start, sequence.moving


def seen_scene(scene: Scene, sequence: SequenceCard) -> Scene:
    """A scene in the frame of the body at time 0 of a sequence, with its objects that move."""
    seen = scene.seen_from(scene.viewpoints[sequence.viewpoint], sequence.start)
    return with_moving(seen, sequence.moving) if sequence.moving else seen
