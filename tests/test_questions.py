"""The pages of questions: what stands between their marks is made of results/, as is every figure around it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from html import unescape
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from documents import ROOT, results, rows
from make_results import BEGIN, END, PARTS, files

from rsbench.benchmark.statistics import format_interval
from rsbench.report.board_figures import DotPanel, DotRow, dots

MADE = files()
ENTRY = "rs-stereo-auto"
Row = Mapping[str, str]


@pytest.mark.parametrize("name", MADE)
def test_the_committed_tables_and_pictures_are_those_of_the_results(name: str) -> None:
    assert (ROOT / "docs" / name).read_text("utf-8") == MADE[name], (
        "run `make reference`, and commit what it wrote"
    )


@pytest.mark.parametrize("name", PARTS)
def test_a_table_has_six_columns_at_most_and_a_page_one_picture(name: str) -> None:
    text = MADE[f"results-{name}.md"]
    made = text.partition(BEGIN)[2].partition(END)[0]
    assert {len(cells) <= 6 for cells in rows(text)} == {True} and len(rows(made)) > 4
    assert (
        made.count("![") == (name != "leaderboard")
        and f"(pictures/{name}.svg)" in made + "(pictures/leaderboard.svg)"
    )


def csv_of(folder: str, start: str) -> dict[str, Row]:
    """The rows of a board's table of numbers, by method."""
    (path,) = (ROOT / "results" / folder / "site").glob(f"{start}-*.csv")
    return {row["method"]: row for row in results(f"{folder}/site/{path.name}")}


POINTS, FRAMES = csv_of("laws", "points-2"), csv_of("laws", "pose-2")
RATIO, CORRECTED = csv_of("laws", "readout-3"), csv_of("laws", "correction-3")


def recorded(end: str) -> dict[str, Row]:
    """The cells of the boards of recordings, of which there is no table of numbers."""
    (path,) = (ROOT / "results/recorded/tables").glob(f"points-recorded-1--{end}-*.md")
    head, _, *body = rows(path.read_text("utf-8"))
    return {cells[0]: dict(zip(head, cells, strict=True)) for cells in body}


HANDS, DRONE = recorded("dev"), recorded("euroc")


def rank(row: Row) -> str:
    return f"{row['rank']} [{row['rank_low']}, {row['rank_high']}]"


def words(row: Row, key: str) -> str:
    return format_interval(*(float(row[f"{key}{end}"]) for end in ("", "_low", "_high")))


