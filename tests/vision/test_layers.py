"""Layers of planes in the closed-form world of conftest: who shows which, the motion, and corrected frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import pytest

from rsbench.components.motion_models import LinearMotion
from rsbench.components.plugins import wrap
from rsbench.core import so3
from rsbench.core.correspondences import Correspondences
from rsbench.core.pose_errors import translation_of_offset
from rsbench.core.projection import rs_project
from rsbench.core.rig import VIEWS
from rsbench.core.se3 import Pose
from rsbench.pipeline.layered_scene import LayersCorrector
from rsbench.vision.correction import correct_frame
from rsbench.vision.corrector import (
    CORRECTORS,
    CorrectionProblem,
    find_corrected,
    find_corrected_rows,
    load_corrector,
)
from rsbench.vision.fusion import Origin
from rsbench.vision.layers import (
    Followed,
    LabelOptions,
    MovingCamera,
    PlaneOptions,
    fronto_parallel,
    planes_seen,
    refined,
)
from rsbench.vision.quality import psnr

DEPTHS = np.array([7.0, 4.5, 3.0])
"""A wall and two boards, metres, at time 0."""
LEFT = ("left", 0), ("left", 1)


@dataclass(frozen=True)
class Filmed:
    """What the left camera sees of the world, which the right one is given too, and the truth."""

    world: Any
    problem: CorrectionProblem
    depth: dict[Any, np.ndarray]
    true: LinearMotion
    """Of the left camera about its own centre."""

    @property
    def camera(self) -> MovingCamera:
        return MovingCamera(self.world.rig.about("left"), self.world.shutter, "left", self.true)


def exact_matches(world: Any, count: int) -> np.ndarray:
    """(n, 4) of points that both frames of the left camera see."""
    pixels = np.random.default_rng(0).uniform(0, [127, 95], (count, 2))
    tau = world.shutter.pixel_time(pixels, 0, "left")
    depth, centre, rays = world.depth_along(world.rig.cam_from_world(world.motion, tau, "left"), pixels)
    seen = rs_project(world.rig, world.shutter, world.motion, "left", 1, centre + depth[:, None] * rays)
    known = np.isfinite(seen.depth)
    ends, times = np.where(known[:, None], seen.pixels, 0.0), np.where(known, seen.tau, 0.0)
    nearest, _, _ = world.depth_along(world.rig.cam_from_world(world.motion, times, "left"), ends)
    visible = known & (nearest > seen.depth * (1 - 1e-6))
    return np.concatenate([pixels, ends], axis=1)[visible]


@pytest.fixture(scope="module")
def filmed(world: Callable[..., Any], shapes: Any, u8: Any) -> Filmed:
    plane = shapes[0]

    def near(X: np.ndarray) -> np.ndarray:
        return (np.abs(X[..., 0] + 0.5) < 0.5) & (np.abs(X[..., 1] - 0.1) < 0.6)

    def middle(X: np.ndarray) -> np.ndarray:
        return (np.abs(X[..., 0] - 0.9) < 0.5) & (np.abs(X[..., 1] + 0.3) < 0.5)

    surfaces = (plane((0, 0, 1), 7.0), plane((0, 0, 1), 3.0, near), plane((0, 0, 1), 4.5, middle))
    made = world(surfaces, size=(96, 128), focal=150.0, w_deg=(0.6, 0.5, -0.8), d=(0.2, 0.05, 0.1), shortest=0.15)
    seen = {view: made.rolling(*view) for view in LEFT}
    matches = exact_matches(made, 300)
    matches = matches + np.random.default_rng(1).normal(scale=0.2, size=matches.shape)
    problem = CorrectionProblem(
        images={(side, frame): u8(seen["left", frame][0]) for side, frame in VIEWS},
        rig=made.rig,
        shutter=made.shutter,
        target_row=0.0,
        motion=None,
        depth=None,
        guess=None,
        matches=Correspondences(left=matches),
    )
    d = translation_of_offset(made.motion.w, made.motion.d, made.rig.offset("left"))
    true = LinearMotion(made.motion.w, d)
    return Filmed(made, problem, {view: depth for view, (_, depth) in seen.items()}, true)


def inside(depth: np.ndarray) -> np.ndarray:
    """(H, W) more than 4 px from a border between surfaces."""
    kernel = np.ones((9, 9), np.uint8)
    near, far = cv2.erode(depth, kernel), cv2.dilate(depth, kernel)
    return far < 1.1 * near  # depth of one plane in the rows' cameras changes by the motion alone, 3 %


def wrong(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(H, W) not the depth of its own layer: the nearest two differ by a third."""
    return np.abs(np.log(found / truth)) > 0.1


