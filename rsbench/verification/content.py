"""Read the images and depth maps of a sequence, compare all pairs, and compare shared rows bit for bit."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable, Collection, Iterable, Iterator
from collections.abc import Sequence as Rows
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.core.rig import FRAMES, SIDES
from rsbench.dataset.layout import clean_file, stack_file, whole_frames
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import IMAGE_VIEWS, ImageView, image_views, nearby_views, view_pairs
from rsbench.storage.files import read_png
from rsbench.storage.untrusted_files import inside, open_regular
from rsbench.verification import depth_checks, image_checks
from rsbench.verification.compiled_comparison import DEPTH_TOLERANCE
from rsbench.verification.depth_checks import likely_cause, roughly_agree
from rsbench.verification.findings import DepthAgreement, Finding, rows_of
from rsbench.verification.image_checks import OtherImages as OtherImages
from rsbench.verification.image_checks import colour_faults
from rsbench.verification.reprojection import (
    BoolArray,
    DepthMap,
    reproject,
    without_changing_light,
)

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_COLOUR_TYPES = {0: "grey", 2: "RGB", 3: "palette", 4: "grey and alpha", 6: "RGBA"}


def png_fault(path: Path, name: str, size: tuple[int, int]) -> Finding | None:
    """The fault of a file that is not an 8-bit RGB PNG of ``size`` (width, height), by its header, or None."""
    try:
        with open_regular(path) as stream:
            head = stream.read(26)
    except OSError as error:
        return Finding(name, f"cannot be read: {error.strerror}")
    if len(head) < 26 or head[:8] != _SIGNATURE or head[12:16] != b"IHDR":
        return Finding(name, "damaged or not a PNG")
    width, height, bits, colour = struct.unpack(">IIBB", head[16:26])
    if (width, height) != size:
        return Finding(name, f"is {width} x {height} pixels, the camera {size[0]} x {size[1]}")
    if (bits, colour) != (8, 2):
        kind = _COLOUR_TYPES.get(colour, f"colour type {colour}")
        return Finding(name, f"is {kind} of {bits} bits per channel: 8-bit RGB is needed")
    return None


Judge = Callable[[ImageView], bool]
"""Whether a file of a view is correct according to evidence that the dataset's author cannot change."""


@dataclass(eq=False)
class Content:
    """The readable depth maps and images of a sequence, and the faults of the unreadable ones."""

    sequence: Sequence
    maps: dict[ImageView, DepthMap] = field(default_factory=dict)
    pictures: dict[ImageView, image_checks.Picture] = field(default_factory=dict)
    faults: list[Finding] = field(default_factory=list)
    times: tuple[int, ...] = ()
    """Numbers of the frames that were read."""

    def maps_without(self, reported: Collection[str]) -> dict[ImageView, DepthMap]:
        """Depth maps that are not ``reported`` as wrong, which would accuse others."""
        return {view: each for view, each in self.maps.items() if view.depth not in reported}

    def followed_by(self, other: Content, reported: Collection[str]) -> Content:
        """The last frame of this content and the next, without ``reported`` files, which would accuse others."""
        last = self.times[-1:]
        maps = {view: each for view, each in self.maps_without(reported).items() if view.frame in last}
        pictures = {
            view: each
            for view, each in self.pictures.items()
            if view.frame in last and not {view.image, clean_picture(self.sequence, view)} & {*reported}
        }
        return Content(self.sequence, maps | other.maps, pictures | other.pictures, times=last + other.times)


def read_content(sequence: Sequence, missing: Collection[str] = (), times: tuple[int, ...] = FRAMES) -> Content:
    """Read all views of some frames except ``missing`` files; each unreadable file gives a fault."""
    content = Content(sequence, times=times)
    for view in image_views(times):
        read_view(content, view, missing)
    return content


