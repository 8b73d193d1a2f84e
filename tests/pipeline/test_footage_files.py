"""Footage as phones, cameras and other tools write it: order, times, copies, orientation, colours, sizes."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from rsbench.components.cards import parse_card
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.shutter import RollingShutter
from rsbench.dataset.card import MotionCard
from rsbench.pipeline import mono_sequence
from rsbench.pipeline.footage import FrameSource, read_frame
from rsbench.pipeline.mono_correction import FoundOwnMotion, flow_matches
from rsbench.pipeline.mono_sequence import correct_frames, options_of_camera
from rsbench.storage.untrusted_files import PIXELS, check_size
from rsbench.storage.videos import Times, VideoFile, upright, write_frames
from rsbench.vision import epipolar_search
from rsbench.vision.mono_fusion import find_flows

SIZE = (96, 128)


def _noise(seed: int, size: tuple[int, int] = SIZE, sigma: float = 3.0) -> np.ndarray:
    """Smooth grey noise in three channels, for H.264 halves the resolution of colour."""
    grey = cv2.GaussianBlur(np.random.default_rng(seed).uniform(0, 255, size), (0, 0), sigma)
    level = cv2.normalize(grey, np.zeros_like(grey), 20, 235, cv2.NORM_MINMAX).astype(np.uint8)
    return np.repeat(level[..., None], 3, axis=2)


def _video(path: Path, frames: list[np.ndarray], stamps: list[int], base: int = 600, **more: Any) -> Path:
    times = Times(
        seconds=np.array(stamps) / base,
        stamps=tuple(stamps),
        base=Fraction(1, base),
        nearly=np.zeros(len(stamps), np.float32),
    )
    write_frames(path, frames, fps=30.0, times=times, **more)
    return path


def _gradient(seed: int, count: int) -> list[np.ndarray]:
    """Frames that pan over noise by 3 px each."""
    wide = _noise(seed, (SIZE[0], SIZE[1] + 3 * count))
    return [np.ascontiguousarray(wide[:, 3 * k : 3 * k + SIZE[1]]) for k in range(count)]


def test_names_are_in_natural_order_and_hidden_ones_are_no_frames(tmp_path: Path) -> None:
    for number in (0, 1, 2, 10, 11):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((40, 50), number, np.uint8))
    (tmp_path / "._1.png").write_bytes(b"Mac OS X")
    assert [int(frame[0, 0]) for frame in FrameSource(tmp_path)] == [0, 1, 2, 10, 11]


def test_names_of_equal_length_keep_the_order_of_their_letters(tmp_path: Path) -> None:
    names = ["b_0001.png", "a_0002.png", "a_0010.png", "a.png", "a1.png"]
    for name in names:
        cv2.imwrite(str(tmp_path / name), np.zeros((40, 50), np.uint8))
    assert [each.name for each in FrameSource(tmp_path)._files] == sorted(names)


def test_times_are_those_of_the_file_and_a_gap_is_a_longer_interval(tmp_path: Path) -> None:
    stamps = [0, 20, 40, 81, 100, 113, 133]
    source = FrameSource(_video(tmp_path / "a.mp4", _gradient(0, 7), stamps))
    assert source.times is not None
    np.testing.assert_allclose(source.times.seconds, np.array(stamps) / 600.0, atol=1e-6)
    # Of the median of 1/30 s; within a hundredth of it an interval counts as whole.
    np.testing.assert_allclose(np.diff(source.timeline.starts), [1, 1, 2.05, 0.95, 0.65, 1], atol=0.011)
    assert source.timeline.period_s == pytest.approx(1 / 30)
    even = FrameSource(_video(tmp_path / "b.mkv", _gradient(0, 7), [0, 20, 40, 60, 80, 100, 120]))
    assert even.timeline.even and not even.timeline.words  # though Matroska rounds to milliseconds


@pytest.mark.parametrize("suffix", [".mkv", ".mp4"])
def test_copies_are_found_and_taken_out_of_the_times(tmp_path: Path, suffix: str) -> None:
    frames = _gradient(1, 20)
    fifth = [k - k // 5 for k in range(20)]  # each fifth is that before it again: 24 as 30 frames a second
    source = FrameSource(_video(tmp_path / f"a{suffix}", [frames[k] for k in fifth], [20 * k for k in range(20)]))
    expected = [k - 1 if k % 5 == 0 and k else k for k in range(20)]
    assert source.timeline.twins.tolist() == expected
    assert source.timeline.even and source.timeline.period_s == pytest.approx(1.25 / 30, rel=0.02)
    dropped = [0, 1, 2, 2, 4, 5, 6, 7]  # one frame was not taken, and the one before stands in for it
    source = FrameSource(_video(tmp_path / f"b{suffix}", [frames[k] for k in dropped], [20 * k for k in range(8)]))
    assert source.timeline.starts.tolist() == [0, 1, 2, 4, 5, 6, 7]


def test_a_still_video_and_a_slow_one_have_no_copies(tmp_path: Path) -> None:
    still = [_noise(2)] * 4
    assert FrameSource(_video(tmp_path / "a.mkv", still, [0, 20, 40, 60])).timeline.twins.tolist() == [0, 1, 2, 3]
    rng = np.random.default_rng(0)
    noisy = [np.clip(_noise(2) + rng.normal(0, 1, (*SIZE, 3)), 0, 255).astype(np.uint8) for _ in range(4)]
    assert FrameSource(_video(tmp_path / "b.mkv", noisy, [0, 20, 40, 60])).timeline.twins.tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_is_as_exif_has_it(orientation: int) -> None:
    from PIL import Image, ImageOps

    image, tagged = _noise(3)[:60], Image.fromarray(_noise(3)[:60])
    tagged.getexif()[0x0112] = orientation
    np.testing.assert_array_equal(upright(image, orientation), np.asarray(ImageOps.exif_transpose(tagged)))


@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".mkv", ".avi"])
def test_a_player_shows_what_is_written_upright(tmp_path: Path, suffix: str) -> None:
    """OpenCV turns frames as the container says; without its help they are as stored, but in .avi."""
    frames = _gradient(4, 2)
    path = _video(tmp_path / f"a{suffix}", frames, [0, 20], orientation=6)
    shown = cv2.VideoCapture(str(path)).read()[1][..., ::-1]
    assert shown.shape == (SIZE[1], SIZE[0], 3)
    assert np.mean(np.abs(shown.astype(float) - upright(frames[0], 6))) < 3.0
    stored = FrameSource(path)
    assert stored.orientation == (1 if suffix == ".avi" else 6)
    assert next(iter(stored)).shape == (shown.shape if suffix == ".avi" else (*SIZE, 3))


def test_an_image_s_tag_is_the_orientation_of_its_folder(tmp_path: Path) -> None:
    from PIL import Image

    exif = Image.Exif()
    exif[0x0112] = 8
    for number in range(2):
        Image.fromarray(_noise(number)).save(tmp_path / f"{number}.jpg", exif=exif)
    source = FrameSource(tmp_path)
    assert source.orientation == 8 and next(iter(source)).shape == (*SIZE, 3)


def test_ten_bits_are_read_as_sixteen(tmp_path: Path) -> None:
    ramp = np.tile(np.linspace(4096, 61000, SIZE[1]).astype(np.uint16)[:, None], (SIZE[0], 1, 3))
    with av.open(str(tmp_path / "a.mov"), mode="w") as file:
        stream = file.add_stream("libx265", rate=30, options={"crf": "5", "x265-params": "log-level=none"})
        stream.width, stream.height, stream.pix_fmt = SIZE[1], SIZE[0], "yuv420p10le"
        for _ in range(2):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(ramp, format="rgb48le")))
        file.mux(stream.encode(None))
    frame = next(iter(FrameSource(tmp_path / "a.mov")))
    assert frame.dtype == np.uint16
    # Of 10 bits one is 64 of 16; colour's matrix rounds once more.
    assert np.mean(np.abs(frame.astype(float) - ramp)) < 160.0
    assert len(np.unique(frame[..., 1])) > 120  # 8 bits would leave 128 columns fewer levels
    notes = write_frames(tmp_path / "b.mp4", FrameSource(tmp_path / "a.mov"), fps=30.0)[1]
    assert "8 bits" in notes[0]


@pytest.mark.parametrize(("full", "colourspace"), [(False, 1), (True, 1), (False, 5), (True, 5)])
def test_colours_come_back_whatever_range_and_matrix_the_file_has(
    tmp_path: Path, full: bool, colourspace: int
) -> None:
    colours = np.array([[250, 20, 30], [20, 200, 40], [30, 40, 220], [240, 240, 240], [5, 5, 5]], np.uint8)
    image = np.repeat(np.repeat(colours[None], 40, axis=0), 16, axis=1)
    with av.open(str(tmp_path / "a.mp4"), mode="w") as file:
        stream = file.add_stream("libx264", rate=30, options={"crf": "1"})
        stream.width, stream.height, stream.pix_fmt = 80, 40, "yuv420p"
        stream.codec_context.color_range, stream.codec_context.colorspace = 1 + full, colourspace
        frame = av.VideoFrame.from_ndarray(image, format="rgb24")
        frame = frame.reformat(
            format="yuv420p", dst_colorspace=colourspace, src_color_range=2, dst_color_range=1 + full
        )
        file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
    read = next(iter(FrameSource(tmp_path / "a.mp4")))
    assert np.max(np.abs(read[20, 8::16].astype(int) - colours)) <= 4
    # And once more, as what is written with this video's tags.
    write_frames(tmp_path / "b.mp4", [read], fps=30.0, like=VideoFile.open(tmp_path / "a.mp4"))
    again = next(iter(FrameSource(tmp_path / "b.mp4")))
    assert np.max(np.abs(again[20, 8::16].astype(int) - colours)) <= 6


def test_odd_sizes_are_padded_and_said_so(tmp_path: Path) -> None:
    frames = [np.ascontiguousarray(each[:95, :127]) for each in _gradient(5, 2)]
    count, notes = write_frames(tmp_path / "a.mp4", frames, fps=30.0)
    assert (count, len(notes)) == (2, 1) and "128 x 96" in notes[0] and "127 x 95" in notes[0]
    read = next(iter(FrameSource(tmp_path / "a.mp4")))
    assert read.shape == (96, 128, 3)
    assert np.mean(np.abs(read[:95, :127].astype(float) - frames[0])) < 3.0
    for suffix in (".avi", ".mkv"):
        assert write_frames(tmp_path / f"a{suffix}", frames, fps=30.0)[1] == []
        assert next(iter(FrameSource(tmp_path / f"a{suffix}"))).shape == (95, 127, 3)


def test_a_written_video_plays_everywhere_and_keeps_the_sound(tmp_path: Path) -> None:
    source = tmp_path / "a.mov"
    with av.open(str(source), mode="w") as file:
        stream, sound = file.add_stream("libx264", rate=30), file.add_stream("aac", rate=48000)
        stream.width, stream.height, stream.pix_fmt = SIZE[1], SIZE[0], "yuv420p"
        for frame in _gradient(6, 6):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        wave = np.sin(np.arange(9600) / 20.0).astype(np.float32)[None]
        for begin in range(0, 9600, 1024):
            part = av.AudioFrame.from_ndarray(wave[:, begin : begin + 1024], format="fltp", layout="mono")
            part.sample_rate = 48000
            file.mux(sound.encode(part))
        file.mux([*stream.encode(None), *sound.encode(None)])

    def packets(path: Path) -> list[tuple[int, bytes]]:
        with av.open(str(path)) as opened:
            return [(int(p.pts), bytes(p)) for p in opened.demux(audio=0) if p.size]

    read = FrameSource(source)
    out = tmp_path / "b.mp4"
    assert write_frames(out, read, fps=30.0, times=read.times, like=read.video)[1] == []
    assert packets(out) == packets(source)
    content = out.read_bytes()
    assert 0 < content.index(b"moov") < content.index(b"mdat")  # plays while it loads
    with av.open(str(out)) as opened:
        context = opened.streams.video[0].codec_context
        assert (context.name, context.pix_fmt, context.profile) == ("h264", "yuv420p", "High")


def test_frames_of_4k_are_allowed_and_larger_ones_name_the_remedy(tmp_path: Path) -> None:
    check_size("a", (3840, 2160))
    assert PIXELS >= 3840 * 2160
    with pytest.raises(RsbenchError, match=r"4096 x 2304 pixels.*RSBENCH_LIMITS=2"):
        check_size("a", (4096, 2304))
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.zeros((1800, 3000), np.uint8))
    assert read_frame(path).shape == (1800, 3000)


def test_a_parameter_outside_its_table_is_told_where_it_belongs() -> None:
    with pytest.raises(RsbenchError, match=r"did you mean parameters = \{ preset = \.\.\. \}"):
        parse_card(MotionCard, {"model": "spline", "preset": "handheld"}, "a.toml")


def test_large_frames_are_searched_at_a_smaller_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their flow is that of the frames as they are, to the error that flow has at the smaller size."""
    wide = _noise(7, (480, 700), 4.0)
    first, second = wide[:, :640], np.ascontiguousarray(wide[:, 13:653])
    whole = find_flows([first, second])
    monkeypatch.setattr(epipolar_search, "_ENOUGH", 320 * 240)
    small = find_flows([first, second])
    assert whole.shape == (480, 640) and small.shape == (240, 320) and small.scale == (2.0, 2.0)
    for flows in (whole, small):
        inner = flows.of_frame(0, first.shape)[40:-40, 60:-60]
        assert np.percentile(np.abs(inner - [-13.0, 0.0]), 95) < 0.3
        matches = flow_matches(flows, np.random.default_rng(0))
        assert np.percentile(np.abs(matches[:, :2] - matches[:, 2:] - [13.0, 0.0]), 90) < 0.3
        assert matches[:, 2:].min(axis=0).max() < 60.0 and matches[:, 2].max() > 560.0


