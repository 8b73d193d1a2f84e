"""Targets of ``rsbench reproduce`` on depth and correction: fig4, fig4-literal, (laws-)correction, sgm, real."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd

from rsbench.benchmark.provenance import dataset_record, provenance
from rsbench.benchmark.studies import real_cameras
from rsbench.benchmark.studies.correction_study import (
    by_law,
    by_scene,
    by_sequence,
    study_dataset,
    summarise,
    summarise_bands,
)
from rsbench.benchmark.studies.fig4_panels import Panels, correct_literally, load_panels, make_panels, save_panels
from rsbench.benchmark.studies.sgm_timing import TIMINGS, Timing, compare, right_row_poses
from rsbench.capture.hypotheses import KnownInputs
from rsbench.cli.console import echo, progress_bar
from rsbench.cli.generate import generate
from rsbench.components.cards import load_card
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import VIEWS
from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.generation import generate_dataset, steps_of
from rsbench.dataset.sequence import read_dataset, read_sequence
from rsbench.pipeline.chain import correct_four
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.renderers.backend import start_backend
from rsbench.renderers.image import to_srgb8
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.render import LinePoses, render
from rsbench.renderers.scene import MitsubaScene
from rsbench.report.correction_page import draw_frames, write_laws, write_real_page, write_sgm_page, write_study
from rsbench.report.paper_figures import draw_fig4
from rsbench.scenes.load import load_scene
from rsbench.storage.files import read_png, write_json, write_png, write_table

LAWS_FRAMES = "laws-frames"
"""Folder of the dataset of the card ``laws``."""
STRATA = ("mild", "moderate", "aggressive", "poles")
SCENES = ("castle", "old-town", "room")
_FIG4 = (("paper", ""), ("moderate", "-2"), ("aggressive", "-2"))
"""Cards of the figure, and suffixes that make the names of their sequences from those of scenes."""
_LITERAL_SCENE, _LITERAL_SEEDS = "castle", 10
"""Sequence of the paper's card, and number of RANSAC seeds that are scored; the result of the first is drawn."""
_SHOWN = "castle-aggressive-2"
"""Sequence in the picture of ``real``."""
_SGM = (("mild", "castle-2"), ("moderate", "castle-2"), ("mild", "room-3"), ("moderate", "room-3"))


def fig4(out: Path, data: Path) -> None:
    """Reproduce the paper's Figure 4 in every scene with rsbench's methods, for its motion and two larger ones.

    Run ``fig4_literal`` first, which has the paper's own components.
    """
    folder = out / "fig4"
    fig4_literal(out, data)
    numbers: list[dict[str, Any]] = []
    for card, ending in _FIG4:
        names = [f"{scene}{ending}" for scene in SCENES]
        _generate(card, data)
        with progress_bar(f"correcting {card}", len(names)) as advance:
            for name in names:
                save_panels(data / "fig4" / card / name, make_panels(read_sequence(data / card / name)))
                advance(name)
        rows = [(name, load_panels(data / "fig4" / card / name)) for name in names]
        numbers += [{"card": card, "sequence": name, **panels.numbers} for name, panels in rows]
        for path in draw_fig4(rows, folder / f"fig4-{card}"):
            echo(f"figure: {path}")
    write_table(folder / "numbers.csv", pd.DataFrame(numbers))
    _write_provenance(folder, "fig4", [data / card for card, _ in _FIG4])


def fig4_literal(out: Path, data: Path) -> None:
    """Reproduce the paper's Figure 4 in its scene with the paper's solver, matches and single-view correction."""
    folder = out / "fig4"
    _generate("paper", data)
    sequence = read_sequence(data / "paper" / _LITERAL_SCENE)
    views, panels = list[dict[str, Any]](), list[Panels]()
    with progress_bar("correcting literally", _LITERAL_SEEDS) as advance:
        for scores, panel in correct_literally(sequence, range(_LITERAL_SEEDS)):
            views += scores
            panels.append(panel)
            advance(sequence.name)
    write_table(folder / "literal.csv", pd.DataFrame(views))
    for path in draw_fig4([(sequence.name, panels[0])], folder / "fig4-literal", quality=60):
        echo(f"figure: {path}")
    _write_provenance(folder, "fig4-literal", [data / "paper"], "literal-provenance.json")


def correction(out: Path, data: Path, workers: int | None = None) -> None:
    """Score baselines, rsbench's methods and oracles on the cards of ``STRATA``.

    ``workers``: number of processes; None: one per core.
    """
    folder = out / "correction"
    studies = [_studied(card, card, data, workers) for card in STRATA]
    images, bands, motions = (pd.concat(table, ignore_index=True) for table in zip(*studies, strict=True))
    write_table(folder / "views.csv", images)
    write_table(folder / "motions.csv", motions)
    # Computed from the stored table, so that the summary can be reproduced from the file exactly.
    stored = pd.read_csv(folder / "views.csv")
    write_table(folder / "summary.csv", summarise(stored))
    write_table(folder / "scenes.csv", by_scene(stored))
    write_table(folder / "rows.csv", summarise_bands(bands))
    _write_provenance(folder, "correction", [data / card for card in STRATA])
    for path in write_study(folder):
        echo(f"written: {path}")


def laws_correction(out: Path, data: Path, workers: int | None = None) -> None:
    """Score the same methods under five motion models, on the sequences of ``laws`` with an ideal sensor."""
    folder = out / "laws-correction"
    images, _, motions = _studied("laws", LAWS_FRAMES, data, workers, lambda name: "-ideal-" in name)
    write_table(folder / "sequences.csv", by_sequence(images))
    write_table(folder / "motions.csv", motions)
    write_table(folder / "summary.csv", by_law(pd.read_csv(folder / "sequences.csv")))
    _write_provenance(folder, "laws-correction", [data / LAWS_FRAMES])
    echo(f"written: {write_laws(folder)}")


