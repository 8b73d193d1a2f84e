"""Exports of what ``rsbench correct`` makes of footage, against the motion and the planes that it shows here."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import assert_refused, run_here
from evo.tools import file_interface
from exported_data import HEIGHT, PLACE, dataset, only, opencv_pixels
from general_rigs import RIGS, SCANS
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rsbench.core.rig import SIDES, Side
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray
from rsbench.dataset.corrected_frames import capture_record, join_poses, write_frame, write_poses, write_record
from rsbench.dataset.sequence import Sequence
from rsbench.interop.readers.layouts import read_colmap
from rsbench.interop.writers.colmap_and_tum import read_corrected_folder
from rsbench.pipeline.frame_capture import KnownCapture
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.storage.files import read_json, write_json, write_png
from rsbench.storage.work_folder import HIDDEN, remove
from rsbench.vision.fusion import Fused, Origin

FRAMES = 4
_NINE_DIGITS = 1e-8
"""What trajectory.csv rounds to, of positions below 1 m and quaternions."""


def _corrected(data: Path, out: Path, row: int = 0, rows: bool = False) -> Sequence:
    """The twins of a sequence as a folder of corrected frames; all but the last one."""
    sequence = only(data)
    shutter, motion = sequence.shutter, sequence.motion
    for frame in range(FRAMES):
        for side in SIDES if frame < FRAMES - 1 else ():
            fused = Fused(
                image=sequence.image("gs", side, frame, row),
                origin=np.full(sequence.image("gs", side, frame).shape[:2], int(Origin.HERE), dtype=np.uint8),
                depth=sequence.depth("gs", side, frame, row),
            )
            write_frame(out, f"{side}_{frame:06d}", fused)
        write_poses(out, "trajectory", frame, [float(frame)], motion.body_from_world(float(frame)))
        if rows:
            taus = np.sort(shutter.line_times(frame, "left"))
            write_poses(out, "row_poses", frame, taus, motion.body_from_world(taus))
    join_poses(out, "trajectory")
    join_poses(out, "row_poses")
    remove(out / HIDDEN)
    options = CorrectionOptions(target_row=float(row))
    write_record(out, {**capture_record(KnownCapture(rig=sequence.rig, shutter=shutter), options), "frames": []})
    return sequence


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return dataset(tmp_path / "data", frames=FRAMES)


def _refused(folder: Path, out: Path, to: str, *words: str) -> None:
    assert_refused(run_here("export", folder, "--to", to, "--out", out), *words)
    assert not out.exists()


def _assert_pose(found: tuple[FloatArray, FloatArray], sequence: Sequence, side: Side, tau: Any) -> None:
    """``cam_from_world`` of a camera at times (...)."""
    for part, true in zip(found, sequence.rig.cam_from_world(sequence.motion, tau, side), strict=True):
        np.testing.assert_allclose(part, true, atol=_NINE_DIGITS)


def _export(folder: Path, name: str, out: Path) -> dict[str, Any]:
    result = run_here("export", folder, "--to", name, "--out", out)
    assert result.returncode == 0, result.stderr
    return read_json(out / "export.json")["sequences"]


@pytest.mark.parametrize("rows", [False, True])
def test_evo_reads_the_cameras_of_a_corrected_sequence(tmp_path: Path, data: Path, rows: bool) -> None:
    sequence = _corrected(data, tmp_path / "walk", rows=rows)
    note = _export(tmp_path / "walk", "tum", tmp_path / "out")["walk"]
    assert note["poses"] == FRAMES and "frame periods" in note["told"][0]
    files = {f"{side}.txt": (side, np.arange(float(FRAMES))) for side in SIDES}
    if rows:
        taus = np.concatenate([sequence.shutter.line_times(frame, "left") for frame in range(FRAMES)])
        files["left_rows.txt"] = ("left", taus)
    assert (tmp_path / "out/walk/left_rows.txt").exists() == rows
    for name, (side, tau) in files.items():
        read = file_interface.read_tum_trajectory_file(tmp_path / "out/walk" / name)
        assert read.check()[0], read.check()[1]
        np.testing.assert_allclose(read.timestamps, tau, atol=_NINE_DIGITS)
        poses = np.linalg.inv(np.array(read.poses_se3))
        _assert_pose((poses[:, :3, :3], poses[:, :3, 3]), sequence, side, tau)


@pytest.mark.parametrize("name", RIGS)
def test_the_record_of_a_rig_is_read_to_the_bit(tmp_path: Path, name: str) -> None:
    rig = RIGS[name]
    shutter = rig.shutter_of(SCANS["late"], 0.8)
    write_record(
        tmp_path, {**capture_record(KnownCapture(rig=rig, shutter=shutter), CorrectionOptions()), "frames": []}
    )
    write_poses(tmp_path, "trajectory", 0, [0.0, 1.0], Pose(np.stack([np.eye(3)] * 2), np.zeros((2, 3))))
    join_poses(tmp_path, "trajectory")
    found = read_corrected_folder(tmp_path)
    assert found.rig == rig and found.shutter == shutter


def _images(path: Path) -> dict[str, tuple[FloatArray, FloatArray]]:
    """R and t by the name of the image, of COLMAP's images.txt: every second line holds points."""
    words = [line.split() for line in path.read_text("utf-8").splitlines()[::2]]
    quaternions = [np.array(line[1:5], dtype=float)[[1, 2, 3, 0]] for line in words]
    return {
        line[9]: (Rotation.from_quat(q).as_matrix(), np.array(line[5:8], dtype=float))
        for line, q in zip(words, quaternions, strict=True)
    }


