"""The page of ``rsbench correct``: frames before and after and the uncertainty of a motion, from stored results.

Drawings (SVG) of the probabilities of motion models and of the direction of d are made from a motion of
motion.json (``rsbench.dataset.corrected_frames.motion_record``).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray
from scipy.special import chdtri

from rsbench.core import so3
from rsbench.core.so3 import FloatArray
from rsbench.dataset.corrected_frames import MARKER
from rsbench.report import pictures
from rsbench.report.markup import rendered
from rsbench.report.pictures import Image
from rsbench.storage.files import read_json, write_bytes
from rsbench.storage.videos import SIDEWAYS, UPRIGHT, upright
from rsbench.vision.fusion import Fused, Origin

_WIDE, _HIGH, _LEFT, _TOP = 520.0, 200.0, 64.0, 10.0
_SIGNIFICANT = 3.0
"""Number of standard deviations at which a quantity counts as different from 0."""
_AXIS_COLOURS = {"x": "#c0392b", "y": "#27855a", "z": "#0b6bcb"}


def draw_trajectory(poses: FloatArray, frames: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """Drawings (SVG) of rotation and position, and their caption; None without a trajectory.

    Args:
        poses: (n, 8) of the body at the starts of frames, in TUM's format: tau, position, quaternion.
        frames: the entries of the frames in motion.json.
    """
    if len(poses) < 2:
        return None
    numbers, places, R = poses[:, 0], poses[:, 1:4], so3.from_quaternion(poses[:, [7, 4, 5, 6]])
    turns = so3.log(np.swapaxes(R, 1, 2) @ R[0])
    bridged = [int(frame["number"]) for frame in frames if "skipped" in frame]
    return {
        "whole": True,
        "drawings": [
            _drawing(numbers, np.rad2deg(turns), bridged, "rotation since the first frame (deg)"),
            _drawing(numbers, places, bridged, "position (m)"),
        ],
        "caption": _caption(frames, bridged),
    }


def draw_own_motion(frames: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """Drawings (SVG) of one camera's rotation and direction of translation, and their caption.

    Args:
        frames: the entries of the frames in motion.json.

    Returns:
        As ``draw_trajectory``; None if fewer than two frames have a motion.
    """
    moving = [frame for frame in frames if "w" in (frame.get("motion") or {})]
    if len(moving) < 2:
        return None
    numbers = np.array([float(frame["number"]) for frame in moving])
    w, d = (np.array([frame["motion"][name] for frame in moving]) for name in "wd")
    length = np.linalg.norm(d, axis=1, keepdims=True)
    without = sorted({int(frame["number"]) for frame in frames} - {int(frame["number"]) for frame in moving})
    caption = "Red x, green y, blue z, in the axes of the frames as they are stored: right, down, forward. "
    caption += "One camera shows the direction in which it moves, not how far."
    return {
        "whole": False,
        "drawings": [
            _drawing(numbers, np.rad2deg(w), without, "rotation over a frame period (deg)"),
            _drawing(numbers, d / np.where(length > 0.0, length, 1.0), without, "direction of translation"),
        ],
        "caption": caption + (" Grey: frames without an estimated motion." if without else ""),
    }


def _caption(frames: Sequence[Mapping[str, Any]], bridged: Sequence[int]) -> str:
    motions = [
        motion for frame in frames if (motion := frame.get("motion") or {}).get("covariance_w_d") is not None
    ]
    text = "Red x, green y, blue z."
    if motions:
        # For each frame: deviation along the worst axis, motion, and difference from a uniform motion.
        deviations = [np.sqrt(np.diagonal(np.array(each["covariance_w_d"]))).reshape(2, 3) for each in motions]
        w, d = np.max(np.stack(deviations), axis=2).T
        text += (
            f" Standard deviation of the motion over a frame period, about or along the worst axis: "
            f"{np.rad2deg(np.median(w)):.2g} deg, {1000.0 * np.median(d):.2g} mm in the median; "
            f"{np.rad2deg(np.max(w)):.2g} deg, {1000.0 * np.max(d):.2g} mm at most. {_kind(motions, w, d)}"
        )
    return text + (" Grey: windows that it bridges." if bridged else "")


def _kind(motions: Sequence[Mapping[str, Any]], w: FloatArray, d: FloatArray) -> str:
    """Description of the motion (static, uniform or shaking) by the deviations (n,) of its motions, radians and
    metres."""
    moved = np.array([[np.deg2rad(each["rotation_deg"]), each["translation"]] for each in motions]).T
    uneven = [each["uneven"] for each in motions]
    off = np.array([[np.deg2rad(each["rotation_deg"]), each["translation"]] for each in uneven]).T
    if np.all(np.median(moved / [w, d], axis=1) < _SIGNIFICANT):
        return "The rig stands still."
    verb = "coasts" if np.all(np.median(off / [w, d], axis=1) < _SIGNIFICANT) else "shakes or changes its speed"
    turn, shift = np.median(off, axis=1)
    return (
        f"The rig {verb}: within a period it leaves an even motion by {np.rad2deg(turn):.2g} deg and "
        f"{1000.0 * shift:.2g} mm, root mean square, in the median."
    )


def _drawing(numbers: FloatArray, values: FloatArray, bridged: Sequence[int], title: str) -> Markup:
    """Three lines over the frames, with bars where windows are bridged."""
    low, high = float(np.min(values)), float(np.max(values))
    spread = max(high - low, 1e-9)
    low, high = low - 0.05 * spread, high + 0.05 * spread

    def across(number: FloatArray | float) -> FloatArray:
        return np.asarray(_LEFT + (number - numbers[0]) / (numbers[-1] - numbers[0]) * (_WIDE - _LEFT - 10.0))

    def down(value: FloatArray | float) -> FloatArray:
        return np.asarray(_TOP + (high - value) / (high - low) * (_HIGH - _TOP - 40.0))

    bars = [
        f'<rect x="{across(k):.1f}" y="{_TOP}" width="{across(k + 1.0) - across(float(k)):.1f}" '
        f'height="{_HIGH - _TOP - 40.0}" fill="#c8ced4"/>'
        for k in bridged
        if k < numbers[-1]
    ]
    lines = []
    for column, colour in zip(values.T, _AXIS_COLOURS.values(), strict=True):
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(across(numbers), down(column), strict=True))
        lines.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.8"/>')
    ticks = [
        f'<text x="{_LEFT - 6}" y="{down(each) + 4:.1f}" text-anchor="end">{each:.3g}</text>'
        f'<line x1="{_LEFT}" x2="{_WIDE - 10}" y1="{down(each):.1f}" y2="{down(each):.1f}" stroke="#d8dde2"/>'
        for each in np.linspace(float(np.min(values)), float(np.max(values)), 4)
    ]
    ends = "".join(
        f'<text x="{across(each):.1f}" y="{_HIGH - 14}" text-anchor="middle">{each:.0f}</text>'
        for each in (numbers[0], numbers[-1])
    )
    middle = 0.5 * (_LEFT + _WIDE)
    title = f'<text x="{middle}" y="{_HIGH - 14}" text-anchor="middle">{title}, by frame</text>'
    inner = "".join([*bars, *ticks, *lines, ends, title])
    return Markup(f'<svg viewBox="0 0 {_WIDE} {_HIGH}" font-size="11" role="img">{inner}</svg>')


_COLOURS = {
    Origin.NOBODY: (200, 40, 40),
    Origin.INVENTED: (240, 150, 150),
    Origin.OTHER_FRAME: (240, 170, 60),
    Origin.OTHER_CAMERA: (80, 150, 240),
    Origin.GUESSED: (170, 120, 200),
    Origin.HERE: (225, 228, 230),
}
_LEGEND = {
    Origin.HERE: "visible in this frame",
    Origin.GUESSED: "visible in this frame, depth guessed from neighbours",
    Origin.OTHER_CAMERA: "from the other camera",
    Origin.OTHER_FRAME: "from the other frame",
    Origin.INVENTED: "visible in no frame, filled from its surroundings",
    Origin.NOBODY: "visible in no frame",
}
_LONGEST = 900


_KNOWN = 0.5
"""Least share of pixels with known depth for which the depth is shown."""


def card_of(
    title: str, before: NDArray[Any], fused: Fused, unit: str = " m", orientation: int = UPRIGHT
) -> dict[str, Any]:
    """A frame of the page, with its pictures as URIs that are small enough for many frames; ``unit`` of depth."""
    finite = np.isfinite(fused.depth) & (fused.depth > 0)
    known = float(np.mean(finite))
    inverse = np.where(finite, 1.0 / np.where(finite, fused.depth, 1.0), np.nan)
    low, high = np.percentile(inverse[finite], [1, 99]) if known else (0.0, 1.0)
    origin_picture = np.zeros((*fused.origin.shape, 3), dtype=np.uint8)
    for origin, colour in _COLOURS.items():
        origin_picture[fused.origin == origin] = colour
    shares = fused.shares()
    return {
        "title": title,
        "before": _uri(upright(_eight_bit(before), orientation)),
        "after": _uri(upright(_eight_bit(fused.image), orientation)),
        "origin": _uri(upright(origin_picture, orientation)),
        "depth": _uri(upright(pictures.colour_map(inverse, low, high), orientation)) if known >= _KNOWN else None,
        "near": f"{1.0 / high:.3g}{unit}",
        "far": f"{1.0 / low:.3g}{unit}" if low > 0 else "infinity",
        "shares": [
            {
                "colour": "#{:02x}{:02x}{:02x}".format(*_COLOURS[origin]),
                "text": text,
                "percent": f"{100 * shares[origin.name.lower()]:.2f}",
            }
            for origin, text in _LEGEND.items()
        ],
    }


def write_page(
    folder: Path,
    title: str,
    subtitle: str,
    facts: list[tuple[str, str]],
    cards: list[Any],
    trajectory: dict[str, Any] | None = None,
    *,
    page: Path | None = None,
    record: Mapping[str, Any] | None = None,
    video: str = "",
) -> None:
    """Write report.html, which opens from disk without other files.

    Args:
        trajectory: result of ``draw_trajectory`` or ``draw_own_motion``.
        page: another place for it.
        record: content of motion.json, if it is not in ``folder``.
        video: name of a video beside it that shows the frames before and after.
    """
    record = read_json(folder / MARKER) if record is None else record
    html = rendered(
        "correct.html.j2",
        title=title,
        subtitle=subtitle,
        facts=facts,
        cards=cards,
        trajectory=trajectory,
        video=video,
        apart=_otherwise(record.get("frames", [])),
        certainty=draw_certainty(_one_motion(record)),
        record=json.dumps(record, indent=1)[:20000],
    )
    write_bytes(page or folder / "report.html", html.encode())


_BY_EACH = "corrected by each camera alone: the motion of the rig does not explain the images"


def _otherwise(frames: Any) -> list[tuple[str, str]]:
    """Numbers of the frames that were not corrected or were corrected by each camera alone, with the reason."""
    reasons = dict[str, list[int]]()
    for each in frames if isinstance(frames, list) else []:
        if reason := each.get("reason", _BY_EACH if "alone" in each else ""):
            reasons.setdefault(reason, []).append(each["number"])
    return [(ranges(numbers), why) for why, numbers in reasons.items()]


def ranges(numbers: Sequence[int]) -> str:
    """Increasing numbers as text, such as "0 to 4, 7"."""
    runs = list[list[int]]()
    for number in numbers:
        if runs and runs[-1][-1] == number - 1:
            runs[-1][1:] = [number]
        else:
            runs.append([number])
    return ", ".join(" to ".join(map(str, run)) for run in runs)


_WIDEST, _TALLEST = 1920, 1080
"""Largest width and height of a comparison, px."""
_COARSE = 4
"""Step between pixels at which changes are measured."""


def comparison(
    pairs: Iterable[tuple[NDArray[Any], NDArray[Any]]], orientation: int, changed: list[float]
) -> Iterator[Image]:
    """Frames before and after, side by side in display orientation; their mean difference in grey levels is
    appended to ``changed``."""
    for before, after in pairs:
        scaled_by = None if before.dtype == np.uint8 else np.stack([before, after])
        both = [_eight_bit(each, scaled_by) for each in (before, after)]
        coarse = [each[::_COARSE, ::_COARSE].astype(np.float32) for each in both]
        changed.append(float(np.mean(np.abs(coarse[0] - coarse[1]))))
        stored = before.shape[1::-1]
        wide, tall = stored[::-1] if orientation in SIDEWAYS else stored
        scale = min(_WIDEST / (2 * wide), _TALLEST / tall, 1.0)
        if scale < 1.0:
            size = [2 * max(int(side * scale) // 2, 1) for side in stored]
            both = [np.asarray(cv2.resize(each, size, interpolation=cv2.INTER_AREA), np.uint8) for each in both]
        yield np.hstack([upright(each, orientation) for each in both])


def most_changed(changed: Sequence[float], count: int) -> list[int]:
    """Numbers of the frames that changed most, at most this many, in order and some frames apart."""
    chosen = list[int]()
    apart = max(len(changed) // (4 * count), 1)
    for number in np.argsort(changed)[::-1].tolist():
        if len(chosen) < count and all(abs(number - other) >= apart for other in chosen):
            chosen.append(number)
    return sorted(chosen)


def _one_motion(record: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The motion of four frames, or of the only window of a sequence; None if it has several."""
    if (motion := record.get("motion")) is not None:
        return motion
    found = [each["motion"] for each in record.get("frames", ()) if isinstance(each, dict) and each.get("motion")]
    return found[0] if found and all(each == found[0] for each in found) else None


