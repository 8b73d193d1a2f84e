"""Faults planted into a scene with glossy surfaces: those of others, and masks that hide something."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attack.planted_faults import depth_faults, image_faults
from attack.planting import RNG, VICTIM, Fault, Plant, drop, image_of, manifest_of, removed, swapped
from rsbench.dataset.sequence import read_sequence
from rsbench.dataset.views import IMAGE_VIEWS, ImageView
from rsbench.storage.files import read_mask, write_mask, write_png

Mask = NDArray[np.bool_]
BAND = slice(30, 66)
"""Rows behind which a fault hides."""
ONE = ImageView("rs", "left", 1)


def _masks(change: Callable[[Mask, Mask], Mask], *views: ImageView) -> Plant:
    """``change`` takes a mask, and where there is a surface."""

    def plant(folder: Path) -> None:
        sequence = read_sequence(folder / VICTIM)
        for view in views:
            path, solid = sequence.folder / view.gloss, sequence.depth(*view) > 0
            write_mask(path, change(read_mask(path), solid) & solid)

    return plant


def _band(mask: Mask, solid: Mask) -> Mask:
    mask[BAND] = True
    return mask


def _everything(mask: Mask, solid: Mask) -> Mask:
    return solid


def _all(*plants: Plant) -> Plant:
    def plant(folder: Path) -> None:
        for each in plants:
            each(folder)

    return plant


def _noise(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    image[BAND] = np.random.default_rng(RNG).integers(0, 256, image[BAND].shape, dtype=np.uint8)
    return image


def _noise_on_gloss(folder: Path) -> None:
    gloss = read_sequence(folder / VICTIM).gloss(*ONE)

    def change(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        noise = np.random.default_rng(RNG).integers(0, 256, image.shape, dtype=np.uint8)
        return np.where(gloss[..., None], noise, image)

    image_of(ONE.shutter, f"{ONE.side}_{ONE.frame}", change)(folder)


def _written(values: Callable[[Mask], NDArray[Any]]) -> Plant:
    def plant(folder: Path) -> None:
        path = folder / VICTIM / ONE.gloss
        write_png(path, values(read_mask(path)))

    return plant


def _mask_faults() -> Iterator[Fault]:
    file, every = ONE.gloss, tuple(IMAGE_VIEWS)
    for name, change, words in (
        ("emptied", lambda mask, solid: mask & False, "marks other surfaces"),
        ("of all", _everything, "leaves 0 %"),
        ("of a band of rows", _band, "rows"),
        ("upside down", lambda mask, solid: mask[::-1], ""),
        ("left to right", lambda mask, solid: mask[:, ::-1], ""),
        ("shifted by 6 pixels", lambda mask, solid: np.roll(mask, 6, axis=1), ""),
    ):
        yield Fault(f"{file} {name}", _masks(change, ONE), (file, words))
    for other in (ONE.other_side, ONE.frame_before):
        yield Fault(f"{file} exchanged with {other.gloss}", swapped((file, other.gloss)), (file,))
    yield Fault(
        f"{file} in the sky", _written(lambda mask: np.full(mask.shape, 255, np.uint8)), (file, "no surface")
    )
    yield Fault(f"{file} of other values", _written(lambda mask: mask.astype(np.uint8)), (file, "0 and 255"))
    yield Fault(f"{file} of one row less", _written(lambda mask: 255 * mask[1:].astype(np.uint8)), (file,))
    yield Fault(f"{file} gone", removed(f"{VICTIM}/{file}"), (file,))
    yield Fault("every mask of all", _masks(_everything, *every), ("_gloss/", "leaves 0 %"))
    yield Fault("every mask of all, rays", _masks(_everything, *every), (file, "rays meet"), rendered=True)
    hidden = _all(_masks(_band, *every), image_of(ONE.shutter, f"{ONE.side}_{ONE.frame}", _noise))
    yield Fault("noise behind every mask", hidden, (file, "rays meet"), rendered=True)
    yield Fault("noise behind every mask, seen", hidden, (ONE.image, "other colours"), rendered=True)
    yield Fault("noise on gloss", _noise_on_gloss, (ONE.image,), rendered=True)
    unsaid = manifest_of(f"{VICTIM}/sequence.json", drop("glossy"))
    yield Fault("gloss unsaid", unsaid, ("sequence.json", "glossy"), rendered=True)


def _others() -> Iterator[Fault]:
    """Of those planted into ``smoke`` all that need no second sequence.

    Where so much is glossy, too little is compared to tell left from right images.
    """
    for fault in (*depth_faults(), *image_faults()):
        if fault.name == "all left and right images exchanged":
            yield replace(fault, words=(ONE.image, "rendered again"), rendered=True)
        elif "another sequence" not in fault.name:
            yield fault


GLOSS_FAULTS = (*_mask_faults(), *_others())
"""In a dataset like ``smoke`` whose victim is of the scene ``wet-castle``."""
