"""The script that scores a folder in KITTI's layout, on a folder of known motion written here."""

from __future__ import annotations

import re
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import programs
import pytest

from rsbench.core import so3

ROOT = Path(__file__).parents[1]
F, BASELINE, DEPTH, STEP = 200.0, 0.5, 10.0, 6


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return programs.program("examples/score_kitti.py")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A wall 10 m away; the rig moves 6 px, 0.3 m, to the right in each of two windows."""
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.integers(0, 256, (120, 300)).astype(np.float32), (0, 0), 1.5)
    wall = cv2.normalize(wall, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    disparity = round(F * BASELINE / DEPTH)
    for number, side in enumerate(("image_0", "image_1")):
        (tmp_path / side).mkdir()
        for frame in range(3):
            start = 20 + frame * STEP + number * disparity
            cv2.imwrite(str(tmp_path / side / f"{frame:06d}.png"), wall[:, start : start + 200])
    projection = "{0} 0 99.5 {1} 0 {0} 59.5 0 0 0 1 0"
    names = (projection.format(F, 0.0), projection.format(F, -F * BASELINE))
    (tmp_path / "calib.txt").write_text("".join(f"P{k}: {line}\n" for k, line in enumerate(names)))
    metres = STEP * DEPTH / F
    (tmp_path / "poses.txt").write_text("".join(f"1 0 0 {k * metres} 0 1 0 0 0 0 1 0\n" for k in range(3)))
    return tmp_path


def test_a_known_motion_scores_well(script: ModuleType, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Whole pixels of motion: SIFT's keypoints repeat to 0.05 px, which is 0.01 deg and 1 % of 6 px."""
    assert script.main([str(folder)]) == 0
    lines = capsys.readouterr().out.splitlines()
    rotation, direction, length = map(float, re.findall(r"[-+]?\d+\.\d+", lines[-3]))
    assert rotation < 0.05 and direction < 1.0 and abs(length) < 1.0
    off, path, share = map(float, re.findall(r"\d+\.?\d*", lines[-2]))
    assert off < 0.02 and path == 1.0 and share < 2.0  # 0.6 m, rounded
    assert lines[-1] == "0 of 2 windows refused"


def test_the_drift_is_the_distance_at_the_end(script: ModuleType) -> None:
    """A quarter turn on the spot, then a metre ahead: to the right of the first frame, or to the left."""
    turn = so3.exp(np.array([0.0, np.pi / 2, 0.0]))
    ahead = (np.eye(3), np.array([0.0, 0.0, -1.0]))  # the world comes nearer
    right, left = ([(each, np.zeros(3)), ahead] for each in (turn.T, turn))
    np.testing.assert_allclose(script.end_of(right), (1.0, 0.0, 0.0), atol=1e-12)
    assert script.drift(list(zip(left, right, strict=True))) == "drift 2.00 m over 1 m, 200.0%"


def test_exchanged_cameras_are_refused_in_every_window(
    script: ModuleType, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script.main([str(folder), "--left", "image_1", "--right", "image_0"])
    out = capsys.readouterr().out
    assert "exchanged" in out and "2 of 2 windows refused" in out


def test_a_wrong_focal_length_leaves_the_baseline(script: ModuleType, folder: Path) -> None:
    rig = script.read_rig(folder, folder / "image_0" / "000000.png", 1.1)
    np.testing.assert_allclose([rig.camera.fx, rig.camera.fy, rig.baseline], [1.1 * F, 1.1 * F, BASELINE])


@pytest.mark.parametrize("name", ["calib.txt", "poses.txt"])
def test_what_is_missing_is_named(
    script: ModuleType, folder: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / name).unlink()
    assert script.main([str(folder)]) == 2
    assert name in capsys.readouterr().err


@pytest.mark.parametrize(
    "words", [("--ratio", "nan"), ("--ratio", "half"), ("--ratio", "1.5"), ("--every", "0"), ("--focal", "3")]
)
def test_options_that_mean_nothing_are_refused(
    script: ModuleType, folder: Path, words: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        script.main([str(folder), *words])
    assert end.value.code == 2 and f"argument {words[0]}: {words[1]!r} must be" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["calib.txt", "poses.txt"])
@pytest.mark.parametrize("damage", ["nan", "one", ""])
def test_damaged_numbers_are_one_line(
    script: ModuleType, folder: Path, name: str, damage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = folder / name
    path.write_text(path.read_text().replace(" 0 ", f" {damage} ", 1))
    assert script.main([str(folder)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{name}: every line must hold twelve numbers" in line
