"""``rsbench evaluate``: run solvers, depth and correction on a dataset and score them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rsbench.cli.cluster_options import Scheduler, chosen_workers, results_at, shared_path
from rsbench.cli.console import echo, print_table, progress_bar, say
from rsbench.cli.names import named
from rsbench.core.errors import RsbenchError

if TYPE_CHECKING:
    import pandas as pd

    from rsbench.benchmark.images.plan import EvaluationOptions
    from rsbench.dataset.recording import Recording
    from rsbench.jobs.process_jobs import Workers

EPILOG = """[bold]Examples[/bold]

  rsbench evaluate data/paper --out results/paper

  rsbench evaluate data/paper --out results/paper --solver mine.toml     [dim](the others are kept)[/dim]

  rsbench evaluate data/paper --out results/paper --only gs-8pt --force  [dim](made again alone)[/dim]

DIR gets [bold]predictions/[/bold], [bold]scores/*.csv[/bold] (rsbench docs score-files), [bold]pictures/[/bold],
[bold]report.html[/bold] and [bold]provenance.json[/bold]. What was predicted before, from the same data and
components, is kept and scored; nothing is deleted."""


_OF_A_RIG = "fusion"


def evaluate(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with a dataset.json.")],
    out: Annotated[
        str,
        typer.Option(
            metavar="DIR",
            help="Folder for predictions, scores, pictures and the report, or a URL such as s3://bucket/folder.",
        ),
    ],
    solver: Annotated[
        list[str] | None,
        named(
            "solvers", "Solver to score: name, card or FILE.py; repeatable. Default: all that come with rsbench."
        ),
    ] = None,
    correct_with: Annotated[
        str, named("solvers", "Solver whose motion the correction uses; it is scored too.")
    ] = "rs-stereo-refined",
    matcher: Annotated[str, named("matchers", "Stereo matcher, a name or a card.")] = "sgm",
    features: Annotated[str, named("features", "Feature matcher, a name or a card.")] = "sift",
    corrector: Annotated[str, named("correctors", "Corrector, a name or a card.")] = _OF_A_RIG,
    metric: Annotated[
        list[str] | None, named("metrics", "Metric that adds columns, a name or a card; repeatable.")
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="SOLVER|SEQUENCE", help="Predict only this; repeatable. All predictions are scored."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Repeat predictions that are up to date.")] = False,
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each solver, with different RANSAC samples.")] = 1,
    seed: Annotated[int, typer.Option(help="Seed of every random choice.")] = 0,
    rehash: Annotated[
        bool, typer.Option("--rehash", help="Read and score all data again, not only what changed.")
    ] = False,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Processes; each predicts and scores whole sequences. Default: 1."),
    ] = None,
    scheduler: Scheduler = None,
    layout: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="LAYOUT",
            help="Layout of DIR, if it is not rsbench's: carla-rs, colmap, euroc, fastec-rs, ...",
        ),
    ] = None,
) -> None:
    """Score pose, depth and correction against the truth of a dataset, and write a report."""
    if layout is not None:
        with results_at(out, scheduler) as place:
            _evaluate_others(folder, place, layout, matcher, corrector, seed)
        return
    from rsbench.benchmark.images.plan import EvaluationOptions

    processes, command = chosen_workers(workers, scheduler), f"rsbench evaluate {folder} --out {out}"
    options = EvaluationOptions(
        solvers=tuple(solver or every_solver()),
        correction_solver=correct_with,
        features=features,
        matcher=matcher,
        corrector=corrector,
        metrics=tuple(metric or ()),
        only=tuple(only or ()),
        force=force,
        seeds=seeds,
        seed=seed,
        rehash=rehash,
    )
    with results_at(out, scheduler) as place:
        evaluate_dataset(shared_path(folder, scheduler), place, options, command, processes)


def _evaluate_others(folder: Path, out: Path, layout: str, matcher: str, corrector: str, seed: int) -> None:
    """Evaluate a dataset in another layout and write tables: depth of pairs with disparities, motion of one camera
    with poses, and correction of its frames with global-shutter images."""
    from rsbench.benchmark.recordings import depth_scores, pose_scores
    from rsbench.interop.readers.layouts import read_others
    from rsbench.storage.files import check_out, write_table
    from rsbench.storage.object_store import name_of
    from rsbench.vision.stereo_matcher import load_matcher

    check_out(out)
    recordings = read_others(folder, layout)
    for note in dict.fromkeys(note for recording in recordings for note in recording.notes):
        say(note)
    tables = {
        "depth": depth_scores(recordings, load_matcher(matcher)),
        "pose": pose_scores(recordings, seed),
        "correction": _correction_scores(recordings, corrector),
    }
    if all(table.empty for table in tables.values()):
        raise RsbenchError(
            f"{folder}: has neither pairs with disparities nor successive frames with poses or a global shutter's "
            "images"
        )
    for name, table in tables.items():
        if not table.empty:
            (out / "scores").mkdir(parents=True, exist_ok=True)
            write_table(out / "scores" / f"{name}.csv", table)
            print_table(name, table if name != "correction" else _means(table))
    echo(f"scores: {name_of(out / 'scores')}")


def _correction_scores(recordings: Sequence[Recording], corrector: str) -> pd.DataFrame:
    """Score two correctors of one camera: flow-scaled, and ``corrector`` or, if it is the default, mono-fusion."""
    from rsbench.benchmark.recordings import check_sees_one_camera, correction_scores, pairs_with_truth
    from rsbench.vision.corrector import load_corrector

    names = dict.fromkeys(("flow-scaled", "mono-fusion" if corrector == _OF_A_RIG else corrector))
    pairs, entries = pairs_with_truth(recordings), [load_corrector(name) for name in names]
    if not pairs:
        return correction_scores([], [])
    for entry in entries:
        check_sees_one_camera(entry)
    with progress_bar("correcting", len(pairs)) as advance:
        return correction_scores(pairs, entries, advance)


def _means(table: pd.DataFrame) -> pd.DataFrame:
    """Return mean scores over the pairs, by target row and method."""
    groups = table.groupby(["row", "method"], sort=False)
    means = groups[["psnr", "ssim", "psnr_mask", "ssim_deepunroll"]].mean().dropna(axis="columns")
    means.insert(0, "frames", groups.size())
    means.insert(1, "failed", groups["success"].agg(lambda each: int((~each).sum())))
    return means.reset_index()


_ON_REQUEST = (
    "rs-12param-affine",  # needs affine frames of matches
    *("rs-12param", "rs-dai-linear", "rs-dai-uniform", "rs-mono-refined", "rs-zhuang-8pt", "rs-zhuang-9pt"),
    *("gs-p3p", "gs-stereo-triplets", "gs-stereo-triplets-lines", "rs-r6p", "rs-r6p-single"),
    *("gs-upright-3pt", "gs-upright-4pt", "rs-gyro-5pt", "rs-gyro-stereo"),  # need a sensor
)
"""Solvers that run only if they are named, because they would double the time; most are on boards of frames."""


def every_solver() -> list[str]:
    """Return the names of shipped and installed solvers, each once, without those that run only if named."""
    from rsbench.solvers.engine.base import list_solvers

    return [name for name in list_solvers() if name not in _ON_REQUEST]


def evaluate_dataset(
    folder: Path, out: Path, options: EvaluationOptions, command: str, workers: Workers = 1
) -> Path:
    """Evaluate with a progress bar, print the tables, and return the path of the report."""
    from rsbench.benchmark.images.evaluation import open_evaluation
    from rsbench.cli.compile_ahead import compiling_ahead
    from rsbench.report.evaluation_page import summary_tables, write_report
    from rsbench.storage.object_store import name_of

    evaluation = open_evaluation(folder, out, options)
    with compiling_ahead(), progress_bar(f"evaluating {folder.name}", evaluation.steps) as advance:
        stale = evaluation.run(command, advance, workers)
    for table in summary_tables(out):
        print_table(table.title, table.brief)
    if stale:
        why = "made from other data, components or options, or by a card that was not named"
        echo(f"not scored, {why}: {', '.join(stale)}", err=True)
    page = write_report(folder, out)
    echo(f"report: {name_of(page)}")
    return page
