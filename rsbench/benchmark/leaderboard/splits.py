"""What the simulated problems of a protocol are drawn from: cameras, sizes, laws of motion, outliers."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.leaderboard.pictures import Asked, TruePictures
from rsbench.benchmark.leaderboard.track import PUBLIC_SEED, Split, Track, Truth
from rsbench.benchmark.seeds import generator
from rsbench.benchmark.simulated.simulation import OutlierImages, Simulation, simulate
from rsbench.benchmark.simulated.sweep_card import Setting
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.rig import FRAMES, VIEWS, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.dataset.imu import gyro_samples
from rsbench.dataset.layout import picture_file
from rsbench.dataset.sequence import Sequence, read_dataset_manifest, read_pairs
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.frame_matches import find_matches_of_rig
from rsbench.pipeline.problem import Problem
from rsbench.storage.untrusted_files import check_name, read_text
from rsbench.vision.feature_matcher import load_features

Range = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Draws:
    """The problems of a protocol, by a seed and their numbers."""

    scope: tuple[str, ...]
    """Names of its generators: no two protocols share a draw."""
    problems: int
    setting: Callable[[int, int], Setting]
    """Of a seed and a number."""
    outlier_images: OutlierImages
    kinds: Callable[[int, int], dict[str, float | str]] = lambda seed, number: {}
    """What else scores may be drawn against, beside the sizes."""

    def rng(self, seed: int, what: str, number: int) -> np.random.Generator:
        return generator(seed, *self.scope, what, number)

    def motion(self, seed: int, number: int) -> Motion:
        """Of a problem."""
        return _motion(self, seed, number)


@lru_cache(maxsize=512)  # a shaken one takes a tenth of a second
def _motion(draws: Draws, seed: int, number: int) -> Motion:
    return draws.setting(seed, number).motion(draws.rng(seed, "motion", number))


def _between(rng: np.random.Generator, sizes: Range) -> float:
    """As often in each factor."""
    return float(np.exp(rng.uniform(*np.log(sizes))))


# points-1


def points_setting(seed: int, number: int) -> Setting:
    """Every size at random, chosen by us; the camera is the paper's."""
    rng = generator(seed, "leaderboard", "setting", number)
    return Setting(
        width=900,
        height=900,
        focal=810.0,
        depth=(2.0, 10.0),
        rotation_deg=_between(rng, (0.2, 8.0)),
        translation=_between(rng, (0.05, 0.5)),
        baseline=_between(rng, (0.1, 0.6)),
        noise_px=_between(rng, (0.05, 1.0)),
        readout_ratio=float(rng.uniform(0.1, 1.0)),
        points=int(rng.integers(40, 201)),
        outlier_ratio=float(rng.choice([0.0, 0.1, 0.3, 0.5])),
        shape="plane" if rng.random() < 0.2 else "box",
    )


POINTS_1 = Draws(scope=("leaderboard",), problems=250, setting=points_setting, outlier_images="frame 1")


# points-2


@dataclass(frozen=True, kw_only=True)
class Kind:
    """Sizes of a kind of rig; docs/reference/protocols.md has the sources."""

    width: int
    height: int
    focal: float
    baseline: Range
    depth: Range
    rotation_deg: Range
    """In a frame period."""
    translation: Range
    """Metres in a frame period."""
    readout_ratio: Range
    shake: str
    """Preset of its hand-held motion."""
    drives: bool = False
    """Whether it moves forward and turns about the vertical, but for a few degrees."""


