"""Verification against a dataset whose depth is known in closed form, sound and spoilt in every way."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic_dataset import write_analytic_dataset
from attack.planting import rehash
from commands import refused

from rsbench.components.motion_models import LinearMotion, TwistMotion
from rsbench.core import so3
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.dataset.sequence import read_dataset
from rsbench.storage.files import read_depth, read_poses, write_depth
from rsbench.verification import SequenceReport, verification_steps, verify_dataset

RIG = StereoRig(camera=PinholeCamera.centred(96, 80, 110.0), baseline=0.3)
SHUTTER = RollingShutter(height=80, readout_ratio=0.9)
MOTION = LinearMotion([0.02, -0.03, 0.01], [0.1, -0.05, 0.2])


def verify(folder: Path) -> SequenceReport:
    return verify_dataset(folder)[-1]


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    write_analytic_dataset(tmp_path, RIG, SHUTTER, MOTION)
    return tmp_path


@pytest.mark.parametrize(
    "wrong",
    [
        LinearMotion([0.0, 0.0, 0.0], MOTION.d),
        LinearMotion(-MOTION.w, MOTION.d),
        LinearMotion(MOTION.w, -MOTION.d),
        LinearMotion(MOTION.w, 1.01 * MOTION.d),
    ],
    ids=["no rotation", "rotation of the other sign", "translation of the other sign", "1 % of scale"],
)
def test_depth_of_another_motion_is_found(tmp_path: Path, wrong: Motion) -> None:
    write_analytic_dataset(tmp_path, RIG, SHUTTER, MOTION, true_motion=wrong)
    faults = verify(tmp_path).faults
    assert any("pairs of depth maps disagree" in fault and "motion" in fault for fault in faults)


def rig_of(w: tuple[float, float, float], right: PinholeCamera) -> StereoRig:
    """A left camera with a lens, and a right one that is turned by w."""
    lens = Lens(model="brown-conrady", k1=-0.2, k2=0.03, p1=0.002)
    left = PinholeCamera(width=96, height=80, fx=100.0, fy=101.0, cx=46.0, cy=41.0, lens=lens)
    return StereoRig.of_cameras(left, right, so3.exp(np.array(w)), (-0.3, 0.02, -0.03))


TURN = (0.03, -0.06, 0.05)
WIDE = PinholeCamera(
    width=112, height=72, fx=110.0, fy=109.0, cx=57.0, cy=33.0, lens=Lens(model="kannala-brandt", k1=-0.04)
)
TWO = rig_of(TURN, WIDE)
SCANS = {
    "rows": Scanning(),
    "own ratio": Scanning(right_readout_ratio=0.4),
    "global right": Scanning(right_readout_ratio=0.0),
    "late columns": Scanning(right_scan="right", right_delay=0.15),
}


@pytest.mark.parametrize(
    ("rig", "scanning", "motion"),
    [
        (RIG, Scanning(), MOTION),
        (RIG, Scanning(), TwistMotion([0.05, 0.02, -0.04], [0.2, 0.1, 0.1])),
        *((TWO, scanning, MOTION) for scanning in SCANS.values()),
    ],
    ids=["linear", "twist", *SCANS],
)
def test_a_sound_dataset_has_no_faults(tmp_path: Path, rig: StereoRig, scanning: Scanning, motion: Motion) -> None:
    write_analytic_dataset(tmp_path, rig, rig.shutter_of(scanning, 0.9), motion)
    report = verify(tmp_path)
    assert report.name == "planes" and report.faults == ()
    assert len(report.agreements) == 24
    for agreement in report.agreements:
        # float32 depth holds 6e-8 relative; bilinear interpolation across rows adds about 1e-6.
        assert agreement.share == 1.0 and agreement.p99 < 1e-5
        assert agreement.compared > (0.5 * 96 * 80 if rig is RIG else 2000)


OWN = SCANS["own ratio"]


@pytest.mark.parametrize(
    ("rig", "scanning", "words"),
    [
        (rig_of((-0.03, 0.06, -0.05), WIDE), OWN, "right_from_left"),
        (rig_of((0.03, -0.0595, 0.05), WIDE), OWN, "right_from_left"),
        (rig_of(TURN, replace(WIDE, fx=TWO.sensor("left").fx)), OWN, "right_from_left"),
        (rig_of(TURN, replace(WIDE, lens=TWO.sensor("left").lens)), OWN, "right_from_left"),
        (TWO, Scanning(), "rs_depth/right_"),
        (TWO, Scanning(right_readout_ratio=0.0), "rs_depth/right_"),
    ],
    ids=["rotation inverted", "half a milliradian", "focal length", "lens", "rows at the left's times", "global"],
)
def test_cameras_of_another_rig_are_found(tmp_path: Path, rig: StereoRig, scanning: Scanning, words: str) -> None:
    """Every file states the other rig; depth and images are of the true one."""
    true = TWO, TWO.shutter_of(OWN, 0.9)
    write_analytic_dataset(tmp_path, rig, rig.shutter_of(scanning, 0.9), MOTION, true_cameras=true)
    assert any(words in fault for fault in verify(tmp_path).faults)


def test_depth_along_the_axes_of_the_rig_is_named(tmp_path: Path) -> None:
    write_analytic_dataset(tmp_path, TWO, TWO.shutter_of(OWN, 0.9), MOTION)
    path = tmp_path / "planes/gs_depth/right_1.exr"
    depth = read_depth(path) / TWO.own_depth("right", WIDE.pixel_grid())
    write_depth(path, depth.astype(np.float32))
    rehash(tmp_path)
    assert any("gs_depth/right_1.exr" in fault and "axes of the rig" in fault for fault in verify(tmp_path).faults)


def test_swapped_cameras_are_found(dataset: Path) -> None:
    mirrored = StereoRig(camera=RIG.camera, baseline=0.301)
    write_analytic_dataset(dataset / "other", mirrored, SHUTTER, MOTION)
    manifest = json.loads((dataset / "other/planes/sequence.json").read_text())
    manifest["baseline"] = 0.3
    (dataset / "other/planes/sequence.json").write_text(json.dumps(manifest))
    rehash(dataset / "other")
    assert verify(dataset / "other").faults


def test_changed_missing_and_unlisted_files_are_found(dataset: Path) -> None:
    changed = dataset / "planes/rs/left_0.png"
    changed.write_bytes(changed.read_bytes()[:-1])
    (dataset / "planes/gs_depth/right_1.exr").unlink()
    faults = verify(dataset).faults
    assert all("left_0.png" in fault or "right_1.exr" in fault for fault in faults)
    assert any("rs/left_0.png" in fault and "checksum" in fault for fault in faults)
    assert any("gs_depth/right_1.exr" in fault and "missing" in fault for fault in faults)


def test_row_zero_must_equal_the_global_shutter_twin(dataset: Path) -> None:
    path = dataset / "planes/gs_depth/left_0.exr"
    depth = read_depth(path)
    depth[0, 0] *= np.float32(1.001)
    write_depth(path, depth)
    rehash(dataset)
    assert any("row 0 differs" in fault for fault in verify(dataset).faults)


@pytest.mark.parametrize(("size", "found"), [(20, True), (4, True), (3, False)])
def test_a_flaw_of_a_few_hundredths_of_the_picture_is_found(dataset: Path, size: int, found: bool) -> None:
    """A square of the wall three tolerances too far, too little to be hidden: 5 % of the pixels, then 0.2 %."""
    path = dataset / "planes/rs_depth/right_1.exr"
    depth = read_depth(path)
    depth[10 : 10 + size, 30 : 30 + size] *= np.float32(1 + 3e-4)
    write_depth(path, depth)
    rehash(dataset)
    report = verify(dataset)
    assert any("rs_depth/right_1.exr: rows 10-" in fault for fault in report.faults) == found
    assert all(agreement.share > 0.9 for agreement in report.agreements)


@pytest.mark.parametrize("damage", [b"", b"not an exr", None])
def test_damaged_depth_file_is_one_clear_line(dataset: Path, damage: bytes | None) -> None:
    path = dataset / "planes/rs_depth/left_0.exr"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2] if damage is None else damage)
    with refused("left_0.exr: damaged or not an EXR file"):
        read_dataset(dataset)[0].depth("rs", "left", 0)


def test_pose_file_round_trip_is_exact_to_rounding(dataset: Path) -> None:
    tau, poses = read_poses(dataset / "planes/poses/right_1.csv")
    expected = RIG.cam_from_world(MOTION, 1 + 0.9 * np.arange(80) / 80, "right")
    np.testing.assert_array_equal(tau, SHUTTER.row_time(np.arange(80), 1))
    np.testing.assert_allclose(poses.R, expected.R, atol=1e-14)
    np.testing.assert_allclose(poses.t, expected.t, atol=0)


def test_folder_without_a_dataset_is_named(tmp_path: Path) -> None:
    with pytest.raises(RsbenchError, match="not a dataset"):
        read_dataset(tmp_path)


def test_progress_is_reported_to_the_last_step(dataset: Path) -> None:
    steps: list[str] = []
    verify_dataset(dataset, 4, steps.append)
    assert len(steps) == verification_steps({"sequences": ["planes"]})


@pytest.mark.slow
def test_two_processes_find_the_same(smoke_dataset: Path, tmp_path: Path) -> None:
    data = Path(shutil.copytree(smoke_dataset, tmp_path / "data"))
    path = data / "castle/rs_depth/left_0.exr"
    write_depth(path, read_depth(path) * np.float32(1.001))
    steps = [list[str](), list[str]()]
    one, two = (verify_dataset(data, 4, steps[k].append, workers=k + 1) for k in (0, 1))
    assert repr(one) == repr(two) and one[0].faults
    assert sorted(steps[0]) == sorted(steps[1])
