"""``rsbench view``: a dataset in the Rerun viewer."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rsbench.cli.component_kinds import complete
from rsbench.cli.console import echo

if TYPE_CHECKING:
    from rsbench.dataset.sequence import Sequence
    from rsbench.interop.writers.match_colours import Scene

EPILOG = """[bold]Examples[/bold]

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
        Path | None, typer.Option(metavar="FILE.rrd", help="Write this file instead; of one sequence.")
    ] = None,
    points: Annotated[int, typer.Option(min=1, help="Points of each depth map, at most.")] = 100_000,
    features: Annotated[
        str,
        typer.Option(help="Matches of data without the channel matches.", autocompletion=complete("features")),
    ] = "sift",
) -> None:
    r"""Show a dataset in the Rerun viewer: rig, row poses, depth as points, images and matches over time.

    Needs the extra of the viewer: pip install 'rsbench\[view]'
    """
    from rsbench.cli.console import late_progress
    from rsbench.core.errors import RsbenchError
    from rsbench.interop.writers.exporter import chosen_sequences
    from rsbench.storage.files import check_out

    if find_spec("rerun") is None:
        raise RsbenchError("the viewer is not installed: pip install 'rsbench[view]'")
    if save is None and not _has_screen():
        raise RsbenchError("there is no screen (DISPLAY and WAYLAND_DISPLAY are empty): give --save FILE.rrd")
    chosen = chosen_sequences(folder, tuple(sequence or ()))[: None if sequence else 1]
    if save is not None:
        if len(chosen) != 1:
            raise RsbenchError(f"--save {save}: holds one sequence, not {len(chosen)}: give one --sequence")
        if save.is_dir():
            raise RsbenchError(f"--save {save}: is a folder, not a file")
        check_out(save.parent)
    with late_progress("showing") as advance:
        for each in chosen:
            _show(_scene(each, points, features), save, advance)
    echo(f"{save}: {chosen[0].name}" if save is not None else "sent to the viewer")


def _has_screen() -> bool:
    """Whether a window can open: on Linux, by the variables that name a display."""
    return sys.platform != "linux" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def _show(scene: Scene, save: Path | None, advance: Callable[[str], None]) -> None:
    """To the viewer, or to a file that appears when it is whole."""
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


def _scene(sequence: Sequence, points: int, features: str) -> Scene:
    from rsbench.interop.writers.match_colours import Scene, found_strips, labelled_strips

    labelled = "matches" in sequence.channels
    strips = labelled_strips(sequence) if labelled else found_strips(sequence, features)
    return Scene(sequence, tuple(strips), points)


def register(app: typer.Typer) -> None:
    app.command(epilog=EPILOG)(view)
