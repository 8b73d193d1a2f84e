"""What objects that move cost: a rolling-shutter frame with none, one, two and three of them.

Each object is a scene of its own, into whose frame every ray is carried at its own time, shadow rays too. Counted
are seconds of one CPU; runs alternate, so that a busy machine disturbs all alike. Exits with 1 where three objects
cost more than ``--limit`` times what none do.

    python benchmarks/moving.py --size 900 --samples 16 --runs 5
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Sequence

import numpy as np
from render_rs_vs_gs import boxes

from rsbench.core.camera import PinholeCamera
from rsbench.core.motion import LinearMotion
from rsbench.core.moving_objects import MovingObject, poses_of
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.renderers.backend import set_threads, start_backend
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.render import Frame, render
from rsbench.renderers.scene import MitsubaScene
from rsbench.scenes.model import Scene
from rsbench.scenes.object_meshes import Body, with_moving

BODIES = tuple(
    Body(box=(0.8, 0.8, 0.8), position=(x, 0.3, 4.0), attitude_deg=(0.0, 20.0 * number, 0.0), texture_seed=number)
    for number, x in enumerate((-1.2, 0.0, 1.2))
)
MOTION = LinearMotion([0.0, 0.3, 0.0], [0.3, 0.0, 0.1])


def built(name: str) -> Scene:
    if name == "boxes":
        return boxes()
    from rsbench.scenes.load import load_scene

    scene = load_scene(name)
    return scene.seen_from(scene.viewpoints["default"])


def seconds(call: Callable[[], Frame]) -> float:
    begin = time.process_time()
    call()
    return time.process_time() - begin


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--scene", default="boxes", help="the 40 boxes of render_rs_vs_gs.py (default), or a scene"
    )
    parser.add_argument("--size", type=int, default=900, help="width and height of the image, px (default 900)")
    parser.add_argument("--samples", type=int, default=16, help="samples per pixel, a square (default 16)")
    parser.add_argument("--runs", type=int, default=5, help="runs of each kind (default 5)")
    parser.add_argument("--limit", type=float, default=3.0, help="exit with 1 above this ratio (default 3)")
    given = parser.parse_args(arguments)
    start_backend()
    set_threads(1)
    camera = PinholeCamera.centred(given.size, given.size, 0.9 * given.size)
    rig = StereoRig(camera=camera, baseline=0.5)
    tau = RollingShutter(height=given.size, readout_ratio=0.8).row_time(np.arange(given.size), 0)
    R, t = rig.cam_from_world(LinearMotion([0.02, 0.03, 0.05], [0.1, 0.05, 0.2]), tau, "left")
    still, options = built(given.scene), RendererOptions(samples=given.samples)

    def with_objects(count: int) -> Callable[[], Frame]:
        scene = MitsubaScene(with_moving(still, BODIES[:count]))
        poses = poses_of([MovingObject(np.array(each.position), MOTION) for each in BODIES[:count]], tau)
        return lambda: render(scene, camera, R, t, options, objects=poses)

    kinds = [with_objects(count) for count in range(len(BODIES) + 1)]
    shares = [float(np.mean(kind().labels > 0)) for kind in kinds]  # compiles, too
    runs = [[seconds(kind) for kind in kinds] for _ in range(given.runs)]
    ratios = [statistics.median(run[count] / run[0] for run in runs) for count in range(len(kinds))]
    for count, (ratio, share) in enumerate(zip(ratios, shares, strict=True)):
        middle = statistics.median(run[count] for run in runs)
        shown = f"{100 * share:.0f} % of the pixels show them or their shadows"
        sys.stdout.write(f"{count} objects: {middle:.2f} s, {ratio:.2f} times none; {shown}\n")
    return 0 if ratios[-1] <= given.limit else 1


if __name__ == "__main__":
    sys.exit(main())
