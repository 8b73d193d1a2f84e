"""An exact rolling-shutter camera in a textured world of planes and spheres: closed forms, no renderer.

A pixel's ray leaves its row's camera, meets the nearest surface, and takes the value of a smooth solid texture at
that very point: images without sampling noise and depth to float64.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.motion import Motion
from rsbench.core.projection import row_poses, rs_project
from rsbench.core.rig import Side, StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter

FloatArray = np.ndarray


@dataclass(frozen=True)
class Plane:
    """Points with normal . X = offset, where ``inside(X)`` holds."""

    normal: tuple[float, float, float]
    offset: float
    inside: Callable[[FloatArray], FloatArray] = lambda X: np.ones(X.shape[:-1], dtype=bool)

    def distance(self, centre: FloatArray, rays: FloatArray) -> FloatArray:
        n = np.array(self.normal)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = (self.offset - centre @ n) / (rays @ n)
        s = np.where(np.isfinite(s) & (s > 0), s, np.inf)
        X = centre + np.where(np.isfinite(s), s, 0.0)[..., None] * rays
        return np.where(self.inside(X), s, np.inf)


@dataclass(frozen=True)
class Sphere:
    """A ball seen from outside."""

    centre: tuple[float, float, float]
    radius: float

    def distance(self, centre: FloatArray, rays: FloatArray) -> FloatArray:
        to = np.array(self.centre) - centre
        aa, ab = np.sum(rays * rays, -1), np.sum(rays * to, -1)
        root = ab * ab - aa * (np.sum(to * to, -1) - self.radius**2)
        s = (ab - np.sqrt(np.maximum(root, 0.0))) / aa
        return np.where((root > 0) & (s > 0), s, np.inf)


@dataclass(frozen=True)
class Texture:
    """Sum of plane waves in space, in [0, 1]; wavelengths in metres from ``shortest`` to eight times that."""

    shortest: float
    seed: int = 0
    waves: int = 40
    parts: tuple[FloatArray, FloatArray, FloatArray] = field(init=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        direction = rng.normal(size=(self.waves, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        length = self.shortest * 8.0 ** rng.random(self.waves)
        wave = (2 * np.pi / length)[:, None] * direction
        object.__setattr__(self, "parts", (wave, rng.uniform(0, 2 * np.pi, (self.waves, 3)), np.ones(self.waves)))

    def __call__(self, X: FloatArray) -> FloatArray:
        """Colour (..., 3)."""
        wave, phase, _ = self.parts
        argument = X @ wave.T
        total = np.stack([np.sin(argument + phase[:, c]).sum(-1) for c in range(3)], axis=-1)
        return 0.5 + 0.5 * np.tanh(total / np.sqrt(2.0 * self.waves))


@dataclass(frozen=True)
class World:
    """Surfaces, texture, rig, shutter and motion; what each camera sees of them."""

    surfaces: tuple[Any, ...]
    texture: Texture
    rig: StereoRig
    shutter: RollingShutter
    motion: Motion
    sky: bool = False
    """Rays that meet nothing see a texture at infinity; otherwise black."""

    def depth_along(self, poses: Pose, pixels: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Depth of pixels (..., 2), inf where nothing is met, with the camera centres and rays in the world."""
        R, t = poses
        rays = (np.swapaxes(R, -1, -2) @ self.rig.camera.unproject(pixels)[..., None])[..., 0]
        centre = -(np.swapaxes(R, -1, -2) @ t[..., None])[..., 0]
        centre = np.broadcast_to(centre, rays.shape)
        nothing = np.full(rays.shape[:-1], np.inf)
        depth = np.min([nothing, *(s.distance(centre, rays) for s in self.surfaces)], axis=0)
        return depth, centre, rays

    def see(self, poses: Pose, columns: bool = False) -> tuple[FloatArray, FloatArray]:
        """Image (H, W, 3) in [0, 1] and depth (H, W), inf where nothing is met, through one pose per line."""
        axis = 0 if columns else 1
        by_line = Pose(np.expand_dims(poses.R, axis), np.expand_dims(poses.t, axis))
        depth, centre, rays = self.depth_along(by_line, self.rig.camera.pixel_grid())
        hit = np.isfinite(depth)
        image = self.texture(centre + np.where(hit, depth, 0.0)[..., None] * rays)
        far = self.texture(40.0 * self.texture.shortest * rays / np.linalg.norm(rays, axis=-1, keepdims=True))
        return np.where(hit[..., None], image, far if self.sky else 0.0), depth

    def rolling(self, side: Side, frame: int) -> tuple[FloatArray, FloatArray]:
        poses = row_poses(self.rig, self.shutter, self.motion, side, frame)
        return self.see(poses, self.shutter.axis(side) == 0)

    def still(self, side: Side, tau: float) -> tuple[FloatArray, FloatArray]:
        """The global-shutter image and depth at one time."""
        rows = np.full(self.rig.camera.height, tau)
        return self.see(self.rig.cam_from_world(self.motion, rows, side))


