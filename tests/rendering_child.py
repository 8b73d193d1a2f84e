"""A small frame by every integrator, rendered in a process of its own, with another LLVM, width or GPU."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from programs import run_python

from rsbench.renderers import llvm

_START = """
import ctypes, os, sys, time
from pathlib import Path
from rsbench.renderers.backend import start_backend

started = start_backend()
if "WIDTH" in os.environ:  # as on a processor with other registers; Dr.Jit has this function for C++ alone
    import drjit
    core = ctypes.CDLL(str(next(Path(drjit.__path__[0]).glob("libdrjit-core.so*"))))
    features = os.environ["FEATURES"].encode()
    core._Z19jit_llvm_set_targetPKcS0_j(b"x86-64", features, ctypes.c_uint32(int(os.environ["WIDTH"])))
    assert core._Z21jit_llvm_vector_widthv() == int(os.environ["WIDTH"])
"""
GENERATE = f"""{_START}
from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.generation import generate_dataset
generate_dataset(load_dataset_card("smoke").only(["castle"]), Path(sys.argv[1]))
"""
RENDER = (
    _START
    + """
import numpy as np
from rsbench.core.camera import PinholeCamera
from rsbench.core.se3 import Pose
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.render import LinePoses, render
from rsbench.renderers.scene import MitsubaScene
from rsbench.scenes.model import Light, Material, Scene, SceneMesh

texture = np.random.default_rng(1).integers(0, 256, (32, 32, 3), dtype=np.uint8)
meshes = []
for x, y, z, size in ((-3, -3, 9, 6), (-1, -1, 4, 1.5), (0.2, 0.1, 3, 0.8)):
    meshes.append(SceneMesh(
        name="quad",
        vertices=np.array([[x, y, z], [x + size, y, z], [x + size, y + size, z + 1], [x, y + size, z + 1.0]]),
        faces=np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32),
        material=Material(name="t", texture=texture),
        uv=np.array([[0, 1], [1, 1], [1, 0], [0, 0.0]]),
    ))
light = Light(sun_direction=(0.3, -0.5, -0.8), up=(0.0, -1.0, 0.0))
scene = MitsubaScene(Scene(name="quads", meshes=tuple(meshes), light=light))
width, height = int(sys.argv[2]), int(sys.argv[3])
camera = PinholeCamera.centred(width, height, 0.8 * width)
tau = np.arange(height) / height
R = np.tile(np.eye(3), (height, 1, 1))
t = np.stack([0.2 * tau, 0 * tau, -0.3 * tau], axis=-1)
begin = time.perf_counter()
sunsky = render(scene, camera, LinePoses(R, t), RendererOptions(samples=4))
seconds = time.perf_counter() - begin
path = render(scene, camera, LinePoses(R, t), RendererOptions(samples=4, integrator="path", seed=3))
stitched = render(scene, camera, LinePoses(R, t), RendererOptions(samples=4, method="stitched"))
assert (stitched.image == sunsky.image).all() and (stitched.depth == sunsky.depth).all()
parts = 0.3 * ((np.arange(64) + 0.5) / 64 - 0.5)[:, None, None]
blur = LinePoses(np.tile(R, (64, 1, 1, 1)), t + parts * np.array([0.2, 0, -0.3]))
exposed = render(scene, camera, LinePoses(R, t), RendererOptions(samples=4, seed=3), exposed=blur)
np.savez(sys.argv[1], sunsky=sunsky.image, exposed=exposed.image, depth=sunsky.depth, path=path.image,
         seconds=seconds, variant=started.variant, message=started.message or "")
"""
)


def child(tmp_path: Path, name: str, size: tuple[int, int], **environ: str) -> Any:
    out = tmp_path / f"{name}.npz"
    run_child(RENDER, str(out), str(size[0]), str(size[1]), **environ)
    return np.load(out)


def run_child(program: str, *words: str, **environ: str) -> None:
    """A program in a process of its own, which must end well."""
    done = run_python("-c", program, *words, environment=environ)
    assert done.returncode == 0, done.stderr


def needs_llvm() -> None:
    if not any(llvm.probe(candidate).ok for candidate in llvm.candidates()):
        pytest.skip("no usable LLVM on this machine")


def assert_alike(other: Any, own: Any) -> None:
    """docs/get-started/install.md: depth to 1e-5, and images but for one pixel in a hundred, where one of the few
    samples at an edge sees the other side."""
    np.testing.assert_allclose(other["depth"], own["depth"], rtol=1e-5)
    for channel in ("sunsky", "path", "exposed"):
        levels = [np.rint(255 * np.clip(each[channel], 0, 1) ** (1 / 2.2)) for each in (other, own)]
        assert np.mean(np.any(levels[0] != levels[1], axis=-1)) < 0.01, channel
        assert abs(np.mean(levels[0]) - np.mean(levels[1])) < 0.1, channel
