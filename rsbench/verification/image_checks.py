"""Compare images: under diffuse light a surface has the same colour in every frame that shows it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import permutations
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.dataset.views import ImageView
from rsbench.verification.compiled_comparison import Shown, costs_of_changes, every_nth, vote_rows
from rsbench.verification.findings import Finding, rows_of
from rsbench.verification.reprojection import (
    BoolArray,
    DepthMap,
    Reprojection,
    by_bands,
    reproject,
    stride_for,
    without_changing_light,
)

if TYPE_CHECKING:
    from rsbench.verification.content import Content

Colours = NDArray[np.float32]
_BEYOND = 6.0
"""Tolerance in 8-bit codes beyond the range of the 3 x 3 pixels of another frame around a surface point: rounding
of both is 1; the rest allows for texture finer than a pixel, which two pixel grids sample differently."""
_NOISE_FACTOR = 4.0
"""Standard deviations of a path-traced image's noise that are added to this tolerance."""
_CAP = 30.0
"""Largest difference of codes that counts, so that a few edges do not decide."""
_BANDS, _LEAST_BAND = 12, 8
"""Number of bands of rows that are judged separately, and their smallest height."""
_LEAST_PIXELS = 60
"""Number of pixels below which a band is not judged."""
_UNLIKE, _UNLIKE_WHOLE = 0.5, 0.22
"""Largest share of a band's pixels, and of all pixels of a pair, that may exceed the tolerance: sound data of one
sample per pixel reaches 0.36 and 0.17."""
_BETTER, _GAIN = 0.8, 0.5
"""A change explains a band if it lowers the mean difference to less than 0.8 of what it was, and by 0.5 codes; on
textured sound data the factor is at least 1.4. It must also be below 0.8 of what a single colour leaves: a part
that is only darker or less noisy is closer to noise than the right part is, but no closer than that."""
_LEAST_EVIDENCE = 3
"""Number of differing bands, counted for both directions of a pair, below which an image is blamed only if two
partners disagree with it: a small image may differ by chance."""
_CHANCE = 3.0
"""Number of standard errors that a change's gain in a band must exceed, as chance may favour a change."""
_TILE, _BAD_IN_TILE = 16, 0.6
_SAMPLES = 60_000
_REMAPPED = 512
"""Number of places in each row of the map given to OpenCV, which accepts at most 32767."""

_PERMUTATIONS = [order for order in permutations(range(3)) if order != (0, 1, 2)]


@dataclass(frozen=True)
class Change:
    """A change that an image may have undergone: where the changed image shows the true colour of a pixel."""

    words: str
    down: int = 0
    right: int = 0
    flip_x: bool = False
    flip_y: bool = False
    order: tuple[int, ...] = (0, 1, 2)

    def undone(self, image: Colours, y: NDArray[np.int64], x: NDArray[np.int64]) -> Colours:
        """Return the colours (n, 3) of pixels with the change undone."""
        height, width = image.shape[:2]
        y = np.clip((height - 1 - y if self.flip_y else y) + self.down, 0, height - 1)
        x = np.clip((width - 1 - x if self.flip_x else x) + self.right, 0, width - 1)
        colours = image[y, x]
        return colours if self.order == (0, 1, 2) else colours[:, list(self.order)]


NOTHING = Change("")
CHANGES = (
    NOTHING,
    *(Change("shifted by one row", down=by) for by in (-1, 1)),
    *(Change("shifted by one column", right=by) for by in (-1, 1)),
    Change("flipped left to right", flip_x=True),
    Change("flipped upside down", flip_y=True),
    Change("turned upside down", flip_x=True, flip_y=True),
    *(Change("channels exchanged", order=order) for order in _PERMUTATIONS),
)
_TABLE = np.array([[c.down, c.right, c.flip_x, c.flip_y, *c.order] for c in CHANGES], dtype=np.int64)
_SHIFTS = slice(1, 5)
"""Changes that a path-traced frame and its global-shutter twin cannot show, as their pixels have the same noise:
where the surface moves by about a pixel, the noise looks shifted."""


