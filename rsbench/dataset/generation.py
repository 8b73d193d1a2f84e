"""Make a dataset from a card, sequence by sequence. Each is complete or absent; an interrupted run resumes."""

from __future__ import annotations

import os
import secrets
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.metadata import version
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.components.cards import load_card
from rsbench.core.errors import RsbenchError
from rsbench.core.geometry import FixedGeometry, Geometry, poses_of
from rsbench.core.projection import row_poses
from rsbench.core.rig import SIDES, Side, views_of
from rsbench.core.se3 import Pose
from rsbench.core.version import __version__
from rsbench.dataset.card import DatasetCard, SequenceCard
from rsbench.dataset.channels import SequenceTruth, write_channels, write_sequence_channels
from rsbench.dataset.clock_channels import Imu
from rsbench.dataset.destinations import FolderTarget, StoreTarget, open_destination
from rsbench.dataset.layout import clean_file
from rsbench.dataset.manifest import Files, Plan, SceneHashes, of_scene, plans_of, scene_hash, with_gloss
from rsbench.dataset.point_channels import Matching
from rsbench.dataset.sequence import files_of
from rsbench.dataset.views import ImageView, image_seed
from rsbench.jobs.isolation import EntryFailure
from rsbench.jobs.process_jobs import Cluster, Workers, finished_jobs
from rsbench.renderers.options import RendererOptions
from rsbench.scenes.load import load_scene
from rsbench.scenes.model import Scene
from rsbench.scenes.object_meshes import with_moving
from rsbench.storage.files import (
    Later,
    background_writer,
    sha256,
    write_depth,
    write_json,
    write_mask,
    write_png,
    write_poses,
)
from rsbench.storage.work_folder import files_below
from rsbench.vision.feature_matcher import load_features

if TYPE_CHECKING:
    from rsbench.renderers.render import Frame, OnGlobalFrame
    from rsbench.renderers.scene import MitsubaScene


class Built(NamedTuple):
    """A scene and its hash."""

    scene: Scene
    sha256: str


Build = Callable[[str], Built]


class PosedScenes:
    """Caches the renderer's scene of the last sequence for sequences with the same viewpoint."""

    def __init__(self, build: Build) -> None:
        self._build = build
        self._place: object = None
        self._scene: Any = None

    def set_for(self, sequence: SequenceCard) -> tuple[MitsubaScene, str]:
        """Return the scene in the frame of a sequence, and the hash of the scene."""
        from rsbench.renderers.scene import MitsubaScene

        place = place_of(sequence)
        if place != self._place:
            self._scene = None  # keep only one scene in memory
        built = self._build(sequence.scene)
        if self._scene is None:
            self._scene, self._place = MitsubaScene(seen_scene(built.scene, sequence)), place
        return self._scene, built.sha256


def place_of(sequence: SequenceCard) -> tuple[object, ...]:
    """Return the values that determine the posed scene of a sequence."""
    return sequence.scene, sequence.viewpoint, sequence.start, sequence.moving


def seen_scene(scene: Scene, sequence: SequenceCard) -> Scene:
    """Return a scene in the frame of the body at time 0 of a sequence, with its moving objects."""
    seen = scene.seen_from(scene.viewpoints[sequence.viewpoint], sequence.start)
    return with_moving(seen, sequence.moving) if sequence.moving else seen


Progress = Callable[[str], None]
"""Called with the name of the sequence after each of its ``steps_of``."""


def steps_of(card: DatasetCard) -> int:
    """Return the number of steps of a sequence: one per camera, frame and shutter, and one for placing it."""
    return 1 + 2 * len(SIDES) * card.frames


