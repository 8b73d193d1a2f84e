"""Shared parts of the calibration readers: parsed files, the result, and conversion of lenses, poses and units.

Files of any syntax are parsed into nested dicts, lists, strings and numbers: YAML (also OpenCV's, with
``%YAML:1.0`` and tags), JSON, OpenCV's XML, the sections of an INI file, and the lines of COLMAP's cameras.txt and
rigs.txt. The syntax is recognised by the content, not by the file's name. A mapping with ``data`` and with
``rows`` and ``cols``, or ``sizes``, is a matrix and becomes an array.
"""

from __future__ import annotations

import configparser
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import yaml

from rsbench.components.cards import parse_card
from rsbench.components.rig_tables import CameraTable, Size
from rsbench.core import so3
from rsbench.core.camera import COEFFICIENTS, Lens, PinholeCamera
from rsbench.core.errors import RsbenchError, naming
from rsbench.core.lens_fit import (
    Profile,
    continued,
    fov_profile,
    kannala_brandt_of,
    mirror_profile,
    unified_profile,
)
from rsbench.core.rig import Side
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray
from rsbench.storage.untrusted_files import MB, parse_json, read_text

_LONGEST = 8 * MB
"""Limit of the file size, bytes; COLMAP may list a camera for each image of a collection."""
_DEEPEST = 16
"""Limit of the nesting of tables and lists."""
_LISTS = (list, tuple, np.ndarray)
_MOST_FILES = 200
"""Limit of the number of files of a folder that are examined."""
_SUFFIXES = (".yaml", ".yml", ".json", ".xml", ".conf", ".txt", ".calib")


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, without aliases, since nested aliases let a small file expand to gigabytes."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.events.AliasEvent):
            raise yaml.YAMLError("aliases (*name) are not read")
        return super().compose_node(parent, index)


_Loader.add_multi_constructor(
    "tag:yaml.org,2002:opencv-", lambda loader, suffix, node: loader.construct_mapping(node, deep=True)
)


def read_tree(path: Path) -> Any:
    """Parse a file.

    Raises:
        RsbenchError: the file cannot be read, or has none of the supported syntaxes.
    """
    text = read_text(path, _LONGEST)
    try:
        return _arrays(_parsed(text, path))
    except RecursionError as error:
        raise RsbenchError(f"{path}: nested too deeply") from error
    except ValueError as error:
        raise RsbenchError(f"{path}: {' '.join(str(error).split())[:200]}") from error


def _parsed(text: str, path: Path) -> Any:
    start, sections = text.lstrip()[:1], re.search(r"^\[[A-Za-z_][\w ]*\]\s*$", text, re.MULTILINE)
    if start == "<":
        return _of_xml(text)
    if start == "{":
        return parse_json(text, path)
    if sections:
        return _of_ini(text)
    if start == "[":
        return json.loads(text)
    if re.search(r"^\d+ +([A-Z_]+ +\d|\d+ +(CAMERA|IMU)\b)", text, re.MULTILINE):
        return {"colmap": [line.split() for line in text.splitlines() if line[:1].isdigit()]}
    return _of_yaml(text)


def _of_yaml(text: str) -> Any:
    plain = re.sub(r"\A%YAML[: ]1\.\d[^\n]*\n(---[^\n]*\n)?", "", text)
    try:
        return yaml.load(plain, Loader=_Loader)
    except yaml.YAMLError as error:
        words = str(error).replace('in "<unicode string>", ', "at ")
        raise ValueError(f"neither YAML, JSON, XML nor an INI file: {words}") from error


def _of_xml(text: str) -> Any:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("XML with a DOCTYPE or ENTITY definition is not supported")
    try:
        return _of_element(ElementTree.fromstring(text))
    except ElementTree.ParseError as error:
        raise ValueError(f"not valid XML: {error}") from error


def _of_element(element: ElementTree.Element) -> Any:
    if len(element):
        return {child.tag: _of_element(child) for child in element}
    words = (element.text or "").split()
    values = [_number(word) for word in words]
    if len(values) == 1:
        return values[0]
    return element.text if any(isinstance(value, str) for value in values) else values


