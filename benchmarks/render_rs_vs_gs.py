"""What a rolling-shutter frame costs beside a global-shutter one: sharp, exposed a tenth of a period, by a lens.

The paper's recipe renders one global-shutter image per row, so a rolling-shutter frame of 900 rows costs 900 of
them; the single pass should cost one. Runs alternate, so that a busy machine disturbs both alike.

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

from rsbench.core.camera import PinholeCamera
from rsbench.core.lens import Lens
from rsbench.core.motion import LinearMotion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.renderers.backend import start_backend
from rsbench.renderers.exposure import instant_count, instant_times
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.render import Frame, render, render_global
from rsbench.renderers.scene import MitsubaScene
from rsbench.scenes.model import Light, Material, Scene, SceneMesh

LENSES = (
    Lens(model="brown-conrady", k1=-0.28, k2=0.07, p1=0.002, p2=-0.001, k3=0.004),
    Lens(model="kannala-brandt", k1=-0.04, k2=0.012, k3=-0.003, k4=0.0005),
)


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


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=900, help="width and height of the image, px (default 900)")
    parser.add_argument("--samples", type=int, default=16, help="samples per pixel, a square (default 16)")
    parser.add_argument("--integrator", choices=("sunsky", "path"), default="sunsky")
    parser.add_argument("--runs", type=int, default=7, help="runs of each kind (default 7)")
    parser.add_argument("--limit", type=float, default=1.1, help="exit with 1 above this ratio (default 1.1)")
    parser.add_argument("--lens-limit", type=float, default=1.3, help="the same of a lens (default 1.3)")
    given = parser.parse_args(arguments)
    options = RendererOptions(samples=given.samples, integrator=given.integrator)

    started = start_backend()
    scene = MitsubaScene(boxes())
    camera = PinholeCamera.centred(given.size, given.size, 0.9 * given.size)
    rig = StereoRig(camera=camera, baseline=0.5)
    shutter = RollingShutter(height=given.size, readout_ratio=0.8)
    motion = LinearMotion(np.array([0.02, 0.03, 0.05]), np.array([0.1, 0.05, 0.2]))
    R, t = rig.cam_from_world(motion, shutter.row_time(np.arange(given.size), 0), "left")

    def rolling() -> Frame:
        return render(scene, camera, R, t, options)

    instants = instant_times(shutter.row_time(np.arange(given.size), 0), 0.1, instant_count(given.samples))
    poses = rig.cam_from_world(motion, instants, "left")

    def exposed() -> Frame:
        return render(scene, camera, R, t, options, exposed=poses)

    def frozen() -> Frame:
        return render_global(scene, camera, R[0], t[0], options)

    def through(lens: Lens) -> Callable[[], Frame]:
        return lambda: render(scene, replace(camera, lens=lens), R, t, options)

    compile_seconds = seconds(rolling)
    kinds = (frozen, rolling, exposed, *map(through, LENSES))
    for kind in kinds:
        seconds(kind)
    runs = [[seconds(kind) for kind in kinds] for _ in range(given.runs)]
    ratio = statistics.median(run[1] / run[0] for run in runs)
    blur_ratio, brown_ratio, fisheye_ratio = (
        statistics.median(run[k] / run[1] for run in runs) for k in (2, 3, 4)
    )
    gs, rs, blurred, brown, fisheye = (statistics.median(times) for times in zip(*runs, strict=True))
    lines = (
        f"{started.variant}, LLVM {started.llvm_version}, {given.integrator}, "
        f"{given.size} x {given.size}, {given.samples} samples, {given.runs} runs of each",
        f"first frame (compiles)    {compile_seconds:7.3f} s",
        f"rolling shutter, median   {rs:7.3f} s",
        f"global shutter, median    {gs:7.3f} s",
        f"exposed, median           {blurred:7.3f} s",
        f"brown-conrady, median     {brown:7.3f} s",
        f"kannala-brandt, median    {fisheye:7.3f} s",
        f"rolling over global       {ratio:7.3f}   (limit {given.limit})",
        f"exposed over rolling      {blur_ratio:7.3f}   (limit {given.limit})",
        f"brown-conrady over none   {brown_ratio:7.3f}   (limit {given.lens_limit})",
        f"kannala-brandt over none  {fisheye_ratio:7.3f}   (limit {given.lens_limit})",
    )
    sys.stdout.write("\n".join(lines) + "\n")
    held = max(ratio, blur_ratio) <= given.limit and max(brown_ratio, fisheye_ratio) <= given.lens_limit
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main())
