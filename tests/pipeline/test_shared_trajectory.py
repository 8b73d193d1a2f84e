"""One way through the frames of a video. Truth: the same pairs in other groups, and frames of a known shake."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import cast

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rsbench.components.motion_models import InertialMotion
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.pipeline import mono_correction
from rsbench.pipeline.mono_correction import (
    FoundOwnMotion,
    SeenPair,
    group_of,
    motion_of_pair,
    shared_trajectory,
)
from rsbench.pipeline.mono_sequence import _readouts_away, correct_frames
from rsbench.pipeline.sequence_capture import CorrectedMoment
from rsbench.solvers.engine.robust_motion import RobustOptions
from rsbench.vision.mono_fusion import Flows, MonoFusion, OwnMotion

WIDTH, HEIGHT, FOCAL = 160, 120, 160.0
COUNT = 14


def texture() -> NDArray[np.float32]:
    noise = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 255, (300, 220)), (0, 0), 2.0)
    return cv2.normalize(noise, np.zeros_like(noise), 0, 255, cv2.NORM_MINMAX).astype(np.float32)


def picture(tau: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Rows read at times (HEIGHT,), of a wall that goes down evenly and shakes sideways by 2 px."""
    x = np.arange(WIDTH) + 30.0 - 2.0 * np.sin(2.0 * np.pi * tau[:, None] / 1.6)
    y = np.arange(HEIGHT)[:, None] + 120.0 - 6.0 * tau[:, None] + 0.0 * x
    seen = cv2.remap(texture(), x.astype(np.float32), y.astype(np.float32), cv2.INTER_CUBIC)
    return np.clip(np.rint(seen), 0, 255).astype(np.uint8)


def frames(count: int) -> Iterator[NDArray[np.uint8]]:
    for frame in range(count):
        yield picture(frame + np.arange(HEIGHT) / HEIGHT)


def moments(count: int, done: int = 0) -> list[CorrectedMoment]:
    shutter = RollingShutter(height=HEIGHT, width=WIDTH, readout_ratio=1.0)
    return list(correct_frames(frames(count), PinholeCamera.centred(WIDTH, HEIGHT, FOCAL), shutter, done=done))


OWN = OwnMotion(
    rig=StereoRig(camera=PinholeCamera.centred(WIDTH, HEIGHT, FOCAL), baseline=1.0).about("left"),
    shutter=RollingShutter(height=HEIGHT, width=WIDTH, readout_ratio=1.0),
    side="left",
    motion=InertialMotion([0.0] * 3, [1.0, 0.0, 0.0]),
)


@pytest.fixture(scope="module")
def whole() -> list[CorrectedMoment]:
    return moments(COUNT)


@pytest.mark.slow
def test_frames_of_a_shaken_video_stand_where_they_should(whole: list[CorrectedMoment]) -> None:
    """Much better than two frames at a time, which do not show what both shake alike."""

    def error(moment: CorrectedMoment, number: int) -> float:
        truth = picture(np.full(HEIGHT, number + (HEIGHT - 1) / (2 * HEIGHT))).astype(float)
        return float(np.sqrt(np.mean((moment.shown["left"].image - truth)[12:-12, 12:-12] ** 2)))

    shutter = RollingShutter(height=HEIGHT, width=WIDTH, readout_ratio=1.0)
    camera, video = PinholeCamera.centred(WIDTH, HEIGHT, FOCAL), list(frames(COUNT))
    inner = range(2, COUNT - 1)
    apart = [error(list(correct_frames(video[k - 1 : k + 1], camera, shutter))[1], k) for k in inner]
    together = [error(whole[k], k) for k in inner]
    assert np.mean(together) < 0.6 * np.mean(apart)


@pytest.mark.slow
@pytest.mark.parametrize("done", [1, 9, 11, COUNT - 1, COUNT])
def test_a_run_that_goes_on_writes_the_same_frames(whole: list[CorrectedMoment], done: int) -> None:
    later = moments(COUNT, done)
    assert [moment.number for moment in later] == list(range(done, COUNT))
    for ours, theirs in zip(later, whole[done:], strict=True):
        np.testing.assert_array_equal(ours.shown["left"].image, theirs.shown["left"].image)
        np.testing.assert_array_equal(ours.shown["left"].depth, theirs.shown["left"].depth)


