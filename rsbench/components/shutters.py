"""Shutters of real cameras by name: how long a frame is read, and how often one is taken."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rsbench.components.cards import load_card
from rsbench.core.errors import RsbenchError

SHUTTER_KEY = {
    "shutter": "Name of a shutter card or a path to one, in place of ``readout_ratio``: the readout time of a "
    "real camera's mode over the frame period, which is the mode's unless ``frame_period_s`` is given."
}
"""Of the tables in which ``with_shutter`` replaces the key."""


@dataclass(frozen=True, kw_only=True)
class ShutterCard:
    """One mode of one camera; rows are read from the top, evenly."""

    description: str
    """Camera and mode, for ``rsbench list shutters``."""
    readout_ms: float
    """Milliseconds from the first row to the (missing) row after the last one."""
    fps: float
    """Frames per second of the mode."""
    width: int
    """Pixels of the mode's frames across; the readout time is theirs, whatever the size of the images that take
    it."""
    height: int
    """Pixels of the mode's frames down."""
    source: str
    """Where the readout time comes from."""

    def __post_init__(self) -> None:
        for name in ("readout_ms", "fps", "width", "height"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} = {getattr(self, name)}: must be positive")
        if self.readout_ms > self.frame_period_ms * (1 + 1e-9):
            raise ValueError(f"readout_ms = {self.readout_ms}: longer than a frame period, 1 / fps")

    @property
    def frame_period_ms(self) -> float:
        """Milliseconds from one frame to the next."""
        return 1e3 / self.fps


def with_shutter(table: Mapping[str, Any], where: str) -> dict[str, Any]:
    """A table of a card in which ``shutter = NAME`` is replaced by what it means.

    That is ``readout_ratio`` and, unless the table has its own, ``frame_period_s``.

    Raises:
        RsbenchError: no such shutter, a readout ratio beside it, or a frame period shorter than its readout.
    """
    if "shutter" not in table:
        return dict(table)
    name, left = table["shutter"], {key: value for key, value in table.items() if key != "shutter"}
    if not isinstance(name, str):
        raise RsbenchError(f"{where}: shutter = {name!r}: must be a name (rsbench list shutters) or a path")
    if "readout_ratio" in left:
        raise RsbenchError(f"{where}: shutter and readout_ratio exclude each other; leave one out")
    try:
        shutter = load_card(ShutterCard, "shutters", name)
    except RsbenchError as error:
        raise RsbenchError(f"{where}: shutter: {error}") from error
    period = left.setdefault("frame_period_s", 1.0 / shutter.fps)
    readout = 1e-3 * shutter.readout_ms
    if isinstance(period, int | float) and 0.0 < period < readout * (1 - 1e-9):
        raise RsbenchError(
            f"{where}: frame_period_s = {period}: {name} reads a frame for {readout:.6g} s; leave frame_period_s "
            "out or give at least that"
        )
    if isinstance(period, int | float) and period > 0.0:
        left["readout_ratio"] = min(readout / period, 1.0)
    return left


def with_shutters(card: Mapping[str, Any], where: str) -> dict[str, Any]:
    """A dataset's card in which every ``shutter`` is replaced by what it means; what is wrong stays so.

    Raises:
        RsbenchError: as ``with_shutter``.
    """

    def meant(value: Any) -> Any:
        return with_shutter(value, where) if isinstance(value, dict) else value

    def values(axis: Any) -> Any:
        return {key: meant(value) for key, value in axis.items()} if isinstance(axis, dict) else axis

    made = with_shutter(card, where)
    if isinstance(sequences := made.get("sequence"), list):
        made["sequence"] = [meant(sequence) for sequence in sequences]
    if isinstance(grid := made.get("grid"), dict):
        made["grid"] = {name: values(axis) for name, axis in grid.items()}
    return made