SPEED = 5.0


def _seen(tau: np.ndarray) -> np.ndarray:
    """Rows read at times (96,) of a texture that moves to the right."""
    x = (np.arange(SIZE[1])[None] + 60.0 - SPEED * tau[:, None]).astype(np.float32)
    y = np.broadcast_to(np.arange(SIZE[0], dtype=np.float32)[:, None], x.shape)
    return cv2.remap(_noise(8, (SIZE[0], 260), 3.0), x, np.ascontiguousarray(y), cv2.INTER_CUBIC)


def test_a_frame_after_a_gap_is_moved_by_the_share_of_the_longer_interval() -> None:
    """Two periods lie between the last two frames: the readout is a smaller share of them."""
    rows, starts = np.arange(SIZE[0]) / SIZE[0], np.array([0.0, 1.0, 3.0])
    frames, truth = (
        [_seen(start + rows) for start in starts],
        _seen(np.full(SIZE[0], 3.0 + rows[48])).astype(float),
    )
    camera = PinholeCamera.centred(SIZE[1], SIZE[0], 130.0)
    shutter = RollingShutter(height=SIZE[0], readout_ratio=1.0)
    options, errors = options_of_camera(None, 0, 48.0), list[float]()
    for given in (starts, None):
        image = list(correct_frames(frames, camera, shutter, options, starts=given))[2].shown["left"].image
        errors.append(float(np.sqrt(np.mean((image - truth)[8:-8, 30:-30] ** 2))))
    before = np.sqrt(np.mean((frames[2] - truth)[8:-8, 30:-30] ** 2))
    assert errors[0] < 0.3 * before < errors[1]


