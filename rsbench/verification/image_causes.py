"""Causes of a wrong image: candidates are tried against what its partners show."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import ImageView
from rsbench.verification.findings import Finding, rows_of
from rsbench.verification.frame_comparison import BoolArray, DepthMap, reproject, without_changing_light
from rsbench.verification.image_checks import (
    CHANGES,
    ColourAgreement,
    Picture,
    band_of_row,
    difference,
    noise_of,
    show,
    wrong_images,
)

OtherImages = Callable[[ImageView], Iterable[tuple[str, NDArray[np.uint8]]]]
"""Names and images of other sequences that may have been exchanged with a view's."""
_TRIED_PIXELS = 20_000
_PLAIN, _AS_LIKE = 0.7, 1.4
"""A candidate must differ by at most this share of what the image as it is does, and by this factor of what sound
pairs do."""
_NEARLY = 1.25
"""A change of the image itself that is nearly as like is what happened, not an exchange."""
_NOISY, _NOISIER = 15.0, 3.0
"""Codes of noise that few renderings have, and how many times as noisy as the others."""


def colour_faults(
    sequence: Sequence,
    maps: Mapping[ImageView, DepthMap],
    pictures: Mapping[ImageView, Picture],
    agreements: list[ColourAgreement],
    other_images: OtherImages,
) -> Iterator[tuple[ImageView, Finding]]:
    """A finding for each image that the others contradict."""
    wrong = list(wrong_images(agreements))
    suspects = {view for view, _ in wrong}
    bands = band_of_row(sequence.shutter.height)
    for view, pairs in wrong:
        unlike = np.any([each.unlike for each in pairs], axis=0)
        others = sorted({(each.target if each.source == view else each.source).image for each in pairs})
        beyond = 100 * max(float(np.max(each.beyond[each.unlike])) for each in pairs)
        what = (
            f"shows other colours than {', '.join(others)} at the same surface, on up to {beyond:.3g} % of pixels"
        )
        partners = sorted((each for each in view.partners() if each in maps), key=lambda each: each in suspects)
        cause = "looks like noise" if _is_noise(pictures, view, unlike[bands]) else ""
        if partners and not cause:
            cause = _cause(sequence, maps, pictures, view, partners[0], agreements, other_images)
        yield view, Finding(view.image, what, rows_of(unlike[bands]), cause)


def _cause(
    sequence: Sequence,
    maps: Mapping[ImageView, DepthMap],
    pictures: Mapping[ImageView, Picture],
    view: ImageView,
    partner: ImageView,
    agreements: list[ColourAgreement],
    other_images: OtherImages,
) -> str:
    """What turns the image into what the partner shows, as well as sound images are like each other."""
    others = [(other.image, picture.colours) for other, picture in pictures.items() if other != view]
    others += [(name, image.astype(np.float32)) for name, image in other_images(view)]
    image = pictures[view].colours
    for name, colours in others:
        if np.array_equal(image[1:], colours[1:]):
            return f"the same as {name}"
    height, width = image.shape[:2]
    stride = max(1, int(np.sqrt(height * width / _TRIED_PIXELS)))
    reprojection = reproject(sequence, maps[view], maps[partner], stride)
    reprojection = without_changing_light(sequence, maps[view], maps[partner], reprojection, stride)
    y, x, shown = show(maps[view], pictures[partner], reprojection, stride)
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
    if best and costs[best] < min(_PLAIN * costs[0], _AS_LIKE * _usual(agreements)):
        return f"looks {candidates[best][0]}"
    return ""


def _is_noise(pictures: Mapping[ImageView, Picture], view: ImageView, rows: BoolArray) -> bool:
    usual = float(np.median([picture.noise for other, picture in pictures.items() if other != view] or [0.0]))
    return noise_of(pictures[view].colours[rows]) > max(_NOISY, _NOISIER * usual)


def _usual(agreements: list[ColourAgreement]) -> float:
    """Mean difference, in codes, of the least unlike half of the pairs."""
    costs = [float(np.average(each.costs[0], weights=each.pixels)) for each in agreements if np.any(each.pixels)]
    return float(np.median(sorted(costs)[: len(costs) // 2 + 1])) if costs else 0.0
