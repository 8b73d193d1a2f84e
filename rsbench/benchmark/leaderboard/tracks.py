"""All tracks, by name and by protocol; each module of tracks has its own list."""

from __future__ import annotations

from rsbench.benchmark.leaderboard import (
    correction_tracks,
    depth_track,
    motion_tracks,
    readout_tracks,
    rig_tracks,
    trajectory_track,
)
from rsbench.benchmark.leaderboard.track import Track
from rsbench.components.cards import choices
from rsbench.core.errors import RsbenchError

_MODULES = (motion_tracks, rig_tracks, readout_tracks, depth_track, correction_tracks, trajectory_track)
TRACKS: dict[str, Track] = {track.name: track for module in _MODULES for track in module.TRACKS}
"""Tracks by name, in the order of tables."""
_BY_PROTOCOL = {track.id: track for track in TRACKS.values()}


def track_of_name(name: str) -> Track:
    """Return the track with this name, or with the protocol of this name.

    Raises:
        RsbenchError: there is no such track.
    """
    found = _BY_PROTOCOL.get(name) or TRACKS.get(name)
    if found is None:
        raise RsbenchError(f"track {name!r} does not exist{choices(name, TRACKS)}")
    return found


def track_of_id(protocol: str) -> Track:
    """Return the track of a protocol; RsbenchError if there is no such protocol."""
    if protocol not in _BY_PROTOCOL:
        raise RsbenchError(f"protocol = {protocol!r}: does not exist{choices(protocol, _BY_PROTOCOL)}")
    return _BY_PROTOCOL[protocol]
