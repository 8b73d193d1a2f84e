"""Frames of a sensor that is not ideal, against clean twins: no more blur and noise than the sensor makes."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.projection import back_project, project_at
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.verification.findings import finding, rows_of
from rsbench.dataset.verification.image_checks import Picture
from rsbench.dataset.verification.landing import FAR, DepthMap, Shot
from rsbench.dataset.verification.png import png_fault
from rsbench.errors import RsbenchError
from rsbench.reading import inside
from rsbench.renderers.electrons import Sensor, fall_off
from rsbench.renderers.image import linear_of_codes

_BEYOND_SIGMA, _BEYOND_SHARE, _ROW_SHARE = 5.0, 5e-3, 0.1
"""Of Gaussian noise 6e-7 are beyond, of Poisson numbers in the dark more; and a blur sees what lies between the
samples of a texture finer than a pixel, or behind a thin near edge, which the twin does not show. This share
is for four samples, and grows with the distance between them."""
_LEAST_VALUES, _VARIANCE_RANGE = 1000, (0.85, 1.2)
"""The variance of 1000 values is known to 4.5 %; five times that, and what a smooth surface changes in a blur."""
_MOST_BIAS = 0.75
"""Of the mean, in sigma: where the twin is uneven by less than one sigma, its middle is off by half at most."""
_UNCLIPPED = (0.03, 0.75)
_WHITE = 255.0


def sensor_faults(
    sequence: Sequence, maps: Mapping[Shot, DepthMap], pictures: Mapping[Shot, Picture], missing: Collection[str]
) -> Iterator[str]:
    """What the rolling-shutter frames of a sequence show that their sensor cannot have made of the clean twins."""
    sensor = sequence.sensor
    size = sequence.rig.camera.width, sequence.rig.camera.height
    for shot in pictures:
        if sensor is None or shot.shutter != "rs" or shot.image in missing or shot not in maps:
            continue
        try:
            fault = png_fault(inside(sequence.folder, shot.image), shot.image, size)
            if fault is None:
                seen = sequence.image(*shot[:3])
                own, spacing = sensor.of(shot.side, shot.frame), _spacing(sequence)
                window = _window(sequence, own, maps[shot], spacing)
                fault = _fault(own, seen, pictures[shot], window, spacing)
        except RsbenchError as error:
            fault = str(error)
        if fault:
            yield fault


def _spacing(sequence: Sequence) -> float:
    """Pixels between the samples of the clean twin, which shows nothing that lies between."""
    renderer = sequence.manifest.get("renderer")
    samples = renderer.get("samples") if isinstance(renderer, dict) else None
    return float(samples**-0.5) if isinstance(samples, int) and samples > 0 else 1.0


def _window(sequence: Sequence, sensor: Sensor, depth_map: DepthMap, spacing: float) -> tuple[int, int]:
    """How far (x, y) a surface may be, in whole pixels, from where the row's time sees it, while it is exposed."""
    if not sensor.exposure_s:
        return 0, 0
    shot = depth_map.shot
    grid = sequence.rig.camera.pixel_grid()[::4, ::4]
    depth = depth_map.depth[::4, ::4].astype(np.float64)
    depth = np.where(depth > 0, depth, FAR)
    geometry = sequence.rig, sequence.shutter, sequence.motion, shot.side, shot.frame
    X = back_project(*geometry, grid, depth)
    half = 0.5 * sensor.exposure_s / sequence.frame_period_s
    tau = sequence.shutter.pixel_time(grid, shot.frame, shot.side)
    moved = [
        np.abs(project_at(sequence.rig, sequence.motion, shot.side, tau + sign * half, X)[..., :2] - grid)
        for sign in (-1.0, 1.0)
    ]
    # One more: a pixel is an area, and thin near things lie between the points looked at; and between samples.
    x, y = np.ceil(np.nanmax(np.stack(moved), axis=(0, 1, 2))).astype(int) + 1 + int(spacing)
    return int(x), int(y)


