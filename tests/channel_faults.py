"""Faults planted in the channels of the dataset of test_channels.py, each with the words that must name it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from attack.planting import drop, manifest_of, put
from numpy.typing import NDArray

from rsbench.core import so3
from rsbench.dataset.channels import AFFINE, MATCHER, TRACKS, matches_file
from rsbench.dataset.matches import Arranged, MatchClass, Matching, labelled
from rsbench.dataset.sequence import read_sequence
from rsbench.dataset.tracks import AffineFrames, jacobians_of
from rsbench.dataset.views import NUMBER, PixelClass
from rsbench.renderers.image import to_srgb8
from rsbench.storage.files import (
    read_depth,
    read_exr,
    read_grey_png,
    read_png,
    save_arrays,
    write_depth,
    write_exr,
    write_png,
    write_png16,
)
from rsbench.storage.untrusted_files import load_arrays


def values_of(file: str, change: Callable[[NDArray[np.float32]], NDArray[np.float32]]) -> Callable[[Path], None]:
    def plant(folder: Path) -> None:
        names = ("d",) if file.startswith("disparity") else ("x", "y")
        changed = change(read_exr(folder / file, names))
        write_exr(folder / file, {name: changed[..., k] for k, name in enumerate(names)})

    return plant


def normals_of(view: str, change: Callable[[NDArray[np.float32]], NDArray[np.float32]]) -> Callable[[Path], None]:
    def plant(folder: Path) -> None:
        changed = change(read_exr(folder / f"normals/{view}.exr", ("x", "y", "z")))
        write_exr(folder / f"normals/{view}.exr", {name: changed[..., k] for k, name in enumerate("xyz")})

    return plant


def instances_of(view: str, change: Callable[[NDArray[np.uint16]], NDArray[np.uint16]]) -> Callable[[Path], None]:
    def plant(folder: Path) -> None:
        path = folder / f"instances/{view}.png"
        write_png16(path, change(read_grey_png(path, bits=16)).astype(np.uint16))

    return plant


def mask_of(file: str, change: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]) -> Callable[[Path], None]:
    def plant(folder: Path) -> None:
        write_png(folder / file, np.ascontiguousarray(change(read_grey_png(folder / file))))

    return plant


def image_of(file: str, change: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]) -> Callable[[Path], None]:
    return lambda folder: write_png(folder / file, np.ascontiguousarray(change(read_png(folder / file))))


def exchanged(*files: str) -> Callable[[Path], None]:
    """The first file with the second, the third with the fourth, ..."""

    def plant(folder: Path) -> None:
        for one, other in zip(files[::2], files[1::2], strict=True):
            kept = (folder / one).read_bytes()
            shutil.copyfile(folder / other, folder / one)
            (folder / other).write_bytes(kept)

    return plant


def other_object(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Labels of two objects with their numbers exchanged."""
    return np.where((labels & NUMBER) > 0, labels ^ 3, labels).astype(np.uint8)


def copied(one: str, other: str) -> Callable[[Path], None]:
    def plant(folder: Path) -> None:
        shutil.copyfile(folder / one, folder / other)

    return plant


def table_of(view: str, row: int, column: int, value: str) -> Callable[[Path], None]:
    def plant(folder: Path) -> None:
        path = folder / f"timing/{view}.csv"
        lines = [line.split(",") for line in path.read_text().splitlines()]
        lines[row + 1][column] = value
        path.write_text("\n".join(",".join(line) for line in lines) + "\n")

    return plant


def of_class(old: PixelClass, new: PixelClass) -> Callable[[NDArray[np.uint8]], NDArray[np.uint8]]:
    return lambda classes: np.where(classes == old, np.uint8(new), classes)


def one_row(values: NDArray[np.float32]) -> NDArray[np.float32]:
    values[30] += np.float32(0.01)
    return values


