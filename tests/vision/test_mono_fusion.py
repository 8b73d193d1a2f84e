"""Two frames of one camera to one image: border depth, motion model, gyroscope."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from commands import assert_refused, run_here
from hypothesis import given
from hypothesis import strategies as st

import rsbench
from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.components.motion_models import make_motion
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter, Scan
from rsbench.core.so3 import FloatArray
from rsbench.core.spline_motion import SplineMotion
from rsbench.interop.readers.gyro_log import read_gyro_log
from rsbench.pipeline.mono_correction import (
    FoundOwnMotion,
    find_own_motion,
    refusal,
    select_motion_model,
)
from rsbench.pipeline.mono_gyro import CONTRADICTED, NOT_COVERED
from rsbench.pipeline.mono_sequence import correct_frames, options_of_camera
from rsbench.pipeline.sequence_capture import CorrectedMoment
from rsbench.solvers.engine.robust_motion import RobustEstimate, RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver
from rsbench.storage.files import read_json, read_png, write_png
from rsbench.vision.fusion import Fused, Origin, finished
from rsbench.vision.mono_fusion import Flows, MonoFusion, OwnMotion, continued, find_flows

Build = Callable[..., Any]
SIZE = {"size": (240, 320), "focal": 300.0, "readout_ratio": 1.0, "shortest": 0.5}


@pytest.fixture(scope="module")
def scene(world: Build, shapes: Any) -> Any:
    """A leaning wall, and a ball before it; the motion is that of the left camera."""
    plane, sphere = shapes
    made = world((plane((0.3, 0.2, 1.0), 7.0), sphere((0.4, 0.3, 4.0), 0.8)), d=(0.3, -0.1, 0.2), **SIZE)
    return replace(made, rig=made.rig.about("left"))


class Seen(NamedTuple):
    """The left frames, their flow, and the motion that it shows."""

    images: list[np.ndarray]
    flows: Flows
    own: OwnMotion

    def fused(self, frame: int, target: float, **changes: Any) -> Fused:
        return MonoFusion(self.images, replace(self.own, **changes), self.flows).corrected(frame, target)


@pytest.fixture(scope="module")
def seen(scene: Any, u8: Any) -> Seen:
    images = [u8(scene.rolling("left", frame)[0]) for frame in (0, 1)]
    flows = find_flows(images)
    return Seen(images, flows, find_own_motion(flows, scene.rig, scene.shutter, "left", RobustOptions()).own)


def _inside(truth: Any) -> np.ndarray:
    """Pixels around which the frame shows everything."""
    return cv2.erode(truth.visible.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)


def _rms(a: Any, b: Any, mask: Any) -> float:
    return float(np.sqrt(np.mean((np.asarray(a, dtype=np.float64) - b)[mask] ** 2)))


@pytest.mark.parametrize("frame", [0, 1])
def test_a_frame_becomes_the_global_shutter_image(scene: Any, seen: Seen, truth: Any, frame: int) -> None:
    fused = seen.fused(frame, frame + 0.5)
    true = truth(scene, "left", frame, frame + 0.5)
    inside, shown = _inside(true), 255.0 * true.image
    # Away from what the frame does not show, a wrong time or sign would leave most of the uncorrected error; the
    # flow's own error of a tenth of a pixel leaves less than a quarter.
    assert _rms(fused.image, shown, inside) < 0.25 * _rms(seen.images[frame], shown, inside)
    assert np.mean(fused.origin == Origin.HERE) > 0.85


def test_motion_and_depth_have_the_unit_of_the_translation(scene: Any, seen: Seen, truth: Any) -> None:
    motion, length = seen.own.motion, float(np.linalg.norm(scene.motion.d))
    assert motion is not None and np.linalg.norm(motion.d) == pytest.approx(1.0)
    # 0.1 px of flow over 1500 matches and 30 px of parallax; the scene's linear motion is not quite inertial.
    assert np.rad2deg(np.arccos(motion.d @ scene.motion.d / length)) < 3.0
    assert np.rad2deg(np.linalg.norm(motion.w - scene.motion.w)) < 0.1
    true = truth(scene, "left", 1, 1.5)
    depth = seen.fused(1, 1.5).depth * length
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


@pytest.mark.parametrize("frame", [0, 1])
def test_where_no_law_explains_the_flow_the_flow_moves_everything(
    scene: Any, seen: Seen, truth: Any, frame: int
) -> None:
    """A motion that is wrong by 0.3 deg about each axis, 1.6 px: geometry alone would be off by as much."""
    motion = seen.own.motion
    assert motion is not None
    wrong = motion.with_endpoint(motion.w + np.deg2rad([0.3, -0.3, 0.3]), motion.d)
    true = truth(scene, "left", frame, frame + 0.5)
    with_wrong, with_flow = (
        _rms(seen.fused(frame, frame + 0.5, motion=each).image, 255.0 * true.image, _inside(true))
        for each in (wrong, None)
    )
    assert with_wrong < 1.1 * with_flow


def test_what_cannot_be_corrected_says_why() -> None:
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.uniform(0, 255, (120, 160)), (0, 0), 2.0)
    textured = cv2.normalize(noise, np.zeros_like(noise), 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    flat = np.full((120, 160), 90, np.uint8)
    assert "no texture" in refusal([flat, flat], find_flows([flat, flat]))
    assert "nothing moves" in refusal([textured, textured], find_flows([textured, textured]))
    moved = np.roll(textured, 4, axis=1)
    assert refusal([textured, moved], find_flows([textured, moved])) == ""


Y, X = np.mgrid[0:120, 0:160].astype(np.float64)


def band(side: str, width: int) -> np.ndarray:
    unknown = np.zeros(Y.shape, dtype=bool)
    along, at = (unknown.T if side in ("left", "right") else unknown), width
    along[: at if side in ("top", "left") else 0] = True
    along[len(along) - at if side in ("bottom", "right") else len(along) :] = True
    return unknown


@given(
    side=st.sampled_from(["top", "bottom", "left", "right"]),
    width=st.integers(1, 17),
    a=st.floats(-1e-3, 1e-3),
    b=st.floats(-1e-3, 1e-3),
)
def test_a_plane_goes_on(side: str, width: int, a: float, b: float) -> None:
    plane = (0.3 + a * X + b * Y).astype(np.float32)
    unknown = band(side, width)
    found = continued(np.where(unknown, np.float32(np.nan), plane))
    np.testing.assert_array_equal(found[~unknown], plane[~unknown])
    np.testing.assert_allclose(found[unknown], plane[unknown], rtol=1e-5)  # float32


def test_wide_bands_holes_and_what_is_no_plane_stay_unknown() -> None:
    plane = (0.3 + 1e-3 * X).astype(np.float32)
    wide, hole = band("bottom", 30), np.zeros(Y.shape, dtype=bool)
    hole[40:60, 50:70] = True
    steps = np.where(Y % 20 < 10, np.float32(0.2), np.float32(0.6))
    for depth, unknown in ((plane, wide), (plane, hole), (steps, band("bottom", 9))):
        found = continued(np.where(unknown, np.float32(np.nan), depth).astype(np.float32))
        np.testing.assert_array_equal(np.isnan(found), unknown)
    assert np.isnan(continued(np.full((20, 30), np.nan, np.float32))).all()


SHUTTER = RollingShutter(height=480, readout_ratio=0.8)
RIG = StereoRig(camera=PinholeCamera.centred(640, 480, 520.0), baseline=0.4).about("left")


def matches_of(motion: Motion, rng: np.random.Generator) -> FloatArray:
    options = SimulationOptions(tracks=1000, noise_px=0.1, outlier_ratio=0.05)
    return temporal_pairs(simulate(RIG, SHUTTER, motion, options, rng).correspondences, "left")


def found_of(matches: FloatArray, rig: StereoRig, seed: int = 0) -> RobustEstimate:
    solver = RefinedSolver(motion_model="inertial", one_camera=True)
    given, rng = Correspondences(left=matches), np.random.default_rng(seed)
    return estimate_motion(given, rig, SHUTTER, solver, RobustOptions(), rng)


def turns_between(a: Motion, b: Motion) -> float:
    """Degrees, the largest at the times of rows."""
    tau = np.linspace(0.0, 1.8, 19)
    R, S = a.body_from_world(tau).R, b.body_from_world(tau).R
    trace = np.trace(R @ np.swapaxes(S, 1, 2), axis1=1, axis2=2)
    return float(np.rad2deg(np.max(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)))))


@pytest.mark.parametrize("acceleration", [-0.3, 0.3])
def test_a_camera_that_accelerates_is_told(acceleration: float) -> None:
    """A law of constant speed leaves half a degree of a turn of 4; the points lie before the camera."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        w, d = (each / np.linalg.norm(each) for each in rng.normal(size=(2, 3)))
        true = make_motion("accelerated", 0.07 * w, 0.4 * d, {"acceleration": acceleration})
        matches = matches_of(true, rng)
        before = found_of(matches, RIG)
        robust, motion = select_motion_model(before, matches, RIG, SHUTTER, RobustOptions())
        assert motion.name == "accelerated" and robust.estimate.success
        constant = make_motion("inertial", before.estimate.w, before.estimate.d)
        assert turns_between(motion, true) < 0.2 * turns_between(constant, true)
        assert motion.d @ d > 0.99 * np.linalg.norm(motion.d)
        assert robust.inlier_count > 0.85 * robust.match_count == 0.85 * len(matches)


