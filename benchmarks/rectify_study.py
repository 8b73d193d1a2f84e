"""What it costs to rectify rolling-shutter frames by resampling, against the rig as it is.

    nice python benchmarks/rectify_study.py --out results/rectify                # an hour of a processor
    nice python benchmarks/rectify_study.py --out results/rectify --frames 0     # points alone: a minute

The right camera is turned by an angle about a random axis. Rectified is ``cv2.stereoRectify`` and ``cv2.remap``
with the true calibration, where users are told to; then everything is as for an ideal rig. The new cameras are
those that keep rows closest to what they were (mean focal length, mean shift); frames are resampled by Lanczos'
kernel: other choices cost more.

Points: exact projections with noise, seen by all four cameras; no images, no wrong matches. Frames: those of
``foreign_frames.py``, corrected by ``rsbench.correct``; PSNR is against the traced global-shutter frames, of
rectified frames against these resampled alike, on the pixels that the correction claims and both frames show.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import foreign_case
import foreign_frames as frames
import foreign_motion as motion
import numpy as np
import pandas as pd
from foreign_motion import Array
from foreign_rig import BROWN, KANNALA, SIDES, Camera, Rig, padded
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

ANGLES_DEG = (0.0, 0.25, 0.5, 1.0, 2.0, 3.0, 5.0)
RATIOS = (0.2, 0.4, 0.6, 0.8, 1.0)
SPEEDS = (0.25, 0.5, 1.0, 2.0)
"""Of 2 deg and 0.25 m a frame period."""
USUAL = {"angle": 1.0, "ratio": 0.8, "speed": 1.0}
NOISE_PX, TRACKS = 0.05, 1000
_RIM = 2.0
"""Pixels at the rim of a frame that its resampled copy lacks."""


@dataclass(frozen=True)
class Rectified:
    """How a rig's frames are resampled, and what they then are."""

    rig: Rig
    """Two equal aligned cameras."""
    turns: dict[str, Array]
    """From each camera's axes (3, 3) to the new ones."""
    body: Array
    """From the new axes (3, 3) to the body's."""
    sources: dict[str, Camera]

    def resample(self, side: str, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        x, y = self._maps(side)
        return np.asarray(cv2.remap(image, x, y, cv2.INTER_LANCZOS4))

    def shown(self, side: str) -> NDArray[np.bool_]:
        """Pixels that the camera's own frame has."""
        (x, y), source = self._maps(side), self.sources[side]
        inside = (x >= _RIM) & (x <= source.width - 1 - _RIM)
        return np.asarray(inside & (y >= _RIM) & (y <= source.height - 1 - _RIM))

    def _maps(self, side: str) -> tuple[Array, Array]:
        source, new = self.sources[side], self.rig.camera(side)
        K, k = matrix(source), padded(source)
        make = cv2.fisheye.initUndistortRectifyMap if source.lens == KANNALA else cv2.initUndistortRectifyMap
        x, y = make(K, k, self.turns[side], matrix(new), (new.width, new.height), cv2.CV_32FC1)
        return x, y

    def pixels(self, side: str, own: Array) -> Array:
        """Where points (n, 2) of a camera's own frame are."""
        source = self.sources[side]
        undistort = cv2.fisheye.undistortPoints if source.lens == KANNALA else cv2.undistortPoints
        found = undistort(
            own.reshape(-1, 1, 2), matrix(source), padded(source), R=self.turns[side], P=matrix(self.rig.left)
        )
        return np.asarray(found).reshape(-1, 2)

    def in_body(self, w: Array, d: Array) -> tuple[Array, Array]:
        """A motion of the new axes in the body's."""
        return self.body @ w, self.body @ d


def matrix(c: Camera) -> Array:
    """The calibration matrix (3, 3)."""
    return np.array([[c.fx, 0.0, c.centre[0]], [0.0, c.fy, c.centre[1]], [0.0, 0.0, 1.0]])


def rectified(rig: Rig) -> Rectified:
    """The ideal rig that the frames of this one are resampled to; of a vertical one with columns for rows."""
    left, right = rig.left, rig.right
    none, size = np.zeros(5), (left.width, left.height)
    first, second, *_ = cv2.stereoRectify(
        matrix(left), none, matrix(right), none, size, rig.R, rig.t.reshape(3, 1), alpha=-1
    )
    upright = np.rint(rig.body_from_left())
    turns = {"left": upright @ first, "right": upright @ second}
    vertical = upright[0, 1] != 0.0
    width, height = size[::-1] if vertical else size
    focal = float(np.mean([left.fx, left.fy, right.fx, right.fy])) if left.width == right.width else left.focal
    middles = []
    for side in SIDES:
        c = rig.camera(side)
        undistort = cv2.fisheye.undistortPoints if c.lens == KANNALA else cv2.undistortPoints
        middle = np.array([[[(c.width - 1) / 2, (c.height - 1) / 2]]])
        ray = turns[side] @ [*np.asarray(undistort(middle, matrix(c), padded(c))).ravel(), 1.0]
        middles.append(focal * ray[:2] / ray[2])
    shift = -np.mean(middles, axis=0)
    new = {
        side: replace(
            rig.camera(side),
            width=width,
            height=height,
            fx=focal,
            fy=focal,
            shift=(float(shift[0]), float(shift[1])),
            lens=BROWN,
            coefficients=(),
            scan="left" if vertical else "top",
        )
        for side in SIDES
    }
    t = np.array([-rig.baseline, 0.0, 0.0])
    body = rig.body_from_left() @ turns["left"].T
    return Rectified(
        Rig(left=new["left"], right=new["right"], t=t), turns, body, {s: rig.camera(s) for s in SIDES}
    )


def misaligned(angle: float, ratio: float, rng: np.random.Generator) -> Rig:
    """The right camera turned by an angle, degrees, about a random axis through its centre."""
    R = Rotation.from_rotvec(np.radians(angle) * motion.direction(rng, (1.0, 1.0, 1.0))).as_matrix()
    camera = Camera(ratio=ratio)
    return Rig(left=camera, right=camera, R=R, t=-R @ np.array([0.2, 0.0, 0.0]))


def errors(true: tuple[Array, Array], found: tuple[Array, Array]) -> dict[str, float]:
    """e_R and e_T, degrees."""
    R = motion.matrices(np.array([true[0], found[0]]))
    a, b = true[1], found[1]
    return {
        "e_R": float(np.degrees(np.linalg.norm(Rotation.from_matrix(R[1] @ R[0].T).as_rotvec()))),
        "e_T": float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))),
    }


