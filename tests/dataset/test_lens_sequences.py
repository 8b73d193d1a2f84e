"""Sequences through lenses, of other scans and of a late right camera: rendered, verified, solved, scored."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from attack.planting import manifest_of, put, spoilt
from commands import run_here
from general_rigs import LENSES
from numpy.typing import NDArray

from rsbench.benchmark.images.evaluation import open_evaluation, read_scores
from rsbench.benchmark.images.plan import EvaluationOptions
from rsbench.components.cards import parse_card
from rsbench.core.camera import Lens
from rsbench.core.epipolar import rs_sampson_error
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import FRAMES, SIDES, VIEWS, View
from rsbench.dataset.card import CameraCard, DatasetCard, load_dataset_card
from rsbench.dataset.generation import generate_dataset
from rsbench.dataset.sequence import Sequence, read_sequence
from rsbench.pipeline.frame_capture import find_matches_of_rig
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.storage.files import read_depth, read_png
from rsbench.verification import content, verify_dataset
from rsbench.verification.pose_checks import pose_faults
from rsbench.vision.quality import psnr

BARREL = Lens(model="brown-conrady", k1=-0.22, k2=0.05, p1=0.001)
FISHEYE = Lens(model="kannala-brandt", k1=-0.03, k2=0.01)
CARDS = {
    "barrel": (BARREL, {"channels": ("flow", "gs_flow")}),
    "late": (
        None,
        {"scan": "bottom", "right_delay": 0.1, "channels": ("timing", "flow", "gs_flow", "normals", "tracks")},
    ),
    "columns": (FISHEYE, {"scan": "left", "right_scan": "right", "channels": ("flow", "gs_flow", "instances")}),
    "rational": (LENSES["rational"], {"channels": ("flow",)}),
    "spheres": (LENSES["double-sphere"], {"channels": ("flow",)}),
}


def _card(name: str) -> DatasetCard:
    smoke = load_dataset_card("smoke")
    lens, scanning = CARDS[name]
    camera = CameraCard(width=128, height=96, focal=110.0, lens=lens)
    return replace(smoke, camera=camera, sequence=smoke.sequence[1:], **scanning)  # pyrefly: ignore[bad-argument-type]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, scenes_once: None) -> dict[str, Path]:
    """Datasets of one sequence each."""
    folders = {}
    for name in CARDS:
        folders[name] = tmp_path_factory.mktemp("lenses") / name
        generate_dataset(_card(name), folders[name])
        assert generate_dataset(_card(name), folders[name]) == [], "a second run has nothing to do"
    return folders


@pytest.mark.parametrize("name", CARDS)
def test_verify_finds_them_sound(made: dict[str, Path], name: str) -> None:
    (report,) = verify_dataset(made[name], rerender="no")
    assert report.faults == ()
    sequence = read_sequence(made[name] / "room-twist")
    card = _card(name)
    assert sequence.manifest["conventions"] == 2, "version 1 is read by those who would take the lens for none"
    assert sequence.rig == card.rig_of(card.sequence[0]) and sequence.shutter == card.shutter_for(card.sequence[0])


@pytest.mark.parametrize(
    ("name", "keys", "value"),
    [("barrel", ["camera", "lens"], None), ("late", ["right_delay"], 0.09), ("columns", ["right_scan"], "left")],
)
def test_another_lens_or_scan_than_the_images_have_is_found(
    made: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    keys: list[str],
    value: object,
) -> None:
    monkeypatch.setattr(content, "likely_cause", lambda *given: "")  # its search takes nine tenths of the time
    change = manifest_of("sequence.json", put(*keys, value))
    data = spoilt(made[name], tmp_path / name, change, sequence="room-twist", fit=False)
    faults = [fault for report in verify_dataset(data, 4, rerender="no") for fault in report.faults]
    # Beside the hashes, the card and the poses say it.
    assert any(keys[-1] in fault for fault in faults) or any("looks" in f or "differ" in f for f in faults)
    if name != "barrel":
        assert list(pose_faults(read_sequence(data / "room-twist")))


@pytest.mark.slow
@pytest.mark.parametrize("name", CARDS)
def test_the_whole_way(made: dict[str, Path], tmp_path: Path, name: str) -> None:
    """A late camera, and opposite columns through a fisheye, find depth with the motion that they estimate."""
    options = EvaluationOptions(solvers=("rs-stereo-refined-twist",), correction_solver="rs-stereo-refined-twist")
    open_evaluation(made[name], tmp_path, options).run("test", lambda word: None)
    (pose,) = read_scores(tmp_path, "pose").to_dict("records")
    # A motion of 2 degrees; a tenth of a pixel of these images of 128 x 96 is 0.05 degrees. Without left-right
    # matches of two times the late camera's would be known to 1.2, opposite columns' to 1.9 degrees.
    assert pose["success"] and pose["e_R_deg"] < 0.4, pose
    assert len(read_scores(tmp_path, "failures")) == 0
    if name == "barrel":
        depth = read_scores(tmp_path, "depth")
        seen = depth[depth["pixels"] == "visible"]
        assert np.all(seen["success"]) and seen["bad_1px"].median() < 0.15 and seen["coverage"].median() > 0.7
    scores = read_scores(tmp_path, "correction")
    images = scores[scores["pixels"] == "visible"].groupby(["solver", "matcher"])["psnr"].mean()
    # The twin has the same lens: nothing but the resampling of these small images is between them.
    assert images["rs-stereo-refined-twist", "sgm"] > images["none", "none"] + 3.0
    assert images["true", "true"] > images["rs-stereo-refined-twist", "sgm"] - 0.5


APART = {
    "barrel": '[camera]\nlens = { model = "brown-conrady", k1 = -0.22, k2 = 0.05, p1 = 0.001 }\n',
    "late": 'scan = "bottom"\nright_delay = 0.1\n[camera]\n',
    "columns": 'scan = "left"\nright_scan = "right"\n[camera]\n'
    'lens = { model = "kannala-brandt", k1 = -0.03, k2 = 0.01 }\n',
}
"""What a rig.toml says of them beside focal length and centre."""


def _rig(sequence: Sequence, told: str, path: Path) -> Path:
    c = sequence.rig.camera
    given = f"baseline = {sequence.rig.baseline}\nreadout_ratio = {sequence.shutter.readout_ratio}\n"
    path.write_text(f"{given}{told}fx = {c.fx}\nfy = {c.fy}\ncx = {c.cx}\ncy = {c.cy}\n")
    return path


def _correct(sequence: Sequence, rig: Path, out: Path) -> subprocess.CompletedProcess[str]:
    frames = [sequence.folder / "rs" / f"{side}_{frame}.png" for frame in FRAMES for side in SIDES]
    return run_here("correct", *frames, "--rig", rig, "--out", out, "--solver", "rs-stereo-refined-twist")


@pytest.mark.slow
def test_correct_takes_frames_with_distortion(made: dict[str, Path], tmp_path: Path) -> None:
    sequence = read_sequence(made["barrel"] / "room-twist")
    done = _correct(sequence, _rig(sequence, APART["barrel"], tmp_path / "rig.toml"), tmp_path / "out")
    assert done.returncode == 0, done.stderr
    twin, frame = sequence.image("gs", "left", 1), sequence.image("rs", "left", 1)
    corrected = read_png(tmp_path / "out" / "corrected" / "left_1.png")
    drawn = read_png(tmp_path / "out" / "mask" / "left_1.png")[..., 0] == 255
    assert np.mean(drawn) > 0.8
    # The twin has the lens, and so has the corrected frame.
    assert psnr(corrected, twin, drawn) > psnr(frame, twin, drawn) + 3.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["late", "columns"])
def test_correct_takes_a_rig_of_cameras_apart(made: dict[str, Path], tmp_path: Path, name: str) -> None:
    """Motion, depth and frames, against those of the dataset; a rig.toml that does not say so corrects worse."""
    sequence, out = read_sequence(made[name] / "room-twist"), tmp_path / "out"
    done = _correct(sequence, _rig(sequence, APART[name], tmp_path / "rig.toml"), out)
    assert done.returncode == 0, done.stderr
    record = json.loads((out / "motion.json").read_text("utf-8"))
    # Half a degree is a pixel of this camera, whose images are 128 wide.
    np.testing.assert_allclose(record["motion"]["w"], sequence.motion.w, rtol=0, atol=np.deg2rad(0.5))
    np.testing.assert_allclose(record["motion"]["d"], sequence.motion.d, rtol=0, atol=0.03)
    drawn = {(s, f): read_png(out / f"mask/{s}_{f}.png")[..., 0] == 255 for s, f in VIEWS}
    for view in VIEWS:
        depth, true = read_depth(out / "depth/{}_{}.exr".format(*view)), sequence.depth("gs", *view)
        both = drawn[view] & (depth > 0) & (true > 0)
        # Half a pixel of some ten of disparity.
        assert np.mean(drawn[view]) > 0.8 and np.median(np.abs(depth[both] / true[both] - 1.0)) < 0.05
    before = _psnr({view: sequence.image("rs", *view) for view in VIEWS}, sequence, drawn)
    after = _psnr(_frames(out), sequence, drawn)
    assert after > before + 3.0
    done = _correct(sequence, _rig(sequence, "[camera]\n", tmp_path / "rig.toml"), tmp_path / "plain")
    assert done.returncode != 0 or _psnr(_frames(tmp_path / "plain"), sequence, drawn) < after - 1.0


def _frames(out: Path) -> dict[View, NDArray[np.uint8]]:
    return {view: read_png(out / "corrected/{}_{}.png".format(*view)) for view in VIEWS}


def _psnr(
    frames: dict[View, NDArray[np.uint8]], sequence: Sequence, drawn: dict[View, NDArray[np.bool_]]
) -> float:
    """Mean of the views, of what was drawn, against the global-shutter twins."""
    return float(np.mean([psnr(frames[view], sequence.image("gs", *view), drawn[view]) for view in VIEWS]))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("[camera]", "disparity_offset = 1.0\n[camera]", "disparity_offset = 1.0: must be 0 with camera.lens"),
        ("k1 = -0.22", "k1 = -0.9", "rig.toml: camera lens: the brown-conrady"),
    ],
)
def test_correct_refuses_by_name(made: dict[str, Path], tmp_path: Path, old: str, new: str, said: str) -> None:
    sequence = read_sequence(made["barrel"] / "room-twist")
    rig = _rig(sequence, APART["barrel"].replace(old, new), tmp_path / "rig.toml")
    done = _correct(sequence, rig, tmp_path / "out")
    assert done.returncode == 2 and said in done.stderr and done.stderr.count("rsbench: error:") == 1, done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", CARDS)
def test_matches_in_the_images_fit_the_true_motion_at_their_own_times(made: dict[str, Path], name: str) -> None:
    sequence = read_sequence(made[name] / "room-twist")
    images = {view: sequence.image("rs", *view) for view in VIEWS}
    rig, shutter, motion = sequence.rig, sequence.shutter, sequence.motion
    matches = find_matches_of_rig(images, rig, shutter.scanning, CorrectionOptions())
    assert len(matches.left) > 40 and len(matches.tracks) >= 8
    errors = [rs_sampson_error(rig, shutter, motion, side, getattr(matches, side)) for side in SIDES]
    # SIFT errs by some tenths of a pixel here. The image moves by few pixels, so this shows that matches are where
    # they should be; that times are, exact matches show (test_timed_tracks.py).
    assert np.median(np.abs(np.concatenate(errors))) < 0.25


def test_a_card_with_a_lens_that_folds_is_refused_by_name() -> None:
    data = {
        "name": "x",
        "baseline": 0.3,
        "readout_ratio": 0.8,
        "camera": {"width": 128, "height": 96, "focal": 60, "lens": {"model": "brown-conrady", "k1": -0.9}},
        "motion": {"rotation_deg": 0, "rotation_axis": [1, 0, 0], "translation": 0, "translation_axis": [1, 0, 0]},
        "sequence": [{"name": "a", "scene": "room"}],
    }
    with pytest.raises(RsbenchError, match=r"camera lens: the brown-conrady polynomial folds inside the image"):
        parse_card(DatasetCard, data, "card.toml")
    data["camera"] = {"width": 128, "height": 96, "focal": 60}
    with pytest.raises(RsbenchError, match=r"scan = 'up'|'scan'|scan"):
        parse_card(DatasetCard, data | {"scan": "up"}, "card.toml")


@pytest.mark.parametrize(
    ("name", "cameras"),
    [("barrel", "without a lens"), ("late", "that both read rows from the top at the same time")],
)
def test_channels_that_cameras_cannot_have_are_refused_by_name(name: str, cameras: str) -> None:
    with pytest.raises(ValueError, match=f"'disparity' needs cameras {cameras}"):
        replace(_card(name), channels=("disparity",))


def test_all_four_cameras_have_times_of_their_own(made: dict[str, Path]) -> None:
    sequence = read_sequence(made["columns"] / "room-twist")
    for side, frame in product(SIDES, FRAMES):
        tau, _ = sequence.poses(side, frame)
        expected = frame + 0.8 * np.arange(128) / 128
        np.testing.assert_allclose(tau, expected if side == "left" else expected[::-1], atol=1e-15)
    # From the bottom, and the right camera a tenth of a period late: 100 ms a frame, 96 rows in 80 ms.
    late = read_sequence(made["late"] / "room-twist").row_times_ns("right", 1)
    assert (late[95, 1], late[0, 1]) == (110_000_000, 110_000_000 + round(95 * 80e6 / 96))
