"""The moving picture of README: a frame and its correction, each in turn with the truth, and the estimated depth.

python examples/before_after.py docs/before-after.gif
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

import rsbench

if TYPE_CHECKING:
    from rsbench.dataset.sequence import Sequence

Picture = NDArray[np.uint8]
WIDTH, GAP, HEAD, MILLISECONDS = 290, 10, 26, 900
CARD = """
name = "before-after"
baseline = 0.5
readout_ratio = 1.0

[camera]
width = 600
height = 600
focal = 760

[motion]                        # per frame period: a pan by 7 deg, and 0.4 m sideways
rotation_deg = 7.0
rotation_axis = [0.15, 1.0, 0.2]
translation = 0.4
translation_axis = [1.0, 0.1, 0.3]

[[sequence]]
name = "castle"
scene = "castle"
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", type=Path, help="GIF to write")
    parser.add_argument("--data", type=Path, default=Path("data/before-after"), help="folder of the frames")
    chosen = parser.parse_args()
    chosen.data.mkdir(parents=True, exist_ok=True)
    card = chosen.data.with_suffix(".toml")
    card.write_text(CARD, "utf-8")
    try:
        (sequence,) = rsbench.generate(str(card), chosen.data)
        moving_picture(sequence, chosen.picture)
    except rsbench.RsbenchError as error:
        parser.error(str(error))


def moving_picture(sequence: Sequence, path: Path) -> None:
    images = [sequence.image("rs", side, frame) for frame in (0, 1) for side in ("left", "right")]
    corrected = rsbench.correct(images, sequence.rig, sequence.shutter.readout_ratio).frames["left", 1]
    truth = ("global-shutter truth", sequence.image("gs", "left", 1))
    depth = ("estimated depth", coloured(corrected.depth))
    shown = [
        [("rolling-shutter frame", images[2]), ("corrected, from 4 RS frames", corrected.image), depth],
        [truth, truth, depth],
    ]
    first, *rest = [strip(panels) for panels in shown]
    path.parent.mkdir(parents=True, exist_ok=True)
    first.save(path, save_all=True, append_images=rest, duration=MILLISECONDS, loop=0, optimize=True)


def coloured(depth: NDArray[np.floating]) -> Picture:
    """Near is yellow, unknown black."""
    known = depth > 0
    inverse = 1 / np.where(known, depth, np.inf)
    low, high = np.percentile(inverse[known], [1, 99])
    levels = np.clip(255 * (inverse - low) / (high - low), 0, 255).astype(np.uint8)
    return np.where(known[..., None], cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)[..., ::-1], 0).astype(
        np.uint8
    )


def strip(panels: list[tuple[str, Picture]]) -> Image.Image:
    """Panels side by side below their names, in 256 colours."""
    sheet = Image.new("RGB", (len(panels) * (WIDTH + GAP) - GAP, HEAD + WIDTH), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(15)
    for column, (name, picture) in enumerate(panels):
        left = column * (WIDTH + GAP)
        small = cv2.resize(picture, (WIDTH, WIDTH), interpolation=cv2.INTER_AREA)
        sheet.paste(Image.fromarray(small), (left, HEAD))
        draw.text((left + WIDTH / 2, HEAD / 2), name, fill="black", font=font, anchor="mm")
    return sheet.quantize(256, dither=Image.Dither.NONE)


if __name__ == "__main__":
    main()
