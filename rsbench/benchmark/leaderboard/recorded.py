"""Simulated points under recorded trajectories, which no solver's motion model describes exactly.

A recording is a file of camera poses in TUM's format, whose name begins with the type of its device, as in
``hand-rig.txt``. rsbench comes with those in cards/recordings; the README there has sources, licences and errors.
A problem is a window of two frames of a recording, with row poses on the spline through its poses; rig, depths,
noise, outliers and number of points are drawn as in points-2.
"""

from __future__ import annotations

from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.leaderboard.splits import KINDS, DrawnPoints, Draws, RigKind, circumstances
from rsbench.benchmark.simulated.sweep_card import Setting
from rsbench.components.cards import choices, shipped_folder
from rsbench.components.motion_models import fixed_endpoint
from rsbench.components.seeds import generator
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.spline_motion import TrajectoryMotion
from rsbench.dataset.motion_cards import Trajectory, poses_around, read_trajectory

DEVICES: dict[str, RigKind] = {"hand": KINDS["headset"], "car": KINDS["car"], "drone": KINDS["drone"]}
"""Type of rig of each type of device, for its sizes only: the motion is that of the recording."""
OF_A_RECORDING = 60
"""Number of problems of each recording."""
_SCOPE = ("leaderboard", "points-recorded")
_PERIOD_S = 1.0 / 30.0
_LASTS = 2.0
"""Length of a window, frame periods: from the first row of frame 0 to the latest possible row of frame 1."""
_READOUT = (0.5, 1.0)


def recordings_folder() -> Path:
    """Return the folder of the recordings that come with rsbench."""
    return shipped_folder("cards/recordings", "_cards/recordings")


@lru_cache(maxsize=8)  # the same object for a folder, because it is a key of other caches
def recorded_draws(folder: Path) -> Draws:
    """Return the generator of the problems of the recordings in a folder.

    Raises:
        RsbenchError: there are no recordings, or a name does not begin with a type of device.
    """
    names = recordings_in(folder)
    return Draws(
        scope=_SCOPE,
        problems=OF_A_RECORDING * len(names),
        setting=partial(_setting, folder),
        outlier_images="all",
        kinds=partial(_kinds, folder),
        moved=partial(_motion, folder),
    )


@lru_cache(maxsize=8)
def recordings_in(folder: Path) -> tuple[str, ...]:
    """Return the names of the recordings in a folder, sorted; errors are those of ``recorded_draws``."""
    names = tuple(sorted(path.stem for path in folder.glob("*.txt")))
    if not names:
        raise RsbenchError(
            f"{folder}: has no recording; write poses in TUM's format into a file such as hand-mine.txt"
        )
    for name in names:
        if (kind := name.partition("-")[0]) not in DEVICES:
            raise RsbenchError(
                f"{folder / name}.txt: its name begins with {kind!r}, not with a kind of device"
                f"{choices(kind, DEVICES)}; rename it, as hand-{name}.txt"
            )
    return names


@lru_cache(maxsize=16)
def _trajectory(path: Path) -> Trajectory:
    return read_trajectory(path, 1.0)


@lru_cache(maxsize=8)
def _order(folder: Path, seed: int) -> NDArray[Any]:
    return generator(seed, *_SCOPE, "order").permutation(OF_A_RECORDING * len(recordings_in(folder)))


def _window(folder: Path, seed: int, number: int) -> tuple[str, int]:
    """Return the name of the recording of a problem, and the index of the part that contains its window."""
    names = recordings_in(folder)
    part, which = divmod(int(_order(folder, seed)[number]), len(names))
    return names[which], part


@lru_cache(maxsize=512)
def _motion(folder: Path, seed: int, number: int) -> Motion:
    """Return the motion of a problem, in a window at a random time within its part of the recording.

    Raises:
        RsbenchError: the recording is shorter than a window.
    """
    name, part = _window(folder, seed, number)
    trajectory = _trajectory(folder / f"{name}.txt")
    left = float(trajectory.seconds[-1]) - _LASTS * _PERIOD_S
    if left <= 0.0:
        raise RsbenchError(f"{folder / name}.txt: is shorter than two frame periods of 1/30 s; give more poses")
    rng = generator(seed, *_SCOPE, "motion", number)
    zero_s = left * (part + float(rng.uniform())) / OF_A_RECORDING
    poses = poses_around(trajectory, zero_s, _PERIOD_S, (0.0, _LASTS))
    w, d = fixed_endpoint("trajectory", {"poses": poses}) or (np.zeros(3), np.zeros(3))
    return TrajectoryMotion(w, d, poses)


@lru_cache(maxsize=512)
def _setting(folder: Path, seed: int, number: int) -> Setting:
    """Return the setting of a problem, with the sizes of w and d of its motion, which is not made from it."""
    kind = DEVICES[_window(folder, seed, number)[0].partition("-")[0]]
    motion, rng = _motion(folder, seed, number), generator(seed, *_SCOPE, "setting", number)
    return Setting(
        width=kind.width,
        height=kind.height,
        focal=kind.focal,
        depth=kind.depth,
        rotation_deg=float(np.rad2deg(np.linalg.norm(motion.w))),
        translation=float(np.linalg.norm(motion.d)),
        **circumstances(rng, kind.baseline, _READOUT),
    )


def _kinds(folder: Path, seed: int, number: int) -> dict[str, float | str]:
    return {"recording": _window(folder, seed, number)[0]}


class RecordedPoints(DrawnPoints):
    """Inputs of points under the recordings of a folder (``--data``), or under those that come with rsbench."""

    def draws_of(self, data: Path | None) -> Draws:
        folder = data or recordings_folder()
        if not folder.is_dir():
            raise RsbenchError(f"--data {folder}: is no folder of recordings, files such as hand-mine.txt")
        return recorded_draws(folder.resolve())