def generate_dataset(
    card: DatasetCard,
    out: Path | str,
    *,
    workers: Workers = 1,
    full_frames: bool = False,
    rehash: bool = False,
    progress: Progress | None = None,
) -> list[str]:
    """Render every sequence that ``out`` does not hold yet and write dataset.json; returns what was rendered.

    A sequence appears under its name only when complete. The same card and seed give the same bytes, whatever
    the number of workers and however often the run was interrupted.

    Args:
        card: card of the dataset.
        out: folder of the dataset, created if missing, or the URL of a store, to which complete sequences are
            uploaded (``StoreDestination``).
        workers: number of processes, or a cluster; each process renders whole sequences.
        full_frames: render every rolling-shutter frame as in the paper, from one whole global-shutter image per
            row, and keep these images as gs_stack/<side>_<frame>/<row>.png.
        rehash: read every file again, even with unchanged size and times; files of a store are downloaded.
        progress: see ``Progress``.

    Raises:
        RsbenchError: ``out`` cannot be written, another command works there, or it contains a dataset of another
            card or other files in a damaged sequence; something that the card names does not exist.
        LostJobsError: see ``finished_jobs``.
    """
    options = load_card(RendererOptions, "renderers", card.renderer)
    if full_frames:
        options = replace(options, method="stitched", full_frames=True)
    if "matches" in card.channels:
        load_features((card.matches or Matching()).features)  # before hours of rendering
    plans = plans_of(card, options)

    def step(name: str, times: int) -> None:
        for _ in range(times if progress else 0):
            progress(name)  # pyrefly: ignore[not-callable]

    with open_destination(out, workers, rehash) as destination:
        # Only in this run, and only the last one: a scene takes hundreds of MB, and its card may change.
        build = lru_cache(maxsize=1)(build_scene)
        scene_hashes = SceneHashes(destination.hidden / "scenes.json", lambda name: build(name).sha256)
        made: dict[str, Files] = {}
        for name, files in destination.complete(card.sequence, plans, scene_hashes):
            made[name] = files
            step(name, steps_of(card))
        todo = [sequence for sequence in card.sequence if sequence.name not in made]
        done: Counter[str] = Counter()
        ordered = sorted(todo, key=scene_name)
        run = _Run(card, options, destination.target)
        for name, steps in run.sequences(ordered, plans, build, workers):
            done[name] += steps
            if done[name] == steps_of(card):
                made[name] = destination.learned(name)
            step(name, steps)
        destination.finish(card, made)
    return [sequence.name for sequence in todo]


def scene_name(sequence: SequenceCard) -> str:
    return sequence.scene


def build_scene(name: str) -> Built:
    scene = load_scene(name)
    return Built(scene, scene_hash(scene))