def off_degrees(found: np.ndarray, true: np.ndarray) -> float:
    return float(np.degrees(np.arccos(found @ true / np.linalg.norm(found) / np.linalg.norm(true))))


def test_planes_are_where_rays_meet_them() -> None:
    rng = np.random.default_rng(0)
    pose = Pose(so3.exp(rng.normal(scale=0.1, size=(5, 3))), rng.normal(scale=0.3, size=(5, 3)))
    planes = np.array([[0.02, -0.03, 0.2], [0.0, 0.0, 0.0], [0.0, 0.0, 0.4]])
    ray = np.array([0.2, -0.1, 1.0])
    rho = planes_seen(planes, pose) @ ray
    for k in range(5):
        back = pose.R[k].T
        for plane, found in zip(planes, rho[k], strict=True):
            # n . (c + z R^T ray) = 1, solved for z.
            z = (1.0 + plane @ back @ pose.t[k]) / (plane @ back @ ray) if np.any(plane) else np.inf
            assert found == pytest.approx(1.0 / z, abs=1e-14)
    behind = planes_seen(planes, Pose(np.eye(3), np.array([0.0, 0.0, -3.0])))  # beyond the one at 2.5
    assert np.all(np.isnan(behind[2])) and np.all(np.isfinite(behind[:2]))


def test_exact_matches_on_layers_give_the_exact_motion_and_planes(filmed: Filmed) -> None:
    matches, camera = exact_matches(filmed.world, 120), filmed.camera
    layer = np.argmin(np.abs(filmed_depths(filmed, matches)[:, None] - DEPTHS), axis=1)
    planes = np.zeros((3, 3))
    planes[:, 2] = 1.05 / DEPTHS
    start = LinearMotion(filmed.true.w + 0.002, filmed.true.d + np.array([0.01, -0.02, 0.02]))
    unit = np.linalg.norm(start.d)
    motion, moved = refined([Followed(matches, layer)], camera._replace(motion=start), planes)
    # It starts 0.2 and 8 degrees off and ends at steps that gain 1e-8 of the cost, 1e-4 of the way.
    np.testing.assert_allclose(motion.w, filmed.true.w, atol=2e-5)
    assert off_degrees(motion.d, filmed.true.d) < 0.05
    # The length of d is a choice, and the planes' unit with it.
    assert np.linalg.norm(motion.d) == pytest.approx(unit)
    np.testing.assert_allclose(moved[:, 2] * DEPTHS, np.linalg.norm(filmed.true.d) / unit, rtol=1e-3)


def filmed_depths(filmed: Filmed, matches: np.ndarray) -> np.ndarray:
    """(n,) true depths of matches in their rows' cameras."""
    tau = filmed.world.shutter.pixel_time(matches[:, :2], 0, "left")
    pose = filmed.world.rig.cam_from_world(filmed.world.motion, tau, "left")
    return filmed.world.depth_along(pose, matches[:, :2])[0]


