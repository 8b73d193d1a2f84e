"""Check frames with sensor effects against clean twins: blur and noise must be those that the sensor makes."""

from __future__ import annotations

import io
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple, get_args

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from rsbench.core.errors import RsbenchError
from rsbench.core.projection import project_at
from rsbench.core.se3 import inverse, transform
from rsbench.core.so3 import FloatArray
from rsbench.dataset.layout import clean_file
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import FAR, SHADED, ImageView, numbers_of, seen_from
from rsbench.renderers.image import (
    Mosaic,
    Sensor,
    compressed,
    expose,
    fall_off,
    filters,
    linear_of_codes,
    processed,
    rows_needed,
    shares_of_noise,
    srgb_of,
)
from rsbench.storage.untrusted_files import inside
from rsbench.verification.content import Content, png_fault
from rsbench.verification.findings import Finding, rows_of
from rsbench.verification.image_checks import Picture
from rsbench.verification.reprojection import BoolArray, DepthMap

_BLOCK = 8
_MOST, _MOST_OF_ROWS = 0.02, 0.1
"""Largest share of wrong values in an image, and in a row of pixels or blocks. In sound data no value of a mosaic
is wrong; of JPEG up to 1.2e-2 at quality 20, 1e-3 at 90."""
_LEAST, _LEAST_OF_ROWS = 200, 20
"""Smallest numbers of values with which an image, or a row, is judged."""
_NEAR = 1.5
"""Tolerance in codes between a value and the mean of its neighbours. All are rounded by half a code; in the mean,
the rounding of a bright neighbour counts up to twice."""
_COARSE, _OFF = 4, 1.25
"""The smallest quantisation step at which a coefficient is judged, and its tolerance from a multiple of the step:
six standard deviations of the errors by rounding to codes, if these are independent. A third of the coefficients
that were not quantised with a step of 4 exceed it. If values of a block repeat, as in equal rows, their rounding
errors add up: the tolerance is multiplied by the root of the number of repetitions."""
_OPEN = 125.0
"""Luminance relative to grey beyond which it may have been clipped."""
_FIRST = 1.0 / np.sqrt(2.0)
_DCT = 0.5 * np.cos(np.pi / 16 * np.outer(np.arange(8), 2 * np.arange(8) + 1)) * np.array([[_FIRST], *[[1.0]] * 7])
"""Orthonormal discrete cosine transform of eight values (ITU-T T.81, A.3.3)."""


class _Counts(NamedTuple):
    """Numbers of wrong values, and of values that can be judged, in each row of pixels (H,)."""

    wrong: FloatArray
    judged: FloatArray

    def rows(self) -> NDArray[np.bool_]:
        """Return the rows (H,) with too many wrong values; none if too few values can be judged."""
        bad = (self.wrong > _MOST_OF_ROWS * self.judged) & (self.judged >= _LEAST_OF_ROWS)
        if np.sum(self.judged) >= _LEAST and np.sum(self.wrong) > _MOST * np.sum(self.judged):
            bad |= self.wrong > _MOST * self.judged
        return np.asarray(bad)


def processing_fault(image: NDArray[np.uint8], sensor: Sensor, file: str) -> Finding | None:
    """Return a finding if an image (H, W, 3) lacks the compression or mosaic of its sensor; None if unclear.

    The mosaic of compressed images is not checked, as it no longer shows.
    """
    if sensor.jpeg_quality:
        blocks = _Blocks.of(image)
        if not np.any(wrong := blocks.off_steps(sensor.jpeg_quality).rows()):
            return None
        # Take the coarsest quantisation that fits: multiples of 8 are multiples of 4 too.
        like = next((q for q in range(1, 100) if _fits(blocks.off_steps(q))), None)
        what = f"is no JPEG image of quality {sensor.jpeg_quality}: its blocks are not of whole steps"
        return Finding(
            file, what, rows_of(wrong), f"looks like quality {like}" if like else "looks not compressed"
        )
    if sensor.mosaic == "none" or not np.any(wrong := _not_means(image, sensor.mosaic).rows()):
        return None
    patterns = [each for each in get_args(Mosaic) if each != "none"]
    alike = next((each for each in patterns if _fits(_not_means(image, each))), None)
    what = f"is not interpolated from a mosaic {sensor.mosaic}: values are not the mean of their neighbours"
    return Finding(file, what, rows_of(wrong), f"looks like {alike or 'no mosaic'}")


