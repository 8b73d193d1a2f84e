"""``rsbench export`` and ``rsbench view``: a dataset for another program, in files or in the Rerun viewer."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from enum import StrEnum
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rsbench.cli.console import echo, late_progress, say
from rsbench.cli.names import named
from rsbench.core.errors import RsbenchError

if TYPE_CHECKING:
    from rsbench.interop.writers.match_colours import Scene

EXPORT_EPILOG = """[bold]Examples[/bold]

  rsbench export data/paper --to colmap --out out/colmap    [dim](global-shutter twins)[/dim]

  rsbench export data/paper --to colmap --images rs --out out/rolling

  rsbench export data/paper --to tum --out out/tum    [dim](then: evo_traj tum out/tum/*/left_rows.txt)[/dim]

  rsbench export data/paper --to gsplat --out out/gsplat --sequence castle

  rsbench export data/paper --to webdataset --out out/shards

  rsbench export corrected --to colmap --out out/map    [dim](what rsbench correct made of footage)[/dim]"""


class Target(StrEnum):
    """Formats; a test compares them with ``rsbench.interop.writers.exporter.FORMATS``."""

    COLMAP = "colmap"
    TUM = "tum"
    KALIBR = "kalibr"
    NERFSTUDIO = "nerfstudio"
    GSPLAT = "gsplat"
    KITTI = "kitti"
    CARLA_RS = "carla-rs"
    FASTEC_RS = "fastec-rs"
    WEBDATASET = "webdataset"
    HUGGINGFACE = "huggingface"


class Pictures(StrEnum):
    """Which images are written."""

    RS = "rs"
    GS = "gs"


def export(
    folder: Annotated[
        Path,
        typer.Argument(metavar="DIR", help="Folder with a dataset.json, or of corrected footage (motion.json)."),
    ],
    to: Annotated[Target, typer.Option(help="Format; the document 'export' describes each.")],
    out: Annotated[Path, typer.Option(help="Folder to write; it appears when it is complete.")],
    images: Annotated[
        Pictures | None,
        typer.Option(help="Rolling-shutter or global-shutter frames, if the format supports both."),
    ] = None,
    sequence: Annotated[
        list[str] | None, typer.Option("--sequence", "--only", help="Only this sequence; repeatable.")
    ] = None,
) -> None:
    """Write a dataset, or corrected footage, in the layout of COLMAP, evo and others.

    A note names what a format cannot represent; some sequences are refused.
    """
    from rsbench.interop.writers.exporter import export_dataset

    with late_progress(f"exporting to {to}") as advance:
        notes = export_dataset(
            folder,
            to.value,
            out,
            images=None if images is None else images.value,
            only=tuple(sequence or ()),
            progress=advance,
        )
    for sentence in notes:
        say(f"note: {sentence}")
    echo(f"{out}: {to}; README.txt describes it")


VIEW_EPILOG = """[bold]Examples[/bold]

  rsbench view data/paper    [dim](opens the viewer with the first sequence)[/dim]

  rsbench view data/paper --sequence castle --sequence room

  rsbench view data/paper --save castle.rrd    [dim](without a screen; then: rerun castle.rrd)[/dim]"""


def view(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with a dataset.json.")],
    sequence: Annotated[
        list[str] | None,
        typer.Option("--sequence", "--only", help="This sequence; repeatable. Default: the first one."),
    ] = None,
    save: Annotated[
        Path | None,
        typer.Option(metavar="FILE.rrd", help="Write one sequence to this file instead of opening the viewer."),
    ] = None,
    points: Annotated[int, typer.Option(min=1, help="Largest number of points per depth map.")] = 100_000,
    features: Annotated[str, named("features", "Feature matcher, for data without the channel matches.")] = "sift",
) -> None:
    r"""Show a dataset in the Rerun viewer: rig, row poses, depth as points, images and matches over time.

    Needs the extra of the viewer: pip install 'rsbench\[view]'
    """
    from rsbench.interop.writers.exporter import chosen_sequences
    from rsbench.interop.writers.match_colours import Scene, found_strips, labelled_strips
    from rsbench.storage.files import check_out

    if find_spec("rerun") is None:
        raise RsbenchError("the viewer is not installed: pip install 'rsbench[view]'")
    screen = sys.platform != "linux" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    if save is None and not screen:
        raise RsbenchError("there is no screen (DISPLAY and WAYLAND_DISPLAY are empty): give --save FILE.rrd")
    chosen = chosen_sequences(folder, tuple(sequence or ()))[: None if sequence else 1]
    if save is not None:
        if len(chosen) != 1:
            raise RsbenchError(f"--save {save}: is for one sequence, not {len(chosen)}: give one --sequence")
        if save.is_dir():
            raise RsbenchError(f"--save {save}: is a folder, not a file")
        check_out(save.parent)
    with late_progress("showing") as advance:
        for each in chosen:
            labelled = "matches" in each.channels
            strips = labelled_strips(each) if labelled else found_strips(each, features)
            _view_one(Scene(each, tuple(strips), points), save, advance)
    echo(f"{save}: {chosen[0].name}" if save is not None else "sent to the viewer")


def _view_one(scene: Scene, save: Path | None, advance: Callable[[str], None]) -> None:
    """Open the viewer, or write a file, which appears when it is complete."""
    from rsbench.interop.writers.rerun_scene import open_viewer, write_recording

    if save is None:
        open_viewer(scene, advance)
        return
    save.parent.mkdir(parents=True, exist_ok=True)
    partial = save.with_name(f".{save.name}.partial")
    try:
        write_recording(scene, partial, advance)
        os.replace(partial, save)
    finally:
        partial.unlink(missing_ok=True)
