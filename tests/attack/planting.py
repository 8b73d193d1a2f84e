"""How faults are planted into a copy of a sound dataset, with hashes and lists made to fit, and are found.

The dataset is that of cards/datasets/smoke.toml, with the sequences "castle" and "room-twist".
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from attack.wet_castle import WET_CASTLE
from rsbench.components.cards import parse_card
from rsbench.components.rig_tables import RigTables, tables_of
from rsbench.core.projection import row_poses
from rsbench.core.rig import VIEWS
from rsbench.dataset.clock_channels import write_timing
from rsbench.dataset.manifest import croissant_of
from rsbench.dataset.sequence import Sequence, read_sequence, sequence_manifest
from rsbench.storage.files import (
    read_depth,
    read_json,
    read_png,
    sha256,
    write_depth,
    write_json,
    write_png,
    write_poses,
)
from rsbench.verification import verify_sequence
from rsbench.verification.manifest_checks import Listing, dataset_faults
from rsbench.verification.rerender import Rerenderer

VICTIM, OTHER = "castle", "room-twist"
Plant = Callable[[Path], None]
"""Changes the files of a dataset in a folder."""


@dataclass(frozen=True)
class Fault:
    """One fault: what plants it, and words that one line of verify's answer must hold."""

    name: str
    plant: Plant
    words: tuple[str, ...]
    rendered: bool = False
    """Whether only rendering again can show it."""
    slow: bool = False
    """Whether planting it needs the scene."""
    rehash: bool = True
    """Whether the hashes are made to fit; False where the hashes are the fault."""


def rehash(folder: Path) -> None:
    """What an adversary does last: every hash, size and list fits the files that are there now."""
    manifest = read_json(folder / "dataset.json")
    listed: dict[str, Any] = {}
    for name in dict.fromkeys(path.partition("/")[0] for path in manifest["files"]):
        own = read_json(folder / name / "sequence.json")
        paths = [path for path in own["files"] if (folder / name / path).is_file()]
        own["files"] = {path: sha256(folder / name / path) for path in paths}
        write_json(folder / name / "sequence.json", own)
        for path in ("sequence.json", *paths):
            file = folder / name / path
            listed[f"{name}/{path}"] = {"sha256": sha256(file), "size": file.stat().st_size}
    write_json(folder / "dataset.json", manifest | {"files": listed})
    with suppress(KeyError, TypeError, AttributeError):  # the fault is in what it tells
        croissant = croissant_of(manifest | {"files": listed}, sha256(folder / "dataset.json"))
        write_json(folder / "croissant.json", croissant)


def planted(fault: Fault, sound: Path, out: Path) -> Path:
    """A copy of the sound dataset with the fault in it."""
    shutil.rmtree(out, ignore_errors=True)
    return spoilt(sound, out, fault.plant, fit=fault.rehash)


def spoilt(sound: Path, out: Path, *plants: Plant, sequence: str = "", fit: bool = True) -> Path:
    """A copy of a dataset with faults in it, or in the folder of a ``sequence``; hashes are made to ``fit``."""
    shutil.copytree(sound, out)
    for plant in plants:
        plant(out / sequence)
    if fit:
        rehash(out)
    return out


def named(faults: Iterable[str], words: Iterable[str]) -> bool:
    """Whether one of the faults has all of these words."""
    return any(all(word in fault for word in words) for fault in faults)


def found(fault: Fault, folder: Path) -> tuple[bool, list[str]]:
    """Whether one line of verify's answer has the fault's words; and all lines, but for the other sequence."""
    listing = Listing.of(folder, read_json(folder / "dataset.json"))
    again = Rerenderer("auto", [WET_CASTLE]) if fault.rendered else None
    lines = [*map(str, dataset_faults(listing)), *_of_victim(listing, again)]
    return named(lines, fault.words), lines