def _fits(counts: _Counts) -> bool:
    return bool(np.sum(counts.judged) >= _LEAST and np.sum(counts.wrong) <= _MOST * np.sum(counts.judged))


def _not_means(image: NDArray[np.uint8], mosaic: Mosaic) -> _Counts:
    """Count interpolated values that are not the mean of the neighbours with a filter of their colour."""
    height, width = image.shape[:2]
    light, codes = linear_of_codes(image), image.astype(np.float64)
    own = filters(mosaic, width, np.arange(height))
    open_ = np.all((image > 0) & (image < 255), axis=-1).astype(np.uint8)
    inner = cv2.erode(open_, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    wrong, counted = np.zeros(height), np.zeros(height)
    for channel in range(3):
        across, down, corners = (
            np.abs(255 * srgb_of(cv2.filter2D(light[..., channel], -1, kernel)) - codes[..., channel]) <= _NEAR
            for kernel in _KERNELS
        )
        level, upright = (np.any(own == channel, axis=axis, keepdims=True) for axis in (1, 0))
        # The camera chose one of two directions from values before their rounding, so either is accepted.
        right = np.where(level | upright, (across & level) | (down & upright), corners)
        judged = inner & (own != channel)
        wrong += np.sum(judged & ~right, axis=1)
        counted += np.sum(judged, axis=1)
    return _Counts(wrong, counted)


_KERNELS = [
    np.array(kernel) / np.sum(kernel)
    for kernel in (
        [[0.0, 0.0, 0.0], [1.0, 0.0, 1.0], [0.0, 0.0, 0.0]],
        [[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
        [[1.0, 0.0, 1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 1.0]],
    )
]


class _Blocks(NamedTuple):
    """The complete 8 x 8 blocks of an image, (H / 8, W / 8, ...)."""

    coefficients: FloatArray
    """(..., 8, 8) DCT coefficients of luminance."""
    open: NDArray[np.bool_]
    """(...) whether no value of the block is clipped at black or white."""
    distinct: NDArray[np.int64]
    """(...) number of distinct values of luminance in the block."""
    rows: int
    """Number of rows of pixels in the image."""

    @classmethod
    def of(cls, image: NDArray[np.uint8]) -> _Blocks:
        height, width = (size // _BLOCK * _BLOCK for size in image.shape[:2])
        shape = height // _BLOCK, _BLOCK, width // _BLOCK, _BLOCK, 3
        blocks = image[:height, :width].reshape(shape).swapaxes(1, 2)
        luminance = blocks @ np.array([0.299, 0.587, 0.114]) - 128.0
        open_ = np.all((blocks > 0) & (blocks < 255), axis=4) & (np.abs(luminance) < _OPEN)
        distinct = 1 + np.sum(np.diff(np.sort(luminance.reshape(*luminance.shape[:2], -1))) > 1e-6, axis=-1)
        return cls(_DCT @ luminance @ _DCT.T, np.all(open_, axis=(2, 3)), distinct, len(image))

    def off_steps(self, quality: int) -> _Counts:
        """Count coefficients that are not multiples of their quantisation step."""
        steps = quality_steps(quality)
        allowed = _OFF * np.sqrt(_BLOCK**2 / self.distinct)[..., None, None]
        off = np.abs(self.coefficients - steps * np.round(self.coefficients / steps)) > allowed
        judged = np.broadcast_to(self.open[..., None, None] & (steps >= _COARSE), off.shape)
        counts = (
            np.sum(each, axis=(1, 2, 3)).repeat(_BLOCK).astype(np.float64) for each in (off & judged, judged)
        )
        return _Counts(*(np.pad(each, (0, self.rows - len(each))) for each in counts))


@cache
def quality_steps(quality: int) -> FloatArray:
    """Return the quantisation steps (8, 8) of luminance that OpenCV's encoder uses."""
    _, data = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality])
    with Image.open(io.BytesIO(data.tobytes())) as image:
        return np.array(image.quantization[0], dtype=np.float64).reshape(8, 8)


_BEYOND_SIGMA, _BEYOND_SHARE, _ROW_SHARE = 5.0, 5e-3, 0.1
"""Tolerance in sigma, and shares of the values of an image and of a row that may exceed it: 6e-7 of Gaussian
noise, more of Poisson noise in the dark; a blur also contains texture between the twin's samples, and surfaces
behind thin near edges. The first share is for four samples per pixel, and grows with the distance between them."""
_LEAST_VALUES, _VARIANCE_RANGE = 1000, (0.85, 1.2)
"""The variance of 1000 values is known to 4.5 %; the range also allows for blur of a smooth surface."""
_COMPRESSED_RANGE, _BLOCKS_ALIKE = (0.5, 2.0), 10
"""Allowed ratio of variances of a compressed image and of its clean twin after the same compression; factor on the
number of values, as noise is that of blocks, not of values: both are chosen, not measured."""
_JPEG_REACH = 17
"""Pixels over which JPEG spreads its errors: a block of colours at half the resolution, and one more."""
_MOST_BIAS = 0.75
"""Largest difference of the means, in sigma: where the twin varies by less than one sigma, the middle of its range
errs by at most half."""
_FARTHER = 3
_UNCLIPPED = (0.03, 0.75)
_WHITE = 255.0


def sensor_faults(content: Content, missing: Collection[str]) -> Iterator[Finding]:
    """Find frames that their sensor cannot have made from the clean twins."""
    sequence, maps, pictures = content.sequence, content.maps, content.pictures
    sensor = sequence.sensor
    for view in pictures:
        camera = sequence.rig.sensor(view.side)
        rolling, file = view.shutter == "rs", _file(view)
        if sensor is None or file in missing or view not in maps or not (rolling or sequence.exposed_twins):
            continue
        try:
            fault = png_fault(inside(sequence.folder, file), file, (camera.width, camera.height))
            if fault is None:
                seen = sequence.image(*view[:3]) if rolling else sequence.exposed_image(*view[1:])
                own, spacing = sensor.of(view.side, view.frame), _spacing(sequence)
                own = own if rolling else own.noiseless
                window = _window(sequence, own, maps[view], spacing)
                changing = _changing(sequence, own, maps[view], spacing)
                fault = _fault(own, seen, pictures[view], window, spacing, changing)
        except RsbenchError as error:
            fault = Finding.of(error)
        if fault:
            yield fault


def _spacing(sequence: Sequence) -> float:
    """Return the distance in pixels between samples of the clean twin, which does not show what lies between."""
    renderer = sequence.manifest.get("renderer")
    samples = renderer.get("samples") if isinstance(renderer, dict) else None
    return float(samples**-0.5) if isinstance(samples, int) and samples > 0 else 1.0


def _changing(sequence: Sequence, sensor: Sensor, depth_map: DepthMap, spacing: float) -> BoolArray:
    """Return the pixels (H, W) where ``_window`` does not hold during exposure: a moving object, its shadow, or
    a reflection in a glossy surface may be seen there."""
    labels, gloss, found = depth_map.labels, depth_map.gloss, np.zeros(depth_map.depth.shape, dtype=np.bool_)
    beside = int(sensor.mosaic != "none") + (_JPEG_REACH if sensor.jpeg_quality else 0)
    if gloss is not None and sensor.exposure_s:
        found |= _around(gloss, _window(sequence, sensor, depth_map, spacing), beside)
    if labels is None or not sensor.exposure_s:
        return found
    numbers = range(1, len(sequence.moving) + 1)
    windows = [_window(sequence, sensor, depth_map, spacing, number) for number in numbers]
    # A shadow moves about as far as the object that casts it, and farther if the sun is low or the ground is near.
    farthest = tuple(_FARTHER * np.max(windows, axis=0))
    masks = [numbers_of(labels) == number for number in numbers]
    for own, window in zip((*masks, labels >= SHADED), (*windows, farthest), strict=True):
        found |= _around(own, window, beside)
    return found


def _around(own: BoolArray, window: tuple[int, int], beside: int) -> BoolArray:
    """Return which pixels (H, W) lie within a window (x, y), and ``beside`` pixels more, of a mask."""
    x, y = window
    around = np.ones((2 * (y + beside) + 1, 2 * (x + beside) + 1), np.uint8)
    return np.asarray(cv2.dilate(own.astype(np.uint8), around) > 0)


def _window(
    sequence: Sequence, sensor: Sensor, depth_map: DepthMap, spacing: float, number: int = 0
) -> tuple[int, int]:
    """Return how far (x, y), in whole pixels, a surface may be during exposure from its place at the row's time.

    Only surfaces of the object with this ``number`` count; 0 is the static scene.
    """
    view, labels = depth_map.view, depth_map.labels
    grid = depth_map.camera.pixel_grid()[::4, ::4]
    own = np.ones(grid.shape[:2], np.bool_) if labels is None else numbers_of(labels[::4, ::4]) == number
    if not (sensor.exposure_s and np.any(own)):
        return 0, 0
    depth, grid = depth_map.depth[::4, ::4][own].astype(np.float64), grid[own]
    rig, shutter, motion = seen_from(sequence, number)[:3]
    tau = shutter.pixel_time(grid, view.frame, view.side)
    if view.shutter == "gs":
        line = shutter.line_times(view.frame, view.side)[shutter.line_after(view.row, view.side)]
        tau = np.full(tau.shape, line)
    rays = depth_map.camera.unproject(grid) * np.where(depth > 0, depth, FAR)[:, None]
    X = transform(inverse(rig.cam_from_world(motion, tau, view.side)), rays)
    half = 0.5 * sensor.exposure_s / sequence.frame_period_s
    moved = [
        np.abs(project_at(rig, motion, view.side, tau + sign * half, X)[..., :2] - grid) for sign in (-1.0, 1.0)
    ]
    # Add one, as a pixel is an area and thin near objects lie between the tested points; add the sample spacing.
    x, y = np.ceil(np.nanmax(np.stack(moved), axis=(0, 1))).astype(int) + 1 + int(spacing)
    return int(x), int(y)


def _fault(
    sensor: Sensor,
    image: NDArray[np.uint8],
    picture: Picture,
    window: tuple[int, int],
    spacing: float = 0.5,
    changing: BoolArray | None = None,
) -> Finding | None:
    """Return the fault of an image of ``picture``'s view; ``window`` is how far (x, y) its blur may reach, px.

    ``changing`` (H, W) marks pixels where it may reach farther; their light and noise are not judged.
    """
    bounds = _Bounds.of(sensor, image, picture, window, spacing)
    judged = np.ones((*image.shape[:2], 1), np.bool_) if changing is None else ~changing[..., None]
    return (
        _beyond(bounds, image, picture.view, spacing, judged)
        or processing_fault(image, sensor, _file(picture.view))
        or _noise_fault(bounds, sensor, image, picture, judged)
    )


@dataclass(frozen=True, eq=False)
class _Bounds:
    """Bounds on what a sensor may show, linear values (H, W, 3) where white is 1."""

    low: FloatArray
    """The darkest light that may reach a pixel; ``high`` is the brightest."""
    high: FloatArray
    own: FloatArray
    """Variance of the sensor's noise."""
    rounded: FloatArray
    """Variance due to rounding, and to the noise of the twin."""
    slack: FloatArray
    inner: tuple[slice, slice]
    """Pixels that receive no light from beyond the image border, which the twin does not show."""

    @classmethod
    def of(
        cls,
        sensor: Sensor,
        image: NDArray[np.uint8],
        picture: Picture,
        window: tuple[int, int],
        spacing: float,
    ) -> _Bounds:
        clean, beside = picture.colours, int(sensor.mosaic != "none")
        height, width = clean.shape[:2]
        x, y = window[0] + beside, window[1] + beside
        around = np.ones((2 * y + 1, 2 * x + 1), np.uint8)
        share = fall_off(sensor, width, height, np.arange(height))[..., None]
        least, most = (extreme(clean, around) for extreme in (cv2.erode, cv2.dilate))
        low = linear_of_codes(least) * share
        # The twin is clipped at white, so that the true brightness of white is unknown.
        high = np.where(most < _WHITE, np.minimum(linear_of_codes(most) * share, 1.0), 1.0)
        # A path tracer's noise differs between the frame and its twin; so does a single sample per pixel.
        traced = 12.0 * picture.noise**2 if picture.noisy or spacing >= 1.0 else 0.0
        own = sensor.variance(high)
        rounded = (1.0 + traced) * (_rounding(image) + share**2 * _rounding(clean))
        unsure = own + rounded + 2.0 * share**2 * _sampling(clean, spacing)
        if sensor.jpeg_quality:
            unsure += cv2.dilate(_compression(sensor, clean), around)
        own = own * shares_of_noise(sensor.mosaic, width, height)
        inner = np.s_[y : height - y, x : width - x]
        return cls(low, high, own, rounded, _BEYOND_SIGMA * np.sqrt(unsure), inner)


def _beyond(
    bounds: _Bounds, image: NDArray[np.uint8], view: ImageView, spacing: float, judged: BoolArray
) -> Finding | None:
    seen, inner = linear_of_codes(image), bounds.inner
    beyond = judged & ((seen < np.minimum(bounds.low, 1.0) - bounds.slack) | (seen > bounds.high + bounds.slack))
    if not beyond[inner].size:
        return None
    many, rows = float(np.mean(beyond[inner])), np.zeros(len(image), dtype=np.bool_)
    rows[inner[0]] = np.mean(beyond[inner], axis=(1, 2)) > _ROW_SHARE
    if many <= _BEYOND_SHARE * max(1.0, 2.0 * spacing) and not np.any(rows):
        return None
    what = f"{100 * many:.2f} % of the values are beyond {_BEYOND_SIGMA:g} sigma of what {_twin(view)} allows"
    return Finding(_file(view), what, rows_of(rows))


def _noise_fault(
    bounds: _Bounds, sensor: Sensor, image: NDArray[np.uint8], picture: Picture, judged: BoolArray
) -> Finding | None:
    """Check light and noise where the twin is smooth and the noise exceeds rounding: without noise, equal values
    are rounded alike."""
    low, high, view = bounds.low, bounds.high, picture.view
    sigma = np.sqrt(bounds.own + bounds.rounded)
    smooth = judged & (high - low < sigma) & (low > _UNCLIPPED[0]) & (high < _UNCLIPPED[1])
    smooth &= bounds.own > bounds.rounded
    if sensor.mosaic != "none":
        inside = np.zeros_like(smooth)
        inside[bounds.inner] = True
        smooth &= inside
    if np.sum(smooth) < _LEAST_VALUES * (_BLOCKS_ALIKE if sensor.jpeg_quality else 1):
        return None
    beside = ((linear_of_codes(image) - 0.5 * (low + high)) / sigma)[smooth]
    if abs(bias := float(np.mean(beside))) > _MOST_BIAS:
        change = "brighter" if bias > 0 else "darker"
        return Finding(_file(view), f"is {change} than its sensor shows {_twin(view)}, by {abs(bias):.2f} sigma")
    ratio, (least, most) = float(np.var(beside)), _VARIANCE_RANGE
    if sensor.jpeg_quality:
        made = linear_of_codes(_made_of(picture.colours, sensor))
        ratio /= float(np.var(((made - 0.5 * (low + high)) / sigma)[smooth]))
        least, most = _COMPRESSED_RANGE
    if least < ratio < most:
        return None
    what = f"its noise has {ratio:.2f} times the variance of the sensor's, seen beside {_twin(view)}"
    return Finding(_file(view), what)


def _file(view: ImageView) -> str:
    """Return the file of the image that the sensor made."""
    return view.image if view.shutter == "rs" else view.exposed


def _twin(view: ImageView) -> str:
    return clean_file(view.side, view.frame) if view.shutter == "rs" else view.image


def _made_of(clean: NDArray[np.uint8] | NDArray[np.float32], sensor: Sensor) -> NDArray[np.uint8]:
    """Return the image that the sensor makes of a clean twin, with new random noise."""
    rows = range(len(clean))
    light = linear_of_codes(clean).astype(np.float32)
    return processed(
        expose(light, sensor, 0, len(clean), rows), sensor, len(clean), rows_needed(sensor, rows, len(clean)), rows
    )


def _compression(sensor: Sensor, clean: NDArray[np.uint8] | NDArray[np.float32]) -> FloatArray:
    """Return the variance (H, W, 3) of linear values near each pixel that JPEG adds to the sensor's image."""
    before = _made_of(clean, replace(sensor, jpeg_quality=0))
    after = compressed(before, sensor.jpeg_quality)
    error = (linear_of_codes(after) - linear_of_codes(before)) ** 2
    return np.asarray(cv2.blur(error, (_JPEG_REACH, _JPEG_REACH)), dtype=np.float64)


def _sampling(clean: NDArray[np.uint8] | NDArray[np.float32], spacing: float) -> FloatArray:
    """Return the variance (...) of linear means of 1 / spacing^2 samples of what the surrounding pixels show."""
    around = np.ones((3, 3), np.uint8)
    least, most = (linear_of_codes(extreme(clean, around)) for extreme in (cv2.erode, cv2.dilate))
    return np.asarray((spacing * (most - least)) ** 2 / 12.0, dtype=np.float64)


def _rounding(codes: NDArray[np.uint8] | NDArray[np.float32]) -> FloatArray:
    """Return the variance of linear values (...) due to rounding to codes."""
    exact = codes.astype(np.float64)
    return np.asarray((linear_of_codes(exact + 0.5) - linear_of_codes(exact - 0.5)) ** 2 / 12.0, dtype=np.float64)
