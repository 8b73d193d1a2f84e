"""``rsbench correct --camera``: frames of one camera, as users meet it."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from commands import assert_refused, bytes_below, run_here

import rsbench
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.shutter import RollingShutter, Scan
from rsbench.dataset import corrected_frames
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.mono_sequence import correct_frames, options_of_camera
from rsbench.pipeline.sequence_capture import CorrectedMoment
from rsbench.storage.files import read_png, write_png
from rsbench.vision.fusion import Fused, Origin

SPEED, SIZE = 12.0, (120, 160)
"""px to the right per frame period, of a texture that reaches far beyond the frames; rows, columns."""


def _texture() -> np.ndarray:
    noise = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 255, (120, 320, 3)), (0, 0), 2.0)
    return cv2.normalize(noise, np.zeros_like(noise), 0, 255, cv2.NORM_MINMAX).astype(np.float32)


def _seen(tau: np.ndarray) -> np.ndarray:
    """Image of rows read at times (120,): the texture has moved by SPEED times the time."""
    x = np.arange(SIZE[1], dtype=np.float32) + 80.0 - (SPEED * tau[:, None]).astype(np.float32)
    y = np.broadcast_to(np.arange(SIZE[0], dtype=np.float32)[:, None], x.shape)
    seen = cv2.remap(_texture(), x.astype(np.float32), np.ascontiguousarray(y), cv2.INTER_CUBIC)
    return np.clip(np.rint(seen), 0, 255).astype(np.uint8)


def _rolling(frame: int) -> np.ndarray:
    return _seen(frame + np.arange(SIZE[0]) / SIZE[0])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for frame in range(3):
        write_png(tmp_path / f"{frame}.png", _rolling(frame))
    (tmp_path / "camera.toml").write_text("readout_ratio = 1.0\nfov_deg = 60.0\n")
    return tmp_path


def _correct(folder: Path, *arguments: Any) -> Any:
    camera = folder / "camera.toml"
    return run_here("correct", *arguments, "--camera", camera, "--out", folder / "out", "--target", 60)


def _moments(
    frames: list[np.ndarray], scan: Scan = "top", options: CorrectionOptions | None = None
) -> list[CorrectedMoment]:
    height, width = frames[0].shape[:2]
    shutter = RollingShutter(height=height, width=width, readout_ratio=1.0, scan=scan)
    return list(correct_frames(frames, PinholeCamera.centred(width, height, 160.0), shutter, options))


@pytest.mark.slow
def test_two_frames_become_upright(folder: Path) -> None:
    result = _correct(folder, folder / "0.png", folder / "1.png")
    assert result.returncode == 0, result.stderr
    for frame in (0, 1):
        truth = _seen(np.full(SIZE[0], frame + 0.5)).astype(float)
        inner = np.s_[8:-8, 20:-20]  # what both frames show at that time
        before = np.sqrt(np.mean((_rolling(frame) - truth)[inner] ** 2))
        image = read_png(folder / "out" / "corrected" / f"{frame:06d}.png").astype(float)
        # Rows are up to 6 px off before; a tenth of a pixel of flow and a second interpolation remain.
        assert np.sqrt(np.mean((image - truth)[inner] ** 2)) < 0.25 * before
    record = json.loads((folder / "out" / "motion.json").read_text())
    assert record["camera"]["fx"] == pytest.approx(80.0 / np.tan(np.deg2rad(30.0)))
    assert (record["focal_length_assumed"], record["focal_length_sigma"]) == (False, None)
    assert [frame["number"] for frame in record["frames"]] == [0, 1]
    # Depth has no metres: its unit is the length of the translation.
    assert re.search(r"yellow [\d.e+]+, violet", (folder / "out" / "report.html").read_text())


@pytest.mark.slow
def test_a_focal_length_that_nothing_shows_is_assumed_and_said_so(folder: Path) -> None:
    (folder / "camera.toml").write_text("readout_ratio = 1.0\n")
    result = _correct(folder, folder / "0.png", folder / "1.png")
    assert "focal length 160.0 +- 56.0 px (assumed: the width of the image" in result.stdout
    record = json.loads((folder / "out" / "motion.json").read_text())
    assert record["focal_length_assumed"] and not record["focal_length_estimated"]
    assert (record["camera"]["fx"], record["focal_length_sigma"]) == (160.0, pytest.approx(56.0))


@pytest.mark.slow
def test_a_shutter_of_another_frame_rate_is_named(folder: Path) -> None:
    """The mode reads for 15.64 ms at 59.94 frames a second; of a period of 30 a second that is 0.469."""
    film = cv2.VideoWriter(str(folder / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, SIZE[::-1])
    for frame in range(2):
        film.write(np.ascontiguousarray(_rolling(frame)[..., ::-1]))
    film.release()
    ratios = []
    for more in ("", "frame_period_s = 0.033333\n"):
        (folder / "camera.toml").write_text(f'shutter = "dji-o4-air-4k60"\nfov_deg = 60.0\n{more}')
        result = _correct(folder, "--frames", folder / "film.avi")
        assert result.returncode == 0, result.stderr
        warning = "0.937 assumes 59.94 frames/s, but the frames have 30 (at that rate the ratio is 0.469)"
        assert (warning in result.stderr) == (not more)
        ratios.append(json.loads((folder / "out" / "motion.json").read_text())["readout_ratio"])
        (folder / "out").rename(folder / f"out-{len(ratios)}")
    assert ratios == pytest.approx([15.64e-3 * 59.94006, 15.64e-3 / 0.033333])
    (folder / "camera.toml").write_text("readout_ratio = 1.0\nframe_period_s = 0\n")
    assert_refused(_correct(folder, folder / "0.png", folder / "1.png"), "frame_period_s = 0", "must be positive")


@pytest.mark.slow
def test_an_interrupted_run_goes_on_where_it_was(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [folder / "in" / path.name for path in folder.glob("?.png")]
    (folder / "in").mkdir()
    for path in frames:
        (folder / path.name).rename(path)
    given = (
        "correct",
        "--frames",
        folder / "in",
        "--camera",
        folder / "camera.toml",
        "--target",
        "middle",
        "--out",
    )
    for part in ("whole", "halves"):
        (folder / part).mkdir()
    assert run_here(*given, folder / "whole" / "out").returncode == 0
    written, write, stops = list[str](), corrected_frames.write_frame, [1]

    def stopped_once(to: Path, frame: str, *rest: Any, **more: Any) -> None:
        if len(written) in stops:
            stops.clear()
            raise KeyboardInterrupt
        written.append(frame)
        write(to, frame, *rest, **more)

    monkeypatch.setattr(corrected_frames, "write_frame", stopped_once)
    for code in (130, 0):
        assert run_here(*given, folder / "halves" / "out").returncode == code
    assert written == [f"{frame:06d}" for frame in range(3)]
    assert bytes_below(folder / "halves") == bytes_below(folder / "whole")


@pytest.mark.slow
def test_bad_input_is_refused_in_one_line_and_nothing_is_left(folder: Path) -> None:
    write_png(folder / "small.png", _rolling(1)[:100])
    write_png(folder / "flat.png", np.full((*SIZE, 3), 90, np.uint8))
    write_png(folder / "grey.png", _rolling(1)[..., 0])
    (folder / "torn.png").write_bytes((folder / "1.png").read_bytes()[:2000])
    first = folder / "0.png"
    assert_refused(_correct(folder, first), "at least two")
    assert_refused(_correct(folder, first, folder / "grey.png"), "alike")
    assert_refused(_correct(folder, first, folder / "torn.png"), "torn.png")
    assert_refused(_correct(folder, first, folder / "1.png", folder / "small.png"), "frame 2")
    assert_refused(_correct(folder, first, folder / "small.png"), "alike")
    assert_refused(_correct(folder, first, first), "nothing moves")
    assert_refused(_correct(folder, folder / "flat.png", folder / "flat.png"), "no texture")
    assert_refused(_correct(folder), "--frames")
    (folder / "camera.toml").write_text("fov_deg = 60.0\n")
    unknown = _correct(folder, first, folder / "1.png")  # this motion lies along the rows
    assert unknown.returncode == 1 and "cannot tell the readout ratio" in unknown.stderr
    (folder / "camera.toml").write_text("readout_ratio = 1.0\nfov_deg = 180.0\n")
    assert_refused(_correct(folder, first, folder / "1.png"), "fov_deg")
    intrinsics = "fx = 300\nfy = 300\ncx = 99.5\ncy = 74.5\n"
    (folder / "camera.toml").write_text(f"readout_ratio = 1.0\n[camera]\n{intrinsics}focal_sigma = 9\n")
    assert_refused(_correct(folder, first, folder / "1.png"), "focal_sigma, k1_sigma")
    assert not (folder / "out").exists()


@pytest.mark.slow
def test_a_still_pair_among_others_is_a_mark_on_its_frame() -> None:
    frames = [_rolling(0), _rolling(1), _rolling(1)]
    moments = _moments(frames)
    assert [moment.number for moment in moments] == [0, 1, 2]
    assert [bool(moment.shown["left"].reason) for moment in moments] == [False, False, True]
    np.testing.assert_array_equal(moments[2].shown["left"].image, frames[2])


def test_a_still_camera_is_known_by_its_clear_texture() -> None:
    """Noise of a sensor, and of a coder, moves flow where there is little texture."""
    rng, dim = np.random.default_rng(0), _rolling(0).astype(float)
    dim[:, 60:] = 120.0 + 0.02 * (dim[:, 60:] - 120.0)
    noisy = [np.clip(dim + rng.normal(0.0, 2.0, dim.shape), 0, 255).astype(np.uint8) for _ in range(3)]
    coded = [cv2.imdecode(cv2.imencode(".jpg", each, [cv2.IMWRITE_JPEG_QUALITY, 70])[1], 1) for each in noisy]
    for frames in (noisy, coded):
        moments = _moments(frames)
        assert ["still camera" in moment.shown["left"].reason for moment in moments] == [True] * 3
        with pytest.raises(RsbenchError, match="still camera"):
            _moments(frames[:2])
        np.testing.assert_array_equal(moments[1].shown["left"].image, frames[1])


@pytest.mark.slow
def test_of_many_marked_frames_the_first_are_told(folder: Path) -> None:
    (folder / "in").mkdir()
    for frame in range(12):
        image = _rolling(min(frame, 1))
        image[0, 0] = frame  # no copies
        write_png(folder / "in" / f"{frame:02d}.png", image)
    result = _correct(folder, "--frames", folder / "in")
    assert result.returncode == 1
    (line,) = [line for line in result.stderr.splitlines() if "not corrected" in line]
    assert line.count("nothing moves") == 8 and line.endswith("and 2 more, see motion.json")
    record = json.loads((folder / "out" / "motion.json").read_text())
    assert [each["number"] for each in record["frames"] if "reason" in each] == list(range(2, 12))


@pytest.mark.slow
def test_a_frame_after_a_cut_is_corrected_with_the_one_after_it() -> None:
    other = [np.ascontiguousarray(_rolling(frame)[::-1, :, ::-1]) for frame in (5, 6)]
    moments = _moments([_rolling(0), _rolling(1), *other])
    assert [moment.number for moment in moments] == [0, 1, 2, 3]
    assert not any(moment.shown["left"].reason for moment in moments)
    assert [bool(moment.reason) for moment in moments] == [False, False, True, False]
    assert "cut" in moments[2].reason
    alone = _moments(other)
    np.testing.assert_array_equal(moments[2].shown["left"].image, alone[0].shown["left"].image)
    # A last frame that nothing follows stays as it is, and says why.
    last = _moments([_rolling(0), _rolling(1), other[0]])[2]
    assert "cut" in last.shown["left"].reason
    np.testing.assert_array_equal(last.shown["left"].image, other[0])


@pytest.mark.slow
@pytest.mark.parametrize("scan", ["bottom", "right"])
def test_lines_may_be_read_from_any_side(scan: Scan) -> None:
    """Frames turned like their camera, whose truth is turned alike."""

    def turn(image: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(image[::-1] if scan == "bottom" else image.swapaxes(0, 1)[:, ::-1])

    moments = _moments([turn(_rolling(frame)) for frame in (0, 1)], scan)
    for frame, moment in enumerate(moments):
        truth, inner = turn(_seen(np.full(SIZE[0], frame + 0.5))).astype(float), np.s_[20:-20, 20:-20]
        before = np.sqrt(np.mean((moment.images["left"] - truth)[inner] ** 2))
        assert np.sqrt(np.mean((moment.shown["left"].image - truth)[inner] ** 2)) < 0.25 * before


def _place(tau: np.ndarray) -> np.ndarray:
    """Of a camera whose speed grows by a sixth in a frame, which the farther of both neighbours does not show."""
    return 0.5 * tau + 0.06 * tau**2


def _second(frames: list[np.ndarray], place: int, row: float) -> Fused:
    """One of the frames at the time of a row, bare."""
    return _moments(frames, options=options_of_camera(False, 0, row))[place].shown["left"]


def _accelerated(row: float) -> tuple[list[np.ndarray], np.ndarray]:
    """Three frames, and the truth of the second at the time of a row."""
    frames = [_seen(_place(frame + np.arange(SIZE[0]) / SIZE[0])) for frame in range(3)]
    return frames, _seen(_place(np.full(SIZE[0], 1.0 + row / SIZE[0]))).astype(float)


@pytest.mark.slow
@pytest.mark.parametrize("last", [False, True])
def test_a_frame_is_corrected_with_the_neighbour_nearer_in_time(last: bool) -> None:
    row = SIZE[0] - 1.0 if last else 0.0
    frames, truth = _accelerated(row)
    found = _second(frames, 1, row)
    alone = _second(frames[:2], 1, row), _second(frames[1:], 0, row)
    errors = [np.sqrt(np.mean((each.image - truth)[20:-20, 30:-30] ** 2)) for each in (found, *alone)]
    seen = alone[last].origin == Origin.HERE
    np.testing.assert_array_equal(found.image[seen], alone[last].image[seen])
    assert errors[0] < 0.7 * errors[2 - last]


@pytest.mark.slow
def test_what_a_frame_and_its_neighbour_do_not_show_is_taken_from_the_other_one() -> None:
    """The texture comes in from the left: what the second frame lacks there, only the third one shows."""
    row = (SIZE[0] - 1) / 2
    frames, truth = _accelerated(row)
    two, three = _second(frames[:2], 1, row), _second(frames, 1, row)
    holes, left = two.origin == Origin.NOBODY, three.origin == Origin.NOBODY
    assert np.mean(holes) > 0.005 and np.sum(left) < 0.2 * np.sum(holes)
    filled = holes & ~left
    assert np.all(three.origin[filled] == Origin.OTHER_FRAME)
    np.testing.assert_array_equal(three.image[~holes], two.image[~holes])
    # A texture that is 20 px off has 1.4 times its own deviation, about 35 levels.
    assert np.sqrt(np.mean((three.image - truth)[filled] ** 2)) < 12.0
    # Its depth is in the unit of the frame's own, though the pairs have each their own.
    ratio = np.median(three.depth[filled]) / np.median(three.depth[~holes])
    assert 0.7 < ratio < 1.4


@pytest.mark.slow
def test_a_camera_may_be_intrinsics_a_field_of_view_or_nothing() -> None:
    frames, focal = [_rolling(0), _rolling(1)], 80.0 / np.tan(np.deg2rad(30.0))
    camera = PinholeCamera.centred(SIZE[1], SIZE[0], focal)
    known, told = (rsbench.correct(frames, camera=each, readout_ratio=1.0)[1].image for each in (camera, 60.0))
    np.testing.assert_array_equal(known, told)
    # A motion parallel to the image is seen alike by any focal length.
    unknown = rsbench.correct(frames, camera="unknown", readout_ratio=1.0)[1].image
    difference = (unknown.astype(float) - known)[8:-8, 20:-20]
    assert np.sqrt(np.mean(difference**2)) < 3.0
    with pytest.raises(RsbenchError, match="fov_deg"):
        rsbench.correct(frames, camera=200.0, readout_ratio=1.0)


LENS = (-0.25, 0.06, 0.004, -0.003)
"""OpenCV's k1, k2, p1, p2: the corners are off by 9 px."""


