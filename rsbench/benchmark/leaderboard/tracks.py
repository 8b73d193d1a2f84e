"""The list of tracks, by name and by protocol: a track is one class and one line here."""

from __future__ import annotations

from rsbench.benchmark.leaderboard.correction_tracks import (
    CorrectionTrack,
    MonoCorrectionTrack,
    PlacedCorrection,
    SeenCorrection,
)
from rsbench.benchmark.leaderboard.depth_track import DepthTrack
from rsbench.benchmark.leaderboard.motion_tracks import (
    LawsOfPoints,
    LawsOfPoses,
    OwnPoseTrack,
    PointsTrack,
    PoseTrack,
)
from rsbench.benchmark.leaderboard.readout_tracks import DrawnReadout, ReadoutTrack, SkilledReadout
from rsbench.benchmark.leaderboard.track import Track
from rsbench.benchmark.leaderboard.trajectory_track import TrajectoryTrack
from rsbench.components.cards import choices
from rsbench.core.errors import RsbenchError

TRACKS: dict[str, Track] = {
    track.name: track
    for track in (
        LawsOfPoints(),
        PointsTrack(),
        LawsOfPoses(),
        PoseTrack(),
        OwnPoseTrack(),
        SkilledReadout(),
        DrawnReadout(),
        ReadoutTrack(),
        DepthTrack(),
        SeenCorrection(),
        PlacedCorrection(),
        CorrectionTrack(),
        MonoCorrectionTrack(),
        TrajectoryTrack(),
    )
}
"""By name, in the order of tables."""


def track_of_name(name: str) -> Track:
    """A track by its name, or by that of its protocol.

    Raises:
        RsbenchError: there is no such track.
    """
    by_id = {track.id: track for track in TRACKS.values()}
    if name in by_id:
        return by_id[name]
    if name not in TRACKS:
        raise RsbenchError(f"track {name!r} does not exist{choices(name, TRACKS)}")
    return TRACKS[name]


def track_of_id(protocol: str) -> Track:
    """Raises RsbenchError: there is no such protocol."""
    known = {track.id: track for track in TRACKS.values()}
    if protocol not in known:
        raise RsbenchError(f"protocol = {protocol!r}: does not exist{choices(protocol, known)}")
    return known[protocol]
