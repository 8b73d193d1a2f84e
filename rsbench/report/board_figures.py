"""SVG figures of results: values with intervals, errors by property of the problems, and calibration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pandas as pd
from markupsafe import Markup, escape
from numpy.typing import NDArray

from rsbench.benchmark.leaderboard.deviations import LEVELS, Triple
from rsbench.benchmark.statistics import Interval, median_interval, typical_interval
from rsbench.core.so3 import FloatArray

_BAR = 90
_WIDTH, _HEIGHT = 300, 190
_LEFT, _BOTTOM, _TOP, _RIGHT = 44, 24, 8, 12
_BINS = 5
_APART = 2.5
"""Horizontal distance, px, between the intervals of two entries at one value."""
_SEED = 0
_DASHES = ("", "6 3", "2 2", "8 3 2 3", "1 3", "10 4")
_MARKS = (
    "M-3 0a3 3 0 1 0 6 0a3 3 0 1 0 -6 0",
    "M-3 -3h6v6h-6z",
    "M0 -4L4 3H-4z",
    "M0 -4L4 0L0 4L-4 0z",
    "M0 4L4 -3H-4z",
    "M-3 -3L3 3M-3 3L3 -3",
)
"""Marks. The colours of board.css.j2 suit any colour vision; entries differ in marks and dashes too."""
MOST_LINES = len(_MARKS)
_NOTHING = 1e-6
"""Median error below which an oracle is not drawn, as it would stretch the axis."""


class ErrorLine(NamedTuple):
    """The errors of an entry, drawn as one line."""

    name: str
    errors: FloatArray
    """(n,) in the order of the problems."""
    grey: bool
    """Whether it is an oracle, drawn in grey."""


@dataclass(frozen=True, kw_only=True)
class _Curve:
    name: str
    style: str
    dash: str
    mark: str
    at: FloatArray
    """Medians (parts,)."""
    ends: FloatArray
    """Ends (parts, 2) of their intervals; infinite if there are too few values for an interval."""


@dataclass(frozen=True, kw_only=True)
class _Axis:
    """Vertical axis: converts scores to px from the top."""

    low: float
    high: float
    logarithmic: bool = False

    def down(self, value: float) -> float:
        return _TOP + (1.0 - self.share(value)) * (_HEIGHT - _TOP - _BOTTOM)

    def share(self, value: float) -> float:
        """Position of a value between the ends of the axis, 0 to 1."""
        low, high, at = (self._place(x) for x in (self.low, self.high, min(max(value, self.low), self.high)))
        return (at - low) / (high - low)

    def _place(self, value: float) -> float:
        return math.log10(value) if self.logarithmic else value

    def ticks(self) -> list[float]:
        if not self.logarithmic:
            size = 10.0 ** math.floor(math.log10(self.high))
            step = next(k * size for k in (0.1, 0.2, 0.25, 0.5, 1.0, 2.0) if self.high < 6.0 * k * size)
            return [float(x) for x in np.arange(0.0, self.high * (1.0 + 1e-9), step)]
        decades = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        for steps in ((1, 2, 5), (1, 3), (1,)):
            found = [k * 10.0**e for e in decades for k in steps if self.low <= k * 10.0**e <= self.high]
            if len(found) <= 6:
                break
        return found


def bar(value: float, low: float, high: float) -> Markup:
    """Draw a value in [0, 1] with its interval; hidden from screen readers, as a text beside it has the number."""
    x, a, b = (1.0 + _BAR * min(max(each, 0.0), 1.0) for each in (value, low, high))
    return Markup(
        f'<svg width="{_BAR + 2}" height="12" aria-hidden="true"><path d="M1 6H{_BAR + 1}" stroke="currentColor" '
        f'stroke-opacity=".2"/><path d="M{a:.1f} 6H{b:.1f}M{a:.1f} 3v6M{b:.1f} 3v6" stroke="currentColor" '
        f'fill="none"/><circle cx="{x:.1f}" cy="6" r="3" fill="currentColor"/></svg>'
    )


# Curves


def legend(lines: Sequence[ErrorLine]) -> Markup:
    """Legend: the line and mark of each entry."""
    items = []
    for line, (style, dash, mark) in zip(lines, _styles(lines), strict=True):
        drawn = f'<path d="M0 7h34" {_stroke(style, dash)}/>{_mark(17.0, 7.0, style, mark)}'
        items.append(f'<li><svg width="34" height="14" aria-hidden="true">{drawn}</svg> {escape(line.name)}</li>')
    return Markup('<ul class="legend">' + "".join(items) + "</ul>")


def drawable(lines: Sequence[ErrorLine]) -> list[ErrorLine]:
    """Select the first ``MOST_LINES`` entries, and all oracles with errors."""
    ranked = [line for line in lines if not line.grey][:MOST_LINES]
    return ranked + [line for line in lines if line.grey and np.median(line.errors) > _NOTHING]


def curves(facts: pd.Series, lines: Sequence[ErrorLine], scenes: Sequence[str]) -> Markup | None:
    """Draw median errors with intervals by a property: one point for each word or value, or for fifths if many.

    Args:
        facts: (n,) property of each problem, numbers or words.
        lines: result of ``drawable``.
        scenes: (n,) scene of each problem; if a scene has several, bootstrap intervals resample whole scenes.

    Returns:
        None if the property has fewer than two different values.
    """
    parts = _parts(facts)
    if parts is None or not lines:
        return None
    part, labels = parts
    clusters = np.asarray(scenes) if len(set(scenes)) < len(scenes) else None
    drawn = []
    for line, (style, dash, mark) in zip(lines, _styles(lines), strict=True):
        found = [_typical(line.errors, part == k, clusters) for k in range(len(labels))]
        at, ends = np.array([each[0] for each in found]), np.array([each[1:] for each in found])
        drawn.append(_Curve(name=line.name, style=style, dash=dash, mark=mark, at=at, ends=ends))
    return _drawn(labels, drawn)


def _parts(facts: pd.Series) -> tuple[NDArray[np.intp], Sequence[float | str]] | None:
    """Group the problems: the group of each, and the label of each group, a word, value or median."""
    if not pd.api.types.is_numeric_dtype(facts):
        words, part = np.unique(facts.astype(str).to_numpy(), return_inverse=True)
        return None if len(words) < 2 else (part, [str(word) for word in words])
    values = facts.to_numpy(dtype=np.float64)
    different = np.unique(values)
    if len(different) < 2 or not np.all(np.isfinite(values)):
        return None
    if len(different) <= _BINS:
        return np.searchsorted(different, values), different.tolist()
    inner = np.quantile(values, np.linspace(0.0, 1.0, _BINS + 1)[1:-1])
    _, part = np.unique(np.searchsorted(inner, values, side="right"), return_inverse=True)
    return part, [float(np.median(values[part == k])) for k in range(part.max() + 1)]


def _typical(errors: FloatArray, where: NDArray[np.bool_], clusters: NDArray[np.str_] | None) -> Triple:
    inside = np.sort(errors[where])
    if clusters is None or len(set(clusters[where])) < 2:  # problems of one scene are independent
        low, high = (inside[int(k)] if np.isfinite(k) else k for k in _bracket(len(inside)))
    else:
        low, high = typical_interval(errors[where], _SEED, clusters[where].tolist())
    return float(np.median(inside)), float(low), float(high)


@lru_cache
def _bracket(n: int) -> Interval:
    """Ranks, from 0, of the ends of the exact interval of a median of n values; infinite if there is none."""
    return median_interval(np.arange(n))


def _styles(lines: Sequence[ErrorLine]) -> list[tuple[str, str, str]]:
    """Colour, dash and mark of each entry."""
    coloured = iter([(f"var(--c{k})", _DASHES[k], _MARKS[k]) for k in range(MOST_LINES)])
    return [("var(--grey)", "", "") if line.grey else next(coloured) for line in lines]


def _drawn(labels: Sequence[float | str], drawn: Sequence[_Curve]) -> Markup:
    across, axis = _across(labels), _axis(drawn)
    words = "; ".join(f"{each.name}: {', '.join(f'{y:.3g}' for y in each.at)}" for each in drawn)
    at = ", ".join(_word(each) for each in labels)
    parts = [
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" width="{_WIDTH}" height="{_HEIGHT}" role="img" '
        f'aria-label="{escape(f"median errors at {at}: {words}")}">',
        *_frame(labels, across, axis),
    ]
    for k, each in enumerate(drawn):
        shift = _APART * (k - 0.5 * (len(drawn) - 1))
        places = [(float(a) + shift, axis.down(float(y))) for a, y in zip(across, each.at, strict=True)]
        if not isinstance(labels[0], str):
            path = "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in places)
            parts.append(f'<path d="{path}" {_stroke(each.style, each.dash)}/>')
        bars = "".join(
            f"M{a:.1f} {axis.down(high):.1f}V{axis.down(low):.1f}"
            for (a, _), (low, high) in zip(places, each.ends, strict=True)
            if np.isfinite(low) and np.isfinite(high)
        )
        parts.append(f'<path d="{bars}" style="stroke:{each.style}" fill="none"/>')
        parts += [_mark(a, b, each.style, each.mark) for a, b in places]
    return Markup("".join(parts) + "</svg>")


def _across(labels: Sequence[float | str]) -> FloatArray:
    """Horizontal positions of the groups, px."""
    words = isinstance(labels[0], str)
    inset = 0.5 * (_WIDTH - _LEFT - _RIGHT) / len(labels) if words else 12.0
    x = np.array([k if isinstance(label, str) else label for k, label in enumerate(labels)], dtype=np.float64)
    if not words and x[0] > 0.0 and x[-1] > 5.0 * x[0]:
        x = np.log(x)
    return _LEFT + inset + (_WIDTH - _LEFT - _RIGHT - 2.0 * inset) * (x - x[0]) / (x[-1] - x[0])


def _axis(drawn: Sequence[_Curve]) -> _Axis:
    """Axis that contains all medians and the finite ends of their intervals; logarithmic if all are positive and
    differ by a factor of 3 or more."""
    every = np.concatenate([np.concatenate([each.at, each.ends.ravel()]) for each in drawn])
    known = every[np.isfinite(every)]
    low, high = float(np.min(known)), float(np.max(known))
    if low <= 0.0 or high < 3.0 * low:
        return _Axis(low=0.0, high=max(high, 1e-9), logarithmic=False)
    return _Axis(low=low / 1.1, high=high * 1.1, logarithmic=True)


def _frame(labels: Sequence[float | str], across: FloatArray, axis: _Axis) -> list[str]:
    marks = [
        f'<path d="M{_LEFT} {axis.down(y):.1f}H{_WIDTH - _RIGHT}" stroke="currentColor" stroke-opacity=".2"/>'
        f'<text x="{_LEFT - 5}" y="{axis.down(y) + 4:.1f}" text-anchor="end">{y:.3g}</text>'
        for y in axis.ticks()
    ]
    last = -math.inf
    for a, label in zip(across, labels, strict=True):
        word = _word(label)
        if a - last >= 6.0 * len(word) + 4.0:  # enough room
            last = float(a)
            marks.append(f'<text x="{a:.1f}" y="{_HEIGHT - 7}" text-anchor="middle">{escape(word)}</text>')
    return marks


def _word(label: float | str) -> str:
    return label if isinstance(label, str) else short(label)


def short(value: float) -> str:
    """Format a number with two digits, or from 100 on without decimals."""
    return f"{value:.2g}" if abs(value) < 100.0 else f"{value:.0f}"


def _stroke(style: str, dash: str) -> str:
    return f'style="stroke:{style}" stroke-width="1.6" stroke-dasharray="{dash}" fill="none"'


def _mark(a: float, b: float, style: str, mark: str) -> str:
    if not mark:
        return ""
    return f'<path transform="translate({a:.1f} {b:.1f})" d="{mark}" style="stroke:{style};fill:{style}"/>'


# Calibration


def reliability(covers: Sequence[Triple]) -> Markup:
    """Draw the share of true values within the stated ellipsoid of each level, against the level."""
    side, width = 150.0, 190

    def place(x: float, y: float) -> str:
        return f"{34.0 + side * x:.1f} {8.0 + side * (1.0 - y):.1f}"

    words = "; ".join(f"{100 * at:.0f} %: {100 * x[0]:.0f} %" for at, x in zip(LEVELS, covers, strict=True))
    parts = [
        f'<svg width="{width}" height="{width - 4}" role="img" '
        f'aria-label="{escape(f"levels and shares: {words}")}">',
        f'<path d="M{place(0, 0)}L{place(1, 1)}" stroke="currentColor" stroke-opacity=".4" fill="none"/>',
    ]
    for level in (0.0, 0.5, 0.9, 1.0):
        parts.append(
            f'<path d="M{place(level, 0)}L{place(level, 1)}M{place(0, level)}L{place(1, level)}" '
            'stroke="currentColor" stroke-opacity=".15"/>'
        )
        if level != 0.9:
            parts.append(f'<text x="28" y="{12.0 + side * (1.0 - level):.0f}" text-anchor="end">{level:g}</text>')
            parts.append(f'<text x="{34.0 + side * level:.0f}" y="176" text-anchor="middle">{level:g}</text>')
    for level, (share, low, high) in zip(LEVELS, covers, strict=True):
        parts.append(
            f'<path d="M{place(level, max(low, 0.0))}L{place(level, min(high, 1.0))}" stroke="currentColor"/>'
        )
        x, y = place(level, share).split()
        parts.append(f'<circle cx="{x}" cy="{y}" r="3" fill="currentColor"/>')
    return Markup("".join(parts) + "</svg>")


# Plots of dots with intervals, a row for each compared item, for pages of results

_PLOT, _ROW, _HEAD, _INSET = 540, 20, 34, 12
"""Width, height of a row, height of titles, inset of a panel, px; on a phone, letters of 12 px have 8 px."""
_SERIES = (("#0072b2", _MARKS[0]), ("#c44e00", _MARKS[1]))
_INK = (
    "text{font:12px system-ui,sans-serif;fill:#1d2126;paint-order:stroke;stroke:#fff;stroke-width:4px}"
    ".h{font-weight:600}.s{fill:#56606b}"
)


class DotRow(NamedTuple):
    """A row of a plot of dots; a row without values is a heading of the rows below."""

    label: str
    values: Sequence[Sequence[Triple]] = ()
    """For each panel, the value of each series with the ends of its interval; NaN if there is none."""


class DotPanel(NamedTuple):
    """A panel of a plot of dots."""

    title: str
    scale: str
    """Title of its axis."""
    low: float = 0.0
    high: float = 1.0
    logarithmic: bool = False


def dots(panels: Sequence[DotPanel], rows: Sequence[DotRow], series: Sequence[str] = ()) -> Markup:
    """Draw panels side by side that share their rows, as the content of an SVG file, black on white.

    Args:
        panels: panels from left to right.
        rows: rows from top to bottom.
        series: names of the values in a row, if there are several.
    """
    left = 8.0 + 6.7 * max(len(row.label) for row in rows if row.values)
    width = (_PLOT - left) / len(panels)
    top = _HEAD + (_ROW if series else 0)
    bottom = top + _ROW * len(rows)
    height = bottom + 42
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_PLOT} {height}" width="{_PLOT}" '
        f'height="{height}"><style>{_INK}</style><rect width="{_PLOT}" height="{height}" fill="#fff"/>'
    ]
    middles = [top + _ROW * (k + 0.5) for k in range(len(rows))]
    parts += [f'<path d="M0 {y:.0f}H{_PLOT}" stroke="#eef1f4"/>' for y in middles]
    for number, panel in enumerate(panels):
        start = left + number * width + _INSET
        parts += _panel(panel, start, width - 2 * _INSET, (top, bottom))
        for row, y in zip(rows, middles, strict=True):
            shown = row.values[number] if row.values else ()
            for k, triple in enumerate(shown):
                apart = 6.0 * k - 3.0 * (len(series) - 1) if series else 0.0
                parts += _whisker(panel, start, width - 2 * _INSET, y + apart, triple, k)
    for row, y in zip(rows, middles, strict=True):
        heading = "" if row.values else ' class="h"'
        parts.append(f'<text x="4" y="{y + 4:.0f}"{heading}>{escape(row.label)}</text>')
    for k, name in enumerate(series):
        x = left + _INSET + k * (40.0 + 6.7 * max(map(len, series)))
        parts.append(f'{_dot(x, 14.0, k)}<text x="{x + 10:.0f}" y="18">{escape(name)}</text>')
    return Markup("".join(parts) + "</svg>\n")


def _panel(panel: DotPanel, start: float, width: float, ends: tuple[int, int]) -> list[str]:
    """Draw titles and grid of a panel."""
    middle, (top, bottom) = start + 0.5 * width, ends
    parts = [
        f'<text x="{middle:.0f}" y="{top - 12}" text-anchor="middle">{escape(panel.title)}</text>',
        f'<text x="{middle:.0f}" y="{bottom + 34}" text-anchor="middle" class="s">{escape(panel.scale)}</text>',
    ]
    if panel.logarithmic:
        decades = range(math.ceil(math.log10(panel.low)), math.floor(math.log10(panel.high)) + 1)
        ticks = [10.0**e for e in decades]
    else:
        ticks = [tick for tick in (-0.5, 0.0, 0.5, 1.0) if panel.low <= tick <= panel.high]
    for tick in ticks:
        x = start + width * _share(panel, tick)
        parts.append(f'<path d="M{x:.1f} {top}V{bottom}" stroke="#cfd6dc"/>')
        parts.append(f'<text x="{x:.1f}" y="{bottom + 16}" text-anchor="middle" class="s">{tick:g}</text>')
    return parts


def _share(panel: DotPanel, value: float) -> float:
    return _Axis(low=panel.low, high=panel.high, logarithmic=panel.logarithmic).share(value)


def _whisker(panel: DotPanel, start: float, width: float, y: float, triple: Triple, series: int) -> list[str]:
    """Draw a value and its interval, as far as they are finite."""
    x, a, b = (start + width * _share(panel, each) if np.isfinite(each) else math.nan for each in triple)
    line = f"M{a:.1f} {y:.1f}H{b:.1f}M{a:.1f} {y - 3:.1f}v6M{b:.1f} {y - 3:.1f}v6"
    parts = [f'<path d="{line}" stroke="{_SERIES[series][0]}" fill="none"/>'] if np.isfinite([a, b]).all() else []
    return parts + [_dot(x, y, series)] * bool(np.isfinite(x))


def _dot(x: float, y: float, series: int) -> str:
    colour, mark = _SERIES[series]
    return f'<path transform="translate({x:.1f} {y:.1f}) scale(.8)" d="{mark}" fill="{colour}"/>'
