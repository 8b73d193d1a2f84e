"""What ``rsbench correct`` says of a rig's shutter and motion, on the terminal and on its page."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rsbench.cli.console import echo

if TYPE_CHECKING:
    from rsbench.capture.two_frame_estimate import Capture
    from rsbench.core.shutter import RollingShutter

_MOST_LISTED = 8


def write_page_of(
    folder: Path,
    out: Path,
    shutter: RollingShutter,
    capture: Capture | None,
    motion: dict[str, Any] | None,
    cards: list[Any],
    trajectory: dict[str, Any] | None = None,
) -> None:
    from rsbench.report.corrected_page import write_page
    from rsbench.report.motion_figures import sizes

    facts = [("readout ratio", readout_words(shutter, capture))]
    if motion is not None:
        names = "rotation in a frame period", "translation in a frame period"
        facts += zip(names, sizes(motion), strict=True)
        if motion["model_choice"]:
            facts += [("motion model", motion["model_choice"]["text"])]
        facts += [("matches that agree", _agreeing(motion))]
        facts += [("noise of a match", f"{motion['noise_px'] or float('nan'):.2f} px")]
    write_page(
        folder, f"rsbench correct: {out.name}", "Rolling shutter to global shutter", facts, cards, trajectory
    )


def _agreeing(motion: dict[str, Any]) -> str:
    """Of each set, such as "312 of 340 tracks"; sets that the solver did not use are left out."""
    sets = ((name, inliers, motion["matches"][name]) for name, inliers in motion["inliers"].items())
    return ", ".join(f"{inliers} of {matches} {name}" for name, inliers, matches in sets if matches)


def readout_words(shutter: RollingShutter, capture: Capture | None) -> str:
    best = None if capture is None else capture.likeliest
    if capture is None or best is None:
        return f"{shutter.readout_ratio:.3f} (given)"
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