@dataclass(frozen=True, eq=False)
class Picture:
    """An image in float32, and the range of colours around each pixel."""

    view: ImageView
    colours: Colours
    """(H, W, 3) 8-bit codes."""
    noise: float
    """Standard deviation of the apparent noise, codes."""
    low: NDArray[np.uint8]
    """(H, W, 3) smallest code of the 3 x 3 neighbourhood; ``high`` is the largest."""
    high: NDArray[np.uint8]
    noisy: bool = False
    """Whether a path tracer made the image, so that its apparent noise is real."""

    @classmethod
    def of(cls, view: ImageView, image: NDArray[np.uint8], noisy: bool) -> Picture:
        colours = image.astype(np.float32)
        noise, around = noise_of(colours), np.ones((3, 3), np.uint8)
        low, high = cv2.erode(image, around), cv2.dilate(image, around)
        return cls(view, colours, noise, np.asarray(low), np.asarray(high), noisy)

    @property
    def beyond(self) -> float:
        """Codes by which a colour may lie outside the range from ``low`` to ``high``."""
        return _BEYOND + (_NOISE_FACTOR * self.noise if self.noisy else 0.0)


def noise_of(colours: Colours) -> float:
    """Estimate the standard deviation of the noise, in codes: J. Immerkaer, Fast noise variance estimation, CVIU
    1996, with the median in place of the mean, which texture would raise."""
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
    response = np.abs(cv2.filter2D(colours, cv2.CV_32F, kernel))[1:-1, 1:-1]
    return float(np.median(response)) / 0.6745 / 6.0 if response.size else 0.0


@dataclass(frozen=True, eq=False)
class ColourAgreement:
    """How well an image agrees with another one on the surfaces that both show, by bands of rows."""

    source: ImageView
    target: ImageView
    pixels: NDArray[np.float64]
    """(B,) number of compared pixels."""
    beyond: NDArray[np.float64]
    """(B,) share of these outside the colour range of the other frame's neighbourhood."""
    costs: NDArray[np.float64]
    """(C, B) mean absolute difference after undoing each of ``CHANGES``, codes."""
    errors: NDArray[np.float64]
    """(C, B) standard error of the gain of each change over no change."""
    plain: NDArray[np.float64]
    """(B,) mean absolute difference that the best single colour would leave, codes."""
    refuted: BoolArray
    """(C, B) changes of the source that this pair cannot show, or that another partner clearly contradicts; see
    ``without_refuted``."""

    @property
    def judged(self) -> BoolArray:
        return self.pixels >= _LEAST_PIXELS

    @property
    def better(self) -> NDArray[np.int64]:
        """(B,) index of the change that explains a band better than no change; 0 if there is none."""
        costs = np.where(self.refuted, np.inf, self.costs)
        best, bands = np.argmin(costs, axis=0), np.arange(costs.shape[1])
        least, needed = costs[best, bands], np.maximum(_GAIN, _CHANCE * self.errors[best, bands])
        typical = np.minimum(self.costs[0], self.plain)
        decisive = (least < _BETTER * typical) & (least < self.costs[0] - needed)
        return np.where(decisive, best, 0)

    @property
    def worse(self) -> BoolArray:
        """(C, B) changes that worsen the agreement of a band as clearly as those of ``better`` improve it."""
        least, needed = self.costs[0], np.maximum(_GAIN, _CHANCE * self.errors)
        clear = (least < _BETTER * self.costs) & (least < self.costs - needed)
        return np.asarray(clear & self.judged)

    @property
    def unlike(self) -> BoolArray:
        """(B,) bands in which the two images show different colours."""
        pixels = float(np.sum(self.pixels))
        whole = pixels > 0 and float(np.sum(self.beyond * self.pixels)) > _UNLIKE_WHOLE * pixels
        allowed = _UNLIKE_WHOLE if whole else _UNLIKE
        return self.judged & ((self.beyond > allowed) | (self.better > 0))