def test_layers_motion_and_frames_of_its_own_model(filmed: Filmed, u8: Any) -> None:
    """From frames and noisy matches alone, against the world's closed forms."""
    corrector = load_corrector("vasu-layers").component
    assert isinstance(corrector, LayersCorrector)
    scene = corrector.scene(filmed.problem, "left")
    assert not isinstance(scene, str)
    unit = float(np.linalg.norm(filmed.true.d))
    # 0.2 px of noise on some 250 matches leave 0.9 and 0.05 degrees; pixels that are followed tell more.
    assert off_degrees(scene.camera.motion.d, filmed.true.d) < 0.4
    assert np.degrees(np.linalg.norm(scene.camera.motion.w - filmed.true.w)) < 0.03
    corrected = find_corrected(wrap(CORRECTORS, corrector), filmed.problem, LEFT)
    for view in LEFT:
        truth, world = filmed.depth[view], filmed.world
        assert np.mean(wrong(scene.depth(view[1]) * unit, truth)[inside(truth)]) < 0.03
        still, depth = world.still("left", float(view[1]))
        image, fused = filmed.problem.images[view], corrected[view]
        known = correct_frame(image, truth.astype(np.float32), world, view)
        drawn = (fused.origin == Origin.HERE) & known.mask & inside(depth)
        assert np.mean(drawn) > 0.5
        score, best = (psnr(each, u8(still), drawn) for each in (fused.image, known.image))
        # The hundred pixels of wrong layers cost some dB of the oracle's 45; with the right ones there is no loss.
        assert score > psnr(image, u8(still), drawn) + 15.0
        assert score > best - 8.0
        right = drawn & ~wrong(fused.depth * unit, depth)
        assert psnr(fused.image, u8(still), right) > psnr(known.image, u8(still), right) - 1.0
        assert np.any(fused.origin == Origin.OTHER_FRAME)


def test_without_parallax_there_is_one_layer(filmed: Filmed) -> None:
    camera = filmed.camera._replace(motion=LinearMotion([0.01, 0.0, 0.0], np.zeros(3)))
    np.testing.assert_array_equal(fronto_parallel(np.zeros((20, 4)), camera, PlaneOptions()), np.zeros((1, 3)))


@pytest.mark.parametrize(
    ("count", "moves", "reason"),
    [(0, 0.0, "no motion of the"), (5, 3.0, "no motion of the"), (50, 0.0, "move by 0 px")],
)
def test_what_tells_no_motion_fails_by_value(filmed: Filmed, count: int, moves: float, reason: str) -> None:
    ends = np.random.default_rng(0).uniform(0, 90, (count, 2))
    matches = Correspondences(left=np.concatenate([ends, ends + moves], axis=1))
    problem = replace(filmed.problem, matches=matches)
    found = find_corrected(wrap(CORRECTORS, LayersCorrector()), problem, LEFT)
    for fused in found.values():
        assert reason in fused.reason and np.all(fused.origin == Origin.NOBODY)
    with pytest.raises(ValueError, match="'matches' must be among the needs"):
        LayersCorrector().correct(replace(problem, matches=None), LEFT)


@pytest.mark.parametrize("name", ["vasu-layers", "zhuang", "purkait-manhattan", "lao-lines"])
def test_frames_of_several_rows_are_those_of_each(filmed: Filmed, name: str) -> None:
    """What is found once for all rows must not depend on the row; a failure is one at each."""
    entry, rows = load_corrector(name), (0.0, 40.0, 95.0)
    together = find_corrected_rows(entry, filmed.problem, LEFT, rows)
    for row, frames in zip(rows, together, strict=True):
        alone = find_corrected(entry, replace(filmed.problem, target_row=row), LEFT)
        for view, fused in frames.items():
            assert fused.reason == alone[view].reason
            for one, other in ((fused.image, alone[view].image), (fused.origin, alone[view].origin)):
                np.testing.assert_array_equal(one, other)
    drawn = [frames["left", 1].image for frames in together if frames["left", 1].success]
    assert name in ("purkait-manhattan", "lao-lines") or not np.array_equal(drawn[0], drawn[1])


def test_options_refuse_what_cannot_be() -> None:
    for name, build in (
        ("window", lambda: LabelOptions(window=4)),
        ("p1", lambda: LabelOptions(p1=200)),
        ("unseen", lambda: LabelOptions(unseen=2.0)),
        ("most", lambda: PlaneOptions(most=0)),
        ("rounds", lambda: LayersCorrector(rounds=0)),
    ):
        with pytest.raises(ValueError, match=name):
            build()
