"""A split of a board as the pages see it: its lines, and what is known of its problems."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rsbench.benchmark.leaderboard.board import about_split, entries_of, place
from rsbench.benchmark.leaderboard.picture_track import PictureTrack
from rsbench.benchmark.leaderboard.pictures import PARTINGS, columns
from rsbench.benchmark.leaderboard.standings import Standing, standings
from rsbench.benchmark.leaderboard.track import Track
from rsbench.benchmark.leaderboard.tracks import track_of_id
from rsbench.report.board_figures import ErrorLine, curves, drawable, legend


@dataclass(frozen=True, kw_only=True)
class Board:
    """A split with its lines, and what is told of its problems."""

    track: Track
    split: str
    fingerprint: str
    lines: list[Standing]
    facts: pd.DataFrame
    """By the name of the problem; without columns where they are secret."""
    problem_pages: bool = True
    """Whether rendered sequences may have pages of their own."""

    @property
    def id(self) -> str:
        """Of its part of the index, of its files, and of the folder of its pages."""
        return f"{self.track.id}--{self.split}"

    @property
    def secret(self) -> bool:
        """Whether nothing is told of single problems: from a few exact errors of one the truth can be computed."""
        return self.facts.columns.empty

    @cached_property
    def problems(self) -> list[str]:
        """Names, in the order of scores."""
        return [str(name) for name in self.lines[0].scored.scores["problem"]]

    @cached_property
    def scenes(self) -> list[str]:
        """Of the problems."""
        return [str(name) for name in self.lines[0].scored.scores["scene"]]

    @property
    def several(self) -> bool:
        """Whether scenes have several problems."""
        return len(set(self.scenes)) < len(self.scenes)

    @property
    def pages(self) -> bool:
        """Whether its problems have pages: simulated ones, of which nothing is to be seen, have a row."""
        return self.problem_pages and self.track.inputs.rendered and not self.secret

    def page_of(self, problem: str) -> str:
        """Where a problem is told, from the folder of the index."""
        return f"{self.id}/problem/{problem}.html" if self.pages else f"{self.named['problems']}#{problem}"

    @property
    def named(self) -> dict[str, str]:
        """Words of its own, for all pages."""
        return {
            "id": self.id,
            "title": self.track.title,
            "protocol": self.track.id,
            "split": self.split,
            "primary": self.track.primary.title,
            "error": self.error,
            "problems": "" if self.secret else f"{self.id}--problems.html",
        }

    @property
    def error(self) -> str:
        """What figures draw."""
        return self.track.error_title

    def known(self) -> list[tuple[str, pd.Series]]:
        """What is known of the problems, in their order: numbers and words, each with its name, and the scene."""
        found = [(str(name), self.facts[name].reindex(self.problems)) for name in self.facts.columns]
        return [*found, ("scene", pd.Series(self.scenes))] if self.several else found

    @property
    def by_score(self) -> list[Standing]:
        """Lines that have a rank, the best first, whatever they use."""
        primary = self.track.primary
        ranked = [line for line in self.lines if line.rank is not None]
        return sorted(ranked, key=lambda line: -primary.sign * line.means[primary.key][0])

    def figures(self, lines: Sequence[Standing]) -> dict[str, Any]:
        """Errors of some of its lines against what is known of the problems."""
        shown = drawable([self._line(line) for line in lines])
        drawn = [(fact_title(name), curves(values, shown, self.scenes)) for name, values in self.known()]
        return {
            "legend": legend(shown),
            "drawn": [{"title": title, "svg": svg} for title, svg in drawn if svg is not None],
        }

    def figures_within(self, lines: Sequence[Standing]) -> dict[str, Any]:
        """Errors of some of its lines in parts of the pictures, where stored scores have them."""
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
    """A split of a board; without lines where it has no entries.

    Raises:
        RsbenchError: an entry or what is said of the split is damaged.
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
    """``rotation_deg`` as people write it."""
    found = re.fullmatch(r"(\w+)_(deg|m|px)", name)
    return (f"{found[1]} ({found[2]})" if found else name).replace("_", " ")
