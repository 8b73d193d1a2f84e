"""The correction study: all correctors on the same frames, matches and pixels.

A method combines a depth, a motion and a corrector of the chain. Methods with depth and motion fill pixels that
are not visible in a frame from the other frames; the remaining pixels are inpainted, so that every method gives a
complete image. 'All' scores the complete image. 'Covered' scores the pixels that every method draws from the frame
itself, without filling or inpainting. A method that finds no motion gets the worst scores and does not reduce the
covered pixels of the others; neither do the optional methods (``ON_REQUEST``).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rsbench.benchmark.images.store import resumed
from rsbench.benchmark.standard_metrics import Flip, Psnr, Ssim
from rsbench.benchmark.statistics import median_interval, with_ends
from rsbench.benchmark.studies.correction_bench import (
    METHODS,
    Attempt,
    Bench,
    Row,
    Rows,
    methods_among,
    rows_identity,
)
from rsbench.core.rig import VIEWS, View
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import Sequence, read_dataset, read_sequence
from rsbench.jobs.process_jobs import finished_jobs
from rsbench.vision.quality import flip, psnr, ssim_deepunroll, ssim_uniform, ssim_within

EXTRA = ("flip_covered", "flip_all", "ssim_deepunroll", "ssim_uniform")
"""Scores that are computed for the first view of a sequence only."""
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


def by_sequence(images: pd.DataFrame) -> pd.DataFrame:
    """Average the scores over views: one row per stratum, sequence and method; ``success`` is a share of views."""
    keys = ["stratum", "sequence", "method"]
    return images[[*keys, *SCORES, "common", "success"]].groupby(keys, as_index=False, sort=False).mean()


def summarise(images: pd.DataFrame) -> pd.DataFrame:
    """Return one row per stratum and method: the median of each score over sequences and its 95 % interval.

    ``gain`` is the paired difference of the covered PSNR, ours minus the method; ``gain_all`` is that over all
    pixels. ``failures`` counts the sequences in which a method failed; these have the worst scores.
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
    """Return, per stratum, the median and minimum over views of the share of pixels that all methods cover."""
    common = images.groupby(["stratum", "sequence", "side", "frame"], sort=False)["common"].first()
    shares = common.groupby("stratum", sort=False)
    return pd.DataFrame({"median": shares.median(), "least": shares.min()}).reset_index()


def by_scene(images: pd.DataFrame) -> pd.DataFrame:
    """Return ``summarise`` for the sequences of each scene: one row per stratum, scene and method.

    A sequence is named after its scene and its seed: ``castle-2``.
    """
    scene = images["sequence"].str.replace(r"-\d+$", "", regex=True)
    parts = []
    for (stratum, name), group in images.groupby([images["stratum"], scene], sort=False):
        table = summarise(group).drop(columns="kind")
        parts.append(table.assign(stratum=str(stratum), scene=str(name)))
    return pd.concat(parts, ignore_index=True)


def by_law(images: pd.DataFrame) -> pd.DataFrame:
    """Return ``summarise`` for sequences of the card ``laws``; each motion model and size is a stratum."""
    return summarise(images.assign(stratum=law_and_size(images)))


def law_and_size(table: pd.DataFrame) -> pd.Series:
    """Return a text such as ``twist, moderate`` for each row of a table of sequences of the card ``laws``.

    A sequence is named after its scene, motion model, size, sensor and seed: ``old-town-twist-moderate-ideal-1``.
    """
    names = table["sequence"].str.rsplit("-", n=4, expand=True)
    return names[1] + ", " + names[2]


def _interval(name: str, values: FloatArray) -> dict[str, float]:
    """Return the median of the finite values and its interval; NaN if no value is finite."""
    known = values[np.isfinite(values)]
    if len(known) == 0:
        return with_ends(name, np.nan, np.nan, np.nan)
    return with_ends(name, float(np.median(known)), *median_interval(known))


