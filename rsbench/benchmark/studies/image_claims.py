"""Verdicts on the claims of the paper about images, by rule from stored results."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from rsbench.benchmark.statistics import median_and_quartiles
from rsbench.benchmark.studies.claims import Check, verdict
from rsbench.benchmark.studies.fig4_panels import LITERAL
from rsbench.core.errors import RsbenchError
from rsbench.jobs.isolation import one_line

COINCIDES_DB, ACCURATE_PX, FAR_SHARE = 30.0, 0.1, 0.05
PUBLISHED = ("rs-stereo-linear", "rs-stereo-linear-symmetric")


@dataclass(frozen=True, kw_only=True)
class ImageClaim:
    """A claim, the stored table by which it is judged, and the rule."""

    key: str
    text: str
    table: str
    """Path of the table below the folder of results."""
    rule: str
    check: Callable[[pd.DataFrame], dict[str, tuple[list[Check], str]]]
    """Function that returns checks and figures as text, by the judged solver."""


def motion_on_images(table: pd.DataFrame) -> dict[str, tuple[list[Check], str]]:
    """Per sequence: both errors of a solver below those of gs-8pt (medians where there are several runs)."""
    runs = table.groupby(["solver", "sequence"], sort=False)[["e_R_deg", "e_T_deg"]]
    errors, shown = runs.median(), runs.agg(median_and_quartiles)
    baseline, found = errors.loc["gs-8pt"], dict[str, tuple[list[Check], str]]()
    for solver in PUBLISHED:
        own = errors.loc[solver]
        checks = [Check(str(name), bool((own.loc[name] < baseline.loc[name]).all())) for name in own.index]
        words, others = (_in_degrees(shown.loc[[who]].droplevel("solver")) for who in (solver, "gs-8pt"))
        found[solver] = (checks, f"{words} deg (GS: {others})")
    return found


def _in_degrees(shown: pd.DataFrame) -> str:
    """e_R and e_T of each sequence: median [quartiles]."""
    return "; ".join(f"{name}: {shown.e_R_deg[name]}, {shown.e_T_deg[name]}" for name in shown.index)


def sgm_is_accurate(table: pd.DataFrame) -> dict[str, tuple[list[Check], str]]:
    """Per sequence and motion, cameras in step: median disparity error and share of pixels 2 m off."""
    rows = table[(table["delay"] == 0.0) & ~table["opposite"].astype(bool)].to_dict("records")
    checks = [
        Check(
            f"{row['sequence']} ({row['stratum']})",
            bool(row["error_px"] <= ACCURATE_PX and row["over_2m"] <= FAR_SHARE),
        )
        for row in rows
    ]
    errors, far, known = ([row[name] for row in rows] for name in ("error_px", "over_2m", "coverage"))
    scenes = ", ".join(dict.fromkeys(str(row["sequence"]) for row in rows))
    words = (
        f"{min(errors):.2g} to {max(errors):.2g} px; {100 * min(far):.1f} to {100 * max(far):.1f} % beyond 2 m; "
    )
    words += f"{100 * min(known):.0f} to {100 * max(known):.0f} % of the surface has an estimate ({scenes})"
    return {"SGM": (checks, words)}


def almost_coincides(table: pd.DataFrame) -> dict[str, tuple[list[Check], str]]:
    """Per sequence: PSNR of the corrected views, from estimated motion and SGM depth."""
    rows = table[(table["corrector"] == "fusion") & (table["matcher"] == "sgm") & (table["solver"] != "true")]
    found = {}
    for solver, own in rows.groupby("solver", sort=False):
        for pixels, what in (("visible", "what the frame saw"), ("all", "all pixels")):
            psnr = own[own["pixels"] == pixels].groupby("sequence", sort=False)["psnr"].mean()
            checks = [Check(str(name), bool(value >= COINCIDES_DB)) for name, value in psnr.items()]
            words = "; ".join(f"{name}: {value:.2f} dB" for name, value in psnr.items())
            found[f"{solver}, {what}"] = (checks, words)
    return found


def coincides_literally(table: pd.DataFrame) -> dict[str, tuple[list[Check], str]]:
    """Per RANSAC seed: PSNR of views corrected by the paper's own components, see ``correct_literally``."""
    means = table.groupby("ransac_seed", sort=False)
    by = "; ".join(", ".join(row) for row in table[list(LITERAL)].drop_duplicates().to_numpy())
    found = {}
    for pixels, what in (("drawn", "pixels with depth"), ("visible", "what the frame saw"), ("all", "all pixels")):
        psnr, before = means[f"psnr_{pixels}"].mean(), means[f"psnr_rolling_{pixels}"].mean()
        checks = [Check(f"seed {seed}", bool(value >= COINCIDES_DB)) for seed, value in psnr.items()]
        words = ", ".join(f"{value:.2f}" for value in psnr)
        found[f"{by}: {what}"] = (checks, f"{words} dB (uncorrected: {before.mean():.2f})")
    return found


