"""The smallest problems that still use all of a command: a checkout whose cards are tiny, data made from them.

The checkout holds rsbench itself by a link, so that the code is the code under test, and the cards of every kind.
"""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from pathlib import Path
from typing import Any

from small_scenes import DATASET, MOTION, write_box_scene

ROOT = Path(__file__).parents[2]
LINKED = ("rsbench", "docs", "examples")
KINDS = ("cards", "renderers", "scenes", "solvers")
"""Folders of cards: whoever imports rsbench here attacks it with the cards of the whole checkout."""
CAMERA = {"width": 96, "height": 64, "focal": 80.0}
RIG = "baseline = 0.3\nreadout_ratio = 0.8\n[camera]\nfx = 80.0\nfy = 80.0\ncx = 47.5\ncy = 31.5\n"
SOLVERS = ("gs-8pt", "rs-stereo-linear", "rs-stereo-refined")


def make_checkout(folder: Path) -> Path:
    """A checkout of few solvers, one textured box for a scene, frames of 96 x 64, sweeps of two trials."""
    folder.mkdir(parents=True)
    shutil.copyfile(ROOT / "pyproject.toml", folder / "pyproject.toml")
    for name in LINKED:
        (folder / name).symlink_to(ROOT / name)
    for kind in KINDS:
        shutil.copytree(ROOT / kind, folder / kind)
    for path in (folder / "solvers").glob("*.toml"):
        if path.stem not in SOLVERS:
            path.unlink()
    for path in (folder / "scenes").glob("*.toml"):
        write_box_scene(folder / "scenes", path.stem)
    for path in (folder / "cards/datasets").glob("*.toml"):
        card = tomllib.loads(path.read_text("utf-8"))
        card |= {"camera": CAMERA, "renderer": "preview", "sequence": card["sequence"][:2]}
        if "seeds" in card:
            card["seeds"] = card["seeds"][:2]
        path.write_text(to_toml(card), "utf-8")
    for path in (folder / "cards/sweeps").glob("*.toml"):
        card = tomllib.loads(path.read_text("utf-8"))
        card |= {"trials": 2, "values": [card["values"][0], card["values"][-1]]}
        path.write_text(to_toml(card), "utf-8")
    return folder


def write_inputs(folder: Path) -> None:
    """What users bring: a rig, a scene, a dataset card of two sequences, a sweep."""
    folder.mkdir(parents=True)
    (folder / "rig.toml").write_text(RIG, "utf-8")
    scene = write_box_scene(folder, "box")
    sequences = [f'[[sequence]]\nname = "{name}"\nscene = "{scene}"\n' for name in ("one", "two")]
    (folder / "tiny.toml").write_text("\n".join([DATASET + MOTION, *sequences]), "utf-8")
    (folder / "sweep.toml").write_text(to_toml(SWEEP), "utf-8")


SWEEP: dict[str, Any] = {
    "name": "tiny",
    "axis": "noise_px",
    "values": [0.0, 0.5, 1.0],
    "solvers": ["gs-8pt", "rs-stereo-linear"],
    "trials": 4,
    "setting": {
        "width": 640,
        "height": 480,
        "focal": 500.0,
        "baseline": 0.2,
        "readout_ratio": 0.5,
        "points": 30,
        "depth": [2.0, 5.0],
        "rotation_deg": 1.0,
        "translation": 0.1,
        "noise_px": 0.0,
    },
}


def to_toml(content: dict[str, Any]) -> str:
    """TOML of a tree, one key a line, tables inline; what TOML cannot say (None) is left out."""
    return "".join(f"{_key(key)} = {_value(value)}\n" for key, value in content.items() if value is not None)


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items() if v is not None) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_value(item) for item in value if item is not None) + "]"
    if isinstance(value, float):  # nan and inf are words of TOML; 1e300 needs its digits
        return repr(value)
    return json.dumps(value)


def _key(key: object) -> str:
    text = str(key)
    return text if re.fullmatch(r"[A-Za-z0-9_-]+", text) else json.dumps(text)
