"""Pages of results on points: recorded trajectories, and the comparison of public with held-out splits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from rsbench.benchmark.leaderboard.board import Scored
from rsbench.benchmark.leaderboard.deviations import calibration, named_numbers
from rsbench.benchmark.leaderboard.standings import Standing, standings
from rsbench.benchmark.leaderboard.track import ORACLE, Split
from rsbench.benchmark.leaderboard.tracks import track_of_id
from rsbench.benchmark.statistics import COVERAGE, format_interval, median_interval, share_interval, with_ends
from rsbench.capture.hypotheses import MODELS
from rsbench.core.so3 import FloatArray
from rsbench.report.markup import frame_text, words_of
from rsbench.storage.files import write_bytes

SPLINE = "continuous"
"""The choice if no motion model fits."""
LIMITS = (0.0, 1.0, 3.0, 10.0, np.inf)
"""Limits of classes of deviations from constant angular velocity, in standard deviations of a match's noise."""
_UNKNOWNS = 6


def by_recording(entries: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """A row for each entry and recording: median errors and coverage of stated covariances, with intervals.

    Args:
        entries: tables of scores by the name of the entry; all have the same problems.
    """
    return pd.DataFrame(
        {"method": name, "recording": recording, "problems": len(part), **_numbers(part)}
        for name, scores in entries.items()
        for recording, part in scores.groupby("recording")
    )


def choices(split: Split, entries: Mapping[str, pd.DataFrame], method: str) -> pd.DataFrame:
    """A row for each problem: chosen model, errors, and deviation of the motion from constant angular velocity.

    ``departure_px`` is the largest angle, over the rows, between the true pose and that of a rotation by the true
    w at constant speed, times the focal length.
    """
    scores = entries[method][["problem", "recording", "chosen", "e_R_deg", "e_T_deg", "e_row_deg", "nees"]]
    focal = np.array([truth.rig.camera.fx for truth in split.truths])
    departure = focal * np.deg2rad(entries[ORACLE]["e_row_deg"].to_numpy(dtype=np.float64))
    noise = np.array([float(truth.facts["noise_px"]) for truth in split.truths])
    return scores.assign(departure_px=departure, noise_px=noise)


def _numbers(scores: pd.DataFrame) -> dict[str, float]:
    found: dict[str, float] = {"stated": int(scores["nees"].notna().sum())}
    for key in ("e_R_deg", "e_T_deg"):
        values = scores[key].to_numpy(dtype=np.float64)
        found |= with_ends(key, float(np.median(values)), *median_interval(values))
    stated = named_numbers(calibration(scores.assign(scene=range(len(scores))), _UNKNOWNS), scored=False)
    for key in ("nees_ratio", "covers_95"):
        found |= with_ends(key, *stated[key])
    return found


def write_recorded_page(folder: Path) -> Path:
    """Write README.md from recordings.csv, choices.csv and, if it exists, resampling.csv in ``folder``."""
    recordings, chosen = (pd.read_csv(folder / f"{name}.csv") for name in ("recordings", "choices"))
    resampling = folder / "resampling.csv"
    text = recorded_page(recordings, chosen, pd.read_csv(resampling) if resampling.is_file() else None)
    write_bytes(folder / "README.md", text.encode())
    return folder / "README.md"


def recorded_page(recordings: pd.DataFrame, chosen: pd.DataFrame, resampling: pd.DataFrame | None) -> str:
    """Return the page as Markdown.

    Args:
        recordings: result of ``by_recording``.
        chosen: result of ``choices``.
        resampling: errors of the recordings, from benchmarks/recorded_motion.py; None: omitted.
    """
    about = (
        "The recordings (`benchmarks/recorded_motion.py`): *left out* is the error of a spline through every\n"
        "second sample at the others, *noise* that of one sample, *path* that of the fitted path, *bend* the\n"
        "median over windows of the largest angle between a row and an even turn, *noise's bend* that of noise\n"
        "alone."
    )
    parts = [
        "# Points on recorded trajectories",
        "Made by `rsbench reproduce recorded`; all numbers are in [recordings.csv](recordings.csv) and\n"
        "[choices.csv](choices.csv), the boards in [tables](tables). `drone-mav` does not come with rsbench:\n"
        "cards/recordings/README.md says why, and how it is made.",
        *([] if resampling is None else [about, frame_text(_resampling(resampling))]),
        "Every method on every recording, 60 windows each: medians, the share of stated 95 % ellipsoids that\n"
        "contain the truth, and the median squared error by the stated covariance over that of a correct one.",
        frame_text(_methods(recordings)),
        "Number of windows in which `rs-stereo-auto` chose a motion model, or a spline (`continuous`):",
        frame_text(_models(chosen)),
        "Its errors and its coverage there:",
        frame_text(_kinds(chosen)),
        "The same by the departure of the rows from an even turn, over the noise of a match:",
        frame_text(_departures(chosen)),
    ]
    return "\n\n".join(parts) + "\n"


def _resampling(table: pd.DataFrame) -> pd.DataFrame:
    rows = []
    for row in table.to_dict("records"):
        both = {
            title: f"{row[f'{key}_deg']:.2g} deg, {row[f'{key}_mm']:.2g} mm"
            for title, key in (("left out", "left_out"), ("noise", "noise"), ("path", "path"))
        }
        start = {
            "recording": row["recording"],
            "Hz": f"{row['rate_hz']:.0f}",
            "knots (ms)": f"{row['interval_ms']:g}",
        }
        bends = {"bend (deg)": f"{row['bend_deg']:.2g}", "noise's bend (deg)": f"{row['noise_bend_deg']:.2g}"}
        rows.append({**start, **both, **bends})
    return pd.DataFrame(rows)


def _methods(table: pd.DataFrame) -> pd.DataFrame:
    rows = []
    for row in table.sort_values(["recording", "e_R_deg"]).to_dict("records"):
        errors = {f"e\\_{key[2]} (deg)": _words(row, key) for key in ("e_R_deg", "e_T_deg")}
        coverage = {"in 95 %": _words(row, "covers_95"), "NEES / right": _words(row, "nees_ratio")}
        rows.append({"method": row["method"], "recording": row["recording"], **errors, **coverage})
    return pd.DataFrame(rows)


def _models(table: pd.DataFrame) -> pd.DataFrame:
    counts = table.groupby(["recording", "chosen"]).size().unstack(fill_value=0)
    return counts.reindex(columns=[*MODELS, SPLINE], fill_value=0).reset_index()


def _kinds(table: pd.DataFrame) -> pd.DataFrame:
    kind = np.where(table["chosen"] == SPLINE, "spline", "motion model")
    rows = []
    for (recording, chose), part in table.groupby(["recording", kind]):
        whole = int(np.count_nonzero(table["recording"] == recording))
        share = format_interval(len(part) / whole, *share_interval(len(part), whole))
        rows.append({"recording": recording, "chosen": chose, "share": share, **_errors_and_coverage(part)})
    return pd.DataFrame(rows)


def _departures(table: pd.DataFrame) -> pd.DataFrame:
    over = table["departure_px"] / table["noise_px"]
    rows = []
    for low, high in pairwise(LIMITS):
        part = table[(over > low) & (over <= high)]
        splines = int(np.count_nonzero(part["chosen"] == SPLINE))
        title = f"{low:g} to {high:g}" if np.isfinite(high) else f"above {low:g}"
        share = format_interval(splines / len(part), *share_interval(splines, len(part))) if len(part) else "-"
        rows.append(
            {"departure / noise": title, "windows": len(part), "spline": share, **_errors_and_coverage(part)}
        )
    return pd.DataFrame(rows)


def _errors_and_coverage(part: pd.DataFrame) -> dict[str, str]:
    numbers = _numbers(part) if len(part) else {}
    words = {f"e\\_{key[2]} (deg)": _words(numbers, key) for key in ("e_R_deg", "e_T_deg")}
    return {**words, "in 95 %": _words(numbers, "covers_95"), "NEES / right": _words(numbers, "nees_ratio")}


def _words(row: Mapping[Any, Any], name: str) -> str:
    value, low, high = (float(str(row.get(f"{name}{end}", "nan"))) for end in ("", "_low", "_high"))
    if not np.isfinite(value):
        return "-"
    return format_interval(value, low, high) if np.isfinite([low, high]).all() else f"{value:.2g}"


# Public and held-out splits

DEV, TEST = "dev", "test"
OURS = "rsbench"
"""``code`` of entries whose code is rsbench's own."""


def compared(dev: Sequence[Scored], test: Sequence[Scored]) -> pd.DataFrame:
    """A row for each entry with results on both splits, sorted by the score on the public split, the best first.

    ``score`` is the primary score, ``rank`` the rank among these entries, ``covers_95`` the coverage of the stated
    95 % ellipsoids, and ``difference`` the held-out score minus the public one, with Welch's interval.
    """
    both = {each.header.method for each in dev} & {each.header.method for each in test}
    lines = {
        DEV: {line.name: line for line in standings([each for each in dev if each.header.method in both])},
        TEST: {line.name: line for line in standings([each for each in test if each.header.method in both])},
    }
    rows = []
    for name, line in lines[DEV].items():
        header, values = line.scored.header, [_primary(lines[split][name]) for split in (DEV, TEST)]
        row: dict[str, Any] = {"protocol": header.protocol, "method": name, "uses": line.uses, "code": header.code}
        row |= _of_split(DEV, line) | _of_split(TEST, lines[TEST][name])
        rows.append(row | with_ends("difference", *difference(*values)))
    return pd.DataFrame(rows).sort_values(f"{DEV}_score", ascending=False, kind="stable", ignore_index=True)


def difference(first: FloatArray, second: FloatArray) -> tuple[float, float, float]:
    """Mean of the second sample minus that of the first, independent one, and the ends of Welch's interval."""
    parts = np.array([np.var(each, ddof=1) / len(each) for each in (first, second)])
    degrees = parts.sum() ** 2 / np.sum(parts**2 / (np.array([len(first), len(second)]) - 1))
    half = float(stdtrit(degrees, 0.5 + 0.5 * COVERAGE) * np.sqrt(parts.sum()))
    middle = float(np.mean(second) - np.mean(first))
    return middle, middle - half, middle + half


def _primary(line: Standing) -> FloatArray:
    return line.scored.scores[line.track.primary.key].to_numpy(dtype=np.float64)


def _of_split(split: str, line: Standing) -> dict[str, Any]:
    nothing = (np.nan, np.nan, np.nan)
    found = with_ends(f"{split}_score", *line.means[line.track.primary.key])
    found |= with_ends(f"{split}_rank", *(line.rank or nothing)) | {f"{split}_peers": line.peers}
    found |= with_ends(f"{split}_covers_95", *(line.calibration.covers[-1] if line.calibration else nothing))
    return found | {f"{split}_{key}": line.medians[key] for key in ("e_R_deg", "e_T_deg")}


def write_held_out_page(folder: Path, about: Mapping[str, Any]) -> Path:
    """Write README.md from scores.csv in ``folder``; ``about``: content of announced.json. Returns the file."""
    text = held_out_page(pd.read_csv(folder / "scores.csv", keep_default_na=True), about)
    write_bytes(folder / "README.md", text.encode())
    return folder / "README.md"


def held_out_page(table: pd.DataFrame, about: Mapping[str, Any]) -> str:
    """Return the page as Markdown, from results of ``compared`` for several tracks, and announced.json."""
    parts = [
        "# Public and held-out splits",
        "Made by `rsbench reproduce held-out`; all numbers are in [scores.csv](scores.csv), the boards in\n"
        "[tables](tables). [announced.json](announced.json) was committed before any entry was run on the\n"
        "held-out splits, which [seed.txt](seed.txt) draws. Scores have 95 % intervals; *difference* is\n"
        "held-out minus public; *in 95 %* is the share of stated 95 % ellipsoids that contain the truth.",
    ]
    for protocol, rows in table.groupby("protocol", sort=False):
        score = track_of_id(str(protocol)).primary.title
        named = f"{protocol}, {score}: public split against `{about['splits'][protocol]['split']}`"
        parts += [f"## {named}", frame_text(_comparison(rows))]
    parts += ["## Code of others, on the public splits", frame_text(others(table))]
    return "\n\n".join(parts) + "\n"


def _comparison(rows: pd.DataFrame) -> pd.DataFrame:
    titles = {
        "public": f"{DEV}_score",
        "held-out": f"{TEST}_score",
        "difference": "difference",
        "in 95 %, public": f"{DEV}_covers_95",
        "in 95 %, held-out": f"{TEST}_covers_95",
    }
    return pd.DataFrame(
        {"method": _name(row), **{title: words_of(row, key) for title, key in titles.items()}}
        for row in rows.to_dict("records")
    )


def others(table: pd.DataFrame) -> pd.DataFrame:
    """Entries whose code is not rsbench's, with their scores on public splits, sorted by the number of inputs."""
    found = dict[str, dict[str, str]]()
    rows = table[table["code"] != OURS].to_dict("records")
    for row in sorted(rows, key=lambda row: (row["uses"].count("+"), row["uses"])):
        track = track_of_id(str(row["protocol"]))
        line = found.setdefault(row["method"], {"method": _name(row), "code": row["code"], "uses": row["uses"]})
        line[f"{track.id}, {track.primary.title}"] = words_of(row, f"{DEV}_score")
    return pd.DataFrame(list(found.values())).fillna("-")


def _name(row: Mapping[Any, Any]) -> str:
    return str(row["method"]).replace("_", r"\_")