@dataclass(frozen=True)
class _Run:
    """Renders the sequences of a card; picklable, for distribution to several processes."""

    card: DatasetCard
    options: RendererOptions
    target: FolderTarget | StoreTarget

    def sequences(
        self, todo: list[SequenceCard], plans: dict[str, Plan], build: Build, workers: Workers
    ) -> Iterator[tuple[str, int]]:
        """Yield names of sequences with the steps done; the last step is reported when a sequence is complete."""
        if workers == 1 or not todo:
            stage = PosedScenes(build)
            for sequence in todo:
                for _ in self.sequence(sequence, plans[sequence.name], stage):
                    yield sequence.name, 1
            return
        jobs = [(sequence, plans[sequence.name]) for sequence in todo]
        threads = 1 if isinstance(workers, Cluster) else max(1, (os.cpu_count() or 1) // workers)
        found = finished_jobs(
            _serve_renders, jobs, workers, {}, self, threads, name=lambda job: f"sequence {job[0].name}"
        )
        with closing(found):
            for (sequence, _), _ in found:
                yield sequence.name, steps_of(self.card)

    def sequence(self, sequence: SequenceCard, plan: Plan, stage: PosedScenes) -> Iterator[None]:
        """Render into a folder of the workplace and place it when complete; yields after each step."""
        from rsbench.renderers.backend import start_backend
        from rsbench.renderers.visibility import obstacle

        card, backend, (mitsuba_scene, digest) = self.card, start_backend(), stage.set_for(sequence)
        if words := obstacle(mitsuba_scene, *card.geometry_of(sequence)):
            raise RsbenchError(f"sequence {sequence.name}: {words}; choose another motion, viewpoint or baseline")
        plan = with_gloss(plan, mitsuba_scene.glossy)
        # A folder of this attempt only: another machine may not know yet that its run was killed.
        partial = self.target.work_folder() / f"{sequence.name}.{secrets.token_hex(4)}"
        for folder in {Path(name).parent for name in files_of(plan)}:
            (partial / folder).mkdir(parents=True, exist_ok=True)
        with background_writer() as later:
            for side, frame in views_of(card.frames):
                yield from render_camera(card, sequence, self.options, mitsuba_scene, side, frame, partial, later)
        write_sequence_channels(
            card.channels, sequence_truth(partial, card, sequence, mitsuba_scene, plan["scene"])
        )
        files = {name: sha256(partial / name) for name in files_below(partial)}
        made_by = {
            "rsbench": __version__,
            "mitsuba": version("mitsuba"),
            "drjit": version("drjit"),
            "variant": backend.variant,
        }
        content = of_scene(plan, digest) | {"made_by": made_by, "files": files}
        write_json(partial / "sequence.json", content)
        self.target.place(partial, sequence.name)
        yield


def _serve_renders(run: _Run, threads: int) -> Callable[[tuple[SequenceCard, Plan]], None]:
    """Return the function that renders sequences in a child process."""
    from rsbench.renderers.backend import set_threads, start_backend

    start_backend()
    set_threads(threads)
    stage = PosedScenes(lru_cache(maxsize=1)(build_scene))

    def render(job: tuple[SequenceCard, Plan]) -> None:
        sequence, plan = job
        try:
            for _ in run.sequence(sequence, plan, stage):
                pass
        except RsbenchError as error:
            raise EntryFailure(str(error)) from error

    return render


def render_camera(
    card: DatasetCard,
    sequence: SequenceCard,
    options: RendererOptions,
    scene: MitsubaScene,
    side: Side,
    frame: int,
    folder: Path,
    later: Later,
    *,
    rolling_alone: bool = False,
) -> Iterator[None]:
    """Render the rolling-shutter frame of one camera, then the global-shutter frames at poses of its rows.

    The sensor is applied only to the rolling-shutter frame, which is also kept without it. ``later`` starts the
    writing of files.
    """
    from rsbench.renderers.image import to_srgb8
    from rsbench.renderers.render import sensed_rows
    from rsbench.renderers.visibility import SceneRays

    geometry, sensor = card.geometry_of(sequence), card.sensor_of(sequence)
    rig, shutter, motion, _, things = geometry
    options = replace(options, seed=image_seed(card.seed_of(sequence), sequence.name, side, frame))
    poses, twins = row_poses(rig, shutter, motion, side, frame), card.twins_of(sequence)
    write_poses(folder / "poses" / f"{side}_{frame}.csv", shutter.line_times(frame, side), poses)
    keep = _stack_writer(folder / "gs_stack" / f"{side}_{frame}", options) if options.full_frames else None
    still: tuple[int, ...] = () if rolling_alone else (0, *twins)
    for view in (ImageView("rs", side, frame), *(ImageView("gs", side, frame, row) for row in still)):
        kind = view.shutter
        rendered = render_view(scene, geometry, view, poses, options, keep if kind == "rs" else None)
        if not np.any(rendered.depth):
            raise RsbenchError(
                f"sequence {sequence.name}: {side}_{frame} shows no surface at all: change the viewpoint "
                f"{sequence.viewpoint!r} of scene {sequence.scene}, or the motion"
            )
        clean = clean_file(side, frame) if kind == "rs" and sensor else view.image
        later(write_png, folder / clean, to_srgb8(rendered.image, options.exposure))
        later(write_depth, folder / view.depth, rendered.depth)
        if things:
            later(write_png, folder / view.labels, rendered.labels)
        if scene.glossy:
            later(write_mask, folder / view.gloss, rendered.gloss)
        if kind == "rs" and sensor:
            own, period = sensor.of(side, frame), card.period_of(sequence)
            later(
                write_png, folder / view.image, sensed_rows(scene, geometry, (side, frame), own, period, options)
            )
        if kind == "gs" and sensor and card.exposed_twins:
            own, period = sensor.of(side, frame).noiseless, card.period_of(sequence)
            exposed = sensed_rows(scene, geometry, (side, frame), own, period, options, twin=view.row)
            later(write_png, folder / view.exposed, exposed)
        if kind == "rs":
            write_channels(folder, card.channels, geometry, view, rendered, SceneRays(scene, things), later, twins)
        if view.row == 0:
            yield


def sequence_truth(
    folder: Path, card: DatasetCard, sequence: SequenceCard, scene: MitsubaScene, record: Mapping[str, Any]
) -> SequenceTruth:
    """Return the data for the channels of a whole sequence; ``record`` is the table ``scene`` of sequence.json."""
    from rsbench.renderers.visibility import SceneRays

    geometry = FixedGeometry(
        card.rig_of(sequence), card.shutter_for(sequence), card.motion_of(sequence), card.frames
    )
    return SequenceTruth(
        folder=folder,
        geometry=geometry,
        seed=f"{card.seed_of(sequence)}/{sequence.name}",
        frame_period_s=card.period_of(sequence),
        sensor=card.sensor_of(sequence),
        imu=card.imu or Imu(),
        matching=card.matches or Matching(),
        scene=scene,
        record=record,
        rays=SceneRays(scene),
    )


def render_view(
    scene: MitsubaScene,
    geometry: Geometry,
    view: ImageView,
    poses: Pose,
    options: RendererOptions,
    on_gs_frame: OnGlobalFrame | None = None,
    rows: list[int] | None = None,
) -> Frame:
    """Render a view of a sequence; ``poses`` are those of the lines of its rolling-shutter frame."""
    from rsbench.renderers.render import LinePoses, render

    shutter = geometry.shutter
    tau, columns = shutter.line_times(view.frame, view.side), shutter.axis(view.side) == 0
    if view.shutter == "gs":
        line = shutter.line_after(view.row, view.side)
        poses = Pose(np.broadcast_to(poses.R[line], poses.R.shape), np.broadcast_to(poses.t[line], poses.t.shape))
        # Stitching is not needed, because all rows have the same pose and time.
        tau, options = np.full(tau.shape, tau[line]), replace(options, method="single-pass")
    lines = LinePoses(*poses, poses_of(geometry.objects, tau), columns)
    return render(scene, geometry.rig.sensor(view.side), lines, options, rows=rows, on_gs_frame=on_gs_frame)


def _stack_writer(folder: Path, options: RendererOptions) -> Callable[[int, NDArray[np.float32]], None]:
    from rsbench.renderers.image import to_srgb8

    folder.mkdir(parents=True, exist_ok=True)
    return lambda row, image: write_png(folder / f"{row:04d}.png", to_srgb8(image, options.exposure))


_LISTED_BYTES = 200
"""Number of bytes of a file's entries in sequence.json and dataset.json."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Estimated cost of a dataset, extrapolated from left frames by the number of pixels."""

    sequences: int
    files: int
    bytes: int
    seconds: float
    """Rendering time on this machine in one process, seconds."""


def estimate_dataset(card: DatasetCard, progress: Callable[[str], None]) -> Estimate:
    """Estimate from a few rendered images; ``progress`` is called with the name of each scene tried.

    Raises:
        RsbenchError: a scene or renderer of the card does not exist.
    """
    options = load_card(RendererOptions, "renderers", card.renderer)
    found: list[Estimate] = []
    warm: set[str] = set()
    for scene, group in groupby(sorted(card.sequence, key=scene_name), key=scene_name):
        found.append(_of_scene(card, list(group), options, warm))
        progress(scene)
    total = _sum(found)
    return replace(total, files=total.files + 2, bytes=total.bytes + _LISTED_BYTES * (total.files + 2))


def _sum(parts: list[Estimate]) -> Estimate:
    return Estimate(
        sequences=sum(each.sequences for each in parts),
        files=sum(each.files for each in parts),
        bytes=sum(each.bytes for each in parts),
        seconds=sum(each.seconds for each in parts),
    )


def _of_scene(
    card: DatasetCard, sequences: list[SequenceCard], options: RendererOptions, warm: set[str]
) -> Estimate:
    """Estimate for the sequences of one scene: a trial with each sensor; kernels of ``warm`` ones are compiled."""
    from rsbench.renderers.scene import MitsubaScene

    start = time.monotonic()
    scene = build_scene(sequences[0].scene).scene
    built = time.monotonic()
    rendered = MitsubaScene(seen_scene(scene, sequences[0]))
    loaded = time.monotonic()
    places = len({repr(place_of(sequence)) for sequence in sequences})
    kinds: dict[str, list[SequenceCard]] = {}
    for sequence in sequences:
        kinds.setdefault(repr((card.sensor_of(sequence), len(sequence.moving))), []).append(sequence)
    tried: list[Estimate] = []
    for kind, alike in kinds.items():
        same = alike[0].moving == sequences[0].moving
        shown = rendered if same else MitsubaScene(seen_scene(scene, alike[0]))
        tried.append(_of_kind(card, alike, options, shown, warm=kind in warm))
        warm.add(kind)
    total = _sum(tried)
    return replace(total, seconds=total.seconds + built - start + places * (loaded - built))


def _of_kind(
    card: DatasetCard, sequences: list[SequenceCard], options: RendererOptions, scene: MitsubaScene, warm: bool
) -> Estimate:
    """Estimate for sequences of one sensor; the first image compiles, which is counted once."""
    glossy: dict[str, bool] = {"glossy": True} if scene.glossy else {}
    own = files_of(card.manifest_of(sequences[0]) | glossy)
    with tempfile.TemporaryDirectory(prefix="rsbench-") as temporary:
        for folder in {Path(name).parent for name in own}:
            (Path(temporary) / folder).mkdir(parents=True, exist_ok=True)
        times, middle = list[float](), (card.frames - 1) // 2
        for _ in range(1 if warm else 2):
            begun = time.monotonic()
            with background_writer() as later:
                for _ in render_camera(
                    card, sequences[0], options, scene, SIDES[0], middle, Path(temporary), later
                ):
                    pass
            times.append(time.monotonic() - begun)
        written = sum((Path(temporary) / name).stat().st_size for name in files_below(Path(temporary)))
    rig = card.rig_of(sequences[0])
    left, right = (rig.sensor(side).width * rig.sensor(side).height for side in SIDES)
    cameras = (1.0 + right / left) * card.frames * len(sequences)
    return Estimate(
        sequences=len(sequences),
        files=len(sequences) * (len(own) + 1),
        bytes=round(cameras * written),
        seconds=max(times[0] - times[-1], 0.0) + cameras * times[-1],
    )
