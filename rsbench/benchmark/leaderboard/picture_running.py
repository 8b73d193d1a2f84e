"""Running cards of stereo matchers and correctors: predictions first, each problem kept as soon as it is made.

A job is one problem, for all cards whose answer is not current: matchers share the motion, correctors the motion
and the depth. The seconds of an entry are those that it would have taken alone.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rsbench.benchmark.images.store import identity_of, read_record
from rsbench.benchmark.leaderboard.frames import read_frames
from rsbench.benchmark.leaderboard.picture_files import FARTHEST, FOLDER, frame_png
from rsbench.benchmark.leaderboard.protocols import Protocol, protocol_of_id
from rsbench.benchmark.leaderboard.running import Limits, jobs_done, read_inputs
from rsbench.benchmark.leaderboard.splits import Split, Truth
from rsbench.benchmark.leaderboard.submissions import submission_text
from rsbench.benchmark.leaderboard.true_pictures import VIEW, Asked
from rsbench.benchmark.provenance import numeric_version, processor
from rsbench.components.plugins import Entry
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES
from rsbench.jobs.isolation import use_one_thread
from rsbench.jobs.workers import Workers
from rsbench.pipeline.chain import CorrectedFrames, Given, correct_four
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.frame_depth import Images, metres, motion_disparities
from rsbench.pipeline.frame_motion import find_matches_of_rig, match_frames, solve_frames
from rsbench.pipeline.isolated_parts import Isolation
from rsbench.pipeline.problem import Problem
from rsbench.solvers.engine.warm_up import warm_up
from rsbench.storage.files import write_bytes, write_depth, write_json
from rsbench.storage.untrusted_files import check_name, read_json
from rsbench.storage.work_folder import remove
from rsbench.vision.corrector import demand_corrected, load_corrector
from rsbench.vision.fusion import Origin
from rsbench.vision.stereo_matcher import load_matcher, needs_motion
from rsbench.vision.undistortion import sensor_disparities

_OF_PAIR, _OF_ALL = ("images", "stereo"), ("readout", "images", "stereo", "time")
"""What a matcher of two images works on, and one that our motion tells where to look."""


class _Job(NamedTuple):
    problem: str
    asked: tuple[Asked, ...]
    cards: tuple[tuple[str, Path, str], ...]
    """Card, folder of its predictions, identity of the answer."""

    def __str__(self) -> str:
        return f"problem {self.problem}"


def load_chains(cards: Sequence[str], protocol: Protocol) -> dict[str, CorrectionOptions]:
    """The chain that each card runs in: a matcher, or a corrector with our default solver and matcher.

    Raises:
        RsbenchError: no such card, or two of one name.
    """
    chains: dict[str, CorrectionOptions] = {}
    names: dict[str, str] = {}
    for card in dict.fromkeys(cards):
        if protocol.asks == "depth":
            chains[card] = CorrectionOptions(matcher=load_matcher(card))
        else:
            chains[card] = CorrectionOptions(corrector=load_corrector(card))
        name = _name(chains[card], protocol)
        try:
            check_name(name)
        except ValueError as error:
            raise RsbenchError(f"entry {card}: {error}") from error
        if names.setdefault(name, card) != card:
            raise RsbenchError(
                f"--entry {card} and --entry {names[name]}: both have the name {name!r}; rename one"
            )
    return chains


def _name(chain: CorrectionOptions, protocol: Protocol) -> str:
    return _entry(chain, protocol.asks == "depth").name


def _entry(chain: CorrectionOptions, depth: bool) -> Entry[Any, Any]:
    return chain.matcher if depth else chain.corrector


def run_picture_cards(
    cards: Sequence[str],
    split: Split,
    inputs: Path,
    work: Path,
    *,
    workers: Workers = 1,
    limits: Limits = Limits(),  # noqa: B008  it is a constant
    step: Callable[[str], None] = lambda word: None,
) -> list[Path]:
    """Run matchers or correctors on exported inputs; returns for each a file of answers, ready to be submitted.

    Raises:
        RsbenchError: no such card; processes died each time over the same problems: what is done is kept.
    """
    chains = load_chains(cards, split.protocol)
    folders = {card: work / _name(chain, split.protocol) for card, chain in chains.items()}
    jobs: list[_Job] = []
    for truth in split.truths:
        due = tuple(
            (card, folders[card], identity)
            for card, chain in chains.items()
            if _answer(folders[card], truth.name, identity := _identity(chain, split, truth, limits)) is None
        )
        assert truth.pictures is not None
        parts = [due] if limits == Limits() and due else [(each,) for each in due]
        jobs += [_Job(truth.name, truth.pictures.asked, part) for part in parts]
        if not due:
            step(truth.name)
    left, depth = Counter(job.problem for job in jobs), split.protocol.asks == "depth"

    def limited(job: _Job) -> bool:
        """Those of others are limited in processes of their own, whose start takes a while."""
        return all(_entry(chains[card], depth).built_in for card, _, _ in job.cards)

    for job in jobs_done(_serve, jobs, workers, inputs, limits, _fail, limited):
        left[job.problem] -= 1
        if left[job.problem] == 0:
            step(job.problem)
    return [_joined(chain, split, folders[card], limits) for card, chain in chains.items()]


def _fail(job: _Job, reason: str) -> None:
    """Keep that nothing was answered within the limits."""
    for _, folder, identity in job.cards:
        remove(folder / FOLDER / job.problem)
        _keep(folder, job.problem, identity, {"success": False, "reason": reason})


def _keep(folder: Path, problem: str, identity: str, answer: dict[str, Any]) -> None:
    path = folder / "answers" / f"{problem}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"identity": identity, "answer": {"name": problem, **answer}})


def _identity(chain: CorrectionOptions, split: Split, truth: Truth, limits: Limits) -> str:
    """Of one answer: whatever decides it, and nothing of the other problems."""
    assert truth.pictures is not None
    return identity_of(
        source=numeric_version(),
        chain=chain.matcher.key if split.protocol.asks == "depth" else chain.key,
        protocol=split.protocol.id,
        split=split.fingerprint,
        problem=truth.name,
        limits=list(limits),
    )


def _answer(folder: Path, problem: str, identity: str) -> dict[str, Any] | None:
    """What was answered, when it is current."""
    record = read_record(folder / "answers" / f"{problem}.json")
    if record is None or record.get("identity") != identity or not isinstance(record.get("answer"), dict):
        return None
    answer: dict[str, Any] = record["answer"]
    return answer


def _joined(chain: CorrectionOptions, split: Split, folder: Path, limits: Limits) -> Path:
    """The answers of a card as one submission."""
    depth = split.protocol.asks == "depth"
    entry = _entry(chain, depth)
    reference = "" if depth else chain.corrector.component.spec.reference
    header: dict[str, Any] = {
        "protocol": split.protocol.id,
        "split": split.name,
        "method": entry.name,
        "uses": _uses(chain, depth),
        "description": entry.description[:300],
        "paper": reference[:300],
        "code": "rsbench" if entry.built_in else "",
        "hardware": f"{processor()}, 1 thread"[:300],
    }
    found = (_answer(folder, truth.name, _identity(chain, split, truth, limits)) for truth in split.truths)
    path = folder / "predictions.jsonl"
    write_bytes(path, submission_text(header, (each for each in found if each is not None)).encode())
    return path


def _uses(chain: CorrectionOptions, depth: bool) -> list[str]:
    if depth:
        return list(_OF_ALL if needs_motion(chain.matcher) else _OF_PAIR)
    return ["readout", "images", *sorted(chain.corrector.component.spec.sees)]


# In the child


def _serve(inputs: Path, limits: Limits) -> Callable[[_Job], None]:
    use_one_thread()
    warm_up()
    protocol = protocol_of_id(str(read_json(inputs / "split.json").get("protocol")))
    problems = {problem.name: problem for problem in read_inputs(inputs, protocol)}
    isolation = Isolation(time_limit_s=limits.seconds, memory_mb=limits.memory_mb)
    chains = dict[str, CorrectionOptions]()  # as long as this process

    def run(job: _Job) -> None:
        problem = problems[job.problem]
        made = _Made(problem, read_frames(inputs, problem), job.asked)
        for card, folder, identity in job.cards:
            if card not in chains:
                chains[card] = isolation.chain(load_chains([card], protocol)[card])
            place = folder / FOLDER / job.problem
            remove(folder / "answers" / f"{job.problem}.json")
            remove(place)
            answer = (made.depth if protocol.asks == "depth" else made.frames)(chains[card], place)
            _keep(folder, job.problem, identity, answer)

    return run


class _Made:
    """The pictures of one problem, and what several entries share."""

    def __init__(self, problem: Problem, images: Images, asked: tuple[Asked, ...]) -> None:
        self.problem, self.images, self.asked = problem, images, asked
        self.given = Given()
        self.spent: dict[str, float] = {}

    def depth(self, chain: CorrectionOptions, place: Path) -> dict[str, Any]:
        """Write the depth map; 0 where it is not known."""
        rig, (side, frame) = self.problem.rig, VIEW
        shared = 0.0
        try:
            if needs_motion(chain.matcher):
                motion = self._motion(chain)
                shared, start = sum(self.spent.values()), time.perf_counter()
                found = motion_disparities(chain.matcher, self.images, rig, self.problem.shutter, motion, (VIEW,))
                depth = metres(found[VIEW], rig)
            else:
                start = time.perf_counter()
                pair = [self.images[each, frame] for each in SIDES]
                disparity = sensor_disparities(chain.matcher, pair[0], pair[1], rig)[SIDES.index(side)]
                depth = np.nan_to_num(rig.depth(disparity), nan=0.0)
        except RsbenchError as error:
            return {"success": False, "reason": str(error)[:300]}
        seconds = shared + time.perf_counter() - start
        place.mkdir(parents=True)
        (each,) = self.asked
        write_depth(place / f"{each.stem}.exr", np.where(depth > FARTHEST, 0.0, depth).astype(np.float32))
        return {"seconds": round(seconds, 4)}

    def _motion(self, chain: CorrectionOptions) -> Motion:
        """That the default solver estimates, the same for all matchers: of frames that are looked at first.

        Raises:
            RsbenchError: see ``match_frames`` and ``solve_frames``.
        """
        rig, shutter, start = self.problem.rig, self.problem.shutter, time.perf_counter()
        if self.given.motion is None:
            matches = match_frames(self.images, rig, chain, shutter.scanning)
            matched = time.perf_counter()
            solved = solve_frames(matches, rig, shutter.readout_ratio, chain, scanning=shutter.scanning)
            assert solved.found is not None
            self.given = Given(motion=solved.found.motion)
            self.spent = {"matching": matched - start, "motion": time.perf_counter() - matched}
        assert self.given.motion is not None
        return self.given.motion

    def frames(self, chain: CorrectionOptions, place: Path) -> dict[str, Any]:
        """Write the corrected frames."""
        needs = chain.corrector.component.spec.needs
        rig, shutter = self.problem.rig, self.problem.shutter
        drawn: dict[str, bytes] = {}
        try:
            if needs & {"motion", "matches"} and self.given.matches is None:
                start = time.perf_counter()
                matches = find_matches_of_rig(self.images, rig, shutter.scanning, chain)
                self.given = replace(self.given, matches=matches)
                self.spent["matching"] = time.perf_counter() - start
            first, *others = (float(each.row) for each in self.asked)
            found = correct_four(
                self.images,
                rig,
                shutter.readout_ratio,
                replace(chain, target_row=first),
                given=self.given,
                views=(VIEW,),
                scanning=shutter.scanning,
                rows=others,
            )
            self._share(found)
            seconds = found.seconds["correction"]
            for each, frames in zip(self.asked, (found.frames, *found.at_rows), strict=True):
                demand_corrected(frames, chain.corrector.name)
                fused = frames[VIEW]
                drawn[each.stem] = frame_png(fused.image, fused.origin != Origin.NOBODY)
        except RsbenchError as error:
            return {"success": False, "reason": str(error)[:300]}
        place.mkdir(parents=True)
        for stem, data in drawn.items():
            write_bytes(place / f"{stem}.png", data)
        steps = {"matching": {"motion", "matches"}, "motion": {"motion"}, "depth": {"depth"}}
        seconds += sum(self.spent.get(step, 0.0) for step, of in steps.items() if needs & of)
        return {"seconds": round(seconds, 4)}

    def _share(self, found: CorrectedFrames) -> None:
        """What need not be found again, and how long it took."""
        if self.given.motion is None and found.motion is not None:
            self.spent["motion"] = found.seconds["motion"]
        if self.given.pairs is None and found.pairs is not None:
            self.spent["depth"] = found.seconds["depth"]
        motion, pairs = found.motion or self.given.motion, found.pairs or self.given.pairs
        self.given = replace(self.given, motion=motion, pairs=pairs)