def _through_lens(tau: Any) -> np.ndarray:
    """What ``_seen`` shows, through the lens; each row of the distorted image at its own time."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float64)
    K = np.array([[130.0, 0.0, 79.5], [0.0, 130.0, 59.5], [0.0, 0.0, 1.0]])
    ideal = cv2.undistortPoints(np.stack([x, y], -1).reshape(-1, 1, 2), K, np.array(LENS), P=K)
    at = ideal.reshape(*SIZE, 2)
    at[..., 0] += 80.0 - SPEED * np.broadcast_to(tau, SIZE[:1])[:, None]
    seen = cv2.remap(_texture(), *np.moveaxis(at.astype(np.float32), -1, 0), cv2.INTER_CUBIC)
    return np.clip(np.rint(seen), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("on_its_side", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_frames_may_be_seen_through_a_lens(on_its_side: bool) -> None:
    """Distorted by OpenCV, without the project's own lens; a camera on its side reads columns from the right."""
    k1, k2, p1, p2 = LENS
    lens = Lens(model="brown-conrady", k1=k1, k2=k2, p1=p1, p2=p2)
    camera, scan = PinholeCamera.centred(SIZE[1], SIZE[0], 130.0), "top"
    if on_its_side:  # x is -y, and y is x
        lens = replace(lens, p1=p2, p2=-p1)
        camera, scan = PinholeCamera.centred(*SIZE, 130.0), "right"

    def turn(image: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(np.rot90(image, -1)) if on_its_side else image

    frames = [turn(_through_lens(frame + np.arange(SIZE[0]) / SIZE[0])) for frame in (0, 1)]
    shutter = RollingShutter(height=camera.height, width=camera.width, readout_ratio=1.0, scan=scan)
    moments = list(correct_frames(frames, replace(camera, lens=lens), shutter))
    middle, inner = (SIZE[0] - 1) / 2 / SIZE[0], np.s_[24:-24, 24:-24]
    for number, (before, moment) in enumerate(zip(frames, moments, strict=True)):
        truth = turn(_through_lens(np.full(SIZE[0], number + middle))).astype(float)
        errors = [np.sqrt(np.mean((image - truth)[inner] ** 2)) for image in (before, moment.shown["left"].image)]
        # As without a lens: a tenth of a pixel of flow and a second interpolation remain.
        assert errors[1] < 0.25 * errors[0]
