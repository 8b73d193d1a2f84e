"""The report of an evaluation: summary tables and one HTML page with the pictures, from stored results only."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rsbench.benchmark.images.evaluation import read_headings, read_scores
from rsbench.benchmark.images.plan import SCORED, HashOf, hash_of_data
from rsbench.benchmark.images.predict import depth_of, load_disparities
from rsbench.benchmark.images.score import hash_of_prediction, scoring_version
from rsbench.benchmark.images.store import identity_of, keep, kept, read_record
from rsbench.benchmark.statistics import median_and_quartiles
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, View
from rsbench.dataset.corrected_frames import read_origin
from rsbench.dataset.sequence import Sequence, read_pairs
from rsbench.report import pictures
from rsbench.report.markup import rendered
from rsbench.report.pictures import Image
from rsbench.storage.files import (
    HASHES,
    FileHashes,
    load_arrays,
    load_matches,
    read_json,
    read_png,
    write_bytes,
)
from rsbench.storage.work_folder import HIDDEN, files_below, listed, named
from rsbench.vision.fusion import Origin

_LONGEST = 640
"""Width of a picture in the page, px: a shift of two pixels at 900 px remains visible."""
_SHOWN: View = ("left", 1)
"""Frame that is shown."""
_DEPTH_ERROR_M = 2.0
"""Upper end of the scale of depth errors, metres: the paper's limit of a good depth."""

Drawn = dict[str, tuple[Image, str]]


def write_pictures(sequence: Sequence, out: Path, chosen: dict[str, str], hash_of: HashOf) -> dict[str, str]:
    """Write pictures/<sequence>/NAME.jpg below ``out``; returns the captions by NAME.

    Args:
        sequence: sequence with the truth.
        out: folder of the evaluation.
        chosen: names of corrector, solver and matcher whose predictions are drawn.
        hash_of: gives the SHA-256 of a file of the sequence.
    """
    predictions, folder = out / "predictions" / sequence.name, out / "pictures" / sequence.name
    record = out / HIDDEN / "pictures" / f"{sequence.name}.json"
    identity = identity_of(
        code=scoring_version(),
        sequence=sequence.name,
        chosen=chosen,
        data=hash_of_data(sequence, SCORED, hash_of),
        predictions=hash_of_prediction(_files_drawn(predictions, chosen)),
    )

    def jpegs(names: Iterable[str]) -> str:
        return hash_of_prediction([folder / f"{name}.jpg" for name in names])

    there = kept(record, identity)
    if there is not None and there["pictures"] == jpegs(there["captions"]):
        return there["captions"]
    drawn = draw_sequence(sequence, predictions, chosen)
    folder.mkdir(parents=True, exist_ok=True)
    for name, (image, _) in drawn.items():
        write_bytes(folder / f"{name}.jpg", pictures.encode_jpeg(pictures.shrink(image, _LONGEST)))
    captions = {name: caption for name, (_, caption) in drawn.items()}
    keep(record, identity, {"pictures": jpegs(captions), "captions": captions})
    return captions


def _corrected_stem(folder: Path, chosen: dict[str, str]) -> Path:
    return folder / "corrected" / ("+".join(chosen.values()) + f"-{_SHOWN[0]}_{_SHOWN[1]}")


def _files_drawn(folder: Path, chosen: dict[str, str]) -> list[Path]:
    """Files of the predictions that the pictures show."""
    stem, depth = _corrected_stem(folder, chosen), folder / "depth" / f"{chosen['matcher']}.npz"
    corrected = [stem.with_name(f"{stem.name}{end}.png") for end in ("", "-origin")]
    inliers = folder / "motion" / f"{chosen['solver']}-inliers.npz"
    return [folder / "matches.npz", inliers, depth, depth.with_suffix(".json"), *corrected]


