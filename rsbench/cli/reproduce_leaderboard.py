"""Targets of ``rsbench reproduce`` that make boards with rsbench's entries: leaderboard, laws, boards, handheld,
footage, recorded, held-out."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from rsbench.benchmark.leaderboard.board import Scored, entries_of, restore, splits_of, store
from rsbench.benchmark.leaderboard.motion_tracks import CHOOSES
from rsbench.benchmark.leaderboard.smoke import own_solvers
from rsbench.benchmark.leaderboard.track import Split
from rsbench.benchmark.leaderboard.tracks import track_of_id, track_of_name
from rsbench.benchmark.provenance import provenance
from rsbench.benchmark.trajectory_scores import METHODS
from rsbench.cli.console import echo
from rsbench.cli.generate import generate
from rsbench.cli.leaderboard import oracles, run, smoke
from rsbench.cli.reproduce_correction import LAWS_FRAMES
from rsbench.components.cards import shipped_folder
from rsbench.components.plugins import Kind, offers
from rsbench.core.errors import RsbenchError
from rsbench.dataset.secret_split import read_secret
from rsbench.report.board_page import build_site
from rsbench.report.points_pages import by_recording, choices, compared, write_held_out_page, write_recorded_page
from rsbench.solvers.engine.base import load_solver_entry
from rsbench.storage.files import write_bytes, write_json, write_table
from rsbench.storage.untrusted_files import read_json
from rsbench.vision.corrector import CORRECTORS, load_corrector
from rsbench.vision.stereo_matcher import STEREO_MATCHERS

BOARD, LAWS, HANDHELD, FOOTAGE, RECORDED = "leaderboard", "laws", "handheld", "footage", "recorded"
HELD_OUT = "held-out"
"""Names of folders of boards and their results."""
OWN_RECORDINGS = "euroc"
"""Folder below ``--data`` with recordings of the user, which do not come with rsbench."""
SAME_METHOD = {
    "rs-r6p-single": "rs-r6p",
    "rs-stereo-iterated": "rs-stereo-iterated-metric",
    "rs-stereo-linear-symmetric": "rs-stereo-linear",
    "rs-stereo-tracks": "rs-stereo-refined",
}
"""Cards that are left out, each with the entry that represents its method: similar versions would reduce the power
of all comparisons, because these are corrected for the number of pairs."""
COMPARED = (
    *("rs-stereo-auto", "rs-stereo-refined", "rs-stereo-refined-twist", "gs-stereo-tracks-scaled", "gs-poselib"),
    *("gs-poselib-scaled", "gs-8pt", "gs-5pt-opencv", "rs-mono-refined", "gs-poselib-stereo", "rs-r6p"),
    "rs-stereo-linear",
)
"""Entries of rsbench that are run on held-out splits."""
_PUBLISHED = {"points-1": BOARD, "points-2": LAWS}
"""Folder of results with the published predictions of rsbench's entries on the public split, by protocol."""
_OF_ONE_CAMERA = ("mono-fusion", "flow-scaled", "rotation-only", "zhuang", "vasu-layers", "gyro", "fusion")
"""Correctors of one camera, and the rig's corrector, to show the benefit of a second camera."""


def leaderboard(out: Path, data: Path, workers: int | None) -> None:
    """Make the board of simulated points, which may already have other entries, and the scores of the smoke run.

    The predictions are published too; ``rsbench leaderboard run points`` ranks users' methods beside them.
    """
    board, folder = data / BOARD, out / BOARD
    _fill(board, {"points": own_solvers()}, workers)
    smoke(folder / "smoke", write=True)
    publish(board, folder)
    for protocol, split in splits_of(board):
        if protocol == "points-1":
            store(board, protocol, split, folder / "predictions" / protocol)


def laws(out: Path, data: Path, workers: int | None) -> None:
    """Make the board of points and frames under several motion models, and store the predictions.

    On tracks of pictures, the predictions are not stored, because they take gigabytes.
    """
    board, folder = data / LAWS, out / LAWS
    _fill(board, entries_of_laws(), workers, "laws", data / LAWS_FRAMES)
    publish(board, folder, "rsbench reproduce laws")
    for protocol, split in splits_of(board):
        if not track_of_id(protocol).pictures:
            store(board, protocol, split, folder / "predictions" / protocol)