def _studied(
    card: str, name: str, data: Path, workers: int | None, among: Callable[[str], bool] = bool
) -> list[pd.DataFrame]:
    """Run the correction study on a card's sequences selected by ``among``; its dataset is in the folder ``name``.

    Returns tables of views, bands of rows, and motions.
    """
    _generate(card, data, name)
    folder, kept = data / name, data / "correction" / name
    count = sum(among(sequence.name) for sequence in read_dataset(folder))
    with progress_bar(f"correcting {card}", count) as advance:
        study = study_dataset(folder, advance, workers=workers, kept=kept, among=among)
    tables = [pd.DataFrame(rows) for rows in study]
    for table in tables:
        table.insert(0, "stratum", card)
    return tables


def sgm(out: Path, data: Path) -> None:
    """Score semi-global matching if the right camera reads its rows at other times than the left one."""
    folder = out / "sgm"
    cards = list(dict.fromkeys(card for card, _ in _SGM))
    for card in cards:
        _generate(card, data)
    rows = []
    with progress_bar("matching", len(_SGM) * len(TIMINGS)) as advance:
        for card, name in _SGM:
            sequence = read_sequence(data / card / name)
            left, depth = sequence.image("rs", "left", 0), sequence.depth("rs", "left", 0)
            for timing in TIMINGS:
                path = data / "sgm" / card / name / f"{timing.name}.png"
                if not path.is_file():
                    _render_right(card, name, timing, path)
                geometry = sequence.rig, sequence.shutter, sequence.motion
                scores = compare(left, read_png(path), depth, *geometry, timing)
                rows.append({"stratum": card, "sequence": name, **scores})
                advance(f"{name}, {timing.name}")
    write_table(folder / "sgm.csv", pd.DataFrame(rows))
    _write_provenance(folder, "sgm", [data / card for card in cards])
    for path in write_sgm_page(folder):
        echo(f"written: {path}")


def real(out: Path, data: Path, seeds: int, width: int | None) -> None:
    """Score the default pipeline on rendered frames with lens, blur and noise, and on those of an ideal camera."""
    if seeds < real_cameras.FEWEST_SEEDS:
        raise RsbenchError(f"--seeds {seeds}: must be at least {real_cameras.FEWEST_SEEDS}")
    folder, card = out / "real", load_dataset_card("real")
    card = card if width is None else real_cameras.sized(card, width)
    cards = {"ideal": real_cameras.ideal_card(card), "real": card}
    start_backend()
    places = {camera: data / each.name for camera, each in cards.items()}
    for camera, each in cards.items():
        with progress_bar(f"rendering {each.name}", steps_of(each) * len(each.sequence)) as advance:
            generate_dataset(each, places[camera], progress=advance)
    with progress_bar("solving and correcting", len(cards) * len(card.sequence)) as advance:
        motions, views = (
            pd.DataFrame(rows) for rows in real_cameras.study(places, seeds, advance, data / "real-rows")
        )
    write_table(folder / "motions.csv", motions)
    write_table(folder / "views.csv", views)
    # Computed from the stored tables, so that the summary can be reproduced from the files exactly.
    stored = (
        pd.read_csv(folder / f"{name}.csv", keep_default_na=False, na_values=[""]) for name in ("motions", "views")
    )
    write_table(folder / "summary.csv", real_cameras.summarise(*stored))
    _write_provenance(folder, "real", places.values())
    for path in (_draw_real(places, folder), write_real_page(folder, asdict(card))):
        echo(f"written: {path}")


def _draw_real(places: dict[str, Path], folder: Path) -> Path:
    ideal, real = (read_sequence(places[camera] / _SHOWN) for camera in ("ideal", "real"))
    images = {view: real.image("rs", *view) for view in VIEWS}
    options, inputs = CorrectionOptions(inpaint=True), KnownInputs.of(real.shutter)
    corrected = correct_four(images, real.rig, inputs, options, views=(("left", 1),))
    frames = {
        "ideal camera": ideal.image("rs", "left", 1),
        "real camera": images["left", 1],
        "real, corrected": corrected.frames["left", 1].image,
        "its global-shutter twin": real.image("gs", "left", 1),
    }
    return draw_frames(frames, folder / "frames.jpg")


def _write_provenance(folder: Path, target: str, datasets: Iterable[Path], name: str = "provenance.json") -> None:
    """Write the command, the code and the datasets from which a target was made."""
    records = [dataset_record(dataset) for dataset in datasets]
    write_json(folder / name, provenance(f"rsbench reproduce {target}", datasets=records))


def _generate(card: str, data: Path, name: str = "") -> None:
    """Render all missing sequences of a card, even unused ones, so that every target has the same dataset."""
    generate(card, str(data / (name or card)), None, workers=1)


def _render_right(card: str, name: str, timing: Timing, path: Path) -> None:
    dataset = load_dataset_card(card)
    sequence = next(one for one in dataset.sequence if one.name == name)
    options = load_card(RendererOptions, "renderers", dataset.renderer)
    start_backend()
    scene = load_scene(sequence.scene)
    rig, shutter, motion = dataset.rig_of(sequence), dataset.shutter_for(sequence), dataset.motion_of(sequence)
    poses = right_row_poses(rig, shutter, motion, timing)
    seen = MitsubaScene(scene.seen_from(scene.viewpoints[sequence.viewpoint]))
    frame = render(seen, rig.camera, LinePoses(poses.R, poses.t), options)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, to_srgb8(frame.image, options.exposure))