@pytest.mark.parametrize("model", ["linear", "twist", "inertial"])
def test_constant_speed_stays_constant_speed(model: str) -> None:
    """And rows turn as they did to a fiftieth of a degree, whichever of these laws is taken."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        w, d = (each / np.linalg.norm(each) for each in rng.normal(size=(2, 3)))
        true = make_motion(model, 0.07 * w, 0.4 * d)
        matches = matches_of(true, rng)
        motion = select_motion_model(found_of(matches, RIG), matches, RIG, SHUTTER, RobustOptions())[1]
        assert motion.name != "accelerated" and turns_between(motion, true) < 0.02 * 4.0


@pytest.mark.parametrize("focal", [440.0, 600.0])
def test_a_wrong_focal_length_is_not_taken_for_an_acceleration(focal: float) -> None:
    """Said to be a sixth shorter or longer than it is: an acceleration would take up some of the error."""
    wrong = StereoRig(camera=PinholeCamera.centred(640, 480, focal), baseline=0.4).about("left")
    for seed in range(4):
        rng = np.random.default_rng(seed)
        w, d = (each / np.linalg.norm(each) for each in rng.normal(size=(2, 3)))
        matches = matches_of(make_motion("inertial", 0.03 * w, 0.4 * d), rng)
        motion = select_motion_model(found_of(matches, wrong), matches, wrong, SHUTTER, RobustOptions())[1]
        assert motion.name != "accelerated"


Array = np.ndarray
TAU = np.arange(-5, 41) / 16.0
"""Sixteen samples a frame period, as 500 Hz at 30 frames a second."""


def shaken(world: Callable[..., Any], shapes: Any, preset: str, seed: int = 0, scan: Scan = "top") -> Any:
    """A leaning wall and a ball, seen by a hand-held left camera."""
    plane, sphere = shapes
    size = {"size": (144, 192), "focal": 180.0, "readout_ratio": 1.0, "shortest": 0.5}
    made = world((plane((0.3, 0.2, 1.0), 7.0), sphere((0.4, 0.3, 4.0), 0.8)), **size)
    motion = SplineMotion(np.deg2rad([0.6, 1.0, -0.5]), np.array([0.15, -0.1, 0.2]), preset=preset, seed=seed)
    shutter = RollingShutter(height=144, width=192, readout_ratio=1.0, scan=scan)
    return replace(made, motion=motion, shutter=shutter, rig=made.rig.about("left"))


def measured(scene: Any, seed: int = 0) -> Array:
    """Samples (n, 4) with a bias of 0.02 rad/s and noise of 0.003 rad/s at 30 frames a second."""
    rng = np.random.default_rng(seed)
    bias, noise = 6e-4 * rng.normal(size=3), 1e-4 * rng.normal(size=(len(TAU), 3))
    return np.column_stack([TAU, scene.motion.velocity(TAU)[0] + bias + noise])


def corrected(scene: Any, u8: Any, gyro: Array | None) -> CorrectedMoment:
    """Its second frame at the time of its middle line."""
    frames = [u8(scene.rolling("left", frame)[0]) for frame in (0, 1)]
    options = options_of_camera(None, 0, (scene.rig.camera.height - 1) / 2)
    return list(correct_frames(frames, scene.rig.camera, scene.shutter, options, gyro=gyro))[1]


def psnr(moment: CorrectedMoment, scene: Any, truth: Any) -> float:
    """dB of what the frame saw, 4 px away from what it did not."""
    lines = scene.shutter.lines("left")
    true = truth(scene, "left", 1, float(scene.shutter.time_after((lines - 1) / 2, 1, "left")))
    seen = cv2.erode(true.visible.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    error = (moment.shown["left"].image.astype(float) - 255.0 * true.image)[seen]
    return float(10.0 * np.log10(255.0**2 / np.mean(error**2)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "seed", "scan", "gain"),
    [
        # What two frames cannot show: the rate of turn changes between the rows.
        ("handheld", 0, "top", 4.0),
        ("handheld", 1, "right", 4.0),
        ("driving", 0, "bottom", 4.0),
        # A constant rate fits: noise of the samples may cost a little, of more than 35 dB.
        ("steady", 0, "top", -0.5),
    ],
)
def test_a_gyroscope_tells_what_two_frames_do_not(
    world: Any, shapes: Any, u8: Any, truth: Any, preset: str, seed: int, scan: Scan, gain: float
) -> None:
    scene = shaken(world, shapes, preset, seed, scan)
    without, given = corrected(scene, u8, None), corrected(scene, u8, measured(scene))
    assert isinstance(given.found, FoundOwnMotion) and not given.found.unused
    assert psnr(given, scene, truth) > psnr(without, scene, truth) + gain
    motion = given.found.own.motion
    assert motion is not None and motion.name == "gyro"
    # The motion is that of the real camera, whatever side its lines are read from: 0.1 px of flow are 0.03 deg.
    assert np.rad2deg(np.linalg.norm(motion.w - scene.motion.w)) < 0.15


@pytest.mark.slow
@pytest.mark.parametrize("factor", [-1.0, 50.0])
def test_a_gyroscope_of_another_sign_or_unit_is_not_believed(
    world: Any, shapes: Any, u8: Any, factor: float
) -> None:
    scene = shaken(world, shapes, "handheld")
    wrong = measured(scene) * [1.0, factor, factor, factor]
    without, given = corrected(scene, u8, None), corrected(scene, u8, wrong)
    assert isinstance(given.found, FoundOwnMotion) and given.found.unused == CONTRADICTED
    np.testing.assert_array_equal(given.shown["left"].image, without.shown["left"].image)


def test_samples_of_another_time_are_not_used(world: Any, shapes: Any, u8: Any) -> None:
    scene = shaken(world, shapes, "steady")
    given = corrected(scene, u8, measured(scene)[:20])
    assert isinstance(given.found, FoundOwnMotion) and given.found.unused == NOT_COVERED


def test_frames_without_texture_are_corrected_by_rotation_alone(world: Any, shapes: Any, u8: Any) -> None:
    """A far light in the dark: refused without a gyroscope, in place with it."""
    plane, _ = shapes
    scene = shaken(world, shapes, "handheld")

    class Light:
        shortest = 1.0

        def __call__(self, X: Array) -> Array:
            apart = np.sum((X[..., :2] - [3.0, 20.0]) ** 2, axis=-1, keepdims=True)
            return np.repeat(0.1 + 0.6 * np.exp(-apart / 0.5), 3, axis=-1)

    def place(image: Array) -> Array:
        """Its middle, px."""
        bright = np.maximum(image[..., 0].astype(float) - 40.0, 0.0)
        y, x = np.indices(bright.shape)
        return np.array([np.sum(bright * x), np.sum(bright * y)]) / np.sum(bright)

    scene = replace(scene, surfaces=(plane((0.0, 0.0, 1.0), 60.0),), texture=Light())
    frames = [u8(scene.rolling("left", frame)[0]) for frame in (0, 1)]
    with pytest.raises(RsbenchError, match="no texture"):
        rsbench.correct(frames, camera=scene.rig.camera, readout_ratio=1.0)
    fused = rsbench.correct(frames, camera=scene.rig.camera, readout_ratio=1.0, gyro=measured(scene))[1]
    true = place(u8(scene.still("left", 1.0)[0]))
    before, after = (float(np.linalg.norm(place(image) - true)) for image in (frames[1], fused.image))
    # The way of 0.25 m moves what is 60 m away by 0.7 px at most, the gyroscope's bias by 0.1 px.
    assert before > 2.5 and after < 0.8
    assert np.all(np.isinf(fused.depth[fused.origin == 1]))


# Logs


def written(path: Path, title: str = "GYROFLOW IMU LOG", **keys: str) -> tuple[Path, Array, Array]:
    """A .gcsv of random rates; times in s, and rates in the camera's axes, rad/s."""
    rng = np.random.default_rng(1)
    raw = rng.integers(-3000, 3000, (30, 3))
    head = {"version": "1.3", "id": "logger", "orientation": "YxZ", "tscale": "0.002", "gscale": "0.001", **keys}
    head = {key: value for key, value in head.items() if value}
    rows = [f"{k},{a},{b},{c},0,0,16384" for k, (a, b, c) in enumerate(raw.tolist())]
    text = [title, *(f"{key},{value}" for key, value in head.items()), "t,gx,gy,gz,ax,ay,az", *rows, "30,17"]
    path.write_text("\n".join(text) + "\n", encoding="utf-8")
    # YxZ: up is their second column, left minus their first, backwards their third.
    up, left, back = raw[:, 1], -raw[:, 0], raw[:, 2]
    return path, 0.002 * np.arange(30), 0.001 * np.stack([-left, -up, -back], axis=-1)