def stereo_corrects_better(table: pd.DataFrame) -> dict[str, tuple[list[Check], str]]:
    """Per stratum: the paired gain of ours over a method, interval apart from 0; few sequences have none."""
    table = table[table["gain_low"] > float("-inf")]
    found = {}
    for method, name in (("mono", "against one camera"), ("plane", "against one plane")):
        rows = table[table["method"] == method].to_dict("records")
        checks = [Check(row["stratum"], _positive(row["gain_low"], row["gain_high"])) for row in rows]
        words = [f"{r['stratum']}: {r['gain']:.1f} [{r['gain_low']:.1f}, {r['gain_high']:.1f}] dB" for r in rows]
        found[name] = (checks, "; ".join(words))
    return found


def _positive(low: float, high: float) -> bool | None:
    return True if low > 0.0 else False if high < 0.0 else None


IMAGE_CLAIMS = (
    ImageClaim(
        key="motion is estimated well on images",
        text="Section 3.2: with SIFT and RANSAC the solver also estimates the motion well",
        table="images/scores/pose.csv",
        rule="e_R and e_T below those of gs-8pt in the same robust loop on the same images, in each scene",
        check=motion_on_images,
    ),
    ImageClaim(
        key="SGM is accurate on rolling-shutter pairs",
        text="Abstract, sections 2.3 and 3.2: semi-global matching estimates the depth of RS pairs accurately",
        table="sgm/sgm.csv",
        rule=f"cameras in step: median disparity error at most {ACCURATE_PX:g} px, and at most "
        f"{100 * FAR_SHARE:g} % of the pixels with an estimate more than 2 m off, in each sequence and motion",
        check=sgm_is_accurate,
    ),
    ImageClaim(
        key="the corrected image almost coincides",
        text="Section 3.2: the corrected image almost coincides with the GS image, but for borders without depth",
        table="images/scores/correction.csv",
        rule=f"PSNR against the GS image at least {COINCIDES_DB:g} dB in each scene, mean of four views. "
        "Ours: the motion by rs-stereo-refined from sift matches, the depth by sgm and from the motion, and "
        "fusion of the four frames",
        check=almost_coincides,
    ),
    ImageClaim(
        key="the corrected image almost coincides, with the paper's own solver, SIFT and a single view",
        text="Section 3.2: the same, of what the paper describes: its linear solver, SIFT matches, depth by "
        "semi-global matching and each frame corrected by itself",
        table="fig4/literal.csv",
        rule=f"PSNR against the GS image at least {COINCIDES_DB:g} dB in the castle, mean of four views, with "
        "each of the RANSAC seeds. Figures in the order of the seeds",
        check=coincides_literally,
    ),
    ImageClaim(
        key="stereo corrects without assumptions about the scene",
        text="Abstract and section 2.3: stereo depth replaces assumptions, and corrects better than one camera",
        table="correction/summary.csv",
        rule="paired gain in PSNR of covered pixels over sequences, median with its 95 % interval above 0, in "
        "each stratum. Ours: the motion by rs-stereo-refined from sift-refined matches, the depth by sgm and from "
        "the motion, and fusion of the four frames",
        check=stereo_corrects_better,
    ),
)


def judge_image_claims(results: Path) -> pd.DataFrame:
    """One row per claim and judged solver: verdict and figures.

    Raises:
        RsbenchError: a table is missing or damaged.
    """
    rows = []
    for claim in IMAGE_CLAIMS:
        path = results / claim.table
        target = claim.table.partition("/")[0]
        if not path.is_file():
            raise RsbenchError(f"{path}: no such table; run: rsbench reproduce {target}")
        try:
            content = path.read_text("utf-8")
            if not content.endswith("\n"):
                raise ValueError("the last line has no end")
            found = claim.check(pd.read_csv(io.StringIO(content)))
        except (KeyError, ValueError) as error:  # no such column or row; no table
            raise RsbenchError(
                f"{path}: cut short, or another version's ({one_line(error)}); run: rsbench reproduce {target}"
            ) from error
        for who, (checks, words) in found.items():
            rows.append({"claim": claim.key, "who": who, "verdict": verdict(checks, "scene"), "figures": words})
    return pd.DataFrame(rows)
