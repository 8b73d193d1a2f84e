"""The single pass and the paper's recipe are the same image, bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.renderers import wavefront
from rsbench.renderers.options import Integrator, Method, RendererOptions
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
    one = render(scene, CAMERA, LinePoses(R, t), RendererOptions(integrator=integrator, samples=4, seed=7))
    stack: dict[int, Any] = {}
    stitched = RendererOptions(integrator=integrator, samples=4, seed=7, method="stitched", full_frames=True)
    oracle = render(
        scene, CAMERA, LinePoses(R, t), stitched, on_gs_frame=lambda row, image: stack.update({row: image})
    )
    np.testing.assert_array_equal(one.image, oracle.image)
    np.testing.assert_array_equal(one.depth, oracle.depth)
    # The stack handed out is the ordinary global-shutter camera's, and the motion is seen at all.
    assert sorted(stack) == list(range(24))
    gs = render_global(scene, CAMERA, R[20], t[20], RendererOptions(integrator=integrator, samples=4, seed=7))
    np.testing.assert_array_equal(stack[20], gs.image)
    np.testing.assert_array_equal(one.depth[20], gs.depth[20])
    assert np.abs(one.image - gs.image).max() > 0.05
    kept = RendererOptions(integrator=integrator, samples=4, seed=7, method="stitched")
    rows_only = render(scene, CAMERA, LinePoses(R, t), kept)
    np.testing.assert_array_equal(rows_only.image, one.image)
    np.testing.assert_array_equal(rows_only.depth, one.depth)


@pytest.mark.parametrize("integrator", ["sunsky", "path"])
def test_sampled_rows_of_a_large_frame(town: Any, row_poses: Any, integrator: Integrator) -> None:
    camera = PinholeCamera.centred(900, 900, 810.0)
    R, t = row_poses(900, **MOTIONS["mixed"])
    scene = MitsubaScene(town)
    samples = 16 if integrator == "sunsky" else 1
    rows = [0, 123, 450, 451, 899]
    whole = render(scene, camera, LinePoses(R, t), RendererOptions(integrator=integrator, samples=samples))
    methods: tuple[Method, Method] = ("single-pass", "stitched")
    for method in methods:
        some = RendererOptions(integrator=integrator, samples=samples, method=method)
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


def test_equal_rows_are_a_global_shutter(scene: Any, row_poses: Any) -> None:
    R, t = row_poses(24, w=(0.1, 0.1, 0.1), start=(0.2, 0.0, 0.1), ratio=0.0)
    rolling = render(scene, CAMERA, LinePoses(R, t), RendererOptions(samples=4))
    frozen = render_global(scene, CAMERA, R[0], t[0], RendererOptions(samples=4))
    np.testing.assert_array_equal(rolling.image, frozen.image)
    np.testing.assert_array_equal(rolling.depth, frozen.depth)


def test_bad_requests_are_refused_in_one_line(scene: Any, row_poses: Any) -> None:
    R, t = row_poses(24)
    with pytest.raises(RsbenchError, match="24 rows"):
        render(scene, CAMERA, LinePoses(R[:5], t[:5]))
    with pytest.raises(RsbenchError, match="not finite"):
        render(scene, CAMERA, LinePoses(R, np.full_like(t, np.nan)))
    with pytest.raises(RsbenchError, match="between 0 and 23"):
        render(scene, CAMERA, LinePoses(R, t), rows=[3, 24])
    with pytest.raises(RsbenchError, match="full_frames"):
        render(scene, CAMERA, LinePoses(R, t), on_gs_frame=lambda row, image: None)
    with pytest.raises(RsbenchError, match=r"\(3, 3\)"):
        render_global(scene, CAMERA, R, t)
