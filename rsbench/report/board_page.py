"""The leaderboard as a static site: an index, pages of entries and problems, and each table as files.

Everything comes from a board's stored scores. Nothing is fetched, and what entries say of themselves is escaped.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pandas.api.types import is_numeric_dtype

from rsbench.benchmark.leaderboard.board import Scored, about_split, entries_of, place, splits_of
from rsbench.benchmark.leaderboard.deviations import LEVELS, named_numbers
from rsbench.benchmark.leaderboard.picture_track import PictureTrack
from rsbench.benchmark.leaderboard.pictures import (
    PARTINGS,
    PICTURES,
    TruePictures,
    columns,
    read_answer_depth,
    read_answer_frame,
)
from rsbench.benchmark.leaderboard.standings import Standing, standings, table
from rsbench.benchmark.leaderboard.track import KNOWLEDGE, Split, Track, Truth
from rsbench.benchmark.leaderboard.tracks import track_of_id
from rsbench.benchmark.statistics import format_interval, score_interval
from rsbench.core.errors import RsbenchError
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import read_pairs
from rsbench.report.board_figures import ErrorLine, bar, curves, drawable, legend, reliability, short
from rsbench.report.markup import rendered, table_lines
from rsbench.report.pictures import Image, colour_map, encode_jpeg, shrink
from rsbench.storage.files import write_bytes


@dataclass(frozen=True, kw_only=True)
class Board:
    """A split with the entries of its table, and the published properties of its problems."""

    track: Track
    split: str
    fingerprint: str
    lines: list[Standing]
    facts: pd.DataFrame
    """Properties, with the names of the problems as index; no columns if they are secret."""
    problem_pages: bool = True
    """Whether rendered sequences may have pages of their own."""

    @property
    def id(self) -> str:
        """Identifier: the section of the index, the file names, and the folder of the pages use it."""
        return f"{self.track.id}--{self.split}"

    @property
    def secret(self) -> bool:
        """Whether single problems are hidden: the truth of a problem can be computed from a few exact errors."""
        return self.facts.columns.empty

    @cached_property
    def problems(self) -> list[str]:
        """Names of the problems, in the order of the scores."""
        return [str(name) for name in self.lines[0].scored.scores["problem"]]

    @cached_property
    def scenes(self) -> list[str]:
        """Scenes of the problems."""
        return [str(name) for name in self.lines[0].scored.scores["scene"]]

    @property
    def several(self) -> bool:
        """Whether any scene has several problems."""
        return len(set(self.scenes)) < len(self.scenes)

    @property
    def pages(self) -> bool:
        """Whether each problem has a page; simulated problems, which have no pictures, have a row of a table
        instead."""
        return self.problem_pages and self.track.inputs.rendered and not self.secret

    def page_of(self, problem: str) -> str:
        """Link to the page or row of a problem, relative to the folder of the index."""
        return f"{self.id}/problem/{problem}.html" if self.pages else f"{self.named['problems']}#{problem}"

    @property
    def named(self) -> dict[str, str]:
        """The identifiers and titles of the split that all its pages show."""
        return {
            "id": self.id,
            "title": self.track.title,
            "protocol": self.track.id,
            "split": self.split,
            "primary": self.track.primary.title,
            "error": self.track.error_title,
            "problems": "" if self.secret else f"{self.id}--problems.html",
        }

    def known(self) -> list[tuple[str, pd.Series]]:
        """Properties of the problems, each with its name: numbers or words in the order of the problems; also the
        scene."""
        found = [(str(name), self.facts[name].reindex(self.problems)) for name in self.facts.columns]
        return [*found, ("scene", pd.Series(self.scenes))] if self.several else found

    @property
    def by_score(self) -> list[Standing]:
        """Entries that have a rank, from the best, regardless of their inputs."""
        primary = self.track.primary
        ranked = [line for line in self.lines if line.rank is not None]
        return sorted(ranked, key=lambda line: -primary.sign * line.means[primary.key][0])

    def figures(self, lines: Sequence[Standing]) -> dict[str, Any]:
        """Figures of the errors of some entries over each property of the problems."""
        shown = drawable([self._line(line) for line in lines])
        drawn = [(fact_title(name), curves(values, shown, self.scenes)) for name, values in self.known()]
        return {
            "legend": legend(shown),
            "drawn": [{"title": title, "svg": svg} for title, svg in drawn if svg is not None],
        }

    def figures_within(self, lines: Sequence[Standing]) -> dict[str, Any]:
        """Figures of the errors of some entries in parts of the pictures, if the stored scores have them."""
        track, drawn, shown = self.track, list[dict[str, Any]](), list[ErrorLine]()
        if not isinstance(track, PictureTrack):
            return {"legend": legend(shown), "drawn": drawn, "error": ""}
        for parting in () if self.secret else PARTINGS:
            names = columns(track.part_score, parting)
            having = [line for line in lines if set(names) <= set(line.scored.scores)]
            if not having:
                continue
            stacked = [line.scored.scores[names].to_numpy(dtype=np.float64).ravel() for line in having]
            known = np.all(np.isfinite(stacked), axis=0)  # a picture need not have pixels of each part
            found = [
                ErrorLine(line.scored.header.method, errors[known], line.rank is None)
                for line, errors in zip(having, stacked, strict=True)
            ]
            starts = pd.Series(np.tile(parting.starts, len(self.problems))[known])
            scenes = np.repeat(self.scenes, len(names))[known].tolist()
            svg = curves(starts, drawable(found), scenes) if np.any(known) else None
            if svg is not None:
                drawn.append({"title": parting.title, "svg": svg})
                shown = drawable(found)
        return {"legend": legend(shown), "drawn": drawn, "error": track.part_title}

    def _line(self, line: Standing) -> ErrorLine:
        errors = line.scored.scores[self.track.error].to_numpy(dtype=np.float64)
        return ErrorLine(line.scored.header.method, errors, line.rank is None)


def read_split(board: Path, protocol: str, split: str) -> Board:
    """Read a split of a board; its list of lines is empty if it has no entries.

    Raises:
        RsbenchError: an entry or the record of the split is damaged.
    """
    about = about_split(place(board, protocol, split))
    return Board(
        track=track_of_id(protocol),
        split=split,
        fingerprint=about.fingerprint,
        lines=standings(entries_of(board, protocol, split)),
        facts=pd.DataFrame.from_dict(about.facts, orient="index"),
    )


def fact_title(name: str) -> str:
    """Return a readable title of a property such as ``rotation_deg``."""
    found = re.fullmatch(r"(\w+)_(deg|m|px)", name)
    return (f"{found[1]} ({found[2]})" if found else name).replace("_", " ")


BRIEF = 2
"""Number of medians in short tables."""


def as_csv(lines: Sequence[Standing], secret: bool) -> str:
    """Return all numbers of a table with all digits. No cell is a formula, as names cannot start like one."""
    return table(lines, worst=not secret).to_csv(index=False, lineterminator="\n")


def as_markdown(lines: Sequence[Standing]) -> str:
    """Return the most important columns as Markdown; underscores in names, their only markup, are escaped."""
    head, *rows = _brief(lines)
    return "\n".join(table_lines(head, rows)).replace("_", r"\_") + "\n"


def as_latex(lines: Sequence[Standing]) -> str:
    """Return the most important columns as a LaTeX tabular with the rules of booktabs."""
    head, *rows = [" & ".join(row).replace("_", r"\_") + r" \\" for row in _brief(lines)]
    width = len(_brief(lines)[0])
    begin, end = rf"\begin{{tabular}}{{ll{'r' * (width - 2)}}}", r"\end{tabular}"
    return "\n".join([begin, r"\toprule", head, r"\midrule", *rows, r"\bottomrule", end, ""])


def brief_medians(track: Track) -> list[str]:
    """Titles of the medians that short tables show."""
    return [score.title for score in track.scores if score.kind == "median"][:BRIEF]


def _brief(lines: Sequence[Standing]) -> list[list[str]]:
    track = lines[0].track
    assumes = ["assumes"] if track.parting else []
    titles = {score.key: score.title for score in track.scores}
    stated = any(line.calibration for line in lines)
    head = ["method", *assumes, "uses", "rank", track.primary.title, *lines[0].parts]
    rows = [[*head, *(titles[key] for key in track.beside), *brief_medians(track)]]
    rows[0] += list(lines[0].stated_words) if stated else []
    for line in lines:
        primary, *beside = [format_interval(*line.means[key]) for key in (track.primary.key, *track.beside)]
        parts = [f"{triple[0]:.2f}" for triple in line.parts.values()]
        medians = [f"{line.medians[key]:.3g}" for key in track.of_kind("median")[:BRIEF]]
        assumed = [line.assumes] if track.parting else []
        rows.append([line.name, *assumed, line.uses, line.rank_words, primary, *parts, *beside, *medians])
        rows[-1] += list(line.stated_words.values()) if stated else []
    return rows


DEPTH_PX, FRAME_LEVELS = 3.0, 64.0
"""Errors at which the colour scale ends: of disparity, px, and of the mean over the colours, 8-bit levels."""
_DIFFERENCE = f"difference, 0 (dark) to {FRAME_LEVELS:g} of 255 levels or more (bright); grey: not drawn"
ERRORS = {
    "depth": f"error, 0 (dark) to {DEPTH_PX:g} px of disparity or more (bright); grey: unknown, or no surface",
    "correction": _DIFFERENCE,
    "correction-mono": _DIFFERENCE,
}
Named = tuple[str, str, Image]
"""Stem of the file name, caption, picture."""


def true_images(track: str, pictures: TruePictures) -> Iterator[Named]:
    """The true pictures of a problem."""
    for each in pictures.requested:
        if track == "depth":
            yield each.stem, "true depth", _depth_image(pictures.depth(), pictures.depth())
        else:
            yield each.stem, f"true frame, {_row_name(each.stem)}", pictures.frame(each.row)


def answer_images(track: str, entry: Scored, truth: Truth) -> Iterator[Named]:
    """The pictures that an entry submitted for a problem, and their errors; empty if the entry failed.

    Raises:
        RsbenchError: a picture is missing, or damaged.
    """
    pictures, method, folder = truth.pictures, entry.header.method, entry.folder / PICTURES
    scores = entry.scores
    assert pictures is not None
    if not bool(scores.loc[scores["problem"] == truth.name, "success"].all()):
        return
    for each in pictures.requested:
        if track == "depth":
            depth = read_answer_depth(folder, pictures, entry.header.png_unit_m)
            yield each.stem, method, _depth_image(depth, pictures.depth())
            yield f"{each.stem}-error", f"{method}, error", depth_error_image(depth, pictures)
        else:
            image, drawn = read_answer_frame(folder, pictures, each)
            words = f"{method}, {_row_name(each.stem)}"
            yield each.stem, words, image
            yield (
                f"{each.stem}-error",
                f"{words}, error",
                frame_error_image(image, drawn, pictures.frame(each.row)),
            )


def _row_name(stem: str) -> str:
    return f"{stem.rpartition('_')[2]} row"


def _depth_image(depth: NDArray[np.float32], truth: NDArray[np.float32]) -> Image:
    """Picture of inverse depth, scaled to the range of the true one; unknown is grey."""
    low, high = np.quantile(1.0 / truth[truth > 0.0], [0.01, 0.99]) if np.any(truth > 0.0) else (0.0, 1.0)
    return colour_map(_inverse(depth), float(low), float(high))


def _inverse(depth: NDArray[np.float32]) -> FloatArray:
    """Inverse depth; NaN where the depth is unknown."""
    return np.divide(1.0, depth, where=depth > 0.0, out=np.full(depth.shape, np.nan))


def depth_error_image(depth: NDArray[np.float32], pictures: TruePictures) -> Image:
    """Error of the disparity of the left camera, px, in colours."""
    rig = pictures.sequence.rig
    gain = rig.camera.fx * rig.baseline * rig.own_depth("left", rig.sensor("left").pixel_grid())
    error = gain * np.abs(_inverse(depth) - _inverse(pictures.depth()))
    return colour_map(error, 0.0, DEPTH_PX)


def frame_error_image(image: Image, drawn: NDArray[np.bool_], truth: Image) -> Image:
    """Mean difference of the three colours, in colours; grey where nothing was drawn."""
    error = np.mean(np.abs(image.astype(np.float64) - truth), axis=-1)
    return colour_map(np.where(drawn, error, np.nan), 0.0, FRAME_LEVELS)


_LONGEST, _QUALITY = 400, 78
"""Longest side, px, and JPEG quality of a picture, which then has 10 to 35 kB."""
_THUMB = 120
_MOST_BYTES = 11_000_000
"""Largest size of all pictures of a site, which stays below 15 MB."""


class Album:
    """Writes the pictures of a split's problems into ``<id>/pictures/<problem>``."""

    def __init__(self, each: Board, out: Path, data: Sequence[Path]) -> None:
        self._each = each
        self._split, folder = _at_hand(each, data)
        self._sequences = {} if folder is None else {sequence.name: sequence for sequence in read_pairs(folder)}
        self._out, self.prefix = out, f"{each.id}/pictures"
        self.allowance = _MOST_BYTES
        """Largest number of bytes of the pictures of one problem."""

    def __len__(self) -> int:
        """Number of problems with pictures."""
        return len(self._sequences)

    @property
    def errors(self) -> str:
        """Explanation of the colours of error maps; empty if there are none."""
        return ERRORS.get(self._each.track.name, "") if self._sequences else ""

    def thumb(self, problem: str) -> str:
        """Path of the thumbnail, relative to the folder of the index; empty if there is none."""
        return f"{self.prefix}/{problem}/thumb.jpg" if problem in self._sequences else ""

    def pictures(self, problem: str) -> list[dict[str, str]]:
        """Write frames, truth and answers, and a thumbnail; answers of the last entries only if the size allows
        it.

        Returns the ``title`` of each picture, and its ``file`` below the folder of the problem's pictures.
        """
        if problem not in self._sequences:
            return []
        left, found = self.allowance, list[dict[str, str]]()
        for group in self._groups(problem):
            pictures = [
                (stem, words, encode_jpeg(shrink(image, _LONGEST), _QUALITY)) for stem, words, image in group
            ]
            left -= sum(len(data) for _, _, data in pictures)
            if left < 0:
                break
            for stem, words, data in pictures:
                found.append({"title": words, "file": f"{stem}.jpg"})
                self._write(problem, f"{stem}.jpg", data)
        return found

    def compared(self, problem: str) -> tuple[int, int]:
        """Indices of the two pictures that are compared at first: the input frame and the best answer, or both
        frames."""
        truth = None if self._split is None else self._split.by_name[problem]
        return (0, 1) if truth is None or truth.pictures is None else (1, 2 + len(truth.pictures.requested))

    def _groups(self, problem: str) -> Iterator[list[Named]]:
        """Groups of pictures that are written together or not at all: the frames with the truth, then each entry,
        the best first."""
        assert self._split is not None
        sequence, truth, track = self._sequences[problem], self._split.by_name[problem], self._each.track.name
        frames = [sequence.image("rs", "left", frame) for frame in (0, 1)]
        self._write(problem, "thumb.jpg", encode_jpeg(shrink(frames[0], _THUMB), _QUALITY))
        first = [(f"left_{k}", f"rolling-shutter frame {k}", image) for k, image in enumerate(frames)]
        if truth.pictures is None:
            yield first
            return
        yield [
            *first,
            *((f"true-{stem}", words, image) for stem, words, image in true_images(track, truth.pictures)),
        ]
        for line in self._each.by_score:
            method = line.scored.header.method
            answer = answer_images(track, line.scored, truth)
            yield [(f"{method}/{stem}", words, image) for stem, words, image in answer]

    def _write(self, problem: str, name: str, data: bytes) -> None:
        path = self._out / self.prefix / problem / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, data)


