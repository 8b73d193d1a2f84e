"""Writing the channels that tell of a whole sequence, when its frames are there."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rsbench.core.geometry import FixedGeometry
from rsbench.core.rig import VIEWS, views_of
from rsbench.dataset.card import DatasetCard, SequenceCard
from rsbench.dataset.channels import AFFINE, INSTANCE_TABLE, MATCHER, matches_file
from rsbench.dataset.imu import Imu, draw_samples, gravity_of, sample_times_ns, write_imu
from rsbench.dataset.matches import Matching, save_matches
from rsbench.dataset.timing import write_timing
from rsbench.dataset.tracks import make_affine, make_tracks, save_affine, write_tracks
from rsbench.dataset.views import ImageView
from rsbench.storage.files import read_depth, read_png, write_json

if TYPE_CHECKING:
    from rsbench.renderers.scene import MitsubaScene


def write_sequence_channels(
    folder: Path, card: DatasetCard, sequence: SequenceCard, scene: MitsubaScene, record: Mapping[str, Any]
) -> None:
    """The files of the card's channels that belong to no one frame.

    Args:
        folder: of the sequence, with all of its frames.
        card: of the dataset.
        sequence: of the card.
        scene: what is seen.
        record: what sequence.json says of it.
    """
    from rsbench.renderers.visibility import SceneRays

    shutter, period, sensor = card.shutter_for(sequence), card.period_of(sequence), card.sensor_of(sequence)
    motion, seed = card.motion_of(sequence), f"{card.seed_of(sequence)}/{sequence.name}"
    geometry = FixedGeometry(card.rig_of(sequence), shutter, motion, card.frames)
    if "timing" in card.channels:
        write_timing(folder, shutter, period, sensor, card.frames)
    if "instances" in card.channels:
        write_json(folder / INSTANCE_TABLE, {"instances": scene.instances})
    if "imu" in card.channels:
        imu, gravity = card.imu or Imu(), gravity_of(record)
        times = sample_times_ns(imu, shutter, period, sensor, card.frames)
        write_imu(folder, imu, gravity, draw_samples(imu, motion, times, period, gravity, seed))
    if "tracks" in card.channels:
        depths = {view: read_depth(folder / ImageView("rs", *view).depth) for view in views_of(card.frames)}
        tracks = make_tracks(geometry, depths, SceneRays(scene).blocked, seed)
        write_tracks(folder, tracks)
        if "affine" in card.channels:
            save_affine(folder / AFFINE, make_affine(geometry, tracks, SceneRays(scene)))
    if "matches" in card.channels:
        from rsbench.dataset.matches import make_matches, matcher_record

        matching, rays = card.matches or Matching(), SceneRays(scene)
        write_json(folder / MATCHER, matcher_record(matching))
        for first in range(card.frames - 1):
            views = [(side, first + frame) for side, frame in VIEWS]
            images = {view: read_png(folder / ImageView("rs", *view).image) for view in views}
            save_matches(folder / matches_file(first), make_matches(geometry, first, images, matching, rays))
