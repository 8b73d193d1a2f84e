"""How bright scenes are by each way of rendering the sky, beside the path tracer, and what it costs.

    python benchmarks/sky.py castle street room forest

Prints, of the pixels that see a surface from the default viewpoint at 160 x 120, the mean over that of ``path``
with direct light only and with ``max_depth = 4``, and the CPU seconds of a frame.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from rsbench.core.camera import PinholeCamera
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.render import render_global
from rsbench.renderers.scene import MitsubaScene
from rsbench.scenes.load import load_scene

CAMERA = PinholeCamera.centred(160, 120, 160.0)
TRACED = {
    "direct": RendererOptions(integrator="path", samples=256, max_depth=2),
    "path": RendererOptions(integrator="path", samples=144, max_depth=4),
}
WAYS = {f"sky_rays = {rays}": RendererOptions(sky_rays=rays) for rays in (0, 1, 2, 4, 16)}


def brightness(scene: MitsubaScene, options: RendererOptions) -> tuple[float, float]:
    """Mean of the surfaces, and CPU seconds of a second frame."""
    for _ in range(2):
        start = time.process_time()
        frame = render_global(scene, CAMERA, np.eye(3), np.zeros(3), options)
        seconds = time.process_time() - start
    return float(np.mean(frame.image[frame.depth > 0])), seconds


def main() -> None:
    for name in sys.argv[1:]:
        built = load_scene(name)
        scene = MitsubaScene(built.seen_from(built.viewpoints["default"]))
        traced = {key: brightness(scene, options)[0] for key, options in TRACED.items()}
        for words, options in WAYS.items():
            mean, seconds = brightness(scene, options)
            shares = ", ".join(f"{mean / value:.3f} of {key}" for key, value in traced.items())
            sys.stdout.write(f"{name}, {words}: {shares}; {seconds:.2f} CPU-s\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
