"""Correction of one camera's frames, against the closed-form world of conftest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from rsbench.core.rig import SIDES, VIEWS
from rsbench.pipeline.mono_correction import MonoFusionCorrector, find_own_motion, refusal
from rsbench.solvers.engine.robust_motion import RobustOptions
from rsbench.vision.corrector import CorrectionProblem, load_corrector
from rsbench.vision.fusion import Origin
from rsbench.vision.mono_fusion import MonoFusion, OwnMotion, find_flows

Build = Callable[..., Any]
SIZE = {"size": (240, 320), "focal": 300.0, "readout_ratio": 1.0, "shortest": 0.5}


@pytest.fixture(scope="module")
def scene(world: Build, shapes: Any) -> Any:
    """A leaning wall, and a ball before it; the motion is that of the left camera."""
    plane, sphere = shapes
    made = world((plane((0.3, 0.2, 1.0), 7.0), sphere((0.4, 0.3, 4.0), 0.8)), d=(0.3, -0.1, 0.2), **SIZE)
    return replace(made, rig=made.rig.about("left"))


def _frames(scene: Any, u8: Any, side: Any = "left") -> list[np.ndarray]:
    return [u8(scene.rolling(side, frame)[0]) for frame in (0, 1)]


def _rms(a: Any, b: Any, mask: Any) -> float:
    return float(np.sqrt(np.mean((np.asarray(a, dtype=np.float64) - b)[mask] ** 2)))


@pytest.mark.parametrize("frame", [0, 1])
def test_a_frame_becomes_the_global_shutter_image(scene: Any, u8: Any, truth: Any, frame: int) -> None:
    images = _frames(scene, u8)
    flows = find_flows(images)
    found = find_own_motion(flows, scene.rig, scene.shutter, "left", RobustOptions())
    target = frame + 0.5
    fused = MonoFusion(images, found.own, flows).corrected(frame, target)
    true = truth(scene, "left", frame, target)
    seen = cv2.erode(true.visible.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    # Away from what the frame does not show, a wrong time or sign would leave most of the uncorrected error; the
    # flow's own error of a tenth of a pixel leaves less than a quarter.
    assert _rms(fused.image, 255.0 * true.image, seen) < 0.25 * _rms(images[frame], 255.0 * true.image, seen)
    assert np.mean(fused.origin == Origin.HERE) > 0.85


def test_motion_and_depth_have_the_unit_of_the_translation(scene: Any, u8: Any, truth: Any) -> None:
    images = _frames(scene, u8)
    flows = find_flows(images)
    found = find_own_motion(flows, scene.rig, scene.shutter, "left", RobustOptions())
    motion, length = found.own.motion, float(np.linalg.norm(scene.motion.d))
    assert motion is not None and np.linalg.norm(motion.d) == pytest.approx(1.0)
    # 0.1 px of flow over 1500 matches and 30 px of parallax; the scene's linear motion is not quite inertial.
    assert np.rad2deg(np.arccos(motion.d @ scene.motion.d / length)) < 3.0
    assert np.rad2deg(np.linalg.norm(motion.w - scene.motion.w)) < 0.1
    true = truth(scene, "left", 1, 1.5)
    depth = MonoFusion(images, found.own, flows).corrected(1, 1.5).depth * length
    ratio = (depth / true.depth)[true.visible & np.isfinite(depth)]
    assert np.median(np.abs(ratio - 1.0)) < 0.05


def test_what_moves_by_itself_goes_its_own_flow(world: Build, shapes: Any, u8: Any) -> None:
    """A ball with another motion, across the epipolar curves of the wall, composed of two closed-form worlds."""
    plane, sphere = shapes
    wall = world((plane((0.0, 0.1, 1.0), 7.0),), d=(0.3, 0.0, 0.05), w_deg=(0.2, 0.3, 0.0), **SIZE)
    ball = world((sphere((0.0, 0.2, 4.0), 0.9),), d=(0.0, 0.25, 0.0), w_deg=(0.0, 0.0, 0.0), seed=1, **SIZE)

    def both(look: Callable[[Any], Any]) -> tuple[np.ndarray, np.ndarray]:
        (near, depth), (far, _) = look(ball), look(wall)
        hit = np.isfinite(depth)
        return np.where(hit[..., None], near, far), hit

    images = [u8(both(lambda scene, frame=frame: scene.rolling("left", frame))[0]) for frame in (0, 1)]
    true, on_ball = both(lambda scene: scene.still("left", 1.25))
    inner = cv2.erode(on_ball.astype(np.uint8), np.ones((15, 15), np.uint8)).astype(bool)
    flows = find_flows(images)
    own = find_own_motion(flows, wall.rig, wall.shutter, "left", RobustOptions()).own
    fused = MonoFusion(images, own, flows).corrected(1, 1.25)
    # Geometry alone would leave the ball where its rows saw it: up to 0.3 periods of 19 px each.
    assert _rms(fused.image, 255.0 * true, inner) < 0.5 * _rms(images[1], 255.0 * true, inner)


def test_without_a_motion_everything_is_scaled_flow(scene: Any, u8: Any) -> None:
    """At the time of a row, the pixels of that row stay where they are."""
    images = _frames(scene, u8)
    flows = find_flows(images)
    own = OwnMotion(rig=scene.rig.about("left"), shutter=scene.shutter, side="left", motion=None)
    fusion = MonoFusion(images, own, flows)
    places = fusion.places(1, float(scene.shutter.row_time(100, 1)))
    np.testing.assert_allclose(places[100, :, 0], np.arange(320), atol=1e-9)  # rounding
    # The whole flow leads to the other frame: at the time of its end a pixel is at its end.
    x, y = 160, 120
    end = np.array([x, y]) + flows.flow[1][y, x]
    there = fusion.places(1, float(scene.shutter.row_time(end[1], 0)))[y, x, :2]
    np.testing.assert_allclose(there, end, atol=1e-4)  # float32 of the flow


def test_what_cannot_be_corrected_says_why() -> None:
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.uniform(0, 255, (120, 160)), (0, 0), 2.0)
    textured = cv2.normalize(noise, np.zeros_like(noise), 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    flat = np.full((120, 160), 90, np.uint8)
    assert "no texture" in refusal([flat, flat], find_flows([flat, flat]))
    assert "nothing moves" in refusal([textured, textured], find_flows([textured, textured]))
    moved = np.roll(textured, 4, axis=1)
    assert refusal([textured, moved], find_flows([textured, moved])) == ""


@pytest.mark.slow
def test_the_corrector_is_found_by_name_and_keeps_cameras_apart(scene: Any, u8: Any) -> None:
    corrector = load_corrector("mono-fusion").component
    assert isinstance(corrector, MonoFusionCorrector)
    images = {(side, frame): u8(scene.rolling(side, frame)[0]) for side in SIDES for frame in (0, 1)}
    known = {"rig": scene.rig, "shutter": scene.shutter, "motion": None, "depth": None, "guess": None}
    problem = CorrectionProblem(images=images, target_row=120.0, **known)
    black = {view: image if view[0] == "left" else np.zeros_like(image) for view, image in images.items()}
    alone = corrector.correct(replace(problem, images=black), VIEWS)
    both = corrector.correct(problem, VIEWS)
    assert not alone["right", 0].success and "no texture" in alone["right", 0].reason
    np.testing.assert_array_equal(alone["left", 0].image, both["left", 0].image)
