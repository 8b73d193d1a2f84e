"""Correctors of a rotation that is known from elsewhere than the matches, on worlds of closed form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from rsbench.components.motion_models import LinearMotion
from rsbench.components.plugins import wrap
from rsbench.core.errors import RsbenchError
from rsbench.core.geometry import FixedGeometry
from rsbench.core.rig import VIEWS, View
from rsbench.dataset.imu import ImuSamples, gyro_samples, true_samples
from rsbench.pipeline.chain import Given, correct_four
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.vision.correction import correction_flow
from rsbench.vision.corrector import CORRECTORS, CorrectionProblem, find_corrected, load_corrector
from rsbench.vision.correctors import RotationCorrector
from rsbench.vision.curves import image_curves
from rsbench.vision.fusion import Origin
from rsbench.vision.rotation_correctors import GyroCorrector, LinesCorrector, ManhattanCorrector

Build = Callable[..., Any]


def problem_of(scene: Any, target_row: float = 0.0) -> CorrectionProblem:
    """What a world shows, and nothing that is known of it."""
    images = {view: np.rint(255.0 * scene.rolling(*view)[0]).astype(np.uint8) for view in VIEWS}
    return CorrectionProblem(
        images=images,
        rig=scene.rig,
        shutter=scene.shutter,
        target_row=target_row,
        motion=None,
        depth=None,
        guess=None,
    )


def rates(scene: Any, count: int = 40, bias: float = 0.0) -> np.ndarray:
    tau = np.linspace(-0.5, 2.5, count)
    return np.column_stack([tau, scene.motion.velocity(tau)[0] + bias])


@pytest.mark.parametrize(("view", "row"), [(("left", 0), 0.0), (("right", 1), 100.0)])
def test_an_exact_gyroscope_gives_what_the_true_rotation_gives(world: Build, view: View, row: float) -> None:
    scene = world((), sky=True)
    problem = replace(problem_of(scene, row), gyro=rates(scene))
    found = find_corrected(wrap(CORRECTORS, GyroCorrector()), problem, [view])[view]
    expected = RotationCorrector().correct(replace(problem, motion=scene.motion), [view])[view]
    # Rates about one axis are integrated exactly: a pixel at the edge of a grey level may round the other way.
    assert np.max(np.abs(found.image.astype(int) - expected.image)) <= 1
    np.testing.assert_array_equal(found.origin, expected.origin)


def test_what_a_gyroscope_has_wrong_turns_the_rows_by_its_integral(world: Build) -> None:
    """A bias b is b more rotation per period: the frame that a motion of w + b is corrected to."""
    scene = world((), sky=True, w_deg=(0.0, 0.0, 0.0), d=(0.0, 0.0, 0.0))
    bias, view = np.radians(0.5), ("left", 1)
    problem = replace(problem_of(scene), gyro=rates(scene, bias=bias))
    found = GyroCorrector().correct(problem, [view])[view]
    wrong = replace(problem, motion=LinearMotion(np.full(3, bias), np.zeros(3)))
    expected = RotationCorrector().correct(wrong, [view])[view]
    assert np.max(np.abs(found.image.astype(int) - expected.image)) <= 1
    assert np.mean(found.image != problem.images["left", 1]) > 0.2


def test_the_samples_of_the_channel_are_the_rates_of_the_motion() -> None:
    """Measured without error, by a clock that is late: the velocity of the motion at times that are late."""
    motion, period, late_ns = LinearMotion([0.01, -0.02, 0.03], [0.1, 0.0, 0.2]), 0.04, 2_000_000
    times = np.arange(-5, 25, dtype=np.int64) * 5_000_000
    true = true_samples(motion, times, period, np.zeros(3))
    samples = ImuSamples(times + late_ns, true, times, true, np.zeros_like(true))
    found = gyro_samples(samples, period)
    np.testing.assert_allclose(found[:, 0], 1e-9 * (times + late_ns) / period, rtol=1e-14)
    np.testing.assert_allclose(found[:, 1:], motion.velocity(times / 1e9 / period)[0], atol=1e-15)


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_samples_are_a_failure_by_value(world: Build, count: int) -> None:
    scene = world((), sky=True)
    problem = replace(problem_of(scene), gyro=rates(scene)[:count])
    found = find_corrected(wrap(CORRECTORS, GyroCorrector()), problem, VIEWS)
    for fused in found.values():
        assert not fused.success and f"{count} samples" in fused.reason
        assert not fused.image.any() and np.all(fused.origin == Origin.NOBODY)


def test_the_chain_hands_samples_over_and_says_where_they_are_missing(world: Build) -> None:
    scene = world((), sky=True)
    images, options = problem_of(scene).images, CorrectionOptions(corrector=load_corrector("gyro"))
    ratio = scene.shutter.readout_ratio
    found = correct_four(images, scene.rig, ratio, options, given=Given(gyro=rates(scene)))
    assert found.matches is None and found.pairs is None
    assert all(fused.success for fused in found.frames.values())
    with pytest.raises(RsbenchError, match="corrector 'gyro': needs the samples of a gyroscope"):
        correct_four(images, scene.rig, ratio, options)


# One image


@dataclass(frozen=True)
class Stripes:
    """Light and dark stripes between lines a X + b Y = c of a plane, a pixel wide at edges; others right of 0."""

    left: tuple[tuple[float, float, float], ...]
    right: tuple[tuple[float, float, float], ...] = ()
    width: float = 0.012
    shortest: float = 1.0

    def __call__(self, X: np.ndarray) -> np.ndarray:
        left, right = (
            np.prod([np.tanh((a * X[..., 0] + b * X[..., 1] - c) / self.width) for a, b, c in lines], axis=0)
            for lines in (self.left, self.right or self.left)
        )
        return np.repeat(0.5 + 0.35 * np.where(X[..., 0] < 0.0, left, right)[..., None], 3, axis=-1)


SIZE: dict[str, Any] = {"size": (240, 240), "focal": 370.0}
FAN = tuple((1.0, -0.45 * c, c) for c in (-1.4, -1.0, -0.6, -0.2, 0.2, 0.6, 1.0, 1.4))  # they meet below the image
UPRIGHT = tuple((1.0, 0.0, c) for c in (-1.6, -1.3, -1.0, -0.7, -0.4, 0.0))
LEVEL = tuple((0.0, 1.0, c) for c in (-1.2, -0.8, -0.4, 0.0, 0.4, 0.8, 1.2))
W_DEG = (1.0, -2.0, 3.0)


@pytest.mark.parametrize(
    ("corrector", "stripes", "normal"),
    [
        (LinesCorrector(), Stripes(FAN), (0.05, 0.1, 1.0)),
        (ManhattanCorrector(), Stripes(UPRIGHT, LEVEL), (0.4, 0.0, 1.0)),  # X and Y stay orthogonal
    ],
)
def test_one_image_with_lines_tells_how_its_rows_are_turned(
    world: Build, shapes: Any, corrector: Any, stripes: Stripes, normal: Any
) -> None:
    """Edges are found to a twentieth of a pixel; what is left of the distortion is a fraction of it."""
    scene = world((shapes[0](normal, 5.0),), w_deg=W_DEG, d=(0.0, 0.0, 0.0), **SIZE)
    scene = replace(scene, texture=stripes)
    problem, view = problem_of(scene), ("left", 0)
    motion = corrector.rotation(problem, view)
    assert not isinstance(motion, str), motion
    far = np.full((240, 240), np.inf, dtype=np.float32)
    moving = [FixedGeometry(scene.rig, scene.shutter, each) for each in (scene.motion, motion)]
    flows = [correction_flow(far, each, view) for each in moving]
    distortion, left = (np.mean(np.linalg.norm(flow, axis=-1)) for flow in (flows[0], flows[1] - flows[0]))
    assert distortion > 4.0 and left < 0.3 * distortion
    fused = find_corrected(wrap(CORRECTORS, corrector), problem, [view])[view]
    expected = RotationCorrector().correct(replace(problem, motion=motion), [view])[view]
    np.testing.assert_array_equal(fused.image, expected.image)


@pytest.mark.parametrize("name", ["lao-lines", "purkait-manhattan"])
def test_an_image_without_lines_is_a_failure_by_value(world: Build, name: str) -> None:
    problem = problem_of(world((), sky=True))
    grey = {view: np.full_like(image, 90) for view, image in problem.images.items()}
    found = find_corrected(load_corrector(name), replace(problem, images=grey), VIEWS)
    for fused in found.values():
        assert not fused.success and fused.reason.startswith("0 curves")


def test_curves_are_found_where_the_edges_are(world: Build, shapes: Any) -> None:
    """Of a camera at rest before upright and slanted edges: the projections of the lines."""
    scene = world((shapes[0]((0.0, 0.0, 1.0), 5.0),), w_deg=(0.0, 0.0, 0.0), d=(0.0, 0.0, 0.0), **SIZE)
    scene = replace(scene, texture=Stripes(FAN))
    curves = image_curves(problem_of(scene).images["left", 0], 20.0)
    K, offset = scene.rig.camera.K, scene.rig.offset("left")
    distances = []
    for curve in curves:
        off = []
        for a, b, c in FAN:
            # a X + b Y = c on the plane Z = 5, X = 5 x - offset.
            n = np.linalg.inv(K).T @ np.array([5.0 * a, 5.0 * b, -a * offset[0] - c])
            off.append(np.abs(np.column_stack([curve, np.ones(len(curve))]) @ n) / np.linalg.norm(n[:2]))
        distances.append(np.sqrt(np.mean(np.square(min(off, key=np.mean)))))
    assert len(curves) >= 6
    assert np.median(distances) < 0.05  # 8 bits
