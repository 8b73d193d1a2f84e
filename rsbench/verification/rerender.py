"""Render rows again if the scene can be built here: the only check that knows the ground truth."""

from __future__ import annotations

import contextlib
import hashlib
import time
from collections.abc import Collection, Iterator, Mapping
from collections.abc import Sequence as Many
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from rsbench.components.cards import list_cards, parse_card
from rsbench.core.errors import RsbenchError
from rsbench.core.geometry import MovingObject, poses_of
from rsbench.core.projection import row_poses
from rsbench.core.rig import SIDES, Side
from rsbench.core.version import __version__
from rsbench.dataset.channels import AFFINE, TRACKS
from rsbench.dataset.generation import render_view
from rsbench.dataset.layout import whole_frames
from rsbench.dataset.manifest import mesh_file_hash, scene_hash
from rsbench.dataset.motion_cards import MovingManifest
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import IMAGE_VIEWS, ImageView, image_seed, image_views
from rsbench.renderers.options import RendererOptions
from rsbench.scenes.load import load_scene, read_scene_card
from rsbench.scenes.model import Start
from rsbench.scenes.object_meshes import with_moving
from rsbench.verification.channel_checks import channels_again
from rsbench.verification.content import Content, clean_picture, stack_rows
from rsbench.verification.findings import Again, Finding, cheapest_cause, rows_of
from rsbench.verification.image_checks import CHANGES, Picture
from rsbench.verification.point_checks import points_again
from rsbench.verification.reprojection import DepthMap

if TYPE_CHECKING:
    from rsbench.renderers.render import Frame
    from rsbench.renderers.scene import MitsubaScene
    from rsbench.renderers.visibility import SceneRays


def with_files(sequence: Sequence, files: Many[Path]) -> tuple[MovingManifest, ...]:
    """Return the moving objects of a sequence, with mesh files found by name among ``files``.

    Raises:
        RsbenchError: a mesh file was not named, cannot be read, or is not the one that the sequence was made from.
    """
    named = {path.name: path for path in files}
    hashes = sequence.manifest.get("meshes")
    made = []
    for number, each in enumerate(sequence.moving, start=1):
        if each.mesh is None:
            made.append(each)
            continue
        if (path := named.get(each.mesh.name)) is None:
            raise RsbenchError(
                f"the mesh {each.mesh.name!r} of moving object {number} is a file of yours; name it with --scene"
            )
        mesh = replace(each.mesh, file=str(path))
        stated = hashes.get(str(number)) if isinstance(hashes, dict) else None
        if mesh_file_hash(mesh) != stated:
            raise RsbenchError(f"{path}: what is drawn of it has another sha256 than meshes in sequence.json says")
        made.append(replace(each, mesh=mesh))
    return tuple(made)


SAME_DEPTH = 2e-6
"""Relative tolerance of float32 rays on another processor; on the same one they have the same bits."""
_OTHER_CODES, _FAR_CODES, _FAR_ON_GPU = 0.05, 0.005, 0.02
"""Shares of pixels that may differ at all, and by more than ``_NEAR_CODES``: rounding on another processor may
move a sample across an edge, more often on a GPU, which intersects triangles by another rule."""
_NEAR_CODES = 2.0
_OTHER_DEPTH = 0.005
_OTHER_LABELS, _FEW_LABELS = 1e-3, 8
"""Share and number of labels at edges that may differ due to rounding on another processor."""


def label_checks(stored: DepthMap, rendered: NDArray[np.uint8], rows: list[int]) -> Iterator[Again]:
    if stored.labels is None:
        return
    wrong, file = stored.labels[rows] != rendered, stored.view.labels
    what = f"{100 * np.mean(wrong):.2g} % of {wrong.size} labels differ from a new rendering"
    in_rows = np.isin(np.arange(len(stored.labels)), np.asarray(rows)[np.any(wrong, axis=1)])
    bad = np.sum(wrong) > max(_OTHER_LABELS * wrong.size, _FEW_LABELS)
    yield Again(file, Finding(file, what, rows_of(in_rows)) if bad else None, not np.any(wrong))


