"""``rsbench digest``: one SHA-256 for each sequence of a dataset, to write or to check."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rsbench.cli.console import echo, late_progress, report_faults
from rsbench.core.errors import RsbenchError

EPILOG = """[bold]Examples[/bold]

  rsbench digest data/paper --out paper.txt

  rsbench digest data/paper --check paper.txt

A digest is of the frames, depth, poses and channels of a sequence, and of what its sequence.json says of motion,
cameras and scene; not of dates, versions and pages. Another kind of processor may give others; where rsbench has a
reference copy, [bold]rsbench verify --reference[/bold] says whether pictures are alike.

Exit codes: 0 done, 1 a digest differs, 2 an input is wrong."""


def digest(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with a dataset.json.")],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Where the digests go. Default: standard output.")
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