def by(folder: str, board: str, method: str, fact: str, column: int = 2) -> dict[str, str]:
    """The score of an entry, or another column, by a fact of the problems, from its page."""
    (page,) = (ROOT / "results" / folder / "site").glob(f"{board}-*/{method}.html")
    table = re.search(rf"By {fact}</h2>.*?</table>", page.read_text("utf-8"), re.DOTALL)
    assert table is not None
    cells = [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", line) for line in table[0].split("<tr>")]
    plain = [[unescape(re.sub(r"<[^>]+>", "", cell)) for cell in line] for line in cells]
    return {line[0]: line[column] for line in plain if len(line) > 3}


def test_cells_are_the_numbers_of_the_boards() -> None:
    """Independent of the Markdown tables that the pages take them from."""
    sources = {
        "one-camera": ((1, POINTS, "near_bound"), (2, FRAMES, "auc_apart")),
        "two-cameras": ((1, POINTS, "near_bound"), (2, FRAMES, "auc_apart")),
        "correction": ((1, CORRECTED, "corrected"), (3, csv_of("leaderboard", "correction-1"), "ssim")),
        "readout": ((1, RATIO, "skill"), (2, RATIO, "right"), (3, RATIO, "wrong"), (5, RATIO, "covers_95")),
    }
    for name, columns in sources.items():
        for cells in rows(MADE[f"results-{name}.md"])[2:]:
            for column, table, key in columns:
                shown = cells[column].strip("*")
                known = cells[0] in table and table[cells[0]][key] != ""
                assert shown == (words(table[cells[0]], key) if known else "-"), (name, cells[0])


def test_bold_are_scores_that_no_ranked_peer_beats() -> None:
    for name in ("one-camera", "two-cameras"):
        for cells in rows(MADE[f"results-{name}.md"])[2:]:
            for column, table in ((1, POINTS), (2, FRAMES)):
                best = cells[0] in table and table[cells[0]]["rank_low"] == "1"
                assert cells[column].startswith("**") == best, cells


# The words around them


def of_one_camera() -> Iterator[str]:
    name, pose = "rs-mono-refined", csv_of("leaderboard", "pose-1")
    one = [row for row in POINTS.values() if row["uses"] in ("left", "left + readout")]
    assert int(POINTS[name]["peers"]) == len(one) == 11
    yield f"first of the {len(one)} methods of one camera (rank {rank(POINTS[name])})"
    yield f"on rendered frames ({rank(FRAMES[name])})"
    yield f"of hands and a car ({HANDS[name]['rank'].partition(' of')[0]})"
    best = [max(table[row["method"]]["near bound"] for row in one) for table in (HANDS,)]
    assert best == [HANDS[name]["near bound"]]
    yield f"has an AUC@5 of {words(pose[name], 'auc_5')}"
    yield f"which ignores the shutter, {words(pose['gs-poselib'], 'auc_5')}"
    linear, accelerated, shakes = (
        float(FRAMES[name][f"auc_apart_{m}"]) for m in ("linear", "accelerated", "spline")
    )
    yield f"has {linear:.2f} under `linear` motion, {accelerated:.2f} under `accelerated`"
    yield f"and {shakes:.2f} under shakes (`spline`)"
    error = {
        row["recording"]: float(row["e_T_deg"])
        for row in results("recorded/recordings.csv")
        if row["method"] == name
    }
    yield f"is {error['car-phone']:.2g} deg in a car"
    yield f"{error['hand-rig']:.0f} and {error['hand-kinect']:.0f} deg in two hands"
    first = DRONE["rs-zhuang-9pt"]["rank"]
    yield f"{error['drone-mav']:.0f} deg on a drone, where `rs-zhuang-9pt` is first ({first})"


def ahead(table: Mapping[str, Row], key: str) -> tuple[str, str]:
    """The score of ours in a part, and that of the next."""
    scores = {name: float(row[key]) for name, row in table.items() if row["rank"]}
    own = scores.pop(ENTRY)
    assert own > max(scores.values())
    return f"{own:.2f}", f"the next {max(scores.values()):.2f}"


def of_two_cameras() -> Iterator[str]:
    assert {rank(POINTS[ENTRY]), rank(FRAMES[ENTRY]), HANDS[ENTRY]["rank"].partition(" of")[0]} == {"1 [1, 1]"}
    yield f"first of {POINTS[ENTRY]['peers']} methods"
    yield "(rank 1 [1, 1] each)"
    drone, other = (DRONE[name]["near bound"].partition(" ")[0] for name in (ENTRY, "rs-r6p"))
    assert DRONE[ENTRY]["rank"].startswith("1 [1, 2]") and DRONE["rs-r6p"]["rank"].startswith("2 [1, 2]")
    yield f"{drone} to {other}, is not significant"
    points, frames = (
        [ahead(table, f"{key}_{model}") for model in ("accelerated", "spline")]
        for table, key in ((POINTS, "near_bound"), (FRAMES, "auc_apart"))
    )
    yield f"Points: {points[0][0]} under `accelerated` motion, {points[0][1]}"
    yield f"and {points[1][0]} under shakes (`spline`: phone, headset, car, drone), {points[1][1]}"
    yield f"Frames: {', '.join(frames[0])}, and {frames[1][0]} (shakes of a hand or a car), {frames[1][1]}."
    given = {"linear": "rs-stereo-refined", "twist": "rs-stereo-refined-twist"}
    right = [float(FRAMES[name][f"auc_apart_{model}"]) for model, name in given.items()]
    chosen = [float(FRAMES[ENTRY][f"auc_apart_{model}"]) for model in given]
    yield f"have {right[0]:.2f} (`linear`) and {right[1]:.2f} (`twist`)"
    yield f"it has {chosen[0]:.2f} and {chosen[1]:.2f}."
    sensor = {name: cell.partition(" ")[0] for name, cell in by("laws", "pose-2", ENTRY, "sensor").items()}
    yield f"it scores {sensor['ideal']} with an ideal simulated sensor and {sensor['real']} with noise"
    covers = [words(POINTS[ENTRY], "covers_95"), words(FRAMES[ENTRY], "covers_95"), HANDS[ENTRY]["in 95 %"]]
    yield f"in {covers[0]} of the points, {covers[1]} of the frames and {covers[2]} of the recorded windows"
    assuming = ("rs-stereo-refined", "rs-stereo-refined-twist", "gs-stereo-tracks-scaled")
    shares = [
        *([float(table[name]["covers_95"]) for name in assuming] for table in (POINTS, FRAMES)),
        [float(HANDS[name]["in 95 %"].partition(" ")[0]) for name in assuming],
    ]
    yield ", ".join(f"{min(each):.2f} to {max(each):.2f}" for each in shares).replace(", 0.08", " and 0.08")
    last = {POINTS["rs-stereo-linear"]["rank"], FRAMES["rs-stereo-linear"]["rank"]}
    assert last == {"15"} and HANDS["rs-stereo-linear"]["rank"].startswith("15 ")
    yield "the last rank of its 15 on all three boards"
    linear = csv_of("leaderboard", "points-1")
    yield f"an AUC@5 of {words(linear['rs-stereo-refined'], 'auc_5')}"
    yield f"drawn from the bound {words(linear['cramer-rao'], 'auc_5')}"
    ways = {
        name: f"{float(row['way_median_deg']):.3g}" for name, row in csv_of("handheld", "trajectory-1").items()
    }
    yield f"error of {ways['rs-trajectory']} deg relative to the first row"
    yield f"two frames {ways['windows-linear']} and {ways['windows-auto']} deg"
    yield f"`gs-vo`, which ignores the shutter, {ways['gs-vo']} deg"
    yield from of_recordings()


def of_recordings() -> Iterator[str]:
    found = {(row["method"], row["recording"]): row for row in results("recorded/recordings.csv")}
    places = sorted({recording for _, recording in found})
    assert len(places) == 4 and {row["problems"] for row in found.values()} == {"60"}
    yield "60 of each recording"
    model, ignoring = "rs-stereo-refined", "gs-stereo-tracks"
    for place in places:  # as much: the interval of one has the median of the other
        low, high = (float(found[model, place][f"e_R_deg{end}"]) for end in ("_low", "_high"))
        assert low < float(found[ignoring, place]["e_R_deg"]) < high
    shares = [100.0 * float(found[model, place]["covers_95"]) for place in places]
    yield f"{min(shares):.0f} to {max(shares):.0f} % of its ellipsoids"
    parts = [float(found[ENTRY, place]["e_R_deg"]) / float(found[model, place]["e_R_deg"]) for place in places]
    assert 0.19 < min(parts) < 0.25 and 0.4 < max(parts) < 0.55, "a fifth to a half"
    chosen = pd.read_csv(ROOT / "results/recorded/choices.csv")
    spline = 100.0 * (chosen["chosen"] == "continuous").groupby(chosen["recording"]).mean()
    yield f"a spline in {spline.min():.0f} to {spline.max():.0f} % of the windows"
    of_splines = chosen[(chosen["chosen"] == "continuous") & chosen["nees"].notna()]
    assert (of_splines["nees"] < 12.6).all(), (
        "all ellipsoids contain the truth: 95 % of chi-square with six degrees"
    )
    ratio = of_splines.groupby("recording")["nees"].median() / 5.348  # the median of that distribution
    assert 5.0 < ratio.max() ** -0.5 < 6.0 and 6.0 < ratio.min() ** -0.5 < 7.5, "five to seven times too large"
    bends = {row["recording"]: row for row in results("recorded/resampling.csv")}
    noise, own = (
        [float(bends[f"hand-{x}"][key]) for x in ("rig", "kinect")] for key in ("noise_bend_deg", "bend_deg")
    )
    yield f"turn by {own[0]:.2g} and {own[1]:.2g} deg"
    yield f"noise alone would by {noise[0]:.2g} and {noise[1]:.2g} deg"


def of_a_second_camera() -> Iterator[str]:
    one, pairs, linked = "rs-mono-refined", "rs-stereo-refined-pairs", "rs-stereo-refined"
    yield f"rises from {HANDS[one]['near bound']} to {HANDS[pairs]['near bound']} without links"
    assert HANDS[one]["assumes"] == HANDS[linked]["assumes"] == HANDS[pairs]["assumes"] == "linear"
    yield f"to {HANDS[linked]['near bound']} with links under the same motion model"
    yield f"and to {HANDS[ENTRY]['near bound']} if the model is chosen too"
    assert "mono-fusion" in CORRECTED["fusion"]["ties"].split(), "do not differ significantly"
    linear = csv_of("leaderboard", "points-1")
    places = [f"{rank(row)} of {row['peers']}" for row in (POINTS[pairs], linear[pairs])]
    yield f"({places[0]}; on `points-1` {places[1]})"
    assert one in FRAMES[pairs]["ties"].split()
    yield f"frames ({rank(FRAMES[pairs])})"
    yield f"first ({HANDS[pairs]['rank'].partition(' of')[0]})"
    links = [row for row in FRAMES.values() if row["uses"] == "left + right + links"]
    yield f"alone has {words(max(links, key=lambda row: float(row['auc_apart'])), 'auc_apart')} there"
    yield f"the ratio alone {words(FRAMES[pairs], 'auc_apart')}, with"
    both = [row for row in FRAMES.values() if row["uses"].endswith("links + readout")]
    one_model = [row for row in both if row["assumes"] != "chosen"]
    yield f"one model {words(max(one_model, key=lambda row: float(row['auc_apart'])), 'auc_apart')}"
    yield f"if the model is chosen {words(FRAMES[ENTRY], 'auc_apart')}"
    scores = [words(CORRECTED[name], "corrected") for name in ("fusion", "mono-fusion")]
    yield f"has {scores[0]} on `correction-3`, `mono-fusion` {scores[1]}"
    rig, alone = (by("laws", "correction-3", name, "sensor") for name in ("fusion", "mono-fusion"))
    yield f"they have {rig['ideal']} and {alone['ideal']}"
    yield f"{rig['real']} and {alone['real']}."
    table = rows((ROOT / "docs/explanation/one-camera.md").read_text("utf-8").partition("## A second camera")[2])
    gains = {cells[0]: cells[4].partition(", ")[2] for cells in table[2:]}
    assert max(gains.values(), key=float) == gains["spline (shakes)"]
    yield f"{gains['spline (shakes)']} dB in the mean"


def of_correction() -> Iterator[str]:
    fusion, mono = CORRECTED["fusion"], CORRECTED["mono-fusion"]
    assert (mono["peers"], fusion["peers"]) == ("5", "11") and fusion["ties"] == "mono-fusion single-view"
    yield f"five entries of one camera (rank {rank(mono)})"
    yield f"the highest score of all {fusion['peers']} ({rank(fusion)})"
    for name in ("lao-lines", "purkait-manhattan"):
        assert float(CORRECTED[name]["corrected"]) < float(CORRECTED["uncorrected"]["corrected"])
    true = CORRECTED["fusion-true"]
    yield f"cost `fusion` {float(true['corrected']) - float(fusion['corrected']):.2f}**"
    yield f"it has {words(true, 'corrected')}"
    yield f"has {words(CORRECTED['rotation-only'], 'corrected')}. `single-view`"
    failed = {fact: by("laws", "correction-3", "fusion", fact, -1) for fact in ("scene", "sensor")}
    assert (
        failed["scene"]["poles"] == failed["sensor"]["real"] == "3" == str(round(180 * float(fusion["failure"])))
    )
    two = csv_of("footage", "correction-mono-1--footage")
    ranked = {name for name, row in two.items() if row["rank"]}
    for name in ranked:  # no difference is significant
        peers = {
            each for each in ranked if set(two[each]["uses"].split(" + ")) <= set(two[name]["uses"].split(" + "))
        }
        assert set(two[name]["ties"].split()) == peers - {name}
    linear = csv_of("footage", "correction-mono-1--standard")
    yield f"first of five ({rank(linear['mono-fusion'])}), with {float(linear['mono-fusion']['psnr']):.1f} dB"
    yield f"`flow-scaled` has {float(linear['flow-scaled']['psnr']):.1f}."
    yield from of_baselines()


def of_baselines() -> Iterator[str]:
    views = {
        tuple(v[key] for key in ("stratum", "sequence", "side", "frame", "method")): v
        for v in results("correction/views.csv")
    }
    for column, on in (("psnr_covered", "in any view on these pixels"), ("psnr_all", "on all pixels")):
        costs = [
            float(view[column]) - float(views[*key[:4], "ours"][column])
            for key, view in views.items()
            if key[4] == "true-motion"
        ]
        yield f"at most {max(costs):.2f} dB {on}"
    gains = {row["stratum"]: row for row in results("correction/summary.csv") if row["method"] == "gs-scaled"}
    for stratum, on in (("mild", "dB at 0.4 deg"), ("moderate", "dB at 2 deg"), ("aggressive", "dB at 6 deg")):
        value, low, high = (float(gains[stratum][f"gain{end}"]) for end in ("", "_low", "_high"))
        yield f"{value:.1f} [{low:.1f}, {high:.1f}] {on}"
    laws = {
        tuple(row[key] for key in ("stratum", "method")): row for row in results("laws-correction/summary.csv")
    }

    def psnr(model: str, method: str) -> str:
        return f"{float(laws[f'{model}, aggressive', method]['psnr_covered']):.1f}"

    steady = ("linear", "twist", "inertial")
    yield "is {}, {} and {} dB under".format(*(psnr(model, "ours") for model in steady))
    yield "have {}, {} and {} dB, and".format(*(psnr(model, "gs-scaled") for model in steady))
    fast = psnr("accelerated", "ours"), psnr("accelerated", "gs-scaled")
    yield f"{fast[0]} dB under `accelerated` motion, where they have {fast[1]} dB"
    yield f"get {psnr('spline', 'ours')} dB; with the true motion and depth {psnr('spline', 'truth')} dB"
    wrong = [laws[f"{model}, aggressive", given] for model in steady for given in ("linear", "twist")]
    yield f"up to {max(float(row['gain_high']) for row in wrong):.1f} dB among"
    faster = [laws["accelerated, aggressive", given] for given in ("linear", "twist")]
    ends = min(float(row["gain_low"]) for row in faster), max(float(row["gain_high"]) for row in faster)
    yield f"and {ends[0]:.1f} to {ends[1]:.1f} dB under `accelerated`"
    real = results("real/summary.csv")
    after = {
        camera: [float(row["psnr_median"]) for row in real if row["camera"] == camera]
        for camera in ("real", "ideal")
    }
    yield f"gets {min(after['real']):.1f} to {max(after['real']):.1f} dB after correction"
    yield f"motions {min(after['ideal']):.1f} to {max(after['ideal']):.1f} dB"
    assert max(float(row["sigmas"]) for row in real) < 4.0
    count = sum(int(row["sequences"]) for row in real if row["camera"] == "real")
    yield f"In {count} of {count} sequences"


def of_rectifying() -> Iterator[str]:
    cases = pd.read_csv(ROOT / "results/rectify/points.csv")
    keys = ["angle", "ratio", "speed"]
    apart = cases.pivot_table(index=[*keys, "seed"], columns="way", values=["e_R", "e_T"])

    def spread(way: str) -> str:
        eight = np.sort(apart["e_T"][way].loc[1.0, 1.0, 1.0])
        return f"{np.median(eight):.2g} [{eight[0]:.2g}, {eight[-1]:.2g}] deg"

    yield spread("rectified")
    yield spread("as it is")
    worse = pd.concat(
        [(apart[e]["rectified"] > apart[e]["as it is"]).groupby(keys).sum() for e in ("e_R", "e_T")], axis=1
    )
    for (angle, ratio, speed), counts in worse.iterrows():
        if speed == 1.0 and (angle >= 2.0 or (angle == 1.0 and ratio >= 0.6)):
            assert (counts == 8).all(), (angle, ratio)
    assert (worse.loc[1.0, 0.2, 1.0] == 6).all()
    biased = cases[(cases["way"] == "rectified") & (cases["angle"] >= 0.5)]
    unit = biased["e_T"] / (biased["angle"] * biased["ratio"])
    yield f"direction is {unit.median():.3f} deg per degree"
    yield f"below {unit.quantile(0.95):.2f} in 95 %"


def of_the_ratio() -> Iterator[str]:
    own = RATIO[ENTRY]
    assert own["peers"] == "4"
    yield f"first of four (rank {rank(own)})"
    yield f"in {words(own, 'right')} of 180 pairs"
    yield f"a wrong one in {words(own, 'wrong')}, and refuses {words(own, 'failure')}"
    models = {model: float(own[f"skill_{model}"]) for model in ("linear", "twist", "inertial", "accelerated")}
    assert float(own["skill_spline"]) == 0.0
    yield "0.00 under the shakes of a hand or a car"
    yield f"and {min(models.values()):.2f} to {max(models.values()):.2f} under"
    sensor = by("laws", "readout-3", ENTRY, "sensor")
    yield f"skill is {sensor['ideal']}, with a real one {sensor['real']}"


def of_models() -> Iterator[str]:
    sweep = {
        (row["solver"], row["variant"], float(row["value"])): row for row in results("sweeps/wrong-motion.csv")
    }

    def error(solver: str) -> str:
        return words(sweep[solver, "inertial", 2.0], "e_T_median")

    yield f"by {error('rs-stereo-refined')} deg"
    yield f"by {error('gs-stereo-tracks')} deg"
    fast = [float(row["e_T_median"]) for key, row in sweep.items() if key[1:] == ("accelerated", 2.0)]
    yield f"{min(fast):.1f} to {max(fast):.1f} deg"
    pairs = {
        float(row["value"]): f"{float(row['e_T_median']):.2f}"
        for row in results("sweeps/wrong-readout.csv")
        if row["solver"] == "rs-stereo-refined-pairs"
    }
    right, low, high = (pairs[at] for at in (0.0, 0.1, -0.1))
    yield f"from {right} to {min(low, high)} or {max(low, high)} deg"


FACTS = {
    "one-camera": of_one_camera,
    "two-cameras": of_two_cameras,
    "second-camera": of_a_second_camera,
    "correction": of_correction,
    "rectifying": of_rectifying,
    "readout": of_the_ratio,
    "solvers": of_models,
}
SETTINGS = {
    "one-camera": ("95 % intervals; 1 is best", "is 1 at", "and 0 at", "to 0.1 deg", "to 1 deg"),
    "two-cameras": ("95 % ellipsoids", "of 30 frames", "from 0.5 to 1;"),
    "second-camera": (),
    "correction": (
        "95 % intervals; 1 is best",
        "180 pairs",
        "216 pairs",
        "at 6 deg (end",
        "At 6 deg and 0.4 m",
        "10 ms",
        "ISO 400",
        "than 4 stated",
    ),
    "rectifying": (
        "ratio of 1,",
        "at 2 deg and 0.25 m",
        "1000 matches with 0.05 px",
        "From 0.5 deg",
        "From 2 deg",
        "ratio of 0.6 on at 1 deg",
        "at 1 deg and a ratio of 0.2",
    ),
    "readout": (
        "right to 0.1",
        "1 for exact ratios, 0 for a refusal and at most 0 for",
        "In 95 %",
        "between 0.1 and 0.95",
    ),
    "solvers": (
        "at 2 deg per frame",
        "95 % interval, of 200 trials",
        "0.1 px of noise",
        "+-0.1",
        "at 0.1 px",
        "0.3 px of noise, 2 deg per frame, 100 matches per camera",
        "300 trials [95 % interval]",
    ),
}
"""Sizes of experiments, and ends of scales."""


@pytest.mark.parametrize("name", FACTS)
def test_every_figure_around_a_table_is_one_of_the_results(name: str) -> None:
    text = (ROOT / f"docs/results-{name}.md").read_text("utf-8")
    before, _, rest = text.partition(BEGIN)
    prose = re.sub(r"^\|.*$", "", before + rest.partition(END)[2], flags=re.MULTILINE)
    left = " ".join(prose.split())
    for fact in [*FACTS[name](), *SETTINGS[name]]:
        assert fact in left, fact
        left = left.replace(fact, " ")
    left = re.sub(r"!?\[([^]]*)\]\([^)]*\)|`[^`]*`", r"\1", left)
    assert re.findall(r".{0,20}\d+.{0,20}", left) == []


def test_rows_typed_by_hand_are_published() -> None:
    """Of the table of the statistical limit."""
    published = (ROOT / "results/sweeps/README.md").read_text("utf-8").splitlines()
    text = (ROOT / "docs/results-solvers.md").read_text("utf-8").partition(END)[2]
    shown = [line for line in text.splitlines() if re.match(r"\| [rg]s-", line)]
    assert len(shown) == 7 and set(shown) <= set(published)


# Pictures


def _marks(svg: str) -> Iterable[tuple[float, float]]:
    return [(float(x), float(y)) for x, y in re.findall(r"translate\(([\d.]+) ([\d.]+)\) scale", svg)]


@pytest.mark.parametrize("logarithmic", [False, True])
def test_a_dot_stands_at_the_tick_of_its_value(logarithmic: bool) -> None:
    ticks = (0.01, 0.1, 1.0) if logarithmic else (0.0, 0.5, 1.0)
    panel = DotPanel("p", "s", ticks[0], ticks[-1], logarithmic)
    nothing = (np.nan, np.nan, np.nan)
    lines = [DotRow("head"), *(DotRow("row", [[(at, ticks[0], ticks[-1])], [nothing]]) for at in ticks)]
    svg = dots([panel, panel], lines)
    grid = [float(x) for x in re.findall(r'd="M([\d.]+) \d+V', svg)][:3]
    assert [x for x, _ in _marks(svg)] == grid
    ends = [tuple(map(float, each)) for each in re.findall(r'd="M([\d.]+) [\d.]+H([\d.]+)M', svg)]
    assert ends == [(grid[0], grid[-1])] * 3


def test_a_picture_has_a_dot_for_each_score_of_its_table() -> None:
    for name in ("one-camera", "two-cameras", "second-camera", "readout"):
        cells = [cell for line in rows(MADE[f"results-{name}.md"])[2:] for cell in line]
        shown = [cell for cell in cells if re.fullmatch(r"\**-?\d[\d.]* \[.*\]\**", cell)]
        apart = len(rows(MADE["results-readout.md"])[2:]) - 1 if name == "readout" else 0  # coverage is not drawn
        assert len(list(_marks(MADE[f"pictures/{name}.svg"]))) == len(shown) - apart


def test_the_pages_stand_beside_each_other_without_dates() -> None:
    months = "January|February|March|April|May|June|July|August|September|October|November|December"
    for name in PARTS:
        text = Path(ROOT / f"docs/results-{name}.md").read_text("utf-8")
        assert not re.search(rf"\b({months})\b|\b20\d\d-\d\d|[Ss]ince |days? later", text), name
