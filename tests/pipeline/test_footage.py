"""Users' frames: image files, the rig's card, folders and videos, and sequences of windows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rsbench.capture.hypotheses import KnownInputs
from rsbench.capture.shutter_decision import NoMotionError
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import VIEWS
from rsbench.dataset.sequence import Sequence
from rsbench.pipeline.chain import correct_four
from rsbench.pipeline.footage import FrameSource, ImageSource, check_alike, read_frame, read_rig_card
from rsbench.pipeline.frame_capture import KnownCapture
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.frame_motion import solve_frames
from rsbench.pipeline.sequence_capture import estimate_sequence_capture
from rsbench.pipeline.sequence_correction import correct_sequence

Folders = tuple[FrameSource, FrameSource]


def _write(folder: Path, name: str, image: np.ndarray) -> Path:
    path = folder / name
    assert cv2.imwrite(str(path), image)
    return path


def test_frames_in_memory_answer_what_files_answer() -> None:
    images = [np.full((4, 5), level, dtype=np.uint8) for level in (1, 2)]
    source, other = ImageSource(images), ImageSource([images[0], images[0]])
    assert (source.video, source.times, source.orientation) == (None, None, 1)
    assert source.identity() == ImageSource(images).identity() != other.identity()
    assert [int(image[0, 0]) for image in source.only([1])] == [2]


def test_frames_are_read_as_they_are(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    grey16 = rng.integers(0, 65536, (40, 50)).astype(np.uint16)
    np.testing.assert_array_equal(read_frame(_write(tmp_path, "a.png", grey16)), grey16)
    colour = rng.integers(0, 256, (40, 50, 3)).astype(np.uint8)
    np.testing.assert_array_equal(read_frame(_write(tmp_path, "b.png", colour))[..., ::-1], colour)
    transparent = rng.integers(0, 256, (40, 50, 4)).astype(np.uint8)
    assert read_frame(_write(tmp_path, "c.png", transparent)).shape == (40, 50, 3)


def test_an_orientation_tag_does_not_turn_rows_into_columns(tmp_path: Path) -> None:
    from PIL import Image

    exif = Image.Exif()
    exif[0x0112] = 6  # a quarter turn
    path = tmp_path / "turned.jpg"
    Image.fromarray(np.zeros((40, 60, 3), np.uint8)).save(path, exif=exif)
    assert read_frame(path).shape == (40, 60, 3)


@pytest.mark.parametrize("content", [None, b"", b"no image"])
def test_what_is_no_image_is_refused(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "x.png"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RsbenchError, match=r"x\.png"):
        read_frame(path)


def test_small_and_unlike_frames_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RsbenchError, match="20 x 10"):
        read_frame(_write(tmp_path, "small.png", np.zeros((10, 20), np.uint8)))
    big, grey = np.zeros((40, 50, 3), np.uint8), np.zeros((40, 50), np.uint8)
    with pytest.raises(RsbenchError, match="50 x 40 8-bit grey"):
        check_alike({"a": big, "b": grey})


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("baseline = 0.1\n[camera]\nfx = 1\nfy = 1\ncx = 0\ncy = 0\nwidth = 3", "width"),
        ("baseline = -1\n[camera]\nfx = 1\nfy = 1\ncx = 0\ncy = 0", "baseline"),
        ("baseline = 0.1\nreadout_ratio = 1.5\n[camera]\nfx = 1\nfy = 1\ncx = 0\ncy = 0", "readout_ratio"),
        ("baseline = 0.1\n[camera]\nfx = 0\nfy = 1\ncx = 0\ncy = 0", "fx"),
        ("baseline = 0.1", "camera"),
    ],
)
def test_wrong_rig_cards_are_refused(tmp_path: Path, text: str, word: str) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(text)
    with pytest.raises(RsbenchError, match=word):
        read_rig_card(path)


# Sequences


@pytest.fixture
def folders(tmp_path: Path, castle: Sequence) -> Folders:
    """The two times of the castle."""
    sources = []
    for side in ("left", "right"):
        folder = tmp_path / side
        folder.mkdir()
        for number, frame in enumerate((0, 1)):
            _write(folder, f"{number}.png", castle.image("rs", side, frame)[..., ::-1])
        sources.append(FrameSource(folder))
    return sources[0], sources[1]


def _known(castle: Sequence) -> KnownCapture:
    return KnownCapture(rig=castle.rig, shutter=castle.shutter)


def test_a_sequence_of_two_equals_four_frames(folders: Folders, castle: Sequence) -> None:
    options, inputs = CorrectionOptions(), KnownInputs.of(castle.shutter)
    moments = list(correct_sequence(folders, _known(castle), options))
    four = correct_four({view: castle.image("rs", *view) for view in VIEWS}, castle.rig, inputs, options).frames
    assert [moment.number for moment in moments] == [0, 1]
    for moment in moments:
        for side, fused in moment.frames.items():
            np.testing.assert_array_equal(fused.image, four[side, moment.number].image)


def test_a_sequence_without_texture_is_refused(folders: Folders, castle: Sequence) -> None:
    left, right = folders
    flat = np.full_like(castle.image("rs", "left", 0), 128)
    for source in (left, right):
        _write(source.path, "1.png", flat)
    with pytest.raises(RsbenchError, match="no texture"):
        list(
            correct_sequence(
                [FrameSource(left.path), FrameSource(right.path)], _known(castle), CorrectionOptions()
            )
        )


def test_a_frame_without_motion_to_the_next_uses_the_motion_that_led_to_it(
    folders: Folders, castle: Sequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three times; no motion is found from the second to the third, nor to anything from the third."""
    left, right = folders
    for source in (left, right):
        _write(source.path, "2.png", read_frame(source.path / "0.png")[..., ::-1])
    results = iter([True, False])

    def solve(*arguments: Any, **options: Any) -> Any:
        if next(results):
            return solve_frames(*arguments, **options)
        raise NoMotionError("nothing there")

    monkeypatch.setattr("rsbench.pipeline.sequence_correction.solve_frames", solve)
    sources = FrameSource(left.path), FrameSource(right.path)
    moments = list(correct_sequence(sources, _known(castle), CorrectionOptions()))
    assert [bool(moment.frames) for moment in moments] == [True, True, False]
    assert moments[2].reason == "nothing there"
    four = correct_four(
        {view: castle.image("rs", *view) for view in VIEWS},
        castle.rig,
        KnownInputs.of(castle.shutter),
        CorrectionOptions(),
    ).frames
    np.testing.assert_array_equal(moments[1].frames["left"].image, four["left", 1].image)


