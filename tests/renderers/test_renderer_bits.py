"""Equal bits of the methods, of samplers and threads; memory."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import refused

from rsbench.core.camera import PinholeCamera
from rsbench.renderers import wavefront
from rsbench.renderers.backend import start_backend
from rsbench.renderers.integrators import lane_sampler, reversed_bits, sobol
from rsbench.renderers.options import Integrator, RendererOptions
from rsbench.renderers.render import LinePoses, render, render_global
from rsbench.renderers.scene import MitsubaScene

# 30 columns: not a multiple of a packet, so packets would straddle rows if rows were not padded.
CAMERA = PinholeCamera.centred(30, 24, 26.0)
MOTIONS = {
    "rotation": {"w": (0.05, -0.1, 0.3)},
    "translation": {"d": (0.3, -0.2, 0.8)},
    "mixed": {"w": (-0.1, 0.2, 0.1), "d": (-0.4, 0.1, 0.3)},
}


@pytest.fixture(scope="module", params=["town", "room"])
def scene(request: pytest.FixtureRequest) -> MitsubaScene:
    return MitsubaScene(request.getfixturevalue(request.param))


@pytest.mark.parametrize("integrator", ["sunsky", "path"])
@pytest.mark.parametrize("motion", MOTIONS)
def test_single_pass_is_stitched_from_whole_frames(
    scene: Any, row_poses: Any, motion: str, integrator: Integrator
) -> None:
    R, t = row_poses(24, **MOTIONS[motion])
    options, stack = RendererOptions(integrator=integrator, samples=4, seed=7), dict[int, Any]()
    one = render(scene, CAMERA, LinePoses(R, t), options)
    kept = replace(options, method="stitched")
    whole = replace(kept, full_frames=True)
    oracle = render(scene, CAMERA, LinePoses(R, t), whole, on_gs_frame=stack.__setitem__)
    np.testing.assert_array_equal(one.image, oracle.image)
    np.testing.assert_array_equal(one.depth, oracle.depth)
    # The stack handed out is the ordinary global-shutter camera's, and the motion is seen at all.
    assert sorted(stack) == list(range(24))
    gs = render_global(scene, CAMERA, R[20], t[20], options)
    np.testing.assert_array_equal(stack[20], gs.image)
    np.testing.assert_array_equal(one.depth[20], gs.depth[20])
    assert np.abs(one.image - gs.image).max() > 0.05
    rows_only = render(scene, CAMERA, LinePoses(R, t), kept)
    np.testing.assert_array_equal(rows_only.image, one.image)
    np.testing.assert_array_equal(rows_only.depth, one.depth)


@pytest.mark.parametrize("integrator", ["sunsky", "path"])
def test_sampled_rows_of_a_large_frame(town: Any, row_poses: Any, integrator: Integrator) -> None:
    camera = PinholeCamera.centred(900, 900, 810.0)
    R, t = row_poses(900, **MOTIONS["mixed"])
    scene = MitsubaScene(town)
    options = RendererOptions(integrator=integrator, samples=16 if integrator == "sunsky" else 1)
    rows = [0, 123, 450, 451, 899]
    whole = render(scene, camera, LinePoses(R, t), options)
    for some in (options, replace(options, method="stitched")):
        frame = render(scene, camera, LinePoses(R, t), some, rows=rows)
        np.testing.assert_array_equal(frame.image, whole.image[rows])
        np.testing.assert_array_equal(frame.depth, whole.depth[rows])


@pytest.mark.parametrize("integrator", ["sunsky", "path"])
def test_small_launches_change_no_bit(
    scene: Any, row_poses: Any, integrator: Integrator, monkeypatch: pytest.MonkeyPatch
) -> None:
    R, t = row_poses(24, **MOTIONS["mixed"])
    options = RendererOptions(integrator=integrator, samples=9)
    whole = render(scene, CAMERA, LinePoses(R, t), options)
    for lanes in (1, 100, 3000):
        monkeypatch.setattr(wavefront, "LANES_PER_LAUNCH", lanes)
        split = render(scene, CAMERA, LinePoses(R, t), options)
        np.testing.assert_array_equal(split.image, whole.image)
        np.testing.assert_array_equal(split.depth, whole.depth)


def test_seed_moves_path_only(scene: Any, row_poses: Any) -> None:
    R, t = row_poses(24)

    def image(integrator: Integrator, seed: int) -> Any:
        options = RendererOptions(integrator=integrator, samples=1, seed=seed)
        return render(scene, CAMERA, LinePoses(R, t), options).image

    np.testing.assert_array_equal(image("sunsky", 0), image("sunsky", 1))
    assert np.mean(image("path", 0) != image("path", 1)) > 0.1


def test_bad_requests_are_refused_in_one_line(scene: Any, row_poses: Any) -> None:
    R, t = row_poses(24)
    bad: tuple[tuple[str, LinePoses, dict[str, Any]], ...] = (
        ("24 rows", LinePoses(R[:5], t[:5]), {}),
        ("not finite", LinePoses(R, np.full_like(t, np.nan)), {}),
        ("between 0 and 23", LinePoses(R, t), {"rows": [3, 24]}),
        ("full_frames", LinePoses(R, t), {"on_gs_frame": lambda row, image: None}),
    )
    for words, poses, options in bad:
        with refused(words):
            render(scene, CAMERA, poses, **options)
    with refused("(3, 3)"):
        render_global(scene, CAMERA, R, t)


SAMPLES, DIMENSIONS = 16, 6


@pytest.fixture(scope="module")
def points() -> Any:
    """(pixels, dimensions, samples, 2) of 50 pixels, and (pixels, samples) of the single dimension after them."""
    start_backend()
    import mitsuba as mi

    if "scalar" in mi.variant():
        pytest.skip("whole numbers of the scalar variant are its own test")
    pixel, sample = np.divmod(np.arange(50 * SAMPLES), SAMPLES)
    sampler = lane_sampler()
    sampler.seed_lanes(mi.UInt32(3), mi.UInt32(pixel), mi.UInt32(sample))
    pairs = np.stack([np.array(sampler.next_2d()).T.reshape(50, SAMPLES, 2) for _ in range(DIMENSIONS)], axis=1)
    return pairs, np.array(sampler.next_1d()).reshape(50, SAMPLES)


def test_the_second_coordinate_is_sobols() -> None:
    """Against its direction numbers, by the recurrence of the primitive polynomial x + 1."""
    for index in [*range(40), 12345, 0xDEADBEEF]:
        expected, direction, rest = 0, 1 << 31, index
        while rest:
            expected ^= direction * (rest & 1)
            rest, direction = rest >> 1, direction ^ (direction >> 1)
        assert sobol(reversed_bits(index)) == expected
        assert reversed_bits(index) == int(f"{index:032b}"[::-1], 2)


def test_every_elementary_interval_of_a_pixel_has_its_point(points: Any) -> None:
    """A (0, 4, 2)-net: one point in each of 16 boxes of every shape; so the mean of a step is exact to a box."""
    pairs, single = points
    for wide in (1, 2, 4, 8, 16):
        boxes = np.floor(pairs * [wide, SAMPLES // wide]).astype(int)
        number = np.sort(boxes[..., 0] * (SAMPLES // wide) + boxes[..., 1], axis=-1)
        assert np.all(number == np.arange(SAMPLES))
    assert np.all(np.sort(np.floor(SAMPLES * single), axis=-1) == np.arange(SAMPLES))


def test_pixels_and_dimensions_have_points_of_their_own(points: Any) -> None:
    """Means over pixels and correlations between dimensions are those of independent draws, to five deviations."""
    pairs, _ = points
    flat = pairs.reshape(-1, SAMPLES, 2)
    assert len(np.unique(flat[:, 0], axis=0)) == len(flat)
    first = pairs[:, :, 0]  # of the first sample of each pixel: nothing spreads these
    assert np.all(np.abs(first.mean(axis=0) - 0.5) < 5.0 / np.sqrt(12 * 50))
    columns = first.reshape(50, -1)
    off = np.corrcoef(columns, rowvar=False) - np.eye(columns.shape[1])
    assert np.max(np.abs(off)) < 5.0 / np.sqrt(50)


def test_numbers_depend_on_pixel_and_sample_alone() -> None:
    """Of some lanes in another order, as of a row that is rendered by itself."""
    start_backend()
    import mitsuba as mi

    found = []
    for pixel, sample in (([5, 9, 5], [0, 3, 7]), ([9, 5], [3, 7])):
        sampler = lane_sampler()
        sampler.seed_lanes(mi.UInt32(1), mi.UInt32(pixel), mi.UInt32(sample))
        sampler.next_2d(), sampler.next_1d()
        found.append(np.array(sampler.next_2d()).T)
    np.testing.assert_array_equal(found[0][1:], found[1])


# Textures of other sizes each time, as scenes have: Dr.Jit's cache serves arrays of the same size only.
CHILD = """
import json, sys
import numpy as np
from rsbench.core.camera import PinholeCamera
from rsbench.renderers.backend import start_backend
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.render import LinePoses, render
from rsbench.renderers.scene import MitsubaScene
from rsbench.scenes.model import Light, Material, Scene, SceneMesh

