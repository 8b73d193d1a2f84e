"""Problems of a split with their ground truth, drawn from a seed or read from a rendered dataset."""

from __future__ import annotations

import contextlib
import hashlib
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.leaderboard.pictures import TruePictures
from rsbench.benchmark.leaderboard.track import PUBLIC_SEED, Inputs, Split, Track, Truth
from rsbench.benchmark.simulated.simulation import OutlierImages, Simulation, simulate
from rsbench.benchmark.simulated.sweep_card import Setting
from rsbench.components.seeds import generator
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError, naming
from rsbench.core.motion import Motion
from rsbench.core.rig import FRAMES, VIEWS, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.dataset.clock_channels import MEASURED, gyro_samples
from rsbench.dataset.layout import picture_file
from rsbench.dataset.sequence import Sequence, read_dataset, read_dataset_manifest, read_pairs
from rsbench.pipeline.frame_capture import find_matches_of_rig
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.problem import Problem
from rsbench.storage.untrusted_files import check_name, read_text
from rsbench.vision.feature_matcher import load_features

Range = tuple[float, float]
_SHORTEST_SECRET = 16
"""Minimum number of characters of a seed file; shorter ones could be found by trying all texts."""
FEATURES = "sift"
"""Feature matcher of the protocols with given matches."""
_GYRO = "imu"
"""The channel with the samples of a gyroscope."""
_AROUND = 1.0
"""Time, frame periods, before the first and after the last frame for which gyroscope samples are given."""
FEWEST_FRAMES, MOST_FRAMES = 4, 250
"""Fewest and most frames of a whole sequence."""


# Simulated points


def _no_kinds(seed: int, number: int) -> dict[str, float | str]:
    """Return no properties; a named function can be passed to other processes, a lambda cannot."""
    return {}


@dataclass(frozen=True, kw_only=True)
class Draws:
    """Generator of the problems of a protocol, from a seed and the number of a problem."""

    scope: tuple[str, ...]
    """Names from which random generators are seeded, so that protocols have independent draws."""
    problems: int
    setting: Callable[[int, int], Setting]
    """Function that returns the setting of a problem, from the seed and the number."""
    outlier_images: OutlierImages
    kinds: Callable[[int, int], dict[str, float | str]] = _no_kinds
    """Function that returns properties, in addition to sizes, against which scores are plotted."""
    moved: Callable[[int, int], Motion] | None = None
    """Function that returns the motion of a problem; None: the motion model of the setting is used."""

    def rng(self, seed: int, what: str, number: int) -> np.random.Generator:
        return generator(seed, *self.scope, what, number)

    def motion(self, seed: int, number: int) -> Motion:
        """Return the motion of a problem."""
        return _motion(self, seed, number)


@lru_cache(maxsize=512)  # a spline takes a tenth of a second
def _motion(draws: Draws, seed: int, number: int) -> Motion:
    if draws.moved is not None:
        return draws.moved(seed, number)
    return draws.setting(seed, number).motion(draws.rng(seed, "motion", number))


def log_uniform(rng: np.random.Generator, sizes: Range) -> float:
    return float(np.exp(rng.uniform(*np.log(sizes))))


def points_setting(seed: int, number: int) -> Setting:
    """Return a setting of points-1: all sizes are drawn from fixed ranges; the camera is the paper's."""
    rng = generator(seed, "leaderboard", "setting", number)
    return Setting(
        width=900,
        height=900,
        focal=810.0,
        depth=(2.0, 10.0),
        rotation_deg=log_uniform(rng, (0.2, 8.0)),
        translation=log_uniform(rng, (0.05, 0.5)),
        **circumstances(rng, (0.1, 0.6), (0.1, 1.0)),
    )


def circumstances(rng: np.random.Generator, baseline: Range, readout: Range) -> dict[str, Any]:
    """Draw the values that all protocols share; they are drawn last, in this order."""
    return {
        "baseline": log_uniform(rng, baseline),
        "noise_px": log_uniform(rng, (0.05, 1.0)),
        "readout_ratio": float(rng.uniform(*readout)),
        "points": int(rng.integers(40, 201)),
        "outlier_ratio": float(rng.choice([0.0, 0.1, 0.3, 0.5])),
        "shape": "plane" if rng.random() < 0.2 else "box",
    }