def albums(boards: Sequence[Board], out: Path, data: Sequence[Path]) -> list[Album]:
    """One album for each split; all together are smaller than ``_MOST_BYTES``."""
    found = [Album(each, out, data) for each in boards]
    for album in found:
        album.allowance = _MOST_BYTES // max(sum(map(len, found)), 1)
    return found


def _at_hand(each: Board, data: Sequence[Path]) -> tuple[Split | None, Path | None]:
    """A public split and the folder of its dataset; None for each that is not available.

    Raises:
        RsbenchError: a folder contains no dataset.
    """
    if each.pages and not each.facts.empty:
        for folder in data:
            try:
                split = each.track.split(folder)
            except RsbenchError:
                if not (folder / "dataset.json").is_file():
                    raise
                continue  # the track does not support its cameras
            if split.fingerprint == each.fingerprint:
                return split, folder
    return None, None


_ABOUT = ("version", "description", "authors", "paper", "code", "licence", "hardware", "tuned_on", "motion_model")
_WORST = 10


def entry_context(each: Board, line: Standing, album: Album) -> dict[str, Any]:
    """Context of the template board_entry.html.j2."""
    header = line.scored.header
    fields = asdict(header)
    uses = set(header.uses)
    # The entry is compared with the best other one that uses no more inputs, and with the oracles.
    peers = [peer for peer in each.by_score if peer is not line and set(peer.scored.header.uses) <= uses]
    oracles = [other for other in each.lines if other.rank is None and other is not line]
    compared = [line, *(peers[:1] if line.rank else []), *oracles]
    return {
        "header": header,
        "split": each.named,
        "about": [
            ("uses", line.uses),
            ("answers", "handed in as a file" if line.scored.handed_in else "made by this board"),
            *([("in_doubt", line.scored.doubt)] if line.scored.doubt else []),
            *((name, fields[name]) for name in _ABOUT if fields[name]),
        ],
        "scores": _entry_scores(line),
        "ties": ", ".join(line.ties),
        "tables": [_by(each, line, name, kinds) for name, kinds in each.known() if not is_numeric_dtype(kinds)],
        "worst": None if each.secret else _worst(each, line, album),
        "figures_found": each.figures(compared),
        "figures_within": each.figures_within(compared),
        "calibration": _calibration(line),
    }


