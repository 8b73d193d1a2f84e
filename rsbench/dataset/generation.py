"""Making a dataset from a card: sequence by sequence, each complete or absent, resumed where it stopped."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import asdict, replace
from functools import lru_cache
from importlib.metadata import version
from itertools import groupby, product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rsbench import __version__
from rsbench.cards import load_card
from rsbench.core.projection import row_poses
from rsbench.core.rig import SIDES, Side
from rsbench.core.se3 import Pose
from rsbench.dataset.card import DatasetCard, SequenceCard
from rsbench.dataset.files import read_json, sha256, write_depth, write_json, write_png, write_poses
from rsbench.dataset.sequence import FORMAT, FRAMES, RELATIVE_FILES, sequence_manifest
from rsbench.errors import RsbenchError
from rsbench.pipeline.isolated_jobs import run_jobs
from rsbench.pipeline.isolation import EntryFailure
from rsbench.renderers.options import RendererOptions
from rsbench.scenes.load import load_scene
from rsbench.scenes.model import Scene

if TYPE_CHECKING:
    from rsbench.renderers.scene import MitsubaScene

Progress = Callable[[str], None]
"""Called with the name of the sequence after each of its ``STEPS``."""
LoadScene = Callable[[str], Scene]
STEPS = 1 + 2 * len(SIDES) * len(FRAMES)
"""Per sequence: building the scene, and four rolling-shutter and four global-shutter renders."""


def generate_dataset(
    card: DatasetCard,
    out: Path,
    *,
    workers: int = 1,
    full_frames: bool = False,
    progress: Progress | None = None,
) -> list[str]:
    """Render every sequence that ``out`` does not hold yet and write dataset.json; returns what was rendered.

    A sequence appears under its name only when complete. The same card and seed give the same bytes, whatever
    the number of workers and however often the run was interrupted.

    Args:
        card: what to make.
        out: folder of the dataset, made if missing.
        workers: processes; each renders whole sequences.
        full_frames: make every rolling-shutter frame as the paper did, from one whole global-shutter image per
            row, and keep these images as gs_stack/<side>_<frame>/<row>.png.
        progress: see ``Progress``.

    Raises:
        RsbenchError: ``out`` cannot be written or holds a dataset of another card; a scene, viewpoint or
            renderer of the card does not exist.
    """
    options = load_card(RendererOptions, "renderers", card.renderer)
    if full_frames:
        options = replace(options, method="stitched", full_frames=True)
    # Of this run alone, and the last one only: a scene takes hundreds of MB, and its card may change between runs.
    load = lru_cache(maxsize=1)(load_scene)
    plans = _plans(card, options, load)
    _open_folder(out)
    todo = []
    for sequence in card.sequence:
        if _is_complete(out / sequence.name, plans[sequence.name]):
            for _ in range(STEPS if progress else 0):
                progress(sequence.name)  # type: ignore[misc]
        else:
            todo.append(sequence)
    for name in _render_all(card, sorted(todo, key=_scene_name), options, plans, load, out, workers):
        if progress:
            progress(name)
    _write_manifest(card, out)
    return [sequence.name for sequence in todo]


def _scene_name(sequence: SequenceCard) -> str:
    return sequence.scene


def _plans(card: DatasetCard, options: RendererOptions, load: LoadScene) -> dict[str, dict[str, Any]]:
    """The plan of each sequence by its name; each scene is loaded once, the one rendered first last."""
    plans: dict[str, dict[str, Any]] = {}
    for name, sequences in groupby(sorted(card.sequence, key=_scene_name, reverse=True), _scene_name):
        digest = _scene_digest(load(name))
        plans |= {sequence.name: _plan(card, sequence, options, load(name), digest) for sequence in sequences}
    return plans


def _plan(
    card: DatasetCard, sequence: SequenceCard, options: RendererOptions, scene: Scene, digest: str
) -> dict[str, Any]:
    """All that decides the bytes of a sequence, as it stands in its sequence.json."""
    if sequence.viewpoint not in scene.viewpoints:
        names = ", ".join(scene.viewpoints)
        raise RsbenchError(f"scene {sequence.scene}: no viewpoint {sequence.viewpoint!r}; there are: {names}")
    viewpoint = scene.viewpoints[sequence.viewpoint]
    manifest = sequence_manifest(
        name=sequence.name,
        rig=card.rig_of(sequence),
        shutter=card.shutter(),
        motion=card.motion_of(sequence),
        frame_period_s=card.frame_period_s,
    )
    return manifest | {
        "scene": {
            "name": scene.name,
            "sha256": digest,
            "viewpoint": sequence.viewpoint,
            **_listed(asdict(viewpoint)),
        },
        "renderer": _listed(asdict(options)),
        "seed": card.seed_of(sequence),
    }


def _listed(values: dict[str, Any]) -> dict[str, Any]:
    return {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}


def _scene_digest(scene: Scene) -> str:
    """Hash of all that is rendered of a scene: geometry, materials and light."""
    digest = hashlib.sha256()
    digest.update(repr(scene.light).encode())
    for mesh in scene.meshes:
        digest.update(f"{mesh.name}/{mesh.material.name}/{mesh.material.colour}".encode())
        for array in (mesh.vertices, mesh.faces, mesh.uv, mesh.normals, mesh.material.texture):
            digest.update(b"-" if array is None else np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _open_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = out / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise RsbenchError(f"{out}: cannot be written: {error.strerror}; choose another --out") from error
    for leftover in out.glob(".*.partial"):
        shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()


def _is_complete(folder: Path, plan: dict[str, Any]) -> bool:
    """Whether the sequence exists, was made from the same plan, and has the bytes it had then."""
    if not folder.exists():
        return False
    manifest = read_json(folder / "sequence.json")
    other = [key for key, value in plan.items() if manifest.get(key) != value]
    if other:
        raise RsbenchError(
            f"{folder}: holds a sequence of another card (differs in {', '.join(other)}); choose another --out"
        )
    files = manifest.get("files", {})
    names = {*RELATIVE_FILES, *files}
    intact = all((folder / name).is_file() and sha256(folder / name) == files.get(name) for name in names)
    if not intact:
        shutil.rmtree(folder)
    return intact


def _render_all(
    card: DatasetCard,
    todo: list[SequenceCard],
    options: RendererOptions,
    plans: dict[str, dict[str, Any]],
    load: LoadScene,
    out: Path,
    workers: int,
) -> Iterator[str]:
    if workers <= 1 or len(todo) <= 1:
        for sequence in todo:
            for _ in _render_sequence(card, sequence, options, plans[sequence.name], load(sequence.scene), out):
                yield sequence.name
        return
    jobs = [(sequence, plans[sequence.name]) for sequence in todo]
    threads = max(1, (os.cpu_count() or 1) // workers)
    with closing(run_jobs(_serve_renders, jobs, workers, {}, card, options, out, threads)) as outcomes:
        for (sequence, _), outcome in outcomes:
            if not outcome.success:
                raise RsbenchError(f"sequence {sequence.name}: {outcome.reason}")
            for _ in range(STEPS):
                yield sequence.name


def _serve_renders(
    card: DatasetCard, options: RendererOptions, out: Path, threads: int
) -> Callable[[tuple[SequenceCard, dict[str, Any]]], None]:
    """What renders sequences, in a child."""
    from rsbench.renderers.backend import set_threads, start_backend

    start_backend()
    set_threads(threads)

    def render(job: tuple[SequenceCard, dict[str, Any]]) -> None:
        sequence, plan = job
        try:
            for _ in _render_sequence(card, sequence, options, plan, load_scene(sequence.scene), out):
                pass
        except RsbenchError as error:
            raise EntryFailure(str(error)) from error

    return render


def _render_sequence(
    card: DatasetCard,
    sequence: SequenceCard,
    options: RendererOptions,
    plan: dict[str, Any],
    scene: Scene,
    out: Path,
) -> Iterator[None]:
    """Render into a temporary folder and rename it when complete; yields after each step."""
    from rsbench.renderers.backend import start_backend
    from rsbench.renderers.scene import MitsubaScene

    backend = start_backend()
    mitsuba_scene = MitsubaScene(scene.seen_from(scene.viewpoints[sequence.viewpoint]))
    partial = out / f".{sequence.name}.partial"
    shutil.rmtree(partial, ignore_errors=True)  # of a process that was killed
    for folder in {Path(name).parent for name in RELATIVE_FILES}:
        (partial / folder).mkdir(parents=True, exist_ok=True)
    yield
    for side, frame in product(SIDES, FRAMES):
        yield from _render_camera(card, sequence, options, mitsuba_scene, side, frame, partial)
    paths = sorted(path for path in partial.rglob("*") if path.is_file())
    files = {path.relative_to(partial).as_posix(): sha256(path) for path in paths}
    made_by = {
        "rsbench": __version__,
        "mitsuba": version("mitsuba"),
        "drjit": version("drjit"),
        "variant": backend.variant,
    }
    write_json(partial / "sequence.json", plan | {"made_by": made_by, "files": files})
    os.replace(partial, out / sequence.name)


def _render_camera(
    card: DatasetCard,
    sequence: SequenceCard,
    options: RendererOptions,
    scene: MitsubaScene,
    side: Side,
    frame: int,
    folder: Path,
) -> Iterator[None]:
    """One camera at one time: the rolling-shutter frame, then the global-shutter frame at its row 0's pose."""
    from rsbench.renderers.image import to_srgb8
    from rsbench.renderers.render import render

    rig, shutter = card.rig_of(sequence), card.shutter()
    options = replace(options, seed=_image_seed(card.seed_of(sequence), sequence.name, side, frame))
    poses = row_poses(rig, shutter, card.motion_of(sequence), side, frame)
    tau = shutter.row_time(np.arange(shutter.height), frame)
    write_poses(folder / "poses" / f"{side}_{frame}.csv", tau, poses)
    first = Pose(np.broadcast_to(poses.R[0], poses.R.shape), np.broadcast_to(poses.t[0], poses.t.shape))
    keep = _stack_writer(folder / "gs_stack" / f"{side}_{frame}", options) if options.full_frames else None
    for kind, pose in (("rs", poses), ("gs", first)):
        # A global-shutter frame needs no stitching: all its rows have one pose.
        chosen = options if kind == "rs" else replace(options, method="single-pass")
        rendered = render(scene, rig.camera, pose.R, pose.t, chosen, on_gs_frame=keep if kind == "rs" else None)
        write_png(folder / kind / f"{side}_{frame}.png", to_srgb8(rendered.image, options.exposure))
        write_depth(folder / f"{kind}_depth" / f"{side}_{frame}.exr", rendered.depth)
        yield