def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096 / 2**20

def scene(size):
    meshes = [
        SceneMesh(
            name="wall",
            vertices=np.array([[-9, -9, z], [9, -9, z], [9, 9, z], [-9, 9, z]], dtype=float),
            faces=np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32),
            material=Material(name="paper", texture=np.full((size, size, 3), 100 + z, dtype=np.uint8)),
            uv=np.array([[0, 1], [1, 1], [1, 0], [0, 0]], dtype=float),
        )
        for z in (4, 5, 6)
    ]
    return Scene(name="walls", meshes=tuple(meshes), light=Light(sun_direction=(0, -1, -1), up=(0, -1, 0)))

start_backend("llvm")
camera = PinholeCamera.centred(64, 48, 50.0)
poses = np.tile(np.eye(3), (48, 1, 1)), np.zeros((48, 3))
found = []
for size in (1600, 1500, 1550, 1450, 1525, 1575):
    empty = resident()
    held, full = MitsubaScene(scene(size)), {}
    for integrator in ("sunsky", "path"):
        render(held, camera, LinePoses(*poses), RendererOptions(samples=4, integrator=integrator))
        full[integrator] = resident()
    del held
    found.append({"texels": 3 * size**2, "empty": empty, **full, "after": resident()})
print(json.dumps(found))
"""


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads the memory of a process from /proc")
def test_scenes_are_given_back_and_hold_no_texture_twice() -> None:
    # The C library keeps freed blocks of some MB for itself unless told to map each one anew.
    environ = {**os.environ, "MALLOC_MMAP_THRESHOLD_": "1000000"}
    command = [sys.executable, "-c", CHILD]
    done = subprocess.run(command, env=environ, capture_output=True, text=True, timeout=300, check=False)
    if "found no usable libLLVM" in done.stderr:
        pytest.skip("no usable LLVM on this machine")
    assert done.returncode == 0, done.stderr
    first, *later = json.loads(done.stdout.splitlines()[-1])
    # For `sunsky` four bytes a texel, for `path` four float32 channels beside them. A quarter of that is four
    # times what images, meshes and ray tracing take here, and a third of the second copy (three channels) that
    # Mitsuba keeps of a texture whose tensor was looked at. Such a copy would be in every scene; in one, on a busy
    # machine, what is about to be freed may still be there.
    for integrator, size in (("sunsky", 4), ("path", 4 + 16)):
        taken = [scene[integrator] - scene["empty"] - scene["texels"] * size / 2**20 for scene in later]
        shares = [each / (scene["texels"] * 16 / 2**20) for each, scene in zip(taken, later, strict=True)]
        assert statistics.median(shares) < 0.25, (integrator, shares)
    # The first scene brings what stays, compiled kernels above all. Scenes that stayed would be 100 MB each, 300
    # by the fourth; a moment's memory of the run time has been seen to add 20 to one of them on a busy machine.
    assert min(scene["after"] for scene in later[2:]) - first["after"] < 30, found(first, later)


def found(first: dict[str, float], later: list[dict[str, float]]) -> list[float]:
    return [round(scene["after"] - first["after"], 1) for scene in later]
