"""Rays of the sensor, through a lens, within an exposure; options."""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from commands import refused
from scipy.spatial.transform import Rotation

from rsbench.components.cards import list_cards, load_card, parse_card
from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.projection import row_poses as line_poses
from rsbench.core.rig import StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter, Scan
from rsbench.renderers import wavefront
from rsbench.renderers.backend import start_backend
from rsbench.renderers.options import Integrator, RendererOptions
from rsbench.renderers.pixel_samples import instant_count, instant_of, instant_times
from rsbench.renderers.render import LinePoses, render
from rsbench.renderers.scene import MitsubaScene
from rsbench.renderers.sensor import LineRays, make_sensor
from rsbench.scenes.model import Light, Material, Scene

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


@pytest.mark.parametrize("integrator", ["sunsky", "path"])
def test_recorded_kernels_are_replayed_with_the_bits_of_traced_ones(
    scene: MitsubaScene, row_poses: Any, integrator: Integrator
) -> None:
    import drjit as dr

    other = PinholeCamera(width=45, height=31, fx=30.5, fy=29.0, cx=22.1, cy=15.0)
    frames = [(CAMERA, 4, None, 0.1), (other, 4, None, 0.3), (CAMERA, 9, [7, 3], 0.2), (CAMERA, 4, None, 0.5)]

    def images() -> list[Any]:
        found = list[Any]()
        for camera, samples, rows, speed in frames:
            poses = LinePoses(*row_poses(camera.height, w=(speed, 0.0, 0.1), d=(0.0, speed, 0.2)))
            options = RendererOptions(integrator=integrator, samples=samples, seed=3)
            frame = render(scene, camera, poses, options, rows=rows)
            found += [frame.image, frame.depth]
        return found

    replayed = images()
    counts = {trace.__name__: recorded.n_recordings for trace, recorded in wavefront._recorded[scene].items()}
    images()
    assert counts == {trace.__name__: each.n_recordings for trace, each in wavefront._recorded[scene].items()}
    dr.set_flag(dr.JitFlag.KernelFreezing, False)
    try:
        traced = images()
    finally:
        dr.set_flag(dr.JitFlag.KernelFreezing, True)
    for replay, trace in zip(replayed, traced, strict=True):
        np.testing.assert_array_equal(replay, trace)


def test_recordings_of_a_scene_outlive_those_of_others(town: Any, row_poses: Any) -> None:
    """Dr.Jit numbers the surfaces of all scenes together, and gives the numbers of a scene that is gone again."""
    if start_backend().variant == "scalar_rgb":
        pytest.skip("kernels are recorded with LLVM")
    poses = LinePoses(*row_poses(CAMERA.height, w=(0.1, 0.0, 0.1), d=(0.0, 0.1, 0.2)))

    def image(scene: MitsubaScene, integrator: Integrator = "sunsky") -> Any:
        return render(scene, CAMERA, poses, RendererOptions(integrator=integrator, samples=4)).image

    kept = MitsubaScene(town)
    first = image(kept)
    for other in (replace(town, meshes=town.meshes[::-1]), replace(town, meshes=town.meshes[:2])):
        fresh = image(MitsubaScene(other))
        gc.collect()
        between = MitsubaScene(other)
        image(between, "path")  # replaces the materials
        np.testing.assert_array_equal(image(between), fresh)
        np.testing.assert_array_equal(image(kept), first)


def test_plugin_and_renderer_see_the_same_scene(scene: MitsubaScene, row_poses: Any) -> None:
    """Mitsuba's render loop and film, against ours: another sampler, the same expectation."""
    import mitsuba as mi

    R, t = row_poses(24, w=(0.1, -0.1, 0.3), d=(0.2, 0.1, 0.5))
    options = RendererOptions(integrator="path", samples=1024, max_depth=3)
    ours = render(scene, CAMERA, LinePoses(R, t), options).image
    sensor = make_sensor(CAMERA, LineRays.of(CAMERA, R, t))
    integrator = mi.load_dict({"type": "path", "max_depth": 3})
    theirs = np.array(mi.render(scene.textured(), sensor=sensor, integrator=integrator, spp=1024))
    # Deviation of a sample is about the mean radiance (0.5), of a pixel 0.5 / 32, of the difference 1.4 times it.
    assert np.sqrt(np.mean((ours - theirs) ** 2)) < 0.03
    np.testing.assert_allclose(ours.mean(axis=(0, 1)), theirs.mean(axis=(0, 1)), rtol=5e-3)


