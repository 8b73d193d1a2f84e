"""Whether a corrected frame can be trusted more than the one that was read. Truth: paths of points in closed form,
and frames of ``benchmarks/uncalibrated_video.py``, warped by a program of its own."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import programs
import pytest

from rsbench.core.camera import PinholeCamera
from rsbench.core.shutter import RollingShutter
from rsbench.pipeline import mono_sequence
from rsbench.pipeline.mono_sequence import UNTRUSTED, correct_frames, expected_errors
from rsbench.vision.mono_fusion import Flows

HEIGHT, WIDTH, RATIO = 60, 80, 0.8
TAU_OF_ROW = RATIO / HEIGHT
Y, X = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
IMAGE = np.clip(128.0 + 2.0 * (X - 40.0), 0, 255).astype(np.uint8)
"""Two grey levels a px along x."""


def path(tau: Any) -> Any:
    """x of every point, less where it is at 0: it speeds up."""
    return 3.0 * tau + 2.0 * tau**2


def pair(place: int) -> tuple[Any, int]:
    """The flow of that frame of a pair along ``path``, which is horizontal: rows stay, and their times."""
    start = TAU_OF_ROW * Y
    to = path(start + 1.0 - 2.0 * place) - path(start)
    flow, returns = np.stack([to, np.zeros_like(to)], axis=-1).astype(np.float32), np.zeros(to.shape, np.float32)
    own = SimpleNamespace(shutter=RollingShutter(height=HEIGHT, readout_ratio=RATIO))
    return SimpleNamespace(own=own, flows=Flows((flow, flow), (returns, returns))), place


def _halved(flows: Flows) -> Flows:
    """The flow as found at half the size: one px of it is two of the frame, over which the image changes twice as
    much."""
    first, second = (each[::2, ::2] / np.float32(2.0) for each in flows.flow)
    returns = flows.returns[0][::2, ::2]
    return Flows((first, second), (returns, returns), (2.0, 2.0))


def drawn_at(line: float) -> np.ndarray:
    return np.stack([X + path(TAU_OF_ROW * line) - path(TAU_OF_ROW * Y), Y], axis=-1)


def test_errors_are_those_of_places_times_gradients() -> None:
    """A parabola holds a path that speeds up evenly, exactly; a line errs by its curve."""
    line, true = 30.0, drawn_at(30.0)
    read = np.mean((2.0 * (true[..., 0] - X)[:, 10:-10]) ** 2)
    right, kept = expected_errors(IMAGE, true, [pair(1), pair(0)], line)
    assert right < 1e-6 * kept
    assert kept == pytest.approx(read, rel=0.15)  # gradients vanish at the border
    off, same = expected_errors(IMAGE, true + np.array([0.5, 0.0]), [pair(1), pair(0)], line)
    assert same == kept and off == pytest.approx(1.0, rel=0.15)  # half a px of 2 levels
    by_line, _ = expected_errors(IMAGE, true, [pair(0)], line)
    assert 1e-3 < by_line / kept < 0.2
    half: list[tuple[Any, int]] = []
    for each, place in (pair(1), pair(0)):
        half.append((SimpleNamespace(own=each.own, flows=_halved(each.flows)), place))
    small, kept_small = expected_errors(IMAGE, true, half, line)  # both in px of that size
    assert small < 1e-3 * kept_small and kept_small == pytest.approx(kept, rel=0.15)
    worse, _ = expected_errors(IMAGE, 2.0 * np.stack([X, Y], axis=-1) - true, [pair(1), pair(0)], line)
    assert worse > 3.0 * kept  # moved the wrong way


@pytest.mark.slow
def test_no_frame_of_a_camera_that_is_wrong_comes_out_worse(monkeypatch: pytest.MonkeyPatch) -> None:
    """A lens 2.5 times too long, under which some frames come out worse if all are believed; 0.2 dB is allowed."""
    bench = programs.program("benchmarks/uncalibrated_video.py")
    frames, truths = bench.video((2, 0.65, 0.75), 7)
    width, height = bench.SIZE
    wrong = PinholeCamera.centred(width, height, 2.5 * 0.75 * width)
    shutter = RollingShutter(height=height, readout_ratio=0.65)
    gains, left = bench.gains(frames, truths, wrong, shutter)
    assert min(gains) >= -0.2
    for gain, reason in zip(gains, left, strict=True):
        assert (gain == 0.0) == (reason == UNTRUSTED)
    assert np.mean(gains) > 2.0


def test_a_frame_that_is_not_trusted_is_the_one_that_was_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mono_sequence, "expected_errors", lambda *_: (4.0, 1.0))
    rng = np.random.default_rng(0)
    wide = np.kron(rng.integers(0, 255, (30, 50)), np.ones((8, 8))).astype(np.uint8)
    frames = [np.ascontiguousarray(wide[:160, 6 * k : 6 * k + 200]) for k in range(3)]
    moments = list(
        correct_frames(
            frames, PinholeCamera.centred(200, 160, 200.0), RollingShutter(height=160, readout_ratio=0.5)
        )
    )
    for moment, frame in zip(moments, frames, strict=True):
        assert not moment.frames and moment.reason == UNTRUSTED
        np.testing.assert_array_equal(moment.shown["left"].image, frame)
