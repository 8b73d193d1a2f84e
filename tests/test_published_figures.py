"""Figures on the results pages and in README are those of the committed results."""

from __future__ import annotations

import re
import statistics

import pytest
from documents import ROOT, results, rows, section

from rsbench.benchmark.studies.claims import CLAIMS
from rsbench.benchmark.studies.correction_bench import METHODS

DOCS = ROOT / "docs"
RESULTS = {path.name: path.read_text("utf-8") for path in sorted((ROOT / "docs").glob("results*.md"))}


README_ROWS = {
    "8-point, global shutter (`gs-8pt`)": "gs-8pt",
    "linear, Wang et al. 2020 (`rs-stereo-linear`)": "rs-stereo-linear",
    "**maximum likelihood** (`rs-stereo-refined`)": "rs-stereo-refined",
    "nothing": "uncorrected",
    "global-shutter motion, scaled matches": "GS motion of scaled matches, SGM depth",
    "**our motion**, best-fitting model": "**ours**",
    "true motion and depth (limit)": "true motion, true depth",
}
"""What README calls a row, and the results pages."""


def test_readme_is_short_and_shows_rows_of_the_results_pages() -> None:
    """In plainer words: solvers (without their input column), models at 2 deg, frames at aggressive motion."""
    readme = (ROOT / "README.md").read_text("utf-8")
    assert readme.count("\n") <= 160
    pages: dict[str, list[list[str]]] = {}
    for text in RESULTS.values():
        for line in text.splitlines():
            name, *cells = line.strip("| ").split(" | ")
            pages.setdefault(name, []).append(cells)
    shown = {name: cells for name, *cells in rows(readme) if re.search(r"\d", " ".join(cells))}
    assert shown.keys() == {*README_ROWS, "`linear`", "`twist`", "`inertial`"}
    for name, cells in shown.items():
        if name in README_ROWS:
            wanted = cells[1:] if "rs-" in name or "gs-" in name else cells
            wanted = [re.sub(r"\(\+?(-?[\d.]+) to \+?(-?[\d.]+)\)", r"[\1, \2]", cell) for cell in wanted]
            found = [row[-len(wanted) :] for row in pages[README_ROWS[name]]]
        else:
            wanted, found = ["2", *cells], pages[name.strip("`")]
        assert wanted in found, name
    assert (DOCS / "before-after.gif").stat().st_size < 1.5e6


def test_figures_shown_are_those_of_the_committed_results() -> None:
    published = {
        line for path in (ROOT / "results").rglob("*.md") for line in path.read_text("utf-8").splitlines()
    }
    shown = "|".join(
        ["castle", "old-town", "room", "[gr]s-[a-z0-9-]+", *(re.escape(claim.key) for claim in CLAIMS)]
    )
    lines = re.findall(rf"^\| (?:{shown}) \|.*$", "\n".join(RESULTS.values()), re.MULTILINE)
    assert {claim.key for claim in CLAIMS} <= {line.split(" | ")[0].removeprefix("| ") for line in lines}
    assert len(lines) > 60
    assert [line for line in lines if line not in published] == []


def test_real_cameras_shown_are_those_of_the_study() -> None:
    text = section(RESULTS["results-correction.md"], "Cameras with lens")
    published = (ROOT / "results" / "real" / "README.md").read_text("utf-8")
    shown = re.findall(r"^(\| [a-z-]+, (?:mild|aggressive) .*)\|$", text, re.MULTILINE)
    assert len(shown) == 8 and all(line in published for line in shown)
    assert max(float(row["sigmas"]) for row in results("real/summary.csv")) < 4.0, "64 of 64"


def test_the_cost_of_a_wrong_motion_model_is_that_of_the_sweep() -> None:
    sweep = {
        (row["variant"], row["value"], row["solver"]): float(row["e_T_median"])
        for row in results("sweeps/wrong-motion.csv")
    }
    header, _, *body = rows(section(RESULTS["results-solvers.md"], "A wrong motion model"))
    solvers = [cell.strip("`") for cell in header[2:]]
    shown = {(data, value, s): float(e) for data, value, *es in body for s, e in zip(solvers, es, strict=True)}
    assert shown.keys() == sweep.keys()
    assert all(shown[key] == float(f"{sweep[key]:.2g}") for key in sweep)


