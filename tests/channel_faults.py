"""Faults planted in the channels of the dataset of test_channels.py, each with the words that must name it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from attack.planting import Plant, cell, copied, drop, exchanged, manifest_of, put, table_of
from numpy.typing import NDArray

from rsbench.core import so3
from rsbench.dataset.channels import AFFINE, MATCHER, TRACKS, matches_file
from rsbench.dataset.point_channels import AffineFrames, Arranged, MatchClass, Matching, jacobians_of, labelled
from rsbench.dataset.sequence import read_sequence
from rsbench.dataset.views import NUMBER, PixelClass
from rsbench.renderers.image import to_srgb8
from rsbench.storage.files import read_exr, read_grey_png, read_png, save_arrays, write_exr, write_png, write_png16
from rsbench.storage.untrusted_files import load_arrays

Arrays = dict[str, NDArray[Any]]
Change = Callable[[Any], Any]
Fault = tuple[Plant, tuple[str, ...]]
"""What plants it into the folder of a sequence, and the words that one line of verify's answer must hold."""


def values_of(file: str, change: Change) -> Plant:
    """``change`` takes and gives the channels (H, W, n) of an EXR file."""
    kind = file.partition("/")[0]
    names = "Z" if kind.endswith("depth") else {"disparity": "d", "normals": "xyz", "hdr": "RGB"}.get(kind, "xy")

    def plant(folder: Path) -> None:
        values = change(read_exr(folder / file, tuple(names), half=kind == "hdr"))
        write_exr(folder / file, {name: values[..., k] for k, name in enumerate(names)}, half=kind == "hdr")

    return plant


def mask_of(file: str, change: Change) -> Plant:
    """``change`` takes and gives the pixels (H, W) of a grey PNG file."""

    def plant(folder: Path) -> None:
        if file.startswith("instances"):
            write_png16(folder / file, change(read_grey_png(folder / file, bits=16)).astype(np.uint16))
        else:
            write_png(folder / file, np.ascontiguousarray(change(read_grey_png(folder / file)), dtype=np.uint8))

    return plant


def image_of(file: str, change: Change) -> Plant:
    """``change`` takes and gives the pixels (H, W, 3) of a PNG file."""
    return lambda folder: write_png(folder / file, np.ascontiguousarray(change(read_png(folder / file))))


def arrays_of(file: str, change: Callable[[Arrays], object]) -> Plant:
    """``change`` may change the arrays in their places, or replace them in the table."""

    def plant(folder: Path) -> None:
        arrays = {name: values.copy() for name, values in load_arrays(folder / file).items()}
        change(arrays)
        save_arrays(folder / file, arrays)

    return plant


def fault(file: str, change: Change, *words: str) -> Fault:
    """A fault in the content of one file, whose suffix chooses how it is read and written."""
    kinds = {".exr": values_of, ".png": mask_of, ".npz": arrays_of, ".json": manifest_of, ".csv": table_of}
    return kinds[Path(file).suffix](file, change), (file, *words)


def copy_of(source: str, target: str, *words: str) -> Fault:
    """A file with the content of another one."""
    return copied(source, target), (target, *words)


def array(name: str, change: Change) -> Callable[[Arrays], object]:
    """One of the arrays of an npz file."""
    return lambda arrays: arrays.update({name: change(arrays[name])})


def one_view(k: int, change: Change) -> Change:
    def of(values: NDArray[Any]) -> NDArray[Any]:
        values[:, k] = change(values[:, k])
        return values

    return of


def classes(old: int, new: int, name: str = "classes") -> Change:
    """All of one class become those of another."""
    return lambda values: np.where(values == old, new, values).astype(np.uint8)


def swapped_numbers(numbers: NDArray[Any]) -> NDArray[Any]:
    """1 and 2 exchanged."""
    return np.where(numbers == 1, 2, np.where(numbers == 2, 1, numbers))