def _entry_scores(line: Standing) -> list[dict[str, str]]:
    found = [{"title": "rank", "text": line.rank_words, "hint": "among those that use no more"}]
    for score in line.track.scores:
        median = score.kind == "median"
        text = _number(line.medians[score.key]) if median else format_interval(*line.means[score.key])
        found.append({"title": score.title, "text": text, "hint": score.hint})
    return found


def _number(value: float) -> str:
    return "–" if np.isnan(value) else f"{value:.3g}"


def _by(each: Board, line: Standing, name: str, kinds: pd.Series) -> dict[str, Any]:
    scores, track, rows = line.scored.scores, each.track, list[list[object]]()
    for kind, part in scores.groupby(kinds.astype(str).to_numpy()):
        primary = part[track.primary.key].to_numpy()
        value, low, high = score_interval(primary, list(part["scene"]), track.primary.kind == "share")
        # One scene has no interval; format_interval would round its value to nothing.
        share = f"{value:.3g}" if part["scene"].nunique() == 1 else format_interval(value, low, high)
        medians = (f"{part[key].median():.3g}" for key in track.of_kind("median")[:BRIEF])
        rows.append([str(kind), len(part), share, *medians, int(part["failure"].sum())])
    return {
        "title": f"By {fact_title(name)}",
        "columns": [fact_title(name), "problems", track.primary.title, *brief_medians(track), "failed"],
        "rows": rows,
    }


