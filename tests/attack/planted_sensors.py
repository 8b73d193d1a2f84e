"""Faults planted into what cameras make of what they read: the left one interpolates, the right one compresses."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from attack.planting import RNG, VICTIM, Fault, Plant, image_of, manifest_of, put
from rsbench.dataset.sequence import read_sequence
from rsbench.renderers.image import Sensor, compressed, expose, linear_of_codes, processed, rows_needed
from rsbench.storage.files import read_png, write_png

CAMERA = Sensor(
    full_well=6000,
    gain=4,
    photon_noise=True,
    read_noise=2.5,
    bit_depth=10,
    mosaic="RGGB",
    right_mosaic="none",
    right_jpeg_quality=80,
)
Pixels = NDArray[np.uint8]


def _made_by(view: str, **changes: Any) -> Plant:
    """A frame as another sensor makes it of the clean twin, with noise of its own."""

    def plant(folder: Path) -> None:
        home, (side, _, frame) = folder / VICTIM, view.partition("_")
        sensor = replace(read_sequence(home).sensor or Sensor(), **changes).of(side, int(frame))
        clean = read_png(home / f"rs_clean/{view}.png")
        rows = range(len(clean))
        needed = rows_needed(sensor, rows, len(clean))
        read = expose(linear_of_codes(clean).astype(np.float32), sensor, RNG, len(clean), needed)
        write_png(home / f"rs/{view}.png", processed(read, sensor, len(clean), needed, rows))

    return plant


def _everywhere(key: str, value: Any) -> Plant:
    """Another sensor in sequence.json and in the card."""

    def plant(folder: Path) -> None:
        manifest_of(f"{VICTIM}/sequence.json", put("sensor", key, value))(folder)
        manifest_of("dataset.json", put("card", "sensor", key, value))(folder)

    return plant


def _in_rows(change: Callable[[Pixels], Pixels]) -> Callable[[Pixels], Pixels]:
    def changed(image: Pixels) -> Pixels:
        image[40:60] = change(image.copy())[40:60]
        return image

    return changed


def _smooth(image: Pixels) -> Pixels:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.7), dtype=np.uint8)


def _sensor_faults() -> Iterator[Fault]:
    left, right = "rs/left_1.png", "rs/right_0.png"
    mosaic, jpeg = "mosaic RGGB", "no JPEG image of quality 80"
    for name, plant, words in (
        ("no mosaic", _made_by("left_1", mosaic="none"), "looks like no mosaic"),
        ("another mosaic", _made_by("left_1", mosaic="GBRG"), "looks like GBRG"),
        ("shifted by a row", image_of("rs", "left_1", lambda image: np.roll(image, 1, axis=0)), mosaic),
        ("compressed", image_of("rs", "left_1", lambda image: compressed(image, 90)), mosaic),
        ("three times the gain", _made_by("left_1", gain=12), "the variance of the sensor's"),
        ("upside down", image_of("rs", "left_1", np.flipud), "beyond 5 sigma"),
        ("smoothed rows", image_of("rs", "left_1", _in_rows(_smooth)), mosaic),
    ):
        yield Fault(f"{left} {name}", plant, (left, words))
    for name, plant, words in (
        ("not compressed", _made_by("right_0", right_jpeg_quality=0), jpeg),
        ("of quality 60", _made_by("right_0", right_jpeg_quality=60), "looks like quality 60"),
        ("shifted by a row", image_of("rs", "right_0", lambda image: np.roll(image, 1, axis=0)), ""),
        ("upside down", image_of("rs", "right_0", np.flipud), "beyond 5 sigma"),
        ("rows of every fourth code", image_of("rs", "right_0", _in_rows(lambda image: image // 4 * 4)), jpeg),
    ):
        yield Fault(f"{right} {name}", plant, (right, words))
    yield Fault("another mosaic everywhere", _everywhere("mosaic", "BGGR"), ("rs/left_0.png", "looks like RGGB"))
    yield Fault(
        "another quality everywhere", _everywhere("right_jpeg_quality", 90), ("rs/right_0.png", "quality 80")
    )
    no = _everywhere("right_jpeg_quality", None)
    yield Fault("no compression everywhere", no, ("rs/right_0.png", "variance of the sensor's"))
    own = manifest_of(f"{VICTIM}/sequence.json", put("sensor", "mosaic", "none"))
    yield Fault("no mosaic in sequence.json", own, ("sequence.json", "sensor"))


SENSOR_FAULTS = tuple(_sensor_faults())
"""In a dataset like ``smoke`` whose sensor is ``CAMERA``."""
