"""A sequence for the Rerun viewer: the extra ``rsbench[view]``; nothing else imports rerun.

The world is that of the sequence (metres, x right, y down, z forward), and the one timeline is ``time``, seconds:
the rig is shown at its pose at that time. Pixels of Rerun are counted from the corner of the image.

    world/left, world/right               cameras, with a pose at the time of every line
    world/left/image                      the frame on its image plane
    world/lines/left_0                    camera positions of the lines of a frame, yellow to blue in time
    world/points/left_0                   surface points of its depth, each pixel from the pose of its line
    frames/left/rs, gs, depth             frame, its global-shutter twin, and the depth of the frame
    frames/left/matches                   from the pixel in a frame to that in the next one
    frames/left/stereo                    from the pixel in the left frame to that in the right one
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from rsbench.core.rig import SIDES, Side
from rsbench.core.se3 import inverse
from rsbench.core.so3 import quaternion
from rsbench.dataset.layout import picture_file
from rsbench.dataset.sequence import Sequence
from rsbench.interop.writers.match_colours import Scene, Strips, line_seconds
from rsbench.interop.writers.sequence_views import (
    CORNER_PX,
    View,
    corner_matrix,
    first_second,
    line_poses,
    step_of,
    views_in_time,
    world_points,
)
from rsbench.storage.untrusted_files import inside, read_bytes

_FIRST_LINE, _LAST_LINE = np.array([240, 228, 66]), np.array([0, 114, 178])
"""Colours that colour-blind readers can distinguish."""
_PLANE = 0.8
"""Distance of the image from its camera, as drawn, in baselines."""
_LINE_RADIUS, _POINT_RADIUS, _STRIP_RADIUS = 0.005, 1.5, 0.7
"""Sizes of drawn lines and points: the first in baselines, the others in pixels of the screen."""
Progress = Callable[[str], None]


def log_scene(recording: rr.RecordingStream, scene: Scene, progress: Progress = lambda word: None) -> None:
    """Send the whole scene; ``progress`` is called after each image."""
    sequence = scene.sequence
    recording.log("world", rr.ViewCoordinates.RDF, static=True)
    for side in SIDES:
        _log_camera(recording, sequence, side)
    for view in views_in_time(sequence):
        _log_frame(recording, sequence, view)
        _log_lines(recording, sequence, view)
        _log_points(recording, sequence, view, scene.points)
        progress(f"{sequence.name} {view.side} {view.frame}")
    _log_matches(recording, sequence, scene.strips)


def blueprint() -> rrb.Blueprint:
    """Return the layout of the viewer: the world next to tabs for both cameras."""
    cameras = [rrb.Tabs(*_tabs(side), name=f"{side} camera") for side in SIDES]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="world", name="world"), rrb.Vertical(*cameras), column_shares=[3.0, 2.0]
        ),
        collapse_panels=True,
    )


def _tabs(side: Side) -> list[rrb.Spatial2DView]:
    shown = {"frame": ["rs"], "matches": ["rs", "matches"], "stereo": ["rs", "stereo"]}
    shown |= {"global shutter": ["gs"], "depth": ["depth"]}
    if side == "right":
        del shown["stereo"]  # these are drawn on the left frames
    return [
        rrb.Spatial2DView(
            origin=f"frames/{side}", contents=[f"$origin/{part}" for part in parts], name=f"{side} {name}"
        )
        for name, parts in shown.items()
    ]


def _log_camera(recording: rr.RecordingStream, sequence: Sequence, side: Side) -> None:
    """Log a camera and its pose at the time of every line of every frame."""
    camera = sequence.rig.sensor(side)
    recording.log(
        f"world/{side}",
        rr.Pinhole(
            image_from_camera=corner_matrix(camera),
            resolution=[camera.width, camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=_PLANE * sequence.rig.baseline,
        ),
        static=True,
    )
    for frame in range(sequence.frames):
        view = View(side, frame)
        world_from_cam = inverse(line_poses(sequence, view))
        recording.send_columns(
            f"world/{side}",
            indexes=[rr.TimeColumn("time", duration=line_seconds(sequence, view))],
            columns=rr.Transform3D.columns(
                translation=world_from_cam.t, quaternion=np.roll(quaternion(world_from_cam.R), -1, axis=-1)
            ),
        )


def _log_frame(recording: rr.RecordingStream, sequence: Sequence, view: View) -> None:
    recording.set_time("time", duration=first_second(sequence, view))
    frame = f"frames/{view.side}"
    for shutter, places in (("rs", (f"{frame}/rs", f"world/{view.side}/image")), ("gs", (f"{frame}/gs",))):
        file = inside(sequence.folder, picture_file(shutter, view.side, view.frame + sequence.first))
        for place in places:
            recording.log(place, rr.EncodedImage(contents=read_bytes(file), media_type="image/png"))
    recording.log(f"{frame}/depth", rr.DepthImage(sequence.depth("rs", view.side, view.frame), meter=1.0))


def _log_lines(recording: rr.RecordingStream, sequence: Sequence, view: View) -> None:
    """Log the positions of a camera during the readout of a frame."""
    places, seconds = inverse(line_poses(sequence, view)).t, line_seconds(sequence, view)
    late = (seconds - seconds.min()) / max(float(np.ptp(seconds)), 1e-12)
    colours = (_FIRST_LINE + late[:, None] * (_LAST_LINE - _FIRST_LINE)).astype(np.uint8)
    name = f"world/lines/{view.side}_{view.frame}"
    recording.set_time("time", duration=first_second(sequence, view))
    recording.log(name, rr.Points3D(places, colors=colours, radii=_LINE_RADIUS * sequence.rig.baseline))


def _log_points(recording: rr.RecordingStream, sequence: Sequence, view: View, most: int) -> None:
    found = world_points(sequence, view, "rs", step_of(sequence.rig.sensor(view.side), most))
    name = f"world/points/{view.side}_{view.frame}"
    recording.log(name, rr.Points3D(found.world, colors=found.colours, radii=rr.Radius.ui_points(_POINT_RADIUS)))


def _log_matches(recording: rr.RecordingStream, sequence: Sequence, strips: Iterable[Strips]) -> None:
    names = set[str]()
    for each in strips:
        name = f"frames/{each.view.side}/{each.name}"
        if name not in names:  # an entry stays visible until the next one
            for view in views_in_time(sequence):
                recording.set_time("time", duration=first_second(sequence, view))
                recording.log(name, rr.LineStrips2D([]))
            names.add(name)
        recording.set_time("time", duration=first_second(sequence, each.view))
        drawn: Any = each.pixels + CORNER_PX
        radii = rr.Radius.ui_points(_STRIP_RADIUS)
        recording.log(name, rr.LineStrips2D(drawn, colors=each.colours, radii=radii))


def write_recording(scene: Scene, path: Path, progress: Progress) -> None:
    """Write a file that ``rerun PATH`` opens."""
    with rr.RecordingStream("rsbench", recording_id=scene.sequence.name) as recording:
        recording.save(path, default_blueprint=blueprint())
        log_scene(recording, scene, progress)


def open_viewer(scene: Scene, progress: Progress) -> None:
    """Open the viewer with a sequence; an open viewer gets another recording."""
    with rr.RecordingStream("rsbench", recording_id=scene.sequence.name) as recording:
        recording.spawn(default_blueprint=blueprint())
        log_scene(recording, scene, progress)
