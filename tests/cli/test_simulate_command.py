"""``rsbench simulate`` as users meet it."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
from commands import assert_refused, run_here, sweep_card

CARD = sweep_card(["gs-8pt"], noise_px=[0.0, 0.5], trials=3)


def test_a_users_own_sweep(tmp_path: Path) -> None:
    card = tmp_path / "mine.toml"
    card.write_text(CARD)
    out = tmp_path / "results"
    result = run_here(
        "simulate", card, "--out", out, "--solver", "rs-stereo-linear", "--set", "points=40", "--workers", 1
    )
    assert result.returncode == 0, result.stderr
    assert "rs-stereo-linear" in result.stdout
    assert f"table: {out / 'summary.csv'}" in result.stdout
    table = pd.read_csv(out / "summary.csv")
    assert list(table.solver) == ["rs-stereo-linear"] * 2 and list(table.value) == [0.0, 0.5]
    assert table.e_R_median[0] < table.e_R_median[1]
    assert sorted(path.name for path in out.iterdir()) == [
        "bounds",
        "provenance.json",
        "seconds",
        "summary.csv",
        "sweep.json",
        "trials",
    ]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nois"], ["did you mean 'noise'?"]),
        (["noise", "--set", "pints=9"], ["unknown key 'pints'", "did you mean 'points'?"]),
        (["noise", "--set", "points"], ["--set points", "FIELD=VALUE"]),
        (["noise", "--set", "shape=ball"], ["shape = 'ball'"]),
        (["noise", "--set", "x=" + "[" * 3000], ["--set x", "not a value of TOML"]),
        (["noise", "--solver", "nobody"], ["solver 'nobody' does not exist"]),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(tmp_path: Path, arguments: list[str], words: list[str]) -> None:
    assert_refused(run_here("simulate", *arguments, "--out", tmp_path / "results"), *words)
    assert not (tmp_path / "results").exists()
