"""Drawings of the leaderboard as SVG: intervals in a table, and scores against what the problems are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from markupsafe import Markup, escape

from rsbench.core.so3 import FloatArray

_BAR = 90
_WIDTH, _HEIGHT = 330, 210
_LEFT, _BOTTOM, _TOP, _RIGHT = 36, 24, 8, 18
_BINS = 5
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#8a6d00", "#56b4e9")
"""Okabe and Ito's, which people with any colour vision tell apart; dashes and marks differ too."""
_DASHES = ("", "6 3", "2 2", "8 3 2 3", "1 3", "10 4")
MOST_LINES = len(_COLOURS)


def bar(value: float, low: float, high: float) -> Markup:
    """A value in [0, 1] with its interval; what it shows stands beside it as text."""
    x, a, b = (1.0 + _BAR * min(max(each, 0.0), 1.0) for each in (value, low, high))
    return Markup(
        f'<svg width="{_BAR + 2}" height="12" aria-hidden="true"><path d="M1 6H{_BAR + 1}" stroke="currentColor" '
        f'stroke-opacity=".2"/><path d="M{a:.1f} 6H{b:.1f}M{a:.1f} 3v6M{b:.1f} 3v6" stroke="currentColor" '
        f'fill="none"/><circle cx="{x:.1f}" cy="6" r="3" fill="currentColor"/></svg>'
    )


def curves(facts: pd.Series, scores: Mapping[str, FloatArray]) -> Markup | None:
    """Mean scores in parts of the problems, by a number that they have: its values where few, else fifths.

    Args:
        facts: (n,) numbers of the problems.
        scores: (n,) in [0, 1], by the name of the entry; the first ``MOST_LINES`` are drawn.

    Returns:
        None where the problems have fewer than two values.
    """
    values = facts.to_numpy(dtype=np.float64)
    different = np.unique(values)
    if len(different) < 2:
        return None
    if len(different) <= _BINS:
        part = np.searchsorted(different, values)
    else:
        inner = np.quantile(values, np.linspace(0.0, 1.0, _BINS + 1)[1:-1])
        part = np.searchsorted(inner, values, side="right")
    used = np.unique(part)
    centres = np.array([np.median(values[part == k]) for k in used])
    lines = {
        name: np.array([np.mean(each[part == k]) for k in used])
        for name, each in list(scores.items())[:MOST_LINES]
    }
    return _drawn(centres, lines)


def _drawn(x: FloatArray, lines: Mapping[str, FloatArray]) -> Markup:
    logarithmic = x[0] > 0.0 and x[-1] > 8.0 * x[0]
    place = np.log(x) if logarithmic else x
    across = _LEFT + (_WIDTH - _LEFT - _RIGHT) * (place - place[0]) / max(place[-1] - place[0], 1e-12)
    height = _HEIGHT + 14 * len(lines)
    words = "; ".join(f"{name}: {', '.join(f'{y:.2f}' for y in ys)}" for name, ys in lines.items())
    at = ", ".join(f"{each:.3g}" for each in x)
    parts = [
        f'<svg width="{_WIDTH}" height="{height}" role="img" aria-label="{escape(f"at {at}: {words}")}">',
        *_axes(x, across),
    ]
    for k, (name, ys) in enumerate(lines.items()):
        points = [(float(a), _down(float(y))) for a, y in zip(across, ys, strict=True)]
        path = " ".join(f"{a:.1f},{b:.1f}" for a, b in points)
        stroke = f'stroke="{_COLOURS[k]}" stroke-width="2" stroke-dasharray="{_DASHES[k]}" fill="none"'
        parts.append(f'<polyline points="{path}" {stroke}/>')
        parts += [f'<circle cx="{a:.1f}" cy="{b:.1f}" r="2.5" fill="{_COLOURS[k]}"/>' for a, b in points]
        y = _HEIGHT + 10 + 14 * k
        parts.append(
            f'<path d="M{_LEFT} {y - 4}h30" {stroke}/><text x="{_LEFT + 36}" y="{y}">{escape(name)}</text>'
        )
    return Markup("".join(parts) + "</svg>")


def _down(score: float) -> float:
    return _TOP + (1.0 - score) * (_HEIGHT - _TOP - _BOTTOM)


def _axes(x: FloatArray, across: FloatArray) -> Sequence[str]:
    marks = [
        f'<path d="M{_LEFT} {_down(y):.1f}H{_WIDTH - _RIGHT}" stroke="currentColor" stroke-opacity=".2"/>'
        f'<text x="{_LEFT - 6}" y="{_down(y) + 4:.1f}" text-anchor="end">{y:g}</text>'
        for y in (0.0, 0.25, 0.5, 0.75, 1.0)
    ]
    ticks = [
        f'<text x="{float(a):.1f}" y="{_HEIGHT - 8}" text-anchor="middle">{float(value):.3g}</text>'
        for a, value in zip(across, x, strict=True)
    ]
    return marks + ticks
