"""The channel ``hdr`` against the images: the same light, before it is clipped and rounded."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.dataset.channels import radiance_file
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import ImageView
from rsbench.renderers.image import linear_of_codes, to_srgb8
from rsbench.verification.content import clean_picture
from rsbench.verification.findings import Finding, rows_of
from rsbench.verification.image_checks import Picture

_CODE = 0.54
"""Codes by which light may differ from a code: its rounding, and that of half floats by 2^-12 of a value."""
_FEW, _LEAST = 1e-3, 8


def hdr_faults(
    sequence: Sequence, pictures: Mapping[ImageView, Picture], reported: Collection[str]
) -> Iterator[Finding]:
    """What linear images show otherwise than the clean images, but for files ``reported``."""
    renderer = sequence.manifest.get("renderer")
    exposure = renderer.get("exposure") if isinstance(renderer, dict) else None
    if "hdr" not in sequence.channels or not isinstance(exposure, float):
        return
    for view, picture in pictures.items():
        file, image = radiance_file(view.side, view.frame), clean_picture(sequence, view)
        if view.shutter != "rs" or {file, image} & set(reported):
            continue
        try:
            radiance = sequence.radiance(view.side, view.frame)
        except RsbenchError as error:
            yield Finding.of(error)
            continue
        light, codes = radiance * exposure, picture.colours
        dark = (codes > 0) & (light < linear_of_codes(codes - _CODE))
        wrong = np.any(dark | ((codes < 255) & (light > linear_of_codes(codes + _CODE))), axis=-1)
        if np.sum(wrong) > max(_FEW * wrong.size, _LEAST):
            off = np.max(np.abs(to_srgb8(radiance, exposure) - codes))
            what = f"{100 * np.mean(wrong):.3g} % of {wrong.size} pixels are not {image} before its rounding"
            rows = np.mean(wrong, axis=1)
            in_rows = rows_of(rows > 0.5 * np.max(rows))
            yield Finding(file, f"{what}, by up to {off:g} codes", in_rows, _cause(light, picture))


def _cause(light: NDArray[np.float32], picture: Picture) -> str:
    """What linear values (H, W, 3) are instead, in words; "" where nothing explains most of them."""
    wanted = linear_of_codes(picture.colours)
    open_ = (wanted > 0.02) & (wanted < 0.98)
    if not np.any(light):
        return "looks zeroed"
    ratio = float(np.median(light[open_] / wanted[open_])) if np.any(open_) else 1.0
    tried = {
        f"scaled by {ratio:.3g}": light / max(ratio, 1e-9),
        "red and blue exchanged": light[..., ::-1],
        "upside down": light[::-1],
        "encoded as sRGB": linear_of_codes(255.0 * light),
    }
    costs = {words: float(np.mean(np.abs(each - wanted)[open_])) for words, each in tried.items()}
    best = min(costs, key=costs.__getitem__)
    return f"looks {best}" if costs[best] < 0.2 * float(np.mean(np.abs(light - wanted)[open_])) else ""
