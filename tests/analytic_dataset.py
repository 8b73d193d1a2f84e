"""A dataset of one sequence whose depth is known in closed form: a slanted floor and a wall behind it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from attack.planting import rehash
from numpy.typing import NDArray

import rsbench
from rsbench.components.cards import load_card, parse_card
from rsbench.components.rig_tables import RigTables, tables_of
from rsbench.core.camera import PinholeCamera
from rsbench.core.motion import Motion
from rsbench.core.projection import row_poses
from rsbench.core.rig import StereoRig, views_of
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.dataset.card import CameraCard, DatasetCard, MotionCard, SequenceCard
from rsbench.dataset.channels import channel_files
from rsbench.dataset.layout import Shutter, picture_file, relative_files
from rsbench.dataset.sequence import UNITS, sequence_manifest
from rsbench.renderers.options import RendererOptions
from rsbench.storage.files import read_json, sha256, write_depth, write_json, write_png, write_poses

PLANES = ((np.array([0.05, 1.0, -0.15]), 1.2), (np.array([0.1, 0.05, 1.0]), 9.0))
"""Normal n and offset c of n . X = c, world frame."""


def _spread(poses: Pose, columns: bool) -> Pose:
    """Poses of lines, such that they broadcast over an image: (H or 1, 1 or W, 3, 3) and (..., 3)."""
    return Pose(*(part[None] if columns else part[:, None] for part in poses))


def plane_depth(camera: PinholeCamera, poses: Pose, columns: bool = False) -> NDArray[np.float32]:
    """z along each pixel's ray to the nearest plane, from the pose of its own row, or column."""
    R, t = _spread(poses, columns)
    directions = np.einsum("...ji,...j->...i", R, camera.unproject(camera.pixel_grid()))
    centres = -np.einsum("...ji,...j->...i", R, t)
    depths = []
    for normal, offset in PLANES:
        z = (offset - centres @ normal) / (directions @ normal)
        depths.append(np.where(z > 0, z, np.inf))
    return np.min(depths, axis=0).astype(np.float32)


def plane_colours(
    camera: PinholeCamera, poses: Pose, depth: NDArray[np.float32], columns: bool = False
) -> NDArray[np.uint8]:
    """What is painted on the planes: waves in the world, some 12 px long, others in each channel."""
    R, t = _spread(poses, columns)
    X = np.einsum("...ji,...j->...i", R, depth[..., None] * camera.unproject(camera.pixel_grid()) - t)
    waves = np.array([[5.0, 4.0, 3.0], [-4.0, 5.0, 2.0], [3.0, -5.0, 4.0]])
    return np.round(128 + 50 * np.sin(X @ waves.T)).astype(np.uint8)


def card_of(rig: StereoRig, shutter: RollingShutter, motion: Motion, frames: int) -> DatasetCard:
    camera = CameraCard(width=rig.camera.width, height=rig.camera.height, focal=rig.camera.fx)
    cameras: dict[str, Any] = {"camera": camera, "baseline": rig.baseline}
    if not rig.aligned:
        cameras = {"rig": parse_card(RigTables, tables_of(rig), "rig")}
    return DatasetCard(
        name="planes",
        **cameras,
        readout_ratio=shutter.readout_ratio,
        frames=frames,
        motion=MotionCard(
            model=motion.name,
            parameters=motion.parameters,
            rotation_deg=float(np.rad2deg(np.linalg.norm(motion.w))),
            rotation_axis=tuple(motion.w.tolist()),
            translation=float(np.linalg.norm(motion.d)),
            translation_axis=tuple(motion.d.tolist()),
        ),
        sequence=(SequenceCard(name="planes", scene="planes.toml"),),
    )


def add_channels(out: Path, card: DatasetCard, write: Callable[[Path], None]) -> None:
    """Add what ``write`` writes of a card's channels into the sequence's folder, with manifests that fit."""
    folder, files = out / "planes", channel_files(card.channels, (), card.frames)
    for name in files:
        (folder / name).parent.mkdir(exist_ok=True)
    write(folder)
    own, made = read_json(folder / "sequence.json"), card.manifest_of(card.sequence[0])
    own |= {key: made[key] for key in ("channels", "imu", "matches") if key in made}
    own["files"] |= dict.fromkeys(files, "")
    write_json(folder / "sequence.json", own)
    write_json(out / "dataset.json", read_json(out / "dataset.json") | {"card": asdict(card)})
    rehash(out)


def write_analytic_dataset(
    out: Path,
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    *,
    true_motion: Motion | None = None,
    true_cameras: tuple[StereoRig, RollingShutter] | None = None,
    frames: int = 2,
    twins: tuple[int, ...] = (),
) -> None:
    """Write a dataset; ``true_motion`` and ``true_cameras`` make depth and images, the others are what files say.

    ``twins``: rows of global-shutter twins beside that of row 0.
    """
    folder = out / "planes"
    files = [
        *relative_files(frames),
        *(picture_file("gs", *v, row, d) for v in views_of(frames) for row in twins for d in (False, True)),
    ]
    for name in files:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
    for side, frame in views_of(frames):
        true_rig, true_shutter = true_cameras or (rig, shutter)
        camera = true_rig.sensor(side)
        stated = row_poses(rig, shutter, motion, side, frame)
        write_poses(folder / f"poses/{side}_{frame}.csv", shutter.line_times(frame, side), stated)
        rolling = row_poses(true_rig, true_shutter, true_motion or motion, side, frame)
        pictures: list[tuple[Shutter, int]] = [("rs", 0), *(("gs", row) for row in (0, *twins))]
        for kind, row in pictures:
            line = abs(shutter.first_line(side) - row)
            still = Pose(*(np.broadcast_to(part[line], part.shape) for part in rolling))
            poses, columns = rolling if kind == "rs" else still, shutter.axis(side) == 0
            depth = plane_depth(camera, poses, columns)
            write_png(folder / picture_file(kind, side, frame, row), plane_colours(camera, poses, depth, columns))
            write_depth(folder / picture_file(kind, side, frame, row, depth=True), depth)
    manifest = sequence_manifest(
        name="planes", rig=rig, shutter=shutter, motion=motion, frame_period_s=0.1, frames=frames
    )
    manifest |= {"twins": list(twins)} if twins else {}
    manifest |= {
        "scene": {"name": "planes", "sha256": "", "viewpoint": "default", "eye": [0, 0, 0], "target": [0, 1, 0]},
        "renderer": asdict(load_card(RendererOptions, "renderers", "default")),
        "seed": 0,
        "made_by": dict.fromkeys(("rsbench", "mitsuba", "drjit", "variant"), rsbench.__version__),
        "files": {name: sha256(folder / name) for name in files},
    }
    write_json(folder / "sequence.json", manifest)
    names = ["sequence.json", *files]
    write_json(
        out / "dataset.json",
        {
            "format": manifest["format"],
            "name": "planes",
            "description": "",
            "rsbench": rsbench.__version__,
            "mitsuba": "none",
            "units": UNITS,
            "card": {
                key: value
                for key, value in asdict(card_of(rig, shutter, motion, frames)).items()
                if value is not None
            },
            "sequences": ["planes"],
            "files": {
                f"planes/{name}": {"sha256": sha256(folder / name), "size": (folder / name).stat().st_size}
                for name in names
            },
        },
    )
