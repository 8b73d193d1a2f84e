"""Grids of a dataset card: every combination once, and nothing else differs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from commands import refused
from small_scenes import write_small_card

from rsbench.core.errors import RsbenchError
from rsbench.dataset.card import DatasetCard, load_dataset_card

MOTION = '{ rotation_deg = %s, rotation_axis = "random", translation = 0.2, translation_axis = "random" }'
GRID = f"""
[grid.motion.mild]
motion = {MOTION % 1}
[grid.motion.fast]
motion = {MOTION % 5}
[grid.readout.short]
readout_ratio = 0.3
[grid.readout.phone]
shutter = "apple-iphone-12-wide"
[grid.sensor.ideal]
[grid.sensor.real]
sensor = {{ exposure_s = 0.01 }}
[[sequence]]
name = "room"
scene = "room"
scale = 0.5
[[sequence]]
name = "street"
scene = "street"
baseline = 0.7
"""


def _card(folder: Path, text: str = GRID) -> DatasetCard:
    path = write_small_card(folder, [])
    path.write_text(path.read_text().replace("seed = 1", "seeds = [4, 5]") + text)
    return load_dataset_card(str(path))


def test_every_combination_is_made_once(tmp_path: Path) -> None:
    card = _card(tmp_path)
    assert [sequence.name for sequence in card.sequence][:4] == [
        "room-mild-short-ideal-4",
        "room-mild-short-real-4",
        "room-mild-phone-ideal-4",
        "room-mild-phone-real-4",
    ]
    assert len({sequence.name for sequence in card.sequence}) == len(card.sequence) == 2 * 2 * 2 * 2 * 2


def test_what_the_grid_does_not_say_is_the_same(tmp_path: Path) -> None:
    card = _card(tmp_path)
    made = {sequence.name: sequence for sequence in card.sequence}
    one, other = made["room-mild-short-ideal-4"], made["room-mild-phone-real-4"]
    motion, same = card.motion_of(one), card.motion_of(other)
    np.testing.assert_array_equal([motion.w, motion.d], [same.w, same.d])
    assert card.sensor_of(one) is None and card.manifest_of(other)["sensor"]["exposure_s"] == 0.01
    assert card.shutter_for(one).readout_ratio == 0.3 and card.period_of(one) == 0.1
    assert card.shutter_for(other).readout_ratio == pytest.approx(0.1584) and card.period_of(other) == 1 / 24
    # Metres are scaled, and no others: baselines of 0.3 and 0.7 m, ways of 0.2 m.
    street = made["street-mild-short-ideal-4"]
    assert card.rig_of(one).baseline == 0.15 and card.rig_of(street).baseline == 0.7
    assert np.linalg.norm(motion.d) == pytest.approx(0.1)
    assert np.linalg.norm(card.motion_of(street).d) == pytest.approx(0.2)
    # Another seed and another motion of the grid have other axes.
    for name in ("room-mild-short-ideal-5", "room-fast-short-ideal-4"):
        direction = card.motion_of(made[name]).d / 0.1
        assert np.linalg.norm(direction - motion.d / 0.1) > 1e-3


def test_a_sequence_of_the_name_draws_the_same_without_a_grid(tmp_path: Path) -> None:
    motion = f'[[sequence]]\nname = "room-mild"\nscene = "room"\nscale = 0.5\nmotion = {MOTION % 1}\n'
    (single, _) = _card(tmp_path, motion).sequence
    grid = {sequence.name: sequence for sequence in _card(tmp_path).sequence}
    assert single.name == "room-mild-4" and single.motion == grid["room-mild-short-ideal-4"].motion


def test_other_seeds_make_another_split(tmp_path: Path) -> None:
    _card(tmp_path)
    dev = load_dataset_card(str(tmp_path / "small.toml"))
    test = load_dataset_card(str(tmp_path / "small.toml"), seeds=(77,))
    assert [sequence.name for sequence in test.sequence] == [
        sequence.name.removesuffix("4") + "77" for sequence in dev.sequence if sequence.name.endswith("4")
    ]
    assert not {dev.seed_of(sequence) for sequence in dev.sequence} & {sequence.seed for sequence in test.sequence}
    with pytest.raises(RsbenchError, match="seeds and the seed of a sequence exclude each other"):
        own = '[[sequence]]\nname = "a"\nscene = "room"\nseed = 3\nmotion = ' + MOTION % 1
        _card(tmp_path, own)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "[grid.motion.mild]\nreadout = 0.3\n",
            "unknown key 'grid.motion.mild.readout' .did you mean 'readout_ratio'",
        ),
        ("[grid.readout.all]\nreadout_ratio = 3\n", r"readout_ratio = 3.0: must be a number from 0 to 1"),
        ('[grid.readout."a/b"]\nreadout_ratio = 0.3\n', "must be a folder's name"),
        ("[grid.sensor.slow]\nsensor = { exposure_s = 9 }\n", "longer than frame_period_s"),
    ],
)
def test_values_that_cannot_be_are_one_line(tmp_path: Path, text: str, words: str) -> None:
    with refused(match=words):
        _card(tmp_path, text + '[[sequence]]\nname = "room"\nscene = "room"\n')
