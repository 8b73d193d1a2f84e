"""Uncertainty of a motion: two drawings (SVG), of the probabilities of its models and of the direction of d, with
captions.

They are made from a motion of motion.json (``rsbench.dataset.corrected_frames.motion_record``).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup, escape
from scipy.special import chdtri

from rsbench.core.so3 import FloatArray

_ACCENT, _GREY, _LINE = "#0b6bcb", "#aab3bd", "#d8dde2"
_WIDE, _ROW, _LEFT, _BAR = 420.0, 24.0, 96.0, 220.0
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
        words = "Probability of each law of motion, given the matches; blue: the law that is used"
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
            f'<text x="{_LEFT - 8}" y="{y + 16}" text-anchor="end"{weight}>{escape(name)}</text>'
            f'<rect x="{_LEFT}" y="{y + 4}" width="{_BAR}" height="{_ROW - 8}" fill="none" stroke="{_LINE}"/>'
            f'<rect x="{_LEFT}" y="{y + 4}" width="{max(_BAR * p, 1.0):.1f}" height="{_ROW - 8}" '
            f'fill="{_ACCENT if name == used else _GREY}"/>'
            f'<text x="{_LEFT + _BAR + 8}" y="{y + 16}">{words}</text>'
        )
    label = "; ".join(f"{name} {p:.3g}" for name, p in probability.items())
    return _svg(_WIDE, _ROW * len(rows), f"probability of the laws of motion: {label}", "".join(rows))


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