def boards(out: Path, data: Path, workers: int | None) -> None:
    """Add the tracks of frames, on the dataset ``standard``, to the board."""
    _fill(data / BOARD, entries_of_frames(), workers, "standard", data / "standard")
    publish(data / BOARD, out / "leaderboard")


def handheld(out: Path, data: Path, workers: int | None) -> None:
    """Make the board of trajectories, on hand-held sequences."""
    board = data / f"{HANDHELD}-board"
    _fill(board, {"trajectory": list(METHODS)}, workers, "handheld", data / HANDHELD, oracles_too=False)
    publish(board, out / HANDHELD, "rsbench reproduce handheld")


def footage(out: Path, data: Path, workers: int | None) -> None:
    """Make the board of correctors of one camera, on the datasets ``footage`` and ``standard`` (no gyroscope)."""
    board, without_gyro = data / f"{FOOTAGE}-board", [each for each in _OF_ONE_CAMERA if each != "gyro"]
    for name, entries in ((FOOTAGE, list(_OF_ONE_CAMERA)), ("standard", without_gyro)):
        _fill(board, {"correction-mono": entries}, workers, name, data / name)
    publish(board, out / FOOTAGE, "rsbench reproduce footage")


def recorded(out: Path, data: Path, workers: int | None) -> None:
    """Make the board of points on recordings, both those that come with rsbench and the user's own."""
    board, folder, own = data / f"{RECORDED}-board", out / RECORDED, data / OWN_RECORDINGS
    if not own.is_dir():
        echo(
            f"{own}: is missing, so the drone is left out; cards/recordings/README.md says how to make it",
            err=True,
        )
    track, errors, chosen = track_of_name("points-recorded"), list[pd.DataFrame](), list[pd.DataFrame]()
    for given in (None, *([own] if own.is_dir() else [])):
        run(track.name, entries_of_laws()["points-2"], str(board), given, workers=workers or os.cpu_count() or 1)
        oracles(track.name, board, given)
        split = track.split(given)
        scores = {each.header.method: each.scores for each in entries_of(board, track.id, split.name)}
        errors.append(by_recording(scores))
        chosen.append(choices(split, scores, CHOOSES))
    publish(board, folder, "rsbench reproduce recorded", tables_alone=True)
    write_table(folder / "recordings.csv", pd.concat(errors))
    write_table(folder / "choices.csv", pd.concat(chosen))
    echo(f"page: {write_recorded_page(folder)}")


def held_out(out: Path, data: Path, workers: int | None) -> None:
    """Run solvers, also of other authors, on the announced secret splits and the public splits of points.

    On public splits, published predictions of rsbench's entries are used. Entries on the board are not run again.

    Raises:
        RsbenchError: the secret text or a split is not the announced one.
    """
    folder, board, count = out / HELD_OUT, data / f"{HELD_OUT}-board", workers or os.cpu_count() or 1
    seed_file, about, tables = folder / "seed.txt", read_json(folder / "announced.json"), list[pd.DataFrame]()
    foreign = {name.rpartition(":")[2]: name for name in solvers_of_others()}
    for protocol, announced in about["splits"].items():
        track, scored = track_of_id(protocol), list[list[Scored]]()
        ours = {name: name for name in COMPARED if name != CHOOSES or protocol != "points-1"}
        for given in (None, seed_file):
            split = track.split(None, given)
            if not split.public:
                _check_announced(split, seed_file, about["commitment"], announced["fingerprint"])
            there = board / protocol / split.name / "entries"
            if split.public and protocol in _PUBLISHED and not there.is_dir():
                restore(out / _PUBLISHED[protocol] / "predictions" / protocol, split, board)
            entries = ours | foreign
            if missing := [name for method, name in entries.items() if not (there / method).is_dir()]:
                run(track.name, missing, str(board), seed_file=given, workers=count)
            scored.append(
                [each for each in entries_of(board, protocol, split.name) if each.header.method in entries]
            )
            if protocol == "points-2":
                stored = folder / "predictions" / f"{protocol}--{split.name}"
                store(board, protocol, split.name, stored, foreign if split.public else entries)
        tables.append(compared(*scored))
    publish(board, folder, f"rsbench reproduce {HELD_OUT}", tables_alone=True)
    write_table(folder / "scores.csv", pd.concat(tables))
    echo(f"page: {write_held_out_page(folder, about)}")


