"""The problems of a split with their truth: drawn from a seed, or those of a rendered dataset.

A split is known by its name and a fingerprint of its truth. The fingerprint can be announced before a
competition: whoever is told the seed or is given the dataset afterwards finds the same one.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from rsbench.benchmark.leaderboard.points_draws import POINTS_1, Draws
from rsbench.benchmark.leaderboard.track import Track
from rsbench.benchmark.leaderboard.true_pictures import TruePictures, true_pictures
from rsbench.benchmark.simulated.simulation import Simulation, simulate
from rsbench.benchmark.simulated.sweep_card import Setting
from rsbench.components.motion_models import motion_record
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import LaterMotion, Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.dataset.sequence import Sequence, read_dataset_manifest, read_pairs
from rsbench.pipeline.problem import Problem, problem_record
from rsbench.storage.untrusted_files import check_name, read_text

PUBLIC_SEED = 1
"""Of the split ``dev``: its truth is known to everybody."""
_ANNOUNCED = {
    "b7eafa489ffbd9d816c2edd44f5842bdf01306f286ab36dd2c0ef72aee05523b": "f88c896f00000000",
    "57af81babdeeb5d96992052241698c127f8a4e7fd716fc28f146bf858b8edb40": "7a998de400000000",
    "881e9e954f8a3cc3c1bd3d11fcca7277b3af27da058d3a2340487ac84d1e7c89": "292f151500000000",
    "792e3e2e7ccfbdaefda940050f3d95c9e814a517eb48c4e618b200bb37b608ee": "ba1e206a00000000",
    "ee83b3153351ba62775f40dedeba0d2bfeb9c8c036fe6eefa6332c92b9e48b29": (
        "382c1320481b8b75aae3ba87190f80b7d671d73c323961e95e6bee131c507e77"
    ),
}
"""By the hash of the truth to nine digits, equal on all processors, the fingerprint that was announced: of the
public points, and of the motions of ``laws``."""
_SHORTEST_SECRET = 16
"""Characters of a seed file: shorter ones could be tried."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """The true motion of one problem, and what is known of it."""

    name: str
    rig: StereoRig
    shutter: RollingShutter
    motion: Motion
    scene: str
    """Problems of one scene are not independent: intervals count scenes."""
    facts: dict[str, float | str]
    """What scores may be drawn against."""
    sequence: Sequence | None = None
    """Of rendered frames: where their truth lies."""
    pictures: TruePictures | None = None
    """Where pictures are asked."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Split:
    """The truth of all problems of a track."""

    track: Track
    label: str
    """``dev``, ``test``, or the name of the dataset."""
    public: bool
    """Whether the truth may be told."""
    truths: tuple[Truth, ...]
    seed: int = PUBLIC_SEED
    """Of problems that are simulated."""

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of the protocol, the rigs, the true motions, and what is seen where pictures are asked."""
        content = [self.track.id, *(_identity(truth) for truth in self.truths)]
        return _ANNOUNCED.get(hash_of(_rounded(content))) or hash_of(content)

    @property
    def name(self) -> str:
        """The label, and enough of the fingerprint that no two splits are taken for one."""
        return f"{self.label}-{self.fingerprint[:8]}"

    @cached_property
    def by_name(self) -> dict[str, Truth]:
        return {truth.name: truth for truth in self.truths}


def hash_of(content: object) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _rounded(content: Any) -> Any:
    """With numbers to nine digits: exp and sin differ in the last bit between processors."""
    if isinstance(content, float):
        return f"{content:.9g}"
    if isinstance(content, dict):
        return {key: _rounded(value) for key, value in content.items()}
    return [_rounded(each) for each in content] if isinstance(content, list | tuple) else content  # pyrefly: ignore


def _identity(truth: Truth) -> dict[str, Any]:
    problem = Problem(
        name=truth.name, correspondences=Correspondences(), rig=truth.rig, known_shutter=truth.shutter
    )
    seen = {} if truth.pictures is None else {"files": truth.pictures.files}
    return {**problem_record(problem), "motion": _motion_identity(truth.motion), **seen}


def _motion_identity(motion: Motion) -> dict[str, Any]:
    """Of a pair of frames in a longer way: the whole way, and where it begins."""
    if isinstance(motion, LaterMotion):
        return {"later": motion_record(motion.motion), "start": motion.start}
    return motion_record(motion)


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