FAULTS: dict[str, tuple[Callable[[Path], None], tuple[str, ...]]] = {
    "disparity scaled": (
        values_of("disparity/left_0.exr", lambda values: values * np.float32(1.001)),
        ("disparity/left_0.exr", "scaled by 1.001"),
    ),
    "disparity negated": (
        values_of("disparity/right_1.exr", np.negative),
        ("disparity/right_1.exr", "looks negated"),
    ),
    "disparity of frames exchanged": (
        exchanged("disparity/left_0.exr", "disparity/left_1.exr"),
        ("disparity/left_0.exr", "differ"),
    ),
    "disparity mask: all that is hidden is visible": (
        mask_of("disparity_mask/left_0.png", of_class(PixelClass.OCCLUDED, PixelClass.VISIBLE)),
        ("disparity_mask/left_0.png", "new computation"),
    ),
    "flow x and y exchanged": (
        values_of("flow/left_0.exr", lambda values: values[..., ::-1]),
        ("flow/left_0.exr", "x and y exchanged"),
    ),
    "flow shifted by one row": (
        values_of("flow/right_0.exr", lambda values: np.roll(values, 1, axis=0)),
        ("flow/right_0.exr", "shifted by one row"),
    ),
    "flow of one row off by 0.01 px": (values_of("flow/left_1.exr", one_row), ("flow/left_1.exr", "row 30")),
    "flow of the other camera": (
        copied("flow/left_0.exr", "flow/right_0.exr"),
        ("flow/right_0.exr", "the same as flow/left_0.exr"),
    ),
    "flow mask upside down": (
        mask_of("flow_mask/left_0.png", np.flipud),
        ("flow_mask/left_0.png", "wrongly sky or surface"),
    ),
    "flow mask: sky is surface": (
        mask_of("flow_mask/right_1.png", of_class(PixelClass.SKY, PixelClass.VISIBLE)),
        ("flow_mask/right_1.png", "wrongly sky or surface"),
    ),
    "flow mask: nothing is out of view": (
        mask_of("flow_mask/left_1.png", of_class(PixelClass.OUT_OF_VIEW, PixelClass.UNSOLVED)),
        ("flow_mask/left_1.png", "not solved"),
    ),
    "normals negated": (
        normals_of("left_0", np.negative),
        ("normals/left_0.exr", "point away from the camera"),
    ),
    "normals with y and z exchanged": (
        normals_of("left_1", lambda normals: normals[..., [0, 2, 1]]),
        ("normals/left_1.exr", "flat pixels"),
    ),
    "normals scaled": (normals_of("right_0", lambda normals: normals * np.float32(0.9)), ("normals/right_0.exr",)),
    "normals upside down": (normals_of("right_1", np.flipud), ("normals/right_1.exr", "length")),
    "instances of the other camera": (
        copied("instances/left_0.png", "instances/right_0.png"),
        ("instances/right_0.png", "no depth"),
    ),
    "instances exchanged": (
        instances_of("left_1", lambda numbers: np.where(numbers == 1, 2, np.where(numbers == 2, 1, numbers))),
        ("instances/left_1.png", "another instance than instances/right_1.png"),
    ),
    "an instance that the table lacks": (
        instances_of("right_1", lambda numbers: np.where(numbers == 1, 99, numbers)),
        ("instances/right_1.png", "holds instance 99"),
    ),
    "a table of instances without materials": (
        manifest_of("instances.json", drop("instances", 0, "material")),
        ("instances.json", "name and material"),
    ),
    "timing of another readout": (
        manifest_of("timing.json", put("left", "readout_ns", 8e7)),
        ("timing.json", "left.readout_ns = 80000000.0"),
    ),
    "timing without a camera": (manifest_of("timing.json", drop("right")), ("timing.json", "right = None")),
    "one row timed late": (table_of("left_1", 20, 1, "137500002"), ("timing/left_1.csv", "row 20")),
    "exposure too short": (table_of("right_0", 7, 3, "15124000"), ("timing/right_0.csv", "exposure_end_ns")),
    "timing of frames exchanged": (
        exchanged("timing/left_0.csv", "timing/left_1.csv"),
        ("timing/left_0.csv", "those of frame 1"),
    ),
    "a word for a time": (table_of("left_0", 3, 1, "soon"), ("timing/left_0.csv", "not a table")),
    "correction flow zeroed": (
        values_of("gs_flow/left_0.exr", lambda values: values * 0),
        ("gs_flow/left_0.exr", "zeroed"),
    ),
    "correction flow of half the shutter": (
        values_of("gs_flow/left_1.exr", lambda values: values * np.float32(0.5)),
        ("gs_flow/left_1.exr", "scaled by 0.5"),
    ),
    "correction flow without values": (
        values_of("gs_flow/right_0.exr", lambda values: values * np.float32("nan")),
        ("gs_flow/right_0.exr", "without a value"),
    ),
    "correction mask: visible and hidden exchanged": (
        mask_of(
            "gs_flow_mask/right_1.png",
            lambda classes: np.where(classes == 1, 2, np.where(classes == 2, 1, classes)).astype(np.uint8),
        ),
        ("gs_flow_mask/right_1.png", "marked hidden, but visible according to gs_depth/right_1.exr"),
    ),
}


