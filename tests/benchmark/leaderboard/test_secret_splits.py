"""Splits, their fingerprints, and secret test splits of rendered frames."""

from __future__ import annotations

import csv
import json
import re
import shutil
import struct
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import assert_refused, bytes_below, run_here
from leaderboards import leaderboard, named, scores_of, small_split, truth_lines, write

from rsbench.benchmark.leaderboard import publishing
from rsbench.benchmark.leaderboard.inputs import check_place, write_inputs
from rsbench.benchmark.leaderboard.motion_tracks import bound_text
from rsbench.benchmark.leaderboard.publishing import (
    ANNOUNCEMENT,
    DATA,
    announced_split,
    drawn_split,
    publish,
    read_announcement,
)
from rsbench.benchmark.leaderboard.splits import exact_problem, simulated_problem
from rsbench.benchmark.leaderboard.track import Split
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.core.errors import RsbenchError
from rsbench.core.projection import rs_project
from rsbench.core.rig import views_of
from rsbench.dataset.card import DatasetCard
from rsbench.dataset.manifest import write_manifest
from rsbench.dataset.secret_split import Secret, secret_card
from rsbench.dataset.views import image_seed
from rsbench.pipeline.problem import Problem, read_problems
from rsbench.storage.files import HashedFile, load_arrays, sha256, write_json, write_png


def test_problems_are_of_their_truth() -> None:
    """Without noise and outliers each track is a point: its four pixels are those that the true motion shows."""
    truth = next(t for t in TRACKS["points"].split(None).truths if t.facts["outliers"] == 0.0)
    tracks = simulated_problem(1, int(truth.name[1:])).correspondences.tracks
    assert len(tracks) == truth.facts["points"]
    noise = float(truth.facts["noise_px"])
    start = truth.rig.cam_from_world(truth.motion, truth.shutter.row_time(tracks[:, 1], 0), "left")
    depth = truth.rig.depth(tracks[:, 0] - tracks[:, 2])
    near = depth < 3.0  # where the noise of a disparity moves a point little
    in_cam = truth.rig.camera.unproject(tracks[:, :2]) * depth[:, None]
    world = (np.swapaxes(start.R, 1, 2) @ (in_cam - start.t)[:, :, None])[:, :, 0]
    seen = rs_project(truth.rig, truth.shutter, truth.motion, "left", 1, world[near]).pixels
    assert np.count_nonzero(near) > 3
    assert np.nanmedian(np.abs(seen - tracks[near, 4:6])) < 10.0 * noise


def test_secrets_make_splits_of_their_own(tmp_path: Path) -> None:
    protocol = TRACKS["points"]
    (tmp_path / "seed").write_text("a text that nobody can guess\n", "utf-8")
    secret, again = (protocol.split(None, tmp_path / "seed") for _ in range(2))
    assert secret.fingerprint == again.fingerprint != protocol.split(None).fingerprint
    assert secret.name.startswith("test-") and not secret.public
    (tmp_path / "seed").write_text("12345", "utf-8")
    with pytest.raises(RsbenchError, match="seed: holds 5 characters"):
        protocol.split(None, tmp_path / "seed")


def test_the_public_split_stays_as_it_was_announced() -> None:
    """Predictions of others are of these problems: what changes them is another protocol."""
    assert TRACKS["points"].split(None).name == "dev-f88c896f"


def test_all_inputs_are_the_same_numbers(tmp_path: Path) -> None:
    problems = [simulated_problem(1, number) for number in range(3)]
    write_inputs(small_split(3), iter(problems), tmp_path)
    read = list(read_problems(tmp_path / "problems.jsonl", sys.stdin))
    arrays = load_arrays(tmp_path / "problems.npz")
    rows = list(csv.reader((tmp_path / "tracks.csv").read_text("utf-8").splitlines()))[1:]
    lines = list(csv.DictReader((tmp_path / "problems.csv").read_text("utf-8").splitlines()))
    for k, (problem, given) in enumerate(zip(problems, read, strict=True)):
        assert isinstance(given, Problem)
        assert (given.name, given.rig, given.shutter) == (problem.name, problem.rig, problem.shutter)
        for found in (
            given.correspondences.tracks,
            arrays["tracks"][arrays["tracks_problem"] == k],
            np.array([[float(x) for x in row[1:]] for row in rows if row[0] == problem.name]),
        ):
            np.testing.assert_array_equal(found, problem.correspondences.tracks)
        assert arrays["names"][k] == lines[k]["name"] == problem.name
        assert arrays["rig"][k].tolist() == [float(x) for x in list(lines[k].values())[1:]]
    assert (tmp_path / "truth.jsonl").is_file()