def summarise_bands(bands: pd.DataFrame) -> pd.DataFrame:
    """Average the flow error, px, over the views of each stratum, method and band of rows."""
    keys = ["stratum", "method", "band"]
    return bands[[*keys, "flow_mean_px"]].groupby(keys, as_index=False, sort=False).mean()


def loss_to_true_motion(images: pd.DataFrame) -> pd.DataFrame:
    """Return, per stratum, the median and the maximum over views of the PSNR lost, dB, relative to a correction
    with the true motion and the same depth."""
    keys = ["stratum", "sequence", "side", "frame"]
    wide = images.pivot_table(index=keys, columns="method", values="psnr_covered", sort=False)
    loss = (wide["true-motion"] - wide["ours"]).groupby("stratum", sort=False)
    return pd.DataFrame({"median_loss_db": loss.median(), "largest_loss_db": loss.max()}).reset_index()


def verdict(summary: pd.DataFrame) -> pd.DataFrame:
    """Return, per stratum and baseline, whether ours is better by disjoint intervals and by paired differences."""
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


Mask = NDArray[np.bool_]
ROW_BANDS = 9
"""Number of bands of rows for which the flow error is reported; later bands are farther from the time of row 0."""
WORST = {column.name: column.worst for metric in (Psnr, Ssim, Flip) for column in metric.columns}
"""Scores of a failure, as in the score tables."""
_PUBLISHED = {method.key for method in METHODS}
_SLOW = {method.key for method in METHODS if method.slow_scores}


def study_dataset(
    dataset: Path,
    step: Callable[[str], None],
    seed: int = 0,
    solver: str = "rs-stereo-refined",
    workers: int | None = 1,
    kept: Path | None = None,
    others: tuple[str, ...] = (),
    among: Callable[[str], bool] = bool,
) -> Rows:
    """Compute scores of every method on every view, errors by row band, and motion errors, for all sequences.

    ``solver`` names the solver of "our" motion; if it supports several motion models, the one that fits best is
    used. ``step`` is called with the name of each finished sequence. ``workers`` is the number of
    processes; None: one per core. Finished sequences are stored in the folder ``kept``, so that an interrupted run
    can be resumed. ``others`` are keys of additional ``ON_REQUEST`` methods. ``among`` selects sequences by name.

    Raises:
        RsbenchError: the dataset cannot be read, or the solver does not exist.
        LostJobsError: see ``finished_jobs``.
    """
    sequences = {each.name: each for each in read_dataset(dataset) if among(each.name)}
    places = dict[str, tuple[Path, str]]()
    if kept is not None:
        options = {"seed": seed, "solver": solver, "others": others}
        places = {name: (kept / f"{name}.json", rows_identity(dataset, name, **options)) for name in sequences}

    def study(missing: list[str]) -> Generator[tuple[str, Rows], None, None]:
        if workers == 1:
            yield from ((name, study_sequence(sequences[name], seed, solver, others)) for name in missing)
        else:
            count = workers or os.cpu_count() or 1
            yield from finished_jobs(_serve, missing, count, {}, dataset, seed, solver, others)

    found: dict[str, Rows] = resumed(list(sequences), places, study, step)
    images, bands, motions = ([row for name in sequences for row in found[name][table]] for table in range(3))
    return images, bands, motions


def _serve(dataset: Path, seed: int, solver: str, others: tuple[str, ...]) -> Callable[[str], Rows]:
    """Return the function that a child process calls to score a sequence, given its name."""
    return lambda name: study_sequence(read_sequence(dataset / name), seed, solver, others)


def study_sequence(
    sequence: Sequence, seed: int = 0, solver: str = "rs-stereo-refined", others: tuple[str, ...] = ()
) -> Rows:
    """Return the rows of ``study_dataset`` for one sequence."""
    bench = Bench(sequence, seed, solver)
    attempts = {key: bench.attempt(key) for key in (*(method.key for method in METHODS), *others)}
    images: list[Row] = []
    bands: list[Row] = []
    for view in VIEWS:
        found = {key: None if attempt is None else attempt.get(view) for key, attempt in attempts.items()}
        identity = {"sequence": sequence.name, "side": view[0], "frame": view[1]}
        images += [identity | row for row in _image_rows(sequence, view, found)]
        bands += [identity | row for row in _band_rows(found)]
    return images, bands, [{"sequence": sequence.name, **bench.motion_errors()}]


