"""Verification of a dataset: every file is what the manifest says, and every channel agrees with the others."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.core import so3
from rsbench.core.projection import ProjectionStatus, back_project, row_poses, rs_project_near
from rsbench.core.rig import SIDES, Side
from rsbench.core.so3 import FloatArray
from rsbench.dataset.files import read_json, sha256
from rsbench.dataset.sequence import FRAMES, RELATIVE_FILES, SHUTTERS, Sequence, read_sequence
from rsbench.errors import RsbenchError

DEPTH_TOLERANCE = 1e-4
"""Relative difference of two depths of one surface point that still agree."""
_FLATNESS = 2e-5
"""Largest relative second difference of inverse depth (linear on planes) of a locally flat surface: bilinear
interpolation errs by an eighth of it along each axis, well under the tolerance; an edge bends far more."""
_NEAR_MISS = 1e-3
"""A surface hidden by less than this is a disagreement, not an occlusion; shallow reliefs hide by little more."""
_AGREEING_SHARE = 0.999
"""Grazing edges, where float32 depth and the flatness test reach their limits, may leave a few pixels over."""
_CHUNK_ROWS = 100

Progress = Callable[[str], None]
"""Called with the name of the sequence after each step."""
_STEPS = 13


@dataclass(frozen=True, kw_only=True)
class DepthAgreement:
    """How the depth of one frame agrees with that of another."""

    source: str
    target: str
    compared: int
    """Pixels on a locally flat surface that land on one in the target and are not plainly hidden there."""
    agreeing: int
    """Of these, within ``DEPTH_TOLERANCE``."""
    p99: float
    """99th percentile of the relative difference of the agreeing and near pixels."""

    @property
    def share(self) -> float:
        return self.agreeing / self.compared if self.compared else 0.0


@dataclass(frozen=True, kw_only=True)
class SequenceReport:
    """What verification found in one sequence."""

    name: str
    faults: tuple[str, ...]
    agreements: tuple[DepthAgreement, ...] = ()


def verify_dataset(folder: Path, stride: int = 1, progress: Progress | None = None) -> list[SequenceReport]:
    """Check every sequence of a dataset; faults are values, only an unreadable dataset raises.

    Args:
        folder: holds dataset.json.
        stride: compare every ``stride``-th pixel in both directions.
        progress: see ``Progress``; there are ``verification_steps`` in all.

    Raises:
        RsbenchError: no dataset.json, or one that is not of format 1.
    """
    manifest = read_json(folder / "dataset.json")
    names, files = manifest.get("sequences"), manifest.get("files")
    if not isinstance(names, list) or not isinstance(files, dict):
        raise RsbenchError(f"{folder / 'dataset.json'}: must name its 'sequences' and 'files'")
    step = progress or (lambda name: None)
    return [_verify_sequence(folder, name, files, stride, step) for name in names]


def verification_steps(manifest: dict[str, Any]) -> int:
    """How often ``verify_dataset`` reports progress on the dataset of this dataset.json."""
    names = manifest.get("sequences")
    return _STEPS * len(names) if isinstance(names, list) else 0


def _verify_sequence(
    folder: Path, name: str, files: dict[str, dict[str, object]], stride: int, step: Progress
) -> SequenceReport:
    faults = list(_file_faults(folder, name, files))
    step(name)
    agreements: list[DepthAgreement] = []
    if not faults:
        try:
            sequence = read_sequence(folder / name)
            faults += [*_pose_faults(sequence), *_twin_faults(sequence)]
            for agreement in depth_agreements(sequence, stride):
                agreements.append(agreement)
                step(name)
            faults += _agreement_faults(agreements)
        except RsbenchError as error:
            faults.append(str(error))
    return SequenceReport(name=name, faults=tuple(faults), agreements=tuple(agreements))


def _file_faults(folder: Path, name: str, files: dict[str, dict[str, object]]) -> Iterator[str]:
    expected = {f"{name}/{relative}" for relative in ("sequence.json", *RELATIVE_FILES)}
    expected |= {path for path in files if path.startswith(f"{name}/")}
    for relative in sorted(expected):
        path = folder / relative
        if relative not in files:
            yield f"{relative}: not listed in dataset.json"
        elif not path.is_file():
            yield f"{relative}: missing"
        elif path.stat().st_size != files[relative]["size"] or sha256(path) != files[relative]["sha256"]:
            yield f"{relative}: content differs from its checksum in dataset.json"


def _pose_faults(sequence: Sequence) -> Iterator[str]:
    """Stored row poses must be the motion at the row times, to the last digits of a quaternion."""
    for side, frame in product(SIDES, FRAMES):
        tau, poses = sequence.poses(side, frame)
        expected = row_poses(sequence.rig, sequence.shutter, sequence.motion, side, frame)
        rows = np.arange(sequence.shutter.height)
        wrong_time = np.max(np.abs(tau - sequence.shutter.row_time(rows, frame)))
        wrong_angle = np.max(so3.angle(poses.R @ np.swapaxes(expected.R, -1, -2)))
        wrong_place = np.max(np.abs(poses.t - expected.t))
        if max(wrong_time, wrong_angle, wrong_place) > 1e-12:
            yield (
                f"{sequence.name}/poses/{side}_{frame}.csv: differs from the motion by {wrong_time:.1e} periods, "
                f"{wrong_angle:.1e} rad, {wrong_place:.1e} m"
            )


def _twin_faults(sequence: Sequence) -> Iterator[str]:
    """Row 0 of a rolling-shutter frame and of its global-shutter twin are the same rays, so the same values."""
    for side, frame in product(SIDES, FRAMES):
        images = [sequence.image(kind, side, frame)[0] for kind in SHUTTERS]
        depths = [sequence.depth(kind, side, frame)[0] for kind in SHUTTERS]
        if not np.array_equal(*images) or not np.array_equal(*depths):
            yield f"{sequence.name}/{side}_{frame}: row 0 differs from the global-shutter twin at the same pose"


def _agreement_faults(agreements: list[DepthAgreement]) -> Iterator[str]:
    for agreement in agreements:
        if agreement.compared and agreement.share < _AGREEING_SHARE:
            yield (
                f"depth of {agreement.source} and {agreement.target} agree to {DEPTH_TOLERANCE:g} on only "
                f"{100 * agreement.share:.2f} % of {agreement.compared} visible pixels"
            )
    if not any(agreement.compared for agreement in agreements):
        yield "no pixel of any frame could be compared with another frame"


def depth_agreements(sequence: Sequence, stride: int = 1) -> Iterator[DepthAgreement]:
    """Compare the rolling-shutter depth of each of the four frames with the other three."""
    frames = list(product(SIDES, FRAMES))
    depths = {frame: sequence.depth("rs", *frame) for frame in frames}
    for source, target in product(frames, frames):
        if source != target:
            yield _agreement(sequence, source, target, depths[source], depths[target], stride)


def _agreement(
    sequence: Sequence,
    source: tuple[Side, int],
    target: tuple[Side, int],
    source_depth: NDArray[np.float32],
    target_depth: NDArray[np.float32],
    stride: int,
) -> DepthAgreement:
    geometry = sequence.rig, sequence.shutter, sequence.motion
    grid = sequence.rig.camera.pixel_grid()[::stride, ::stride]
    depth = source_depth[::stride, ::stride].astype(np.float64)
    flat = _locally_flat(source_depth)[::stride, ::stride]
    differences = []
    for first in range(0, len(grid), _CHUNK_ROWS):
        surface = flat[first : first + _CHUNK_ROWS]
        pixels = grid[first : first + _CHUNK_ROWS][surface]
        X = back_project(*geometry, *source, pixels, depth[first : first + _CHUNK_ROWS][surface])
        seen = rs_project_near(*geometry, *target, X, pixels[:, 1])
        inside = seen.status == ProjectionStatus.SEEN
        differences.append(_compare(target_depth, seen.pixels[inside], seen.depth[inside]))
    relative = np.concatenate(differences)
    near = np.abs(relative[relative < _NEAR_MISS])
    return DepthAgreement(
        source=f"{source[0]}_{source[1]}",
        target=f"{target[0]}_{target[1]}",
        compared=near.size,
        agreeing=int(np.sum(near <= DEPTH_TOLERANCE)),
        p99=float(np.percentile(near, 99)) if near.size else float("nan"),
    )


def _locally_flat(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(H, W) pixels whose 3 x 3 neighbourhood is one flat surface, too wide to slip between pixels."""
    solid = depth > 0
    inverse = np.where(solid, 1.0 / np.where(solid, depth, 1.0).astype(np.float64), np.nan)
    flat = np.zeros(depth.shape, dtype=np.bool_)
    across = np.abs(np.diff(inverse, 2, axis=1))
    down = np.abs(np.diff(inverse, 2, axis=0))
    bend = np.maximum.reduce([across[:-2], across[1:-1], across[2:], down[:, :-2], down[:, 1:-1], down[:, 2:]])
    with np.errstate(invalid="ignore"):
        flat[1:-1, 1:-1] = bend <= _FLATNESS * inverse[1:-1, 1:-1]
    return flat


