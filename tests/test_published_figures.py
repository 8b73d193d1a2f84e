"""Figures on the results pages and in README are those of the committed results."""

from __future__ import annotations

import re
import statistics

import pytest
from documents import ROOT, results, rows, section

from rsbench.benchmark.studies.claims import CLAIMS

DOCS = ROOT / "docs"
PAPER = (DOCS / "results-paper.md").read_text("utf-8")
PUBLISHED = [
    line for path in sorted((ROOT / "results").rglob("*.md")) for line in path.read_text("utf-8").splitlines()
]
README_ROWS = {
    "8-point, global shutter (`gs-8pt`)": "gs-8pt",
    "linear, Wang et al. 2020 (`rs-stereo-linear`)": "rs-stereo-linear",
    "**maximum likelihood** (`rs-stereo-refined`)": "rs-stereo-refined",
    "nothing": "uncorrected",
    "global-shutter motion, scaled matches": "GS motion of scaled matches, SGM depth",
    "**our motion**, best-fitting model": "**ours**",
    "true motion and true depth": "true motion, true depth",
}
"""What README calls a row, and the results."""
README_SOLVERS = ("rs-stereo-refined", "rs-stereo-refined-twist", "gs-stereo-tracks-scaled", "gs-stereo-tracks")


def test_readme_is_short_and_shows_rows_of_the_results() -> None:
    """In plainer words: solvers (without their input column), models at 2 deg, frames at aggressive motion."""
    readme = (ROOT / "README.md").read_text("utf-8")
    assert readme.count("\n") <= 160
    published: dict[str, list[list[str]]] = {}
    for line in PUBLISHED:
        name, *cells = line.strip("| ").split(" | ")
        published.setdefault(name, []).append(cells)
    sweep = {
        (row["variant"], row["solver"]): float(row["e_T_median"])
        for row in results("sweeps/wrong-motion.csv")
        if float(row["value"]) == 2.0
    }
    shown = {name: cells for name, *cells in rows(readme) if re.search(r"\d", " ".join(cells))}
    assert shown.keys() == {*README_ROWS, "`linear`", "`twist`", "`inertial`"}
    pairs = [row[1:] for row in published["rs-stereo-refined-pairs"] if row[0] == "left and right pairs"]
    without_intervals = [", ".join(cell.partition(" ")[0] for cell in row) for row in pairs]
    assert any(f"row 2's matches ({numbers})" in readme for numbers in without_intervals)
    for name, cells in shown.items():
        if name in README_ROWS:
            wanted = cells[1:] if "rs-" in name or "gs-" in name else cells
            wanted = [re.sub(r"\(\+?(-?[\d.]+) to \+?(-?[\d.]+)\)", r"[\1, \2]", cell) for cell in wanted]
            assert wanted in [row[-len(wanted) :] for row in published[README_ROWS[name]]], name
        else:
            errors = [float(f"{sweep[name.strip('`'), solver]:.2g}") for solver in README_SOLVERS]
            assert [float(cell) for cell in cells] == errors, name
    assert (DOCS / "before-after.gif").stat().st_size < 1.5e6


def test_figures_shown_are_those_of_the_committed_results() -> None:
    shown = "|".join(
        ["castle", "old-town", "room", "[gr]s-[a-z0-9-]+", *(re.escape(claim.key) for claim in CLAIMS)]
    )
    lines = re.findall(rf"^\| (?:{shown}) \|.*$", PAPER, re.MULTILINE)
    assert {claim.key for claim in CLAIMS} <= {line.split(" | ")[0].removeprefix("| ") for line in lines}
    assert len(lines) > 40
    assert [line for line in lines if line not in PUBLISHED] == []


def test_the_literal_correction_is_that_of_figure_4() -> None:
    """Least and largest mean of the views over the seeds, on pixels with depth, and that of the uncorrected."""
    seeds: dict[str, list[dict[str, str]]] = {}
    for row in results("fig4/literal.csv"):
        seeds.setdefault(row["ransac_seed"], []).append(row)
    psnr, before = (
        [statistics.mean(float(row[column]) for row in of_seed) for of_seed in seeds.values()]
        for column in ("psnr_drawn", "psnr_rolling_drawn")
    )
    bounds = f"{min(psnr):.1f} to {max(psnr):.1f} dB"
    assert len(seeds) == 10
    text = " ".join(section(PAPER, "Corrected images").split())
    assert f"ten RANSAC seeds have {bounds} on the pixels that have a depth" in text
    assert f"uncorrected frame has {statistics.mean(before):.1f} dB" in text
    assert bounds in " ".join((DOCS / "report.md").read_text("utf-8").split())


# Sentences and tables beyond those above


def page(name: str) -> str:
    """A document as one line."""
    return " ".join((DOCS / name).read_text("utf-8").split())