def draw_sequence(sequence: Sequence, folder: Path, chosen: dict[str, str]) -> Drawn:
    """Pictures of the left camera's frame 1 for which there are predictions, with their captions, by name."""
    rolling, truth = sequence.image("rs", *_SHOWN), sequence.image("gs", *_SHOWN)
    drawn: Drawn = {
        "rolling": (rolling, "Rolling-shutter frame (left, frame 1); hover: global-shutter truth"),
        "global": (truth, "Global-shutter truth at row 0's pose"),
        "rolling-over-global": (
            pictures.overlay(rolling, truth),
            "Rolling-shutter frame (red) over the truth (cyan): colours show the distortion",
        ),
    }
    return (
        drawn
        | _draw_corrected(folder, chosen, truth)
        | _draw_motion(sequence, folder, chosen)
        | _draw_depth(sequence, folder, chosen["matcher"])
    )


def _draw_corrected(folder: Path, chosen: dict[str, str], truth: Image) -> Drawn:
    stem = _corrected_stem(folder, chosen)
    if not stem.with_name(f"{stem.name}.png").is_file():
        return {}
    size = truth.shape[1], truth.shape[0]
    corrected = read_png(stem.with_name(f"{stem.name}.png"), size)
    mask = read_origin(stem.with_name(f"{stem.name}-origin.png"), size) != Origin.NOBODY
    return {
        "corrected": (
            pictures.masked(corrected, mask),
            "Corrected frame (dark: visible in no frame); hover: global-shutter truth",
        ),
        "corrected-over-global": (
            pictures.overlay(corrected, truth, mask),
            "Corrected frame (red) over the truth (cyan)",
        ),
    }


def _draw_motion(sequence: Sequence, folder: Path, chosen: dict[str, str]) -> Drawn:
    if not (folder / "matches.npz").is_file():
        return {}
    matches = load_matches(folder / "matches.npz").left
    stored = folder / "motion" / f"{chosen['solver']}-inliers.npz"
    inliers = load_arrays(stored).get("left") if stored.is_file() else None
    keep = np.ones(len(matches), dtype=np.bool_)
    if inliers is not None and inliers.shape == keep.shape and inliers.dtype == keep.dtype:
        keep = inliers
    image = pictures.draw_matches(sequence.image("rs", "left", 0), matches, keep)
    return {"matches": (image, "Left matches over time; orange: rejected")}


def _draw_depth(sequence: Sequence, folder: Path, matcher: str) -> Drawn:
    truth = sequence.depth("rs", *_SHOWN)
    surface = truth > 0
    low, high = np.percentile(1.0 / truth[surface], [1, 99]) if np.any(surface) else (0.0, 1.0)

    def inverse(depth: NDArray[np.float32]) -> Image:
        return pictures.colour_map(np.where(depth > 0, 1.0 / np.where(depth > 0, depth, 1.0), np.nan), low, high)

    drawn: Drawn = {"depth-truth": (inverse(truth), "True depth of the rolling-shutter frame")}
    stored = folder / "depth" / f"{matcher}.npz"
    if stored.is_file():
        found = load_disparities(stored, sequence.rig)
        timed = bool((read_record(stored.with_suffix(".json")) or {}).get("timed"))
        depth = depth_of(found[f"{_SHOWN[0]}_{_SHOWN[1]}"], sequence, *_SHOWN, timed=timed)
        error = np.where(surface & (depth > 0), np.abs(depth - truth), np.nan)
        drawn["depth"] = (inverse(depth), f"Depth by {matcher} (dark: invalid)")
        drawn["depth-error"] = (
            pictures.colour_map(error, 0.0, _DEPTH_ERROR_M, "inferno"),
            f"Depth error, 0 to {_DEPTH_ERROR_M:g} m (dark grey: no depth)",
        )
    return drawn


_OVERVIEW = 360
"""Width of a picture in the overview, px."""


@dataclass(frozen=True, kw_only=True)
class SummaryTable:
    """A table for the page, and its most important columns for an 80-column terminal."""

    title: str
    note: str
    frame: pd.DataFrame
    brief: pd.DataFrame