@pytest.mark.parametrize("row", [0, HEIGHT // 2])
def test_colmap_gets_corrected_frames_with_the_poses_of_their_time(tmp_path: Path, data: Path, row: int) -> None:
    """Points come from the depth of the left frame: each must lie in the right frame where its colour is."""
    sequence = _corrected(data, tmp_path / "walk", row, rows=row > 0)
    note = _export(tmp_path / "walk", "colmap", tmp_path / "out")["walk"]
    assert note["frames"] == FRAMES - 1 and "1 frames of the trajectory were not corrected" in note["told"][0]
    folder = tmp_path / "out/walk"
    found = _images(folder / "sparse/images.txt")
    assert sorted(found) == sorted(path.name for path in (folder / "images").iterdir())
    for name, pose in found.items():
        side: Side = "left" if name.startswith("left") else "right"
        _assert_pose(pose, sequence, side, int(name[-10:-4]) + sequence.shutter.readout_ratio * row / HEIGHT)
        assert (folder / "images" / name).read_bytes() == (tmp_path / "walk/corrected" / name).read_bytes()
        assert (folder / "masks" / f"{name}.png").is_file()
    points = np.loadtxt(folder / "sparse/points3D.txt")
    assert len(points) == note["points"] > 1000
    R, t = found["right_000000.png"]
    first = points[points[:, 0] <= note["points"] / (FRAMES - 1)]
    places = sequence.rig.camera.project(first[:, 1:4] @ R.T + t)
    _hold_colours(first, places, sequence.image("gs", "right", 0, row))


def _hold_colours(points: FloatArray, places: FloatArray, image: NDArray[np.uint8]) -> None:
    """Points have the colours of an image at their places there (n, 2) px."""
    pixels = np.round(places).astype(int)
    inside = np.all((pixels >= 0) & (pixels < image.shape[1::-1]), axis=1)
    off = np.abs(image[pixels[inside, 1], pixels[inside, 0]].astype(float) - points[inside, 4:7])
    # Waves of some 12 px and 50 levels, looked up in whole pixels: half a pixel of them is 13 levels.
    assert np.median(off) < 13.0 and np.count_nonzero(inside) > 300


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--to", "kitti"], ["--to kitti", "exported to tum or colmap"]),
        (["--to", "colmap", "--images", "rs"], ["--images rs", "one sequence of corrected frames"]),
        (["--to", "tum", "--sequence", "castle"], ["--sequence castle"]),
    ],
)
def test_options_that_cannot_be_are_one_line(
    tmp_path: Path, data: Path, options: list[str], words: list[str]
) -> None:
    _corrected(data, tmp_path / "walk")
    assert_refused(run_here("export", tmp_path / "walk", "--out", tmp_path / "out", *options), *words)
    assert not (tmp_path / "out").exists()


def test_a_lens_stays_a_lens(tmp_path: Path) -> None:
    _corrected(dataset(tmp_path / "data", "brown", frames=FRAMES), tmp_path / "walk")
    _export(tmp_path / "walk", "colmap", tmp_path / "out")
    line = (tmp_path / "out/walk/sparse/cameras.txt").read_text("utf-8").splitlines()[0].split()
    assert line[1] == "OPENCV"
    assert [float(word) for word in line[4:]] == [60, 61, 31, 25.5, -0.1, 0.02, 0.001, -0.002]


