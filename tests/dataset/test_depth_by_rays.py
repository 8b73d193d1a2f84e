"""Depth of every surface pixel against rays traced at the exact place and time where another frame sees it."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from rsbench.core.projection import ProjectionStatus, back_project, rs_project_near
from rsbench.core.rig import FRAMES, SIDES
from rsbench.core.so3 import FloatArray
from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.sequence import read_dataset
from rsbench.renderers.scene import MitsubaScene
from rsbench.scenes.model import Scene


def traced_depth(scene: MitsubaScene, origins: FloatArray, directions: FloatArray) -> FloatArray:
    """Ray parameter (n,) of the first surface; directions have z = 1 in their camera, so it is depth."""
    import mitsuba as mi

    ray = mi.Ray3f(mi.Point3f(*origins.T.astype(np.float32)), mi.Vector3f(*directions.T.astype(np.float32)))
    return np.array(scene.scene.ray_intersect_preliminary(ray).t, dtype=np.float64)


@pytest.mark.parametrize("name", ["castle", "room-twist"])
def test_every_surface_pixel_is_where_another_frame_sees_it(
    smoke_dataset: Path, built_scene: Callable[[str], Scene], name: str
) -> None:
    (card,) = load_dataset_card("smoke").only([name]).sequence
    sequence = next(sequence for sequence in read_dataset(smoke_dataset) if sequence.name == name)
    built = built_scene(card.scene)
    scene = MitsubaScene(built.seen_from(built.viewpoints[card.viewpoint]))
    rig, shutter, motion = sequence.rig, sequence.shutter, sequence.motion
    grid = rig.camera.pixel_grid()
    for source, target in product(product(SIDES, FRAMES), repeat=2):
        if source == target:
            continue
        depth = sequence.depth("rs", *source)
        pixels = grid[depth > 0]
        points = back_project(rig, shutter, motion, *source, pixels, depth[depth > 0])
        seen = rs_project_near(rig, shutter, motion, *target, points, pixels[:, 1])
        inside = seen.status == ProjectionStatus.SEEN
        R, t = rig.cam_from_world(motion, seen.tau[inside], target[0])
        Rt = np.swapaxes(R, -1, -2)
        origins = -(Rt @ t[..., None])[..., 0]
        directions = (Rt @ rig.camera.unproject(seen.pixels[inside])[..., None])[..., 0]
        relative = traced_depth(scene, origins, directions) / seen.depth[inside] - 1.0
        # A ray meets the point itself or something before it. Going past it is impossible, but for float32 rays
        # that graze an edge: fewer than one in a thousand.
        assert np.mean(relative > 1e-4) < 1e-3
        visible = np.abs(relative) <= 1e-4
        assert np.mean(visible) > 0.3, "too little is seen twice to prove anything"
        assert np.percentile(np.abs(relative[visible]), 99) < 2e-5