def assert_tells_no_motion(folder: Path, split: Split) -> None:
    """What can be read as text has the fingerprint of a split, and no number of its motions."""
    files = [path for path in folder.rglob("*") if path.suffix in (".csv", ".json", ".jsonl")]
    told = b"".join(path.read_bytes() for path in files)
    assert len(files) >= 3 and split.fingerprint.encode() in told
    for truth in split.truths:
        assert all(repr(float(x)).encode() not in told for x in (*truth.motion.w, *truth.motion.d))


def test_a_secret_split_is_exported_without_its_truth(tmp_path: Path) -> None:
    (tmp_path / "seed").write_text("a text that nobody can guess", "utf-8")
    split = TRACKS["points"].split(None, tmp_path / "seed")
    write_inputs(split, iter([simulated_problem(3, 0)]), tmp_path / "out")
    assert not (tmp_path / "out" / "truth.jsonl").exists()
    assert_tells_no_motion(tmp_path / "out", split)


def test_motions_at_the_bound_err_as_it_says(tmp_path: Path) -> None:
    """Their squared errors over the bound's covariance are chi-squared with six degrees of freedom: mean 6."""
    split = small_split(40)
    scores = scores_of(split, map(json.loads, bound_text(split, tmp_path).splitlines()), tmp_path)
    assert scores["success"].all()
    assert abs(scores["nees"].mean() - 6.0) < 3.0 * np.sqrt(12.0 / 40)  # its variance is 12
    # The bound of tracks without the outliers: no noisy pixel is among the exact ones, and no outlier.
    exact, noise = exact_problem(1, 0)
    given = simulated_problem(1, 0).correspondences.tracks
    near = np.min(np.max(np.abs(exact.correspondences.tracks[:, None] - given[None]), axis=2), axis=1)
    good = 1.0 - float(split.truths[0].facts["outliers"])
    assert len(exact.correspondences.tracks) == round(good * len(given))
    assert np.all(near < 6.0 * noise) and np.all(near > 0.0)


def test_a_secret_dataset_is_exported_without_its_truth(smoke_dataset: Path, tmp_path: Path) -> None:
    leaderboard("export", "pose-own", "--data", smoke_dataset, "--out", tmp_path / "out", "--secret")
    split = TRACKS["pose-own"].split(smoke_dataset)
    assert_tells_no_motion(tmp_path / "out", split)


def test_inputs_are_written_beside_nothing_else(tmp_path: Path) -> None:
    """Neither over files of somebody, nor beside another split's, nor beside a truth that is secret now."""
    split = small_split(3)
    check_place(split, tmp_path / "new")
    (tmp_path / "tracks.csv").write_text("mine")
    with pytest.raises(RsbenchError, match=r"holds tracks\.csv, not the inputs of"):
        check_place(split, tmp_path)
    out = tmp_path / "out"
    write_inputs(split, iter([simulated_problem(1, number) for number in range(3)]), out)
    check_place(split, out)
    for other in (small_split(4), replace(split, public=False)):
        with pytest.raises(RsbenchError, match="choose another folder"):
            check_place(other, out)


