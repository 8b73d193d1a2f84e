"""The example that trains a network. Truth: closed forms of planes that move evenly, and the renderer's twins."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import commands
import cv2
import numpy as np
import programs
import pytest
from numpy.typing import NDArray

import rsbench
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import StereoRig, View
from rsbench.core.shutter import RollingShutter
from rsbench.pipeline.mono_correction import MonoFusionCorrector
from rsbench.vision.corrector import CorrectionProblem
from rsbench.vision.mono_fusion import Flows, find_flows

torch: Any = pytest.importorskip("torch")
SIZE = WIDTH, HEIGHT = 160, 96
RATIO, SPEED = 0.8, np.array([5.0, -7.0])
"""Of a plane in px per frame period."""


@pytest.fixture(scope="module")
def script() -> ModuleType:
    torch.set_num_threads(1)  # as the program itself: two that share a core wait for each other
    return programs.program("examples/learn_flow.py")


def plane(frame: int) -> NDArray[np.uint8]:
    """A rolling-shutter frame of waves that move by ``SPEED``."""
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    time = frame + RATIO * y / HEIGHT
    u, v = x - SPEED[0] * time, y - SPEED[1] * time
    waves = (np.sin(0.31 * u + 0.13 * v), np.sin(0.11 * u - 0.37 * v), np.sin(0.05 * u * np.cos(0.3) + 0.21 * v))
    return np.repeat((127 + 40 * np.sum(waves, axis=0))[..., None], 3, axis=-1).round().astype(np.uint8)


def test_the_true_shift_leads_to_what_the_twin_shows(script: ModuleType, smoke_dataset: Path) -> None:
    """Depth and poses of a frame against another render, that of the first row's pose; grain is blurred away."""
    for sequence in rsbench.read_dataset(smoke_dataset):
        shift = script.true_shift(sequence, "right", 1, 0)
        u, v = np.moveaxis(sequence.rig.camera.pixel_grid().astype(np.float32) + shift, -1, 0)
        images = (sequence.image("gs", "right", 1), sequence.image("rs", "right", 1))
        twin, frame = (cv2.GaussianBlur(image.astype(np.float32), (0, 0), 2) for image in images)
        inside = (u > 0) & (u < 127) & (v > 60) & (v < 95)  # rows that are read late
        moved = np.abs(cv2.remap(twin, u, v, cv2.INTER_LINEAR) - frame)[inside]
        assert np.mean(moved) < 0.35 * np.mean(np.abs(twin - frame)[inside])  # of the opposite shift: above 1
        np.testing.assert_allclose(shift[0], 0, atol=1e-5)  # float32: that row is read at this time


