"""The correction study: every way to correct a frame, on the same frames, matches and pixels.

A method is a depth, a motion and a corrector of the chain that users have. Those that know a scene fill what a
frame did not see from the other frames; what remains is invented (inpainted), so that every method gives a whole
picture, which 'all' scores. 'Covered' scores the pixels that every method of a view draws from the frame itself:
nothing there is filled or invented. A method that finds no motion has failed: it scores the worst values, and
takes no pixels from the others. Nor do methods on request, which are compared when they are
asked for: what they do not cover is invented.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.standard_metrics import Flip, Psnr, Ssim
from rsbench.benchmark.studies.correction_bench import Attempt, Bench
from rsbench.benchmark.studies.correction_methods import METHODS
from rsbench.benchmark.studies.resumable_rows import ResumableRows, Row, Rows
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import VIEWS, View
from rsbench.dataset.sequence import Sequence, read_dataset, read_sequence
from rsbench.jobs.isolation import EntryFailure
from rsbench.jobs.process_jobs import finished_jobs
from rsbench.vision.quality import flip, psnr, ssim_deepunroll, ssim_uniform, ssim_within

Mask = NDArray[np.bool_]
ROW_BANDS = 9
"""Bands of rows in which the flow error is reported; their distance from row 0 is the distance in time."""
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
    """Scores of every method on every view, errors by row band, and the motion errors, of all sequences.

    ``solver`` names the solver of "our" motion, of the law that the matches prefer where it takes any. ``step`` is
    called with the name of each sequence done; ``workers`` processes share them, one per core for None. A folder
    ``kept`` holds what is done of a run that is cut off. ``others`` are keys of ``ON_REQUEST`` methods to have
    too. ``among`` tells by its name whether a sequence takes part.

    Raises:
        RsbenchError: the dataset cannot be read, or there is no such solver.
        LostJobsError: see ``finished_jobs``.
    """
    sequences = [sequence for sequence in read_dataset(dataset) if among(sequence.name)]
    found: dict[str, Rows] = {}
    store = (
        None
        if kept is None
        else ResumableRows(folder=kept, dataset=dataset, seed=seed, solver=solver, others=others)
    )
    if store is not None:
        found = {one.name: rows for one in sequences if (rows := store.read(one.name)) is not None}
    for name in found:
        step(name)
    missing = [sequence for sequence in sequences if sequence.name not in found]
    with closing(_studied(missing, dataset, seed, solver, workers, others)) as outcomes:
        for name, rows in outcomes:
            found[name] = rows
            if store is not None:
                store.write(name, rows)
            step(name)
    images, bands, motions = (
        [row for sequence in sequences for row in found[sequence.name][table]] for table in range(3)
    )
    return images, bands, motions


def _studied(
    sequences: list[Sequence],
    dataset: Path,
    seed: int,
    solver: str,
    workers: int | None,
    others: tuple[str, ...],
) -> Generator[tuple[str, Rows], None, None]:
    """Names of sequences with their rows, as they become ready."""
    if workers == 1:
        for sequence in sequences:
            yield sequence.name, study_sequence(sequence, seed, solver, others)
    else:
        names, count = [sequence.name for sequence in sequences], workers or os.cpu_count() or 1
        yield from finished_jobs(_serve, names, count, {}, dataset, seed, solver, others)


def _serve(dataset: Path, seed: int, solver: str, others: tuple[str, ...]) -> Callable[[str], Rows]:
    """What studies sequences by their names, in a child."""

    def study(name: str) -> Rows:
        try:
            return study_sequence(read_sequence(dataset / name), seed, solver, others)
        except RsbenchError as error:
            raise EntryFailure(str(error)) from error

    return study


def study_sequence(
    sequence: Sequence, seed: int = 0, solver: str = "rs-stereo-refined", others: tuple[str, ...] = ()
) -> Rows:
    """What ``study_dataset`` says of one sequence."""
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
    truth, found = sequence.image("gs", *view), _found(attempts)
    common = np.logical_and.reduce([attempt.covered for key, attempt in found.items() if key in _PUBLISHED])
    rows = []
    for key, attempt in attempts.items():
        if attempt is None:
            scores = _worst_scores(truth, view == VIEWS[0] and key in _SLOW)
        else:
            error = flow_error(attempt.flow, found["truth"].flow)
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


def _found(attempts: dict[str, Attempt | None]) -> dict[str, Attempt]:
    """The attempts that did not fail."""
    return {key: attempt for key, attempt in attempts.items() if attempt is not None}


def _worst_scores(image: NDArray[Any], extra: bool) -> dict[str, float]:
    """What a failed method scores on an image: the rule of failures of docs/explanation/conventions.md."""
    scores = {f"{name}_{part}": WORST[name] for part in ("covered", "all") for name in ("psnr", "ssim")}
    scores |= {name: worst_flow(image) for name in ("flow_mean_px", "flow_median_px")}
    slow = {"flip_covered": "flip", "flip_all": "flip", "ssim_deepunroll": "ssim", "ssim_uniform": "ssim"}
    scores |= {name: WORST[kind] if extra else float("nan") for name, kind in slow.items()}
    return scores | {"flow_known": 0.0, "coverage": 0.0}


def worst_flow(image: NDArray[Any]) -> float:
    """The diagonal of an image (H, W[, C]), px: a pixel that stays in the image cannot be farther off."""
    return float(np.hypot(*image.shape[:2]))


def _extra_scores(image: NDArray[Any], truth: NDArray[Any], common: Mask, wanted: bool) -> dict[str, float]:
    """Slow scores, of one view per sequence and some methods: FLIP and SSIM by others' protocols."""
    names = ("flip_covered", "flip_all", "ssim_deepunroll", "ssim_uniform")
    if not wanted:
        return dict.fromkeys(names, float("nan"))
    errors = flip(image, truth)
    if errors is None:
        errors = np.full(common.shape, np.nan)
    covered = float(np.mean(errors[common])) if np.any(common) else float("nan")
    scores = covered, float(np.mean(errors)), ssim_deepunroll(image, truth), ssim_uniform(image, truth)
    return dict(zip(names, scores, strict=True))


def _band_rows(attempts: dict[str, Attempt | None]) -> list[Row]:
    truth, rows = _found(attempts)["truth"], list[Row]()
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
    """End-point error (H, W), px; NaN where either flow is not known."""
    return np.linalg.norm(flow.astype(np.float64) - truth, axis=-1)
