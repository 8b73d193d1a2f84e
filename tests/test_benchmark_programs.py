"""Programs in benchmarks/: how they count errors, their intervals and tables, and their committed results."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pandas as pd
import programs
import pytest
from programs import ROOT

from rsbench.benchmark.leaderboard.track import PUBLIC_SEED
from rsbench.core import so3
from rsbench.solvers.engine.base import load_solver_entry


@pytest.fixture(scope="module")
def lines() -> ModuleType:
    return programs.program("benchmarks/line_triplets.py")


SWEEP_FOLDER = ROOT / "results/trajectory"


@pytest.fixture
def sweep(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))  # whose programs find each other in their folder
    return importlib.import_module("trajectory_sweep")


def test_points_are_seen_where_their_rows_are_read(sweep: ModuleType) -> None:
    """Each pixel is the pinhole image from the pose at its own row's time, whatever order found it."""
    rng, setting = np.random.default_rng(0), sweep.Setting()
    law, ratio = sweep.hand(setting, rng), 0.015 * 30.0
    points = rng.uniform([-2.0, -1.5, 4.0], [2.0, 1.5, 9.0], (50, 3))
    for frame, side, shift in ((0, 0, 0.1), (1, 1, -0.1)):
        pixels = sweep.seen(law, setting.shutter, points, frame, side)
        for point, (x, y) in zip(points, pixels, strict=True):
            R, t = (each[0] for each in law.body(np.array([frame + ratio * y / 480.0])))
            X = R @ point + t + [shift, 0.0, 0.0]
            np.testing.assert_allclose([x, y], 520.0 * X[:2] / X[2] + [319.5, 239.5], atol=1e-6)


def test_the_truth_errs_by_nothing_and_a_still_rig_by_the_motion(sweep: ModuleType) -> None:
    from rsbench.benchmark.trajectory_scores import along
    from rsbench.components.motion_models import LinearMotion

    setting = sweep.Setting(shake=0.0)
    law = sweep.hand(setting, np.random.default_rng(1))
    still = along(LinearMotion(np.zeros(3), np.zeros(3)), setting.length - 1)
    turned, shifted = sweep.error(law, setting, still)
    # Rows go on evenly from the first: the root mean square of k / 20 of the readout, k from 0 to 19.
    part = 0.45 * np.sqrt(np.mean((np.arange(20) / 20.0) ** 2))
    assert turned == pytest.approx(part * 1.0, rel=1e-9)
    assert shifted == pytest.approx(part * 50.0, rel=1e-9)


def test_committed_rows_say_what_the_page_concludes() -> None:
    rows = pd.read_csv(SWEEP_FOLDER / "rows.csv").set_index(["sweep", "entry", "value"])
    ours = rows.xs("rs-trajectory", level="entry")
    for windows in ("windows-auto", "windows-linear"):
        beside = rows.xs(windows, level="entry")
        clear = ours.rotation_deg_high < beside.rotation_deg_low
        shaken = [key for key in clear.index if key[0] != "shake of two frames" and key[1] != 0.0]
        assert all(clear[key] for key in shaken if key != ("rate", 7.5))
        assert not clear["shake of two frames", 0.0] and not clear["rate", 7.5]
    assert not np.any(rows.failed)


TUNING_FOLDER = ROOT / "results/tuning"


@pytest.fixture(scope="module")
def tuning() -> ModuleType:
    return programs.program("benchmarks/tune_solvers.py")


def test_what_is_committed_is_of_a_seed_of_its_own_and_the_cards_stand(tuning: ModuleType) -> None:
    assert tuning.SEED != PUBLIC_SEED
    table = pd.read_csv(TUNING_FOLDER / "tuning.csv", keep_default_na=False)
    assert set(table["solver"]) == set(tuning.CARDS)
    for name, rows in table.groupby("solver"):
        entry = load_solver_entry(str(name))
        settings = list(tuning.settings_of(entry.solver, entry.options.robust == "own"))
        assert list(rows["option"]) == [each.option for each in settings]
        assert list(rows["value"].astype(str)) == [each.value for each in settings]
        assert list(rows["option"][rows["best"]]) == ["card"], f"{name}: its card does not have what is best"


GYRO_FOLDER = ROOT / "results/gyro"


@pytest.fixture(scope="module")
def crossing() -> ModuleType:
    return programs.program("benchmarks/gyro_crossing.py")


VALUES = np.array([0.0, 1.0, 3.0, 10.0])


def test_errors_that_add_in_squares_cross_where_they_do(crossing: ModuleType) -> None:
    a, b = 0.2, 0.5
    gyro = np.sqrt(a**2 + (b * VALUES) ** 2)
    for vision in (0.21, 0.6, 1.7, 5.0):
        found = float(crossing.crossing(VALUES, gyro, np.full(4, vision)))
        assert found == pytest.approx(np.sqrt(vision**2 - a**2) / b, rel=1e-12)
    assert crossing.crossing(VALUES, gyro, np.full(4, 0.1)) == 0.0
    assert crossing.crossing(VALUES, gyro, np.full(4, 6.0)) == np.inf


