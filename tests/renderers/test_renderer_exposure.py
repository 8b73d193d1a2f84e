"""A row that is exposed for a while: the mean of its instants, in one kernel, bit for bit as stitched."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.se3 import Pose
from rsbench.renderers.exposure import instant_count, instant_of, instant_times
from rsbench.renderers.options import Integrator, RendererOptions
from rsbench.renderers.render import LinePoses, render
from rsbench.renderers.scene import MitsubaScene
from rsbench.scenes.model import Light, Material, Scene

CAMERA = PinholeCamera.centred(30, 24, 26.0)
W, D = np.array([-0.1, 0.2, 0.1]), np.array([-0.4, 0.1, 0.3])


def _poses(tau: Any) -> Pose:
    """Linear motion at times (...)."""
    tau = np.asarray(tau)
    R = Rotation.from_rotvec((tau[..., None] * W).reshape(-1, 3)).as_matrix().reshape(*tau.shape, 3, 3)
    return Pose(R, tau[..., None] * D)


def _times(exposure: float, instants: int) -> tuple[Any, Any]:
    rows = 0.8 * np.arange(CAMERA.height) / CAMERA.height
    return rows, instant_times(rows, exposure, instants)


@pytest.mark.parametrize("integrator", ["sunsky", "path"])
def test_single_pass_is_stitched_from_exposed_frames(town: Scene, integrator: Integrator) -> None:
    rows, instants = _times(0.5, 64)
    scene, geometry = MitsubaScene(town), _poses(rows)
    options = RendererOptions(integrator=integrator, samples=4, seed=7)
    whole = render(scene, CAMERA, LinePoses(*geometry), options, exposed=LinePoses(*_poses(instants)))
    sharp = render(scene, CAMERA, LinePoses(*geometry), options)
    for full in (True, False):
        stitched = replace(options, method="stitched", full_frames=full)
        oracle = render(scene, CAMERA, LinePoses(*geometry), stitched, exposed=LinePoses(*_poses(instants)))
        np.testing.assert_array_equal(whole.image, oracle.image)
        np.testing.assert_array_equal(whole.depth, oracle.depth)
    np.testing.assert_array_equal(whole.depth, sharp.depth)
    assert np.abs(whole.image - sharp.image).max() > 0.05, "nothing is blurred"


def test_an_exposed_frame_is_the_mean_of_its_instants(town: Scene) -> None:
    """Over many seeds, as each sample sees one of the instants of its part; 5 standard errors of the mean."""
    rows, instants = _times(0.3, instant_count(4))
    scene, geometry, exposed = MitsubaScene(town), _poses(rows), _poses(instants)
    frames = np.stack(
        [
            render(
                scene,
                CAMERA,
                LinePoses(*geometry),
                RendererOptions(samples=4, seed=seed),
                exposed=LinePoses(*exposed),
            ).image
            for seed in range(40)
        ]
    )
    # 64 instants, all sub-pixel samples at each: what the exposed frame is a random part of.
    truth = np.mean(
        [render(scene, CAMERA, LinePoses(*_poses(tau)), RendererOptions(samples=4)).image for tau in instants],
        axis=0,
    )
    error = frames.mean(axis=0) - truth
    sigma = frames.std(axis=0, ddof=1) / np.sqrt(len(frames))
    assert np.sqrt(np.mean(error**2)) < 1.2 * np.sqrt(np.mean(sigma**2))
    assert np.mean(np.abs(error) > 5.0 * sigma + 1e-6) < 0.005
    sharp = render(scene, CAMERA, LinePoses(*geometry), RendererOptions(samples=4)).image
    assert np.abs(truth - sharp).max() > 0.05, "nothing is blurred"


def test_an_edge_is_smeared_as_far_as_it_moves(quad: Callable[..., Any]) -> None:
    """Closed form: a camera that moves sideways sees an upright edge as a ramp of f v e / z pixels."""
    wall = quad(
        [[-50, -50, 4], [0, -50, 4], [0, 50, 4], [-50, 50, 4]], Material(name="dark", colour=(0.0, 0.0, 0.0))
    )
    light = quad(
        [[0, -50, 4], [50, -50, 4], [50, 50, 4], [0, 50, 4]], Material(name="white", colour=(0.8, 0.8, 0.8))
    )
    scene = MitsubaScene(
        Scene(name="edge", meshes=(wall, light), light=Light(sun_direction=(0, 0, -1), up=(0, -1, 0)))
    )
    camera, exposure, speed = PinholeCamera.centred(64, 48, 40.0), 0.4, 3.0
    tau = instant_times(np.zeros(48), exposure, 64)
    t = np.zeros((64, 48, 3))
    t[..., 0] = -speed * tau
    exposed = Pose(np.broadcast_to(np.eye(3), (64, 48, 3, 3)), t)
    still = np.broadcast_to(np.eye(3), (48, 3, 3)), np.zeros((48, 3))
    image = render(
        scene, camera, LinePoses(*still), RendererOptions(samples=16), exposed=LinePoses(*exposed)
    ).image[..., 0]
    profile = image.mean(axis=0) / image[:, -1].mean()
    ramp = camera.fx * speed * exposure / 4.0  # 12 px
    expected = np.clip((np.arange(64) - camera.cx) / ramp + 0.5, 0.0, 1.0)
    # A sample knows its time to a part of the exposure: 48 rows average 16 samples each, so to 0.3 / sqrt(768).
    assert ramp == pytest.approx(12.0)
    np.testing.assert_allclose(profile, expected, atol=0.05)


@pytest.mark.parametrize("samples", [1, 4, 9, 16, 25, 36, 64, 100])
def test_samples_share_the_exposure_evenly(samples: int) -> None:
    """Each sample of a pixel has its own part, whichever pixel; over pixels every sample sees every instant."""
    from rsbench.renderers.backend import start_backend

    start_backend()
    instants = instant_count(samples)
    assert instants >= 64 and instants % samples == 0
    seen = np.array(
        [[int(_first(instant_of(3, pixel, k, samples, instants))) for k in range(samples)] for pixel in range(30)]
    )
    parts = np.sort(seen * samples // instants, axis=1)
    assert np.array_equal(parts, np.broadcast_to(np.arange(samples), parts.shape))
    assert len(np.unique(seen[:, 0])) > 10 or instants < 30


def _first(value: Any) -> Any:
    return np.ravel(np.array(value))[0]


def test_instants_that_samples_cannot_share_are_refused(town: Scene) -> None:
    rows, instants = _times(0.3, 6)
    with pytest.raises(RsbenchError, match="6 instants: a multiple of the 4 samples is needed"):
        render(
            MitsubaScene(town),
            CAMERA,
            LinePoses(*_poses(rows)),
            RendererOptions(samples=4),
            exposed=LinePoses(*_poses(instants)),
        )
