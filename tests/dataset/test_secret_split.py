"""Cards drawn from a secret text: all that a split must hide is drawn, and nothing that is told tells it."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from commands import run_here

from rsbench.benchmark.leaderboard.splits import seed_of
from rsbench.core.errors import RsbenchError
from rsbench.dataset.card import DatasetCard, load_dataset_card
from rsbench.dataset.secret_split import Secret, open_split, read_secret, secret_card, write_scenes
from rsbench.scenes.load import load_scene, read_scene_card

TEXT = "f3b1 a secret that nobody guesses"
MOVING = """[[sequence.moving]]
box = [1, 1, 1]
position = [0, 0, 9]
motion = { rotation_deg = 1, rotation_axis = "random", translation = 0.1, translation_axis = "random" }
"""


@pytest.fixture(scope="module")
def drawn() -> DatasetCard:
    return secret_card("standard", Secret(TEXT))


def motions(card: DatasetCard) -> np.ndarray:
    """(n, 6), in the order of the card."""
    found = [card.motion_of(each) for each in card.sequence]
    return np.array([np.concatenate([each.w, each.d]) for each in found])


def test_a_text_draws_one_card_and_another_text_another(drawn: DatasetCard) -> None:
    assert secret_card("standard", Secret(TEXT)) == drawn
    other = secret_card("standard", Secret(f"{TEXT}."))
    assert not {each.seed for each in other.sequence} & {each.seed for each in drawn.sequence}
    assert not set(motions(other).ravel()) & set(motions(drawn).ravel())


def test_every_combination_is_there_and_no_two_share_a_motion(drawn: DatasetCard) -> None:
    """As many of each scene, stratum and sensor as the card has; a motion that eight share could be averaged."""
    open_card = load_dataset_card("standard")

    def kinds(card: DatasetCard) -> list[tuple[object, ...]]:
        return sorted((each.scene, each.baseline or card.baseline, each.sensor is None) for each in card.sequence)

    assert kinds(drawn) == kinds(open_card)
    assert len(np.unique(motions(drawn), axis=0)) == len(drawn.sequence) == 216
    assert len({each.seed for each in drawn.sequence}) == 216
    axes = motions(drawn)[:, :3] / np.linalg.norm(motions(drawn)[:, :3], axis=1, keepdims=True)
    # Of 216 directions on the sphere the mean is shorter than 4 / sqrt(3 * 216) but for one in 1e4 of all texts.
    assert np.linalg.norm(axes.mean(axis=0)) < 4.0 / np.sqrt(3 * 216)


def test_no_size_is_that_of_the_card(drawn: DatasetCard) -> None:
    """Who knows that a rotation has 0.4, 2 or 6 deg would round to them."""
    sizes = np.array([each.motion.rotation_deg for each in drawn.sequence if each.motion])
    nearest = np.array([0.4, 2.0, 6.0])[np.searchsorted([0.4, 2.0], sizes - 1e-12)]
    share = sizes / nearest
    assert share.min() >= 0.7 and share.max() < 1.0
    assert len(np.unique(share)) == 216
    ratios = np.array([each.readout_ratio for each in drawn.sequence])
    assert len(np.unique(ratios)) == 216
    assert np.all((ratios < 0.3) & (ratios >= 0.21) | (ratios < 0.9) & (ratios >= 0.63))


def test_names_and_order_tell_nothing(drawn: DatasetCard) -> None:
    assert [each.name for each in drawn.sequence] == [f"s{number:03d}" for number in range(216)]
    scenes = [each.scene for each in drawn.sequence]
    # Of 215 neighbours one in nine is of one scene by chance: 24, with a deviation of 5.
    assert sum(one == other for one, other in pairwise(scenes)) < 24 + 5 * 5


def test_what_is_announced_is_no_seed(drawn: DatasetCard, tmp_path: Path) -> None:
    secret, path = Secret(TEXT), tmp_path / "seed"
    path.write_text(f"  {TEXT}\n")
    assert read_secret(path) == secret
    plain = hashlib.sha256(TEXT.encode()).hexdigest()
    assert secret.commitment != plain and int(secret.commitment, 16) != seed_of(path)
    told = int(secret.commitment, 16)
    assert all(each.seed not in (told >> 194, told % 2**62, told) for each in drawn.sequence)
    assert TEXT not in repr(secret)


def test_scenes_are_others_in_the_same_places(tmp_path: Path) -> None:
    paths = write_scenes("standard", Secret(TEXT), tmp_path)
    assert len(paths) == 9
    for path in paths:
        own, open_one = read_scene_card(path)[0], read_scene_card(Path("scenes", path.name))[0]
        assert own.seed != open_one.seed and replace(own, seed=open_one.seed) == open_one
    card = secret_card("standard", Secret(TEXT), tmp_path)
    assert {each.scene for each in card.sequence} == set(map(str, paths))


def test_train_and_dev_share_no_seed_motion_scene_or_texture(tmp_path: Path) -> None:
    """Textures of two scenes, those that are built soonest; the seeds of scenes are read from all nine."""
    train, dev = open_split("standard", "train"), load_dataset_card("standard")
    paths = write_scenes("standard", train, tmp_path)
    card = secret_card("standard", train, tmp_path, split="train")
    assert card.name == "standard-train" and {each.scene for each in card.sequence} == set(map(str, paths))
    assert not {each.seed for each in card.sequence} & {each.seed for each in dev.sequence}
    assert not set(motions(card).ravel()) & set(motions(dev).ravel())
    assert all(
        read_scene_card(path)[0].seed != read_scene_card(Path("scenes", path.name))[0].seed for path in paths
    )
    assert open_split("standard", "other").number("sequence") != train.number("sequence")
    for name in ("corridor", "street"):
        path = next(each for each in paths if each.stem == name)
        drawn, known = (
            {m.material.texture.tobytes() for m in load_scene(each).meshes if m.material.texture is not None}
            for each in (path, name)
        )
        assert len(drawn) == len(known) >= 10 and not drawn & known


def test_a_split_has_as_many_sequences_as_asked_and_more_have_scenes_of_their_own(tmp_path: Path) -> None:
    """The first 216 are the split itself; 300 draw the card twice."""
    train = open_split("standard", "train")
    first = secret_card("standard", train, tmp_path, split="train")
    more = secret_card("standard", train, tmp_path, split="train", count=300)
    assert len(more.sequence) == 300 and more.sequence[0].name == "s000" and more.sequence[-1].name == "s299"
    assert more.sequence[:216] == first.sequence
    assert len({each.seed for each in more.sequence}) == len(np.unique(motions(more), axis=0)) == 300
    assert len({each.readout_ratio for each in more.sequence}) == 300
    paths = write_scenes("standard", train, tmp_path, 300)
    assert len(paths) == 18 == len({read_scene_card(path)[0].seed for path in paths})
    scenes = [{each.scene for each in more.sequence[part]} for part in (slice(216), slice(216, None))]
    assert scenes[0] | scenes[1] == set(map(str, paths)) and not scenes[0] & scenes[1]
    few = secret_card("standard", train, tmp_path, split="train", count=10)
    same = zip(few.sequence, first.sequence[:10], strict=True)
    assert all(replace(one, name=other.name) == other for one, other in same)


def test_splits_of_what_is_not_drawn_are_refused(tmp_path: Path) -> None:
    out = tmp_path / "out"
    for words, said in (
        (["standard", "--split", "test"], "--split test: must be a name"),
        (["standard", "--split", "train", "--seed", "3"], "--split: not with --seed"),
        (["smoke", "--split", "train"], "a secret split needs both axes"),
        (["standard", "--sequences", "9"], "--sequences: goes with --split"),
    ):
        ran = run_here("generate", *words, "--out", out)
        assert ran.returncode == 2 and said in ran.stderr


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ('rotation_axis = "random"', "rotation_axis = [1, 0, 0]"),
        ('translation_axis = "random"', "translation_axis = [1, 0, 0]"),
        ('scene = "poles"', f'scene = "poles"\n{MOVING}'),
    ],
)
def test_a_card_that_tells_what_is_to_be_hidden_is_refused(change: str, words: str, tmp_path: Path) -> None:
    text = Path("cards/datasets/poles.toml").read_text()
    assert change in text
    (tmp_path / "mine.toml").write_text(text.replace(change, words))
    with pytest.raises(RsbenchError, match=r"mine\.toml: poles: mo(tion|ving): "):
        secret_card(str(tmp_path / "mine.toml"), Secret(TEXT))


def test_a_short_text_and_a_scene_without_a_seed_are_refused(tmp_path: Path) -> None:
    (tmp_path / "seed").write_text("12345\n")
    with pytest.raises(RsbenchError, match=r"seed: holds 5 characters: a secret seed needs 16"):
        read_secret(tmp_path / "seed")
    card = tmp_path / "mine.toml"
    card.write_text(Path("cards/datasets/poles.toml").read_text().replace('scene = "poles"', 'scene = "mesh"'))
    with pytest.raises(RsbenchError, match="scene mesh: is not built from a seed"):
        write_scenes(str(card), Secret(TEXT), tmp_path)
