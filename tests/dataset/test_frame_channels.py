"""Channels of whole sequences of four frames: what tells of the later ones is checked as is the rest."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic_dataset import PLANES, add_channels, card_of, write_analytic_dataset
from attack.planting import named, spoilt
from frame_faults import FAULTS
from numpy.typing import NDArray

from rsbench.components.motion_models import AcceleratedMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import StereoRig, views_of
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.dataset.channels import Channel, write_sequence_channels
from rsbench.dataset.generation import sequence_truth
from rsbench.dataset.point_channels import track_views
from rsbench.dataset.sequence import read_sequence
from rsbench.renderers import visibility
from rsbench.renderers.visibility import Surfaces
from rsbench.storage.files import read_json
from rsbench.verification import verify_dataset

RIG = StereoRig(camera=PinholeCamera.centred(96, 80, 110.0), baseline=0.3)
SHUTTER = RollingShutter(height=80, readout_ratio=0.9)
MOTION = AcceleratedMotion([0.02, -0.03, 0.01], [0.1, -0.05, 0.2], acceleration=0.1)
COUNT = 4
SAMPLE = list(FAULTS)[::4]
"""``python -m attack.verifying`` plants all of them into rendered frames."""
CHANNELS: tuple[Channel, ...] = ("timing", "imu", "tracks", "affine", "matches")


class PlaneRays:
    """Rays that meet the planes, as ``renderers.segments.SceneRays`` meets meshes."""

    def __init__(self, scene: object) -> None:
        pass

    def shares(self, eyes: FloatArray, points: FloatArray) -> FloatArray:
        """(n, planes) of the way to the points at which each plane is met; inf behind the eye."""
        way = [(offset - eyes @ normal, (points - eyes) @ normal) for normal, offset in PLANES]
        met = np.stack([near / along for near, along in way], axis=1)
        return np.where(met > 0, met, np.inf)

    def share(self, eyes: FloatArray, points: FloatArray) -> FloatArray:
        return np.min(self.shares(eyes, points), axis=1)

    def blocked(self, eyes: FloatArray, points: FloatArray) -> NDArray[np.bool_]:
        return self.share(eyes, points) < 1 - 1e-4

    def surfaces(self, eyes: FloatArray, points: FloatArray) -> Surfaces:
        nearest = np.argmin(self.shares(eyes, points), axis=1)
        normals = np.array([normal / np.linalg.norm(normal) for normal, _ in PLANES])[nearest]
        away = np.sum(normals * (points - eyes), axis=1) > 0
        normals[away] *= -1.0
        return Surfaces(normals.astype(np.float32), np.zeros(len(eyes), np.uint16))


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four frames of two planes with all channels of whole sequences, by what writes them of rendered ones."""
    out = tmp_path_factory.mktemp("channels") / "data"
    write_analytic_dataset(out, RIG, SHUTTER, MOTION, frames=COUNT)
    card = replace(card_of(RIG, SHUTTER, MOTION, COUNT), channels=CHANNELS)
    scene = read_json(out / "planes/sequence.json")["scene"]

    def write(folder: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(visibility, "SceneRays", PlaneRays)
            whole = sequence_truth(folder, card, card.sequence[0], None, scene)  # pyrefly: ignore[bad-argument-type]
            write_sequence_channels(card.channels, whole)

    add_channels(out, card, write)
    return out


def test_sound_channels_have_no_faults(sound: Path) -> None:
    assert [report.faults for report in verify_dataset(sound, 3)] == [()]


def test_tracks_are_where_rays_from_every_frame_meet_them(sound: Path) -> None:
    """By the rays of their pixels at the stated times, and not by the row equation that made them."""
    sequence = read_sequence(sound / "planes")
    tracks = sequence.tracks()
    views = track_views(COUNT)
    assert set(tracks.sources) == set(range(len(views))) and set(views) == set(views_of(COUNT))
    for k, (side, frame) in enumerate(views):
        seen = np.isfinite(tracks.tau[:, k])
        assert np.sum(seen) > 500
        tau = tracks.tau[seen, k]
        # The row that is read at this time: a readout ratio of the frame period, all rows.
        np.testing.assert_allclose((tau - frame) / 0.9 * 80, tracks.pixels[seen, k, 1], rtol=0, atol=1e-6)
        R, t = RIG.cam_from_world(MOTION, tau, side)
        x_in_cam = np.einsum("nij,nj->ni", R, tracks.points[seen]) + t
        pixels = 110.0 * x_in_cam[:, :2] / x_in_cam[:, 2:] + [47.5, 39.5]
        np.testing.assert_allclose(pixels, tracks.pixels[seen, k], rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", SAMPLE)
def test_a_fault_beyond_the_first_two_frames_is_named(sound: Path, tmp_path: Path, name: str) -> None:
    plant, words = FAULTS[name]
    faults = verify_dataset(spoilt(sound, tmp_path / "data", plant, sequence="planes"), 3)[-1].faults
    assert named(faults, words), faults
    assert not any(fault.startswith(("sequence.json", "rs", "gs", "poses")) for fault in faults), faults
