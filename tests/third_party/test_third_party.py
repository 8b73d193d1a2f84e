"""A stranger's single file adds a component: docs/how-to/extend.md, installed as packages, on the command line."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from rsbench.cli.names import COMPONENTS, component_kind
from rsbench.components.plugins import load_class, load_entry
from rsbench.scenes.load import load_scene

from .conftest import SECTIONS, Run

KINDS = {
    "A scene builder": ("builders", "hoardings"),
    "A solver": ("solvers", "aligned"),
    "A motion model": ("motions", "stop-and-go"),
    "A stereo matcher": ("matchers", "blocks"),
    "A feature matcher": ("features", "orb"),
    "A corrector": ("correctors", "as-it-is"),
    "A metric": ("metrics", "grey-error"),
}


def folder_of(output: str) -> Path:
    return Path(output.partition("\n")[0])


def all_lines(run: Run, section: str) -> Path:
    """Run a section's commands; returns the folder that they ran in."""
    return [folder_of(run(line)) for line in SECTIONS[section].commands][-1]


def test_every_kind_of_component_has_a_section() -> None:
    assert {kind for kind, _ in KINDS.values()} == set(COMPONENTS) and set(KINDS) == set(SECTIONS)


@pytest.mark.slow
def test_all_are_listed_and_one_is_shown(run: Run) -> None:
    listed = {row["kind"]: row["names"] for row in json.loads(run("rsbench list --json").partition("\n")[2])}
    for kind, name in KINDS.values():
        assert name in listed[kind]
    shown = json.loads(run("rsbench show stop-and-go --json").partition("\n")[2])
    assert shown["class"] == "stop_and_go:StopAndGo" and shown["origin"] == "stranger-stop_and_go"
    assert [row["default"] for row in shown["parameters"] if row["parameter"] == "swing"] == [0.5]


@pytest.mark.parametrize("title", KINDS)
def test_a_card_with_the_file_beside_it_is_enough(
    title: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without any installation, in this process."""
    section, (kind, _) = SECTIONS[title], KINDS[title]
    module = f"beside_{section.module}"
    (tmp_path / module).write_text(section.source, "utf-8")
    target = section.entry_points.split('"')[3].split(":")[1]
    card = tmp_path / "mine.toml"
    monkeypatch.setattr(sys, "path", list(sys.path))
    if title == "A scene builder":
        text = section.cards["street.toml"].replace('"hoardings"', f'"beside_hoardings:{target}"')
        card.write_text(text, "utf-8")
        assert len(load_scene(card).meshes) == 30
        return
    described = component_kind(kind)
    if described.cards is None:
        assert load_class(described, f"{module.removesuffix('.py')}:{target}", card).__name__ == target
        return
    card.write_text(f'class = "{module.removesuffix(".py")}:{target}"', "utf-8")
    assert type(load_entry(described, card).component).__name__ == target
    sys.modules.pop(module.removesuffix(".py"))


@pytest.mark.slow
def test_a_scene_builder(run: Run, data: Path) -> None:
    work = all_lines(run, "A scene builder")
    manifest = json.loads((work / "data" / "street" / "sequence.json").read_text("utf-8"))
    assert manifest["scene"]["name"] == "street"
    assert "1 sequences, 0 faults" in run("rsbench verify data")


@pytest.mark.slow
def test_a_solver(run: Run) -> None:
    work = all_lines(run, "A solver")
    assert "0 of 8 checks failed" in run("rsbench check-solver aligned")
    table = pd.read_csv(work / "simulated" / "summary.csv")
    assert list(table.solver) == ["aligned", "aligned-near"] and (table.failures == 0).all()
    # It ignores a rolling shutter: some hundredths of a degree off, not 180 and not nothing.
    assert table.e_R_median.between(0.001, 1.0).all()


@pytest.mark.slow
def test_a_motion_model(run: Run) -> None:
    work = all_lines(run, "A motion model")
    manifest = json.loads((work / "shaken" / "street" / "sequence.json").read_text("utf-8"))
    assert manifest["motion"]["model"] == "stop-and-go" and manifest["motion"]["parameters"] == {"swing": 0.8}
    # Written with pose of row 36 of 72: tau = 0.8 * 36 / 72 = 0.4, of which the path is at beta.
    poses = pd.read_csv(work / "shaken" / "street" / "poses" / "left_0.csv")
    beta = 0.4 + 0.8 * np.sin(2 * np.pi * 0.4) / (2 * np.pi)
    angle = 2 * np.arccos(poses.qw[36])
    assert angle == pytest.approx(beta * np.deg2rad(1.5), rel=1e-9)
    table = pd.read_csv(work / "wrong-model" / "summary.csv")
    # A wrong model costs accuracy: noise of 0.1 px alone leaves some thousandths of a degree.
    assert (table.e_R_median > 0.01).any() and table.e_R_median.notna().all()


def images_of(folder: Path) -> dict[tuple[str, int], np.ndarray]:
    return {
        (side, frame): np.asarray(Image.open(folder / f"{side}_{frame}.png"))
        for side in ("left", "right")
        for frame in (0, 1)
    }


def installed_class(installed: Path, module: str, name: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(installed)
    return getattr(importlib.import_module(module), name)


@pytest.mark.slow
def test_a_stereo_matcher(run: Run, data: Path, installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    work = all_lines(run, "A stereo matcher")
    found = np.load(work / "scored" / "predictions" / "street" / "depth" / "blocks.npz")["left_0"]
    images = images_of(data / "street" / "rs")
    matcher = installed_class(installed, "blocks", "Blocks", monkeypatch)()
    disparity, _ = matcher.disparities(images["left", 0], images["right", 0], None)
    np.testing.assert_array_equal(found, disparity)
    assert np.mean(np.isfinite(disparity)) > 0.3


def test_a_feature_matcher(run: Run, data: Path, installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    work = all_lines(run, "A feature matcher")
    found = np.load(work / "scored" / "predictions" / "street" / "matches.npz")["tracks"]
    matcher = installed_class(installed, "orb", "Orb", monkeypatch)()
    np.testing.assert_array_equal(found, matcher.match(images_of(data / "street" / "rs")).tracks)
    assert len(found) > 50


def test_a_corrector(run: Run, data: Path) -> None:
    work = all_lines(run, "A corrector")
    drawn = list((work / "scored" / "predictions" / "street" / "corrected").glob("as-it-is*-left_0.png"))
    assert len(drawn) == 1
    np.testing.assert_array_equal(Image.open(drawn[0]), images_of(data / "street" / "rs")["left", 0])


def test_a_metric(run: Run, data: Path) -> None:
    work = all_lines(run, "A metric")
    table = pd.read_csv(work / "scored" / "scores" / "correction.csv").fillna("")
    of_all = table[(table.corrector == "as-it-is") & (table.side == "left") & (table.frame == 0)]
    (value,) = of_all[of_all.pixels == "all"].grey_error
    rolling, truth = (images_of(data / "street" / kind)["left", 0].astype(float) for kind in ("rs", "gs"))
    assert value == pytest.approx(np.abs(rolling - truth).mean(), rel=1e-5)  # six digits are stored


def test_the_solver_is_scored_with_the_others(run: Run, data: Path) -> None:
    work = all_lines(run, "A metric")
    table = pd.read_csv(work / "scored" / "scores" / "pose.csv").set_index("solver")
    assert table.success["aligned"] and table.shutter["aligned"] == "global" and table.uses["aligned"] == "tracks"
    assert 0.0 < table.e_R_deg["aligned"] < 5.0