POINTS_1 = Draws(scope=("leaderboard",), problems=250, setting=points_setting, outlier_images="frame 1")


@dataclass(frozen=True)
class RigKind:
    """Ranges of a type of rig in points-2; docs/reference/protocols.md has the sources."""

    width: int
    height: int
    focal: float
    baseline: Range
    depth: Range
    rotation_deg: Range
    """Rotation per frame period, degrees."""
    translation: Range
    """Translation per frame period, metres."""
    shake: str
    """Preset of the spline motion."""
    drives: bool = False
    """Whether the rig translates forward and rotates about the vertical axis, both within a few degrees."""


KINDS = {
    "phone": RigKind(1280, 720, 925.0, (0.01, 0.02), (0.5, 8.0), (0.05, 3.0), (0.003, 0.05), "handheld"),
    "headset": RigKind(640, 480, 370.0, (0.06, 0.14), (0.5, 8.0), (0.1, 6.0), (0.003, 0.05), "steady"),
    "car": RigKind(1242, 375, 721.0, (0.12, 0.54), (4.0, 40.0), (0.02, 1.0), (0.1, 0.9), "driving", True),
    "drone": RigKind(752, 480, 458.0, (0.06, 0.2), (2.0, 20.0), (0.2, 8.0), (0.02, 0.5), "drone"),
}
MODELS_DRAWN = ("linear", "twist", "inertial", "accelerated", "spline")
"""Motion models, each for a fifth of the problems of each type of rig."""
_READOUT: Range = (0.1, 0.95)
_CELLS = tuple((kind, model) for kind in KINDS for model in MODELS_DRAWN)
_OF_A_CELL = 12
_ACCELERATION = 0.4
"""Bound of the parameter k of ``accelerated``, which is uniform in [-bound, bound]."""
_SLANT = 0.1
"""Standard deviation of the noise on each component of a car's unit direction and rotation axis."""
_SCOPE = ("leaderboard", "points-2")


@lru_cache(maxsize=8)
def _order(seed: int) -> NDArray[Any]:
    """Return, for each problem, an index into ``_CELLS``, shuffled so that names of problems do not reveal it."""
    return generator(seed, *_SCOPE, "order").permutation(len(_CELLS) * _OF_A_CELL) % len(_CELLS)


def _cell(seed: int, number: int) -> tuple[str, str]:
    return _CELLS[int(_order(seed)[number])]


@lru_cache(maxsize=512)
def setting_by_kind(seed: int, number: int) -> Setting:
    """Return a setting of points-2; each type of rig with each motion model has equally many problems."""
    name, model = _cell(seed, number)
    kind, rng = KINDS[name], generator(seed, *_SCOPE, "setting", number)
    ahead = np.array([0.0, 0.0, 1.0]) + _SLANT * rng.standard_normal(3)
    about = np.array([0.0, float(rng.choice([-1.0, 1.0])), 0.0]) + _SLANT * rng.standard_normal(3)
    k = float(rng.uniform(-_ACCELERATION, _ACCELERATION))
    parameters: dict[str, dict[str, Any]] = {"accelerated": {"acceleration": k}, "spline": {"preset": kind.shake}}
    return Setting(
        width=kind.width,
        height=kind.height,
        focal=kind.focal,
        depth=kind.depth,
        rotation_deg=log_uniform(rng, kind.rotation_deg),
        translation=log_uniform(rng, kind.translation),
        rotation_axis=tuple(about.tolist()) if kind.drives else None,
        translation_axis=tuple(ahead.tolist()) if kind.drives else None,
        motion_model=model,
        motion_parameters=parameters.get(model, {}),
        **circumstances(rng, kind.baseline, _READOUT),
    )


def _kinds(seed: int, number: int) -> dict[str, float | str]:
    kind, model = _cell(seed, number)
    return {"motion": model, "rig": kind}


POINTS_2 = Draws(
    scope=_SCOPE,
    problems=len(_CELLS) * _OF_A_CELL,
    setting=setting_by_kind,
    outlier_images="all",
    kinds=_kinds,
)