def test_the_sentence_below_the_corrected_frames_of_readme_is_true_of_its_table() -> None:
    readme = (ROOT / "README.md").read_text("utf-8")
    gains = {
        name: [tuple(map(float, re.findall(r"([+-][\d.]+)", cell))) for cell in cells]
        for name, *cells in rows(readme)
        if name in ("true motion and true depth", "global-shutter motion, scaled matches")
    }
    limit, scaled = gains["true motion and true depth"], gains["global-shutter motion, scaled matches"]
    words = " ".join(readme.split())
    assert f"at most {-min(low for low, _ in limit[:4]):.1f} dB below true motion and depth" in words
    assert f"{-limit[4][1]:.1f} to {-limit[4][0]:.1f} dB under a shake" in words
    assert f"lose at most {max(high for _, high in scaled[:3]):.1f} dB to ours" in words
    assert "{:.1f} to {:.1f} where it grows".format(*scaled[3]) in words
    rectified = (ROOT / "results/rectify/README.md").read_text("utf-8")
    assert "turns the translation by [0.05 to 0.06 deg]" in words
    assert "**0.054 deg per degree of misalignment" in rectified and "below 0.28" in rectified
    corrected = page("explanation/correction.md")
    assert "e_T is 0.05 to 0.06 deg" in corrected and "below 0.28 deg in 95 %" in corrected


def test_what_is_written_about_the_papers_images_and_readings_is_true_of_them() -> None:
    text = page("results-paper.md")
    medians: dict[str, dict[str, float]] = {}
    pose = results("images/scores/pose.csv")
    for scene, solver in {(row["sequence"], row["solver"]) for row in pose}:
        found = [float(row["e_T_deg"]) for row in pose if (row["sequence"], row["solver"]) == (scene, solver)]
        medians.setdefault(scene, {})[solver] = statistics.median(found)
    scenes = ("castle", "old-town", "room")
    best = [min((e, name) for name, e in medians[scene].items() if name.startswith("gs-")) for scene in scenes]
    times = [e / medians[scene]["rs-stereo-refined"] for scene, (e, _) in zip(scenes, best, strict=True)]
    assert best[0][1] == "gs-8pt" and all(name.endswith("-scaled") for _, name in best[1:])
    for scene, (e, _) in zip(scenes[1:], best[1:], strict=True):  # the twist is the reason, not the shutter
        assert medians[scene]["rs-stereo-refined-twist"] >= e
    assert "is {:.0f}, {:.0f} and {:.0f} times as large".format(*times) in text
    views = [row for row in results("images/scores/correction.csv") if row["corrector"] == "fusion"]
    whole = [
        statistics.mean(
            float(row["psnr"])
            for row in views
            if (row["sequence"], row["solver"], row["matcher"], row["pixels"])
            == (scene, "rs-stereo-refined", "sgm", "all")
        )
        for scene in ("castle", "old-town", "room")
    ]
    assert "{:.1f}, {:.1f} and {:.1f} dB".format(*whole) in text
    settings = results("readings/settings.csv")

    def throughout(claim: str, reading: str, verdict: str) -> int:
        return sum(
            row["verdict"] == verdict
            for row in settings
            if (row["claim"], row["reading"]) == (f"{claim} GS" if "better" in claim else claim, reading)
        )

    better = ("translation velocity: better than", "rotation velocity: better than")
    ratio = "readout ratio: GS gets higher errors"
    readings = ("literal", "symmetric")
    assert max(throughout(claim, each, "holds") for claim in better for each in readings) == 2
    assert [throughout(ratio, each, "holds") for each in readings] == [1, 1]
    assert "hold throughout in at most 2 of 8 settings (readout ratio: 1 of 16)" in text
    literal, symmetric = ([throughout(claim, each, "fails") for claim in (*better, ratio)] for each in readings)
    assert "fail throughout in {} and {} of 8 ({} of 16)".format(*literal) in text
    assert "symmetric part in {} and {} of 8 ({} of 16)".format(*symmetric) in text


def test_coverage_on_the_page_of_deviations_is_that_of_the_boards() -> None:
    shown = {
        (row[0].strip("`"), row[1].partition(",")[0].strip("`")): row
        for row in rows(
            section((DOCS / "explanation/deviations.md").read_text("utf-8"), "How often they contain the truth")
        )
        if row[0].startswith("`rs-")
    }
    boards = {
        "points-2": "laws/site/points-2--dev-*.csv",
        "pose-2": "laws/site/pose-2--laws-*.csv",
        "points-1": "leaderboard/site/points-1--dev-*.csv",
        "pose-1": "leaderboard/site/pose-1--standard-*.csv",
    }
    for (method, track), row in shown.items():
        if track == "the same; its model is true for a fifth":
            track = "points-2"
        if track not in boards:
            continue
        (board,) = (ROOT / "results").glob(boards[track])
        (found,) = (
            each for each in results(board.relative_to(ROOT / "results").as_posix()) if each["method"] == method
        )
        share, low, high = (100 * float(found[f"covers_95{end}"]) for end in ("", "_low", "_high"))
        assert row[3] == f"{share:.0f} % [{low:.0f}, {high:.0f}]", (method, track)
        assert float(row[4].removesuffix(" now").rpartition(" ")[2]) == pytest.approx(
            float(found["log_score"]), abs=0.5
        )
        if track == "points-2":
            assert f"{row[3]} " in page("reference/problem-format.md"), method
    assert len(shown) == 6