def summary_tables(out: Path) -> list[SummaryTable]:
    """Tables of pose, depth, correction and failures for readers; errors as ``read_scores``."""
    tables = [_pose_table(out), _depth_table(out), _correction_table(out), _failure_table(out)]
    return [table for table in tables if len(table.frame) > 0]


def _pose_table(out: Path) -> SummaryTable:
    scores = read_scores(out, "pose").drop(columns="reason")
    headings = read_headings(out, "pose")
    words = {"data_model": "data", "assumed_model": "assumes", "iterations": "RANSAC"} | headings
    if scores["seed"].nunique() > 1:
        frame, about = _over_seeds(scores, list(headings))
    else:
        order = ["sequence", *[name for name in ("e_R_deg",) if name in scores], "solver"]
        frame, about = scores.sort_values(order).drop(columns="seed"), ""
    note = (
        f"{about}e_R and e_T against the true motion of the rig over one frame period (a monocular solver against "
        "the translation of its own camera); e_s = |log(estimated length / true length)| where a solver claims "
        "metres. A failure scores 180 degrees. 'Data' is the motion model that the data follow, 'assumes' that of "
        "the solver, none for a global shutter. Inliers are among the matches that the solver works on, each "
        "counted once. All solvers ran in the same robust loop on the same matches, of which each takes the sets "
        "that it can use."
    )
    frame = frame.rename(columns=words)
    frame["assumes"] = frame["assumes"].where(frame["shutter"] != "global", "none")
    counts = [name for name in ("runs", "failures") if name in frame]
    brief = frame[["sequence", "solver", "assumes", *headings.values(), "inliers", "matches", *counts]]
    told_first = frame[[*brief, *[name for name in frame if name not in brief]]]
    return SummaryTable(title="Relative pose", note=note, frame=told_first, brief=brief)


def _over_seeds(scores: pd.DataFrame, metrics: list[str]) -> tuple[pd.DataFrame, str]:
    """Medians with quartiles over the runs of each solver, and the note about them."""
    numbers = [*metrics, "inliers", "matches", "iterations"]
    runs = scores.assign(failures=~scores["success"].astype(bool)).groupby(["sequence", "solver"], sort=False)
    medians = runs[numbers].median()
    frame = runs[["shutter", "data_model", "assumed_model", "uses"]].first().join(medians)
    frame = frame.assign(runs=runs.size(), failures=runs["failures"].sum())
    order = ["sequence", *[name for name in ("e_R_deg",) if name in frame], "solver"]
    frame = frame.reset_index().sort_values(order).set_index(["sequence", "solver"])
    for name in metrics:
        frame[name] = runs[name].agg(median_and_quartiles)
    counts = ["inliers", "matches", "iterations"]
    frame[counts] = frame[counts].round().astype(int)
    note = (
        "Median [lower quartile, upper quartile] over the runs of each solver with other RANSAC samples; one "
        "number where the three agree in its digits. "
    )
    return frame.reset_index(), note


def _mean(scores: pd.DataFrame, keys: list[str], numbers: list[str]) -> pd.DataFrame:
    """Mean over the views, and the number of failed views."""
    scores = scores.assign(failures=~scores["success"].astype(bool))
    how = dict.fromkeys(numbers, "mean") | {"failures": "sum"}
    return scores.groupby(keys, as_index=False, sort=False).agg(how)


def _depth_table(out: Path) -> SummaryTable:
    headings = read_headings(out, "depth")
    keys = ["sequence", "matcher", "pixels"]
    frame = _mean(read_scores(out, "depth"), keys, list(headings)).rename(columns=headings)
    note = (
        "Depth of the rolling-shutter pairs against the truth on surface pixels, mean of the four frames: "
        "all of them, those that the other camera sees (visible), and those that it does not. Errors are over "
        "the pixels that have an estimate; coverage is their share. 'On sky' is the share of the pixels without a "
        "surface that the matcher gives a depth; a correction takes those for sky that look like it."
    )
    hidden = {headings.get(name) for name in ("rmse_m", "bad_2px", "bad_3px")} | {"failures"}
    brief = frame[[name for name in frame if name not in hidden]]
    return SummaryTable(title="Depth", note=note, frame=frame, brief=brief)