KINDS = {
    "phone": Kind(
        width=1280,
        height=720,
        focal=925.0,
        baseline=(0.01, 0.02),
        depth=(0.5, 8.0),
        rotation_deg=(0.05, 3.0),
        translation=(0.003, 0.05),
        readout_ratio=(0.1, 0.95),
        shake="handheld",
    ),
    "headset": Kind(
        width=640,
        height=480,
        focal=370.0,
        baseline=(0.06, 0.14),
        depth=(0.5, 8.0),
        rotation_deg=(0.1, 6.0),
        translation=(0.003, 0.05),
        readout_ratio=(0.1, 0.95),
        shake="steady",
    ),
    "car": Kind(
        width=1242,
        height=375,
        focal=721.0,
        baseline=(0.12, 0.54),
        depth=(4.0, 40.0),
        rotation_deg=(0.02, 1.0),
        translation=(0.1, 0.9),
        readout_ratio=(0.1, 0.95),
        shake="driving",
        drives=True,
    ),
    "drone": Kind(
        width=752,
        height=480,
        focal=458.0,
        baseline=(0.06, 0.2),
        depth=(2.0, 20.0),
        rotation_deg=(0.2, 8.0),
        translation=(0.02, 0.5),
        readout_ratio=(0.1, 0.95),
        shake="drone",
    ),
}
LAWS = ("linear", "twist", "inertial", "accelerated", "spline")
"""Motion models, each of a fifth of the problems of each kind."""
_CELLS = tuple((kind, law) for kind in KINDS for law in LAWS)
_OF_A_CELL = 12
_ACCELERATION = 0.4
"""k of ``accelerated`` lies evenly within this distance of 0."""
_SLANT = 0.1
"""Standard deviation of what a car's way and axis leave forward and vertical by, in shares of their length."""
_SCOPE = ("leaderboard", "points-2")


@lru_cache(maxsize=8)
def _order(seed: int) -> NDArray[Any]:
    """Which cell each problem is of: no name tells its law."""
    return generator(seed, *_SCOPE, "order").permutation(len(_CELLS) * _OF_A_CELL) % len(_CELLS)


def _cell(seed: int, number: int) -> tuple[str, str]:
    return _CELLS[int(_order(seed)[number])]


@lru_cache(maxsize=512)
def setting_by_kind(seed: int, number: int) -> Setting:
    """Of a kind of rig under a law of motion: as many problems of each pair."""
    name, law = _cell(seed, number)
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
        rotation_deg=_between(rng, kind.rotation_deg),
        translation=_between(rng, kind.translation),
        rotation_axis=tuple(about.tolist()) if kind.drives else None,
        translation_axis=tuple(ahead.tolist()) if kind.drives else None,
        motion_model=law,
        motion_parameters=parameters.get(law, {}),
        baseline=_between(rng, kind.baseline),
        noise_px=_between(rng, (0.05, 1.0)),
        readout_ratio=float(rng.uniform(*kind.readout_ratio)),
        points=int(rng.integers(40, 201)),
        outlier_ratio=float(rng.choice([0.0, 0.1, 0.3, 0.5])),
        shape="plane" if rng.random() < 0.2 else "box",
    )


def _kinds(seed: int, number: int) -> dict[str, float | str]:
    kind, law = _cell(seed, number)
    return {"motion": law, "rig": kind}


POINTS_2 = Draws(
    scope=_SCOPE,
    problems=len(_CELLS) * _OF_A_CELL,
    setting=setting_by_kind,
    outlier_images="all",
    kinds=_kinds,
)


# The problems of a split with their truth: drawn from a seed, or those of a rendered dataset.
#
# A split is known by its name and a fingerprint of its truth. The fingerprint can be announced before a
# competition: whoever is told the seed or is given the dataset afterwards finds the same one.
_SHORTEST_SECRET = 16
"""Characters of a seed file: shorter ones could be tried."""


# Simulated points


def points_split(track: Track, secret: Path | None = None, draws: Draws = POINTS_1) -> Split:
    """The split ``dev``, or with a file that holds a secret seed the split ``test``.

    Raises:
        RsbenchError: the file cannot be read, or its text could be guessed.
    """
    seed = seed_of(secret)
    truths = tuple(_drawn(draws, seed, number) for number in range(draws.problems))
    label = "dev" if secret is None else "test"
    return Split(track=track, label=label, public=secret is None, truths=truths, seed=seed)