def build(
    surfaces: tuple[Any, ...],
    *,
    size: tuple[int, int] = (160, 200),
    focal: float = 260.0,
    baseline: float = 0.4,
    readout_ratio: float = 0.8,
    w_deg: tuple[float, float, float] = (0.6, 1.0, -0.5),
    d: tuple[float, float, float] = (0.15, -0.1, 0.2),
    shortest: float = 0.25,
    sky: bool = False,
    seed: int = 0,
) -> World:
    height, width = size
    return World(
        surfaces=surfaces,
        texture=Texture(shortest, seed),
        rig=StereoRig(camera=PinholeCamera.centred(width, height, focal), baseline=baseline),
        shutter=RollingShutter(height=height, readout_ratio=readout_ratio),
        motion=LinearMotion(np.deg2rad(w_deg), np.array(d)),
        sky=sky,
    )


@pytest.fixture(scope="session")
def world() -> Callable[..., World]:
    return build


@pytest.fixture(scope="session")
def scene() -> World:
    """A leaning wall and a ball before it."""
    surfaces = Plane((0.2, 0.3, 1), 8), Sphere((0.2, 0.1, 4), 0.6)
    return build(surfaces, size=(240, 320), focal=400, shortest=0.12)


def to_u8(image: FloatArray) -> np.ndarray:
    return np.clip(np.rint(255.0 * image), 0, 255).astype(np.uint8)


@pytest.fixture(scope="session")
def shapes() -> tuple[type[Plane], type[Sphere]]:
    return Plane, Sphere


@pytest.fixture(scope="session")
def u8() -> Callable[[FloatArray], np.ndarray]:
    return to_u8


@dataclass(frozen=True)
class Truth:
    """What the global-shutter camera at one time sees, and where the rolling-shutter frame saw it."""

    image: FloatArray
    depth: FloatArray
    source: FloatArray
    """(H, W, 2) pixel of the rolling-shutter frame that shows the same point; NaN when none does."""
    visible: FloatArray
    """(H, W) the frame saw the point: inside its outermost pixel centres and not hidden."""


def truth_at(world: World, side: Side, frame: int, tau: float, target: Side | None = None) -> Truth:
    """Closed-form truth of a correction: rays of the target, their points, and ``rs_project`` of these.

    The target is the camera that saw the frame, unless another one is named.
    """
    rig, camera, target = world.rig, world.rig.camera, target or side
    image, _ = world.still(target, tau)
    depth, centre, rays = world.depth_along(rig.cam_from_world(world.motion, tau, target), camera.pixel_grid())
    points = centre + np.where(np.isfinite(depth), depth, 1e9)[..., None] * rays
    seen = rs_project(rig, world.shutter, world.motion, side, frame, points)
    known = np.isfinite(seen.depth)
    pixels, times = np.where(known[..., None], seen.pixels, 0.0), np.where(known, seen.tau, 0.0)
    nearest, _, _ = world.depth_along(rig.cam_from_world(world.motion, times, side), pixels)
    hidden = np.minimum(nearest, 1e9) < seen.depth * (1 - 1e-6)
    limit = np.array([camera.width - 1, camera.height - 1])
    inside = np.all((pixels >= 0) & (pixels <= limit), axis=-1)
    return Truth(image=image, depth=depth, source=seen.pixels, visible=known & ~hidden & inside)


@pytest.fixture(scope="session")
def truth() -> Callable[..., Truth]:
    return truth_at
