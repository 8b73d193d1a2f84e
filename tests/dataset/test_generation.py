"""Generated data: consistent, the same bytes however they were made, and never half-written."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from attack.planting import rehash
from commands import bytes_below, refused
from small_scenes import write_box_scene, write_small_card

from rsbench.core.errors import RsbenchError
from rsbench.dataset.card import CameraCard, DatasetCard, MotionCard, load_dataset_card
from rsbench.dataset.generation import estimate_dataset, generate_dataset, steps_of
from rsbench.dataset.sequence import read_dataset
from rsbench.renderers.image import Sensor
from rsbench.storage.files import read_png, write_png
from rsbench.storage.work_folder import HIDDEN
from rsbench.verification import verify_dataset


@dataclass(frozen=True)
class Small:
    """A dataset of two small scenes, "a" and "b", and the card that made it."""

    card: Path
    dataset: Path


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Small:
    folder = tmp_path_factory.mktemp("small")
    card = write_small_card(folder, [write_box_scene(folder, "a"), write_box_scene(folder, "b", (50, 70))])
    generate_dataset(load_dataset_card(str(card)), folder / "dataset")
    return Small(card, folder / "dataset")


def test_manifest_states_the_paper_conventions(smoke_dataset: Path) -> None:
    sequences = {sequence.name: sequence for sequence in read_dataset(smoke_dataset)}
    castle = sequences["castle"]
    assert castle.manifest["row_time_s"] == pytest.approx(0.8 * 0.1 / 96, rel=1e-15)
    assert np.rad2deg(np.linalg.norm(castle.motion.w)) == pytest.approx(1.5, rel=1e-12)
    assert np.linalg.norm(castle.motion.d) == pytest.approx(0.2, rel=1e-12)
    assert sequences["room-twist"].motion.name == "twist"


def test_same_card_gives_the_same_bytes_whatever_the_workers(small: Small, tmp_path: Path) -> None:
    generate_dataset(load_dataset_card(str(small.card)), tmp_path / "again", workers=2)
    assert bytes_below(tmp_path / "again", HIDDEN) == bytes_below(small.dataset, HIDDEN)


def child(card: Path, out: Path, progress: str) -> list[str]:
    """A command that generates a dataset, and runs ``progress`` after each step of the sequence ``name``."""
    code = (
        "import sys, time; from pathlib import Path\n"
        "from rsbench.dataset.card import load_dataset_card\n"
        "from rsbench.dataset.generation import generate_dataset\n"
        f"def step(name): {progress}\n"
        "generate_dataset(load_dataset_card(sys.argv[1]), Path(sys.argv[2]), progress=step)"
    )
    return [sys.executable, "-c", code, str(card), str(out)]


def test_damaged_sequence_is_rendered_again_and_sound_ones_are_kept(small: Small, tmp_path: Path) -> None:
    card, out = load_dataset_card(str(small.card)), tmp_path / "copy"
    shutil.copytree(small.dataset, out)
    assert generate_dataset(card, out) == []
    (out / "b/rs/left_0.png").write_bytes(b"damaged")
    assert generate_dataset(card, out) == ["b"]
    assert bytes_below(out, HIDDEN) == bytes_below(small.dataset, HIDDEN)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_scenes(tmp_path: Path) -> None:
    """Resident memory while each of four scenes is rendered, with textures of equal count but other shapes."""
    if not Path("/proc/self/statm").exists():
        pytest.skip("reads the memory of a process from /proc")
    scenes = [write_box_scene(tmp_path, name, (1536 + 64 * k, 2048 - 64 * k)) for k, name in enumerate("abcd")]
    card = write_small_card(tmp_path, scenes)
    command = child(card, tmp_path / "out", "print(name, int(open('/proc/self/statm').read().split()[1]) / 256)")
    # The C library keeps freed blocks of some MB for itself unless told to map each one anew.
    environ = {**os.environ, "MALLOC_MMAP_THRESHOLD_": "1000000"}
    done = subprocess.run(command, env=environ, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    peaks: dict[str, float] = {}
    for name, size in (line.split() for line in done.stdout.splitlines()):
        peaks[name] = max(peaks.get(name, 0.0), float(size))
    # A scene that stays is 48 MB in Mitsuba and 9 MB as an array; the first one lacks what compiles later.
    assert max(peaks[name] for name in "cd") - peaks["b"] < 9


def test_progress_counts_every_step_of_a_finished_dataset(small: Small, tmp_path: Path) -> None:
    card, out = load_dataset_card(str(small.card)), tmp_path / "out"
    for _ in ("rendered", "found"):
        steps: list[str] = []
        generate_dataset(card, out, progress=steps.append)
        assert steps == ["a"] * steps_of(card) + ["b"] * steps_of(card)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('scene = "PLACE/a.toml"', 'scene = "castel"', "castel"),
        ('name = "a"', 'name = "a"\nviewpoint = "moon"', "no viewpoint 'moon'"),
        ("baseline = 0.3", "baseline = -0.3", "baseline = -0.3: must be a positive"),
        ("baseline = 0.3", "baselines = 0.3", "unknown key 'baselines'"),
        ("readout_ratio = 0.8", "readout_ratio = nan", "readout_ratio"),
        ("rotation_deg = 1.5", "rotation_deg = -1.5", "must not be negative"),
        ('name = "b"', 'name = "a"', "two sequences are named 'a'"),
        ('name = "a"', 'name = "../a"', "a folder's name"),
        ('renderer = "preview"', 'renderer = "previeww"', "previeww"),
    ],
)
def test_bad_card_is_one_line_and_leaves_nothing(
    small: Small, tmp_path: Path, old: str, new: str, message: str
) -> None:
    text, old = small.card.read_text(), old.replace("PLACE", str(small.card.parent))
    assert old in text
    card = tmp_path / "card.toml"
    card.write_text(text.replace(old, new, 1))
    with refused(message):
        generate_dataset(load_dataset_card(str(card)), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_only_names_the_sequences_that_exist() -> None:
    card = load_dataset_card("smoke")
    assert isinstance(card, DatasetCard)
    with pytest.raises(RsbenchError, match="no sequence 'x'; there are: castle, room-twist"):
        card.only(["x"])


def test_shards_are_all_of_a_card_and_share_nothing() -> None:
    card = load_dataset_card("poles")
    for parts in (1, 3, len(card.sequence)):
        names = [sequence.name for part in range(parts) for sequence in card.shard(part + 1, parts).sequence]
        assert sorted(names) == sorted(sequence.name for sequence in card.sequence)
    for part, parts in ((0, 2), (3, 2), (len(card.sequence) + 1, 100)):
        with pytest.raises(RsbenchError, match=f"shard {part}/{parts}: "):
            card.shard(part, parts)


def test_shards_brought_together_are_the_dataset(small: Small, tmp_path: Path) -> None:
    card = load_dataset_card(str(small.card))
    for part in (1, 2):
        (made,) = generate_dataset(card.shard(part, 2), tmp_path / str(part))
        shutil.copytree(tmp_path / str(part) / made, tmp_path / "both" / made)
    assert generate_dataset(card, tmp_path / "both") == []
    assert bytes_below(tmp_path / "both", HIDDEN) == bytes_below(small.dataset, HIDDEN)


def test_the_estimate_counts_files_and_bytes(small: Small) -> None:
    words: list[str] = []
    found = estimate_dataset(load_dataset_card(str(small.card)), words.append)
    made = bytes_below(small.dataset, HIDDEN).values()
    assert len(words) == 2 and (found.sequences, found.files) == (2, len(made))
    # One camera at one time stands for four.
    assert found.bytes == pytest.approx(sum(map(len, made)), rel=0.1)
    assert 0.0 < found.seconds < 60.0


def test_every_sensor_of_a_scene_is_tried_for_an_estimate(small: Small) -> None:
    """Files have the same bytes in each run, so that an estimate for two sensors is the sum of two estimates."""
    card = load_dataset_card(str(small.card)).only(["a"])
    (ideal,), noise = card.sequence, Sensor(photon_noise=True, full_well=6000)
    noisy = replace(ideal, name="noisy", sensor=noise)
    one, other, both = (
        estimate_dataset(replace(card, sequence=sequences), lambda scene: None)
        for sequences in ((ideal,), (noisy,), (ideal, noisy))
    )
    # dataset.json and croissant.json, which list each file in 200 bytes, are there once.
    assert (both.sequences, both.files) == (2, one.files + other.files - 2)
    assert both.bytes == one.bytes + other.bytes - 2 * 200 and other.bytes > 1.1 * one.bytes


def test_a_frame_without_any_surface_is_an_error(tmp_path: Path) -> None:
    """A card's viewpoint that looks away from its mesh, or from inside out of it."""
    scene = write_box_scene(tmp_path, "away")
    scene.write_text(
        scene.read_text().replace("[0.0, -3.0, 0.2]", "[0.0, -30.0, 0.2]").replace("3.0, 0.0]", "-60.0, 0.0]")
    )
    card = load_dataset_card(str(write_small_card(tmp_path, [scene])))
    with pytest.raises(RsbenchError, match="sequence away: left_0 shows no surface at all"):
        generate_dataset(card, tmp_path / "out")
    assert not (tmp_path / "out" / "away").exists()