TEXT = "f3b1 a secret that nobody guesses"
SECRET = Secret(TEXT)
TRACK = TRACKS["pose-own"]
CARD = """
name = "tiny"
baseline = 0.3
readout_ratio = 0.8
[camera]
width = 24
height = 16
focal = 20
[motion]
rotation_deg = 2
rotation_axis = "random"
translation = 0.2
translation_axis = "random"
[grid.sensor.ideal]
[grid.sensor.real]
sensor = { exposure_s = 0.01, full_well = 6000, photon_noise = true, read_noise = 2.5, bit_depth = 10 }
[[sequence]]
name = "posts"
scene = "poles"
[[sequence]]
name = "yard"
scene = "terrain"
"""


def render(card: DatasetCard, out: Path, **options: Any) -> None:
    """As ``generate_dataset``: noise of the seed in the places of pictures, and what a sequence says of itself."""
    made = {}
    for each in card.sequence:
        folder, files = out / each.name, dict[str, str]()
        (folder / "rs").mkdir(parents=True, exist_ok=True)
        for side, frame in views_of(2):
            rng = np.random.default_rng(image_seed(card.seed_of(each), each.name, side, frame))
            write_png(folder / f"rs/{side}_{frame}.png", rng.integers(0, 256, (16, 24, 3), dtype=np.uint8))
            files[f"rs/{side}_{frame}.png"] = sha256(folder / f"rs/{side}_{frame}.png")
        scene, seed = {"name": Path(each.scene).stem}, card.seed_of(each)
        said = card.manifest_of(each) | {"scene": scene, "seed": seed, "made_by": {"rsbench": "0"}, "files": files}
        write_json(folder / "sequence.json", said)
        files["sequence.json"] = sha256(folder / "sequence.json")
        made[each.name] = {n: HashedFile((folder / n).stat().st_size, 0, 0, digest) for n, digest in files.items()}
    write_manifest(card, out, made)


@pytest.fixture(autouse=True)
def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publishing, "generate_dataset", render)


@pytest.fixture
def card(tmp_path: Path) -> str:
    path = tmp_path / "tiny.toml"
    path.write_text(CARD)
    return str(path)


@pytest.fixture
def place(tmp_path: Path, card: str) -> Path:
    """Holds ``keep`` and ``out`` of a split of frames."""
    publish(TRACK, card, SECRET, tmp_path / "keep", tmp_path / "out")
    return tmp_path


def test_the_text_alone_makes_the_truth_that_was_rendered(place: Path, card: str) -> None:
    announced = read_announcement(place / "out")
    drawn = announced_split(announced, TRACK, card, SECRET, None)
    kept = announced_split(announced, TRACK, card, SECRET, place / "keep")
    assert drawn.fingerprint == kept.fingerprint == announced.fingerprint
    assert [each.facts for each in drawn.truths] == [each.facts for each in kept.truths]
    assert [each.scene for each in drawn.truths] == [each.scene for each in kept.truths]
    scores = scores_of(kept, truth_lines(drawn), place)
    assert np.all(scores["auc_1"] == 1.0) and len(scores) == 4


def test_the_public_part_is_frames_cameras_and_what_is_announced(place: Path) -> None:
    names = {re.sub(r"s\d/(left|right)_[01]", "s0/left_0", name) for name in bytes_below(place / "out")}
    assert names == {
        "frames/s0/left_0.png",
        "problems.csv",
        "problems.jsonl",
        "problems.npz",
        "split.json",
        ANNOUNCEMENT,
    }
    assert not (place / "out" / ".rsbench").exists()  # it would name the machine


def test_no_public_file_holds_a_number_or_name_of_the_truth(place: Path, card: str) -> None:
    drawn = secret_card(card, SECRET, place / "keep" / "scenes")
    hidden = {TEXT, "poles", "terrain", "posts", "yard", "ideal", "random", "rotation", str(place)}
    numbers: list[float] = []
    for each in drawn.sequence:
        assert each.motion is not None
        motion = drawn.motion_of(each)
        numbers += [*motion.w, *motion.d, each.motion.rotation_deg, each.motion.translation]  # pyrefly: ignore[bad-assignment]
        hidden |= {str(each.seed), f"{each.seed:x}"}
        hidden |= {str(image_seed(drawn.seed_of(each), each.name, *view)) for view in views_of(2)}
    hidden |= {repr(float(number)) for number in numbers}
    bits = [struct.pack("<d", number) for number in numbers]
    for name, content in bytes_below(place / "out").items():
        text = content.decode("latin-1")
        assert not [word for word in hidden if word in text], name
        assert not [word for word in bits if word in content], name


