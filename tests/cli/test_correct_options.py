"""Every option of ``rsbench correct`` has an effect or is refused, with a rig and with one camera."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from commands import assert_refused, run_here

from rsbench.cli import correct_run
from rsbench.cli.main import app
from rsbench.storage.files import write_png

RIG = "baseline = 0.3\nreadout_ratio = 0.8\n[camera]\nfx = 150\nfy = 150\ncx = 63.5\ncy = 47.5\n"
OTHER = {
    "target": ["--target", "middle"],
    "inpaint": ["--inpaint"],
    "sky": ["--no-sky"],
    "fill": ["--no-fill"],
    "solver": ["--solver", "rs-stereo-refined-pairs"],
    "motion_model": ["--motion-model", "twist"],
    "matcher": ["--matcher", "sgm-plain"],
    "features": ["--features", "sift"],
    "corrector": ["--corrector", "single-view"],
    "seed": ["--seed", "3"],
    "fast": ["--fast"],
    "row_poses": ["--row-poses"],
    "rectify": ["--rectify"],
    "side_by_side": ["--side-by-side"],
    "rig": ["--rig", "rig.toml"],
    "left": ["--left", "left"],
    "right": ["--right", "right"],
    "gyro": ["--gyro", "log.csv"],
    "fps": ["--fps", "30"],
    "gyro_offset": ["--gyro-offset", "0.1"],
    "readout_ratio": ["--readout-ratio", "0.5"],
    "shutter": ["--shutter", "gopro-hero6-4k30"],
    "fov": ["--fov", "60"],
}
"""A value of each option that is not its default."""
OF_INPUT = {"frames", "out", "camera", "footage"}
"""What every run, or one of its two kinds, has to give."""
ONE_CAMERA = {"target", "inpaint", "seed", "gyro", "fps", "gyro_offset", "readout_ratio", "shutter", "fov"}


def _parameters() -> set[str]:
    (found,) = (each for each in typer.main.get_group(app).commands.items() if each[0] == "correct")
    return {parameter.name or "" for parameter in found[1].params} - {"help"}


def test_every_option_is_walked() -> None:
    assert _parameters() == OTHER.keys() | OF_INPUT


@pytest.mark.parametrize("option", sorted(OTHER.keys() - ONE_CAMERA))
def test_options_of_a_rig_are_refused_for_one_camera(option: str, tmp_path: Path) -> None:
    result = run_here("correct", "--frames", tmp_path, "--out", tmp_path / "out", *OTHER[option])
    assert_refused(result, OTHER[option][0], "no effect on frames of one camera")
    assert not (tmp_path / "out").exists()


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """What a call of the command would correct, with which options."""
    calls: list[Any] = []
    monkeypatch.setattr(correct_run, "correct_given", lambda *known: calls.append(known))

    def called(*arguments: object) -> str:
        calls.clear()
        run_here("correct", *arguments)
        (call,) = calls
        return repr(call)

    return called


@pytest.mark.parametrize("option", sorted(ONE_CAMERA))
def test_options_of_one_camera_reach_its_correction(
    option: str, tmp_path: Path, given: Callable[..., str]
) -> None:
    write_png(tmp_path / "0.png", np.zeros((48, 64, 3), np.uint8))
    log = [] if option == "gyro" else OTHER["gyro"]
    frames = ["--frames", tmp_path, "--out", tmp_path / "out", *log]
    assert given(*frames) != given(*frames, *OTHER[option])


@pytest.mark.parametrize("option", sorted(OTHER.keys() - {"rig", "left", "right", "row_poses", "gyro", "fov"}))
def test_options_of_a_rig_reach_its_correction(option: str, tmp_path: Path, given: Callable[..., str]) -> None:
    (tmp_path / "rig.toml").write_text(RIG)
    right = ["--right", "right"]
    frames = ["--left", "left", "--rig", tmp_path / "rig.toml", "--out", tmp_path / "out", *OTHER["gyro"]]
    other = frames if option == "side_by_side" else [*frames, *right]
    assert given(*frames, *right) != given(*other, *OTHER[option])


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("row_poses", "no trajectory"),
        ("gyro", "no trajectory"),
        ("fps", "needs --gyro or --shutter"),
        ("gyro_offset", "needs --gyro"),
    ],
)
def test_options_of_a_sequence_are_refused_for_two_times(option: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(RIG)
    four = [tmp_path / f"{name}.png" for name in ("l0", "r0", "l1", "r1")]
    for each in four:
        each.touch()
    result = run_here("correct", *four, "--rig", tmp_path / "rig.toml", "--out", tmp_path / "out", *OTHER[option])
    assert_refused(result, OTHER[option][0], words)
