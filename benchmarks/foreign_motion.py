"""Laws of motion for ``foreign_frames.py``, written from formulas alone: no code of rsbench.

A law says where the body (the centre of the baseline) is at time tau, in frame periods:
``X_body = R X_world + t``, the identity at time 0. Angles are radians, lengths metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
SINES = 3
"""Of each axis of a shaken motion."""


class Law(Protocol):
    """Where the body is."""

    def body(self, tau: Array) -> tuple[Array, Array]:
        """R (n, 3, 3) and t (n, 3) at times (n,)."""
        ...


def matrices(vectors: Array) -> Array:
    """Rotation matrices (n, 3, 3) of rotation vectors (n, 3)."""
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())


@dataclass(frozen=True)
class Linear:
    """R = exp(tau w), t = tau d."""

    w: Array
    d: Array

    def body(self, tau: Array) -> tuple[Array, Array]:
        return matrices(tau[:, None] * self.w), tau[:, None] * self.d


@dataclass(frozen=True)
class Twist:
    """The same velocity in the body at all times: the pose is exp(tau xi), xi = (w, v); w is not 0."""

    w: Array
    v: Array

    def body(self, tau: Array) -> tuple[Array, Array]:
        # The integral of exp(s w) v over s from 0 to tau; what lies along w only grows.
        rate = float(np.linalg.norm(self.w))
        axis = self.w / rate
        along = (axis @ self.v) * axis
        across, turned = self.v - along, np.cross(axis, self.v)
        angle = (rate * tau)[:, None]
        t = tau[:, None] * along + (np.sin(angle) * across + (1.0 - np.cos(angle)) * turned) / rate
        return matrices(tau[:, None] * self.w), t


@dataclass(frozen=True)
class Inertial:
    """The centre is at tau v in the world, R = exp(tau w)."""

    w: Array
    v: Array

    def body(self, tau: Array) -> tuple[Array, Array]:
        R = matrices(tau[:, None] * self.w)
        return R, _from_centres(R, tau[:, None] * self.v)


@dataclass(frozen=True)
class Accelerated:
    """R = exp(beta w), t = beta d, beta = (tau + k tau^2 / 2) 2 / (2 + k)."""

    w: Array
    d: Array
    k: float

    def body(self, tau: Array) -> tuple[Array, Array]:
        beta = (tau + self.k * tau**2 / 2.0) * 2.0 / (2.0 + self.k)
        return matrices(beta[:, None] * self.w), beta[:, None] * self.d


@dataclass(frozen=True)
class Shaken:
    """Rotation vector and centre grow evenly; three sines are added to each of their six coordinates."""

    w: Array
    v: Array
    amplitudes: Array = field(default_factory=lambda: np.zeros((6, SINES)))
    """(6, 3): of the three axes of rotation, radians, and of translation, metres."""
    cycles: Array = field(default_factory=lambda: np.zeros((6, SINES)))
    """Per frame period."""
    phases: Array = field(default_factory=lambda: np.zeros((6, SINES)))

    def body(self, tau: Array) -> tuple[Array, Array]:
        angles = 2.0 * np.pi * self.cycles * tau[:, None, None] + self.phases
        sines = np.sum(self.amplitudes * (np.sin(angles) - np.sin(self.phases)), axis=-1)
        R = matrices(tau[:, None] * self.w + sines[:, :3])
        return R, _from_centres(R, tau[:, None] * self.v + sines[:, 3:])


def _from_centres(R: Array, centres: Array) -> Array:
    """t (n, 3) of the body whose centre is there in the world."""
    return -np.einsum("nij,nj->ni", R, centres)


def centres(law: Law, tau: Array) -> Array:
    """Places (n, 3) of the body in the world."""
    R, t = law.body(tau)
    return -np.einsum("nji,nj->ni", R, t)


def between(law: Law, first: float, last: float) -> tuple[Array, Array]:
    """w (3,), d (3,): rotation vector and translation of the body from one time to another."""
    R, t = law.body(np.array([first, last]))
    turn = R[1] @ R[0].T
    return np.asarray(Rotation.from_matrix(turn).as_rotvec()), np.asarray(t[1] - turn @ t[0])


def direction(rng: np.random.Generator, weights: tuple[float, float, float]) -> Array:
    """A random unit vector that prefers the axes of larger weights."""
    v = rng.normal(size=3) * weights
    return np.asarray(v / np.linalg.norm(v))


def shaken(rng: np.random.Generator, strength: float, slowest: float, fastest: float) -> Shaken:
    """1.5 deg and 0.15 m per frame, shaken by around ``strength`` times 0.2 deg and 5 mm for each sine."""
    size = np.repeat([np.radians(0.2), 0.005], 3)[:, None] * strength
    return Shaken(
        w=np.radians(1.5) * direction(rng, (0.5, 1.0, 0.4)),
        v=0.15 * direction(rng, (1.0, 0.4, 0.7)),
        amplitudes=size * rng.uniform(0.6, 1.4, (6, SINES)),
        cycles=rng.uniform(slowest, fastest, (6, SINES)),
        phases=rng.uniform(0.0, 2.0 * np.pi, (6, SINES)),
    )
