"""Figure 4: panels of a small sequence, stored, drawn, and the numbers under them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rsbench.benchmark.studies.fig4_panels import Panels, load_panels, make_panels, save_panels
from rsbench.dataset.sequence import read_dataset
from rsbench.report.fig4 import INVENTED, caption, depth_scale, draw_fig4, few_colours, panel_images
from rsbench.report.pictures import INVALID


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


def test_ticks_of_depth_are_where_their_colours_are(panels: Panels) -> None:
    scale = depth_scale(panels)
    depths = [float(text.removesuffix(" m")) for text in scale.ticks]
    # Two digits are printed.
    np.testing.assert_allclose(1.0 / np.array(depths), list(scale.ticks.values()), rtol=0.05)
    assert depths == sorted(depths, reverse=True) and scale.low == min(scale.ticks.values())


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


def test_few_colours_are_few_and_near() -> None:
    rng = np.random.default_rng(0)
    smooth = np.clip(np.cumsum(rng.normal(0, 1, (60, 80, 3)), axis=1) + 128, 0, 255).astype(np.uint8)
    reduced = few_colours(smooth)
    assert len(np.unique(reduced.reshape(-1, 3), axis=0)) <= 256
    assert np.mean(np.abs(reduced.astype(int) - smooth)) < 6
