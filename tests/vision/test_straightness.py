"""Rotation from straight lines, and the correctors that use it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from rsbench.capture.hypotheses import KnownInputs
from rsbench.components.motion_models import LinearMotion
from rsbench.components.plugins import wrap
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.geometry import FixedGeometry
from rsbench.core.rig import VIEWS, View
from rsbench.core.shutter import RollingShutter
from rsbench.dataset.clock_channels import ImuSamples, gyro_samples, true_samples
from rsbench.pipeline.chain import Given, correct_four
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.vision.correction import correction_flow
from rsbench.vision.corrector import CORRECTORS, CorrectionProblem, find_corrected, load_corrector
from rsbench.vision.correctors import RotationCorrector
from rsbench.vision.fusion import Origin
from rsbench.vision.rotation_correctors import GyroCorrector, LinesCorrector, ManhattanCorrector
from rsbench.vision.straightness import (
    LineOptions,
    ManhattanOptions,
    Points,
    Turned,
    across,
    image_curves,
    lines_at,
    rotation_of_directions,
    rotation_of_lines,
    straightened,
)

CAMERA = PinholeCamera.centred(320, 320, 490.0)
SHUTTER = RollingShutter(height=320, readout_ratio=0.9)
MIDDLE = 0.5 * SHUTTER.row_time(319.0, 0)
PRIOR = np.radians(3.0)


def curve_of(normal: np.ndarray, w: np.ndarray, upright: bool, ends: tuple[int, int]) -> np.ndarray:
    """Places (n, 2) of the line of normal l, in the middle of the readout, in a frame of a camera that turns by w.

    In each row, or in each column, whose row is then found by fixed-point steps that shrink by w each.
    """
    along = np.arange(*ends, dtype=np.float64)
    x, y = (np.full_like(along, 160.0), along) if upright else (along, np.full_like(along, 160.0))
    for _ in range(1 if upright else 60):
        a, b, c = (so3.exp((SHUTTER.row_time(y, 0) - MIDDLE)[:, None] * w) @ normal).T
        if upright:
            x = CAMERA.cx - CAMERA.fx * (b * (y - CAMERA.cy) / CAMERA.fy + c) / a
        else:
            y = CAMERA.cy - CAMERA.fy * (a * (x - CAMERA.cx) / CAMERA.fx + c) / b
    return np.column_stack([x, y])


def line_at(pixel: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Normal of the line through a pixel that runs along a direction (3,) in space."""
    normal = np.cross(CAMERA.unproject(pixel), direction)
    return np.asarray(normal / np.linalg.norm(normal))


def lines_of(rng: np.random.Generator, w: np.ndarray, count: int = 8) -> list[np.ndarray]:
    """Upright curves, some slanted, of lines along directions of their own."""
    normals = [line_at(rng.uniform(60, 260, 2), np.array([rng.normal(0, 0.5), 1, 0.2])) for _ in range(count)]
    return [curve_of(n, w, True, (int(rng.integers(0, 120)), int(rng.integers(200, 320)))) for n in normals]


def town_of(rng: np.random.Generator, w: np.ndarray, count: int = 24) -> list[np.ndarray]:
    """Curves, some of them short, of lines along three orthogonal directions."""
    axes, curves = so3.exp(np.array([0.2, 0.5, 0.1])), list[np.ndarray]()
    for k in range(count):
        n = line_at(rng.uniform(60, 260, 2), axes[:, k % 3])
        first = int(rng.integers(0, 160))
        curves.append(curve_of(n, w, abs(n[0]) >= abs(n[1]), (first, first + int(rng.integers(60, 160)))))
    return curves


def points_of(curves: list[np.ndarray]) -> Points:
    return Points.of(curves, CAMERA, SHUTTER, ("left", 0))


@pytest.mark.parametrize("seed", range(3))
def test_exact_curves_of_lines_give_the_exact_rotation(seed: int) -> None:
    w = np.radians([2.5, -3.0, 4.0])
    found = straightened(points_of(lines_of(np.random.default_rng(seed), w)), np.zeros(3), PRIOR)
    np.testing.assert_allclose(found.w, w, atol=1e-11)  # rounding, times what noise in px becomes: up to 1e3
    determined = found.determined(PRIOR)
    assert determined is not None
    np.testing.assert_allclose(determined, w, atol=1e-11)