def depth_of(file: str, factor: float) -> Callable[[Path], None]:
    return lambda folder: write_depth(folder / file, read_depth(folder / file) * np.float32(factor))


def arrays_of(file: str, change: Callable[[dict[str, NDArray[Any]]], object]) -> Callable[[Path], None]:
    """``change`` may change the arrays in their places, or replace them in the table."""

    def plant(folder: Path) -> None:
        arrays = {name: values.copy() for name, values in load_arrays(folder / file).items()}
        change(arrays)
        save_arrays(folder / file, arrays)

    return plant


def tracks_of(name: str, change: Callable[[NDArray[Any]], NDArray[Any]]) -> Callable[[Path], None]:
    return arrays_of(TRACKS, lambda arrays: arrays.update({name: change(arrays[name])}))


def matches_of(name: str, change: Callable[[NDArray[Any]], NDArray[Any]]) -> Callable[[Path], None]:
    return arrays_of(_MATCHES, lambda arrays: arrays.update({name: change(arrays[name])}))


def perfect(arrays: dict[str, NDArray[Any]]) -> None:
    """Every match moved to its true place, with matching labels: what no check of the labels alone can see."""
    seen = np.isfinite(arrays["error"])
    arrays["pixels"][seen, 1], arrays["error"][seen] = arrays["truth"][seen], 0.0
    wrong = seen & (arrays["classes"] == MatchClass.WRONG)
    arrays["classes"][wrong] = MatchClass.RIGHT


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
    arrays = load_arrays(folder / _MATCHES)
    found, rays = Arranged(*(arrays[name] for name in Arranged._fields)), Depths(1.1 * arrays["depth"])
    labelled(read_sequence(folder), 0, found, Matching().bound_px, rays).save(folder / _MATCHES)


def one_view(k: int, change: Callable[[NDArray[Any]], NDArray[Any]]) -> Callable[[NDArray[Any]], NDArray[Any]]:
    def of(values: NDArray[Any]) -> NDArray[Any]:
        values[:, k] = change(values[:, k])
        return values

    return of


def radiance_of(view: str, change: Callable[[NDArray[np.float32]], NDArray[Any]]) -> Callable[[Path], None]:
    def plant(folder: Path) -> None:
        changed = change(read_exr(folder / f"hdr/{view}.exr", ("R", "G", "B"), half=True))
        write_exr(folder / f"hdr/{view}.exr", {name: changed[..., k] for k, name in enumerate("RGB")}, half=True)

    return plant


_MATCHES = matches_file(0)


def affine_of(name: str, change: Callable[[NDArray[Any]], NDArray[Any]]) -> Callable[[Path], None]:
    return arrays_of(AFFINE, lambda arrays: arrays.update({name: change(arrays[name])}))


def on_another_plane(folder: Path) -> None:
    """All normals turned by 20 degrees, and derivatives of these planes."""
    sequence, normals = read_sequence(folder), load_arrays(folder / AFFINE)["normals"]
    turned = normals @ so3.exp(np.array([0.35, 0.0, 0.0]))
    made = AffineFrames(jacobians=jacobians_of(sequence, sequence.tracks(), turned), normals=turned)
    made.save(folder / AFFINE)