def test_a_frame_whose_row_has_no_pose_is_left_out(tmp_path: Path, data: Path) -> None:
    _corrected(data, tmp_path / "walk", HEIGHT // 2, rows=True)
    path = tmp_path / "walk/row_poses.csv"
    lines = path.read_text("utf-8").splitlines(keepends=True)
    path.write_text("".join(lines[: 1 + 2 * HEIGHT]), newline="\n")
    note = _export(tmp_path / "walk", "colmap", tmp_path / "out")["walk"]
    assert note["frames"] == 2 and "2 frames of the trajectory" in note["told"][0]


def test_a_picture_of_another_size_is_one_line(tmp_path: Path, data: Path) -> None:
    _corrected(data, tmp_path / "walk")
    write_png(tmp_path / "walk/corrected/left_000001.png", np.zeros((8, 8, 3), dtype=np.uint8))
    _refused(tmp_path / "walk", tmp_path / "out", "colmap", "left_000001.png")


def test_frames_of_another_row_need_the_poses_of_rows(tmp_path: Path, data: Path) -> None:
    _corrected(data, tmp_path / "walk", HEIGHT // 2)
    _refused(tmp_path / "walk", tmp_path / "out", "colmap", "of the time of row 24", "--row-poses")


def test_cameras_that_read_apart_have_no_pair_of_one_time(tmp_path: Path) -> None:
    data = dataset(tmp_path / "data", frames=FRAMES, right_delay=0.1)
    _corrected(data, tmp_path / "walk")
    words = "do not read each row at one time", "--to tum"
    _refused(tmp_path / "walk", tmp_path / "out", "colmap", *words)


def test_two_cameras_that_differ_are_exported_as_they_are(tmp_path: Path) -> None:
    """Points of the left depth lie in the right frame where their colour is, by OpenCV's model of its lens."""
    data = dataset(tmp_path / "data", "brown", frames=FRAMES, right="fisheye", right_readout_ratio=0.4)
    sequence = _corrected(data, tmp_path / "walk")
    note = _export(tmp_path / "walk", "colmap", tmp_path / "out")["walk"]
    _export(tmp_path / "walk", "tum", tmp_path / "tum")
    found = _images(tmp_path / "out/walk/sparse/images.txt")
    for name, pose in found.items():
        side: Side = "left" if name.startswith("left") else "right"
        read = file_interface.read_tum_trajectory_file(tmp_path / f"tum/walk/{side}.txt")
        camera_from_world = np.linalg.inv(read.poses_se3[int(name[-10:-4])])
        for each in (pose, (camera_from_world[:3, :3], camera_from_world[:3, 3])):
            _assert_pose(each, sequence, side, float(int(name[-10:-4])))
    points = np.loadtxt(tmp_path / "out/walk/sparse/points3D.txt")
    points = points[points[:, 0] <= note["points"] / (FRAMES - 1)]
    R, t = found["right_000000.png"]
    K = np.array([[75.0, 0.0, 41.0], [0.0, 74.0, 20.5], [0.0, 0.0, 1.0]])
    places = opencv_pixels(points[:, 1:4] @ R.T + t, K, "fisheye")
    _hold_colours(points, places, sequence.image("gs", "right", 0))
    (recording,) = read_colmap(tmp_path / "out/walk/sparse")
    assert recording.rig is not None
    np.testing.assert_allclose(recording.rig.right_from_left.t, PLACE, atol=1e-12)
    assert recording.rig.sensor("right") == sequence.rig.sensor("right")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, ["has no trajectory.csv", "four frames"]),
        ("0 0 0 0 0 0 0\n", ["trajectory.csv: must hold lines of timestamp"]),
        ("0 0 0 0 0 0 0 2\n", ["trajectory.csv: must hold lines of timestamp"]),
        ("0 0 0 nan 0 0 0 1\n", ["trajectory.csv: must hold lines of timestamp"]),
        ("", ["trajectory.csv: must hold lines of timestamp"]),
        ("1 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n", ["trajectory.csv: must hold lines of timestamp"]),
    ],
)
def test_a_trajectory_that_is_none_is_one_line(
    tmp_path: Path, data: Path, text: str | None, words: list[str]
) -> None:
    _corrected(data, tmp_path / "walk")
    path = tmp_path / "walk/trajectory.csv"
    path.unlink() if text is None else path.write_text(text, newline="\n")
    _refused(tmp_path / "walk", tmp_path / "out", "tum", *words)


@pytest.mark.parametrize(
    "change", [{"camera": {"width": 64}}, {"baseline": "wide"}, {"lens": {"model": "none"}}, {"scan": 3}]
)
def test_a_record_that_says_no_rig_is_one_line(tmp_path: Path, data: Path, change: dict[str, Any]) -> None:
    _corrected(data, tmp_path / "walk")
    path = tmp_path / "walk/motion.json"
    write_json(path, read_json(path) | change)
    _refused(tmp_path / "walk", tmp_path / "out", "tum", "motion.json")