def _eight_bit(image: NDArray[Any], scaled_by: NDArray[Any] | None = None) -> Image:
    """Convert an image to RGB uint8. 16-bit images, which may use few of their bits, are scaled by the 99.9th
    percentile of the image or of ``scaled_by``."""
    if image.dtype != np.uint8:
        top = max(float(np.percentile(image if scaled_by is None else scaled_by, 99.9)), 1.0)
        image = np.clip(image * (255.0 / top), 0.0, 255.0).astype(np.uint8)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB) if image.ndim == 2 else image, dtype=np.uint8)


def _uri(image: Image) -> str:
    return pictures.jpeg_uri(pictures.encode_jpeg(pictures.shrink(image, _LONGEST)))


_ACCENT, _GREY, _LINE = "#0b6bcb", "#aab3bd", "#d8dde2"
_ODDS_WIDE, _ROW, _ODDS_LEFT, _BAR = 420.0, 24.0, 96.0, 220.0
_SIDE, _INSET = 240.0, 52.0
"""Side of the square for directions, and width of its labels, px."""
_LEAST = 1e-3
"""Smaller probabilities are labelled as less than this."""
_WIDEST_DEG = 30.0
"""Standard deviation at which a direction counts as unknown: the tangent plane then no longer approximates the
sphere."""


