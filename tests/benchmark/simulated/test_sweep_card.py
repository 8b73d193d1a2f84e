"""Sweep cards: what they hold, and refusals that a reader can act on."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from commands import refused

from rsbench.benchmark.simulated.sweep_card import SweepCard, load_sweep, with_options
from rsbench.components.cards import list_cards, parse_card
from rsbench.core.errors import RsbenchError
from rsbench.solvers.engine.base import list_solvers

SETTING: dict[str, Any] = load_sweep("noise").setting.record | {"points": 20, "noise_px": 0.1}
CARD: dict[str, Any] = {
    "name": "mine",
    "axis": "points",
    "values": [9, 20],
    "solvers": ["gs-8pt"],
    "setting": SETTING,
}


def parse(**changes: Any) -> SweepCard:
    return parse_card(SweepCard, {**CARD, **changes}, "mine.toml")


def test_cards_load_and_name_solvers_that_exist() -> None:
    for name in list_cards("sweeps"):
        card = load_sweep(name)
        assert card.name == name and card.description
        assert set(card.solvers) <= set(list_solvers()), name


def test_the_papers_sweeps_cover_its_ranges_with_its_repetitions() -> None:
    assert load_sweep("readout").values[0] == 0.2 and load_sweep("readout").values[-1] == 1.0
    assert load_sweep("baseline").values[0] == 0.1 and load_sweep("baseline").values[-1] == 1.0
    for name in ("noise", "rotation", "translation", "readout", "baseline"):
        card = load_sweep(name)
        assert card.trials == 300 and not card.robust
        assert (card.setting.width, card.setting.height, card.setting.focal) == (900, 900, 810.0)
        if name != "noise":
            assert sorted({cell.setting.noise_px for cell in card.cells()}) == [0.001, 0.81]


def test_cells_replace_the_axis_in_every_variant() -> None:
    card = parse(variant=[{"name": "a"}, {"name": "b", "setting": {"noise_px": 0.5, "shape": "plane"}}])
    cells = card.cells()
    assert [cell.index for cell in cells] == [0, 1, 2, 3]
    assert [(cell.variant, cell.setting.points) for cell in cells] == [("a", 9), ("a", 20), ("b", 9), ("b", 20)]
    assert [cell.setting.noise_px for cell in cells] == [0.1, 0.1, 0.5, 0.5]
    assert cells[3].setting.shape == "plane" and cells[0].setting.shape == "box"


def test_motion_keeps_its_random_axes_while_magnitudes_change() -> None:
    setting = parse().setting
    first = setting.motion(np.random.default_rng(3))
    other = setting.changed({"rotation_deg": 4.0, "translation": 0.6}, "").motion(np.random.default_rng(3))
    np.testing.assert_allclose(other.w, 2 * first.w, rtol=1e-12)
    np.testing.assert_allclose(other.d, 2 * first.d, rtol=1e-12)
    fixed = setting.changed({"rotation_axis": [0.0, 2.0, 0.0]}, "").motion(np.random.default_rng(3))
    np.testing.assert_allclose(fixed.w, [0.0, np.deg2rad(2.0), 0.0], atol=1e-15)
    np.testing.assert_allclose(fixed.d, first.d, rtol=1e-12)


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({"valus": [1]}, ["unknown key 'valus'", "did you mean 'values'?"]),
        ({"axis": "noise"}, ["axis = 'noise'", "noise_px"]),
        ({"values": []}, ["values must be different numbers"]),
        ({"values": [9, 9]}, ["values must be different numbers"]),
        ({"values": [9, 9.5]}, ["points", "9.5"]),
        ({"values": [0]}, ["points = 0: must be a whole number from 1 to"]),
        ({"solvers": []}, ["solvers must be different names"]),
        ({"trials": 0}, ["trials = 0: must be a whole number from 1 to"]),
        ({"name": "a/b"}, ["name = 'a/b'"]),
        ({"setting": {**SETTING, "depth": [5.0, 2.0]}}, ["depth must be two positive numbers in order"]),
        ({"setting": {**SETTING, "readout_ratio": 1.2}}, ["readout_ratio = 1.2: must be a number from 0 to 1"]),
        ({"setting": {**SETTING, "noise_px": -1.0}}, ["noise_px must not be negative"]),
        ({"setting": {**SETTING, "outlier_ratio": 1.0}}, ["outlier_ratio must lie in [0, 1)"]),
        (
            {"setting": {**SETTING, "motion_model": "spiral"}},
            ["motion model 'spiral'", "linear, spline, trajectory, twist"],
        ),
        ({"setting": {**SETTING, "rotation_axis": [0.0, 0.0, 0.0]}}, ["rotation_axis must not be zero"]),
        ({"setting": {**SETTING, "baseline": 0.0}}, ["baseline = 0.0: must be a positive number"]),
        ({"variant": [{"name": "a"}, {"name": "a"}]}, ["[[variant]] needs a name of its own"]),
        ({"variant": [{"name": "a", "setting": {"nois": 1}}]}, ["variant 'a'", "unknown key 'nois'"]),
        ({"axis": "readout_ratio_error", "values": [0.5]}, ["readout_ratio_error = 0.5", "from 0 to 1"]),
    ],
)
def test_bad_cards_are_refused_in_one_line(changes: dict[str, Any], parts: list[str]) -> None:
    with refused(*parts, match="^mine.toml: "):
        parse(**changes)


def test_command_line_options_are_checked_like_cards() -> None:
    assert with_options(parse(), ["rs-stereo-linear"], 7).trials == 7
    assert with_options(parse(), None, None) == parse()
    assert with_options(parse(), None, None, 5).seed == 5
    with pytest.raises(RsbenchError, match="solvers must be different names"):
        with_options(parse(), ["gs-8pt", "gs-8pt"], None)
    with pytest.raises(RsbenchError, match="unknown key 'pints'"):
        parse().with_setting(pints=9)
