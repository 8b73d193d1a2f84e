"""``rsbench verify``: check a dataset against its card, its manifests and itself; and ``rsbench digest``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from rsbench.cli.console import echo, late_progress, print_rows, print_table, progress_bar, report_faults, say
from rsbench.cli.names import named
from rsbench.core.errors import RsbenchError

EPILOG = """[bold]Examples[/bold]

  rsbench verify data/paper

  rsbench verify data/paper --fast           [dim](in a hurry: says what it leaves out)[/dim]

  rsbench verify data/paper --workers 2      [dim](a process and a scene in memory each)[/dim]

  rsbench verify data/mine --scene my/scene.toml --rerender all

  rsbench verify Carla-RS/test --from carla-rs     [dim](a layout of others: rsbench docs others)[/dim]"""


_FAST_STRIDE = 4
_LEFT_OUT = (
    "--fast left out: rows rendered again, so that light alone, or all pictures alike, may be wrong; and all but "
    "every {stride}th pixel in both directions where pictures are compared, so that a fault of few pixels may be"
)


class Rerender(StrEnum):
    """Rows that are rendered again."""

    NO = "no"
    AUTO = "auto"
    ALL = "all"


def verify(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with a dataset.json.")],
    stride: Annotated[int, typer.Option(min=1, help="Compare every n-th pixel in both directions.")] = 1,
    rerender: Annotated[
        Rerender, typer.Option(help="Rows to render again, if the scene can be built here; auto takes seconds.")
    ] = Rerender.AUTO,
    scene: Annotated[
        list[str] | None, named("scenes", "Card, or moving mesh, that is not rsbench's own; repeatable.")
    ] = None,
    fast: Annotated[
        bool,
        typer.Option("--fast", help="Compare every 4th pixel in both directions, and render nothing again."),
    ] = False,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Processes; each checks whole sequences. Default: 1."),
    ] = None,
    reference: Annotated[
        bool,
        typer.Option(
            "--reference",
            help="Also compare with rsbench's reference copy of the card standard: equal bytes or similar images.",
        ),
    ] = False,
    layout: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="LAYOUT",
            help="Layout of DIR, if it is not rsbench's: carla-rs, colmap, euroc, fastec-rs, ...",
        ),
    ] = None,
) -> None:
    """Check a dataset: files, poses, depth maps and images against each other and against rows rendered again."""
    if layout is not None:
        _verify_others(folder, layout)
        return
    import pandas as pd

    from rsbench.dataset.manifest import DATASET
    from rsbench.storage.files import read_json
    from rsbench.verification import verification_steps, verify_dataset

    faults = _reference_faults(folder) if reference else []
    stride, rerender = (max(stride, _FAST_STRIDE), Rerender.NO) if fast else (stride, rerender)
    scenes = [Path(each) for each in scene or []]
    with progress_bar("verifying", verification_steps(read_json(folder / "dataset.json"))) as advance:
        reports = verify_dataset(
            folder, stride, advance, rerender=rerender.value, scenes=scenes, workers=workers or 1
        )
    rows = [
        {
            "sequence": report.name,
            "depth of": agreement.source,
            "against": agreement.target,
            "pixels": agreement.compared,
            "agree (%)": 100 * agreement.share,
            "p99 difference": f"{agreement.p99:.1e}",
        }
        for report in reports
        for agreement in report.agreements
    ]
    if rows:
        print_table("Depth agreement between frames (relative tolerance 1e-4)", pd.DataFrame(rows))
    for note in [f"{report.name}: {note}" for report in reports for note in report.notes]:
        say(note)
    if fast:
        say(_LEFT_OUT.format(stride=stride))
    faults += [f"{report.name}: {fault}" for report in reports for fault in report.faults]
    count = sum(report.name != DATASET for report in reports)
    report_faults(faults, f"{folder}: {count} sequences, {len(faults)} faults")


def _reference_faults(folder: Path) -> list[str]:
    """Return the differences from the reference copy, and print how many sequences agree."""
    from rsbench.verification.digests import against_reference

    found = list(against_reference(folder))
    same = sum(each.same for each in found)
    faults = [f"{each.name}: {each.fault}" for each in found if each.fault]
    alike = len(found) - same - len(faults)
    echo(f"reference copy: {same} of {len(found)} sequences have its bytes, {alike} are alike")
    return faults


def _verify_others(folder: Path, layout: str) -> None:
    """Check a dataset in another layout: files, sizes, and, if there are any, disparities, depth and matches, by
    poses and row times."""
    from rsbench.interop.readers.check import NEAR_PX, agreements, disparity_faults, file_faults, sights
    from rsbench.interop.readers.layouts import read_others

    recordings, faults = read_others(folder, layout), list[str]()
    depths, seen = list[list[str]](), list[list[str]]()
    with late_progress("Checking") as advance:
        for recording in recordings:
            for note in recording.notes:
                say(f"{recording.name}: {note}")
            found = [*file_faults(recording, advance), *disparity_faults(recording)]
            for each in agreements(recording):
                found += [each.fault] if each.fault else []
                share, typical = f"{100 * each.share:.2f}", f"{each.typical:.1e}"
                depths.append(
                    [recording.name, each.side, *map(str, each.frames), str(each.pixels), share, typical]
                )
            for sight in sights(recording):
                advance(sight.what)
                found += [sight.fault] if sight.fault else []
                row = str(sight.count), f"{100 * sight.share:.1f}", f"{sight.typical:.2f}"
                if sight.count:
                    seen.append([recording.name, sight.what, *row])
            faults += [f"{recording.name}: {fault}" for fault in found]
    if depths:
        columns = ["recording", "camera", "depth of", "against", "pixels", "agree (%)", "typical difference"]
        print_rows("Depth agreement between frames (relative tolerance 1e-2)", columns, depths, right=columns[4:])
    if seen:
        columns = ["recording", "seen", "count", f"within {NEAR_PX:g} px (%)", "typical (px)"]
        print_rows("Features where cameras and poses say", columns, seen, right=columns[2:])
    report_faults(faults, f"{folder}: {len(recordings)} recordings, {len(faults)} faults")


DIGEST_EPILOG = """[bold]Examples[/bold]

  rsbench digest data/paper --out paper.txt

  rsbench digest data/paper --check paper.txt

A digest covers the frames, depth, poses and channels of a sequence, and the motion, cameras and scene in its
sequence.json, but no dates, versions and pages. Another kind of processor may give other digests; where rsbench
has a reference copy, [bold]rsbench verify --reference[/bold] says whether pictures are alike.

Exit codes: 0 done, 1 a digest differs, 2 an input is wrong."""


def digest(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with a dataset.json.")],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="File for the digests. Default: standard output.")
    ] = None,
    check: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Digests of an earlier copy, to compare with.")
    ] = None,
) -> None:
    """Write a SHA-256 for each sequence of a dataset, or check those of an earlier copy."""
    from rsbench.storage.files import write_bytes
    from rsbench.verification.digests import differences, digests, read_digests, text_of

    if out is not None and check is not None:
        raise RsbenchError("--out and --check: give one of them")
    known = None if check is None else read_digests(check)
    found = dict[str, str]()
    with late_progress("digesting") as advance:
        for name, value in digests(folder):
            found[name] = value
            advance(name)
    if out is not None:
        write_bytes(out, text_of(found).encode())
    if known is None:
        echo(f"{out}: digests of {len(found)} sequences" if out else text_of(found), nl=out is not None)
        return
    faults = differences(found, known)
    report_faults(faults, f"{folder}: {len(found)} sequences, {len(faults)} faults")
