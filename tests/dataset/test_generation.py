"""Generated data: consistent, the same bytes however they were made, and never half-written."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rsbench.dataset import generation
from rsbench.dataset.card import CameraCard, DatasetCard, MotionCard, load_dataset_card
from rsbench.dataset.files import read_png, sha256
from rsbench.dataset.generation import STEPS, generate_dataset
from rsbench.dataset.sequence import read_dataset
from rsbench.dataset.verification import verify_dataset
from rsbench.errors import RsbenchError


def bytes_of(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): sha256(path) for path in sorted(folder.rglob("*")) if path.is_file()}


def test_rendered_depth_agrees_between_all_frames(smoke_dataset: Path) -> None:
    reports = verify_dataset(smoke_dataset)
    assert [report.faults for report in reports] == [(), ()]
    for report in reports:
        for agreement in report.agreements:
            assert agreement.compared > 0.1 * 96 * 128, "too little is compared to prove anything"
            assert agreement.p99 < 1e-4


def test_manifest_states_the_paper_conventions(smoke_dataset: Path) -> None:
    sequences = {sequence.name: sequence for sequence in read_dataset(smoke_dataset)}
    castle = sequences["castle"]
    assert castle.manifest["row_time_s"] == pytest.approx(0.8 * 0.1 / 96, rel=1e-15)
    assert np.rad2deg(np.linalg.norm(castle.motion.w)) == pytest.approx(1.5, rel=1e-12)
    assert np.linalg.norm(castle.motion.d) == pytest.approx(0.2, rel=1e-12)
    assert sequences["room-twist"].motion.name == "twist"


def test_same_card_gives_the_same_bytes_whatever_the_workers(smoke_dataset: Path, tmp_path: Path) -> None:
    generate_dataset(load_dataset_card("smoke"), tmp_path / "again", workers=2)
    assert bytes_of(tmp_path / "again") == bytes_of(smoke_dataset)


@pytest.mark.parametrize("seconds_after_first_file", [0.0, 0.4])
def test_killed_run_resumes_to_the_bytes_of_an_undisturbed_one(
    smoke_dataset: Path, tmp_path: Path, seconds_after_first_file: float
) -> None:
    out = tmp_path / "killed"
    command = [sys.executable, "-m", "rsbench", "generate", "smoke", "--out", str(out)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while not list(out.rglob("*.png")) and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(seconds_after_first_file)
    process.send_signal(signal.SIGKILL)
    process.wait()
    with pytest.raises(RsbenchError, match="not a dataset"):
        read_dataset(out)
    generate_dataset(load_dataset_card("smoke"), out)
    assert bytes_of(out) == bytes_of(smoke_dataset)


def test_damaged_sequence_is_rendered_again_and_sound_ones_are_kept(smoke_dataset: Path, tmp_path: Path) -> None:
    card = load_dataset_card("smoke").only(["castle"])
    generate_dataset(card, tmp_path)
    before = bytes_of(tmp_path)
    assert generate_dataset(card, tmp_path) == []
    (tmp_path / "castle/rs/left_0.png").write_bytes(b"damaged")
    assert generate_dataset(card, tmp_path) == ["castle"]
    assert bytes_of(tmp_path) == before


def test_other_card_in_the_same_folder_is_refused(smoke_dataset: Path) -> None:
    card = load_dataset_card("smoke")
    other = replace(card, readout_ratio=0.5)
    before = bytes_of(smoke_dataset)
    with pytest.raises(RsbenchError, match=r"another card \(differs in readout_ratio"):
        generate_dataset(other, smoke_dataset)
    assert bytes_of(smoke_dataset) == before


def test_progress_counts_every_step_of_a_finished_dataset(smoke_dataset: Path) -> None:
    steps: list[str] = []
    generate_dataset(load_dataset_card("smoke"), smoke_dataset, progress=steps.append)
    assert len(steps) == 2 * STEPS


def test_unwritable_folder_is_named(tmp_path: Path) -> None:
    blocker = tmp_path / "file"
    blocker.write_text("")
    with pytest.raises(RsbenchError, match="cannot be written"):
        generate_dataset(load_dataset_card("smoke"), blocker / "below")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('scene = "castle"', 'scene = "castel"', "castel"),
        ('scene = "castle"', 'scene = "castle"\nviewpoint = "moon"', "no viewpoint 'moon'"),
        ("baseline = 0.3", "baseline = -0.3", "baseline must be a positive"),
        ("baseline = 0.3", "baselines = 0.3", "unknown key 'baselines'"),
        ("readout_ratio = 0.8", "readout_ratio = nan", "readout_ratio"),
        ("rotation_deg = 1.5", "rotation_deg = -1.5", "must not be negative"),
        ('name = "room-twist"', 'name = "castle"', "two sequences are named 'castle'"),
        ('name = "castle"', 'name = "../castle"', "a folder name"),
        ('renderer = "preview"', 'renderer = "previeww"', "previeww"),
    ],
)
def test_bad_card_is_one_line_and_leaves_nothing(tmp_path: Path, old: str, new: str, message: str) -> None:
    source = Path(__file__).parents[2] / "datasets/smoke.toml"
    text = source.read_text()
    assert old in text
    card = tmp_path / "card.toml"
    card.write_text(text.replace(old, new, 1))
    with pytest.raises(RsbenchError) as caught:
        generate_dataset(load_dataset_card(str(card)), tmp_path / "out")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_motion_card_gives_exact_magnitudes() -> None:
    card = MotionCard(
        rotation_deg=0.4, rotation_axis=(0.6, 1.0, -0.5), translation=0.3, translation_axis=(1, 2, 3)
    )
    motion = card.motion()
    assert np.linalg.norm(motion.w) == pytest.approx(np.deg2rad(0.4), rel=1e-15)
    np.testing.assert_allclose(motion.d, 0.3 * np.array([1, 2, 3]) / np.sqrt(14), rtol=1e-15)


def test_only_names_the_sequences_that_exist() -> None:
    card = load_dataset_card("smoke")
    assert isinstance(card, DatasetCard)
    with pytest.raises(RsbenchError, match="no sequence 'x'; there are: castle, room-twist"):
        card.only(["x"])


def test_dataset_manifest_lists_every_file(smoke_dataset: Path) -> None:
    manifest = json.loads((smoke_dataset / "dataset.json").read_text())
    assert set(manifest["files"]) == set(bytes_of(smoke_dataset)) - {"dataset.json"}


def test_full_frames_keep_the_stack_that_the_frame_is_stitched_from(tmp_path: Path) -> None:
    small = replace(
        load_dataset_card("smoke").only(["room-twist"]), camera=CameraCard(width=20, height=12, focal=22.0)
    )
    generate_dataset(small, tmp_path / "stack", full_frames=True)
    generate_dataset(small, tmp_path / "single")
    (stacked,), (single,) = read_dataset(tmp_path / "stack"), read_dataset(tmp_path / "single")
    frame = stacked.image("rs", "right", 1)
    np.testing.assert_array_equal(frame, single.image("rs", "right", 1))
    for row in range(12):
        whole = read_png(stacked.folder / f"gs_stack/right_1/{row:04d}.png")
        np.testing.assert_array_equal(whole[row], frame[row])
    lost = stacked.folder / "gs_stack/left_0/0003.png"
    lost.unlink()
    (report,) = verify_dataset(tmp_path / "stack")
    assert any("0003.png: missing" in fault for fault in report.faults)


def test_changed_scene_is_not_taken_for_the_old_one(tmp_path: Path) -> None:
    source = Path(__file__).parents[2] / "scenes/room.toml"
    scene, dataset = tmp_path / "room.toml", tmp_path / "card.toml"
    scene.write_text(source.read_text())
    text = (Path(__file__).parents[2] / "datasets/smoke.toml").read_text()
    dataset.write_text(text.replace('scene = "room"', f'scene = "{scene}"'))
    card = load_dataset_card(str(dataset)).only(["room-twist"])
    generate_dataset(card, tmp_path / "out")
    scene.write_text(re.sub(r"^seed = \d+", "seed = 987", source.read_text(), flags=re.MULTILINE))
    # A new process would read the card anew; here the cache stands for the old one.
    generation._scene.cache_clear()
    generation._scene_digest.cache_clear()
    with pytest.raises(RsbenchError, match=r"another card \(differs in scene"):
        generate_dataset(card, tmp_path / "out")
