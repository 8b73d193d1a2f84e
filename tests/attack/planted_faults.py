"""Faults planted into a copy of a sound dataset, each alone and with hashes made to fit: verify must name each.

The fast sample of the test command and the long run of ``attack.verifying`` take the same table, ``FAULTS``. The
dataset is that of cards/datasets/smoke.toml, with the sequences "castle" and "room-twist".
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from attack.planting import (
    OTHER,
    RNG,
    VICTIM,
    Fault,
    Plant,
    below_row_0,
    bgr,
    brightened,
    cell,
    copied,
    depth_of,
    drop,
    grey,
    holed,
    image_of,
    manifest_of,
    noised,
    other_geometry,
    poses_of,
    put,
    random_pixels,
    rays,
    removed,
    renumbered,
    rows_scaled,
    shifted,
    swapped,
    times,
    written,
)
from attack.wet_castle import WET_CASTLE
from rsbench.components.cards import load_card
from rsbench.components.motion_models import TwistMotion
from rsbench.core.projection import row_poses
from rsbench.core.rig import VIEWS
from rsbench.dataset.sequence import Sequence, read_sequence
from rsbench.renderers.options import RendererOptions
from rsbench.scenes.load import load_scene
from rsbench.storage.files import sha256, write_depth, write_png


def depth_faults() -> Iterator[Fault]:
    for shutter, view in (("rs", "left_0"), ("rs", "right_1"), ("gs", "left_1"), ("gs", "right_0")):
        file = f"{shutter}_depth/{view}.exr"

        def fault(
            name: str,
            change: Callable[[Any], Any],
            *words: str,
            shutter: str = shutter,
            view: str = view,
            file: str = file,
        ) -> Fault:
            return Fault(f"{file} {name}", depth_of(shutter, view, change), (file, *words))

        yield fault("scaled by 1.0002", times(1.0002), "scaled by 1.000")
        yield fault("scaled by 1.02", times(1.02), "scaled by 1.0")
        yield fault("scaled by 1.0002 below row 0", times(1.0002, slice(1, None)), "scaled by 1.000")
        yield fault("zeroed", lambda depth: depth * 0, "zeroed")
        yield fault("zeroed below row 0", times(0.0, slice(1, None)), "others see a surface")
        yield fault("holed", holed, "others see a surface", "rows 5")
        yield fault("noise of 1e-3", noised(1e-3), "noise")
        yield fault("noise of 1e-2 in rows 40 to 59", noised(1e-2, slice(40, 60)), "rows 4")
        yield fault("shifted by a row", shifted(1, 0), "shifted by 1 row")
        yield fault("shifted by a pixel", shifted(0, 1), "shifted by 1 column")
        yield fault("upside down", below_row_0(np.flipud), "upside down")
        yield fault("left to right", below_row_0(np.fliplr), "left to right")
        yield fault("along the ray", below_row_0(rays), "along the ray")
    rs, gs = "rs_depth/left_0.exr", "gs_depth/left_0.exr"
    for name, change in (
        ("NaN", lambda depth: np.where(np.arange(len(depth))[:, None] == 20, np.nan, depth)),
        ("negative", lambda depth: -depth),
        ("infinite", lambda depth: np.where(depth == 0, np.inf, depth)),
    ):
        yield Fault(f"{gs} {name}", depth_of("gs", "left_0", change), (gs, "finite"))
    yield Fault("one row of 1.0005", depth_of("rs", "left_0", times(1.0005, slice(30, 31))), (rs, "row 30"))
    yield Fault(
        "patch of 1.001", depth_of("gs", "left_0", times(1.001, slice(60, 80), slice(40, 64))), (gs, "rows 6")
    )
    yield Fault("GS depth is RS depth", copied(f"{VICTIM}/{rs}", f"{VICTIM}/{gs}"), (gs, f"the same as {rs}"))
    yield Fault("RS depth is GS depth", copied(f"{VICTIM}/{gs}", f"{VICTIM}/{rs}"), (rs, f"the same as {gs}"))
    yield Fault("RS and GS depth exchanged", swapped((rs, gs)), ("depth/left_0.exr", "looks like"))
    yield Fault(
        "depth left and right exchanged",
        swapped((rs, "rs_depth/right_0.exr")),
        (rs, "looks like rs_depth/right_0.exr"),
    )
    yield Fault(
        "depth of frames exchanged", swapped((gs, "gs_depth/left_1.exr")), (gs, "looks like gs_depth/left_1.exr")
    )
    yield Fault("depth of another sequence", copied(f"{OTHER}/{rs}", f"{VICTIM}/{rs}"), (rs, "differs"))
    for row in (48, 95):
        words = ("gs_depth/left_1.exr", f"global shutter at the pose of line {row}")
        yield Fault(f"twin at the pose of row {row}", twin_at(row), words, slow=True)
    yield Fault("every depth scaled by 1.02", every_depth(times(1.02)), ("depth/",))
    words = ("depth/", "scaled by 1.0002")
    yield Fault("every depth scaled by 1.0002", every_depth(times(1.0002)), words, rendered=True)
    yield Fault("noise in every depth", every_depth(noised(1e-3, slice(None))), ("depth/", "can be compared"))


@lru_cache(maxsize=1)
def scene_of_victim(name: str = VICTIM) -> Any:
    from rsbench.renderers.scene import MitsubaScene

    scene = load_scene(name)
    return MitsubaScene(scene.seen_from(scene.viewpoints["default"]))


def rendered_as(
    change: Callable[[Sequence], Sequence], shutter: str, view: tuple[Any, int], line: int | None = None
) -> Plant:
    """Image and depth of one view as another rig, shutter or motion makes them; a twin at the pose of a line."""

    def plant(folder: Path) -> None:
        from rsbench.renderers.image import to_srgb8
        from rsbench.renderers.render import LinePoses, render

        home, (side, frame) = folder / VICTIM, view
        sequence = change(read_sequence(home))
        R, t = row_poses(sequence.rig, sequence.shutter, sequence.motion, side, frame)
        if shutter == "gs":
            at = sequence.shutter.first_line(side) if line is None else line
            R, t = np.broadcast_to(R[at], R.shape), np.broadcast_to(t[at], t.shape)
        options, name = load_card(RendererOptions, "renderers", "preview"), sequence.manifest["scene"]["name"]
        scene = scene_of_victim(str(WET_CASTLE) if name == "wet-castle" else name)
        poses = LinePoses(R, t, columns=sequence.shutter.axis(side) == 0)
        seen = render(scene, sequence.rig.sensor(side), poses, options)
        write_png(home / shutter / f"{side}_{frame}.png", to_srgb8(seen.image, options.exposure))
        write_depth(home / f"{shutter}_depth" / f"{side}_{frame}.exr", seen.depth)

    return plant


def twin_at(line: int) -> Plant:
    """The global-shutter twin, image and depth, at the pose of another line."""
    return rendered_as(lambda sequence: sequence, "gs", ("left", 1), line)


def every_depth(change: Callable[[Any], Any]) -> Plant:
    def plant(folder: Path) -> None:
        for shutter in ("rs", "gs"):
            for side, frame in VIEWS:
                depth_of(shutter, f"{side}_{frame}", change)(folder)

    return plant


def image_faults() -> Iterator[Fault]:
    for shutter, view in (("rs", "right_0"), ("gs", "left_1")):
        file = f"{shutter}/{view}.png"
        for name, change, words in (
            ("channels exchanged", bgr, "channels exchanged"),
            ("channels exchanged below row 0", below_row_0(bgr), "channels exchanged"),
            ("channels turned", lambda image: np.roll(image, 1, axis=2), "channels exchanged"),
            ("left to right", below_row_0(np.fliplr), "left to right"),
            ("upside down", below_row_0(np.flipud), "upside down"),
            ("turned", below_row_0(lambda image: np.rot90(image, 2)), "turned"),
            ("shifted by a row", shifted(1, 0), "shifted by one row"),
            ("shifted by a row upwards", shifted(-1, 0), "shifted by one row"),
            ("shifted by a pixel", shifted(0, 1), "shifted by one column"),
            ("noise", random_pixels, "noise"),
            ("noise in rows 40 to 63", lambda image: random_pixels(image, slice(40, 64)), "rows 4"),
            ("black", lambda image: image * 0, "black"),
            ("black below row 0", below_row_0(lambda image: image * 0), "other colours"),
            ("one colour", lambda image: image * 0 + np.uint8(120), "of one colour"),
            ("brightened", below_row_0(brightened), "times as bright"),
            ("16 bits", lambda image: image[..., ::-1].astype(np.uint16) * 257, "RGB of 16 bits"),
            ("grey", grey, "is grey of 8 bits"),
            (
                "grey in three channels",
                lambda image: np.repeat(grey(image)[..., None], 3, axis=2),
                "image is grey",
            ),
            ("RGBA", lambda image: cv2.cvtColor(image, cv2.COLOR_RGB2BGRA), "is RGBA of 8 bits"),
            ("cut", lambda image: image[:-1].copy(), "pixels, the camera"),
        ):
            yield Fault(f"{file} {name}", image_of(shutter, view, change), (file, words))
    yield Fault("patch of noise", image_of("rs", "left_1", _noisy_patch), ("rs/left_1.png", "colours"))
    for name, one, other in (
        ("left and right", "rs/left_0.png", "rs/right_0.png"),
        ("frames", "rs/left_0.png", "rs/left_1.png"),
        ("shutters", "rs/right_1.png", "gs/right_1.png"),
        ("GS left and right", "gs/left_0.png", "gs/right_0.png"),
        ("GS frames", "gs/right_0.png", "gs/right_1.png"),
        ("cameras and frames", "rs/left_0.png", "rs/right_1.png"),
    ):
        yield Fault(f"images exchanged: {name}", swapped((one, other)), (one, f"looks like {other}"))
    sides = [(f"{s}/left_{k}.png", f"{s}/right_{k}.png") for s in ("rs", "gs") for k in (0, 1)]
    yield Fault("all left and right images exchanged", swapped(*sides), (".png", "other colours"))
    frames = [(f"{s}/{side}_0.png", f"{s}/{side}_1.png") for s in ("rs", "gs") for side in ("left", "right")]
    yield Fault("all frames exchanged", swapped(*frames), (".png", "other colours"))
    yield Fault(
        "GS image is RS image",
        copied(f"{VICTIM}/rs/left_0.png", f"{VICTIM}/gs/left_0.png"),
        ("gs/left_0.png", "the same as rs/left_0.png"),
    )
    for shutter in ("rs", "gs"):
        file = f"{shutter}/left_1.png"
        yield Fault(
            f"{shutter} image of another sequence",
            copied(f"{OTHER}/{file}", f"{VICTIM}/{file}"),
            (file, f"the same as {OTHER}/{file}"),
        )
    blurred = below_row_0(lambda image: cv2.GaussianBlur(image, (0, 0), 0.8))
    yield Fault("blurred", image_of("rs", "left_0", blurred), ("rs/left_0.png",), rendered=True)


def _noisy_patch(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    image[40:76, 40:90] = np.random.default_rng(RNG).integers(0, 256, (36, 50, 3), dtype=np.uint8)
    return image


def _pose_faults() -> Iterator[Fault]:
    file = "poses/left_0.csv"
    quaternion, place = slice(2, 6), slice(6, 9)
    for name, change, words in (
        ("zero quaternions", rows_scaled(quaternion, 0.0), "quaternion is zero"),
        ("one zero quaternion", rows_scaled(quaternion, 0.0, slice(8, 9)), "row 7: the quaternion is zero"),
        ("quaternions of norm 1.01", rows_scaled(quaternion, 1.01), "norm 1.01"),
        ("one quaternion of norm 2", rows_scaled(quaternion, 2.0, slice(8, 9)), "row 7"),
        ("negated quaternions", rows_scaled(quaternion, -1.0), "w >= 0"),
        ("one negated quaternion", rows_scaled(quaternion, -1.0, slice(96, 97)), "row 95"),
        ("millimetres", rows_scaled(place, 1000.0), "differs from the motion"),
        ("one place off by 1e-9 m", rows_scaled(place, 1 + 1e-8, slice(50, 51)), "row 49"),
        ("late times", rows_scaled(slice(1, 2), 1.01), "periods"),
        ("NaN in a quaternion", cell(9, 3, "nan"), "finite numbers"),
        ("NaN in a place", cell(9, 8, "nan"), "finite numbers"),
        ("infinite time", cell(9, 1, "inf"), "finite numbers"),
        ("empty cell", cell(9, 4, ""), "not a table of numbers"),
        ("a word", cell(9, 4, "abc"), "not a table of numbers"),
        ("last row cut", lambda lines: lines[:-1], "has 95 rows"),
        ("one row too many", lambda lines: [*lines, ["96", *lines[-1][1:]]], "has 97 rows"),
        ("shifted by a row", lambda lines: renumbered([lines[0], lines[1], *lines[1:-1]]), "shifted by one row"),
        ("rows upside down", lambda lines: renumbered([lines[0], *lines[:0:-1]]), "differs from the motion"),
        ("columns exchanged", lambda lines: [[*line[:6], line[7], line[6], line[8]] for line in lines], "columns"),
    ):
        yield Fault(f"{file} {name}", poses_of("left_0", change), ("left_0.csv", words))
    yield Fault("poses left and right exchanged", swapped((file, "poses/right_0.csv")), (file, "poses of right_0"))
    yield Fault("poses of frames exchanged", swapped((file, "poses/left_1.csv")), (file, "poses of left_1"))


def _manifest_faults() -> Iterator[Fault]:
    own = f"{VICTIM}/sequence.json"
    for key, value in (
        ("frame_period_s", 0.2),
        ("readout_time_s", 0.1),
        ("row_time_s", 0.001),
        ("name", "keep"),
        ("conventions", 2),
        ("format", True),
        ("baseline", 0.31),
        ("seed", 2),
        ("camera", {"width": 128, "height": 96, "fx": 151.0, "fy": 150.0, "cx": 63.5, "cy": 47.5}),
    ):
        yield Fault(f"{key} of sequence.json", manifest_of(own, put(key, value)), ("sequence.json", key))
    for key in ("conventions", "row_time_s", "scene", "renderer", "made_by", "seed"):
        yield Fault(f"{key} of sequence.json missing", manifest_of(own, drop(key)), ("sequence.json", key))
    for path in (("scene", "name"), ("scene", "viewpoint"), ("renderer", "integrator")):
        yield Fault(
            f"{'.'.join(path)} of sequence.json",
            manifest_of(own, put(*path, "x")),
            ("sequence.json", ".".join(path)),
        )
    yield Fault(
        "samples of sequence.json", manifest_of(own, put("renderer", "samples", 16)), ("renderer.samples = 16",)
    )
    motion = manifest_of(own, lambda content: content["motion"].update(w=[0.0, 0.01, 0.0]))
    yield Fault("motion of sequence.json", motion, ("poses/left_0.csv", "differs from the motion"))


def _consistent_faults() -> Iterator[Fault]:
    """Another truth in all places that state it: only the depth maps know better."""

    def everywhere(name: str, change: Callable[[Sequence], Sequence], *words: str) -> Fault:
        return Fault(f"another {name} everywhere", other_geometry(change), words)

    def readout(sequence: Sequence) -> Sequence:
        return replace(sequence, shutter=sequence.shutter.with_ratio(0.79))

    def baseline(sequence: Sequence) -> Sequence:
        return replace(sequence, rig=replace(sequence.rig, baseline=0.301))

    def focal(sequence: Sequence) -> Sequence:
        return replace(
            sequence, rig=replace(sequence.rig, camera=replace(sequence.rig.camera, fx=151.0, fy=151.0))
        )

    def twist(sequence: Sequence) -> Sequence:
        return replace(sequence, motion=TwistMotion(sequence.motion.w, sequence.motion.d))

    yield everywhere("readout ratio", readout, "rs_depth/", "depth")
    yield everywhere("baseline", baseline, "_depth/", "baseline")
    yield everywhere("focal length", focal, "_depth/", "depth")
    yield everywhere("motion model", twist, "_depth/", "depth")


def _dataset_faults() -> Iterator[Fault]:
    def dataset(name: str, change: Callable[[dict[str, Any]], object], *words: str, fit: bool = True) -> Fault:
        return Fault(
            f"dataset.json: {name}", manifest_of("dataset.json", change), ("dataset.json", *words), rehash=fit
        )

    yield dataset("another name", put("name", "other"), "name = 'other'")
    yield dataset("no name", drop("name"), "name = None")
    yield dataset("another description", put("description", "other"), "description")
    yield dataset("another format", put("format", 2), "format = 2")
    yield dataset("another licence", put("license", "CC0-1.0"), "license = 'CC0-1.0'")
    yield dataset("other units", put("units", "length", "mm"), "units")
    yield dataset("no card", drop("card"), "card")
    for name, path, words in (
        ("baseline", ("card", "baseline", 0.4), ("baseline = 0.3", "0.4")),
        ("focal length", ("card", "camera", "focal", 151.0), ("camera", "151")),
        ("readout ratio", ("card", "readout_ratio", 0.7), ("readout_ratio = 0.8", "0.7")),
        ("motion", ("card", "motion", "rotation_deg", 1.6), ("motion", "card")),
        ("seed", ("card", "seed", 2), ("seed = 1", "2")),
        ("frame period", ("card", "frame_period_s", 0.2), ("frame_period_s = 0.1", "0.2")),
        ("viewpoint", ("card", "sequence", 0, "viewpoint", "gate"), ("viewpoint", "gate")),
        ("scene", ("card", "sequence", 0, "scene", "old-town"), ("scene.name", "old-town")),
        ("renderer", ("card", "renderer", "default"), ("renderer.samples", "16")),
    ):
        yield Fault(f"card of another {name}", manifest_of("dataset.json", put(*path)), words)
    yield dataset("card with an unknown key", put("card", "basline", 1.0), "basline")
    yield dataset("card of another name", put("card", "name", "other"), "its card says 'other'")
    yield dataset(
        "card names another sequence", put("card", "sequence", 0, "name", "keep"), "its card makes", "keep"
    )
    yield dataset("card of one sequence", lambda content: content["card"]["sequence"].pop(), "its card makes")
    yield dataset("a sequence twice", lambda content: content["sequences"].append(VICTIM), "twice")
    yield dataset("no sequences", put("sequences", []), "a list of names")
    yield dataset("a sequence less", lambda content: content["sequences"].pop(), "none of its sequences")
    yield dataset("other order", lambda content: content["sequences"].reverse(), "its card makes")
    yield dataset("a path for a name", put("sequences", 0, f"../sound/{VICTIM}"), "not the name of a folder")
    yield dataset("a number for a name", put("sequences", 0, 3), "not the name of a folder")
    yield dataset("no files", put("files", {}), "not listed", fit=False)
    yield dataset("files as a list", put("files", []), "a table of paths", fit=False)
    file = f"{VICTIM}/rs/left_0.png"
    yield dataset("a file less", drop("files", file), "not listed", "rs/left_0.png", fit=False)
    yield dataset("a path outside", put("files", "../x.png", {"sha256": "", "size": 1}), "../x.png", fit=False)
    yield dataset("an entry without a size", drop("files", file, "size"), "size and sha256", fit=False)
    yield dataset("an entry of another type", put("files", file, 3), "size and sha256", fit=False)
    licence = manifest_of("croissant.json", put("license", "of another"))
    yield Fault("croissant.json of another licence", licence, ("does not describe dataset.json",), rehash=False)
    size, hashed = (
        manifest_of("dataset.json", put("files", file, key, value))
        for key, value in (("size", 1), ("sha256", "0"))
    )
    yield Fault("another size", size, ("left_0.png", "it says 1"), rehash=False)
    yield Fault("another hash", hashed, ("left_0.png", "checksum"), rehash=False)


def _own_list_faults() -> Iterator[Fault]:
    """Lists of sequence.json, with dataset.json made to fit."""
    own = f"{VICTIM}/sequence.json"

    def listed(change: Callable[[dict[str, Any]], object]) -> Plant:
        def plant(folder: Path) -> None:
            manifest_of(own, change)(folder)
            file = folder / own
            entry = {"sha256": sha256(file), "size": file.stat().st_size}
            manifest_of("dataset.json", put("files", own, entry))(folder)

        return plant

    for name, change, words in (
        ("a wrong hash", put("files", "gs/left_0.png", "0" * 64), ("gs/left_0.png", "sequence.json")),
        ("an empty list", put("files", {}), ("files", "sequence.json")),
        ("no list", drop("files"), ("files", "sequence.json")),
        ("a file less", drop("files", "gs_depth/left_0.exr"), ("does not list gs_depth/left_0.exr",)),
        ("a file that is not there", put("files", "gs/left_2.png", "0" * 64), ("left_2.png",)),
        ("a path outside", put("files", "../x", "0" * 64), ("../x",)),
    ):
        yield Fault(f"sequence.json lists {name}", listed(change), words, rehash=False)
    unlisted = "lies there but is not listed"
    yield Fault("a file that nothing lists", written("notes.txt"), ("notes.txt", unlisted), rehash=False)
    extra = written(f"{VICTIM}/rs/left_2.png")
    yield Fault("an image that nothing lists", extra, ("left_2.png", unlisted), rehash=False)
    gone = removed(f"{VICTIM}/gs/left_0.png")
    yield Fault("a file gone", gone, ("gs/left_0.png", "missing"), rehash=False)
    yield Fault("a file gone from all lists", gone, ("gs/left_0.png",))


FAULTS = (
    *depth_faults(),
    *image_faults(),
    *_pose_faults(),
    *_manifest_faults(),
    *_consistent_faults(),
    *_dataset_faults(),
    *_own_list_faults(),
)
