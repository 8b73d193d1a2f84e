"""Frames of one camera with their truth, in the layouts of Fastec-RS and Carla-RS: read, read back, and scored.

Truth: a camera that pans over a picture, each row and each global shutter drawn from where it looks at its time.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest
from carla_frames import write_carla, write_image
from commands import run_here
from exported_data import HEIGHT, dataset, exported, only
from numpy.typing import NDArray

from rsbench.benchmark.recorded_corrections import correction_scores, pairs_with_truth
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES
from rsbench.interop.readers.check import file_faults
from rsbench.interop.readers.layouts import read_carla, read_fastec
from rsbench.vision.corrector import load_corrector

WIDE, HIGH, PX = 160, 120, 9.0
"""Size of the panning camera's frames, and how far the picture moves in a frame period."""


def panned(times: NDArray[Any]) -> NDArray[np.uint8]:
    """What rows (h,) that are read at these times show, frame periods."""
    blots = cv2.GaussianBlur(np.random.default_rng(5).uniform(size=(HIGH, 240)), (0, 0), 2.0)
    blots = (255 * (blots - blots.min()) / np.ptp(blots)).astype(np.float32)
    x, y = np.meshgrid(np.arange(WIDE), np.arange(HIGH))
    where = (x + 20.0 + PX * times[:, None]).astype(np.float32)
    drawn = cv2.remap(blots, where, y.astype(np.float32), cv2.INTER_CUBIC)
    return np.asarray(np.clip(np.rint(drawn), 0, 255), dtype=np.uint8)


def write_fastec(root: Path, frames: int = 3) -> Path:
    rows = np.arange(HIGH) / HIGH
    for frame in range(frames):
        for name, times in (
            ("rolling", frame + rows),
            ("global_first", np.full(HIGH, float(frame))),
            ("global_middle", np.full(HIGH, frame + 0.5)),
        ):
            write_image(root / "drive" / f"{frame:03d}_{name}.png", panned(times))
    return root


def test_fastec_is_scored_against_its_truth(tmp_path: Path) -> None:
    folder = write_fastec(tmp_path / "data")
    run = run_here("evaluate", folder, "--from", "fastec-rs", "--out", tmp_path / "out")
    assert run.returncode == 0, run.stderr
    assert "a focal length of 160 px, the width, and a readout ratio of 1 are assumed" in run.stdout + run.stderr
    table = pd.read_csv(tmp_path / "out" / "scores" / "correction.csv")
    # Every frame but the first, at the first and the middle row, by three methods.
    assert len(table) == 2 * 2 * 3
    assert table["success"].all()
    scores = table.set_index(["frame", "row", "method"])["psnr"]
    for frame in (1, 2):
        for row in (0, 60):
            rolling, truth = (
                panned(times).astype(np.float64)
                for times in (frame + np.arange(HIGH) / HIGH, np.full(HIGH, frame + row / HIGH))
            )
            expected = 10.0 * np.log10(255.0**2 / np.mean((rolling - truth) ** 2))
            assert scores[frame, row, "uncorrected"] == pytest.approx(expected, abs=1e-4)  # six digits in the file
            # A pan of 9 px leaves at most 4.5 px of a column that no frame shows: 10 dB are left far above noise.
            assert min(scores[frame, row, name] for name in ("flow-scaled", "mono-fusion")) > expected + 5.0


