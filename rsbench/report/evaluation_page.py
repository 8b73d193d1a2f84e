"""The report of an evaluation: summary tables and one HTML page with the pictures, from stored results only."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from rsbench.benchmark.images.evaluation import read_scores
from rsbench.benchmark.images.predict import depth_of
from rsbench.dataset.files import load_arrays, load_matches, read_json, read_png, write_bytes
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.report import pictures
from rsbench.report.pictures import Image

_LONGEST = 640
"""Pixels of a picture in the page; enough to see a shift of two pixels at 900."""
_OVERVIEW = 360
"""Pixels of a picture in the overview."""
_DEPTH_ERROR_M = 2.0
"""End of the scale of depth errors: the paper's limit of a good depth."""


@dataclass(frozen=True, kw_only=True)
class SummaryTable:
    """A table for the page, and its most telling columns for an 80-column terminal."""

    title: str
    note: str
    frame: pd.DataFrame
    brief: pd.DataFrame


def summary_tables(out: Path) -> list[SummaryTable]:
    """Pose, depth and correction in the form that people read; errors as ``read_scores``."""
    return [_pose_table(out), _depth_table(out), _correction_table(out)]


def _pose_table(out: Path) -> SummaryTable:
    scores = read_scores(out, "pose").sort_values(["sequence", "e_R_deg", "solver"])
    columns = {
        "sequence": "sequence",
        "solver": "solver",
        "shutter": "shutter",
        "uses": "uses",
        "success": "success",
        "e_R_deg": "e_R (deg)",
        "e_T_deg": "e_T (deg)",
        "e_s": "e_s",
        "inliers": "inliers",
        "iterations": "RANSAC",
    }
    note = (
        "e_R and e_T against the true motion of the rig over one frame period (a monocular solver against the "
        "translation of its own camera); e_s = |log(estimated length / true length)| where a solver claims "
        "metres. A failure scores 180 degrees. All solvers had the same matches, sampler and budget."
    )
    frame = scores[list(columns)].rename(columns=columns)
    brief = frame[["sequence", "solver", "e_R (deg)", "e_T (deg)", "e_s", "inliers"]]
    return SummaryTable(title="Relative pose", note=note, frame=frame, brief=brief)


def _depth_table(out: Path) -> SummaryTable:
    scores = read_scores(out, "depth")
    mean = (
        scores.drop(columns=["side", "frame"]).groupby(["sequence", "pixels"], as_index=False, sort=False).mean()
    )
    note = (
        "SGM depth of the rolling-shutter pairs against the truth on surface pixels, mean of the four frames: "
        "all of them, those that the other camera sees (visible), and those that it does not."
    )
    names = {"median_m": "median (m)", "over_2m": "> 2 m", "bad_1px": "> 1 px", "coverage": "coverage"}
    brief = mean[["sequence", "pixels", *names]].rename(columns=names)
    return SummaryTable(title="Depth (SGM)", note=note, frame=mean, brief=brief)


def _correction_table(out: Path) -> SummaryTable:
    scores = read_scores(out, "correction")
    names = {
        "psnr": "PSNR (dB)",
        "psnr_uncorrected": "uncorrected",
        "ssim": "SSIM",
        "ssim_uncorrected": "uncorrected ",
        "psnr_common": "PSNR, common pixels",
        "coverage": "coverage",
    }
    mean = scores.groupby(["sequence", "depth", "motion"], as_index=False)[list(names)].mean()
    note = (
        "Corrected frames against the global-shutter image at row 0's pose, mean of the four frames, on the "
        "pixels that the method covers; 'uncorrected' is the rolling-shutter frame on the same pixels. Common "
        "pixels are those that all methods of a frame cover. Rows with true depth or motion are oracles."
    )
    frame = mean.rename(columns=names)
    brief = frame[["sequence", "depth", "motion", "PSNR (dB)", "uncorrected", "SSIM", "coverage"]]
    return SummaryTable(title="Correction", note=note, frame=frame, brief=brief)


