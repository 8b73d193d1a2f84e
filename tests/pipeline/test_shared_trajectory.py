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
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.pipeline import mono_correction
from rsbench.pipeline.mono_correction import FoundOwnMotion, SeenPair, group_of, with_shared_trajectory
from rsbench.pipeline.mono_sequence import _kept, _readouts_away, _RoundedFlows, correct_frames
from rsbench.pipeline.sequence_capture import CorrectedMoment
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


def test_pairs_are_told_in_order_with_those_beside_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which pairs a way is made of: the group and two on either side, cut where a pair shows no motion."""
    runs: list[list[int]] = []

    def noted(run: list[tuple[int, SeenPair]]) -> dict[int, FoundOwnMotion]:
        runs.append([number for number, _ in run])
        return {}

    monkeypatch.setattr(mono_correction, "_trajectory_motions", noted)
    monkeypatch.setattr(mono_correction, "_is_usable", lambda pair: pair.found is not None)
    marks = [FoundOwnMotion(own=OWN, robust=None, reason=str(k)) for k in range(25)]
    pairs = [SeenPair(found=None if k == 14 else mark, matches=np.zeros((0, 4))) for k, mark in enumerate(marks)]
    told = list(with_shared_trajectory(pairs))
    assert [None if each is None else each.reason for each in told] == [
        None if k == 14 else str(k) for k in range(25)
    ]
    assert runs == [
        list(range(12)),
        list(range(8, 14)),
        list(range(15, 22)),
        list(range(18, 25)),
    ]
    first = 16
    begin = group_of(first)[0]
    assert begin == 8
    assert list(with_shared_trajectory(pairs[begin:], begin, first)) == told[first:]
    assert list(with_shared_trajectory([], 0, 0)) == []


def test_a_pair_that_a_way_does_not_explain_keeps_its_own_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    """Or where there are fewer than three pairs in a row, or no way is found."""
    here = np.random.default_rng(0).uniform(20.0, 100.0, (200, 2))
    pair = SeenPair(
        found=FoundOwnMotion(own=OWN, robust=None),
        matches=np.concatenate([here, here + np.array([6.0, 0.0])], axis=1),
    )
    along, across = InertialMotion([0.0] * 3, [-1.0, 0.0, 0.0]), InertialMotion([0.0] * 3, [0.0, 1.0, 0.0])
    monkeypatch.setattr(mono_correction, "camera_trajectory", lambda *rest: [along, across, along])
    told = list(with_shared_trajectory([pair] * 3))
    assert [each is pair.found for each in told] == [False, True, False]
    assert all(each is pair.found for each in with_shared_trajectory([pair] * 2))
    monkeypatch.setattr(mono_correction, "camera_trajectory", lambda *rest: None)
    assert all(each is pair.found for each in with_shared_trajectory([pair] * 3))


def test_flow_that_waits_takes_little_memory_and_is_hardly_changed() -> None:
    rng = np.random.default_rng(0)

    def kept(height: int, width: int) -> tuple[Flows, Flows | _RoundedFlows | None]:
        two = rng.normal(0.0, 30.0, (2, height, width, 2)).astype(np.float32)
        flows = Flows((two[0], two[1]), (abs(two[0, ..., 0]), abs(two[1, ..., 0])))
        return flows, _kept(flows)

    small, same = kept(480, 640)
    assert same is small
    large, rounded = kept(1080, 1920)
    assert isinstance(rounded, _RoundedFlows)
    again = rounded.restored()
    for before, after in zip((*large.flow, *large.returns), (*again.flow, *again.returns), strict=True):
        np.testing.assert_allclose(after, before, atol=1 / 128, rtol=1e-3)
    assert kept(2160, 3840)[1] is None


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