def test_a_gyroscope_s_samples_are_those_of_the_frames_own_times(monkeypatch: pytest.MonkeyPatch) -> None:
    """A rate of turn that grows with time, over a pair two periods long that begins at 1."""
    taken = dict[int, Any]()

    def with_gyro(found: FoundOwnMotion, flows: Any, gyro: Any, *rest: Any) -> FoundOwnMotion:
        taken[len(taken)] = (gyro, found.own.shutter.readout_ratio)
        return found

    monkeypatch.setattr(mono_sequence, "with_gyro", with_gyro)
    tau = np.linspace(-1.0, 6.0, 71)
    samples = np.column_stack([tau, 0.01 * tau, 0.0 * tau, 0.0 * tau])
    frames = [_seen(np.full(SIZE[0], float(k))) for k in range(3)]
    shutter = RollingShutter(height=SIZE[0], readout_ratio=0.8)
    camera = PinholeCamera.centred(SIZE[1], SIZE[0], 130.0)
    list(correct_frames(frames, camera, shutter, gyro=samples, starts=np.array([0.0, 1.0, 3.0])))
    gyro, ratio = max(taken.values(), key=lambda each: each[0][-1, 1])
    assert ratio == pytest.approx(0.4)
    # At the pair's own time s, 1 + 2 s periods have gone by, and a rate counts twice over the longer interval.
    np.testing.assert_allclose(gyro[:, 1], 2.0 * 0.01 * (1.0 + 2.0 * gyro[:, 0]), atol=1e-12)
    assert gyro[0, 0] <= 0.0 and gyro[-1, 0] >= 1.4
