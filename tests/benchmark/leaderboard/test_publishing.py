"""Secret splits of frames: the truth comes back from the text alone, and the public part does not tell it.

Nothing is rendered here: a stand-in writes what a renderer would, noise for pictures.
"""

from __future__ import annotations

import json
import re
import shutil
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run_here

from rsbench.benchmark.leaderboard import publishing
from rsbench.benchmark.leaderboard.publishing import (
    ANNOUNCEMENT,
    DATA,
    announced_split,
    drawn_split,
    publish,
    read_announcement,
)
from rsbench.benchmark.leaderboard.submissions import read_submission, truth_text
from rsbench.benchmark.leaderboard.track import mark
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import views_of
from rsbench.dataset.card import DatasetCard
from rsbench.dataset.manifest import write_manifest
from rsbench.dataset.secret_split import Secret, secret_card
from rsbench.dataset.views import image_seed
from rsbench.storage.files import HashedFile, sha256, write_json, write_png

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


def public(place: Path) -> Iterator[tuple[str, bytes]]:
    for path in sorted((place / "out").rglob("*")):
        if path.is_file():
            yield path.relative_to(place / "out").as_posix(), path.read_bytes()


def test_the_text_alone_makes_the_truth_that_was_rendered(place: Path, card: str) -> None:
    announced = read_announcement(place / "out")
    drawn = announced_split(announced, TRACK, card, SECRET, None)
    kept = announced_split(announced, TRACK, card, SECRET, place / "keep")
    assert drawn.fingerprint == kept.fingerprint == announced.fingerprint
    assert [each.facts for each in drawn.truths] == [each.facts for each in kept.truths]
    assert [each.scene for each in drawn.truths] == [each.scene for each in kept.truths]
    (place / "mine.jsonl").write_text(truth_text(drawn))
    scores = mark(read_submission(place / "mine.jsonl", kept), kept)
    assert np.all(scores["auc_1"] == 1.0) and len(scores) == 4


def test_the_public_part_is_frames_cameras_and_what_is_announced(place: Path) -> None:
    names = {re.sub(r"s\d/(left|right)_[01]", "s0/left_0", name) for name, _ in public(place)}
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
    for name, content in public(place):
        text = content.decode("latin-1")
        assert not [word for word in hidden if word in text], name
        assert not [word for word in bits if word in content], name


def test_pictures_hold_pixels_alone(place: Path) -> None:
    """No date, no program, no comment: a header, the pixels and an end."""
    for name, content in public(place):
        if name.endswith(".png"):
            kinds, at = list[bytes](), 8
            while at < len(content):
                length, kind = struct.unpack(">I4s", content[at : at + 8])
                kinds.append(kind)
                at += 12 + length
            assert set(kinds) == {b"IHDR", b"IDAT", b"IEND"} and at == len(content)


def test_who_is_told_the_text_finds_the_same(place: Path, card: str) -> None:
    before = dict(public(place))
    publish(TRACK, card, SECRET, place / "again", place / "other")
    assert (place / "other" / ANNOUNCEMENT).read_bytes() == before[ANNOUNCEMENT]
    publish(TRACK, card, SECRET, place / "keep", place / "out")
    assert dict(public(place)) == before


def test_another_text_is_not_the_announced_one(place: Path, card: str) -> None:
    announced, other = read_announcement(place / "out"), Secret(f"{TEXT}!")
    with pytest.raises(RsbenchError, match="--seed-file: its text is not the announced one"):
        announced_split(announced, TRACK, card, other, None)
    with pytest.raises(RsbenchError, match="commitment: what is here is not what was announced"):
        publish(TRACK, card, other, place / "other", place / "out")


def test_another_truth_is_not_the_announced_one(place: Path, card: str) -> None:
    announced = read_announcement(place / "out")
    shorter = Path(card).read_text().replace("rotation_deg = 2", "rotation_deg = 1.9")
    (place / "other.toml").write_text(shorter)
    with pytest.raises(RsbenchError, match="fingerprint: what is here is not what was announced"):
        announced_split(announced, TRACK, str(place / "other.toml"), SECRET, None)
    listing = place / "keep" / DATA / "dataset.json"
    content = json.loads(listing.read_text())
    content["files"]["s0/rs/left_0.png"]["sha256"] = 64 * "0"
    listing.write_text(json.dumps(content))
    with pytest.raises(RsbenchError, match="truth: what is here is not what was announced"):
        announced_split(announced, TRACK, card, SECRET, place / "keep")


def test_the_readout_ratio_is_not_told_by_the_split_of_another_track(card: str) -> None:
    poses, readouts = (drawn_split(TRACKS[track], card, SECRET) for track in ("pose", "readout"))
    ratios = [{truth.shutter.readout_ratio for truth in split.truths} for split in (poses, readouts)]
    assert not ratios[0] & ratios[1]


def test_commands_score_by_the_text_and_keep_the_truth_apart(place: Path, card: str) -> None:
    (place / "seed").write_text(TEXT)
    (place / "mine.jsonl").write_text(truth_text(drawn_split(TRACK, card, SECRET)).replace('"truth"', '"mine"', 1))
    (place / "mine.jsonl").write_text((place / "mine.jsonl").read_text().replace('["truth"]', '["left"]', 1))
    given = ("--seed-file", place / "seed", "--published", place / "out", "--board", place / "board")
    done = run_here("leaderboard", "score", place / "mine.jsonl", *given, "--card", card)
    assert done.returncode == 0, done.stderr
    assert (
        place / "board/pose-own-1" / read_announcement(place / "out").split / "entries/mine/scores.csv"
    ).is_file()
    inside = ("--seed-file", place / "seed", "--keep", place / "out/keep", "--out", place / "out")
    refused = run_here("leaderboard", "publish", "pose-own", *inside, "--card", card)
    assert refused.returncode == 2 and "which everybody may see; take another place" in refused.stderr
    apart = ("--seed-file", place / "seed", "--keep", place / "apart", "--out", place / "new")
    simulated = run_here("leaderboard", "publish", "points", *apart)
    assert simulated.returncode == 2 and "has no frames" in simulated.stderr
    shutil.rmtree(place / "out")
    lost = run_here("leaderboard", "score", place / "mine.jsonl", *given, "--card", card)
    assert lost.returncode == 2 and "has no announcement.json" in lost.stderr