def depth_check(stored: DepthMap, rendered: NDArray[np.float32], rows: list[int]) -> Again:
    depth, file = stored.depth[rows], stored.view.depth
    wrong = np.abs(depth - rendered) > SAME_DEPTH * np.maximum(depth, rendered)
    share = float(np.mean(wrong))
    if share <= _OTHER_DEPTH:
        return Again(file, None, np.array_equal(depth, rendered))
    both = wrong & (depth > 0) & (rendered > 0)
    ratio = depth[both] / rendered[both] if np.any(both) else np.ones(1)
    middle = float(np.median(ratio))
    scaled = np.median(np.abs(ratio / middle - 1)) < 1e-6 and abs(middle - 1) > SAME_DEPTH
    cause = f"looks scaled by {middle:.7g}" if scaled else ""
    what = f"depth differs from a new rendering on {100 * share:.3g} % of {wrong.size} pixels"
    if np.any(both):
        what += f", typically by {np.median(np.abs(ratio - 1)):.1e} of itself"
    return Again(file, Finding(file, what, _rows(wrong, rows, len(stored.depth)), cause), False)


def image_check(
    file: str, stored: Picture, rendered: NDArray[np.uint8], rows: list[int], noisy: bool, by_gpu: bool = False
) -> Again:
    """Compare an image; ``noisy``: with other random numbers; ``by_gpu``: only one of the two is from a GPU."""
    truth = rendered.astype(np.float32)
    difference = np.max(np.abs(stored.colours[rows] - truth), axis=-1)
    far = difference > _NEAR_CODES + (4 * stored.noise if noisy else 0.0)
    other = far if noisy else difference > 0
    few = _FAR_ON_GPU if by_gpu else _FAR_CODES
    if np.mean(far) <= few and np.mean(other) <= _OTHER_CODES:
        return Again(file, None, not np.any(difference))
    what = (
        f"the image differs from a new rendering on {100 * np.mean(other):.3g} % of {far.size} pixels, "
        f"by up to {np.max(difference):g} codes"
    )
    y, x = (each.ravel() for each in np.meshgrid(rows, np.arange(truth.shape[1]), indexing="ij"))
    costs = [
        float(np.mean(np.abs(change.undone(stored.colours, y, x) - truth.reshape(-1, 3)))) for change in CHANGES
    ]
    best = int(np.argmin(costs))
    cause = cheapest_cause({CHANGES[best].words: costs[best]}, costs[0], 0.5)
    return Again(file, Finding(file, what, _rows(other, rows, len(stored.colours)), cause), False)


def _rows(wrong: NDArray[np.bool_], rows: list[int], height: int) -> str:
    """Describe the rendered rows in which many pixels are wrong."""
    flags = np.zeros(height, dtype=np.bool_)
    flags[np.asarray(rows)[np.mean(wrong, axis=1) > _OTHER_DEPTH]] = True
    return "all rows that were rendered" if np.sum(flags) == len(rows) else rows_of(flags)


Rerender = Literal["no", "auto", "all"]
"""Rows to render again: none, some rows of each image if that takes seconds, or all rows."""
_ALIKE = (": the same bits", ": the same but for rounding")
"""Ends of the note if nothing differs."""
_ROWS = 16
"""Number of rows of each image that ``auto`` renders again."""
_COMPRESSED = 4
"""One in this many of the rows is compared in a compressed frame, as each needs 48 rows of the sensor."""
_MOST_RAYS = 2e8
"""Largest number of rays for a sequence with ``auto``: more samples mean fewer rows. Also that for one image."""