def write_report(dataset: Path, out: Path) -> Path:
    """Write pictures/ and report.html below ``out``; returns the page, which needs no other file."""
    record = read_json(out / "provenance.json")
    solver = record["inputs"]["correction_solver"]
    sections = []
    for sequence in read_dataset(dataset):
        drawn = draw_sequence(sequence, out / "predictions" / sequence.name, solver)
        folder = out / "pictures" / sequence.name
        folder.mkdir(parents=True, exist_ok=True)
        for name, (image, _) in drawn.items():
            write_bytes(folder / f"{name}.jpg", pictures.encode_jpeg(pictures.shrink(image, _LONGEST)))
        sections.append(_section(sequence, folder, drawn))
    environment = Environment(
        loader=PackageLoader("rsbench.report"),
        autoescape=select_autoescape(["html", "j2"]),
        undefined=StrictUndefined,
    )
    tables = [
        {"title": table.title, "note": table.note, "html": _html(table.frame)} for table in summary_tables(out)
    ]
    page = environment.get_template("evaluation.html.j2").render(
        title=f"rsbench: {record['inputs']['dataset']}",
        subtitle=f"Rolling-shutter stereo evaluation, {record['date']}; correction with {solver} and SGM depth",
        tables=tables,
        sections=sections,
        provenance=json.dumps(record, indent=2),
    )
    path = out / "report.html"
    write_bytes(path, page.encode())
    return path


def write_overview(out: Path) -> Path:
    """One picture of all sequences of a report: frame, frame over the truth, corrected frame over the truth."""
    columns = ("rolling", "rolling-over-global", "corrected-over-global")
    rows = []
    for folder in sorted((out / "pictures").iterdir()):
        images = [read_png(folder / f"{name}.jpg") for name in columns if (folder / f"{name}.jpg").is_file()]
        if len(images) == len(columns):
            rows.append(np.concatenate([pictures.shrink(image, _OVERVIEW) for image in images], axis=1))
    path = out / "overview.jpg"
    write_bytes(path, pictures.encode_jpeg(np.concatenate(rows)))
    return path


def publish(evaluation: Path, out: Path) -> Path:
    """Copy what is small of an evaluation: scores, motions, pictures, an overview and the tables in Markdown."""
    for name in ("scores", "pictures", "provenance.json", *_motions(evaluation)):
        source, target = evaluation / name, out / name
        if target.is_dir():
            shutil.rmtree(target)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(source, target) if source.is_dir() else shutil.copyfile(source, target)
    write_overview(out)
    lines = []
    for table in summary_tables(evaluation):
        lines += [f"## {table.title}", "", table.note, "", markdown_table(table.brief), ""]
    path = out / "summary.md"
    write_bytes(path, "\n".join(lines).encode())
    return path


def _motions(evaluation: Path) -> list[str]:
    paths = sorted(evaluation.glob("predictions/*/motion/*.json"))
    return [str(path.relative_to(evaluation)) for path in paths]


def markdown_table(frame: pd.DataFrame) -> str:
    """A data frame as a Markdown table; numbers to four significant digits."""

    def cell(value: Any) -> str:
        if isinstance(value, float):
            return "–" if np.isnan(value) else f"{value:.4g}"
        return str(value)

    rows = [[cell(value) for value in row] for row in frame.itertuples(index=False)]
    head = [str(column) for column in frame.columns]
    return "\n".join("| " + " | ".join(row) + " |" for row in [head, ["---"] * len(head), *rows])


Drawn = dict[str, tuple[Image, str]]