FAULTS |= {
    "affine frames transposed": (
        affine_of("jacobians", lambda J: np.swapaxes(J, 2, 3)),
        (AFFINE, "left_1", "looks transposed"),
    ),
    "affine frames stretched": (
        affine_of("jacobians", lambda J: J @ np.diag([1.0, 1.01])),
        (AFFINE, "right_1", "not those of plane, motion and row times"),
    ),
    "affine frames on another plane": (on_another_plane, (AFFINE, "left_0", "not perpendicular to the surface")),
    "matches moved by half a pixel": (
        matches_of("pixels", lambda pixels: pixels + 0.5),
        (_MATCHES, "left", "not those of the point in their row"),
    ),
    "matches without errors": (
        matches_of("error", lambda error: 0.1 * error),
        (_MATCHES, "stereo_0", "not the distance from the true pixel"),
    ),
    "matches: all that is seen is right": (
        matches_of("classes", lambda classes: np.where(classes == 5, 1, classes).astype(np.uint8)),
        (_MATCHES, "do not follow from error and depth, with a bound of 3 px"),
    ),
    "matches: all is hidden": (
        matches_of("classes", lambda classes: np.where(classes == 1, 2, classes).astype(np.uint8)),
        (_MATCHES, "are marked hidden, but visible according to rs_depth/left_1.exr"),
    ),
    "matches that nobody found, all of them right": (
        arrays_of(_MATCHES, perfect),
        (_MATCHES, "are not found in the images"),
    ),
    "matches of surfaces that are farther away": (
        farther,
        (_MATCHES, "stereo_0", "keypoints is not that of rs_depth/left_0.exr"),
    ),
    "another bound of matches": (manifest_of(MATCHER, put("bound_px", 9.0)), (MATCHER, "bound_px = 9.0")),
    "radiance scaled": (radiance_of("left_0", lambda light: 1.05 * light), ("hdr/left_0.exr", "scaled by 1.05")),
    "radiance in other colours": (
        radiance_of("right_0", lambda light: light[..., ::-1]),
        ("hdr/right_0.exr", "red and blue exchanged"),
    ),
    "radiance upside down": (radiance_of("left_1", np.flipud), ("hdr/left_1.exr", "upside down")),
    "radiance of codes": (
        radiance_of("right_1", lambda light: to_srgb8(light, 0.8) / (0.8 * 255)),
        ("hdr/right_1.exr", "encoded as sRGB"),
    ),
    "radiance that is not finite": (
        radiance_of("right_1", lambda light: light * np.inf),
        ("hdr/right_1.exr", "finite"),
    ),
    "points scaled": (tracks_of("points", lambda X: 1.001 * X), (TRACKS, "left_0", "scaled by 1.001")),
    "pixels of one frame moved by 0.1 px": (
        tracks_of("pixels", one_view(3, lambda pixels: pixels + 0.1)),
        (TRACKS, "right_1", "not at the pixel in their row"),
    ),
    "frames of tracks exchanged": (
        tracks_of("pixels", lambda pixels: pixels[:, [2, 1, 0, 3]]),
        (TRACKS, "left_0", "points"),
    ),
    "tracks of another time": (
        tracks_of("tau", one_view(2, lambda tau: tau - 1.0)),
        (TRACKS, "left_1", "another time than their row"),
    ),
    "tracks: nothing is hidden": (
        tracks_of("classes", lambda classes: np.where(classes == 2, 1, classes).astype(np.uint8)),
        (TRACKS, "are marked visible, but hidden according to"),
    ),
    "tracks: all is hidden": (
        tracks_of("classes", lambda classes: np.where(classes == 1, 2, classes).astype(np.uint8)),
        (TRACKS, "are marked hidden, but visible according to"),
    ),
    "tracks without points": (
        lambda folder: save_arrays(
            folder / TRACKS, {name: values[:0] for name, values in load_arrays(folder / TRACKS).items()}
        ),
        (TRACKS, "has no points"),
    ),
    "tracks in float32": (
        tracks_of("pixels", lambda pixels: pixels.astype(np.float32)),
        (TRACKS, "pixels is float32"),
    ),
    "a twin at the pose of another row": (
        copied("gs_twin/0047/left_0.png", "gs_twin/0024/left_0.png"),
        ("gs_twin/0024/left_0.png", "row 24 differs from rs_clean/left_0.png"),
    ),
    "a twin that is the first one": (
        copied("gs_depth/right_1.exr", "gs_twin_depth/0024/right_1.exr"),
        ("gs_twin_depth/0024/right_1.exr", "row 24 differs"),
    ),
    "depth of a twin scaled": (
        depth_of("gs_twin_depth/0024/left_1.exr", 1.001),
        ("gs_twin_depth/0024/left_1.exr", "scaled by 1.001"),
    ),
    "correction flow of another twin": (
        copied("gs_twin_flow/0024/left_0.exr", "gs_twin_flow/0047/left_0.exr"),
        ("gs_twin_flow/0047/left_0.exr", "differ from what depth and motion make"),
    ),
    "a twin's mask: all is hidden": (
        mask_of("gs_twin_flow_mask/0047/right_0.png", of_class(PixelClass.VISIBLE, PixelClass.OCCLUDED)),
        (
            "gs_twin_flow_mask/0047/right_0.png",
            "marked hidden, but visible according to gs_twin_depth/0047/right_0.exr",
        ),
    ),
    "a twin that is not there": (
        lambda folder: (folder / "gs_twin/0024/left_0.png").unlink(),
        ("gs_twin/0024/left_0.png", "does not list"),
    ),
}