def test_derivatives_are_those_of_the_errors() -> None:
    """Of curves that fit nothing, in rows and in columns, against central differences."""
    rng = np.random.default_rng(2)
    curves = [each + rng.normal(0, 0.3, each.shape) for each in town_of(rng, np.radians([1.0, 2.0, -1.0]), 9)]
    points, w, h = points_of(curves), np.array([0.03, 0.02, -0.05]), 1e-6
    at = Turned.by(points, w)
    normals = lines_at(at) + 0.01
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ways = across(normals)
    by_turn = [
        Turned.by(points, w + h * u).errors(normals) - Turned.by(points, w - h * u).errors(normals)
        for u in np.eye(3)
    ]
    by_normals = [at.errors(normals + h * ways[:, k]) - at.errors(normals - h * ways[:, k]) for k in (0, 1)]
    for found, expected in ((at.by_turn(normals), by_turn), (at.by_normals(normals, ways), by_normals)):
        expected = np.stack(expected, axis=-1) / (2 * h)
        np.testing.assert_allclose(
            found, expected, atol=1e-6 * np.max(np.abs(expected))
        )  # rounding over the step: 1e-9


def test_stated_deviations_are_those_of_noise() -> None:
    """White noise counts as one error in eight px: it errs by less than stated, and not by a tenth of that."""
    w, ratios = np.radians([1.0, -1.0, 2.0]), list[float]()
    for seed in range(12):
        rng = np.random.default_rng(seed)
        curves = [
            each + np.column_stack([rng.normal(0, 0.1, len(each)), np.zeros(len(each))])
            for each in lines_of(rng, w)
        ]
        found = straightened(points_of(curves), np.zeros(3), 1.0)
        ratios.append(float((found.w - w) @ np.linalg.solve(found.covariance, found.w - w)))
    assert 3 * 0.1**2 < np.mean(ratios) < 3 * 1.5


def test_curves_that_were_no_lines_are_left_out() -> None:
    w = np.radians([2.0, -1.5, 3.0])
    curves = lines_of(np.random.default_rng(3), w, 12)
    y = np.arange(40.0, 280.0)
    bent = [np.column_stack([80 + 20 * k + 2e-3 * (1 + k) * (y - 160) ** 2, y]) for k in range(5)]
    found = rotation_of_lines(points_of([*curves, *bent]), LineOptions(), np.random.default_rng(0))
    assert not isinstance(found, str) and len(found.normals) == 12
    np.testing.assert_allclose(found.w, w, atol=1e-10)


@pytest.mark.parametrize("seed", range(3))
def test_exact_lines_along_three_directions_give_the_exact_rotation(seed: int) -> None:
    w = np.radians([2.0, -2.5, 3.0])
    points = points_of(town_of(np.random.default_rng(seed), w))
    found = rotation_of_directions(points, ManhattanOptions(), np.random.default_rng(0))
    assert not isinstance(found, str), found
    np.testing.assert_allclose(found.w, w, atol=1e-11)


def test_directions_tell_yaw_where_straightness_does_not() -> None:
    """Short pieces: bending tells next to nothing, shear a tenth of a degree."""
    rng, w = np.random.default_rng(5), np.radians([0.0, 2.0, 0.0])
    curves = [each + rng.normal(0, 0.05, each.shape) for each in town_of(rng, w)]
    points = points_of([each[:40] for each in curves])
    straight = straightened(points, np.zeros(3), PRIOR)
    along = rotation_of_directions(points, ManhattanOptions(), np.random.default_rng(0))
    assert not isinstance(along, str)
    assert np.sqrt(along.covariance[1, 1]) < 0.5 * np.sqrt(straight.covariance[1, 1])
    assert along.w[1] == pytest.approx(w[1], abs=4 * np.sqrt(along.covariance[1, 1]))


def test_lines_in_all_directions_are_no_town() -> None:
    curves = lines_of(np.random.default_rng(7), np.radians([1.0, 1.0, 1.0]), 40)
    found = rotation_of_directions(
        points_of(curves), ManhattanOptions(threshold_px=0.05), np.random.default_rng(0)
    )
    assert isinstance(found, str)


@pytest.mark.parametrize(
    ("find", "options", "counts"),
    [(rotation_of_lines, LineOptions(), (0, 3)), (rotation_of_directions, ManhattanOptions(), (0, 7))],
)
def test_too_few_curves_are_a_failure_by_value(find: Any, options: Any, counts: tuple[int, int]) -> None:
    for count in counts:
        points = points_of(town_of(np.random.default_rng(0), np.zeros(3), count)) if count else None
        found = find(points, options, np.random.default_rng(0))
        assert isinstance(found, str) and found.startswith(f"{count} curves")


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
    inputs = KnownInputs.of(scene.shutter)
    found = correct_four(images, scene.rig, inputs, options, given=Given(gyro=rates(scene)))
    assert found.matches is None and found.pairs is None
    assert all(fused.success for fused in found.frames.values())
    with pytest.raises(RsbenchError, match="corrector 'gyro': needs the samples of a gyroscope"):
        correct_four(images, scene.rig, inputs, options)


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
