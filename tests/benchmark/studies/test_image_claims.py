"""Claims about images: verdicts on constructed tables, and a page that is that of the committed results."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
from commands import refused

from rsbench.benchmark.studies.claims import verdict
from rsbench.benchmark.studies.image_claims import (
    IMAGE_CLAIMS,
    PUBLISHED,
    ImageClaim,
    almost_coincides,
    coincides_literally,
    judge_image_claims,
    motion_on_images,
    sgm_is_accurate,
    stereo_corrects_better,
)
from rsbench.core.errors import RsbenchError
from rsbench.report.claim_pages import image_claims_page

ROOT = Path(__file__).parents[3]


def test_motion_must_be_better_in_both_errors_in_the_median_of_runs() -> None:
    rows = [
        {"solver": solver, "sequence": scene, "e_R_deg": e_R, "e_T_deg": e_T}
        for solver, scene, e_R, e_T in (
            ("gs-8pt", "a", 1.0, 1.0),
            ("gs-8pt", "b", 1.0, 1.0),
            (PUBLISHED[0], "a", 0.5, 0.5),
            (PUBLISHED[0], "a", 0.6, 0.6),
            (PUBLISHED[0], "a", 9.0, 9.0),
            (PUBLISHED[0], "b", 0.5, 2.0),
            (PUBLISHED[1], "a", 2.0, 2.0),
            (PUBLISHED[1], "b", 2.0, 2.0),
        )
    ]
    found = motion_on_images(pd.DataFrame(rows))
    assert [verdict(found[solver][0], "scene") for solver in PUBLISHED] == ["holds only for a", "fails"]


def test_depth_counts_only_with_cameras_in_step() -> None:
    rows = [
        {
            "sequence": "a",
            "stratum": "mild",
            "delay": d,
            "opposite": o,
            "error_px": e,
            "over_2m": f,
            "coverage": 0.9,
        }
        for d, o, e, f in ((0.0, False, 0.05, 0.01), (0.1, False, 3.0, 0.5), (0.0, True, 3.0, 0.5))
    ]
    ((checks, _),) = sgm_is_accurate(pd.DataFrame(rows)).values()
    assert verdict(checks, "scene") == "holds"
    far = pd.DataFrame([rows[0] | {"over_2m": 0.06}])
    assert verdict(sgm_is_accurate(far)["SGM"][0], "scene") == "fails"


def test_corrected_images_are_averaged_over_views() -> None:
    rows = [
        {"corrector": "fusion", "solver": s, "matcher": "sgm", "sequence": "a", "pixels": "visible", "psnr": p}
        for s, p in (("x", 29.0), ("x", 32.0), ("true", 50.0))
    ]
    found = almost_coincides(pd.DataFrame([*rows, rows[0] | {"pixels": "all", "psnr": 20.0}]))
    assert {who: verdict(checks, "scene") for who, (checks, _) in found.items()} == {
        "x, what the frame saw": "holds",
        "x, all pixels": "fails",
    }


def test_the_literal_reading_averages_the_views_of_each_seed() -> None:
    names = {"solver": "a", "features": "b", "matcher": "c", "corrector": "d"}
    pixels = ("drawn", "visible", "all")
    rows = [
        names
        | {"ransac_seed": seed}
        | {f"psnr_rolling_{p}": 22.0 for p in pixels}
        | {f"psnr_{p}": db for p in pixels}
        for seed, db in ((0, 29.0), (0, 32.0), (1, 29.0), (1, 30.5))
    ]
    found = coincides_literally(pd.DataFrame([row | {"psnr_all": 20.0} for row in rows]))
    assert {who: verdict(checks, "seed") for who, (checks, _) in found.items()} == {
        "a, b, c, d: pixels with depth": "holds only for seed 0",
        "a, b, c, d: what the frame saw": "holds only for seed 0",
        "a, b, c, d: all pixels": "fails",
    }
    assert found["a, b, c, d: pixels with depth"][1] == "30.50, 29.75 dB (uncorrected: 22.00)"


def test_a_gain_needs_an_interval_above_zero() -> None:
    gains = (("mild", 0.1, 1.0), ("moderate", -0.1, 1.0), ("aggressive", -2.0, -1.0))
    rows = [
        {"method": method, "stratum": s, "gain": (low + high) / 2, "gain_low": low, "gain_high": high}
        for method in ("mono", "plane")
        for s, low, high in gains
    ]
    checks, _ = stereo_corrects_better(pd.DataFrame(rows))["against one camera"]
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