def seed_of(path: Path | None) -> int:
    """The seed that the text of a file stands for; without one, that of the public split.

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
    """The matches of one problem: tracks alone, of which a method takes what it uses.

    Raises:
        RsbenchError: the motion leaves too few points in view; another seed is needed.
    """
    found = _simulated(draws, draws.setting(seed, number), seed, number)
    return Problem(
        name=_name(number), correspondences=found.correspondences, rig=found.rig, known_shutter=found.shutter
    )


@lru_cache(maxsize=512)  # bounds of what methods use are of the same problems
def exact_problem(seed: int, number: int, draws: Draws = POINTS_1) -> tuple[Problem, float]:
    """The matches of a problem without noise and without the outliers, and the noise that they get, px.

    Raises:
        RsbenchError: as ``simulated_problem``.
    """
    setting = draws.setting(seed, number)
    found = _simulated(draws, setting.exact(), seed, number)
    # Outliers are displaced after the noise, and the draws are common: without noise the same are.
    right = found.correspondences.tracks[~found.outliers["tracks"]]
    problem = Problem(
        name=_name(number),
        correspondences=Correspondences(tracks=right),
        rig=found.rig,
        known_shutter=found.shutter,
    )
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


def _drawn(draws: Draws, seed: int, number: int) -> Truth:
    setting, motion = draws.setting(seed, number), draws.motion(seed, number)
    facts = {
        **_sizes(motion, setting.rig(), setting.shutter()),
        "noise_px": setting.noise_px,
        "outliers": setting.outlier_ratio,
        "points": setting.points,
        "shape": setting.shape,
        **draws.kinds(seed, number),
    }
    return Truth(
        name=_name(number),
        rig=setting.rig(),
        shutter=setting.shutter(),
        motion=motion,
        scene=_name(number),
        facts=facts,
    )


def _sizes(motion: Motion, rig: StereoRig, shutter: RollingShutter) -> dict[str, float | str]:
    return {
        "rotation_deg": float(np.rad2deg(np.linalg.norm(motion.w))),
        "translation_m": float(np.linalg.norm(motion.d)),
        "readout_ratio": shutter.readout_ratio,
        "baseline_m": rig.baseline,
    }


# Rendered frames


def dataset_split(track: Track, folder: Path, *, public: bool = True) -> Split:
    """The sequences of a dataset.

    Raises:
        RsbenchError: the dataset cannot be read, its name cannot be that of a split, or its cameras are none of
            which the track asks pictures.
    """
    name = label_of(folder)
    pairs = read_pairs(folder)
    pictures = true_pictures(folder, pairs, track) if track.pictures else {}
    truths = tuple(truth_of(sequence, pictures.get(sequence.name)) for sequence in pairs)
    return Split(track=track, label=name, public=public, truths=truths)


def label_of(folder: Path) -> str:
    """Of the split of a dataset: its name. Raises RsbenchError where that can be none, or is not there."""
    name = read_dataset_manifest(folder).name
    try:
        check_name(name)
    except ValueError as error:
        raise RsbenchError(f"{folder / 'dataset.json'}: {error}") from error
    return name


def truth_of(sequence: Sequence, pictures: TruePictures | None = None) -> Truth:
    """Of a sequence, with what is compared where pictures are asked."""
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


# Tracks of rendered frames: what is given of them, matches or the frames themselves.

FEATURES = "sift"
"""Whose matches the protocol pose-1 gives."""


class FrameTrack(Track):
    """A track whose problems are the sequences of a dataset."""

    rendered = True

    def split(self, data: Path | None, seed_file: Path | None = None, secret: bool = False) -> Split:
        return dataset_split(self, self.source(data, seed_file), public=not secret)

    def source(self, data: Path | None, seed_file: Path | None) -> Path:
        """Folder of the dataset. Raises RsbenchError where the options name none, or another source."""
        if data is None:
            raise RsbenchError(
                f"--data: the track {self.name!r} needs the folder of a dataset; make one with rsbench generate"
            )
        if seed_file is not None:
            raise RsbenchError(
                f"--seed-file {seed_file}: a dataset has its own seed; leave it out, and say --secret"
            )
        return data

    def problems(self, data: Path | None, seed_file: Path | None, count: int) -> Iterator[Problem]:
        assert data is not None
        return islice((bare_problems if self.gives_images else matched_problems)(data), count)


def matched_problems(data: Path) -> Iterator[Problem]:
    """Each sequence with its given matches; none where the frames show no texture."""
    options = CorrectionOptions(features=load_features(FEATURES))
    for sequence in read_pairs(data):
        yield matched(sequence, options)


def matched(sequence: Sequence, options: CorrectionOptions) -> Problem:
    """Two frames with their matches."""
    return _problem(sequence, _matches(sequence, options))


def bare_problems(data: Path) -> Iterator[Problem]:
    """Each sequence without matches: its rig and its shutter."""
    for sequence in read_pairs(data):
        yield _problem(sequence, Correspondences())


def _problem(sequence: Sequence, matches: Correspondences) -> Problem:
    return Problem(name=sequence.name, correspondences=matches, rig=sequence.rig, known_shutter=sequence.shutter)


def _matches(sequence: Sequence, options: CorrectionOptions) -> Correspondences:
    images = {view: sequence.image("rs", *view) for view in VIEWS}
    try:
        return find_matches_of_rig(images, sequence.rig, sequence.shutter.scanning, options)
    except RsbenchError:  # frames without texture: an empty problem, which every method fails
        return Correspondences()


# The track of corrected frames for methods that see one camera, beside those of a rig on the same frames.
#
# What a corrector needs is found from the two frames of that camera alone, by dense flow: matches, and a motion
# whose translation has no length. Correctors that need the depth of a rig run in the chain of ``correction``, and
# their entries say that they use the other camera: what it is worth.
GYRO = "imu"
"""The channel that has its samples."""
_BESIDE = 1.0
"""Frame periods before the first frame and after the last one of which samples are given."""


def with_gyro(problem: Problem, sequence: Sequence) -> Problem:
    """With the samples that lie over the frames of a pair, at its own times."""
    if GYRO not in sequence.manifest.get("channels", ()):
        return problem
    whole = replace(sequence, channels=(GYRO,))  # a pair of many frames has no channel of them all
    samples = gyro_samples(whole.inertial(), sequence.frame_period_s) - [sequence.first, 0.0, 0.0, 0.0]
    near = (samples[:, 0] > -_BESIDE) & (samples[:, 0] < len(FRAMES) + _BESIDE)
    return replace(problem, correspondences=replace(problem.correspondences, gyro=samples[near]))


# What pictures of a sequence are asked, and the truth that they are compared with.
#
# Asked is frame 1 of the left camera, the later one, for which a method may look at the frame before. Pictures of
# a split are what its fingerprint is of: a file that has changed since then is refused by name.


def true_pictures(folder: Path, sequences: Iterable[Sequence], track: Track) -> dict[str, TruePictures]:
    """Those of a dataset, by the names of its sequences or pairs of frames.

    Raises:
        RsbenchError: dataset.json lists no such file; the cameras have a lens or other scans, or objects move.
    """
    listed = read_dataset_manifest(folder).files
    found = {}
    for sequence in sequences:
        if sequence.rig.camera.lens is not None or not sequence.shutter.plain or sequence.moving:
            raise RsbenchError(
                f"{folder}: {sequence.name}: {track.id} is of cameras without a lens that read rows together "
                "from the top, and of scenes that stand still; choose another dataset"
            )
        pictures = track.asked(sequence)
        files = {}
        for name in (*_files(sequence, pictures), *track.shown(sequence)):
            if (manifest := listed.get(f"{sequence.whole}/{name}")) is None:
                raise RsbenchError(f"{folder / 'dataset.json'}: lists no {sequence.whole}/{name}")
            files[name] = manifest.sha256
        found[sequence.name] = TruePictures(sequence=sequence, asked=pictures, files=files)
    return found


def _files(sequence: Sequence, pictures: Iterable[Asked]) -> list[str]:
    views = [(side, frame + sequence.first) for side, frame in VIEWS]
    seen = [picture_file("rs", *view, depth=depth) for depth in (False, True) for view in views]
    return list(dict.fromkeys([*seen, *(each.file for each in pictures)]))