def other_object(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Labels of two objects with their numbers exchanged."""
    return np.where((labels & NUMBER) > 0, labels ^ 3, labels).astype(np.uint8)


def one_row(values: NDArray[np.float32]) -> NDArray[np.float32]:
    values[30] += np.float32(0.01)
    return values


def scaled(factor: float) -> Change:
    return lambda values: values * np.float32(factor)


def perfect(arrays: Arrays) -> None:
    """Every match moved to its true place, with matching labels: what no check of the labels alone can see."""
    seen = np.isfinite(arrays["error"])
    arrays["pixels"][seen, 1], arrays["error"][seen] = arrays["truth"][seen], 0.0
    wrong = seen & (arrays["classes"] == MatchClass.WRONG)
    arrays["classes"][wrong] = MatchClass.RIGHT


def without_points(arrays: Arrays) -> None:
    arrays.update({name: values[:0] for name, values in arrays.items()})


class Depths:
    """Rays that meet their given targets, one pair of frames after the other, and nothing before it."""

    def __init__(self, depth: NDArray[np.float64]) -> None:
        self.left = np.where(depth > 0, depth, np.inf)

    def share(self, eyes: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
        met, self.left = self.left[: len(eyes)], self.left[len(eyes) :]
        return met

    def blocked(self, eyes: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.zeros(len(eyes), dtype=np.bool_)


def farther(folder: Path) -> None:
    """Keypoints that see what is a tenth farther away, with all that follows from it."""
    arrays = load_arrays(folder / MATCHES)
    found, rays = Arranged(*(arrays[name] for name in Arranged._fields)), Depths(1.1 * arrays["depth"])
    labelled(read_sequence(folder), 0, found, Matching().bound_px, rays).save(folder / MATCHES)


def on_another_plane(folder: Path) -> None:
    """All normals turned by 20 degrees, and derivatives of these planes."""
    sequence, normals = read_sequence(folder), load_arrays(folder / AFFINE)["normals"]
    turned = normals @ so3.exp(np.array([0.35, 0.0, 0.0]))
    made = AffineFrames(jacobians=jacobians_of(sequence, sequence.tracks(), turned), normals=turned)
    made.save(folder / AFFINE)


MATCHES = matches_file(0)
SKY, VISIBLE, OCCLUDED = PixelClass.SKY, PixelClass.VISIBLE, PixelClass.OCCLUDED
_SURFACE, _HIDDEN = "wrongly sky or surface", "marked hidden, but visible according to"

FAULTS: dict[str, Fault] = {
    "disparity scaled": fault("disparity/left_0.exr", scaled(1.001), "scaled by 1.001"),
    "disparity negated": fault("disparity/right_1.exr", np.negative, "looks negated"),
    "disparity of frames exchanged": (
        exchanged(("disparity/left_0.exr", "disparity/left_1.exr")),
        ("disparity/left_0.exr", "differ"),
    ),
    "disparity mask: all that is hidden is visible": fault(
        "disparity_mask/left_0.png", classes(OCCLUDED, VISIBLE), "new computation"
    ),
    "flow x and y exchanged": fault("flow/left_0.exr", lambda flow: flow[..., ::-1], "x and y exchanged"),
    "flow shifted by one row": fault(
        "flow/right_0.exr", lambda flow: np.roll(flow, 1, axis=0), "shifted by one row"
    ),
    "flow of one row off by 0.01 px": fault("flow/left_1.exr", one_row, "row 30"),
    "flow of the other camera": copy_of("flow/left_0.exr", "flow/right_0.exr", "the same as flow/left_0.exr"),
    "flow mask upside down": fault("flow_mask/left_0.png", np.flipud, _SURFACE),
    "flow mask: sky is surface": fault("flow_mask/right_1.png", classes(SKY, VISIBLE), _SURFACE),
    "flow mask: nothing is out of view": fault(
        "flow_mask/left_1.png", classes(PixelClass.OUT_OF_VIEW, PixelClass.UNSOLVED), "not solved"
    ),
    "disparity mask: sky is no class": fault("disparity_mask/right_0.png", classes(SKY, 9), "holds 9: "),
    "normals negated": fault("normals/left_0.exr", np.negative, "point away from the camera"),
    "normals with y and z exchanged": fault("normals/left_1.exr", lambda n: n[..., [0, 2, 1]], "flat pixels"),
    "normals scaled": fault("normals/right_0.exr", scaled(0.9)),
    "normals upside down": fault("normals/right_1.exr", np.flipud, "length"),
    "instances of the other camera": copy_of("instances/left_0.png", "instances/right_0.png", "no depth"),
    "instances exchanged": fault(
        "instances/left_1.png", swapped_numbers, "another instance than instances/right_1.png"
    ),
    "an instance that the table lacks": fault(
        "instances/right_1.png", lambda numbers: np.where(numbers == 1, 99, numbers), "holds instance 99"
    ),
    "a table of instances without materials": fault(
        "instances.json", drop("instances", 0, "material"), "name and material"
    ),
    "timing of another readout": fault(
        "timing.json", put("left", "readout_ns", 8e7), "left.readout_ns = 80000000.0"
    ),
    "timing without a camera": fault("timing.json", drop("right"), "right = None"),
    "one row timed late": fault("timing/left_1.csv", cell(21, 1, "137500002"), "row 20"),
    "exposure too short": fault("timing/right_0.csv", cell(8, 3, "15124000"), "exposure_end_ns"),
    "timing of frames exchanged": (
        exchanged(("timing/left_0.csv", "timing/left_1.csv")),
        ("timing/left_0.csv", "those of frame 1"),
    ),
    "a word for a time": fault("timing/left_0.csv", cell(4, 1, "soon"), "not a table"),
    "correction flow zeroed": fault("gs_flow/left_0.exr", scaled(0.0), "zeroed"),
    "correction flow of half the shutter": fault("gs_flow/left_1.exr", scaled(0.5), "scaled by 0.5"),
    "correction flow without values": fault("gs_flow/right_0.exr", scaled(np.nan), "without a value"),
    "correction mask: visible and hidden exchanged": fault(
        "gs_flow_mask/right_1.png", swapped_numbers, f"{_HIDDEN} gs_depth/right_1.exr"
    ),
    "affine frames transposed": fault(
        AFFINE, array("jacobians", lambda J: np.swapaxes(J, 2, 3)), "left_1", "looks transposed"
    ),
    "affine frames stretched": fault(
        AFFINE,
        array("jacobians", lambda J: J @ np.diag([1.0, 1.01])),
        *("right_1", "not those of plane, motion and row times"),
    ),
    "affine frames on another plane": (on_another_plane, (AFFINE, "left_0", "not perpendicular to the surface")),
    "matches moved by half a pixel": fault(
        MATCHES, array("pixels", lambda pixels: pixels + 0.5), "left", "not those of the point in their row"
    ),
    "matches without errors": fault(
        MATCHES, array("error", lambda error: 0.1 * error), "stereo_0", "not the distance from the true pixel"
    ),
    "matches: all that is seen is right": fault(
        MATCHES, array("classes", classes(5, 1)), "do not follow from error and depth, with a bound of 3 px"
    ),
    "matches: all is hidden": fault(
        MATCHES, array("classes", classes(1, 2)), f"are {_HIDDEN} rs_depth/left_1.exr"
    ),
    "matches that nobody found, all of them right": fault(MATCHES, perfect, "are not found in the images"),
    "matches of surfaces that are farther away": (
        farther,
        (MATCHES, "stereo_0", "keypoints is not that of rs_depth/left_0.exr"),
    ),
    "another bound of matches": fault(MATCHER, put("bound_px", 9.0), "bound_px = 9.0"),
    "radiance scaled": fault("hdr/left_0.exr", lambda light: 1.05 * light, "scaled by 1.05"),
    "radiance in other colours": fault(
        "hdr/right_0.exr", lambda light: light[..., ::-1], "red and blue exchanged"
    ),
    "radiance upside down": fault("hdr/left_1.exr", np.flipud, "upside down"),
    "radiance of codes": fault(
        "hdr/right_1.exr", lambda light: to_srgb8(light, 0.8) / (0.8 * 255), "encoded as sRGB"
    ),
    "radiance that is not finite": fault("hdr/right_1.exr", lambda light: light * np.inf, "finite"),
    "points scaled": fault(TRACKS, array("points", lambda X: 1.001 * X), "left_0", "scaled by 1.001"),
    "pixels of one frame moved by 0.1 px": fault(
        TRACKS,
        array("pixels", one_view(3, lambda pixels: pixels + 0.1)),
        *("right_1", "not at the pixel in their row"),
    ),
    "frames of tracks exchanged": fault(
        TRACKS, array("pixels", lambda pixels: pixels[:, [2, 1, 0, 3]]), "left_0", "points"
    ),
    "tracks of another time": fault(
        TRACKS, array("tau", one_view(2, lambda tau: tau - 1.0)), "left_1", "another time than their row"
    ),
    "tracks: nothing is hidden": fault(
        TRACKS, array("classes", classes(2, 1)), "are marked visible, but hidden according to"
    ),
    "tracks: all is hidden": fault(TRACKS, array("classes", classes(1, 2)), f"are {_HIDDEN}"),
    "tracks without points": fault(TRACKS, without_points, "has no points"),
    "tracks in float32": fault(
        TRACKS, array("pixels", lambda pixels: pixels.astype(np.float32)), "pixels is float32"
    ),
    "a twin at the pose of another row": copy_of(
        "gs_twin/0047/left_0.png", "gs_twin/0024/left_0.png", "row 24 differs from rs_clean/left_0.png"
    ),
    "a twin that is the first one": copy_of(
        "gs_depth/right_1.exr", "gs_twin_depth/0024/right_1.exr", "row 24 differs"
    ),
    "depth of a twin scaled": fault("gs_twin_depth/0024/left_1.exr", scaled(1.001), "scaled by 1.001"),
    "correction flow of another twin": copy_of(
        "gs_twin_flow/0024/left_0.exr", "gs_twin_flow/0047/left_0.exr", "differ from what depth and motion make"
    ),
    "a twin's mask: all is hidden": fault(
        "gs_twin_flow_mask/0047/right_0.png",
        classes(VISIBLE, OCCLUDED),
        f"{_HIDDEN} gs_twin_depth/0047/right_0.exr",
    ),
    "a twin that is not there": (
        lambda folder: (folder / "gs_twin/0024/left_0.png").unlink(),
        ("gs_twin/0024/left_0.png", "does not list"),
    ),
}