def band_of_row(height: int) -> NDArray[np.int64]:
    """Return the number of the band (H,) of each row."""
    bands = max(1, min(_BANDS, height // _LEAST_BAND))
    return np.arange(height) * bands // height


def shown_by(source: Picture, surface: DepthMap, reprojection: Reprojection, stride: int) -> Shown:
    """Return a source for the compiled loops; ``reprojection`` has every ``stride``-th pixel."""
    even = surface.flat | (surface.depth == 0)
    return Shown(source.colours, even, reprojection.pixels, reprojection.relative, stride)


def sampled(
    shown: Shown, target: Picture, count: int, every: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], Colours]:
    """Sample every ``every``-th of the ``count`` source pixels that see the same surface, or sky, as the target.

    Returns:
        Rows and columns (n,) of the samples, and the target's colours (n, 3) there.
    """
    places = np.zeros((count // every + 1, 2), dtype=np.int64)
    y, x = places[: every_nth(shown, every, places)].T
    return y, x, _interpolated(target.colours, shown.pixels[y // shown.stride, x // shown.stride])


def _interpolated(colours: Colours, places: NDArray[np.float32]) -> Colours:
    """Interpolate the colours (n, 3) of an image at places (n, 2)."""
    rows = -(-len(places) // _REMAPPED)
    whole = np.zeros((rows * _REMAPPED, 2), np.float32)
    whole[: len(places)] = places
    whole = whole.reshape(rows, _REMAPPED, 2)
    seen = (
        cv2.remap(colours, whole, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        if rows
        else np.zeros((0, 3), np.float32)
    )
    return np.asarray(seen.reshape(-1, 3)[: len(places)])


def difference(colours: Colours, shown: Colours) -> Colours:
    """Return the mean absolute difference (n,) of the channels, each limited to ``_CAP``."""
    return np.asarray(np.mean(np.minimum(np.abs(colours - shown), _CAP), axis=1))


def compare(
    source: Picture,
    target: Picture,
    surface: DepthMap,
    reprojection: Reprojection,
    votes: NDArray[np.uint8],
    stride: int = 1,
) -> ColourAgreement:
    """Compare every ``stride``-th pixel of the source that sees one flat surface, or the sky, in both pictures.

    ``votes`` (2, H, W) increase by 1 at each pixel whose surface the target sees, and by 1 if its colour differs.
    """
    shown = shown_by(source, surface, reprojection, stride)
    bands = band_of_row(len(shown.even))
    count = int(bands[-1]) + 1
    span, shape = (target.low, target.high, target.beyond), np.zeros((2, count), np.int64)
    by_rows = partial(vote_rows, shown, span, (votes[0], votes[1]), (bands, shape))
    pixels, beyond = np.sum(by_bands(by_rows, len(reprojection.relative)), axis=0)
    costs = _costs(shown, target, bands, int(np.sum(pixels)))
    refuted = np.zeros(costs[0].shape, dtype=np.bool_)
    if source.noisy and source.view[1:3] == target.view[1:3]:
        refuted[_SHIFTS] = True
    share = beyond / np.maximum(pixels, 1)
    return ColourAgreement(source.view, target.view, pixels.astype(np.float64), share, *costs, refuted)


def _costs(
    shown: Shown, target: Picture, bands: NDArray[np.int64], pixels: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return mean capped differences from the target in each band, measured at some of ``pixels``: (C, B) after
    each change, (C, B) standard errors of the gains, (B,) for the median colour of the band."""
    every, count = max(1, pixels // _SAMPLES), int(bands[-1]) + 1
    y, x, seen = sampled(shown, target, pixels, every)
    of, places = bands[y], np.stack([y, x], axis=1)
    size = np.maximum(np.bincount(of, minlength=count), 1)
    sums = np.zeros((2, len(CHANGES), count))
    costs_of_changes(shown.colours, places, seen, of, _TABLE, _CAP, sums)
    costs, squares = sums / size
    errors = np.sqrt(np.maximum(squares - (costs[0] - costs) ** 2, 0.0) / size)
    middle = np.zeros((count, 3), np.float32)
    for band in np.unique(of):
        middle[band] = np.median(seen[of == band], axis=0)
    plain = np.bincount(of, weights=difference(middle[of], seen), minlength=count) / size
    return costs, errors, np.asarray(plain)


def without_refuted(agreements: list[ColourAgreement]) -> list[ColourAgreement]:
    """Mark changes of an image as refuted if another partner contradicts them: a real fault shows against all
    partners, while texture finer than a pixel looks different from each place."""
    result = []
    for each in agreements:
        others = [other.worse for other in agreements if other.source == each.source and other is not each]
        result.append(replace(each, refuted=np.any([each.refuted, *others], axis=0)))
    return result


def wrong_images(agreements: list[ColourAgreement]) -> Iterator[tuple[ImageView, list[ColourAgreement]]]:
    """Images, with the disagreeing pairs that each explains; the image that explains most pairs comes first."""
    left = [each for each in agreements if np.any(each.unlike)]
    while left:
        counts = Counter(view for each in left for view in (each.source, each.target))
        worst = max(counts, key=lambda view: counts[view])
        pairs = [each for each in left if worst in (each.source, each.target)]
        partners = {view for each in pairs for view in (each.source, each.target)} - {worst}
        if len(partners) > 1 or sum(int(np.sum(each.unlike)) for each in pairs) >= _LEAST_EVIDENCE:
            yield worst, pairs
        left = [each for each in left if worst not in (each.source, each.target)]


def tile_rows(votes: NDArray[np.uint8]) -> BoolArray:
    """Return the rows (H,) of tiles in which most pixels differ from what two partners show."""
    seen, against = (np.asarray(each >= 2, dtype=np.int64) for each in votes)
    height = seen.shape[0]
    rows, columns = np.arange(0, height, _TILE), np.arange(0, seen.shape[1], _TILE)
    seen, against = (
        np.add.reduceat(np.add.reduceat(each, rows, axis=0), columns, axis=1) for each in (seen, against)
    )
    spoilt = (seen >= _LEAST_PIXELS) & (against > _BAD_IN_TILE * seen)
    return np.repeat(np.any(spoilt, axis=1), _TILE)[:height]


def single_colour_fault(picture: Picture, others: Mapping[ImageView, Picture]) -> Finding | None:
    """Return a finding for an image of one colour, or a grey image among coloured ones; None for other images."""
    if np.ptp(picture.colours) == 0 and any(np.ptp(other.colours) > 0 for other in others.values()):
        codes = ", ".join(f"{code:g}" for code in picture.colours[0, 0])
        what = "black" if not np.any(picture.colours) else f"of one colour ({codes})"
        return Finding(picture.view.image, f"the image is {what}", "all rows")
    if _chroma(picture) == 0 and any(_chroma(other) > 1.0 for other in others.values()):
        return Finding(picture.view.image, "the image is grey where others have colours", "all rows")
    return None


def _chroma(picture: Picture) -> float:
    """Return the mean absolute deviation of the channels from the mean of their pixel, codes."""
    grey = np.mean(picture.colours, axis=2, keepdims=True)
    return float(np.mean(np.abs(picture.colours - grey)))


OtherImages = Callable[[ImageView], Iterable[tuple[str, NDArray[np.uint8]]]]
"""Names and images of other frames and sequences that may have been exchanged with a view's image."""
_TRIED_PIXELS = 20_000
_PLAIN, _AS_LIKE = 0.7, 1.4
"""Largest difference of a candidate, relative to that of the unchanged image and that of sound pairs."""
_NEARLY = 1.25
"""A change of the image itself is preferred to an exchange if its difference is less than this times as large."""
_NOISY, _NOISIER = 15.0, 3.0
"""Noise in codes that few renderings exceed, and factor over the noise of the other images."""


def colour_faults(
    content: Content, agreements: list[ColourAgreement], other_images: OtherImages
) -> Iterator[tuple[ImageView, Finding]]:
    """Yield a finding for each image that the others contradict."""
    wrong = list(wrong_images(agreements))
    suspects = {view for view, _ in wrong}
    for view, pairs in wrong:
        bands = band_of_row(content.sequence.rig.sensor(view.side).height)
        unlike = np.any([_of_bands(each.unlike, int(bands[-1]) + 1) for each in pairs], axis=0)
        others = sorted({(each.target if each.source == view else each.source).image for each in pairs})
        beyond = 100 * max(float(np.max(each.beyond[each.unlike])) for each in pairs)
        what = (
            f"shows other colours than {', '.join(others)} at the same surface, on up to {beyond:.3g} % of pixels"
        )
        partners = sorted(
            (each for each in view.partners() if each in content.maps), key=lambda each: each in suspects
        )
        cause = "looks like noise" if _is_noise(content.pictures, view, unlike[bands]) else ""
        if partners and not cause:
            cause = _image_cause(content, view, partners[0], agreements, other_images)
        yield view, Finding(view.image, what, rows_of(unlike[bands]), cause)


def _of_bands(unlike: BoolArray, count: int) -> BoolArray:
    """Return flags (B,) for ``count`` bands; flags of an image of another height become one flag for all."""
    return unlike if len(unlike) == count else np.full(count, np.any(unlike))


def _image_cause(
    content: Content,
    view: ImageView,
    partner: ImageView,
    agreements: list[ColourAgreement],
    other_images: OtherImages,
) -> str:
    """Describe the change or exchange that explains the image about as well as sound images agree; "" for none."""
    sequence, maps, pictures = content.sequence, content.maps, content.pictures
    others = [(other.image, picture.colours) for other, picture in pictures.items() if other != view]
    others += [(name, image.astype(np.float32)) for name, image in other_images(view)]
    image = pictures[view].colours
    for name, colours in others:
        if np.array_equal(image[1:], colours[1:]):
            return f"the same as {name}"
    stride = stride_for(image.size / 3, _TRIED_PIXELS)
    reprojection = reproject(sequence, maps[view], maps[partner], stride)
    reprojection = without_changing_light(sequence, maps[view], maps[partner], reprojection, stride)
    source = shown_by(pictures[view], maps[view], reprojection, stride)
    y, x, shown = sampled(source, pictures[partner], reprojection.relative.size, 1)
    if len(y) == 0:
        return ""
    own = image[y, x]
    candidates = [(change.words, change.undone(image, y, x)) for change in CHANGES]
    gain = float(np.median(own) / max(1.0, float(np.median(shown))))
    candidates.append((f"{gain:.3g} times as bright", own / max(gain, 1e-3)))
    changes = len(candidates)
    candidates += [(f"like {name}", colours[y, x]) for name, colours in others if colours.shape == image.shape]
    costs = [float(np.mean(difference(colours, shown))) for _, colours in candidates]
    best = int(np.argmin(costs))
    changed = int(np.argmin(costs[:changes]))
    best = changed if costs[changed] < _NEARLY * costs[best] else best
    if best and costs[best] < min(_PLAIN * costs[0], _AS_LIKE * _usual_difference(agreements)):
        return f"looks {candidates[best][0]}"
    return ""


def _is_noise(pictures: Mapping[ImageView, Picture], view: ImageView, rows: BoolArray) -> bool:
    usual = float(np.median([picture.noise for other, picture in pictures.items() if other != view] or [0.0]))
    return noise_of(pictures[view].colours[rows]) > max(_NOISY, _NOISIER * usual)


def _usual_difference(agreements: list[ColourAgreement]) -> float:
    """Return the median, over the better half of the pairs, of their mean difference in codes."""
    costs = [float(np.average(each.costs[0], weights=each.pixels)) for each in agreements if np.any(each.pixels)]
    return float(np.median(sorted(costs)[: len(costs) // 2 + 1])) if costs else 0.0