def _image_rows(sequence: Sequence, view: View, attempts: dict[str, Attempt | None]) -> list[Row]:
    truth, true = sequence.image("gs", *view), attempts["truth"]
    assert true is not None
    published = [attempts[key] for key in attempts if key in _PUBLISHED]
    common = np.logical_and.reduce([attempt.covered for attempt in published if attempt is not None])
    rows = []
    for key, attempt in attempts.items():
        if attempt is None:
            scores = _worst_scores(truth, view == VIEWS[0] and key in _SLOW)
        else:
            error = flow_error(attempt.flow, true.flow)
            known = np.isfinite(error)
            ssim_covered, ssim_all = ssim_within(attempt.image, truth, (common, None))
            scores = {
                "psnr_covered": psnr(attempt.image, truth, common),
                "ssim_covered": ssim_covered,
                "psnr_all": psnr(attempt.image, truth),
                "ssim_all": ssim_all,
                "flow_mean_px": float(np.mean(error[known])) if np.any(known) else float("nan"),
                "flow_median_px": float(np.median(error[known])) if np.any(known) else float("nan"),
                "flow_known": float(np.mean(known)),
                "coverage": float(np.mean(attempt.covered)),
                **_extra_scores(attempt.image, truth, common, view == VIEWS[0] and key in _SLOW),
            }
        rows.append({"method": key, "success": attempt is not None, **scores, "common": float(np.mean(common))})
    return rows


def _worst_scores(image: NDArray[Any], extra: bool) -> dict[str, float]:
    """Return the scores of a failed method on an image, as defined in docs/explanation/conventions.md."""
    scores = {f"{name}_{part}": WORST[name] for part in ("covered", "all") for name in ("psnr", "ssim")}
    scores |= {name: worst_flow(image) for name in ("flow_mean_px", "flow_median_px")}
    slow = {"flip_covered": "flip", "flip_all": "flip", "ssim_deepunroll": "ssim", "ssim_uniform": "ssim"}
    scores |= {name: WORST[kind] if extra else float("nan") for name, kind in slow.items()}
    return scores | {"flow_known": 0.0, "coverage": 0.0}


def worst_flow(image: NDArray[Any]) -> float:
    """Return the diagonal of an image (H, W[, C]), px: the largest flow error between pixels of the image."""
    return float(np.hypot(*image.shape[:2]))


def _extra_scores(image: NDArray[Any], truth: NDArray[Any], common: Mask, wanted: bool) -> dict[str, float]:
    """Compute FLIP and the SSIM of other protocols if ``wanted``, else NaN; they are slow."""
    if not wanted:
        return dict.fromkeys(EXTRA, float("nan"))
    errors = flip(image, truth)
    if errors is None:
        errors = np.full(common.shape, np.nan)
    covered = float(np.mean(errors[common])) if np.any(common) else float("nan")
    scores = covered, float(np.mean(errors)), ssim_deepunroll(image, truth), ssim_uniform(image, truth)
    return dict(zip(EXTRA, scores, strict=True))


def _band_rows(attempts: dict[str, Attempt | None]) -> list[Row]:
    truth, rows = attempts["truth"], list[Row]()
    assert truth is not None
    for key, attempt in attempts.items():
        error = np.full(truth.covered.shape, worst_flow(truth.image))
        if attempt is not None:
            error = flow_error(attempt.flow, truth.flow)
        for band, part in enumerate(np.array_split(error, ROW_BANDS)):
            known = np.isfinite(part)
            mean = float(np.mean(part[known])) if np.any(known) else float("nan")
            rows.append({"method": key, "band": band, "flow_mean_px": mean})
    return rows


def flow_error(flow: NDArray[np.float32], truth: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the end-point error (H, W), px; NaN where one of the flows is unknown."""
    return np.linalg.norm(flow.astype(np.float64) - truth, axis=-1)