@dataclass(eq=False)
class Rerenderer:
    """Renders rows of sequences again; keeps the scene of the last one."""

    mode: Rerender
    scene_cards: Many[Path] = ()
    """Cards of scenes that are not built in. The scene that a dataset names is never opened as a file."""
    mesh_files: Many[Path] = ()
    """Mesh files of moving objects, likewise."""
    _built: tuple[tuple[object, ...], str, MitsubaScene] | None = field(default=None, init=False)

    def depth_is_rendered(self, content: Content, view: ImageView) -> bool:
        """Return whether a depth map equals a new rendering at every pixel, which takes one ray per pixel."""
        with contextlib.suppress(RsbenchError):  # reported by ``RerenderedRows``
            stored, rendered = content.maps[view].depth, self.whole(content, view)[1].depth
            return bool(np.all(np.abs(stored - rendered) <= SAME_DEPTH * np.maximum(stored, rendered)))
        return False

    def image_is_rendered(self, content: Content, view: ImageView) -> bool:
        """Return whether a whole picture, without sensor effects, equals a new rendering with all samples."""
        camera = content.sequence.rig.sensor(view.side)
        with contextlib.suppress(RsbenchError):  # reported by ``RerenderedRows``
            options = _options_of(content.sequence)
            rows = list(range(camera.height))
            if _rays_of(camera.width, options) * camera.height > _MOST_RAYS:
                return False
            scene, _ = self.scene(content.sequence)
            check = _picture_check(content, _render(content, scene, options, view, rows), options, view, rows)
            return check.same_bits or not (check.fault or _made_here(content))
        return False

    def cleared(self, content: Content, accused: Collection[str]) -> set[str]:
        """Return the accused channel files that are reproduced bit for bit with traced rays."""
        sequence, same = content.sequence, set[str]()
        with contextlib.suppress(RsbenchError):
            for view in [each for each in image_views(content.times) if each.shutter == "rs"]:
                if any(f"/{view.side}_{view.frame}." in file for file in accused):
                    scene, frame = self.whole(content, view)
                    rows = list(range(sequence.rig.sensor(view.side).height))
                    checks = channels_again(sequence, view, rows, frame, _rays(scene, sequence.objects), ())
                    same |= {file for file, _, alike in checks if alike}
            scene, _ = self.scene(sequence)
            again = points_again(sequence, _rays(scene), accused.__contains__)
            same |= {file for file, _, alike in again if alike}
        return same & set(accused)

    def whole(self, content: Content, view: ImageView) -> tuple[MitsubaScene, Frame]:
        """Return the scene of a sequence, and a whole frame of it with one sample per pixel."""
        options = _options_of(content.sequence)
        scene, _ = self.scene(content.sequence)
        quick = replace(options, samples=1, integrator="sunsky")
        rows = list(range(content.sequence.rig.sensor(view.side).height))
        return scene, _render(content, scene, quick, view, rows)

    def scene(self, sequence: Sequence) -> tuple[MitsubaScene, str]:
        """Return the scene of a sequence in the renderer, and its hash."""
        from rsbench.renderers.scene import MitsubaScene

        record = _table(sequence.manifest, "scene")
        name, viewpoint = record.get("name"), record.get("viewpoint")
        cards = {read_scene_card(path)[0].name: path for path in self.scene_cards}
        path = cards.get(str(name), list_cards("scenes").get(str(name)))
        if path is None:
            raise RsbenchError(f"the scene {name!r} is not one of rsbench's; name its card with --scene")
        card, _ = read_scene_card(path)
        if viewpoint not in card.viewpoints:
            raise RsbenchError(f"the scene {name!r} has no viewpoint {viewpoint!r}")
        for key, value in asdict(card.viewpoints[viewpoint]).items():
            if list(value) != record.get(key):
                raise RsbenchError(f"{key} of the viewpoint {viewpoint!r} is {list(value)}, not {record.get(key)}")
        start = (
            parse_card(Start, _table(record, "start"), "sequence.json: scene.start") if "start" in record else None
        )
        moving = with_files(sequence, self.mesh_files)
        wanted = (path, path.stat().st_mtime_ns, viewpoint, start, moving)
        if self._built is None or self._built[0] != wanted:
            self._built = None  # a scene takes hundreds of MB: never keep two at a time
            scene = load_scene(path)
            seen = scene.seen_from(scene.viewpoints[viewpoint], start)
            seen = with_moving(seen, moving) if moving else seen
            self._built = (wanted, scene_hash(scene), MitsubaScene(seen))
        return self._built[2], self._built[1]