def test_the_flow_of_a_plane_has_no_loss(script: ModuleType) -> None:
    """A point is seen dt sooner, in the row where it then lies: dt = rate * (rows it moved) - 1."""
    y = np.arange(HEIGHT)[:, None] * np.ones(WIDTH)
    passed = -1 / (1 - RATIO * SPEED[1] / HEIGHT)
    flow = torch.tensor(SPEED * passed)[None, :, None, None].expand(1, 2, HEIGHT, WIDTH)
    rows = np.array([0, HEIGHT // 2, HEIGHT - 1])
    shift = torch.tensor((RATIO * (rows[:, None, None] - y) / HEIGHT)[:, None] * SPEED[:, None, None])[None]
    ratio = torch.tensor([RATIO])
    assert script.loss_of(flow, ratio, shift).item() == pytest.approx(0.01, abs=1e-6)  # its least, 1e-4's root
    assert script.loss_of(flow * 1.5, ratio, shift).item() > 0.5


def test_flow_ahead_is_that_of_the_pair_that_is_turned(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With DIS, which errs by 0.1 px, as the network; the border, where the plane leaves the picture, aside."""
    monkeypatch.setattr(script, "_flow", lambda _, pair: find_flows(list(pair)).flow[1])
    there, back = script.learned_flows(None, script.Pair(plane(0), plane(1))).flow
    slower = 1 - RATIO * SPEED[1] / HEIGHT
    for flow, true in ((there, SPEED / slower), (back, -SPEED / slower)):
        np.testing.assert_allclose(np.median(flow[16:-16, 16:-16], axis=(0, 1)), true, atol=0.1)


def test_untrained_it_leaves_the_frame_as_it_was(script: ModuleType) -> None:
    pair = script.Pair(plane(0), plane(1))
    made = script.fusion(pair, script.learned_flows(script.FlowNet(), pair), RATIO)
    np.testing.assert_array_equal(made.corrected(1, 1.4).image, pair.second)


def test_with_dis_it_is_the_corrector_flow_scaled(script: ModuleType) -> None:
    images: dict[View, NDArray[np.uint8]] = {("left", frame): plane(frame) for frame in (0, 1)}
    rig = StereoRig(camera=PinholeCamera.centred(*SIZE, 200.0), baseline=0.1)
    problem = CorrectionProblem(
        images=images,
        rig=rig,
        shutter=RollingShutter(height=HEIGHT, readout_ratio=RATIO),
        target_row=HEIGHT // 2,
        motion=None,
        depth=None,
        guess=None,
    )
    theirs = MonoFusionCorrector(geometry=False).correct(problem, [("left", 1)])["left", 1]
    pair = script.Pair(plane(0), plane(1))
    made = script.fusion(pair, find_flows(list(pair)), RATIO).corrected(1, 1.0 + RATIO / 2)
    np.testing.assert_array_equal(made.image, theirs.image)


def test_training_goes_on_where_it_was_stopped(
    script: ModuleType, smoke_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the same bits; and it learns, from four pairs."""
    monkeypatch.setattr(script, "KEEP_EVERY", 4)
    monkeypatch.setattr(script, "WIDTH", 64)
    samples = script.read_samples(rsbench.read_dataset(smoke_dataset))
    assert samples.frames.shape == (8, 2, 96, 128) and samples.shift.shape == (8, 3, 2, 96, 128)
    nets = []
    for name in ("at once", "stopped"):
        torch.manual_seed(1)
        nets.append(script.FlowNet())
        if name == "stopped":
            with monkeypatch.context() as patch:
                patch.setattr(script, "progress", _stop)
                with pytest.raises(KeyboardInterrupt):
                    script.train(nets[-1], samples, 8, tmp_path / name)
            nets[-1] = script.FlowNet()
        script.train(nets[-1], samples, 8, tmp_path / name)
    batch = script.drawn(samples, 0)
    for one, other in zip(nets[0](batch.frames), nets[1](batch.frames), strict=True):
        assert torch.equal(one, other)
    before, after = (
        script.loss_of(net(batch.frames)[-1], batch.ratio, batch.shift).item()
        for net in (script.FlowNet(), nets[0])
    )
    assert after < before


def _stop(_: str, done: int, __: int) -> None:
    if done == 6:
        raise KeyboardInterrupt


def test_an_entry_has_no_faults(script: ModuleType, smoke_dataset: Path, tmp_path: Path) -> None:
    words = ("leaderboard", "export", "correction-mono", "--data", smoke_dataset, "--out", tmp_path / "inputs")
    assert commands.run_here(*words).returncode == 0
    script.predict(script.FlowNet(), tmp_path / "inputs", tmp_path / "entry", "learned-flow")
    file = tmp_path / "entry" / "predictions.jsonl"
    checked = commands.run_here("leaderboard", "check", file, "--data", smoke_dataset)
    assert checked.returncode == 0 and "0 faults" in checked.stdout, checked.stdout + checked.stderr


@pytest.mark.parametrize("wrong", ["public", "predict", "damaged", "steps"])
def test_what_is_wrong_is_one_line(
    script: ModuleType,
    wrong: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words, message = {
        "public": (["--public", str(tmp_path)], "has no folder Carla"),
        "predict": (["--predict", str(tmp_path)], "no network of 1800 steps"),
        "damaged": (["--predict", str(tmp_path)], "net.pt: is no state of this program: delete it"),
        "steps": (["--steps", "0"], "'0' must be a whole number"),
    }[wrong]
    if wrong == "damaged":
        (tmp_path / "net.pt").write_bytes(b"no network")
    monkeypatch.setattr("sys.argv", ["learn_flow.py", "--out", str(tmp_path), *words])
    with pytest.raises(SystemExit) as end:
        script.main()
    assert end.value.code == 2 and message in capsys.readouterr().err.splitlines()[-1]


def test_flow_of_larger_frames_is_in_their_pixels(script: ModuleType) -> None:
    """A network that says (1, 2) px at the size at which it sees them, half of theirs."""
    net = lambda frames: [torch.tensor([1.0, 2.0])[None, :, None, None].expand(1, 2, *frames.shape[-2:])]  # noqa: E731
    wide = np.zeros((96, 2 * script.WIDEST, 3), dtype=np.uint8)
    flows: Flows = script.learned_flows(net, script.Pair(wide, wide))
    np.testing.assert_allclose(flows.flow[1], np.broadcast_to([2.0, 4.0], (96, 2 * script.WIDEST, 2)), rtol=1e-6)
    np.testing.assert_allclose(flows.flow[0][..., 1], -4.0, rtol=1e-6)