def _stack_writer(folder: Path, options: RendererOptions) -> Callable[[int, NDArray[np.float32]], None]:
    from rsbench.renderers.image import to_srgb8

    folder.mkdir(parents=True)
    return lambda row, image: write_png(folder / f"{row:04d}.png", to_srgb8(image, options.exposure))


def _image_seed(seed: int, sequence: str, side: Side, frame: int) -> int:
    """Independent noise per image; rolling- and global-shutter twins share it, so that row 0 is the same."""
    text = f"{seed}/{sequence}/{side}/{frame}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "little")


def _write_manifest(card: DatasetCard, out: Path) -> None:
    paths = [
        f"{sequence.name}/{name}"
        for sequence in card.sequence
        for name in ("sequence.json", *read_json(out / sequence.name / "sequence.json")["files"])
    ]
    files = {path: {"sha256": sha256(out / path), "size": (out / path).stat().st_size} for path in paths}
    write_json(
        out / "dataset.json",
        {
            "format": FORMAT,
            "name": card.name,
            "description": card.description,
            "rsbench": __version__,
            "mitsuba": version("mitsuba"),
            "units": {"length": "m", "angle": "rad", "time": "frame period", "depth": "m, 0 = no surface"},
            "card": asdict(card),
            "sequences": [sequence.name for sequence in card.sequence],
            "files": files,
        },
    )
