"""``rsbench correct`` guesses whose frames it is given, says so, and refuses what cannot be before work begins."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from commands import assert_refused, run_here

from rsbench.cli import correct_run
from rsbench.cli.correct_input import Arranged, arranged
from rsbench.core.errors import RsbenchError
from rsbench.storage.videos import Times, write_frames

SIZE, SPEED = (96, 128), 8.0
RIG = "baseline = 0.3\nreadout_ratio = 0.8\n[camera]\nfx = 150\nfy = 150\ncx = 31.5\ncy = 47.5\n"


def _seen(tau: np.ndarray) -> np.ndarray:
    noise = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 255, (96, 300)), (0, 0), 2.5)
    texture = cv2.normalize(noise, np.zeros_like(noise), 20, 235, cv2.NORM_MINMAX).astype(np.float32)
    x = (np.arange(SIZE[1])[None] + 90.0 - SPEED * tau[:, None]).astype(np.float32)
    y = np.broadcast_to(np.arange(SIZE[0], dtype=np.float32)[:, None], x.shape)
    grey = cv2.remap(texture, x, np.ascontiguousarray(y), cv2.INTER_CUBIC)
    return np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


ROWS = np.arange(SIZE[0]) / SIZE[0]


def _phone_video(path: Path) -> list[float]:
    """Six frames with sound, turned by 90 degrees: a gap of two periods after the second, the fourth twice."""
    taken = [0.0, 1.0, 3.0, 4.0, 4.0, 6.0]
    with av.open(str(path), mode="w") as file:
        stream, sound = (
            file.add_stream("libx264", rate=30, options={"crf": "8"}),
            file.add_stream("aac", rate=48000),
        )
        stream.width, stream.height, stream.pix_fmt = SIZE[1], SIZE[0], "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 600)
        one = 1 << 16
        stream.set_display_matrix([0, one, 0, -one, 0, 0, SIZE[0] * one, 0, 1 << 30])
        for begin in range(0, 9600, 1024):
            wave = np.sin(np.arange(begin, min(begin + 1024, 9600)) / 20.0).astype(np.float32)[None]
            part = av.AudioFrame.from_ndarray(wave, format="fltp", layout="mono")
            part.sample_rate = 48000
            file.mux(sound.encode(part))
        for stamp, tau in zip((0, 20, 60, 80, 100, 120), taken, strict=True):
            frame = av.VideoFrame.from_ndarray(_seen(tau + ROWS), format="rgb24")
            frame.pts, frame.time_base = stamp, Fraction(1, 600)
            file.mux(stream.encode(frame))
        file.mux([*stream.encode(None), *sound.encode(None)])
    return taken


@pytest.mark.slow
def test_a_phone_s_video_becomes_an_upright_one_with_sound_and_a_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    taken = _phone_video(tmp_path / "film.mp4")
    result = run_here("correct", "film.mp4", "--readout-ratio", "1", "--fov", "53")
    assert result.returncode == 0, result.stderr
    for words in (
        "taken as one camera's",
        "turned by 90 degrees",
        "1 of 6 frames repeat",
        "the time stamps are used",
    ):
        assert words in result.stdout
    frames = [frame.to_ndarray(format="rgb24") for frame in av.open("film-corrected.mp4").decode(video=0)]
    for frame, tau in zip(frames, taken, strict=True):
        rolling, truth = (_seen(tau + each).astype(float) for each in (ROWS, np.full(SIZE[0], 0.5)))
        inner = np.s_[8:-8, 24:-24]
        before, after = (np.sqrt(np.mean((image - truth)[inner] ** 2)) for image in (rolling, frame))
        assert after < 0.4 * before  # what H.264 loses, twice, is a fifth of it
    # The copy has its twin's result, to what H.264 makes of it: two frames of the video differ by 15 levels.
    assert np.mean(np.abs(frames[3].astype(float) - frames[4])) < 1.0
    with av.open("film-corrected.mp4") as written, av.open("film.mp4") as read:
        times = [[round(600 * frame.time) for frame in each.decode(video=0)] for each in (written, read)]
        assert times[0] == times[1]
        assert written.streams.audio[0].codec_context.name == "aac"
    assert cv2.VideoCapture("film-corrected.mp4").read()[1].shape == (SIZE[1], SIZE[0], 3)
    record = json.loads(Path("film-corrected.json").read_text())
    assert [each.get("copy_of") for each in record["frames"]] == [None, None, None, None, 3, None]
    page = Path("film-corrected.html").read_text()
    assert "film-corrected-compare.mp4" in page and "changed most" in page and "depth" in page
    both = cv2.VideoCapture("film-corrected-compare.mp4").read()[1]
    assert both.shape == (SIZE[1], 2 * SIZE[0], 3)
    # What a second run writes takes the place of the first.
    assert run_here("correct", "film.mp4", "--readout-ratio", "1", "--fov", "53").returncode == 0


@pytest.mark.slow
def test_a_still_video_is_told_once(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    still = [np.clip(_seen(ROWS) + rng.normal(0, 1, (*SIZE, 3)), 0, 255).astype(np.uint8) for _ in range(4)]
    write_frames(tmp_path / "a.mkv", still, fps=30.0)
    for options in (["--seed", "0"], ["--readout-ratio", "0.8"]):
        result = run_here("correct", tmp_path / "a.mkv", "--out", tmp_path / "out.mp4", *options)
        assert result.returncode == 1
        assert result.stderr.count("nothing moves") == 1 and "readout_ratio" not in result.stderr


def _films(folder: Path) -> dict[str, Path]:
    found = {name: folder / name for name in ("a.mp4", "b.mp4", "0.png", "1.png", "2.png", "3.png", "dir")}
    for name, path in found.items():
        path.mkdir() if name == "dir" else path.touch()
    return found


@pytest.mark.parametrize(
    ("given", "rig", "sides", "one"),
    [
        ("a.mp4", False, False, True),
        ("dir", False, False, True),
        ("0.png 1.png", False, False, True),
        ("0.png 1.png 2.png", False, False, True),
        ("a.mp4 b.mp4", True, False, False),
        ("a.mp4", True, True, False),
        ("0.png 1.png 2.png 3.png", True, False, False),
    ],
)
def test_what_is_given_is_one_camera_s_unless_there_is_a_rig(
    tmp_path: Path, given: str, rig: bool, sides: bool, one: bool
) -> None:
    names = _films(tmp_path)
    card = tmp_path / "rig.toml" if rig else None
    found = arranged([names[each] for each in given.split()], card, None, None, None, None, sides)
    assert found.one_camera == one and bool(found.words) == one


@pytest.mark.parametrize(
    ("given", "rig", "sides", "words"),
    [
        ("0.png", False, False, "one image does not show"),
        ("0.png 1.png 2.png 3.png", False, False, "--rig: is required with four images.*--frames, or --camera"),
        ("a.mp4 b.mp4", False, False, "--rig: is required with two videos"),
        ("a.mp4", True, False, "--side-by-side"),
        ("a.mp4", False, True, "--rig: is required with --side-by-side"),
        ("a.mp4 0.png", False, False, "2 inputs"),
        ("", False, False, "give a video, a folder or images"),
        ("clip_a.mp4", False, False, r"clip_a\.mp4: does not exist; nearest here: a\.mp4"),
    ],
)
def test_what_does_not_go_together_is_told(tmp_path: Path, given: str, rig: bool, sides: bool, words: str) -> None:
    _films(tmp_path)
    card = tmp_path / "rig.toml" if rig else None
    with pytest.raises(RsbenchError, match=words):
        arranged([tmp_path / each for each in given.split()], card, None, None, None, None, sides)


@pytest.mark.parametrize(
    ("out", "words"),
    [("x.webm", "not written; give .mp4"), ("x.png", "no image"), ("a.mp4/out", "is a file")],
)
def test_a_place_that_cannot_be_is_refused_before_anything_is_read(tmp_path: Path, out: str, words: str) -> None:
    names = _films(tmp_path)  # an empty video, which would be refused as one
    assert_refused(run_here("correct", names["a.mp4"], "--out", tmp_path / out), words)


def test_halves_of_a_frame_are_the_cameras_of_a_rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    both = [np.hstack([_seen(tau + ROWS), _seen(tau + ROWS)[::-1]]) for tau in (0.0, 1.0)]
    times = Times(seconds=np.arange(2.0), stamps=(0, 1), base=Fraction(1), nearly=np.zeros(2, np.float32))
    write_frames(tmp_path / "a.mkv", both, fps=30.0, times=times)
    (tmp_path / "rig.toml").write_text(RIG)
    calls = list[Any]()
    monkeypatch.setattr(correct_run, "correct_given", lambda given, *rest: calls.append(given))
    given = ("correct", tmp_path / "a.mkv", "--rig", tmp_path / "rig.toml", "--side-by-side")
    assert run_here(*given, "--out", tmp_path / "out").returncode == 0
    left, right = calls[0].sources()
    np.testing.assert_array_equal(next(iter(left)), _seen(ROWS))
    np.testing.assert_array_equal(next(iter(right)), _seen(ROWS)[::-1])


def test_one_camera_is_arranged_as_before_with_its_options(tmp_path: Path) -> None:
    names = _films(tmp_path)
    found = arranged([names["0.png"], names["1.png"]], None, tmp_path / "camera.toml", None, None, None, False)
    assert isinstance(found, Arranged) and found.one_camera and not found.words
    found = arranged(None, None, None, names["dir"], None, None, False)
    assert found.one_camera and found.left == names["dir"] and not found.words
