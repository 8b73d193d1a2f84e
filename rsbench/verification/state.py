"""What the checks of one sequence share: the frames that were read last, and what has been found so far."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field

from rsbench.core.errors import RsbenchError
from rsbench.dataset.sequence import Sequence, read_sequence
from rsbench.dataset.views import Times
from rsbench.verification.content import Content, OtherImages, images_of_others
from rsbench.verification.depth_checks import GeometryFault
from rsbench.verification.findings import MISSING, DepthAgreement, Finding, Progress, files_of
from rsbench.verification.manifest_checks import Listing
from rsbench.verification.rerender import RerenderedRows, Rerenderer
from rsbench.verification.twin_checks import with_twins

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
    """Builds the scene and renders rows again; None where nobody asked for it."""
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
