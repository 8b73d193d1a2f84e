"""Stacks of whole frames: the image of row y is the global-shutter one at that row's pose."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from collections.abc import Sequence as Rows

import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.dataset.layout import stack_file, whole_frames
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import ImageView
from rsbench.storage.files import read_png
from rsbench.storage.untrusted_files import inside
from rsbench.verification.content import Content, clean_picture
from rsbench.verification.findings import Finding, rows_of


def stack_faults(content: Content, missing: Collection[str], stride: int = 1) -> Iterator[Finding]:
    """Row y of image y is row y of the rolling-shutter frame, and image 0 is its global-shutter twin; every
    ``stride``-th image is read."""
    sequence = content.sequence
    for view, picture in content.pictures.items():
        rows_scanned = sequence.shutter.axis(view.side) == 1
        if view.shutter != "rs" or not rows_scanned or not whole_frames(sequence.manifest):
            continue
        rows = range(0, sequence.rig.camera.height, stride)
        wrong = np.zeros(sequence.rig.camera.height, dtype=np.bool_)
        for row in rows:
            file = stack_file(view.side, view.frame, row)
            if file in missing:
                continue
            try:
                image = _image(sequence, view, row)
            except RsbenchError as error:
                yield Finding.of(error)
                continue
            wrong[row] = not np.array_equal(image[row], picture.colours[row])
            twin = content.pictures.get(view._replace(shutter="gs"))
            if (
                row == sequence.shutter.first_line(view.side)
                and twin is not None
                and not np.array_equal(image, twin.colours)
            ):
                yield Finding(file, f"differs from {twin.view.image}, which has the same pose")
        if np.any(wrong):
            what = f"{np.sum(wrong)} images differ in their own row from {clean_picture(sequence, view)}"
            yield Finding(f"gs_stack/{view.side}_{view.frame}", what, rows_of(wrong))


def stack_rows(sequence: Sequence, view: ImageView, rows: Rows[int], of: Rows[int]) -> NDArray[np.uint8]:
    """(H, W, 3) of which row ``rows[k]`` is that of image ``of[k]``, and others are black.

    Raises:
        RsbenchError: an image cannot be read.
    """
    camera = sequence.rig.camera
    shown = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
    for row, image in zip(rows, of, strict=True):
        shown[row] = _image(sequence, view, image)[row]
    return shown


def _image(sequence: Sequence, view: ImageView, row: int) -> NDArray[np.uint8]:
    camera = sequence.rig.camera
    file = inside(sequence.folder, stack_file(view.side, view.frame, row))
    return read_png(file, (camera.width, camera.height))
