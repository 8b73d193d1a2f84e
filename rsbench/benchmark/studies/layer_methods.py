"""Frames by layers of planes, a method of the correction study on request."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.core.correspondences import Correspondences
from rsbench.core.geometry import FixedGeometry
from rsbench.core.rig import FRAMES, SIDES, View
from rsbench.dataset.sequence import Sequence
from rsbench.pipeline.layered_scene import LayersCorrector
from rsbench.vision.correction import correction_flow
from rsbench.vision.corrector import CorrectionProblem, load_corrector
from rsbench.vision.fusion import Fused, Origin, inpaint


def asked_layers(
    key: str, sequence: Sequence, images: Mapping[View, NDArray[Any]], matches: Correspondences, seed: int
) -> dict[View, tuple[Fused, NDArray[np.float32]]]:
    """Whole pictures, and where each pixel (H, W, 2) moves, px, of the cameras that did not fail.

    Raises:
        RsbenchError: there is no such card.
        ValueError: the card is of another corrector.
    """
    corrector = load_corrector(key).component
    if not isinstance(corrector, LayersCorrector):
        raise ValueError(f"{key!r} is no corrector of layers")
    corrector = replace(corrector, seed=seed)
    problem = CorrectionProblem(
        images=images,
        rig=sequence.rig,
        shutter=sequence.shutter,
        target_row=0.0,
        motion=None,
        depth=None,
        guess=None,
        matches=matches,
    )
    found: dict[View, tuple[Fused, NDArray[np.float32]]] = {}
    for side in SIDES:
        scene = corrector.scene(problem, side)
        if isinstance(scene, str):
            continue
        for frame in FRAMES:
            fused = corrector.rendered(problem, (side, frame), scene)
            rig, shutter, _, motion = scene.camera
            flow = correction_flow(scene.depth(frame), FixedGeometry(rig, shutter, motion), (side, frame))
            whole = inpaint(fused.image, fused.origin == Origin.NOBODY)
            found[side, frame] = replace(fused, image=whole), flow
    return found