def test_a_log_of_gyroflow(tmp_path: Path) -> None:
    path, times, rates = written(tmp_path / "log.gcsv", note="a, b")
    log = read_gyro_log(path)
    np.testing.assert_allclose(log.times_s, times, atol=1e-12)
    np.testing.assert_allclose(log.rates, rates, atol=1e-12)
    samples = log.samples(25.0, 0.004)
    np.testing.assert_allclose(samples[:, 0], (times - 0.004) * 25.0, atol=1e-12)
    # What carries points into the camera turns the other way.
    np.testing.assert_allclose(samples[:, 1:], -rates / 25.0, atol=1e-12)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"title": "BLACKBOX"}, "must begin with GYROFLOW IMU LOG"),
        ({"tscale": "fast"}, "log.gcsv:5: tscale: 'fast': must be numbers"),
        ({"tscale": "-1"}, "log.gcsv:5: tscale = -1: must be positive"),
        ({"orientation": "XYx"}, "log.gcsv:4: orientation = 'XYx'"),
    ],
)
def test_logs_that_are_none_are_refused(tmp_path: Path, keys: dict[str, str], words: str) -> None:
    path, _, _ = written(tmp_path / "log.gcsv", **keys)
    with pytest.raises(RsbenchError, match=words):
        read_gyro_log(path)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (["t,wx,wy,wz", "0,1,2,3"], "must have the columns stamp_ns,wx,wy,wz"),
        (["stamp_ns,wx,wy,wz", "0,1,2,x", "1,1,2,3"], "log.csv:2: '0 1 2 x': must be numbers"),
        (["stamp_ns,wx,wy,wz", "0,1,2,nan", "1,1,2,3"], "finite"),
        (["stamp_ns,wx,wy,wz", "5,1,2,3", "1,1,2,3"], "log.csv:3: its time is before"),
        (["stamp_ns,wx,wy,wz", "5,1,2,3", "5,1,2,3"], "one time"),
        (["stamp_ns,wx,wy,wz"], "two samples"),
        ([], "must have the columns"),
    ],
)
def test_tables_that_are_none_are_refused(tmp_path: Path, rows: list[str], words: str) -> None:
    (tmp_path / "log.csv").write_text("\n".join(rows), encoding="utf-8")
    with pytest.raises(RsbenchError, match=words):
        read_gyro_log(tmp_path / "log.csv")


