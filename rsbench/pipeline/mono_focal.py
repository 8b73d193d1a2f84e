"""The camera of a video: as its card says, with a focal length that its frames show, or with a stated default."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from numpy.typing import NDArray

from rsbench.capture.self_calibration import FoundFocal, PairFocal, conclude_focal, focal_of_pair
from rsbench.core.camera import PinholeCamera
from rsbench.core.shutter import RollingShutter
from rsbench.pipeline.mono_shutter import matched_pairs
from rsbench.pipeline.one_camera_card import OneCameraCard
from rsbench.solvers.engine.robust_motion import RobustOptions

PAIRS = 5
"""Of frames, at most, by which the focal length is found; they lie evenly over the video."""


def find_camera(
    frames: Iterable[NDArray[Any]],
    count: int,
    card: OneCameraCard,
    shutter: RollingShutter,
    options: RobustOptions,
    seed: int = 0,
    advance: Callable[[str], None] = lambda word: None,
) -> tuple[PinholeCamera, FoundFocal | None]:
    """The camera, and what the frames say of its focal length; None where the card says that.

    Args:
        frames, count, card, options, seed, advance: as of ``find_shutter``.
        shutter: of the camera.

    Raises:
        RsbenchError: fewer than two frames, or frames of two sizes.
    """
    camera, pairs = None, list[PairFocal | None]()
    wanted = PAIRS if card.focal_unknown else 0
    for matches, _, camera in matched_pairs(frames, card, max((count - 1) // PAIRS, 1), wanted, seed):
        if matches is not None:
            pairs.append(focal_of_pair(matches, (camera.width, camera.height), shutter, options, seed))
            advance(f"pair {len(pairs)}")
    assert camera is not None
    if not card.focal_unknown:
        return camera, None
    found = conclude_focal(pairs, camera.width)
    return PinholeCamera.centred(camera.width, camera.height, found.focal), found