def _fault(
    sensor: Sensor, image: NDArray[np.uint8], picture: Picture, window: tuple[int, int], spacing: float = 0.5
) -> str | None:
    shot, clean = picture.shot, picture.colours
    height, width = clean.shape[:2]
    twin = f"rs_clean/{shot.side}_{shot.frame}.png"
    around = np.ones((2 * window[1] + 1, 2 * window[0] + 1), np.uint8)
    share = fall_off(sensor, width, height, np.arange(height))[..., None]
    least, most = (way(clean, around) for way in (cv2.erode, cv2.dilate))
    low = linear_of_codes(least) * share
    # How bright white is, the twin does not say.
    high = np.where(most < _WHITE, np.minimum(linear_of_codes(most) * share, 1.0), 1.0)
    seen = linear_of_codes(image)
    # A path tracer's noise is in both, and in each frame another; one sample of a pixel is a draw likewise.
    traced = 12.0 * picture.noise**2 if picture.noisy or spacing >= 1.0 else 0.0
    own, rounded = sensor.variance(high), (1.0 + traced) * (_rounding(image) + share**2 * _rounding(clean))
    sigma = np.sqrt(own + rounded)
    slack = _BEYOND_SIGMA * np.sqrt(own + rounded + 2.0 * share**2 * _sampling(clean, spacing))
    beyond = (seen < np.minimum(low, 1.0) - slack) | (seen > high + slack)
    # What the twin does not show may come in over its borders.
    inner = np.s_[window[1] : height - window[1], window[0] : width - window[0]]
    if not beyond[inner].size:
        return None
    many, rows = float(np.mean(beyond[inner])), np.zeros(height, dtype=np.bool_)
    rows[inner[0]] = np.mean(beyond[inner], axis=(1, 2)) > _ROW_SHARE
    if many > _BEYOND_SHARE * max(1.0, 2.0 * spacing) or np.any(rows):
        what = f"{100 * many:.2f} % of the values are beyond {_BEYOND_SIGMA:g} sigma of what {twin} allows"
        return finding(shot.image, what, rows_of(rows))
    # Rounding is no noise: without any beside it, equal values are rounded alike.
    smooth = (high - low < sigma) & (low > _UNCLIPPED[0]) & (high < _UNCLIPPED[1]) & (own > rounded)
    if np.sum(smooth) < _LEAST_VALUES:
        return None
    beside = ((seen - 0.5 * (low + high)) / sigma)[smooth]
    if abs(bias := float(np.mean(beside))) > _MOST_BIAS:
        what = f"is {'brighter' if bias > 0 else 'darker'} than its sensor shows {twin}, by {abs(bias):.2f} sigma"
        return finding(shot.image, what)
    ratio = float(np.var(beside))
    if not _VARIANCE_RANGE[0] < ratio < _VARIANCE_RANGE[1]:
        return finding(
            shot.image, f"its noise has {ratio:.2f} times the variance of the sensor's, seen beside {twin}"
        )
    return None


def _sampling(clean: NDArray[np.uint8] | NDArray[np.float32], spacing: float) -> FloatArray:
    """Variance of linear values (...) that are means of 1 / spacing^2 samples of what the pixels around show."""
    around = np.ones((3, 3), np.uint8)
    least, most = (linear_of_codes(way(clean, around)) for way in (cv2.erode, cv2.dilate))
    return np.asarray((spacing * (most - least)) ** 2 / 12.0, dtype=np.float64)


def _rounding(codes: NDArray[np.uint8] | NDArray[np.float32]) -> FloatArray:
    """Variance of the linear values (...) by rounding to codes."""
    exact = codes.astype(np.float64)
    return np.asarray((linear_of_codes(exact + 0.5) - linear_of_codes(exact - 0.5)) ** 2 / 12.0, dtype=np.float64)
