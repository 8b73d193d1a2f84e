"""The path tracer against Blender's Cycles at equal noise: seconds times squared relative noise, of both.

The boxes of ``render_rs_vs_gs.py``, or the meshes of a scene (``--scene castle``), in one grey, a grey sky and one
sun, 400 x 400, 16 samples, paths of at most 4 segments, box filter, no denoiser and no adaptive sampling. The
noise of each is the RMS difference to its own image of 256 samples, over the mean. The time of Cycles is what 16
samples more take, without its start and its export of the scene; ours is of the whole frame. Blender runs in a
Python of its own:

    python3.11 -m venv blender && blender/bin/pip install bpy==4.5.0
    python benchmarks/against_cycles.py --blender blender/bin/python
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

SIZE, FOCAL, SAMPLES, SEGMENTS, GREY, SKY, SUN = 400, 360.0, 16, 4, 0.5, 0.6, 2.4
MANY, RUNS = 256, 3
BOXES = "boxes"
FLIP = (1.0, -1.0, -1.0)


def cycles(folder: Path) -> None:
    """In Blender's Python: seconds of 16 samples, and images as EXR files."""
    import bpy  # pyrefly: ignore[missing-import]
    import numpy as np

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    _build(bpy, scene, dict(np.load(folder / "scene.npz")))
    render, engine = scene.render, scene.cycles
    render.engine, render.resolution_x, render.resolution_y = "CYCLES", SIZE, SIZE
    render.resolution_percentage, render.use_persistent_data = 100, True
    render.image_settings.file_format, render.image_settings.color_depth = "OPEN_EXR", "32"
    engine.pixel_filter_type, engine.filter_width = "BOX", 1.0
    engine.use_adaptive_sampling = engine.use_denoising = engine.use_fast_gi = False
    engine.max_bounces = engine.diffuse_bounces = SEGMENTS - 2
    engine.sample_clamp_direct = engine.sample_clamp_indirect = 0.0
    engine.caustics_reflective = engine.caustics_refractive = False

    def seconds(samples: int, name: str) -> float:
        engine.samples, render.filepath = samples, str(folder / name)
        start = time.monotonic()
        bpy.ops.render.render(write_still=True)
        return time.monotonic() - start

    seconds(SAMPLES, "cycles.exr")
    more = [seconds(9 * SAMPLES, "x.exr") - seconds(SAMPLES, "y.exr") for _ in range(RUNS)]
    engine.seed = 7
    seconds(MANY, "cycles-many.exr")
    sys.stdout.write(f"\n{np.median(more) / 8.0}\n")


def _build(bpy: Any, scene: Any, made: dict[str, Any]) -> None:
    """The boxes, the sun, the sky and the camera, in Blender's axes: x right, y up, z backward."""
    from mathutils import Vector  # pyrefly: ignore[missing-import]

    def put(name: str, data: Any) -> Any:
        placed = bpy.data.objects.new(name, data)
        scene.collection.objects.link(placed)
        return placed

    material = bpy.data.materials.new("grey")
    material.use_nodes = True
    nodes = material.node_tree.nodes
    nodes.clear()
    diffuse, output = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeOutputMaterial")
    diffuse.inputs["Color"].default_value = (GREY, GREY, GREY, 1.0)
    material.node_tree.links.new(diffuse.outputs[0], output.inputs[0])
    mesh = bpy.data.meshes.new("boxes")
    mesh.from_pydata((made["vertices"] * FLIP).tolist(), [], made["faces"].tolist())
    mesh.materials.append(material)
    put("boxes", mesh)
    sun = bpy.data.lights.new("sun", "SUN")
    sun.energy, sun.angle = SUN, 0.0
    towards = Vector((made["sun"] * FLIP).tolist())
    put("sun", sun).rotation_euler = towards.to_track_quat("Z", "Y").to_euler()
    scene.world = bpy.data.worlds.new("sky")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs[0].default_value = (SKY, SKY, SKY, 1.0)
    camera = bpy.data.cameras.new("camera")
    camera.sensor_width, camera.lens = SIZE / FOCAL, 1.0
    scene.camera = put("camera", camera)