def read_view(content: Content, view: ImageView, missing: Collection[str]) -> None:
    """Read the files of a view into ``content``, with faults for unreadable ones."""
    sequence = content.sequence
    renderer = sequence.manifest.get("renderer")
    noisy = isinstance(renderer, dict) and renderer.get("integrator") == "path"
    camera = sequence.rig.sensor(view.side)
    size = camera.width, camera.height
    try:
        beside = [view.labels] * bool(sequence.moving) + [view.gloss] * sequence.glossy
        if not {view.depth, *beside} & set(missing):
            labels = sequence.labels(*view) if sequence.moving else None
            gloss = sequence.gloss(*view) if sequence.glossy else None
            content.maps[view] = DepthMap(view, sequence.depth(*view), camera, labels, gloss)
    except RsbenchError as error:
        content.faults.append(Finding.of(error))
    file = clean_picture(sequence, view)
    if file in missing:
        return
    try:
        fault = png_fault(inside(sequence.folder, file), file, size)
        content.faults += [fault] if fault else []
        if fault is None:
            pixels = read_png(inside(sequence.folder, file), size)
            content.pictures[view] = image_checks.Picture.of(view, pixels, noisy)
    except RsbenchError as error:
        content.faults.append(Finding.of(error))


def clean_picture(sequence: Sequence, view: ImageView) -> str:
    """The file of a view's image without effects of a sensor: the clean twin if the dataset has a sensor."""
    blurred = sequence.sensor is not None and view.shutter == "rs"
    return clean_file(view.side, view.frame) if blurred else view.image


def twin_faults(content: Content) -> Iterator[Finding]:
    """Compare the first row (or column) of rolling-shutter frames and their global-shutter twins.

    Both are rendered with the same rays and must have the same values.
    """
    for view in image_views(content.times):
        twin, maps, pictures = view._replace(shutter="gs"), content.maps, content.pictures
        axis, number, line = shared_line(content.sequence, twin)
        if view.shutter != "rs":
            continue
        if {view, twin} <= pictures.keys():
            rows = [np.take(pictures[each].colours, [number], axis) for each in (view, twin)]
            apart = np.max(np.abs(rows[0].astype(np.float64) - rows[1]), axis=-1)
            unlike = apart > _rounding(axis, 1.0)
            if np.sum(unlike) > spare_pixels(axis, unlike.size):
                what = f"{np.sum(unlike)} pixels differ from the global-shutter twin at the same pose"
                yield Finding(clean_picture(content.sequence, view), f"{line} differs from {twin.image}: {what}")
        if {view, twin} <= maps.keys():
            own, other = (np.take(maps[each].depth, [number], axis) for each in (view, twin))
            if np.sum(np.abs(own - other) > _rounding(axis, 1e-6) * other) > spare_pixels(axis, own.size):
                what = f"by up to {np.max(np.abs(own - other)):.3g} m at the same pose"
                cause = _first_of_twin(maps[view].depth, maps[twin].depth)
                yield Finding(view.depth, f"{line} differs from {twin.depth}: {what}", cause=cause)


def _rounding(axis: int, most: float) -> float:
    """Tolerance of the values of a line that two images share, see ``spare_pixels``."""
    return 0.0 if axis == 0 else most