def of_points(angle: float, ratio: float, speed: float, seed: int) -> Iterator[dict[str, Any]]:
    """Errors of both ways from the same points."""
    from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
    from rsbench.components.motion_models import LinearMotion
    from rsbench.core.correspondences import Correspondences
    from rsbench.solvers.engine.base import load_solver_entry

    rng = np.random.default_rng([seed, *b"rectify"])
    law = frames.usual_law(rng, speed)
    rig = misaligned(angle, ratio, rng)
    true = motion.between(law, 0.0, 1.0)
    options = SimulationOptions(tracks=TRACKS, noise_px=NOISE_PX)
    tracks = simulate(*foreign_case.ours(rig), LinearMotion(*true), options, rng).correspondences.tracks
    solver = load_solver_entry("rs-stereo-refined").solver
    new = rectified(rig)
    ends = [new.pixels(side, tracks[:, 2 * k : 2 * k + 2]) for k, side in enumerate([*SIDES, *SIDES])]
    for way, seen, as_rig in (("as it is", tracks, rig), ("rectified", np.concatenate(ends, axis=1), new.rig)):
        found = solver.estimate(Correspondences(tracks=seen), *foreign_case.ours(as_rig))
        pose = np.asarray(found.w), np.asarray(found.d)
        pose = pose if way == "as it is" else new.in_body(*pose)
        yield {"way": way, **(errors(true, pose) if found.success else {"e_R": 180.0, "e_T": 180.0})}


def of_frames(angle: float, ratio: float, speed: float, seed: int) -> Iterator[dict[str, Any]]:
    """Errors and PSNR of both ways from the same frames."""
    rng = np.random.default_rng([seed, *b"rig"])
    case = frames.usual_case(frames.usual_law(rng, speed), misaligned(angle, ratio, np.random.default_rng(seed)))
    yield from both_ways(case, rng)


