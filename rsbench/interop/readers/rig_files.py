"""Readers of a user's camera files: rig.toml, camera.toml, or a calibration of another tool."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rsbench.components.cards import parse_card, read_toml, with_shutter
from rsbench.components.rig_tables import RightFromLeft, Size, with_readouts
from rsbench.core.errors import RsbenchError, naming
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import Scanning
from rsbench.interop.readers.calibration_parts import Assumptions, Calibration, Table, refuse_unseen
from rsbench.interop.readers.calibrations import read_calibration
from rsbench.pipeline.footage import OneCameraCard, RigCard, rig_path

_READOUTS = ("readout_ratio", "shutter", "line_delay_s")


@dataclass(frozen=True, kw_only=True)
class Readout:
    """Readout options of the user, which replace the values in the file."""

    readout_ratio: float | None = None
    shutter: str | None = None
    """Name or path of a shutter card."""
    fps: float | None = None
    """Frames per second, required for values in seconds."""

    def __post_init__(self) -> None:
        if self.readout_ratio is not None and self.shutter is not None:
            raise RsbenchError("--readout-ratio and --shutter exclude each other; leave one out")
        if self.fps is not None and not 0.0 < self.fps < 1e6:
            raise RsbenchError(f"--fps {self.fps:g}: must be a positive number of frames per second")

    def into(self, table: Mapping[str, Any]) -> Table:
        """Return the tables of a rig or camera with their readout values replaced by these."""
        made = dict(table)
        if self.readout_ratio is not None or self.shutter is not None:
            made = _without(made, _READOUTS)
            made |= {side: _without(made[side], _READOUTS) for side in SIDES if isinstance(made.get(side), dict)}
            given = {"readout_ratio": self.readout_ratio, "shutter": self.shutter}
            made |= {key: value for key, value in given.items() if value is not None}
        return made if self.fps is None else made | {"frame_period_s": 1.0 / self.fps}


def _without(table: Mapping[str, Any], keys: tuple[str, ...]) -> Table:
    return {key: value for key, value in table.items() if key not in keys}


def read_rig_file(
    path: Path, readout: Readout | None = None, frame_size: Callable[[], Size] | None = None
) -> tuple[RigCard, tuple[str, ...]]:
    """Read the card of a rig from rig.toml or a calibration of another tool, and the assumptions as sentences.

    Args:
        path: the file, or a folder with files that belong together.
        readout: replaces the values in the file.
        frame_size: gives the (width, height) of the frames, by which some formats choose a section.

    Raises:
        RsbenchError: the file is missing or invalid; the message names file, field, fault and remedy.
    """
    readout, path = readout or Readout(), rig_path(path)
    if path.suffix == ".toml":
        return parse_card(RigCard, with_readouts(readout.into(read_toml(path)), str(path)), str(path)), ()
    found = read_calibration(path, Assumptions(frame_size=frame_size))
    if found.right is None:
        raise RsbenchError(
            f"{path}: {found.format}: describes only one camera: give the folder with both, or use --camera for "
            "frames of one camera"
        )
    refuse_unseen(found, path)
    table, missing = tables_of_calibration(found, readout)
    card = parse_card(RigCard, with_readouts(table, str(path)), str(path))
    return card, (*found.notes, *missing)


def tables_of_calibration(found: Calibration, readout: Readout) -> tuple[Table, tuple[str, ...]]:
    """Return the tables of rig.toml, and a note on each value in seconds if the frame rate is missing."""
    table, notes = found.tables(), list[str]()
    given = readout.readout_ratio is not None or readout.shutter is not None
    for side, own in found.cameras.items():
        delay = None if given else own.get("line_delay_s")
        if delay == 0.0:
            table[side]["readout_ratio"] = 0.0
        elif delay is not None and readout.fps is not None:
            table[side]["line_delay_s"] = delay
        elif delay is not None:
            notes.append(f"{side}: line_delay = {delay:.6g} s is used only with the frames' rate (--fps)")
    if found.right_delay_s and (readout.fps is not None or readout.shutter is not None):
        table["right"]["delay_s"] = found.right_delay_s
    elif found.right_delay_s:
        notes.append(f"the right camera is {found.right_delay_s:.6g} s late, which is used only with --fps")
    return readout.into(table), tuple(notes)


def read_camera_file(
    path: Path | None, readout: Readout | None = None, frame_size: Callable[[], Size] | None = None
) -> tuple[OneCameraCard, tuple[str, ...]]:
    """Read the card of one camera from camera.toml or a calibration of another tool; see ``read_rig_file``."""
    readout = readout or Readout()
    if path is None or path.suffix == ".toml":
        table = readout.into({} if path is None else read_toml(path))
        where = "--shutter, --readout-ratio" if path is None else str(path)
        return parse_card(OneCameraCard, with_shutter(table, where), where), ()
    found = read_calibration(path, Assumptions(frame_size=frame_size))
    notes = list(found.notes)
    if found.right is not None:
        notes.append("describes two cameras; the left one is used")
    own = dict(found.left)
    size, delay = (own.pop("width", None), own.pop("height", None)), own.pop("line_delay_s", None)
    if frame_size is not None and None not in size and size != (wanted := frame_size()):
        raise RsbenchError(
            f"{path}: is of images of {size[0]} x {size[1]} pixels, and the frames are {wanted[0]} x {wanted[1]}; "
            "give the calibration of that size, or rsbench rig --resize where frames were scaled, not cropped"
        )
    table = readout.into({"camera": own})
    if delay is not None and "readout_ratio" not in table and "shutter" not in table:
        if delay == 0.0:
            table["readout_ratio"] = 0.0
        elif readout.fps is not None and size[1] is not None:
            table["readout_ratio"] = min(delay * size[1] * readout.fps, 1.0)
        else:
            notes.append(f"line_delay = {delay:.6g} s is used only with the frames' rate (--fps)")
    return parse_card(OneCameraCard, with_shutter(table, str(path)), str(path)), tuple(notes)


class KnownRig(NamedTuple):
    """A rig as described by a file."""

    rig: StereoRig
    readout_ratio: float | None
    """Readout time over frame period; None if it has to be estimated from the frames."""
    scanning: Scanning | None
    """Scan direction, and differences of the right camera; None if they have to be estimated from the frames."""
    notes: tuple[str, ...]
    """Assumptions, and values that need the frame rate."""


def known_rig(path: Path, sizes: tuple[Size, Size] | None = None, fps: float | None = None) -> KnownRig:
    """Read the rig of a file; see ``rsbench.read_rig``."""
    card, notes = read_rig_file(path, Readout(fps=fps), None if sizes is None else lambda: sizes[0])
    left, right = (None if side is None else side.size for side in (card.left, card.right))
    if sizes is None and (left is None or right is None):
        raise RsbenchError(f"{path}: has no image size: give size = (width, height)")
    left, right = sizes or (left, right)
    assert left is not None and right is not None
    with naming(path):
        return KnownRig(card.rig(left, right), card.readout_ratio, card.scanning, notes)


def calibration_of(path: Path, given: Assumptions) -> Calibration:
    """Read the calibration in any supported file, also rig.toml and camera.toml."""
    path = rig_path(path)
    if path.suffix != ".toml":
        return read_calibration(path, given)
    table = read_toml(path)
    if "baseline" not in table and "left" not in table:
        one = parse_card(OneCameraCard, with_shutter(table, str(path)), str(path))
        if one.camera is None:
            raise RsbenchError(f"{path}: camera: is required to show or convert it")
        return Calibration(format="camera.toml", left=_record(one.camera), readout=_readout(one))
    card = parse_card(RigCard, with_readouts(table, str(path)), str(path))
    apart = card.right_from_left or RightFromLeft(translation=(-(card.baseline or 0.0), 0.0, 0.0))
    return Calibration(
        format="rig.toml",
        left=_record(card.camera or card.left),
        right=_record(card.camera or card.right),
        right_from_left=Pose(apart.R, np.array(apart.translation)),
        readout=_readout(card),
    )


def _record(camera: Any) -> Table:
    names = ("width", "height", "fx", "fy", "cx", "cy")
    own = {name: value for name in names if (value := getattr(camera, name, None)) is not None}
    return own if camera.lens is None else own | {"lens": camera.lens.record()}


def _readout(card: RigCard | OneCameraCard) -> Table:
    names = ("readout_ratio", "scan", "right_readout_ratio", "right_scan", "right_delay", "frame_period_s")
    known = {name: value for name in names if (value := getattr(card, name, None)) is not None}
    return known if known.get("right_delay") else _without(known, ("right_delay",))