def _correction_table(out: Path) -> SummaryTable:
    headings = read_headings(out, "correction")
    keys = ["sequence", "corrector", "solver", "matcher"]
    numbers = [*headings, "coverage"]
    scores = _mean(read_scores(out, "correction"), [*keys, "pixels"], numbers).rename(columns=headings)
    shown, every = (scores[scores["pixels"] == name].drop(columns="pixels") for name in ("visible", "all"))
    columns = [*headings.values(), "coverage"]
    wide = shown.merge(
        every[[*keys, *columns]].rename(columns={name: f"{name}, all" for name in columns}), on=keys, how="left"
    )
    frame = wide[[*keys, *columns, *[f"{name}, all" for name in columns], "failures"]]
    frame = frame.rename(columns={"solver": "motion", "matcher": "depth"})
    note = (
        "Corrected frames, as 'rsbench correct' makes them, against the global-shutter image at row 0's pose, "
        "mean of the four frames, on the pixels whose place the rolling-shutter frame saw, and on all. What a "
        "method leaves black counts as black; coverage is the share that it draws. Corrector 'none' is the "
        "rolling-shutter frame itself; rows with true depth or motion are oracles. A failure scores 0 dB."
    )
    brief = frame[["sequence", "corrector", "motion", "depth", *columns]]
    return SummaryTable(title="Correction", note=note, frame=frame, brief=brief)


def _failure_table(out: Path) -> SummaryTable:
    frame = read_scores(out, "failures")
    counted = frame.groupby(["kind", "name", "reason"], as_index=False, sort=False).agg(
        sequences=("sequence", lambda names: ", ".join(sorted(set(names)))), count=("sequence", "size")
    )
    note = "Entries that raised, answered wrongly, took too long or found nothing; each scores the worst value."
    frame = counted[["kind", "name", "count", "sequences", "reason"]]
    return SummaryTable(title="Failures", note=note, frame=frame, brief=frame)


def write_report(dataset: Path, out: Path) -> Path:
    """Write pictures/ and report.html below ``out``; returns the page, which needs no other file."""
    record = read_json(out / "provenance.json")
    try:
        chosen, title = correction_of(record), f"rsbench: {record['inputs']['dataset']}"
        date = str(record["date"])
    except (KeyError, TypeError, ValueError) as error:
        raise RsbenchError(f"{out / 'provenance.json'}: is not that of an evaluation; evaluate again") from error
    sections: list[dict[str, Any]] = []
    hashes = FileHashes(dataset, out / HASHES)
    for sequence in read_pairs(dataset):
        captions = write_pictures(sequence, out, chosen, hashes.sha256)
        sections.append(_section(sequence, out / "pictures" / sequence.name, captions))
    tables = [
        {"title": table.title, "note": table.note, "html": _html(table.frame)} for table in summary_tables(out)
    ]
    page = rendered(
        "evaluation.html.j2",
        title=title,
        subtitle=f"Rolling-shutter stereo evaluation, {date}; pictures: {' + '.join(chosen.values())}",
        tables=tables,
        sections=sections,
        provenance=json.dumps(record, indent=2),
    )
    path = out / "report.html"
    write_bytes(path, page.encode())
    return path


def write_overview(out: Path) -> Path:
    """One picture of all sequences of a report: frame, frame over the truth, corrected frame over the truth."""
    columns = {
        "rolling": "{}: rolling shutter (RS)",
        "rolling-over-global": "RS over truth",
        "corrected-over-global": "corrected over truth",
    }
    rows = []
    for folder in sorted((out / "pictures").iterdir()):
        paths = {text: folder / f"{name}.jpg" for name, text in columns.items()}
        if all(path.is_file() for path in paths.values()):
            images = [
                pictures.label(pictures.shrink(read_png(path), _OVERVIEW), text.format(folder.name))
                for text, path in paths.items()
            ]
            rows.append(np.concatenate(images, axis=1))
    path = out / "overview.jpg"
    write_bytes(path, pictures.encode_jpeg(np.concatenate(rows)))
    return path


