"""``rsbench correct`` as users meet it."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from commands import assert_refused, bytes_below, run_apart, run_here
from small_scenes import write_rig

from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.capture.calibration import offset_error
from rsbench.capture.hypotheses import Known, Scans
from rsbench.capture.two_frame_estimate import conclude, examine
from rsbench.cli.correct_run import readout_words, say_calibration
from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.dataset import corrected_frames
from rsbench.dataset.corrected_frames import MASK_VALUES
from rsbench.dataset.sequence import Sequence
from rsbench.pipeline import chain
from rsbench.pipeline.frame_capture import KnownCapture
from rsbench.storage.files import read_depth, read_png, write_png

ORDER = ("left_0", "right_0", "left_1", "right_1")


def correct(*arguments: object) -> subprocess.CompletedProcess[str]:
    return run_here("correct", *arguments)


@pytest.fixture
def frames(castle: Sequence) -> list[Path]:
    return [castle.folder / "rs" / f"{name}.png" for name in ORDER]


@pytest.fixture
def rig(tmp_path: Path, castle: Sequence) -> Path:
    return write_rig(tmp_path / "rig.toml", castle.rig, castle.shutter.readout_ratio)


def _check_outputs(out: Path, names: tuple[str, ...]) -> dict[str, Any]:
    for name in names:
        image = cv2.imread(str(out / "corrected" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        mask = cv2.imread(str(out / "mask" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        depth = read_depth(out / "depth" / f"{name}.exr")
        assert image is not None and mask is not None
        assert image.shape[:2] == mask.shape == depth.shape
        assert set(np.unique(mask)) <= set(MASK_VALUES.values())
        assert np.all(image[mask == 0] == 0) and np.all(depth[mask == 0] == 0)
        assert np.mean(mask == 255) > 0.8
    page = (out / "report.html").read_text("utf-8")
    # Opens from disk with no network: whatever it shows is in it.
    assert not re.search(r'(src|href)="(?!data:)', page)
    record: dict[str, Any] = json.loads((out / "motion.json").read_text("utf-8"))
    return record


def test_a_rendered_sequence_is_footage_that_knows_its_rig(tmp_path: Path, castle: Sequence, rig: Path) -> None:
    result = correct(castle.folder, "--out", tmp_path / "out", "--rectify")
    assert result.returncode == 0, result.stderr
    pairs = {path.stem for path in (tmp_path / "out/rectified").glob("*.png")}
    assert pairs == {f"{side}_00000{k}" for side in ("left", "right") for k in (0, 1)}
    assert (tmp_path / "out/rectified/calibration.yml").is_file()
    record = _check_outputs(
        tmp_path / "out", tuple(f"{side}_00000{k}" for side in ("left", "right") for k in (0, 1))
    )
    assert [frame["number"] for frame in record["frames"]] == [0, 1] and not record["readout_ratio_estimated"]
    assert record["readout_ratio"] == castle.shutter.readout_ratio and record["baseline"] == castle.rig.baseline
    others = {("--rig", rig): "its own frames and rig", ("--left", castle.folder): "leave the others out"}
    for more, words in others.items():
        assert_refused(correct(castle.folder, *more, "--out", tmp_path / "other"), words)
    words = "is a dataset; give one of its sequences: castle, room-twist"
    assert_refused(correct(castle.folder.parent, "--out", tmp_path / "other"), words)


def test_four_frames(tmp_path: Path, castle: Sequence, frames: list[Path], rig: Path) -> None:
    out = tmp_path / "out"
    result = correct(*frames, "--rig", rig, "--out", out, "--target", "middle")
    assert result.returncode == 0, result.stderr
    assert str(out / "report.html") in result.stdout
    record = _check_outputs(out, ORDER)
    assert record["target_row"] == (castle.rig.camera.height - 1) / 2
    assert not record["readout_ratio_estimated"]
    # 128 x 96 px: a quarter of a degree is half a pixel.
    np.testing.assert_allclose(record["motion"]["w"], castle.motion.w, atol=np.deg2rad(0.25))
    assert {path.name for path in tmp_path.iterdir()} == {"out", "rig.toml"}
    # The same command again replaces its own results, and gives the same.
    before = (out / "corrected" / "left_0.png").read_bytes()
    assert correct(*frames, "--rig", rig, "--out", out, "--target", "middle").returncode == 0
    assert (out / "corrected" / "left_0.png").read_bytes() == before


def test_rectified_pairs_of_an_ideal_rig_are_its_corrected_frames(
    tmp_path: Path, castle: Sequence, frames: list[Path], rig: Path
) -> None:
    out = tmp_path / "out"
    assert correct(*frames, "--rig", rig, "--out", out, "--rectify").returncode == 0
    for name in ORDER:
        assert (out / f"rectified/{name}.png").read_bytes() == (out / f"corrected/{name}.png").read_bytes()
    storage = cv2.FileStorage(str(out / "rectified/calibration.yml"), cv2.FILE_STORAGE_READ)
    Q = storage.getNode("Q").mat()
    disparity = cv2.imread(str(out / "rectified/disparity/left_1.png"), cv2.IMREAD_UNCHANGED) / np.float32(256)
    depth, near = read_depth(out / "depth/left_1.exr"), disparity > 1.0
    z = cv2.reprojectImageTo3D(disparity, Q)[..., 2]
    np.testing.assert_allclose(z[near], depth[near], rtol=0.5 / 256 + 1e-6)  # rounded to 1/256 px of 1 and more
    assert_refused(
        correct(castle.folder, "--out", tmp_path / "pair.mp4", "--rectify"), "--rectify: --out", "folder"
    )


@pytest.mark.slow
def test_a_camera_that_is_not_sure_is_looked_for_and_told(
    tmp_path: Path, castle: Sequence, frames: list[Path], rig: Path
) -> None:
    """What is found of frames this small is anybody's guess: told with the card's, and used, or the card's is."""
    fx, out = castle.rig.camera.fx, tmp_path / "out"
    rig.write_text(rig.read_text().replace("[camera]", f"[camera]\nk1_sigma = 0.02\nfocal_sigma = {0.1 * fx}"))
    result = correct(*frames, "--rig", rig, "--out", out)
    assert result.returncode == 0, result.stderr
    record = json.loads((out / "motion.json").read_text("utf-8"))
    note = record["camera_note"]
    assert result.stdout.count(note) == 1 and record["calibration_note"] != note
    assert f"(card: {fx:.1f} +- {0.1 * fx:.1f})" in note
    focal, k1 = note.split("; k1 ")
    assert ("do not determine it" in focal) == (record["camera"]["fx"] == fx)
    assert ("do not determine it" in k1) == (record["lens"] is None) and "(card: 0.000 +- 0.020)" in k1
    looked = run_here("inspect", *frames, "--rig", rig)
    assert looked.returncode in (0, 1) and note in looked.stderr
    rig.write_text(rig.read_text().replace(f"focal_sigma = {0.1 * fx}", "focal_sigma = -1"))
    assert_refused(correct(*frames, "--rig", rig, "--out", tmp_path / "other"), "focal_sigma = -1")