class RerenderedRows:
    """Rows of one sequence rendered again, a few frames at a time."""

    def __init__(self, again: Rerenderer, sequence: Sequence) -> None:
        self._sequence, self._checks = sequence, list[Again]()
        self._begun, self._seconds, self._refusal = time.perf_counter(), 0.0, ""
        try:
            self._options = _options_of(sequence)
            self._scene, self._digest = again.scene(sequence)
        except RsbenchError as error:
            self._refusal = f"no row rendered again: {error}"
            return
        self._rows = _rows_of(again.mode, sequence, self._options)
        if not self._rows["left"]:
            self._refusal = "no row rendered again: its renderer takes too many samples; --rerender all does it"
        self._seconds = time.perf_counter() - self._begun

    def add(self, content: Content, reported: set[str]) -> None:
        """Render rows of frames that were just read, and compare all but ``reported`` channels."""
        if not self._refusal:
            self._take(self._row_checks(content, reported))

    def _take(self, checks: Iterator[Again]) -> None:
        start = time.perf_counter()
        self._checks += checks
        self._seconds += time.perf_counter() - start

    def end(self, reported: set[str]) -> tuple[list[Finding], str]:
        """Return faults of files that are not ``reported`` yet, and a note on what was done or why nothing was."""
        if self._refusal:
            return [], self._refusal
        manifest, checks = self._sequence.manifest, self._checks
        left_out = reported | ({AFFINE} if TRACKS in reported else set())  # affine frames at points of the tracks
        self._take(points_again(self._sequence, _rays(self._scene), lambda file: file not in left_out))
        wrong = [check for check in checks if check.fault]
        done = (
            f"{len(self._rows['left'])} rows of each image and depth map rendered again in {self._seconds:.1f} s"
        )
        if _table(manifest, "scene").get("sha256") != self._digest:
            done += "; the scene built here has another sha256 than sequence.json says"
            if wrong and _table(manifest, "made_by").get("rsbench") != __version__:
                return [], f"{done}, and other images: another version of rsbench built it"
        if wrong and len(wrong) == len(checks):
            cause = "look at scene, motion, camera and renderer in sequence.json"
            what = f"not one file is what its scene looks like when rendered again, {wrong[0].fault}"
            return [Finding("sequence.json", what, cause=cause)], done
        same = all(check.same_bits for check in checks)
        done += _ALIKE[0] if same else "" if wrong else _ALIKE[1]
        return [check.fault for check in wrong if check.fault and check.file not in reported], done

    def _row_checks(self, content: Content, reported: set[str]) -> Iterator[Again]:
        scene, options = self._scene, self._options
        own = image_views(content.times)
        twins = (each._replace(row=row) for row in content.sequence.twins for each in own if each.shutter == "gs")
        for view in (*own, *twins):
            if view not in content.maps and view not in content.pictures:
                continue
            rows = self._rows[view.side]
            frame = _render(content, scene, options, view, rows)
            if view in content.maps:
                yield depth_check(content.maps[view], frame.depth, rows)
                yield from label_checks(content.maps[view], frame.labels, rows)
            if view in content.pictures:
                yield _picture_check(content, frame, options, view, rows)
            rays = _rays(scene, content.sequence.objects)
            yield from channels_again(content.sequence, view, rows, frame, rays, reported)
            yield from self._sensed_check(content, view, reported)
            if view.shutter == "rs" and whole_frames(content.sequence.manifest):
                with contextlib.suppress(RsbenchError):  # reported already: a file that cannot be read
                    yield self._stack_check(content, view)

    def _sensed_check(self, content: Content, view: ImageView, reported: set[str]) -> Iterator[Again]:
        """Compare what the sensor makes of a rolling-shutter frame, or of a global-shutter picture without noise.

        Each row of a sensor has its own random numbers, so it can be made alone with the same bits; a row of an
        interpolated or compressed image is made together with the rows around it.
        """
        from rsbench.renderers.render import sensed_rows

        sequence, rows, rolling = content.sequence, self._rows[view.side], view.shutter == "rs"
        file = view.image if rolling else view.exposed
        if sequence.sensor is None or file in reported or not (rolling or sequence.exposed_twins):
            return
        with contextlib.suppress(RsbenchError):  # reported already: a file that cannot be read
            image = sequence.image(*view[:3]) if rolling else sequence.exposed_image(*view[1:])
            seen, sensor = Picture.of(view, image, noisy=False), sequence.sensor.of(view.side, view.frame)
            sensor, twin = (sensor, None) if rolling else (sensor.noiseless, view.row)
            few = rolling and sensor.jpeg_quality and len(rows) < len(seen.colours)
            some, chosen = rows[::_COMPRESSED] if few else rows, _of_image(content, self._options, view)
            place, period = (view.side, view.frame), sequence.frame_period_s
            made = sensed_rows(self._scene, sequence, place, sensor, period, chosen, some, twin)
            yield image_check(file, seen, made, some, not _made_here(content), _by_gpu(content))

    def _stack_check(self, content: Content, view: ImageView) -> Again:
        """Compare rows of stack images that have other rows' poses: row i of the image at the pose of row j."""
        from rsbench.renderers.image import to_srgb8
        from rsbench.renderers.render import LinePoses, render

        sequence, rows, chosen = content.sequence, self._rows[view.side], _of_image(content, self._options, view)
        of = rows[::-1]
        seen = Picture.of(view, stack_rows(sequence, view, rows, of), noisy=False)
        R, t = (
            each.copy()
            for each in row_poses(sequence.rig, sequence.shutter, sequence.motion, view.side, view.frame)
        )
        tau = sequence.shutter.line_times(view.frame, view.side).copy()
        R[rows], t[rows], tau[rows] = R[of], t[of], tau[of]
        poses = LinePoses(R, t, poses_of(sequence.objects, tau))
        frame = render(self._scene, sequence.rig.sensor(view.side), poses, chosen, rows=rows)
        rendered = to_srgb8(frame.image, chosen.exposure)
        noisy = chosen.integrator == "path" and not _made_here(content)
        return image_check(f"gs_stack/{view.side}_{view.frame}", seen, rendered, rows, noisy, _by_gpu(content))