def _compare(depth: NDArray[np.float32], pixels: FloatArray, z: FloatArray) -> FloatArray:
    """Relative depth of points behind (+) or before (-) the surface, where that is locally flat."""
    height, width = depth.shape
    x0, y0 = np.floor(pixels).astype(np.int64).T
    inner = (x0 >= 1) & (x0 < width - 2) & (y0 >= 1) & (y0 < height - 2)
    x0, y0, pixels, z = x0[inner], y0[inner], pixels[inner], z[inner]
    offsets = np.arange(-1, 3)
    block = depth[y0[:, None, None] + offsets[:, None], x0[:, None, None] + offsets].astype(np.float64)
    solid = np.all(block > 0, axis=(1, 2))
    inverse = 1.0 / np.where(block > 0, block, 1.0)
    bend = np.maximum(
        np.max(np.abs(np.diff(inverse, 2, axis=1)), axis=(1, 2)),
        np.max(np.abs(np.diff(inverse, 2, axis=2)), axis=(1, 2)),
    )
    twist = np.max(np.abs(np.diff(np.diff(inverse, axis=1), axis=2)), axis=(1, 2))
    flat = solid & (np.maximum(bend, twist) <= _FLATNESS * inverse[:, 1, 1])
    fx, fy = (pixels - np.stack([x0, y0], axis=-1)).T
    top = (1 - fx) * inverse[:, 1, 1] + fx * inverse[:, 1, 2]
    bottom = (1 - fx) * inverse[:, 2, 1] + fx * inverse[:, 2, 2]
    relative = z * ((1 - fy) * top + fy * bottom) - 1.0
    return relative[flat]