def both_ways(case: frames.Case, rng: np.random.Generator) -> Iterator[dict[str, Any]]:
    """A case corrected as it is and rectified."""
    seen = foreign_case.seen(case, rng)
    yield {"way": "as it is", **scored(seen, None)}
    yield {"way": "rectified", **scored(seen, rectified(case.rig))}


def scored(seen: foreign_case.Seen, new: Rectified | None) -> dict[str, Any]:
    """Of one correction in memory; what went wrong where there is none."""
    import rsbench
    from rsbench.core.rig import VIEWS

    images, still, (rig, shutter) = seen.images, seen.still, (seen.rig, seen.shutter)
    shown = [np.ones(image.shape, dtype=np.bool_) for image in images]
    if new is not None:
        sides = [*SIDES, *SIDES]
        images, still = (
            [new.resample(*each) for each in zip(sides, four, strict=True)] for four in (images, still)
        )
        shown, (rig, shutter) = [new.shown(side) for side in sides], foreign_case.ours(new.rig)
    try:
        result = foreign_case.corrected(images, rig, shutter)
    except rsbench.RsbenchError as error:
        return {"reason": str(error)}
    pose = result.motion.w, result.motion.d
    row: dict[str, Any] = errors((seen.motion.w, seen.motion.d), pose if new is None else new.in_body(*pose))
    found = []
    for number, view in enumerate((side, frame) for frame in (0, 1) for side in SIDES):
        fused = result.frames[view]
        mask = (fused.origin != 0) & shown[number]
        found.append([psnr(image[mask], still[number][mask]) for image in (fused.image, images[number])])
    assert len(found) == len(VIEWS)
    return row | dict(zip(("psnr", "before"), np.mean(found, axis=0), strict=True))


def psnr(image: NDArray[Any], truth: NDArray[Any]) -> float:
    """dB."""
    error = image.astype(np.float64) - truth.astype(np.float64)
    return float(10.0 * np.log10(255.0**2 / max(float(np.mean(error**2)), 1e-12)))


def _cells() -> list[dict[str, float]]:
    """Combinations in which at most one value is not the usual one."""
    axes = dict(zip(USUAL, (ANGLES_DEG, RATIOS, SPEEDS), strict=True))
    every = [dict(zip(USUAL, values, strict=True)) for values in product(*axes.values())]
    return [cell for cell in every if sum(cell[name] != USUAL[name] for name in USUAL) <= 1]


def measured(kind: str, seeds: int) -> pd.DataFrame:
    """A row for each cell, seed and way."""
    of = {"points": of_points, "frames": of_frames}[kind]
    rows = []
    for cell in _cells():
        for seed in range(seeds):
            rows += [{"kind": kind, **cell, "seed": seed, **row} for row in of(**cell, seed=seed)]
        sys.stderr.write(f"{kind} {cell}\n")
    return pd.DataFrame(rows)


def page(points: pd.DataFrame, seen: pd.DataFrame | None) -> str:
    """The results in Markdown."""
    biased = points[(points.way == "rectified") & (points.angle >= 0.5)]
    share = biased.e_T / (biased.angle * biased.ratio)
    turn = biased.e_R / (biased.angle * biased.ratio * biased.speed)
    return PAGE.format(
        seeds=points.seed.nunique(),
        tracks=TRACKS,
        noise=NOISE_PX,
        share=share.median(),
        largest=share.quantile(0.95),
        turn=turn.median(),
        points=_lines(points),
    ) + ("" if seen is None else FRAMES.format(seeds=seen.seed.nunique(), frames=_frames(seen)))


def _lines(points: pd.DataFrame) -> str:
    """A line for each cell: both ways beside each other."""
    head = ("angle (deg)", "ratio", "speed", "e_R: as it is", "rectified", "e_T: as it is", "rectified")
    lines = [f"| {' | '.join(head)} |", "|" + "---:|" * len(head)]
    for cell, rows in points.groupby(list(USUAL)):
        numbers = [f"{value:g}" for value in cell]  # type: ignore[union-attr]
        for name, digits in (("e_R", 4), ("e_T", 3)):
            for way in ("as it is", "rectified"):
                values = rows[rows.way == way][name]
                numbers.append(f"{values.median():.{digits}f} [{values.max():.{digits}f}]")
        lines.append(f"| {' | '.join(numbers)} |")
    return "\n".join(lines)