def solvers_of_others() -> list[str]:
    """Return the solvers in examples/solvers whose packages are installed, as ``FILE.py:NAME``."""
    found = list[str]()
    for file in sorted(shipped_folder("examples/solvers", "_docs/examples/solvers").glob("*.py")):
        names = [f"{file}:{file.stem}{ending}" for ending in ("", "_scaled")]
        try:
            found += [name for name in names if load_solver_entry(name)]
        except RsbenchError as error:
            echo(f"left out: {error}", err=True)
    return found


def _check_announced(split: Split, seed_file: Path, commitment: str, fingerprint: str) -> None:
    """Raise RsbenchError if a secret split or its text is not the announced one."""
    if read_secret(seed_file).commitment != commitment or split.fingerprint != fingerprint:
        raise RsbenchError(f"{seed_file}: draws {split.name}, which announced.json beside it does not announce")


def _fill(
    board: Path,
    entries: Mapping[str, Sequence[str]],
    workers: int | None,
    card: str = "",
    frames: Path | None = None,
    *,
    oracles_too: bool = True,
) -> None:
    """Run the entries of each track that have not run yet, and add the oracles.

    ``frames`` is the folder of the dataset of ``card``, for tracks on frames; missing sequences are rendered.
    """
    count = workers or os.cpu_count() or 1
    if frames is not None:
        generate(card, str(frames), None, workers=count)
    for track, names in entries.items():
        given = frames if track_of_name(track).inputs.rendered else None
        run(track, list(names), str(board), given, workers=count)
        if oracles_too:
            oracles(track, board, given)


def entries_of_laws() -> dict[str, list[str]]:
    """Return rsbench's entries by protocol: one for each method, and the solver that selects a motion model."""
    first = entries_of_frames()
    solvers, readers = (
        [name for name in first[track] if name not in SAME_METHOD] + [CHOOSES] for track in ("pose", "readout")
    )
    return {"points-2": solvers, "pose-2": solvers, "readout-3": readers, "correction-3": first["correction"]}


def entries_of_frames() -> dict[str, list[str]]:
    """Return, by track, rsbench's entries that need only the inputs of the track.

    On the track ``readout``, these are the maximum-likelihood solvers of both cameras, which estimate the ratio.
    """

    def own(kind: Kind[Any, Any]) -> list[str]:
        return [offer.name for offer in offers(kind) if offer.origin == "rsbench"]

    images_alone = [name for name in own(CORRECTORS) if "gyro" not in load_corrector(name).component.spec.needs]
    return {
        "pose": own_solvers(),
        "readout": [f"rs-stereo-{name}" for name in ("refined", "refined-pairs", "refined-twist", "tracks")],
        "depth": own(STEREO_MATCHERS),
        "correction": images_alone,
    }


def publish(
    board: Path, out: Path, command: str = "rsbench reproduce leaderboard", *, tables_alone: bool = False
) -> None:
    """Write a board's site, or only its tables, and provenance.json with the command and code of each entry.

    Tables and provenance of splits that the board does not have are kept.
    """
    if tables_alone:
        with tempfile.TemporaryDirectory() as folder:
            build_site(board, Path(folder), problem_pages=False)
            (out / "tables").mkdir(parents=True, exist_ok=True)
            for table in sorted(Path(folder).glob("*.md")):
                write_bytes(out / "tables" / table.name, table.read_bytes())
    else:
        echo(f"page: {build_site(board, out / 'site', problem_pages=False)}")
    path, splits = out / "provenance.json", splits_of(board)
    made = {
        f"{protocol}/{split}/{entry.header.method}": read_json(entry.folder / "entry.json").get("made")
        for protocol, split in splits
        for entry in entries_of(board, protocol, split)
    }
    former = read_json(path).get("entries", {}) if path.is_file() else {}
    kept = {
        name: each for name, each in former.items() if name in made or tuple(name.split("/")[:2]) not in splits
    }
    brief = {
        name: {key: record[key] for key in ("command", "commit", "source", "date") if key in record}
        for name, record in made.items()
        if isinstance(record, dict)
        and not (name in former and "commit" not in record)  # restored entries keep their former provenance
    }
    write_json(path, {**provenance(command), "entries": dict(sorted((kept | brief).items()))})