def _of_ini(text: str) -> Any:
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    parser.optionxform = lambda optionstr: optionstr  # pyrefly: ignore[method-assign]
    try:
        parser.read_string(text)
    except configparser.Error as error:
        raise ValueError(f"not a valid INI file: {error}") from error
    return {name: {key: _number(value) for key, value in section.items()} for name, section in parser.items()}


def _number(word: str) -> float | str:
    try:
        return float(word)
    except ValueError:
        return word


def _arrays(tree: Any, depth: int = 0) -> Any:
    """Return the tree with each matrix converted to an array."""
    if depth > _DEEPEST:
        raise ValueError(f"nested more than {_DEEPEST} levels deep")
    if isinstance(tree, Mapping):
        shape = [tree[key] for key in ("rows", "cols") if key in tree] or tree.get("sizes", [])
        if "data" in tree and shape:
            data, shape = ([each] if isinstance(each, int | float) else each for each in (tree["data"], shape))
            try:
                return np.array([float(value) for value in data]).reshape([int(size) for size in shape])
            except (TypeError, ValueError, OverflowError) as error:
                raise ValueError(f"a matrix of {' x '.join(map(str, shape))} must hold as many numbers") from error
        return {str(key): _arrays(value, depth + 1) for key, value in tree.items()}
    return [_arrays(value, depth + 1) for value in tree] if isinstance(tree, list) else tree


def files_in(folder: Path) -> Iterator[Path]:
    """Yield the files of a folder and of its subfolders that may be calibrations, by their suffix."""
    inside = sorted(folder.iterdir())
    inside += [each for sub in inside if sub.is_dir() for each in sorted(sub.iterdir())[:_MOST_FILES]]
    yield from [path for path in inside if path.suffix.lower() in _SUFFIXES and path.is_file()][:_MOST_FILES]


class Fields:
    """Typed access to the values of a table in a file; errors name the file and the key."""

    def __init__(self, tree: Any, where: str) -> None:
        self.where = where
        self.tree: Mapping[str, Any] = tree if isinstance(tree, Mapping) else {}
        if not isinstance(tree, Mapping):
            raise RsbenchError(f"{where}: must be a table of keys, is {str(tree)[:60]!r}")

    def __contains__(self, key: str) -> bool:
        return self.tree.get(key) is not None

    def known(self, *keys: str) -> str:
        """Return the first key that exists, or the first of ``keys`` if none exists."""
        return next((key for key in keys if key in self), keys[0])

    def get(self, *keys: str) -> Any:
        """Return the value of the first key that exists, or None if none exists."""
        return self.tree.get(self.known(*keys))

    def inner(self, key: str) -> Fields:
        """Return the table that is the value of a key."""
        return Fields(self.tree.get(key), f"{self.where}: {key}")

    def text(self, *keys: str, default: str = "") -> str:
        """Return a string in lower case, without blanks at its ends."""
        value = self.get(*keys)
        return default if value is None else str(value).strip().lower()

    def number(self, key: str, default: float | None = None) -> float:
        """Return a finite number."""
        return default if default is not None and key not in self else float(self.numbers(key, 1)[0])

    def each(self, *keys: str) -> list[float]:
        """Return a finite number for each key."""
        return [self.number(key) for key in keys]

    def numbers(self, key: str, *counts: int) -> FloatArray:
        """Return finite numbers (n,), flattened from nested lists; n must be one of ``counts``, if given."""
        value = self.get(key)
        if value is None:
            raise RsbenchError(f"{self.where}: {key}: is missing")
        try:
            found = np.array([float(each) for each in _flat(value)])
        except (TypeError, ValueError, OverflowError):
            found = np.full(1, np.nan)
        if not np.all(np.isfinite(found)) or (counts and len(found) not in counts):
            wanted = f"{' or '.join(map(str, counts))} " if counts else ""
            raise RsbenchError(
                f"{self.where}: {key} = {' '.join(map(str, _flat(value)))[:60]}: must be {wanted}finite numbers"
            )
        return found


