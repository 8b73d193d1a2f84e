"""The page of points on recordings, from made-up scores whose medians and shares are known."""

from __future__ import annotations

import pandas as pd
from documents import ROOT, rows

from rsbench.report.points_pages import by_recording, recorded_page


def scores() -> pd.DataFrame:
    """Ten windows of a car, all within the ellipsoids, and thirty of a hand, half of them."""
    return pd.DataFrame(
        {
            "problem": [f"p{k}" for k in range(40)],
            "scene": [f"p{k}" for k in range(40)],
            "recording": ["car-a"] * 10 + ["hand-b"] * 30,
            "chosen": ["linear"] * 10 + ["continuous"] * 24 + ["twist"] * 6,
            "e_R_deg": [float(k) for k in range(40)],
            "e_T_deg": 1.0,
            "e_row_deg": 2.0,
            "nees": [1.0] * 10 + [1.0] * 15 + [100.0] * 15,
        }
    )


def test_medians_and_coverage_of_each_recording() -> None:
    table = by_recording({"a": scores()}).set_index("recording")
    assert list(table["problems"]) == list(table["stated"]) == [10, 30]
    assert list(table["covers_95"]) == [1.0, 0.5] and list(table["e_R_deg"]) == [4.5, 24.5]
    assert table["e_R_deg_low"]["hand-b"] < 24.5 < table["e_R_deg_high"]["hand-b"]
    unstated = scores().assign(nees=float("nan"))
    assert by_recording({"a": unstated})["covers_95"].isna().all()


def test_the_page_counts_choices_and_departures() -> None:
    chosen = scores().assign(departure_px=[0.5] * 10 + [2.0] * 15 + [20.0] * 15, noise_px=1.0)
    resampling = pd.read_csv(ROOT / "results/recorded/resampling.csv")
    text = recorded_page(by_recording({"ours": scores()}), chosen, resampling)
    assert ["hand-b", "0", "6", "0", "0", "24"] in rows(text) and ["car-a", "10", "0", "0", "0", "0"] in rows(text)
    cells = {tuple(row[:2]): row for row in rows(text)}
    assert cells["car-a", "motion model"][2].startswith("1.0") and cells["hand-b", "spline"][2].startswith("0.8")
    assert cells["hand-b", "motion model"][5].startswith("0.0")  # all of these errors are large
    windows = {row[0]: row[1:3] for row in rows(text) if row[0].startswith(("0 to", "1 to", "3 to", "above"))}
    assert [count for count, _ in windows.values()] == ["10", "15", "0", "15"] and windows["3 to 10"][1] == "-"


def test_the_committed_page_is_that_of_the_committed_tables() -> None:
    folder = ROOT / "results/recorded"
    tables = (pd.read_csv(folder / f"{name}.csv") for name in ("recordings", "choices", "resampling"))
    assert recorded_page(*tables) == (folder / "README.md").read_text("utf-8")