def test_a_log_is_read_as_gyroflow_reads_it(tmp_path: Path) -> None:
    """Absent keys are ms, 1 and xzY; the first column may be ``time``, lines indented, cells empty."""
    path = tmp_path / "log.gcsv"
    path.write_text(
        "GYROFLOW IMU LOG v1\n  gscale, 0.5\n time , rx, ry, rz\n0, 2, 4, 6\n 1,,4,6\n 2, 8, 10, 12\n3, 2, 4, 6",
        encoding="utf-8-sig",
    )
    log = read_gyro_log(path)
    np.testing.assert_allclose(log.times_s, [0.0, 0.002, 0.003], atol=1e-15)
    # xzY: up = -x, left = -z, backwards = y; the camera's axes are right, down, forward.
    np.testing.assert_allclose(log.rates[0], 0.5 * np.array([6.0, 2.0, -4.0]), atol=1e-12)


@pytest.mark.parametrize("bits", [16, 24, 32])
def test_a_clock_that_begins_again_goes_on(tmp_path: Path, bits: int) -> None:
    ticks = (2**bits - 1500 + 1000 * np.arange(4)) % 2**bits
    rows = [f"{tick},1,2,3" for tick in ticks]
    path = tmp_path / "log.gcsv"
    path.write_text("\n".join(["GYROFLOW IMU LOG", "tscale,1e-6", "t,gx,gy,gz", *rows]), encoding="utf-8")
    np.testing.assert_allclose(np.diff(read_gyro_log(path).times_s), 1e-3, atol=1e-12)
    path.write_text(path.read_text("utf-8") + "\n7,1,2,3", encoding="utf-8")
    with pytest.raises(RsbenchError, match=r"log\.gcsv:\d: its time is before"):
        read_gyro_log(path)