class DrawnPoints(Inputs):
    """Inputs of simulated points: the split ``dev``, or the split ``test`` if the seed is secret."""

    rendered = False

    def split(self, track: Track, data: Path | None, seed_file: Path | None, secret: bool) -> Split:
        draws, seed = self.draws_of(data), seed_of(seed_file)
        if secret and seed_file is None:
            raise RsbenchError(f"--secret: a --seed-file makes the split of {track.name} secret; leave it out")
        label = "dev" if data is None else _checked_name(data.resolve().name, data)
        label = label if seed_file is None else "test"
        truths = tuple(_truth(draws, seed, number) for number in range(draws.problems))
        return Split(track=track, label=label, public=seed_file is None, truths=truths, seed=seed, draws=draws)

    def problems(self, track: Track, data: Path | None, seed_file: Path | None, count: int) -> Iterator[Problem]:
        draws, seed = self.draws_of(data), seed_of(seed_file)
        return (simulated_problem(seed, number, draws) for number in range(count))

    @abstractmethod
    def draws_of(self, data: Path | None) -> Draws:
        """Return the generator of problems for the folder of the option ``--data``.

        Raises:
            RsbenchError: the track takes no folder, or the folder is invalid.
        """


@dataclass(frozen=True)
class SimulatedPoints(DrawnPoints):
    """Simulated points under motion models, determined by a seed alone."""

    draws: Draws

    def draws_of(self, data: Path | None) -> Draws:
        if data is not None:
            raise RsbenchError(f"--data {data}: the problems of points are simulated; leave it out")
        return self.draws


def _truth(draws: Draws, seed: int, number: int) -> Truth:
    setting, motion, name = draws.setting(seed, number), draws.motion(seed, number), _name(number)
    rig, shutter = setting.rig(), setting.shutter()
    facts = {
        **_sizes(motion, rig, shutter),
        "noise_px": setting.noise_px,
        "outliers": setting.outlier_ratio,
        "points": setting.points,
        "shape": setting.shape,
        **draws.kinds(seed, number),
    }
    return Truth(name=name, rig=rig, shutter=shutter, motion=motion, scene=name, facts=facts)


def seed_of(path: Path | None) -> int:
    """Compute the seed from the text of a file; without a file, return the seed of the public split.

    Raises:
        RsbenchError: the file cannot be read, or its text is too short to be a secret.
    """
    if path is None:
        return PUBLIC_SEED
    text = read_text(path, 4096).strip()
    if len(text) < _SHORTEST_SECRET:
        raise RsbenchError(
            f"{path}: holds {len(text)} characters: a secret seed needs {_SHORTEST_SECRET}, drawn at random"
        )
    return int.from_bytes(hashlib.sha256(text.encode()).digest(), "big")


def simulated_problem(seed: int, number: int, draws: Draws = POINTS_1) -> Problem:
    """Simulate the matches of one problem. It has tracks only, from which each method takes its inputs.

    Raises:
        RsbenchError: too few points are in view under the motion; another seed is needed.
    """
    found = _simulated(draws, draws.setting(seed, number), seed, number)
    return Problem(
        name=_name(number), correspondences=found.correspondences, rig=found.rig, known_shutter=found.shutter
    )


@lru_cache(maxsize=512)  # bounds for different inputs use the same problems
def exact_problem(seed: int, number: int, draws: Draws = POINTS_1) -> tuple[Problem, float]:
    """Return a problem with noise-free inliers only, and the standard deviation of its noise, px.

    Raises:
        RsbenchError: see ``simulated_problem``.
    """
    setting = draws.setting(seed, number)
    found = _simulated(draws, setting.exact(), seed, number)
    # Outliers are displaced after the noise is added, with the same random numbers, so they are the same matches.
    inliers = Correspondences(tracks=found.correspondences.tracks[~found.outliers["tracks"]])
    problem = Problem(name=_name(number), correspondences=inliers, rig=found.rig, known_shutter=found.shutter)
    return problem, setting.noise_px


def _simulated(draws: Draws, setting: Setting, seed: int, number: int) -> Simulation:
    options = replace(setting.options(True), pairs=0, outlier_images=draws.outlier_images)
    scene = draws.rng(seed, "scene", number)
    try:
        return simulate(setting.rig(), setting.shutter(), draws.motion(seed, number), options, scene)
    except ValueError as error:
        raise RsbenchError(f"problem {_name(number)}: {error}; choose another seed") from error