def _frames(seen: pd.DataFrame) -> str:
    """A line for each cell, both ways beside each other."""
    head = ("angle (deg)", "ratio", "speed", "e_R: as it is", "rectified", "e_T: as it is", "rectified")
    head = (*head, "PSNR before", "as it is", "rectified", "failed")
    lines = [f"| {' | '.join(head)} |", "|" + "---:|" * len(head)]
    for cell, rows in seen.groupby(list(USUAL)):
        ways = [rows[rows.way == way] for way in ("as it is", "rectified")]
        numbers = [f"{value:g}" for value in cell]  # type: ignore[union-attr]
        for name, digits in (("e_R", 4), ("e_T", 3)):
            numbers += [f"{way[name].median():.{digits}f} [{way[name].max():.{digits}f}]" for way in ways]
        numbers += [f"{ways[0].before.median():.1f}", *(f"{way.psnr.median():.2f}" for way in ways)]
        numbers.append(" + ".join(str(int(way.e_T.isna().sum())) for way in ways))
        lines.append(f"| {' | '.join(numbers)} |")
    return "\n".join(lines)


PAGE = """# What it costs to rectify rolling-shutter frames by resampling

Rectifying moves pixels to other rows, and with a rolling shutter a row is a time: the resampled frames no longer
tell when a pixel was read. Here the right camera is turned by an angle about a random axis; both cameras are
640 x 480, focal length 520 px, baseline 0.2 m. *As it is*: rsbench knows the rig and the frames stay as the
sensor read them. *Rectified*: OpenCV's `stereoRectify` and `remap` with the true calibration, new cameras that
keep rows as near as possible to where they were, then everything as for an ideal rig. Speed 1 is 2 deg and 0.25 m
a frame period; the law of motion is linear in both, and readout ratio and law are given.

Made by `python benchmarks/rectify_study.py --out results/rectify`; versions, date and seeds:
[provenance.json](provenance.json). Every case: [points.csv](points.csv).

## Points

{tracks} points seen by both cameras at both times, {noise} px of noise, no wrong matches; solver
`rs-stereo-refined`; degrees, medians [and worst] of {seeds} scenes and motions. Rectified, from 0.5 deg on, e_T
is **{share:.3f} deg per degree of misalignment and unit of readout ratio** (95 % below {largest:.2f}), e_R
{turn:.4f} deg per degree, unit of readout ratio and unit of speed. e_T does not fall with the speed, as it
does where noise is the cause: the error of a pixel grows with the motion.

{points}
"""

FRAMES = """
## Frames

Traced by code that shares nothing with rsbench's geometry (`benchmarks/foreign_frames.py`), noise 1.5 grey levels,
corrected by `rsbench.correct`; medians [and worst] of {seeds} scenes and motions. PSNR (dB) is against the
traced global-shutter frames, of rectified frames against these resampled alike. Every case:
[frames.csv](frames.csv).

{frames}
"""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--points", type=int, default=8, help="seeds of points")
    parser.add_argument("--frames", type=int, default=5, help="seeds of frames")
    given = parser.parse_args()
    from rsbench.benchmark.provenance import provenance
    from rsbench.storage.files import write_bytes, write_json, write_table

    given.out.mkdir(parents=True, exist_ok=True)
    wanted = {"points": given.points, "frames": given.frames}
    found = {kind: measured(kind, seeds) for kind, seeds in wanted.items() if seeds}
    for kind, table in found.items():
        write_table(given.out / f"{kind}.csv", table)
    write_bytes(given.out / "README.md", page(found["points"], found.get("frames")).encode())
    command = f"python benchmarks/rectify_study.py --out {given.out.as_posix()} --frames {given.frames}"
    sizes = {"points": given.points, "frames": given.frames, "tracks": TRACKS, "noise_px": NOISE_PX}
    write_json(given.out / "provenance.json", provenance(command, **sizes))
    return 0


if __name__ == "__main__":
    sys.exit(main())