def draw_sequence(sequence: Sequence, folder: Path, solver: str) -> Drawn:
    """Pictures of the left camera's frame 1: name to image and caption."""
    side, frame = "left", 1
    rolling, truth = sequence.image("rs", "left", frame), sequence.image("gs", "left", frame)
    true_depth = sequence.depth("rs", "left", frame)
    depth = depth_of(load_arrays(folder / "disparity.npz")[f"{side}_{frame}"], sequence.rig)
    surface = true_depth > 0
    low, high = np.percentile(1.0 / true_depth[surface], [1, 99]) if np.any(surface) else (0.0, 1.0)
    error = np.where(surface & (depth > 0), np.abs(depth - true_depth), np.nan)
    drawn: Drawn = {
        "rolling": (rolling, "Rolling-shutter frame (left, frame 1); hover: global-shutter truth"),
        "global": (truth, "Global-shutter truth at row 0's pose"),
        "rolling-over-global": (
            pictures.overlay(rolling, truth),
            "Rolling-shutter frame (red) over the truth (cyan): colour is distortion",
        ),
    }
    corrected_path = folder / "corrected" / f"{side}_{frame}.png"
    if corrected_path.is_file():
        corrected = read_png(corrected_path)
        mask = read_png(folder / "corrected" / f"{side}_{frame}_mask.png")[..., 0] > 0
        drawn["corrected"] = (
            pictures.masked(corrected, mask),
            "Corrected frame (dark: not seen or no depth); hover: global-shutter truth",
        )
        drawn["corrected-over-global"] = (
            pictures.overlay(corrected, truth, mask),
            "Corrected frame (red) over the truth (cyan)",
        )
    matches = load_matches(folder / "matches.npz")
    drawn["matches"] = (
        _draw_matches(sequence, matches.left, folder, solver),
        "Left matches over time; red: rejected",
    )
    inverse = [np.where(d > 0, 1.0 / np.where(d > 0, d, 1.0), np.nan) for d in (true_depth, depth)]
    drawn["depth-truth"] = (pictures.colour_map(inverse[0], low, high), "True depth of the rolling-shutter frame")
    drawn["depth-sgm"] = (pictures.colour_map(inverse[1], low, high), "SGM depth (dark: invalid)")
    drawn["depth-error"] = (
        pictures.colour_map(error, 0.0, _DEPTH_ERROR_M, "inferno"),
        f"Depth error, 0 to {_DEPTH_ERROR_M:g} m (dark grey: no depth)",
    )
    return drawn


def _draw_matches(sequence: Sequence, matches: Any, folder: Path, solver: str) -> Image:
    image = sequence.image("rs", "left", 0)
    name = read_json(folder / "motion" / f"{solver}.json")["solver"]
    inliers = load_arrays(folder / "motion" / f"{name}-inliers.npz").get("left")
    keep = np.ones(len(matches), dtype=np.bool_) if inliers is None or len(inliers) != len(matches) else inliers
    return pictures.draw_matches(image, matches, keep)


def _section(sequence: Sequence, folder: Path, drawn: Drawn) -> dict[str, Any]:
    angle, length = np.rad2deg(np.linalg.norm(sequence.motion.w)), np.linalg.norm(sequence.motion.d)
    camera = sequence.rig.camera
    hover = {"rolling": "global", "corrected": "global"}
    shown = [
        {
            "uri": pictures.data_uri(folder / f"{name}.jpg"),
            "other": pictures.data_uri(folder / f"{hover[name]}.jpg") if name in hover else None,
            "caption": caption,
        }
        for name, (_, caption) in drawn.items()
        if name != "global"
    ]
    text = (
        f"{camera.width} x {camera.height} px, f = {camera.fx:g} px, baseline {sequence.rig.baseline:g} m, "
        f"readout ratio {sequence.shutter.readout_ratio:g}; true motion per frame: {angle:.3g} deg, "
        f"{length:.3g} m ({sequence.motion.name})."
    )
    return {"title": sequence.name, "text": text, "pictures": shown}


def _html(frame: pd.DataFrame) -> str:
    text = frame.to_html(index=False, border=0, justify="unset", na_rep="–", float_format=lambda x: f"{x:.4g}")
    return str(text)