def test_a_camera_through_a_wall_is_refused(small: Small, tmp_path: Path) -> None:
    """The rig stands 8 m before the end of a box that is 6 m wide, and looks there, a little askew."""
    card = load_dataset_card(str(small.card)).only(["a"])
    along = MotionCard(rotation_deg=0.0, rotation_axis=(0, 0, 1), translation=16.0, translation_axis=(0, 0, -1))
    fast = replace(card, motion=along)
    with pytest.raises(
        RsbenchError, match=r"^sequence a: the left camera goes through a surface at time "
    ) as told:
        generate_dataset(fast, tmp_path / "out")
    found = re.search(r"at time ([0-9.]+); choose another motion", str(told.value))
    # The left camera is 0.15 m nearer to the wall times the sine of the view; steps are 1.8 / 128 long.
    at = 8.0 * float(np.linalg.norm([0.3, 6.0, -0.2])) / 6.0 / 16.0
    assert found is not None and -0.001 < at - float(found[1]) < 1.8 / 128 + 0.001
    for baseline, blocked in ((5.8, False), (6.2, True)):
        wide = replace(card, baseline=baseline, motion=replace(along, translation=0.0))
        with nullcontext() if not blocked else pytest.raises(RsbenchError, match="surface between the middle"):
            generate_dataset(wide, tmp_path / f"{baseline}")
    assert not (tmp_path / "out/a").exists()


