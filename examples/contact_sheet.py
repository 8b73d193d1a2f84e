"""One picture of a dataset: a frame of each sequence, three in a row.

rsbench generate scenes --out data/scenes
python examples/contact_sheet.py data/scenes scenes.jpg
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

import rsbench

COLUMNS = 3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, help="folder with a dataset.json")
    parser.add_argument("picture", type=Path, help="file to write")
    chosen = parser.parse_args()
    try:
        frames = [sequence.image("rs", "left", 0) for sequence in rsbench.read_dataset(chosen.dataset)]
    except rsbench.RsbenchError as error:
        parser.error(str(error))
    frames += [np.zeros_like(frames[0])] * (-len(frames) % COLUMNS)
    rows = [np.hstack(frames[first : first + COLUMNS]) for first in range(0, len(frames), COLUMNS)]
    sheet = cv2.cvtColor(np.vstack(rows), cv2.COLOR_RGB2BGR)
    _, content = cv2.imencode(chosen.picture.suffix, sheet, [cv2.IMWRITE_JPEG_QUALITY, 82])
    chosen.picture.write_bytes(content.tobytes())


if __name__ == "__main__":
    main()