def _rays(scene: MitsubaScene, objects: Many[MovingObject] = ()) -> SceneRays:
    from rsbench.renderers.visibility import SceneRays

    return SceneRays(scene, objects)


def _rows_of(mode: Rerender, sequence: Sequence, options: RendererOptions) -> dict[Side, list[int]]:
    """Draw one row from each of equal bands, by the hashes of the files, so that nobody knows them in advance.

    Cameras of the same height have the same rows. The mode "all" returns all rows.
    """
    cameras = {side: sequence.rig.sensor(side) for side in SIDES}
    heights = {side: camera.height for side, camera in cameras.items()}
    if mode == "all":
        return {side: list(range(height)) for side, height in heights.items()}
    views = len(IMAGE_VIEWS) * sequence.frames // 2
    widest = max(camera.width for camera in cameras.values())
    count = min(_ROWS, *heights.values(), int(_MOST_RAYS / (views * _rays_of(widest, options))))
    return {side: _drawn_rows(sequence, height, count) for side, height in heights.items()}


def _drawn_rows(sequence: Sequence, height: int, count: int) -> list[int]:
    digest = hashlib.sha256(repr(sequence.manifest.get("files")).encode()).digest()
    rng = np.random.default_rng(int.from_bytes(digest[:8], "little"))
    edges = np.linspace(0, height, count + 1).astype(int)
    return [int(rng.integers(low, high)) for low, high in pairwise(edges)]


def _rays_of(pixels: int, options: RendererOptions) -> int:
    return pixels * options.samples * (options.max_depth if options.integrator == "path" else 1)


def _options_of(sequence: Sequence) -> RendererOptions:
    return parse_card(RendererOptions, _table(sequence.manifest, "renderer"), "sequence.json: renderer")


def _table(manifest: Mapping[str, Any], key: str) -> dict[str, Any]:
    table = manifest.get(key)
    if not isinstance(table, dict):
        raise RsbenchError(f"sequence.json has no table {key!r}")
    return table


def _picture_check(
    content: Content, frame: Frame, options: RendererOptions, view: ImageView, rows: list[int]
) -> Again:
    from rsbench.renderers.image import to_srgb8

    noisy = options.integrator == "path" and not _made_here(content)
    rendered = to_srgb8(frame.image, options.exposure)
    file, stored = clean_picture(content.sequence, view), content.pictures[view]
    return image_check(file, stored, rendered, rows, noisy, _by_gpu(content))


def _by_gpu(content: Content) -> bool:
    """Return whether only one of the stored image and the new rendering is from a GPU."""
    from rsbench.renderers.backend import VARIANTS, start_backend

    variants = {start_backend().variant, _table(content.sequence.manifest, "made_by").get("variant")}
    return len(variants) > 1 and VARIANTS["cuda"] in variants


def _made_here(content: Content) -> bool:
    """Return whether the same versions and variant rendered the dataset, so that random numbers are equal."""
    from rsbench.renderers.backend import start_backend

    here = {"mitsuba": version("mitsuba"), "drjit": version("drjit"), "variant": start_backend().variant}
    made_by = _table(content.sequence.manifest, "made_by")
    return all(made_by.get(key) == value for key, value in here.items())


def _of_image(content: Content, options: RendererOptions, view: ImageView) -> RendererOptions:
    sequence = content.sequence
    seed = image_seed(int(sequence.manifest.get("seed", 0)), sequence.name, view.side, view.frame)
    return replace(options, seed=seed, method="single-pass", full_frames=False)


def _render(
    content: Content, scene: MitsubaScene, options: RendererOptions, view: ImageView, rows: list[int]
) -> Frame:
    """Render rows of a view, with the same bits as in the whole image."""
    sequence = content.sequence
    poses = row_poses(sequence.rig, sequence.shutter, sequence.motion, view.side, view.frame)
    return render_view(scene, sequence, view, poses, _of_image(content, options, view), rows=rows)