def ours(scene: Any) -> tuple[float, Any, Any]:
    """Seconds of 16 samples, that image, and the one of many samples."""
    import numpy as np

    from rsbench.core.camera import PinholeCamera
    from rsbench.renderers.options import RendererOptions
    from rsbench.renderers.render import LinePoses, render
    from rsbench.renderers.scene import MitsubaScene

    loaded, camera = MitsubaScene(scene), PinholeCamera.centred(SIZE, SIZE, FOCAL)
    poses = LinePoses(np.tile(np.eye(3), (SIZE, 1, 1)), np.zeros((SIZE, 3)))

    def image(samples: int, seed: int) -> Any:
        options = RendererOptions(samples=samples, integrator="path", max_depth=SEGMENTS, seed=seed)
        return render(loaded, camera, poses, options).image

    few, spent = image(SAMPLES, 1), list[float]()
    for _ in range(RUNS):
        start = time.monotonic()
        image(SAMPLES, 1)
        spent.append(time.monotonic() - start)
    return float(np.median(spent)), few, image(MANY, 7)


def grey_scene(name: str) -> Any:
    """A scene without its textures, seen by the camera at the origin."""
    from dataclasses import replace

    import render_rs_vs_gs

    from rsbench.scenes.load import load_scene
    from rsbench.scenes.model import Light, Material

    grey = Material(name="grey", colour=(1.055 * GREY ** (1 / 2.4) - 0.055,) * 3)
    sun, up = (0.5, -0.7, -0.5), (0.0, -1.0, 0.0)
    if name == BOXES:
        scene = render_rs_vs_gs.boxes()
    else:
        loaded = load_scene(name)
        scene = loaded.seen_from(next(iter(loaded.viewpoints.values())))
        sun, up = scene.light.sun_direction, scene.light.up
    light = Light(sun_direction=sun, up=up, sun_irradiance=(SUN,) * 3)
    light = replace(light, sky_zenith=(SKY,) * 3, sky_horizon=(SKY,) * 3)
    return replace(
        scene, meshes=tuple(replace(mesh, material=grey, uv=None) for mesh in scene.meshes), light=light
    )


def theirs(blender: Path, scene: Any) -> tuple[float, Any, Any]:
    """As ``ours``; ValueError with the last line that Blender says where it fails."""
    import numpy as np
    import OpenEXR

    counts = np.cumsum([0, *(len(mesh.vertices) for mesh in scene.meshes)])
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        np.savez(
            folder / "scene.npz",
            vertices=np.concatenate([mesh.vertices for mesh in scene.meshes]),
            faces=np.concatenate([mesh.faces + n for mesh, n in zip(scene.meshes, counts, strict=False)]),
            sun=np.array(scene.light.sun_direction),
        )
        ran = subprocess.run([blender, __file__, "--in", place], capture_output=True, text=True)
        if ran.returncode:
            raise ValueError(ran.stderr.strip().splitlines()[-1])
        read = [
            OpenEXR.File(str(folder / f"{name}.exr"), separate_channels=False).parts[0].channels
            for name in ("cycles", "cycles-many")
        ]
        few, many = (next(each[k].pixels[..., :3].copy() for k in ("RGB", "RGBA") if k in each) for each in read)
    return float(ran.stdout.strip().splitlines()[-1]), few, many


def main() -> int:
    import numpy as np

    from rsbench.core.errors import RsbenchError

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blender", type=Path, required=True, help="a Python that has bpy")
    parser.add_argument("--scene", default=BOXES, help="boxes, or a scene's card (default: %(default)s)")
    given = parser.parse_args()
    try:
        scene = grey_scene(given.scene)
    except RsbenchError as error:
        parser.error(f"--scene: {error}")
    try:
        rows = {"Cycles": theirs(given.blender, scene), "rsbench": ours(scene)}
    except (OSError, ValueError) as error:
        parser.error(f"--blender {given.blender}: {error}")
    sys.stdout.write("            seconds   noise    mean  seconds x noise^2\n")
    costs = {}
    for name, (seconds, one, truth) in rows.items():
        noise = float(np.sqrt(np.mean((one - truth) ** 2)) / np.mean(truth))
        costs[name] = seconds * noise**2
        sys.stdout.write(f"{name:10} {seconds:8.3f} {noise:7.4f} {np.mean(truth):7.4f} {costs[name]:18.2e}\n")
    sys.stdout.write(f"at equal noise {costs['Cycles'] / costs['rsbench']:.2f} times as fast as Cycles\n")
    return 0


if __name__ == "__main__":
    if sys.argv[1:2] == ["--in"]:
        cycles(Path(sys.argv[2]))
    else:
        sys.exit(main())
