"""Matches of four frames of a rig: found, or refused with the reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rsbench.capture.calibration import RefusedFramesError, check_rig
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import Scanning
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.frame_depth import Images
from rsbench.vision.feature_matcher import find_correspondences
from rsbench.vision.features import ROW_TOLERANCE_PX, SiftMatcher
from rsbench.vision.images import eight_bit

_FEWEST_MATCHES = 12


def find_matches(
    images: Images,
    options: CorrectionOptions,
    sides: tuple[Side, Side] = SIDES,
    camera: PinholeCamera | None = None,
) -> Correspondences:
    """Correspondences of the four frames, whatever they are; ``sides`` says which images are taken for the left's.

    Those of frames that have the lens of ``camera`` are in their pixels.

    Raises:
        RsbenchError: another package's feature matcher failed, see ``find_correspondences``.
    """
    levels = eight_bit([images[side, frame] for frame in (0, 1) for side in sides])
    names = [(side, frame) for frame in (0, 1) for side in SIDES]
    return find_correspondences(options.features, dict(zip(names, levels, strict=True)), camera)


def find_matches_of_rig(
    images: Images, rig: StereoRig, scanning: Scanning, options: CorrectionOptions
) -> Correspondences:
    """``find_matches`` of cameras as they are, in pixels of their images.

    Other matchers see images without distortion. Where the cameras do not read rows together, a left-right match
    is of two times, and its ends of two rows: rsbench's own looks for it anywhere, and of others, which may look
    along the row, only matches over time are kept.

    Raises:
        RsbenchError: another package's feature matcher failed, see ``find_correspondences``.
    """
    component = options.features.component
    if not scanning.rows_together and isinstance(component, SiftMatcher):
        apart = replace(options.features, component=replace(component, row_tolerance=None))
        options = replace(options, features=apart)
    matches = find_matches(images, options, camera=rig.camera)
    if scanning.rows_together or isinstance(component, SiftMatcher):
        return matches
    return Correspondences(left=matches.left, right=matches.right)


def match_frames(
    images: Images,
    rig: StereoRig,
    options: CorrectionOptions,
    scanning: Scanning | None = None,
    *,
    judge_rig: bool = True,
) -> Correspondences:
    """``find_matches_of_rig`` of frames that a user says to be those of a rig.

    Args:
        scanning: how the cameras read; None: rows from the top, both at once.
        judge_rig: whether to look if frame 0 is a rectified pair in the right order.

    Raises:
        RefusedFramesError: no texture, sides exchanged, not rectified, or not of one time.
    """
    scanning = scanning or Scanning()
    if judge_rig and scanning.rows_together:
        check_rig(images["left", 0], images["right", 0], rig)
    return _enough(find_matches_of_rig(images, rig, scanning, options))


def with_enough(options: CorrectionOptions, tracks: int) -> CorrectionOptions:
    """The same options, but for rsbench's own matcher giving tracks alone where there are as many as that."""
    component = options.features.component
    if not isinstance(component, SiftMatcher):
        return options
    return replace(options, features=replace(options.features, component=replace(component, enough_tracks=tracks)))


def match_unknown(
    images: Images, rig: StereoRig, options: CorrectionOptions, *, judge_rig: bool = True
) -> tuple[Correspondences, RefusedFramesError | None]:
    """``match_frames`` of cameras that may read in any way, and what speaks against a pair that reads as one.

    Raises:
        RefusedFramesError: no texture.
    """
    doubt = None
    try:
        if judge_rig:
            check_rig(images["left", 0], images["right", 0], rig)
    except RefusedFramesError as error:
        doubt = error
    anyhow = isinstance(options.features.component, SiftMatcher)
    scanning = Scanning(scan="left") if anyhow else Scanning()
    return _enough(find_matches_of_rig(images, rig, scanning, options)), doubt


def on_their_rows(matches: Correspondences, rig: StereoRig) -> Correspondences:
    """Without tracks whose left-right ends are not on one row, of cameras that read rows together."""
    tracks = rig.camera.ideal_pixels(matches.tracks.reshape(-1, 2)).reshape(-1, 8)
    off = np.maximum(np.abs(tracks[:, 1] - tracks[:, 3]), np.abs(tracks[:, 5] - tracks[:, 7]))
    return replace(matches, tracks=matches.tracks[off <= ROW_TOLERANCE_PX])


def _enough(matches: Correspondences) -> Correspondences:
    temporal = max(len(matches.left) + len(matches.right), 2 * len(matches.tracks))
    if temporal < _FEWEST_MATCHES:
        raise RefusedFramesError(
            f"only {temporal} matches between the two times; {_FEWEST_MATCHES} are needed: the frames show no "
            "texture, or not the same scene"
        )
    return matches
