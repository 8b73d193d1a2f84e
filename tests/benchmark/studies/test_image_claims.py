"""Claims about images: verdicts on constructed tables, and a page that is that of the committed results."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
from commands import refused

from rsbench.benchmark.studies.claims import (
    IMAGE_CLAIMS,
    PUBLISHED,
    ImageClaim,
    almost_coincides,
    coincides_literally,
    judge_image_claims,
    motion_on_images,
    sgm_is_accurate,
    stereo_corrects_better,
    verdict,
)
from rsbench.core.errors import RsbenchError
from rsbench.report.claim_pages import image_claims_page

ROOT = Path(__file__).parents[3]


def test_motion_must_be_better_in_both_errors_in_the_median_of_runs() -> None:
    rows = [
        ("gs-8pt", "a", 1.0, 1.0),
        ("gs-8pt", "b", 1.0, 1.0),
        (PUBLISHED[0], "a", 0.5, 0.5),
        (PUBLISHED[0], "a", 0.6, 0.6),
        (PUBLISHED[0], "a", 9.0, 9.0),
        (PUBLISHED[0], "b", 0.5, 2.0),
        (PUBLISHED[1], "a", 2.0, 2.0),
        (PUBLISHED[1], "b", 2.0, 2.0),
    ]
    found = motion_on_images(pd.DataFrame(rows, columns=["solver", "sequence", "e_R_deg", "e_T_deg"]))
    assert [verdict(found[solver][0], "scene") for solver in PUBLISHED] == ["holds only for a", "fails"]


def test_depth_counts_only_with_cameras_in_step() -> None:
    columns = ["delay", "opposite", "error_px", "over_2m"]
    rows = [(0.0, False, 0.05, 0.01), (0.1, False, 3.0, 0.5), (0.0, True, 3.0, 0.5)]
    table = pd.DataFrame(rows, columns=columns).assign(sequence="a", stratum="mild", coverage=0.9)
    assert verdict(sgm_is_accurate(table)["SGM"][0], "scene") == "holds"
    far = table[:1].assign(over_2m=0.06)
    assert verdict(sgm_is_accurate(far)["SGM"][0], "scene") == "fails"


def test_corrected_images_are_averaged_over_views() -> None:
    rows = [("x", "visible", 29.0), ("x", "visible", 32.0), ("true", "visible", 50.0), ("x", "all", 20.0)]
    table = pd.DataFrame(rows, columns=["solver", "pixels", "psnr"])
    found = almost_coincides(table.assign(corrector="fusion", matcher="sgm", sequence="a"))
    assert {who: verdict(checks, "scene") for who, (checks, _) in found.items()} == {
        "x, what the frame saw": "holds",
        "x, all pixels": "fails",
    }


def test_the_literal_reading_averages_the_views_of_each_seed() -> None:
    seeds = pd.DataFrame([(0, 29.0), (0, 32.0), (1, 29.0), (1, 30.5)], columns=["ransac_seed", "psnr_drawn"])
    table = seeds.assign(psnr_visible=seeds["psnr_drawn"], psnr_all=20.0)
    table = table.assign(**{f"psnr_rolling_{pixels}": 22.0 for pixels in ("drawn", "visible", "all")})
    found = coincides_literally(table.assign(solver="a", features="b", matcher="c", corrector="d"))
    assert {who: verdict(checks, "seed") for who, (checks, _) in found.items()} == {
        "a, b, c, d: pixels with depth": "holds only for seed 0",
        "a, b, c, d: what the frame saw": "holds only for seed 0",
        "a, b, c, d: all pixels": "fails",
    }
    assert found["a, b, c, d: pixels with depth"][1] == "30.50, 29.75 dB (uncorrected: 22.00)"


def test_a_gain_needs_an_interval_above_zero() -> None:
    rows = [("mild", 0.55, 0.1, 1.0), ("moderate", 0.45, -0.1, 1.0), ("aggressive", -1.5, -2.0, -1.0)]
    table = pd.DataFrame(rows, columns=["stratum", "gain", "gain_low", "gain_high"])
    both = pd.concat([table.assign(method=method) for method in ("mono", "plane")])
    checks, _ = stereo_corrects_better(both)["against one camera"]
    assert verdict(checks, "stratum") == "holds only for mild; undecided for moderate"


def test_the_page_is_that_of_the_committed_results() -> None:
    results = ROOT / "results"
    stored = (results / "claims" / "images.md").read_text("utf-8")
    page = image_claims_page(judge_image_claims(results))
    assert stored == page, "results changed: rsbench reproduce image-claims"
    for claim in IMAGE_CLAIMS:
        assert f"{claim.text}." in page and claim.rule in page


def test_missing_results_are_named(tmp_path: Path) -> None:
    with pytest.raises(RsbenchError, match=r"pose\.csv: no such table; run: rsbench reproduce images"):
        judge_image_claims(tmp_path)


@pytest.mark.parametrize("claim", IMAGE_CLAIMS, ids=lambda claim: claim.table)
@pytest.mark.parametrize("left", [0, 3, 200])
def test_a_table_that_is_cut_short_is_one_line(tmp_path: Path, claim: ImageClaim, left: int) -> None:
    for other in IMAGE_CLAIMS:
        (tmp_path / other.table).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / other.table).write_bytes((ROOT / "results" / other.table).read_bytes())
    path = tmp_path / claim.table
    path.write_bytes(path.read_bytes()[:left])
    with refused(str(path), "reproduce"):
        judge_image_claims(tmp_path)