def _name(number: int) -> str:
    return f"p{number:03d}"


def _sizes(motion: Motion, rig: StereoRig, shutter: RollingShutter) -> dict[str, float | str]:
    return {
        "rotation_deg": float(np.rad2deg(np.linalg.norm(motion.w))),
        "translation_m": float(np.linalg.norm(motion.d)),
        "readout_ratio": shutter.readout_ratio,
        "baseline_m": rig.baseline,
    }


# Rendered frames


@dataclass(frozen=True)
class Frames(Inputs):
    """Inputs of frame pairs of a dataset: matches, or the frames themselves on tracks that give them."""

    distinct_ratios: bool = False
    """Whether all sequences must have different readout ratios, so that a constant answer scores badly."""
    any_rig: bool = False
    """Whether cameras may have lens distortion and may differ in scan direction and image size."""

    def split(self, track: Track, data: Path | None, seed_file: Path | None, secret: bool) -> Split:
        folder = _dataset_of(track, data, seed_file)
        label, pairs = label_of(folder), self.pairs(track, folder)
        pictures = _true_pictures(folder, pairs, track, self.any_rig) if track.pictures else {}
        truths = tuple(truth_of(sequence, pictures.get(sequence.name)) for sequence in pairs)
        if self.distinct_ratios:
            ratio, count = Counter(truth.shutter.readout_ratio for truth in truths).most_common(1)[0]
            if count > 1:
                raise RsbenchError(
                    f"{data}: {count} sequences have the readout ratio {ratio:g}, which a constant would win by: "
                    f"{track.id} needs one for each, as the card laws draws them (readout_range)"
                )
        return Split(track=track, label=label, public=not secret, truths=truths)

    def problems(self, track: Track, data: Path | None, seed_file: Path | None, count: int) -> Iterator[Problem]:
        assert data is not None
        options = None if track.gives_images else CorrectionOptions(features=load_features(FEATURES))
        for sequence in self.given(track, data)[:count]:
            problem = find_problem(sequence, options)
            yield with_gyro(problem, sequence) if "gyro" in track.allowed else problem

    def given(self, track: Track, folder: Path) -> list[Sequence]:
        """Return the sequences of the problems as they are given to methods."""
        return self.pairs(track, folder)

    def pairs(self, track: Track, folder: Path) -> list[Sequence]:
        """Return the frame pairs that are problems of the track."""
        return read_pairs(folder)


class WholeSequences(Inputs):
    """Inputs of whole sequences of a dataset: windows of two frames with given matches."""

    whole = True

    def split(self, track: Track, data: Path | None, seed_file: Path | None, secret: bool) -> Split:
        folder, truths = _dataset_of(track, data, seed_file), list[Truth]()
        for sequence in read_dataset(folder):
            if not FEWEST_FRAMES <= sequence.frames <= MOST_FRAMES:
                raise RsbenchError(
                    f"{folder}: {sequence.name} has {sequence.frames} frames: the track {track.name!r} takes "
                    f"sequences of {FEWEST_FRAMES} to {MOST_FRAMES}, such as those of the card handheld"
                )
            rates, _ = sequence.motion.velocity(np.linspace(0.0, sequence.frames - 1.0, 20 * sequence.frames))
            turn_deg = float(np.rad2deg(np.sqrt(np.mean(np.sum(rates**2, axis=1)))))
            truth = truth_of(sequence)
            facts = {**truth.facts, "turn_deg": turn_deg, "frames": float(sequence.frames)}
            truths.append(replace(truth, facts=facts))
        return Split(track=track, label=label_of(folder), public=not secret, truths=tuple(truths))

    def problems(self, track: Track, data: Path | None, seed_file: Path | None, count: int) -> Iterator[Problem]:
        """Yield the windows of the first ``count`` sequences; the first window has all gyroscope samples."""
        assert data is not None
        options = CorrectionOptions(features=load_features(FEATURES))
        for sequence in read_dataset(data)[:count]:
            for number, pair in enumerate(sequence.pairs()):
                problem = find_problem(pair, options)
                if number == 0 and _GYRO in sequence.channels:
                    gyro = gyro_samples(sequence.inertial(), sequence.frame_period_s)
                    problem = replace(problem, correspondences=replace(problem.correspondences, gyro=gyro))
                yield problem