def test_a_camera_that_was_found_and_errors_of_its_calibration_are_two_lines(
    capsys: pytest.CaptureFixture[str],
) -> None:
    for camera in ("", "focal length 690.0 +- 22.0 px"):
        say_calibration({"camera_note": camera, "calibration_note": "rows by up to 1.0 px"})
        lines = capsys.readouterr().out.splitlines()
        assert lines[-1].endswith("rows by up to 1.0 px") and lines[:-1] == [camera][: bool(camera)]


@pytest.mark.slow
def test_an_inspected_shutter_is_compared_with_the_options(frames: list[Path], rig: Path) -> None:
    found = run_here("inspect", *frames, "--rig", rig, "--readout-ratio", 0.25, "--json")
    assert found.returncode in (0, 1), found.stderr
    assert json.loads(found.stdout)["said"]["readout_ratio"] == 0.25


def test_options_of_a_shutter_need_a_rig_to_inspect(tmp_path: Path) -> None:
    assert_refused(run_here("inspect", tmp_path, "--shutter", "gopro-hero6-4k30"), "--shutter", "--rig")


def test_a_sequence_of_folders(tmp_path: Path, frames: list[Path], rig: Path) -> None:
    for number, path in enumerate(frames):
        side = tmp_path / ("left", "right")[number % 2]
        side.mkdir(exist_ok=True)
        (side / f"{number // 2}.png").write_bytes(path.read_bytes())
    out = tmp_path / "out"
    given = ("--left", tmp_path / "left", "--right", tmp_path / "right", "--rig", rig, "--inpaint", "--out")
    result = correct(*given, out)
    assert result.returncode == 0, result.stderr
    assert "2 of 2 times corrected" in result.stdout
    names = ("left_000000", "right_000000", "left_000001", "right_000001")
    for name in names:
        assert (out / "corrected" / f"{name}.png").is_file()
    record = json.loads((out / "motion.json").read_text("utf-8"))
    assert [frame["number"] for frame in record["frames"]] == [0, 1]
    # The same as a video without loss: both cameras side by side.
    film = tmp_path / "film.mkv"
    assert correct(*given, film).returncode == 0
    video = cv2.VideoCapture(str(film))
    for number in (0, 1):
        sides = [cv2.imread(str(out / "corrected" / f"{side}_{number:06d}.png")) for side in ("left", "right")]
        np.testing.assert_array_equal(video.read()[1], np.hstack(sides))
    assert not video.read()[0] and (tmp_path / "film.json").is_file()


