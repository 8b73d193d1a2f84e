"""What the files of a sequence hold: poses, depth and images, each alone and against the others."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.core.rig import FRAMES
from rsbench.dataset.layout import clean_file
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import SHOTS, near_shots, pairs_of, shots_of
from rsbench.storage.files import read_png
from rsbench.storage.untrusted_files import inside
from rsbench.verification import depth, image_checks
from rsbench.verification.depth_causes import likely_cause
from rsbench.verification.findings import DepthAgreement, Finding, rows_of
from rsbench.verification.frame_comparison import DepthMap, Shot, in_one_light, land
from rsbench.verification.image_causes import Elsewhere as Elsewhere
from rsbench.verification.image_causes import likeness_faults
from rsbench.verification.png_header import png_fault
from rsbench.verification.thin_structures import roughly_alike

Judge = Callable[[Shot], bool]
"""Says of a file of a shot, from what nobody who made the dataset could change, that it is right."""


@dataclass(eq=False)
class Content:
    """The depth maps and images of a sequence that can be read, and the faults of those that cannot."""

    sequence: Sequence
    maps: dict[Shot, DepthMap] = field(default_factory=dict)
    pictures: dict[Shot, image_checks.Picture] = field(default_factory=dict)
    faults: list[Finding] = field(default_factory=list)
    times: tuple[int, ...] = ()
    """Numbers of the frames that were read."""

    def followed_by(self, other: Content, told: Collection[str]) -> Content:
        """What was read last and the next, but for files that are ``told``: they accuse the next ones no more."""
        last = self.times[-1:]
        maps = {shot: each for shot, each in self.maps.items() if shot.frame in last and shot.depth not in told}
        pictures = {
            shot: each
            for shot, each in self.pictures.items()
            if shot.frame in last and not {shot.image, clean_picture(self.sequence, shot)} & {*told}
        }
        return Content(self.sequence, maps | other.maps, pictures | other.pictures, times=last + other.times)


def read_content(sequence: Sequence, missing: Collection[str] = (), times: tuple[int, ...] = FRAMES) -> Content:
    """Read all shots of some frames but ``missing`` files, one fault for each that cannot be."""
    content = Content(sequence, times=times)
    for shot in shots_of(times):
        read_shot(content, shot, missing)
    return content


def read_shot(content: Content, shot: Shot, missing: Collection[str]) -> None:
    """Add what can be read of a shot, and the faults of what cannot."""
    sequence = content.sequence
    renderer = sequence.manifest.get("renderer")
    noisy = isinstance(renderer, dict) and renderer.get("integrator") == "path"
    size = sequence.rig.camera.width, sequence.rig.camera.height
    try:
        beside = [shot.labels] * bool(sequence.moving) + [shot.gloss] * sequence.glossy
        if not {shot.depth, *beside} & set(missing):
            labels = sequence.labels(*shot) if sequence.moving else None
            gloss = sequence.gloss(*shot) if sequence.glossy else None
            content.maps[shot] = DepthMap(shot, sequence.depth(*shot), sequence.rig.camera, labels, gloss)
    except RsbenchError as error:
        content.faults.append(Finding.of(error))
    file = clean_picture(sequence, shot)
    if file in missing:
        return
    try:
        fault = png_fault(inside(sequence.folder, file), file, size)
        content.faults += [fault] if fault else []
        if fault is None:
            pixels = read_png(inside(sequence.folder, file), size)
            content.pictures[shot] = image_checks.Picture.of(shot, pixels, noisy)
    except RsbenchError as error:
        content.faults.append(Finding.of(error))


def clean_picture(sequence: Sequence, shot: Shot) -> str:
    """The image of a shot that shows light alone: where a sensor blurs and errs, its clean twin."""
    blurred = sequence.sensor is not None and shot.shutter == "rs"
    return clean_file(shot.side, shot.frame) if blurred else shot.image


def twin_faults(content: Content) -> Iterator[Finding]:
    """The first row of a rolling-shutter frame and of its global-shutter twin are the same rays and values.

    Where columns are read, it is the first column.
    """
    for shot in shots_of(content.times):
        twin, maps, pictures = shot._replace(shutter="gs"), content.maps, content.pictures
        axis, number = _first_line(content, shot)
        line = f"{'row' if axis == 0 else 'column'} {number}"
        if shot.shutter != "rs":
            continue
        if {shot, twin} <= pictures.keys():
            rows = [np.take(pictures[each].colours, [number], axis) for each in (shot, twin)]
            apart = np.max(np.abs(rows[0].astype(np.float64) - rows[1]), axis=-1)
            unlike = apart > _rounding(axis, 1.0)
            if np.sum(unlike) > spare_pixels(axis, unlike.size):
                what = f"{np.sum(unlike)} pixels differ from the global-shutter twin at the same pose"
                yield Finding(clean_picture(content.sequence, shot), f"{line} differs from {twin.image}: {what}")
        if {shot, twin} <= maps.keys():
            own, other = (np.take(maps[each].depth, [number], axis) for each in (shot, twin))
            if np.sum(np.abs(own - other) > _rounding(axis, 1e-6) * other) > spare_pixels(axis, own.size):
                what = f"by up to {np.max(np.abs(own - other)):.3g} m at the same pose"
                cause = _first_of_twin(maps[shot].depth, maps[twin].depth)
                yield Finding(shot.depth, f"{line} differs from {twin.depth}: {what}", cause=cause)


def _rounding(axis: int, most: float) -> float:
    """How much the values of a line that two images share may differ anywhere: see ``spare_pixels``."""
    return 0.0 if axis == 0 else most


def spare_pixels(axis: int, size: int) -> int:
    """So many of the pixels of a line that two images share may differ: of a row none.

    Of a column some: rays are traced in packets along rows, and beside others a ray is rounded otherwise.
    """
    return 0 if axis == 0 else max(2, size // 20)


def _first_line(content: Content, shot: Shot) -> tuple[int, int]:
    """Axis and number of the line of an image that is read first."""
    shutter = content.sequence.shutter
    return 1 - shutter.axis(shot.side), shutter.first_line(shot.side)


def _first_of_twin(depth: NDArray[np.float32], twin: NDArray[np.float32]) -> str:
    """Where these maps (H, W) begin to be read, in words, by the one line that they share; "" for none."""
    ends = (("top", 0, 0), ("bottom", 0, -1), ("left", 1, 0), ("right", 1, -1))
    lines = {side: (depth.take(place, axis), twin.take(place, axis)) for side, axis, place in ends}
    same = [side for side, (own, other) in lines.items() if np.array_equal(own, other) and np.any(own)]
    return f"looks read from the {same[0]}" if len(same) == 1 else ""


@dataclass(eq=False)
class Comparison:
    """All pairs of a sequence compared, step by step."""

    content: Content
    stride: int
    agreements: list[tuple[Shot, Shot, DepthAgreement]] = field(default_factory=list)
    verdicts: dict[Shot, depth.MapVerdict] = field(default_factory=dict)
    likenesses: list[image_checks.Likeness] = field(default_factory=list)
    votes: dict[Shot, image_checks.ImageVotes] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    """What could not be compared well, and is no fault."""

    def __post_init__(self) -> None:
        camera = self.content.sequence.rig.camera
        self.verdicts = {shot: depth.MapVerdict(each, self.stride) for shot, each in self.content.maps.items()}
        self.votes = {
            shot: image_checks.ImageVotes.none((camera.height, camera.width)) for shot in self.content.pictures
        }

    def pairs(self) -> Iterator[DepthAgreement | None]:
        """Compare one pair after the other; None where a file of it could not be read."""
        maps, pictures = self.content.maps, self.content.pictures
        for source, target in pairs_of((self.content.times[0], self.content.times[-1])):
            if not {source, target} <= maps.keys():
                yield None
                continue
            landing = land(self.content.sequence, maps[source], maps[target], self.stride)
            agreement = depth.compare(self.verdicts[source], self.verdicts[target], landing)
            self.agreements.append((source, target, agreement))
            if {source, target} <= pictures.keys():
                lit = in_one_light(self.content.sequence, maps[source], maps[target], landing, self.stride)
                self.likenesses.append(
                    image_checks.compare(
                        pictures[source], pictures[target], maps[source], lit, self.votes[source], self.stride
                    )
                )
            yield agreement

    def geometry(self) -> depth.GeometryFault | None:
        """What the pairs show of sequence.json; where that is wrong they show nothing else."""
        return depth.geometry_fault(self.agreements)

    def faults(
        self, elsewhere: Elsewhere, is_right: Judge = lambda shot: False, shows: Judge = lambda shot: False
    ) -> Iterator[Finding]:
        """What the pairs show, each with its likely cause.

        ``is_right`` acquits a depth map that they accuse, ``shows`` an image.
        """
        wrong = self._wrong_maps(is_right)
        for shot, fault in wrong.items():
            cause = likely_cause(self.content.sequence, self.content.maps, shot, fault.rows)
            yield Finding(shot.depth, fault.what, rows_of(fault.rows), cause)
        yield from depth.pair_faults(self.agreements, wrong)
        yield from self._acquitted(list(self._image_faults(wrong.keys(), elsewhere)), shows)

    def _acquitted(self, accused: list[tuple[Shot, Finding]], shows: Judge) -> Iterator[Finding]:
        """Faults of images without those that are what is rendered again: fine things look different from each
        place. A partner that is not what is rendered again is then what was wrong."""
        judged = lru_cache(maxsize=None)(shows)
        for shot, fault in accused:
            if not judged(shot):
                yield fault
                continue
            what = "others contradict it, and it is what is rendered again, all of it"
            self.notes.append(str(Finding(shot.image, what)))
            pairs = {(each.source, each.target) for each in self.likenesses}
            for other in sorted(
                {one for pair in pairs if shot in pair for one in pair} - {one for one, _ in accused}
            ):
                if not judged(other):
                    yield Finding(other.image, f"shows other colours than {shot.image} at the same surface")

    def _wrong_maps(self, is_right: Judge) -> dict[Shot, depth.MapFault]:
        """Faults of maps; one without a flat place is none, where it is roughly what others see."""
        wrong, right = depth.map_faults(self.verdicts), set[Shot]()
        while acquitted := {shot for shot in wrong if is_right(shot)}:
            right |= acquitted
            wrong = depth.map_faults(self.verdicts, right)
        for shot in right:
            what = "others contradict it, and it is what is rendered again, all of it"
            self.notes.append(str(Finding(shot.depth, what)))
        for shot in [shot for shot, fault in wrong.items() if fault.uncompared]:
            if roughly_alike(self.content.sequence, self.content.maps, shot):
                del wrong[shot]
                what = "no place is flat enough to be compared with another frame; it is roughly what others see"
                self.notes.append(str(Finding(shot.depth, what)))
        return wrong

    def _image_faults(self, blamed: Collection[Shot], elsewhere: Elsewhere) -> Iterator[tuple[Shot, Finding]]:
        """Images compared through depth that is in order; a wrong map would accuse its image too."""
        content, told = self.content, set()
        for shot, picture in content.pictures.items():
            fault = image_checks.colour_fault(picture, content.pictures)
            if fault:
                told.add(shot)
                yield shot, fault
        sound = [each for each in self.likenesses if not {each.source, each.target} & {*blamed, *told}]
        heard = image_checks.heard(sound)
        for shot, fault in likeness_faults(content.sequence, content.maps, content.pictures, heard, elsewhere):
            told.add(shot)
            yield shot, fault
        for shot, votes in self.votes.items():
            rows = image_checks.tile_rows(votes)
            if shot not in told and shot not in blamed and np.any(rows):
                what = "a part of these rows shows other colours than two partners at the same surface"
                yield shot, Finding(shot.image, what, rows_of(rows))


def images_elsewhere(sequence: Sequence, others: Callable[[], Iterable[Sequence]]) -> Elsewhere:
    """Images of frames of a sequence near one, then of other sequences, those of the same name first."""

    def candidates(shot: Shot) -> Iterator[tuple[str, NDArray[np.uint8]]]:
        if sequence.frames > len(FRAMES):
            for each in near_shots(shot, sequence.frames):
                with contextlib.suppress(RsbenchError):
                    yield each.image, read_png(sequence.folder / each.image)
        for other in others():
            for each in sorted(SHOTS, key=lambda one: one != shot):
                try:
                    yield f"{other.name}/{each.image}", read_png(other.folder / each.image)
                except RsbenchError:
                    continue

    return candidates