def _flat(value: Any) -> Iterator[Any]:
    if isinstance(value, _LISTS):
        for each in np.ravel(value) if isinstance(value, np.ndarray) else value:
            yield from _flat(each)
    else:
        yield value


Table = dict[str, Any]
_LONGEST_M = 2.0
"""Limit of the baseline, metres, if no unit is given; a longer one suggests that the unit is not the metre."""
UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
_PROPORTION = 0.005
"""Tolerance of the relative change of the aspect ratio of scaled images, whose sizes are whole pixels."""
_NEAR = 1e-3
"""Tolerance of R R^T - I for a rotation matrix that is written with few digits."""


@dataclass(frozen=True, kw_only=True)
class Assumptions:
    """Assumptions of the user about a calibration that its file does not define."""

    unit: float | None = None
    """Metres per unit of the file's lengths."""
    fisheye: bool | None = None
    """Whether four coefficients describe a fisheye lens, if the file does not define it."""
    invert: bool = False
    """Whether the transform of the file maps right-camera coordinates to left-camera coordinates."""
    exchange: bool = False
    """Whether the file's second camera is the left one."""
    frame_size: Callable[[], Size] | None = None
    """Function that returns (width, height) of the frames; some formats have a section for each size."""


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Calibration of one camera or of two."""

    format: str
    left: Table
    """Keys as in rig.toml: width, height, fx, fy, cx, cy, lens, line_delay_s; unknown ones are absent."""
    right: Table | None = None
    right_from_left: Pose | None = None
    """``X_right = R X_left + t``, metres."""
    right_delay_s: float = 0.0
    """Delay of the right camera relative to the left one, seconds."""
    readout: Table = field(default_factory=dict)
    """Keys of rig.toml above its tables: readout_ratio, scan, right_delay and so on; empty for other formats."""
    notes: tuple[str, ...] = ()
    """Assumptions and approximations, one sentence each."""
    files: tuple[Path, ...] = field(default=())

    @property
    def cameras(self) -> dict[Side, Table]:
        """Table of each camera, by side."""
        return {"left": self.left} if self.right is None else {"left": self.left, "right": self.right}

    def with_tables(self, change: Callable[[Table], Table]) -> Calibration:
        """Return the calibration with a function applied to the table of each camera."""
        return replace(self, **{side: change(table) for side, table in self.cameras.items()})

    def tables(self) -> Table:
        """Return the tables of rig.toml without readout times."""
        found: Table = {side: _still(table) for side, table in self.cameras.items()}
        if self.right_from_left is not None:
            R, t = self.right_from_left
            found["right_from_left"] = {"rotation": R.tolist(), "translation": t.tolist()}
        return found


def _still(table: Table) -> Table:
    return {key: value for key, value in table.items() if key != "line_delay_s"}


class Files(NamedTuple):
    """Files of one format that belong together, with their parsed contents."""

    trees: Mapping[Path, Any]
    given: Assumptions

    @property
    def where(self) -> str:
        return " and ".join(map(str, self.trees))

    def only(self) -> Fields:
        """Return the table of the only file; RsbenchError if there are several."""
        if len(self.trees) > 1:
            names = ", ".join(path.name for path in self.trees)
            raise RsbenchError(f"{next(iter(self.trees)).parent}: holds several calibrations: {names}; give one")
        ((path, tree),) = self.trees.items()
        return Fields(tree, str(path))


class Format(NamedTuple):
    name: str
    holds: Callable[[Any], bool]
    """Function that returns whether the content of a file is of this format."""
    read: Callable[[Files], Calibration]
    parts: Callable[[Path, Mapping[Path, Any]], Mapping[Path, Any]] | None = None
    """Function that selects the files that belong together with a file; None if one file is sufficient."""


def table_of(size: Sequence[float] | FloatArray | None, intrinsics: Sequence[float], lens: Lens | None) -> Table:
    """Return the camera table of rig.toml for (width, height), (fx, fy, cx, cy) and a lens."""
    sizes = {} if size is None else dict(zip(("width", "height"), map(round, size), strict=True))
    numbers = dict(zip(("fx", "fy", "cx", "cy"), map(float, intrinsics), strict=True))
    return {**sizes, **numbers, **({} if lens is None else {"lens": lens.record()})}


def camera_of(table: Table, where: str) -> PinholeCamera:
    """Return the camera of a table; RsbenchError if its values are invalid."""
    with naming(where):
        return parse_card(CameraTable, _still(table), where).camera()


def lens_of(model: str, coefficients: Iterable[float], where: str) -> Lens | None:
    """Return a lens of one of our models; coefficients that the model does not have must be 0."""
    values = [float(value) for value in coefficients]
    names = COEFFICIENTS[model]  # pyrefly: ignore[bad-index]
    if any(values[len(names) :]):
        raise RsbenchError(
            f"{where}: distortion coefficients {values[len(names) :]} after the first {len(names)}: thin prisms "
            "and tilted sensors (s1 to s4, tauX, tauY) are not supported; calibrate without them"
        )
    with naming(where):
        return Lens(model=model, **dict(zip(names, values, strict=False)))  # pyrefly: ignore[bad-argument-type]


def brown(coefficients: Iterable[float], where: str) -> Lens | None:
    """Return the lens for OpenCV's vector of 4, 5, 8, 12 or 14 coefficients; None if all are 0."""
    values = [*map(float, coefficients)]
    if not any(values):
        return None
    return lens_of(
        "rational" if any(values[5:8]) else "brown-conrady", values if any(values[5:]) else values[:5], where
    )