@pytest.mark.slow
def test_frames_that_the_motion_does_not_explain_are_named(
    tmp_path: Path, frames: list[Path], rig: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chain, "_CREDIBLE", 2.0)  # more than any motion explains
    out, words = tmp_path / "out", "rsbench: corrected by each camera alone: frames "
    result = correct(*frames, "--rig", rig, "--out", out)
    assert result.returncode == 0, result.stderr
    assert result.stderr.splitlines()[-1].startswith(
        words + "left 0, left 1, right 0, right 1: the motion of the rig"
    )
    record = _check_outputs(out, ORDER)
    assert set(record["alone"]) == {"explained", *ORDER}
    assert not np.any(read_depth(out / "depth" / "left_0.exr"))  # one camera does not know its unit
    for number, path in enumerate(frames):
        side = tmp_path / ("left", "right")[number % 2]
        side.mkdir(exist_ok=True)
        (side / f"{number // 2}.png").write_bytes(path.read_bytes())
    given = ("--left", tmp_path / "left", "--right", tmp_path / "right", "--rig", rig)
    result = correct(*given, "--out", tmp_path / "sequence")
    assert result.stderr.splitlines()[-1].startswith(words + "0 to 1: ")
    entries = json.loads((tmp_path / "sequence" / "motion.json").read_text("utf-8"))["frames"]
    assert [set(each["alone"]) for each in entries] == [{"explained", "left", "right"}] * 2


@pytest.fixture
def footage(tmp_path: Path, castle: Sequence, rig: Path) -> tuple[object, ...]:
    """The third of five frames is blank."""
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        for number, frame in enumerate((0, 1, None, 0, 1)):
            image = np.full_like(castle.image("rs", "left", 0), 128)
            if frame is not None:
                image = castle.image("rs", side, frame)
            write_png(tmp_path / side / f"{number}.png", image)
    rig.write_text(rig.read_text().replace("[camera]", "[camera]\nfocal_sigma = 3"))
    given = ("--left", tmp_path / "left", "--right", tmp_path / "right", "--rig", rig)
    return (*given, "--row-poses", "--out")