def _of_victim(listing: Listing, again: Rerenderer | None) -> tuple[str, ...]:
    return verify_sequence(listing, VICTIM, again=again).faults if VICTIM in listing.names else ()


# How files are changed


def depth_of(shutter: str, view: str, change: Callable[[NDArray[np.float32]], NDArray[Any]]) -> Plant:
    def plant(folder: Path) -> None:
        path = folder / VICTIM / f"{shutter}_depth/{view}.exr"
        write_depth(path, np.asarray(change(read_depth(path).copy()), dtype=np.float32))

    return plant


def image_of(shutter: str, view: str, change: Callable[[NDArray[np.uint8]], NDArray[Any]]) -> Plant:
    def plant(folder: Path) -> None:
        path = folder / VICTIM / f"{shutter}/{view}.png"
        pixels = change(read_png(path).copy())
        if pixels.dtype == np.uint8 and pixels.ndim == 3 and pixels.shape[2] == 3:
            write_png(path, pixels)
        else:
            assert cv2.imwrite(str(path), pixels)

    return plant


def in_victim(plant: Plant) -> Plant:
    """The same for the folder of the one sequence."""
    return lambda folder: plant(folder / VICTIM)


def copied(source: str, target: str) -> Plant:
    def plant(folder: Path) -> None:
        shutil.copyfile(folder / source, folder / target)

    return plant


def written(place: str) -> Plant:
    def plant(folder: Path) -> None:
        (folder / place).write_text("more")

    return plant


def removed(place: str) -> Plant:
    return lambda folder: (folder / place).unlink()


def exchanged(*pairs: tuple[str, str]) -> Plant:
    def plant(folder: Path) -> None:
        for one, other in pairs:
            a, b = folder / one, folder / other
            kept = a.read_bytes()
            a.write_bytes(b.read_bytes())
            b.write_bytes(kept)

    return plant


def swapped(*pairs: tuple[str, str]) -> Plant:
    return in_victim(exchanged(*pairs))


Lines = list[list[str]]


def table_of(file: str, change: Callable[[Lines], Lines]) -> Plant:
    """``change`` takes and gives the lines of a CSV file, header first, split at commas."""

    def plant(folder: Path) -> None:
        path = folder / file
        lines = [line.split(",") for line in path.read_text().splitlines()]
        path.write_text("\n".join(",".join(line) for line in change(lines)) + "\n")

    return plant


def poses_of(view: str, change: Callable[[Lines], Lines]) -> Plant:
    return table_of(f"{VICTIM}/poses/{view}.csv", change)


def rows_scaled(columns: slice, factor: float, rows: slice = slice(1, None)) -> Callable[[Lines], Lines]:
    def change(lines: Lines) -> Lines:
        for line in lines[rows]:
            line[columns] = [repr(factor * float(value)) for value in line[columns]]
        return lines

    return change


def cell(line: int, column: int, value: str) -> Callable[[Lines], Lines]:
    """Line 1 is that of row 0."""

    def change(lines: Lines) -> Lines:
        lines[line][column] = value
        return lines

    return change


def renumbered(lines: Lines) -> Lines:
    return [lines[0], *([str(row), *line[1:]] for row, line in enumerate(lines[1:]))]


def manifest_of(file: str, change: Callable[[dict[str, Any]], object]) -> Plant:
    """``change`` changes the content of a JSON file in place."""

    def plant(folder: Path) -> None:
        content = json.loads((folder / file).read_text())
        change(content)
        (folder / file).write_text(json.dumps(content, indent=2))

    return plant


def put(*path: Any) -> Callable[[dict[str, Any]], object]:
    """Set the last of the keys in ``path[:-1]`` to ``path[-1]``."""
    *keys, last, value = path

    def change(content: Any) -> None:
        for key in keys:
            content = content[key]
        content[last] = value

    return change


def drop(*path: Any) -> Callable[[dict[str, Any]], object]:
    *keys, last = path

    def change(content: Any) -> None:
        for key in keys:
            content = content[key]
        del content[last]

    return change