def draw_certainty(motion: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    """The drawings of a motion with their captions, without those for which the motion has no data."""
    if motion is None:
        return []
    found, choice = list[dict[str, Any]](), motion.get("model_choice")
    if choice and len(choice["probability"]) > 1:
        words = "Probability of each motion model, given the matches; blue: the model that is used"
        words += "." if choice["decided"] else ", though the matches do not decide."
        found.append({"svg": _odds(choice["probability"], choice["used"]), "caption": words})
    if motion.get("covariance_w_d") is None:
        return found
    d, covariance = np.array(motion["d"]), np.array(motion["covariance_w_d"])[3:, 3:]
    if not np.any(d):
        return found
    _, across, names = direction_covariance(d, covariance)
    sigma = np.sqrt(np.linalg.eigvalsh(across))[::-1]
    words = (
        f"Direction of d, deg from the estimate: standard deviation {sigma[0]:.2g} along the longest axis and "
        f"{sigma[1]:.2g} across. Inner ellipse: one deviation, probability 39 %; outer: 95 %."
    )
    if sigma[0] > _WIDEST_DEG:
        found.append({"svg": Markup(""), "caption": f"The direction of d is unknown: {words}"})
    else:
        found.append({"svg": _ellipses(across, names), "caption": words})
    return found


def sizes(motion: Mapping[str, Any]) -> tuple[str, str]:
    """Rotation and translation of a frame period as text, each with its standard deviation if it is stated."""
    found = list[str]()
    covariance = motion.get("covariance_w_d")
    for part, (key, name, unit) in enumerate((("w", "rotation_deg", "deg"), ("d", "translation", "m"))):
        text, vector = f"{motion[name]:.4f}", np.array(motion[key])
        if covariance is not None and np.any(vector):
            along, own = vector / np.linalg.norm(vector), np.s_[3 * part : 3 * part + 3]
            sigma = float(np.sqrt(along @ np.array(covariance)[own, own] @ along))
            text += f" +- {np.rad2deg(sigma) if part == 0 else sigma:.4f}"
        found.append(f"{text} {unit}")
    return found[0], found[1]


def direction_covariance(d: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray, tuple[str, str]]:
    """The covariance of the direction of a translation, to first order.

    Args:
        d: (3,) translation.
        covariance: (3, 3) of d, in its unit squared.

    Returns:
        Two unit vectors (2, 3) perpendicular to d, the covariance (2, 2) of the direction along them, deg^2, and
            the names of the two body axes that they are closest to.
    """
    ahead = d / np.linalg.norm(d)
    first, second = sorted(np.argsort(np.abs(ahead), kind="stable")[:2])
    across = np.eye(3)[first] - ahead[first] * ahead
    across /= np.linalg.norm(across)
    other = np.cross(ahead, across)
    other *= np.sign(other[second]) or 1.0
    axes = np.stack([across, other])
    slope = np.rad2deg(1.0 / np.linalg.norm(d)) * axes
    return axes, slope @ covariance @ slope.T, ("xyz"[first], "xyz"[second])


def _odds(probability: Mapping[str, float], used: str) -> Markup:
    """A bar for each motion model, the most probable first."""
    rows = []
    for number, (name, p) in enumerate(probability.items()):
        y = _ROW * number
        words = (
            f"{100.0 * p:.1f} %" if _LEAST <= p <= 1.0 - _LEAST else "&lt; 0.1 %" if p < _LEAST else "&gt; 99.9 %"
        )
        weight = ' font-weight="bold"' if name == used else ""
        rows.append(
            f'<text x="{_ODDS_LEFT - 8}" y="{y + 16}" text-anchor="end"{weight}>{escape(name)}</text>'
            f'<rect x="{_ODDS_LEFT}" y="{y + 4}" width="{_BAR}" height="{_ROW - 8}" fill="none" stroke="{_LINE}"/>'
            f'<rect x="{_ODDS_LEFT}" y="{y + 4}" width="{max(_BAR * p, 1.0):.1f}" height="{_ROW - 8}" '
            f'fill="{_ACCENT if name == used else _GREY}"/>'
            f'<text x="{_ODDS_LEFT + _BAR + 8}" y="{y + 16}">{words}</text>'
        )
    label = "; ".join(f"{name} {p:.3g}" for name, p in probability.items())
    return _svg(_ODDS_WIDE, _ROW * len(rows), f"probability of the motion models: {label}", "".join(rows))


def _ellipses(covariance: FloatArray, names: tuple[str, str]) -> Markup:
    """Ellipses of one standard deviation and of 95 % about the estimate; one scale in both directions."""
    values, vectors = np.linalg.eigh(covariance)
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    outline = vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * circle)
    outer = float(np.sqrt(chdtri(2, 0.05)))
    reach = 1.1 * outer * max(float(np.max(np.abs(outline))), 1e-12)
    step = 10.0 ** np.floor(np.log10(reach))
    step = next(float(k * step) for k in (5.0, 2.0, 1.0, 0.5) if k * step <= reach)
    scale, middle = 0.5 * _SIDE / reach, (_INSET + 0.5 * _SIDE, 8.0 + 0.5 * _SIDE)
    parts = [f'<rect x="{_INSET}" y="8" width="{_SIDE}" height="{_SIDE}" fill="none" stroke="{_LINE}"/>']
    for at in (-step, 0.0, step):
        x, y = middle[0] + scale * at, middle[1] - scale * at
        parts.append(
            f'<path d="M{x:.1f} 8v{_SIDE}M{_INSET} {y:.1f}h{_SIDE}" stroke="{_LINE}"/>'
            f'<text x="{x:.1f}" y="{_SIDE + 24}" text-anchor="middle">{at:.3g}</text>'
            f'<text x="{_INSET - 5}" y="{y + 4:.1f}" text-anchor="end">{at:.3g}</text>'
        )
    for factor, opacity in ((outer, 0.15), (1.0, 0.35)):
        points = [
            f"{middle[0] + scale * factor * x:.1f},{middle[1] - scale * factor * y:.1f}" for x, y in outline.T
        ]
        parts.append(
            f'<polygon points="{" ".join(points)}" fill="{_ACCENT}" fill-opacity="{opacity}" stroke="{_ACCENT}"/>'
        )
    parts.append(f'<circle cx="{middle[0]}" cy="{middle[1]}" r="2.5"/>')
    parts.append(f'<text x="{middle[0]}" y="{_SIDE + 40}" text-anchor="middle">deg towards {names[0]}</text>')
    upright = f'transform="translate(12 {middle[1]}) rotate(-90)" text-anchor="middle"'
    parts.append(f"<text {upright}>deg towards {names[1]}</text>")
    return _svg(_INSET + _SIDE + 8.0, _SIDE + 48.0, "ellipses of the direction of d", "".join(parts))


def _svg(wide: float, high: float, label: str, inner: str) -> Markup:
    """A drawing in its own size, at most as wide as its container."""
    return Markup(
        f'<svg viewBox="0 0 {wide:g} {high:g}" width="{wide:g}" style="max-width: 100%" font-size="12" role="img" '
        f'aria-label="{escape(label)}">{inner}</svg>'
    )
