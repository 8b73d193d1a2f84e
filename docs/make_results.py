"""``make reference``: tables and pictures of docs/results-*.md, from results/.

What stands between the marks of a page is replaced; the words around it are written by hand, and
tests/test_questions.py compares their figures with results/.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from rsbench.benchmark.statistics import format_interval, median_interval
from rsbench.report.board_figures import DotPanel, DotRow, Triple, dots
from rsbench.report.markup import table_lines
from rsbench.storage.files import write_bytes

DOCS = Path(__file__).parent
RESULTS = DOCS.parent / "results"
REPOSITORY = "https://github.com/rsbench/rsbench/blob/main/results"
BEGIN, END = "<!-- From results/ by make reference -->", "<!-- End -->"
NOTHING: Triple = (np.nan, np.nan, np.nan)
Cells = Mapping[str, str]


class Score(NamedTuple):
    """A board, and the score by which it ranks."""

    title: str
    column: str
    file: str
    """Its Markdown file below results/, without the end of its name."""

    @property
    def head(self) -> str:
        """Of its column in a table."""
        return f"{self.title}: {self.column}"

    @property
    def panel(self) -> DotPanel:
        """Of a picture."""
        return DotPanel(self.title, self.column)

    @property
    def path(self) -> Path:
        """Of its table."""
        (path,) = RESULTS.glob(f"{self.file}-*.md")
        return path

    @property
    def link(self) -> str:
        """To its table, by the name of its protocol; the site leads to the interactive one instead."""
        protocol = self.path.stem.partition("--")[0]
        return f"[`{protocol}`]({REPOSITORY}/{self.path.relative_to(RESULTS).as_posix()})"

    def rows(self) -> dict[str, Cells]:
        """The cells of each method by column, the best of those with equal input first."""
        head, _, *rows = [line[2:-2].split(" | ") for line in self.path.read_text("utf-8").splitlines()]
        return {cells[0]: dict(zip(head, cells, strict=True)) for cells in rows}


class Part(NamedTuple):
    """What a page shows of results/."""

    table: list[str]
    """Its lines."""
    picture: str = ""
    """SVG."""
    words: str = ""
    """What the picture shows."""
    boards: Sequence[Score] = ()
    """Where all of it is."""


POINTS = Score("points", "near bound", "laws/site/points-2--dev")
FRAMES = Score("frames", "AUC apart", "laws/site/pose-2--laws")
RECORDED = Score("recorded", "near bound", "recorded/tables/points-recorded-1--dev")
MOTION = (POINTS, FRAMES, RECORDED)
PLACED = Score("frames, five models", "placed x picture", "laws/site/correction-3--laws")
LINEAR = Score("frames, `linear`", "SSIM", "leaderboard/site/correction-1--standard")
RATIO = Score("", "skill", "laws/site/readout-3--laws")
INPUTS = {
    "left": "one camera",
    "left + readout": "one camera, its readout",
    "left + right": "two cameras",
    "left + right + readout": "two cameras, readout",
    "left + right + links": "two cameras, links",
    "left + right + links + readout": "two cameras, links, readout",
}
ORACLE, PAPERS, BOUND = "truth", "rs-stereo-linear", "cramer-rao"
SHOWN = 3
"""How many of the best of all a table of the best of each input has, by each board."""


def triple(cell: str) -> Triple:
    """The numbers of a cell such as ``0.5 [0.4, 0.6]`` or ``0.5``."""
    value, *ends = [float(each) for each in re.findall(r"-?(?:\d[\d.e-]*|nan|inf)", cell)] or [np.nan]
    return (value, *(ends or (np.nan, np.nan)))


def marked(cells: Cells | None, column: str) -> str:
    """The cell of a score, bold where the data do not exclude that no method with as much input is better."""
    if cells is None:
        return "-"
    bold = "**" if re.match(r"\d+ \[1, |alone$", cells["rank"]) else ""
    return f"{bold}{cells[column]}{bold}"


def headed(methods: Sequence[str], of: Mapping[str, Cells], boards: Sequence[Score]) -> Iterator[DotRow]:
    """Rows of a picture below what they use."""
    tables, last = [each.rows() for each in boards], ""
    for method in methods:
        if of[method]["uses"] != last:
            last = of[method]["uses"]
            yield DotRow(f"uses {last}" if last != ORACLE else "given the truth")
        found = [rows.get(method) for rows in tables]
        yield DotRow(
            method,
            [[triple(row[each.column]) if row else NOTHING] for row, each in zip(found, boards, strict=True)],
        )


def compared(methods: Sequence[str], boards: Sequence[Score], beside: Sequence[str], words: str) -> Part:
    """Methods with their scores on boards.

    Args:
        methods: in the order of the first board.
        boards: the first has all methods.
        beside: other columns of the first board.
        words: what the picture shows.
    """
    tables = [each.rows() for each in boards]
    rows = [
        [
            method,
            *(marked(rows.get(method), each.column) for each, rows in zip(boards, tables, strict=True)),
            *(tables[0][method][column] or "-" for column in beside),
        ]
        for method in methods
    ]
    picture = dots([each.panel for each in boards], list(headed(methods, tables[0], boards)))
    head = ["method", *(each.head for each in boards), *beside]
    return Part(table_lines(head, rows), picture, words, boards)


def best_of_inputs() -> dict[str, list[str]]:
    """By input the methods that some board of motion ranks first there, in the order of ``POINTS``."""
    found: dict[str, list[str]] = {uses: [] for uses in INPUTS}
    for rows in (each.rows() for each in MOTION):
        for uses, methods in found.items():
            methods.append(next(name for name, cells in rows.items() if cells["uses"] == uses))
    return {uses: [name for name in POINTS.rows() if name in methods] for uses, methods in found.items()}


def one_camera() -> Part:
    methods = [name for name, cells in POINTS.rows().items() if "right" not in cells["uses"]]
    methods = [name for name in methods if name not in (ORACLE, BOUND)]
    return compared(methods, MOTION, ("assumes", "uses"), "Scores of the methods of one camera on three boards")


def two_cameras() -> Part:
    shown = {PAPERS, BOUND, *(name for names in best_of_inputs().values() for name in names)}
    for each in MOTION:
        ranked = {name: cells for name, cells in each.rows().items() if cells["uses"] != ORACLE}
        shown |= set(sorted(ranked, key=lambda name: -triple(ranked[name][each.column])[0])[:SHOWN])
    methods = [name for name, cells in POINTS.rows().items() if name in shown and _of_two(cells)]
    return compared(methods, MOTION, ("assumes", "uses"), "Scores of methods of two cameras on three boards")


def _of_two(cells: Cells) -> bool:
    return "right" in cells["uses"] or cells["uses"] == ORACLE


def second_camera() -> Part:
    tables, rows, lines = [each.rows() for each in MOTION], list[DotRow](), list[list[str]]()
    for uses, methods in best_of_inputs().items():
        name = methods[0]
        scores = [table[name][each.column] for each, table in zip(MOTION, tables, strict=True)]
        rows.append(DotRow(INPUTS[uses], [[triple(score)] for score in scores]))
        lines.append([INPUTS[uses], name, *scores])
    head = ["input", "best method", *(each.head for each in MOTION)]
    words = "Scores of the best method of each input on three boards"
    return Part(table_lines(head, lines), dots([each.panel for each in MOTION], rows), words, MOTION)


def correction() -> Part:
    boards = (PLACED, LINEAR._replace(title="frames, linear"))
    tables = [each.rows() for each in boards]
    methods = [name for name in tables[0] if name != ORACLE]
    picture = dots([each.panel for each in boards], list(headed(methods, tables[0], boards)))
    lines = []
    for method in methods:
        both = [rows.get(method) for rows in tables]
        scores = [
            cell
            for each, cells in zip(boards, both, strict=True)
            for cell in (marked(cells, each.column), cells["PSNR (dB)"] if cells else "-")
        ]
        lines.append([method, *scores, tables[0][method]["uses"]])
    scores = [f"{each.title}: {column}" for each in boards for column in (each.column, "PSNR (dB)")]
    return Part(
        table_lines(["method", *scores, "uses"], lines), picture, "Scores of correctors on two boards", boards
    )


def rectifying() -> Part:
    cases = pd.read_csv(RESULTS / "rectify" / "points.csv")
    cases = cases[cases["speed"] == 1.0]
    rows, lines = list[DotRow](), list[list[str]]()
    for (angle, ratio), case in cases.groupby(["angle", "ratio"]):
        both = [
            [(float(np.median(each)), *median_interval(each)) for each in (_way(case, way, error) for way in WAYS)]
            for error in ("e_R", "e_T")
        ]
        rows.append(DotRow(f"{angle:g} deg, ratio {ratio:g}", both))
        lines.append([f"{angle:g}", f"{ratio:g}", *(_small(each) for pair in both for each in pair)])
    head = ["angle (deg)", "readout ratio", "e_R (deg): as it is", "rectified", "e_T (deg): as it is", "rectified"]
    panels = [
        DotPanel("rotation", "e_R (deg)", 1e-4, 0.06, True),
        DotPanel("direction of translation", "e_T (deg)", 9e-4, 1.2, True),
    ]
    return Part(table_lines(head, lines), dots(panels, rows, WAYS), "Errors by the angle between the cameras")


WAYS = ("as it is", "rectified")


def _way(case: pd.DataFrame, way: str, error: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return case.loc[case["way"] == way, error].to_numpy(dtype=np.float64)


def _small(numbers: Triple) -> str:
    value, low, high = numbers
    return f"{value:.2g} [{low:.2g}, {high:.2g}]"


def readout() -> Part:
    table, shares = RATIO.rows(), {"right": "right", "wrong": "wrong", "refused": "failed"}
    methods = [name for name in table if name != ORACLE]
    columns = {"skill": "skill", **shares, "in 95 %": "in 95 %"}
    lines = [[name, *(table[name][column] for column in columns.values())] for name in methods]
    rows = [DotRow(name, [[triple(table[name][x])] for x in ("skill", *shares.values())]) for name in methods]
    panels = [DotPanel("score", "skill", -0.7, 1.0), *(DotPanel(name, "share") for name in shares)]
    words = "Skill of the methods, and how often they are right, wrong and refuse"
    return Part(table_lines(["method", *columns], lines), dots(panels, rows), words, [RATIO])


def solvers() -> Part:
    cases = pd.read_csv(RESULTS / "sweeps" / "wrong-motion.csv")
    cases = cases[cases["value"] == DEGREES]
    names, ends = ("e_T_median", "e_T_median_low", "e_T_median_high"), list(dict.fromkeys(cases["variant"]))
    by_case = {key: tuple(rows.iloc[0]) for key, rows in cases.groupby(["solver", "variant"])[list(names)]}
    methods = list(dict.fromkeys(cases["solver"]))
    rows = [DotRow(name, [[by_case[name, law]] for law in ends]) for name in methods]
    lines = [[f"`{name}`", *(format_interval(*by_case[name, law]) for law in ends)] for name in methods]
    panels = [DotPanel(law, "e_T (deg)", 0.02, 3.0, True) for law in ends]
    return Part(table_lines(["solver", *ends], lines), dots(panels, rows), "Errors by the motion of the data")


DEGREES = 2.0
"""Rotation in a frame period of what the page of a wrong motion model shows."""

BOARDS = {
    POINTS: "simulated matches, five motion models",
    RECORDED: "simulated matches, motion of two hands and a car",
    Score("", "near bound", "recorded/tables/points-recorded-1--euroc"): "the same, motion of a drone",
    FRAMES: "matches of frames, five motion models",
    RATIO: "matches of frames, without the readout ratio",
    PLACED: "frames, five motion models",
    Score("", "SSIM", "footage/site/correction-mono-1--footage"): "frames of one camera, a hand and a car",
    Score("", "AUC way", "handheld/site/trajectory-1--handheld"): "matches of whole sequences from hands",
    Score("", "AUC@5", "leaderboard/site/points-1--dev"): "simulated matches, `linear`",
    Score("", "AUC@5", "leaderboard/site/pose-1--standard"): "matches of frames, `linear`",
    Score("", "bad@1", "leaderboard/site/depth-1--standard"): "frames, for depth, `linear`",
    LINEAR: "frames, `linear`",
    Score("", "SSIM", "footage/site/correction-mono-1--standard"): "frames of one camera, `linear`",
    Score("", "AUC@0.1", "leaderboard/site/readout-1--standard"): "as `readout-3`, two ratios, `linear`",
}
"""What methods are given on each."""
SMALLER = ("bad@1",)
"""Scores of which the least is the best."""


def leaderboard() -> Part:
    lines = []
    for board, given in BOARDS.items():
        ranked = {name: cells for name, cells in board.rows().items() if cells["uses"] != ORACLE}
        sign = 1.0 if board.column in SMALLER else -1.0
        best = min(sign * triple(cells[board.column])[0] for cells in ranked.values())
        first = [name for name, cells in ranked.items() if sign * triple(cells[board.column])[0] == best]
        names = ", ".join(f"`{name}`" for name in first)
        lines.append([board.link, given, len(ranked), board.column, names, ranked[first[0]][board.column]])
    return Part(table_lines(["board", "given", "methods", "ranks by", "first", "score"], lines))


PARTS = {
    "one-camera": one_camera,
    "two-cameras": two_cameras,
    "second-camera": second_camera,
    "correction": correction,
    "rectifying": rectifying,
    "readout": readout,
    "solvers": solvers,
    "leaderboard": leaderboard,
}
"""By page ``results-NAME.md``; the picture is ``pictures/NAME.svg``."""


def files() -> dict[str, str]:
    """Contents by path below docs/."""
    found = dict[str, str]()
    for name, make in PARTS.items():
        part, page = make(), f"results-{name}.md"
        shown = [f"![{part.words}](pictures/{name}.svg)", ""] if part.picture else []
        where = [f"All methods: {', '.join(each.link for each in part.boards)}.", ""] if part.boards else []
        lines = [BEGIN, "", *shown, *part.table, "", *where, END]
        before, _, rest = (DOCS / page).read_text("utf-8").partition(BEGIN)
        found[page] = before + "\n".join(lines) + rest.partition(END)[2]
        if part.picture:
            found[f"pictures/{name}.svg"] = part.picture
    return found


def main() -> int:
    for name, text in files().items():
        write_bytes(DOCS / name, text.encode())
        sys.stdout.write(f"{DOCS / name}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