@pytest.mark.slow
def test_the_command_takes_a_log(tmp_path: Path, world: Any, shapes: Any, u8: Any) -> None:
    scene = shaken(world, shapes, "handheld")
    for frame in (0, 1):
        write_png(tmp_path / f"{frame}.png", u8(scene.rolling("left", frame)[0]))
    (tmp_path / "camera.toml").write_text(
        "readout_ratio = 1.0\n[camera]\nfx = 180\nfy = 180\ncx = 95.5\ncy = 71.5\n"
    )
    samples, period = measured(scene), 1.0 / 20.0
    rows = [
        f"{round(1e9 * (1.5 + tau * period))},{','.join(map(repr, (-w / period).tolist()))}"
        for tau, w in zip(samples[:, 0], samples[:, 1:], strict=True)
    ]
    (tmp_path / "log.csv").write_text("stamp_ns,wx,wy,wz\n" + "\n".join(rows), encoding="utf-8")

    def run(*more: Any) -> Any:
        files = [tmp_path / "0.png", tmp_path / "1.png", "--camera", tmp_path / "camera.toml"]
        return run_here("correct", *files, "--target", "middle", "--out", tmp_path / "out", *more)

    assert_refused(run("--gyro", tmp_path / "log.csv"), "--fps")
    assert_refused(run("--gyro", tmp_path / "log.csv", "--fps", 20), "--gyro-offset")
    assert_refused(run("--gyro", tmp_path / "log.txt", "--fps", 20), ".gcsv")
    assert_refused(run("--fps", 20), "--gyro")
    done = run("--gyro", tmp_path / "log.csv", "--fps", 20, "--gyro-offset", 1.5)
    assert done.returncode == 0 and "clock" not in done.stdout, done.stderr
    record = read_json(tmp_path / "out" / "motion.json")
    assert [each["motion"]["model"] for each in record["frames"]] == ["gyro", "gyro"]
    image = read_png(tmp_path / "out" / "corrected" / "000001.png").astype(int)
    assert (
        np.max(np.abs(image - finished(corrected(scene, u8, samples).shown["left"]).image)) <= 1
    )  # times in whole nanoseconds
    early = [f"{int(row.split(',')[0]) - 1_500_000_000},{row.partition(',')[2]}" for row in rows]
    (tmp_path / "early.csv").write_text("stamp_ns,wx,wy,wz\n" + "\n".join(early), encoding="utf-8")
    shown = run("--gyro", tmp_path / "early.csv", "--fps", 20)
    assert "gyroscope's clock: the frames do not show its offset" in shown.stdout  # two of them
    assert read_json(tmp_path / "out" / "motion.json")["gyro_clock"]["used"] is False
