"""The sensor plugin with Mitsuba's own render loop, and what compiles when."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rsbench.core.camera import PinholeCamera
from rsbench.renderers.backend import start_backend
from rsbench.renderers.options import Integrator, RendererOptions
from rsbench.renderers.render import LinePoses, render
from rsbench.renderers.scene import MitsubaScene
from rsbench.renderers.sensor import make_sensor, pose_table

CAMERA = PinholeCamera(width=32, height=24, fx=26.0, fy=27.0, cx=14.0, cy=12.5)


@pytest.fixture(scope="module")
def scene(town: Any) -> MitsubaScene:
    if start_backend().variant == "scalar_rgb":
        pytest.skip("whole images through a Python sensor need LLVM")
    return MitsubaScene(town)


def kernels(call: Any) -> list[Any]:
    """Entries of Dr.Jit's history for the kernels that a call launched."""
    import drjit as dr

    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        dr.kernel_history_clear()
        call()
        return [entry for entry in dr.kernel_history() if "cache_hit" in entry]
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, False)


@pytest.mark.parametrize("integrator", ["sunsky", "path"])
def test_only_the_first_frame_compiles(scene: MitsubaScene, row_poses: Any, integrator: Integrator) -> None:
    def frame(camera: PinholeCamera, samples: int, seed: int, rows: Any = None, **motion: Any) -> Any:
        R, t = row_poses(camera.height, **motion)
        options = RendererOptions(integrator=integrator, samples=samples, seed=seed)
        return kernels(lambda: render(scene, camera, LinePoses(R, t), options, rows=rows))

    first = frame(CAMERA, 4, 0)
    assert len(first) >= 2
    other = PinholeCamera(width=45, height=31, fx=30.5, fy=29.0, cx=22.1, cy=15.0)
    later = [
        *frame(CAMERA, 4, 0, w=(0.1, 0.2, 0.3), d=(0.1, 0.2, 0.3)),  # other poses
        *frame(other, 9, 5, w=(0.3, 0.0, 0.0)),  # other intrinsics, size, samples, seed
        *frame(other, 9, 5, rows=[7], d=(0.3, 0.0, 0.0)),  # a row by itself
    ]
    assert later and all(entry["cache_hit"] for entry in later)
    assert {entry["hash"] for entry in later} <= {entry["hash"] for entry in first}


def test_plugin_row_equals_global_shutter_row_in_mitsubas_own_loop(scene: MitsubaScene, row_poses: Any) -> None:
    import mitsuba as mi

    R, t = row_poses(24, w=(0.1, -0.1, 0.3), d=(0.2, 0.1, 0.5))
    integrator = mi.load_dict({"type": "path", "max_depth": 3})

    def image(R: Any, t: Any) -> Any:
        sensor = make_sensor(CAMERA, R, t)
        return np.array(mi.render(scene.textured(), sensor=sensor, integrator=integrator, spp=4, seed=11))

    rolling = image(R, t)
    for row in (0, 9, 23):
        frozen = image(np.tile(R[row], (24, 1, 1)), np.tile(t[row], (24, 1)))
        np.testing.assert_array_equal(rolling[row], frozen[row])
        assert np.abs(rolling - frozen).max() > 0.05


def test_plugin_and_renderer_see_the_same_scene(scene: MitsubaScene, row_poses: Any) -> None:
    """Mitsuba's render loop and film, against ours: another sampler, the same expectation."""
    import mitsuba as mi

    R, t = row_poses(24, w=(0.1, -0.1, 0.3), d=(0.2, 0.1, 0.5))
    ours = render(
        scene, CAMERA, LinePoses(R, t), RendererOptions(integrator="path", samples=1024, max_depth=3)
    ).image
    integrator = mi.load_dict({"type": "path", "max_depth": 3})
    theirs = np.array(
        mi.render(scene.textured(), sensor=make_sensor(CAMERA, R, t), integrator=integrator, spp=1024)
    )
    # Deviation of a sample is about the mean radiance (0.5), of a pixel 0.5 / 32, of the difference 1.4 times it.
    assert np.sqrt(np.mean((ours - theirs) ** 2)) < 0.03
    np.testing.assert_allclose(ours.mean(axis=(0, 1)), theirs.mean(axis=(0, 1)), rtol=5e-3)


def test_film_positions_are_half_a_pixel_beyond_pixel_coordinates(scene: MitsubaScene, row_poses: Any) -> None:
    """Film position ((x + 0.5) / width, (y + 0.5) / height) is pixel (x, y), seen from row y's pose."""
    import mitsuba as mi

    R, t = row_poses(24, w=(0.4, 0.2, -0.3), d=(0.2, 0.1, 0.5))
    sensor = make_sensor(CAMERA, R, t)
    for x, y in ((0, 0), (31, 0), (5, 17), (31, 23)):
        position = mi.Point2f((x + 0.5) / 32, (y + 0.5) / 24)
        ray, weight = sensor.sample_ray(mi.Float(0), mi.Float(0.5), position, mi.Point2f(0.5))
        d = R[y].T @ [(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, 1.0]
        np.testing.assert_allclose(np.array(ray.d).ravel(), d / np.linalg.norm(d), atol=1e-6)
        np.testing.assert_allclose(np.array(ray.o).ravel(), -R[y].T @ t[y], atol=1e-6)
        np.testing.assert_array_equal(np.array(weight).ravel(), 1.0)


def test_pose_table_holds_the_inverse_pose(row_poses: Any) -> None:
    R, t = row_poses(24, w=(0.4, 0.2, -0.3), d=(0.2, 0.1, 0.5))
    table = pose_table(CAMERA, R, t).astype(np.float64)
    np.testing.assert_allclose(table[:, :9].reshape(-1, 3, 3) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-6)
    centre = table[:, 9:]
    np.testing.assert_allclose(np.einsum("hij,hj->hi", R, centre) + t, 0.0, atol=1e-6)