@pytest.mark.slow
def test_a_killed_run_of_footage_goes_on_to_the_same_bytes(
    tmp_path: Path, footage: tuple[object, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    for part in ("whole", "halves"):
        (tmp_path / part).mkdir()
    assert correct(*footage, tmp_path / "whole" / "out").returncode == 0
    written, write = list[int](), corrected_frames.write_entry

    def until(last: int) -> Callable[[Path, dict[str, Any]], None]:
        def write_or_stop(folder: Path, entry: dict[str, Any]) -> None:
            if entry["number"] == last:
                raise KeyboardInterrupt
            written.append(entry["number"])
            write(folder, entry)

        return write_or_stop

    for last, code in ((1, 130), (4, 130), (5, 0)):
        with monkeypatch.context() as patch:
            patch.setattr(corrected_frames, "write_entry", until(last))
            assert correct(*footage, tmp_path / "halves" / "out").returncode == code
    assert written == [0, 1, 2, 3, 4]
    assert bytes_below(tmp_path / "halves") == bytes_below(tmp_path / "whole")


def test_a_bad_window_is_bridged_and_told(tmp_path: Path, footage: tuple[object, ...]) -> None:
    """The trajectory through the neighbours of a blank frame bridges it, and the end says so."""
    out = tmp_path / "out"
    result = correct(*footage, out)
    assert result.returncode == 0, result.stderr
    bridged = result.stderr.strip().splitlines()[-1]
    assert "corrected with the motion of the frames around: frame 1 (only 0 matches" in bridged
    assert "frame 2 (only 0 matches" in bridged and bridged.count("frame ") == 2
    frames = json.loads((out / "motion.json").read_text())["frames"]
    assert ["skipped" in frame for frame in frames] == [number in (1, 2) for number in range(5)]
    assert "5 of 5 times corrected" in result.stdout
    lines = [line.split() for line in (out / "trajectory.csv").read_text().splitlines()[1:]]
    assert [float(line[0]) for line in lines] == [0.0, 1.0, 2.0, 3.0, 4.0] and {len(line) for line in lines} == {8}
    page = (out / "report.html").read_text("utf-8")
    assert page.count("<polyline") == 6 and page.count("<rect") == 4  # three axes; two windows, in two drawings
    # Row 0 of a frame is at the frame's own time, and all rows within the readout.
    rows = np.loadtxt(out / "row_poses.csv")
    assert rows.shape == (5 * 96, 8) and np.all(np.diff(rows[:, 0]) > 0.0) and rows[-1, 0] < 5.0
    np.testing.assert_allclose(rows[::96], np.array(lines, dtype=float), atol=1e-7)  # nine digits


def _log(path: Path, rate: float) -> Path:
    """Of a rig that swings by so many rad/s, 200 samples a second."""
    rows = [f"{5_000_000 * k},{rate * np.sin(0.2 * k)},0,0" for k in range(-20, 120)]
    path.write_text("stamp_ns,wx,wy,wz\n" + "\n".join(rows), encoding="utf-8")
    return path


@pytest.mark.slow
def test_a_gyroscope_that_contradicts_the_frames_is_told_and_left_out(
    tmp_path: Path, footage: tuple[object, ...]
) -> None:
    log = _log(tmp_path / "log.csv", 3.0)
    for name, more in (("alone", ()), ("both", ("--gyro", log, "--fps", 20))):
        result = correct(*footage, tmp_path / name, *more)
        assert result.returncode == 0, result.stderr
        told = "corrected without the gyroscope: frame 0 (the gyroscope contradicts the frames)"
        assert (told in result.stderr) == (name == "both")
    alone, both = (bytes_below(tmp_path / name / "corrected") for name in ("alone", "both"))
    assert alone == both
    assert_refused(correct(*footage, tmp_path / "no", "--gyro", log), "--fps")
    assert_refused(correct(*footage, tmp_path / "no", "--fps", 20), "needs --gyro")
    given = ("--gyro", log, "--fps", 20, "--motion-model", "linear")
    assert_refused(correct(*footage, tmp_path / "no", *given), "--gyro", "four frames and more")
    assert_refused(correct(*footage, tmp_path / "no", *given[:4], "--gyro-offset", 90), "--gyro-offset")
    given = ("--row-poses", "--motion-model", "linear")
    assert_refused(correct(*footage, tmp_path / "no", *given), "--row-poses", "four frames and more")


def test_bad_calls_are_refused_and_leave_nothing(tmp_path: Path, frames: list[Path], rig: Path) -> None:
    out = tmp_path / "out"
    common = ("--rig", rig, "--out", out)
    small = tmp_path / "small.png"
    cv2.imwrite(str(small), read_png(frames[0])[:60])
    flat = tmp_path / "flat.png"
    cv2.imwrite(str(flat), np.full((96, 128), 128, np.uint8))
    assert_refused(correct(*frames[:3], *common), "3 images")
    assert_refused(correct(*frames, "--rig", rig, "--out", tmp_path / "film.mp4"), "give a folder")
    assert_refused(correct(*frames[:3], small, *common), "small.png", "128 x 60", "128 x 96")
    assert_refused(correct(*frames[:3], tmp_path / "none.png", *common), "none.png", "does not exist")
    assert_refused(correct(*[flat] * 4, *common), "no texture")
    assert_refused(correct(*frames, *common, "--target", "500"), "--target 500", "95")
    assert_refused(correct(*frames, "--out", out), "--rig")
    assert_refused(correct(*frames, *common, "--solver", "nobody"), "nobody", "does not exist")
    assert_refused(correct(*frames, "--rig", tmp_path / "no.toml", "--out", out), "no.toml")
    assert {path.name for path in tmp_path.iterdir()} == {"rig.toml", "small.png", "flat.png"}


def test_a_cut_image_is_one_line_without_one_of_opencv(tmp_path: Path, frames: list[Path], rig: Path) -> None:
    cut = tmp_path / "cut.png"
    cut.write_bytes(frames[0].read_bytes()[:2000])
    given = (cut, *frames[1:], "--rig", rig, "--out", tmp_path / "out")
    done = run_apart("correct", *given)  # OpenCV has read its environment here
    assert_refused(done, "cut.png", "cannot be decoded")


def test_a_folder_of_others_is_not_touched(tmp_path: Path, frames: list[Path], rig: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "precious.txt").write_text("mine")
    assert_refused(correct(*frames, "--rig", rig, "--out", out), "choose another --out")
    assert (out / "precious.txt").read_text() == "mine"


@pytest.mark.slow
def test_where_nothing_moves_an_unknown_readout_hardly_matters(
    tmp_path: Path, castle: Sequence, rig: Path
) -> None:
    """The same pair twice: nothing tells how the rows were read, and there is nothing to correct."""
    left, right = (castle.folder / "gs" / f"{side}_0.png" for side in ("left", "right"))
    write_rig(rig, castle.rig)
    result = correct(left, right, left, right, "--rig", rig, "--out", tmp_path / "out")
    assert result.returncode == 0, result.stderr
    assert "hardly matters" in result.stdout
    image, before = (read_png(path).astype(float) for path in (tmp_path / "out/corrected/left_0.png", left))
    assert np.median(np.abs(image - before)) <= 1.0


def test_one_window_of_a_rig_that_is_off_says_how_far_it_errs() -> None:
    """A fitted disparity offset is what tells a real rig from a rendered one."""
    shutter = RollingShutter(height=480, readout_ratio=0.1)
    options = SimulationOptions(tracks=60, noise_px=0.2)
    rig = StereoRig(camera=PinholeCamera.centred(640, 480, 520.0), baseline=0.4)
    motion = LinearMotion(w=np.radians([1.2, -0.7, 1.5]), d=[0.1, -0.15, 0.1])
    matches = simulate(rig, shutter, motion, options, np.random.default_rng(0)).correspondences
    known = Known(scans=(Scans("top", "top"),), delay=0.0, models=("linear",))
    window = examine(matches, rig, replace(known, calibration_sigma=offset_error(0.5)))
    taken = KnownCapture(rig=rig, shutter=shutter)
    assert "may err" in readout_words(replace(taken, capture=conclude([window])))
    assert "may err" not in readout_words(replace(taken, capture=conclude([window, window])))
    assert "may err" not in readout_words(replace(taken, capture=conclude([examine(matches, rig, known)])))