def test_dataset_manifest_lists_every_file(smoke_dataset: Path) -> None:
    manifest = json.loads((smoke_dataset / "dataset.json").read_text())
    assert set(manifest["files"]) == set(bytes_below(smoke_dataset, HIDDEN)) - {"dataset.json", "croissant.json"}


@pytest.mark.slow
def test_full_frames_keep_the_stack_that_the_frame_is_stitched_from(small: Small, tmp_path: Path) -> None:
    card = load_dataset_card(str(small.card)).only(["a"])
    tiny = replace(card, camera=CameraCard(width=20, height=12, focal=17.0))
    generate_dataset(tiny, tmp_path / "stack", full_frames=True)
    generate_dataset(tiny, tmp_path / "single")
    (stacked,), (single,) = read_dataset(tmp_path / "stack"), read_dataset(tmp_path / "single")
    frame = stacked.image("rs", "right", 1)
    np.testing.assert_array_equal(frame, single.image("rs", "right", 1))
    assert np.std(frame) > 5, "a frame of one colour proves nothing"
    for row in range(12):
        whole = read_png(stacked.folder / f"gs_stack/right_1/{row:04d}.png")
        np.testing.assert_array_equal(whole[row], frame[row])
    scenes = [small.card.parent / "a.toml"]
    (report,) = verify_dataset(tmp_path / "stack", rerender="all", scenes=scenes)
    assert report.faults == () and report.notes[0].endswith("the same bits")
    lost = stacked.folder / "gs_stack/left_0/0003.png"
    lost.unlink()
    for file, first, last in (("right_0/0005.png", 5, 5), ("right_1/0000.png", 7, 7), ("left_1/0002.png", 3, 11)):
        image = read_png(stacked.folder / "gs_stack" / file)
        image[first : last + 1] = 255 - image[first : last + 1]
        write_png(stacked.folder / "gs_stack" / file, image)
    rehash(tmp_path / "stack")
    (report,) = verify_dataset(tmp_path / "stack", rerender="all", scenes=scenes)
    for words in (
        "a/sequence.json: files does not list gs_stack/left_0/0003.png",
        "gs_stack/right_0: row 5: 1 images differ in their own row from rs/right_0.png",
        "gs_stack/right_1/0000.png: differs from gs/right_1.png",
        "gs_stack/left_1: row 9: the image differs from a new rendering",
    ):
        assert any(fault.startswith(words) for fault in report.faults), (words, report.faults)


def test_changed_scene_is_not_taken_for_the_old_one(tmp_path: Path) -> None:
    """In one process: what a run holds of a scene goes with it."""
    scene = write_box_scene(tmp_path, "a")
    card = load_dataset_card(str(write_small_card(tmp_path, [scene])))
    generate_dataset(card, tmp_path / "out")
    write_box_scene(tmp_path, "a", texture=(32, 32))
    with pytest.raises(RsbenchError, match=r"another card \(differs in scene"):
        generate_dataset(card, tmp_path / "out")