def _worst(each: Board, line: Standing, album: Album) -> dict[str, Any]:
    track = each.track
    worst = line.scored.scores.sort_values([track.error, "problem"], ascending=[False, True]).head(_WORST)
    names = [str(name) for name in each.facts.columns]
    rows = []
    for case in worst.to_dict("records"):
        numbers = [f"{case[key]:.3g}" for key in track.of_kind("median")[:BRIEF]]
        known = [each.facts[name].get(case["problem"], "") for name in names]
        words = [f"{value:.3g}" if isinstance(value, float) else str(value) for value in known]
        problem = str(case["problem"])
        thumb = album.thumb(problem)
        rows.append(
            {
                "name": problem,
                "page": f"../{each.page_of(problem)}",
                "thumb": thumb and f"../{thumb}",
                "cells": [*numbers, *words],
            }
        )
    return {"columns": [*brief_medians(track), *map(fact_title, names)], "rows": rows}


def _calibration(line: Standing) -> dict[str, Any] | None:
    found = line.calibration
    if found is None:
        return None
    rows = [
        {"level": f"{100.0 * level:.0f} %", "text": format_interval(*(100.0 * x for x in triple)) + " %"}
        for level, triple in zip(LEVELS, found.covers, strict=True)
    ]
    return {
        "stated": found.stated,
        "of": len(line.scored.scores),
        "spread": format_interval(*found.spread),
        "mean": f"{found.mean:.3g}",
        "unknowns": line.track.unknowns,
        "log_score": format_interval(*found.log_score) if found.log_score else "",
        "log_rank": line.stated_words["log rank"] if line.log_rank else "",
        "rows": rows,
        "figure": reliability(found.covers),
    }