def test_committed_crossings_are_those_of_the_committed_medians(crossing: ModuleType) -> None:
    medians = pd.read_csv(GYRO_FOLDER / "medians.csv")
    crossings = pd.read_csv(GYRO_FOLDER / "crossings.csv")
    assert set(crossings["sweep"]) == set(crossing.SWEEPS)
    for row in crossings.to_dict("records"):
        here = medians[(medians["sweep"] == row["sweep"]) & (medians["variant"] == row["variant"])]
        here = here[here["measure"] == row["measure"]]
        gyro, vision = (here[here["solver"] == row[kind]] for kind in ("gyro", "vision"))
        curves = [each["median"].to_numpy(float) for each in (gyro, vision)]
        found = float(crossing.crossing(gyro["value"].to_numpy(float), *curves))
        # Tables have six digits; where curves run along each other that moves a crossing by more.
        assert found == pytest.approx(row["crossing"], rel=1e-3)
        assert row["low"] <= row["crossing"] <= row["high"]


def test_the_document_has_the_committed_crossings(crossing: ModuleType) -> None:
    text = (ROOT / "docs/explanation/monocular.md").read_text("utf-8")
    rows = crossing.shown(pd.read_csv(GYRO_FOLDER / "crossings.csv"))
    assert len(rows) == 8 and [row for row in rows if row not in text] == []


def test_the_rotation_of_a_biased_gyroscope_errs_by_its_bias() -> None:
    medians = pd.read_csv(GYRO_FOLDER / "medians.csv")
    of_bias = medians[(medians["sweep"] == "gyro-bias") & (medians["measure"] == "e_R_deg")]
    rows = of_bias[of_bias["solver"] == "rs-gyro-stereo"]
    # deg/s over 30 frames/s; a rotation of 2 deg turns the bias on the way, by at most its sine, 0.035.
    np.testing.assert_allclose(rows["median"], rows["value"] / 30.0, rtol=1e-3, atol=1e-9)


F, BASELINE, DEPTH, STEP = 200.0, 0.5, 10.0, 6


@pytest.fixture(scope="module")
def kitti() -> ModuleType:
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


def test_a_known_motion_scores_well(kitti: ModuleType, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Whole pixels of motion: SIFT's keypoints repeat to 0.05 px, which is 0.01 deg and 1 % of 6 px."""
    assert kitti.main([str(folder)]) == 0
    lines = capsys.readouterr().out.splitlines()
    rotation, direction, length = map(float, re.findall(r"[-+]?\d+\.\d+", lines[-3]))
    assert rotation < 0.05 and direction < 1.0 and abs(length) < 1.0
    off, path, share = map(float, re.findall(r"\d+\.?\d*", lines[-2]))
    assert off < 0.02 and path == 1.0 and share < 2.0  # 0.6 m, rounded
    assert lines[-1] == "0 of 2 windows refused"


def test_the_drift_is_the_distance_at_the_end(kitti: ModuleType) -> None:
    """A quarter turn on the spot, then a metre ahead: to the right of the first frame, or to the left."""
    turn = so3.exp(np.array([0.0, np.pi / 2, 0.0]))
    ahead = (np.eye(3), np.array([0.0, 0.0, -1.0]))  # the world comes nearer
    right, left = ([(each, np.zeros(3)), ahead] for each in (turn.T, turn))
    np.testing.assert_allclose(kitti.end_of(right), (1.0, 0.0, 0.0), atol=1e-12)
    assert kitti.drift(list(zip(left, right, strict=True))) == "drift 2.00 m over 1 m, 200.0%"


def test_a_wrong_focal_length_leaves_the_baseline(kitti: ModuleType, folder: Path) -> None:
    rig = kitti.read_rig(folder, folder / "image_0" / "000000.png", 1.1)
    np.testing.assert_allclose([rig.camera.fx, rig.camera.fy, rig.baseline], [1.1 * F, 1.1 * F, BASELINE])


@pytest.mark.parametrize("name", ["calib.txt", "poses.txt"])
def test_what_is_missing_is_named(
    kitti: ModuleType, folder: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / name).unlink()
    assert kitti.main([str(folder)]) == 2
    assert name in capsys.readouterr().err


@pytest.mark.parametrize("name", ["calib.txt", "poses.txt"])
@pytest.mark.parametrize("damage", ["nan", "one", ""])
def test_damaged_numbers_are_one_line(
    kitti: ModuleType, folder: Path, name: str, damage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = folder / name
    path.write_text(path.read_text().replace(" 0 ", f" {damage} ", 1))
    assert kitti.main([str(folder)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{name}: every line must hold twelve numbers" in line


def test_of_copies_of_a_public_pair_the_one_with_most_truths_counts(tmp_path: Path) -> None:
    """Whatever the names of the folders; a copy with one image as both truths does not count."""
    both = {"gs_0_m.png": b"first", "gs_1_m.png": b"second"}
    copies = {"a": {"gs_1.png": b"second"}, "b": both, "c": dict.fromkeys(both, b"second")}
    for name, truths in copies.items():
        folder = tmp_path / name / "demo/Carla/seq_01"
        folder.mkdir(parents=True)
        for file, content in ({"rs_0.png": b"0", "rs_1.png": b"1"} | truths).items():
            (folder / file).write_bytes(content)
    public = programs.program("benchmarks/public_frames.py")
    assert [pair for _, pair in public.pairs_in(tmp_path)] == [tmp_path / "b/demo/Carla/seq_01"]
