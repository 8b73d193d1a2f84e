"""What the page of a correction shows of a motion's certainty."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsbench.dataset.corrected_frames import MARKER
from rsbench.report.corrected_page import direction_covariance, draw_certainty, sizes, write_page


def _motion(rng: np.random.Generator, spread: float = 1e-3) -> dict[str, Any]:
    root = spread * rng.standard_normal((6, 9))
    w, d = 0.05 * rng.standard_normal(3), 0.3 * rng.standard_normal(3)
    return {
        "w": w.tolist(),
        "d": d.tolist(),
        "rotation_deg": float(np.rad2deg(np.linalg.norm(w))),
        "translation": float(np.linalg.norm(d)),
        "covariance_w_d": (root @ root.T).tolist(),
        "model_choice": {
            "used": "twist",
            "decided": False,
            "probability": {"twist": 0.7, "linear": 0.2999, "x": 1e-4},
        },
    }


@given(st.integers(0, 10_000))
def test_the_direction_varies_as_its_covariance_says(seed: int) -> None:
    """Finite differences of the angles under which d is seen from the estimate, along both axes."""
    motion = _motion(np.random.default_rng(seed))
    d, covariance = np.array(motion["d"]), np.array(motion["covariance_w_d"])[3:, 3:]
    axes, across, names = direction_covariance(d, covariance)
    np.testing.assert_allclose(axes @ np.stack([*axes, d]).T, [[1, 0, 0], [0, 1, 0]], atol=1e-12)
    assert all(axes[k]["xyz".index(name)] > 0.5 for k, name in enumerate(names))
    step = 1e-7 * np.linalg.norm(d)
    slopes = [(d + step * unit) / np.linalg.norm(d + step * unit) - d / np.linalg.norm(d) for unit in np.eye(3)]
    J = np.rad2deg(axes @ np.array(slopes).T / step)
    np.testing.assert_allclose(across, J @ covariance @ J.T, rtol=1e-4, atol=1e-6 * np.max(across))


def test_sizes_carry_the_deviation_of_their_length() -> None:
    """Of 20,000 draws; the second figure of a deviation from so many is right to 0.5 %."""
    rng = np.random.default_rng(1)
    motion = _motion(rng)
    draws = rng.multivariate_normal([*motion["w"], *motion["d"]], motion["covariance_w_d"], 20_000)
    turn, shift = sizes(motion)
    for text, part, unit in ((turn, np.rad2deg(draws[:, :3]), "deg"), (shift, draws[:, 3:], "m")):
        value, sigma, found = re.fullmatch(r"([\d.]+) \+- ([\d.]+) (\w+)", text).groups()  # pyrefly: ignore
        lengths = np.linalg.norm(part, axis=1)
        assert found == unit and float(value) == pytest.approx(np.mean(lengths), rel=2e-3)
        assert float(sigma) == pytest.approx(np.std(lengths), rel=0.03, abs=5e-5)
    assert sizes(motion | {"covariance_w_d": None, "translation": 0.25})[1] == "0.2500 m"


def test_the_ellipses_hold_what_they_name() -> None:
    """Outlines in px, of directions drawn from the covariance: 39 and 95 % are inside."""
    rng = np.random.default_rng(2)
    motion = _motion(rng)
    svg = ET.fromstring(draw_certainty(motion)[1]["svg"])
    middle = np.array([float(svg.find("circle").get(key)) for key in ("cx", "cy")])  # pyrefly: ignore
    ticks = {each.text: float(each.get("x", "nan")) for each in svg.iter("text") if each.get("y") == "264.0"}
    name = max((text for text in ticks if text), key=float)
    scale = (ticks[name] - ticks["0"]) / float(name)
    d, covariance = np.array(motion["d"]), np.array(motion["covariance_w_d"])[3:, 3:]
    axes, _, _ = direction_covariance(d, covariance)
    seen = rng.multivariate_normal(d, covariance, 4000)
    seen = scale * np.rad2deg((seen / np.linalg.norm(seen, axis=1, keepdims=True)) @ axes.T)
    for polygon, share in zip(svg.iter("polygon"), (0.95, 0.3935), strict=True):
        corners = np.array([pair.split(",") for pair in polygon.get("points", "").split()], dtype=np.float64)
        outline = (corners - middle) * [1.0, -1.0]
        ranges = np.interp(
            np.arctan2(seen[:, 1], seen[:, 0]),
            *np.array(sorted(zip(np.arctan2(*outline.T[::-1]), np.hypot(*outline.T), strict=True))).T,
            period=2.0 * np.pi,
        )
        assert np.mean(np.hypot(*seen.T) < ranges) == pytest.approx(share, abs=0.03)  # 4000 draws: 0.8 %


def test_the_page_shows_odds_and_direction_of_one_motion_alone(tmp_path: Path) -> None:
    def page(record: dict[str, Any]) -> str:
        (tmp_path / MARKER).write_text(json.dumps(record), "utf-8")
        write_page(tmp_path, "title", "subtitle", [], [])
        return (tmp_path / "report.html").read_text("utf-8")

    first, other = (_motion(np.random.default_rng(seed)) for seed in (3, 4))
    text = page({"motion": first})
    assert (
        text.count("<svg") == 2 and "twist</text>" in text and "&lt; 0.1 %" in text and "probability 39 %" in text
    )
    assert "though the matches do not decide" in text and "+- is one standard deviation." in text
    assert page({"frames": [{"motion": first}, {"motion": first}]}).count("<svg") == 2
    assert "<svg" not in page({"frames": [{"motion": first}, {"motion": other}]})
    assert "<svg" not in page({"motion": None})
    wild = page({"motion": _motion(np.random.default_rng(5), spread=1.0)})
    assert wild.count("<svg") == 1 and "The direction of d is unknown" in wild
