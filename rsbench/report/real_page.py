"""The page and the picture of the study of real cameras, from its stored tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rsbench.benchmark.statistics import share_interval
from rsbench.benchmark.studies.real_cameras import BEYOND, kept_sequences
from rsbench.report import pages, pictures

_CAMERAS = ("ideal", "real")
_GAP = 8
_LONGEST = 560


def write_real_page(folder: Path, card: dict[str, Any]) -> Path:
    """README.md from motions.csv and summary.csv in ``folder``; ``card`` is that of the real camera's dataset."""
    summary, motions = pd.read_csv(folder / "summary.csv"), pd.read_csv(folder / "motions.csv")
    page = folder / "README.md"
    page.write_text(real_page(summary, motions, card), "utf-8", newline="\n")
    return page


def real_page(summary: pd.DataFrame, motions: pd.DataFrame, card: dict[str, Any]) -> str:
    """The page as Markdown."""
    return pages.markdown(
        "real.md.j2",
        table=_table(summary),
        errors=_errors(summary),
        kept={camera: _kept(motions, camera) for camera in _CAMERAS},
        beyond=BEYOND,
        seeds=int(summary["seeds"].min()),
        camera=card["camera"],
        exposure_ms=1e3 * card["sensor"]["exposure_s"],
        period_ms=1e3 * card["frame_period_s"],
        readout=card["readout_ratio"],
    )


def _kept(motions: pd.DataFrame, camera: str) -> str:
    found = kept_sequences(motions, camera)
    low, high = share_interval(found.kept, found.sequences)
    return f"{found.kept} of {found.sequences} sequences (95 % interval of the share: {low:.2f} to {high:.2f})"


def _pairs(summary: pd.DataFrame) -> list[tuple[str, pd.Series, pd.Series]]:
    """Scene and stratum with the rows of both cameras."""
    found = []
    for (scene, stratum), group in summary.groupby(["scene", "stratum"], sort=False):
        ideal, real = (group[group["camera"] == camera].iloc[0] for camera in _CAMERAS)
        found.append((f"{scene}, {stratum}", ideal, real))
    return found


def _table(summary: pd.DataFrame) -> str:
    lines = [
        "| scene, motion | e_R (deg): ideal, real | e_T (deg): ideal, real | PSNR (dB), ideal: before, after "
        "| real: before, after | real, clean: after | drawn |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, ideal, real in _pairs(summary):
        cells = [name, *(f"{ideal[e]:.3f}, {real[e]:.3f}" for e in ("e_R_deg", "e_T_deg"))]
        cells += [f"{row['psnr_none']:.1f}, {row['psnr_median']:.1f}" for row in (ideal, real)]
        cells += [f"{real['psnr_clean_median']:.1f}", f"{real['coverage']:.1%}"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _errors(summary: pd.DataFrame) -> str:
    lines = [
        "| scene, motion | camera | failed | e_R of the worst seed (deg) | e_T of the worst seed (deg) "
        "| largest error in stated sigmas | PSNR of that seed (dB) |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, *rows in _pairs(summary):
        for row in rows:
            cells = [name, row["camera"], f"{row['failures']} of {row['sequences'] * row['seeds']}"]
            cells += [f"{row['e_R_worst_deg']:.3f}", f"{row['e_T_worst_deg']:.3f}", f"{row['sigmas']:.1f}"]
            cells.append(f"{row['psnr_worst']:.1f}")
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def draw_frames(frames: dict[str, NDArray[np.uint8]], path: Path) -> Path:
    """Pictures of one size side by side, each under its name."""
    small = [pictures.label(pictures.shrink(frame, _LONGEST).copy(), name) for name, frame in frames.items()]
    white = np.full((small[0].shape[0], _GAP, 3), 255, dtype=np.uint8)
    row = [part for image in small for part in (image, white)][:-1]
    path.write_bytes(pictures.encode_jpeg(np.asarray(cv2.hconcat(row), dtype=np.uint8)))
    return path
