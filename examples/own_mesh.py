"""A dataset from a mesh of your own: here a torus that this script makes; put your file in its place.

python examples/own_mesh.py --out own
python examples/own_mesh.py --out own --picture own/frames.jpg
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import trimesh

import rsbench
from rsbench.components.cards import card_path

DATASET = """
name = "own"
baseline = 0.2
readout_ratio = 1.0
frame_period_s = 0.1
renderer = "default"

[camera]
width = 480
height = 360
focal = 480.0

[motion]
model = "linear"
rotation_deg = 8.0
rotation_axis = [0.3, 1.0, 0.5]
translation = 0.4
translation_axis = [1.0, 0.2, 0.0]

[[sequence]]
name = "torus"
scene = "{scene}"
"""


def torus(file: Path) -> None:
    """A torus of coloured faces, in units and at a place that the scene card need not know."""
    mesh = trimesh.creation.torus(40.0, 14.0)
    mesh.apply_translation((1000.0, 0.0, 250.0))
    colours = np.random.default_rng(0).integers(60, 255, (len(mesh.faces), 4), dtype=np.uint8)
    colours[:, 3] = 255
    mesh.visual.face_colors = colours
    mesh.export(file)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("own"), help="folder of the cards and the dataset")
    parser.add_argument("--picture", type=Path, help="also draw the frames beside the global-shutter truth")
    chosen = parser.parse_args()
    chosen.out.mkdir(parents=True, exist_ok=True)
    torus(chosen.out / "model.glb")
    # The card for meshes that comes with rsbench, under a name of its own.
    scene = card_path("scenes", "mesh").read_text("utf-8").replace('name = "mesh"', 'name = "own-mesh"')
    (chosen.out / "own-mesh.toml").write_text(scene, "utf-8")
    # Paths of scenes start where the command runs.
    (chosen.out / "own.toml").write_text(DATASET.format(scene=(chosen.out / "own-mesh.toml").as_posix()), "utf-8")
    rsbench.generate(chosen.out / "own.toml", chosen.out / "data")
    print(f"made: {chosen.out / 'data'}")
    if chosen.picture is not None:
        (sequence,) = rsbench.read_dataset(chosen.out / "data")
        frames = [sequence.image(kind, "left", 1) for kind in ("rs", "gs")]
        picture = cv2.cvtColor(np.hstack(frames), cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(chosen.picture), picture, [cv2.IMWRITE_JPEG_QUALITY, 80])


if __name__ == "__main__":
    main()
