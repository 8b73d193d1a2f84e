"""Times a rolling-shutter frame beside a global-shutter one: sharp, exposed, through a lens, with moving objects.

The paper's recipe renders one global-shutter image per row, so a rolling-shutter frame of 900 rows costs 900 of
them; the single pass should cost one. An exposure takes a tenth of a period; each of one to three moving objects
is a scene of its own, into whose frame every ray is carried at its own time, shadow rays too. Runs alternate, so
that a busy machine disturbs all kinds alike. Prints seconds and ratios (medians); exits with 1 above a limit.

    python benchmarks/render_rs_vs_gs.py --size 900 --samples 16 --runs 7
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import trimesh

from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.geometry import MovingObject, poses_of
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.renderers.backend import start_backend
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.pixel_samples import instant_count, instant_times
from rsbench.renderers.render import Frame, LinePoses, render, render_global
from rsbench.renderers.scene import MitsubaScene
from rsbench.scenes.model import Light, Material, Scene, SceneMesh
from rsbench.scenes.object_meshes import Body, with_moving

LENSES = (
    Lens(model="brown-conrady", k1=-0.28, k2=0.07, p1=0.002, p2=-0.001, k3=0.004),
    Lens(model="kannala-brandt", k1=-0.04, k2=0.012, k3=-0.003, k4=0.0005),
)
LENS_NAMES = {lens.model for lens in LENSES}
BODIES = tuple(
    Body(box=(0.8, 0.8, 0.8), position=(x, 0.3, 4.0), attitude_deg=(0.0, 20.0 * number, 0.0), texture_seed=number)
    for number, x in enumerate((-1.2, 0.0, 1.2))
)
MOVES = LinearMotion([0.0, 0.3, 0.0], [0.3, 0.0, 0.1])
GLOBAL, ROLLING, EXPOSED = "global shutter", "rolling shutter", "exposed"


def boxes(count: int = 40) -> Scene:
    """Textured ground and boxes before the camera, world frame (y down)."""
    rng = np.random.default_rng(1)
    noise = Material(name="noise", texture=rng.integers(0, 256, (256, 256, 3), dtype=np.uint8))
    ground = np.array([[-60, 1.5, 90], [60, 1.5, 90], [60, 1.5, -5], [-60, 1.5, -5]], dtype=np.float64)
    meshes = [
        SceneMesh(
            name="ground",
            vertices=ground,
            faces=np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32),
            material=noise,
            uv=ground[:, [0, 2]] / 2,
        )
    ]
    for number in range(count):
        box = trimesh.creation.box(rng.uniform(0.5, 2.0, 3))
        vertices = np.asarray(box.vertices)[np.asarray(box.faces)].reshape(-1, 3)
        place = [rng.uniform(-8, 8), rng.uniform(0, 1), rng.uniform(5, 30)]
        faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
        uv = vertices[:, :2] + vertices[:, 2:]
        meshes.append(
            SceneMesh(name=f"box{number}", vertices=vertices + place, faces=faces, material=noise, uv=uv)
        )
    return Scene(name="boxes", meshes=tuple(meshes), light=Light(sun_direction=(0.5, -0.7, -0.5), up=(0, -1, 0)))


def seconds(call: Callable[[], Frame]) -> float:
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def kinds(
    scene: Scene, camera: PinholeCamera, shutter: RollingShutter, options: RendererOptions
) -> dict[str, Callable[[], Frame]]:
    """Calls that render one frame each, by the name that is printed."""
    built, rig = MitsubaScene(scene), StereoRig(camera=camera, baseline=0.5)
    motion = LinearMotion(np.array([0.02, 0.03, 0.05]), np.array([0.1, 0.05, 0.2]))
    tau = shutter.row_time(np.arange(camera.height), 0)
    R, t = rig.cam_from_world(motion, tau, "left")
    exposed = rig.cam_from_world(motion, instant_times(tau, 0.1, instant_count(options.samples)), "left")

    def with_objects(count: int) -> Callable[[], Frame]:
        moving = MitsubaScene(with_moving(scene, BODIES[:count]))
        poses = poses_of([MovingObject(np.array(body.position), MOVES) for body in BODIES[:count]], tau)
        return lambda: render(moving, camera, LinePoses(R, t, objects=poses), options)

    def through(lens: Lens) -> Callable[[], Frame]:
        return lambda: render(built, replace(camera, lens=lens), LinePoses(R, t), options)

    return {
        GLOBAL: lambda: render_global(built, camera, R[0], t[0], options),
        ROLLING: lambda: render(built, camera, LinePoses(R, t), options),
        EXPOSED: lambda: render(built, camera, LinePoses(R, t), options, exposed=LinePoses(*exposed)),
        **{lens.model: through(lens) for lens in LENSES},
        **{f"{count} moving": with_objects(count) for count in range(1, len(BODIES) + 1)},
    }


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=900, help="width and height of the image, px (default 900)")
    parser.add_argument("--samples", type=int, default=16, help="samples per pixel, a square (default 16)")
    parser.add_argument("--integrator", choices=("sunsky", "path"), default="sunsky")
    parser.add_argument("--runs", type=int, default=7, help="runs of each kind (default 7)")
    parser.add_argument("--limit", type=float, default=1.1, help="exit with 1 above this ratio (default 1.1)")
    parser.add_argument("--lens-limit", type=float, default=1.3, help="the same of a lens (default 1.3)")
    parser.add_argument("--moving-limit", type=float, default=3.0, help="the same of moving objects (default 3)")
    given = parser.parse_args(arguments)
    options = RendererOptions(samples=given.samples, integrator=given.integrator)

    started = start_backend()
    camera = PinholeCamera.centred(given.size, given.size, 0.9 * given.size)
    calls = kinds(boxes(), camera, RollingShutter(height=given.size, readout_ratio=0.8), options)
    compiling = {name: seconds(call) for name, call in calls.items()}
    runs = [{name: seconds(call) for name, call in calls.items()} for _ in range(given.runs)]
    sys.stdout.write(
        f"{started.variant}, LLVM {started.llvm_version}, {given.integrator}, "
        f"{given.size} x {given.size}, {given.samples} samples, {given.runs} runs of each\n"
        f"first rolling-shutter frame (compiles): {compiling[ROLLING]:.3f} s\n"
    )
    held = True
    for name in calls:
        over = GLOBAL if name == ROLLING else ROLLING
        limit = given.lens_limit if name in LENS_NAMES else given.moving_limit if "moving" in name else given.limit
        line = f"{name:16} {statistics.median(run[name] for run in runs):7.3f} s"
        if name != GLOBAL:
            ratio = statistics.median(run[name] / run[over] for run in runs)
            held &= ratio <= limit
            line += f", {ratio:.3f} times {over} (limit {limit})"
        sys.stdout.write(line + "\n")
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main())