def test_pairs_are_grouped_in_order_with_those_beside_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """A trajectory is fitted to a group and two pairs on either side, and ends at a pair that shows no motion."""
    runs: list[list[int]] = []

    def noted(run: list[SeenPair], *rest: object) -> list[str]:
        runs.append([int(pair.matches[0, 0]) for pair in run])
        return [f"{number} in {len(run)}" for number in runs[-1]]

    monkeypatch.setattr(mono_correction, "_trajectory_motions", noted)
    pairs = [SeenPair(matches=np.full((0 if k == 14 else 60, 4), float(k))) for k in range(25)]
    found = list(shared_trajectory(pairs, OWN.rig, OWN.shutter))
    expected = [f"{k} in 12" for k in range(10)] + [f"{k} in 6" for k in range(10, 14)] + [None]
    expected += [f"{k} in 7" for k in range(15, 20)] + [f"{k} in 7" for k in range(20, 25)]
    assert found == expected
    assert runs == [
        list(range(12)),
        list(range(8, 14)),
        list(range(15, 22)),
        list(range(18, 25)),
    ]
    first = 16
    begin = group_of(first)[0]
    assert begin == 8
    assert list(shared_trajectory(pairs[begin:], OWN.rig, OWN.shutter, begin, first)) == found[first:]
    assert list(shared_trajectory([], OWN.rig, OWN.shutter)) == []


def test_a_pair_that_a_trajectory_does_not_explain_keeps_its_own_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    here = np.random.default_rng(0).uniform(20.0, 100.0, (200, 2))
    matches = np.concatenate([here, here + np.array([6.0, 0.0])], axis=1)
    flow = np.tile(np.array([6.0, 0.0], np.float32), (HEIGHT, WIDTH, 1))
    flows, estimated = Flows((flow, -flow), (flow[..., 1], flow[..., 1])), list[object]()
    own = FoundOwnMotion(own=OWN, robust=None)
    monkeypatch.setattr(mono_correction, "find_steady_motion", lambda *rest: estimated.append(rest) or own)

    def motion(path: InertialMotion | None) -> FoundOwnMotion:
        return motion_of_pair(path, matches, flows, OWN.rig, OWN.shutter, RobustOptions())

    along = InertialMotion([0.0] * 3, [-1.0, 0.0, 0.0])
    explained = motion(along)
    assert explained.own.motion is along and not estimated
    assert explained.robust is not None and explained.robust.inlier_count == explained.robust.match_count == 200
    across = InertialMotion([0.0] * 3, [0.0, 1.0, 0.0])
    assert motion(across) is own and motion(None) is own and len(estimated) == 2
    pairs = [SeenPair(matches=matches)] * 3
    assert list(shared_trajectory(pairs[:2], OWN.rig, OWN.shutter)) == [None] * 2
    monkeypatch.setattr(mono_correction, "camera_trajectory", lambda *rest: None)
    assert list(shared_trajectory(pairs, OWN.rig, OWN.shutter)) == [None] * 3


def test_the_start_of_a_trajectory_turns_as_the_camera_does() -> None:
    """Truth: points at rest, seen by a global-shutter camera that turns and moves; and one match sixty times."""
    rng, camera = np.random.default_rng(1), OWN.rig.camera
    points = rng.uniform([-3.0, -2.0, 3.0], [3.0, 2.0, 9.0], (400, 3))
    w, d = np.deg2rad([1.0, -2.0, 0.5]), np.array([0.1, 0.05, -0.2])
    seen = [camera.project(points), camera.project(points @ so3.exp(w).T + d)]
    inside = np.all([(p >= 0.0) & (p <= [WIDTH - 1, HEIGHT - 1]) for p in seen], axis=(0, 2))
    found = mono_correction._global_shutter_motion(np.concatenate(seen, axis=1)[inside], camera)
    np.testing.assert_allclose(found.w, w, atol=1e-3)
    assert abs(found.d @ d) > 0.999 * np.linalg.norm(d)
    for nothing in (np.zeros((60, 4)), np.full((60, 4), np.nan)):
        assert not np.any(mono_correction._global_shutter_motion(nothing, camera).w)


def test_the_neighbour_nearer_in_time_corrects_a_frame() -> None:
    """After a missing frame it is the next one; with even times the side of the target's row decides."""

    def first(periods: tuple[float, float], line: float) -> int:
        pairs = [
            SimpleNamespace(own=SimpleNamespace(shutter=RollingShutter(height=HEIGHT, readout_ratio=0.8 / period)))
            for period in periods
        ]
        return min((0, 1), key=lambda k: _readouts_away(cast(MonoFusion, pairs[k]), 1 - k, line))

    middle = (HEIGHT - 1) / 2
    assert [first((1.0, 1.0), line) for line in (0.0, middle, HEIGHT - 1.0)] == [0, 0, 1]
    assert [first((2.0, 1.0), line) for line in (0.0, middle)] == [1, 1]
    assert first((1.0, 2.0), HEIGHT - 1.0) == 0