_PROFILES: Mapping[str, Callable[..., Profile]] = {
    "fov": fov_profile,
    "eucm": unified_profile,
    "ucm": unified_profile,
    "omni": mirror_profile,
}
"""Radial profiles of lens models that rsbench does not support; they are approximated."""


def camera_table(
    size: Sequence[float] | FloatArray | None,
    intrinsics: Sequence[float],
    name: str,
    coefficients: Sequence[float],
    where: str,
) -> tuple[Table, str]:
    """Return the camera table for a lens model, which has its name in rsbench or in other tools, and a note.

    For an unsupported model, a Kannala-Brandt lens is fitted, and the note states the error of the fit.
    """
    if name.lower() not in _PROFILES:
        lens = lens_of(name, coefficients, where) if name in COEFFICIENTS else by_name(name, coefficients, where)
        return table_of(size, intrinsics, lens), ""
    if size is None:
        raise RsbenchError(f"{where}: {name}: fitting a Kannala-Brandt lens needs the size of the images; add it")
    fx, fy, cx, cy = intrinsics
    with naming(f"{where}: {name}"):
        camera = PinholeCamera(width=round(size[0]), height=round(size[1]), fx=fx, fy=fy, cx=cx, cy=cy)
        fit = kannala_brandt_of(camera, _PROFILES[name.lower()](*coefficients))
    camera_name = where.rsplit(": ", 1)[-1]
    words = f"{name} of {camera_name} became the nearest kannala-brandt, within {fit.error_px:.2g} px"
    return table_of(size, (fit.fx, fit.fy, cx, cy), fit.lens), words


def rotation_of(values: FloatArray, where: str) -> FloatArray:
    """Return the rotation matrix (3, 3) for nine numbers, row by row, or for a rotation vector (3,)."""
    if len(values) == 3:
        return so3.exp(values)
    R = values.reshape(3, 3)
    if not np.allclose(R @ R.T, np.eye(3), atol=_NEAR) or np.linalg.det(R) < 0.0:
        raise RsbenchError(f"{where}: is not a rotation matrix")
    u, _, vt = np.linalg.svd(R)
    return u @ vt


def quaternion_of(wxyz: Sequence[float] | FloatArray, where: str) -> FloatArray:
    """Return the rotation matrix of a quaternion (w, x, y, z); RsbenchError if its length is not 1 within 1 %."""
    length = float(np.linalg.norm(wxyz))
    if not abs(length - 1.0) < 1e-2:
        raise RsbenchError(f"{where}: the quaternion has length {length:g}, not 1")
    return so3.from_quaternion(wxyz)