def test_pictures_hold_pixels_alone(place: Path) -> None:
    """No date, no program, no comment: a header, the pixels and an end."""
    for name, content in bytes_below(place / "out").items():
        if name.endswith(".png"):
            kinds, at = list[bytes](), 8
            while at < len(content):
                length, kind = struct.unpack(">I4s", content[at : at + 8])
                kinds.append(kind)
                at += 12 + length
            assert set(kinds) == {b"IHDR", b"IDAT", b"IEND"} and at == len(content)


def test_who_is_told_the_text_finds_the_same(place: Path, card: str) -> None:
    before = bytes_below(place / "out")
    publish(TRACK, card, SECRET, place / "again", place / "other")
    assert (place / "other" / ANNOUNCEMENT).read_bytes() == before[ANNOUNCEMENT]
    publish(TRACK, card, SECRET, place / "keep", place / "out")
    assert bytes_below(place / "out") == before


def test_another_text_is_not_the_announced_one(place: Path, card: str) -> None:
    announced, other = read_announcement(place / "out"), Secret(f"{TEXT}!")
    with pytest.raises(RsbenchError, match="--seed-file: its text is not the announced one"):
        announced_split(announced, TRACK, card, other, None)
    with pytest.raises(RsbenchError, match="commitment: differs from the announced one"):
        publish(TRACK, card, other, place / "other", place / "out")


def test_another_truth_is_not_the_announced_one(place: Path, card: str) -> None:
    announced = read_announcement(place / "out")
    shorter = Path(card).read_text().replace("rotation_deg = 2", "rotation_deg = 1.9")
    (place / "other.toml").write_text(shorter)
    with pytest.raises(RsbenchError, match="fingerprint: differs from the announced one"):
        announced_split(announced, TRACK, str(place / "other.toml"), SECRET, None)
    listing = place / "keep" / DATA / "dataset.json"
    content = json.loads(listing.read_text())
    content["files"]["s0/rs/left_0.png"]["sha256"] = 64 * "0"
    listing.write_text(json.dumps(content))
    with pytest.raises(RsbenchError, match="truth: differs from the announced one"):
        announced_split(announced, TRACK, card, SECRET, place / "keep")


def test_the_readout_ratio_is_not_told_by_the_split_of_another_track(card: str) -> None:
    poses, readouts = (drawn_split(TRACKS[track], card, SECRET) for track in ("pose", "readout"))
    ratios = [{truth.shutter.readout_ratio for truth in split.truths} for split in (poses, readouts)]
    assert not ratios[0] & ratios[1]


def test_commands_score_by_the_text_and_keep_the_truth_apart(place: Path, card: str) -> None:
    (place / "seed").write_text(TEXT)
    write(place / "mine.jsonl", named(truth_lines(drawn_split(TRACK, card, SECRET)), "mine"))
    given = ("--seed-file", place / "seed", "--published", place / "out", "--board", place / "board")
    leaderboard("score", place / "mine.jsonl", *given, "--card", card)
    split = read_announcement(place / "out").split
    assert (place / "board/pose-own-1" / split / "entries/mine/scores.csv").is_file()
    inside = ("--seed-file", place / "seed", "--keep", place / "out/keep", "--out", place / "out")
    refused = run_here("leaderboard", "publish", "pose-own", *inside, "--card", card)
    assert_refused(refused, "which everybody may see; take another place")
    apart = ("--seed-file", place / "seed", "--keep", place / "apart", "--out", place / "new")
    assert_refused(run_here("leaderboard", "publish", "points", *apart), "has no frames")
    shutil.rmtree(place / "out")
    lost = run_here("leaderboard", "score", place / "mine.jsonl", *given, "--card", card)
    assert_refused(lost, "has no announcement.json")
