"""Statistics of the correction study: medians over sequences with clustered intervals, and paired differences.

The four views of a sequence share scene, motion and matches, so they count as one: every number is first averaged
over them. Intervals are those of order statistics: sequences differ in their drawn motion, and their scenes are
given. A stratum with as many sequences of each scene has a median that scatters less than that of independent
draws, so its interval holds at least as often as it says; it says nothing of other scenes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from rsbench.benchmark.statistics import median_interval
from rsbench.benchmark.studies.correction_methods import methods_among
from rsbench.core.so3 import FloatArray

EXTRA = ("flip_covered", "flip_all", "ssim_deepunroll", "ssim_uniform")
"""Scores of the first view of a sequence only."""
SCORES = (
    "psnr_covered",
    "ssim_covered",
    "psnr_all",
    "ssim_all",
    "flow_mean_px",
    "flow_median_px",
    "coverage",
    *EXTRA,
)


def numbers_table(numbers: dict[tuple[str, str], dict[str, Any]]) -> pd.DataFrame:
    """One row per card and sequence, of numbers by their name."""
    return pd.DataFrame([{"card": card, "sequence": name, **row} for (card, name), row in numbers.items()])


def by_sequence(images: pd.DataFrame) -> pd.DataFrame:
    """Mean of the views: one row per stratum, sequence and method; ``success`` is the share of views."""
    keys = ["stratum", "sequence", "method"]
    return images[[*keys, *SCORES, "common", "success"]].groupby(keys, as_index=False, sort=False).mean()


def summarise(images: pd.DataFrame) -> pd.DataFrame:
    """One row per stratum and method: median over sequences of each score with its 95 % interval.

    ``gain`` is the paired difference of the covered PSNR, ours minus the method, and ``gain_all`` that of all
    pixels. ``failures`` counts the sequences on which a method failed; they are in the scores, with the worst.
    ``images`` has the rows of ``study_dataset`` and a column ``stratum``.
    """
    table = by_sequence(images)
    rows = []
    for stratum, group in table.groupby("stratum", sort=False):
        ours = group[group["method"] == "ours"].set_index("sequence")
        for method in methods_among(set(group["method"])):
            own = group[group["method"] == method.key].set_index("sequence")
            row: dict[str, Any] = {"stratum": stratum, "method": method.key, "kind": method.kind}
            row |= {"sequences": len(own), "failures": int(np.count_nonzero(own["success"] < 1.0))}
            for score in SCORES:
                row |= _interval(score, own[score].to_numpy())
            for name, score in (("gain", "psnr_covered"), ("gain_all", "psnr_all")):
                row |= _interval(name, (ours[score] - own[score]).dropna().to_numpy())
            rows.append(row)
    return pd.DataFrame(rows)


def masks(images: pd.DataFrame) -> pd.DataFrame:
    """Per stratum, the median and the least share of a view's pixels that every method covers."""
    common = images.groupby(["stratum", "sequence", "side", "frame"], sort=False)["common"].first()
    shares = common.groupby("stratum", sort=False)
    return pd.DataFrame({"median": shares.median(), "least": shares.min()}).reset_index()


def by_scene(images: pd.DataFrame) -> pd.DataFrame:
    """Per stratum, scene and method: ``summarise`` of the scene's sequences.

    A sequence is named after its scene and its seed: ``castle-2``.
    """
    scene = images["sequence"].str.replace(r"-\d+$", "", regex=True)
    parts = []
    for (stratum, name), group in images.groupby([images["stratum"], scene], sort=False):
        table = summarise(group).drop(columns="kind")
        parts.append(table.assign(stratum=str(stratum), scene=str(name)))
    return pd.concat(parts, ignore_index=True)


def by_law(images: pd.DataFrame) -> pd.DataFrame:
    """``summarise`` of sequences of the card ``laws``, a stratum for each law and size of its motions."""
    return summarise(images.assign(stratum=law_and_size(images)))


def law_and_size(table: pd.DataFrame) -> pd.Series:
    """Such as ``twist, moderate`` for each row of a table of sequences of the card ``laws``.

    A sequence is named after its scene, law, size, sensor and seed: ``old-town-twist-moderate-ideal-1``.
    """
    names = table["sequence"].str.rsplit("-", n=4, expand=True)
    return names[1] + ", " + names[2]


def _interval(name: str, values: FloatArray) -> dict[str, float]:
    """Median and its interval; NaN where nothing is known."""
    known = values[np.isfinite(values)]
    if len(known) == 0:
        return {name: np.nan, f"{name}_low": np.nan, f"{name}_high": np.nan}
    low, high = median_interval(known)
    return {name: float(np.median(known)), f"{name}_low": low, f"{name}_high": high}


def summarise_bands(bands: pd.DataFrame) -> pd.DataFrame:
    """Mean flow error, px, over the views of each stratum, method and band of rows."""
    keys = ["stratum", "method", "band"]
    return bands[[*keys, "flow_mean_px"]].groupby(keys, as_index=False, sort=False).mean()


def loss_to_true_motion(images: pd.DataFrame) -> pd.DataFrame:
    """Per stratum, the median and the largest loss in dB of single views to the true motion on the same depth."""
    keys = ["stratum", "sequence", "side", "frame"]
    wide = images.pivot_table(index=keys, columns="method", values="psnr_covered", sort=False)
    loss = (wide["true-motion"] - wide["ours"]).groupby("stratum", sort=False)
    return pd.DataFrame({"median_loss_db": loss.median(), "largest_loss_db": loss.max()}).reset_index()


def verdict(summary: pd.DataFrame) -> pd.DataFrame:
    """Per stratum and baseline: whether ours is better, by separate intervals and by the paired difference."""
    rows = []
    for stratum, group in summary.groupby("stratum", sort=False):
        ours = group[group["method"] == "ours"].iloc[0]
        for _, other in group[group["kind"].isin(["none", "baseline"])].iterrows():
            row: dict[str, Any] = {"stratum": stratum, "method": other["method"]}
            for name, score, gain in (("covered", "psnr_covered", "gain"), ("all", "psnr_all", "gain_all")):
                row[f"{name}_apart"] = bool(ours[f"{score}_low"] > other[f"{score}_high"])
                row[f"{name}_paired"] = bool(other[f"{gain}_low"] > 0.0)
            row["flow_apart"] = bool(ours["flow_median_px_high"] < other["flow_median_px_low"])
            rows.append(row)
    return pd.DataFrame(rows)