def publish(evaluation: Path, out: Path) -> Path:
    """Copy the small files of an evaluation: scores, motions, pictures, an overview and the tables in Markdown.

    Raises:
        RsbenchError: ``out`` contains scores, motions or pictures that the evaluation does not have; nothing is
            removed.
    """
    names = ["provenance.json", *_motions(evaluation), *_files(evaluation, "scores", "pictures")]
    there = _files(out, "scores", "pictures", "predictions")
    if others := sorted(set(there) - set(names)):
        raise RsbenchError(
            f"{out}: holds {named(others)}, which this evaluation has not; move it away, then run it again"
        )
    for name in names:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        write_bytes(out / name, (evaluation / name).read_bytes())
    write_overview(out)
    lines: list[str] = []
    for table in summary_tables(evaluation):
        lines += [f"## {table.title}", "", table.note, "", markdown_table(table.brief), ""]
    path = out / "summary.md"
    write_bytes(path, "\n".join(lines).encode())
    return path


def _files(folder: Path, *parts: str) -> list[str]:
    """Files in some parts of a folder, by their paths below it; without incomplete files of a killed run."""
    there = [part for part in parts if (folder / part).exists()]
    paths = (f"{part}/{path}" for part in there for path in files_below(folder / part))
    return [path for path in paths if not path.endswith(".partial")]


def _motions(evaluation: Path) -> list[str]:
    folders = listed(evaluation / "predictions")
    paths = [path for folder in folders if folder.is_dir() for path in listed(folder / "motion", ".json")]
    return [path.relative_to(evaluation).as_posix() for path in paths]


def markdown_table(frame: pd.DataFrame) -> str:
    """A data frame as a Markdown table; numbers to four significant digits."""

    def cell(value: Any) -> str:
        if isinstance(value, float):
            return "–" if np.isnan(value) else f"{value:.4g}"
        return str(value)

    rows = [[cell(value) for value in row] for row in frame.itertuples(index=False)]
    head = [str(column) for column in frame.columns]
    return "\n".join("| " + " | ".join(row) + " |" for row in [head, ["---"] * len(head), *rows])


def correction_of(record: dict[str, Any]) -> dict[str, str]:
    """Names of the corrector, solver and matcher that an evaluation's pictures show, from its provenance."""
    chosen = {name: str(record["inputs"]["correction"][name]) for name in ("corrector", "solver", "matcher")}
    if any(Path(name).name != name for name in chosen.values()):
        raise ValueError("a path in place of a name: it becomes part of the names of files")
    return chosen


def _section(sequence: Sequence, folder: Path, captions: dict[str, str]) -> dict[str, Any]:
    angle, length = np.rad2deg(np.linalg.norm(sequence.motion.w)), np.linalg.norm(sequence.motion.d)
    rig = sequence.rig
    cameras = [rig.sensor(side) for side in (SIDES[:1] if rig.aligned else SIDES)]
    uris = {name: pictures.jpeg_uri((folder / f"{name}.jpg").read_bytes()) for name in captions}
    shown = [
        {
            "uri": uris[name],
            "other": uris["global"] if name in ("rolling", "corrected") else None,
            "caption": caption,
        }
        for name, caption in captions.items()
        if name != "global"
    ]
    text = (
        f"{' and '.join(f'{each.width} x {each.height} px, f = {each.fx:g} px' for each in cameras)}, "
        f"baseline {rig.baseline:g} m, readout ratio {sequence.shutter.readout_ratio:g}; true motion per frame: "
        f"{angle:.3g} deg, {length:.3g} m ({sequence.motion.name})."
    )
    return {"title": sequence.name, "text": text, "pictures": shown}


def _html(frame: pd.DataFrame) -> str:
    text = frame.to_html(index=False, border=0, justify="unset", na_rep="–", float_format=lambda x: f"{x:.4g}")
    return str(text)
