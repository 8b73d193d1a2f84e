"""Kannala-Brandt lenses fitted to fisheye models of other tools that rsbench does not have.

A radially symmetric model is a function from the angle between a ray and the axis to the distorted radius in focal
lengths. For Kannala-Brandt this function is an odd polynomial, so the fit is linear.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rsbench.core.camera import WIDEST, Lens, PinholeCamera
from rsbench.core.so3 import FloatArray

Profile = Callable[[FloatArray], FloatArray]
"""Function that returns distorted radii, in focal lengths, for angles from the axis, rad."""
_NODES, _CHECKED = 400, 4001


class LensFit(NamedTuple):
    """A Kannala-Brandt lens that approximates another lens model, with its focal lengths."""

    lens: Lens
    fx: float
    fy: float
    error_px: float
    """Largest distance between the pixels of a ray in the two models, over the angles within the image."""


def kannala_brandt_of(camera: PinholeCamera, profile: Profile) -> LensFit:
    """The nearest Kannala-Brandt lens of a radially symmetric model.

    Args:
        camera: size, focal lengths and principal point as the model has them; without a lens.
        profile: the model: ``unified_profile``, ``fov_profile`` or another function.

    Raises:
        ValueError: the image shows angles at which the model folds, or beyond ``camera.WIDEST``.
    """
    corners = [(x, y) for x in (-0.5, camera.width - 0.5) for y in (-0.5, camera.height - 0.5)]
    most = float(np.max(np.linalg.norm(camera.ideal.unproject(corners)[:, :2], axis=-1)))
    angles = np.linspace(0.0, WIDEST, _CHECKED)
    radii = profile(angles)
    grows = np.append(True, np.diff(radii) > 0.0) & np.isfinite(radii)
    shown = int(np.argmax(~grows | (radii >= most)))
    if not (grows[shown] and radii[shown] >= most):
        raise ValueError(
            f"camera lens: the corners of the image lie {most:.3g} focal lengths from the principal point, where "
            f"the model folds or shows rays more than {math.degrees(WIDEST):.0f} degrees from the axis"
        )
    # Chebyshev's nodes of an odd function: least squares on them are near the least largest error.
    nodes = angles[shown] * np.sin(np.linspace(0.0, np.pi / 2, _NODES))
    powers = np.array([1, 3, 5, 7, 9])
    scale = angles[shown]
    scaled = np.linalg.lstsq((nodes[:, None] / scale) ** powers, profile(nodes), rcond=None)[0]
    polynomial = scaled / scale**powers
    gain, k = float(polynomial[0]), polynomial[1:] / polynomial[0]
    seen = angles[: shown + 1]
    off = np.abs(seen[:, None] ** powers @ polynomial - radii[: shown + 1])
    lens = Lens(model="kannala-brandt", **dict(zip(("k1", "k2", "k3", "k4"), map(float, k), strict=True)))
    error_px = float(np.max(off)) * max(camera.fx, camera.fy)
    return LensFit(lens, gain * camera.fx, gain * camera.fy, error_px)


def unified_profile(alpha: float, beta: float = 1.0) -> Profile:
    """The enhanced unified camera model of B. Khomutenko, G. Garcia, P. Martinet, RA-L 2016; beta = 1: unified."""
    return lambda angle: (
        np.sin(angle)
        / (alpha * np.sqrt(beta * np.sin(angle) ** 2 + np.cos(angle) ** 2) + (1.0 - alpha) * np.cos(angle))
    )


def mirror_profile(xi: float, k1: float = 0.0, k2: float = 0.0) -> Profile:
    """The unified model of C. Mei, P. Rives, ICRA 2007, with radial distortion: omni of Kalibr."""

    def profile(angle: FloatArray) -> FloatArray:
        radius = np.sin(angle) / (np.cos(angle) + xi)
        s = radius * radius
        return np.asarray(radius * (1.0 + s * (k1 + s * k2)))

    return profile


def fov_profile(omega: float) -> Profile:
    """The field-of-view model of F. Devernay, O. Faugeras, 2001; omega in rad, above 0."""
    return lambda angle: np.arctan2(2.0 * math.tan(omega / 2.0) * np.sin(angle), np.cos(angle)) / omega


_LEAST_SLOPE, _MOST_ADDED, _WEIGHT = 0.3, 0.15, 0.03


class Continued(NamedTuple):
    """A rational lens that replaces a lens whose polynomial folds just inside the corners of the image."""

    lens: Lens
    until: float
    """Distorted radius, in focal lengths, beyond which the lens is extrapolated."""
    error: float
    """Largest difference between the two lenses' distorted radii within that radius, in focal lengths."""


def continued(lens: Lens, corner: float) -> Continued | None:
    """Return a lens that does not fold inside the corners of the image, where a calibration has no points.

    Beyond the radius at which the derivative of the distorted radius falls below 0.3, the lens is extrapolated
    linearly. A rational lens is fitted to the result; tangential distortion is kept.

    Args:
        lens: ``brown-conrady`` or ``rational``.
        corner: distorted radius, in focal lengths, up to which the image reaches.

    Returns:
        The lens, or None if the slope falls below 0.3 far from the corner, or nowhere.
    """
    radial = replace(lens, p1=0.0, p2=0.0)
    r = np.linspace(0.0, min(lens.reach, 1e3) * (1 - 1e-9), _CHECKED)[1:]
    bent = radial.distort(np.stack([r, np.zeros_like(r)], axis=-1))
    y, slope = bent.xy[:, 0], bent.jacobian[:, 0, 0]
    turn = int(np.argmax(slope < _LEAST_SLOPE))
    if not slope[turn] < _LEAST_SLOPE or not corner * (1 - _MOST_ADDED) < y[turn]:
        return None
    more = np.linspace(0.0, max(1.02 * corner - y[turn], 0.0) / slope[turn], _NODES)[1:]
    inside = turn + 1
    r, y = np.append(r[:inside], r[turn] + more), np.append(y[:inside], y[turn] + slope[turn] * more)
    s, gain = r * r, y / r
    columns = np.stack([s, s**2, s**3, -gain * s, -gain * s**2, -gain * s**3], axis=-1)
    weight = np.where(np.arange(len(r)) < inside, 1.0, _WEIGHT) * r
    c = np.zeros(6)
    for _ in range(_NODES // 10):  # the denominator's weight follows the fit
        below = 1.0 + s * (c[3] + s * (c[4] + s * c[5]))
        c = np.linalg.lstsq(columns * (weight / below)[:, None], (gain - 1.0) * weight / below, rcond=None)[0]
    k1, k2, k3, k4, k5, k6 = map(float, c)
    made = Lens(model="rational", k1=k1, k2=k2, k3=k3, k4=k4, k5=k5, k6=k6, p1=lens.p1, p2=lens.p2)
    ideal = np.stack([r[:inside], np.zeros(inside)], axis=-1)
    off = np.abs(replace(made, p1=0.0, p2=0.0).distort(ideal).xy[:, 0] - y[:inside])
    return Continued(made, float(y[turn]), float(np.max(off)))
