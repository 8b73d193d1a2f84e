"""Figure 4: panels of a small sequence, stored, drawn, and the numbers under them."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rsbench.benchmark.studies.fig4_panels import (
    Panels,
    correct_literally,
    literal_options,
    load_panels,
    make_panels,
    save_panels,
)
from rsbench.core.rig import VIEWS
from rsbench.dataset.sequence import read_dataset
from rsbench.report.paper_figures import INVENTED, caption, draw_fig4, panel_images
from rsbench.report.pictures import INVALID
from rsbench.solvers.linear import LinearSolver
from rsbench.vision.quality import psnr

PAPERS = {"solver": "rs-stereo-linear", "features": "sift", "matcher": "sgm", "corrector": "single-view"}


@pytest.fixture(scope="module")
def panels(smoke_dataset: Path) -> Panels:
    return make_panels(read_dataset(smoke_dataset)[0])


def test_the_numbers_describe_the_pictures(panels: Panels) -> None:
    n = panels.numbers
    shares = ("here", "guessed", "other_camera", "other_frame", "nobody")
    assert sum(n[f"share_{name}"] for name in shares) == pytest.approx(1.0)
    assert n["share_nobody"] == pytest.approx(np.mean(~panels.known))
    assert n["psnr_corrected"] > n["psnr_rolling"] + 3.0
    known, sky = np.isfinite(panels.depth_error), np.isnan(panels.true_depth)
    assert n["depth_median_m"] == pytest.approx(np.median(panels.depth_error[known]), rel=1e-5)
    assert n["depth_over_2m"] == pytest.approx(np.mean(panels.depth_error[known] > 2.0))
    # The sky has no depth error, but a depth there is invented.
    assert not np.any(known & sky)
    assert n["depth_on_sky"] == pytest.approx(np.mean(np.isinf(panels.depth_error[sky])))
    assert (n["seed"], n["ransac_seed"]) == (1, 0)


def test_panels_survive_storage(panels: Panels, tmp_path: Path) -> None:
    save_panels(tmp_path, panels)
    again = load_panels(tmp_path)
    for name in ("rolling", "corrected", "known", "truth", "true_depth", "depth_error"):
        np.testing.assert_array_equal(getattr(again, name), getattr(panels, name))
    assert again.numbers == pytest.approx(panels.numbers)


def test_equal_panels_give_equal_bytes(panels: Panels, tmp_path: Path) -> None:
    rows = [("castle", panels), ("again", panels)]
    first = {path.name: path.read_bytes() for path in draw_fig4(rows, tmp_path / "fig")}
    second = {path.name: path.read_bytes() for path in draw_fig4(rows, tmp_path / "fig")}
    assert set(first) == {"fig.pdf", "fig.jpg"}
    assert first == second


def test_colours_of_depth_errors_tell_sizes_and_inventions_apart(panels: Panels) -> None:
    """From 1 mm to 2 m brighter and brighter, beyond as at the ends; what is invented has a colour of its own."""
    sizes = np.array([[0.0, 0.001, 0.01, 0.1, 2.0, 50.0, np.inf, np.nan]], dtype=np.float32)
    (row,) = panel_images(replace(panels, depth_error=sizes))[5].astype(int)
    brightness = row[:6].sum(axis=-1)
    assert brightness[0] == brightness[1] < brightness[2] < brightness[3] < brightness[4] == brightness[5]
    assert tuple(row[6]) == INVENTED and tuple(row[7]) == INVALID


def test_agreement_is_grey_and_distortion_is_coloured(panels: Panels) -> None:
    images = panel_images(panels)
    assert len(images) == 6
    colour = [np.ptp(images[k].astype(int), axis=-1)[panels.known].mean() for k in (3, 4)]
    # At 128 x 96 px half of what is left is resampling.
    assert colour[1] < 0.7 * colour[0]


def test_the_caption_has_the_figures(panels: Panels) -> None:
    text = " ".join(caption("castle", panels.numbers))
    assert f"{panels.numbers['psnr_corrected']:.1f} dB after" in text
    assert "1.5 deg and 0.2 m per frame, readout ratio 0.8" in text


def test_the_literal_figure_is_by_the_papers_own_components(smoke_dataset: Path) -> None:
    """One linear solution, plain SIFT, and a frame's own pixels: no other frame's, no guess, no inpainting."""
    options = literal_options(3)
    assert {option: entry.name for option, entry in options.components.items()} == PAPERS
    assert isinstance(options.solver.solver, LinearSolver) and options.motion_model is None and options.seed == 3
    assert not (options.depth_from_motion or options.find_sky or options.inpaint)

    sequence = read_dataset(smoke_dataset)[0]
    (rows, panels), (again, _) = correct_literally(sequence, (0, 1))
    assert [(row["side"], row["frame"]) for row in rows] == list(VIEWS)
    assert {row["ransac_seed"] for row in rows} == {0} and {row["ransac_seed"] for row in again} == {1}
    assert all(row.items() >= PAPERS.items() for row in (*rows, *again))
    first, n = rows[0], panels.numbers
    assert n["share_here"] + n["share_nobody"] == pytest.approx(1.0) and n["share_here"] == first["share_drawn"]
    assert not np.any(panels.corrected[~panels.known])
    drawn = psnr(panels.corrected, sequence.image("gs", "left", 0), panels.known)
    assert first["psnr_drawn"] == n["psnr_corrected"] == pytest.approx(drawn)
    assert first["psnr_all"] == pytest.approx(psnr(panels.corrected, sequence.image("gs", "left", 0)))
    assert "(rs-stereo-linear, sift, sgm, single-view)" in " ".join(caption("castle", n))
    assert "black where nobody saw" in " ".join(caption("castle", n))


def test_the_stored_literal_figures_are_by_the_papers_own_components() -> None:
    text = (Path(__file__).parents[2] / "results" / "fig4" / "literal.csv").read_text("utf-8")
    rows = list(csv.DictReader(text.splitlines()))
    assert {int(row["ransac_seed"]) for row in rows} >= set(range(5)) and len(rows) % len(VIEWS) == 0
    assert all(row.items() >= ({"sequence": "castle"} | PAPERS).items() for row in rows)
