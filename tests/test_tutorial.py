"""The tutorial's files and commands, as printed but for smaller frames, end with the picture that it promises."""

from __future__ import annotations

import csv
import runpy
import shlex
from pathlib import Path

import cv2
import pytest
from commands import run_here
from documents import ROOT, blocks

TUTORIAL = ROOT / "docs" / "get-started" / "tutorial.md"


@pytest.mark.slow
def test_the_tutorial_ends_with_its_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (card,) = blocks(TUTORIAL, "toml")
    for full, small in (("480", "240"), ("360", "180"), ("420", "210")):
        assert full in card
        card = card.replace(full, small)
    Path("first.toml").write_text(card, "utf-8")
    (script,) = blocks(TUTORIAL, "python")
    Path("picture.py").write_text(script, "utf-8")
    verbs = []
    for program, *words in (shlex.split(line) for block in blocks(TUTORIAL, "sh") for line in block.splitlines()):
        verbs.append(words[0])
        if program == "python":
            runpy.run_path(words[0])
            continue
        run = run_here(*words)
        assert run.returncode == 0, run.stderr
        assert words[0] != "verify" or "1 sequences, 0 faults" in run.stdout
    assert verbs == ["generate", "verify", "correct", "evaluate", "picture.py"]
    assert cv2.imread("picture.jpg").shape == (2 * 180, 2 * 240, 3)
    with open("scores/scores/pose.csv", encoding="utf-8") as file:
        errors = {row["solver"]: float(row["e_T_deg"]) for row in csv.DictReader(file)}
    # Half of the width and height: matches are twice as coarse as those of the tutorial, which has 0.08 and 5.2.
    assert errors["rs-stereo-refined"] < 1.0 < 3.0 < errors["gs-stereo-pnp"]
    with open("scores/scores/correction.csv", encoding="utf-8") as file:
        psnr = {row["corrector"]: float(row["psnr"]) for row in csv.DictReader(file) if row["pixels"] == "visible"}
    assert psnr["fusion"] > psnr["none"] + 8.0