def test_sequences_of_different_lengths_are_refused(folders: Folders, castle: Sequence) -> None:
    left, right = folders
    (right.path / "1.png").unlink()
    with pytest.raises(RsbenchError, match="has 1 frames, fewer than"):
        list(correct_sequence([left, FrameSource(right.path)], _known(castle), CorrectionOptions()))


@pytest.mark.slow
def test_the_readout_of_a_sequence_is_that_of_its_windows(folders: Folders, castle: Sequence) -> None:
    try:
        capture, shutter = estimate_sequence_capture(*folders, castle.rig, CorrectionOptions())
    except NoMotionError as refusal:
        assert "readout_ratio" in str(refusal)
    else:
        assert capture is not None and capture.likeliest is not None
        assert abs(shutter.readout_ratio - castle.shutter.readout_ratio) < 4 * capture.likeliest.sigma


def test_sources_that_do_not_exist_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RsbenchError, match="no such folder or video"):
        FrameSource(tmp_path / "nothing")
    with pytest.raises(RsbenchError, match="no images"):
        FrameSource(tmp_path)
    (tmp_path / "x.mp4").write_bytes(b"no video")
    with pytest.raises(RsbenchError, match="cannot be read as a video"):
        FrameSource(tmp_path / "x.mp4")


def test_a_video_gives_its_frames_again_and_again(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 256, (48, 64, 3)).astype(np.uint8) for _ in range(3)]
    path = tmp_path / "v.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 10.0, (64, 48))
    for frame in frames:
        writer.write(frame)
    writer.release()
    source = FrameSource(path)
    assert source.count == 3
    for _ in range(2):
        read = list(source)
        assert len(read) == 3 and all(frame.shape == (48, 64, 3) for frame in read)
