"""What ``rsbench generate`` refuses of its options: one line, exit code 2, and nothing left behind."""

from __future__ import annotations

from pathlib import Path

import pytest
from commands import run_here
from small_scenes import write_box_scene, write_small_card


@pytest.fixture
def card(tmp_path: Path) -> Path:
    """Of a camera with a lens."""
    path = write_small_card(tmp_path, [write_box_scene(tmp_path, "a")])
    path.write_text(
        path.read_text().replace("focal = 80", 'focal = 80\nlens = { model = "brown-conrady", k1 = -0.1 }')
    )
    return path


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--shard", ""], "--shard : must be I/N"),
        (["--shard", "1"], "--shard 1: must be I/N"),
        (["--shard", "2/1"], "shard 2/1: the first number"),
        (["--shard", "2/2"], "shard 2/2: is empty"),
        (["--channels", ""], "--channels : ''"),
        (["--channels", "nix"], "--channels nix: 'nix'"),
        (["--channels", "timing,timing"], "each once"),
        (["--channels", "all"], "dataset small: channels: 'disparity' is made of cameras without a lens"),
        (["--only", "b"], "no sequence 'b'"),
        (["--estimate", "--full-frames"], "--estimate: not with --full-frames"),
    ],
)
def test_options_that_cannot_be_are_one_line(card: Path, tmp_path: Path, options: list[str], words: str) -> None:
    result = run_here("generate", card, "--out", tmp_path / "out", *options)
    assert result.returncode == 2
    (line,) = result.stderr.strip().splitlines()
    assert words in line
    assert not (tmp_path / "out").exists()