def test_the_cost_of_estimated_motion_is_that_of_the_study() -> None:
    """At most 0.03 dB in any view on covered pixels, 0.16 dB on all."""
    views = {
        (v["stratum"], v["sequence"], v["side"], v["frame"], v["method"]): v
        for v in results("correction/views.csv")
    }
    for column, figure in (("psnr_covered", "0.03 dB"), ("psnr_all", "0.16 dB")):
        worst = max(
            float(view[column]) - float(views[*key[:4], "ours"][column])
            for key, view in views.items()
            if key[4] == "true-motion"
        )
        assert f"{worst:.2f} dB" == figure
        assert f"at most {figure}" in " ".join(RESULTS["results-correction.md"].split())


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
    text = " ".join(section(RESULTS["results-paper.md"], "Corrected images").split())
    assert f"ten RANSAC seeds have {bounds} on the pixels that have a depth" in text
    assert f"uncorrected frame has {statistics.mean(before):.1f} dB" in text
    assert bounds in " ".join((DOCS / "report.md").read_text("utf-8").split())


def test_corrections_shown_are_those_of_the_study() -> None:
    """Covered / all PSNR, and the interval of what ours gains on the covered pixels, of each stratum."""
    summary = {(row["stratum"], row["method"]): row for row in results("correction/summary.csv")}
    keys = {method.title: method.key for method in METHODS}
    shown = rows(section(RESULTS["results-correction.md"], "Correction against"))[2:]
    assert len(shown) > 5
    for title, *cells in shown:
        key = keys[title.removesuffix(" (oracle)").strip("*")]
        for stratum, cell in zip(("mild", "moderate", "aggressive"), cells, strict=True):
            row = summary[stratum, key]
            expected = f"{float(row['psnr_covered']):.1f} / {float(row['psnr_all']):.1f}"
            if key != "ours":
                low, high = (round(float(row[f"gain_{end}"]), 1) + 0.0 for end in ("low", "high"))  # no -0.0
                expected += f" [{low:.1f}, {high:.1f}]"
            assert cell == expected, (title, stratum)


def test_results_tell_the_bound_and_rows_of_the_committed_board() -> None:
    tables = {
        path.name.removesuffix(".md"): path.read_text("utf-8").splitlines()
        for folder in ("leaderboard", "laws", "footage")
        for path in (ROOT / "results" / folder / "site").glob("*.md")
    }

    def table(start: str) -> list[str]:
        (found,) = (lines for name, lines in tables.items() if name.startswith(start))
        return found

    page = RESULTS["results-leaderboard.md"]
    words = " ".join(page.split())
    for protocol, score, column in (("points-1--", "an AUC@5", 3), ("points-2--", "a `near bound`", 4)):
        bound = next(line for line in table(protocol) if line.startswith("| cramer-rao"))
        assert f"reach {score} of {bound.split(' | ')[column]}." in words
    ranked = [each for each in page.split("\n\n") if " rank |" in each.partition("\n")[0]]
    shown = [each.splitlines() for each in ranked]
    boards = (
        *("points-2--", "pose-2--", "readout-3--", "correction-3--"),
        *("points-1--", "pose-1--", "depth-1--", "correction-1--"),
        *("correction-mono-1--footage", "correction-mono-1--standard"),
    )
    for lines, board in zip(shown, boards, strict=True):
        assert set(lines) <= set(table(board)) and len(lines) > 5


# Sentences and tables beyond those above


def page(name: str) -> str:
    """A document as one line."""
    return " ".join((DOCS / name).read_text("utf-8").split())


