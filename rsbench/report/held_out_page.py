"""Public and held-out splits of the tracks of points side by side: the table of all numbers, and its page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from rsbench.benchmark.leaderboard.board import Scored
from rsbench.benchmark.leaderboard.standings import Standing, standings
from rsbench.benchmark.leaderboard.tracks import track_of_id
from rsbench.benchmark.statistics import COVERAGE, with_ends
from rsbench.core.so3 import FloatArray
from rsbench.report.markup import frame_text, words_of
from rsbench.storage.files import write_bytes

DEV, TEST = "dev", "test"
OURS = "rsbench"
"""``code`` of entries whose code is rsbench's own."""


def compared(dev: Sequence[Scored], test: Sequence[Scored]) -> pd.DataFrame:
    """A row for each entry of a track that has answered both splits, the best on the public one first.

    ``score`` is the first score of the track, ``rank`` that among these entries, ``covers_95`` the coverage of the
    stated 95 % ellipsoids, and ``difference`` the held-out score minus the public one, with Welch's interval.
    """
    both = {each.header.method for each in dev} & {each.header.method for each in test}
    lines = {
        DEV: {line.name: line for line in standings([each for each in dev if each.header.method in both])},
        TEST: {line.name: line for line in standings([each for each in test if each.header.method in both])},
    }
    rows = []
    for name, line in lines[DEV].items():
        header, values = line.scored.header, [_scores(lines[split][name]) for split in (DEV, TEST)]
        row: dict[str, Any] = {"protocol": header.protocol, "method": name, "uses": line.uses, "code": header.code}
        row |= _numbers(DEV, line) | _numbers(TEST, lines[TEST][name])
        rows.append(row | with_ends("difference", *difference(*values)))
    return pd.DataFrame(rows).sort_values(f"{DEV}_score", ascending=False, kind="stable", ignore_index=True)


def difference(first: FloatArray, second: FloatArray) -> tuple[float, float, float]:
    """Mean of the second values minus that of the first, independent ones, and the ends of Welch's interval."""
    parts = np.array([np.var(each, ddof=1) / len(each) for each in (first, second)])
    degrees = parts.sum() ** 2 / np.sum(parts**2 / (np.array([len(first), len(second)]) - 1))
    half = float(stdtrit(degrees, 0.5 + 0.5 * COVERAGE) * np.sqrt(parts.sum()))
    middle = float(np.mean(second) - np.mean(first))
    return middle, middle - half, middle + half


def _scores(line: Standing) -> FloatArray:
    return line.scored.scores[line.track.primary.key].to_numpy(dtype=np.float64)


def _numbers(split: str, line: Standing) -> dict[str, Any]:
    nothing = (np.nan, np.nan, np.nan)
    found = with_ends(f"{split}_score", *line.means[line.track.primary.key])
    found |= with_ends(f"{split}_rank", *(line.rank or nothing)) | {f"{split}_peers": line.peers}
    found |= with_ends(f"{split}_covers_95", *(line.calibration.covers[-1] if line.calibration else nothing))
    return found | {f"{split}_{key}": line.medians[key] for key in ("e_R_deg", "e_T_deg")}


# The page


def write_page(folder: Path, about: Mapping[str, Any]) -> Path:
    """README.md from scores.csv of a folder and what was announced; returns it."""
    text = page(pd.read_csv(folder / "scores.csv", keep_default_na=True), about)
    write_bytes(folder / "README.md", text.encode())
    return folder / "README.md"


def page(table: pd.DataFrame, about: Mapping[str, Any]) -> str:
    """The page in Markdown: of ``compared`` of several tracks, and of the announcement."""
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
    """The code of others: a row for each entry, with its scores on public splits, those that use least first."""
    found = dict[str, dict[str, str]]()
    rows = table[table["code"] != OURS].to_dict("records")
    for row in sorted(rows, key=lambda row: (row["uses"].count("+"), row["uses"])):
        track = track_of_id(str(row["protocol"]))
        line = found.setdefault(row["method"], {"method": _name(row), "code": row["code"], "uses": row["uses"]})
        line[f"{track.id}, {track.primary.title}"] = words_of(row, f"{DEV}_score")
    return pd.DataFrame(list(found.values())).fillna("-")


def _name(row: Mapping[Any, Any]) -> str:
    return str(row["method"]).replace("_", r"\_")