def test_film_positions_are_half_a_pixel_beyond_pixel_coordinates(scene: MitsubaScene, row_poses: Any) -> None:
    """Film position ((x + 0.5) / width, (y + 0.5) / height) is pixel (x, y), seen from row y's pose."""
    import mitsuba as mi

    R, t = row_poses(24, w=(0.4, 0.2, -0.3), d=(0.2, 0.1, 0.5))
    sensor = make_sensor(CAMERA, LineRays.of(CAMERA, R, t))
    for x, y in ((0, 0), (31, 0), (5, 17), (31, 23)):
        position = mi.Point2f((x + 0.5) / 32, (y + 0.5) / 24)
        ray, weight = sensor.sample_ray(mi.Float(0), mi.Float(0.5), position, mi.Point2f(0.5))
        d = R[y].T @ [(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, 1.0]
        np.testing.assert_allclose(np.array(ray.d).ravel(), d / np.linalg.norm(d), atol=1e-6)
        np.testing.assert_allclose(np.array(ray.o).ravel(), -R[y].T @ t[y], atol=1e-6)
        np.testing.assert_array_equal(np.array(weight).ravel(), 1.0)


BARREL = Lens(model="brown-conrady", k1=-0.28, k2=0.07, p1=0.002, p2=-0.001, k3=0.004)
FISHEYE = Lens(model="kannala-brandt", k1=-0.04, k2=0.012, k3=-0.003, k4=0.0005)
RATIONAL = Lens(model="rational", k1=0.9, k2=0.06, p1=-0.0004, p2=0.0002, k3=0.001, k4=1.25, k5=0.22, k6=0.006)
SPHERES = Lens(model="double-sphere", xi=-0.18, alpha=0.59)
LENS_CAMERA = PinholeCamera.centred(30, 24, 20.0)


@pytest.mark.parametrize("shrunk", [1, 16])
@pytest.mark.parametrize(
    "lens", [BARREL, FISHEYE, RATIONAL, SPHERES], ids=["barrel", "fisheye", "rational", "spheres"]
)
def test_rays_at_every_sample_are_the_host_s(lens: Lens, shrunk: int) -> None:
    """In a small camera a sample is far from its pixel's centre: many steps are needed."""
    start_backend()
    import drjit as dr
    import mitsuba as mi

    width, height, cx, cy = 640 // shrunk, 480 // shrunk, 322.0 / shrunk, 236.5 / shrunk
    camera = PinholeCamera(width=width, height=height, fx=400 / shrunk, fy=405 / shrunk, cx=cx, cy=cy, lens=lens)
    still = np.broadcast_to(np.eye(3), (height, 3, 3)), np.zeros((height, 3))
    rays = LineRays.of(camera, *still)
    rng = np.random.default_rng(0)
    low, high = np.array([-0.49, -0.49]), np.array([width - 0.51, height - 0.51])
    corners = np.array([low, high, [low[0], high[1]], [high[0], low[1]], [cx, cy]])
    pixels = np.concatenate([corners, rng.uniform(low, high, size=(300, 2))])
    pixels = pixels.astype(np.float32)
    if dr.is_jit_v(mi.Float):
        x, y = mi.Float(pixels[:, 0].copy()), mi.Float(pixels[:, 1].copy())
        lens_rays = rays.lens
        assert lens_rays is not None
        found = np.stack(
            [np.array(each) for each in lens_rays.coordinates(x, y, lens_rays.pixel(x, y, True))], axis=-1
        )
    else:
        found = np.array([list(rays.row_ray(x, y, 0)[1])[:2] for x, y in pixels.tolist()])
    expected = camera.unproject(pixels.astype(np.float64))[:, :2]
    # What is rounded to single precision is the answer alone: half a unit in the last place. Before that a ray is
    # within 1e-8 px of its sample; 4 times that where the lens squeezes the image.
    np.testing.assert_allclose(found, expected, rtol=6e-8, atol=4e-8 / camera.fx)


@pytest.mark.parametrize("exposed", [False, True])
@pytest.mark.parametrize("scan", ["top", "bottom", "left", "right"])
def test_single_pass_is_stitched_with_a_lens_and_every_scan(town: Any, scan: Scan, exposed: bool) -> None:
    start_backend()
    scene = MitsubaScene(town)
    camera = replace(LENS_CAMERA, lens=BARREL if scan in ("top", "left") else FISHEYE)
    rig = StereoRig(camera=camera, baseline=0.2)
    shutter = RollingShutter(height=24, width=30, readout_ratio=0.8, scan=scan)
    motion = LinearMotion((-0.1, 0.2, 0.1), (-0.4, 0.1, 0.3))
    poses, columns = line_poses(rig, shutter, motion, "left", 0), shutter.axis("left") == 0
    options, rows = RendererOptions(samples=4, seed=7), [0, 1, 11, 23]
    instants = instant_times(shutter.line_times(0, "left"), 0.2, 64)
    blur = LinePoses(*rig.cam_from_world(motion, instants, "left")) if exposed else None
    one = render(scene, camera, LinePoses(*poses, columns=columns), options, exposed=blur)
    other = replace(options, method="stitched")
    stitched = render(scene, camera, LinePoses(*poses, columns=columns), other, exposed=blur, rows=rows)
    np.testing.assert_array_equal(one.image[rows], stitched.image)
    np.testing.assert_array_equal(one.depth[rows], stitched.depth)
    # The scan is seen at all: its first line is the global shutter's at that time, the last one is not.
    first = shutter.first_line("left")
    still = Pose(*(np.broadcast_to(part[first], part.shape) for part in poses))
    gs = render(scene, camera, LinePoses(*still, columns=columns), options)
    lines = one.depth.T if columns else one.depth
    gs_lines = gs.depth.T if columns else gs.depth
    np.testing.assert_array_equal(lines[first], gs_lines[first])
    assert np.mean(one.depth != gs.depth) > 0.3


def test_depth_is_that_of_the_ray_through_the_lens(quad: Any, town: Any) -> None:
    start_backend()
    # A wall at z = 3 + 0.5 x: along a ray (u, v, 1) it is met at z = 3 / (1 - 0.5 u).
    wall = quad([[-60, -60, -27], [60, -60, 33], [60, 60, 33], [-60, 60, -27]])
    camera = replace(LENS_CAMERA, lens=BARREL)
    scene = MitsubaScene(Scene(name="wall", meshes=(wall,), light=town.light))
    depth = render(scene, camera, LinePoses(*STILL)).depth
    u = camera.unproject(camera.pixel_grid())[..., 0]
    np.testing.assert_allclose(depth, 3.0 / (1.0 - 0.5 * u), rtol=2e-6)  # single precision


EXPOSED = PinholeCamera.centred(30, 24, 26.0)
STILL = np.broadcast_to(np.eye(3), (24, 3, 3)), np.zeros((24, 3))
W, D = np.array([-0.1, 0.2, 0.1]), np.array([-0.4, 0.1, 0.3])


def _poses(tau: Any) -> Pose:
    """Linear motion at times (...)."""
    tau = np.asarray(tau)
    R = Rotation.from_rotvec((tau[..., None] * W).reshape(-1, 3)).as_matrix().reshape(*tau.shape, 3, 3)
    return Pose(R, tau[..., None] * D)


def _times(exposure: float, instants: int) -> tuple[Any, Any]:
    rows = 0.8 * np.arange(EXPOSED.height) / EXPOSED.height
    return rows, instant_times(rows, exposure, instants)


@pytest.mark.parametrize("integrator", ["sunsky", "path"])
def test_single_pass_is_stitched_from_exposed_frames(town: Scene, integrator: Integrator) -> None:
    rows, instants = _times(0.5, 64)
    scene, geometry = MitsubaScene(town), _poses(rows)
    options = RendererOptions(integrator=integrator, samples=4, seed=7)
    whole = render(scene, EXPOSED, LinePoses(*geometry), options, exposed=LinePoses(*_poses(instants)))
    sharp = render(scene, EXPOSED, LinePoses(*geometry), options)
    for full in (True, False):
        stitched = replace(options, method="stitched", full_frames=full)
        oracle = render(scene, EXPOSED, LinePoses(*geometry), stitched, exposed=LinePoses(*_poses(instants)))
        np.testing.assert_array_equal(whole.image, oracle.image)
        np.testing.assert_array_equal(whole.depth, oracle.depth)
    np.testing.assert_array_equal(whole.depth, sharp.depth)
    assert np.abs(whole.image - sharp.image).max() > 0.05, "nothing is blurred"


def test_an_exposed_frame_is_the_mean_of_its_instants(town: Scene) -> None:
    """Over many seeds, as each sample sees one of the instants of its part; 5 standard errors of the mean."""
    rows, instants = _times(0.3, instant_count(4))
    scene, geometry, exposed = MitsubaScene(town), _poses(rows), _poses(instants)

    def image(poses: Pose, seed: int = 0, exposed: LinePoses | None = None) -> Any:
        options = RendererOptions(samples=4, seed=seed)
        return render(scene, EXPOSED, LinePoses(*poses), options, exposed=exposed).image

    frames = np.stack([image(geometry, seed, LinePoses(*exposed)) for seed in range(40)])
    # 64 instants, all sub-pixel samples at each: what the exposed frame is a random part of.
    truth = np.mean([image(_poses(tau)) for tau in instants], axis=0)
    error = frames.mean(axis=0) - truth
    sigma = frames.std(axis=0, ddof=1) / np.sqrt(len(frames))
    assert np.sqrt(np.mean(error**2)) < 1.2 * np.sqrt(np.mean(sigma**2))
    assert np.mean(np.abs(error) > 5.0 * sigma + 1e-6) < 0.005
    assert np.abs(truth - image(geometry)).max() > 0.05, "nothing is blurred"


def test_an_edge_is_smeared_as_far_as_it_moves(quad: Callable[..., Any]) -> None:
    """Closed form: a camera that moves sideways sees an upright edge as a ramp of f v e / z pixels."""
    black, white = (Material(name=f"grey {level}", colour=(level,) * 3) for level in (0.0, 0.8))
    dark = quad([[-50, -50, 4], [0, -50, 4], [0, 50, 4], [-50, 50, 4]], black)
    light = quad([[0, -50, 4], [50, -50, 4], [50, 50, 4], [0, 50, 4]], white)
    sun = Light(sun_direction=(0, 0, -1), up=(0, -1, 0))
    scene = MitsubaScene(Scene(name="edge", meshes=(dark, light), light=sun))
    camera, exposure, speed = PinholeCamera.centred(64, 48, 40.0), 0.4, 3.0
    tau = instant_times(np.zeros(48), exposure, 64)
    t = np.zeros((64, 48, 3))
    t[..., 0] = -speed * tau
    exposed = LinePoses(np.broadcast_to(np.eye(3), (64, 48, 3, 3)), t)
    still = LinePoses(np.broadcast_to(np.eye(3), (48, 3, 3)), np.zeros((48, 3)))
    image = render(scene, camera, still, RendererOptions(samples=16), exposed=exposed).image[..., 0]
    profile = image.mean(axis=0) / image[:, -1].mean()
    ramp = camera.fx * speed * exposure / 4.0  # 12 px
    expected = np.clip((np.arange(64) - camera.cx) / ramp + 0.5, 0.0, 1.0)
    # A sample knows its time to a part of the exposure: 48 rows average 16 samples each, so to 0.3 / sqrt(768).
    assert ramp == pytest.approx(12.0)
    np.testing.assert_allclose(profile, expected, atol=0.05)


@pytest.mark.parametrize("samples", [1, 4, 9, 16, 25, 36, 64, 100])
def test_samples_share_the_exposure_evenly(samples: int) -> None:
    """Each sample of a pixel has its own part, whichever pixel; over pixels every sample sees every instant."""
    start_backend()
    instants = instant_count(samples)
    assert instants >= 64 and instants % samples == 0
    seen = np.array(
        [[np.ravel(instant_of(3, pixel, k, samples, instants))[0] for k in range(samples)] for pixel in range(30)]
    ).astype(int)
    parts = np.sort(seen * samples // instants, axis=1)
    assert np.array_equal(parts, np.broadcast_to(np.arange(samples), parts.shape))
    assert len(np.unique(seen[:, 0])) > 10 or instants < 30


def test_instants_that_samples_cannot_share_are_refused(town: Scene) -> None:
    rows, instants = _times(0.3, 6)
    poses, blur = LinePoses(*_poses(rows)), LinePoses(*_poses(instants))
    with pytest.raises(RsbenchError, match="6 instants: a multiple of the 4 samples is needed"):
        render(MitsubaScene(town), EXPOSED, poses, RendererOptions(samples=4), exposed=blur)


def test_every_card_that_comes_along_is_valid() -> None:
    cards = {name: load_card(RendererOptions, "renderers", name) for name in list_cards("renderers")}
    assert {"default", "path", "stitched", "preview"} <= set(cards)
    assert all(card.description for card in cards.values())
    usual = cards["default"]
    assert (usual.method, usual.integrator, usual.samples) == ("single-pass", "sunsky", 16)
    assert cards["stitched"].method == "stitched" and cards["path"].integrator == "path"
    # Images of one dataset may come from any of them: equal brightness.
    assert len({card.exposure for card in cards.values()}) == 1


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("samples", 15, "perfect square"),
        ("samples", 0, "perfect square"),
        ("samples", 16.0, "samples"),
        ("method", "warp", "single-pass"),
        ("integrator", "magic", "sunsky"),
        ("max_depth", 0, "allowed are 1 to"),
        ("exposure", -1.0, "positive"),
        ("seed", -1, "4294967295"),
        ("sky_rays", 65, "0 to 64"),
        ("sample", 4, "samples"),
    ],
)
def test_bad_values_are_refused_with_what_is_allowed(field: str, value: Any, says: str) -> None:
    with refused(says, "my.toml"):
        parse_card(RendererOptions, {field: value}, "my.toml")
