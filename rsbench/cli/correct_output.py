"""What ``rsbench correct`` says of a rig's shutter and motion, on the terminal and on its page."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rsbench.capture.two_frame_estimate import Capture
from rsbench.cli.console import echo
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.report.motion_figures import sizes

_MOST_LISTED = 8
SUBTITLE = "Rolling shutter to global shutter"
UNIT = "length of the translation over one frame period"
"""Unit of the depth of one camera's frames."""


def motion_facts(motion: dict[str, Any] | None) -> list[tuple[str, str]]:
    """What the page of four frames says of their motion."""
    if motion is None:
        return []
    names = "rotation in a frame period", "translation in a frame period"
    facts = [*zip(names, sizes(motion), strict=True)]
    if motion["model_choice"]:
        facts += [("motion model", motion["model_choice"]["text"])]
    # Of each set of matches; those that the solver did not use are left out.
    sets = ((name, inliers, motion["matches"][name]) for name, inliers in motion["inliers"].items())
    agreeing = ", ".join(f"{inliers} of {matches} {name}" for name, inliers, matches in sets if matches)
    noise = f"{motion['noise_px'] or float('nan'):.2f} px"
    return [*facts, ("matches that agree", agreeing), ("noise of a match", noise)]


def camera_facts(record: dict[str, Any]) -> dict[str, str]:
    """Of the record of one camera: its focal length, and the clock of its gyroscope."""
    focal, sigma = f"{record['camera']['fx']:.1f}", record["focal_length_sigma"]
    how = "found"
    if record["focal_length_assumed"]:
        how = "assumed: the width of the image; the frames do not determine it"
    facts = {"focal length": f"{focal} px (given)" if sigma is None else f"{focal} +- {sigma:.1f} px ({how})"}
    clock = record.get("gyro_clock")
    if clock is None:
        return facts
    words = f"{clock['shift']:+.3f} +- {clock['sigma']:.3f} frame periods off, and "
    words += "set right" if clock["used"] else "left as it is"
    if not clock["told"]:
        words = "the frames do not show its offset; give `--gyro-offset`"
    return {**facts, "gyroscope's clock": words}


def readout_words(shutter: RollingShutter, capture: Capture | None, rig: StereoRig) -> str:
    best = None if capture is None else capture.likeliest
    if capture is None or best is None:
        return f"{shutter.readout_ratio:.3f} (given)"
    if not rig.metric:
        side = f"from the {shutter.scan_of('left')}, which is the right side with a probability of"
        return f"{best.ratio:.3f} +- {best.sigma:.3f} (found), {side} {best.probability:.0%}"
    odds = f"probability that the cameras read so {best.probability:.0%}"
    odds += "".join(f"; else {each.scans}" for each in capture.candidates[1:2])
    text = f"{best.ratio:.3f} +- {best.sigma:.3f}, {best.scans} (found, {odds})"
    if not capture.determined and capture.moved_px < 1.0:
        text += f"; matches move by {capture.moved_px:.1f} px, so that it hardly matters"
    if shutter.right_delay:
        text += f"; right camera late by {best.delay:+.3f} +- {best.delay_sigma:.3f} frame periods"
    if capture.offset_sigma > 0.0 and capture.windows == 1:
        text += "; a rig whose calibration errs may err by more than one window says"
    return text


def say_calibration(record: dict[str, Any]) -> None:
    if record["camera_note"]:
        echo(record["camera_note"])
    if record["calibration_note"]:
        echo(f"errors of the calibration, taken from the matches: {record['calibration_note']}")


def listed(frames: Iterable[tuple[int, str]]) -> str:
    """Numbers of frames and why; of many the first ones."""
    words = [f"frame {number} ({why})" for number, why in frames]
    more = [f"and {len(words) - _MOST_LISTED} more, see motion.json"] if len(words) > _MOST_LISTED else []
    return "; ".join(words[:_MOST_LISTED] + more)