def other_geometry(change: Callable[[Sequence], Sequence]) -> Plant:
    """sequence.json, poses, times and card all say another rig, shutter or motion than that of the images."""

    def plant(folder: Path) -> None:
        path = folder / VICTIM / "sequence.json"
        sequence = change(read_sequence(path.parent))
        rig, shutter, motion = sequence.rig, sequence.shutter, sequence.motion
        kept = {key: value for key, value in read_json(path).items() if key not in asdict(shutter.scanning)}
        period = sequence.frame_period_s
        geometry = sequence_manifest(name=VICTIM, rig=rig, shutter=shutter, motion=motion, frame_period_s=period)
        write_json(path, kept | geometry)
        for side, frame in VIEWS:
            poses = row_poses(rig, shutter, motion, side, frame)
            write_poses(path.parent / f"poses/{side}_{frame}.csv", shutter.line_times(frame, side), poses)
        if "timing" in sequence.channels:
            write_timing(path.parent, shutter, period, sequence.sensor, sequence.frames)
        dataset = read_json(folder / "dataset.json")
        card = dataset["card"]
        card |= {"readout_ratio": shutter.readout_ratio, **asdict(shutter.scanning)}
        if rig.aligned:
            card["baseline"] = rig.baseline
            card["camera"] |= {"focal": rig.camera.fx, "lens": rig.camera.lens and asdict(rig.camera.lens)}
        else:
            card["rig"] = asdict(parse_card(RigTables, tables_of(rig), "rig"))
        write_json(folder / "dataset.json", dataset)

    return plant


# What the changes are

RNG = 7


def noised(size: float, rows: slice = slice(1, None)) -> Callable[[NDArray[np.float32]], NDArray[Any]]:
    def change(depth: NDArray[np.float32]) -> NDArray[Any]:
        noise = 1 + size * np.random.default_rng(RNG).standard_normal(depth.shape)
        depth[rows] = (depth * noise)[rows]
        return np.maximum(depth, 0)

    return change


def holed(depth: NDArray[np.float32]) -> NDArray[Any]:
    depth[50:60, 40:60] = 0
    return depth


def times(factor: float, *where: slice) -> Callable[[NDArray[np.float32]], NDArray[Any]]:
    def change(depth: NDArray[np.float32]) -> NDArray[Any]:
        depth[where] = depth[where] * np.float32(factor)
        return depth

    return change


def shifted(down: int, right: int) -> Callable[[NDArray[Any]], NDArray[Any]]:
    """All but row 0."""

    def change(pixels: NDArray[Any]) -> NDArray[Any]:
        moved = np.roll(pixels, (down, right), axis=(0, 1))
        moved[0] = pixels[0]
        return moved

    return change


def below_row_0(function: Callable[[NDArray[Any]], NDArray[Any]]) -> Callable[[NDArray[Any]], NDArray[Any]]:
    def change(pixels: NDArray[Any]) -> NDArray[Any]:
        changed = np.array(function(pixels.copy()))
        changed[0] = pixels[0]
        return changed

    return change


def random_pixels(image: NDArray[np.uint8], rows: slice = slice(1, None)) -> NDArray[np.uint8]:
    image[rows] = np.random.default_rng(RNG).integers(0, 256, image.shape, dtype=np.uint8)[rows]
    return image


def rays(depth: NDArray[np.float32]) -> NDArray[Any]:
    """Distance along the ray; the focal length of the dataset is 150 px."""
    y, x = np.mgrid[: depth.shape[0], : depth.shape[1]]
    centre = (np.array(depth.shape) - 1) / 2
    return depth * np.sqrt(1 + ((x - centre[1]) / 150) ** 2 + ((y - centre[0]) / 150) ** 2)


def bgr(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(image[..., ::-1])


def grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def brightened(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.clip(image * 1.25, 0, 255).astype(np.uint8)