def spare_pixels(axis: int, size: int) -> int:
    """Number of pixels that may differ in a line that two images share: none in a row, some in a column.

    Rays are traced in packets along rows, and the rounding of a ray depends on the others in its packet.
    """
    return 0 if axis == 0 else max(2, size // 20)


def shared_line(sequence: Sequence, twin: ImageView) -> tuple[int, int, str]:
    """Axis, number and name ("row 3") of the line that a global-shutter image shares with its frame."""
    axis, line = 1 - sequence.shutter.axis(twin.side), sequence.shutter.line_after(twin.row, twin.side)
    return axis, line, f"{'row' if axis == 0 else 'column'} {line}"


def _first_of_twin(depth: NDArray[np.float32], twin: NDArray[np.float32]) -> str:
    """Text on the side at which two depth maps (H, W) share a line, where the readout begins; "": unclear."""
    ends = (("top", 0, 0), ("bottom", 0, -1), ("left", 1, 0), ("right", 1, -1))
    lines = {side: (depth.take(place, axis), twin.take(place, axis)) for side, axis, place in ends}
    same = [side for side, (own, other) in lines.items() if np.array_equal(own, other) and np.any(own)]
    return f"looks read from the {same[0]}" if len(same) == 1 else ""


@dataclass(eq=False)
class Comparison:
    """The comparison of all pairs of views of a sequence, step by step."""

    content: Content
    stride: int
    agreements: list[tuple[ImageView, ImageView, DepthAgreement]] = field(default_factory=list)
    evidence: dict[ImageView, depth_checks.DepthEvidence] = field(default_factory=dict)
    colour_agreements: list[image_checks.ColourAgreement] = field(default_factory=list)
    votes: dict[ImageView, NDArray[np.uint8]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    """Notes on what could not be compared well; these are no faults."""

    def __post_init__(self) -> None:
        self.evidence = {
            view: depth_checks.DepthEvidence(each, self.stride) for view, each in self.content.maps.items()
        }
        pictures = self.content.pictures.items()
        self.votes = {view: np.zeros((2, *each.colours.shape[:2]), np.uint8) for view, each in pictures}

    def pairs(self) -> Iterator[DepthAgreement | None]:
        """Compare one pair after the other; yields None for a pair with an unreadable file."""
        maps, pictures = self.content.maps, self.content.pictures
        for source, target in view_pairs((self.content.times[0], self.content.times[-1])):
            if not {source, target} <= maps.keys():
                yield None
                continue
            reprojection = reproject(self.content.sequence, maps[source], maps[target], self.stride)
            agreement = depth_checks.compare(self.evidence[source], self.evidence[target], reprojection)
            self.agreements.append((source, target, agreement))
            if {source, target} <= pictures.keys():
                lit = without_changing_light(
                    self.content.sequence, maps[source], maps[target], reprojection, self.stride
                )
                self.colour_agreements.append(
                    image_checks.compare(
                        pictures[source], pictures[target], maps[source], lit, self.votes[source], self.stride
                    )
                )
            yield agreement

    def geometry(self) -> depth_checks.GeometryFault | None:
        """A fault of sequence.json that the pairs reveal; they are then useless for other checks."""
        return depth_checks.geometry_fault(self.agreements, self.content.sequence.rig)

    def faults(
        self,
        other_images: OtherImages,
        depth_is_rendered: Judge = lambda view: False,
        image_is_rendered: Judge = lambda view: False,
    ) -> Iterator[Finding]:
        """Faults of depth maps and images that the pairs reveal, each with its likely cause.

        Depth maps and images that equal their new rendering, according to ``depth_is_rendered`` and
        ``image_is_rendered``, are left out.
        """
        wrong = self._wrong_maps(depth_is_rendered)
        for view, fault in wrong.items():
            cause = likely_cause(self.content.sequence, self.content.maps, view, fault.rows)
            yield Finding(view.depth, fault.what, rows_of(fault.rows), cause)
        yield from depth_checks.pair_faults(self.agreements, wrong, self.content.sequence.rig)
        yield from self._without_rendered(list(self._image_faults(wrong.keys(), other_images)), image_is_rendered)

    def _without_rendered(
        self, accused: list[tuple[ImageView, Finding]], image_is_rendered: Judge
    ) -> Iterator[Finding]:
        """Faults of images without those that equal their new rendering: fine structures look different from each
        viewpoint. If a partner of such an image differs from its new rendering, it is accused instead."""
        judged = lru_cache(maxsize=None)(image_is_rendered)
        for view, fault in accused:
            if not judged(view):
                yield fault
                continue
            what = "others contradict it, but it equals a new rendering"
            self.notes.append(str(Finding(view.image, what)))
            pairs = {(each.source, each.target) for each in self.colour_agreements}
            for other in sorted(
                {one for pair in pairs if view in pair for one in pair} - {one for one, _ in accused}
            ):
                if not judged(other):
                    yield Finding(other.image, f"shows other colours than {view.image} at the same surface")

    def _wrong_maps(self, depth_is_rendered: Judge) -> dict[ImageView, depth_checks.MapFault]:
        """Faults of depth maps; a map without flat surfaces is accepted if it roughly agrees with others."""
        wrong, right = depth_checks.map_faults(self.evidence), set[ImageView]()
        while confirmed := {view for view in wrong if depth_is_rendered(view)}:
            right |= confirmed
            wrong = depth_checks.map_faults(self.evidence, right)
        for view in right:
            what = "others contradict it, but it equals a new rendering"
            self.notes.append(str(Finding(view.depth, what)))
        for view in [view for view, fault in wrong.items() if fault.uncompared]:
            if roughly_agree(self.content.sequence, self.content.maps, view):
                del wrong[view]
                what = (
                    "no surface is flat enough for a comparison with another frame; it roughly agrees with others"
                )
                self.notes.append(str(Finding(view.depth, what)))
        return wrong

    def _image_faults(
        self, wrong: Collection[ImageView], other_images: OtherImages
    ) -> Iterator[tuple[ImageView, Finding]]:
        """Faults of images compared through correct depth maps, as a wrong map would accuse its image too."""
        content, reported = self.content, set()
        for view, picture in content.pictures.items():
            fault = image_checks.single_colour_fault(picture, content.pictures)
            if fault:
                reported.add(view)
                yield view, fault
        sound = [each for each in self.colour_agreements if not {each.source, each.target} & {*wrong, *reported}]
        sound = image_checks.without_refuted(sound)
        for view, fault in colour_faults(content, sound, other_images):
            reported.add(view)
            yield view, fault
        for view, votes in self.votes.items():
            rows = image_checks.tile_rows(votes)
            if view not in reported and view not in wrong and np.any(rows):
                what = "a part of these rows shows other colours than two partners at the same surface"
                yield view, Finding(view.image, what, rows_of(rows))


def images_of_others(sequence: Sequence, others: Callable[[], Iterable[Sequence]]) -> OtherImages:
    """Images of nearby frames of a sequence, then of other sequences, those with the same name first."""

    def candidates(view: ImageView) -> Iterator[tuple[str, NDArray[np.uint8]]]:
        if sequence.frames > len(FRAMES):
            for each in nearby_views(view, sequence.frames):
                with contextlib.suppress(RsbenchError):
                    yield each.image, read_png(sequence.folder / each.image)
        for other in others():
            for each in sorted(IMAGE_VIEWS, key=lambda one: one != view):
                try:
                    yield f"{other.name}/{each.image}", read_png(other.folder / each.image)
                except RsbenchError:
                    continue

    return candidates


_SAME_SURFACE, _LEAST_SHARED = 0.05, 100
"""Relative distance up to which two surfaces are the same one with an error, while otherwise one hides the other;
smallest number of shared pixels for a check."""
_MOST_WRONG = 0.1
"""Largest share of different pixels, for objects thinner than a pixel and edges that are nearly flat."""


def read_twins(sequence: Sequence, missing: Collection[str], times: tuple[int, ...]) -> Content:
    """``read_content`` for the global-shutter twins at rows other than the first."""
    content = Content(sequence, times=times)
    for row in sequence.twins:
        for side, frame in product(SIDES, times):
            read_view(content, ImageView("gs", side, frame, row), missing)
    return content


def other_twin_faults(content: Content, twins: Content, stride: int = 1) -> Iterator[Finding]:
    """Check that a twin shares a row with its rolling-shutter frame, bit for bit, and shows the same surfaces."""
    sequence = content.sequence
    for row in sequence.twins:
        for side, frame in product(SIDES, content.times):
            twin, source = ImageView("gs", side, frame, row), ImageView("rs", side, frame)
            yield from _shared_line_faults(content, twins, source, twin)
            if source in content.maps and twin in twins.maps:
                yield from _twin_depth_faults(content, twins, source, twin, stride)


def _shared_line_faults(content: Content, twins: Content, source: ImageView, twin: ImageView) -> Iterator[Finding]:
    axis, line, name = shared_line(content.sequence, twin)
    words = f"{name} differs from"
    if source in content.pictures and twin in twins.pictures:
        own, other = (
            np.take(each.colours, line, axis) for each in (twins.pictures[twin], content.pictures[source])
        )
        unlike = np.any(own != other, axis=-1)
        if np.sum(unlike) > spare_pixels(axis, unlike.size):
            of = clean_picture(content.sequence, source)
            yield Finding(twin.image, f"{words} {of}: {np.sum(unlike)} pixels at the same pose")
    if source in content.maps and twin in twins.maps:
        own, other = (np.take(each.depth, line, axis) for each in (twins.maps[twin], content.maps[source]))
        if np.sum(own != other) > spare_pixels(axis, own.size):
            far = np.max(np.abs(own - other))
            yield Finding(twin.depth, f"{words} {source.depth}: by up to {far:.3g} m at the same pose")


def _twin_depth_faults(
    content: Content, twins: Content, source: ImageView, twin: ImageView, stride: int
) -> Iterator[Finding]:
    relative = reproject(content.sequence, twins.maps[twin], content.maps[source], stride).relative
    with np.errstate(invalid="ignore"):
        near = (np.abs(relative) < _SAME_SURFACE) & (twins.maps[twin].depth[::stride, ::stride] > 0)
        wrong: BoolArray = near & ~(np.abs(relative) < DEPTH_TOLERANCE)
    if np.sum(near) >= _LEAST_SHARED and np.sum(wrong) > _MOST_WRONG * np.sum(near):
        middle = float(np.median(relative[near]))
        cause = f"looks scaled by {1 + middle:.5g}" if abs(middle) > DEPTH_TOLERANCE else ""
        share = f"{100 * np.sum(wrong) / np.sum(near):.0f} % of {np.sum(near)} pixels"
        rows = np.repeat(np.sum(wrong, axis=1) > _MOST_WRONG * np.maximum(np.sum(near, axis=1), 1), stride)
        what = f"{share} differ from the surface of {source.depth}"
        yield Finding(twin.depth, what, rows_of(rows[: len(twins.maps[twin].depth)]), cause)


def with_twins(content: Content, twins: Content) -> Content:
    """Both contents joined, for checks of channels and of rows rendered again."""
    maps, pictures = content.maps | twins.maps, content.pictures | twins.pictures
    return Content(content.sequence, maps, pictures, times=content.times)


def stack_faults(content: Content, missing: Collection[str], stride: int = 1) -> Iterator[Finding]:
    """Check that row y of stack image y is row y of the rolling-shutter frame, and that image 0 is its
    global-shutter twin; every ``stride``-th image is read."""
    sequence = content.sequence
    for view, picture in content.pictures.items():
        rows_scanned = sequence.shutter.axis(view.side) == 1
        if view.shutter != "rs" or not rows_scanned or not whole_frames(sequence.manifest):
            continue
        height = sequence.rig.sensor(view.side).height
        rows, wrong = range(0, height, stride), np.zeros(height, dtype=np.bool_)
        for row in rows:
            file = stack_file(view.side, view.frame, row)
            if file in missing:
                continue
            try:
                image = _stack_image(sequence, view, row)
            except RsbenchError as error:
                yield Finding.of(error)
                continue
            wrong[row] = not np.array_equal(image[row], picture.colours[row])
            twin = content.pictures.get(view._replace(shutter="gs"))
            if (
                row == sequence.shutter.first_line(view.side)
                and twin is not None
                and not np.array_equal(image, twin.colours)
            ):
                yield Finding(file, f"differs from {twin.view.image}, which has the same pose")
        if np.any(wrong):
            what = f"{np.sum(wrong)} images differ in their own row from {clean_picture(sequence, view)}"
            yield Finding(f"gs_stack/{view.side}_{view.frame}", what, rows_of(wrong))


def stack_rows(sequence: Sequence, view: ImageView, rows: Rows[int], of: Rows[int]) -> NDArray[np.uint8]:
    """(H, W, 3) image in which row ``rows[k]`` is that of stack image ``of[k]``, and other rows are black.

    Raises:
        RsbenchError: an image cannot be read.
    """
    camera = sequence.rig.sensor(view.side)
    shown = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
    for row, image in zip(rows, of, strict=True):
        shown[row] = _stack_image(sequence, view, image)[row]
    return shown


def _stack_image(sequence: Sequence, view: ImageView, row: int) -> NDArray[np.uint8]:
    camera = sequence.rig.sensor(view.side)
    file = inside(sequence.folder, stack_file(view.side, view.frame, row))
    return read_png(file, (camera.width, camera.height))