def _dataset_of(track: Track, data: Path | None, seed_file: Path | None) -> Path:
    """Return the dataset folder; RsbenchError if ``--data`` is missing or ``--seed-file`` is given."""
    if data is None:
        raise RsbenchError(
            f"--data: the track {track.name!r} needs the folder of a dataset; make one with rsbench generate"
        )
    if seed_file is not None:
        raise RsbenchError(f"--seed-file {seed_file}: a dataset has its own seed; leave it out, and give --secret")
    return data


def label_of(folder: Path) -> str:
    """Return the name of a dataset, which labels its split; RsbenchError if it is invalid or missing."""
    return _checked_name(read_dataset_manifest(folder).name, folder / "dataset.json")


def _checked_name(name: str, where: Path) -> str:
    with naming(where):
        check_name(name)
    return name


def truth_of(sequence: Sequence, pictures: TruePictures | None = None) -> Truth:
    """Return the ground truth of a sequence; on tracks of pictures it includes the true pictures."""
    scene = sequence.manifest.get("scene")
    named = scene.get("name") if isinstance(scene, dict) else None
    facts = {
        **_sizes(sequence.motion, sequence.rig, sequence.shutter),
        "sensor": "ideal" if sequence.sensor is None else "real",
    }
    return Truth(
        name=sequence.name,
        rig=sequence.rig,
        shutter=sequence.shutter,
        motion=sequence.motion,
        scene=str(named or sequence.name),
        facts=facts,
        sequence=sequence,
        pictures=pictures,
    )


def _true_pictures(
    folder: Path, sequences: Iterable[Sequence], track: Track, any_rig: bool
) -> dict[str, TruePictures]:
    """Return the true pictures of each sequence of a dataset, by its name.

    Raises:
        RsbenchError: dataset.json lacks a file, a rig is not supported by the track, or objects move.
    """
    listed = read_dataset_manifest(folder).files
    found = {}
    for sequence in sequences:
        plain = any_rig or (sequence.rig.rectified and sequence.shutter.plain)
        if not plain or sequence.moving:
            raise RsbenchError(
                f"{folder}: {sequence.name}: {track.id} is of cameras without a lens that read rows together "
                "from the top, and of scenes without motion; choose another dataset"
            )
        requested, files = track.requested(sequence), dict[str, str]()
        views = [(side, frame + sequence.first) for side, frame in VIEWS]
        names = [picture_file("rs", *view, depth=depth) for depth in (False, True) for view in views]
        names += [each.file for each in requested]
        names += [MEASURED] if "gyro" in track.allowed and _GYRO in sequence.channels else []
        for name in names:
            if (manifest := listed.get(f"{sequence.whole}/{name}")) is None:
                raise RsbenchError(f"{folder / 'dataset.json'}: lists no {sequence.whole}/{name}")
            files[name] = manifest.sha256
        found[sequence.name] = TruePictures(sequence=sequence, requested=requested, files=files)
    return found


def find_problem(sequence: Sequence, options: CorrectionOptions | None) -> Problem:
    """Return two frames as a problem, with matches by the feature matcher of ``options``.

    Without ``options`` there are no matches, because methods find their own. There are none either if the frames
    have too little texture, and every method then fails.
    """
    matches = Correspondences()
    if options is not None:
        images = {view: sequence.image("rs", *view) for view in VIEWS}
        with contextlib.suppress(RsbenchError):
            matches = find_matches_of_rig(images, sequence.rig, sequence.shutter.scanning, options)
    return Problem(name=sequence.name, correspondences=matches, rig=sequence.rig, known_shutter=sequence.shutter)


def with_gyro(problem: Problem, sequence: Sequence) -> Problem:
    """Add the gyroscope samples around the two frames, if there are any, in frame periods from its first frame."""
    if _GYRO not in sequence.manifest.get("channels", ()):
        return problem
    whole = replace(sequence, channels=(_GYRO,))  # a pair does not list the channels of its sequence
    samples = gyro_samples(whole.inertial(), sequence.frame_period_s) - [sequence.first, 0.0, 0.0, 0.0]
    near = (samples[:, 0] > -_AROUND) & (samples[:, 0] < len(FRAMES) + _AROUND)
    return replace(problem, correspondences=replace(problem.correspondences, gyro=samples[near]))
