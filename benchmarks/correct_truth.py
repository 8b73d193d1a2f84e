"""What correction costs when depth and motion are true: geometry, and resampling.

Geometry: the flow takes every pixel of the rolling-shutter frame to its place in the corrected one; the exact
place is the projection of its true point. Backwards, every pixel of the corrected frame says which pixel of the
rolling-shutter frame it shows; the exact answer is the row equation of the point that a global-shutter depth map
sees there, which the correction has to guess from the depth of the neighbouring pixels.

Image: what is left against the rendered truth, beside what resampling a global-shutter image by the same sub-pixel
shifts leaves. For that, images are rendered with the principal point shifted by quarters of a pixel in x and y and
resampled back; each pixel takes the one whose shift is nearest to its own in the corrected frame.

    python benchmarks/correct_truth.py --data data/paper --sequence castle
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.components.cards import load_card
from rsbench.core.camera import PinholeCamera
from rsbench.core.projection import back_project, project_at, rs_project_near
from rsbench.core.rig import Side
from rsbench.core.se3 import Pose
from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.renderers.backend import start_backend
from rsbench.renderers.image import to_srgb8
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.render import render_global
from rsbench.renderers.scene import MitsubaScene
from rsbench.scenes.load import load_scene
from rsbench.vision.correction import Corrected, correct_frame, correction_flow
from rsbench.vision.images import resample
from rsbench.vision.quality import psnr

BOUND_PX = 0.01
SIDE: Side = "left"
FRAME = 1
STEPS = 4
Mask = NDArray[np.bool_]


def visible(sequence: Sequence, corrected: Corrected) -> tuple[NDArray[np.float64], Mask]:
    """Error of the source pixel (H, W), px, and the surface pixels that the frame saw, clear of depth edges."""
    rig, camera = sequence.rig, sequence.rig.camera
    depth = sequence.depth("gs", SIDE, FRAME)
    R, t = rig.cam_from_world(sequence.motion, float(FRAME), SIDE)
    grid = camera.pixel_grid()
    points = (depth[..., None] * camera.unproject(grid) - t) @ R
    seen = rs_project_near(rig, sequence.shutter, sequence.motion, SIDE, FRAME, points, grid[..., 1])
    rolling = sequence.depth("rs", SIDE, FRAME)
    near = np.nan_to_num(seen.pixels).astype(np.float32)
    there = cv2.remap(rolling, near, None, cv2.INTER_NEAREST)
    same = np.abs(there - seen.depth) < 0.01 * seen.depth
    clear = flat(depth) & (cv2.remap(flat(rolling).astype(np.uint8), near, None, cv2.INTER_NEAREST) > 0)
    limit = np.array([camera.width - 1, camera.height - 1])
    inside = np.all((near >= 1) & (near <= limit - 1), axis=-1)
    mask = (depth > 0) & np.isfinite(seen.depth) & same & clear & inside
    return np.linalg.norm(corrected.source_map - seen.pixels, axis=-1), mask


def flow_errors(sequence: Sequence) -> NDArray[np.float64]:
    """Errors (n,), px, of the flow of all surface pixels of the rolling-shutter frame."""
    depth, grid = sequence.depth("rs", SIDE, FRAME), sequence.rig.camera.pixel_grid()
    geometry = sequence.rig, sequence.shutter, sequence.motion
    flow = correction_flow(depth, sequence, (SIDE, FRAME))
    points = back_project(*geometry, SIDE, FRAME, grid, depth)
    exact = project_at(sequence.rig, sequence.motion, SIDE, float(FRAME), points)[..., :2] - grid
    return np.asarray(np.linalg.norm(flow - exact, axis=-1)[depth > 0])


def flat(depth: NDArray[np.float32], reach: int = 3) -> Mask:
    """Pixels with no jump of depth of 2 % within ``reach`` px."""
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    return np.asarray(cv2.dilate(depth, kernel) <= 1.02 * cv2.erode(depth, kernel))


def resampled_like(corrected: Corrected, sequence: Sequence, card: str) -> NDArray[np.uint8]:
    """The global-shutter image of the sequence, resampled by the sub-pixel shifts of ``corrected``."""
    dataset = load_dataset_card(card)
    entry = next(one for one in dataset.sequence if one.name == sequence.name)
    options = load_card(RendererOptions, "renderers", dataset.renderer)
    scene = load_scene(entry.scene)
    mitsuba_scene = MitsubaScene(scene.seen_from(scene.viewpoints[entry.viewpoint]))
    pose = sequence.rig.cam_from_world(sequence.motion, float(FRAME), SIDE)
    camera = sequence.rig.camera
    part = np.nan_to_num(corrected.source_map) % 1.0
    nearest = np.rint(part * STEPS).astype(int) % STEPS
    out = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
    for j, i in product(range(STEPS), repeat=2):
        shift = np.array([i, j]) / STEPS
        image = render_shifted(mitsuba_scene, camera, pose, shift, options)
        back = resample(image, (camera.pixel_grid() + shift).astype(np.float32))
        mine = (nearest[..., 0] == i) & (nearest[..., 1] == j)
        out[mine] = back[mine]
    return out


def render_shifted(
    scene: MitsubaScene, camera: PinholeCamera, pose: Pose, shift: NDArray[np.float64], options: RendererOptions
) -> NDArray[np.uint8]:
    """What lies at x of the camera's image lies at x + shift of this one."""
    moved = replace(camera, cx=camera.cx + shift[0], cy=camera.cy + shift[1])
    return to_srgb8(render_global(scene, moved, pose.R, pose.t, options).image, options.exposure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("data/paper"), help="dataset (rsbench generate CARD)")
    parser.add_argument("--card", default="paper", help="card that it was made from (default paper)")
    parser.add_argument("--sequence", default="castle", help="which of its sequences (default castle)")
    arguments = parser.parse_args()
    start_backend()
    sequence = next(one for one in read_dataset(arguments.data) if one.name == arguments.sequence)
    rolling, depth = sequence.image("rs", SIDE, FRAME), sequence.depth("rs", SIDE, FRAME)
    corrected = correct_frame(rolling, depth, sequence, (SIDE, FRAME), sky_mask=depth == 0)
    error, mask = visible(sequence, corrected)
    write = sys.stdout.write
    flow = flow_errors(sequence)
    write(f"flow of {len(flow)} surface pixels: at most {np.max(flow):.1e} px\n")
    write(f"{sequence.name}: {np.count_nonzero(mask)} visible pixels clear of depth edges, ")
    write(f"{100 * np.mean(corrected.mask[mask]):.3f} % of them covered\n")
    known = error[mask & corrected.mask]
    write(f"source pixel: median {np.median(known):.1e} px, 99.9 % below {np.quantile(known, 0.999):.1e} px, ")
    write(f"{100 * np.mean(known < BOUND_PX):.3f} % below {BOUND_PX:g} px\n")
    truth = sequence.image("gs", SIDE, FRAME)
    again = resampled_like(corrected, sequence, arguments.card)
    for name, where in (("clear of edges", mask & corrected.mask), ("all that was drawn", corrected.mask)):
        write(f"{name}: corrected {psnr(corrected.image, truth, where):.2f} dB, ")
        write(f"truth resampled by the same shifts {psnr(again, truth, where):.2f} dB, ")
        write(f"uncorrected {psnr(rolling, truth, where):.2f} dB\n")


if __name__ == "__main__":
    main()
