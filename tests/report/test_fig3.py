"""Figure 3: drawn from stored summaries alone, and equal bytes from equal summaries."""

from __future__ import annotations

import re
import zlib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from rsbench.benchmark.simulated.sweep_card import load_sweep
from rsbench.benchmark.studies.claims import READINGS
from rsbench.core.errors import RsbenchError
from rsbench.report import paper_figures
from rsbench.report.paper_figures import SWEEPS, draw_fig3, fig3, read_summaries, setting_table

SOLVERS = {"rs-stereo-linear": 0.5, "rs-stereo-refined-pairs": 0.01, "gs-8pt": 1.0, "somebody-elses": 0.3}


def write_summaries(folder: Path) -> None:
    for name in SWEEPS:
        card = load_sweep(name)
        rows = []
        for cell in card.cells():
            for k, (solver, error) in enumerate(SOLVERS.items()):
                row = {"variant": cell.variant, "value": cell.value, "solver": solver, "trials": 300}
                row |= {"information": "left pairs" if solver == "gs-8pt" else "left and right pairs"}
                for measure in ("e_R", "e_T"):
                    value = error * (1 + 0.1 * np.sin(k + cell.index))
                    for centre in ("mean", "median"):
                        ends = {"": value, "_low": 0.9 * value, "_high": 1.1 * value}
                        row |= {f"{measure}_{centre}{end}": number for end, number in ends.items()}
                    row |= {f"{measure}_bound_mean": 0.009, f"{measure}_bound_median": 0.008}
                rows.append(row)
        pd.DataFrame(rows).to_csv(folder / f"{name}.csv", index=False)


@pytest.mark.slow
def test_equal_summaries_give_equal_bytes_without_dates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paper_figures, "READINGS", {"1e-3 px": 1e-3})  # each figure takes seconds
    monkeypatch.setattr(paper_figures, "CENTRES", ("mean",))
    drawn = []
    for name in ("a", "b"):
        folder = tmp_path / name
        folder.mkdir()
        write_summaries(folder)
        paths = draw_fig3(folder)
        assert [path.suffix for path in paths] == [".pdf", ".png"]
        drawn.append({path.name: path.read_bytes() for path in paths})
    assert drawn[0] == drawn[1]
    assert len(set(drawn[0].values())) == 2
    for name, content in drawn[0].items():
        assert b"CreationDate" not in content and b"Matplotlib" not in content
        if name.endswith(".pdf"):
            # Vector: no image objects, and text that can be searched.
            assert b"/Subtype /Image" not in content and b"/FontFile2" in content
            streams = [_inflated(s) for s in re.findall(rb"stream\r?\n(.*?)endstream", content, re.DOTALL)]
            assert any(b" l\n" in stream for stream in streams)


@pytest.mark.parametrize("upright", [True, False])
def test_an_error_has_one_scale_that_holds_all_of_it(upright: bool) -> None:
    """Panels stand in the order of the paper's columns: noise and baseline, translation, rotation, readout."""
    folder = Path(__file__).parents[2] / "results" / "fig3"
    tables = read_summaries(folder, SWEEPS)
    panels = fig3(tables, "0.81 px", "mean", upright=upright).axes
    by_error = [panels[0::2], panels[1::2]] if upright else [panels[:5], panels[5:]]
    for measure, row in zip(("e_R", "e_T"), by_error, strict=True):
        ((low, high),) = {axes.get_ylim() for axes in row}
        for axes, name in zip(row, ("noise", "baseline", "translation", "rotation", "readout"), strict=True):
            table = tables[name] if name == "noise" else tables[name][tables[name].variant == "0.81 px"]
            wanted = {tuple(rows[f"{measure}_mean"]) for _, rows in table.groupby("solver")}
            curves = {tuple(np.asarray(line.get_ydata())) for line in axes.lines}
            assert wanted <= curves, (name, measure)
            every = table[[f"{measure}_mean", f"{measure}_mean_low", f"{measure}_mean_high"]].to_numpy()
            assert low < np.min(every) and np.max(every) < high


def test_the_committed_pdf_fits_a_column() -> None:
    for path in (Path(__file__).parents[2] / "results" / "fig3").glob("*.pdf"):
        (box,) = re.findall(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", path.read_bytes())
        width, height = (float(each) * 25.4 / 72.0 for each in box)
        assert abs(width - 88.0) < 0.01 and height < 235.0, "a page of A4 between its margins"


def _inflated(stream: bytes) -> bytes:
    try:
        return zlib.decompress(stream)
    except zlib.error:
        return b""


def test_a_missing_summary_is_named(tmp_path: Path) -> None:
    with pytest.raises(RsbenchError, match=r"noise\.csv: no such summary"):
        draw_fig3(tmp_path)


def test_the_table_of_settings_says_what_the_paper_leaves_open() -> None:
    table = setting_table([load_sweep(name) for name in SWEEPS]).set_index("sweep")
    assert table.loc["rotation", "rotation (deg)"] == "varies"
    assert table.loc["noise", "depth (m)"] == "2 to 10, uniform"
    assert set(table["points per camera"]) == {"100"} and set(table.trials) == {"300"}
    assert set(READINGS) == {cell.variant for cell in load_sweep("rotation").cells()}


@pytest.mark.parametrize("name", SWEEPS)
def test_the_committed_tables_are_those_of_the_committed_trials(name: str) -> None:
    """Median and mean of every row by NumPy; tables have six digits, trials single precision."""
    folder = Path(__file__).parents[2] / "results" / "fig3"
    table = pd.read_csv(folder / f"{name}.csv")
    with np.load(folder / "trials.npz") as stored:
        errors = {measure: stored[f"{name}_{measure}_deg"].astype(float) for measure in ("e_R", "e_T")}
    for measure, values in errors.items():
        assert values.shape == (len(table), 300) and set(table.trials) == {300}
        np.testing.assert_allclose(np.median(values, axis=1), table[f"{measure}_median"], rtol=1e-5)
        np.testing.assert_allclose(np.mean(values, axis=1), table[f"{measure}_mean"], rtol=1e-5)
