"""The motion of a sequence as a dataset card says it."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rsbench.components.motion_models import drawn_parameters, fixed_endpoint, make_motion, motion_model
from rsbench.core.motion import Motion

Vector = tuple[float, float, float]
Axis = Vector | str


@dataclass(frozen=True, kw_only=True)
class MotionCard:
    """Magnitudes and axes of one frame period's motion; the axes need not be unit vectors."""

    model: str = "linear"
    """Name of a motion model, or ``package.module:Class``."""
    parameters: dict[str, Any] = field(default_factory=dict)
    """Parameters of the motion model; absent ones have its defaults, or are drawn for each sequence (a shake's
    seed)."""
    rotation_deg: float | None = None
    """Angle of the rotation in one frame period, degrees. Required, as the axes and the translation are, unless
    the parameters alone fix the motion."""
    rotation_axis: Axis | None = None
    """Axis of the rotation (x right, y down, z forward), of any length; or ``"random"``: drawn for each sequence
    from its seed and name when the card is loaded."""
    translation: float | None = None
    """Length of the translation in one frame period, metres."""
    translation_axis: Axis | None = None
    """Direction of the translation, of any length; or ``"random"``."""

    def __post_init__(self) -> None:
        names = ("rotation_deg", "rotation_axis", "translation", "translation_axis")
        given = [name for name in names if getattr(self, name) is not None]
        if fixed_endpoint(self.model, self.parameters) is not None:
            if given:
                raise ValueError(f"{given[0]}: the parameters of the model {self.model!r} fix the motion already")
            self.motion()
            return
        for name in names:
            if name not in given:
                raise ValueError(f"{name!r} is required")
        for name, length in (("rotation", self.rotation_deg), ("translation", self.translation)):
            if length is not None and length < 0:
                raise ValueError(f"{name} must not be negative, got {length}")
            axis = getattr(self, f"{name}_axis")
            if isinstance(axis, str) and axis != "random":
                raise ValueError(f'{name}_axis = {axis!r}: must be three numbers or "random"')
            if length and not isinstance(axis, str) and not np.any(axis):
                raise ValueError(f"{name}_axis must not be zero when there is {name}")
        make_motion(self.model, np.zeros(3), np.zeros(3), self.parameters)

    def motion(self) -> Motion:
        """The motion of the rig's body, radians and metres per frame period.

        Raises ValueError when an axis was not drawn yet.
        """
        w, d = fixed_endpoint(self.model, self.parameters) or (
            _scaled(self.rotation_axis, np.deg2rad(self.rotation_deg or 0.0)),
            _scaled(self.translation_axis, self.translation or 0.0),
        )
        return make_motion(self.model, w, d, self.parameters)

    def lasting(self, periods: float) -> MotionCard:
        """With what a model needs to go on as it is until a time, where the card does not say it."""
        return replace(self, parameters=motion_model(self.model).lasting(self.parameters, periods))

    def drawn(self, seed: int, name: str) -> MotionCard:
        """With axes drawn, uniform on the sphere, the same whatever the lengths are; and random parameters."""
        axes = {
            field: _random_axis(f"{seed}/{name}/{field}")
            for field in ("rotation_axis", "translation_axis")
            if getattr(self, field) == "random"
        }
        parameters = drawn_parameters(self.model, self.parameters, generator(f"{seed}/{name}/parameters"))
        return replace(self, parameters=parameters, **axes)


def generator(text: str) -> np.random.Generator:
    """What is drawn for a purpose that a text names."""
    return np.random.default_rng(int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "little"))


def _random_axis(text: str) -> Vector:
    v = generator(text).standard_normal(3)
    x, y, z = (v / np.linalg.norm(v)).tolist()
    return x, y, z


def _scaled(axis: Axis | None, length: float) -> np.ndarray:
    if axis is None or isinstance(axis, str):
        raise ValueError('an axis is still "random"; load_dataset_card draws it')
    v = np.asarray(axis, dtype=np.float64)
    return v * (length / np.linalg.norm(v)) if length > 0 else np.zeros(3)