def test_what_is_exported_to_fastec_and_carla_reads_back(tmp_path: Path) -> None:
    data = dataset(tmp_path / "data", frames=3)
    sequence = only(data)
    for name, read, ends in (
        ("fastec-rs", read_fastec, {side: f"planes_{side}" for side in SIDES}),
        ("carla-rs", read_carla, {side: f"seq_{side}" for side in SIDES}),
    ):
        out, _ = exported(data, name, tmp_path / name)
        recordings = {each.name: each for each in read(out)}
        for side in SIDES:
            found = recordings[ends[side]]
            assert set(found.images) == {("left", frame) for frame in range(3)}
            assert set(found.truths) == {("left", frame, row) for frame in range(3) for row in (0, HEIGHT // 2)}
            for frame in range(3):
                twin = data / "planes" / "gs_twin" / f"{HEIGHT // 2:04d}" / f"{side}_{frame}.png"
                assert found.truths["left", frame, HEIGHT // 2].read_bytes() == twin.read_bytes()
                shown = cv2.imread(str(found.truths["left", frame, 0]))[..., ::-1]
                np.testing.assert_array_equal(shown, sequence.image("gs", side, frame))


def test_the_mask_of_carla_weighs_pixels(tmp_path: Path) -> None:
    """Only its lower half counts there, and of that the right half half as much: PSNR written out."""
    (seq,) = [path.parent for path in write_carla(tmp_path).rglob("gt_vel.log")]
    frame = cv2.imread(str(seq / "0001_rs.png"), cv2.IMREAD_GRAYSCALE)
    truth = np.clip(frame.astype(int) + np.random.default_rng(0).integers(-20, 20, frame.shape), 0, 255)
    weights = np.zeros(frame.shape, dtype=np.uint8)
    weights[frame.shape[0] // 2 :] = 200
    weights[:, frame.shape[1] // 2 :] //= 2
    write_image(seq / "0001_gs_m.png", truth.astype(np.uint8))
    write_image(seq / "0001_mask.png", weights)
    (row,) = correction_scores(pairs_with_truth(read_carla(tmp_path)), []).to_dict("records")
    squares, weights = ((frame.astype(np.float64) - truth) / 255.0) ** 2, weights.astype(np.float64)
    expected = -20.0 * np.log10(np.sqrt(np.sum(squares * weights) / np.sum(weights)))
    assert row["psnr_mask"] == pytest.approx(expected, abs=1e-9)
    assert row["psnr"] == pytest.approx(-10.0 * np.log10(np.mean(squares)), abs=1e-9)
    write_image(seq / "0001_mask.png", weights[1:])
    with pytest.raises(RsbenchError, match=r"0001_mask.png: is 160 x 119 pixels, its frame 160 x 120"):
        correction_scores(pairs_with_truth(read_carla(tmp_path)), [])


def test_what_is_equal_scores_100_as_published(tmp_path: Path) -> None:
    folder = write_fastec(tmp_path, frames=2)
    for name in ("global_first", "global_middle"):
        (folder / "drive" / f"001_{name}.png").write_bytes((folder / "drive" / "001_rolling.png").read_bytes())
    table = correction_scores(pairs_with_truth(read_fastec(folder)), [])
    assert list(table["psnr"]) == [100.0, 100.0]


def test_a_frame_that_is_not_corrected_counts_as_it_was_read(tmp_path: Path) -> None:
    for frame in range(2):
        for name in ("rolling", "global_middle"):
            write_image(tmp_path / f"{frame:03d}_{name}.png", panned(np.zeros(HIGH)))
    table = correction_scores(pairs_with_truth(read_fastec(tmp_path)), [load_corrector("mono-fusion")])
    assert list(table["success"]) == [True, False]
    assert "still camera" in table["reason"][1]
    assert table["psnr"][1] == 100.0


def test_bad_recordings_are_refused_in_one_line(tmp_path: Path) -> None:
    folder = write_fastec(tmp_path / "data")
    run = run_here("evaluate", folder, "--from", "fastec-rs", "--out", tmp_path / "a", "--corrector", "zhuang")
    assert run.returncode == 2
    assert "--corrector zhuang: needs matches, the other camera" in run.stderr
    write_image(folder / "drive" / "001_global_middle.png", panned(np.zeros(HIGH))[:-1])
    (recording,) = read_fastec(folder)
    assert [str(fault) for fault in file_faults(recording)] == [
        f"{folder / 'drive' / '001_global_middle.png'}: is 160 x 119 pixels, its camera 160 x 120"
    ]
    run = run_here("evaluate", folder, "--from", "fastec-rs", "--out", tmp_path / "b")
    assert run.returncode == 2
    assert "001_global_middle.png: is 160 x 119" in run.stderr