_SHADES = 5


def matrix_context(each: Board, album: Album) -> dict[str, Any]:
    """Context of the template board_problems.html.j2: a row for each problem, a column for each entry."""
    errors = np.stack([line.scored.scores[each.track.error].to_numpy(dtype=np.float64) for line in each.lines])
    failed = np.stack([line.scored.scores["failure"].to_numpy() > 0.0 for line in each.lines])
    names = [str(name) for name in each.facts.columns]
    shades = _shades(errors)
    rows = [
        {
            "name": problem,
            "page": each.page_of(problem) if each.pages else "",
            "thumb": album.thumb(problem),
            "facts": [_fact(each, name, problem) for name in names],
            "cells": [
                {"value": repr(float(x)), "text": "failed" if lost else short(x), "shade": int(shade)}
                for x, lost, shade in zip(errors[:, k], failed[:, k], shades[:, k], strict=True)
            ],
        }
        for k, problem in enumerate(each.problems)
    ]
    entries = [{"method": line.scored.header.method, "oracle": line.rank is None} for line in each.lines]
    return {"split": each.named, "facts": [_title(each, name) for name in names], "entries": entries, "rows": rows}


def _shades(errors: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Shade of each error: 0 for the smallest ones to ``_SHADES`` - 1 for the largest; equally many of each."""
    inner = np.quantile(errors, np.linspace(0.0, 1.0, _SHADES + 1)[1:-1], method="inverted_cdf")
    return np.searchsorted(inner, errors, side="left")


def _title(each: Board, name: str) -> dict[str, Any]:
    return {"name": name, "title": fact_title(name), "text": each.facts[name].dtype == object}


def _fact(each: Board, name: str, problem: str) -> dict[str, str]:
    value = each.facts[name].get(problem, "")
    if isinstance(value, str):
        return {"value": value, "text": value}
    return {"value": repr(float(value)), "text": f"{value:.3g}"}


def problem_contexts(each: Board, album: Album) -> Iterator[tuple[str, dict[str, Any]]]:
    """Names of the rendered sequences, each with the context of the template board_problem.html.j2."""
    if not each.pages:
        return
    for k, problem in enumerate(each.problems):
        before, after = each.problems[k - 1], each.problems[(k + 1) % len(each.problems)]
        yield (
            problem,
            {
                "split": each.named,
                "name": problem,
                "before": before,
                "after": after,
                "facts": [(fact_title(str(n)), _fact(each, str(n), problem)["text"]) for n in each.facts.columns],
                "columns": [{"title": score.title, "hint": score.hint} for score in each.track.scores],
                "rows": [_problem_row(each, line, k) for line in each.lines],
                "place": f"../pictures/{problem}",
                "pictures": album.pictures(problem),
                "compared": album.compared(problem),
                "errors": album.errors,
            },
        )


def _problem_row(each: Board, line: Standing, k: int) -> dict[str, Any]:
    scores, method = line.scored.scores.iloc[k], line.scored.header.method
    cells = [_number(float(scores[score.key])) for score in each.track.scores]
    return {"method": method, "page": f"../{method}.html", "oracle": line.rank is None, "cells": cells}


def build_site(board: Path, out: Path, data: Sequence[Path] = (), *, problem_pages: bool = True) -> Path:
    """Write the site of a board into a folder; returns its first page.

    Tables of other splits that are already in the folder are kept, also on the first page.

    Args:
        data: datasets whose pictures the pages of problems show.
        problem_pages: if False, the site is a tenth as large; the table of all problems then has their errors.

    Raises:
        RsbenchError: it is no board, an entry or a dataset is damaged, or the folder cannot be written.
    """

    def write(name: str, template: str, context: dict[str, Any]) -> None:
        path = out / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, rendered(f"{template}.html.j2", trim=True, **context).encode())

    boards = [read_split(board, protocol, split) for protocol, split in splits_of(board)]
    boards = [replace(each, problem_pages=problem_pages) for each in boards if each.lines]
    secret, order = {each.track.id for each in boards if each.secret}, [each.track.id for each in boards]
    boards.sort(key=lambda each: (order.index(each.track.id), not each.secret))
    out.mkdir(parents=True, exist_ok=True)
    for each, album in zip(boards, albums(boards, out, data), strict=True):
        for suffix, text in (
            ("csv", as_csv(each.lines, each.secret)),
            ("md", as_markdown(each.lines)),
            ("tex", as_latex(each.lines)),
        ):
            write_bytes(out / f"{each.id}.{suffix}", text.encode())
        for line in each.lines:
            write(f"{each.id}/{line.scored.header.method}.html", "board_entry", entry_context(each, line, album))
        if not each.secret:
            write(f"{each.id}--problems.html", "board_problems", matrix_context(each, album))
        for name, context in problem_contexts(each, album):
            write(f"{each.id}/problem/{name}.html", "board_problem", context)
    kept = _other_sections(out, {each.id for each in boards})
    sections = [_section(each, each.track.id in secret) for each in boards]
    write("index.html", "board", {"splits": sections, "kept": kept})
    return out / "index.html"


def _other_sections(out: Path, names: Collection[str]) -> list[dict[str, Any]]:
    """Sections of an existing first page whose tables still exist, without those with these ``names``."""
    path = out / "index.html"
    page = path.read_text("utf-8") if path.is_file() else ""
    found = re.findall(r'<section class="split" id="([^"]+)".*?</section>', page, re.DOTALL)
    texts = re.findall(r'(<section class="split" .*?</section>)', page, re.DOTALL)
    return [
        {"id": name, "protocol": name.partition("--")[0], "split": name.partition("--")[2], "html": text}
        for name, text in zip(found, texts, strict=True)
        if name not in names and (out / f"{name}.csv").is_file()
    ]


def _section(each: Board, ranked: bool) -> dict[str, Any]:
    """Context of a section of the first page; ``ranked``: whether a secret split of the protocol is on the board,
    which then decides the ranks."""
    used = {name for line in each.lines for name in line.scored.header.uses}
    return {
        **each.named,
        "word": ("Secret: it ranks." if each.secret else "Its truth is public: for practice.") if ranked else "",
        "count": len(each.problems),
        "scenes": len(set(each.scenes)),
        "given": each.track.given,
        "files": [(suffix, f"{each.id}.{suffix}") for suffix in ("csv", "md", "tex")],
        "knowledge": [name for name in KNOWLEDGE if name in used],
        "columns": _columns(each),
        "rows": [_row(each, line) for line in each.lines],
        "figures": each.figures(_first_of_groups(each.lines)),
    }


def _columns(each: Board) -> list[dict[str, Any]]:
    track, parts = each.track, each.lines[0].parts
    telling = {"method", "uses", "rank", track.primary.key, "flip", *track.beside, "assumes"}
    telling |= {f"part_{name}" for name in parts}
    if not parts:  # a page of 1280 pixels has no room for all of them
        telling |= {*track.of_kind("median")[:BRIEF], "covers_95", "log_score", "log_rank"}

    def column(key: str, title: str, first: str, hint: str, *, text: bool = False) -> dict[str, Any]:
        """``more``: whether the column is hidden until all columns are requested."""
        more = key not in telling
        return {"key": key, "title": title, "first": first, "hint": hint, "text": text, "more": more}

    part, primary = track.parting, track.primary.title
    scores = sorted(each.track.scores, key=lambda score: score.kind == "median")  # in the order of the cells
    stated = [
        column("nees_ratio", "NEES", "up", "squared error by the stated covariance: 1 where that is right"),
        *(
            column(
                f"covers_{100.0 * level:.0f}",
                f"in {100.0 * level:.0f} %",
                "down",
                "share of truths in the stated ellipsoid of that level",
            )
            for level in LEVELS
        ),
    ]
    if _log_scored(each):
        words = "ln of the stated density at the truth over that of a vague guess, nats, mean over scenes"
        stated += [column("log_score", "log score", "down", f"{words}; 0 where nothing is stated")]
        stated += [
            column("log_rank", "log rank", "up", "by the log score, among those that have one and use no more")
        ]
    return [
        column("method", "method", "up", "name of the entry", text=True),
        column("uses", "uses", "up", "what it works on", text=True),
        column("rank", "rank", "up", "among those that use no more, with its interval"),
        *(column(s.key, s.title, "down" if s.better == "higher" else "up", s.hint) for s in scores),
        *(stated if _stated(each) else []),
        *(column(f"part_{name}", name, "down", f"{primary} where the {part} is {name}") for name in parts),
        *([column("assumes", "assumes", "up", "motion model that it assumes", text=True)] if parts else []),
        column("ties", "ties", "up", "entries that the data do not distinguish from it", text=True),
        column("tuned_on", "tuned on", "up", "data by which its parameters were chosen", text=True),
    ]


def _stated(each: Board) -> bool:
    return any(line.calibration for line in each.lines)


def _log_scored(each: Board) -> bool:
    return any("log_score" in line.scored.scores for line in each.lines)


def _row(each: Board, line: Standing) -> dict[str, Any]:
    header, rank, primary = line.scored.header, line.rank, line.track.primary.key
    position, of, peers = line.rank_words.partition(" of ")
    cells: list[dict[str, Any]] = [
        {"value": "" if rank is None else rank.place, "text": position, "among": of + peers, "bar": None}
    ]
    for key, triple in line.means.items():
        drawn = bar(*triple) if key == primary else None
        text = {"text": format_interval(*triple)} if key == primary else _apart(triple)
        cells.append({"value": _value(triple[0]), **text, "bar": drawn})
    cells += [{"value": _value(value), "text": _number(value), "bar": None} for value in line.medians.values()]
    if _stated(each):
        for triple in named_numbers(line.calibration, _log_scored(each)).values():
            text = {"text": "–"} if np.isnan(triple[0]) else _apart(triple)
            cells.append({"value": _value(triple[0]), **text, "bar": None})
        if _log_scored(each):
            place = "" if line.log_rank is None else line.log_rank.place
            cells.append({"value": place, "text": line.stated_words.get("log rank", "–"), "bar": None})
    for triple in line.parts.values():
        cells.append({"value": _value(triple[0]), **_apart(triple), "bar": None})
    return {
        "method": header.method,
        "uses": line.uses.replace(" + ", " "),
        "among": peers,
        "oracle": rank is None,
        "handed_in": line.scored.handed_in,
        "doubt": line.scored.doubt,
        "page": f"{each.id}/{header.method}.html",
        "cells": cells,
        "words": [*([line.assumes] if line.parts else []), ", ".join(line.ties), header.tuned_on],
    }


def _apart(triple: tuple[float, float, float]) -> dict[str, str]:
    """Split a number and its interval into two texts; the interval is shown only with all columns."""
    number, space, interval = format_interval(*triple).partition(" ")
    return {"text": number, "interval": space + interval}


def _value(value: float) -> str:
    """The number as JavaScript text, with all digits of the CSV file."""
    return "" if np.isnan(value) else "Infinity" if np.isinf(value) else repr(float(value))


def _first_of_groups(lines: Sequence[Standing]) -> list[Standing]:
    """Sort entries: the best of each group with the same inputs first, then the second of each, and so on."""
    seen: dict[str, int] = {}
    places = []
    for line in lines:
        seen[line.uses] = seen.get(line.uses, 0) + 1
        places.append((line.rank is None, seen[line.uses]))
    return [lines[k] for k in sorted(range(len(lines)), key=lambda k: places[k])]
