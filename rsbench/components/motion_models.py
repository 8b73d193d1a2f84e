"""Motion models by name: the one place that turns a name in a card, a file or a solver's spec into a class.

A name is one of rsbench's own, an entry point of the group ``rsbench.motions``, or ``package.module:Class``.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rsbench.components.cards import choices
from rsbench.components.imports import blaming, import_target
from rsbench.components.plugins import Kind, NoOptions, list_names, load_class
from rsbench.core import so3
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion

MOTIONS: Kind[Motion, NoOptions] = Kind(
    singular="motion model",
    group="rsbench.motions",
    base=Motion,
    options=NoOptions,
    built_in={
        "linear": "rsbench.core.motion:LinearMotion",
        "twist": "rsbench.core.motion:TwistMotion",
        "inertial": "rsbench.core.motion:InertialMotion",
        "accelerated": "rsbench.core.motion:AcceleratedMotion",
        "spline": "rsbench.core.spline_motion:SplineMotion",
        "trajectory": "rsbench.core.trajectory_motion:TrajectoryMotion",
    },
)
_SAME = 1e-9
"""Radians and metres by which another package's model may miss its own w and d."""


def list_motions() -> list[str]:
    """Names of all motion models, sorted."""
    return list_names(MOTIONS)


def motion_model(name: str) -> type[Motion]:
    """Class of a motion model.

    Raises:
        RsbenchError: no such model, two of that name, or it cannot be loaded: one line.
    """
    return _built_in(name) if name in MOTIONS.built_in else load_class(MOTIONS, name)


@functools.cache
def _built_in(name: str) -> type[Motion]:
    return load_class(MOTIONS, name)


def model_name(model: type[Motion]) -> str:
    """What ``motion_model`` finds the class by."""
    own = f"{model.__module__}:{model.__qualname__}"
    name = getattr(model, "name", "")
    known = name in MOTIONS.built_in or name in list_motions()  # which reads what every package says of itself
    return name if known and motion_model(name) is model else own


def motion_record(motion: Motion) -> dict[str, Any]:
    """The motion as JSON holds it: ``read_motion`` makes it again."""
    own = {"parameters": motion.parameters} if motion.parameters else {}
    return {"model": model_name(type(motion)), "w": motion.w.tolist(), "d": motion.d.tolist(), **own}


def read_motion(record: Mapping[str, Any]) -> Motion:
    """The motion of a ``motion_record``.

    A class that it names must be installed or on Python's path: no code is run from the folder where data happen
    to lie.

    Raises:
        RsbenchError: see ``make_motion``.
        KeyError: ``model``, ``w`` or ``d`` is missing.
    """
    if ":" in record["model"]:
        import_target(record["model"], None, f"motion model = {record['model']!r}")
    return make_motion(record["model"], record["w"], record["d"], record.get("parameters", {}))


def make_motion(name: str, w: ArrayLike, d: ArrayLike, parameters: Mapping[str, Any] | None = None) -> Motion:
    """Motion of a model from its pose after one frame period and the model's own parameters.

    Raises:
        RsbenchError: no such model, or it cannot have such parameters: one line.
    """
    model, where = motion_model(name), f"motion model {name!r}"
    check_parameters(name, parameters or {})
    if not _foreign(model):
        try:
            return model(w, d, **dict(parameters or {}))
        except (TypeError, ValueError, ArithmeticError, LookupError) as error:  # parameters of any type and shape
            raise RsbenchError(f"{where}: {error}") from error
    with blaming(where, "cannot be made"):
        motion = model(w, d, **dict(parameters or {}))
    _check_ends(motion, where)
    return motion


def check_parameters(name: str, parameters: Mapping[str, Any]) -> None:
    """Raises RsbenchError when there is no such model, or it has no parameter of one of these names."""
    if not parameters and name in MOTIONS.built_in:
        return
    known = list(inspect.signature(motion_model(name)).parameters)[2:]
    for key in parameters:
        if key not in known:
            raise RsbenchError(f"motion model {name!r}: unknown parameter {key!r}{choices(key, known)}")


def drawn_parameters(name: str, parameters: Mapping[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """The parameters with those drawn that are random by default, such as the seed of a shake."""
    check_parameters(name, parameters)
    return motion_model(name).drawn(parameters, rng)


def fixed_endpoint(name: str, parameters: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray] | None:
    """``(w, d)`` where the parameters alone fix them; None where they are free.

    Raises:
        RsbenchError: no such model, or it cannot have such parameters.
    """
    check_parameters(name, parameters)
    try:
        return motion_model(name).endpoint(parameters)
    except ValueError as error:
        raise RsbenchError(f"motion model {name!r}: {error}") from error


def _foreign(model: type[Motion]) -> bool:
    return model.__module__.partition(".")[0] != "rsbench"


def _check_ends(motion: Motion, where: str) -> None:
    """Another package's model must start at the body and reach (w, d) after a period: the truth of all scores."""
    with blaming(where, "body_from_world fails"):
        R, t = motion.body_from_world(np.array([0.0, 1.0]))
        missed = [so3.angle(R @ np.stack([np.eye(3), so3.exp(motion.w).T])), t - np.stack([np.zeros(3), motion.d])]
    for time, wrong in ((0, "the identity"), (1, "(exp([w]x), d)")):
        if not max(float(np.max(np.abs(part[time]))) for part in missed) <= _SAME:
            raise RsbenchError(f"{where}: its pose at time {time} is not {wrong}")