def test_the_sentence_below_the_corrected_frames_of_readme_is_true_of_its_table() -> None:
    readme = (ROOT / "README.md").read_text("utf-8")
    gains = {
        name: [tuple(map(float, re.findall(r"([+-][\d.]+)", cell))) for cell in cells]
        for name, *cells in rows(readme)
        if name in ("true motion and depth (limit)", "global-shutter motion, scaled matches")
    }
    limit, scaled = gains["true motion and depth (limit)"], gains["global-shutter motion, scaled matches"]
    words = " ".join(readme.split())
    assert f"at most {-min(low for low, _ in limit[:4]):.1f} dB below the limit" in words
    assert f"{-limit[4][1]:.1f} to {-limit[4][0]:.1f} dB under a shake" in words
    assert f"lose at most {max(high for _, high in scaled[:3]):.1f} dB to ours" in words
    assert "{:.1f} to {:.1f} where it grows".format(*scaled[3]) in words
    rectified = (ROOT / "results/rectify/README.md").read_text("utf-8")
    assert "turns the translation by [0.05 deg]" in words and "**0.05 deg per degree of misalignment" in rectified
    assert "below 0.28" in rectified and "below 0.28 deg in 95 %" in page("explanation/correction.md")


def test_what_is_written_about_sweeps_is_true_of_them() -> None:
    wrong = {
        (row["variant"], float(row["value"]), row["solver"]): [
            float(row[f"e_T_median{end}"]) for end in ("", "_low", "_high")
        ]
        for row in results("sweeps/wrong-motion.csv")
    }
    at_two = [each[0] for key, each in wrong.items() if key[:2] == ("accelerated", 2.0)]
    text = page("results-solvers.md")
    assert f"{min(at_two):.1f} to {max(at_two):.1f} deg at 2 deg per frame" in text
    for model in ("twist", "inertial"):
        for turn in (2.0, 4.0, 8.0):  # "from 2 deg per frame on ... worse": intervals apart
            ours = wrong[model, turn, "rs-stereo-refined"]
            for other in ("gs-stereo-tracks", "gs-stereo-tracks-scaled"):
                assert ours[1] > wrong[model, turn, other][2], (model, turn, other)
    ratio = {float(row["value"]): row for row in results("sweeps/wrong-readout.csv") if "pairs" in row["solver"]}
    low, high = sorted(float(ratio[each]["e_T_median"]) for each in (-0.1, 0.1))
    assert f"{low:.2f} to {high:.2f} deg instead of {float(ratio[0.0]['e_T_median']):.2f}" in text
    noisy = {row["solver"]: row for row in results("sweeps/solvers.csv") if float(row["value"]) == 0.3}
    opencv, scaled = (
        [float(noisy[name][f"{error}_median"]) for error in ("e_R", "e_T")]
        for name in ("gs-5pt-opencv", "gs-8pt-scaled")
    )
    assert f"algorithm has {opencv[0]:.2f} deg and {opencv[1]:.1f} deg" in text
    assert f"give {scaled[0]:.3f} deg and {scaled[1]:.2f} deg" in text


def test_what_is_written_about_the_papers_images_and_readings_is_true_of_them() -> None:
    text = page("results-paper.md")
    medians: dict[str, dict[str, float]] = {}
    pose = results("images/scores/pose.csv")
    for scene, solver in {(row["sequence"], row["solver"]) for row in pose}:
        found = [float(row["e_T_deg"]) for row in pose if (row["sequence"], row["solver"]) == (scene, solver)]
        medians.setdefault(scene, {})[solver] = statistics.median(found)
    times = [
        min(e for solver, e in medians[scene].items() if solver.startswith("gs-"))
        / medians[scene]["rs-stereo-refined"]
        for scene in ("castle", "old-town", "room")
    ]
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


def test_recorded_motion_in_short_is_that_of_the_boards() -> None:
    text = page("results.md")
    recordings = results("recorded/recordings.csv")
    covers = [float(row["covers_95"]) for row in recordings if row["method"] == "rs-stereo-auto"]
    assert f"contain the truth in {100 * min(covers):.0f} to {100 * max(covers):.0f} %" in text
    chosen: dict[str, list[bool]] = {}
    for row in results("recorded/choices.csv"):
        chosen.setdefault(row["recording"], []).append(row["chosen"] == "continuous")
    shares = [100 * statistics.mean(each) for each in chosen.values()]
    assert f"spline in {min(shares):.0f} to {max(shares):.0f} %" in text
    for board, rank in (("dev", "1 [1, 1] of"), ("euroc", "1 [1, 2] of")):
        (table,) = (ROOT / "results/recorded/tables").glob(f"points-recorded-1--{board}-*.md")
        (line,) = (line for line in table.read_text("utf-8").splitlines() if line.startswith("| rs-stereo-auto "))
        assert rank in line, board


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
