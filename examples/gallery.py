"""The pictures of the documentation's gallery: cameras, channels and correctors on one motion.

python examples/gallery.py --data out --pictures docs/pictures
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

import rsbench

CARD = """
name = "{name}"
baseline = 0.3
{reading}

[camera]
width = 480
height = 360
focal = {focal}
{lens}

[motion]
rotation_deg = 4
rotation_axis = [0.2, 1.0, -0.4]
translation = 0.4
translation_axis = [1.0, 0.1, 0.4]

[[sequence]]
name = "castle"
scene = "castle"

{sensor}
"""
ROWS = "readout_ratio = 0.8"
SENSOR = """[sensor]
exposure_s = 0.02
full_well = 1500
gain = 8
photon_noise = true
read_noise = 2.5
bit_depth = 10"""
CAMERAS = {
    "ideal": (ROWS, 420, "", ""),
    "brown-conrady": (ROWS, 380, 'lens = { model = "brown-conrady", k1 = -0.25, k2 = 0.05 }', ""),
    "kannala-brandt": (ROWS, 240, 'lens = { model = "kannala-brandt", k1 = -0.02 }', ""),
    "bottom-up": (f'{ROWS}\nscan = "bottom"', 420, "", ""),
    "columns": (f'{ROWS}\nscan = "left"', 420, "", ""),
    "sensor": (ROWS, 420, "", SENSOR),
}
CORRECTORS = ("rotation-only", "one-plane", "zhuang", "vasu-layers", "fusion")
SIZE = (300, 225)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder for the datasets")
    parser.add_argument("--pictures", type=Path, required=True, help="folder for the pictures")
    chosen = parser.parse_args()
    chosen.data.mkdir(parents=True, exist_ok=True)
    chosen.pictures.mkdir(parents=True, exist_ok=True)
    sequences = {name: rendered(chosen.data, name) for name in CAMERAS}
    frames = [sequence.image("rs", "left", 1) for sequence in sequences.values()]
    write(chosen.pictures / "cameras.jpg", frames)
    write(chosen.pictures / "channels.jpg", channels(sequences["ideal"]))
    write(chosen.pictures / "correctors.jpg", corrected(sequences["ideal"]))


def rendered(data: Path, name: str) -> rsbench.dataset.sequence.Sequence:
    """A sequence of one of the cameras, with channels where it is the ideal one."""
    reading, focal, lens, sensor = CAMERAS[name]
    if name == "ideal":
        reading += '\nchannels = ["disparity", "flow", "gs_flow", "normals", "instances"]'
    card = data / f"{name}.toml"
    card.write_text(CARD.format(name=name, reading=reading, focal=focal, lens=lens, sensor=sensor), "utf-8")
    return rsbench.generate(str(card), data / name)[0]


def channels(sequence: rsbench.dataset.sequence.Sequence) -> list[np.ndarray]:
    """As colours: depth, disparity, flow to the other frame and to the twin, normals, instances."""
    depth = sequence.depth("rs", "left", 1)
    near = np.where(depth > 0, 1 / np.maximum(depth, 1e-3), 0)
    numbers = sequence.instances("left", 1)
    colours = np.random.default_rng(1).integers(40, 255, (int(numbers.max()) + 1, 3))
    colours[0] = 0
    return [
        ramp(near),
        ramp(np.nan_to_num(sequence.offsets("disparity", "left", 1)[..., 0])),
        directions(sequence.offsets("flow", "left", 1)),
        directions(sequence.offsets("gs_flow", "left", 1)),
        (127.5 * (1 + sequence.normals("left", 1))).astype(np.uint8),
        colours[numbers].astype(np.uint8),
    ]


def ramp(values: np.ndarray) -> np.ndarray:
    """Dark to bright up to the 99th percentile."""
    share = np.clip(values / np.percentile(values, 99), 0, 1)
    return cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1]


def directions(flow: np.ndarray) -> np.ndarray:
    """Hue is the direction, brightness the length up to the 99th percentile."""
    x, y = np.moveaxis(np.nan_to_num(flow), -1, 0).astype(np.float64)
    length = np.hypot(x, y)
    hue = (np.degrees(np.arctan2(y, x)) % 360) / 2
    bright = 255 * np.clip(length / np.percentile(length, 99), 0, 1)
    colour = np.stack([hue, np.full_like(hue, 255), bright], -1).astype(np.uint8)
    return cv2.cvtColor(colour, cv2.COLOR_HSV2RGB)


def corrected(sequence: rsbench.dataset.sequence.Sequence) -> list[np.ndarray]:
    """The rolling-shutter frame and what correctors make of it, over the truth."""
    images = [sequence.image("rs", side, frame) for frame in (0, 1) for side in ("left", "right")]
    truth = sequence.image("gs", "left", 1)
    shown = [sequence.image("rs", "left", 1)]
    for name in CORRECTORS:
        found = rsbench.correct(images, sequence.rig, readout_ratio=0.8, corrector=name)
        shown.append(found.frames["left", 1].image)
    return [np.stack([image.mean(-1), truth.mean(-1), truth.mean(-1)], -1).astype(np.uint8) for image in shown]


def write(path: Path, images: list[np.ndarray]) -> None:
    """Six pictures, three in a row."""
    small = [cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA) for image in images]
    sheet = np.vstack([np.hstack(small[:3]), np.hstack(small[3:])])
    _, content = cv2.imencode(".jpg", cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 62])
    path.write_bytes(content.tobytes())


if __name__ == "__main__":
    main()
