"""The checks of ``rsbench verify``: a table with a row and a function for each, and their run over a sequence."""

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
"""Number of other sequences in which the original of an exchanged image is searched."""


@dataclass(eq=False)
class State:
    """One sequence during verification, the input of each check.

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
    """Frames whose depth maps disagree although no single map is wrong."""
    missing: Collection[str] = ()
    """Files that a manifest lists but that are missing."""
    sequence: Sequence = field(init=False)
    """Available from the stage "sequence" on, like ``other_images``."""
    other_images: OtherImages = field(init=False)
    """Images with which its own may have been exchanged."""
    fresh: Content = field(init=False)
    """The frames that were read last: first two together, then one by one. Available from stage "masks" on."""
    twins: Content = field(init=False)
    """Their global-shutter twins at other rows than the first."""
    content: Content = field(init=False)
    """The last two frames, without files that earlier checks found wrong. Available from the stage "frames" on."""
    masks_by_rays: bool = False
    """Whether the masks of ``fresh`` and ``twins`` come from traced rays, not from files."""
    rerendered: RerenderedRows | None = None

    @property
    def reported(self) -> set[str]:
        """Files that need not be reported again."""
        return {*self.missing, *files_of(self.findings)}

    @property
    def all_content(self) -> Content:
        """The last two frames, and the twins of ``fresh``."""
        return with_twins(self.content, self.twins)

    def open(self) -> None:
        """Read sequence.json, after the check that the files exist.

        Raises:
            RsbenchError: it cannot be read.
        """
        below = f"{self.name}/"
        self.missing = {each.file.removeprefix(below) for each in self.findings if each.words == MISSING}
        self.sequence = read_sequence(self.listing.folder / self.name)
        self.other_images = images_of_others(self.sequence, self._other_sequences)

    def _other_sequences(self) -> Iterator[Sequence]:
        """Some other sequences of the dataset, the nearest in the list first."""
        names = self.listing.names
        place = names.index(self.name)
        around = range(max(place - _MOST_ELSEWHERE, 0), min(place + _MOST_ELSEWHERE + 1, len(names)))
        near = sorted(around, key=lambda other: abs(other - place))[1 : _MOST_ELSEWHERE + 1]
        for other in near:
            with contextlib.suppress(RsbenchError):
                yield read_sequence(self.listing.folder / names[other])


def picture_faults(state: State) -> Iterator[Finding]:
    """Find depth maps and images of two successive frames that the others contradict."""
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
    """Find faults of sequence.json, or of single frames, from the frames that disagree."""
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
or for each two successive frames. "masks" may change the masks of the frames just read; findings of "channels" are
dropped if traced rays reproduce the file bit for bit; "rays" come last."""
Run = Callable[[State], Iterable[Finding]]


@dataclass(frozen=True)
class Check:
    """One check; docs/explanation/verification.md lists what it reads, finds and costs."""

    name: str
    stage: Stage
    run: Run
    at_end: Run | None = None
    """Further findings after all frames."""

    def found(self, findings: Iterable[Finding]) -> Iterator[Finding]:
        """Return the findings with the name of the check."""
        return (replace(each, check=self.name) for each in findings)


def _masks_by_rays(state: State) -> list[Finding]:
    """Replace the masks by those of traced rays, if the scene can be built."""
    known = [known_gloss(each, state.again) for each in (state.fresh, state.twins)]
    state.masks_by_rays = all(derived for _, derived in known)
    return [each for findings, _ in known for each in findings]


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
    Check("dataset", "dataset", lambda state: dataset_faults(state.listing)),
    Check("files", "files", lambda state: file_faults(state.listing, state.name)),
    Check("manifest", "sequence", lambda state: sequence_faults(state.sequence, state.name, state.listing)),
    Check("poses", "sequence", lambda state: pose_faults(state.sequence)),
    Check("timing", "sequence", lambda state: timing_faults(state.sequence, state.reported)),
    Check("imu", "sequence", lambda state: imu_faults(state.sequence, state.reported)),
    Check("gloss masks by rays", "masks", _masks_by_rays),
    Check(
        "gloss masks",
        "frames",
        lambda s: () if s.masks_by_rays else gloss_faults(s.content, s.fresh, s.twins),
    ),
    Check("labels", "frames", lambda state: label_faults(state.content, state.fresh, state.twins)),
    Check("images and depth maps", "frames", lambda state: state.fresh.faults),
    Check("first row", "frames", lambda state: twin_faults(state.fresh)),
    Check("stacks", "frames", lambda state: stack_faults(state.fresh, state.missing, state.stride)),
    Check("sensor", "frames", lambda state: sensor_faults(with_twins(state.fresh, state.twins), state.missing)),
    Check("depth and colours", "frames", picture_faults, at_end=geometry_faults),
    Check("twins", "frames", lambda s: [*s.twins.faults, *other_twin_faults(s.fresh, s.twins, s.stride)]),
    Check(
        "flow, disparity and masks",
        "channels",
        lambda state: channel_faults(state.all_content, state.reported, state.fresh.times, state.stride),
    ),
    Check("tracks", "channels", lambda state: track_faults(state.fresh, state.reported)),
    Check("affine", "channels", lambda state: affine_faults(state.fresh, state.reported)),
    Check(
        "normals and instances",
        "channels",
        lambda state: surface_faults(state.all_content, state.reported, state.fresh.times),
    ),
    Check("hdr", "channels", lambda state: hdr_faults(state.fresh, state.reported)),
    Check("matches", "channels", lambda state: match_faults(state.all_content, state.reported)),
    Check("matcher", "matcher", _matcher),
    Check("rows rendered again", "rays", _render_rows, at_end=_rendered_rows),
)


STEPS = len(VIEW_PAIRS)
"""Progress reports for two successive frames."""


def run_stage(state: State, stage: Stage) -> None:
    """Run the checks of one stage; each can use the findings of earlier ones."""
    for check in CHECKS:
        if check.stage == stage:
            state.findings += check.found(check.run(state))


def check_sequence(state: State) -> None:
    """Run all checks of one sequence.

    Raises:
        RsbenchError: a file that all further checks need cannot be read.
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
    """Run the checks of channels; drop findings, with a note, in files that traced rays reproduce bit for bit.

    Rays show nothing that is not in the pictures, so they refute no finding of the matcher's check.
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
