"""The checks of ``rsbench verify``: their table, one function and one row each, and their run over a sequence."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Literal

from rsbench.core.errors import RsbenchError
from rsbench.dataset.sequence import Sequence, read_sequence
from rsbench.dataset.views import VIEW_PAIRS, Times
from rsbench.verification.channel_checks import channel_faults, hdr_faults, surface_faults
from rsbench.verification.content import (
    Comparison,
    Content,
    OtherImages,
    images_of_others,
    other_twin_faults,
    read_content,
    read_twins,
    stack_faults,
    twin_faults,
    with_twins,
)
from rsbench.verification.depth_checks import GeometryFault, frames_of_other_times
from rsbench.verification.findings import MISSING, DepthAgreement, Finding, Progress, files_of
from rsbench.verification.manifest_checks import Listing, dataset_faults, file_faults, sequence_faults
from rsbench.verification.mask_checks import gloss_faults, known_gloss, label_faults
from rsbench.verification.point_checks import affine_faults, match_faults, matched_again, track_faults
from rsbench.verification.pose_checks import imu_faults, pose_faults, timing_faults
from rsbench.verification.rerender import RerenderedRows, Rerenderer
from rsbench.verification.sensor_checks import sensor_faults

_MOST_ELSEWHERE = 8
"""Other sequences among whose images an exchanged one is looked for."""


@dataclass(eq=False)
class State:
    """One sequence under verification; each check reads from here.

    Frames are read two at a time, so that long sequences take no more memory.
    """

    listing: Listing
    name: str
    stride: int = 1
    again: Rerenderer | None = None
    """Builds the scene and renders rows again; None with `--rerender no`."""
    step: Progress = lambda name: None
    findings: list[Finding] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    agreements: dict[tuple[str, str], DepthAgreement] = field(default_factory=dict)
    disagreeing: dict[Times, GeometryFault] = field(default_factory=dict)
    """Frames whose depth maps do not agree, none by itself."""
    missing: Collection[str] = ()
    """Files that a manifest lists and that are not there."""
    sequence: Sequence = field(init=False)
    """From the stage "sequence" on, as ``other_images``."""
    other_images: OtherImages = field(init=False)
    """Images that may have been exchanged with its own."""
    fresh: Content = field(init=False)
    """The frames that were read last: both of the first two, then one at a time. From the stage "masks" on."""
    twins: Content = field(init=False)
    """Their global-shutter twins at other rows than the first."""
    content: Content = field(init=False)
    """The last two frames, without what earlier checks found wrong. From the stage "frames" on."""
    masks_by_rays: bool = False
    """Whether the masks of ``fresh`` and ``twins`` are those that rays meet, not those that are stored."""
    rerendered: RerenderedRows | None = None

    @property
    def reported(self) -> set[str]:
        """Files that need not be reported again."""
        return {*self.missing, *files_of(self.findings)}

    @property
    def all_content(self) -> Content:
        """The last two frames, and the twins of what was read last."""
        return with_twins(self.content, self.twins)

    def open(self) -> None:
        """Read sequence.json, after the files of the sequence were looked for.

        Raises:
            RsbenchError: it cannot be read.
        """
        below = f"{self.name}/"
        self.missing = {each.file.removeprefix(below) for each in self.findings if each.words == MISSING}
        self.sequence = read_sequence(self.listing.folder / self.name)
        self.other_images = images_of_others(self.sequence, self._other_sequences)

    def _other_sequences(self) -> Iterator[Sequence]:
        """Some sequences of the dataset, the nearest in the list first."""
        names = self.listing.names
        place = names.index(self.name)
        around = range(max(place - _MOST_ELSEWHERE, 0), min(place + _MOST_ELSEWHERE + 1, len(names)))
        near = sorted(around, key=lambda other: abs(other - place))[1 : _MOST_ELSEWHERE + 1]
        for other in near:
            with contextlib.suppress(RsbenchError):
                yield read_sequence(self.listing.folder / names[other])


def picture_faults(state: State) -> Iterator[Finding]:
    """What depth maps and images of two successive frames show that the others contradict."""
    content, again = state.content, state.again
    comparison = Comparison(content, state.stride)
    for agreement in comparison.pairs():
        if agreement is not None:
            state.agreements.setdefault((agreement.source, agreement.target), agreement)
        state.step(state.sequence.name)
    judges = (
        ()
        if again is None
        else (partial(again.depth_is_rendered, content), partial(again.image_is_rendered, content))
    )
    geometry = comparison.geometry()
    if geometry is None:
        yield from comparison.faults(state.other_images, *judges)
    else:
        state.disagreeing[content.times[0], content.times[-1]] = geometry
    state.notes += comparison.notes


def geometry_faults(state: State) -> Iterator[Finding]:
    """What the frames that do not agree show of sequence.json, or of one of them."""
    if not state.disagreeing:
        return
    first = min(state.disagreeing.values(), key=lambda each: (each.over_time, each.share))
    count = state.sequence.frames - 1
    if count > 1 and first.over_time and (found := frames_of_other_times(state.sequence, state.disagreeing)):
        yield from found
        return
    where = "" if count == 1 else f", in {len(state.disagreeing)} of {count} pairs of frames"
    yield Finding("sequence.json", first.what + where, cause=first.cause)


Stage = Literal["dataset", "files", "sequence", "masks", "frames", "channels", "matcher", "rays"]
"""When a check runs: once for a dataset ("dataset") or a sequence ("files", before it is opened, and "sequence"),
or for each two successive frames. "masks" may change the masks of what was just read; what "channels" find is
dropped where rays make the file again bit for bit; "rays" come last."""
Run = Callable[[State], Iterable[Finding]]
START, END = "<!-- The table of rsbench/verification/checks.py -->\n", "<!-- End of the table -->\n"


@dataclass(frozen=True, kw_only=True)
class Check:
    """One row of the table."""

    name: str
    stage: Stage
    reads: str
    finds: str
    costs: str
    run: Run
    at_end: Run | None = None
    """What it finds when all frames were seen."""

    def found(self, findings: Iterable[Finding]) -> Iterator[Finding]:
        """Findings that say which check found them."""
        return (replace(each, check=self.name) for each in findings)


def _masks_by_rays(state: State) -> list[Finding]:
    """Replaces the masks by those that rays meet, where the scene can be built."""
    known = [known_gloss(each, state.again) for each in (state.fresh, state.twins)]
    state.masks_by_rays = all(derived for _, derived in known)
    return [each for findings, _ in known for each in findings]


def _masks(state: State) -> Iterable[Finding]:
    return () if state.masks_by_rays else gloss_faults(state.content, state.fresh, state.twins)


def _twins(state: State) -> list[Finding]:
    return [*state.twins.faults, *other_twin_faults(state.fresh, state.twins, state.stride)]


def _matcher(state: State) -> list[Finding]:
    findings, notes = matched_again(state.sequence, state.reported, state.content.times[0])
    state.notes += notes
    return findings


def _render_rows(state: State) -> tuple[Finding, ...]:
    if state.rerendered is not None:
        state.rerendered.add(with_twins(state.fresh, state.twins), state.reported)
    return ()


def _rendered_rows(state: State) -> list[Finding]:
    if state.rerendered is None:
        return []
    findings, note = state.rerendered.end(state.reported)
    state.notes.append(note)
    return findings


CHECKS = (
    Check(
        name="dataset",
        stage="dataset",
        reads="`dataset.json`, names of the files on disk",
        finds="keys and sequences that differ from the card, other units, duplicate names or names that "
        "are paths, listed files that belong to no sequence, and files on disk that are not listed (names "
        "that begin with a dot are ignored)",
        costs="one listing of the folder",
        run=lambda state: dataset_faults(state.listing),
    ),
    Check(
        name="files",
        stage="files",
        reads="every file of the sequence, `files` of `dataset.json` and `sequence.json`",
        finds="files that are missing, listed in one manifest alone, or have another size or SHA-256",
        costs="every file is read once",
        run=lambda state: file_faults(state.listing, state.name),
    ),
    Check(
        name="manifest",
        stage="sequence",
        reads="`sequence.json`, the card in `dataset.json`",
        finds="cameras, baseline, shutter, motion, seed, viewpoint and times that differ from the card, "
        "the folder or the rest of the file; a `right_from_left` that is no rotation, contradicts "
        "`rotation_from_body` or puts the right camera on the left; renderer options, if this version wrote "
        "the file",
        costs="almost nothing",
        run=lambda state: sequence_faults(state.sequence, state.name, state.listing),
    ),
    Check(
        name="poses",
        stage="sequence",
        reads="`poses/*.csv`",
        finds="poses that differ from the motion at the row times by more than 1e-12; quaternions that "
        "are not of length 1 or have w < 0; missing rows, values that are not numbers",
        costs="one pose per row",
        run=lambda state: pose_faults(state.sequence),
    ),
    Check(
        name="timing",
        stage="sequence",
        reads="channel `timing`, `poses/*.csv`",
        finds="times that differ by more than 1 ns from `sequence.json` or from those of the poses",
        costs="one time per row",
        run=lambda state: timing_faults(state.sequence, state.reported),
    ),
    Check(
        name="imu",
        stage="sequence",
        reads="channel `imu`",
        finds="rates and forces that contradict motion, gravity and times; noise or steps of the bias "
        "that exceed 6 sigma of the stated densities, or are not white",
        costs="one pose per sample",
        run=lambda state: imu_faults(state.sequence, state.reported),
    ),
    Check(
        name="gloss masks by rays",
        stage="masks",
        reads="masks of [glossy surfaces](../reference/dataset-format.md#glossy-surfaces)",
        finds="masks that differ at any pixel from those of traced rays, if the scene can be built; the "
        "other checks then use the traced masks",
        costs="one ray per pixel, with `--rerender auto` or `all`",
        run=_masks_by_rays,
    ),
    Check(
        name="gloss masks",
        stage="frames",
        reads="the same masks and depth, if no rays were traced",
        finds="masks where there is no surface, that differ between twins in their shared row, that mark "
        "different surfaces in different images, or that leave less than 5 % of the surfaces to compare. "
        "Colours within a pixel of gloss are checked only by rendering rows again, and blur is not checked "
        "there",
        costs="each map is projected into the others, at 60 000 pixels at most",
        run=_masks,
    ),
    Check(
        name="labels",
        stage="frames",
        reads="labels of [moving objects](../reference/dataset-format.md#objects-that-move), depth",
        finds="labels where there is no surface, that differ between twins in their shared row, or that "
        "other frames contradict. All other checks move a surface with its label; colours of moving objects "
        "and of their shadows are compared only between the cameras at one time",
        costs="each map is projected into the others, at 60 000 pixels at most",
        run=lambda state: label_faults(state.content, state.fresh, state.twins),
    ),
    Check(
        name="images and depth maps",
        stage="frames",
        reads="images by their headers, then all pixels; depth maps",
        finds="files that cannot be read, images that are not 8-bit RGB of their camera's size",
        costs="every image is read once",
        run=lambda state: state.fresh.faults,
    ),
    Check(
        name="first row",
        stage="frames",
        reads="images and depth of a frame and its global-shutter twin",
        finds="a first row that is not identical in both; if columns are read, a first column that "
        "differs by more than 1 code or 1e-6 of the depth on more than 5 % of its pixels, because rays are "
        "rounded in groups",
        costs="almost nothing",
        run=lambda state: twin_faults(state.fresh),
    ),
    Check(
        name="stacks",
        stage="frames",
        reads="channel `gs_stack`",
        finds="images whose row y is not identical to row y of the clean rolling-shutter frame, or whose "
        "first image is not the global-shutter twin",
        costs="every `--stride`-th image is read",
        run=lambda state: stack_faults(state.fresh, state.missing, state.stride),
    ),
    Check(
        name="sensor",
        stage="frames",
        reads="`rs/*.png` of a `[sensor]`, their clean twins; `gs_exposed/*.png` beside `gs/*.png`",
        finds="blur and noise that the sensor cannot have made from the clean twin, which replaces the "
        "frame in all other checks; with a `mosaic`, values that are neither read nor the mean of neighbours "
        "of that colour; with `jpeg_quality`, blocks whose coefficients are not multiples of that quality's "
        "steps",
        costs="filters over the whole frame",
        run=lambda state: sensor_faults(with_twins(state.fresh, state.twins), state.missing),
    ),
    Check(
        name="depth and colours",
        stage="frames",
        reads="depth maps and images of each two successive frames, eight of each",
        finds="surfaces that the twin, the other camera or the other time see elsewhere (each with its "
        "own axes, lens and readout); under diffuse light, colours that differ between them, including the "
        "sky; in sequences of [many frames](../reference/dataset-format.md#many-frames), frames of another "
        "time, with the time that fits",
        costs="every pixel is projected into three other images, N squared times fewer with `--stride N`",
        run=picture_faults,
        at_end=geometry_faults,
    ),
    Check(
        name="twins",
        stage="frames",
        reads="channel `gs_twin`",
        finds="a twin whose own row is not identical to that row of the rolling-shutter frame, or whose "
        "surfaces differ from those of the frame",
        costs="each twin is projected into its frame",
        run=_twins,
    ),
    Check(
        name="flow, disparity and masks",
        stage="channels",
        reads="channels between two images, depth",
        finds="values that differ from those of depth and motion by more than 1.5e-3 px on more than 0.1 "
        "% of the pixels; wrong masks of sky and view; wrong visible or hidden pixels, where the target is "
        "one flat surface",
        costs="every pixel is projected once per channel, N squared times fewer with `--stride N`",
        run=lambda state: channel_faults(state.all_content, state.reported, state.fresh.times, state.stride),
    ),
    Check(
        name="tracks",
        stage="channels",
        reads="channel `tracks`, depth",
        finds="points that are not on the depth map at the drawn pixels, places and times that contradict"
        " the row equation, and points whose visibility contradicts the depths around them",
        costs="the row equation of every point in every view",
        run=lambda state: track_faults(state.fresh, state.reported),
    ),
    Check(
        name="affine",
        stage="channels",
        reads="channels `affine` and `tracks`, depth",
        finds="derivatives that differ by more than 1e-6 from those of normals, tracks and row times, and"
        " normals that are not perpendicular to the surface of the depth map",
        costs="one derivative per point and view",
        run=lambda state: affine_faults(state.fresh, state.reported),
    ),
    Check(
        name="normals and instances",
        stage="channels",
        reads="channels `normals` and `instances`, depth",
        finds="normals that are not perpendicular to the surface of the depth map or do not face the "
        "camera; surfaces that have different numbers in different images",
        costs="every image is projected into the others",
        run=lambda state: surface_faults(state.all_content, state.reported, state.fresh.times),
    ),
    Check(
        name="hdr",
        stage="channels",
        reads="channel `hdr`, images",
        finds="linear light that differs from the clean image by more than a code",
        costs="almost nothing",
        run=lambda state: hdr_faults(state.fresh, state.reported),
    ),
    Check(
        name="matches",
        stage="channels",
        reads="channel `matches`, depth",
        finds="keypoints whose depth differs from that of the pixels around, true places that contradict "
        "the row equation, and errors, classes and labels that contradict these places and the depths around",
        costs="the row equation of every match",
        run=lambda state: match_faults(state.all_content, state.reported),
    ),
    Check(
        name="matcher",
        stage="matcher",
        reads="channel `matches`, images",
        finds="matches that the stated matcher does not find in the images, if it is one of rsbench and "
        "the versions are the same",
        costs="features of four images per two frames",
        run=_matcher,
    ),
    Check(
        name="rows rendered again",
        stage="rays",
        reads="all images, depth maps, labels and channels, the card of the scene",
        finds="rows that are not identical when rendered again (on other machines, versions or variants: "
        "up to rounding): with the noise of the sensor, for a stack at the poses of other rows, and the "
        "channels by rays",
        costs="16 rows of each image with `--rerender auto`, all with `all`, and the scene is built once",
        run=_render_rows,
        at_end=_rendered_rows,
    ),
)


def table() -> str:
    """The checks as a table in Markdown, in the order in which they run."""
    rows = [(each.name, each.reads, each.finds, each.costs) for each in CHECKS]
    head = [("check", "reads", "finds", "costs"), ("---",) * 4]
    return "".join(f"| {' | '.join(row)} |\n" for row in (*head, *rows))


def with_table(text: str) -> str:
    """A document with the table between ``START`` and ``END``."""
    before, _, rest = text.partition(START)
    return f"{before}{START}\n{table()}\n{END}{rest.partition(END)[2]}"


STEPS = len(VIEW_PAIRS)
"""Progress reports for two successive frames."""


def run_stage(state: State, stage: Stage) -> None:
    """Run the checks of one stage; each knows what those before it found."""
    for check in CHECKS:
        if check.stage == stage:
            state.findings += check.found(check.run(state))


def check_sequence(state: State) -> None:
    """Run all checks of one sequence.

    Raises:
        RsbenchError: a file without which nothing can be checked any further cannot be read.
    """
    run_stage(state, "files")
    state.open()
    run_stage(state, "sequence")
    state.rerendered = None if state.again is None else RerenderedRows(state.again, state.sequence)
    state.content = Content(state.sequence)
    for times in pairwise(range(state.sequence.frames)):
        state.fresh = read_content(state.sequence, state.missing, times if times[0] == 0 else times[1:])
        state.twins = read_twins(state.sequence, state.missing, state.fresh.times)
        run_stage(state, "masks")
        state.content = state.content.followed_by(state.fresh, state.reported)
        run_stage(state, "frames")
        _check_channels(state)
        run_stage(state, "rays")
    for check in CHECKS:
        if check.at_end is not None:
            state.findings += check.found(check.at_end(state))


def _check_channels(state: State) -> None:
    """Run the checks of channels; drop what they found in files that rays make again bit for bit, with a note.

    Rays say nothing of what the pictures do not show, and so clear no file of what the matcher says.
    """
    first = len(state.findings)
    run_stage(state, "channels")
    last = len(state.findings)
    run_stage(state, "matcher")
    accused = state.findings[first:last]
    if state.again is None or not accused:
        return
    cleared = state.again.cleared(state.all_content, files_of(accused))
    what = "others contradict it, but it equals a new computation"
    state.notes += sorted(str(Finding(file, what)) for file in cleared)
    state.findings[first:last] = [each for each in accused if each.file not in cleared]