def pose_of(fields: Fields, key: str) -> Pose:
    """Return the transform of a 3 x 4 or 4 x 4 matrix, given as 12 or 16 numbers row by row."""
    T = fields.numbers(key, 12, 16).reshape(-1, 4)
    return Pose(rotation_of(T[:3, :3].ravel(), f"{fields.where}: {key}"), T[:3, 3])


def in_metres(t: FloatArray, given: Assumptions, where: str) -> tuple[FloatArray, tuple[str, ...]]:
    """Convert a translation of unknown unit to metres; also return a note if metres are assumed."""
    length = float(np.linalg.norm(t))
    if given.unit is not None:
        return t * given.unit, ()
    if length > _LONGEST_M:
        raise RsbenchError(
            f"{where}: the cameras would be {length:.4g} m apart: lengths are in the unit of the board's squares; "
            "say which: rsbench rig FILE --unit mm -o rig.toml (or cm, inch, m, or metres such as 0.025)"
        )
    return t, (
        f"lengths are taken as metres, as the file does not say their unit: {length:.4g} m between the cameras",
    )


def keyed(tree: Any, *keys: str) -> bool:
    return isinstance(tree, Mapping) and all(key in tree for key in keys)


_NAMES = {
    "none": "none",
    "pinhole": "none",
    "radtan": "brown",
    "radial-tangential": "brown",
    "plumb_bob": "brown",
    "brown_conrady": "brown",
    "rational_polynomial": "brown",
    "equidistant": "kannala-brandt",
    "fisheye": "kannala-brandt",
    "kannala_brandt4": "kannala-brandt",
    "kannala_brandt": "kannala-brandt",
    "kb4": "kannala-brandt",
}


def by_name(name: str, coefficients: Sequence[float], where: str) -> Lens | None:
    """Return a lens for the name of its model in other tools; None if there is no distortion."""
    kind = _NAMES.get(name)
    if kind is None:
        raise RsbenchError(f"{where}: lens model {name!r}: must be one of {', '.join(_NAMES)}")
    if kind == "none":
        return None
    return brown(coefficients, where) if kind == "brown" else lens_of(kind, coefficients, where)


def unfolded(found: Calibration, given: Assumptions) -> Calibration:
    """Return the calibration with lens polynomials continued monotonically if they fold inside the image."""
    tables, notes = dict[str, Any](), list(found.notes)
    for side, table in found.cameras.items():
        size = _size_of(table) or (None if given.frame_size is None else given.frame_size())
        made = None if size is None else _continued(table, size)
        if made is not None:
            tables[side] = made[0]
            notes.append(f"{side}: {made[1]}")
    return replace(found, **tables, notes=tuple(notes))


def _size_of(table: Table) -> Size | None:
    return (table["width"], table["height"]) if "width" in table else None


def _fault(table: Table, size: Size) -> ValueError | None:
    """Return the error of a camera of this image size, for example of its lens; None if it is valid."""
    try:
        lens = None if "lens" not in table else Lens(**table["lens"])
        intrinsics = {name: table[name] for name in ("fx", "fy", "cx", "cy")}
        PinholeCamera(width=size[0], height=size[1], lens=lens, **intrinsics)
    except ValueError as error:
        return error
    return None


def _continued(table: Table, size: Size) -> tuple[Table, str] | None:
    """Return the camera with a continued lens and a note if its polynomial folds inside the image, else None."""
    if table.get("lens", {}).get("model") not in ("brown-conrady", "rational"):
        return None
    fx, fy, cx, cy = (table[key] for key in ("fx", "fy", "cx", "cy"))
    if not (fx > 0.0 and fy > 0.0):
        return None
    across, down = (max(c + 0.5, extent - 0.5 - c) / f for c, extent, f in ((cx, size[0], fx), (cy, size[1], fy)))
    if _fault(table, size) is None:
        return None
    made = continued(Lens(**table["lens"]), float(np.hypot(across, down)))
    if made is None:
        return None
    words = (
        f"its polynomial folds before the corners of the image, {np.hypot(across, down):.3f} focal lengths from "
        f"the centre: it is continued from {made.until:.3f} on, {made.error * fx:.2g} px off at most before that"
    )
    return table | {"lens": made.lens.record()}, words


