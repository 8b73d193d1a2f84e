"""The page of a rig of one's own: its commands, as printed, on frames of a ray tracer of no code of ours."""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import re
import runpy
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from calibration_files import matrix, opencv
from commands import run_here
from documents import ROOT, blocks
from numpy.typing import NDArray

PAGE = ROOT / "docs" / "how-to" / "your-own-rig.md"
SCALE = 0.75
"""Of the width and height of the frames that the page shows."""


def _smaller(c: Any) -> Any:
    """The same camera with images of fewer pixels."""
    shift = tuple(SCALE * each for each in c.shift)
    return replace(c, width=480, height=360, fx=SCALE * c.fx, fy=SCALE * c.fy, shift=shift)


class Day(NamedTuple):
    folder: Path
    """Of a user: four frames, a Kalibr and an OpenCV file."""
    still: dict[str, NDArray[np.uint8]]
    """At the time of each frame's first row, without noise."""
    rotation_deg: float


@pytest.fixture(scope="module")
def day(tmp_path_factory: pytest.TempPathFactory) -> Day:
    folder = tmp_path_factory.mktemp("day")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "benchmarks"))
        frames, rigs, world = (importlib.import_module(f"foreign_{each}") for each in ("frames", "rig", "world"))
    case, rng = frames.draw_case("printed", 0)
    rig = replace(case.rig, left=_smaller(case.rig.left), right=_smaller(case.rig.right))
    traced = frames.trace_case(replace(case, rig=rig), rng, world.read_photographs(None))
    truth = {}
    for (side, frame), image in traced.rolling.items():
        cv2.imwrite(str(folder / f"{side}_{frame}.png"), frames.grey(image))
        truth[f"{side}_{frame}"] = frames.grey(traced.still[side, frame])
    (folder / "camchain.yaml").write_text(rigs.camchain(rig), "utf-8")
    _write_opencv(folder / "stereo.yml", rig)
    return Day(folder, truth, float(np.degrees(np.linalg.norm(case.law.w))))


def _write_opencv(path: Path, rig: Any) -> None:
    """As OpenCV's sample of stereo calibration writes it, in millimetres."""
    values = {"R": np.asarray(rig.R), "T": 1000.0 * np.asarray(rig.t).reshape(3, 1)}
    for number, c in enumerate((rig.left, rig.right), start=1):
        k = np.zeros((1, 5))
        k[0, : len(c.coefficients)] = c.coefficients
        values |= {f"M{number}": matrix((c.fx, c.fy, *c.centre)), f"D{number}": k}
    opencv(path, **values)


def _psnr(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    return float(10.0 * np.log10(255.0**2 / np.mean((a.astype(np.float64) - b) ** 2)))


def _row_difference(folder: Path) -> float:
    """Median over OpenCV's matches of a rectified pair, px, of those within reach of a row."""
    sift = cv2.SIFT_create()
    images = [cv2.imread(str(folder / f"{side}_0.png"), 0) for side in ("left", "right")]
    (left, a), (right, b) = (sift.detectAndCompute(image, None) for image in images)
    pairs = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(a, b)
    rows = np.array([left[m.queryIdx].pt[1] - right[m.trainIdx].pt[1] for m in pairs])
    return float(np.median(np.abs(rows[np.abs(rows) < 5.0])))


@pytest.mark.slow
@pytest.mark.parametrize(("number", "out"), [(0, "corrected"), (1, "corrected-opencv")])
def test_three_commands_lead_from_a_calibration_to_a_rectified_pair(
    day: Day, monkeypatch: pytest.MonkeyPatch, number: int, out: str
) -> None:
    folder, truth, rotation_deg = day
    monkeypatch.chdir(folder)
    commands = [shlex.split(line) for line in blocks(PAGE, "sh")[number].splitlines()]
    assert [words[:2] for words in commands] == [["rsbench", each] for each in ("rig", "inspect", "correct")]
    said = []
    for _, *words in commands:
        run = run_here(*(word.replace("640x480", "480x360") for word in words))
        assert run.returncode == 0, run.stderr
        said.append(run.stdout)
    # What the page quotes, of the same rig; the true ratio is 0.8, which fewer pixels show less well.
    assert "200.01 mm" in said[0] and "1.079 deg in all" in said[0]
    (ratio,) = re.findall(r"top +top +(0\.\d+) \+-", said[1])
    assert abs(float(ratio) - 0.8) < 0.03
    motion = json.loads(Path(out, "motion.json").read_text("utf-8"))["motion"]
    # With all pixels it is off by 0.0004 deg. The angle of a rotation is the same in the axes of any camera.
    assert abs(motion["rotation_deg"] - rotation_deg) < 0.02
    for name, true in truth.items():
        before, after = (cv2.imread(str(each / f"{name}.png"), 0) for each in (Path(), Path(out, "corrected")))
        assert _psnr(after, true) > _psnr(before, true) + 5.0
    # SIFT places a point to a tenth or two of a pixel, so that the difference of two rows is no more than 0.3.
    assert _row_difference(Path(out, "rectified")) < 0.3
    assert _row_difference(Path()) > 1.0
    if number == 0:
        printed = io.StringIO()
        (script,) = blocks(PAGE, "python")
        Path("points.py").write_text(script, "utf-8")
        with contextlib.redirect_stdout(printed):
            runpy.run_path("points.py")
        ((count, metres),) = re.findall(r"(\d+) points, ([\d.]+) m away in the median\n", printed.getvalue())
        assert int(count) > 0.5 * 480 * 360
        assert 1.0 < float(metres) < 20.0  # the world is a room
