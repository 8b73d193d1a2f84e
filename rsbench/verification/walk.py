"""A sequence checked frame after frame: two successive frames at a time, so that long ones take no more memory."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise

from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import PAIRS, Times
from rsbench.verification.affine_checks import affine_faults
from rsbench.verification.channel_checks import channel_faults
from rsbench.verification.content import Comparison, Content, Elsewhere, read_content, twin_faults
from rsbench.verification.depth import GeometryFault
from rsbench.verification.findings import DepthAgreement, Finding, Progress, files_of
from rsbench.verification.gloss_checks import gloss_faults, known_gloss
from rsbench.verification.hdr_checks import hdr_faults
from rsbench.verification.match_checks import match_faults, matched_again
from rsbench.verification.moving_checks import label_faults
from rsbench.verification.rerender import Again, Redone
from rsbench.verification.sensors import sensor_faults
from rsbench.verification.stacks import stack_faults
from rsbench.verification.surface_checks import surface_faults
from rsbench.verification.swapped_frames import misplaced_frames
from rsbench.verification.track_checks import track_faults
from rsbench.verification.twin_checks import other_twin_faults, read_twins, with_twins

STEPS = len(PAIRS)
"""Of two successive frames."""


@dataclass(eq=False)
class Walk:
    """What the frames of a sequence show, gathered on the way."""

    sequence: Sequence
    missing: Collection[str]
    elsewhere: Elsewhere
    """Images that may have been exchanged with its own."""
    stride: int
    again: Again | None
    faults: list[Finding]
    """Those that are told already, to which others come."""
    agreements: dict[tuple[str, str], DepthAgreement] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    apart: dict[Times, GeometryFault] = field(default_factory=dict)
    """Frames whose depth maps do not agree, none by itself."""

    @property
    def told(self) -> set[str]:
        """Files that need not be told of again."""
        return {*self.missing, *files_of(self.faults)}

    def go(self, step: Progress) -> None:
        """Check all of it; ``step`` is called ``STEPS`` times for each two successive frames."""
        content = Content(self.sequence)
        redone = None if self.again is None else Redone(self.again, self.sequence)
        for times in pairwise(range(self.sequence.frames)):
            fresh = read_content(self.sequence, self.missing, times if times[0] == 0 else times[1:])
            twins = read_twins(self.sequence, self.missing, fresh.times)
            known = [known_gloss(each, self.again) for each in (fresh, twins)]
            self.faults += [fault for faults, _ in known for fault in faults]
            content = content.followed_by(fresh, self.told)
            if not all(derived for _, derived in known):
                self.faults += gloss_faults(content, fresh, twins)
            self.faults += label_faults(content, fresh, twins)
            self._of_frames(fresh)
            self._of_pairs(content, step)
            self.faults += [*twins.faults, *other_twin_faults(fresh, twins, self.stride)]
            self._of_channels(with_twins(content, twins), fresh)
            if redone is not None:
                redone.add(with_twins(fresh, twins), self.told)
        self.faults += self._of_geometry()
        if redone is not None:
            other, note = redone.end(self.told)
            self.faults += other
            self.notes.append(note)

    def _of_frames(self, fresh: Content) -> None:
        sequence, missing = self.sequence, self.missing
        self.faults += [*fresh.faults, *twin_faults(fresh)]
        self.faults += stack_faults(fresh, missing, self.stride)
        self.faults += sensor_faults(sequence, fresh.maps, fresh.pictures, missing)

    def _of_pairs(self, content: Content, step: Progress) -> None:
        """All pictures of two successive frames against each other."""
        comparison = Comparison(content, self.stride)
        for agreement in comparison.pairs():
            if agreement is not None:
                self.agreements.setdefault((agreement.source, agreement.target), agreement)
            step(self.sequence.name)
        again = self.again
        judges = () if again is None else (partial(again.is_right, content), partial(again.shows, content))
        geometry = comparison.geometry()
        if geometry is None:
            self.faults += comparison.faults(self.elsewhere, *judges)
        else:
            self.apart[content.times[0], content.times[-1]] = geometry
        self.notes += comparison.notes

    def _of_geometry(self) -> Iterator[Finding]:
        """What the frames that do not agree show of sequence.json, or of one of them."""
        if not self.apart:
            return
        first = min(self.apart.values(), key=lambda each: (each.over_time, each.share))
        count = self.sequence.frames - 1
        if count > 1 and first.over_time and (found := misplaced_frames(self.sequence, self.apart)):
            yield from found
            return
        where = "" if count == 1 else f", in {len(self.apart)} of {count} pairs of frames"
        yield Finding("sequence.json", first.what + where, cause=first.cause)

    def _of_channels(self, content: Content, fresh: Content) -> None:
        """Faults of channels, but for files told already; and notes of the accused that are right, and more.

        Rays say nothing of what the pictures do not show, and so clear nobody of it.
        """
        faults: list[Finding] = []
        for found in self._channel_checks(content, fresh):
            faults += found({*self.told, *files_of(faults)})
        unfound, notes = matched_again(self.sequence, {*self.told, *files_of(faults)}, content.times[0])
        again = self.again
        cleared = again.cleared(content, files_of(faults)) if again is not None and faults else set()
        what = "others contradict it, and it is what is made again, all of it"
        self.notes += sorted([*notes, *(str(Finding(file, what)) for file in cleared)])
        self.faults += [*(fault for fault in faults if fault.file not in cleared), *unfound]

    def _channel_checks(
        self, content: Content, fresh: Content
    ) -> Iterator[Callable[[Collection[str]], Iterator[Finding]]]:
        """Each gives the faults of some channels, but for files that are told already."""
        sequence, new = self.sequence, fresh.times
        yield partial(channel_faults, sequence, content.maps, stride=self.stride, times=content.times, new=new)
        yield partial(track_faults, sequence, fresh.maps, times=new)
        yield partial(affine_faults, sequence, fresh.maps, times=new)
        yield partial(surface_faults, sequence, content.maps, times=content.times, new=new)
        yield partial(hdr_faults, sequence, fresh.pictures)
        yield partial(match_faults, sequence, content.maps, first=content.times[0])