def refuse_unseen(found: Calibration, where: object) -> None:
    """Raise RsbenchError, which suggests a crop, if image corners have no ray in front of the camera."""
    sizes = [size for table in found.cameras.values() if (size := _size_of(table)) is not None]
    for side, table in found.cameras.items():
        size = _size_of(table)
        error = None if size is None else _fault(table, size)
        if size is None or error is None:
            continue
        for share in np.arange(0.98, 0.3, -0.02):
            width, height = (2 * round(share * extent / 2) for extent in size)
            x, y = (size[0] - width) // 2, (size[1] - height) // 2
            within = all(x + width <= each[0] and y + height <= each[1] for each in sizes)
            if within and _fault(_cut(table, x, y), (width, height)) is None:
                raise RsbenchError(
                    f"{where}: {side}: {error}; or crop the frames to what is seen before the camera, and "
                    f"rsbench rig --crop {width}x{height}+{x}+{y} -o rig.toml"
                ) from error
        raise RsbenchError(f"{where}: {side}: {error}") from error


def _cut(table: Table, x: int, y: int) -> Table:
    """Return the camera of images from which the first x columns and y rows are removed."""
    return table | {"cx": table["cx"] - x, "cy": table["cy"] - y}


def cropped(found: Calibration, crop: str) -> Calibration:
    """Return the calibration of frames cropped to WxH+X+Y; RsbenchError if the crop exceeds the images."""
    numbers = re.fullmatch(r"(\d{1,6})x(\d{1,6})\+(\d{1,6})\+(\d{1,6})", crop)
    if numbers is None:
        raise RsbenchError(f"--crop {crop!r}: must be WIDTHxHEIGHT+X+Y, such as 640x480+104+160")
    width, height, x, y = map(int, numbers.groups())

    def cut(table: Table) -> Table:
        whole = _size_of(table)
        if whole is None or not (0 < width <= whole[0] - x and 0 < height <= whole[1] - y):
            shown = "whose size is unknown: give --size" if whole is None else f"of {whole[0]} x {whole[1]} px"
            raise RsbenchError(f"--crop {crop}: must lie inside the images, {shown}")
        return _cut(table, x, y) | {"width": width, "height": height}

    return found.with_tables(cut)


def with_size(found: Calibration, size: Size) -> Calibration:
    """Return the calibration with this image size if it has none.

    Raises:
        RsbenchError: the calibration has another image size.
    """

    def sized(table: Table) -> Table:
        known = (table.get("width", size[0]), table.get("height", size[1]))
        if known != size:
            raise RsbenchError(
                f"--size {size[0]}x{size[1]}: the calibration is of images of {known[0]} x {known[1]} px; "
                "--resize where frames were scaled, not cropped"
            )
        return table | {"width": size[0], "height": size[1]}

    return found.with_tables(sized)


def resized(found: Calibration, size: Size) -> Calibration:
    """Return the calibration of images scaled to another size; RsbenchError if the aspect ratio differs."""

    def scaled(table: Table) -> Table:
        if "width" not in table:
            raise RsbenchError("--resize: the calibration has no image size: give --size too")
        across, down = (new / table[name] for new, name in zip(size, ("width", "height"), strict=True))
        if abs(across / down - 1.0) > _PROPORTION:
            raise RsbenchError(
                f"--resize {size[0]}x{size[1]}: images of {table['width']} x {table['height']} pixels have other "
                "proportions: frames that were cropped need cx and cy less what is cut off; edit rig.toml"
            )
        made = dict(table) | {"width": size[0], "height": size[1]}
        for axis, by in (("x", across), ("y", down)):
            made[f"f{axis}"], made[f"c{axis}"] = by * table[f"f{axis}"], by * (table[f"c{axis}"] + 0.5) - 0.5
        return made if "line_delay_s" not in table else made | {"line_delay_s": table["line_delay_s"] / down}

    return found.with_tables(scaled)