def test_tables_of_trajectories_r6p_and_speed_are_those_of_the_results() -> None:
    varied = {
        "shake": "shake",
        "frames/s": "rate",
        "frames": "length",
        "matches": "matches",
        "two frames, shake": "shake of two frames",
    }
    found = {(row["sweep"], float(row["value"]), row["entry"]): row for row in results("trajectory/rows.csv")}
    text = section((DOCS / "explanation/correction.md").read_text("utf-8"), "Sequences: one trajectory")
    shown = [row for row in rows(text.partition("| | trajectory |")[2]) if re.search(r"\d", row[0])]
    assert len(shown) == 14
    for name, trajectory, two, nothing in shown:
        number = re.search(r"[\d.]+", name)
        assert number
        key = varied[name.replace(number.group(), "").strip()], float(number.group())
        for entry, cell in (("rs-trajectory", trajectory), ("windows-auto", two), ("no-motion", nothing)):
            row = found[*key, entry]
            ends = [float(row[f"rotation_deg{end}"]) for end in ("", "_low", "_high")]
            for cell_value, value in zip(re.findall(r"[\d.]+", cell), ends, strict=False):
                digits = len(cell_value.partition(".")[2])
                assert float(cell_value) == pytest.approx(value, abs=0.5 * 10.0**-digits + 1e-12), (name, entry)
    limits = {(row["shape"], row["rotation_deg"]): row for row in results("r6p/limits.csv")}
    columns = ("refined_deg", "noisy_deg", "bound_deg", "bound_known_velocity_deg")
    shown = [
        row for row in rows((DOCS / "explanation/tuning.md").read_text("utf-8")) if row[0] in ("box", "plane")
    ]
    assert len(shown) == 6
    for shape, turn, near, *errors in shown:
        row = limits[shape, turn]
        wanted = [float(row[f"near_{each}"]) for each in ("double_still", "double_p3p", "single_still")]
        assert [float(each) for each in near.split(", ")] == pytest.approx(wanted, abs=0.0051)
        assert [float(each) for each in errors] == pytest.approx([float(row[each]) for each in columns], rel=0.13)
    speed = (DOCS / "results-speed.md").read_text("utf-8")
    for row in results("speed/speed.csv"):
        times = "{:.2f} [{:.2f}, {:.2f}]".format(*(float(row[each]) for each in ("median", "lowest", "highest")))
        assert f"| {row['row']} | {row['anchor']} | {times} | {float(row['limit']):g} |" in speed
    for row in results("speed/waits.csv"):
        seconds = "{:.2f} [{:.2f}, {:.2f}]".format(*(float(row[each]) for each in ("seconds", "least", "most")))
        memory = f"{float(row['memory_mb']):.0f} MB" if row["memory_mb"] else "-"
        assert f"| {row['command']} | {seconds} | {float(row['processor_s']):.1f} | {memory} |" in speed
    for gpu, cpu in pairwise_by_backend(results("speed/gpu/frames.csv")):
        kernels = float(gpu["kernels_ms"])
        cells = [
            f"{1000.0 / float(gpu['frame_ms']):.1f}, {float(gpu['rolling_over_global']):.2f}",
            f"{kernels:.{int(kernels < 10)}f}, {float(gpu['copy_ms']):.1f} of {float(gpu['frame_ms']):.0f} ms",
            f"{1000.0 / float(cpu['frame_ms']):.1f}, {float(cpu['rolling_over_global']):.2f}",
            f"{float(gpu['png_ms']):.0f}, {float(gpu['exr_ms']):.0f} ms",
        ]
        assert " | ".join(cells) in speed


def pairwise_by_backend(frames: list[dict[str, str]]) -> list[tuple[dict[str, str], dict[str, str]]]:
    """The rows of the GPU, each with that of the processor for the same frame."""
    cpu = {(row["width"], row["integrator"]): row for row in frames if row["backend"].startswith("llvm")}
    gpu = [row for row in frames if row["backend"].startswith("cuda")]
    assert len(gpu) == len(cpu) == 4
    return [(row, cpu[row["width"], row["integrator"]]) for row in gpu]
