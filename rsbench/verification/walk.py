"""The checks of a sequence run in the order of their table, over two successive frames at a time."""

from __future__ import annotations

from itertools import pairwise

from rsbench.dataset.views import VIEW_PAIRS
from rsbench.verification.checks import CHECKS, Stage
from rsbench.verification.content import Content, read_content
from rsbench.verification.findings import Finding, files_of
from rsbench.verification.rerender import RerenderedRows
from rsbench.verification.state import State
from rsbench.verification.twin_checks import read_twins

STEPS = len(VIEW_PAIRS)
"""Of progress, for two successive frames."""


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
    what = "others contradict it, and it is what is made again, all of it"
    state.notes += sorted(str(Finding(file, what)) for file in cleared)
    state.findings[first:last] = [each for each in accused if each.file not in cleared]
